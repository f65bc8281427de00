"""Draws docs/gallery/conventions.png: one and the same pose in mitsonar's convention, in that of ROS and in NED.

python docs/draw_conventions.py [--quick] [--out PICTURE.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsonar.motion.pose import Pose, vehicle_rotation
from mitsonar.motion.trajectory import CONVENTIONS, Convention

POSE = Pose.from_degrees([2.2, 1.4, 1.5, 25, 0, 40])
"""Where the sonar of the picture is: 25 deg below the horizon, 40 deg clockwise from north."""

COLOURS = ("tab:red", "tab:green", "tab:blue")
"""Of x, y and z."""

WORDS = {
    "mitsonar": (("east", "north", "up"), ("starboard", "forward", "up")),
    "ros-enu": (("east", "north", "up"), ("forward", "left", "up")),
    "ned": (("north", "east", "down"), ("forward", "right", "down")),
}
TITLES = {"mitsonar": "mitsonar", "ros-enu": "ros-enu (REP 103: ENU, FLU)", "ned": "ned (NED, FRD)"}

# the eye of the drawing is in the south and above
RIGHT = np.array([0.92, 0.38, 0.0])
UPWARD = np.array([-0.19, 0.46, 0.87])


def on_paper(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points ``(n, 3)`` in mitsonar's world as seen from the south and above ``(n, 2)``."""
    return np.column_stack([points @ RIGHT, points @ UPWARD])


def arrow(axis: Axes, start: NDArray[np.float64], end: NDArray[np.float64], colour: str, text: str) -> None:
    """Draw an arrow between two points, with its text beyond its tip."""
    (a, b), tip = on_paper(np.array([start, end])), on_paper(np.array([start + 1.2 * (end - start)]))[0]
    axis.annotate("", b, a, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 2.2, "shrinkA": 0, "shrinkB": 0})
    side = "center" if abs(tip[0] - a[0]) < 0.2 else "left" if tip[0] > a[0] else "right"
    axis.text(tip[0], tip[1], text, color=colour, fontsize=10, ha=side, va="center")


def triad(
    axis: Axes, place: NDArray[np.float64], matrix: NDArray[np.float64], length: float, words: tuple[str, ...]
) -> None:
    """Draw the axes x, y, z, the columns of a matrix in mitsonar's world."""
    for column, colour, letter, word in zip(matrix.T, COLOURS, "xyz", words, strict=True):
        arrow(axis, place, place + length * column, colour, f"{letter} {word}")


def fan(axis: Axes, turn: Rotation, place: NDArray[np.float64]) -> None:
    """Draw the view of the sonar along its middle plane."""
    bearing = np.radians(np.linspace(-15, 15, 20))
    rim = np.column_stack([np.sin(bearing), np.cos(bearing), np.zeros(20)]) * 2.6
    corners = on_paper(place + turn.apply(np.vstack([[0, 0, 0], rim])))
    axis.fill(*corners.T, color="tab:orange", alpha=0.25, lw=0)


def panel(axis: Axes, convention: Convention) -> None:
    """World and body of one convention, and the numbers it has for the pose."""
    ground = np.array([(0, 0, 0), (4.6, 0, 0), (4.6, 4.2, 0), (0, 4.2, 0)], dtype=float)
    axis.fill(*on_paper(ground).T, color="0.93", lw=0)
    place, turn = np.array(POSE[:3]), vehicle_rotation(np.array([POSE]))
    foot = on_paper(np.array([place, [place[0], place[1], 0]]))
    axis.plot(*foot.T, ":", color="0.5", lw=1)
    fan(axis, turn, place)
    world, body = WORDS[convention.name]
    triad(axis, np.array([0.0, 0.0, 0.0]), np.array(convention.world, dtype=float), 1.2, world)
    ours = turn.as_matrix()[0] @ np.linalg.inv(np.array(convention.body, dtype=float))
    triad(axis, place, ours, 1.2, body)
    axis.plot(*on_paper(place[None])[0], "ko", ms=5)
    position, _ = convention.from_mitsonar(place[None], turn)
    pitch, roll, around = np.degrees(convention.angles_from_mitsonar(np.array([POSE[3:]])))[0] + 0.0
    x, y, z = position[0]
    axis.set_title(TITLES[convention.name], fontsize=12)
    output = f"x {x:.1f}  y {y:.1f}  z {z:.1f} m\nroll {roll:.0f}  pitch {pitch:.0f}  {convention.turn[0]} {around:.0f} deg"
    axis.text(0.5, -0.02, output, transform=axis.transAxes, ha="center", va="top", fontsize=11, family="monospace")
    axis.set(aspect="equal", xlim=(-0.7, 6.0), ylim=(-1.6, 2.9))
    axis.axis("off")


def drawn() -> Figure:
    """Draw the three conventions side by side."""
    figure, axes = plt.subplots(1, 3, figsize=(14, 4.4), layout="constrained")
    for axis, convention in zip(axes, CONVENTIONS.values(), strict=True):
        panel(axis, convention)
    figure.suptitle("One pose, three conventions: the sonar looks 25 deg below the horizon, 40 deg clockwise from north")
    return figure


def main() -> None:
    """Draw and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small picture")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "gallery" / "conventions.png")
    arguments = parser.parse_args()
    drawn().savefig(arguments.out, dpi=30 if arguments.quick else 80)


if __name__ == "__main__":
    main()
