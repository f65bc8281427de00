"""A mesh whose vertices move between pings: its search tree is built anew, those of all other shapes stay."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.motion.bodies import VertexLaw

__all__ = ["DeformingMesh"]


class DeformingMesh:
    """A copy of a mesh with vertices of its own.

    Args:
        shape: to copy.
        law: vertices at a time, as many as the mesh has.

    Attributes:
        mesh: the copy.
        scene: that holds it alone.
        version: number of changes so far.

    Raises:
        MitsonarError: a shape that is no mesh.
    """

    def __init__(self, shape: mi.Shape, law: VertexLaw) -> None:
        if not isinstance(shape, mi.Mesh):
            raise MitsonarError(f"moving: only meshes deform: {shape.id()} is another shape; give a PLY file")
        self.mesh, self.law = _copied(shape), law
        self.scene: mi.Scene | None = None
        self.version, self._time_s = 0, float("nan")

    def vertices(self, time_s: float) -> NDArray[np.float32]:
        """Return the vertices ``(vertices, 3)`` at a time [s].

        Raises:
            MitsonarError: another number of them, or some that are not finite.
        """
        found = np.asarray(self.law(time_s), dtype=np.float32)
        count = self.mesh.vertex_count()
        if found.shape != (count, 3) or not np.isfinite(found).all():
            raise MitsonarError(
                f"moving: {self.mesh.id()} has {count} vertices, finite ({count}, 3): got {found.shape} at {time_s:g} s"
            )
        return found

    def deform(self, time_s: float) -> None:
        """Move the vertices to where they are at a time [s].

        Raises:
            MitsonarError: as :meth:`vertices`.
        """
        if time_s == self._time_s:
            return
        vertices = self.vertices(time_s)
        assert self.scene is not None
        values: Any = mi.traverse(self.scene)  # its types lack the keys
        (name,) = [key for key in values.keys() if key.endswith("vertex_positions")]  # noqa: SIM118  no dict
        values[name] = mi.Float(vertices.ravel().tolist())
        values.update()
        self.version, self._time_s = self.version + 1, time_s


def _copied(mesh: mi.Mesh) -> mi.Mesh:
    """Return a mesh of the same triangles, uv and numbers of objects, without normals at vertices."""
    props = mi.Properties()
    props["bsdf"] = mesh.bsdf()
    uv = mesh.has_vertex_texcoords()
    made = mi.Mesh(mesh.id(), mesh.vertex_count(), mesh.face_count(), props, False, uv)
    old, new = mi.traverse(mesh), mi.traverse(made)
    for name in ("vertex_positions", "faces", *(("vertex_texcoords",) if uv else ())):
        new[name] = type(new[name])(old[name])
    new.update()
    if mesh.has_attribute("face_id")[0]:
        numbers = mesh.attribute_buffer("face_id")
        made.add_attribute("face_id", dr.width(numbers) // mesh.face_count(), np.array(numbers).tolist())
    made.set_id(mesh.id())
    return made
