"""A data set on disk or in object storage: one Zarr v3 group, written shard by shard (docs/guides/data-sets.md)."""

from __future__ import annotations

import contextlib
import hashlib
from functools import cached_property
from pathlib import Path
from types import EllipsisType
from typing import Any, TypeAlias

import numpy as np
import zarr
from numpy.typing import NDArray

from mitsonar.config.data import Recipe, recipe_from
from mitsonar.datasets.modalities import modality_of
from mitsonar.datasets.modality import Fields, Modality, Values
from mitsonar.datasets.plan import Plan, Scene
from mitsonar.datasets.store_arrays import SEAL, ShardLayout, create_arrays, planned_arrays, write_planned
from mitsonar.datasets.store_attributes import check_attributes
from mitsonar.errors import MitsonarError, shortened
from mitsonar.io.files import check_plain
from mitsonar.io.runs import other_versions
from mitsonar.io.storage import Storage, refuse_codecs
from mitsonar.records.frames import FEW_ROWS, rows_that_fit

__all__ = ["DECIDING", "FORMAT", "PACKAGES", "DataStore"]

FORMAT = 1
"""Version of what docs/guides/data-sets.md describes."""

PACKAGES = ("mitsonar", "mitsuba", "drjit", "numpy", "finufft", "zarr")
"""Packages whose versions a store names."""

DECIDING = PACKAGES[:3]
"""Packages whose versions decide what is recorded."""

Kind: TypeAlias = np.dtype[Any]
"""The type of an array, whatever it holds."""


