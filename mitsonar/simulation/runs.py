"""Runs on disk: how results are written as they are computed, and how an interrupted run is resumed.

Imaging sonars, channel sonars, cameras, sounders and whole vehicles each have a kind of run. A run that was killed can be
resumed, and ends with the same bits as an uninterrupted one.
"""

from __future__ import annotations

import io
import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.acoustics.water import delay_exact, delay_iterated
from mitsonar.errors import MitsonarError, counted
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar, TimedPath, overlap_notes, timed_path
from mitsonar.instruments.sounder import Sounder
from mitsonar.io.files import read_npz, write_whole
from mitsonar.io.runs import RunDirectory, RunKind, digest
from mitsonar.io.storage import refuse_codecs
from mitsonar.motion.bodies import BodyStates, MovingBodies
from mitsonar.motion.sensors import save_sensors
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.plotting import figures
from mitsonar.plotting.fans import FanPictures, save_fan
from mitsonar.plotting.figures import response_png, waterfall_png
from mitsonar.recordings.write_xtf import write_xtf
from mitsonar.records.echoes import Echoes, load_exr, save_exr
from mitsonar.records.frames import LONGEST_NPZ, FrameStore, SonarFrames, check_column, to_uint8
from mitsonar.records.responses import COLUMNS, ImpulseResponses
from mitsonar.records.soundings import Echogram, Soundings
from mitsonar.simulation.channel import ChannelSimulator, Paths
from mitsonar.simulation.device import current_variant, ensure_variant, padded
from mitsonar.simulation.pings import RenderedPings, Tally, constant_gain, labels_above, to_image
from mitsonar.simulation.simulator import Simulator
from mitsonar.simulation.sounding import SoundedPings, SounderSimulator, dvl_readings, dvl_sensors
from mitsonar.simulation.vehicle import CameraSimulator, Mounted, VehicleSimulator, refuse_path, told_of

if TYPE_CHECKING:
    import zarr

__all__ = [
    "PHOTOGRAPHS",
    "RENDERING",
    "SIMULATORS",
    "SOUNDING",
    "SOUNDINGS",
    "VEHICLE_RUN",
    "ImpulseReport",
    "Outputs",
    "Progress",
    "RenderReport",
    "SoundingReport",
    "Source",
    "Spread",
    "StoredEchoes",
    "VehicleReport",
    "iteration_error",
    "progress_of",
    "run",
    "run_camera",
    "run_impulse",
    "run_sounder",
    "run_vehicle",
    "spread_of",
]


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

    def window_range(self, pose: ArrayLike, ping: int) -> tuple[float, float] | None:
        """Return the ranges of the nearest and the farthest return outside the window [m]."""

    def buried(self, pose: ArrayLike) -> str:
        """Describe how a pose lies below the ground or inside an object; empty if it does not."""

    def label_names(self, labels: bool = True) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the names of shapes and of objects that labels refer to; both empty without labels."""


@dataclass(frozen=True)
class Outputs:
    """Noise and output options of a run.

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
    """Folder, number of frames, pictures and warnings of a run."""

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
    """Render a trajectory into a run folder, or resume an interrupted run.

    Args:
        source: source of the levels.
        trajectory: poses and times.
        folder: folder to create; holds ``frames.npz`` (or ``frames.zarr``), ``images/``, ``poses.tum``, ``run.json`` and the
            files that ``outputs`` selects.
        outputs: noise and output options.
        origin: what else is needed to reproduce the run, besides sonar, poses and outputs: scene, its digest, parameters.
        overwrite: replace an existing run.
        resume: continue an interrupted run.
        progress: called with the number of frames that were added.

    Returns:
        The report of the run.

    Raises:
        MitsonarError: the folder exists; the run to resume has other inputs; the folder cannot be written.
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
    """Return everything that determines the bits of a run."""
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
    """Write the trajectory of each moving body at the times of the frames, one file per body."""
    names, poses, _ = source.bodies(trajectory.time_s)
    for number, name in enumerate(names):
        assert poses is not None
        folder.mkdir(exist_ok=True)
        Trajectory(poses[:, number], trajectory.time_s).save(folder / f"{name.replace('/', '_')}.tum", frame)


def _make_frames(
    source: Source, timed: TimedPath, made: RunDirectory, outputs: Outputs, progress: Callable[[int], None]
) -> FrameStore:
    """Render and write the missing frames; update the run's notes after each batch."""
    # 1. read the progress of an earlier call, and check that the stored frames agree with it
    trajectory = timed.frames
    folder, earlier, store = made.path, progress_of(made, source.sonar, len(trajectory)), None
    done, tally, gain = earlier.frames, earlier.tally, earlier.gain
    if done > 0:
        store = FrameStore.open(folder / "frames.zarr")
        store.check(len(trajectory), source.sonar, done)
    if store is not None and done == len(trajectory):
        return store
    # 2. levels of the missing frames; the first frames of a run fix the gain of all frames
    batches = source.pings(timed.poses[done:], first=done, labels=outputs.labels, time_s=timed.time_s[done:])
    names = source.label_names(outputs.labels)
    if outputs.labels:
        made.notes |= {"shape_names": list(names[0]), "object_names": list(names[1])}
    if done == 0:
        gain, batches = constant_gain(batches)
        made.notes["gain"] = gain
    # 3. write each batch, and note the progress only after all its files are complete
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
    """Progress of a run: number of frames written, gain of all frames (1 before the first), and their tally."""

    frames: int
    gain: float
    tally: Tally


