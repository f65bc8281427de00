"""``mitsonar impulse``: simulate complex channel impulse responses of a scene."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from mitsonar.cli.console import answered, numbers, progress_bar, say, warn
from mitsonar.cli.flown_path import SIX, Frame, poses_line
from mitsonar.cli.render_command import scene_parameters
from mitsonar.errors import MitsonarError, counted, meant

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mitsonar.instruments.hydrophones import ChannelSonar
    from mitsonar.motion.pose import Pose
    from mitsonar.motion.trajectory import Trajectory

__all__ = ["impulse"]


@answered
def impulse(
    scene: Annotated[str, typer.Argument(help="Mitsuba XML file, or the name of a shipped scene (`mitsonar scenes`).")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder to make (default: out/SCENE-impulse).")] = None,
    velocity: Annotated[
        str | None,
        typer.Option(
            help="Velocity vx,vy to starboard and forward [m/s], or vx,vy,turn with the turn to starboard [deg/s]."
        ),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(help="Number of pings (default: 1); with --trajectory evenly spaced in time over all of it."),
    ] = None,
    start: Annotated[str | None, typer.Option("--from", help=f"First pose: {SIX}.")] = None,
    trajectory: Annotated[
        str | None,
        typer.Option(help="Poses of the vehicle: a TUM or CSV file, or a course (square, stairs, zigzag, circle ...)."),
    ] = None,
    frame: Frame = "mitsonar",
    model: Annotated[
        str | None,
        typer.Option(help="scatterers (fixed in the world) or rays (fixed to the vehicle, as in Almanza-Medina)."),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the places and amplitudes of scatterers without cells.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Change a key of the instrument, KEY=VALUE: carrier_hz=160e3.")
    ] = None,
    parameter: Annotated[list[str] | None, typer.Option("-D", help="NAME=VALUE for the scene's $NAME.")] = None,
    mirrors: Annotated[
        bool,
        typer.Option("--mirrors", help="Paths by way of smooth materials; see docs/guides/impulse-responses.md."),
    ] = False,
    mirror: Annotated[
        list[str] | None,
        typer.Option("--mirror", help="NAME=V,H: reflection of pressures and rms height [m] of a shape: surface=-1,0.002."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing run.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Resume a stopped run.")] = False,
) -> None:
    """Simulate channels, and write responses.npz, responses.zarr, response.png and waterfall.png into the folder OUT."""
    from mitsonar.io.runs import file_digest
    from mitsonar.simulation.channel import ChannelSimulator
    from mitsonar.simulation.runs import iteration_error, run_impulse
    from mitsonar.simulation.scene import channel_sonar_in, find_scene, load_scene

    parameters = scene_parameters(parameter or [])
    loaded = load_scene(scene, **parameters)
    sonar, attitude = _instrument(channel_sonar_in(loaded), model, seed, set_ or [])
    flown, speeds = _path(sonar, attitude, velocity, frames, start, trajectory, frame)
    folder = out or Path("out") / f"{find_scene(scene).stem}-impulse"
    origin: dict[str, Any] = {"scene": str(scene), "scene_sha256": file_digest(find_scene(scene)), "parameters": parameters}
    parts = _mirrors(mirrors, mirror or [])
    origin |= {"mirrors": True if parts == "materials" else parts} if parts else {}
    simulator = ChannelSimulator(loaded, sonar, mirrors=parts)
    with progress_bar("measuring", len(flown), "pings") as progress:
        report = run_impulse(
            simulator, flown, speeds, folder, origin=origin, overwrite=overwrite, resume=resume, progress=progress
        )
    for sentence in report.warnings:
        warn(sentence)
    names = ", ".join(receiver.name for receiver in sonar.receivers)
    say(
        f"{counted(report.pings, 'ping')} ({sonar.model} model, {sonar.title}: {names}) of "
        f"{counted(sonar.taps, 'tap')} in {folder}"
    )
    say(poses_line(flown, {}))
    spread = report.spread
    say(
        f"spread factor {spread.factor:.3g}: delays over {1e3 * spread.delay_s:.3g} ms, Doppler shifts over "
        f"{spread.doppler_hz:.3g} Hz"
    )
    still, twice = iteration_error(flown, speeds, sonar)
    if still > 0:
        say(
            f"motion during the travel of sound changes the phase by up to {still:.3g} turns at {sonar.range_max:g} m, "
            f"which is counted exactly (two iterations, as in Almanza-Medina, would leave {twice:.2g})"
        )
    say(f"figures: {folder / 'response.png'}, {folder / 'waterfall.png'}")


def _instrument(
    found: tuple[ChannelSonar, Pose] | None, model: str | None, seed: int | None, changes: list[str]
) -> tuple[ChannelSonar, Pose | None]:
    """Return the instrument with its changes, and its pose in the scene; by default the instrument of Almanza-Medina."""
    from mitsonar.instruments.hydrophones import ChannelSonar

    sonar, attitude = found if found is not None else (ChannelSonar(name="thesis"), None)
    fields: dict[str, Any] = {}
    for pair in changes:
        key, equals, value = pair.partition("=")
        if not equals:
            raise MitsonarError(f"--set takes KEY=VALUE: got {pair!r}")
        if key == "transmitter":
            raise MitsonarError(f"fields of view are set in the scene, or in Python, not by --set: got {pair!r}")
        fields[key] = _receivers(sonar, value) if key == "receivers" else value
    fields |= {} if model is None else {"model": model}
    fields |= {} if seed is None else {"seed": seed}
    return sonar.replace(**fields), attitude


def _mirrors(materials: bool, given: list[str]) -> dict[str, tuple[float, float]] | Literal["materials"] | None:
    """Return the mirrors that --mirrors or --mirror say; None where they say nothing."""
    if not given:
        return "materials" if materials else None
    if materials:
        raise MitsonarError("--mirrors takes the mirrors of all materials, --mirror those of named shapes: give one of both")
    parts: dict[str, tuple[float, float]] = {}
    for one in given:
        name, _, values = one.rpartition("=")
        part = numbers(values, 2, "--mirror NAME=V,H")
        if not name or part is None:
            raise MitsonarError(f"--mirror takes NAME=V,H, reflection and rms height [m] of a shape: got {one!r}")
        parts[name] = (part[0], part[1])
    return parts


def _receivers(sonar: ChannelSonar, names: str) -> list[dict[str, object]]:
    """Return the named receivers of an instrument."""
    known = {one.name: one for one in sonar.receivers}
    wanted = [name.strip() for name in names.split(",")]
    for name in wanted:
        if name not in known:
            raise MitsonarError(
                f"--set receivers=NAME,NAME chooses of the receivers {', '.join(known)}: got {name!r}{meant(name, known)}; "
                "others are described in the scene's channel_sonar"
            )
    return [known[name].model_dump() for name in wanted]


def _path(
    sonar: ChannelSonar,
    attitude: Pose | None,
    velocity: str | None,
    frames: int | None,
    start: str | None,
    path: str | None,
    frame: str,
) -> tuple[Trajectory, NDArray[np.float64]]:
    """Return the poses and velocities that the options define."""
    import numpy as np

    from mitsonar.motion.composition import steady
    from mitsonar.motion.courses import COURSES, course
    from mitsonar.motion.pose import Pose
    from mitsonar.motion.trajectory import Trajectory, convention_named, velocities

    convention_named(frame)
    if frames is not None and frames < 1:
        raise MitsonarError(f"--frames must be at least 1: got {frames}")
    first = numbers(start, 6, "--from")
    begin = Pose.from_degrees(first) if first else attitude
    if path is not None:
        if velocity or (start and path not in COURSES):
            raise MitsonarError(
                "--trajectory and --velocity contradict each other, and --from is only the middle of a course: give one"
            )
        named = path in COURSES or not Path(path).suffix
        flown = course(path, begin or Pose(0.0, 0.0, 10.0)) if named else Trajectory.load(path, frame, looks_ahead=False)
        speeds = velocities(flown)
        if frames is not None:  # velocities are of the full trajectory
            few = flown.resample(frames)
            speeds = np.stack([np.interp(few.time_s, flown.time_s, column) for column in speeds.T], axis=1)
            flown = few
        return flown, speeds
    if begin is None:
        raise MitsonarError(
            f"the scene has no channel_sonar that gives a pose: add one, or give a pose with --from ({SIX}), or --trajectory"
        )
    if velocity is not None and velocity.count(",") not in (1, 2):
        raise MitsonarError(f"--velocity takes vx,vy or vx,vy,turn (m/s, m/s, deg/s): got {velocity!r}")
    count = 2 if velocity is None else velocity.count(",") + 1
    speed = [*(numbers(velocity, count, "--velocity (m/s, m/s, deg/s)") or [0.0, 0.0]), 0.0][:3]
    if velocity is None and (frames or 1) > 1:
        warn("the vehicle stands still, and all pings are alike: give --velocity vx,vy in m/s, or --trajectory")
    return steady(begin, (speed[0], speed[1], math.radians(speed[2])), frames or 1, sonar.frame_rate_hz)
