"""The world ``flat-objects``: thin rectangles and ellipses on a flat seabed of random cells."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mitsonar.worlds.shapes import cylinder, place, slab
from mitsonar.worlds.world import (
    BuiltFamily,
    Counts,
    Floor,
    Interval,
    Mesh,
    Standpoint,
    World,
    draw,
    stream,
    whole,
)

__all__ = ["FlatObjects"]

STEP_M = 5e-6
"""Height difference of objects that overlap [m]: of two at one height the ray tracer would hit either at random."""


class FlatObjects(BuiltFamily):
    """Almost flat objects on a seabed (Almanza-Medina, 5.4.1), anywhere on it, each of one reflectivity."""

    called: ClassVar[str] = "flat-objects"

    size_m: float = Field(50.0, gt=0, le=10_000, description="edge of the square field [m]")
    seabed_cells: int = Field(2048, ge=1, le=2**20, description="cells along the seabed's edge")
    seabed_reflectivity: Interval = Field((0.0, 1.0), description="uniform reflectivity of a cell")
    objects: Counts = Field((2000, 5000), description="number of rectangles, drawn; ellipses likewise")
    rectangles: int | None = Field(None, ge=0, le=10**6, description="rectangles, instead of a draw")
    ellipses: int | None = Field(None, ge=0, le=10**6, description="ellipses, instead of a draw")
    thickness_m: float = Field(
        0.001, gt=0, le=100, description="height over the seabed [m]; 0.1 in one test of Almanza-Medina"
    )
    side_m: Interval = Field((0.2, 1.0), description="length and width [m]")
    object_reflectivity: Interval = Field((0.0, 1.0), description="uniform reflectivity of an object")

    @property
    def half_m(self) -> float:
        """Return half the edge of the field [m]."""
        return self.size_m / 2

    def build(self, seed: int) -> World:
        """Build the field of a seed."""
        kinds = (("rectangles", slab(), self.rectangles), ("ellipses", cylinder(24, 1), self.ellipses))
        streams = [stream(seed, 1, number) for number in range(len(kinds))]
        counts = [whole(rng, self.objects) if kind[2] is None else kind[2] for rng, kind in zip(streams, kinds, strict=True)]
        places = [draw(rng, (-self.half_m, self.half_m), n, 2) for rng, n in zip(streams, counts, strict=True)]
        sides = [draw(rng, self.side_m, n, 2) for rng, n in zip(streams, counts, strict=True)]
        height = self.thickness_m + STEP_M * _levels(np.concatenate(places), np.concatenate(sides))
        meshes: list[Mesh] = []
        ends = np.cumsum(counts)
        for (name, shape, _), rng, count, end, middle, side in zip(kinds, streams, counts, ends, places, sides, strict=True):
            if count > 0:
                tall = height[end - count : end]
                turn = Rotation.from_euler("z", draw(rng, (0, np.pi), count, 1))
                placed = place(shape, np.column_stack([side, tall]), turn, np.column_stack([middle, tall / 2]))
                reflectivity = draw(rng, self.object_reflectivity, count)[placed.number]
                meshes.append(Mesh(name, placed.vertices, placed.faces, reflectivity, 1 + end - count + placed.number))
        return World(
            about=f"flat-objects, seed {seed}: {counts[0]} rectangles, {counts[1]} ellipses on "
            f"{self.size_m:g} x {self.size_m:g} m",
            meshes=meshes,
            stand=Standpoint((0, -3.5, 2.5), (0, -3.5 + 2.5 / np.tan(np.radians(35)), 0)),
            floor=Floor(self.half_m, Floor.cells(self.seabed_cells, self.seabed_reflectivity, seed)),
            surface=self.surface,
        )


def _levels(middle: NDArray[np.float64], side: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the lowest level of each object that differs from the levels of all objects that it may overlap ``(n,)``."""
    radius = np.hypot(*side.T) / 2
    level = np.zeros(len(middle), dtype=np.int64)
    if len(middle) < 2:
        return level
    near = cKDTree(middle).query_pairs(2 * radius.max(), output_type="ndarray")
    near = near[np.hypot(*(middle[near[:, 0]] - middle[near[:, 1]]).T) < radius[near].sum(axis=1)]
    earlier: list[list[int]] = [[] for _ in middle]
    for first, second in np.sort(near, axis=1):
        earlier[second].append(first)
    for number, others in enumerate(earlier):
        taken = set(level[others])
        level[number] = next(free for free in range(len(taken) + 1) if free not in taken)
    return level
