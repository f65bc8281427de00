"""How well a motion can be known from impulse responses of unknown ground: the Cramer-Rao lower bound.

Pings of unknown ground are Gaussian with the covariance R of :mod:`mitsonar.estimation.channel.covariance`. The Fisher
information of the motion is tr(R^-1 R_a R^-1 R_b), added over receivers, whose fields of view hardly overlap. The bound is
*local*: it does not include that another motion may fit as well.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.channel.correlation import bands_of
from mitsonar.estimation.channel.covariance import ResponseCovariance, block_toeplitz
from mitsonar.estimation.channel.likelihood import ReceiverBand, receiver_bands_of
from mitsonar.estimation.crlb.image import Bound
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.motion.composition import DEGREES

__all__ = ["NOISELESS_DB", "PARAMETERS", "channel_bound", "channel_crlb", "impulse_information"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

NOISELESS_DB = 60.0
"""Signal-to-noise ratio that counts as "without noise": below lies the error of the integral over the ground."""

PARAMETERS = ("sideways", "forward", "yaw", "rise", "pitch", "roll")
"""Parameters of a motion between pings, in the order of this file; :data:`mitsonar.motion.composition.DEGREES` has units."""

STEP = 2e-4
"""Step of the differences over the whole motion [m, rad]."""

UNKNOWN = 1e-9
"""Relative information of an axis, compared with the other axes, below which it cannot be observed."""


def channel_crlb(
    sonar: ChannelSonar,
    height_m: float,
    motion: ArrayLike,
    *,
    pings: int = 2,
    span_s: float = 0.05,
    snr_db: float = NOISELESS_DB,
    free: Sequence[int] = (0, 1),
) -> Array:
    """Return the least standard deviations ``(k,)`` of the free parameters of the motion from the first to the last ping.

    The parameters are those of :data:`PARAMETERS`. One that cannot be observed has inf.

    Args:
        sonar: the instrument.
        height_m: height of the transmitter over the ground.
        motion: sideways, forward, yaw (rise, pitch, roll) from the first to the last ping.
        pings: number of pings, evenly spaced in time.
        span_s: time from the first to the last ping [s].
        snr_db: mean power of the taps that hold echoes over the variance of a tap's noise.
        free: which of the parameters are unknown, by their number.
    """
    information = impulse_information(sonar, height_m, motion, pings=pings, span_s=span_s, snr_db=snr_db, free=free)
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    size, axes = np.linalg.eigh(information * np.outer(scale, scale))
    unobservable = (axes[:, size < UNKNOWN] ** 2).sum(axis=1) > 1e-3
    variance = ((axes[:, size >= UNKNOWN] ** 2) / size[size >= UNKNOWN]).sum(axis=1) * scale**2
    return np.asarray(np.where(unobservable, np.inf, np.sqrt(variance)))


def channel_bound(
    sonar: ChannelSonar,
    height_m: float,
    motion: ArrayLike,
    degrees: Sequence[str] = tuple(DEGREES),
    *,
    pings: int = 2,
    span_s: float = 0.05,
    snr_db: float = NOISELESS_DB,
) -> Bound:
    """Return the bound of the motion from the first to the last ping along named degrees of freedom.

    Its ``covariance(1)`` is that of the motion, which the information of all pings already is about.

    Args:
        sonar: the instrument.
        height_m: height of the transmitter over the ground.
        motion: all six degrees of freedom, in the order of :data:`mitsonar.motion.composition.DEGREES` [m, rad].
        degrees: names of the k degrees of freedom that are unknown.
        pings: number of pings, evenly spaced in time.
        span_s: time from the first to the last ping [s].
        snr_db: mean power of the taps that hold echoes over the variance of a tap's noise.
    """
    named = dict(zip(DEGREES, np.asarray(motion, dtype=float).tolist(), strict=True))
    ordered, free = [named[name] for name in PARAMETERS], [PARAMETERS.index(name) for name in degrees]
    information = impulse_information(sonar, height_m, ordered, pings=pings, span_s=span_s, snr_db=snr_db, free=free)
    return Bound(information, np.zeros((len(degrees),) * 4))


def impulse_information(
    sonar: ChannelSonar,
    height_m: float,
    motion: ArrayLike,
    *,
    pings: int = 2,
    span_s: float = 0.05,
    snr_db: float = NOISELESS_DB,
    free: Sequence[int] = (0, 1),
) -> Array:
    """Return the Fisher information of the free parameters ``(k, k)``; the arguments are those of :func:`channel_crlb`.

    Raises:
        MitsonarError: fewer than two pings.
    """
    if pings < 2:
        raise MitsonarError(f"a bound needs two pings or more: got {pings}")
    full_motion = np.zeros(len(PARAMETERS))
    full_motion[: len(np.atleast_1d(motion))] = motion
    reach = 1.2 * max(float(np.abs(full_motion[:2]).max()) / (pings - 1), 0.1 * sonar.wavelength_m)
    total = np.zeros((len(free), len(free)))
    for band in bands_of(sonar):
        for receiver_band in receiver_bands_of(band.sonar, height_m, span_s / (pings - 1), reach):
            total += _information(
                receiver_band.law, _full_turn(receiver_band), full_motion, pings, 10 ** (-snr_db / 10), free
            )
    return total


def _full_turn(receiver_band: ReceiverBand) -> Array:
    """Return the matrix from motions of the vehicle to those in the receiver's axes ``(6, 6)``, with pitch and roll."""
    turn = np.eye(len(PARAMETERS))
    turn[:4, :4] = receiver_band.turn
    cos, sin = receiver_band.turn[0, 0], receiver_band.turn[1, 0]
    turn[4:, 4:] = [[cos, sin], [-sin, cos]]  # the turn about a level axis is the vector (-pitch, roll)
    return turn


def _information(
    law: ResponseCovariance, turn: Array, motion: Array, pings: int, noise: float, free: Sequence[int]
) -> Array:
    """Return the information from one receiver."""
    covariance = _covariance(law, turn @ motion, pings)
    power = float(np.diag(covariance).real.mean())
    inverse = np.linalg.inv(covariance + noise * power * np.eye(len(covariance)))
    whitened = []
    for number in free:
        step = turn[:, number] * STEP
        high, low = (_covariance(law, turn @ motion + sign * step, pings) for sign in (1, -1))
        whitened.append(inverse @ (high - low) / (2 * STEP))
    return np.array([[float(np.sum(one * two.T).real) for two in whitened] for one in whitened])


def _covariance(law: ResponseCovariance, motion: Array, pings: int) -> Complex:
    """Return the covariance of the taps of all pings, for a motion over all of them."""
    return block_toeplitz([law.covariance(motion / (pings - 1), lag) for lag in range(pings)])
