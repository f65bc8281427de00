"""Height of the sonar over the visible surface, measured from the first echoes or given by the user.

Registration scales motions by the height over the surface that carries the contrast, not over the floor. On rocks of 0.45 m,
from 2.5 m, the two heights differ by up to 0.45 m, and forward motions by 10 %. The steepest rays of a beam meet the scene
first. So the range of the first echo measures the height there, and no altimeter is needed. Where there is one, both must
agree. Where the last echoes tell a much smaller height, the ground rises, and the mean of both ends counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, argument
from mitsonar.geometry.echo_heights import EchoHeights, FirstEchoes, echo_heights
from mitsonar.geometry.ground_plane import GroundGeometry

if TYPE_CHECKING:
    from mitsonar.records.sonar_frames import SonarFrames

__all__ = ["Attitude", "attitude_of"]

AGREEING = 0.25
"""Largest difference of first echoes and given height, as part of the given height. Beyond it one of them is wrong."""

STD_MEASURED, STD_GIVEN = 0.02, 0.05
"""Standard deviation of the height over the visible surface, as part of it: with first echoes, and without."""

RISING, RISING_EVEN = 0.15, 0.03
"""By how much the height at the far end of the light is smaller than at the near end, as part of it, where ground rises.

Rocks on level ground make -0.05 to 0.07 in the mean, 0.14 at most; on a slope of 10 deg 0.17 in a fan of 29 deg and 0.43 in
one of 130 deg. Level ground without relief makes -0.01 to 0.01, a slope of 5 deg 0.05.
"""

STD_RISING = 0.29
"""Standard deviation of the height over rising ground besides, as part of that difference: it may be any between both."""


@dataclass(frozen=True)
class Attitude:
    """Height and attitude of the sonar over the visible surface.

    Attributes:
        height_m: over the visible surface [m].
        height_std_m: its standard deviation [m].
        pitch_rad: > 0 points down.
        roll_rad: > 0 puts starboard down.
        reason: why the given geometry is rejected; empty where it is not.
        even: whether first echoes show ground without relief.
        told_m: height over the ground as it was told [m]; None: it was not.
        first: what first echoes tell; None: they did not tell the height.
    """

    height_m: float
    height_std_m: float
    pitch_rad: float
    roll_rad: float = 0.0
    reason: str = ""
    even: bool = False
    told_m: float | None = None
    first: FirstEchoes | None = None

    @property
    def floor_m(self) -> float:
        """Height over the floor, where the fan begins to light it [m]: as told, but there may be a rock straight below."""
        return self.height_m if self.told_m is None else max(self.told_m, self.height_m)

    @property
    def tops_m(self) -> float:
        """Height of the contrast above the mean of the first echoes [m]; 0 where they did not tell the height."""
        return 0.0 if self.first is None else self.first.tops_m

    def ground(self, frames: SonarFrames) -> GroundGeometry:
        """Return the level ground that the cells of the frames show from this height and attitude."""
        bearing = frames.sonar.bearing
        return GroundGeometry(frames.range_m, frames.bearing_rad, bearing, self.height_m, self.pitch_rad, self.roll_rad)


def attitude_of(
    frames: SonarFrames, name: str, height_m: float | None, pitch_rad: float | None, relief_m: float | None = None
) -> Attitude:
    """Estimate height, pitch and roll of the frames' mean.

    First echoes measure the height, unless the relief is given. Else the given height counts, then that of the frames.

    Args:
        frames: consecutive frames.
        name: of the estimator, for errors.
        height_m: over the ground [m]; None: from the frames.
        pitch_rad: None: from the frames.
        relief_m: mean height of the visible surface over the ground [m]; None: from the first echoes, where there are any.

    Raises:
        MitsonarError: no pitch; a height neither given nor measured, or not above 0 or the relief.
    """
    lean = _mean_lean(frames)
    pitch = pitch_rad if pitch_rad is not None else (None if lean is None else float(lean[0]))
    given = height_m if height_m is not None else _mean(frames.height_m)
    if pitch is None or (given is None and relief_m is not None):
        raise MitsonarError(
            f"{name} needs height and pitch, and the frames do not hold both: give {argument('height_m')} and "
            f"{argument('pitch_rad')}"
        )
    if given is not None and not 0 < given < np.inf:
        raise MitsonarError(f"{name} needs a height above 0 m: got {given:g}; give {argument('height_m')}")
    roll = 0.0 if lean is None else float(lean[1])
    half = np.radians(frames.sonar.elevation_fov_deg) / 2
    if given is not None and pitch + half > np.pi / 2:
        reason = "the sonar looks past straight down: a cell shows two points of the ground"
        return Attitude(given, STD_GIVEN * given, pitch, roll, reason)
    if given is not None and relief_m is not None:
        if not given - relief_m > 0:
            raise MitsonarError(f"the height over the visible surface must be above 0: got {given:g} m less {relief_m:g} m")
        return Attitude(given - relief_m, STD_MEASURED * given, pitch, roll)
    found = echo_heights(frames, pitch, roll)
    if given is None and found.first is None:
        raise MitsonarError(
            f"{name} needs height and pitch: the frames hold no height, and their window shows no first echoes; give "
            f"{argument('height_m')}"
        )
    level = _over_level(found.first, given, pitch, roll)
    return level if level.reason else _over_rising(level, found)


def _over_level(first: FirstEchoes | None, told_m: float | None, pitch: float, roll: float) -> Attitude:
    """Return the attitude over level ground, whose height first echoes tell, or else somebody."""
    if told_m is not None:
        told = Attitude(told_m, STD_GIVEN * told_m, pitch, roll)
        if first is None:
            return told
        if abs(first.height_m - told_m) > AGREEING * told_m:
            reason = f"first echoes tell a height of {first.height_m:.2f} m, not {told_m:.2f} m: height or pitch is wrong"
            return replace(told, reason=reason)
    assert first is not None
    std = STD_MEASURED * first.height_m
    return Attitude(first.height_m, std, pitch, roll, even=first.even, told_m=told_m, first=first)


def _over_rising(level: Attitude, found: EchoHeights) -> Attitude:
    """Return the attitude over the mean of both ends of the light, where they show that the ground rises."""
    if found.last_m is None or found.ends_m is None:
        return level
    first_m = level.height_m + level.tops_m
    apart = first_m - found.last_m
    if apart <= (RISING_EVEN if level.even else RISING) * first_m:
        return level
    std = float(np.hypot(STD_MEASURED * found.ends_m, STD_RISING * apart))
    return replace(level, height_m=found.ends_m, height_std_m=std)


def _mean_lean(frames: SonarFrames) -> NDArray[np.float64] | None:
    """Return the mean of pitch and roll ``(2,)``, by the poses or by the sonar's own sensors; None where unknown."""
    table, columns = (frames.attitude_rad, slice(0, 2)) if frames.poses is None else (frames.poses, slice(3, 5))
    if table is None or not np.isfinite(table[:, columns]).all():
        return None
    return np.asarray(table.mean(axis=0)[columns])


def _mean(values: NDArray[np.float64] | None) -> float | None:
    known = None if values is None else values[np.isfinite(values)]
    return float(known.mean()) if known is not None and len(known) else None
