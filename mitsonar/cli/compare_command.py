"""``mitsonar compare``: estimators side by side on the same pairs of a data set."""

from __future__ import annotations

import hashlib
import io
import json
import re
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from mitsonar.cli.console import answered, progress_bar, say, warn
from mitsonar.errors import MitsonarError, meant

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mitsonar.acoustics.noise import NoiseModel
    from mitsonar.estimation.benchmark import Answers
    from mitsonar.estimation.estimator import Estimator

__all__ = ["compare", "markdown", "table_lines"]


FEWEST_SCENES = 10
"""With fewer, clustered intervals hold much less than they say."""


@answered
def compare(
    data: Annotated[str, typer.Argument(metavar="DATA.zarr", help="Path or URL of a data set.")],
    estimators: Annotated[
        str | None,
        typer.Option(
            help="Names, or checkpoints of networks, with commas between them, each NAME or NAME:key=value:key=value "
            "(default: zero,ecc,flow,phase,direct; of impulse responses: zero,correlation,likelihood)."
        ),
    ] = None,
    noise: Annotated[
        str,
        typer.Option(
            help="Levels with commas between them (or ; where one is m,s,g): none, low, high, chapter2, a YAML file; of "
            "impulse responses ratios: none,20 dB."
        ),
    ] = "none",
    part: Annotated[str | None, typer.Option(help="train, validation, test (default where it is), all.")] = None,
    pairs: Annotated[int | None, typer.Option(min=2, help="At most so many, each of a sequence of its own.")] = None,
    perturb: Annotated[
        bool, typer.Option("--perturb", help="Rows with wrong height, pitch, roll, sound speed, heave.")
    ] = False,
    jitter: Annotated[
        bool, typer.Option("--jitter", help="A row with rays that move: is it the sampling's pattern?")
    ] = False,
    prior: Annotated[bool, typer.Option("--prior", help="Rows that know how large motions are, as networks do.")] = False,
    limit: Annotated[
        int, typer.Option(min=0, help="Pairs over which the physical limit is computed; 0: none (of images only).")
    ] = 10,
    reference: Annotated[str | None, typer.Option(help="Method that others are compared with (default: the last).")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of noise, choice of pairs and bootstrap.")] = 0,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder for answers, table.md and table.json; goes on.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print for programs.")] = False,
) -> None:
    """Errors of all methods on the same pairs; failures count as zero motion; bootstrap by scene, then sequence."""
    from mitsonar.datasets.modalities import modality_of
    from mitsonar.datasets.modality import samples_of
    from mitsonar.datasets.store import DataStore
    from mitsonar.estimation.benchmark import VARIATIONS, answers_of, bounds_of_pairs, chosen, rows_of, with_prior
    from mitsonar.estimation.named_estimators import estimator_from
    from mitsonar.motion.motion_errors import cluster_resamples, in_units
    from mitsonar.motion.pose import motions

    recipe = DataStore.open(data).recipe
    modality = modality_of(recipe)
    methods = {text: estimator_from(text) for text in dict.fromkeys((estimators or modality.estimators).split(",")) if text}
    if not methods or (reference is not None and reference not in methods):
        raise MitsonarError(
            f"--reference must be one of {', '.join(methods) or 'the estimators'}: got {reference!r}"
            f"{meant(reference, methods)}"
        )
    if not modality.variations and (perturb or jitter or prior):
        raise MitsonarError("--perturb, --jitter and --prior are for data sets of images: leave them out")
    names = list(dict.fromkeys(noise.split(";" if ";" in noise else ",")))
    levels = {name: modality.noise_model(name) for name in names}
    limit = limit if modality.variations else 0
    changed = [name for name in VARIATIONS if name not in ("as told", "jitter")] if perturb else []
    asked = ["as told", *changed, *(["jitter"] if jitter else [])]
    part_read = part or recipe.split.unseen
    samples: dict[str, Any] = {
        name: samples_of(modality, data, noise=name, one_a_sequence=True, part=part_read, seed=seed) for name in names
    }
    first = next(iter(samples.values()))
    if len(first) < 2:
        raise MitsonarError("a comparison needs two pairs or more: give --part all, or a larger data set")
    numbers = chosen(len(first), pairs, seed)
    # of the sonar: the labels of a data set are the vehicle's motions, and a mount may turn or offset them
    pose = first.chosen.pose
    truth = np.array([motions(pose[first.frame_numbers(number)][[0, -1]])[0] for number in numbers])
    resamples = cluster_resamples(first.scene[first.first[numbers]], seed=seed)
    if jitter and first.recipe.instrument.jittered:
        raise MitsonarError("the rays of this data set move already: --jitter is for the thesis's model")
    scenes = len(np.unique(first.scene[first.first[numbers]]))
    if scenes < FEWEST_SCENES:
        warn(f"{scenes} scenes only: the 95 % intervals are too narrow; compare on {FEWEST_SCENES} or more")
    settings: dict[str, Any] = {
        "digest": _digest(first),
        "methods": list(methods),
        "part": part,
        "pairs": len(numbers),
        "seed": seed,
        "version": version("mitsonar"),
    }
    networks = {name: method.digest for name, method in methods.items() if method.digest}
    if networks:
        settings["networks"] = networks
    store = _Kept(out, settings)
    model_name = modality.sonar.model
    report: dict[str, Any] = {"data": data, "model": model_name, **settings, "tables": []}
    with progress_bar("comparing", len(levels) * len(asked) * len(numbers), "pairs") as progress:
        answers = {
            (level, variation): answers_of(
                methods,
                samples[level],
                numbers,
                variation,
                known=store.load(_key(level, levels[level]), variation, methods, len(numbers)),
                keep=store.keeper(_key(level, levels[level]), variation),
                progress=progress,
            )
            for level in levels
            for variation in asked
        }
    inputs = {name: method.inputs for name, method in methods.items()}
    for level, model in levels.items():
        bounds = store.limits(_key(level, model), limit)
        if limit and bounds is None and model is not None:
            few = [numbers[k] for k in np.linspace(0, len(numbers) - 1, min(limit, len(numbers))).astype(int)]
            with progress_bar("limit", len(few), "pairs") as progress:
                bounds = bounds_of_pairs(samples[level], few, model, progress)
            store.keep_limits(_key(level, model), limit, bounds)
        for variation in asked:
            said = dict(answers[level, variation])
            if prior:
                flight = first.recipe.flight
                largest = np.array([flight.sideways_mm / 1e3, flight.forward_mm / 1e3, np.radians(flight.yaw_deg)])
                known = {k: one for k, one in said.items() if np.isfinite(one.covariance).any()}
                said |= {f"{k} with prior": with_prior(one, largest) for k, one in known.items()}
            words = {k: inputs[k.removesuffix(" with prior")] + (", prior" if "with prior" in k else "") for k in said}
            bound = None if not bounds else bounds["rays"]
            rows = rows_of(said, words, truth, resamples, limit=bound, reference=reference or list(methods)[-1])
            report["tables"].append(
                {
                    "noise": level,
                    "variation": variation,
                    "limits": {law: _plain(in_units(std)) for law, std in (bounds or {}).items()},
                    "reference": reference or list(methods)[-1],
                    "rows": [row.plain() for row in rows],
                }
            )
    lines = [line for table in report["tables"] for line in table_lines(table)]
    store.finish(lines, report)
    if as_json:
        say(json.dumps(report, indent=1))
        return
    say(
        f"{data}: {len(numbers)} pairs of {len(np.unique(first.scene[first.first[numbers]]))} scenes, "
        f"{model_name} model; sideways mm / forward mm / yaw deg"
    )
    for line in lines:
        say(line)
    if out is not None:
        say(f"\ntables: {out / 'table.md'}, {out / 'table.json'}")


