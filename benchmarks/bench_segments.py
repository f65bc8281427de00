"""Chapter 4: vectors of portions of a looking-down view, networks that read them, and what their validation has seen.

    python benchmarks/bench_segments.py leak --out bench/segments [--width 0.5] [--minutes 20]
    python benchmarks/bench_segments.py ours --out bench/segments [--sequences 5000] [--minutes 20]

`leak`: PoseNetVec on 1,000 pairs of circular segments from 10 m, by the chapter's schedule, its pairs dealt out one by one
as the thesis shuffles them (`split: {by: sample}`), and by sequence; each validated on its own 5 % and on pairs of scenes
that nobody learnt from. `ours`: ProfileNet and PoseNetVec on the same pairs of other scenes, at 1024 to 64 range levels,
with milliseconds an estimate. What is in OUT is kept, so that a run that was broken off goes on.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from bench_impulse import cpu

from mitsonar import load_recipe
from mitsonar.dataset.generate import make
from mitsonar.training.evaluation import evaluate
from mitsonar.training.recipe import load_training_recipe
from mitsonar.training.run import train

SEGMENTS = ["c1", "c2", "c3", "c4"]

HEAD = (
    "| network | levels | split | pairs to learn from | validated on | RMSE sideways / forward mm / yaw deg | high noise | "
    "answering zero | ms |\n|---|---|---|---|---|---|---|---|---|"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["leak", "ours"])
    parser.add_argument("--out", type=Path, default=Path("bench/segments"))
    parser.add_argument("--sequences", type=int, default=5000, help="that `ours` learns from, five pings each")
    parser.add_argument("--unseen", type=int, default=1000, help="pairs that all are judged by")
    parser.add_argument("--width", type=float, default=1.0, help="of PoseNetVec")
    parser.add_argument("--minutes", type=float, default=None, help="of each training at most")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--levels", type=int, nargs="*", default=[1024, 512, 256, 128, 64])
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    print(f"{cpu()}, {time.strftime('%Y-%m-%d')}, {asked.threads} threads\n{HEAD}", flush=True)
    {"leak": leak, "ours": ours}[asked.what](asked)


def data(asked: argparse.Namespace, name: str, sequences: int, **changes: Any) -> Path:
    """Vectors of circular segments from 10 m up at 1024 levels, made or gone on with."""
    words = {"store": "vectors", "segments": SEGMENTS, "name": name, "sonar.range_bins": 1024, **changes}
    path = asked.out / f"{name}.zarr"
    make(load_recipe("looking-down-10m", words), str(path), sequences=sequences, workers=asked.workers)
    return path


def unseen(asked: argparse.Namespace) -> Path:
    """Pairs, each of a sequence of its own, over other scenes."""
    scenes = [{"count": -(-asked.unseen // 50), "sequences": 50}]
    return data(asked, "unseen", asked.unseen, **{"seed": 7919, "scenes": scenes, "flight.pings": 2})


def row(asked: argparse.Namespace, name: str, recipe: Any, learnt: Path, judged: dict[str, tuple[Path, str]]) -> None:
    """One training, and a line for each of what it is judged by."""
    run = asked.out / "runs" / name
    checkpoint = train(recipe, learnt, run, resume=run.exists(), minutes=asked.minutes, threads=asked.threads)
    for what, (where, part) in judged.items():
        kept = asked.out / f"{name}-{what.replace(' ', '-')}.json"
        if not kept.exists():
            report = evaluate(checkpoint, where, part=part, noise=["none", "high"])
            kept.write_text(json.dumps(report))
        report = json.loads(kept.read_text())
        mine = [table["rows"][0] for table in report["tables"]]
        said = [" / ".join(f"{v:.3g}" for v in one["rmse"]) for one in mine]
        zero = " / ".join(f"{v:.3g}" for v in mine[0]["zero"])
        split = recipe.split if isinstance(recipe.split, str) else recipe.split["by"]
        levels, pairs = checkpoint.options["size"][0], json.loads((run / "run.json").read_text())["epoch_samples"]
        where_said = f"{what} ({report['pairs']} pairs)"
        print(
            f"| {checkpoint.network} | {levels} | {split} | {pairs:,} | {where_said} | {said[0]} | {said[1]} | {zero} | "
            f"{mine[0]['ms']:.2g} |",
            flush=True,
        )


def leak(asked: argparse.Namespace) -> None:
    """The chapter's way to validate, and another."""
    learnt = data(asked, "thousand", 249)
    for by in ("sample", "sequence"):
        split = {"by": by, "train": 0.95, "validation": 0.05}
        words = {"split": split, "network.width": asked.width, "input.range_levels": 512, "validate.every_minutes": 2}
        recipe = load_training_recipe("portion-circular-10m-vector", words)
        judged = {"validation": (learnt, "validation"), "unseen scenes": (unseen(asked), "all")}
        row(asked, f"leak-{by}", recipe, learnt, judged)


def ours(asked: argparse.Namespace) -> None:
    """ProfileNet beside PoseNetVec."""
    scenes = [{"count": -(-asked.sequences // 80), "sequences": 80}]
    learnt = data(asked, "many", asked.sequences, scenes=scenes)
    judged = {"unseen scenes": (unseen(asked), "all")}
    for levels in asked.levels:
        words = {"input.range_levels": levels, "network.lags": int(np.clip(levels // 128, 2, 8))}
        row(asked, f"profilenet-{levels}", load_training_recipe("profilenet-circular-10m", words), learnt, judged)
    for levels in (512, 128):
        words = {"input.range_levels": levels, "split": "scene", "network.width": asked.width}
        row(asked, f"posenetvec-{levels}", load_training_recipe("portion-circular-10m-vector", words), learnt, judged)


if __name__ == "__main__":
    main()
