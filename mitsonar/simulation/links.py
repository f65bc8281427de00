"""Delays of links: how long sound takes from the transmitter via a point to a moving receiver.

The equations are those of Almanza-Medina, sections 5.2.2 and 5.2.3. The functions accept NumPy arrays and Dr.Jit arrays. A
vector is a sequence of three arrays, or an array whose first axis holds the three coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.simulation.device import DeviceArray

__all__ = ["delay_exact", "delay_iterated", "delay_static", "dot", "length"]

Vector: TypeAlias = Sequence[DeviceArray] | NDArray[np.floating]
"""Three coordinates, each a NumPy or Dr.Jit array."""


def dot(a: Vector, b: Vector) -> DeviceArray:
    """Return the inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def length(a: Vector) -> DeviceArray:
    """Return the Euclidean length."""
    return dot(a, a) ** 0.5


def delay_static(to_point: Vector, from_receiver: Vector, sound_speed: float) -> DeviceArray:
    """Return the delay for a vehicle at rest (Almanza-Medina, eq. 5.1-5.4) [s].

    Args:
        to_point: vector from the transmitter to the point, P - A [m].
        from_receiver: vector from the receiver to the point, P - B, when the sound is sent [m].
        sound_speed: [m/s].
    """
    return (length(to_point) + length(from_receiver)) / sound_speed


def delay_iterated(
    to_point: Vector, from_receiver: Vector, velocity: Vector, sound_speed: float, times: int = 2
) -> DeviceArray:
    """Return the delay to a receiver that moves while sound travels, by iteration (Almanza-Medina, eq. 5.5-5.14) [s].

    Each round moves the receiver along its velocity for the previous delay. Almanza-Medina takes two rounds.
    """
    out = length(to_point) / sound_speed
    delay = out + length(from_receiver) / sound_speed
    for _ in range(times):
        moved = [q - v * delay for q, v in zip(from_receiver, velocity, strict=True)]
        delay = out + length(moved) / sound_speed
    return delay


def delay_exact(to_point: Vector, from_receiver: Vector, velocity: Vector, sound_speed: float) -> DeviceArray:
    """Return the exact delay to a receiver that moves while sound travels [s]: the limit of :func:`delay_iterated`.

    |P - B - v tau| = c (tau - tau_0) is a quadratic equation, whose larger root is the one after tau_0. Let s = tau - tau_0,
    and let q be the vector from the receiver to P when the sound is at P. Then (c^2 - v^2) s^2 + 2 q.v s - q^2 = 0. This
    form suffers no cancellation.
    """
    out = length(to_point) / sound_speed
    left = [q - v * out for q, v in zip(from_receiver, velocity, strict=True)]
    closing, speed2 = dot(left, velocity), sound_speed**2 - dot(velocity, velocity)
    return out + ((closing * closing + speed2 * dot(left, left)) ** 0.5 - closing) / speed2
