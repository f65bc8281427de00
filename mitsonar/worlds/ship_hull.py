"""The world ``ship-hull``: groups of flat tubes and anodes on a plate of random cells."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from mitsonar.worlds.perlin_noise import perlin_reflectivity
from mitsonar.worlds.shapes import Copies, cylinder, place
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

__all__ = ["ShipHull"]


class ShipHull(BuiltFamily):
    """The bottom of a ship, laid flat (Almanza-Medina, 3.2.2).

    It has groups of elliptical tubes side by side, and sacrificial anodes. The anodes are elliptical too, with their
    cross-section towards the sonar. Both are attached to the plate z = 0.
    """

    called: ClassVar[str] = "ship-hull"

    size_m: float = Field(20.0, gt=0, le=10_000, description="edge of the square plate [m] (ours)")
    plate_cells: int = Field(1024, ge=1, le=2**20, description="cells along the plate's edge")
    plate_reflectivity: Interval = Field((0.25, 1.0), description="uniform reflectivity of a cell")
    groups_a_side: Counts = Field((4, 8), description="groups of tubes along the grid's edge, drawn (ours)")
    tubes_a_group: Counts = Field((2, 5), description="tubes side by side, drawn for each group (ours)")
    tube_width_m: Interval = Field((0.0, 0.4), description="major axis of a tube's cross-section, along the plate [m]")
    tube_height_m: Interval = Field((0.0, 0.05), description="its minor axis, off the plate [m]")
    tube_length_m: Interval = Field((1.0, 3.0), description="length of a tube [m]")
    anodes_a_side: Counts = Field((8, 20), description="anodes along the grid's edge, drawn (ours)")
    anode_height_m: Interval = Field((0.0, 0.03), description="height of an anode [m]")
    anode_length_m: Interval = Field((0.15, 0.3), description="major axis of an anode [m]")
    anode_width_m: Interval = Field((0.05, 0.1), description="minor axis of an anode [m]")
    object_reflectivity: Interval = Field((0.0, 1.0), description="what Perlin's -1..1 becomes on tubes and anodes")
    perlin_cell_m: float = Field(0.15, gt=0, le=100, description="lattice cell of that noise [m] (ours)")

    @property
    def half_m(self) -> float:
        """Return half the edge of the plate [m]."""
        return self.size_m / 2

    def build(self, seed: int) -> World:
        """Build the hull of a seed."""
        meshes: list[Mesh] = []
        counts: list[str] = []
        first_id = 1
        for number, (name, make) in enumerate((("tubes", self._tubes), ("anodes", self._anodes))):
            placed = make(stream(seed, 1, number))
            counts.append(f"{placed.count} {name}")
            if placed.count > 0:
                noise = stream(seed, 2, number)
                reflectivity = perlin_reflectivity(placed.centres, self.perlin_cell_m, self.object_reflectivity, noise)
                meshes.append(Mesh(name, placed.vertices, placed.faces, reflectivity, first_id + placed.number))
                first_id += placed.count
        return World(
            about=f"ship-hull, seed {seed}: {', '.join(counts)} on {self.size_m:g} x {self.size_m:g} m",
            meshes=meshes,
            stand=Standpoint((0, -3, 0.32), (0, -3 + 0.32 / np.tan(np.radians(4)), 0), window=(1.5, 5.0)),
            floor=Floor(self.half_m, Floor.cells(self.plate_cells, self.plate_reflectivity, seed), name="plate"),
            surface=self.surface,
        )

    def _tubes(self, rng: np.random.Generator) -> Copies:
        """Build all tubes; those of a group lie side by side, along one direction."""
        middle = shifted_grid(self.half_m, whole(rng, self.groups_a_side), rng)
        groups = len(middle)
        counts = whole(rng, self.tubes_a_group, groups)
        of_group = np.repeat(np.arange(groups), counts)
        total = len(of_group)
        width, height = draw(rng, self.tube_width_m, total), draw(rng, self.tube_height_m, total)
        length = draw(rng, self.tube_length_m, total)
        heading = draw(rng, (0, np.pi), groups)[of_group]
        before = np.cumsum(width) - width
        last = (np.cumsum(counts) - 1)[of_group]
        begin, end = before[last + 1 - counts[of_group]], np.cumsum(width)[last]
        aside = before + width / 2 - (begin + end) / 2
        across = np.column_stack([np.cos(heading), np.sin(heading)])
        centre = np.column_stack([middle[of_group] + across * aside[:, None], height / 2])
        # a cylinder along z laid down: its length along y, its height along z
        laid = Rotation.from_euler("z", heading[:, None]) * Rotation.from_euler("x", -np.pi / 2)
        return place(cylinder(12, 12), np.column_stack([width, height, length]), laid, centre)

    def _anodes(self, rng: np.random.Generator) -> Copies:
        """Build all anodes."""
        middle = shifted_grid(self.half_m, whole(rng, self.anodes_a_side), rng)
        count = len(middle)
        height = draw(rng, self.anode_height_m, count)
        size = np.column_stack([draw(rng, self.anode_length_m, count), draw(rng, self.anode_width_m, count), height])
        turn = Rotation.from_euler("z", draw(rng, (0, np.pi), count, 1))
        return place(cylinder(16, 1), size, turn, np.column_stack([middle, height / 2]))
