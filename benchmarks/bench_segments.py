"""Chapter 4: vectors of portions of a looking-down view, networks that read them, heights, and paths.

    python benchmarks/bench_segments.py leak --out bench/segments [--width 0.35] [--minutes 20]
    python benchmarks/bench_segments.py ours --out bench/segments [--sequences 5000] [--minutes 20] [--rows NAME,NAME]
    python benchmarks/bench_segments.py heights --out bench/segments
    python benchmarks/bench_segments.py paths --out bench/segments [--rows RUN,RUN]
    python benchmarks/bench_segments.py halves --out bench/segments --frames lamprey2_first30.npz
    python benchmarks/bench_segments.py --quick            # all five, a few coarse pairs, one epoch, kept nowhere

The chapter's figures and its table are made by `mitsonar reproduce 4.12`, 4.14, 4.15 and 4.5. Here: `leak`, PoseNetVec on
1,000 pairs of circular segments from 10 m, split one by one as in Almanza-Medina, and by sequence. Both are validated on
their own 5 % and on pairs of unseen scenes. `ours`, ProfileNet on many pairs of other scenes, in both models, with and
without noise, with jittered rays, and with pings that share no rays. `heights`, the direct estimator over rocks and hulls.
`paths`, the two paths of 4.4.4. `halves`, networks of two halves of simulated hulls (4.4.5), and their estimates on real
frames. OUT keeps all results, so that a stopped run is resumed.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from bench_impulse import cpu

from mitsonar import load_recipe
from mitsonar.acoustics.noise import load_noise
from mitsonar.config.training import TrainingRecipe, TrainOptions, load_training_recipe
from mitsonar.datasets.make import make_dataset
from mitsonar.datasets.store import DataStore
from mitsonar.estimation.height import DirectHeight
from mitsonar.estimation.learned import ViewNetwork
from mitsonar.estimation.named import create_estimator
from mitsonar.mapping.odometry_run import run_odometry
from mitsonar.mapping.open_source import open_views
from mitsonar.mapping.sources import measured
from mitsonar.motion.errors import in_units
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.records.frames import SonarFrames
from mitsonar.training.evaluate import evaluate
from mitsonar.training.run import train

QUADRANTS, CONES = ["q1", "q2", "q3", "q4"], ["c1", "c2", "c3", "c4"]

HEAD = (
    "| row | split | pairs to learn from | validated on | RMSE sideways / forward mm / yaw deg | 95 % interval | slopes | "
    "high noise | answering zero | ms |\n|---|---|---|---|---|---|---|---|---|---|"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=list(PARTS), nargs="?")
    parser.add_argument("--out", type=Path, default=Path("bench/segments"))
    parser.add_argument("--sequences", type=int, default=5000, help="that `ours` learns from, five pings each")
    parser.add_argument("--physical", type=int, default=600, help="the same of the physical model")
    parser.add_argument("--unseen", type=int, default=1000, help="pairs that all are judged by")
    parser.add_argument("--width", type=float, default=1.0, help="of PoseNetVec")
    parser.add_argument("--minutes", type=float, default=None, help="of each training at most")
    parser.add_argument("--epochs", type=float, default=8, help="of ours; five times as many of the few physical pairs")
    parser.add_argument("--rows", help="of ours: names with commas; of paths: folders of runs")
    parser.add_argument("--frames", type=Path, help="lamprey2_first30.npz of a real DIDSON at rest, for halves")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="all parts, a few coarse pairs, kept nowhere: within a minute")
    arguments = parser.parse_args()
    if arguments.what is None and not arguments.quick:
        parser.error(f"say what: {', '.join(PARTS)}, or --quick")
    print(f"{cpu()}, {time.strftime('%Y-%m-%d')}, {arguments.threads} threads", flush=True)
    if arguments.quick:
        return quick(arguments)
    arguments.out.mkdir(parents=True, exist_ok=True)
    PARTS[arguments.what](arguments)


def quick(arguments: argparse.Namespace) -> None:
    """All parts on a few coarse pairs."""
    with tempfile.TemporaryDirectory() as folder:
        few = {"out": Path(folder), "sequences": 8, "physical": 8, "unseen": 2, "width": 0.05, "epochs": 0.2, "threads": 1}
        arguments = argparse.Namespace(**{**vars(arguments), **few})
        leak(arguments)
        arguments.rows = "circular-512,circular-1024-physical"
        ours(arguments)
        heights(arguments)
        arguments.rows = str(arguments.out / "runs" / "ours-circular-512")
        paths(arguments)
        halves(arguments)


COARSE = {
    "sonar.beams": 100,
    "sonar.rays_per_beam": 100,
    "world": {"family": "rocky-field", "size_m": 50, "a_side": [10, 15]},
}
COARSE_HULL = {
    "sonar.rays_per_beam": 100,
    "world": {"family": "ship-hull", "groups_a_side": [3, 3], "anodes_a_side": [3, 3]},
}
"""What `--quick` changes in data sets."""


def coarse(arguments: argparse.Namespace, changes: dict[str, object] = COARSE) -> dict[str, object]:
    """Return changes of the recipe of a data set."""
    return changes if arguments.quick else {}


def short(arguments: argparse.Namespace) -> dict[str, object]:
    """Return changes of the recipe of a training."""
    return {"epochs": 1, "batch": 4} if arguments.quick else {}


# ---------------------------------------------------------------- data


def data(arguments: argparse.Namespace, name: str, sequences: int, **changes: object) -> Path:
    """Make, or resume, vectors from 10 m up at 1024 levels."""
    words = {
        "store": "vectors",
        "segments": QUADRANTS + CONES,
        "name": name,
        "sonar.range_bins": 1024,
        **coarse(arguments),
        **changes,
    }
    path: Path = arguments.out / f"{name}.zarr"
    make_dataset(load_recipe("looking-down-10m", words), str(path), sequences=sequences, workers=arguments.workers)
    return path


def unseen(arguments: argparse.Namespace, name: str = "unseen10", pairs: int | None = None, **changes: object) -> Path:
    """Make pairs over other scenes, one a sequence."""
    count = arguments.unseen if arguments.quick else pairs or arguments.unseen
    scenes = [{"count": -(-count // 50), "sequences": 50}]
    return data(arguments, name, count, **{"seed": 7919, "scenes": scenes, "flight.pings": 2, **changes})


def many(arguments: argparse.Namespace) -> Path:
    """Make the training data in the model `thesis`: 20,000 pairs."""
    return data(arguments, "many10", arguments.sequences, scenes=groups(arguments, arguments.sequences, 125))


def physical(arguments: argparse.Namespace) -> Path:
    """And in the physical one."""
    return data(arguments, "phys10", arguments.physical, scenes=groups(arguments, arguments.physical, 75), **PHYSICAL)


def groups(arguments: argparse.Namespace, sequences: int, each: int) -> list[dict[str, int]]:
    """Scenes of so many sequences each; two at least, since the split is by scene."""
    each = sequences // 2 if arguments.quick else each
    return [{"count": -(-sequences // each), "sequences": each}]


PHYSICAL = {"sonar.model": "physical", "segments": CONES + QUADRANTS}


# ---------------------------------------------------------------- trainings


def row(
    arguments: argparse.Namespace, name: str, recipe: TrainingRecipe, learnt: Path, judged: dict[str, tuple[Path, str]]
) -> None:
    """One training, and a line for each of what it is judged by."""
    run = arguments.out / "runs" / name
    checkpoint = train(
        TrainOptions(recipe, learnt, run, resume=run.exists(), minutes=arguments.minutes, threads=arguments.threads)
    )
    for what, (where, part) in judged.items():
        stored = arguments.out / f"{name}-{what.replace(' ', '-')}.json"
        if not stored.exists():
            report = evaluate(checkpoint, where, part=part, noise=["none", "high"])
            stored.write_text(json.dumps(report))
        report = json.loads(stored.read_text())
        mine = [table["rows"][0] for table in report["tables"]]
        output = [" / ".join(f"{v:.3g}" for v in one["rmse"]) for one in mine]
        ends = zip(mine[0]["rmse_low"], mine[0]["rmse_high"], strict=True)
        interval = " / ".join(f"{low:.2g}..{high:.2g}" for low, high in ends)
        zero, slopes = (" / ".join(f"{v:.3g}" for v in mine[0][key]) for key in ("zero", "slope"))
        split = recipe.split if isinstance(recipe.split, str) else recipe.split["by"]
        pairs = json.loads((run / "run.json").read_text())["epoch_samples"]
        split_text = f"{what} ({report['pairs']} pairs)"
        print(
            f"| {name} | {split} | {pairs:,} | {split_text} | {output[0]} | {interval} | {slopes} | {output[1]} | {zero} | "
            f"{mine[0]['ms']:.2g} |",
            flush=True,
        )


def leak(arguments: argparse.Namespace) -> None:
    """Compare the validation of the chapter with a split by sequence."""
    print(HEAD)
    learnt = data(
        arguments, "thousand10", 6 if arguments.quick else 250, segments=["whole", "starboard", *QUADRANTS, *CONES]
    )
    judged_by = unseen(arguments, segments=["whole", "starboard", *QUADRANTS, *CONES])
    for by in ("sample", "sequence"):
        split = {"by": by, "train": 0.95, "validation": 0.05}
        words = {
            "split": split,
            "network.width": arguments.width,
            "input.range_levels": 512,
            "validate.every_minutes": 2,
            **short(arguments),
        }
        recipe = load_training_recipe("portion-circular-10m-vector", words)
        judged = {"validation": (learnt, "validation"), "unseen scenes": (judged_by, "all")}
        row(arguments, f"leak-{by}", recipe, learnt, judged)


class Ours(NamedTuple):
    """A row of ours: what it reads, at how many levels, what it learns from, and how many times as many epochs."""

    views: list[str]
    levels: int = 1024
    noise: str | list[str] = "none"
    model: str = "thesis"
    times: float = 1


BOTH = ["none", "high"]

OURS = {
    "quadrants-1024": Ours(QUADRANTS),
    "circular-1024": Ours(CONES),
    "quadrants-1024-noise": Ours(QUADRANTS, noise=BOTH),
    "circular-1024-noise": Ours(CONES, noise=BOTH),
    "quadrants-1024-physical": Ours(QUADRANTS, model="physical", times=5),
    "circular-1024-physical": Ours(CONES, model="physical", times=5),
    "quadrants-1024-physical-noise": Ours(QUADRANTS, noise=BOTH, model="physical", times=5),
    "circular-512": Ours(CONES, 512),
    "quadrants-512": Ours(QUADRANTS, 512),
    "circular-256": Ours(CONES, 256),
}


def ours(arguments: argparse.Namespace) -> None:
    """ProfileNet on many pairs."""
    print(HEAD)
    everything = ["whole", "starboard", *QUADRANTS, *CONES]
    for name in arguments.rows.split(",") if arguments.rows else OURS:
        result = OURS[name]
        words = {
            "input.views": result.views,
            "input.range_levels": result.levels,
            "network.lags": int(np.clip(result.levels // 128, 2, 6)),
            "noise": result.noise,
            "epochs": arguments.epochs * result.times,
            "split": {"by": "scene", "train": 0.95, "validation": 0.05},
            **({"batch": 4} if arguments.quick else {}),
        }
        if result.model == "physical":
            learnt, judged = physical(arguments), {"unseen scenes": (unseen(arguments, "unseenp10", 300, **PHYSICAL), "all")}
        else:
            learnt = many(arguments)
            moving = unseen(arguments, "jitter10", 300, **{"sonar.jitter": True})
            judged = {"unseen scenes": (unseen(arguments, segments=everything), "all"), "rays that move": (moving, "all")}
        row(arguments, f"ours-{name}", load_training_recipe("profilenet-circular-10m", words), learnt, judged)


# ---------------------------------------------------------------- heights


def heights(arguments: argparse.Namespace) -> None:
    """Evaluate the direct estimator on frames of the height data sets of the chapter."""
    print("| data | noise | frames | RMSE cm | of the interval | median cm | bias cm | valid | ms |\n" + 9 * "|---" + "|")
    for recipe, interval in (("height-rocky", 9.0), ("height-hull", 0.35)):
        path = arguments.out / f"{recipe}.zarr"
        changes = coarse(arguments, COARSE if recipe == "height-rocky" else COARSE_HULL)
        few = 10 if arguments.quick else None
        make_dataset(
            load_recipe(recipe, {"store": "vectors", **changes}), str(path), sequences=few, workers=arguments.workers
        )
        for noise in ("none", "high"):
            print(height_row(path, recipe, noise, interval), flush=True)


def height_row(path: Path, name: str, noise: str, interval_m: float) -> str:
    """Print a line of the direct estimator on every fifth frame."""
    store = DataStore.open(str(path))
    first = open_views(str(path), [store.recipe.views[0].name], "vector", sequence=0).with_noise(load_noise(noise), 1)
    time_s, poses, height_m = (store.read(array) for array in ("time_s", "pose", "height_m"))
    whole = replace(first, time_s=time_s, poses=poses, sonar_poses=poses, height_m=height_m)  # all sequences in one
    heights, spent = [], []
    for number in range(0, len(poses), 5):
        frame = whole.read([number])
        begun = time.process_time()
        heights.append(measured(frame, DirectHeight())[1][0])
        spent.append(1e3 * (time.process_time() - begun))
    valid = np.array([one.valid for one in heights])
    error = 100 * (np.array([one.height_m for one in heights]) - poses[::5, 2])[valid]
    rmse = np.sqrt((error**2).mean())
    return (
        f"| {name} | {noise} | {len(heights)} | {rmse:.2f} | {rmse / interval_m:.2f} % | {np.median(np.abs(error)):.2f} | "
        f"{error.mean():+.2f} | {100 * valid.mean():.0f} % | {np.median(spent):.0f} |"
    )


# ---------------------------------------------------------------- paths


def paths(arguments: argparse.Namespace) -> None:
    """Estimate the two paths of 4.4.4 over each of two scenes, by networks of circular segments from 10 m."""
    if not arguments.rows:
        raise SystemExit("paths needs --rows: folders of trained networks of c1..c4 from 10 m, with commas between them")
    path = arguments.out / "runs10.zarr"
    make_dataset(
        load_recipe("looking-down-runs", {"sonar.range_bins": 1024, **coarse(arguments)}),
        str(path),
        workers=arguments.workers,
    )
    print(
        "| network | path | pairs | valid | RMSE sideways / forward mm / yaw deg | end off, mm (of path) |\n"
        + 6 * "|---"
        + "|"
    )
    for run in arguments.rows.split(","):
        network = ViewNetwork(Checkpoint.load(run))
        for number, name in enumerate((("sideways_50", "sideways_54") * 2)[: 1 if arguments.quick else None]):
            source = open_views(str(path), network.views, network.kind, sequence=number)
            out = arguments.out / "paths" / f"{Path(run).name}-{number}"
            result = run_odometry(source, run, network, out, overwrite=True)
            texts = dict((label, value) for label, value, _ in result.rows())
            rmse = " / ".join(f"{value:.3g}" for label, value in texts.items() if label.startswith("motion error RMSE"))
            off = np.linalg.norm(result.path.poses[-1][:2] - source.poses[-1, :2])
            length = np.linalg.norm(np.diff(source.poses[:, :2], axis=0), axis=1).sum()
            print(
                f"| {Path(run).name} | {name}, scene {number // 2} | {len(result.estimates)} | {int(result.valid.sum())} | "
                f"{rmse} | {1e3 * off:.0f} ({100 * off / length:.1f} %) |",
                flush=True,
            )


# ---------------------------------------------------------------- halves


def halves(arguments: argparse.Namespace) -> None:
    """Two halves of a forward-looking sonar, learnt on simulated hulls with the chapter's noise (4.4.5)."""
    print(HEAD)
    learnt = arguments.out / "hulls.zarr"
    hull = coarse(arguments, {**COARSE_HULL, "scenes": [{"count": 2, "sequences": 4}]})
    make_dataset(
        load_recipe("ship-hull", hull), str(learnt), sequences=8 if arguments.quick else 300, workers=arguments.workers
    )
    second = arguments.out / "hulls-unseen.zarr"
    gain = DataStore.open(str(learnt)).about["gain"]  # one sonar
    words = {**hull, "seed": 7919, "name": "hulls-unseen", "gain": gain}
    make_dataset(
        load_recipe("ship-hull", words), str(second), sequences=2 if arguments.quick else 100, workers=arguments.workers
    )
    noise = "0.04,0.02,0.04"
    given = {
        "input": {"kind": "vector", "halves": True},
        "noise": noise,
        "data": "ship-hull",
        "data_changes": {},
        **short(arguments),
    }
    if arguments.quick:
        given["split"] = {"by": "scene", "train": 0.5, "validation": 0.5}
    for name, recipe in (
        ("halves-posenetvec", load_training_recipe("portion-circular-vector", {**given, "network.width": arguments.width})),
        ("halves-profilenet", load_training_recipe("profilenet-quadrants", {"epochs": 60, **given})),
    ):
        row(arguments, name, recipe, learnt, {"unseen scenes": (second, "all")})
        if arguments.frames is not None:
            network = create_estimator(f"{arguments.out / 'runs' / name}:force=1")
            frames = lamprey(arguments.frames)
            pairs = [network.estimate(frames.select(slice(k, k + 2))) for k in range(len(frames) - 1)]
            motions = in_units(np.array([one.motion for one in pairs]))
            valid = sum(one.valid for one in pairs)
            mean, spread = (" / ".join(f"{v:.3g}" for v in fold(motions, axis=0)) for fold in (np.mean, np.std))
            print(f"{name}, {len(pairs)} pairs of a DIDSON at rest: mean {mean}, spread {spread}, {valid} valid")


def lamprey(path: Path) -> SonarFrames:
    """Load the recording lamprey2 of a DIDSON at rest as beams and bins, as if its window were that of the simulated one."""
    fans = np.load(path)["frames"].astype(np.float32)
    sonar = load_recipe("ship-hull").instrument
    radius, bearing = np.meshgrid(np.linspace(37, 809.5, sonar.range_bins), sonar.bearing_rad, indexing="ij")
    across, down = (axis.astype(np.float32) for axis in (199.1 + radius * np.sin(bearing), 810.1 - radius * np.cos(bearing)))
    image = np.stack([cv2.remap(fan, across, down, cv2.INTER_LINEAR) for fan in fans]) / 255
    return SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.arange(len(image)) / 10.0, sonar)


PARTS = {"leak": leak, "ours": ours, "heights": heights, "paths": paths, "halves": halves}

if __name__ == "__main__":
    main()
