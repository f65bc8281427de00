"""The estimator ``direct``: photometric Gauss-Newton in native polar coordinates, over level ground.

The ground that a cell of one frame shows, the other frame shows where the exact geometry of the motion takes it. Each frame
is drawn at the cells of the other, and both differences are used: a texture finer than a beam pulls the answer towards
whole and half beams where both frames are interpolated at once. The slopes of the mean of both, as far as they rise over the
noise, turn differences into motion. Single differences, and whole blocks that want to move by themselves, are weighed by
Cauchy's law: shadow edges and relief are outliers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
from mitsonar.estimation.image.direct_cells import Cells, DirectLevel
from mitsonar.estimation.image.image_slopes import FAINTEST, blurred, central_differences, sampled, slopes_of
from mitsonar.geometry.attitude import attitude_of
from mitsonar.motion.composition import Motion
from mitsonar.records.sonar_frames import SonarFrames

__all__ = ["Direct"]

Floats = NDArray[np.float32]

LEVELS = (
    DirectLevel(8, (16.0, 4.0), (0.0, 0.0), 10),
    DirectLevel(4, (6.0, 1.5), (0.0, 0.0), 8),
    DirectLevel(1, (0.7, 0.5), (0.6, 0.4), 24),
)

STILL = np.array([3e-5, 3e-5, 6e-6])
"""Steps below which an iteration ends [m, m, rad]."""

CAUCHY = 3.0
"""Residuals of so many standard deviations have half the weight."""

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
            cells = Cells(frames, attitude, level, heave=bool(self.heave_std_m))
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
        self, first: Floats, second: Floats, cells: Cells, start: NDArray[np.float64], level: DirectLevel, *, last: bool
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
    first: Floats, second: Floats, cells: Cells, v: NDArray[np.float64], level: DirectLevel, *, last: bool
) -> _Look | None:
    """The second frame drawn at the first's cells, at last also the other way; None where too little remains to compare."""
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
        if last:
            weight = weight * _block_weight(slopes, residual, weight, inner)
        jacobian = cells.along(slopes, inner)
        sides.append(_Side(before, after, inner, slopes, residual, jacobian, weight, jacobian * weight))
    normal = np.asarray(sum(side.weighted @ side.jacobian.T for side in sides), dtype=np.float64)
    pull = np.asarray(sum(side.weighted @ side.residual for side in sides), dtype=np.float64)
    return None if _singular(normal) else _Look(sides, scale, normal, pull)


def _fit(
    look: _Look, cells: Cells, v: NDArray[np.float64], level: DirectLevel, held: NDArray[np.float64], converged: bool
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


def _smoothed(image: Floats, level: DirectLevel) -> Floats:
    """Every so many bins of the smoothed image."""
    smooth = blurred(image, *level.smoothing)
    return np.ascontiguousarray(smooth[level.step // 2 :: level.step])


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


def _cross(side: _Side, cells: Cells, level: DirectLevel) -> NDArray[np.float64]:
    """The normal matrix from slopes of one frame times slopes of the other, whose noise is not the same."""
    frames = (side.before, side.after)
    one, other = (cells.along(central_differences(blurred(image, *level.slopes)), side.inner) for image in frames)
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
