"""How the separate process reads a USD stage.

    python -m mitsonar.bridges.usd_reading OUT.npz < request.json

The C++ library of USD may crash on a damaged file, and opens any file that a stage names. Therefore a process with limited
memory and time checks and reads the stage. It writes arrays to ``OUT.npz``, and a report on the prims as JSON to standard
output. :mod:`mitsonar.bridges.usd` starts the process and reads both.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pxr import Ar, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade

from mitsonar.io.system import limit_process

__all__: list[str] = []

Prim: TypeAlias = Any
"""A prim, attribute or layer of USD, whose Python bindings have no types."""

MAX_MEMORY_BYTES = 2**34
"""Limit of the address space [bytes]."""

MAX_CPU_S = 300
"""Limit of the processor time [s]."""

MAX_LAYERS = 10_000
MAX_PRIMS = 200_000
MAX_TRIANGLES = 50_000_000

GPRIMS = {
    "Cube": ("box", ("size",)),
    "Sphere": ("sphere", ("radius",)),
    "Cylinder": ("cylinder", ("radius", "height")),
    "Capsule": ("capsule", ("radius", "height")),
    "Cone": ("cone", ("radius", "height")),
    "Plane": ("plane", ("width", "length")),
}
"""Primitive and attributes of each type of prim that is defined by sizes."""

TIME = Usd.TimeCode.EarliestTime()


class RefusedError(Exception):
    """A fault of a stage; the message describes it."""


def main() -> None:
    """Read the stage that is requested on standard input; print a report, or ``{"error": ...}`` if it cannot be read."""
    limit_process(MAX_MEMORY_BYTES, MAX_CPU_S)
    request = json.loads(sys.stdin.read())
    try:
        check_layers(request["path"], [Path(root) for root in request["roots"]])
        stage = Usd.Stage.Open(request["path"])
        arrays: dict[str, NDArray[Any]] = {}
        report = read_stage(stage, request["collision"], arrays)
        np.savez(sys.argv[1], **arrays)  # type: ignore[arg-type]  # the stubs take a name for allow_pickle
    except RefusedError as error:
        report = {"error": str(error)}
    except Tf.ErrorException as error:
        reason = str(error).partition(" : '")[2].splitlines() or ["it is damaged"]
        report = {"error": f"the USD reader refuses it ({reason[0].strip()[:160]})"}
    except MemoryError:
        report = {"error": "it needs too much memory"}
    json.dump(report, sys.stdout)


# ---------------- Layers


def check_layers(path: str, roots: list[Path]) -> None:
    """Check that all layers of a stage lie within the allowed folders, each before it is opened.

    Args:
        path: file of the stage, whose own layer is always opened.
        roots: allowed folders.

    Raises:
        RefusedError: a layer lies elsewhere, is missing, or cannot be read; or a prim has value clips.
    """
    unread, seen = [path], {path}
    while unread:
        name = unread.pop()
        layer = Sdf.Layer.FindOrOpen(name)
        if layer is None:
            raise RefusedError(f"the layer {short(name)} cannot be read: it is damaged, or is not USD")
        clips: list[str] = []

        def collect_clips(prim_path: Prim, layer: Prim = layer, clips: list[str] = clips) -> None:
            if prim_path.IsPrimPath() and layer.GetObjectAtPath(prim_path).HasInfo("clips"):
                clips.append(str(prim_path))

        layer.Traverse(Sdf.Path.absoluteRootPath, collect_clips)
        if clips:
            raise RefusedError(f"the prim {short(clips[0])} has value clips, which are not read: flatten the stage")
        for asset in layer.GetCompositionAssetDependencies():
            dependency = _allowed_layer(layer, asset, roots)
            if dependency not in seen:
                seen.add(dependency)
                unread.append(dependency)
        if len(seen) > MAX_LAYERS:
            raise RefusedError(f"it is composed of more than {MAX_LAYERS:,} layers")


def _allowed_layer(layer: Prim, asset: str, roots: list[Path]) -> str:
    """Return the path of a layer that another layer names."""
    if "://" in asset or "`" in asset:
        raise RefusedError(
            f"it names the layer {short(asset)}: only files in its folder, or in folders of --search, are read"
        )
    resolved = str(Sdf.ComputeAssetPathRelativeToLayer(layer, asset))
    outer_file = Path(Ar.SplitPackageRelativePathOuter(resolved)[0] if Ar.IsPackageRelativePath(resolved) else resolved)
    if not outer_file.is_file():
        raise RefusedError(f"it names the layer {short(asset)}, which does not exist")
    if not any(outer_file.resolve().is_relative_to(root) for root in roots):
        raise RefusedError(
            f"it names the layer {short(asset)}, outside its folder: give the folder that contains it by --search"
        )
    return resolved


def short(name: str) -> str:
    """Return a name, shortened for a message."""
    return repr(name if len(name) <= 80 else f"{name[:80]}...")


# ---------------- Prims


def read_stage(stage: Prim, collision: bool, arrays: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Return a report on the prims with geometries, and add their arrays to ``arrays``.

    Args:
        stage: the stage to read.
        collision: whether to read the collision prims instead of the visible ones.
        arrays: filled with the arrays of the meshes, keyed by ``NUMBER:NAME``.

    Returns:
        ``bodies`` with kind, path, sizes and colour; ``frames``, the poses of all prims; ``left_out``, the number of prims
        that were not read, by type; ``up``, the vertical axis; and ``metres``, the length of the unit [m].

    Raises:
        RefusedError: a geometry is damaged, or there are too many prims or triangles.
    """
    cache = UsdGeom.XformCache(TIME)
    bodies: list[dict[str, Any]] = []
    frames: dict[str, list[list[float]]] = {}
    left_out: dict[str, int] = {}
    triangles = 0
    for count, prim in enumerate(prims_of(stage)):
        if count >= MAX_PRIMS:
            raise RefusedError(f"it has more than {MAX_PRIMS:,} prims")
        kind = str(prim.GetTypeName())
        if prim.IsA(UsdGeom.Xformable):
            frames[str(prim.GetPath())] = np.array(cache.GetLocalToWorldTransform(prim)).T.tolist()
        if not _is_selected(prim, collision):
            continue
        if kind == "Mesh":
            shape, faces = read_mesh(prim)
            triangles += faces
            arrays |= {f"{len(bodies)}:{name}": values for name, values in shape.items()}
            body: dict[str, Any] = {"kind": "mesh"}
        elif kind in GPRIMS:
            body = _gprim(prim, kind)
        else:
            if prim.IsA(UsdGeom.Gprim) or kind == "PointInstancer":
                left_out[kind] = left_out.get(kind, 0) + 1
            continue
        if triangles > MAX_TRIANGLES:
            raise RefusedError(f"it has more than {MAX_TRIANGLES:,} triangles")
        bodies.append({**body, "path": str(prim.GetPath()), "colour": _uniform_colour(prim)})
    up, metres = str(UsdGeom.GetStageUpAxis(stage)), float(UsdGeom.GetStageMetersPerUnit(stage))
    return {"bodies": bodies, "frames": frames, "left_out": left_out, "up": up.lower(), "metres": metres}


