"""Derivatives of expected images by the pose of the sonar, against central differences, in ten scenes with occlusion.

The derivatives are those of a sum of all levels with weights that vary over range and beams. Errors are in % of the
gradient, for places and angles together (an angle counts as a place at the range of the scene). Differences are means over
draws of the jitter, whose spread gives their standard error.

    python benchmarks/bench_gradients.py [--draws 24] [--edge-points 200000]
    python benchmarks/bench_gradients.py --quick    # one scene, two draws
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import mitsonar
from mitsonar.motion.pose import Pose
from mitsonar.simulation.device import ensure_variant

if TYPE_CHECKING:
    import mitsuba as mi

POSE = Pose(0, -3, 2.0, 0.6)
RANGE_M = 3.5
"""Range at which an angle counts as much as a place [m]."""

STEP_M = 5e-3
CENTRE = (0.2, -0.3, 0.35)

Array = NDArray[np.float64]
Solid = Callable[[], list[trimesh.Trimesh]]


def ground(relief_m: float, rough_m: float = 0.15) -> trimesh.Trimesh:
    """Return a floor of 6 x 6 m whose heights vary by a standard deviation over a distance."""
    steps = 76
    height = gaussian_filter(np.random.default_rng(3).normal(size=(steps, steps)), rough_m / 6 * steps)
    height *= relief_m / height.std()
    x, y = np.meshgrid(np.linspace(-3, 3, steps), np.linspace(-3, 3, steps), indexing="ij")
    index = np.arange(steps * steps).reshape(steps, steps)
    corners = [index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]]
    facets = np.concatenate([np.stack([corners[k] for k in trio], -1).reshape(-1, 3) for trio in ((0, 1, 2), (0, 2, 3))])
    return trimesh.Trimesh(np.stack([x, y, height], -1).reshape(-1, 3), facets, process=False)


def moved(mesh: trimesh.Trimesh, place: tuple[float, ...], turn: float = 0.0) -> trimesh.Trimesh:
    """Return a mesh at a place, turned about an oblique axis [rad]."""
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec(turn * np.array([1, 2, 3]) / np.sqrt(14)).as_matrix()
    mesh.apply_transform(turned)
    mesh.apply_translation(place)
    return mesh


def box(place: tuple[float, ...], size: tuple[float, ...], turn: float = 0.0) -> trimesh.Trimesh:
    """Return a box at a place."""
    return moved(trimesh.creation.box(size), place, turn)


def ball(place: tuple[float, ...], radius: float = 0.2) -> trimesh.Trimesh:
    """Return a ball of 320 facets."""
    return moved(trimesh.creation.icosphere(subdivisions=2, radius=radius), place)


BOX = (0.4, 0.1, 0.4)
FLAT = [ground(1e-9)]
SOLIDS: dict[str, Solid] = {
    "cube above a floor": lambda: [*FLAT, box(CENTRE, (0.25,) * 3, 0.7)],
    "ball above a floor": lambda: [*FLAT, ball(CENTRE)],
    "ball half in the floor": lambda: [*FLAT, ball((0.2, -0.3, 0.0))],
    "cube cut by the floor": lambda: [*FLAT, box((0.2, -0.3, 0.05), (0.3,) * 3, 0.7)],
    "three boxes one behind another": lambda: [
        *FLAT,
        *(box((0.1 * k, 0.4 * k - 0.7, 0.1), (0.4, 0.1, 0.4)) for k in range(3)),
    ],
    "a gate of poles": lambda: [*FLAT, *(box((x, -0.2, 0.4), (0.06, 0.06, 0.9), 0.05) for x in (-0.3, 0.0, 0.3))],
    "hills of 2 cm": lambda: [ground(0.02)],
    "hills of 10 cm": lambda: [ground(0.1, 0.3)],
    "hills and a ball": lambda: [ground(0.05, 0.3), ball(CENTRE)],
    "steep hills and a box": lambda: [ground(0.08), box((0.1, 0.0, 0.3), (0.5, 0.2, 0.3), 0.2)],
}


def main() -> None:
    """Print a row for each scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=24, help="draws of the jitter")
    parser.add_argument("--edge-points", type=int, default=200_000)
    parser.add_argument("--quick", action="store_true", help="one scene, two draws")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.draws, arguments.edge_points = 2, 20_000
    ensure_variant()
    print("scene: error of rays alone, with edges; standard error of the differences [% of the gradient]; s a gradient")
    worst = []
    for name, solid in list(SOLIDS.items())[: 1 if arguments.quick else None]:
        scene = built(solid())
        truth, spread = differences(scene, arguments.draws)
        size = np.linalg.norm(truth)
        alone = gradient(scene, 0, 1)
        begin = time.perf_counter()
        whole = gradient(scene, arguments.edge_points, 4)
        seconds = (time.perf_counter() - begin) / 4
        errors = [100 * np.linalg.norm(one - truth) / size for one in (alone, whole)]
        worst.append(errors[1])
        print(
            f"{name}: {errors[0]:.1f}, {errors[1]:.2f}; {100 * np.linalg.norm(spread) / size:.2f}; {seconds:.2f}", flush=True
        )
    print(f"mean error with edges {np.mean(worst):.2f} %, largest {np.max(worst):.2f} %")


