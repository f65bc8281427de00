"""The odometry benchmark: methods on simulated sets and recordings, one row each, in a folder that can be resumed."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.noise import NOISE_MODELS, NoiseModel
from mitsonar.errors import MitsonarError, MitsonarWarning, argument, suggest_names
from mitsonar.estimation.compare import Answers, Cells, markdown
from mitsonar.estimation.crlb.image import bounds_at, laws_of, overall
from mitsonar.estimation.estimator import AnyEstimator, Estimate, PlainTable
from mitsonar.estimation.named import EXTERNAL, create_estimator
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar
from mitsonar.io.files import parse_json, read_json, whole_lines, write_atomic, write_json
from mitsonar.io.runs import RunDirectory, RunKind, digest, versions
from mitsonar.mapping.odometry import Odometry, OdometryOptions
from mitsonar.mapping.odometry_run import ODOMETRY, OdometryFolder, run_odometry
from mitsonar.mapping.open_source import LOOP, Reading, open_source, record_at
from mitsonar.mapping.sources import FrameSource, open_frames
from mitsonar.motion.composition import motions
from mitsonar.motion.errors import (
    AXES,
    assess,
    cluster_resamples,
    distance_driven,
    in_units,
    motion_errors,
    path_length,
    segment_drift,
)
from mitsonar.motion.pose import Pose, mounted
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.device import release_memory
from mitsonar.simulation.runs import RENDERING, Destination, RenderOptions, run
from mitsonar.simulation.scene import load_scene
from mitsonar.worlds.families import RockyField, ShipHull
from mitsonar.worlds.world import Family, sloped

if TYPE_CHECKING:
    from mitsonar.simulation.simulator import Simulator

__all__ = [
    "DIVE",
    "LENGTHS_M",
    "METHODS",
    "NOISES",
    "PRESET",
    "SEED",
    "SETS",
    "TEXTURES",
    "Begin",
    "Case",
    "RenderedSet",
    "SimulatedSet",
    "Wanted",
    "benchmark_course",
    "benchmark_lines",
    "benchmark_odometry",
    "dive_course",
    "measure_row",
]


# ---------------- One row of the odometry benchmark: a method on the frames of one set, its path, errors, time and
# failures


Array = NDArray[np.float64]

LENGTHS_M = (1.0, 2.0, 5.0)
"""Lengths of the segments of drift [m]; KITTI has 100 to 800 m."""

TIMED_PAIRS = 15
"""Pairs whose estimates are timed, evenly spaced."""


@dataclass(frozen=True)
class Case:
    """What a row measures: a method on a set with a texture and noise.

    Attributes:
        name: of the set, or the path of a recording.
        texture: ``still``, ``speckle``, or ``recorded``.
        noise: level.
        method: name of the estimator.
        geometry: file that describes the layout of a recording's pictures.
    """

    name: str
    texture: str
    noise: str
    method: str
    geometry: Path | None = field(default=None, compare=False)

    @property
    def key(self) -> tuple[str, str, str, str]:
        """Return set, texture, noise and method."""
        return self.name, self.texture, self.noise, self.method

    @property
    def command(self) -> str:
        """Return the arguments of ``mitsonar benchmark odometry`` that produce this row."""
        geometry = [] if self.geometry is None else [f"--geometry {self.geometry}"]
        if self.texture == "recorded":
            return " ".join([f"--set {self.name}", *geometry, f"--method {self.method}"])
        noise = [] if self.noise == PRESET else [f"--noise {self.noise}"]
        return " ".join([f"--set {self.name} --texture {self.texture}", *noise, f"--method {self.method}"])


def measure_row(
    case: Case,
    source: FrameSource,
    estimator: AnyEstimator,
    folder: Path,
    *,
    bound: Array | None = None,
    workers: int = 1,
    progress: Callable[[int], None] = lambda pairs: None,
) -> PlainTable:
    """Estimate the path of a set, and compute what the table of the benchmark shows.

    Invalid motions are failures; they are bridged from their neighbours, as :func:`mitsonar.mapping.odometry.odometry` does.

    Args:
        case: what the row measures.
        source: of its frames.
        estimator: the method.
        folder: of the odometry; an interrupted run is resumed.
        bound: of a motion ``(3,)`` [m, m, rad], where it is known.
        workers: number of worker processes; 1 computes in this process.
        progress: called with the number of pairs that were added.

    Returns:
        Numbers, lists and texts, for JSON: None where a number is not known.

    Raises:
        MitsonarError: frames that the estimator does not take.
    """
    pairs = len(source) - 1
    row: PlainTable = dict(zip(("set", "texture", "noise", "method"), case.key, strict=True))
    row |= {"command": case.command, "inputs": estimator.inputs, "frames": len(source), "pairs": pairs, "note": ""}
    loop = LOOP if source.true is None and pairs > LOOP else 0
    try:
        options = OdometryOptions(closure=loop, workers=workers)
        odometry = run_odometry(source, case.method, estimator, folder, options, resume=True, progress=progress)
    except MitsonarError as error:
        estimates = _failed_estimates(folder)
        if len(estimates) < pairs or any(estimate.valid for estimate in estimates):
            raise
        return row | {"failures": pairs, "note": str(error), "ms": _milliseconds(source, estimator)}
    row |= {"failures": int((~odometry.valid).sum()), "ms": _milliseconds(source, estimator)}
    row |= {"estimated_path_m": path_length(odometry.path)}
    return row | (_without_truth(odometry) if odometry.true is None else _against_truth(odometry, odometry.true, bound))


def _failed_estimates(folder: Path) -> list[Estimate]:
    """Return the estimates of a row that failed."""
    if not (folder / "run.json").exists():
        return []
    return list(OdometryFolder(RunDirectory.open(folder, ODOMETRY)).read_journals().pairs.values())


def _without_truth(odometry: Odometry) -> PlainTable:
    """Return the results of a path without truth: net motion, and the closure error of loops."""
    end = odometry.path.poses[-1] - odometry.path.poses[0]
    row: PlainTable = {"net": [float(end[0]), float(end[1]), float(np.degrees(end[5]))]}
    row |= {"sums": in_units(odometry.series.motions.sum(axis=0)).tolist()}
    if odometry.closure is not None:
        row |= {"closure_steps": odometry.closure.steps, "closure": in_units(odometry.closure.rms).tolist()}
    return row


def _against_truth(odometry: Odometry, true: Trajectory, bound: Array | None) -> PlainTable:
    """Return the errors of a path: drift over segments, at the end, and of single motions."""
    at_frames = Trajectory(true.poses[odometry.frames], true.time_s[odometry.frames])
    row: PlainTable = {"path_m": path_length(at_frames)}
    drift = segment_drift(odometry.path, at_frames, LENGTHS_M)
    if drift is not None:
        percent, degrees = drift.intervals()
        row |= {"drift_percent": [drift.percent, *percent], "drift_deg_per_100m": [drift.deg_per_100m, *degrees]}
        row |= {"lengths_m": list(drift.lengths_m), "segments": len(drift.length_m), "blocks": len(np.unique(drift.blocks))}
    end = 100 * assess(odometry.path, at_frames).end_drift
    row |= {"end_percent": end if np.isfinite(end) else None}
    truth, block = motions(at_frames.poses), distance_driven(at_frames)[:-1] // LENGTHS_M[0]
    errors = motion_errors(odometry.series.motions, truth, np.ones(len(truth), dtype=bool), None, cluster_resamples(block))
    row |= {name: getattr(errors, name).tolist() for name in ("rmse", "rmse_low", "rmse_high", "zero", "bias")}
    nees = _nees(odometry.estimates, truth)
    row |= {"nees": nees if np.isfinite(nees) else None}
    if bound is not None:
        units = in_units(bound)
        known = (units > 0) & np.isfinite(units)
        ratios = np.divide(errors.rmse, units, out=np.zeros(3), where=known)
        row |= {"bound": units.tolist()} if np.isfinite(units).all() else {}
        row |= {"over_bound": [float(ratio) if is_known else None for ratio, is_known in zip(ratios, known, strict=True)]}
    return row


def _nees(estimates: list[Estimate], truth: Array) -> float:
    """Return a third of the mean normalised squared error of the valid estimates; nan where no covariance is known."""
    unknown = np.full((3, 3), np.nan)
    motion = np.array([estimate.motion for estimate in estimates], dtype=float)
    covariance = np.array([unknown if estimate.covariance is None else estimate.covariance for estimate in estimates])
    return motion_errors(motion, truth, np.array([estimate.valid for estimate in estimates], dtype=bool), covariance).nees


def _milliseconds(source: FrameSource, estimator: AnyEstimator) -> float:
    """Return the median processor time of an estimate, all threads together, after a first one that loads [ms]."""
    first_frames = np.unique(np.linspace(0, len(source) - 2, TIMED_PAIRS).astype(int))
    answers, threads = Answers.unasked(len(first_frames)), cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        estimator.estimate(source.read([first_frames[0], first_frames[0] + 1]))
        for index, start in enumerate(first_frames):
            answers.ask(index, estimator, source.read([start, start + 1]))
    finally:
        cv2.setNumThreads(threads)
    return float(np.median(answers.ms))


# ---------------- The simulated sets of the odometry benchmark: worlds that no training saw, dives and one course,
# still texture or speckle
# A set is rendered once into the folder of the benchmark. *Still texture*: the model ``physical``, in which a cell of the
# ground has the same brightness in every frame. *Speckle*: the model ``coherent``, in which grain changes as the sonar
# moves.


SEED = 730_022
"""Of the worlds, the rays and the noise. Worlds of recipes have other seeds, hashes of the data set's seed and the scene."""

