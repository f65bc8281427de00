"""Read tables from CSV files of data sets, with columns selected by name or index and checked numbers."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, suggest_names
from mitsonar.io.files import read_bytes

__all__ = ["CsvTable"]

MAX_BYTES = 2**29
"""Largest size of a table [bytes]."""


class CsvTable:
    """A CSV file with a header line; all rows have as many cells as the header."""

    def __init__(self, path: Path) -> None:
        """Read a table.

        Raises:
            MitsonarError: no such file, not a table, or a row of another length.
        """
        self.path = path
        text = read_bytes(path, "table", MAX_BYTES).decode("utf-8-sig", "replace")
        try:
            rows = [row for row in csv.reader(io.StringIO(text)) if any(word.strip() for word in row)]
        except csv.Error as error:
            reason = "it is not text" if "\0" in text or "new-line" in str(error) else error
            raise MitsonarError(f"cannot read the table {path}: {reason}; give a CSV file") from None
        if len(rows) < 2:
            raise MitsonarError(f"{path} holds no table: it needs a line of names and rows below it")
        self.names = [name.strip() for name in rows[0]]
        self.rows = rows[1:]
        uneven = next((number for number, row in enumerate(self.rows, 2) if len(row) != len(self.names)), None)
        if uneven is not None:
            raise MitsonarError(
                f"row {uneven:,} of {path} has {len(self.rows[uneven - 2]):,} cells, its first line has {len(self.names):,}"
            )

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.rows)

    def numbers(self, name: str, default: float | None = None) -> NDArray[np.float64]:
        """Return a column ``(rows,)`` by name; cells that are not numbers are nan.

        Raises:
            MitsonarError: no such column, and no default.
        """
        if name not in self.names:
            if default is not None:
                return np.full(len(self), default)
            raise MitsonarError(f"{self.path} has no column {name}: {suggest_names(name, self.names)}")
        return self.at(self.names.index(name))

    def whole(self, name: str) -> NDArray[np.int64]:
        """Return a column of integers ``(rows,)`` by name, exact to the last digit; invalid cells are -1."""
        if name not in self.names:
            raise MitsonarError(f"{self.path} has no column {name}: {suggest_names(name, self.names)}")
        return self.whole_at(self.names.index(name))

    def at(self, column: int) -> NDArray[np.float64]:
        """Return a column ``(rows,)`` by index; cells that are not numbers are nan."""
        return np.array([_number(row[column]) for row in self.rows])

    def whole_at(self, column: int) -> NDArray[np.int64]:
        """Return a column of integers ``(rows,)`` by index; invalid cells are -1."""
        return np.array([_integer(row[column]) for row in self.rows], dtype=np.int64)

    def columns_at(self, columns: Sequence[int]) -> NDArray[np.float64]:
        """Return columns ``(rows, columns)`` by index."""
        return np.column_stack([self.at(column) for column in columns])


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return float("nan")


def _integer(word: str) -> int:
    text = word.strip()
    digits = text.partition(".")[0] if not text.partition(".")[2].strip("0") else ""
    return int(digits) if digits.isascii() and digits.isdigit() and len(digits) < 19 else -1
