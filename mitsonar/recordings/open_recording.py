"""Any recording, by its content: a file's first bytes or a folder's files tell the format."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from mitsonar.errors import MitsonarError
from mitsonar.recordings.aris import SIGNATURE, read_aris
from mitsonar.recordings.bag_file import is_ros_bag
from mitsonar.recordings.canoe import is_canoe, read_canoe
from mitsonar.recordings.didson import SIGNATURES, read_didson
from mitsonar.recordings.neusis import is_neusis, read_neusis
from mitsonar.recordings.oculus import read_oculus
from mitsonar.recordings.oculus_messages import is_oculus
from mitsonar.recordings.picture_folder import holds_pictures, read_picture_folder
from mitsonar.recordings.picture_stack import is_picture_stack, read_picture_stack
from mitsonar.recordings.picture_video import is_video, read_picture_video
from mitsonar.recordings.recording import Recording
from mitsonar.recordings.ros_bag import read_ros_bag
from mitsonar.recordings.uxo import is_uxo, read_uxo

__all__ = ["FORMATS", "Format", "format_of", "known_formats", "open_recording"]

FIRST_BYTES = 16
"""Bytes by which formats are told from each other."""


class Format(NamedTuple):
    """A format: in words, whether a path with these first bytes (empty for a folder) has it, and what reads it.

    What reads it is given the path, a geometry file or None, and the topic of the sonar or None.
    """

    words: str
    fits: Callable[[Path, bytes], bool]
    read: Callable[[Path, Path | None, str | None], Recording]


def _of_pictures(read: Callable[[Path, Path | None], Recording]) -> Callable[[Path, Path | None, str | None], Recording]:
    """Return a reader of a format whose files hold one sonar, which refuses a topic."""

    def checked(path: Path, geometry: Path | None, topic: str | None) -> Recording:
        if topic is not None:
            raise MitsonarError(f"{path} is a recording of one sonar, and has no topics or views: leave {topic!r} out")
        return read(path, geometry)

    return checked


def _says_it_itself(read: Callable[[Path], Recording]) -> Callable[[Path, Path | None, str | None], Recording]:
    """Return a reader of a format whose files hold one sonar and tell their geometry, which refuses another one."""

    def checked(path: Path, geometry: Path | None) -> Recording:
        if geometry is not None:
            raise MitsonarError(f"{path} tells its geometry itself: leave {geometry} out")
        return read(path)

    return _of_pictures(checked)


FORMATS: tuple[Format, ...] = (
    Format("ARIS (.aris)", lambda path, first: first.startswith(SIGNATURE), _says_it_itself(read_aris)),
    Format("DIDSON (.ddf)", lambda path, first: first[:4] in SIGNATURES, _says_it_itself(read_didson)),
    Format("Oculus (.raw, .oculus)", is_oculus, _says_it_itself(read_oculus)),
    Format("ROS bags (.bag, .mcap, .db3, folders)", is_ros_bag, read_ros_bag),
    Format("folders of UXO (DFKI)", is_uxo, _says_it_itself(read_uxo)),
    Format("folders of CANOE", is_canoe, _says_it_itself(read_canoe)),
    Format("folders of views (neusis)", is_neusis, _says_it_itself(read_neusis)),
    Format("stacks of pictures (.npz)", is_picture_stack, _of_pictures(read_picture_stack)),
    Format("videos (.avi, .mp4)", is_video, _of_pictures(read_picture_video)),
    Format("folders of pictures (PNG, JPEG, PGM)", holds_pictures, _of_pictures(read_picture_folder)),
)
"""All formats, in the order in which they are tried."""


def format_of(path: str | Path) -> Format | None:
    """Return the format of a file or folder; None where it is no recording, or is not there."""
    path = Path(path)
    first = b""
    if os.path.isfile(path):
        try:
            with path.open("rb") as file:
                first = file.read(FIRST_BYTES)
        except OSError:
            return None
    elif not os.path.isdir(path):
        return None
    return next((one for one in FORMATS if one.fits(path, first)), None)


def known_formats() -> str:
    """Return all formats in words, for messages."""
    return ", ".join(one.words for one in FORMATS)


def open_recording(path: str | Path, geometry: str | Path | None = None, topic: str | None = None) -> Recording:
    """Open a recording of a real sonar; pixels are read on demand.

    Args:
        path: of a file or folder; its content tells the format (docs/guides/recordings.md).
        geometry: a geometry file, for pictures. Other formats tell their geometry themselves.
        topic: of the sonar in a ROS bag; default: the only one.

    Raises:
        MitsonarError: nothing there, no known format, damaged, no such topic, or a geometry that is not needed.
    """
    found = format_of(path)
    if found is None:
        if not os.path.exists(path):
            raise MitsonarError(f"no such file: {path}")
        raise MitsonarError(f"{path} is no recording that mitsonar reads: it reads {known_formats()}")
    return found.read(Path(path), None if geometry is None else Path(geometry), topic)
