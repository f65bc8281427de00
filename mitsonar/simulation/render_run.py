"""Runs on disk: frames, pictures and echoes are written as they are made; a run that is killed goes on to the same bits."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar, TimedPath, overlap_notes, timed_path
from mitsonar.io.files import write_whole
from mitsonar.io.runs import RunDirectory, RunKind, digest
from mitsonar.motion.bodies import BodyStates
from mitsonar.motion.trajectory import Trajectory
from mitsonar.plotting.fans import FanPictures, save_fan
from mitsonar.records.echoes import Echoes, load_exr, save_exr
from mitsonar.records.frames import LONGEST_NPZ, FrameStore, SonarFrames, to_uint8
from mitsonar.simulation.device_arrays import padded
from mitsonar.simulation.labels import labels_above
from mitsonar.simulation.rendered_pings import RenderedPings, constant_gain, to_image
from mitsonar.simulation.tally import Tally
from mitsonar.simulation.variant import ensure_variant

__all__ = [
    "RENDERING",
    "SIMULATORS",
    "Outputs",
    "Progress",
    "RenderReport",
    "Source",
    "StoredEchoes",
    "progress_of",
    "run",
]

SIMULATORS = ("mitsonar", "mitsuba", "drjit", "numpy")
"""Packages that decide what is simulated, to the last bit."""

RENDERING = RunKind(
    "rendering",
    outputs=("frames.npz", "frames.zarr", "images", "cartesian", "fan", "echoes", "bodies", "poses.tum"),
    notes={
        **{"frames_done": int, "gain": float, "tally": dict, "warnings": list},
        **{"shape_names": list, "object_names": list},
    },
    packages=SIMULATORS,
    deciding=SIMULATORS[:3],
)


class Source(Protocol):
    """Where levels come from: a simulator that traces, or echoes that were stored."""

    sonar: Sonar
    notes: list[str]
    variant: str

    def pings(
        self, poses: ArrayLike, *, first: int = 0, labels: bool = False, time_s: ArrayLike | None = None
    ) -> Iterator[RenderedPings]:
        """Levels of consecutive pings, in batches."""

    def film_echoes(self, pose: ArrayLike, ping: int, time_s: float | None = None) -> Echoes:
        """One ping's echoes in the order of the film."""

    def bodies(self, time_s: ArrayLike) -> BodyStates:
        """Return the names of the bodies that move, their poses and velocities at times."""

    def window_range(self, pose: ArrayLike, ping: int) -> tuple[float, float] | None:
        """Nearest and farthest return outside the window [m]."""

    def buried(self, pose: ArrayLike) -> str:
        """Describe where a pose lies below the ground or inside an object; empty where it does not."""

    def label_names(self, labels: bool = True) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the names that labels refer to, of shapes and of objects; none without labels."""


@dataclass(frozen=True)
class Outputs:
    """What a run writes beside its frames.

    Attributes:
        noise: that is added.
        labels: per-pixel truth.
        cartesian: a figure with axes for each frame.
        exr: the echoes of each ray.
        frame: the convention of ``poses.tum``.
        fan: a plain fan picture for each frame, and of its labels.
        label_floor: part of full scale above which a pixel is labelled.
    """

    noise: NoiseModel
    labels: bool = False
    cartesian: bool = False
    exr: bool = False
    frame: str = "mitsonar"
    fan: bool = False
    label_floor: float = 0.0


@dataclass(frozen=True)
class RenderReport:
    """What a run did."""

    folder: Path
    frames: int
    pictures: list[Path]
    warnings: list[str]


def run(
    source: Source,
    trajectory: Trajectory,
    folder: str | Path,
    outputs: Outputs,
    *,
    origin: dict[str, Any],
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[int], None] = lambda frames: None,
) -> RenderReport:
    """Make a run's folder, or go on with one.

    Args:
        source: where levels come from.
        trajectory: poses and times.
        folder: is made; holds ``frames.npz`` (or ``frames.zarr``), ``images/``, ``poses.tum``, ``run.json`` and what
            ``outputs`` asks for.
        outputs: what is written.
        origin: what repeats the run beside sonar, poses and outputs: scene, its digest, parameters.
        overwrite: replace a run that is there.
        resume: go on with a run that was broken off.
        progress: called with the number of frames that were added.

    Raises:
        MitsonarError: the folder exists; the run to resume was another one; the folder cannot be written.
    """
    timed = timed_path(source.sonar, trajectory)
    if outputs.exr and timed.time_s.ndim > 1:
        raise MitsonarError("echoes of each ray are kept of frames that are one ping: leave --exr or ping_groups out")
    asked = {**_asked(source, trajectory, outputs, origin), "frames": len(timed.frames)}
    made = RunDirectory.begin(folder, RENDERING, asked, resume=resume, overwrite=overwrite)
    made.start(frames_done=0)
    trajectory = timed.frames
    trajectory.save(made.path / "poses.tum", outputs.frame)
    _save_bodies(source, trajectory, made.path / "bodies", outputs.frame)
    if (made.path / "frames.npz").exists():  # finished, or killed while the store was removed
        shutil.rmtree(made.path / "frames.zarr", ignore_errors=True)
    elif not made.finished:
        progress(made.count("frames_done", len(trajectory)))
        store = _make_frames(source, timed, made, outputs, progress)
        tally = progress_of(made, source.sonar, len(trajectory)).tally
        notes = [*source.notes, *overlap_notes(source.sonar, trajectory.time_s)]
        made.note(warnings=[*notes, *tally.warnings(source, trajectory.poses)])
        if len(trajectory) <= LONGEST_NPZ:
            store.pack(made.path / "frames.npz")
    if not made.finished:
        made.finish()
    pictures = "cartesian" if outputs.cartesian else "fan" if outputs.fan else "images"
    found = sorted((made.path / pictures).glob("[0-9]*[0-9].png"))
    return RenderReport(made.path, len(trajectory), found, made.notes.get("warnings") or [])


def _asked(source: Source, trajectory: Trajectory, outputs: Outputs, origin: dict[str, Any]) -> dict[str, Any]:
    """All that decides the bits of a run."""
    return {
        **origin,
        "variant": source.variant,
        "sonar": source.sonar.model_dump(),
        "frames": len(trajectory),
        "poses_sha256": digest(trajectory.poses.tobytes(), trajectory.time_s.tobytes()),
        "noise": outputs.noise.model_dump(),
        "labels": outputs.labels,
        "cartesian": outputs.cartesian,
        "exr": outputs.exr,
        "frame": outputs.frame,
        "fan": outputs.fan,
        "label_floor": outputs.label_floor,
    }


def _save_bodies(source: Source, trajectory: Trajectory, folder: Path, frame: str) -> None:
    """Write the path of each body that moves, a file each, at the times of the frames."""
    names, poses, _ = source.bodies(trajectory.time_s)
    for number, name in enumerate(names):
        assert poses is not None
        folder.mkdir(exist_ok=True)
        Trajectory(poses[:, number], trajectory.time_s).save(folder / f"{name.replace('/', '_')}.tum", frame)


def _make_frames(
    source: Source, timed: TimedPath, made: RunDirectory, outputs: Outputs, progress: Callable[[int], None]
) -> FrameStore:
    """Write the frames that are missing; the run's notes follow each batch."""
    trajectory = timed.frames
    folder, earlier, store = made.path, progress_of(made, source.sonar, len(trajectory)), None
    done, tally, gain = earlier.frames, earlier.tally, earlier.gain
    if done > 0:
        store = FrameStore.open(folder / "frames.zarr")
        store.check(len(trajectory), source.sonar, done)
    if store is not None and done == len(trajectory):
        return store
    batches = source.pings(timed.poses[done:], first=done, labels=outputs.labels, time_s=timed.time_s[done:])
    names = source.label_names(outputs.labels)
    if outputs.labels:
        made.notes |= {"shape_names": list(names[0]), "object_names": list(names[1])}
    if done == 0:
        gain, batches = constant_gain(batches)
        made.notes["gain"] = gain
    for pings in batches:
        frames, image = _frames_of(pings, source, timed, outputs, gain, names)
        store = store or FrameStore.create(folder / "frames.zarr", len(trajectory), frames)
        _write_pictures(folder, pings.first, frames, outputs)
        if outputs.exr:
            _write_echoes(folder, source, frames, pings.first)
        store.write(pings.first, frames)
        tally.add(pings, image)
        made.note(frames_done=pings.first + len(pings), tally=tally.state())
        progress(len(pings))
    assert store is not None
    return store


