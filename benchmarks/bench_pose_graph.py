"""The pose graph at the end of a long run: seconds and memory by the number of frames.

    python benchmarks/bench_pose_graph.py [--frames 1000 3000 10000 20000]
    python benchmarks/bench_pose_graph.py --quick       # 300 and 1,200 frames

A chain of drawn motions of 20 mm with a gyroscope that has a bias; errors of motions depend on each other as in
`mitsonar odometry --sensors`. Each length runs in a process of its own. Memory is the peak of that process over what it
held before.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from mitsonar.mapping.odometry import graph_path
from mitsonar.mapping.sensors import SensorNoise, simulated_sensors
from mitsonar.mapping.series import MotionSeries, path_of
from mitsonar.motion.pose import Pose
from mitsonar.motion.sensors import VehicleSensors

LENGTHS = (1000, 3000, 10_000, 20_000)
STEP_S = 0.1
STD = np.array([1e-3, 1e-3, 5e-4])
"""Time from frame to frame, and standard deviations of an estimated motion [m, m, rad]."""

GYRO = SensorNoise(gyro_deg_rth=1.0, gyro_bias_deg_h=1.0)


def main() -> None:
    """Run each length, print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, nargs="+", default=LENGTHS, help="lengths of the chain")
    parser.add_argument("--quick", action="store_true", help="300 and 1,200 frames")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        return print(row(args.one), flush=True)
    print("| frames | s | ms a frame | MiB | standard deviation of the end, m |\n|---|---|---|---|---|", flush=True)
    for frames in (300, 1200) if args.quick else args.frames:
        subprocess.run([sys.executable, __file__, "--one", str(frames)], check=True)


def row(frames: int) -> str:
    """Solve a chain; return the row of its time and memory."""
    measured, sensors = drawn(frames)
    stored, begun = peak_mib(), time.process_time()
    result = graph_path(measured, Pose(0, 0, 2), start_known=True, sensors=sensors, search=None, source=None)
    seconds = time.process_time() - begun
    return (
        f"| {frames:,} | {seconds:.1f} | {1e3 * seconds / frames:.2f} | {peak_mib() - stored:.0f} | {result.end_std_m:.6f} |"
    )


def drawn(frames: int) -> tuple[MotionSeries, VehicleSensors]:
    """Draw the motions of a winding path, with errors, and the readings of its gyroscope."""
    yaw = np.radians(1.5) * np.sin(np.arange(frames - 1) / 40)
    moved = np.column_stack([np.zeros(frames - 1), np.full(frames - 1, 0.02), yaw])
    time_s = STEP_S * np.arange(frames, dtype=float)
    true = path_of(moved, Pose(0, 0, 2), time_s)
    errors = STD * np.random.default_rng(0).normal(size=moved.shape)
    covariances = np.tile(np.diag(STD**2), (len(moved), 1, 1))
    return MotionSeries(moved + errors, time_s, covariances), simulated_sensors(true, GYRO, seed=0)


def peak_mib() -> float:
    """Return the peak of resident memory of this process [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


if __name__ == "__main__":
    main()
