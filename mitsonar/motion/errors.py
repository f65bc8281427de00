"""Compute the errors of estimated motions and paths, with units and confidence intervals, as all tables print them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError
from mitsonar.motion.pose import poses_from, vehicle_rotation
from mitsonar.motion.trajectory import Trajectory

__all__ = [
    "AXES",
    "Alignment",
    "Axis",
    "DeltaUnit",
    "MotionErrors",
    "PathErrors",
    "SegmentDrift",
    "absolute_errors",
    "aligned",
    "assess",
    "associated",
    "cluster_resamples",
    "distance_driven",
    "in_units",
    "motion_errors",
    "path_length",
    "relative_errors",
    "segment_drift",
]


Array = NDArray[np.float64]


class Axis(NamedTuple):
    """One component of a motion: its name, its printed unit, and the factor from m or rad to that unit."""

    name: str
    unit: str
    scale: float


AXES = (Axis("sideways", "mm", 1e3), Axis("forward", "mm", 1e3), Axis("yaw", "deg", 180 / np.pi))
"""Components of a motion, always in this order."""

LARGE = 0.5
"""Fraction of the largest motion beyond which errors are also reported separately.

Methods that learned the usual size of motions are worse there.
"""


def in_units(motions: ArrayLike) -> Array:
    """Convert motions ``(..., 3)`` from m, m, rad to mm, mm, deg."""
    scaled: Array = np.asarray(motions, dtype=float) * np.array([axis.scale for axis in AXES])
    return scaled


@dataclass(frozen=True)
class MotionErrors:
    """Errors of estimated motions, each ``(3,)``: sideways [mm], forward [mm], yaw [deg].

    Attributes:
        pairs: number of motions.
        failures: number of rejected estimates, which count as zero motion.
        rmse: root mean square error.
        rmse_low: lower limit of its 95 % interval (clustered bootstrap), if resamples were given.
        rmse_high: upper limit of that interval.
        median: median absolute error.
        p95: 95th percentile of the absolute errors.
        bias: mean error.
        slope: slope of the estimates over the true motions, by least squares through the origin. 1 is unbiased; below 1 the
            estimates are too small.
        large: RMSE of motions beyond half the largest, per component.
        zero: RMSE of estimating zero for every motion.
        skill: 1 - rmse / zero.
        believed: RMSE of the valid estimates only.
        nees: normalised estimation error squared, divided by three (1: consistent); nan without covariances.
    """

    pairs: int
    failures: int
    rmse: Array
    rmse_low: Array
    rmse_high: Array
    median: Array
    p95: Array
    bias: Array
    slope: Array
    large: Array
    zero: Array
    skill: Array
    believed: Array
    nees: float


def motion_errors(
    estimated: Array,
    true: Array,
    valid: NDArray[np.bool_],
    covariances: Array | None = None,
    resamples: NDArray[np.int64] | None = None,
) -> MotionErrors:
    """Compute the errors of estimated motions against the true ones, counting rejected estimates as zero motion.

    Args:
        estimated: estimated sideways, forward [m], yaw [rad] ``(n, 3)``.
        true: true motions, of the same shape.
        valid: False for estimates that the method rejected ``(n,)``.
        covariances: covariances of the estimates ``(n, 3, 3)``, nan where unknown.
        resamples: see :func:`cluster_resamples`.

    Raises:
        MitsonarError: inconsistent shapes, or no motions.
    """
    if not len(true) or estimated.shape != true.shape or valid.shape != (len(true),):
        raise MitsonarError(
            "errors need equal numbers of estimated and true motions, at least one: got "
            f"{estimated.shape}, {true.shape}, {valid.shape}"
        )
    estimate = in_units(np.where(valid[:, None], estimated, 0.0))
    truth = in_units(true)
    error = estimate - truth
    rmse, zero = _rms(error), _rms(truth)
    low = high = rmse
    if resamples is not None:  # 95 % interval of the root mean square
        low, high = np.percentile(np.sqrt((error**2)[resamples].mean(axis=1)), [2.5, 97.5], axis=0)
    size = np.abs(truth)
    large = np.where(size > LARGE * size.max(axis=0), error, np.nan)
    power = (truth**2).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        slope, skill = (estimate * truth).sum(axis=0) / power, 1 - rmse / zero
    return MotionErrors(
        pairs=len(true),
        failures=int((~valid).sum()),
        rmse=rmse,
        rmse_low=low,
        rmse_high=high,
        median=np.median(np.abs(error), axis=0),
        p95=np.percentile(np.abs(error), 95, axis=0),
        bias=error.mean(axis=0),
        slope=slope,
        large=_rms_of_known(large),
        zero=zero,
        skill=skill,
        believed=_rms(error[valid]) if valid.any() else np.full(3, np.nan),
        nees=_nees(estimated - true, covariances, valid),
    )


def cluster_resamples(scene: ArrayLike, *, count: int = 1000, seed: int = 0) -> NDArray[np.int64]:
    """Draw bootstrap samples by scene, then by sequence.

    Each resample draws as many scenes as there are, with replacement, and as many sequences from each scene as it has. Since
    scenes differ in size, surplus draws are dropped and missing ones are drawn from the same scenes, so that each resample
    has n sequences.

    With few scenes the intervals are too narrow. In a simulation with scenes that differed by a factor of 1.8, they
    contained the true RMSE in 73 % of cases with 5 scenes, 79 % with 10 and 88 % with 50.

    Args:
        scene: scene of each sequence ``(n,)``.
        count: number of resamples.
        seed: seed of the draws.

    Returns:
        Indices ``(count, n)`` into arrays with one pair per sequence.
    """
    names, group = np.unique(np.asarray(scene), return_inverse=True)
    total = len(group)
    order, size = np.argsort(group, kind="stable"), np.bincount(group)
    start = np.concatenate([[0], np.cumsum(size)[:-1]])
    rng = np.random.default_rng([seed, 7])
    table = np.empty((count, total), dtype=np.int64)
    for row in table:
        # Draw scenes, each repeated by its size, and fill up or cut to n.
        drawn = rng.integers(len(names), size=len(names))
        drawn_scene = np.repeat(drawn, size[drawn])
        drawn_scene = np.concatenate([drawn_scene, rng.choice(drawn_scene, size=max(0, total - len(drawn_scene)))])[:total]
        # Draw a sequence from each of these scenes.
        row[:] = order[start[drawn_scene] + (rng.random(total) * size[drawn_scene]).astype(np.int64)]
    return table


def _rms(error: Array) -> Array:
    """Return the root mean square over the first axis."""
    return np.asarray(np.sqrt((error**2).mean(axis=0)))


def _rms_of_known(error: Array) -> Array:
    """Return the root mean square of the values that are not nan; nan if there are none."""
    count = np.isfinite(error).sum(axis=0)
    return np.where(count > 0, np.sqrt(np.nansum(error**2, axis=0) / np.maximum(count, 1)), np.nan)


def _nees(error: Array, covariances: Array | None, valid: NDArray[np.bool_]) -> float:
    """Return a third of the mean normalised squared error of the valid estimates that have a covariance."""
    if covariances is None:
        return float("nan")
    known = valid & np.isfinite(covariances).all(axis=(1, 2))
    if not known.any():
        return float("nan")
    solved = (np.linalg.pinv(covariances[known], hermitian=True) @ error[known][..., None])[..., 0]
    return float((error[known] * solved).sum(axis=1).mean() / 3)


# ---------------- Errors of an estimated path
# Absolute and relative errors as `evo` defines them, and drift at the end.


Alignment = Literal["none", "first", "plane", "space"]
"""Alignment of an estimated path with the true one.

