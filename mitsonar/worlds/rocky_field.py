"""The world ``rocky-field``: cubes, cylinders and capsules on a flat seabed of random cells."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from mitsonar.worlds.perlin_noise import perlin_reflectivity
from mitsonar.worlds.shapes import box, capsule, cylinder, place
from mitsonar.worlds.world import (
    BuiltFamily,
    Counts,
    Floor,
    Interval,
    Mesh,
    Standpoint,
    World,
    draw,
    shifted_grid,
    stream,
    whole,
)

if TYPE_CHECKING:
    import trimesh

__all__ = ["RockyField"]


class _Kind(NamedTuple):
    name: str
    shape: trimesh.Trimesh
    a_side: int | None


class RockyField(BuiltFamily):
    """Rocks on a flat seabed (Almanza-Medina, 3.2.1).

    Each kind of rock has its own square grid. Each rock is displaced at random within its grid step, and has its own height,
    sizes and turns. The reflectivity is Perlin's noise, one value for each face.
    """

    called: ClassVar[str] = "rocky-field"

    size_m: float = Field(30.0, gt=0, le=10_000, description="edge of the square field [m]; Almanza-Medina has 30 and 50")
    seabed_cells: int = Field(2048, ge=1, le=2**20, description="cells along the seabed's edge")
    seabed_reflectivity: Interval = Field((0.0, 1.0), description="uniform reflectivity of a cell")
    a_side: Counts = Field((30, 130), description="rocks of a kind along the grid's edge, drawn for each kind")
    cubes_a_side: int | None = Field(None, ge=0, le=1000, description="cubes along the edge, instead of a draw")
    cylinders_a_side: int | None = Field(None, ge=0, le=1000, description="cylinders along the edge, instead of a draw")
    capsules_a_side: int | None = Field(None, ge=0, le=1000, description="capsules along the edge, instead of a draw")
    centre_height_m: Interval = Field((0.0, 0.45), description="height of a rock's centre over the seabed [m]")
    rock_size_m: Interval = Field((0.0, 0.45), description="size of a rock in each of its three directions [m]")
    rotation_deg: Interval = Field((-165.0, 100.0), description="turn of a rock about each axis [deg]")
    rock_reflectivity: Interval = Field((0.0, 1.0), description="what Perlin's -1..1 becomes on rocks")
    perlin_cell_m: float = Field(0.15, gt=0, le=100, description="lattice cell of that noise [m] (ours)")

    @property
    def half_m(self) -> float:
        """Return half the edge of the field [m]."""
        return self.size_m / 2

    def build(self, seed: int) -> World:
        """Build the field of a seed."""
        kinds = [
            _Kind("cubes", box(), self.cubes_a_side),
            _Kind("cylinders", cylinder(), self.cylinders_a_side),
            _Kind("capsules", capsule(), self.capsules_a_side),
        ]
        meshes: list[Mesh] = []
        counts: list[str] = []
        first_id = 1
        for number, kind in enumerate(kinds):
            rng = stream(seed, 1, number)
            a_side = whole(rng, self.a_side) if kind.a_side is None else kind.a_side
            counts.append(f"{a_side} x {a_side} {kind.name}")
            if a_side > 0:
                meshes.append(self._rocks(kind, a_side, first_id, rng))
                first_id += a_side**2
        return World(
            about=f"rocky-field, seed {seed}: {', '.join(counts)} on {self.size_m:g} x {self.size_m:g} m",
            meshes=meshes,
            stand=Standpoint((0, -3.5, 2.5), (0, -3.5 + 2.5 / np.tan(np.radians(35)), 0)),
            floor=Floor(self.half_m, Floor.cells(self.seabed_cells, self.seabed_reflectivity, seed)),
            surface=self.surface,
        )

    def _rocks(self, kind: _Kind, a_side: int, first_id: int, rng: np.random.Generator) -> Mesh:
        """Build all rocks of one kind."""
        count = a_side**2
        centre = np.column_stack([shifted_grid(self.half_m, a_side, rng), draw(rng, self.centre_height_m, count)])
        size = draw(rng, self.rock_size_m, count, 3)
        turn = Rotation.from_euler("xyz", draw(rng, self.rotation_deg, count, 3), degrees=True)
        rocks = place(kind.shape, size, turn, centre)
        reflectivity = perlin_reflectivity(rocks.centres, self.perlin_cell_m, self.rock_reflectivity, rng)
        return Mesh(kind.name, rocks.vertices, rocks.faces, reflectivity, first_id + rocks.number)
