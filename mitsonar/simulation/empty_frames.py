"""Describe frames without echoes: pose and view of the sonar, what its rays hit, and what may be wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import counted
from mitsonar.motion.pose import vehicle_rotation

__all__ = ["NEARLY_EMPTY", "angle_hint", "empty_frames", "percent", "view_of"]

NEARLY_EMPTY = 1e-4
"""Part of the pixels below which a frame counts as empty: 5 pixels of 512 x 96."""


def empty_frames(
    empty: int,
    frames: int,
    first: tuple[int, NDArray[np.float64]],
    rays: Sequence[int],
    window: tuple[float, float],
    found: tuple[float, float] | None,
    buried: str = "",
) -> str:
    """Describe empty frames in one sentence.

    Args:
        empty: number of frames with no echo, or almost none (:data:`NEARLY_EMPTY`).
        frames: number of all frames.
        first: number of the first empty frame, and its pose ``(6,)`` [m, rad].
        rays: numbers of that frame's rays that hit something inside the window, nearer, farther, and nothing.
        window: nearest and farthest range of the image [m].
        found: nearest and farthest return outside the window in that frame [m]; None where there is none.
        buried: that the sonar is below the ground or inside an object in that frame; empty where it is not.
    """
    number, pose = first
    hint = angle_hint(pose) or (buried and f"the sonar {buried}")
    if not any(rays[:3]):
        check = "check the pose (x, y, z in m; pitch > 0 looks down) and the scene's units"
        text = f"no ray hit anything in {counted(empty, 'frame')}: {check}; in frame {number} {view_of(pose)}"
        return f"{text}; {hint}" if hint else text
    inside, nearer, farther, missed = (percent(count / sum(rays)) for count in rays)
    beside = f" (returns at {found[0]:.3g}..{found[1]:.3g} m)" if found else ""
    check = "check the pose (m, pitch > 0 looks down), the window and the scene's units"
    return (
        f"empty: {empty} of {counted(frames, 'frame')}, frame {number} first: {inside} % of its rays meet something within "
        f"the window {window[0]:g}..{window[1]:g} m, {nearer} % nearer, {farther} % farther{beside}, {missed} % "
        f"nothing; {view_of(pose)}; {hint or check}"
    )


def percent(share: float) -> str:
    """Return a share in percent to two digits, without an exponent."""
    return "100" if share >= 0.995 else f"{100 * share:.2g}"


def view_of(pose: NDArray[np.float64]) -> str:
    """Describe position and view direction of a sonar in words."""
    forward = vehicle_rotation(pose).apply([0.0, 1.0, 0.0])[0]
    below = math.degrees(math.asin(float(np.clip(-forward[2], -1, 1))))
    level = (
        "along the horizon" if abs(below) < 0.05 else f"{abs(below):.3g} deg {'below' if below > 0 else 'above'} the horizon"
    )
    axis = ", ".join(f"{value:.2f}" for value in forward + 0.0)
    return f"the sonar is at ({', '.join(f'{value:g}' for value in pose[:3])}) m and looks {level}, along ({axis})"


def angle_hint(pose: NDArray[np.float64]) -> str:
    """Suggest what is wrong with the angles of an empty frame: their unit, or a view upwards; else return an empty text.

    Args:
        pose: x, y, z [m], pitch, roll, heading [rad].
    """
    angles = np.asarray(pose, dtype=float)[3:]
    largest = float(np.abs(angles).max())
    degrees = ", ".join(f"{value:.3g}" for value in np.degrees(angles))
    if largest > 2 * math.pi:
        given = ", ".join(f"{value:.3g}" for value in angles)
        return (
            f"its pitch, roll, heading are {given} rad, more than a full turn: were degrees given where radians are meant?"
        )
    if 0 < math.degrees(largest) <= 2 * math.pi:
        return f"its pitch, roll, heading are only {degrees} deg: were radians given where degrees are meant?"
    if angles[0] < -math.radians(1):
        return f"its pitch is {math.degrees(angles[0]):.3g} deg, and pitch > 0 looks down: check its sign"
    return ""
