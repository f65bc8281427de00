"""Draws docs/simulated_and_real.png: the frame of `make demo` beside one of a real sonar, in the same layout.

python docs/draw_beside_real.py --recordings FOLDER    # the folder of benchmarks/real_recordings.py
python docs/draw_beside_real.py --quick                # the simulated half, coarse, into a folder that is removed

The real frame: Oculus at 2.1 MHz, first ping of `three_pings_8bit.raw` of liboculus, (c) 2018-2020 University of Washington,
BSD-3-Clause (docs/gallery/index.md has its text). Its counts are read as amplitude^0.5. Nothing else is done to it.
"""

from __future__ import annotations

import argparse
import io
import sys
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from numpy.typing import NDArray
from PIL import Image

import mitsonar
from mitsonar.acoustics.levels import decoded
from mitsonar.geometry.fan import to_cartesian
from mitsonar.simulation.scene import sonar_in

DOCS = Path(__file__).parent

SPAN_DB = 50.0
"""Span of both pictures, below the 99.9th percentile of each [dB]."""

COARSE = {"range_bins": 60, "beams": 24, "quality": "draft"}
"""What `--quick` changes of the sonar."""


def main() -> None:
    """Draw and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, help="folder of the recordings")
    parser.add_argument("--quick", action="store_true", help="coarse, without a recording, and kept nowhere")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", mitsonar.MitsonarWarning)
    if arguments.quick:
        with tempfile.TemporaryDirectory() as folder:
            return draw({"simulated": simulated(COARSE)}, Path(folder) / "picture.png")
    if arguments.recordings is None:
        return print("no recording: name their folder by --recordings; nothing is drawn")
    pair = {
        "simulated: a sunken ship, 750 kHz": simulated({}),
        "real: an Oculus, 2.1 MHz, in a tank": recorded(arguments.recordings),
    }
    draw(pair, DOCS / "simulated_and_real.png")


def simulated(changes: Mapping[str, object]) -> mitsonar.SonarFrames:
    """Render the frame of `make demo`, with changes of its sonar."""
    scene = mitsonar.load_scene("sunken_ship")
    result = sonar_in(scene)
    assert result is not None
    sonar, pose = result
    return mitsonar.Simulator(scene, sonar.replace(**changes)).render([pose])


def recorded(folder: Path) -> mitsonar.SonarFrames:
    """Read the real frame."""
    sys.path.append(str(DOCS.parent / "benchmarks"))
    from real_recordings import RECORDINGS

    return RECORDINGS["Oculus 2.1 MHz"](folder)


def decibels(frames: mitsonar.SonarFrames) -> NDArray[np.float64]:
    """Return the first frame in dB below its 99.9th percentile ``(bins, beams)``."""
    intensity = np.asarray(decoded(frames.image[0], frames.sonar, frames.level), dtype=np.float64)
    return np.asarray(10 * np.log10(np.maximum(intensity / np.percentile(intensity, 99.9), 1e-12)))


def show(axes: Axes, title: str, frames: mitsonar.SonarFrames) -> AxesImage:
    """Draw a frame as a fan with metre axes, from the sonar on."""
    fan = to_cartesian(decibels(frames), frames.range_m, frames.bearing_rad)
    axes.set_facecolor("black")
    image = axes.imshow(fan.image, extent=fan.extent, cmap="copper", vmin=-SPAN_DB, vmax=0, interpolation="antialiased")
    axes.set(title=title, xlabel="starboard (m)", ylabel="forward (m)", ylim=(0, fan.extent[3]))
    return image


def draw(shown: Mapping[str, mitsonar.SonarFrames], out: Path) -> None:
    """Write frames side by side, with one colour bar.

    Args:
        shown: frames by their titles.
        out: the picture to write.
    """
    figure, axes = plt.subplots(1, len(shown), figsize=(11.4, 4.9), layout="constrained", squeeze=False)
    drawn = [show(one, title, frames) for one, (title, frames) in zip(axes[0], shown.items(), strict=True)]
    figure.colorbar(drawn[0], ax=axes, label="level (dB below the brightest 0.1 %)", fraction=0.03, pad=0.01)
    picture = io.BytesIO()
    figure.savefig(picture, dpi=100)
    Image.open(picture).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(out, optimize=True)
    print(f"{out.name}: {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
