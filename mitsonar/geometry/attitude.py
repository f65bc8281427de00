"""Height of the sonar over the visible surface, measured from the first echoes or given by the user.

Registration scales motions by the height over the surface that carries the contrast, not over the floor. On rocks of 0.45 m,
from 2.5 m, the two heights differ by up to 0.45 m, and forward motions by 10 %. The steepest rays of a beam meet the scene
first. So the range of the first echo measures the height there, and no altimeter is needed. Where there is one, both must
agree. Where the last echoes tell a much smaller height, the ground rises, and the mean of both ends counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, argument
from mitsonar.geometry.echo_heights import EchoHeights, FirstEchoes, echo_heights
from mitsonar.geometry.ground_plane import GroundGeometry

if TYPE_CHECKING:
    from mitsonar.records.frames import SonarFrames

__all__ = ["Attitude", "attitude_of"]

DOUBTFUL = 3.0
"""Standard deviations of both beyond which first echoes contradict a given height, and do not count."""

SAME = 1e-9
"""Differences of heights [m] and angles [rad] of frames that are none."""

STD_MEASURED, STD_GIVEN = 0.02, 0.05
"""Standard deviation of the height over the visible surface, as part of it: with first echoes, and without."""

RISING, RISING_EVEN = 0.15, 0.03
"""By how much the height at the far end of the light is smaller than at the near end, as part of it, where ground rises.

Rocks on level ground make -0.05 to 0.07 in the mean, 0.14 at most; on a slope of 10 deg 0.17 in a fan of 29 deg and 0.43 in
one of 130 deg. Level ground without relief makes -0.01 to 0.01, a slope of 5 deg 0.05.
"""

STD_RISING = 0.29
"""Standard deviation of the height over rising ground besides, as part of that difference: it may be any between both."""


STEEPEST = 2.0
"""How many times higher or lower than at the ends of the light a sonar may be over rising ground straight below it."""


class Apart(NamedTuple):
    """Height [m], pitch and roll [rad] of a frame, less those of the mean of the frames."""

    height_m: float
    pitch_rad: float
    roll_rad: float


NOT_APART = Apart(0.0, 0.0, 0.0)

UNKNOWN_PER_S = Apart(0.06, math.radians(4.0), math.radians(4.0))
"""How fast height [m/s], pitch and roll [rad/s] of a vehicle change on a calm day, root mean square.

Heave of 4 cm in 3 s, pitch and roll of 2 deg in 2.2 s. What nothing tells may change as fast."""

UNKNOWN_MOST = Apart(0.04, math.radians(2.0), math.radians(2.0))
"""How far they are apart in frames that are far apart in time, root mean square."""

COARSE = 12
"""Ranges and bearings at which the apparent motion of a heave, a pitch and a roll is computed."""


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
        given_m: height over the ground as given [m]; None: it was not.
        first: height by first echoes; None where they do not show it, or contradict the height as given.
        doubt: how echoes contradict the height as given, which counts unless the ground rises; empty where they do not.
        apart: height, pitch and roll of each frame, less their mean; empty where they are not known, or all the same.
        unsure: standard deviation of their change from one frame to the other; 0 where it is known.
    """

    height_m: float
    height_std_m: float
    pitch_rad: float
    roll_rad: float = 0.0
    reason: str = ""
    doubt: str = ""
    even: bool = False
    given_m: float | None = None
    first: FirstEchoes | None = None
    apart: tuple[Apart, ...] = ()
    unsure: Apart = NOT_APART

    @property
    def floor_m(self) -> float:
        """Height over the floor, where the fan begins to light it [m]: as given, but there may be a rock straight below."""
        return self.height_m if self.given_m is None else max(self.given_m, self.height_m)

    @property
    def tops_m(self) -> float:
        """Height of the contrast above the mean of the first echoes [m]; 0 where they did not tell the height."""
        return 0.0 if self.first is None else self.first.tops_m

    @property
    def about(self) -> dict[str, str]:
        """Return what an estimate must report of the attitude: a doubt, if there is one."""
        return {"doubt": self.doubt} if self.doubt else {}

    def of_frame(self, number: int, lift_m: float = 0.0) -> tuple[float, float, float]:
        """Return height [m], pitch and roll [rad] of one of the frames, over ground that is raised by ``lift_m``."""
        apart = self.apart[number] if self.apart else NOT_APART
        return self.height_m + apart.height_m - lift_m, self.pitch_rad + apart.pitch_rad, self.roll_rad + apart.roll_rad

    def widened(self, covariance: NDArray[np.float64], frames: SonarFrames) -> NDArray[np.float64]:
        """Return the covariance of a motion ``(3, 3)`` with what unknown heave, pitch and roll add.

        Args:
            covariance: of sideways, forward [m], yaw [rad], were height and attitude the same in both frames.
            frames: both.
        """
        std = np.array(self.unsure)
        if not std.any():
            return covariance
        seen = self.ground(frames).motions_of_lean(COARSE, np.radians(frames.sonar.elevation_fov_deg) / 2) * std
        return np.asarray(covariance + seen @ seen.T)

    def ground(self, frames: SonarFrames, number: int | None = None) -> GroundGeometry:
        """Return the level ground that the cells show, of the mean of the frames or of one of them."""
        pose = (self.height_m, self.pitch_rad, self.roll_rad) if number is None else self.of_frame(number)
        return GroundGeometry(frames.range_m, frames.bearing_rad, frames.sonar.bearing, *pose)


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
    leans = _leans(frames)
    lean = None if leans is None else leans.mean(axis=0)
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
        return Attitude(given - relief_m, STD_MEASURED * given, pitch, roll, apart=_apart(frames), unsure=_unsure(frames))
    found = echo_heights(frames, pitch, roll)
    if given is None and found.first is None:
        raise MitsonarError(
            f"{name} needs height and pitch: the frames hold no height, and their window shows no first echoes; give "
            f"{argument('height_m')}"
        )
    attitude = (
        _over_rising(found, given, pitch, roll) if _rises(found, given) else _over_level(found.first, given, pitch, roll)
    )
    return replace(attitude, apart=_apart(frames), unsure=_unsure(frames))


