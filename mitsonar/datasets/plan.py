"""Where the vehicle is in every frame of a data set, and what its instrument records there.

Frames form sequences of pings at a constant rate. Sequences are drawn at random, with jumps between them, or follow one of
the predefined runs. A plan depends only on recipe, seed, scene and sequence, so every process computes the same numbers.
The sequences of a small data set are the first ones of each scene of a large data set from the same recipe.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.noise import NoiseModel, load_noise, parse_snr
from mitsonar.config.data import Flight, Recipe, array_names
from mitsonar.datasets.modality import Fields, Modality, Read, Scene, StoredArray, StoredAxis, Values, ground_reach
from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import directions
from mitsonar.motion.composition import Motion, compose, motions
from mitsonar.motion.pose import Pose, mounted, vehicle_rotation
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.records.frames import LABELS
from mitsonar.worlds.world import Family, draw, stream

__all__ = [
    "ImageModality",
    "Plan",
    "ResponseModality",
    "Sequence",
    "footprint",
    "footprints_at",
    "modality_of",
    "scenes_of",
    "sequences_of",
]


MIN_SEQUENCES_PER_SCENE = 10
"""Sequences per scene before a small data set adds another scene: building a world costs more than rendering frames."""

CANDIDATES = 64
"""Number of candidate positions and headings drawn at once for a sequence."""

TRIES = 200
"""Number of draws of candidates before the recipe is rejected."""

FLIGHT, WORLD = 3, 4
"""Keys of the random streams for flights and worlds (see worlds.world.stream)."""


@dataclass(frozen=True)
class Sequence:
    """The vehicle's poses ``(pings, 6)`` [m, rad] at the pings of one sequence."""

    vehicle: NDArray[np.float64]

    def at_rate(self, rate_hz: float) -> Trajectory:
        """Return the vehicle's trajectory for a given ping rate [Hz]."""
        return Trajectory(self.vehicle, np.arange(len(self.vehicle)) / rate_hz)


@dataclass(frozen=True)
class Plan:
    """All frames of a data set, in storage order.

    Attributes:
        scenes: scenes that have frames.
        scene: scene number of each frame ``(frames,)``.
        sequence: sequence number of each frame, counted over the whole data set ``(frames,)``.
        time_s: time since the start of the sequence ``(frames,)`` [s].
        vehicle: poses of the vehicle ``(frames, 6)`` [m, rad].
        poses: poses of the sonar ``(frames, 6)`` [m, rad].
        motion: motion to the next frame of the sequence ``(frames, 3)``: sideways, forward [m], yaw [rad]; nan for the last
            frame of a sequence.
        velocity: velocity of the vehicle in its body frame ``(frames, 4)``; see
            :func:`~mitsonar.motion.trajectory.velocities`.
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
        """Plan a data set from its recipe.

        Args:
            recipe: of the data set.
            sequences: number of sequences to plan; all of the recipe by default.

        Raises:
            MitsonarError: fewer than one sequence, more than the recipe has, or a footprint that does not fit its scene.
        """
        scenes = scenes_of(recipe, recipe.sequences if sequences is None else sequences)
        planned = [(scene, one) for scene in scenes for one in islice(sequences_of(recipe, scene), scene.sequences)]
        lengths = [len(one.vehicle) for _, one in planned]
        vehicle = np.concatenate([one.vehicle for _, one in planned])
        # the last frame of a sequence has no motion: the next one belongs to another sequence
        motion = np.full((len(vehicle), 3), np.nan)
        last = np.cumsum(lengths) - 1
        inner = np.setdiff1d(np.arange(len(vehicle)), last)
        motion[inner] = motions(vehicle)[inner]
        rate = modality_of(recipe).sonar.frame_rate_hz
        step = np.concatenate([np.arange(length) for length in lengths])
        return cls(
            scenes=scenes,
            scene=np.repeat([scene.number for scene, _ in planned], lengths).astype(np.int32),
            sequence=np.repeat(np.arange(len(planned)), lengths).astype(np.int32),
            time_s=step / rate,
            vehicle=vehicle,
            poses=mounted(vehicle, recipe.mount.pose),
            motion=motion,
            velocity=np.concatenate([velocities(one.at_rate(rate)) for _, one in planned]),
        )


def scenes_of(recipe: Recipe, sequences: int) -> list[Scene]:
    """Distribute a number of sequences over scenes, in proportion to the sequences that the recipe gives each scene.

    Raises:
        MitsonarError: fewer than one sequence, or more than the recipe has.
    """
    if not 1 <= sequences <= recipe.sequences:
        raise MitsonarError(
            f"the recipe {recipe.name} has {recipe.sequences:,} sequences: got {sequences:,}; give 1 to "
            f"{recipe.sequences:,}, or raise scenes.sequences in a recipe file"
        )
    groups = [group for group, part in enumerate(recipe.scenes) for _ in range(part.count)]
    sequence_counts = np.array([recipe.scenes[group].sequences for group in groups])
    scene_count = (
        len(sequence_counts)
        if sequences == sequence_counts.sum()
        else int(np.clip(sequences // MIN_SEQUENCES_PER_SCENE, 1, len(sequence_counts)))
    )
    while sequence_counts[:scene_count].sum() < sequences:  # small scenes may have fewer than MIN_SEQUENCES_PER_SCENE
        scene_count += 1
    # Rounding the cumulative sum, not each share, keeps the total exact.
    exact = sequences * np.cumsum(sequence_counts[:scene_count]) / sequence_counts[:scene_count].sum()
    counts = np.diff(np.floor(exact + 1e-9).astype(int), prepend=0)
    return [
        Scene(number, groups[number], world_seed(recipe.seed, number), int(count))
        for number, count in enumerate(counts)
        if count
    ]


def world_seed(seed: int, scene: int) -> int:
    """Compute the seed of a scene's world."""
    return int(np.random.SeedSequence([seed, WORLD, scene]).generate_state(1)[0])


