"""Combine the readings of a vehicle's other sensors, all optional: gyroscope, DVL, depth, attitude, compass, dead reckoning.

Readings are integrated over the time between frames. They yield motions with covariances, headings, depths and attitudes.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline

from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.io.csv_table import CsvTable
from mitsonar.io.files import write_atomic
from mitsonar.motion.composition import Motion, MotionPrior, motions
from mitsonar.motion.pose import Pose, mounted
from mitsonar.motion.trajectory import ALIASES, Trajectory

__all__ = [
    "COLUMNS",
    "ROOT_HOUR",
    "SMOOTHED_S",
    "DeadReckoning",
    "Headings",
    "Readings",
    "SensorMotions",
    "VehicleSensors",
    "leaning_mount",
    "load_sensors",
    "save_sensors",
    "smoothed_change",
    "straight_poses",
    "wrapped",
]


Array = NDArray[np.float64]
Index = NDArray[np.intp]

UNKNOWN_STD = np.array([10.0, 10.0, np.pi])
"""Standard deviations of motion components that a sensor does not measure [m, m, rad]."""

MIN_STD = 1e-12
"""Smallest standard deviation of a reading, whose inverse square must be finite."""

LONGEST_GAP_S = 1.0
"""Longest time between two readings that still cover the time in between, unless readings are slower throughout [s]."""

SMOOTHED_S = 0.15
"""Time over which depths and attitudes are averaged [s]; a sway with a period of 4 s loses 0.3 % of its amplitude."""

SMOOTHED_MARGIN_S = 10.0
"""Time before the first and after the last frame whose readings enter the smoothing [s]."""

FEWEST_SMOOTHED = 5
"""Fewest readings that are smoothed; fewer are interpolated."""

REMAINING = 3 / 2**3.5
"""Variance of a smoothed value over that of a reading, times :data:`SMOOTHED_S` over the time between readings.

