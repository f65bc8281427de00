"""Responses of points along a path, summed directly, for tests of synthetic apertures."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.instruments.hydrophones import ChannelSonar, side_looking_array
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.records.responses import ImpulseResponses

C = 1500.0
HEIGHT = 8.0
ELEMENT = 0.1
BAND_HZ = 20e3


def array(receivers: int = 4, **keys: Any) -> ChannelSonar:
    return side_looking_array(
        ELEMENT, receivers, **{"carrier_hz": 100e3, "bandwidth_hz": BAND_HZ, "range_max": 25.0, **keys}
    )


def track(pings: int, step: float, every_s: float = 0.1, sway: ArrayLike = 0.0) -> Trajectory:
    """Pings along +y at 8 m, with a sway to starboard."""
    poses = np.zeros((pings, 6))
    poses[:, 0], poses[:, 1], poses[:, 2] = sway, np.arange(pings) * step, HEIGHT
    return Trajectory(poses, np.arange(pings, dtype=np.float64) * every_s)


def arrival(sent: NDArray[np.float64], back: NDArray[np.float64], velocity: NDArray[np.float64]) -> NDArray[np.float64]:
    """Delays of points ``(n, 3)`` from one place to another that moves: fixed-point iteration, by its definition."""
    out = np.linalg.norm(sent, axis=1)
    delay = (out + np.linalg.norm(back, axis=1)) / C
    for _ in range(12):
        delay = (out + np.linalg.norm(back - velocity * delay[:, None], axis=1)) / C
    return np.asarray(delay)


def responses_of(
    sonar: ChannelSonar, flown: Trajectory, points: ArrayLike, amplitude: ArrayLike, noise: float = 0.0, seed: int = 0
) -> ImpulseResponses:
    """Responses of points with these amplitudes at 1 m, spreading and patterns included, and white noise in the band."""
    from mitsonar.simulation.channel import impulse_response

    places, sizes = np.atleast_2d(np.asarray(points, float)), np.atleast_1d(np.asarray(amplitude))
    speed, turns = velocities(flown), vehicle_rotation(flown.poses).as_matrix()
    value = np.zeros((len(flown), len(sonar.receivers), sonar.taps), np.complex64)
    for ping, (pose, turn) in enumerate(zip(flown.poses, turns, strict=True)):
        for number, one in enumerate(sonar.receivers):
            swing = speed[ping, :3] + np.cross([0, 0, -speed[ping, 3]], one.position)
            sent, back = places - pose[:3], places - pose[:3] - turn @ np.array(one.position)
            r_out, r_back = np.linalg.norm(sent, axis=1), np.linalg.norm(back, axis=1)
            axes = one.field.axes @ turn.T
            gain = one.field.sensitivity(*(axes @ (sent / r_out[:, None]).T)) * one.field.sensitivity(
                *(axes @ (back / r_back[:, None]).T)
            )
            delay = arrival(sent, back, turn @ swing)
            loss = 10 ** (-sonar.absorption_db_per_m * delay * C / 20)
            value[ping, number] = impulse_response(delay, gain * loss * sizes / (r_out * r_back), sonar)
    if noise:
        rng = np.random.default_rng(seed)
        white = rng.normal(size=value.shape) + 1j * rng.normal(size=value.shape)
        band = np.abs(np.fft.fftfreq(sonar.taps, 1 / sonar.sampling_hz)) <= sonar.bandwidth_hz / 2
        white = np.fft.ifft(np.fft.fft(white, axis=2) * band, axis=2)
        value += (white * noise / np.sqrt(np.mean(np.abs(white) ** 2))).astype(np.complex64)
    height = np.full(len(flown), HEIGHT)
    return ImpulseResponses(value, flown.time_s, sonar, flown.poses, speed, height)
