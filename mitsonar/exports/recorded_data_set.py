"""A data set of frames that were not rendered for it: of runs, and of recordings of real sonars, with known poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.config.data import Recipe, recipe_from
from mitsonar.datasets.modality import Values
from mitsonar.datasets.plan import Plan, Scene
from mitsonar.datasets.store import PACKAGES, DataStore
from mitsonar.errors import MitsonarError, counted
from mitsonar.exports.export_folder import new_folder
from mitsonar.exports.recorded_frames import FramesWithPoses, Stretch, as_pixels
from mitsonar.io.runs import versions
from mitsonar.io.storage import Storage
from mitsonar.motion.composition import motions
from mitsonar.motion.trajectory import Trajectory, velocities

__all__ = ["RecordedDataSet", "recorded_recipe", "write_recorded"]

Array = NDArray[np.float64]

OTHER_GAIN = 0.01
"""Difference of the level scales of two files, as part of them, that the user is told of."""


@dataclass(frozen=True)
class RecordedDataSet:
    """What was written.

    Attributes:
        path: of the data set.
        frames: of it.
        sequences: of it.
        notes: a sentence each.
    """

    path: Path
    frames: int
    sequences: int
    notes: list[str]


def write_recorded(
    sources: Sequence[FramesWithPoses],
    out: str | Path,
    *,
    begun: Callable[[int, int], None] = lambda frames, done: None,
    progress: Callable[[int], None] = lambda frames: None,
) -> RecordedDataSet:
    """Write frames with their poses as a data set, whole or absent; a shard at a time is in memory.

    Each source is a scene, each stretch of it a sequence. Pixels, levels and bearings stay as they are.

    Args:
        sources: files and runs of one sonar.
        out: folder to make.
        begun: called with the number of frames of the data set, and 0.
        progress: called with the number of frames that were added.

    Raises:
        MitsonarError: something is there, no sources, sonars that differ, no heights, frames that cannot be read.
    """
    if "://" in str(out):
        raise MitsonarError(f"-o must name a folder here: got {out}; copy the finished data set to its storage")
    path = Path(out)
    recipe = recorded_recipe(sources, path.stem)
    plan = _plan(sources)
    stretches = [stretch for source in sources for stretch in source.stretches]
    scale = sources[0].level_scale
    about = {"gain": 1 / scale, "level_scale": scale, "variant": "none", "versions": versions(PACKAGES)}
    begun(len(plan), 0)
    with new_folder(path) as folder:
        store = DataStore.create(Storage(folder), recipe, plan, about)
        for shard in range(store.shards):
            here = store.frames_of(shard)
            store.write_shard(shard, _values(store, stretches, here))
            progress(here.stop - here.start)
        store.finish()
    return RecordedDataSet(path, len(plan), len(stretches), _notes(sources, len(stretches)))


def recorded_recipe(sources: Sequence[FramesWithPoses], name: str) -> Recipe:
    """Return the recipe of a data set of these frames.

    Raises:
        MitsonarError: no sources, sonars that differ, a name that occurs twice, no heights.
    """
    if not sources:
        raise MitsonarError("a data set needs frames: give a run or a recording, or more")
    first = sources[0]
    for one in sources[1:]:
        other = one.axes.other(first.axes)
        if other:
            raise MitsonarError(
                f"{one.name} is of another sonar than {first.name}: {'; '.join(other[:6])}; make a data set of each"
            )
    names = [one.name for one in sources]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise MitsonarError(f"{twice[0]} is given twice: its frames would be in training and in validation")
    stretches = [stretch for source in sources for stretch in source.stretches]
    poses = np.concatenate([one.poses for one in stretches])
    moved = np.abs(np.concatenate([motions(one.poses) for one in stretches])).max(axis=0)
    low, high = _heights(stretches)
    pitch, roll = (float(np.round(np.degrees(np.median(poses[:, axis])), 2)) for axis in (3, 4))
    floats = any(one.part.like.image.dtype != np.uint8 for one in stretches)
    several = {"by": "scene", "train": 0.8, "validation": 0.2, "test": 0.0}
    bearings = first.axes.bearing_rad
    return recipe_from(
        {
            "name": name,
            "about": f"frames of {len(sources)} runs or recordings, with known poses",
            "scenes": [{"sequences": len(one.stretches)} for one in sources],
            "sonar": first.axes.sonar.model_dump(mode="json"),
            "mount": {"pitch_deg": pitch, "roll_deg": roll},
            "flight": {
                "kind": "recorded",
                "height_m": [low, high],
                "sideways_mm": 1e3 * float(moved[0]),
                "forward_mm": 1e3 * float(moved[1]),
                "yaw_deg": float(np.degrees(moved[2])),
                "jump_m": None,
            },
            "pixel": "float32" if floats else "uint8",
            **({"split": several} if len(sources) > 1 else {}),
            "recorded": {
                "level": first.axes.level,
                "bearings": None if bearings is None else bearings.tolist(),
                "sources": [_source(one) for one in sources],
            },
        }
    )


def _source(one: FramesWithPoses) -> dict[str, str | int | float]:
    """Return the keys of a source in the recipe."""
    return {
        "name": one.name,
        "format": one.format,
        "poses": one.poses,
        "frames": len(one),
        "left_out": one.left_out,
        "level_scale": one.level_scale,
        "start_s": float(one.stretches[0].time_s[0]),
    }


def _heights(stretches: Sequence[Stretch]) -> tuple[float, float]:
    """Return the lowest and highest height over the ground [m]; over z = 0 where no frame tells one.

    Raises:
        MitsonarError: no frame tells a height, and z = 0 is not below all of them.
    """
    told = np.concatenate([one.height_m for one in stretches])
    told = told[np.isfinite(told) & (told > 0)]
    if not told.size:
        told = np.concatenate([one.poses[:, 2] for one in stretches])
    if told.min() <= 0:
        raise MitsonarError("no frame tells its height over the ground, and their poses are below z = 0: give --height")
    return float(told.min()), float(told.max())


def _plan(sources: Sequence[FramesWithPoses]) -> Plan:
    """Return the poses of all frames, in the order in which they are stored."""
    stretches = [stretch for source in sources for stretch in source.stretches]
    counts = [len(one) for one in stretches]
    scene = [number for number, source in enumerate(sources) for _ in source.stretches]
    poses = np.concatenate([one.poses for one in stretches])
    nan = np.full((1, 3), np.nan)
    return Plan(
        scenes=[Scene(number, number, 0, len(source.stretches)) for number, source in enumerate(sources)],
        scene=np.repeat(scene, counts).astype(np.int32),
        sequence=np.repeat(np.arange(len(counts)), counts).astype(np.int32),
        time_s=np.concatenate([one.time_s - one.time_s[0] for one in stretches]),
        vehicle=poses * [1, 1, 1, 0, 0, 1],
        poses=poses,
        motion=np.concatenate([part for one in stretches for part in (motions(one.poses), nan)]),
        velocity=np.concatenate([velocities(Trajectory(one.poses, one.time_s)) for one in stretches]),
    )


def _values(store: DataStore, stretches: Sequence[Stretch], here: slice) -> dict[str, Values]:
    """Read the frames of a shard. Return what is stored of them, by name."""
    images, heights, first = [], [], 0
    for one in stretches:
        part = slice(max(here.start - first, 0), min(here.stop - first, len(one)))
        if part.start < part.stop:
            frames = one.read(part)
            images.append(as_pixels(frames.image, store.recipe.pixel, f"frame {first + part.start} and those after it"))
            heights.append(one.height_m[part])
        first += len(one)
    image = np.concatenate(images)
    full = 255 if store.recipe.pixel == "uint8" else 1
    return {
        "image": image,
        "height_m": np.concatenate(heights),
        "dropped": np.zeros(len(image), dtype=np.uint32),
        "saturated": (image == full).sum(axis=(1, 2), dtype=np.uint32),
    }


def _notes(sources: Sequence[FramesWithPoses], sequences: int) -> list[str]:
    """Return what the user should know, a sentence each."""
    notes = [f"{one.name}: {note}" for one in sources for note in one.notes]
    notes += [
        f"{one.name}: left out: {counted(one.left_out, 'frame')} without a pose, of another geometry, or with no neighbour"
        for one in sources
        if one.left_out
    ]
    scales = np.array([one.level_scale for one in sources])
    if np.ptp(scales) > OTHER_GAIN * scales.max():
        notes.append(
            f"the gains of the files differ (levels of a pixel of 1 from {scales.min():.3g} to {scales.max():.3g}): pixels "
            "stay as they are, and levels can be compared within a file only"
        )
    if not all(np.isfinite(one.height_m).all() for source in sources for one in source.stretches):
        notes.append("not all frames have a height over the ground, which most estimators need: --height gives one")
    if sequences == 1:
        notes.append(
            "one sequence cannot be split: read it with `--part all`, or cut it with --cut to train on some sequences and "
            "validate on others"
        )
    return notes
