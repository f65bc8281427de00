"""Pictures of frames, polar or fan, with the regions that their labels make: a mask, a box and a class each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.geometry.scan_conversion import nearest_cells
from mitsonar.plotting.fan_pictures import FanPictures
from mitsonar.records.sonar_frames import SonarFrames, to_uint8

__all__ = ["LabelledPictures", "PictureKind", "Region", "class_names"]

PictureKind: TypeAlias = Literal["polar", "fan"]

Mask: TypeAlias = NDArray[np.bool_]


@dataclass(frozen=True)
class Region:
    """What one object shows in a picture.

    Attributes:
        kind: number of its class: the shape's place in the scene.
        number: of the object within its shape; 0 for none.
        mask: of the picture ``(rows, columns)``.
        box: first column, first row, columns, rows [pixels].
    """

    kind: int
    number: int
    mask: Mask
    box: tuple[int, int, int, int]


class LabelledPictures:
    """Makes pictures and regions of frames of one sonar.

    Args:
        like: whose ranges and bearings the pictures have, and whose names the classes.
        picture: ``polar``, a row a range, nearest above; or ``fan``, forward up, starboard to the right.
        without: names of shapes that make no region: the ground.
        least: pixels of a region, at least.

    Attributes:
        size: columns and rows of the pictures.

    Raises:
        MitsonarError: an unknown picture or shape.
    """

    def __init__(
        self, like: SonarFrames, picture: PictureKind = "polar", without: Sequence[str] = (), least: int = 1
    ) -> None:
        if picture not in ("polar", "fan"):
            raise MitsonarError(f"--picture is polar or fan: got {picture!r}")
        names = class_names(like)
        for name in without:
            if names and name not in names.values():
                raise MitsonarError(f"no shape is named {name!r}: {nearest_names(name, names.values())}")
        self.picture_kind, self.least = picture, least
        self.without = {number for number, name in names.items() if name in without}
        self.fan = FanPictures(like) if picture == "fan" else None
        rows, columns = like.image.shape[1:] if self.fan is None else self.fan.fan.index.shape[1:]
        self.size = int(columns), int(rows)

    def picture(self, frames: SonarFrames, index: int) -> NDArray[np.uint8]:
        """Return the levels of a frame ``(rows, columns)``, 0..255."""
        image = frames.image[index]
        if self.fan is not None:
            return self.fan.picture(image)
        return image if image.dtype == np.uint8 else to_uint8(image)

    def label(self, frames: SonarFrames, name: str, index: int) -> NDArray[np.int64]:
        """Return a label of a frame in the picture ``(rows, columns)``; -1 where there is none.

        Raises:
            MitsonarError: the frames lack it.
        """
        values = getattr(frames, name)
        if values is None:
            raise MitsonarError(f"the frames have no {name}: render with --labels, or give the recipe `labels: [{name}]`")
        shown = np.asarray(values[index], dtype=np.int64)
        return shown if self.fan is None else np.asarray(nearest_cells(self.fan.fan, shown, -1), dtype=np.int64)

    def regions(self, frames: SonarFrames, index: int) -> list[Region]:
        """Return what each object of each shape shows in a frame, by shape and object.

        Raises:
            MitsonarError: the frames have no ``shape_id``.
        """
        shape = self.label(frames, "shape_id", index)
        part = self.label(frames, "object_id", index) if frames.object_id is not None else np.zeros_like(shape)
        found = []
        for kind in (int(one) for one in np.unique(shape) if one >= 0 and int(one) not in self.without):
            of_kind = shape == kind
            for number in (int(one) for one in np.unique(part[of_kind])):
                mask = of_kind & (part == number)
                if np.count_nonzero(mask) >= self.least:
                    found.append(Region(kind, max(0, number), mask, _box(mask)))
        return found


def class_names(like: SonarFrames) -> dict[int, str]:
    """Return the name of each class by its number; empty where shapes have no names, as in data sets of many scenes."""
    return {number: name or f"shape {number}" for number, name in enumerate(like.shape_names)}


def _box(mask: Mask) -> tuple[int, int, int, int]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1
