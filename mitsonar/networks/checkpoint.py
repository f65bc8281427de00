"""How a trained network is saved in a self-contained file: weights, input, labels, sonar, training and accuracy."""

from __future__ import annotations

import hashlib
import importlib.util
import io
import json
import logging
import math
import os
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeAlias, TypeGuard

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator
from torch import Tensor, nn

from mitsonar.config.data import Recipe, Split
from mitsonar.datasets.arrangement import Coordinates, LabelKind, Labels, Layout
from mitsonar.datasets.modality import Fields
from mitsonar.datasets.plan import scenes_of
from mitsonar.datasets.sample_index import first_frames, split_for
from mitsonar.datasets.samples import Batches, ground_at
from mitsonar.datasets.store import DataStore, world_numbers
from mitsonar.errors import MitsonarError, did_you_mean, short_repr, validation_message
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import sonar_from
from mitsonar.io.files import check_plain_value, read_bytes, write_atomic
from mitsonar.motion.errors import AXES
from mitsonar.networks.corrnet import GaussianHead
from mitsonar.networks.create import NETWORKS, create_network
from mitsonar.networks.shipped import SHIPPED, shipped_path

if TYPE_CHECKING:
    from mitsonar.datasets.responses import ImpulseSamples
    from mitsonar.datasets.samples import SonarPairs

__all__ = ["FILE", "Checkpoint", "to_onnx"]

FORMAT = 1
"""Version of the file format. A reader accepts only this version."""

KIND = "mitsonar checkpoint"
"""Value of the field ``kind``, which identifies a checkpoint."""

LARGEST_OPTION = 1_000_000
"""Largest valid number among the options of a network, such as sizes, channels and layers."""

FEW_WEIGHTS = 10_000_000
"""Number of weights that may be allocated without comparing it with the number in the file."""

