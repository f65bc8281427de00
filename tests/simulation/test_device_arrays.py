"""Arrays of NumPy as Dr.Jit may read them: also where no memory follows their end."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from helpers import run_python

from mitsonar.simulation.device import padded

AT_THE_END = """
import ctypes, sys
import numpy as np
import mitsuba as mi
from mitsonar.simulation.device import padded

mi.set_variant("llvm_ad_mono")
import drjit as dr

libc, page, pages, size = ctypes.CDLL(None), 4096, 4, 1604
libc.mmap.restype = ctypes.c_void_p
libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long]
libc.mprotect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
begin = libc.mmap(None, (pages + 1) * page, 3, 0x22, -1, 0)
assert libc.mprotect(begin + pages * page, page, 0) == 0  # whoever reads beyond the end dies
values = np.frombuffer((ctypes.c_float * size).from_address(begin + pages * page - 4 * size), np.float32)
values[:] = np.arange(size)
doubled = 2 * mi.Float(padded(values))
dr.eval(doubled)
assert (np.array(doubled) == 2 * values).all()
print("alive")
"""


@pytest.mark.thorough
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="maps memory as Linux does")
def test_a_launch_over_an_array_reads_nothing_behind_its_page() -> None:
    """Without ``padded`` the process ends by SIGSEGV: 1,604 is no multiple of 16."""
    assert "alive" in run_python(AT_THE_END)


@pytest.mark.parametrize("count", [0, 1, 63, 64, 1000])
def test_values_and_type_stay(count: int) -> None:
    values = np.arange(count, dtype=np.uint32)
    np.testing.assert_array_equal(padded(values), values)
    assert padded(values).dtype == np.uint32
    whole = padded(values).base
    assert whole is not None
    assert whole.size >= count + 16


@pytest.mark.parametrize("kind", [np.uint32, np.float32, np.float64])
def test_copies_lie_alike(kind: type) -> None:
    """A frozen launch is recorded anew for each way in which its inputs lie: responses by mirrors took ten times as long."""
    stored = [padded(np.arange(count, dtype=kind)) for count in range(1, 50)]
    assert {values.ctypes.data % 64 for values in stored} == {0}
