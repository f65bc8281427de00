"""Commands ``mitsonar render``, ``impulse``, ``sound`` and ``image``: simulate sonars in a scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from mitsonar.cli import options
from mitsonar.cli.console import answered, numbers, progress_bar, say, warn
from mitsonar.cli.run_config import Config, configuration_of, merged_pairs
from mitsonar.errors import MitsonarError, count_noun, did_you_mean

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mitsonar.instruments.hydrophones import ChannelSonar
    from mitsonar.motion.bodies import MovingBodies
    from mitsonar.motion.pose import Pose
    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.simulation.runs import Destination, RenderOptions
    from mitsonar.simulation.scene import MotionSpec
    from mitsonar.simulation.simulator import Simulator
    from mitsonar.simulation.vehicle import VehicleFile

__all__ = ["image", "impulse", "render", "sound"]


@answered
def render(
    ctx: typer.Context,
    scene: options.SceneName,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder to make (default: out/SCENE).")] = None,
    frames: Annotated[int | None, typer.Option(help=options.FRAMES)] = None,
    start: options.Start = None,
    end: options.End = None,
    speed: options.Speed = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(help="Poses of the sonar, or with --vehicle of the vehicle: a TUM or CSV file, or `shipped`."),
    ] = None,
    frame: options.Frame = "mitsonar",
    sonar: options.SonarName = None,
    model: Annotated[str | None, typer.Option(help="coherent (default of most presets), physical or thesis.")] = None,
    quality: Annotated[
        str | None, typer.Option(help="draft, standard or fine: number of rays by accuracy (`mitsonar presets`).")
    ] = None,
    set_: options.SonarKeys = None,
    noise: options.Noise = "none",
    labels: Annotated[
        bool, typer.Option("--labels", help="Write elevation, shape id, object id and shadow of each pixel.")
    ] = False,
    seed: Annotated[int | None, typer.Option(help="Seed of jitter and noise.")] = None,
    label_floor: Annotated[
        float, typer.Option(min=0, max=1, help="Label only pixels above this fraction of full scale, before noise.")
    ] = 0.0,
    fan: Annotated[
        bool, typer.Option("--fan", help="Write a plain fan picture of each frame to fan/; with --labels also of labels.")
    ] = False,
    cartesian: Annotated[bool, typer.Option("--cartesian", help="Draw each frame as a fan with axes in metres.")] = False,
    exr: Annotated[bool, typer.Option("--exr", help="Write the echo of every ray, one EXR file per frame.")] = False,
    mirrors: Annotated[
        bool,
        typer.Option(
            "--mirrors",
            help="Render glints (coherent) and mirrors (bounces) of smooth materials; see docs/guides/multipath.md.",
        ),
    ] = False,
    moving: options.Moving = None,
    all_sensors: Annotated[
        bool,
        typer.Option(
            "--all-sensors", help="Use all sonars and cameras of the scene, on one vehicle (docs/guides/bridges.md)."
        ),
    ] = False,
    vehicle: Annotated[
        Path | None, typer.Option(help="YAML file with the sensors of a vehicle; see docs/guides/bridges.md.")
    ] = None,
    rays_per_launch: options.RaysPerLaunch = 2**22,
    parameter: options.Parameters = None,
    config: Config = None,
    overwrite: options.Overwrite = False,
    resume: options.Resume = False,
) -> None:
    """Render sonar frames: frames.npz, images/, poses.tum, run.json and run.yaml in the folder OUT."""
    from mitsonar.acoustics.noise import load_noise, refuse_noise
    from mitsonar.acoustics.water import absorption_line
    from mitsonar.instruments.sonar import Sonar
    from mitsonar.motion.trajectory import convention_named
    from mitsonar.simulation.runs import Destination, RenderOptions, run
    from mitsonar.simulation.scene import channel_sonar_in, find_scene, sonar_in
    from mitsonar.simulation.simulator import Simulator

    if label_floor and not labels:
        raise MitsonarError(f"--label-floor {label_floor:g} needs --labels: without labels nothing is labelled")
    named = convention_named(frame).name
    outputs = RenderOptions(load_noise(noise), labels, cartesian, exr, named, fan, label_floor)
    loaded, origin = _load(scene, parameter)
    changes = options.sonar_changes(set_, quality, model, seed)
    folder = out or Path("out") / find_scene(scene).stem
    destination = Destination(folder, origin, overwrite, resume, configuration=configuration_of(ctx))
    if all_sensors or vehicle is not None:
        if mirrors:
            raise MitsonarError("--mirrors applies to a single sonar: leave it out, or render the sonars one by one")
        file = _vehicle_file(vehicle, all_sensors, sonar)
        scene_sonar = (sonar_in(loaded) or channel_sonar_in(loaded)) if file is None else None
        path = options.path_for(Sonar(), scene_sonar and scene_sonar[1], scene, frames, start, end, trajectory, frame, speed)
        options.warn_of_speed(path, end, speed)
        motions = _motions(loaded, moving, named, [] if file is None else file.motion_specs)
        return _render_vehicle(loaded, file, path, changes, motions, outputs, destination)
    instrument, attitude = options.instrument_for(loaded, sonar, changes)
    refuse_noise(outputs.noise, instrument)
    path = options.path_for(instrument, attitude, scene, frames, start, end, trajectory, frame, speed)
    options.warn_of_speed(path, end, speed)
    if mirrors and instrument.model != "coherent" and instrument.bounces == 1:
        raise MitsonarError(
            f"--mirrors needs the model coherent, or --set bounces=2: got {instrument.model}; leave it out, or give one"
        )
    bodies, moved = moving_bodies(loaded, moving, named, path)
    simulator = Simulator(
        loaded, instrument, mirrors="materials" if mirrors else None, moving=bodies, rays_per_launch=rays_per_launch
    )
    _check_above_ground(loaded, path, simulator.motion is not None, simulator)
    origin |= ({"mirrors": True} if mirrors else {}) | moved
    origin["path"] = {"frames": frames, "from": start, "to": end, "trajectory": trajectory and str(trajectory)}
    origin["path"] |= {} if speed is None else {"speed": speed}
    with progress_bar("rendering", len(path), "pings") as progress:
        report = run(simulator, path, outputs, replace(destination, origin=origin, progress=progress))
    for sentence in report.warnings:
        warn(sentence)
    say(f"{count_noun(report.frames, 'frame')} ({instrument.model} model, {instrument.title}) in {folder}")
    say(options.poses_line(path))
    if line := absorption_line(instrument):
        say(line)
    if report.pictures:
        say(f"pictures: {report.pictures[0]}" + (f" ... {report.pictures[-1].name}" if len(report.pictures) > 1 else ""))


def _load(scene: str, parameter: list[str] | None) -> tuple[Any, dict[str, Any]]:
    """Load a scene; return it and what identifies it in ``run.json``: name, digest of the file, parameters."""
    from mitsonar.io.runs import file_digest
    from mitsonar.simulation.scene import find_scene, load_scene

    parameters = options.scene_parameters(parameter or [])
    loaded = load_scene(scene, **parameters)
    return loaded, {"scene": scene, "scene_sha256": file_digest(find_scene(scene)), "parameters": parameters}


def _check_above_ground(scene: Any, path: Trajectory, moving: bool, simulator: Simulator | None = None) -> None:
    """Reject a path below the ground or inside an object if the sonar sees nothing from there; warn if it sees something.

    Args:
        scene: the Mitsuba scene.
        path: trajectory of the sonar or vehicle.
        moving: whether bodies move; such scenes are not checked.
        simulator: simulator of the sonar, to find whether it sees anything; None: only warn.
    """
    from mitsonar.simulation.tracing import buried_in

    buried = None if moving else buried_in(scene, path.poses)
    if buried is None:
        return
    more = "" if buried.frames == 1 else f", the first of {buried.frames:,} such poses,"
    frames = f"pose {buried.frame}{more}"
    if simulator is not None:
        echoes, sonar = simulator.film_echoes(path.poses[buried.frame], buried.frame), simulator.sonar
        if not ((echoes.hit > 0) & (echoes.far_m >= sonar.range_min) & (echoes.near_m < sonar.range_max)).any():
            raise MitsonarError(f"{frames} {buried.text}, and sees nothing from there: correct --from, --to or --trajectory")
    if not buried.inside:  # a tank is an object, too
        warn(f"{frames} {buried.text}: its frames show the ground from below")


def _motions(scene: Any, moving: list[str] | None, frame: str, also: Sequence[MotionSpec] = ()) -> list[MotionSpec]:
    """Return the motions of bodies: from --moving, else from the file of the vehicle, else from the scene."""
    from mitsonar.motion.bodies import BodyMotion
    from mitsonar.simulation.scene import MotionSpec, motion_specs_in, motion_specs_of

    given: list[MotionSpec] = []
    for option in moving or []:
        name, _, file = option.partition("=")
        if option.lower().endswith((".yaml", ".yml")) and not file:
            given += motion_specs_in(option)
        elif name and file:
            given.append(MotionSpec(name, BodyMotion(path=file, frame=frame), [Path()]))
        else:
            raise MitsonarError(f"--moving takes ID=FILE.tum, ID=vehicle or FILE.yaml: got {option!r}")
    for weaker in (also, motion_specs_of(scene)):
        named = {one.name for one in given}
        given += [one for one in weaker if one.name not in named]
    return given


def moving_bodies(scene: Any, moving: list[str] | None, frame: str, path: Trajectory) -> tuple[MovingBodies, dict[str, Any]]:
    """Return the bodies that move along a vehicle's path, and their digests for the settings of a run, if there are any."""
    from mitsonar.motion.bodies import MovingBodies
    from mitsonar.simulation.scene import digests_of, read_motion_specs

    motions = _motions(scene, moving, frame)
    return MovingBodies.of(read_motion_specs(motions), frame, path), {"moving": digests_of(motions)} if motions else {}


