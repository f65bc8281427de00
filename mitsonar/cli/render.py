"""Commands ``mitsonar render``, ``impulse``, ``sound`` and ``image``: simulate sonars in a scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from mitsonar.cli.console import answered, numbers, progress_bar, say, warn
from mitsonar.cli.paths import FRAMES, SIX, SPEED, Frame, path_for, poses_line, under_vehicle, warn_of_speed
from mitsonar.errors import MitsonarError, counted, meant

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mitsonar.instruments.hydrophones import ChannelSonar
    from mitsonar.instruments.sonar import Sonar
    from mitsonar.motion.pose import Pose
    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.simulation.runs import Outputs
    from mitsonar.simulation.scene import Said
    from mitsonar.simulation.simulator import Simulator
    from mitsonar.simulation.vehicle import VehicleFile

__all__ = [
    "NOISE",
    "VehicleOptions",
    "check_above_ground",
    "first_pose",
    "image",
    "impulse",
    "instrument_for",
    "moving_said",
    "render",
    "render_vehicle",
    "scene_parameters",
    "sonar_changes",
    "sound",
    "vehicle_file",
]


NOISE = (
    "Almanza-Medina's noise: none, low, high, m,s,g (fractions of the maximum) or a YAML file; not realistic, since it "
    "reveals empty pixels"
)


@answered
def render(
    scene: Annotated[str, typer.Argument(help="Mitsuba XML file, or the name of a shipped scene (`mitsonar scenes`).")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder to make (default: out/SCENE).")] = None,
    frames: Annotated[int | None, typer.Option(help=FRAMES)] = None,
    start: Annotated[str | None, typer.Option("--from", help=f"First pose: {SIX}.")] = None,
    end: Annotated[str | None, typer.Option("--to", help=f"Last pose: {SIX}.")] = None,
    speed: Annotated[float | None, typer.Option(help=SPEED)] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(help="Poses of the sonar, or with --vehicle of the vehicle: a TUM or CSV file, or `shipped`."),
    ] = None,
    frame: Frame = "mitsonar",
    sonar: Annotated[str | None, typer.Option(help="Preset (`mitsonar presets`) or YAML file.")] = None,
    model: Annotated[str | None, typer.Option(help="coherent (default of most presets), physical or thesis.")] = None,
    quality: Annotated[
        str | None, typer.Option(help="draft, standard or fine: number of rays by accuracy (`mitsonar presets`).")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Change a key of the sonar, KEY=VALUE: range_max=8.")
    ] = None,
    noise: Annotated[str, typer.Option(help=f"{NOISE}.")] = "none",
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
    moving: Annotated[
        list[str] | None,
        typer.Option("--moving", help="ID=FILE.tum: move the shape ID along a path; or FILE.yaml (docs/guides/moving.md)."),
    ] = None,
    all_sensors: Annotated[
        bool,
        typer.Option(
            "--all-sensors", help="Use all sonars and cameras of the scene, on one vehicle (docs/guides/bridges.md)."
        ),
    ] = False,
    vehicle: Annotated[
        Path | None, typer.Option(help="YAML file with the sensors of a vehicle; see docs/guides/bridges.md.")
    ] = None,
    rays_per_launch: Annotated[int, typer.Option(help="Rays traced at once, about 30 bytes each: limits memory.")] = 2**22,
    parameter: Annotated[list[str] | None, typer.Option("-D", help="NAME=VALUE for the scene's $NAME.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing run.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Resume a stopped run.")] = False,
) -> None:
    """Render sonar frames: frames.npz, images/, poses.tum and run.json in the folder OUT."""
    from mitsonar.acoustics.noise import load_noise, refuse_noise
    from mitsonar.acoustics.water import absorption_line
    from mitsonar.instruments.sonar import Sonar
    from mitsonar.io.runs import file_digest
    from mitsonar.motion.bodies import MovingBodies
    from mitsonar.motion.trajectory import convention_named
    from mitsonar.simulation.runs import Outputs, run
    from mitsonar.simulation.scene import digests_of, find_scene, load_scene, read_said
    from mitsonar.simulation.simulator import Simulator

    if label_floor and not labels:
        raise MitsonarError(f"--label-floor {label_floor:g} needs --labels: without labels nothing is labelled")
    named = convention_named(frame).name
    outputs = Outputs(
        load_noise(noise), labels=labels, cartesian=cartesian, exr=exr, frame=named, fan=fan, label_floor=label_floor
    )
    parameters = scene_parameters(parameter or [])
    loaded = load_scene(scene, **parameters)
    changes, folder = sonar_changes(set_ or [], quality), out or Path("out") / find_scene(scene).stem
    origin: dict[str, Any] = {"scene": str(scene), "scene_sha256": file_digest(find_scene(scene)), "parameters": parameters}
    if all_sensors or vehicle is not None:
        if mirrors:
            raise MitsonarError("--mirrors is of one sonar: leave it out, or render the sonars one by one")
        file = vehicle_file(vehicle, all_sensors, sonar)
        changes |= {name: value for name, value in (("model", model), ("seed", seed)) if value is not None}
        begin = first_pose(loaded) if file is None else None
        flown = path_for(Sonar(), begin, scene, frames, start, end, trajectory, frame, speed)
        warn_of_speed(flown, end, speed)
        said = moving_said(loaded, moving or [], named, [] if file is None else file.said)
        options = VehicleOptions(changes, overwrite, resume)
        return render_vehicle(loaded, file, flown, folder, outputs, said, origin, options)
    instrument, attitude = instrument_for(loaded, sonar, model, seed, changes)
    refuse_noise(outputs.noise, instrument)
    path = path_for(instrument, attitude, scene, frames, start, end, trajectory, frame, speed)
    warn_of_speed(path, end, speed)
    if mirrors and instrument.model != "coherent" and instrument.bounces == 1:
        raise MitsonarError(
            f"--mirrors needs the model coherent, or --set bounces=2: got {instrument.model}; leave it out, or give one"
        )
    said = moving_said(loaded, moving or [], named)
    bodies = MovingBodies.of(read_said(said), named, path)
    simulator = Simulator(
        loaded, instrument, mirrors="materials" if mirrors else None, moving=bodies, rays_per_launch=rays_per_launch
    )
    check_above_ground(loaded, path, simulator.motion is not None, simulator)
    origin |= {"mirrors": True} if mirrors else {}
    origin |= {"moving": digests_of(said)} if said else {}
    origin["path"] = {"frames": frames, "from": start, "to": end, "trajectory": trajectory and str(trajectory)}
    origin["path"] |= {} if speed is None else {"speed": speed}
    with progress_bar("rendering", len(path), "pings") as progress:
        report = run(simulator, path, folder, outputs, origin=origin, overwrite=overwrite, resume=resume, progress=progress)
    for sentence in report.warnings:
        warn(sentence)
    say(f"{counted(report.frames, 'frame')} ({instrument.model} model, {instrument.title}) in {folder}")
    say(poses_line(path))
    if line := absorption_line(instrument):
        say(line)
    if report.pictures:
        say(f"pictures: {report.pictures[0]}" + (f" ... {report.pictures[-1].name}" if len(report.pictures) > 1 else ""))


def check_above_ground(scene: Any, path: Trajectory, moving: bool, simulator: Simulator | None = None) -> None:
    """Refuse a path below the ground or inside an object, from where the sonar sees nothing; warn where it sees something.

    Args:
        scene: the Mitsuba scene.
        path: of the sonar or vehicle.
        moving: whether bodies move, which is not judged.
        simulator: of the sonar, tells whether it sees anything; None: only warn.
    """
    from mitsonar.simulation.tracing import buried_in

    found = None if moving else buried_in(scene, path.poses)
    if found is None:
        return
    frames = f"pose {found.frame}" if found.frames == 1 else f"pose {found.frame}, the first of {found.frames:,} such poses,"
    if simulator is not None:
        echoes, sonar = simulator.film_echoes(path.poses[found.frame], found.frame), simulator.sonar
        if not ((echoes.hit > 0) & (echoes.far_m >= sonar.range_min) & (echoes.near_m < sonar.range_max)).any():
            raise MitsonarError(f"{frames} {found.text}, and sees nothing from there: correct --from, --to or --trajectory")
    if not found.inside:  # a tank is an object, too
        warn(f"{frames} {found.text}: its frames show the ground from below")


def moving_said(scene: Any, options: list[str], frame: str, also: Sequence[Said] = ()) -> list[Said]:
    """Return what the scene says of its bodies' motion, and in its place what --moving and a vehicle's file say."""
    from mitsonar.motion.bodies import BodyMotion
    from mitsonar.simulation.scene import Said, said_by, said_in

    given: list[Said] = []
    for option in options:
        name, _, file = option.partition("=")
        if option.lower().endswith((".yaml", ".yml")) and not file:
            given += said_in(option)
        elif name and file:
            given.append(Said(name, BodyMotion(path=file, frame=frame), [Path()]))
        else:
            raise MitsonarError(f"--moving takes ID=FILE.tum, ID=vehicle or FILE.yaml: got {option!r}")
    for weaker in (also, said_by(scene)):
        named = {one.name for one in given}
        given += [one for one in weaker if one.name not in named]
    return given


def scene_parameters(pairs: list[str]) -> dict[str, str]:
    """Return what -D says, by name."""
    wrong = [pair for pair in pairs if "=" not in pair]
    if wrong:
        raise MitsonarError(f"-D takes NAME=VALUE: got {wrong[0]!r}")
    return dict(pair.split("=", 1) for pair in pairs)


def sonar_changes(pairs: list[str], quality: str | None) -> dict[str, Any]:
    """Return what --set and --quality change of a sonar."""
    wrong = [pair for pair in pairs if "=" not in pair]
    if wrong:
        raise MitsonarError(f"--set takes KEY=VALUE: got {wrong[0]!r}")
    changes = dict(pair.split("=", 1) for pair in pairs)
    if "preset" in changes:
        raise MitsonarError(f"--set changes keys of the sonar: got preset={changes['preset']}; name it by --sonar")
    if quality is not None and changes.get("quality", quality) != quality:
        raise MitsonarError(f"--quality {quality} and --set quality={changes['quality']} contradict each other: give one")
    return changes if quality is None else {**changes, "quality": quality}


def instrument_for(
    scene: Any, name: str | None, model: str | None, seed: int | None, changes: dict[str, Any] | None = None
) -> tuple[Sonar, Pose | None]:
    """Return the sonar to use and the pose that the scene gives it."""
    from mitsonar.instruments.sounder import load_sonar
    from mitsonar.simulation.scene import sonar_in

    found = sonar_in(scene)
    if name is None and found is None:
        raise MitsonarError(
            "the scene has no sensor of type imaging_sonar: add one, or name a sonar (--sonar didson300) and a pose (--from)"
        )
    sonar = load_sonar(name) if name is not None else found[0]  # type: ignore[index]
    change: dict[str, Any] = dict(changes or {})
    change |= {} if model is None else {"model": model}
    change |= {} if seed is None else {"seed": seed}
    sonar = sonar.replace(**change)
    if "quality" in change and sonar.model == "thesis":
        raise MitsonarError(
            "quality is of the model physical, the thesis model has its own number of rays: got quality "
            f"{change['quality']}; leave it out, or give --set rays_per_beam=N"
        )
    return sonar, found[1] if found else None


# ---------------- What ``mitsonar render --all-sensors`` and ``--vehicle`` do: all sensors of a vehicle in one run


class VehicleOptions(NamedTuple):
    """Options of a run: what changes in the sonars, and how its folder is begun."""

    changes: dict[str, Any]
    overwrite: bool
    resume: bool


def vehicle_file(file: Path | None, all_sensors: bool, sonar: str | None) -> VehicleFile | None:
    """Return what --vehicle says, None where the scene's own sensors are meant."""
    from mitsonar.simulation.vehicle import load_vehicle

    if file is not None and all_sensors:
        raise MitsonarError("--vehicle and --all-sensors contradict each other: give one")
    if sonar is not None:
        raise MitsonarError("--sonar names one sonar: leave it out with --all-sensors and --vehicle")
    return None if file is None else load_vehicle(file)


