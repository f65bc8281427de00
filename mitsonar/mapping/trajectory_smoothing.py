"""Motions become a path: composition (Almanza-Medina, eq. 3.4), scale factors, smoothing by a weighted spline or by a Kalman
filter with RTS smoother, and how the motions' covariances grow into that of the pose.

The thesis composes its estimates as they come (3.5.1, 4.4.4, 5.4.5), multiplies single axes by constants where the sonar's
height or pitch was not known (3.5.2, 3.5.3), and leaves splines and Kalman filters to further work (6.2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import make_smoothing_spline

from mitsonar.errors import MitsonarError
from mitsonar.mapping.motion_series import MotionSeries
from mitsonar.motion.motion_errors import AXES

__all__ = ["fit_noise", "fit_wander", "kalman_smoothed", "spline_period", "spline_smoothed"]

Array = NDArray[np.float64]

FEWEST_FOR_SPLINE = 5
"""What SciPy's smoothing spline asks for; fewer motions are joined by straight lines."""

LONGEST_PERIOD = 2000.0
"""In motions: beyond, the spline is a straight line, and SciPy's equations lose their digits (from 6000 on)."""


# ---------------------------------------------------------------- splines


def spline_smoothed(measured: MotionSeries, period_s: ArrayLike | None = None) -> MotionSeries:
    """Velocities smoothed, axis by axis, by a cubic spline weighted with the inverse variances of the estimates (all motions
    alike where these are not known); motions that are not believed are bridged. After Henson and Zakharov, whom the thesis
    compares itself with (3.4.8, 3.5.3), who integrate such splines.

    Before the first and after the last believed motion the velocity stays as it was there. Fewer than five believed motions
    are not smoothed, but joined by straight lines. The covariance of the smoothed motions is not told (the Kalman filter
    tells one).

    Args:
        measured: the motions.
        period_s: a swing of this period [s] keeps half of its size, faster ones less; one number, or one an axis ``(3,)``.
            Not given: :func:`spline_period`. Beyond 2,000 motions the spline is a straight line, and no longer one is taken.
    """
    known, place, weight = _spline_data(measured)
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
            spline = make_smoothing_spline(place, values, w=weight[:, axis], lam=strength[axis])
            velocity[:, axis] = spline((held - measured.middle_s[known[0]]) / gap)
    return MotionSeries(velocity * measured.step_s[:, None], measured.time_s)


def spline_period(measured: MotionSeries) -> Array:
    """The period ``(3,)`` [s] at which :func:`spline_smoothed` halves a swing, chosen for each axis by generalised cross
    validation (Craven and Wahba, 1979) between two and 2,000 motions.

    SciPy's own choice is sought at 0 to n in the unit of the abscissa, so that it changes with the unit of time, and counts
    residuals without their weights; hence this one.
    """
    known, place, weight = _spline_data(measured)
    if known.size < FEWEST_FOR_SPLINE:
        raise MitsonarError(f"a spline's period needs {FEWEST_FOR_SPLINE} believed motions: got {known.size}; give more")
    values = measured.velocity[known]

    def score(log_period: Array) -> Array:
        return _generalised_cross_validation(place, values, weight, _strength(np.exp(log_period)))

    least = _least(score, np.log(np.full(3, 2.0)), np.log(np.full(3, LONGEST_PERIOD)))
    return np.exp(least) * _mean_gap(measured, known)


def _spline_data(measured: MotionSeries) -> tuple[NDArray[np.intp], Array, Array]:
    """Which motions are believed, where they lie (mean gap 1) and their weights (mean 1) for each axis."""
    known = np.flatnonzero(measured.believed)
    weight = np.broadcast_to(measured.step_s[known, None] ** 2, (known.size, 3))
    if measured.covariances is not None:
        weight = weight / _variances(measured)[known]
    place = (measured.middle_s[known] - measured.middle_s[known[0]]) / _mean_gap(measured, known)
    return known, place, weight / weight.mean(axis=0)


def _mean_gap(measured: MotionSeries, known: NDArray[np.intp]) -> float:
    span = measured.middle_s[known[-1]] - measured.middle_s[known[0]]
    return float(span / (known.size - 1)) if known.size > 1 else 1.0


def _strength(period: Array) -> Array:
    """The factor of the integral of f''^2 that halves a swing of a period in mean gaps, for weights of mean 1."""
    return (period / (2 * np.pi)) ** 4


def _generalised_cross_validation(x: Array, y: Array, w: Array, strength: Array) -> Array:
    """The score of smoothing splines of many strengths ``(many, axes)`` through y ``(n, axes)`` with weights w.

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
    """Solution ``(n, many, axes)`` of symmetric equations with five diagonals, of which the main one and the two above are
    given ``(3, n, many, axes)``, and the same diagonals of the inverse (Hutchinson and de Hoog, 1985)."""
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
    """Motions and covariances given all measurements: Kalman filter and Rauch-Tung-Striebel smoother.

    The state is the velocity in the vehicle's frame (sideways, forward, yaw); from the middle of one motion to that of the
    next it walks at random, independently on each axis; nothing is assumed of it beforehand. A measured motion is velocity
    times its time, with its whole 3 x 3 covariance. Motions that are not believed are filled in. The result's ``with_next``
    tells how the smoothed errors hang together, without which the pose's covariance would come out too small.

    Args:
        measured: the motions; where they have no covariances, :func:`fit_noise` gives them one for all.
        wander: how far the velocity walks in a second, one standard deviation: [m/s, m/s, rad/s] per root second ``(3,)``,
            growing with the root of time. Not given: :func:`fit_wander`.

    Raises:
        MitsonarError: a variance or wander that is not positive, or too few motions to tell them from.
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
    """Covariance of the velocity's change from each motion to the next ``(frames - 2, 3, 3)``."""
    return np.diff(measured.middle_s)[:, None, None] * np.diag(wander**2)


