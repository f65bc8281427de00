"""One frame at a time, with what every layout says of it: its pose, and what its regions are."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mitsonar.errors import MitsonarError
from mitsonar.exports.export_source import ExportSource
from mitsonar.exports.labelled_pictures import LabelledPictures
from mitsonar.records.frames import SonarFrames

__all__ = ["Shot", "as_json", "pose_of", "refuse_unlabelled", "refuse_unposed", "regions_of", "shots"]


@dataclass(frozen=True)
class Shot:
    """One frame that is exported: its number, its part, and where it is among those that were read."""

    number: int
    part: str
    frames: SonarFrames
    index: int

    @property
    def name(self) -> str:
        """Return the name of its files."""
        return f"{self.number:06d}"


def shots(source: ExportSource) -> Iterator[Shot]:
    """Yield the frames of a source one by one; a few are in memory."""
    for first, frames in source.pieces():
        for index in range(len(frames)):
            yield Shot(first + index, str(source.part[first + index]), frames, index)


def refuse_unlabelled(source: ExportSource) -> None:
    """Refuse frames without labels.

    Raises:
        MitsonarError: they have no ``shape_id``.
    """
    if "shape_id" not in source.labels:
        raise MitsonarError(
            f"{source.name} has no label shape_id: render with --labels, or give the recipe `labels: [shape_id, object_id]`"
        )


def refuse_unposed(source: ExportSource) -> None:
    """Refuse frames without poses.

    Raises:
        MitsonarError: they have none.
    """
    if not source.posed:
        raise MitsonarError(f"{source.name} has no poses, which this layout is made of: choose another --to")


def regions_of(shot: Shot, pictures: LabelledPictures, source: ExportSource) -> dict[str, list[object]]:
    """Return boxes, classes and names of a frame's regions as plain lists; empty where there are no labels."""
    raised_db = float(source.raised_db[shot.number])
    found = pictures.regions(shot.frames, shot.index, raised_db) if "shape_id" in source.labels else []
    return {
        "bbox": [list(region.box) for region in found],
        "category": [region.kind for region in found],
        "name": [pictures.classes[region.kind] for region in found],
        "object": [region.number for region in found],
    }


def pose_of(shot: Shot) -> dict[str, float]:
    """Return time and pose of a frame [s, m, deg]; no pose where it is not known."""
    time = float(np.mean(shot.frames.time_s[shot.index]))
    if shot.frames.poses is None:
        return {"time_s": time}
    six = shot.frames.poses[shot.index]
    angles = np.degrees(six[3:])
    place = dict(zip(("x_m", "y_m", "z_m"), map(float, six[:3]), strict=True))
    turned = dict(zip(("pitch_deg", "roll_deg", "heading_deg"), map(float, angles), strict=True))
    return {"time_s": time, **place, **turned}


def as_json(value: object) -> bytes:
    """Return a value as JSON for a file."""
    return (json.dumps(value, indent=2, allow_nan=False) + "\n").encode()
