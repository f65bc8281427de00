"""Environments stepped together against single ones, within one run.

    python benchmarks/bench_environments.py [--envs 64] [--steps 10]
    python benchmarks/bench_environments.py --quick            # 8 environments, 2 steps

Frames a second of `SonarVectorEnv`, which steps all environments in one launch, and of `SonarEnv`, one step for each;
medians of the rounds, the two in turn; both count their clearance rays.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from bench_impulse import cpu

from mitsonar.bridges.gymnasium import SonarEnv, SonarVectorEnv
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar
from mitsonar.simulation.device import ensure_variant
from mitsonar.simulation.scene import load_scene
from mitsonar.simulation.simulator import Simulator

WARM = 2
"""Rounds that are not counted: Dr.Jit records a launch anew once or twice."""

START = [[-4.0, -6.0, 2.0, 0.4, 0.0, -0.5], [4.0, -4.0, 3.0, 0.5, 0.0, 0.5]]


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--quick", action="store_true", help="8 environments, 2 steps")
    arguments = parser.parse_args()
    envs, steps = (8, 2) if arguments.quick else (arguments.envs, arguments.steps)
    print(f"{cpu()}, {time.strftime('%Y-%m-%d')}, {ensure_variant()}, scene objects, {envs} environments\n")
    print("| sonar, physical, draft | together frames/s | one by one frames/s | ratio |\n|---|---|---|---|")
    small = Sonar(model="physical", beams=64, range_bins=128, range_min=1, range_max=8, quality="draft")
    didson = load_sonar("didson300").replace(model="physical", range_min=1, range_max=8, quality="draft")
    for name, sonar in (("64 beams x 128 bins", small), ("DIDSON 300", didson)):
        print(row(name, sonar, envs, steps), flush=True)


def row(name: str, sonar: Sonar, envs: int, steps: int) -> str:
    """Return a row of the table."""
    simulator = Simulator(load_scene("objects"), sonar)
    many, one = SonarVectorEnv(simulator, num_envs=envs, start=START), SonarEnv(simulator, start=START)
    many.reset(seed=0)
    one.reset(seed=0)
    action = np.zeros((envs, 4))
    took = []
    for _ in range(steps + WARM):
        begun = time.perf_counter()
        many.step(action)
        middle = time.perf_counter()
        for local in action:
            one.step(local)
        took.append((middle - begun, time.perf_counter() - middle))
    together, single = envs / np.median(took[WARM:], axis=0)
    return f"| {name} | {together:.0f} | {single:.0f} | {together / single:.1f} |"


if __name__ == "__main__":
    main()
