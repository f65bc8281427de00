"""A data set on disk or in object storage: one Zarr v3 group, written shard by shard (docs/guides/data-sets.md)."""

from __future__ import annotations

import contextlib
import hashlib
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec, ZstdCodec

from mitsonar.config.data_recipe import Recipe, recipe_from
from mitsonar.datasets.modalities import modality_of
from mitsonar.datasets.modality import Modality, StoredArray, StoredAxis
from mitsonar.datasets.plan import Plan, Scene
from mitsonar.errors import MitsonarError
from mitsonar.io.plain_data import check_plain, finite_number, whole_number
from mitsonar.io.provenance import other_versions
from mitsonar.io.storage import Storage
from mitsonar.records.columns import FEW_ROWS, rows_that_fit

__all__ = ["DECIDING", "FORMAT", "PACKAGES", "DataStore"]

FORMAT = 1
"""Version of what docs/guides/data-sets.md describes."""

SHARD_BYTES = 32 * 2**20
"""Of what is recorded in a shard, about: what a worker holds, and what a kill may cost."""

MOST_FRAMES = 10**9
"""Of a data set."""

SEAL = "seal"

PACKAGES = ("mitsonar", "mitsuba", "drjit", "numpy", "finufft", "zarr")
"""Packages whose versions are kept."""

DECIDING = PACKAGES[:3]
"""Packages whose versions decide what is recorded."""