def sequences_of(recipe: Recipe, scene: Scene) -> Iterator[Sequence]:
    """Yield the sequences of a scene in order; with random flights the iterator never ends.

    Raises:
        MitsonarError: the footprint does not fit the scene, or the recipe is one of recorded frames.
    """
    flight = recipe.flight
    if flight.kind == "recorded":
        recipe.family(scene.group)  # raises: recorded frames have no world
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
    """Draw the next sequence of a random flight: poses ``(pings, 6)`` [m, rad].

    The motion is drawn first. Start positions are then drawn until one keeps the footprints of all pings in the scene.

    Raises:
        MitsonarError: no position was found.
    """
    flight, half = recipe.flight, family.half_m
    # 1. Height, motion and pitch are constant over the sequence; motions are uniform up to the limits of the recipe.
    low, high = flight.heights
    draws = rng.random(4)
    height = low + (high - low) * float(draws[0])
    largest = np.array([flight.sideways_mm / 1e3, flight.forward_mm / 1e3, math.radians(flight.yaw_deg)])
    motion = Motion(*(largest * (2 * draws[1:] - 1)))
    pitch = 0.0
    if flight.pitch_deg is not None:
        pitch = math.radians(float(draw(rng, flight.pitch_deg)))
    # 2. Drive the sequence from the origin, so that each candidate only needs a rotation and a shift of its footprints.
    driven = _drive(Pose(0, 0, height), motion, flight.pings)
    reach = modality_of(recipe).reach(height, pitch)
    corners = np.concatenate([footprints_at(driven, reach).reshape(-1, 2), driven[:, :2]])
    for _ in range(TRIES):
        # 3. Draw candidate positions and headings, and rotate all corners into the axes of the world.
        position = _positions(flight, half, rng, last)
        heading = np.pi * (2 * rng.random(CANDIDATES) - 1)
        sin, cos = np.sin(heading)[:, None], np.cos(heading)[:, None]
        x, y = corners.T[0] * cos + corners.T[1] * sin, corners.T[1] * cos - corners.T[0] * sin
        # 4. Accept candidates whose corners all lie within the square scene, and whose pings avoid the excluded boxes.
        outermost = np.maximum(np.abs(x + position[:, :1]), np.abs(y + position[:, 1:])).max(axis=1)
        fits = outermost <= half
        here = slice(-flight.pings, None)  # the last corners are the positions of the pings
        fits &= ~_in_excluded_box(flight, x[:, here] + position[:, :1], y[:, here] + position[:, 1:], height)
        # 5. Take the first accepted candidate.
        candidate = int(fits.argmax())
        if fits[candidate]:
            start = Pose.from_row(
                (float(position[candidate, 0]), float(position[candidate, 1]), height, pitch, 0, float(heading[candidate]))
            )
            return _drive(start, motion, flight.pings)
    raise MitsonarError(
        f"no place for a sequence found in {TRIES * CANDIDATES:,} tries: its footprint reaches "
        f"{np.hypot(*corners.T).max():.3g} m from the vehicle, the scene {half:g} m from its middle, jumps "
        f"{flight.jump_m or 'anywhere'}{', boxes are excluded' if flight.keep_out else ''}; use a larger scene, smaller "
        "jumps, a nearer range_max or a lower height"
    )


