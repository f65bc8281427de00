"""How frames with known poses become a height map of the ground: the fit, its regulariser and its standard deviation.

Heights z are a Gaussian process around level ground, of standard deviation s: Matern's covariance of smoothness 1, whose
inverse is sparse (Lindgren, Rue and Lindstrom, J. R. Stat. Soc. B 73:423, 2011). The mean level Y of L independent samples
of speckle has a Gamma distribution around the level m(z) of :mod:`mitsonar.mapping.relief`. Gauss-Newton steps minimise

    sum L (log m + Y / m) + (z - plane)' Q (z - plane) / (2 s^2).

s is the one that best predicts image blocks which the fit did not use. The residuals of these blocks also give the
dispersion by which errors exceed those of speckle: texture, and what heights per cell cannot represent. It scales the
covariance.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, ndimage, sparse
from scipy.sparse.linalg import SuperLU, splu

from mitsonar.errors import MitsonarError, argument
from mitsonar.instruments.sonar import Sonar, scans
from mitsonar.mapping.relief import GroundCells, ReliefView, lit_ground
from mitsonar.mapping.shadows import joined_shadow_heights
from mitsonar.records.frames import SonarFrames

__all__ = ["HeightMap", "HeightMapOptions", "Trial", "fit_height_map", "most_trials", "views_of"]

Array = NDArray[np.float64]
Sparse: TypeAlias = "sparse.csr_array[Any, Any]"

FEWEST_CELLS, MOST_CELLS, MOST_FRAMES = 16, 96, 32
FEWEST_BEAMS = 8
"""Smallest number of beams, and of bins: with fewer, heights are not resolved."""

LENGTH_CELLS = 4.0
"""Correlation length of the heights [cells]. Held-out blocks cannot choose it: a long one allows the whole ground to tilt
away from the sonar and to be brighter, which looks the same in one frame."""

STDS, FIRST = (0.005, 0.01, 0.02, 0.04, 0.08), 1
"""Candidates of the standard deviation of heights, as fractions of the height of the sonar, and the first that is tried."""

LEAKS = (0.3, 0.1, 0.03)
"""Constant level that is added to the image, as a fraction of that of level ground, from the first steps of the fit to the
last. It represents side lobes and what the map cannot represent, and bounds the penalty of an echo in a modelled shadow."""

HELD_OUT, PATCH = 0.2, 4
"""Fraction of the blocks that are held out, and the edge of their patches [blocks]."""

STEPS, STEPS_OF_TRIAL = 12, 6
"""Largest numbers of Gauss-Newton steps of the final fit and of a trial."""

MOST_DAMPED, LEAST_DAMPING = 4, 1e-2
"""Largest number of dampings of a step, and the first of them, relative to the diagonal of the information."""

CONVERGED = 1.0
"""Decrease of the objective at which a fit has converged; 0.5 is one standard deviation of one direction."""

LEAST_GAIN = 5.0
"""Smallest gain of the log-likelihood of all held-out blocks over level ground at which there is relief."""

MOST_RATIO = 5.0
"""Largest ratio of the measured to the expected level of a held-out block that counts; some lie in a modelled shadow."""


@dataclass(frozen=True)
class HeightMapOptions:
    """Choices of a height map.

    Attributes:
        cells: number of cells along an edge of the square map.
        seed: seed of the choice of held-out blocks.

    Raises:
        MitsonarError: an option is outside its limits.
    """

    cells: int = 64
    seed: int = 0

    def __post_init__(self) -> None:
        if not FEWEST_CELLS <= self.cells <= MOST_CELLS:
            raise MitsonarError(f"{argument('cells')} must lie in {FEWEST_CELLS}..{MOST_CELLS}: got {self.cells}")


@dataclass(frozen=True)
class Trial:
    """A regulariser, and how well it predicts the held-out blocks.

    Attributes:
        std_m: standard deviation of the heights [m]; 0 is level ground.
        length_m: correlation length of the heights [m].
        deviance: mean of log m + min(Y / m, 5) of the held-out blocks, less that of level ground; smaller is better.
    """

    std_m: float
    length_m: float
    deviance: float


@dataclass(frozen=True)
class HeightMap:
    """A map of heights and of their standard deviations. Row 0 is northernmost, column 0 westernmost.

    Attributes:
        height_m: heights in the world ``(cells, cells)`` [m]; nan where no frame shows the ground.
        std_m: their standard deviations, shaped so [m].
        west_m: western edge [m].
        north_m: northern edge [m].
        cell_m: edge of a cell [m].
        ground_m: height of the level ground that the regulariser prefers [m].
        regulariser: the chosen regulariser.
        trials: all regularisers that were tried.
        dispersion: squared errors of held-out blocks relative to those of speckle.
        reflectivity: reflectivity of the ground for the levels of the frames.
        frames: number of frames.
    """

    height_m: Array
    std_m: Array
    west_m: float
    north_m: float
    cell_m: float
    ground_m: float
    regulariser: Trial
    trials: tuple[Trial, ...] = field(repr=False)
    dispersion: float
    reflectivity: float
    frames: int

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Return the west, east, south and north edge [m] (Matplotlib's ``extent``)."""
        edge = len(self.height_m) * self.cell_m
        return self.west_m, self.west_m + edge, self.north_m - edge, self.north_m

    @property
    def centres(self) -> tuple[Array, Array]:
        """Return x and y of the centres of cells, shaped as ``height_m`` [m]."""
        steps = (np.arange(len(self.height_m)) + 0.5) * self.cell_m
        x, y = np.meshgrid(self.west_m + steps, self.north_m - steps)
        return x, y


