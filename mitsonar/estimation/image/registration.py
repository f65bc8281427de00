"""How ``direct`` registers two frames by Gauss-Newton in polar coordinates, and how it assesses the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from mitsonar.estimation.estimator import UNMEASURED, Excess, ambiguity, correlation_excess, correlation_of, spread_of
from mitsonar.geometry.ground import Attitude, GroundGeometry, lean_derivative, lit_margin, moved, nearest_known
from mitsonar.motion.composition import inverse
from mitsonar.records.frames import SonarFrames

__all__ = [
    "FAINTEST",
    "FEWEST_CELLS",
    "NODES",
    "SHADOW_SIDES",
    "SHADOW_SIDES_CODED",
    "Cells",
    "DirectLevel",
    "Fit",
    "GroundNodes",
    "StartPrior",
    "blurred",
    "by_block",
    "cauchy",
    "cell_blocks",
    "central_differences",
    "correlated_cells",
    "is_resolved",
    "node_axes",
    "noise_of",
    "on_cells",
    "products_by_block",
    "register",
    "sampled",
    "shadow_lengths",
    "slopes_of",
    "smoothed",
]


Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

SETTLED = np.array([3e-5, 3e-5, 6e-6])
"""Steps below which an iteration ends [m, m, rad]."""

CAUCHY = 3.0
"""Residuals of this many standard deviations have half the weight."""

CORRELATED_PATCHES = (3, 2)
"""Patches within which residuals are correlated: rocks and their shadows."""

SURROUNDING_PATCHES = (3, 3)
"""Patches along beams and bins around each patch that are assessed as one block."""

MODEL = 1.4
"""Squared errors over the jackknife's covariance, measured at 60 places over rocky fields with six sonars."""

SURFACE = 3
"""Unknowns of the surface: its height, and its rise forward and to starboard."""

DISPLACEMENT_STD = 0.012
"""Standard deviation of displacements [bins, beams] that neither motion nor noise explains.

Interpolation displaces frames by up to 0.02 bins where a pulse is shorter than a bin. With it, squared errors over the
covariance are 0.7 to 1.3 over rocky fields, over hulls without noise and over a pattern in speckle; without it, up to 3.7.
"""

SURFACE_SLOPE_STD = float(np.radians(1))
"""Standard deviation of the slope of the surface, forward and to starboard, and of the attitude over it."""

BLOCK_CAUCHY = 4.0
"""Blocks have half the weight if their individual best shift explains this many times (squared) what it usually does."""

NEGLIGIBLE = 0.1
"""Standard deviations of the estimate below which a remaining step is lost in the noise."""

DISPLACED_BEAMS = 8
"""Beams by which one frame is displaced to measure how distinct the match is."""

COARSE_STEP_FACTOR = 10.0
"""Factor on the step that ends the iteration of a level followed by a finer one."""

REMEMBERED_STEPS = 4
LEVER_M = 4.0
LONGEST_ACCELERATION = 4.0
ACCELERATED_STEP_M = 0.002
"""Steps remembered for the acceleration; metres that a radian of turn counts as; largest lengthening of a step; and the
largest step [m] that is accelerated."""

FEWEST_CELLS = 500
"""Smallest number of cells that can be registered."""

FEWEST_ROWS = 24
"""Smallest number of rows of a level that is not the last."""

NOISE_STRIDE = (5, 3)
"""Stride in bins and beams of the cells from which the noise is measured."""


class Fit(NamedTuple):
    """Quality of an estimated motion.

    Attributes:
        converged: whether the iteration settled.
        covariance: of the motion, from the residuals ``(3, 3)``.
        by_unknown: change of the motion by one standard deviation of what else is uncertain: the surface, and the attitude
            of the frames ``(3, unknowns)``. Signs do not matter to a covariance.
        correlation: of the registered frames.
        independent: number of cells with independent noise.
        blocks: effective number of blocks that share the information.
        excess: how much the correlation exceeds that of displaced frames.
    """

    converged: bool
    covariance: Doubles
    by_unknown: Doubles
    correlation: float
    independent: float
    blocks: float
    excess: Excess = UNMEASURED


class StartPrior(NamedTuple):
    """Gaussian prior of the unknowns: mean and standard deviation of each [m, m, rad, m]; infinite: no prior."""

    mean: Doubles
    std: Doubles

    def weight(self, scale: float, level: DirectLevel) -> Doubles:
        """Return the prior weight of each unknown in units of the residuals' noise."""
        return np.asarray(correlated_cells(level) * scale**2 / self.std**2)


def register(
    pair: tuple[Floats, Floats],
    cells: Cells,
    start: Doubles,
    level: DirectLevel,
    *,
    last: bool,
    prior: StartPrior,
) -> tuple[Doubles, Fit | None] | None:
    """Run Gauss-Newton from a start; return None if there is nothing to match.

    Args:
        pair: both frames at this level, smoothed.
        cells: of this level.
        start: sideways, forward [m], yaw [rad], and heave [m] if it is unknown ``(3,)`` or ``(4,)``.
        level: smoothing and iterations.
        last: whether it is the finest level: frames are resampled in both directions, and the fit is assessed.
        prior: prior of the unknowns.

    Returns:
        The motion, and its fit at the finest level.
    """
    v, accelerate, converged = start.copy(), _AndersonAcceleration(), False
    step_limit = SETTLED if last else COARSE_STEP_FACTOR * SETTLED
    linearisation, margins = None, np.zeros((2, 2))
    for _ in range(level.iterations):
        linearisation = _linearised(*pair, cells, v, level, margins, last=last)
        if linearisation is None:
            return None
        # the prior enters the normal equations in units of the residuals' noise
        weight = prior.weight(linearisation.scale, level)
        gradient = linearisation.gradient + weight * (v - prior.mean)
        step = np.asarray(-np.linalg.solve(linearisation.normal + np.diag(weight), gradient), dtype=np.float64)
        v = np.add(v, accelerate(v, step))
        converged = bool((np.abs(step[:3]) < step_limit).all())
        if converged:
            break
    if not last or linearisation is None:
        return v, None
    # a long step is acceptable if it is small against the uncertainty of the estimate
    correction, fit = _fit(linearisation, cells, v, level, weight, gradient, converged)
    return v + correction, fit if converged else fit._replace(converged=_is_small(step[:3], fit.covariance))


