"""Options that several commands share, and what they select: path, scene, instrument.

The path is that of ``--from``, ``--to``, ``--frames``, ``--speed`` and ``--trajectory``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from mitsonar.cli.console import numbers, warn
from mitsonar.cli.run_config import merged_pairs
from mitsonar.errors import MitsonarError, did_you_mean

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from mitsonar.instruments.sonar import Sonar
    from mitsonar.instruments.sounder import Sounder
    from mitsonar.motion.pose import Pose
    from mitsonar.motion.trajectory import Trajectory

SIX = "x,y,z,pitch,roll,heading in m and deg"
FRAMES = (
    "Number of frames, with --trajectory evenly spaced in time. For a rotating head (ping360) the number of sweeps from the "
    "start, with --vehicle the number of poses."
)
NOISE = (
    "Almanza-Medina's noise: none, low, high, m,s,g (fractions of the maximum) or a YAML file; not realistic, since it "
    "reveals empty pixels"
)

SceneName = Annotated[str, typer.Argument(help="Mitsuba XML file, or the name of a shipped scene (`mitsonar scenes`).")]
Parameters = Annotated[list[str] | None, typer.Option("-D", callback=merged_pairs, help="NAME=VALUE for the scene's $NAME.")]
Moving = Annotated[
    list[str] | None,
    typer.Option("--moving", help="ID=FILE.tum: move the shape ID along a path; or FILE.yaml (docs/guides/moving.md)."),
]
Start = Annotated[str | None, typer.Option("--from", help=f"First pose: {SIX}.")]
End = Annotated[str | None, typer.Option("--to", help=f"Last pose: {SIX}.")]
Speed = Annotated[
    float | None, typer.Option(help="Speed from --from to --to [m/s] (default: a frame every 1 / frame_rate_hz).")
]
Frame = Annotated[
    str,
    typer.Option(help="Convention of pose files to read and write: mitsonar, ros-enu or ned; --from is always mitsonar."),
]
SonarName = Annotated[str | None, typer.Option(help="Preset (`mitsonar presets`) or YAML file.")]
SonarKeys = Annotated[
    list[str] | None,
    typer.Option("--set", callback=merged_pairs, help="Change a key of the sonar, KEY=VALUE: range_max=8."),
]
Noise = Annotated[str, typer.Option(help=f"{NOISE}.")]
RaysPerLaunch = Annotated[int, typer.Option(help="Rays traced at once, about 30 bytes each: limits memory.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing run.")]
Resume = Annotated[bool, typer.Option("--resume", help="Resume a stopped run.")]

FAST_M_S = 5.0
"""Speed above which a vehicle's speed is reported [m/s]: few underwater vehicles reach it."""

TILTED_DEG = 10.0
"""Pitch or roll of a vehicle above which a warning is given for instruments that look down from it [deg]."""


def path_for(
    sonar: Sonar,
    attitude: Pose | None,
    scene: str,
    frames: int | None,
    start: str | None,
    end: str | None,
    file: Path | None,
    frame: str,
    speed: float | None = None,
    *,
    counted: str = "--frames",
) -> Trajectory:
    """Return the trajectory that the options define; ``counted`` is the option that gives ``frames``."""
    from mitsonar.instruments.sonar import first_sweeps, frame_period_s, scans
    from mitsonar.motion.pose import Pose
    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.simulation.scene import shipped_trajectory

    if frames is not None and frames < 1:
        raise MitsonarError(f"{counted} must be at least 1: got {frames}")
    if speed is not None and (file is not None or end is None or not 0 < speed < 1e4):
        raise MitsonarError(
            f"--speed must be above 0 m/s, and needs --from and --to: got {speed:g}{' without --to' if end is None else ''}"
        )
    if file is not None:
        if start or end:
            raise MitsonarError("--trajectory and --from/--to contradict each other: give one")
        shipped = str(file) == "shipped"
        if not shipped and not file.exists():
            raise MitsonarError(
                f"there is no trajectory {file}: give a TUM or CSV file, or `shipped`{did_you_mean(file, ['shipped'])}"
            )
        path = Trajectory.load_tum(shipped_trajectory(scene)) if shipped else Trajectory.load(file, frame)
        if frames is None:
            return path
        return first_sweeps(sonar, path, frames) if scans(sonar) else path.resample(frames)
    first = numbers(start, 6, "--from")
    last = numbers(end, 6, "--to")
    begin = Pose.from_degrees(first) if first else attitude
    if begin is None:
        raise MitsonarError(f"the scene gives no pose: give one with --from ({SIX}), or --trajectory FILE.tum")
    if last is None:
        rest = frames or 1  # poses of a vehicle at rest; those of a head that turns lie at the ends of its sweeps
        return Trajectory.between(begin, begin, rest + (rest > 1 and scans(sonar)), 1 / frame_period_s(sonar))
    if frames is None or (frames < 2 and not scans(sonar)):
        many = counted.strip("-")
        raise MitsonarError(f"--to needs {counted} T, 2 or more: how many {many} lie between --from and --to")
    ends, poses = (begin, Pose.from_degrees(last)), frames + 1 if scans(sonar) else frames
    distance_m = math.dist(ends[0][:3], ends[1][:3])
    if speed is not None and distance_m == 0:
        raise MitsonarError("--speed needs different places --from and --to: they are the same; leave --speed out")
    if speed is None:
        return Trajectory.between(*ends, poses, 1 / frame_period_s(sonar))
    path = Trajectory.between(*ends, poses, (poses - 1) * speed / distance_m)
    return first_sweeps(sonar, path, frames) if scans(sonar) else path


