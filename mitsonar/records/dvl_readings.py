"""Readings of a DVL: range rates of its beams, the velocity and altitude that follow from them, and when they are lost."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mitsonar.instruments.sounder import FEWEST_BEAMS
from mitsonar.io.files import write_whole
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.records.soundings import Soundings

__all__ = ["DvlReadings", "velocity_of"]

Array = NDArray[np.float64]

AXES = ("starboard", "forward", "up")


@dataclass(frozen=True)
class DvlReadings:
    """Readings of consecutive pings; nan where the bottom lock is lost.

    Attributes:
        soundings: ranges of the beams.
        range_rate: of the beams, growing ranges positive ``(pings, beams)`` [m/s]; nan without an echo.
        velocity: of the vehicle in its own axes, starboard, forward, up ``(pings, 3)`` [m/s].
        covariance: of the velocity ``(pings, 3, 3)``, from the noise of a range rate.
    """

    soundings: Soundings
    range_rate: Array
    velocity: Array
    covariance: Array

    @classmethod
    def of(cls, soundings: Soundings, range_rate: Array) -> Self:
        """Compute velocities from range rates ``(pings, beams)``; beams without an echo do not count."""
        sounder = soundings.sounder
        heard = np.where(soundings.found[..., 0], range_rate, np.nan)
        return cls(soundings, heard, *velocity_of(heard, sounder.axes, sounder.beam_std_m_s))

    @property
    def locked(self) -> NDArray[np.bool_]:
        """Return in which pings the velocity is known ``(pings,)``."""
        return np.asarray(np.isfinite(self.velocity).all(axis=1), dtype=np.bool_)

    @property
    def altitude_m(self) -> Array:
        """Return the height of the vehicle over the mean of the points that the beams meet ``(pings,)`` [m]."""
        depth = self.soundings.poses[:, None, 2] - self.soundings.points()[:, :, 0, 2]
        there = np.isfinite(depth)
        return np.where(there.any(axis=1), np.nansum(depth, axis=1) / np.maximum(there.sum(axis=1), 1), np.nan)

    def level(self) -> tuple[Array, Array]:
        """Return velocities and covariances in level axes: sideways, forward, up ``(pings, 3)`` and ``(pings, 3, 3)``.

        Pitch and roll are those of the poses, as a DVL with an attitude sensor has them.
        """
        upright = self.soundings.poses.copy()
        upright[:, 3:5] = 0
        turn = (vehicle_rotation(upright).inv() * vehicle_rotation(self.soundings.poses)).as_matrix()
        return np.einsum("pij,pj->pi", turn, self.velocity), turn @ self.covariance @ turn.swapaxes(1, 2)

    def save(self, path: str | Path) -> None:
        """Write a CSV file, whole or absent; cells are empty where nothing is known."""
        beams = len(self.soundings.sounder.channels)
        std = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        names = [f"{axis}_m_s" for axis in AXES] + [f"{axis}_std_m_s" for axis in AXES] + ["altitude_m"]
        names += [f"range_{k}_m" for k in range(1, beams + 1)] + [f"range_rate_{k}_m_s" for k in range(1, beams + 1)]
        table = np.column_stack([self.velocity, std, self.altitude_m, self.soundings.range_m[..., 0], self.range_rate])
        text = io.StringIO()
        text.write(",".join(["time_s", "locked", *names]) + "\n")
        for time_s, locked, row in zip(self.soundings.time_s, self.locked, table, strict=True):
            cells = ["" if np.isnan(value) else f"{value:.6f}" for value in row]
            text.write(",".join([f"{time_s:.9f}", str(int(locked)), *cells]) + "\n")
        write_whole(Path(path), text.getvalue().encode())


def velocity_of(range_rate: Array, axes: Array, std_m_s: float) -> tuple[Array, Array]:
    """Solve for velocities by least squares: each rate is minus the velocity along its beam.

    Args:
        range_rate: of the beams ``(pings, beams)`` [m/s], nan where there is none.
        axes: of the beams ``(beams, 3)``, unit vectors.
        std_m_s: noise of a rate.

    Returns:
        Velocities ``(pings, 3)`` and covariances ``(pings, 3, 3)``, nan with fewer than three beams, or beams in a plane.
    """
    heard = np.isfinite(range_rate)
    weight = heard.astype(float)
    information = np.einsum("pb,bi,bj->pij", weight, axes, axes)
    right = -np.einsum("pb,bi->pi", np.where(heard, range_rate, 0), axes)
    known = (heard.sum(axis=1) >= FEWEST_BEAMS) & (np.linalg.cond(information) < 1e6)
    inverse = np.full(information.shape, np.nan)
    inverse[known] = np.linalg.inv(information[known])
    return np.einsum("pij,pj->pi", inverse, right), inverse * std_m_s**2
