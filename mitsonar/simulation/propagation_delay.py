"""How long sound takes from transmitter to receiver by way of a point, while the vehicle moves (thesis 5.2.2, 5.2.3).

The functions work on NumPy arrays and on Dr.Jit arrays alike; vectors are sequences of three.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

__all__ = ["delay_exact", "delay_iterated", "delay_static", "dot", "length"]

Vector = Sequence[Any]


def dot(a: Vector, b: Vector) -> Any:
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def length(a: Vector) -> Any:
    """Length."""
    return dot(a, a) ** 0.5


def delay_static(to_point: Vector, from_receiver: Vector, sound_speed: float) -> Any:
    """Delay of a vehicle that stands still (Almanza-Medina, eq. 5.1-5.4) [s].

    Args:
        to_point: from the transmitter to the point, P - A [m].
        from_receiver: from the receiver to the point, P - B, both when the sound is sent [m].
        sound_speed: [m/s].
    """
    return (length(to_point) + length(from_receiver)) / sound_speed


def delay_iterated(to_point: Vector, from_receiver: Vector, velocity: Vector, sound_speed: float, times: int = 2) -> Any:
    """Delay of a receiver that moves while sound travels, by the thesis's iteration (eq. 5.5-5.14) [s].

    Each round moves the receiver by the delay found before; two rounds are what the thesis takes.
    """
    out = length(to_point) / sound_speed
    delay = out + length(from_receiver) / sound_speed
    for _ in range(times):
        moved = [q - v * delay for q, v in zip(from_receiver, velocity, strict=True)]
        delay = out + length(moved) / sound_speed
    return delay


def delay_exact(to_point: Vector, from_receiver: Vector, velocity: Vector, sound_speed: float) -> Any:
    """Delay of a receiver that moves while sound travels, exactly [s]: what :func:`delay_iterated` tends to.

    |P - B - v tau| = c (tau - tau_0) is a quadratic equation; its larger root is the one after tau_0. In s = tau - tau_0 and
    with q, what is left of the way when the sound is at P, (c^2 - v^2) s^2 + 2 q.v s - q^2 = 0: nothing cancels.
    """
    out = length(to_point) / sound_speed
    left = [q - v * out for q, v in zip(from_receiver, velocity, strict=True)]
    closing, speed2 = dot(left, velocity), sound_speed**2 - dot(velocity, velocity)
    return out + ((closing * closing + speed2 * dot(left, left)) ** 0.5 - closing) / speed2
