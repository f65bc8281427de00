"""The coarse search for a motion over all motions that a vehicle can make.

The cross-covariance of two pings of a receiver is computed once for motions on a grid, along its axis and across. Responses
are first whitened in the strong directions of a single ping. There a hypothesis is a matrix C of the cross-covariance, and
its score for responses b_1, b_2 is 2 Re b_1* C b_2 - |C|^2: least squares of their products.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import maximum_filter

from mitsonar.estimation.channel.response_covariance import ResponseCovariance
from mitsonar.estimation.channel.sub_bands import Band
from mitsonar.instruments.hydrophones import ChannelSonar, Hydrophone

__all__ = ["ReceiverBand", "Search", "receiver_bands_of", "response_covariance_of", "single_receiver"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

FLOOR = 1e-2
"""Part of the mean power below which a direction of responses is not used."""

ALONG, ACROSS = 7.5, 1.9
"""Motions of the grid a wavelength, along the axis of a receiver and across."""

FINE = 15.0
"""Cells a wavelength of the map in which the scores of all receivers are added."""

PEAKS = 40
"""Number of maxima of the map that are used."""


class ReceiverBand(NamedTuple):
    """A receiver turned to face forward, so that receivers of one kind share what is computed.

    Attributes:
        law: covariance of its responses.
        turn: from motions of the vehicle to motions in its axes ``(4, 4)``.
        number: its index among the receivers of the sonar.
    """

    law: ResponseCovariance
    turn: Array
    number: int


def single_receiver(sonar: ChannelSonar, receiver: Hydrophone) -> ChannelSonar:
    """Return the instrument with this receiver only, turned so that it faces forward."""
    heading = math.radians(receiver.field.heading_deg)
    x, y, z = receiver.position
    cos, sin = math.cos(heading), math.sin(heading)
    position = (round(x * cos - y * sin, 9) + 0.0, round(x * sin + y * cos, 9) + 0.0, z)
    field = receiver.field.model_copy(update={"heading_deg": 0.0})
    sender = sonar.transmitter
    if sender.shape != "all":
        sender = sender.model_copy(update={"heading_deg": sender.heading_deg - receiver.field.heading_deg})
    one = Hydrophone(name="forward", position=position, field=field)
    return sonar.model_copy(update={"receivers": (one,), "transmitter": sender, "name": "one", "seed": 0})


@lru_cache(maxsize=32)
def response_covariance_of(alone: ChannelSonar, height_m: float, interval_s: float, reach_m: float) -> ResponseCovariance:
    """Return the response covariance of an instrument of one receiver, cached."""
    return ResponseCovariance(alone, alone.receivers[0], height_m, interval_s, reach_m)


def receiver_bands_of(sonar: ChannelSonar, height_m: float, interval_s: float, reach_m: float) -> list[ReceiverBand]:
    """Return all receivers of an instrument, each turned forward."""
    found = []
    for number, receiver in enumerate(sonar.receivers):
        heading = math.radians(receiver.field.heading_deg)
        cos, sin = math.cos(heading), math.sin(heading)
        turn = np.eye(4)
        turn[:2, :2] = [[cos, -sin], [sin, cos]]
        found.append(
            ReceiverBand(
                response_covariance_of(single_receiver(sonar, receiver), height_m, interval_s, reach_m), turn, number
            )
        )
    return found


@dataclass(frozen=True)
class CovarianceTable:
    """Cross-covariances of two pings for motions on a grid.

    Attributes:
        along: motions along the axis of the receiver ``(a,)`` [m].
        across: across it ``(b,)`` [m].
        basis: from taps to directions of equal strength ``(directions, taps)``.
        shared: C of each motion ``(a, b, directions, directions)`` complex64.
    """

    along: Array
    across: Array
    basis: Complex
    shared: NDArray[np.complex64]

    @classmethod
    def of(cls, law: ResponseCovariance) -> Self:
        """Compute the table for all motions within the reach of the covariance."""
        own = law.covariance((0, 0, 0), 0)
        power = float(np.diag(own).real.mean())
        size, vectors = np.linalg.eigh(own + FLOOR * power * np.eye(len(own)))
        strong = size > 2 * FLOOR * power
        basis = (vectors[:, strong] / np.sqrt(size[strong])).conj().T
        along, across = (_grid(law.reach_m, law.sonar.wavelength_m / parts) for parts in (ALONG, ACROSS))
        # a receiver in the plane of its axis has the same covariance for motions to port and to starboard
        alike = law.receiver.position[0] == 0 and law.sonar.transmitter.shape == "all"
        shared = np.empty((len(along), len(across), len(basis), len(basis)), dtype=np.complex64)
        for i, j in np.ndindex(len(along), len(across)):
            if alike and across[j] > 0:
                shared[i, j] = shared[i, len(across) - 1 - j]
            else:
                shared[i, j] = basis @ law.covariance(np.array([across[j], along[i], 0.0])) @ basis.conj().T
        return cls(along, across, basis, shared)

    def score(self, response: Complex) -> Array:
        """Score each motion of the grid ``(a, b)`` by pings ``(pings, taps)``."""
        b = response @ self.basis.T
        size = float(np.mean(np.abs(b) ** 2))
        product = (b[:-1].T @ b[1:].conj()) / (size or 1.0)
        matched = 2 * np.tensordot(self.shared, product.conj().astype(np.complex64), 2).real
        return np.asarray(matched - (len(b) - 1) * (np.abs(self.shared) ** 2).sum(axis=(2, 3)), dtype=float)


def _grid(reach: float, step: float) -> Array:
    count = max(math.ceil(reach / step), 4)
    return np.linspace(-1, 1, 2 * count + 1) * reach


@lru_cache(maxsize=32)
def _table_of(alone: ChannelSonar, height_m: float, interval_s: float, reach_m: float) -> CovarianceTable:
    return CovarianceTable.of(response_covariance_of(alone, height_m, interval_s, reach_m))


@dataclass(frozen=True)
class Search:
    """The scores of all receivers for all motions.

    Attributes:
        line: motions along either axis, from ping to ping ``(n,)`` [m].
        scores: of each receiver in each band for sideways and forward motions ``(bands x receivers, n, n)``.
    """

    line: Array
    scores: Array

    @classmethod
    def of(
        cls, bands: list[Band], response: Complex, height_m: float, interval_s: float, reach_m: float, received: list[int]
    ) -> Self:
        """Score pings ``(pings, receivers, taps)`` by the receivers ``received``, for motions up to ``reach_m`` [m]."""
        line = _grid(reach_m, min(band.sonar.wavelength_m for band in bands) / FINE)
        plane, scores = np.stack(np.meshgrid(line, line, indexing="ij")), []
        for band in bands:
            part = band.of(response)
            for receiver_band in receiver_bands_of(band.sonar, height_m, interval_s, 1.5 * reach_m):
                if receiver_band.number in received:
                    table = _table_of(receiver_band.law.sonar, height_m, interval_s, 1.5 * reach_m)
                    across, along = np.tensordot(receiver_band.turn[:2, :2], plane, 1)
                    score = RectBivariateSpline(
                        table.along, table.across, table.score(part[:, receiver_band.number, receiver_band.law.taps])
                    )
                    scores.append(score.ev(along.ravel(), across.ravel()).reshape(along.shape))
        return cls(line, np.array(scores))

    def peaks(self) -> Array:
        """Return the motions ``(n, 2)`` [m] of the largest scores, best first."""
        total = self.scores.sum(axis=0)
        peaks = np.argwhere(total == maximum_filter(total, size=5))
        return np.asarray(self.line[peaks[np.argsort(-total[tuple(peaks.T)])][:PEAKS]])

    def along(self, receiver: int, motion: Array, axis: int) -> Array:
        """Return the scores of one receiver on the line through a motion along an axis ``(n,)``."""
        index = int(np.abs(self.line - motion[1 - axis]).argmin())
        return self.scores[receiver, :, index] if axis == 0 else self.scores[receiver, index]
