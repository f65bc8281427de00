"""Videos of fans (MP4, AVI), written frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, explain_missing
from mitsonar.geometry.fan import cartesian_map
from mitsonar.io.runs import refuse_to_replace
from mitsonar.plotting.decibel_frames import coded_in_decibels
from mitsonar.records.frames import SonarFrames

__all__ = ["CODECS", "write_fan_video"]

CODECS = {".mp4": "mp4v", ".avi": "MJPG"}
"""Codec by the ending of the name."""

Picture = NDArray[np.uint8]


def write_fan_video(
    chunks: Iterable[SonarFrames],
    path: str | Path,
    rate_hz: float,
    *,
    span_db: float = 60.0,
    rows: int = 720,
    overwrite: bool = False,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Write frames of one geometry as a video: forward up, starboard right, with number and time since the first.

    The file is whole or absent.

    Args:
        chunks: the frames, some at a time.
        path: of the video, ``.mp4`` or ``.avi``.
        rate_hz: frames a second.
        span_db: levels from full scale down that are shown [dB].
        rows: height of the picture [px].
        overwrite: replace a file that is there.
        progress: called with how many more frames are written.

    Returns:
        The number of frames.

    Raises:
        MitsonarError: a file that is there, another ending, no frames, or OpenCV cannot write the codec.
    """
    path = Path(path)
    if path.suffix.lower() not in CODECS:
        raise MitsonarError(f"{path}: videos end with {' or '.join(CODECS)}")
    refuse_to_replace(path, overwrite=overwrite)
    if not path.parent.is_dir():
        raise MitsonarError(f"cannot write {path}: there is no folder {path.parent}; make it first")
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        count = _write(chunks, part, rate_hz, span_db, rows, progress or (lambda done: None))
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return count


def _write(
    chunks: Iterable[SonarFrames], path: Path, rate_hz: float, span_db: float, rows: int, progress: Callable[[int], None]
) -> int:
    """Write all frames and return their number."""
    try:
        import cv2
    except ModuleNotFoundError as error:
        raise explain_missing(error) from None
    colours = _colours()
    writer, fan, count, begin = None, None, 0, 0.0
    try:
        for frames in chunks:
            if fan is None:
                fan = cartesian_map(frames.range_m, frames.bearing_rad, rows=2 * (rows // 2))
            shown = coded_in_decibels(frames, span_db).image
            for image, time in zip(shown, np.atleast_2d(frames.time_s.T).T.mean(axis=1), strict=True):
                values = np.asarray(fan.apply(np.asarray(image, np.float32)))
                picture = _even(colours[np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)])
                begin = begin if count else float(time)
                text = f"{count}   {time - begin:.2f} s"
                cv2.putText(picture, text, (8, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 1, cv2.LINE_AA)
                if writer is None:
                    codec = cv2.VideoWriter.fourcc(*CODECS[path.suffix.lower()])
                    writer = cv2.VideoWriter(str(path), codec, rate_hz, (picture.shape[1], picture.shape[0]))
                    if not writer.isOpened():
                        raise MitsonarError(f"OpenCV cannot write {path.suffix} here: choose another ending")
                writer.write(picture)
                count += 1
                progress(1)
    finally:
        if writer is not None:
            writer.release()
    if not count:
        raise MitsonarError("there are no frames to show")
    return count


def _colours() -> Picture:
    """Return blue, green, red of each value ``(256, 3)``, those of the other figures."""
    from matplotlib import colormaps

    table = np.asarray(colormaps["copper"](np.arange(256)))[:, 2::-1]
    return np.asarray(np.rint(255 * table), dtype=np.uint8)


def _even(picture: Picture) -> Picture:
    """Return a picture with an even number of columns, as codecs want it."""
    return np.ascontiguousarray(np.pad(picture, ((0, 0), (0, picture.shape[1] % 2), (0, 0))))
