"""The estimator ``direct``: photometric Gauss-Newton in native polar coordinates, over level ground.

The ground that a cell of one frame shows, the other frame shows where the exact geometry of the motion takes it. Each frame
is drawn at the cells of the other, and both differences are used: a texture finer than a beam pulls the answer towards
whole and half beams where both frames are interpolated at once. The slopes of the mean of both, as far as they rise over the
noise, turn differences into motion. Single differences, and whole blocks that want to move by themselves, are weighed by
Cauchy's law: shadow edges and relief are outliers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import (
    FEWEST_BLOCKS,
    INPUTS,
    LEAST_AT_BEST,
    LEAST_CORRELATION,
    Estimate,
    correlation_of,
    rejected,
    spread_of,
    two_frames,
)
from mitsonar.geometry.attitude import Attitude, attitude_of
from mitsonar.geometry.ground_plane import GroundGeometry, moved, nearest_known
from mitsonar.motion.composition import Motion, inverse
from mitsonar.records.sonar_frames import SonarFrames

__all__ = ["Direct"]

Floats = NDArray[np.float32]


class DirectLevel(NamedTuple):
    """One step from coarse to fine.

    Attributes:
        step: every so many bins are used.
        smoothing: of the frames, in bins and beams.
        slopes: further smoothing of their mean, before its slopes are taken.
        iterations: at most.
    """

    step: int
    smoothing: tuple[float, float]
    slopes: tuple[float, float]
    iterations: int


LEVELS = (
    DirectLevel(8, (16.0, 4.0), (0.0, 0.0), 10),
    DirectLevel(4, (6.0, 1.5), (0.0, 0.0), 8),
    DirectLevel(1, (0.7, 0.5), (0.6, 0.4), 24),
)

STILL = np.array([3e-5, 3e-5, 6e-6])
"""Steps below which an iteration ends [m, m, rad]."""

CAUCHY = 3.0
"""Residuals of so many standard deviations have half the weight."""

FAINTEST = 0.02
"""Residuals of this size are never outliers: patterns of rays and interpolation reach it without any noise."""

NEIGHBOURS = (3, 7)
"""Beams and bins within which the slopes' variance is compared with the noise (Wiener's filter)."""

BLOCK = (24, 8)
"""Bins and beams within which residuals belong together: rocks and their shadows."""

BLOCK_CAUCHY = 4.0
"""Blocks whose own best shift explains so many times (squared) what it usually does have half the weight."""

MODEL = 4.5
"""Squared errors over the covariance of the residuals, as found on rocky fields with high noise, thesis and physical model:
the ground is neither level nor sampled finely enough. Without any noise errors are larger by a factor of 1.2 and 2 (standard
deviations) than the covariance then says."""

REMEMBERED = 4
LEVER_M = 4.0
LONGEST = 4.0
NEAR_M = 0.002
"""Steps that are remembered for the next; metres that a turn is worth; how many times longer a step may get; how short it
must be before."""

HEIGHT_STEP = 0.05
"""Part of the height by which it is changed to see what depends on it."""

MOSTLY = 0.5
"""Part of the window that must show lit ground for the outline of the light to be left in."""

LIT = 0.9
"""Part of the field of view's elevation that is free of its outline."""

FARTHEST = np.array([0.15, 0.15, np.radians(3)])
"""Motions that are found with certainty are 100 mm and 2 deg; a maximum far beyond is one among noise."""

FEWEST_CELLS = 500
LARGEST_STD = np.array([0.02, 0.02, np.radians(0.5)])
"""What an estimate that is to be believed must have besides: cells; standard deviations."""


class _Fit(NamedTuple):
    """What tells how good a motion is: covariance of the residuals' making, what a height wrong by 1 m changes, ..."""

    converged: bool
    covariance: NDArray[np.float64]
    by_height: NDArray[np.float64]
    correlation: float
    independent: float
    blocks: float


