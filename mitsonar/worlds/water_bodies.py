"""What drifts and hangs in the water as one mesh each: a cloud of particles, and a net of thin bars."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError

__all__ = ["fishing_net_mesh", "particle_mesh"]

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Vertices ``(vertices, 3)`` [m] and triangles ``(faces, 3)``, outward."""

MOST = 5_000_000
"""Particles or bars at most."""


def particle_mesh(count: int, size_m: tuple[float, float, float], radius_m: float, seed: int = 0) -> Mesh:
    """Make octahedra at random places and attitudes in a box about the origin.

    An octahedron of radius a has the surface 4 sqrt(3) a^2. With Lambert's mu its mean backscattering cross-section is mu
    times a sixth of the surface, as of every convex body.

    Args:
        count: of the particles.
        size_m: of the box, east, north, up.
        radius_m: from the middle of a particle to its corners.
        seed: of places and attitudes.

    Raises:
        MitsonarError: no particles, or too many; a size that is not positive.
    """
    if not 1 <= count <= MOST or not min(*size_m, radius_m) > 0:
        raise MitsonarError(f"particles are 1..{MOST:,} of positive size: got {count} of {radius_m:g} m in {size_m} m")
    rng = np.random.default_rng(seed)
    corners = np.concatenate([np.eye(3), -np.eye(3)]) * radius_m
    sides = [[x, y, z] for x in (0, 3) for y in (1, 4) for z in (2, 5)]
    outward = [side if np.linalg.det(corners[side]) > 0 else side[::-1] for side in sides]
    turned = np.einsum("nij,kj->nki", Rotation.random(count, random_state=rng).as_matrix(), corners)
    vertices = turned + rng.uniform(-0.5, 0.5, (count, 1, 3)) * np.asarray(size_m)
    return vertices.reshape(-1, 3), _copied(np.array(outward), len(corners), count)


def fishing_net_mesh(width_m: float, height_m: float, opening_m: float, twine_m: float) -> Mesh:
    """Make a net of square openings in the plane y = 0, from the origin to east and up, of bars with three sides.

    Args:
        width_m: of the net, a whole number of openings at least.
        height_m: of the net.
        opening_m: from bar to bar.
        twine_m: diameter of the bars.

    Raises:
        MitsonarError: sizes that make no net.
    """
    if not 0 < twine_m < opening_m <= min(width_m, height_m):
        raise MitsonarError(
            f"a net has twine < opening <= size: got {twine_m:g}, {opening_m:g}, {width_m:g}, {height_m:g} m"
        )
    across, up = (round(size / opening_m) for size in (width_m, height_m))
    if (across + 1) * up + (up + 1) * across > MOST:
        raise MitsonarError(f"a net has at most {MOST:,} bars: enlarge opening_m, got {opening_m:g}")
    x, z = (a.ravel() for a in np.meshgrid(np.arange(across + 1), np.arange(up + 1), indexing="ij"))
    knots = np.column_stack([x, np.zeros_like(x), z]) * opening_m
    begins = np.concatenate([knots[z < up], knots[x < across]])
    ways = np.repeat([[0, 0, opening_m], [opening_m, 0, 0]], [(z < up).sum(), (x < across).sum()], axis=0)
    turn = 2 * np.pi * np.arange(3) / 3
    round_ = 0.5 * twine_m * np.column_stack([np.cos(turn), np.sin(turn)])
    side = np.cross(ways / opening_m, [0.0, 1.0, 0.0])
    ring = round_[None, :, :1] * side[:, None] + round_[None, :, 1:] * np.array([0.0, 1.0, 0.0])
    vertices = np.concatenate([begins[:, None] + ring, (begins + ways)[:, None] + ring], axis=1)
    faces = [[k, 3 + k, (k + 1) % 3] for k in range(3)] + [[(k + 1) % 3, 3 + k, 3 + (k + 1) % 3] for k in range(3)]
    return vertices.reshape(-1, 3), _copied(np.array(faces), 6, len(begins))


def _copied(faces: NDArray[np.int64], vertices: int, count: int) -> NDArray[np.int64]:
    """Return the triangles of copies of a shape with so many vertices."""
    return np.asarray((faces[None] + vertices * np.arange(count)[:, None, None]).reshape(-1, 3), dtype=np.int64)
