"""Edges as a sonar sees them: how an image changes where motion covers and uncovers surfaces.

The integral of a discontinuous function over directions changes with its discontinuities, by the jump across an edge times
the velocity of the edge, along its length (Li et al. 2018, ACM Trans. Graph. 37:222). Rays alone miss that part. Edges are
those of meshes, silhouettes of other shapes, and lines along which two shapes cut each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.plugins.imaging_sonar_sensor import Fan
from mitsonar.plugins.surfaces import Hit
from mitsonar.simulation.beams import angles_of
from mitsonar.simulation.device import DeviceArray, clipped
from mitsonar.simulation.tracing import Tracer

__all__ = ["EdgePieces", "Edges", "crossings", "edges_of", "pieces_of", "without_derivatives"]

FLAT = 1e-6
"""Largest difference of the normals of two facets at which their edge is ignored."""

LEAST = 0.05
"""Smallest share of points for the length of an edge between two facets that face the sonar, relative to a silhouette."""

BEHIND_RAD = 2e-4
"""Angle from a line where two surfaces cut each other to where the hidden one must go on [rad]."""

INSTANCE = "Instance"
"""Mitsuba's name of the shape that shows a ``shapegroup``."""

SAME = 0.02
"""Largest difference of the normals there."""

NONE = 2**32 - 1
"""Index in place of the corners of a second facet, at the border of a mesh."""


class EdgePieces(NamedTuple):
    """Short pieces of edges as a sonar sees them, in its axes.

    Attributes:
        direction: unit direction of the middle of each piece.
        across: unit vector perpendicular to this direction and to the edge.
        distance: distance of the piece [m].
        swept: solid angle that the piece sweeps towards ``across`` [sr]: 0, with derivatives.
        smooth: whether it belongs to a curved surface that turns away there, so that its cosine is 0.
    """

    direction: DeviceArray
    across: DeviceArray
    distance: DeviceArray
    swept: DeviceArray
    smooth: DeviceArray


@dataclass(frozen=True)
class SonarView:
    """Place of a sonar and what it sees.

    Attributes:
        sonar: the sonar.
        lines: first three rows of its ``to_world``, without derivatives.
    """

    sonar: Sonar
    lines: list[mi.Vector4f]

    @property
    def origin(self) -> mi.Point3f:
        """Return the place of the sonar."""
        return mi.Point3f(*(line.w for line in self.lines))

    def to_sonar(self, vector: DeviceArray) -> mi.Vector3f:
        """Return world vectors in axes of the sonar."""
        return _to_sonar(self.lines, vector)

    def may_see(self, local: DeviceArray, angle: DeviceArray, distance: DeviceArray) -> DeviceArray:
        """Return whether something may lie in the fan before the end of the window.

        Args:
            local: direction to its middle, in axes of the sonar.
            angle: angle that it takes, at least [rad].
            distance: distance to its nearest point [m].
        """
        d = dr.normalize(local)
        bearing, elevation = angles_of(self.sonar, -d.x, d.z, d.y)
        half = (math.radians(extent) / 2 for extent in (self.sonar.azimuth_fov_deg, self.sonar.elevation_fov_deg))
        inside = [dr.abs(value) <= edge + angle for value, edge in zip((bearing, elevation), half, strict=True)]
        return (inside[0] & inside[1] | (angle > 0.5)) & (distance < self.sonar.range_max)


def without_derivatives() -> AbstractContextManager[None]:
    """Return a context in which nothing carries derivatives."""
    context: AbstractContextManager[None] = dr.suspend_grad()  # type: ignore[no-untyped-call]  # Dr.Jit gives it no types
    return context


# ---------------- Edges of shapes


