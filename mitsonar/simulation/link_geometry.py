"""Link geometry: where transmitter and receiver are in one ping, and what echoes they exchange via points.

Echoes are Dr.Jit arrays of one launch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.instruments.hydrophones import PADDING, ChannelSonar, FieldOfView, Maths
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.simulation.device import DeviceArray
from mitsonar.simulation.tracing import hidden

__all__ = ["LINK", "EchoBatch", "Leg", "LinkGeometry", "ScatteringPoints", "link_table"]

LINK = 30
"""Length of :func:`link_table`."""

DRJIT = Maths(dr.asin, dr.atan2, dr.cos, dr.clip, dr.select)


class ScatteringPoints(NamedTuple):
    """Points on surfaces.

    Attributes:
        at: position [m].
        exact: position in double precision, three arrays [m].
        normal: unit normal of the surface.
    """

    at: DeviceArray
    exact: list[DeviceArray]
    normal: DeviceArray


class Leg(NamedTuple):
    """Unit direction from transmitter or receiver (or its image) to points, and distance [m]."""

    u: DeviceArray
    length: DeviceArray


@dataclass
class EchoBatch:
    """Echoes as unevaluated Dr.Jit arrays, one value for each point.

    Attributes:
        delay: delay of the echo [s].
        amplitude: magnitude of the echo.
        phase: phase of the scatterer, without that of the delay [rad]; a single 0 in the model ``rays``.
        doppler: Doppler shift of the carrier [Hz].
        counts: whether there is an echo within ``range_max``.
        beyond: whether there is an echo from beyond ``range_max``.
        turn: phase of the delay at the finest frequency step, -pi..pi, for the transform [rad].
        real, imag: complex amplitude, with the phases of the scatterer and the carrier.
    """

    delay: DeviceArray
    amplitude: DeviceArray
    phase: DeviceArray
    doppler: DeviceArray
    counts: DeviceArray
    beyond: DeviceArray
    turn: DeviceArray
    real: DeviceArray
    imag: DeviceArray


def link_table(
    sonar: ChannelSonar, receiver: int, pose: NDArray[np.float64], velocity: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the geometry of one ping in the world ``(30,)``.

    The table holds the positions of transmitter and receiver [m] and their velocities [m/s], three numbers each, then the
    axes of the receiver's and of the transmitter's field of view, nine numbers each.
    """
    turn = vehicle_rotation(pose).as_matrix()[0]
    one = sonar.receivers[receiver]
    offset = np.array(one.position)
    swing = velocity[:3] + np.cross([0.0, 0.0, -velocity[3]], offset)
    axes = [field.axes @ turn.T for field in (one.field, sonar.transmitter)]
    places, velocities = (pose[:3], pose[:3] + turn @ offset), (turn @ velocity[:3], turn @ swing)
    return np.concatenate([*places, *velocities, *(each.ravel() for each in axes)])


class LinkGeometry:
    """Geometry between transmitter and receiver in one ping, on the device.

    Quantities that affect the phase are float64.

    Args:
        sonar: the instrument.
        receiver: index of the receiver.
        table: as returned by :func:`link_table`.
    """

    def __init__(self, sonar: ChannelSonar, receiver: int, table: mi.Float64) -> None:
        self.sonar = sonar
        self.numbers = [dr.gather(mi.Float64, table, mi.UInt32(k)) for k in range(self.size)]
        dr.eval(self.numbers)  # read once, not once per point
        self.listens: FieldOfView = sonar.field_of_view[sonar.receivers[receiver].name]
        self.sends: FieldOfView = sonar.transmitter

    @property
    def size(self) -> int:
        """Return the length of the table."""
        return LINK

    def vector(self, start: int) -> list[DeviceArray]:
        """Return three consecutive numbers of the table."""
        return self.numbers[start : start + 3]

    @property
    def sent_from(self) -> list[DeviceArray]:
        """Return the position of the transmitter [m]."""
        return self.vector(0)

    @property
    def velocity(self) -> list[DeviceArray]:
        """Return the velocity of the receiver [m/s]."""
        return self.vector(9)

    def axes(self, which: int) -> list[mi.Vector3f]:
        """Return the axes of the receiver's field of view (0) or the transmitter's (1)."""
        return [mi.Vector3f(*self.vector(12 + 9 * which + 3 * k)) for k in range(3)]

    def to_point(self, point: list[DeviceArray]) -> tuple[list[DeviceArray], list[DeviceArray]]:
        """Return the vectors from the transmitter and from the receiver to points in the world [m]."""
        sent, received = ([p - a for p, a in zip(point, self.vector(start), strict=True)] for start in (0, 3))
        return sent, received

    def sensitivity(self, sent: DeviceArray, received: DeviceArray) -> DeviceArray:
        """Return the combined sensitivity of transmitter and receiver, given unit directions to the points."""
        ahead, aside, above = (dr.dot(axis, received) for axis in self.axes(0))
        both = self.listens.sensitivity(ahead, aside, above, DRJIT)
        if self.sends.shape != "all":
            ahead, aside, above = (dr.dot(axis, sent) for axis in self.axes(1))
            both = both * self.sends.sensitivity(ahead, aside, above, DRJIT)
        return both

    def reached(
        self, scene: mi.Scene, point: ScatteringPoints, sent: Leg, received: Leg, active: DeviceArray
    ) -> tuple[DeviceArray, DeviceArray | None]:
        """Return which points sound reaches, and the factor of mirrors on its amplitude; None without mirrors.

        Only the path from the transmitter is tested, since receivers are near it.
        """
        return ~hidden(scene, point.at, point.normal, sent.u, sent.length, active), None

    def doppler(self, sent: DeviceArray, received: DeviceArray) -> DeviceArray:
        """Return the Doppler shift of the carrier [Hz], given unit directions to the points.

        The shift is positive where the vehicle approaches the point, because both legs of the path get shorter. In a turn,
        transmitter and receiver have different velocities. Terms of second order in velocity over sound speed are neglected.
        """
        sender, receiver = (mi.Vector3f(*self.vector(start)) for start in (6, 9))
        return (dr.dot(sent, sender) + dr.dot(received, receiver)) * (1 / self.sonar.wavelength_m)

    def echo_batch(
        self, delay: DeviceArray, amplitude: DeviceArray, phase: DeviceArray, doppler: DeviceArray, valid: DeviceArray
    ) -> EchoBatch:
        """Return the echoes, split into those within ``range_max`` and those from beyond."""
        beyond = valid & (delay > 2 * self.sonar.range_max / self.sonar.sound_speed)
        turn = delay * (self.sonar.frequency_step_hz / PADDING)
        turns = delay * self.sonar.carrier_hz
        # remove whole cycles in float64; the rest of the phase fits float32
        sin, cos = dr.sincos(mi.Float((turns - dr.round(turns)) * (2 * math.pi)) - phase)
        return EchoBatch(
            delay=delay,
            amplitude=amplitude,
            phase=phase,
            doppler=doppler,
            counts=valid & ~beyond,
            beyond=beyond,
            turn=(turn - dr.round(turn)) * (2 * math.pi),
            real=amplitude * cos,
            imag=-amplitude * sin,
        )