STEP_M = 0.02
"""Distance of the vehicle from frame to frame [m]: the largest that the shipped networks were trained for."""

TURN_RAD, TURN_M = np.radians(6.0), 2.5
"""The heading swings by this angle, with this period along the path [m]: at most 0.3 deg per frame."""

CRAB_RAD, CRAB_M = np.radians(30.0), 1.7
"""The same for the angle between path and heading: sideways motions of at most 10 mm."""

DIVE_M_PER_S, DIVE_HZ = 0.4, 10.0

TEXTURES: dict[str, dict[str, Any]] = {
    "still": {"model": "physical", "quality": "standard"},
    "speckle": {"model": "coherent", "quality": "standard", "coding": "gamma", "coding_gamma": 0.5, "gain_exponent": 4},
}
"""Changes of the sonar for each texture."""

PRESET = "preset"
"""The noise of a dive: that of the preset in its model, which is none in ``physical``."""

NOISES = ("none", "low", "high")
"""Levels of noise. Of still texture: Almanza-Medina's. Of speckle the receiver's: none, the preset's, or one raised to 6 dB
below the echo of the median cell."""

Begin = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
"""Called with the name and the length of a stage; the value of its context is called with the amount newly done."""


@dataclass(frozen=True)
class SimulatedSet:
    """A world and a sonar over it.

    Attributes:
        family: of the world.
        preset: of the sonar.
        window: changes of the preset.
        height_m: of the vehicle over z = 0 [m].
        pitch_deg: of the sonar [deg].
        raised_db: by which the preset's receiver noise is raised for ``high`` [dB].
        slope_deg: angle at which the ground rises forward [deg].
        flight: None for the course of :func:`benchmark_course`, or a name of :data:`FLIGHTS`: a dive, with quality, coding
            and noise of the preset.
        seed: of world, rays and dive.
        frames: default number of frames.
    """

    family: Family
    preset: str
    window: dict[str, Any]
    height_m: float
    pitch_deg: float
    raised_db: float
    slope_deg: float = 0.0
    flight: str | None = None
    seed: int = SEED
    frames: int = 260

    def sonar(self, texture: str, noise: str) -> Sonar:
        """Return the sonar of a texture and a level of receiver noise."""
        if self.flight is not None:
            changes = {**self.window, "model": TEXTURES[texture]["model"], "seed": self.seed}
            return load_sonar(self.preset).replace(**changes)
        sonar = load_sonar(self.preset).replace(**self.window, **TEXTURES[texture], seed=SEED)
        if texture == "still" or sonar.noise_level_db is None:
            return sonar
        levels = {"none": None, "low": sonar.noise_level_db, "high": sonar.noise_level_db + self.raised_db}
        return sonar.replace(noise_level_db=levels[noise])

    def path(self, frames: int, rate_hz: float) -> Trajectory:
        """Return the poses of the sonar on its course; a dive has ten frames a second of every sonar."""
        if self.flight is None:
            vehicle = benchmark_course(frames)
        else:
            rate_hz = DIVE_HZ
            vehicle = dive_course(frames, rate_hz, self.seed, FLIGHTS[self.flight])
        vehicle[:, 2] += self.height_m
        return Trajectory(mounted(vehicle, Pose.from_degrees([0, 0, 0, self.pitch_deg, 0, 0])), np.arange(frames) / rate_hz)

    def world(self, folder: Path) -> Path:
        """Write the world into a folder, if it is missing there, and return its scene."""
        scene = folder / "scene.xml"
        if not scene.exists():
            built = self.family.build(self.seed)
            (sloped(built, self.slope_deg) if self.slope_deg else built).write(folder)
        return scene


