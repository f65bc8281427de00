"""Runs on disk: one loop that writes results batch by batch and resumes an interrupted run, and runs of imaging sonars.

A run that was killed can be resumed, and ends with the same bits as an uninterrupted one. Runs of channel sonars, sounders,
cameras and vehicles are in :mod:`mitsonar.simulation.instrument_runs`.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np
import yaml
from numpy.typing import ArrayLike
from PIL import Image

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar, TimedPath, overlap_notes, timed_path
from mitsonar.io.files import write_atomic
from mitsonar.io.runs import CONFIG_FILE, RunDirectory, RunKind, digest
from mitsonar.motion.bodies import BodyStates
from mitsonar.motion.trajectory import Trajectory
from mitsonar.plotting.fans import FanPictures, save_fan
from mitsonar.records.echoes import Echoes, load_exr, save_exr
from mitsonar.records.frames import MAX_NPZ_FRAMES, FrameStore, SonarFrames, to_uint8
from mitsonar.simulation.device import ensure_variant, padded
from mitsonar.simulation.pings import RenderedPings, Tally, constant_gain, labels_above, to_image

__all__ = [
    "RENDERING",
    "SIMULATORS",
    "Destination",
    "RenderOptions",
    "RenderReport",
    "Source",
    "Steps",
    "StoredEchoes",
    "path_digest",
    "path_to_render",
    "progress_of",
    "run",
    "write_run",
]


# ---------------- The loop of all runs


@dataclass(frozen=True)
class Destination:
    """Folder of a run, and how the run begins.

    Attributes:
        folder: folder to create.
        origin: what else is needed to reproduce the run, besides instrument, path and options: scene, parameters.
        overwrite: replace an existing run.
        resume: continue an interrupted run.
        progress: called with the number of pings that were added.
        configuration: options of the command, which are written to ``run.yaml``; empty: no such file.
    """

    folder: str | Path
    origin: Mapping[str, Any] = field(default_factory=dict)
    overwrite: bool = False
    resume: bool = False
    progress: Callable[[int], None] = lambda pings: None
    configuration: Mapping[str, Any] = field(default_factory=dict)


Steps: TypeAlias = Iterator[tuple[int, dict[str, Any]]]
"""Steps of a run as it is written: the number of pings that a step has added, and what to note in ``run.json``."""


def write_run(
    kind: RunKind,
    settings: Mapping[str, Any],
    destination: Destination,
    steps: Callable[[RunDirectory], Steps],
    **notes: Any,
) -> RunDirectory:
    """Begin or resume a run, and note its progress after each step.

    Args:
        kind: type of run.
        settings: what determines the results, besides the origin; a run is resumed only with the same settings.
        destination: folder, origin, and how the run begins.
        steps: generator that writes what the run lacks. It yields only after all files of a step are complete: a killed run
            loses no more than one step. It yields nothing if nothing is missing.
        notes: notes of a new run.

    Raises:
        MitsonarError: the folder exists; the run to resume has other settings; the folder cannot be written.
    """
    all_settings = {**destination.origin, **settings}
    run = RunDirectory.begin(
        destination.folder, kind, all_settings, resume=destination.resume, overwrite=destination.overwrite
    )
    run.start(**notes)
    if destination.configuration:
        words = f"# `mitsonar {destination.configuration['command']} --config {CONFIG_FILE} -o FOLDER` repeats this run\n"
        text = yaml.safe_dump(dict(destination.configuration), sort_keys=False, allow_unicode=True)
        write_atomic(run.path / CONFIG_FILE, (words + text).encode())
    for pings, noted in steps(run):
        if noted:
            run.note(**noted)
        destination.progress(pings)
    if not run.finished:
        run.finish()
    return run


def path_digest(path: Trajectory) -> str:
    """Return the SHA-256 of poses and times."""
    return digest(path.poses.tobytes(), path.time_s.tobytes())


# ---------------- Runs of imaging sonars


SIMULATORS = ("mitsonar", "mitsuba", "drjit", "numpy")
"""Packages whose versions determine the simulation, to the last bit."""

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
    """A source of levels: a simulator that traces, or stored echoes."""

    sonar: Sonar
    notes: list[str]
    variant: str

    def pings(
        self, poses: ArrayLike, *, first: int = 0, labels: bool = False, time_s: ArrayLike | None = None
    ) -> Iterator[RenderedPings]:
        """Yield the levels of consecutive pings, in batches."""

    def film_echoes(self, pose: ArrayLike, ping: int, time_s: float | None = None) -> Echoes:
        """Return the echoes of one ping in the order of the film."""

    def bodies(self, time_s: ArrayLike) -> BodyStates:
        """Return the names of the moving bodies, with their poses and velocities at the given times."""

    def window_range(self, pose: ArrayLike, ping: int, time_s: float | None = None) -> tuple[float, float] | None:
        """Return the ranges of the nearest and the farthest return outside the window [m]."""

    def buried(self, pose: ArrayLike) -> str:
        """Describe how a pose lies below the ground or inside an object; empty if it does not."""

    def label_names(self, labels: bool = True) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the names of shapes and of objects that labels refer to; both empty without labels."""


