"""A wide band is divided into narrow ones.

For unknown scatterers, frequencies farther apart than one over the spread of delays (some 100 Hz) are independent. Parts of
a band that do not overlap therefore hold independent information on the motion; each is a channel sonar of its own carrier.
The cost of a part grows with the cube of its taps: n parts cost n squared times less than the whole band. Only the
correlation across their edges is lost.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.instruments.hydrophones import ChannelSonar

__all__ = ["BAND_HZ", "Band", "bands_of"]

Complex = NDArray[np.complex128]

BAND_HZ = 4800.0
"""Least bandwidth of a part [Hz]."""

FAINT = 1e-3
"""Frequencies at which the whole band has a smaller amplitude are left out."""


class Band(NamedTuple):
    """A part of a band.

    Attributes:
        sonar: an instrument of this part alone.
        place: indices of its frequencies among those of the whole's measurement ``(taps,)``.
        gain: from the whole's spectrum to the part's ``(taps,)``.
    """

    sonar: ChannelSonar
    place: NDArray[np.int64]
    gain: NDArray[np.float64]

    def of(self, response: Complex) -> Complex:
        """Return the response of this part ``(..., taps)`` from the response of the whole band."""
        return np.asarray(np.fft.ifft(np.fft.fft(response, axis=-1)[..., self.place] * self.gain, axis=-1))


def bands_of(sonar: ChannelSonar, width_hz: float = BAND_HZ) -> list[Band]:
    """Return the parts of an instrument's band: as many as are at least ``width_hz`` wide and sampled alike."""
    count = max(1, int(sonar.bandwidth_hz / width_hz))
    while sonar.taps % count:
        count -= 1
    step, spacing = sonar.frequency_step_hz, (1 + sonar.rolloff) * sonar.bandwidth_hz / count
    found = []
    for number in range(count):
        offset = step * round((number - (count - 1) / 2) * spacing / step)
        part = sonar.replace(
            carrier_hz=sonar.carrier_hz + offset,
            bandwidth_hz=sonar.bandwidth_hz / count,
            sampling_hz=sonar.sampling_hz / count,
        )
        frequency = np.asarray(np.fft.fftfreq(part.taps, 1 / part.sampling_hz), dtype=np.float64)
        whole = sonar.raised_cosine(frequency + offset)
        gain = np.where(whole > FAINT, part.raised_cosine(frequency) / np.maximum(whole, FAINT), 0) / count
        found.append(Band(part, np.rint((frequency + offset) / step).astype(np.int64) % sonar.taps, gain))
    return found