Plain: TypeAlias = "str | bool | int | float | list[Plain] | dict[str, Plain] | None"
"""Type of every value in a file except weights."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A trained network and everything that is needed to use it.

    Attributes:
        network: its name, for :func:`~mitsonar.networks.create.create_network`.
        options: of the network.
        weights: its state, on the CPU.
        arrangement: of its input: the options of :class:`~mitsonar.datasets.samples.SonarPairs`.
        labels: of its output: kind, low, high, names; see :attr:`coder`.
        sonar: fields of the sonar of each view, keyed by view; empty if the network works with any sonar.
        trained_at: geometry of the sonar in training: ``height_m`` [low, high] above z = 0, ``pitch_deg``, ``roll_deg``.
        model: ``thesis``, ``physical`` or ``coherent``; for several data sets all of them: ``coherent and physical``.
        noise: of training, as text.
        data: name of the data set's recipe, or names of all recipes.
        data_recipe: that recipe, or the first one.
        recipe: of the training.
        metrics: of validation, keyed by noise level: ``{"none": {"rmse": [sideways mm, forward mm, yaw deg], "pairs":
            500}}``; for heights rmse is ``[mm]``.
        trained: number of pairs, minutes, epochs, seed ...; and ``sequences``, the number of each data set, keyed by the
            digest of its recipe.
        version: of the mitsonar that wrote the file.
        format: :data:`FORMAT`.
    """

    network: str
    options: Fields
    weights: dict[str, Tensor] = field(repr=False)
    arrangement: Fields
    labels: Fields
    sonar: dict[str, Fields]
    trained_at: Fields
    model: str
    noise: str
    data: str
    data_recipe: Fields = field(default_factory=dict)
    recipe: Fields = field(default_factory=dict)
    metrics: Fields = field(default_factory=dict)
    trained: Fields = field(default_factory=dict)
    version: str = field(default_factory=lambda: version("mitsonar"))
    format: int = FORMAT

    @classmethod
    def of(cls, network: nn.Module, samples: Batches, **about: object) -> Self:
        """Make the checkpoint of a network of :data:`~mitsonar.networks.create.NETWORKS` in its current state.

        Args:
            network: network whose weights are copied.
            samples: samples on which it was trained. They define input, labels, sonar, geometry and noise.
            about: further fields: recipe, metrics, trained; and noise, if it is not that of the samples.

        Raises:
            MitsonarError: the module is not one of these networks, or a value cannot be saved.
        """
        names = [name for name, network_class in NETWORKS.items() if type(network) is network_class]
        if not names:
            raise MitsonarError(
                f"a checkpoint holds one of our networks: got {type(network).__name__}; make it with create_network, or "
                "keep its state_dict yourself"
            )
        recipe, coder, described = samples.recipe, samples.labels, samples.described()
        contents: Fields = {
            "data": recipe.name,
            **described,
            "network": names[0],
            "options": network.options,
            "weights": {name: values.detach().cpu().clone() for name, values in network.state_dict().items()},
            "labels": {"kind": coder.kind, "low": coder.low, "high": coder.high, "names": coder.names},
            "sonar": {} if NETWORKS[names[0]].any_sonar else described["sonar"],
            "data_recipe": recipe.model_dump(mode="json"),
            **about,
        }
        plain: Fields = {key: value if key == "weights" else _plain(value, key) for key, value in contents.items()}
        return cls(**plain)

    def halved(self) -> Self:
        """Return the checkpoint with matrices and filters in half precision, which is about half as large.

        Statistics keep single precision, and :meth:`build` returns a network of single precision.
        """
        weights = {
            name: values.half() if values.is_floating_point() and values.dim() > 1 else values
            for name, values in self.weights.items()
        }
        return replace(self, weights=weights)

    def build(self) -> nn.Module:
        """Build the network with its weights, in evaluation mode, without changing the state of torch's random generator.

        Raises:
            MitsonarError: the network or an option is unknown, or the weights do not fit.
        """
        written = f"the checkpoint was written by mitsonar {self.version[:40]}, this is {version('mitsonar')}"
        self._check_fit(written)
        with torch.random.fork_rng(devices=[]):
            try:
                network = create_network(self.network, **self.options)
            except MitsonarError as error:
                raise MitsonarError(f"{error} ({written})") from None
            except Exception as error:  # invalid options may raise anything
                raise MitsonarError(
                    f"no {self.network} has these options, {short_repr(self.options)}: {_first_line(error)}"
                ) from None
        try:
            network.load_state_dict(self.weights)
        except RuntimeError as error:
            raise MitsonarError(
                f"the weights do not fit a {self.network} with options {short_repr(self.options)}: "
                f"{_mismatch(error)} ({written})"
            ) from None
        return network.eval().requires_grad_(False)

    def _check_fit(self, written: str) -> None:
        """Check that options and weights fit each other before memory is allocated for the network.

        Raises:
            MitsonarError: they do not fit.
        """
        large = [name for name, value in _numbers_in(self.options) if not abs(value) <= LARGEST_OPTION]
        if large:
            raise MitsonarError(
                f"no {self.network} has these options, {short_repr(self.options)}: {large[0]} is beyond {LARGEST_OPTION:,}"
            )
        try:
            with torch.device("meta"), torch.random.fork_rng(devices=[]):
                expected = create_network(self.network, **self.options).state_dict()
        except Exception:  # ``build`` raises it again, with a message
            return
        stored = sum(values.numel() for values in self.weights.values())
        required = sum(values.numel() for values in expected.values())
        if required > 2 * stored + FEW_WEIGHTS:
            raise MitsonarError(
                f"the weights do not fit a {self.network} with options {short_repr(self.options)}: the file has "
                f"{stored:,}, the network {required:,} ({written})"
            )

    # ---------------------------------------------------------------- description

    @property
    def coder(self) -> Labels:
        """Return the encoder and decoder of targets."""
        low, high = (np.array(self.labels[end], dtype=float) for end in ("low", "high"))
        return Labels(self.labels["kind"], low, high, tuple(self.labels["names"]))

    @property
    def sonars(self) -> dict[str, Sonar]:
        """Return the sonar of each view; empty if the network works with any sonar, or on impulse responses."""
        return {} if self.channel else {name: Sonar.create(**fields) for name, fields in self.sonar.items()}

    @property
    def channel(self) -> ChannelSonar | None:
        """Return the instrument of a network on impulse responses; None for images and vectors."""
        return ChannelSonar.create(**self.sonar["channel"]) if self.arrangement["kind"] == "response" else None

    @property
    def fixed(self) -> str:
        """Return the geometry of training as text: ``height 2.5 m, pitch 35 deg``."""
        low, high = self.trained_at["height_m"]
        height = f"{low:g} m" if low == high else f"{low:g}..{high:g} m"
        roll = f", roll {self.trained_at['roll_deg']:g} deg" if self.trained_at["roll_deg"] else ""
        return f"height {height}, pitch {self.trained_at['pitch_deg']:g} deg{roll}"

    @property
    def covariance(self) -> NDArray[np.float64] | None:
        """Return the covariance of a motion [m, m, rad] ``(3, 3)`` from :attr:`rmse`; None if the errors are unknown.

        It serves networks that do not estimate a covariance.
        """
        rmse = self.rmse
        return None if rmse is None or len(rmse) != len(AXES) else np.diag((rmse / [axis.scale for axis in AXES]) ** 2)

    @property
    def rmse(self) -> NDArray[np.float64] | None:
        """Return the RMSE of validation [mm, mm, deg], or of heights [mm]; None if it is unknown.

        It is that at the noise of training if this level was validated, otherwise that over all levels.
        """
        known = {level: scores.get("rmse") for level, scores in self.metrics.items() if isinstance(scores, dict)}
        chosen = [known[self.noise]] if self.noise in known else list(known.values())
        if not chosen or not all(_are_numbers(rmse, len(self.labels["names"])) for rmse in chosen):
            return None
        return np.asarray(np.sqrt((np.array(chosen, dtype=float) ** 2).mean(axis=0)))

    def split_of_training(self, recipe: Recipe) -> Split | None:
        """Return how training split the data set of a recipe; None if the network was trained on other data.

        Raises:
            MitsonarError: the file has no valid split.
        """
        used = self.data_recipe == recipe.model_dump(mode="json") or self._sequences_of_training(recipe) is not None
        if self.trained.get("rendered") or not used:
            return None
        return split_for(self.recipe.get("split"), recipe)

    def _sequences_of_training(self, recipe: Recipe) -> object:
        """Return the number of sequences of a recipe in training; None if it is unknown, as in files of earlier versions."""
        counts = self.trained.get("sequences")
        return counts.get(recipe.digest()) if isinstance(counts, dict) else None

    def learnt(self, samples: SonarPairs | ImpulseSamples) -> NDArray[np.bool_]:
        """Mark the samples ``(samples,)`` of a data set that training may have seen: those whose motions it all used.

        Raises:
            MitsonarError: the file has no valid split.
        """
        split = self.split_of_training(samples.recipe)
        if split is None:
            return np.zeros(len(samples), dtype=bool)
        # 1. First frames of the samples of training: its part of the split, cut to the share of the data that it used.
        fraction, length = self.recipe.get("part_of_data"), self.arrangement["frames"]
        world, sequence, place = _frames_of_training(samples.store, self._sequences_of_training(samples.recipe))
        share = fraction if isinstance(fraction, int | float) else 1.0
        first = first_frames(world, sequence, split, "train", length)
        first = first[first + length <= share * len(sequence)]
        used = np.zeros(len(sequence) + max(length, samples.frames), dtype=bool)  # motions from each frame to the next
        for step in range(max(length - 1, 1)):
            used[first + step] = True
        # 2. A sample counts as seen if training has seen every motion between its frames.
        steps = range(max(samples.frames - 1, 1))
        return np.asarray(np.all([used[place[samples.first] + step] for step in steps], axis=0))

    def decode(self, output: Tensor | GaussianHead) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Decode the output of the network.

        Returns:
            Targets ``(batch, n)`` [m, rad], and their covariances ``(batch, n, n)``, or None if the network estimates none.

        Raises:
            MitsonarError: the shape of the output differs from that of the labels.
        """
        if isinstance(output, GaussianHead):
            mean, covariance = (values.detach().cpu().double().numpy() for values in output)
            return mean, (covariance + covariance.swapaxes(-1, -2)) / 2  # single precision leaves an asymmetry of 1e-8
        names = self.labels["names"]
        if not isinstance(output, Tensor) or output.ndim != 2 or output.shape[1] != len(names):
            got = tuple(output.shape) if isinstance(output, Tensor) else type(output).__name__
            raise MitsonarError(f"the {self.network} returns {got}, its labels are {', '.join(names)}: the file is damaged")
        return self.coder.decode(output.detach().cpu().numpy()), None

    @property
    def digest(self) -> str:
        """Compute the SHA-256 of network, options and weights."""
        total = hashlib.sha256(f"{self.network} {self.options}".encode())
        for name, values in sorted(self.weights.items()):
            total.update(f"{name} {values.dtype} {tuple(values.shape)}".encode())
            total.update(values.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
        return total.hexdigest()

    def rows(self) -> list[tuple[str, str]]:
        """Return a summary as pairs of names and values, for a console."""
        arrangement = self.arrangement
        shape = [arrangement[entry] for entry in ("kind", "layout", "coordinates")] + ["ground"] * arrangement["ground"]
        count = sum(values.numel() for values in self.weights.values())
        options = "".join(f", {key} {value}" for key, value in self.options.items())
        sonars = [
            f"{sonar.name}, {sonar.beams} beams, {sonar.range_bins} bins, {sonar.range_min:g}..{sonar.range_max:g} m"
            for sonar in self.sonars.values()
        ]
        if self.channel is not None:
            received = self.channel
            sonars = [
                f"{received.name}, {received.carrier_hz:g} Hz, {received.bandwidth_hz:g} Hz wide, {received.taps} taps"
            ]
        trained = {name: value for name, value in self.trained.items() if not isinstance(value, dict)}
        spans = zip(self.labels["names"], self.labels["low"], self.labels["high"], strict=True)
        rows = [
            ("network", f"{self.network}{options}"),
            ("weights", f"{count:,}"),
            ("input", f"{arrangement['frames']} frames of {', '.join(arrangement['views'])}: {', '.join(shape)}"),
            ("labels", f"{self.labels['kind']}: " + ", ".join(f"{name} {low:.4g}..{high:.4g}" for name, low, high in spans)),
            ("sonar", "; ".join(dict.fromkeys(sonars)) or "any"),
            ("trained on", f"{self.data}, {self.model} model, noise {self.noise}; {self.fixed}"),
            ("trained for", ", ".join(f"{name} {_number(value)}" for name, value in trained.items()) or "not recorded"),
        ]
        for level, scores in self.metrics.items():
            rmse = scores.get("rmse") if isinstance(scores, dict) else None
            if isinstance(rmse, list) and len(rmse) <= len(AXES) and _are_numbers(rmse, len(rmse)):
                units = [axis.unit for axis in AXES[: len(rmse)]]
                values = " / ".join(f"{value:.3g} {unit}" for value, unit in zip(rmse, units, strict=True))
                rows.append((f"RMSE, noise {level}", f"{values} in validation"))
        return [*rows, ("written by", f"mitsonar {self.version}")]

    # ---------------------------------------------------------------- files

    def to_bytes(self) -> bytes:
        """Return the checkpoint as the bytes of a file."""
        table = {one.name: getattr(self, one.name) for one in fields(self)}
        plain: Fields = {key: value if key == "weights" else _plain(value, key) for key, value in table.items()}
        buffer = io.BytesIO()
        torch.save({"kind": KIND, **plain}, buffer)
        return buffer.getvalue()

    def save(self, path: str | Path) -> None:
        """Write the file atomically: either all of it or nothing."""
        write_atomic(path, self.to_bytes())

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Load a checkpoint from a file, from the folder of a training run, or by name.

        The names are those of the networks that come with mitsonar. Nothing in the file is executed.

        Raises:
            MitsonarError: the file does not exist, is not a checkpoint, is damaged, or has another format.
        """
        path = shipped_path(path) if isinstance(path, str) and path in SHIPPED else Path(path)
        if os.path.isdir(path):
            if not os.path.isfile(path / FILE):
                raise MitsonarError(
                    f"{path} holds no {FILE}: give the folder of a training that has validated once, or a checkpoint"
                )
            path = path / FILE
        if not os.path.exists(path):
            raise MitsonarError(
                f"no checkpoint {path}: give a {FILE}, the folder of `mitsonar train`, or {' or '.join(SHIPPED)}"
                f"{did_you_mean(path, SHIPPED)}"
            )
        content = read_bytes(path, "checkpoint", LARGEST)
        return cls.from_bytes(content, str(path))

    @classmethod
    def from_bytes(cls, content: bytes, source: str = "the checkpoint") -> Self:
        """Load a checkpoint from the bytes that :meth:`to_bytes` returned; errors name ``source``.

        Raises:
            MitsonarError: the bytes are not a checkpoint, are damaged, or have another format.
        """
        table = _unpack(content, source)
        if table.get("kind") != KIND:
            lightning = any(str(key).startswith("pytorch-lightning") for key in table)
            actual = "Lightning's state, from which `mitsonar train --resume` continues" if lightning else "something else"
            raise MitsonarError(f"{source} is not a checkpoint of mitsonar, but {actual}: give a {FILE}")
        if table.get("format") != FORMAT:
            raise MitsonarError(
                f"{source} is a checkpoint of format {short_repr(table.get('format'))}, written by mitsonar "
                f"{str(table.get('version'))[:40]}; this is mitsonar {version('mitsonar')}, which reads format {FORMAT}: "
                "use the version that wrote it, or train again"
            )
        try:
            check_plain_value({name: value for name, value in table.items() if name != "weights"}, "it")
            _Contents.model_validate(table)
        except MitsonarError as error:
            reason = str(error)
        except ValidationError as error:
            reason = validation_message(error, _Contents, "checkpoint")
        else:
            return cls(**{one.name: table[one.name] for one in fields(cls)})
        raise MitsonarError(f"{source} is damaged: {reason}; train again, or use an intact copy")