DIVE_FIELD = RockyField(size_m=40, a_side=(20, 60), centre_height_m=(0.0, 0.2), rock_size_m=(0.0, 0.3))

DIVE_SONARS: dict[str, tuple[dict[str, Any], float, float]] = {
    "didson300": ({}, 2.5, 35),
    "aris3000": ({"range_bins": 600}, 1.6, 30),
    "oculus-m1200d-2100khz": ({"beams": 160, "range_bins": 500, "range_max": 8.0}, 2.0, 20),
    "oculus-m750d-750khz": ({"beams": 160, "range_bins": 500, "range_max": 20.0}, 4.0, 20),
    "blueview-p900-45": ({"beams": 128, "range_bins": 500, "range_max": 15.0}, 3.0, 20),
    "gemini-720is": ({"beams": 160, "range_bins": 500, "range_max": 20.0}, 4.0, 20),
    # as recorded: eight ping groups, looks, tails
    "didson300-recorded": ({}, 2.5, 35),
    "aris3000-recorded": ({"range_bins": 600}, 1.6, 30),
}
"""The presets that dive: changes that save time, height [m], pitch [deg]."""

FLIGHTS = {"level": 0.0, "gentle": 1.0}
"""Amplitude of the vehicle's swing, relative to a calm day: see :func:`dive_course`."""

DIVE_SEEDS = (3, 11, 20)

DIVE = "dive"
"""Prefix of the names of all dives."""

SETS: dict[str, SimulatedSet] = {
    **{
        f"{DIVE}-{preset}-{flight}-{seed}": SimulatedSet(
            DIVE_FIELD, preset, window, height_m, pitch_deg, 0.0, flight=flight, seed=seed, frames=40
        )
        for preset, (window, height_m, pitch_deg) in DIVE_SONARS.items()
        for flight in FLIGHTS
        for seed in DIVE_SEEDS
    },
    # DIDSON over rocks
    "rocks": SimulatedSet(RockyField(size_m=30), "didson300", {"range_min": 3.2, "range_max": 5.6}, 2.5, 35, 16),
    # Oculus of 130 deg over rocks that rise forward
    "slope": SimulatedSet(
        RockyField(size_m=30),
        "oculus-m750d-750khz",
        {"range_min": 5.0, "range_max": 9.0, "range_bins": 400, "beams": 256},
        2.5,
        25,
        35,
        slope_deg=10,
    ),
    # DIDSON along a hull
    "hull": SimulatedSet(ShipHull(), "didson300", {"range_min": 1.5, "range_max": 5.0}, 0.32, 4, 22),
}
"""The sets by name."""


