"""Gauss-Newton between two frames in polar coordinates: the steps of ``direct``, coarse to fine, and what they are worth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.estimation.estimator import ambiguity, correlation_excess, correlation_of, spread_of
from mitsonar.estimation.image.direct_blocks import block_of, by_block
from mitsonar.estimation.image.direct_cells import Cells, DirectLevel
from mitsonar.estimation.image.image_slopes import FAINTEST, blurred, central_differences, sampled, slopes_of

__all__ = ["Fit", "register", "smoothed"]

Floats = NDArray[np.float32]

STILL = np.array([3e-5, 3e-5, 6e-6])
"""Steps below which an iteration ends [m, m, rad]."""

CAUCHY = 3.0
"""Residuals of so many standard deviations have half the weight."""

BLOCK = (24, 8)
"""Bins and beams within which residuals belong together: rocks and their shadows."""

BLOCK_CAUCHY = 4.0
"""Blocks whose own best shift explains so many times (squared) what it usually does have half the weight."""

NEGLIGIBLE = 0.1
"""Standard deviations of the estimate below which a step left over is lost in the noise."""

REMEMBERED = 4
LEVER_M = 4.0
LONGEST = 4.0
NEAR_M = 0.002
"""Steps that are remembered for the next; metres that a turn is worth; how many times longer a step may get; how short it
must be before."""

FEWEST_CELLS = 500
"""Fewest cells that are registered."""


class Fit(NamedTuple):
    """The quality of a motion: covariance from the residuals, derivative by the height, correlation, sizes.

    ``excess`` is how much the correlation exceeds that of displaced frames.
    """

    converged: bool
    covariance: NDArray[np.float64]
    by_height: NDArray[np.float64]
    correlation: float
    independent: float
    blocks: float
    excess: float = 0.0


class Held(NamedTuple):
    """What is known of the unknowns before: mean and standard deviation of each [m, m, rad, m]; infinite: nothing."""

    mean: NDArray[np.float64]
    std: NDArray[np.float64]

    def weight(self, scale: float, level: DirectLevel) -> NDArray[np.float64]:
        """Return the prior weight of each unknown in units of the residuals' noise."""
        return np.asarray(_alike(level) * scale**2 / self.std**2)


def register(
    pair: tuple[Floats, Floats],
    cells: Cells,
    start: NDArray[np.float64],
    level: DirectLevel,
    *,
    last: bool,
    held: Held,
) -> tuple[NDArray[np.float64], Fit | None] | None:
    """Run Gauss-Newton from a start; None where there is nothing to match.

    Args:
        pair: both frames at this level, smoothed.
        cells: of this level.
        start: sideways, forward [m], yaw [rad], and heave [m] where it is unknown ``(3,)`` or ``(4,)``.
        level: smoothing and iterations.
        last: whether it is the finest level: both ways are drawn, and the fit is assessed.
        held: what is known of the unknowns before.

    Returns:
        The motion, and its fit at the finest level.
    """
    v, accelerate, converged = start.copy(), _AndersonAcceleration(), False
    at = None
    for _ in range(level.iterations):
        at = _linearised(*pair, cells, v, level, last=last)
        if at is None:
            return None
        weight = held.weight(at.scale, level)
        step = np.asarray(
            -np.linalg.solve(at.normal + np.diag(weight), at.pull + weight * (v - held.mean)), dtype=np.float64
        )
        v = np.add(v, accelerate(v, step))
        converged = bool((np.abs(step[:3]) < STILL).all())
        if converged:
            break
    if not last or at is None:
        return v, None
    fit = _fit(at, cells, v, level, held.weight(at.scale, level), converged)
    return v, fit if converged else fit._replace(converged=_is_small(step[:3], fit.covariance[:3, :3]))


def _is_small(step: NDArray[np.float64], covariance: NDArray[np.float64]) -> bool:
    """Return whether a step is lost in the noise of the estimate ``(3, 3)``, however long it is."""
    return bool(step @ np.linalg.lstsq(covariance, step, rcond=None)[0] < NEGLIGIBLE**2)


