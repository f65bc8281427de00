"""Scene, sonar and poses to frames: tracing and binning in one launch, many pings a launch, constant memory."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.instruments.imaging_sonar import Sonar
from mitsonar.io.plain_data import whole_number
from mitsonar.motion.pose import Trajectory
from mitsonar.records.echoes import Echoes
from mitsonar.records.sonar_frames import SonarFrames
from mitsonar.simulation.empty_frames import NEARLY_EMPTY, empty_frames
from mitsonar.simulation.variant import ensure_variant, garbage_stays

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.instruments.views import View
    from mitsonar.simulation.binning import Counts

__all__ = ["Pings", "Simulator", "Tally", "constant_gain"]

CALIBRATION_FRAMES = 20
"""Frames whose brightest pixels set the gain of a run."""


@dataclass
class Pings:
    """A batch of consecutive pings.

    Attributes:
        first: number of the first.
        levels: ``(pings, bins, beams)`` float32, before gain.
        counts: what became of the rays.
        height_m: ``(pings,)``.
        labels: ``elevation_rad``, ``shape_id``, ``object_id``, ``shadow``, like ``levels``, where asked for.
    """

    first: int
    levels: NDArray[np.float32]
    counts: Counts
    height_m: NDArray[np.float64]
    labels: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.levels)


class Simulator:
    """Renders what a sonar receives in a scene.

    Args:
        scene: a Mitsuba scene; its cameras are ignored.
        sonar: the instrument; default: the scene's ``imaging_sonar``.
        views: makes the images of a ping from its echoes; default: one, of all of them.
        rays_per_launch: bound of a launch's rays and of its image cells, about 30 bytes each.

    Attributes:
        gain: of the closed loop that :meth:`step` renders; None before its first ping.

    Raises:
        MitsonarError: no sonar given and none in the scene.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sonar: Sonar | None = None,
        *,
        views: Sequence[View] | None = None,
        rays_per_launch: int = 2**23,
    ) -> None:
        self.variant = ensure_variant()
        from mitsonar.instruments.views import Whole
        from mitsonar.simulation.scene import sonar_in
        from mitsonar.simulation.tracing import Tracer
        from mitsonar.simulation.view_tracers import view_tracers

        if sonar is None:
            found = sonar_in(scene)
            if found is None:
                raise MitsonarError(
                    "the scene has no sensor of type imaging_sonar: add one, or name a sonar (--sonar didson300)"
                )
            sonar = found[0]
        self.sonar = sonar
        self.tracer = Tracer(scene, sonar)
        self.notes = self.tracer.notes
        self.views: Sequence[View] = [Whole(sonar)] if views is None else views
        self.view_tracers = view_tracers(self.views)
        cells = sum(len(view.bearing_rad) * view.sonar.range_bins for view in self.views)
        self.pings_per_launch = max(1, rays_per_launch // max(sonar.rays, cells))
        self._launches: dict[tuple[int, bool], Callable[..., Any]] = {}
        self._stepped, self._gain_from, self._told = 0, "", set[str]()
        self.gain: float | None = None

    def pings(self, poses: ArrayLike, *, first: int = 0, labels: bool = False) -> Iterator[Pings]:
        """Levels of consecutive pings in the first view; see :meth:`looks`."""
        for looks in self.render_views(poses, first=first, labels=labels):
            yield looks[0]

    def render_views(self, poses: ArrayLike, *, first: int = 0, labels: bool = False) -> Iterator[list[Pings]]:
        """Levels of consecutive pings, in batches, one of each view.

        Ping ``first + k`` draws its own jitter whatever the batches are.

        Args:
            poses: of the sonar ``(frames, 6)`` x, y, z [m], pitch, roll, heading [rad].
            first: number of the first ping.
            labels: per-pixel truth as well.
        """
        table = np.atleast_2d(np.asarray(poses, dtype=float))
        if table.ndim != 2 or table.shape[1] != 6 or not len(table) or not np.isfinite(table).all():
            raise MitsonarError(f"poses must be finite numbers (frames, 6): got {table.shape}; give m and rad")
        for start in range(0, len(table), self.pings_per_launch):
            yield self._launch(table[start : start + self.pings_per_launch], first + start, labels)

    def _launch(self, poses: NDArray[np.float64], first: int, labels: bool) -> list[Pings]:
        from mitsonar.simulation import binning

        key = (len(poses), labels)
        if key not in self._launches:
            self._launches[key] = self._compile(*key)
        inputs = self.tracer.inputs(poses, first)
        tables = [tracer.tables(poses) for tracer in self.view_tracers]
        with garbage_stays():
            height, made = self._launches[key](self.tracer.scene, *inputs, tables)
        height_m = np.array(height, dtype=float)
        looks = []
        for view, (image, counters, truth) in zip(self.views, made, strict=True):
            pings = Pings(first, *binning.fetch(image, counters, len(poses), view), height_m)
            if labels:
                pings.labels = labels_of(pings, truth, self.sonar.rays)
            looks.append(pings)
        return looks

    def _compile(self, pings: int, labels: bool) -> Callable[..., Any]:
        """The fused launch, traced once and then replayed (``dr.freeze``): a single ping costs its rays, not Python."""
        import drjit as dr

        from mitsonar.simulation.binning import accumulate, develop, strongest
        from mitsonar.simulation.tracing import Rays

        tracer, sonar = self.tracer, self.sonar

        @dr.freeze
        def launch(index: Any, scene: Any, rows: Any, keys: Any, surfaces: Any, tables: Any) -> Any:
            rays = Rays(sonar, index)
            ray, fan = tracer.rays_of(rays, rows, keys)
            echoes = tracer.echoes(scene, ray, fan, surfaces)
            looks = [
                tracer.view_echoes(scene, rays, fan, echoes, own)
                for tracer, own in zip(self.view_tracers, tables, strict=True)
            ]
            sums = [
                accumulate(seen, rays.ping, pings, tracer) for seen, tracer in zip(looks, self.view_tracers, strict=True)
            ]
            truths: list[Any] = [None] * len(looks)
            if labels:
                truths = [
                    (
                        strongest(seen, rays.ping, rays.ray, pings, view),
                        seen.elevation,
                        seen.echoes.shape_id,
                        seen.echoes.object_id,
                    )
                    for seen, view in zip(looks, self.views, strict=True)
                ]
            dr.eval(sums, truths)  # all that reads the echoes in one kernel, before any sum is read: rays are traced once
            made = [
                (*develop(total, pings, tracer), truth)
                for total, tracer, truth in zip(sums, self.view_tracers, truths, strict=True)
            ]
            return tracer.height_m(scene, rows), made

        return partial(launch, Rays.numbered(sonar, pings))

    def film_echoes(self, pose: ArrayLike, ping: int) -> Echoes:
        """One ping's echoes as NumPy arrays, in the order of the film."""
        return self.tracer.film_echoes(pose, ping)

    def window_range(self, pose: ArrayLike, ping: int) -> tuple[float, float] | None:
        """Nearest and farthest return outside the window of one ping [m]; None where all lie inside."""
        return self.film_echoes(pose, ping).outside(self.sonar)

    def render(
        self,
        trajectory: Trajectory | ArrayLike,
        *,
        noise: NoiseModel | None = None,
        seed: int = 0,
        labels: bool = False,
        gain: float | None = None,
    ) -> SonarFrames:
        """All frames in memory.

        Args:
            trajectory: poses with times, or poses ``(frames, 6)`` [m, rad], one every ``1 / frame_rate_hz``.
            noise: drawn from (seed, frame, cell); default none.
            seed: of the noise; the jitter's is the sonar's.
            labels: per-pixel truth as well.
            gain: the constant that levels are multiplied by; default: from the first 20 frames.

        Warns:
            MitsonarWarning: nothing hit, returns outside the window, saturated pixels, too few rays a bin, BSDFs
                without a diffuse reflectance.
        """
        if not isinstance(trajectory, Trajectory):
            poses = np.atleast_2d(np.asarray(trajectory, dtype=float))
            trajectory = Trajectory(poses, np.arange(len(poses)) / self.sonar.frame_rate_hz)
        batches = self.pings(trajectory.poses, labels=labels)
        calibrated = gain is None
        if gain is None:
            gain, batches = constant_gain(batches)
        tally = Tally(self.sonar) if calibrated else Tally(self.sonar, "as given")
        images, heights, truth = [], [], []
        for pings in batches:
            image = to_image(pings, gain)
            tally.add(pings, image)
            frames = np.arange(pings.first, pings.first + len(pings))
            images.append(image if noise is None else noise.apply(image, seed=seed, frames=frames))
            heights.append(pings.height_m)
            truth.append(pings.labels)
        labelled: dict[str, Any] = {name: np.concatenate([part[name] for part in truth]) for name in truth[0]}
        for sentence in [*self.notes, *tally.warnings(self, trajectory.poses)]:
            warnings.warn(sentence, MitsonarWarning, stacklevel=2)
        return SonarFrames(
            image=np.concatenate(images),
            range_m=self.sonar.range_m,
            bearing_rad=self.sonar.bearing_rad,
            time_s=trajectory.time_s,
            sonar=self.sonar,
            poses=trajectory.poses,
            height_m=np.concatenate(heights),
            level_scale=1 / gain,
            **labelled,
        )

    def step(
        self,
        pose: ArrayLike,
        *,
        time_s: float | None = None,
        noise: NoiseModel | None = None,
        seed: int = 0,
        labels: bool = False,
        gain: float | None = None,
    ) -> SonarFrames:
        """Render the next ping of a closed loop, in which each pose follows from the frame before it.

        The simulator counts its pings, so that each draws its own jitter and noise, and keeps one gain. Stepping over poses
        gives the images that ``render(poses, gain=simulator.gain)`` gives afterwards, bit for bit. Where no gain is given,
        the first frame with echoes sets it (:meth:`render` uses 20 frames); frames before that one are black, with a gain of
        1. Each warning of :meth:`render` is given once in a loop. :meth:`reset` begins a new loop.

        Args:
            pose: of the sonar: x, y, z [m], pitch, roll, heading [rad].
            time_s: of the ping [s]; default: its number / ``frame_rate_hz``.
            noise: drawn from (seed, number of the ping, cell); default none.
            seed: of the noise; the jitter's is the sonar's.
            labels: per-pixel truth as well.
            gain: the constant that levels are multiplied by; default: set on the first frame with echoes.

        Returns:
            One frame.

        Raises:
            MitsonarError: not one pose; a gain other than that of the steps before.
        """
        table = np.atleast_2d(np.asarray(pose, dtype=float))
        if table.shape != (1, 6):
            raise MitsonarError(f"a step takes one pose x, y, z [m], pitch, roll, heading [rad]: got {table.shape}")
        if gain is not None and self.gain is not None and gain != self.gain:
            raise MitsonarError(
                f"a loop keeps its gain, {self.gain:g}: got {gain:g}; leave gain out, or call reset() to begin a new loop"
            )
        number = self._stepped
        (pings,) = self.pings(table, first=number, labels=labels)
        if self.gain is None and (gain is not None or pings.levels.any()):
            self._gain_from = "set on the first frame with echoes" if gain is None else "as given"
            self.gain = constant_gain([pings])[0] if gain is None else gain
        kept = 1.0 if self.gain is None else self.gain
        self._stepped = number + 1
        image = to_image(pings, kept)
        self._warn_once(pings, image, table)
        return SonarFrames(
            image=image if noise is None else noise.apply(image, seed=seed, frames=np.array([number])),
            range_m=self.sonar.range_m,
            bearing_rad=self.sonar.bearing_rad,
            time_s=np.array([number / self.sonar.frame_rate_hz if time_s is None else time_s]),
            sonar=self.sonar,
            poses=table,
            height_m=pings.height_m,
            level_scale=1 / kept,
            **pings.labels,
        )

    def reset(self) -> None:
        """Begin a new loop: the next :meth:`step` is ping 0, sets the gain anew, and may warn again."""
        self._stepped = 0
        self._gain_from, self.gain = "", None
        self._told.clear()

    def _warn_once(self, pings: Pings, image: NDArray[np.float32], pose: NDArray[np.float64]) -> None:
        """Warn of what a step shows, each kind once in a loop."""
        tally = Tally(self.sonar, self._gain_from)
        tally.add(pings, image)
        found = {note: note for note in self.notes} | tally.findings(self, pose, pings.first)
        for kind in [kind for kind in found if kind not in self._told]:
            self._told.add(kind)
            warnings.warn(found[kind], MitsonarWarning, stacklevel=3)


def constant_gain(batches: Iterable[Pings]) -> tuple[float, Iterator[Pings]]:
    """The gain that lifts the 99.9th percentile of all pixels of the first 20 frames to 0.9, and all the batches again.

    Where that percentile is empty the largest pixel takes its place; where all pixels are, the gain is 1.
    """
    batches = iter(batches)
    head: list[Pings] = []
    while sum(map(len, head)) < CALIBRATION_FRAMES and (pings := next(batches, None)) is not None:
        head.append(pings)
    levels = np.concatenate([pings.levels for pings in head])[:CALIBRATION_FRAMES]
    bright = float(np.percentile(levels, 99.9)) or float(levels.max())
    return (0.9 / bright if bright > 0 else 1.0), chain(head, batches)


def to_image(pings: Pings, gain: float) -> NDArray[np.float32]:
    """Levels times gain, clipped to 0..1."""
    return np.clip(pings.levels * np.float32(gain), 0, 1)


def labels_of(pings: Pings, truth: Any, rays: int) -> dict[str, NDArray[Any]]:
    """Label maps of a batch (see :class:`mitsonar.records.sonar_frames.SonarFrames`), from the strongest ray of each cell.

    ``rays`` is how many a ping has.
    """
    best, elevation, shape_id, object_id = truth
    frames, bins, beams = pings.levels.shape
    winner = np.array(best).reshape(frames, beams, bins).transpose(0, 2, 1)
    filled = (winner > 0) & (pings.levels > 0)
    ray = (winner & 0xFFFFFFFF).astype(np.int64) + np.arange(frames)[:, None, None] * rays
    ray = np.where(filled, ray, 0)
    return {
        "elevation_rad": np.where(filled, np.array(elevation)[ray], np.float32(np.nan)),
        "shape_id": np.where(filled, np.array(shape_id)[ray], -1).astype(np.int32),
        "object_id": np.where(filled, np.array(object_id)[ray], -1).astype(np.int32),
        "shadow": shadow(pings),
    }


def shadow(pings: Pings) -> NDArray[np.uint8]:
    """0 lit or not yet intercepted; 1 dark between what intercepts and what still travels; 2 dark beyond all echoes."""
    echo = pings.levels > 0
    nearer = np.logical_or.accumulate(echo, axis=1) | (pings.counts.nearer > 0)[:, None]
    still = np.logical_or.accumulate(echo[:, ::-1], axis=1)[:, ::-1]
    still = still | ((pings.counts.farther > 0) | (pings.counts.missed > 0))[:, None]
    return np.where(nearer & ~echo, np.where(still, 1, 2), 0).astype(np.uint8)


@dataclass
class Tally:
    """What a run adds up to warn of."""

    sonar: Sonar
    gain_from: str = "set on the first 20 frames"
    frames: int = 0
    rays: dict[str, int] = field(default_factory=lambda: dict.fromkeys(("inside", "nearer", "farther", "missed"), 0))
    pixels: int = 0
    filled: int = 0
    saturated: int = 0
    worst: tuple[int, int] = (0, 0)
    empty: int = 0
    first_empty: tuple[int, ...] = ()
    """Number of the first empty frame, then of its rays those inside the window, nearer, farther, missed."""

    def add(self, pings: Pings, image: NDArray[np.float32]) -> None:
        """Count a batch; ``image`` before noise."""
        self.frames += len(pings)
        filled = np.count_nonzero(image, axis=(1, 2))
        empty = np.flatnonzero(filled < NEARLY_EMPTY * image[0].size)
        if len(empty) and not self.empty:
            rays = (int(getattr(pings.counts, name)[empty[0]].sum()) for name in self.rays)
            self.first_empty = (pings.first + int(empty[0]), *rays)
        self.empty += len(empty)
        for name in self.rays:
            self.rays[name] += int(getattr(pings.counts, name).sum())
        self.pixels += image.size
        self.filled += int(filled.sum())
        self.saturated += int(np.count_nonzero(image >= 1))
        outside = (pings.counts.nearer + pings.counts.farther).sum(axis=1)
        if outside.max() > self.worst[0]:
            self.worst = int(outside.max()), pings.first + int(outside.argmax())

    def warnings(self, source: Any, poses: NDArray[np.float64]) -> list[str]:
        """A sentence for each thing that the user should know; ``source`` finds the ranges of the worst frame."""
        return list(self.findings(source, poses).values())

    def findings(self, source: Any, poses: NDArray[np.float64], first: int = 0) -> dict[str, str]:
        """The sentences of :meth:`warnings`, each by the name of what it is about.

        Args:
            source: finds the ranges of the worst frame.
            poses: of the frames ``(frames, 6)``.
            first: number of the first of them.
        """
        sonar, rays = self.sonar, self.rays
        outside = rays["nearer"] + rays["farther"]
        hits = rays["inside"] + outside
        found = {}
        if self.empty:
            number, *its_rays = self.first_empty
            pose = poses[number - first]
            window = (sonar.range_min, sonar.range_max)
            beside = source.window_range(pose, number)
            found["empty"] = empty_frames(self.empty, self.frames, (number, pose), its_rays, window, beside)
        if outside > 0:
            frame = self.worst[1]
            ends = source.window_range(poses[frame - first], frame)
            where = f", in frame {frame} at {ends[0]:.2f}..{ends[1]:.2f} m" if ends else ""
            found["window"] = (
                f"{outside:,} of {hits:,} returns ({100 * outside / hits:.2g} %) lie outside the window "
                f"{sonar.range_min:g}..{sonar.range_max:g} m{where}: they are dropped; widen the window if they matter"
            )
        if self.saturated > 0.01 * self.pixels:
            found["saturated"] = (
                f"{100 * self.saturated / self.pixels:.2g} % of pixels are at the maximum (more than 1 %): the gain, "
                f"{self.gain_from}, is too high for the rest"
            )
        if sonar.model == "thesis" and 0 < rays["inside"] < 10 * self.filled:
            found["rays"] = (
                f"{rays['inside'] / self.filled:.1f} rays a bin on average, below 10: point deposits make the levels "
                "noisy; raise rays_per_beam, lower range_bins, or use the model physical"
            )
        return found

    def state(self) -> dict[str, Any]:
        """As JSON can hold it; :meth:`restore` reads it back."""
        names = ("frames", "rays", "pixels", "filled", "saturated", "worst", "empty", "first_empty")
        return {name: getattr(self, name) for name in names}

    @classmethod
    def restore(cls, sonar: Sonar, state: dict[str, Any]) -> Tally:
        """The tally of a run that was broken off, as JSON gives it back.

        Raises:
            MitsonarError: the state is damaged.
        """
        kept = cls(sonar)
        rays, worst, empty = (state.get(name) for name in ("rays", "worst", "first_empty"))
        if set(state) != set(kept.state()) or not isinstance(rays, dict) or set(rays) != set(kept.rays):
            raise MitsonarError(f"the tally must hold {', '.join(kept.state())}, and rays {', '.join(kept.rays)}")
        if not isinstance(worst, list) or len(worst) != 2 or not isinstance(empty, list) or len(empty) not in (0, 5):
            raise MitsonarError("worst of the tally must be two counts, first_empty five or none")
        for count in (*rays.values(), *worst, *empty):
            whole_number(count, "a count of the tally")
        frames = whole_number(state["frames"], "frames of the tally")
        pixels = whole_number(state["pixels"], "pixels of the tally")
        for name in ("filled", "saturated"):
            whole_number(state[name], f"{name} of the tally", 0, pixels)
        whole_number(state["empty"], "empty of the tally", 0, frames if empty else 0)
        for number in (worst[1], *empty[:1]):
            whole_number(number, "a frame of the tally", 0, max(0, frames - 1))
        tuples = {name: tuple(state[name]) for name in ("worst", "first_empty")}
        return cls(sonar, **{**state, "rays": dict(state["rays"]), **tuples})
