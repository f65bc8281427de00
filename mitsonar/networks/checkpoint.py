"""A trained network in one file that explains itself: weights, input, labels, sonar, training, and how well it did."""

from __future__ import annotations

import hashlib
import io
import math
import zipfile
from dataclasses import dataclass, field, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mitsonar.datasets.arrangement import LABELS, Coordinates, Labels, Layout
from mitsonar.datasets.batches import Batches
from mitsonar.errors import MitsonarError, meant, nearest_names, shortened
from mitsonar.instruments.channel_sonar import ChannelSonar
from mitsonar.instruments.imaging_sonar import Sonar
from mitsonar.io.plain_data import check_plain
from mitsonar.io.whole_files import read_bytes, write_whole
from mitsonar.motion.motion_errors import AXES
from mitsonar.networks.create import NETWORKS, create_network
from mitsonar.networks.gaussian_head import GaussianHead
from mitsonar.networks.shipped import SHIPPED, shipped_path

__all__ = ["FILE", "FORMAT", "WORDS", "Checkpoint"]

FORMAT = 1
"""Version of what is in the file; a reader knows its own only."""

FILE = "network.ckpt"
"""Its name in the folder of a training run."""

KIND = "mitsonar checkpoint"

WORDS = {
    "frames": int,
    "views": list,
    "kind": str,
    "layout": str,
    "coordinates": str,
    "cartesian_rows": int,
    "ground": bool,
}
"""The words of :class:`~mitsonar.datasets.torch_pairs.SonarPairs` that say what a network is given, with their types."""

LATER: dict[str, Any] = {"range_levels": (int, type(None)), "halves": bool}
"""Words that files of earlier versions lack: then they are what SonarPairs has without them."""

LARGEST = 8 * 2**30
"""Bytes of a checkpoint once unpacked."""

LARGEST_OPTION = 1_000_000
"""Of a network: sizes, channels, layers."""

