"""Noise of a range rate that is measured by pulse pairs, as Doppler velocity logs do."""

from __future__ import annotations

import math

from mitsonar.errors import MitsonarError

__all__ = ["ambiguity_m_s", "pulse_pair_std"]


def pulse_pair_std(
    frequency_hz: float, lag_s: float, samples: int, correlation: float, sound_speed: float = 1500.0
) -> float:
    """Compute the standard deviation of a range rate [m/s] from the phase between two pulses.

    The phase of the correlation of ``samples`` independent complex pairs has the variance (1 - rho^2) / (2 N rho^2), the
    Cramer-Rao bound (Rodriguez and Martin 1992, IEE Proc. F 139:147, eq. 25). A phase is 4 pi f lag / c times the rate.

    Args:
        frequency_hz: carrier [Hz].
        lag_s: between the pulses [s].
        samples: independent pairs: the band times the length of the echo.
        correlation: of the pairs, above 0 and below 1: noise and what leaves the beam lower it.
        sound_speed: [m/s].

    Raises:
        MitsonarError: a correlation outside 0..1, or fewer than one pair.
    """
    if not (0 < correlation < 1 and samples >= 1):
        raise MitsonarError(
            f"pulse pairs need a correlation between 0 and 1 and one sample at least: got {correlation:g} and {samples}"
        )
    phase = math.sqrt((1 - correlation**2) / (2 * samples * correlation**2))
    return sound_speed / (4 * math.pi * frequency_hz * lag_s) * phase


def ambiguity_m_s(frequency_hz: float, lag_s: float, sound_speed: float = 1500.0) -> float:
    """Return the largest range rate [m/s] that a lag tells without ambiguity: a phase of pi."""
    return sound_speed / (4 * frequency_hz * lag_s)