def _frames_of_training(
    store: DataStore, sequences: object
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int64]]:
    """Return the frames of a training on a data set of this recipe, of which the store may hold more or fewer sequences.

    Args:
        store: data set to evaluate on.
        sequences: number of sequences in training; those of the store if it is unknown.

    Returns:
        World and sequence of each frame of training ``(n,)``, and the number in training of each frame of the store, n for
        frames that training did not have.
    """
    recipe, scene, sequence = store.recipe, store.read("scene"), store.read("sequence")
    if type(sequences) is not int or sequences == store.about["sequences"] or recipe.flight.kind != "random":
        return world_numbers(recipe, store.scenes)[scene], sequence, np.arange(len(scene))
    # Both begin with the same sequences in each scene.
    scenes, pings = {one.number: one for one in scenes_of(recipe, sequences)}, recipe.flight.pings
    place, begin = np.full(len(scene), sequences * pings), 0
    for number, one in scenes.items():
        common = np.flatnonzero(scene == number)[: one.sequences * pings]
        place[common], begin = begin + np.arange(len(common)), begin + one.sequences * pings
    numbers = np.repeat(list(scenes), [one.sequences * pings for one in scenes.values()])
    return world_numbers(recipe, scenes)[numbers], np.repeat(np.arange(sequences, dtype=np.int32), pings), place


