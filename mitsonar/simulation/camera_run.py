"""Pictures of a camera on disk: PNG files as they are made; a run that is killed goes on."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path

from PIL import Image

from mitsonar.io.files import write_whole
from mitsonar.io.runs import RunDirectory, RunKind, digest
from mitsonar.motion.trajectory import Trajectory
from mitsonar.simulation.camera import CameraSimulator, told_of
from mitsonar.simulation.render_run import SIMULATORS
from mitsonar.simulation.variant import current_variant

__all__ = ["PHOTOGRAPHS", "run_camera"]

PHOTOGRAPHS = RunKind(
    "photographs",
    outputs=("images", "poses.tum"),
    notes={"frames_done": int},
    packages=SIMULATORS,
    deciding=SIMULATORS[:3],
)


def run_camera(
    simulator: CameraSimulator,
    flown: Trajectory,
    folder: str | Path,
    *,
    origin: Mapping[str, object],
    frame: str = "mitsonar",
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[int], None] = lambda frames: None,
) -> None:
    """Make a folder of pictures, or go on with one: ``images/000000.png`` ..., ``poses.tum``, ``run.json``.

    Args:
        simulator: scene and camera.
        flown: poses and times of the camera.
        folder: of the run.
        origin: what repeats the run beside the path.
        frame: the convention of ``poses.tum``.
        overwrite: replace a run that is there.
        resume: go on with a run that was broken off.
        progress: called with the number of new pictures.

    Raises:
        MitsonarError: the folder exists; the run to resume was another one; the folder cannot be written.
    """
    asked = {**origin, "variant": current_variant(), "camera": told_of(simulator.camera), "frames": len(flown)}
    asked |= {"samples": simulator.samples, "frame": frame}
    asked["poses_sha256"] = digest(flown.poses.tobytes(), flown.time_s.tobytes())
    run = RunDirectory.begin(folder, PHOTOGRAPHS, asked, resume=resume, overwrite=overwrite)
    run.start(frames_done=0)
    if run.finished:
        return
    flown.save(run.path / "poses.tum", frame)
    (run.path / "images").mkdir(exist_ok=True)
    done = _whole(run.path, run.count("frames_done", len(flown)))
    progress(done)
    for number, picture in enumerate(simulator.pictures(flown.poses[done:], flown.time_s[done:], first=done), done):
        buffer = io.BytesIO()
        Image.fromarray(picture).save(buffer, format="PNG")
        write_whole(_picture(run.path, number), buffer.getvalue())
        run.note(frames_done=number + 1)
        progress(1)
    run.finish()


def _picture(folder: Path, number: int) -> Path:
    """Return the file of a picture."""
    return folder / "images" / f"{number:06d}.png"


def _whole(folder: Path, done: int) -> int:
    """Return how many of the first pictures are there: one that was deleted is made again, and those after it."""
    return next((number for number in range(done) if not _picture(folder, number).is_file()), done)
