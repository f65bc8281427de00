"""Names for arrays whose library is not known, for signatures.

No type checker can say "the array that was handed in" across NumPy, torch and Dr.Jit. These names say it to readers.
"""

from __future__ import annotations

from typing import Any, TypeAlias

__all__ = ["AnyArray", "DeviceArray"]

AnyArray: TypeAlias = Any
"""An array of NumPy, torch or Dr.Jit. The function returns the library that it was handed."""

DeviceArray: TypeAlias = Any
"""An array of Dr.Jit in the variant that is set, perhaps not evaluated yet; also a number where Dr.Jit broadcasts it."""
