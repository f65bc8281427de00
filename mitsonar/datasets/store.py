"""How a data set is stored on disk or in object storage: one Zarr v3 group, written shard by shard.

docs/reference/files.md describes the format.
"""

from __future__ import annotations

import contextlib
import hashlib
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import EllipsisType
from typing import Any, TypeAlias

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec, ZstdCodec

from mitsonar.config.data import Recipe, Split, recipe_from
from mitsonar.datasets.modality import Fields, Modality, Scene, StoredArray, Values
from mitsonar.datasets.plan import Plan, modality_of
from mitsonar.errors import MitsonarError, did_you_mean, short_repr
from mitsonar.io.files import check_plain_value, finite_number, whole_number
from mitsonar.io.runs import changed_versions
from mitsonar.io.storage import Storage, refuse_codecs
from mitsonar.records.frames import ALWAYS_ACCEPTED_ROWS, max_plausible_rows
from mitsonar.worlds.world import Family

__all__ = [
    "FORMAT",
    "PACKAGES",
    "PARTS",
    "RESULT_PACKAGES",
    "SEAL",
    "DataStore",
    "ShardLayout",
    "check_attributes",
    "create_arrays",
    "frames_in_part",
    "planned_arrays",
    "samples_in_part",
    "shape_names_of",
    "world_numbers",
    "write_planned",
]


FORMAT = 1
"""Version of the format that docs/reference/files.md describes."""

PACKAGES = ("mitsonar", "mitsuba", "drjit", "numpy", "finufft", "zarr")
"""Packages whose versions a store records."""

RESULT_PACKAGES = PACKAGES[:3]
"""Packages whose versions affect the recorded values."""

DType: TypeAlias = np.dtype[Any]
"""NumPy data type of an array."""


