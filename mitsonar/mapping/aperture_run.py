"""How a synthetic aperture is written to a folder: responses are measured, focused block by block, and drawn."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.io.files import read_npz, write_atomic
from mitsonar.io.runs import RunDirectory, RunKind, digest
from mitsonar.mapping.micronavigation import MicroNavigation, autofocus, displaced_phase_centres
from mitsonar.mapping.synthetic_aperture import BLOCK_ROWS, BackProjector, Weighting
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.plotting.figures import save_sounding_figure, strip_figure
from mitsonar.records.responses import ImpulseResponses
from mitsonar.records.strips import StripGrid, StripImage

__all__ = ["CORRECTIONS", "SYNTHETIC_APERTURE", "ApertureOptions", "ApertureReport", "Correction", "run_aperture"]


SYNTHETIC_APERTURE = RunKind(
    "synthetic aperture",
    outputs=("responses", "parts", "corrected.npz", "micronavigation.csv", "corrected.tum", "image.npz", "image.png"),
    notes={"measured": int, "rows_done": int, "warnings": list},
    packages=("mitsonar", "numpy", "scipy"),
    deciding=("mitsonar", "numpy", "scipy"),
)
"""The files of a run. ``parts`` holds focused blocks until ``image.npz`` is written."""

Correction = Literal["dpc", "autofocus"]

CORRECTIONS: tuple[Correction, ...] = ("dpc", "autofocus")
"""Corrections of the path: by displaced phase centres and by autofocus, in this order."""


@dataclass(frozen=True)
class ApertureOptions:
    """How responses are focused.

    Attributes:
        grid: the pixels.
        weighting: weights over beam and band.
        navigation: poses that focusing assumes; default: those at which the responses were measured.
        corrections: corrections of the path.
    """

    grid: StripGrid
    weighting: Weighting = "uniform"
    navigation: Trajectory | None = None
    corrections: tuple[Correction, ...] = ()


Measure = Callable[[Path, bool], list[str]]
"""Writes responses into a folder, or resumes it, and returns warnings."""


@dataclass(frozen=True)
class ApertureReport:
    """Image and warnings of a run, and its micronavigation if this run has computed it."""

    image: StripImage
    warnings: list[str]
    micronavigation: MicroNavigation | None = None


def run_aperture(
    folder: str | Path,
    settings: Mapping[str, Any],
    measure: Measure,
    options: ApertureOptions,
    *,
    title: str = "",
    resume: bool = False,
    overwrite: bool = False,
    begin: Callable[[int], None] = lambda rows: None,
    progress: Callable[[int], None] = lambda rows: None,
) -> ApertureReport:
    """Measure and focus a synthetic aperture into a run folder, or resume an interrupted run.

    Responses stay on disk while they are focused. A killed run loses at most one ping group or one block of rows.

    Args:
        folder: folder of the run.
        settings: what determines the responses.
        measure: writes the responses into a folder.
        options: how they are focused.
        title: title of the picture.
        resume: continue an interrupted run.
        overwrite: replace an existing run.
        begin: called with the number of rows that an earlier run has focused, before more are.
        progress: called with the number of new rows.

    Raises:
        MitsonarError: the folder exists; the run to resume has other settings; an aliased aperture; a damaged part.
    """
    grid, path = options.grid, options.navigation
    every = {
        **settings,
        "grid": asdict(grid),
        "weighting": options.weighting,
        "navigation": None if path is None else digest(path.poses.tobytes(), path.time_s.tobytes()),
        "corrections": list(options.corrections),
    }
    run = RunDirectory.begin(folder, SYNTHETIC_APERTURE, every, resume=resume, overwrite=overwrite)
    run.start(measured=0, rows_done=0)
    micro: MicroNavigation | None = None
    if not run.finished:
        inner = run.path / "responses"
        # only a folder that this run has begun is resumed
        warnings = measure(inner, inner.exists())
        run.note(measured=1, warnings=warnings)
        responses = _navigated(ImpulseResponses.load(inner / "responses.zarr", stored=True), options.navigation)
        places, micro = _corrected(run, responses, options)
        _focus_into(run, BackProjector(responses, grid, options.weighting, places), begin, progress)
        image = _joined(run, grid)
        image.save(run.path / "image.npz")
        figure = strip_figure(image, title=title)
        save_sounding_figure(figure, run.path / "image.png")
        run.finish()
    shutil.rmtree(run.path / "parts", ignore_errors=True)
    warned = [str(one) for one in run.notes.get("warnings") or []]
    return ApertureReport(StripImage.load(run.path / "image.npz"), warned, micro)


def _navigated(responses: ImpulseResponses, navigation: Trajectory | None) -> ImpulseResponses:
    """Return responses with the poses of a navigation.

    Raises:
        MitsonarError: it does not cover the pings.
    """
    if navigation is None:
        return responses
    first, last = (float(responses.time_s[k]) for k in (0, -1))
    begin, end = (float(navigation.time_s[k]) for k in (0, -1))
    if begin > first + 1e-6 or end < last - 1e-6:
        raise MitsonarError(
            f"the navigation must cover the pings, {first:.15g} to {last:.15g} s: got {begin:.15g} to {end:.15g} s"
        )
    flown = Trajectory(navigation.at(responses.time_s), responses.time_s)
    return replace(responses, poses=flown.poses, velocity=velocities(flown))


def _corrected(
    run: RunDirectory, responses: ImpulseResponses, options: ApertureOptions
) -> tuple[NDArray[np.float64] | None, MicroNavigation | None]:
    """Return the corrected positions of the pings, or those that an earlier run has stored."""
    if not options.corrections:
        return None, None
    stored = run.path / "corrected.npz"
    if stored.exists():
        try:
            places = read_npz(stored)["places"]
            if places.shape != (len(responses), 3) or places.dtype != np.float64 or not np.isfinite(places).all():
                raise ValueError("its positions do not fit the pings")
        except Exception as error:  # damaged bytes raise errors of many kinds
            reason = " ".join(str(error).split())[:200]
            raise MitsonarError(f"{stored} is damaged ({reason}): start again with --overwrite") from None
        return places, None
    micro, path = None, None
    if "dpc" in options.corrections:
        micro = displaced_phase_centres(responses)
        path = micro.path
        _write_micronavigation(run.path / "micronavigation.csv", micro)
    if "autofocus" in options.corrections:
        path = autofocus(responses, options.grid, path=path)
    assert path is not None
    poses = np.column_stack([path, np.asarray(responses.poses)[:, 3:]])
    Trajectory(poses, responses.time_s).save(run.path / "corrected.tum")
    buffer = io.BytesIO()
    np.savez(buffer, places=path)
    write_atomic(stored, buffer.getvalue())
    return path, micro


def _write_micronavigation(path: Path, micro: MicroNavigation) -> None:
    """Write a line for each pair of pings."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["pair", "sway_m", "sway_std_m", "advance_m", "coherence"])
    columns = (micro.sway_m, micro.sway_std_m, micro.advance_m, micro.coherence)
    for pair, row in enumerate(zip(*columns, strict=True)):
        writer.writerow([pair, *(f"{value:.6g}" for value in row)])
    write_atomic(path, text.getvalue().encode())


