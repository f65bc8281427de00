"""How an odometry run is written to a folder, resumed and read back.

:func:`run_odometry` appends each estimate to a journal as soon as it is computed, so that a killed run can be resumed. At
the end it writes the path, a table and a figure. :class:`OdometryFolder` reads them back.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.estimation.estimator import AnyEstimator, Estimate, PlainTable
from mitsonar.io.files import finite_number, parse_json, whole_lines, whole_number, write_atomic, write_json
from mitsonar.io.runs import RunDirectory, RunKind
from mitsonar.mapping.odometry import Odometry, OdometryOptions, Row, odometry
from mitsonar.mapping.open_source import Source
from mitsonar.mapping.pairs import EstimateStore
from mitsonar.mapping.pose_graph import PoseEdges
from mitsonar.motion.composition import Motion
from mitsonar.motion.errors import AXES, in_units
from mitsonar.motion.trajectory import Trajectory, convention_named
from mitsonar.plotting.figures import path_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["ODOMETRY", "OdometryFolder", "add_to_journal", "read_journal", "run_odometry", "table_lines"]


ODOMETRY = RunKind(
    "odometry",
    outputs=(
        *("estimates.jsonl", "loops.jsonl", "loops.csv", "estimated.tum", "true.tum", "motions.csv", "covariances.npz"),
        *("table.md", "table.json", "path.png", "height_profile.csv"),
    ),
    notes={
        **{"source": str, "inputs": str, "smooth": str, "scale": str | None, "frame": str, "factors": list, "from": list},
        **{"not_believed": int, "warnings": list, "seconds": float, "pairs_in_these_seconds": int, "workers": int},
        **{"closure": int, "loops": bool, "local_map": bool},
    },
    packages=("mitsonar", "numpy", "scipy", "opencv-python-headless"),
    deciding=("mitsonar",),
)
"""The files of an odometry run. ``true.tum`` exists if true poses are known. ``estimates.jsonl`` has one line per pair. A
search for loops adds ``loops.jsonl``, with one line per registration, and ``loops.csv``."""


class OdometryFolder(EstimateStore):
    """A folder to which an odometry run is written, or from which it is read; its journals are a store of estimates.

    Attributes:
        run: options and state of the run.
        path: path of the folder.
    """

    def __init__(self, run: RunDirectory) -> None:
        super().__init__()
        self.run, self.path = run, run.path

    @classmethod
    def open(cls, path: str | Path) -> OdometryFolder:
        """Open the folder of a finished odometry run.

        Raises:
            MitsonarError: the folder holds no odometry run, or the run is not finished.
        """
        folder = cls(RunDirectory.open(path, ODOMETRY))
        if not folder.run.finished:
            raise MitsonarError(f"{path} is not finished: run the same `mitsonar odometry` with --resume")
        return folder

    @property
    def height_m(self) -> float | None:
        """Return the height over the ground that the user gave [m]; None if none was given.

        Raises:
            MitsonarError: ``run.json`` is damaged.
        """
        height = self.run.settings.get("height_m")
        try:
            return None if height is None else finite_number(height, "height_m", above=0, below=1e6)
        except MitsonarError as error:
            raise self.run.damage(error) from None

    @property
    def estimated(self) -> Trajectory:
        """Return the estimated path."""
        return self._path("estimated.tum")

    @property
    def true(self) -> Trajectory | None:
        """Return the true path; None if it was not known."""
        return self._path("true.tum") if (self.path / "true.tum").exists() else None

    def _path(self, name: str) -> Trajectory:
        """Load a path in the convention in which it was written, without warnings."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MitsonarWarning)
            return Trajectory.load(self.path / name, str(self.run.notes.get("frame", "mitsonar")))

    # ---------------- Journals

    def read_journals(self) -> Self:
        """Read the estimates of an earlier run. Remove a last line that a killed run left incomplete.

        Raises:
            MitsonarError: a journal is damaged.
        """
        pairs = read_journal(self.path / "estimates.jsonl", "pair")
        self.pairs = {key["pair"]: estimate for key, estimate in pairs}
        loops = read_journal(self.path / "loops.jsonl", "first", "second")
        self.loops = {(key["first"], key["second"], key["guess"]): estimate for key, estimate in loops}
        return self

    def add_pair(self, pair: int, estimate: Estimate) -> None:
        """Append an estimate to its journal; the first one creates the folder.

        Raises:
            MitsonarError: the folder cannot be created.
        """
        self.run.start()
        add_to_journal(self.path / "estimates.jsonl", {"pair": pair}, estimate)

    def add_loop(self, first: int, second: int, guess: Motion, estimate: Estimate) -> None:
        """Append a loop registration to its journal; see :meth:`add_pair`."""
        self.run.start()
        add_to_journal(self.path / "loops.jsonl", {"first": first, "second": second, "guess": list(guess)}, estimate)

    # ---------------- Results

    def write(self, result: Odometry, title: str, notes: PlainTable) -> None:
        """Write all results. ``run.json`` comes last and marks them as complete."""
        self.run.start()
        self.run.finished = False
        self.run.note(**notes)
        frame = str(self.run.notes.get("frame", "mitsonar"))
        _save_tum(self.path / "estimated.tum", result.path, frame)
        if result.true is not None:
            _save_tum(self.path / "true.tum", result.true, frame)
        write_atomic(self.path / "motions.csv", _motions_csv(result).encode())
        write_atomic(self.path / "covariances.npz", _covariances(result))
        if np.isfinite(result.heights.height_m).any():
            write_atomic(self.path / "height_profile.csv", result.heights.csv().encode())
        else:
            (self.path / "height_profile.csv").unlink(missing_ok=True)  # left from an earlier run with heights
        if result.graph is not None and result.graph.search is not None:
            write_atomic(
                self.path / "loops.csv", _loops_csv(result, result.graph.search.loops, result.graph.accepted).encode()
            )
        else:
            (self.path / "loops.csv").unlink(missing_ok=True)  # left from an earlier search
        rows = result.rows()
        write_atomic(self.path / "table.md", ("\n".join(table_lines(rows)) + "\n").encode())
        table = [{"name": name, "value": value if np.isfinite(value) else None, "unit": unit} for name, value, unit in rows]
        write_json(self.path / "table.json", {"rows": table})
        save_figure(self.path / "path.png", _figure(result, title))
        self.run.finish()


