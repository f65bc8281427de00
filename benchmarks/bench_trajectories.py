"""Table 2.1 and the synthetic trajectories of Almanza-Medina (2.3, 3.5.1), with estimators that need no training.

    python benchmarks/bench_trajectories.py [--only table21,trajectories] [--methods direct,posenet] [--frames N] [--every N]
    python benchmarks/bench_trajectories.py --quick       # five frames of each run, one seabed, kept nowhere

`table21`: three runs over six seabeds (recipe pattern-runs), every consecutive pair, or one of N. `trajectories`: 904 frames
over a rocky field that no recipe has, and two runs over the pattern; drift, and mosaics along true and estimated paths. Two
processes of one thread each. Every finished run is a line of DIR/results.jsonl, with its estimates in an .npz
beside it, so that a killed benchmark resumes.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, replace
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from trajectory_jobs import (
    BRAKED,
    COARSE,
    CREEPING,
    FAST,
    FIELD_M,
    FIELD_SEED,
    FRAMES,
    HEIGHT_M,
    PITCH_DEG,
    RECIPES,
    RUNS,
    SETTINGS,
    SLOW,
    SPECKLE,
    TABLE_21,
    TEXTURES,
    Job,
    Setting,
    Table,
    jobs,
    trajectory_job,
)
from trajectory_pictures import draw, draw_errors, draw_network

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.config.data import load_recipe, shipped_recipes
from mitsonar.datasets.plan import run_poses
from mitsonar.errors import MitsonarWarning
from mitsonar.estimation.estimator import Estimate
from mitsonar.estimation.named import create_estimator
from mitsonar.mapping.odometry import OdometryOptions, odometry
from mitsonar.mapping.pairs import EstimateStore
from mitsonar.mapping.sensors import SensorNoise, simulated_sensors
from mitsonar.mapping.series import MotionSeries, kalman_smoothed, path_of, pose_covariances, spline_smoothed
from mitsonar.motion.composition import motions
from mitsonar.motion.errors import assess, motion_errors
from mitsonar.motion.pose import Pose, mounted
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames, to_uint8
from mitsonar.reproduction.odometry_benchmark import TEXTURES as SONARS

Array = NDArray[np.float64]
PARTS = ("table21", "trajectories")
WORKERS = 2
GYRO = SensorNoise(gyro_deg_rth=1.0)
"""A gyroscope of 1 deg/h^0.5, as a good one of a vehicle has it."""

Result = dict[str, Any]
"""Numbers and texts of one job, as a line of ``results.jsonl`` holds them."""


# ---------------------------------------------------------------- command


def main() -> None:
    """Run what is missing, draw, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default=",".join(PARTS), help="which parts, with commas between")
    parser.add_argument(
        "--models", default=",".join(RECIPES), help=f"of the trajectories, with commas between; {SPECKLE} too"
    )
    parser.add_argument("--methods", default="direct", help="of the trajectories, with commas between; networks too")
    parser.add_argument("--frames", type=int, default=0, help="so many frames of each run at most, to try")
    parser.add_argument("--out", type=Path, default=Path("out/trajectories"), help="data sets, results, estimates")
    parser.add_argument("--pictures", type=Path, help="where pictures go (default: OUT)")
    parser.add_argument("--every", type=int, default=1, help="of table21, only one of so many pairs")
    parser.add_argument("--quick", action="store_true", help="five frames of each run, one seabed: within a minute")
    args = parser.parse_args()
    parts = args.only.split(",")
    if not set(parts) <= set(PARTS):
        parser.error(f"--only takes {', '.join(PARTS)}: got {args.only}")
    if not args.quick:
        return benchmark(args, parts, Table(TEXTURES, SETTINGS))
    with tempfile.TemporaryDirectory(prefix="bench-trajectories-") as folder:
        few = {"frames": 5, "every": 1, "out": Path(folder), "pictures": None, "methods": "direct,posenet"}
        benchmark(argparse.Namespace(**{**vars(args), **few}), parts, Table(TEXTURES[:1], SETTINGS[:2]))


