"""Mirrors: which shapes reflect specularly, how strongly, and by which paths sound reaches points via them.

A shape with reflection coefficient V and rms height h reflects the amplitude ``V exp(-2 k^2 h^2 cos^2)`` as a mirror; the
energy is ``V^2 exp(-4 k^2 h^2 cos^2)``. Its scattered energy is multiplied by ``1 - exp(-4 k^2 h^2 cos^2)``. Both are the
laws of :mod:`mitsonar.acoustics.materials`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.materials import Material
from mitsonar.acoustics.water import dot, length
from mitsonar.errors import MitsonarError, short_repr, suggest_names
from mitsonar.plugins.material_laws import material_of
from mitsonar.plugins.surfaces import Hit, Surfaces, registry_index
from mitsonar.simulation.device import DeviceArray
from mitsonar.simulation.shape_pieces import FLAT, triangles_of
from mitsonar.simulation.tracing import OFF_SURFACE, hidden

__all__ = [
    "MOST_FACETS",
    "MOST_PLANES",
    "ROW",
    "FlatMirrors",
    "MirrorFacets",
    "MirrorPart",
    "MirrorPlane",
    "MirrorSequence",
    "Mirroring",
    "Mirrors",
    "PlaneRow",
    "ReturnPath",
    "ScatteringPoints",
    "SecondMirror",
    "SecondMirrors",
    "bright_notes",
    "flat_mirrors",
    "mirror_of",
    "mirror_sequences",
    "second_notes",
    "unfolded",
]


MirrorPart: TypeAlias = tuple[float, float] | Material
"""Pressure reflection coefficient, -1 to 1, and rms height of the roughness [m]; or a material that has both."""

Mirroring: TypeAlias = Mapping[str, MirrorPart] | Literal["materials"] | None
"""Mirror parts keyed by shape id, or ``materials`` for those of the shapes' materials, or None."""

ROUGHEST_M = 1.0
"""Largest rms height [m]."""


@dataclass(frozen=True)
class Mirrors:
    """Mirror parts of a scene's shapes, in the order of ``scene.shapes()``.

    Attributes:
        reflection: pressure reflection coefficient V ``(shapes,)``; 0 if a shape has no mirror part.
        roughness_m: rms height ``(shapes,)`` [m].
    """

    reflection: NDArray[np.float64]
    roughness_m: NDArray[np.float64]

    def table(self) -> mi.Float:
        """Return pairs of V and rms height as the input of a launch, with zeros for one shape more."""
        rows = np.append(np.stack([self.reflection, self.roughness_m], axis=1), np.zeros((1, 2)), axis=0)
        return mi.Float(rows.ravel().astype(np.float32))


def mirror_of(scene: mi.Scene, mirrors: Mirroring) -> Mirrors | None:
    """Collect the mirror parts of a scene's shapes; return None if there are none.

    Args:
        scene: any Mitsuba scene.
        mirrors: parts keyed by shape id, or ``materials`` to use each shape's ``acoustic_material``. A material without
            a mirror part gives none.

    Raises:
        MitsonarError: a shape is not in the scene, or a number is out of limits.
    """
    if isinstance(mirrors, str):
        mirrors = _material_parts(scene, mirrors)
    if not isinstance(mirrors, Mapping | None):
        raise MitsonarError(f"mirrors must be mirror parts keyed by shape id, or `materials`: got {short_repr(mirrors)}")
    names = [shape.id() for shape in scene.shapes()]
    parts = Mirrors(np.zeros(len(names)), np.zeros(len(names)))
    for name, part in (mirrors or {}).items():
        if name not in names:
            raise MitsonarError(f"mirrors: the scene has no shape {name}: {suggest_names(name, names)}")
        reflection, roughness_m = _numbers_of(name, part)
        if not (-1 <= reflection <= 1 and 0 <= roughness_m <= ROUGHEST_M):
            raise MitsonarError(
                f"mirrors: the reflection of {name} must lie in -1..1 and its rms height in 0..{ROUGHEST_M:g} m: "
                f"got {reflection:g} and {roughness_m:g}"
            )
        for index in (index for index, shape_name in enumerate(names) if shape_name == name):
            parts.reflection[index], parts.roughness_m[index] = reflection, roughness_m
    return parts if parts.reflection.any() else None


