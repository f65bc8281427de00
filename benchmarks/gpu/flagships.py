"""Trains PoseNet of tables 3.2 and 3.3 without and with noise, and ours with noise, at once on one GPU from one data set.

    python benchmarks/gpu/flagships.py OUT --minutes 11
    python benchmarks/gpu/flagships.py --quick        # on a CPU: one row and ours, narrow, a few frames, kept nowhere

Processors render the data while the GPU measures how many pairs a second two trainings see, as they are and compiled. From
that follow the epochs that fit into the minutes; the learning rate is halved at the same fractions of them as in the thesis.
The same command goes on after a stop. OUT/data holds the data, OUT/NAME the folder of `mitsonar reproduce` of each row,
OUT/posenet-noise our training.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mitsonar.config.data import Recipe

Fields = dict[str, Any]
"""Changes of a recipe, by key."""

ROWS = {"posenet-normx10": "3.2", "posenet-normx10-low-noise": "3.3"}
"""Rows trained at once, and the table of each."""

OURS = "posenet-noise"
"""Recipe trained at the same time, from the weights of `posenet`."""

THESIS_EPOCHS = 32.0
SHARE = 0.42
"""Part of the speed of two trainings that each of them has while ours runs as well."""

EVALUATION_S = 60.0
START_S = 25.0
COMPILED_FROM = 1.15
"""Smallest gain of compiled networks that is worth their start."""

SMALL: Fields = {"network.width": 0.03, "validate.pairs": 2}
SMALL_DATA = (
    *("--set", "scenes=[{count: 10, sequences: 3, world: {family: rocky-field, size_m: 20, a_side: [5, 9]}}]"),
    *("--set", "sonar.rays_per_beam=60"),
)
BENCH_DATA = ("--set", "scenes=[{count: 1, sequences: 60, world: {size_m: 30}}]")


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", help="data, trainings, results")
    parser.add_argument("--minutes", type=float, default=11, help="of this call, evaluation included")
    parser.add_argument("--device", choices=["cuda", "cpu"], default="cuda")
    parser.add_argument("--batch", type=int, default=64, help="pairs per step")
    parser.add_argument("--small", action="store_true", help="a check of the steps: narrow networks, a few frames")
    parser.add_argument("--quick", action="store_true", help="--small --device cpu, kept nowhere")
    parser.add_argument("--train", nargs=2, metavar=("NAME", "JSON"), help="one training, started by this script")
    arguments = parser.parse_args()
    if arguments.quick:
        with tempfile.TemporaryDirectory() as folder:
            words = [sys.executable, __file__, folder, "--small", "--device", "cpu", "--minutes", "8"]
            raise SystemExit(subprocess.run(words).returncode)
    if arguments.out is None:
        parser.error("a folder is missing: give OUT, or --quick")
    end = time.monotonic() + 60 * arguments.minutes
    if arguments.train:
        return trained(arguments, arguments.train[0], json.loads(arguments.train[1]))
    arguments.out.mkdir(parents=True, exist_ok=True)
    seen, making = begin_data(arguments)
    plan = planned(arguments, making, end)
    if making.wait() != 0:
        raise SystemExit(f"no data: see {arguments.out / 'make.log'}")
    make_unseen(arguments, seen)
    left = end - time.monotonic() - EVALUATION_S
    names = *list(ROWS)[: 1 if arguments.small else None], OURS
    runs = {name: start(arguments, name, {**plan, "seconds": left}) for name in names}
    while any(run.poll() is None for run in runs.values()) and time.monotonic() < end:
        time.sleep(1)
    states = {name: stopped(run) for name, run in runs.items()}
    print(", ".join(f"{name} {'done' if state == 0 else 'open'}" for name, state in states.items()))
    raise SystemExit(max(map(abs, states.values())) > 0)


# ---------------- Data


def begin_data(arguments: argparse.Namespace) -> tuple[Path, subprocess.Popen[bytes]]:
    """Make a few frames to measure with, and begin to make the data set; by CUDA if LLVM is missing."""
    out, folder = arguments.out, arguments.out / "data"
    seen, small, workers = folder / "rocky-field.zarr", SMALL_DATA if arguments.small else (), str(os.cpu_count())
    bench = ["dataset", "make", "rocky-field", *BENCH_DATA, "-o", folder / "bench.zarr", "--workers"]
    if not small and logged(out, "bench", *bench, workers).wait() != 0:
        os.environ["MITSONAR_VARIANT"], workers = "cuda_ad_mono", "6"
        logged(out, "bench", *bench, 1).wait()
    return seen, logged(out, "make", "dataset", "make", "rocky-field", *small, "--workers", workers, "-o", seen)


def make_unseen(arguments: argparse.Namespace, seen: Path) -> None:
    """Make the unseen scenes of a table, with the gain of the data set of training."""
    from mitsonar.datasets.make import make_dataset
    from mitsonar.datasets.store import DataStore
    from mitsonar.reproduction.tables import unseen_recipe
    from mitsonar.simulation.device import ensure_variant

    ensure_variant()
    store = DataStore.open(seen)
    recipe, count = unseen_recipe(store.recipe, store.recipe.sequences, 10 if arguments.small else None, 2)
    recipe = recipe.model_copy(update={"gain": store.about["gain"]})
    make_dataset(recipe, str(unseen_of(arguments)), sequences=count, workers=max(1, (os.cpu_count() or 1) - 1))


def unseen_of(arguments: argparse.Namespace) -> Path:
    """Return the path of the data set of unseen scenes."""
    return Path(arguments.out, "data", "rocky-field-unseen.zarr")


# ---------------- Plan


def planned(arguments: argparse.Namespace, making: subprocess.Popen[bytes], end: float) -> Fields:
    """Measure speeds while data are made, and choose epochs and whether to compile; an earlier plan is kept."""
    path = arguments.out / "plan.json"
    if path.exists():
        return dict(json.loads(path.read_text(encoding="utf-8")))
    speeds = [measured(arguments, compiled) for compiled in (False, True)] if not arguments.small else [1.0, 0.0]
    compiled = speeds[1] > COMPILED_FROM * speeds[0]
    making.wait()
    from mitsonar.datasets.samples import SonarPairs

    pairs = len(SonarPairs(arguments.out / "data" / "rocky-field.zarr", split="sample"))
    seconds = end - time.monotonic() - EVALUATION_S - START_S
    epochs = min(THESIS_EPOCHS, max(0.01, round(SHARE * speeds[compiled] * seconds / pairs, 2)))
    plan: Fields = {"epochs": epochs, "compiled": compiled, "speeds": speeds, "pairs": pairs}
    path.write_text(json.dumps(plan), encoding="utf-8")
    print(f"two trainings at once: {speeds[0]:.0f} pairs/s, compiled {speeds[1]:.0f}; {epochs:g} epochs of {pairs:,} pairs")
    return plan


def measured(arguments: argparse.Namespace, compiled: bool) -> float:
    """Return the pairs per second of two trainings at once in a steady state."""
    names = [f"measure-{kind}-{int(compiled)}" for kind in "ab"]
    seconds = 90 if compiled else 25
    runs = [start(arguments, name, {"seconds": seconds, "compiled": compiled, "epochs": 1e6}) for name in names]
    time.sleep(seconds + 15)
    for run in runs:
        stopped(run, at_once=True)
    rates = [re.findall(r" (\d+) pairs/s", log_of(arguments.out, name).read_text(encoding="utf-8")) for name in names]
    return float(sum(int(rate[-1]) for rate in rates if rate))


# ---------------- Trainings


def start(arguments: argparse.Namespace, name: str, plan: Fields) -> subprocess.Popen[bytes]:
    """Start this script for one training."""
    words = [Path(__file__), arguments.out, "--device", arguments.device, "--batch", arguments.batch]
    words += [*(["--small"] if arguments.small else []), "--train", name, json.dumps(plan)]
    return process(arguments.out, name, map(str, words))


def trained(arguments: argparse.Namespace, name: str, plan: Fields) -> None:
    """Train one network, and evaluate it if it is a row of a table."""
    import mitsonar.training.run as training
    from mitsonar.config.training import TrainOptions, load_training_recipe
    from mitsonar.reproduction import tables
    from mitsonar.training.step import network_for

    accelerator = "gpu" if arguments.device == "cuda" else "cpu"
    precision = "bf16-mixed" if arguments.device == "cuda" else "32-true"
    changes: Fields = {"precision": precision, "validate.every_minutes": 3, **(SMALL if arguments.small else {})}
    minutes, watch, out = plan["seconds"] / 60, Prints(), arguments.out / name
    batch = 8 if arguments.small else arguments.batch
    if plan["compiled"]:
        training.network_for = compiled_when_trained(network_for)  # type: ignore[attr-defined]
    if name in ROWS:
        epochs = plan["epochs"]
        changes |= {"epochs": epochs, "optimiser.halve_every": 12 / THESIS_EPOCHS * epochs}
        seen = arguments.out / "data" / "rocky-field.zarr"

        def make_data(self: tables.TableBuilder, data: Recipe, sequences: int, crew: tables.Crew) -> Path:
            return unseen_of(arguments) if "unseen" in data.name else seen

        tables.TableBuilder._make_data = make_data  # type: ignore[method-assign]
        effort = tables.Effort(scale=1.0, minutes=minutes, batch=batch, changes=changes)
        tables.reproduce(ROWS[name], out, effort, rows=[name], accelerator=accelerator, devices=1, watch=watch)
        return
    ours = name == OURS
    changes |= {"batch": batch} | ({"network.width": 0.25} if ours else {"split": "sample"})
    changes |= {"steps": 2 if arguments.small else 20_000, "epochs": None} if ours else {"epochs": plan["epochs"]}
    data_path = arguments.out / "data" / ("rocky-field.zarr" if ours else "bench.zarr")
    recipe = load_training_recipe(OURS if ours else next(iter(ROWS)), changes)
    options = TrainOptions(recipe, data_path, out, minutes=minutes, resume=out.exists(), accelerator=accelerator, devices=1)
    with watch.training(name) as (progress, stop):
        training.train(options, progress=progress, stop=stop)


def compiled_when_trained(create: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that creates networks whose training steps are compiled; validation stays as it is."""
    import torch

    def network_for(*given: Any) -> Any:
        network = create(*given)
        eager = network.forward
        fast = torch.compile(eager, dynamic=False)
        network.forward = lambda *inputs: (fast if network.training else eager)(*inputs)
        return network

    return network_for


