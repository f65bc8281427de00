"""The npz files of sounders: arrays of pings with the instrument in JSON, checked when they are read."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sounder import Sounder
from mitsonar.io.files import parse_json, read_npz, write_whole

__all__ = ["load_pings", "save_pings"]


def save_pings(path: str | Path, sounder: Sounder, arrays: dict[str, NDArray[Any]]) -> None:
    """Write arrays and the instrument to an npz file, whole or absent."""
    buffer = io.BytesIO()
    told = sounder.model_dump(mode="json", exclude={"fan"}) | {"fan": sounder.fan.model_dump(mode="json")}
    table: dict[str, Any] = {"sounder": np.array(json.dumps(told)), **arrays}
    np.savez_compressed(buffer, **table)
    write_whole(Path(path), buffer.getvalue())


def load_pings(path: str | Path, names: tuple[str, ...]) -> tuple[Sounder, dict[str, NDArray[Any]]]:
    """Read a file of :func:`save_pings`: the instrument and the named arrays, finite or nan, with the same first length.

    Raises:
        MitsonarError: unreadable, or not such a file.
    """
    try:
        found = read_npz(path)
    except MitsonarError:
        raise
    except Exception as error:  # damaged bytes raise errors of many kinds
        raise MitsonarError(f"cannot read {path}: {error}; give a file that `mitsonar sound` wrote") from None
    lacking = [name for name in (*names, "sounder", "time_s", "poses") if name not in found]
    if lacking:
        raise MitsonarError(f"{path} lacks {lacking[0]}: give a file that `mitsonar sound` wrote")
    told: Any = parse_json(str(found.pop("sounder")), str(path))
    if not isinstance(told, dict) or not isinstance(told.get("fan"), dict):
        raise MitsonarError(f"{path} tells of no instrument: give a file that `mitsonar sound` wrote")
    sounder = Sounder.create(**{**told.pop("fan"), **told})
    arrays = {name: found[name] for name in (*names, "time_s", "poses")}
    pings = len(arrays["time_s"]) if arrays["time_s"].ndim == 1 else -1
    for name, values in arrays.items():
        if values.dtype.kind != "f" or not values.ndim or len(values) != pings or np.isinf(values).any():
            raise MitsonarError(f"{path} is damaged: {name} must be {pings} rows of numbers")
    if arrays["poses"].shape != (pings, 6) or not pings:
        raise MitsonarError(f"{path} is damaged: poses must be (pings, 6), got {arrays['poses'].shape}")
    return sounder, arrays
