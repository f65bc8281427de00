"""A DVL in a scene: ranges from its echoes, range rates from its motion and noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sounder import Sounder
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.records.soundings import DvlReadings, Soundings

__all__ = ["dvl_readings", "true_rates"]

Array = NDArray[np.float64]

RATES, SCALE = 0x64766C, 0x7363616C
"""Keep the draws of noise and of the scale apart."""


def dvl_readings(soundings: Soundings, seed: int = 0) -> DvlReadings:
    """Make a DVL's readings of its soundings.

    A rate is that of the beam's axis, times one constant scale, plus Gaussian noise of the beam's standard deviation. Beams
    without an echo have no rate. Fewer than three rates are no bottom lock.

    Args:
        soundings: of a dvl along its path.
        seed: of noise and scale; the noise is a function of (seed, ping, beam).

    Raises:
        MitsonarError: soundings of another kind of instrument.
    """
    sounder = soundings.sounder
    if sounder.kind != "dvl":
        raise MitsonarError(f"readings of a DVL need soundings of one: got a {sounder.kind}")
    true = true_rates(sounder, Trajectory(soundings.poses, soundings.time_s))
    scale = 1 + sounder.scale_std * np.random.default_rng([seed, SCALE]).normal()
    drawn = np.stack([np.random.default_rng([seed, RATES, ping]).normal(size=true.shape[1]) for ping in range(len(true))])
    return DvlReadings.of(soundings, scale * true + sounder.beam_std_m_s * drawn)


def true_rates(sounder: Sounder, flown: Trajectory) -> Array:
    """Compute the range rates of the beams over ground at rest ``(pings, beams)`` [m/s]: minus the velocity along them.

    A mount beside the vehicle's middle moves with its turn as well. The velocity at a pose is the mean of those of the
    steps before and after it.
    """
    step = velocities(flown)
    at_pose = np.concatenate([step[:1], (step[:-2] + step[1:-1]) / 2, step[-1:]]) if len(step) > 2 else step
    starboard, forward = sounder.mount_poses[:, :2].T
    turn = at_pose[:, 3:]
    lever = np.stack([turn * forward, -turn * starboard, np.zeros((len(at_pose), len(forward)))], axis=-1)
    return np.asarray(-np.einsum("pbi,bi->pb", at_pose[:, None, :3] + lever, sounder.axes))
