"""Checks of a data set: checksums, counts, ranges, and labels that follow from poses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mitsonar.datasets.modality import empty_sentence
from mitsonar.datasets.plan import Plan, footprints_at
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError
from mitsonar.motion.composition import motions

__all__ = ["check"]

LABEL_TOLERANCE = 1e-9
"""Largest difference of labels and limits [m, rad]."""


def check(store: DataStore, progress: Callable[[int], None] = lambda frames: None) -> list[str]:
    """Check a data set. Everything is read.

    Args:
        store: of the data set.
        progress: called with the number of frames that were checked.

    Returns:
        A sentence for each fault.
    """
    wrong = _files(store, progress)
    for check_part in (_plan, _counts, _labels, _flight):
        try:
            wrong += check_part(store)
        except MitsonarError as error:
            wrong.append(str(error))
    return wrong


def _files(store: DataStore, progress: Callable[[int], None]) -> list[str]:
    """Check every file against its seal, and its values against their limits."""
    wrong: list[str] = []
    unwritten: list[int] = []
    empty: list[int] = []
    sizes, seals = store.place.sizes(), store.seals()
    for shard in range(store.shards):
        here = store.frames_of(shard)
        keys = [store.key(name, shard) for name in store.rendered]
        lacking = [key for key in keys if key not in sizes]
        if lacking or not seals[shard].any():
            unwritten.append(shard)
        else:
            damaged = store.damaged(shard, seals[shard])
            for key in damaged:
                size = int(seals[shard][keys.index(key), 0])
                wrong.append(
                    f"{key} is damaged (frames {here.start}..{here.stop - 1}): "
                    + (f"{sizes[key]} bytes, sealed with {size}" if sizes[key] != size else "other bytes than were sealed")
                )
            if not damaged:
                wrong += store.modality.faults(store.read, here)
                empty += (here.start + np.flatnonzero(store.modality.empty(store.read, here))).tolist()
        progress(here.stop - here.start)
    if empty:
        wrong.append(empty_sentence(empty, len(store)))
    if unwritten:
        which = ", ".join(map(str, unwritten[:10])) + (" ..." if len(unwritten) > 10 else "")
        state = "is damaged" if store.finished else "is not finished"
        wrong.append(
            f"{store.place.url} {state}: {len(unwritten)} of {store.shards} shards are not written ({which}); the same "
            "`mitsonar dataset make` makes them"
        )
    return wrong


def _plan(store: DataStore) -> list[str]:
    """Check the planned arrays against a plan that is made anew from recipe and seed."""
    if store.recipe.recorded is not None:  # its poses were given
        return []
    plan = Plan.of(store.recipe, int(store.about["sequences"]))
    return [f"{name} is not what recipe and seed give" for name in store.unplanned(plan)]


def _counts(store: DataStore) -> list[str]:
    """Check the numbers of frames, sequences and scenes."""
    about, wrong = store.about, []
    scene, sequence = store.read("scene"), store.read("sequence")
    lengths = np.bincount(sequence)
    if len(scene) != about["frames"] or len(lengths) != about["sequences"]:
        wrong.append(f"{len(scene)} frames in {len(lengths)} sequences, {about['frames']} in {about['sequences']} promised")
    if (np.diff(sequence) < 0).any() or (np.diff(sequence) > 1).any():
        wrong.append("sequences are not numbered one after the other")
    if store.recipe.flight.kind == "random" and (lengths != store.recipe.flight.pings).any():
        wrong.append(f"sequences of {sorted(set(lengths.tolist()))} frames, the recipe says {store.recipe.flight.pings}")
    _, first = np.unique(sequence, return_index=True)
    for number, wanted in store.scenes.items():
        found = int((scene[first] == number).sum())
        if found != wanted.sequences:
            wrong.append(f"scene {number} has {found} sequences, {wanted.sequences} promised")
    for name, axis in store.modality.axes.items():
        if not np.array_equal(store.read(name), axis.values):
            wrong.append(f"{name} is not what the recipe's sonar has")
    return wrong


def _vehicle(store: DataStore) -> NDArray[np.float64]:
    return store.read("vehicle_pose" if "vehicle_pose" in store.group else "pose")


def _labels(store: DataStore) -> list[str]:
    """Check the motions against the poses."""
    sequence, motion, vehicle = store.read("sequence"), store.read("motion"), _vehicle(store)
    inner = np.append(sequence[1:] == sequence[:-1], False)
    wrong = []
    if not np.isnan(motion[~inner]).all():
        wrong.append("the last frame of a sequence has a motion")
    error = np.abs(motions(vehicle) - motion[:-1])[inner[:-1]]
    if error.size and not error.max() <= LABEL_TOLERANCE:
        wrong.append(f"labels differ from poses by up to {error.max():.1e} (m, rad), allowed {LABEL_TOLERANCE:g}")
    return wrong


def _flight(store: DataStore) -> list[str]:
    """Check the limits of motions and jumps, and that footprints lie inside their scenes."""
    recipe = store.recipe
    flight = recipe.flight
    if flight.kind != "random":
        return []
    wrong = []
    sequence, motion, scene = (store.read(name) for name in ("sequence", "motion", "scene"))
    vehicle = _vehicle(store)
    limit = np.array([flight.sideways_mm / 1e3, flight.forward_mm / 1e3, np.radians(flight.yaw_deg)])
    if motion.size and np.nanmax(np.abs(np.nan_to_num(motion)) - limit) > LABEL_TOLERANCE:
        wrong.append("motions exceed the recipe's limits")
    border = np.flatnonzero((sequence[1:] != sequence[:-1]) & (scene[1:] == scene[:-1]))
    if flight.jump_m is not None and border.size:
        jump = np.abs(vehicle[border + 1, :2] - vehicle[border, :2])
        low, high = flight.jump_m
        if jump.min() < low - LABEL_TOLERANCE or jump.max() > high + LABEL_TOLERANCE:
            wrong.append(f"jumps of {jump.min():.4f}..{jump.max():.4f} m, the recipe says {low:g}..{high:g}")
    outside = _outside(store, vehicle, scene)
    if outside > LABEL_TOLERANCE:
        wrong.append(f"a footprint leaves its scene by {outside:.3g} m")
    return wrong


def _outside(store: DataStore, vehicle: NDArray[np.float64], scene: NDArray[np.int32]) -> float:
    """Return how far footprints leave their scenes at most [m]."""
    recipe = store.recipe
    half = {number: recipe.family(one.group).half_m for number, one in store.scenes.items()}
    limit = np.array([half[int(number)] for number in scene])
    farthest = -np.inf
    # where no pose of the vehicle is stored, it differs from the sonar's by the mount's pitch alone
    lean = 0.0 if "vehicle_pose" in store.group else recipe.mount.pose.pitch
    flown = np.column_stack([vehicle[:, 2], np.round(vehicle[:, 3] - lean, 9)])
    for height, pitch in np.unique(flown, axis=0):
        mine = (flown == (height, pitch)).all(axis=1)
        corners = np.abs(footprints_at(vehicle[mine], store.modality.reach(float(height), float(pitch))))
        farthest = max(farthest, float((corners.max(axis=(1, 2)) - limit[mine]).max()))
    return farthest
