"""How the scenes of data sets become sources of another data set, so that several runs and data sets can be joined."""

from __future__ import annotations

import hashlib
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.bridges.export_source import FramesWithPoses, Stretch, axes_of, frames_with_poses
from mitsonar.config.data import Recipe
from mitsonar.datasets.modality import Scene, Values
from mitsonar.datasets.store import DataStore, shape_names_of
from mitsonar.errors import MitsonarError
from mitsonar.mapping.sources import LabelledPart, Labels, is_data_set, is_recording, recording_at, view_in
from mitsonar.recordings.recording import Part, Pixels

__all__ = ["part_of", "require_single_view", "shape_names_by_scene", "sources_at", "sources_of_data_set"]


def sources_at(
    where: str,
    *,
    path: str | Path | None = None,
    frame: str = "mitsonar",
    height_m: float | None = None,
    cut: int | None = None,
    geometry: str | Path | None = None,
) -> list[FramesWithPoses]:
    """Find the frames with poses at a path or URL: a source for each scene of a data set, otherwise a single one.

    Args:
        where: a data set, or a file or run as for :func:`~mitsonar.bridges.export_source.frames_with_poses`.
        path: file of poses, TUM or CSV; not for data sets.
        frame: convention of that file.
        height_m: height above the ground for frames that have none [m].
        cut: largest number of frames in a sequence.
        geometry: file that describes the layout of a recording's pictures; not for data sets.

    Raises:
        MitsonarError: there are no frames or no poses, or an option does not apply to a data set.
    """
    if not is_data_set(where):
        source = frames_with_poses(where, path=path, frame=frame, height_m=height_m, cut=cut, geometry=geometry)
        return [source if is_recording(where) else _read_again(source)]
    for option, value in (("--poses", path), ("--geometry", geometry)):
        if value is not None:
            raise MitsonarError(f"{option} does not apply to {where}, a data set with poses of its own: join it without")
    return sources_of_data_set(where, height_m=height_m, cut=cut)


def _read_again(source: FramesWithPoses) -> FramesWithPoses:
    """Return a run whose pixels and labels are not kept in memory: ``frames.npz`` is loaded as a whole when it is read."""
    part = source.stretches[0].part
    assert isinstance(part, LabelledPart)
    # an empty slice would keep the array that it is cut from
    values: dict[str, Any] = {one.name: getattr(part.like, one.name) for one in fields(part.like)}
    arrays: dict[str, Any] = {name: one.copy() for name, one in values.items() if isinstance(one, np.ndarray)}
    like = replace(part.like, **arrays)

    where, known = source.name, source.labels  # the functions below must not refer to the source, which holds the pixels
    stamps = tuple(one.stat().st_mtime_ns for one in _files_of(where))

    def labels(index: NDArray[np.intp]) -> Labels:
        frames = _loaded(where, stamps).read(index)
        return {name: getattr(frames, name) for name in known}

    def images(index: NDArray[np.intp]) -> Pixels:
        return _loaded(where, stamps).images(index)

    lazy = replace(part, like=like, images=images, labels=labels)
    return replace(source, stretches=[replace(stretch, part=lazy) for stretch in source.stretches])


def _files_of(where: str) -> list[Path]:
    """Return the files that may hold the frames of a run, as far as they exist."""
    return [one for one in (Path(where), Path(where) / "frames.npz", Path(where) / "frames.zarr") if one.exists()]


_KEPT: dict[tuple[str, tuple[int, ...]], Part] = {}
"""The run that was read last."""


def _loaded(where: str, stamps: tuple[int, ...]) -> Part:
    """Open a run, and keep it until another is read or its files have other ``stamps``."""
    if (where, stamps) not in _KEPT:
        _KEPT.clear()  # before the next one is loaded, so that only one is in memory
        _KEPT[where, stamps] = recording_at(where).part()
    return _KEPT[where, stamps]


