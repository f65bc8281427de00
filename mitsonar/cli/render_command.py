"""``mitsonar render``: a scene becomes sonar frames on disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitsonar.cli.console import answered, progress_bar, say, warn
from mitsonar.cli.flown_path import FRAMES, SIX, SPEED, Frame, path_for, poses_line, warn_of_speed
from mitsonar.errors import MitsonarError, counted

if TYPE_CHECKING:
    from mitsonar.instruments.sonar import Sonar
    from mitsonar.motion.pose import Pose
    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.simulation.scene import Said
    from mitsonar.simulation.simulator import Simulator

__all__ = ["NOISE", "check_above_ground", "instrument_for", "moving_said", "render", "scene_parameters", "sonar_changes"]

NOISE = (
    "Almanza-Medina's noise: none, low, high, m,s,g (fractions of the maximum) or a YAML file; no realism, it shows which "
    "pixels are empty"
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
    model: Annotated[str | None, typer.Option(help="coherent (as of most presets), physical or thesis.")] = None,
    quality: Annotated[
        str | None, typer.Option(help="draft, standard or fine: rays by the error wanted (`mitsonar presets`).")
    ] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE of the sonar: range_max=8.")] = None,
    noise: Annotated[str, typer.Option(help=f"{NOISE}.")] = "none",
    labels: Annotated[bool, typer.Option("--labels", help="Per-pixel elevation, shape id and shadow too.")] = False,
    seed: Annotated[int | None, typer.Option(help="Seed of jitter and noise.")] = None,
    label_floor: Annotated[
        float, typer.Option(min=0, max=1, help="Label only pixels above this part of full scale, before noise.")
    ] = 0.0,
    fan: Annotated[
        bool, typer.Option("--fan", help="A plain fan picture of each frame, in fan/; with --labels of these as well.")
    ] = False,
    cartesian: Annotated[bool, typer.Option("--cartesian", help="A figure with metre axes for each frame.")] = False,
    exr: Annotated[bool, typer.Option("--exr", help="Every ray's echo, one EXR a frame.")] = False,
    mirrors: Annotated[
        bool,
        typer.Option("--mirrors", help="Smooth materials glint (coherent) and mirror (bounces); docs/guides/multipath.md."),
    ] = False,
    moving: Annotated[
        list[str] | None,
        typer.Option("--moving", help="ID=FILE.tum: the shape ID follows that path; or FILE.yaml (docs/guides/moving.md)."),
    ] = None,
    all_sensors: Annotated[
        bool, typer.Option("--all-sensors", help="All sonars and cameras of the scene, on one vehicle (several-sensors.md).")
    ] = False,
    vehicle: Annotated[
        Path | None, typer.Option(help="All sensors of a vehicle, a YAML file; see docs/guides/several-sensors.md.")
    ] = None,
    rays_per_launch: Annotated[int, typer.Option(help="Bound of memory: about 30 bytes a ray.")] = 2**22,
    parameter: Annotated[list[str] | None, typer.Option("-D", help="NAME=VALUE for the scene's $NAME.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a run that is there.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a run that was broken off.")] = False,
) -> None:
    """Render what the sonar receives: frames.npz, images/, poses.tum and run.json in the folder OUT."""
    from mitsonar.acoustics.noise import load_noise, refuse_noise
    from mitsonar.acoustics.water import absorption_line
    from mitsonar.cli.vehicle_rendering import VehicleOptions, first_pose, render_vehicle, vehicle_file
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
