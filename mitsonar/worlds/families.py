"""Which families of worlds there are, and how each builds its worlds."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError, short_repr, suggest_names
from mitsonar.worlds.scene_check import SceneFile
from mitsonar.worlds.sea import SeaSurface
from mitsonar.worlds.world import (
    BuiltFamily,
    Copies,
    Counts,
    Family,
    Floor,
    Interval,
    Mesh,
    Standpoint,
    World,
    box,
    capsule,
    cylinder,
    draw,
    place,
    shifted_grid,
    slab,
    stream,
    whole,
)

if TYPE_CHECKING:
    import trimesh

__all__ = ["FAMILIES", "FlatObjects", "Pattern", "RockyField", "ShipHull", "create_family", "perlin_reflectivity"]


# ---------------- World ``pattern``: a T of blocks, and bars


PHOTO_M = 2.0
"""Edge of the piece of seabed that a shipped picture covers [m]; the picture is repeated."""

T = np.array([(-1, 0.5), (0, 0.5), (1, 0.5), (0, -0.5)])
"""Centres of the blocks, in block steps: three across, and one below the middle one."""


class Pattern(BuiltFamily):
    """The test field of Almanza-Medina, 2.3.

    The seed draws the three random seabeds. The other three are pictures: generated stand-ins for Almanza-Medina's
    photographs, see the README beside them.
    """

    called: ClassVar[str] = "pattern"

    size_m: float = Field(12.0, gt=0, le=10_000, description="edge of the square seabed [m] (ours)")
    texture: Literal["gaussian", "perlin_high", "perlin_low", "photo_sand", "photo_gravel", "photo_rock"] = Field(
        "gaussian", description="seabed: Gaussian cells, Perlin of high or low correlation, or a picture"
    )
    block_m: tuple[float, float, float] = Field((0.5, 0.5, 0.025), description="a block's width, length, height [m]")
    block_step_m: float = Field(0.6, gt=0, description="distance between the middles of neighbouring blocks [m] (ours)")
    bar_width_m: float = Field(0.05, gt=0, description="width of a bar [m] (ours)")
    bar_height_m: float = Field(0.025, gt=0, description="height of a bar [m] (ours)")
    bar_step_m: float = Field(0.2, gt=0, description="between the middles of the two bars of a pair [m] (ours)")
    bars_across_m: tuple[float, float] = Field((3.6, 1.1), description="fore and aft pairs: length, and y of the inner [m]")
    bars_along_m: tuple[float, float] = Field((1.8, 2.1), description="side pairs: length, and x of the inner bar [m]")
    object_reflectivity: float = Field(0.6, ge=0, le=1, description="reflectivity of blocks and bars (ours)")

    @property
    def seeded(self) -> bool:
        """Return whether the seabed is random; the pictures are not."""
        return not self.texture.startswith("photo")

    def build(self, seed: int) -> World:
        """Build the field, with the seabed for a seed."""
        blocks = np.column_stack([T * self.block_step_m, np.full(len(T), self.block_m[2] / 2)])
        meshes = [self._boxes("blocks", 1, np.tile(self.block_m, (len(T), 1)), blocks)]
        meshes.append(self._boxes("bars", 1 + len(T), *self._bars()))
        return World(
            about=f"pattern, seabed {self.texture}, seed {seed}",
            meshes=meshes,
            stand=Standpoint((-2.5, -4.85, 2.5), (-2.5, -4.85 + 2.5 / np.tan(np.radians(35)), 0)),
            floor=Floor(self.half_m, self._seabed(seed)),
            surface=self.surface,
            pictures=self._pictures(),
        )

    def _boxes(self, name: str, first_id: int, size: ArrayLike, centre: NDArray[np.float64]) -> Mesh:
        placed = place(slab(), size, Rotation.identity(len(centre)), centre)
        reflectivity = np.full(len(placed.faces), self.object_reflectivity)
        return Mesh(name, placed.vertices, placed.faces, reflectivity, first_id + placed.number)

    def _bars(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return sizes and centres of the eight bars ``(8, 3)`` [m]: fore, aft, starboard, port, the inner bar first."""
        sizes, centres = [], []
        for axis, (length, inner) in ((1, self.bars_across_m), (0, self.bars_along_m)):
            for sign in (1, -1):
                for step in (0, 1):
                    size = np.array([self.bar_width_m, self.bar_width_m, self.bar_height_m])
                    size[1 - axis] = length
                    centre = np.array([0, 0, self.bar_height_m / 2])
                    centre[axis] = sign * (inner + step * self.bar_step_m)
                    sizes.append(size)
                    centres.append(centre)
        return np.array(sizes), np.array(centres)

    def _seabed(self, seed: int) -> str:
        """Return the XML of the floor's texture; random ones keep the grain of the shipped scene ``pattern`` at any size."""
        a_metre = self.size_m / 12
        if self.texture == "gaussian":
            numbers = {"cells": 800 * a_metre, "mean": 0.45, "std": 0.2}
            return _texture("cell_noise", numbers, seed, '<string name="distribution" value="gaussian"/>')
        if self.texture.startswith("perlin"):
            cells, octaves = (16, 2) if self.texture == "perlin_high" else (100, 3)
            return _texture(
                "perlin", {"cells": cells * a_metre, "high": 0.9}, seed, f'<integer name="octaves" value="{octaves}"/>'
            )
        return f"""<texture type="bitmap" name="reflectance">
                <string name="filename" value="textures/{self.texture}.png"/>
                <boolean name="raw" value="true"/>
                <transform name="to_uv"><scale value="{self.size_m / PHOTO_M!r}"/></transform>
            </texture>"""

    def _pictures(self) -> dict[str, Path]:
        name = f"textures/{self.texture}.png"
        return {name: Path(str(files("mitsonar.scenes"))) / name} if self.texture.startswith("photo") else {}


