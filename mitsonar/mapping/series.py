"""How motions between consecutive frames become a path, and how the errors of the path follow from theirs.

A :class:`MotionSeries` holds motions with their covariances. Functions here compose it to a path (Almanza-Medina, eq. 3.4),
scale it, smooth it, and propagate its covariances to those of the poses, with errors that may be correlated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import make_smoothing_spline
from scipy.linalg import block_diag
from scipy.stats import chi2

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate
from mitsonar.motion.errors import AXES
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory

__all__ = [
    "YAW_ADVICE",
    "CorrelatedErrors",
    "Ellipse",
    "ErrorCorrelation",
    "MotionSeries",
    "bridged",
    "ellipse",
    "fit_noise",
    "fit_scale",
    "fit_wander",
    "kalman_smoothed",
    "path_of",
    "pose_covariances",
    "scaled",
    "spline_period",
    "spline_smoothed",
]


Array = NDArray[np.float64]


@dataclass(frozen=True)
class MotionSeries:
    """Motions between consecutive frames, with the statistics of their errors.

    Attributes:
        motions: sideways, forward [m], yaw [rad] ``(frames - 1, 3)`` (eq. 3.4).
        time_s: times of the frames ``(frames,)`` [s], increasing, not necessarily evenly spaced.
        covariances: covariances of the errors of the motions ``(frames - 1, 3, 3)`` [m, m, rad], if known.
        valid: False where a motion and its covariance must not be used ``(frames - 1,)``; None: all are valid.
        with_next: covariance of the error of each motion (rows) with that of the next (columns) ``(frames - 2, 3, 3)``.
            Errors further apart depend on each other only through those between (Markov). None: errors are independent.

    Raises:
        MitsonarError: shapes do not fit, times do not increase, no motion is valid, or a valid motion is not finite or has
            no valid covariance.
    """

    motions: Array
    time_s: Array
    covariances: Array | None = None
    valid: NDArray[np.bool_] | None = None
    with_next: Array | None = None

    def __post_init__(self) -> None:
        count = len(self.time_s) - 1
        if count < 1:
            raise MitsonarError(f"a path needs two frames or more: got {count + 1}; give a longer run")
        if self.motions.shape != (count, 3):
            raise MitsonarError(f"motions must be ({count}, 3) for {count + 1} frame times: got {self.motions.shape}")
        if not (np.isfinite(self.time_s).all() and (np.diff(self.time_s) > 0).all()):
            raise MitsonarError("frame times must be finite and increase: sort the frames, or give their times")
        if self.is_valid.shape != (count,):
            raise MitsonarError(f"valid must be ({count},), one for each motion: got {self.is_valid.shape}")
        if not self.is_valid.any():
            raise MitsonarError(f"none of {count} motions is valid, so that there is no path: try another estimator")
        self._refuse(~np.isfinite(self.motions).all(axis=1), "is not finite")
        if self.covariances is not None:
            self._check_covariances(self.covariances)
        if self.with_next is not None and self.with_next.shape != (count - 1, 3, 3):
            raise MitsonarError(f"with_next must be ({count - 1}, 3, 3): got {self.with_next.shape}")

    def _check_covariances(self, covariances: Array) -> None:
        if covariances.shape != (len(self), 3, 3):
            raise MitsonarError(f"covariances must be ({len(self)}, 3, 3), one per motion: got {covariances.shape}")
        self._refuse(~np.isfinite(covariances).all(axis=(1, 2)), "has a covariance that is not finite")
        known = np.where(self.is_valid[:, None, None], covariances, np.eye(3))
        crooked = np.abs(known - known.swapaxes(1, 2)).max(axis=(1, 2)) > 1e-9 * np.abs(known).max(axis=(1, 2))
        least = np.linalg.eigvalsh(known)
        self._refuse(crooked | (least[:, 0] < -1e-9 * least[:, 2]), "has an asymmetric covariance, or a negative variance")

    def _refuse(self, bad: ArrayLike, what: str) -> None:
        where = np.flatnonzero(np.asarray(bad) & self.is_valid)
        if where.size:
            raise MitsonarError(
                f"the motion from frame {where[0]} to {where[0] + 1} {what} ({where.size} of {len(self)} motions): "
                "mark it as not valid, or leave it out"
            )

    def __len__(self) -> int:
        """Return the number of motions, one less than the number of frames."""
        return len(self.time_s) - 1

    @classmethod
    def from_estimates(cls, estimates: Sequence[Estimate], time_s: ArrayLike) -> Self:
        """Collect the estimates of consecutive frames at ``time_s`` ``(frames,)`` [s].

        The series has covariances only if every valid estimate has one.
        """
        valid = np.array([estimate.valid for estimate in estimates], dtype=bool)
        unknown = np.full((3, 3), np.nan)
        covariances = [unknown if one.covariance is None else one.covariance for one in estimates]
        known = all(one.covariance is not None for one in estimates if one.valid)
        motions = np.array([one.motion for one in estimates], dtype=float).reshape(-1, 3)
        return cls(motions, np.asarray(time_s, dtype=float), np.array(covariances) if known else None, valid)

    @cached_property
    def is_valid(self) -> NDArray[np.bool_]:
        """Return whether each motion is valid ``(frames - 1,)``."""
        return np.ones(len(self), dtype=bool) if self.valid is None else self.valid

    @cached_property
    def step_s(self) -> Array:
        """Return the time from frame to frame ``(frames - 1,)`` [s]."""
        return np.diff(self.time_s)

    @cached_property
    def middle_s(self) -> Array:
        """Return the time half-way through each motion ``(frames - 1,)`` [s], to which its mean velocity is assigned."""
        return (self.time_s[1:] + self.time_s[:-1]) / 2

    @cached_property
    def velocity(self) -> Array:
        """Return the mean velocity of each motion in the vehicle frame ``(frames - 1, 3)`` [m/s, m/s, rad/s]."""
        return self.motions / self.step_s[:, None]


# ---------------- Composition


def path_of(motions: ArrayLike, start: Pose, time_s: ArrayLike) -> Trajectory:
    """Compose motions to a path that begins at ``start`` (Almanza-Medina, eq. 3.4).

    Each step is :func:`mitsonar.motion.composition.compose`; :func:`mitsonar.motion.composition.motions` is the inverse.
    Height, pitch and roll stay those of ``start``.

    Args:
        motions: sideways, forward [m], yaw [rad] ``(frames - 1, 3)``.
        start: first pose.
        time_s: times of the frames ``(frames,)`` [s].

    Raises:
        MitsonarError: shapes do not fit, a motion is not finite, or times do not increase.
    """
    series = MotionSeries(np.asarray(motions, dtype=float), np.asarray(time_s, dtype=float))
    sideways, forward, yaw = series.motions.T
    heading = start.heading + np.cumsum(yaw)
    sin, cos = np.sin(heading), np.cos(heading)
    poses = np.tile(np.asarray(start, dtype=float), (len(series) + 1, 1))
    poses[1:, 0] += np.cumsum(forward * sin + sideways * cos)
    poses[1:, 1] += np.cumsum(forward * cos - sideways * sin)
    poses[1:, 5] = heading
    return Trajectory(poses, series.time_s)


# ---------------- Scale


def scaled(measured: MotionSeries, factors: ArrayLike) -> MotionSeries:
    """Multiply motions and their covariances by a factor for each of sideways, forward, yaw ``(3,)``.

    Almanza-Medina uses 2.3 for sideways (3.5.2), and 9.0 for sideways with 4.0 for forward (3.5.3).

    Raises:
        MitsonarError: the factors are not three finite numbers.
    """
    factor = np.asarray(factors, dtype=float)
    if factor.shape != (3,) or not np.isfinite(factor).all():
        raise MitsonarError(f"scale factors are three finite numbers, for sideways, forward, yaw: got {factors!r}")
    both = np.outer(factor, factor)
    covariances, with_next = (None if c is None else c * both for c in (measured.covariances, measured.with_next))
    return replace(measured, motions=measured.motions * factor, covariances=covariances, with_next=with_next)


def fit_scale(estimated: ArrayLike, true: ArrayLike) -> Array:
    """Fit the factors ``(3,)`` that scale estimated to true motions, both ``(frames - 1, 3)``.

    Each axis is fitted by least squares through the origin. An axis whose estimates are all zero has factor 1. Noise in the
    estimates biases a factor low, by the ratio of signal power to signal plus noise power.

    Raises:
        MitsonarError: the motions differ in shape, or are not finite.
    """
    e, t = np.asarray(estimated, dtype=float), np.asarray(true, dtype=float)
    if e.shape != t.shape or e.ndim != 2 or e.shape[1] != 3 or not (np.isfinite(e).all() and np.isfinite(t).all()):
        raise MitsonarError(
            f"scale factors need finite true and estimated motions of one shape (motions, 3): got {e.shape} and {t.shape}"
        )
    power = (e * e).sum(axis=0)
    return np.where(power > 0, (e * t).sum(axis=0) / np.where(power > 0, power, 1), 1.0)


def bridged(measured: MotionSeries) -> MotionSeries:
    """Fill in invalid motions from the valid ones, which stay as measured.

    If covariances are known, the Kalman smoother fills the gaps and supplies their covariances. Otherwise the velocity is
    interpolated linearly between its neighbours.
    """
    known = np.flatnonzero(measured.is_valid)
    if known.size == len(measured):
        return measured
    if measured.covariances is not None and known.size > 1:
        filled = kalman_smoothed(measured)
        fill, fill_covariances = filled.motions, filled.covariances
    else:
        middle = measured.middle_s
        velocity = np.column_stack([np.interp(middle, middle[known], v[known]) for v in measured.velocity.T])
        fill, fill_covariances = velocity * measured.step_s[:, None], None
        if measured.covariances is not None:  # from a single motion: as uncertain as it is large
            large = np.diag(measured.motions[known[0]] ** 2)
            fill_covariances = np.broadcast_to(measured.covariances[known[0]] + large, (len(measured), 3, 3))
    together = np.where(measured.is_valid[:, None], measured.motions, fill)
    if fill_covariances is None or measured.covariances is None:
        return MotionSeries(together, measured.time_s)
    covariances = np.where(measured.is_valid[:, None, None], measured.covariances, fill_covariances)
    return MotionSeries(together, measured.time_s, covariances)


# ---------------- Smoothing: weighted spline
# Almanza-Medina composes estimates without smoothing (3.5.1, 4.4.4, 5.4.5), and leaves splines and Kalman filters to
# future work (6.2).


FEWEST_FOR_SPLINE = 5
"""Smallest number of motions that SciPy's smoothing spline accepts; fewer are interpolated linearly."""

