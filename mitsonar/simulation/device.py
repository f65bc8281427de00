"""Which Mitsuba variant runs, and how launches are recorded, replayed and given their memory.

The default variant is ``cuda_ad_mono`` if there is a GPU, and ``llvm_ad_mono`` otherwise.
"""

from __future__ import annotations

import gc
import os
import sys
import weakref
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, suggest_names

__all__ = [
    "VARIANTS",
    "Backend",
    "DeviceArray",
    "Frozen",
    "LaunchTables",
    "backend",
    "clipped",
    "current_variant",
    "ensure_variant",
    "padded",
    "release_memory",
    "replayed",
    "thread_count",
    "use_threads",
]


VARIANTS = ("cuda_ad_mono", "llvm_ad_mono", "cuda_ad_rgb", "llvm_ad_rgb")
"""Variants that mitsonar supports; monochrome ones need less memory."""

INSTALL = {
    "linux": "on Debian or Ubuntu type `sudo apt-get install libllvm19 libatomic1` (or another libllvm from 17 on), on "
    "Fedora `sudo dnf install llvm-libs libatomic`, on Arch `sudo pacman -S llvm-libs`",
    "darwin": "type `brew install llvm`",
    "win32": "type `winget install LLVM.LLVM`, and add the folder of LLVM-C.dll to PATH",
}
"""How to install the libraries that Dr.Jit loads, by ``sys.platform``."""


class Backend(NamedTuple):
    """Variant of the renderer, and its version of LLVM (None on CUDA)."""

    variant: str
    llvm: tuple[int, int, int] | None


def ensure_variant(name: str | None = None) -> str:
    """Set a Mitsuba variant if none is set, and return the name of the current one.

    Args:
        name: variant to set even if another is set; default: the environment variable ``MITSONAR_VARIANT``, if it is set.

    Raises:
        MitsonarError: the variant is unknown; the variant already set is not supported; the library of the variant, CUDA or
            LLVM, is not found (for LLVM, the message gives the command that installs it).
    """
    cuda, llvm = _backends()
    import mitsuba as mi

    variant = name or os.environ.get("MITSONAR_VARIANT")
    if variant is None:
        if mi.variant() in VARIANTS:
            return str(mi.variant())
        variant = "cuda_ad_mono" if cuda else "llvm_ad_mono"
        if mi.variant() is not None:  # chosen by the user, whose objects would be invalid in another variant
            raise MitsonarError(
                f"the Mitsuba variant {mi.variant()} is set, and mitsonar works with {', '.join(VARIANTS)}: call "
                f'mi.set_variant("{variant}") first, or leave set_variant out'
            )
    if variant not in VARIANTS:
        raise MitsonarError(f"unknown variant {variant!r}: {suggest_names(variant, VARIANTS)}")
    if not (cuda if variant.startswith("cuda") else llvm):
        if variant.startswith("cuda"):
            raise MitsonarError(f"{variant} needs an NVIDIA driver, and none was found: use llvm_ad_mono")
        raise MitsonarError(f"the library libLLVM was not found, which the renderer needs: {install_hint()}")
    if mi.variant() != variant:
        mi.set_variant(variant)
    return variant


def backend() -> Backend:
    """Return the variant and its version of LLVM, after setting a variant if none is set."""
    variant = ensure_variant()
    import drjit as dr

    return Backend(variant, tuple(dr.detail.llvm_version()) if variant.startswith("llvm") else None)


def install_hint() -> str:
    """Return how to install the libraries that Dr.Jit loads on this system, or where it finds them."""
    command = INSTALL.get(sys.platform, "install LLVM 17 or later")
    return f"{command}; or set DRJIT_LIBLLVM_PATH to the file of the library"


def use_threads(count: int) -> None:
    """Set the number of threads of the renderer; call this before anything is rendered."""
    import drjit as dr

    if dr.thread_count() != count:
        dr.set_thread_count(count)


def current_variant() -> str:
    """Return the current variant; empty if Mitsuba is not loaded or no variant is set."""
    mi = sys.modules.get("mitsuba")
    return str(mi.variant() or "") if mi is not None else ""


def thread_count() -> int:
    """Return the number of threads of the renderer, at least one."""
    import drjit as dr

    return max(1, int(dr.thread_count()))


