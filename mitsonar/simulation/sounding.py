"""Sounder simulation: what sounders and DVLs measure in a scene, with many pings and all their fans in one launch."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.levels import Detected, first_echoes, strongest_echoes
from mitsonar.acoustics.water import gain_of
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sounder import Sounder
from mitsonar.motion.sensors import Readings, VehicleSensors
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.records.soundings import DvlReadings, Echogram, Soundings
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.motion.bodies import Moving, MovingBodies

__all__ = ["SoundedPings", "SounderSimulator", "dvl_readings", "dvl_sensors", "true_rates"]


FEW = 8
"""Number of pings per batch in the model ``coherent``, which renders fan by fan: as many are lost if a run is killed."""


class SoundedPings(NamedTuple):
    """A batch of consecutive pings.

    Attributes:
        first: number of the first ping.
        levels: levels of all fans ``(pings, channels, bins, beams)`` float32.
        height_m: height of the first fan above the surface straight below it ``(pings,)`` [m]; nan if there is none.
    """

    first: int
    levels: NDArray[np.float32]
    height_m: NDArray[np.float64]


class SounderSimulator:
    """Simulator of the echoes that the fans of a sounder receive in a scene.

    Args:
        scene: a Mitsuba scene.
        sounder: the instrument.
        moving: trajectories of bodies, as in :class:`mitsonar.Simulator`.
        rays_per_launch: upper bound of the rays, and of the image cells, in one launch.

    Raises:
        MitsonarError: as in :class:`mitsonar.Simulator`.
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
        """Return notes to the user about the scene and the instrument."""
        return self.simulator.notes

    def pings(self, poses: ArrayLike, *, first: int = 0, time_s: ArrayLike | None = None) -> Iterator[SoundedPings]:
        """Yield the levels of consecutive pings of the vehicle, in batches; each fan of each ping has independent jitter.

        Args:
            poses: poses of the vehicle ``(pings, 6)`` x, y, z [m], pitch, roll, heading [rad].
            first: number of the first ping.
            time_s: times of the pings ``(pings,)``, used if bodies move [s]; default: their number / ``frame_rate_hz``.
        """
        table = np.atleast_2d(np.asarray(poses, dtype=float))
        rate = self.sounder.fan.frame_rate_hz
        time = (first + np.arange(len(table))) / rate if time_s is None else np.asarray(time_s, dtype=float)
        fans = len(self.sounder.channels)
        batch = FEW if self.sounder.fan.model == "coherent" else max(1, self.simulator.model.pings_per_launch // fans)
        for start in range(0, len(table), batch):
            fan_poses = self.sounder.fan_poses(table[start : start + batch])
            fan_times_s = np.repeat(time[start : start + batch], fans)
            rendered = list(self.simulator.pings(fan_poses.reshape(-1, 6), first=(first + start) * fans, time_s=fan_times_s))
            levels = np.concatenate([part.levels for part in rendered])
            height_m = np.concatenate([part.height_m for part in rendered])[::fans]
            yield SoundedPings(first + start, levels.reshape(len(fan_poses), fans, *levels.shape[1:]), height_m)

    def detect(self, levels: NDArray[np.float32]) -> Detected:
        """Detect an echo in each beam of levels ``(pings, channels, bins, beams)``; return ``(pings, channels, beams)``."""
        find = first_echoes if self.sounder.kind == "altimeter" else strongest_echoes
        limits = {"below_db": self.sounder.below_db, "above_noise_db": self.sounder.above_noise_db}
        return find(np.moveaxis(levels, 2, -1).astype(float), self.sounder.fan.range_m, self.noise, **limits)

    def echogram(self, flown: Trajectory) -> Echogram:
        """Render all pings of an instrument with one beam per fan.

        Raises:
            MitsonarError: the fans have several beams.
        """
        if self.sounder.fan.beams > 1:
            raise MitsonarError(f"an echogram has one beam a fan: got {self.sounder.fan.beams}; use soundings()")
        batches = list(self.pings(flown.poses, time_s=flown.time_s))
        levels = np.concatenate([batch.levels[..., 0] for batch in batches])
        height_m = np.concatenate([batch.height_m for batch in batches])
        return Echogram(flown.time_s, flown.poses, self.sounder, levels, height_m)

    def soundings(self, flown: Trajectory) -> Soundings:
        """Render all pings and detect an echo in each beam."""
        detected = [self.detect(batch.levels) for batch in self.pings(flown.poses, time_s=flown.time_s)]
        joined = (np.concatenate(parts) for parts in zip(*detected, strict=True))
        return Soundings(flown.time_s, flown.poses, self.sounder, *joined)

    def _noise(self) -> NDArray[np.float64]:
        """Return the mean level of noise, volume and the detector's offset after the gain ``(bins,)``; 0 without them."""
        fan, imager = self.sounder.fan, self.simulator.model.imager
        if imager is not None:
            power = sum(imager.receiver.noise_powers()) + imager.receiver.offset.mean()
            return np.asarray(power * imager.gain, dtype=np.float64)
        if fan.noise_level_db is None:
            return np.zeros(fan.range_bins)
        return np.asarray(10 ** ((fan.noise_level_db - fan.source_level_db) / 10) * gain_of(fan), dtype=np.float64)


# ---------------- DVL readings


Array = NDArray[np.float64]

RATES, SCALE = 0x64766C, 0x7363616C
"""Keys that separate the random numbers of the noise from that of the scale."""


def dvl_readings(soundings: Soundings, seed: int = 0) -> DvlReadings:
    """Simulate a DVL's readings from its soundings.

    Ranges come from the echoes, range rates from the motion. A rate is that along the beam's axis, times a constant scale,
    plus Gaussian noise with the beam's standard deviation. Beams without an echo have no rate. Fewer than three rates mean
    no bottom lock.

    Args:
        soundings: soundings of a DVL along its trajectory.
        seed: seed of noise and scale; the noise is a function of (seed, ping, beam).

    Raises:
        MitsonarError: the soundings are of another kind of instrument.
    """
    sounder = soundings.sounder
    if sounder.kind != "dvl":
        raise MitsonarError(f"readings of a DVL need soundings of a DVL: got those of a {sounder.kind}")
    true = true_rates(sounder, Trajectory(soundings.poses, soundings.time_s))
    scale = 1 + sounder.scale_std * np.random.default_rng([seed, SCALE]).normal()
    drawn = np.stack([np.random.default_rng([seed, RATES, ping]).normal(size=true.shape[1]) for ping in range(len(true))])
    return DvlReadings.of(soundings, scale * true + sounder.beam_std_m_s * drawn)


def true_rates(sounder: Sounder, flown: Trajectory) -> Array:
    """Compute the range rates of the beams over ground at rest ``(pings, beams)`` [m/s]: minus the velocity along them.

    A mount off the vehicle's origin also moves with the vehicle's turn. The velocity at a pose is the mean of those of the
    steps before and after it.
    """
    step = velocities(flown)
    at_pose = np.concatenate([step[:1], (step[:-2] + step[1:-1]) / 2, step[-1:]]) if len(step) > 2 else step
    starboard, forward = sounder.mount_poses[:, :2].T
    turn = at_pose[:, 3:]
    lever = np.stack([turn * forward, -turn * starboard, np.zeros((len(at_pose), len(forward)))], axis=-1)
    return np.asarray(-np.einsum("pbi,bi->pb", at_pose[:, None, :3] + lever, sounder.axes))


# ---------------- DVL velocities for odometry


def dvl_sensors(readings: DvlReadings) -> VehicleSensors:
    """Return sideways and forward velocities in level axes, with standard deviations, of the pings with bottom lock.

    The readings have the form that odometry reads. The correlation of both velocities is neglected; it is 0 as long as all
    beams of a symmetric DVL have an echo.

    Raises:
        MitsonarError: no ping has bottom lock.
    """
    locked = readings.locked
    if not locked.any():
        raise MitsonarError("the DVL has no bottom lock in any ping: come nearer to the ground, or raise range_max")
    velocity, covariance = readings.level()
    time_s, std = readings.soundings.time_s[locked], np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))[locked]
    sideways, forward = (Readings(time_s, velocity[locked, axis], std[:, axis]) for axis in (0, 1))
    return VehicleSensors(sideways=sideways, forward=forward, name="the DVL")