def _texture(kind: str, numbers: dict[str, float], seed: int, more: str) -> str:
    lines = "".join(f'<float name="{name}" value="{value!r}"/>' for name, value in numbers.items())
    return f"""<texture type="{kind}" name="reflectance">
                {lines}{more}<integer name="seed" value="{seed}"/>
            </texture>"""


# ---------------- World ``rocky-field``: rocks on a seabed


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
    rock_reflectivity: Interval = Field(
        (0.0, 1.0), description="reflectivities of rocks, to which Perlin noise of -1..1 is mapped"
    )
    perlin_cell_m: float = Field(0.15, gt=0, le=100, description="lattice cell of that noise [m] (ours)")

    def build(self, seed: int) -> World:
        """Build the field for a seed."""
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
        """Build all rocks of one kind as one mesh; their objects are numbered from ``first_id``."""
        count = a_side**2
        centre = np.column_stack([shifted_grid(self.half_m, a_side, rng), draw(rng, self.centre_height_m, count)])
        size = draw(rng, self.rock_size_m, count, 3)
        turn = Rotation.from_euler("xyz", draw(rng, self.rotation_deg, count, 3), degrees=True)
        rocks = place(kind.shape, size, turn, centre)
        reflectivity = perlin_reflectivity(rocks.centres, self.perlin_cell_m, self.rock_reflectivity, rng)
        return Mesh(kind.name, rocks.vertices, rocks.faces, reflectivity, first_id + rocks.number)