@dataclass(frozen=True)
class RenderOptions:
    """Noise and output options of a run; all of them are settings in ``run.json``.

    Attributes:
        noise: noise model to apply to the frames.
        labels: write per-pixel ground truth.
        cartesian: write a figure with axes for each frame.
        exr: write the echoes of each ray.
        frame: coordinate convention of ``poses.tum``.
        fan: write a plain fan picture of each frame and of its labels.
        label_floor: fraction of full scale above which a pixel is labelled.
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
    """Number of frames, pictures and warnings of a run."""

    frames: int
    pictures: list[Path]
    warnings: list[str]


def path_to_render(sonar: Sonar, trajectory: Trajectory, *, exr: bool = False) -> TimedPath:
    """Return the poses and times of the pings of a run.

    Args:
        sonar: the instrument.
        trajectory: poses and times.
        exr: whether the echoes of each ray are to be stored.

    Raises:
        MitsonarError: the trajectory is too short for a sweep, or a frame whose echoes are to be stored is several pings.
    """
    timed = timed_path(sonar, trajectory)
    if exr and timed.time_s.ndim > 1:
        raise MitsonarError("echoes of each ray are stored only if a frame is one ping: leave out --exr or ping_groups")
    return timed


def run(source: Source, trajectory: Trajectory, options: RenderOptions, destination: Destination) -> RenderReport:
    """Render a trajectory into a run folder, or resume an interrupted run.

    The folder holds ``frames.npz`` (or ``frames.zarr``), ``images/``, ``poses.tum``, ``run.json`` and the files that the
    options select.

    Args:
        source: source of the levels.
        trajectory: poses and times.
        options: noise and options.
        destination: folder, origin, and how the run begins.

    Raises:
        MitsonarError: as in :func:`write_run`.
    """
    timed = path_to_render(source.sonar, trajectory, exr=options.exr)
    settings = {
        "variant": source.variant,
        "sonar": source.sonar.model_dump(),
        "frames": len(timed.frames),
        "poses_sha256": path_digest(trajectory),
        **vars(options),
        "noise": options.noise.model_dump(),
    }
    directory = write_run(
        RENDERING, settings, destination, lambda run: _write_frames(source, timed, options, run), frames_done=0
    )
    pictures = "cartesian" if options.cartesian else "fan" if options.fan else "images"
    files = sorted((directory.path / pictures).glob("[0-9]*[0-9].png"))
    return RenderReport(len(timed.frames), files, directory.notes.get("warnings") or [])


def _write_frames(source: Source, timed: TimedPath, options: RenderOptions, run: RunDirectory) -> Steps:
    """Render and write the missing frames."""
    folder, sonar, trajectory = run.path, source.sonar, timed.frames
    # 1. poses of the sonar and of the moving bodies
    trajectory.save(folder / "poses.tum", options.frame)
    names, bodies, _ = source.bodies(trajectory.time_s)
    for number, name in enumerate(names):
        assert bodies is not None
        (folder / "bodies").mkdir(exist_ok=True)
        path = Trajectory(bodies[:, number], trajectory.time_s)
        path.save(folder / "bodies" / f"{name.replace('/', '_')}.tum", options.frame)
    if (folder / "frames.npz").exists():  # complete, perhaps killed while the store was removed
        shutil.rmtree(folder / "frames.zarr", ignore_errors=True)
    if run.finished or (folder / "frames.npz").exists():
        return
    # 2. read the progress of an earlier call, and check that the stored frames agree with it
    gain, tally = progress_of(run, sonar, len(trajectory))
    done, store = tally.frames, None
    yield done, {}
    if done > 0:
        store = FrameStore.open(folder / "frames.zarr")
        store.check(len(trajectory), sonar, done)
    # 3. levels of the missing frames; the first frames of a run fix the gain of all frames
    if done < len(trajectory):
        batches = source.pings(timed.poses[done:], first=done, labels=options.labels, time_s=timed.time_s[done:])
        if done == 0:
            gain, batches = constant_gain(batches)
        shapes, objects = source.label_names(options.labels)
        label_names = {"shape_names": list(shapes), "object_names": list(objects)} if options.labels else {}
        time_s, beam_poses = timed.of_beams(sonar)
        for pings in batches:
            image = to_image(pings.levels, gain, sonar)
            numbers = np.arange(pings.first, pings.first + len(pings))
            frames = SonarFrames(
                image=np.ascontiguousarray(options.noise.apply(image, seed=sonar.seed, frames=numbers)),
                range_m=sonar.range_m,
                bearing_rad=sonar.bearing_rad,
                time_s=time_s[numbers],
                sonar=sonar,
                poses=trajectory.poses[numbers],
                beam_poses=None if beam_poses is None else beam_poses[numbers],
                **source.bodies(trajectory.time_s[numbers]).fields(),
                height_m=pings.height_m,
                level=sonar.value_coding,
                level_scale=1 / gain,
                **labels_above(pings, gain, options.label_floor),
                shape_names=shapes,
                object_names=objects,
            )
            store = store or FrameStore.create(folder / "frames.zarr", len(trajectory), frames)
            _write_pictures(folder, pings.first, frames, options)
            if options.exr:
                _write_echoes(folder, source, frames, pings.first)
            store.write(pings.first, frames)
            tally.add(pings, image)
            yield len(pings), {"frames_done": tally.frames, **label_names, "gain": gain, "tally": tally.state()}
    # 4. warnings, and one file of a short run
    notes = [*source.notes, *overlap_notes(sonar, trajectory.time_s)]
    yield 0, {"warnings": [*notes, *tally.warnings(source, trajectory.poses, trajectory.time_s)]}
    assert store is not None
    if len(trajectory) <= MAX_NPZ_FRAMES:
        store.pack(folder / "frames.npz")


def progress_of(run: RunDirectory, sonar: Sonar, frames: int) -> tuple[float, Tally]:
    """Read the gain of all frames (1 before the first) and the tally of the frames that a run of ``frames`` has written.

    Raises:
        MitsonarError: the file is damaged.
    """
    done = run.count("frames_done", frames)
    if done == 0:
        return 1.0, Tally(sonar)
    gain = run.amount("gain")
    if gain is None:
        raise run.damage("it has no gain")
    try:
        tally = Tally.restore(sonar, run.notes.get("tally", {}))
    except MitsonarError as error:
        raise run.damage(error) from None
    if tally.frames != done:
        raise run.damage(f"frames_done is {done}, the tally counts {tally.frames:,} frames")
    return gain, tally


class StoredEchoes:
    """Source that bins the stored echoes of a run again, without tracing; the run was rendered with ``--exr``.

    Args:
        folder: the run.
        bins: number of range bins; default: that of the run.
        window: nearest and farthest range [m]; default: those of the run.

    Raises:
        MitsonarError: no run, or one without echoes.
    """

    def __init__(self, folder: str | Path, *, bins: int | None = None, window: tuple[float, float] | None = None) -> None:
        self.variant = ensure_variant()
        self.folder = Path(folder)
        self.settings = RunDirectory.open(folder, RENDERING).settings
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
        if frames.sonar.beam_pattern != "box":  # echoes have neither phase nor losses: expected levels in hard boxes
            change |= {"model": "physical", "pattern": "box", "absorption_db_per_m": None}
        self.sonar = frames.sonar.replace(**change, bounces=1)  # stored echoes have one reflection
        self.notes: list[str] = []

    def pings(
        self, poses: ArrayLike, *, first: int = 0, labels: bool = False, time_s: ArrayLike | None = None
    ) -> Iterator[RenderedPings]:
        """Yield the levels of the stored frames, one at a time; only the number of ``poses`` is used."""
        import drjit as dr
        import mitsuba as mi

        from mitsonar.instruments.views import Whole
        from mitsonar.simulation.models.thesis import ViewEchoes, WholeTracer, accumulate, develop, fetch

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
        """Read the echoes of one frame from its EXR file."""
        return load_exr(self.folder / "echoes" / f"{ping:06d}.exr", self.traced)

    def window_range(self, pose: ArrayLike, ping: int, time_s: float | None = None) -> tuple[float, float] | None:
        """Return the ranges of the nearest and the farthest return outside the window [m]."""
        return self.film_echoes(pose, ping).outside(self.sonar)

    def buried(self, pose: ArrayLike) -> str:
        """Return an empty string: stored echoes do not include the position of the ground."""
        return ""

    def bodies(self, time_s: ArrayLike) -> BodyStates:
        """Return no bodies: the run that stored the echoes has their poses."""
        return BodyStates()

    def label_names(self, labels: bool = True) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return no names: stored echoes have no labels."""
        return (), ()


def _write_pictures(folder: Path, first: int, frames: SonarFrames, options: RenderOptions) -> None:
    (folder / "images").mkdir(exist_ok=True)
    for index, picture in enumerate(to_uint8(frames.image)):
        buffer = io.BytesIO()
        Image.fromarray(picture).save(buffer, format="PNG", compress_level=3)
        write_atomic(folder / "images" / f"{first + index:06d}.png", buffer.getvalue())
    if options.fan:
        (folder / "fan").mkdir(exist_ok=True)
        pictures = FanPictures(frames)
        for index in range(len(frames)):
            pictures.save(folder / "fan", frames, index, first + index)
    if options.cartesian:
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
