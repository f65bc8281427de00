"""Write a height map as a mesh, as a GeoTIFF or as arrays."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from mitsonar.errors import MitsonarError
from mitsonar.io.files import write_atomic
from mitsonar.io.ply import ply_bytes
from mitsonar.mapping.height_map import HeightMap
from mitsonar.mapping.mosaic import geotiff_bytes

__all__ = ["FORMATS", "save_height_map"]

FORMATS = (".ply", ".tif", ".tiff", ".npz")


def save_height_map(path: str | Path, height_map: HeightMap) -> None:
    """Write a height map in the format of the file's extension; the file is complete or absent.

    ``.ply`` is a mesh with a vertex at the centre of each known cell and its standard deviation as the vertex property
    ``std_m``; ``.tif`` is a GeoTIFF with the float32 bands height and standard deviation, nan where unknown; ``.npz`` holds
    both arrays, with row 0 northernmost, and what :class:`~mitsonar.mapping.height_map.HeightMap` states about them.

    Args:
        path: file to write; an existing file is replaced.
        height_map: the map.

    Raises:
        MitsonarError: the extension is another, or a package is missing.
    """
    kind = Path(path).suffix.lower()
    if kind not in FORMATS:
        raise MitsonarError(f"a height map's name must end in one of {', '.join(FORMATS)}: got {str(path)!r}")
    writers = {".ply": _ply, ".npz": _npz}
    write_atomic(path, writers.get(kind, _geotiff)(height_map))


def _ply(height_map: HeightMap) -> bytes:
    """Return a binary PLY mesh, two triangles for each square of four known cells."""
    # 1. Number the known cells; each is a vertex.
    known = np.isfinite(height_map.height_m)
    number = np.cumsum(known).reshape(known.shape) - 1
    x, y = height_map.centres
    vertices = np.column_stack([x[known], y[known], height_map.height_m[known]])
    # 2. Squares with four known corners; triangles run counter-clockwise as seen from above.
    whole = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
    parts = (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:])
    north_west, north_east, south_west, south_east = (part[whole] for part in parts)
    corners = [(north_west, south_west, south_east), (north_west, south_east, north_east)]
    faces = np.concatenate([np.column_stack(triangle) for triangle in corners])
    # 3. Positions of double precision: in single, eastings and northings of a map on the Earth are rounded to 0.5 m.
    columns = {name: ("<f8", values) for name, values in zip("xyz", vertices.T, strict=True)}
    return ply_bytes({**columns, "std_m": ("<f4", height_map.std_m[known])}, faces)


def _geotiff(height_map: HeightMap) -> bytes:
    bands = np.stack([height_map.height_m, height_map.std_m]).astype(np.float32)
    names = ("height, m", "standard deviation of the height, m")
    return geotiff_bytes(bands, names, (height_map.west_m, height_map.north_m), height_map.cell_m)


def _npz(height_map: HeightMap) -> bytes:
    buffer = io.BytesIO()
    trials = [(trial.std_m, trial.length_m, trial.deviance) for trial in height_map.trials]
    np.savez_compressed(
        buffer,
        height_m=height_map.height_m,
        std_m=height_map.std_m,
        west_m=height_map.west_m,
        north_m=height_map.north_m,
        cell_m=height_map.cell_m,
        ground_m=height_map.ground_m,
        trials=np.array(trials),
        dispersion=height_map.dispersion,
        reflectivity=height_map.reflectivity,
        frames=height_map.frames,
    )
    return buffer.getvalue()
