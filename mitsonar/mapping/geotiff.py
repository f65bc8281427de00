"""A mosaic as a GeoTIFF."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from mitsonar.io.files import write_whole
from mitsonar.mapping.mosaic import Mosaic

__all__ = ["save_geotiff"]


def save_geotiff(path: str | Path, mosaic: Mosaic) -> None:
    """Write a GeoTIFF: bands mean, std and count as float32, nan where unknown, in metres of the local world.

    The reference system is a local engineering one: x east, y north, with no place on Earth (GeoTIFF 1.1: user-defined
    model, linear unit metre).
    """
    import tifffile

    bands = np.stack([mosaic.mean, mosaic.std, mosaic.count.astype(np.float32)])
    west, _, _, north = mosaic.extent
    names = ("mean level, 0..1", "standard deviation of the frames' levels", "frames that saw the cell")
    items = "".join(f'<Item name="DESCRIPTION" sample="{i}" role="description">{n}</Item>' for i, n in enumerate(names))
    citation = "mitsonar world: x east, y north, metres|"
    keys = [(1024, 0, 1, 32767), (1025, 0, 1, 1), (1026, 34737, len(citation), 0), (3076, 0, 1, 9001)]
    directory = [1, 1, 1, len(keys), *(number for key in keys for number in key)]
    tags = [
        (33550, "d", 3, (mosaic.cell_m, mosaic.cell_m, 0.0), True),  # ModelPixelScale
        (33922, "d", 6, (0.0, 0.0, 0.0, west, north, 0.0), True),  # ModelTiepoint: the corner of pixel (0, 0)
        (34735, "H", len(directory), directory, True),  # GeoKeyDirectory
        (34737, "s", 0, citation, True),  # GeoAsciiParams
        (42112, "s", 0, f"<GDALMetadata>{items}</GDALMetadata>", True),  # GDAL_METADATA: names of bands
        (42113, "s", 0, "nan", True),  # GDAL_NODATA
    ]
    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer,
        bands,
        bigtiff=bands.nbytes > 2**31,
        photometric="minisblack",
        planarconfig="separate",
        compression="zlib",
        metadata=None,
        extratags=tags,
    )
    write_whole(path, buffer.getvalue())
