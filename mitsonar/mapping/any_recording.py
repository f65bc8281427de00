"""Frames of any origin as a recording: files of real sonars, runs and data sets; with poses and labels."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError
from mitsonar.mapping.open_frames import is_data_set, is_recording, open_frames
from mitsonar.recordings.open import open_recording
from mitsonar.recordings.recording import Part, Recording
from mitsonar.records.frames import COLUMNS, LABELS, SonarFrames, open_group

__all__ = ["LabelledPart", "recording_at"]

Index = NDArray[np.intp]

Labels: TypeAlias = dict[str, Any]
"""Arrays of per-pixel truth by the names of :data:`~mitsonar.records.frames.LABELS`."""


@dataclass(frozen=True)
class LabelledPart(Part):
    """A part with per-pixel truth.

    Attributes:
        labels: reads the labels of frames of given numbers ``(n,)`` by name: ``(n, bins, beams)``.
    """

    labels: Callable[[Index], Labels] = lambda index: {}

    def read(self, index: ArrayLike) -> SonarFrames:
        """Read frames of these numbers ``(n,)``, with labels.

        Raises:
            MitsonarError: frames that are not there, or that cannot be read.
        """
        return replace(super().read(index), **self.labels(np.asarray(index, dtype=np.intp)))

    def _read_within(self, rows: slice, columns: slice) -> dict[str, Any]:
        """Return the fields that read pixels and their labels, of these bins and beams."""

        def labels(index: Index) -> Labels:
            return {name: values[:, rows, columns] for name, values in self.labels(index).items()}

        return {**super()._read_within(rows, columns), "labels": labels}


def recording_at(
    where: str | Path, *, sequence: int | None = None, view: str | None = None, geometry: str | Path | None = None
) -> Recording:
    """Open frames at a path or URL as a recording.

    Args:
        where: a recording of a real sonar, ``frames.npz``, ``frames.zarr``, the folder of a run, or a data set.
        sequence: of a data set.
        view: of a data set, or topic of a ROS bag.
        geometry: file that tells how pictures are laid out.

    Raises:
        MitsonarError: no frames there, or choices that do not fit them.
    """
    data_set = is_data_set(where)
    if not data_set and is_recording(where):
        return open_recording(where, geometry, view)
    source = open_frames(where, sequence=sequence if data_set else None, view=view, geometry=geometry)
    labels = None if data_set else _labels_at(Path(where))
    part = LabelledPart(
        like=source.like,
        time_s=source.time_s,
        images=source.images,
        poses=source.poses,
        attitude_rad=source.attitude_rad,
        height_m=source.height_m,
        labels=(lambda index: {}) if labels is None else labels,
    )
    words = "data set of mitsonar" if data_set else "run of mitsonar"
    return Recording(str(where), words, (part,), {}, (source.note,) if source.note else ())


def _labels_at(path: Path) -> Callable[[Index], Labels] | None:
    """Return what reads the labels of a run; None where it has none."""
    if os.path.isdir(path) and path.suffix != ".zarr":
        path = next(one for one in (path / "frames.npz", path / "frames.zarr") if os.path.exists(one))
    if os.path.isfile(path):
        frames = SonarFrames.load(path)
        kept = {name: getattr(frames, name) for name in LABELS if getattr(frames, name) is not None}
        return (lambda index: {name: values[index] for name, values in kept.items()}) if kept else None
    try:
        arrays = {name: one for name, one in open_group(path, COLUMNS, "time_s", "frames_done")[0].items() if name in LABELS}
    except Exception as error:  # a damaged Zarr raises errors of many kinds
        raise MitsonarError(f"cannot read the labels of {path}: {' '.join(str(error).split())[:160]}") from None

    def stored(index: Index) -> Labels:
        return {
            name: np.stack([np.asarray(one[int(number)]) for number in index]) if len(index) else np.asarray(one[:0])
            for name, one in arrays.items()
        }

    return stored if arrays else None
