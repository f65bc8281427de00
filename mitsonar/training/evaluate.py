"""Evaluate a trained network on a data set, with a baseline and confidence intervals."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import default_collate

from mitsonar.config.data import Recipe, Split
from mitsonar.datasets.plan import modality_of
from mitsonar.datasets.sample_index import split_for
from mitsonar.datasets.samples import ImpulsePairs, SonarPairs
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError, count_noun
from mitsonar.estimation.compare import Answers, chosen, markdown, rows_of
from mitsonar.estimation.learned import ANGLE_OFF_DEG, HEIGHT_OFF, TrainedInstrument, answer_of, inputs_of, one_thread
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.io.files import write_atomic, write_json
from mitsonar.io.runs import refuse_to_replace
from mitsonar.motion.errors import AXES, cluster_resamples
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.training.data import Array, JsonObject

__all__ = ["NOISES", "check_no_tables", "evaluate", "predictions", "report_lines", "save_tables"]


NOISES = ("none", "low", "high")
"""Default noise levels."""

SAME_INSTRUMENT = ("name", "model", "seed", "rays", "points_per_m2", "scatterer_spacing_m")
"""Keys in which two channel sonars may differ and still count as the same instrument."""

TIMED_PAIRS = 20
"""Number of pairs over which the time of one estimate is measured."""


def predictions(
    checkpoint: Checkpoint,
    pairs: SonarPairs | ImpulsePairs,
    batch: int = 16,
    *,
    numbers: Sequence[int] | None = None,
    device: torch.device | str | None = None,
    progress: Callable[[int], object] = lambda pairs: None,
) -> tuple[Array, Array | None]:
    """Estimate the targets of samples with a network.

    Args:
        checkpoint: checkpoint of the network.
        pairs: samples, arranged as in training; see :func:`samples_for`.
        batch: number of samples per batch.
        numbers: indices of the samples; default: all samples.
        device: device of the computation; default: a GPU, if available.
        progress: called after each batch with its number of samples.

    Returns:
        Estimated targets ``(n, 3)`` [m, m, rad], ``(n, 2)`` [m] without yaw, or ``(n, 1)`` [m] for heights; and covariances
        ``(n, 3, 3)``, or None if the network does not estimate them.
    """
    torch_device = _device(device)
    network = checkpoint.build().to(torch_device)
    indices = range(len(pairs)) if numbers is None else numbers
    decoded = []
    with torch.inference_mode():
        for start in range(0, len(indices), batch):
            raw = default_collate([pairs.raw(index) for index in indices[start : start + batch]])
            decoded.append(checkpoint.decode(answer_of(network, pairs.finished(raw, torch_device)[0])))
            progress(len(decoded[-1][0]))
    targets = np.concatenate([targets for targets, _ in decoded])
    covariances = [covariance for _, covariance in decoded if covariance is not None]
    return targets, np.concatenate(covariances) if covariances else None


def evaluate(
    checkpoint: Checkpoint,
    data: str | Path,
    *,
    noise: Sequence[str] | None = None,
    part: str | None = None,
    split: str | Split | JsonObject | None = None,
    pairs: int | None = None,
    force: bool = False,
    seed: int = 0,
    batch: int = 16,
    device: torch.device | str | None = None,
    begin: Callable[[int], Callable[[int], object]] = lambda total: lambda done: None,
) -> JsonObject:
    """Evaluate a network on one sample of each sequence of a data set, and compare it with the constant estimate zero.

    Args:
        checkpoint: checkpoint of the network.
        data: path or URL of the data set.
        noise: noise levels, with one table each; default: :data:`NOISES`, or none for impulse responses.
        part: ``train``, ``validation``, ``test`` or ``all``; default: ``test`` if the split has one, else ``validation``.
        split: split of the data; default: that of the training, else that of the data set.
        pairs: maximum number of pairs; from a larger set, pairs are drawn at random.
        force: allow a sonar that differs from that of training.
        seed: seed for noise, choice of samples, and bootstrap.
        batch: number of samples per batch.
        device: device of the computation; default: a GPU, if available. Times are always measured on one CPU core.
        begin: called with the total number of estimates; returns a function that is called with the number of new ones.

    Returns:
        The report: facts about network and data, ``notes`` and ``tables``. ``notes`` are remarks for readers of the
        tables. ``tables`` has one table per noise level. Its rows are those of the network and of ``zero``, with the
        fields of :class:`~mitsonar.estimation.compare.BenchmarkRow` in mm, mm, deg (heights: mm), and ``thesis``, the RMSE
        in mm, mm, 1/100 deg. ``beyond`` has the fractions of true motions and of estimates outside the training range,
        ``correlations`` the correlations of the network's errors between any two axes.

    Raises:
        MitsonarError: the sonar differs from that of training, views or arrays are missing, or there are no samples.
    """
    sonar_differences = _sonar_differences(checkpoint, DataStore.open(data).recipe)
    if sonar_differences and not force:
        raise MitsonarError(f"{'; '.join(sonar_differences)}: evaluate on the sonar used in training, or use --force")
    split = checkpoint.recipe.get("split") if split is None else split
    default_levels = NOISES[:1] if checkpoint.channel is not None else NOISES
    levels = list(dict.fromkeys(default_levels if noise is None else noise))
    samples = {level: samples_for(checkpoint, data, part=part, split=split, noise=level, seed=seed) for level in levels}
    subject = _Subject.of(samples[levels[0]], pairs, seed)
    ms = _time_per_sample(
        checkpoint, samples_for(checkpoint, data, part=part, split=split, seed=seed), subject.numbers[:TIMED_PAIRS]
    )
    progress, tables = begin(len(levels) * len(subject.numbers)), []
    for level in levels:
        predicted = predictions(checkpoint, samples[level], batch, numbers=subject.numbers, device=device, progress=progress)
        tables.append({"noise": level, "variation": "as given", **_table(checkpoint, subject, ms, *predicted)})
    return _report(checkpoint, data, part, samples[levels[0]], subject, sonar_differences, tables)


@dataclass(frozen=True)
class _Subject:
    """The samples of an evaluation.

    Attributes:
        numbers: indices of the n samples.
        truth: true targets ``(n, outputs)`` [m, rad].
        scenes: number of distinct scenes.
        resamples: indices of the samples in each bootstrap resample ``(resamples, n)``.
        seed: seed for the choice of samples and the bootstrap.
    """

    numbers: list[int]
    truth: Array
    scenes: int
    resamples: NDArray[np.int64]
    seed: int

    @classmethod
    def of(cls, samples: SonarPairs | ImpulsePairs, pairs: int | None, seed: int) -> _Subject:
        """Choose samples and draw the bootstrap resamples."""
        numbers = chosen(len(samples), pairs, seed)
        truth = np.array([samples.target(number) for number in numbers])
        scenes = samples.scene[samples.first[numbers]]
        return cls(numbers, truth, len(np.unique(scenes)), cluster_resamples(scenes, seed=seed), seed)


def _report(
    checkpoint: Checkpoint,
    data: str | Path,
    part: str | None,
    samples: SonarPairs | ImpulsePairs,
    subject: _Subject,
    sonar_differences: list[str],
    tables: list[JsonObject],
) -> JsonObject:
    """Return the report of an evaluation; see :func:`evaluate`."""
    recipe = DataStore.open(data).recipe
    return {
        "network": checkpoint.network,
        "digest": checkpoint.digest,
        "trained": {"data": checkpoint.data, "model": checkpoint.model, "noise": checkpoint.noise, **checkpoint.trained},
        "data": str(data),
        "recipe": recipe.name,
        "model": modality_of(recipe).sonar.model,
        "part": part or samples.split.unseen,
        "split": samples.split.by,
        "pairs": len(subject.numbers),
        "scenes": subject.scenes,
        "names": list(checkpoint.labels["names"]),
        "seed": subject.seed,
        "notes": [*sonar_differences, *_seen_note(checkpoint, samples, subject), *_notes(checkpoint, recipe)],
        "tables": tables,
    }


def samples_for(
    checkpoint: Checkpoint,
    data: str | Path,
    *,
    part: str | None = None,
    split: str | Split | JsonObject | None = None,
    noise: str = "none",
    seed: int = 0,
) -> SonarPairs | ImpulsePairs:
    """Return one sample of each sequence of a data set, or all samples of recorded frames, arranged for a network.

    Raises:
        MitsonarError: the data set lacks an input of the network, or has no samples in that part.
    """
    recipe = DataStore.open(data).recipe
    options = {
        "noise": noise,
        "labels": checkpoint.labels["kind"],
        "seed": seed,
        "one_per_sequence": recipe.recorded is None,
    }
    if part is None:
        part = split_for(split, recipe).unseen
    if checkpoint.channel is not None:
        return ImpulsePairs(data, part=part, split=split, frames=checkpoint.arrangement["frames"], **options)
    return SonarPairs(data, part=part, split=split, **checkpoint.arrangement, **options)


def _device(device: torch.device | str | None) -> torch.device:
    return torch.device(device if device is not None else "cuda" if torch.cuda.is_available() else "cpu")


def _time_per_sample(checkpoint: Checkpoint, pairs: SonarPairs | ImpulsePairs, numbers: Sequence[int]) -> float:
    """Measure the median CPU time per sample on one core [ms], from the frames (and their geometry) to the estimate."""
    network = checkpoint.build()
    times_ms = []
    with torch.inference_mode(), one_thread():
        for number in [numbers[0], *numbers]:
            raw = default_collate([pairs.raw(number)])
            started = time.process_time()
            answer_of(network, pairs.finished(raw)[0])
            times_ms.append(1e3 * (time.process_time() - started))
    return float(np.median(times_ms[1:]))  # the first sample warms up


# ---------------- Error tables


def _table(checkpoint: Checkpoint, subject: _Subject, ms: float, estimates: Array, covariances: Array | None) -> JsonObject:
    """Return the table of one noise level, with rows for the network and for the constant estimate zero."""
    truth, resamples = subject.truth, subject.resamples
    inputs, beyond = {checkpoint.network: inputs_of(checkpoint), "zero": "nothing"}, _beyond(checkpoint, truth, estimates)
    # Motions: a missing yaw is filled with zeros, since the rows of a comparison have three axes, and removed again.
    if truth.shape[1] >= 2:
        truth, estimates, axes = _with_yaw(truth), _with_yaw(estimates), truth.shape[1]
        no_covariances, valid = np.full((len(truth), 3, 3), np.nan), np.ones(len(truth), dtype=bool)
        covariances = no_covariances if covariances is None else covariances
        answers = {
            checkpoint.network: Answers(estimates, valid, covariances, np.full(len(truth), ms)),
            "zero": Answers(np.zeros_like(truth), valid, no_covariances, np.zeros(len(truth))),
        }
        rows = [_first_axes(row.plain(), axes) for row in rows_of(answers, inputs, truth, resamples, reference="zero")]
        scale = np.array([1, 1, 100])[:axes]
    # Heights: the baseline is the middle of the training heights, since zero is not a valid height.
    else:
        middle = np.full_like(truth, checkpoint.coder.low.mean() / 2 + checkpoint.coder.high.mean() / 2)
        by_method = {checkpoint.network: estimates, "zero": middle}
        times = {checkpoint.network: ms, "zero": 0.0}
        rows = [
            {"method": name, "inputs": inputs[name], "ms": times[name], **_height_errors(values, truth, middle, resamples)}
            for name, values in by_method.items()
        ]
        scale = np.ones(1)
    for row in rows:
        row["thesis"] = [value * factor for value, factor in zip(row["rmse"], scale.tolist(), strict=True)]
    correlations = _correlations(estimates - truth, len(rows[0]["rmse"]))
    return {"limits": {}, "reference": "zero", "rows": rows, "beyond": beyond, "correlations": correlations}


def _correlations(error: Array, axes: int) -> dict[str, float | None]:
    """Compute the correlations between the errors ``(n, axes)`` of any two axes; None if undefined, as for one sample."""
    table = np.full((axes, axes), np.nan)
    if len(error) > 1:
        with np.errstate(invalid="ignore"):
            table = np.atleast_2d(np.corrcoef(error[:, :axes], rowvar=False))
    return {
        f"{AXES[first].name}-{AXES[second].name}": float(table[first, second]) if np.isfinite(table[first, second]) else None
        for first, second in combinations(range(axes), 2)
    }


def _with_yaw(motion: Array) -> Array:
    """Return motions ``(n, 3)``, with a missing yaw as 0."""
    return np.hstack([motion, np.zeros((len(motion), len(AXES) - motion.shape[1]))])


def _first_axes(row: JsonObject, axes: int) -> JsonObject:
    """Return a row with the values of its first axes only."""
    return {name: value[:axes] if isinstance(value, list) else value for name, value in row.items()}


def _height_errors(heights: Array, truth: Array, middle: Array, resamples: NDArray[np.int64]) -> JsonObject:
    """Compute the errors of heights ``(n, 1)`` [m], with the fields of :class:`~mitsonar.motion.errors.MotionErrors`.

    Errors are in mm. ``zero`` is the RMSE of a constant estimate, the middle of the training heights. The slope is that of
    estimated against true differences from this middle.
    """
    error, offset = 1e3 * (heights - truth), 1e3 * (truth - middle)
    rmse, zero = (float(np.sqrt((values**2).mean())) for values in (error, offset))
    low, high = np.percentile(np.sqrt((error[resamples, 0] ** 2).mean(axis=1)), [2.5, 97.5])
    large = np.abs(offset) > 0.5 * np.abs(offset).max()
    power = float((offset**2).sum())
    slope = float(((1e3 * (heights - middle)) * offset).sum()) / power if power else None
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
        "large": [float(np.sqrt((error[large] ** 2).mean())) if large.any() else None],
        "zero": [zero],
        "skill": [1 - rmse / zero if zero else None],
        "nees": None,
    }


def _beyond(checkpoint: Checkpoint, truth: Array, estimates: Array) -> dict[str, float]:
    """Compute the fractions of true and of estimated targets that are outside the training range on any axis."""
    low, high = checkpoint.coder.low - 1e-9, checkpoint.coder.high + 1e-9
    return {
        name: float(((values < low) | (values > high)).any(axis=1).mean())
        for name, values in (("true", truth), ("answers", estimates))
    }


# ---------------- Differences from training


def _sonar_differences(checkpoint: Checkpoint, recipe: Recipe) -> list[str]:
    """Describe the sonars of a data set that differ from those of training."""
    if checkpoint.channel is not None:
        return _channel_differences(checkpoint.channel, recipe.channel_sonar, recipe.name)
    differences = []
    for view in recipe.views:
        trained = checkpoint.sonars.get(view.name)
        if trained is None:
            continue
        difference = TrainedInstrument.of(trained).unlike(TrainedInstrument.of(view.sonar))
        if difference:
            differences.append(
                f"the {checkpoint.network} was trained on the sonar {trained.name}, but the data set {recipe.name} uses "
                f"{view.sonar.name}: {difference}"
            )
    return list(dict.fromkeys(differences))


def _channel_differences(trained: ChannelSonar, evaluated: ChannelSonar, name: str) -> list[str]:
    """Describe the differences between two channel sonars that change responses."""
    trained_fields, evaluated_fields = trained.model_dump(mode="json"), evaluated.model_dump(mode="json")
    changed = [key for key in trained_fields if trained_fields[key] != evaluated_fields[key] and key not in SAME_INSTRUMENT]
    return [f"trained with a different channel sonar from that of {name}: {', '.join(changed)} differ"] if changed else []


def _seen_note(checkpoint: Checkpoint, samples: SonarPairs | ImpulsePairs, subject: _Subject) -> list[str]:
    """Return a note on the number of pairs that training has seen, if any."""
    seen = int(checkpoint.learnt(samples)[subject.numbers].sum())
    count = count_noun(len(subject.numbers), "pair")
    return [f"training has seen {seen} of these {count}: errors on unseen pairs may be larger"] if seen else []


def _notes(checkpoint: Checkpoint, recipe: Recipe) -> list[str]:
    """Describe other differences between training and evaluation."""
    notes = []
    model = modality_of(recipe).sonar.model
    if model not in checkpoint.model.split(" and "):
        notes.append(f"trained on the {checkpoint.model} model, evaluated on the {model} model")
    if not checkpoint.arrangement["ground"]:
        low, high = (height + recipe.mount.up_m for height in recipe.flight.heights)
        trained = checkpoint.trained_at
        heights = low < trained["height_m"][0] * (1 - HEIGHT_OFF) or high > trained["height_m"][1] * (1 + HEIGHT_OFF)
        angles = [abs(getattr(recipe.mount, key) - trained[key]) > ANGLE_OFF_DEG for key in ("pitch_deg", "roll_deg")]
        if heights or any(angles):
            notes.append(
                f"{checkpoint.fixed} are fixed by training; here the sonar is at {low:g}..{high:g} m, pitch "
                f"{recipe.mount.pitch_deg:g} deg, roll {recipe.mount.roll_deg:g} deg"
            )
    return notes


# ---------------- Output


COLUMNS = (
    *("method", "RMSE", "RMSE, mm / mm / deg/100", "95 % interval", "median", "95 %", "slope", "bias", "large"),
    *("skill", "nees", "ms", "inputs"),
)


def report_lines(report: JsonObject) -> list[str]:
    """Format the report of :func:`evaluate` as lines of Markdown."""
    units = "height mm" if len(report["names"]) == 1 else "sideways mm / forward mm / yaw deg"
    units = units.removesuffix(" / yaw deg") if len(report["names"]) == 2 else units
    lines = [
        f"{report['data']} ({report['recipe']}), part {report['part']} by {report['split']}: {report['pairs']} samples of "
        f"{report['scenes']} scenes, {report['model']} model; {units}"
    ]
    for table in report["tables"]:
        beyond = table["beyond"]
        lines += ["", f"noise {table['noise']}", "", *markdown(table["rows"], COLUMNS), ""]
        lines.append(
            f"outside the training range: {beyond['true']:.1%} of the samples, {beyond['answers']:.1%} of the estimates  "
        )
        correlations = [
            f"{axes} {'-' if value is None else f'{value:.2f}'}" for axes, value in table["correlations"].items()
        ]
        if correlations:
            lines.append(f"correlations of errors: {', '.join(correlations)}  ")
    return lines


def check_no_tables(out: Path, *, overwrite: bool) -> None:
    """Check that no tables in a folder would be replaced without ``overwrite``.

    Raises:
        MitsonarError: the folder contains tables, or the path is a file.
    """
    if out.exists() and not out.is_dir():
        raise MitsonarError(f"-o must be a folder: got the file {out}")
    refuse_to_replace(out / "table.md", out / "table.json", overwrite=overwrite)


def save_tables(out: Path, report: JsonObject) -> None:
    """Write ``table.md`` and ``table.json`` to a folder, which is created if it does not exist."""
    out.mkdir(parents=True, exist_ok=True)
    write_atomic(out / "table.md", ("\n".join(report_lines(report)) + "\n").encode())
    write_json(out / "table.json", report)