# ---------------- ``mitsonar render --all-sensors`` and ``--vehicle``: all sensors of a vehicle in one run


def _vehicle_file(file: Path | None, all_sensors: bool, sonar: str | None) -> VehicleFile | None:
    """Return the content of the file of --vehicle; None for the sensors of the scene."""
    from mitsonar.simulation.vehicle import load_vehicle

    if file is not None and all_sensors:
        raise MitsonarError("--vehicle and --all-sensors contradict each other: give one")
    if sonar is not None:
        raise MitsonarError("--sonar names one sonar: leave it out with --all-sensors and --vehicle")
    return None if file is None else load_vehicle(file)


def _render_vehicle(
    scene: Any,
    vehicle: VehicleFile | None,
    path: Trajectory,
    changes: dict[str, Any],
    motions: list[MotionSpec],
    outputs: RenderOptions,
    destination: Destination,
) -> None:
    """Run all sensors of a vehicle along a path, and print where their folders are."""
    from mitsonar.instruments.sonar import Sonar
    from mitsonar.instruments.sounder import Sounder
    from mitsonar.motion.pose import Pose
    from mitsonar.simulation.instrument_runs import run_vehicle
    from mitsonar.simulation.scene import digests_of, read_motion_specs
    from mitsonar.simulation.vehicle import Mounted, VehicleSimulator, sensors_in

    sensors = sensors_in(scene, Pose.from_row(path.poses[0])) if vehicle is None else vehicle.sensors
    changed = {}
    for name, one in sensors.items():
        instrument: Any = one.instrument
        if changes and isinstance(instrument, Sonar | Sounder):
            instrument = instrument.replace(**changes)
        changed[name] = Mounted(instrument, one.mount)
    origin = {**destination.origin, **({"moving": digests_of(motions)} if motions else {})}
    simulator = VehicleSimulator(scene, changed, moving=read_motion_specs(motions))
    with progress_bar("rendering", len(path) * len(changed), "pings") as progress:
        report = run_vehicle(simulator, path, outputs, replace(destination, origin=origin, progress=progress))
    for sentence in report.warnings:
        warn(sentence)
    say(options.poses_line(path, {name: one.mount for name, one in changed.items()}))
    say(
        f"{count_noun(len(path), 'pose')}, "
        f"{count_noun(len(report.sensors), 'sensor')} ({', '.join(report.sensors)}) in {destination.folder}, a folder each"
    )


