"""Scenes, plain NumPy truths and scripts of several tests. Truths are written from the formulas, not from the code."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose
from mitsonar.records.frames import SonarFrames

if TYPE_CHECKING:
    import mitsuba as mi

Array = NDArray[np.float64]

# ---------------------------------------------------------------- scenes


MitsubaDict: TypeAlias = dict[str, Any]
"""A part of a scene as Mitsuba's `load_dict` reads it."""

RecipeFields: TypeAlias = dict[str, Any]
"""Fields of a recipe, as a YAML file would hold them."""


def diffuse(reflectance: float | MitsubaDict = 0.5) -> MitsubaDict:
    """A diffuse BSDF; ``reflectance`` a number or a texture."""
    if isinstance(reflectance, int | float):
        reflectance = {"type": "uniform", "value": float(reflectance)}
    return {"type": "diffuse", "reflectance": reflectance}


def floor(bsdf: MitsubaDict | None = None, half: float = 100.0) -> MitsubaDict:
    """The plane z = 0, normal up."""
    import mitsuba as mi

    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(half), "bsdf": bsdf or diffuse()}


def plate(point: ArrayLike, normal: ArrayLike, half: float = 50.0, bsdf: MitsubaDict | None = None) -> MitsubaDict:
    """A square plate through ``point`` with that normal."""
    import mitsuba as mi

    point, normal = np.asarray(point, float), np.asarray(normal, float)
    up = [0, 0, 1] if abs(normal[2]) < 0.9 * np.linalg.norm(normal) else [0, 1, 0]
    look = mi.ScalarTransform4f().look_at(origin=point.tolist(), target=(point + normal).tolist(), up=up)
    return {"type": "rectangle", "to_world": look @ mi.ScalarTransform4f().scale(half), "bsdf": bsdf or diffuse()}


def sphere(center: ArrayLike, radius: float, bsdf: MitsubaDict | None = None) -> MitsubaDict:
    """A sphere."""
    return {"type": "sphere", "center": np.asarray(center, float).tolist(), "radius": radius, "bsdf": bsdf or diffuse()}


