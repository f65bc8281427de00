"""Kirchhoff's integral over the facets of a mirror that is no plane, such as waves of the sea surface.

    p = sum_f j k / 4 pi V exp(-k^2 h^2 (cos_A + cos_B)^2 / 2) (cos_A + cos_B) dA T / (r_A r_B) exp(-j k (r_A + r_B))

It is the law of :mod:`mitsonar.simulation.mirror_tracing` for a receiver apart from the transmitter. T is the mean of the
phase over the facet, exact for a phase that is linear on it. A plane of facets returns the image source's V / r but for the
diffraction at its edge (Kirchhoff's boundary condition; Medwin and Clay, Fundamentals of Acoustical Oceanography, 1998).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.simulation.mirror_planes import MirrorFacets
from mitsonar.simulation.propagation_delay import delay_exact

__all__ = ["FacetEchoes", "facet_echoes", "half_fresnel_m", "phase_mean"]

NEAR = 1e-2
"""Differences of phase below which the mean over a facet is a series [rad]."""


class FacetEchoes(NamedTuple):
    """Echoes of facets.

    Attributes:
        delay: by way of the middle of each facet ``(n,)`` [s].
        amplitude: complex, before the carrier's phase ``(n,)`` [1/m].
        sent: unit direction from the transmitter ``(n, 3)``.
        received: unit direction from the receiver ``(n, 3)``.
        length: of the path ``(n,)`` [m].
        lit: whether transmitter and receiver are on one side of the facet ``(n,)``.
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
    heard_at: NDArray[np.float64],
    velocity: NDArray[np.float64],
    carrier_hz: float,
    sound_speed: float,
) -> FacetEchoes:
    """Compute the echo of each facet at the carrier.

    Args:
        mirror: the facets.
        sent_from: position of the transmitter ``(3,)`` [m].
        heard_at: position of the receiver when sound is sent ``(3,)`` [m].
        velocity: of the receiver ``(3,)`` [m/s].
        carrier_hz: frequency.
        sound_speed: [m/s].
    """
    middle = mirror.corners.mean(axis=1)
    edges = mirror.corners[:, 1] - mirror.corners[:, 0], mirror.corners[:, 2] - mirror.corners[:, 0]
    across = np.cross(*edges)
    twice = np.linalg.norm(across, axis=1)
    normal = across / np.maximum(twice, 1e-30)[:, None]
    legs = [middle - place for place in (sent_from, heard_at)]
    sent, received = (np.linalg.norm(leg, axis=1) for leg in legs)
    u = [leg / np.maximum(length, 1e-9)[:, None] for leg, length in zip(legs, (sent, received), strict=True)]
    cosines = [np.einsum("ni,ni->n", normal, one) for one in u]
    total = np.abs(cosines[0] + cosines[1])

    def delay(places: NDArray[np.float64]) -> NDArray[np.float64]:
        ways = [np.moveaxis(places - place, -1, 0) for place in (sent_from, heard_at)]
        moving = velocity.reshape(3, *[1] * (ways[0].ndim - 1))
        return np.asarray(delay_exact(ways[0], ways[1], moving, sound_speed))

    arrival, wavenumber = delay(middle), 2 * np.pi * carrier_hz / sound_speed
    phase = 2 * np.pi * carrier_hz * (delay(mirror.corners) - arrival[:, None])
    # curvature raises the corners' mean; over the triangle it is a quarter of that
    phase -= 0.75 * phase.mean(axis=1, keepdims=True)
    smooth = np.exp(-((wavenumber * mirror.roughness_m * total) ** 2) / 2)
    weight = wavenumber / (4 * np.pi) * mirror.reflection * smooth * total * twice / 2 / np.maximum(sent * received, 1e-18)
    return FacetEchoes(arrival, 1j * weight * phase_mean(phase), u[0], u[1], sent + received, cosines[0] * cosines[1] > 0)


def phase_mean(phase: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the mean of ``exp(-j phase)`` over triangles on which the phase is linear ``(n,)``.

    It is twice the divided difference of exp over the corners (Hermite and Genocchi).

    Args:
        phase: at the corners ``(n, 3)`` [rad].
    """
    low, mid, high = np.sort(phase, axis=1).T
    wide = high - low
    near = wide < NEAR

    def step(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.complex128]:
        return np.asarray(np.exp(-0.5j * (a + b)) * np.sinc((b - a) / (2 * np.pi)))

    mean = (low + mid + high) / 3
    spread = (low - mean) ** 2 + (mid - mean) ** 2 + (high - mean) ** 2
    series = np.exp(-1j * mean) * (1 - spread / 24)
    exact = 2j * (step(mid, high) - step(low, mid)) / np.where(near, 1, wide)
    return np.asarray(np.where(near, series, exact))


def half_fresnel_m(
    mirror: MirrorFacets, sent_from: NDArray[np.float64], heard_at: NDArray[np.float64], wavelength_m: float
) -> tuple[float, float]:
    """Return the longest edge near the shortest path, and half the Fresnel radius there [m].

    Args:
        mirror: the facets.
        sent_from: position of the transmitter ``(3,)`` [m].
        heard_at: position of the receiver ``(3,)`` [m].
        wavelength_m: of the carrier.
    """
    middle = mirror.corners.mean(axis=1)
    sent, received = (np.linalg.norm(middle - place, axis=1) for place in (sent_from, heard_at))
    near = int(np.argmin(sent + received))
    edges = mirror.corners[near] - np.roll(mirror.corners[near], 1, axis=0)
    radius = np.sqrt(wavelength_m * sent[near] * received[near] / (sent[near] + received[near]))
    return float(np.linalg.norm(edges, axis=1).max()), float(radius) / 2
