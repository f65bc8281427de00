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
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.estimation.estimator import AnyEstimator, Estimate, PlainTable
from mitsonar.io.files import finite_number, parse_json, whole_lines, whole_number, write_json, write_whole
from mitsonar.io.runs import RunDirectory, RunKind
from mitsonar.mapping.odometry import Odometry, Row, Smoothing, odometry
from mitsonar.mapping.open_source import Source
from mitsonar.mapping.pose_graph import PoseEdges
from mitsonar.motion.composition import Motion
from mitsonar.motion.errors import AXES, in_units
from mitsonar.motion.pose import Pose
from mitsonar.motion.sensors import VehicleSensors
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


class OdometryFolder:
    """A folder to which an odometry run is written, or from which it is read.

    Attributes:
        run: options and state of the run.
        path: path of the folder.
    """

    def __init__(self, run: RunDirectory) -> None:
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
        height = self.run.asked.get("height_m")
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

    def kept(self) -> dict[int, Estimate]:
        """Return the estimates of an earlier run, by pair number. Remove a last line that a killed run left incomplete.

        Raises:
            MitsonarError: the journal is damaged.
        """
        return {of["pair"]: estimate for of, estimate in read_journal(self.path / "estimates.jsonl", "pair")}

    def keep(self, pair: int, estimate: Estimate) -> None:
        """Append an estimate to the journal; the first one creates the folder.

        Raises:
            MitsonarError: the folder cannot be created.
        """
        self.run.start()
        add_to_journal(self.path / "estimates.jsonl", {"pair": pair}, estimate)

    def kept_loops(self) -> dict[tuple[int, int, Motion], Estimate]:
        """Return the loop registrations of an earlier run, by both frames and the initial guess; see :meth:`kept`.

        Raises:
            MitsonarError: the journal is damaged.
        """
        journal = read_journal(self.path / "loops.jsonl", "first", "second")
        return {(of["first"], of["second"], of["guess"]): estimate for of, estimate in journal}

    def keep_loop(self, first: int, second: int, guess: Motion, estimate: Estimate) -> None:
        """Append a loop registration to its journal.

        Raises:
            MitsonarError: the folder cannot be created.
        """
        self.run.start()
        add_to_journal(self.path / "loops.jsonl", {"first": first, "second": second, "guess": list(guess)}, estimate)

    # ---------------- Results

    def write(self, found: Odometry, title: str, more: PlainTable) -> None:
        """Write all results. ``run.json`` comes last and marks them as complete."""
        self.run.start()
        self.run.finished = False
        self.run.note(**more)
        frame = str(self.run.notes.get("frame", "mitsonar"))
        _save_tum(self.path / "estimated.tum", found.path, frame)
        if found.true is not None:
            _save_tum(self.path / "true.tum", found.true, frame)
        write_whole(self.path / "motions.csv", _motions_csv(found).encode())
        write_whole(self.path / "covariances.npz", _covariances(found))
        if np.isfinite(found.heights.height_m).any():
            write_whole(self.path / "height_profile.csv", found.heights.csv().encode())
        else:
            (self.path / "height_profile.csv").unlink(missing_ok=True)  # left from an earlier run with heights
        if found.graph is not None and found.graph.search is not None:
            write_whole(self.path / "loops.csv", _loops_csv(found, found.graph.search.loops, found.graph.kept).encode())
        else:
            (self.path / "loops.csv").unlink(missing_ok=True)  # left from an earlier search
        rows = found.rows()
        write_whole(self.path / "table.md", ("\n".join(table_lines(rows)) + "\n").encode())
        table = [{"name": name, "value": value if np.isfinite(value) else None, "unit": unit} for name, value, unit in rows]
        write_json(self.path / "table.json", {"rows": table})
        save_figure(self.path / "path.png", _figure(found, title))
        self.run.finish()


