"""A comparison: many estimators on the same pairs of a data set, with their errors side by side."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.config.data import Recipe, Split
from mitsonar.datasets.modality import samples_of
from mitsonar.datasets.plan import modality_of
from mitsonar.datasets.responses import ImpulseSamples
from mitsonar.datasets.samples import split_for
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError, argument, counted, meant
from mitsonar.estimation.benchmark import (
    VARIATIONS,
    Answers,
    Samples,
    answers_of,
    bounds_of_pairs,
    chosen,
    rows_of,
    with_prior,
)
from mitsonar.estimation.benchmark_tables import FEWEST_SCENES, Comparison
from mitsonar.estimation.estimator import AnyEstimator, PlainTable
from mitsonar.estimation.external.own_estimator import OwnEstimator
from mitsonar.estimation.kept_answers import AnswerFolder, kept_answers
from mitsonar.estimation.named_estimators import EstimatorLike, create_estimator
from mitsonar.io.runs import digest, versions
from mitsonar.motion.composition import motions
from mitsonar.motion.errors import cluster_resamples, in_units

if TYPE_CHECKING:
    from mitsonar.networks.checkpoint import Checkpoint

__all__ = ["Estimators", "compare"]

Array = NDArray[np.float64]
Begin = Callable[[str, int], AbstractContextManager[Callable[[int], object]]]
"""Called with what begins and how many pairs it has; while it is open, its value is called with how many more are done."""


Estimators: TypeAlias = str | Sequence[EstimatorLike] | Mapping[str, EstimatorLike] | None
"""Estimators of a comparison: a text with commas, a list, or by the names of their rows."""


class _Asked(NamedTuple):
    """What is compared, beside data and estimators; see :func:`compare`."""

    noise: str
    part: str | None
    split: str | None
    pairs: int | None
    perturb: bool
    jitter: bool
    prior: bool
    limit: int
    reference: str | None
    seed: int


@dataclass(frozen=True)
class Bench:
    """The estimators, and the pairs that all of them estimate.

    Attributes:
        methods: by name.
        levels: noise models by name; None where the name is a ratio of signal to noise.
        samples: by level of noise, the same pairs in each.
        numbers: of the samples that are estimated.
        truth: motions of the sonar ``(n, 3)`` [m, m, rad].
        scenes: number of each pair's scene ``(n,)``.
        learnt: by network, the number of pairs that its training has seen.
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
    *,
    noise: str = "none",
    part: str | None = None,
    split: str | None = None,
    pairs: int | None = None,
    perturb: bool = False,
    jitter: bool = False,
    prior: bool = False,
    limit: int = 10,
    reference: str | None = None,
    seed: int = 0,
    out: str | Path | None = None,
    begin: Begin = lambda what, pairs: nullcontext(lambda done: None),
) -> Comparison:
    """Run all estimators on the same pairs and report their errors; invalid estimates count as zero motion.

    Args:
        data: path or URL of a data set.
        estimators: what :func:`~mitsonar.estimation.named_estimators.create_estimator` takes: one text with commas between
            them, a list, or a dictionary by the names of the rows; default: all that need no training.
        noise: levels, commas between them, or ``;``.
        part: of the data set; default: the one that training does not use.
        split: ``sequence``, ``scene`` or ``sample``; default: that with which networks among the estimators were trained on
            this data set, else the data set's own.
        pairs: at most so many; default: all.
        perturb: add rows in which estimators get wrong inputs.
        jitter: add a row with jittered rays.
        prior: add rows with the prior of the size of motions.
        limit: pairs over which the Cramer-Rao lower bound is computed; 0: none.
        reference: the method that others are compared with; default: the last.
        seed: of noise, choice of pairs and bootstrap.
        out: folder for estimates, ``table.md`` and ``table.json``; an interrupted comparison in it resumes.
        begin: called with each stage, for progress.

    Returns:
        The errors of each method at each level of noise and variation: print it, or read its ``rows``.

    Raises:
        MitsonarError: unknown names, too few pairs, or another comparison in the folder.
    """
    asked = _Asked(noise, part, split, pairs, perturb, jitter, prior, limit, reference, seed)
    data = str(data)
    bench = _bench(data, estimators, asked)
    settings = _settings(bench, asked)
    kept = kept_answers(out, settings)
    variations = _variations(asked)
    with begin("comparing", len(bench.levels) * len(variations) * len(bench.numbers)) as progress:
        answers = {
            (level, variation): answers_of(
                bench.methods,
                bench.samples[level],
                bench.numbers,
                variation,
                known=kept.load(_key(level, model), variation, bench.methods, len(bench.numbers)),
                keep=partial(kept.keep, _key(level, model), variation),
                progress=progress,
            )
            for level, model in bench.levels.items()
            for variation in variations
        }
    tables = []
    for level in bench.levels:
        bounds = _bounds(bench, level, asked.limit, kept, begin)
        tables += [_table(bench, asked, level, variation, answers[level, variation], bounds) for variation in variations]
    scenes = len(np.unique(bench.scenes))
    notes = [f"{counted(scenes, 'scene')} only: the 95 % intervals are too narrow; compare on {FEWEST_SCENES} or more"]
    notes = notes if scenes < FEWEST_SCENES else []
    notes += [
        f"{name} was trained on {count} of the {counted(len(bench.numbers), 'pair')}, whose errors are too small; "
        f"give {argument('part')} {bench.first.split.unseen}, or other data"
        for name, count in bench.learnt.items()
        if count
    ]
    report = {"data": data, "model": modality_of(bench.first.recipe).sonar.model, **settings, "scenes": scenes}
    report |= {"notes": notes, "tables": tables, **versions(("mitsonar",))}
    kept.finish(report)
    return Comparison(report)


