"""Frames that take time: groups of beams that ping one after another, and heads that turn from beam to beam.

A frame of a DIDSON is 8 pings of 12 beams, one of an ARIS 4 to 8 pings. A mechanically scanned sonar has one beam and
turns it: its frame is a sweep, each beam of which is a ping of its own. The time of a frame is the middle of its pings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.motion.pose import Pose, mounted
from mitsonar.motion.trajectory import Trajectory

if TYPE_CHECKING:
    from mitsonar.instruments.imaging_sonar import Sonar

__all__ = [
    "GroupOrder",
    "TimedPath",
    "check_groups",
    "frame_period_s",
    "group_of_beams",
    "one_beam",
    "ping_interval_s",
    "scanned",
    "scans",
    "timed_path",
]

GroupOrder: TypeAlias = Literal["interleaved", "sequential"]


def check_groups(sonar: Sonar) -> None:
    """Check the ping groups of a sonar.

    Raises:
        ValueError: more groups than beams.
    """
    if sonar.ping_groups > sonar.beams:
        raise ValueError(
            f"each ping group has a beam at least: got ping_groups {sonar.ping_groups} and beams {sonar.beams}; lower "
            "ping_groups"
        )


def scans(sonar: Sonar) -> bool:
    """Return whether each beam is a ping of its own: a head that turns."""
    return 1 < sonar.beams == sonar.ping_groups


def group_of_beams(sonar: Sonar) -> NDArray[np.int64]:
    """Return the number of the group of each beam ``(beams,)``; groups ping in the order of their numbers."""
    beam = np.arange(sonar.beams)
    return beam % sonar.ping_groups if sonar.group_order == "interleaved" else beam * sonar.ping_groups // sonar.beams


def ping_interval_s(sonar: Sonar) -> float:
    """Return the time from the ping of one group to that of the next [s]: as given, or echo and overhead."""
    if sonar.group_interval_s is not None:
        return sonar.group_interval_s
    return 2 * sonar.range_max / sonar.sound_speed + sonar.group_overhead_s


def frame_period_s(sonar: Sonar) -> float:
    """Return the time from frame to frame [s]: one over the frame rate, of a head that turns its sweep."""
    return sonar.ping_groups * ping_interval_s(sonar) if scans(sonar) else 1 / sonar.frame_rate_hz


def scanned(sonar: Sonar, *, sector_deg: float = 360.0, step_deg: float = 0.9, overhead_s: float = 0.0) -> Sonar:
    """Return the sonar whose beams are the steps of a head that turns a one-beam sonar from port to starboard.

    Each step is a ping with its own time and pose. It lasts ``2 range_max / sound_speed + overhead_s``. A frame is a sweep.

    Args:
        sonar: with one beam; ``beam_width_deg``, or its ``azimuth_fov_deg``, is the width of the beam.
        sector_deg: that is swept, at most 360 [deg]; 0 deg is ahead, in its middle.
        step_deg: from beam to beam [deg]; the sector must be a whole number of them.
        overhead_s: for turning and reporting, a step [s].

    Raises:
        MitsonarError: more beams than one; a sector that is no whole number of steps.
    """
    if sonar.beams != 1:
        raise MitsonarError(f"a head that turns has one beam: got {sonar.beams}; give a sonar with beams 1")
    steps = round(sector_deg / step_deg) if step_deg > 0 and 0 < sector_deg <= 360 else 0
    if steps < 2 or not math.isclose(steps * step_deg, sector_deg, rel_tol=1e-6):
        raise MitsonarError(
            f"a sector of at most 360 deg is a whole number of steps: got {sector_deg:g} deg and steps of {step_deg:g} deg"
        )
    if not 0 <= overhead_s < math.inf:
        raise MitsonarError(f"the overhead of a step must be 0 s or more: got {overhead_s:g}")
    interval = 2 * sonar.range_max / sonar.sound_speed + overhead_s
    return sonar.replace(
        beams=steps,
        azimuth_fov_deg=sector_deg,
        beam_width_deg=math.degrees(sonar.beam_width_rad),
        bearing="azimuth",
        beam_layout="even",
        ping_groups=steps,
        group_order="sequential",
        group_interval_s=None,
        group_overhead_s=overhead_s,
        frame_rate_hz=1 / (steps * interval),
    )


def one_beam(sonar: Sonar) -> Sonar:
    """Return the one beam that a head turns, of a sonar that scans."""
    width = math.degrees(sonar.beam_width_rad)
    return sonar.replace(beams=1, azimuth_fov_deg=width, beam_width_deg=width, ping_groups=1)


@dataclass(frozen=True)
class TimedPath:
    """The pings of all frames.

    Attributes:
        frames: pose and time of each frame, the middle of its pings.
        time_s: of each ping ``(frames, groups)``, or ``(frames,)`` where a frame is one ping [s].
        poses: of each ping ``(frames, groups, 6)``, or ``(frames, 6)`` [m, rad].
    """

    frames: Trajectory
    time_s: NDArray[np.float64]
    poses: NDArray[np.float64]

    def of_beams(self, sonar: Sonar) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Return the time of each beam ``(frames, beams)`` and its pose; ``(frames,)`` and None for one ping a frame."""
        if self.time_s.ndim == 1:
            return self.time_s, None
        group = group_of_beams(sonar)
        return self.time_s[:, group], self.poses[:, group]


def timed_path(sonar: Sonar, path: Trajectory) -> TimedPath:
    """Return the pings of all frames along a path.

    A frame is due at each time of the path. Poses of its pings lie between those of the path; before its first and after
    its last one the vehicle goes on as beside it. A head that turns sweeps without a pause from the path's begin on, as
    often as the path is long; along a single pose it sweeps once.

    Raises:
        MitsonarError: a path that is too short for a sweep, or whose times do not grow.
    """
    if sonar.ping_groups == 1:
        return TimedPath(path, path.time_s, path.poses)
    offsets = (np.arange(sonar.ping_groups) - (sonar.ping_groups - 1) / 2) * ping_interval_s(sonar)
    due = path.time_s
    if scans(sonar) and len(path) > 1:
        sweep = ping_interval_s(sonar) * sonar.ping_groups
        lasts = path.time_s[-1] - path.time_s[0]
        if lasts < sweep * (1 - 1e-9):
            raise MitsonarError(f"a sweep lasts {sweep:.4g} s and the path {lasts:.4g} s: give a longer path")
        due = path.time_s[0] + (np.arange(int(lasts / sweep + 1e-9)) + 0.5) * sweep
    longer = path.lengthened(-offsets[0])
    time = due[:, None] + offsets
    poses = longer.at(time.ravel()).reshape(*time.shape, 6)
    frames = path if due is path.time_s else Trajectory(longer.at(due), due)
    return TimedPath(frames, time, poses)


def turned_heads(sonar: Sonar, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses of the head of a sonar that scans, from those of the vehicle, both ``(frames, beams, 6)``."""
    found = np.empty_like(poses)
    group = group_of_beams(sonar)
    for beam, bearing in enumerate(sonar.bearing_rad):
        found[:, group[beam]] = mounted(poses[:, group[beam]], Pose(0, 0, 0, heading=float(bearing)))
    return found
