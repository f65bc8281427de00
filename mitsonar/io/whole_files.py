"""Files that are whole or absent."""

from __future__ import annotations

import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError

__all__ = ["read_json", "read_npz", "write_json", "write_whole"]


def write_whole(path: str | Path, content: bytes) -> None:
    """Write a file under another name and rename it: whoever looks finds the old one, or the whole new one."""
    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    with part.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def write_json(path: str | Path, value: dict[str, Any]) -> None:
    """A JSON file, whole or absent."""
    write_whole(path, (json.dumps(value, indent=2) + "\n").encode())


def read_json(path: str | Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        MitsonarError: no such file, not JSON, or not an object.
    """
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise MitsonarError(f"no such file: {path}") from None
    except (OSError, ValueError, RecursionError) as error:  # the last where it is nested too deep
        raise MitsonarError(f"cannot read {path}: {error}") from None
    if not isinstance(value, dict):
        raise MitsonarError(f"{path} must hold a JSON object")
    return value


def read_npz(path: str | Path) -> dict[str, NDArray[Any]]:
    """The arrays of an npz file by name; what its bytes lead to where it is damaged is the caller's to answer."""
    with zipfile.ZipFile(path) as file:  # read to the end, or NumPy would not see each part's checksum
        if any(entry.comment for entry in file.infolist()):  # a damaged length there swallows other parts
            raise ValueError("its list of parts is damaged")
        parts = {name.removesuffix(".npy"): io.BytesIO(file.read(name)) for name in file.namelist()}
    return {name: np.lib.format.read_array(part, allow_pickle=False) for name, part in parts.items()}
