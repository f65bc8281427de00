"""Gauss-Newton between two frames in polar coordinates: the steps of ``direct``, coarse to fine, and what they are worth."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.estimation.estimator import UNMEASURED, Excess, ambiguity, correlation_excess, correlation_of, spread_of
from mitsonar.estimation.image.direct_blocks import by_block, products_by_block
from mitsonar.estimation.image.direct_cells import Cells, DirectLevel
from mitsonar.estimation.image.image_slopes import FAINTEST, blurred, central_differences, sampled, slopes_of

__all__ = ["FEWEST_CELLS", "Fit", "Held", "alike_cells", "cauchy", "is_resolved", "noise_of", "register", "smoothed"]

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

STILL = np.array([3e-5, 3e-5, 6e-6])
"""Steps below which an iteration ends [m, m, rad]."""

CAUCHY = 3.0
"""Residuals of so many standard deviations have half the weight."""

TOGETHER = (3, 2)
"""Patches within which residuals belong together: rocks and their shadows."""

AROUND = (3, 3)
"""Patches along beams and bins around each that are looked at as a block."""

BLOCK_CAUCHY = 4.0
"""Blocks whose own best shift explains so many times (squared) what it usually does have half the weight."""

NEGLIGIBLE = 0.1
"""Standard deviations of the estimate below which a step left over is lost in the noise."""

ASIDE = 8
"""Beams by which one frame is displaced to see how much the match stands out."""

COARSE = 10.0
"""How many times larger steps end the iteration of a level that another follows."""

REMEMBERED = 4
LEVER_M = 4.0
LONGEST = 4.0
NEAR_M = 0.002
"""Steps that are remembered for the next; metres that a turn is worth; how many times longer a step may get; how short it
must be before."""

FEWEST_CELLS = 500
"""Fewest cells that are registered."""

FEWEST_ROWS = 24
"""Fewest rows of a level that is not the last."""

SAMPLED = (5, 3)
"""The noise is measured in every so manieth bin and beam."""


class Fit(NamedTuple):
    """The quality of a motion: covariance from the residuals, derivatives, correlation, sizes.

    ``by_height`` is the derivative by the height ``(3,)``, ``by_lean`` that by how far height, pitch and roll of the second
    frame exceed those of the first ``(3, 3)``; their signs do not matter to a covariance. ``excess`` is how much the
    correlation exceeds that of displaced frames.
    """

    converged: bool
    covariance: Doubles
    by_height: Doubles
    by_lean: Doubles
    correlation: float
    independent: float
    blocks: float
    excess: Excess = UNMEASURED


class Held(NamedTuple):
    """What is known of the unknowns before: mean and standard deviation of each [m, m, rad, m]; infinite: nothing."""

    mean: Doubles
    std: Doubles

    def weight(self, scale: float, level: DirectLevel) -> Doubles:
        """Return the prior weight of each unknown in units of the residuals' noise."""
        return np.asarray(alike_cells(level) * scale**2 / self.std**2)


def register(
    pair: tuple[Floats, Floats],
    cells: Cells,
    start: Doubles,
    level: DirectLevel,
    *,
    last: bool,
    held: Held,
) -> tuple[Doubles, Fit | None] | None:
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
    still = STILL if last else COARSE * STILL
    at, margins = None, np.zeros((2, 2))
    for _ in range(level.iterations):
        at = _linearised(*pair, cells, v, level, margins, last=last)
        if at is None:
            return None
        weight = held.weight(at.scale, level)
        pull = at.pull + weight * (v - held.mean)
        step = np.asarray(-np.linalg.solve(at.normal + np.diag(weight), pull), dtype=np.float64)
        v = np.add(v, accelerate(v, step))
        converged = bool((np.abs(step[:3]) < still).all())
        if converged:
            break
    if not last or at is None:
        return v, None
    fit = _fit(at, cells, v, level, held.weight(at.scale, level), converged)
    return v, fit if converged else fit._replace(converged=_is_small(step[:3], fit.covariance[:3, :3]))


def _is_small(step: Doubles, covariance: Doubles) -> bool:
    """Return whether a step is lost in the noise of the estimate ``(3, 3)``, however long it is."""
    return bool(step @ np.linalg.lstsq(covariance, step, rcond=None)[0] < NEGLIGIBLE**2)


