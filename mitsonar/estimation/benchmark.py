"""Estimators side by side: all on the same pairs in one run, with what they were told changed, and the physical limit."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.datasets.plan import scenes_of
from mitsonar.datasets.re_render import re_rendered
from mitsonar.datasets.response_samples import ImpulseSamples
from mitsonar.datasets.scene_rendering import SceneRenderer
from mitsonar.datasets.torch_pairs import SonarPairs
from mitsonar.errors import MitsonarError
from mitsonar.estimation.crlb.image_crlb import bounds_at, overall
from mitsonar.estimation.estimator import AnyEstimator, PlainTable, Record
from mitsonar.motion.motion_errors import MotionErrors, in_units, motion_errors
from mitsonar.records.sonar_frames import SonarFrames
from mitsonar.simulation.variant import release_memory

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
"""What is changed, half of the pairs one way and half the other."""

HEAVE_M = 0.005


@dataclass(frozen=True)
class Answers:
    """What one estimator said of many pairs.

    Attributes:
        motion: sideways, forward [m], yaw [rad] ``(n, 3)``.
        believe: whether it stands for it ``(n,)``.
        covariance: ``(n, 3, 3)``, nan where it gives none.
        ms: processor time of each, all threads ``(n,)``.
    """

    motion: Array
    valid: NDArray[np.bool_]
    covariance: Array
    ms: Array

    @classmethod
    def unasked(cls, count: int) -> Answers:
        """None yet: times are nan."""
        nan = np.full((count, 3, 3), np.nan)
        return cls(np.zeros((count, 3)), np.zeros(count, dtype=bool), nan, np.full(count, np.nan))

    @property
    def asked(self) -> NDArray[np.bool_]:
        """Which pairs have been asked for ``(n,)``."""
        return np.isfinite(self.ms)

    def ask(self, place: int, estimator: AnyEstimator, frames: Record) -> None:
        """Put an estimate in its place."""
        begun = time.process_time()
        estimate = estimator.estimate(frames)
        self.ms[place] = 1e3 * (time.process_time() - begun)
        self.motion[place], self.valid[place] = estimate.motion, estimate.valid
        if estimate.covariance is not None:
            self.covariance[place] = estimate.covariance

    def arrays(self, prefix: str) -> dict[str, NDArray[np.generic]]:
        """By name, to store."""
        return {f"{prefix}/{field.name}": getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_arrays(cls, table: Mapping[str, NDArray[np.generic]], prefix: str) -> Answers:
        """What :meth:`arrays` gave."""
        return cls(*(np.array(table[f"{prefix}/{field.name}"]) for field in fields(cls)))


def chosen(count: int, pairs: int | None, seed: int) -> list[int]:
    """Numbers of samples: all, or some at random, in order."""
    if pairs is None or pairs >= count:
        return list(range(count))
    return sorted(np.random.default_rng([seed, 11]).choice(count, pairs, replace=False).tolist())


def frames_of(pairs: Samples, numbers: Sequence[int], variation: str) -> Iterator[tuple[int, Record]]:
    """Samples as (number, frames or impulse responses) with a variation of :data:`VARIATIONS`; of responses only as told."""
    if isinstance(pairs, ImpulseSamples):
        for number in numbers:
            yield number, pairs.responses(number)
    elif variation == "heave 5 mm":
        yield from re_rendered(pairs, numbers, shift=_heaved)
    elif variation == "jitter":
        yield from re_rendered(pairs, numbers, jitter=True)
    elif variation in VARIATIONS:
        for number in numbers:
            yield number, _told(pairs.sonar_frames(number), variation, _sign(number))
    else:
        raise MitsonarError(f"unknown variation {variation!r}: known are {', '.join(VARIATIONS)}")


def _sign(number: int) -> int:
    return 1 if number % 2 == 0 else -1


def _heaved(number: int, poses: Array) -> Array:
    moved = poses.copy()
    moved[1:, 2] += _sign(number) * HEAVE_M * np.arange(1, len(poses))
    return moved


def _told(frames: SonarFrames, variation: str, sign: int) -> SonarFrames:
    """Frames that tell something wrong."""
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
    """What all estimators say of the same pairs, one pair after another.

    Args:
        estimators: by name.
        pairs: of a store.
        numbers: of the samples.
        variation: of :data:`VARIATIONS`.
        known: answers of an earlier run that was broken off; only what is missing is asked for.
        keep: called every so many pairs, and at the end, with all answers.
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
    place = {number: k for k, number in enumerate(numbers)}
    missing = [number for number in numbers if not all(table[name].asked[place[number]] for name in estimators)]
    if progress is not None:
        progress(len(numbers) - len(missing))
    for count, (number, frames) in enumerate(frames_of(pairs, missing, variation), start=1):
        for name, estimator in estimators.items():
            if not table[name].asked[place[number]]:
                table[name].ask(place[number], estimator, frames)
        if progress is not None:
            progress(1)
        if keep is not None and count % keep_every == 0:
            keep(table)
    if keep is not None:
        keep(table)
    return table


def with_prior(answers: Answers, largest: Array) -> Answers:
    """Answers weighed with what networks know from training: motions are even within a box (here: a Gaussian as wide).

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
    """The two-frame bound by each law of :data:`mitsonar.estimation.crlb.image_crlb.LAWS` ``(3,)`` [m, m, rad]: the root of
    the mean
    variance over the first poses of these samples; 0 where no noise leaves no bound."""
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
        inputs: what it is given.
        errors: see :class:`mitsonar.motion.motion_errors.MotionErrors`.
        ms: median processor time of the believed pairs, all threads.
        over_limit: RMSE over the bound ``(3,)``; nan where there is none.
        over_reference: RMSE less that of the reference method ``(3,)`` [mm, mm, deg], with
        over_reference_low: the lower,
        over_reference_high: and the upper end of its 95 % interval (paired).
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
        """Numbers and texts only, for JSON: nan becomes None."""

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
    """A table of methods on the same pairs; see section 7 of the reference.

    Args:
        answers: by method.
        inputs: by method.
        truth: motions ``(n, 3)`` [m, m, rad].
        resamples: of :func:`mitsonar.motion.motion_errors.cluster_resamples`; the same for all, so that differences are
        paired.
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
