"""What a rendered ping is: its pose and time, levels, gain, per-pixel labels, and the warnings of a run."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.levels import coded
from mitsonar.errors import MitsonarError, count_noun
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.files import finite_number, whole_number
from mitsonar.motion.pose import refuse_beyond_reach, vehicle_rotation

__all__ = [
    "NEARLY_EMPTY",
    "NEGLIGIBLE",
    "Counts",
    "CutRays",
    "FirstPing",
    "RenderedPings",
    "Tally",
    "angle_hint",
    "constant_gain",
    "empty_frames",
    "labels_above",
    "labels_of",
    "moments_of",
    "percent",
    "shadow",
    "to_image",
    "view_of",
]


FirstPing: TypeAlias = int | Sequence[int]
"""Number of the first of several consecutive pings, or the number of each ping."""


def moments_of(
    sonar: Sonar, poses: ArrayLike, time_s: ArrayLike | None, first: FirstPing
) -> tuple[NDArray[np.float64], NDArray[np.float64], list[int]]:
    """Check and complete the poses and times of pings, and return them with the ping numbers.

    Poses and times get an axis for groups of beams where the sonar has several.

    Args:
        sonar: the instrument.
        poses: ``(frames, 6)``, valid for all groups of a frame, or ``(frames, groups, 6)`` [m, rad].
        time_s: ``(frames,)`` or ``(frames, groups)`` [s]; default: frame number / ``frame_rate_hz``.
        first: number of the first frame, or the number of each frame.

    Raises:
        MitsonarError: a shape is wrong; a value is not finite or too large; ping numbers are negative or of another count.
    """
    table, groups = np.atleast_2d(np.asarray(poses, dtype=float)), sonar.ping_groups
    shapes = [(len(table), 6)] + ([(len(table), groups, 6)] if groups > 1 else [])
    if table.shape not in shapes or not len(table) or not np.isfinite(table).all():
        allowed = "(frames, 6)" if groups == 1 else f"(frames, 6) or (frames, {groups}, 6)"
        raise MitsonarError(f"poses must be finite numbers {allowed}: got {table.shape}; give m and rad")
    refuse_beyond_reach(table)
    numbers = (
        [first + offset for offset in range(len(table))]
        if isinstance(first, int | np.integer)
        else [int(number) for number in first]
    )
    if len(numbers) != len(table) or min(numbers) < 0:
        raise MitsonarError(f"each of the {len(table)} pings needs a number of 0 or more: got {len(numbers)} numbers")
    time = np.array(numbers) / sonar.frame_rate_hz if time_s is None else np.asarray(time_s, dtype=float)
    if time.shape not in [shape[:-1] for shape in shapes] or not np.isfinite(time).all():
        raise MitsonarError(f"times must be finite numbers, one for each pose {table.shape[:-1]}: got {time.shape}; give s")
    if groups == 1:
        return table, time, numbers
    table = table if table.ndim == 3 else np.repeat(table[:, None], groups, axis=1)
    return table, time if time.ndim == 2 else np.repeat(time[:, None], groups, axis=1), numbers


# ---------------- Rendered pings and their gain


CALIBRATION_FRAMES = 20
"""Number of frames whose brightest pixels set the gain of a run."""


@dataclass
class Counts:
    """Numbers of rays of each beam ``(frames, beams)``: inside the window, nearer, farther, missed.

    ``inside`` is -1 where the number of rays of a beam differs from ping to ping (``View.rays_a_beam`` is None).
    """

    inside: NDArray[np.int64]
    nearer: NDArray[np.int64]
    farther: NDArray[np.int64]
    missed: NDArray[np.int64]


class CutRays(NamedTuple):
    """Rays of the model ``coherent`` whose surface cells hold more points than one ray may visit.

    Attributes:
        rays: number of such rays.
        enough_m: pitch of points at which no ray would be cut [m].
    """

    rays: int = 0
    enough_m: float = 0.0


NONE_CUT = CutRays()


@dataclass
class RenderedPings:
    """A batch of consecutive pings.

    Attributes:
        first: number of the first ping.
        levels: ``(pings, bins, beams)`` float32, before gain.
        counts: numbers of rays inside the window, nearer, farther and missed.
        height_m: height of the sonar above the surface straight below it ``(pings,)`` [m].
        labels: ``elevation_rad``, ``shape_id``, ``object_id`` and ``shadow``, each shaped like ``levels``; empty unless
            requested.
        expected: levels without speckle, noise and patterns, shaped like ``levels``, from which labels are derived; None:
            labels are derived from ``levels``.
        cut: rays that missed points, in the model ``coherent``.
    """

    first: int
    levels: NDArray[np.float32]
    counts: Counts
    height_m: NDArray[np.float64]
    labels: dict[str, Any] = field(default_factory=dict)
    expected: NDArray[np.float32] | None = None
    cut: CutRays = NONE_CUT

    def __len__(self) -> int:
        return len(self.levels)

    @property
    def echoes(self) -> NDArray[np.float32]:
        """Return the levels that determine which pixels hold an echo ``(pings, bins, beams)``."""
        return self.levels if self.expected is None else self.expected


def constant_gain(batches: Iterable[RenderedPings]) -> tuple[float, Iterator[RenderedPings]]:
    """Compute the gain that scales the 99.9th percentile of the pixels of the first 20 frames to 0.9.

    If that percentile is 0, the largest pixel takes its place; if all pixels are 0, the gain is 1.

    Returns:
        The gain, and an iterator over all batches, including those that were consumed to compute it.
    """
    batches = iter(batches)
    head: list[RenderedPings] = []
    while sum(map(len, head)) < CALIBRATION_FRAMES and (pings := next(batches, None)) is not None:
        head.append(pings)
    levels = np.concatenate([pings.levels for pings in head])[:CALIBRATION_FRAMES]
    bright = float(np.percentile(levels, 99.9)) or float(levels.max())
    faintest = 0.9 / float(np.finfo(np.float32).max)  # below it, the gain exceeds single precision
    return (0.9 / bright if bright > faintest else 1.0), chain(head, batches)


def to_image(levels: NDArray[np.float32], gain: float, sonar: Sonar) -> NDArray[np.float32]:
    """Return image values 0..1, of the same shape: levels times the gain, in the sonar's value coding."""
    return coded(levels * np.float32(gain), sonar)