class _Side(NamedTuple):
    """One frame drawn at the cells of the other: residual, weights, and sums over patches.

    ``weight`` is that of single cells, 0 where they do not count ``(bins, beams)``; ``along`` and ``across`` are it times
    the slopes along bins and beams; ``patches`` is that of each patch ``(patches,)``; ``slopes`` and ``pull`` are sums of
    both weights times slope by slope, and times slope by residual: along bins, of both, along beams ``(3, patches)``; along
    bins, beams ``(2, patches)``.
    """

    before: Floats
    after: Floats
    inner: tuple[slice, slice]
    weight: Floats
    along: Floats
    across: Floats
    patches: Doubles
    slopes: Doubles
    pull: Doubles


class _Linearisation(NamedTuple):
    """Both sides at one motion, the noise of their differences, and the normal equations."""

    sides: list[_Side]
    scale: float
    normal: Doubles
    pull: Doubles


def _linearised(
    first: Floats, second: Floats, cells: Cells, v: Doubles, level: DirectLevel, margins: Doubles, *, last: bool
) -> _Linearisation | None:
    """Draw the second frame at the cells of the first, at the last level also the reverse; None where too little remains.

    ``margins`` of both ways ``(2, 2)`` grow in place.
    """
    pairs = []
    for back in (False, True) if last else (False,):
        there = cells.shift(v, back=back)
        inner = _inner(there, cells.usable, margins[int(back)])
        if inner is None:
            return None
        drawn = sampled(first if back else second, cells.row + there[0], cells.column + there[1])
        pairs.append((drawn, second, inner) if back else (first, drawn, inner))
    residuals = [after - before for before, after, _ in pairs]
    counted = residuals[0][pairs[0][2]]
    if counted.size < FEWEST_CELLS:
        return None
    scale = noise_of(counted[:: SAMPLED[0], :: SAMPLED[1]].ravel())
    sides = [_side(*pair, residual, cells, level, scale, last=last) for pair, residual in zip(pairs, residuals, strict=True)]
    normal = np.sum([_by_motion(cells.derivative, side.slopes) for side in sides], axis=0)
    pull = np.sum([_flat(cells.derivative) @ side.pull.ravel() for side in sides], axis=0)
    return None if _singular(normal) else _Linearisation(sides, scale, normal, pull)


def noise_of(residual: Floats) -> float:
    """Return the standard deviation of most residuals ``(cells,)``, by their median."""
    return max(1.4826 * median_of(np.abs(residual)), FAINTEST)


