"""The benchmark: all estimators on the same pairs, also with wrong inputs, and the Cramer-Rao lower bound."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import overload

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.datasets.make import SceneRenderer
from mitsonar.datasets.plan import scenes_of
from mitsonar.datasets.rendered import re_rendered
from mitsonar.datasets.responses import ImpulseSamples
from mitsonar.datasets.samples import SonarPairs
from mitsonar.errors import MitsonarError
from mitsonar.estimation.crlb.fisher_bound import overall
from mitsonar.estimation.crlb.image_crlb import bounds_at
from mitsonar.estimation.estimator import AnyEstimator, PlainTable, Record
from mitsonar.motion.errors import MotionErrors, in_units, motion_errors
from mitsonar.records.frames import SonarFrames
from mitsonar.records.responses import ImpulseResponses
from mitsonar.simulation.device import release_memory

__all__ = [
    "VARIATIONS",
    "Answers",
    "BenchmarkRow",
    "Samples",
    "answers_of",
    "bounds_of_pairs",
    "chosen",
    "frames_of",
    "rows_of",
    "with_prior",
]

Array = NDArray[np.float64]

Samples = SonarPairs | ImpulseSamples
"""The samples of a data set that estimators are compared on."""

VARIATIONS: dict[str, str] = {
    "as told": "height, pitch, roll and sound speed are right",
    "height 5 %": "the height told is 5 % too large or too small (of no effect where first echoes tell it)",
    "pitch 1 deg": "the pitch told is 1 deg off",
    "roll 1 deg": "the roll told is 1 deg off",
    "sound speed 1 %": "ranges are 1 % too long or too short",
    "heave 5 mm": "the sonar rises or sinks by 5 mm between the pings (rendered again)",
    "jitter": "rays move within their cells, anew each ping (rendered again)",
}
"""What each variation changes: half of the pairs one way and half the other."""

HEAVE_M = 0.005


@dataclass(frozen=True)
class Answers:
    """The estimates of one estimator for many pairs.

    Attributes:
        motion: sideways, forward [m], yaw [rad] ``(n, 3)``.
        valid: whether the estimate is valid ``(n,)``.
        covariance: ``(n, 3, 3)`` [m, m, rad], nan where there is none.
        ms: processor time of each estimate, all threads ``(n,)`` [ms]; nan before it is made.
    """

    motion: Array
    valid: NDArray[np.bool_]
    covariance: Array
    ms: Array

    @classmethod
    def unasked(cls, count: int) -> Answers:
        """Return room for ``count`` estimates, none of which is made yet."""
        nan = np.full((count, 3, 3), np.nan)
        return cls(np.zeros((count, 3)), np.zeros(count, dtype=bool), nan, np.full(count, np.nan))

    @property
    def asked(self) -> NDArray[np.bool_]:
        """Return which estimates are made ``(n,)``."""
        return np.isfinite(self.ms)

    def ask(self, index: int, estimator: AnyEstimator, frames: Record) -> None:
        """Estimate one pair and store the result at an index."""
        begun = time.process_time()
        estimate = estimator.estimate(frames)
        self.ms[index] = 1e3 * (time.process_time() - begun)
        self.motion[index], self.valid[index] = estimate.motion, estimate.valid
        if estimate.covariance is not None:
            self.covariance[index] = estimate.covariance

    def arrays(self, prefix: str) -> dict[str, NDArray[np.generic]]:
        """Return all arrays by name, to be stored."""
        return {f"{prefix}/{field.name}": getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_arrays(cls, table: Mapping[str, NDArray[np.generic]], prefix: str) -> Answers:
        """Restore what :meth:`arrays` returned."""
        return cls(*(np.array(table[f"{prefix}/{field.name}"]) for field in fields(cls)))


def chosen(count: int, pairs: int | None, seed: int) -> list[int]:
    """Return numbers of samples: all, or some at random, in order."""
    if pairs is None or pairs >= count:
        return list(range(count))
    return sorted(np.random.default_rng([seed, 11]).choice(count, pairs, replace=False).tolist())


@overload
def frames_of(pairs: SonarPairs, numbers: Sequence[int], variation: str) -> Iterator[tuple[int, SonarFrames]]: ...
@overload
def frames_of(pairs: ImpulseSamples, numbers: Sequence[int], variation: str) -> Iterator[tuple[int, ImpulseResponses]]: ...
@overload
def frames_of(pairs: Samples, numbers: Sequence[int], variation: str) -> Iterator[tuple[int, Record]]: ...
def frames_of(pairs: Samples, numbers: Sequence[int], variation: str) -> Iterator[tuple[int, Record]]:
    """Yield samples as (number, record) with a variation of :data:`VARIATIONS`; impulse responses have none.

    Raises:
        MitsonarError: an unknown variation.
    """
    if isinstance(pairs, ImpulseSamples):
        for number in numbers:
            yield number, pairs.responses(number)
    elif variation == "heave 5 mm":
        yield from re_rendered(pairs, numbers, shift=_heaved)
    elif variation == "jitter":
        yield from re_rendered(pairs, numbers, jitter=True)
    elif variation in VARIATIONS:
        for number in numbers:
            yield number, _misinformed(pairs.sonar_frames(number), variation, _sign(number))
    else:
        raise MitsonarError(f"unknown variation {variation!r}: known are {', '.join(VARIATIONS)}")


def _sign(number: int) -> int:
    return 1 if number % 2 == 0 else -1


def _heaved(number: int, poses: Array) -> Array:
    moved = poses.copy()
    moved[1:, 2] += _sign(number) * HEAVE_M * np.arange(1, len(poses))
    return moved


def _misinformed(frames: SonarFrames, variation: str, sign: int) -> SonarFrames:
    """Return frames with a wrong height, attitude or sound speed."""
    change: dict[str, Array] = {}
    poses = None if frames.poses is None else frames.poses.copy()
    if variation == "height 5 %" and frames.height_m is not None:
        change["height_m"] = frames.height_m * (1 + 0.05 * sign)
    elif variation == "sound speed 1 %":
        change["range_m"] = frames.range_m * (1 + 0.01 * sign)
    elif variation in ("pitch 1 deg", "roll 1 deg") and poses is not None:
        poses[:, 3 if variation.startswith("pitch") else 4] += sign * np.radians(1)
        change["poses"] = poses
    return SonarFrames(**{**vars(frames), **change})


def answers_of(
    estimators: Mapping[str, AnyEstimator],
    pairs: Samples,
    numbers: Sequence[int],
    variation: str = "as told",
    *,
    known: dict[str, Answers] | None = None,
    keep: Callable[[dict[str, Answers]], None] | None = None,
    keep_every: int = 100,
    progress: Callable[[int], object] | None = None,
) -> dict[str, Answers]:
    """Estimate the same pairs with all estimators, one pair after another.

    Args:
        estimators: by name.
        pairs: of a store.
        numbers: of the samples.
        variation: of :data:`VARIATIONS`.
        known: estimates of an interrupted run; only the missing ones are made.
        keep: called every so many pairs, and at the end, with all estimates.
        keep_every: how many.
        progress: called with how many pairs are done since the last call.
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        return _answers_of(estimators, pairs, numbers, variation, known, keep, keep_every, progress)
    finally:
        cv2.setNumThreads(threads)