``none``: no alignment. ``first``: by the first pose. ``plane``: by the rotation about the vertical and the shift in the
plane that best fit all positions. ``space``: by the best-fitting rotation and shift in space (Umeyama, 1991, without scale).
"""

DeltaUnit = Literal["frames", "metres"]
Index = NDArray[np.intp]

SHORTEST_PATH_M = 1e-3
"""Shortest path for which drift per length is defined [m]."""


@dataclass(frozen=True)
class PathErrors:
    """Errors of an estimated path; angles are those of the rotation between the attitudes.

    Attributes:
        frames: number of poses compared.
        alignment: alignment of the paths for the absolute errors.
        path_m: length of the true path [m].
        estimated_path_m: length of the estimated path [m].
        absolute_rmse_m: absolute trajectory error, root mean square [m].
        absolute_max_m: largest absolute trajectory error [m].
        absolute_angle_rmse_rad: absolute attitude error, root mean square [rad].
        delta: length over which relative errors are computed.
        unit: unit of ``delta``: frames, or metres of the true path.
        pairs: number of relative errors.
        relative_rmse_m: relative pose error, translation [m].
        relative_angle_rmse_rad: relative pose error, rotation [rad].
        end_error_m: error of the last pose, with the first poses aligned [m].
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
        """Return the end error as a fraction of the path length (Almanza-Medina, 5.4.5); nan for a path below 1 mm."""
        return self.end_error_m / self.path_m if self.path_m > SHORTEST_PATH_M else np.nan

    @property
    def heading_drift_rad_per_m(self) -> float:
        """Return the heading error per metre of path [rad/m], clockwise positive; nan for a path below 1 mm."""
        return self.end_heading_rad / self.path_m if self.path_m > SHORTEST_PATH_M else np.nan

    def rows(self) -> list[tuple[str, float, str]]:
        """Return the name, value and unit of every error, as shown in console, log and README."""
        texts = {"none": "as they lie", "first": "first pose aligned", "plane": "aligned in the plane", "space": "aligned"}
        unit = {"frames": "frame", "metres": "m"}[self.unit] + ("s" if self.unit == "frames" and self.delta != 1 else "")
        span = f"over {self.delta:g} {unit}"
        return [
            ("poses compared", self.frames, ""),
            ("path length", self.path_m, "m"),
            ("estimated path length", self.estimated_path_m, "m"),
            (f"absolute error RMSE, {texts[self.alignment]}", 1e3 * self.absolute_rmse_m, "mm"),
            (f"absolute error maximum, {texts[self.alignment]}", 1e3 * self.absolute_max_m, "mm"),
            (
                f"absolute attitude error RMSE, {texts[self.alignment]}",
                float(np.degrees(self.absolute_angle_rmse_rad)),
                "deg",
            ),
            (f"relative error RMSE {span}", 1e3 * self.relative_rmse_m, "mm"),
            (f"relative attitude error RMSE {span}", float(np.degrees(self.relative_angle_rmse_rad)), "deg"),
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
        estimated: the estimated path.
        true: the true path. Its length includes all its poses between the first and the last compared.
        align: alignment of the paths for the absolute errors; drift is always computed from the first pose.
        delta: length over which relative errors are computed, in consecutive segments without overlap.
        unit: unit of ``delta``: frames, or metres of the true path.
        tolerance_s: largest time difference between compared poses [s].

    Raises:
        MitsonarError: fewer than two poses at equal times, a path too short for ``delta``, or one that cannot be aligned.
    """
    # 1. Match the poses by time.
    estimated_index, true_index = associated(estimated.time_s, true.time_s, tolerance_s)
    if estimated_index.size < 2:
        raise MitsonarError(
            f"a path's errors need two poses or more at equal times: got {estimated_index.size}; give longer paths"
        )
    true_path = Trajectory(true.poses[true_index[0] : true_index[-1] + 1], true.time_s[true_index[0] : true_index[-1] + 1])
    estimated, true = _select(estimated, estimated_index), _select(true, true_index)
    # 2. Compute the absolute, relative and end errors.
    absolute, angle = absolute_errors(estimated, true, align)
    relative, turn = relative_errors(estimated, true, delta, unit)
    end_errors, _ = absolute_errors(estimated, true, "first")
    heading_error = np.unwrap(estimated.poses[:, 5] - true.poses[:, 5])
    return PathErrors(
        frames=len(true),
        alignment=align,
        path_m=path_length(true_path),
        estimated_path_m=path_length(estimated),
        absolute_rmse_m=float(_rms(absolute)),
        absolute_max_m=float(absolute.max()),
        absolute_angle_rmse_rad=float(_rms(angle)),
        delta=delta,
        unit=unit,
        pairs=relative.size,
        relative_rmse_m=float(_rms(relative)),
        relative_angle_rmse_rad=float(_rms(turn)),
        end_error_m=float(end_errors[-1]),
        end_heading_rad=float(heading_error[-1] - heading_error[0]),
    )


def associated(estimated_s: Array, true_s: Array, tolerance_s: float = 0.01) -> tuple[Index, Index]:
    """Match poses by time: mutual nearest neighbours within the tolerance.

    Returns:
        Indices ``(matches,)`` into both paths.

    Raises:
        MitsonarError: times that do not increase, or no match within the tolerance.
    """
    for name, time in (("estimated", estimated_s), ("true", true_s)):
        if not (np.diff(time) > 0).all():
            raise MitsonarError(f"the times of the {name} path must increase: sort its poses")
    true_index = _nearest(true_s, estimated_s)
    estimated_index = np.arange(len(estimated_s))
    gap_s = np.abs(true_s[true_index] - estimated_s)
    # times read from files may differ in the last digit
    matched = (_nearest(estimated_s, true_s)[true_index] == estimated_index) & (gap_s <= tolerance_s + 1e-9)
    if not matched.any():
        raise MitsonarError(
            f"no pose of the estimated path ({estimated_s[0]:g}..{estimated_s[-1]:g} s) is within {tolerance_s:g} s of one "
            f"of the true path ({true_s[0]:g}..{true_s[-1]:g} s): the nearest is {gap_s.min():.3g} s away; give paths of "
            "the same run, or a larger tolerance_s"
        )
    return estimated_index[matched], true_index[matched]


def path_length(path: Trajectory) -> float:
    """Compute the length of a path as the sum of distances between poses [m]."""
    return float(distance_driven(path)[-1])


def distance_driven(path: Trajectory) -> Array:
    """Compute the distance travelled up to each pose ``(frames,)`` [m]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path.poses[:, :3], axis=0), axis=1))])


