"""How estimators are compared: errors on the same pairs, also with wrong inputs, and the Cramer-Rao lower bound."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, overload

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.config.data import Recipe, Split
from mitsonar.datasets.make import SceneRenderer
from mitsonar.datasets.modality import samples_of
from mitsonar.datasets.plan import modality_of, scenes_of
from mitsonar.datasets.rendered import rerender
from mitsonar.datasets.responses import ImpulseSamples
from mitsonar.datasets.sample_index import split_for
from mitsonar.datasets.samples import SonarPairs
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError, argument, count_noun, did_you_mean
from mitsonar.estimation.crlb.image import bounds_at, overall
from mitsonar.estimation.estimator import AnyEstimator, PlainTable, Record
from mitsonar.estimation.external import OwnEstimator
from mitsonar.estimation.image.ping_groups import estimate_pair
from mitsonar.estimation.named import EstimatorLike, create_estimator
from mitsonar.io.files import read_json, read_npz, write_atomic, write_json
from mitsonar.io.runs import RunDirectory, RunKind, digest, plain_json, versions
from mitsonar.motion.composition import motions
from mitsonar.motion.errors import AXES, MotionErrors, cluster_resamples, in_units, motion_errors
from mitsonar.records.frames import SonarFrames
from mitsonar.records.responses import ImpulseResponses
from mitsonar.simulation.device import release_memory

if TYPE_CHECKING:
    from mitsonar.networks.checkpoint import Checkpoint

__all__ = [
    "COMPARISON",
    "FEWEST_SCENES",
    "VARIATIONS",
    "AnswerFolder",
    "Answers",
    "BenchmarkRow",
    "Cells",
    "Comparison",
    "ComparisonOptions",
    "Estimators",
    "Samples",
    "answers_of",
    "bounds_of_pairs",
    "chosen",
    "compare",
    "frames_of",
    "kept_answers",
    "markdown",
    "rows_of",
    "table_lines",
    "with_prior",
]


Array = NDArray[np.float64]

Samples = SonarPairs | ImpulseSamples
"""The samples of a data set on which estimators are compared."""

VARIATIONS: dict[str, str] = {
    "as given": "height, pitch, roll and sound speed are right",
    "height 5 %": "the given height is 5 % too large or too small (without effect where first echoes give it)",
    "pitch 1 deg": "the given pitch is 1 deg off",
    "roll 1 deg": "the given roll is 1 deg off",
    "sound speed 1 %": "ranges are 1 % too long or too short",
    "heave 5 mm": "the sonar rises or sinks by 5 mm between the pings (rendered again)",
    "jitter": "rays move within their cells, anew each ping (rendered again)",
}
"""Description of each variation; half of the pairs change in one direction, half in the other."""

HEAVE_M = 0.005


@dataclass(frozen=True)
class Answers:
    """The estimates of one estimator for many pairs.

    Attributes:
        motion: sideways, forward [m], yaw [rad] ``(n, 3)``.
        valid: whether the estimate is valid ``(n,)``.
        covariance: ``(n, 3, 3)`` [m, m, rad]; nan where there is none.
        ms: processor time of each estimate, all threads ``(n,)`` [ms]; nan if the pair has not been estimated.
    """

    motion: Array
    valid: NDArray[np.bool_]
    covariance: Array
    ms: Array

    @classmethod
    def unasked(cls, count: int) -> Answers:
        """Return an empty table for ``count`` estimates."""
        nan = np.full((count, 3, 3), np.nan)
        return cls(np.zeros((count, 3)), np.zeros(count, dtype=bool), nan, np.full(count, np.nan))

    @property
    def estimated(self) -> NDArray[np.bool_]:
        """Return which pairs have been estimated ``(n,)``."""
        return np.isfinite(self.ms)

    def ask(self, index: int, estimator: AnyEstimator, frames: Record) -> None:
        """Estimate one pair and store the result at an index."""
        begun = time.process_time()
        estimate = estimate_pair(estimator, frames)
        self.ms[index] = 1e3 * (time.process_time() - begun)
        self.motion[index], self.valid[index] = estimate.motion, estimate.valid
        if estimate.covariance is not None:
            self.covariance[index] = estimate.covariance

    def arrays(self, prefix: str) -> dict[str, NDArray[np.generic]]:
        """Return all arrays by name, for storage."""
        return {f"{prefix}/{field.name}": getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_arrays(cls, table: Mapping[str, NDArray[np.generic]], prefix: str) -> Answers:
        """Restore the estimates from the arrays of :meth:`arrays`."""
        return cls(*(np.array(table[f"{prefix}/{field.name}"]) for field in fields(cls)))


def chosen(count: int, pairs: int | None, seed: int) -> list[int]:
    """Return sample numbers in increasing order: all, or a random choice of ``pairs``."""
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
        yield from rerender(pairs, numbers, shift=_heaved)
    elif variation == "jitter":
        yield from rerender(pairs, numbers, jitter=True)
    elif variation in VARIATIONS:
        for number in numbers:
            yield number, _with_wrong_inputs(pairs.sonar_frames(number), variation, _sign(number))
    else:
        raise MitsonarError(f"unknown variation {variation!r}: known are {', '.join(VARIATIONS)}")


def _sign(number: int) -> int:
    return 1 if number % 2 == 0 else -1


def _heaved(number: int, poses: Array) -> Array:
    moved = poses.copy()
    moved[1:, 2] += _sign(number) * HEAVE_M * np.arange(1, len(poses))
    return moved


def _with_wrong_inputs(frames: SonarFrames, variation: str, sign: int) -> SonarFrames:
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
    variation: str = "as given",
    *,
    known: dict[str, Answers] | None = None,
    keep: Callable[[dict[str, Answers]], None] | None = None,
    keep_every: int = 100,
    progress: Callable[[int], object] | None = None,
) -> dict[str, Answers]:
    """Estimate the same pairs with all estimators, one pair after another.

    Args:
        estimators: estimators by name.
        pairs: samples of a store.
        numbers: numbers of the samples to estimate.
        variation: one of :data:`VARIATIONS`.
        known: estimates of an interrupted run; only the missing ones are made.
        keep: called with all estimates after every ``keep_every`` pairs and at the end.
        keep_every: number of pairs between calls of ``keep``.
        progress: called with the number of pairs finished since the last call.
    """
    table = {name: (known or {}).get(name) or Answers.unasked(len(numbers)) for name in estimators}
    index = {number: k for k, number in enumerate(numbers)}
    missing = [number for number in numbers if not all(table[name].estimated[index[number]] for name in estimators)]
    if progress is not None:
        progress(len(numbers) - len(missing))
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for count, (number, frames) in enumerate(frames_of(pairs, missing, variation), start=1):
            for name, estimator in estimators.items():
                if not table[name].estimated[index[number]]:
                    table[name].ask(index[number], estimator, frames)
            if progress is not None:
                progress(1)
            if keep is not None and count % keep_every == 0:
                keep(table)
    finally:
        cv2.setNumThreads(threads)
    if keep is not None:
        keep(table)
    return table


def with_prior(answers: Answers, largest: Array) -> Answers:
    """Combine estimates with the prior that networks learn: motions uniform in a box, here a Gaussian of equal variance.

    Args:
        answers: estimates with covariances.
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
    """Return the two-frame bound ``(3,)`` [m, m, rad] by law, see :func:`mitsonar.estimation.crlb.image.laws_of`.

    It is the root of the mean variance over the first poses of these samples; 0 where there is no bound without noise.
    """
    indices = np.asarray(numbers, dtype=np.int64)
    scene_of = pairs.scene[pairs.first[indices]]
    gain = float(pairs.store.about["gain"])
    stds: dict[str, list[Array]] = {}
    for scene in scenes_of(pairs.recipe, pairs.recipe.sequences):
        in_scene = indices[scene_of == scene.number]
        if not len(in_scene):
            continue
        renderer = SceneRenderer(pairs.recipe, scene)
        for bounds in bounds_at(renderer.simulator, pairs.pose[pairs.first[in_scene]], noise, gain):
            for (_, kind, law), bound in bounds.items():
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
        method: name of the method.
        inputs: inputs that it needs.
        errors: see :class:`mitsonar.motion.errors.MotionErrors`.
        ms: median processor time of the valid pairs, all threads [ms].
        over_limit: RMSE divided by the bound ``(3,)``; nan where there is none.
        over_reference: RMSE minus that of the reference method ``(3,)`` [mm, mm, deg].
        over_reference_low: lower end of its paired 95 % interval.
        over_reference_high: upper end of its paired 95 % interval.
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
        """Return the row as a JSON object of numbers and strings: nan becomes None."""

        def plain_value(one: object) -> object:
            if isinstance(one, np.ndarray):
                return [plain_value(float(v)) for v in one]
            if isinstance(one, float | np.floating):
                return float(one) if np.isfinite(one) else None
            return one

        values = {f.name: plain_value(getattr(self, f.name)) for f in fields(self) if f.name != "errors"}
        return values | {f.name: plain_value(getattr(self.errors, f.name)) for f in fields(self.errors)}


