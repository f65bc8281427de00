"""Convert the COLLADA meshes of Field-Robotics-Lab/dave into the plain binary PLY files of the shipped scenes.

Needs trimesh, pycollada and lxml. Only the container changes: scene-graph transforms are applied (metres, z up),
identical vertices are merged, degenerate faces are dropped, and colours, normals and texture coordinates are left out.
"""

import argparse
from pathlib import Path

import numpy as np
import trimesh

SOURCES: dict[str, str] = {
    "sunken_ship.ply": "sunkenship_distort.dae",
    "observatory.ply": "mbari_mars.dae",
    "torpedo.ply": "torpedo_mk46.dae",
    "uxo.ply": "uxo_c.dae",
    "amphora.ply": "Pot01_distort.dae",
}


def load(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the float32 vertices and int32 triangles of a COLLADA file, merged and without degenerate faces."""
    mesh = trimesh.load_scene(path).to_mesh()
    vertices, inverse = np.unique(mesh.vertices.astype("<f4"), axis=0, return_inverse=True)
    faces = inverse.reshape(-1)[mesh.faces]
    a, b, c = np.moveaxis(vertices[faces].astype(np.float64), 1, 0)
    faces = faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0.0]
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3).astype("<i4")


def save(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write a binary little-endian PLY with vertices and triangles only."""
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    rows["count"], rows["index"] = 3, faces
    coordinates = "".join(f"property float {axis}\n" for axis in "xyz")
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{coordinates}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode("ascii") + vertices.astype("<f4").tobytes() + rows.tobytes())


def main() -> None:
    """Convert every mesh of the shipped scenes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path, help="folder with the COLLADA files")
    parser.add_argument("out", type=Path, help="folder for the PLY files")
    arguments = parser.parse_args()
    for name, source in SOURCES.items():
        vertices, faces = load(arguments.source / source)
        save(arguments.out / name, vertices, faces)
        print(f"{name}: {len(faces)} faces, {vertices.min(axis=0)} to {vertices.max(axis=0)}")


if __name__ == "__main__":
    main()
