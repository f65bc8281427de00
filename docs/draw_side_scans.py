"""Draws docs/gallery/side_scans.png: waterfalls and maps of a real side-scan and of a simulated one, by the same functions.

python docs/draw_side_scans.py FILE.xtf --declination -18  # into docs/gallery; scotsman-iver2.xtf of OpenSidescan
python docs/draw_side_scans.py --quick                     # a coarse simulation twice, into a folder that is removed
"""

from __future__ import annotations

import argparse
import io
import math
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from PIL import Image

import mitsonar
from mitsonar.geometry.side_scan import track_bottom
from mitsonar.mapping.side_scan_mosaic import build_side_scan_mosaic
from mitsonar.motion.pose import Pose
from mitsonar.records.soundings import Echogram

START, END, PINGS = Pose(-14, -8, 8, heading=math.pi / 2), Pose(14, -8, 8, heading=math.pi / 2), 280
"""First and last pose of the vehicle over the scene `sunken_ship`, and its pings."""

WINDOW = {"range_min": 0.5, "range_max": 25.0, "range_bins": 800, "quality": "draft"}

SPAN_DB = 55.0

COLOURS = 64


def main() -> None:
    """Draw into the gallery, or with ``--quick`` into a folder that is removed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?", help="recording of a side-scan")
    parser.add_argument("--declination", type=float, default=0.0, help="to add to its headings [deg]")
    parser.add_argument("--quick", action="store_true", help="coarse, into a folder that is removed")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", mitsonar.MitsonarWarning)
    rendered = simulated(20 if arguments.quick else 1)
    if arguments.quick:
        with tempfile.TemporaryDirectory() as folder:
            return draw(Path(folder) / "side_scans.png", {"simulated": rendered, "again": rendered})
    if arguments.file is None:
        parser.error("name the recording of a side-scan, or use --quick")
    real = mitsonar.open_side_scan(arguments.file).part().read()
    turned = real.poses + np.array([0, 0, 0, 0, 0, math.radians(arguments.declination)])
    named = {
        "real: wreck of the Scotsman, 600 kHz": replace(real, poses=turned),
        "simulated: sunken_ship, starfish-450f": rendered,
    }
    return draw(Path(__file__).parent / "gallery" / "side_scans.png", named)


def simulated(coarser: int) -> Echogram:
    """Return the echogram of a line past the ship; of ``coarser`` pings one is rendered."""
    sounder = mitsonar.load_sounder("sidescan").replace(**WINDOW)
    path = mitsonar.Trajectory.between(START, END, max(4, PINGS // coarser), 10.0)
    return mitsonar.SounderSimulator(mitsonar.load_scene("sunken_ship"), sounder).echogram(path)


def draw(path: Path, echograms: dict[str, Echogram]) -> None:
    """Draw a waterfall and a map of each echogram."""
    figure, axes = plt.subplots(len(echograms), 2, figsize=(10.4, 10), layout="constrained")
    for (title, echogram), (left, right) in zip(echograms.items(), axes, strict=True):
        track = track_bottom(echogram)
        waterfall(left, echogram, track.range_m)
        left.set_title(title, fontsize=10)
        mosaic = build_side_scan_mosaic(echogram, track.height_m)
        low, high = np.nanpercentile(mosaic.mean, [0.5, 99.5])
        right.imshow(mosaic.mean, extent=mosaic.extent, cmap="copper", vmin=low, vmax=high)
        right.plot(*echogram.poses[:, :2].T, color="cyan", lw=0.8, label="track")
        right.set(xlabel="x, east (m)", ylabel="y, north (m)", facecolor="0.9")
        right.legend(loc="lower right", fontsize=8)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=85, format="png")
    Image.open(buffer).convert("RGB").quantize(COLOURS).save(path, optimize=True)


def waterfall(axes: Axes, echogram: Echogram, first_return_m: np.ndarray) -> None:
    """Draw levels over slant range, port to the left, and the first return."""
    level = echogram.decibels(SPAN_DB)
    near, far = echogram.sounder.fan.range_min, echogram.sounder.fan.range_max
    port, starboard = (level[:, echogram.sounder.channels.index(side)] for side in ("port", "starboard"))
    for side, extent in ((port[:, ::-1], (-far, -near)), (starboard, (near, far))):
        axes.imshow(
            side,
            extent=(*extent, 0, len(level)),
            cmap="copper",
            vmin=-SPAN_DB,
            vmax=0,
            aspect="auto",
            origin="lower",
            interpolation="antialiased",
        )
    for sign in (-1, 1):
        axes.plot(sign * first_return_m, np.arange(len(level)) + 0.5, color="cyan", lw=0.8)
    axes.set(xlim=(-far, far), ylim=(0, len(level)), xlabel="slant range, port - starboard (m)", ylabel="ping")


if __name__ == "__main__":
    main()
