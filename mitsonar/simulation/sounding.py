"""Sounders in a scene: all fans of a ping, and many pings, in one launch."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.levels import Detected, first_echoes, strongest_echoes
from mitsonar.acoustics.water import gain_of
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sounder import Sounder
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.soundings import Echogram, Soundings
from mitsonar.simulation.imaging import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.motion.bodies import Moving, MovingBodies

__all__ = ["SoundedPings", "SounderSimulator"]

FEW = 8
"""Pings of a batch of the model coherent, which renders fan by fan: so many are lost when a run is killed."""


class SoundedPings(NamedTuple):
    """A batch of consecutive pings.

    Attributes:
        first: number of the first.
        levels: of all fans ``(pings, channels, bins, beams)`` float32.
        height_m: of the first fan over what is straight below it ``(pings,)``; nan where there is nothing.
    """

    first: int
    levels: NDArray[np.float32]
    height_m: NDArray[np.float64]


class SounderSimulator:
    """Renders what the fans of a sounder receive in a scene.

    Args:
        scene: a Mitsuba scene.
        sounder: the instrument.
        moving: trajectories of bodies, as of :class:`mitsonar.Simulator`.
        rays_per_launch: bound of a launch's rays and of its image cells.

    Raises:
        MitsonarError: as :class:`mitsonar.Simulator` does.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sounder: Sounder,
        *,
        moving: Moving | MovingBodies | None = None,
        rays_per_launch: int = 2**23,
    ) -> None:
        self.sounder = sounder
        self.simulator = Simulator(scene, sounder.fan, moving=moving, rays_per_launch=rays_per_launch)
        self.variant = self.simulator.variant
        self.noise = self._noise()

    def __repr__(self) -> str:
        return f"SounderSimulator({self.sounder})"

    @property
    def notes(self) -> list[str]:
        """Return what a user should know about the scene and the instrument."""
        return self.simulator.notes

    def pings(self, poses: ArrayLike, *, first: int = 0, time_s: ArrayLike | None = None) -> Iterator[SoundedPings]:
        """Levels of consecutive pings of the vehicle, in batches; every fan of every ping draws its own jitter.

        Args:
            poses: of the vehicle ``(pings, 6)`` x, y, z [m], pitch, roll, heading [rad].
            first: number of the first ping.
            time_s: of the pings ``(pings,)``, where bodies move [s]; default: their number / ``frame_rate_hz``.
        """
        table = np.atleast_2d(np.asarray(poses, dtype=float))
        rate = self.sounder.fan.frame_rate_hz
        time = (first + np.arange(len(table))) / rate if time_s is None else np.asarray(time_s, dtype=float)
        fans = len(self.sounder.channels)
        together = FEW if self.simulator.coherent is not None else max(1, self.simulator.pings_per_launch // fans)
        for start in range(0, len(table), together):
            own = self.sounder.fan_poses(table[start : start + together])
            now = np.repeat(time[start : start + together], fans)
            rendered = list(self.simulator.pings(own.reshape(-1, 6), first=(first + start) * fans, time_s=now))
            levels = np.concatenate([part.levels for part in rendered])
            height_m = np.concatenate([part.height_m for part in rendered])[::fans]
            yield SoundedPings(first + start, levels.reshape(len(own), fans, *levels.shape[1:]), height_m)

    def detect(self, levels: NDArray[np.float32]) -> Detected:
        """Detect an echo in each beam of levels ``(pings, channels, bins, beams)``: arrays ``(pings, channels, beams)``."""
        find = first_echoes if self.sounder.kind == "altimeter" else strongest_echoes
        limits = {"below_db": self.sounder.below_db, "above_noise_db": self.sounder.above_noise_db}
        return find(np.moveaxis(levels, 2, -1).astype(float), self.sounder.fan.range_m, self.noise, **limits)

    def echogram(self, flown: Trajectory) -> Echogram:
        """Render all pings of an instrument of one beam a fan.

        Raises:
            MitsonarError: several beams a fan.
        """
        if self.sounder.fan.beams > 1:
            raise MitsonarError(f"an echogram has one beam a fan: got {self.sounder.fan.beams}; use soundings()")
        batches = list(self.pings(flown.poses, time_s=flown.time_s))
        levels = np.concatenate([batch.levels[..., 0] for batch in batches])
        height_m = np.concatenate([batch.height_m for batch in batches])
        return Echogram(flown.time_s, flown.poses, self.sounder, levels, height_m)

    def soundings(self, flown: Trajectory) -> Soundings:
        """Render all pings and detect an echo in each beam."""
        found = [self.detect(batch.levels) for batch in self.pings(flown.poses, time_s=flown.time_s)]
        joined = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return Soundings(flown.time_s, flown.poses, self.sounder, *joined)

    def _noise(self) -> NDArray[np.float64]:
        """Return the mean level of noise and volume ``(bins,)``, after the gain; 0 where there is none."""
        fan, coherent = self.sounder.fan, self.simulator.coherent
        if coherent is not None:
            return np.asarray(sum(coherent.noise_powers()) * coherent.gain, dtype=np.float64)
        if fan.noise_level_db is None:
            return np.zeros(fan.range_bins)
        return np.asarray(10 ** ((fan.noise_level_db - fan.source_level_db) / 10) * gain_of(fan), dtype=np.float64)
