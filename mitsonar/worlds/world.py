"""Worlds in memory, and their export as a Mitsuba XML scene with PLY meshes and textures."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, NoReturn, cast, overload
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, Field, ValidationError
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError, validation_message
from mitsonar.io.checked_model import CheckedModel
from mitsonar.io.ply import ply_bytes

if TYPE_CHECKING:
    import trimesh

__all__ = [
    "BuiltFamily",
    "Copies",
    "Counts",
    "Family",
    "Floor",
    "Interval",
    "Mesh",
    "Standpoint",
    "World",
    "box",
    "capsule",
    "cylinder",
    "draw",
    "place",
    "shifted_grid",
    "slab",
    "sloped",
    "stream",
    "whole",
]


def _check_interval(pair: tuple[float, float]) -> tuple[float, float]:
    if not (np.isfinite(pair).all() and pair[0] <= pair[1]):
        raise ValueError(f"an interval must be two finite numbers low,high with low <= high: got {pair[0]:g},{pair[1]:g}")
    return pair


Interval = Annotated[tuple[float, float], AfterValidator(_check_interval)]
"""Lowest and highest value of an interval, both finite."""


def _check_counts(pair: tuple[int, int]) -> tuple[int, int]:
    if not 0 <= pair[0] <= pair[1] <= 10**6:
        raise ValueError(f"a range of counts must be low,high with 0 <= low <= high <= 1000000: got {pair[0]},{pair[1]}")
    return pair


Counts = Annotated[tuple[int, int], AfterValidator(_check_counts)]
"""Lowest and highest number of objects; the number is drawn from this closed interval."""


SURFACE_MARGIN_M = 25.0
"""Distance by which a sea surface extends beyond the world on each side [m]."""


class Family(CheckedModel):
    """A family of worlds: its fields are the options, and :meth:`build` makes a world from a seed.

    An invalid option raises a one-sentence error that names the family and where its options are documented.
    """

    described: ClassVar[str] = ""

    if TYPE_CHECKING:  # subclasses define it at different positions among their fields
        size_m: float

    @classmethod
    def refuse(cls, error: ValidationError) -> NoReturn:
        """Raise a pydantic validation error as a :class:`~mitsonar.errors.MitsonarError`.

        Raises:
            MitsonarError: always; the message describes the first error that pydantic reports.
        """
        described = cls.described or f"`mitsonar world {cls.called} --help`"
        raise MitsonarError(validation_message(error, cls, cls.called, f" (see {described})")) from None

    def __str__(self) -> str:
        return repr(self)

    @property
    def half_m(self) -> float:
        """Return half the side length of the square around the origin in which the vehicle stays [m]."""
        return self.size_m / 2

    @property
    def seeded(self) -> bool:
        """Return whether the world depends on the seed."""
        return True

    def build(self, seed: int) -> World:
        """Build the world for a seed; the same seed gives the same bytes."""
        raise NotImplementedError

    def check_scene_extent(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Check that a scene covers the square in which frames are taken; generated worlds always do.

        Args:
            low: minimum x, y, z of the scene ``(3,)`` [m].
            high: maximum x, y, z of the scene ``(3,)`` [m].

        Raises:
            MitsonarError: the scene is smaller.
        """

    def prepare(self, seed: int, folder: Path) -> tuple[Path, dict[str, str]]:
        """Write the world for a seed into a new folder; return its XML file and the parameters to load it with."""
        return self.build(seed).write(folder), {}


def stream(seed: int, *purpose: int) -> np.random.Generator:
    """Return the random number generator for a seed and a purpose."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, *purpose])))


def draw(rng: np.random.Generator, span: tuple[float, float], *shape: int) -> NDArray[np.float64]:
    """Draw uniform numbers from an interval, as an array of ``shape``.

    Only the generator's plain doubles are used, because their bits are the same in all versions of NumPy.
    """
    low, high = span
    return np.asarray(low + (high - low) * rng.random(shape), dtype=np.float64)


@overload
def whole(rng: np.random.Generator, span: tuple[int, int]) -> int: ...
@overload
def whole(rng: np.random.Generator, span: tuple[int, int], first: int, /, *shape: int) -> NDArray[np.int64]: ...
def whole(rng: np.random.Generator, span: tuple[int, int], *shape: int) -> int | NDArray[np.int64]:
    """Draw integers from a closed interval: a scalar without a shape, otherwise an array of that shape."""
    values = span[0] + np.floor(rng.random(shape) * (span[1] + 1 - span[0])).astype(int)
    return values if shape else int(values)


def shifted_grid(half_m: float, a_side: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw the vertices of a square grid, each displaced at random within one grid step (Almanza-Medina, 3.2.1).

    Args:
        half_m: half the side length of the field [m].
        a_side: number of vertices along each side.
        rng: random number generator for the displacements.

    Returns:
        Points ``(a_side^2, 2)`` [m].
    """
    step = 2 * half_m / max(a_side, 1)
    corners = np.stack(np.meshgrid(*[np.arange(a_side)] * 2, indexing="ij"), -1).reshape(-1, 2) * step - half_m
    return np.asarray(corners + step * rng.random((a_side**2, 2)), dtype=np.float64)