class DataStore:
    """One data set on disk or in object storage; use :meth:`create` or :meth:`open` to get one.

    Attributes:
        place: storage that contains the data set.
        group: Zarr group.
        recipe: recipe of the data set.
        modality: modality of the recipe's instrument.
    """

    def __init__(self, storage: Storage, group: zarr.Group) -> None:
        self.place, self.group = storage, group
        self._arrays: dict[str, zarr.Array[Any]] = {}
        self.recipe = recipe_from(dict(self.about["recipe"]))
        self.modality: Modality = modality_of(self.recipe)

    @classmethod
    def create(cls, storage: Storage, recipe: Recipe, plan: Plan, about: Fields) -> DataStore:
        """Create a store, and write everything that is known before rendering.

        An unfinished store at the same location is overwritten.

        Args:
            storage: location of the store.
            recipe: recipe of the data set.
            plan: all frames of the data set.
            about: further attributes, at least those in the modality's ``fixed_attributes``.
        """
        modality, layout = modality_of(recipe), ShardLayout.of(recipe, plan)
        attributes = {
            "format": FORMAT,
            "kind": "mitsonar data set",
            "recipe": recipe.model_dump(mode="json"),
            "frames": len(plan),
            "sequences": int(plan.sequence[-1]) + 1,
            "chunk_frames": layout.chunk,
            "shard_frames": layout.shard,
            **modality.attributes,
            "scenes": [vars(scene) for scene in plan.scenes],
            "ready": False,
            "finished": False,
            **about,
        }
        if "zarr.json" in storage.sizes():
            group = zarr.open_group(storage.store(write=True), mode="r+", zarr_format=3)
            group.attrs.put(attributes)
        else:  # in one write: a group without attributes could not be recognised as a data set
            group = zarr.create_group(storage.store(write=True), zarr_format=3, attributes=attributes)
        store = cls(storage, group)
        create_arrays(group, plan, modality, layout)
        group.attrs.put(attributes | {"ready": True})
        return store

    @classmethod
    def open(cls, url: str | Path | Storage, *, write: bool = False, unfinished: bool = False) -> DataStore:
        """Open the store at a path or URL.

        Args:
            url: path or URL.
            write: whether shards will be written.
            unfinished: whether to accept a store that is not finished.

        Raises:
            MitsonarError: there is no store, or it is not a mitsonar data set, is damaged, or is not finished.
        """
        storage = url if isinstance(url, Storage) else Storage(url)
        try:
            group = zarr.open_group(storage.store(write=write), mode="r+" if write else "r", zarr_format=3)
            attributes: Fields = dict(group.attrs)
            is_data_set = attributes.get("kind") == "mitsonar data set"
            stored_format = attributes.get("format")
            check_plain_value(attributes, "its zarr.json")
        except Exception as error:  # a damaged file, or a storage that does not answer, may raise anything
            no_group = isinstance(error, zarr.errors.GroupNotFoundError)
            reason = "it is not a Zarr group" if no_group else " ".join(str(error).split())[:200] or type(error).__name__
            raise MitsonarError(
                f"no data set at {storage.url}: {reason}; give the output of `mitsonar dataset make` or of `dataset "
                "from-frames`"
            ) from None
        if not is_data_set:
            kind = short_repr(attributes.get("kind"))
            raise MitsonarError(
                f"{storage.url} is not a mitsonar data set, but a Zarr group of the kind {kind}: give the output of "
                "`mitsonar dataset make` or `dataset from-frames`"
            )
        if stored_format != FORMAT:
            raise MitsonarError(
                f"{storage.url} has format {short_repr(stored_format)}, but this version of mitsonar reads format {FORMAT}: "
                "use the version that wrote it"
            )
        try:
            store = cls(storage, group)
            check_attributes(attributes, store.recipe, store.modality)
            store.scenes  # noqa: B018
            if store.ready:
                store._check_rows()
        except Exception as error:  # damaged attributes may raise anything
            raise MitsonarError(
                f"the attributes of {storage.url} are damaged ({type(error).__name__}: {error}): remove it and make it again"
            ) from None
        if not unfinished and not store.finished:
            raise MitsonarError(
                f"{storage.url} is not finished: run the same `mitsonar dataset make` again, which resumes it"
            )
        return store

    def __repr__(self) -> str:
        state, sequences = "" if self.finished else ", not finished", int(self.about["sequences"])
        return f"DataStore({len(self):,} frames in {sequences:,} sequences, {self.recipe.name}{state}: {self.place.url})"

    # ---------------------------------------------------------------- reading

    @property
    def about(self) -> Fields:
        """Return the attributes of the group, keyed by name."""
        return dict(self.group.attrs)

    @property
    def ready(self) -> bool:
        """Return whether all arrays have been created."""
        return bool(self.group.attrs.get("ready"))

    @property
    def finished(self) -> bool:
        """Return whether every shard has been written."""
        return bool(self.group.attrs.get("finished"))

    def __len__(self) -> int:
        return int(self.about["frames"])

    @cached_property
    def scenes(self) -> dict[int, Scene]:
        """Return the scenes, keyed by number."""
        return {int(fields["number"]): Scene(**fields) for fields in self.about["scenes"]}

    def level_scale_of(self, scene: int) -> float:
        """Return the level of a pixel of value 1 in a scene; scenes of recorded frames keep the gain of their source."""
        recorded = self.recipe.recorded
        if recorded is None:
            return float(self.about["level_scale"])
        return recorded.sources[self.scenes[scene].group].level_scale

    def array(self, name: str) -> zarr.Array[Any]:
        """Return the array with the given name.

        Raises:
            MitsonarError: its metadata is damaged or missing, or its type, shape or layout does not match the recipe.
        """
        if name not in self._arrays:  # cached, because the group reads the metadata at every access
            try:
                with zarr.config.set({"array.write_empty_chunks": True}):  # so that a missing file is a missing shard
                    array = self.group[name]
                if isinstance(array, zarr.Array):
                    refuse_codecs(array)
            except Exception as error:  # metadata missing or damaged
                raise MitsonarError(
                    f"{self.place.url}/{name}/zarr.json is damaged or missing ({type(error).__name__}): remove the data set "
                    "and make it again"
                ) from None
            if not isinstance(array, zarr.Array):
                raise MitsonarError(f"{self.place.url}/{name} is not an array: remove the data set and make it again")
            self._check_array(name, array)
            self._arrays[name] = array
        return self._arrays[name]

    def read(self, name: str, index: int | slice | EllipsisType = ...) -> Values:
        """Read the values of an array: all of them, or those of one frame or of a slice of frames.

        Raises:
            MitsonarError: the bytes are damaged, or the values are impossible.
        """
        array = self.array(name)
        try:
            values = np.asarray(array[index])
        except Exception as error:  # damaged bytes may raise anything
            reason = " ".join(str(error).split())[:160] or type(error).__name__
            raise MitsonarError(
                f"{self.place.url}: {name} is damaged ({reason}); `mitsonar dataset check` lists the damaged files, "
                "`mitsonar dataset make --verify` repairs them"
            ) from None
        highest = {"sequence": int(self.about["sequences"]) - 1, "scene": max(self.scenes)}.get(name)
        if values.size and highest is not None and not (values.min() >= 0 and values.max() <= highest):
            raise MitsonarError(
                f"{self.place.url}: {name} is damaged (numbers are 0..{highest}, got {values.min()}..{values.max()}); "
                "`mitsonar dataset make --verify` repairs it"
            )
        if name in ("pose", "vehicle_pose", "time_s") and not np.isfinite(values).all():
            raise MitsonarError(
                f"{self.place.url}: {name} is damaged (nan or inf); `mitsonar dataset make --verify` repairs it"
            )
        return values

    def _check_rows(self) -> None:
        """Check that the stored bytes of poses, motions or times suffice for the number of frames in the attributes.

        Raises:
            ValueError: they do not.
        """
        if len(self) <= ALWAYS_ACCEPTED_ROWS:
            return
        stored_bytes = 0
        for key in ("pose/c/0/0", "motion/c/0/0", "time_s/c/0"):
            with contextlib.suppress(OSError):
                stored_bytes = max(stored_bytes, int(self.place.fs.size(f"{self.place.root}/{key}") or 0))
        if len(self) > max_plausible_rows(stored_bytes):
            raise ValueError(f"{len(self):,} frames are more than the {stored_bytes:,} bytes of their poses can hold")

    def _check_array(self, name: str, array: zarr.Array[Any]) -> None:
        """Check that type, shape and chunks of an array match the recipe.

        Raises:
            MitsonarError: they do not.
        """
        expected = self._expected_arrays.get(name)
        if expected is None:
            return
        shape, dtype = expected
        chunks = array.shards or array.chunks
        expected_chunks = (
            (self.shard_frames, *shape[1:]) if name in self.rendered else (1, *shape[1:]) if name == SEAL else shape
        )
        fits = all(length > 0 for length in array.chunks) and tuple(chunks) == expected_chunks
        if array.shape != shape or array.dtype.kind != np.dtype(dtype).kind or not fits:
            raise MitsonarError(
                f"{self.place.url}/{name} is {array.dtype} {str(array.shape)[:60]} in chunks of {str(chunks)[:60]}, not "
                f"{dtype} {shape} in chunks of {expected_chunks}: it is damaged; remove the data set and make it again"
            )

    @cached_property
    def _expected_arrays(self) -> dict[str, tuple[tuple[int, ...], DType]]:
        """Return the expected shape and type of each array, keyed by name."""
        frames = len(self)
        table: dict[str, tuple[tuple[int, ...], DType]] = {}
        table |= {name: ((frames, *one.shape), one.kind) for name, one in self.modality.stored.items()}
        table |= {name: (axis.values.shape, axis.values.dtype) for name, axis in self.modality.axes.items()}
        widths = {"pose": 6, "vehicle_pose": 6, "motion": 3, "velocity": 4}
        table |= {name: ((frames, width), np.dtype(np.float64)) for name, width in widths.items()}
        table |= {"time_s": ((frames,), np.dtype(np.float64))}
        table |= {name: ((frames,), np.dtype(np.int32)) for name in ("scene", "sequence")}
        return table | {SEAL: ((self.shards, len(self.rendered), 2), np.dtype(np.uint64))}

    # ---------------------------------------------------------------- shards

    @property
    def shard_frames(self) -> int:
        """Return the number of frames in a shard; the last shard may contain fewer."""
        return int(self.about["shard_frames"])

    @property
    def shards(self) -> int:
        """Return the number of shards."""
        return -(-len(self) // self.shard_frames)

    def frames_of(self, shard: int) -> slice:
        """Return the slice of a shard's frames in the store."""
        return slice(shard * self.shard_frames, min((shard + 1) * self.shard_frames, len(self)))

    @cached_property
    def rendered(self) -> list[str]:
        """Return the names of the arrays that are written shard by shard."""
        return list(self.modality.stored)

    def key(self, name: str, shard: int) -> str:
        """Return the path of the file of an array's shard, relative to the store."""
        array = self.array(name)
        return f"{name}/{array.metadata.encode_chunk_key((shard, *(0,) * (array.ndim - 1)))}"

    def write_shard(self, shard: int, values: dict[str, Values]) -> None:
        """Write all arrays of a shard, given by name, then its seal: the sizes and digests of the files."""
        for name in self.rendered:
            self.place.remove(self.key(name, shard))  # Zarr would read a damaged shard before it overwrites it
            self.array(name)[self.frames_of(shard)] = values[name]
        self.seal(shard)

    def seal(self, shard: int) -> None:
        """Record the current sizes and digests of a shard's files, which marks the shard as done."""
        contents = [self.place.read(self.key(name, shard)) for name in self.rendered]
        rows = [(len(content), digest(content)) for content in contents]
        self.array(SEAL)[shard] = np.array(rows, dtype=np.uint64)

    def seals(self) -> NDArray[np.uint64]:
        """Read the sizes and digests of all files ``(shards, arrays, 2)``; zeros where a shard is not done."""
        return np.asarray(self.read(SEAL), dtype=np.uint64)

    def missing(self, *, verify: bool = False) -> list[int]:
        """List the shards that are missing or whose files have changed.

        A complete shard without a seal is sealed. In a store that is open for reading only, it counts as missing.

        Args:
            verify: whether to compare digests as well as sizes, which reads all files.
        """
        sizes, seals = self.place.sizes(), self.seals()
        missing = []
        for shard in range(self.shards):
            keys = [self.key(name, shard) for name in self.rendered]
            file_sizes = np.array([sizes.get(key, -1) for key in keys])
            if (file_sizes < 0).any():
                missing.append(shard)
            elif not seals[shard].any():  # the writer stopped between the last file and the seal
                if not self.group.read_only and self._checksums_match(shard):
                    self.seal(shard)
                else:
                    missing.append(shard)
            elif (file_sizes != seals[shard, :, 0]).any() or (verify and self.damaged(shard, seals[shard])):
                missing.append(shard)
        return missing

    def damaged(self, shard: int, seal: NDArray[np.uint64]) -> list[str]:
        """Return the files of a shard whose digest differs from the sealed one."""
        damaged = []
        for name, (_, sealed_digest) in zip(self.rendered, seal, strict=True):
            try:
                content = self.place.read(self.key(name, shard))
            except OSError:
                content = b""
            if digest(content) != int(sealed_digest):
                damaged.append(self.key(name, shard))
        return damaged

    def _checksums_match(self, shard: int) -> bool:
        """Return whether all checksums inside the files of a shard are correct."""
        try:
            for name in self.rendered:
                self.read(name, self.frames_of(shard))
        except MitsonarError:
            return False
        return True

    def finish(self) -> None:
        """Mark the store as finished, once every shard has been written."""
        self.group.attrs["finished"] = True

    def mark_unfinished(self) -> None:
        """Mark the store as not finished, because shards will be rewritten."""
        if self.finished:
            self.group.attrs["finished"] = False

    def changed_versions(self) -> list[str]:
        """List the packages that affect recorded values and whose installed versions differ from the recorded ones."""
        return changed_versions(self.about["versions"], (*RESULT_PACKAGES, *self.modality.result_packages))

    def deviating_arrays(self, plan: Plan) -> list[str]:
        """List the planned arrays that deviate from the plan by more than 1e-9.

        The tolerance allows for processors that differ in the last bits.
        """
        deviating = []
        for name, values in planned_arrays(plan, self.modality).items():
            try:
                stored = self.read(name)
                same = stored.shape == values.shape and np.allclose(stored, values, rtol=0, atol=1e-9, equal_nan=True)
            except MitsonarError:
                same = False
            if not same:
                deviating.append(name)
        return deviating

    def repair_planned_arrays(self, plan: Plan) -> None:
        """Rewrite the planned arrays that are damaged or deviate from the plan."""
        for name in self.deviating_arrays(plan):
            self._arrays.pop(name, None)
            write_planned(self.group, name, planned_arrays(plan, self.modality)[name])


def digest(content: bytes) -> int:
    """Compute the 64-bit BLAKE2b digest of some bytes."""
    return int.from_bytes(hashlib.blake2b(content, digest_size=8).digest(), "little")


# ---------------- Arrays of a store and their layout


SHARD_BYTES = 32 * 2**20
"""Approximate size of the recorded values in a shard [bytes]. A worker keeps this much in memory, and loses it if killed."""

SEAL = "seal"
"""Name of the array with the sizes and digests of all files."""

DESCRIPTIONS = {
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
    """Division of the frames into chunks and shards.

    Attributes:
        chunk: number of frames that are compressed together; one sequence if sequences are short.
        shard: number of frames in one file, the unit of work.
    """

    chunk: int
    shard: int

    @classmethod
    def of(cls, recipe: Recipe, plan: Plan) -> ShardLayout:
        """Choose chunks of one sequence if sequences are short, and shards of about 32 MiB, of one scene if possible."""
        pings = recipe.flight.pings if recipe.flight.kind == "random" else 10
        chunk = pings if pings <= 10 else 10
        ping_bytes = modality_of(recipe).ping_bytes
        scenes = np.bincount(plan.scene)
        target = max(1, min(SHARD_BYTES // ping_bytes, int(scenes.max())) // chunk)
        # Shards end where scenes end if the sizes allow it, because rendering a shard of two scenes loads both. The
        # aligned size is used unless it is less than a third of the target.
        scene_chunks = int(np.gcd.reduce(scenes[scenes > 0])) // chunk
        aligned = max((n for n in range(1, target + 1) if scene_chunks % n == 0), default=1) if scene_chunks else 1
        return cls(chunk, chunk * (aligned if 3 * aligned >= target else target))


def create_arrays(group: zarr.Group, plan: Plan, modality: Modality, layout: ShardLayout) -> None:
    """Create every array of a store, and write those whose values are known before rendering.

    Args:
        group: Zarr group of the store.
        plan: all frames of the data set.
        modality: modality of the recipe's instrument.
        layout: division of the frames into chunks and shards.
    """
    for name, stored in modality.stored.items():
        # Scalars per ping are small, so the scalars of a whole shard form one chunk.
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
    seal.attrs.put({"about": DESCRIPTIONS[SEAL], "arrays": recorded})


def planned_arrays(plan: Plan, modality: Modality) -> dict[str, Values]:
    """Return the arrays ``(frames, ...)`` that are known from the plan, keyed by name.

    The vehicle's poses are included if x, y, z or heading of the sonar differ from the vehicle's.
    """
    arrays: dict[str, Values] = {"pose": plan.poses, "motion": plan.motion, "time_s": plan.time_s}
    arrays |= {"scene": plan.scene, "sequence": plan.sequence}
    if not np.array_equal(plan.poses[:, [0, 1, 2, 5]], plan.vehicle[:, [0, 1, 2, 5]]):
        arrays["vehicle_pose"] = plan.vehicle
    return arrays | {name: getattr(plan, name) for name in modality.planned}


def write_planned(group: zarr.Group, name: str, values: Values) -> None:
    """Write an array of :func:`planned_arrays` as a single chunk."""
    dims = {"pose": ("six",), "vehicle_pose": ("six",), "motion": ("three",), "velocity": ("four",)}
    _write_known(group, name, values, ("frame", *dims.get(name, ())), DESCRIPTIONS[name])


def _create_recorded(group: zarr.Group, name: str, frames: int, stored: StoredArray, layout: ShardLayout) -> None:
    """Create an array that is filled by rendering.

    It consists of shards of compressed chunks with checksums, or of unsharded chunks if ``layout.shard`` is 0.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Zarr warns that not every reader supports the checksums of v3
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
    """Create an array whose values are known before rendering, and write it as a single chunk."""
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


# ---------------- Validation of a store's attributes


MAX_FRAMES = 10**9
"""Largest number of frames in a data set."""


def check_attributes(about: Fields, recipe: Recipe, modality: Modality) -> None:
    """Check that the numbers in a store's attributes agree with each other and with the recipe.

    The check runs before any memory is allocated for the number of frames in the attributes.

    Args:
        about: attributes of the Zarr group.
        recipe: recipe of the data set.
        modality: modality of the recipe's instrument.

    Raises:
        MitsonarError, KeyError, ValueError: a number is missing, out of bounds or inconsistent.
    """
    sequences = whole_number(about["sequences"], "sequences", 1, recipe.sequences)
    max_frames = MAX_FRAMES
    if recipe.flight.kind == "random":
        max_frames = sequences * recipe.flight.pings
        whole_number(about["frames"], "frames", max_frames, max_frames)
    frames = whole_number(about["frames"], "frames", 1, min(max_frames, MAX_FRAMES))
    shard_frames = whole_number(about["shard_frames"], "shard_frames", 1, MAX_FRAMES)
    if shard_frames % whole_number(about["chunk_frames"], "chunk_frames", 1, shard_frames):
        raise ValueError("shard_frames is not a multiple of chunk_frames")
    total, numbers = 0, set()
    for scene in about["scenes"]:
        numbers.add(whole_number(scene["number"], "number of a scene", 0, 2**31))
        whole_number(scene["group"], "group of a scene", 0, len(recipe.scenes) - 1)
        whole_number(scene["seed"], "seed of a scene", 0, 2**64)
        total += whole_number(scene["sequences"], "sequences of a scene", 1, sequences)
    if total != sequences or len(numbers) != len(about["scenes"]):
        raise ValueError(f"scenes have {total:,} sequences, but the attributes state {sequences:,} for {frames:,} frames")
    for name in modality.fixed_attributes:
        finite_number(about[name], name, above=0)
    versions = about["versions"]
    if not (isinstance(versions, dict) and isinstance(about["variant"], str)):
        raise ValueError("versions must be an object, and variant a string")
    if not all(type(about[name]) is bool for name in ("ready", "finished")):
        raise ValueError("ready and finished must be true or false")


# ---------------- Training, validation and test parts


PARTS = ("train", "validation", "test")


def world_numbers(recipe: Recipe, scenes: dict[int, Scene]) -> NDArray[np.int64]:
    """Return, for each scene number, the first scene with the same world; some worlds do not depend on the seed."""
    worlds = np.arange(max(scenes) + 1)
    if recipe.recorded is not None:  # only scenes that were rendered tell whether they show the same place
        places: dict[str, int] = {}
        for number, scene in sorted(scenes.items()):
            place = recipe.recorded.sources[scene.group].world
            worlds[number] = places.setdefault(place, number) if place else number
        return worlds
    known: dict[tuple[type[Family], str, int], int] = {}
    for number, scene in sorted(scenes.items()):
        family = recipe.family(scene.group)
        world = (type(family), family.model_dump_json(), scene.seed if family.seeded else 0)
        worlds[number] = known.setdefault(world, number)
    return worlds


def frames_in_part(world: NDArray[np.int64], sequence: NDArray[np.int32], split: Split, part: str) -> NDArray[np.bool_]:
    """Return the mask ``(frames,)`` of the frames in a part.

    Sequences, or worlds with all their frames, are assigned to the parts at random, as a whole.

    Args:
        world: world number of each frame ``(frames,)``.
        sequence: sequence number of each frame ``(frames,)``.
        split: shares of the parts, and the seed.
        part: ``train``, ``validation``, ``test`` or ``all``.

    Raises:
        MitsonarError: the part is unknown or not in the split, or there are fewer worlds or sequences than parts.
    """
    if part == "all":
        return np.ones(len(world), dtype=bool)
    if part not in PARTS:
        raise MitsonarError(f"part must be {', '.join(PARTS)} or all: got {part!r}{did_you_mean(part, (*PARTS, 'all'))}")
    shares = np.array([getattr(split, name) for name in PARTS])
    if shares[PARTS.index(part)] == 0:
        raise MitsonarError(f"the split by {split.by} has no {part} part: {_format_shares(split)}; give another split")
    unit = world if split.by == "scene" else sequence
    numbers = np.unique(unit)
    counts = _part_sizes(len(numbers), shares)
    if (counts[shares > 0] == 0).any():
        raise MitsonarError(
            f"the data set has {len(numbers)} different {split.by}{'s' * (len(numbers) > 1)}, too few for "
            f"{_format_shares(split)}: make more, give another split, or read part 'all'"
        )
    shuffled = numbers[np.random.default_rng([split.seed, 6]).permutation(len(numbers))]
    ends = np.cumsum(counts)
    index = PARTS.index(part)
    return np.isin(unit, shuffled[ends[index] - counts[index] : ends[index]])


def samples_in_part(sequence: NDArray[np.int32], split: Split, part: str) -> NDArray[np.bool_]:
    """Return the mask ``(samples,)`` of the samples in a part.

    Samples are assigned to training and validation one by one, so the two parts share sequences. Samples of a sequence have
    the same motion, and consecutive ones share a frame. The test part, if there is one, consists of whole sequences.

    Args:
        sequence: sequence number of each sample ``(samples,)``.
        split: shares of the parts, and the seed.
        part: ``train``, ``validation``, ``test`` or ``all``.

    Raises:
        MitsonarError: as for :func:`deal`.
    """
    # 1. Without a test part, each sample is assigned as if it were a sequence.
    number = np.arange(len(sequence), dtype=np.int32)
    if part not in PARTS or not split.test:
        return frames_in_part(number.astype(np.int64), number, split, part)
    # 2. Otherwise set whole sequences aside for the test, so that it shares no motion with training.
    sequence_split = Split(by="sequence", train=1 - split.test, validation=0.0, test=split.test, seed=split.seed)
    if part == "test":
        return frames_in_part(sequence.astype(np.int64), sequence, sequence_split, part)
    # 3. Assign the remaining samples one by one, with the shares that remain.
    mask = frames_in_part(sequence.astype(np.int64), sequence, sequence_split, "train")
    remaining = 1 - split.test
    sample_split = split.model_copy(
        update={"train": split.train / remaining, "validation": split.validation / remaining, "test": 0.0}
    )
    mask[mask] = frames_in_part(number[mask].astype(np.int64), number[mask], sample_split, part)
    return mask


def _part_sizes(total: int, shares: NDArray[np.float64]) -> NDArray[np.int64]:
    """Divide ``total`` among the parts by their shares; every part with a positive share gets at least one."""
    counts = np.maximum(np.rint(shares * total).astype(np.int64), (shares > 0).astype(np.int64))
    largest = int(shares.argmax())
    counts[largest] = total - (counts.sum() - counts[largest])
    return np.maximum(counts, 0)


def _format_shares(split: Split) -> str:
    """Format the shares of all parts."""
    return ", ".join(f"{name} {getattr(split, name):.0%}" for name in PARTS)


# ---------------- Shape names of the labels


def shape_names_of(store: DataStore) -> tuple[tuple[str, ...], dict[int, NDArray[np.int32]]]:
    """Return the names of all shapes in a data set, and the mapping from each scene's ``shape_id`` to these names.

    The store contains the names of scene files and of recorded frames. Other worlds are rebuilt.

    Returns:
        The names, and for each scene number an array ``(shapes + 1,)`` with the index of each ``shape_id`` among the names,
        and -1 for -1. The mapping is empty if ``shape_id`` is the index in every scene. Both are empty if the names
        are unknown: for recorded frames without them, and for scene files in stores of earlier versions.

    Raises:
        MitsonarError: the stored names are damaged.
    """
    file_names = store.about.get("shape_names")
    scene_names: dict[int, tuple[str, ...]] = {}
    built_names: dict[tuple[str, int], tuple[str, ...]] = {}
    for number, scene in sorted(store.scenes.items()):
        family = None if store.recipe.recorded is not None else store.recipe.family(scene.group)
        if family is None or family.called == "scene":
            if file_names is None:
                return (), {}
            names_of_group = file_names[scene.group] if isinstance(file_names, list) and scene.group < len(file_names) else 0
            if not isinstance(names_of_group, list):
                raise MitsonarError(
                    f"{store.place.url}: the attribute shape_names must list the names of {len(store.recipe.scenes):,} "
                    f"groups of scenes: got {short_repr(file_names)}; it is damaged: make the data set again"
                )
            scene_names[number] = tuple(map(str, names_of_group))
        else:
            key = repr(family), scene.seed if family.seeded else 0
            if key not in built_names:
                built_names[key] = family.build(scene.seed).shape_names
            scene_names[number] = built_names[key]
    names = tuple(dict.fromkeys(name for shapes in scene_names.values() for name in shapes))
    if len(set(map(len, scene_names.values()))) == 1 and len(set(scene_names.values())) == 1:  # all scenes agree
        return next(iter(scene_names.values())), {}
    index_of = {name: index for index, name in enumerate(names)}
    return names, {
        number: np.array([*map(index_of.get, shapes), -1], dtype=np.int32) for number, shapes in scene_names.items()
    }