FEW_WEIGHTS = 10_000_000
"""So many may be made before it is known that they fit no file."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A trained network and all that is needed to use it.

    Attributes:
        network: its name, for :func:`~mitsonar.networks.create.create_network`.
        options: of it.
        weights: its state, on the CPU.
        arrangement: what it is given: the words of :data:`WORDS`.
        labels: what it says: kind, low, high, names; see :attr:`coder`.
        sonar: fields of the sonar of each view, by name; empty where the network works with any.
        stands: how the sonar stood in training: ``height_m`` [low, high] over z = 0, ``pitch_deg``, ``roll_deg``.
        model: ``thesis`` or ``physical``.
        noise: of training, as text.
        data: name of the recipe of the data set.
        data_recipe: that recipe.
        recipe: of the training.
        metrics: of validation by noise level: ``{"none": {"rmse": [sideways mm, forward mm, yaw deg], "pairs": 500}}``;
            for heights rmse is ``[mm]``.
        trained: pairs seen, minutes, epochs, seed ...
        version: of the mitsonar that wrote it.
        format: :data:`FORMAT`.
    """

    network: str
    options: dict[str, Any]
    weights: dict[str, Tensor] = field(repr=False)
    arrangement: dict[str, Any]
    labels: dict[str, Any]
    sonar: dict[str, dict[str, Any]]
    trained_at: dict[str, Any]
    model: str
    noise: str
    data: str
    data_recipe: dict[str, Any] = field(default_factory=dict)
    recipe: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    trained: dict[str, Any] = field(default_factory=dict)
    version: str = field(default_factory=lambda: version("mitsonar"))
    format: int = FORMAT

    @classmethod
    def of(cls, network: nn.Module, samples: Batches, **about: Any) -> Self:
        """The checkpoint of a network of :data:`~mitsonar.networks.create.NETWORKS` as it is now.

        Args:
            network: whose weights are copied.
            samples: it was trained on: they tell input, labels, sonar, geometry, noise.
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
        told: dict[str, Any] = {
            **described,
            "network": names[0],
            "options": network.options,
            "weights": {name: values.detach().cpu().clone() for name, values in network.state_dict().items()},
            "labels": {"kind": coder.kind, "low": coder.low, "high": coder.high, "names": coder.names},
            "sonar": {} if NETWORKS[names[0]].any_sonar else described["sonar"],
            "data": recipe.name,
            "data_recipe": recipe.model_dump(mode="json"),
            **about,
        }
        return cls(**{key: value if key == "weights" else _plain(value, key) for key, value in told.items()})

    def build(self) -> nn.Module:
        """The network with its weights, in evaluation mode; torch's random numbers stay as they were.

        Raises:
            MitsonarError: an unknown network or option, or weights that do not fit it.
        """
        written = f"the checkpoint was written by mitsonar {self.version}, this is {version('mitsonar')}"
        self._check_fit(written)
        with torch.random.fork_rng(devices=[]):
            try:
                network = create_network(self.network, **self.options)
            except MitsonarError as error:
                raise MitsonarError(f"{error} ({written})") from None
            except Exception as error:  # options lead to whatever they do
                raise MitsonarError(f"no {self.network} has these options, {self.options}: {_first_line(error)}") from None
        try:
            network.load_state_dict(self.weights)
        except RuntimeError as error:
            raise MitsonarError(
                f"the weights do not fit a {self.network} with options {self.options}: {_mismatch(error)} ({written})"
            ) from None
        return network.eval().requires_grad_(False)

    def _check_fit(self, written: str) -> None:
        """That options and weights fit each other, before memory is taken for a network that only its options promise.

        Raises:
            MitsonarError: they do not.
        """
        large = [name for name, value in _numbers_in(self.options) if not abs(value) <= LARGEST_OPTION]
        if large:
            raise MitsonarError(
                f"no {self.network} has these options, {shortened(self.options)}: {large[0]} is beyond {LARGEST_OPTION:,}"
            )
        try:
            with torch.device("meta"), torch.random.fork_rng(devices=[]):
                promised = create_network(self.network, **self.options).state_dict()
        except Exception:  # said by build, where it happens again
            return
        there = sum(values.numel() for values in self.weights.values())
        wanted = sum(values.numel() for values in promised.values())
        if wanted > 2 * there + FEW_WEIGHTS:
            raise MitsonarError(
                f"the weights do not fit a {self.network} with options {shortened(self.options)}: they are {there:,}, "
                f"it has {wanted:,} ({written})"
            )

    # ---------------------------------------------------------------- what it says

    @property
    def coder(self) -> Labels:
        """From targets to its labels and back."""
        low, high = (np.array(self.labels[end], dtype=float) for end in ("low", "high"))
        return Labels(self.labels["kind"], low, high, tuple(self.labels["names"]))

    @property
    def sonars(self) -> dict[str, Sonar]:
        """The sonar of each view; empty where the network works with any, or on impulse responses."""
        return {} if self.channel else {name: Sonar.create(**fields) for name, fields in self.sonar.items()}

    @property
    def channel(self) -> ChannelSonar | None:
        """The instrument of a network on impulse responses."""
        return ChannelSonar.create(**self.sonar["channel"]) if self.arrangement["kind"] == "response" else None

    @property
    def fixed(self) -> str:
        """What training has fixed, in words: ``height 2.5 m, pitch 35 deg``."""
        low, high = self.trained_at["height_m"]
        height = f"{low:g} m" if low == high else f"{low:g}..{high:g} m"
        roll = f", roll {self.trained_at['roll_deg']:g} deg" if self.trained_at["roll_deg"] else ""
        return f"height {height}, pitch {self.trained_at['pitch_deg']:g} deg{roll}"

    @property
    def covariance(self) -> NDArray[np.float64] | None:
        """Of a motion [m, m, rad] ``(3, 3)``, for networks that do not say it, by :attr:`rmse`; None where that is not
        known."""
        rmse = self.rmse
        return None if rmse is None or len(rmse) != len(AXES) else np.diag((rmse / [axis.scale for axis in AXES]) ** 2)

    @property
    def rmse(self) -> NDArray[np.float64] | None:
        """Errors in validation [mm, mm, deg], or of heights [mm]: at the noise of training where that was validated, else
        over all levels. None where they are not known."""
        known = {level: found.get("rmse") for level, found in self.metrics.items() if isinstance(found, dict)}
        chosen = [known[self.noise]] if self.noise in known else list(known.values())
        if not chosen or not all(_are_numbers(rmse, len(self.labels["names"])) for rmse in chosen):
            return None
        return np.asarray(np.sqrt((np.array(chosen, dtype=float) ** 2).mean(axis=0)))

    def decode(self, answer: Tensor | GaussianHead) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Targets ``(batch, n)`` [m, rad] of what the network answers; covariances ``(batch, n, n)``, if it says them."""
        if isinstance(answer, GaussianHead):
            mean, covariance = (values.detach().cpu().double().numpy() for values in answer)
            return mean, covariance
        names = self.labels["names"]
        if not isinstance(answer, Tensor) or answer.ndim != 2 or answer.shape[1] != len(names):
            got = tuple(answer.shape) if isinstance(answer, Tensor) else type(answer).__name__
            raise MitsonarError(f"the {self.network} answers {got}, its labels are {', '.join(names)}: the file is damaged")
        return self.coder.decode(answer.detach().cpu().numpy()), None

    @property
    def digest(self) -> str:
        """SHA-256 of network, options and weights."""
        total = hashlib.sha256(f"{self.network} {self.options}".encode())
        for name, values in sorted(self.weights.items()):
            total.update(f"{name} {values.dtype} {tuple(values.shape)}".encode())
            total.update(values.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
        return total.hexdigest()

    def rows(self) -> list[tuple[str, str]]:
        """Name and value of what a user wants to know, for a console."""
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
            ("trained for", ", ".join(f"{name} {_number(value)}" for name, value in self.trained.items()) or "not said"),
        ]
        for level, found in self.metrics.items():
            rmse = found.get("rmse") if isinstance(found, dict) else None
            if isinstance(rmse, list) and len(rmse) <= len(AXES) and _are_numbers(rmse, len(rmse)):
                units = [axis.unit for axis in AXES[: len(rmse)]]
                values = " / ".join(f"{value:.3g} {unit}" for value, unit in zip(rmse, units, strict=True))
                rows.append((f"RMSE, noise {level}", f"{values} in validation"))
        return [*rows, ("written by", f"mitsonar {self.version}")]

    # ---------------------------------------------------------------- files

    def to_bytes(self) -> bytes:
        """What the file holds."""
        table = {one.name: getattr(self, one.name) for one in fields(self)}
        plain = {key: value if key == "weights" else _plain(value, key) for key, value in table.items()}
        buffer = io.BytesIO()
        torch.save({"kind": KIND, **plain}, buffer)
        return buffer.getvalue()

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        write_whole(path, self.to_bytes())

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """The checkpoint in a file, in the folder of a training run, or the one of that name that comes with mitsonar.

        Nothing in the file is executed.

        Raises:
            MitsonarError: no such file, not a checkpoint, damaged, or of another format.
        """
        path = shipped_path(path) if isinstance(path, str) and path in SHIPPED else Path(path)
        if path.is_dir():
            if not (path / FILE).is_file():
                raise MitsonarError(
                    f"{path} holds no {FILE}: give the folder of a training that has validated once, or a checkpoint"
                )
            path = path / FILE
        if not path.exists():
            raise MitsonarError(
                f"no checkpoint {path}: give a {FILE}, the folder of `mitsonar train`, or {' or '.join(SHIPPED)}"
                f"{meant(path, SHIPPED)}"
            )
        content = read_bytes(path, "checkpoint", LARGEST)
        return cls.from_bytes(content, str(path))

    @classmethod
    def from_bytes(cls, content: bytes, source: str = "the checkpoint") -> Self:
        """What :meth:`to_bytes` gave; ``source`` is named in errors.

        Raises:
            MitsonarError: not a checkpoint, damaged, or of another format.
        """
        table = _unpacked(content, source)
        if table.get("kind") != KIND:
            lightning = any(str(key).startswith("pytorch-lightning") for key in table)
            held = "Lightning's state, from which `mitsonar train --resume` goes on" if lightning else "something else"
            raise MitsonarError(f"{source} is not a checkpoint of mitsonar, it holds {held}: give a {FILE}")
        if table.get("format") != FORMAT:
            raise MitsonarError(
                f"{source} is a checkpoint of format {table.get('format')!r}, written by mitsonar {table.get('version')}; "
                f"this is mitsonar {version('mitsonar')}, which reads format {FORMAT}: use the version that wrote it, or "
                "train again"
            )
        faults = _faults({key: value for key, value in table.items() if key != "kind"})
        if faults:
            raise MitsonarError(f"{source} is damaged: {faults[0]}; train again, or take a copy that is whole")
        return cls(**{one.name: table[one.name] for one in fields(cls)})