def _numbers_in(options: Fields) -> list[tuple[str, float]]:
    """List the numbers in a network's options, including those in lists, each with the name of its option."""
    pairs = [(name, one) for name, value in options.items() for one in (value if isinstance(value, list) else [value])]
    return [(name, one) for name, one in pairs if isinstance(one, int | float)]


def _plain(value: object, name: str) -> Plain:
    """Convert a value to numbers, strings, lists and dictionaries.

    Raises:
        MitsonarError: the value has another type.
    """
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, np.generic | np.ndarray):
        plain: Plain = value.tolist()
        return plain
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, list | tuple):
        return [_plain(one, name) for one in value]
    if isinstance(value, dict):
        return {str(key): _plain(one, name) for key, one in value.items()}
    raise MitsonarError(f"{name} of a checkpoint may hold only numbers, strings, lists and dictionaries: got {value!r}")


def _mismatch(error: RuntimeError) -> str:
    """Return the part of torch's message about the first weight that does not fit."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join((lines[1] if len(lines) > 1 else lines[0]).split())[:300]


def _number(value: object) -> str:
    """Format a number, or any other value, for a console."""
    return f"{value:,.4g}" if isinstance(value, float) else f"{value:,}" if type(value) is int else str(value)


# ---------------- Unpacking and validation of a file


FILE = "network.ckpt"
"""Name of a checkpoint in the folder of a training run."""

LARGEST = 8 * 2**30
"""Largest accepted size of a checkpoint when unpacked [bytes]."""


def _unpack(content: bytes, source: str) -> dict[Any, Any]:
    """Unpack the dictionary in a torch file, after checks of sizes and checksums that torch does not make.

    Args:
        content: of the file.
        source: name of the file in messages.

    Raises:
        MitsonarError: this is not a torch file, it is damaged, or it would unpack to more than its size.
    """
    buffer = io.BytesIO(content)
    try:
        if not zipfile.is_zipfile(buffer):  # raises if the archive claims to span several files
            raise MitsonarError(f"{source} is not a checkpoint, or was cut off: give a {FILE} of `mitsonar train`")
        with zipfile.ZipFile(buffer) as parts:
            packed = [part for part in parts.infolist() if part.compress_type != zipfile.ZIP_STORED]
            if packed or sum(part.file_size for part in parts.infolist()) > min(LARGEST, len(content)):
                raise MitsonarError(
                    f"{source} would unpack to more than its size, or than {LARGEST >> 30} GiB: it is not of mitsonar"
                )
            wrong = parts.testzip()
        if wrong is not None:
            raise ValueError(f"the checksum of {wrong} is wrong")
        buffer.seek(0)
        table = torch.load(buffer, map_location="cpu", weights_only=True)
    except MitsonarError:
        raise
    except Exception as error:  # a damaged zip or pickle may raise anything
        raise MitsonarError(
            f"{source} is damaged, or not a checkpoint of mitsonar ({_first_line(error)}): give a {FILE} of `mitsonar train`"
        ) from None
    return table if isinstance(table, dict) else {}


class _Part(BaseModel):
    """A table of a file: types are not converted."""

    model_config = ConfigDict(strict=True, arbitrary_types_allowed=True)


Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Arrangement(_Part, extra="forbid"):
    """Options of :class:`~mitsonar.datasets.samples.SonarPairs` that define the input; earlier files lack the last two."""

    frames: int = Field(ge=1, le=16)
    views: list[str] = Field(min_length=1)
    kind: Literal["image", "vector", "response"]
    layout: Layout | Literal["columns"]
    coordinates: Coordinates | Literal["delay"]
    cartesian_rows: int = Field(ge=0, le=2**24)
    ground: bool
    range_levels: int | None = Field(None, ge=1, le=2**24)
    halves: bool = False


class _Labels(_Part):
    """Kind, limits and names of the labels."""

    kind: LabelKind
    names: list[str] = Field(min_length=1)
    low: list[Finite]
    high: list[Finite]

    @model_validator(mode="after")
    def _fit(self) -> Self:
        if not len(self.low) == len(self.high) == len(self.names):
            raise ValueError("low and high must have one number per name")
        return self


class _TrainedAt(_Part):
    """Geometry of the sonar in training."""

    height_m: list[Finite] = Field(min_length=2, max_length=2)
    pitch_deg: Finite
    roll_deg: Finite


def _check_stored(values: Tensor) -> Tensor:
    """Check that the file holds every number of a tensor, all finite; an expanded tensor would need more memory."""
    plain = values.layout == torch.strided and values.device.type == "cpu" and not values.is_quantized
    if not plain or values.numel() * values.element_size() > values.untyped_storage().nbytes():
        raise ValueError("the file has fewer numbers than the shape of the tensor")
    if not torch.isfinite(values).all():
        raise ValueError("numbers must be finite: got nan or inf")
    return values


class _Contents(_Part, extra="forbid"):
    """Fields of a file: those of :class:`Checkpoint`, and ``kind``."""

    kind: str
    network: str
    options: Fields
    weights: dict[str, Annotated[Tensor, AfterValidator(_check_stored)]]
    arrangement: _Arrangement
    labels: _Labels
    sonar: dict[str, Fields]
    trained_at: _TrainedAt
    model: str
    noise: str
    data: str
    data_recipe: Fields
    recipe: Fields
    metrics: Fields
    trained: Fields
    version: str
    format: int

    @model_validator(mode="after")
    def _has_sonars(self) -> Self:
        is_response = self.arrangement.kind == "response"
        if is_response and list(self.sonar) != ["channel"]:
            raise ValueError("sonar has no channel")
        for view, settings in self.sonar.items():
            try:
                (ChannelSonar if is_response else Sonar).create(**settings)
            except (MitsonarError, TypeError) as error:
                raise ValueError(f"sonar {view[:80]}: {error}") from None
        return self


def _are_numbers(values: object, count: int) -> TypeGuard[list[float]]:
    """Return whether ``values`` is a list of ``count`` finite numbers."""
    if not isinstance(values, list) or len(values) != count:
        return False
    return all(type(value) in (int, float) and math.isfinite(value) for value in values)


def _first_line(error: Exception) -> str:
    """Return the first line of an error's message, shortened if it is long, or the name of its class."""
    return (str(error).splitlines() or [type(error).__name__])[0][:300]


