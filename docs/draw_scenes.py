"""Draws docs/gallery/objects.png, pattern.png and flat_floor.png: shipped scenes in the model coherent, levels in dB.

python docs/draw_scenes.py            # into docs/gallery
python docs/draw_scenes.py --quick    # coarse, into a folder that is removed: does it still work?
"""

from __future__ import annotations

import argparse
import io
import math
import tempfile
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from PIL import Image

import mitsonar
from mitsonar.motion.pose import Pose
from mitsonar.plotting.fans import fan_figure
from mitsonar.simulation.scene import sonar_in

SPAN_DB = 50.0
"""What values 0..1, and so the colours, span [dB]."""


@dataclass(frozen=True)
class Shown:
    """A scene's parameters, and the sonar's pose where it is not the scene's."""

    parameters: Mapping[str, str] = field(default_factory=dict)
    pose: Pose | None = None


SAND = {"floor_material": "sand-mhz"}

SHOWN = {
    "objects": Shown(SAND),
    "pattern": Shown({"texture": "photo_gravel", **SAND}, Pose(0.05, -3.67, 2.5, math.radians(35))),
    "flat_floor": Shown({"model": "coherent", **SAND}),
}


def main() -> None:
    """Draw and write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="coarse, and kept nowhere")
    if not parser.parse_args().quick:
        return draw(Path(__file__).parent / "gallery", {})
    with tempfile.TemporaryDirectory() as folder:
        draw(Path(folder), {"range_bins": 60, "beams": 24, "quality": "draft"})


def draw(folder: Path, coarse: Mapping[str, object]) -> None:
    """Draw all scenes.

    Args:
        folder: to write to.
        coarse: changes of the sonars.
    """
    warnings.simplefilter("ignore", mitsonar.MitsonarWarning)
    for name, shown in SHOWN.items():
        scene = mitsonar.load_scene(name, **shown.parameters)
        result = sonar_in(scene)
        assert result is not None
        sonar, pose = result
        frames = mitsonar.Simulator(scene, sonar.replace(coding_db=SPAN_DB, **coarse)).render([shown.pose or pose])
        picture = io.BytesIO()
        fan_figure(frames, title=f"{name}, {sonar.name}, {sonar.model}").savefig(picture, dpi=85)
        out = folder / f"{name}.png"
        Image.open(picture).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(out, optimize=True)


if __name__ == "__main__":
    main()
