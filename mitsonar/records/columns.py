"""Checks of the arrays of a file: type, shape and values, before anything is computed from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, cast

import numpy as np

from mitsonar.errors import MitsonarError
from mitsonar.io.files import FileArray, PlainValue, finite_number, parse_json, read_json, refuse_beyond_memory, whole_number

if TYPE_CHECKING:
    import zarr

__all__ = [
    "FEW_ROWS",
    "Column",
    "StoredArray",
    "arrays_in",
    "check_column",
    "number_of",
    "open_group",
    "rows_that_fit",
    "table_in",
    "text_of",
]

StoredArray: TypeAlias = Any
"""An array of NumPy or Zarr, with dtype, shape and ndim."""

MOST_DIMENSIONS = 4
PIECES_A_ROW = 64
"""Chunks of a row of an array, at most."""

ROWS_A_BYTE = 200
"""Rows of a byte of a compressed array, at most: times and poses differ from row to row."""

FEW_ROWS = 100_000
"""Rows that a file of any size may have."""


@dataclass(frozen=True)
class Column:
    """Required type, shape and values of an array.

    Attributes:
        dims: names of its dimensions; the same name has the same length everywhere.
        kinds: NumPy's letters of its types: f float, u and i integers, c complex.
        low: least value.
        high: greatest value.
        nan: whether it may hold nan.
        order: along its first dimension: ``strict`` grows, ``same`` does not fall, ``any``.
    """

    dims: tuple[str, ...]
    kinds: str = "f"
    low: float = -math.inf
    high: float = math.inf
    nan: bool = False
    order: Literal["strict", "same", "any"] = "any"


def check_column(values: StoredArray, name: str, column: Column, sizes: Mapping[str, int], source: str) -> None:
    """Check an array.

    Args:
        values: the array. Of an array of Zarr only type and shape are checked.
        name: of the array, for errors.
        column: requirements on it.
        sizes: known lengths of dimensions.
        source: is named in errors.

    Raises:
        MitsonarError: it does not meet them.
    """
    wanted = tuple(sizes.get(dim, length) for dim, length in zip(column.dims, values.shape, strict=False))
    if values.dtype.kind not in column.kinds or values.ndim != len(column.dims) or values.shape != wanted:
        shape = ", ".join(f"{dim} {sizes[dim]:,}" if dim in sizes else dim for dim in column.dims)
        kinds = " or ".join({"f": "float", "i": "int", "u": "uint", "c": "complex"}[kind] for kind in column.kinds)
        raise MitsonarError(
            f"{source}: {name} must be {kinds} of the shape ({shape}): got {str(values.dtype)[:20]} {str(values.shape)[:60]}"
        )
    if isinstance(values, np.ndarray) and values.size:
        _check_values(values, name, column, source)


def _check_values(values: FileArray, name: str, column: Column, source: str) -> None:
    if values.dtype.kind in "fc" and not np.isfinite(values).all():
        if not column.nan or np.isinf(values).any():
            raise MitsonarError(f"{source}: {name} holds nan or inf; the file is damaged, or was written by something else")
        if np.isnan(values).all():
            return
    if values.dtype.kind != "c":
        low, high = np.nanmin(values), np.nanmax(values)
        if low < column.low or high > column.high:
            raise MitsonarError(f"{source}: {name} must lie in {column.low:g}..{column.high:g}: got {low:.6g}..{high:.6g}")
    if column.order != "any" and len(values) > 1:
        steps = np.diff(values, axis=0)
        if (steps < 0).any() or (column.order == "strict" and not (steps > 0).all()):
            wanted = "grow" if column.order == "strict" else "not fall"
            raise MitsonarError(f"{source}: {name} must {wanted} from row to row")


def text_of(table: Mapping[str, StoredArray], name: str, default: str | None = None) -> str:
    """Return a text of a table of arrays.

    Raises:
        MitsonarError: it is no text.
    """
    value = np.asarray(table[name]) if name in table else np.asarray(default)
    if value.ndim or value.dtype.kind != "U":
        raise MitsonarError(f"{name} must be one text: got {str(value.dtype)[:20]} {str(value.shape)[:40]}")
    return str(value)


def number_of(table: Mapping[str, StoredArray], name: str, default: float) -> float:
    """Return a finite number above 0 of a table of arrays.

    Raises:
        MitsonarError: it is something else.
    """
    value = np.asarray(table.get(name, default))
    single = value.ndim == 0 and value.dtype.kind in "fiu"
    return finite_number(float(value) if single else str(value), name, above=0)


def table_in(table: Mapping[str, StoredArray], name: str, source: str, default: str | None = None) -> dict[str, PlainValue]:
    """Parse the JSON object in a text of a table of arrays.

    Raises:
        MitsonarError: the text is no JSON object.
    """
    try:
        value = parse_json(text_of(table, name, default), f"the field {name}")
    except MitsonarError as error:
        raise MitsonarError(f"{source}: the field {name} is not JSON ({error}); the file is damaged") from None
    if not isinstance(value, dict):
        raise MitsonarError(f"{source}: the field {name} is not JSON of a table; the file is damaged")
    return value


# ---------------------------------------------------------------- Zarr


def open_group(
    path: Path, columns: Mapping[str, Column], rows: str, done: str | None = None
) -> tuple[dict[str, StoredArray], int]:
    """Open the arrays and attributes of a Zarr group. Their values are not read yet.

    Types, shapes and chunks of all arrays are checked against each other and against the bytes of the array ``rows``.

    Args:
        path: of the group.
        columns: requirements on its arrays; other arrays may be present.
        rows: name of the array that has a number for each row.
        done: name of the attribute with the number of rows that are written, if there is one.

    Returns:
        Arrays of Zarr and attributes (as arrays of NumPy) by name, and the number of rows that are written.

    Raises:
        Exception: a damaged group raises errors of many kinds. The caller puts them into words.
    """
    group, arrays = arrays_in(path, "r")
    if rows not in arrays or arrays[rows].ndim not in (1, 2) or arrays[rows].dtype.kind != "f":
        raise ValueError(f"it lacks {rows}, a number for each row")
    count = int(arrays[rows].shape[0])
    stored = sum(one.stat().st_size for one in (path / rows).rglob("*") if one.is_file() and one.name != "zarr.json")
    if count > rows_that_fit(stored):
        raise ValueError(f"{count:,} rows are more than the {stored:,} bytes of {rows} can hold")
    for name, array in arrays.items():
        _check_pieces(name, array)
        if name in columns and name != rows:
            check_column(array, name, columns[name], {columns[rows].dims[0]: count}, "it")
    attributes = dict(group.attrs)
    written = count if done is None else attributes.pop(done, count)
    written = whole_number(written, str(done), 0, count)
    return {**arrays, **{name: np.array(value) for name, value in attributes.items()}}, written


def arrays_in(path: Path, mode: Literal["r", "r+"]) -> tuple[zarr.Group, dict[str, StoredArray]]:
    """Open a Zarr group in a folder, and its arrays by name. Their metadata are checked before Zarr reads them.

    Arrays are opened one by one: of several at once Zarr would print the errors of all.

    Raises:
        Exception: a damaged group raises errors of many kinds. The caller puts them into words.
    """
    import zarr

    from mitsonar.io.storage import refuse_codecs

    names = sorted(one.parent.name for one in path.glob("*/zarr.json"))
    for name in ("", *names):
        metadata = read_json(path / name / "zarr.json")
        for length in metadata["shape"] if name else ():
            whole_number(length, f"a length of {name}")
    group = zarr.open_group(path, mode=mode, zarr_format=3)
    arrays = {name: group[name] for name in names}
    if not all(isinstance(array, zarr.Array) for array in arrays.values()):
        raise ValueError("it holds groups where arrays should be")
    for array in arrays.values():
        refuse_codecs(cast("zarr.Array[Any]", array))
    return group, arrays


def rows_that_fit(stored: int) -> int:
    """Return the largest number of rows that so many compressed bytes may hold."""
    return max(FEW_ROWS, ROWS_A_BYTE * stored)


def _check_pieces(name: str, array: StoredArray) -> None:
    """Check that an array can be read in finite time and memory."""
    if array.ndim > MOST_DIMENSIONS or array.dtype.kind not in "biufc":
        raise ValueError(f"{name} holds no numbers, or has more than {MOST_DIMENSIONS} dimensions")
    if any(piece < 1 for piece in array.chunks):
        raise ValueError(f"{name} is cut into pieces of nothing")
    pieces = math.prod(-(-length // piece) for length, piece in zip(array.shape, array.chunks, strict=True))
    if pieces > PIECES_A_ROW * max(1, array.shape[0] if array.ndim else 1):
        raise ValueError(f"{name} is cut into {pieces:,} pieces")
    refuse_beyond_memory(math.prod(array.chunks) * array.dtype.itemsize, name)