LONGEST_PERIOD = 2000.0
"""Longest period [motions]; beyond, the spline is a straight line, and from 6000 SciPy's equations lose precision."""


def spline_smoothed(measured: MotionSeries, period_s: ArrayLike | None = None) -> MotionSeries:
    """Smooth the velocities, axis by axis, with a cubic spline, and bridge invalid motions.

    The weights are the inverse variances of the estimates; without covariances all motions weigh the same. Henson and
    Zakharov, whose method Almanza-Medina compares with (3.4.8, 3.5.3), integrate such splines. Before the first and after
    the last valid motion the velocity is constant. Fewer than five valid motions are interpolated linearly, without
    smoothing. The smoothed motions have no covariance; those of :func:`kalman_smoothed` do.

    Args:
        measured: motions to smooth.
        period_s: period [s] of an oscillation whose amplitude is halved; faster ones are damped more. One number, or one per
            axis ``(3,)``. Default: :func:`spline_period`. It is capped at 2,000 motions, where the spline is a straight
            line.

    Raises:
        MitsonarError: a period or a variance is not positive.
    """
    # 1. fallback for few motions: linear interpolation of the velocities
    known, abscissa, weight = _spline_data(measured)
    velocity = np.column_stack(
        [np.interp(measured.middle_s, measured.middle_s[known], v[known]) for v in measured.velocity.T]
    )
    # 2. the spline, over times in units of the mean gap; clipping them holds the velocity constant beyond the ends
    if known.size >= FEWEST_FOR_SPLINE:
        gap = _mean_gap(measured, known)
        period = np.asarray(spline_period(measured) if period_s is None else period_s, dtype=float)
        if not (period > 0).all() or period.shape not in ((), (3,)):
            raise MitsonarError(f"period_s must be a positive number of seconds, or three: got {period_s!r}")
        strength = _strength(np.minimum(np.broadcast_to(period, 3) / gap, LONGEST_PERIOD))
        clamped_s = np.clip(measured.middle_s, measured.middle_s[known[0]], measured.middle_s[known[-1]])
        for axis in range(3):
            values = measured.velocity[known, axis]
            spline = make_smoothing_spline(abscissa, values, w=weight[:, axis], lam=strength[axis])
            velocity[:, axis] = spline((clamped_s - measured.middle_s[known[0]]) / gap)
    return MotionSeries(velocity * measured.step_s[:, None], measured.time_s)