def _numbers_of(name: str, part: MirrorPart) -> tuple[float, float]:
    """Return reflection and rms height [m] of a mirror part; a missing one is 0."""
    if isinstance(part, Material):
        return part.reflection or 0.0, part.roughness_m or 0.0
    try:
        reflection, roughness_m = (float(number) for number in part)
    except (TypeError, ValueError):
        raise MitsonarError(
            f"mirrors: {name} needs a pair, reflection and rms height in m, such as (-1.0, 0.0): got {short_repr(part)}"
        ) from None
    return reflection, roughness_m


def _material_parts(scene: mi.Scene, source: str) -> dict[str, MirrorPart]:
    """Return the materials of a scene's shapes, keyed by shape id."""
    if source != "materials":
        raise MitsonarError(f"mirrors must be mirror parts keyed by shape id, or `materials`: got {source!r}")
    parts: dict[str, MirrorPart] = {}
    for shape in scene.shapes():
        acoustic_material = material_of(shape) if shape.bsdf() is not None else None
        if acoustic_material is not None:
            parts[shape.id()] = acoustic_material.material
    return parts


def refuse_moving_mirrors(scene: mi.Scene, mirrors: Mirroring, moving: Collection[str]) -> None:
    """Refuse mirrors that move, since image sources assume planes at rest.

    Args:
        scene: any Mitsuba scene.
        mirrors: as in :func:`mirror_of`.
        moving: ids of the moving shapes.

    Raises:
        MitsonarError: a mirror moves.
    """
    parts = mirror_of(scene, mirrors)
    for shape, reflection in zip(scene.shapes(), [] if parts is None else parts.reflection, strict=parts is not None):
        if reflection != 0 and shape.id() in moving:
            raise MitsonarError(
                f"mirrors must not move: got {shape.id()}, which moves; name the mirrors by the ids of still shapes, or "
                "remove its trajectory"
            )


def parts_at(table: mi.Float, hit: Hit) -> tuple[DeviceArray, DeviceArray]:
    """Return V and rms height [m] at hits; 0 where there is no mirror part."""
    known = hit.valid & (hit.shape_id >= 0)
    pair = dr.gather(mi.Vector2f, table, mi.UInt32(dr.select(known, hit.shape_id, 0)), known)
    return pair.x, pair.y


def smooth_share(roughness_m: DeviceArray, cosine: DeviceArray, wavenumber: float) -> DeviceArray:
    """Return the factor by which roughness reduces a mirror's amplitude, ``exp(-2 k^2 h^2 cos^2)``."""
    return dr.exp(-2 * dr.square(roughness_m * cosine * wavenumber))


def without_mirror_part(table: mi.Float, hit: Hit, d: DeviceArray, wavenumber: float) -> Hit:
    """Scale the reflectivity of mirrors by the share of energy that roughness removes from the mirror part.

    Other hits are unchanged. So are those with a material, whose scattering law includes this share already.
    """
    reflection, roughness_m = parts_at(table, hit)
    scattered_share = 1 - dr.square(smooth_share(roughness_m, dr.dot(hit.n, d), wavenumber))
    return replace(
        hit,
        reflectivity=dr.select(
            (reflection == 0) | (hit.material >= 0), hit.reflectivity, hit.reflectivity * scattered_share
        ),
    )


# ---------------- Planes and facets of mirrors


MOST_PLANES = 16
"""Largest number of planes in a mesh; a mesh with more is treated as a curved surface."""

MOST_FACETS = 2_000_000
"""Largest number of triangles in a curved mirror; a thousand cost 1 ms of processor time per ping."""

STEEPEST, HIGHEST = 0.5, 0.1
"""Limits of a plane with waves: cosine of the steepest facet (60 deg), and rms height as a fraction of the mesh's size."""

SAME_PLANE = 2e-6
"""Largest distance of a facet from a plane that it lies on, as a fraction of the mesh's size."""


@dataclass(frozen=True)
class MirrorPlane:
    """Plane of a mirror, ``normal . x = offset``; both sides reflect.

    Attributes:
        name: id of the shape.
        shape: index of the shape in ``scene.shapes()``.
        normal: unit normal ``(3,)``.
        offset: [m].
        reflection: pressure reflection coefficient V, -1 to 1.
        roughness_m: rms height [m].
        slab_m: largest distance of the shape's points from the plane [m]; 0 if the shape is flat.
    """

    name: str
    shape: int
    normal: NDArray[np.float64]
    offset: float
    reflection: float
    roughness_m: float
    slab_m: float = 0.0


