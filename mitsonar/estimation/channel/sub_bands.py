"""A wide band as narrow ones side by side.

Scatterers that nothing is known of make frequencies farther apart than one over the spread of delays (some 100 Hz)
independent of each other. Parts of a band that do not overlap therefore tell of the motion independently, each a channel
sonar of its own carrier, and what is computed of each grows with the cube of its taps: n parts cost n squared times less
than the whole, and say as much but for what crosses their edges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.instruments.channel_sonar import ChannelSonar

__all__ = ["BAND_HZ", "Band", "bands_of"]

Complex = NDArray[np.complex128]

BAND_HZ = 4800.0
"""Bandwidth of a part."""

FAINT = 1e-3
"""Frequencies at which the whole band is fainter are left out."""


class Band(NamedTuple):
    """A part of a band.

    Attributes:
        sonar: that would measure it alone.
        place: its frequencies among those of the whole's measurement ``(taps,)``.
        gain: from the whole's spectrum to the part's ``(taps,)``.
    """

    sonar: ChannelSonar
    place: NDArray[np.int64]
    gain: NDArray[np.float64]

    def of(self, response: Complex) -> Complex:
        """The part's response ``(..., taps)`` of the whole's."""
        return np.asarray(np.fft.ifft(np.fft.fft(response, axis=-1)[..., self.place] * self.gain, axis=-1))


def bands_of(sonar: ChannelSonar, width_hz: float = BAND_HZ) -> list[Band]:
    """The parts of an instrument's band, as many as are at least ``width_hz`` wide and sampled alike."""
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