def prims_of(stage: Prim) -> Iterator[Prim]:
    """Yield the prims of a stage, including those of instances, but not the prototypes below a point instancer."""
    whole = iter(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)))
    for prim in whole:
        if prim.GetTypeName() == "PointInstancer":
            whole.PruneChildren()
        yield prim


def _is_selected(prim: Prim, collision: bool) -> bool:
    """Return whether a prim is visible, or, for collision shapes, takes part in collisions."""
    imageable = UsdGeom.Imageable(prim)
    if not imageable:
        return False
    if collision:
        return bool(prim.HasAPI(UsdPhysics.CollisionAPI)) or prim.GetTypeName() == "PointInstancer"
    purpose = imageable.ComputePurpose()
    return purpose in ("default", "render") and imageable.ComputeVisibility(TIME) != "invisible"


def _gprim(prim: Prim, kind: str) -> dict[str, Any]:
    """Return the kind, the sizes and the axis of a prim that is defined by sizes."""
    primitive, names = GPRIMS[kind]
    values = [float(prim.GetAttribute(name).Get(TIME)) for name in names]
    sizes: dict[str, float] = dict(zip(("radius", "length"), values, strict=False))
    if kind == "Cube":
        sizes = dict.fromkeys("xyz", values[0])
    if kind == "Plane":
        along_x = prim.GetAttribute("axis").Get(TIME) == UsdGeom.Tokens.x  # its width lies along z, and turns to y upright
        sizes = dict(zip("yx" if along_x else "xy", values, strict=True))
    axis = prim.GetAttribute("axis")
    return {"kind": primitive, "sizes": sizes, "axis": str(axis.Get(TIME)).lower() if axis else "z"}


