"""Derivatives of expected images by the pose of the sonar, against central differences, in ten scenes with occlusion.

The derivatives are those of a sum of all levels with weights that vary over range and beams. A difference between two poses
is the mean of the derivative along the way from one to the other. Both are compared over a step that is long against the
cells of the rays, whose noise falls with its length, and without an error of truncation: the derivative is averaged over
places that divide the step evenly. Errors are in % of the gradient, for places and angles together (an angle counts as a
place at the range of the scene). Differences are means over draws of the jitter, whose spread gives their standard error.

    python benchmarks/bench_gradients.py [--draws 24] [--places 6] [--edge-points 200000] [--scene "hills and a ball"]
    python benchmarks/bench_gradients.py --quick    # one scene, two draws
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
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

STEP_M = 0.03
"""Half the step of the differences [m], or at that range."""

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
    parser.add_argument("--places", type=int, default=6, help="places on each step where the derivative is computed")
    parser.add_argument("--edge-points", type=int, default=200_000)
    parser.add_argument("--scene", choices=SOLIDS, help="one scene instead of all")
    parser.add_argument("--quick", action="store_true", help="one scene, two draws")
    arguments = parser.parse_args()
    names = [arguments.scene] if arguments.scene else list(SOLIDS)
    if arguments.quick:
        arguments.draws, arguments.places, arguments.edge_points, names = 2, 1, 20_000, names[:1]
    ensure_variant()
    print("scene: error of rays alone, with edges; standard error of the differences [% of the gradient]; s a gradient")
    worst = []
    for name in names:
        scene = built(SOLIDS[name]())
        truth, spread = differences(scene, arguments.draws)
        size = np.linalg.norm(truth)
        alone, _ = gradient(scene, 0, 1)
        whole, seconds = gradient(scene, arguments.edge_points, arguments.places)
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


def moved_pose(number: int, step: float) -> list[float]:
    """Return the pose with one of its numbers changed by a step [m], or at the range of the scene."""
    pose = np.array(POSE, dtype=float)
    pose[number] += step / scales()[number]
    return [float(value) for value in pose]


def gradient(scene: mi.Scene, edge_points: int, places: int) -> tuple[Array, float]:
    """Return the gradient by x, y, z, pitch, roll, heading, per metre: its mean along the step of each; and seconds each."""
    import drjit as dr
    import mitsuba as mi

    simulator = mitsonar.DifferentiableSimulator(scene, edge_points=edge_points)
    weight = mi.TensorXf(weights().astype(np.float32))
    total, begin = np.zeros(6), time.perf_counter()
    for number in range(6):
        for place in range(places):
            pose = [mi.Float(value) for value in moved_pose(number, STEP_M * ((2 * place + 1) / places - 1))]
            dr.enable_grad(pose)
            dr.backward(dr.sum(simulator.levels(pose, ping=number * places + place) * weight))
            total[number] += float(dr.grad(pose[number])[0]) / places
    return total / scales(), (time.perf_counter() - begin) / (6 * places)


def differences(scene: mi.Scene, draws: int) -> tuple[Array, Array]:
    """Return differences over the steps per metre, and their standard errors."""
    simulator = mitsonar.DifferentiableSimulator(scene, edge_points=0)

    def total(pose: list[float], ping: int) -> float:
        return float((np.array(simulator.levels(pose, ping=ping), dtype=float) * weights()).sum())

    def slope(number: int, ping: int) -> float:
        return (total(moved_pose(number, STEP_M), ping) - total(moved_pose(number, -STEP_M), ping)) / (2 * STEP_M)

    table = np.array([[slope(number, 100 + draw) for number in range(6)] for draw in range(draws)])
    return table.mean(axis=0), table.std(axis=0, ddof=1) / np.sqrt(draws)


if __name__ == "__main__":
    main()