def benchmark_course(frames: int) -> NDArray[np.float64]:
    """Return the course of all sets, about the origin: poses ``(frames, 6)`` [m, rad] at z = 0.

    The vehicle moves by :data:`STEP_M` per frame along a swinging line, and crabs.
    """
    distance_m = np.arange(frames) * STEP_M
    heading = TURN_RAD * np.sin(2 * np.pi * distance_m / TURN_M)
    course = heading + CRAB_RAD * np.sin(2 * np.pi * distance_m / CRAB_M)
    poses = np.zeros((frames, 6))
    middle = (course[1:] + course[:-1]) / 2
    poses[1:, 0], poses[1:, 1] = np.cumsum(STEP_M * np.sin(middle)), np.cumsum(STEP_M * np.cos(middle))
    poses[:, 5] = heading
    poses[:, :2] -= (poses[0, :2] + poses[-1, :2]) / 2
    return poses


def dive_course(frames: int, rate_hz: float, seed: int, moves: float) -> NDArray[np.float64]:
    """Return the course of a vehicle at 0.4 m/s from the origin: poses ``(frames, 6)`` [m, rad].

    Args:
        frames: number of poses.
        rate_hz: of them [1/s].
        seed: of the phases.
        moves: amplitude of the swing. 1 is a calm day: heading +-8 deg in 6 s, heave +-4 cm in 3.1 s, pitch +-2 deg in
            2.3 s and roll +-2 deg in 2.9 s; 0 is straight ahead.
    """
    time_s, phase = np.arange(frames) / rate_hz, np.random.default_rng(seed).uniform(0, 2 * np.pi, 4)
    periods, sizes = np.array([6.0, 3.1, 2.3, 2.9]), np.array([np.radians(8), 0.04, np.radians(2), np.radians(2)])
    swing = moves * sizes * np.sin(2 * np.pi * time_s[:, None] / periods + phase)
    poses = np.zeros((frames, 6))
    poses[:, 5] = swing[:, 0] - swing[0, 0]
    poses[:, 2:5] = swing[:, 1:]
    step = DIVE_M_PER_S / rate_hz
    poses[1:, 0], poses[1:, 1] = step * np.cumsum(np.sin(poses[:-1, 5])), step * np.cumsum(np.cos(poses[:-1, 5]))
    return poses


@dataclass(frozen=True)
class RenderedSet:
    """A simulated set with a texture and noise, in the folder of a benchmark.

    Attributes:
        name: of the set, of :data:`SETS`.
        texture: of :data:`TEXTURES`.
        noise: of :data:`NOISES`.
        frames: number of frames.
        out: folder of the benchmark.
    """

    name: str
    texture: str
    noise: str
    frames: int
    out: Path

    @property
    def simulated(self) -> SimulatedSet:
        """Return the set."""
        return SETS[self.name]

    @property
    def folder(self) -> Path:
        """Return the folder of the frames; noise of still texture is added when they are read."""
        return self.out / "sets" / "-".join([self.name, self.texture, *([self.noise] if self.texture == "speckle" else [])])

    def source(self, begin: Begin) -> FrameSource:
        """Return the frames; render those that are missing."""
        sonar = self.simulated.sonar(self.texture, self.noise)
        if not self._finished():
            path = self.simulated.path(self.frames, sonar.frame_rate_hz)
            origin = {"set": self.name, "seed": self.simulated.seed}
            with begin(f"rendering {self.folder.name}", self.frames) as progress:
                destination = Destination(self.folder, origin, resume=True, progress=progress)
                run(self._simulator(sonar), path, RenderOptions(NOISE_MODELS["none"]), destination)
            release_memory()
        source = replace(open_frames(self.folder), name=self.folder.name)
        return source.with_noise(self._noise, SEED) if self.texture == "still" else source

    @property
    def _noise(self) -> NoiseModel:
        """Return the noise that is added to pixels."""
        return NOISE_MODELS[self.noise if self.texture == "still" and self.noise != PRESET else "none"]

    def _finished(self) -> bool:
        return (self.folder / "run.json").exists() and RunDirectory.open(self.folder, RENDERING).finished

    def _simulator(self, sonar: Sonar) -> Simulator:
        from mitsonar.simulation.simulator import Simulator

        world = self.name if self.simulated.flight is None else f"{DIVE}-{self.simulated.seed}"
        return Simulator(load_scene(self.simulated.world(self.out / "worlds" / world)), sonar)

    def bound(self, poses: int, begin: Begin) -> NDArray[np.float64]:
        """Return the Cramer-Rao lower bound of a motion ``(3,)`` [m, m, rad]: root of the mean variance over some poses.

        Raises:
            MitsonarError: the frames are not rendered.
        """
        gain = RunDirectory.open(self.folder, RENDERING).amount("gain")
        if gain is None:
            raise MitsonarError(f"{self.folder} has no gain: render it again")
        sonar = self.simulated.sonar(self.texture, self.noise)
        path = self.simulated.path(self.frames, sonar.frame_rate_hz)
        sampled_poses = path.poses[np.linspace(0, self.frames - 1, poses + 2).astype(int)[1:-1]]
        noise, law = self._noise, list(laws_of(sonar))[-1]
        stds = []
        with begin(f"bound of {'-'.join((self.name, self.texture, self.noise))}", poses) as progress:
            for bounds in bounds_at(self._simulator(sonar), sampled_poses, noise, gain):
                bound = next(value for (_, kind, law_name), value in bounds.items() if (kind, law_name) == ("image", law))
                stds.append(np.zeros(3) if bound is None else bound.std(2))
                progress(1)
        release_memory()
        return overall(stds)


