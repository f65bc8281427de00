"""What ``mitsonar render --all-sensors`` and ``--vehicle`` do: all sensors of a vehicle in one run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mitsonar.cli.console import progress_bar, say, warn
from mitsonar.cli.flown_path import poses_line
from mitsonar.errors import MitsonarError, counted

if TYPE_CHECKING:
    from mitsonar.motion.pose import Pose
    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.simulation.runs import Outputs
    from mitsonar.simulation.scene import Said
    from mitsonar.simulation.vehicle import VehicleFile

__all__ = ["VehicleOptions", "first_pose", "render_vehicle", "vehicle_file"]


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
