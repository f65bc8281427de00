"""Smoothing of motions: by a weighted spline, or by a Kalman filter with RTS smoother.

Almanza-Medina composes estimates without smoothing (3.5.1, 4.4.4, 5.4.5), and leaves splines and Kalman filters to further
work (6.2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import make_smoothing_spline

from mitsonar.errors import MitsonarError
from mitsonar.mapping.motion_series import MotionSeries
from mitsonar.motion.errors import AXES

__all__ = ["fit_noise", "fit_wander", "kalman_smoothed", "spline_period", "spline_smoothed"]

Array = NDArray[np.float64]

FEWEST_FOR_SPLINE = 5
"""Fewest motions that SciPy's smoothing spline takes; fewer are joined by straight lines."""

LONGEST_PERIOD = 2000.0
"""Longest period [motions]: beyond, the spline is a straight line, and SciPy's equations lose their digits (from 6000)."""


# ---------------------------------------------------------------- splines


def spline_smoothed(measured: MotionSeries, period_s: ArrayLike | None = None) -> MotionSeries:
    """Smooth the velocities, axis by axis, by a cubic spline; bridge invalid motions.

    The weights are the inverse variances of the estimates; without covariances all motions weigh the same. Henson and
    Zakharov, whose method Almanza-Medina compares with (3.4.8, 3.5.3), integrate such splines. Before the first and after
    the last valid motion the velocity is constant. Fewer than five valid motions are not smoothed, but joined by straight
    lines. The smoothed motions have no covariance; those of :func:`kalman_smoothed` have one.

    Args:
        measured: the motions.
        period_s: an oscillation of this period [s] keeps half of its amplitude, faster ones less; one number, or one an
            axis ``(3,)``. Default: :func:`spline_period`. At most 2,000 motions: there the spline is a straight line.

    Raises:
        MitsonarError: a period that is not positive, or a variance that is not.
    """
    known, abscissa, weight = _spline_data(measured)
    velocity = np.column_stack(
        [np.interp(measured.middle_s, measured.middle_s[known], v[known]) for v in measured.velocity.T]
    )
    if known.size >= FEWEST_FOR_SPLINE:
        gap = _mean_gap(measured, known)
        period = np.asarray(spline_period(measured) if period_s is None else period_s, dtype=float)
        if not (period > 0).all() or period.shape not in ((), (3,)):
            raise MitsonarError(f"period_s must be a positive number of seconds, or three: got {period_s!r}")
        strength = _strength(np.minimum(np.broadcast_to(period, 3) / gap, LONGEST_PERIOD))
        held = np.clip(measured.middle_s, measured.middle_s[known[0]], measured.middle_s[known[-1]])
        for axis in range(3):
            values = measured.velocity[known, axis]
            spline = make_smoothing_spline(abscissa, values, w=weight[:, axis], lam=strength[axis])
            velocity[:, axis] = spline((held - measured.middle_s[known[0]]) / gap)
    return MotionSeries(velocity * measured.step_s[:, None], measured.time_s)


def spline_period(measured: MotionSeries) -> Array:
    """Choose the period ``(3,)`` [s] at which :func:`spline_smoothed` halves an oscillation.

    Each axis is chosen by generalised cross validation (Craven and Wahba, 1979), between two and 2,000 motions. SciPy's own
    choice changes with the unit of time, and ignores the weights of the residuals.

    Raises:
        MitsonarError: fewer than five valid motions.
    """
    known, abscissa, weight = _spline_data(measured)
    if known.size < FEWEST_FOR_SPLINE:
        raise MitsonarError(f"a spline's period needs {FEWEST_FOR_SPLINE} valid motions: got {known.size}; give more")
    values = measured.velocity[known]

    def score(log_period: Array) -> Array:
        return _generalised_cross_validation(abscissa, values, weight, _strength(np.exp(log_period)))

    least = _least(score, np.log(np.full(3, 2.0)), np.log(np.full(3, LONGEST_PERIOD)))
    return np.exp(least) * _mean_gap(measured, known)


def _spline_data(measured: MotionSeries) -> tuple[NDArray[np.intp], Array, Array]:
    """Return which motions are valid, their times (mean gap 1) and their weights for each axis (mean 1)."""
    known = np.flatnonzero(measured.believed)
    weight = np.broadcast_to(measured.step_s[known, None] ** 2, (known.size, 3))
    if measured.covariances is not None:
        weight = weight / _variances(measured)[known]
    abscissa = (measured.middle_s[known] - measured.middle_s[known[0]]) / _mean_gap(measured, known)
    return known, abscissa, weight / weight.mean(axis=0)