# ---------------- odometry benchmark


METHODS = ("zero", "ecc", "phase", "flow", "direct", "corrnet", "corrnet-coherent", *EXTERNAL)
"""Default methods, except for those in :data:`UNSUITED_NETWORKS`."""

UNSUITED_NETWORKS = {"still": "corrnet-coherent", "speckle": "corrnet", "recorded": "corrnet"}
"""The network that was not trained for frames of a texture."""

SET_NAMES = (DIVE, *(name for name, one in SETS.items() if one.flight is None))

LARGEST_JOURNAL = 2**28

BENCHMARK = RunKind(
    "odometry benchmark",
    outputs=("rows.jsonl", "table.md", "table.json", "bounds", "paths", "sets", "worlds"),
    notes={},
    packages=("mitsonar", "numpy", "scipy", "mitsuba", "opencv-python-headless"),
    deciding=("mitsonar",),
)


@dataclass(frozen=True)
class Wanted:
    """The requested rows: every method on every set, texture and level of noise.

    Attributes:
        sets: names of :data:`~mitsonar.reproduction.odometry_benchmark.SETS`, or paths of recordings and runs. The beginning
            of a name up to a hyphen means all of these sets: ``dive``, ``dive-aris3000``.
        textures: of :data:`~mitsonar.reproduction.odometry_benchmark.TEXTURES`, for simulated sets.
        noises: of :data:`~mitsonar.reproduction.odometry_benchmark.NOISES`, for simulated sets; dives have their preset's.
        methods: as :func:`~mitsonar.estimation.named.create_estimator` takes them; none: :data:`METHODS`, without
            those whose packages are not installed.
        frames: of each set at most; None: 40 of a dive, 260 of another simulated set, all of a recording.
        geometry: file that describes the layout of the recordings' pictures.
        bound: poses of the Cramer-Rao bound of a simulated set; 0: none.
    """

    sets: Sequence[str] = SET_NAMES
    textures: Sequence[str] = tuple(TEXTURES)
    noises: Sequence[str] = ("none",)
    methods: Sequence[str] = ()
    frames: int | None = None
    geometry: Path | None = None
    bound: int = 3


def benchmark_odometry(
    request: Wanted,
    out: str | Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    workers: int = 1,
    begin: Begin = lambda stage, total: nullcontext(lambda done: None),
) -> PlainTable:
    """Make the rows that are missing, and write the table of all rows in the folder.

    Args:
        request: the rows.
        out: folder: ``rows.jsonl`` with one line per row; ``table.md`` and ``table.json``; rendered sets, and the path of
            each row.
        resume: add rows to an existing folder. Its rows are kept, and an interrupted one is resumed.
        overwrite: replace an existing folder.
        workers: number of processes that estimate.
        begin: called with each stage, for progress.

    Returns:
        The content of ``table.json``: ``rows``, and ``notes`` for the reader.

    Raises:
        MitsonarError: unknown names, no frames, or another benchmark in the folder.
    """
    cells = list(_cells(request))
    methods, notes = _methods(request)
    cases = [case for cell in cells for case in _cases(cell, methods, request)]
    settings = {"limit": request.frames, "seed": SEED, "lengths_m": LENGTHS_M}
    bench = _Bench(RunDirectory.begin(out, BENCHMARK, settings, resume=resume, overwrite=overwrite), request)
    bench.run.start()
    rows = bench.rows()
    for case in cases:
        if case.key in rows:
            continue
        try:
            row = bench.measure(case, methods[case.method], workers, begin)
        except MitsonarError as error:
            notes.append(f"{' '.join(case.key)}: {error}")
            continue
        bench.append(row)
        rows[case.key] = row
    return bench.finish(sorted(rows.values(), key=_order), notes)


# ---------------------------------------------------------------- the requested rows


def _methods(request: Wanted) -> tuple[dict[str, AnyEstimator], list[str]]:
    """Create the estimators by name. Leave out default ones that cannot be created, with a note."""
    if request.methods:
        chosen = {name: create_estimator(name) for name in dict.fromkeys(request.methods)}
        unsuited = [name for name, estimator in chosen.items() if estimator.consumes not in (SonarFrames, object)]
        if unsuited:
            raise MitsonarError(f"{unsuited[0]} does not read frames of one view: the benchmark takes {', '.join(METHODS)}")
        return chosen, []
    estimators, notes = {}, []
    for name in METHODS:
        try:
            estimators[name] = create_estimator(name)
        except MitsonarError as error:
            notes.append(f"no row of {name}: {error}")
    return estimators, notes