@dataclass(frozen=True)
class Mesh:
    """One mesh of a world.

    Attributes:
        name: name of the shape and of its file.
        vertices: vertex positions ``(vertices, 3)`` [m].
        faces: vertex indices of the triangles ``(faces, 3)``.
        reflectivity: reflectivity of each face ``(faces,)`` 0..1, unless a texture gives it.
        object_id: number of the object that each face belongs to ``(faces,)``, counted from 1.
        uv: texture coordinates of each vertex ``(vertices, 2)``; only with a texture.
        texture: path of an image of the reflectivity, relative to the world's folder.
        shape_id: id of the shape; default: its name.
        material: name of an ``acoustic_material`` that gives the surface its scattering law; default: a diffuse surface.
    """

    name: str
    vertices: NDArray[np.floating]
    faces: NDArray[np.integer]
    reflectivity: NDArray[np.floating] | None = None
    object_id: NDArray[np.integer] | None = None
    uv: NDArray[np.floating] | None = None
    texture: str | None = None
    shape_id: str | None = None
    material: str | None = None

    def ply(self) -> bytes:
        """Return the mesh as a binary PLY file, with the attribute names that Mitsuba reads."""
        places = self.vertices.T if self.uv is None else (*self.vertices.T, *self.uv.T)
        faces = {"reflectivity_0": self.reflectivity, "id_0": self.object_id}
        return ply_bytes(
            {name: ("<f4", values) for name, values in zip("xyzuv", places, strict=False)},
            self.faces,
            {name: values for name, values in faces.items() if values is not None},
        )

    def xml(self) -> str:
        """Return the XML of the shape."""
        if self.texture is not None:
            reflectance = (
                f'<texture type="bitmap" name="reflectance"><string name="filename" value={quoteattr(self.texture)}/>'
                '<boolean name="raw" value="true"/></texture>'
            )
        else:
            reflectance = (
                '<texture type="mesh_attribute" name="reflectance"><string name="name" value="face_reflectivity"/></texture>'
            )
        kind = "diffuse"
        if self.material is not None:
            kind, reflectance = "acoustic_material", f'<string name="material" value={quoteattr(self.material)}/>'
        return f"""
    <shape type="ply" id={quoteattr(self.shape_id or self.name)}>
        <string name="filename" value="meshes/{self.name}.ply"/>
        <boolean name="face_normals" value="true"/>
        <bsdf type="{kind}">
            {reflectance}
        </bsdf>
    </shape>"""


@dataclass(frozen=True)
class Floor:
    """A square plane centred on the origin, at height ``z_m``; ``texture`` is the XML of its reflectivity.

    The plane rises along +y by ``slope_deg``. The rotation is about the x axis, which points to starboard, and is
    applied after the translation to ``z_m``.
    """

    half_m: float
    texture: str
    z_m: float = 0.0
    name: str = "seabed"
    slope_deg: float = 0.0

    @staticmethod
    def cells(count: int, span: tuple[float, float], seed: int) -> str:
        """Return the XML of a texture of independent cells, ``count`` along each side, drawn uniformly from ``span``."""
        return f"""<texture type="cell_noise" name="reflectance">
                <float name="cells" value="{count}"/>
                <float name="low" value="{span[0]!r}"/>
                <float name="high" value="{span[1]!r}"/>
                <integer name="seed" value="{seed}"/>
            </texture>"""

    def xml(self) -> str:
        """Return the XML of the shape."""
        rotation = f'\n            <rotate x="1" angle="{self.slope_deg!r}"/>' if self.slope_deg else ""
        return f"""
    <shape type="rectangle" id="{self.name}">
        <transform name="to_world">
            <scale value="{self.half_m!r}"/>
            <translate z="{self.z_m!r}"/>{rotation}
        </transform>
        <bsdf type="diffuse">
            {self.texture}
        </bsdf>
    </shape>"""