# ---------------- World ``ship-hull``: tubes and anodes on a plate


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
    object_reflectivity: Interval = Field(
        (0.0, 1.0), description="reflectivities of tubes and anodes, from Perlin noise of -1..1"
    )
    perlin_cell_m: float = Field(0.15, gt=0, le=100, description="lattice cell of that noise [m] (ours)")

    def build(self, seed: int) -> World:
        """Build the hull for a seed."""
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
        """Build all tubes; the tubes of a group lie side by side and share one direction."""
        # 1. Draw the groups, and how many tubes each has.
        middle = shifted_grid(self.half_m, whole(rng, self.groups_a_side), rng)
        groups = len(middle)
        counts = whole(rng, self.tubes_a_group, groups)
        of_group = np.repeat(np.arange(groups), counts)
        total = len(of_group)
        # 2. Draw the tubes' sizes, and one heading for each group.
        width, height = draw(rng, self.tube_width_m, total), draw(rng, self.tube_height_m, total)
        length = draw(rng, self.tube_length_m, total)
        heading = draw(rng, (0, np.pi), groups)[of_group]
        # 3. Place the tubes of a group without gaps, centred on the group: `before` is the running sum of widths, and
        #    `begin` and `end` are its values at the two edges of the tube's group.
        before = np.cumsum(width) - width
        last = (np.cumsum(counts) - 1)[of_group]
        begin, end = before[last + 1 - counts[of_group]], np.cumsum(width)[last]
        aside = before + width / 2 - (begin + end) / 2
        across = np.column_stack([np.cos(heading), np.sin(heading)])
        centre = np.column_stack([middle[of_group] + across * aside[:, None], height / 2])
        # 4. Lay the cylinder, whose axis is z, on the plate: its length along y, its height along z. Then turn it.
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


# ---------------- World ``flat-objects``: rectangles and ellipses


STEP_M = 5e-6
"""Height difference between overlapping objects [m]; at equal heights the ray tracer would hit either one at random."""


class FlatObjects(BuiltFamily):
    """Almost flat objects on a seabed (Almanza-Medina, 5.4.1), anywhere on it, each of one reflectivity."""

    called: ClassVar[str] = "flat-objects"

    size_m: float = Field(50.0, gt=0, le=10_000, description="edge of the square field [m]")
    seabed_cells: int = Field(2048, ge=1, le=2**20, description="cells along the seabed's edge")
    seabed_reflectivity: Interval = Field((0.0, 1.0), description="uniform reflectivity of a cell")
    objects: Counts = Field((2000, 5000), description="number of rectangles, drawn, and likewise of ellipses")
    rectangles: int | None = Field(None, ge=0, le=10**6, description="rectangles, instead of a draw")
    ellipses: int | None = Field(None, ge=0, le=10**6, description="ellipses, instead of a draw")
    thickness_m: float = Field(
        0.001, gt=0, le=100, description="height over the seabed [m]; 0.1 in one test of Almanza-Medina"
    )
    side_m: Interval = Field((0.2, 1.0), description="length and width [m]")
    object_reflectivity: Interval = Field((0.0, 1.0), description="uniform reflectivity of an object")

    def build(self, seed: int) -> World:
        """Build the field for a seed."""
        # All draws of one kind come from its own generator, so that the counts of one kind leave the other unchanged.
        kinds = (("rectangles", slab(), self.rectangles), ("ellipses", cylinder(24, 1), self.ellipses))
        streams = [stream(seed, 1, number) for number in range(len(kinds))]
        counts = [whole(rng, self.objects) if kind[2] is None else kind[2] for rng, kind in zip(streams, kinds, strict=True)]
        places = [draw(rng, (-self.half_m, self.half_m), n, 2) for rng, n in zip(streams, counts, strict=True)]
        sides = [draw(rng, self.side_m, n, 2) for rng, n in zip(streams, counts, strict=True)]
        # Objects that overlap differ slightly in height, whatever their kinds.
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
    """Return a height level for each object ``(n,)``, such that objects that may overlap have different levels.

    Objects get the lowest free level, in their order. Two objects may overlap if their circumscribed circles do.

    Args:
        middle: centres of the objects ``(n, 2)`` [m].
        side: length and width of the objects ``(n, 2)`` [m].
    """
    radius = np.hypot(*side.T) / 2
    level = np.zeros(len(middle), dtype=np.int64)
    if len(middle) < 2:
        return level
    # Pairs within twice the largest radius are candidates; keep those whose own circles meet.
    near = cKDTree(middle).query_pairs(2 * radius.max(), output_type="ndarray")
    near = near[np.hypot(*(middle[near[:, 0]] - middle[near[:, 1]]).T) < radius[near].sum(axis=1)]
    # Colour the graph of overlaps greedily.
    earlier: list[list[int]] = [[] for _ in middle]
    for first, second in np.sort(near, axis=1):
        earlier[second].append(first)
    for number, others in enumerate(earlier):
        used_levels = set(level[others])
        level[number] = next(free for free in range(len(used_levels) + 1) if free not in used_levels)
    return level