def spline_period(measured: MotionSeries) -> Array:
    """Choose the periods ``(3,)`` [s] at which :func:`spline_smoothed` halves an oscillation.

    The period of each axis is chosen by generalised cross validation (Craven and Wahba, 1979), between two and 2,000
    motions. SciPy's choice depends on the unit of time, and ignores the weights of the residuals.

    Raises:
        MitsonarError: fewer than five motions are valid.
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
    """Return the indices of the valid motions, their times (mean gap 1) and their weights on each axis (mean 1)."""
    known = np.flatnonzero(measured.is_valid)
    weight = np.broadcast_to(measured.step_s[known, None] ** 2, (known.size, 3))
    if measured.covariances is not None:
        weight = weight / _variances(measured)[known]
    abscissa = (measured.middle_s[known] - measured.middle_s[known[0]]) / _mean_gap(measured, known)
    return known, abscissa, weight / weight.mean(axis=0)


def _mean_gap(measured: MotionSeries, known: NDArray[np.intp]) -> float:
    span = measured.middle_s[known[-1]] - measured.middle_s[known[0]]
    return float(span / (known.size - 1)) if known.size > 1 else 1.0


def _strength(period: Array) -> Array:
    """Return the weight of the integral of f''^2 that halves an oscillation of this period [mean gaps].

    The weights of the residuals have mean 1.
    """
    return (period / (2 * np.pi)) ** 4


def _generalised_cross_validation(x: Array, y: Array, w: Array, strength: Array) -> Array:
    """Score smoothing splines of many strengths ``(many, axes)`` through y ``(n, axes)`` with weights w.

    In Reinsch's form, with B = R + strength S, S = Q'W^-1Q and B c = Q'y, the residuals are strength W^-1 Q c, and the trace
    of (1 - hat matrix) is the trace of strength B^-1 S. The strength cancels in the score.
    """
    # 1. columns of Q: weighted second differences
    h = np.diff(x)[:, None]
    a, c = 1 / h[:-1], 1 / h[1:]
    b = -(a + c)
    # 2. diagonals of R and S: the main one and the two above, since both are symmetric and banded
    r, s = np.zeros((3, len(a), 1)), np.zeros((3, len(a), y.shape[1]))
    r[0], r[1, :-1] = (h[:-1] + h[1:]) / 3, h[1:-1] / 6
    s[0] = a**2 / w[:-2] + b**2 / w[1:-1] + c**2 / w[2:]
    s[1, :-1] = b[:-1] * a[1:] / w[1:-2] + c[:-1] * b[1:] / w[2:-1]
    s[2, :-2] = c[:-2] * a[2:] / w[2:-2]
    # 3. solve for the curvature c, and find the same diagonals of B^-1, which suffice for the trace
    s = s[:, :, None]
    curve, inverse = _five_diagonals(r[:, :, None] + strength * s, a * y[:-2] + b * y[1:-1] + c * y[2:])
    # 4. weighted sum of squared residuals c'Sc, and trace of B^-1 S; off-diagonals count twice
    misfit, free = (s[0] * curve * curve).sum(axis=0), (s[0] * inverse[0]).sum(axis=0)
    for k in (1, 2):
        misfit += 2 * (s[k, :-k] * curve[:-k] * curve[k:]).sum(axis=0)
        free += 2 * (s[k] * inverse[k]).sum(axis=0)
    return np.asarray(len(x) * misfit / free**2)


def _five_diagonals(band: Array, right: Array) -> tuple[Array, Array]:
    """Solve symmetric equations with five diagonals (Hutchinson and de Hoog, 1985).

    ``band`` holds the main diagonal and the two above ``(3, n, many, axes)``. Return the solution ``(n, many, axes)`` and
    the same diagonals of the inverse.
    """
    _, n, *many = band.shape
    # 1. forward: factor B = L d L' and solve L z = right; two leading zeros avoid special cases
    d, z, l1, l2 = np.zeros((4, n + 2, *many))
    for i in range(2, n + 2):
        d[i] = band[0, i - 2] - l1[i - 1] ** 2 * d[i - 1] - l2[i - 2] ** 2 * d[i - 2]
        z[i] = right[i - 2] - l1[i - 1] * z[i - 1] - l2[i - 2] * z[i - 2]
        l1[i] = (band[1, i - 2] - l1[i - 1] * d[i - 1] * l2[i - 1]) / d[i]
        l2[i] = band[2, i - 2] / d[i]
    d, z, l1, l2 = d[2:], z[2:], l1[2:], l2[2:]
    # 2. backward: substitute, and find the band of the inverse from the rows below; two trailing zeros
    solution, inverse = np.zeros((n + 2, *many)), np.zeros((3, n + 2, *many))
    for i in range(n - 1, -1, -1):
        solution[i] = z[i] / d[i] - l1[i] * solution[i + 1] - l2[i] * solution[i + 2]
        inverse[2, i] = -l1[i] * inverse[1, i + 1] - l2[i] * inverse[0, i + 2]
        inverse[1, i] = -l1[i] * inverse[0, i + 1] - l2[i] * inverse[1, i + 1]
        inverse[0, i] = 1 / d[i] - l1[i] * inverse[1, i] - l2[i] * inverse[2, i]
    return solution[:-2], inverse[:, :-2]


# ---------------- Smoothing: Kalman filter and RTS smoother


def kalman_smoothed(measured: MotionSeries, wander: ArrayLike | None = None) -> MotionSeries:
    """Smooth motions with a Kalman filter and a Rauch-Tung-Striebel smoother, and estimate their covariances.

    The state is the velocity in the vehicle frame (sideways, forward, yaw). Between the middles of consecutive motions it is
    a random walk, independent on each axis, with no prior. A measured motion is the velocity times the duration of the
    motion, with its full 3 x 3 covariance. Invalid motions are filled in. ``with_next`` of the result holds the covariances
    of consecutive errors; without them the covariances of the poses would be too small.

    Args:
        measured: motions to smooth; without covariances, :func:`fit_noise` estimates one for all of them.
        wander: standard deviation of the random walk after one second ``(3,)`` [m/s, m/s, rad/s per root second]; it grows
            with the square root of time. Default: :func:`fit_wander`.

    Raises:
        MitsonarError: a variance or ``wander`` is not positive, or there are too few motions to estimate them.
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
    # velocities back to motions: each covariance scales with the product of both durations
    step = measured.step_s
    squared, crossed = (step**2)[:, None, None], (step[:-1] * step[1:])[:, None, None]
    return MotionSeries(mean * step[:, None], measured.time_s, covariance * squared, with_next=lag * crossed)


