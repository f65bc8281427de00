"""Run every script of benchmarks/, docs/ and scenes/ with --quick, as many at a time as the machine has cores.

    python benchmarks/run_quick.py [NAME ...] [--limit 600] [--together 1]

It prints the seconds of each script and the last lines of failed ones; the exit status is then 1. Scripts take the cores
from each other, so their own times are no measurements.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("benchmarks", "docs", "scenes")


def main() -> None:
    """Run them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="only scripts whose path contains one of these")
    parser.add_argument("--limit", type=float, default=600, help="seconds after which a script has failed")
    parser.add_argument("--together", type=int, default=os.cpu_count() or 1, help="scripts that run at a time")
    parser.add_argument("--quick", action="store_true", help="only list the scripts: this script is one of them")
    asked = parser.parse_args()
    wanted = [path for path in scripts(ROOT) if not asked.names or any(name in str(path) for name in asked.names)]
    if asked.quick:
        return print("\n".join(str(path.relative_to(ROOT)) for path in wanted))
    with ThreadPoolExecutor(max(1, asked.together)) as pool:
        passed = list(pool.map(partial(passes, limit_s=asked.limit), wanted))
    failed = [path.name for path, well in zip(wanted, passed, strict=True) if not well]
    print(
        f"{len(wanted) - len(failed)} of {len(wanted)} scripts end well" + (f"; not {', '.join(failed)}" if failed else "")
    )
    if failed or not wanted:
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
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    begun = time.perf_counter()
    try:
        done = subprocess.run(
            [sys.executable, str(path), "--quick"],
            cwd=path.parent,
            env=environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=limit_s,
        )
        status, said = done.returncode, done.stdout
    except subprocess.TimeoutExpired as late:
        status, said = 1, f"{(late.stdout or b'').decode(errors='replace')}\nnot done after {limit_s:g} s"
    lines = [f"{time.perf_counter() - begun:6.1f} s  {'ok    ' if status == 0 else 'FAILED'} {path.relative_to(ROOT)}"]
    if status:
        lines += [f"    {line}" for line in said.splitlines()[-30:]]
    print("\n".join(lines), flush=True)
    return status == 0


if __name__ == "__main__":
    main()
