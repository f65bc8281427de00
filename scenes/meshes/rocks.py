"""Generate `rocks.ply`: stones strewn over the seabed around the sunken ship, half of them near its hull.

Needs trimesh. The seed is fixed, so the same bytes come out each time; `--quick` compares them with the shipped file.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import trimesh
from convert import save

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


def main() -> None:
    """Write the mesh into a folder, or compare it with the one that is shipped.

    Raises:
        SystemExit: it differs.
    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, nargs="?", help="folder for the PLY file")
    parser.add_argument("--quick", action="store_true", help="compare with the shipped file instead")
    arguments = parser.parse_args()
    if arguments.out is None and not arguments.quick:
        parser.error("a folder is missing: give OUT, or --quick")
    vertices, faces = rocks(np.random.default_rng(5))
    with tempfile.TemporaryDirectory() as folder:
        result = (arguments.out or Path(folder)) / "rocks.ply"
        save(result, vertices, faces)
        if arguments.quick and result.read_bytes() != (Path(__file__).resolve().parent / "rocks.ply").read_bytes():
            raise SystemExit("rocks.ply is not what is made now: run `python rocks.py .`")
    print(f"rocks.ply: {len(faces)} faces, {vertices.min(axis=0)} to {vertices.max(axis=0)}")


if __name__ == "__main__":
    main()