# ---------------- ``mitsonar impulse``: simulate complex channel impulse responses of a scene


@answered
def impulse(
    ctx: typer.Context,
    scene: options.SceneName,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder to make (default: out/SCENE-impulse).")] = None,
    velocity: Annotated[
        str | None,
        typer.Option(
            help="Velocity vx,vy to starboard and forward [m/s], or vx,vy,turn with the turn to starboard [deg/s]."
        ),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(help="Number of pings (default: 1), with --trajectory evenly spaced in time."),
    ] = None,
    start: options.Start = None,
    trajectory: Annotated[
        str | None,
        typer.Option(help="Poses of the vehicle: a TUM or CSV file, or a course (square, stairs, zigzag, circle ...)."),
    ] = None,
    frame: options.Frame = "mitsonar",
    model: Annotated[
        str | None,
        typer.Option(help="scatterers (fixed in the world) or rays (fixed to the vehicle, as in Almanza-Medina)."),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the places and amplitudes of scatterers without cells.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", callback=merged_pairs, help="Change a key of the instrument, KEY=VALUE: carrier_hz=160e3."),
    ] = None,
    parameter: options.Parameters = None,
    mirrors: Annotated[
        bool,
        typer.Option("--mirrors", help="Add paths reflected by smooth materials; see docs/guides/impulse-responses.md."),
    ] = False,
    mirror: Annotated[
        list[str] | None,
        typer.Option(
            "--mirror", help="Reflection coefficient of pressure and rms height [m] of a shape, NAME=V,H: surface=-1,0.002."
        ),
    ] = None,
    moving: options.Moving = None,
    config: Config = None,
    overwrite: options.Overwrite = False,
    resume: options.Resume = False,
) -> None:
    """Simulate channels, and write responses.npz, responses.zarr, response.png and waterfall.png into the folder OUT."""
    from mitsonar.motion.trajectory import convention_named
    from mitsonar.simulation.channel import ChannelSimulator
    from mitsonar.simulation.instrument_runs import iteration_error, run_impulse
    from mitsonar.simulation.runs import Destination
    from mitsonar.simulation.scene import channel_sonar_in, find_scene

    loaded, origin = _load(scene, parameter)
    sonar, attitude = _channel_sonar(channel_sonar_in(loaded), model, seed, set_ or [])
    named = convention_named(frame).name
    flown, speeds = _channel_path(sonar, attitude, velocity, frames, start, trajectory, frame)
    bodies, moved = moving_bodies(loaded, moving, named, flown)
    if velocity is None and trajectory is None and len(flown) > 1 and not moved:
        warn("the vehicle does not move, so that all pings are equal: give --velocity vx,vy in m/s, or --trajectory")
    folder = out or Path("out") / f"{find_scene(scene).stem}-impulse"
    parts = _mirrors(mirrors, mirror or [])
    origin |= {"mirrors": True if parts == "materials" else parts} if parts else {}
    origin |= moved
    simulator = ChannelSimulator(loaded, sonar, mirrors=parts, moving=bodies)
    with progress_bar("measuring", len(flown), "pings") as progress:
        destination = Destination(folder, origin, overwrite, resume, progress, configuration_of(ctx))
        report = run_impulse(simulator, flown, speeds, destination)
    for sentence in report.warnings:
        warn(sentence)
    names = ", ".join(receiver.name for receiver in sonar.receivers)
    say(
        f"{count_noun(len(flown), 'ping')} ({sonar.model} model, {sonar.title}: {names}) of "
        f"{count_noun(sonar.taps, 'tap')} in {folder}"
    )
    say(options.poses_line(flown, {}))
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


