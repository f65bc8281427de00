"""Run every script of benchmarks/, docs/ and scenes/ with --quick, as many at a time as the machine has cores.

    python benchmarks/run_quick.py [NAME ...] [--limit 600] [--together 1]

It prints the seconds of each script and the last lines of failed ones; the exit status is then 1. Scripts take the cores
from each other, so their own times are no measurements. Each runs in a process of its own, forked from one that has
imported the libraries that most of them need; on Windows, which has no fork, each imports them again.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import os
import runpy
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext, SpawnContext

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("benchmarks", "docs", "scenes")
LIBRARIES = ["cv2", "lightning.pytorch", "matplotlib.pyplot", "scipy.stats", "torch", "zarr"]
HAS_FORK = "forkserver" in multiprocessing.get_all_start_methods()
PROCESSES: ForkServerContext | SpawnContext = (
    multiprocessing.get_context("forkserver") if HAS_FORK else multiprocessing.get_context("spawn")
)


def main() -> None:
    """Run them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="only scripts whose path contains one of these")
    parser.add_argument("--limit", type=float, default=600, help="seconds after which a script has failed")
    parser.add_argument("--together", type=int, default=os.cpu_count() or 1, help="scripts that run at a time")
    parser.add_argument("--quick", action="store_true", help="only list the scripts: this script is one of them")
    arguments = parser.parse_args()
    expected = [path for path in scripts(ROOT) if not arguments.names or any(name in str(path) for name in arguments.names)]
    if arguments.quick:
        return print("\n".join(str(path.relative_to(ROOT)) for path in expected))
    os.environ |= {"OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    if HAS_FORK:
        PROCESSES.set_forkserver_preload(LIBRARIES)
    with ThreadPoolExecutor(max(1, arguments.together)) as pool:
        passed = list(pool.map(partial(passes, limit_s=arguments.limit), expected))
    failed = [path.name for path, well in zip(expected, passed, strict=True) if not well]
    print(
        f"{len(expected) - len(failed)} of {len(expected)} scripts end well"
        + (f"; not {', '.join(failed)}" if failed else "")
    )
    if failed or not expected:
        raise SystemExit(1)


def scripts(root: Path) -> Iterator[Path]:
    """Files that can be run: those that ask for `__main__`; not those behind links, nor this one."""
    for folder in FOLDERS:
        for path in sorted((root / folder).rglob("*.py")):
            if path.resolve() == path and path != Path(__file__).resolve() and is_script(path):
                yield path


def is_script(path: Path) -> bool:
    """Whether a file does something when it is run."""
    return '\nif __name__ == "__main__":' in path.read_text(encoding="utf-8")


def passes(path: Path, limit_s: float) -> bool:
    """Run a script, say how long it took, and whether it ended well."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        output = Path(folder, "output.txt")
        process = PROCESSES.Process(target=run_script, args=(path, output))
        process.start()
        process.join(limit_s)
        late = process.is_alive()
        if late:
            if sys.platform == "win32":
                process.kill()
            else:
                os.killpg(process.pid or 0, signal.SIGKILL)
            process.join()
        text = output.read_text(encoding="utf-8", errors="replace") + (f"\nnot done after {limit_s:g} s" if late else "")
    well = process.exitcode == 0
    lines = [f"{time.perf_counter() - begun:6.1f} s  {'ok    ' if well else 'FAILED'} {path.relative_to(ROOT)}"]
    if not well:
        lines += [f"    {line}" for line in text.splitlines()[-30:]]
    print("\n".join(lines), flush=True)
    return well


def run_script(path: Path, output: Path) -> None:
    """Run a script as ``python PATH --quick`` from its folder does, with all that it prints in a file."""
    if sys.platform != "win32":
        os.setpgrp()  # which ends with it if it takes too long
    file = os.open(output, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    for stream in (1, 2):
        os.dup2(file, stream)
    gc.freeze()  # what the libraries hold is left out of collections of garbage, of which each data set makes several
    os.chdir(path.parent)
    sys.argv, sys.path[0] = [str(path), "--quick"], str(path.parent)
    runpy.run_path(str(path), run_name="__main__")


if __name__ == "__main__":
    main()