def run_odometry(
    source: Source,
    name: str,
    estimator: AnyEstimator,
    out: str | Path,
    options: OdometryOptions = OdometryOptions(),
    *,
    frame: str = "mitsonar",
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[int], None] = lambda pairs: None,
) -> Odometry:
    """Run :func:`mitsonar.mapping.odometry.odometry` and write the results, the files of :data:`ODOMETRY`, to a folder.

    Args:
        source: source of the records.
        name: name of the estimator, as the user gave it.
        estimator: estimates the motions.
        out: folder to write to; it is created.
        options: which frames are used, and what the path is made of.
        frame: convention of ``estimated.tum`` and ``true.tum``: ``mitsonar``, ``ros-enu`` or ``ned``.
        overwrite: replace an odometry run in the folder.
        resume: continue an interrupted run; other options than ``every`` and ``sensors`` may change.
        progress: see ``odometry``.

    Raises:
        MitsonarError: as for ``odometry``; or the folder holds something else, or cannot be written.
    """
    convention_named(frame)
    # 1. open the folder, and read the estimates of an earlier run
    settings = _settings(source, name, estimator, options)
    run = RunDirectory.begin(out, ODOMETRY, settings, resume=resume, overwrite=overwrite)
    folder = OdometryFolder(run).read_journals() if run.resumed else OdometryFolder(run)
    # 2. compute the path; each new estimate goes to the journals at once
    begun = time.perf_counter()
    result = odometry(source, estimator, options, store=folder, progress=progress)
    # 3. write the results, with notes for `run.json`
    notes = {
        **{"source": source.name, "inputs": estimator.inputs, "smooth": options.smooth},
        "scale": options.scale if isinstance(options.scale, str) or options.scale is None else "given",
        **{"frame": frame, "factors": result.factors, "from": result.path.poses[0]},
        **{"not_believed": int((~result.valid).sum())},
        **{"warnings": result.warnings(), "seconds": time.perf_counter() - begun},
        **{"pairs_in_these_seconds": len(result.estimates) - len(folder.pairs), "workers": options.workers},
        **{"closure": options.closure, "loops": options.loops, "local_map": options.local_map},
    }
    folder.write(result, f"{Path(source.name).name}, {name}", notes)
    return result