def _channel_sonar(
    scene_sonar: tuple[ChannelSonar, Pose] | None, model: str | None, seed: int | None, changes: list[str]
) -> tuple[ChannelSonar, Pose | None]:
    """Return the instrument with its changes, and its pose in the scene; by default the instrument of Almanza-Medina."""
    from mitsonar.instruments.hydrophones import ChannelSonar

    sonar, attitude = scene_sonar if scene_sonar is not None else (ChannelSonar(name="thesis"), None)
    fields: dict[str, Any] = {}
    for pair in changes:
        key, equals, value = pair.partition("=")
        if not equals:
            raise MitsonarError(f"--set takes KEY=VALUE: got {pair!r}")
        if key == "transmitter":
            raise MitsonarError(f"fields of view are set in the scene or in Python, not with --set: got {pair!r}")
        fields[key] = _receivers(sonar, value) if key == "receivers" else value
    fields |= {} if model is None else {"model": model}
    fields |= {} if seed is None else {"seed": seed}
    return sonar.replace(**fields), attitude


def _mirrors(materials: bool, given: list[str]) -> dict[str, tuple[float, float]] | Literal["materials"] | None:
    """Return the mirrors of --mirrors or --mirror; None without either."""
    if not given:
        return "materials" if materials else None
    if materials:
        raise MitsonarError("--mirrors takes the mirrors of all materials, --mirror those of named shapes: give only one")
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
    chosen = [name.strip() for name in names.split(",")]
    for name in chosen:
        if name not in known:
            raise MitsonarError(
                f"--set receivers=NAME,NAME chooses among the receivers {', '.join(known)}: got "
                f"{name!r}{did_you_mean(name, known)}; describe others in the channel_sonar of the scene"
            )
    return [known[name].model_dump() for name in chosen]