def first_pose(scene: Any) -> Pose | None:
    """Return the pose of a scene's first sonar or hydrophones, where a path begins that no option tells."""
    from mitsonar.simulation.scene import channel_sonar_in, sonar_in

    found = sonar_in(scene) or channel_sonar_in(scene)
    return None if found is None else found[1]


def render_vehicle(
    scene: Any,
    vehicle: VehicleFile | None,
    path: Trajectory,
    folder: Path,
    outputs: Outputs,
    said: list[Said],
    origin: dict[str, Any],
    options: VehicleOptions,
) -> None:
    """Run all sensors of a vehicle along a path, and say where they lie."""
    from mitsonar.instruments.sonar import Sonar
    from mitsonar.instruments.sounder import Sounder
    from mitsonar.motion.pose import Pose
    from mitsonar.simulation.runs import run_vehicle
    from mitsonar.simulation.scene import digests_of, read_said
    from mitsonar.simulation.vehicle import Mounted, VehicleSimulator, sensors_in

    sensors = sensors_in(scene, Pose.from_row(path.poses[0])) if vehicle is None else vehicle.sensors
    changed = {}
    for name, one in sensors.items():
        instrument: Any = one.instrument
        if options.changes and isinstance(instrument, Sonar | Sounder):
            instrument = instrument.replace(**options.changes)
        changed[name] = Mounted(instrument, one.mount)
    origin = origin | ({"moving": digests_of(said)} if said else {})
    simulator = VehicleSimulator(scene, changed, moving=read_said(said))
    begun = {"overwrite": options.overwrite, "resume": options.resume}
    with progress_bar("rendering", len(path) * len(changed), "pings") as progress:
        report = run_vehicle(simulator, path, folder, outputs, origin=origin, progress=progress, **begun)
    for sentence in report.warnings:
        warn(sentence)
    say(poses_line(path, {name: one.mount for name, one in changed.items()}))
    say(
        f"{counted(len(path), 'pose')}, "
        f"{counted(len(report.sensors), 'sensor')} ({', '.join(report.sensors)}) in {folder}, a folder each"
    )