def _focus_into(
    run: RunDirectory, projector: BackProjector, begin: Callable[[int], None], progress: Callable[[int], None]
) -> None:
    """Focus the missing blocks, each into a file of ``parts``."""
    folder, rows = run.path / "parts", projector.grid.rows
    folder.mkdir(exist_ok=True)
    done = run.count("rows_done", rows) // BLOCK_ROWS * BLOCK_ROWS
    if run.count("rows_done", rows) == rows:
        done = rows
    begin(done)
    for part, block in projector.blocks(done) if done < rows else ():
        whole = folder / f"{part.start:09d}.part"
        with whole.open("wb") as file:
            np.savez(file, value=block)
        whole.replace(whole.with_suffix(".npz"))
        run.note(rows_done=part.stop)
        progress(len(block))


def _joined(run: RunDirectory, grid: StripGrid) -> StripImage:
    """Read all blocks and return the image.

    Raises:
        MitsonarError: a part is missing or damaged.
    """
    value: NDArray[np.complex64] = np.zeros((grid.rows, grid.columns), np.complex64)
    for start in range(0, grid.rows, BLOCK_ROWS):
        path, rows = run.path / "parts" / f"{start:09d}.npz", slice(start, min(start + BLOCK_ROWS, grid.rows))
        try:
            block = read_npz(path)["value"]
            if block.dtype != np.complex64 or block.shape != value[rows].shape:
                raise ValueError(f"values of type {block.dtype} and shape {block.shape}")
            value[rows] = block
        except Exception as error:  # damaged bytes raise errors of many kinds
            reason = " ".join(str(error).split())[:200]
            raise MitsonarError(f"{path} is damaged ({reason}): start again with --overwrite") from None
    return StripImage(value, grid)