def _mean_gap(measured: MotionSeries, known: NDArray[np.intp]) -> float:
    span = measured.middle_s[known[-1]] - measured.middle_s[known[0]]
    return float(span / (known.size - 1)) if known.size > 1 else 1.0


def _strength(period: Array) -> Array:
    """Return the factor of the integral of f''^2 that halves an oscillation of a period [mean gaps]; weights of mean 1."""
    return (period / (2 * np.pi)) ** 4


def _generalised_cross_validation(x: Array, y: Array, w: Array, strength: Array) -> Array:
    """Score smoothing splines of many strengths ``(many, axes)`` through y ``(n, axes)`` with weights w.

    In Reinsch's form: with B = R + strength S, S = Q'W^-1Q and B c = Q'y, the residuals are strength W^-1 Q c, and the trace
    of (1 - hat matrix) is that of strength B^-1 S.
    """
    h = np.diff(x)[:, None]
    a, c = 1 / h[:-1], 1 / h[1:]  # Q takes second differences: its columns are a, b, c
    b = -(a + c)
    r, s = np.zeros((3, len(a), 1)), np.zeros((3, len(a), y.shape[1]))  # diagonals: the main one, and those above
    r[0], r[1, :-1] = (h[:-1] + h[1:]) / 3, h[1:-1] / 6
    s[0] = a**2 / w[:-2] + b**2 / w[1:-1] + c**2 / w[2:]
    s[1, :-1] = b[:-1] * a[1:] / w[1:-2] + c[:-1] * b[1:] / w[2:-1]
    s[2, :-2] = c[:-2] * a[2:] / w[2:-2]
    s = s[:, :, None]
    curve, inverse = _five_diagonals(r[:, :, None] + strength * s, a * y[:-2] + b * y[1:-1] + c * y[2:])
    misfit, free = (s[0] * curve * curve).sum(axis=0), (s[0] * inverse[0]).sum(axis=0)
    for k in (1, 2):
        misfit += 2 * (s[k, :-k] * curve[:-k] * curve[k:]).sum(axis=0)
        free += 2 * (s[k] * inverse[k]).sum(axis=0)
    return np.asarray(len(x) * misfit / free**2)


def _five_diagonals(band: Array, right: Array) -> tuple[Array, Array]:
    """Solve symmetric equations with five diagonals (Hutchinson and de Hoog, 1985).

    ``band`` is the main diagonal and the two above ``(3, n, many, axes)``. Return the solution ``(n, many, axes)`` and the
    same diagonals of the inverse.
    """
    _, n, *many = band.shape
    d, z, l1, l2 = np.zeros((4, n + 2, *many))  # B = L d L', L z = right; two zeros before the first
    for i in range(2, n + 2):
        d[i] = band[0, i - 2] - l1[i - 1] ** 2 * d[i - 1] - l2[i - 2] ** 2 * d[i - 2]
        z[i] = right[i - 2] - l1[i - 1] * z[i - 1] - l2[i - 2] * z[i - 2]
        l1[i] = (band[1, i - 2] - l1[i - 1] * d[i - 1] * l2[i - 1]) / d[i]
        l2[i] = band[2, i - 2] / d[i]
    d, z, l1, l2 = d[2:], z[2:], l1[2:], l2[2:]
    solution, inverse = np.zeros((n + 2, *many)), np.zeros((3, n + 2, *many))  # two zeros after the last
    for i in range(n - 1, -1, -1):
        solution[i] = z[i] / d[i] - l1[i] * solution[i + 1] - l2[i] * solution[i + 2]
        inverse[2, i] = -l1[i] * inverse[1, i + 1] - l2[i] * inverse[0, i + 2]
        inverse[1, i] = -l1[i] * inverse[0, i + 1] - l2[i] * inverse[1, i + 1]
        inverse[0, i] = 1 / d[i] - l1[i] * inverse[1, i] - l2[i] * inverse[2, i]
    return solution[:-2], inverse[:, :-2]


# ---------------------------------------------------------------- Kalman filter