@dataclass(frozen=True)
class MeshEdges:
    """Edges of a mesh. Vertices at the same place, such as along seams of a texture, count as one.

    Attributes:
        mesh: the mesh.
        ends: vertices at both ends of each edge.
        facets: corners of the two facets that meet there; those of the second are :data:`NONE` where there is no second.
    """

    mesh: mi.Mesh
    ends: tuple[DeviceArray, DeviceArray]
    facets: tuple[list[DeviceArray], list[DeviceArray]]

    @classmethod
    def of_mesh(cls, mesh: mi.Mesh) -> MeshEdges:
        """Find the edges of a mesh."""
        corners = np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)
        places = np.array(mesh.vertex_positions_buffer(), dtype=np.float32).reshape(-1, 3)
        _, first, same = np.unique(places, axis=0, return_index=True, return_inverse=True)
        corners = first[same.ravel()][corners]
        # each facet has three edges; equal ones are neighbours after sorting
        ends = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
        order = np.lexsort((ends[:, 1], ends[:, 0]))
        edges, count = np.unique(ends, axis=0, return_counts=True)
        begin = np.cumsum(count) - count
        of_edge = corners[np.tile(np.arange(len(corners)), 3)[order]]
        second = np.where((count > 1)[:, None], of_edge[np.minimum(begin + 1, len(order) - 1)], NONE)
        real = edges[:, 0] != edges[:, 1]
        table = np.hstack([edges, of_edge[begin], second])[real].astype(np.uint32)
        columns = [mi.UInt32(np.ascontiguousarray(column)) for column in table.T]
        return cls(mesh, (columns[0], columns[1]), (columns[2:5], columns[5:8]))

    def weights(self, view: SonarView) -> DeviceArray:
        """Return what share of the points each edge takes: by its length in the view, and by how its facets differ."""
        ends = [view.to_sonar(self._vertex(index) - view.origin) for index in self.ends]
        one, other = (dr.normalize(end) for end in ends)
        length: DeviceArray = dr.norm(one - other)
        normals = [view.to_sonar(self._normal(corners)) for corners in self.facets]
        silhouette = (self.facets[1][0] == NONE) | (dr.dot(normals[0], one) * dr.dot(normals[1], one) < 0)
        differ = dr.norm(normals[0] - normals[1])
        share = dr.select(silhouette, 1, dr.select(differ > FLAT, clipped(differ, LEAST, 1), 0))
        near, far = (dr.norm(end) for end in ends)
        nearer = dr.select(near < far, near, far)
        return dr.select(view.may_see(one + other, length, nearer), length * share, 0)

    def points(self, share: DeviceArray, view: SonarView) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
        """Return points on the edges, with derivatives, the piece of the edge that each represents, without [m], and 0.

        Args:
            share: shares of the total weight up to each point, evenly spaced in 0..1.
            view: view of the sonar.
        """
        # 1. Edge of each point, and place on it.
        weight = mi.Float64(dr.detach(self.weights(view)))
        total = dr.cumsum(weight)
        whole = dr.gather(mi.Float64, total, dr.width(total) - 1)
        at = mi.Float64(share) * whole
        search: DeviceArray = dr.binary_search  # Dr.Jit gives it no types
        edge = search(0, dr.width(total) - 1, lambda index: dr.gather(mi.Float64, total, index) <= at)
        size = dr.gather(mi.Float64, weight, edge)
        part = mi.Float(1 - clipped((dr.gather(mi.Float64, total, edge) - at) / size, 0, 1))
        # 2. Its place, and the piece that it represents.
        one, other = (self._vertex(dr.gather(mi.UInt32, index, edge)) for index in self.ends)
        piece = dr.detach(other - one) * mi.Float(whole / size / dr.width(share))
        return one * (1 - part) + other * part, piece, mi.Bool(False)

    def _vertex(self, index: DeviceArray, active: DeviceArray = True) -> DeviceArray:
        return self.mesh.vertex_position(index, active)

    def _normal(self, corners: Sequence[DeviceArray]) -> DeviceArray:
        a, b, c = (self._vertex(index, index != NONE) for index in corners)
        return dr.normalize(dr.cross(b - a, c - a))


@dataclass(frozen=True)
class Outline:
    """Border and silhouette of a shape that is not a mesh, as Mitsuba samples them.

    Attributes:
        shape: a sphere, cylinder, disk or rectangle.
    """

    shape: mi.Shape

    def weights(self, view: SonarView) -> DeviceArray:
        """Return the angle that its box takes in the view."""
        box = self.shape.bbox()
        away = view.to_sonar(mi.Point3f(box.center()) - view.origin)
        size: DeviceArray = dr.norm(mi.Vector3f(box.extents()))
        distance: DeviceArray = dr.norm(away)
        return dr.select(view.may_see(away, size / distance, distance - size), clipped(size / distance, 0, 1), 0)

    def points(self, share: DeviceArray, view: SonarView) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
        """Return points on the outline, their pieces, and which are on no border; see :meth:`MeshEdges.points`."""
        # 1. Part of the outline of each point, and place on it.
        origin = view.origin
        parts, weights = self.shape.precompute_silhouette(mi.ScalarPoint3f(*(float(value[0]) for value in origin)))
        share_of_part = np.array(weights, dtype=float) / np.sum(np.array(weights, dtype=float))
        end, at = np.cumsum(share_of_part), np.array(share, dtype=float)
        part = np.minimum(np.searchsorted(end, at, side="right"), len(end) - 1)
        within = np.clip(1 - (end[part] - at) / share_of_part[part], 0, 1)
        # 2. Its place, which moves with the shape.
        index: DeviceArray = dr.gather(mi.UInt32, parts, mi.UInt32(part.astype(np.uint32)))
        places: DeviceArray = mi.Float(within.astype(np.float32))
        sample: DeviceArray = self.shape.sample_precomputed_silhouette(origin, index, places)
        si = dr.zeros(mi.SurfaceInteraction3f, len(at))
        si.p, si.uv, si.prim_index, si.shape = sample.p, sample.uv, sample.prim_index, mi.ShapePtr(self.shape)
        density = dr.detach(sample.pdf) * mi.Float(share_of_part[part].astype(np.float32)) * len(at)
        smooth = sample.discontinuity_type == int(mi.DiscontinuityFlags.InteriorType)
        return self.shape.differential_motion(si), dr.detach(sample.silhouette_d) / density, smooth


