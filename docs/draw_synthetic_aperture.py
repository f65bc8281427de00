"""Draws the sunken ship by a side-scan and by a synthetic aperture along one track: docs/gallery/synthetic_aperture.png.

python docs/draw_synthetic_aperture.py           # about five minutes on two cores
python docs/draw_synthetic_aperture.py --quick   # a shorter, coarser strip, into a folder that is removed
"""

from __future__ import annotations

import argparse
import math
import tempfile
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

import mitsonar
from mitsonar.instruments.hydrophones import side_looking_array
from mitsonar.mapping.synthetic_aperture import along_resolution, focus, strip_grid
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import velocities
from mitsonar.records.strips import StripGrid, StripImage

if TYPE_CHECKING:
    import mitsuba as mi

NEAR_M, FAR_M = 12.0, 40.0
"""Ground range of both pictures."""

SPAN_DB = 45.0


def main() -> None:
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a short, coarse strip, kept nowhere")
    warnings.simplefilter("ignore", mitsonar.MitsonarWarning)
    if not parser.parse_args().quick:
        return draw(Path(__file__).parent / "gallery" / "synthetic_aperture.png")
    with tempfile.TemporaryDirectory() as folder:
        draw(Path(folder) / "picture.png", quick=True)


def draw(path: Path, quick: bool = False) -> None:
    """Simulate both instruments past the wreck, and draw them to one scale."""
    half = 6.0 if quick else 16.0
    start, end = (Pose(1.0 + x, 27.0, 10.0, heading=math.pi / 2) for x in (-half, half))
    scene = mitsonar.load_scene("sunken_ship")
    strip = aperture(scene, start, end, quick)
    slow = side_scan(scene, start, end, strip.grid, 20 if quick else 320)
    figure = Figure(figsize=(11.2, 5.6), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    panels = (
        (slow, "side-scan, 450 kHz, 0.8 deg beam"),
        (strip.decibels(SPAN_DB), "synthetic aperture, 100 kHz, 8 receivers"),
    )
    grid = strip.grid
    extent = (grid.across_m[0], grid.across_m[-1], grid.along_m[0], grid.along_m[-1])
    for one, (level, title) in zip(axes, panels, strict=True):
        drawn = one.imshow(
            level, extent=extent, cmap="copper", vmin=-SPAN_DB, vmax=0, origin="lower", interpolation="antialiased"
        )
        one.set(xlabel="ground range to starboard (m)", title=title)
    axes[0].set_ylabel("along the track (m)")
    figure.colorbar(drawn, ax=axes, label="level (dB)", fraction=0.03, pad=0.01, shrink=0.86)
    figure.savefig(path, dpi=100, metadata={"Software": None})
    Image.open(path).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    print(path)


def aperture(scene: mi.Scene, start: Pose, end: Pose, quick: bool) -> StripImage:
    """Focus the strip between two poses."""
    sonar = side_looking_array(
        0.2 if quick else 0.1, 8, bandwidth_hz=10e3 if quick else 20e3, range_max=42.0, absorption_db_per_m=0.0336
    )
    length = math.dist(start[:3], end[:3])
    pings = math.ceil(length / (along_resolution(sonar) * 8)) + 1
    flown = mitsonar.Trajectory.between(start, end, pings, 1.5 * (pings - 1) / length)
    simulator = mitsonar.ChannelSimulator(scene, sonar, within=sonar.box_seen_from(flown.poses))
    responses = simulator.responses(flown, velocities(flown))
    return focus(responses, strip_grid(responses, near_m=NEAR_M, far_m=FAR_M), weighting="hann")


def side_scan(scene: mi.Scene, start: Pose, end: Pose, grid: StripGrid, pings: int) -> NDArray[np.float64]:
    """Return the levels of a side-scan at the pixels of a strip, in ground range [dB]."""
    sounder = mitsonar.load_sounder("sidescan").replace(
        range_min=12.0, range_max=42.0, range_bins=1200, quality="draft", gain_exponent=4
    )
    flown = mitsonar.Trajectory.between(start, end, pings, 15.0)
    simulator = mitsonar.SounderSimulator(scene, sounder)
    starboard = sounder.channels.index("starboard")
    levels = np.concatenate([part.levels[:, starboard, :, 0] for part in simulator.pings(flown.poses)])
    way = np.linspace(0.0, math.dist(start[:3], end[:3]), pings)
    slant = np.hypot(grid.across_m, start.z - grid.z)
    rows = np.abs(way[None] - grid.along_m[:, None]).argmin(axis=1)
    bins = np.clip(np.searchsorted(sounder.fan.range_m, slant), 0, sounder.fan.range_bins - 1)
    shown = levels[rows][:, bins].astype(float)
    return np.asarray(10 * np.log10(np.clip(shown / np.percentile(shown, 99.9), 10 ** (-SPAN_DB / 10), 1)))


if __name__ == "__main__":
    main()