def kalman_smoothed(measured: MotionSeries, wander: ArrayLike | None = None) -> MotionSeries:
    """Estimate motions and covariances from all measurements: Kalman filter and Rauch-Tung-Striebel smoother.

    The state is the velocity in the vehicle's frame (sideways, forward, yaw). From the middle of one motion to that of the
    next it is a random walk, independent on each axis, with no prior. A measured motion is velocity times its time, with its
    whole 3 x 3 covariance. Invalid motions are filled in. ``with_next`` of the result holds the covariances of consecutive
    errors; without them the covariance of the pose would be too small.

    Args:
        measured: the motions; where they have no covariances, :func:`fit_noise` estimates one for all.
        wander: standard deviation of the random walk after a second: [m/s, m/s, rad/s] per root second ``(3,)``; it grows
            with the root of time. Default: :func:`fit_wander`.

    Raises:
        MitsonarError: a variance or wander that is not positive, or too few motions to estimate them.
    """
    if measured.covariances is None:
        covariances = np.tile(np.diag(fit_noise(measured) ** 2), (len(measured), 1, 1))
        measured = replace(measured, covariances=covariances)
    walk = np.asarray(fit_wander(measured) if wander is None else wander, dtype=float)
    if walk.shape != (3,) or not (np.isfinite(walk) & (walk > 0)).all():
        raise MitsonarError(f"wander must be three positive numbers (m/s, m/s, rad/s per root second): got {wander!r}")
    _variances(measured)
    mean, covariance, gain = _filtered(measured, walk)
    mean, covariance, lag = _rts(mean, covariance, gain, _walked(measured, walk))
    step = measured.step_s
    squared, crossed = (step**2)[:, None, None], (step[:-1] * step[1:])[:, None, None]
    return MotionSeries(mean * step[:, None], measured.time_s, covariance * squared, with_next=lag * crossed)


def _walked(measured: MotionSeries, wander: Array) -> Array:
    """Return the covariance of the change of velocity from each motion to the next ``(frames - 2, 3, 3)``."""
    return np.diff(measured.middle_s)[:, None, None] * np.diag(wander**2)


def _filtered(measured: MotionSeries, wander: Array) -> tuple[Array, Array, Array]:
    """Return the filtered velocity ``(n, 3)``, its covariance, and the gain of the smoother ``(n - 1, 3, 3)``.

    Before the first valid motion the gain is the identity.
    """
    seen, noise = measured.velocity, np.asarray(measured.covariances) / (measured.step_s**2)[:, None, None]
    walked = _walked(measured, wander)
    first = int(np.argmax(measured.believed))
    n, one = len(measured), np.eye(3)
    mean, covariance = np.tile(seen[first], (n, 1)), np.zeros((n, 3, 3))
    back = np.tile(one, (max(n - 1, 0), 1, 1))
    covariance[first] = noise[first]
    for k in range(first + 1, n):
        ahead = covariance[k - 1] + walked[k - 1]
        back[k - 1] = np.linalg.solve(ahead, covariance[k - 1]).T
        mean[k], covariance[k] = mean[k - 1], ahead
        if measured.believed[k]:
            gain = np.linalg.solve(ahead + noise[k], ahead).T
            mean[k] += gain @ (seen[k] - mean[k - 1])
            # Joseph's form: a sum of two squares, so that rounding cannot make it negative
            covariance[k] = _symmetric((one - gain) @ ahead @ (one - gain).T + gain @ noise[k] @ gain.T)
    return mean, covariance, back


def _rts(mean: Array, covariance: Array, back: Array, walked: Array) -> tuple[Array, Array, Array]:
    """Return the smoothed velocity, its covariance, and the covariance of each with the next."""
    mean, covariance, lag = mean.copy(), covariance.copy(), np.zeros_like(back)
    one = np.eye(3)
    for k in range(len(mean) - 2, -1, -1):
        gain, rest = back[k], one - back[k]
        lag[k] = gain @ covariance[k + 1]
        mean[k] += gain @ (mean[k + 1] - mean[k])
        # P - G (P + Q) G' + G P' G', written as a sum of squares
        covariance[k] = _symmetric(rest @ covariance[k] @ rest.T + gain @ (covariance[k + 1] + walked[k]) @ gain.T)
    return mean, covariance, lag


