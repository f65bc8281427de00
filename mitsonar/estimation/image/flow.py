"""How the estimator ``flow`` finds a motion from dense optical flow.

It is the deterministic method of Almanza-Medina's comparisons, after Henson and Zakharov ("Attitude-trajectory estimation
for forward-looking multibeam sonar based on acoustic image registration", IEEE Journal of Oceanic Engineering, 2019;
Almanza-Medina, 1.2.3, 2.3, 3.4.8).

1. Dense optical flow between the frames, in native (range, bearing), gives a displacement map.
2. The best match among the displacement maps of modelled sensor motions gives sideways, forward and yaw.
3. A weighted regularised spline joins the motions of a run: :mod:`mitsonar.mapping.series`.

Almanza-Medina gives no further details. This implementation makes the following choices:

- The flow is that of Lucas and Kanade: least squares of brightness within windows, with the slopes of both frames' mean.
  Each window gives its information about each direction, which weights the match. Flow without such information
  (Farnebäck's, DIS) gave larger errors.
- It runs coarse to fine, in several rounds per level: the flow starts from the displacement map of the current motion.
- The modelled map is exact: cells are points of level ground, moved and observed again. "Among a set of motions" is
  Gauss-Newton on this map with robust weights, which finds the best of an infinitely fine set.
- ``match="vector"`` is the paper's shortcut: a displacement map is described by a small vector "derived from the
  displacement distribution". The paper does not specify it. Here it is the mean displacements in range and in bearing
  and the slope of the displacement in range over bearing, without weights.
- The height over the visible surface comes from the first echoes, or from the frames. It is known only to ``height_std``
  and is a fourth unknown of the match: rocks rise above the ground to which the height is measured. Heave, pitch and roll
  that no sensor measures are further unknowns, of the size that is usual on a calm day.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import INPUTS, Estimate, two_frames
from mitsonar.geometry.ground import GroundGeometry, attitude_of, lean_derivative, moved
from mitsonar.instruments.sonar import Bearing
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.frames import SonarFrames

__all__ = [
    "STILL",
    "TINY",
    "Flow",
    "FlowLevel",
    "WindowFlow",
    "WindowGrid",
    "in_blocks",
    "match_map",
    "match_vector",
    "window_grid",
]


# ---------------- Windows of a level, and their modelled displacements


Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


class FlowLevel(NamedTuple):
    """One level of the pyramid.

    Attributes:
        step: stride in bins.
        bins: standard deviation of the smoothing over bins.
        beams: standard deviation of the smoothing over beams.
        window: size of the windows [bins, beams].
        rounds: largest number of rounds of flow and match.
    """

    step: int
    bins: float
    beams: float
    window: tuple[int, int]
    rounds: int


HEIGHT_STEP = 0.02
"""Step in height for the numerical derivative of the map, as a fraction of the height."""


@dataclass(frozen=True)
class WindowGrid:
    """The cells of a level's frames on the ground, and the windows over them.

    Attributes:
        ground: geometry of the first frame.
        other: geometry of the second frame.
        level: of the windows.
    """

    ground: GroundGeometry
    other: GroundGeometry
    level: FlowLevel

    @cached_property
    def cells(self) -> Floats:
        """Ground points of all cells ``(bins, beams, 2)``."""
        return self.ground.points.astype(np.float32)

    @cached_property
    def window(self) -> tuple[int, int]:
        """Size of the windows in rows and columns of this level."""
        bins, beams = self.level.window
        return max(3, bins // self.level.step), beams

    @cached_property
    def centres(self) -> tuple[slice, slice]:
        """The cells at the centres of the windows, which overlap by half."""
        rows, columns = (max(1, size // 2) for size in self.window)
        return slice(rows // 2, None, rows), slice(columns // 2, None, columns)

    @cached_property
    def home(self) -> Doubles:
        """Range [m] and bearing [rad] of the windows' centres ``(n, m, 2)``."""
        return np.stack(np.meshgrid(self.ground.range_m, self.ground.bearing_rad, indexing="ij"), axis=-1)[self.centres]

    @cached_property
    def spacing(self) -> Doubles:
        """Metres per row and radians per column at the centres ``(n, m, 2)``."""
        steps = [np.gradient(axis) for axis in (self.ground.range_m, self.ground.bearing_rad)]
        return np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1)[self.centres]

    @cached_property
    def points(self) -> Doubles:
        """Ground points of the centres ``(n, m, 2)``."""
        return self.ground.points[self.centres]

    @cached_property
    def derivative(self) -> Doubles:
        """Derivative of the centres' displacement by the motion ``(n, m, 2, 3)``; zero where they show no ground."""
        return np.nan_to_num(self.ground.derivative[self.centres])

    @cached_property
    def _higher(self) -> tuple[GroundGeometry, GroundGeometry]:
        """Geometry of both frames with the sonar raised by :data:`HEIGHT_STEP` times the height of the first."""
        ground, second = (
            replace(one, height_m=one.height_m + HEIGHT_STEP * self.ground.height_m) for one in self._both_grounds
        )
        return ground, second

    @property
    def _both_grounds(self) -> tuple[GroundGeometry, GroundGeometry]:
        return self.ground, self.other

    @cached_property
    def _higher_points(self) -> Doubles:
        """Ground points of the centres, seen from the raised sonar ``(n, m, 2)``."""
        return self._higher[0].points[self.centres]

    def map(self, v: Doubles) -> Doubles:
        """Return the modelled displacement map of a motion [m, rad] ``(n, m, 2)``; zero where no ground is shown."""
        return np.nan_to_num(np.stack(self.other.to_polar(moved(self.points, v)), axis=-1) - self.home)

    def by_height(self, v: Doubles) -> Doubles:
        """Return the derivative of the map by the relative height ``(n, m, 2, 1)``."""
        map_there = np.stack(self._higher[1].to_polar(moved(self._higher_points, v)), axis=-1) - self.home
        return (np.nan_to_num(map_there - self.map(v)) / HEIGHT_STEP)[..., None]

    def by_unsure(self, v: Doubles) -> Doubles:
        """Return the derivative of the map by the relative height and by height and attitude of both frames.

        ``(n, m, 2, 6)``, see :func:`~mitsonar.geometry.ground.lean_derivative`.
        """
        rows, columns = self.centres
        first, second = (
            replace(one, range_m=one.range_m[rows], bearing_rad=one.bearing_rad[columns]) for one in self._both_grounds
        )
        by_lean = np.moveaxis(np.nan_to_num(lean_derivative(first, second, v)), (1, 0), (2, 3))
        return np.concatenate([self.by_height(v), by_lean], axis=-1)