def sources_of_data_set(
    where: str | Path, *, height_m: float | None = None, cut: int | None = None
) -> list[FramesWithPoses]:
    """Return each scene of a finished data set as a source, without reading pixels.

    Args:
        where: path or URL of a data set of images in a single view.
        height_m: height above the ground for frames that have none [m].
        cut: largest number of frames in a sequence.

    Raises:
        MitsonarError: the data set has other arrays or several views, or is damaged.
    """
    # 1. Open the images and their labels.
    store = DataStore.open(where)
    recipe = store.recipe
    require_single_view(store)
    axes = axes_of(view_in(store).like, str(where))
    part = part_of(store)
    names = shape_names_by_scene(store)
    # 2. Divide the frames into sequences, and these by scene.
    sequence, scene = store.read("sequence"), store.read("scene")
    ends = [*(np.flatnonzero(np.diff(sequence) | np.diff(scene)) + 1).tolist(), len(store)]
    time, poses, height = (np.asarray(store.read(name), dtype=float) for name in ("time_s", "pose", "height_m"))
    if height_m is not None:
        height = np.where(np.isfinite(height), height, height_m)
    by_scene: dict[int, list[Stretch]] = {number: [] for number in sorted(store.scenes)}
    for first, end in zip([0, *ends], ends, strict=False):
        if not (np.diff(time[first:end]) > 0).all():
            raise MitsonarError(f"the times of sequence {sequence[first]} of {where} do not increase: it is damaged")
        for span in _spans(first, end, cut):
            by_scene[int(scene[first])].append(Stretch(part, span.start, time[span], poses[span], height[span]))
    # 3. Describe each scene.
    notes = _left_out(store)
    raised = recipe.noise_raised_db(sorted(by_scene))
    counts = np.bincount(scene, minlength=max(by_scene) + 1)
    sources: list[FramesWithPoses] = []
    for (number, stretches), raised_db in zip(by_scene.items(), raised, strict=True):
        if stretches:
            source = FramesWithPoses(
                name=str(where) if len(by_scene) == 1 else f"{where}, scene {number}",
                format="data set of mitsonar",
                poses="its own",
                axes=axes,
                level_scale=store.level_scale_of(number),
                stretches=stretches,
                left_out=int(counts[number]) - sum(map(len, stretches)),
                notes=() if sources else notes,
                labels=tuple(recipe.labels),
                shape_names=names.get(number, ()),
                world=_world_digest(recipe, store.scenes[number]),
                recipe=recipe,
                raised_db=float(raised_db),
            )
            sources.append(source)
    if not sources:
        raise MitsonarError(f"{where} has no two frames of a sequence that --cut {cut} keeps: cut it into longer ones")
    return sources


def require_single_view(store: DataStore) -> None:
    """Check that a data set holds images of one sonar.

    Raises:
        MitsonarError: it holds responses or several views.
    """
    recipe = store.recipe
    if recipe.channel is not None:
        raise MitsonarError(f"{store.place.url} holds impulse responses: give data sets of images")
    if recipe.receivers or recipe.segments:
        views = ", ".join(view.name for view in recipe.views)
        raise MitsonarError(
            f"{store.place.url} has the views {views}: give data sets of one sonar without receivers or segments"
        )
    view_in(store)  # raises if only vectors are stored


def part_of(store: DataStore, span: slice | None = None, shape_names: tuple[str, ...] = ()) -> LabelledPart:
    """Return frames of a data set as a part of a recording, whose pixels and labels are read on demand."""
    view, chosen = view_in(store), span or slice(0, len(store))
    names = [view.array, *store.recipe.labels]

    def read(name: str, index: NDArray[np.intp]) -> Values:
        first = chosen.start + int(index[0]) if len(index) else 0
        if len(index) == 0 or (np.diff(index) == 1).all():
            return store.read(name, slice(first, first + len(index)))
        return np.stack([store.read(name, chosen.start + int(number)) for number in index])

    def labels(index: NDArray[np.intp]) -> Labels:
        return {name: read(name, index) for name in names[1:]}

    return LabelledPart(
        like=replace(view.like, shape_names=shape_names),
        time_s=np.asarray(store.read("time_s", chosen), dtype=float),
        images=lambda index: read(view.array, index),
        poses=np.asarray(store.read("pose", chosen), dtype=float),
        height_m=np.asarray(store.read("height_m", chosen), dtype=float),
        labels=labels,
    )


def shape_names_by_scene(store: DataStore) -> dict[int, tuple[str, ...]]:
    """Return the names of the shapes of each scene, by its number; empty if they are unknown."""
    if "shape_id" not in store.recipe.labels:
        return {}
    names, indices = shape_names_of(store)
    if not indices:
        return dict.fromkeys(store.scenes, names)
    return {number: tuple(names[index] for index in places[:-1]) for number, places in indices.items()}


def _spans(first: int, end: int, cut: int | None) -> list[slice]:
    """Cut a sequence; a single frame that a cut leaves over is dropped."""
    step = cut or end - first
    spans = [slice(start, min(start + step, end)) for start in range(first, end, step)]
    return [span for span in spans if span.stop - span.start > 1 or end - first == 1]


def _left_out(store: DataStore) -> tuple[str, ...]:
    """Return a sentence on what a data set holds besides images, labels and poses of the sonar."""
    recipe = store.recipe
    arrays = [name for name in store.rendered if name.startswith(("vector", "nonzero", "body_"))]
    notes = [f"left out: {', '.join(arrays)}"] if arrays else []
    if recipe.recorded is None and "vehicle_pose" in store.group:
        notes.append("left out: vehicle_pose; motions are those of the sonar, not of the vehicle that carried it")
    return tuple(notes)


def _world_digest(recipe: Recipe, scene: Scene) -> str:
    """Return a digest that is the same for two scenes with the same world; empty if it is unknown."""
    if recipe.recorded is not None:
        return recipe.recorded.sources[scene.group].world
    family = recipe.family(scene.group)
    text = f"{type(family).__qualname__} {family.model_dump_json()} {scene.seed if family.seeded else 0}"
    return hashlib.sha256(text.encode()).hexdigest()
