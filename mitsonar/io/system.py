"""Operations that differ between Linux, macOS and Windows: cores, memory, limits of a process, locks on files.

No other module of mitsonar calls what only some systems have; ``tests/test_platforms.py`` checks it.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["exclusive_file", "limit_process", "memory_bytes", "usable_cores"]


def usable_cores() -> int:
    """Count the processor cores that this process may use: on macOS and Windows, all cores of the machine."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def memory_bytes() -> int:
    """Return the size of the machine's memory [bytes]."""
    if sys.platform == "win32":
        import psutil  # required on Windows only

        return int(psutil.virtual_memory().total)
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def limit_process(memory: int, cpu_s: int) -> None:
    """Limit the memory and the processor time of this process as far as the system can, and disable core dumps.

    Windows has no such limits, and macOS none for memory: a caller also limits the time of the process from outside.

    Args:
        memory: limit of the address space [bytes].
        cpu_s: limit of the processor time [s].
    """
    if sys.platform == "win32":
        return
    import resource

    for kind, maximum in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, cpu_s), (resource.RLIMIT_CORE, 0)):
        finite_limits = [limit for limit in resource.getrlimit(kind) if limit != resource.RLIM_INFINITY]
        limit = min([maximum, *finite_limits])
        try:
            resource.setrlimit(kind, (limit, limit))
        except (ValueError, OSError):
            if sys.platform == "linux":  # macOS refuses a limit of the address space
                raise


@contextlib.contextmanager
def exclusive_file(path: str) -> Iterator[None]:
    """Create a file and hold a kernel lock on it, which ends with the process for any reason; finally remove the file.

    Args:
        path: path of the file, which may exist: left by a process that was killed.

    Raises:
        BlockingIOError: another process holds the lock.
    """
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        if sys.platform == "win32":
            try:
                msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
            except OSError:
                raise BlockingIOError(f"{path} is locked") from None
        else:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not (os.path.exists(path) and os.path.samestat(os.fstat(handle), os.stat(path))):
                # the last owner has just removed it, or another process has created a new one
                raise BlockingIOError(f"{path} is locked")
        try:
            yield
        finally:
            if sys.platform != "win32":  # while it is locked: afterwards it may be another process's
                with contextlib.suppress(OSError):
                    os.unlink(path)
    finally:
        os.close(handle)
        if sys.platform == "win32":  # Windows removes no open file, hence none that another process has locked
            with contextlib.suppress(OSError):
                os.unlink(path)
