"""ROS bags: topics and raw messages of ROS 1 bags, ROS 2 bags and MCAP files, read on demand (by ``rosbags``)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from mitsonar.errors import MitsonarError, explain_missing
from mitsonar.recordings.ros_messages import ros1_types, ros2_types

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

__all__ = ["BagFile", "Message", "Topic", "is_ros_bag"]

Message: TypeAlias = Any
"""A decoded message; its definition, which stands in the bag, says which fields it has."""

ROS1 = b"#ROSBAG V"
MCAP = b"\x89MCAP0\r\n"
SQLITE = b"SQLite format 3\x00"

ENDS = {ROS1: ".bag", MCAP: ".mcap", SQLITE: ".db3"}
"""First bytes of bags of one file, and how their names end."""


REPAIRS = {".bag": "rosbag reindex", ".mcap": "mcap recover"}
"""What makes a bag whole that a recorder has not closed, by the end of its name."""


class Topic(NamedTuple):
    """A topic: its name, its type (``sensor_msgs/msg/Image``) and its number of messages."""

    name: str
    kind: str
    messages: int


def is_ros_bag(path: Path, first: bytes) -> bool:
    """Return whether a file with these first bytes, or a folder, is a ROS bag."""
    if not first and path.is_dir():
        return _is_ros2_folder(path)
    return first.startswith((ROS1, MCAP)) or (first.startswith(SQLITE) and path.suffix == ".db3")


def _is_ros2_folder(path: Path) -> bool:
    try:
        with (path / "metadata.yaml").open("rb") as file:
            return b"rosbag2_bagfile_information" in file.read(4096)
    except OSError:
        return False


class BagFile:
    """A bag. It is opened when it is first read, also in another process that it is sent to.

    Raises:
        MitsonarError: it is damaged, or its name does not end as its format demands.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._reader: AnyReader | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the path only: an open file stays in its process."""
        return {"path": self.path, "_reader": None}

    @property
    def is_ros1(self) -> bool:
        """Return whether it is a bag of ROS 1."""
        return self.path.suffix == ".bag"

    def topics(self) -> list[Topic]:
        """Return all topics."""
        with self._readable():
            found = self._open().topics
            return [Topic(name, one.msgtype or "several types", one.msgcount) for name, one in sorted(found.items())]

    def messages(self, topic: str, start: int | None = None, stop: int | None = None) -> Iterator[tuple[int, bytes]]:
        """Read the raw messages of a topic in the order in which they were received.

        Args:
            topic: its name.
            start: time of reception from which they are read [ns].
            stop: time of reception before which they are read [ns].

        Yields:
            Time of reception [ns] and bytes of each message.
        """
        with self._readable():
            reader = self._open()
            for _, time, raw in reader.messages(self._connections(topic), start=start, stop=stop):
                yield time, bytes(raw)

    def decode(self, raw: bytes, kind: str) -> Message:
        """Decode a message of a type."""
        with self._readable():
            return self._open().deserialize(raw, kind)

    def _connections(self, topic: str) -> list[Connection]:
        return [one for one in self._open().connections if one.topic == topic]

    def _open(self) -> AnyReader:
        if self._reader is not None:
            return self._reader
        try:
            from rosbags.highlevel import AnyReader
        except ModuleNotFoundError as error:
            raise explain_missing(error) from None
        self._check_name()
        reader = AnyReader([self.path], default_typestore=ros1_types() if self.is_ros1 else ros2_types())
        reader.open()
        self._reader = reader
        return reader

    def _check_name(self) -> None:
        """Check that the name ends as the content demands: ``rosbags`` tells formats by the name."""
        if self.path.is_dir():
            return
        with self.path.open("rb") as file:
            first = file.read(len(SQLITE))
        for begin, end in ENDS.items():
            if first.startswith(begin) and self.path.suffix != end:
                raise MitsonarError(f"{self.path} is a bag whose name must end with {end}: rename it")

    @contextmanager
    def _readable(self) -> Iterator[None]:
        """Turn whatever a damaged bag leads to into one sentence."""
        try:
            yield
        except (MitsonarError, GeneratorExit):
            raise
        except Exception as error:  # a damaged bag raises errors of many kinds
            reason = " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__
            repair = REPAIRS.get(self.path.suffix)
            raise MitsonarError(
                f"cannot read the bag {self.path}: {reason}; the file is cut off, damaged or of another kind"
                + (f": `{repair}` may repair it" if repair else "")
            ) from None
