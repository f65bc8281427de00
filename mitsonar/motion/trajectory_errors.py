"""Errors of an estimated path: absolute and relative errors as `evo` defines them, and drift at the end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError
from mitsonar.motion.pose import poses_from, vehicle_rotation
from mitsonar.motion.trajectory import Trajectory

__all__ = [
    "Alignment",
    "DeltaUnit",
    "PathErrors",
    "absolute_errors",
    "aligned",
    "assess",
    "associated",
    "distance_driven",
    "path_length",
    "relative_errors",
]

Alignment = Literal["none", "first", "plane", "space"]
"""Alignment of an estimated path with the true one.

``none``: no alignment. ``first``: by the first pose. ``plane``: by the rotation about the vertical and the shift in the
plane that fit all positions best. ``space``: by the rotation and shift in space that do so (Umeyama, 1991, without scale).
"""

DeltaUnit = Literal["frames", "metres"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SHORTEST_PATH_M = 1e-3
"""Shortest path for which drift per length is defined."""


@dataclass(frozen=True)
class PathErrors:
    """Errors of an estimated path; angles are those of the rotation between the attitudes.

    Attributes:
        frames: number of poses compared.
        alignment: of the paths, for the absolute errors.
        path_m: length of the true path [m].
        estimated_path_m: length of the estimated path [m].
        absolute_rmse_m: absolute trajectory error, root of the mean square [m].
        absolute_max_m: the largest [m].
        absolute_angle_rmse_rad: the same for the attitude [rad].
        delta: length over which the relative errors are taken.
        unit: of ``delta``: frames, or metres of the true path.
        pairs: number of relative errors.
        relative_rmse_m: relative pose error, translation [m].
        relative_angle_rmse_rad: relative pose error, rotation [rad].
        end_error_m: at the last pose, with the first poses aligned [m].
        end_heading_rad: heading error accumulated from the first to the last pose [rad], clockwise positive, not wrapped.
    """

    frames: int
    alignment: Alignment
    path_m: float
    estimated_path_m: float
    absolute_rmse_m: float
    absolute_max_m: float
    absolute_angle_rmse_rad: float
    delta: float
    unit: DeltaUnit
    pairs: int
    relative_rmse_m: float
    relative_angle_rmse_rad: float
    end_error_m: float
    end_heading_rad: float

    @property
    def end_drift(self) -> float:
        """Return the end error as a fraction of the path's length (Almanza-Medina, 5.4.5); nan for a path below 1 mm."""
        return self.end_error_m / self.path_m if self.path_m > SHORTEST_PATH_M else np.nan

    @property
    def heading_drift_rad_per_m(self) -> float:
        """Return the heading error per metre of path [rad/m], clockwise positive; nan for a path below 1 mm."""
        return self.end_heading_rad / self.path_m if self.path_m > SHORTEST_PATH_M else np.nan

    def rows(self) -> list[tuple[str, float, str]]:
        """Return name, value and unit of every error: the one table for console, log and README."""
        laid = {"none": "as they lie", "first": "first pose aligned", "plane": "aligned in the plane", "space": "aligned"}
        unit = {"frames": "frame", "metres": "m"}[self.unit] + ("s" if self.unit == "frames" and self.delta != 1 else "")
        each = f"over {self.delta:g} {unit}"
        return [
            ("poses compared", self.frames, ""),
            ("path length", self.path_m, "m"),
            ("estimated path length", self.estimated_path_m, "m"),
            (f"absolute error RMSE, {laid[self.alignment]}", 1e3 * self.absolute_rmse_m, "mm"),
            (f"absolute error maximum, {laid[self.alignment]}", 1e3 * self.absolute_max_m, "mm"),
            (
                f"absolute attitude error RMSE, {laid[self.alignment]}",
                float(np.degrees(self.absolute_angle_rmse_rad)),
                "deg",
            ),
            (f"relative error RMSE {each}", 1e3 * self.relative_rmse_m, "mm"),
            (f"relative attitude error RMSE {each}", float(np.degrees(self.relative_angle_rmse_rad)), "deg"),
            ("end-point error", 1e3 * self.end_error_m, "mm"),
            ("end-point drift", 100 * self.end_drift, "% of path"),
            ("heading error at the end", float(np.degrees(self.end_heading_rad)), "deg"),
            ("heading drift", 100 * float(np.degrees(self.heading_drift_rad_per_m)), "deg per 100 m"),
        ]