def box(center: ArrayLike, half: ArrayLike, bsdf: MitsubaDict | None = None) -> MitsubaDict:
    """A box along the axes, a mesh."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate(np.asarray(center, float).tolist()).scale(np.asarray(half, float).tolist())
    return {"type": "cube", "to_world": place, "bsdf": bsdf or diffuse()}


def scene(**shapes: MitsubaDict) -> mi.Scene:
    """A scene of these shapes; each is named by its key."""
    import mitsuba as mi

    loaded = mi.load_dict({"type": "scene", **shapes})
    assert isinstance(loaded, mi.Scene)
    return loaded


def separate(**shapes: MitsubaDict) -> mi.Scene:
    """A scene of these shapes, of which none are merged."""
    import mitsuba as mi

    loaded = mi.load_dict({"type": "scene", **shapes}, optimize=False)
    assert isinstance(loaded, mi.Scene)
    return loaded


def place_of(scene: mi.Scene, name: str) -> int:
    """The index of a shape in the scene, as in ``shape_id``."""
    return [shape.id() for shape in scene.shapes()].index(name)


def lit_plane(sonar: Sonar, height_m: float, pitch_rad: float, slope_deg: float = 0.0) -> tuple[SonarFrames, Array, Array]:
    """Two frames of a plane that rises forward below the sonar, bright where the fan lights it.

    Returns:
        The frames, and the heights below the sonar at which the steepest and the shallowest rays end ``(beams,)`` each.
    """
    half, bearing = np.radians(sonar.elevation_fov_deg) / 2, sonar.bearing_rad
    reach, below = [], []
    for e in (-half, half):
        forward = np.cos(bearing) * np.cos(e) * np.cos(pitch_rad) + np.sin(e) * np.sin(pitch_rad)
        down = np.cos(bearing) * np.cos(e) * np.sin(pitch_rad) - np.sin(e) * np.cos(pitch_rad)
        reach.append(height_m / (down + forward * np.tan(np.radians(slope_deg))))
        below.append(reach[-1] * down)
    grain = 0.3 + 0.7 * np.random.default_rng(1).random((sonar.range_bins, sonar.beams), dtype=np.float32)
    lit = (sonar.range_m[:, None] >= reach[0]) & (sonar.range_m[:, None] <= reach[1])
    image = np.repeat((grain * lit)[None], 2, axis=0)
    poses = np.tile([0.0, 0.0, height_m, pitch_rad, 0.0, 0.0], (2, 1))
    height = np.full(2, height_m)
    frames = SonarFrames(image, sonar.range_m, bearing, np.arange(2.0), sonar, poses=poses, height_m=height)
    return frames, below[0], below[1]


# ---------------------------------------------------------------- geometry


def axes(pose: Pose) -> tuple[Array, Array, Array]:
    """Starboard, forward and up of a pose in the world, from the conventions of poses."""
    sin_h, cos_h, sin_p, cos_p = np.sin(pose.heading), np.cos(pose.heading), np.sin(pose.pitch), np.cos(pose.pitch)
    forward = np.array([cos_p * sin_h, cos_p * cos_h, -sin_p])
    level = np.array([cos_h, -sin_h, 0.0])  # starboard before the roll
    upright = np.cross(level, forward)
    starboard = np.cos(pose.roll) * level - np.sin(pose.roll) * upright
    return starboard, forward, np.cross(starboard, forward)


def direction(sonar: Sonar, bearing: ArrayLike, elevation: ArrayLike) -> Array:
    """Directions ``(rays, 3)`` as (starboard, forward, up) of bearings and elevations [rad]."""
    b, e = np.broadcast_arrays(np.asarray(bearing, float), np.asarray(elevation, float))
    if sonar.bearing == "azimuth":
        return np.stack([np.cos(e) * np.sin(b), np.cos(e) * np.cos(b), np.sin(e)], axis=-1)
    return np.stack([np.sin(b), np.cos(b) * np.cos(e), np.cos(b) * np.sin(e)], axis=-1)


def angles(sonar: Sonar, local: ArrayLike) -> tuple[Array, Array]:
    """Bearing and elevation [rad] of directions ``(rays, 3)`` (starboard, forward, up): :func:`direction` inverted."""
    starboard, forward, up = np.asarray(local, float).T
    if sonar.bearing == "azimuth":
        return np.arctan2(starboard, forward), np.arctan2(up, np.hypot(starboard, forward))
    return np.arctan2(starboard, np.hypot(forward, up)), np.arctan2(up, forward)


def cells(sonar: Sonar) -> tuple[Array, Array]:
    """Bearing and elevation [rad] of the middle of each ray's cell, in the order of the film (row 0 highest)."""
    across = sonar.across
    offset = ((np.arange(across) + 0.5) / across - 0.5) * sonar.beam_width_rad
    bearing = (sonar.bearing_rad[:, None] + offset).ravel()
    rows = sonar.rays_per_beam
    elevation = np.radians(sonar.elevation_fov_deg) * (0.5 - (np.arange(rows) + 0.5) / rows)
    return np.tile(bearing, rows), np.repeat(elevation, len(bearing))


def world_directions(sonar: Sonar, pose: Pose, bearing: ArrayLike, elevation: ArrayLike) -> Array:
    """Directions ``(rays, 3)`` in the world."""
    return direction(sonar, bearing, elevation) @ np.array(axes(pose))


