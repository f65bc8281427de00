"""How a synthetic aperture is written to a folder: responses are measured, focused block by block, and drawn."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.io.files import read_npz
from mitsonar.io.runs import RunDirectory, RunKind
from mitsonar.mapping.synthetic_aperture import BLOCK_ROWS, BackProjector, Weighting
from mitsonar.plotting.figures import save_sounding_figure, strip_figure
from mitsonar.records.responses import ImpulseResponses
from mitsonar.records.strips import StripGrid, StripImage

__all__ = ["SYNTHETIC_APERTURE", "ApertureReport", "run_aperture"]


SYNTHETIC_APERTURE = RunKind(
    "synthetic aperture",
    outputs=("responses", "parts", "image.npz", "image.png"),
    notes={"measured": int, "rows_done": int, "warnings": list},
    packages=("mitsonar", "numpy", "scipy"),
    deciding=("mitsonar", "numpy", "scipy"),
)
"""The files of a run. ``parts`` holds focused blocks until ``image.npz`` is written."""

Measure = Callable[[Path, bool], list[str]]
"""Writes responses into a folder, or resumes it, and returns warnings."""


@dataclass(frozen=True)
class ApertureReport:
    """Image and warnings of a run."""

    image: StripImage
    warnings: list[str]


def run_aperture(
    folder: str | Path,
    settings: Mapping[str, Any],
    measure: Measure,
    grid: StripGrid,
    weighting: Weighting = "uniform",
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
        grid: the pixels.
        weighting: weights over the processed beam.
        title: title of the picture.
        resume: continue an interrupted run.
        overwrite: replace an existing run.
        begin: called with the number of rows that an earlier run has focused, before more are.
        progress: called with the number of new rows.

    Raises:
        MitsonarError: the folder exists; the run to resume has other settings; an aliased aperture; a damaged part.
    """
    every = {**settings, "grid": asdict(grid), "weighting": weighting}
    run = RunDirectory.begin(folder, SYNTHETIC_APERTURE, every, resume=resume, overwrite=overwrite)
    run.start(measured=0, rows_done=0)
    if not run.finished:
        inner = run.path / "responses"
        # only a folder that this run has begun is resumed
        warnings = measure(inner, inner.exists())
        run.note(measured=1, warnings=warnings)
        responses = ImpulseResponses.load(inner / "responses.zarr", stored=True)
        _focus_into(run, BackProjector(responses, grid, weighting), begin, progress)
        image = _joined(run, grid)
        image.save(run.path / "image.npz")
        figure = strip_figure(image, title=title)
        save_sounding_figure(figure, run.path / "image.png")
        run.finish()
    shutil.rmtree(run.path / "parts", ignore_errors=True)
    return ApertureReport(StripImage.load(run.path / "image.npz"), [str(one) for one in run.notes.get("warnings") or []])


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
            if block.dtype != np.complex64:
                raise ValueError(f"values of type {block.dtype}")
            value[rows] = block
        except Exception as error:  # damaged bytes raise errors of many kinds
            reason = " ".join(str(error).split())[:200]
            raise MitsonarError(f"{path} is damaged ({reason}): start again with --overwrite") from None
    return StripImage(value, grid)
