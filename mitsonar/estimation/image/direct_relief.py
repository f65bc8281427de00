"""Registration of far motions over relief: the height of each block of ground is estimated together with the motion.

A rock of 0.3 m, seen from 2.5 m, moves by 10 % less or more than level ground: 20 mm of a motion of 200 mm. Over motions of
20 mm that is lost among the bins, over far ones it is most of the error. Each block of cells has a height of its own, with a
Gaussian prior; the heights are eliminated block by block (Schur complement), so that a step costs as much as one without.
Cells are left out one by one where the other frame does not show them: a turn of 6 deg hides a fifth of a narrow fan.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.estimation.estimator import correlation_of, spread_of
from mitsonar.estimation.image.direct_blocks import by_block, cell_blocks, on_cells, products_by_block
from mitsonar.estimation.image.direct_cells import Cells, DirectLevel
from mitsonar.estimation.image.direct_nodes import GroundNodes
from mitsonar.estimation.image.direct_registration import (
    FEWEST_CELLS,
    Fit,
    alike_cells,
    cauchy,
    is_resolved,
    noise_of,
    smoothed,
)
from mitsonar.estimation.image.image_slopes import blurred, sampled, slopes_of
from mitsonar.geometry.ground import Attitude
from mitsonar.records.frames import SonarFrames

__all__ = ["registered_over_relief"]

Floats = NDArray[np.float32]
Pair = tuple[Floats, Floats]

RELIEF_LEVELS = (
    DirectLevel(4, (6.0, 1.5), (0.0, 0.0), 6),
    DirectLevel(2, (2.0, 0.8), (0.0, 0.0), 6),
    DirectLevel(1, (0.4, 0.3), (0.5, 0.4), 12),
)
"""Coarse to fine: the first reaches 50 mm and 1 deg from the start; the last is finer than that of near motions."""

RELIEF_BLOCK = (32, 12)
"""Bins and beams that share one height."""

RELIEF_STD = 0.048
"""Standard deviation of a block's height, as part of the sonar's: 0.12 m at 2.5 m."""

ILLUMINATION = (12.0, 4.0)
"""Bins and beams beyond which brightness belongs to the sonar, which moves, and not to the ground."""

ALIKE = 20.0
"""Residuals that count as one: those of a block err together where its ground is not as the model has it."""

SETTLED = np.array([3e-4, 3e-4, 6e-5])
"""Steps below which an iteration ends [m, m, rad]: a fifth of what is left over relief."""

TALLEST_STEP = 0.06
"""Largest change of a height in one iteration, as part of the sonar's."""

SMALL = (2e-3, 2e-3, 5e-4, 0.04)
"""Steps of numerical derivatives [m, m, rad], and of the height as part of the sonar's: 0.1 m at 2.5 m."""