# ---------------- Export to ONNX


def to_onnx(checkpoint: Checkpoint, batch: int | None = None) -> bytes:
    """Return a checkpoint as the bytes of an ONNX file, for programs without torch.

    The inputs are ``image`` in the checkpoint's arrangement, with grey values in 0..1, and ``cartesian`` for ``both``
    coordinates. Networks that need the geometry also have the arrays of :func:`~mitsonar.datasets.samples.ground_at` as
    inputs, by name. The outputs are ``labels``, or ``motion`` and its ``covariance``. The metadata of the file describe
    inputs and outputs.

    Args:
        checkpoint: of the network.
        batch: number of samples per batch; None: any number.

    Raises:
        MitsonarError: ``onnx`` or ``onnxscript`` is missing, or torch cannot export the network.
    """
    missing = [name for name in ("onnx", "onnxscript") if importlib.util.find_spec(name) is None]
    if missing:
        raise MitsonarError(f"writing ONNX needs {' and '.join(missing)}: pip install 'mitsonar[learn]'")
    import onnx

    # 1. Example inputs; a dynamic batch size needs an example of more than one sample.
    network = _Named(checkpoint.build(), checkpoint.arrangement["ground"]).eval()
    inputs = _inputs(checkpoint, 3 if batch is None else batch)
    shapes = None
    if batch is None:
        shapes = {"inputs": {name: {0: torch.export.Dim("batch")} for name in inputs}}
    # 2. Trace the network, and replace the operations that ONNX lacks.
    outputs = ["motion", "covariance"] if NETWORKS[checkpoint.network].has_covariance else ["labels"]
    try:
        with _quiet(), torch.no_grad():
            network(inputs)  # fill the caches of the network before the tracer passes empty tensors
            traced = torch.export.export(network, (), {"inputs": inputs}, dynamic_shapes=shapes)
            traced = traced.run_decompositions({**torch.export.default_decompositions(), **REPLACEMENTS})
            program = torch.onnx.export(
                traced,
                dynamo=True,
                verbose=False,
                input_names=list(inputs),
                output_names=outputs,
                external_data=False,
            )
    except (RuntimeError, torch.onnx.errors.OnnxExporterError) as error:
        cause = str(error.__cause__ or error).splitlines() or [type(error).__name__]
        how = "of any number of samples at a time; give a number" if batch is None else f"of {batch} samples at a time"
        raise MitsonarError(f"torch cannot write this {checkpoint.network} as ONNX {how} ({cause[0]})") from None
    # 3. Describe inputs and outputs in the metadata.
    assert program is not None
    model = program.model_proto
    onnx.helper.set_model_props(model, _metadata(checkpoint))
    return bytes(model.SerializeToString())