def fit_height_map(
    frames: SonarFrames,
    poses: Array,
    height_m: Array,
    options: HeightMapOptions = HeightMapOptions(),
    progress: Callable[[int], None] | None = None,
) -> HeightMap:
    """Fit one height map to all frames.

    The map covers all ground that the frames show, and states heights where it lies within the elevation field of view.
    Ground outside the map is assumed to be level.

    Args:
        frames: one or more frames of one sonar, of the same ground.
        poses: poses of the sonar ``(frames, 6)`` [m, rad].
        height_m: height of the sonar over level ground ``(frames,)`` [m].
        options: size of the map.
        progress: function that is called with the number of further trials that are done, :func:`most_trials` at most.

    Raises:
        MitsonarError: too few beams, too many frames, an unknown pose or height, no ground in the window, or no relief.
    """
    views, levels = views_of(frames, np.asarray(poses, dtype=float), np.asarray(height_m, dtype=float), options)
    fit = _Fit(views, levels)
    search = _Search(fit, float(np.median(height_m)), options.seed, progress or (lambda _: None))
    best = search.best()
    # The dispersion scales the covariance of the heights, and hence their regulariser: the fit stays the same.
    solution = fit.recentred(fit.minimised(best.trial, best.solution, STEPS))
    grid = fit.grid
    std = np.sqrt(best.dispersion) * fit.std(best.trial, solution)
    seen = fit.seen
    maps = [np.where(seen, values, np.nan)[::-1] for values in (solution.height_m, std)]
    return HeightMap(
        height_m=maps[0],
        std_m=maps[1],
        west_m=grid.west_m,
        north_m=grid.south_m + grid.cells * grid.cell_m,
        cell_m=grid.cell_m,
        ground_m=grid.ground_m,
        regulariser=best.trial,
        trials=tuple(search.trials),
        dispersion=best.dispersion,
        reflectivity=solution.reflectivity,
        frames=len(views),
    )


def most_trials() -> int:
    """Return the largest number of regularisers that :func:`fit_height_map` tries."""
    return len(STDS)


# ---------------- Frames become views of a grid


def views_of(
    frames: SonarFrames, poses: Array, height_m: Array, options: HeightMapOptions
) -> tuple[list[ReliefView], list[Array]]:
    """Return the views of all frames, and their levels in blocks."""
    count, bearing = len(frames), np.asarray(frames.bearing_rad, dtype=float)
    if scans(frames.sonar) or min(len(bearing), len(frames.range_m)) < FEWEST_BEAMS:
        size = f"{len(bearing)} beams and {len(frames.range_m)} bins"
        raise MitsonarError(
            f"a height map needs an image of {FEWEST_BEAMS} beams and bins or more from one pose: got "
            + ("a rotating head, whose beams ping one after another" if scans(frames.sonar) else size)
            + "; a single bearing shows ranges only, at any height"
        )
    if not 1 <= count <= MOST_FRAMES:
        raise MitsonarError(f"a height map takes 1..{MOST_FRAMES} frames: got {count}; choose some of them")
    if poses.shape != (count, 6) or height_m.shape != (count,):
        raise MitsonarError(
            f"poses must be ({count}, 6) and heights ({count},), one for each frame: got {poses.shape} and {height_m.shape}"
        )
    if not (np.isfinite(poses).all() and np.isfinite(height_m).all() and (height_m > 0).all()):
        raise MitsonarError(
            "a height map needs the pose of each frame and a height above 0 m over the ground: some are unknown; give "
            f"{argument('height_m')}, or other frames"
        )
    images = frames.to_linear().image.astype(float) * frames.level_scale
    if not np.isfinite(images).all():
        raise MitsonarError("the frames hold nan or inf: set pixels without echo to 0")
    sonar = _sonar_of(frames)
    grid = _grid(sonar, bearing, poses, float(np.median(poses[:, 2] - height_m)), options.cells)
    views = [ReliefView(sonar, bearing, pose, grid) for pose in poses]
    return views, [view.averaged(image) for view, image in zip(views, images, strict=True)]