def _unpacked(content: bytes, source: str) -> dict[Any, Any]:
    """The table in a file of torch; its parts are checked, which torch does not do."""
    buffer = io.BytesIO(content)
    if not zipfile.is_zipfile(buffer):
        raise MitsonarError(f"{source} is not a checkpoint, or was cut off: give a {FILE} of `mitsonar train`")
    try:
        with zipfile.ZipFile(buffer) as parts:
            packed = [part for part in parts.infolist() if part.compress_type != zipfile.ZIP_STORED]
            if packed or sum(part.file_size for part in parts.infolist()) > min(LARGEST, len(content)):
                raise MitsonarError(
                    f"{source} would unpack to more than it is, or than {LARGEST >> 30} GiB: it is no checkpoint of mitsonar"
                )
            wrong = parts.testzip()
        if wrong is not None:
            raise ValueError(f"the checksum of {wrong} is wrong")
        buffer.seek(0)
        table = torch.load(buffer, map_location="cpu", weights_only=True)
    except MitsonarError:
        raise
    except Exception as error:  # a damaged zip or pickle raises whatever its bytes lead to
        raise MitsonarError(
            f"{source} is damaged, or not a checkpoint of mitsonar ({_first_line(error)}): give a {FILE} of `mitsonar train`"
        ) from None
    return table if isinstance(table, dict) else {}