def _walked(measured: MotionSeries, wander: Array) -> Array:
    """Return the covariance of the change of velocity from each motion to the next ``(frames - 2, 3, 3)``."""
    return np.diff(measured.middle_s)[:, None, None] * np.diag(wander**2)


def _filtered(measured: MotionSeries, wander: Array) -> tuple[Array, Array, Array]:
    """Return the filtered velocity ``(n, 3)``, its covariance, and the gain of the smoother ``(n - 1, 3, 3)``.

    Before the first valid motion the gain is the identity, so that smoothing extends the first valid velocity backwards.
    """
    seen, noise = measured.velocity, np.asarray(measured.covariances) / (measured.step_s**2)[:, None, None]
    walked = _walked(measured, wander)
    # without a prior the first valid motion initialises the filter
    first = int(np.argmax(measured.is_valid))
    n, one = len(measured), np.eye(3)
    mean, covariance = np.tile(seen[first], (n, 1)), np.zeros((n, 3, 3))
    back = np.tile(one, (max(n - 1, 0), 1, 1))
    covariance[first] = noise[first]
    for k in range(first + 1, n):
        # predict by the random walk
        ahead = covariance[k - 1] + walked[k - 1]
        back[k - 1] = np.linalg.solve(ahead, covariance[k - 1]).T
        mean[k], covariance[k] = mean[k - 1], ahead
        # update by a valid measurement, in Joseph form: a sum of two squares, which rounding cannot make negative
        if measured.is_valid[k]:
            gain = np.linalg.solve(ahead + noise[k], ahead).T
            mean[k] += gain @ (seen[k] - mean[k - 1])
            covariance[k] = _symmetric((one - gain) @ ahead @ (one - gain).T + gain @ noise[k] @ gain.T)
    return mean, covariance, back


