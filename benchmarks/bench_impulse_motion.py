"""Motion from impulse responses: table 5.2 and 5.3, noise, leaks, wrong assumptions, and the six courses of table 5.6.

    python benchmarks/bench_impulse_motion.py rows --out bench/impulse [--samples 100] [--only NAME] [--model rays]
    python benchmarks/bench_impulse_motion.py noise --out bench/impulse
    python benchmarks/bench_impulse_motion.py courses --out bench/impulse
    python benchmarks/bench_impulse_motion.py regressors [--rays 12500 50000]
    python benchmarks/bench_impulse_motion.py figure --out bench/impulse
    python benchmarks/bench_impulse_motion.py places [--samples 100]
    python benchmarks/bench_impulse_motion.py --quick      # all, five samples of a small field, kept nowhere

Samples are made like those of the data sets `impulse-*`, over 5 scenes that no network has seen (seed 4201). OUT keeps them,
so that a stopped run is resumed. `rows`: every row of table 5.2 by each estimator, with the figure of Almanza-Medina and the
bound. `noise`: the standard row at signal-to-noise ratios, two pings of different scenes, one ping twice, and a wrong height
or sound speed. `courses`: trajectories 1 to 6 over flat objects, with positions 50 ms apart and each motion from ten pings
(--pings 2: from the pings at both positions; neighbours then resolve ambiguous motions).
Networks go by name or folder in --estimators; they read --model rays and --pings 2. `regressors`: table 5.5, ten regressors
on the standard row of so many rays, split one by one, and the same from one ping twice, which holds no motion.
`places`: two pings 1/180 s apart at 1 m/s to starboard and 0.5 m/s forward, as in the guide, at places and headings drawn at
random over the scene `hydrophones` (stones on a seabed) and over its seabed alone.
`figure`: figure 5.11, the sinusoid by impulse responses, and by images of a DIDSON 2.5 m above the same field (`direct`).
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import os
import re
import tempfile
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from multiprocessing.pool import Pool
from pathlib import Path
from typing import Any, Literal

import numpy as np
from bench_impulse import cpu
from numpy.typing import NDArray

from mitsonar import (
    ChannelSimulator,
    ChannelSonar,
    ImpulseResponses,
    MitsonarError,
    Simulator,
    load_recipe,
    load_scene,
    load_sonar,
)
from mitsonar.config.data import Recipe, Split
from mitsonar.datasets.make import make_dataset
from mitsonar.datasets.plan import scenes_of, sequences_of
from mitsonar.datasets.responses import with_noise
from mitsonar.datasets.samples import ImpulsePairs
from mitsonar.estimation.crlb.channel import channel_crlb
from mitsonar.estimation.named import create_estimator
from mitsonar.mapping.odometry import OdometryOptions, odometry
from mitsonar.mapping.open_source import ResponseSource
from mitsonar.mapping.series import path_of
from mitsonar.motion.composition import motions
from mitsonar.motion.courses import COURSES, course
from mitsonar.motion.errors import in_units
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.reproduction.regressors import REGRESSORS, flattened, score_all

SEED, SCENES = 4201, 5

ROWS = {
    "impulse-two-receivers": "6.0 / 5.9",
    "impulse-40khz": "8.8 / 10.5",
    "impulse-60khz": "6.3 / 6.2",
    "impulse-standard": "5.1 / 4.2",
    "impulse-narrow": "2.7 / 2.3",
    "impulse-circular-4800": "11.0 / 15.2",
    "impulse-100khz": "7.7 / 7.6",
    "impulse-160khz": "9.05 / 8.84",
    "impulse-wideband-9600": "3.9 / 3.8",
    "impulse-wideband-19200": "1.9 / 2.4",
    "impulse-circular-19200": "2.0 / 3.5",
    "impulse-high-objects": "5.4 / 5.2",
    "impulse-ten-80khz": "1.8 / 1.7",
    "impulse-ten-160khz": "1.58 / 1.51",
    "impulse-ten-320khz": "1.53 / 1.27",
    "impulse-yaw": "-",
    "impulse-yaw-narrow": "-",
    "impulse-yaw-ten": "-",
}
"""Data sets, and the RMSE of the network of Almanza-Medina in its own simulator (`rays`), sideways / forward [mm]."""

SMALL = {
    "world": {"family": "flat-objects", "size_m": 30.0, "seabed_cells": 300, "rectangles": 20, "ellipses": 20},
    "scenes": [{"count": SCENES, "sequences": 2}],
}
"""What `--quick` changes in a recipe."""

COSTLY = {"impulse-wideband-19200": 0.3, "impulse-circular-19200": 0.3, "impulse-wideband-9600": 0.5}
"""Part of the samples for rows whose likelihood takes long."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=list(PARTS), nargs="?")
    parser.add_argument("--out", type=Path, default=Path("bench/impulse"))
    parser.add_argument("--samples", type=int, default=100)
    parser.add_argument("--only", choices=[*ROWS, *COURSES], nargs="*")
    parser.add_argument("--model", choices=["scatterers", "rays"], default="scatterers")
    parser.add_argument("--estimators", default="zero,correlation,likelihood")
    parser.add_argument("--pings", type=int, default=10, help="of each motion of a course")
    parser.add_argument("--rays", type=int, nargs="+", default=[12_500, 50_000], help="of regressors: in each field of view")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="all four, small, kept nowhere: within a minute")
    arguments = parser.parse_args()
    if arguments.what is None and not arguments.quick:
        parser.error(f"say what: {', '.join(PARTS)}, or --quick")
    os.environ["OMP_NUM_THREADS"] = "1"
    print(f"{cpu()}, {time.strftime('%Y-%m-%d')}, model {arguments.model}", flush=True)
    if not arguments.quick:
        arguments.out.mkdir(parents=True, exist_ok=True)
        with workers(arguments.processes) as arguments.pool:
            return PARTS[arguments.what](arguments)
    with tempfile.TemporaryDirectory() as folder, workers(1) as arguments.pool:
        arguments.out, arguments.samples, arguments.pings, arguments.processes = Path(folder), SCENES, 2, 1
        for part, only in (("rows", "impulse-two-receivers"), ("noise", "impulse-standard"), ("courses", "sinusoid")):
            arguments.only = [only]
            arguments.estimators = "zero,correlation,likelihood" if part == "rows" else "correlation"
            PARTS[part](arguments)
        regressors(arguments)
        figure(arguments)