def _faults(table: dict[Any, Any]) -> list[str]:
    """What is wrong with the fields of a file, in words."""
    names = {one.name for one in fields(Checkpoint)}
    found = [f"it lacks {name}" for name in sorted(names - set(table))]
    found += [f"{key!r} is unknown" for key in table if key not in names]
    if found:
        return found
    try:
        check_plain({name: value for name, value in table.items() if name != "weights"}, "it")
    except MitsonarError as error:
        return [str(error)]
    texts, tables = (
        ("network", "model", "noise", "data", "version"),
        ("options", "arrangement", "labels", "sonar", "trained_at"),
    )
    found += [f"{name} is not a text" for name in texts if not isinstance(table[name], str)]
    for name in (*tables, "weights", "data_recipe", "recipe", "metrics", "trained"):
        if not (isinstance(table[name], dict) and all(isinstance(key, str) for key in table[name])):
            found.append(f"{name} is not a table")
    if found:
        return found
    for name, values in table["weights"].items():
        if not isinstance(values, Tensor):
            found.append(f"weights {name} are not numbers")
        elif not _stored_whole(values):
            found.append(f"weights {name} stand for more numbers than the file holds")
        elif not torch.isfinite(values).all():
            found.append(f"weights {name} hold nan or inf")
    words = table["arrangement"]
    found += [f"arrangement {word} is not said" for word, kind in WORDS.items() if not isinstance(words.get(word), kind)]
    known = {**WORDS, **LATER}
    found += [f"arrangement {word} is unknown ({nearest_names(word, known)})" for word in words if word not in known]
    later = [word for word in LATER if word in words]
    found += [f"arrangement {word} is not said" for word in later if not isinstance(words[word], LATER[word])]
    if not found and not (words["views"] and all(isinstance(view, str) for view in words["views"])):
        found.append("arrangement views are not names")
    if not found:
        found += _faults_of_words(words)
    receives = words["kind"] == "response" if not found else False
    return found + _faults_of_labels(table["labels"]) + _faults_of_sonar(table["sonar"], table["trained_at"], receives)


