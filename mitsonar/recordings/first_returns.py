"""Where is the first strong return of each beam? Ranges and points for tools that map from laser scans and point clouds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, argument
from mitsonar.instruments.sonar import group_of_beams, ping_offsets_s, scans
from mitsonar.instruments.views import directions
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.records.frames import SonarFrames, to_float32

__all__ = ["BeamReturns", "FirstReturns", "beam_times", "return_points"]


Array = NDArray[np.float64]


class BeamReturns(NamedTuple):
    """The first return of each beam.

    Attributes:
        range_m: ranges ``(frames, beams)`` [m]; inf for a beam without a return.
        value: image values at these ranges ``(frames, beams)`` in 0..1; 0 without a return.
        from_m: range at which the search began [m].
    """

    range_m: Array
    value: NDArray[np.float32]
    from_m: float = 0.0

    def select(self, index: slice) -> BeamReturns:
        """Return those of a subset of the frames."""
        return self._replace(range_m=self.range_m[index], value=self.value[index])


@dataclass(frozen=True)
class FirstReturns:
    """Rule that picks the first return of a beam.

    A return begins at the first bin at or above a level. It ends where a bin falls below the level, at the latest
    ``length_m`` beyond its begin. Its range is that of its strongest bin.

    Attributes:
        level_db: least level of a return, relative to full scale [dB].
        from_m: range at which the search begins [m], beyond the ringing of the transducer.
        length_m: largest extent of a return in range [m]; behind it may follow the reverberation of what returned it.

    Raises:
        MitsonarError: a level above full scale, or a negative range or length.
    """

    level_db: float = -20.0
    from_m: float = 0.0
    length_m: float = 0.2

    def __post_init__(self) -> None:
        if not -300 <= self.level_db <= 0:
            raise MitsonarError(
                f"{argument('level_db')} is a level relative to full scale, from -300 to 0 dB: got {self.level_db:g}"
            )
        if not 0 <= self.from_m < math.inf:
            raise MitsonarError(f"{argument('from_m')} must be a range of 0 m or more: got {self.from_m:g}")
        if not 0 <= self.length_m < math.inf:
            raise MitsonarError(f"{argument('length_m')} must be a length of 0 m or more: got {self.length_m:g}")

    def doubts(self, beams: int, returned: int, nearest: int) -> list[str]:
        """Return one-sentence notes on a level that finds nothing, or only the ringing of the transducer.

        Args:
            beams: number of beams that were searched.
            returned: number of beams with a return.
            nearest: number of returns in the first bin that is searched.
        """
        if beams and not returned:
            searched = f"{self.level_db:g} dB or more from {self.from_m:g} m on"
            return [f"no beam has a return of {searched}: give a lower level, but above that of the noise"]
        if nearest > returned / 2:
            return [
                f"{nearest:,} of {returned:,} returns are at {self.from_m:g} m, where the search begins, perhaps ringing of "
                "the transducer: begin farther out, or give a higher level"
            ]
        return []

    def find(self, frames: SonarFrames) -> BeamReturns:
        """Find the first return of each beam of each frame.

        Raises:
            MitsonarError: contrast images, which hold no levels.
        """
        beyond = frames.range_m >= self.from_m
        level_db = frames.in_decibels()[:, beyond]
        range_m, image = frames.range_m[beyond], frames.image[:, beyond]
        if not len(range_m) or not len(frames):
            shape = (len(frames), len(frames.bearing_rad))
            return BeamReturns(np.full(shape, np.inf), np.zeros(shape, np.float32), self.from_m)
        # 1. A return is the first run of bins above the level, up to its largest extent.
        above = (level_db >= self.level_db) & (image > 0)
        begun = np.logical_or.accumulate(above, axis=1)
        run = above & ~np.logical_or.accumulate(begun & ~above, axis=1)
        run &= range_m[:, None] <= range_m[above.argmax(axis=1)][:, None] + self.length_m
        # 2. Its strongest bin counts, the nearest of equally strong ones.
        strongest = np.where(run, level_db, -np.inf).argmax(axis=1)
        has_return = above.any(axis=1)
        value = to_float32(np.take_along_axis(image, strongest[:, None], axis=1)[:, 0])
        range_m = np.where(has_return, range_m[strongest], np.inf)
        return BeamReturns(range_m, np.where(has_return, value, np.float32(0)), self.from_m)


def beam_times(frames: SonarFrames, index: int) -> Array | None:
    """Return the times of the beams of a frame ``(beams,)`` [s]; None if all ping at once, or in unknown order."""
    if frames.time_s.ndim == 2:
        return np.asarray(frames.time_s[index], dtype=np.float64)
    if not scans(frames.sonar) or frames.sonar.beams != len(frames.bearing_rad):
        return None
    return np.asarray(frames.time_s[index] + ping_offsets_s(frames.sonar)[group_of_beams(frames.sonar)], dtype=np.float64)


def return_points(frames: SonarFrames, index: int, range_m: Array) -> Array:
    """Return the points of a frame at the given ranges ``(beams,)`` as starboard, forward, up ``(beams, 3)`` [m].

    They lie in the plane of the beams, in the axes of the sonar at the time of the frame. If the pose at each beam is known,
    the motion of the sonar during the frame is taken into account. Infinite ranges give points that are not finite.
    """
    local = directions(frames.sonar.bearing, frames.bearing_rad, np.zeros(len(range_m)))
    with np.errstate(invalid="ignore"):
        points = np.asarray(local * range_m[:, None], dtype=np.float64)
        if frames.beam_poses is None or frames.poses is None:
            return points
        beams, pose = frames.beam_poses[index], frames.poses[index]
        world = beams[:, :3] + np.einsum("bij,bj->bi", vehicle_rotation(beams).as_matrix(), points)
        return np.asarray((world - pose[:3]) @ vehicle_rotation(pose[None]).as_matrix()[0], dtype=np.float64)
