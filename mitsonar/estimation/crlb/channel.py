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
from mitsonar.instruments.hydrophones import ChannelSonar

__all__ = ["NOISELESS_DB", "channel_crlb", "impulse_information"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

NOISELESS_DB = 60.0
"""Signal-to-noise ratio that counts as "without noise": below lies the error of the integral over the ground."""

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

    The parameters are sideways, forward [m], yaw [rad] and rise [m]. A parameter that cannot be observed has inf.

    Args:
        sonar: the instrument.
        height_m: height of the transmitter over the ground.
        motion: sideways, forward, yaw (and rise) from the first to the last ping.
        pings: number of pings, evenly spaced in time.
        span_s: time from the first to the last ping [s].
        snr_db: mean power of the taps that hold echoes over the variance of a tap's noise.
        free: which of the four parameters are unknown.
    """
    information = impulse_information(sonar, height_m, motion, pings=pings, span_s=span_s, snr_db=snr_db, free=free)
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    size, axes = np.linalg.eigh(information * np.outer(scale, scale))
    unobservable = (axes[:, size < UNKNOWN] ** 2).sum(axis=1) > 1e-3
    variance = ((axes[:, size >= UNKNOWN] ** 2) / size[size >= UNKNOWN]).sum(axis=1) * scale**2
    return np.asarray(np.where(unobservable, np.inf, np.sqrt(variance)))


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
    full_motion = np.zeros(4)
    full_motion[: len(np.atleast_1d(motion))] = motion
    reach = 1.2 * max(float(np.abs(full_motion[:2]).max()) / (pings - 1), 0.1 * sonar.wavelength_m)
    total = np.zeros((len(free), len(free)))
    for band in bands_of(sonar):
        for receiver_band in receiver_bands_of(band.sonar, height_m, span_s / (pings - 1), reach):
            total += _information(receiver_band, full_motion, pings, 10 ** (-snr_db / 10), free)
    return total


def _information(receiver_band: ReceiverBand, motion: Array, pings: int, noise: float, free: Sequence[int]) -> Array:
    """Return the information from one receiver."""
    covariance = _covariance(receiver_band.law, receiver_band.turn @ motion, pings)
    power = float(np.diag(covariance).real.mean())
    inverse = np.linalg.inv(covariance + noise * power * np.eye(len(covariance)))
    whitened = []
    for number in free:
        step = receiver_band.turn[:, number] * STEP
        high, low = (_covariance(receiver_band.law, receiver_band.turn @ motion + sign * step, pings) for sign in (1, -1))
        whitened.append(inverse @ (high - low) / (2 * STEP))
    return np.array([[float(np.sum(one * two.T).real) for two in whitened] for one in whitened])


def _covariance(law: ResponseCovariance, motion: Array, pings: int) -> Complex:
    """Return the covariance of the taps of all pings, for a motion over all of them."""
    return block_toeplitz([law.covariance(motion / (pings - 1), lag) for lag in range(pings)])
