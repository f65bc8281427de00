"""How impulse responses over level ground of unknown scatterers covary, for any motion between pings.

With independent unknown scatterers, the taps of all pings are a complex Gaussian vector of mean 0. Its covariance depends
on the motion. It is an integral over the ground P of the responses of both pings to a scatterer there (Almanza-Medina,
eq. 5.15, for both):

    E[h_i(t) h_j(s)*] = S int a_i a_j exp(-j 2 pi f_c (D_i - D_j)) p(t - D_i) p(s - D_j) dP

The delays D include the motion of the receiver while sound travels (5.14, its exact root). The amplitudes a include
spreading, cosines and fields of view; p is the pulse. The ground is homogeneous, so only the relative pose of the two pings
matters. Poses are therefore relative to the midpoint between them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from mitsonar.acoustics.water import delay_exact
from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar, Hydrophone

__all__ = ["LinkResponse", "ResponseCovariance", "block_toeplitz", "link_response"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

LEADING_PULSES = 1.0
"""Taps before the first echo that are used, in pulses of 1 / F_d."""

FAINTEST = 1e-4
"""Power of the last taps that are used, as a fraction of the largest."""

SILENCE_PULSES = 24.0
"""Length of silence after which a response may repeat, in pulses: their tails are then below 1e-5."""

NODES = 4.0
"""Points of the ground per period of the integrand."""

PANEL = 12
"""Points of a Gauss-Legendre panel along the axis of a receiver."""

MARGIN_M = 0.25
"""Margin of the ground around the footprint of a receiver at the midpoint, since receivers move and have offsets."""

MOST_POINTS = 400_000

STEP = 1e-4
"""Step of the numerical derivatives [m, rad]."""

PRECISION = 1e-7
"""Precision of the non-uniform Fourier transform."""


class LinkResponse(NamedTuple):
    """Delay and amplitude of the echo of each point of the ground.

    Attributes:
        delay: from the transmitter via the point to the receiver ``(points,)`` [s].
        amplitude: of an echo of unit strength ``(points,)``.
    """

    delay: Array
    amplitude: Array


def link_response(
    sonar: ChannelSonar,
    receiver: Hydrophone,
    height_m: float,
    points: Array,
    pose: ArrayLike,
    velocity: ArrayLike,
    tilt: ArrayLike = (0.0, 0.0),
) -> LinkResponse:
    """Compute delay and amplitude of the echoes of points of level ground.

    Args:
        sonar: the instrument; its transmitter's field of view counts too.
        receiver: one of its receivers.
        height_m: height of the transmitter over the ground.
        points: x, y ``(n, 2)`` [m].
        pose: x, y [m] and heading [rad] of the vehicle when the ping was sent.
        velocity: over ground along x and y [m/s].
        tilt: pitch (nose down) and roll (starboard side down) of the vehicle [rad], as one small turn about a level axis.
    """
    # points relative to the transmitter and to the receiver, in the vehicle's axes
    x, y, heading = np.asarray(pose, dtype=float)
    cos, sin = math.cos(heading), math.sin(heading)
    to_starboard, forward, up = receiver.position
    east, north = points[:, 0] - x, points[:, 1] - y
    starboard, ahead = east * cos - north * sin, east * sin + north * cos
    sent = np.stack([starboard, ahead, np.full_like(east, -height_m)])
    tilted, from_level = any(np.asarray(tilt, dtype=float)), np.eye(3)
    if tilted:
        pitch, roll = np.asarray(tilt, dtype=float)
        from_level = Rotation.from_rotvec([-pitch, roll, 0.0]).inv().as_matrix()
        sent = from_level @ sent
    received = sent - np.array([[to_starboard], [forward], [up]])
    distance_out, distance_back = np.sqrt((sent**2).sum(axis=0)), np.sqrt((received**2).sum(axis=0))
    # the receiver moves while the sound travels
    speed = np.asarray(velocity, dtype=float)
    velocity_in_axes = np.array([speed[0] * cos - speed[1] * sin, speed[0] * sin + speed[1] * cos, 0.0])
    if tilted:
        velocity_in_axes, up = from_level @ velocity_in_axes, float(from_level[:, 2] @ receiver.position)
    delay = np.asarray(delay_exact(list(sent), list(received), list(velocity_in_axes), sonar.sound_speed))
    # amplitude: sensitivities, the cosines of incidence and reflection, and spreading
    amplitude = _sensitivity(sonar, None, sent / distance_out) * _sensitivity(sonar, receiver, received / distance_back)
    amplitude *= np.sqrt(height_m / distance_out * (height_m + up) / distance_back)
    if sonar.spreads:
        amplitude /= distance_out * distance_back
    return LinkResponse(delay, amplitude)


def _sensitivity(sonar: ChannelSonar, receiver: Hydrophone | None, direction: Array) -> Array:
    """Return the sensitivity of the transmitter, or of a receiver, to unit directions ``(3, n)`` in the vehicle's axes."""
    field = sonar.transmitter if receiver is None else sonar.field_of_view[receiver.name]
    return np.asarray(field.sensitivity(*(field.axes @ direction)), dtype=float)


