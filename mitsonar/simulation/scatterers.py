"""Points of the world that scatter sound, and a search for those in a field of view.

A surface whose reflectivity comes in cells (``cell_noise`` over uv, or a picture) has one point in each cell. Its position
is a hash of the cell. Any other surface has the points of a lattice of the world, as images of the model ``coherent`` have
them. With ``scatterer_spacing_m`` all surfaces do: images and impulse responses then come from one field. The points do not
depend on the sonar's pose, the time or the number of rays.

Each point scatters with a complex Gaussian number zeta of its own, E|zeta|^2 = 1: a hash of its cell.
Echoes of many points then add in power, as those of rough ground do. Their energy does not depend on the density of points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar, FieldOfView
from mitsonar.plugins.bsdf_reflectance import is_black, reflectances_of, reflectivity_at
from mitsonar.plugins.cell_noise import CellNoise
from mitsonar.plugins.hashed_texture import ROUNDS
from mitsonar.simulation.device_arrays import DeviceArray
from mitsonar.simulation.lattice_points import Patches, SurfacePoints, lattice_points, lattice_size

__all__ = ["Scatterers"]

MOST = 2**26
"""Largest number of points of a scene, 36 bytes each: place, normal, strength, phase and shape."""

A_BUCKET = 256
"""Points in a bucket, about: few enough to fit a field of view closely, enough to keep the buckets few."""

A_BLOCK = 64
"""Buckets in a block; the search tests blocks first."""

BITS = 20
"""Bits of a bucket's position along each axis."""


@dataclass(frozen=True)
class Spheres:
    """Bounding spheres of groups of points, and the directions that their surfaces face.

    Attributes:
        middle: ``(groups, 3)`` [m].
        radius: ``(groups,)`` [m].
        facing: mean normal of a group on a closed body, which is visible from outside only; else zero ``(groups, 3)``.
        spread: largest angle between a normal of the group and ``facing`` ``(groups,)`` [rad].
    """

    middle: NDArray[np.float64]
    radius: NDArray[np.float64]
    facing: NDArray[np.float64]
    spread: NDArray[np.float64]

    def may_be_seen(
        self, groups: NDArray[np.int64], eye: NDArray[np.float64], axes: NDArray[np.float64], field: FieldOfView
    ) -> NDArray[np.int64]:
        """Return those of some groups that may have a visible point in a field of view at ``eye``."""
        way = self.middle[groups] - eye
        distance = np.sqrt(np.einsum("gi,gi->g", way, way))
        unit, radius = way / np.maximum(distance, 1e-12)[:, None], self.radius[groups]
        margin = np.where(distance > radius, np.arcsin(np.minimum(radius / np.maximum(distance, 1e-12), 1)), np.pi)
        away = np.einsum("gi,gi->g", self.facing[groups], unit) > np.sin(np.minimum(margin + self.spread[groups], np.pi / 2))
        ahead, aside, above = axes @ unit.T
        kept: NDArray[np.int64] = groups[field.may_see(ahead, aside, above, margin) & ~away]
        return kept