class Prints:
    """Watch of a reproduction that prints a line now and then."""

    def begin(self, what: str, total: int, unit: str) -> Callable[[int], None]:
        """Print what begins."""
        print(f"{what}: {total:,} {unit}", flush=True)
        return lambda done: None

    @contextlib.contextmanager
    def training(self, what: str) -> Iterator[tuple[Callable[[Any], None], Callable[[], bool]]]:
        """Yield a report that prints every few seconds, and a function that never stops training."""
        last = [time.monotonic(), 0]

        def report(state: Any) -> None:
            passed = time.monotonic() - last[0]
            if passed > 5 or state.validated:
                speed, last[:] = (state.pairs - last[1]) / passed, [time.monotonic(), state.pairs]
                print(f"{what}: {state.pairs:,} pairs, {speed:.0f} pairs/s, {state.rmse}, {state.validation}", flush=True)

        yield report, lambda: False


# ---------------- Processes


def log_of(out: Path, name: str) -> Path:
    """Return the path of the log of a process."""
    return out / f"{name}.log"


def logged(out: Path, name: str, *words: object) -> subprocess.Popen[bytes]:
    """Start a command of mitsonar with its output in a log."""
    return process(out, name, ["-m", "mitsonar", *map(str, words)])


def process(out: Path, name: str, words: Any) -> subprocess.Popen[bytes]:
    """Start Python with these words in a session of its own."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's background job, whose children would ignore it, too
        signal.signal(signal.SIGINT, signal.default_int_handler)
    with log_of(out, name).open("ab") as log:
        return subprocess.Popen([sys.executable, *words], stdout=log, stderr=log, start_new_session=True)


def stopped(run: subprocess.Popen[bytes], *, at_once: bool = False) -> int:
    """Stop a process if it still runs, and return its exit status."""
    if run.poll() is None:
        os.killpg(run.pid, signal.SIGKILL if at_once else signal.SIGINT)
    return run.wait()


if __name__ == "__main__":
    main()