def benchmark(args: argparse.Namespace, parts: list[str], table: Table) -> None:
    """Run what is missing, draw, print the tables."""
    args.out.mkdir(parents=True, exist_ok=True)
    if "table21" in parts:
        for model in RECIPES:
            make_pattern_runs(args.out, model, args.quick)
    models = args.models.split(",")
    methods = args.methods.split(",")
    listed = jobs(parts, args.frames, args.every, table, args.quick, methods)
    expected = [job for job in listed if job.part == "table21" or job.model in models]
    results = run_all(expected, args.out)
    pictures = args.pictures or args.out
    if "trajectories" in parts and set(models) == set(RECIPES):
        draw(args.out, pictures, args.frames)
    for method in methods if "trajectories" in parts else []:
        if method != "direct" and "thesis" in models:
            draw_network(args.out, pictures, args.frames, method)
    if "table21" in parts:
        draw_errors(args.out, pictures, next(job for job in expected if job.part == "table21" and job.run == "diagonal"))
    print(machine(args.frames, args.every))
    if "table21" in parts:
        print("\n" + "\n".join(table21([row for row in results if row["part"] == "table21"], args.every, table)))
    if "trajectories" in parts:
        print("\n" + "\n".join(trajectory_table([row for row in results if row["part"] == "trajectories"])))


