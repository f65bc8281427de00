"""Convert the COLLADA meshes of Field-Robotics-Lab/dave into the plain binary PLY files of the shipped scenes.

Needs trimesh, pycollada and lxml. Only the container changes: scene-graph transforms are applied (metres, z up),
identical vertices are merged, degenerate faces are dropped, and colours, normals and texture coordinates are left out.
`--quick` converts a box of its own there and back.
"""

import argparse
import tempfile
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
    """Convert every mesh of the shipped scenes, or a box."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path, nargs="?", help="folder with the COLLADA files")
    parser.add_argument("out", type=Path, nargs="?", help="folder for the PLY files")
    parser.add_argument("--quick", action="store_true", help="convert a box instead, and compare")
    arguments = parser.parse_args()
    if arguments.quick:
        return convert_box()
    if arguments.out is None:
        parser.error("folders are missing: give SOURCE and OUT, or --quick")
    for name, source in SOURCES.items():
        vertices, faces = load(arguments.source / source)
        save(arguments.out / name, vertices, faces)
        print(f"{name}: {len(faces)} faces, {vertices.min(axis=0)} to {vertices.max(axis=0)}")


def convert_box() -> None:
    """Convert a box from COLLADA to PLY.

    Raises:
        SystemExit: it is no longer the same box.
    """
    box = trimesh.creation.box((1, 2, 3))
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder, "box.dae"), Path(folder, "box.ply")
        source.write_bytes(trimesh.exchange.dae.export_collada(box))  # type: ignore[no-untyped-call]  # trimesh has no types here
        save(result, *load(source))
        back = trimesh.load_mesh(result)
    if back.faces.shape != (12, 3) or not np.allclose(back.bounds, box.bounds) or not np.isclose(back.volume, 6):
        raise SystemExit(f"a box of 12 faces and 6 m3 came back as {len(back.faces)} faces and {back.volume:g} m3")
    print("box.ply: 12 faces, 6 m3, as it went in")


if __name__ == "__main__":
    main()