def _in_excluded_box(flight: Flight, x: NDArray[np.float64], y: NDArray[np.float64], height: float) -> NDArray[np.bool_]:
    """Mark the candidates ``(candidates,)`` with at least one ping in an excluded box.

    Args:
        flight: with the excluded boxes.
        x: of each ping ``(candidates, pings)`` [m].
        y: of each ping ``(candidates, pings)`` [m].
        height: of the sequence [m].
    """
    inside = np.zeros(len(x), dtype=bool)
    for left, near, low, right, far, high in flight.keep_out:
        if low <= height <= high:
            inside |= ((left <= x) & (x <= right) & (near <= y) & (y <= far)).any(axis=1)
    return inside


def footprints_at(vehicle: NDArray[np.float64], reach: NDArray[np.float64]) -> NDArray[np.float64]:
    """Transform a footprint ``(n, 2)`` [m] from the body frame to the world frame at each pose.

    Args:
        vehicle: poses of the vehicle ``(poses, 6)`` [m, rad].
        reach: corners of the footprint, starboard and forward of the vehicle ``(n, 2)`` [m].

    Returns:
        Corners in the world frame ``(poses, n, 2)`` [m].
    """
    sin, cos = np.sin(vehicle[:, 5:]), np.cos(vehicle[:, 5:])
    x = vehicle[:, :1] + reach.T[0] * cos + reach.T[1] * sin
    y = vehicle[:, 1:2] + reach.T[1] * cos - reach.T[0] * sin
    return np.stack([x, y], axis=-1)