@dataclass(frozen=True)
class Layout:
    """How frames are cut into files.

    Attributes:
        chunk: frames that are compressed together: a sequence, where sequences are short.
        shard: frames of one file, the unit of work.
    """

    chunk: int
    shard: int

    @classmethod
    def of(cls, recipe: Recipe, plan: Plan) -> Layout:
        """Chunks that hold whole short sequences; shards of some 32 MiB, of one scene if possible."""
        pings = recipe.flight.pings if recipe.flight.kind == "random" else 10
        chunk = pings if pings <= 10 else 10
        each = modality_of(recipe).ping_bytes
        scenes = np.bincount(plan.scene)
        wanted = max(1, min(SHARD_BYTES // each, int(scenes.max())) // chunk)
        # where scenes allow it, shards end with them: a shard of two scenes loads both
        whole = int(np.gcd.reduce(scenes[scenes > 0])) // chunk
        aligned = max((n for n in range(1, wanted + 1) if whole % n == 0), default=1) if whole else 1
        return cls(chunk, chunk * (aligned if 3 * aligned >= wanted else wanted))


class DataStore:
    """One data set. :meth:`create` makes an empty one, :meth:`open` finds one that is there.

    Attributes:
        place: where it lies.
        group: the Zarr group.
        recipe: what it is.
        recording: what its instrument records.
    """

    def __init__(self, place: Storage, group: zarr.Group) -> None:
        self.place, self.group = place, group
        self._arrays: dict[str, zarr.Array] = {}
        self.recipe = recipe_from(dict(group.attrs["recipe"]))  # type: ignore[arg-type, call-overload]
        self.modality: Modality = modality_of(self.recipe)

    @classmethod
    def create(cls, place: Storage, recipe: Recipe, plan: Plan, about: dict[str, Any]) -> DataStore:
        """An empty store with all that is known before rendering; what an earlier try left is written anew.

        ``about`` is kept in the attributes; it holds at least what the recording says is settled.
        """
        layout = Layout.of(recipe, plan)
        attributes = {
            "format": FORMAT,
            "kind": "mitsonar data set",
            "recipe": recipe.model_dump(mode="json"),
            "frames": len(plan),
            "sequences": int(plan.sequence[-1]) + 1,
            "chunk_frames": layout.chunk,
            "shard_frames": layout.shard,
            **modality_of(recipe).attributes,
            "scenes": [vars(scene) for scene in plan.scenes],
            "ready": False,
            "finished": False,
            **about,
        }
        if "zarr.json" in place.sizes():
            group = zarr.open_group(place.store(write=True), mode="r+", zarr_format=3)
            group.attrs.put(attributes)
        else:  # in one write: a group without its attributes is nobody's
            group = zarr.create_group(place.store(write=True), zarr_format=3, attributes=attributes)
        store = cls(place, group)
        store._create_arrays(plan, layout)
        group.attrs.put(attributes | {"ready": True})
        return store

    @classmethod
    def open(cls, url: str | Path | Storage, *, write: bool = False, unfinished: bool = False) -> DataStore:
        """The store at a path or URL.

        Args:
            url: path or URL.
            write: shards will be written.
            unfinished: one that is not finished will do.

        Raises:
            MitsonarError: nothing there, not a data set of mitsonar, or one that is not finished.
        """
        place = url if isinstance(url, Storage) else Storage(url)
        try:
            group = zarr.open_group(place.store(write=write), mode="r+" if write else "r", zarr_format=3)
            attributes: dict[str, Any] = dict(group.attrs)
            ours = attributes.get("kind") == "mitsonar data set"
            known = attributes.get("format")
            check_plain(attributes, "its zarr.json")
        except Exception as error:  # a damaged file or a storage that does not answer: whatever it leads to
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            raise MitsonarError(f"no data set at {place.url}: {reason}; give what `mitsonar dataset make` wrote") from None
        if not ours:
            raise MitsonarError(f"{place.url} is a Zarr group but no data set of mitsonar")
        if known != FORMAT:
            raise MitsonarError(
                f"{place.url} has format {known}, this mitsonar reads {FORMAT}: use the version that made it"
            )
        try:
            store = cls(place, group)
            _check_attributes(attributes, store.recipe, store.modality)
            store.scenes  # noqa: B018
            if store.ready:
                store._check_rows()
        except Exception as error:  # attributes lead to whatever their bytes do
            raise MitsonarError(
                f"the attributes of {place.url} are damaged ({type(error).__name__}: {error}): remove it and make it again"
            ) from None
        if not unfinished and not store.finished:
            raise MitsonarError(
                f"{place.url} is not finished: run the same `mitsonar dataset make` again, it goes on where it stopped"
            )
        return store

    # ---------------------------------------------------------------- what it holds

    @property
    def about(self) -> dict[str, Any]:
        """The attributes."""
        return dict(self.group.attrs)

    @property
    def ready(self) -> bool:
        """Whether all arrays were made."""
        return bool(self.group.attrs.get("ready"))

    @property
    def finished(self) -> bool:
        """Whether every shard was written."""
        return bool(self.group.attrs.get("finished"))

    def __len__(self) -> int:
        return int(self.group.attrs["frames"])  # type: ignore[arg-type]

    @cached_property
    def scenes(self) -> dict[int, Scene]:
        """The scenes by number."""
        return {int(fields["number"]): Scene(**fields) for fields in self.about["scenes"]}

    def array(self, name: str) -> zarr.Array:
        """An array by its name."""
        if name not in self._arrays:  # the group would read its metadata again each time
            try:
                with zarr.config.set({"array.write_empty_chunks": True}):  # a file that is not there is a shard not made
                    found = self.group[name]
            except Exception as error:  # no metadata, or bytes that are none
                raise MitsonarError(
                    f"{self.place.url}/{name}/zarr.json is damaged or gone ({type(error).__name__}): remove the data set "
                    "and make it again"
                ) from None
            if not isinstance(found, zarr.Array):
                raise MitsonarError(f"{self.place.url}/{name} is no array: remove the data set and make it again")
            self._check_array(name, found)
            self._arrays[name] = found
        return self._arrays[name]

    def read(self, name: str, index: Any = ...) -> NDArray[Any]:
        """Values of an array.

        Raises:
            MitsonarError: bytes are damaged.
        """
        array = self.array(name)
        try:
            values = np.asarray(array[index])
        except Exception as error:  # damaged bytes raise whatever they lead to
            reason = " ".join(str(error).split())[:160] or type(error).__name__
            raise MitsonarError(
                f"{self.place.url}: {name} is damaged ({reason}); `mitsonar dataset check` tells where, "
                "`mitsonar dataset make --verify` mends it"
            ) from None
        most = {"sequence": int(self.about["sequences"]) - 1, "scene": max(self.scenes)}.get(name)
        if values.size and most is not None and not (values.min() >= 0 and values.max() <= most):
            raise MitsonarError(
                f"{self.place.url}: {name} is damaged (numbers are 0..{most}, got {values.min()}..{values.max()}); "
                "`mitsonar dataset make --verify` mends it"
            )
        if name in ("pose", "vehicle_pose", "time_s") and not np.isfinite(values).all():
            raise MitsonarError(
                f"{self.place.url}: {name} is damaged (nan or inf); `mitsonar dataset make --verify` mends it"
            )
        return values

    def _check_rows(self) -> None:
        """That the frames promised are no more than the bytes of their poses, motions or times can hold.

        Raises:
            ValueError: they are.
        """
        if len(self) <= FEW_ROWS:
            return
        stored = 0
        for key in ("pose/c/0/0", "motion/c/0/0", "time_s/c/0"):
            with contextlib.suppress(OSError):
                stored = max(stored, int(self.place.fs.size(f"{self.place.root}/{key}") or 0))
        if len(self) > rows_that_fit(stored):
            raise ValueError(f"{len(self):,} frames are more than the {stored:,} bytes of their poses can hold")

    def _check_array(self, name: str, found: zarr.Array) -> None:
        """That an array has the type, the shape and the pieces that the recipe gives it.

        Raises:
            MitsonarError: it has others.
        """
        wanted = self._wanted.get(name)
        if wanted is None:
            return
        shape, kind = wanted
        pieces = found.shards or found.chunks
        whole = (self.shard_frames, *shape[1:]) if name in self.rendered else (1, *shape[1:]) if name == SEAL else shape
        fits = all(piece > 0 for piece in found.chunks) and tuple(pieces) == whole
        if found.shape != shape or found.dtype.kind != np.dtype(kind).kind or not fits:
            raise MitsonarError(
                f"{self.place.url}/{name} is {found.dtype} {str(found.shape)[:60]} in pieces of {str(pieces)[:60]}, not "
                f"{kind} {shape} in pieces of {whole}: it is damaged; remove the data set and make it again"
            )

    @cached_property
    def _wanted(self) -> dict[str, tuple[tuple[int, ...], Any]]:
        """Shape and type of each array."""
        frames = len(self)
        table = {name: ((frames, *one.shape), one.kind) for name, one in self.modality.stored.items()}
        table |= {name: (axis.values.shape, axis.values.dtype) for name, axis in self.modality.axes.items()}
        widths = {"pose": 6, "vehicle_pose": 6, "motion": 3, "velocity": 4}
        table |= {name: ((frames, width), np.dtype(np.float64)) for name, width in widths.items()}
        table |= {"time_s": ((frames,), np.dtype(np.float64))}
        table |= {name: ((frames,), np.dtype(np.int32)) for name in ("scene", "sequence")}
        return table | {SEAL: ((self.shards, len(self.rendered), 2), np.dtype(np.uint64))}

    # ---------------------------------------------------------------- shards

    @property
    def shard_frames(self) -> int:
        """Frames of a shard."""
        return int(self.group.attrs["shard_frames"])  # type: ignore[arg-type]

    @property
    def shards(self) -> int:
        """How many there are."""
        return -(-len(self) // self.shard_frames)

    def frames_of(self, shard: int) -> slice:
        """The frames of a shard."""
        return slice(shard * self.shard_frames, min((shard + 1) * self.shard_frames, len(self)))

    @cached_property
    def rendered(self) -> list[str]:
        """Arrays that are written shard by shard."""
        return list(self.modality.stored)

    def key(self, name: str, shard: int) -> str:
        """The file of one array and shard."""
        array = self.array(name)
        return f"{name}/{array.metadata.encode_chunk_key((shard, *(0,) * (array.ndim - 1)))}"  # type: ignore[union-attr]

    def write_shard(self, shard: int, values: dict[str, NDArray[Any]]) -> None:
        """Write all arrays of a shard, then its seal: sizes and digests of the files."""
        for name in self.rendered:
            self.place.remove(self.key(name, shard))  # Zarr would read a damaged shard before it writes over it
            self.array(name)[self.frames_of(shard)] = values[name]
        self.seal(shard)

    def seal(self, shard: int) -> None:
        """Record sizes and digests of a shard's files, as they are: the shard is done."""
        contents = [self.place.read(self.key(name, shard)) for name in self.rendered]
        rows = [(len(content), digest(content)) for content in contents]
        self.array(SEAL)[shard] = np.array(rows, dtype=np.uint64)

    def seals(self) -> NDArray[np.uint64]:
        """Sizes and digests ``(shards, arrays, 2)``; zeros where a shard is not done."""
        return np.asarray(self.read(SEAL), dtype=np.uint64)

    def missing(self, *, verify: bool = False) -> list[int]:
        """Shards that are not written, or not as they were written; what reads whole but lacks its seal gets one.

        Args:
            verify: compare digests too, which reads everything; otherwise sizes.
        """
        sizes, seals = self.place.sizes(), self.seals()
        lacking = []
        for shard in range(self.shards):
            keys = [self.key(name, shard) for name in self.rendered]
            found = np.array([sizes.get(key, -1) for key in keys])
            if (found < 0).any():
                lacking.append(shard)
            elif not seals[shard].any():  # stopped between the last file and the seal
                if self._reads_whole(shard):
                    self.seal(shard)
                else:
                    lacking.append(shard)
            elif (found != seals[shard, :, 0]).any() or (verify and self.damaged(shard, seals[shard])):
                lacking.append(shard)
        return lacking

    def damaged(self, shard: int, seal: NDArray[np.uint64]) -> list[str]:
        """Files of a shard that are not what was sealed."""
        wrong = []
        for name, (_, wanted) in zip(self.rendered, seal, strict=True):
            try:
                content = self.place.read(self.key(name, shard))
            except OSError:
                content = b""
            if digest(content) != int(wanted):
                wrong.append(self.key(name, shard))
        return wrong

    def _reads_whole(self, shard: int) -> bool:
        """Whether all checksums within the files hold."""
        try:
            for name in self.rendered:
                self.read(name, self.frames_of(shard))
        except MitsonarError:
            return False
        return True

    def finish(self) -> None:
        """Mark it as finished: every shard is there."""
        self.group.attrs["finished"] = True

    def unfinish(self) -> None:
        """Mark it as not finished: shards will be written again."""
        if self.finished:
            self.group.attrs["finished"] = False

    # ---------------------------------------------------------------- making the arrays

    def _create_arrays(self, plan: Plan, layout: Layout) -> None:
        for name, stored in self.modality.stored.items():
            # numbers of a shard's pings are small: one chunk
            self._array(name, len(plan), stored, layout if len(stored.shape) > 0 else Layout(layout.shard, 0))
        for name, axis in self.modality.axes.items():
            self._axis(name, axis)
        for name, values in planned(plan, self.modality).items():
            self._planned(name, values)
        shape = (self.shards, len(self.rendered), 2)
        seal = self.group.create_array(
            SEAL,
            shape=shape,
            chunks=(1, *shape[1:]),
            dtype="uint64",
            compressors=None,
            fill_value=0,
            overwrite=True,
            dimension_names=("shard", "stored", "two"),
        )
        seal.attrs.put({"about": TEXTS[SEAL], "arrays": self.rendered})

    def _axis(self, name: str, axis: StoredAxis) -> None:
        """An array along a dimension."""
        self._known(name, axis.values, (axis.dim,), axis.about)

    def _array(self, name: str, frames: int, stored: StoredArray, layout: Layout) -> None:
        """An array that is rendered: shards of compressed chunks with checksums (or plain chunks where a shard is 0)."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # checksums of v3 are not in every reader
            self.group.create_array(
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

    def other_versions(self) -> list[str]:
        """Packages that decide what is recorded and are not here what the store was begun with."""
        return other_versions(self.about["versions"], (*DECIDING, *self.modality.decided_by))

    def unplanned(self, plan: Plan) -> list[str]:
        """Arrays that the plan decides and that do not hold it (to 1e-9: processors differ in last bits)."""
        wrong = []
        for name, values in planned(plan, self.modality).items():
            try:
                there = self.read(name)
                same = there.shape == values.shape and np.allclose(there, values, rtol=0, atol=1e-9, equal_nan=True)
            except MitsonarError:
                same = False
            if not same:
                wrong.append(name)
        return wrong

    def mend_known(self, plan: Plan) -> None:
        """Write again what the plan decides and what is damaged of it."""
        for name in self.unplanned(plan):
            self._arrays.pop(name, None)
            self._planned(name, planned(plan, self.modality)[name])

    def _planned(self, name: str, values: NDArray[Any]) -> None:
        inner = {"pose": ("six",), "vehicle_pose": ("six",), "motion": ("three",), "velocity": ("four",)}
        self._known(name, values, ("frame", *inner.get(name, ())), TEXTS[name])

    def _known(self, name: str, values: NDArray[Any], dims: tuple[str, ...], text: str) -> None:
        """An array whose values are known from the start, in one piece."""
        array = self.group.create_array(
            name,
            shape=values.shape,
            chunks=values.shape,
            dtype=values.dtype,
            fill_value=0,
            dimension_names=dims,
            attributes={"about": text},
            overwrite=True,
        )
        with zarr.config.set({"array.write_empty_chunks": True}):
            array[...] = values


def _check_attributes(about: dict[str, Any], recipe: Recipe, modality: Modality) -> None:
    """The numbers of a store, against each other and its recipe.

    Raises:
        MitsonarError, KeyError, ValueError: a number that cannot be.
    """
    sequences = whole_number(about["sequences"], "sequences", 1, recipe.sequences)
    most = MOST_FRAMES
    if recipe.flight.kind == "random":
        most = sequences * recipe.flight.pings
        whole_number(about["frames"], "frames", most, most)
    frames = whole_number(about["frames"], "frames", 1, min(most, MOST_FRAMES))
    shard = whole_number(about["shard_frames"], "shard_frames", 1, MOST_FRAMES)
    if shard % whole_number(about["chunk_frames"], "chunk_frames", 1, shard):
        raise ValueError("shard_frames is no multiple of chunk_frames")
    total, numbers = 0, set()
    for scene in about["scenes"]:
        numbers.add(whole_number(scene["number"], "number of a scene", 0, 2**31))
        whole_number(scene["group"], "group of a scene", 0, len(recipe.scenes) - 1)
        whole_number(scene["seed"], "seed of a scene", 0, 2**64)
        total += whole_number(scene["sequences"], "sequences of a scene", 1, sequences)
    if total != sequences or len(numbers) != len(about["scenes"]):
        raise ValueError(f"scenes have {total:,} sequences, {sequences:,} are promised for {frames:,} frames")
    for name in modality.settled:
        finite_number(about[name], name, above=0)
    versions = about["versions"]
    if not (isinstance(versions, dict) and isinstance(about["variant"], str)):
        raise ValueError("versions or variant is something else")
    if not all(type(about[name]) is bool for name in ("ready", "finished")):
        raise ValueError("ready and finished must be true or false")


def planned(plan: Plan, modality: Modality) -> dict[str, NDArray[Any]]:
    """What the plan says of each frame."""
    known: dict[str, NDArray[Any]] = {"pose": plan.poses, "motion": plan.motion, "time_s": plan.time_s}
    known |= {"scene": plan.scene, "sequence": plan.sequence}
    if not np.array_equal(plan.poses[:, [0, 1, 2, 5]], plan.vehicle[:, [0, 1, 2, 5]]):
        known["vehicle_pose"] = plan.vehicle
    return known | {name: getattr(plan, name) for name in modality.planned}


def digest(content: bytes) -> int:
    """64 bits of BLAKE2b."""
    return int.from_bytes(hashlib.blake2b(content, digest_size=8).digest(), "little")


TEXTS = {
    "pose": "sonar: x, y, z [m], pitch, roll, heading [rad]",
    "vehicle_pose": "vehicle: x, y, z [m], pitch, roll, heading [rad]; motion is the vehicle's",
    "motion": "to the next frame of the sequence: sideways, forward [m], yaw [rad]; nan for its last",
    "velocity": "of the vehicle in its own axes: starboard, forward, up [m/s], turn to starboard [rad/s]",
    "time_s": "since the sequence began [s]",
    "scene": "number of the scene",
    "sequence": "number of the sequence",
    SEAL: "bytes and BLAKE2b-64 of each file of a shard, written when the shard is done",
}