def under_vehicle(path: Trajectory, sounder: Sounder, file: Path | None) -> Trajectory:
    """Return the path of the vehicle that carries an instrument, given a path that may be that of a forward-looking sonar.

    The trajectories of shipped scenes are those of a sonar that looks ahead and down; an instrument that looks down or aside
    is mounted on the level vehicle below it. On other paths, warn if such an instrument is tilted.
    """
    if sounder.looks_ahead:
        return path
    if str(file) == "shipped":
        level = path.poses.copy()
        level[:, 3:5] = 0.0
        return type(path)(level, path.time_s)
    pitch, roll = (math.degrees(float(angle)) for angle in np.median(path.poses[:, 3:5], axis=0))
    if max(abs(pitch), abs(roll)) > TILTED_DEG:
        warn(
            f"the vehicle flies at pitch {pitch:.3g}, roll {roll:.3g} deg, and the {sounder.kind} on it looks down or aside "
            "from a level one: the path must be the vehicle's, not that of a sonar on it; where the vehicle "
            "is level, give pitch 0"
        )
    return path


def poses_line(path: Trajectory, mounts: Mapping[str, ArrayLike] | None = None) -> str:
    """Return a sentence on whose poses a path holds, the median pitch, and how instruments are mounted.

    Args:
        path: trajectory of the sonar or of the vehicle.
        mounts: mounts on the vehicle keyed by name [m, rad]; empty for hydrophones, whose receivers have positions. None:
            the path is that of the sonar itself.
    """
    pitch = math.degrees(float(np.median(path.poses[:, 3])))
    if mounts is None:
        return f"poses: of the sonar, at pitch {pitch:.3g} deg"
    shown = [
        f"{name} pitch {math.degrees(mount[3]):.3g}, heading {math.degrees(mount[5]):.3g} deg"
        for name, mount in ((name, np.asarray(mount, dtype=float)) for name, mount in mounts.items())
    ]
    on_it = f"; mounted on it: {'; '.join(shown)}" if shown else ""
    return f"poses: of the vehicle, at pitch {pitch:.3g} deg{on_it}"


def warn_of_speed(path: Trajectory, end: str | None, speed: float | None) -> None:
    """Warn if the frame rate makes the vehicle faster than real ones, since --to is given without --speed."""
    duration_s = float(path.time_s[-1] - path.time_s[0])
    if end is None or speed is not None or duration_s <= 0:
        return
    distance_m = math.dist(path.poses[0, :3], path.poses[-1, :3])
    if distance_m / duration_s > FAST_M_S:
        warn(
            f"the vehicle moves {distance_m:.3g} m in {duration_s:.3g} s, {distance_m / duration_s:.3g} m/s, since "
            "frames follow each other at the sonar's rate; give --speed 1 (m/s), or more --frames"
        )


def scene_parameters(pairs: list[str]) -> dict[str, str]:
    """Return the parameters of -D, keyed by name."""
    wrong = [pair for pair in pairs if "=" not in pair]
    if wrong:
        raise MitsonarError(f"-D takes NAME=VALUE: got {wrong[0]!r}")
    return dict(pair.split("=", 1) for pair in pairs)


def sonar_changes(pairs: list[str] | None, quality: str | None, model: str | None, seed: int | None) -> dict[str, Any]:
    """Return the keys of a sonar that --set, --quality, --model and --seed change."""
    wrong = [pair for pair in pairs or [] if "=" not in pair]
    if wrong:
        raise MitsonarError(f"--set takes KEY=VALUE: got {wrong[0]!r}")
    changes: dict[str, Any] = dict(pair.split("=", 1) for pair in pairs or [])
    if "preset" in changes:
        raise MitsonarError(f"--set changes keys of the sonar: got preset={changes['preset']}; name it with --sonar")
    if quality is not None and changes.get("quality", quality) != quality:
        raise MitsonarError(f"--quality {quality} and --set quality={changes['quality']} contradict each other: give one")
    given = {"quality": quality, "model": model, "seed": seed}
    return changes | {key: value for key, value in given.items() if value is not None}


def instrument_for(scene: Any, name: str | None, changes: dict[str, Any]) -> tuple[Sonar, Pose | None]:
    """Return the sonar to use, with its changes, and the pose that the scene gives it."""
    from mitsonar.instruments.sounder import load_sonar
    from mitsonar.simulation.scene import sonar_in

    scene_sonar = sonar_in(scene)
    if name is None and scene_sonar is None:
        raise MitsonarError(
            "the scene has no sensor of type imaging_sonar: add one, or name a sonar (--sonar didson300) and a pose (--from)"
        )
    sonar = load_sonar(name) if name is not None else scene_sonar[0]  # type: ignore[index]
    sonar = sonar.replace(**changes)
    if "quality" in changes and sonar.model == "thesis":
        raise MitsonarError(
            "quality applies to the model physical; the model thesis takes its number of rays from rays_per_beam: got "
            f"quality {changes['quality']}; leave it out, or give --set rays_per_beam=N"
        )
    return sonar, scene_sonar[1] if scene_sonar else None
