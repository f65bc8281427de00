"""A trained network in one file that explains itself: weights, input, labels, sonar, training, and how well it did."""

from __future__ import annotations

import hashlib
import io
import os
from dataclasses import dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Self, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mitsonar.config.data import Recipe, Split
from mitsonar.datasets.arrangement import Labels
from mitsonar.datasets.modality import Fields
from mitsonar.datasets.samples import Batches, Part, split_for
from mitsonar.errors import MitsonarError, meant, shortened
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.files import read_bytes, write_whole
from mitsonar.motion.errors import AXES
from mitsonar.networks.checkpoint_faults import FILE, LARGEST, WORDS, are_numbers, faults_of, first_line, unpacked
from mitsonar.networks.create import NETWORKS, create_network
from mitsonar.networks.gaussian_head import GaussianHead
from mitsonar.networks.shipped import SHIPPED, shipped_path

if TYPE_CHECKING:
    from mitsonar.datasets.responses import ImpulseSamples
    from mitsonar.datasets.samples import SonarPairs

__all__ = ["FILE", "FORMAT", "WORDS", "Checkpoint"]

FORMAT = 1
"""Version of the file's content. A reader knows only its own version."""

KIND = "mitsonar checkpoint"
"""The file's own name of its kind."""

LARGEST_OPTION = 1_000_000
"""Largest number among a network's options: sizes, channels, layers."""

FEW_WEIGHTS = 10_000_000
"""Weights that may be allocated before they are compared with those of the file."""

