"""The loop of a live sonar: the newest pose becomes a ping, and the ping is published. A path is played where none comes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from threading import Event
from typing import Protocol

from numpy.typing import ArrayLike

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.errors import MitsonarError
from mitsonar.io.files import PlainValue
from mitsonar.live.pose_mailbox import Delivered, PoseMailbox
from mitsonar.live.pose_messages import AskedPose
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames

__all__ = ["LivePing", "LivePublisher", "Pinger", "live_pings"]

LOOK_S = 0.25
"""How long the loop waits for a pose before it looks again whether it shall end [s]."""


@dataclass(frozen=True)
class LivePing:
    """One ping of a live sonar.

    Attributes:
        frames: one frame, with its pose.
        number: of the ping since the start.
        time_ns: wall clock when the pose came, or when the path's turn came [ns].
        source: ``client``, or ``path`` that is played.
        mark: what the client's pose had in ``id``.
        dropped: poses that came since the ping before and that no ping took.
        render_s: time for the frame [s].
    """

    frames: SonarFrames
    number: int
    time_ns: int
    source: str
    mark: PlainValue
    dropped: int
    render_s: float


class LivePublisher(Protocol):
    """Takes pings to those who listen: a Foxglove server, or a ROS 2 node."""

    def publish(self, ping: LivePing) -> None:
        """Publish a ping to all who listen."""

    def complain(self, sentence: str) -> None:
        """Tell all who listen what was refused."""

    def close(self) -> None:
        """End all connections."""


class Pinger(Protocol):
    """What the loop needs of a simulator."""

    def step(self, pose: ArrayLike, *, noise: NoiseModel | None = None, seed: int = 0) -> SonarFrames:
        """Render the next ping."""


def live_pings(
    simulator: Pinger,
    mailbox: PoseMailbox,
    publisher: LivePublisher,
    path: Trajectory,
    *,
    rate_hz: float,
    noise: NoiseModel | None = None,
    seed: int = 0,
    quiet_s: float = 2.0,
    ends: Event | None = None,
) -> Iterator[LivePing]:
    """Ping until told to end, and publish each ping; yield it afterwards.

    A client's pose is rendered at once. The path is played in a circle until the first pose comes, and goes on when none
    came for a while. A path of a single pose is one ping.

    Args:
        simulator: of the scene and the sonar.
        mailbox: where poses arrive.
        publisher: of the pings.
        path: is played where no pose comes.
        rate_hz: pings a second of the path [Hz].
        noise: drawn from (seed, number of the ping, cell); default none.
        seed: of the noise.
        quiet_s: time without a pose after which the path goes on [s].
        ends: ends the loop between two pings, once it is set; an exception within a ping would leave the renderer broken.

    Raises:
        MitsonarError: a rate or a time that is not positive.
    """
    if not (rate_hz > 0 and quiet_s > 0):
        raise MitsonarError(f"rate_hz and quiet_s must be positive: got {rate_hz:g}, {quiet_s:g}")
    ends = Event() if ends is None else ends
    numbers, next_in_path, heard, due = count(), 0, -float("inf"), time.monotonic()
    while not ends.is_set():
        now = time.monotonic()
        playing = now - heard > quiet_s and (len(path) > 1 or next_in_path == 0)
        delivered, source = mailbox.take(min(LOOK_S, max(0.0, due - now)) if playing else LOOK_S), "client"
        if delivered is not None:
            heard = time.monotonic()
        elif playing and time.monotonic() >= due:
            delivered, source = _played(path, next_in_path), "path"
            next_in_path += 1
            due = max(due, time.monotonic() - 1 / rate_hz) + 1 / rate_hz
        else:
            continue
        begun = time.perf_counter()
        try:
            frames = simulator.step(delivered.asked.pose, noise=noise, seed=seed)
        except MitsonarError as error:
            publisher.complain(f"this pose cannot be rendered: {error}")
            continue
        ping = _ping(frames, next(numbers), delivered, source, time.perf_counter() - begun)
        publisher.publish(ping)
        yield ping


def _ping(frames: SonarFrames, number: int, delivered: Delivered, source: str, render_s: float) -> LivePing:
    """Return a ping with what is known of its pose."""
    return LivePing(frames, number, delivered.came_ns, source, delivered.asked.mark, delivered.dropped, render_s)


def _played(path: Trajectory, number: int) -> Delivered:
    """Return the pose of a path that is played in a circle."""
    pose = path.poses[number % len(path)]
    return Delivered(AskedPose(Pose.from_row(float(value) for value in pose)), time.time_ns(), 0)
