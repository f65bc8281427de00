"""Certainty: squared errors over the covariances, refusals and errors, on pairs of many kinds.

    python benchmarks/bench_certainty.py --out bench/certainty [--only hull,far130] [--noise none,high] [--seed 7301]
        [--methods direct,corrnet,flow] [--recordings FOLDER]

Makes the data sets (one pair a sequence) and estimates each pair. What is there is kept. *nees*: squared error over the
covariance, a third of it, of the valid estimates: its mean with a 95 % interval (bootstrap over scenes), and its median; 1
and 0.79 are consistent. With --recordings: sonars at rest, whose true motion is none, and loops of the chain, whose sum of 8
motions less the motion over 8 is none. `--quick` estimates two pairs of one set, kept nowhere.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from bench_compare import run
from bench_recordings import CHAIN, RESTING, opened, pairs
from numpy.typing import NDArray
from real_recordings import recordings_folder

from mitsonar.datasets.samples import SonarPairs
from mitsonar.estimation.estimator import AnyEstimator, Estimate
from mitsonar.estimation.named import create_estimator
from mitsonar.mapping.odometry import closure_of
from mitsonar.mapping.open_source import LOOP
from mitsonar.motion.composition import motions
from mitsonar.motion.errors import cluster_resamples, in_units, motion_errors
from mitsonar.records.frames import SonarFrames
from mitsonar.reproduction.odometry_benchmark import RenderedSet

Array = NDArray[np.float64]
Pairs = Iterator[tuple[SonarFrames, Array, int]]
"""Two frames, the true motion of the sonar, and the number of the scene."""

SEED = 7301


class Kind(NamedTuple):
    """A recipe, scenes of it and pairs a scene, and further changes."""

    recipe: str
    scenes: int
    pairs: int
    world: str = ""
    changes: tuple[str, ...] = ()


FIELD = ", world: {size_m: 30}"
FAR = ("flight.sideways_mm=250", "flight.forward_mm=250", "flight.yaw_deg=6")
NEAR = ("flight.kind=random", "flight.sideways_mm=20", "flight.forward_mm=20", "flight.yaw_deg=0.45")
TEXTURES = ("gaussian", "perlin_high", "photo_gravel", "photo_rock")
KINDS: dict[str, Kind] = {
    "rocky": Kind("rocky-field-physical", 4, 15, FIELD),
    "rocky thesis": Kind("rocky-field", 4, 15, FIELD),
    "rocky coherent": Kind("rocky-field-coherent", 4, 15, FIELD),
    "hull": Kind("ship-hull-physical", 12, 5),
    "hull thesis": Kind("ship-hull", 12, 5),
    "pattern": Kind("pattern-runs", 4, 15, "pattern", (*NEAR, "sonar.model=physical")),
    "pattern coherent": Kind(
        "pattern-runs", 4, 10, "pattern", (*NEAR, "sonar.model=coherent", "sonar.coding=gamma", "sonar.coding_gamma=0.5",
                                           "sonar.gain_exponent=4", "sonar.bearing=cone"),
    ),
    "far29": Kind("rocky-field-physical", 4, 15, FIELD, FAR),
    "far130": Kind("rocky-field-physical", 4, 6, FIELD, (*FAR, "sonar.preset=oculus-m750d-750khz")),
}  # fmt: skip
"""Of rocks, hulls and patterns, 20 mm or 250 mm apart."""

SLOPE, SLOPE_FRAMES = "slope", 61
"""The set of the odometry benchmark whose ground rises forward by 10 deg; consecutive frames are its pairs."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("bench/certainty"))
    parser.add_argument("--only", default=",".join((*KINDS, SLOPE)))
    parser.add_argument("--noise", default="none,high")
    parser.add_argument("--methods", default="direct,corrnet,flow")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--recordings", nargs="?", const="", help="folder; default: the variable MITSONAR_RECORDINGS")
    parser.add_argument("--quick", action="store_true", help="two pairs of one set, kept nowhere: within a minute")
    arguments = parser.parse_args()
    print(HEAD)
    if not arguments.quick:
        return measure(arguments)
    with tempfile.TemporaryDirectory() as folder:
        measure_kind(Path(folder), "far29", KINDS["far29"]._replace(scenes=1, pairs=2), "none", ["direct"], arguments.seed)


HEAD = """| set | noise | method | pairs | invalid | RMSE (mm, mm, deg) | median | nees, mean (95 %) | median | reasons |
|---|---|---|---|---|---|---|---|---|---|"""


def measure(arguments: argparse.Namespace) -> None:
    """Print a row for each set, noise and method."""
    methods = arguments.methods.split(",")
    for name in filter(None, arguments.only.split(",")):
        for noise in arguments.noise.split(","):
            if name == SLOPE:
                measure_slope(arguments.out, noise, methods)
            elif noise == "none" or "coherent" not in name:  # their noise is the receiver's
                measure_kind(arguments.out, name, KINDS[name], noise, methods, arguments.seed)
    folder = None if arguments.recordings is None else recordings_folder(arguments.recordings)
    if folder is not None:
        for method in methods:
            measure_recordings(folder, network_of(method, coherent=True))


def network_of(method: str, *, coherent: bool) -> str:
    """Return the network that was trained for frames with speckle, where that is requested."""
    return "corrnet-coherent" if coherent and method == "corrnet" else method


