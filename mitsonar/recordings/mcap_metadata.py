"""What ROS messages cannot tell of frames, as a metadata record of an MCAP file: sonar, axes and coding."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from mitsonar.errors import MitsonarError, explain_missing
from mitsonar.io.plain_data import parse_json
from mitsonar.records.sonar_frames import SonarFrames

__all__ = ["RECORD", "WRITTEN", "frames_like", "metadata_of"]

RECORD = "mitsonar"
"""Name of the record."""

WRITTEN = "/sonar/image"
"""Topic of the images that it describes."""

FIELDS = ("sonar", "level", "level_scale", "range_m", "bearing_rad")


def metadata_of(frames: SonarFrames) -> dict[str, str]:
    """Return the record of frames: JSON texts by name."""
    table = {
        "sonar": frames.sonar.model_dump(),
        "level": frames.level,
        "level_scale": frames.level_scale,
        "range_m": frames.range_m.tolist(),
        "bearing_rad": frames.bearing_rad.tolist(),
    }
    return {name: json.dumps(value) for name, value in table.items()}


def frames_like(path: Path, images: np.dtype[np.generic]) -> SonarFrames | None:
    """Return frames without images as the record of a file describes them; None where it has none.

    Args:
        path: of an ``.mcap``.
        images: type of the images.

    Raises:
        MitsonarError: a damaged record.
    """
    record = _record_in(path)
    if record is None:
        return None
    source = f"the metadata of {path}"
    missing = [name for name in FIELDS if name not in record]
    if missing:
        raise MitsonarError(f"{source} lack {', '.join(missing)}: the file is damaged")
    value = {name: parse_json(record[name], f"{name} in {source}") for name in FIELDS}
    try:
        axes = {name: np.array(value[name], dtype=np.float64).reshape(-1) for name in ("range_m", "bearing_rad")}
        table = {name: np.array(value[name]) for name in ("level", "level_scale")} | {"sonar": np.array(record["sonar"])}
        nothing = {"image": np.zeros((0, *(len(one) for one in axes.values())), images), "time_s": np.zeros(0)}
    except (TypeError, ValueError) as error:
        raise MitsonarError(f"{source} are damaged: {error}") from None
    return SonarFrames.from_arrays({**axes, **table, **nothing}, source)


def _record_in(path: Path) -> dict[str, str] | None:
    """Return mitsonar's metadata record of a file."""
    try:
        from mcap.reader import make_reader
    except ModuleNotFoundError as error:
        raise explain_missing(error) from None
    try:
        with path.open("rb") as file:
            return next((one.metadata for one in make_reader(file).iter_metadata() if one.name == RECORD), None)
    except Exception as error:  # a damaged file raises errors of many kinds
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise MitsonarError(f"cannot read the metadata of {path}: {reason}; the file is damaged") from None
