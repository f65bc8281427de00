"""Stacks of pictures in one ``.npz`` file: arrays ``frames`` or ``images``, times, and often the fan's own geometry."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from mitsonar.errors import MitsonarError
from mitsonar.io.files import FileArray, read_npz
from mitsonar.recordings.geometry_file import PictureGeometry
from mitsonar.recordings.picture_file import Grey, refuse_size
from mitsonar.recordings.picture_recording import Pictures, geometry_for, recording_of
from mitsonar.recordings.recording import Recording

__all__ = ["is_picture_stack", "read_picture_stack"]

NAMES = ("frames", "images")
"""Names of the array of pictures."""

TIMES = ("time_s", "times", "timestamps")
RATES = ("fps", "frame_rate_hz")
"""Names of the arrays of times [s] and of the rate [Hz]."""

FAN = {"apex_xy": "apex_px", "rmin_px": "near_px", "rmax_px": "far_px", "half_fov_deg": "half_angle_deg", "kx": "stretch"}
"""Arrays that tell a fan's geometry, and the keys of a geometry file that they are."""


def is_picture_stack(path: Path, first: bytes) -> bool:
    """Return whether a file is an npz file of pictures, and not frames of mitsonar."""
    if not first.startswith(b"PK") or path.suffix.lower() != ".npz":
        return False
    try:
        with zipfile.ZipFile(path) as file:
            names = {name.removesuffix(".npy") for name in file.namelist()}
    except Exception:  # damaged bytes raise errors of many kinds
        return False
    return bool(names & set(NAMES)) and not {"image", "sonar"} <= names


def read_picture_stack(path: Path, geometry: Path | None = None) -> Recording:
    """Open an npz file of pictures ``(pictures, rows, columns)``: uint8, or floats in 0..1.

    Args:
        path: of the file. Its arrays ``apex_xy``, ``rmin_px``, ``rmax_px``, ``half_fov_deg`` and ``kx`` (optional) tell the
            geometry of a fan whose metres are not known, where no geometry file does; ``fps`` or ``time_s`` the times.
        geometry: a geometry file; default: ``FILE.yaml`` or ``geometry.yaml`` beside the file.

    Raises:
        MitsonarError: damaged, no pictures, or no geometry.
    """
    try:
        table = read_npz(path)
    except MitsonarError:
        raise
    except Exception as error:  # damaged bytes raise errors of many kinds
        raise MitsonarError(f"cannot read {path}: {' '.join(str(error).split())[:200]}; it is damaged") from None
    name = next(one for one in NAMES if one in table)
    stack = _stack(table[name], f"{name} of {path}")
    told, told_by = geometry_for(path, geometry, _fan_in(table, path))
    times = next((table[one] for one in TIMES if one in table and table[one].shape == (len(stack),)), None)
    rate = next((_number(table[one], one, path) for one in RATES if one in table), None)

    def read(place: int) -> Grey:
        return np.asarray(stack[place])

    pictures = Pictures(
        path,
        "stack of pictures (.npz)",
        (stack.shape[1], stack.shape[2]),
        tuple(str(number) for number in range(len(stack))),
        read,
        None if times is None else np.asarray(times, dtype=float),
        rate_hz=rate,
        facts={"values": str(stack.dtype)},
    )
    return recording_of(pictures, told, told_by)


def _stack(values: FileArray, what: str) -> Grey:
    """Check pictures and return them: uint8, or float32 in 0..1."""
    if values.ndim != 3 or not len(values) or values.dtype.kind not in "uf":
        raise MitsonarError(f"{what} must be pictures (pictures, rows, columns), uint8 or floats: got {values.shape}")
    refuse_size(values.shape[1], values.shape[2], what)
    if values.dtype == np.uint8:
        return values
    if values.dtype == np.uint16:
        return np.asarray(values / np.float32(65535), dtype=np.float32)
    if values.dtype.kind == "u" or not np.isfinite(values).all() or values.min() < 0 or values.max() > 1 + 1e-5:
        raise MitsonarError(f"{what} must be uint8, uint16, or floats in 0..1: divide them by their largest value")
    return values.astype(np.float32)


def _fan_in(table: dict[str, FileArray], path: Path) -> PictureGeometry | None:
    """Return the geometry that the file's own arrays tell; None where they do not."""
    if not set(FAN) - {"kx"} <= set(table):
        return None
    apex = np.asarray(table["apex_xy"])
    if apex.shape != (2,) or apex.dtype.kind not in "iuf" or not np.isfinite(apex).all():
        raise MitsonarError(f"apex_xy of {path} must be two numbers: column and row of the apex")
    numbers = {key: _number(table[name], name, path) for name, key in FAN.items() if name in table and name != "apex_xy"}
    return PictureGeometry.create(
        layout="fan", apex_px=(float(apex[0]), float(apex[1])), scale_known=False, name=path.stem[:200], **numbers
    )


def _number(values: FileArray, name: str, path: Path) -> float:
    """Return the one finite number of an array."""
    if values.size != 1 or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise MitsonarError(f"{name} of {path} must be one number: got shape {values.shape}")
    return float(values.reshape(()))