# ---------------- ``mitsonar impulse``: simulate complex channel impulse responses of a scene


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
        typer.Option("--mirrors", help="Add paths reflected by smooth materials; see docs/guides/impulse-responses.md."),
    ] = False,
    mirror: Annotated[
        list[str] | None,
        typer.Option(
            "--mirror", help="Reflection coefficient of pressure and rms height [m] of a shape, NAME=V,H: surface=-1,0.002."
        ),
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


# ---------------- ``mitsonar sound``: side-scans, altimeters, profilers, DVLs and 3-D sonars along a path


@answered
def sound(
    scene: Annotated[str, typer.Argument(help="Mitsuba XML file, or the name of a shipped scene (`mitsonar scenes`).")],
    instrument: Annotated[
        str,
        typer.Option(help="sidescan, altimeter, profiler, dvl, range-image, a preset (`mitsonar presets`) or a YAML file."),
    ],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder to make (default: out/INSTRUMENT).")] = None,
    frames: Annotated[int | None, typer.Option(help="Number of pings, with --trajectory evenly spaced in time.")] = None,
    start: Annotated[str | None, typer.Option("--from", help=f"First pose of the vehicle: {SIX}.")] = None,
    end: Annotated[str | None, typer.Option("--to", help=f"Last pose: {SIX}.")] = None,
    speed: Annotated[float | None, typer.Option(help=SPEED)] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(help="Poses of the vehicle: a TUM or CSV file, or `shipped` (levelled)."),
    ] = None,
    frame: Frame = "mitsonar",
    model: Annotated[str | None, typer.Option(help="coherent (speckle and noise) or physical.")] = None,
    quality: Annotated[str | None, typer.Option(help="draft, standard or fine: number of rays by accuracy.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Change a key of the instrument, KEY=VALUE: range_max=20.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of jitter, speckle and noise.")] = None,
    moving: Annotated[
        list[str] | None,
        typer.Option("--moving", help="ID=FILE.tum: move the shape ID along a path; or FILE.yaml (docs/guides/moving.md)."),
    ] = None,
    rays_per_launch: Annotated[int, typer.Option(help="Rays traced at once, about 30 bytes each: limits memory.")] = 2**22,
    parameter: Annotated[list[str] | None, typer.Option("-D", help="NAME=VALUE for the scene's $NAME.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing run.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Resume a stopped run.")] = False,
) -> None:
    """Simulate a side-scan, altimeter, profiler, DVL or 3-D sonar on a vehicle, and write its records into OUT."""
    from mitsonar.instruments.sounder import load_sounder
    from mitsonar.io.runs import file_digest
    from mitsonar.motion.bodies import MovingBodies
    from mitsonar.motion.pose import Pose
    from mitsonar.motion.trajectory import convention_named
    from mitsonar.simulation.runs import run_sounder
    from mitsonar.simulation.scene import digests_of, find_scene, load_scene, read_said
    from mitsonar.simulation.sounding import SounderSimulator

    named = convention_named(frame).name
    changes: dict[str, Any] = sonar_changes(set_ or [], quality)
    changes |= {} if model is None else {"model": model}
    changes |= {} if seed is None else {"seed": seed}
    sounder = load_sounder(instrument)
    sounder = sounder.replace(**changes) if changes else sounder
    parameters = scene_parameters(parameter or [])
    loaded = load_scene(scene, **parameters)
    flown = path_for(sounder.fan, None, scene, frames, start, end, trajectory, frame, speed)
    flown = under_vehicle(flown, sounder, trajectory)
    warn_of_speed(flown, end, speed)
    said = moving_said(loaded, moving or [], named)
    bodies = MovingBodies.of(read_said(said), named, flown)
    simulator = SounderSimulator(loaded, sounder, moving=bodies, rays_per_launch=rays_per_launch)
    check_above_ground(loaded, flown, bool(said))
    origin: dict[str, Any] = {"scene": str(scene), "scene_sha256": file_digest(find_scene(scene)), "parameters": parameters}
    origin |= {"moving": digests_of(said)} if said else {}
    options: dict[str, Any] = {"frame": named, "overwrite": overwrite, "resume": resume}
    folder = out or Path("out") / sounder.name
    with progress_bar("sounding", len(flown), "pings") as progress:
        report = run_sounder(simulator, flown, folder, origin=origin, progress=progress, **options)
    for sentence in report.warnings:
        warn(sentence)
    say(f"{counted(len(flown), 'ping')} ({sounder.kind}, {sounder.name}, {sounder.fan.model} model) in {folder}")
    say(poses_line(flown, {name: Pose.from_degrees(mount) for name, mount in sounder.mounts.items()}))
    say(f"echoes in {report.found:,} of {counted(report.beams, 'beam')}; files: {', '.join(report.files)}")