class Frozen:
    """Launch that is recorded at its first call and replayed at later calls: ``dr.freeze`` for launches with BSDFs.

    A kernel that evaluates BSDFs contains the code of all BSDFs that are alive, including those of other scenes. Dr.Jit can
    record it only if the values that they read are among the inputs. It collects these values for every class to which the
    inputs hold a pointer. A scene holds pointers to shapes only. Through a shape, Dr.Jit finds the BSDF of that shape, but
    not a BSDF of another scene that no shape uses. The inputs therefore include a null pointer to a BSDF.

    For the same reason, scenes must be freed as soon as they are no longer referenced. ``dr.freeze`` creates a class for
    each function, and a class refers to itself, so objects that the launch references would live until the next garbage
    collection. Dr.Jit therefore gets a function that holds only a weak reference.

    Args:
        launch: function from the inputs to the results of a launch.
    """

    def __init__(self, launch: Callable[..., Any]) -> None:
        import drjit as dr
        import mitsuba as mi

        self._launch = launch
        reference = weakref.ref(self)

        def run(*inputs: object) -> Any:
            frozen = reference()
            assert frozen is not None, "called by its owner"
            return frozen._launch(*inputs)

        self._recorded: Any = dr.freeze(run, state_fn=lambda *_: mi.BSDFPtr(None))

    def __call__(self, *inputs: object) -> Any:
        """Run the launch, or replay it."""
        return self._recorded(*inputs)

    def clear(self) -> None:
        """Discard the recording."""
        self._recorded.clear()


def replayed(launch: Any, *inputs: object) -> Any:
    """Run a frozen launch, and record it again if Dr.Jit refuses to replay it.

    Garbage collection is suspended meanwhile, because Dr.Jit 1.5 ends the process if an array is freed while a launch is
    recorded. Dr.Jit refuses to replay a launch if other scenes were created or freed since, which garbage collection may do.
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
    """Free the memory of scenes that are no longer referenced, which reference cycles and Dr.Jit's cache retain."""
    import drjit as dr

    gc.collect()
    dr.flush_malloc_cache()


def _backends() -> tuple[bool, bool]:
    """Return whether Dr.Jit finds CUDA, and whether it finds LLVM."""
    try:
        import drjit as dr
    except Exception as error:  # without libatomic1 this is a NameError about something else
        remedy = f"it needs the library libatomic: {install_hint()}" if sys.platform == "linux" else "install drjit again"
        raise MitsonarError(f"Dr.Jit cannot be loaded ({type(error).__name__}: {error}); {remedy}") from error
    return bool(dr.has_backend(dr.JitBackend.CUDA)), bool(dr.has_backend(dr.JitBackend.LLVM))


# ---------------- Array types and aligned memory


DeviceArray: TypeAlias = Any
"""A Dr.Jit array of any type and depth, such as ``mi.Float``, ``mi.Float64`` or ``mi.Vector3f``.

The same code runs in single and in double precision, and Dr.Jit's stubs type ``dr.select``, ``dr.dot`` and mixed operations
too broadly for a narrower alias. Functions that also accept NumPy arrays document this.
"""

LaunchTables: TypeAlias = dict[str, DeviceArray]
"""Named arrays that a frozen launch takes as inputs."""

MOST_LANES = 64
"""Padding in values: more than a processor computes in parallel lanes."""

ALIGNED_BYTES = 64
"""Alignment of memory for a launch [bytes]: that of arrays allocated by Dr.Jit, or a multiple of it."""


def clipped(value: DeviceArray, low: DeviceArray, high: DeviceArray) -> DeviceArray:
    """Clip to low..high by comparisons, since LLVM 15 and 16 abort on ``dr.clip`` (see CONTRIBUTING.md)."""
    import drjit as dr

    return dr.select(value > low, dr.select(value < high, value, high), low)


def padded(values: NDArray[Any]) -> NDArray[Any]:
    """Return an aligned copy of values ``(n,)`` with readable memory beyond its end, for a launch over all of them.

    Dr.Jit 1.5 borrows the memory of NumPy arrays and reads whole packets of 16 values, hence past the end of an array whose
    length is not a multiple of 16. If that memory is not mapped, the process crashes. The copy is aligned to
    :data:`ALIGNED_BYTES`, since a frozen launch is recorded again whenever the alignment of an input changes.
    """
    room = np.zeros(len(values) + MOST_LANES + ALIGNED_BYTES // values.itemsize, dtype=values.dtype)
    first = -room.ctypes.data % ALIGNED_BYTES // values.itemsize
    aligned = room[first : first + len(values)]
    aligned[:] = values
    return aligned
