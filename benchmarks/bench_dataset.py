"""How fast data sets are made and read: worlds, rendering, compression and writing included.

    python benchmarks/bench_dataset.py [--json] [--quick] [--only make,rendered,read,field]

`make` runs `mitsonar dataset make` as a user would, for two sizes that build the same 30 worlds; the difference of the two
gives the time of a further frame, and with it the time of 200,000 (the table marks it). Memory is the sum over the command
and its workers (proportional set size: shared pages count once), sampled every three seconds.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil

Row = dict[str, Any]
"""One row of a result: numbers and texts by name."""


class Size(NamedTuple):
    """How much is done.

    Attributes:
        crews: recipes, and how many processes work on each.
        sequences: of five frames, of the two data sets that are made.
        changes: of the recipes.
        samples: that are rendered as a training would.
        buffer: of that training.
        stored: sequences of the data set that is read.
        batch: pairs read at a time.
        batches: read each time.
        rocks: of a kind along an edge of the largest field.
    """

    crews: tuple[tuple[str, int], ...]
    sequences: tuple[int, int]
    changes: tuple[str, ...]
    samples: int
    buffer: int
    stored: int
    batch: int
    batches: int
    rocks: int


RECIPES = ("rocky-field", "rocky-field-physical")

FULL = Size(
    crews=tuple((recipe, workers) for recipe in RECIPES for workers in (1, 2)),
    sequences=(1_000, 5_000),
    changes=(),
    samples=15_000,
    buffer=500,
    stored=400,
    batch=50,
    batches=8,
    rocks=130,
)
"""5,000 and 25,000 frames, over 30 worlds each."""

QUICK = Size(
    crews=(("rocky-field-physical", 2),),
    sequences=(2, 10),
    changes=("scenes=[{count: 2, sequences: 20}]", "world={family: rocky-field, size_m: 20, a_side: [5, 9]}"),
    samples=40,
    buffer=10,
    stored=10,
    batch=5,
    batches=2,
    rocks=20,
)
SAMPLE_S = 3.0
"""Between two looks at the memory: a look stops what it looks at."""

THESIS_FRAMES = 200_000
GIB = 2.0**30


def main() -> None:
    """Print the tables, or everything as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print for programs")
    parser.add_argument("--quick", action="store_true", help="a few frames over two small worlds: within a minute")
    parser.add_argument("--only", default="make,rendered,read,field", help="which parts, with commas between")
    parser.add_argument("--rendered", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--field", nargs=1, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.rendered:
        recipe, workers, samples = args.rendered
        return print(json.dumps(rendered(recipe, int(workers), int(samples), QUICK if args.quick else FULL)))
    if args.field:
        return print(json.dumps(largest_field(Path(args.field[0]), (QUICK if args.quick else FULL).rocks)))
    parts = args.only.split(",")
    size = QUICK if args.quick else FULL
    quick = ("--quick",) if args.quick else ()
    result: Row = {"machine": machine(), "make": [], "rendered": [], "read": []}
    with tempfile.TemporaryDirectory(prefix="bench-dataset-") as folder:
        built = Path(folder) / "read.zarr"
        for recipe, workers in size.crews if "make" in parts else ():
            result["make"].append(note(making(recipe, workers, size, Path(folder))))
        for recipe, workers in size.crews if "rendered" in parts else ():
            crew = 0 if workers == 1 else workers
            words = ("--rendered", recipe, str(crew), str(size.samples))
            result["rendered"].append(note(in_a_process(*quick, *words)))
        if "read" in parts:
            command(["dataset", "make", "rocky-field", *changed(size), "--sequences", str(size.stored), "-o", str(built)])
            result["read"] = [note(row) for row in reading(built, size)]
        if "field" in parts:
            result["field"] = note(in_a_process(*quick, "--field", str(Path(folder) / "field")))
    print(json.dumps(result, indent=2) if args.json else tables(result))


def note(what: Row) -> Row:
    """Progress, out of the way of what is printed."""
    print(what, file=sys.stderr, flush=True)
    return what


def machine() -> Row:
    """Describe the machine and the versions."""
    names = [line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line]
    return {
        "cpu": names[0] if names else platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "mitsuba": version("mitsuba"),
        "torch": version("torch"),
        "zarr": version("zarr"),
        "date": date.today().isoformat(),
    }


def changed(size: Size) -> list[str]:
    """Return the changes of a recipe as words of the command line."""
    return [word for change in size.changes for word in ("--set", change)]


def command(words: list[str]) -> None:
    """Run a command of mitsonar to its end."""
    subprocess.run([sys.executable, "-m", "mitsonar", *words], check=True, stdout=subprocess.DEVNULL)


def in_a_process(*words: str) -> Row:
    """Run this script in a process of its own, so that its memory can be measured, and return what it prints."""
    out = subprocess.run([sys.executable, __file__, *words], check=True, stdout=subprocess.PIPE, text=True).stdout
    row: Row = json.loads(out.splitlines()[-1])
    return row


def memory(process: psutil.Process) -> float:
    """GiB of a process and its children."""
    total = 0
    for one in [process, *process.children(recursive=True)]:
        try:
            total += one.memory_full_info().pss
        except psutil.Error:  # it has just ended
            continue
    return total / GIB


# ---------------------------------------------------------------- parts


def making(recipe: str, workers: int, size: Size, folder: Path) -> Row:
    """Seconds, memory and bytes of the command, for two sizes; what a frame more costs."""
    seconds, peaks = [], []
    for sequences in size.sequences:
        url = folder / f"{recipe}-{workers}-{sequences}.zarr"
        words = [
            "dataset",
            "make",
            recipe,
            *changed(size),
            "--sequences",
            str(sequences),
            "--workers",
            str(workers),
            "-o",
            str(url),
        ]
        start, samples = time.perf_counter(), []
        run = psutil.Popen([sys.executable, "-m", "mitsonar", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while run.poll() is None:
            samples.append(memory(run))
            with contextlib.suppress(psutil.TimeoutExpired):
                run.wait(SAMPLE_S)
        if run.returncode:
            raise SystemExit(f"mitsonar {' '.join(words)} failed: run it by hand")
        seconds.append(time.perf_counter() - start)
        quarter = max(1, len(samples) // 4)
        second = samples[quarter : 2 * quarter] or samples
        peaks.append((max(samples), max(second), max(samples[-quarter:])))
        stored = sum(path.stat().st_size for path in url.rglob("*") if path.is_file())
    frames = [5 * sequences for sequences in size.sequences]
    each = (seconds[1] - seconds[0]) / (frames[1] - frames[0])
    return {
        "recipe": recipe,
        "workers": workers,
        "frames": frames[1],
        "seconds": seconds[1],
        "images a second": frames[1] / seconds[1],
        "images a second, once running": 1 / each,
        "minutes for 200,000, extrapolated": (seconds[1] + (THESIS_FRAMES - frames[1]) * each) / 60,
        "peak GiB": peaks[1][0],
        "GiB in the second and in the last quarter": peaks[1][1:],
        "bytes an image": stored / frames[1],
    }


def rendered(recipe: str, workers: int, samples: int, size: Size) -> Row:
    """Measure rendered samples a second over some worlds. The buffer is full when the first sample comes."""
    import yaml

    from mitsonar import RenderedPairs, load_recipe

    changes = {key: yaml.safe_load(value) for key, _, value in (change.partition("=") for change in size.changes)}
    gain = 1.0 if recipe == "rocky-field" else 0.05
    pairs = RenderedPairs(load_recipe(recipe, changes), seed=1, length=samples, buffer=size.buffer, gain=gain)
    process, peak, taken = psutil.Process(), 0.0, 0
    begun = first = time.perf_counter()
    for number, (_, label) in enumerate(pairs.loader(size.batch, workers=workers)):
        if number == 0:
            first = time.perf_counter()
        taken += len(label)
        if number % 20 == 1:
            peak = max(peak, memory(process))
    return {
        "recipe": recipe,
        "workers": workers,
        "samples": taken,
        "pairs a second": taken / (time.perf_counter() - begun),
        "pairs a second, once running": (taken - size.batch - pairs.buffer * max(workers, 1))
        / (time.perf_counter() - first),
        "peak GiB": peak,
    }


def reading(url: Path, size: Size) -> Iterator[Row]:
    """Measure samples a second from a store, in batches, for each arrangement in turn."""
    import torch

    from mitsonar import SonarPairs

    torch.set_num_threads(min(2, torch.get_num_threads()))
    kinds: dict[str, Row] = {
        "polar, no noise": {},
        "polar, high noise": {"noise": "high"},
        "Cartesian, no noise": {"coordinates": "cartesian"},
        "vectors, high noise": {"kind": "vector", "noise": "high"},
    }
    sets = {name: SonarPairs(url, part="all", **words) for name, words in kinds.items()}
    times: dict[str, list[float]] = {name: [] for name in sets}
    for _ in range(5):
        for name, pairs in sets.items():
            start = time.perf_counter()
            for batch, _ in enumerate(pairs.loader(size.batch)):
                if batch == size.batches - 1:
                    break
            times[name].append((time.perf_counter() - start) / (size.batch * size.batches))
    for name, values in times.items():
        yield {"arrangement": name, "pairs a second": 1 / float(np.median(values[1:]))}


def largest_field(folder: Path, rocks: int) -> Row:
    """Seconds to build, write and load a field of rocks, and the memory of it all."""
    from mitsonar.simulation.scene import load_scene
    from mitsonar.worlds.families import RockyField

    start = time.perf_counter()
    world = RockyField(size_m=50, a_side=(rocks, rocks)).build(0)
    built = time.perf_counter()
    path = world.write(folder)
    written, triangles = time.perf_counter(), world.faces
    load_scene(path)
    loaded = time.perf_counter()
    status = Path("/proc/self/status").read_text()
    peak = int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))) / 2**20
    return {
        "rocks": rocks,
        "triangles": triangles,
        "build s": built - start,
        "write s": written - built,
        "load s": loaded - written,
        "peak GiB": peak,
    }


def tables(result: Row) -> str:
    """Format the results as Markdown."""
    m = result["machine"]
    lines = [f"{m['cpu']}, {m['cores']} cores; Mitsuba {m['mitsuba']}, Zarr {m['zarr']}, torch {m['torch']}, {m['date']}"]
    if result["make"]:
        lines += [
            "",
            "| recipe | workers | frames | s, all included | images/s | images/s once running | 200,000, extrapolated "
            "| peak GiB | 2nd and last quarter | bytes an image |",
            "|---" * 10 + "|",
        ]
    for row in result["make"]:
        early, late = row["GiB in the second and in the last quarter"]
        cells = [
            f"{row['recipe']} | {row['workers']} | {row['frames']:,} | {row['seconds']:.0f} | {row['images a second']:.0f}",
            f"{row['images a second, once running']:.0f} | {row['minutes for 200,000, extrapolated']:.1f} min",
            f"{row['peak GiB']:.2f} | {early:.2f}, {late:.2f} | {row['bytes an image']:,.0f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    if result["rendered"]:
        lines += [
            "",
            "| `RenderedPairs` | workers | samples | pairs/s, all included | once running | peak GiB |",
            "|---" * 6 + "|",
        ]
    for row in result["rendered"]:
        lines.append(
            f"| {row['recipe']} | {row['workers'] or 'in the process'} | {row['samples']:,} | {row['pairs a second']:.0f} "
            f"| {row['pairs a second, once running']:.0f} | {row['peak GiB']:.2f} |"
        )
    if result["read"]:
        lines += ["", "| `SonarPairs`, one process | pairs/s |", "|---|---|"]
    lines += [f"| {row['arrangement']} | {row['pairs a second']:.0f} |" for row in result["read"]]
    if "field" in result:
        f = result["field"]
        lines += [
            "",
            f"Largest rocky field, 3 x {f['rocks']} x {f['rocks']} rocks, {f['triangles']:,} triangles: "
            f"built in {f['build s']:.1f} s, "
            f"written in {f['write s']:.1f} s, loaded in {f['load s']:.1f} s, {f['peak GiB']:.2f} GiB at most.",
        ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