def _answers_of(
    estimators: Mapping[str, AnyEstimator],
    pairs: Samples,
    numbers: Sequence[int],
    variation: str,
    known: dict[str, Answers] | None,
    keep: Callable[[dict[str, Answers]], None] | None,
    keep_every: int,
    progress: Callable[[int], object] | None,
) -> dict[str, Answers]:
    table = {name: (known or {}).get(name) or Answers.unasked(len(numbers)) for name in estimators}
    index = {number: k for k, number in enumerate(numbers)}
    missing = [number for number in numbers if not all(table[name].asked[index[number]] for name in estimators)]
    if progress is not None:
        progress(len(numbers) - len(missing))
    for count, (number, frames) in enumerate(frames_of(pairs, missing, variation), start=1):
        for name, estimator in estimators.items():
            if not table[name].asked[index[number]]:
                table[name].ask(index[number], estimator, frames)
        if progress is not None:
            progress(1)
        if keep is not None and count % keep_every == 0:
            keep(table)
    if keep is not None:
        keep(table)
    return table


def with_prior(answers: Answers, largest: Array) -> Answers:
    """Combine estimates with the prior that networks learn: motions uniform in a box, here a Gaussian of equal variance.

    Args:
        answers: with covariances.
        largest: half the edges of the box ``(3,)`` [m, m, rad].
    """
    prior = np.diag(largest**2 / 3)
    motion, covariance = answers.motion.copy(), answers.covariance.copy()
    for k in np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2))):
        motion[k] = prior @ np.linalg.solve(prior + covariance[k], motion[k])
        covariance[k] = prior @ np.linalg.solve(prior + covariance[k], covariance[k])
    return Answers(motion, answers.valid, covariance, answers.ms)


