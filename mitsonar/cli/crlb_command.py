"""``mitsonar limit``: how well a motion can be known at all, of a scene, sonar and noise, or of a data set."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from mitsonar.cli.console import answered, progress_bar, say, warn
from mitsonar.cli.render_command import SIX, Frame, _instrument, _path, scene_parameters
from mitsonar.errors import MitsonarError

if TYPE_CHECKING:
    from mitsonar.acoustics.noise import NoiseModel
    from mitsonar.estimation.crlb.image_crlb import Bound
    from mitsonar.instruments.imaging_sonar import Sonar
    from mitsonar.instruments.views import View

__all__ = ["limit"]

Value = float | tuple[float, float]
UNITS = np.array([1e3, 1e3, np.degrees(1)])


@dataclass(frozen=True)
class Place:
    """A scene, and the poses in it.

    Attributes:
        scene: Mitsuba's.
        poses: of the sonar ``(n, 6)``.
        heights: over the ground ``(n,)`` [m].
    """

    scene: Any
    poses: NDArray[np.float64]
    heights: NDArray[np.float64]


@dataclass(frozen=True)
class Subject:
    """What a bound is asked for.

    Attributes:
        sonar: the instrument.
        views: its views, made for a sonar; None where they cannot be made for another.
        places: one after another, so that only one scene is in memory.
        poses: in all of them.
        gain: constant; None: set on the frames.
    """

    sonar: Sonar
    views: Callable[[Sonar], list[View]]
    places: Callable[[], Iterator[Place]]
    poses: int
    gain: float | None


@answered
def limit(
    source: Annotated[
        str, typer.Argument(metavar="SCENE|DATA.zarr", help="Mitsuba XML file, a shipped scene's name, or a data set.")
    ],
    noise: Annotated[str, typer.Option(help="none, low, high, m,s,g (fractions of the maximum) or a YAML file.")] = "high",
    start: Annotated[str | None, typer.Option("--from", help=f"Pose: {SIX}.")] = None,
    end: Annotated[str | None, typer.Option("--to", help="Last pose: --poses are spread from --from to it.")] = None,
    poses: Annotated[int | None, typer.Option(help="How many poses (default: 1; of a trajectory 20).")] = None,
    trajectory: Annotated[Path | None, typer.Option(help="Poses of a TUM or CSV file, or `shipped`.")] = None,
    frame: Frame = "mitsonar",
    sonar: Annotated[str | None, typer.Option(help="Preset (`mitsonar presets`) or YAML file.")] = None,
    model: Annotated[str | None, typer.Option(help="physical or thesis.")] = None,
    segments: Annotated[str | None, typer.Option(help="Portions of a looking-down sonar's view: q1,q2,q3,q4.")] = None,
    height: Annotated[float | None, typer.Option(help="Height over the ground [m]; the window follows the floor.")] = None,
    pairs: Annotated[int, typer.Option(help="Of a data set: how many pairs, each of a sequence of its own.")] = 20,
    part: Annotated[
        str | None, typer.Option(help="Of a data set: train, validation, test (default where it is), all.")
    ] = None,
    vary: Annotated[
        str | None, typer.Option(help="NAME=V1,V2,...: height_m, pitch_deg, azimuth_fov_deg, beams, window=3.2..5.6 ...")
    ] = None,
    gain: Annotated[float | None, typer.Option(help="Constant gain (default: the data set's, or from the frames).")] = None,
    pings: Annotated[int | None, typer.Option(help="Of each half of the derivatives (default: as needed).")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the rays.")] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG: the bound against the variable, or pose by pose.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
    parameter: Annotated[list[str] | None, typer.Option("-D", help="NAME=VALUE for the scene's $NAME.")] = None,
) -> None:
    """The Cramer-Rao bound of sideways, forward and yaw between two pings, by an exact renderer of the scene.

    One frame: against an oracle that knows scene and pose. Two frames: both noisy, relief known. Laws: `pixel`, the exact
    one of clipped, rounded pixels; `gaussian`, of the same mean and variance; `rays`, with the noise of a ping's own rays.
    With --vary the gain is set anew for each value, and where height, pitch or a field of view change both ends of the
    window follow the nearest and farthest range of the floor, with as many bins.
    """
    from mitsonar.acoustics.noise import load_noise
    from mitsonar.motion.conventions import convention_named

    added, name, values = load_noise(noise), *_variable(vary)
    if height is not None and not height > 0:
        raise MitsonarError(f"--height must be above 0: got {height:g} m")
    flown = {"start": start, "end": end, "count": poses, "file": trajectory}
    convention_named(frame)
    if Path(source).suffix == ".zarr" or "://" in source:
        scene_only = {**flown, "--sonar": sonar, "--model": model, "--segments": segments, "-D": parameter}
        if any(value is not None for value in scene_only.values()):
            raise MitsonarError(f"{source} is a data set, which says sonar, poses and segments itself: give none of them")
        subject = _of_data(source, pairs, part, gain, seed)
    else:
        subject = _of_scene(
            source, sonar, model, seed, segments, gain, scene_parameters(parameter or []), {**flown, "frame": frame}
        )
    if name is not None and gain is None:
        subject = Subject(subject.sonar, subject.views, subject.places, subject.poses, None)
    rows: list[tuple[Value | None, Table]] = []
    with progress_bar("differentiating", subject.poses * max(1, len(values)), "poses") as progress:
        asked: list[Value | None] = [*values] or [None]
        for value in asked:
            changes = [(key, v) for key, v in (("height_m", height), (name, value)) if v is not None and key is not None]
            rows.append((value, _table(subject, added, changes, pings, progress)))
    report = _report(source, noise, name, rows)
    if plot is not None:
        _save_plot(plot, report)
    if as_json:
        say(json.dumps(report, indent=1))
        return
    for line in _lines(report):
        say(line)
    if added.scale == 0:
        warn(
            "echoes without noise tell the motion without limit (law `pixel`: -); `gaussian` counts rounding to grey values "
            "as variance 1 / (12 255^2), `rays` also the noise of a ping's own rays"
        )
    if any(row["not_observable"] for row in report["rows"]):
        warn("inf: an axis cannot be observed, or so little that noise of the rays hides it: raise --pings to know")
    if plot is not None:
        say(f"picture: {plot}")


Table = dict[tuple[str, str, str], "list[Bound | None]"]
"""(portion, kind, law) -> a bound for each pose."""


def _variable(text: str | None) -> tuple[str | None, list[Value]]:
    """NAME=V1,V2,..."""
    from mitsonar.errors import nearest_names
    from mitsonar.estimation.crlb.image_crlb import VARIABLES

    if text is None:
        return None, []
    name, _, rest = text.partition("=")
    if name not in VARIABLES:
        raise MitsonarError(f"--vary takes NAME=V1,V2,...: got {text!r}; {nearest_names(name, VARIABLES)}")
    try:
        values: list[Value] = []
        for word in rest.split(","):
            ends = [float(number) for number in word.split("..")]
            if len(ends) != (2 if name == "window" else 1):
                raise ValueError
            values.append((ends[0], ends[1]) if name == "window" else ends[0])
    except ValueError:
        example = "3.2..5.6,3..6" if name == "window" else "1,2.5,4"
        raise MitsonarError(f"--vary {name} takes numbers as {example}: got {rest!r}") from None
    return name, values


def _of_scene(
    source: str,
    sonar: str | None,
    model: str | None,
    seed: int | None,
    segments: str | None,
    gain: float | None,
    parameters: dict[str, str],
    flown: dict[str, Any],
) -> Subject:
    """Poses in one scene."""
    from mitsonar.simulation.imaging import Simulator
    from mitsonar.simulation.scene import load_scene

    loaded = load_scene(source, **parameters)
    instrument, attitude = _instrument(loaded, sonar, model, seed)
    count = flown["count"] or (20 if flown["file"] else None)
    path = _path(instrument, attitude, source, count, flown["start"], flown["end"], flown["file"], flown["frame"])
    heights = np.concatenate([batch.height_m for batch in Simulator(loaded, instrument).pings(path.poses)])
    if not np.isfinite(heights).all():
        raise MitsonarError("nothing is below the sonar at some pose: give a pose over the scene with --from")
    names = segments.split(",") if segments else []
    place = Place(loaded, path.poses, heights)
    return Subject(instrument, lambda other: _views(other, names), lambda: iter([place]), len(heights), gain)


def _of_data(source: str, pairs: int, part: str | None, gain: float | None, seed: int | None) -> Subject:
    """First poses of pairs, scene by scene."""
    from mitsonar.datasets.scene_rendering import SceneRenderer
    from mitsonar.datasets.split import deal, world_of
    from mitsonar.datasets.store import DataStore
    from mitsonar.simulation.variant import release_memory

    if pairs < 1:
        raise MitsonarError(f"--pairs must be at least 1: got {pairs}")
    store = DataStore.open(source)
    recipe = store.recipe
    scene, sequence, pose, height = (store.read(name) for name in ("scene", "sequence", "pose", "height_m"))
    part = part or recipe.split.unseen
    mine = np.flatnonzero(deal(world_of(recipe, store.scenes)[scene], sequence, recipe.split, part) & np.isfinite(height))
    first = mine[np.unique(sequence[mine], return_index=True)[1]]
    if not len(first):
        raise MitsonarError(f"{source} has no frame over ground in part {part!r}: give --part all")
    chosen = first[np.unique(np.linspace(0, len(first) - 1, min(pairs, len(first))).round().astype(int))]

    def places() -> Iterator[Place]:
        for number in np.unique(scene[chosen]):
            here = chosen[scene[chosen] == number]
            renderer = SceneRenderer(recipe, store.scenes[int(number)])
            yield Place(renderer.simulator.tracer.scene, pose[here], height[here])
            del renderer
            release_memory()

    def views(other: Sonar) -> list[View]:
        if recipe.receivers and other != own:
            raise MitsonarError("--vary and --height need one sonar that sends and hears: this data set has receivers")
        return recipe.views if recipe.receivers else _views(other, recipe.segments)

    own = recipe.instrument if seed is None else recipe.instrument.replace(seed=seed)
    return Subject(own, views, places, len(chosen), float(store.about["gain"]) if gain is None else gain)


def _views(sonar: Sonar, segments: list[str]) -> list[View]:
    from mitsonar.instruments.views import Segment, Whole

    return [Segment(sonar, name) for name in segments] or [Whole(sonar)]


def _table(
    subject: Subject,
    noise: NoiseModel,
    changes: list[tuple[str, Value]],
    pings: int | None,
    progress: Callable[[int], None],
) -> Table:
    """Bounds at all poses, with sonar and poses changed."""
    from mitsonar.estimation.crlb.image_crlb import bounds_at, varied
    from mitsonar.simulation.imaging import Simulator

    table: Table = {}
    gain = subject.gain
    for place in subject.places():
        sonar, poses, heights = subject.sonar, place.poses, place.heights
        for name, value in changes:
            sonar, poses = varied(sonar, poses, heights, name, value)
            heights = np.full_like(heights, value) if name == "height_m" else heights
        simulator = Simulator(place.scene, sonar, views=subject.views(sonar))
        gain = gain if gain is not None else _gain(simulator, poses)
        for bounds in bounds_at(simulator, poses, noise, gain, pings=pings):
            for key, found in bounds.items():
                table.setdefault(key, []).append(found)
            progress(1)
    return table


def _gain(simulator: Any, poses: NDArray[np.float64]) -> float:
    """The constant gain of all views of the first frames, as that of a run."""
    from mitsonar.simulation.imaging import CALIBRATION_FRAMES, Pings, constant_gain

    batches = []
    for looks in simulator.render_views(poses[:CALIBRATION_FRAMES]):
        flat = np.concatenate([pings.levels.reshape(len(pings), -1) for pings in looks], axis=1)
        batches.append(Pings(looks[0].first, flat[:, :, None], looks[0].counts, looks[0].height_m))
    if not any(pings.levels.any() for pings in batches):
        raise MitsonarError("no ray met anything within the window: check the pose (pitch > 0 looks down) and the window")
    return constant_gain(batches)[0]


def _report(source: str, noise: str, name: str | None, rows: list[tuple[Value | None, Table]]) -> dict[str, Any]:
    """As JSON can hold it: numbers in mm and deg, null where there is no bound or the motion is not observable."""
    from mitsonar.estimation.crlb.image_crlb import LAWS, overall

    found = []
    for value, table in rows:
        for (portion, kind, law), bounds in table.items():
            row: dict[str, Any] = {} if name is None else {name: value}
            row |= {"portion": portion, "data": kind, "law": law, "poses": len(bounds)}
            known = [one for one in bounds if one is not None]
            for frames, words in ((1, "one_frame"), (2, "two_frames")):
                each = np.array([one.std(frames) * UNITS for one in known])
                row[words] = _numbers(overall(each)) if len(known) == len(bounds) else None
                row[f"{words}_each"] = [_numbers(std) for std in each]
            row["not_observable"] = sum(not np.isfinite(one.std()).all() for one in known)
            row["relative_error"] = _numbers(np.mean([one.relative_error for one in known], axis=0)) if known else None
            found.append(row)
    return {
        "source": source,
        "noise": noise,
        "vary": name,
        "units": ["sideways mm", "forward mm", "yaw deg"],
        "laws": LAWS,
        "rows": found,
    }


def _numbers(values: NDArray[np.float64]) -> list[float | None]:
    return [float(f"{v:.6g}") if np.isfinite(v) else None for v in values]


def _lines(report: dict[str, Any]) -> list[str]:
    """The table: least standard deviations."""
    name = report["vary"]
    titles = [name] if name else []
    titles += ["portion", "data", "law", "one frame: mm / mm / deg", "two frames: mm / mm / deg", "poses"]
    cells = [titles]
    for row in report["rows"]:
        value = row.get(name)
        text = "..".join(f"{v:g}" for v in value) if isinstance(value, tuple) else f"{value:g}" if name else ""
        two = [_text(row[words]) for words in ("one_frame", "two_frames")]
        lost = f", {row['not_observable']} not observable" if row["not_observable"] else ""
        cells.append([*([text] if name else []), row["portion"], row["data"], row["law"], *two, f"{row['poses']}{lost}"])
    widths = [max(len(line[k]) for line in cells) for k in range(len(titles))]
    lines = ["  ".join(word.ljust(width) for word, width in zip(line, widths, strict=True)).rstrip() for line in cells]
    head = f"noise {report['noise']}: least standard deviation, sideways / forward / yaw (root of the mean variance)"
    return [head, *lines]


def _text(std: list[float | None] | None) -> str:
    if std is None:
        return "-"
    return " / ".join("inf" if v is None else f"{v:.{d}f}" for v, d in zip(std, (3, 3, 4), strict=True))


def _save_plot(path: Path, report: dict[str, Any]) -> None:
    """Two-frame bounds against the variable, or pose by pose."""
    import io

    from matplotlib.figure import Figure

    from mitsonar.io.whole_files import write_whole

    name = report["vary"]
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    panels = figure.subplots(1, 3)
    series: dict[str, list[tuple[Any, list[float | None]]]] = {}
    for row in report["rows"]:
        label = " ".join([row["portion"], row["data"], row["law"]])
        if name is None:
            series[label] = list(enumerate(row["two_frames_each"]))
        elif row["two_frames"] is not None:
            x = "..".join(f"{v:g}" for v in row[name]) if name == "window" else row[name]
            series.setdefault(label, []).append((x, row["two_frames"]))
    for axis, (panel, unit) in enumerate(zip(panels, report["units"], strict=True)):
        for label, points in series.items():
            known = [(x, std[axis]) for x, std in points if std[axis] is not None]
            panel.plot([x for x, _ in known], [y for _, y in known], "o-" if name else ".", label=label, markersize=4)
        panel.set(xlabel=name or "pose", ylabel=unit, yscale="log")
        panel.grid(alpha=0.3, which="both")
    panels[0].legend(fontsize=7)
    figure.suptitle(f"least standard deviation of two frames, noise {report['noise']}", fontsize=10)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    write_whole(path, buffer.getvalue())
