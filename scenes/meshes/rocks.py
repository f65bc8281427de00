"""Generate `rocks.ply` and `debris.ply`: stones strewn around the sunken ship, and rubble, planks and rods in heaps.

Needs trimesh. The seeds are fixed, so the same bytes come out each time; `--quick` compares them with the shipped files.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import trimesh
from convert import save
from scipy.spatial.transform import Rotation

COUNT = 140
HALF_EXTENT_M = 30.0
HULL_M = (9.0, 5.0)
"""Half length and half width of the ship, about, along x and y."""


def rocks(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices ``(n, 3)`` [m] and triangles ``(m, 3)``: rough balls, flattened, turned, sunk into the floor z = 0."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices, faces = [], []
    for number in range(COUNT):
        radius = min(0.12 * rng.uniform() ** -0.55, 0.8)
        rough = ball.vertices * rng.uniform(0.8, 1.2, (len(ball.vertices), 1)) * radius * rng.uniform(0.6, 1.4, 3)
        rough = rough @ trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3].T
        place = rng.uniform(-HALF_EXTENT_M, HALF_EXTENT_M, 2) if number % 2 else rng.normal(0, HULL_M)
        vertices.append(rough + np.array([*place, 0.3 * radius]))
        faces.append(ball.faces + number * len(ball.vertices))
    return np.concatenate(vertices), np.concatenate(faces)


HEAPS, PIECES = 40, 520
HEAP_M = 1.6
"""Standard deviation of the places in a heap."""

SPREAD_M = (11.0, 9.0)
"""Standard deviation of the heaps' places along x and y."""

STONE_M, LENGTH_M = (0.06, 0.5), (0.4, 3.0)
"""Smallest and largest edge of a stone, and length of a plank or rod."""


def debris(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices ``(n, 3)`` [m] and triangles ``(m, 3)``: stones, planks and rods in heaps, sunk into z = 0."""
    ball, box = trimesh.creation.icosphere(subdivisions=0), trimesh.creation.box()
    heaps = rng.normal(0, SPREAD_M, (HEAPS, 2))
    vertices, faces, count = [], [], 0
    for _ in range(PIECES):
        long = rng.uniform() < 0.3
        tilt = rng.normal(0, 0.15, 2)
        turned = Rotation.from_euler("xyz", [tilt[0], tilt[1], rng.uniform(0, 2 * np.pi)]).as_matrix()
        if long:
            length = LENGTH_M[0] * (LENGTH_M[1] / LENGTH_M[0]) ** rng.uniform() ** 2
            width, thick = length * rng.uniform(0.03, 0.15), rng.uniform(0.03, 0.1)
            body, size = box, np.array([length, width, min(width, thick)])
            points = body.vertices * size
        else:
            edge = STONE_M[0] * (STONE_M[1] / STONE_M[0]) ** rng.uniform() ** 2
            body = ball
            points = body.vertices * rng.uniform(0.7, 1.2, (len(body.vertices), 1)) * edge * rng.uniform(0.4, 0.7, 3)
        low = (points := points @ turned.T)[:, 2].min()
        place = heaps[rng.integers(HEAPS)] + rng.normal(0, HEAP_M, 2)
        points = points + np.array([*place, -low * rng.uniform(0.2, 1.0)])
        vertices.append(points)
        faces.append(body.faces + count)
        count += len(points)
    return np.concatenate(vertices), np.concatenate(faces)


MESHES = {"rocks.ply": (rocks, 5), "debris.ply": (debris, 7)}
"""What makes each file, and its seed."""


def main() -> None:
    """Write the meshes into a folder, or compare them with those that are shipped.

    Raises:
        SystemExit: one differs.
    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, nargs="?", help="folder for the PLY files")
    parser.add_argument("--quick", action="store_true", help="compare with the shipped files instead")
    arguments = parser.parse_args()
    if arguments.out is None and not arguments.quick:
        parser.error("a folder is missing: give OUT, or --quick")
    with tempfile.TemporaryDirectory() as folder:
        for name, (make, seed) in MESHES.items():
            vertices, faces = make(np.random.default_rng(seed))
            result = (arguments.out or Path(folder)) / name
            save(result, vertices, faces)
            if arguments.quick and result.read_bytes() != (Path(__file__).resolve().parent / name).read_bytes():
                raise SystemExit(f"{name} is not what is made now: run `python rocks.py .`")
            print(f"{name}: {len(faces)} faces, {vertices.min(axis=0)} to {vertices.max(axis=0)}")


if __name__ == "__main__":
    main()