def _digest(pairs: Any) -> str:
    """Of what is compared on: the motions and the recipe."""
    content = pairs.chosen.motion.tobytes() + pairs.chosen.pose.tobytes()
    content += json.dumps(pairs.recipe.model_dump(), default=str).encode()
    return hashlib.sha256(content).hexdigest()


def _key(level: str, model: NoiseModel | None) -> str:
    """Names a noise level by what it is: a file of the same name may change; a ratio says all."""
    if model is None:
        return level
    return f"{level} {hashlib.sha256(model.model_dump_json().encode()).hexdigest()[:8]}"


def _plain(values: NDArray[np.float64]) -> list[float | None]:
    """For JSON: what is not finite is None."""
    return [float(value) if np.isfinite(value) else None for value in values]


class _Kept:
    """Answers on disk, so that a comparison that was broken off goes on; a stub without a folder."""

    def __init__(self, folder: Path | None, settings: dict[str, Any]) -> None:
        from mitsonar.io.whole_files import read_json, write_json

        self.folder = folder
        if folder is None:
            return
        if folder.exists() and any(folder.iterdir()):
            if not (folder / "compare.json").exists():
                raise MitsonarError(f"{folder} holds other things and is kept: choose another -o")
            had = read_json(folder / "compare.json")
            differ = [key for key, value in settings.items() if had.get(key) != value]
            if differ:
                raise MitsonarError(f"{folder} holds a comparison with other {', '.join(differ)}: choose another -o")
            return
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "compare.json", settings)

    def _path(self, level: str, variation: str) -> Path:
        assert self.folder is not None
        return self.folder / (re.sub(r"[^\w.-]+", "-", f"answers {level} {variation}".replace("%", "percent")) + ".npz")

    def load(self, level: str, variation: str, methods: dict[str, Estimator], count: int) -> dict[str, Answers] | None:
        """What an earlier run has found."""
        from mitsonar.estimation.benchmark import Answers

        if self.folder is None or not self._path(level, variation).exists():
            return None
        try:
            with np.load(self._path(level, variation)) as table:
                found = {name: Answers.from_arrays(table, name) for name in methods}
            if any(len(values) != count for one in found.values() for values in vars(one).values()):
                raise ValueError("it holds other numbers of pairs")
            return found
        except Exception as error:  # a damaged zip raises whatever its bytes lead to
            raise MitsonarError(
                f"{self._path(level, variation)} is damaged ({error}): remove it, it is made again"
            ) from None

    def keeper(self, level: str, variation: str) -> Any:
        """What keeps answers as they come."""
        from mitsonar.io.whole_files import write_whole

        if self.folder is None:
            return None

        def keep(answers: dict[str, Answers]) -> None:
            buffer = io.BytesIO()
            arrays: dict[str, NDArray[Any]] = {}
            for name, one in answers.items():
                arrays |= one.arrays(name)
            np.savez(buffer, **arrays)  # type: ignore[arg-type]
            write_whole(self._path(level, variation), buffer.getvalue())

        return keep

    def limits(self, level: str, count: int) -> dict[str, NDArray[np.float64]] | None:
        """Bounds of an earlier run."""
        from mitsonar.estimation.crlb.image_crlb import LAWS
        from mitsonar.io.whole_files import read_json

        path = None if self.folder is None else self.folder / (re.sub(r"[^\w.-]+", "-", f"limit-{level}-{count}") + ".json")
        if path is None or not path.exists():
            return None
        found = read_json(path)
        try:
            bounds = {law: np.array(found[law], dtype=float) for law in LAWS}
            if any(std.shape != (3,) for std in bounds.values()):
                raise ValueError("a bound is three numbers")
        except (KeyError, ValueError, TypeError) as error:
            raise MitsonarError(f"{path} is damaged ({error}): remove it, it is made again") from None
        return bounds

    def keep_limits(self, level: str, count: int, bounds: dict[str, NDArray[np.float64]]) -> None:
        """Keep them."""
        from mitsonar.io.whole_files import write_json

        if self.folder is not None:
            write_json(
                self.folder / (re.sub(r"[^\w.-]+", "-", f"limit-{level}-{count}") + ".json"),
                {law: std.tolist() for law, std in bounds.items()},
            )

    def finish(self, lines: list[str], report: dict[str, Any]) -> None:
        """The tables."""
        from mitsonar.io.whole_files import write_json, write_whole

        if self.folder is not None:
            write_whole(self.folder / "table.md", ("\n".join(lines) + "\n").encode())
            write_json(self.folder / "table.json", report)


