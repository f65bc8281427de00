"""Which cells of a fan of rays contain mirrors that are narrower than a few of its columns.

Rays may pass by such mirrors, so a launch that compares neighbouring rays does not find them. Their triangles are projected
into the fan instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.simulation.beams import CommonFan
from mitsonar.simulation.mirrors import Mirrors
from mitsonar.simulation.shape_pieces import COLUMNS, pieces_of, sphere_and_width, triangles_of

__all__ = ["NarrowMirrors"]

MOST_SAMPLES = 128
"""Largest number of samples along the side of a triangle."""


@dataclass(frozen=True)
class NarrowMirrors:
    """Connected pieces of a scene's mirrors; those of shapes without a mesh are boxes around them.

    Attributes:
        names: id of the shape of each piece.
        centre, radius: sphere around each piece ``(pieces, 3)``, ``(pieces,)`` [m].
        width: second of three extents of each piece along its principal axes ``(pieces,)`` [m].
        corners: corners of all triangles ``(triangles, 3, 3)`` [m].
        piece: index of the piece of each triangle ``(triangles,)``.
    """

    names: list[str]
    centre: NDArray[np.float64]
    radius: NDArray[np.float64]
    width: NDArray[np.float64]
    corners: NDArray[np.float64]
    piece: NDArray[np.int64]

    @classmethod
    def from_scene(cls, scene: mi.Scene, mirrors: Mirrors) -> NarrowMirrors:
        """Find the pieces of a scene's mirrors."""
        names: list[str] = []
        parts: list[NDArray[np.float64]] = []
        for shape, reflection in zip(scene.shapes(), mirrors.reflection, strict=True):
            if reflection != 0:
                pieces = pieces_of(triangles_of(shape))
                names += [shape.id()] * len(pieces)
                parts += pieces
        spheres = [sphere_and_width(part) for part in parts]
        return cls(
            names,
            np.array([centre for centre, _, _ in spheres]).reshape(-1, 3),
            np.array([radius for _, radius, _ in spheres]),
            np.array([width for _, _, width in spheres]),
            np.concatenate([np.empty((0, 3, 3)), *parts]),
            np.repeat(np.arange(len(parts)), [len(part) for part in parts]),
        )

    def cells(
        self, fan: CommonFan, lines: NDArray[np.float64], *, cone: bool, finest: int
    ) -> tuple[NDArray[np.int64], list[str]]:
        """Return columns and rows of the cells that narrow mirrors may cover, and the names of the narrowest mirrors.

        Args:
            fan: fan of the rays.
            lines: first three rows of the sonar's ``to_world`` ``(3, 4)``.
            cone: whether bearings are cones.
            finest: largest number of parts of a cell in each direction.

        Returns:
            Columns and rows ``(cells, 2)``, and the ids of shapes in the fan that are narrower than four of the
            finest parts.
        """
        # 1. Pieces that are narrow from here.
        step = np.array([2 * fan.sine / fan.columns, 2 * fan.tangent / fan.rows])
        apart = np.linalg.norm(self.centre - lines[:, 3], axis=1)
        cell = step.max() * np.maximum(apart - self.radius, 0)
        narrow = self.width < COLUMNS * cell
        if not narrow.any():
            return np.empty((0, 2), dtype=np.int64), []
        # 2. Corners of their triangles in cells of the fan; those behind the sonar are left out.
        chosen = narrow[self.piece]
        piece = self.piece[chosen]
        port, up, forward = np.moveaxis((self.corners[chosen] - lines[:, 3]) @ lines[:, :3], -1, 0)
        level, whole = np.hypot(port, forward), np.sqrt(port**2 + up**2 + forward**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            place = np.stack([-port / (whole if cone else level), -up / (forward if cone else level)], axis=-1)
        place = (place + np.array([fan.sine, fan.tangent])) / step
        size = np.array([fan.columns, fan.rows])
        low, high = place.min(axis=1), place.max(axis=1)
        with np.errstate(invalid="ignore"):
            inside = (forward > 0).all(axis=1) & (high > -1).all(axis=1) & (low < size + 1).all(axis=1)
        place, piece = place[inside], piece[inside]
        # 3. Cells of points on the triangles at most a cell apart, and their neighbours.
        samples = 2 ** np.ceil(np.log2(np.clip((high - low)[inside].max(axis=1, initial=0.0), 1, MOST_SAMPLES))).astype(int)
        covered = [np.empty((0, 2), dtype=np.int64)]
        for count in np.unique(samples):
            weight = np.array([(i, j, count - i - j) for i in range(count + 1) for j in range(count + 1 - i)]) / count
            cells = np.floor(np.einsum("sc,tcd->tsd", weight, place[samples == count])).astype(np.int64)
            covered.append(np.unique(cells.reshape(-1, 2), axis=0))
        around = np.array([(over, down) for over in (-1, 0, 1) for down in (-1, 0, 1)])
        cells = np.unique((np.concatenate(covered)[:, None] + around).reshape(-1, 2), axis=0)
        hidden = self.width[piece] < COLUMNS * cell[piece] / finest
        return cells[((cells >= 0) & (cells < size)).all(axis=1)], sorted({self.names[k] for k in piece[hidden]})
