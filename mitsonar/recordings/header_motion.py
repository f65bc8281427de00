"""What the headers of Sound Metrics' sonars tell of their motion: attitude by the compass, height, place on the earth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsonar.recordings.ping_file import Header

__all__ = ["EARTH_M", "MOTION", "attitude_of", "height_of", "poses_of"]

Array = NDArray[np.float64]

MOTION = {
    "depth_m": (128, "<f4"), "altitude_m": (132, "<f4"), "heading_deg": (160, "<f4"), "pitch_deg": (164, "<f4"),
    "roll_deg": (168, "<f4"), "latitude_deg": (172, "<f8"), "longitude_deg": (180, "<f8"),
}  # fmt: skip
"""Fields of a frame's header in DIDSON and ARIS files alike: offset [bytes] and type."""

EARTH_M = 6_371_008.8
"""Mean radius of the earth [m]."""

DEEPEST_M = 1.2e4
HIGHEST_M = 1e4
"""What is believed of a depth and of a height over the ground [m]."""


def attitude_of(headers: Header) -> Array | None:
    """Return pitch, roll, heading ``(frames, 3)`` [rad] by the compass; None where it tells nothing, nan where it cannot be.

    The compass counts upward pitch as positive, poses count downward pitch so.
    """
    degrees = np.stack([-headers["pitch_deg"], headers["roll_deg"], headers["heading_deg"]], axis=1).astype(float)
    attitude = np.radians(np.where(np.abs(degrees) <= 360, degrees, np.nan))
    return attitude if np.any(attitude) else None


def height_of(headers: Header) -> Array | None:
    """Return the height over the ground ``(frames,)`` [m] where the vehicle filled it in; None where it did not."""
    altitude_m = headers["altitude_m"].astype(float)
    known = np.isfinite(altitude_m) & (altitude_m > 0) & (altitude_m < HIGHEST_M)
    return np.where(known, altitude_m, np.nan) if known.any() else None


def poses_of(headers: Header, attitude_rad: Array | None) -> Array | None:
    """Return poses ``(frames, 6)`` by latitude and longitude; None where a frame lacks them, or its attitude."""
    latitude, longitude = np.radians(headers["latitude_deg"]), np.radians(headers["longitude_deg"])
    known = (np.abs(latitude) < np.pi / 2) & (np.abs(longitude) <= np.pi) & ((latitude != 0) | (longitude != 0))
    if attitude_rad is None or not known.all() or not np.isfinite(attitude_rad).all():
        return None
    depth = headers["depth_m"].astype(float)
    east = (longitude - longitude[0]) * np.cos(latitude[0]) * EARTH_M
    north = (latitude - latitude[0]) * EARTH_M
    return np.column_stack([east, north, -np.where(np.abs(depth) < DEEPEST_M, depth, 0.0), attitude_rad])