def _rts(mean: Array, covariance: Array, back: Array, walked: Array) -> tuple[Array, Array, Array]:
    """Return the smoothed velocity, its covariance, and the covariance of each velocity with the next."""
    mean, covariance, lag = mean.copy(), covariance.copy(), np.zeros_like(back)
    one = np.eye(3)
    for k in range(len(mean) - 2, -1, -1):
        gain, rest = back[k], one - back[k]
        lag[k] = gain @ covariance[k + 1]
        mean[k] += gain @ (mean[k + 1] - mean[k])
        # P - G (P + Q) G' + G P' G', with the smoothed P' of the next step, written as a sum of squares
        covariance[k] = _symmetric(rest @ covariance[k] @ rest.T + gain @ (covariance[k + 1] + walked[k]) @ gain.T)
    return mean, covariance, lag


def fit_wander(measured: MotionSeries) -> Array:
    """Estimate the random walk of the velocity after one second ``(3,)`` [m/s, m/s, rad/s per root second].

    The estimate maximises the likelihood of the innovations of the filter, axis by axis, with the diagonals of the
    covariances.

    Raises:
        MitsonarError: there are no covariances, a variance is not positive, or only one of several motions is valid.
    """
    if measured.covariances is None:
        raise MitsonarError("fit_wander needs the motions' covariances: give them, or estimate the noise with fit_noise")
    known = np.flatnonzero(measured.is_valid)
    if known.size == 1 < len(measured):
        raise MitsonarError(f"one valid motion of {len(measured)} shows no change of velocity: give wander")
    gap, seen = np.diff(measured.middle_s[known])[:, None], measured.velocity[known]
    noise = _variances(measured)[known] / measured.step_s[known, None] ** 2
    if known.size == 1:  # a single motion shows no walk: its noise sets the scale
        return np.asarray(np.sqrt(noise[0]))

    def misfit(log_walk: Array) -> Array:
        log_spread, chi = _innovations(seen, noise, gap, np.exp(log_walk))
        return np.asarray(log_spread + chi)

    high = np.log(1e2 * (np.diff(seen, axis=0) ** 2 + noise[1:] + noise[:-1]).mean(axis=0) / gap.min())
    return np.exp(_least(misfit, high - np.log(1e14), high) / 2)