def _is_small(step: Doubles, covariance: Doubles) -> bool:
    """Return whether a step is small against the covariance of the estimate ``(3, 3)``, whatever its length."""
    return bool(step @ np.linalg.lstsq(covariance, step, rcond=None)[0] < NEGLIGIBLE**2)


class _ResampledPair(NamedTuple):
    """One frame resampled at the cells of the other: residual, weights, and sums over patches.

    Attributes:
        before: levels of the first frame ``(bins, beams)``.
        after: levels of the second frame ``(bins, beams)``.
        inner: cells that both frames show.
        weight: weight of each cell, 0 where it does not count ``(bins, beams)``.
        along: weight times the slope over bins.
        across: weight times the slope over beams.
        patches: weight of each patch ``(patches,)``.
        slopes: sums of both weights times slope by slope: over bins, mixed, over beams ``(3, patches)``.
        gradients: sums of both weights times slope by residual: over bins, over beams ``(2, patches)``.
    """

    before: Floats
    after: Floats
    inner: tuple[slice, slice]
    weight: Floats
    along: Floats
    across: Floats
    patches: Doubles
    slopes: Doubles
    gradients: Doubles


class _Linearisation(NamedTuple):
    """Both resampled frames at one motion, the noise of their differences, and the normal equations."""

    sides: list[_ResampledPair]
    scale: float
    normal: Doubles
    gradient: Doubles


def _linearised(
    first: Floats, second: Floats, cells: Cells, v: Doubles, level: DirectLevel, margins: Doubles, *, last: bool
) -> _Linearisation | None:
    """Resample the second frame at the cells of the first and build the normal equations.

    At the last level the reverse is added. Return None where too few cells remain. ``margins`` of both directions
    ``(2, 2)`` grow in place.
    """
    # resample in one direction, or in both so that the interpolation of either frame does not bias the motion
    pairs = []
    for back in (False, True) if last else (False,):
        displacement = cells.shift(v, back=back)
        inner = _inner(displacement, cells.usable, margins[int(back)])
        if inner is None:
            return None
        resampled = sampled(first if back else second, cells.row + displacement[0], cells.column + displacement[1])
        pairs.append((resampled, second, inner) if back else (first, resampled, inner))
    # one scale for both directions, from the residuals of the first
    residuals = [after - before for before, after, _ in pairs]
    counted = residuals[0][pairs[0][2]]
    if counted.size < FEWEST_CELLS:
        return None
    scale = noise_of(counted[:: NOISE_STRIDE[0], :: NOISE_STRIDE[1]].ravel())
    # weigh the residuals, then project the sums over patches onto the motion
    sides = [
        _weighted_pair(*pair, residual, cells, level, scale, last=last)
        for pair, residual in zip(pairs, residuals, strict=True)
    ]
    normal = np.sum([_by_motion(cells.derivative, side.slopes) for side in sides], axis=0)
    gradient = np.sum([_flat(cells.derivative) @ side.gradients.ravel() for side in sides], axis=0)
    return None if _singular(normal) else _Linearisation(sides, scale, normal, gradient)


def noise_of(residual: Floats) -> float:
    """Return a robust standard deviation of residuals ``(cells,)``, from their median."""
    return max(1.4826 * median_of(np.abs(residual)), FAINTEST)