def workers(processes: int) -> AbstractContextManager[Pool]:
    """Create a pool of processes that run :func:`estimate_of`."""
    return multiprocessing.get_context("spawn").Pool(processes)


def recipe_of(arguments: argparse.Namespace, name: str) -> Recipe:
    """Return a recipe of scenes that no network has seen."""
    rays = {"channel.rays": arguments.rays[0]} if arguments.model == "rays" else {}
    return load_recipe(name, {"seed": SEED, "channel.model": arguments.model, **rays, **(SMALL if arguments.quick else {})})


# ---------------------------------------------------------------- samples


def report(arguments: argparse.Namespace, name: str) -> list[ImpulseResponses]:
    """Load the samples of a data set from OUT, or make them."""
    recipe, samples = recipe_of(arguments, name), arguments.samples
    path = arguments.out / f"{name}-{arguments.model}-{samples}.npz"
    if not path.exists():
        parts = list(fresh(recipe, samples))
        np.savez(
            path,
            response=np.array([one.response for one in parts]),
            poses=np.array([one.poses for one in parts]),
            time_s=parts[0].time_s,
        )
    table = np.load(path)
    sonar = recipe.channel_sonar
    return [
        ImpulseResponses(response, table["time_s"], sonar, poses=poses, height_m=poses[:, 2])
        for response, poses in zip(table["response"], table["poses"], strict=True)
    ]


_LAST: dict[object, ChannelSimulator] = {}
"""A simulator of each scene that is open: rows over the same scene share its scatterers."""