def floor_levels(
    sonar: Sonar, height: float, pitch: float, reflectivity: float, *, axis_only: bool = False, nodes: int = 8
) -> Array:
    """Levels ``(bins, beams)`` that an endless flat floor sends back, by Gauss-Legendre over width and bin.

    The floor lies ``height`` below; heading and roll are 0. ``physical``: the integral of C cos(theta) R^(g-2) over the
    bin's solid angle. ``thesis``: rays a radian of elevation times the integral of C cos(theta), averaged over the
    beam's width (jitter) or on its axis.
    """
    edges = sonar.range_min + np.arange(sonar.range_bins + 1) * sonar.bin_m
    x, weight = np.polynomial.legendre.leggauss(nodes)
    over_width, width_weight = (np.zeros(1), np.full(1, 2.0)) if axis_only else (x, weight)
    b = sonar.bearing_rad[:, None] + over_width * sonar.beam_width_rad / 2
    half = np.radians(sonar.elevation_fov_deg) / 2
    if sonar.bearing == "azimuth":  # down-going part of a ray: steep cos(e + lean)
        steep, lean = (
            np.hypot(np.cos(b) * np.sin(pitch), np.cos(pitch)),
            np.arctan2(np.cos(pitch), np.cos(b) * np.sin(pitch)),
        )
        e = np.arccos(np.clip(height / (edges[:, None, None] * steep), -1, 1)) - lean
    else:  # cos b sin(pitch - e)
        e = pitch - np.arcsin(np.clip(height / (edges[:, None, None] * np.cos(b)), -1, 1))
    e = np.clip(e, -half, half)
    middle, reach = (e[1:] + e[:-1]) / 2, (e[1:] - e[:-1]) / 2
    inner = middle[..., None] + reach[..., None] * x
    if sonar.bearing == "azimuth":
        radius = height / (steep[..., None] * np.cos(inner + lean[..., None]))
        metric = np.cos(inner)
    else:
        radius = height / (np.cos(b)[..., None] * np.sin(pitch - inner))
        metric = np.broadcast_to(np.cos(b)[..., None], inner.shape)
    value = reflectivity * height / radius
    if sonar.model == "physical":
        value = value * radius ** (sonar.gain_exponent - 2.0) * metric * sonar.beam_width_rad
    else:
        value = value * sonar.rays_per_beam / np.radians(sonar.elevation_fov_deg)
    over_bin = (value * weight).sum(-1) * reach
    return np.asarray((over_bin * width_weight).sum(-1) / 2)


def slope(x: ArrayLike, y: ArrayLike) -> float:
    """The order of a convergence: slope on log axes."""
    return float(np.polyfit(np.log(np.asarray(x, float)), np.log(np.asarray(y, float)), 1)[0])


# ---------------------------------------------------------------- checks


def assert_image_close(got: NDArray[np.floating], wanted: Array, rms: float, picture: Path) -> None:
    """Relative error below ``rms`` where ``wanted`` is not 0; a failure says by how much and leaves a picture to look at."""
    filled = wanted > 0
    relative = np.zeros(wanted.shape)
    relative[filled] = np.asarray(got, float)[filled] / wanted[filled] - 1
    error = float(np.sqrt(np.mean(relative[filled] ** 2)))
    if not error < rms:
        brightest = wanted.max()
        panels = [np.clip(panel, 0, 1) for panel in (got / brightest, wanted / brightest, 0.5 + relative / (8 * error))]
        Image.fromarray((255 * np.hstack(panels)).astype(np.uint8)).save(picture)
        worst = np.unravel_index(np.abs(relative).argmax(), relative.shape)
        raise AssertionError(
            f"relative error {error:.3e} rms, allowed {rms:.1e}; worst {relative[worst]:+.3e} at (bin, beam) {worst}; "
            f"got | wanted | difference in {picture}"
        )


BLOCK = """
import sys
class Block:
    def find_spec(name, path=None, target=None):
        if name.split(".")[0] in {names!r}:
            raise ModuleNotFoundError(f"{{name}} is blocked", name=name)
sys.meta_path.insert(0, Block)
"""


def essence(values: Iterable[Any], *quick: Any, rest: pytest.MarkDecorator = pytest.mark.thorough) -> list[Any]:
    """Values of a test's parameter, or tuples of several: all but the quick ones are marked, by default ``thorough``."""
    parts = [(value, value if isinstance(value, tuple) else (value,)) for value in values]
    return [pytest.param(*one, marks=() if value in quick else rest) for value, one in parts]


def run_python(script: str, *, block: tuple[str, ...] = (), **environment: str) -> str:
    """What a fresh interpreter, in which ``block`` cannot be imported, prints for a script; its failure is the test's."""
    script = BLOCK.format(names=block) + textwrap.dedent(script)
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env={**os.environ, **environment}, timeout=300
    )
    assert done.returncode == 0, f"exit code {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done.stdout


# ---------------------------------------------------------------- data sets