# ---------------- Per-pixel truth


def labels_of(pings: RenderedPings, truth: Any, rays: int) -> dict[str, NDArray[Any]]:
    """Return the label maps of a batch: elevation, shape and object of each cell's strongest ray, and shadow.

    See :class:`mitsonar.records.frames.SonarFrames` for the maps.

    Args:
        pings: the batch.
        truth: strongest ray of each cell, and elevation, shape and object of each ray.
        rays: number of rays of a ping.
    """
    best, elevation, shape_id, object_id = truth
    frames, bins, beams = pings.levels.shape
    winner = np.array(best).reshape(frames, beams, bins).transpose(0, 2, 1)
    filled = (winner > 0) & (pings.echoes > 0)
    ray = (winner & 0xFFFFFFFF).astype(np.int64) + np.arange(frames)[:, None, None] * rays
    ray = np.where(filled, ray, 0)
    return {
        "elevation_rad": np.where(filled, np.array(elevation)[ray], np.float32(np.nan)),
        "shape_id": np.where(filled, np.array(shape_id)[ray], -1).astype(np.int32),
        "object_id": np.where(filled, np.array(object_id)[ray], -1).astype(np.int32),
        "shadow": shadow(pings),
    }


def labels_above(pings: RenderedPings, gain: float, floor: float | NDArray[np.float64]) -> dict[str, Any]:
    """Return the label maps of a batch without the pixels whose level is at most ``floor``.

    Args:
        pings: a batch with or without labels.
        gain: factor that scales levels to a full scale of 1.
        floor: fraction of full scale, a single one or one for each bin ``(bins, 1)``; 0 labels every echo, however faint.
    """
    if np.max(floor) <= 0 or not pings.labels:
        return pings.labels
    bright = pings.echoes * np.float32(gain) > np.asarray(floor, dtype=np.float32)
    empty = {"elevation_rad": np.float32(np.nan), "shape_id": np.int32(-1), "object_id": np.int32(-1)}
    labels = {name: np.where(bright, pings.labels[name], nothing) for name, nothing in empty.items()}
    return {**labels, "shadow": shadow(pings, bright)}