# ---------------- ``mitsonar image``: bin stored echoes into new frames, without tracing


@answered
def image(
    run_folder: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of a run rendered with --exr.")],
    bins: Annotated[int | None, typer.Option(help="Number of range bins (default: as rendered).")] = None,
    window: Annotated[str | None, typer.Option("--range", help="Range window from,to [m] (default: as rendered).")] = None,
    noise: Annotated[str, typer.Option(help=f"{NOISE}.")] = "none",
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder to make (default: OUT/rebinned).")] = None,
    cartesian: Annotated[bool, typer.Option("--cartesian", help="Draw each frame with axes in metres.")] = False,
    frame: Frame = "mitsonar",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing run.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Resume a stopped run.")] = False,
) -> None:
    """Bin the stored echoes of a run into new frames, with other bins, another window or other noise."""
    from mitsonar.acoustics.noise import load_noise
    from mitsonar.motion.trajectory import convention_named
    from mitsonar.simulation.runs import Outputs, StoredEchoes, run

    outputs = Outputs(load_noise(noise), cartesian=cartesian, frame=convention_named(frame).name)
    ends = numbers(window, 2, "--range")
    if ends and not 0 <= ends[0] < ends[1]:
        raise MitsonarError(f"--range takes from,to in m, the near end first: got {window}")
    source = StoredEchoes(run_folder, bins=bins, window=(ends[0], ends[1]) if ends else None)
    folder = out or run_folder / "rebinned"
    if run_folder.resolve().is_relative_to(folder.resolve()):
        raise MitsonarError(f"-o {folder} would replace the echoes that are read: choose another folder")
    origin = {"echoes_of": str(run_folder), "echoes_recipe": source.asked}
    with progress_bar("binning", len(source.trajectory), "pings") as progress:
        report = run(
            source, source.trajectory, folder, outputs, origin=origin, overwrite=overwrite, resume=resume, progress=progress
        )
    for sentence in report.warnings:
        warn(sentence)
    say(f"{counted(report.frames, 'frame')} of {counted(source.sonar.range_bins, 'bin')} in {folder}")
    if report.pictures:
        say(f"pictures: {report.pictures[0]}")
