"""Look up the surface that a ray meets: normal, reflectivity and shape, from a table of facets where possible.

The reflectivity of a surface is one number in 0..1; colours are converted to luminance:

- ``acoustic_material``: a constant of its law, or for a sonar (:meth:`Surfaces.at_frequency_of`) the value of its law at
  the angle;
- a BSDF with a diffuse reflectance (``diffuse``, ``plastic``, ``roughplastic``; through ``twosided``, ``mask``,
  ``bumpmap``, ``normalmap``): that reflectance, textured or not;
- ``principled``, ``principledthin``: the base colour; ``blendbsdf``: the weighted mean of the two;
- any other (``dielectric``, ``conductor``, ``null`` ...) has none and gets :data:`DEFAULT_REFLECTIVITY`.

:attr:`Surfaces.notes` names the shapes of the last two kinds.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import drjit as dr
import mitsuba as mi

from mitsonar.acoustics.materials import frequency_notes
from mitsonar.arrays import DeviceArray
from mitsonar.instruments.sonar import Sonar
from mitsonar.plugins.acoustic_material import AcousticMaterial
from mitsonar.plugins.bsdf_reflectance import (
    APPROXIMATED,
    BENT,
    DEFAULT_REFLECTIVITY,
    DIFFUSE,
    TWO_FACED,
    WRAPPERS,
    by_vertex,
    constant_on_facets,
    kinds_and_textures,
    reduce_colour,
    reflectivity_at,
    unit,
)
from mitsonar.plugins.material_laws import law_rows, material_of, mirror_rows, weighed

__all__ = ["Hit", "Surfaces", "facet_points", "grain_key", "registry_index"]


@dataclass
class Hit:
    """Intersections of rays: ``valid``, distance ``t`` [m], unit normal ``n``, ``reflectivity``, shape, object and material.

    The reflectivity lies in 0..1, or in 0..1 / cosine where a law is evaluated. ``material`` is -1 for a shape without one.
    """

    valid: DeviceArray
    t: DeviceArray
    n: DeviceArray
    reflectivity: DeviceArray
    shape_id: DeviceArray
    object_id: DeviceArray
    material: DeviceArray


@dataclass
class Surfaces:
    """Tables of the shapes of a scene, built once per scene by :meth:`from_scene`.

    A triangle of a mesh is a row of four floats, normal and reflectivity. One fetch of 16 bytes replaces two virtual calls
    and a dozen scattered reads. If the reflectivity varies within triangles, a second table provides uv, and the BSDF is
    evaluated. Mitsuba itself evaluates other shapes, instances, bump maps and vertex colours.

    Attributes:
        facets: normal and reflectivity (negative: evaluate the BSDF), four floats per triangle.
        corners: uv of the first corner and its change to the second and third, eight floats per triangle (two unused).
        shapes: by registry index, four numbers per shape: first facet (-1: not in the tables), first row in ``corners``,
            index of the shape in ``scene.shapes()``, number of its material (-1: none).
        constant: by registry index, reflectivity of a shape without a diffuse reflectance; negative: evaluate its BSDF.
        objects: number of the object that a triangle belongs to (the mesh's attribute ``face_id``, 0 without it), one per
            triangle; a single 0 if no mesh has the attribute.
        laws: scattering laws of the materials, for the sonar of :meth:`at_frequency_of`; a single 0 without a sonar.
        mirrors: by material, reflection coefficient at normal incidence and rms height [m]; zeros without a mirror part.
        grains: by number of shape, key of its scatterers; see :func:`grain_key`.
        materials: one BSDF per material, by number.
        lawful: whether the laws are evaluated.
        textured: whether any shape has a reflectivity that varies within a triangle.
        foreign: whether any shape is not in the tables.
        notes: notes for the user on the scene's BSDFs, one sentence each.
    """

    facets: mi.Float
    corners: mi.Float
    shapes: mi.Int32
    constant: mi.Float
    objects: mi.Float
    laws: mi.Float
    mirrors: mi.Float
    grains: mi.UInt32
    materials: list[AcousticMaterial]
    lawful: bool
    textured: bool
    foreign: bool
    notes: list[str]

    @classmethod
    def from_scene(cls, scene: mi.Scene, shapes: Sequence[mi.Shape] | None = None) -> Surfaces:
        """Build the tables of a scene, with one reflectivity per material for all angles; see :meth:`at_frequency_of`.

        Args:
            scene: scene to trace.
            shapes: replacements for the shapes of the scene, in the same order; default: the shapes themselves.

        Raises:
            MitsonarError: a shape with several materials.
        """
        # Rows are addressed by registry index, the number by which kernels identify a shape.
        shapes = scene.shapes() if shapes is None else shapes
        size = 1 + max((registry_index(shape) for shape in shapes), default=0)
        rows = [[-1, 0, -1, -1] for _ in range(size)]
        constant = [-1.0] * size
        facets: list[mi.Float] = []
        corners: list[mi.Float] = []
        tabled: list[mi.Mesh] = []
        materials: list[AcousticMaterial] = []
        named: dict[str, list[str]] = {"approximated": [], "without": []}
        facet_count = corner_count = 0
        for number, shape in enumerate(shapes):
            index = registry_index(shape)
            rows[index][2] = number
            if shape.bsdf() is None:  # an instance, for which Mitsuba evaluates the shapes of its group
                continue
            kinds, textures = kinds_and_textures(shape.bsdf())
            rows[index][3] = _number_of_material(shape, materials) if AcousticMaterial.__name__ in kinds else -1
            constant[index] = _fixed_reflectivity(shape, kinds, named)
            # Tabulate a mesh if its reflectivity is constant on facets, or a function of uv. Bump maps and vertex attributes
            # need Mitsuba.
            flat = constant[index] >= 0 or (TWO_FACED not in kinds and all(map(constant_on_facets, textures)))
            if shape.is_mesh() and (flat or not (kinds & BENT or any(map(by_vertex, textures)))):
                rows[index][:2] = facet_count, corner_count
                tabled.append(mesh := cast(mi.Mesh, shape))
                facets.append(_facet_rows(mesh, constant[index], flat))
                facet_count += mesh.face_count()
                if not flat:
                    corners.append(_corner_rows(mesh))
                    corner_count += mesh.face_count()
        tables = cls(
            facets=dr.concat(facets) if facets else dr.zeros(mi.Float, 4),
            corners=dr.concat(corners) if corners else dr.zeros(mi.Float, 8),
            shapes=mi.Int32([number for row in rows for number in row]),
            constant=mi.Float(constant),
            objects=_object_ids(tabled),
            laws=dr.zeros(mi.Float, 1),
            mirrors=mirror_rows([one.material for one in materials]) if materials else dr.zeros(mi.Float, 1),
            grains=mi.UInt32([grain_key(shape.id(), number) for number, shape in enumerate(shapes)] or [0]),
            materials=materials,
            lawful=False,
            textured=bool(corners),
            foreign=len(facets) < len(shapes),
            notes=_notes(named),
        )
        dr.eval(tables.arrays())
        return tables

    def adopt(self, updated: Surfaces) -> bool:
        """Replace the tables by those of the current state of the same scene.

        Returns:
            False, with nothing replaced, if launches recorded with these tables are incompatible with the new ones.
        """
        if any(getattr(self, name) != getattr(updated, name) for name in ("lawful", "textured", "foreign", "notes")):
            return False
        for name in ("materials", *self.arrays()):
            setattr(self, name, getattr(updated, name))
        return True

    def turn_facets(self, mesh: mi.Mesh) -> None:
        """Update the normals of a mesh whose vertices have moved; reflectivities remain."""
        first = int(self.shapes[4 * registry_index(mesh)])
        if first < 0:
            return
        facet = dr.arange(mi.UInt32, mesh.face_count())
        normal = facet_points(mesh, facet, mi.Point2f(1 / 3)).n
        facets = mi.Float(self.facets)
        for axis, value in enumerate((normal.x, normal.y, normal.z)):
            dr.scatter(facets, value, (facet + first) * 4 + axis)
        self.facets = facets
        dr.eval(self.facets)

    def arrays(self) -> dict[str, DeviceArray]:
        """Return the tables by name, as inputs of a launch."""
        names = ("facets", "corners", "shapes", "constant", "objects", "laws", "mirrors", "grains")
        return {name: getattr(self, name) for name in names}

    def at_frequency_of(self, sonar: Sonar) -> Surfaces:
        """Return the tables with the laws of the materials at the frequency of a sonar, and notes on them.

        The models ``physical`` and ``coherent`` evaluate the law at each ray's angle. The model ``thesis`` uses mu, or sigma
        at normal incidence, for all angles. Without a ``frequency_hz`` the middle of a material's band is used.
        """
        if not self.materials:
            return self
        laws = law_rows(self.materials, sonar)
        dr.eval(laws)
        materials = list(dict.fromkeys(one.material for one in self.materials))
        notes = frequency_notes(materials, sonar.frequency_hz, sonar.sound_speed)
        return replace(self, laws=laws, lawful=True, notes=[*self.notes, *notes])

    def renew_laws(self, sonar: Sonar) -> None:
        """Evaluate the laws again, whose constants may have changed or have derivatives now."""
        if self.lawful:
            self.laws = law_rows(self.materials, sonar)

    def mirror(self, material: DeviceArray) -> tuple[DeviceArray, DeviceArray]:
        """Return the reflection coefficient at normal incidence and rms height [m] of materials; 0 for number -1."""
        pair = dr.gather(mi.Vector2f, self.mirrors, mi.UInt32(dr.select(material >= 0, material, 0)), material >= 0)
        return pair.x, pair.y

    def grain(self, hit: Hit) -> DeviceArray:
        """Return the key of the scatterers of the shapes that are hit."""
        return dr.gather(mi.UInt32, self.grains, mi.UInt32(hit.shape_id), hit.valid & (hit.shape_id >= 0))

    def hit(self, scene: mi.Scene, ray: mi.Ray3f, active: DeviceArray = True, *, attached: bool = False) -> Hit:
        """Trace rays to the nearest surface, without evaluation, so that later operations join the same kernel.

        Args:
            scene: scene to trace.
            ray: rays.
            active: which rays to trace.
            attached: whether the results carry derivatives by ray, geometry and reflectance.
        """
        coherent: DeviceArray = True
        intersection = scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
        return self.read(intersection, ray, active, attached=attached)

    def read(
        self,
        intersection: mi.PreliminaryIntersection3f,
        ray: mi.Ray3f,
        active: DeviceArray = True,
        *,
        attached: bool = False,
    ) -> Hit:
        """Return the surface at given intersections; rays and intersections are in the axes of the shape's scene."""
        # 1. Find the shape, and read normal and reflectivity of its facet from the table.
        valid = intersection.is_valid() & active
        index: DeviceArray = dr.reinterpret_array(mi.UInt32, intersection.shape)
        known = valid & (index * 4 < dr.width(self.shapes))
        shape = dr.gather(mi.Vector4i, self.shapes, index, known)
        first = dr.select(known, shape.x, -1)
        tabled = (first >= 0) & (not attached)  # tables have no derivatives
        row = dr.gather(mi.Vector4f, self.facets, mi.UInt32(first) + intersection.prim_index, tabled)
        normal: DeviceArray = mi.Normal3f(row.x, row.y, row.z)
        reflectivity: DeviceArray = row.w
        shape_id: DeviceArray = dr.select(known, shape.z, -1)
        # 2. Evaluate textures that vary within a facet, at a uv from the table.
        if self.textured:
            evaluated = tabled & (reflectivity < 0)
            si = self._on_facet(intersection, ray, normal, mi.UInt32(shape.y), evaluated)
            reflectance: DeviceArray = reduce_colour(intersection.shape.bsdf().eval_diffuse_reflectance(si, evaluated))
            reflectivity = dr.select(evaluated, unit(reflectance), reflectivity)
        # 3. Let Mitsuba evaluate shapes that are not in the tables. An instance counts as one shape of the scene.
        t: DeviceArray = intersection.t
        if self.foreign or attached:
            evaluated = valid & ~tabled
            si = intersection.compute_surface_interaction(ray, mi.RayFlags.UV | mi.RayFlags.ShadingFrame, evaluated)
            fixed = dr.select(known, dr.gather(mi.Float, self.constant, index, known), -1)
            reflectance = reduce_colour(si.bsdf().eval_diffuse_reflectance(si, evaluated & (fixed < 0)))
            t = si.t if attached else t
            normal = dr.select(tabled, normal, si.n)
            reflectivity = dr.select(tabled, reflectivity, unit(dr.select(fixed < 0, reflectance, fixed)))
            top: DeviceArray = dr.reinterpret_array(mi.UInt32, intersection.instance)
            inside = valid & (top > 0) & (top * 4 < dr.width(self.shapes))
            shape_id = dr.select(inside, dr.gather(mi.Vector4i, self.shapes, top, inside).z, shape_id)
        # 4. Apply the scattering law of the material at the angle of the ray.
        material: DeviceArray = dr.select(known, shape.w, -1) if self.materials else mi.Int32(-1)
        if self.lawful:
            cosine: DeviceArray = dr.abs(dr.dot(normal, ray.d))
            reflectivity = weighed(self.laws, material, reflectivity, dr.select(cosine < 1, cosine, 1))
        # 5. Read the object number of the facet.
        numbered = (first >= 0) & (dr.width(self.objects) > 1)
        object_id = dr.gather(mi.Float, self.objects, mi.UInt32(first) + intersection.prim_index, numbered)
        return Hit(valid, t, normal, reflectivity, shape_id, object_id, material)

    def _on_facet(
        self,
        intersection: mi.PreliminaryIntersection3f,
        ray: mi.Ray3f,
        normal: DeviceArray,
        first: mi.UInt32,
        active: DeviceArray,
    ) -> mi.SurfaceInteraction3f:
        """Return the inputs of a texture or BSDF at a point: uv, position, triangle, and the side that is hit."""
        corner = (first + intersection.prim_index) * 2
        uv = dr.gather(mi.Vector4f, self.corners, corner, active)
        change = dr.gather(mi.Vector4f, self.corners, corner + 1, active)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(intersection.t))
        offset: DeviceArray = ray.d * intersection.t
        si.t, si.p, si.n = intersection.t, ray.o + offset, normal
        si.uv = mi.Point2f(uv.x, uv.y) + mi.Point2f(uv.z, uv.w) * intersection.prim_uv.x
        si.uv += mi.Point2f(change.x, change.y) * intersection.prim_uv.y
        si.shape, si.prim_index = intersection.shape, intersection.prim_index
        si.wi = mi.Vector3f(0, 0, -dr.dot(normal, ray.d))
        return si


