"""The type of Dr.Jit arrays in signatures."""

from __future__ import annotations

from typing import Any, TypeAlias

__all__ = ["DeviceArray", "LaunchTables"]

DeviceArray: TypeAlias = Any
"""A Dr.Jit array of any type and depth, such as ``mi.Float``, ``mi.Float64`` or ``mi.Vector3f``.

The same lines run in single and in double precision, and Dr.Jit's stubs type ``dr.select``, ``dr.dot`` and mixed operations
too widely for a narrower name. Functions that also accept NumPy arrays say so.
"""

LaunchTables: TypeAlias = dict[str, DeviceArray]
"""Arrays by name that a frozen launch takes as inputs."""
