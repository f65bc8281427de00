"""Draws docs/gallery/worlds.png: each world from above, lit from the side, and as a sonar in it sees it.

python docs/draw_worlds.py            # into docs/gallery
python docs/draw_worlds.py --quick    # coarse, into a folder that is removed: does it still work?
"""

from __future__ import annotations

import argparse
import io
import tempfile
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import mitsonar
from mitsonar.geometry.fan import to_cartesian
from mitsonar.motion.pose import Pose
from mitsonar.simulation.device import ensure_variant
from mitsonar.simulation.scene import sonar_in
from mitsonar.worlds.families import create_family

if TYPE_CHECKING:
    import mitsuba as mi

SHOWN: dict[str, tuple[dict[str, object], float]] = {
    "rocky-field": ({}, 4.0),
    "ship-hull": ({}, 4.0),
    "pattern": ({}, 6.0),
    "flat-objects": ({}, 4.0),
}
"""Options of each family, and half the edge of what is drawn from above [m]."""

SPAN_DB = 60.0
"""What values 0..1 of the sonar images, and so the colours, span [dB]."""


def from_above(scene: mi.Scene, middle: tuple[float, float], half_m: float, pixels: int, spp: int) -> np.ndarray:
    """Render a photograph, as if the water were clear. North is up."""
    import mitsuba as mi

    sun = {"type": "directional", "direction": [0.8, -0.5, -0.7], "irradiance": {"type": "uniform", "value": 3.0}}
    sky = {"type": "constant", "radiance": {"type": "uniform", "value": 0.25}}
    x, y = middle
    look = mi.ScalarTransform4f().look_at(origin=[x, y, 20], target=[x, y, 0], up=[0, 1, 0])
    camera = mi.load_dict(
        {
            "type": "orthographic",
            "to_world": look @ mi.ScalarTransform4f().scale([half_m, half_m, 1]),
            "film": {"type": "hdrfilm", "width": pixels, "height": pixels, "pixel_format": "luminance"},
        }
    )
    shapes = {f"shape{number}": shape for number, shape in enumerate(scene.shapes())}
    lit = mi.load_dict({"type": "scene", "sun": sun, "sky": sky, **shapes})
    picture = np.array(mi.render(lit, sensor=camera, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=spp))
    return np.asarray(np.clip(picture[..., 0], 0, 1) ** (1 / 2.2))


def footprint_outline(sonar: mitsonar.Sonar, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Where the window lies on the ground."""
    edge = np.radians(sonar.azimuth_fov_deg) / 2
    near, far = (np.sqrt(max(r**2 - pose.z**2, 0)) for r in (sonar.range_min, sonar.range_max))
    bearing = np.linspace(-edge, edge, 40)
    r = np.r_[np.full(40, near), np.full(40, far), near]
    b = np.r_[bearing, bearing[::-1], bearing[0]] + pose.heading
    return pose.x + r * np.sin(b), pose.y + r * np.cos(b)


def main() -> None:
    """Draw and write the picture.

    Raises:
        SystemExit: a world is not seen.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="coarse, and kept nowhere")
    if not parser.parse_args().quick:
        return draw(Path(__file__).parent / "gallery" / "worlds.png", 700, 64)
    with tempfile.TemporaryDirectory() as folder:
        draw(Path(folder) / "worlds.png", 40, 2)


def draw(out: Path, pixels: int, spp: int) -> None:
    """Draw all worlds.

    Args:
        out: the picture to write.
        pixels: of an edge of what is seen from above.
        spp: rays a pixel of it.

    Raises:
        SystemExit: a world is not seen.
    """
    ensure_variant()
    warnings.simplefilter("ignore", mitsonar.MitsonarWarning)
    figure, axes = plt.subplots(2, len(SHOWN), figsize=(4 * len(SHOWN), 8.2), layout="constrained")
    for (name, (options, half_m)), (above, below) in zip(SHOWN.items(), axes.T, strict=True):
        with tempfile.TemporaryDirectory() as folder:
            world = create_family(name, **options).build(1)
            scene = mitsonar.load_scene(world.write(Path(folder) / "world"))
        result = sonar_in(scene)
        assert result is not None
        sonar, pose = result
        frames = mitsonar.Simulator(scene, sonar.replace(coding_db=SPAN_DB)).render([pose])
        x, y = footprint_outline(sonar, pose)
        middle = (float(x.mean()), float(y.mean())) if half_m < 6 else (0.0, 0.0)
        extent = (middle[0] - half_m, middle[0] + half_m, middle[1] - half_m, middle[1] + half_m)
        seen = from_above(scene, middle, half_m, pixels, spp)
        if not (frames.image[0] > 0).mean() > 0.05 or not np.ptp(seen) > 0.1:
            raise SystemExit(f"{name} is not seen: its picture or its sonar image is empty")
        above.imshow(seen, cmap="gray", extent=extent, vmin=0, vmax=1)
        above.plot(x, y, color="tab:orange", lw=1)
        above.plot(pose.x, pose.y, "o", color="tab:orange", ms=5)
        above.set(title=name, xlim=extent[:2], ylim=extent[2:], xlabel="x, m", ylabel="y, m")
        fan = to_cartesian(frames.image[0], frames.range_m, frames.bearing_rad)
        shown = below.imshow((fan.image - 1) * SPAN_DB, extent=fan.extent, cmap="copper", vmin=-SPAN_DB, vmax=0)
        below.set(facecolor="black", xlabel="starboard, m", ylabel="ahead, m")
    figure.colorbar(shown, ax=axes[1], label="level (dB below full scale)", pad=0.01)
    picture = io.BytesIO()
    figure.savefig(picture, dpi=70)
    Image.open(picture).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(out, optimize=True)
    print(f"{out}: {len(SHOWN)} worlds")


if __name__ == "__main__":
    main()
