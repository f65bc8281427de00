"""The range profile of level ground at any height: first return and fall-off of levels."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import directions
from mitsonar.motion.pose import Pose, vehicle_rotation

__all__ = ["FloorProfile"]

MANY = 256
"""Most beams, and rays of a beam, that are used."""

FARTHEST = 40.0
"""Largest range over height of the ground."""

Array = NDArray[np.float64]


class FloorProfile:
    """The range profile of level ground of constant reflectivity, as a curve over range / height.

    Levels are those of :func:`mitsonar.acoustics.levels.level`: a ray's cosine in the ``thesis`` model; cosine, solid
    angle, spreading and gain in ``physical``.

    Args:
        sonar: the instrument.
        pitch_rad: of it, > 0 looks down.
        roll_rad: of it.
        weight: of its rays in the profile ``(rays_per_beam, beams)``, rows from the highest elevation down; None: all alike.

    Raises:
        MitsonarError: no ray meets the ground.
    """

    def __init__(self, sonar: Sonar, pitch_rad: float, roll_rad: float = 0.0, weight: Array | None = None) -> None:
        self.sonar, self.pitch_rad, self.roll_rad = sonar, pitch_rad, roll_rad
        rows, beams = (np.unique(np.linspace(0, n - 1, min(n, MANY)).astype(int)) for n in (self._rows, sonar.beams))
        elevation = (0.5 - (rows + 0.5) / self._rows) * np.radians(sonar.elevation_fov_deg)
        bearing = sonar.bearing_rad[beams]
        rays = directions(sonar.bearing, bearing[None, :], elevation[:, None])
        down = -(vehicle_rotation(Pose(0, 0, 0, pitch_rad, roll_rad, 0)).apply(rays.reshape(-1, 3))[:, 2])
        part = np.ones(rays.shape[:2]) if weight is None else weight[np.ix_(rows, beams)]
        angle = elevation[:, None] if sonar.bearing == "azimuth" else bearing[None, :]
        part = part * (1.0 if sonar.model == "thesis" else np.cos(angle))
        meets = (down > 1 / FARTHEST) & (part.ravel() > 0)
        if not meets.any():
            raise MitsonarError(f"at a pitch of {np.degrees(pitch_rad):g} deg the sonar sees no level ground")
        order = np.argsort(-down[meets])
        self._down, self._part = down[meets][order], part.ravel()[meets][order]

    @property
    def _rows(self) -> int:
        return max(1, self.sonar.rays_per_beam)

    @cached_property
    def _along(self) -> tuple[Array, Array]:
        """Return the ranges of rays over the height, rising, and the sum of levels up to each."""
        away = 1 / self._down
        gain = 1.0 if self.sonar.model == "thesis" else away ** (self.sonar.gain_exponent - 2)
        return away, np.cumsum(self._part * self._down * gain)

    @property
    def nearest(self) -> float:
        """Return the range of the first return over the height."""
        return float(self._along[0][0])

    @property
    def farthest(self) -> float:
        """Return the range of the last return over the height."""
        return float(self._along[0][-1])

    def at(self, height_m: float | Array, edges_m: Array) -> Array:
        """Return the levels of the bins between edges ``(..., bins)`` at heights ``(...)`` [m]; their sum is 1 at most."""
        away, total = self._along
        ends = np.asarray(edges_m) / np.asarray(height_m, dtype=float)[..., None]
        return np.asarray(np.diff(np.interp(ends, away, total, left=0.0), axis=-1) / total[-1])