@dataclass(frozen=True)
class Direct:
    """Photometric registration with the exact geometry of the sonar over level ground.

    Args:
        height_m: over the ground, where the window shows no first echoes; default: what the frames say.
        pitch_rad: default: what the frames say.
        relief_m: mean height over the ground of what is seen: rocks, growth; default: from the first echoes, where the
            window shows them, else 0. Motions are scaled wrongly by about its part of the height where it is not known.
        heave_std_m: how far the sonar may have risen or sunk between the frames; 0: not at all.
        levels: coarse to fine.

    Raises:
        MitsonarError: a height or a heave that is not positive.
    """

    height_m: float | None = None
    pitch_rad: float | None = None
    relief_m: float | None = None
    heave_std_m: float = 0.0
    levels: tuple[DirectLevel, ...] = LEVELS

    consumes = SonarFrames
    inputs = INPUTS
    digest = ""

    def __post_init__(self) -> None:
        if not 0 <= self.heave_std_m < np.inf or (self.height_m is not None and not self.height_m > 0):
            raise MitsonarError(
                "direct takes a height above 0 m and a heave_std_m of 0 or more: got "
                f"{self.height_m} and {self.heave_std_m:g}"
            )

    def estimate(self, frames: SonarFrames) -> Estimate:
        """The motion, its covariance, and whether to believe it; zero motion where there is nothing to match."""
        first, second = two_frames(frames)
        attitude = attitude_of(frames, "direct", self.height_m, self.pitch_rad, self.relief_m)
        if attitude.reason:
            return rejected(attitude.reason)
        v = np.zeros(4 if self.heave_std_m else 3)
        fit = None
        for number, level in enumerate(self.levels):
            if len(first) < 24 * level.step and number + 1 < len(self.levels):
                continue  # too few bins for so coarse a step
            pair = _smoothed(first, level), _smoothed(second, level)
            cells = _Cells(frames, attitude, level, heave=bool(self.heave_std_m))
            found = self._register(*pair, cells, v, level, last=number + 1 == len(self.levels))
            if found is None:
                return rejected("nothing in the frames to match")
            v, fit = found
        assert fit is not None
        height = fit.by_height[:3] * attitude.height_std_m
        covariance = MODEL * fit.covariance[:3, :3] + np.outer(height, height)
        about = {"correlation": fit.correlation, "height_m": attitude.height_m}
        about |= {"heave_m": float(v[3])} if self.heave_std_m else {}
        reason = _rejection(fit, covariance, v)
        return Estimate(Motion(*(float(x) for x in v[:3])), covariance, not reason, reason, about)

    def _register(
        self, first: Floats, second: Floats, cells: _Cells, start: NDArray[np.float64], level: DirectLevel, *, last: bool
    ) -> tuple[NDArray[np.float64], _Fit | None] | None:
        """Gauss-Newton from a start; None where there is nothing to match."""
        v, hasten, converged = start.copy(), _Hasten(), False
        look = None
        for _ in range(level.iterations):
            look = _look(first, second, cells, v, level, last=last)
            if look is None:
                return None
            held = self._held(look.scale, len(v))
            step = np.asarray(-np.linalg.solve(look.normal + np.diag(held), look.pull + held * v), dtype=np.float64)
            v = np.add(v, hasten(v, step))
            converged = bool((np.abs(step[:3]) < STILL).all())
            if converged:
                break
        if not last or look is None:
            return v, None
        return v, _fit(look, cells, v, level, self._held(look.scale, len(v)), converged)

    def _held(self, scale: float, unknowns: int) -> NDArray[np.float64]:
        """How strongly each unknown is held to zero: only heave is, in units of the residuals' noise."""
        held = np.zeros(unknowns)
        held[3:] = scale**2 / self.heave_std_m**2 if self.heave_std_m else 0.0
        return held


class _Side(NamedTuple):
    """One frame drawn at the cells of the other: what differs, and what a further motion would change."""

    before: Floats
    after: Floats
    inner: tuple[slice, slice]
    slopes: tuple[Floats, Floats]
    residual: Floats
    jacobian: Floats
    weight: Floats
    weighted: Floats

    def sums(self, values: Floats) -> NDArray[np.float64]:
        """Maps ``(maps, cells)`` summed over blocks of the whole frame ``(maps, blocks)``."""
        rows, columns = self.before.shape
        whole = np.zeros((len(values), rows, columns), dtype=np.float32)
        inside = whole[:, self.inner[0], self.inner[1]]
        inside[...] = values.reshape(inside.shape)
        return _by_block(whole)


class _Look(NamedTuple):
    """Both sides at one motion, and the noise of their differences."""

    sides: list[_Side]
    scale: float
    normal: NDArray[np.float64]
    pull: NDArray[np.float64]


