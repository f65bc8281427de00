"""Pictures of frames, polar or fan, with the regions that their labels make: a mask, a box and a class each."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.water import noise_of
from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.geometry.fan import nearest_cells
from mitsonar.plotting.fans import FanPictures
from mitsonar.records.frames import SonarFrames, to_uint8

__all__ = ["LEAST_SNR_DB", "LabelledPictures", "PictureKind", "Region", "class_rules"]

PictureKind: TypeAlias = Literal["polar", "fan"]

Mask: TypeAlias = NDArray[np.bool_]

LEAST_SNR_DB = 3.0
"""Signal-to-noise ratio of an object that is marked, at least [dB]."""

NUMBER = re.compile(r"[\s_.-]*\d+$")
"""The number at the end of a shape's name, with what separates it."""


@dataclass(frozen=True)
class Region:
    """What one object shows in a picture.

    Attributes:
        kind: number of its class, from 0; see :attr:`LabelledPictures.classes`.
        shape: its shape's place in the scene.
        number: of the object within its shape; 0 for none.
        mask: of the picture ``(rows, columns)``.
        box: first column, first row, columns, rows [pixels].
    """

    kind: int
    shape: int
    number: int
    mask: Mask
    box: tuple[int, int, int, int]


class LabelledPictures:
    """Makes pictures and regions of frames of one sonar.

    Args:
        like: whose ranges and bearings the pictures have, and whose shapes the classes are of.
        picture: ``polar``, a row a range, nearest above; or ``fan``, forward up, starboard to the right.
        classes: names of shapes, as globs, and the class of each; an empty class leaves a shape out. The first glob that
            matches counts. Shapes that none matches have their own names as classes; those whose names differ only by a
            number at the end share one.
        least: pixels of a region, at least.
        least_snr_db: signal-to-noise ratio of a region, at least [dB]; see :meth:`snr_db`. ``-inf`` keeps all.

    Attributes:
        size: columns and rows of the pictures.
        classes: their names, by number; of shapes without names those that were seen.
        left_out: names of shapes without a class.
        boxes: number of regions that were counted, by part and class.
        faint: number of regions that were left out since their ratio is too low.
        small: number of those that have too few pixels.

    Raises:
        MitsonarError: an unknown picture, a glob that matches no shape, no class that is left.
    """

    def __init__(
        self,
        like: SonarFrames,
        picture: PictureKind = "polar",
        classes: Sequence[tuple[str, str]] = (),
        least: int = 1,
        least_snr_db: float = LEAST_SNR_DB,
    ) -> None:
        if picture not in ("polar", "fan"):
            raise MitsonarError(f"--picture is polar or fan: got {picture!r}")
        self.picture_kind, self.least, self.least_snr_db = picture, least, least_snr_db
        self._rules = tuple(classes)
        names = like.shape_names
        for glob, _ in classes if names else ():
            if not any(fnmatchcase(name, glob) for name in names):
                raise MitsonarError(f"no shape is named {glob!r}: {nearest_names(glob, names)}")
        class_of = self._class_names(names)
        self.classes = list(dict.fromkeys(name for name in class_of if name))
        self.left_out = [shape for shape, name in zip(names, class_of, strict=True) if not name]
        if names and not self.classes:
            raise MitsonarError(f"no class is left of the shapes {', '.join(names[:6])}: leave fewer of them out")
        self._kinds = {place: self.classes.index(name) if name else None for place, name in enumerate(class_of)}
        self.fan = FanPictures(like) if picture == "fan" else None
        rows, columns = like.image.shape[1:] if self.fan is None else self.fan.fan.index.shape[1:]
        self.size = int(columns), int(rows)
        self.boxes: Counter[tuple[str, str]] = Counter()
        self.faint = self.small = 0

    def _class_names(self, names: Sequence[str]) -> list[str]:
        """Return the class of each shape; it is empty for one that is left out."""
        stems = [NUMBER.sub("", name) or name for name in names]
        shared = Counter(stems)
        own = [stem if shared[stem] > 1 else name for name, stem in zip(names, stems, strict=True)]
        return [
            next((kind for glob, kind in self._rules if fnmatchcase(name, glob)), mine)
            for name, mine in zip(names, own, strict=True)
        ]

    def _kind_of(self, shape: int) -> int | None:
        """Return the number of a shape's class; None where it is left out. Classes of shapes without names are added."""
        if shape not in self._kinds:
            name = f"shape {shape}"
            kind = next((kind for glob, kind in self._rules if fnmatchcase(name, glob)), name)
            if kind and kind not in self.classes:
                self.classes.append(kind)
            self._kinds[shape] = self.classes.index(kind) if kind else None
        return self._kinds[shape]

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
        shown = _label(frames, name, index)
        return shown if self.fan is None else np.asarray(nearest_cells(self.fan.fan, shown, -1), dtype=np.int64)

    def regions(self, frames: SonarFrames, index: int, raised_db: float = 0.0) -> list[Region]:
        """Return what each object of each shape shows in a frame, by shape and object.

        Args:
            frames: with ``shape_id``.
            index: of the frame.
            raised_db: by which its noise is above that of the sonar [dB].

        Raises:
            MitsonarError: the frames have no ``shape_id``.
        """
        shape = self.label(frames, "shape_id", index)
        part = self.label(frames, "object_id", index) if frames.object_id is not None else np.zeros_like(shape)
        snr = self.snr_db(frames, index, raised_db) if self.least_snr_db > -np.inf else {}
        found = []
        for place in (int(one) for one in np.unique(shape) if one >= 0):
            kind = self._kind_of(place)
            if kind is None:
                continue
            of_kind = shape == place
            for number in (int(one) for one in np.unique(part[of_kind])):
                mask = of_kind & (part == number)
                if snr.get((place, number), np.inf) < self.least_snr_db:
                    self.faint += 1
                elif np.count_nonzero(mask) < self.least:
                    self.small += 1
                else:
                    found.append(Region(kind, place, max(0, number), mask, _box(mask)))
        return found

    def snr_db(self, frames: SonarFrames, index: int, raised_db: float = 0.0) -> dict[tuple[int, int], float]:
        """Compute the signal-to-noise ratio of each object in a frame, by shape and object [dB].

        The signal is the mean level of the object's cells less the mean level of noise alone there. Noise is known of
        frames of the model ``coherent``: that of the sonar, after the gain. In other frames it is the mean of the cells
        without an echo; where these are dark the ratio is infinite. Of images of contrast nothing is known: the answer is
        empty.
        """
        if frames.level == "contrast":
            return {}
        level = frames.select(slice(index, index + 1)).linear_values()[0].astype(float)
        shape = _label(frames, "shape_id", index)
        part = _label(frames, "object_id", index) if frames.object_id is not None else np.zeros_like(shape)
        echo = shape >= 0
        noise = _noise_levels(frames, raised_db)
        if noise is None:
            dark = level[~echo]
            noise = np.full(len(level), float(dark.mean()) if dark.size else 0.0)
        pairs, place = np.unique(np.stack([shape[echo], part[echo]], axis=-1), axis=0, return_inverse=True)
        place = place.ravel()
        alone = np.bincount(place, np.broadcast_to(noise[:, None], level.shape)[echo])
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(alone > 0, np.maximum(0.0, np.bincount(place, level[echo]) - alone) / alone, np.inf)
            decibels = 10 * np.log10(ratio)
        return {(int(kind), int(number)): float(one) for (kind, number), one in zip(pairs, decibels, strict=True)}

    def count(self, part: str, regions: Sequence[Region]) -> None:
        """Add regions that were written to :attr:`boxes`."""
        self.boxes.update((part, self.classes[region.kind]) for region in regions)

    def refuse_none(self, frames: int) -> None:
        """Refuse frames of which no region was counted.

        Raises:
            MitsonarError: there is none.
        """
        if not self.boxes:
            raise MitsonarError(
                f"no object is seen in any of {frames:,} frames ({self.faint:,} are below --least-snr-db "
                f"{self.least_snr_db:g}, {self.small:,} have fewer pixels than --least {self.least}): move the sonar nearer "
                "to the objects, or lower these"
            )


