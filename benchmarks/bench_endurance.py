"""A long run: time and memory a frame, with a local map and a gyroscope; and runs that are killed and resumed.

    python benchmarks/bench_endurance.py [--frames 10000] [--killed 600] [--out DIR]
    python benchmarks/bench_endurance.py --quick       # 12 frames of few rays, killed and resumed, kept nowhere

450 frames of the run `forward` of `bench_trajectories.py` are rendered once. The sonar goes to and fro along them. All
frames lie in a `frames.zarr`, as `mitsonar render` writes it. `mitsonar odometry --map --sensors` runs in a process of
its own, whose progress bar notes the processor time and the memory. A shorter run is killed by SIGKILL while it
estimates pairs, while it makes the map, and while it writes. All files of the resumed runs must be those of a run that
was not stopped.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from bench_trajectories import GYRO, machine, rendered
from numpy.typing import NDArray
from trajectory_jobs import trajectory_job

from mitsonar.mapping.sensors import simulated_sensors
from mitsonar.motion.sensors import save_sensors
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import FrameStore, SonarFrames

Array = NDArray[np.float64]
Index = NDArray[np.intp]

WATCHED = "BENCH_PROGRESS"
"""Variable that names the file of times and memory in the process of the command."""

TIMELESS = ("seconds", "pairs_in_these_seconds")
"""Keys of ``run.json`` that describe the run, not its results."""

STAGES = ("pairs", "map", "writing")
PART = 64
"""Frames that are written at a time."""


class Scale(NamedTuple):
    """Frames that are rendered, those of the long run and of the killed ones, rows of the table, whether rays are few."""

    rendered: int
    frames: int
    killed: int
    rows: int = 10
    coarse: bool = False


def main() -> None:
    """Render what is missing, run, kill and resume, print the tables."""
    if WATCHED in os.environ:
        return command()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=10_000, help="of the long run")
    parser.add_argument("--killed", type=int, default=600, help="frames of the runs that are killed")
    parser.add_argument("--out", type=Path, default=Path("out/endurance"), help="frames and runs")
    parser.add_argument("--quick", action="store_true", help="12 frames of few rays: within a minute")
    args = parser.parse_args()
    print(machine(0, 1).rsplit(";", 1)[0])
    if not args.quick:
        return benchmark(args.out, Scale(450, args.frames, args.killed))
    with tempfile.TemporaryDirectory(prefix="bench-endurance-") as folder:
        benchmark(Path(folder), Scale(6, 12, 12, 1, coarse=True))


def benchmark(out: Path, scale: Scale) -> None:
    """Print a row for each part of the long run, and one for each kill."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / "way.npz"
    if not file.exists():
        rendered(trajectory_job("forward", "physical", scale.rendered, scale.coarse)).save(file)
    way = SonarFrames.load(file)
    long, short = (to_and_fro(way, frames, out / f"run-{frames}") for frames in (scale.frames, scale.killed))
    result = out / f"found-{scale.frames}"
    log = finished(watched(long, result))
    print("\n" + "\n".join(table(log, scale)), flush=True)
    whole = result
    if scale.killed != scale.frames:
        whole = out / f"found-{scale.killed}"
        finished(watched(short, whole))
    print("\n| killed | pairs, frames of the map when killed | files that differ after --resume |\n|---|---|---|")
    for stage in STAGES:
        print(killed(stage, short, out / f"killed-{stage}", whole, scale.killed), flush=True)


# ---------------------------------------------------------------- frames


def to_and_fro(way: SonarFrames, frames: int, folder: Path) -> Path:
    """Write a run of so many frames to and fro along a way, with the readings of a gyroscope beside it."""
    if (folder / "gyroscope.csv").exists():
        return folder
    folder.mkdir(exist_ok=True)
    turn = len(way) - 1
    number = turn - np.abs(turn - np.arange(frames) % (2 * turn))
    time_s: Array = float(np.median(np.diff(way.time_s))) * np.arange(frames, dtype=np.float64)
    store = FrameStore.create(folder / "frames.zarr", frames, way.select(slice(1)))
    for first in range(0, frames, PART):
        there = number[first : first + PART]
        store.write(first, replace(way.select(there), time_s=time_s[first : first + PART]))
    assert way.poses is not None
    save_sensors(folder / "gyroscope.csv", simulated_sensors(Trajectory(way.poses[number], time_s), GYRO, seed=0))
    return folder


# ---------------------------------------------------------------- the command