def _look(
    first: Floats, second: Floats, cells: _Cells, v: NDArray[np.float64], level: DirectLevel, *, last: bool
) -> _Look | None:
    """The second frame drawn at the first's cells, at last also the other way; None where too little remains to compare."""
    pairs = []
    for back in (False, True) if last else (False,):
        there = cells.shift(v, back=back)
        inner = _inner(there, cells.usable)
        if inner is None:
            return None
        drawn = _drawn(first if back else second, cells.row + there[0], cells.column + there[1])
        pairs.append((drawn, second, inner) if back else (first, drawn, inner))
    residuals = [(after - before)[inner].ravel() for before, after, inner in pairs]
    if residuals[0].size < FEWEST_CELLS:
        return None
    scale = max(1.4826 * float(np.median(np.abs(residuals[0][::5]))), FAINTEST)
    sides = []
    for (before, after, inner), residual in zip(pairs, residuals, strict=True):
        slopes = _slopes((before + after) * np.float32(0.5), level, scale)
        weight = np.asarray(1 / (1 + (residual * np.float32(1 / (CAUCHY * scale))) ** 2), dtype=np.float32)
        if last:
            weight = weight * _block_weight(slopes, residual, weight, inner)
        jacobian = cells.along(slopes, inner)
        sides.append(_Side(before, after, inner, slopes, residual, jacobian, weight, jacobian * weight))
    normal = np.asarray(sum(side.weighted @ side.jacobian.T for side in sides), dtype=np.float64)
    pull = np.asarray(sum(side.weighted @ side.residual for side in sides), dtype=np.float64)
    return None if _singular(normal) else _Look(sides, scale, normal, pull)


def _fit(
    look: _Look, cells: _Cells, v: NDArray[np.float64], level: DirectLevel, held: NDArray[np.float64], converged: bool
) -> _Fit:
    """How good the motion is: from the pulls of blocks, and from slopes of one frame times those of the other."""
    true = np.sum([_cross(side, cells, level) for side in look.sides], axis=0)
    undone = np.linalg.inv((true if np.linalg.eigvalsh(true)[0] > 0 else look.normal) + np.diag(held))
    pulls = np.sum([side.sums(side.weighted * side.residual) for side in look.sides], axis=0)
    side = look.sides[0]
    shares = side.sums((side.weighted * (undone.astype(np.float32) @ side.jacobian)).sum(axis=0)[None])
    lifted = cells.lifted_shift(v)
    by_height = np.zeros(len(v))
    for one in look.sides:
        by_height += one.weighted @ (one.slopes[0] * lifted[0] + one.slopes[1] * lifted[1])[one.inner].ravel()
    # smoothed noise is alike in neighbouring cells: as many count once as a smoothing kernel covers
    alike = 4 * np.pi * max(level.smoothing[0] / level.step, 0.28) * max(level.smoothing[1], 0.28)
    return _Fit(
        converged=converged,
        covariance=undone @ (pulls @ pulls.T) @ undone,
        by_height=undone @ by_height,
        correlation=correlation_of(side.before[side.inner], side.after[side.inner]),
        independent=side.residual.size / alike,
        blocks=spread_of(shares[0]),
    )