# ---------------------------------------------------------------- what is asked


def _bench(data: str, estimators: Estimators, asked: _Asked) -> Bench:
    """Open the samples and create the estimators.

    Raises:
        MitsonarError: unknown names, options that are not for these data, too few pairs.
    """
    recipe = DataStore.open(data).recipe
    modality = modality_of(recipe)
    methods = _methods(modality.estimators if estimators is None else estimators)
    if not methods or (asked.reference is not None and asked.reference not in methods):
        raise MitsonarError(
            f"{argument('reference')} must be one of {', '.join(methods) or 'the estimators'}: got {asked.reference!r}"
            f"{meant(asked.reference, methods)}"
        )
    perturb, jitter, prior = (argument(name) for name in ("perturb", "jitter", "prior"))
    if not modality.variations and (asked.perturb or asked.jitter or asked.prior):
        raise MitsonarError(f"{perturb}, {jitter} and {prior} are for data sets of images: leave them out")
    if recipe.recorded is not None and (asked.perturb or asked.jitter):
        raise MitsonarError(f"{perturb} and {jitter} render anew, and recorded frames have no world: leave them out")
    words = list(dict.fromkeys(asked.noise.split(";" if ";" in asked.noise else ",")))
    levels = {word: modality.noise_model(word) for word in words}
    split = _split(asked.split, methods, recipe)
    options = {
        **{"part": asked.part or split.unseen, "split": split},
        **{"one_a_sequence": recipe.recorded is None, "seed": asked.seed},
    }
    samples = {level: samples_of(modality, data, noise=level, **options) for level in levels}
    first = next(iter(samples.values()))
    if len(first) < 2:
        raise MitsonarError(f"a comparison needs two pairs or more: give {argument('part')} all, or a larger data set")
    if asked.jitter and first.recipe.instrument.jittered:
        raise MitsonarError(f"the rays of this data set move already: {jitter} is for Almanza-Medina's model")
    numbers = chosen(len(first), asked.pairs, asked.seed)
    # of the sonar: the labels of a data set are the vehicle's motions, and a mount may turn or offset them
    pose = first.chosen.pose
    truth = np.array([motions(pose[first.frame_numbers(number)][[0, -1]])[0] for number in numbers])
    learnt = {
        name: int(np.any([one.learnt(first)[numbers] for one in of], axis=0).sum())
        for name, of in _checkpoints(methods).items()
    }
    return Bench(methods, levels, samples, numbers, truth, first.scene[first.first[numbers]], learnt)


def _split(asked: str | None, methods: Mapping[str, AnyEstimator], recipe: Recipe) -> Split:
    """Return the split that is asked for, or that of the networks which were trained on this data set, or the data set's.

    Raises:
        MitsonarError: an unknown split, or networks of different ones.
    """
    if asked is not None:
        return split_for(asked, recipe)
    known = [(name, one.split_of_training(recipe)) for name, of in _checkpoints(methods).items() for one in of]
    theirs = [(name, split) for name, split in known if split is not None]
    if len({split.model_dump_json() for _, split in theirs}) > 1:
        splits = ", ".join(f"{name} by {split.by}" for name, split in theirs)
        raise MitsonarError(
            f"the networks were trained on other parts of this data set: {splits}; choose {argument('split')}, which marks "
            "rows with pairs that training has seen"
        )
    return theirs[0][1] if theirs else recipe.split