def aligned(estimated: Trajectory, true: Trajectory, align: Alignment) -> Trajectory:
    """Align an estimated path with the true one, which has the same frames.

    Raises:
        MitsonarError: different numbers of poses, an unknown alignment, or positions that do not determine the rotation.
    """
    if len(estimated) != len(true):
        raise MitsonarError(
            f"the paths must have equal numbers of poses: got {len(estimated)} and {len(true)}; associate them"
        )
    estimated_position, true_position = estimated.poses[:, :3], true.poses[:, :3]
    if align == "none":
        return estimated
    if align == "first":
        rotation = vehicle_rotation(true.poses[0]) * vehicle_rotation(estimated.poses[0]).inv()
        shift = true_position[0] - rotation.apply(estimated_position[0])[0]
    elif align == "plane":
        rotation = _rotation_in_plane(estimated_position, true_position)
        shift = (true_position - rotation.apply(estimated_position)).mean(axis=0) * [1, 1, 0]
    elif align == "space":
        rotation = _rotation_in_space(estimated_position, true_position)
        shift = (true_position - rotation.apply(estimated_position)).mean(axis=0)
    else:
        raise MitsonarError(f"align must be one of {', '.join(get_args(Alignment))}: got {align!r}")
    return Trajectory(
        poses_from(rotation.apply(estimated_position) + shift, rotation * vehicle_rotation(estimated.poses)),
        estimated.time_s,
    )