class _Cells:
    """The cells of one level: where they are, and how they move with the sonar, in bins and beams."""

    def __init__(self, frames: SonarFrames, attitude: Attitude, level: DirectLevel, *, heave: bool) -> None:
        step = level.step
        reach = tuple(2 * int(np.ceil(2 * s / k)) + 1 for s, k in zip(level.smoothing[::-1], (1, step), strict=True))
        self.bearing, self.attitude, self.heave = frames.sonar.bearing, attitude, heave
        self.grid = _grid(tuple(frames.range_m.tolist()), tuple(frames.bearing_rad.tolist()), step)
        self.row, self.column = self.grid.row, self.grid.column
        self.ground = self._ground(attitude.height_m)
        known = np.asarray(np.isfinite(self.ground.points).all(axis=-1), dtype=bool)
        self.from_node = nearest_known(known)
        first = int(known.any(axis=1).argmax()) if known.any() else len(known)
        self.usable = slice(
            int(np.searchsorted(self.grid.range_m, self.grid.node_range[first])) if known.any() else 10**9, None
        )
        self.nodes = self._nodes(attitude.height_m)
        self.derivative = self._on_all(self.nodes)
        self.seen = self._seen(known, np.radians(frames.sonar.elevation_fov_deg) / 2, reach)

    def _ground(self, height: float) -> GroundGeometry:
        """The geometry at the nodes."""
        grid, attitude = self.grid, self.attitude
        return GroundGeometry(
            grid.node_range, grid.node_bearing, self.bearing, height, attitude.pitch_rad, attitude.roll_rad
        )

    def _nodes(self, height: float) -> Floats:
        """The derivative at the nodes by motion (and heave) ``(3 or 4, 2, nodes, nodes)``."""
        ground = self._ground(height)
        nodes = np.moveaxis(ground.derivative, (3, 2), (0, 1))
        if self.heave:
            nodes = np.concatenate([nodes, np.moveaxis(ground.derivative_by_height, 2, 0)[None]])
        return np.nan_to_num(nodes[:, :, self.from_node[0], self.from_node[1]]).astype(np.float32)

    def _seen(self, known: NDArray[np.bool_], half_elevation: float, reach: tuple[int, ...]) -> Floats | None:
        """1 where a cell shows ground to be matched, else 0 ``(bins, beams)``; None where all do.

        The outline of the lit ground moves with the sonar and holds estimates back. It is kept out where the ground is even,
        and where a fan shows mostly what it cannot light; rocks blur it, and those that rise from beyond it help.
        """
        with np.errstate(invalid="ignore"):
            lit = np.abs(self.ground.elevation(self.ground.points)) <= LIT * half_elevation
        mask_lit = self.attitude.even or lit.mean() < MOSTLY
        shown = known & lit if mask_lit else known
        if shown[self.from_node[0].min() :].all():
            return None
        grid = self.grid
        row, column = (
            np.abs(values[:, None] - nodes).argmin(axis=1)
            for values, nodes in ((grid.range_m, grid.node_range), (grid.bearing_rad, grid.node_bearing))
        )
        on_all = shown[row][:, column].astype(np.uint8)
        return np.asarray(cv2.erode(on_all, np.ones(reach[::-1], np.uint8)) if mask_lit else on_all, dtype=np.float32)

    def _on_all(self, nodes: Floats) -> Floats:
        """From the nodes to all cells ``(..., 2, bins, beams)``, in bins and beams."""
        full = self.grid.over_bins @ nodes @ self.grid.over_beams.T
        full[..., 0, :, :] /= self.grid.bin_m[:, None]
        full[..., 1, :, :] /= self.grid.beam_rad
        return np.asarray(full)

    def shift(self, v: NDArray[np.float64], *, back: bool = False) -> Floats:
        """How far from each cell of the first frame the second shows its ground ``(2, bins, beams)``, in bins and beams; or
        back: how far from each cell of the second the first shows it."""
        ground = other = self.ground
        if self.heave:
            half = float(v[3]) / (2 if back else -2)
            ground, other = (self._ground(self.attitude.height_m + change) for change in (half, -half))
        motion = inverse(v[:3]) if back else v[:3]
        radius, bearing = other.to_polar(moved(ground.points, motion))
        grid = self.grid
        nodes = np.stack([radius - grid.node_range[:, None], bearing - grid.node_bearing])
        return self._on_all(nodes[:, self.from_node[0], self.from_node[1]].astype(np.float32))

    def lifted_shift(self, v: NDArray[np.float64]) -> Floats:
        """The change of :meth:`shift` with the height, a metre, to first order in the motion."""
        change = HEIGHT_STEP * self.attitude.height_m
        other = self._nodes(self.attitude.height_m + change)
        return self._on_all(np.tensordot(v.astype(np.float32) / np.float32(change), other - self.nodes, axes=1))

    def along(self, slopes: tuple[Floats, Floats], inner: tuple[slice, slice]) -> Floats:
        """The image's derivative by each motion ``(3 or 4, cells)``."""
        by_bin, by_beam = slopes[0][inner], slopes[1][inner]
        jacobian = np.empty((len(self.derivative), *by_bin.shape), dtype=np.float32)
        for out, (bins, beams) in zip(jacobian, self.derivative, strict=True):
            np.multiply(by_bin, bins[inner], out=out)
            out += by_beam * beams[inner]
            if self.seen is not None:
                out *= self.seen[inner]
        return jacobian.reshape(len(jacobian), -1)