def run_all(expected: list[Job], out: Path) -> list[Result]:
    """Run the jobs, and return all results in their order. Results of an earlier call are read."""
    log = out / "results.jsonl"
    done = {}
    for line in log.read_text().splitlines() if log.exists() else []:
        row = json.loads(line)
        done[Job(**{key: row[key] for key in Job.__dataclass_fields__ if key in row})] = row
    missing = [job for job in expected if job not in done]
    context, begun = multiprocessing.get_context("spawn"), time.perf_counter()
    with ProcessPoolExecutor(WORKERS, mp_context=context, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        running = {pool.submit(run, job, out): job for job in missing}
        for number, future in enumerate(as_completed(running), start=1):
            row = asdict(running[future]) | future.result()
            done[running[future]] = row
            with log.open("a") as file:
                file.write(json.dumps(row) + "\n")
            rmse = ", ".join(f"{value:.3g}" for value in row["rmse"])
            note(f"{number}/{len(missing)} after {time.perf_counter() - begun:.0f} s: {running[future].name}: {rmse}")
    return [done[job] for job in expected]


def run(job: Job, out: Path) -> Result:
    """Run one job in a process of its own."""
    return (run_table21 if job.part == "table21" else run_trajectory)(job, out)


def note(text: str) -> None:
    """Print progress on standard error."""
    print(text, file=sys.stderr, flush=True)


def machine(frames: int, every: int) -> str:
    """Describe the machine, the versions, the date and the scale."""
    names = [line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line]
    cpu = names[0] if names else platform.machine()
    scale = f"trajectories: {f'{frames} frames at most' if frames else 'all frames'}; table 2.1: one of {every} pairs"
    packages = {"Mitsuba": "mitsuba", "OpenCV": "opencv-python-headless"}
    versions = ", ".join(f"{name} {version(package)}" for name, package in packages.items())
    return f"{cpu}, {len(os.sched_getaffinity(0))} cores; {versions}, {date.today().isoformat()}; {scale}"


# ---------------------------------------------------------------- table 2.1


def pattern_runs(out: Path, model: str) -> Path:
    """Return the path of the data set of a model."""
    return out / f"pattern-runs-{model}.zarr"


def make_pattern_runs(out: Path, model: str, coarse: bool) -> None:
    """Make the data set of the shipped recipe with the sonar of a model; coarse: the runs over the first seabed only."""
    fields = yaml.safe_load(shipped_recipes()["pattern-runs"].read_text(encoding="utf-8"))
    fields["sonar"] = yaml.safe_load(shipped_recipes()[RECIPES[model]].read_text(encoding="utf-8"))["sonar"]
    if coarse:
        fields["sonar"] |= COARSE
    recipe = out / f"pattern-runs-{model}.yaml"
    recipe.write_text(yaml.safe_dump(fields), encoding="utf-8")
    note(f"making {pattern_runs(out, model)}")
    words = ["dataset", "make", str(recipe), "-o", str(pattern_runs(out, model))]
    words += ["--sequences", str(len(RUNS)), "--workers", "1"] if coarse else []
    subprocess.run([sys.executable, "-m", "mitsonar", *words], check=True, stdout=sys.stderr)


def run_table21(job: Job, out: Path) -> Result:
    """Estimate consecutive pairs of a run: all, one of ``every``, or ``frames`` evenly spaced."""
    from mitsonar.datasets.samples import SonarPairs

    pairs = SonarPairs(pattern_runs(out, job.model), part="all", split="sequence", noise=job.noise)
    number = TEXTURES.index(job.texture) * len(RUNS) + RUNS.index(job.run)
    mine = np.flatnonzero(pairs.sequence[pairs.first] == number)
    chosen = mine[:: job.every]
    if job.frames:
        chosen = mine[np.unique(np.linspace(0, len(mine) - 1, job.frames).astype(int))]
    looked = (pairs.sonar_frames(int(index)) for index in chosen)
    result, each = estimates_of(job.method, looked)
    true = np.array([pairs.target(int(index)) for index in chosen])
    keep(job, out, result, true)
    return scores(result, true) | {"ms": each}


def estimates_of(method: str, pairs: Iterable[SonarFrames]) -> tuple[list[Estimate], float]:
    """Estimate the motions of pairs of frames, and the median milliseconds a pair."""
    estimator = create_estimator(method)
    result, taken = [], []
    for frames in pairs:
        start = time.perf_counter()
        result.append(estimator.estimate(frames))
        taken.append(time.perf_counter() - start)
    return result, 1e3 * float(np.median(taken))


def scores(results: list[Estimate], true: Array) -> Result:
    """Compute the errors of the tables. Invalid estimates count as zero motion."""
    motion = np.array([one.motion for one in results])
    valid = np.array([one.valid for one in results])
    unknown = np.full((3, 3), np.nan)
    covariances = np.array([unknown if one.covariance is None else one.covariance for one in results])
    errors = motion_errors(motion, true, valid, covariances)
    heights = [one.about["height_m"] for one in results if "height_m" in one.about]
    found_errors = {name: getattr(errors, name).tolist() for name in ("rmse", "median", "bias", "slope", "zero", "believed")}
    return found_errors | {
        "pairs": errors.pairs,
        "failures": errors.failures,
        "nees": errors.nees,
        "height_m": float(np.mean(heights)) if heights else None,
    }


def keep(job: Job, out: Path, results: list[Estimate], true: Array) -> None:
    """Save the estimates for closer analysis."""
    unknown = np.full((3, 3), np.nan)
    np.savez_compressed(
        out / f"{job.name}.npz",
        motion=[one.motion for one in results],
        covariance=[unknown if one.covariance is None else one.covariance for one in results],
        valid=[one.valid for one in results],
        height_m=[one.about.get("height_m", np.nan) for one in results],
        true=true,
    )


def table21(rows: list[Result], every: int, table: Table) -> Iterator[str]:
    """Format table 2.1 as Markdown: a row for each method and seabed, with those of Almanza-Medina and of zero motion."""
    yield "RMSE sideways mm / forward mm / yaw deg, over the three runs of Almanza-Medina, 2.3"
    yield ""
    yield f"| seabed | method | model | noise | pairs | {' | '.join(RUNS)} | invalid |"
    yield "|---" * (6 + len(RUNS)) + "|"
    by = {
        (row["texture"], Setting(row["method"], row["model"], row["noise"], row["every"]), row["run"]): row for row in rows
    }
    for texture in table.textures:
        cells = [" / ".join(f"{value:.4g}" for value in one) for one in TABLE_21[texture]]
        yield f"| {texture} | Almanza-Medina, table 2.1 | its own | chapter2 | 1,547 | {' | '.join(cells)} | |"
        for setting in table.settings:
            mine = [by[texture, setting._replace(every=setting.every * every), run] for run in RUNS]
            cells = [numbers(row["rmse"]) for row in mine]
            failed = sum(row["failures"] for row in mine)
            pairs = sum(row["pairs"] for row in mine)
            yield f"| {texture} | {' | '.join(setting[:3])} | {pairs:,} | {' | '.join(cells)} | {failed} |"
    pairs = sum(by[TEXTURES[0], SETTINGS[0]._replace(every=every), run]["pairs"] for run in RUNS)
    zero = [numbers(by[TEXTURES[0], SETTINGS[0]._replace(every=every), run]["zero"]) for run in RUNS]
    yield f"| any | zero | any | any | {pairs:,} | {' | '.join(zero)} | |"


def numbers(values: Iterable[float]) -> str:
    """Format sideways / forward / yaw."""
    sideways, forward, yaw = values
    return f"{sideways:.2f} / {forward:.2f} / {yaw:.3f}"


# ---------------------------------------------------------------- trajectories


def driven(run: str, rate_hz: float, frames: int = 0) -> Trajectory:
    """Return the first ``frames`` poses of the sonar in a run of 3.5.1, or over the pattern."""
    if run in RUNS:
        vehicle = run_poses(run, HEIGHT_M)
    else:
        time_s = np.arange(FRAMES) / rate_hz
        half = time_s[-1] / 2
        speed = np.interp(time_s, [0, 2 * half], [SLOW, FAST])
        if run == "braking":
            speed = np.interp(time_s, [0, half, 2 * half], [CREEPING, BRAKED, CREEPING])
        along = np.concatenate([[0], np.cumsum((speed[1:] + speed[:-1]) / 2)]) / rate_hz
        centred = along - along[-1] / 2
        vehicle = np.zeros((FRAMES, 6))
        vehicle[:, 0 if run == "sideways" else 1] = centred
        vehicle[:, 2] = HEIGHT_M
    vehicle = vehicle[: frames or None]
    return Trajectory(mounted(vehicle, Pose.from_degrees([0, 0, 0, PITCH_DEG, 0, 0])), np.arange(len(vehicle)) / rate_hz)


def rendered(job: Job) -> SonarFrames:
    """Render the frames of a run as a sonar would store them: noisy, in 256 grey values."""
    from mitsonar.simulation.scene import load_scene
    from mitsonar.simulation.simulator import Simulator
    from mitsonar.worlds.families import Pattern, RockyField

    recipe, speckle = (RECIPES["physical"], SONARS["speckle"]) if job.model == SPECKLE else (RECIPES[job.model], {})
    sonar = load_recipe(recipe).instrument.replace(**(COARSE if job.coarse else {}), **speckle)
    rocks = {"a_side": (9, 15)} if job.coarse else {}
    family = Pattern(texture="gaussian") if job.run in RUNS else RockyField(size_m=FIELD_M, **rocks)
    with tempfile.TemporaryDirectory(prefix="bench-trajectories-") as folder:
        world, parameters = family.prepare(FIELD_SEED, Path(folder) / "world")
        simulator = Simulator(load_scene(world, **parameters), sonar)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MitsonarWarning)  # the window of the recipes drops farther echoes, with a warning
        path = driven(job.run, sonar.frame_rate_hz, job.frames)
        result = simulator.render(path, noise=NOISE_MODELS[job.noise], seed=1)
    return replace(result, image=to_uint8(result.image))