@dataclass(frozen=True)
class MirrorFacets:
    """Triangles of a mirror that is not flat.

    Attributes:
        name: id of the shape.
        corners: corners of the triangles ``(facets, 3, 3)`` [m].
        reflection, roughness_m: see :class:`MirrorPlane`.
    """

    name: str
    corners: NDArray[np.float64]
    reflection: float
    roughness_m: float


@dataclass(frozen=True)
class FlatMirrors:
    """Mirrors of a scene.

    Attributes:
        planes: planes of the flat mirrors.
        facets: facets of the other mirrors.
        means: mean planes of the latter, for paths of several reflections; their roughness includes the waves.
        notes: notes to the user about shapes that do not mirror.
    """

    planes: list[MirrorPlane] = field(default_factory=list)
    facets: list[MirrorFacets] = field(default_factory=list)
    means: list[MirrorPlane] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def reflecting(self, reflections: int) -> list[MirrorPlane]:
        """Return the planes for paths with several reflections; for one, the flat ones, since facets cover the others."""
        return self.planes if reflections < 2 else self.planes + self.means

    def notes_on(self, bounces: int) -> list[str]:
        """Return notes to the user, given the largest number of reflections."""
        notes = list(self.notes)
        for mirror in self.facets if bounces > 1 else []:
            mean = next((plane for plane in self.means if plane.name == mirror.name), None)
            if mean is None:
                notes.append(f"the mirror {mirror.name} is not a plane with waves: it reflects once and makes no ghosts")
            else:
                notes.append(
                    f"the mirror {mirror.name} is not flat: paths of several reflections have the coherent part of its "
                    f"mean plane, with the loss of its waves' rms height, {mean.roughness_m:.2g} m; "
                    "what waves scatter is left out"
                )
        return notes


def flat_mirrors(scene: mi.Scene, mirrors: Mirrors | None) -> FlatMirrors:
    """Find planes and facets of a scene's mirrors.

    Rectangles, disks, and meshes of up to :data:`MOST_PLANES` planes become planes. Other meshes become facets.

    Args:
        scene: any Mitsuba scene.
        mirrors: mirror parts of its shapes.

    Raises:
        MitsonarError: a curved mirror has more than :data:`MOST_FACETS` triangles.
    """
    flat = FlatMirrors()
    for index, shape in enumerate(scene.shapes() if mirrors is not None else []):
        assert mirrors is not None
        part = float(mirrors.reflection[index]), float(mirrors.roughness_m[index])
        if part[0] == 0:
            continue
        name = shape.id()
        kind = shape.class_name()
        if not isinstance(shape, mi.Mesh) and kind not in FLAT:
            flat.notes.append(
                f"shape {name} ({kind.lower()}) is curved and does not mirror in impulse responses: give it as a mesh"
            )
            continue
        corners = triangles_of(shape)
        planes = _planes(corners)
        if planes is not None:
            flat.planes.extend(MirrorPlane(name, index, normal, offset, *part) for normal, offset in planes)
        elif len(corners) > MOST_FACETS:
            raise MitsonarError(
                f"the mirror {name} has {len(corners):,} triangles: at most {MOST_FACETS:,} are supported; use fewer, or "
                "make it flat"
            )
        else:
            flat.facets.append(MirrorFacets(name, corners, *part))
            mean = _mean_plane(name, index, corners, *part)
            flat.means.extend([] if mean is None else [mean])
    return flat


def mirror_planes(scene: mi.Scene, mirrors: Mirrors | None) -> list[MirrorPlane]:
    """Return the planes of a scene's flat mirrors."""
    flat_planes = []
    for index, shape in enumerate(scene.shapes() if mirrors is not None else []):
        assert mirrors is not None
        part = float(mirrors.reflection[index]), float(mirrors.roughness_m[index])
        if part[0] != 0 and (isinstance(shape, mi.Mesh) or shape.class_name() in FLAT):
            planes = _planes(triangles_of(shape)) or []
            flat_planes += [MirrorPlane(shape.id(), index, normal, offset, *part) for normal, offset in planes]
    return flat_planes