def fit_wander(measured: MotionSeries) -> Array:
    """Estimate the random walk of the velocity in a second ``(3,)`` [m/s, m/s, rad/s per root second].

    It maximises the likelihood of the filter's innovations, each axis by itself, with the diagonal of the covariances.

    Raises:
        MitsonarError: no covariances, a variance that is not positive, or one valid motion among several.
    """
    if measured.covariances is None:
        raise MitsonarError("fit_wander needs the motions' covariances: give them, or estimate the noise with fit_noise")
    known = np.flatnonzero(measured.believed)
    if known.size == 1 < len(measured):
        raise MitsonarError(f"one valid motion of {len(measured)} shows no change of velocity: give wander")
    gap, seen = np.diff(measured.middle_s[known])[:, None], measured.velocity[known]
    noise = _variances(measured)[known] / measured.step_s[known, None] ** 2
    if known.size == 1:  # nothing to walk to
        return np.asarray(np.sqrt(noise[0]))

    def misfit(log_walk: Array) -> Array:
        log_spread, chi = _innovations(seen, noise, gap, np.exp(log_walk))
        return np.asarray(log_spread + chi)

    high = np.log(1e2 * (np.diff(seen, axis=0) ** 2 + noise[1:] + noise[:-1]).mean(axis=0) / gap.min())
    return np.exp(_least(misfit, high - np.log(1e14), high) / 2)


def fit_noise(measured: MotionSeries) -> Array:
    """Estimate the standard deviation of the errors ``(3,)`` [m, m, rad], one for all motions, from their differences.

    It maximises the likelihood jointly with the random walk of the velocity.

    Raises:
        MitsonarError: fewer than five valid motions, or an axis that never changes.
    """
    known = np.flatnonzero(measured.believed)
    seen, step = measured.velocity[known], measured.step_s[known, None]
    if known.size < 5:
        raise MitsonarError(f"the noise of motions needs five of them or more: got {known.size}; give covariances")
    still = [axis.name for axis, values in zip(AXES, measured.motions[known].T, strict=True) if not np.ptp(values)]
    if still:
        raise MitsonarError(
            f"{still[0]} is the same in all motions, so that its noise cannot be estimated: give covariances"
        )
    noise, gap = np.broadcast_to((step.mean() / step) ** 2, seen.shape), np.diff(measured.middle_s[known])[:, None]

    def power(log_walk: Array) -> tuple[Array, Array]:
        log_spread, chi = _innovations(seen, noise, gap, np.exp(log_walk))
        return log_spread, chi / len(gap)

    def misfit(log_walk: Array) -> Array:
        log_spread, each = power(log_walk)
        return np.asarray(log_spread + len(gap) * np.log(each))

    unit = np.full(3, -np.log(gap.mean()))  # a walk as large as the noise
    walk = _least(misfit, unit - np.log(1e10), unit + np.log(1e6))
    return np.asarray(np.sqrt(power(walk[None])[1][0]) * step.mean())


def _innovations(seen: Array, noise: Array, gap: Array, walk: Array) -> tuple[Array, Array]:
    """Sum the log variances and the normalised squares of the filter's innovations, each axis by itself.

    ``walk`` holds many variances of the random walk in a second ``(many, 3)``.
    """
    mean, variance = seen[0] + 0 * walk, noise[0] + 0 * walk
    log_spread, chi = 0 * walk, 0 * walk
    for k in range(1, len(seen)):
        ahead = variance + walk * gap[k - 1]
        spread = ahead + noise[k]
        innovation = seen[k] - mean
        gain = ahead / spread
        log_spread, chi = log_spread + np.log(spread), chi + innovation**2 / spread
        mean, variance = mean + gain * innovation, gain * noise[k]
    return log_spread, chi


def _variances(measured: MotionSeries) -> Array:
    """Return the variances of the motions ``(frames - 1, 3)``, positive where valid."""
    variance = np.diagonal(np.asarray(measured.covariances), axis1=1, axis2=2)
    for axis, values in zip(AXES, variance[measured.believed].T, strict=True):
        if not (values > 0).all():
            raise MitsonarError(f"smoothing needs variances above zero: got {values.min():g} for {axis.name}")
    return variance


def _least(score: Callable[[Array], Array], low: Array, high: Array, points: int = 25, rounds: int = 4) -> Array:
    """Return where each column of ``score((points, axes))`` is least between low and high: a grid, then finer ones."""
    columns = np.arange(low.size)
    for _ in range(rounds):
        grid = np.linspace(low, high, points)
        best = np.argmin(score(grid), axis=0)
        low, high = grid[np.maximum(best - 1, 0), columns], grid[np.minimum(best + 1, points - 1), columns]
    return np.asarray(grid[best, columns])


def _symmetric(matrix: Array) -> Array:
    return (matrix + matrix.T) / 2