@lru_cache(maxsize=16)
def window_grid(
    range_m: tuple[float, ...],
    bearing_rad: tuple[float, ...],
    bearing: Bearing,
    first: tuple[float, float, float],
    second: tuple[float, float, float],
    level: FlowLevel,
) -> WindowGrid:
    """Return the windows of a level over level ground, given height [m], pitch and roll [rad] of each frame."""
    ranges = np.array(range_m)[level.step // 2 :: level.step]
    ground, other = (GroundGeometry(ranges, np.array(bearing_rad), bearing, *pose) for pose in (first, second))
    return WindowGrid(ground, other, level)


# ---------------- Flow and estimator


LEVELS = (
    FlowLevel(8, 16.0, 3.0, (136, 33), 6),
    FlowLevel(4, 6.0, 1.5, (68, 17), 6),
    FlowLevel(1, 1.0, 0.6, (33, 9), 25),
)

LONGEST_STEP = np.array([0.06, 0.06, np.radians(1.2)])
"""Largest change in one round [m, m, rad]: wrong flow can be wrong without limit."""

STRUCTURE_FLOOR, RESIDUAL_FLOOR = 1e-3, 0.1
"""Fractions of the mean structure and of the mean residual that are added to those of each window."""

LEAST_CORRELATION = 0.25
FEWEST_BLOCKS = 4.0
MOST_UNSEEN = 0.5
MODEL = 1.6
"""Squared errors over the covariance of the match, measured on dives of six sonars over rocky fields: 0.9 to 3.2."""

LARGEST_STD = np.array([0.02, 0.02, np.radians(0.5)])
"""Limits of a valid estimate: correlation within windows of the registered frames; blocks that hold the structure; the
fraction of the structure that lies twice as far from the axis in elevation as the field of view; standard deviations
[m, m, rad]."""


class _Fit(NamedTuple):
    """Motion, covariance, correlation of the matched frames, structure in each window, and whether the rounds settled."""

    motion: Doubles
    covariance: Doubles | None
    correlation: float
    structure: Doubles
    converged: bool


@dataclass(frozen=True)
class Flow:
    """Registration by optical flow, with the exact geometry of the sonar over level ground.

    Args:
        height_m: height over the ground, used where the window shows no first echoes; default: that of the frames.
        pitch_rad: default: that of the frames.
        relief_m: mean height of the visible surface over the ground; default: from the first echoes, where the window
            shows them.
        match: ``map``, which weights each window by its information; or ``vector``, three means and slopes of all windows.
        height_std: relative standard deviation of the height over the visible surface; 0: known exactly; default: from
            :func:`~mitsonar.geometry.ground.attitude_of`. Only for ``map``.
        levels: pyramid levels, coarse to fine.

    Raises:
        MitsonarError: unknown match, a height not above 0, or a height_std below 0.
    """

    height_m: float | None = None
    pitch_rad: float | None = None
    relief_m: float | None = None
    match: Literal["map", "vector"] = "map"
    height_std: float | None = None
    levels: tuple[FlowLevel, ...] = LEVELS

    consumes = SonarFrames
    inputs = INPUTS
    digest = ""

    def __post_init__(self) -> None:
        if self.match not in ("map", "vector"):
            raise MitsonarError(f"match must be map or vector: got {self.match!r}")
        if self.height_m is not None and not self.height_m > 0:
            raise MitsonarError(f"the height must be above 0: got {self.height_m:g} m; give that over the ground")
        if self.height_std is not None and not self.height_std >= 0:
            raise MitsonarError(f"height_std must be 0 or more, a part of the height: got {self.height_std:g}")

    def estimate(self, frames: SonarFrames, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion and its covariance; reject frames that hold nothing to match. A prior is ignored.

        Raises:
            MitsonarError: invalid frames, see :func:`mitsonar.estimation.estimator.two_frames`, or no height or pitch.
        """
        first, second = two_frames(frames)
        attitude = attitude_of(frames, "flow", self.height_m, self.pitch_rad, self.relief_m)
        height_std = attitude.height_std_m / attitude.height_m if self.height_std is None else self.height_std
        unsure = np.array([height_std, *attitude.lean_std])
        axes = tuple(frames.range_m.tolist()), tuple(frames.bearing_rad.tolist())
        v = np.zeros(3)
        fit = None
        for level in self.levels:
            grid = window_grid(*axes, frames.sonar.bearing, attitude.of_frame(0), attitude.of_frame(1), level)
            fit = self._register(_smoothed(first, level), _smoothed(second, level), grid, v, unsure)
            if fit is None:
                return Estimate(Motion(0.0, 0.0, 0.0), None, False, "nothing in the frames to match")
            v = fit.motion
        assert fit is not None
        unseen = _unseen(grid, fit.structure, frames.sonar.elevation_fov_deg)
        blocks = _blocks(fit.structure)
        reason = attitude.reason or _rejection(fit, blocks, unseen)
        about = {"correlation": float(fit.correlation), "blocks": blocks, "unseen": unseen, **attitude.about}
        covariance = None if fit.covariance is None else MODEL * fit.covariance
        if covariance is not None and self.match == "vector":
            covariance = attitude.widened(covariance, frames)
        return Estimate(Motion(*(float(x) for x in v)), covariance, not reason, reason, about)

    def _register(self, first: Floats, second: Floats, grid: WindowGrid, start: Doubles, unsure: Doubles) -> _Fit | None:
        """Run rounds of flow and match from a start; return None if there is nothing to match.

        ``unsure``: standard deviations of the relative height and of :attr:`Attitude.lean_std` ``(6,)``.
        """
        v, converged = start, False
        by_unsure = Unsure(grid.by_unsure(v)[..., unsure > 0], unsure[unsure > 0])
        for _ in range(grid.level.rounds):
            warped, inside = _warped(second, grid, v)
            flow = _flow(first, warped, inside, grid)
            match = match_map(grid, flow, v, by_unsure) if self.match == "map" else match_vector(grid, flow, v)
            if match is None:
                return None
            step = match.motion - v
            step *= min(1.0, float((LONGEST_STEP / np.maximum(np.abs(step), 1e-12)).min()))
            v = v + step
            converged = bool((np.abs(step) < STILL).all())
            if converged:
                break
        assert match is not None
        correlation = _correlation(first, warped, inside, grid)
        return _Fit(v, match.covariance, correlation, _structure(flow, grid), converged)


def _smoothed(image: Floats, level: FlowLevel) -> Floats:
    """Smooth an image and keep every ``step``-th bin of the level."""
    smooth = cv2.GaussianBlur(image, (0, 0), sigmaX=level.beams, sigmaY=level.bins)
    return np.ascontiguousarray(smooth[level.step // 2 :: level.step])


def _warped(second: Floats, grid: WindowGrid, v: Doubles) -> tuple[Floats, Floats]:
    """Resample the second frame at the cells of the first; return it, and 1 where known, else 0 ``(bins, beams)``."""
    radius, bearing = grid.other.to_polar(moved(grid.cells, v))
    row, column = _place(radius, grid.ground.range_m), _place(bearing, grid.ground.bearing_rad)
    bins, beams = second.shape
    inside = (row >= 0) & (row <= bins - 1) & (column >= 0) & (column <= beams - 1)  # False for nan
    safe_column, safe_row = (np.where(inside, place, np.float32(0)) for place in (column, row))
    warped = cv2.remap(second, safe_column, safe_row, cv2.INTER_LINEAR)
    return np.asarray(warped, dtype=np.float32), inside.astype(np.float32)


def _place(value: Floats, axis: Doubles) -> Floats:
    """Return the fractional index of values on an increasing axis; -1 or its length beyond the ends."""
    step = (axis[-1] - axis[0]) / (len(axis) - 1)
    if np.allclose(np.diff(axis), step, rtol=1e-6, atol=0):
        return np.asarray((value - np.float32(axis[0])) * np.float32(1 / step), dtype=np.float32)
    return np.interp(value, axis, np.arange(len(axis)), left=-1, right=len(axis)).astype(np.float32)


def _flow(first: Floats, warped: Floats, inside: Floats, grid: WindowGrid) -> WindowFlow:
    """Compute the step of Lucas and Kanade in each window."""
    # slopes of the mean of both frames, and sums of their products over each window
    (by_row, by_column), (row_there, column_there) = (_slopes(image, inside) for image in (first, warped))
    row, column = (by_row + row_there) / 2, (by_column + column_there) / 2
    change = (first - warped) * inside
    rows, cross, columns, right_row, right_column, noise = (
        _in_windows(product, grid)
        for product in (row * row, row * column, column * column, row * change, column * change, change * change)
    )
    # regularise faint windows, then solve for the displacement in cells
    faint = STRUCTURE_FLOOR * (rows + columns).mean() + TINY
    known = grid.derivative.any(axis=(2, 3)) & (rows + columns > faint)
    tensor = _symmetric(rows + faint, cross, columns + faint)
    cells = np.linalg.solve(tensor, np.stack([right_row, right_column], axis=-1)[..., None])[..., 0]
    # information free of noise: slopes of one frame times slopes of the other
    shared = _symmetric(
        *(
            _in_windows(product, grid)
            for product in (
                by_row * row_there,
                (by_row * column_there + by_column * row_there) / 2,
                by_column * column_there,
            )
        )
    )
    # normalise by the residual of each window, and convert cells to metres and radians
    per = known / (noise + RESIDUAL_FLOOR * noise.mean() + TINY)
    scale = per[..., None, None] / (grid.spacing[..., :, None] * grid.spacing[..., None, :])
    return WindowFlow(cells * grid.spacing, _symmetric(rows, cross, columns) * scale, shared * scale)


def _slopes(image: Floats, inside: Floats) -> tuple[Floats, Floats]:
    """Return central differences over rows and over columns, zero where the image is unknown."""
    difference = np.array([[-0.5, 0, 0.5]], dtype=np.float32)
    by_row, by_column = (np.asarray(cv2.filter2D(image, -1, kernel), np.float32) for kernel in (difference.T, difference))
    return by_row * inside, by_column * inside


def _in_windows(values: NDArray[np.floating], grid: WindowGrid) -> Doubles:
    """Sum over the windows ``(n, m)``."""
    sums = cv2.boxFilter(values, -1, grid.window[::-1], normalize=False, borderType=cv2.BORDER_CONSTANT)
    return sums[grid.centres].astype(np.float64)


def _symmetric(one: Doubles, cross: Doubles, other: Doubles) -> Doubles:
    """Return symmetric matrices ``(..., 2, 2)`` from their elements."""
    return np.stack([np.stack([one, cross], axis=-1), np.stack([cross, other], axis=-1)], axis=-2)


def _correlation(first: Floats, warped: Floats, inside: Floats, grid: WindowGrid) -> float:
    """Return the correlation of the matched frames within windows; shading common to the whole images does not count."""
    first_inside, warped_inside = first * inside, warped * inside
    count = np.maximum(_in_windows(inside, grid), 1)
    mean, mean_there = _in_windows(first_inside, grid), _in_windows(warped_inside, grid)
    covariance = (_in_windows(first_inside * warped_inside, grid) - mean * mean_there / count).sum()
    variance = (_in_windows(first_inside * first_inside, grid) - mean**2 / count).sum()
    variance_there = (_in_windows(warped_inside * warped_inside, grid) - mean_there**2 / count).sum()
    product = float(variance * variance_there)
    return float(covariance) / np.sqrt(product) if product > TINY else 0.0


def _structure(flow: WindowFlow, grid: WindowGrid) -> Doubles:
    """Return the information of each window about displacements, in cells, where both frames agree ``(n, m)``."""
    return np.asarray(np.maximum((np.diagonal(flow.shared, axis1=2, axis2=3) * grid.spacing**2).sum(axis=-1), 0))


def _blocks(structure: Doubles) -> float:
    """Return the effective number of blocks that hold the structure: all if equal, one if one holds everything."""
    each = in_blocks(structure)
    return float(each.sum() ** 2 / max(float((each**2).sum()), TINY))


def _unseen(grid: WindowGrid, structure: Doubles, elevation_fov_deg: float) -> float:
    """Return the fraction of the structure whose elevation is more than twice that of the field of view."""
    drop = np.full((*grid.points.shape[:2], 1), -grid.ground.height_m)
    up = np.concatenate([grid.points, drop], axis=-1) @ grid.ground.turn[:, 2]
    far = np.abs(up) > grid.home[..., 0] * np.sin(np.radians(min(elevation_fov_deg, 90.0)))
    return float(structure[far].sum() / max(float(structure.sum()), TINY))


def _rejection(fit: _Fit, blocks: float, unseen: float) -> str:
    """Return why an estimate is rejected; empty if it is valid."""
    if fit.covariance is None:
        return "no motion matches better than those around it"
    std = np.sqrt(np.diag(fit.covariance))
    if not fit.converged:
        return "the rounds of flow and match did not settle"
    if fit.correlation < LEAST_CORRELATION:
        return f"the matched frames correlate by {fit.correlation:.2f} only"
    if blocks < FEWEST_BLOCKS:
        return "the visible structure fills too small a part of the frames"
    if unseen > MOST_UNSEEN:
        return "height and pitch place the ground outside the field of view"
    if (std > LARGEST_STD).any():
        return f"standard deviations of {1e3 * std[0]:.1f}, {1e3 * std[1]:.1f} mm, {np.degrees(std[2]):.2f} deg"
    return ""


# ---------------- Match with the modelled displacement maps


TINY = 1e-20
"""Keeps divisions by zero finite."""

STILL = np.array([1e-4, 1e-4, 3e-5])
"""Steps below which a level ends [m, m, rad]."""

CAUCHY = 8.0
"""Windows whose squared misfit is this many times the usual have half the weight."""

COMPARABLE_MOTION = np.array([0.01, 0.01, 0.003])
"""Motions of comparable effect [m, m, rad]."""

BLOCK = 4
"""Edge of the blocks of windows that count once: windows that overlap or show the same rock have correlated errors."""


class WindowFlow(NamedTuple):
    """Optical flow in each window.

    Attributes:
        displacement: remaining displacement [m, rad] ``(n, m, 2)``.
        information: of the displacement ``(n, m, 2, 2)``.
        shared: the same without the contribution of noise to the slopes ``(n, m, 2, 2)``.
    """

    displacement: Doubles
    information: Doubles
    shared: Doubles


class MapMatch(NamedTuple):
    """A motion and its covariance; the covariance is None where the match is not a maximum."""

    motion: Doubles
    covariance: Doubles | None


class Unsure(NamedTuple):
    """What is known of height and attitude up to an error.

    Attributes:
        derivative: of the map by each ``(n, m, 2, unsure)``.
        std: standard deviation of each error ``(unsure,)``.
    """

    derivative: Doubles
    std: Doubles


def match_map(grid: WindowGrid, flow: WindowFlow, v: Doubles, unsure: Unsure) -> MapMatch | None:
    """Fit the exact map of a motion to the displacement map by robust weighted least squares; return None if singular.

    The unknowns are the motion and the errors of height and attitude, with a prior.
    """
    measured = grid.map(v) + flow.displacement
    unknowns = np.concatenate([grid.derivative, unsure.derivative], axis=-1)
    used = flow.information.any(axis=(2, 3))
    if used.sum() < BLOCK * BLOCK:
        return None
    p = np.append(v, np.zeros(len(unsure.std)))
    prior, std = np.zeros(len(p)), np.append(np.zeros(3), unsure.std)
    for _ in range(10):
        # misfit of the windows, and its usual square
        misfit = measured - grid.map(p[:3]) - (unknowns[..., 3:] @ p[3:])
        gradient = (flow.information @ misfit[..., None])[..., 0]
        squared = np.maximum((misfit * gradient).sum(axis=-1), 0)
        usual_square = float(np.median(squared[used])) / 1.39 + TINY  # the median of chi-square with 2 degrees of freedom
        # the prior of height and attitude in units of the misfit; robust weights of the windows
        prior[3:] = usual_square * BLOCK**2 / unsure.std**2
        weight = 1 / (1 + squared / (CAUCHY * usual_square))
        # Gauss-Newton step
        scores = _apply(unknowns, gradient) * weight[..., None]
        normal = _normal(unknowns, flow.information * weight[..., None, None]).sum(axis=(0, 1)) + np.diag(prior)
        if not _regular(normal):
            return None
        step = np.linalg.solve(normal, scores.sum(axis=(0, 1)) - prior * p)
        p = p + step
        if (np.abs(step[:3]) < STILL / 10).all():
            break
    # robust scores rise by the squared weight over both directions; only the shared slopes are free of either frame's noise
    normals = _normal(unknowns, flow.shared * (weight * weight)[..., None, None])
    if not _regular(normals.sum(axis=(0, 1)) + np.diag(prior)):
        return MapMatch(p[:3], None)
    return MapMatch(p[:3], _covariance(normals, scores, prior, std))


def match_vector(grid: WindowGrid, flow: WindowFlow, v: Doubles) -> MapMatch | None:
    """Fit the motion whose modelled map has the same three numbers as the measured one; return None if singular.

    They are the mean displacements in range and in bearing, and the slope of the displacement in range over bearing.
    """
    measured = grid.map(v) + flow.displacement
    used = flow.information.any(axis=(2, 3))
    count = int(used.sum())
    if count < BLOCK * BLOCK:
        return None
    bearing_offset = np.where(used, grid.home[..., 1] - grid.home[..., 1][used].mean(), 0.0)
    one, none = used.astype(float), np.zeros(used.shape)
    # contribution of each window to the vector: (n, m, 2, 3)
    summary = (
        np.stack([np.stack([one, none, bearing_offset], axis=-1), np.stack([none, one, none], axis=-1)], axis=-2) / count
    )
    slope = (np.swapaxes(summary, -1, -2) @ grid.derivative).sum(axis=(0, 1))
    if np.linalg.matrix_rank(slope * COMPARABLE_MOTION) < 3:
        return None
    for _ in range(10):
        scores = _apply(summary, measured - grid.map(v))
        step = np.linalg.solve(slope, scores.sum(axis=(0, 1)))
        v = v + step
        if (np.abs(step) < STILL / 10).all():
            break
    # noise in the slopes shortens the flow by this factor
    gain = np.linalg.pinv(flow.information, hermitian=True) @ flow.shared
    normals = np.swapaxes(summary, -1, -2) @ gain @ grid.derivative
    return MapMatch(v, _covariance(normals, scores, np.zeros(3), np.zeros(3)))


def _apply(unknowns: Doubles, gradient: Doubles) -> Doubles:
    """Return the gradient by each unknown, for each window ``(n, m, unknowns)``."""
    return (np.swapaxes(unknowns, -1, -2) @ gradient[..., None])[..., 0]


def _normal(unknowns: Doubles, information: Doubles) -> Doubles:
    """Return the information about the unknowns from each window ``(n, m, unknowns, unknowns)``."""
    return np.asarray(np.swapaxes(unknowns, -1, -2) @ (information @ unknowns))


def _regular(normal: Doubles) -> bool:
    """Return whether normal equations can be solved and have a maximum."""
    size = np.sqrt(np.maximum(np.diag(normal), TINY))
    eigenvalues = np.linalg.eigvalsh(normal / np.outer(size, size))
    return bool(eigenvalues[0] > 1e-8 * eigenvalues[-1])


def _covariance(normals: Doubles, scores: Doubles, prior: Doubles, std: Doubles) -> Doubles | None:
    """Return the covariance of the motion ``(3, 3)``; None where a single block decides.

    It sums the changes when one block of windows is left out (jackknife) and those by what is unsure.
    """
    block_normals, block_scores = in_blocks(normals), in_blocks(scores)
    total = block_normals.sum(axis=0) + np.diag(prior)
    try:
        change = np.linalg.solve(total - block_normals, block_scores[..., None])[..., 0]
        by_unsure = np.linalg.solve(total, np.diag(prior * std))
    except np.linalg.LinAlgError:
        return None
    blocks = len(block_normals)
    return np.asarray((change.T @ change * (blocks - 1) / blocks + by_unsure @ by_unsure.T)[:3, :3])


def in_blocks(values: Doubles) -> Doubles:
    """Sum over blocks of windows ``(blocks, ...)``."""
    for axis in (0, 1):
        values = np.add.reduceat(values, np.arange(0, values.shape[axis], BLOCK), axis=axis)
    return values.reshape(-1, *values.shape[2:])
