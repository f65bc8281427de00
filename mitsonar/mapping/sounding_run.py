"""Runs of sounders on disk: parts as they are rendered, then the files of each kind; a run that is killed goes on."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, counted
from mitsonar.io.files import read_npz
from mitsonar.io.runs import RunDirectory, RunKind, digest
from mitsonar.mapping.dvl_sensors import dvl_sensors
from mitsonar.motion.sensors import save_sensors
from mitsonar.motion.trajectory import Trajectory
from mitsonar.plotting import figures
from mitsonar.recordings.write_xtf import write_xtf
from mitsonar.records.soundings import Echogram, Soundings
from mitsonar.simulation.dvl import dvl_readings
from mitsonar.simulation.render_run import SIMULATORS
from mitsonar.simulation.sounding import SoundedPings, SounderSimulator

__all__ = ["SOUNDINGS", "SoundingReport", "run_sounder"]

SOUNDINGS = RunKind(
    "sounding",
    outputs=(
        *("parts", "echogram.npz", "echogram.png", "sidescan.xtf", "waterfall.png", "soundings.npz", "soundings.csv"),
        *("soundings.ply", "soundings.png", "range.png", "dvl.csv", "dvl.png", "sensors.csv", "poses.tum"),
    ),
    notes={"pings_done": int, "warnings": list},
    packages=SIMULATORS,
    deciding=SIMULATORS[:3],
)

WITH_LEVELS = ("sidescan", "altimeter")
"""Kinds that keep all levels, and not detections alone."""

DETECTED = ("range_m", "level_db", "quality")


@dataclass(frozen=True)
class SoundingReport:
    """What a run did.

    Attributes:
        folder: of the run.
        files: that were written, by name.
        found: beams with an echo, of ``beams``.
        beams: of all pings.
        warnings: sentences on what a user should know.
    """

    folder: Path
    files: list[str]
    found: int
    beams: int
    warnings: list[str]


def run_sounder(
    simulator: SounderSimulator,
    flown: Trajectory,
    folder: str | Path,
    *,
    origin: Mapping[str, object],
    frame: str = "mitsonar",
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[int], None] = lambda pings: None,
) -> SoundingReport:
    """Make a run's folder, or go on with one.

    Args:
        simulator: scene and instrument.
        flown: poses of the vehicle and times of the pings.
        folder: is made; holds ``run.json``, ``poses.tum`` and the files of the kind of instrument.
        origin: what repeats the run beside instrument and path.
        frame: the convention of ``poses.tum``.
        overwrite: replace a run that is there.
        resume: go on with a run that was broken off.
        progress: called with the number of new pings.

    Raises:
        MitsonarError: the folder exists; the run to resume was another one; the folder cannot be written.
    """
    sounder = simulator.sounder
    asked = {**origin, "variant": simulator.variant, "sounder": sounder.model_dump(mode="json"), "pings": len(flown)}
    asked |= {"poses_sha256": digest(flown.poses.tobytes(), flown.time_s.tobytes()), "frame": frame}
    run = RunDirectory.begin(folder, SOUNDINGS, asked, resume=resume, overwrite=overwrite)
    run.start(pings_done=0)
    flown.save(run.path / "poses.tum", frame)
    if not run.finished:
        progress(run.count("pings_done", len(flown)))
        _render(simulator, flown, run, progress)
        parts = _joined(run.path / "parts", len(flown))
        soundings = Soundings(flown.time_s, flown.poses, sounder, *(parts[name] for name in DETECTED))
        warnings = [*simulator.notes, *_write(run.path, soundings, parts)]
        run.finish(warnings=warnings)
    shutil.rmtree(run.path / "parts", ignore_errors=True)
    return _report(run, Soundings.load(run.path / "soundings.npz"))


def _render(simulator: SounderSimulator, flown: Trajectory, run: RunDirectory, progress: Callable[[int], None]) -> None:
    """Render the pings that are missing, a part a batch."""
    folder, done = run.path / "parts", run.count("pings_done", len(flown))
    folder.mkdir(exist_ok=True)
    if done == len(flown):
        return
    for batch in simulator.pings(flown.poses[done:], first=done, time_s=flown.time_s[done:]):
        part = folder / f"{batch.first:09d}.npz"
        whole = part.with_suffix(".part")
        with whole.open("wb") as file:
            np.savez(file, **_kept(simulator, batch))  # type: ignore[arg-type]  # the stubs take allow_pickle for a name
        whole.replace(part)
        run.note(pings_done=batch.first + len(batch.levels))
        progress(len(batch.levels))


def _kept(simulator: SounderSimulator, batch: SoundedPings) -> dict[str, NDArray[Any]]:
    """Return what is kept of a batch."""
    detected = simulator.detect(batch.levels)
    kept: dict[str, NDArray[Any]] = dict(zip(DETECTED, detected, strict=True))
    if simulator.sounder.kind in WITH_LEVELS:
        kept |= {"levels": batch.levels[..., 0], "height_m": batch.height_m}
    return kept


def _joined(folder: Path, pings: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of all parts.

    Raises:
        MitsonarError: a part is missing or damaged.
    """
    try:
        parts = [read_npz(path) for path in sorted(folder.glob("*.npz"))]
        joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    except Exception as error:  # damaged bytes raise errors of many kinds
        raise MitsonarError(f"{folder} is damaged ({error}): begin anew with --overwrite") from None
    if len(joined["range_m"]) != pings:
        raise MitsonarError(f"{folder} holds {len(joined['range_m'])} pings of {pings}: begin anew with --overwrite")
    return joined