Edges: TypeAlias = MeshEdges | Outline


def edges_of(scene: mi.Scene) -> list[Edges]:
    """Return the edges of all shapes of a scene but instances.

    Raises:
        MitsonarError: a shape has no outline that Mitsuba knows.
    """
    edges: list[Edges] = []
    for shape in scene.shapes():
        if shape.is_mesh():
            edges.append(MeshEdges.of_mesh(cast(mi.Mesh, shape)))
        elif shape.class_name() != INSTANCE:
            if int(shape.silhouette_discontinuity_types()) == 0:
                raise MitsonarError(
                    f"shape {shape.id()} is of a kind without outlines: got {shape.class_name()}; make it a mesh, or give "
                    "edge_points=0 for derivatives without edges"
                )
            edges.append(Outline(shape))
    return edges


def pieces_of(edges: Sequence[Edges], sonar: Sonar, lines: list[mi.Vector4f], count: int) -> list[EdgePieces]:
    """Return about ``count`` pieces of edges: the more, the longer they appear and the more their facets differ.

    Args:
        edges: result of :func:`edges_of`.
        sonar: sonar that sees them.
        lines: first three rows of ``to_world`` of the sonar, with derivatives or without.
        count: number of pieces.
    """
    place = mi.Point3f(*(line.w for line in lines))
    view = SonarView(sonar, [dr.detach(line) for line in lines])
    with without_derivatives():
        weights = [float(dr.sum(one.weights(view))[0]) for one in edges]
    pieces = []
    for one, weight in zip(edges, weights, strict=True):
        size = math.ceil(count * weight / (sum(weights) or 1))
        if not size:
            continue
        point, piece, smooth = one.points((dr.arange(mi.Float, size) + 0.5) / size, view)
        away, along = _to_sonar(lines, point - place), view.to_sonar(piece)
        distance = dr.norm(dr.detach(away))
        direction = dr.detach(away) / distance
        normal = dr.cross(direction, along)
        length = dr.norm(normal)
        across = dr.select(length > 0, normal / length, 0)
        swept = _change(dr.dot(away, across)) / distance * (length / distance)
        pieces.append(EdgePieces(direction, across, distance, swept, smooth))
    return pieces


# ---------------- Lines along which two shapes cut each other


def crossings(scene: mi.Scene, tracer: Tracer, lines: list[mi.Vector4f]) -> list[EdgePieces]:
    """Return pieces of the lines along which two shapes or objects cut each other, between middles of neighbouring cells.

    On an even grid, a line has one piece in each column or row that it crosses; jittered rays would cross it several times.
    Such a line is where the tangent planes at both hits meet. It is visible if each ray meets the nearer plane.

    Args:
        scene: scene to trace.
        tracer: tracer of the rays.
        lines: first three rows of ``to_world`` of the sonar, with derivatives or without.
    """
    sonar, still = tracer.sonar, [dr.detach(line) for line in lines]
    # 1. Which shape and object does each ray meet?
    ray = dr.arange(mi.UInt32, sonar.rays)
    with without_derivatives():
        hit, _ = _seen(scene, tracer, still, ray, attached=False)
    valid, shape, part = hit.valid, mi.Int32(hit.shape_id), mi.Int32(hit.object_id)
    dr.eval(valid, shape, part)
    # 2. Pairs of neighbours that meet different ones, over elevation and across.
    pieces, columns = [], sonar.columns
    for apart, has in ((columns, ray < sonar.rays - columns), (1, ray % columns < columns - 1)):
        other: DeviceArray = dr.select(has, ray + apart, ray)
        differ = (shape != dr.gather(mi.Int32, shape, other)) | (part != dr.gather(mi.Int32, part, other))
        one: DeviceArray = dr.compress(valid & dr.gather(mi.Bool, valid, other) & differ)
        if dr.width(one):
            pieces.append(_between(scene, tracer, lines, one, one + apart, over_elevation=apart > 1))
    return pieces


