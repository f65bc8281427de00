"""Type aliases for arrays of NumPy, torch or Dr.Jit.

No type checker can express that a function returns arrays of the same library as its arguments. These aliases document it.
"""

from __future__ import annotations

from typing import Any, TypeAlias

__all__ = ["AnyArray", "DeviceArray"]

AnyArray: TypeAlias = Any
"""An array of NumPy, torch or Dr.Jit. A function returns arrays of the same library as its arguments."""

DeviceArray: TypeAlias = Any
"""A Dr.Jit array in the current variant, possibly not evaluated yet, or a number that Dr.Jit broadcasts."""