def _settings(source: Source, name: str, estimator: AnyEstimator, options: OdometryOptions) -> PlainTable:
    """Return the options on which the estimates depend; a run can be resumed only with the same ones."""
    of_estimator: PlainTable = dataclasses.asdict(estimator) if dataclasses.is_dataclass(estimator) else {}
    return {
        **{"estimator": name, "options": of_estimator, "frames": len(source), "frames_sha256": source.digest()},
        **{"every": options.every, "height_m": source.given_height_m},
        "pitch_deg": None if source.pitch_rad is None else float(np.degrees(source.pitch_rad)),
        "noise": None if source.noise is None else {**source.noise.model_dump(), "seed": source.seed},
        **({} if options.sensors is None else {"sensors_sha256": options.sensors.digest()}),
    }


# ---------------- Files


def _save_tum(path: Path, trajectory: Trajectory, frame: str) -> None:
    part = path.with_name(f".{path.name}.part")
    trajectory.save(part, frame)
    part.replace(path)


def _motions_csv(result: Odometry) -> str:
    """Return a CSV table with one line per motion, in mm and deg; unknown standard deviations are empty."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    names = [f"{axis.name}_{axis.unit}" for axis in AXES]
    stds = [f"{axis.name}_std_{axis.unit}" for axis in AXES]
    table.writerow(["from_frame", "frame", "time_s", *names, *stds, "believed", "reason"])
    moved = in_units(result.series.motions)
    std = _std(result.series.covariances)
    for k, estimate in enumerate(result.estimates):
        deviations = ["", "", ""] if std is None else [f"{value:.6g}" for value in std[k]]
        numbers = [f"{value:.6f}" for value in moved[k]]
        frames = [int(result.frames[k]), int(result.frames[k + 1]), f"{result.series.time_s[k + 1]:.9f}"]
        table.writerow([*frames, *numbers, *deviations, int(estimate.valid), estimate.reason])
    return text.getvalue()


def _loops_csv(result: Odometry, loops: PoseEdges, accepted: NDArray[np.bool_]) -> str:
    """Return a CSV table with one line per loop, in mm and deg."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    names = [f"{axis.name}_{axis.unit}" for axis in AXES]
    table.writerow(["from_frame", "frame", *names, *(f"{axis.name}_std_{axis.unit}" for axis in AXES), "kept"])
    moved, std = in_units(loops.motions), in_units(np.sqrt(np.diagonal(loops.covariances, axis1=1, axis2=2)))
    for k, (first, second) in enumerate(zip(loops.first, loops.second, strict=True)):
        numbers = [f"{value:.6f}" for value in moved[k]] + [f"{value:.6g}" for value in std[k]]
        table.writerow([int(result.frames[first]), int(result.frames[second]), *numbers, int(accepted[k])])
    return text.getvalue()


def _std(covariances: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    return None if covariances is None else in_units(np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)))


def _covariances(result: Odometry) -> bytes:
    """Return an ``.npz`` file of times, motions and covariances in m and rad; unknown covariances are nan."""
    count = len(result.estimates)
    motions, poses = result.series.covariances, result.pose_covariances
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        time_s=result.series.time_s,
        frames=result.frames,
        motions=result.series.motions,
        believed=result.valid,
        motion_covariances=np.full((count, 3, 3), np.nan) if motions is None else motions,
        pose_covariances=np.full((count + 1, 3, 3), np.nan) if poses is None else poses,
    )
    return buffer.getvalue()


def table_lines(rows: list[Row]) -> list[str]:
    """Return rows as the lines of a Markdown table with aligned columns."""
    cells = [("", "value", "unit"), *((name, _number(value, unit), unit) for name, value, unit in rows)]
    width = [max(len(line[k]) for line in cells) for k in range(3)]
    lines = [f"| {name.ljust(width[0])} | {value.rjust(width[1])} | {unit.ljust(width[2])} |" for name, value, unit in cells]
    return [lines[0], f"| {'-' * width[0]} | {'-' * (width[1] - 1)}: | {'-' * width[2]} |", *lines[1:]]