def assess(
    estimated: Trajectory,
    true: Trajectory,
    *,
    align: Alignment = "first",
    delta: float = 1,
    unit: DeltaUnit = "frames",
    tolerance_s: float = 0.01,
) -> PathErrors:
    """Compute all errors of an estimated path.

    Args:
        estimated: the path to judge.
        true: the true path. Its length counts all its poses between the first and the last compared.
        align: alignment of the paths for the absolute errors; drift always counts from the first pose.
        delta: length over which relative errors are taken, one after another without overlap.
        unit: of ``delta``: frames, or metres of the true path.
        tolerance_s: largest difference in time of the poses that are compared [s].

    Raises:
        MitsonarError: fewer than two poses at equal times, a path too short for ``delta``, or one that cannot be aligned.
    """
    mine, theirs = associated(estimated.time_s, true.time_s, tolerance_s)
    if mine.size < 2:
        raise MitsonarError(f"a path's errors need two poses or more at equal times: got {mine.size}; give longer paths")
    whole = Trajectory(true.poses[theirs[0] : theirs[-1] + 1], true.time_s[theirs[0] : theirs[-1] + 1])
    estimated, true = _picked(estimated, mine), _picked(true, theirs)
    absolute, angle = absolute_errors(estimated, true, align)
    relative, turn = relative_errors(estimated, true, delta, unit)
    ends, _ = absolute_errors(estimated, true, "first")
    astray = np.unwrap(estimated.poses[:, 5] - true.poses[:, 5])
    return PathErrors(
        frames=len(true),
        alignment=align,
        path_m=path_length(whole),
        estimated_path_m=path_length(estimated),
        absolute_rmse_m=_rms(absolute),
        absolute_max_m=float(absolute.max()),
        absolute_angle_rmse_rad=_rms(angle),
        delta=delta,
        unit=unit,
        pairs=relative.size,
        relative_rmse_m=_rms(relative),
        relative_angle_rmse_rad=_rms(turn),
        end_error_m=float(ends[-1]),
        end_heading_rad=float(astray[-1] - astray[0]),
    )


def associated(estimated_s: Array, true_s: Array, tolerance_s: float = 0.01) -> tuple[Index, Index]:
    """Match poses by time: each is the nearest of the other, within the tolerance.

    Returns:
        Indices ``(matches,)`` into both paths.

    Raises:
        MitsonarError: times that do not increase, or no match within the tolerance.
    """
    for name, time in (("estimated", estimated_s), ("true", true_s)):
        if not (np.diff(time) > 0).all():
            raise MitsonarError(f"the times of the {name} path must increase: sort its poses")
    theirs = _nearest(true_s, estimated_s)
    mine = np.arange(len(estimated_s))
    apart = np.abs(true_s[theirs] - estimated_s)
    # times read from a file differ in their last digit
    keep = (_nearest(estimated_s, true_s)[theirs] == mine) & (apart <= tolerance_s + 1e-9)
    if not keep.any():
        raise MitsonarError(
            f"no pose of the estimated path ({estimated_s[0]:g}..{estimated_s[-1]:g} s) is within {tolerance_s:g} s of one "
            f"of the true path ({true_s[0]:g}..{true_s[-1]:g} s): the nearest is {apart.min():.3g} s away; give paths of "
            "the same run, or a larger tolerance_s"
        )
    return mine[keep], theirs[keep]


def path_length(path: Trajectory) -> float:
    """Sum the distances from pose to pose [m]."""
    return float(distance_driven(path)[-1])


