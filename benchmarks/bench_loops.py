"""A closed square of 4 x 10 m over rocks: odometry with and without a gyroscope, and with and without loops.

    python benchmarks/bench_loops.py [--out DIR] [--noise none,high] [--seeds N]
    python benchmarks/bench_loops.py --quick       # a square of 4 x 0.6 m with few rays, kept nowhere

The field, height and pitch are those of `bench_trajectories.py`. The run begins and ends in the middle of a side, and turns
its corners on the spot, at 2 deg a frame. Its frames are rendered once and kept in DIR.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from bench_trajectories import GYRO, machine
from numpy.typing import NDArray
from trajectory_jobs import COARSE, FIELD_M, FIELD_SEED, HEIGHT_M, PITCH_DEG, RECIPES

from mitsonar.acoustics.noise import load_noise
from mitsonar.config.data import load_recipe
from mitsonar.errors import MitsonarWarning
from mitsonar.estimation.named import create_estimator
from mitsonar.mapping.odometry import Odometry, OdometryOptions, normalised_errors, odometry
from mitsonar.mapping.pairs import EstimateStore
from mitsonar.mapping.sensors import simulated_sensors
from mitsonar.mapping.series import path_of
from mitsonar.mapping.sources import FrameSource
from mitsonar.motion.pose import Pose, mounted
from mitsonar.motion.sensors import VehicleSensors
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames, to_uint8

Array = NDArray[np.float64]

RATE_HZ = 7.0
"""Frames a second."""


@dataclass(frozen=True)
class Square:
    """A closed square: length of a side [m], steps along it (even), and frames of a corner."""

    side_m: float = 10.0
    steps: int = 234
    corner: int = 45

    @property
    def path(self) -> Trajectory:
        """Return the poses of the sonar: from the middle of the first side, headed along it, clockwise round."""
        leg = [[0.0, self.side_m / self.steps, 0.0]] * self.steps
        corner = [[0.0, 0.0, np.pi / 2 / self.corner]] * self.corner
        moved = np.array(leg[: self.steps // 2] + corner + (leg + corner) * 3 + leg[: self.steps // 2])
        start = Pose(-self.side_m / 2, 0.0, HEIGHT_M)
        vehicle = path_of(moved, start, np.arange(len(moved) + 1) / RATE_HZ)
        return Trajectory(mounted(vehicle.poses, Pose.from_degrees([0, 0, 0, PITCH_DEG, 0, 0])), vehicle.time_s)


def main() -> None:
    """Render what is missing, run, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/loops"), help="folder of the frames")
    parser.add_argument("--noise", default="none,high", help="models, with commas between")
    parser.add_argument("--seeds", type=int, default=5, help="draws of the gyroscope's noise")
    parser.add_argument("--quick", action="store_true", help="a small square: within a minute")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print(machine(0, 1).split(";")[0])
    if not args.quick:
        return benchmark(args.out, Square(), args.noise.split(","), args.seeds, coarse=False)
    with tempfile.TemporaryDirectory(prefix="bench-loops-") as folder:
        benchmark(Path(folder), Square(0.6, 14, 30), ["none"], 1, coarse=True)


def benchmark(out: Path, square: Square, noises: list[str], seeds: int, *, coarse: bool) -> None:
    """Print a table row for each noise, sensor and choice of loops."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / "square-physical.npz"
    if not file.exists():
        rendered(square.path, coarse=coarse).save(file)
    source = FrameSource.of(SonarFrames.load(file))
    heads = "noise | gyroscope | loops | found | rejected | end mm | end % | ATE mm | heading deg | reported mm"
    heads += " | nees, mean | nees, end | s"
    print(f"\n| {heads} |\n" + "|---" * (heads.count("|") + 1) + "|")
    for noise in noises:
        for row in rows(source.with_noise(load_noise(noise), 1), noise, seeds):
            print(row, flush=True)


def rendered(path: Trajectory, *, coarse: bool) -> SonarFrames:
    """Render the frames of a path over the rocky field, in 256 grey values."""
    from mitsonar.simulation.scene import load_scene
    from mitsonar.simulation.simulator import Simulator
    from mitsonar.worlds.families import RockyField

    sonar = load_recipe(RECIPES["physical"]).instrument.replace(**(COARSE if coarse else {}))
    with tempfile.TemporaryDirectory(prefix="bench-loops-") as folder:
        field = RockyField(size_m=FIELD_M, **({"a_side": (9, 15)} if coarse else {}))
        world, parameters = field.prepare(FIELD_SEED, Path(folder) / "world")
        simulator = Simulator(load_scene(world, **parameters), sonar)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MitsonarWarning)  # the window of the recipe drops farther echoes, with a warning
        result = simulator.render(path, seed=1)
    return replace(result, image=to_uint8(result.image))


def rows(source: FrameSource, noise: str, seeds: int) -> Iterator[str]:
    """Run odometry with and without a gyroscope and loops; the motions of frames are estimated once."""
    estimator, store = create_estimator("direct"), EstimateStore()
    assert source.true is not None
    begun = time.perf_counter()
    plain = odometry(source, estimator, store=store)
    yield row([noise, "no", "no"], [plain], time.perf_counter() - begun)
    print(f"{len(store.pairs)} motions estimated", file=sys.stderr, flush=True)
    gyros = [simulated_sensors(source.true, GYRO, seed) for seed in range(seeds)]
    choices: list[tuple[Sequence[VehicleSensors | None], bool]] = [([None], True), (gyros, False), (gyros, True)]
    for sensors, loops in choices:
        begun = time.perf_counter()
        runs = [
            odometry(source, estimator, OdometryOptions(sensors=one, loops=loops), store=EstimateStore(store.pairs))
            for one in sensors
        ]
        name = "no" if sensors[0] is None else f"1 deg/h^0.5, {seeds} draws"
        yield row([noise, name, "yes" if loops else "no"], runs, (time.perf_counter() - begun) / len(runs))


def row(names: list[str], runs: list[Odometry], seconds: float) -> str:
    """Format the root mean square of the errors of runs, and the means of all else."""
    cells = []
    for one in runs:
        true = one.true_at_frames
        assert true is not None
        assert one.pose_covariances is not None
        result = {name: value for name, value, _ in one.rows()}
        each = normalised_errors(one.path, one.pose_covariances, true)
        message = 1e3 * float(np.sqrt(np.trace(one.pose_covariances[-1, :2, :2])))
        errors = (
            "end-point error",
            "end-point drift",
            "absolute error RMSE, first pose aligned",
            "heading error at the end",
        )
        counts = [result.get("loops", 0.0), result.get("loops rejected", 0.0)]
        cells.append([*counts, *(result[name] for name in errors), message, float(each.mean()), float(each[-1])])
    table = np.array(cells)
    rms = np.sqrt((table[:, 2:6] ** 2).mean(axis=0))
    loops, mean = table[:, :2].mean(axis=0), table[:, 6:].mean(axis=0)
    numbers = [f"{loops[0]:.3g}", f"{loops[1]:.3g}", f"{rms[0]:.1f}", f"{rms[1]:.3f}", f"{rms[2]:.0f}", f"{rms[3]:.2f}"]
    numbers += [f"{mean[0]:.1f}", f"{mean[1]:.2f}", f"{mean[2]:.2f}", f"{seconds:.0f}"]
    return f"| {' | '.join([*names, *numbers])} |"


if __name__ == "__main__":
    main()