def grain_key(name: str, number: int) -> int:
    """Return the key of the scatterers of a shape: a hash of its name up to a colon, or its number if it has none.

    Scatterers of named shapes therefore stay where they are when shapes are added to a scene, or a mesh is divided into
    ``hull:1`` and ``hull:2``. Shapes that Mitsuba merges have no name.
    """
    return zlib.crc32(name.split(":")[0].encode()) >> 4 if name else number


def registry_index(shape: mi.Shape) -> int:
    """Return the number by which kernels identify a shape, which is that of ``intersection.shape``."""
    index: DeviceArray = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))
    return int(index[0])


def _fixed_reflectivity(shape: mi.Shape, kinds: set[str], named: dict[str, list[str]]) -> float:
    """Return the reflectivity of a shape without diffuse reflectance, else -1; record shapes for the notes."""
    if not kinds <= DIFFUSE | APPROXIMATED | WRAPPERS:
        named["without"] += [shape.id()]
        return DEFAULT_REFLECTIVITY
    if kinds & APPROXIMATED:
        named["approximated"] += [shape.id()]
    return -1.0


def _number_of_material(shape: mi.Shape, materials: list[AcousticMaterial]) -> int:
    """Return the number of a shape's material, which is appended to ``materials`` unless it is present.

    Equal materials of different BSDFs have numbers of their own, since each has constants that may change.
    """
    shape_material = material_of(shape)
    assert shape_material is not None
    for number, known in enumerate(materials):
        if shape_material is known:
            return number
    materials.append(shape_material)
    return len(materials) - 1


