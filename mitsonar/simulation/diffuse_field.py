"""The field of paths by way of two and three rough surfaces, in the model ``coherent``.

Their energies are sums over rays (:mod:`mitsonar.simulation.bounce_walk`) in coarse cells of sine and range, about as large
as beam and pulse resolve. Each node of the grid in a cell gets its part of the energy times a complex Gaussian number, a
hash of (seed, node). So the speckle is that of very many paths, and a sonar at rest sees it unchanged; its grain does not
move with the ground.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from mitsonar.acoustics.noise import uniform
from mitsonar.motion.pose import to_world_matrices
from mitsonar.plugins.surfaces import Hit
from mitsonar.simulation.beam_former import RANGES_A_PULSE, SINES_A_LOBE
from mitsonar.simulation.bounce_walk import Arrival, Vertex, Walk, at_most_one
from mitsonar.simulation.coherent_tracing import ADD, CoherentTracer, FanRays
from mitsonar.simulation.device_arrays import DeviceArray
from mitsonar.simulation.elevation_pattern import elevation_gain_of_ends
from mitsonar.simulation.mirror_parts import parts_at, smooth_share, without_mirror_part
from mitsonar.simulation.moving_scene import scene_at
from mitsonar.simulation.reflections import overlap
from mitsonar.simulation.variant import Frozen, replayed

__all__ = ["DiffuseField"]

GRAIN = 0x64696666
"""Keeps the grain of these paths apart from noise and volume."""

SMOOTHED = 3
"""Coarse cells each way over which the energies of single rays are spread."""

MOST_OF_A_RAY = 64
"""Energy of a ray's arrivals, at most, in that of one straight arrival."""


