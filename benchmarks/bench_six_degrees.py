"""Six degrees of freedom: what instruments can observe over three seabeds, and how near `direct6` comes to the bound.

    python benchmarks/bench_six_degrees.py [--only bounds,direct6] [--frames 10] [--json FILE]

*bounds*: the Cramer-Rao bound of two noisy frames of a known scene, of one fan, two crossed fans, a 3-D sonar, a fan in
speckle, and of hydrophones over level ground of unknown scatterers. *direct6*: frames with noise, from poses that are off by
10 mm and 0.5 deg (standard deviations): root mean square errors over the bound of one frame and the assumed pose, and the
normalised squared error (1 is consistent). Frames are means of 64 pings, whose rays have hardly any noise. `--quick` takes
coarse sonars, and one frame.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rocky_seabed import Seabed, rocky_seabed
from scipy import ndimage

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.estimation.crlb.channel import channel_bound
from mitsonar.estimation.crlb.image import Bound, SpeckleBounds, bounds_at
from mitsonar.estimation.crlb.observability import bounds_of_fans, observability
from mitsonar.estimation.image.direct6 import Direct6
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import Sounder, load_sonar
from mitsonar.io.files import write_atomic
from mitsonar.motion.composition import DEGREES, MotionStd, compose_six, six_between
from mitsonar.motion.pose import Pose
from mitsonar.records.frames import to_uint8
from mitsonar.simulation.device import ensure_variant
from mitsonar.simulation.pings import CALIBRATION_FRAMES, constant_gain
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

Array = NDArray[np.float64]

SIZE_M = 16.0
NAMES = tuple(DEGREES)
UNITS = np.array([1e3] * 3 + [np.degrees(1)] * 3)
LOW = NOISE_MODELS["low"]
POSE = Pose.from_degrees([-2.0, -3.0, 2.5, 35, 0, 20])
VEHICLE = Pose.from_degrees([-2.0, -3.0, 2.5, 0, 0, 20])
MEAN_OF = 64
START = MotionStd(0.01, float(np.radians(0.5)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="bounds,direct6", help="parts, separated by commas")
    parser.add_argument("--frames", type=int, default=10, help="frames of direct6 over each seabed")
    parser.add_argument("--json", type=Path, help="file to write the rows to")
    parser.add_argument("--quick", action="store_true", help="coarse sonars, and one frame: within a minute")
    arguments = parser.parse_args()
    ensure_variant()
    seabeds = {"even": even(), "gravel": gravel(), "rocks": rocks(), "rocks, relief": relief()}
    tables: dict[str, list[list[str]]] = {}
    if "bounds" in arguments.only:
        tables["bounds"] = []
        for row in bound_rows(seabeds, arguments.quick):
            tables["bounds"].append(row)
            print(" | ".join(row), flush=True)
    if "direct6" in arguments.only:
        tables["direct6"] = []
        for name in ["gravel"] if arguments.quick else list(seabeds)[1:]:
            tables["direct6"].append(direct6_row(name, seabeds[name], 1 if arguments.quick else arguments.frames))
            print(" | ".join(tables["direct6"][-1]), flush=True)
    if arguments.json:
        write_atomic(arguments.json, json.dumps(tables, indent=1).encode())


# ---------------- Seabeds


def even() -> mi.Scene:
    """Return a level floor of one reflectivity."""
    return plane({"type": "rgb", "value": 0.4})


def gravel() -> mi.Scene:
    """Return a level floor of smooth blotches of some 50 mm."""
    import mitsuba as mi

    picture = mi.Bitmap(blotches(800).astype(np.float32)[..., None])
    return plane({"type": "bitmap", "bitmap": picture, "raw": True, "filter_type": "bilinear"})


def plane(reflectance: dict[str, Any]) -> mi.Scene:
    """Return a level floor of a texture."""
    import mitsuba as mi

    to_world = mi.ScalarTransform4f().scale(SIZE_M / 2)
    floor = {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "diffuse", "reflectance": reflectance}}
    scene: mi.Scene = mi.load_dict({"type": "scene", "floor": floor})
    return scene


def rocks() -> mi.Scene:
    """Return a dense field of rocks, each of one reflectivity a face, on the gravel."""
    return with_rocks(np.zeros((401, 401)), rocky_seabed(52, seed=3))


def relief() -> mi.Scene:
    """Return gravel that rises and falls by some 0.1 m over 2 m, with a few rocks."""
    height = ndimage.gaussian_filter(np.random.default_rng(8).normal(size=(401, 401)), 25, mode="wrap")
    return with_rocks(0.1 * height / height.std(), rocky_seabed(16, seed=4))


def with_rocks(height: Array, seabed: Seabed) -> mi.Scene:
    """Return a ground of heights ``(n, n)`` with blotches, and rocks on it."""
    import mitsuba as mi

    side = len(height)
    x, y = np.meshgrid(np.linspace(-SIZE_M / 2, SIZE_M / 2, side), np.linspace(-SIZE_M / 2, SIZE_M / 2, side))
    corner = np.arange(side * side).reshape(side, side)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    ground = mesh(
        "ground", np.stack([x, y, height], -1).reshape(-1, 3), faces, "vertex_reflectivity", blotches(side).ravel()
    )
    stones = mesh("rocks", seabed.vertices, seabed.faces, "face_reflectivity", seabed.reflectivity)
    scene: mi.Scene = mi.load_dict({"type": "scene", "ground": ground, "rocks": stones})
    return scene


def mesh(name: str, vertices: NDArray[Any], faces: NDArray[Any], attribute: str, values: NDArray[Any]) -> mi.Mesh:
    """Return a diffuse mesh with a reflectivity a vertex or a face."""
    import mitsuba as mi

    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": attribute}})
    result = mi.Mesh(name, len(vertices), len(faces), props=properties)
    result.add_attribute(attribute, 1, values.astype(np.float32))  # type: ignore[arg-type]  # arrays work, despite the stub
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return result


def blotches(side: int) -> Array:
    """Return smooth reflectivities ``(side, side)``."""
    grain = ndimage.gaussian_filter(np.random.default_rng(5).random((side, side)), 1.2, mode="wrap")
    return np.asarray(np.clip(0.45 + (grain - 0.5) * 3, 0.02, 1))


# ---------------- Bounds


def bound_rows(seabeds: dict[str, mi.Scene], quick: bool) -> Iterator[list[str]]:
    """Yield a row for each instrument and seabed."""
    fan = load_sonar("didson300").replace(model="physical", range_min=3.2, range_max=5.6)
    grainy = load_sonar("didson300").replace(range_min=3.2, range_max=5.6)
    crossed = {"level": (0.0, 0.0, 0.0, 35.0, 0.0, 0.0), "upright": (0.0, 0.0, 0.0, 35.0, 90.0, 0.0)}
    volume = {"beams": 64, "azimuth_fov_deg": 90.0, "elevation_fov_deg": 2.5, "range_min": 2.5, "range_max": 7.5}
    if quick:
        fan, grainy = (sonar.replace(beams=12, range_bins=64, beam_width_deg=None) for sonar in (fan, grainy))
    pair = Sounder(name="pair", kind="range-image", fan=fan, mounts=crossed)
    stack = Sounder.create(
        name="stack", kind="range-image", model="physical", rows=2 if quick else 16, range_bins=64 if quick else 200,
        mounts={"ahead": crossed["level"]}, **(volume | ({"beams": 16} if quick else {})),
    )  # fmt: skip
    pings = 2 if quick else None
    for name in ["gravel"] if quick else list(seabeds):
        scene = seabeds[name]
        yield row_of("fan", name, fan_bound(scene, fan, pings))
        yield row_of("two crossed fans", name, sounder_bound(scene, pair, pings))
        yield row_of("3-D sonar", name, sounder_bound(scene, stack, pings))
        speckle = SpeckleBounds(Simulator(scene, grainy), 1.0, NAMES)
        yield row_of("fan, speckle", name, speckle.ground(np.array(POSE, dtype=float), 1 if quick else 16).bound())
    hydrophones = channel_bound(ChannelSonar(), 10.0, [0.003, 0.005, 0, 0, 0, 0], snr_db=20.0)
    yield row_of("hydrophones", "level, unknown scatterers", hydrophones, frames=1)


def gain_of(simulator: Simulator, poses: Array) -> float:
    """Return the gain of a run at these poses."""
    return constant_gain(simulator.pings(poses[:CALIBRATION_FRAMES]))[0]


def fan_bound(scene: mi.Scene, sonar: Sonar, pings: int | None) -> Bound | None:
    """Return the bound of one sonar."""
    simulator, pose = Simulator(scene, sonar), np.array([POSE], dtype=float)
    bounds = next(bounds_at(simulator, pose, LOW, gain_of(simulator, pose), pings=pings, degrees=NAMES))
    return bounds["image", "image", "gaussian"]


def sounder_bound(scene: mi.Scene, sounder: Sounder, pings: int | None) -> Bound | None:
    """Return the bound of all fans of an instrument."""
    simulator, pose = Simulator(scene, sounder.fan), np.array([VEHICLE], dtype=float)
    fans = sounder.fan_poses(pose)[0]
    gain = gain_of(simulator, fans if sounder.rows > 1 else fans[:1])  # bright echoes of a second fan are clipped
    bounds = next(bounds_of_fans(simulator, sounder, pose, LOW, gain, degrees=NAMES, pings=pings))
    return next(one for (_, kind, law), one in bounds.items() if (kind, law) == ("image", "gaussian"))


def row_of(instrument: str, seabed: str, bound: Bound | None, frames: int = 2) -> list[str]:
    """Return the cells of a row: directions that can be observed, standard deviations, and those that cannot."""
    assert bound is not None
    seen = observability(bound, NAMES, frames=frames)
    cells = ["-" if not np.isfinite(one) else f"{one:.2g}" for one in bound.std(frames) * UNITS]
    hidden = [*seen.unobservable, *(f"{name} (undecided)" for name in seen.undecided)]
    return [
        instrument,
        seabed,
        str(seen.observable),
        " / ".join(cells[:3]),
        " / ".join(cells[3:]),
        ", ".join(hidden) or "none",
    ]


# ---------------- The estimator


def direct6_row(name: str, scene: mi.Scene, frames: int) -> list[str]:
    """Return the cells of a row: errors of `direct6` over the bound, by degree of freedom, and their consistency."""
    sonar = load_sonar("didson300").replace(
        model="physical", range_min=3.2, range_max=5.6, beams=24, range_bins=128, beam_width_deg=None, jitter=True
    )
    simulator = Simulator(scene, sonar)
    gain = gain_of(simulator, np.array([POSE], dtype=float))
    (bounds,) = bounds_at(simulator, np.array([POSE], dtype=float), LOW, gain, degrees=NAMES)
    bound = bounds["image", "image", "gaussian"]
    assert bound is not None
    least = np.sqrt(np.diag(np.linalg.inv(bound.information + np.diag(1 / START.of(NAMES) ** 2))))
    estimator = Direct6(simulator, gain, LOW, start_std=START, pings=4 if frames == 1 else 32, ray_noise=False)
    rng, errors, squared, valid = np.random.default_rng(1), [], [], 0
    for number in range(frames):
        poses = np.tile(np.array(POSE, dtype=float), (MEAN_OF, 1))
        levels = np.concatenate([batch.levels for batch in simulator.pings(poses, first=MEAN_OF * (1 + number))])
        echo = np.minimum(levels * np.float32(gain), np.float32(1)).mean(axis=0, keepdims=True)
        image = to_uint8(LOW.apply(echo, seed=5, frames=np.array([number])))[0] / 255
        result = estimator.register(image, compose_six(POSE, rng.normal(size=6) * START.of(NAMES)))
        error = six_between(POSE, result.pose)
        errors.append(error)
        squared.append(float(error @ np.linalg.solve(result.covariance, error)) / 6)
        valid += result.valid
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / least
    stds = " / ".join(f"{one:.2g}" for one in least * UNITS)
    cells = [f"{one:.2f}" for one in ratio]
    return [name, stds, " / ".join(cells[:3]), " / ".join(cells[3:]), f"{np.mean(squared):.2f}", f"{valid} of {frames}"]


if __name__ == "__main__":
    main()