def absolute_errors(estimated: Trajectory, true: Trajectory, align: Alignment = "first") -> tuple[Array, Array]:
    """Compute the distance [m] and angle [rad] between the poses ``(frames,)`` of two paths after alignment."""
    fitted = aligned(estimated, true, align)
    angle = (vehicle_rotation(true.poses).inv() * vehicle_rotation(fitted.poses)).magnitude()
    return np.linalg.norm(fitted.poses[:, :3] - true.poses[:, :3], axis=1), np.asarray(angle)


def relative_errors(
    estimated: Trajectory, true: Trajectory, delta: float = 1, unit: DeltaUnit = "frames", *, overlapping: bool = False
) -> tuple[Array, Array]:
    """Compute the errors of motions over ``delta`` frames, or over ``delta`` metres of the true path.

    Args:
        estimated: the estimated path.
        true: the true path, with the same frames.
        delta: length of each motion.
        unit: unit of ``delta``: frames or metres.
        overlapping: whether a motion starts at every frame, or only where the previous one ends.

    Returns:
        Distance [m] and angle [rad] ``(pairs,)``.

    Raises:
        MitsonarError: different numbers of poses, or a path shorter than ``delta``.
    """
    if len(estimated) != len(true):
        raise MitsonarError(
            f"the paths must have equal numbers of poses: got {len(estimated)} and {len(true)}; associate them"
        )
    first, second = _pairs(true, delta, unit, overlapping)
    true_step, true_turn = _relative_poses(true, first, second)
    estimated_step, estimated_turn = _relative_poses(estimated, first, second)
    return np.linalg.norm(estimated_step - true_step, axis=1), np.asarray((true_turn.inv() * estimated_turn).magnitude())