def read_mesh(prim: Prim) -> tuple[dict[str, NDArray[Any]], int]:
    """Return the vertices, triangles and colours of a mesh, keyed by name, and the number of triangles.

    Raises:
        RefusedError: the arrays of the mesh contradict each other, or points are not finite.
    """
    # 1. Read the arrays, and check that they fit together.
    mesh = UsdGeom.Mesh(prim)
    points = np.array(mesh.GetPointsAttr().Get(TIME) or [], dtype=np.float64).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(TIME) or [], dtype=np.int64)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(TIME) or [], dtype=np.int64)
    mesh_name = f"the mesh {short(str(prim.GetPath()))}"
    if counts.size and (counts.min() < 0 or counts.sum() != len(corners)):
        raise RefusedError(f"{mesh_name} states {counts.sum():,} corners of faces, but has {len(corners):,}")
    if corners.size and (corners.min() < 0 or corners.max() >= len(points)):
        raise RefusedError(f"a face of {mesh_name} refers to a point that does not exist")
    if not np.isfinite(points).all():
        raise RefusedError(f"{mesh_name} has points that are not finite")
    # 2. Split each face of n corners into a fan of n - 2 triangles: `face` is the face of each triangle, `number` its number
    #    in the fan, and `first_corner` the index of the face's first corner.
    triangle_counts = np.maximum(counts - 2, 0)
    face = np.repeat(np.arange(len(counts)), triangle_counts)
    number = np.arange(int(triangle_counts.sum())) - np.repeat(np.cumsum(triangle_counts) - triangle_counts, triangle_counts)
    first_corner = (np.cumsum(counts) - counts)[face]
    triangle_corners = np.stack([first_corner, first_corner + number + 1, first_corner + number + 2], -1)
    if mesh.GetOrientationAttr().Get(TIME) == UsdGeom.Tokens.leftHanded:
        triangle_corners = triangle_corners[:, ::-1]
    # 3. Give each triangle the colour of its face.
    shape = {"vertices": points, "faces": corners[triangle_corners].reshape(-1, 3)}
    colours = _face_colours(prim, counts, corners, len(points))
    if colours is not None:
        shape["colours"] = colours[face]
    return shape, len(triangle_corners)


# ---------------- Colours


def _face_colours(
    prim: Prim, counts: NDArray[np.int64], corners: NDArray[np.int64], points: int
) -> NDArray[np.float64] | None:
    """Return the linear colours of faces ``(faces, 3)`` from materials, otherwise from ``displayColor``, or None."""
    # Materials of subsets take precedence over that of the whole mesh.
    colours = np.full((len(counts), 3), np.nan)
    for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
        colour = _material_colour(subset.GetPrim())
        faces = np.array(subset.GetIndicesAttr().Get(TIME) or [], dtype=np.int64)
        if colour is not None and faces.size and faces.min() >= 0 and faces.max() < len(counts):
            colours[faces] = colour
    default = _material_colour(prim)
    default = _display_colours(prim, counts, corners, points) if default is None else default
    if default is not None:
        colours = np.where(np.isnan(colours), default, colours)
    return None if np.isnan(colours).all() else colours


def _display_colours(
    prim: Prim, counts: NDArray[np.int64], corners: NDArray[np.int64], points: int
) -> NDArray[np.float64] | None:
    """Return the ``displayColor`` of each face ``(faces, 3)``, averaged over its corners, or None."""
    # The colours may be one for all, one per face, one per point or one per corner.
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayColor")
    values = primvar.ComputeFlattened(TIME) if primvar and primvar.HasValue() else None
    if values is None or not len(values):
        return None
    table = np.array(values, dtype=np.float64).reshape(-1, 3)
    if len(table) == 1:
        return np.repeat(table, len(counts), axis=0)
    if len(table) == len(counts) and primvar.GetInterpolation() == UsdGeom.Tokens.uniform:
        return table
    if len(table) == points:
        table = table[corners]
    if len(table) != len(corners) or not counts.size:
        return None
    sums = np.add.reduceat(np.concatenate([table, np.zeros((1, 3))]), np.cumsum(counts) - counts)
    return np.asarray(sums / np.maximum(counts, 1)[:, None], dtype=np.float64)


def _uniform_colour(prim: Prim) -> list[float] | None:
    """Return the uniform colour of a primitive, or None."""
    colour = _material_colour(prim)
    if colour is None:
        display_colours = _display_colours(prim, np.array([1]), np.array([0]), 1)
        colour = None if display_colours is None else display_colours[0]
    return None if colour is None else [float(value) for value in colour]


def _material_colour(prim: Prim) -> NDArray[np.float64] | None:
    """Return the diffuse colour of the material bound to a prim, if it is uniform, or None."""
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    if not material:
        return None
    for shader in Usd.PrimRange(material.GetPrim()):
        for name in ("diffuseColor", "diffuse_color_constant", "base_color"):
            shader_input = UsdShade.Shader(shader).GetInput(name) if shader.IsA(UsdShade.Shader) else None
            if shader_input and not shader_input.HasConnectedSource() and shader_input.Get(TIME) is not None:
                colour = np.array(shader_input.Get(TIME), dtype=np.float64).ravel()
                return colour[:3] if len(colour) >= 3 and np.isfinite(colour).all() else None
    return None


if __name__ == "__main__":
    main()
