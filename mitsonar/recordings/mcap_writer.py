"""Sonar frames as an MCAP file of ROS 2 messages, for Foxglove, RViz and ``ros2 bag play``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsonar.errors import MitsonarError, explain_missing
from mitsonar.io.runs import refuse_to_replace
from mitsonar.recordings.mcap_metadata import RECORD, WRITTEN, metadata_of
from mitsonar.recordings.ros_encoding import TOPICS, Encoded, FrameEncoder
from mitsonar.records.frames import LABELS, PER_FRAME, SonarFrames, to_uint8

if TYPE_CHECKING:
    from mcap.writer import Writer

__all__ = ["SPAN_DB", "write_mcap"]

SPAN_DB = 80.0
"""Levels from full scale down that 8 bits hold of linear images [dB]; a step is 0.31 dB."""

CHUNK_BYTES = 4 * 2**20
"""Size of the pieces that are compressed at a time [bytes]."""


def write_mcap(
    chunks: Iterable[SonarFrames],
    path: str | Path,
    *,
    picture: str = "jpeg",
    full: bool = False,
    labels: bool = False,
    overwrite: bool = False,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Write frames of one sonar as MCAP (profile ``ros2``, CDR, chunks in Zstandard); the file is whole or absent.

    Topics: ``/sonar/image`` (``marine_acoustic_msgs/ProjectedSonarImage``), ``/sonar/fan/compressed``
    (``sensor_msgs/CompressedImage``). With poses ``/sonar/odometry`` (``nav_msgs/Odometry``) and ``/tf``, with attitudes
    ``/sonar/imu`` (``sensor_msgs/Imu``), with heights ``/sonar/altitude`` (``sensor_msgs/Range``). Times in headers are
    those of the frames.

    Samples are 8 bit: values in the codings dB and gamma times 255, linear levels as dB over
    :data:`~mitsonar.recordings.mcap_writer.SPAN_DB`, which
    :func:`~mitsonar.recordings.open_recording.open_recording` turns into levels again. A metadata record holds the sonar,
    exact ranges and bearings, the coding, and how samples become levels, in words.

    Args:
        chunks: the frames, some at a time, of one geometry; the first say which arrays all have.
        path: of the file; its name ends with ``.mcap``.
        picture: format of the fans: ``jpeg``, or the larger ``png``.
        full: samples as they are, float32 or uint8, bit for bit, and with labels.
        labels: ``/sonar/points`` (``sensor_msgs/PointCloud2``) of frames with elevations, about as large as all else.
        overwrite: replace a file that is there.
        progress: called with how many more frames are written.

    Returns:
        The number of frames.

    Raises:
        MitsonarError: a file that is there, a name that ends otherwise, no frames, or times that ROS cannot hold.
    """
    path = Path(path)
    if path.suffix != ".mcap":
        raise MitsonarError(f"{path} must end with .mcap: ROS tells bags by their names")
    refuse_to_replace(path, overwrite=overwrite)
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("wb") as file:
            writer = _writer(file)
            span_db: list[float] = []
            smaller = (_reduced(frames, full, labels, span_db) for frames in chunks)
            count = _write(writer, smaller, picture, span_db, progress or (lambda done: None))
            writer.finish()  # type: ignore[no-untyped-call]
        part.replace(path)
    except FileNotFoundError:
        raise MitsonarError(f"cannot write {path}: there is no folder {path.parent}; make it first") from None
    finally:
        part.unlink(missing_ok=True)
    return count


def _writer(file: object) -> Writer:
    try:
        from mcap.writer import CompressionType, Writer
    except ModuleNotFoundError as error:
        raise explain_missing(error) from None
    return Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)  # type: ignore[arg-type]


def _reduced(frames: SonarFrames, full: bool, labels: bool, span_db: list[float]) -> SonarFrames:
    """Return frames as they are written; ``span_db`` gets the span where linear levels became dB."""
    if full:
        return frames
    if not labels:
        nothing: dict[str, Any] = dict.fromkeys(LABELS)
        frames = replace(frames, **nothing)
    if frames.image.dtype == np.uint8:
        return frames
    if frames.level != "linear":
        return replace(frames, image=to_uint8(frames.image))
    span_db[:] = [SPAN_DB]
    with np.errstate(divide="ignore"):
        value = 1 + np.log10(np.clip(frames.image, 0, 1)) * np.float32(10 / SPAN_DB)
    return replace(frames, image=to_uint8(np.where(frames.image > 0, np.maximum(value, np.float32(1e-6)), np.float32(0))))


def _write(
    writer: Writer, chunks: Iterator[SonarFrames], picture: str, span_db: list[float], progress: Callable[[int], None]
) -> int:
    """Write all frames and return their number."""
    first = next((one for one in chunks if len(one)), None)
    if first is None:
        raise MitsonarError("there are no frames to write")
    encoder = FrameEncoder(first.select(slice(0)), picture)
    writer.start(profile="ros2", library="mitsonar")
    writer.add_metadata(RECORD, metadata_of(first, span_db[0] if span_db else None))
    channels = _channels(writer, encoder)
    count, fixed = 0, False
    for frames in _all(first, chunks):
        for message in encoder.messages(frames):
            if not fixed:
                _add(writer, channels, encoder.fixed(message.time_ns), 0)
                fixed = True
            _add(writer, channels, message, count)
            if message.topic == WRITTEN:
                count += 1
                progress(1)
    return count


def _all(first: SonarFrames, rest: Iterator[SonarFrames]) -> Iterator[SonarFrames]:
    """Yield the first chunk and the others.

    Raises:
        MitsonarError: frames of another geometry, or with other arrays.
    """
    yield first
    for one in rest:
        if one.image.shape[1:] != first.image.shape[1:] or _known(one) != _known(first):
            raise MitsonarError("all frames of an MCAP file must have one geometry and the same arrays: write two files")
        yield one


def _known(frames: SonarFrames) -> list[bool]:
    """Return which arrays frames have."""
    return [getattr(frames, name) is not None for name in PER_FRAME]


def _channels(writer: Writer, encoder: FrameEncoder) -> dict[str, int]:
    """Register types and topics; return the number of each topic."""
    schemas: dict[str, int] = {}
    channels = {}
    for topic in encoder.topics:
        kind = TOPICS[topic]
        if kind not in schemas:
            schemas[kind] = writer.register_schema(kind, "ros2msg", encoder.definition(topic).encode())
        channels[topic] = writer.register_channel(topic, "cdr", schemas[kind], _quality(topic))
    return channels


def _quality(topic: str) -> dict[str, str]:
    """Return the channel's metadata: fixed transforms are kept for subscribers that come later."""
    if topic != "/tf_static":
        return {}
    ever = "{sec: 9223372036, nsec: 854775807}"
    quality = f"{{history: 1, depth: 1, reliability: 1, durability: 1, deadline: {ever}, lifespan: {ever}, liveliness: 1, "
    return {
        "offered_qos_profiles": f"- {quality}liveliness_lease_duration: {ever}, avoid_ros_namespace_conventions: false}}"
    }


def _add(writer: Writer, channels: dict[str, int], message: Encoded, sequence: int) -> None:
    writer.add_message(channels[message.topic], message.time_ns, message.data, message.time_ns, sequence)
