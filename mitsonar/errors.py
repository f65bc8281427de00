"""Raise errors and warnings that a user can act on: what is wrong, what was given, what is allowed, what to do."""

from __future__ import annotations

import difflib
import itertools
import re
import reprlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import BaseModel, ValidationError
    from pydantic_core import ErrorDetails


__all__ = [
    "MitsonarError",
    "MitsonarWarning",
    "argument",
    "check_argument_names",
    "count_noun",
    "did_you_mean",
    "missing_package_error",
    "one_line",
    "printable",
    "short_repr",
    "suggest_names",
    "validation_message",
]

EXTRAS = {
    "distributed": ("data", "making a data set on several processes"),
    "dask": ("data", "making a data set on several processes"),
    "trimesh": ("data,meshes", "worlds and models"),
    "collada": ("meshes", "reading a .dae model"),
    "lxml": ("meshes", "reading a .dae model"),
    "pxr": ("usd", "reading USD"),
    "gymnasium": ("rl", "environments"),
    "cv2": ("odometry", "estimating motion and laying mosaics"),
    "tifffile": ("odometry", "writing GeoTIFF"),
    "torch": ("learn", "networks, and reading data sets for them,"),
    "lightning": ("learn", "training"),
    "torchmetrics": ("learn", "training"),
    "onnx": ("learn", "writing ONNX"),
    "onnxscript": ("learn", "writing ONNX"),
    "sklearn": ("learn", "classical regression"),
    "s3fs": ("s3", "object storage"),
    "rosbags": ("ros", "reading ROS bags and writing MCAP"),
    "mcap": ("ros", "writing MCAP"),
    "pytritech": ("gemini", "reading GLF files of a Gemini"),
    "foxglove": ("live", "a live sonar"),
    "websockets": ("live", "a client of a live sonar"),
    "rerun": ("view", "showing frames in Rerun"),
    "small_gicp": ("bench", "the estimator cfar-gicp"),
    "pystackreg": ("bench", "the estimator stackreg"),
}
"""Optional packages, with the extras that install each and the tasks that need it."""

MAX_KEY_LENGTH = 60
"""Maximum number of characters of a key in a message; keys in input files may be arbitrarily long."""

MAX_LIST_LENGTH = 500
"""Maximum number of characters of a list of names in a message."""

ARGUMENT_DELIMITER = "\x1f"
"""Control character that delimits argument names in messages; never displayed."""


def one_line(text: str) -> str:
    """Return a text as one line of printable characters: names in files may contain line breaks."""
    return printable(re.sub(r"\s*[\n\r\v\f\x85\u2028\u2029]\s*", " ", text.strip()))


def printable(text: str) -> str:
    """Return a text with escapes in place of all characters that would control a terminal, except line breaks."""
    return "".join(one if one.isprintable() or one == "\n" else repr(one)[1:-1] for one in text)


class MitsonarError(ValueError):
    """Error caused by invalid or unusable input. The command line prints the message and exits with code 2."""

    def __str__(self) -> str:
        return self.with_options({})

    def with_options(self, options: Mapping[str, str]) -> str:
        """Return the message as one line, with the names of marked arguments replaced by command-line options.

        Args:
            options: command-line options, keyed by the argument that :func:`mitsonar.errors.argument` marks, such as
                ``{"height_m": "--height"}``. Other arguments keep their Python names.
        """

        def option_of(match: re.Match[str]) -> str:
            return options.get(match[1].rpartition(" ")[2], match[1])

        marked = f"{ARGUMENT_DELIMITER}([^{ARGUMENT_DELIMITER}]*){ARGUMENT_DELIMITER}"
        return one_line(re.sub(marked, option_of, super().__str__()))


def argument(name: str) -> str:
    """Mark the name of an argument in the message of a :class:`MitsonarError`.

    The command line replaces it by the corresponding option, if there is one.

    Args:
        name: name of the argument, optionally after the noun for its owner, as in ``sonar model``. The option
            replaces both.
    """
    return f"{ARGUMENT_DELIMITER}{name}{ARGUMENT_DELIMITER}"


class MitsonarWarning(UserWarning):
    """Warning about a result that is valid, but has a limitation that the user should know."""


def missing_package_error(error: ModuleNotFoundError) -> MitsonarError:
    """Return an error that states which extra installs a missing optional package.

    Raises:
        ModuleNotFoundError: the original error, if no extra installs the module.
    """
    package = (error.name or "").partition(".")[0]
    if package not in EXTRAS:
        raise error
    extra, what = EXTRAS[package]
    needs = "need" if what.endswith("s") else "needs"
    return MitsonarError(f"{what} {needs} {package}, which is not installed: pip install 'mitsonar[{extra}]'")


