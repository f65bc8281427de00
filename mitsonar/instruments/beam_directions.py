"""Directions of beams in the sonar's frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.instruments.imaging_sonar import Bearing

__all__ = ["directions"]


def directions(bearing: Bearing, bearing_rad: ArrayLike, elevation_rad: ArrayLike) -> NDArray[np.float64]:
    """Compute unit vectors ``(..., 3)`` as (starboard, forward, up) of the sonar's frame, for both kinds of bearing.

    Args:
        bearing: ``azimuth``, or ``cone``, the angle that a line array measures.
        bearing_rad: of the directions [rad].
        elevation_rad: of the directions [rad]; the two are broadcast.
    """
    b, e = np.broadcast_arrays(np.asarray(bearing_rad, dtype=float), np.asarray(elevation_rad, dtype=float))
    if bearing == "azimuth":
        return np.stack([np.cos(e) * np.sin(b), np.cos(e) * np.cos(b), np.sin(e)], axis=-1)
    return np.stack([np.sin(b), np.cos(b) * np.cos(e), np.cos(b) * np.sin(e)], axis=-1)