def median_of(values: NDArray[np.floating]) -> float:
    """Return the median ``(n,)``, of an even number the upper one: without the checks of ``np.median``."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


def _side(
    before: Floats,
    after: Floats,
    inner: tuple[slice, slice],
    residual: Floats,
    cells: Cells,
    level: DirectLevel,
    scale: float,
    *,
    last: bool,
) -> _Side:
    """Weigh cells, and at the last level blocks; sum over patches."""
    along, across = slopes_of((before + after) * np.float32(0.5), level, scale)
    weight = np.zeros_like(residual)
    weight[inner] = cauchy(residual[inner], scale)
    if cells.seen is not None:
        weight *= cells.seen
    bins, beams = weight * along, weight * across
    products = (bins, along), (bins, across), (beams, across), (bins, residual), (beams, residual)
    sums = products_by_block(products, cells.patch)
    patches = _patch_weight(sums.reshape(5, *cells.patches)) if last else np.ones(sums.shape[1])
    sums *= patches
    return _Side(before, after, inner, weight, bins, beams, patches, sums[:3], sums[3:])


def cauchy(residual: Floats, scale: float) -> Floats:
    """Return weights of residuals whose noise has this standard deviation."""
    ratio = residual * np.float32(1 / (CAUCHY * scale))
    ratio *= ratio
    ratio += 1
    return np.asarray(np.reciprocal(ratio, out=ratio))


def alike_cells(level: DirectLevel) -> float:
    """Return how many cells count once: smoothed noise is alike in neighbours, as far as a smoothing kernel covers."""
    return float(4 * np.pi * max(level.smoothing[0] / level.step, 0.28) * max(level.smoothing[1], 0.28))


def _by_motion(derivative: Doubles, slopes: Doubles) -> Doubles:
    """Return how the pull changes with the motion ``(unknowns, unknowns)``, from sums of slopes by slopes."""
    return np.asarray(_flat(_information(derivative, slopes)) @ _flat(derivative).T)


def _flat(values: Doubles) -> Doubles:
    """Return values ``(n, 2 * patches)`` of ``(n, 2, patches)``."""
    return np.reshape(values, (len(values), -1))


def _information(derivative: Doubles, slopes: Doubles) -> Doubles:
    """Return derivatives ``(n, 2, patches)`` times sums of slopes by slopes: along bins, of both, along beams."""
    return np.asarray(derivative * slopes[::2] + derivative[:, ::-1] * slopes[1])


def _fit(at: _Linearisation, cells: Cells, v: Doubles, level: DirectLevel, held: Doubles, converged: bool) -> Fit:
    """Assess the motion from slopes of one frame times those of the other, and from the pulls of blocks.

    These hold whatever errs together within a block: noise, speckle, relief, in both ways of drawing at once.
    """
    informed = _information(cells.derivative, np.sum([_cross(side, cells, level) for side in at.sides], axis=0))
    true = _flat(informed) @ _flat(cells.derivative).T
    # symmetric to the bit: sums of float32 are not, and a path refuses such covariances
    sound = true if np.linalg.eigvalsh(true)[0] > 0 else (at.normal + at.normal.T) / 2
    undone = np.linalg.inv(sound + np.diag(held))
    each = _without_each(sound + np.diag(held), informed, at, cells)
    # what is known before errs, too: where the frames tell nothing it is all that is known
    known = undone * (alike_cells(level) * at.scale**2 * held) @ undone.T
    side = at.sides[0]
    both = [_information(cells.derivative, one.slopes) for one in at.sides]
    shares = _together((np.tensordot(undone, both[0], 1) * cells.derivative).sum(axis=(0, 1)), cells)
    by_height, by_lean = (
        undone @ np.sum([_flat(one) @ _flat(shift).T for one in both], axis=0)
        for shift in (cells.lifted_shift(v)[None], cells.leaning_shift(v))
    )
    before, after = side.before[side.inner], side.after[side.inner]
    independent, excess = before.size / alike_cells(level), _excess(side, cells)
    return Fit(
        converged=converged,
        covariance=ambiguity(excess.mean, independent) * (each @ each.T + (known + known.T) / 2),
        by_height=by_height[:, 0],
        by_lean=by_lean,
        correlation=correlation_of(before, after),
        independent=independent,
        blocks=spread_of(shares),
        excess=excess,
    )


def _without_each(whole: Doubles, informed: Doubles, at: _Linearisation, cells: Cells) -> Doubles:
    """Return by how much the motion would change without each of the blocks ``(n, blocks)``: the jackknife.

    Blocks that hold much of the information pull little, since the motion follows them.
    """
    pulls = np.sum([(cells.derivative * side.pull).sum(axis=1) for side in at.sides], axis=0)
    parts = np.einsum("ikp,jkp->ijp", informed, cells.derivative)
    left = whole - np.moveaxis(_together((parts + np.swapaxes(parts, 0, 1)) / 2, cells), -1, 0)
    change = np.linalg.solve(left, np.moveaxis(_together(pulls, cells), -1, 0)[..., None])
    return np.asarray(change[..., 0].T)


def _excess(side: _Side, cells: Cells) -> Excess:
    """Return by how much the frames correlate more than displaced across the beams."""
    before, after = side.before[side.inner], side.after[side.inner]
    inside = np.ones(before.shape, dtype=bool) if cells.seen is None else cells.seen[side.inner] > 0
    return correlation_excess(before, after, inside, ASIDE)


def is_resolved(bins: int, level: DirectLevel) -> bool:
    """Return whether frames of so many bins leave a level enough rows."""
    return bins >= FEWEST_ROWS * level.step


def smoothed(image: Floats, level: DirectLevel) -> Floats:
    """Every so many bins of the smoothed image."""
    bins, beams = level.smoothing
    if level.step == 1:
        return blurred(image, bins, beams)
    return blurred(_smoothed_rows(len(image), bins, level.step) @ image, 0, beams)


@lru_cache(maxsize=16)
def _smoothed_rows(bins: int, sigma: float, step: int) -> Floats:
    """Return the weights of bins in every so manieth bin, smoothed ``(rows, bins)``: only those are computed."""
    return np.ascontiguousarray(blurred(np.eye(bins, dtype=np.float32), sigma, 0)[step // 2 :: step])


class _AndersonAcceleration:
    """Anderson acceleration (1965): noise in the slopes shortens steps; the last steps show by how much."""

    def __init__(self) -> None:
        self.places: list[Doubles] = []
        self.steps: list[Doubles] = []

    def __call__(self, place: Doubles, step: Doubles) -> Doubles:
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


def _inner(there: Floats, usable: slice, least: Doubles) -> tuple[slice, slice] | None:
    """Return the cells that meet the ground and stay within both images; None where none does.

    ``least`` are the margins so far ``(2,)``, which grow in place: cells that came and went would keep it from settling.
    """
    _, bins, beams = there.shape
    reach = np.array([max(one.max(), -one.min()) for one in there])
    if not np.isfinite(reach).all():
        return None
    least[:] = np.maximum(least, np.ceil(reach) + 1)
    margin = [int(far) for far in least]
    start = max(margin[0], usable.start)
    if not (start + margin[0] < bins and 2 * margin[1] < beams):
        return None
    return slice(start, bins - margin[0]), slice(margin[1], beams - margin[1])


def _singular(normal: Doubles) -> bool:
    """Return whether some motion changes nothing."""
    size = np.sqrt(np.diag(normal))
    if not (size > 0).all():
        return True
    stretch = np.linalg.eigvalsh(normal / np.outer(size, size))
    return bool(stretch[-1] > 1e8 * stretch[0])


def _cross(side: _Side, cells: Cells, level: DirectLevel) -> Doubles:
    """Return how the pull changes with the slopes ``(3, patches)``, from slopes of one frame times slopes of the other,
    whose noise is independent.

    Outliers, whose weight falls as they grow, count with the derivative of weight times residual, which is negative: a
    motion that the weights hold is known less well than the sum of the weights says.
    """
    curvature = side.weight * (2 * side.weight - 1)
    (along, across), others = (central_differences(blurred(image, *level.slopes)) for image in (side.before, side.after))
    bins, beams = along * curvature, across * curvature
    products = (bins, others[0]), (bins, others[1]), (beams, others[0]), (beams, others[1])
    along_both, one, other, across_both = products_by_block(products, cells.patch)
    return np.stack([along_both, (one + other) / 2, across_both]) * side.patches


def _patch_weight(sums: Doubles) -> Doubles:
    """Return weights of patches ``(patches,)``: one whose surroundings move on their own shows relief, or a shadow.

    The measure is the decrease of their squared differences by their own best shift (Lucas and Kanade, 1981). ``sums``: of
    slopes by slopes and by residuals ``(5, rows, columns)``.
    """
    around = np.array([cv2.boxFilter(one, -1, AROUND, normalize=False, borderType=cv2.BORDER_CONSTANT) for one in sums])
    aa, ab, bb, pull_a, pull_b = around.reshape(5, -1)
    holds = aa + bb > 0
    if not holds.any():
        return np.ones(aa.shape)
    aa, bb = (one + 1e-3 * one[holds].mean() + 1e-12 for one in (aa, bb))
    decrease = (bb * pull_a**2 - 2 * ab * pull_a * pull_b + aa * pull_b**2) / (aa * bb - ab * ab)
    return np.asarray(1 / (1 + decrease / (BLOCK_CAUCHY**2 * median_of(decrease[holds]) + 1e-12)))


def _together(values: Doubles, cells: Cells) -> Doubles:
    """Sum values of patches ``(..., patches)`` over the blocks whose errors are alike ``(..., blocks)``."""
    return by_block(values.reshape(*values.shape[:-1], *cells.patches), TOGETHER)