def run_trajectory(job: Job, out: Path) -> Result:
    """Estimate consecutive frames, and compute the paths and their errors. Frames are saved for mosaics."""
    frames = rendered(job)
    assert frames.poses is not None
    true = Trajectory(frames.poses, frames.time_s)
    result, each = estimates_of(job.method, (frames.select(slice(k, k + 2)) for k in range(len(frames) - 1)))
    moved = motions(frames.poses)
    keep(job, out, result, moved)
    row = scores(result, moved) | {"ms": each, "paths": {}}
    start = Pose.from_row(frames.poses[0])
    for name, series in smoothed(result, frames.time_s).items():
        path = path_of(series.motions, start, series.time_s)
        path.save_tum(out / f"{job.name}-{name}.tum")
        row["paths"][name] = path_errors(path, true, None if series.covariances is None else pose_covariances(series, start))
    if job.method == "direct":
        row["paths"] |= mapped_paths(job, frames, result)
    if job.method == "direct" or not (out / f"{trajectory_job(job.run, job.model, job.frames).name}-frames.npz").exists():
        frames.save(out / f"{trajectory_job(job.run, job.model, job.frames).name}-frames.npz")
    return row


def smoothed(results: list[Estimate], time_s: Array) -> dict[str, MotionSeries]:
    """Return the estimates without smoothing (invalid ones as no motion), and smoothed."""
    series = MotionSeries.from_estimates(results, time_s)
    motion = np.where(series.is_valid[:, None], series.motions, 0)
    known = None if series.covariances is None else np.where(series.is_valid[:, None, None], series.covariances, 0)
    raw = MotionSeries(motion, time_s, known)
    return {"raw": raw, "Kalman": kalman_smoothed(series), "spline": spline_smoothed(series)}


