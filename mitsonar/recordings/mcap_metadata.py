"""What ROS messages cannot tell of frames, as a metadata record of an MCAP file: sonar, axes and coding."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from mitsonar.errors import MitsonarError, explain_missing
from mitsonar.io.files import finite_number, parse_json
from mitsonar.records.frames import SonarFrames

__all__ = ["RECORD", "WRITTEN", "frames_like", "metadata_of"]

RECORD = "mitsonar"
"""Name of the record."""

WRITTEN = "/sonar/image"
"""Topic of the images that it describes."""

FIELDS = ("sonar", "level", "level_scale", "range_m", "bearing_rad")


def metadata_of(frames: SonarFrames, span_db: float | None = None) -> dict[str, str]:
    """Return the record of frames: JSON texts by name.

    Args:
        frames: of the file.
        span_db: over which samples are dB of linear levels; None: samples are values in the coding of the frames.
    """
    table = {
        "sonar": frames.sonar.model_dump(),
        "level": frames.level,
        "level_scale": frames.level_scale,
        "range_m": frames.range_m.tolist(),
        "bearing_rad": frames.bearing_rad.tolist(),
        "samples": _in_words(frames, span_db),
    }
    table |= {} if span_db is None else {"span_db": span_db}
    return {name: json.dumps(value) for name, value in table.items()}


def _in_words(frames: SonarFrames, span_db: float | None) -> str:
    """Return how samples become levels relative to full scale."""
    value, sonar = "sample / 255" if frames.image.dtype == np.uint8 else "sample", frames.sonar
    zero = "0 is no echo; "
    if span_db is not None or frames.level == "dB":
        text = f"{zero if span_db else ''}level in dB = {span_db or sonar.coding_db:g} * ({value} - 1)"
    elif frames.level == "gamma":
        text = f"level in dB = {20 / sonar.coding_gamma:g} * log10({value})"
    elif frames.level == "linear":
        text = f"{zero}level in dB = 10 * log10({value})"
    else:
        return "contrast: there are no levels"
    return f"{text}, relative to full scale, which is {10 * np.log10(frames.level_scale) + sonar.source_level_db:.6g} dB"


def frames_like(path: Path, images: np.dtype[np.generic]) -> tuple[SonarFrames, float | None] | None:
    """Return frames without images as the record of a file describes them, and the span of their samples.

    The span [dB] is None where samples are the values of the images. Without a record the answer is None.

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
    span_db = None
    if "span_db" in record:
        span_db = finite_number(parse_json(record["span_db"], f"span_db in {source}"), f"span_db in {source}", above=0)
        nothing["image"] = nothing["image"].astype(np.float32)
    return SonarFrames.from_arrays({**axes, **table, **nothing}, source), span_db


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
