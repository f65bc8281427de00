"""Videos of fans or polar pictures (``.avi``, ``.mp4``), read by OpenCV frame by frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mitsonar.errors import MitsonarError, explain_missing
from mitsonar.recordings.picture_file import Grey, refuse_size
from mitsonar.recordings.picture_recording import Pictures, geometry_for, recording_of
from mitsonar.recordings.recording import Recording

__all__ = ["is_video", "read_picture_video"]

MOST_PICTURES = 2_000_000
"""Frames of a video, at most."""


def is_video(path: Path, first: bytes) -> bool:
    """Return whether a file is an AVI or MP4 video, by its first bytes."""
    return (first[:4] == b"RIFF" and first[8:12] == b"AVI ") or first[4:8] == b"ftyp"


def read_picture_video(path: Path, geometry: Path | None = None) -> Recording:
    """Open a video; its frames are decoded on demand, and counted once.

    Args:
        path: of the video. Its nominal frame rate counts where the geometry tells none.
        geometry: a geometry file; default: ``FILE.yaml`` or ``geometry.yaml`` beside the video.

    Raises:
        MitsonarError: OpenCV is not there, damaged, or no geometry.
    """
    told, told_by = geometry_for(path, geometry)
    video = _Video(path)
    count, rate = video.count(), video.rate_hz
    pictures = Pictures(
        path,
        f"video ({path.suffix.lower() or 'no ending'})",
        video.shape,
        tuple(str(number) for number in range(count)),
        video.read,
        rate_hz=rate,
        facts={} if rate is None else {"nominal_rate_hz": rate},
    )
    return recording_of(pictures, told, told_by)


class _Video:
    """A video that is decoded forward; going back begins anew."""

    def __init__(self, path: Path) -> None:
        try:
            import cv2
        except ModuleNotFoundError as error:
            raise explain_missing(error) from None
        self.cv2, self.path = cv2, path
        self.capture: Any = None
        self.at = 0
        self._begin()
        opened: Any = self.capture
        rows, columns = (int(opened.get(one)) for one in (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH))
        refuse_size(rows, columns, str(path))
        rate = float(opened.get(cv2.CAP_PROP_FPS))
        self.shape, self.rate_hz = (rows, columns), rate if np.isfinite(rate) and 0 < rate < 1e4 else None

    def _begin(self) -> None:
        """Open the video at its first frame."""
        if self.capture is not None:
            self.capture.release()
        self.capture = self.cv2.VideoCapture(str(self.path))
        self.at = 0
        if not self.capture.isOpened():
            raise MitsonarError(f"OpenCV cannot open the video {self.path}: it is damaged, or of a codec that is not there")

    def count(self) -> int:
        """Count the frames that can be decoded; the number in the header is a guess."""
        while self.capture.grab():
            self.at += 1
            if self.at > MOST_PICTURES:
                raise MitsonarError(f"{self.path} holds more than {MOST_PICTURES:,} frames: cut it")
        count = self.at
        self._begin()
        if not count:
            raise MitsonarError(f"{self.path} holds no frame that can be decoded: it is damaged")
        return count

    def read(self, place: int) -> Grey:
        """Decode a frame by its number: ``(rows, columns)`` uint8, the luminance of colours."""
        if place < self.at:
            self._begin()
        while self.at < place:
            if not self.capture.grab():
                break
            self.at += 1
        there, picture = self.capture.read()
        self.at += 1
        if not there or picture.shape[:2] != self.shape:
            raise MitsonarError(f"frame {place:,} of {self.path} cannot be decoded: the video is damaged")
        grey: Grey = self.cv2.cvtColor(picture, self.cv2.COLOR_BGR2GRAY) if picture.ndim == 3 else picture
        return np.asarray(grey, dtype=np.uint8)