def _facet_rows(mesh: mi.Mesh, constant: float, flat: bool) -> DeviceArray:
    """Return the normal and reflectivity of each triangle, as computed by Mitsuba."""
    si = facet_points(mesh, dr.arange(mi.UInt32, mesh.face_count()), mi.Point2f(1 / 3))
    reflectivity: DeviceArray = mi.Float(-1)
    if flat:
        reflectivity = reflectivity_at(mesh.bsdf(), si) if constant < 0 else mi.Float(constant)
    rows: DeviceArray = dr.ravel(mi.Vector4f(si.n.x, si.n.y, si.n.z, reflectivity))
    return rows


def _object_ids(meshes: list[mi.Mesh]) -> mi.Float:
    """Return the attribute ``face_id`` of all triangles, 0 for meshes without it; a single 0 if no mesh has it."""
    given = [bool(mesh.has_attribute("face_id")[0]) for mesh in meshes]
    if not any(given):
        return dr.zeros(mi.Float, 1)
    parts = []
    for mesh, has in zip(meshes, given, strict=True):
        ids = mi.Float(mesh.attribute_buffer("face_id")) if has else dr.zeros(mi.Float, mesh.face_count())
        parts.append(ids if dr.width(ids) == mesh.face_count() else dr.zeros(mi.Float, mesh.face_count()))
    return dr.concat(parts)