def _between(
    scene: mi.Scene,
    tracer: Tracer,
    lines: list[mi.Vector4f],
    one: DeviceArray,
    other: DeviceArray,
    *,
    over_elevation: bool,
) -> EdgePieces:
    """Return the pieces of edges between pairs of neighbouring rays; nothing is swept where their planes do not meet."""
    # 1. Planes n . x = h of both hits, as n / h in axes of the sonar.
    planes, fans, hits = [], [], []
    for ray in (one, other):
        hit, fan = _seen(scene, tracer, lines, ray, attached=True)
        away = hit.t * dr.dot(hit.n, fan.carried(lines).d)
        planes.append(_to_sonar(lines, hit.n) / dr.select(dr.abs(away) > 0, away, dr.inf))
        fans.append(fan)
        hits.append(dr.detach(hit))
    # 2. Their line lies where q . d = 0, between the rays if q . d is positive for the one and negative for the other.
    q = planes[0] - planes[1]
    still = dr.detach(q)
    here, there = (dr.dot(still, fan.d) for fan in fans)
    meet = (here > 0) & (there < 0)
    part = dr.select(meet, here / (here - there), 0)
    direction = dr.normalize(fans[0].d * (1 - part) + fans[1].d * part)
    across: DeviceArray = still / dr.norm(still)
    # 3. Both surfaces go on behind one another: otherwise the line is an edge of a mesh, which has pieces already.
    view = SonarView(tracer.sonar, [dr.detach(line) for line in lines])
    for side, near, far in ((1, 0, 1), (-1, 1, 0)):
        d = dr.normalize(direction + across * (side * BEHIND_RAD))
        begin, end = (1 / dr.dot(dr.detach(planes[which]), d) for which in (near, far))
        towards = _to_world(view.lines, d)
        with without_derivatives():
            behind = tracer.surfaces.hit(
                scene, mi.Ray3f(view.origin + towards * ((begin + end) / 2), towards), attached=True
            )
        same = (behind.shape_id == hits[far].shape_id) & (dr.norm(behind.n - hits[far].n) < SAME)
        meet &= behind.valid & same & (behind.t < end - begin)
    # 4. Both kinds of pairs see each line: together they count once, as the squares of both components of its normal.
    fan, sonar = fans[0], tracer.sonar
    if over_elevation:
        size, towards = sonar.beam_width_rad / sonar.across * dr.norm(fan.side), fan.lift
    else:
        size, towards = math.radians(sonar.elevation_fov_deg) / sonar.rays_per_beam * dr.norm(fan.lift), fan.side
    length = size * dr.abs(dr.dot(across, dr.normalize(towards)))
    swept = _change(-dr.dot(q, direction)) / dr.norm(still) * length
    distance = 1 / dr.abs(dr.dot(dr.detach(planes[0]), direction))
    return EdgePieces(direction, across, distance, dr.select(meet, swept, 0), mi.Bool(False))


def _seen(scene: mi.Scene, tracer: Tracer, lines: list[mi.Vector4f], ray: mi.UInt32, *, attached: bool) -> tuple[Hit, Fan]:
    """Return the hits of rays through the middles of cells, numbered in film order, and their fan in axes of the sonar."""
    fan = tracer.sensor.fan(ray % tracer.sonar.columns, ray // tracer.sonar.columns)
    origin = mi.Point3f(*(line.w for line in lines))
    return tracer.surfaces.hit(scene, mi.Ray3f(origin, fan.carried(lines).d), attached=attached), fan


def _to_sonar(lines: list[mi.Vector4f], vector: DeviceArray) -> mi.Vector3f:
    """Return world vectors in axes of the sonar."""
    return mi.Vector3f(*(sum(line[axis] * vector[row] for row, line in enumerate(lines)) for axis in range(3)))


def _to_world(lines: list[mi.Vector4f], local: DeviceArray) -> mi.Vector3f:
    """Return vectors in axes of the sonar in those of the world."""
    return mi.Vector3f(*(dr.dot(mi.Vector3f(line.x, line.y, line.z), local) for line in lines))


def _change(value: DeviceArray) -> DeviceArray:
    """Return 0 with the derivatives of a value."""
    return value - dr.detach(value)
