"""Store the echo of every traced ray, the input of all later computations, and read and write it as EXR."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.materials import FLATTEST
from mitsonar.arrays import AnyArray
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.files import PlainValue

__all__ = ["CHANNELS", "Echoes", "load_exr", "save_exr"]


@dataclass
class Echoes:
    """Echoes of rays, with one value per ray: Dr.Jit arrays that are not evaluated yet, or NumPy arrays.

    Attributes:
        hit: 1 if the ray met a surface, else 0, in which case all other values are 0 (``shape_id`` -1).
        range_m: distance from the sonar to the hit point [m].
        near_m: range at which the ray's elevation cell starts on the surface (its tangent plane) [m].
        far_m: range at which it ends [m].
        reflectivity: 0..1, or 0..1 / cosine for the scattering law of a material.
        cosine: |cos(angle of incidence)|.
        solid_angle_sr: solid angle of the ray's cell [sr].
        x, y, z: hit point in the world [m].
        nx, ny, nz: geometric normal at the hit point.
        shape_id: index of the shape in the scene.
        object_id: number of the object within its mesh (the mesh's attribute ``face_id``), or 0 without one.
    """

    hit: AnyArray
    range_m: AnyArray
    near_m: AnyArray
    far_m: AnyArray
    reflectivity: AnyArray
    cosine: AnyArray
    solid_angle_sr: AnyArray
    x: AnyArray
    y: AnyArray
    z: AnyArray
    nx: AnyArray
    ny: AnyArray
    nz: AnyArray
    shape_id: AnyArray
    object_id: AnyArray

    def __repr__(self) -> str:
        if not isinstance(self.hit, np.ndarray):
            return "Echoes(not evaluated yet)"
        hit = self.hit > 0
        extent = f", {self.range_m[hit].min():.4g}..{self.range_m[hit].max():.4g} m" if hit.any() else ""
        return f"Echoes({hit.size:,} rays, {int(hit.sum()):,} hit{extent})"

    def outside(self, sonar: Sonar) -> tuple[float, float] | None:
        """Return the nearest and farthest echo outside the window [m], or None; requires NumPy arrays."""
        near, far = (self.range_m, self.range_m) if sonar.model == "thesis" else (self.near_m, self.far_m)
        outside_window = (far < sonar.range_min) | (near >= sonar.range_max)
        outside_range_m = self.range_m[(self.hit > 0) & outside_window]
        return (float(outside_range_m.min()), float(outside_range_m.max())) if outside_range_m.size else None


CHANNELS = tuple(field.name for field in fields(Echoes))
"""Channels of the integrator ``echo`` and of an EXR file of ``echoes/``, in this order; EXR files sort them by name."""


LIMITS = (
    *(("hit", 0, 1), ("reflectivity", 0, 1001), ("cosine", 0, 1.001), ("solid_angle_sr", 0, 13), ("range_m", 0, 1e9)),
    *(("shape_id", -1, 2**24), ("nx", -1.001, 1.001), ("ny", -1.001, 1.001), ("nz", -1.001, 1.001)),
)
"""Smallest and largest values of the channels."""

INFLATION = 1032
"""Largest factor by which deflated pixels can grow on decompression."""


def save_exr(path: str | Path, echoes: Echoes, sonar: Sonar) -> None:
    """Write the echoes of one frame ``(rays_per_beam, columns)`` as float32, with one channel per field."""
    import OpenEXR

    shape = (sonar.rays_per_beam, sonar.columns)
    channels = {name: np.asarray(getattr(echoes, name), np.float32).reshape(shape) for name in CHANNELS}
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


def load_exr(path: str | Path, sonar: Sonar) -> Echoes:
    """Read the echoes of one frame as flat float32 arrays, in film order.

    Raises:
        MitsonarError: not an EXR file, missing channels, a size that differs from the sonar's, or values out of bounds.
    """
    import OpenEXR

    shape = (sonar.rays_per_beam, sonar.columns)
    if not os.path.isfile(path):
        raise MitsonarError(f"no such echo file: {path}")
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            _check_header(file.header(), [str(name) for name in file.channels()], shape, Path(path).stat().st_size)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except MitsonarError as error:
        raise MitsonarError(f"{path} {error}") from None
    except Exception as error:  # OpenEXR raises bare exceptions of several types
        raise MitsonarError(f"cannot read echoes {path}: {error}; render them again with --exr") from None
    values: dict[str, NDArray[np.float32]] = {}
    for name in CHANNELS:
        if name not in channels:
            raise MitsonarError(f"{path} lacks the channel {name}: has {', '.join(sorted(channels))}")
        if channels[name].shape != shape:
            raise MitsonarError(f"{path} must have {shape[1]} x {shape[0]} rays, like its sonar: got {channels[name].shape}")
        values[name] = np.ascontiguousarray(channels[name], dtype=np.float32).ravel()
        if not np.isfinite(values[name]).all():
            raise MitsonarError(f"{path}: channel {name} holds inf or nan; render the echoes again with --exr")
    for name, low, high in LIMITS:
        if values[name].min() < low or values[name].max() > high:
            raise MitsonarError(f"{path}: channel {name} must lie in {low}..{high}; render the echoes again with --exr")
    if (values["reflectivity"] * np.maximum(values["cosine"], FLATTEST)).max() > 1.001:
        raise MitsonarError(f"{path}: channel reflectivity must lie in 0..1 / cosine; render the echoes again with --exr")
    return Echoes(**values)


def _check_header(header: dict[str, PlainValue], names: list[str], shape: tuple[int, int], size: int) -> None:
    """Check the header of a file before its pixels are read.

    Raises:
        MitsonarError: a size that differs from the sonar's, or more pixels than the file can contain.
    """
    low, high = (np.asarray(corner).tolist() for corner in header["dataWindow"])
    film_shape = (high[1] - low[1] + 1, high[0] - low[0] + 1)
    if film_shape != shape:
        raise MitsonarError(f"must have {shape[1]} x {shape[0]} rays, like its sonar: got {film_shape}")
    if len(names) > 100 or len(names) * 2 * shape[0] * shape[1] > INFLATION * size:
        raise MitsonarError(f"declares {len(names)} channels of {shape[1]} x {shape[0]} rays in {size:,} bytes")