class BuiltFamily(Family):
    """A family of generated worlds, optionally below a flat sea surface."""

    surface_m: float | None = Field(
        None, gt=0, le=12_000, description="height of a flat sea surface (shape surface) above z = 0 [m]; none if omitted"
    )
    surface_reflectivity: float = Field(0.0, ge=0, le=1, description="what the surface scatters; a mirror loses the rest")

    @property
    def surface(self) -> Floor | None:
        """Return the sea surface, or None.

        It extends :data:`SURFACE_MARGIN_M` beyond the world, so that it also reflects the world's edges.
        """
        if self.surface_m is None:
            return None
        texture = f'<spectrum name="reflectance" value="{self.surface_reflectivity!r}"/>'
        return Floor(self.half_m + SURFACE_MARGIN_M, texture, self.surface_m, "surface")


@dataclass(frozen=True)
class Standpoint:
    """The initial sonar of a world: its position, a point on its axis, its range window [m], and its preset."""

    origin: tuple[float, float, float]
    target: tuple[float, float, float]
    window: tuple[float, float] = (3.2, 5.6)
    preset: str = "didson300"

    def xml(self) -> str:
        """Return the XML of the sensor."""
        return f"""
    <sensor type="imaging_sonar">
        <string name="preset" value="{self.preset}"/>
        <float name="range_min" value="{self.window[0]:g}"/>
        <float name="range_max" value="{self.window[1]:g}"/>
        <transform name="to_world">
            <lookat origin="{_numbers(self.origin)}" target="{_numbers(self.target)}" up="0, 0, 1"/>
        </transform>
    </sensor>"""


@dataclass(frozen=True)
class World:
    """A world: meshes, a floor, a sea surface and an initial sonar.

    Attributes:
        about: family and seed, written as a comment at the top of the file.
        meshes: meshes of the world.
        stand: initial position and window of the sonar.
        floor: plane below the meshes, if any.
        surface: sea surface above the meshes, if any; it is the last shape.
        pictures: image files to copy into the world's folder, keyed by their name there.
        content: files to write into the world's folder, keyed by their name there.
    """

    about: str
    meshes: list[Mesh]
    stand: Standpoint
    floor: Floor | None = None
    surface: Floor | None = None
    pictures: dict[str, Path] = field(default_factory=dict)
    content: dict[str, bytes] = field(default_factory=dict)

    @property
    def shape_names(self) -> tuple[str, ...]:
        """Return the ids of the shapes, in the order of the XML file."""
        planes = ([plane.name] if plane else [] for plane in (self.floor, self.surface))
        below, above = planes
        return (*below, *(mesh.shape_id or mesh.name for mesh in self.meshes), *above)

    @property
    def size_m(self) -> float:
        """Return the longest edge of the bounding box of the meshes [m]."""
        vertices = np.concatenate([mesh.vertices for mesh in self.meshes])
        return float(np.ptp(vertices, axis=0).max())

    @property
    def faces(self) -> int:
        """Return the total number of triangles of all meshes."""
        return sum(len(mesh.faces) for mesh in self.meshes)

    def xml(self) -> str:
        """Return the XML of the Mitsuba scene."""
        shapes: Iterable[Floor | Mesh] = [*([self.floor] if self.floor else []), *self.meshes]
        shapes = [*shapes, *([self.surface] if self.surface else [])]
        about = re.sub("-(?=-)", "- ", escape(self.about))  # two hyphens would end the comment
        return f"""<?xml version="1.0" encoding="utf-8"?>
<!-- {about} -->
<scene version="3.0.0">
    <integrator type="echo"/>
{self.stand.xml()}
{"".join(shape.xml() for shape in shapes)}
</scene>
"""

    def write(self, folder: str | Path) -> Path:
        """Write ``meshes/``, ``textures/`` and, last, ``scene.xml`` into a folder; return the path of the scene.

        The write is atomic: the folder is either complete or absent.

        Raises:
            MitsonarError: the folder is not empty, or is the current one.
        """
        folder = Path(folder)
        if folder.exists() and (not folder.name or not folder.is_dir() or any(folder.iterdir())):  # "." has no name
            raise MitsonarError(f"{folder} exists and is kept as it is: choose another -o")
        temporary = folder.with_name(f".{folder.name}.part")  # renamed at the end, so that the folder is complete or absent
        shutil.rmtree(temporary, ignore_errors=True)
        for subfolder in ("meshes", "textures"):
            (temporary / subfolder).mkdir(parents=True)
        for mesh in self.meshes:
            (temporary / "meshes" / f"{mesh.name}.ply").write_bytes(mesh.ply())
        for name, source in self.pictures.items():
            shutil.copyfile(source, temporary / name)
        for name, content in self.content.items():
            (temporary / name).write_bytes(content)
        (temporary / "scene.xml").write_bytes(self.xml().encode())
        for subfolder in ("meshes", "textures"):
            if not any((temporary / subfolder).iterdir()):
                (temporary / subfolder).rmdir()
        temporary.rename(folder)
        return folder / "scene.xml"


