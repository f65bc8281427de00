"""The flat mirrors of a scene as planes, and the others as facets, in double precision."""

from __future__ import annotations

from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.simulation.mirror_parts import Mirrors

__all__ = ["MOST_FACETS", "MOST_PLANES", "FlatMirrors", "MirrorFacets", "MirrorPlane", "flat_mirrors"]

MOST_PLANES = 16
"""Planes of a mesh, at most; one of more is a curved surface."""

MOST_FACETS = 2_000_000
"""Triangles of a curved mirror, at most: 1 ms of processor time a thousand and ping."""

STEEPEST, HIGHEST = 0.5, 0.1
"""A mesh is a plane with waves where no facet leans by more than 60 deg, and rms heights stay below a part of its size."""

FLAT = ("Rectangle", "Disk")
"""Mitsuba's shapes that are flat."""

SAME_PLANE = 2e-6
"""Facets are on one plane where normals and offsets (as a part of the mesh's size) differ by less."""


@dataclass(frozen=True)
class MirrorPlane:
    """One plane of a mirror, ``normal . x = offset``; both sides reflect.

    Attributes:
        name: of the shape.
        shape: its place in ``scene.shapes()``.
        normal: unit vector ``(3,)``.
        offset: [m].
        reflection: coefficient V of pressures, -1 to 1.
        roughness_m: rms height [m].
        slab_m: how far the shape's points lie off the plane, at most [m]; 0 where it is flat.
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
    """The triangles of a mirror that is no plane.

    Attributes:
        name: of the shape.
        corners: ``(facets, 3, 3)`` [m].
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
        planes: of what is flat.
        facets: of what is not flat.
        means: mean planes of the latter, for ways of several reflections; their roughness is that of all waves.
        notes: on shapes that mirror nothing.
    """

    planes: list[MirrorPlane] = field(default_factory=list)
    facets: list[MirrorFacets] = field(default_factory=list)
    means: list[MirrorPlane] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def reflecting(self, reflections: int) -> list[MirrorPlane]:
        """Return the planes of ways of several reflections; of ways of one, which the facets have, the flat ones."""
        return self.planes if reflections < 2 else self.planes + self.means

    def notes_on(self, bounces: int) -> list[str]:
        """Return what a user should know, given the largest number of reflections."""
        found = list(self.notes)
        for mirror in self.facets if bounces > 1 else []:
            mean = next((plane for plane in self.means if plane.name == mirror.name), None)
            if mean is None:
                found.append(f"the mirror {mirror.name} is no plane with waves: it reflects once and makes no ghosts")
            else:
                found.append(
                    f"the mirror {mirror.name} is not flat: ways of several reflections have the coherent part of its "
                    f"mean plane, with the loss of its waves' rms height, {mean.roughness_m:.2g} m; "
                    "what waves scatter is left out"
                )
        return found


def flat_mirrors(scene: mi.Scene, mirrors: Mirrors | None) -> FlatMirrors:
    """Find the planes of a scene's mirrors: rectangles, disks, and meshes of up to :data:`MOST_PLANES` planes.

    Args:
        scene: any.
        mirrors: parts of its shapes.

    Raises:
        MitsonarError: a curved mirror of more than :data:`MOST_FACETS` triangles.
    """
    found = FlatMirrors()
    for place, shape in enumerate(scene.shapes() if mirrors is not None else []):
        assert mirrors is not None
        part = float(mirrors.reflection[place]), float(mirrors.roughness_m[place])
        if part[0] == 0:
            continue
        name = shape.id()
        kind = shape.class_name()
        if not isinstance(shape, mi.Mesh) and kind not in FLAT:
            found.notes.append(
                f"shape {name} ({kind.lower()}) is curved and mirrors nothing in impulse responses: give it as a mesh"
            )
            continue
        corners = _triangles(shape)
        planes = _planes(corners)
        if planes is not None:
            found.planes.extend(MirrorPlane(name, place, normal, offset, *part) for normal, offset in planes)
        elif len(corners) > MOST_FACETS:
            raise MitsonarError(
                f"the mirror {name} has {len(corners):,} triangles: at most {MOST_FACETS:,} are possible; give it fewer, or "
                "make it flat"
            )
        else:
            found.facets.append(MirrorFacets(name, corners, *part))
            mean = _mean_plane(name, place, corners, *part)
            found.means.extend([] if mean is None else [mean])
    return found


def mirror_planes(scene: mi.Scene, mirrors: Mirrors | None) -> list[MirrorPlane]:
    """Return the planes of a scene's flat mirrors; mirrors that are not flat have none."""
    found = []
    for place, shape in enumerate(scene.shapes() if mirrors is not None else []):
        assert mirrors is not None
        part = float(mirrors.reflection[place]), float(mirrors.roughness_m[place])
        if part[0] != 0 and (isinstance(shape, mi.Mesh) or shape.class_name() in FLAT):
            planes = _planes(_triangles(shape)) or []
            found += [MirrorPlane(shape.id(), place, normal, offset, *part) for normal, offset in planes]
    return found


def _triangles(shape: mi.Shape) -> NDArray[np.float64]:
    """Return the triangles of a mesh ``(n, 3, 3)`` [m]; one triangle in the plane of a rectangle or disk."""
    if isinstance(shape, mi.Mesh):
        vertices = np.array(shape.vertex_positions_buffer(), dtype=float).reshape(-1, 3)
        return np.asarray(vertices[np.array(shape.faces_buffer(), dtype=np.int64).reshape(-1, 3)])
    matrix = np.array(mi.traverse(shape)["to_world"].matrix, dtype=float).reshape(4, 4, -1)[..., 0]
    middle, across, along = matrix[:3, 3], matrix[:3, 0], matrix[:3, 1]
    return np.stack([middle, middle + across, middle + along])[None]


def _mean_plane(
    name: str, place: int, corners: NDArray[np.float64], reflection: float, roughness_m: float
) -> MirrorPlane | None:
    """Return the plane through the middle of a mesh of waves; None where heights or slopes are too large for waves."""
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
    return MirrorPlane(name, place, up, float(up @ middle), reflection, float(np.hypot(height, roughness_m)), slab)


def _planes(corners: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], float]] | None:
    """Return normal and offset of each plane that triangles lie in; None where there are more than :data:`MOST_PLANES`."""
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
        largest = int(np.argmax(np.where(left, area, 0)))
        chosen, offset = normal[largest], float(normal[largest] @ corners[largest].mean(axis=0))
        flat = np.abs(corners @ chosen - offset).max(axis=1) < SAME_PLANE * size
        along = np.abs(normal @ chosen) > 1 - 1e-4
        planes.append((chosen, offset))
        left &= ~(flat & along)
        left[largest] = False
    return planes
