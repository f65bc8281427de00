"""Poses and times of pings as a simulator takes them, and frames whose groups of beams are rendered ping by ping."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.levels import coded
from mitsonar.acoustics.materials import check_image_mirrors
from mitsonar.errors import MitsonarError, counted
from mitsonar.instruments.sonar import Sonar, group_of_beams, one_beam, scans, turned_heads
from mitsonar.instruments.views import View, Whole
from mitsonar.io.files import finite_number, whole_number
from mitsonar.motion.pose import refuse_beyond_reach, vehicle_rotation
from mitsonar.simulation.binning import Counts

__all__ = [
    "NEARLY_EMPTY",
    "NEGLIGIBLE",
    "CutRays",
    "FirstPing",
    "GroupedPings",
    "RenderedPings",
    "Tally",
    "angle_hint",
    "check_timed",
    "constant_gain",
    "empty_frames",
    "labels_above",
    "labels_of",
    "moments_of",
    "percent",
    "shadow",
    "sonar_of_one_ping",
    "to_image",
    "view_of",
]


FirstPing: TypeAlias = int | Sequence[int]
"""Number of the first of consecutive pings, or of each ping."""


class OnePing(Protocol):
    """Renders pings, each at one moment."""

    def pings(
        self, poses: ArrayLike, *, first: FirstPing = 0, labels: bool = False, time_s: ArrayLike | None = None
    ) -> Iterator[RenderedPings]:
        """Levels of consecutive pings, in batches."""


def moments_of(
    sonar: Sonar, poses: ArrayLike, time_s: ArrayLike | None, first: FirstPing
) -> tuple[NDArray[np.float64], NDArray[np.float64], list[int]]:
    """Return poses and times of pings, both with an axis for groups of beams where there are several, and their numbers.

    Args:
        sonar: the instrument.
        poses: ``(frames, 6)``, which hold for all groups of a frame, or ``(frames, groups, 6)`` [m, rad].
        time_s: ``(frames,)`` or ``(frames, groups)`` [s]; default: the number of the frame / ``frame_rate_hz``.
        first: number of the first frame, or of each.

    Raises:
        MitsonarError: another shape, numbers that are not finite, or too large ones.
    """
    table, groups = np.atleast_2d(np.asarray(poses, dtype=float)), sonar.ping_groups
    shapes = [(len(table), 6)] + ([(len(table), groups, 6)] if groups > 1 else [])
    if table.shape not in shapes or not len(table) or not np.isfinite(table).all():
        known = "(frames, 6)" if groups == 1 else f"(frames, 6) or (frames, {groups}, 6)"
        raise MitsonarError(f"poses must be finite numbers {known}: got {table.shape}; give m and rad")
    refuse_beyond_reach(table)
    numbers = (
        [first + place for place in range(len(table))]
        if isinstance(first, int | np.integer)
        else [int(number) for number in first]
    )
    if len(numbers) != len(table) or min(numbers) < 0:
        raise MitsonarError(f"pings need a number of 0 or more each, {len(table)} of them: got {len(numbers)}")
    time = np.array(numbers) / sonar.frame_rate_hz if time_s is None else np.asarray(time_s, dtype=float)
    if time.shape not in [shape[:-1] for shape in shapes] or not np.isfinite(time).all():
        raise MitsonarError(f"times must be finite numbers, one for each pose {table.shape[:-1]}: got {time.shape}; give s")
    if groups == 1:
        return table, time, numbers
    table = table if table.ndim == 3 else np.repeat(table[:, None], groups, axis=1)
    return table, time if time.ndim == 2 else np.repeat(time[:, None], groups, axis=1), numbers


def sonar_of_one_ping(sonar: Sonar) -> Sonar | None:
    """Return the sonar whose pings make up the frames; None where one launch traces all groups, each from its own pose.

    That is so where the beams are apart: boxes. Where each beam is formed of more than its own rays, or hears those of
    others by way of several reflections, all beams of the fan are formed at each group's pose, and those of the group are
    kept. A head that turns has one beam.
    """
    if sonar.ping_groups == 1 or (sonar.beam_pattern == "box" and sonar.bounces == 1):
        return None
    return one_beam(sonar) if scans(sonar) else sonar.replace(ping_groups=1)


def check_timed(sonar: Sonar, moving: object, views: Sequence[View] | None, mirrors: object) -> None:
    """Refuse what has no bodies that move, and no groups of beams.

    Raises:
        MitsonarError: receivers elsewhere or portions; mirrors in a model without them.
    """
    what = "bodies that move" if moving else "ping groups" if sonar.ping_groups > 1 else ""
    check_image_mirrors(sonar, views, bool(mirrors))
    if what and any(not isinstance(view, Whole) for view in views or ()):
        raise MitsonarError(f"receivers elsewhere and portions have no {what}: render the whole view")


class GroupedPings:
    """Frames whose groups of beams are pings of their own.

    Args:
        inner: renders the pings of the sonar of :func:`sonar_of_one_ping`.
        sonar: with groups.
    """

    def __init__(self, inner: OnePing, sonar: Sonar) -> None:
        self.inner, self.sonar = inner, sonar

    def pings(
        self, poses: NDArray[np.float64], time_s: NDArray[np.float64], numbers: list[int], labels: bool
    ) -> Iterator[RenderedPings]:
        """Levels of frames, one at a time; arguments as :func:`moments_of` returns them."""
        groups = self.sonar.ping_groups
        heads = turned_heads(self.sonar, poses) if scans(self.sonar) else poses
        for place, number in enumerate(numbers):
            made = self.inner.pings(heads[place], first=number * groups, labels=labels, time_s=time_s[place])
            yield self._joined(list(made), number)

    def _joined(self, parts: list[RenderedPings], number: int) -> RenderedPings:
        """Return the pings of a frame's groups as one frame: each beam from the ping of its group."""
        group = group_of_beams(self.sonar)
        beam = np.zeros_like(group) if scans(self.sonar) else np.arange(self.sonar.beams)

        def chosen(images: list[Any]) -> NDArray[Any]:
            return np.ascontiguousarray(np.concatenate(images)[group, :, beam].T[None])

        counts = (
            np.concatenate([getattr(part.counts, name) for part in parts])
            for name in ("inside", "nearer", "farther", "missed")
        )
        height_m = np.concatenate([part.height_m for part in parts])
        return RenderedPings(
            number,
            chosen([part.levels for part in parts]),
            Counts(*(self._of_beams(count, group, beam) for count in counts)),
            height_m[len(height_m) // 2 :][:1],
            {name: chosen([part.labels[name] for part in parts]) for name in parts[0].labels},
            None if parts[0].expected is None else chosen([part.expected for part in parts]),
            CutRays(sum(part.cut.rays for part in parts), max(part.cut.enough_m for part in parts)),
        )

    def _of_beams(self, count: NDArray[np.int64], group: NDArray[np.int64], beam: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return numbers of rays of the frame's beams, or of all where the pings do not tell them beam by beam."""
        if count.shape[1] == (1 if scans(self.sonar) else self.sonar.beams):
            return np.asarray(count[group, beam][None])
        return np.asarray([[count.sum()]])


# ---------------- Rendered pings: levels of a batch, the constant gain of a run, and images of both


CALIBRATION_FRAMES = 20
"""Frames whose brightest pixels set the gain of a run."""


class CutRays(NamedTuple):
    """Rays of the model ``coherent`` whose cells of a surface hold more points than are looked through.

    Attributes:
        rays: how many.
        enough_m: pitch of the points with which none would be cut [m].
    """

    rays: int = 0
    enough_m: float = 0.0


NONE_CUT = CutRays()


@dataclass
class RenderedPings:
    """A batch of consecutive pings.

    Attributes:
        first: number of the first.
        levels: ``(pings, bins, beams)`` float32, before gain.
        counts: what became of the rays.
        height_m: ``(pings,)``.
        labels: ``elevation_rad``, ``shape_id``, ``object_id``, ``shadow``, like ``levels``, where asked for.
        expected: levels without speckle, noise and patterns, like ``levels``, that labels of the model ``coherent`` go by;
            None: the levels themselves.
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
        """Return the levels that tell where echoes are ``(pings, bins, beams)``."""
        return self.levels if self.expected is None else self.expected


def constant_gain(batches: Iterable[RenderedPings]) -> tuple[float, Iterator[RenderedPings]]:
    """Find the gain that lifts the 99.9th percentile of all pixels of the first 20 frames to 0.9, and all the batches again.

    Where that percentile is empty the largest pixel takes its place; where all pixels are, the gain is 1.
    """
    batches = iter(batches)
    head: list[RenderedPings] = []
    while sum(map(len, head)) < CALIBRATION_FRAMES and (pings := next(batches, None)) is not None:
        head.append(pings)
    levels = np.concatenate([pings.levels for pings in head])[:CALIBRATION_FRAMES]
    bright = float(np.percentile(levels, 99.9)) or float(levels.max())
    return (0.9 / bright if bright > 0 else 1.0), chain(head, batches)


def to_image(levels: NDArray[np.float32], gain: float, sonar: Sonar) -> NDArray[np.float32]:
    """Return values 0..1 of levels times the gain, in the sonar's coding, of the same shape."""
    return coded(levels * np.float32(gain), sonar)


# ---------------- Per-pixel truth of frames: elevation, shape, object and shadow, from the strongest ray of each cell


def labels_of(pings: RenderedPings, truth: Any, rays: int) -> dict[str, NDArray[Any]]:
    """Label maps of a batch (see :class:`mitsonar.records.frames.SonarFrames`), from the strongest ray of each cell.

    ``rays`` is how many a ping has.
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
        pings: with labels, or without.
        gain: that lifts levels to full scale, 1.
        floor: part of full scale, one or of each bin ``(bins, 1)``; 0: every echo is labelled, however faint.
    """
    if np.max(floor) <= 0 or not pings.labels:
        return pings.labels
    bright = pings.echoes * np.float32(gain) > np.asarray(floor, dtype=np.float32)
    empty = {"elevation_rad": np.float32(np.nan), "shape_id": np.int32(-1), "object_id": np.int32(-1)}
    kept = {name: np.where(bright, pings.labels[name], nothing) for name, nothing in empty.items()}
    return {**kept, "shadow": shadow(pings, bright)}


def shadow(pings: RenderedPings, echo: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """Return where no echo came from ``(frames, bins, beams)``.

    0: lit, or not yet intercepted. 1: dark between what intercepts and what still travels. 2: dark beyond all echoes.

    Args:
        pings: of a batch.
        echo: which pixels count as echoes; default: all that are not 0.
    """
    echo = pings.echoes > 0 if echo is None else echo
    beams = echo.shape[2]
    near, far, missed = (_of_beams(one, beams) for one in (pings.counts.nearer, pings.counts.farther, pings.counts.missed))
    nearer = np.logical_or.accumulate(echo, axis=1) | (near > 0)[:, None]
    still = np.logical_or.accumulate(echo[:, ::-1], axis=1)[:, ::-1]
    still = still | ((far > 0) | (missed > 0))[:, None]
    return np.where(nearer & ~echo, np.where(still, 1, 2), 0).astype(np.uint8)


def _of_beams(counts: NDArray[Any], beams: int) -> NDArray[Any]:
    """Return counts of rays in the beams of the image: with a pattern, boxes beside the fan are traced too."""
    beside = max(0, counts.shape[-1] - beams) // 2
    return counts[..., beside : counts.shape[-1] - beside]


# ---------------- The tally of a run: what its frames add up to warn of


NEGLIGIBLE = 1e-3
"""Part of the returns that may lie outside the window without a warning."""


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
    cut: int = 0
    """Rays that missed points, and the pitch of points that would do [m]."""
    enough_m: float = 0.0

    def add(self, pings: RenderedPings, image: NDArray[np.float32]) -> None:
        """Count a batch; ``image`` before noise."""
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

    def warnings(self, source: Any, poses: NDArray[np.float64]) -> list[str]:
        """Return a sentence for each thing that the user should know; ``source`` finds the ranges of the worst frame."""
        return list(self.findings(source, poses).values())

    def findings(self, source: Any, poses: NDArray[np.float64], first: int = 0, told: Container[str] = ()) -> dict[str, str]:
        """Return the sentences of :meth:`warnings`, each by the name of what it is about.

        Args:
            source: finds the ranges of the worst frame.
            poses: of the frames ``(frames, 6)``.
            first: number of the first of them.
            told: names of sentences that are not wanted again; ranges, which take another tracing, are not sought for them.
        """
        sonar, rays = self.sonar, self.rays
        outside = rays["nearer"] + rays["farther"]
        hits = rays["inside"] + outside
        found = {}
        if self.empty and "empty" not in told:
            number, *its_rays = self.first_empty
            pose = poses[number - first]
            window = (sonar.range_min, sonar.range_max)
            beside = source.window_range(pose, number)
            found["empty"] = empty_frames(
                self.empty, self.frames, (number, pose), its_rays, window, beside, source.buried(pose)
            )
        if outside > NEGLIGIBLE * hits and "window" not in told:
            frame = self.worst[1]
            ends = source.window_range(poses[frame - first], frame)
            where = f", in frame {frame} at {ends[0]:.2f}..{ends[1]:.2f} m" if ends else ""
            found["window"] = (
                f"{outside:,} of {hits:,} returns ({percent(outside / hits)} %) lie outside the window "
                f"{sonar.range_min:g}..{sonar.range_max:g} m{where}: they are dropped; widen the window if they matter"
            )
        if self.saturated > 0.01 * self.pixels:
            found["saturated"] = (
                f"{percent(self.saturated / self.pixels)} % of pixels are at the maximum (more than 1 %): the gain, "
                f"{self.gain_from}, is too high for the rest"
            )
        if self.cut:
            found["cut"] = (
                f"{self.cut:,} rays met surfaces so flatly, or points so dense, that they looked through a part of their "
                f"points only: these surfaces are too dark; a scatterer_spacing_m of {_up(self.enough_m)} m would do, or a "
                "higher quality"
            )
        reach = rounding_reach_m(sonar)
        if reach is not None and np.abs(poses[:, :3]).max() > reach:
            found["far"] = (
                f"a pose lies {np.abs(poses[:, :3]).max():,.0f} m from the origin, where coordinates round to more than an "
                f"eighth of the wavelength: speckle loses its place; move the scene so that poses lie within {reach:.0f} m "
                "of the origin"
            )
        if sonar.model == "thesis" and 0 < rays["inside"] < 10 * self.filled:
            found["rays"] = (
                f"{rays['inside'] / self.filled:.1f} rays a bin on average, below 10: point deposits make the levels "
                "noisy; raise rays_per_beam, lower range_bins, or use the model physical"
            )
        return found

    def state(self) -> dict[str, Any]:
        """As JSON can hold it; :meth:`restore` reads it back."""
        names = ("frames", "rays", "pixels", "filled", "saturated", "worst", "empty", "first_empty", "cut", "enough_m")
        return {name: getattr(self, name) for name in names}

    @classmethod
    def restore(cls, sonar: Sonar, state: dict[str, Any]) -> Tally:
        """Restore the tally of a run that was broken off, as JSON gives it back.

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
        whole_number(state["cut"], "cut of the tally")
        finite_number(state["enough_m"], "enough_m of the tally", above=1e-9 if state["cut"] else -math.inf)
        tuples = {name: tuple(state[name]) for name in ("worst", "first_empty")}
        return cls(sonar, **{**state, "rays": dict(state["rays"]), **tuples})


def rounding_reach_m(sonar: Sonar) -> float | None:
    """Return the distance at which single precision rounds to an eighth of the wavelength; None for other models."""
    if sonar.model != "coherent" or sonar.frequency_hz is None:
        return None
    return sonar.sound_speed / sonar.frequency_hz / 8 * 2.0**24


def _up(length_m: float) -> str:
    """Return a length to two digits, rounded up."""
    step = 10.0 ** (math.floor(math.log10(length_m)) - 1)
    return f"{math.ceil(length_m / step) * step:.2g}"


# ---------------- Describe frames without echoes: pose and view of the sonar, what its rays hit, and what may be wrong


NEARLY_EMPTY = 1e-4
"""Part of the pixels below which a frame counts as empty: 5 pixels of 512 x 96."""


def empty_frames(
    empty: int,
    frames: int,
    first: tuple[int, NDArray[np.float64]],
    rays: Sequence[int],
    window: tuple[float, float],
    found: tuple[float, float] | None,
    buried: str = "",
) -> str:
    """Describe empty frames in one sentence.

    Args:
        empty: number of frames with no echo, or almost none (:data:`NEARLY_EMPTY`).
        frames: number of all frames.
        first: number of the first empty frame, and its pose ``(6,)`` [m, rad].
        rays: numbers of that frame's rays that hit something inside the window, nearer, farther, and nothing.
        window: nearest and farthest range of the image [m].
        found: nearest and farthest return outside the window in that frame [m]; None where there is none.
        buried: that the sonar is below the ground or inside an object in that frame; empty where it is not.
    """
    number, pose = first
    hint = angle_hint(pose) or (buried and f"the sonar {buried}")
    if not any(rays[:3]):
        check = "check the pose (x, y, z in m; pitch > 0 looks down) and the scene's units"
        text = f"no ray hit anything in {counted(empty, 'frame')}: {check}; in frame {number} {view_of(pose)}"
        return f"{text}; {hint}" if hint else text
    inside, nearer, farther, missed = (percent(count / sum(rays)) for count in rays)
    beside = f" (returns at {found[0]:.3g}..{found[1]:.3g} m)" if found else ""
    check = "check the pose (m, pitch > 0 looks down), the window and the scene's units"
    return (
        f"empty: {empty} of {counted(frames, 'frame')}, frame {number} first: {inside} % of its rays meet something within "
        f"the window {window[0]:g}..{window[1]:g} m, {nearer} % nearer, {farther} % farther{beside}, {missed} % "
        f"nothing; {view_of(pose)}; {hint or check}"
    )


def percent(share: float) -> str:
    """Return a share in percent to two digits, without an exponent."""
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
    """Suggest what is wrong with the angles of an empty frame: their unit, or a view upwards; else return an empty text.

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
