"""The arrays of a data set's store: how frames are cut into files, how the arrays are created, what each one holds."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec

from mitsonar.config.data import Recipe
from mitsonar.datasets.modalities import modality_of
from mitsonar.datasets.modality import Modality, StoredArray, Values
from mitsonar.datasets.plan import Plan

__all__ = ["SEAL", "ShardLayout", "create_arrays", "planned_arrays", "write_planned"]

SHARD_BYTES = 32 * 2**20
"""Approximate size of what is recorded in a shard. A worker holds so much, and a kill may cost so much."""

SEAL = "seal"
"""Name of the array with the sizes and digests of all files."""

ABOUT = {
    "pose": "sonar: x, y, z [m], pitch, roll, heading [rad]",
    "vehicle_pose": "vehicle: x, y, z [m], pitch, roll, heading [rad]; motion is the vehicle's",
    "motion": "to the next frame of the sequence: sideways, forward [m], yaw [rad]; nan for its last",
    "velocity": "of the vehicle in its own axes: starboard, forward, up [m/s], turn to starboard [rad/s]",
    "time_s": "since the sequence began [s]",
    "scene": "number of the scene",
    "sequence": "number of the sequence",
    SEAL: "bytes and BLAKE2b-64 of each file of a shard, written when the shard is done",
}


@dataclass(frozen=True)
class ShardLayout:
    """How frames are cut into files.

    Attributes:
        chunk: frames that are compressed together: a sequence, where sequences are short.
        shard: frames of one file, the unit of work.
    """

    chunk: int
    shard: int

    @classmethod
    def of(cls, recipe: Recipe, plan: Plan) -> ShardLayout:
        """Choose chunks that hold whole short sequences, and shards of about 32 MiB, of one scene if possible."""
        pings = recipe.flight.pings if recipe.flight.kind == "random" else 10
        chunk = pings if pings <= 10 else 10
        each = modality_of(recipe).ping_bytes
        scenes = np.bincount(plan.scene)
        wanted = max(1, min(SHARD_BYTES // each, int(scenes.max())) // chunk)
        # where scenes allow it, shards end with them: a shard of two scenes loads both
        whole = int(np.gcd.reduce(scenes[scenes > 0])) // chunk
        aligned = max((n for n in range(1, wanted + 1) if whole % n == 0), default=1) if whole else 1
        return cls(chunk, chunk * (aligned if 3 * aligned >= wanted else wanted))


def create_arrays(group: zarr.Group, plan: Plan, modality: Modality, layout: ShardLayout) -> None:
    """Create every array of a store, and write those whose values are known before rendering.

    Args:
        group: of the store.
        plan: all frames of the data set.
        modality: what its instrument records.
        layout: how frames are cut into files.
    """
    for name, stored in modality.stored.items():
        # numbers of a shard's pings are small: one chunk
        _create_recorded(group, name, len(plan), stored, layout if len(stored.shape) > 0 else ShardLayout(layout.shard, 0))
    for name, axis in modality.axes.items():
        _write_known(group, name, axis.values, (axis.dim,), axis.about)
    for name, values in planned_arrays(plan, modality).items():
        write_planned(group, name, values)
    recorded = list(modality.stored)
    shape = (-(-len(plan) // layout.shard), len(recorded), 2)
    seal = group.create_array(
        SEAL,
        shape=shape,
        chunks=(1, *shape[1:]),
        dtype="uint64",
        compressors=None,
        fill_value=0,
        overwrite=True,
        dimension_names=("shard", "stored", "two"),
    )
    seal.attrs.put({"about": ABOUT[SEAL], "arrays": recorded})


def planned_arrays(plan: Plan, modality: Modality) -> dict[str, Values]:
    """Return the arrays that the plan decides, by name, each ``(frames, ...)``.

    The vehicle's poses are among them where x, y, z or heading of the sonar differ from the vehicle's.
    """
    known: dict[str, Values] = {"pose": plan.poses, "motion": plan.motion, "time_s": plan.time_s}
    known |= {"scene": plan.scene, "sequence": plan.sequence}
    if not np.array_equal(plan.poses[:, [0, 1, 2, 5]], plan.vehicle[:, [0, 1, 2, 5]]):
        known["vehicle_pose"] = plan.vehicle
    return known | {name: getattr(plan, name) for name in modality.planned}


def write_planned(group: zarr.Group, name: str, values: Values) -> None:
    """Write an array of :func:`planned_arrays`, in one piece."""
    inner = {"pose": ("six",), "vehicle_pose": ("six",), "motion": ("three",), "velocity": ("four",)}
    _write_known(group, name, values, ("frame", *inner.get(name, ())), ABOUT[name])


def _create_recorded(group: zarr.Group, name: str, frames: int, stored: StoredArray, layout: ShardLayout) -> None:
    """Create an array that rendering fills: shards of compressed chunks with checksums, or plain chunks if a shard is 0."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # checksums of v3 are not in every reader
        group.create_array(
            name,
            shape=(frames, *stored.shape),
            chunks=(layout.chunk, *stored.shape),
            shards=(layout.shard, *stored.shape) if layout.shard else None,
            dtype=stored.kind,
            fill_value=0,
            compressors=[ZstdCodec(level=1), Crc32cCodec()],
            dimension_names=("frame", *stored.dims),
            attributes={"about": stored.about},
            overwrite=True,
        )


def _write_known(group: zarr.Group, name: str, values: Values, dims: tuple[str, ...], about: str) -> None:
    """Write an array whose values are known from the start, in one piece."""
    array = group.create_array(
        name,
        shape=values.shape,
        chunks=values.shape,
        dtype=values.dtype,
        fill_value=0,
        dimension_names=dims,
        attributes={"about": about},
        overwrite=True,
    )
    with zarr.config.set({"array.write_empty_chunks": True}):
        array[...] = values
