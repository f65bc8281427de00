"""Draws a picture of each instrument of fans and of a head that turns, and the film of a school, into docs/gallery.

python docs/draw_instruments.py            # sidescan, ping360, returns, altimeter, profiler, dvl .png and school.mp4
python docs/draw_instruments.py --quick    # coarse, into a folder that is removed: does it still work?
"""

from __future__ import annotations

import argparse
import math
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import mitsonar
from mitsonar.motion.pose import Pose
from mitsonar.plotting.fans import fan_figure, save_fan, write_fan_video
from mitsonar.simulation.instrument_runs import run_sounder
from mitsonar.simulation.runs import Destination

SOUNDED = {
    "sidescan": ("waterfall.png", Pose(-6, -3, 2.5, heading=math.pi / 2), Pose(6, -3, 2.5, heading=math.pi / 2), 240),
    "altimeter": ("echogram.png", Pose(-6, 0.4, 2.2, heading=math.pi / 2), Pose(6, 0.4, 2.2, heading=math.pi / 2), 120),
    "profiler": ("soundings.png", Pose(-5, 0.4, 2.5, heading=math.pi / 2), Pose(5, 0.4, 2.5, heading=math.pi / 2), 60),
    "dvl": ("dvl.png", Pose(-3, -3, 2.2), Pose(-1, 1, 2.2, heading=0.6), 60),
}
"""Picture of each instrument over the scene `objects`, first and last pose, pings."""

CHANGES: dict[str, dict[str, Any]] = {
    "sidescan": {"range_max": 7.0, "range_min": 0.5, "range_bins": 520, "quality": "draft"},
    "altimeter": {"range_max": 5.0, "range_bins": 188, "quality": "draft"},
    "profiler": {"range_min": 0.5, "range_max": 8.0, "range_bins": 750, "model": "physical", "quality": "draft"},
    "dvl": {"model": "physical", "quality": "draft"},
}

FISH, FILMED = 14, 60


def main() -> None:
    """Draw and write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="coarse, and kept nowhere")
    warnings.simplefilter("ignore", mitsonar.MitsonarWarning)
    if not parser.parse_args().quick:
        return draw(Path(__file__).parent / "gallery", 1)
    with tempfile.TemporaryDirectory() as folder:
        draw(Path(folder), 20)


def draw(folder: Path, coarser: int) -> None:
    """Draw all; of ``coarser`` pings or frames one is rendered."""
    scene = mitsonar.load_scene("objects")
    for kind, (picture, start, end, pings) in SOUNDED.items():
        simulator = mitsonar.SounderSimulator(scene, mitsonar.load_sounder(kind).replace(**CHANGES[kind]))
        path = mitsonar.Trajectory.between(start, end, max(2, pings // coarser), 10.0)
        with tempfile.TemporaryDirectory() as out:
            run_sounder(simulator, path, Destination(Path(out) / "run"))
            (folder / f"{kind}.png").write_bytes((Path(out) / "run" / picture).read_bytes())
    head = mitsonar.load_sonar("ping360").replace(
        range_max=10.0, model="physical", pattern="two_way", coding="dB", coding_db=50.0
    )
    if coarser > 1:
        head = head.replace(beams=20, ping_groups=20)
    sweep = mitsonar.Simulator(scene, head.replace(quality="draft")).render([Pose(0, -3, 1.2, 0.12)])
    save_fan(folder / "ping360.png", sweep, title="Ping360: a sweep of 13 s over `objects`")
    first_returns(folder / "returns.png", sweep)
    film(folder / "school.mp4", max(2, FILMED // coarser))


def first_returns(path: Path, sweep: mitsonar.SonarFrames) -> None:
    """Draw a sweep with the first return of each beam."""
    rule = mitsonar.FirstReturns(level_db=-6.0, from_m=0.75)
    range_m = rule.find(sweep).range_m[0]
    figure = fan_figure(sweep, title=f"First returns from {rule.level_db:g} dB on, beyond {rule.from_m:g} m")
    starboard, forward = range_m * np.sin(sweep.bearing_rad), range_m * np.cos(sweep.bearing_rad)
    figure.axes[0].plot(starboard, forward, ".", color="cyan", markersize=3)
    figure.savefig(path, dpi=80)


def film(path: Path, frames: int) -> None:
    """Write the film of a school of fish that passes a DIDSON over sand and stones."""
    import mitsuba as mi

    rng = np.random.default_rng(4)
    sand: dict[str, Any] = {"type": "cell_noise", "coordinates": "position", "cell_size": 0.4, "low": 0.15, "high": 0.35}
    parts: dict[str, Any] = {
        "floor": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale(20),
            "bsdf": {"type": "diffuse", "reflectance": sand},
        },
        "fish": fish(),
    }
    for number, (x, y) in enumerate(rng.uniform((-1.2, 4), (1.2, 7), (9, 2))):
        parts[f"stone{number}"] = {"type": "sphere", "center": [x, y, 0.0], "radius": float(rng.uniform(0.06, 0.16))}
    scene = mi.load_dict({"type": "scene", **parts}, optimize=False)
    time = np.arange(frames + 20) / 10.0
    school = []
    for late, side, height in rng.uniform((-1.6, -0.5, 0.35), (1.2, 0.5, 0.9), (FISH, 3)):
        x = -1.6 + 0.55 * time + late
        y = 5.2 + side + 0.25 * np.sin(0.9 * x + side)
        heading = np.arctan2(np.gradient(x), np.gradient(y))
        level = np.zeros_like(time)
        school.append(mitsonar.Trajectory(np.column_stack([x, y, level + height, level, level, heading]), time))
    sonar = mitsonar.load_sonar("didson300").replace(
        range_min=3.5, range_max=7.5, quality="draft", frame_rate_hz=10.0, gain_exponent=4
    )
    still = mitsonar.Trajectory.between(Pose(0, 0, 2, 0.3), Pose(0, 0, 2, 0.3), frames, 10.0)
    seen = mitsonar.Simulator(scene, sonar, moving={"fish": school}).render(still)
    write_fan_video([seen], path, 10.0, span_db=45.0, rows=400, overwrite=True)


def fish() -> object:
    """Return a fish of 24 cm as a mesh: an ellipsoid with a tail, its bow along +y."""
    import mitsuba as mi

    along, around = np.linspace(0, 1, 25), np.linspace(0, 2 * np.pi, 17)[:-1]
    width = 0.03 * np.sin(np.pi * along) ** 0.7
    height = np.where(along < 0.85, 0.045 * np.sin(np.pi * along) ** 0.7, 0.05 * (along - 0.8) / 0.2)
    y = np.repeat(0.12 - 0.24 * along, 16)
    x, z = (np.outer(one, wave).ravel() for one, wave in ((width, np.cos(around)), (height, np.sin(around))))
    ring, next_ = np.arange(24)[:, None] * 16, (np.arange(16) + 1) % 16
    a, b, c, d = ring + np.arange(16), ring + next_, ring + 16 + next_, ring + 16 + np.arange(16)
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": 0.9})
    mesh = mi.Mesh("fish", 25 * 16, len(faces), props)
    values = mi.traverse(mesh)
    values["vertex_positions"] = np.stack([x, y, z], -1).ravel().astype(np.float32)
    values["faces"] = faces.ravel().astype(np.uint32)
    values.update()
    return mesh


if __name__ == "__main__":
    main()