The smoothing spline has the frequency response ``1 / (1 + w**4)``, whose square integrates to this over ``2 pi``.
"""

SLOWER = 3.0
"""Number of median steps beyond which a step counts as a gap."""


class Headings(NamedTuple):
    """Absolute headings of poses: their indices ``(n,)``, the headings [rad] and the standard deviations [rad]."""

    pose: Index
    heading: Array
    std: Array

    @classmethod
    def none(cls) -> Self:
        """Return an empty set of headings."""
        return cls(np.zeros(0, np.intp), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class Readings:
    """Readings of one quantity over time.

    Attributes:
        time_s: times of the readings ``(n,)``, increasing.
        values: ``(n,)``.
        std: standard deviations of their independent errors ``(n,)``; for a gyroscope the noise density (rad/s per root Hz,
            which is rad per root second).

    Raises:
        MitsonarError: other shapes, non-finite numbers, times that do not increase, or deviations that are not positive.
    """

    time_s: Array
    values: Array
    std: Array

    def __post_init__(self) -> None:
        shapes = {self.time_s.shape, self.values.shape, self.std.shape}
        if shapes != {(len(self.time_s),)} or not self.time_s.size:
            raise MitsonarError(f"readings need a time, a value and a standard deviation each: got {sorted(shapes)}")
        if not all(np.isfinite(numbers).all() for numbers in (self.time_s, self.values, self.std)):
            raise MitsonarError("readings must be finite: leave out those that are missing")
        if not (np.diff(self.time_s) > 0).all():
            where = int(np.flatnonzero(~(np.diff(self.time_s) > 0))[0])
            raise MitsonarError(
                f"times of readings must increase: got {self.time_s[where + 1]:.15g} s after {self.time_s[where]:.15g}"
            )
        if not (self.std >= MIN_STD).all():
            raise MitsonarError(f"standard deviations of readings must be above 0: got {self.std.min():g}")

    @property
    def edges_s(self) -> Array:
        """Return the limits of the intervals ``(n + 1,)`` in which each reading applies, around its time."""
        step = np.diff(self.time_s)
        if not step.size:
            return np.asarray(self.time_s[0] + np.array([-0.5, 0.5]) * LONGEST_GAP_S)
        middle = self.time_s[:-1] + step / 2
        return np.concatenate([[self.time_s[0] - step[0] / 2], middle, [self.time_s[-1] + step[-1] / 2]])

    def means(self, time_s: Array) -> Array:
        """Return the mean between consecutive times ``(times - 1,)``, which is valid where readings cover them."""
        return np.asarray(_integrate_between(self.edges_s, self.values, time_s) / np.diff(time_s))

    def variances(self, time_s: Array, *, density: bool) -> Array:
        """Return the variance of the integral between consecutive times ``(times - 1,)``.

        Args:
            time_s: times of the frames.
            density: whether ``std`` is a noise density per root Hz; otherwise it is that of each reading, and readings
                average.
        """
        edges = self.edges_s
        power = np.asarray(self.std**2 if density else self.std**2 * np.diff(edges))
        return _integrate_between(edges, power, time_s)

    def covers(self, time_s: Array) -> NDArray[np.bool_]:
        """Return whether readings cover each interval between consecutive times without a gap ``(times - 1,)``."""
        edges, step = self.edges_s, np.diff(self.time_s)
        widest = max(LONGEST_GAP_S, SLOWER * float(np.median(step))) if step.size else LONGEST_GAP_S
        covered = (time_s[:-1] >= edges[0] - 1e-6) & (time_s[1:] <= edges[-1] + 1e-6)
        for gap in np.flatnonzero(step > widest):
            covered &= (time_s[1:] <= self.time_s[gap]) | (time_s[:-1] >= self.time_s[gap + 1])
        return np.asarray(covered)

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """Return interpolated values and standard deviations at times ``(times,)`` each; nan where no reading is near.

        A reading is near a time if the two are mutual nearest neighbours, so that no reading counts twice.
        """
        # The reading nearest to each time.
        after = np.clip(np.searchsorted(self.time_s, time_s), 1, max(1, len(self.time_s) - 1)) - 1
        nearest = np.where(
            np.abs(self.time_s[np.minimum(after + 1, len(self.time_s) - 1)] - time_s) < np.abs(self.time_s[after] - time_s),
            np.minimum(after + 1, len(self.time_s) - 1),
            after,
        )
        # The time nearest to each reading; only mutual nearest neighbours are used.
        off = np.abs(self.time_s[nearest] - time_s)
        best = np.full(len(self.time_s), np.inf)
        np.minimum.at(best, nearest, off)
        near = (off <= best[nearest]) & (off <= LONGEST_GAP_S / 2)
        value = np.interp(time_s, self.time_s, self.values)
        return np.where(near, value, np.nan), np.where(near, self.std[nearest], np.nan)

    def reaches(self, time_s: Array) -> bool:
        """Return whether readings lie around all times, from the first to the last."""
        return bool(time_s[0] >= self.edges_s[0] - 1e-6 and time_s[-1] <= self.edges_s[-1] + 1e-6)

    def smoothed(self, time_s: Array) -> Array | None:
        """Return values at times ``(times,)`` from a smoothing spline; None if the readings do not reach all times.

        The spline averages over some :data:`SMOOTHED_S`, so that height and attitude of a frame do not jump by the noise of
        a reading. An oscillation of angular frequency w keeps ``1 / (1 + (SMOOTHED_S * w)**4)`` of its amplitude.
        """
        if not self.reaches(time_s):
            return None
        begin, end = np.searchsorted(self.time_s, time_s[[0, -1]] + [-SMOOTHED_MARGIN_S, SMOOTHED_MARGIN_S])
        seconds, values = self.time_s[begin:end] - time_s[0], self.values[begin:end]
        between = np.interp(time_s, self.time_s, self.values)
        if len(values) < FEWEST_SMOOTHED:
            return np.asarray(between)
        spline = make_smoothing_spline(seconds, values, lam=SMOOTHED_S**4 / float(np.median(np.diff(seconds))))
        smooth = spline(time_s - time_s[0])
        # a spline swings far out between readings that lie far apart
        after = np.clip(np.searchsorted(seconds, time_s - time_s[0]), 1, len(seconds) - 1)
        return np.where(np.diff(seconds)[after - 1] > LONGEST_GAP_S, between, smooth)

    def smoothed_std(self, time_s: Array) -> Array:
        """Return the standard deviations of :meth:`smoothed` by the noise of the readings ``(times,)``.

        They hold for even steps. At the first and the last reading, with readings on one side only, they are twice as large.
        """
        std = np.interp(time_s, self.time_s, self.std)
        if len(self.values) < FEWEST_SMOOTHED:
            return np.asarray(std)
        from_end = np.minimum(time_s - self.time_s[0], self.time_s[-1] - time_s)
        one_sided = 1 + 3 * np.exp(-2 * from_end / SMOOTHED_S)
        step = float(np.median(np.diff(self.time_s)))
        return np.asarray(std * np.sqrt(np.minimum(1.0, REMAINING * step / SMOOTHED_S * one_sided)))


def smoothed_change(first: Array, second: Array, step_s: float | Array) -> Array:
    """Return the standard deviation of the change between two smoothed values by the noise of the readings.

    The errors of values that lie within the time of smoothing are correlated: by the autocorrelation of a spline's kernel.

    Args:
        first: standard deviations of the earlier values, from :meth:`Readings.smoothed_std`.
        second: those of the later values.
        step_s: time between the two [s].
    """
    lag = np.abs(step_s) / (np.sqrt(2) * SMOOTHED_S)
    correlation = np.exp(-lag) * (np.cos(lag) + (1 + 2 * lag / 3) * np.sin(lag))
    return np.asarray(np.sqrt(np.maximum(first**2 + second**2 - 2 * correlation * first * second, 0.0)))


def _integrate_between(edges: Array, rate: Array, time_s: Array) -> Array:
    """Integrate a step function with values ``rate`` (n,) and limits ``edges`` (n + 1,) between consecutive times."""
    cumulative = np.concatenate([[0.0], np.cumsum(rate * np.diff(edges))])
    return np.asarray(np.diff(np.interp(time_s, edges, cumulative)))


@dataclass(frozen=True)
class DeadReckoning:
    """Poses from the vehicle's own navigation, with errors that grow as a random walk.

    Attributes:
        path: the poses.
        walk_m: standard deviation of the position after one second [m per root second].
        walk_rad: standard deviation of the heading after one second [rad per root second].

    Raises:
        MitsonarError: a walk that is not positive, or times that do not increase.
    """

    path: Trajectory
    walk_m: float
    walk_rad: float

    def __post_init__(self) -> None:
        if not (0 < self.walk_m < np.inf and 0 < self.walk_rad < np.inf):
            raise MitsonarError(
                f"dead reckoning needs a random walk above 0 m and rad: got {self.walk_m:g} and {self.walk_rad:g}"
            )
        if len(self.path) < 2 or not (np.diff(self.path.time_s) > 0).all():
            raise MitsonarError("dead reckoning needs at least two poses, at increasing times: sort them")

    def poses_at(self, time_s: Array) -> Array:
        """Return interpolated poses at times ``(times, 6)``, constant before the first and after the last."""
        return straight_poses(self.path, time_s)


def straight_poses(path: Trajectory, time_s: Array) -> Array:
    """Return linearly interpolated poses at times ``(times, 6)``, with unwrapped headings; constant beyond the ends."""
    table = path.poses.copy()
    table[:, 5] = np.unwrap(table[:, 5])
    return np.column_stack([np.interp(time_s, path.time_s, column) for column in table.T])


def leaning_mount(lean: Array, pitch_rad: float) -> Array:
    """Compute pitch, roll and heading ``(n, 3)`` [rad] of a sonar on a vehicle that leans and heads north.

    Args:
        lean: pitch and roll of the vehicle ``(n, 2)`` [rad].
        pitch_rad: pitch of the sonar in the axes of the vehicle [rad].
    """
    poses = np.zeros((len(lean), 6))
    poses[:, 3:5] = lean
    return mounted(poses, Pose(0.0, 0.0, 0.0, pitch_rad))[:, 3:]


class SensorMotions(NamedTuple):
    """Motions between frames measured by one sensor.

    Attributes:
        pair: indices of the pairs of frames that it covers ``(n,)``.
        motions: sideways, forward [m], yaw [rad] ``(n, 3)``.
        covariances: ``(n, 3, 3)``; unmeasured components have the variance of ``UNKNOWN_STD``.
        bias: error of each motion caused by one standard deviation of the gyroscope bias ``(n, 3)``.
    """

    pair: NDArray[np.intp]
    motions: Array
    covariances: Array
    bias: Array


@dataclass(frozen=True)
class VehicleSensors:
    """Readings of a vehicle's sensors, in the vehicle's level axes; None for missing sensors.

    Attributes:
        yaw_rate: yaw rate of a gyroscope [rad/s], clockwise seen from above; ``std`` is its noise density.
        sideways: velocity to starboard from a DVL [m/s].
        forward: forward velocity from a DVL [m/s].
        depth: depth below the surface [m].
        pitch: pitch of the vehicle [rad], > 0: bow down.
        roll: roll of the vehicle [rad], > 0: starboard down.
        heading: heading of a compass [rad], clockwise from north.
        dead_reckoning: poses from other navigation.
        bias_std: standard deviation of the constant gyroscope bias [rad/s]; 0 for none.
        name: name of the source in messages.
        mount_rad: pitch of the mount for which :meth:`on_mount` has corrected turns for the roll, whose noise they share.

    Raises:
        MitsonarError: no sensor at all, a pitch without roll or the reverse, or a negative bias.
    """

    yaw_rate: Readings | None = None
    sideways: Readings | None = None
    forward: Readings | None = None
    depth: Readings | None = None
    heading: Readings | None = None
    dead_reckoning: DeadReckoning | None = None
    bias_std: float = 0.0
    name: str = "the sensors"
    pitch: Readings | None = None
    roll: Readings | None = None
    mount_rad: float = 0.0

    def __post_init__(self) -> None:
        if (self.pitch is None) != (self.roll is None):
            raise MitsonarError(
                f"{self.name} hold only one of pitch and roll of the vehicle: give both, in a file as vehicle_pitch_deg and "
                "vehicle_roll_deg, or leave both out"
            )
        if not self.names:
            raise MitsonarError(
                f"{self.name} hold no reading: give a gyroscope, velocities, depths, attitudes, headings or poses"
            )
        if not 0 <= self.bias_std < np.inf:
            raise MitsonarError(
                f"the bias of a gyroscope needs a standard deviation of 0 or more: got {self.bias_std:g} rad/s"
            )

    def __repr__(self) -> str:
        count, (first, last) = sum(map(len, self._times)), self.span_s
        return f"VehicleSensors({', '.join(self.names)}; {count:,} readings over {last - first:.4g} s)"

    @property
    def _times(self) -> list[Array]:
        """Return the times of the readings of each sensor [s]."""
        times = [readings.time_s for readings in _readings_by_column(self).values()]
        return times + ([self.dead_reckoning.path.time_s] if self.dead_reckoning else [])

    @property
    def span_s(self) -> tuple[float, float]:
        """Return the times of the first and the last reading of any sensor [s]."""
        return min(float(time[0]) for time in self._times), max(float(time[-1]) for time in self._times)

    @property
    def names(self) -> list[str]:
        """Return the names of the sensors that are present."""
        sensors = {
            "gyroscope": self.yaw_rate,
            "DVL": self.sideways or self.forward,
            "depth": self.depth,
            "attitude": self.pitch,
            "compass": self.heading,
            "dead reckoning": self.dead_reckoning,
        }
        return [name for name, sensor in sensors.items() if sensor is not None]

    def digest(self) -> str:
        """Return the SHA-256 of all readings."""
        digest = hashlib.sha256(repr(self.bias_std).encode())
        for readings in (self.yaw_rate, self.sideways, self.forward, self.depth, self.heading, self.pitch, self.roll):
            for values in () if readings is None else (readings.time_s, readings.values, readings.std):
                digest.update(values.astype(float).tobytes())
            digest.update(b";")
        if self.dead_reckoning is not None:
            reckoning = self.dead_reckoning
            digest.update(
                reckoning.path.poses.tobytes()
                + reckoning.path.time_s.tobytes()
                + repr((reckoning.walk_m, reckoning.walk_rad)).encode()
            )
        return digest.hexdigest()

    def on_mount(self, pitch_rad: float) -> Self:
        """Return the sensors in the axes of a sonar on a pitched mount, whose heading changes as the vehicle rolls.

        A vehicle that rolls by 4 deg turns a sonar that looks 25 deg down by 1.7 deg.

        Args:
            pitch_rad: pitch of the sonar in the axes of the vehicle [rad].
        """
        if self.pitch is None or self.roll is None:
            return self
        ends = np.array([one.edges_s[[0, -1]] for one in (self.pitch, self.roll)])
        first, last = ends[:, 0].max(), ends[:, 1].min()

        def turn(time_s: Array) -> Array:
            lean = self.attitudes(np.clip(time_s, first, last))
            assert lean is not None
            return leaning_mount(lean, pitch_rad)[:, 2]

        changes: dict[str, Readings | DeadReckoning | float] = {"mount_rad": pitch_rad}
        if (gyro := self.yaw_rate) is not None:
            rate = np.diff(turn(gyro.edges_s)) / np.diff(gyro.edges_s)
            changes["yaw_rate"] = replace(gyro, values=gyro.values + rate)
        if (compass := self.heading) is not None:
            changes["heading"] = replace(compass, values=compass.values + turn(compass.time_s))
        if (side := self.sideways) is not None and (ahead := self.forward) is not None:
            for name, one, other, sign in (("sideways", side, ahead, -1), ("forward", ahead, side, 1)):
                angle, crosswise = turn(one.time_s), np.interp(one.time_s, other.time_s, other.values)
                changes[name] = replace(one, values=one.values * np.cos(angle) + sign * crosswise * np.sin(angle))
        if (reckoning := self.dead_reckoning) is not None:
            poses = reckoning.path.poses.copy()
            poses[:, 5] += turn(reckoning.path.time_s)
            changes["dead_reckoning"] = replace(reckoning, path=Trajectory(poses, reckoning.path.time_s))
        return replace(self, **changes)  # type: ignore[arg-type]  # each name with its type

    def motions(self, time_s: Array) -> list[SensorMotions]:
        """Return the motions between frames at ``time_s`` ``(frames,)`` [s], one item per sensor, with independent errors.

        Raises:
            MitsonarError: no sensor covers the time of any frame.
        """
        measured = [sensor_motions for sensor_motions in self._motions_by_sensor(time_s) if sensor_motions.pair.size]
        others = self.rises(time_s), self.attitudes(time_s)
        if not measured and self.headings(time_s).pose.size == 0 and all(one is None for one in others):
            frames, readings = (f"{first:.10g}..{last:.10g} s" for first, last in ((time_s[0], time_s[-1]), self.span_s))
            raise MitsonarError(
                f"{self.name} hold no reading at the times of the frames, {frames}, but at {readings}: give time_s in "
                "seconds, in the clock of the recording, which `mitsonar recording info` prints"
            )
        return measured

    def _motions_by_sensor(self, time_s: Array) -> Iterator[SensorMotions]:
        if self.yaw_rate is not None:
            yield self._gyro_motions(self.yaw_rate, time_s)
        if self.sideways is not None or self.forward is not None:
            yield self._dvl_motions(time_s)
        if self.dead_reckoning is not None:
            yield _reckoning_motions(self.dead_reckoning, time_s)

    def turn_std(self, time_s: Array) -> Array:
        """Return the standard deviation of the turns by which :meth:`on_mount` corrects headings ``(frames,)`` [rad].

        It is the noise of the roll. The error of a frame's turn enters the yaws before and after it with opposite signs, so
        that it does not add up along a path: :meth:`motions` leave it out.
        """
        return np.asarray(np.tan(self.mount_rad) * self.attitude_std(time_s)[:, 2])

    def _gyro_motions(self, gyro: Readings, time_s: Array) -> SensorMotions:
        """Return the yaw measured by the gyroscope."""
        pair, step = np.flatnonzero(gyro.covers(time_s)), np.diff(time_s)
        table = np.zeros((len(step), 3))
        table[:, 2] = gyro.means(time_s) * step
        covariances = np.tile(np.diag(UNKNOWN_STD**2), (len(step), 1, 1))
        covariances[:, 2, 2] = gyro.variances(time_s, density=True)
        bias = np.zeros((len(step), 3))
        bias[:, 2] = self.bias_std * step
        return SensorMotions(pair, table[pair], covariances[pair], bias[pair])

    def _dvl_motions(self, time_s: Array) -> SensorMotions:
        """Return the displacement measured by velocities, in the axes of the second heading.

        Velocities are in rotating axes, so the displacement lies half the rotation behind the final axes. The rotation is
        taken from the gyroscope or the dead reckoning. Without them it is unknown, and the covariance describes how it bends
        the displacement.
        """
        # 1. Integrate each velocity over the intervals that it covers; the other components remain unknown.
        step = np.diff(time_s)
        displacement, variance = np.zeros((2, len(step))), np.tile(UNKNOWN_STD[:2, None] ** 2, (1, len(step)))
        covered = np.zeros(len(step), dtype=bool)
        for axis, sensor in enumerate((self.sideways, self.forward)):
            if sensor is not None:
                sensor_covers = sensor.covers(time_s)
                displacement[axis] = np.where(sensor_covers, sensor.means(time_s) * step, 0.0)
                variance[axis] = np.where(sensor_covers, sensor.variances(time_s, density=False), variance[axis])
                covered |= sensor_covers
        # 2. Rotate the displacement by half the yaw into the axes of the second heading.
        yaw = self._yaws(time_s)
        sin, cos = np.sin(yaw / 2), np.cos(yaw / 2)
        sideways, forward = displacement[0] * cos - displacement[1] * sin, displacement[0] * sin + displacement[1] * cos
        # 3. Propagate the variances, including that of the yaw, through this rotation.
        zeros, ones = np.zeros_like(sin), np.ones_like(sin)
        jacobian = np.array([[cos, -sin, -forward / 2], [sin, cos, sideways / 2], [zeros, zeros, ones]]).transpose(2, 0, 1)
        component_variances = np.stack([*variance, UNKNOWN_STD[2] ** 2 * ones], axis=1)
        covariances = (jacobian * component_variances[:, None]) @ jacobian.swapaxes(1, 2)
        pair = np.flatnonzero(covered)
        table = np.column_stack([sideways, forward, yaw])
        return SensorMotions(pair, table[pair], covariances[pair], np.zeros((len(pair), 3)))

    def _yaws(self, time_s: Array) -> Array:
        """Return the yaw between frames from the gyroscope, or else from dead reckoning; otherwise 0."""
        step = np.diff(time_s)
        if self.yaw_rate is not None:
            return np.where(self.yaw_rate.covers(time_s), self.yaw_rate.means(time_s) * step, 0.0)
        if self.dead_reckoning is not None:
            return np.diff(self.dead_reckoning.poses_at(time_s)[:, 5])
        return np.zeros_like(step)

    def priors(self, time_s: Array) -> list[MotionPrior] | None:
        """Return the combined sensor estimate of each motion ``(frames - 1,)``; None if no sensor measures any.

        Raises:
            MitsonarError: as for :meth:`motions`.
        """
        measurements = self.motions(time_s)
        if not measurements:
            return None
        # Weight each sensor by its information, starting from a weak prior, so that the result is always defined.
        information = np.tile(np.diag(1 / UNKNOWN_STD**2), (len(time_s) - 1, 1, 1))
        weighted = np.zeros((len(time_s) - 1, 3, 1))
        turn = self.turn_std(time_s)
        turn_noise = smoothed_change(turn[:-1], turn[1:], np.diff(time_s))[:, None, None] ** 2 * np.diag([0.0, 0.0, 1.0])
        for measurement in measurements:
            by_bias = measurement.bias[:, :, None] * measurement.bias[:, None]
            inverse = _inverse(measurement.covariances + by_bias + turn_noise[measurement.pair])
            information[measurement.pair] += inverse
            weighted[measurement.pair] += inverse @ measurement.motions[..., None]
        covariances = _inverse(information)
        means = (covariances @ weighted)[..., 0]
        return [
            MotionPrior(Motion(*(float(value) for value in mean)), covariance)
            for mean, covariance in zip(means, covariances, strict=True)
        ]

    def headings(self, time_s: Array) -> Headings:
        """Return the compass headings of frames; frames without a nearby reading are omitted."""
        if self.heading is None:
            return Headings.none()
        unwrapped = Readings(self.heading.time_s, np.unwrap(self.heading.values), self.heading.std)
        heading, std = unwrapped.at(time_s)
        known = np.flatnonzero(np.isfinite(heading))
        return Headings(known, wrapped(heading[known]), std[known])

    def rises(self, time_s: Array) -> Array | None:
        """Return the rise of each frame above the first, from the depth ``(frames,)`` [m]; None if not known."""
        depth = self.depths(time_s)
        return None if depth is None else np.asarray(depth[0] - depth)

    def depths(self, time_s: Array) -> Array | None:
        """Return the depth of each frame below the surface ``(frames,)`` [m]; None if not known."""
        return None if self.depth is None else self.depth.smoothed(time_s)

    def attitudes(self, time_s: Array) -> Array | None:
        """Return pitch and roll of the vehicle at each frame ``(frames, 2)`` [rad]; None if not known."""
        if self.pitch is None or self.roll is None:
            return None
        pitch, roll = self.pitch.smoothed(time_s), self.roll.smoothed(time_s)
        return None if pitch is None or roll is None else np.column_stack([pitch, roll])

    def attitude_std(self, time_s: Array) -> Array:
        """Return standard deviations of smoothed depth [m], pitch and roll [rad] of the vehicle ``(frames, 3)``; 0 without.

        They hold the noise of the readings; :func:`mitsonar.motion.sensors.smoothed_change` gives those of a change.
        """
        none = np.zeros(len(time_s))
        readings = self.depth, self.pitch, self.roll
        return np.column_stack([none if one is None else one.smoothed_std(time_s) for one in readings])


def _inverse(matrices: Array) -> Array:
    """Invert covariances or information matrices ``(n, 3, 3)`` whose components differ by many orders of magnitude."""
    scale = 1 / np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
    both = scale[:, :, None] * scale[:, None]
    return np.asarray(both * np.linalg.inv(matrices * both))


def _reckoning_motions(reckoning: DeadReckoning, time_s: Array) -> SensorMotions:
    """Return the motions measured by dead reckoning."""
    step, known = np.diff(time_s), reckoning.path.time_s
    table = motions(reckoning.poses_at(time_s))
    covered = (time_s[:-1] >= known[0] - 1e-6) & (time_s[1:] <= known[-1] + 1e-6)
    pair = np.flatnonzero(covered)
    walk = np.diag([reckoning.walk_m**2, reckoning.walk_m**2, reckoning.walk_rad**2])
    return SensorMotions(pair, table[pair], step[pair, None, None] * walk, np.zeros((len(pair), 3)))


def wrapped(angle: Array) -> Array:
    """Wrap angles to -pi..pi [rad]."""
    return np.asarray(angle - 2 * np.pi * np.rint(angle / (2 * np.pi)))


# ---------------- CSV files of sensors


ROOT_HOUR = float(np.radians(1) / 60)
"""One deg/h^0.5 in rad per root second, the unit of gyroscope noise."""

DEG = float(np.radians(1))

COLUMNS = {
    "yaw_rate_deg_s": ("yaw_rate_noise_deg_rth", DEG, ROOT_HOUR),
    "sideways_m_s": ("sideways_std_m_s", 1.0, 1.0),
    "forward_m_s": ("forward_std_m_s", 1.0, 1.0),
    "depth_m": ("depth_std_m", 1.0, 1.0),
    "vehicle_pitch_deg": ("vehicle_pitch_std_deg", DEG, DEG),
    "vehicle_roll_deg": ("vehicle_roll_std_deg", DEG, DEG),
    "heading_deg": ("heading_std_deg", DEG, DEG),
    "compass_deg": ("compass_std_deg", DEG, DEG),
}
"""Columns of readings; for each the column of its noise, and the factors of both to m, rad and s."""

RECKONED = ("reckoned_x_m", "reckoned_y_m", "reckoned_heading_deg")
WALKS = ("reckoned_walk_m_rts", "reckoned_walk_deg_rts")
"""Columns of the random walk of dead reckoning per root second; ``RECKONED`` are those of its poses."""

POSITION_COLUMNS = {*ALIASES["x"], *ALIASES["y"]}
"""Columns of positions. In a file that has them, ``heading_deg`` is the heading of a pose, which may be the true one."""

BIAS = "yaw_rate_bias_deg_h"
TIMES = ("time_s", "time", "timestamp")

LARGEST = 1e12
"""Largest number in a file; times may be Unix times."""


def load_sensors(path: str | Path) -> VehicleSensors:
    """Load the readings of sensors from a CSV file.

    Its first line names the columns: ``time_s`` (or ``time``, ``timestamp``), and those of the available sensors. The noise
    of a sensor has a separate column, whose first number replaces missing ones. Other columns are ignored: the file may be a
    trajectory (:meth:`mitsonar.Trajectory.load`), whose poses may be the true ones.

    | sensor | columns | columns of its noise |
    |---|---|---|
    | gyroscope | ``yaw_rate_deg_s``, clockwise seen from above | ``yaw_rate_noise_deg_rth`` (deg/h^0.5) |
    | | | ``yaw_rate_bias_deg_h``; default: 0 |
    | DVL | ``sideways_m_s`` to starboard, ``forward_m_s`` | ``sideways_std_m_s``, ``forward_std_m_s``, per reading |
    | depth | ``depth_m`` | ``depth_std_m`` |
    | attitude | ``vehicle_pitch_deg``, > 0: bow down | ``vehicle_pitch_std_deg`` |
    | | ``vehicle_roll_deg``, > 0: starboard down | ``vehicle_roll_std_deg`` |
    | compass | ``heading_deg``, clockwise from north | ``heading_std_deg`` |
    | | or ``compass_deg``; the only choice in a file with poses | ``compass_std_deg`` |
    | dead reckoning | ``reckoned_x_m``, ``reckoned_y_m`` | ``reckoned_walk_m_rts``, after one second |
    | | ``reckoned_heading_deg`` | ``reckoned_walk_deg_rts`` |

    Raises:
        MitsonarError: an unreadable file, no sensor column, a sensor without its noise, cells that are not numbers, or times
            that do not increase.
    """
    table = CsvTable(Path(path))
    time = _column(table, _time_name(table), complete=True)
    sensor_columns = _sensor_columns(table)
    if not sensor_columns:
        known_columns = ", ".join((*COLUMNS, *RECKONED))
        raise MitsonarError(f"{path} has no column of a sensor ({', '.join(table.names)[:80]}): known are {known_columns}")
    repeated = sorted({name for name in table.names if table.names.count(name) > 1})
    if repeated:
        raise MitsonarError(f"{path} has the column {repeated[0]} more than once: leave one out")
    if {"heading_deg", "compass_deg"} <= set(sensor_columns):
        raise MitsonarError(f"{path} has headings of a compass twice, heading_deg and compass_deg: leave one out")
    readings = {name: _parse_readings(table, time, name) for name in sensor_columns if name in COLUMNS}
    bias = _first_number(table, BIAS) * DEG / 3600 if BIAS in table.names else 0.0
    return VehicleSensors(
        readings.get("yaw_rate_deg_s"),
        readings.get("sideways_m_s"),
        readings.get("forward_m_s"),
        readings.get("depth_m"),
        readings.get("compass_deg", readings.get("heading_deg")),
        _parse_dead_reckoning(table, time) if set(sensor_columns) & set(RECKONED) else None,
        bias,
        f"the sensors of {Path(path).name}",
        readings.get("vehicle_pitch_deg"),
        readings.get("vehicle_roll_deg"),
    )


def save_sensors(path: str | Path, sensors: VehicleSensors) -> None:
    """Write sensors atomically to a CSV file for :func:`load_sensors`, with a row for each time of any sensor."""
    columns: dict[str, tuple[Array, Array]] = {}
    for name, readings in _readings_by_column(sensors).items():
        noise, unit, noise_unit = COLUMNS[name]
        columns[name] = readings.time_s, readings.values / unit
        columns[noise] = readings.time_s, readings.std / noise_unit
    if sensors.dead_reckoning is not None:
        reckoning = sensors.dead_reckoning
        unit_poses = reckoning.path.poses[:, [0, 1, 5]] / [1, 1, DEG]
        walks = np.tile([reckoning.walk_m, reckoning.walk_rad / DEG], (len(reckoning.path), 1))
        for name, values in zip((*RECKONED, *WALKS), np.column_stack([unit_poses, walks]).T, strict=True):
            columns[name] = reckoning.path.time_s, values
    if sensors.bias_std and sensors.yaw_rate is not None:
        columns[BIAS] = sensors.yaw_rate.time_s[:1], np.array([sensors.bias_std * 3600 / DEG])
    times = np.unique(np.concatenate([time for time, _ in columns.values()]))
    cells = np.full((len(times), len(columns)), "", dtype=object)
    for number, (time, values) in enumerate(columns.values()):
        cells[np.searchsorted(times, time), number] = [f"{value:.12g}" for value in values]
    lines = [",".join(["time_s", *columns])]
    lines += [",".join([f"{time:.9f}", *row]) for time, row in zip(times, cells, strict=True)]
    write_atomic(Path(path), ("\n".join(lines) + "\n").encode())


def _readings_by_column(sensors: VehicleSensors) -> Mapping[str, Readings]:
    """Return the readings by column name."""
    by_column = {
        "yaw_rate_deg_s": sensors.yaw_rate,
        "sideways_m_s": sensors.sideways,
        "forward_m_s": sensors.forward,
        "depth_m": sensors.depth,
        "vehicle_pitch_deg": sensors.pitch,
        "vehicle_roll_deg": sensors.roll,
        "heading_deg": sensors.heading,
    }
    return {name: readings for name, readings in by_column.items() if readings is not None}


def _sensor_columns(table: CsvTable) -> list[str]:
    """Return the sensor columns of a table; in a table with poses, ``heading_deg`` is not one of them."""
    columns = [name for name in (*COLUMNS, *RECKONED) if name in table.names]
    if not POSITION_COLUMNS & set(table.names) or "heading_deg" not in columns:
        return columns
    if COLUMNS["heading_deg"][0] in table.names:
        message = f"{table.path}: heading_deg belongs to the poses in this file, and is not read as a compass"
        warnings.warn(f"{message}: name the column of a compass compass_deg, and its noise", MitsonarWarning, stacklevel=3)
    columns.remove("heading_deg")
    return columns


def _time_name(table: CsvTable) -> str:
    time_columns = [name for name in TIMES if name in table.names]
    if len(time_columns) != 1:
        raise MitsonarError(f"{table.path} needs one column of times, {', '.join(TIMES)}: got {', '.join(table.names)[:80]}")
    return time_columns[0]


def _column(table: CsvTable, name: str, *, complete: bool = False) -> Array:
    """Return a column; empty cells are nan, or rejected if the column must be complete."""
    column = table.names.index(name)
    numbers = table.at(column)
    for row, (cells, number) in enumerate(zip(table.rows, numbers, strict=True), start=2):
        cell = cells[column].strip()
        if (cell or complete) and not (abs(number) <= LARGEST and "_" not in cell):
            limit = f"; numbers up to {LARGEST:g} are read, times in s" if LARGEST < abs(number) < np.inf else ""
            raise MitsonarError(f"{table.path}, row {row:,}: {name} must be a number: got {cell[:40]!r}{limit}")
    return numbers


def _first_number(table: CsvTable, name: str) -> float:
    """Return the first number of a column."""
    numbers = _column(table, name)
    known = numbers[np.isfinite(numbers)]
    if not known.size:
        raise MitsonarError(f"{table.path}: the column {name} is empty")
    return float(known[0])


def _parse_readings(table: CsvTable, time: Array, name: str) -> Readings | None:
    """Return the readings of a column; None if it is empty."""
    noise, unit, noise_unit = COLUMNS[name]
    values = _column(table, name)
    known = np.isfinite(values)
    if not known.any():
        return None
    if noise not in table.names:
        raise MitsonarError(f"{table.path} has {name}, but not its noise: add the column {noise}")
    first, std = _first_number(table, noise), _column(table, noise)
    std = np.where(np.isfinite(std), std, first)
    try:
        return Readings(time[known], values[known] * unit, std[known] * noise_unit)
    except MitsonarError as error:
        raise MitsonarError(f"{table.path}, column {name}: {error}") from None


def _parse_dead_reckoning(table: CsvTable, time: Array) -> DeadReckoning:
    """Return the dead reckoning of a table."""
    missing = [name for name in (*RECKONED, *WALKS) if name not in table.names]
    if missing:
        raise MitsonarError(f"{table.path} has poses by dead reckoning, but no column {', '.join(missing)}: add it")
    numbers = np.column_stack([_column(table, name) for name in RECKONED])
    known = np.isfinite(numbers).all(axis=1)
    poses = np.zeros((int(known.sum()), 6))
    poses[:, [0, 1, 5]] = numbers[known] * [1, 1, DEG]
    try:
        return DeadReckoning(
            Trajectory(poses, time[known]), _first_number(table, WALKS[0]), _first_number(table, WALKS[1]) * DEG
        )
    except MitsonarError as error:
        raise MitsonarError(f"{table.path}, dead reckoning: {error}") from None