class _Named(nn.Module):
    """Wrapper of a network that takes its inputs by name."""

    def __init__(self, network: nn.Module, ground: bool) -> None:
        super().__init__()
        self.network, self.ground = network, ground

    def forward(self, inputs: dict[str, Tensor]) -> Tensor | tuple[Tensor, Tensor]:
        """Return the labels, or a motion and its covariance."""
        rest = dict(inputs)
        image = rest.pop("image")
        output = self.network(image, rest) if self.ground else self.network(image, *rest.values())
        return tuple(output) if isinstance(output, GaussianHead) else output  # type: ignore[return-value]


def _inputs(checkpoint: Checkpoint, batch: int) -> dict[str, Tensor]:
    """Make a batch of network inputs, keyed by name, with noise instead of frames."""
    generator = torch.Generator().manual_seed(0)
    if not checkpoint.arrangement["ground"]:
        options = checkpoint.options
        names = {"image": "size", "cartesian": "cartesian_size"}
        sizes = {name: options[size] for name, size in names.items() if size in options}
        if checkpoint.arrangement["coordinates"] == "cartesian":
            sizes = {"image": options["size"]}
        return {
            name: torch.rand((batch, options.get("channels", 1), *size), generator=generator) for name, size in sizes.items()
        }
    sonar = sonar_from(dict(checkpoint.data_recipe["sonar"]))
    height, pitch = sum(checkpoint.trained_at["height_m"]) / 2, checkpoint.trained_at["pitch_deg"]
    ground = ground_at(sonar.range_m, sonar.bearing_rad, sonar.bearing, height, math.radians(pitch))
    image = torch.rand((batch, 2, sonar.range_bins, sonar.beams), generator=generator)
    tables = {name: torch.from_numpy(values) for name, values in ground.items()}
    return {"image": image} | {name: values.expand(batch, *values.shape).contiguous() for name, values in tables.items()}