def _sonar_of(frames: SonarFrames) -> Sonar:
    """Return the sonar with the window of the frames."""
    ranges = frames.range_m
    half = float(ranges[-1] - ranges[0]) / max(1, len(ranges) - 1) / 2
    window = {"range_min": max(0.0, float(ranges[0]) - half), "range_max": float(ranges[-1]) + half}
    return frames.sonar.replace(**window, range_bins=len(ranges))


def _grid(sonar: Sonar, bearing_rad: Array, poses: Array, ground_m: float, cells: int) -> GroundCells:
    """Return the smallest square of cells around the ground that the frames show."""
    step = max(1, sonar.range_bins // 128)
    shown = [lit_ground(sonar, bearing_rad, sonar.range_m[::step], pose, ground_m).reshape(-1, 2) for pose in poses]
    points = np.concatenate(shown)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < cells or any(not np.isfinite(part).any() for part in shown):
        raise MitsonarError(
            "a frame shows no ground: at the given height and pitch, level ground lies outside the window of "
            f"{sonar.range_min:.3g}..{sonar.range_max:.3g} m or the elevation field of view; check {argument('height_m')} "
            f"and {argument('pitch_deg')}"
        )
    low, high = points.min(axis=0), points.max(axis=0)
    edge = float((high - low).max())
    west, south = (low + high - edge) / 2
    return GroundCells(float(west), float(south), edge / cells, cells, ground_m)


# ---------------- Objective and its minimisation


@dataclass(frozen=True)
class _Solution:
    """Heights, the reflectivity of the ground, and what follows from them.

    Attributes:
        height_m: heights ``(cells, cells)`` [m].
        reflectivity: reflectivity of the ground.
        centre_m: mean of the heights in the regulariser [m].
        levels: levels of echoes in the blocks of each view, for a reflectivity of 1.
    """

    height_m: Array
    reflectivity: float
    centre_m: float
    levels: list[Array]


@dataclass(frozen=True)
class _Regulariser:
    """Inverse covariance of the heights: Matern's of smoothness 1, on square cells with free edges."""

    grid: GroundCells
    std_m: float
    length_m: float

    def precision(self) -> Sparse:
        """Return the inverse covariance ``(cells^2, cells^2)`` [1/m^2]."""
        n, cell = self.grid.cells, self.grid.cell_m
        wave = 8 / self.length_m**2  # the correlation has fallen to 0.14 at this length
        second = sparse.diags_array([np.r_[1, np.full(n - 2, 2.0), 1], -np.ones(n - 1), -np.ones(n - 1)], offsets=[0, 1, -1])
        one = sparse.eye_array(n)
        laplacian = (sparse.kron(second, one) + sparse.kron(one, second)) / cell**2
        operator = sparse.csr_array(wave * sparse.eye_array(n * n) + laplacian)
        return sparse.csr_array((operator.T @ operator) * (cell**2 / (4 * math.pi * wave * self.std_m**2)))


class _Fit:
    """The objective of a height map, and its minimisation.

    Attributes:
        grid: cells of the map.
        flat: level ground, from which fits begin where nothing is known.
        weights: number of independent samples of each block of each view; 0 where it is not used.
        seen: cells that some frame shows ``(cells, cells)``.
        leak: constant level of the image, see :data:`LEAKS`.
        threads: threads that render views; NumPy and SciPy release the interpreter.
    """

    def __init__(self, views: Sequence[ReliefView], levels: Sequence[Array]) -> None:
        self.views, self.measured, self.grid = views, levels, views[0].grid
        self.threads = ThreadPoolExecutor(min(len(views), os.cpu_count() or 1))
        self.weights = [np.where(view.used, 1.0 if math.isinf(view.looks) else view.looks, 0.0) for view in views]
        height = np.full((self.grid.cells, self.grid.cells), self.grid.ground_m)
        ground = [view.levels(height) for view in views]
        ratios = [y[w > 0] / m[w > 0] for y, m, w in zip(levels, ground, self.weights, strict=True)]
        ratio = np.concatenate([part[np.isfinite(part)] for part in ratios])
        if not len(ratio) or not np.median(ratio) > 0:
            raise MitsonarError("the frames hold no echo of the ground: check the height, the pitch and the window")
        reflectivity = float(np.median(ratio))
        self.flat = _Solution(height, reflectivity, self.grid.ground_m, ground)
        self._ground = [reflectivity * m for m in ground]
        self.leak = LEAKS[-1]
        self.seen = self._seen()
        if not self.seen.any():
            raise MitsonarError(
                "no frame shows ground within the elevation field of view: at the given height and pitch, only the edges of "
                f"the beams light it; check {argument('height_m')} and {argument('pitch_deg')}"
            )

    def _seen(self) -> NDArray[np.bool_]:
        """Return the cells that lie within the fan and the elevation field of view of some view ``(cells, cells)``."""
        x, y = self.grid.centres
        seen = np.zeros(x.shape, dtype=bool)
        for view in self.views:
            row, column = view.blocks_of(np.stack([x, y, np.full_like(x, self.grid.ground_m)], axis=-1))
            inside = (row >= 0) & (row < view.shape[0]) & (column >= 0) & (column < view.shape[1])
            seen[inside] |= view.in_view[row[inside], column[inside]]
        return seen

    def means(self, solution: _Solution) -> list[Array]:
        """Return the expected levels in the blocks of each view: echoes, noise and leak."""
        return [
            solution.reflectivity * m + view.noise + self.leak * (g + 0.1 * g.max())
            for m, view, g in zip(solution.levels, self.views, self._ground, strict=True)
        ]

    def deviance(self, solution: _Solution, weights: Sequence[Array]) -> float:
        """Return the sum of weight (log m + Y / m)."""
        means = self.means(solution)
        return sum(
            float((w * (np.log(m) + y / m))[w > 0].sum()) for w, m, y in zip(weights, means, self.measured, strict=True)
        )

    def with_reflectivity(self, solution: _Solution) -> _Solution:
        """Return the solution with the reflectivity of least deviance, by Fisher's scoring of its logarithm."""
        for _ in range(20):
            slope = curvature = 0.0
            for w, mean, y, m in zip(self.weights, self.means(solution), self.measured, solution.levels, strict=True):
                part = solution.reflectivity * m / mean
                slope += float((w * part * (1 - y / mean)).sum())
                curvature += float((w * part * part).sum())
            step = -slope / curvature if curvature > 0 else 0.0
            solution = replace(solution, reflectivity=solution.reflectivity * math.exp(float(np.clip(step, -1, 1))))
            if abs(step) < 1e-4:
                break
        return solution

    def solution_of(self, height_m: Array, reflectivity: float, centre_m: float) -> _Solution:
        """Return the solution of given heights around a centre, with the best reflectivity."""
        levels = list(self.threads.map(lambda view: view.levels(height_m), self.views))
        return self.with_reflectivity(_Solution(height_m, reflectivity, centre_m, levels))

    def minimised(self, trial: Trial, start: _Solution, steps: int) -> _Solution:
        """Minimise the objective by Gauss-Newton steps that are halved until they decrease it."""
        precision = _Regulariser(self.grid, trial.std_m, trial.length_m).precision()

        def objective(solution: _Solution) -> float:
            offset = solution.height_m.ravel() - solution.centre_m
            return self.deviance(solution, self.weights) + float(offset @ (precision @ offset)) / 2

        solution = self.with_reflectivity(start)
        value, damping = objective(solution), 0.0
        ceiling = min(float(view.position[2]) for view in self.views)
        for _ in range(steps):
            hessian, gradient, gain = self._expansion(solution, precision)
            decrease = 0.0
            for _ in range(MOST_DAMPED):
                damped = hessian + damping * sparse.diags_array(hessian.diagonal())
                step = _solve_with_gain(_factor(damped), gain, -gradient).reshape(solution.height_m.shape)
                for fraction in (1.0, 0.5, 0.2):
                    height = solution.height_m + fraction * step
                    if height.max() < ceiling:
                        moved = self.solution_of(height, solution.reflectivity, solution.centre_m)
                        decrease = value - objective(moved)
                    if decrease > 0:
                        break
                if decrease > 0:
                    break
                damping = max(10 * damping, LEAST_DAMPING)
            if decrease <= 0:
                break
            solution, value, damping = moved, value - decrease, damping / 3
            if decrease < CONVERGED:
                break
        return solution

    def recentred(self, solution: _Solution) -> _Solution:
        """Shift the heights so that the most frequent one is that of level ground, and the mean of the regulariser with it.

        Rocks raise the mean of the heights above the ground. A common offset of all heights hardly changes an image.
        """
        offset = _mode(solution.height_m[self.seen]) - self.grid.ground_m
        return self.solution_of(solution.height_m - offset, solution.reflectivity, solution.centre_m - offset)

    def _expansion(self, solution: _Solution, precision: Sparse) -> tuple[Sparse, Array, tuple[Array, float]]:
        """Return Fisher's information about the heights, the gradient, and the information shared with the reflectivity."""
        hessian, gradient = precision, precision @ (solution.height_m.ravel() - solution.centre_m)
        shared, alone = np.zeros(len(gradient)), 0.0
        views = zip(self.views, self.weights, self.means(solution), self.measured, strict=True)
        for parts in self.threads.map(lambda view: _expansion_of(solution, *view), views):  # summed in the order of views
            hessian, gradient = hessian + parts[0], gradient + parts[1]
            shared, alone = shared + parts[2], alone + parts[3]
        return sparse.csr_array(hessian), gradient, (shared, alone)

    def std(self, trial: Trial, solution: _Solution) -> Array:
        """Return the standard deviation of each height ``(cells, cells)`` [m] for errors of speckle alone."""
        precision = _Regulariser(self.grid, trial.std_m, trial.length_m).precision()
        hessian, _, (shared, alone) = self._expansion(solution, precision)
        dense = hessian.toarray()
        lower = linalg.cholesky(dense, lower=True, overwrite_a=True, check_finite=False)
        direction = linalg.cho_solve((lower, True), shared, check_finite=False)
        inverse, _ = linalg.lapack.dpotri(lower, lower=1, overwrite_c=1)
        variance = inverse.diagonal() + direction**2 / max(alone - float(shared @ direction), 1e-12 * alone)
        return np.asarray(np.sqrt(variance).reshape(solution.height_m.shape))


def _expansion_of(
    solution: _Solution, view: ReliefView, weights: Array, means: Array, measured: Array
) -> tuple[Sparse, Array, Array, float]:
    """Return the information and the gradient of one view: of heights, and of the logarithm of the reflectivity."""
    levels, by_height = view.derivative(solution.height_m)
    used = np.flatnonzero(weights.ravel() > 0)
    by_height = sparse.csr_array(by_height[used] * solution.reflectivity)
    m = means.ravel()[used]
    weight, by_gain = weights.ravel()[used] / np.square(m), solution.reflectivity * levels.ravel()[used]
    return (
        sparse.csr_array(by_height.T @ sparse.csr_array(by_height.multiply(weight[:, None]))),
        by_height.T @ (weight * (m - measured.ravel()[used])),
        by_height.T @ (weight * by_gain),
        float((weight * by_gain * by_gain).sum()),
    )


def _mode(values: Array) -> float:
    """Return the most frequent value: the middle of the shortest half, of its shortest half, and so on."""
    ordered = np.sort(values)
    while len(ordered) > 3:
        half = (len(ordered) + 1) // 2
        spans = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
        begin = int(spans.argmin())
        ordered = ordered[begin : begin + half]
    return float(ordered.mean())


def _factor(hessian: Sparse) -> SuperLU:
    """Factorise a sparse symmetric matrix."""
    options = {"SymmetricMode": True}
    return splu(hessian.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


def _solve_with_gain(factor: SuperLU, gain: tuple[Array, float], right: Array) -> Array:
    """Solve for the heights when the reflectivity, whose gradient is 0, is free as well."""
    shared, alone = gain
    solved, direction = factor.solve(right), factor.solve(shared)
    rest = alone - float(shared @ direction)
    return np.asarray(solved + direction * (float(shared @ solved) / rest if rest > 0 else 0.0))


# ---------------- Search of the regulariser


@dataclass(frozen=True)
class _Candidate:
    """A trial, the fit to the blocks that were not held out, and the dispersion of the others."""

    trial: Trial
    solution: _Solution
    dispersion: float


class _Search:
    """Search of the regulariser that best predicts held-out blocks.

    Attributes:
        trials: all regularisers tried so far; the first is level ground.
    """

    def __init__(self, fit: _Fit, height_m: float, seed: int, progress: Callable[[int], None]) -> None:
        self.fit, self.height_m, self.progress = fit, height_m, progress
        rng = np.random.default_rng([abs(seed), 0x68656967])
        self.all, self.train, self.test = fit.weights, [], []
        for weight in fit.weights:
            patches = rng.random([size // PATCH + 1 for size in weight.shape]) < HELD_OUT
            excluded = np.kron(patches, np.ones((PATCH, PATCH)))[: weight.shape[0], : weight.shape[1]] > 0
            self.train.append(np.where(excluded, 0.0, weight))
            self.test.append(np.where(excluded, (weight > 0).astype(float), 0.0))
        self.blocks = sum(float(test.sum()) for test in self.test)
        fit.weights = self.train
        self.level = self._deviance(fit.with_reflectivity(fit.flat))
        fit.weights = self.all
        self.trials = [Trial(0.0, math.inf, 0.0)]

    def _deviance(self, solution: _Solution) -> float:
        """Return the mean deviance of held-out blocks, with ratios of levels up to :data:`MOST_RATIO`."""
        means = self.fit.means(solution)
        parts = [np.log(m) + np.minimum(y / m, MOST_RATIO) for m, y in zip(means, self.fit.measured, strict=True)]
        return sum(float((part * test).sum()) for part, test in zip(parts, self.test, strict=True)) / max(1.0, self.blocks)

    def best(self) -> _Candidate:
        """Return the best candidate on the way to larger or smaller standard deviations.

        Raises:
            MitsonarError: none is better than level ground.
        """
        length = LENGTH_CELLS * self.fit.grid.cell_m
        first = best = self._tried(STDS[FIRST] * self.height_m, length, self._beginning(), first=True)
        # Larger ones while they help, or else smaller ones.
        for parts in (STDS[FIRST + 1 :], STDS[:FIRST][::-1]):
            if best is not first:
                break
            for part in parts:
                candidate = self._tried(part * self.height_m, length, best.solution)
                if candidate.trial.deviance >= best.trial.deviance:
                    break
                best = candidate
        looks = max(float(weight.max()) for weight in self.all)
        if best.trial.deviance * self.blocks * looks > -LEAST_GAIN:
            raise MitsonarError(
                "the frames show no relief: level ground predicts blocks of the image that the fit did not use as well as "
                "any height map does; it needs shadows or slopes, at grazing angles of about 10 to 40 deg"
            )
        return best

    def _beginning(self) -> _Solution:
        """Return level ground, or the heights from shadows where they explain the image better."""
        flat = self.fit.with_reflectivity(self.fit.flat)
        heights = joined_shadow_heights(self.fit.views, self.fit.measured, flat.reflectivity)
        smooth = ndimage.gaussian_filter(heights, 1.0)
        shadows = self.fit.solution_of(smooth, flat.reflectivity, flat.centre_m)
        return min(flat, shadows, key=lambda one: self.fit.deviance(one, self.train))

    def _tried(self, std_m: float, length_m: float, start: _Solution, *, first: bool = False) -> _Candidate:
        """Fit the blocks that are not held out, and score the others."""
        fit = self.fit
        fit.weights = self.train
        trial = Trial(std_m, length_m, math.nan)
        for leak in LEAKS if first else LEAKS[-1:]:
            fit.leak = leak
            start = fit.recentred(fit.minimised(trial, start, STEPS_OF_TRIAL))
        fit.weights = self.all
        trial = replace(trial, deviance=self._deviance(start) - self.level)
        self.trials.append(trial)
        self.progress(1)
        return _Candidate(trial, start, self._dispersion(start))

    def _dispersion(self, solution: _Solution) -> float:
        """Return the variance of the mean residuals of held-out patches over that of speckle, at least 1.

        Errors of the model are correlated over neighbouring blocks, and count more in the mean of a patch than speckle.
        """
        ratios = []
        for mean, y, test, view in zip(self.fit.means(solution), self.fit.measured, self.test, self.fit.views, strict=True):
            rows, columns = (size // PATCH for size in test.shape)
            patches = [
                values[: rows * PATCH, : columns * PATCH].reshape(rows, PATCH, columns, PATCH).mean(axis=(1, 3))
                for values in (np.minimum(y / mean, MOST_RATIO) - 1, test)
            ]
            whole = patches[1] == 1
            ratios.append(np.square(patches[0][whole]) * PATCH**2 * (1.0 if math.isinf(view.looks) else view.looks))
        joined = np.concatenate(ratios)
        return max(1.0, float(joined.mean())) if len(joined) else 1.0