def names_of(set_name: str) -> list[str]:
    """Return the names that pick a set: its own, and those of all dives, of the dives of a sonar, or of its flight."""
    if not set_name.startswith(f"{DIVE}-"):
        return [set_name]
    of_sonar = set_name.rsplit("-", 2)[0]
    return [set_name, set_name.rsplit("-", 1)[0], of_sonar, DIVE]


def _cells(request: Wanted) -> Iterator[Case]:
    """List sets with texture and noise, as cases without a method.

    Raises:
        MitsonarError: unknown names, or no such file.
    """
    for kind, names, known in (("texture", request.textures, TEXTURES), ("noise", request.noises, NOISES)):
        for choice in names:
            if choice not in known:
                raise MitsonarError(f"unknown {kind} {choice!r}: {suggest_names(choice, known)}")
    if request.frames is not None and request.frames < 3:
        raise MitsonarError(f"{argument('frames')} must be at least 3: got {request.frames}")
    for name in dict.fromkeys(request.sets):
        sets = [set_name for set_name in SETS if name in names_of(set_name)]
        if sets:
            yield from (
                Case(set_name, texture, noise, "")
                for set_name in sets
                for texture in request.textures
                for noise in (request.noises if SETS[set_name].flight is None else (PRESET,))
            )
        elif not Path(name).exists():
            raise MitsonarError(
                f"unknown set {name!r}: {suggest_names(name, SET_NAMES)}; or give the path of a recording or a run"
            )
        else:
            if record_at(name) is not SonarFrames:
                raise MitsonarError(
                    f"{name} holds impulse responses, but the benchmark needs frames: give a recording or a run of frames"
                )
            yield Case(name, "recorded", "none", "", request.geometry)


def _cases(cell: Case, methods: dict[str, AnyEstimator], request: Wanted) -> Iterator[Case]:
    """List the rows of a cell."""
    excluded = "" if request.methods else UNSUITED_NETWORKS[cell.texture]
    yield from (replace(cell, method=name) for name in methods if name != excluded)


def _order(row: PlainTable) -> tuple[int, str, str, int, int, str]:
    """Return the sort key of a row: sets, textures, noises and methods in their listed order, others after them."""
    orders = [[*SETS], [*NOISES], [*METHODS]]
    choices = row["set"], row["noise"], row["method"]
    positions = [
        known.index(choice) if choice in known else len(known) for known, choice in zip(orders, choices, strict=True)
    ]
    return (
        positions[0],
        row["set"],
        "" if row["texture"] == "still" else row["texture"],
        positions[1],
        positions[2],
        row["method"],
    )


# ---------------------------------------------------------------- the folder


class _Bench:
    """The folder of a benchmark.

    Attributes:
        opening_notes: warnings from opening recordings, each once, since every method gives the same.
    """

    def __init__(self, run: RunDirectory, request: Wanted) -> None:
        self.run, self.out, self.request = run, run.path, request
        self.opening_notes: dict[str, None] = {}
        self.journal = run.path / "rows.jsonl"

    def rows(self) -> dict[tuple[str, str, str, str], PlainTable]:
        """Return the rows of earlier runs. Cut off a half-written last line.

        Raises:
            MitsonarError: the journal is damaged.
        """
        rows = {}
        for number, line in enumerate(whole_lines(self.journal, "journal", LARGEST_JOURNAL), start=1):
            try:
                row = parse_json(line, "the line")
                rows[row["set"], row["texture"], row["noise"], row["method"]] = row
            except Exception:  # a line leads to whatever its bytes do
                raise MitsonarError(f"{self.journal}, line {number} is damaged: start over with --overwrite") from None
        return rows

    def append(self, row: PlainTable) -> None:
        """Add a row to the journal."""
        with self.journal.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def measure(self, case: Case, estimator: AnyEstimator, workers: int, begin: Begin) -> PlainTable:
        """Make a row; render its set where it is missing."""
        rendered = None
        if case.name in SETS:
            rendered = RenderedSet(
                case.name, case.texture, case.noise, self.request.frames or SETS[case.name].frames, self.out
            )
            source = rendered.source(begin)
        else:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", MitsonarWarning)
                source = _recorded(case, estimator, self.request.frames)
            self.opening_notes |= dict.fromkeys(
                str(warning.message) for warning in caught if warning.category is MitsonarWarning
            )
        bound = None if rendered is None or not self.request.bound else self._bound(case, rendered, begin)
        loops = 0 if source.true is not None else max(0, len(source) - 1 - LOOP)
        with begin(" ".join(case.key), len(source) - 1 + loops) as progress:
            folder = self.out / "paths" / _folder_name(case)
            return measure_row(case, source, estimator, folder, bound=bound, workers=workers, progress=progress)

    def _bound(self, case: Case, rendered: RenderedSet, begin: Begin) -> NDArray[np.float64] | None:
        """Return the bound of a set, computed once; None if it cannot be computed."""
        path = self.out / "bounds" / f"{case.name}-{case.texture}-{case.noise}-{self.request.bound}.json"
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            try:
                std = rendered.bound(self.request.bound, begin).tolist()
            except MitsonarError as error:
                write_json(path, {"std": None, "reason": str(error)})
            else:
                write_json(path, {"std": std, "reason": ""})
        std = read_json(path)["std"]
        return None if std is None else np.array(std, dtype=float)

    def finish(self, rows: list[PlainTable], notes: list[str]) -> PlainTable:
        """Write the table of all rows."""
        report: PlainTable = {**self.run.settings, "loop": LOOP, "notes": [*self.opening_notes, *notes], "rows": rows}
        report |= versions(BENCHMARK.packages)
        write_atomic(self.out / "table.md", ("\n".join(benchmark_lines(rows)) + "\n").encode())
        write_json(self.out / "table.json", report)
        self.run.finish()
        return report