def table_lines(table: dict[str, Any]) -> list[str]:
    """A table of the report as Markdown."""
    lines = ["", f"noise {table['noise']}, {table['variation']}", "", *markdown(table["rows"], COLUMNS)]
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


def markdown(rows: list[dict[str, Any]], columns: Sequence[str]) -> list[str]:
    """Methods as lines of a Markdown table with these columns of :data:`CELLS`."""
    cells = [list(columns), ["---"] * len(columns), *([CELLS[column](row) for column in columns] for row in rows)]
    width = [max(len(row[k]) for row in cells) for k in range(len(columns))]
    return ["| " + " | ".join(cell.ljust(size) for cell, size in zip(row, width, strict=True)) + " |" for row in cells]


DIGITS = (2, 2, 4)


def _number(value: float | None, axis: int) -> str:
    return "-" if value is None else f"{value:.{DIGITS[axis]}f}"


def _three(values: list[float | None]) -> str:
    return " / ".join(_number(value, k) for k, value in enumerate(values))


def _joined(values: list[float | None], digits: int) -> str:
    return " / ".join("-" if value is None else f"{value:.{digits}f}" for value in values)


def _interval(row: dict[str, Any]) -> str:
    ends = zip(row["rmse_low"], row["rmse_high"], strict=True)
    return " ".join(f"{_number(low, k)}..{_number(high, k)}" for k, (low, high) in enumerate(ends))


CELLS: dict[str, Callable[[dict[str, Any]], str]] = {
    "method": lambda row: str(row["method"]),
    "RMSE": lambda row: _three(row["rmse"]),
    "as in the thesis": lambda row: _joined(row["thesis"], 2),
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
"""What a column says of a row."""

COLUMNS = (
    *("method", "RMSE", "95 % interval", "median", "95 %", "slope", "large", "fail", "skill", "/ limit (rays)", "nees"),
    *("ms", "inputs"),
)