def _pairs(true: Trajectory, delta: float, unit: DeltaUnit, overlapping: bool) -> tuple[Index, Index]:
    """Return the first and second frame of each relative error."""
    index = np.arange(len(true))
    if unit == "frames" and delta >= 1 and float(delta).is_integer():
        ends = index + int(delta)
    elif unit == "metres" and delta > 0:
        driven = distance_driven(true)
        ends = np.searchsorted(driven, driven + delta * (1 - 1e-9))  # rounding must not add a step where all are equal
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


def _relative_poses(path: Trajectory, first: Index, second: Index) -> tuple[Array, Rotation]:
    """Return positions ``(pairs, 3)`` and attitudes of the second poses, in the axes of the first."""
    rotation = vehicle_rotation(path.poses)
    to_first = rotation[first].inv()
    return to_first.apply(path.poses[second, :3] - path.poses[first, :3]), to_first * rotation[second]


def _rotation_in_plane(estimated: Array, true: Array) -> Rotation:
    a, b = (points[:, :2] - points[:, :2].mean(axis=0) for points in (estimated, true))
    along, across = float((a * b).sum()), float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    if np.hypot(along, across) <= 1e-12 * np.linalg.norm(a) * np.linalg.norm(b) or not (a.any() and b.any()):
        raise MitsonarError("a path without motion cannot be aligned by its positions: align by the first pose")
    return Rotation.from_euler("z", np.arctan2(across, along))


def _rotation_in_space(estimated: Array, true: Array) -> Rotation:
    a, b = (points - points.mean(axis=0) for points in (estimated, true))
    spread = np.linalg.svd(b.T @ a, compute_uv=False)
    if spread[1] <= 1e-9 * spread[0]:
        raise MitsonarError(
            "a straight path does not determine the rotation about itself: align in the plane or by the first pose"
        )
    return Rotation.align_vectors(b, a)[0]


def _select(path: Trajectory, index: Index) -> Trajectory:
    return Trajectory(path.poses[index], path.time_s[index])


