"""What a body that moves costs, and that nothing changes where nothing moves.

    python benchmarks/bench_moving.py [--triangles 1000000] [--pings 9]
    python benchmarks/bench_moving.py --quick            # 20,000 triangles, 3 pings

A seabed of that many triangles and a body of as many, in the models physical and coherent: milliseconds a ping where the
body is at rest in the scene, and where it moves; medians, the two in turn. A frame of eight groups too.
Then bodies whose vertices move each ping, by their triangles.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from bench_impulse import cpu
from numpy.typing import NDArray

from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.bodies import Deforming
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.simulation.device import ensure_variant
from mitsonar.simulation.simulator import Simulator

WARM = 4
"""Pings that are not counted: Dr.Jit records a launch anew once or twice."""

POSE = np.array([0, 0, 2.5, 0.61, 0, 0])
MODELS: dict[str, dict[str, object]] = {
    "physical": {"quality": "standard"},
    "coherent": {"model": "coherent", "frequency_hz": 1.8e6, "bearing": "cone", "quality": "draft"},
}


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--triangles", type=int, default=1_000_000)
    parser.add_argument("--pings", type=int, default=9)
    parser.add_argument("--quick", action="store_true", help="20,000 triangles, 3 pings")
    arguments = parser.parse_args()
    triangles, pings = (20_000, 3) if arguments.quick else (arguments.triangles, arguments.pings)
    print(f"{cpu()}, {time.strftime('%Y-%m-%d')}, {ensure_variant()}, {triangles:,} triangles still and as many that move\n")
    print("| model | still ms | moving ms | ratio | 8 ping groups ms | ratio |\n|---|---|---|---|---|---|")
    for name, changes in MODELS.items():
        print(row(name, changes, triangles, pings), flush=True)
    print("\n| triangles that deform | ms a ping | still body ms |\n|---|---|---|")
    for count in (1_000, 10_000) if arguments.quick else (1_000, 10_000, 100_000):
        print(deforming_row(count, pings), flush=True)


def row(name: str, changes: dict[str, object], triangles: int, pings: int) -> str:
    """Return a row of the table."""
    import mitsuba as mi

    sonar = Sonar.create(**changes)
    shapes = {"floor": relief(triangles, 12.0, 0), "body": relief(triangles, 0.6, 1)}
    placed = mi.load_dict({"type": "scene", **shapes}, optimize=False)
    fly = Trajectory.between(Pose(0, 4, 0.4), Pose(0.2, 4.3, 0.4), 2, 1.0)
    makers = [
        Simulator(placed, sonar),
        Simulator(placed, sonar, moving={"body": fly}),
        Simulator(placed, sonar.replace(ping_groups=8)),
    ]
    took = np.array([[ping_s(one, number) for one in makers] for number in range(pings + WARM)])[WARM:]
    still, moving, groups = np.median(took, axis=0) * 1e3
    return f"| {name} | {still:.0f} | {moving:.0f} | {moving / still:.2f} | {groups:.0f} | {groups / still:.2f} |"


def deforming_row(triangles: int, pings: int) -> str:
    """Return a row of what a body costs that deforms over a still seabed of 20,000 triangles."""
    import mitsuba as mi

    sonar = Sonar.create(**MODELS["physical"])
    body: Any = relief(triangles, 0.6, 1)
    vertex = np.array(mi.traverse(body)["vertex_positions"]).reshape(-1, 3)
    placed = mi.load_dict({"type": "scene", "floor": relief(20_000, 12.0, 0), "body": body}, optimize=False)
    here = Trajectory(np.array([[0, 4, 0.4, 0, 0, 0]], dtype=float), np.zeros(1))
    swims = Deforming(here, lambda time_s: vertex + 0.01 * np.sin(time_s))
    makers = [Simulator(placed, sonar, moving={"body": one}) for one in (swims, here)]
    took = np.array([[ping_s(one, number) for one in makers] for number in range(pings + WARM)])[WARM:]
    deforms, still = np.median(took, axis=0) * 1e3
    return f"| {triangles:,} | {deforms:.0f} | {still:.0f} |"


def ping_s(simulator: Simulator, number: int) -> float:
    """Return the seconds of one ping."""
    begun = time.perf_counter()
    next(simulator.pings(POSE, first=number, time_s=[number / 10]))
    return time.perf_counter() - begun


def relief(triangles: int, size: float, seed: int) -> object:
    """Return a square relief as a mesh."""
    import mitsuba as mi

    side = max(2, round((triangles / 2) ** 0.5) + 1)
    line = np.linspace(-size / 2, size / 2, side)
    rough = 0.02 * np.random.default_rng(seed).standard_normal((side, side))
    vertex = np.stack([*np.meshgrid(line, line, indexing="ij"), rough], -1).astype(np.float32)
    corner: NDArray[np.int64] = np.arange(side * side).reshape(side, side)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    mesh = mi.Mesh("relief", side * side, len(faces))
    values = mi.traverse(mesh)
    values["vertex_positions"], values["faces"] = vertex.ravel(), faces.ravel().astype(np.uint32)
    values.update()
    return mesh


if __name__ == "__main__":
    main()
