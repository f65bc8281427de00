"""Pictures in ROS bags, ``sensor_msgs/Image`` and ``CompressedImage``, as recordings by a geometry file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mitsonar.errors import MitsonarError
from mitsonar.recordings.bag_file import BagFile, Topic
from mitsonar.recordings.picture_file import Grey, refuse_size
from mitsonar.recordings.picture_recording import Pictures, geometry_for, recording_of
from mitsonar.recordings.recording import Recording
from mitsonar.recordings.ros_messages import short
from mitsonar.recordings.ros_pings import FORWARD_LEFT_UP, picture_of
from mitsonar.recordings.ros_poses import motion_in, with_motion
from mitsonar.recordings.ros_scan import TopicScan

__all__ = ["read_ros_pictures"]


def read_ros_pictures(bag: BagFile, topic: Topic, geometry: Path | None) -> Recording:
    """Open a topic of pictures; they are read on demand.

    Poses are those of the bag. The frame of the pictures counts as forward, left, up (REP 103).

    Args:
        bag: with the topic.
        topic: of type ``sensor_msgs/Image`` or ``sensor_msgs/CompressedImage``.
        geometry: a geometry file; default: ``FILE.yaml`` or ``geometry.yaml`` beside the bag.

    Raises:
        MitsonarError: no geometry, no picture that can be read, or a geometry that does not fit the pictures.
    """
    told, told_by = geometry_for(bag.path, geometry)
    scan = TopicScan(bag, topic)
    scan.read()
    if not scan.received:
        raise MitsonarError(f"{bag.path}: no message of {topic.name} can be read: {scan.reason or 'there is none'}")

    def read(place: int) -> Grey:
        (found,) = (message for _, message in scan.frames(np.array([place])))
        try:
            picture = picture_of(found)
        except ValueError as error:
            raise MitsonarError(f"{bag.path}: message {place:,} of {topic.name}: {error}") from None
        if picture.shape != shape:
            raise MitsonarError(
                f"{bag.path}: message {place:,} of {topic.name} has {picture.shape[1]:,} x {picture.shape[0]:,} pixels, the "
                f"first one {shape[1]:,} x {shape[0]:,}: cut the bag where they change"
            )
        return picture

    (_, message) = next(scan.frames(np.array([0])))
    try:
        rows, columns = picture_of(message).shape
    except ValueError as error:
        raise MitsonarError(f"{bag.path}: the first message of {topic.name}: {error}") from None
    refuse_size(rows, columns, f"a message of {topic.name}")
    shape = (rows, columns)
    pictures = Pictures(
        bag.path,
        f"ROS {1 if bag.is_ros1 else 2} bag, {short(topic.kind)}",
        shape,
        tuple(str(place) for place in range(len(scan.received))),
        read,
        scan.frame_times(),
        facts={"topic": topic.name, "type": short(topic.kind), "frame_id": str(message.header.frame_id)},
        notes=tuple(scan.notes()),
    )
    return _with_poses(recording_of(pictures, told, told_by), bag, str(message.header.frame_id))


def _with_poses(recording: Recording, bag: BagFile, frame_id: str) -> Recording:
    """Return the recording with what other topics of the bag tell of the sonar."""
    part = recording.parts[0]
    motion = motion_in(bag, frame_id, FORWARD_LEFT_UP, part.time_s)
    part = with_motion(part, motion, np.arange(len(part)))
    facts = recording.facts | ({"poses": motion.origin} if motion.origin else {})
    return replace(recording, parts=(part,), facts=facts, notes=(*recording.notes, *motion.notes))
