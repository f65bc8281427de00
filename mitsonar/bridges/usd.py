"""How a USD stage is read: its prims are read in a separate process, which damaged files may end."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.bridges.model_files import Body, Matrix, ModelSearch, ReadScene, Shapes, placed, primitive
from mitsonar.errors import MitsonarError, missing_package_error
from mitsonar.io.files import PlainValue
from mitsonar.worlds.meshes import LUMINANCE, UNCOLOURED, UP, Piece

__all__ = ["read_usd"]

TIMEOUT_S = 600
"""Longest time for reading a stage [s]."""


def read_usd(path: Path, search: ModelSearch, shapes: Shapes, collision: bool = False) -> ReadScene:
    """Read the meshes and primitives of a USD stage at its first time, with z upwards, in m.

    Args:
        path: ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.
        search: search with the folders that its layers must lie in.
        shapes: reader of geometries.
        collision: whether to read the collision prims instead of the visible ones.

    Raises:
        MitsonarError: the stage is damaged, has layers outside the folders, or usd-core is not installed.
    """
    if find_spec("pxr") is None:
        raise missing_package_error(ModuleNotFoundError(name="pxr"))
    report, arrays = _read_in_subprocess(path, search, collision)
    metres, up = report["metres"], report["up"]
    if not (np.isfinite(metres) and 1e-9 <= metres <= 1e9) or up not in UP:
        raise MitsonarError(f"{path}: metersPerUnit must lie in 1e-9..1e9 and upAxis be X, Y or Z: got {metres:g}, {up}")
    # Frames and geometries have z upwards: `to_world` leads from the stage's axes and units to the world, and `to_stage`
    # from axes with z upwards to those of the stage.
    to_world = np.eye(4)
    to_world[:3, :3] = np.asarray(UP[up], dtype=float) * metres
    scene = ReadScene(left_out={str(kind): int(count) for kind, count in report["left_out"].items()})
    to_stage = placed(np.zeros(3))
    to_stage[:3, :3] = np.asarray(UP[up], dtype=float).T
    scene.frames = {
        name: _finite(path, name, to_world @ np.array(matrix) @ to_stage) for name, matrix in report["frames"].items()
    }
    for number, body in enumerate(report["bodies"]):
        name = body["path"]
        body_arrays = {key.partition(":")[2]: value for key, value in arrays.items() if key.startswith(f"{number}:")}
        piece = _piece(path, body, body_arrays, shapes)
        if len(piece.faces):
            upright = piece.moved(to_stage[:3, :3].T, np.zeros(3))  # to axes with z upwards
            parents = [str(parent) for parent in Path(name).parents][-2::-1]
            scene.bodies.append(Body(name, scene.frames[name], shapes.count_noun([upright], str(path)), tuple(parents)))
    return scene


def _read_in_subprocess(path: Path, search: ModelSearch, collision: bool) -> tuple[PlainValue, dict[str, NDArray[Any]]]:
    """Read a stage in another process; return its report on the prims, and their arrays, keyed by name."""
    if not os.path.isfile(path):
        raise MitsonarError(f"no such file: {path}")
    request = {"path": str(path.resolve()), "roots": [str(root) for root in search.roots], "collision": collision}
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PXR_", "USD_"))}
    with tempfile.TemporaryDirectory() as folder:
        # -P: do not import modules from the current folder, which may be that of an untrusted scene
        command = [sys.executable, "-P", "-m", "mitsonar.bridges.usd_reading", f"{folder}/prims.npz"]
        try:
            process = subprocess.run(
                command, input=json.dumps(request).encode(), capture_output=True, timeout=TIMEOUT_S, env=environment
            )
        except subprocess.TimeoutExpired:
            raise MitsonarError(f"cannot read {path}: it takes more than {TIMEOUT_S} s; give a smaller stage") from None
        try:
            report = json.loads(process.stdout)
        except ValueError:
            raise MitsonarError(f"cannot read {path}: the USD reader crashed; export the stage again") from None
        if "error" in report:
            raise MitsonarError(f"cannot read {path}: {report['error']}")
        with np.load(f"{folder}/prims.npz", allow_pickle=False) as arrays:
            return report, dict(arrays)


def _finite(path: Path, name: str, matrix: Matrix) -> Matrix:
    """Return the pose of a prim, after checking that its numbers are finite and not too large.

    Raises:
        MitsonarError: a number is not finite, or too large.
    """
    if not np.isfinite(matrix).all() or not np.abs(matrix).max() <= 1e9:
        raise MitsonarError(f"{path}: the pose of the prim {name[:80]} is not finite, or too large; export the stage again")
    return matrix


def _piece(path: Path, body: PlainValue, arrays: dict[str, NDArray[Any]], shapes: Shapes) -> Piece:
    """Return the geometry of a prim, in the axes and units of the prim."""
    if body["kind"] != "mesh":
        piece = primitive(body["kind"], body["sizes"], UNCOLOURED, f"{path}, {body['path'][:80]}")
        piece = piece.moved(np.asarray(UP[body["axis"]], dtype=float).T, np.zeros(3))
        uniform_colour = np.nan if body["colour"] is None else np.array(body["colour"])
        colours = np.broadcast_to(uniform_colour, (len(piece.faces), 3))
    else:
        piece = Piece(arrays["vertices"], arrays["faces"])
        colours = arrays.get("colours", np.full((len(piece.faces), 3), np.nan))
    if not isinstance(shapes.value, str):
        return piece.uniform(float(shapes.value))
    linear = np.clip(colours, 0, 1)
    value = linear[:, 0] if shapes.value == "red" else linear @ LUMINANCE
    return Piece(piece.vertices, piece.faces, np.where(np.isnan(value), UNCOLOURED, value))