def mapped_paths(job: Job, frames: SonarFrames, results: list[Estimate]) -> dict[str, dict[str, float]]:
    """Return the errors with a local map, and with a gyroscope beside it."""
    assert frames.poses is not None
    true = Trajectory(frames.poses, frames.time_s)
    store = EstimateStore(dict(enumerate(results)))
    sensors = {"map": None, "map, gyroscope": simulated_sensors(true, GYRO, seed=0)}
    paths = {
        name: odometry(frames, job.method, OdometryOptions(local_map=True, sensors=one), store=store)
        for name, one in sensors.items()
    }
    return {name: path_errors(one.path, true, one.pose_covariances) for name, one in paths.items()}


def path_errors(path: Trajectory, true: Trajectory, covariances: Array | None) -> dict[str, float]:
    """Compute the errors of a path for the table; covariances are those of its poses ``(frames, 3, 3)``."""
    errors = assess(path, true)
    length = min(1.0, 0.5 * errors.path_m)
    metre = assess(path, true, delta=length, unit="metres")
    off = path.poses[-1, :2] - true.poses[-1, :2]
    estimated_end = {} if covariances is None else {"reported_mm": 1e3 * float(np.sqrt(np.trace(covariances[-1, :2, :2])))}
    return estimated_end | {
        "path_m": errors.path_m,
        "estimated_path_m": errors.estimated_path_m,
        "end_east_mm": 1e3 * float(off[0]),
        "end_north_mm": 1e3 * float(off[1]),
        "end_percent": 100 * errors.end_drift,
        "end_heading_deg": float(np.degrees(errors.end_heading_rad)),
        "heading_deg_100m": 100 * float(np.degrees(errors.heading_drift_rad_per_m)),
        "ate_mm": 1e3 * errors.absolute_rmse_m,
        "rpe_mm": 1e3 * errors.relative_rmse_m,
        "rpe_deg": float(np.degrees(errors.relative_angle_rmse_rad)),
        "rpe_metre_mm": 1e3 * metre.relative_rmse_m,
    }


def trajectory_table(rows: list[Result]) -> Iterator[str]:
    """Format the errors of the paths as Markdown."""
    heads = (
        "run | model | noise | method | path m | end east mm | end north mm | end % of path | heading deg | deg per 100 m"
    )
    heads += " | ATE mm | frame mm | frame deg | 1 m of path mm | slope | invalid | estimated end error, mm"
    yield f"| {heads} |"
    yield "|---" * (heads.count("|") + 1) + "|"
    for row in rows:
        for name, path in row["paths"].items():
            method = row["method"] + ("" if name == "raw" else f", {name}")
            slope = [value for value, zero in zip(row["slope"], row["zero"], strict=True) if zero > 1e-6]
            cells = [row["run"], row["model"], row["noise"], method, f"{path['path_m']:.2f}"]
            cells += [f"{path['end_east_mm']:+.0f}", f"{path['end_north_mm']:+.0f}", f"{path['end_percent']:.2f}"]
            cells += [f"{path['end_heading_deg']:+.2f}", f"{path['heading_deg_100m']:+.1f}", f"{path['ate_mm']:.0f}"]
            cells += [f"{path['rpe_mm']:.2f}", f"{path['rpe_deg']:.3f}", f"{path['rpe_metre_mm']:.1f}"]
            cells += [" / ".join(f"{value:.3f}" for value in slope), str(row["failures"])]
            cells += [f"{path['reported_mm']:.0f}" if "reported_mm" in path else ""]
            yield f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