def distance_driven(path: Trajectory) -> Array:
    """Sum the distances from pose to pose up to each pose ``(frames,)`` [m]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path.poses[:, :3], axis=0), axis=1))])


def aligned(estimated: Trajectory, true: Trajectory, align: Alignment) -> Trajectory:
    """Align an estimated path with the true one; both have the same frames.

    Raises:
        MitsonarError: another number of poses, an unknown alignment, or positions that do not determine the rotation.
    """
    if len(estimated) != len(true):
        raise MitsonarError(
            f"as many estimated as true poses are needed: got {len(estimated)} and {len(true)}; associate them"
        )
    here, there = estimated.poses[:, :3], true.poses[:, :3]
    if align == "none":
        return estimated
    if align == "first":
        turn = vehicle_rotation(true.poses[0]) * vehicle_rotation(estimated.poses[0]).inv()
        shift = there[0] - turn.apply(here[0])[0]
    elif align == "plane":
        turn = _turn_in_the_plane(here, there)
        shift = (there - turn.apply(here)).mean(axis=0) * [1, 1, 0]
    elif align == "space":
        turn = _turn_in_space(here, there)
        shift = (there - turn.apply(here)).mean(axis=0)
    else:
        raise MitsonarError(f"align must be one of {', '.join(get_args(Alignment))}: got {align!r}")
    return Trajectory(poses_from(turn.apply(here) + shift, turn * vehicle_rotation(estimated.poses)), estimated.time_s)


def absolute_errors(estimated: Trajectory, true: Trajectory, align: Alignment = "first") -> tuple[Array, Array]:
    """Compute distance [m] and angle [rad] between the poses ``(frames,)`` of two paths after alignment."""
    fitted = aligned(estimated, true, align)
    angle = (vehicle_rotation(true.poses).inv() * vehicle_rotation(fitted.poses)).magnitude()
    return np.linalg.norm(fitted.poses[:, :3] - true.poses[:, :3], axis=1), np.asarray(angle)


def relative_errors(
    estimated: Trajectory, true: Trajectory, delta: float = 1, unit: DeltaUnit = "frames", *, overlapping: bool = False
) -> tuple[Array, Array]:
    """Compute the errors of motions over ``delta`` frames, or over so many metres of the true path.

    Args:
        estimated: the path to judge.
        true: the true path, with the same frames.
        delta: length of each motion.
        unit: of ``delta``: frames or metres.
        overlapping: whether a motion begins at every frame, or each where the one before ends.

    Returns:
        Distance [m] and angle [rad] ``(pairs,)``.

    Raises:
        MitsonarError: another number of poses, or a path that is shorter than ``delta``.
    """
    if len(estimated) != len(true):
        raise MitsonarError(
            f"as many estimated as true poses are needed: got {len(estimated)} and {len(true)}; associate them"
        )
    first, second = _pairs(true, delta, unit, overlapping)
    position, turn = _between(true, first, second)
    got, turned = _between(estimated, first, second)
    return np.linalg.norm(got - position, axis=1), np.asarray((turn.inv() * turned).magnitude())


def _pairs(true: Trajectory, delta: float, unit: DeltaUnit, overlapping: bool) -> tuple[Index, Index]:
    """Return the first and second frame of each relative error."""
    index = np.arange(len(true))
    if unit == "frames" and delta >= 1 and float(delta).is_integer():
        ends = index + int(delta)
    elif unit == "metres" and delta > 0:
        driven = distance_driven(true)
        ends = np.searchsorted(driven, driven + delta * (1 - 1e-9))  # rounding must not lengthen equal steps
    else:
        raise MitsonarError(f"delta must be 1, 2, ... frames or a positive number of metres: got {delta:g} {unit}")
    starts = index[ends < len(true)]
    if not starts.size:
        raise MitsonarError(f"the path, {len(true)} poses over {path_length(true):.3g} m, is shorter than {delta:g} {unit}")
    if not overlapping:
        chain = [0]
        while ends[chain[-1]] < len(true):
            chain.append(int(ends[chain[-1]]))
        starts = np.array(chain[:-1])
    return starts, ends[starts]


def _between(path: Trajectory, first: Index, second: Index) -> tuple[Array, Rotation]:
    """Return positions ``(pairs, 3)`` and attitudes of the second poses, in axes of the first."""
    turn = vehicle_rotation(path.poses)
    back = turn[first].inv()
    return back.apply(path.poses[second, :3] - path.poses[first, :3]), back * turn[second]


def _turn_in_the_plane(here: Array, there: Array) -> Rotation:
    a, b = (points[:, :2] - points[:, :2].mean(axis=0) for points in (here, there))
    along, across = float((a * b).sum()), float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    if np.hypot(along, across) <= 1e-12 * np.linalg.norm(a) * np.linalg.norm(b) or not (a.any() and b.any()):
        raise MitsonarError("a path without motion cannot be aligned by its positions: align by the first pose")
    return Rotation.from_euler("z", np.arctan2(across, along))


def _turn_in_space(here: Array, there: Array) -> Rotation:
    a, b = (points - points.mean(axis=0) for points in (here, there))
    spread = np.linalg.svd(b.T @ a, compute_uv=False)
    if spread[1] <= 1e-9 * spread[0]:
        raise MitsonarError(
            "a straight path does not determine the rotation about itself: align in the plane or by the first pose"
        )
    return Rotation.align_vectors(b, a)[0]


def _picked(path: Trajectory, index: Index) -> Trajectory:
    return Trajectory(path.poses[index], path.time_s[index])


def _nearest(among: Array, wanted: Array) -> Index:
    """Return the index of the nearest of rising values for each wanted one."""
    after = np.clip(np.searchsorted(among, wanted), 1, max(len(among) - 1, 1))
    after = np.minimum(after, len(among) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(wanted - among[before] <= among[after] - wanted, before, after)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