@dataclass(frozen=True)
class Scatterers:
    """Scattering points of a scene, sorted so that neighbours are adjacent.

    Attributes:
        place: positions ``(points, 3)`` float32 [m]; exact as they are.
        normal: unit normal of the surface ``(points, 3)`` float32.
        strength: reflectivity times the area that a point represents, times |zeta|^2 ``(points,)`` float32 [m2].
        phase: of zeta ``(points,)`` float32, -pi..pi [rad].
        shape: place in ``scene.shapes()`` of the shape that has the point ``(points,)`` int32.
        first: index of the first point of each bucket, and the number of points ``(buckets + 1,)``.
        one_sided: whether a bucket's points lie on closed bodies, visible from outside only ``(buckets,)``.
    """

    place: NDArray[np.float32]
    normal: NDArray[np.float32]
    strength: NDArray[np.float32]
    phase: NDArray[np.float32]
    shape: NDArray[np.int32]
    first: NDArray[np.int64]
    one_sided: NDArray[np.bool_]

    @classmethod
    def of(cls, scene: mi.Scene, sonar: ChannelSonar, smooth: frozenset[int] | None = None) -> Scatterers:
        """Place scatterers on a scene's shapes.

        Args:
            scene: any.
            sonar: gives number and seed of the points.
            smooth: places in the scene of perfect mirrors, which scatter nothing; where it is given there may be no points.

        Raises:
            MitsonarError: no surface can carry scatterers, or there are more than :data:`MOST`.
        """
        parts, closed, shapes = [], [], []
        for number, shape in enumerate(scene.shapes()):
            if shape.bsdf() is not None and number not in (smooth or ()) and not is_black(shape.bsdf()):
                grid = _grid_of(shape) if sonar.scatterer_spacing_m is None else None
                parts.append(_in_cells(shape, grid, number) if grid else _on_lattice(shape, sonar, number))
                closed.append(np.full(len(parts[-1].strength), isinstance(shape, mi.Mesh) and _is_closed(shape)))
                shapes.append(np.full(len(parts[-1].strength), number, np.int32))
        if not sum(map(len, closed)) and smooth is not None:
            none = np.zeros((0, 3), np.float32)
            return cls(none, none, none[:, 0], none[:, 0], np.zeros(0, np.int32), np.zeros(1, np.int64), np.zeros(0, bool))
        if not sum(map(len, closed)):
            raise MitsonarError(
                "the scene has no surface that can carry scatterers: give it a shape with a diffuse BSDF, cell_noise or a "
                "bitmap as reflectance, or raise points_per_m2"
            )
        place, normal, strength, phase = (np.concatenate(values) for values in zip(*parts, strict=True))
        one_sided = np.concatenate(closed)
        order, first = _buckets(place, np.where(one_sided, _side(normal), 0))
        of_shape, sided = np.concatenate(shapes)[order], one_sided[order[first[:-1]]]
        return cls(place[order], normal[order], strength[order], phase[order], of_shape, first, sided)

    def __len__(self) -> int:
        return len(self.strength)

    @cached_property
    def spheres(self) -> tuple[Spheres, Spheres]:
        """Return bounding spheres of the blocks, and of the buckets."""
        buckets = np.arange(len(self.one_sided))
        blocks = self.first[:-1][::A_BLOCK]
        mixed = np.logical_and.reduceat(self.one_sided, buckets[::A_BLOCK])
        return self._spheres(blocks, mixed), self._spheres(self.first[:-1], self.one_sided)

    def _spheres(self, first: NDArray[np.int64], one_sided: NDArray[np.bool_]) -> Spheres:
        low, high = (reach.reduceat(self.place, first).astype(float) for reach in (np.minimum, np.maximum))
        count = np.diff(np.append(first, len(self)))
        mean = np.add.reduceat(self.normal, first, dtype=np.float64)
        mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
        along = np.einsum("pi,pi->p", self.normal, np.repeat(mean.astype(np.float32), count, axis=0))
        spread = np.arccos(np.clip(np.minimum.reduceat(along, first), -1, 1)) + 1e-3
        return Spheres((low + high) / 2, np.linalg.norm(high - low, axis=1) / 2, mean * one_sided[:, None], spread)

    def within(self, eye: NDArray[np.float64], axes: NDArray[np.float64], field: FieldOfView) -> NDArray[np.uint32]:
        """Return indices of the points that may lie in a field of view: all that do, and some beside it.

        Args:
            eye: position of the receiver ``(3,)`` [m].
            axes: :attr:`FieldOfView.axes` in the world ``(3, 3)``.
            field: shape of the field of view.
        """
        if not len(self):
            return np.zeros(0, np.uint32)
        blocks, buckets = self.spheres
        near = blocks.may_be_seen(np.arange(len(blocks.radius)), eye, axes, field)
        inner = (near[:, None] * A_BLOCK + np.arange(A_BLOCK)).ravel()
        return _ranges(self.first, buckets.may_be_seen(inner[inner < len(self.one_sided)], eye, axes, field))


def _side(normal: NDArray[np.float32]) -> NDArray[np.int64]:
    """Classify normals by the nearest of the six axis directions, 1 to 6."""
    axis = np.abs(normal).argmax(axis=1)
    return np.asarray(1 + 2 * axis + (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] < 0))