def _mean_plane(
    name: str, index: int, corners: NDArray[np.float64], reflection: float, roughness_m: float
) -> MirrorPlane | None:
    """Return the mean plane of a mesh of waves; None if heights or slopes are too large for waves."""
    # area-weighted principal axes; the axis of least variance is the normal
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    weight = np.repeat(np.linalg.norm(normal, axis=1), 3)
    points = corners.reshape(-1, 3)
    middle = np.average(points, axis=0, weights=weight)
    variances, axes = np.linalg.eigh(np.cov(points.T, aweights=weight, bias=True))
    up = axes[:, 0]
    steep = np.abs(normal @ up) < STEEPEST * np.linalg.norm(normal, axis=1)
    height = float(np.sqrt(max(variances[0], 0.0)))
    if steep.any() or height > HIGHEST * np.sqrt(variances[1]):
        return None
    slab = float(np.abs((points - middle) @ up).max())
    return MirrorPlane(name, index, up, float(up @ middle), reflection, float(np.hypot(height, roughness_m)), slab)


def _planes(corners: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], float]] | None:
    """Return normal and offset of each plane that triangles lie in; None if there are more than :data:`MOST_PLANES`."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    keep = area > 0
    normal, corners, area = normal[keep] / area[keep, None], corners[keep], area[keep]
    size = max(1.0, float(np.abs(corners).max(initial=0)))
    left = np.ones(len(normal), dtype=bool)
    planes: list[tuple[NDArray[np.float64], float]] = []
    while left.any():
        if len(planes) == MOST_PLANES:
            return None
        # take the plane of the largest triangle left, and remove all triangles that lie in it
        largest = int(np.argmax(np.where(left, area, 0)))
        chosen, offset = normal[largest], float(normal[largest] @ corners[largest].mean(axis=0))
        flat = np.abs(corners @ chosen - offset).max(axis=1) < SAME_PLANE * size
        along = np.abs(normal @ chosen) > 1 - 1e-4
        planes.append((chosen, offset))
        left &= ~(flat & along)
        left[largest] = False
    return planes


# ---------------- Image sources


ROW = 10
"""Number of values of a plane in :meth:`MirrorSequence.rows`, not counting the registry index of its shape."""


MOST_SEQUENCES = 20_000
"""Largest number of sequences with a given number of planes; each costs about 1 ms per ping and receiver."""


@dataclass(frozen=True)
class MirrorSequence:
    """Sequence of planes that sound meets on its path from (or, backwards, to) a transducer; empty for the direct path."""

    planes: tuple[MirrorPlane, ...] = ()

    @property
    def name(self) -> str:
        """Return the names of the mirrors in order from the transducer, such as ``surface-seabed``."""
        return "-".join(plane.name for plane in self.planes)

    def images(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the transducer's position and its successive images, one for each mirror ``(planes + 1, 3)`` [m]."""
        places = [np.asarray(place, dtype=float)]
        for plane in self.planes:
            last = places[-1]
            places.append(last - 2 * (plane.normal @ last - plane.offset) * plane.normal)
        return np.stack(places)

    @property
    def turn(self) -> NDArray[np.float64]:
        """Return the matrix that mirrors the transducer's vectors, such as its velocity ``(3, 3)``."""
        turn = np.eye(3)
        for plane in self.planes:
            turn = turn - 2 * np.outer(plane.normal, plane.normal @ turn)
        return turn

    def rows(self, place: NDArray[np.float64], registry: dict[int, int]) -> NDArray[np.float64]:
        """Return the table that visibility tests of the path need ``(planes, 11)``.

        A row holds the transducer's image in the mirrors before the plane, and the plane's normal, offset, reflection,
        roughness, slab and registry index of the shape.

        Args:
            place: position of the transducer [m].
            registry: registry index of each mirror's shape, keyed by the shape's index in the scene.
        """
        images = self.images(place)
        return np.array(
            [
                [
                    *(*image, *plane.normal, plane.offset),
                    *(plane.reflection, plane.roughness_m, plane.slab_m, registry[plane.shape]),
                ]
                for image, plane in zip(images[:-1], self.planes, strict=True)
            ]
        ).reshape(-1, ROW + 1)


