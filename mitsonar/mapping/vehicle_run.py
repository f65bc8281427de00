"""A run of all sensors of a vehicle: a folder for each, made one after another; a run that is killed goes on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import Sounder
from mitsonar.io.runs import RunDirectory, RunKind, digest
from mitsonar.mapping.sounding_run import run_sounder
from mitsonar.motion.bodies import MovingBodies
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.simulation.channel import ChannelSimulator
from mitsonar.simulation.imaging import Simulator
from mitsonar.simulation.impulse_run import run_impulse
from mitsonar.simulation.render_run import Outputs, run
from mitsonar.simulation.sounding import SounderSimulator
from mitsonar.simulation.vehicle import Mounted, VehicleSimulator, refuse_path

__all__ = ["VEHICLE_RUN", "VehicleReport", "run_vehicle"]

VEHICLE_RUN = RunKind("run of a vehicle", outputs=("vehicle.tum",), notes={"begun": list, "warnings": list})


@dataclass(frozen=True)
class VehicleReport:
    """What a run did: its folder, the names of the sensors, each of which has a folder in it, and warnings."""

    folder: Path
    sensors: tuple[str, ...]
    warnings: list[str]


def run_vehicle(
    simulator: VehicleSimulator,
    vehicle: Trajectory,
    folder: str | Path,
    outputs: Outputs,
    *,
    origin: Mapping[str, Any],
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[int], None] = lambda pings: None,
) -> VehicleReport:
    """Make a folder with a run of each sensor, or go on with one.

    Args:
        simulator: scene, sensors, and bodies that move.
        vehicle: path of the vehicle.
        folder: is made; holds ``vehicle.tum``, ``run.json`` and a folder for each sensor.
        outputs: what imaging sonars write; its convention is that of all files of poses.
        origin: what repeats the run beside sensors and path.
        overwrite: replace a run that is there.
        resume: go on with a run that was broken off.
        progress: called with the number of new pings.

    Raises:
        MitsonarError: a sensor cannot follow the path; the folder exists; the run to resume was another one; the folder
            cannot be written.
    """
    sensors, bodies = simulator.sensors(vehicle), simulator.bodies(vehicle)
    refuse_path(sensors, vehicle, outputs.noise)
    asked = {**origin, "sensors": {name: _told(one) for name, one in sensors.items()}, "frame": outputs.frame}
    asked["poses_sha256"] = digest(vehicle.poses.tobytes(), vehicle.time_s.tobytes())
    made = RunDirectory.begin(folder, VEHICLE_RUN, asked, resume=resume, overwrite=overwrite)
    made.start(begun=[], warnings=[])
    vehicle.save(made.path / "vehicle.tum", outputs.frame)
    begun, warnings = list(made.notes.get("begun") or []), list(made.notes.get("warnings") or [])
    for name, one in sensors.items():
        again = name in begun
        if not again:
            begun.append(name)
            made.note(begun=begun)  # a folder that is there from now on is this run's
        how = {"resume": again, "overwrite": not again, "progress": progress, "origin": dict(origin)}
        said = _run_sensor(simulator, one, vehicle, bodies, made.path / name, outputs, how)
        warnings += [line for line in (f"{name}: {sentence}" for sentence in said) if line not in warnings]
        made.note(warnings=warnings)
    if not made.finished:
        made.finish()
    return VehicleReport(made.path, tuple(sensors), warnings)


def _run_sensor(
    simulator: VehicleSimulator,
    one: Mounted,
    vehicle: Trajectory,
    bodies: MovingBodies,
    folder: Path,
    outputs: Outputs,
    how: dict[str, Any],
) -> list[str]:
    """Run one sensor; return its warnings."""
    scene, instrument, flown = simulator.scene, one.instrument, one.path(vehicle)
    if isinstance(instrument, Sonar):
        return run(Simulator(scene, instrument, moving=bodies), flown, folder, outputs, **how).warnings
    if isinstance(instrument, Sounder):
        sounder = SounderSimulator(scene, instrument, moving=bodies)
        return run_sounder(sounder, flown, folder, frame=outputs.frame, **how).warnings
    if isinstance(instrument, ChannelSonar):
        return run_impulse(ChannelSimulator(scene, instrument), flown, velocities(flown), folder, **how).warnings
    from mitsonar.simulation.camera import CameraSimulator
    from mitsonar.simulation.camera_run import run_camera

    run_camera(CameraSimulator(scene, instrument, moving=bodies), flown, folder, frame=outputs.frame, **how)
    return []


def _told(one: Mounted) -> dict[str, Any]:
    """Return what tells a sensor again."""
    instrument = one.instrument
    if isinstance(instrument, Sonar | Sounder | ChannelSonar):
        return {"keys": instrument.model_dump(mode="json"), "mount": list(one.mount)}
    from mitsonar.simulation.camera import told_of

    return {"keys": told_of(instrument), "mount": list(one.mount)}
