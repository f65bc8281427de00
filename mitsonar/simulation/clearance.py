"""Free water around vehicles: how near the nearest surface is, by a few rays from each."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.simulation.device_arrays import DeviceArray
from mitsonar.simulation.tracing import Tracer, free_way
from mitsonar.simulation.variant import frozen, replayed

__all__ = ["Clearance"]

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
            self._launches[count] = frozen(self._traced)
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