def _rises(found: EchoHeights, given_m: float | None) -> bool:
    """Return whether the far end of the light lies so much higher than its near end that the ground must rise."""
    if found.last_clear_m is None:
        return False
    first_m = found.first.height_m + found.first.tops_m if found.first is not None else given_m
    assert first_m is not None
    even = found.first is not None and found.first.even
    return first_m - found.last_clear_m > (RISING_EVEN if even else RISING) * first_m


def _over_rising(found: EchoHeights, given_m: float | None, pitch: float, roll: float) -> Attitude:
    """Return the attitude over ground that rises: the mean height of both ends of the light counts."""
    assert found.ends_m is not None
    assert found.last_m is not None
    first = found.first
    first_m = first.height_m + first.tops_m if first is not None else given_m
    assert first_m is not None
    std = float(np.hypot(STD_MEASURED * found.ends_m, STD_RISING * (first_m - found.last_m)))
    doubt = ""
    if given_m is not None and not found.last_m / STEEPEST < given_m < STEEPEST * first_m:
        ends = f"{first_m:.2f} and {found.last_m:.2f} m"
        doubt = f"the ground rises, and its ends give heights of {ends}, not {given_m:.2f} m"
    even = first is not None and first.even
    return Attitude(found.ends_m, std, pitch, roll, doubt=doubt, even=even, given_m=given_m, first=first)


def _over_level(first: FirstEchoes | None, given_m: float | None, pitch: float, roll: float) -> Attitude:
    """Return the attitude over level ground: the height as given, by first echoes, or both by their weights."""
    if first is None:
        assert given_m is not None
        return Attitude(given_m, STD_GIVEN * given_m, pitch, roll, given_m=given_m)
    std = STD_MEASURED * first.height_m
    measured = Attitude(first.height_m, std, pitch, roll, even=first.even, given_m=given_m, first=first)
    if given_m is None:
        return measured
    given_std = STD_GIVEN * given_m
    if abs(first.height_m - given_m) > DOUBTFUL * math.hypot(given_std, std):
        doubt = f"first echoes give a height of {first.height_m:.2f} m, not {given_m:.2f} m"
        std = math.hypot(given_std, first.height_m - given_m)
        return replace(measured, height_m=given_m, height_std_m=std, even=False, first=None, doubt=doubt)
    weight = given_std**2 / (given_std**2 + std**2)
    height = given_m + weight * (first.height_m - given_m)
    return replace(measured, height_m=height, height_std_m=given_std * math.sqrt(1 - weight))


def _apart(frames: SonarFrames) -> tuple[Apart, ...]:
    """Return height, pitch and roll of each frame less their mean; empty where they are not known, or all the same."""
    leans = _leans(frames)
    if leans is None:
        return ()
    heights = np.zeros(len(leans)) if frames.poses is None else np.nan_to_num(frames.poses[:, 2])
    known = np.column_stack([heights, leans])
    apart = known - known.mean(axis=0)
    return () if (np.abs(apart) < SAME).all() else tuple(Apart(*(float(value) for value in row)) for row in apart)


def _unsure(frames: SonarFrames) -> Apart:
    """Return how far the frames may be apart in what nothing tells. One pitch and roll for all frames tells no change."""
    time_s = frames.time_s if frames.time_s.ndim == 1 else frames.time_s.mean(axis=1)
    step_s = abs(float(time_s[-1] - time_s[0]))
    leans = _leans(frames)
    heave = frames.poses is not None and bool(np.isfinite(frames.poses[:, 2]).all())
    lean = leans is not None and (heave or bool((np.abs(leans - leans[0]) > SAME).any()))
    rates = zip(UNKNOWN_PER_S, UNKNOWN_MOST, (heave, lean, lean), strict=True)
    return Apart(*(0.0 if known else min(rate * step_s, most) for rate, most, known in rates))


def _leans(frames: SonarFrames) -> NDArray[np.float64] | None:
    """Return pitch and roll of each frame ``(frames, 2)``, by the poses or the sonar's own sensors; None where unknown."""
    table, columns = (frames.attitude_rad, slice(0, 2)) if frames.poses is None else (frames.poses, slice(3, 5))
    if table is None or not np.isfinite(table[:, columns]).all():
        return None
    return np.asarray(table[:, columns])


def _mean(values: NDArray[np.float64] | None) -> float | None:
    known = None if values is None else values[np.isfinite(values)]
    return float(known.mean()) if known is not None and len(known) else None
