"""Impulse responses of points on level ground in plain NumPy, from Almanza-Medina, ch. 5, for tests of estimators."""

from __future__ import annotations

from typing import Any

import finufft
import numpy as np
from helpers import axes
from numpy.typing import ArrayLike, NDArray

from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.motion.composition import Motion, compose
from mitsonar.motion.pose import Pose
from mitsonar.records.responses import ImpulseResponses

Array = NDArray[np.float64]

CELL_M = 50 / 2048


class PointGround:
    """One scatterer in each cell of the level ground, anywhere in it; strength 0..1 times the cell's area.

    Each has its own complex Gaussian number besides, of variance 1, as the scatterers of the simulator have.

    Args:
        seed: of places, strengths and these numbers.
        half_m: the ground reaches so far to each side.
        cell_m: edge of a cell [m].
    """

    def __init__(self, seed: int, half_m: float = 14.0, cell_m: float = CELL_M) -> None:
        rng = np.random.default_rng(seed)
        line = np.arange(-half_m, half_m, cell_m)
        shift = rng.random(2) * cell_m
        grid = np.stack(np.meshgrid(line + shift[0], line + shift[1], indexing="ij"), axis=-1).reshape(-1, 2)
        self.points = np.column_stack([grid + rng.random(grid.shape) * cell_m, np.zeros(len(grid))])
        self.strength = rng.random(len(grid)) * cell_m**2
        self.zeta = rng.standard_normal((len(grid), 2)) @ [1, 1j] / np.sqrt(2)


def ping(
    sonar: ChannelSonar, ground: PointGround, pose: Pose, velocity: ArrayLike, *, keep: list[NDArray[Any]] | None = None
) -> NDArray[np.complex64]:
    """One ping's responses ``(receivers, taps)`` of a vehicle at ``velocity`` (world, m/s), by eq. 5.15 to 5.17.

    Args:
        sonar: the instrument.
        ground: the scatterers.
        pose: of the transmitter.
        velocity: over ground x, y, z.
        keep: for each receiver the points in its field of view; filled by the first ping, read by later ones.
    """
    turn = np.stack(axes(pose))
    place, speed = np.array(pose[:3]), np.asarray(velocity, dtype=float)
    result = []
    for number, receiver in enumerate(sonar.receivers):
        of = slice(None) if keep is None or len(keep) <= number else keep[number]
        points, strength, zeta = ground.points[of], ground.strength[of], ground.zeta[of]
        sent = points - place
        there = np.linalg.norm(sent, axis=1)
        received = sent - np.array(receiver.position) @ turn
        back = np.linalg.norm(received, axis=1)
        ahead, aside, above = sonar.field_of_view[receiver.name].axes @ turn @ (received / back[:, None]).T
        gain = sonar.field_of_view[receiver.name].sensitivity(ahead, aside, above)
        if keep is not None and len(keep) <= number:
            wide = sonar.field_of_view[receiver.name].model_copy(update={"taper": 0.0})
            wide = wide.model_copy(update={"across_deg": wide.across_deg + 6, "along_deg": wide.along_deg + 6})
            keep.append(np.flatnonzero(wide.sensitivity(ahead, aside, above) > 0))
        on = gain > 0
        tau = there[on] / sonar.sound_speed
        delay = tau + back[on] / sonar.sound_speed
        for _ in range(6):  # of 5.5 to 5.14, to convergence
            delay = tau + np.linalg.norm(received[on] - delay[:, None] * speed, axis=1) / sonar.sound_speed
        cosines = -sent[on, 2] / there[on] * -received[on, 2] / back[on]
        amplitude = gain[on] * np.sqrt(strength[on] * cosines) / (there[on] * back[on] if sonar.spreads else 1.0)
        result.append(_response(sonar, amplitude * zeta[on], delay))
    return np.array(result, dtype=np.complex64)


def _response(sonar: ChannelSonar, amplitude: NDArray[np.complex128], delay: Array) -> NDArray[np.complex128]:
    """The taps of echoes (eq. 5.15 to 5.17)."""
    count = sonar.taps
    phase = np.exp(-2j * np.pi * sonar.carrier_hz * delay)
    place = 2 * np.pi * np.mod(sonar.frequency_step_hz * delay + 0.5, 1) - np.pi
    spectrum = finufft.nufft1d1(place, amplitude * phase, count, eps=1e-9, isign=-1, nthreads=1)
    frequency = (np.arange(count) - count // 2) * sonar.frequency_step_hz
    return np.asarray(np.fft.ifft(np.fft.ifftshift(spectrum * sonar.raised_cosine(frequency))))


def run(
    sonar: ChannelSonar,
    ground: PointGround,
    motion: Motion,
    *,
    pings: int = 2,
    span_s: float = 0.05,
    height_m: float = 10.0,
    noise: float = 0.0,
    seed: int = 0,
    start: Pose | None = None,
    end: Pose | None = None,
) -> ImpulseResponses:
    """Pings at equal times over ``span_s``, in which the vehicle makes ``motion`` at constant speed.

    Args:
        sonar: the instrument.
        ground: the scatterers.
        motion: from the first to the last ping.
        pings: how many.
        span_s: from the first to the last [s].
        height_m: of the transmitter.
        noise: standard deviation of the noise of each tap.
        seed: of the noise.
        start: its pose at first; default: level, over the middle of the ground.
        end: and at last; default: after the motion.
    """
    start = start or Pose(0.0, 0.0, height_m)
    end = end or compose(start, motion)
    velocity = (np.array(end[:3]) - np.array(start[:3])) / span_s
    poses = np.linspace(start, end, pings)
    keep: list[NDArray[Any]] = []
    response = np.array([ping(sonar, ground, Pose(*pose), velocity, keep=keep) for pose in poses])
    rng = np.random.default_rng([seed, 1])
    response = response + noise * (rng.standard_normal((*response.shape, 2)) @ [1, 1j]) / np.sqrt(2)
    return ImpulseResponses(
        np.asarray(response, dtype=np.complex64),
        np.linspace(0, span_s, pings),
        sonar,
        poses=poses,
        height_m=np.full(pings, height_m),
    )