def built(meshes: list[trimesh.Trimesh]) -> mi.Scene:
    """Return a scene of meshes under a sonar of 24 beams."""
    import mitsuba as mi

    instrument = {"type": "imaging_sonar", "beams": 24, "range_min": 2.0, "range_max": 5.5, "range_bins": 96,
                  "gain_exponent": 2, "rays_per_beam": 600, "rays_across": 24}  # fmt: skip
    scene: dict[str, Any] = {"type": "scene", "sonar": instrument}
    with tempfile.TemporaryDirectory() as folder:
        for number, mesh in enumerate(meshes):
            path = Path(folder) / f"{number}.ply"
            mesh.export(path)
            bsdf = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.4 + 0.4 * (number > 0)}}
            scene[f"shape{number}"] = {"type": "ply", "filename": str(path), "face_normals": True, "bsdf": bsdf}
        loaded = mi.load_dict(scene, optimize=False)
    assert isinstance(loaded, mi.Scene)
    return loaded


def weights() -> Array:
    """Return the weights of bins and beams."""
    bins = np.arange(96)[:, None] / 96
    return (np.sin(5 * bins) + 1) * np.linspace(0.5, 1.5, 24)


def scales() -> Array:
    """Return how far a unit of each number of a pose moves the picture [m]."""
    return np.array([1.0] * 3 + [RANGE_M] * 3)


def gradient(scene: mi.Scene, edge_points: int, draws: int) -> Array:
    """Return the gradient by x, y, z, pitch, roll, heading, per metre: the mean over draws."""
    import drjit as dr
    import mitsuba as mi

    simulator = mitsonar.DifferentiableSimulator(scene, edge_points=edge_points)
    weight = mi.TensorXf(weights().astype(np.float32))
    total = np.zeros(6)
    for draw in range(draws):
        pose = [mi.Float(value) for value in POSE]
        dr.enable_grad(pose)
        dr.backward(dr.sum(simulator.levels(pose, ping=draw) * weight))
        total += [float(dr.grad(value)[0]) for value in pose]
    return np.asarray(total / draws / scales(), dtype=np.float64)


def differences(scene: mi.Scene, draws: int) -> tuple[Array, Array]:
    """Return central differences per metre, and their standard errors."""
    simulator = mitsonar.DifferentiableSimulator(scene, edge_points=0)

    def slopes() -> Iterator[list[float]]:
        for draw in range(draws):
            row = []
            for number, scale in enumerate(scales()):
                ends = []
                for side in (1, -1):
                    pose = np.array(POSE, dtype=float)
                    pose[number] += side * STEP_M / scale
                    levels = np.array(simulator.levels(pose.tolist(), ping=100 + draw), dtype=float)
                    ends.append(float((levels * weights()).sum()))
                row.append((ends[0] - ends[1]) / (2 * STEP_M))
            yield row

    table = np.array(list(slopes()))
    return table.mean(axis=0), table.std(axis=0, ddof=1) / np.sqrt(draws)


if __name__ == "__main__":
    main()
