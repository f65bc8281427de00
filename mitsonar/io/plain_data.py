"""Contents of JSON and YAML files: tables, lists, texts and numbers of a plausible size, without circular references."""

from __future__ import annotations

import datetime
import itertools
import json
import math
import sys
from typing import Any, TypeAlias

import yaml

from mitsonar.errors import MitsonarError, shortened

__all__ = ["PlainValue", "check_plain", "finite_number", "parse_json", "parse_yaml", "whole_number"]

PlainValue: TypeAlias = Any
"""A value of a file: a table, list, text, number, date or None. Its reader checks which."""

DEEPEST = 40
"""Levels of lists and tables within each other, at most."""

MOST_VALUES = 2_000_000
"""Values of a file, at most. A value that is referred to counts each time."""

MOST_OF_YAML = 100_000
"""Values of a YAML file, at most; people write these files."""

MOST_BRACKETS = 200
"""Open brackets in a YAML text, at most; those in comments count too."""

LARGEST_INTEGER = 2**64
"""No seed and no count is larger."""

LARGEST_COUNT = 2**63 - 1
"""What NumPy can count to."""


def parse_json(text: str | bytes, source: str, *, check: bool = True) -> PlainValue:
    """Parse a JSON text.

    Args:
        text: of the file.
        source: is named in errors.
        check: its depth, size and integers; without, :func:`check_plain` is the caller's to call.

    Raises:
        MitsonarError: not JSON, or a depth, size or integer beyond the limits of this module.
    """
    try:
        value = json.loads(text)
    except RecursionError:
        raise MitsonarError(f"{source} nests more than {DEEPEST} deep: it is damaged") from None
    except ValueError as error:
        raise MitsonarError(f"cannot read {source}: it is not JSON ({' '.join(str(error).split())[:160]})") from None
    if check:
        check_plain(value, source)
    return value


def parse_yaml(text: str, source: str) -> PlainValue:
    """Parse a YAML text; nothing in it is executed.

    Args:
        text: of the file.
        source: is named in errors.

    Raises:
        MitsonarError: not YAML, a circular reference, or a depth, size or integer beyond the limits of this module.
    """
    if _brackets(text) > MOST_BRACKETS:  # PyYAML would need seconds to reject it
        raise MitsonarError(f"{source} is not YAML: it nests more than {DEEPEST} deep")
    loader: yaml.SafeLoader | None = None
    try:
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _check_nodes(node, source)
        value = loader.construct_document(node)
    except MitsonarError:
        raise
    except RecursionError:
        raise MitsonarError(f"{source} is not YAML: it nests more than {DEEPEST} deep") from None
    except Exception as error:  # constructors of numbers and dates raise errors of many kinds
        raise MitsonarError(f"{source} is not YAML: {' '.join(str(error).split())[:300] or type(error).__name__}") from None
    finally:
        if loader is not None:
            loader.dispose()
    check_plain(value, source, MOST_OF_YAML)
    return value


def check_plain(value: object, source: str, most: int = MOST_VALUES) -> None:
    """Check that a value holds only tables, lists, texts, numbers and dates, within limits of depth and size.

    Args:
        value: from a reader of JSON, YAML or pickles.
        source: is named in errors.
        most: largest number of values that it may hold.

    Raises:
        MitsonarError: it is not.
    """
    rest: list[tuple[object, int]] = [(value, 0)]
    count = 0
    while rest:
        one, depth = rest.pop()
        count += 1
        if depth > DEEPEST or count > most:
            too = f"nests more than {DEEPEST} deep" if depth > DEEPEST else f"holds more than {most:,} values"
            raise MitsonarError(f"{source} {too}, or refers to itself: it is damaged")
        if isinstance(one, dict):
            rest += [(inner, depth + 1) for pair in one.items() for inner in pair]
        elif isinstance(one, list | tuple | set):
            rest += [(inner, depth + 1) for inner in one]
        elif type(one) is int:
            if abs(one) > LARGEST_INTEGER:
                raise MitsonarError(f"{source} holds an integer of {one.bit_length():,} bits: integers have at most 64")
        elif not (one is None or isinstance(one, str | bytes | bool | float | datetime.date)):
            raise MitsonarError(f"{source} holds a {type(one).__name__}: only tables, lists, texts and numbers are known")


def whole_number(value: object, name: str, low: int = 0, high: int = LARGEST_COUNT) -> int:
    """Check that a value of a file is an integer within limits, and return it.

    Raises:
        MitsonarError: it is no integer, or outside ``low`` .. ``high``.
    """
    if type(value) is not int or not low <= value <= high:
        top = "2^63" if high == LARGEST_COUNT else f"{high:,}"
        raise MitsonarError(f"{name} must be a whole number in {low:,}..{top}: got {shortened(value)}")
    return value


def finite_number(value: Any, name: str, above: float = -math.inf, below: float = math.inf) -> float:
    """Check that a value of a file is a finite number, and return it as a float.

    Raises:
        MitsonarError: it is none, not finite, or not between ``above`` and ``below``.
    """
    if type(value) not in (int, float) or not above < value < below or abs(value) > sys.float_info.max:
        over = "" if above == -math.inf else f" above {above:g}"
        under = "" if below == math.inf else f" below {below:g}"
        raise MitsonarError(f"{name} must be a finite number{over}{under}: got {shortened(value)}")
    return float(value)


def _brackets(text: str) -> int:
    """Return how many brackets are open at most; those in texts and comments count too."""
    return max(itertools.accumulate((one in "[{") - (one in "]}") for one in text if one in "[]{}"), default=0)


def _check_nodes(node: yaml.Node, source: str) -> None:
    """Check depth and size of a YAML document before its values are made. An alias counts as all that it refers to."""
    rest, count = [(node, 0)], 0
    while rest:
        one, depth = rest.pop()
        count += 1
        if depth > DEEPEST or count > MOST_OF_YAML:
            raise MitsonarError(
                f"{source} is not YAML that can be read: it nests more than {DEEPEST} deep, refers to itself, or holds more "
                f"than {MOST_OF_YAML:,} values"
            )
        if isinstance(one, yaml.MappingNode):
            rest += [(inner, depth + 1) for pair in one.value for inner in pair]
        elif isinstance(one, yaml.SequenceNode):
            rest += [(inner, depth + 1) for inner in one.value]