def _corner_rows(mesh: mi.Mesh) -> mi.Float:
    """Return the uv of each triangle's first corner, and its change to the second and third."""
    facets = dr.arange(mi.UInt32, mesh.face_count())
    first, second, third = (facet_points(mesh, facets, mi.Point2f(*corner)).uv for corner in ((0, 0), (1, 0), (0, 1)))
    second, third = second - first, third - first
    rows = mi.Float(dr.zeros(mi.Float, 8 * mesh.face_count()))
    start = dr.arange(mi.UInt32, mesh.face_count()) * 8
    for offset, value in enumerate((first.x, first.y, second.x, second.y, third.x, third.y)):
        dr.scatter(rows, value, start + offset)
    return rows


def facet_points(mesh: mi.Mesh, facet: DeviceArray, uv: mi.Point2f) -> mi.SurfaceInteraction3f:
    """Return points on triangles.

    Args:
        mesh: the mesh of the triangles.
        facet: indices of the triangles, ``UInt32``.
        uv: second and third barycentric coordinates of the points.
    """
    count = dr.width(facet)
    intersection: DeviceArray = dr.zeros(mi.PreliminaryIntersection3f, count)
    intersection.valid = dr.full(mi.Bool, True, count)
    intersection.t = mi.Float(1)
    intersection.prim_index = facet
    intersection.prim_uv = uv
    intersection.shape = mi.ShapePtr(mesh)
    ray = dr.zeros(mi.Ray3f, count)
    ray.d = mi.Vector3f(0, 0, 1)
    return cast(
        mi.SurfaceInteraction3f, intersection.compute_surface_interaction(ray, mi.RayFlags.UV | mi.RayFlags.ShadingFrame)
    )


def _notes(named: dict[str, list[str]]) -> list[str]:
    notes = []
    if named["approximated"]:
        notes.append(
            f"the BSDF of {', '.join(named['approximated'])} is not diffuse: its base colour, or the weighted mean of a "
            "blend, is used as reflectivity"
        )
    if named["without"]:
        notes.append(
            f"the BSDF of {', '.join(named['without'])} has no diffuse reflectance: reflectivity "
            f"{DEFAULT_REFLECTIVITY:g} is used; give the shape a diffuse BSDF to choose it"
        )
    return notes
