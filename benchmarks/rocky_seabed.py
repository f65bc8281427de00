"""A rocky seabed of a given number of triangles, as one mesh, for benchmarks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = ["SIZE_M", "Seabed", "mitsuba_scene", "poses_over", "rocky_seabed"]

SIZE_M = 30.0
CELLS = 2048


@dataclass(frozen=True)
class Seabed:
    """Rocks as one mesh: ``vertices`` (n, 3) [m], ``faces`` (m, 3), ``reflectivity`` (m,) 0..1. The floor is z = 0."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    reflectivity: NDArray[np.float32]


def rocky_seabed(a_side: int = 52, seed: int = 0) -> Seabed:
    """Boxes, cylinders and capsules, each kind on its own ``a_side`` x ``a_side`` grid (after Almanza-Medina, 3.2.1)."""
    rng = np.random.default_rng(seed)
    kinds = [
        trimesh.creation.box(),
        trimesh.creation.cylinder(0.5, 1.0, sections=24),
        trimesh.creation.capsule(1.0, 0.5, count=[12, 12]),
    ]
    count, step = a_side**2, SIZE_M / a_side
    corner = np.stack(np.meshgrid(*[np.arange(a_side)] * 2, indexing="ij"), -1).reshape(-1, 2) * step - SIZE_M / 2
    vertices, faces, reflectivity, first = [], [], [], 0
    for kind in kinds:
        unit = np.asarray(kind.vertices) / np.ptp(kind.vertices, axis=0)
        size = rng.uniform(0.02, 0.45, (count, 1, 3))
        turn = Rotation.from_euler("xyz", rng.uniform(-165, 100, (count, 3)), degrees=True).as_matrix()
        centre = np.column_stack([corner + rng.uniform(0, step, (count, 2)), rng.uniform(0, 0.45, count)])
        placed = (unit * size) @ turn.transpose(0, 2, 1) + centre[:, None]
        vertices.append(placed.reshape(-1, 3))
        faces.append((kind.faces + (first + np.arange(count) * len(unit))[:, None, None]).reshape(-1, 3))
        reflectivity.append(np.repeat(rng.uniform(0.2, 1, count), len(kind.faces)))
        first += count * len(unit)
    return Seabed(
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(faces).astype(np.uint32),
        np.concatenate(reflectivity).astype(np.float32),
    )


def mitsuba_scene(seabed: Seabed) -> mi.Scene:
    """Return the seabed as a Mitsuba scene: one mesh with a reflectivity a face, on a floor of independent cells."""
    import mitsuba as mi

    rocks = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "face_reflectivity"}}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(rocks)
    mesh = mi.Mesh("rocks", len(seabed.vertices), len(seabed.faces), props=properties)
    mesh.add_attribute("face_reflectivity", 1, seabed.reflectivity)  # type: ignore[arg-type]  # arrays work, despite the stub
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = seabed.vertices.ravel()
    parameters["faces"] = seabed.faces.ravel()
    parameters.update()
    floor = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale(SIZE_M / 2),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "cell_noise", "cells": CELLS}},
    }
    scene: mi.Scene = mi.load_dict({"type": "scene", "rocks": mesh, "floor": floor})
    return scene


def poses_over(count: int, seed: int = 1) -> NDArray[np.float64]:
    """Draw random positions and headings 2.5 m above the floor, at a pitch of 35 deg, with footprints on the seabed."""
    rng = np.random.default_rng(seed)
    position, heading = rng.uniform(-8.5, 8.5, (count, 2)), rng.uniform(0, 2 * np.pi, count)
    rest = np.tile([2.5, np.radians(35), 0.0], (count, 1))
    return np.column_stack([position, rest, heading])
