"""What goes wrong, in words a user can act on: what, got, allowed, what to do."""

from __future__ import annotations

import difflib
import re
import reprlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pydantic import BaseModel, ValidationError


__all__ = [
    "MitsonarError",
    "MitsonarWarning",
    "argument",
    "complaint",
    "explain_missing",
    "meant",
    "nearest_names",
    "shortened",
]

EXTRAS = {
    "distributed": ("data", "making a data set on several processes"),
    "dask": ("data", "making a data set on several processes"),
    "trimesh": ("meshes", "worlds and models"),
    "collada": ("meshes", "reading a .dae model"),
    "lxml": ("meshes", "reading a .dae model"),
    "cv2": ("odometry", "estimating motion and laying mosaics"),
    "tifffile": ("odometry", "writing GeoTIFF"),
    "torch": ("learn", "networks, and reading data sets for them,"),
    "lightning": ("learn", "training"),
    "torchmetrics": ("learn", "training"),
    "onnx": ("learn", "writing ONNX"),
    "onnxscript": ("learn", "writing ONNX"),
    "sklearn": ("learn", "classical regression"),
    "s3fs": ("s3", "object storage"),
}
"""Packages that a plain installation lacks: the extra that brings them, and what needs them."""

MARK = "\x1f"
"""Stands before and after an argument's name in a message, and is never shown."""


class MitsonarError(ValueError):
    """An input that mitsonar cannot work with. The command line prints it and exits with code 2."""

    def __str__(self) -> str:
        return self.said({})

    def said(self, options: Mapping[str, str]) -> str:
        """The message with the words of who reads it.

        Args:
            options: what stands for arguments that :func:`argument` names, ``{"height_m": "--height"}``; others keep their
                Python names.
        """

        def typed(found: re.Match[str]) -> str:
            return options.get(found[1].rpartition(" ")[2], found[1])

        return re.sub(f"{MARK}([^{MARK}]*){MARK}", typed, super().__str__())


def argument(name: str) -> str:
    """Name an argument in the message of a :class:`MitsonarError`: where the command line has an option for it, that is
    printed instead.

    Args:
        name: of the argument, perhaps after words on what it belongs to, which an option does not need: ``sonar model``.
    """
    return f"{MARK}{name}{MARK}"


class MitsonarWarning(UserWarning):
    """A result that stands, but that the user should know something about."""


def explain_missing(error: ModuleNotFoundError) -> MitsonarError:
    """Turn an absent optional package into a sentence that names the extra which brings it.

    Raises:
        ModuleNotFoundError: the error itself, where no extra brings that module.
    """
    package = (error.name or "").partition(".")[0]
    if package not in EXTRAS:
        raise error
    extra, what = EXTRAS[package]
    return MitsonarError(f"{what} needs {package}, which is not installed: pip install 'mitsonar[{extra}]'")


def nearest_names(wrong: str, names: Iterable[str]) -> str:
    """The known names, nearest to ``wrong`` first, for the end of an error message."""
    known = list(names)
    near = [name for name in known if wrong and wrong.lower() in name.lower()]
    near = near or difflib.get_close_matches(wrong.lower(), known, n=3, cutoff=0.5)
    return f"did you mean {' or '.join(near)}? Known: {', '.join(known)}" if near else f"known: {', '.join(known)}"


def meant(wrong: object, names: Iterable[str]) -> str:
    """Ask for the nearest of some names, for the end of a message that lists them; empty where none is near."""
    near = difflib.get_close_matches(str(wrong).lower(), [str(name) for name in names], n=1, cutoff=0.5)
    return f"; did you mean {near[0]}?" if near else ""


def complaint(error: ValidationError, model: type[BaseModel], what: str, see: str = "") -> str:
    """The first of pydantic's complaints as one sentence: what, got, allowed.

    Args:
        error: what pydantic raised.
        model: whose fields are the known keys.
        what: what the keys belong to, in the sentence: ``sonar``.
        see: where more is said, for the end of the sentence.
    """
    first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")  # a typing slip explains what is missing
    where = [str(part) for part in first["loc"]]
    key = ".".join(where)
    if first["type"] == "extra_forbidden":
        known = _fields_of(model, where[:-1]) or model.model_fields
        return f"unknown {what} key {key}: {nearest_names(where[-1], known)}"
    if first["type"] == "missing":
        return f"{what} lacks {key}{see}"
    if first["type"] == "value_error":
        said = str(first["ctx"]["error"])
        return f"{argument(f'{what} {key}')}: {said}" if where else said
    message = first["msg"][0].lower() + first["msg"][1:]
    return f"{argument(f'{what} {key}')}: {message}, got {shortened(first['input'])}{_meant(first)}{see}"


def _meant(error: Mapping[str, Any]) -> str:
    """The nearest of the names that a key may have, where its value is none of them."""
    if error["type"] != "literal_error":
        return ""
    return meant(error["input"], re.findall(r"'([^']*)'", str(error["ctx"]["expected"])))


def shortened(value: object) -> str:
    """A value as Python writes it, cut where it is long: it may be huge, or refer to itself."""
    if isinstance(value, int) and abs(value) > 10**40:
        return f"an integer of {value.bit_length():,} bits"
    brief = reprlib.Repr()
    brief.maxstring = brief.maxother = brief.maxlong = 80
    return brief.repr(value)


def _fields_of(model: type[BaseModel], where: list[str]) -> dict[str, object]:
    """The fields of a model nested in another; empty where it cannot be told."""
    from pydantic import BaseModel

    for name in where:
        if name.isdigit():  # a place in a list
            continue
        field = model.model_fields.get(name)
        nested = [kind for kind in _kinds(field.annotation if field else None) if issubclass(kind, BaseModel)]
        if len(nested) != 1:
            return {}
        model = nested[0]
    return dict(model.model_fields)


def _kinds(annotation: object) -> list[type]:
    """The classes in an annotation: ``list[A] | None`` holds A and NoneType."""
    from typing import get_args

    parts = get_args(annotation)
    if parts:
        return [kind for part in parts for kind in _kinds(part)]
    return [annotation] if isinstance(annotation, type) else []