def _checkpoints(methods: Mapping[str, AnyEstimator]) -> dict[str, tuple[Checkpoint, ...]]:
    """Return the checkpoints of those estimators that have some."""
    return {name: getattr(one, "checkpoints") for name, one in methods.items() if hasattr(one, "checkpoints")}  # noqa: B009


def _methods(estimators: str | Sequence[EstimatorLike] | Mapping[str, EstimatorLike]) -> dict[str, AnyEstimator]:
    """Create the estimators by the names of their rows: texts as they are, others by their classes."""
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
    """Return the name of a row: a text as it is, the class of anything else, be it wrapped or not."""
    if isinstance(estimator, OwnEstimator):
        return estimator.path
    if isinstance(estimator, str | os.PathLike):
        return os.fspath(estimator)
    return (estimator if isinstance(estimator, type) else type(estimator)).__name__


def _settings(bench: Bench, asked: _Asked) -> PlainTable:
    """Return what decides the estimates; levels of noise may be added later."""
    chosen_of, recipe = bench.first.chosen, bench.first.recipe
    recipe_text = json.dumps(recipe.model_dump(), default=str)
    networks = {name: method.digest for name, method in bench.methods.items() if method.digest}
    return {
        "digest": digest(chosen_of.motion.tobytes(), chosen_of.pose.tobytes(), recipe_text),
        "methods": list(bench.methods),
        "part": asked.part,
        "split": bench.first.split.model_dump(),
        "pairs": len(bench.numbers),
        "seed": asked.seed,
        **({"networks": networks} if networks else {}),
    }


def _variations(asked: _Asked) -> list[str]:
    changed = [name for name in VARIATIONS if name not in ("as told", "jitter")] if asked.perturb else []
    return ["as told", *changed, *(["jitter"] if asked.jitter else [])]


def _key(level: str, model: NoiseModel | None) -> str:
    """Name a level of noise by its content: a file of the same name may change. A ratio needs no more."""
    return level if model is None else f"{level} {digest(model.model_dump_json())[:8]}"


# ---------------------------------------------------------------- what is found


def _bounds(bench: Bench, level: str, limit: int, kept: AnswerFolder, begin: Begin) -> dict[str, Array]:
    """Return the bound by model of the noise, over some pairs; empty if not asked for, for responses and recorded frames."""
    model, samples = bench.levels[level], bench.samples[level]
    if not limit or model is None or isinstance(samples, ImpulseSamples) or samples.recipe.recorded is not None:
        return {}
    found = kept.load_bounds(_key(level, model), limit)
    if found is None:
        places = np.linspace(0, len(bench.numbers) - 1, min(limit, len(bench.numbers))).astype(int)
        with begin("limit", len(places)) as progress:
            found = bounds_of_pairs(samples, [bench.numbers[k] for k in places], model, progress)
        kept.keep_bounds(_key(level, model), limit, found)
    return found


def _table(
    bench: Bench, asked: _Asked, level: str, variation: str, answers: dict[str, Answers], bounds: dict[str, Array]
) -> PlainTable:
    """Return the errors of all methods, as JSON can hold them."""
    found = dict(answers)
    if asked.prior:
        flight = bench.first.recipe.flight
        largest = np.array([flight.sideways_mm / 1e3, flight.forward_mm / 1e3, np.radians(flight.yaw_deg)])
        known = {name: one for name, one in found.items() if np.isfinite(one.covariance).any()}
        found |= {f"{name}{PRIOR}": with_prior(one, largest) for name, one in known.items()}
    inputs = {name: bench.methods[name.removesuffix(PRIOR)].inputs for name in found}
    inputs = {name: f"{text}, prior" if name.endswith(PRIOR) else text for name, text in inputs.items()}
    reference = asked.reference or list(bench.methods)[-1]
    resamples = cluster_resamples(bench.scenes, seed=asked.seed)
    law = list(bounds)[-1] if bounds else "rays"
    rows = rows_of(found, inputs, bench.truth, resamples, limit=bounds.get(law), reference=reference)
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