def fit_noise(measured: MotionSeries) -> Array:
    """Estimate the standard deviation of the errors ``(3,)`` [m, m, rad], common to all motions, from their differences.

    The estimate maximises the likelihood jointly with the random walk of the velocity.

    Raises:
        MitsonarError: fewer than five motions are valid, or an axis never changes.
    """
    known = np.flatnonzero(measured.is_valid)
    seen, step = measured.velocity[known], measured.step_s[known, None]
    if known.size < 5:
        raise MitsonarError(f"the noise of motions needs five of them or more: got {known.size}; give covariances")
    still = [axis.name for axis, values in zip(AXES, measured.motions[known].T, strict=True) if not np.ptp(values)]
    if still:
        raise MitsonarError(
            f"{still[0]} is the same in all motions, so that its noise cannot be estimated: give covariances"
        )
    # unit noise: its size drops out of the search, as the mean normalised square of the innovations
    noise, gap = np.broadcast_to((step.mean() / step) ** 2, seen.shape), np.diff(measured.middle_s[known])[:, None]

    def power(log_walk: Array) -> tuple[Array, Array]:
        log_spread, chi = _innovations(seen, noise, gap, np.exp(log_walk))
        return log_spread, chi / len(gap)

    def misfit(log_walk: Array) -> Array:
        log_spread, each = power(log_walk)
        return np.asarray(log_spread + len(gap) * np.log(each))

    unit = np.full(3, -np.log(gap.mean()))  # a walk as large as the noise after a mean gap
    walk = _least(misfit, unit - np.log(1e10), unit + np.log(1e6))
    return np.asarray(np.sqrt(power(walk[None])[1][0]) * step.mean())