class DiffuseField:
    """Sum the energies of paths by way of rough surfaces, and give them speckle.

    Args:
        tracer: of one reflection.
    """

    def __init__(self, tracer: CoherentTracer) -> None:
        self.direct, self.sonar, self.former = tracer, tracer.sonar, tracer.former
        former = tracer.former
        self.wavenumber = 2 * math.pi / tracer.wavelength
        self.nearest = max(former.first_range, tracer.sonar.bin_m)
        self.shape = -(-former.sines // SINES_A_LOBE), -(-former.ranges // RANGES_A_PULSE)
        fan = tracer.fan
        cell = 4 * fan.sine * fan.tangent / fan.rays
        loudest = MOST_OF_A_RAY * cell / self.nearest**2
        self.bits = 62 - math.ceil(math.log2(loudest * fan.rays))
        self.launch = self._compile()

    def add(self, pose: NDArray[np.float64], field: NDArray[np.complex64], time_s: float = 0.0) -> None:
        """Add these paths of one ping to its field ``(sines, ranges)``, in place, at a pose ``(6,)`` and a time [s]."""
        energy = self.energy(pose, time_s)
        if not energy.any():
            return
        smooth = uniform_filter(energy, SMOOTHED, mode="nearest")
        nodes = SINES_A_LOBE * RANGES_A_PULSE
        amplitude = np.sqrt(np.maximum(smooth, 0) * (self.former.kept / nodes)).astype(np.float32)
        grain = self._grain.reshape(self.shape[0], SINES_A_LOBE, self.shape[1], RANGES_A_PULSE)
        made = (grain * amplitude[:, None, :, None]).reshape(self._grain.shape)
        field += made[: field.shape[0], : field.shape[1]]

    def energy(self, pose: NDArray[np.float64], time_s: float = 0.0) -> NDArray[np.float64]:
        """Return the energies of one ping in coarse cells ``self.shape``, relative to the source's at 1 m."""
        direct = self.direct
        rows = mi.Float64(to_world_matrices(pose.reshape(1, 6))[0, :3].astype(np.float64).ravel().tolist())
        scene = scene_at(direct.scene, direct.motion, time_s)
        sums = replayed(self.launch, direct.index, scene, rows, direct.surfaces.arrays(), direct.mirrors)
        return np.array(sums, copy=False).reshape(self.shape).astype(np.float64) * 2.0**-self.bits

    @cached_property
    def _grain(self) -> NDArray[np.complex64]:
        """Return complex Gaussian numbers of mean power 1 on all nodes of the coarse cells."""
        shape = 1, self.shape[0] * SINES_A_LOBE, self.shape[1] * RANGES_A_PULSE
        first, second = uniform(shape, seed=self.sonar.seed ^ GRAIN, frames=np.array([0]), like=np.empty(0))
        return np.asarray(np.sqrt(-np.log(first[0])) * np.exp(2j * math.pi * second[0]), dtype=np.complex64)

    def _compile(self) -> Callable[..., Any]:
        @Frozen
        def launch(index: Any, scene: Any, rows: Any, tables: Any, mirrors: Any) -> Any:
            lines = [[dr.gather(mi.Float64, rows, mi.UInt32(4 * i + j)) for j in range(4)] for i in range(3)]
            rays = FanRays(self.direct.fan, self.sonar, index, lines)
            surfaces = replace(self.direct.surfaces, **tables)
            hit = surfaces.hit(scene, mi.Ray3f(rays.origin, rays.d))
            begin = self._begin(rays, hit, mirrors)
            none = mi.Float(0)
            origin: DeviceArray = rays.origin
            walk = Walk(scene, surfaces, mirrors, self.sonar.bounces, self.wavenumber, origin, none, none, none, none)
            cell = dr.norm(dr.cross(rays.by_sine, rays.by_tangent)) * (rays.sine_step * rays.tangent_step)
            sums = dr.zeros(mi.UInt64, self.shape[0] * self.shape[1])
            for arrival in walk.arrivals(begin, index, mi.UInt32(self.sonar.seed * 7919 & 0xFFFFFFFF)):
                if not arrival.same:
                    self._deposit(rays, arrival, cell, sums)
            dr.eval(sums)
            return mi.Float64(sums)

        return launch

    def _begin(self, rays: FanRays, hit: Hit, mirrors: mi.Float | None) -> Vertex:
        """Return the first surface of each ray."""
        reflection: DeviceArray = mi.Float(0)
        if mirrors is not None:
            part, roughness_m = parts_at(mirrors, hit)
            reflection = part * smooth_share(roughness_m, dr.dot(hit.n, rays.d), self.wavenumber)
            hit = without_mirror_part(mirrors, hit, rays.d, self.wavenumber)
        return Vertex(
            valid=hit.valid,
            place=rays.origin + rays.d * hit.t,
            n=hit.n,
            d=rays.d,
            lift=mi.Vector3f(0),
            side=mi.Vector3f(0),
            reflectivity=at_most_one(hit.reflectivity),
            reflection=reflection,
            length=hit.t,
            gain=mi.Float(1),
            pure=mi.Bool(True),
            first=reflection != 0,
        )

    def _deposit(self, rays: FanRays, arrival: Arrival, cell: DeviceArray, sums: mi.UInt64) -> None:
        """Add the energies of arrivals to the coarse cells of the beams that hear them."""
        other, tangent, ahead = rays.direction(arrival.toward)
        sine, own = rays.sine, rays.tangent
        distance = dr.select(arrival.distance > self.nearest, arrival.distance, self.nearest)
        level = arrival.reflectivity * arrival.cosine * cell / dr.square(distance)
        there = dr.square(elevation_gain_of_ends(self.sonar, own, tangent))
        active, both = arrival.active & ~arrival.pure & ahead, overlap(self.sonar, sine - other)
        if self.sonar.beam_pattern == "two_way":  # heard in the beams between both ends, a path and its reverse in phase
            level = level * there * dr.square(both) * dr.select(arrival.reverse, 4.0, 2.0)
            self._add(sums, (sine + other) * 0.5, arrival.range_m, level, active)
            return
        back = dr.square(elevation_gain_of_ends(self.sonar, tangent, own))
        self._add(sums, sine, arrival.range_m, level * there * (1 + both), active)
        self._add(sums, other, arrival.range_m, level * back * (1 + both), active & arrival.reverse)

    def _add(
        self, sums: mi.UInt64, sine: DeviceArray, range_m: DeviceArray, level: DeviceArray, active: DeviceArray
    ) -> None:
        former = self.former
        line = (sine - former.first_sine) * (1 / (former.sine_step * SINES_A_LOBE))
        place = (range_m - former.first_range) * (1 / (former.range_step * RANGES_A_PULSE))
        kept = active & (line >= 0) & (line < self.shape[0]) & (place >= 0) & (place < self.shape[1])
        where = mi.UInt32(dr.select(kept, line, 0)) * self.shape[1] + mi.UInt32(dr.select(kept, place, 0))
        value = mi.UInt64(mi.Float64(level) * 2.0**self.bits)
        dr.scatter_reduce(dr.ReduceOp.Add, sums, value, where, kept, mode=ADD)
