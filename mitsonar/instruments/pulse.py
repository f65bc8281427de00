"""Compressed pulses: amplitude over range after the matched filter, by resolution or by bandwidth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.instruments.aperture import half_power, series, shaded_sinc

__all__ = ["Pulse"]

HANN = series("hann")


@dataclass(frozen=True)
class Pulse:
    """A pulse after its matched filter, whose band is weighted by Hann's window: side lobes of -31 dB and less.

    Attributes:
        resolution_m: full width of its power at one half, over range [m].
    """

    resolution_m: float

    @classmethod
    def of_band(cls, bandwidth_hz: float, sound_speed: float) -> Pulse:
        """Return the pulse that fills a band.

        The width is 1.44 c / 2B: the pattern of the window at x = B times the delay 2 r / c.
        """
        return cls(half_power(HANN, 2) * sound_speed / bandwidth_hz)

    def bandwidth_hz(self, sound_speed: float) -> float:
        """Return the band that the pulse fills [Hz]: the inverse of :meth:`of_band`."""
        return half_power(HANN, 2) * sound_speed / self.resolution_m

    def shape(self, r: ArrayLike) -> NDArray[np.float64]:
        """Return the amplitude at a range ``r`` [m] from the echo, 1 at 0, of the same shape."""
        return shaded_sinc(np.asarray(r, dtype=float) * (2 * half_power(HANN, 2) / self.resolution_m), HANN)

    @cached_property
    def equivalent_m(self) -> float:
        """Return the integral of the squared amplitude over range [m]: the length of a box of the same energy."""
        r = np.linspace(-20, 20, 200_001) * self.resolution_m
        return float(np.trapezoid(self.shape(r) ** 2, r))
