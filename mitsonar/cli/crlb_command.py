"""``mitsonar crlb``: the Cramer-Rao lower bound of motions, for a scene, sonar and noise, or for a data set."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypedDict

import typer

from mitsonar.cli.console import answered, progress_bar, say, say_json, warn
from mitsonar.cli.flown_path import SIX, Frame, path_for
from mitsonar.cli.render_command import NOISE, instrument_for, scene_parameters
from mitsonar.errors import MitsonarError

if TYPE_CHECKING:
    from mitsonar.estimation.crlb.report import Subject, Table, Value

__all__ = ["crlb"]


class _PosesAsked(TypedDict):
    """Options that define the poses in a scene."""

    start: str | None
    end: str | None
    count: int | None
    file: Path | None
    frame: str


@answered
def crlb(
    source: Annotated[
        str, typer.Argument(metavar="SCENE|DATA.zarr", help="Mitsuba XML file, a shipped scene's name, or a data set.")
    ],
    noise: Annotated[
        str | None, typer.Option(help=f"{NOISE} (default: high; the model coherent has noise of its own).")
    ] = None,
    start: Annotated[str | None, typer.Option("--from", help=f"Pose: {SIX}.")] = None,
    end: Annotated[
        str | None, typer.Option("--to", help="Last pose. The --poses are evenly spaced from --from to this one.")
    ] = None,
    poses: Annotated[int | None, typer.Option(help="Number of poses (default: 1; of a trajectory 20).")] = None,
    trajectory: Annotated[Path | None, typer.Option(help="Poses of a TUM or CSV file, or `shipped`.")] = None,
    frame: Frame = "mitsonar",
    sonar: Annotated[str | None, typer.Option(help="Preset (`mitsonar presets`) or YAML file.")] = None,
    model: Annotated[str | None, typer.Option(help="Model of the echo level: coherent, physical or thesis.")] = None,
    segments: Annotated[
        str | None, typer.Option(help="Portions of the view of a sonar that looks down: q1,q2,q3,q4.")
    ] = None,
    height: Annotated[
        float | None, typer.Option(help="Height over the ground [m]. The range window follows the floor.")
    ] = None,
    pairs: Annotated[int, typer.Option(help="Of a data set: number of pairs, one a sequence.")] = 20,
    part: Annotated[
        str | None, typer.Option(help="Of a data set: train, validation, test (default if the split has one) or all.")
    ] = None,
    vary: Annotated[
        str | None, typer.Option(help="NAME=V1,V2,...: height_m, pitch_deg, azimuth_fov_deg, beams, window=3.2..5.6 ...")
    ] = None,
    gain: Annotated[float | None, typer.Option(help="Constant gain (default: the data set's, or from the frames).")] = None,
    pings: Annotated[
        int | None, typer.Option(help="Pings in each half of the derivatives (default: as many as needed).")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the rays.")] = None,
    plot: Annotated[
        Path | None, typer.Option(help="PNG to write: the bound against the variable, or for each pose.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    parameter: Annotated[list[str] | None, typer.Option("-D", help="NAME=VALUE for the scene's $NAME.")] = None,
) -> None:
    """Compute the Cramer-Rao lower bound of sideways, forward and yaw between two pings, from derivatives of the renderer.

    One frame: scene and first pose are known. Two frames: both are noisy, and the relief is known. Distributions: `pixel`,
    the exact one of clipped, rounded pixels; `gaussian`, with the same mean and variance; `rays`, with the noise of the
    rays of a ping. In the model coherent: `grain`, scatterers known, in the receiver's noise; `ground`, expected level
    known, with speckle of its own in each frame.

    With --vary the gain is computed for each value. If height, pitch or a field of view varies, both ends of the range
    window follow the nearest and farthest range of the floor. The number of bins stays.
    """
    from mitsonar.acoustics.noise import load_noise, refuse_noise
    from mitsonar.estimation.crlb.report import bounds_of_subject, report_lines, report_of, subject_of_data
    from mitsonar.motion.trajectory import convention_named

    given, (name, values) = None if noise is None else load_noise(noise), _variable(vary)
    if height is not None and not height > 0:
        raise MitsonarError(f"--height must be above 0: got {height:g} m")
    asked_poses: _PosesAsked = {"start": start, "end": end, "count": poses, "file": trajectory, "frame": frame}
    convention_named(frame)
    if Path(source).suffix == ".zarr" or "://" in source:
        scene_only = (start, end, poses, trajectory, sonar, model, segments, parameter)
        if any(value is not None for value in scene_only):
            raise MitsonarError(f"{source} is a data set, which has its own sonar, poses and segments: give none of them")
        subject = subject_of_data(source, pairs, part=part, gain=gain, seed=seed)
    else:
        subject = _of_scene(source, sonar, model, seed, segments, gain, scene_parameters(parameter or []), asked_poses)
    refuse_noise(given, subject.sonar)
    speckle = subject.sonar.model == "coherent"
    noise = noise or ("none" if speckle else "high")
    added = given or load_noise(noise)
    if name is not None and gain is None:
        subject = replace(subject, gain=None)
    rows: list[tuple[Value | None, Table]] = []
    with progress_bar("differentiating", subject.poses * max(1, len(values)), "poses") as progress:
        asked: list[Value | None] = [*values] or [None]
        for value in asked:
            changes = [(key, v) for key, v in (("height_m", height), (name, value)) if v is not None and key is not None]
            rows.append((value, bounds_of_subject(subject, added, changes, pings, progress)))
    report = report_of(source, subject.sonar, "of the receiver" if speckle else noise, name, rows)
    if plot is not None:
        from mitsonar.io.files import write_whole
        from mitsonar.plotting.figures import crlb_png

        write_whole(plot, crlb_png(report))
    if as_json:
        say_json(report, indent=1)
        return
    for line in report_lines(report):
        say(line)
    if added.scale == 0 and not speckle:
        warn(
            "without noise the echoes determine the motion without limit (`pixel`: -); `gaussian` counts rounding as "
            "variance 1 / (12 255^2), `rays` adds the noise of the rays of a ping"
        )
    if any(row["not_observable"] for row in report["rows"]):
        warn("inf: an axis is not observable, or the noise of the rays hides it: raise --pings to distinguish the two")
    if plot is not None:
        say(f"picture: {plot}")


def _variable(text: str | None) -> tuple[str | None, list[Value]]:
    """Parse ``NAME=V1,V2,...``; of ``window`` the values are intervals."""
    from mitsonar.errors import nearest_names
    from mitsonar.estimation.crlb.image import VARIABLES

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
    poses: _PosesAsked,
) -> Subject:
    """Load a scene and the poses that the options define."""
    from mitsonar.estimation.crlb.report import subject_of_scene
    from mitsonar.simulation.scene import load_scene

    loaded = load_scene(source, **parameters)
    instrument, attitude = instrument_for(loaded, sonar, model, seed)
    count = poses["count"] or (20 if poses["file"] else None)
    path = path_for(instrument, attitude, source, count, poses["start"], poses["end"], poses["file"], poses["frame"])
    return subject_of_scene(loaded, instrument, path.poses, segments=segments.split(",") if segments else [], gain=gain)