def _innovations(seen: Array, noise: Array, gap: Array, walk: Array) -> tuple[Array, Array]:
    """Sum the log variances and the normalised squares of the innovations of a scalar filter on each axis.

    ``walk`` holds many trial variances of the random walk after one second ``(many, 3)``.
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


YAW_ADVICE = "an estimator that takes the heading as constant states none for yaw: let it turn, as likelihood:yaw=1"
"""What to do where a covariance has no variance of yaw."""


def _variances(measured: MotionSeries) -> Array:
    """Return the variances of the motions ``(frames - 1, 3)``, checked to be positive where valid."""
    variance = np.diagonal(np.asarray(measured.covariances), axis1=1, axis2=2)
    for axis, values in zip(AXES, variance[measured.is_valid].T, strict=True):
        if not (values > 0).all():
            hint = f"; {YAW_ADVICE}" if axis.name == "yaw" else ""
            raise MitsonarError(f"smoothing needs variances above zero: got {values.min():g} for {axis.name}{hint}")
    return variance


def _least(score: Callable[[Array], Array], low: Array, high: Array, points: int = 25, rounds: int = 4) -> Array:
    """Return the minimum of each column of ``score((points, axes))`` between low and high, by successively finer grids."""
    columns = np.arange(low.size)
    for _ in range(rounds):
        grid = np.linspace(low, high, points)
        best = np.argmin(score(grid), axis=0)
        low, high = grid[np.maximum(best - 1, 0), columns], grid[np.minimum(best + 1, points - 1), columns]
    return np.asarray(grid[best, columns])


def _symmetric(matrix: Array) -> Array:
    return (matrix + matrix.T) / 2


# ---------------- Covariances of poses


def pose_covariances(
    series: MotionSeries,
    start: Pose,
    at_start: ArrayLike | None = None,
    correlated: CorrelatedErrors | None = None,
    alone: NDArray[np.bool_] | None = None,
) -> Array:
    """Return the covariances of x, y [m] and heading [rad] of every frame ``(frames, 3, 3)`` along a path, to first order.

    Args:
        series: motions with their covariances, all valid; smooth a series with gaps first.
        start: first pose.
        at_start: covariance of the first pose ``(3, 3)``; default: known exactly.
        correlated: how errors of consecutive motions are correlated; default: as in ``series.with_next``, or independent
            without it.
        alone: motions whose errors are independent in spite of ``correlated`` ``(frames - 1,)``.

    Raises:
        MitsonarError: there are no covariances, or a motion is invalid, so that its error is not known.
    """
    if series.covariances is None:
        raise MitsonarError("the pose's covariance needs those of the motions: give them, or use kalman_smoothed")
    if not series.is_valid.all():
        gaps = int((~series.is_valid).sum())
        raise MitsonarError(f"{gaps} motions are not valid, so that their errors are not known: use kalman_smoothed first")
    poses = path_of(series.motions, start, series.time_s).poses
    covariances = np.zeros((len(poses), 3, 3))
    covariances[0] = 0.0 if at_start is None else np.asarray(at_start, dtype=float)
    # 1. model of the errors: a state shared by consecutive motions, and an independent rest for each
    if correlated is None:
        shared, steps = np.zeros((3, 3)), _regressed_on_previous(series.covariances, series.with_next)
    else:
        # the nine slopes are constant with unit variance; the wandering part starts with the first motion
        shared, steps = np.diag([0.0] * 3 + [1.0] * 9), _correlated(series, correlated, alone)
    # 2. propagate the joint covariance of the pose and the shared state from frame to frame
    joint = block_diag(covariances[0], shared)
    for k, ((x, y), step) in enumerate(zip(np.diff(poses[:, :2], axis=0), steps, strict=True)):
        sin, cos = np.sin(poses[k + 1, 5]), np.cos(poses[k + 1, 5])
        pose = np.array([[1, 0, y], [0, 1, -x], [0, 0, 1]])  # derivative of eq. 3.4 by the pose
        motion = np.array([[cos, sin, y], [-sin, cos, -x], [0, 0, 1]])  # and by the motion
        by_shared = motion @ step.by_shared
        onward = np.block([[pose, by_shared @ step.onward], [np.zeros((len(step.onward), 3)), step.onward]])
        fresh_by = np.vstack([by_shared, np.eye(len(step.onward))])
        joint = onward @ joint @ onward.T + fresh_by @ step.fresh @ fresh_by.T
        joint[:3, :3] += motion @ step.independent @ motion.T
        joint = (joint + joint.T) / 2
        covariances[k + 1] = joint[:3, :3]
    return covariances


class _Step(NamedTuple):
    """Error model of one motion: a state ``(m,)`` that motions share, plus an independent rest.

    Attributes:
        onward: transition matrix of the state from the motion before ``(m, m)``.
        fresh: covariance of the innovation of the state ``(m, m)``.
        by_shared: derivative of the error of the motion by the state ``(3, m)``.
        independent: covariance of the independent rest ``(3, 3)``.
    """

    onward: Array
    fresh: Array
    by_shared: Array
    independent: Array


def _regressed_on_previous(covariances: Array, with_next: Array | None) -> Iterator[_Step]:
    """Yield steps whose shared state is the error itself, regressed on the error of the motion before."""
    along, fresh = np.zeros_like(covariances), covariances.copy()
    if with_next is not None and len(with_next):
        along[1:] = np.linalg.solve(covariances[:-1], with_next).swapaxes(1, 2)
        fresh[1:] -= along[1:] @ with_next
    for matrix, rest in zip(along, fresh, strict=True):
        yield _Step(matrix, rest, np.eye(3), np.zeros((3, 3)))


def _correlated(series: MotionSeries, correlated: CorrelatedErrors, alone: NDArray[np.bool_] | None) -> Iterator[_Step]:
    """Yield steps whose shared state is a wandering error ``(3,)`` and nine slopes over the motion, of unit variance."""
    assert series.covariances is not None
    # 1. the symmetric square root of each covariance scales the wandering part to its share of the variance
    variance, axes = np.linalg.eigh(series.covariances)
    root = axes * np.sqrt(np.maximum(variance, 0))[:, None] @ axes.swapaxes(1, 2)
    wander = np.sqrt(correlated.share) * root
    by_shared = np.concatenate([wander, correlated.by_slopes()], axis=2)
    independent = (1 - correlated.share) * series.covariances
    if alone is not None:
        by_shared[alone], independent[alone] = 0.0, series.covariances[alone]
    # 2. the wandering part is a first-order chain of unit variance; slopes stay constant
    for along, by, rest in zip(np.append(0.0, correlated.onward), by_shared, independent, strict=True):
        onward, fresh = np.ones(12), np.zeros(12)
        onward[:3], fresh[:3] = along, 1 - along**2
        yield _Step(np.diag(onward), np.diag(fresh), by, rest)


class Ellipse(NamedTuple):
    """A confidence ellipse: semi-axes [m] and the direction of the longer one [rad], clockwise from +y like a heading."""

    major_m: float
    minor_m: float
    heading: float


def ellipse(covariance: ArrayLike, probability: float = 0.95) -> Ellipse:
    """Return the ellipse that contains a position with a given probability.

    Args:
        covariance: covariance whose first two components are x, y ``(2.., 2..)`` [m].
        probability: probability of the ellipse.

    Raises:
        MitsonarError: ``probability`` is not between 0 and 1.
    """
    if not 0 < probability < 1:
        raise MitsonarError(f"probability must be between 0 and 1: got {probability:g}")
    variance, axes = np.linalg.eigh(np.asarray(covariance, dtype=float)[:2, :2])
    minor, major = np.sqrt(np.maximum(variance, 0) * chi2.ppf(probability, 2))
    return Ellipse(float(major), float(minor), float(np.arctan2(axes[0, 1], axes[1, 1]) % np.pi))


# ---------------- Correlation of errors over the same ground


class CorrelatedErrors(NamedTuple):
    """Correlation between the errors of consecutive motions of the chain.

    Attributes:
        share: fraction of the variance of each error that consecutive motions have in common, in [0, 1).
        onward: correlation of the common part from each motion to the next ``(motions - 1,)``, in [0, 1).
        slope_std: standard deviation of the slope of each component of the error (rows) over each component of the motion
            (columns) ``(3, 3)``. All motions share the same slopes.
        sloped: motions that the slopes multiply, smoothed to reduce the errors of single ones ``(motions, 3)``.
    """

    share: float
    onward: Array
    slope_std: Array
    sloped: Array

    def by_slopes(self) -> Array:
        """Return the derivatives of the errors by the nine slopes, in standard deviations ``(motions, 3, 9)``."""
        table = np.zeros((len(self.sloped), 3, 3, 3))
        for axis in range(3):
            table[:, axis, axis] = self.sloped * self.slope_std[axis]
        return table.reshape(-1, 3, 9)


@dataclass(frozen=True)
class ErrorCorrelation:
    """Model of the correlation between errors of motions over the same ground.

    Relief and the outline of the insonified area bias estimates in one direction as long as the same ground is in view.
    Covariances that are right for single motions then give far too small a covariance for the path. The defaults are
    measured on rocky fields with ``direct`` (``benchmarks/bench_loops.py``).

    Attributes:
        share: fraction of the variance that motions over the same ground have in common.
        length: displacement of the ground through the window after which the common part has correlation 1/e, as a fraction
            of the reach.
        slope: standard deviation of a common error proportional to the motion, such as the scale error of a wrong height.

    Raises:
        MitsonarError: a number is outside its limits.
    """

    share: float = 0.9
    length: float = 0.12
    slope: float = 0.006

    def __post_init__(self) -> None:
        if not (0 <= self.share < 1 and 0 < self.length < np.inf and 0 < self.slope < np.inf):
            raise MitsonarError(
                "share must be 0 or more and below 1, length and slope above 0: got "
                f"{self.share:g}, {self.length:g} and {self.slope:g}"
            )

    def along(self, motions: ArrayLike, reach_m: float) -> CorrelatedErrors:
        """Return the correlation of the errors of consecutive motions ``(n, 3)``.

        Args:
            motions: sideways, forward [m], yaw [rad].
            reach_m: horizontal distance from the sonar to the middle of the ground in view [m].
        """
        # displacement of the middle of the ground in view: a turn moves it by the reach
        moved = np.asarray(motions, dtype=float)
        way = np.hypot(moved[:, 0] + reach_m * moved[:, 2], moved[:, 1])
        between = (way[1:] + way[:-1]) / 2
        # a sonar at rest keeps its errors, but a correlation of exactly 1 would make the graph singular
        onward = np.exp(-np.maximum(between / (self.length * reach_m), 1e-6))
        # slopes are a ratio of lengths: yaw enters as a length at the reach
        lever = np.array([1.0, 1.0, 1.0 / reach_m])
        slope_std = self.slope * np.outer(lever, 1 / lever)
        return CorrelatedErrors(self.share, onward, slope_std, _spread(moved, onward))


def _spread(moved: Array, onward: Array) -> Array:
    """Spread each motion over those that see the same ground, with their sum unchanged ``(n, 3)``.

    A slope over the unsmoothed motions would mistake an error that two components share for a proportional error.
    """
    total = _correlated_sum(np.ones((len(moved), 1)), onward)
    return _correlated_sum(moved / total, onward)


def _correlated_sum(values: Array, onward: Array) -> Array:
    """Sum values ``(n, k)`` weighted by the correlations of their motions, with one recursion in each direction."""
    before, after = values.copy(), values.copy()
    for k, stays in enumerate(onward):
        before[k + 1] += stays * before[k]
    for k in range(len(onward) - 1, -1, -1):
        after[k] += onward[k] * after[k + 1]
    return np.asarray(before + after - values)