def _recorded(case: Case, estimator: AnyEstimator, frames: int | None) -> FrameSource:
    """Open a recording or a run, its first frames only.

    Raises:
        MitsonarError: fewer than two frames, or frames that the estimator does not take.
    """
    source = cast(FrameSource, open_source(case.name, estimator, Reading(geometry=case.geometry)))
    source = source if frames is None else _first(source, frames)
    if len(source) < 2:
        raise MitsonarError(f"a row of the benchmark needs at least two frames: got {len(source)} from {case.name}")
    return source


def _first(source: FrameSource, count: int) -> FrameSource:
    """Return the first frames of a source."""
    poses, attitude, height = source.poses, source.attitude_rad, source.height_m
    return replace(
        source,
        time_s=source.time_s[:count],
        poses=None if poses is None else poses[:count],
        attitude_rad=None if attitude is None else attitude[:count],
        height_m=None if height is None else height[:count],
    )


def _folder_name(case: Case) -> str:
    """Return the name of the folder of a row's path; for a file it contains a digest of the file's path."""
    name = case.name if case.name in SETS else f"{Path(case.name).stem}-{digest(str(Path(case.name).resolve()))[:8]}"
    plain = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in case.method)
    return "-".join((name, case.texture, case.noise, plain))


# ---------------- The tables of the odometry benchmark as Markdown: dives, drift of the other sets, then a part for
# each of these


FEWEST_BLOCKS = 10
"""Fewest blocks of a path for intervals; with fewer they are too narrow."""

UNITS = " / ".join(f"{axis.name} {axis.unit}" for axis in AXES)


def benchmark_lines(rows: Sequence[PlainTable]) -> list[str]:
    """Return the rows, in their order, as lines of Markdown."""
    dives = [row for row in rows if row["set"].startswith(f"{DIVE}-")]
    parts = [list(group) for _, group in groupby([row for row in rows if row not in dives], key=_cell)]
    return [*_dives(dives), *_overview(parts), *(line for part in parts for line in _part(part))]


def _dives(rows: Sequence[PlainTable]) -> Iterator[str]:
    """Yield one table per method, with one line per sonar, texture and flight, over all their worlds."""
    for method in dict.fromkeys(row["method"] for row in rows):
        groups: dict[tuple[str, str, str], list[PlainTable]] = {}
        for row in rows:
            if row["method"] == method:
                preset, flight = _parse_dive(row["set"])
                groups.setdefault((preset, row["texture"], flight), []).append(row)
        worlds = max(len(group) for group in groups.values())
        yield from ("", f"**Dives, {method}**: RMSE and bound: {UNITS}; of {worlds} worlds, drift is the median", "")
        yield from markdown([_dive(*key, group) for key, group in groups.items()], tuple(DIVE_CELLS), DIVE_CELLS)


def _parse_dive(name: str) -> tuple[str, str]:
    """Return preset and flight of a dive's name."""
    preset, flight, _ = name.removeprefix(f"{DIVE}-").rsplit("-", 2)
    return preset, flight


def _dive(preset: str, texture: str, flight: str, rows: Sequence[PlainTable]) -> PlainTable:
    """Return the line of a dive from the rows of its worlds."""
    known = [row for row in rows if "path_m" in row]
    line: PlainTable = {"sonar": preset, "texture": texture, "flight": flight, "pairs": sum(row["pairs"] for row in rows)}
    line |= {"failures": sum(row["failures"] for row in rows), "ms": float(np.median([row["ms"] for row in rows]))}
    if not known:
        return line
    for name in ("rmse", "bound"):
        if all(row.get(name) is not None for row in known):
            line[name] = np.sqrt(np.mean([np.square(row[name]) for row in known], axis=0)).tolist()
    weighted_nees = [(row["nees"], row["pairs"] - row["failures"]) for row in known if row.get("nees") is not None]
    if weighted_nees:
        line["nees"] = float(np.average([nees for nees, _ in weighted_nees], weights=[count for _, count in weighted_nees]))
    drifts = [row["end_percent"] for row in known if row["end_percent"] is not None]
    line["end_percent"] = float(np.median(drifts)) if drifts else None
    return line