def _nearest(values: Array, queries: Array) -> Index:
    """Return the index of the nearest of increasing ``values`` for each query."""
    after = np.clip(np.searchsorted(values, queries), 1, max(len(values) - 1, 1))
    after = np.minimum(after, len(values) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(queries - values[before] <= values[after] - queries, before, after)


# ---------------- Drift over segments (KITTI)


@dataclass(frozen=True)
class SegmentDrift:
    """Errors over segments of a path, as in the KITTI odometry benchmark (Geiger et al., 2012).

    Segments of given lengths start at every frame (KITTI: at every tenth). The error of a segment is that of the estimated
    motion between its ends: its distance over the length, and its angle over the length. The drift is the mean over all
    segments of all lengths. KITTI uses lengths of 100 to 800 m; sonar paths are shorter.

    Attributes:
        lengths_m: lengths that fit into the path [m].
        length_m: length of each segment ``(n,)`` [m].
        translation: translation error of each segment, as a fraction of its length ``(n,)``.
        rotation_rad_per_m: angle between the attitudes over the length ``(n,)`` [rad/m].
        start_m: distance travelled before the start of each segment ``(n,)`` [m].
    """

    lengths_m: tuple[float, ...]
    length_m: Array
    translation: Array
    rotation_rad_per_m: Array
    start_m: Array

    @property
    def percent(self) -> float:
        """Return the mean translation error in percent of the segment length."""
        return 100 * float(self.translation.mean())

    @property
    def deg_per_100m(self) -> float:
        """Return the mean rotation error in deg per 100 m."""
        return 100 * float(np.degrees(self.rotation_rad_per_m.mean()))

    @property
    def blocks(self) -> NDArray[np.int64]:
        """Return the block of each segment ``(n,)``; a block holds the segments that start within one shortest length."""
        return np.asarray((self.start_m + 1e-9) // min(self.lengths_m), dtype=np.int64)

    def intervals(self, *, seed: int = 0) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return 95 % intervals of percent and of deg per 100 m, by a bootstrap over blocks of the path.

        Segments overlap and are not independent; blocks nearly are. With fewer than ten blocks the intervals are too narrow,
        see :func:`mitsonar.motion.errors.cluster_resamples`.
        """
        drawn = cluster_resamples(self.blocks, seed=seed)
        tables = 100 * self.translation, 100 * np.degrees(self.rotation_rad_per_m)
        ends = [np.percentile(table[drawn].mean(axis=1), [2.5, 97.5]) for table in tables]
        return (float(ends[0][0]), float(ends[0][1])), (float(ends[1][0]), float(ends[1][1]))


def segment_drift(estimated: Trajectory, true: Trajectory, lengths_m: Sequence[float]) -> SegmentDrift | None:
    """Compute the errors of all segments, one of which starts at every frame.

    Args:
        estimated: the estimated path.
        true: the true path, with the same frames.
        lengths_m: lengths of the segments along the true path [m]. Lengths beyond that of the path are ignored.

    Returns:
        The errors; None if no length fits into the path.

    Raises:
        MitsonarError: different numbers of poses, or a length that is not positive.
    """
    if not lengths_m or min(lengths_m) <= 0:
        raise MitsonarError(f"lengths of segments must be above 0 m: got {list(lengths_m)}")
    driven = distance_driven(true)
    fitting = tuple(length for length in lengths_m if driven[-1] >= length * (1 - 1e-9))
    if not fitting:
        return None
    parts = []
    for length in fitting:
        distance, angle = relative_errors(estimated, true, length, "metres", overlapping=True)
        parts.append([np.full(len(distance), length), distance / length, angle / length, driven[: len(distance)]])
    length_m, translation, rotation, start = (np.concatenate(column) for column in zip(*parts, strict=True))
    return SegmentDrift(fitting, length_m, translation, rotation, start)