class _Side(NamedTuple):
    """One frame drawn at the cells of the other: residuals, and their derivatives by a further motion.

    ``weight`` is that of single cells, ``blocks`` that of the block of each; None: all 1.
    """

    before: Floats
    after: Floats
    inner: tuple[slice, slice]
    slopes: tuple[Floats, Floats]
    residual: Floats
    jacobian: Floats
    weight: Floats
    blocks: Floats | None
    weighted: Floats

    def curvature(self) -> Floats:
        """Return the derivative of weight times residual by the residual ``(cells,)``.

        Outliers, whose weight falls as they grow, have a negative one: a motion that the weights hold is known less well
        than the sum of the weights says.
        """
        alone = self.weight * (2 * self.weight - 1)
        return alone if self.blocks is None else alone * self.blocks

    def sums(self, values: Floats) -> NDArray[np.float64]:
        """Sum maps ``(maps, cells)`` over blocks of the whole frame ``(maps, blocks)``."""
        rows, columns = self.before.shape
        whole = np.zeros((len(values), rows, columns), dtype=np.float32)
        inside = whole[:, self.inner[0], self.inner[1]]
        inside[...] = values.reshape(inside.shape)
        return by_block(whole, BLOCK)


class _Linearisation(NamedTuple):
    """Both sides at one motion, the noise of their differences, and the normal equations."""

    sides: list[_Side]
    scale: float
    normal: NDArray[np.float64]
    pull: NDArray[np.float64]


def _linearised(
    first: Floats, second: Floats, cells: Cells, v: NDArray[np.float64], level: DirectLevel, *, last: bool
) -> _Linearisation | None:
    """Draw the second frame at the cells of the first, at the last level also the reverse; None where too little remains."""
    pairs = []
    for back in (False, True) if last else (False,):
        there = cells.shift(v, back=back)
        inner = _inner(there, cells.usable)
        if inner is None:
            return None
        drawn = sampled(first if back else second, cells.row + there[0], cells.column + there[1])
        pairs.append((drawn, second, inner) if back else (first, drawn, inner))
    residuals = [(after - before)[inner].ravel() for before, after, inner in pairs]
    if residuals[0].size < FEWEST_CELLS:
        return None
    scale = max(1.4826 * float(np.median(np.abs(residuals[0][::5]))), FAINTEST)
    sides = []
    for (before, after, inner), residual in zip(pairs, residuals, strict=True):
        slopes = slopes_of((before + after) * np.float32(0.5), level, scale)
        weight = np.asarray(1 / (1 + (residual * np.float32(1 / (CAUCHY * scale))) ** 2), dtype=np.float32)
        blocks = _block_weight(slopes, residual, weight, inner) if last else None
        jacobian = cells.along(slopes, inner)
        weighted = jacobian * (weight if blocks is None else weight * blocks)
        sides.append(_Side(before, after, inner, slopes, residual, jacobian, weight, blocks, weighted))
    normal = np.asarray(sum(side.weighted @ side.jacobian.T for side in sides), dtype=np.float64)
    pull = np.asarray(sum(side.weighted @ side.residual for side in sides), dtype=np.float64)
    return None if _singular(normal) else _Linearisation(sides, scale, normal, pull)


def _fit(
    at: _Linearisation, cells: Cells, v: NDArray[np.float64], level: DirectLevel, held: NDArray[np.float64], converged: bool
) -> Fit:
    """Assess the motion from the gradients of single cells, and from slopes of one frame times those of the other.

    Sums of gradients over blocks tell less: what interpolation leaves over changes sign within a block and cancels there.
    """
    true = np.sum([_cross(side, cells, level) for side in at.sides], axis=0)
    undone = np.linalg.inv((true if np.linalg.eigvalsh(true)[0] > 0 else at.normal) + np.diag(held))
    pulls = [one.weighted * one.residual for one in at.sides]
    spread = _alike(level) * sum((one @ one.T).astype(np.float64) for one in pulls)
    side = at.sides[0]
    independent = side.residual.size / _alike(level)
    excess = _excess(side, cells)
    shares = side.sums((side.weighted * (undone.astype(np.float32) @ side.jacobian)).sum(axis=0)[None])
    lifted = cells.lifted_shift(v)
    by_height = np.zeros(len(v))
    for one in at.sides:
        by_height += one.weighted @ (one.slopes[0] * lifted[0] + one.slopes[1] * lifted[1])[one.inner].ravel()
    return Fit(
        converged=converged,
        covariance=ambiguity(excess, independent) * undone @ spread @ undone,
        by_height=undone @ by_height,
        correlation=correlation_of(side.before[side.inner], side.after[side.inner]),
        independent=independent,
        blocks=spread_of(shares[0]),
        excess=excess,
    )


