"""Paths without a scatterer: what reaches a receiver directly, via flat mirrors, and via the facets of waves."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.water import delay_exact
from mitsonar.instruments.hydrophones import PADDING, ChannelSonar
from mitsonar.simulation.beams import phasors
from mitsonar.simulation.device import DeviceArray, Frozen, padded, replayed
from mitsonar.simulation.mirrors import (
    ROW,
    MirrorFacets,
    MirrorSequence,
    PlaneRow,
    ScatteringPoints,
    mirror_sequences,
    unfolded,
)
from mitsonar.simulation.moving import MovingScene
from mitsonar.simulation.scatterers import ChannelTracer, EchoValues, Moment, absorption_rate, link_table
from mitsonar.simulation.tracing import hidden

__all__ = ["APART_M", "FacetEchoes", "MirrorPaths", "facet_echoes", "half_fresnel_m", "phase_mean"]


APART_M = 1e-3
"""Distance from the transmitter below which a receiver has no direct arrival [m]."""


class MirrorPaths:
    """Tracer of the paths of one ping that involve no scatterer.

    The pressure falls as that of a point source with pressure 1 at 1 m: ``V / r``, where r is the length of the path and V
    the product of the reflection coefficients. Waves are summed by :func:`facet_echoes`.

    Args:
        tracer: tracer of the scatterers, which gives scene, instrument and mirrors.

    Attributes:
        names: names of the paths: ``direct``, the names of planes such as ``surface-seabed``, the names of waves.
        notes: notes to the user about mirrors.
    """

    def __init__(self, tracer: ChannelTracer) -> None:
        self.scene, self.sonar, self.registry = tracer.scene, tracer.sonar, tracer.registry
        self.facets = tracer.flat.facets
        lengths = range(0 if self.sonar.direct else 1, self.sonar.bounces + 1)
        planes = tracer.flat.reflecting
        self.sequences = {length: sequences for length in lengths if (sequences := mirror_sequences(planes(length), length))}
        self.names = [sequence.name or "direct" for sequences in self.sequences.values() for sequence in sequences]
        self.names += [mirror.name for mirror in self.facets]
        self.wavenumber = 2 * math.pi / self.sonar.wavelength_m
        self.launches: dict[int, Callable[..., list[DeviceArray]]] = {}
        self.shadows = _compile_shadows()
        self.notes: list[str] = []

    def trace(
        self,
        pose: NDArray[np.float64],
        velocity: NDArray[np.float64],
        receiver: int,
        fields: Sequence[str],
        moment: Moment | None = None,
    ) -> list[EchoValues]:
        """Return the paths of one ping at one receiver: a list of echo values, one entry for each of :attr:`names`.

        Args:
            pose: pose of the transmitter ``(6,)`` [m, rad].
            velocity: velocity of the vehicle in its own axes ``(4,)`` [m/s, rad/s].
            receiver: index of the receiver.
            fields: names of the values to return.
            moment: of the ping, if bodies move.
        """
        scene = self.scene if moment is None else moment.scene
        table = link_table(self.sonar, receiver, pose, velocity)
        echoes = [
            part
            for length, sequences in self.sequences.items()
            for part in self._by_planes(table, receiver, length, sequences, scene)
        ]
        echoes += [self._by_facets(table, receiver, mirror, scene) for mirror in self.facets]
        return [{name: part[name] for name in fields} for part in echoes]

    def _by_planes(
        self,
        table: NDArray[np.float64],
        receiver: int,
        length: int,
        sequences: list[MirrorSequence],
        scene: mi.Scene | MovingScene,
    ) -> list[EchoValues]:
        """Return the paths via sequences of ``length`` planes, one entry for each sequence."""
        # 1. image sources, and which of them the receiver sees through its mirrors
        sent_from, received_at = table[0:3], table[3:6]
        image = np.array([sequence.images(sent_from)[-1] for sequence in sequences])
        rows = np.array([sequence.rows(sent_from, self.registry) for sequence in sequences])
        is_open, factor = self._open(image, received_at, rows, length, scene)
        # 2. direction and distance from the receiver to the image
        to_image = image - received_at
        distance = np.linalg.norm(to_image, axis=1)
        apart = distance > APART_M
        u = to_image / np.where(apart, distance, 1)[:, None]
        # 3. the direction in which sound departs from the transmitter itself, mirrored back from that of its image
        departed = np.einsum("nij,ni->nj", np.array([sequence.turn for sequence in sequences]), -u)
        # 4. delay, amplitude and Doppler shift
        valid = is_open & apart
        delay = delay_exact(np.zeros(to_image.T.shape), to_image.T, table[9:12, None], self.sonar.sound_speed)
        amplitude = factor * self._sensitivity(table, receiver, departed, u)
        if self.sonar.spreads:
            amplitude = amplitude / np.where(apart, distance, 1)
        doppler = (departed @ table[6:9] + u @ table[9:12]) / self.sonar.wavelength_m
        return [
            echo_values(self.sonar, delay[k : k + 1], amplitude[k : k + 1], doppler[k : k + 1], valid[k : k + 1])
            for k in range(len(sequences))
        ]

    def _sensitivity(
        self, table: NDArray[np.float64], receiver: int, departed: NDArray[np.float64], u: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the combined sensitivity of transmitter and receiver ``(n,)``, given unit directions from each."""
        receiver_field, transmitter_field = self.sonar.receivers[receiver].field, self.sonar.transmitter
        receiver_gain = receiver_field.sensitivity(*(table[12:21].reshape(3, 3) @ u.T))
        return np.asarray(
            receiver_gain * transmitter_field.sensitivity(*(table[21:30].reshape(3, 3) @ departed.T)), dtype=float
        )

    def _open(
        self,
        image: NDArray[np.float64],
        received_at: NDArray[np.float64],
        rows: NDArray[np.float64],
        length: int,
        scene: mi.Scene | MovingScene,
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Return which paths are unobstructed ``(n,)``, and the products of their reflection coefficients ``(n,)``."""
        if length not in self.launches:
            self.launches[length] = _compile_open(length, self.wavenumber)
        inputs = [np.broadcast_to(received_at, image.shape), image, rows.reshape(len(image), -1)]
        table = np.concatenate(inputs, axis=1)
        columns = mi.UInt32(padded(np.arange(len(image), dtype=np.uint32))), mi.Float64(padded(table.ravel()))
        seen, factor = replayed(self.launches[length], *columns, scene)
        return np.broadcast_to(np.array(seen), len(image)), np.broadcast_to(np.array(factor, dtype=float), len(image))

    def _by_facets(
        self, table: NDArray[np.float64], receiver: int, mirror: MirrorFacets, scene: mi.Scene | MovingScene
    ) -> EchoValues:
        """Return the echoes of one reflection from the facets of a mirror that is not flat."""
        echoes = facet_echoes(mirror, table[0:3], table[3:6], table[9:12], self.sonar.carrier_hz, self.sonar.sound_speed)
        self._note_large_facets(mirror, table)
        valid = echoes.lit & self._lit(mirror, table, scene)
        amplitude = echoes.amplitude * self._sensitivity(table, receiver, echoes.sent, echoes.received)
        if not self.sonar.spreads:
            amplitude = amplitude * echoes.length
        doppler = (echoes.sent @ table[6:9] + echoes.received @ table[9:12]) / self.sonar.wavelength_m
        return echo_values(self.sonar, echoes.delay, amplitude, doppler, valid)

    def _lit(self, mirror: MirrorFacets, table: NDArray[np.float64], scene: mi.Scene | MovingScene) -> NDArray[np.bool_]:
        """Return which facets both transmitter and receiver see ``(facets,)``."""
        middle = mirror.corners.mean(axis=1)
        normal = np.cross(mirror.corners[:, 1] - mirror.corners[:, 0], mirror.corners[:, 2] - mirror.corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-30)[:, None]
        places = (np.broadcast_to(table[start : start + 3], middle.shape) for start in (0, 3))
        inputs = (middle, normal, *places)
        number = mi.UInt32(padded(np.arange(len(middle), dtype=np.uint32)))
        numbers = mi.Float(padded(np.concatenate(inputs, axis=1, dtype=np.float32).ravel()))
        return np.broadcast_to(np.array(replayed(self.shadows, number, numbers, scene)), len(middle))

    def _note_large_facets(self, mirror: MirrorFacets, table: NDArray[np.float64]) -> None:
        """Add a note, once, if facets are too large for the integral."""
        largest, allowed = half_fresnel_m(mirror, table[0:3], table[3:6], self.sonar.wavelength_m)
        if largest > allowed and not self.notes:
            self.notes.append(
                f"the facets of the mirror {mirror.name} are {largest:.2g} m long where its echo comes from, more than half "
                f"the Fresnel radius, {allowed:.2g} m: they shine as a polyhedron; give it a finer mesh"
            )


def _compile_open(length: int, wavenumber: float) -> Callable[..., list[DeviceArray]]:
    """Record the launch that follows paths via ``length`` planes from a receiver to the transmitter."""

    @Frozen
    def launch(number: mi.UInt32, table: mi.Float64, scene: mi.Scene) -> list[DeviceArray]:
        columns = _columns(mi.Float64, table, number, 6 + (ROW + 1) * length)
        position = columns[:3]
        point = ScatteringPoints(mi.Point3f(*position), position, mi.Normal3f(0, 0, 0))
        rows = [PlaneRow.from_numbers(columns[6 + (ROW + 1) * k : 6 + (ROW + 1) * (k + 1)]) for k in range(length)]
        seen, factor = unfolded(scene, point, columns[3:6], rows, wavenumber, mi.Bool(True))
        dr.eval(seen, factor)
        return [seen, factor]

    return launch


def _columns(kind: Any, table: DeviceArray, number: mi.UInt32, count: int) -> list[DeviceArray]:
    """Return the ``count`` columns of a flat table.

    The table is one array, since a frozen launch is recorded again for each alignment of each of its inputs.
    """
    return [dr.gather(kind, table, number * count + k) for k in range(count)]


def _compile_shadows() -> Callable[..., DeviceArray]:
    """Record the launch that tests which facets are visible from two positions."""

    @Frozen
    def launch(number: mi.UInt32, table: mi.Float, scene: mi.Scene) -> DeviceArray:
        columns = _columns(mi.Float, table, number, 12)
        point, normal = mi.Point3f(*columns[:3]), mi.Normal3f(*columns[3:6])
        seen = mi.Bool(True)
        for start in (6, 9):
            place = mi.Point3f(*columns[start : start + 3])
            line = point - place
            distance = dr.norm(line)
            seen = seen & ~hidden(scene, point, normal, line / distance, distance, seen)
        dr.eval(seen)
        return seen

    return launch


def echo_values(
    sonar: ChannelSonar,
    delay: NDArray[np.float64],
    amplitude: NDArray[np.inexact],
    doppler: NDArray[np.float64],
    valid: NDArray[np.bool_],
) -> EchoValues:
    """Return echoes as NumPy arrays with the fields of :class:`~mitsonar.simulation.scatterers.EchoBatch`.

    Args:
        sonar: the instrument.
        delay: delay of each echo ``(n,)`` [s].
        amplitude: amplitude, real or complex, before the carrier's phase ``(n,)``.
        doppler: Doppler shift ``(n,)`` [Hz].
        valid: which echoes exist ``(n,)``; those of amplitude 0 are dropped.
    """
    valid = valid & (np.abs(amplitude) > 0)
    if sonar.absorption_db_per_m > 0:
        amplitude = amplitude * np.exp(-absorption_rate(sonar) * delay)
    beyond = valid & (delay > 2 * sonar.range_max / sonar.sound_speed)
    turn, strength = phasors(delay, amplitude, sonar, PADDING)
    return {
        "delay": delay,
        "amplitude": np.abs(amplitude),
        "phase": np.angle(amplitude),
        "doppler": doppler,
        "counts": valid & ~beyond,
        "beyond": beyond,
        "turn": turn,
        "real": strength.real,
        "imag": strength.imag,
    }


# ---------------- Kirchhoff's integral over facets


NEAR = 1e-2
"""Phase difference below which the mean over a facet is computed by a series [rad]."""


class FacetEchoes(NamedTuple):
    """Echoes of facets.

    Attributes:
        delay: delay via the centre of each facet ``(n,)`` [s].
        amplitude: complex amplitude before the carrier's phase ``(n,)`` [1/m].
        sent: unit direction from the transmitter ``(n, 3)``.
        received: unit direction from the receiver ``(n, 3)``.
        length: length of the path ``(n,)`` [m].
        lit: whether transmitter and receiver are on the same side of the facet ``(n,)``.
    """

    delay: NDArray[np.float64]
    amplitude: NDArray[np.complex128]
    sent: NDArray[np.float64]
    received: NDArray[np.float64]
    length: NDArray[np.float64]
    lit: NDArray[np.bool_]


def facet_echoes(
    mirror: MirrorFacets,
    sent_from: NDArray[np.float64],
    received_at: NDArray[np.float64],
    velocity: NDArray[np.float64],
    carrier_hz: float,
    sound_speed: float,
) -> FacetEchoes:
    """Compute the echo of each facet at the carrier, by Kirchhoff's integral.

    The pressure is that of a mirror which is not a plane, such as waves of the sea surface::

        p = sum_f j k / 4 pi V exp(-k^2 h^2 (cos_A + cos_B)^2 / 2) (cos_A + cos_B) dA T / (r_A r_B) exp(-j k (r_A + r_B))

    This is the integral of :mod:`mitsonar.simulation.multipath_coherent` for a receiver apart from the transmitter. T is the
    mean phase factor over the facet, exact for a phase that is linear on it. A plane of facets returns the image source's
    V / r, except for the diffraction at its edge (Kirchhoff's boundary condition; Medwin and Clay, Fundamentals of
    Acoustical Oceanography, 1998).

    Args:
        mirror: the facets.
        sent_from: position of the transmitter ``(3,)`` [m].
        received_at: position of the receiver when sound is sent ``(3,)`` [m].
        velocity: velocity of the receiver ``(3,)`` [m/s].
        carrier_hz: frequency of the carrier [Hz].
        sound_speed: [m/s].
    """
    # 1. centre, normal and twice the area of each facet
    middle = mirror.corners.mean(axis=1)
    edges = mirror.corners[:, 1] - mirror.corners[:, 0], mirror.corners[:, 2] - mirror.corners[:, 0]
    across = np.cross(*edges)
    twice = np.linalg.norm(across, axis=1)
    normal = across / np.maximum(twice, 1e-30)[:, None]
    # 2. directions from both ends, and the sum of the cosines to the normal
    legs = [middle - place for place in (sent_from, received_at)]
    sent, received = (np.linalg.norm(leg, axis=1) for leg in legs)
    u = [leg / np.maximum(length, 1e-9)[:, None] for leg, length in zip(legs, (sent, received), strict=True)]
    cosines = [np.einsum("ni,ni->n", normal, one) for one in u]
    total = np.abs(cosines[0] + cosines[1])

    # 3. delay via the centre, and phase at the corners relative to it
    def delay(places: NDArray[np.float64]) -> NDArray[np.float64]:
        vectors = [np.moveaxis(places - place, -1, 0) for place in (sent_from, received_at)]
        moving = velocity.reshape(3, *[1] * (vectors[0].ndim - 1))
        return np.asarray(delay_exact(vectors[0], vectors[1], moving, sound_speed))

    arrival, wavenumber = delay(middle), 2 * np.pi * carrier_hz / sound_speed
    phase = 2 * np.pi * carrier_hz * (delay(mirror.corners) - arrival[:, None])
    # curvature raises the mean over the corners; its mean over the triangle is only a quarter of that
    phase -= 0.75 * phase.mean(axis=1, keepdims=True)
    # 4. weight of the integral, with the coherent loss of the roughness
    smooth = np.exp(-((wavenumber * mirror.roughness_m * total) ** 2) / 2)
    weight = wavenumber / (4 * np.pi) * mirror.reflection * smooth * total * twice / 2 / np.maximum(sent * received, 1e-18)
    return FacetEchoes(arrival, 1j * weight * phase_mean(phase), u[0], u[1], sent + received, cosines[0] * cosines[1] > 0)


def phase_mean(phase: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the mean of ``exp(-j phase)`` over triangles on which the phase is linear ``(n,)``.

    The mean is twice the divided difference of exp over the corners (Hermite and Genocchi).

    Args:
        phase: phase at the corners ``(n, 3)`` [rad].
    """
    low, mid, high = np.sort(phase, axis=1).T
    wide = high - low
    near = wide < NEAR

    def step(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.complex128]:
        return np.asarray(np.exp(-0.5j * (a + b)) * np.sinc((b - a) / (2 * np.pi)))

    # nearly equal phases: a series of second order, since the divided difference would cancel
    mean = (low + mid + high) / 3
    spread = (low - mean) ** 2 + (mid - mean) ** 2 + (high - mean) ** 2
    series = np.exp(-1j * mean) * (1 - spread / 24)
    exact = 2j * (step(mid, high) - step(low, mid)) / np.where(near, 1, wide)
    return np.asarray(np.where(near, series, exact))


def half_fresnel_m(
    mirror: MirrorFacets, sent_from: NDArray[np.float64], received_at: NDArray[np.float64], wavelength_m: float
) -> tuple[float, float]:
    """Return the longest edge of the facet on the shortest path, and half the Fresnel radius there [m].

    Args:
        mirror: the facets.
        sent_from: position of the transmitter ``(3,)`` [m].
        received_at: position of the receiver ``(3,)`` [m].
        wavelength_m: wavelength of the carrier [m].
    """
    middle = mirror.corners.mean(axis=1)
    sent, received = (np.linalg.norm(middle - place, axis=1) for place in (sent_from, received_at))
    near = int(np.argmin(sent + received))
    edges = mirror.corners[near] - np.roll(mirror.corners[near], 1, axis=0)
    radius = np.sqrt(wavelength_m * sent[near] * received[near] / (sent[near] + received[near]))
    return float(np.linalg.norm(edges, axis=1).max()), float(radius) / 2
