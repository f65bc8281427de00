"""How bounds are computed for a scene or a data set and reported: JSON for programs, a table for people."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.noise import NoiseModel, load_noise, refuse_noise
from mitsonar.config.data import MirrorKeys
from mitsonar.datasets.make import SceneRenderer
from mitsonar.datasets.store import DataStore, frames_in_part, world_numbers
from mitsonar.errors import MitsonarError, argument
from mitsonar.estimation.crlb.image import LARGEST, Bound, bounds_at, laws_of, overall, varied
from mitsonar.estimation.crlb.observability import bounds_of_fans, observability
from mitsonar.estimation.estimator import PlainTable
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import Sounder
from mitsonar.instruments.views import Segment, View, Whole
from mitsonar.motion.composition import DEGREES, PLANAR, MotionStd
from mitsonar.simulation.device import release_memory
from mitsonar.simulation.pings import CALIBRATION_FRAMES, RenderedPings, constant_gain
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = [
    "BoundOptions",
    "Place",
    "Subject",
    "Table",
    "Value",
    "bounds_of_subject",
    "bounds_report",
    "report_lines",
    "subject_of_data",
    "subject_of_scene",
]


Value = float | tuple[float, float]
"""Value of a variable: a number, or both ends of a window."""

Table = dict[tuple[str, str, str], list[Bound | None]]
"""A bound for each pose, keyed by (portion, kind, law)."""


def units_of(degrees: Sequence[str]) -> tuple[NDArray[np.float64], list[str]]:
    """Return the factors from m and rad to the printed units of degrees of freedom ``(k,)``, and the names of the units."""
    lengths = ["[m]" in DEGREES[name] for name in degrees]
    return np.where(lengths, 1e3, np.degrees(1)), ["mm" if length else "deg" for length in lengths]


@dataclass(frozen=True, kw_only=True)
class BoundOptions:
    """Choices of bounds.

    Attributes:
        noise: noise of the pixels; None: high, or none in the model ``coherent``, which includes noise.
        height_m: height of the sonar over the ground [m]; None: that of the poses.
        vary: name of one of :data:`~mitsonar.estimation.crlb.image.VARIABLES`, if any.
        values: values of this variable.
        gain: constant gain; None: that of a data set if nothing varies, else determined from the frames.
        pings: pings of each half of the derivatives; None: as needed.
        degrees: names of the degrees of freedom of the motion, of :data:`~mitsonar.motion.composition.DEGREES`.
        largest: largest standard deviations that count as an observation, where ``degrees`` differ from the usual three.

    Raises:
        MitsonarError: an unknown noise, or a height or gain that is not above 0.
    """

    noise: str | None = None
    height_m: float | None = None
    vary: str | None = None
    values: Sequence[Value] = ()
    gain: float | None = None
    pings: int | None = None
    degrees: tuple[str, ...] = PLANAR
    largest: MotionStd = LARGEST

    def __post_init__(self) -> None:
        load_noise(self.noise or "none")
        if self.height_m is not None and not self.height_m > 0:
            raise MitsonarError(f"{argument('height_m')} must be above 0: got {self.height_m:g} m")
        if self.gain is not None and not 0 < self.gain < np.inf:
            raise MitsonarError(f"{argument('gain')} must be above 0 and finite: got {self.gain:g}")

    def noise_for(self, sonar: Sonar) -> NoiseModel:
        """Return the noise of the pixels of a sonar.

        Raises:
            MitsonarError: noise of pixels for the model ``coherent``.
        """
        noise = load_noise(self.noise or ("none" if sonar.model == "coherent" else "high"))
        refuse_noise(noise, sonar)
        return noise


def bounds_report(source: str, subject: Subject, options: BoundOptions, progress: Callable[[int], None]) -> PlainTable:
    """Compute the bounds of a subject for each value of the variable, and report them as a JSON object.

    Numbers are in mm and deg; they are null where there is no bound or the motion is not observable.

    Args:
        source: name of the scene or data set.
        subject: scenes, poses and sonar of the bounds.
        options: noise, variable and derivatives.
        progress: called with the number of finished poses.

    Raises:
        MitsonarError: noise or values that do not fit, or no echo at all.
    """
    name, rows = options.vary, []
    factors, units = units_of(options.degrees)
    values: Sequence[Value | None] = options.values or [None]
    for value in values:
        for (portion, kind, law), bounds in bounds_of_subject(subject, options, value, progress).items():
            row: PlainTable = {} if name is None else {name: value}
            row |= {"portion": portion, "data": kind, "law": law, "poses": len(bounds)}
            known = [one for one in bounds if one is not None]
            for frames, key in ((1, "one_frame"), (2, "two_frames")):
                each = np.array([one.std(frames) * factors for one in known])
                row[key] = _numbers(overall(each)) if len(known) == len(bounds) else None
                row[f"{key}_each"] = [_numbers(std) for std in each]
            row["not_observable"] = sum(not np.isfinite(one.std()).all() for one in known)
            row["relative_error"] = _numbers(np.mean([one.relative_error for one in known], axis=0)) if known else None
            if options.degrees != PLANAR:
                each_pose = [observability(one, options.degrees, largest=options.largest) for one in known]
                row["observable_each"] = [one.observable for one in each_pose]
                row["unobservable_each"] = [list(one.unobservable) for one in each_pose]
                row["undecided_each"] = [list(one.undecided) for one in each_pose]
            rows.append(row)
    return {
        "source": source,
        "noise": "of the receiver" if subject.sonar.model == "coherent" else options.noise or "high",
        "vary": name,
        "units": [f"{degree} {unit}" for degree, unit in zip(options.degrees, units, strict=True)],
        "laws": laws_of(subject.sonar),
        "rows": rows,
    }


def bounds_of_subject(
    subject: Subject, options: BoundOptions, value: Value | None, progress: Callable[[int], None]
) -> Table:
    """Compute the bounds at all poses for one value of the variable; see :func:`bounds_report`."""
    noise = options.noise_for(subject.sonar)
    changes = [(name, v) for name, v in (("height_m", options.height_m), (options.vary, value)) if name and v is not None]
    gain = subject.gain if options.gain is None and options.vary is None else options.gain
    table: Table = {}
    for place in subject.places():
        sonar, poses, heights = subject.sonar, place.poses, place.heights
        if sonar.model == "coherent" and place.seed is not None:
            sonar = sonar.replace(seed=place.seed)
        for name, varied_value in changes:
            sonar, poses = varied(sonar, poses, heights, name, varied_value)
            heights = np.full_like(heights, varied_value) if name == "height_m" else heights
        if subject.sounder is not None:
            table |= _bounds_of_sounder(subject.sounder, place.scene, poses, options, progress)
            continue
        simulator = Simulator(place.scene, sonar, views=subject.views(sonar), mirrors=subject.mirrors)
        gain = gain if gain is not None else _gain(simulator, poses)
        for bounds in bounds_at(simulator, poses, noise, gain, pings=options.pings, degrees=options.degrees):
            for key, bound in bounds.items():
                table.setdefault(key, []).append(bound)
            progress(1)
    return table


def _bounds_of_sounder(
    sounder: Sounder, scene: mi.Scene, poses: NDArray[np.float64], options: BoundOptions, progress: Callable[[int], None]
) -> Table:
    """Compute the bounds of an instrument of several fans at all poses of its vehicle."""
    simulator = Simulator(scene, sounder.fan)
    gain = options.gain
    if gain is None:
        fans = sounder.fan_poses(poses).reshape(-1, 6)
        gain = _gain(simulator, fans[np.unique(np.linspace(0, len(fans) - 1, CALIBRATION_FRAMES).round().astype(int))])
    table: Table = {}
    noise = options.noise_for(sounder.fan)
    for bounds in bounds_of_fans(simulator, sounder, poses, noise, gain, degrees=options.degrees, pings=options.pings):
        for key, bound in bounds.items():
            table.setdefault(key, []).append(bound)
        progress(1)
    return table


def _gain(simulator: Simulator, poses: NDArray[np.float64]) -> float:
    """Return the constant gain of all views from the first frames, as for a run."""
    batches = []
    for views in simulator.render_views(poses[:CALIBRATION_FRAMES]):
        flat = np.concatenate([pings.levels.reshape(len(pings), -1) for pings in views], axis=1)
        batches.append(RenderedPings(views[0].first, flat[:, :, None], views[0].counts, views[0].height_m))
    if not any(pings.levels.any() for pings in batches):
        raise MitsonarError("no ray met anything within the window: check the pose (pitch > 0 looks down) and the window")
    return constant_gain(batches)[0]


def _numbers(values: NDArray[np.float64]) -> list[float | None]:
    return [float(f"{v:.6g}") if np.isfinite(v) else None for v in values]


def report_lines(report: PlainTable) -> list[str]:
    """Return the table of least standard deviations as lines of text."""
    name = report["vary"]
    titles = [name] if name else []
    degrees, units = zip(*(unit.split() for unit in report["units"]), strict=True)
    listed = " / ".join(units)
    titles += ["portion", "data", "law", f"one frame: {listed}", f"two frames: {listed}", "poses"]
    cells = [titles]
    for row in report["rows"]:
        value = row.get(name)
        value_text = "..".join(f"{v:g}" for v in value) if isinstance(value, tuple) else f"{value:g}" if name else ""
        texts = [_text(row[words], units) for words in ("one_frame", "two_frames")]
        unobservable = f", {row['not_observable']} not observable" if row["not_observable"] else ""
        cells.append(
            [
                *([value_text] if name else []),
                row["portion"],
                row["data"],
                row["law"],
                *texts,
                f"{row['poses']}{unobservable}",
            ]
        )
    widths = [max(len(line[k]) for line in cells) for k in range(len(titles))]
    lines = ["  ".join(word.ljust(width) for word, width in zip(line, widths, strict=True)).rstrip() for line in cells]
    head = f"noise {report['noise']}: least standard deviation, {' / '.join(degrees)} (root of the mean variance)"
    meanings = (f"{law}: {meaning}" for law, meaning in report["laws"].items())
    return [head, *lines, *meanings, *_observability_lines(report["rows"], len(degrees))]


def _observability_lines(rows: list[PlainTable], degrees: int) -> list[str]:
    """Return a line for each set of directions that images cannot show, or about which derivatives are too noisy."""
    lines: dict[str, None] = {}
    for row in rows:
        where = " ".join([row["portion"], row["data"], row["law"]])
        for key, text in (("unobservable_each", "not"), ("undecided_each", "undecided, for want of pings:")):
            for observable, names in zip(row.get("observable_each", ()), row.get(key, ()), strict=True):
                if names:
                    lines[f"{where}: {observable} of {degrees} directions observable; {text} {', '.join(names)}"] = None
    return list(lines)


def _text(std: list[float | None] | None, units: Sequence[str]) -> str:
    if std is None:
        return "-"
    return " / ".join(_number(v, 3 if unit == "mm" else 4) for v, unit in zip(std, units, strict=True))


def _number(value: float | None, digits: int) -> str:
    """Return a standard deviation with some decimals, or with two digits where these show fewer; inf for None."""
    if value is None:
        return "inf"
    return f"{value:.2g}" if 0 < value < 10 ** (1 - digits) else f"{value:.{digits}f}"


# ---------------- Subjects: scenes and data sets


@dataclass(frozen=True)
class Place:
    """A scene, and the poses in it.

    Attributes:
        scene: the Mitsuba scene.
        poses: poses of the sonar ``(n, 6)``.
        heights: heights over the ground ``(n,)`` [m].
        seed: seed of the scatterers here; None: that of the sonar.
    """

    scene: mi.Scene
    poses: NDArray[np.float64]
    heights: NDArray[np.float64]
    seed: int | None = None


@dataclass(frozen=True)
class Subject:
    """Scenes, poses and sonar for which a bound is computed.

    Attributes:
        sonar: the instrument.
        views: function that returns the views of a sonar; it may refuse any other than the instrument.
        places: function that yields the places one after another, so that only one scene is in memory.
        poses: number of poses in all places.
        gain: gain of a data set, if it is one.
        mirrors: mirrors of all scenes.
        sounder: instrument of several fans, whose ``fan`` the sonar is and whose vehicle the poses are of; None: one sonar.
    """

    sonar: Sonar
    views: Callable[[Sonar], list[View]]
    places: Callable[[], Iterator[Place]]
    poses: int
    gain: float | None = None
    mirrors: MirrorKeys = None
    sounder: Sounder | None = None


def subject_of_scene(
    scene: mi.Scene,
    sonar: Sonar,
    poses: NDArray[np.float64],
    *,
    segments: list[str],
    sounder: Sounder | None = None,
) -> Subject:
    """Return the subject of poses in one scene.

    Args:
        scene: the Mitsuba scene.
        sonar: the instrument.
        poses: poses of the sonar ``(n, 6)``.
        segments: names of portions of a looking-down sonar's view; none: all of it.
        sounder: instrument of several fans, whose ``fan`` the sonar is; the poses are then those of its vehicle.

    Raises:
        MitsonarError: a pose over nothing.
    """
    heights = np.concatenate([batch.height_m for batch in Simulator(scene, sonar).pings(poses)])
    if not np.isfinite(heights).all():
        raise MitsonarError("nothing is below the sonar at some pose: give a pose over the scene with --from")
    place = Place(scene, poses, heights)
    return Subject(sonar, lambda other: _views(other, segments), lambda: iter([place]), len(heights), sounder=sounder)


def subject_of_data(source: str, pairs: int, *, part: str | None = None, seed: int | None = None) -> Subject:
    """Return the subject of the first poses of pairs of a data set, scene by scene.

    Args:
        source: path or URL.
        pairs: number of pairs, each from a different sequence.
        part: part of the data set; None: the one that training does not see.
        seed: seed of the rays; None: that of the data set.

    Raises:
        MitsonarError: no pair, or not a data set.
    """
    if pairs < 1:
        raise MitsonarError(f"--pairs must be at least 1: got {pairs}")
    store = DataStore.open(source)
    recipe = store.recipe
    scene, sequence, pose, height = (store.read(name) for name in ("scene", "sequence", "pose", "height_m"))
    part = part or recipe.split.unseen
    in_part = np.flatnonzero(
        frames_in_part(world_numbers(recipe, store.scenes)[scene], sequence, recipe.split, part) & np.isfinite(height)
    )
    first = in_part[np.unique(sequence[in_part], return_index=True)[1]]
    if not len(first):
        raise MitsonarError(f"{source} has no frame over ground in part {part!r}: give --part all")
    chosen = first[np.unique(np.linspace(0, len(first) - 1, min(pairs, len(first))).round().astype(int))]

    def places() -> Iterator[Place]:
        for number in np.unique(scene[chosen]):
            in_scene = chosen[scene[chosen] == number]
            renderer = SceneRenderer(recipe, store.scenes[int(number)])
            yield Place(renderer.simulator.tracer.scene, pose[in_scene], height[in_scene], renderer.simulator.sonar.seed)
            del renderer
            release_memory()

    def views(other: Sonar) -> list[View]:
        if recipe.receivers and other != instrument:
            raise MitsonarError("--vary and --height need one sonar that sends and receives: this data set has receivers")
        return recipe.views if recipe.receivers else _views(other, recipe.segments)

    instrument = recipe.instrument if seed is None else recipe.instrument.replace(seed=seed)
    return Subject(instrument, views, places, len(chosen), float(store.about["gain"]), recipe.mirrors)


def _views(sonar: Sonar, segments: list[str]) -> list[View]:
    return [Segment(sonar, name) for name in segments] or [Whole(sonar)]