class _Grid(NamedTuple):
    """Cells of every so many bins, and splines from few nodes to all of them: the geometry is smooth."""

    range_m: NDArray[np.float64]
    bearing_rad: NDArray[np.float64]
    node_range: NDArray[np.float64]
    node_bearing: NDArray[np.float64]
    over_bins: Floats
    over_beams: Floats
    bin_m: Floats
    beam_rad: Floats
    row: Floats
    column: Floats


@lru_cache(maxsize=16)
def _grid(range_m: tuple[float, ...], bearing_rad: tuple[float, ...], step: int) -> _Grid:
    ranges, axes = np.array(range_m)[step // 2 :: step], np.array(bearing_rad)
    nodes = [np.linspace(values[0], values[-1], count) for values, count in ((ranges, 33), (axes, 17))]
    splines = [
        np.asarray(make_interp_spline(node, np.eye(len(node)), 3)(values), dtype=np.float32)
        for node, values in zip(nodes, (ranges, axes), strict=True)
    ]
    row = np.arange(len(ranges), dtype=np.float32)[:, None]
    column = np.arange(len(axes), dtype=np.float32)[None, :]
    spacing = [np.gradient(values).astype(np.float32) for values in (ranges, axes)]
    return _Grid(ranges, axes, nodes[0], nodes[1], splines[0], splines[1], spacing[0], spacing[1], row, column)


def _blurred(image: Floats, bins: float, beams: float) -> Floats:
    if not bins and not beams:
        return image
    size = tuple(2 * int(np.ceil(3 * sigma)) + 1 for sigma in (beams, bins))
    return np.asarray(cv2.GaussianBlur(image, size, sigmaX=beams, sigmaY=bins, borderType=cv2.BORDER_REPLICATE))


def _smoothed(image: Floats, level: DirectLevel) -> Floats:
    """Every so many bins of the smoothed image."""
    smooth = _blurred(image, *level.smoothing)
    return np.ascontiguousarray(smooth[level.step // 2 :: level.step])


def _drawn(image: Floats, row: Floats, column: Floats) -> Floats:
    """Values between pixels, bilinear."""
    return np.asarray(cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _slopes(image: Floats, level: DirectLevel, scale: float) -> tuple[Floats, Floats]:
    """Central differences over bins and beams of the image as far as it rises over the noise.

    ``scale`` is the standard deviation of a difference of two frames; their mean has half of it.
    """
    smooth = _blurred(image, *level.slopes)
    if scale > FAINTEST:
        mean = cv2.blur(smooth, NEIGHBOURS)
        variance = cv2.blur(smooth * smooth, NEIGHBOURS) - mean * mean
        kept = np.maximum(0, 1 - np.float32(2 * (scale / 2) ** 2) / np.maximum(variance, np.float32(1e-9)))
        smooth = mean + (smooth - mean) * kept
    return _differences(smooth)


HALVES = np.array([-0.5, 0.0, 0.5], dtype=np.float32)
ONE = np.ones(1, dtype=np.float32)


def _differences(image: Floats) -> tuple[Floats, Floats]:
    """Central differences over bins and over beams."""
    by_bin = cv2.sepFilter2D(image, -1, ONE, HALVES, borderType=cv2.BORDER_REPLICATE)
    by_beam = cv2.sepFilter2D(image, -1, HALVES, ONE, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(by_bin, dtype=np.float32), np.asarray(by_beam, dtype=np.float32)


class _Hasten:
    """Anderson's acceleration (1965): noise in the slopes makes steps too short, by what the last ones tell."""

    def __init__(self) -> None:
        self.places: list[NDArray[np.float64]] = []
        self.steps: list[NDArray[np.float64]] = []

    def __call__(self, place: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """The step to take instead of one; the same where the last ones tell too little, or too much."""
        lever = np.array([1, 1, LEVER_M, 1])[: len(step), None]
        if np.linalg.norm(lever[:, 0] * step) > NEAR_M:  # too far for the last steps to tell much
            return step
        self.places.append(place)
        self.steps.append(step)
        if len(self.steps) < 2:
            return step
        places, steps = (np.diff(np.array(values[-REMEMBERED:]), axis=0).T for values in (self.places, self.steps))
        past, *_ = np.linalg.lstsq(lever * steps, lever[:, 0] * step, rcond=1e-3)
        hastened = np.asarray(step - (places + steps) @ past)
        lengths = [float(np.linalg.norm(lever[:, 0] * one)) for one in (hastened, step)]
        return hastened if lengths[0] < LONGEST * lengths[1] else step


def _inner(half: Floats, usable: slice) -> tuple[slice, slice] | None:
    """Cells that meet the ground and stay within both images; None where none does."""
    _, bins, beams = half.shape
    reach = np.abs(half).max(axis=(1, 2))
    if not np.isfinite(reach).all():
        return None
    margin = [int(np.ceil(far)) + 1 for far in reach]
    start = max(margin[0], usable.start)
    if not (start + margin[0] < bins and 2 * margin[1] < beams):
        return None
    return slice(start, bins - margin[0]), slice(margin[1], beams - margin[1])


def _singular(normal: NDArray[np.float64]) -> bool:
    """Whether some motion changes nothing."""
    size = np.sqrt(np.diag(normal))
    return not (size > 0).all() or np.linalg.cond(normal / np.outer(size, size)) > 1e8


def _cross(side: _Side, cells: _Cells, level: DirectLevel) -> NDArray[np.float64]:
    """The normal matrix from slopes of one frame times slopes of the other, whose noise is not the same."""
    frames = (side.before, side.after)
    one, other = (cells.along(_differences(_blurred(image, *level.slopes)), side.inner) for image in frames)
    product = ((one * side.weight) @ other.T).astype(np.float64)
    return (product + product.T) / 2


def _block_weight(slopes: tuple[Floats, Floats], residual: Floats, weight: Floats, inner: tuple[slice, slice]) -> Floats:
    """Weights ``(cells,)`` of whole blocks: one that wants to move by itself shows relief, or a shadow.

    How much it wants to is what its own best shift would take off its squared differences (Lucas and Kanade, 1981).
    """
    along, across = slopes[0][inner], slopes[1][inner]
    r, w = residual.reshape(along.shape), weight.reshape(along.shape)
    terms = np.empty((5, *r.shape), dtype=np.float32)
    products = ((along, along), (along, across), (across, across), (along, r), (across, r))
    for k, (one, other) in enumerate(products):
        np.multiply(one, other, out=terms[k])
    terms *= w
    aa, ab, bb, pull_a, pull_b = _by_block(terms)
    aa, bb = aa + 1e-3 * aa.mean() + 1e-12, bb + 1e-3 * bb.mean() + 1e-12
    unrest = (bb * pull_a**2 - 2 * ab * pull_a * pull_b + aa * pull_b**2) / (aa * bb - ab * ab)
    blocks = 1 / (1 + unrest / (BLOCK_CAUCHY**2 * float(np.median(unrest)) + 1e-12))
    row, column = (_block_of(r.shape[k], BLOCK[k]) for k in (0, 1))
    table = blocks.reshape(row[-1] + 1, column[-1] + 1).astype(np.float32)
    return np.asarray(table[row][:, column]).ravel()


def _block_of(size: int, block: int) -> NDArray[np.intp]:
    """The block of each cell along an axis; cells beyond the last whole block belong to it."""
    return np.minimum(np.arange(size) // block, max(size // block, 1) - 1)


def _by_block(maps: Floats) -> NDArray[np.float64]:
    """Sums over blocks ``(maps, blocks)``."""
    starts = [np.arange(0, max(size // block, 1) * block, block) for size, block in zip(maps.shape[1:], BLOCK, strict=True)]
    sums = np.add.reduceat(np.add.reduceat(maps, starts[0], axis=1), starts[1], axis=2)
    return np.asarray(sums.reshape(len(maps), -1), dtype=np.float64)


def _rejection(fit: _Fit, covariance: NDArray[np.float64], v: NDArray[np.float64]) -> str:
    """Why not to believe an estimate; empty where nothing speaks against it."""
    std = np.sqrt(np.diag(covariance))
    if not fit.converged:
        return "the iteration did not settle"
    if fit.correlation < max(LEAST_AT_BEST, LEAST_CORRELATION / np.sqrt(fit.independent)):
        return f"the frames as matched correlate by {fit.correlation:.2f} only"
    if (np.abs(v[:3]) > FARTHEST).any():
        return "a motion beyond 150 mm or 3 deg is farther than the coarsest level searches"
    if fit.blocks < FEWEST_BLOCKS:
        return "too small a part of the frames holds anything to match"
    if not (std < LARGEST_STD).all():
        return f"standard deviations of {1e3 * std[0]:.1f}, {1e3 * std[1]:.1f} mm, {np.degrees(std[2]):.2f} deg"
    return ""