def progress_of(made: RunDirectory, sonar: Sonar, frames: int) -> Progress:
    """Read the progress of a run of ``frames`` frames from its file.

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
        if frames.sonar.model == "coherent":  # echoes have no phase: only expected levels in hard boxes can be binned
            change |= {"model": "physical", "pattern": "box"}
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

    def window_range(self, pose: ArrayLike, ping: int) -> tuple[float, float] | None:
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


def _frames_of(
    pings: RenderedPings,
    source: Source,
    timed: TimedPath,
    outputs: Outputs,
    gain: float,
    names: tuple[tuple[str, ...], tuple[str, ...]],
) -> tuple[SonarFrames, NDArray[np.float32]]:
    """Convert a batch to frames; return them, and the images before noise."""
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


# ---------------- Runs of impulse responses


SOUNDING = RunKind(
    "channel measurement",
    outputs=("responses.npz", "responses.zarr", "response.png", "waterfall.png"),
    notes={"frames_done": int, "warnings": list},
    packages=(*SIMULATORS, "finufft"),
    deciding=(*SIMULATORS[:3], "finufft"),
)

OVERSPREAD = 0.3
"""Product of a receiver's delay spread and Doppler spread above which a channel is reported as overspread."""

MOST_ENERGY = (0.01, 0.99)
"""Quantiles of the echo energy between which the spread of delays and Doppler shifts is measured."""


@dataclass(frozen=True)
class Spread:
    """Delay spread [s] and Doppler spread [Hz] of a receiver's echoes; each contains 98 % of their energy."""

    delay_s: float
    doppler_hz: float

    @property
    def factor(self) -> float:
        """Return the product of delay spread and Doppler spread; above 1 a channel changes within one response."""
        return self.delay_s * self.doppler_hz


@dataclass(frozen=True)
class ImpulseReport:
    """Folder, number of pings, spread and warnings of a run."""

    folder: Path
    pings: int
    spread: Spread
    warnings: list[str]


def run_impulse(
    simulator: ChannelSimulator,
    flown: Trajectory,
    velocity: NDArray[np.float64],
    folder: str | Path,
    *,
    origin: Mapping[str, object],
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[int], None] = lambda pings: None,
) -> ImpulseReport:
    """Simulate impulse responses into a run folder, or resume an interrupted run.

    The folder holds ``responses.zarr`` and ``responses.npz``, two figures and ``run.json``.

    Args:
        simulator: scene and instrument.
        flown: poses and times of the pings.
        velocity: velocity of the vehicle in each ping, see :class:`~mitsonar.records.responses.ImpulseResponses`.
        folder: folder of the run.
        origin: what else is needed to reproduce the run, besides instrument and trajectory.
        overwrite: replace an existing run.
        resume: continue an interrupted run.
        progress: called with the number of new pings.

    Returns:
        The report of the run.

    Raises:
        MitsonarError: the folder exists; the run to resume has other inputs; the folder cannot be written.
    """
    sonar = simulator.sonar
    asked = {**origin, "sonar": sonar.model_dump(mode="json"), "pings": len(flown)}
    asked["poses_sha256"] = digest(flown.poses.tobytes(), flown.time_s.tobytes())
    asked["velocity"] = velocity[0].tolist() if len(np.unique(velocity, axis=0)) == 1 else "of the path"
    paths = [simulator.paths(flown.poses[0], velocity[:1], receiver) for receiver in range(len(sonar.receivers))]
    spread = spread_of(paths)
    if not any(path.amplitude.size for path in paths):
        _refuse_silence(simulator, flown, paths)
    run = RunDirectory.begin(folder, SOUNDING, asked, resume=resume, overwrite=overwrite)
    run.start(frames_done=0)
    if not (run.path / "responses.npz").exists():  # the file that is written last
        progress(run.count("frames_done", len(flown)))
        made = _make(simulator, flown, velocity, run, progress)
        run.note(warnings=[*simulator.notes, *warnings_of(made, spread)])
        made.about |= {"spread_factor": spread.factor}
        write_whole(run.path / "response.png", response_png(made))
        write_whole(run.path / "waterfall.png", waterfall_png(made))
        made.save(run.path / "responses.npz")
    if not run.finished:
        run.finish()
    return ImpulseReport(run.path, len(flown), spread, run.notes.get("warnings") or [])


