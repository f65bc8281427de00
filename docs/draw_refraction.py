"""Draws docs/gallery/refraction.png: how far a gradient of the sound speed bends rays, and what it does to ranges.

python docs/draw_refraction.py            # into docs/gallery
python docs/draw_refraction.py --quick    # into a folder that is removed: does it still work?

In a constant gradient g rays are arcs of circles; a level one has the radius c / g. The travel time between two points of
sound speeds a and b, d apart, is arccosh(1 + g^2 d^2 / 2 a b) / g (Medwin and Clay, 1998).
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

SOUND_SPEED = 1500.0
GRADIENTS = (0.1, 0.2, 0.5)
"""Sound speed over depth [1/s]: a weak, a common and a sharp thermocline."""

TABLE_M = (10, 25, 50, 100, 200)


def main() -> None:
    """Draw into the gallery, or with ``--quick`` into a folder that is removed, and print the numbers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="into a folder that is removed")
    quick = parser.parse_args().quick
    with tempfile.TemporaryDirectory() as folder:
        draw(Path(folder if quick else Path(__file__).parent / "gallery") / "refraction.png")
    for gradient in GRADIENTS:
        for away in TABLE_M:
            x = np.array([float(away)])
            bend, error, depth = sag_m(x, gradient)[0], range_error_m(x, gradient)[0], speed_error_m(x, gradient, 5.0)[0]
            print(f"{gradient} 1/s, {away} m: {bend:.3f} m aside, range {1e3 * error:.3f} mm, deeper {1e3 * depth:.1f} mm")


def sag_m(range_m: NDArray[np.float64], gradient: float) -> NDArray[np.float64]:
    """Return how far a level ray leaves its straight line ``(n,)`` [m]: the arc's own height."""
    radius = SOUND_SPEED / gradient
    return np.asarray(radius - np.sqrt(radius**2 - range_m**2))


def range_error_m(range_m: NDArray[np.float64], gradient: float) -> NDArray[np.float64]:
    """Return by how much the arc's time makes a range between two points of one depth too short ``(n,)`` [m]."""
    time = np.arccosh(1 + (gradient * range_m / SOUND_SPEED) ** 2 / 2) / gradient
    return np.asarray(range_m - SOUND_SPEED * time)


def speed_error_m(range_m: NDArray[np.float64], gradient: float, deeper_m: float) -> NDArray[np.float64]:
    """Return by how much a range to a deeper point errs where the speed at the sonar is taken for all of it ``(n,)`` [m]."""
    there = SOUND_SPEED - gradient * deeper_m
    time = np.arccosh(1 + (gradient * range_m) ** 2 / (2 * SOUND_SPEED * there)) / gradient
    return np.asarray(SOUND_SPEED * time - range_m)


def draw(out: Path) -> None:
    """Draw bend and error of range over range, with what a sonar resolves."""
    x = np.linspace(1, 200, 400)
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    for gradient in GRADIENTS:
        axes[0].loglog(x, sag_m(x, gradient), label=f"{gradient:g} 1/s")
        axes[1].loglog(x, 1e3 * range_error_m(x, gradient), label=f"{gradient:g} 1/s, by the bend")
    axes[1].loglog(x[x > 10], 1e3 * speed_error_m(x[x > 10], 0.2, 5.0), "k-.", label="0.2 1/s, by the speed 5 m deeper")
    axes[0].loglog(x, x * np.radians(14), "k--", label="14 deg (imaging sonar, over elevation)")
    axes[0].loglog(x, x * np.radians(1), "k:", label="1 deg (profiler)")
    axes[1].axhline(5, color="k", linestyle="--", label="bin of 5 mm")
    axes[0].set(xlabel="range (m)", ylabel="level ray leaves its line (m)", ylim=(1e-3, 1e2), xlim=(5, 200))
    axes[1].set(xlabel="range (m)", ylabel="error of range (mm)", ylim=(1e-3, 1e3), xlim=(5, 200))
    for axis in axes:
        axis.axvline(50, color="0.7")
        axis.legend(fontsize=8)
    figure.savefig(out, dpi=85)


if __name__ == "__main__":
    main()
