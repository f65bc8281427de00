"""Fisher information of a motion, and the least covariance that follows from it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError

__all__ = ["Bound", "fisher", "fisher_by", "overall", "together"]

SURE = 3.0
"""A direction is observable in which the information exceeds so many of its standard errors."""


@dataclass(frozen=True)
class Bound:
    """Fisher information of the motion in one frame.

    Attributes:
        information: F ``(3, 3)`` of sideways, forward [1/m^2] and yaw [1/rad^2].
        reason: covariance of the elements of F, from the noise of the rays that it was computed with ``(3, 3, 3, 3)``.
    """

    information: NDArray[np.float64]
    reason: NDArray[np.float64]

    def __add__(self, other: Bound) -> Bound:
        """Of two independent images."""
        return Bound(self.information + other.information, self.reason + other.reason)

    def covariance(self, frames: int = 1) -> NDArray[np.float64]:
        """Return the least covariance ``(3, 3)`` [m, m, rad]: of one frame against an oracle, or of two noisy frames.

        The pseudo-inverse where not all can be observed: the variance of an axis with a part in what cannot be is inf.
        """
        if frames not in (1, 2):
            raise MitsonarError(f"a bound is that of 1 or 2 noisy frames: got {frames}")
        diagonal = np.diag(self.information)
        scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
        size, axes = np.linalg.eigh(self.information * np.outer(scale, scale))
        known = size > np.maximum(SURE * self._error(axes * scale[:, None]), 1e-9)
        inverse = (axes[:, known] / size[known]) @ axes[:, known].T * np.outer(scale, scale)
        lost = (axes[:, ~known] ** 2).sum(axis=1) > 1e-3
        inverse[lost, :] = inverse[:, lost] = 0
        inverse[lost, lost] = np.inf
        return np.asarray(frames * inverse)

    def std(self, frames: int = 1) -> NDArray[np.float64]:
        """Return the least standard deviations ``(3,)`` [m, m, rad]; inf where an axis cannot be observed."""
        return np.asarray(np.sqrt(np.diag(self.covariance(frames))))

    @property
    def relative_error(self) -> NDArray[np.float64]:
        """Standard error of :meth:`std` as a part of it ``(3,)``; nan where an axis cannot be observed."""
        covariance = self.covariance()
        variance = np.diag(covariance)
        finite = np.where(np.isfinite(covariance), covariance, 0)
        return np.asarray(np.where(np.isfinite(variance), self._error(finite) / (2 * variance), np.nan))

    def _error(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the standard error of v' F v for each column v ``(3, n)``."""
        v = directions
        variance: NDArray[np.float64] = np.einsum("ijkl,in,jn,kn,ln->n", self.reason, v, v, v, v)
        return np.sqrt(np.maximum(variance, 0))


def fisher(jacobian: NDArray[np.float64], weight: NDArray[np.float64]) -> Bound:
    """Compute F = J1' W J2, made symmetric, and the covariance of its elements.

    Args:
        jacobian: two independent estimates of how k numbers of n independent values change with the motion ``(2, n, k, 3)``.
        weight: information of each value about its numbers ``(n, k, k)``.
    """
    return fisher_by(jacobian, lambda values: weight @ values)


def fisher_by(jacobian: NDArray[np.float64], weigh: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Bound:
    """Compute F = J1' W J2 of values that need not be independent; see :func:`fisher`.

    Args:
        jacobian: two independent estimates ``(2, n, k, 3)``.
        weigh: multiplies derivatives ``(n, k, 3)`` by the information of all values, W.

    With M the mean and D half the difference of both it is M' W M - D' W D, and the noise of M is as large as D.
    """
    mean, half = jacobian.mean(axis=0), (jacobian[0] - jacobian[1]) / 2
    weighted = weigh(half)
    own = mean.transpose(0, 2, 1) @ weigh(mean)
    own = (own + own.transpose(0, 2, 1)) / 2
    noise = half.transpose(0, 2, 1) @ weighted
    noise = (noise + noise.transpose(0, 2, 1)) / 2
    mixed = mean.transpose(0, 2, 1) @ weighted
    parts = np.concatenate([mixed + mixed.transpose(0, 2, 1), np.sqrt(2) * noise]).reshape(-1, 9)
    return Bound((own - noise).sum(axis=0), (parts.T @ parts).reshape(3, 3, 3, 3))


def together(parts: Sequence[Bound | None]) -> Bound | None:
    """Add the information of several views, whose noise is independent; None where one view alone has no bound."""
    known = [part for part in parts if part is not None]
    return sum(known[1:], known[0]) if len(known) == len(parts) else None


def overall(stds: Iterable[ArrayLike]) -> NDArray[np.float64]:
    """One number an axis for many poses ``(3,)``: the root of the mean variance, which an RMSE is to be compared with."""
    return np.asarray(np.sqrt(np.mean(np.square(np.array(list(stds), dtype=float)), axis=0)))
