"""Height maps: errors on rocky fields and on a mesh of a real object, with speckle, and those of trivial answers.

    python benchmarks/bench_heights.py [--seeds 1,2,3] [--out heights.json] [--picture docs/gallery/heights.png]

A DIDSON 300, model `coherent`, looks from 1.5 m above the ground at a pitch of 20 deg: at rocks of 0.1 to 0.6 m that rest
in the seabed, whose reflectivity is random (one value per 20 mm cell and per face of a rock), and at a piece of unexploded
ordnance (`scenes/meshes/uxo.ply`, not made here) on an even floor. *plane*: level ground at the known height. *shadows*:
heights from the lengths of shadows, in each cell the mean of the frames that have one there. *centre*: cells within 1.3 m
of the middle, which all frames see. Processor seconds are of the fit alone. `--quick` fits one small map.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
import warnings
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

import mitsonar
from mitsonar.mapping.height_map import HeightMap, HeightMapOptions, fit_height_map, views_of
from mitsonar.mapping.shadows import joined_shadow_heights
from mitsonar.plotting.figures import height_map_figure, save_figure
from mitsonar.simulation.device import ensure_variant
from mitsonar.worlds.families import create_family

if TYPE_CHECKING:
    import mitsuba as mi

Array = NDArray[np.float64]

HEIGHT_M, PITCH_DEG, AWAY_M = 1.5, 20.0, 4.2
"""Of the sonar over level ground, and its horizontal distance from the middle of the map."""

ROCKS_A_SIDE, FIELD_M = 14, 20.0
"""Rocks of each of three kinds along the edge of the field."""

CENTRE_M = 1.3
MESH = Path(str(files("mitsonar.scenes"))) / "meshes" / "uxo.ply"
SAMPLES = 4
"""Samples of the true height along the edge of a cell."""


class Case(NamedTuple):
    """One map: the scene, its seed, and the number of frames around it."""

    scene: str
    seed: int
    frames: int


class Result(NamedTuple):
    """True and estimated maps, and the processor time of the fit."""

    estimate: HeightMap
    true: Array
    shadows: Array
    seconds: float


def main() -> None:
    """Print a table with a row for each map."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1,2,3", help="seeds of the rocky fields")
    parser.add_argument("--out", type=Path, help="JSON file of the rows")
    parser.add_argument("--picture", type=Path, help="picture of the last rocky field and of the mesh")
    parser.add_argument("--quick", action="store_true", help="one small map: within a minute")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    seeds = [int(seed) for seed in arguments.seeds.split(",")]
    cases = [Case("rocks", seed, frames) for frames in (1, 4) for seed in seeds] + [Case("mesh", 0, 1), Case("mesh", 0, 4)]
    if arguments.quick:
        cases = [Case("rocks", 1, 1)]
    print("| " + " | ".join(COLUMNS) + " |\n" + "|---" * len(COLUMNS) + "|")
    rows, shown = [], {}
    for case in cases:
        shown[case.scene, case.frames] = result = measure(case, 24 if arguments.quick else 64)
        rows.append(row_of(case, result))
        print("| " + " | ".join(f"{value}" for value in rows[-1].values()) + " |", flush=True)
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(rows, indent=1) + "\n")
    if arguments.picture is not None:
        draw(arguments.picture, shown["rocks", 4])
        draw(arguments.picture.with_stem(arguments.picture.stem + "_one_frame"), shown["rocks", 1])
        draw(arguments.picture.with_stem(arguments.picture.stem + "_mesh"), shown["mesh", 1])


COLUMNS = (
    "scene",
    "frames",
    "plane, cm",
    "shadows",
    "map",
    "bias",
    "centre: plane",
    "shadows",
    "map",
    "within 2 std, %",
    "cpu, s",
)


def measure(case: Case, cells: int) -> Result:
    """Render the frames of a case, fit the map, and look up the truth."""
    ensure_variant()
    scene = mesh_scene() if case.scene == "mesh" else rocky_scene(case.seed)
    sonar = mitsonar.load_sonar("didson300").replace(range_min=2.5, range_max=6.5)
    turns = np.arange(case.frames) * 2 * math.pi / case.frames
    pitch = math.radians(PITCH_DEG)
    poses = np.array([[-AWAY_M * math.sin(t), -AWAY_M * math.cos(t), HEIGHT_M, pitch, 0, t] for t in turns])
    frames = mitsonar.Simulator(scene, sonar).render(poses)
    height_m, options = np.full(case.frames, HEIGHT_M), HeightMapOptions(cells)
    begun = time.process_time()
    estimate = fit_height_map(frames, poses, height_m, options)
    seconds = time.process_time() - begun
    views, levels = views_of(frames, poses, height_m, options)
    shadows = joined_shadow_heights(views, levels, estimate.reflectivity)
    return Result(estimate, true_heights(scene, estimate), shadows[::-1], seconds)