def bounds_of_pairs(
    pairs: SonarPairs, numbers: Sequence[int], noise: NoiseModel, progress: Callable[[int], object] | None = None
) -> dict[str, Array]:
    """Return the two-frame bound ``(3,)`` [m, m, rad] by law, see :func:`mitsonar.estimation.crlb.image_crlb.laws_of`.

    It is the root of the mean variance over the first poses of these samples; 0 where there is no bound without noise.
    """
    wanted = np.asarray(numbers, dtype=np.int64)
    scene_of = pairs.scene[pairs.first[wanted]]
    gain = float(pairs.store.about["gain"])
    stds: dict[str, list[Array]] = {}
    for scene in scenes_of(pairs.recipe, pairs.recipe.sequences):
        mine = wanted[scene_of == scene.number]
        if not len(mine):
            continue
        renderer = SceneRenderer(pairs.recipe, scene)
        for found in bounds_at(renderer.simulator, pairs.pose[pairs.first[mine]], noise, gain):
            for (_, kind, law), bound in found.items():
                if kind == "image":
                    stds.setdefault(law, []).append(np.zeros(3) if bound is None else bound.std(2))
            if progress is not None:
                progress(1)
        del renderer
        release_memory()
    return {law: overall(values) for law, values in stds.items()}


@dataclass(frozen=True)
class BenchmarkRow:
    """One method in a table.

    Attributes:
        method: its name.
        inputs: that it needs.
        errors: see :class:`mitsonar.motion.errors.MotionErrors`.
        ms: median processor time of the valid pairs, all threads [ms].
        over_limit: RMSE over the bound ``(3,)``; nan where there is none.
        over_reference: RMSE less that of the reference method ``(3,)`` [mm, mm, deg].
        over_reference_low: lower end of its paired 95 % interval.
        over_reference_high: upper end of the same.
    """

    method: str
    inputs: str
    errors: MotionErrors
    ms: float
    over_limit: Array
    over_reference: Array
    over_reference_low: Array
    over_reference_high: Array

    def plain(self) -> PlainTable:
        """Return numbers and texts only, for JSON: nan becomes None."""

        def value(one: object) -> object:
            if isinstance(one, np.ndarray):
                return [value(float(v)) for v in one]
            if isinstance(one, float | np.floating):
                return float(one) if np.isfinite(one) else None
            return one

        own = {f.name: value(getattr(self, f.name)) for f in fields(self) if f.name != "errors"}
        return own | {f.name: value(getattr(self.errors, f.name)) for f in fields(self.errors)}


def rows_of(
    answers: Mapping[str, Answers],
    inputs: Mapping[str, str],
    truth: Array,
    resamples: NDArray[np.int64],
    *,
    limit: Array | None = None,
    reference: str | None = None,
) -> list[BenchmarkRow]:
    """Return a row for each method, all on the same pairs: errors of motion, invalid estimates count as zero motion.

    Args:
        answers: by method.
        inputs: by method.
        truth: motions ``(n, 3)`` [m, m, rad].
        resamples: of :func:`mitsonar.motion.errors.cluster_resamples`; the same for all, so that
            differences are paired.
        limit: standard deviations ``(3,)`` [m, m, rad].
        reference: the method that others are compared with; default: the last.
    """
    bound = np.full(3, np.nan) if limit is None else in_units(limit)
    reference = reference or list(answers)[-1]

    def squares(one: Answers) -> Array:
        return in_units(np.where(one.valid[:, None], one.motion, 0.0) - truth) ** 2

    against = squares(answers[reference])
    rows = []
    for name, one in answers.items():
        errors = motion_errors(one.motion, truth, one.valid, one.covariance, resamples)
        drawn = [np.sqrt(table[resamples].mean(axis=1)) for table in (squares(one), against)]
        low, high = np.percentile(drawn[0] - drawn[1], [2.5, 97.5], axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where((bound > 0) & np.isfinite(bound), errors.rmse / bound, np.nan)
        difference = errors.rmse - np.sqrt(against.mean(axis=0))
        ms = float(np.median(one.ms[one.valid] if one.valid.any() else one.ms))
        rows.append(BenchmarkRow(name, inputs[name], errors, ms, ratio, difference, low, high))
    return rows