def fresh(recipe: Recipe, samples: int) -> Iterator[ImpulseResponses]:
    """Make the first sequences of the first scenes of a recipe."""
    sonar = recipe.channel_sonar
    for scene in scenes_of(recipe, recipe.sequences)[:SCENES]:
        simulator = simulator_of(recipe, scene)
        for sequence in itertools.islice(sequences_of(recipe, scene), samples // SCENES):
            flown = sequence.at_rate(sonar.frame_rate_hz)
            yield simulator.responses(flown, velocities(flown))


def simulator_of(recipe: Recipe, scene: Any) -> ChannelSimulator:
    """Of a scene, whose mesh is loaded once for all rows."""
    key = (recipe.family(scene.group).model_dump_json(), scene.seed)
    if key not in _LAST:
        if len(_LAST) >= SCENES:
            _LAST.clear()
        with tempfile.TemporaryDirectory() as folder:
            path, parameters = recipe.family(scene.group).prepare(scene.seed, Path(folder) / "world")
            _LAST[key] = ChannelSimulator(load_scene(path, **parameters), recipe.channel_sonar)
    like = _LAST[key]
    return ChannelSimulator(like.tracer.scene, recipe.channel_sonar, like=like)


# ---------------------------------------------------------------- estimates


def estimate_of(work: tuple[str, dict[str, bool], ImpulseResponses]) -> list[float]:
    """Run an estimator, and return motion, standard deviations, validity and seconds."""
    name, options, responses = work
    begun = time.perf_counter()
    try:
        result = create_estimator(name, **options).estimate(responses)
    except MitsonarError:
        return [0.0] * 6 + [0.0, time.perf_counter() - begun]
    spread = np.full(3, np.nan) if result.covariance is None else np.sqrt(np.abs(np.diag(result.covariance)))
    return [*result.motion, *spread, float(result.valid), time.perf_counter() - begun]


def estimates(
    arguments: argparse.Namespace, label: str, name: str, samples: list[ImpulseResponses], **options: bool
) -> NDArray[np.float64]:
    """Answers ``(samples, 8)``, from OUT or new."""
    path = arguments.out / f"{label}-{file_name(name)}.json"
    if not path.exists():
        work = [(name, options, one) for one in samples]
        answers = arguments.pool.map(estimate_of, work, chunksize=max(1, len(work) // (4 * arguments.processes)))
        path.write_text(json.dumps(answers))
    return np.array(json.loads(path.read_text()))


def file_name(estimator: str) -> str:
    """Return the name of an estimator, or of the file of a network, as part of a file's name."""
    return re.sub(r"[^A-Za-z0-9]+", "-", estimator).strip("-")


def truth(samples: list[ImpulseResponses]) -> NDArray[np.float64]:
    """Motions from first to last ping ``(samples, 3)``."""
    return np.array([motions(one.poses[[0, -1]])[0] for one in samples if one.poses is not None])


def cells_of(answers: NDArray[np.float64], true: NDArray[np.float64]) -> str:
    """Format RMSE and median of all, share and RMSE of valid estimates, and milliseconds."""
    error = in_units(answers[:, :3] - true)
    rmse, median = np.sqrt((error**2).mean(axis=0)), np.median(np.abs(error), axis=0)
    valid = answers[:, 6] > 0
    rmse_valid = np.sqrt((error[valid] ** 2).mean(axis=0)) if valid.any() else np.full(3, np.nan)
    seconds = float(np.median(answers[:, 7]))
    columns = [" / ".join(f"{value:.3g}" for value in row) for row in (rmse, median, rmse_valid)]
    return f"{columns[0]} | {columns[1]} | {valid.mean():.0%}: {columns[2]} | {1e3 * seconds:.0f}"


HEAD = (
    "| data | estimator | RMSE sideways mm / forward mm / yaw deg | median | valid: RMSE | ms | Almanza-Medina | "
    "bound, rms |\n"
    "|---|---|---|---|---|---|---|---|"
)


def rows(arguments: argparse.Namespace) -> None:
    """Every row of table 5.2."""
    print(HEAD, flush=True)
    for name in arguments.only or ROWS:
        samples = report(arguments, name)
        true, some = truth(samples), slice(1, 2) if arguments.quick else slice(None, None, round(1 / COSTLY.get(name, 1.0)))
        turning = bool(np.abs(true[:, 2]).max() > 1e-9)
        for estimator in arguments.estimators.split(","):
            used = samples[some] if estimator == "likelihood" else samples
            options = {"yaw": True} if turning and estimator == "likelihood" else {}
            answers = estimates(arguments, f"{name}-{arguments.model}-{arguments.samples}", estimator, used, **options)
            bound = (
                bound_of(arguments, name, used, turning)
                if estimator == "likelihood" and arguments.model == "scatterers"
                else ""
            )
            figure = ROWS[name] if estimator == "likelihood" else ""
            mine = true[some] if estimator == "likelihood" else true
            print(f"| {name} ({len(used)}) | {estimator} | {cells_of(answers, mine)} | {figure} | {bound} |", flush=True)


def bound_of(arguments: argparse.Namespace, name: str, samples: list[ImpulseResponses], turning: bool) -> str:
    """Root mean square of the local bound over some of the samples' motions, noiseless."""
    path = arguments.out / f"{name}-bound.json"
    if not path.exists():
        free = (0, 1, 2) if turning else (0, 1)
        stds = []
        for one, true in list(zip(samples, truth(samples), strict=True))[:24]:
            span = float(one.time_s[-1] - one.time_s[0])
            stds.append(channel_crlb(one.sonar, 10.0, true, pings=len(one), span_s=span, free=free).tolist())
        path.write_text(json.dumps(stds))
    bounds = np.array(json.loads(path.read_text()))
    scale = np.array([1e3, 1e3, 180 / np.pi])[: bounds.shape[1]]
    rms, median = np.sqrt((bounds**2).mean(axis=0)) * scale, np.median(bounds, axis=0) * scale
    return " / ".join(f"{value:.3g}" for value in rms) + " (median " + " / ".join(f"{v:.3g}" for v in median) + ")"


# ---------------------------------------------------------------- noise, leaks, wrong words


def noise(arguments: argparse.Namespace) -> None:
    """Evaluate the standard row and ten pings with noise, leaks and perturbations."""
    print(
        "| data | noise or change | estimator | RMSE | median | valid: RMSE | ms |\n|---|---|---|---|---|---|---|",
        flush=True,
    )
    for name in arguments.only or ("impulse-standard", "impulse-ten-80khz"):
        samples = report(arguments, name)
        true = truth(samples)
        cases: dict[str, list[ImpulseResponses]] = {}
        for snr in (30.0, 20.0, 10.0, 0.0):
            cases[f"{snr:g} dB"] = [noisy(one, number, snr) for number, one in enumerate(samples)]
        cases["one ping, again and again"] = [repeated(one) for one in samples]
        cases["pings of two scenes"] = [
            strangers(one, samples[number - 2 * len(samples) // 5]) for number, one in enumerate(samples)
        ]
        for percent in (-5, 5):
            cases[f"height given as {percent:+d} %"] = [
                replace(one, height_m=one.height_m * (1 + percent / 100)) for one in samples if one.height_m is not None
            ]
        for percent in (-1, 1):
            sonar = samples[0].sonar.replace(sound_speed=1500 * (1 + percent / 100))
            cases[f"sound speed given as {percent:+d} %"] = [replace(one, sonar=sonar) for one in samples]
        for case, changed in cases.items():
            for estimator in arguments.estimators.split(","):
                if estimator == "zero":
                    continue
                label = f"{name}-{arguments.model}-{arguments.samples}-{case.replace(' ', '_').replace('%', 'pc')}"
                answers = estimates(arguments, label, estimator, changed)
                print(f"| {name} | {case} | {estimator} | {cells_of(answers, true)} |", flush=True)


def noisy(one: ImpulseResponses, number: int, snr_db: float) -> ImpulseResponses:
    """With white complex noise."""
    return replace(one, response=with_noise(one.response, np.arange(len(one)) + 1000 * number, snr_db, SEED))


def repeated(one: ImpulseResponses) -> ImpulseResponses:
    """Replace all pings by the first one."""
    return replace(one, response=np.repeat(one.response[:1], len(one), axis=0))


def strangers(one: ImpulseResponses, other: ImpulseResponses) -> ImpulseResponses:
    """Join the first ping with the later pings of another scene."""
    return replace(one, response=np.concatenate([one.response[:1], other.response[1:]]))


# ---------------------------------------------------------------- courses


def course_of(arguments: argparse.Namespace, name: str, around: Pose) -> Trajectory:
    """Return a course, or its first positions."""
    flown = course(name, around)
    return Trajectory(flown.poses[:9], flown.time_s[:9]) if arguments.quick else flown


def courses(arguments: argparse.Namespace) -> None:
    """Table 5.6: motion by motion, and where the path ends."""
    print(
        "| course | estimator | RMSE sideways mm / forward mm | valid | path m | end error cm | of the path |\n"
        "|---|---|---|---|---|---|---|",
        flush=True,
    )
    recipe = recipe_of(arguments, "impulse-standard")
    for name in arguments.only or COURSES:
        flown, steps = course_of(arguments, name, Pose(0, 0, 10)), arguments.pings - 1
        path = arguments.out / f"course-{name}-{arguments.model}-{arguments.pings}.npz"
        if not path.exists():
            fine = flown.resample((len(flown) - 1) * steps + 1)
            simulator = simulator_of(recipe, scenes_of(recipe, recipe.sequences)[0])
            simulator.responses(fine, velocities(fine)).save(path)
        responses = ImpulseResponses.load(path)
        pairs = [responses.select(slice(k * steps, (k + 1) * steps + 1)) for k in range(len(flown) - 1)]
        true = motions(flown.poses)
        length = float(np.hypot(*true[:, :2].T).sum())
        for estimator in arguments.estimators.split(","):
            if estimator == "zero":
                continue
            label = f"course-{name}-{arguments.model}-{arguments.pings}"
            answers = (
                driven(arguments, label, estimator, responses)
                if steps == 1
                else estimates(arguments, label, estimator, pairs)
            )
            error = answers[:, :2] - true[:, :2]
            rmse, end = 1e3 * np.sqrt((error**2).mean(axis=0)), float(np.hypot(*error.sum(axis=0)))
            print(
                f"| {name} | {estimator} | {rmse[0]:.2f} / {rmse[1]:.2f} | {answers[:, 6].mean():.0%} | {length:.1f} | "
                f"{100 * end:.2f} | {end / length:.2%} |",
                flush=True,
            )


def driven(arguments: argparse.Namespace, label: str, name: str, responses: ImpulseResponses) -> NDArray[np.float64]:
    """Estimate motions ``(n, 7)`` from ping to ping as odometry does. Neighbours resolve ambiguous motions, and invalid ones
    are bridged. The last column is the validity."""
    path = arguments.out / f"{label}-{file_name(name)}.json"
    if not path.exists():
        result = odometry(
            ResponseSource(label, responses), create_estimator(name), OdometryOptions(workers=arguments.processes)
        )
        rows = np.column_stack([result.series.motions, np.zeros((len(result.series), 3)), result.valid])
        path.write_text(json.dumps(rows.tolist()))
    return np.array(json.loads(path.read_text()))


def figure(arguments: argparse.Namespace) -> None:
    """Paths of the sinusoid: true, by impulse responses (after `courses`), by sonar images."""
    from matplotlib.figure import Figure

    recipe = recipe_of(arguments, "impulse-standard")
    scene = simulator_of(recipe, scenes_of(recipe, recipe.sequences)[0]).tracer.scene
    flown = course_of(arguments, "sinusoid", Pose(0, 0, 2.5, pitch=np.radians(35)))
    sonar = load_sonar("didson300").replace(frame_rate_hz=20.0)
    frames = Simulator(scene, sonar).render(flown)
    seen = odometry(frames, create_estimator("direct"), OdometryOptions(start=Pose.from_row(flown.poses[0])))
    path = arguments.out / f"course-sinusoid-{arguments.model}-{arguments.pings}-correlation.json"
    received = np.array(json.loads(path.read_text()))[:, :3]
    driven_by = {
        "impulse responses, correlation of ten pings": path_of(received, Pose.from_row(flown.poses[0]), flown.time_s).poses,
        "DIDSON images, direct": seen.path.poses,
    }
    drawn = Figure(figsize=(10, 5), layout="constrained")
    axes = drawn.add_subplot()
    axes.plot(*flown.poses[:, :2].T, "k--", lw=2, label="true")
    true = motions(flown.poses)
    for (name, poses), answers in zip(driven_by.items(), (received, seen.series.motions), strict=True):
        rmse = np.sqrt((in_units(answers - true) ** 2).mean(axis=0))
        end = float(np.hypot(*(poses[-1, :2] - flown.poses[-1, :2])))
        print(
            f"{name}: RMSE {rmse[0]:.2f} / {rmse[1]:.2f} mm, {rmse[2]:.3f} deg; end-point error {100 * end:.1f} cm",
            flush=True,
        )
        axes.plot(*poses[:, :2].T, lw=1.2, label=f"{name}: ends {100 * end:.1f} cm off")
    print(f"images: {int((~seen.valid).sum())} of {len(true)} motions invalid and bridged", flush=True)
    axes.set(xlabel="starboard (m)", ylabel="forward (m)", aspect="equal", title="Trajectory 5 (sinusoid), no noise")
    axes.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3)
    axes.grid(alpha=0.3)
    drawn.savefig(arguments.out / "sinusoid.png", dpi=110)


def places(arguments: argparse.Namespace) -> None:
    """Print errors and processor time of the guide's motion at many places."""
    import mitsuba as mi

    print(
        "| ground | estimator | RMSE mm | median of distances mm | nees / 2, median | valid | ms of processor time |\n"
        + "|---" * 7
        + "|"
    )
    stones = load_scene("hydrophones")
    seabed = mi.load_dict({"type": "scene", "seabed": next(one for one in stones.shapes() if one.id() == "seabed")})
    for ground, scene in (("stones", stones), ("seabed alone", seabed)):
        simulator = ChannelSimulator(scene, ChannelSonar(frame_rate_hz=180))
        for name in ("correlation", "likelihood"):
            print(
                f"| {ground} | `{name}` | {place_cells(name, simulator, 5 if arguments.quick else arguments.samples)} |",
                flush=True,
            )


def place_cells(name: str, simulator: ChannelSimulator, samples: int) -> str:
    """Format the errors of an estimator at places drawn at random, the same for all."""
    rng, motion = np.random.default_rng(SEED), np.array([1.0, 0.5, 0.0]) / 180
    errors, nees, valid, ms = [], [], [], []
    for _ in range(samples):
        (x, y), heading = rng.uniform(-4, 4, 2), rng.uniform(0, 2 * np.pi)
        pair = path_of(motion[None], Pose(x, y, 10.0, 0.0, 0.0, heading), np.array([0.0, 1 / 180]))
        responses = simulator.responses(pair, velocities(pair))
        begun = time.process_time()
        result = create_estimator(name).estimate(responses)
        ms.append(1e3 * (time.process_time() - begun))
        error = (np.array(result.motion) - motion)[:2]
        errors.append(1e3 * error)
        valid.append(result.valid)
        if result.covariance is not None:
            nees.append(error @ np.linalg.solve(result.covariance[:2, :2], error) / 2)
    rmse = " / ".join(f"{value:.3f}" for value in np.sqrt(np.square(errors).mean(axis=0)))
    distance = np.median(np.hypot(*np.transpose(errors)))
    known = f"{np.median(nees):.2f}" if nees else "-"
    return f"{rmse} | {distance:.3f} | {known} | {sum(valid)} of {samples} | {np.median(ms):.0f}"


LEAKS: tuple[Literal["none", "one_ping"], ...] = ("none", "one_ping")
ONE_BY_ONE = Split(by="sample", train=0.8, validation=0.2)
"""How Almanza-Medina deals out samples (5.4.1)."""


def regressors(arguments: argparse.Namespace) -> None:
    """Table 5.5: forward RMSE of ten regressors on pairs, and on one ping twice."""
    print("| regressor | rays | pairs, RMSE mm | one ping twice | no motion | learnt in s |\n" + 6 * "|---" + "|")
    small = {**SMALL, "scenes": [{"count": 2, "sequences": 20}]} if arguments.quick else {}
    for rays in arguments.rays[: 1 if arguments.quick else None]:
        path = arguments.out / f"impulse-standard-{rays}.zarr"
        make_dataset(
            load_recipe("impulse-standard", {"channel.rays": rays, **small}), str(path), workers=arguments.processes
        )
        names = list(REGRESSORS)[1:3] if arguments.quick else list(REGRESSORS)
        for name in names:
            both = []
            for leak in LEAKS:
                parts = [ImpulsePairs(path, part=part, leak=leak, split=ONE_BY_ONE) for part in ("train", "validation")]
                both += score_all(flattened(parts[0]), flattened(parts[1]), names=[name])
            pairs, alone = both
            errors = " | ".join(f"{value:.2f}" for value in (pairs.rmse_mm, alone.rmse_mm, pairs.zero_mm))
            print(f"| {name} | {rays:,} | {errors} | {pairs.fit_s:.0f} |", flush=True)


PARTS = {"rows": rows, "noise": noise, "courses": courses, "regressors": regressors, "figure": figure, "places": places}

if __name__ == "__main__":
    main()
