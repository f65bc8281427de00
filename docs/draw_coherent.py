"""Draws docs/gallery/coherent.png: two scenes in the model coherent, beside the expected levels of the model physical.

python docs/draw_coherent.py            # into docs/gallery
python docs/draw_coherent.py --quick    # coarse, into a folder that is removed: does it still work?
"""

from __future__ import annotations

import argparse
import io
import tempfile
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from PIL import Image

import mitsonar
from mitsonar.acoustics.levels import decoded
from mitsonar.geometry.fan import to_cartesian
from mitsonar.simulation.scene import sonar_in

SPAN_DB = 50.0
"""Span of the pictures below full scale [dB]."""


@dataclass(frozen=True)
class Shown:
    """A scene, its parameters, and what is changed of its sonar in the model coherent."""

    scene: str
    parameters: Mapping[str, str]
    sonar: Mapping[str, float]


SHOWN = (
    Shown("sunken_ship", {}, {"source_level_db": 210.0, "noise_level_db": 66.0, "gain_exponent": 3}),
    Shown("objects", {"x": "0", "floor_material": "sand-mhz"}, {}),
)


def decibels(frames: mitsonar.SonarFrames) -> NDArray[np.float64]:
    """Return the first frame in dB below full scale ``(bins, beams)``."""
    level = decoded(frames.image[0], frames.sonar, frames.level)
    return np.asarray(10 * np.log10(np.maximum(level, 1e-20)), dtype=np.float64)


def main() -> None:
    """Draw and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="coarse, and kept nowhere")
    if not parser.parse_args().quick:
        return draw(Path(__file__).parent / "gallery" / "coherent.png", {})
    with tempfile.TemporaryDirectory() as folder:
        draw(Path(folder) / "coherent.png", {"range_bins": 60, "beams": 24, "rays_per_beam": 60, "quality": "draft"})


def draw(out: Path, coarse: Mapping[str, object]) -> None:
    """Draw both scenes in both models.

    Args:
        out: the picture to write.
        coarse: changes of the sonars.
    """
    warnings.simplefilter("ignore", mitsonar.MitsonarWarning)
    figure, axes = plt.subplots(2, len(SHOWN), figsize=(10.6, 8.6), layout="constrained", width_ratios=[1.5, 1])
    for column, shown in zip(axes.T, SHOWN, strict=True):
        scene = mitsonar.load_scene(shown.scene, **shown.parameters)
        result = sonar_in(scene)
        assert result is not None
        sonar, pose = result
        changes = {**shown.sonar, **coarse, "coding": "dB", "coding_db": 90.0}
        models: dict[str, Mapping[str, object]] = {
            "physical": {"model": "physical", "pattern": "box", "coding": "linear"},
            "coherent": {"model": "coherent", "pattern": None},
        }
        for ax, (name, model) in zip(column, models.items(), strict=True):
            frames = mitsonar.Simulator(scene, sonar.replace(**{**changes, **model})).render([pose])
            fan = to_cartesian(decibels(frames), frames.range_m, frames.bearing_rad)
            ax.set_facecolor("black")
            shown_db = np.where(fan.image == 0, np.nan, fan.image)
            drawn = ax.imshow(shown_db, extent=fan.extent, cmap="copper", vmin=-SPAN_DB, vmax=0)
            ax.set(title=f"{shown.scene}, {name}", xlabel="starboard (m)", ylabel="forward (m)")
    figure.colorbar(drawn, ax=axes, label="level (dB below full scale)", fraction=0.03, pad=0.01)
    picture = io.BytesIO()
    figure.savefig(picture, dpi=85)
    Image.open(picture).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(out, optimize=True)


if __name__ == "__main__":
    main()