class Nodes(NamedTuple):
    """Points of the ground ``(n, 2)`` [m] with the area of each ``(n,)`` [m2]."""

    points: Array
    area: Array


@dataclass(frozen=True)
class ResponseCovariance:
    """Covariances of the responses of one receiver.

    Args:
        sonar: the instrument.
        receiver: one of its receivers.
        height_m: height of the transmitter over the ground.
        interval_s: time between pings, in which the vehicle makes the motion.
        reach_m: longest motion; it sets the density of the points of the ground.
    """

    sonar: ChannelSonar
    receiver: Hydrophone
    height_m: float
    interval_s: float
    reach_m: float = 0.12

    @cached_property
    def nodes(self) -> Nodes:
        """Return the points of the integral over the ground, relative to the midpoint between the pings."""
        # 1. panels along the axis: dense enough for the phase of the band and for the longest motion
        along, across = _extent(self.sonar, self.receiver, self.height_m)
        farthest = np.abs(along).max() + MARGIN_M
        sine = farthest / math.hypot(farthest, self.height_m)
        band = (1 + self.sonar.rolloff) * self.sonar.bandwidth_hz
        moves = 2 * self.reach_m / (self.sonar.wavelength_m * self.height_m)
        panels = math.ceil((along[-1] - along[0]) * (band * 2 * sine / self.sonar.sound_speed + moves) * NODES / PANEL)
        u, du = _panels(along[0], along[-1], panels, PANEL)
        # 2. points across it, within the edges of the footprint
        low, high = (np.interp(u, along, edge) for edge in across)
        width = (high - low).max()
        cycles = width * (band * width / (self.sonar.sound_speed * self.height_m) + moves)
        count = math.ceil(8 + NODES * cycles)
        if len(u) * count > MOST_POINTS:
            raise MitsonarError(
                f"receiver {self.receiver.name} covers too much ground to compute its covariance: {len(u)} x {count} "
                f"points; give it a field of view narrower than {width:.0f} m on the ground"
            )
        w, dw = np.polynomial.legendre.leggauss(count)
        side = (low + high)[:, None] / 2 + (high - low)[:, None] / 2 * w
        area = du[:, None] * (high - low)[:, None] / 2 * dw
        # 3. turn to the vehicle's axes, and keep the points received at the midpoint or at the longest motions
        turn = math.radians(self.receiver.field.heading_deg)
        u = np.broadcast_to(u[:, None], side.shape)
        x, y = u * math.sin(turn) + side * math.cos(turn), u * math.cos(turn) - side * math.sin(turn)
        points = np.stack([x.ravel(), y.ravel()], axis=1)
        received = np.zeros(len(points), dtype=bool)
        for offset in self.reach_m / 2 * np.array([(0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)]):
            received |= link_response(self.sonar, self.receiver, self.height_m, points, (*offset, 0), (0, 0)).amplitude > 0
        return Nodes(points[received], area.ravel()[received])

    @cached_property
    def taps(self) -> slice:
        """Return the taps that hold echoes."""
        links = link_response(self.sonar, self.receiver, self.height_m, self.nodes.points, (0, 0, 0), (0, 0))
        tap = np.rint(links.delay * self.sonar.sampling_hz).astype(int)
        power = np.bincount(tap, links.amplitude**2 * self.nodes.area)
        loud = np.flatnonzero(power > FAINTEST * power.max())
        tail = math.ceil(LEADING_PULSES / self.sonar.bandwidth_hz * self.sonar.sampling_hz)
        return slice(max(0, int(loud[0]) - tail), min(self.sonar.taps, int(loud[-1]) + 1))

    @cached_property
    def synthesis(self) -> tuple[float, float, Complex]:
        """Return the middle delay and the period [s] of the spectrum, and the matrix to taps ``(taps, frequencies)``."""
        delay = self.sonar.delay_s[self.taps]
        middle = (delay[0] + delay[-1]) / 2
        period = delay[-1] - delay[0] + SILENCE_PULSES / self.sonar.bandwidth_hz
        count = 2 * math.ceil((1 + self.sonar.rolloff) * self.sonar.bandwidth_hz / 2 * period) + 2
        frequency = np.arange(-count // 2, count - count // 2) / period
        level = self.sonar.raised_cosine(frequency) / (self.sonar.sampling_hz * period)
        return middle, period, np.exp(2j * np.pi * np.outer(delay - middle, frequency)) * level

    def link_responses(self, motion: ArrayLike, lag: float = 1.0) -> tuple[LinkResponse, LinkResponse]:
        """Compute the echoes of the ground in both pings, ``lag`` intervals apart.

        Args:
            motion: sideways, forward [m], yaw [rad] in one interval (eq. 3.4), the rise of the vehicle [m], its pitch and
                roll [rad]; the last three default to 0. The vehicle is level at the midpoint.
            lag: intervals between the pings.
        """
        sideways, forward, yaw, heave, pitch, roll = _six(motion)
        # eq. 3.4 counts along the new heading, which differs by half the turn from that at the midpoint
        cos, sin = math.cos(yaw / 2), math.sin(yaw / 2)
        displacement = np.array([sideways * cos + forward * sin, forward * cos - sideways * sin])
        links = []
        for half in (-lag / 2, lag / 2):
            pose, height = (*(half * displacement), half * yaw), self.height_m + half * heave
            velocity = (
                _clockwise(displacement, half * yaw) / self.interval_s
            )  # along the arc whose chord is the displacement
            tilt = (half * pitch, half * roll)
            links.append(link_response(self.sonar, self.receiver, height, self.nodes.points, pose, velocity, tilt))
        return links[0], links[1]

    def covariance(self, motion: ArrayLike, lag: float = 1.0) -> Complex:
        """Return E[h_i h_j*] of taps i of the earlier and j of the later ping ``(taps, taps)``; ``lag`` 0: of one ping.

        The scatterers have a strength of 1 per square metre.
        """
        first, second = self.link_responses(motion, lag)
        weight = self.nodes.area * first.amplitude * second.amplitude
        return np.asarray(self._taps_of(self._spectra(first, second, weight[None]))[0])

    def slopes(self, motion: ArrayLike, lag: float, free: Sequence[int]) -> Complex:
        """Return :meth:`covariance` and its derivatives by free parameters of the motion ``(1 + free, taps, taps)``.

        Only carrier phase and amplitude change; the shift of the pulses is neglected, which suits narrow bands.
        """
        first, second = self.link_responses(motion, lag)
        weight = first.amplitude * second.amplitude
        weights = [weight.astype(complex)]
        for number in free:
            step = np.zeros(6)
            step[number] = STEP
            (low_i, low_j), (high_i, high_j) = (self.link_responses(_six(motion) + sign * step, lag) for sign in (-1, 1))
            amplitude = high_i.amplitude * high_j.amplitude - low_i.amplitude * low_j.amplitude
            delay_change = (high_i.delay - high_j.delay) - (low_i.delay - low_j.delay)
            weights.append((amplitude - 2j * np.pi * self.sonar.carrier_hz * weight * delay_change) / (2 * STEP))
        return self._taps_of(self._spectra(first, second, self.nodes.area * np.array(weights)))

    def _spectra(self, first: LinkResponse, second: LinkResponse, weight: NDArray[np.inexact]) -> Complex:
        """Integrate n weights over the ground at the frequencies of both pings ``(n, frequencies, frequencies)``."""
        import finufft

        middle, period, synthesis = self.synthesis
        x = 2 * np.pi / period * (first.delay - middle)
        y = -2 * np.pi / period * (second.delay - middle)
        carrier_weight = weight * np.exp(-2j * np.pi * self.sonar.carrier_hz * (first.delay - second.delay))
        count = synthesis.shape[1]
        spectra = finufft.nufft2d1(x, y, carrier_weight, (count, count), eps=PRECISION, isign=-1, nthreads=1)
        return np.asarray(spectra, dtype=np.complex128).reshape(len(weight), count, count)

    def _taps_of(self, spectra: Complex) -> Complex:
        """Return the taps of both pings ``(n, taps, taps)`` from spectra ``(n, frequencies, frequencies)``."""
        synthesis = self.synthesis[2]
        return np.asarray(synthesis @ spectra @ synthesis.conj().T)


def _clockwise(displacement: Array, turn: float) -> Array:
    """Turn a level displacement clockwise."""
    cos, sin = math.cos(turn), math.sin(turn)
    return np.array([displacement[0] * cos + displacement[1] * sin, displacement[1] * cos - displacement[0] * sin])


def _six(motion: ArrayLike) -> Array:
    """Return sideways, forward, yaw, rise, pitch and roll of a motion; those that are missing at the end are 0."""
    values = np.asarray(motion, dtype=float)
    return np.append(values, np.zeros(6 - len(values)))


def _panels(start: float, end: float, panels: int, nodes: int) -> tuple[Array, Array]:
    """Return nodes and weights of Gauss-Legendre quadrature in ``panels`` parts."""
    x, weight = np.polynomial.legendre.leggauss(nodes)
    edge = np.linspace(start, end, panels + 1)
    half = np.diff(edge)[:, None] / 2
    return (edge[:-1, None] + half * (1 + x)).ravel(), (half * weight).ravel()


def _extent(sonar: ChannelSonar, receiver: Hydrophone, height_m: float) -> tuple[Array, tuple[Array, Array]]:
    """Return the footprint of a receiver: positions along its axis ``(n,)``, and its two edges across ``(n,)`` each [m]."""
    # which points of a grid in the receiver's axes it receives
    farthest = math.sqrt(max(sonar.range_max**2 - height_m**2, 0.0))
    step = height_m / 200
    line = np.arange(-farthest - step, farthest + 2 * step, step)
    turn = math.radians(receiver.field.heading_deg)
    u, w = np.meshgrid(line, line, indexing="ij")
    x, y = u * math.sin(turn) + w * math.cos(turn), u * math.cos(turn) - w * math.sin(turn)
    links = link_response(sonar, receiver, height_m, np.stack([x.ravel(), y.ravel()], axis=1), (0, 0, 0), (0, 0))
    received = (links.amplitude > 0).reshape(u.shape) & (np.hypot(u, w) <= farthest)
    if not received.any():
        raise MitsonarError(
            f"receiver {receiver.name} receives no echo of level ground {height_m:g} m below within {sonar.range_max:g} m: "
            "tilt it down, or raise range_max"
        )
    # edges of each row that has such points, with a margin around
    rows = np.flatnonzero(received.any(axis=1))
    low = np.array([line[np.flatnonzero(received[row])[0]] for row in rows]) - MARGIN_M - step
    high = np.array([line[np.flatnonzero(received[row])[-1]] for row in rows]) + MARGIN_M + step
    along = line[rows]
    ends = np.r_[along[0] - MARGIN_M - step, along, along[-1] + MARGIN_M + step]
    return ends, (np.r_[low[0], low, low[-1]], np.r_[high[0], high, high[-1]])


def block_toeplitz(blocks: Sequence[Complex]) -> Complex:
    """Assemble the covariance of all pings from the covariances by lag, the earlier ping first."""
    count = range(len(blocks))
    joint = np.block([[blocks[j - i] if j >= i else blocks[i - j].conj().T for j in count] for i in count])
    return np.asarray((joint + joint.conj().T) / 2)