Plain: TypeAlias = "str | bool | int | float | list[Plain] | dict[str, Plain] | None"
"""What a file holds beside weights."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A trained network and all that is needed to use it.

    Attributes:
        network: its name, for :func:`~mitsonar.networks.create.create_network`.
        options: of the network.
        weights: its state, on the CPU.
        arrangement: of its input: the options of :data:`WORDS`.
        labels: of its output: kind, low, high, names; see :attr:`coder`.
        sonar: fields of the sonar of each view, by name; empty where the network works with any sonar.
        trained_at: geometry of the sonar in training: ``height_m`` [low, high] over z = 0, ``pitch_deg``, ``roll_deg``.
        model: ``thesis``, ``physical`` or ``coherent``; of several data sets all of them: ``coherent and physical``.
        noise: of training, as text.
        data: name of the recipe of the data set, or of all of them.
        data_recipe: that recipe, or the first.
        recipe: of the training.
        metrics: of validation by noise level: ``{"none": {"rmse": [sideways mm, forward mm, yaw deg], "pairs": 500}}``;
            for heights rmse is ``[mm]``.
        trained: number of pairs, minutes, epochs, seed ...
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
        """Make the checkpoint of a network of :data:`~mitsonar.networks.create.NETWORKS` in its present state.

        Args:
            network: whose weights are copied.
            samples: on which it was trained. They define input, labels, sonar, geometry and noise.
            about: further fields: recipe, metrics, trained; noise, where it is not that of the samples.

        Raises:
            MitsonarError: a module that is not one of ours, or a value that a file cannot hold.
        """
        names = [name for name, made in NETWORKS.items() if type(network) is made]
        if not names:
            raise MitsonarError(
                f"a checkpoint holds one of our networks: got {type(network).__name__}; make it with create_network, or "
                "keep its state_dict yourself"
            )
        recipe, coder, described = samples.recipe, samples.labels, samples.described()
        table: Fields = {
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
        plain: Fields = {key: value if key == "weights" else _plain(value, key) for key, value in table.items()}
        return cls(**plain)

    def halved(self) -> Self:
        """Return the checkpoint with matrices and filters of half precision, about half as large; statistics stay whole.

        :meth:`build` computes with whole precision again.
        """
        weights = {
            name: values.half() if values.is_floating_point() and values.dim() > 1 else values
            for name, values in self.weights.items()
        }
        return replace(self, weights=weights)

    def build(self) -> nn.Module:
        """Build the network with its weights, in evaluation mode. The state of torch's random numbers does not change.

        Raises:
            MitsonarError: an unknown network or option, or weights that do not fit it.
        """
        written = f"the checkpoint was written by mitsonar {self.version[:40]}, this is {version('mitsonar')}"
        self._check_fit(written)
        with torch.random.fork_rng(devices=[]):
            try:
                network = create_network(self.network, **self.options)
            except MitsonarError as error:
                raise MitsonarError(f"{error} ({written})") from None
            except Exception as error:  # wrong options may raise anything
                raise MitsonarError(
                    f"no {self.network} has these options, {shortened(self.options)}: {first_line(error)}"
                ) from None
        try:
            network.load_state_dict(self.weights)
        except RuntimeError as error:
            raise MitsonarError(
                f"the weights do not fit a {self.network} with options {shortened(self.options)}: "
                f"{_mismatch(error)} ({written})"
            ) from None
        return network.eval().requires_grad_(False)

    def _check_fit(self, written: str) -> None:
        """Check that options and weights fit each other, before memory is allocated for the network.

        Raises:
            MitsonarError: they do not fit.
        """
        large = [name for name, value in _numbers_in(self.options) if not abs(value) <= LARGEST_OPTION]
        if large:
            raise MitsonarError(
                f"no {self.network} has these options, {shortened(self.options)}: {large[0]} is beyond {LARGEST_OPTION:,}"
            )
        try:
            with torch.device("meta"), torch.random.fork_rng(devices=[]):
                promised = create_network(self.network, **self.options).state_dict()
        except Exception:  # build raises it again, with a message
            return
        there = sum(values.numel() for values in self.weights.values())
        wanted = sum(values.numel() for values in promised.values())
        if wanted > 2 * there + FEW_WEIGHTS:
            raise MitsonarError(
                f"the weights do not fit a {self.network} with options {shortened(self.options)}: they are {there:,}, "
                f"it has {wanted:,} ({written})"
            )

    # ---------------------------------------------------------------- what it describes

    @property
    def coder(self) -> Labels:
        """Return the labels, which encode and decode targets."""
        low, high = (np.array(self.labels[end], dtype=float) for end in ("low", "high"))
        return Labels(self.labels["kind"], low, high, tuple(self.labels["names"]))

    @property
    def sonars(self) -> dict[str, Sonar]:
        """Return the sonar of each view; empty where the network works with any sonar, or on impulse responses."""
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
        """Return the covariance of a motion [m, m, rad] ``(3, 3)`` from :attr:`rmse`, for networks that estimate none.

        It is None if the errors are not known.
        """
        rmse = self.rmse
        return None if rmse is None or len(rmse) != len(AXES) else np.diag((rmse / [axis.scale for axis in AXES]) ** 2)

    @property
    def rmse(self) -> NDArray[np.float64] | None:
        """Return the errors in validation [mm, mm, deg], or of heights [mm]; None if they are not known.

        They are those at the noise of training if it was validated, else those over all levels.
        """
        known = {level: found.get("rmse") for level, found in self.metrics.items() if isinstance(found, dict)}
        chosen = [known[self.noise]] if self.noise in known else list(known.values())
        if not chosen or not all(are_numbers(rmse, len(self.labels["names"])) for rmse in chosen):
            return None
        return np.asarray(np.sqrt((np.array(chosen, dtype=float) ** 2).mean(axis=0)))

    def split_of_training(self, recipe: Recipe) -> Split | None:
        """Return how training has split the data set of a recipe; None where it was trained on other data.

        Raises:
            MitsonarError: the file holds no split.
        """
        if self.trained.get("rendered") or self.data_recipe != recipe.model_dump(mode="json"):
            return None
        return split_for(self.recipe.get("split"), recipe)

    def learnt(self, samples: SonarPairs | ImpulseSamples) -> NDArray[np.bool_]:
        """Return which samples of a data set training may have seen ``(samples,)``: all of whose motions it was given.

        Raises:
            MitsonarError: the file holds no split.
        """
        split = self.split_of_training(samples.recipe)
        if split is None:
            return np.zeros(len(samples), dtype=bool)
        part, length = self.recipe.get("part_of_data"), self.arrangement["frames"]
        seen = Part.of(samples.store, "train", split, length)
        share = part if isinstance(part, int | float) else 1.0
        first = seen.first[seen.first + length <= share * len(samples.store)]
        given = np.zeros(len(samples.store) + length, dtype=bool)  # motions from each frame to the next
        for step in range(max(length - 1, 1)):
            given[first + step] = True
        steps = range(max(samples.frames - 1, 1))
        return np.asarray(np.all([given[samples.first + step] for step in steps], axis=0))

    def decode(self, answer: Tensor | GaussianHead) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Decode the output of the network.

        Returns:
            Targets ``(batch, n)`` [m, rad], and their covariances ``(batch, n, n)``, or None if it estimates none.

        Raises:
            MitsonarError: an output of another shape than the labels.
        """
        if isinstance(answer, GaussianHead):
            mean, covariance = (values.detach().cpu().double().numpy() for values in answer)
            return mean, (covariance + covariance.swapaxes(-1, -2)) / 2  # single precision leaves it lopsided by 1e-8
        names = self.labels["names"]
        if not isinstance(answer, Tensor) or answer.ndim != 2 or answer.shape[1] != len(names):
            got = tuple(answer.shape) if isinstance(answer, Tensor) else type(answer).__name__
            raise MitsonarError(f"the {self.network} answers {got}, its labels are {', '.join(names)}: the file is damaged")
        return self.coder.decode(answer.detach().cpu().numpy()), None

    @property
    def digest(self) -> str:
        """Compute the SHA-256 of network, options and weights."""
        total = hashlib.sha256(f"{self.network} {self.options}".encode())
        for name, values in sorted(self.weights.items()):
            total.update(f"{name} {values.dtype} {tuple(values.shape)}".encode())
            total.update(values.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
        return total.hexdigest()

    def rows(self) -> list[tuple[str, str]]:
        """List what a user wants to know as names and values, for a console."""
        words = self.arrangement
        shape = [words[word] for word in ("kind", "layout", "coordinates")] + ["ground"] * words["ground"]
        count = sum(values.numel() for values in self.weights.values())
        options = "".join(f", {key} {value}" for key, value in self.options.items())
        sonars = [
            f"{one.name}, {one.beams} beams, {one.range_bins} bins, {one.range_min:g}..{one.range_max:g} m"
            for one in self.sonars.values()
        ]
        if self.channel is not None:
            received = self.channel
            sonars = [
                f"{received.name}, {received.carrier_hz:g} Hz, {received.bandwidth_hz:g} Hz wide, {received.taps} taps"
            ]
        spans = zip(self.labels["names"], self.labels["low"], self.labels["high"], strict=True)
        rows = [
            ("network", f"{self.network}{options}"),
            ("weights", f"{count:,}"),
            ("input", f"{words['frames']} frames of {', '.join(words['views'])}: {', '.join(shape)}"),
            ("labels", f"{self.labels['kind']}: " + ", ".join(f"{name} {low:.4g}..{high:.4g}" for name, low, high in spans)),
            ("sonar", "; ".join(dict.fromkeys(sonars)) or "any"),
            ("trained on", f"{self.data}, {self.model} model, noise {self.noise}; {self.fixed}"),
            ("trained for", ", ".join(f"{name} {_number(value)}" for name, value in self.trained.items()) or "not recorded"),
        ]
        for level, found in self.metrics.items():
            rmse = found.get("rmse") if isinstance(found, dict) else None
            if isinstance(rmse, list) and len(rmse) <= len(AXES) and are_numbers(rmse, len(rmse)):
                units = [axis.unit for axis in AXES[: len(rmse)]]
                values = " / ".join(f"{value:.3g} {unit}" for value, unit in zip(rmse, units, strict=True))
                rows.append((f"RMSE, noise {level}", f"{values} in validation"))
        return [*rows, ("written by", f"mitsonar {self.version}")]

    # ---------------------------------------------------------------- files

    def to_bytes(self) -> bytes:
        """Return the content of the file."""
        table = {one.name: getattr(self, one.name) for one in fields(self)}
        plain: Fields = {key: value if key == "weights" else _plain(value, key) for key, value in table.items()}
        buffer = io.BytesIO()
        torch.save({"kind": KIND, **plain}, buffer)
        return buffer.getvalue()

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        write_whole(path, self.to_bytes())

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Load the checkpoint of a file, of a training run's folder, or the one of that name that comes with mitsonar.

        Nothing in the file is executed.

        Raises:
            MitsonarError: no such file, not a checkpoint, damaged, or of another format.
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
                f"{meant(path, SHIPPED)}"
            )
        content = read_bytes(path, "checkpoint", LARGEST)
        return cls.from_bytes(content, str(path))

    @classmethod
    def from_bytes(cls, content: bytes, source: str = "the checkpoint") -> Self:
        """Load what :meth:`to_bytes` returned; errors name ``source``.

        Raises:
            MitsonarError: not a checkpoint, damaged, or of another format.
        """
        table = unpacked(content, source)
        if table.get("kind") != KIND:
            lightning = any(str(key).startswith("pytorch-lightning") for key in table)
            held = "Lightning's state, from which `mitsonar train --resume` continues" if lightning else "something else"
            raise MitsonarError(f"{source} is not a checkpoint of mitsonar, it holds {held}: give a {FILE}")
        if table.get("format") != FORMAT:
            raise MitsonarError(
                f"{source} is a checkpoint of format {shortened(table.get('format'))}, written by mitsonar "
                f"{str(table.get('version'))[:40]}; this is mitsonar {version('mitsonar')}, which reads format {FORMAT}: "
                "use the version that wrote it, or train again"
            )
        names = [one.name for one in fields(cls)]
        faults = faults_of({key: value for key, value in table.items() if key != "kind"}, names)
        if faults:
            raise MitsonarError(f"{source} is damaged: {faults[0]}; train again, or take a copy that is whole")
        return cls(**{name: table[name] for name in names})


def _numbers_in(options: Fields) -> list[tuple[str, float]]:
    """List the numbers of a network's options, also those of lists, each with the option's name."""
    pairs = [(name, one) for name, value in options.items() for one in (value if isinstance(value, list) else [value])]
    return [(name, one) for name, one in pairs if isinstance(one, int | float)]


def _plain(value: object, name: str) -> Plain:
    """Convert a value to numbers, texts, lists and tables.

    Raises:
        MitsonarError: something else.
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
    raise MitsonarError(f"{name} of a checkpoint holds numbers, texts, lists and tables only: got {value!r}")


def _mismatch(error: RuntimeError) -> str:
    """Return torch's message on the first weight that does not fit."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join((lines[1] if len(lines) > 1 else lines[0]).split())[:300]


def _number(value: object) -> str:
    """Write a number, or anything else, for a console."""
    return f"{value:,.4g}" if isinstance(value, float) else f"{value:,}" if type(value) is int else str(value)