def _channel_path(
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
            f"the scene has no channel_sonar that gives a pose: add one, or give a pose with --from ({options.SIX}), or "
            "--trajectory"
        )
    if velocity is not None and velocity.count(",") not in (1, 2):
        raise MitsonarError(f"--velocity takes vx,vy or vx,vy,turn (m/s, m/s, deg/s): got {velocity!r}")
    count = 2 if velocity is None else velocity.count(",") + 1
    speed = [*(numbers(velocity, count, "--velocity (m/s, m/s, deg/s)") or [0.0, 0.0]), 0.0][:3]
    return steady(begin, (speed[0], speed[1], math.radians(speed[2])), frames or 1, sonar.frame_rate_hz)


# ---------------- ``mitsonar sound``: side-scans, altimeters, profilers, DVLs and 3-D sonars along a path


@answered
def sound(
    ctx: typer.Context,
    scene: options.SceneName,
    instrument: Annotated[
        str,
        typer.Option(help="sidescan, altimeter, profiler, dvl, range-image, a preset (`mitsonar presets`) or a YAML file."),
    ],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder to make (default: out/INSTRUMENT).")] = None,
    frames: Annotated[int | None, typer.Option(help="Number of pings, with --trajectory evenly spaced in time.")] = None,
    start: Annotated[str | None, typer.Option("--from", help=f"First pose of the vehicle: {options.SIX}.")] = None,
    end: options.End = None,
    speed: options.Speed = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(help="Poses of the vehicle: a TUM or CSV file, or `shipped` (levelled)."),
    ] = None,
    frame: options.Frame = "mitsonar",
    model: Annotated[str | None, typer.Option(help="coherent (speckle and noise) or physical.")] = None,
    quality: Annotated[str | None, typer.Option(help="draft, standard or fine: number of rays by accuracy.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", callback=merged_pairs, help="Change a key of the instrument, KEY=VALUE: range_max=20."),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of jitter, speckle and noise.")] = None,
    moving: options.Moving = None,
    rays_per_launch: options.RaysPerLaunch = 2**22,
    parameter: options.Parameters = None,
    config: Config = None,
    overwrite: options.Overwrite = False,
    resume: options.Resume = False,
) -> None:
    """Simulate a side-scan, altimeter, profiler, DVL or 3-D sonar on a vehicle, and write its records into OUT."""
    from mitsonar.instruments.sounder import load_sounder
    from mitsonar.motion.pose import Pose
    from mitsonar.motion.trajectory import convention_named
    from mitsonar.simulation.instrument_runs import run_sounder
    from mitsonar.simulation.runs import Destination
    from mitsonar.simulation.sounding import SounderSimulator

    named = convention_named(frame).name
    changes = options.sonar_changes(set_, quality, model, seed)
    sounder = load_sounder(instrument)
    sounder = sounder.replace(**changes) if changes else sounder
    loaded, origin = _load(scene, parameter)
    flown = options.path_for(sounder.fan, None, scene, frames, start, end, trajectory, frame, speed)
    flown = options.under_vehicle(flown, sounder, trajectory)
    options.warn_of_speed(flown, end, speed)
    bodies, moved = moving_bodies(loaded, moving, named, flown)
    simulator = SounderSimulator(loaded, sounder, moving=bodies, rays_per_launch=rays_per_launch)
    _check_above_ground(loaded, flown, bool(moved))
    origin |= moved
    folder = out or Path("out") / sounder.name
    with progress_bar("sounding", len(flown), "pings") as progress:
        destination = Destination(folder, origin, overwrite, resume, progress, configuration_of(ctx))
        report = run_sounder(simulator, flown, destination, frame=named)
    for sentence in report.warnings:
        warn(sentence)
    say(f"{count_noun(len(flown), 'ping')} ({sounder.kind}, {sounder.name}, {sounder.fan.model} model) in {folder}")
    say(options.poses_line(flown, {name: Pose.from_degrees(mount) for name, mount in sounder.mounts.items()}))
    say(f"echoes in {report.found:,} of {count_noun(report.beams, 'beam')}; files: {', '.join(report.files)}")