def mirror_sequences(planes: Sequence[MirrorPlane], length: int) -> list[MirrorSequence]:
    """Return all sequences of ``length`` planes in which no plane follows itself.

    Raises:
        MitsonarError: there are more than :data:`MOST_SEQUENCES`.
    """
    count = len(planes) * (len(planes) - 1) ** (length - 1) if length else 1
    if count > MOST_SEQUENCES:
        raise MitsonarError(
            f"sound may meet the {len(planes)} planes of the mirrors in {count:,} orders of {length}: at most "
            f"{MOST_SEQUENCES:,} are traced; give fewer mirrors, or fewer bounces"
        )
    sequences: list[tuple[MirrorPlane, ...]] = [()]
    for _ in range(length):
        sequences = [
            (*sequence, plane) for sequence in sequences for plane in planes if not sequence or sequence[-1] is not plane
        ]
    return [MirrorSequence(sequence) for sequence in sequences]


# ---------------- Unfolded paths: visibility and loss


class ScatteringPoints(NamedTuple):
    """Points on surfaces.

    Attributes:
        position: position [m].
        exact: position in double precision, three arrays [m].
        normal: unit normal of the surface.
    """

    position: DeviceArray
    exact: list[DeviceArray]
    normal: DeviceArray


class PlaneRow(NamedTuple):
    """One mirror of a path on the device; see :meth:`~mitsonar.simulation.mirrors.MirrorSequence.rows`.

    Attributes:
        image: image of the transducer in the mirrors before this one, three arrays [m].
        normal: unit normal, three arrays.
        offset: offset of the plane [m].
        reflection: pressure reflection coefficient.
        roughness_m: rms height [m].
        slab_m: largest distance of the mirror's points from the plane [m].
        registry: registry index of the shape.
    """

    image: list[DeviceArray]
    normal: list[DeviceArray]
    offset: DeviceArray
    reflection: DeviceArray
    roughness_m: DeviceArray
    slab_m: DeviceArray
    registry: DeviceArray

    @classmethod
    def from_numbers(cls, numbers: list[DeviceArray]) -> PlaneRow:
        """Create a mirror from the eleven numbers of a row."""
        return cls(numbers[:3], numbers[3:6], *numbers[6:])


def unfolded(
    scene: mi.Scene,
    point: ScatteringPoints,
    image: list[DeviceArray],
    rows: list[PlaneRow],
    wavenumber: float,
    active: DeviceArray,
    moment: DeviceArray = None,
) -> tuple[DeviceArray, DeviceArray]:
    """Follow paths from points back to a transducer via its mirrors.

    A path is unfolded: each leg points to an image of the transducer, and its intersection with the plane is where the
    next leg begins.

    Args:
        scene: scene to trace.
        point: points where the paths begin; the normal is 0 if a point is not on a surface.
        image: image of the transducer in all mirrors [m].
        rows: the mirrors in order from the transducer.
        wavenumber: [rad/m].
        active: paths to follow.
        moment: index of the moment of each path in a moving scene; default: 0, or a still scene.

    Returns:
        Which paths are open (each leg meets its mirror first, and the last leg the transducer), and the product of the
        mirrors' reflection coefficients.
    """
    position, normal, far, factor = point.exact, point.normal, image, mi.Float(1)
    slab: DeviceArray = mi.Float(0)  # of the mirror that a leg leaves; its waves hide nothing
    for row in reversed(rows):
        # 1. the point and the image must be on opposite sides of the plane, and outside its waves
        above, below = (dot(row.normal, place) - row.offset for place in (position, far))
        size = dr.abs(position[0]) + dr.abs(position[1]) + dr.abs(position[2]) + 1
        # a point on the mirror itself has no path via it
        active = active & (above * below < 0) & (dr.abs(above) > size * OFF_SURFACE + row.slab_m)
        active = active & (dr.abs(below) > row.slab_m)
        # 2. the leg to the foot, where the line to the image crosses the plane, must not be obstructed
        part = above / (above - below)
        foot = [a + (b - a) * part for a, b in zip(position, far, strict=True)]
        leg = [b - a for a, b in zip(position, foot, strict=True)]
        u = mi.Vector3f(*(axis / length(leg) for axis in leg))
        active = active & _meets(scene, mi.Point3f(*position) + u * slab, normal, u, row, active, moment)
        # 3. loss at the mirror; the next leg begins at the foot and points to the image before this mirror
        normal = mi.Normal3f(*row.normal)
        facing: DeviceArray = mi.Vector3f(*row.normal)
        cosine = dr.abs(dr.dot(facing, u))
        factor = factor * mi.Float(row.reflection) * smooth_share(mi.Float(row.roughness_m), cosine, wavenumber)
        position, far = foot, row.image
        slab = mi.Float(row.slab_m) / cosine
    # 4. the last leg, to the transducer itself
    last = [a - b for a, b in zip(position, far, strict=True)]
    distance = length(last)
    u = mi.Vector3f(*(axis / distance for axis in last))
    start = mi.Point3f(*position) - u * slab
    return active & ~hidden(scene, start, normal, u, mi.Float(distance) - slab, active, moment), factor