def _metadata(checkpoint: Checkpoint) -> dict[str, str]:
    """Return the metadata of the ONNX file; dictionaries are JSON."""
    texts = ("network", "model", "noise", "data", "digest")
    tables = ("options", "arrangement", "labels", "sonar", "trained_at", "metrics", "trained")
    metadata: dict[str, str] = {name: getattr(checkpoint, name) for name in texts}
    metadata |= {name: json.dumps(getattr(checkpoint, name)) for name in tables}
    return metadata | {"mitsonar_version": checkpoint.version}


def _solve(matrix: Tensor, right_sides: Tensor, **options: object) -> Tensor:
    """Solve systems with positive definite matrices ``(..., 3, 3)`` by elimination."""
    size = matrix.shape[-1]
    rows = [torch.cat([matrix[..., k, :], right_sides[..., k, :]], dim=-1) for k in range(size)]
    for k in range(size):
        rows[k] = rows[k] / rows[k][..., k : k + 1]
        rows = [row if j == k else row - row[..., k : k + 1] * rows[k] for j, row in enumerate(rows)]
    return torch.stack(rows, dim=-2)[..., size:]


def _invert(matrix: Tensor) -> Tensor:
    """Invert positive definite matrices ``(..., 3, 3)`` by elimination."""
    return _solve(matrix, torch.eye(matrix.shape[-1], dtype=matrix.dtype).expand(matrix.shape))


REPLACEMENTS = {torch.ops.aten.linalg_solve.default: _solve, torch.ops.aten.linalg_inv.default: _invert}
"""Replacements of operations that ONNX lacks."""


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress torch's messages about packages that are not needed and about its own deprecations."""
    logs = [logging.getLogger(name) for name in ("torch.onnx", "onnx_ir", "onnxscript")]
    levels = [logger.level for logger in logs]
    for logger in logs:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(logs, levels, strict=True):
            logger.setLevel(level)