def _number(value: float, unit: str) -> str:
    if not np.isfinite(value):
        return "-"
    return f"{value:,.0f}" if unit == "" and float(value).is_integer() else f"{value:.4g}"


def _figure(result: Odometry, title: str) -> Figure:
    true = result.true_at_frames
    paths = {"estimated": result.path} | ({} if true is None else {"true": true})
    motions, poses = result.series.covariances, result.pose_covariances
    return path_figure(
        paths,
        motion_covariances=None if motions is None else {"estimated": motions},
        pose_covariances=None if poses is None else {"estimated": poses},
        title=title,
    )


# ---------------- Journals of estimates


LARGEST_JOURNAL = 2**30
"""Largest size of a journal [bytes]: some three million pairs."""

HEIGHTS, SENTENCES = ("height_m", "height_std_m"), ("doubt", "untrained")
"""What an estimator may report: height over the ground with its standard deviation [m], and sentences for the user."""


def add_to_journal(path: Path, key: PlainTable, estimate: Estimate) -> None:
    """Append an estimate to a journal as one JSON line, which preserves every bit of its numbers.

    Args:
        path: path of the journal.
        key: identifies the estimate: its ``pair``; or its ``first`` and ``second`` frame and the initial ``guess``.
        estimate: estimate to append.
    """
    covariance = None if estimate.covariance is None else np.asarray(estimate.covariance, dtype=float).tolist()
    motion = [float(value) for value in estimate.motion]
    line = key | {"motion": motion, "covariance": covariance, "valid": bool(estimate.valid)}
    about = {name: estimate.about[name] for name in ("modes", "spreads", *HEIGHTS, *SENTENCES) if name in estimate.about}
    # estimators of users may report numbers and arrays of NumPy
    text = json.dumps(line | {"reason": estimate.reason} | ({"about": about} if about else {}), default=_of_numpy)
    with path.open("a", encoding="utf-8", newline="\n") as file:
        file.write(f"{text}\n")


def _of_numpy(value: np.ndarray | np.generic) -> object:
    return value.tolist()


def read_journal(path: Path, *names: str) -> Iterator[tuple[PlainTable, Estimate]]:
    """Yield the identifiers and the estimate of each line. Remove a last line that a killed run left incomplete.

    Args:
        path: path of the journal.
        names: names of the numbers that identify an estimate; every line must hold them.

    Raises:
        MitsonarError: the journal is damaged.
    """
    for number, line in enumerate(whole_lines(path, "journal", LARGEST_JOURNAL), start=1):
        try:
            entry = _estimate_in(line, names)
        except Exception:  # a damaged line may raise anything
            raise MitsonarError(f"{path}, line {number} is damaged: start over with --overwrite") from None
        yield entry


def _estimate_in(line: bytes, names: tuple[str, ...]) -> tuple[PlainTable, Estimate]:
    """Parse and validate a line. A damaged line raises an exception of some kind."""
    table = parse_json(line, "the line")
    covariance = None if table["covariance"] is None else np.array(table["covariance"], dtype=float)
    motion = np.array(table["motion"], dtype=float)
    if motion.shape != (3,) or not isinstance(table["reason"], str) or type(table["valid"]) is not bool:
        raise ValueError("motion, reason or valid is of another type")
    if table["valid"] and not np.isfinite(motion).all():
        raise ValueError("the motion is not finite")
    if covariance is not None and (covariance.shape != (3, 3) or (table["valid"] and (np.diagonal(covariance) < 0).any())):
        raise ValueError("covariance is not a covariance")
    about = table.get("about", {})
    if not isinstance(about, dict):
        raise ValueError("about is not a table")
    for name in set(HEIGHTS) & set(about):
        finite_number(about[name], name, above=0)
    key: PlainTable = {name: whole_number(table[name], name, 0, 2**40) for name in names}
    if "first" in names:
        key["guess"] = Motion(*(float(value) for value in np.array(table["guess"], dtype=float).reshape(3)))
    return key, Estimate(Motion(*(float(value) for value in motion)), covariance, table["valid"], table["reason"], about)