def _meets(
    scene: mi.Scene,
    start: DeviceArray,
    normal: DeviceArray,
    u: DeviceArray,
    row: PlaneRow,
    active: DeviceArray,
    moment: DeviceArray = None,
) -> DeviceArray:
    """Test whether rays from points meet a mirror's plane before anything else."""
    off = (1 + dr.abs(start.x) + dr.abs(start.y) + dr.abs(start.z)) * OFF_SURFACE
    ray = mi.Ray3f(start + normal * dr.select(dr.dot(normal, u) > 0, off, -off), u)
    if moment is not None:
        ray.time = moment
    hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)  # type: ignore[call-overload]
    index: DeviceArray = dr.reinterpret_array(mi.UInt32, hit.shape)
    met = ray.o + u * hit.t
    size = 1 + dr.abs(met.x) + dr.abs(met.y) + dr.abs(met.z)
    # the shape alone does not suffice, since a mesh may have several planes
    aside = dr.abs(dr.dot(mi.Vector3f(*row.normal), met) - mi.Float(row.offset))
    near = 4 * size * OFF_SURFACE + mi.Float(row.slab_m)
    return hit.is_valid() & (index == mi.UInt32(row.registry)) & (aside < near)


# ---------------- Return paths via a second mirror


MOST_SECOND = 8
"""Largest number of planes for return paths; each costs two rays for every ray."""

ON_PLANE = 1e-4
"""Tolerance for a point on a plane, as a fraction of its distance from the origin."""


@dataclass(frozen=True)
class SecondMirror:
    """Plane of a mirror, and the registry index of its shape, by which kernels identify it."""

    plane: MirrorPlane
    registry: int

    @property
    def normal(self) -> mi.Vector3d:
        """Return the unit normal."""
        return mi.Vector3d(*self.plane.normal.tolist())

    @property
    def place(self) -> mi.Vector3d:
        """Return a point on the plane [m]."""
        return mi.Vector3d(*(self.plane.normal * self.plane.offset).tolist())


@dataclass(frozen=True)
class ReturnPath:
    """Return path from points to the sonar via one plane.

    Attributes:
        mirror: the plane.
        u: direction from the image of the sonar to the points.
        distance: distance from that image [m].
        factor: factor of the mirror on the amplitude.
        is_open: whether the path is unobstructed, and the plane differs from that of the outward path.
    """

    mirror: SecondMirror
    u: DeviceArray
    distance: DeviceArray
    factor: DeviceArray
    is_open: DeviceArray