def rocky_scene(seed: int) -> mi.Scene:
    """Build a field of rocks that rest in the seabed; those of the family hover up to 0.45 m above it."""
    sides = dict.fromkeys(("cubes_a_side", "cylinders_a_side", "capsules_a_side"), ROCKS_A_SIDE)
    family = create_family(
        "rocky-field", size_m=FIELD_M, centre_height_m=(0.0, 0.05), rock_size_m=(0.1, 0.6), seabed_cells=1024, **sides
    )
    with tempfile.TemporaryDirectory() as folder:
        return mitsonar.load_scene(family.build(seed).write(Path(folder) / "world"))


def mesh_scene() -> mi.Scene:
    """Lay the mesh on an even floor, turned by 30 deg."""
    import mitsuba as mi
    import trimesh

    bottom = float(trimesh.load_mesh(MESH).bounds[0, 2])
    turned = mi.ScalarTransform4f().rotate([0, 0, 1], 30) @ mi.ScalarTransform4f().translate([0, 0, -bottom])
    grey = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.3}}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(10), "bsdf": {"type": "twosided", "inner": grey}}
    body = {"type": "ply", "filename": str(MESH), "face_normals": True, "to_world": turned}
    scene: mi.Scene = mi.load_dict(
        {"type": "scene", "floor": floor, "body": {**body, "bsdf": {"type": "twosided", "inner": grey}}}
    )
    return scene


def true_heights(scene: mi.Scene, estimate: HeightMap) -> Array:
    """Measure the mean height of the scene in each cell, by rays from above."""
    import mitsuba as mi

    west, east, south, north = estimate.extent
    count = len(estimate.height_m) * SAMPLES
    steps = (np.arange(count) + 0.5) / count
    x, y = np.meshgrid(west + steps * (east - west), north - steps * (north - south))
    origin = mi.Point3f(mi.Float(x.ravel()), mi.Float(y.ravel()), mi.Float(np.full(x.size, 20.0)))
    hit = scene.ray_intersect_preliminary(mi.Ray3f(origin, mi.Vector3f(0, 0, -1)))
    heights = 20 - np.array(hit.t, dtype=float).reshape(len(estimate.height_m), SAMPLES, -1, SAMPLES)
    return np.asarray(heights.mean(axis=(1, 3)))


def row_of(case: Case, result: Result) -> dict[str, object]:
    """Return errors in cm, by name."""
    estimate, true = result.estimate, result.true
    seen = np.isfinite(estimate.height_m)
    centre = seen & (np.hypot(*estimate.centres) < CENTRE_M)
    maps = {"plane": np.full_like(true, estimate.ground_m), "shadows": result.shadows, "map": estimate.height_m}

    def rmse(values: Array, cells: NDArray[np.bool_]) -> str:
        return f"{100 * np.sqrt(np.mean(np.square(values - true)[cells])):.1f}"

    error = (estimate.height_m - true)[seen]
    return {
        "scene": f"{case.scene} {case.seed}" if case.scene == "rocks" else case.scene,
        "frames": case.frames,
        **{name: rmse(values, seen) for name, values in maps.items()},
        "bias": f"{100 * error.mean():+.1f}",
        **{f"centre {name}": rmse(values, centre) for name, values in maps.items()},
        "within": f"{100 * np.mean(np.abs(error) < 2 * estimate.std_m[seen]):.0f}",
        "seconds": f"{result.seconds:.0f}",
    }


def draw(path: Path, result: Result) -> None:
    """Draw the true heights, the estimated ones and their standard deviation."""
    estimate = result.estimate
    true = np.where(np.isfinite(estimate.height_m), result.true, np.nan)
    maps = {"true height": true, "estimated height": estimate.height_m, "standard deviation": estimate.std_m}
    frames = "one frame" if estimate.frames == 1 else f"{estimate.frames} frames"
    save_figure(path, height_map_figure(estimate.extent, maps, title=f"heights from {frames} with speckle"), dpi=100)


if __name__ == "__main__":
    main()