def _filtered(measured: MotionSeries, wander: Array) -> tuple[Array, Array, Array]:
    """Velocity after each measurement ``(n, 3)``, its covariance, and how far the smoother carries back what it learns from
    the next ``(n - 1, 3, 3)``: wholly, before the first believed motion."""
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
    """Smoothed velocity, its covariance, and that of each with the next."""
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
    """How far the velocity walks in a second ``(3,)`` [m/s, m/s, rad/s per root second]: maximum likelihood of the filter's
    innovations, each axis by itself with the variances on the diagonal of the covariances.

    Raises:
        MitsonarError: no covariances, a variance that is not positive, or one believed motion among several.
    """
    if measured.covariances is None:
        raise MitsonarError("fit_wander needs the motions' covariances: give them, or tell the noise by fit_noise")
    known = np.flatnonzero(measured.believed)
    if known.size == 1 < len(measured):
        raise MitsonarError(f"one believed motion of {len(measured)} tells no change of velocity: give wander")
    gap, seen = np.diff(measured.middle_s[known])[:, None], measured.velocity[known]
    noise = _variances(measured)[known] / measured.step_s[known, None] ** 2
    if known.size == 1:  # nothing to walk to
        return np.sqrt(noise[0])

    def surprise(log_walk: Array) -> Array:
        log_spread, chi = _innovations(seen, noise, gap, np.exp(log_walk))
        return log_spread + chi

    high = np.log(1e2 * (np.diff(seen, axis=0) ** 2 + noise[1:] + noise[:-1]).mean(axis=0) / gap.min())
    return np.exp(_least(surprise, high - np.log(1e14), high) / 2)


def fit_noise(measured: MotionSeries) -> Array:
    """Standard deviation of the motions' errors ``(3,)`` [m, m, rad], one for all motions, where an estimator tells none: by
    maximum likelihood together with the velocity's wander, from how much consecutive motions differ.

    Raises:
        MitsonarError: fewer than five believed motions, or an axis that never changes.
    """
    known = np.flatnonzero(measured.believed)
    seen, step = measured.velocity[known], measured.step_s[known, None]
    if known.size < 5:
        raise MitsonarError(f"the noise of motions is told from five of them or more: got {known.size}; give covariances")
    still = [axis.name for axis, values in zip(AXES, measured.motions[known].T, strict=True) if not np.ptp(values)]
    if still:
        raise MitsonarError(f"{still[0]} is the same in all motions, so that its noise cannot be told: give covariances")
    noise, gap = np.broadcast_to((step.mean() / step) ** 2, seen.shape), np.diff(measured.middle_s[known])[:, None]

    def power(log_walk: Array) -> tuple[Array, Array]:
        log_spread, chi = _innovations(seen, noise, gap, np.exp(log_walk))
        return log_spread, chi / len(gap)

    def surprise(log_walk: Array) -> Array:
        log_spread, each = power(log_walk)
        return log_spread + len(gap) * np.log(each)

    unit = np.full(3, -np.log(gap.mean()))  # a walk as large as the noise
    walk = _least(surprise, unit - np.log(1e10), unit + np.log(1e6))
    return np.asarray(np.sqrt(power(walk[None])[1][0]) * step.mean())


def _innovations(seen: Array, noise: Array, gap: Array, walk: Array) -> tuple[Array, Array]:
    """Sums over the motions of the log variance and the squared size of what surprises the filter, for many variances of the
    walk a second ``(many, 3)``; each axis by itself."""
    mean, variance = seen[0] + 0 * walk, noise[0] + 0 * walk
    log_spread, chi = 0 * walk, 0 * walk
    for k in range(1, len(seen)):
        ahead = variance + walk * gap[k - 1]
        spread = ahead + noise[k]
        news = seen[k] - mean
        gain = ahead / spread
        log_spread, chi = log_spread + np.log(spread), chi + news**2 / spread
        mean, variance = mean + gain * news, gain * noise[k]
    return log_spread, chi


def _variances(measured: MotionSeries) -> Array:
    """Variances of the motions ``(frames - 1, 3)``, positive where believed."""
    variance = np.diagonal(np.asarray(measured.covariances), axis1=1, axis2=2)
    for axis, values in zip(AXES, variance[measured.believed].T, strict=True):
        if not (values > 0).all():
            raise MitsonarError(f"smoothing needs variances above zero: got {values.min():g} for {axis.name}")
    return variance


def _least(score: Callable[[Array], Array], low: Array, high: Array, points: int = 25, rounds: int = 4) -> Array:
    """Where each of the columns of ``score((points, axes))`` is least between low and high: a grid, then finer ones."""
    columns = np.arange(low.size)
    for _ in range(rounds):
        grid = np.linspace(low, high, points)
        best = np.argmin(score(grid), axis=0)
        low, high = grid[np.maximum(best - 1, 0), columns], grid[np.minimum(best + 1, points - 1), columns]
    return np.asarray(grid[best, columns])


def _symmetric(matrix: Array) -> Array:
    return (matrix + matrix.T) / 2