# ---------------- Families by name


FAMILIES: dict[str, type[Family]] = {
    family.called: family for family in (RockyField, ShipHull, Pattern, FlatObjects, SeaSurface)
}


def create_family(name: str, **fields: object) -> Family:
    """Create the family of a given name.

    Args:
        name: a key of :data:`FAMILIES`, or ``scene`` for a scene file of the user.
        fields: options of the family; the defaults are Almanza-Medina's values.

    Raises:
        MitsonarError: the name or a key is unknown, or a value is outside its limits.
    """
    known: dict[str, type[Family]] = {**FAMILIES, SceneFile.called: SceneFile}
    if name not in known:
        raise MitsonarError(f"unknown world {short_repr(name)}: {suggest_names(name, known)}")
    return known[name].create(**fields)


# ---------------- Perlin noise
# Reflectivities are stored with a mesh, so the noise uses plain NumPy without transcendental functions: it has the same bits
# on every machine.


PERIOD = 256
OCTAVES = 2
CONTRAST = 1.5
BLOCK = 2**15  # points per block: their data fit the cache
GRADIENTS = np.array(
    [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if abs(x) + abs(y) + abs(z) == 2], dtype=float
)
"""Gradients, along the twelve edges of a cube: they need no sine, whose bits depend on the mathematics library."""


def perlin_reflectivity(
    places: NDArray[np.float64], cell_m: float, span: tuple[float, float], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Compute reflectivities from Perlin noise (Improving Noise, 2002) of two octaves, with contrast 1.5.

    Args:
        places: points ``(n, 3)`` [m].
        cell_m: edge of a lattice cell of the first octave [m]; the lattice repeats after 256 cells.
        span: lowest and highest reflectivity.
        rng: generator of the lattice.

    Returns:
        One reflectivity for each point ``(n,)``.
    """
    order = np.argsort(rng.random(PERIOD)).astype(np.int16)
    kinds = (rng.random(PERIOD) * len(GRADIENTS)).astype(np.int16)
    total = np.zeros(len(places))
    for start in range(0, len(places), BLOCK):
        block = slice(start, start + BLOCK)
        for octave in range(OCTAVES):
            total[block] += 0.5**octave * _noise(places[block] / cell_m * 2**octave, order, kinds)
    level = np.clip(0.5 + 0.5 * CONTRAST * total / (2 - 0.5 ** (OCTAVES - 1)), 0, 1)
    low, high = span
    return low + (high - low) * level


def _noise(places: NDArray[np.float64], order: NDArray[np.int16], kinds: NDArray[np.int16]) -> NDArray[np.float64]:
    """Compute one octave of noise, about -1..1, at ``places`` ``(n, 3)`` in lattice cells."""
    # 1. Split the coordinates into the lattice cell and the position inside it, and ease the latter by Perlin's quintic,
    #    whose first and second derivatives vanish at the cell's faces.
    x, y, z = places.T
    corner = [np.floor(axis) for axis in (x, y, z)]
    inside = [axis - low for axis, low in zip((x, y, z), corner, strict=True)]
    ease = [t * t * t * (t * (t * 6 - 15) + 10) for t in inside]
    whole = [low.astype(np.int64) for low in corner]
    # 2. Sum over the eight corners: each contributes the linear ramp of its hashed gradient, with trilinear weights.
    value = np.zeros(len(places))
    for dx in (0, 1):
        first = order[(whole[0] + dx) % PERIOD]
        across = ease[0] if dx else 1 - ease[0]
        for dy in (0, 1):
            second = order[(first + whole[1] + dy) % PERIOD]
            along = across * (ease[1] if dy else 1 - ease[1])
            for dz in (0, 1):
                gradient = GRADIENTS[kinds[(second + whole[2] + dz) % PERIOD]]
                ramp = (
                    gradient[:, 0] * (inside[0] - dx) + gradient[:, 1] * (inside[1] - dy) + gradient[:, 2] * (inside[2] - dz)
                )
                value += along * (ease[2] if dz else 1 - ease[2]) * ramp
    return value
