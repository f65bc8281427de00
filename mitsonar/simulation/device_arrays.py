"""The type of Dr.Jit arrays in signatures, and arrays of NumPy as Dr.Jit may read them."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = ["DeviceArray", "LaunchTables", "padded"]

DeviceArray: TypeAlias = Any
"""A Dr.Jit array of any type and depth, such as ``mi.Float``, ``mi.Float64`` or ``mi.Vector3f``.

The same lines run in single and in double precision, and Dr.Jit's stubs type ``dr.select``, ``dr.dot`` and mixed operations
too widely for a narrower name. Functions that also accept NumPy arrays say so.
"""

LaunchTables: TypeAlias = dict[str, DeviceArray]
"""Arrays by name that a frozen launch takes as inputs."""

MOST_LANES = 64
"""More than a processor computes side by side."""

ALIGNED_BYTES = 64
"""Boundary that memory begins on for a launch: that of Dr.Jit's own arrays, or a multiple of it."""


def padded(values: NDArray[Any]) -> NDArray[Any]:
    """Return a copy of values ``(n,)`` behind whose end memory goes on, for a launch over all of them.

    Dr.Jit 1.5 borrows the memory of NumPy and reads whole packets of 16 values: past the end of an array of another length.
    Where no memory follows, the process dies. The copy begins on a boundary of :data:`ALIGNED_BYTES`: a frozen launch is
    recorded anew where an input lies otherwise than before.
    """
    room = np.zeros(len(values) + MOST_LANES + ALIGNED_BYTES // values.itemsize, dtype=values.dtype)
    first = -room.ctypes.data % ALIGNED_BYTES // values.itemsize
    kept = room[first : first + len(values)]
    kept[:] = values
    return kept