def _positions(
    flight: Flight, half_m: float, rng: np.random.Generator, last: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Draw candidates for the next position ``(n, 2)`` [m]: anywhere, or a jump away from the last pose in x and y."""
    draws = rng.random((2, CANDIDATES, 2))
    if last is None or flight.jump_m is None:
        return np.asarray(half_m * (2 * draws[0] - 1), dtype=np.float64)
    low, high = flight.jump_m
    return np.asarray(last[:2] + np.where(draws[1] < 0.5, -1, 1) * (low + (high - low) * draws[0]), dtype=np.float64)


def _drive(start: Pose, motion: Motion, pings: int) -> NDArray[np.float64]:
    """Compose the poses ``(pings, 6)`` of a vehicle that repeats one motion (Almanza-Medina, eq. 3.4)."""
    poses = [start]
    for _ in range(pings - 1):
        poses.append(compose(poses[-1], motion))
    return np.array(poses)


def run_poses(name: str, height_m: float) -> NDArray[np.float64]:
    """Return the vehicle's poses ``(frames, 6)`` [m, rad] in a run over the pattern (Almanza-Medina, 2.3 or 4.4.4).

    The runs are:

    - ``legs``: 250 frames over 5 m to starboard, 100 over 1.2 m forward, 250 over 5 m to port, 100 over 1.1 m forward, 250
      over 5 m to starboard.
    - ``diagonal``: 300 frames, 5 m to starboard and 2.3 m forward.
    - ``turn``: 300 frames over 120 deg on the spot; the T is straight ahead half-way.
    - ``sideways_50``, ``sideways_54``: 50 and 54 steps from the middle of a scene, almost all to starboard, some back near
      the end. Figures 4.16 and 4.17 show these two without numbers, so the numbers are our choice.
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


# ---------------- Modality of a recipe


def modality_of(recipe: Recipe) -> Modality:
    """Return the modality of the recipe's instrument: responses for a channel sonar, images for any other."""
    return ImageModality(recipe) if recipe.channel is None else ResponseModality(recipe)


# ---------------- Imaging sonars: images, vectors and labels


RAYS = 61
"""Number of rays over azimuth and over elevation that sample a footprint. Arcs deviate less than 0.2 mm between rays."""

TEXTS = {
    "image": "{}: level times gain, 0..255 (or 0..1), row 0 nearest, column 0 most to port; zero means no echo",
    "vector": "{}: sum over the beams of the image in 0..1",
    "nonzero": "{}: number of beams with an echo, from which a vector's noise is drawn",
    "elevation_rad": "{}: elevation of the strongest echo; nan without echo",
    "shape_id": "{}: place in the scene of the shape of the strongest echo; -1 without echo",
    "object_id": "{}: object of the strongest echo, as its mesh numbers them; 0 for none, -1 without echo",
    "shadow": "{}: 0 not in shadow, 1 dark with sound or echoes beyond, 2 dark with all sound intercepted before",
}

BODY_TEXTS = {
    "body_pose": "of the recipe's bodies, in its order: x, y, z [m], pitch, roll, heading [rad]",
    "body_velocity": "of the recipe's bodies in the world's axes: of the origin [m/s], rotation vector a second [rad/s]",
}

PER_FRAME = {
    "height_m": StoredArray(
        np.dtype(np.float64), "height of the sonar over what is straight below it [m]; nan where nothing is"
    ),
    "dropped": StoredArray(np.dtype(np.uint32), "returns of the frame that lie outside the window and were dropped"),
    "saturated": StoredArray(np.dtype(np.uint32), "pixels of the frame at the maximum"),
}


MAX_DROPPED_SHARE = 0.5
"""Share of a ping's rays that may be dropped without a warning if the recipe sets the range window explicitly."""


class ImageModality:
    """Modality of imaging sonars: images, vectors or both of each view, with their labels.

    The members are those of :class:`~mitsonar.datasets.modality.Modality`.
    """

    what = "frame"
    fixed_attributes: tuple[str, ...] = ("gain", "level_scale")
    planned: tuple[str, ...] = ()
    result_packages: tuple[str, ...] = ()
    renderer_class = "mitsonar.datasets.make:SceneRenderer"
    samples_class = "mitsonar.datasets.samples:SonarPairs"
    estimators = "zero,ecc,flow,phase,direct"
    variations = True

    def __init__(self, recipe: Recipe) -> None:
        self.recipe, self.sonar = recipe, recipe.instrument

    @property
    def stored(self) -> dict[str, StoredArray]:
        """Return the arrays of pixels, labels and body states, and the counters that rendering reports for each frame."""
        views = {view.name: view for view in self.recipe.views}
        table = {}
        for name, (kind, view_name) in array_names(self.recipe).items():
            view, sums = views[view_name], kind in ("vector", "nonzero")
            shape: tuple[int, ...] = (view.sonar.range_bins, *(() if sums else (len(view.bearing_rad),)))
            dims = ("range", *(() if sums else (f"beam{self.recipe.suffix(view_name)}",)))
            table[name] = self._stored(kind, view_name, shape, dims)
        if self.recipe.bodies:
            shape, dims = (len(self.recipe.bodies), 6), ("body", "six")
            table |= {name: StoredArray(np.dtype(np.float64), about, shape, dims) for name, about in BODY_TEXTS.items()}
        return table | PER_FRAME

    @property
    def axes(self) -> dict[str, StoredAxis]:
        """Return the bearing axis of each view, and the range axis."""
        table = {}
        for view in self.recipe.views:
            suffix = self.recipe.suffix(view.name)
            about = "bearing of each beam's axis [rad], starboard positive"
            table[f"bearing_rad{suffix}"] = StoredAxis(view.bearing_rad, f"beam{suffix}", about)
        return table | {"range_m": StoredAxis(self.recipe.views[0].sonar.range_m, "range", "centre of each range bin [m]")}

    @property
    def attributes(self) -> Fields:
        """Return the parameters of the sonar and of the sonar of each view, and the kind of level."""
        views = {view.name: view.sonar.model_dump() for view in self.recipe.views}
        return {
            "sonar": self.sonar.model_dump(),
            "views": views,
            "level": "linear" if self.recipe.recorded is None else self.recipe.recorded.level,
        }

    @property
    def ping_bytes(self) -> int:
        """Return the size of a frame's pixels and labels, or of its sums and counts if it has only vectors [bytes]."""
        if "image" not in self.recipe.kinds:
            return sum(view.sonar.range_bins * 8 for view in self.recipe.views)
        size = 1 if self.recipe.pixel == "uint8" else 4
        each = sum(len(view.bearing_rad) * view.sonar.range_bins * size for view in self.recipe.views)
        return each + len(self.recipe.labels) * 4 * each // size

    @property
    def sample_frames(self) -> int:
        """Return 2, because image estimators are compared on pairs."""
        return 2

    def reach(self, height: float, pitch: float = 0.0) -> NDArray[np.float64]:
        """Compute the footprint ``(n, 2)`` [m] of the sonar, or of the field of view in ``flight.footprint_fov_deg``.

        Raises:
            MitsonarError: the ground is out of range.
        """
        return footprint(self.sonar, self.recipe.mount.pose, height, self.recipe.flight.footprint_fov_deg, pitch)

    def _stored(self, kind: str, view: str, shape: tuple[int, ...], dims: tuple[str, ...]) -> StoredArray:
        """Return the specification of an array of the given kind for a view."""
        known = {"image": self.recipe.pixel, "vector": np.float32, "nonzero": np.uint32}
        return StoredArray(np.dtype(known[kind] if kind in known else LABELS[kind]), TEXTS[kind].format(view), shape, dims)

    # ---------------------------------------------------------------- noise

    def noise_model(self, name: str) -> NoiseModel:
        """Return the noise model with the given name.

        Raises:
            MitsonarError: unknown name.
        """
        return load_noise(name)

    # ---------------------------------------------------------------- checks

    def empty(self, read: Read, here: slice) -> NDArray[np.bool_]:
        """Mark the frames ``(frames,)`` that have no pixel above 0 in any view."""
        dark = np.ones(here.stop - here.start, dtype=bool)
        for name, (kind, _) in array_names(self.recipe).items():
            if kind in ("image", "vector"):
                dark &= ~read(name, here).reshape(len(dark), -1).any(axis=1)
        return dark

    def faults(self, read: Read, here: slice) -> list[str]:
        """Check pixels, sums and labels against their limits, and return one sentence per fault."""
        faults = []
        beams = {view.name: len(view.bearing_rad) for view in self.recipe.views}
        for name, (kind, view) in array_names(self.recipe).items():
            values = read(name, here)
            low, high = _limits(kind, values, beams[view])
            valid = values[~np.isnan(values)] if kind == "elevation_rad" else values
            if valid.size and not (valid.min() >= low and valid.max() <= high):
                faults.append(
                    f"{name}, frames {here.start}..{here.stop - 1}: values {valid.min():g}..{valid.max():g}, allowed "
                    f"{low:g}..{high:g}"
                )
            if kind == "nonzero":
                vector = read(name.replace("nonzero", "vector", 1), here)
                if ((vector > 0) != (values > 0)).any() or (vector > values * (1 + 1e-6)).any():
                    faults.append(
                        f"{name}, frames {here.start}..{here.stop - 1}: sums and numbers of echoes contradict each other"
                    )
        return faults

    def warnings(self, read: Read) -> list[str]:
        """Return warnings about motions far below a range bin, returns outside the window, and too high a gain."""
        from mitsonar.simulation.pings import NEGLIGIBLE  # imported here: reading a store must not load the simulator

        sentences = []
        flight, bin_mm = self.recipe.flight, 1e3 * self.sonar.bin_m
        largest_mm = max(flight.sideways_mm, flight.forward_mm)
        if flight.kind == "random" and flight.pings > 1 and 0 < largest_mm < bin_mm / 100:
            sentences.append(
                f"motions of at most {largest_mm:g} mm are less than a hundredth of a range bin ({bin_mm:.2g} mm): "
                "flight.sideways_mm and forward_mm are in millimetres"
            )
        dropped, saturated = (read(name).astype(np.int64) for name in ("dropped", "saturated"))
        rays, stated = self.sonar.rays, {"range_min", "range_max"} <= set(self.recipe.sonar or {})
        if dropped.mean() > (MAX_DROPPED_SHARE if stated else NEGLIGIBLE) * rays:
            sentences.append(
                f"{dropped.mean():,.0f} returns a ping ({100 * dropped.mean() / rays:.2g} % of {rays:,} rays) lie outside "
                f"the window {self.sonar.range_min:g}..{self.sonar.range_max:g} m and were dropped: set sonar.range_min "
                "and range_max"
            )
        pixels = sum(len(view.bearing_rad) * view.sonar.range_bins for view in self.recipe.views)
        if saturated.mean() > 0.01 * pixels:
            sentences.append(
                f"{100 * saturated.mean() / pixels:.2g} % of pixels are at the maximum (more than 1 %): the gain, set on "
                "the first 20 frames, is too high for the rest"
            )
        return sentences


def _limits(kind: str, values: Values, beams: int) -> tuple[float, float]:
    """Return the smallest and the largest valid value of an array of this kind."""
    match kind:
        case "image":
            return 0, 255 if values.dtype == np.uint8 else 1
        case "vector" | "nonzero":
            return 0, beams
        case "elevation_rad":
            return -np.pi / 2, np.pi / 2
        case "shadow":
            return 0, 2
        case _:
            return -1, np.inf


@lru_cache(maxsize=8)
def footprint(
    sonar: Sonar, mount: Pose, height: float, fov_deg: tuple[float, float] | None = None, pitch: float = 0.0
) -> NDArray[np.float64]:
    """Compute a sonar's footprint on the ground z = 0.

    Args:
        sonar: whose field of view is projected.
        mount: pose of the sonar on the vehicle.
        height: of the vehicle [m].
        fov_deg: azimuth and elevation that replace the sonar's field of view [deg].
        pitch: of the vehicle [rad], positive down.

    Returns:
        Corners ``(n, 2)`` [m], starboard and forward of the vehicle.

    Raises:
        MitsonarError: the ground is out of range.
    """
    azimuth, elevation = fov_deg or (sonar.azimuth_fov_deg, sonar.elevation_fov_deg)
    outer = max(math.radians(azimuth) / 2, sonar.bearing_rad[-1] + sonar.beam_width_rad / 2 if fov_deg is None else 0)
    b, e = np.meshgrid(np.linspace(-outer, outer, RAYS), np.radians(np.linspace(-elevation, elevation, RAYS)) / 2)
    local = directions(sonar.bearing, b.ravel(), e.ravel())
    eye = mounted(Pose(0, 0, height, pitch), mount)[0]
    return ground_reach(eye[:3], vehicle_rotation(eye).apply(local), sonar.range_max)


# ---------------- Channel sonars: impulse responses


class ResponseModality:
    """Modality of channel sonars: a complex impulse response at each receiver.

    The members are those of :class:`~mitsonar.datasets.modality.Modality`.
    """

    what = "ping"
    fixed_attributes: tuple[str, ...] = ()
    planned: tuple[str, ...] = ("velocity",)
    result_packages: tuple[str, ...] = ("finufft",)
    renderer_class = "mitsonar.datasets.make:ResponseRenderer"
    samples_class = "mitsonar.datasets.responses:ImpulseSamples"
    estimators = "zero,correlation,likelihood"
    variations = False

    def __init__(self, recipe: Recipe) -> None:
        self.recipe, self.sonar = recipe, recipe.channel_sonar

    @property
    def stored(self) -> dict[str, StoredArray]:
        """Return the array of responses, and the quantities that the simulation reports for each ping."""
        count = len(self.sonar.receivers)
        response = "complex baseband responses; receivers in the order of the attribute sonar"
        return {
            "response": StoredArray(np.dtype(np.complex64), response, (count, self.sonar.taps), ("receiver", "tap")),
            "height_m": StoredArray(
                np.dtype(np.float64), "height of the transmitter over what is straight below it [m]; nan where nothing is"
            ),
            "echoes": StoredArray(np.dtype(np.int64), "echoes that count", (count,), ("receiver",)),
            "dropped": StoredArray(np.dtype(np.int64), "echoes from beyond range_max, dropped", (count,), ("receiver",)),
        }

    @property
    def axes(self) -> dict[str, StoredAxis]:
        """Return the delay axis."""
        return {"delay_s": StoredAxis(self.sonar.delay_s, "tap", "delay of each tap [s]")}

    @property
    def attributes(self) -> Fields:
        """Return the parameters of the instrument and the names of its receivers."""
        return {"sonar": self.sonar.model_dump(mode="json"), "receivers": [one.name for one in self.sonar.receivers]}

    @property
    def ping_bytes(self) -> int:
        """Return the size of one ping's responses [bytes]."""
        return 8 * len(self.sonar.receivers) * self.sonar.taps

    @property
    def sample_frames(self) -> int:
        """Return the number of pings per sample in the recipe."""
        return self.recipe.frames

    def reach(self, height: float, pitch: float = 0.0) -> NDArray[np.float64]:
        """Compute the corners ``(n, 2)`` [m] of the ground that the receivers cover.

        Raises:
            MitsonarError: a receiver has no ground in range.
        """
        return _reach(self.sonar, height)

    def noise_model(self, name: str) -> None:
        """Check the name of a signal-to-noise ratio; the ratio alone defines the noise, so there is no model.

        Raises:
            MitsonarError: the name is not a ratio.
        """
        parse_snr(name)

    def empty(self, read: Read, here: slice) -> NDArray[np.bool_]:
        """Mark the pings ``(pings,)`` of which no receiver recorded an echo."""
        return np.asarray((read("echoes", here) == 0).all(axis=1))

    def faults(self, read: Read, here: slice) -> list[str]:
        """Check that responses are finite and counts not negative, and return one sentence per fault."""
        faults = [
            f"response, pings {here.start}..{here.stop - 1}: values that are not finite"
            for _ in range(not np.isfinite(read("response", here)).all())
        ]
        for name in ("echoes", "dropped"):
            if (read(name, here) < 0).any():
                faults.append(f"{name}, pings {here.start}..{here.stop - 1}: numbers below 0")
        return faults

    def warnings(self, read: Read) -> list[str]:
        """Return warnings about receivers without echoes, dropped echoes, and motions far below a wavelength."""
        sentences = []
        echoes, dropped = read("echoes"), read("dropped")
        for number, receiver in enumerate(self.sonar.receivers):
            silent = int((echoes[:, number] == 0).sum())
            if silent:
                sentences.append(
                    f"receiver {receiver.name} records no echo in {silent:,} of {len(echoes):,} pings: check where it "
                    f"points (heading {receiver.field.heading_deg:g} deg, tilt {receiver.field.tilt_deg:g} deg), height_m "
                    "and range_max"
                )
        if dropped.any():
            share = 100 * dropped.sum() / max(1, dropped.sum() + echoes.sum())
            sentences.append(
                f"{dropped.sum() / len(dropped):,.0f} echoes a ping ({share:.2g} %) came from beyond range_max "
                f"{self.sonar.range_max:g} m and were dropped"
            )
        flight, wave_mm = self.recipe.flight, 1e3 * self.sonar.wavelength_m
        largest_mm = max(flight.sideways_mm, flight.forward_mm)
        if flight.kind == "random" and flight.pings > 1 and 0 < largest_mm < wave_mm / 1000:
            sentences.append(
                f"motions of at most {largest_mm:g} mm are less than a thousandth of the wavelength ({wave_mm:.3g} mm): "
                "flight.sideways_mm and forward_mm are in millimetres"
            )
        return sentences


@lru_cache(maxsize=8)
def _reach(sonar: ChannelSonar, height: float) -> NDArray[np.float64]:
    """Compute the footprint of every receiver and concatenate their corners ``(n, 2)`` [m]."""
    parts = [
        ground_reach(np.array([*one.position[:2], height + one.position[2]]), one.field.directions(RAYS), sonar.range_max)
        for one in sonar.receivers
    ]
    return np.concatenate(parts)