def measure_kind(out: Path, name: str, kind: Kind, noise: str, methods: Sequence[str], seed: int) -> None:
    """Make a data set where it is not there, and print its rows."""
    data = out / f"{name.replace(' ', '-')}-{seed}.zarr"
    if not data.exists():
        out.mkdir(parents=True, exist_ok=True)
        worlds = [f", world: {{texture: {one}}}" for one in TEXTURES] if kind.world == "pattern" else [kind.world]
        each = kind.scenes // len(worlds) or 1
        fields = ", ".join(f"{{count: {each}, sequences: {kind.pairs}{world}}}" for world in worlds)
        changes = (f"scenes=[{fields}]", "flight.pings=2", *kind.changes)
        run("dataset", "make", kind.recipe, *(w for one in changes for w in ("--set", one)), "--seed", seed, "-o", data)
    for word in methods:
        method = network_of(word, coherent="coherent" in name)
        report(name, noise, method, stored(data, noise, seed), create_estimator(method))


def stored(data: Path, noise: str, seed: int) -> Pairs:
    """Read the pairs of a data set."""
    samples = SonarPairs(data, part="all", frames=2, noise=noise, seed=seed, one_per_sequence=True)
    for number in range(len(samples)):
        here = samples.frame_slice(number)
        truth = motions(samples.pose[here][[0, -1]])[0]
        yield samples.sonar_frames(number), truth, int(samples.scene[samples.first[number]])


def measure_slope(out: Path, noise: str, methods: Sequence[str]) -> None:
    """Print the rows of rising ground."""
    source = RenderedSet(SLOPE, "still", noise, SLOPE_FRAMES, out).source(
        lambda what, length: nullcontext(lambda done: None)
    )
    assert source.true is not None
    truth = motions(source.true.poses)
    for method in methods:
        each = ((source.read([k, k + 1]), truth[k], k // 5) for k in range(len(truth)))
        report(SLOPE, noise, method, each, create_estimator(method))


def measure_recordings(folder: Path, method: str) -> None:
    """Print the rows of sonars at rest, and of the loops of a chain."""
    estimator = create_estimator(method)
    for name, path in RESTING.items():
        source = opened(folder / path).with_contrast()
        report(
            f"{name}, at rest", "own", method, ((pair, np.zeros(3), k) for k, pair in enumerate(pairs(source))), estimator
        )
    source = opened(folder / CHAIN).with_contrast()
    numbers = np.arange(len(source))
    result = [estimator.estimate(source.read([k, k + 1])) for k in numbers[:-1]]
    closure = closure_of(source, estimator, numbers, result, LOOP)
    refused = sum(not one.valid for one in result)
    if closure is None:
        print(f"| ARIS 3000, chain, loops | own | {method} | 0 | {refused} of {len(result)} | - | - | - | - | |", flush=True)
        return
    rmse, median = (
        np.sqrt((in_units(closure.residuals) ** 2).mean(axis=0)),
        np.median(np.abs(in_units(closure.residuals)), 0),
    )
    words = f"{len(closure.residuals)} | {refused} of {len(result)} | {triple(rmse)} | {triple(median)}"
    print(f"| ARIS 3000, chain, loops | own | {method} | {words} | {closure.factor:.2f} at least 1 | - | |", flush=True)


def report(name: str, noise: str, method: str, each: Pairs, estimator: AnyEstimator) -> None:
    """Estimate pairs and print their row."""
    cv2.setNumThreads(1)
    truth, scene, result = [], [], []
    for frames, motion, number in each:
        truth.append(motion)
        scene.append(number)
        result.append(estimator.estimate(frames))
    print(f"| {name} | {noise} | {method} | {row(np.array(truth), np.array(scene), result)} |", flush=True)


def row(truth: Array, scene: NDArray[np.int64], results: list[Estimate]) -> str:
    """Return the cells of a row."""
    valid = np.array([one.valid for one in results])
    motion = np.array([one.motion for one in results])
    errors = motion_errors(motion, truth, valid)
    nees = np.array([normalised(one, true) for one, true in zip(results, truth, strict=True)])
    known = np.isfinite(nees)
    cells = f"{len(results)} | {(~valid).sum()} | {triple(errors.rmse)} | {triple(errors.median)}"
    reasons = Counter(one.reason.split(":")[0][:60] for one in results if not one.valid)
    why = "; ".join(f"{count} {reason}" for reason, count in reasons.most_common(2))
    if not known.any():
        return f"{cells} | - | - | {why}"
    drawn = nees[known][cluster_resamples(scene[known])].mean(axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return f"{cells} | {nees[known].mean():.2f} ({low:.2f}..{high:.2f}) | {np.median(nees[known]):.2f} | {why}"


def normalised(results: Estimate, true: Array) -> float:
    """Return the squared error of an estimate over its covariance, a third of it; nan of one that is not valid."""
    if not results.valid or results.covariance is None:
        return float("nan")
    off = np.array(results.motion) - true
    return float(off @ np.linalg.solve(results.covariance, off)) / 3


def triple(values: Any) -> str:
    """Return mm, mm, deg as text."""
    return " / ".join(f"{value:.{digits}f}" for value, digits in zip(values, (2, 2, 3), strict=True))


if __name__ == "__main__":
    main()
