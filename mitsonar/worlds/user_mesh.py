"""A world from a user's own model, with or without textures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, argument, meant
from mitsonar.worlds.model_pieces import UP, merged, read_pieces, reflectivity_of
from mitsonar.worlds.world import Floor, Standpoint, World

__all__ = ["mesh_world", "overview", "random_seabed"]

LARGEST_M = 1e6
"""Largest extent of a model [m]."""

FARTHEST_M = 1e9
"""Largest distance of a model from the file's origin [m]."""


def mesh_world(
    path: str | Path,
    *,
    scale: float = 1.0,
    up: str | None = None,
    reflectivity: str | float = "luminance",
    floor: bool = True,
    floor_m: float | None = None,
) -> World:
    """Build the world of a model: z upwards, scaled, its lowest point on a seabed at z = 0, centred on the origin.

    Args:
        path: glTF, OBJ, STL, COLLADA or PLY.
        scale: metres in a unit of the file.
        up: the file's axis that points up, x, y or z; default: y for glTF, z otherwise.
        reflectivity: ``luminance`` (of linear light, as Mitsuba computes it), ``red`` (the stored red channel, as in
            Almanza-Medina), or one number for all.
        floor: whether a seabed of random cells of 15 mm lies below.
        floor_m: edge of that seabed [m]; default: three times the model's diagonal.

    Raises:
        MitsonarError: the model is unreadable, broken or empty; scale, axis or reflectivity is not allowed.
    """
    path = Path(path)
    up = up or ("y" if path.suffix.lower() in (".glb", ".gltf") else "z")
    _check_options(up, scale, floor_m)
    pieces = read_pieces(path, reflectivity_of(reflectivity))
    turn = np.array(UP[up], dtype=float) * scale
    corners = np.concatenate([(piece.vertices @ turn.T)[np.unique(piece.faces)] for piece in pieces])
    _check_extent(path, corners, scale)
    low, high = corners.min(axis=0), corners.max(axis=0)
    shift = np.array([*(low + high)[:2] / 2, low[2]])
    meshes, content = merged([piece.moved(turn, shift) for piece in pieces])
    radius = float(np.linalg.norm(high - low)) / 2
    half = 3 * radius if floor_m is None else floor_m / 2
    return World(
        about=f"{path.name}: {sum(len(piece.faces) for piece in pieces)} triangles, "
        f"{' x '.join(f'{edge:.4g}' for edge in high - low)} m, reflectivity {reflectivity}",
        meshes=meshes,
        stand=overview(radius, (high - low)[2]),
        floor=random_seabed(half) if floor else None,
        content=content,
    )


def _check_options(up: str, scale: float, floor_m: float | None) -> None:
    """Check the options of :func:`mesh_world`.

    Raises:
        MitsonarError: one of them is not allowed.
    """
    if up not in UP:
        raise MitsonarError(f"{argument('up')} must be x, y or z: got {up!r}{meant(up, UP)}")
    if not (np.isfinite(scale) and scale > 0):
        raise MitsonarError(f"{argument('scale')} must be a finite number above 0, metres a unit of the file: got {scale:g}")
    if floor_m is not None and not 0 < floor_m <= 10_000:
        raise MitsonarError(f"{argument('floor_m')} must lie in 0..10000 m: got {floor_m:g}")


def _check_extent(path: Path, corners: NDArray[np.float64], scale: float) -> None:
    """Check that the corners of a model ``(n, 3)`` [m] are finite, and neither one point nor too far apart.

    Raises:
        MitsonarError: they are not.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        extent = float(np.ptp(corners, axis=0).max())
    if not np.isfinite(corners).all() or extent <= 0:
        raise MitsonarError(f"{path} is broken: its vertices are not finite or all in one place; export it again")
    if not (extent <= LARGEST_M and np.abs(corners).max() <= FARTHEST_M):
        raise MitsonarError(
            f"{path} spans {extent:.4g} m with scale {scale:g}: a model spans at most {LARGEST_M:g} m; give the scale in "
            "metres a unit of the file"
        )


def random_seabed(half_m: float, z_m: float = 0.0) -> Floor:
    """Return a square seabed of random cells of 15 mm; ``half_m`` is half its edge [m]."""
    return Floor(half_m, Floor.cells(int(np.clip(round(2 * half_m / 0.015), 1, 2**20)), (0, 1), 0), z_m)


def overview(radius: float, height: float, foot: ArrayLike = (0.0, 0.0, 0.0), *, nearest: float = 0.0) -> Standpoint:
    """Return a sonar 30 deg above, at the distance at which the model fills a field of view of 29 deg.

    Args:
        radius: of the model [m].
        height: of the model [m].
        foot: the point below its middle, at its lowest height ``(3,)`` [m].
        nearest: the sonar keeps this distance [m].
    """
    away = max(1.1 * radius / np.tan(np.radians(14.5)), nearest)
    x, y, z = (float(value) for value in np.asarray(foot))
    middle = z + height / 2
    sin, cos = np.sin(np.radians(30)), np.cos(np.radians(30))
    window = (max(away - 1.5 * radius, 0.01), away + 2.5 * radius)
    return Standpoint((x, y - away * cos, middle + away * sin), (x, y, middle), window=window)
