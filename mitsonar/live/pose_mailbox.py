"""The place where poses arrive and the loop takes the newest: older ones that no ping took are dropped."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

from mitsonar.live.pose_messages import AskedPose

__all__ = ["Delivered", "PoseMailbox"]


@dataclass(frozen=True)
class Delivered:
    """A pose and when it came.

    Attributes:
        asked: what a client asked for.
        came_ns: wall clock at its arrival [ns].
        dropped: poses that came before it and that no ping took.
    """

    asked: AskedPose
    came_ns: int
    dropped: int


class PoseMailbox:
    """Holds the newest pose. Threads of a server put, the loop takes."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: Delivered | None = None

    def put(self, asked: AskedPose) -> None:
        """Deliver a pose in place of the one that waits."""
        with self._changed:
            waiting = self._newest
            dropped = 0 if waiting is None else waiting.dropped + 1
            self._newest = Delivered(asked, time.time_ns(), dropped)
            self._changed.notify_all()

    def take(self, wait_s: float) -> Delivered | None:
        """Return the newest pose and empty the box; wait for one at most that long [s]. None: none came."""
        with self._changed:
            if self._newest is None and wait_s > 0:
                self._changed.wait(wait_s)
            taken, self._newest = self._newest, None
            return taken
