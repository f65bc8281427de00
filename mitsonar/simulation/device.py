"""Choose and set the Mitsuba variant: ``cuda_ad_mono`` where there is a GPU, else ``llvm_ad_mono``."""

from __future__ import annotations

import gc
import os
import weakref
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, nearest_names

__all__ = [
    "VARIANTS",
    "Backend",
    "DeviceArray",
    "Frozen",
    "LaunchTables",
    "backend",
    "current_variant",
    "ensure_variant",
    "padded",
    "release_memory",
    "replayed",
    "thread_count",
    "use_threads",
]


VARIANTS = ("cuda_ad_mono", "llvm_ad_mono", "cuda_ad_rgb", "llvm_ad_rgb")
"""The variants that mitsonar works with; monochrome ones need less memory."""

INSTALL = "on Debian or Ubuntu type `sudo apt-get install libllvm19 libatomic1` (or another libllvm from 17 on)"


class Backend(NamedTuple):
    """The renderer's variant, and its version of LLVM (None on CUDA)."""

    variant: str
    llvm: tuple[int, int, int] | None


def ensure_variant(name: str | None = None) -> str:
    """Set a variant where none is set, and return the name of the one that is; ``name`` or ``MITSONAR_VARIANT`` forces one.

    Raises:
        MitsonarError: unknown variant; one is set that mitsonar does not work with; neither CUDA nor LLVM is found (with the
            command that installs it).
    """
    cuda, llvm = _backends()
    import mitsuba as mi

    wanted = name or os.environ.get("MITSONAR_VARIANT")
    if wanted is None:
        if mi.variant() in VARIANTS:
            return str(mi.variant())
        wanted = "cuda_ad_mono" if cuda else "llvm_ad_mono"
        if mi.variant() is not None:  # chosen by the user, whose objects another variant would not know
            raise MitsonarError(
                f"the Mitsuba variant {mi.variant()} is set, and mitsonar works with {', '.join(VARIANTS)}: call "
                f'mi.set_variant("{wanted}") first, or leave set_variant out'
            )
    if wanted not in VARIANTS:
        raise MitsonarError(f"unknown variant {wanted!r}: {nearest_names(wanted, VARIANTS)}")
    if not (cuda if wanted.startswith("cuda") else llvm):
        if wanted.startswith("cuda"):
            raise MitsonarError(f"{wanted} needs an NVIDIA driver, and none was found: use llvm_ad_mono")
        raise MitsonarError(f"the library libLLVM was not found, which the renderer needs: {INSTALL}")
    if mi.variant() != wanted:
        mi.set_variant(wanted)
    return wanted


def backend() -> Backend:
    """Return the variant and its version of LLVM; sets a variant if none is set."""
    variant = ensure_variant()
    import drjit as dr

    return Backend(variant, tuple(dr.detail.llvm_version()) if variant.startswith("llvm") else None)


def use_threads(count: int) -> None:
    """Set the number of threads of the renderer; call it before anything is rendered."""
    import drjit as dr

    if dr.thread_count() != count:
        dr.set_thread_count(count)


def current_variant() -> str:
    """Return the current variant; empty where Mitsuba is not loaded or no variant is set."""
    import sys

    mi = sys.modules.get("mitsuba")
    return str(mi.variant() or "") if mi is not None else ""


def thread_count() -> int:
    """Return the number of threads of the renderer, at least one."""
    import drjit as dr

    return max(1, int(dr.thread_count()))


class Frozen:
    """Record a launch at its first call and replay it at later ones: ``dr.freeze``, for launches that evaluate BSDFs.

    A kernel that evaluates BSDFs holds the code of all that are alive, those of other scenes included, and Dr.Jit records it
    only if the values that they read are among the inputs. It collects these of every class of which the inputs hold a
    pointer. A scene holds pointers to shapes only, and through a shape Dr.Jit finds the shape's BSDF, but not a BSDF of
    another scene that no shape uses. Hence the pointer to a BSDF, which points at none.

    For the same reason scenes must go as soon as nobody refers to them. ``dr.freeze`` makes a class for each function, and a
    class refers to itself: what a launch holds would stay until Python collects its garbage. So Dr.Jit gets a function that
    holds nothing.
    """

    def __init__(self, launch: Callable[..., Any]) -> None:
        import drjit as dr
        import mitsuba as mi

        self._launch = launch
        own = weakref.ref(self)

        def run(*inputs: object) -> Any:
            found = own()
            assert found is not None, "called by its owner"
            return found._launch(*inputs)

        self._recorded: Any = dr.freeze(run, state_fn=lambda *_: mi.BSDFPtr(None))

    def __call__(self, *inputs: object) -> Any:
        """Run the launch, or replay it."""
        return self._recorded(*inputs)

    def clear(self) -> None:
        """Forget what was recorded."""
        self._recorded.clear()


def replayed(launch: Any, *inputs: object) -> Any:
    """Run a frozen launch; record it anew where Dr.Jit refuses to replay it.

    Garbage collection waits meanwhile: Dr.Jit 1.5 ends the process where an array is freed while a launch is recorded. It
    refuses a replay where other scenes came or went since, as they do with the garbage.
    """
    was = gc.isenabled()
    gc.disable()
    try:
        return launch(*inputs)
    except RuntimeError as error:
        if "registry entries" not in str(error):
            raise
        launch.clear()
        return launch(*inputs)
    finally:
        if was:
            gc.enable()


def release_memory() -> None:
    """Free the memory of scenes that are no longer referenced: they are cycles of objects, and Dr.Jit caches memory."""
    import drjit as dr

    gc.collect()
    dr.flush_malloc_cache()


def _backends() -> tuple[bool, bool]:
    try:
        import drjit as dr
    except Exception as error:  # without libatomic1 this is a NameError about something else
        raise MitsonarError(
            f"Dr.Jit cannot be loaded ({type(error).__name__}: {error}); it needs the library libatomic: {INSTALL}"
        ) from error
    return bool(dr.has_backend(dr.JitBackend.CUDA)), bool(dr.has_backend(dr.JitBackend.LLVM))


# ---------------- The type of Dr.Jit arrays in signatures, and arrays of NumPy as Dr.Jit may read them


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
