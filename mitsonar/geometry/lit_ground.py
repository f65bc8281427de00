"""The ground that a sonar lights: its outline moves with the sonar, and biases estimates of motion to zero."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mitsonar.geometry.attitude import Attitude
from mitsonar.geometry.ground_plane import GroundGeometry

__all__ = ["margin_of_light"]

MOSTLY = 0.5
"""Part of the window that must show lit ground for the outline of the light to be left in."""

NEARLY_ALL = 0.85
"""Part of the window beyond which the outline costs little to leave out, as in a grazing look at a hull."""

LIT = 0.9
"""Part of the field of view's elevation that is free of its outline."""


def margin_of_light(
    ground: GroundGeometry, attitude: Attitude, elevation_fov_deg: float, mostly: float = MOSTLY
) -> NDArray[np.float64] | None:
    """Compute how far inside the light the ground of each cell lies, where its outline must be left out of a match.

    That is where the ground is even, where most of the fan is not lit, and where nearly all of it is. Else rocks blur the
    outline, and those that rise beyond it help.

    Args:
        ground: of the cells, at the height of the attitude.
        attitude: of the sonar.
        elevation_fov_deg: of the sonar.
        mostly: part of the window that must be lit for the outline to be left in.

    Returns:
        Part of the half field of view ``(bins, beams)``, > 0 inside the light, -1 where a cell meets no ground; None: the
        outline is left in.
    """
    margin = _margin(ground, elevation_fov_deg)
    lit = (margin >= 0).mean()
    if attitude.even or lit < mostly:
        return margin
    if lit <= NEARLY_ALL:
        return None
    # tubes answer first and hide how high the sonar is over the plate that carries the outline
    return _margin(replace(ground, height_m=attitude.floor_m), elevation_fov_deg)


def _margin(ground: GroundGeometry, elevation_fov_deg: float) -> NDArray[np.float64]:
    """Return the margin of each cell ``(bins, beams)``."""
    with np.errstate(invalid="ignore"):
        elevation = np.abs(ground.elevation(ground.points))
    return np.asarray(np.nan_to_num(1 - elevation / (LIT * np.radians(elevation_fov_deg) / 2), nan=-1.0))