def _is_closed(mesh: mi.Mesh) -> bool:
    """Test whether a mesh bounds bodies with normals outwards.

    It does where each edge occurs once in each direction and each body has a volume above 0.
    """
    faces = np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)
    vertex = np.array(mesh.vertex_positions_buffer(), dtype=float).reshape(-1, 3)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forth, back = (np.sort(a * len(vertex) + b) for a, b in (edges.T, edges.T[::-1]))
    if (np.diff(forth) == 0).any() or not np.array_equal(forth, back):
        return False
    links = coo_array((np.ones(len(edges), np.int8), tuple(edges.T)), shape=2 * (len(vertex),))
    _, body = connected_components(links, directed=False)
    corner = vertex[faces] - vertex[faces[0, 0]]
    volume = np.bincount(body[faces[:, 0]], np.einsum("fi,fi->f", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])))
    return bool((volume[np.unique(body[faces[:, 0]])] > 0).all())


class _Grid(NamedTuple):
    """The cells over uv of a shape's reflectivity; ``texture`` is None for a picture."""

    texture: CellNoise | None
    columns: int
    rows: int


def _grid_of(shape: mi.Shape) -> _Grid | None:
    """Return the cells over uv of a shape's reflectivity; None where it has none."""
    textures = reflectances_of(shape.bsdf())
    if len(textures) != 1:
        return None
    texture: Any = textures[0]  # Mitsuba's type of it is not the plugin's class
    # by its name: the class is made anew with each variant
    if type(texture).__name__ == CellNoise.__name__ and texture.coordinates == "uv":
        fine = round(texture.cells * 2 ** (texture.octaves - 1))
        return _Grid(texture, fine, fine) if fine >= 1 else None
    if texture.class_name() == "BitmapTexture":
        size = texture.resolution()
        return _Grid(None, int(size[0]), int(size[1]))
    return None


class _Zeta(NamedTuple):
    """Complex Gaussian numbers of points on the device: |zeta|^2, and the phase [rad]."""

    power: DeviceArray
    phase: DeviceArray


