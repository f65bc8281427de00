"""``mitsonar sound``: side-scans, altimeters, profilers, DVLs and 3-D sonars along a path."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mitsonar.cli.console import answered, progress_bar, say, warn
from mitsonar.cli.flown_path import SIX, SPEED, Frame, path_for, poses_line, under_vehicle, warn_of_speed
from mitsonar.cli.render_command import check_above_ground, moving_said, scene_parameters, sonar_changes
from mitsonar.errors import counted

__all__ = ["sound"]


@answered
def sound(
    scene: Annotated[str, typer.Argument(help="Mitsuba XML file, or the name of a shipped scene (`mitsonar scenes`).")],
    instrument: Annotated[
        str,
        typer.Option(help="sidescan, altimeter, profiler, dvl, range-image, a preset (`mitsonar presets`) or a YAML file."),
    ],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder to make (default: out/INSTRUMENT).")] = None,
    frames: Annotated[
        int | None, typer.Option(help="Number of pings; with --trajectory evenly spaced in time over all of it.")
    ] = None,
    start: Annotated[str | None, typer.Option("--from", help=f"First pose of the vehicle: {SIX}.")] = None,
    end: Annotated[str | None, typer.Option("--to", help=f"Last pose: {SIX}.")] = None,
    speed: Annotated[float | None, typer.Option(help=SPEED)] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(help="Poses of the vehicle: a TUM or CSV file, or `shipped`, level below the sonar of the scene."),
    ] = None,
    frame: Frame = "mitsonar",
    model: Annotated[str | None, typer.Option(help="coherent, with speckle and noise, or physical.")] = None,
    quality: Annotated[str | None, typer.Option(help="draft, standard or fine: rays by the error wanted.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE of the instrument: range_max=20.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of jitter, speckle and noise.")] = None,
    moving: Annotated[
        list[str] | None,
        typer.Option("--moving", help="ID=FILE.tum: the shape ID follows that path; or FILE.yaml (docs/guides/moving.md)."),
    ] = None,
    rays_per_launch: Annotated[int, typer.Option(help="Bound of memory: about 30 bytes a ray.")] = 2**22,
    parameter: Annotated[list[str] | None, typer.Option("-D", help="NAME=VALUE for the scene's $NAME.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a run that is there.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a run that was broken off.")] = False,
) -> None:
    """Simulate an instrument of beams on a vehicle: waterfall, ranges, points or velocities in the folder OUT."""
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