def run_odometry(
    source: Source,
    name: str,
    estimator: AnyEstimator,
    out: str | Path,
    *,
    smooth: Smoothing = "none",
    scale: ArrayLike | Literal["fit"] | None = None,
    start: Pose | None = None,
    frame: str = "mitsonar",
    every: int = 1,
    closure: int = 0,
    sensors: VehicleSensors | None = None,
    loops: bool = False,
    local_map: bool = False,
    workers: int = 1,
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
        smooth: see :func:`~mitsonar.mapping.odometry.odometry`.
        scale: see ``odometry``.
        start: see ``odometry``.
        frame: convention of ``estimated.tum`` and ``true.tum``: ``mitsonar``, ``ros-enu`` or ``ned``.
        every: see ``odometry``.
        closure: see ``odometry``.
        sensors: see ``odometry``.
        loops: see ``odometry``.
        local_map: see ``odometry``.
        workers: see ``odometry``.
        overwrite: replace an odometry run in the folder.
        resume: continue an interrupted run.
        progress: see ``odometry``.

    Raises:
        MitsonarError: as for ``odometry``; or the folder holds something else, or cannot be written.
    """
    convention_named(frame)
    run = RunDirectory.begin(
        out, ODOMETRY, _asked(source, name, estimator, every, sensors), resume=resume, overwrite=overwrite
    )
    folder = OdometryFolder(run)
    kept, begun = folder.kept() if folder.run.resumed else {}, time.perf_counter()
    asked = partial(odometry, smooth=smooth, scale=scale, start=start, every=every, closure=closure)
    pipeline = partial(asked, sensors=sensors, loops=loops, local_map=local_map, workers=workers, progress=progress)
    known_loops = folder.kept_loops() if folder.run.resumed else {}
    journals = partial(pipeline, known=kept, keep=folder.keep, known_loops=known_loops, keep_loop=folder.keep_loop)
    found = journals(source, estimator)
    settings = {
        **{"source": source.name, "inputs": estimator.inputs, "smooth": smooth, "scale": _named(scale), "frame": frame},
        **{**_found(found), "seconds": time.perf_counter() - begun},
        **{"pairs_in_these_seconds": len(found.estimates) - len(kept), "workers": workers},
        **{"closure": closure, "loops": loops, "local_map": local_map},
    }
    folder.write(found, f"{Path(source.name).name}, {name}", settings)
    return found


def _named(scale: ArrayLike | Literal["fit"] | None) -> str | None:
    return scale if isinstance(scale, str) or scale is None else "given"


def _found(found: Odometry) -> PlainTable:
    """Return the notes about the path for ``run.json``."""
    lost = int((~found.believed).sum())
    return {"factors": found.factors, "from": found.path.poses[0], "not_believed": lost, "warnings": found.warnings()}


def _asked(source: Source, name: str, estimator: AnyEstimator, every: int, sensors: VehicleSensors | None) -> PlainTable:
    """Return the options on which the estimates depend; a run can be resumed only with the same ones."""
    options: PlainTable = dataclasses.asdict(estimator) if dataclasses.is_dataclass(estimator) else {}
    return {
        **{"estimator": name, "options": options, "frames": len(source), "frames_sha256": source.digest(), "every": every},
        "height_m": source.told_height_m,
        "pitch_deg": None if source.pitch_rad is None else float(np.degrees(source.pitch_rad)),
        "noise": None if source.noise is None else {**source.noise.model_dump(), "seed": source.seed},
        **({} if sensors is None else {"sensors_sha256": sensors.digest()}),
    }


# ---------------- Files


def _save_tum(path: Path, trajectory: Trajectory, frame: str) -> None:
    part = path.with_name(f".{path.name}.part")
    trajectory.save(part, frame)
    part.replace(path)


def _motions_csv(found: Odometry) -> str:
    """Return a CSV table with one line per motion, in mm and deg; unknown standard deviations are empty."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    names = [f"{axis.name}_{axis.unit}" for axis in AXES]
    stds = [f"{axis.name}_std_{axis.unit}" for axis in AXES]
    table.writerow(["from_frame", "frame", "time_s", *names, *stds, "believed", "reason"])
    moved = in_units(found.series.motions)
    std = _std(found.series.covariances)
    for k, estimate in enumerate(found.estimates):
        deviations = ["", "", ""] if std is None else [f"{value:.6g}" for value in std[k]]
        numbers = [f"{value:.6f}" for value in moved[k]]
        frames = [int(found.frames[k]), int(found.frames[k + 1]), f"{found.series.time_s[k + 1]:.9g}"]
        table.writerow([*frames, *numbers, *deviations, int(estimate.valid), estimate.reason])
    return text.getvalue()


def _loops_csv(found: Odometry, loops: PoseEdges, kept: NDArray[np.bool_]) -> str:
    """Return a CSV table with one line per loop, in mm and deg."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    names = [f"{axis.name}_{axis.unit}" for axis in AXES]
    table.writerow(["from_frame", "frame", *names, *(f"{axis.name}_std_{axis.unit}" for axis in AXES), "kept"])
    moved, std = in_units(loops.motions), in_units(np.sqrt(np.diagonal(loops.covariances, axis1=1, axis2=2)))
    for k, (first, second) in enumerate(zip(loops.first, loops.second, strict=True)):
        numbers = [f"{value:.6f}" for value in moved[k]] + [f"{value:.6g}" for value in std[k]]
        table.writerow([int(found.frames[first]), int(found.frames[second]), *numbers, int(kept[k])])
    return text.getvalue()


def _std(covariances: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    return None if covariances is None else in_units(np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)))


def _covariances(found: Odometry) -> bytes:
    """Return an ``.npz`` file of times, motions and covariances in m and rad; unknown covariances are nan."""
    count = len(found.estimates)
    motions, poses = found.series.covariances, found.pose_covariances
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        time_s=found.series.time_s,
        frames=found.frames,
        motions=found.series.motions,
        believed=found.believed,
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


def _figure(found: Odometry, title: str) -> Figure:
    true = found.true_at_frames
    paths = {"estimated": found.path} | ({} if true is None else {"true": true})
    motions, poses = found.series.covariances, found.pose_covariances
    return path_figure(
        paths,
        motion_covariances=None if motions is None else {"estimated": motions},
        pose_covariances=None if poses is None else {"estimated": poses},
        title=title,
    )


# ---------------- Journals of estimates


LARGEST_JOURNAL = 2**30
"""Largest size of a journal [bytes]: some three million pairs."""

HEIGHTS = ("height_m", "height_std_m")
"""Height over the ground and its standard deviation [m], which an estimator may report."""


def add_to_journal(path: Path, of: PlainTable, estimate: Estimate) -> None:
    """Append an estimate to a journal as one JSON line, which preserves every bit of its numbers.

    Args:
        path: path of the journal.
        of: identifies the estimate: its ``pair``; or its ``first`` and ``second`` frame and the initial ``guess``.
        estimate: estimate to append.
    """
    covariance = None if estimate.covariance is None else np.asarray(estimate.covariance, dtype=float).tolist()
    motion = [float(value) for value in estimate.motion]
    line = of | {"motion": motion, "covariance": covariance, "valid": bool(estimate.valid)}
    about = {name: estimate.about[name] for name in ("modes", "spreads", *HEIGHTS) if name in estimate.about}
    text = json.dumps(line | {"reason": estimate.reason} | ({"about": about} if about else {})) + "\n"
    with path.open("a", encoding="utf-8") as file:
        file.write(text)


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
            found = _estimate_in(line, names)
        except Exception:  # a damaged line may raise anything
            raise MitsonarError(f"{path}, line {number} is damaged: start over with --overwrite") from None
        yield found


def _estimate_in(line: bytes, names: tuple[str, ...]) -> tuple[PlainTable, Estimate]:
    """Parse and validate a line. A damaged line raises an exception of some kind."""
    table = parse_json(line, "the line")
    covariance = None if table["covariance"] is None else np.array(table["covariance"], dtype=float)
    motion = np.array(table["motion"], dtype=float)
    if motion.shape != (3,) or not isinstance(table["reason"], str) or type(table["valid"]) is not bool:
        raise ValueError("motion, reason or valid is of another type")
    if table["valid"] and not np.isfinite(motion).all():
        raise ValueError("the motion is not finite")
    if covariance is not None and (covariance.shape != (3, 3) or (np.diagonal(covariance) < 0).any()):
        raise ValueError("covariance is not a covariance")
    about = table.get("about", {})
    if not isinstance(about, dict):
        raise ValueError("about is no table")
    for name in set(HEIGHTS) & set(about):
        finite_number(about[name], name, above=0)
    of: PlainTable = {name: whole_number(table[name], name, 0, 2**40) for name in names}
    if "first" in names:
        of["guess"] = Motion(*(float(value) for value in np.array(table["guess"], dtype=float).reshape(3)))
    return of, Estimate(Motion(*(float(value) for value in motion)), covariance, table["valid"], table["reason"], about)
