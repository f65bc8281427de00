"""How well a trained network does on a data set: the thesis's columns, and those that keep them honest."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import default_collate

from mitsonar.config.data_recipe import Recipe, Split
from mitsonar.datasets.modalities import modality_of
from mitsonar.datasets.response_pairs import ImpulsePairs
from mitsonar.datasets.sample_index import split_for
from mitsonar.datasets.store import DataStore
from mitsonar.datasets.torch_pairs import SonarPairs
from mitsonar.errors import MitsonarError
from mitsonar.estimation.benchmark import Answers, chosen, rows_of
from mitsonar.estimation.learned.trained_network import (
    ANGLE_OFF_DEG,
    HEIGHT_OFF,
    TrainedInstrument,
    answer_of,
    inputs_of,
    one_thread,
)
from mitsonar.instruments.channel_sonar import ChannelSonar
from mitsonar.motion.motion_errors import AXES, cluster_resamples
from mitsonar.networks.checkpoint import Checkpoint

__all__ = ["NOISES", "evaluate", "predictions"]

Array = NDArray[np.float64]

NOISES = ("none", "low", "high")

SAME_INSTRUMENT = ("name", "model", "seed", "rays", "points_per_m2")
"""Keys of a channel sonar in which two may differ and yet be one instrument."""

TIMED = 20
"""Pairs over which the time of one is taken."""


def predictions(
    checkpoint: Checkpoint,
    pairs: SonarPairs | ImpulsePairs,
    batch: int = 16,
    *,
    numbers: Sequence[int] | None = None,
    device: torch.device | str | None = None,
    progress: Callable[[int], object] = lambda pairs: None,
) -> tuple[Array, Array | None]:
    """What a network says of samples.

    Args:
        checkpoint: of the network.
        pairs: arranged as it was trained; see :func:`samples_for`.
        batch: samples at a time.
        numbers: of the samples; default: all.
        device: where it computes; default: a GPU where there is one.
        progress: called with how many were done.

    Returns:
        Targets ``(n, 3)`` [m, m, rad], ``(n, 2)`` [m] without yaw, or ``(n, 1)`` [m] of heights; covariances
        ``(n, 3, 3)``, if the network says them.
    """
    place = _device(device)
    network = checkpoint.build().to(place)
    wanted = range(len(pairs)) if numbers is None else numbers
    found = []
    with torch.inference_mode():
        for start in range(0, len(wanted), batch):
            raw = default_collate([pairs.raw(number) for number in wanted[start : start + batch]])
            found.append(checkpoint.decode(answer_of(network, pairs.finished(raw, place)[0])))
            progress(len(found[-1][0]))
    targets = np.concatenate([answer for answer, _ in found])
    covariances = [law for _, law in found if law is not None]
    return targets, np.concatenate(covariances) if covariances else None


def evaluate(
    checkpoint: Checkpoint,
    data: str | Path,
    *,
    noise: Sequence[str] | None = None,
    part: str | None = None,
    split: str | Split | dict[str, Any] | None = None,
    pairs: int | None = None,
    force: bool = False,
    seed: int = 0,
    batch: int = 16,
    device: torch.device | str | None = None,
    begin: Callable[[int], Callable[[int], object]] = lambda total: lambda done: None,
) -> dict[str, Any]:
    """Errors of a network on one sample of each sequence of a part of a data set, beside always answering nothing.

    Args:
        checkpoint: of the network.
        data: path or URL of the data set.
        noise: levels, each a table; default: :data:`NOISES`, or none for impulse responses.
        part: ``train``, ``validation``, ``test`` or ``all``; default: ``test`` where the split has one, else ``validation``.
        split: default: that of the training, else of the data set.
        pairs: at most so many, drawn at random.
        force: go on with another sonar than that of training.
        seed: of noise, choice of samples, and bootstrap.
        batch: samples at a time.
        device: where it computes; default: a GPU where there is one. Times are of one CPU core anyway.
        begin: called with how many answers will be made; gives what is called with how many more were made.

    Returns:
        Numbers and texts: what was asked for; ``notes``, sentences that the reader of the tables needs; ``tables``, one a
        level, each with ``rows``: for the network and ``zero`` what :class:`~mitsonar.estimation.benchmark.BenchmarkRow`
        holds, in
        mm, mm, deg (heights: mm), with ``thesis``, the RMSE in mm, mm, 1/100 deg; and ``beyond``: shares of true motions and
        of answers beyond those of training.

    Raises:
        MitsonarError: another sonar than that of training, views or arrays that the data set lacks, no samples.
    """
    recipe = DataStore.open(data).recipe
    others = _other_sonars(checkpoint, recipe)
    if others and not force:
        raise MitsonarError(f"{'; '.join(others)}: evaluate on that sonar, or force it with --force")
    split = checkpoint.recipe.get("split") if split is None else split
    usual = NOISES[:1] if checkpoint.channel is not None else NOISES
    levels = list(dict.fromkeys(usual if noise is None else noise))
    samples = {level: samples_for(checkpoint, data, part=part, split=split, noise=level, seed=seed) for level in levels}
    first = samples[levels[0]]
    numbers = chosen(len(first), pairs, seed)
    truth = np.array([first.target(number) for number in numbers])
    scenes = first.scene[first.first[numbers]]
    resamples = cluster_resamples(scenes, seed=seed)
    quiet = samples_for(checkpoint, data, part=part, split=split, seed=seed)
    ms = _milliseconds(checkpoint, quiet, numbers[:TIMED])
    progress, tables = begin(len(levels) * len(numbers)), []
    for level in levels:
        said = predictions(checkpoint, samples[level], batch, numbers=numbers, device=device, progress=progress)
        tables.append({"noise": level, "variation": "as told", **_table(checkpoint, truth, resamples, ms, *said)})
    return {
        "network": checkpoint.network,
        "digest": checkpoint.digest,
        "trained": {"data": checkpoint.data, "model": checkpoint.model, "noise": checkpoint.noise, **checkpoint.trained},
        "data": str(data),
        "recipe": recipe.name,
        "model": modality_of(recipe).sonar.model,
        "part": part or first.split.unseen,
        "split": first.split.by,
        "pairs": len(numbers),
        "scenes": len(np.unique(scenes)),
        "names": list(checkpoint.labels["names"]),
        "seed": seed,
        "notes": [*others, *_notes(checkpoint, recipe, part)],
        "tables": tables,
    }


def samples_for(
    checkpoint: Checkpoint,
    data: str | Path,
    *,
    part: str | None = None,
    split: str | Split | dict[str, Any] | None = None,
    noise: str = "none",
    seed: int = 0,
) -> SonarPairs | ImpulsePairs:
    """One sample of each sequence of a data set, arranged for a network.

    Raises:
        MitsonarError: a data set that lacks what the network is given, or without samples in that part.
    """
    words = {"noise": noise, "labels": checkpoint.labels["kind"], "seed": seed, "one_a_sequence": True}
    if part is None:
        part = split_for(split, DataStore.open(data).recipe).unseen
    if checkpoint.channel is not None:
        return ImpulsePairs(data, part=part, split=split, frames=checkpoint.arrangement["frames"], **words)
    return SonarPairs(data, part=part, split=split, **checkpoint.arrangement, **words)


def _device(device: torch.device | str | None) -> torch.device:
    return torch.device(device if device is not None else "cuda" if torch.cuda.is_available() else "cpu")


def _milliseconds(checkpoint: Checkpoint, pairs: SonarPairs | ImpulsePairs, numbers: Sequence[int]) -> float:
    """Median processor time of one sample on one core, from frames (and their geometry) to the answer."""
    network = checkpoint.build()
    spent = []
    with torch.inference_mode(), one_thread():
        for number in [numbers[0], *numbers]:
            raw = default_collate([pairs.raw(number)])
            begun = time.process_time()
            answer_of(network, pairs.finished(raw)[0])
            spent.append(1e3 * (time.process_time() - begun))
    return float(np.median(spent[1:]))  # the first one prepares


# ---------------------------------------------------------------- tables


def _table(
    checkpoint: Checkpoint, truth: Array, resamples: NDArray[np.int64], ms: float, said: Array, law: Array | None
) -> dict[str, Any]:
    """Rows of the network and of always answering nothing."""
    inputs, beyond = {checkpoint.network: inputs_of(checkpoint), "zero": "nothing"}, _beyond(checkpoint, truth, said)
    if truth.shape[1] >= 2:
        truth, said, axes = _with_yaw(truth), _with_yaw(said), truth.shape[1]
        nan, sure = np.full((len(truth), 3, 3), np.nan), np.ones(len(truth), dtype=bool)
        answers = {
            checkpoint.network: Answers(said, sure, nan if law is None else law, np.full(len(truth), ms)),
            "zero": Answers(np.zeros_like(truth), sure, nan, np.zeros(len(truth))),
        }
        rows = [_of_axes(row.plain(), axes) for row in rows_of(answers, inputs, truth, resamples, reference="zero")]
        scale = np.array([1, 1, 100])[:axes]
    else:
        middle = np.full_like(truth, checkpoint.coder.low.mean() / 2 + checkpoint.coder.high.mean() / 2)
        found = {checkpoint.network: said, "zero": middle}
        times = {checkpoint.network: ms, "zero": 0.0}
        rows = [
            {"method": name, "inputs": inputs[name], "ms": times[name], **_height_errors(values, truth, middle, resamples)}
            for name, values in found.items()
        ]
        scale = np.ones(1)
    for row in rows:
        row["thesis"] = [value * factor for value, factor in zip(row["rmse"], scale.tolist(), strict=True)]
    return {"limits": {}, "reference": "zero", "rows": rows, "beyond": beyond}


def _with_yaw(motion: Array) -> Array:
    """Motions ``(n, 3)`` of those with or without yaw, which is then 0."""
    return np.hstack([motion, np.zeros((len(motion), len(AXES) - motion.shape[1]))])


def _of_axes(row: dict[str, Any], axes: int) -> dict[str, Any]:
    """A row with the numbers of its first axes."""
    return {name: value[:axes] if isinstance(value, list) else value for name, value in row.items()}


def _height_errors(heights: Array, truth: Array, middle: Array, resamples: NDArray[np.int64]) -> dict[str, Any]:
    """What :class:`~mitsonar.motion.motion_errors.MotionErrors` says of motions, of heights ``(n, 1)`` [m], in mm; zero
    stands for always
    answering the middle of the heights of training, and slopes are over the differences from it."""
    error, side = 1e3 * (heights - truth), 1e3 * (truth - middle)
    rmse, zero = (float(np.sqrt((values**2).mean())) for values in (error, side))
    low, high = np.percentile(np.sqrt((error[resamples, 0] ** 2).mean(axis=1)), [2.5, 97.5])
    far = np.abs(side) > 0.5 * np.abs(side).max()
    power = float((side**2).sum())
    slope = float(((1e3 * (heights - middle)) * side).sum()) / power if power else None
    return {
        "pairs": len(truth),
        "failures": 0,
        "rmse": [rmse],
        "rmse_low": [float(low)],
        "rmse_high": [float(high)],
        "median": [float(np.median(np.abs(error)))],
        "p95": [float(np.percentile(np.abs(error), 95))],
        "bias": [float(error.mean())],
        "slope": [slope],
        "large": [float(np.sqrt((error[far] ** 2).mean())) if far.any() else None],
        "zero": [zero],
        "skill": [1 - rmse / zero if zero else None],
        "nees": None,
    }


def _beyond(checkpoint: Checkpoint, truth: Array, said: Array) -> dict[str, float]:
    """Shares of samples whose truth, and whose answer, lies beyond the targets of training on any axis."""
    low, high = checkpoint.coder.low - 1e-9, checkpoint.coder.high + 1e-9
    return {
        name: float(((values < low) | (values > high)).any(axis=1).mean())
        for name, values in (("true", truth), ("answers", said))
    }


# ---------------------------------------------------------------- what is other than in training


def _other_sonars(checkpoint: Checkpoint, recipe: Recipe) -> list[str]:
    """Sentences on the sonars of a data set that are not those of training."""
    if checkpoint.channel is not None:
        return _other_channel(checkpoint.channel, recipe.channel_sonar, recipe.name)
    found = []
    for view in recipe.views:
        trained = checkpoint.sonars.get(view.name)
        if trained is None:
            continue
        unlike = TrainedInstrument.of(trained).unlike(TrainedInstrument.of(view.sonar))
        if unlike:
            found.append(
                f"the {checkpoint.network} was trained on the sonar {trained.name}, the data set {recipe.name} is of "
                f"{view.sonar.name}: {unlike}"
            )
    return list(dict.fromkeys(found))


def _other_channel(trained: ChannelSonar, other: ChannelSonar, name: str) -> list[str]:
    """A sentence on keys that differ and change responses."""
    mine, its = trained.model_dump(mode="json"), other.model_dump(mode="json")
    changed = [key for key in mine if mine[key] != its[key] and key not in SAME_INSTRUMENT]
    return [f"trained with another channel sonar than that of {name}: {', '.join(changed)} differ"] if changed else []


def _notes(checkpoint: Checkpoint, recipe: Recipe, part: str | None) -> list[str]:
    """Sentences on what else differs, and on pairs that training has seen."""
    found = []
    same = checkpoint.data_recipe == recipe.model_dump(mode="json")
    if same and part in ("train", "all"):
        found.append(f"part {part} of this data set holds pairs that training has seen")
    model = modality_of(recipe).sonar.model
    if model != checkpoint.model:
        found.append(f"trained on the {checkpoint.model} model, evaluated on the {model} model")
    if not checkpoint.arrangement["ground"]:
        low, high = (height + recipe.mount.up_m for height in recipe.flight.heights)
        trained = checkpoint.trained_at
        heights = low < trained["height_m"][0] * (1 - HEIGHT_OFF) or high > trained["height_m"][1] * (1 + HEIGHT_OFF)
        angles = [abs(getattr(recipe.mount, key) - trained[key]) > ANGLE_OFF_DEG for key in ("pitch_deg", "roll_deg")]
        if heights or any(angles):
            found.append(
                f"{checkpoint.fixed} are fixed by training; here the sonar stands at {low:g}..{high:g} m, pitch "
                f"{recipe.mount.pitch_deg:g} deg, roll {recipe.mount.roll_deg:g} deg"
            )
    return found
