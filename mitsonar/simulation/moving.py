"""Moving bodies in a scene: how rays are traced, how meshes deform, and how changed parameters are detected.

The still shapes form one scene, and each moving shape forms another. A ray is transformed to the axes of each body and
traced there, and the nearest hit counts. Search trees are not rebuilt for rigid motion: a million moving triangles cost
as much as a million still ones. A ray carries the index of its moment as its time.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, suggest_names
from mitsonar.motion.bodies import Moving, MovingBodies, VertexFunction
from mitsonar.motion.pose import to_world_matrices
from mitsonar.plugins.native_plugins import load_dict
from mitsonar.simulation.device import DeviceArray
from mitsonar.simulation.scene import motions_of

__all__ = ["DeformingMesh", "MovingScene", "SceneMotion", "SceneWatch", "carried_back", "motion_in", "scene_at", "scene_of"]


@dataclass
class MovingScene:
    """Scene with moving bodies as the input of a launch; created by :meth:`SceneMotion.scene_at`.

    It is traced like a Mitsuba scene.

    Attributes:
        still: scene of the still shapes.
        shapes: a scene for each moving shape, in the shape's own axes.
        copies: number of bodies of each moving shape.
        rows: transforms from world to body, 12 numbers for each moment and body; body 0 is the still scene.
        spheres: centre and radius of a sphere around each moving shape, in its own axes.
    """

    still: mi.Scene
    shapes: list[mi.Scene]
    copies: list[int]
    rows: mi.Float
    spheres: list[mi.Vector4f]

    def ray_intersect_preliminary(
        self, ray: mi.Ray3f, coherent: DeviceArray = True, active: DeviceArray = True
    ) -> mi.PreliminaryIntersection3f:
        """Trace rays to the nearest surface; ``shape`` and ``prim_uv`` refer to the body's own axes."""
        return self.find(ray, active)[0]

    def ray_test(self, ray: mi.Ray3f, coherent: DeviceArray = True, active: DeviceArray = True) -> DeviceArray:
        """Test whether rays hit anything before their ``maxt``."""
        intersection, _ = self.find(ray, active)
        return intersection.is_valid() & (intersection.t < ray.maxt)

    def find(self, ray: mi.Ray3f, active: DeviceArray = True) -> tuple[mi.PreliminaryIntersection3f, DeviceArray]:
        """Trace rays to the nearest surface; return the hit and the number of the body, 0 for still shapes."""
        coherent: DeviceArray = True
        best: DeviceArray = self.still.ray_intersect_preliminary(mi.Ray3f(ray.o, ray.d), coherent=coherent, active=active)
        body = dr.zeros(mi.UInt32, dr.width(ray.d))
        first = 1
        for scene, copies, sphere in zip(self.shapes, self.copies, self.spheres, strict=True):
            if copies == 1:
                best, body = self._nearer(scene, sphere, ray, mi.UInt32(first), best, body, active)
            else:
                best, body = self._nearest_copy(scene, sphere, ray, (first, copies), best, body, active)
            first += copies
        return best, body

    def _nearest_copy(
        self,
        scene: mi.Scene,
        sphere: mi.Vector4f,
        ray: mi.Ray3f,
        which: tuple[int, int],
        best: DeviceArray,
        body: DeviceArray,
        active: DeviceArray,
    ) -> tuple[DeviceArray, DeviceArray]:
        """Test all bodies of one shape in a loop, which keeps the kernel as short as that of one body."""
        first, copies = which
        number = mi.UInt32(first) + dr.zeros(mi.UInt32, dr.width(ray.d))

        def step(number: DeviceArray, best: DeviceArray, body: DeviceArray) -> tuple[DeviceArray, ...]:
            best, body = self._nearer(scene, sphere, ray, number, best, body, active)
            return number + 1, best, body

        nearest = dr.while_loop((number, best, body), lambda number, best, body: number < first + copies, step)
        return nearest[1], nearest[2]

    def _nearer(
        self,
        scene: mi.Scene,
        sphere: mi.Vector4f,
        ray: mi.Ray3f,
        number: DeviceArray,
        best: DeviceArray,
        body: DeviceArray,
        active: DeviceArray,
    ) -> tuple[DeviceArray, DeviceArray]:
        """Return the nearer of the best hit so far and the hit of a body; rays that miss its sphere are not traced."""
        local = self.carried(ray, number)
        to_centre: DeviceArray = mi.Point3f(sphere.x, sphere.y, sphere.z) - local.o
        along = dr.dot(to_centre, local.d)
        reach = dr.squared_norm(to_centre - local.d * along) < dr.square(sphere.w)
        local.maxt = best.t
        coherent: DeviceArray = True
        intersection: DeviceArray = scene.ray_intersect_preliminary(
            local, coherent=coherent, active=active & reach & (along > -sphere.w)
        )
        nearer = intersection.is_valid() & (intersection.t < best.t)
        return dr.select(nearer, intersection, best), dr.select(nearer, number, body)

    def lines(self, moment: DeviceArray, body: DeviceArray) -> list[mi.Vector4f]:
        """Return the three rows of the transforms from world to bodies."""
        begin = (moment * self.stride + body) * 3
        return [dr.gather(mi.Vector4f, self.rows, begin + axis) for axis in range(3)]

    def carried(self, ray: mi.Ray3f, body: DeviceArray) -> mi.Ray3f:
        """Transform rays to the axes of bodies."""
        lines = self.lines(mi.UInt32(ray.time), body)
        origin = mi.Point3f(*(line.x * ray.o.x + line.y * ray.o.y + line.z * ray.o.z + line.w for line in lines))
        return mi.Ray3f(origin, mi.Vector3f(*(line.x * ray.d.x + line.y * ray.d.y + line.z * ray.d.z for line in lines)))

    @property
    def stride(self) -> int:
        """Return the number of bodies at a moment, including the still scene."""
        return 1 + sum(self.copies)