def median_of(values: NDArray[np.floating]) -> float:
    """Return the median of values ``(n,)``, the upper one of an even number; without the checks of ``np.median``."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


def _weighted_pair(
    before: Floats,
    after: Floats,
    inner: tuple[slice, slice],
    residual: Floats,
    cells: Cells,
    level: DirectLevel,
    scale: float,
    *,
    last: bool,
) -> _ResampledPair:
    """Weigh cells, and at the last level blocks; sum over patches."""
    along, across = slopes_of((before + after) * np.float32(0.5), level, scale)
    # downweight outliers cell by cell; cells outside both images, or that show no ground, do not count
    weight = np.zeros_like(residual)
    weight[inner] = cauchy(residual[inner], scale)
    if cells.seen is not None:
        weight *= cells.seen
    # sums over patches, within which the geometry is constant
    bins, beams = weight * along, weight * across
    products = (bins, along), (bins, across), (beams, across), (bins, residual), (beams, residual)
    sums = products_by_block(products, cells.patch)
    # downweight whole patches whose surroundings move independently
    patches = _patch_weight(sums.reshape(5, *cells.patches)) if last else np.ones(sums.shape[1])
    sums *= patches
    return _ResampledPair(before, after, inner, weight, bins, beams, patches, sums[:3], sums[3:])


def cauchy(residual: Floats, scale: float) -> Floats:
    """Return the Cauchy weights of residuals, given the standard deviation of their noise."""
    ratio = residual * np.float32(1 / (CAUCHY * scale))
    ratio *= ratio
    ratio += 1
    return np.asarray(np.reciprocal(ratio, out=ratio))


def correlated_cells(level: DirectLevel) -> float:
    """Return the number of cells that count as one, since a smoothing kernel correlates the noise of neighbours."""
    return float(4 * np.pi * max(level.smoothing[0] / level.step, 0.28) * max(level.smoothing[1], 0.28))


def _by_motion(derivative: Doubles, slopes: Doubles) -> Doubles:
    """Return the normal matrix ``(unknowns, unknowns)`` from sums of slope by slope."""
    return np.asarray(_flat(_information(derivative, slopes)) @ _flat(derivative).T)


def _flat(values: Doubles) -> Doubles:
    """Return values ``(n, 2 * patches)`` from ``(n, 2, patches)``."""
    return np.reshape(values, (len(values), -1))


def _information(derivative: Doubles, slopes: Doubles) -> Doubles:
    """Return derivatives ``(n, 2, patches)`` times sums of slope by slope: over bins, mixed, over beams."""
    return np.asarray(derivative * slopes[::2] + derivative[:, ::-1] * slopes[1])


def _fit(
    linearisation: _Linearisation,
    cells: Cells,
    v: Doubles,
    level: DirectLevel,
    prior_weight: Doubles,
    gradient: Doubles,
    converged: bool,
) -> tuple[Doubles, Fit]:
    """Correct the motion for the surface and the attitude that the frames show, and assess it.

    Whatever else displaces the ground has a Gaussian prior of unit variance: see :meth:`GroundNodes.unknown_shift`. A
    surface that lies lower than assumed moves more slowly in the near part of a frame than in the far part, and the
    residuals show it. How far they count follows from the gradients of blocks, which include all errors common to a block,
    in both directions of resampling: noise, speckle, relief.

    Returns:
        What to add to the motion and heave ``(3 or 4,)``, and the fit.
    """
    unknowns = len(cells.derivative)
    motion, others = slice(unknowns), slice(unknowns, -2)  # the residuals cannot tell the last two from motion
    derivative, information, normal = _curvature(linearisation, cells, v, level)
    mixed, noise = normal[motion, unknowns:], correlated_cells(level) * linearisation.scale**2
    inverse = np.linalg.inv(normal[motion, motion] + np.diag(prior_weight))
    # a match that hardly differs from displaced ones has a larger covariance
    first = linearisation.sides[0]
    before, after = first.before[first.inner], first.after[first.inner]
    independent, excess = before.size / correlated_cells(level), _excess(first, cells)
    model = MODEL * ambiguity(excess.mean, independent)
    # gradients of the blocks ``(unknowns, blocks)``, as they would be with the block left out
    weighted = normal + np.diag(np.append(prior_weight, np.full(len(normal) - unknowns, noise)))
    gradients = weighted @ _jackknife(weighted, information, derivative, linearisation, cells)
    # eliminate the motion: what the residuals say of the other unknowns, and how far the blocks contradict each other in it
    by_unknown = -inverse @ mixed
    of_others = by_unknown[:, :-2]
    schur = normal[unknowns:, unknowns:] + mixed.T @ by_unknown
    reduced = gradients[others] + of_others.T @ gradients[motion]
    trust, unexplained = _trust(schur[:-2, :-2], model * reduced @ reduced.T, linearisation)
    gain = of_others @ trust
    others_gradient = np.sum(
        [(derivative[others] * side.gradients).sum(axis=(1, 2)) for side in linearisation.sides], axis=0
    )
    # errors of the motion from the blocks, and from the prior where the frames hold no information
    changes = inverse @ gradients[motion] + gain @ reduced
    prior_part = inverse * (noise * prior_weight) @ inverse.T
    covariance = model * (changes @ changes.T) + (prior_part + prior_part.T) / 2 + gain @ unexplained @ gain.T
    # share of each block in the information
    shares = (np.tensordot(inverse, _information(cells.derivative, first.slopes), 1) * cells.derivative).sum(axis=(0, 1))
    return -gain @ (others_gradient + of_others.T @ gradient), Fit(
        converged=converged,
        covariance=covariance[:3, :3],
        by_unknown=(by_unknown - gain @ schur[:-2])[:3],
        correlation=correlation_of(before, after),
        independent=independent,
        blocks=spread_of(_by_correlated_block(shares, cells)),
        excess=excess,
    )


def _trust(normal: Doubles, spread: Doubles, linearisation: _Linearisation) -> tuple[Doubles, Doubles]:
    """Return what gradients of the other unknowns, whose prior has unit variance, are multiplied by.

    Args:
        normal: of these unknowns, the motion eliminated ``(others, others)``.
        spread: covariance of their gradients, from the blocks ``(others, others)``.
        linearisation: whose slopes say what a displacement changes.

    Returns:
        The factors, and the covariance of gradients by displacements that nothing explains, which would pass for the
        attitude ``(others, others)``.
    """
    values, axes = np.linalg.eigh(normal)
    known = (axes * np.maximum(values, 0)) @ axes.T
    unexplained = np.zeros_like(known)
    slopes = float(np.sum([side.slopes[::2].sum() for side in linearisation.sides])) / 2
    unexplained[SURFACE:, SURFACE:] = DISPLACEMENT_STD**2 * slopes * known[SURFACE:, SURFACE:]
    return np.asarray(known @ np.linalg.pinv(known @ known + spread + unexplained, hermitian=True)), unexplained


def _curvature(
    linearisation: _Linearisation, cells: Cells, v: Doubles, level: DirectLevel
) -> tuple[Doubles, Doubles, Doubles]:
    """Return derivatives and information of the patches, and the normal matrix, of all unknowns.

    These are the motion, those of :meth:`GroundNodes.unknown_shift`, and a displacement of all cells along bins, and along
    beams. Slopes of one frame times those of the other hold no noise, which is independent in the two.
    """
    everywhere = DISPLACEMENT_STD * np.repeat(np.eye(2)[:, :, None], cells.derivative.shape[2], axis=2)
    derivative = np.concatenate([cells.derivative, cells.unknown_shift(v), everywhere])
    of_motion = len(cells.derivative)
    information = _information(derivative, np.sum([_cross(side, cells, level) for side in linearisation.sides], axis=0))
    normal = _flat(information) @ _flat(derivative).T
    if np.linalg.eigvalsh(normal[:of_motion, :of_motion])[0] <= 0:
        information = np.sum([_information(derivative, side.slopes) for side in linearisation.sides], axis=0)
        normal = _flat(information) @ _flat(derivative).T
    # exactly symmetric: sums of float32 are not, and a path refuses such covariances
    return derivative, information, (normal + normal.T) / 2


def _jackknife(
    normal: Doubles, information: Doubles, derivative: Doubles, linearisation: _Linearisation, cells: Cells
) -> Doubles:
    """Return the change of the unknowns without each of the blocks ``(n, blocks)``: the jackknife.

    Blocks that hold much of the information have small gradients, since the motion follows them.
    """
    gradients = np.sum([(derivative * side.gradients).sum(axis=1) for side in linearisation.sides], axis=0)
    of_patches = np.einsum("ikp,jkp->ijp", information, derivative)
    remaining = normal - np.moveaxis(_by_correlated_block((of_patches + np.swapaxes(of_patches, 0, 1)) / 2, cells), -1, 0)
    change = np.linalg.solve(remaining, np.moveaxis(_by_correlated_block(gradients, cells), -1, 0)[..., None])
    return np.asarray(change[..., 0].T)


def _excess(side: _ResampledPair, cells: Cells) -> Excess:
    """Return how much more the frames correlate than when displaced across the beams."""
    before, after = side.before[side.inner], side.after[side.inner]
    inside = np.ones(before.shape, dtype=bool) if cells.seen is None else cells.seen[side.inner] > 0
    return correlation_excess(before, after, inside, DISPLACED_BEAMS)


def is_resolved(bins: int, level: DirectLevel) -> bool:
    """Return whether frames with this number of bins leave enough rows at a level."""
    return bins >= FEWEST_ROWS * level.step


def smoothed(image: Floats, level: DirectLevel) -> Floats:
    """Smooth an image and keep every ``step``-th bin of the level."""
    bins, beams = level.smoothing
    if level.step == 1:
        return blurred(image, bins, beams)
    return blurred(_smoothed_rows(len(image), bins, level.step) @ image, 0, beams)


@lru_cache(maxsize=16)
def _smoothed_rows(bins: int, sigma: float, step: int) -> Floats:
    """Return the matrix that smooths bins and keeps every ``step``-th ``(rows, bins)``: only those are computed."""
    return np.ascontiguousarray(blurred(np.eye(bins, dtype=np.float32), sigma, 0)[step // 2 :: step])


class _AndersonAcceleration:
    """Anderson acceleration (1965): noise in the slopes shortens steps, and the last steps show by how much."""

    def __init__(self) -> None:
        self.places: list[Doubles] = []
        self.steps: list[Doubles] = []

    def __call__(self, place: Doubles, step: Doubles) -> Doubles:
        """Return an accelerated step; the given one if there are too few earlier steps."""
        lever = np.array([1, 1, LEVER_M, 1])[: len(step), None]
        if np.linalg.norm(lever[:, 0] * step) > ACCELERATED_STEP_M:  # long steps predict little
            return step
        self.places.append(place)
        self.steps.append(step)
        if len(self.steps) < 2:
            return step
        # extrapolate to where the remembered steps would vanish
        places, steps = (np.diff(np.array(values[-REMEMBERED_STEPS:]), axis=0).T for values in (self.places, self.steps))
        past, *_ = np.linalg.lstsq(lever * steps, lever[:, 0] * step, rcond=1e-3)
        accelerated = np.asarray(step - (places + steps) @ past)
        # limit the lengthening
        lengths = [float(np.linalg.norm(lever[:, 0] * one)) for one in (accelerated, step)]
        return accelerated if lengths[0] < LONGEST_ACCELERATION * lengths[1] else step


def _inner(displacement: Floats, usable: slice, margins: Doubles) -> tuple[slice, slice] | None:
    """Return the cells that meet the ground and stay within both images; None if there are none.

    ``margins`` are those so far ``(2,)``, which grow in place: cells that come and go would keep it from settling.
    """
    _, bins, beams = displacement.shape
    reach = np.array([max(one.max(), -one.min()) for one in displacement])
    if not np.isfinite(reach).all():
        return None
    margins[:] = np.maximum(margins, np.ceil(reach) + 1)
    widths = [int(far) for far in margins]
    start = max(widths[0], usable.start)
    if not (start + widths[0] < bins and 2 * widths[1] < beams):
        return None
    return slice(start, bins - widths[0]), slice(widths[1], beams - widths[1])


def _singular(normal: Doubles) -> bool:
    """Return whether some motion leaves the residuals unchanged."""
    size = np.sqrt(np.diag(normal))
    if not (size > 0).all():
        return True
    stretch = np.linalg.eigvalsh(normal / np.outer(size, size))
    return bool(stretch[-1] > 1e8 * stretch[0])


def _cross(side: _ResampledPair, cells: Cells, level: DirectLevel) -> Doubles:
    """Return sums of slopes of one frame times slopes of the other ``(3, patches)``, whose noise is independent.

    Outliers, whose weight falls as they grow, count with the derivative of weight times residual, which is negative: a
    motion determined by the weights is less certain than the sum of the weights suggests.
    """
    curvature = side.weight * (2 * side.weight - 1)
    (along, across), others = (central_differences(blurred(image, *level.slopes)) for image in (side.before, side.after))
    bins, beams = along * curvature, across * curvature
    products = (bins, others[0]), (bins, others[1]), (beams, others[0]), (beams, others[1])
    along_both, mixed, mixed_back, across_both = products_by_block(products, cells.patch)
    return np.stack([along_both, (mixed + mixed_back) / 2, across_both]) * side.patches


def _patch_weight(sums: Doubles) -> Doubles:
    """Return weights of patches ``(patches,)``: one whose surroundings move independently shows relief or a shadow.

    The measure is the decrease of their squared differences by their individual best shift (Lucas and Kanade, 1981).
    ``sums`` are those of slope by slope and slope by residual ``(5, rows, columns)``.
    """
    # sum over the surroundings of each patch
    around = np.array(
        [cv2.boxFilter(one, -1, SURROUNDING_PATCHES, normalize=False, borderType=cv2.BORDER_CONSTANT) for one in sums]
    )
    aa, ab, bb, gradient_a, gradient_b = around.reshape(5, -1)
    textured = aa + bb > 0
    if not textured.any():
        return np.ones(aa.shape)
    # regularise, then solve for the decrease by the best shift
    aa, bb = (one + 1e-3 * one[textured].mean() + 1e-12 for one in (aa, bb))
    decrease = (bb * gradient_a**2 - 2 * ab * gradient_a * gradient_b + aa * gradient_b**2) / (aa * bb - ab * ab)
    # compare with the usual decrease, since noise alone causes some
    return np.asarray(1 / (1 + decrease / (BLOCK_CAUCHY**2 * median_of(decrease[textured]) + 1e-12)))


def _by_correlated_block(values: Doubles, cells: Cells) -> Doubles:
    """Sum values of patches ``(..., patches)`` over the blocks whose errors are correlated ``(..., blocks)``."""
    return by_block(values.reshape(*values.shape[:-1], *cells.patches), CORRELATED_PATCHES)


# ---------------- Cells of a level


class DirectLevel(NamedTuple):
    """One level of the pyramid.

    Attributes:
        step: stride in bins.
        smoothing: standard deviations of the smoothing of the frames [bins, beams].
        slopes: further smoothing of their mean before its slopes are taken.
        iterations: largest number of iterations.
    """

    step: int
    smoothing: tuple[float, float]
    slopes: tuple[float, float]
    iterations: int


PATCH = (8, 4)
"""Bins and beams of a patch, within which the geometry is constant; sums over patches come first."""

FEWEST_PATCH_ROWS = 2
"""Smallest number of rows of a patch at a coarse level."""


class Cells:
    """The cells of one level over level ground: where they are, and how a motion displaces them, in bins and beams.

    Attributes:
        patch: rows and columns of the patches over which cells are summed.
        patches: number of patches along rows and columns.
        derivative: of the displacement of the patches' centres by motion (and heave) ``(3 or 4, 2, patches)``.
        usable: rows that meet the ground.
        seen: 1 where a cell shows ground to match, else 0 ``(bins, beams)``; None if all cells do.
        casters: in each frame, the number of the cell at which the shadow over a cell begins, else its own number
            ``(bins, beams)``; None if shadows are not known.
    """

    def __init__(self, nodes: GroundNodes, level: DirectLevel, shadows: tuple[Floats, Floats] | None = None) -> None:
        self.nodes, self.grid = nodes, cell_grid(*nodes.key, level.step)
        self.casters = None if shadows is None else tuple(_casting_cells(lengths, level.step) for lengths in shadows)
        self.row, self.column, self.patch, self.patches = self.grid.row, self.grid.column, self.grid.patch, self.grid.patches
        self.derivative = self._on_patches(nodes.derivative)
        known = nodes.known
        first = float(nodes.axes[0][int(known.any(axis=1).argmax())]) if known.any() else np.inf
        self.usable = slice(int(np.searchsorted(self.grid.range_m, first)), None)
        self.seen = self._seen(level)

    def _seen(self, level: DirectLevel) -> Floats | None:
        """Return 1 where a cell shows ground to match, else 0 ``(bins, beams)``; None if all cells do."""
        shown, masked = self.nodes.shown
        if shown[self.nodes.from_node[0].min() :].all():
            return None
        row, column = (
            np.abs(values[:, None] - nodes).argmin(axis=1)
            for values, nodes in zip((self.grid.range_m, self.grid.bearing_rad), self.nodes.axes, strict=True)
        )
        on_all = shown[row][:, column].astype(np.uint8)
        reach = [2 * int(np.ceil(2 * s / k)) + 1 for s, k in zip(level.smoothing, (level.step, 1), strict=True)]
        return np.asarray(cv2.erode(on_all, np.ones(reach, np.uint8)) if masked else on_all, dtype=np.float32)

    def _on_all(self, nodes: Doubles) -> Floats:
        """Interpolate from the nodes to all cells ``(..., 2, bins, beams)``, in bins and beams."""
        return np.asarray(self.grid.over_bins @ nodes.astype(np.float32) @ self.grid.over_beams)

    def _on_patches(self, nodes: Doubles) -> Doubles:
        """Interpolate from the nodes to the centres of the patches ``(..., 2, patches)``, in bins and beams."""
        middles = self.grid.over_rows @ nodes @ self.grid.over_columns
        return np.asarray(middles.reshape(*nodes.shape[:-2], -1))

    def shift(self, v: Doubles, *, back: bool = False) -> Floats:
        """Return the displacement of the ground of each cell ``(2, bins, beams)`` from the first frame to the second.

        It is in bins and beams. ``back``: from the second frame to the first. A translation moves shadows across the beams
        as far as the places where they begin.
        """
        nodes = self.nodes.shift(v, back=back, lift_m=0.0)
        turning = 0.0 if self.casters is None else self.nodes.shift(np.array([0, 0, *v[2:]]), back=back, lift_m=0.0)
        return self._with_shadows(nodes, nodes - turning, back)

    def derivatives(self, v: Doubles, steps: Doubles, *, back: bool) -> Floats:
        """Differentiate :meth:`shift` by motion and by the height of the ground, by central differences.

        Args:
            v: motion [m, rad] ``(3,)``.
            steps: of sideways, forward [m], yaw [rad] and height [m] ``(4,)``.
            back: from the second frame to the first.

        Returns:
            Bins and beams per metre and per radian ``(4, 2, bins, beams)``.
        """
        derivatives, turning = self._node_derivatives(v, steps, back), np.zeros(())
        if self.casters is not None:
            turning = self._node_derivatives(np.array([0, 0, v[2]]), np.array([0, 0, *steps[2:]]), back)
        return self._with_shadows(derivatives, derivatives - turning, back)

    def _node_derivatives(self, v: Doubles, steps: Doubles, back: bool) -> Doubles:
        """Differentiate the displacement of the nodes ``(4, 2, nodes, nodes)``; 0 by what has a step of 0."""
        moving = np.flatnonzero(steps[:3])
        changes = np.diag(steps[:3])[moving]
        derivatives = np.zeros((4, 2, *NODES))
        ends = self.nodes.shift(v + np.stack([changes, -changes]), back=back, lift_m=0.0)
        derivatives[moving] = (ends[0] - ends[1]) / (2 * steps[moving, None, None, None])
        above, below = (self.nodes.shift(v, back=back, lift_m=sign * float(steps[3])) for sign in (1, -1))
        derivatives[3] = (above - below) / (2 * steps[3])
        return derivatives

    def _with_shadows(self, nodes: Doubles, translation: Doubles, back: bool) -> Floats:
        """Interpolate from the nodes to the cells ``(..., 2, bins, beams)``; a translation moves what casts a shadow.

        What casts a shadow turns with it, so that only the translation counts.
        """
        shift = self._on_all(nodes)
        if self.casters is not None:
            across = self.grid.over_bins[1] @ translation[..., 1, :, :].astype(np.float32) @ self.grid.over_beams[1]
            casting = across.reshape(*across.shape[:-2], -1)[..., self.casters[int(back)]]
            shift[..., 1, :, :] += casting - across
        return shift

    def leaning_shift_of_cells(self, v: Doubles) -> list[Floats]:
        """Return the derivatives of :meth:`GroundNodes.leaning_shift`, each ``(2, bins, beams)``."""
        return [self._on_all(nodes) for nodes in self.nodes.leaning_shift(v)]

    def unknown_shift(self, v: Doubles) -> Doubles:
        """Return the derivatives of :meth:`GroundNodes.unknown_shift` at the patch centres ``(unknowns, 2, patches)``."""
        return self._on_patches(self.nodes.unknown_shift(v))


class CellGrid(NamedTuple):
    """Cells of a level and their patches, with splines from the nodes, in bins ``[0]`` and beams ``[1]``.

    ``over_bins`` and ``over_beams`` interpolate to all cells, ``over_rows`` and ``over_columns`` to the patch centres.
    """

    range_m: Doubles
    bearing_rad: Doubles
    row: Floats
    column: Floats
    over_bins: Floats
    over_beams: Floats
    patch: tuple[int, int]
    patches: tuple[int, int]
    over_rows: Doubles
    over_columns: Doubles


@lru_cache(maxsize=16)
def cell_grid(range_m: tuple[float, ...], bearing_rad: tuple[float, ...], step: int) -> CellGrid:
    """Return the grid of a level; the result is cached."""
    # cubic splines from the nodes to the cells, as matrices
    ranges, axes = np.array(range_m)[step // 2 :: step], np.array(bearing_rad)
    splines = [
        np.asarray(make_interp_spline(node, np.eye(len(node)), 3)(values))
        for node, values in zip(node_axes(np.array(range_m), axes), (ranges, axes), strict=True)
    ]
    # divide by the spacing, so that displacements come out in bins and beams
    bin_m, beam_rad = (np.gradient(values)[:, None] for values in (ranges, axes))
    over_bins = np.stack([splines[0] / bin_m, splines[0]])
    over_beams = np.stack([splines[1].T, (splines[1] / beam_rad).T])
    # patches, and the cells at their centres
    patch = max(FEWEST_PATCH_ROWS, PATCH[0] // step), PATCH[1]
    patches = cell_blocks((len(ranges), len(axes)), patch)
    rows, columns = (
        np.minimum(np.arange(count) * edge + edge // 2, size - 1)
        for count, edge, size in zip(patches, patch, (len(ranges), len(axes)), strict=True)
    )
    return CellGrid(
        ranges,
        axes,
        row=np.arange(len(ranges), dtype=np.float32)[:, None],
        column=np.arange(len(axes), dtype=np.float32)[None, :],
        over_bins=over_bins.astype(np.float32),
        over_beams=over_beams.astype(np.float32),
        patch=patch,
        patches=patches,
        over_rows=over_bins[:, rows],
        over_columns=np.ascontiguousarray(over_beams[:, :, columns]),
    )


# ---------------- Shadows
# A body casts its shadow along the beams that hit it. When the sonar moves sideways, the sides of a shadow move across the
# beams as the body does, which is nearer than the ground in its shadow. Displaced as that ground, shadows turn a sideways
# motion by 0.2 to 0.8 deg a metre.


SHADOW_LEVEL = 0.13
"""Level below which a cell lies in shadow, as a fraction of that of its surroundings."""

SHADOW_SMOOTHING = (1.0, 0.6)
SHADOW_SURROUNDINGS = (61, 25)
"""Bins and beams by which frames are smoothed, and over which the level of the surroundings is taken."""

SHADOW_SIDES, SHADOW_SIDES_CODED = 5, 9
"""Beams across which the side of a shadow is smoothed, and moves with it: hard-edged beams, and overlapping ones."""


def shadow_lengths(root: Floats, sides: int) -> Floats:
    """Measure how many bins before each cell the shadow over it begins ``(bins, beams)``; 0 outside shadows.

    Args:
        root: fourth roots of the levels of a frame ``(bins, beams)``.
        sides: :data:`SHADOW_SIDES`, or :data:`SHADOW_SIDES_CODED` for coded levels.
    """
    smooth = blurred(root, *SHADOW_SMOOTHING)
    dark = smooth < np.float32(SHADOW_LEVEL**0.25) * cv2.blur(smooth, SHADOW_SURROUNDINGS[::-1])
    rows = np.arange(len(root))[:, None]
    last_lit = np.maximum.accumulate(np.where(dark, -1, rows), axis=0)
    lengths = np.where(last_lit < 0, 0, rows - last_lit).astype(np.float32)  # nothing casts the dark before the first echo
    return np.asarray(cv2.dilate(lengths, np.ones((1, sides), np.uint8)), dtype=np.float32)


def _casting_cells(lengths: Floats, step: int) -> NDArray[np.intp]:
    """Return the number of the cell of a level whose translation across the beams each cell shares ``(bins, beams)``."""
    of_level = lengths[step // 2 :: step] / np.float32(step)
    bins, beams = of_level.shape
    row = np.maximum(np.rint(np.arange(bins)[:, None] - of_level), 0).astype(np.intp)
    return np.asarray(row * beams + np.arange(beams), dtype=np.intp)


# ---------------- Nodes on level ground


NODES = (33, 17)
"""Nodes along range and bearing."""

HEIGHT_STEP = 0.05
"""Step of the height for numerical derivatives, as a fraction of it."""


def node_axes(range_m: Doubles, bearing_rad: Doubles) -> tuple[Doubles, Doubles]:
    """Return ranges [m] and bearings [rad] of the nodes, from the first to the last cell."""
    return np.linspace(range_m[0], range_m[-1], NODES[0]), np.linspace(bearing_rad[0], bearing_rad[-1], NODES[1])


class GroundNodes:
    """The nodes of a pair of frames, shared by all levels; between them the displacement is smooth.

    Args:
        frames: frames whose axes the nodes span.
        attitude: of the sonar.
        heave: whether the derivative has a fourth component, by the sonar's height.

    Attributes:
        known: whether a node meets the ground ``(nodes, nodes)``.
        derivative: of range [m] and bearing [rad] by motion (and heave) ``(3 or 4, 2, nodes, nodes)``.
    """

    def __init__(self, frames: SonarFrames, attitude: Attitude, *, heave: bool) -> None:
        self.frames, self.attitude, self.heave = frames, attitude, heave
        self._lifted: dict[float, tuple[GroundGeometry, GroundGeometry]] = {}
        self.axes = node_axes(frames.range_m, frames.bearing_rad)
        self.ground = self._ground(None)
        self.known = np.asarray(np.isfinite(self.ground.points).all(axis=-1), dtype=bool)
        self.from_node = nearest_known(self.known)
        self.derivative = self._derivative(self.ground)

    def _ground(self, number: int | None, lift_m: float = 0.0) -> GroundGeometry:
        """Return the geometry of the nodes, for the mean pose or that of one frame, over ground raised by ``lift_m``."""
        attitude = self.attitude
        mean = attitude.height_m - lift_m, attitude.pitch_rad, attitude.roll_rad
        pose = mean if number is None else attitude.of_frame(number, lift_m)
        return GroundGeometry(*self.axes, self.frames.sonar.bearing, *pose)

    @cached_property
    def _grounds_of_frames(self) -> tuple[GroundGeometry, GroundGeometry]:
        """Return the geometry of the nodes in each frame."""
        return (self._ground(0), self._ground(1)) if self.attitude.apart else (self.ground, self.ground)

    def _lifted_grounds_of_frames(self, lift_m: float) -> tuple[GroundGeometry, GroundGeometry]:
        """Return the geometry of the nodes in each frame over ground that is higher, and keep it: levels share it."""
        if lift_m not in self._lifted:
            one, other = (replace(ground, height_m=ground.height_m - lift_m) for ground in self._grounds_of_frames)
            self._lifted[lift_m] = one, other
        return self._lifted[lift_m]

    @cached_property
    def _source_nodes_of_frames(self) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """Return, for each frame, the nodes from which its nodes take their values."""
        if not self.attitude.apart:
            return [self.from_node, self.from_node]
        return [nearest_known(np.asarray(np.isfinite(one.points).all(axis=-1))) for one in self._grounds_of_frames]

    def _derivative(self, ground: GroundGeometry) -> Doubles:
        """Return the derivative by motion (and heave), from the nearest valid node where a node meets no ground."""
        nodes = np.moveaxis(ground.derivative, (3, 2), (0, 1))
        if self.heave:
            nodes = np.concatenate([nodes, np.moveaxis(ground.derivative_by_height, 2, 0)[None]])
        return np.nan_to_num(nodes[:, :, self.from_node[0], self.from_node[1]])

    @cached_property
    def shown(self) -> tuple[NDArray[np.bool_], bool]:
        """Return which nodes show ground to match ``(nodes, nodes)``, and whether the outline of the light is masked.

        See :func:`mitsonar.geometry.ground.lit_margin`.
        """
        margin = lit_margin(self.ground, self.attitude, self.frames.sonar.elevation_fov_deg)
        return (self.known, False) if margin is None else (self.known & (margin >= 0), True)

    @cached_property
    def key(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return ranges and bearings of the frames' cells, as a cache key."""
        return tuple(self.frames.range_m.tolist()), tuple(self.frames.bearing_rad.tolist())

    def shift(self, v: Doubles, *, back: bool, lift_m: float) -> Doubles:
        """Return the displacement of the nodes in range [m] and bearing [rad] ``(..., 2, nodes, nodes)``.

        Args:
            v: motions [m, rad] ``(..., 3)``, or one with heave [m] ``(4,)``.
            back: from the second frame to the first, see :meth:`Cells.shift`.
            lift_m: how much higher the ground is [m].
        """
        grounds = self._lifted_grounds_of_frames(lift_m) if lift_m else self._grounds_of_frames
        ground, other_ground = grounds[:: -1 if back else 1]
        if self.heave:
            half = float(v[3]) / (2 if back else -2)
            ground, other_ground = (
                replace(ground, height_m=ground.height_m + half),
                replace(other_ground, height_m=other_ground.height_m - half),
            )
        nodes = self._between(ground, other_ground, inverse(v[..., :3]) if back else v[..., :3])
        # a cell that meets level ground may not meet ground that lies lower
        known = self._source_nodes_of_frames[int(back)]
        row, column = nearest_known(np.asarray(np.isfinite(nodes).all(axis=0), dtype=bool)) if lift_m else known
        return np.asarray(nodes[..., row, column], dtype=np.float64)

    def _between(self, ground: GroundGeometry, other_ground: GroundGeometry, motion: Doubles) -> Doubles:
        """Return the displacement of one frame's ground nodes in another ``(..., 2, nodes, nodes)``; nan off the ground."""
        radius, bearing = other_ground.to_polar(moved(ground.points, motion[..., None, None, :]))
        return np.stack([radius - self.axes[0][:, None], bearing - self.axes[1]], axis=-3)

    def leaning_shift(self, v: Doubles) -> Doubles:
        """Return the derivative of :meth:`shift` by the excess of height, pitch and roll of the second frame.

        Returns:
            Ranges [m] and bearings [rad] per metre of height and per radian of pitch and of roll, then per radian of pitch
            and of roll of both frames ``(5, 2, nodes, nodes)``.
        """
        row, column = self._source_nodes_of_frames[0]
        return np.nan_to_num(lean_derivative(*self._grounds_of_frames, v[:3])[:, :, row, column])

    def unknown_shift(self, v: Doubles) -> Doubles:
        """Return the change of :meth:`shift` by one standard deviation of all that is uncertain.

        Returns:
            For a higher sonar, and a surface that rises forward and to starboard about the middle of the view; and where the
            attitude is uncertain, for :meth:`leaning_shift`: ranges [m] and bearings [rad] ``(3 or 8, 2, nodes, nodes)``.
        """
        lifted, points = self.lifted_shift(v), self.ground.points[self.from_node]
        starboard, forward = points[..., 0], points[..., 1]
        forward = forward - np.median(forward)  # the height is that over the middle of the view
        rises = self.attitude.height_std_m, SURFACE_SLOPE_STD * forward, SURFACE_SLOPE_STD * starboard
        surface = np.stack([lifted * rise for rise in rises])
        if not any(self.attitude.unsure):
            return np.asarray(np.nan_to_num(surface))
        std = self.attitude.lean_std * ([0, 1, 1, 1, 1] if self.heave else 1)
        return np.asarray(np.nan_to_num(np.concatenate([surface, self.leaning_shift(v) * std[:, None, None, None]])))

    def lifted_shift(self, v: Doubles) -> Doubles:
        """Return the derivative of :meth:`shift` by the height [m/m, rad/m]."""
        change = HEIGHT_STEP * self.attitude.height_m
        higher, lower = (self.shift(v, back=False, lift_m=lift_m) for lift_m in (-change, change))
        return (higher - lower) / (2 * change)


