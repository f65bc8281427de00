"""Generate `seabed.ply`: a gently undulating seabed, 0.2 m from trough to crest at most, level and flat far away.

The seed is fixed, so the same bytes come out each time; `--quick` compares them with the shipped file.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from convert import save

HALF_M = 45
"""Half the edge of the part with relief, in cells of 1 m."""

FAR_M = 100.0
"""Half the edge of all."""

HEIGHT_M = 0.1
WAVES = 24
LENGTHS_M = (9.0, 30.0)
"""Wavelengths of the relief: long against the cells, so that facets lean 1 deg from their neighbours at most."""


def seabed(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices ``(n, 3)`` [m] and triangles ``(m, 3)`` that face up."""
    line = np.array([-FAR_M, *range(-HALF_M, HALF_M + 1), FAR_M])
    x, y = np.meshgrid(line, line)
    height = np.zeros(x.shape)
    for _ in range(WAVES):
        length, turn, phase = rng.uniform(*LENGTHS_M), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
        height += np.cos(2 * np.pi / length * (x * np.cos(turn) + y * np.sin(turn)) + phase)
    from_edge = np.clip((HALF_M - np.maximum(np.abs(x), np.abs(y))) / 10, 0, 1)
    height *= from_edge**2 * (3 - 2 * from_edge)
    height *= HEIGHT_M / np.abs(height).max()
    count = len(line)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    near, far = [corner, corner + 1, corner + count + 1], [corner, corner + count + 1, corner + count]
    faces = np.stack([np.column_stack(near), np.column_stack(far)], axis=1).reshape(-1, 3)
    return np.column_stack([x.ravel(), y.ravel(), height.round(4).ravel()]), faces


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
    vertices, faces = seabed(np.random.default_rng(6))
    with tempfile.TemporaryDirectory() as folder:
        result = (arguments.out or Path(folder)) / "seabed.ply"
        save(result, vertices, faces)
        if arguments.quick and result.read_bytes() != (Path(__file__).resolve().parent / "seabed.ply").read_bytes():
            raise SystemExit("seabed.ply is not what is made now: run `python seabed.py .`")
    print(f"seabed.ply: {len(faces)} faces, {vertices.min(axis=0)} to {vertices.max(axis=0)}")


if __name__ == "__main__":
    main()