# ---------------- ``mitsonar image``: bin stored echoes into new frames, without tracing


@answered
def image(
    ctx: typer.Context,
    run_folder: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of a run rendered with --exr.")],
    bins: Annotated[int | None, typer.Option(help="Number of range bins (default: as rendered).")] = None,
    window: Annotated[str | None, typer.Option("--range", help="Range window from,to [m] (default: as rendered).")] = None,
    noise: options.Noise = "none",
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder to make (default: OUT/rebinned).")] = None,
    cartesian: Annotated[bool, typer.Option("--cartesian", help="Draw each frame with axes in metres.")] = False,
    frame: options.Frame = "mitsonar",
    config: Config = None,
    overwrite: options.Overwrite = False,
    resume: options.Resume = False,
) -> None:
    """Bin the stored echoes of a run into new frames, with other bins, another window or other noise."""
    from mitsonar.acoustics.noise import load_noise
    from mitsonar.motion.trajectory import convention_named
    from mitsonar.simulation.runs import Destination, RenderOptions, StoredEchoes, run

    outputs = RenderOptions(load_noise(noise), cartesian=cartesian, frame=convention_named(frame).name)
    ends = numbers(window, 2, "--range")
    if ends and not 0 <= ends[0] < ends[1]:
        raise MitsonarError(f"--range takes from,to in m, the near end first: got {window}")
    source = StoredEchoes(run_folder, bins=bins, window=(ends[0], ends[1]) if ends else None)
    folder = out or run_folder / "rebinned"
    if run_folder.resolve().is_relative_to(folder.resolve()):
        raise MitsonarError(f"-o {folder} would replace the echoes that are read: choose another folder")
    origin = {"echoes_of": str(run_folder), "echoes_recipe": source.settings}
    with progress_bar("binning", len(source.trajectory), "pings") as progress:
        destination = Destination(folder, origin, overwrite, resume, progress, configuration_of(ctx))
        report = run(source, source.trajectory, outputs, destination)
    for sentence in report.warnings:
        warn(sentence)
    say(f"{count_noun(report.frames, 'frame')} of {count_noun(source.sonar.range_bins, 'bin')} in {folder}")
    if report.pictures:
        say(f"pictures: {report.pictures[0]}")
