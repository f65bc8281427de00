"""Checks that all estimators of impulse responses share: of pings, reach and height."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, argument
from mitsonar.records.responses import ImpulseResponses

__all__ = ["Pings", "assumed_height", "pings_of", "reach_of"]

UNEVEN = 0.01
"""Part of an interval by which the time of a ping may deviate."""


class Pings(NamedTuple):
    """Checked responses.

    Attributes:
        response: ``(pings, receivers, taps)`` complex128.
        interval_s: from ping to ping [s].
        silent: receivers without any echo in one ping or more.
    """

    response: NDArray[np.complex128]
    interval_s: float
    silent: tuple[str, ...]


def pings_of(responses: ImpulseResponses) -> Pings:
    """Check responses and convert them to complex128.

    Raises:
        MitsonarError: fewer than two pings, times that do not rise evenly, values that are not finite.
    """
    if len(responses) < 2:
        raise MitsonarError(f"an estimator of motion takes two pings or more: got {len(responses)}; give a longer run")
    if not np.isfinite(responses.response).all():
        raise MitsonarError("the responses hold nan or inf: leave such pings out")
    steps = np.diff(responses.time_s)
    interval = float(steps.mean())
    if not (np.isfinite(interval) and interval > 0 and (np.abs(steps - interval) <= UNEVEN * interval).all()):
        raise MitsonarError(
            f"pings must come at equal times that rise: got steps of {steps.min():g} to {steps.max():g} s; select such pings"
        )
    quiet = np.asarray(~responses.response.any(axis=2).all(axis=0), dtype=bool)
    names = tuple(one.name for number, one in enumerate(responses.sonar.receivers) if quiet[number])
    return Pings(responses.response.astype(np.complex128), interval, names)


def reach_of(interval_s: float, speed: float, wavelength_m: float, most_waves: float) -> float:
    """Return the longest motion between pings [m].

    Raises:
        MitsonarError: more wavelengths than can be searched.
    """
    reach = speed * interval_s
    if reach > most_waves * wavelength_m:
        raise MitsonarError(
            f"pings {interval_s:g} s apart at up to {speed:g} m/s leave motions of up to {reach:.3g} m open, "
            f"{reach / wavelength_m:.3g} wavelengths, of which at most {most_waves:g} can be searched: measure more often, "
            f"or give the estimator a lower speed (NAME:speed={most_waves * wavelength_m / interval_s:.2g})"
        )
    return reach


def assumed_height(responses: ImpulseResponses, name: str, height_m: float | None) -> float:
    """Return the height of the transmitter over the ground [m]: as given, or the mean of the responses' heights.

    Raises:
        MitsonarError: neither is there, or it is not positive or beyond the instrument's range.
    """
    if height_m is not None:
        height = height_m
    elif responses.height_m is not None:
        height = float(np.mean(responses.height_m))
    else:
        raise MitsonarError(f"{name} needs the height over the ground: the responses hold none; give {argument('height_m')}")
    if not 0 < height < responses.sonar.range_max:
        raise MitsonarError(
            f"{name}: {argument('height_m')} must be above 0 and below range_max {responses.sonar.range_max:g} m: got "
            f"{height:g} m"
        )
    return height