@dataclass(frozen=True)
class Progress:
    """How far a run is: frames that are written, the gain of all frames (1 before the first), and what they add up to."""

    frames: int
    gain: float
    tally: Tally


def progress_of(made: RunDirectory, sonar: Sonar, frames: int) -> Progress:
    """How far a run of ``frames`` frames is, from its file.

    Raises:
        MitsonarError: the file is damaged.
    """
    done = made.count("frames_done", frames)
    if done == 0:
        return Progress(0, 1.0, Tally(sonar))
    gain = made.amount("gain")
    if gain is None:
        raise made.damage("it tells no gain")
    try:
        tally = Tally.restore(sonar, made.notes.get("tally", {}))
    except MitsonarError as error:
        raise made.damage(error) from None
    if tally.frames != done:
        raise made.damage(f"frames_done is {done}, the tally counts {tally.frames:,} frames")
    return Progress(done, gain, tally)


class StoredEchoes:
    """The echoes of a run that was rendered with ``--exr``, as a source: bins again, without tracing.

    Args:
        folder: the run.
        sonar: other bins or window than the run's; default: the run's own.

    Raises:
        MitsonarError: no run, or one without echoes.
    """

    def __init__(self, folder: str | Path, *, bins: int | None = None, window: tuple[float, float] | None = None) -> None:
        self.variant = ensure_variant()
        self.folder = Path(folder)
        self.asked = RunDirectory.open(folder, RENDERING).asked
        if not (self.folder / "echoes").is_dir():
            raise MitsonarError(f"{folder} holds no echoes: render the run with --exr first")
        frames = SonarFrames.load(self.folder)
        if frames.poses is None or frames.height_m is None:
            raise MitsonarError(f"the frames of {folder} lack poses or height_m: `mitsonar render` did not write them")
        self.trajectory = Trajectory(frames.poses, frames.time_s)
        self.height_m = frames.height_m
        self.traced = frames.sonar
        change: dict[str, Any] = {} if bins is None else {"range_bins": bins}
        change |= {} if window is None else {"range_min": window[0], "range_max": window[1]}
        if frames.sonar.model == "coherent":  # echoes have no phase: what can be binned are expected levels in hard boxes
            change |= {"model": "physical", "pattern": "box"}
        self.sonar = frames.sonar.replace(**change, bounces=1)  # echoes are of one reflection
        self.notes: list[str] = []

    def pings(
        self, poses: ArrayLike, *, first: int = 0, labels: bool = False, time_s: ArrayLike | None = None
    ) -> Iterator[RenderedPings]:
        """Levels of the stored frames, one at a time; ``poses`` only tells how many."""
        import drjit as dr
        import mitsuba as mi

        from mitsonar.instruments.views import Whole
        from mitsonar.simulation.binning import accumulate, develop, fetch
        from mitsonar.simulation.view_echoes import ViewEchoes, WholeTracer

        if labels:
            raise MitsonarError("labels need the scene: render with --labels")
        tracer = WholeTracer(Whole(self.sonar))
        pixel = dr.arange(mi.UInt32, self.traced.rays)
        beam = pixel % self.traced.columns // self.traced.across
        for number in range(first, first + len(np.atleast_2d(poses))):
            stored = self.film_echoes(poses, number)
            echoes = Echoes(**{name: mi.Float(padded(value)) for name, value in vars(stored).items()})
            sums = accumulate(ViewEchoes(echoes, beam, True, None), mi.UInt32(0), 1, tracer)
            levels, counts = fetch(*develop(sums, 1, tracer), 1, tracer.view)
            yield RenderedPings(number, levels, counts, self.height_m[number : number + 1])

    def film_echoes(self, pose: ArrayLike, ping: int, time_s: float | None = None) -> Echoes:
        """Read the echoes of one frame's EXR."""
        return load_exr(self.folder / "echoes" / f"{ping:06d}.exr", self.traced)

    def window_range(self, pose: ArrayLike, ping: int) -> tuple[float, float] | None:
        """Nearest and farthest return outside the window [m]."""
        return self.film_echoes(pose, ping).outside(self.sonar)

    def buried(self, pose: ArrayLike) -> str:
        """Return nothing: where the ground is, the run that stored the echoes knows."""
        return ""

    def bodies(self, time_s: ArrayLike) -> BodyStates:
        """Return none: where bodies were is in the run that stored the echoes."""
        return BodyStates()

    def label_names(self, labels: bool = True) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return none: stored echoes have no labels."""
        return (), ()


def _frames_of(
    pings: RenderedPings,
    source: Source,
    timed: TimedPath,
    outputs: Outputs,
    gain: float,
    names: tuple[tuple[str, ...], tuple[str, ...]],
) -> tuple[SonarFrames, NDArray[np.float32]]:
    """Return a batch as frames, and its images before noise."""
    sonar = source.sonar
    image = to_image(pings.levels, gain, sonar)
    numbers = np.arange(pings.first, pings.first + len(pings))
    time_s, beam_poses = timed.of_beams(sonar)
    frames = SonarFrames(
        image=np.ascontiguousarray(outputs.noise.apply(image, seed=sonar.seed, frames=numbers)),
        range_m=sonar.range_m,
        bearing_rad=sonar.bearing_rad,
        time_s=time_s[numbers],
        sonar=sonar,
        poses=timed.frames.poses[numbers],
        beam_poses=None if beam_poses is None else beam_poses[numbers],
        **source.bodies(timed.frames.time_s[numbers]).fields(),
        height_m=pings.height_m,
        level=sonar.value_coding,
        level_scale=1 / gain,
        **labels_above(pings, gain, outputs.label_floor),
        shape_names=names[0],
        object_names=names[1],
    )
    return frames, image


def _write_pictures(folder: Path, first: int, frames: SonarFrames, outputs: Outputs) -> None:
    (folder / "images").mkdir(exist_ok=True)
    for index, picture in enumerate(to_uint8(frames.image)):
        buffer = io.BytesIO()
        Image.fromarray(picture).save(buffer, format="PNG", compress_level=3)
        write_whole(folder / "images" / f"{first + index:06d}.png", buffer.getvalue())
    if outputs.fan:
        (folder / "fan").mkdir(exist_ok=True)
        pictures = FanPictures(frames)
        for index in range(len(frames)):
            pictures.save(folder / "fan", frames, index, first + index)
    if outputs.cartesian:
        (folder / "cartesian").mkdir(exist_ok=True)
        for index in range(len(frames)):
            title = f"{frames.sonar.title}, {frames.sonar.model} model, frame {first + index}"
            save_fan(folder / "cartesian" / f"{first + index:06d}.png", frames, index, title=title)


def _write_echoes(folder: Path, source: Source, frames: SonarFrames, first: int) -> None:
    (folder / "echoes").mkdir(exist_ok=True)
    assert frames.poses is not None
    for index, pose in enumerate(frames.poses):
        path = folder / "echoes" / f"{first + index:06d}.exr"
        part = path.with_name(f".{path.stem}.part.exr")
        save_exr(part, source.film_echoes(pose, first + index, float(frames.time_s[index])), source.sonar)
        part.replace(path)