class _Equations(NamedTuple):
    """Normal equations of motion and heights: of the motion ``(3, 3)``, of both ``(3, blocks)``, of each block's height
    ``(blocks,)``; what pulls the motion, by block ``(3, blocks)``, and each height ``(blocks,)``."""

    normal: NDArray[np.float64]
    both: NDArray[np.float64]
    height: NDArray[np.float64]
    pulls: NDArray[np.float64]
    height_pull: NDArray[np.float64]
    noise: float
    correlation: float
    cells: int

    def without_heights(self, prior: float, off: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the normal matrix ``(3, 3)`` and pull ``(3,)`` of the motion alone.

        Args:
            prior: information of each height [1/m^2].
            off: heights less their prior mean ``(blocks,)`` [m].
        """
        held = self.height + self.noise * prior
        return self.normal - (self.both / held) @ self.both.T, self.pulls_alone(prior, off).sum(axis=1)

    def pulls_alone(self, prior: float, off: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what each block pulls the motion by, its height eliminated ``(3, blocks)``; see :meth:`without_heights`."""
        pulled = (self.height_pull + self.noise * prior * off) / (self.height + self.noise * prior)
        return self.pulls - self.both * pulled


class _Drawn(NamedTuple):
    """One frame drawn at the cells of the other, each ``(bins, beams)``: levels before and after, which cells count, slopes
    over bins and beams, derivatives of the residual by motion and height, the same with weights ``(4, bins, beams)``, noise.

    ``shown`` is the row and column of each cell in the frame of the blocks; None: that is this frame.
    """

    before: Floats
    after: Floats
    inside: NDArray[np.bool_]
    slopes: tuple[Floats, Floats]
    jacobian: Floats
    weighted: Floats
    scale: float
    shown: tuple[Floats, Floats] | None


class _ReliefLevel:
    """One level: its frames and cells, and derivatives at the motion with which it begins."""

    def __init__(self, images: Pair, nodes: GroundNodes, v: NDArray[np.float64], level: DirectLevel) -> None:
        self.level = level
        self.nodes, self.cells = nodes, Cells(nodes, level)
        slow = ILLUMINATION[0] / level.step, ILLUMINATION[1]
        self.images = tuple(one - blurred(one, *slow) for one in (smoothed(image, level) for image in images))
        self.shape = self.images[0].shape
        self.block = max(1, RELIEF_BLOCK[0] // level.step), RELIEF_BLOCK[1]
        self.blocks = cell_blocks(self.shape, self.block)
        self.sides = [self._derivatives(v, back=back) for back in (False, True)]
        self.mean = self._mean(nodes.frames, nodes.attitude)

    def _derivatives(self, v: NDArray[np.float64], *, back: bool) -> Floats:
        """Return the derivatives of the displacement by motion and height ``(4, 2, bins, beams)``."""
        found = []
        steps = *SMALL[:3], SMALL[3] * self.nodes.attitude.height_m
        for k, small in enumerate(steps):
            change = np.zeros(4)
            change[k] = small
            ahead, behind = (
                self.cells.shift(v + sign * change[:3], back=back, lift_m=sign * float(change[3])) for sign in (1, -1)
            )
            found.append((ahead - behind) / np.float32(2 * small))
        return np.stack(found)

    def _mean(self, frames: SonarFrames, attitude: Attitude) -> NDArray[np.float64]:
        """Return the prior mean of the heights ``(blocks,)`` [m]: level ground, as far as the fan lights it.

        What answers before the fan meets level ground is above it, and what answers beyond is below.
        """
        half = np.radians(frames.sonar.elevation_fov_deg) / 2
        middle = by_block(self.cells.grid.range_m[:, None], (self.block[0], 1)) / by_block(
            np.ones((self.shape[0], 1)), (self.block[0], 1)
        )
        low, high = (attitude.height_m - middle * np.sin(attitude.pitch_rad + sign * half) for sign in (1, -1))
        return np.repeat(np.clip(0.0, low, np.maximum(low, high)), self.blocks[1])

    def equations(self, v: NDArray[np.float64], heights: NDArray[np.float64]) -> _Equations | None:
        """Return the normal equations at a motion and heights; None where too few cells remain."""
        sides = self._drawn(v, heights)
        if sides is None:
            return None
        one = sides[0]
        summed = (self._summed(side, side.after - side.before) for side in sides)
        total = np.sum(list(summed), axis=0)  # motion by motion and by residual, height by motion, by itself and by residual
        by_motion, both, height = total[:12].reshape(3, 4, -1), total[12:15], total[15:]
        correlation = correlation_of(one.before[one.inside], one.after[one.inside])
        normal, pulls = by_motion[:, :3].sum(axis=-1), by_motion[:, 3]
        return _Equations(
            normal, both, height[0], pulls, height[1], ALIKE * one.scale**2, correlation, int(one.inside.sum())
        )

    def pulls_by_lean(self, v: NDArray[np.float64], heights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of the pulls of motion and heights by how the frames lean ``(3, 4, blocks)``."""
        sides, shifts = self._drawn(v, heights), self.cells.leaning_shift_of_cells(v)
        assert sides is not None
        sums = [
            np.sum([self._summed(side, side.slopes[0] * bins + side.slopes[1] * beams) for side in sides], axis=0)
            for bins, beams in shifts
        ]
        return np.stack(sums)[:, [3, 7, 11, 16]]

    def _drawn(self, v: NDArray[np.float64], heights: NDArray[np.float64]) -> list[_Drawn] | None:
        """Return each frame drawn at the cells of the other; None where too few cells remain."""
        relief = on_cells(heights.reshape(self.blocks), self.shape, self.block)
        scale, found = 0.0, []
        for back, derivatives in zip((False, True), self.sides, strict=True):
            level_shift = self.cells.shift(v, back=back)
            lift = relief if not back else sampled(relief, *self._places(level_shift))
            row, column = self._places(level_shift + derivatives[3] * lift)
            inside = self._inside(row, column)
            if inside.sum() < FEWEST_CELLS:
                return None
            drawn = sampled(self.images[0 if back else 1], row, column)
            before, after = (drawn, self.images[1]) if back else (self.images[0], drawn)
            residual = after - before
            if not back:
                scale = noise_of(residual[inside][::5])
            weight = cauchy(residual, scale) * inside
            slopes = slopes_of((before + after) * np.float32(0.5), self.level, scale)
            jacobian = (slopes[0] * derivatives[:, 0] + slopes[1] * derivatives[:, 1]) * np.float32(-1 if back else 1)
            shown = self._places(level_shift) if back else None  # heights are those of the first frame's blocks
            found.append(_Drawn(before, after, inside, slopes, jacobian, jacobian * weight, scale, shown))
        return found

    def _summed(self, side: _Drawn, residual: Floats) -> NDArray[np.float64]:
        """Return sums over blocks ``(17, blocks)``: motion by motion, motion by residual, height by all."""
        jacobian, weighted, shown = side.jacobian, side.weighted, side.shown
        pairs = [(weighted[k], other) for k in range(3) for other in jacobian[k:3]]  # the rest is symmetric
        pairs += [(weighted[k], residual) for k in range(3)]
        pairs += [(weighted[3], other) for other in (*jacobian, residual)]
        if shown is None:
            sums = products_by_block(pairs, self.block)
        else:
            place = [
                np.clip(where // edge, 0, count - 1).astype(np.intp)
                for where, edge, count in zip(shown, self.block, self.blocks, strict=True)
            ]
            number = (place[0] * self.blocks[1] + place[1]).ravel()
            count = self.blocks[0] * self.blocks[1]
            sums = np.stack([np.bincount(number, (a * b).ravel(), minlength=count) for a, b in pairs])
        return np.asarray(sums[[0, 1, 2, 6, 1, 3, 4, 7, 2, 4, 5, 8, *range(9, 14)]])

    def _places(self, shift: Floats) -> tuple[Floats, Floats]:
        """Return rows and columns of displaced cells."""
        return self.cells.row + shift[0], self.cells.column + shift[1]

    def _inside(self, row: Floats, column: Floats) -> NDArray[np.bool_]:
        """Return which cells meet ground that both frames show ``(bins, beams)``."""
        bins, beams = self.shape
        inside = (row >= 1) & (row <= bins - 2) & (column >= 1) & (column <= beams - 2)
        inside[: max(1, self.cells.usable.start)] = False
        inside[-1], inside[:, 0], inside[:, -1] = False, False, False
        return inside if self.cells.seen is None else np.asarray(inside & (self.cells.seen > 0), dtype=np.bool_)


def registered_over_relief(
    images: Pair, frames: SonarFrames, attitude: Attitude, start: NDArray[np.float64]
) -> tuple[NDArray[np.float64], Fit] | None:
    """Register two frames from a start that is near the motion; None where there is nothing to match.

    Args:
        images: both frames ``(bins, beams)`` in 0..1.
        frames: the same, with their axes.
        attitude: of the sonar; its height is that over the mean of what is seen.
        start: sideways, forward [m], yaw [rad] ``(3,)``.

    Returns:
        The motion ``(3,)`` and its fit, whose derivative by the height is that by the mean of the heights.
    """
    v, heights, shape = np.asarray(start, dtype=np.float64), None, (0, 0)
    prior = 1 / (RELIEF_STD * attitude.height_m) ** 2
    found, converged = None, False
    nodes = GroundNodes(frames, attitude, heave=False)
    for number, level in enumerate(RELIEF_LEVELS):
        if number + 1 < len(RELIEF_LEVELS) and not is_resolved(len(images[0]), level):
            continue
        at = _ReliefLevel(images, nodes, v, level)
        if heights is not None:
            table = heights.reshape(shape).astype(np.float32)
            heights = cv2.resize(table, at.blocks[::-1]).ravel().astype(np.float64)
        heights, shape = at.mean.copy() if heights is None else np.asarray(heights), at.blocks
        for _ in range(level.iterations):
            found = at.equations(v, heights)
            if found is None:
                return None
            normal, pull = found.without_heights(prior, heights - at.mean)
            if np.linalg.eigvalsh(normal)[0] <= 0:
                return None
            step = -np.linalg.solve(normal, pull)
            held = found.height + found.noise * prior
            change = -(found.height_pull + found.noise * prior * (heights - at.mean) + found.both.T @ step) / held
            most = TALLEST_STEP * attitude.height_m
            v, heights = v + step, heights + np.clip(change, -most, most)
            converged = bool((np.abs(step) < SETTLED).all())
            if converged:
                break
    assert found is not None
    assert heights is not None
    leaning = at.pulls_by_lean(v, heights) if any(attitude.unsure) else None
    return v, _assessed(found, prior, heights - at.mean, level, leaning, converged=converged)


def _assessed(
    found: _Equations,
    prior: float,
    off: NDArray[np.float64],
    level: DirectLevel,
    leaning: NDArray[np.float64] | None,
    *,
    converged: bool,
) -> Fit:
    """Return the covariance, and how the motion depends on the mean height and on how the frames lean.

    The covariance is that of the blocks' pulls, which hold whatever errs together within a block: noise, speckle, relief.
    """
    normal, _ = found.without_heights(prior, off)
    undone = np.linalg.inv(normal)
    held = found.noise * prior
    each = undone @ found.pulls_alone(prior, off)
    by_lean = np.zeros((3, 3))
    if leaning is not None:
        alone = leaning[:, :3] - found.both * (leaning[:, 3:] / (found.height + held))
        by_lean = undone @ alone.sum(axis=-1).T
    return Fit(
        converged=converged,
        covariance=np.asarray(each @ each.T, dtype=np.float64),
        by_height=undone @ (found.both @ (held / (found.height + held))),
        by_lean=by_lean,
        correlation=found.correlation,
        independent=found.cells / alike_cells(level),
        blocks=spread_of(found.height),
    )
