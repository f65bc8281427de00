"""Pickles that hold tables of NumPy arrays, read without running anything that they name.

Pickles are programs. This reader knows the few names that an array consists of, and answers each with an object that only
remembers what it is given. Any other name is refused. Arrays are made of the remembered bytes after a check of their sizes.
"""

from __future__ import annotations

import io
import math
import pickle
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from mitsonar.errors import MitsonarError
from mitsonar.io.files import FileArray, read_bytes

__all__ = ["read_pickled_arrays"]

LARGEST = 2**30
"""Bytes of a pickle, at most."""

MOST_DIMENSIONS = 8

NUMBERS = "biuf"
"""Kinds of NumPy's types that are read."""

Remembered = Any
"""What a pickle gives: numbers, texts, bytes, tuples, lists, tables, and the objects of this module."""


class _Remembers:
    """An object of a pickle: what it was made with, and the state that it was given."""

    def __init__(self, *made_with: Remembered) -> None:
        self.made_with = made_with
        self.state: Remembered = None

    def __setstate__(self, state: Remembered) -> None:
        self.state = state


class _Array(_Remembers):
    """An array: its state is version, shape, type, Fortran order, bytes."""


class _Kind(_Remembers):
    """A type: made with its name; its state begins with version and order of bytes."""


class _Scalar(_Remembers):
    """A number of NumPy: made with its type and bytes."""


class _Class(_Remembers):
    """A class that is only named."""


def _encode(text: Remembered, coding: Remembered) -> bytes:
    """Return bytes that old pickles write as text of Latin 1."""
    if not isinstance(text, str) or coding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError("bytes that are no text of Latin 1")
    return text.encode("latin1")


KNOWN: dict[tuple[str, str], Any] = {
    **{
        (f"numpy.{core}.{module}", name): made
        for core in ("core", "_core")
        for module, name, made in (
            ("multiarray", "_reconstruct", _Array),
            ("multiarray", "scalar", _Scalar),
            ("numeric", "_frombuffer", _Array),
        )
    },
    ("numpy", "ndarray"): _Class,
    ("numpy", "dtype"): _Kind,
    ("_codecs", "encode"): _encode,
}
"""Names that a pickle may say, and what answers them."""


class _Reader(pickle._Unpickler):  # the one in Python, whose memory follows the file's size
    """Unpickles known names only, and gives states to the objects of this module only."""

    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)
    stack: list[Any]

    def find_class(self, module: str, name: str) -> Any:
        """Return what answers a name.

        Raises:
            UnpicklingError: another name.
        """
        if (module, name) not in KNOWN:
            raise pickle.UnpicklingError(f"it names {module[:60]}.{name[:60]}, which is no part of an array")
        return KNOWN[module, name]

    def persistent_load(self, pid: Any) -> Any:
        """Refuse what lies outside of the file."""
        raise pickle.UnpicklingError("it refers to another file")

    def load_build(self) -> None:
        """Give a state to the object on the stack."""
        if not isinstance(self.stack[-2], _Remembers):
            raise pickle.UnpicklingError("it changes something that is no array")
        state = self.stack.pop()
        self.stack[-1].__setstate__(state)

    dispatch[pickle.BUILD[0]] = load_build


def read_pickled_arrays(path: Path) -> dict[str, FileArray]:
    """Read the arrays and numbers of the table in a pickle, by name; what is neither is left out.

    Raises:
        MitsonarError: no such file, no table, or a pickle that names anything but NumPy's arrays.
    """
    content = read_bytes(path, "pickle", LARGEST)
    try:
        found = _Reader(io.BytesIO(content)).load()
        if not isinstance(found, dict):
            raise pickle.UnpicklingError("it holds no table")
        return {str(name): array for name, value in found.items() if (array := _array(value)) is not None}
    except Exception as error:  # damaged bytes raise errors of many kinds
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise MitsonarError(f"cannot read the pickle {path}: {reason}; only arrays of NumPy are read from pickles") from None


def _array(value: Remembered) -> FileArray | None:
    """Return the array that a value stands for; None where it is none."""
    if isinstance(value, bool | int | float):
        return np.asarray(value, dtype=float) if abs(value) < 1e300 or value != value else None
    if isinstance(value, _Scalar):
        kind, content = (*value.made_with, None, None)[:2]
        return _from_bytes(content, kind, (), "C")
    if not isinstance(value, _Array):
        return None
    if value.state is None:  # _frombuffer: bytes, type, shape, order
        content, kind, shape, order = (*value.made_with, None, None, None, None)[:4]
        return _from_bytes(content, kind, shape, order)
    if not isinstance(value.state, tuple) or len(value.state) != 5:
        raise ValueError("an array has a state that cannot be")
    _, shape, kind, fortran, content = value.state
    return _from_bytes(content, kind, shape, "F" if fortran else "C")


def _from_bytes(content: Remembered, kind: Remembered, shape: Remembered, order: Remembered) -> FileArray:
    """Make an array of bytes, after its type and shape are checked against their number."""
    if not isinstance(kind, _Kind) or not kind.made_with or not isinstance(kind.made_with[0], str):
        raise ValueError("an array has a type that cannot be")
    name = kind.made_with[0]
    swapped = isinstance(kind.state, tuple) and len(kind.state) > 1 and kind.state[1] == ">"
    if name[:1] not in NUMBERS or not name[1:].isdigit() or len(name) > 3:
        raise ValueError(f"an array of type {name[:20]} holds no numbers")
    made = np.dtype(name).newbyteorder(">" if swapped else "<")
    if not isinstance(shape, tuple) or len(shape) > MOST_DIMENSIONS or order not in ("C", "F"):
        raise ValueError("an array has a shape that cannot be")
    if not all(type(length) is int and 0 <= length < 2**40 for length in shape):
        raise ValueError("an array has a shape that cannot be")
    if not isinstance(content, bytes | bytearray) or math.prod(shape) * made.itemsize != len(content):
        raise ValueError("an array has another number of bytes than its shape says")
    return np.frombuffer(bytes(content), made).reshape(shape, order=order).astype(made.newbyteorder("="))