def command() -> None:
    """Run a command of mitsonar whose progress bar writes a line of processor time, count and memory each time."""
    from mitsonar.cli import estimate
    from mitsonar.cli import main as run

    log = Path(os.environ[WATCHED])

    @contextmanager
    def noted(what: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
        done = 0

        def note(held_mib: float) -> None:
            with log.open("a") as file:
                file.write(f"{time.process_time()} {done} {held_mib}\n")

        def add(more: int) -> None:
            nonlocal done
            done += more
            note(resident_mib())

        add(0)
        yield add
        note(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10)

    with patch.object(estimate, "progress_bar", noted):
        run()


def resident_mib() -> float:
    """Return the resident memory of this process [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def watched(run: Path, out: Path, *more: str) -> tuple[subprocess.Popen[bytes], Path]:
    """Start an odometry in a process of its own; return it and the file of its progress."""
    log = out.with_suffix(".log")
    log.unlink(missing_ok=True)
    words = ["odometry", str(run), "--map", "--sensors", str(run / "gyroscope.csv"), "--workers", "1", "-o", str(out), *more]
    environment = {**os.environ, WATCHED: str(log)}
    return subprocess.Popen([sys.executable, __file__, *words], env=environment, stdout=subprocess.DEVNULL), log


def finished(started: tuple[subprocess.Popen[bytes], Path]) -> Array:
    """Wait for an odometry; return its progress: processor time [s], pairs and frames done, memory [MiB] ``(n, 3)``."""
    process, log = started
    if process.wait():
        raise SystemExit(f"the odometry failed with status {process.returncode}")
    return np.loadtxt(log)


# ---------------------------------------------------------------- flat


def table(log: Array, scale: Scale) -> Iterator[str]:
    """Format processor time and memory for each part of a run."""
    pairs, step = scale.frames - 1, scale.frames // scale.rows
    end = int(np.flatnonzero(log[:, 1] == pairs + scale.frames)[0])
    log, after = log[: end + 1], log[end + 1 :]
    yield "| frames | ms a pair | MiB | ms a frame of the map | MiB |\n|---|---|---|---|---|"
    for first in range(0, scale.frames - step + 1, step):
        cells = []
        for begin, stop in ((first, min(first + step, pairs)), (pairs + first, pairs + first + step)):
            start, over = np.interp([begin, stop], log[:, 1], log[:, 0])
            stored = log[(log[:, 1] > begin) & (log[:, 1] <= stop), 2].max()
            cells += [f"{1e3 * (over - start) / (stop - begin):.1f}", f"{stored:.0f}"]
        yield f"| {first:,} to {first + step:,} | {' | '.join(cells)} |"
    yield f"\nPose graph and files: {after[-1, 0] - log[-1, 0]:.1f} s, at most {after[-1, 2]:.0f} MiB"


# ---------------------------------------------------------------- killed


def killed(stage: str, run: Path, out: Path, whole: Path, frames: int) -> str:
    """Kill an odometry in a stage, resume it, and format what differs from the run that was not stopped."""
    process, log = watched(run, out, "--overwrite")
    while not reached(stage, log, out, frames):
        if process.poll() is not None:
            raise SystemExit(f"the odometry was over before it was killed in the stage {stage}")
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = count(log)
    finished(watched(run, out, "--resume"))
    return (
        f"| {stage} | {min(done, frames - 1)}, {max(0, done - frames + 1)} | {', '.join(differing(out, whole)) or 'none'} |"
    )


def reached(stage: str, log: Path, out: Path, frames: int) -> bool:
    """Return whether an odometry is in the middle of a stage."""
    if stage == "writing":
        return (out / "motions.csv").exists() and not (out / "path.png").exists()
    return count(log) >= (frames // 2 if stage == "pairs" else frames - 1 + frames // 2)


def count(log: Path) -> int:
    """Return how many pairs and frames of the map are done."""
    lines = log.read_text().split("\n")[:-1] if log.exists() else []
    return int(lines[-1].split()[1]) if lines else 0


def differing(one: Path, other: Path) -> list[str]:
    """Return the names of the files that are not the same in two folders, to the bit; of ``run.json`` what is no time."""
    names = sorted({path.name for folder in (one, other) for path in folder.iterdir()})
    return [name for name in names if content(one / name) != content(other / name)]


def content(path: Path) -> bytes | dict[str, object] | None:
    """Return what must be the same in a file; None where there is none."""
    if not path.exists():
        return None
    if path.name != "run.json":
        return path.read_bytes()
    return {key: value for key, value in json.loads(path.read_bytes()).items() if key not in TIMELESS}


if __name__ == "__main__":
    main()
