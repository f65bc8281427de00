"""The geometry of level ground as networks read it: at a few nodes of an image, in bins and beams."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.geometry.ground import Attitude, GroundGeometry, margin_of_light, nearest_known
from mitsonar.instruments.sonar import Bearing
from mitsonar.records.frames import SonarFrames

__all__ = ["NODES", "ground_at", "ground_of", "light_of"]

NODES = (17, 9)
"""Nodes along range and bearing. The geometry is smooth: linear interpolation between them errs by less than 1e-3 cells."""

RISE = 0.05
"""Part of the height by which the ground is raised and lowered to compute the derivative by relief."""


def ground_at(
    range_m: ArrayLike, bearing_rad: ArrayLike, bearing: Bearing, height_m: float, pitch_rad: float, roll_rad: float = 0.0
) -> dict[str, NDArray[np.float32]]:
    """Compute where the nodes of an image lie on the ground, and how they move with the sonar.

    Args:
        range_m: of the bins ``(bins,)`` [m], rising.
        bearing_rad: of the beams ``(beams,)`` [rad], rising.
        bearing: the kind of that angle.
        height_m: of the sonar over the ground [m].
        pitch_rad: > 0 tilts the sonar down.
        roll_rad: > 0 puts starboard down.

    Returns:
        By name, float32: ``points (R, C, 2)`` [m], ``turn (3, 3)``, ``height ()`` [m], ``place (2, R, C)`` range [m] and
        bearing [rad] of the nodes, ``cell (2, R, C)`` bin [m] and beam [rad] there, ``derivative (2, 3, R, C)`` in bins and
        beams by motion [m, m, rad], ``by_relief (2, 3, R, C)`` its change with relief above the ground, by parts of the
        height, ``cone ()``: 1 where the bearing is the angle of a cone.
    """
    axes = [np.asarray(values, dtype=float) for values in (range_m, bearing_rad)]
    index = [np.linspace(0, len(axis) - 1, count) for axis, count in zip(axes, NODES, strict=True)]
    nodes = [np.interp(at, np.arange(len(axis)), axis) for at, axis in zip(index, axes, strict=True)]
    cell = [np.interp(at, np.arange(len(axis)), np.gradient(axis)) for at, axis in zip(index, axes, strict=True)]
    geometry = GroundGeometry(nodes[0], nodes[1], bearing, height_m, pitch_rad, roll_rad)
    row, column = nearest_known(np.asarray(np.isfinite(geometry.points).all(axis=-1)))
    points = np.nan_to_num(geometry.points[row, column])
    cells = np.stack(np.meshgrid(*cell, indexing="ij"))

    def derivative(part: float) -> NDArray[np.float64]:
        """Compute the derivative by motion, over ground at this part of the height."""
        own = GroundGeometry(nodes[0], nodes[1], bearing, part * height_m, pitch_rad, roll_rad)
        values = np.nan_to_num(own.derivative[row, column]) / np.moveaxis(cells, 0, -1)[..., None]
        return np.moveaxis(values, (2, 3), (0, 1))

    higher, lower = (derivative(1 - sign * RISE) for sign in (1, -1))
    table = {
        "points": points,
        "turn": geometry.turn,
        "height": np.array(height_m),
        "place": np.stack(np.broadcast_arrays(nodes[0][row], nodes[1][column])),
        "cell": cells,
        "derivative": derivative(1.0),
        "by_relief": (higher - lower) / (2 * RISE),
        "cone": np.array(float(bearing == "cone")),
    }
    return {name: np.array(values, dtype=np.float32) for name, values in table.items()}


def ground_of(frames: SonarFrames, attitude: Attitude) -> dict[str, NDArray[np.float32]]:
    """Compute the geometry of frames at their attitude over the ground; see :func:`ground_at`.

    Of two frames at known attitudes, ``points`` are those of the first frame, ``turn`` and ``height`` those of the second.
    """
    axes = frames.range_m, frames.bearing_rad, frames.sonar.bearing
    table = ground_at(*axes, attitude.height_m, attitude.pitch_rad, attitude.roll_rad)
    if len(attitude.apart) == 2:
        first, second = (ground_at(*axes, *attitude.of_frame(number)) for number in range(2))
        table |= {"points": first["points"], "place": first["place"], "turn": second["turn"], "height": second["height"]}
    return table


def light_of(frames: SonarFrames, attitude: Attitude) -> dict[str, NDArray[np.float32]]:
    """Compute how far inside the light the ground of each node lies, as ``lit (R, C)``; empty where its outline is left in.

    See :func:`mitsonar.geometry.ground.margin_of_light`. It stays in where
    little of the window is lit, as in training, which does without this table.
    """
    range_m, bearing_rad = (
        np.interp(np.linspace(0, len(axis) - 1, count), np.arange(len(axis)), axis)
        for axis, count in zip((frames.range_m, frames.bearing_rad), NODES, strict=True)
    )
    sonar, pitch_rad, roll_rad = frames.sonar, attitude.pitch_rad, attitude.roll_rad
    ground = GroundGeometry(range_m, bearing_rad, sonar.bearing, attitude.height_m, pitch_rad, roll_rad)
    margin = margin_of_light(ground, attitude, sonar.elevation_fov_deg, mostly=0.0)
    return {} if margin is None else {"lit": margin.astype(np.float32)}
