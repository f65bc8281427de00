"""Masks as COCO stores them: lengths of runs down the columns, as a short text."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["compressed", "runs_of"]


def runs_of(mask: NDArray[np.bool_]) -> list[int]:
    """Return the lengths of the runs of a mask ``(rows, columns)``, column by column; the first is of zeros."""
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    edges = np.concatenate([[0], changes, [flat.size]])
    lengths = np.diff(edges).tolist()
    return [0, *lengths] if flat[0] else lengths


def compressed(runs: list[int]) -> str:
    """Return runs as the text that COCO's tools read: differences to the run before the last, 5 bits a letter."""
    letters = []
    for place, run in enumerate(runs):
        value = run - runs[place - 2] if place > 2 else run
        while True:
            bits = value & 31
            value >>= 5
            more = value != -1 if bits & 16 else value != 0
            letters.append(chr((bits | 32 if more else bits) + 48))
            if not more:
                break
    return "".join(letters)
