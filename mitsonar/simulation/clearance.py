"""Free water around vehicles: how near the nearest surface is, by a few rays from each, and who lies below the ground."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.simulation.device_arrays import DeviceArray
from mitsonar.simulation.tracing import Tracer, free_way
from mitsonar.simulation.variant import Frozen, replayed

__all__ = ["Buried", "Clearance", "buried_in"]

AROUND = np.array([way for way in itertools.product((-1, 0, 1), repeat=3) if any(way)], dtype=float)
"""Directions in which surfaces are sought: the faces, edges and corners of a cube."""


class Clearance:
    """Measures the clearance of vehicles, all in one launch.

    Args:
        tracer: of the scene.
    """

    def __init__(self, tracer: Tracer) -> None:
        self.tracer = tracer
        self._ways = AROUND / np.linalg.norm(AROUND, axis=1, keepdims=True)
        self._launches: dict[int, Callable[..., Any]] = {}

    def of(
        self, before: NDArray[np.float64], after: NDArray[np.float64], time_s: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the distance of each place to the nearest surface in 26 directions and along the way there ``(n,)`` [m].

        A surface that was passed on the way counts as a negative distance. Thin things between the directions are missed.

        Args:
            before: places that vehicles came from ``(n, 3)`` [m].
            after: places where they are.
            time_s: of each, for bodies that move ``(n,)`` [s].
        """
        count = len(after)
        if self.tracer.deforms and count > 1:  # a launch has one shape of each body
            each = (slice(number, number + 1) for number in range(count))
            return np.concatenate([self.of(before[one], after[one], time_s[one]) for one in each])
        way = after - before
        gone = np.linalg.norm(way, axis=1)
        ahead = np.where(gone[:, None] > 0, way / np.maximum(gone, 1e-12)[:, None], (0.0, 0.0, -1.0))
        ways = np.concatenate([np.broadcast_to(self._ways, (count, *self._ways.shape)), ahead[:, None]], axis=1)
        begin = np.concatenate([np.repeat(after[:, None], len(self._ways), axis=1), before[:, None]], axis=1)
        if count not in self._launches:
            self._launches[count] = Frozen(self._traced)
        number = mi.Float(np.repeat(np.arange(count), ways.shape[1]).astype(np.float32).tolist())
        rays = [mi.Float(part.ravel().astype(np.float32).tolist()) for part in (begin, ways)]
        free = replayed(self._launches[count], self.tracer.scene_at(time_s), number, *rays)
        distance = np.array(free, dtype=float).reshape(ways.shape[:2])
        distance[:, -1] -= gone
        return np.asarray(distance.min(axis=1))

    def straight(self, places: NDArray[np.float64], way: tuple[float, float, float]) -> NDArray[np.float64]:
        """Return the distance from each place ``(n, 3)`` to the surface in one direction ``(n,)`` [m], at time 0; or inf."""
        begin = mi.Point3f(*(mi.Float(column.astype(np.float32).tolist()) for column in places.T))
        found = free_way(self.tracer.scene_at(np.zeros(len(places))), mi.Ray3f(begin, mi.Vector3f(*way)))
        return np.array(found, dtype=float)

    @staticmethod
    def _traced(scene: DeviceArray, number: mi.Float, begin: mi.Float, ways: mi.Float) -> DeviceArray:
        """Trace the rays of all vehicles; a ray carries the number of its vehicle as its time."""
        at = dr.arange(mi.UInt32, dr.width(number))
        ray = mi.Ray3f(dr.gather(mi.Point3f, begin, at), dr.gather(mi.Vector3f, ways, at))
        time: DeviceArray = number
        ray.time = time
        return free_way(scene, ray)


SEA_SURFACE = "surface"
"""Id of the shape that worlds give the sea above them: what lies below it is in the water."""


class Buried(NamedTuple):
    """A pose below the ground or inside an object.

    Attributes:
        frame: its number.
        frames: number of all such poses.
        text: what is wrong, in a sentence without its subject.
        inside: whether it is inside an object.
    """

    frame: int
    frames: int
    text: str
    inside: bool


def buried_in(scene: mi.Scene, poses: NDArray[np.float64]) -> Buried | None:
    """Find poses below the ground or inside an object: straight up a ray meets the back of a surface.

    Below the ground there is nothing straight below; inside an object there is the back of the same shape. Surfaces whose
    normals point down, and scenes that move, are not judged.

    Args:
        scene: that stands still.
        poses: of the sonar or vehicle ``(n, 6)`` [m, rad].

    Returns:
        The first of them; None where all poses are in the water, or nothing shows that they are not.
    """
    places = np.asarray(poses, dtype=float)[:, :3]
    begin = mi.Point3f(*(mi.Float(column.astype(np.float32).tolist()) for column in places.T))
    above, below = (scene.ray_intersect(mi.Ray3f(begin, mi.Vector3f(0, 0, way))) for way in (1, -1))
    roofed = np.array(above.is_valid()) & (np.array(above.n)[2] > 0)
    open_below = ~np.array(below.is_valid())
    if not roofed.any():
        return None
    shapes = [dr.reinterpret_array(mi.UInt32, found.shape) for found in (above, below)]
    names = {
        number: shape.id()
        for shape in scene.shapes()
        for number in np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))
    }
    up, down = (np.array(number) for number in shapes)
    wet = np.array([names.get(int(number), "") == SEA_SURFACE for number in up])
    inside = (up == down) & ~open_below & (np.array(below.n)[2] < 0)
    wrong = np.flatnonzero(roofed & ~wet & (open_below | inside))
    if not len(wrong):
        return None
    first = int(wrong[0])
    x, y, z = places[first]
    where, name = f"at ({x:g}, {y:g}, {z:g}) m", names.get(int(up[first]), "")
    if inside[first]:
        return Buried(
            first, len(wrong), inside=True, text=f"{where} is inside {f'the shape {name}' if name else 'an object'}"
        )
    depth = float(np.array(above.t)[first])
    ground = f"the ground, the shape {name}," if name else "the ground"
    text = f"{where} is {depth:.3g} m below {ground} at z = {z + depth:.3g} m (z points up)"
    return Buried(first, len(wrong), text, inside=False)