def _make(
    simulator: ChannelSimulator,
    flown: Trajectory,
    velocity: NDArray[np.float64],
    run: RunDirectory,
    progress: Callable[[int], None],
) -> ImpulseResponses:
    """Simulate the missing pings; the run's notes are updated after each batch."""
    import zarr

    done = run.count("frames_done", len(flown))
    url = run.path / "responses.zarr"
    if done == 0:
        shape = (len(flown), len(simulator.sonar.receivers))
        empty = ImpulseResponses(
            response=np.zeros((*shape, simulator.sonar.taps), np.complex64),
            time_s=flown.time_s,
            sonar=simulator.sonar,
            poses=flown.poses,
            velocity=velocity,
            height_m=np.zeros(shape[0]),
            echoes=np.zeros(shape, np.int64),
            dropped=np.zeros(shape, np.int64),
        )
        empty.save(url)
    try:
        group = zarr.open_group(url, mode="r+", zarr_format=3)
        _check(group, len(flown), simulator.sonar)
        for part in simulator.pings(flown.poses[done:], velocity[done:], first=done):
            here = slice(part.first, part.first + len(part))
            for name in ("response", "height_m", "echoes", "dropped"):
                group[name][here] = getattr(part, name)  # type: ignore[index]
            run.note(frames_done=here.stop)
            progress(len(part))
    except MitsonarError:
        raise
    except Exception as error:  # a damaged Zarr store raises errors of any type
        raise MitsonarError(f"cannot go on with {url}: {error}; make it again with --overwrite") from None
    return ImpulseResponses.load(url)


def _check(group: zarr.Group, pings: int, sonar: ChannelSonar) -> None:
    """Check that a store belongs to the run, before anything is written into it.

    Raises:
        MitsonarError: an array is missing or has another shape or type.
        ValueError: an array has other chunks, or codecs that are not read.
    """
    sizes = {"pings": pings, "receivers": len(sonar.receivers), "taps": sonar.taps, "four": 4, "six": 6}
    for name, column in COLUMNS.items():
        array = cast("zarr.Array[Any]", group[name])
        refuse_codecs(array)
        check_column(array, name, column, sizes, str(group.store_path))
        if array.chunks != ((1, *array.shape[1:]) if array.ndim > 2 else array.shape):
            raise ValueError(f"{name} is cut into pieces of {array.chunks}")