def _excess(side: _Side, cells: Cells) -> float:
    """Return by how much the frames correlate more than displaced across the beams."""
    before, after = side.before[side.inner], side.after[side.inner]
    inside = np.ones(before.shape, dtype=bool) if cells.seen is None else cells.seen[side.inner] > 0
    return correlation_excess(before, after, inside, BLOCK[1])


def _alike(level: DirectLevel) -> float:
    """Return how many cells count once: smoothed noise is alike in as many as a smoothing kernel covers."""
    return float(4 * np.pi * max(level.smoothing[0] / level.step, 0.28) * max(level.smoothing[1], 0.28))


def smoothed(image: Floats, level: DirectLevel) -> Floats:
    """Every so many bins of the smoothed image."""
    smooth = blurred(image, *level.smoothing)
    return np.ascontiguousarray(smooth[level.step // 2 :: level.step])


class _AndersonAcceleration:
    """Anderson acceleration (1965): noise in the slopes shortens steps; the last steps show by how much."""

    def __init__(self) -> None:
        self.places: list[NDArray[np.float64]] = []
        self.steps: list[NDArray[np.float64]] = []

    def __call__(self, place: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return an accelerated step; the given one where the last steps do not suffice."""
        lever = np.array([1, 1, LEVER_M, 1])[: len(step), None]
        if np.linalg.norm(lever[:, 0] * step) > NEAR_M:  # too far for the last steps to tell much
            return step
        self.places.append(place)
        self.steps.append(step)
        if len(self.steps) < 2:
            return step
        places, steps = (np.diff(np.array(values[-REMEMBERED:]), axis=0).T for values in (self.places, self.steps))
        past, *_ = np.linalg.lstsq(lever * steps, lever[:, 0] * step, rcond=1e-3)
        accelerated = np.asarray(step - (places + steps) @ past)
        lengths = [float(np.linalg.norm(lever[:, 0] * one)) for one in (accelerated, step)]
        return accelerated if lengths[0] < LONGEST * lengths[1] else step


def _inner(half: Floats, usable: slice) -> tuple[slice, slice] | None:
    """Return the cells that meet the ground and stay within both images; None where none does."""
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
    """Return whether some motion changes nothing."""
    size = np.sqrt(np.diag(normal))
    if not (size > 0).all():
        return True
    stretch = np.linalg.eigvalsh(normal / np.outer(size, size))
    return bool(stretch[-1] > 1e8 * stretch[0])


def _cross(side: _Side, cells: Cells, level: DirectLevel) -> NDArray[np.float64]:
    """Return how the gradient changes with the motion, from slopes of one frame times slopes of the other, whose noise is
    independent."""
    frames = (side.before, side.after)
    one, other = (cells.along(central_differences(blurred(image, *level.slopes)), side.inner) for image in frames)
    product = ((one * side.curvature()) @ other.T).astype(np.float64)
    return (product + product.T) / 2


def _block_weight(slopes: tuple[Floats, Floats], residual: Floats, weight: Floats, inner: tuple[slice, slice]) -> Floats:
    """Return weights ``(cells,)`` of whole blocks: one that moves on its own shows relief, or a shadow.

    The measure is the decrease of its squared differences by its own best shift (Lucas and Kanade, 1981).
    """
    along, across = slopes[0][inner], slopes[1][inner]
    r, w = residual.reshape(along.shape), weight.reshape(along.shape)
    terms = np.empty((5, *r.shape), dtype=np.float32)
    products = ((along, along), (along, across), (across, across), (along, r), (across, r))
    for k, (one, other) in enumerate(products):
        np.multiply(one, other, out=terms[k])
    terms *= w
    aa, ab, bb, pull_a, pull_b = by_block(terms, BLOCK)
    aa, bb = aa + 1e-3 * aa.mean() + 1e-12, bb + 1e-3 * bb.mean() + 1e-12
    decrease = (bb * pull_a**2 - 2 * ab * pull_a * pull_b + aa * pull_b**2) / (aa * bb - ab * ab)
    blocks = 1 / (1 + decrease / (BLOCK_CAUCHY**2 * float(np.median(decrease)) + 1e-12))
    row, column = (block_of(r.shape[k], BLOCK[k]) for k in (0, 1))
    table = blocks.reshape(row[-1] + 1, column[-1] + 1).astype(np.float32)
    return np.asarray(table[row][:, column]).ravel()