def _overview(parts: list[list[PlainTable]]) -> Iterator[str]:
    """Yield a table of drift in percent: one line per method, one column per set; nothing for a single set."""
    with_truth = [part for part in parts if any("path_m" in row for row in part)]
    drifts = {", ".join(_cell(part[0])): {row["method"]: row for row in part} for part in with_truth}
    if len(drifts) < 2:
        return
    methods = dict.fromkeys(name for by_method in drifts.values() for name in by_method)
    texts: Cells = {name: _drift_in(name) for name in drifts}
    lines: list[PlainTable] = [
        {"method": method, **{name: by_method.get(method, {}) for name, by_method in drifts.items()}} for method in methods
    ]
    yield from ("", "Drift over segments, % of their length; after a comma the motions that failed, %", "")
    yield from markdown(lines, ("method", *drifts), {"method": CELLS["method"], **texts})


def _drift_in(name: str) -> Callable[[PlainTable], str]:
    """Return a function that formats the drift and the failures of a method in a set."""

    def text(line: PlainTable) -> str:
        row = line[name]
        if not row:
            return ""
        failed = f", {100 * row['failures'] / row['pairs']:.0f}" if row["failures"] else ""
        return f"{row['drift_percent'][0]:.1f}{failed}" if row.get("drift_percent") else f"-{failed}"

    return text


def _cell(row: PlainTable) -> tuple[str, str, str]:
    return row["set"], row["texture"], row["noise"]


def _part(rows: list[PlainTable]) -> Iterator[str]:
    """Yield heading, facts and table of one set."""
    first = rows[0]
    with_truth = [row for row in rows if "path_m" in row]
    noise = "" if first["texture"] == "recorded" else f", noise {first['noise']}"
    yield from ("", f"**{first['set']}, {first['texture']}{noise}**: {'; '.join(_facts(first, with_truth))}", "")
    yield from markdown(rows, COLUMNS if with_truth else CLOSURE_COLUMNS, CELLS)
    yield from (f"- {row['method']}: {row['note']}" for row in rows if row["note"])


def _facts(first: PlainTable, with_truth: list[PlainTable]) -> Iterator[str]:
    """Yield the facts that are common to all rows."""
    yield f"{first['frames']} frames"
    if not with_truth:
        yield f"no truth; net motion and closure: {UNITS}"
        return
    row = with_truth[0]
    yield f"path {row['path_m']:.2f} m; RMSE: {UNITS}"
    if row.get("bound") is not None:
        yield f"bound {_format_three(row['bound'])}"
    if "segments" in row:
        lengths = ", ".join(f"{length:g}" for length in row["lengths_m"])
        caveat = f", so few that intervals are too narrow (95 %, over {row['blocks']} blocks)"
        blocks = caveat if row["blocks"] < FEWEST_BLOCKS else f", 95 % intervals over {row['blocks']} blocks"
        yield f"{row['segments']} segments of {lengths} m{blocks}"


DIGITS = (2, 2, 3)


def _format_three(values: Sequence[float | None], digits: Sequence[int] = DIGITS) -> str:
    return " / ".join("-" if value is None else f"{value:.{d}f}" for value, d in zip(values, digits, strict=True))


def _with_interval(row: PlainTable, name: str, digits: int) -> str:
    """Return a value with its interval."""
    if row.get(name) is None:
        return "-"
    value, low, high = row[name]
    return f"{value:.{digits}f} ({low:.{digits}f}..{high:.{digits}f})"


CELLS: Cells = {
    "method": lambda row: str(row["method"]),
    "drift %": lambda row: _with_interval(row, "drift_percent", 1),
    "drift deg / 100 m": lambda row: _with_interval(row, "drift_deg_per_100m", 0),
    "end %": lambda row: "-" if row.get("end_percent") is None else f"{row['end_percent']:.1f}",
    "RMSE": lambda row: _format_three(row["rmse"]) if "rmse" in row else "-",
    "/ bound": lambda row: _format_three(row["over_bound"], (0, 0, 0)) if "over_bound" in row else "-",
    "nees": lambda row: "-" if row.get("nees") is None else f"{row['nees']:.1f}",
    "net motion": lambda row: _format_three(row["sums"]) if "sums" in row else "-",
    "closure": lambda row: _format_three(row["closure"]) if "closure" in row else "-",
    "fail": lambda row: f"{row['failures']} of {row['pairs']}",
    "ms": lambda row: f"{row['ms']:.0f}",
}

DIVE_CELLS: Cells = {
    "sonar": lambda row: str(row["sonar"]),
    "texture": lambda row: str(row["texture"]),
    "flight": lambda row: str(row["flight"]),
    "rejected": lambda row: f"{row['failures']} of {row['pairs']}",
    "RMSE": CELLS["RMSE"],
    "bound": lambda row: _format_three(row["bound"]) if "bound" in row else "-",
    "NEES": lambda row: "-" if row.get("nees") is None else f"{row['nees']:.2f}",
    "drift %": lambda row: "-" if row.get("end_percent") is None else f"{row['end_percent']:.2f}",
    "ms": CELLS["ms"],
}

COLUMNS = ("method", "drift %", "drift deg / 100 m", "end %", "RMSE", "/ bound", "nees", "fail", "ms")
CLOSURE_COLUMNS = ("method", "net motion", "closure", "fail", "ms")
