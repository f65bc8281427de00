"""Draws docs/gallery/multipath.png: a tank with one, two and three reflections, in the models physical and coherent.

python docs/draw_multipath.py            # into docs/gallery
python docs/draw_multipath.py --quick    # coarse, into a folder that is removed: does it still work?
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np

import mitsonar
from mitsonar.simulation.device import ensure_variant

if TYPE_CHECKING:
    import mitsuba as mi

SPAN_DB = 60.0
"""Span of the pictures below full scale [dB]."""

POSE = [0.3, -1.5, 1.2, math.radians(8), 0, math.radians(12)]
MIRRORS = {"surface": (-1.0, 0.0), "back": (0.7, 2e-5), "starboard": (0.7, 2e-5)}
PLATES: dict[str, tuple[list[float], list[float]]] = {
    "floor": ([0, 0, 0], [0, 0, 1]),
    "surface": ([0, 0, 4], [0, 0, -1]),
    "back": ([0, 4.5, 2], [0, -1, 0]),
    "starboard": ([3, 2, 2], [-1, 0, 0]),
}
BALLS = [-0.4, 3.0, 0.15], [0.3, 3.5, 0.15], [0.7, 2.8, 0.15]


def main() -> None:
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="draw coarsely into a temporary folder")
    quick = parser.parse_args().quick
    ensure_variant()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) if quick else Path(__file__).parent / "gallery"
        draw(folder / "multipath.png", quick)


def tank() -> mi.Scene:
    """Return a tank with a rough floor, three balls on it, two smooth walls and a flat surface."""
    import mitsuba as mi

    parts: dict[str, Any] = {}
    for name, (position, normal) in PLATES.items():
        up = [0, 1, 0] if normal[2] else [0, 0, 1]
        look = mi.ScalarTransform4f().look_at(
            origin=position, target=[a + n for a, n in zip(position, normal, strict=True)], up=up
        )
        parts[name] = {"type": "rectangle", "to_world": look @ mi.ScalarTransform4f().scale(8), "bsdf": grey(0.05)}
    for number, position in enumerate(BALLS):
        parts[f"ball{number}"] = {"type": "sphere", "center": position, "radius": 0.15, "bsdf": grey(0.2)}
    loaded = mi.load_dict({"type": "scene", **parts}, optimize=False)
    assert isinstance(loaded, mi.Scene)
    return loaded


def grey(reflectance: float) -> dict[str, Any]:
    """Return a diffuse BSDF."""
    return {"type": "diffuse", "reflectance": {"type": "uniform", "value": reflectance}}


def draw(file: Path, quick: bool) -> None:
    """Draw both models with one, two and three reflections."""
    sonar = mitsonar.load_sonar("didson300").replace(
        range_min=1.0, range_max=10.0, range_bins=700, pattern="receive", elevation_fov_deg=20.0, noise_level_db=None,
        quality="draft" if quick else "standard",
    )  # fmt: skip
    scene, words = tank(), ["one reflection", "two", "three"]
    figure, axes = plt.subplots(2, 3, figsize=(9, 8), sharex=True, sharey=True, layout="constrained")
    for row, model in zip(axes, ("physical", "coherent"), strict=True):
        full = 0.0
        for axis, bounces, word in zip(row, (1, 2, 3), words, strict=True):
            mirrors = MIRRORS if bounces > 1 or model == "coherent" else None
            simulator = mitsonar.Simulator(scene, sonar.replace(model=model, bounces=bounces), mirrors=mirrors)
            level_db = 10 * np.log10(next(iter(simulator.pings(np.array(POSE)))).levels[0] + 1e-20)
            full = float(np.percentile(level_db, 99.5)) if bounces == 1 else full
            extent = (*np.degrees(sonar.bearing_rad[[0, -1]]), sonar.range_min, sonar.range_max)
            axis.imshow(
                level_db, vmin=full - SPAN_DB, vmax=full, cmap="copper", origin="lower", aspect="auto", extent=extent
            )
            axis.set_title(f"{model}, {word}", fontsize=9)
    figure.supxlabel("bearing [deg]", fontsize=9)
    figure.supylabel("range [m]", fontsize=9)
    figure.savefig(file, dpi=80, pil_kwargs={"optimize": True})


if __name__ == "__main__":
    main()