class DataStore:
    """One data set. :meth:`create` makes an empty store, :meth:`open` opens an existing one.

    Attributes:
        place: its storage.
        group: the Zarr group.
        recipe: of the data set.
        modality: what its instrument records.
    """

    def __init__(self, storage: Storage, group: zarr.Group) -> None:
        self.place, self.group = storage, group
        self._arrays: dict[str, zarr.Array[Any]] = {}
        self.recipe = recipe_from(dict(self.about["recipe"]))
        self.modality: Modality = modality_of(self.recipe)

    @classmethod
    def create(cls, storage: Storage, recipe: Recipe, plan: Plan, about: Fields) -> DataStore:
        """Create an empty store with all that is known before rendering.

        An unfinished attempt that lies there is overwritten.

        Args:
            storage: where the store shall lie.
            recipe: of the data set.
            plan: all its frames.
            about: further attributes, at least those that the modality calls ``settled``.
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
        else:  # in one write: a group without its attributes is nobody's
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
            unfinished: whether a store that is not finished is accepted.

        Raises:
            MitsonarError: nothing there, not a data set of mitsonar, damaged, or not finished.
        """
        storage = url if isinstance(url, Storage) else Storage(url)
        try:
            group = zarr.open_group(storage.store(write=write), mode="r+" if write else "r", zarr_format=3)
            attributes: Fields = dict(group.attrs)
            ours = attributes.get("kind") == "mitsonar data set"
            known = attributes.get("format")
            check_plain(attributes, "its zarr.json")
        except Exception as error:  # a damaged file, or a storage that does not answer, may raise anything
            nothing = isinstance(error, zarr.errors.GroupNotFoundError)
            reason = "it is no Zarr group" if nothing else " ".join(str(error).split())[:200] or type(error).__name__
            raise MitsonarError(
                f"no data set at {storage.url}: {reason}; give what `mitsonar dataset make` or `dataset from-frames` wrote"
            ) from None
        if not ours:
            kind = shortened(attributes.get("kind"))
            raise MitsonarError(
                f"{storage.url} is no data set of mitsonar, but a Zarr group of the kind {kind}: give what `mitsonar "
                "dataset make` or `dataset from-frames` wrote"
            )
        if known != FORMAT:
            raise MitsonarError(
                f"{storage.url} has format {shortened(known)}, this mitsonar reads {FORMAT}: use the version that made it"
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
                f"{storage.url} is not finished, and only a whole data set is read: run the same `mitsonar dataset make` "
                "again, it continues where it stopped"
            )
        return store

    def __repr__(self) -> str:
        state, sequences = "" if self.finished else ", not finished", int(self.about["sequences"])
        return f"DataStore({len(self):,} frames in {sequences:,} sequences, {self.recipe.name}{state}: {self.place.url})"

    # ---------------------------------------------------------------- reading

    @property
    def about(self) -> Fields:
        """Return the attributes, by name."""
        return dict(self.group.attrs)

    @property
    def ready(self) -> bool:
        """Return whether all arrays were created."""
        return bool(self.group.attrs.get("ready"))

    @property
    def finished(self) -> bool:
        """Return whether every shard was written."""
        return bool(self.group.attrs.get("finished"))

    def __len__(self) -> int:
        return int(self.about["frames"])

    @cached_property
    def scenes(self) -> dict[int, Scene]:
        """Return the scenes, by number."""
        return {int(fields["number"]): Scene(**fields) for fields in self.about["scenes"]}

    def array(self, name: str) -> zarr.Array[Any]:
        """Return an array by its name.

        Raises:
            MitsonarError: its metadata is damaged or gone, or it has another type, shape or layout than the recipe gives.
        """
        if name not in self._arrays:  # the group would read the metadata anew each time
            try:
                with zarr.config.set({"array.write_empty_chunks": True}):  # a missing file is a missing shard
                    found = self.group[name]
                if isinstance(found, zarr.Array):
                    refuse_codecs(found)
            except Exception as error:  # no metadata, or damaged ones
                raise MitsonarError(
                    f"{self.place.url}/{name}/zarr.json is damaged or gone ({type(error).__name__}): remove the data set "
                    "and make it again"
                ) from None
            if not isinstance(found, zarr.Array):
                raise MitsonarError(f"{self.place.url}/{name} is no array: remove the data set and make it again")
            self._check_array(name, found)
            self._arrays[name] = found
        return self._arrays[name]

    def read(self, name: str, index: int | slice | EllipsisType = ...) -> Values:
        """Read the values of an array: all, those of a frame, or those of a slice of frames.

        Raises:
            MitsonarError: the bytes are damaged, or the values cannot be.
        """
        array = self.array(name)
        try:
            values = np.asarray(array[index])
        except Exception as error:  # damaged bytes may raise anything
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
        """Check that the bytes of poses, motions or times can hold as many frames as the attributes promise.

        Raises:
            ValueError: they cannot.
        """
        if len(self) <= FEW_ROWS:
            return
        stored = 0
        for key in ("pose/c/0/0", "motion/c/0/0", "time_s/c/0"):
            with contextlib.suppress(OSError):
                stored = max(stored, int(self.place.fs.size(f"{self.place.root}/{key}") or 0))
        if len(self) > rows_that_fit(stored):
            raise ValueError(f"{len(self):,} frames are more than the {stored:,} bytes of their poses can hold")

    def _check_array(self, name: str, found: zarr.Array[Any]) -> None:
        """Check that an array has the type, the shape and the pieces that the recipe gives it.

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
    def _wanted(self) -> dict[str, tuple[tuple[int, ...], Kind]]:
        """Return shape and type of each array, by name."""
        frames = len(self)
        table: dict[str, tuple[tuple[int, ...], Kind]] = {}
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
        """Return the number of frames of a shard; the last shard may hold fewer."""
        return int(self.about["shard_frames"])

    @property
    def shards(self) -> int:
        """Return the number of shards."""
        return -(-len(self) // self.shard_frames)

    def frames_of(self, shard: int) -> slice:
        """Return the frames of a shard, as numbered in the store."""
        return slice(shard * self.shard_frames, min((shard + 1) * self.shard_frames, len(self)))

    @cached_property
    def rendered(self) -> list[str]:
        """Return the names of the arrays that are written shard by shard."""
        return list(self.modality.stored)

    def key(self, name: str, shard: int) -> str:
        """Return the file of one array and shard, relative to the store."""
        array = self.array(name)
        return f"{name}/{array.metadata.encode_chunk_key((shard, *(0,) * (array.ndim - 1)))}"

    def write_shard(self, shard: int, values: dict[str, Values]) -> None:
        """Write all arrays of a shard by name, then its seal: sizes and digests of the files."""
        for name in self.rendered:
            self.place.remove(self.key(name, shard))  # Zarr would read a damaged shard before it overwrites it
            self.array(name)[self.frames_of(shard)] = values[name]
        self.seal(shard)

    def seal(self, shard: int) -> None:
        """Record sizes and digests of a shard's files as they are. The shard is then done."""
        contents = [self.place.read(self.key(name, shard)) for name in self.rendered]
        rows = [(len(content), digest(content)) for content in contents]
        self.array(SEAL)[shard] = np.array(rows, dtype=np.uint64)

    def seals(self) -> NDArray[np.uint64]:
        """Read sizes and digests of all files ``(shards, arrays, 2)``; zeros where a shard is not done."""
        return np.asarray(self.read(SEAL), dtype=np.uint64)

    def missing(self, *, verify: bool = False) -> list[int]:
        """Find the shards that are not written or that have changed. A whole shard without a seal is sealed.

        In a store that is open for reading only, a shard without a seal counts as missing.

        Args:
            verify: whether digests are compared, too, which reads everything; otherwise only sizes.
        """
        sizes, seals = self.place.sizes(), self.seals()
        lacking = []
        for shard in range(self.shards):
            keys = [self.key(name, shard) for name in self.rendered]
            found = np.array([sizes.get(key, -1) for key in keys])
            if (found < 0).any():
                lacking.append(shard)
            elif not seals[shard].any():  # stopped between the last file and the seal
                if not self.group.read_only and self._reads_whole(shard):
                    self.seal(shard)
                else:
                    lacking.append(shard)
            elif (found != seals[shard, :, 0]).any() or (verify and self.damaged(shard, seals[shard])):
                lacking.append(shard)
        return lacking

    def damaged(self, shard: int, seal: NDArray[np.uint64]) -> list[str]:
        """Find the files of a shard whose digest is not the sealed one."""
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
        """Return whether all checksums within the files of a shard hold."""
        try:
            for name in self.rendered:
                self.read(name, self.frames_of(shard))
        except MitsonarError:
            return False
        return True

    def finish(self) -> None:
        """Mark the store as finished: every shard is there."""
        self.group.attrs["finished"] = True

    def unfinish(self) -> None:
        """Mark the store as not finished: shards will be rewritten."""
        if self.finished:
            self.group.attrs["finished"] = False

    def other_versions(self) -> list[str]:
        """List the packages that decide what is recorded and whose version here is not the one of the store."""
        return other_versions(self.about["versions"], (*DECIDING, *self.modality.decided_by))

    def unplanned(self, plan: Plan) -> list[str]:
        """List the planned arrays that do not hold the plan to 1e-9; processors differ in last bits."""
        wrong = []
        for name, values in planned_arrays(plan, self.modality).items():
            try:
                there = self.read(name)
                same = there.shape == values.shape and np.allclose(there, values, rtol=0, atol=1e-9, equal_nan=True)
            except MitsonarError:
                same = False
            if not same:
                wrong.append(name)
        return wrong

    def mend_known(self, plan: Plan) -> None:
        """Rewrite the planned arrays that are damaged."""
        for name in self.unplanned(plan):
            self._arrays.pop(name, None)
            write_planned(self.group, name, planned_arrays(plan, self.modality)[name])


def digest(content: bytes) -> int:
    """Compute 64 bits of BLAKE2b."""
    return int.from_bytes(hashlib.blake2b(content, digest_size=8).digest(), "little")