TINY: RecipeFields = {
    "name": "tiny",
    "world": {"family": "rocky-field", "size_m": 20.0, "a_side": [6, 10]},
    "scenes": [{"count": 3, "sequences": 10}],
    "sonar": {
        "preset": "didson300",
        "model": "thesis",
        "bearing": "azimuth",
        "gain_exponent": 0,
        "beams": 12,
        "rays_per_beam": 60,
        "range_bins": 40,
    },
    "mount": {"pitch_deg": 35.0},
}
"""A recipe that takes seconds: three small scenes of ten sequences."""


def tiny_recipe(**changes: Any) -> Any:
    """The tiny recipe with some keys changed; dots between levels become ``__``."""
    import copy

    from mitsonar.config.data import recipe_from

    fields = copy.deepcopy(TINY)
    for key, value in changes.items():
        *levels, last = key.split("__")
        inner = fields
        for level in levels:
            inner = inner.setdefault(level, {})
        inner[last] = value
    return recipe_from(fields)


TINY_TRAINING: dict[str, Any] = {
    "recipe": {"network": "posenet", "split": "scene"},
    "metrics": {"none": {"rmse": [3.0, 2.0, 0.1], "pairs": 50}, "high": {"rmse": [6.0, 2.0, 0.2], "pairs": 50}},
    "trained": {"pairs": 1200, "minutes": 2.5, "epochs": 3, "seed": 0},
}
"""What a checkpoint tells of a training."""


def tiny_network(seed: int = 0, **options: Any) -> Any:
    """A small network with drawn weights."""
    import torch

    from mitsonar.networks.create import create_network

    torch.manual_seed(seed)
    return create_network("posenet", **{"width": 1 / 16, "size": (40, 24), **options})


def tiny_samples(**words: Any) -> Any:
    """The samples that the tiny recipe would give; there are none."""
    from mitsonar.datasets.samples import Samples

    return Samples(tiny_recipe(), **{"labels": "normx10", "noise": "low", **words})


DOWN: RecipeFields = {
    "sonar__azimuth_fov_deg": 100.0,
    "sonar__elevation_fov_deg": 100.0,
    "sonar__range_min": 2.0,
    "sonar__range_max": 4.0,
    "mount__pitch_deg": 90.0,
}
"""Changes of the tiny recipe: a sonar that looks straight down."""


HEARD: RecipeFields = {
    "name": "received",
    "world": {"family": "flat-objects", "size_m": 16.0, "seabed_cells": 96, "rectangles": 20, "ellipses": 20},
    "scenes": [{"count": 4, "sequences": 10}],
    "channel": {"range_max": 8.0, "frequency_step_hz": 40.0, "frame_rate_hz": 40.0},
    "flight": {"height_m": 4.0, "pings": 3, "sideways_mm": 50.0, "forward_mm": 50.0, "yaw_deg": 0.4, "jump_m": None},
    "frames": 3,
    "split": {"by": "scene", "train": 0.5, "validation": 0.5},
}
"""Four small scenes of ten sequences of three pings: a second each."""


def impulse_recipe(**changes: Any) -> Any:
    """The small recipe of responses with some groups of keys changed."""
    from mitsonar.config.data import recipe_from

    groups = {
        name: {**HEARD[name], **value} if isinstance(value, dict) and name in HEARD else value
        for name, value in changes.items()
    }
    return recipe_from({**HEARD, **groups})


def files_of(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# ---------------------------------------------------------------- commands


class Done(NamedTuple):
    """What a command came to."""

    returncode: int
    stdout: str
    stderr: str


Command = Callable[..., Done]

PROGRAM = (sys.executable, "-m", "mitsonar")
"""What a command begins with in a process of its own."""


def refused(done: Done, *words: str) -> None:
    """One sentence, exit code 2, no traceback, and these words in it."""
    assert done.returncode == 2, done
    assert "Traceback" not in done.stderr + done.stdout, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, done.stderr
    for word in words:
        assert word in lines[0], lines[0]


def by_itself(*arguments: object, cwd: Path | None = None, **environment: str) -> Done:
    """The command line in a process of its own."""
    command, env = [*PROGRAM, *map(str, arguments)], {**os.environ, **environment}
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=env, timeout=300)
    return Done(done.returncode, done.stdout, done.stderr)