def _refuse_silence(simulator: ChannelSimulator, flown: Trajectory, paths: list[Paths]) -> None:
    """Refuse a run without echoes in the first, the middle and the last ping; the caller has checked the first.

    Raises:
        MitsonarError: the middle and the last ping have no echo either.
    """
    sonar = simulator.sonar
    for pose in flown.poses[[len(flown) // 2, -1]]:
        if any(simulator.paths(pose, None, receiver).amplitude.size for receiver in range(len(sonar.receivers))):
            return
    beyond = sum(path.dropped for path in paths)
    x, y, z, pitch, *_ = flown.poses[0]
    height = float(simulator.tracer.height_m(flown.poses[:1])[0])
    below = f"{height:.3g} m above what is below it" if math.isfinite(height) else "with nothing below it"
    raise MitsonarError(
        f"no receiver has an echo: the vehicle is at ({x:g}, {y:g}, {z:g}) m, {below}, pitched by "
        f"{math.degrees(pitch):.3g} deg; {beyond:,} echoes came from beyond range_max {sonar.range_max:g} m. z is upwards, "
        "a level vehicle has pitch 0 (to_world's +z is forward), and receivers point tilt_deg away from straight down"
    )


FAR_ARM_M = 10.0
"""Distance from the transmitter [m] above which a receiver's position is probably given in millimetres."""


def spread_of(paths: list[Paths]) -> Spread:
    """Measure the spread of 98 % of each receiver's echo energy, and return the spread with the largest factor.

    Each receiver is a separate channel: Doppler shifts of receivers that look in different directions do not blur one
    response.
    """
    return max((_own_spread(path) for path in paths), key=lambda spread: spread.factor)


def _own_spread(path: Paths) -> Spread:
    """Measure the spread of one receiver's echoes."""
    energy = np.abs(path.amplitude) ** 2
    widths = []
    for values in (path.delay_s, path.doppler_hz):
        # the cumulative energy along the sorted values gives the quantiles of MOST_ENERGY
        order = np.argsort(values)
        share = np.cumsum(energy[order])
        if not share.size or share[-1] == 0:
            return Spread(0.0, 0.0)
        low, high = np.searchsorted(share, np.array(MOST_ENERGY) * share[-1])
        widths.append(float(values[order[min(high, len(order) - 1)]] - values[order[low]]))
    return Spread(*widths)


def warnings_of(made: ImpulseResponses, spread: Spread) -> list[str]:
    """Return the warnings of a run, one sentence each."""
    arms = {one.name: math.dist(one.position, (0, 0, 0)) for one in made.sonar.receivers}
    far = [name for name, away in arms.items() if away > FAR_ARM_M]
    several = f"receivers {', '.join(far)} are up to" if len(far) > 1 else f"receiver {', '.join(far)} is"
    sentences = [f"{several} {max(arms.values()):g} m from the transmitter: positions are in metres"] if far else []
    assert made.echoes is not None
    assert made.dropped is not None
    for number, receiver in enumerate(made.sonar.receivers):
        silent = int((made.echoes[:, number] == 0).sum())
        if silent:
            view = receiver.field
            up = " (above 90: upwards)" if view.tilt_deg > 90 else ""
            pitch = "" if made.poses is None else f" (pitched by {math.degrees(made.poses[0, 3]):.3g} deg)"
            sentences.append(
                f"receiver {receiver.name} has no echo in {silent} of {counted(len(made), 'ping')}: check its direction "
                f"(heading {view.heading_deg:g} deg, tilt {view.tilt_deg:g} deg from straight down{up}), "
                f"the vehicle's pose{pitch} and range_max"
            )
    dropped = int(made.dropped.sum())
    if dropped:
        share = dropped / max(1, dropped + int(made.echoes.sum()))
        sentences.append(
            f"{dropped:,} echoes ({100 * share:.3g} %) came from beyond range_max {made.sonar.range_max:g} m and were "
            "dropped: raise it, with a frequency_step_hz below sound_speed / (4 range_max)"
        )
    if spread.factor > OVERSPREAD:
        sentences.append(
            f"the channel is overspread: delays over {1e3 * spread.delay_s:.3g} ms times Doppler shifts over "
            f"{spread.doppler_hz:.3g} Hz make {spread.factor:.2g}, above {OVERSPREAD:g}; it changes while it is measured, "
            "and a real sounder would see it blurred"
        )
    return sentences


def iteration_error(flown: Trajectory, velocity: NDArray[np.float64], sonar: ChannelSonar) -> tuple[float, float]:
    """Bound the error of a moving receiver's delay in Almanza-Medina's iteration (eq. 5.5-5.14).

    The bound is evaluated for points ahead and behind at ``range_max``.

    Returns:
        Largest errors without iteration and after two rounds [cycles of the carrier]; 0, 0 where they are not finite.
    """
    speed = float(np.linalg.norm(velocity[:, :3], axis=1).max(initial=0.0))
    ahead = (np.array([sonar.range_max, -sonar.range_max]), np.zeros(2), np.zeros(2))
    moving = (np.full(2, speed), np.zeros(2), np.zeros(2))
    exact = delay_exact(ahead, ahead, moving, sonar.sound_speed)
    errors = [
        float(np.abs(delay_iterated(ahead, ahead, moving, sonar.sound_speed, rounds) - exact).max()) * sonar.carrier_hz
        for rounds in (0, 2)
    ]
    return (errors[0], errors[1]) if math.isfinite(sum(errors)) else (0.0, 0.0)


# ---------------- Runs of cameras


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
    """Render a camera's pictures into a run folder, or resume an interrupted run.

    The folder holds ``images/000000.png`` ..., ``poses.tum`` and ``run.json``.

    Args:
        simulator: scene and camera.
        flown: poses and times of the camera.
        folder: folder of the run.
        origin: what else is needed to reproduce the run, besides the trajectory.
        frame: coordinate convention of ``poses.tum``.
        overwrite: replace an existing run.
        resume: continue an interrupted run.
        progress: called with the number of new pictures.

    Raises:
        MitsonarError: the folder exists; the run to resume has other inputs; the folder cannot be written.
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
    """Return the path of a picture."""
    return folder / "images" / f"{number:06d}.png"


def _whole(folder: Path, done: int) -> int:
    """Return how many pictures exist up to the first missing one; that one and all after it are rendered again."""
    return next((number for number in range(done) if not _picture(folder, number).is_file()), done)


# ---------------- Runs of sounders


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
"""Kinds of sounders that store all levels, not only detections."""

DETECTED = ("range_m", "level_db", "quality")


@dataclass(frozen=True)
class SoundingReport:
    """Files, number of detections and warnings of a run.

    Attributes:
        folder: folder of the run.
        files: names of the files that were written.
        found: number of beams with an echo, out of ``beams``.
        beams: number of beams in all pings.
        warnings: warnings to the user, one sentence each.
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
    """Render a sounder's pings into a run folder, or resume an interrupted run.

    Batches are stored as parts while they are rendered; the files of the kind of instrument follow at the end.

    Args:
        simulator: scene and instrument.
        flown: poses of the vehicle and times of the pings.
        folder: folder to create; holds ``run.json``, ``poses.tum`` and the files of the kind of instrument.
        origin: what else is needed to reproduce the run, besides instrument and trajectory.
        frame: coordinate convention of ``poses.tum``.
        overwrite: replace an existing run.
        resume: continue an interrupted run.
        progress: called with the number of new pings.

    Returns:
        The report of the run.

    Raises:
        MitsonarError: the folder exists; the run to resume has other inputs; the folder cannot be written.
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
    """Render the missing pings, one part per batch."""
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
    """Return the arrays of a batch to store: detections, and for some kinds the levels."""
    detected = simulator.detect(batch.levels)
    kept: dict[str, NDArray[Any]] = dict(zip(DETECTED, detected, strict=True))
    if simulator.sounder.kind in WITH_LEVELS:
        kept |= {"levels": batch.levels[..., 0], "height_m": batch.height_m}
    return kept


def _joined(folder: Path, pings: int) -> dict[str, NDArray[Any]]:
    """Read all parts and return their concatenated arrays.

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
    """Write the files of the kind of instrument; return warnings."""
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
    """Write the picture of an echogram, and for a side-scan sonar the XTF file."""
    if echogram.sounder.kind == "sidescan":
        write_xtf(folder / "sidescan.xtf", echogram)
        figures.save_sounding_figure(figures.waterfall_figure_of(echogram), folder / "waterfall.png")
    else:
        figures.save_sounding_figure(figures.echogram_figure(echogram, soundings), folder / "echogram.png")


def _write_dvl(folder: Path, soundings: Soundings) -> list[str]:
    """Write the readings of a DVL, and the sensor file that odometry reads; return warnings."""
    readings = dvl_readings(soundings, soundings.sounder.fan.seed)
    readings.save(folder / "dvl.csv")
    figures.save_sounding_figure(figures.dvl_figure(readings), folder / "dvl.png")
    lost = int((~readings.locked).sum())
    if lost == len(readings.locked):
        return ["the DVL has no bottom lock in any ping: there is no sensors.csv"]
    save_sensors(folder / "sensors.csv", dvl_sensors(readings))
    return [f"the DVL lost the bottom in {lost} of {counted(len(readings.locked), 'ping')}"] if lost else []


def _write_points(folder: Path, soundings: Soundings) -> list[str]:
    """Write soundings as table, point cloud and pictures; return warnings."""
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
    """Return the report of a finished run."""
    files = [name for name in SOUNDINGS.outputs if (run.path / name).is_file()]
    warnings = [str(one) for one in run.notes.get("warnings") or []]
    return SoundingReport(run.path, files, int(soundings.found.sum()), soundings.found.size, warnings)


# ---------------- Runs of vehicles


VEHICLE_RUN = RunKind("run of a vehicle", outputs=("vehicle.tum",), notes={"begun": list, "warnings": list})


@dataclass(frozen=True)
class VehicleReport:
    """Folder, sensor names and warnings of a run; each sensor has a subfolder of its name."""

    folder: Path
    sensors: tuple[str, ...]
    warnings: list[str]


def run_vehicle(
    simulator: VehicleSimulator,
    vehicle: Trajectory,
    folder: str | Path,
    outputs: Outputs,
    *,
    origin: Mapping[str, Any],
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[int], None] = lambda pings: None,
) -> VehicleReport:
    """Run all sensors of a vehicle one after another, each into its own subfolder, or resume an interrupted run.

    Args:
        simulator: scene, sensors and moving bodies.
        vehicle: trajectory of the vehicle.
        folder: folder to create; holds ``vehicle.tum``, ``run.json`` and a folder for each sensor.
        outputs: output options of imaging sonars; its coordinate convention applies to all pose files.
        origin: what else is needed to reproduce the run, besides sensors and trajectory.
        overwrite: replace an existing run.
        resume: continue an interrupted run.
        progress: called with the number of new pings.

    Returns:
        The report of the run.

    Raises:
        MitsonarError: a sensor cannot follow the trajectory; the folder exists; the run to resume has other inputs; the
            folder cannot be written.
    """
    sensors, bodies = simulator.sensors(vehicle), simulator.bodies(vehicle)
    refuse_path(sensors, vehicle, outputs.noise)
    asked = {**origin, "sensors": {name: _told(one) for name, one in sensors.items()}, "frame": outputs.frame}
    asked["poses_sha256"] = digest(vehicle.poses.tobytes(), vehicle.time_s.tobytes())
    made = RunDirectory.begin(folder, VEHICLE_RUN, asked, resume=resume, overwrite=overwrite)
    made.start(begun=[], warnings=[])
    vehicle.save(made.path / "vehicle.tum", outputs.frame)
    begun, warnings = list(made.notes.get("begun") or []), list(made.notes.get("warnings") or [])
    for name, one in sensors.items():
        again = name in begun
        if not again:
            begun.append(name)
            made.note(begun=begun)  # noted first, so that a resumed run treats the sensor's folder as its own
        how = {"resume": again, "overwrite": not again, "progress": progress, "origin": dict(origin)}
        said = _run_sensor(simulator, one, vehicle, bodies, made.path / name, outputs, how)
        warnings += [line for line in (f"{name}: {sentence}" for sentence in said) if line not in warnings]
        made.note(warnings=warnings)
    if not made.finished:
        made.finish()
    return VehicleReport(made.path, tuple(sensors), warnings)


def _run_sensor(
    simulator: VehicleSimulator,
    one: Mounted,
    vehicle: Trajectory,
    bodies: MovingBodies,
    folder: Path,
    outputs: Outputs,
    how: dict[str, Any],
) -> list[str]:
    """Run one sensor; return its warnings."""
    scene, instrument, flown = simulator.scene, one.instrument, one.path(vehicle)
    if isinstance(instrument, Sonar):
        return run(Simulator(scene, instrument, moving=bodies), flown, folder, outputs, **how).warnings
    if isinstance(instrument, Sounder):
        sounder = SounderSimulator(scene, instrument, moving=bodies)
        return run_sounder(sounder, flown, folder, frame=outputs.frame, **how).warnings
    if isinstance(instrument, ChannelSonar):
        return run_impulse(ChannelSimulator(scene, instrument), flown, velocities(flown), folder, **how).warnings
    from mitsonar.simulation.vehicle import CameraSimulator

    run_camera(CameraSimulator(scene, instrument, moving=bodies), flown, folder, frame=outputs.frame, **how)
    return []


def _told(one: Mounted) -> dict[str, Any]:
    """Return the keys and the mount that describe a sensor."""
    instrument = one.instrument
    if isinstance(instrument, Sonar | Sounder | ChannelSonar):
        return {"keys": instrument.model_dump(mode="json"), "mount": list(one.mount)}
    from mitsonar.simulation.vehicle import told_of

    return {"keys": told_of(instrument), "mount": list(one.mount)}