# ---------------- Sums over blocks of cells


def cell_blocks(shape: tuple[int, ...], block: tuple[int, int]) -> tuple[int, int]:
    """Return the number of blocks along bins and beams; the last block includes the cells beyond it."""
    return max(shape[-2] // block[0], 1), max(shape[-1] // block[1], 1)


def by_block(maps: NDArray[np.floating], block: tuple[int, int]) -> NDArray[np.float64]:
    """Sum maps ``(..., bins, beams)`` over blocks ``(..., blocks)``."""
    means = [_means(one, block) for one in maps.reshape(-1, *maps.shape[-2:])]
    return _sums(means, cell_blocks(maps.shape, block), block).reshape(*maps.shape[:-2], -1)


def products_by_block(pairs: Sequence[tuple[Floats, Floats]], block: tuple[int, int]) -> NDArray[np.float64]:
    """Sum products of two maps ``(bins, beams)`` over blocks ``(pairs, blocks)``."""
    shape = pairs[0][0].shape
    product = np.empty(shape, dtype=np.float32)  # one buffer for all products stays in the processor's cache
    return _sums([_means(np.multiply(*pair, out=product), block) for pair in pairs], cell_blocks(shape, block), block)


def _means(values: NDArray[np.floating], block: tuple[int, int]) -> NDArray[np.floating]:
    """Average a map ``(bins, beams)`` over blocks ``(rows, columns)``; incomplete blocks are padded with zeros."""
    over = [-(-size // edge) for size, edge in zip(values.shape, block, strict=True)]
    missing = [(0, count * edge - size) for count, edge, size in zip(over, block, values.shape, strict=True)]
    if any(after for _, after in missing):
        values = np.pad(values, missing)
    # OpenCV takes a third of the time of np.add.reduceat
    return np.asarray(cv2.resize(values, over[::-1], interpolation=cv2.INTER_AREA), dtype=values.dtype)


def _sums(means: list[NDArray[np.floating]], blocks: tuple[int, int], block: tuple[int, int]) -> NDArray[np.float64]:
    """Sum over blocks from their means ``(maps, blocks)``; the last block includes the cells beyond it."""
    sums = np.multiply(means, block[0] * block[1], dtype=np.float64)
    rows, columns = blocks
    if sums.shape[1:] != blocks:
        sums[:, rows - 1] += sums[:, rows:].sum(axis=1)
        sums[:, :, columns - 1] += sums[:, :, columns:].sum(axis=2)
    return np.asarray(sums[:, :rows, :columns].reshape(len(means), -1), dtype=np.float64)


def on_cells(table: NDArray[np.float64], shape: tuple[int, ...], block: tuple[int, int]) -> Floats:
    """Interpolate values of blocks ``(rows, columns)`` linearly to cells of this shape ``(bins, beams)``."""
    row, column = (
        ((np.arange(size) + 0.5) / edge - 0.5).astype(np.float32) for size, edge in zip(shape, block, strict=True)
    )
    column, row = (np.ascontiguousarray(axis) for axis in np.broadcast_arrays(column[None], row[:, None]))
    interpolated = cv2.remap(table.astype(np.float32), column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(interpolated, dtype=np.float32)


# ---------------- Smoothing, interpolation and slopes


FAINTEST = 0.02
"""Residuals of this size are never outliers: ray patterns and interpolation reach it without any noise."""

NEIGHBOURS = (3, 7)
"""Beams and bins within which the variance of the image is compared with the noise (Wiener's filter)."""


def blurred(image: Floats, bins: float, beams: float) -> Floats:
    """Smooth an image ``(bins, beams)`` by a Gaussian of these standard deviations [bins, beams]; 0, 0: no smoothing."""
    if not bins and not beams:
        return image
    size = tuple(2 * int(np.ceil(3 * sigma)) + 1 for sigma in (beams, bins))
    smallest_sigma = 1e-3  # OpenCV replaces 0 by the other sigma
    return np.asarray(
        cv2.GaussianBlur(
            image, size, sigmaX=max(beams, smallest_sigma), sigmaY=max(bins, smallest_sigma), borderType=cv2.BORDER_REPLICATE
        )
    )


def sampled(image: Floats, row: Floats, column: Floats) -> Floats:
    """Interpolate an image bilinearly between pixels."""
    return np.asarray(cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def slopes_of(image: Floats, level: DirectLevel, scale: float, *, like: Floats | None = None) -> tuple[Floats, Floats]:
    """Return central differences over bins and beams of the denoised image (Wiener's filter).

    ``scale`` is the standard deviation of a difference of two frames; their mean has half of it. ``like``: the mean of both
    frames, by which one of them is denoised.
    """
    smooth = blurred(image, *level.slopes)
    if scale > FAINTEST:
        shown = smooth if like is None else blurred(like, *level.slopes)
        mean = cv2.blur(shown, NEIGHBOURS)
        variance = cv2.blur(shown * shown, NEIGHBOURS) - mean * mean
        wiener_gain = np.maximum(0, 1 - np.float32(2 * (scale / 2) ** 2) / np.maximum(variance, np.float32(1e-9)))
        mean = mean if like is None else cv2.blur(smooth, NEIGHBOURS)
        smooth = mean + (smooth - mean) * wiener_gain
    return central_differences(smooth)


DIFFERENCE_KERNEL = np.array([-0.5, 0.0, 0.5], dtype=np.float32)
UNIT_KERNEL = np.ones(1, dtype=np.float32)


def central_differences(image: Floats) -> tuple[Floats, Floats]:
    """Return central differences over bins and over beams."""
    by_bin = cv2.sepFilter2D(image, -1, UNIT_KERNEL, DIFFERENCE_KERNEL, borderType=cv2.BORDER_REPLICATE)
    by_beam = cv2.sepFilter2D(image, -1, DIFFERENCE_KERNEL, UNIT_KERNEL, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(by_bin, dtype=np.float32), np.asarray(by_beam, dtype=np.float32)
