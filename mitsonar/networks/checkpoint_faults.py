"""What the file of a checkpoint may hold: it is unpacked and checked before anything in it is used."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Collection
from typing import Any, TypeAlias, TypeGuard, get_args

import torch
from torch import Tensor

from mitsonar.datasets.arrangement import LABELS, Coordinates, Layout
from mitsonar.datasets.modality import Fields
from mitsonar.errors import MitsonarError, nearest_names, shortened
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.files import check_plain

__all__ = ["FILE", "LARGEST", "WORDS", "are_numbers", "faults_of", "first_line", "unpacked"]

FILE = "network.ckpt"
"""Name of a checkpoint in the folder of a training run."""

Table: TypeAlias = dict[Any, Any]
"""What a file holds, before it is known that its keys are texts."""

WORDS = {
    "frames": int,
    "views": list,
    "kind": str,
    "layout": str,
    "coordinates": str,
    "cartesian_rows": int,
    "ground": bool,
}
"""The options of :class:`~mitsonar.datasets.samples.SonarPairs` that define the input of a network, with their types."""

LATER: dict[str, type | tuple[type, ...]] = {"range_levels": (int, type(None)), "halves": bool}
"""Options that files of earlier versions lack. They then have the defaults of SonarPairs."""

LARGEST = 8 * 2**30
"""Largest size of a checkpoint that is unpacked [bytes]."""


LONGEST_NAME = 80
"""Letters of a name in a message; those of a stranger's file may be of any length."""


def unpacked(content: bytes, source: str) -> Table:
    """Unpack the table in a file of torch. Its parts are checked, which torch does not do.

    Args:
        content: of the file.
        source: the file's name in messages.

    Raises:
        MitsonarError: not a file of torch, damaged, or one that would unpack to more than it is.
    """
    buffer = io.BytesIO(content)
    try:
        if not zipfile.is_zipfile(buffer):  # raises where the end says that parts lie in other files
            raise MitsonarError(f"{source} is not a checkpoint, or was cut off: give a {FILE} of `mitsonar train`")
        with zipfile.ZipFile(buffer) as parts:
            packed = [part for part in parts.infolist() if part.compress_type != zipfile.ZIP_STORED]
            if packed or sum(part.file_size for part in parts.infolist()) > min(LARGEST, len(content)):
                raise MitsonarError(
                    f"{source} would unpack to more than its own size, or than {LARGEST >> 30} GiB: it is none of mitsonar"
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
            f"{source} is damaged, or not a checkpoint of mitsonar ({first_line(error)}): give a {FILE} of `mitsonar train`"
        ) from None
    return table if isinstance(table, dict) else {}


def faults_of(table: Table, names: Collection[str]) -> list[str]:
    """Check the fields of a file. Return a sentence for each fault.

    Args:
        table: of the file.
        names: of the fields that a checkpoint has.
    """
    found = [f"it lacks {name}" for name in sorted(set(names) - set(table))]
    found += [f"{shortened(key)} is unknown" for key in table if key not in names]
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
        found += _faults_of_weights(name, values)
    words = table["arrangement"]
    found += _faults_of_arrangement(words) if not found else _faults_of_types(words)
    receives = words["kind"] == "response" if not found else False
    return found + _faults_of_labels(table["labels"]) + _faults_of_sonar(table["sonar"], table["trained_at"], receives)


def _faults_of_weights(name: str, values: object) -> list[str]:
    """Check one of the weights."""
    if not isinstance(values, Tensor):
        return [f"weights {name[:LONGEST_NAME]} are not numbers"]
    if not _stored_whole(values):
        return [f"weights {name[:LONGEST_NAME]} promise more numbers than the file holds"]
    if not torch.isfinite(values).all():
        return [f"weights {name[:LONGEST_NAME]} hold nan or inf"]
    return []


def _faults_of_types(words: Fields) -> list[str]:
    """Check the names and the types of an arrangement's options."""
    found = [
        f"arrangement {word} is missing or of another type"
        for word, kind in WORDS.items()
        if not isinstance(words.get(word), kind)
    ]
    known = {**WORDS, **LATER}
    found += [
        f"arrangement {word[:LONGEST_NAME]} is unknown ({nearest_names(word, known)})" for word in words if word not in known
    ]
    later = [word for word in LATER if word in words]
    return found + [
        f"arrangement {word} is missing or of another type" for word in later if not isinstance(words[word], LATER[word])
    ]


def _faults_of_arrangement(words: Fields) -> list[str]:
    """Check the options of an arrangement: their types first, then their values."""
    found = _faults_of_types(words)
    if found:
        return found
    if not (words["views"] and all(isinstance(view, str) for view in words["views"])):
        return ["arrangement views are not names"]
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
    """Return whether the file holds each number of a tensor. An expanded tensor would need memory that the file lacks."""
    if values.layout != torch.strided or values.device.type != "cpu" or values.is_quantized:
        return False
    return values.numel() * values.element_size() <= values.untyped_storage().nbytes()


def _faults_of_labels(labels: Fields) -> list[str]:
    """Check kind, names and limits of the labels."""
    ends, names = [labels.get("low"), labels.get("high")], labels.get("names")
    if labels.get("kind") not in LABELS:
        return [f"labels are {shortened(labels.get('kind'))}, not one of {', '.join(LABELS)}"]
    if not (isinstance(names, list) and names and all(isinstance(name, str) for name in names)):
        return ["labels have no names"]
    if not all(are_numbers(end, len(names)) for end in ends):
        return ["the limits of the labels are not numbers, one a name"]
    return []


def _faults_of_sonar(sonar: Fields, trained_at: Fields, receives: bool) -> list[str]:
    """Check the instrument of each view, and its geometry in training."""
    if receives and list(sonar) != ["channel"]:
        return ["sonar has no channel"]
    for view, own in sonar.items():
        if not isinstance(own, dict):
            return [f"sonar {view[:LONGEST_NAME]} is not a table"]
        try:
            (ChannelSonar if receives else Sonar).create(**own)
        except (MitsonarError, TypeError) as error:
            return [f"sonar {view[:LONGEST_NAME]}: {error}"]
    angles = [trained_at.get("pitch_deg"), trained_at.get("roll_deg")]
    if not (are_numbers(trained_at.get("height_m"), 2) and are_numbers(angles, 2)):
        return ["trained_at must hold height_m (low, high), pitch_deg and roll_deg"]
    return []


def are_numbers(values: object, count: int) -> TypeGuard[list[float]]:
    """Return whether this is a list of ``count`` finite numbers."""
    if not isinstance(values, list) or len(values) != count:
        return False
    return all(type(value) in (int, float) and math.isfinite(value) for value in values)


def first_line(error: Exception) -> str:
    """Return the first line of an error's message, cut where it is long, or its class."""
    return (str(error).splitlines() or [type(error).__name__])[0][:300]