def suggest_names(wrong: str, names: Iterable[str]) -> str:
    """Format the known names for the end of an error message, after a suggestion of those similar to ``wrong``.

    Of many names the first are listed, and none if one is similar.
    """
    known = list(names)
    similar = [name for name in known if wrong and wrong.lower() in name.lower()]
    similar = similar or difflib.get_close_matches(wrong.lower(), known, n=3, cutoff=0.5)
    shown = sum(length <= MAX_LIST_LENGTH for length in itertools.accumulate(len(name) + 2 for name in known))
    listed = ", ".join(known[:shown])
    guess = f"did you mean {' or '.join(similar)}?" if similar else ""
    if shown < len(known):
        return guess or f"known: {listed}, ... ({len(known)} names)"
    return f"{guess} Known: {listed}" if guess else f"known: {listed}"


def count_noun(number: int, noun: str, plural: str = "") -> str:
    """Format a number with its noun for messages: ``1 frame``, ``1,200 frames``."""
    return f"{number:,} {noun if number == 1 else plural or f'{noun}s'}"


def did_you_mean(wrong: object, names: Iterable[str]) -> str:
    """Format a suggestion of the most similar name, for the end of a message; empty if no name is similar."""
    similar = difflib.get_close_matches(str(wrong).lower(), [str(name) for name in names], n=1, cutoff=0.5)
    return f"; did you mean {similar[0]}?" if similar else ""


def check_argument_names(given: Iterable[str], known: Iterable[str], owner: str) -> None:
    """Reject keyword arguments with unknown names.

    Args:
        given: names of the given arguments.
        known: names of the valid arguments.
        owner: function or class that takes the arguments, for the message.

    Raises:
        MitsonarError: a name is unknown; the message suggests similar names and lists all valid ones.
    """
    names = list(known)
    for name in given:
        if name not in names:
            raise MitsonarError(f"{owner} has no argument {name}: {suggest_names(name, names)}")


def validation_message(error: ValidationError, model: type[BaseModel], what: str, see: str = "") -> str:
    """Format a pydantic validation error as one sentence: what is wrong, what was given, what is allowed.

    Only the first error is reported; unknown keys come first.

    Args:
        error: the error raised by pydantic.
        model: model whose fields are the valid keys.
        what: noun for the object that the keys describe, such as ``sonar``.
        see: end of the sentence, such as a reference to a documentation page.
    """
    first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")  # a misspelt key also makes one missing
    where = [str(part) for part in first["loc"]]
    key = ".".join(part if len(part) <= MAX_KEY_LENGTH else f"{part[:MAX_KEY_LENGTH]}..." for part in where)
    if first["type"] == "extra_forbidden":
        known = _fields_of(model, where[:-1]) or model.model_fields
        return f"unknown {what} key {key}: {suggest_names(where[-1], known)}"
    if first["type"] == "missing":
        return f"{what} lacks {key}{see}"
    if first["type"] == "value_error":
        reason = str(first["ctx"]["error"])
        return f"{argument(f'{what} {key}')}: {reason}" if where else reason
    message = first["msg"][0].lower() + first["msg"][1:]
    return f"{argument(f'{what} {key}')}: {message}, got {short_repr(first['input'])}{_suggest_literal(first)}{see}"


def _suggest_literal(error: ErrorDetails) -> str:
    """Suggest the most similar allowed value if the given one is not allowed."""
    if error["type"] != "literal_error":
        return ""
    return did_you_mean(error["input"], re.findall(r"'([^']*)'", str(error["ctx"]["expected"])))


def short_repr(value: object) -> str:
    """Return the repr of a value, truncated if it is long. Huge and self-referential values are safe."""
    if isinstance(value, int) and abs(value) > 10**40:
        return f"an integer of {value.bit_length():,} bits"
    brief = reprlib.Repr()
    brief.maxstring = brief.maxother = brief.maxlong = 80
    return brief.repr(value)


def _fields_of(model: type[BaseModel], where: list[str]) -> dict[str, object]:
    """Return the fields of a nested model; empty if the annotation does not name exactly one model."""
    from pydantic import BaseModel

    for name in where:
        if name.isdigit():  # an index in a list
            continue
        field = model.model_fields.get(name)
        nested = [member for member in _classes_in(field.annotation if field else None) if issubclass(member, BaseModel)]
        if len(nested) != 1:
            return {}
        model = nested[0]
    return dict(model.model_fields)


def _classes_in(annotation: object) -> list[type]:
    """List the classes in an annotation: ``list[A] | None`` contains A and NoneType."""
    from typing import get_args

    parts = get_args(annotation)
    if parts:
        return [member for part in parts for member in _classes_in(part)]
    return [annotation] if isinstance(annotation, type) else []