def class_rules(text: str) -> list[tuple[str, str]]:
    """Parse classes as a command takes them: ``pillar*=pillar,seabed*=``.

    Raises:
        MitsonarError: a part is not GLOB=CLASS.
    """
    rules = []
    for one in filter(None, (part.strip() for part in text.split(","))):
        glob, equals, kind = (word.strip() for word in one.partition("="))
        if not glob or not equals:
            raise MitsonarError(
                f"--classes is GLOB=CLASS, with commas between, an empty class leaves shapes out: got {one!r}"
            )
        rules.append((glob, kind))
    return rules


def _label(frames: SonarFrames, name: str, index: int) -> NDArray[np.int64]:
    """Return a label of a frame ``(bins, beams)``.

    Raises:
        MitsonarError: the frames lack it.
    """
    values = getattr(frames, name)
    if values is None:
        raise MitsonarError(f"the frames have no {name}: render with --labels, or give the recipe `labels: [{name}]`")
    return np.asarray(values[index], dtype=np.int64)


def _noise_levels(frames: SonarFrames, raised_db: float) -> NDArray[np.float64] | None:
    """Return the mean level of the receiver's noise in each bin, relative to full scale ``(bins,)``; None if unknown."""
    if frames.sonar.model != "coherent":
        return None
    return noise_of(frames.sonar) * 10 ** (raised_db / 10) / frames.level_scale


def _box(mask: Mask) -> tuple[int, int, int, int]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1
