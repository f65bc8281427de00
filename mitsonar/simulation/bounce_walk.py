"""Paths of two and three reflections, one a ray: energies by way of mirrors and of rough surfaces.

A ray that meets a mirror goes on as from a mirror; what it brings back is multiplied by V^2 exp(-4 k^2 h^2 cos^2). One that
meets another surface goes on in a direction drawn from Lambert's law, and is multiplied by pi C, so that its mean is the
integral over all directions. Each further surface P of reflectivity C that the sonar sees sends back

    level = product  C_P cos_P / R_P^2  dOmega

with the angle and the range of P from the sonar: the source lights P straight, and the ray's cell dOmega hears it. The range
is half of the path. A path and its reverse have one length. What begins at a mirror is not drawn from its other end, so the
caller adds the reverse. Rays to P by one mirror and back by the same or another one are further kinds, of three.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsonar.plugins.surfaces import Surfaces
from mitsonar.simulation.bistatic import half_path_rate
from mitsonar.simulation.device_arrays import DeviceArray
from mitsonar.simulation.mirror_parts import parts_at, smooth_share, without_mirror_part
from mitsonar.simulation.reflections import going_on, lambert_direction, reflected
from mitsonar.simulation.second_mirrors import SecondMirrors
from mitsonar.simulation.tracing import hidden

__all__ = ["Arrival", "Vertex", "Walk", "at_most_one"]

DRAWS = 0x6D756C74
"""Keeps the draws of directions apart from those of the jitter."""


@dataclass
class Vertex:
    """Where a path meets a surface.

    Attributes:
        valid: whether it does.
        place: the point [m].
        n: unit normal.
        d: direction of the ray that meets it; ``lift`` and ``side``: how it turns with the first ray's angles, where all
            reflections so far were of mirrors.
        reflectivity: of what is scattered.
        reflection: amplitude that a mirror leaves; 0: it is none.
        length: of the path so far [m].
        gain: of the energy so far.
        pure: whether all reflections so far were of mirrors; ``first``: whether the first was.
    """

    valid: DeviceArray
    place: DeviceArray
    n: DeviceArray
    d: DeviceArray
    lift: DeviceArray
    side: DeviceArray
    reflectivity: DeviceArray
    reflection: DeviceArray
    length: DeviceArray
    gain: DeviceArray
    pure: DeviceArray
    first: DeviceArray


@dataclass
class Arrival:
    """A path that has come back along its ray.

    Attributes:
        active: whether it has.
        reflectivity: of the last surface, times the energy's gain on the way.
        cosine: to the normal there, of the line to the sonar.
        distance: of the last surface from the sonar [m].
        range_m: half of the path [m].
        low_m, high_m: of the path by the cell's lower and upper edge.
        toward: unit direction from the sonar to the last surface.
        reverse: whether the reverse is to be added.
        pure: whether all reflections but that of the last surface were of mirrors.
        same: whether it left along its ray as well.
    """

    active: DeviceArray
    reflectivity: DeviceArray
    cosine: DeviceArray
    distance: DeviceArray
    range_m: DeviceArray
    low_m: DeviceArray
    high_m: DeviceArray
    toward: DeviceArray
    reverse: DeviceArray
    pure: DeviceArray
    same: bool = False


@dataclass
class Walk:
    """Follow paths from their first surface on.

    Attributes:
        scene: to trace.
        surfaces: its tables.
        mirrors: table of :class:`~mitsonar.simulation.mirror_parts.Mirrors`; None: no mirrors.
        bounces: largest number of reflections.
        wavenumber: of the carrier [1/m].
        origin: of the sonar [m].
        below, above, aside: elevations of the edges and bearing of the middle of each ray's cell, relative to the ray [rad].
        width: half-length of the path's range interval by way of rough surfaces [m].
        moment: number of the moment of each ray in a scene that moves; None: a still scene.
        second: planes for ways back by another mirror; None: there are no such ways.
    """

    scene: mi.Scene
    surfaces: Surfaces
    mirrors: mi.Float | None
    bounces: int
    wavenumber: float
    origin: DeviceArray
    below: DeviceArray
    above: DeviceArray
    aside: DeviceArray
    width: DeviceArray
    moment: DeviceArray = None
    second: SecondMirrors | None = None

    def arrivals(self, begin: Vertex, ray: DeviceArray, key: DeviceArray) -> Iterator[Arrival]:
        """Yield the arrivals of two reflections, then those of three.

        Args:
            begin: the first surface of each ray.
            ray: number of each ray.
            key: of the draws, 32 bits.
        """
        now = begin
        for number in range(2, self.bounces + 1):
            now = self._next(now, ray, key + (DRAWS + number))
            if number == 2 and self.bounces > 2 and self.mirrors is not None:
                yield self._back_again(now)
                yield from self._by_others(begin, now)
            yield self._straight(now)

    def _next(self, now: Vertex, ray: DeviceArray, key: DeviceArray) -> Vertex:
        """Follow paths to the next surface."""
        mirror = now.reflection != 0
        # a drawn direction turns with no angle of the first ray, so what is turned of a rough surface's counts for nothing
        d = dr.select(mirror, reflected(now.d, now.n), lambert_direction(now.n, now.d, ray, key))
        gain = now.gain * dr.select(mirror, dr.square(now.reflection), now.reflectivity * dr.pi)
        begin = going_on(now.place, d, now.n)
        active = now.valid & (gain > 0)
        onward = mi.Ray3f(now.place + d * begin, d)
        if self.moment is not None:
            onward.time = self.moment
        hit = self.surfaces.hit(self.scene, onward, active)
        reflection: DeviceArray = mi.Float(0)
        if self.mirrors is not None:
            part, roughness_m = parts_at(self.mirrors, hit)
            reflection = part * smooth_share(roughness_m, dr.dot(hit.n, d), self.wavenumber)
            hit = without_mirror_part(self.mirrors, hit, d, self.wavenumber)
        along: DeviceArray = begin + hit.t
        return Vertex(
            valid=active & hit.valid,
            place=now.place + d * along,
            n=hit.n,
            d=d,
            lift=reflected(now.lift, now.n),
            side=reflected(now.side, now.n),
            reflectivity=at_most_one(hit.reflectivity),
            reflection=reflection,
            length=now.length + along,
            gain=gain,
            pure=now.pure & mirror,
            first=now.first,
        )

    def _straight(self, now: Vertex) -> Arrival:
        """Return what arrives from a surface that the sonar lights straight."""
        way: DeviceArray = now.place - self.origin
        distance = dr.norm(way)
        u = way / distance
        toward = dr.dot(now.n, u)
        lit = now.valid & (now.reflectivity > 0) & (toward * dr.dot(now.n, now.d) > 0)
        lit &= ~hidden(self.scene, mi.Point3f(now.place), now.n, u, distance, lit, self.moment)
        half = (now.length + distance) * 0.5
        low, high = self._edges(now, u, half)
        cosine = dr.abs(toward)
        return Arrival(
            active=lit,
            reflectivity=now.reflectivity * now.gain,
            cosine=dr.select(cosine < 1, cosine, 1),
            distance=distance,
            range_m=half,
            low_m=dr.select(now.pure, low, half - self.width),
            high_m=dr.select(now.pure, high, half + self.width),
            toward=u,
            reverse=now.first,
            pure=now.pure,
        )

    def _back_again(self, now: Vertex) -> Arrival:
        """Return what leaves and arrives by the same mirror."""
        low, high = self._edges(now, now.d, now.length)
        cosine = dr.abs(dr.dot(now.n, now.d))
        return Arrival(
            active=now.valid & now.pure & (now.reflectivity > 0),
            reflectivity=now.reflectivity * dr.square(now.gain),
            cosine=dr.select(cosine < 1, cosine, 1),
            distance=now.length,
            range_m=now.length,
            low_m=low,
            high_m=high,
            toward=now.d,
            reverse=mi.Bool(False),
            pure=now.pure,
            same=True,
        )

    def _by_others(self, first: Vertex, now: Vertex) -> Iterator[Arrival]:
        """Yield what left by one mirror and arrives by another. The reverse is that of the ray to the other mirror."""
        if self.second is None:
            return
        met = now.valid & now.pure & (now.reflectivity > 0)
        point, mirror = (now.place, now.n), (first.place, first.n)
        for way in self.second.ways(self.scene, self.origin, point, mirror, met, self.moment):
            half = (now.length + way.distance) * 0.5
            toward = dr.dot(now.n, way.u)
            cosine = dr.abs(toward)
            low, high = self._edges(now, way.u, half)
            yield Arrival(
                active=met & way.is_open & (toward * dr.dot(now.n, now.d) > 0),
                reflectivity=now.reflectivity * now.gain * dr.square(way.factor),
                cosine=dr.select(cosine < 1, cosine, 1),
                distance=way.distance,
                range_m=half,
                low_m=low,
                high_m=high,
                toward=reflected(way.u, mi.Vector3f(way.mirror.normal)),
                reverse=mi.Bool(False),
                pure=mi.Bool(True),
            )

    def _edges(self, now: Vertex, u: DeviceArray, half: DeviceArray) -> tuple[DeviceArray, DeviceArray]:
        """Return half the path by way of a cell's lower and upper edge, on the tangent plane; ``u`` from the other end."""
        lift = half_path_rate(now.length, now.d, now.lift, u, now.n)
        middle = half + half_path_rate(now.length, now.d, now.side, u, now.n) * self.aside
        low, high = middle + lift * self.below, middle + lift * self.above
        return dr.select(low < high, low, high), dr.select(low < high, high, low)


def at_most_one(reflectivity: DeviceArray) -> DeviceArray:
    """Return Lambert's mu of further reflections, at most 1: laws of materials exceed it where a ray grazes."""
    return dr.select(reflectivity < 1, reflectivity, 1)