def shadow(pings: RenderedPings, echo: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """Classify the pixels without an echo ``(frames, bins, beams)``.

    0: an echo, or no ray has been intercepted yet. 1: dark, although some rays travel on. 2: dark beyond all echoes.

    Args:
        pings: the batch.
        echo: which pixels count as echoes; default: all that are not 0.
    """
    echo = pings.echoes > 0 if echo is None else echo
    beams = echo.shape[2]
    # A pixel is behind the first echo of its beam, or behind a return nearer than the window; rays travel on if a farther
    # echo follows, a return lies beyond the window, or a ray of the beam hit nothing.
    near, far, missed = (_of_beams(one, beams) for one in (pings.counts.nearer, pings.counts.farther, pings.counts.missed))
    nearer = np.logical_or.accumulate(echo, axis=1) | (near > 0)[:, None]
    still = np.logical_or.accumulate(echo[:, ::-1], axis=1)[:, ::-1]
    still = still | ((far > 0) | (missed > 0))[:, None]
    return np.where(nearer & ~echo, np.where(still, 1, 2), 0).astype(np.uint8)


def _of_beams(counts: NDArray[Any], beams: int) -> NDArray[Any]:
    """Return the ray counts of the image's beams, without the boxes traced beside the fan for a beam pattern."""
    margin = max(0, counts.shape[-1] - beams) // 2
    return counts[..., margin : counts.shape[-1] - margin]


# ---------------- Tally of a run, for its warnings


NEGLIGIBLE = 1e-3
"""Fraction of the returns that may lie outside the window without a warning."""


@dataclass
class Tally:
    """Running totals of a run, from which its warnings are derived.

    Attributes:
        sonar: the instrument.
        gain_from: origin of the gain, as the warnings state it.
        frames: number of frames.
        rays: numbers of rays inside the window, nearer, farther and missed.
        pixels: number of pixels.
        filled: number of pixels with an echo.
        saturated: number of pixels at the maximum.
        worst: largest number of returns outside the window in one frame, and the number of that frame.
        empty: number of empty frames.
    """

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
    """Number of the first empty frame, then its rays inside the window, nearer, farther and missed."""
    cut: int = 0
    """Number of rays that missed points."""
    enough_m: float = 0.0
    """Pitch of points at which no ray would miss any [m]."""

    def add(self, pings: RenderedPings, image: NDArray[np.float32]) -> None:
        """Add a batch to the totals; ``image`` is its image without the noise model."""
        self.frames += len(pings)
        filled = np.count_nonzero(image, axis=(1, 2))
        if self.sonar.model == "coherent":  # noise and side lobes fill every pixel
            filled = np.where(pings.counts.inside.sum(axis=1) > 0, filled, 0)
        empty = np.flatnonzero(filled < NEARLY_EMPTY * image[0].size)
        if len(empty) and not self.empty:
            rays = (int(getattr(pings.counts, name)[empty[0]].sum()) for name in self.rays)
            self.first_empty = (pings.first + int(empty[0]), *rays)
        self.empty += len(empty)
        for name in self.rays:
            self.rays[name] += int(getattr(pings.counts, name).sum())
        self.cut += pings.cut.rays
        self.enough_m = max(self.enough_m, pings.cut.enough_m)
        self.pixels += image.size
        self.filled += int(filled.sum())
        self.saturated += int(np.count_nonzero(image >= 1))
        outside = (pings.counts.nearer + pings.counts.farther).sum(axis=1)
        if outside.max() > self.worst[0]:
            self.worst = int(outside.max()), pings.first + int(outside.argmax())

    def warnings(self, source: Any, poses: NDArray[np.float64], time_s: NDArray[np.float64]) -> list[str]:
        """Return the warnings of the run; ``source`` is the simulator, which traces the worst frame again for its ranges."""
        return list(self.findings(source, poses, time_s).values())

    def findings(
        self,
        source: Any,
        poses: NDArray[np.float64],
        time_s: NDArray[np.float64],
        first: int = 0,
        issued: Container[str] = (),
    ) -> dict[str, str]:
        """Return the sentences of :meth:`warnings`, keyed by the name of their subject.

        Args:
            source: the simulator, which traces the worst frame again for its ranges.
            poses: poses of the frames ``(frames, 6)`` [m, rad].
            time_s: times of the frames ``(frames,)``, at which moving bodies are placed [s].
            first: number of the first of these frames.
            issued: names of warnings that have been issued already; frames are not traced again for these.
        """
        sonar, rays = self.sonar, self.rays
        outside = rays["nearer"] + rays["farther"]
        hits = rays["inside"] + outside
        sentences = {}
        if self.empty and "empty" not in issued:
            number, *its_rays = self.first_empty
            pose = poses[number - first]
            window = (sonar.range_min, sonar.range_max)
            returns = source.window_range(pose, number, float(time_s[number - first]))
            sentences["empty"] = empty_frames(
                self.empty, self.frames, (number, pose), its_rays, window, returns, source.buried(pose)
            )
        if outside > NEGLIGIBLE * hits and "window" not in issued:
            frame = self.worst[1]
            ends = source.window_range(poses[frame - first], frame, float(time_s[frame - first]))
            where = f", in frame {frame} at {ends[0]:.2f}..{ends[1]:.2f} m" if ends else ""
            sentences["window"] = (
                f"{outside:,} of {hits:,} returns ({percent(outside / hits)} %) lie outside the window "
                f"{sonar.range_min:g}..{sonar.range_max:g} m{where}: they are dropped; widen the window if they matter"
            )
        if self.saturated > 0.01 * self.pixels:
            sentences["saturated"] = (
                f"{percent(self.saturated / self.pixels)} % of pixels are at the maximum (more than 1 %): the gain, "
                f"{self.gain_from}, is too high for the rest"
            )
        if self.cut:
            sentences["cut"] = (
                f"{self.cut:,} rays met surfaces at too flat an angle, or too dense points, and skipped some of their "
                f"points: these surfaces are too dark; a scatterer_spacing_m of {_up(self.enough_m)} m is enough, or a "
                "higher quality"
            )
        reach = rounding_reach_m(sonar)
        if reach is not None and np.abs(poses[:, :3]).max() > reach:
            sentences["far"] = (
                f"a pose lies {np.abs(poses[:, :3]).max():,.0f} m from the origin, where coordinates round to more than an "
                f"eighth of the wavelength: speckle becomes inaccurate; move the scene so that poses lie within "
                f"{reach:.0f} m of the origin"
            )
        if sonar.model == "thesis" and 0 < rays["inside"] < 10 * self.filled:
            sentences["rays"] = (
                f"{rays['inside'] / self.filled:.1f} rays per bin on average, below 10: point deposits make the levels "
                "noisy; raise rays_per_beam, lower range_bins, or use the model physical"
            )
        return sentences

    def state(self) -> dict[str, Any]:
        """Return the totals in a form that JSON can hold; :meth:`restore` reads it back."""
        names = ("frames", "rays", "pixels", "filled", "saturated", "worst", "empty", "first_empty", "cut", "enough_m")
        return {name: getattr(self, name) for name in names}

    @classmethod
    def restore(cls, sonar: Sonar, state: dict[str, Any]) -> Tally:
        """Restore the tally of an interrupted run from its :meth:`state`, as read from JSON.

        Raises:
            MitsonarError: the state is damaged.
        """
        blank = cls(sonar)
        rays, worst, empty = (state.get(name) for name in ("rays", "worst", "first_empty"))
        if set(state) != set(blank.state()) or not isinstance(rays, dict) or set(rays) != set(blank.rays):
            raise MitsonarError(f"the tally must hold {', '.join(blank.state())}, and rays {', '.join(blank.rays)}")
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
        whole_number(state["cut"], "cut of the tally")
        finite_number(state["enough_m"], "enough_m of the tally", above=1e-9 if state["cut"] else -math.inf)
        tuples = {name: tuple(state[name]) for name in ("worst", "first_empty")}
        return cls(sonar, **{**state, "rays": dict(state["rays"]), **tuples})


def rounding_reach_m(sonar: Sonar) -> float | None:
    """Return the coordinate at which single precision rounds to 1/8 wavelength [m]; None except in model ``coherent``."""
    if sonar.model != "coherent" or sonar.frequency_hz is None:
        return None
    return sonar.sound_speed / sonar.frequency_hz / 8 * 2.0**24


def _up(length_m: float) -> str:
    """Format a length with two digits, rounded up."""
    step = 10.0 ** (math.floor(math.log10(length_m)) - 1)
    return f"{math.ceil(length_m / step) * step:.2g}"


# ---------------- Frames without echoes: their likely causes


NEARLY_EMPTY = 1e-4
"""Fraction of filled pixels below which a frame counts as empty: 5 pixels of 512 x 96."""


def empty_frames(
    empty: int,
    frames: int,
    first: tuple[int, NDArray[np.float64]],
    rays: Sequence[int],
    window: tuple[float, float],
    returns: tuple[float, float] | None,
    buried: str = "",
) -> str:
    """Describe empty frames in one sentence.

    Args:
        empty: number of frames with no echo, or almost none (:data:`NEARLY_EMPTY`).
        frames: total number of frames.
        first: number of the first empty frame, and its pose ``(6,)`` [m, rad].
        rays: numbers of that frame's rays that hit something inside the window, nearer, farther, and that hit nothing.
        window: nearest and farthest range of the image [m].
        returns: nearest and farthest return outside the window in that frame [m]; None if there is none.
        buried: description of how the sonar is below the ground or inside an object in that frame; empty if it is not.
    """
    number, pose = first
    hint = angle_hint(pose) or (buried and f"the sonar {buried}")
    if not any(rays[:3]):
        check = "check the pose (x, y, z in m; pitch > 0 looks down) and the scene's units"
        text = f"no ray hit anything in {count_noun(empty, 'frame')}: {check}; in frame {number} {view_of(pose)}"
        return f"{text}; {hint}" if hint else text
    inside, nearer, farther, missed = (percent(count / sum(rays)) for count in rays)
    returns_text = f" (returns at {returns[0]:.3g}..{returns[1]:.3g} m)" if returns else ""
    check = "check the pose (m, pitch > 0 looks down), the window and the scene's units"
    return (
        f"empty: {empty} of {count_noun(frames, 'frame')}, frame {number} first: {inside} % of its rays meet something "
        f"within the window {window[0]:g}..{window[1]:g} m, {nearer} % nearer, {farther} % farther{returns_text}, "
        f"{missed} % nothing; {view_of(pose)}; {hint or check}"
    )


def percent(share: float) -> str:
    """Format a fraction as a percentage with two digits, without an exponent."""
    return "100" if share >= 0.995 else f"{100 * share:.2g}"


def view_of(pose: NDArray[np.float64]) -> str:
    """Describe position and view direction of a sonar in words."""
    forward = vehicle_rotation(pose).apply([0.0, 1.0, 0.0])[0]
    below = math.degrees(math.asin(float(np.clip(-forward[2], -1, 1))))
    level = (
        "along the horizon" if abs(below) < 0.05 else f"{abs(below):.3g} deg {'below' if below > 0 else 'above'} the horizon"
    )
    axis = ", ".join(f"{value:.2f}" for value in forward + 0.0)
    return f"the sonar is at ({', '.join(f'{value:g}' for value in pose[:3])}) m and looks {level}, along ({axis})"


def angle_hint(pose: NDArray[np.float64]) -> str:
    """Suggest what is wrong with the angles of an empty frame, their unit or an upward view; empty if nothing is.

    Args:
        pose: x, y, z [m], pitch, roll, heading [rad].
    """
    angles = np.asarray(pose, dtype=float)[3:]
    largest = float(np.abs(angles).max())
    degrees = ", ".join(f"{value:.3g}" for value in np.degrees(angles))
    if largest > 2 * math.pi:
        given = ", ".join(f"{value:.3g}" for value in angles)
        return (
            f"its pitch, roll, heading are {given} rad, more than a full turn: were degrees given where radians are meant?"
        )
    if 0 < math.degrees(largest) <= 2 * math.pi:
        return f"its pitch, roll, heading are only {degrees} deg: were radians given where degrees are meant?"
    if angles[0] < -math.radians(1):
        return f"its pitch is {math.degrees(angles[0]):.3g} deg, and pitch > 0 looks down: check its sign"
    return ""
