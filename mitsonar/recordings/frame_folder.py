"""A part of a recording as the folder of a run, ``frames.zarr`` or ``frames.npz``, that can be resumed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from mitsonar.errors import MitsonarError
from mitsonar.io.runs import RunDirectory, RunKind
from mitsonar.recordings.recording import Part, Recording
from mitsonar.records.frames import LONGEST_NPZ, FrameStore

__all__ = ["CONVERSION", "write_frames"]

CONVERSION = RunKind("recording", ("frames.npz", "frames.zarr"), {"frames": int, "frames_done": int})

CHUNK_BYTES = 32 * 2**20
"""Approximate size of the pixels that are copied at a time [bytes]."""


def write_frames(
    recording: Recording,
    number: int | None,
    folder: str | Path,
    *,
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Copy a part of a recording into the folder of a run, in constant memory; a stopped copy can be resumed.

    Args:
        recording: any.
        number: of the part; None: the longest.
        folder: to make.
        overwrite: replace a copy that is there.
        resume: go on with one.
        progress: called with how many more frames are copied.

    Returns:
        ``frames.npz`` of at most 1,000 frames, or ``frames.zarr`` of more.

    Raises:
        MitsonarError: the folder holds other things, or a copy that is neither resumed nor replaced.
    """
    part = recording.part(number)
    chosen = recording.longest if number is None else number
    asked = {"of": recording.name, "format": recording.format, "part": chosen, "frames": len(part)}
    run = RunDirectory.begin(folder, CONVERSION, asked, resume=resume, overwrite=overwrite)
    run.start(frames=len(part), frames_done=0)
    told = progress or (lambda done: None)
    packed, path = run.path / "frames.npz", run.path / "frames.zarr"
    if run.finished and (packed.exists() or path.exists()):
        told(len(part))
        return packed if packed.exists() else path
    store, done = _store(run, recording, part, path)
    told(done)
    step = max(1, CHUNK_BYTES // (part.like.image.dtype.itemsize * len(part.like.range_m) * len(part.like.bearing_rad)))
    for start in range(done, len(part), step):
        frames = part.read(np.arange(start, min(start + step, len(part))))
        store.write(start, frames)
        run.note(frames_done=start + len(frames))
        told(len(frames))
    if len(part) <= LONGEST_NPZ:
        store.pack(packed)
    run.finish()
    return packed if packed.exists() else path


def _store(run: RunDirectory, recording: Recording, part: Part, path: Path) -> tuple[FrameStore, int]:
    """Return the store that is there, or a new one, and how many frames it holds."""
    if run.resumed and path.exists():
        store = FrameStore.open(path)
        done = min(run.count("frames_done", len(part)), store.done)
        store.check(len(part), part.like.sonar, done)
        return store, done
    if run.resumed and run.count("frames_done", len(part)):
        raise MitsonarError(f"{path} is gone, though run.json says that it was begun: copy again with --overwrite")
    about = {"recording": recording.name, "format": recording.format, "notes": list(recording.notes)}
    return FrameStore.create(path, len(part), replace(part.read([]), about=about)), 0
