"""What a ray meets: normal, reflectivity and shape, read from a table of facets where a surface allows it.

Reflectivity of a surface (one number in 0..1; colours count by their luminance):

- a BSDF with a diffuse reflectance (``diffuse``, ``plastic``, ``roughplastic``; through ``twosided``, ``mask``,
  ``bumpmap``, ``normalmap``): that reflectance, textured or not;
- ``principled``, ``principledthin``: the base colour; ``blendbsdf``: the weighted mean of the two;
- any other (``dielectric``, ``conductor``, ``null`` ...) has none: :data:`DEFAULT_REFLECTIVITY` stands for it.

The last two kinds are named in :attr:`Surfaces.notes`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

__all__ = ["DEFAULT_REFLECTIVITY", "Hit", "Surfaces"]

DEFAULT_REFLECTIVITY = 0.5

DIFFUSE = {"SmoothDiffuse", "SmoothPlastic", "RoughPlastic"}
APPROXIMATED = {"Principled", "PrincipledThin", "BlendBSDF"}
WRAPPERS = {"TwoSidedBRDF", "MaskBSDF", "BumpMap", "NormalMap"}


@dataclass
class Hit:
    """Where rays end: ``valid``, distance ``t`` [m], unit normal ``n``, ``reflectivity`` 0..1, ``shape_id``."""

    valid: Any
    t: Any
    n: Any
    reflectivity: Any
    shape_id: Any


@dataclass
class Surfaces:
    """Tables of a scene's shapes; made once a scene by :meth:`of`.

    A mesh whose reflectivity is constant on each triangle is a row of four floats a triangle, normal and
    reflectivity: one fetch of 16 bytes replaces two virtual calls and a dozen scattered reads. Other shapes are asked
    through Mitsuba. Both give the same bits.

    Attributes:
        facets: normal and reflectivity, four floats a triangle.
        first: first facet of a shape by its registry index; -1: ask Mitsuba.
        constant: reflectivity of a shape that has no diffuse reflectance, by registry index; negative: ask its BSDF.
        shape_id: place of a shape in ``scene.shapes()``, by registry index.
        tabulated: every shape of the scene is in the table.
        notes: what a user should know about the scene's BSDFs, a sentence each.
    """

    facets: mi.Float
    first: mi.Int32
    constant: mi.Float
    shape_id: mi.Int32
    tabulated: bool
    notes: list[str]

    @classmethod
    def of(cls, scene: mi.Scene) -> Surfaces:
        """The tables of a scene."""
        shapes = scene.shapes()
        size = 1 + max((_registry_index(shape) for shape in shapes), default=0)
        first, constant, ids = [-1] * size, [-1.0] * size, [-1] * size
        rows: list[mi.Float] = []
        named: dict[str, list[str]] = {"approximated": [], "without": []}
        facets = 0
        for number, shape in enumerate(shapes):
            index = _registry_index(shape)
            ids[index] = number
            if shape.bsdf() is None:  # an instance: its group's shapes are asked through Mitsuba
                continue
            kinds, textures = _walk(shape.bsdf())
            if not kinds <= DIFFUSE | APPROXIMATED | WRAPPERS:
                constant[index] = DEFAULT_REFLECTIVITY
                named["without"] += [shape.id()]
            elif kinds & APPROXIMATED:
                named["approximated"] += [shape.id()]
            if shape.is_mesh() and (constant[index] >= 0 or all(map(_constant_on_facets, textures))):
                first[index] = facets
                rows.append(_facet_rows(shape, constant[index]))
                facets += shape.face_count()
        tables = cls(
            facets=dr.concat(rows) if rows else mi.Float([0.0] * 4),
            first=mi.Int32(first),
            constant=mi.Float(constant),
            shape_id=mi.Int32(ids),
            tabulated=len(rows) == len(shapes) > 0,
            notes=_notes(named),
        )
        dr.eval(tables.facets, tables.first, tables.constant, tables.shape_id)
        return tables

    def hit(self, scene: mi.Scene, ray: mi.Ray3f, active: Any = True) -> Hit:
        """Trace rays to the nearest surface. The arrays are not evaluated: what follows joins the same kernel."""
        found = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        valid = found.is_valid() & active
        index = dr.reinterpret_array(mi.UInt32, found.shape)
        known = valid & (index < dr.width(self.first))
        first = dr.select(known, dr.gather(mi.Int32, self.first, index, known), -1)
        tabled = known & (first >= 0)
        row = dr.gather(mi.Vector4f, self.facets, mi.UInt32(first) + found.prim_index, tabled)
        normal, reflectivity = mi.Normal3f(row.x, row.y, row.z), row.w
        top = dr.select(found.instance != None, dr.reinterpret_array(mi.UInt32, found.instance), index)  # noqa: E711
        listed = valid & (top < dr.width(self.shape_id))
        shape_id = dr.select(listed, dr.gather(mi.Int32, self.shape_id, top, listed), -1)
        if not self.tabulated:
            asked = valid & ~tabled
            si = found.compute_surface_interaction(ray, mi.RayFlags.UV | mi.RayFlags.ShadingFrame, asked)
            fixed = dr.select(known, dr.gather(mi.Float, self.constant, index, known), -1)
            own = _one_number(si.bsdf().eval_diffuse_reflectance(si, asked & (fixed < 0)))
            normal = dr.select(tabled, normal, si.n)
            reflectivity = dr.select(tabled, reflectivity, _unit(dr.select(fixed < 0, own, fixed)))
        return Hit(valid, found.t, normal, reflectivity, shape_id)


def _registry_index(shape: mi.Shape) -> int:
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def _facet_rows(mesh: mi.Mesh, constant: float) -> mi.Float:
    """Normal and reflectivity of each triangle, as Mitsuba itself computes them."""
    count = mesh.face_count()
    found = dr.zeros(mi.PreliminaryIntersection3f, count)
    found.valid = dr.full(mi.Bool, True, count)
    found.t = mi.Float(1)
    found.prim_index = dr.arange(mi.UInt32, count)
    found.prim_uv = mi.Point2f(1 / 3, 1 / 3)
    found.shape = mi.ShapePtr(mesh)
    ray = dr.zeros(mi.Ray3f, count)
    ray.d = mi.Vector3f(0, 0, 1)
    si = found.compute_surface_interaction(ray, mi.RayFlags.UV | mi.RayFlags.ShadingFrame)
    own = _one_number(mesh.bsdf().eval_diffuse_reflectance(si)) if constant < 0 else mi.Float(constant)
    return dr.ravel(mi.Vector4f(si.n.x, si.n.y, si.n.z, _unit(own)))


def _one_number(spectrum: Any) -> mi.Float:
    return mi.luminance(spectrum) if mi.is_rgb else spectrum[0]


def _unit(value: mi.Float) -> mi.Float:
    """Into 0..1; by comparisons, since LLVM 15 and 16 abort on `max` (see simulation.variant)."""
    return dr.select(value > 0, dr.select(value < 1, value, 1), 0)


class _Children(mi.TraversalCallback):
    """Collects the objects directly below one."""

    def __init__(self) -> None:
        super().__init__()
        self.objects: list[mi.Object] = []

    def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
        if isinstance(value, mi.Object):
            self.objects.append(value)


def _walk(bsdf: mi.BSDF) -> tuple[set[str], list[mi.Object]]:
    """Class names of a BSDF and all nested ones, and the textures that their reflectance may come from."""
    children = _Children()
    bsdf.traverse(children)
    kinds, textures = {bsdf.class_name()}, []
    for child in children.objects:
        if isinstance(child, mi.BSDF):
            below = _walk(child)
            kinds |= below[0]
            textures += below[1]
        else:
            textures.append(child)
    return kinds, textures


def _constant_on_facets(texture: mi.Object) -> bool:
    name = texture.class_name()
    return name == "UniformSpectrum" or (name == "MeshAttribute" and 'name = "face_' in str(texture))


def _notes(named: dict[str, list[str]]) -> list[str]:
    notes = []
    if named["approximated"]:
        notes.append(
            f"the BSDF of {', '.join(named['approximated'])} is not diffuse: its base colour, or the weighted mean of a "
            "blend, is taken as reflectivity"
        )
    if named["without"]:
        notes.append(
            f"the BSDF of {', '.join(named['without'])} has no diffuse reflectance: reflectivity "
            f"{DEFAULT_REFLECTIVITY:g} is taken; give the shape a diffuse BSDF to choose it"
        )
    return notes