def _numbers(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:.9g}" for value in values)


# ---------------- Sloped worlds


def sloped(world: World, slope_deg: float) -> World:
    """Tilt a world so that its ground rises forward, along +y, by an angle [deg].

    Floor and meshes are rotated about the x axis, which points to starboard. The sonar and a sea surface do not move.
    """
    rotation = Rotation.from_euler("x", slope_deg, degrees=True)

    def tilted(mesh: Mesh) -> Mesh:
        return replace(mesh, vertices=rotation.apply(mesh.vertices))

    floor = None if world.floor is None else replace(world.floor, slope_deg=slope_deg)
    meshes = [tilted(mesh) for mesh in world.meshes]
    return replace(world, about=f"{world.about}, rising forward by {slope_deg:g} deg", meshes=meshes, floor=floor)


# ---------------- Unit shapes and their copies


GRID_M = 1e-6
"""Grid to which vertices are rounded [m], so that mathematics libraries that differ in the last bits give equal results."""


@dataclass(frozen=True)
class Copies:
    """Copies of one shape, merged into a single mesh.

    Attributes:
        vertices: vertices of all copies ``(vertices, 3)`` [m].
        faces: vertex indices of all triangles ``(faces, 3)``.
        number: index of the copy that each face belongs to ``(faces,)``.
        count: number of copies.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    number: NDArray[np.int64]
    count: int

    @property
    def centres(self) -> NDArray[np.float64]:
        """Return the centre of each face ``(faces, 3)`` [m]."""
        return np.asarray(self.vertices[self.faces].mean(axis=1))


def box() -> trimesh.Trimesh:
    """Return a unit cube of 48 triangles, eight per side."""
    import trimesh

    return cast("trimesh.Trimesh", trimesh.creation.box().subdivide())


def slab() -> trimesh.Trimesh:
    """Return a unit cube of 12 triangles."""
    import trimesh

    return cast("trimesh.Trimesh", trimesh.creation.box())


def cylinder(sections: int = 12, rings: int = 2) -> trimesh.Trimesh:
    """Return a unit cylinder along z whose side is divided into ``rings``."""
    import trimesh

    side = [(0.5, z) for z in np.linspace(-0.5, 0.5, rings + 1)]
    return trimesh.creation.revolve([(0, -0.5), *side, (0, 0.5)], sections=sections)


def capsule(sections: int = 12) -> trimesh.Trimesh:
    """Return a capsule along z, made of two hemispheres of two bands each: twice as long as wide, scaled to unit size."""
    import trimesh

    angle = np.radians([-90, -45, 0])
    low = np.column_stack([0.5 * np.cos(angle), (0.5 * np.sin(angle) - 0.5) / 2])
    low[0, 0] = 0  # the pole lies on the axis
    return trimesh.creation.revolve([*low, *(low[::-1] * (1, -1))], sections=sections)


def place(shape: trimesh.Trimesh, size: ArrayLike, turn: Rotation, centre: ArrayLike) -> Copies:
    """Copy a unit shape ``n`` times, each copy scaled, rotated and translated.

    Args:
        shape: shape of unit size, centred on the origin.
        size: dimensions of each copy before the rotation ``(n, 3)`` [m].
        turn: the n rotations.
        centre: centre of each copy ``(n, 3)`` [m].
    """
    size, centre = np.asarray(size, dtype=float), np.asarray(centre, dtype=float)
    count, stride = len(size), len(shape.vertices)
    placed = (np.asarray(shape.vertices) * size[:, None]) @ turn.as_matrix().transpose(0, 2, 1) + centre[:, None]
    faces = np.asarray(shape.faces) + (np.arange(count) * stride)[:, None, None]
    vertices = np.rint(placed.reshape(-1, 3) / GRID_M) * GRID_M
    return Copies(vertices, faces.reshape(-1, 3), np.repeat(np.arange(count), len(shape.faces)), count)