def carried_back(lines: list[mi.Vector4f], v: mi.Vector3f) -> mi.Vector3f:
    """Rotate directions from bodies' axes to the world, given the rows of :meth:`MovingScene.lines`."""
    first, second, third = lines
    turned: DeviceArray = mi.Vector3f(first.x, first.y, first.z) * v.x
    turned += mi.Vector3f(second.x, second.y, second.z) * v.y + mi.Vector3f(third.x, third.y, third.z) * v.z
    return mi.Vector3f(turned)


class SceneMotion:
    """Moving and deforming shapes of a scene, on the host.

    Args:
        scene: any Mitsuba scene; its moving shapes are given in their own axes.
        bodies: the moving bodies.

    Attributes:
        still: scene of the other shapes.
        shapes: shapes of the scene; deforming ones are copies.
        deformed: the deforming meshes.

    Raises:
        MitsonarError: a shape is not in the scene or cannot deform; the scene has instances.
    """

    def __init__(self, scene: mi.Scene, bodies: MovingBodies) -> None:
        self.scene, self.bodies = scene, bodies
        self.shapes = list(scene.shapes())
        names = [shape.id() for shape in self.shapes]
        for name in bodies.shapes:
            if name not in names:
                raise MitsonarError(f"moving: the scene has no shape {name}: {suggest_names(name, names)}")
        instances = [shape.id() for shape in self.shapes if shape.class_name() == "Instance"]
        if instances:
            raise MitsonarError(
                f"moving: moving bodies need a scene without instances: got {', '.join(instances[:3])}; give these as meshes"
            )
        moved = dict.fromkeys(bodies.shapes)
        self.numbers = {name: names.index(name) for name in moved}
        self.copies = [bodies.shapes.count(name) for name in moved]
        self.deformed = [DeformingMesh(self.shapes[names.index(name)], law) for name, law in bodies.deforming.items()]
        for one in self.deformed:
            self.shapes[names.index(one.mesh.id())] = one.mesh
        self.still = scene_of([shape for shape in self.shapes if shape.id() not in moved])
        self._movers = [scene_of([self.shapes[number]]) for number in self.numbers.values()]
        self._spheres = [_sphere(self.shapes[number]) for number in self.numbers.values()]
        for one in self.deformed:
            one.scene = self._movers[list(moved).index(one.mesh.id())]
        dr.make_opaque(self._spheres)

    def scene_at(self, time_s: ArrayLike) -> MovingScene:
        """Return the scene at the given moments ``(moments,)`` [s]; a ray's time is the index of its moment.

        Deforming bodies have one shape at all moments: that at the mean time.
        """
        for one in self.deformed:
            one.deform(float(np.asarray(time_s, dtype=float).mean()))
            index = list(self.numbers).index(one.mesh.id())
            self._spheres[index] = _sphere(one.mesh)
            dr.make_opaque(self._spheres[index])
        rows = self.bodies.from_world(time_s)
        rest = np.broadcast_to(np.eye(4)[:3], (len(rows), 1, 3, 4))
        table = np.concatenate([rest, rows], axis=1).astype(np.float32)
        return MovingScene(self.still, self._movers, self.copies, mi.Float(table.ravel().tolist()), self._spheres)

    def sonar_lines(self, pose: NDArray[np.float64], time_s: float) -> NDArray[np.float64]:
        """Return three rows of the sonar's ``to_world``, in the world and in each body's axes ``(1 + bodies, 3, 4)``."""
        sonar = to_world_matrices(pose.reshape(1, 6))[0]
        rows = self.bodies.from_world(time_s)[0]
        return np.concatenate([sonar[None, :3], rows @ sonar])

    def body_lines(self, time_s: float) -> NDArray[np.float64]:
        """Return three rows of the transforms from world to world (identity) and to each body ``(1 + bodies, 3, 4)``."""
        return np.concatenate([np.eye(4)[None, :3], self.bodies.from_world(time_s)[0]])

    @cached_property
    def first_objects(self) -> int:
        """Return the largest object number in the scene's meshes; the bodies' objects are numbered after it."""
        largest = 0
        for shape in self.scene.shapes():
            if shape.is_mesh() and shape.has_attribute("face_id")[0]:
                largest = max(largest, int(np.array(shape.attribute_buffer("face_id")).max(initial=0)))
        return largest

    def object_names(self, known: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of objects in the order of their numbers: those of the scene's meshes, then the bodies."""
        blank = ("",) * (self.first_objects + 1 - len(known))
        return (*known[: self.first_objects + 1], *blank, *self.bodies.names)


def motion_in(scene: mi.Scene, moving: Moving | MovingBodies | None) -> SceneMotion | None:
    """Return the motion of a scene, as given or by default as specified in its shapes; None if nothing moves."""
    moving = motions_of(scene) if moving is None else moving
    if not moving:
        return None
    return SceneMotion(scene, moving if isinstance(moving, MovingBodies) else MovingBodies.of(moving))


def scene_at(scene: mi.Scene, motion: SceneMotion | None, time_s: float) -> mi.Scene | MovingScene:
    """Return a scene at a time [s]; the scene itself if nothing moves."""
    return scene if motion is None else motion.scene_at(time_s)


def scene_of(shapes: list[mi.Shape]) -> mi.Scene:
    """Build a scene from some shapes of another scene."""
    names = [shape.id() for shape in shapes]
    numbered = {f"shape{number}": shape for number, shape in enumerate(shapes)}
    scene = load_dict({"type": "scene", **numbered}, optimize=False)  # merged meshes would be different shapes
    assert isinstance(scene, mi.Scene)
    for shape, name in zip(shapes, names, strict=True):
        shape.set_id(name)  # restore the id, which the loader changes
    return scene


def _sphere(shape: mi.Shape) -> mi.Vector4f:
    """Return centre and radius of a sphere around a shape, slightly enlarged against rounding."""
    box = shape.bbox()
    low, high = (np.array(end, dtype=float).ravel() for end in (box.min, box.max))
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    margin = 1e-4 * (1 + float(np.abs(np.stack([low, high])).max()))
    return mi.Vector4f(*middle.tolist(), radius + margin)


# ---------------- Deforming meshes


class DeformingMesh:
    """Copy of a mesh whose vertices move between pings.

    Only the search tree of this mesh is rebuilt; those of all other shapes stay.

    Args:
        shape: mesh to copy.
        law: function that returns the vertices at a time, as many as the mesh has.

    Attributes:
        mesh: the copy.
        scene: scene that contains only the copy.
        version: number of changes so far.

    Raises:
        MitsonarError: the shape is not a mesh.
    """

    def __init__(self, shape: mi.Shape, law: VertexFunction) -> None:
        if not isinstance(shape, mi.Mesh):
            raise MitsonarError(f"moving: only meshes can deform: {shape.id()} is not a mesh; give a PLY file")
        self.mesh, self.law = _copied(shape), law
        self.scene: mi.Scene | None = None
        self.version, self._time_s = 0, float("nan")

    def vertices(self, time_s: float) -> NDArray[np.float32]:
        """Return the vertices ``(vertices, 3)`` at a time [s].

        Raises:
            MitsonarError: the number of vertices differs from the mesh's, or some are not finite.
        """
        vertices = np.asarray(self.law(time_s), dtype=np.float32)
        count = self.mesh.vertex_count()
        if vertices.shape != (count, 3) or not np.isfinite(vertices).all():
            raise MitsonarError(
                f"moving: {self.mesh.id()} has {count} vertices, finite ({count}, 3): got {vertices.shape} at {time_s:g} s"
            )
        return vertices

    def deform(self, time_s: float) -> None:
        """Move the vertices to their positions at a time [s].

        Raises:
            MitsonarError: as in :meth:`vertices`.
        """
        if time_s == self._time_s:
            return
        vertices = self.vertices(time_s)
        assert self.scene is not None
        values: Any = mi.traverse(self.scene)  # the type stubs lack keys()
        (name,) = [key for key in values.keys() if key.endswith("vertex_positions")]  # noqa: SIM118  no dict
        values[name] = mi.Float(vertices.ravel().tolist())
        values.update()
        self.version, self._time_s = self.version + 1, time_s


OF_ANY_MESH = ("vertex_positions", "vertex_normals", "vertex_texcoords")
"""Names of parameters that are no attributes of a mesh."""


def _copied(mesh: mi.Mesh) -> mi.Mesh:
    """Return a mesh with the same triangles, uv and attributes, without vertex normals."""
    props = mi.Properties()
    props["bsdf"] = mesh.bsdf()
    uv = mesh.has_vertex_texcoords()
    copied = mi.Mesh(mesh.id(), mesh.vertex_count(), mesh.face_count(), props, False, uv)
    old: Any = mi.traverse(mesh)  # the type stubs lack keys()
    new = mi.traverse(copied)
    for name in ("vertex_positions", "faces", *(("vertex_texcoords",) if uv else ())):
        new[name] = type(new[name])(old[name])
    new.update()
    for name in old.keys():  # noqa: SIM118  no dict
        if name.startswith(("face_", "vertex_")) and name not in OF_ANY_MESH:  # reflectivities, numbers of objects ...
            values = np.array(mesh.attribute_buffer(name))
            count = mesh.face_count() if name.startswith("face_") else mesh.vertex_count()
            copied.add_attribute(name, len(values) // count, values.tolist())
    copied.set_id(mesh.id())
    return copied


# ---------------- Detection of changed scene parameters


WITHOUT_ECHO = ("silhouette_sampling_weight", "vertex_normals")
"""Suffixes of parameter names that no echo depends on; vertex normals do not matter because facets are flat."""


class SceneWatch:
    """Detector of changes to the parameters of a scene's shapes, materials and textures that ``mi.traverse`` reaches.

    Data derived from a scene, such as a table of its normals, is rebuilt when a change is detected. Dr.Jit numbers its
    arrays, and a changed array has another number, so a check costs about 0.1 us per array, regardless of its size.
    Copies that share the memory prevent numbers from being reused.

    Args:
        scene: any Mitsuba scene.
        places: whether to watch the transforms of instances, spheres, cylinders and disks, which Mitsuba looks up when it
            traces.
    """

    def __init__(self, scene: mi.Scene, *, places: bool = True) -> None:
        self._scene, self._places = scene, places
        self._begin()

    def _begin(self) -> None:
        """Collect references to the parameters, and record their current state."""
        traversal: Any = mi.traverse(self._scene)  # the type stubs lack keys()
        self._arrays: dict[str, Any] = {}  # references, which follow the scene's current values
        self._others: dict[str, Any] = {}
        self._owners: dict[str, mi.Object] = {}
        for name, (place, kind, owner, _) in traversal.properties.items():
            if not isinstance(owner, mi.Shape | mi.BSDF | mi.Texture) or name.endswith(WITHOUT_ECHO):
                continue
            looked_up = name.endswith("to_world") and isinstance(owner, mi.Shape) and not isinstance(owner, mi.Mesh)
            if looked_up and not self._places:
                continue
            self._owners[name] = owner
            value = place if kind is None else mi.get_property(place, kind, owner)
            if isinstance(value, mi.Float | mi.UInt32 | mi.Int32):
                self._arrays[name] = value
            else:
                self._others[name] = place, kind
        self._live = list(self._arrays.values())
        self._record()

    def changed(self) -> dict[str, mi.Object] | None:
        """Return the owners of the parameters that changed since the last call, keyed by name; None if none did."""
        materials = self._materials()
        if materials != self._recorded_materials:  # a shape has another BSDF, with other parameters
            owners: dict[str, mi.Object] = {"bsdf": self._scene}
            self._begin()
            return owners
        others = self._fingerprints()
        if [one.index for one in self._live] == self._numbers and others == self._recorded_others:
            return None
        numbered = zip(self._arrays.items(), self._numbers, strict=True)
        names = [name for (name, value), number in numbered if value.index != number]
        names += [name for name, before in self._recorded_others.items() if others[name] != before]
        self._record()
        return {name: self._owners[name] for name in names}

    def _materials(self) -> list[mi.BSDF | None]:
        return [shape.bsdf() for shape in self._scene.shapes()]

    def _values(self) -> dict[str, Any]:
        """Return the current values of the parameters that are not plain arrays, such as transforms and tensors."""
        read: Any = mi.get_property
        return {
            name: place if kind is None else read(place, kind, self._owners[name])
            for name, (place, kind) in self._others.items()
        }

    def _fingerprints(self) -> dict[str, Hashable]:
        """Return a fingerprint of each of these parameters, which differs after a change."""
        return {name: tuple(dr.detail.collect_indices([value])) or str(value) for name, value in self._values().items()}

    def _record(self) -> None:
        """Record the current state of the parameters."""
        self._references = [[dr.copy(value) for value in self._live], [_shared(value) for value in self._values().values()]]
        self._numbers, self._recorded_others = [one.index for one in self._live], self._fingerprints()
        self._recorded_materials = self._materials()


def _shared(value: Any) -> Any:
    """Return a copy that refers to the same arrays; None if the value has no arrays."""
    return dr.copy(value) if dr.detail.collect_indices([value]) else None
