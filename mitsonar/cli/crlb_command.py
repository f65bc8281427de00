"""``mitsonar crlb``: how well a motion can be known at all, of a scene, sonar and noise, or of a data set."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitsonar.cli.console import answered, progress_bar, say, warn
from mitsonar.cli.render_command import SIX, Frame, _instrument, _path, scene_parameters
from mitsonar.errors import MitsonarError

if TYPE_CHECKING:
    from mitsonar.estimation.crlb.crlb_report import Table, Value
    from mitsonar.estimation.crlb.crlb_subject import Subject

__all__ = ["crlb"]


@answered
def crlb(
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
    from mitsonar.estimation.crlb.crlb_report import bounds_of_subject, report_lines, report_of
    from mitsonar.estimation.crlb.crlb_subject import subject_of_data
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
        subject = subject_of_data(source, pairs, part=part, gain=gain, seed=seed)
    else:
        subject = _of_scene(
            source, sonar, model, seed, segments, gain, scene_parameters(parameter or []), {**flown, "frame": frame}
        )
    if name is not None and gain is None:
        subject = replace(subject, gain=None)
    rows: list[tuple[Value | None, Table]] = []
    with progress_bar("differentiating", subject.poses * max(1, len(values)), "poses") as progress:
        asked: list[Value | None] = [*values] or [None]
        for value in asked:
            changes = [(key, v) for key, v in (("height_m", height), (name, value)) if v is not None and key is not None]
            rows.append((value, bounds_of_subject(subject, added, changes, pings, progress)))
    report = report_of(source, noise, name, rows)
    if plot is not None:
        from mitsonar.io.whole_files import write_whole
        from mitsonar.plotting.crlb_figure import crlb_png

        write_whole(plot, crlb_png(report))
    if as_json:
        say(json.dumps(report, indent=1))
        return
    for line in report_lines(report):
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
    """The poses in one scene that the options say."""
    from mitsonar.estimation.crlb.crlb_subject import subject_of_scene
    from mitsonar.simulation.scene import load_scene

    loaded = load_scene(source, **parameters)
    instrument, attitude = _instrument(loaded, sonar, model, seed)
    count = flown["count"] or (20 if flown["file"] else None)
    path = _path(instrument, attitude, source, count, flown["start"], flown["end"], flown["file"], flown["frame"])
    return subject_of_scene(loaded, instrument, path.poses, segments=segments.split(",") if segments else [], gain=gain)