@dataclass(frozen=True)
class SecondMirrors:
    """Planes for return paths.

    The sonar's image behind a plane gives the path back via a mirror other than that of the outward path.

    Attributes:
        mirrors: the planes.
        wavenumber: wavenumber of the carrier [1/m].
    """

    mirrors: tuple[SecondMirror, ...]
    wavenumber: float

    @classmethod
    def from_scene(cls, scene: mi.Scene, mirrors: Mirrors | None, wavenumber: float) -> SecondMirrors | None:
        """Find the planes of a scene's mirrors; None if there are fewer than two or more than :data:`MOST_SECOND`."""
        planes = mirror_planes(scene, mirrors)
        if not 2 <= len(planes) <= MOST_SECOND:
            return None
        shapes = scene.shapes()
        return cls(tuple(SecondMirror(plane, registry_index(shapes[plane.shape])) for plane in planes), wavenumber)

    def return_paths(
        self,
        scene: DeviceArray,
        origin: DeviceArray,
        point: tuple[DeviceArray, DeviceArray],
        first: tuple[DeviceArray, DeviceArray],
        active: DeviceArray,
        moment: DeviceArray = None,
    ) -> Iterator[ReturnPath]:
        """Yield the return path via each plane.

        Args:
            scene: scene to trace.
            origin: position of the sonar [m].
            point: position and normal where rays meet a rough surface.
            first: position and normal where they met their mirror.
            active: rays to follow.
            moment: index of the moment of each ray in a moving scene.
        """
        place, normal = point
        exact = [mi.Float64(value) for value in place]
        sonar: DeviceArray = mi.Vector3d(origin)
        scattering = ScatteringPoints(mi.Point3f(place), exact, normal)
        for mirror in self.mirrors:
            # image of the sonar, and the direct line from it to the points
            plane, facing = mirror.plane, mirror.normal
            image = sonar - facing * (2 * (dr.dot(facing, sonar) - plane.offset))
            from_image: DeviceArray = mi.Vector3d(*exact) - image
            distance = dr.norm(from_image)
            row = PlaneRow(
                image=list(sonar),
                normal=[mi.Float64(value) for value in plane.normal.tolist()],
                offset=mi.Float64(plane.offset),
                reflection=mi.Float64(plane.reflection),
                roughness_m=mi.Float64(plane.roughness_m),
                slab_m=mi.Float64(0),
                registry=mi.UInt32(mirror.registry),
            )
            # the plane of the outward path is left out: callers sum that return path separately
            eligible = active & ~_on(plane, *first)
            is_open, factor = unfolded(scene, scattering, list(image), [row], self.wavenumber, eligible, moment)
            yield ReturnPath(mirror, mi.Vector3f(from_image / distance), mi.Float(distance), factor, is_open)


def _on(plane: MirrorPlane, place: DeviceArray, normal: DeviceArray) -> DeviceArray:
    """Test whether the mirrors that rays met lie in a plane."""
    facing: DeviceArray = mi.Vector3f(*plane.normal.tolist())
    along: DeviceArray = dr.abs(dr.dot(facing, normal))
    off: DeviceArray = dr.abs(dr.dot(facing, place) - plane.offset)
    size = float(1 + np.abs(plane.offset))
    return (along > 1 - ON_PLANE) & (off < ON_PLANE * (size + dr.norm(place)))


def second_notes(scene: mi.Scene, mirrors: Mirroring) -> list[str]:
    """Return a note if mirrors have too many planes for paths out via one and back via another."""
    count = len(mirror_planes(scene, mirror_of(scene, mirrors)))
    if count <= MOST_SECOND:
        return []
    return [
        f"the mirrors have {count} planes: ghosts out via one plane and back via another need {MOST_SECOND} at most, "
        "and are left out"
    ]


# ---------------- Notes on too large reflectivities


def bright_notes(scene: mi.Scene, surfaces: Surfaces) -> list[str]:
    """Return a note if meshes without a material have a Lambert's mu above 1 / pi.

    Such surfaces reflect more energy than arrives. This is harmless in one reflection, but too loud in several.

    Args:
        scene: any Mitsuba scene.
        surfaces: surface tables of the scene.
    """
    rows = np.array(surfaces.facets).reshape(-1, 4)[:, 3]
    bright, largest = [], 1 / math.pi + 1e-3
    for first, _, number, material in np.array(surfaces.shapes).reshape(-1, 4):
        if first < 0 or number < 0 or material >= 0:
            continue
        shape = scene.shapes()[number]
        assert isinstance(shape, mi.Mesh)
        if (rows[first : first + shape.face_count()] > largest).any():
            bright.append(shape.id() or f"shape number {number}")  # Mitsuba merges meshes into one without a name
    if not bright:
        return []
    names = ", ".join(sorted(bright)[:3]) + (" ..." if len(bright) > 3 else "")
    return [
        f"reflectivities above 1/pi = 0.318 reflect more than arrives: paths of several reflections via {names} are "
        "too loud; give a reflectance of 0.318 at most, or a material"
    ]
