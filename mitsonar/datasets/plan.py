"""The vehicle's pose in every frame of a data set: sequences of pings at a constant rate, jumps between them, runs.

A plan is a function of recipe, seed, scene and sequence: every process computes the same numbers. The sequences of a small
data set are the first ones of each scene of a large one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsonar.config.data import Flight, Recipe
from mitsonar.datasets.modalities import modality_of
from mitsonar.errors import MitsonarError
from mitsonar.motion.composition import Motion, compose, motions
from mitsonar.motion.pose import Pose, mounted
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.worlds.world import Family, draw, stream

__all__ = ["Plan", "Scene", "Sequence", "footprints_at", "scenes_of", "sequences_of"]

FEWEST_SEQUENCES = 10
"""Sequences of a scene before a small data set opens another scene: worlds cost more than frames."""

CANDIDATES = 64
"""Positions and headings that are drawn at once for a sequence."""

TRIES = 200
"""How often they are drawn before the recipe is refused."""

FLIGHT, WORLD = 3, 4
"""Purposes of random numbers (see worlds.world.stream)."""


@dataclass(frozen=True)
class Scene:
    """One scene of a data set: its number, its group in the recipe, the seed of its world, how many sequences it has."""

    number: int
    group: int
    seed: int
    sequences: int


@dataclass(frozen=True)
class Sequence:
    """Pings of one sequence: poses ``(pings, 6)`` [m, rad] of the vehicle."""

    vehicle: NDArray[np.float64]

    def at_rate(self, rate_hz: float) -> Trajectory:
        """Return the vehicle's trajectory at a rate of pings [Hz]."""
        return Trajectory(self.vehicle, np.arange(len(self.vehicle)) / rate_hz)


@dataclass(frozen=True)
class Plan:
    """All frames of a data set, in the order in which they are stored.

    Attributes:
        scenes: those that have frames.
        scene: number of the scene of each frame ``(frames,)``.
        sequence: number of the sequence of each frame, counted over the data set ``(frames,)``.
        time_s: since the sequence began ``(frames,)`` [s].
        vehicle: poses of the vehicle ``(frames, 6)`` [m, rad].
        poses: of the sonar ``(frames, 6)`` [m, rad].
        motion: sideways, forward [m], yaw [rad] to the next frame of the sequence ``(frames, 3)``; nan for its last.
        velocity: of the vehicle in its own axes; see :func:`~mitsonar.motion.trajectory.velocities` ``(frames, 4)``.
    """

    scenes: list[Scene]
    scene: NDArray[np.int32]
    sequence: NDArray[np.int32]
    time_s: NDArray[np.float64]
    vehicle: NDArray[np.float64]
    poses: NDArray[np.float64]
    motion: NDArray[np.float64]
    velocity: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.scene)

    @classmethod
    def of(cls, recipe: Recipe, sequences: int | None = None) -> Plan:
        """Plan a recipe, or its first ``sequences`` sequences.

        Raises:
            MitsonarError: more sequences than the recipe has, none, or a footprint that fits no scene.
        """
        scenes = scenes_of(recipe, recipe.sequences if sequences is None else sequences)
        flown = [(scene, one) for scene in scenes for one in _first(sequences_of(recipe, scene), scene.sequences)]
        lengths = [len(one.vehicle) for _, one in flown]
        vehicle = np.concatenate([one.vehicle for _, one in flown])
        motion = np.full((len(vehicle), 3), np.nan)
        last = np.cumsum(lengths) - 1
        inner = np.setdiff1d(np.arange(len(vehicle)), last)
        motion[inner] = motions(vehicle)[inner]
        rate = modality_of(recipe).sonar.frame_rate_hz
        step = np.concatenate([np.arange(length) for length in lengths])
        return cls(
            scenes=scenes,
            scene=np.repeat([scene.number for scene, _ in flown], lengths).astype(np.int32),
            sequence=np.repeat(np.arange(len(flown)), lengths).astype(np.int32),
            time_s=step / rate,
            vehicle=vehicle,
            poses=mounted(vehicle, recipe.mount.pose),
            motion=motion,
            velocity=np.concatenate([velocities(one.at_rate(rate)) for _, one in flown]),
        )