def _faults_of_words(words: dict[str, Any]) -> list[str]:
    """What is wrong with an arrangement whose words have the right types."""
    known = {
        "kind": ("image", "vector", "response"),
        "layout": (*get_args(Layout), "columns"),
        "coordinates": (*get_args(Coordinates), "delay"),
    }
    found = [f"arrangement {word} is {words[word][:40]!r}" for word, names in known.items() if words[word] not in names]
    if not 1 <= words["frames"] <= 16 or not 0 <= words["cartesian_rows"] <= 2**24:
        found.append("arrangement frames or cartesian_rows cannot be")
    levels = words.get("range_levels")
    if levels is not None and not 1 <= levels <= 2**24:
        found.append("arrangement range_levels cannot be")
    return found


def _stored_whole(values: Tensor) -> bool:
    """Whether a tensor has a number in the file for each of its own: an expanded one asks for memory that nobody sent."""
    if values.layout != torch.strided or values.device.type != "cpu" or values.is_quantized:
        return False
    return values.numel() * values.element_size() <= values.untyped_storage().nbytes()


def _numbers_in(options: dict[str, Any]) -> list[tuple[str, float]]:
    """Numbers of a network's options, those of lists too, with the option's name."""
    pairs = [(name, one) for name, value in options.items() for one in (value if isinstance(value, list) else [value])]
    return [(name, one) for name, one in pairs if isinstance(one, int | float)]


def _faults_of_labels(labels: dict[str, Any]) -> list[str]:
    ends, names = [labels.get("low"), labels.get("high")], labels.get("names")
    if labels.get("kind") not in LABELS:
        return [f"labels are {labels.get('kind')!r}, not one of {', '.join(LABELS)}"]
    if not (isinstance(names, list) and names and all(isinstance(name, str) for name in names)):
        return ["labels have no names"]
    if not all(_are_numbers(end, len(names)) for end in ends):
        return ["the limits of the labels are not numbers, one a name"]
    return []


def _faults_of_sonar(sonar: dict[str, Any], trained_at: dict[str, Any], receives: bool) -> list[str]:
    if receives and list(sonar) != ["channel"]:
        return ["sonar has no channel"]
    for view, own in sonar.items():
        if not isinstance(own, dict):
            return [f"sonar {view} is not a table"]
        try:
            (ChannelSonar if receives else Sonar).create(**own)
        except (MitsonarError, TypeError) as error:
            return [f"sonar {view}: {error}"]
    angles = [trained_at.get("pitch_deg"), trained_at.get("roll_deg")]
    if not (_are_numbers(trained_at.get("height_m"), 2) and _are_numbers(angles, 2)):
        return ["stands must hold height_m (low, high), pitch_deg and roll_deg"]
    return []


def _are_numbers(values: Any, count: int) -> bool:
    """Whether this is a list of so many finite numbers."""
    numbers = isinstance(values, list) and len(values) == count
    return numbers and all(type(value) in (int, float) and math.isfinite(value) for value in values)


def _plain(value: Any, name: str) -> Any:
    """Numbers, texts, lists and tables only.

    Raises:
        MitsonarError: something else.
    """
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, list | tuple):
        return [_plain(one, name) for one in value]
    if isinstance(value, dict):
        return {str(key): _plain(one, name) for key, one in value.items()}
    raise MitsonarError(f"{name} of a checkpoint holds numbers, texts, lists and tables only: got {value!r}")


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _mismatch(error: RuntimeError) -> str:
    """What torch says of the first weight that does not fit."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join((lines[1] if len(lines) > 1 else lines[0]).split())[:300]


def _number(value: Any) -> str:
    return f"{value:,.4g}" if isinstance(value, float) else f"{value:,}" if type(value) is int else str(value)