def _write(folder: Path, soundings: Soundings, parts: Mapping[str, NDArray[Any]]) -> list[str]:
    """Write the files of the kind of instrument; return what a user should know."""
    kind, notes = soundings.sounder.kind, []
    if kind in WITH_LEVELS:
        levels, height_m = parts["levels"], parts["height_m"]
        echogram = Echogram(soundings.time_s, soundings.poses, soundings.sounder, levels, height_m)
        echogram.save(folder / "echogram.npz")
        _draw(folder, echogram, soundings)
    if not soundings.found.any():
        notes.append("no beam of any ping has an echo: move the window (range_min, range_max), or come nearer")
    elif kind == "dvl":
        notes += _write_dvl(folder, soundings)
    elif kind != "sidescan":
        notes += _write_points(folder, soundings)
    soundings.save(folder / "soundings.npz")
    return notes


def _draw(folder: Path, echogram: Echogram, soundings: Soundings) -> None:
    """Write the pictures of an echogram, and a side-scan's XTF file."""
    if echogram.sounder.kind == "sidescan":
        write_xtf(folder / "sidescan.xtf", echogram)
        figures.save_sounding_figure(figures.waterfall_figure_of(echogram), folder / "waterfall.png")
    else:
        figures.save_sounding_figure(figures.echogram_figure(echogram, soundings), folder / "echogram.png")


def _write_dvl(folder: Path, soundings: Soundings) -> list[str]:
    """Write the readings of a DVL, and the file that odometry takes."""
    readings = dvl_readings(soundings, soundings.sounder.fan.seed)
    readings.save(folder / "dvl.csv")
    figures.save_sounding_figure(figures.dvl_figure(readings), folder / "dvl.png")
    lost = int((~readings.locked).sum())
    if lost == len(readings.locked):
        return ["the DVL has no bottom lock in any ping: there is no sensors.csv"]
    save_sensors(folder / "sensors.csv", dvl_sensors(readings))
    return [f"the DVL lost the bottom in {lost} of {counted(len(readings.locked), 'ping')}"] if lost else []


def _write_points(folder: Path, soundings: Soundings) -> list[str]:
    """Write soundings as tables, point clouds and pictures."""
    soundings.save(folder / "soundings.csv")
    if soundings.sounder.kind == "altimeter":
        return []
    drawn = figures.soundings_figure(soundings)
    figures.save_sounding_figure(drawn, folder / "soundings.png")
    if soundings.sounder.kind == "range-image":
        figures.save_sounding_figure(figures.range_figure(soundings), folder / "range.png")
    if find_spec("trimesh") is None:
        return ["there is no soundings.ply without trimesh: pip install 'mitsonar[meshes]'"]
    soundings.save(folder / "soundings.ply")
    return []


def _report(run: RunDirectory, soundings: Soundings) -> SoundingReport:
    """Return what a finished run holds."""
    files = [name for name in SOUNDINGS.outputs if (run.path / name).is_file()]
    warnings = [str(one) for one in run.notes.get("warnings") or []]
    return SoundingReport(run.path, files, int(soundings.found.sum()), soundings.found.size, warnings)