def _in_cells(shape: mi.Shape, grid: _Grid, number: int) -> SurfacePoints:
    """Place one point in each cell. Place and zeta are hashes of the cell and the texture's seed (of a picture: the shape's
    number).
    """
    texture, columns, rows = grid
    turn = np.eye(3)
    if texture is not None:
        turn[:2] = texture.to_uv
    back = np.linalg.inv(turn)
    corners = turn @ np.array([[0, 1, 0, 1], [0, 0, 1, 1], [1, 1, 1, 1.0]])
    low = np.floor(corners[:2].min(axis=1) * (columns, rows)).astype(int)
    wide, tall = np.ceil(corners[:2].max(axis=1) * (columns, rows)).astype(int) - low
    _check_count(shape, float(wide) * float(tall), "give its texture fewer cells, or a scatterer_spacing_m")
    cell = dr.arange(mi.UInt32, int(wide * tall))
    column, row = mi.Int32(cell % int(wide)) + int(low[0]), mi.Int32(cell // int(wide)) + int(low[1])
    seed = (texture.seed, 1) if texture is not None else (number, 0)
    bits: list[DeviceArray] = [dr.reinterpret_array(mi.UInt32, value) for value in (column, row)]
    first, second = mi.sample_tea_32(bits[0], bits[1] ^ _key(*seed, PLACE), ROUNDS)
    u, v = (mi.Float(column) + _fraction(first)) / columns, (mi.Float(row) + _fraction(second)) / rows
    uv = mi.Point2f(*(float(a) * u + float(b) * v + float(c) for a, b, c in back[:2]))
    inside = (uv.x >= 0) & (uv.x < 1) & (uv.y >= 0) & (uv.y < 1)
    si = shape.eval_parameterization(uv, mi.RayFlags.All, inside)
    area = dr.norm(dr.cross(si.dp_du, si.dp_dv)) * abs(float(np.linalg.det(back[:2, :2]))) / (columns * rows)
    return _kept(shape, si, area, _zeta_of(bits[0], bits[1] ^ _key(*seed, ZETA)), inside & si.is_valid())


def _on_lattice(shape: mi.Shape, sonar: ChannelSonar, number: int) -> SurfacePoints:
    """Return the points of the world's lattice on a surface, one in each cell."""
    pitch = sonar.lattice_pitch_m
    cells = lattice_size(shape, pitch) / 2
    enough = pitch * math.sqrt(cells / MOST) * 1.1
    mend = "lower points_per_m2" if sonar.scatterer_spacing_m is None else "raise scatterer_spacing_m"
    _check_count(shape, cells, f"{mend}; a spacing of {enough:.2g} m would do")
    patches = None if sonar.speckle_nu is None else Patches(sonar.speckle_nu, sonar.speckle_patch_m)
    return lattice_points(shape, number, pitch, sonar.seed, patches)


def _kept(shape: mi.Shape, si: mi.SurfaceInteraction3f, area: DeviceArray, zeta: _Zeta, valid: DeviceArray) -> SurfacePoints:
    """Return the points whose strength is above 0."""
    strength = dr.select(valid, reflectivity_at(shape.bsdf(), si) * area * zeta.power, 0)
    dr.eval(si.p, si.n, strength, zeta.phase)
    found = np.array(strength)
    keep = np.flatnonzero((found > 0) & np.isfinite(found))
    place, normal = (np.broadcast_to(np.array(values).T, (len(found), 3))[keep] for values in (si.p, si.n))
    return SurfacePoints(np.ascontiguousarray(place), np.ascontiguousarray(normal), found[keep], np.array(zeta.phase)[keep])


def _check_count(shape: mi.Shape, count: float, mend: str) -> None:
    if count > MOST:
        raise MitsonarError(
            f"shape {shape.id() or 'of merged meshes'} would carry {count:,.0f} scatterers, more than {MOST:,}: {mend}"
        )


PLACE, ZETA = 82, 83
"""Last numbers of the keys that draw places within cells, and zeta of cells."""


def _key(seed: int, kind: int, drawn: int) -> DeviceArray:
    """Return 32 bits that choose a hash; they differ from those that draw the reflectivity."""
    return mi.UInt32(int(np.random.SeedSequence([abs(seed), kind, drawn]).generate_state(1)[0]))


def _zeta_of(first: DeviceArray, second: DeviceArray) -> _Zeta:
    """Hash 64 bits to complex Gaussian numbers of variance 1 (Box and Muller)."""
    bits: tuple[DeviceArray, DeviceArray] = mi.sample_tea_32(first, second, ROUNDS)
    # 23 bits: with one half added they fit a float32, so that the logarithm of 1 is never taken
    return _Zeta(-dr.log((mi.Float(bits[0] >> 9) + 0.5) * 2.0**-23), (_fraction(bits[1]) - 0.5) * (2 * math.pi))


def _fraction(bits: mi.UInt32) -> mi.Float:
    return (mi.Float(bits >> 8) + 0.5) * 2.0**-24


def _buckets(place: NDArray[np.float32], side: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sort points into buckets: the points of one cube that face one direction.

    Returns:
        The order of the points, near cubes near each other; and the index where each bucket begins, with the end.
    """
    low, high = place.min(axis=0).astype(float), place.max(axis=0).astype(float)
    reach = np.sort(high - low)[::-1]
    # an edge that holds A_BUCKET points of a surface as large as the two longest sides
    edge = math.sqrt(reach[0] * reach[1] * A_BUCKET / len(place))
    edge = max(edge, reach[0] / (2**BITS - 1), 1e-9)
    key = side.astype(np.uint64) << np.uint64(3 * BITS)
    for axis, values in enumerate(((place - low) / edge).T):
        key |= _spaced(values.astype(np.uint64)) << np.uint64(axis)
    order = np.argsort(key, kind="stable")
    new = np.flatnonzero(np.diff(key[order])) + 1
    return order, np.concatenate([[0], new, [len(place)]])


def _spaced(number: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Put two zeros before each bit of numbers below 2^21: three such make a position on Morton's curve."""
    masks = (0x1F00000000FFFF, 0x1F0000FF0000FF, 0x100F00F00F00F00F, 0x10C30C30C30C30C3, 0x1249249249249249)
    for shift, mask in zip((32, 16, 8, 4, 2), masks, strict=True):
        number = (number | (number << np.uint64(shift))) & np.uint64(mask)
    return number


def _ranges(first: NDArray[np.int64], buckets: NDArray[np.int64]) -> NDArray[np.uint32]:
    """Return the indices of all points of some buckets."""
    begin, count = first[buckets], first[buckets + 1] - first[buckets]
    if not len(begin):
        return np.empty(0, np.uint32)
    jump = np.ones(count.sum(), np.int64)
    ends = np.cumsum(count)
    jump[0] = begin[0]
    jump[ends[:-1]] = begin[1:] - (begin[:-1] + count[:-1] - 1)
    return np.cumsum(jump).astype(np.uint32)