def scenes_of(recipe: Recipe, sequences: int) -> list[Scene]:
    """Spread ``sequences`` sequences over scenes, in proportion to the recipe's own numbers.

    Raises:
        MitsonarError: no sequence, or more than the recipe has.
    """
    if not 1 <= sequences <= recipe.sequences:
        raise MitsonarError(
            f"the recipe {recipe.name} has {recipe.sequences:,} sequences: got {sequences:,}; give 1 to as many, or raise "
            "scenes.sequences in a recipe of your own"
        )
    groups = [group for group, part in enumerate(recipe.scenes) for _ in range(part.count)]
    own = np.array([recipe.scenes[group].sequences for group in groups])
    opened = len(own) if sequences == own.sum() else int(np.clip(sequences // FEWEST_SEQUENCES, 1, len(own)))
    while own[:opened].sum() < sequences:  # small scenes may not hold ten
        opened += 1
    exact = sequences * np.cumsum(own[:opened]) / own[:opened].sum()
    counts = np.diff(np.floor(exact + 1e-9).astype(int), prepend=0)
    return [
        Scene(number, groups[number], world_seed(recipe.seed, number), int(count))
        for number, count in enumerate(counts)
        if count
    ]


def world_seed(seed: int, scene: int) -> int:
    """Compute the seed of a scene's world."""
    return int(np.random.SeedSequence([seed, WORLD, scene]).generate_state(1)[0])


def _first(sequences: Iterator[Sequence], count: int) -> list[Sequence]:
    """Take the first sequences of a scene."""
    return [next(sequences) for _ in range(count)]


def sequences_of(recipe: Recipe, scene: Scene) -> Iterator[Sequence]:
    """Yield the sequences of a scene, one after the other; random flights have no end.

    Raises:
        MitsonarError: the footprint does not fit the scene, or frames were recorded.
    """
    flight = recipe.flight
    if flight.kind == "recorded":
        recipe.family(scene.group)  # refuses
    if flight.kind == "runs":
        for name in flight.runs:
            yield Sequence(run_poses(name, flight.heights[0]))
        return
    family = recipe.family(scene.group)
    number, last = 0, None
    while True:
        rng = stream(recipe.seed, FLIGHT, scene.number, number)
        vehicle = _sequence(recipe, family, rng, last)
        yield Sequence(vehicle)
        number, last = number + 1, vehicle[-1]


def _sequence(
    recipe: Recipe, family: Family, rng: np.random.Generator, last: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Draw the next sequence ``(pings, 6)``: its motion, then positions until one keeps all footprints in the scene.

    Raises:
        MitsonarError: no position was found.
    """
    flight, half = recipe.flight, family.half_m
    low, high = flight.heights
    draws = rng.random(4)
    height = low + (high - low) * float(draws[0])
    largest = np.array([flight.sideways_mm / 1e3, flight.forward_mm / 1e3, math.radians(flight.yaw_deg)])
    motion = Motion(*(largest * (2 * draws[1:] - 1)))
    pitch = 0.0
    if flight.pitch_deg is not None:
        pitch = math.radians(float(draw(rng, flight.pitch_deg)))
    driven = _drive(Pose(0, 0, height), motion, flight.pings)
    corners = _corners(recipe, height, pitch, driven)
    for _ in range(TRIES):
        position = _positions(flight, half, rng, last)
        heading = np.pi * (2 * rng.random(CANDIDATES) - 1)
        sin, cos = np.sin(heading)[:, None], np.cos(heading)[:, None]
        x, y = corners.T[0] * cos + corners.T[1] * sin, corners.T[1] * cos - corners.T[0] * sin
        outermost = np.maximum(np.abs(x + position[:, :1]), np.abs(y + position[:, 1:])).max(axis=1)
        fits = outermost <= half
        here = slice(-flight.pings, None)  # the last of the corners are the pings themselves
        fits &= ~_kept_out(flight, x[:, here] + position[:, :1], y[:, here] + position[:, 1:], height)
        found = int(fits.argmax())
        if fits[found]:
            start = Pose.from_row(
                (float(position[found, 0]), float(position[found, 1]), height, pitch, 0, float(heading[found]))
            )
            return _drive(start, motion, flight.pings)
    raise MitsonarError(
        f"no place for a sequence found in {TRIES * CANDIDATES:,} tries: its footprint reaches "
        f"{np.hypot(*corners.T).max():.3g} m from the vehicle, the scene {half:g} m from its middle, jumps "
        f"{flight.jump_m or 'anywhere'}{', boxes are kept out' if flight.keep_out else ''}; use a larger scene, smaller "
        "jumps, a nearer range_max or a lower height"
    )


def _kept_out(flight: Flight, x: NDArray[np.float64], y: NDArray[np.float64], height: float) -> NDArray[np.bool_]:
    """Mark the candidates with a ping ``(candidates, pings)`` [m] in a box that is kept out ``(candidates,)``."""
    inside = np.zeros(len(x), dtype=bool)
    for left, near, low, right, far, high in flight.keep_out:
        if low <= height <= high:
            inside |= ((left <= x) & (x <= right) & (near <= y) & (y <= far)).any(axis=1)
    return inside


def _corners(recipe: Recipe, height: float, pitch: float, driven: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute positions and footprints of all pings ``(n, 2)`` [m], relative to the first ping and in its axes."""
    reach = modality_of(recipe).reach(height, pitch)
    return np.concatenate([footprints_at(driven, reach).reshape(-1, 2), driven[:, :2]])


def footprints_at(vehicle: NDArray[np.float64], reach: NDArray[np.float64]) -> NDArray[np.float64]:
    """Transform a footprint ``(n, 2)`` from the vehicle's axes to the world's at each pose: ``(poses, n, 2)`` [m]."""
    sin, cos = np.sin(vehicle[:, 5:]), np.cos(vehicle[:, 5:])
    x = vehicle[:, :1] + reach.T[0] * cos + reach.T[1] * sin
    y = vehicle[:, 1:2] + reach.T[1] * cos - reach.T[0] * sin
    return np.stack([x, y], axis=-1)


def _positions(
    flight: Flight, half_m: float, rng: np.random.Generator, last: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Draw candidates for the next position ``(n, 2)``: anywhere, or a jump away in x and in y."""
    draws = rng.random((2, CANDIDATES, 2))
    if last is None or flight.jump_m is None:
        return np.asarray(half_m * (2 * draws[0] - 1), dtype=np.float64)
    low, high = flight.jump_m
    return np.asarray(last[:2] + np.where(draws[1] < 0.5, -1, 1) * (low + (high - low) * draws[0]), dtype=np.float64)


def _drive(start: Pose, motion: Motion, pings: int) -> NDArray[np.float64]:
    """Compose poses at a constant rate (Almanza-Medina, eq. 3.4)."""
    poses = [start]
    for _ in range(pings - 1):
        poses.append(compose(poses[-1], motion))
    return np.array(poses)


def run_poses(name: str, height_m: float) -> NDArray[np.float64]:
    """Return a run over the pattern (Almanza-Medina, 2.3 or 4.4.4): poses of the vehicle ``(frames, 6)`` [m, rad].

    ``legs``: 250 frames over 5 m to starboard, 100 over 1.2 m forward, 250 over 5 m to port, 100 over 1.1 m forward, 250
    over 5 m to starboard. ``diagonal``: 300 frames, 5 m to starboard and 2.3 m forward. ``turn``: 300 frames over 120 deg on
    the spot, the T ahead half-way. ``sideways_50``, ``sideways_54``: 50 and 54 steps from the middle of a scene, almost all
    to starboard, some back near the end. Figures 4.16 and 4.17 show them without numbers; the numbers are ours.
    """
    x, y = -2.5, -4.85
    match name:
        case "legs":
            corners = np.array([(x, y), (x + 5, y), (x + 5, y + 1.2), (x, y + 1.2), (x, y + 2.3), (x + 5, y + 2.3)])
            counts = (250, 100, 250, 100, 250)
            legs = [np.linspace(a, b, n + 1)[1:] for a, b, n in zip(corners, corners[1:], counts, strict=False)]
            legs[0] = np.linspace(corners[0], corners[1], counts[0])
            position, heading = np.concatenate(legs), np.zeros(sum(counts))
        case "diagonal":
            position, heading = np.linspace((x, y), (x + 5, y + 2.3), 300), np.zeros(300)
        case "sideways_50" | "sideways_54":
            step = np.arange(int(name[-2:]))
            back = (step >= len(step) - 14) & (step < len(step) - 6)
            sideways = np.where(back, -8.0, 15.0 + 3 * np.sin(step / 5))
            forward = np.where(back, -9.0, 5 * np.cos(step / (7 if len(step) == 50 else 4)))
            position = np.concatenate([np.zeros((1, 2)), np.cumsum(np.column_stack([sideways, forward]) / 1e3, axis=0)])
            heading = np.zeros(len(position))
        case _:
            position, heading = np.tile([0.0, -4.2], (300, 1)), np.radians(np.linspace(-60, 60, 300))
    rest = np.column_stack([np.full(len(position), height_m), np.zeros((len(position), 2)), heading])
    return np.column_stack([position, rest])