def rows_of(
    answers: Mapping[str, Answers],
    inputs: Mapping[str, str],
    truth: Array,
    resamples: NDArray[np.int64],
    *,
    limit: Array | None = None,
    reference: str | None = None,
) -> list[BenchmarkRow]:
    """Return the errors of each method on the same pairs; invalid estimates count as zero motion.

    Args:
        answers: estimates by method.
        inputs: required inputs by method.
        truth: motions ``(n, 3)`` [m, m, rad].
        resamples: from :func:`mitsonar.motion.errors.cluster_resamples`; the same for all methods, so that differences are
            paired.
        limit: standard deviations of the bound ``(3,)`` [m, m, rad].
        reference: the method with which others are compared; default: the last.
    """
    bound = np.full(3, np.nan) if limit is None else in_units(limit)
    reference = reference or list(answers)[-1]

    def squares(one: Answers) -> Array:
        return in_units(np.where(one.valid[:, None], one.motion, 0.0) - truth) ** 2

    reference_squares = squares(answers[reference])
    rows = []
    for name, one in answers.items():
        errors = motion_errors(one.motion, truth, one.valid, one.covariance, resamples)
        # the same resamples for both methods give a paired interval of their difference
        drawn = [np.sqrt(table[resamples].mean(axis=1)) for table in (squares(one), reference_squares)]
        low, high = np.percentile(drawn[0] - drawn[1], [2.5, 97.5], axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where((bound > 0) & np.isfinite(bound), errors.rmse / bound, np.nan)
        difference = errors.rmse - np.sqrt(reference_squares.mean(axis=0))
        ms = float(np.median(one.ms[one.valid] if one.valid.any() else one.ms))
        rows.append(BenchmarkRow(name, inputs[name], errors, ms, ratio, difference, low, high))
    return rows


# ---------------- Tables


FEWEST_SCENES = 10
"""Smallest number of scenes for clustered intervals; with fewer they are much too narrow."""


@dataclass(frozen=True)
class Comparison:
    """The result of a comparison of estimators. Its string is its tables as Markdown, which a notebook renders.

    Attributes:
        report: the content of ``table.json``: the settings; ``notes``, sentences for the reader; ``tables``, one per level
            of noise and variation, whose ``rows`` are :class:`~mitsonar.estimation.compare.BenchmarkRow` as JSON.
    """

    report: PlainTable

    @property
    def rows(self) -> list[PlainTable]:
        """Return a row for each method, level of noise and variation: ``noise``, ``variation``, and numbers and strings.

        Values with three components, sideways and forward [mm] and yaw [deg], become three entries: ``rmse_sideways_mm`` ...
        Unknown numbers are None.
        """
        return [
            {"noise": table["noise"], "variation": table["variation"], **_flat(row)}
            for table in self.report["tables"]
            for row in table["rows"]
        ]

    @property
    def notes(self) -> list[str]:
        """Return the notes, sentences for the reader."""
        return list(self.report["notes"])

    def columns(self) -> dict[str, list[object]]:
        """Return the columns of :attr:`rows` by name, as ``pandas.DataFrame`` accepts them."""
        rows = self.rows
        return {name: [row[name] for row in rows] for name in rows[0]}

    def to_markdown(self) -> str:
        """Return the tables as printed by ``mitsonar compare``."""
        report = self.report
        head = (
            f"{report['data']}: {count_noun(report['pairs'], 'pair')} of {count_noun(report['scenes'], 'scene')}, "
            f"{report['model']} model; sideways mm / forward mm / yaw deg"
        )
        return "\n".join([head, *(line for table in report["tables"] for line in table_lines(table))])

    def to_csv(self, path: str | Path | None = None) -> str:
        """Return :attr:`rows` as CSV; also write it to ``path`` if given."""
        text, rows = io.StringIO(), self.rows
        writer = csv.DictWriter(text, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        if path is not None:
            write_atomic(path, text.getvalue().encode())
        return text.getvalue()

    def __str__(self) -> str:
        return self.to_markdown()

    def _repr_markdown_(self) -> str:
        return self.to_markdown()


def _flat(row: PlainTable) -> PlainTable:
    """Return a row with a separate entry for each number."""
    flat: PlainTable = {}
    for name, value in row.items():
        if isinstance(value, list):
            ends = [axis.name if name in UNITLESS else f"{axis.name}_{axis.unit}" for axis in AXES]
            flat |= {f"{name}_{end}": one for end, one in zip(ends, value, strict=True)}
        else:
            flat[name] = value
    return flat


UNITLESS = ("slope", "skill", "over_limit")
"""Entries of a row without a unit."""


def table_lines(table: PlainTable) -> list[str]:
    """Return a table of the report as lines of Markdown."""
    shown = markdown(table["rows"], COLUMNS)
    shown[0] = shown[0].replace("/ limit (rays)", f"/ limit ({table.get('limit_law', 'rays')})")
    lines = ["", f"noise {table['noise']}, {table['variation']}", "", *shown]
    if table["limits"]:
        known = {law: std for law, std in table["limits"].items() if any(value != 0 for value in std)}
        lines += ["", "limit of two frames: " + "; ".join(f"{law} {_three(std)}" for law, std in known.items())]
    others = [row for row in table["rows"] if row["method"] != table["reference"] and row["method"] != "zero"]
    for row in others:
        numbers = zip(row["over_reference"], row["over_reference_low"], row["over_reference_high"], DIGITS, strict=True)
        spans = (f"{value:+.{d}f} ({low:+.{d}f}..{high:+.{d}f})" for value, low, high, d in numbers)
        lines.append(
            f"{'' if row is not others[0] else chr(10)}{row['method']} less {table['reference']}: {' / '.join(spans)}  "
        )
    return lines


Cells = Mapping[str, Callable[[PlainTable], str]]
"""Functions that format the cells of a row, by column."""


def markdown(rows: list[PlainTable], columns: Sequence[str], texts: Cells | None = None) -> list[str]:
    """Return the methods as lines of a Markdown table with these columns of ``texts``; default: of :data:`CELLS`."""
    text = CELLS if texts is None else texts
    cells = [list(columns), ["---"] * len(columns), *([text[column](row) for column in columns] for row in rows)]
    width = [max(len(row[k]) for row in cells) for k in range(len(columns))]
    return ["| " + " | ".join(cell.ljust(size) for cell, size in zip(row, width, strict=True)) + " |" for row in cells]


DIGITS = (2, 2, 4)


def _number(value: float | None, axis: int) -> str:
    return "-" if value is None else f"{value:.{DIGITS[axis]}f}"


def _three(values: list[float | None]) -> str:
    return " / ".join(_number(value, k) for k, value in enumerate(values))


def _joined(values: list[float | None], digits: int) -> str:
    return " / ".join("-" if value is None else f"{value:.{digits}f}" for value in values)


def _interval(row: PlainTable) -> str:
    ends = zip(row["rmse_low"], row["rmse_high"], strict=True)
    return " ".join(f"{_number(low, k)}..{_number(high, k)}" for k, (low, high) in enumerate(ends))


CELLS: Cells = {
    "method": lambda row: str(row["method"]) + (f" (learnt {row['learnt']})" if row.get("learnt") else ""),
    "RMSE": lambda row: _three(row["rmse"]),
    "RMSE, mm / mm / deg/100": lambda row: _joined(row["thesis"], 2),
    "95 % interval": _interval,
    "median": lambda row: _three(row["median"]),
    "95 %": lambda row: _three(row["p95"]),
    "slope": lambda row: _joined(row["slope"], 3),
    "bias": lambda row: _three(row["bias"]),
    "large": lambda row: _three(row["large"]),
    "fail": lambda row: str(row["failures"]),
    "skill": lambda row: _joined(row["skill"], 2),
    "/ limit (rays)": lambda row: _joined(row["over_limit"], 1),
    "nees": lambda row: "-" if row["nees"] is None else f"{row['nees']:.1f}",
    "ms": lambda row: f"{row['ms']:.1f}",
    "inputs": lambda row: str(row["inputs"]),
}
"""Columns of a comparison or an evaluation."""

COLUMNS = (
    *("method", "RMSE", "95 % interval", "median", "95 %", "slope", "large", "fail", "skill", "/ limit (rays)", "nees"),
    *("ms", "inputs"),
)


# ---------------- The comparison

Begin = Callable[[str, int], AbstractContextManager[Callable[[int], object]]]
"""Context manager of a stage, given its name and number of pairs; yields a function that reports newly finished pairs."""


Estimators: TypeAlias = str | Sequence[EstimatorLike] | Mapping[str, EstimatorLike] | None
"""Estimators of a comparison: a comma-separated string, a list, or a mapping from row names."""


@dataclass(frozen=True, kw_only=True)
class ComparisonOptions:
    """Choices of a comparison.

    Attributes:
        noise: levels of noise, separated by commas, or by ``;``.
        part: part of the data set; default: the one that training does not use.
        split: ``sequence``, ``scene`` or ``sample``; default: the split with which networks among the estimators were
            trained on this data set, else that of the data set.
        pairs: largest number of pairs; default: all.
        perturb: add rows in which estimators get wrong inputs.
        jitter: add a row with jittered rays.
        prior: add rows that use the prior of the size of motions.
        limit: number of pairs over which the Cramer-Rao lower bound is computed; 0: no bound.
        reference: the method with which others are compared; default: the last.
        seed: seed of noise, choice of pairs and bootstrap.
    """

    noise: str = "none"
    part: str | None = None
    split: str | None = None
    pairs: int | None = None
    perturb: bool = False
    jitter: bool = False
    prior: bool = False
    limit: int = 10
    reference: str | None = None
    seed: int = 0


@dataclass(frozen=True)
class Bench:
    """The estimators, and the pairs that all of them estimate.

    Attributes:
        methods: estimators by name.
        levels: noise models by name; None where the name is a signal-to-noise ratio.
        samples: samples by level of noise, the same pairs in each.
        numbers: numbers of the samples to estimate.
        truth: motions of the sonar ``(n, 3)`` [m, m, rad].
        scenes: scene number of each pair ``(n,)``.
        learnt: number of pairs that a network has seen in training, by network.
    """

    methods: dict[str, AnyEstimator]
    levels: dict[str, NoiseModel | None]
    samples: dict[str, Samples]
    numbers: list[int]
    truth: Array
    scenes: NDArray[np.int64]
    learnt: dict[str, int]

    @property
    def first(self) -> Samples:
        """Return the samples at the first level of noise."""
        return next(iter(self.samples.values()))


def compare(
    data: str | Path,
    estimators: Estimators = None,
    options: ComparisonOptions = ComparisonOptions(),
    *,
    out: str | Path | None = None,
    begin: Begin = lambda what, pairs: nullcontext(lambda done: None),
) -> Comparison:
    """Run all estimators on the same pairs and report their errors; invalid estimates count as zero motion.

    Args:
        data: path or URL of a data set.
        estimators: what :func:`~mitsonar.estimation.named.create_estimator` accepts: one comma-separated string, a list,
            or a dictionary from row names; default: all that need no training.
        options: which pairs, and which rows.
        out: folder for estimates, ``table.md`` and ``table.json``; an interrupted comparison in it resumes.
        begin: called with each stage, for progress.

    Returns:
        The errors of each method at each level of noise and variation: print it, or read its ``rows``.

    Raises:
        MitsonarError: unknown names, too few pairs, or another comparison in the folder.
    """
    data = str(data)
    bench = _bench(data, estimators, options)
    settings = _settings(bench, options)
    answer_store = kept_answers(out, settings)
    variations = _variations(options)
    with begin("comparing", len(bench.levels) * len(variations) * len(bench.numbers)) as progress:
        answers = {
            (level, variation): answers_of(
                bench.methods,
                bench.samples[level],
                bench.numbers,
                variation,
                known=answer_store.load(_key(level, model), variation, bench.methods, len(bench.numbers)),
                keep=partial(answer_store.keep, _key(level, model), variation),
                progress=progress,
            )
            for level, model in bench.levels.items()
            for variation in variations
        }
    tables = []
    for level in bench.levels:
        bounds = _bounds(bench, level, options.limit, answer_store, begin)
        tables += [_table(bench, options, level, variation, answers[level, variation], bounds) for variation in variations]
    scenes = len(np.unique(bench.scenes))
    notes = [f"{count_noun(scenes, 'scene')} only: the 95 % intervals are too narrow; compare on {FEWEST_SCENES} or more"]
    notes = notes if scenes < FEWEST_SCENES else []
    notes += [
        f"{name} was trained on {count} of the {count_noun(len(bench.numbers), 'pair')}, whose errors are too small; "
        f"take the part {bench.first.split.unseen}, or other data"
        for name, count in bench.learnt.items()
        if count
    ]
    report = {"data": data, "model": modality_of(bench.first.recipe).sonar.model, **settings, "scenes": scenes}
    report |= {"notes": notes, "tables": tables, **versions(("mitsonar",))}
    answer_store.finish(report)
    return Comparison(report)


# ---------------- Samples, methods and settings


def _bench(data: str, estimators: Estimators, options: ComparisonOptions) -> Bench:
    """Open the samples and create the estimators.

    Raises:
        MitsonarError: unknown names, options that do not apply to these data, or too few pairs.
    """
    recipe = DataStore.open(data).recipe
    modality = modality_of(recipe)
    methods = _methods(modality.estimators if estimators is None else estimators)
    if not methods:
        raise MitsonarError(
            f"{argument('estimators')} must name one or more: got none; leave it out for all without training"
        )
    if options.reference is not None and options.reference not in methods:
        raise MitsonarError(
            f"{argument('reference')} must be one of {', '.join(methods)}: got {options.reference!r}"
            f"{did_you_mean(options.reference, methods)}"
        )
    perturb, jitter, prior = (argument(name) for name in ("perturb", "jitter", "prior"))
    if not modality.variations and (options.perturb or options.jitter or options.prior):
        raise MitsonarError(f"{perturb}, {jitter} and {prior} apply only to data sets of images: omit them")
    if recipe.recorded is not None and (options.perturb or options.jitter):
        raise MitsonarError(f"{perturb} and {jitter} render the frames again, but recorded frames have no world: omit them")
    names = list(dict.fromkeys(options.noise.split(";" if ";" in options.noise else ",")))
    levels = {word: modality.noise_model(word) for word in names}
    split = _split(options.split, methods, recipe)
    chosen_samples = {
        **{"part": options.part or split.unseen, "split": split},
        **{"one_per_sequence": recipe.recorded is None, "seed": options.seed},
    }
    samples = {level: samples_of(modality, data, noise=level, **chosen_samples) for level in levels}
    first = next(iter(samples.values()))
    if len(first) < 2:
        part = chosen_samples["part"]
        raise MitsonarError(
            f"a comparison needs two pairs or more, of a made data set one a sequence: got {len(first)} in the part {part}; "
            f"give {'' if part == 'all' else argument('part') + ' all, or '}a larger data set"
        )
    if options.jitter and first.recipe.instrument.jittered:
        raise MitsonarError(f"the rays of this data set already move: {jitter} is for Almanza-Medina's model")
    numbers = chosen(len(first), options.pairs, options.seed)
    # motion of the sonar: the labels of a data set are the vehicle's motions, and a mount may turn or offset them
    pose = first.chosen.pose
    truth = np.array([motions(pose[first.frame_slice(number)][[0, -1]])[0] for number in numbers])
    learnt = {
        name: int(np.any([one.learnt(first)[numbers] for one in checkpoints], axis=0).sum())
        for name, checkpoints in _checkpoints(methods).items()
    }
    return Bench(methods, levels, samples, numbers, truth, first.scene[first.first[numbers]], learnt)


def _split(requested: str | None, methods: Mapping[str, AnyEstimator], recipe: Recipe) -> Split:
    """Return the requested split, else that of the networks trained on this data set, else that of the data set.

    Raises:
        MitsonarError: an unknown split, or networks trained on different ones.
    """
    if requested is not None:
        return split_for(requested, recipe)
    splits = [
        (name, one.split_of_training(recipe)) for name, checkpoints in _checkpoints(methods).items() for one in checkpoints
    ]
    known_splits = [(name, split) for name, split in splits if split is not None]
    if len({split.model_dump_json() for _, split in known_splits}) > 1:
        text = ", ".join(f"{name} by {split.by}" for name, split in known_splits)
        raise MitsonarError(
            f"the networks were trained on other parts of this data set: {text}; choose {argument('split')}, which marks "
            "rows with pairs that training has seen"
        )
    return known_splits[0][1] if known_splits else recipe.split


def _checkpoints(methods: Mapping[str, AnyEstimator]) -> dict[str, tuple[Checkpoint, ...]]:
    """Return the checkpoints of the estimators that have any."""
    return {name: getattr(one, "checkpoints") for name, one in methods.items() if hasattr(one, "checkpoints")}  # noqa: B009


def _methods(estimators: str | Sequence[EstimatorLike] | Mapping[str, EstimatorLike]) -> dict[str, AnyEstimator]:
    """Create the estimators by row name: strings name themselves, other estimators are named by their classes."""
    if isinstance(estimators, Mapping):
        return {name: create_estimator(one) for name, one in estimators.items()}
    if isinstance(estimators, str):
        estimators = [text for text in dict.fromkeys(estimators.split(",")) if text]
    methods: dict[str, AnyEstimator] = {}
    for one in estimators:
        name = _name_of(one)
        if name in methods:
            raise MitsonarError(f"two estimators are named {name}: give a dictionary, with a name for each")
        methods[name] = create_estimator(one)
    return methods


def _name_of(estimator: EstimatorLike) -> str:
    """Return the row name of an estimator: a string as it is, the class of anything else, wrapped or not."""
    if isinstance(estimator, OwnEstimator):
        return estimator.path
    if isinstance(estimator, str | os.PathLike):
        return os.fspath(estimator)
    return (estimator if isinstance(estimator, type) else type(estimator)).__name__


def _settings(bench: Bench, options: ComparisonOptions) -> PlainTable:
    """Return the settings that determine the estimates; levels of noise may be added later."""
    chosen_of, recipe = bench.first.chosen, bench.first.recipe
    recipe_text = json.dumps(recipe.model_dump(), default=str)
    networks = {name: method.digest for name, method in bench.methods.items() if method.digest}
    return {
        "digest": digest(chosen_of.motion.tobytes(), chosen_of.pose.tobytes(), recipe_text),
        "methods": list(bench.methods),
        "part": options.part,
        "split": bench.first.split.model_dump(),
        "pairs": len(bench.numbers),
        "seed": options.seed,
        **({"networks": networks} if networks else {}),
        "estimators": {name: _described(method) for name, method in bench.methods.items()},
    }


def _described(method: AnyEstimator) -> PlainTable:
    """Return the class and the options of an estimator: in a dictionary, its name may stand for any."""
    options: PlainTable = asdict(method) if is_dataclass(method) else {}
    return plain_json({"class": type(method).__name__, **{k: v for k, v in options.items() if k != "digest"}})


def _variations(options: ComparisonOptions) -> list[str]:
    changed = [name for name in VARIATIONS if name not in ("as given", "jitter")] if options.perturb else []
    return ["as given", *changed, *(["jitter"] if options.jitter else [])]


def _key(level: str, model: NoiseModel | None) -> str:
    """Return a name for a level of noise that includes its content, since a file may change; a ratio needs none."""
    return level if model is None else f"{level} {digest(model.model_dump_json())[:8]}"


# ---------------- Bounds and tables of errors


def _bounds(bench: Bench, level: str, limit: int, answer_store: AnswerFolder, begin: Begin) -> dict[str, Array]:
    """Return the bound by law over some pairs; empty if not requested, and for responses and recorded frames."""
    model, samples = bench.levels[level], bench.samples[level]
    if not limit or model is None or isinstance(samples, ImpulseSamples) or samples.recipe.recorded is not None:
        return {}
    bounds = answer_store.load_bounds(_key(level, model), limit)
    if bounds is None:
        sampled = np.linspace(0, len(bench.numbers) - 1, min(limit, len(bench.numbers))).astype(int)
        with begin("limit", len(sampled)) as progress:
            bounds = bounds_of_pairs(samples, [bench.numbers[k] for k in sampled], model, progress)
        answer_store.keep_bounds(_key(level, model), limit, bounds)
    return bounds


def _table(
    bench: Bench,
    options: ComparisonOptions,
    level: str,
    variation: str,
    answers: dict[str, Answers],
    bounds: dict[str, Array],
) -> PlainTable:
    """Return the errors of all methods as a JSON object."""
    by_row = dict(answers)
    if options.prior:
        flight = bench.first.recipe.flight
        largest_motion = np.array([flight.sideways_mm / 1e3, flight.forward_mm / 1e3, np.radians(flight.yaw_deg)])
        known = {name: one for name, one in by_row.items() if np.isfinite(one.covariance).any()}
        by_row |= {f"{name}{PRIOR}": with_prior(one, largest_motion) for name, one in known.items()}
    inputs = {name: bench.methods[name.removesuffix(PRIOR)].inputs for name in by_row}
    inputs = {name: f"{text}, prior" if name.endswith(PRIOR) else text for name, text in inputs.items()}
    reference = options.reference or list(bench.methods)[-1]
    resamples = cluster_resamples(bench.scenes, seed=options.seed)
    law = list(bounds)[-1] if bounds else "rays"
    rows = rows_of(by_row, inputs, bench.truth, resamples, limit=bounds.get(law), reference=reference)
    return {
        "noise": level,
        "variation": variation,
        "limits": {law: _finite(in_units(std)) for law, std in bounds.items()},
        "limit_law": law,
        "reference": reference,
        "rows": [{**row.plain(), "learnt": bench.learnt.get(row.method.removesuffix(PRIOR), 0)} for row in rows],
    }


PRIOR = " with prior"


def _finite(values: Array) -> list[float | None]:
    """Return numbers for JSON: None where not finite."""
    return [float(value) if np.isfinite(value) else None for value in values]


# ---------------- Estimates on disk


COMPARISON = RunKind(
    "comparison",
    outputs=("answers-*.npz", "limit-*.json", "table.md", "table.json"),
    notes={},
    packages=("mitsonar", "numpy", "opencv-python-headless", "torch"),
    deciding=("mitsonar",),
    replaced=False,
)


class AnswerFolder:
    """The store of a comparison without a folder: it stores nothing."""

    def load(self, level: str, variation: str, methods: Mapping[str, AnyEstimator], count: int) -> dict[str, Answers] | None:
        """Return the estimates of an earlier run of ``count`` pairs; None if there are none."""
        return None

    def keep(self, level: str, variation: str, answers: dict[str, Answers]) -> None:
        """Store all estimates made so far."""

    def load_bounds(self, level: str, count: int) -> dict[str, Array] | None:
        """Return the bounds of an earlier run; None if there are none."""
        return None

    def keep_bounds(self, level: str, count: int, bounds: dict[str, Array]) -> None:
        """Store bounds."""

    def finish(self, report: PlainTable) -> None:
        """Write the tables."""


class AnswersOnDisk(AnswerFolder):
    """A folder of estimates, written as they are made, so that an interrupted comparison resumes.

    Args:
        run: the folder.
    """

    def __init__(self, run: RunDirectory) -> None:
        self.run = run

    def _path(self, name: str, ending: str) -> Path:
        return self.run.path / (re.sub(r"[^\w.-]+", "-", name.replace("%", "percent")) + ending)

    def load(self, level: str, variation: str, methods: Mapping[str, AnyEstimator], count: int) -> dict[str, Answers] | None:
        """Return the estimates of an earlier run of ``count`` pairs; None if there are none.

        Raises:
            MitsonarError: the file is damaged.
        """
        path = self._path(f"answers {level} {variation}", ".npz")
        if not path.exists():
            return None
        try:
            table = read_npz(path)
            answers = {name: Answers.from_arrays(table, name) for name in methods}
            if any(len(values) != count for one in answers.values() for values in vars(one).values()):
                raise ValueError("it holds another number of pairs")
            return answers
        except Exception as error:  # a damaged zip may raise any exception
            raise MitsonarError(f"{path} is damaged ({error}): remove it, and it is computed again") from None

    def keep(self, level: str, variation: str, answers: dict[str, Answers]) -> None:
        """Store all estimates made so far."""
        buffer = io.BytesIO()
        arrays: dict[str, NDArray[np.generic]] = {}
        for name, one in answers.items():
            arrays |= one.arrays(name)
        np.savez(buffer, **arrays)  # type: ignore[arg-type]
        write_atomic(self._path(f"answers {level} {variation}", ".npz"), buffer.getvalue())

    def load_bounds(self, level: str, count: int) -> dict[str, Array] | None:
        """Return the bounds of an earlier run; None if there are none.

        Raises:
            MitsonarError: the file is damaged.
        """
        path = self._path(f"limit {level} {count}", ".json")
        if not path.exists():
            return None
        stored = read_json(path)
        try:
            bounds = {law: np.array(std, dtype=float) for law, std in stored.items()}
            if not bounds or any(std.shape != (3,) for std in bounds.values()):
                raise ValueError("a bound is three numbers")
        except (AttributeError, ValueError, TypeError) as error:
            raise MitsonarError(f"{path} is damaged ({error}): remove it, and it is computed again") from None
        return bounds

    def keep_bounds(self, level: str, count: int, bounds: dict[str, Array]) -> None:
        """Store bounds."""
        write_json(self._path(f"limit {level} {count}", ".json"), {law: std.tolist() for law, std in bounds.items()})

    def finish(self, report: PlainTable) -> None:
        """Write the tables."""
        lines = [line for table in report["tables"] for line in table_lines(table)]
        write_atomic(self.run.path / "table.md", ("\n".join(lines) + "\n").encode())
        write_json(self.run.path / "table.json", report)
        self.run.finish()


def kept_answers(out: str | Path | None, settings: PlainTable) -> AnswerFolder:
    """Open the store of a comparison: a folder, new or resumed, or none.

    Raises:
        MitsonarError: the folder holds something else, or another comparison.
    """
    if out is None:
        return AnswerFolder()
    run = RunDirectory.begin(out, COMPARISON, settings, resume=True)
    run.start()
    return AnswersOnDisk(run)
