"""The simulated sets of the odometry benchmark: worlds that no training saw, dives and one course, still texture or speckle.

A set is rendered once into the folder of the benchmark and kept. *Still texture*: the model ``physical``, in which a cell of
the ground is as bright in every frame. *Speckle*: the model ``coherent``, in which grain changes as the sonar moves.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.noise import NOISE_MODELS, NoiseModel
from mitsonar.errors import MitsonarError
from mitsonar.estimation.crlb.image import bounds_at, laws_of, overall
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar
from mitsonar.io.runs import RunDirectory
from mitsonar.mapping.frame_source import FrameSource
from mitsonar.mapping.open_frames import open_frames
from mitsonar.motion.pose import Pose, mounted
from mitsonar.motion.trajectory import Trajectory
from mitsonar.simulation.device import release_memory
from mitsonar.simulation.runs import RENDERING, Outputs, run
from mitsonar.simulation.scene import load_scene
from mitsonar.worlds.families import RockyField, ShipHull
from mitsonar.worlds.world import Family, sloped

if TYPE_CHECKING:
    from mitsonar.simulation.simulator import Simulator

__all__ = [
    "DIVE",
    "NOISES",
    "PRESET",
    "SEED",
    "SETS",
    "TEXTURES",
    "Begin",
    "RenderedSet",
    "SimulatedSet",
    "benchmark_course",
    "dive_course",
]

SEED = 730_022
"""Of the worlds, the rays and the noise. Worlds of recipes have other seeds, hashes of the data set's seed and the scene."""

STEP_M = 0.02
"""Way of the vehicle from frame to frame [m]: the largest that the shipped networks were trained for."""

TURN_RAD, TURN_M = np.radians(6.0), 2.5
"""The heading swings by this angle, over so many metres of way: 0.3 deg a frame at most."""

CRAB_RAD, CRAB_M = np.radians(30.0), 1.7
"""So does the angle between way and heading: sideways motions of 10 mm at most."""

DIVE_M_PER_S, DIVE_HZ = 0.4, 10.0

TEXTURES: dict[str, dict[str, Any]] = {
    "still": {"model": "physical", "quality": "standard"},
    "speckle": {"model": "coherent", "quality": "standard", "coding": "gamma", "coding_gamma": 0.5, "gain_exponent": 4},
}
"""What a texture is, as changes of the sonar."""

PRESET = "preset"
"""The noise of a dive: what the preset has in its model, which is none in ``physical``."""

NOISES = ("none", "low", "high")
"""Levels of noise. Of still texture: Almanza-Medina's. Of speckle the receiver's: none, the preset's, or one raised to 6 dB
below the echo of the median cell."""

Begin = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
"""Called with what begins and its length; while it is open, its value is called with how much more is done."""


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
        flight: None for the course of :func:`benchmark_course`, or a name of :data:`FLIGHTS`: a dive, with the preset's own
            quality, coding and noise.
        seed: of world, rays and dive.
        frames: how many, unasked.
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
        made = load_sonar(self.preset).replace(**self.window, **TEXTURES[texture], seed=SEED)
        if texture == "still" or made.noise_level_db is None:
            return made
        levels = {"none": None, "low": made.noise_level_db, "high": made.noise_level_db + self.raised_db}
        return made.replace(noise_level_db=levels[noise])

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
        """Write the world into a folder, where it is not there, and return its scene."""
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
}
"""The presets that dive: changes that save time, height [m], pitch [deg]."""

FLIGHTS = {"level": 0.0, "gentle": 1.0}
"""How much a vehicle moves beside its way, as a share of a calm day: see :func:`dive_course`."""

DIVE_SEEDS = (3, 11, 20)

DIVE = "dive"
"""What the names of all dives begin with."""

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

    The vehicle goes forward by :data:`STEP_M` a frame along a line that swings, and crabs.
    """
    way = np.arange(frames) * STEP_M
    heading = TURN_RAD * np.sin(2 * np.pi * way / TURN_M)
    course = heading + CRAB_RAD * np.sin(2 * np.pi * way / CRAB_M)
    poses = np.zeros((frames, 6))
    middle = (course[1:] + course[:-1]) / 2
    poses[1:, 0], poses[1:, 1] = np.cumsum(STEP_M * np.sin(middle)), np.cumsum(STEP_M * np.cos(middle))
    poses[:, 5] = heading
    poses[:, :2] -= (poses[0, :2] + poses[-1, :2]) / 2
    return poses


def dive_course(frames: int, rate_hz: float, seed: int, moves: float) -> NDArray[np.float64]:
    """Return the way of a vehicle at 0.4 m/s from the origin: poses ``(frames, 6)`` [m, rad].

    Args:
        frames: how many.
        rate_hz: of them [1/s].
        seed: of the phases.
        moves: 1 for a calm day: heading +-8 deg in 6 s, heave +-4 cm in 3.1 s, pitch +-2 deg in 2.3 s and roll +-2 deg in
            2.9 s; 0 for none of these, straight ahead.
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
        frames: how many.
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
                nothing = Outputs(NOISE_MODELS["none"])
                run(self._simulator(sonar), path, self.folder, nothing, origin=origin, resume=True, progress=progress)
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
            raise MitsonarError(f"{self.folder} tells no gain: render it anew")
        sonar = self.simulated.sonar(self.texture, self.noise)
        path = self.simulated.path(self.frames, sonar.frame_rate_hz)
        some = path.poses[np.linspace(0, self.frames - 1, poses + 2).astype(int)[1:-1]]
        noise, law = self._noise, list(laws_of(sonar))[-1]
        found = []
        with begin(f"bound of {'-'.join((self.name, self.texture, self.noise))}", poses) as progress:
            for bounds in bounds_at(self._simulator(sonar), some, noise, gain):
                one = next(value for (_, kind, of), value in bounds.items() if (kind, of) == ("image", law))
                found.append(np.zeros(3) if one is None else one.std(2))
                progress(1)
        release_memory()
        return overall(found)
