"""Type aliases for arrays whose library is not known.

No type checker can express that a function returns an array of the same library as its argument, across NumPy, torch and
Dr.Jit. These aliases document it for the reader.
"""

from __future__ import annotations

from typing import Any, TypeAlias

__all__ = ["AnyArray", "DeviceArray"]

AnyArray: TypeAlias = Any
"""An array of NumPy, torch or Dr.Jit. Functions return arrays of the library that they receive."""

DeviceArray: TypeAlias = Any
"""A Dr.Jit array in the current variant, possibly not evaluated yet; also a number where Dr.Jit broadcasts it."""
