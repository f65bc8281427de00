"""Runs of channel sonars, sounders, cameras and whole vehicles on disk."""

from __future__ import annotations

import io
import math
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import zarr
from numpy.typing import NDArray
from PIL import Image

from mitsonar.acoustics.water import delay_exact, delay_iterated
from mitsonar.errors import MitsonarError, count_noun
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import Sounder
from mitsonar.io.files import read_npz, write_atomic
from mitsonar.io.runs import RUN_FILE, RunDirectory, RunKind, digest
from mitsonar.io.storage import refuse_codecs
from mitsonar.motion.bodies import MovingBodies
from mitsonar.motion.sensors import save_sensors
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.plotting import figures
from mitsonar.recordings.write_xtf import write_xtf
from mitsonar.records.frames import check_column
from mitsonar.records.responses import COLUMNS, ImpulseResponses
from mitsonar.records.soundings import Echogram, Soundings
from mitsonar.simulation.channel import ChannelSimulator, Paths
from mitsonar.simulation.device import current_variant
from mitsonar.simulation.runs import SIMULATORS, Destination, RenderOptions, Steps, path_digest, run, write_run
from mitsonar.simulation.simulator import Simulator
from mitsonar.simulation.sounding import SoundedPings, SounderSimulator, dvl_readings, dvl_sensors
from mitsonar.simulation.vehicle import CameraSimulator, Mounted, VehicleSimulator, camera_settings, refuse_path

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = [
    "CHANNEL_MEASUREMENT",
    "PHOTOGRAPHS",
    "SOUNDINGS",
    "VEHICLE_RUN",
    "ImpulseReport",
    "SoundingReport",
    "Spread",
    "VehicleReport",
    "iteration_error",
    "run_camera",
    "run_impulse",
    "run_sounder",
    "run_vehicle",
    "spread_of",
]


# ---------------- Runs of channel sonars


CHANNEL_MEASUREMENT = RunKind(
    "channel measurement",
    outputs=("responses.npz", "responses.zarr", "response.png", "waterfall.png"),
    notes={"frames_done": int, "warnings": list},
    packages=(*SIMULATORS, "finufft"),
    deciding=(*SIMULATORS[:3], "finufft"),
)

OVERSPREAD = 0.3
"""Product of a receiver's delay spread and Doppler spread above which a channel is reported as overspread."""

MOST_ENERGY = (0.01, 0.99)
"""Quantiles of the echo energy between which the spread of delays and Doppler shifts is measured."""


@dataclass(frozen=True)
class Spread:
    """Delay spread [s] and Doppler spread [Hz] of a receiver's echoes; each contains 98 % of their energy."""

    delay_s: float
    doppler_hz: float

    @property
    def factor(self) -> float:
        """Return the product of delay spread and Doppler spread; above 1 a channel changes within one response."""
        return self.delay_s * self.doppler_hz


@dataclass(frozen=True)
class ImpulseReport:
    """Spread and warnings of a run."""

    spread: Spread
    warnings: list[str]


def run_impulse(
    simulator: ChannelSimulator,
    flown: Trajectory,
    velocity: NDArray[np.float64],
    destination: Destination,
    *,
    pulsed: bool = False,
) -> ImpulseReport:
    """Simulate impulse responses into a run folder, or resume an interrupted run.

    The folder holds ``responses.zarr`` and ``responses.npz``, two figures and ``run.json``.

    Args:
        simulator: scene and instrument.
        flown: poses and times of the pings.
        velocity: velocity of the vehicle in each ping, see :class:`~mitsonar.records.responses.ImpulseResponses`.
        destination: folder, origin, and how the run begins.
        pulsed: a pulse measures each response, not a continuous signal: overspread channels and echoes that come later than
            the next pulse are no reason to warn.

    Raises:
        MitsonarError: no receiver has an echo; or as in :func:`~mitsonar.simulation.runs.write_run`.
    """
    sonar = simulator.sonar
    settings = {
        "sonar": sonar.model_dump(mode="json"),
        "pings": len(flown),
        "poses_sha256": path_digest(flown),
        "velocity": _velocity_settings(flown, velocity),
    }
    begun = float(flown.time_s[0])
    paths = [
        simulator.paths(flown.poses[0], velocity[:1], receiver, time_s=begun) for receiver in range(len(sonar.receivers))
    ]
    spread = spread_of(paths)
    if not any(path.amplitude.size for path in paths):
        _refuse_silence(simulator, flown, paths)

    def steps(run: RunDirectory) -> Steps:
        if (run.path / "responses.npz").exists():  # the file that is written last
            return
        yield run.count("frames_done", len(flown)), {}
        yield from _write_responses(simulator, flown, velocity, run)
        responses = ImpulseResponses.load(run.path / "responses.zarr")
        yield 0, {"warnings": [*simulator.notes, *_warnings(responses, None if pulsed else spread)]}
        responses.about |= {"spread_factor": spread.factor}
        write_atomic(run.path / "response.png", figures.response_png(responses))
        write_atomic(run.path / "waterfall.png", figures.waterfall_png(responses))
        responses.save(run.path / "responses.npz")

    directory = write_run(CHANNEL_MEASUREMENT, settings, destination, steps, frames_done=0)
    return ImpulseReport(spread, directory.notes.get("warnings") or [])


def _velocity_settings(flown: Trajectory, velocity: NDArray[np.float64]) -> list[float] | str:
    """Return the velocities as a run records them: one for all pings, those of the path, or the digest of others."""
    if len(np.unique(velocity, axis=0)) == 1:
        return [float(one) for one in velocity[0]]
    return "of the path" if np.array_equal(velocity, velocities(flown)) else digest(velocity.tobytes())


def _write_responses(
    simulator: ChannelSimulator, flown: Trajectory, velocity: NDArray[np.float64], run: RunDirectory
) -> Steps:
    """Simulate the missing pings into ``responses.zarr``."""
    done, url = run.count("frames_done", len(flown)), run.path / "responses.zarr"
    if done == 0:
        shape = (len(flown), len(simulator.sonar.receivers))
        empty = ImpulseResponses(
            response=np.zeros((*shape, simulator.sonar.taps), np.complex64),
            time_s=flown.time_s,
            sonar=simulator.sonar,
            poses=flown.poses,
            velocity=velocity,
            height_m=np.zeros(shape[0]),
            echoes=np.zeros(shape, np.int64),
            dropped=np.zeros(shape, np.int64),
        )
        empty.save(url)
    try:
        group = zarr.open_group(url, mode="r+", zarr_format=3)
        _check_store(group, len(flown), simulator.sonar)
        for part in simulator.pings(flown.poses[done:], velocity[done:], first=done, time_s=flown.time_s[done:]):
            batch = slice(part.first, part.first + len(part))
            for name in ("response", "height_m", "echoes", "dropped"):
                group[name][batch] = getattr(part, name)  # type: ignore[index]
            yield len(part), {"frames_done": batch.stop}
    except MitsonarError:
        raise
    except Exception as error:  # a damaged Zarr store raises errors of any type
        raise MitsonarError(f"cannot continue {url}: {error}; start again with --overwrite") from None


def _check_store(group: zarr.Group, pings: int, sonar: ChannelSonar) -> None:
    """Check that a store belongs to the run, before anything is written into it.

    Raises:
        MitsonarError: an array is missing or has another shape or type.
        ValueError: an array has other chunks, or codecs that are not read.
    """
    sizes = {"pings": pings, "receivers": len(sonar.receivers), "taps": sonar.taps, "four": 4, "six": 6}
    for name, column in COLUMNS.items():
        array = cast(zarr.Array[Any], group[name])
        refuse_codecs(array)
        check_column(array, name, column, sizes, str(group.store_path))
        if array.chunks != ((1, *array.shape[1:]) if array.ndim > 2 else array.shape):
            raise ValueError(f"{name} has chunks of {array.chunks}")


def _refuse_silence(simulator: ChannelSimulator, flown: Trajectory, paths: list[Paths]) -> None:
    """Refuse a run without echoes in the first, the middle and the last ping; the caller has checked the first.

    Raises:
        MitsonarError: the middle and the last ping have no echo either.
    """
    sonar = simulator.sonar
    for k in (len(flown) // 2, -1):
        pose, time_s = flown.poses[k], float(flown.time_s[k])
        if any(simulator.paths(pose, None, one.name, time_s=time_s).amplitude.size for one in sonar.receivers):
            return
    beyond = sum(path.dropped for path in paths)
    x, y, z, pitch, *_ = flown.poses[0]
    height = float(simulator.tracer.height_m(flown.poses[:1])[0])
    below = f"{height:.3g} m above what is below it" if math.isfinite(height) else "with nothing below it"
    raise MitsonarError(
        f"no receiver has an echo: the vehicle is at ({x:g}, {y:g}, {z:g}) m, {below}, pitched by "
        f"{math.degrees(pitch):.3g} deg; {beyond:,} echoes came from beyond range_max {sonar.range_max:g} m. z is upwards, "
        "a level vehicle has pitch 0 (to_world's +z is forward), and receivers point tilt_deg away from straight down"
    )


FAR_ARM_M = 10.0
"""Distance from the transmitter [m] above which a receiver's position is probably given in millimetres."""


def spread_of(paths: list[Paths]) -> Spread:
    """Measure the spread of 98 % of each receiver's echo energy, and return the spread with the largest factor.

    Each receiver is a separate channel: Doppler shifts of receivers that look in different directions do not blur one
    response.
    """
    spreads = []
    for path in paths:
        energy, widths = np.abs(path.amplitude) ** 2, []
        for values in (path.delay_s, path.doppler_hz):
            # the cumulative energy along the sorted values gives the quantiles of MOST_ENERGY
            order = np.argsort(values)
            share = np.cumsum(energy[order])
            if not share.size or share[-1] == 0:
                widths.append(0.0)
                continue
            low, high = np.searchsorted(share, np.array(MOST_ENERGY) * share[-1])
            widths.append(float(values[order[min(high, len(order) - 1)]] - values[order[low]]))
        spreads.append(Spread(*widths))
    return max(spreads, key=lambda spread: spread.factor)


def _warnings(responses: ImpulseResponses, spread: Spread | None) -> list[str]:
    """Return the warnings of a run, one sentence each."""
    arms = {one.name: math.dist(one.position, (0, 0, 0)) for one in responses.sonar.receivers}
    far = [name for name, away in arms.items() if away > FAR_ARM_M]
    several = f"receivers {', '.join(far)} are up to" if len(far) > 1 else f"receiver {', '.join(far)} is"
    sentences = [f"{several} {max(arms.values()):g} m from the transmitter: positions are in metres"] if far else []
    assert responses.echoes is not None
    assert responses.dropped is not None
    for number, receiver in enumerate(responses.sonar.receivers):
        silent = int((responses.echoes[:, number] == 0).sum())
        if silent:
            view = receiver.field
            up = " (above 90: upwards)" if view.tilt_deg > 90 else ""
            pitch = "" if responses.poses is None else f" (pitched by {math.degrees(responses.poses[0, 3]):.3g} deg)"
            sentences.append(
                f"receiver {receiver.name} has no echo in {silent} of {count_noun(len(responses), 'ping')}: check its "
                f"direction (heading {view.heading_deg:g} deg, tilt {view.tilt_deg:g} deg from straight down{up}), "
                f"the vehicle's pose{pitch} and range_max"
            )
    dropped = int(responses.dropped.sum())
    if dropped and spread is not None:
        share = dropped / max(1, dropped + int(responses.echoes.sum()))
        sentences.append(
            f"{dropped:,} echoes ({100 * share:.3g} %) came from beyond range_max {responses.sonar.range_max:g} m and were "
            "dropped: raise it, with a frequency_step_hz below sound_speed / (4 range_max)"
        )
    if spread is not None and spread.factor > OVERSPREAD:
        sentences.append(
            f"the channel is overspread: delays over {1e3 * spread.delay_s:.3g} ms times Doppler shifts over "
            f"{spread.doppler_hz:.3g} Hz make {spread.factor:.2g}, above {OVERSPREAD:g}; it changes while it is measured, "
            "and a real sounder would see it blurred"
        )
    return sentences


def iteration_error(flown: Trajectory, velocity: NDArray[np.float64], sonar: ChannelSonar) -> tuple[float, float]:
    """Bound the error of a moving receiver's delay in Almanza-Medina's iteration (eq. 5.5-5.14).

    The bound is evaluated for points ahead and behind at ``range_max``.

    Returns:
        Largest errors without iteration and after two rounds [cycles of the carrier]; 0, 0 where they are not finite.
    """
    speed = float(np.linalg.norm(velocity[:, :3], axis=1).max(initial=0.0))
    ahead = (np.array([sonar.range_max, -sonar.range_max]), np.zeros(2), np.zeros(2))
    moving = (np.full(2, speed), np.zeros(2), np.zeros(2))
    exact = delay_exact(ahead, ahead, moving, sonar.sound_speed)
    errors = [
        float(np.abs(delay_iterated(ahead, ahead, moving, sonar.sound_speed, rounds) - exact).max()) * sonar.carrier_hz
        for rounds in (0, 2)
    ]
    return (errors[0], errors[1]) if math.isfinite(sum(errors)) else (0.0, 0.0)


# ---------------- Runs of cameras


PHOTOGRAPHS = RunKind(
    "photographs",
    outputs=("images", "poses.tum"),
    notes={"frames_done": int},
    packages=SIMULATORS,
    deciding=SIMULATORS[:3],
)


def run_camera(simulator: CameraSimulator, flown: Trajectory, destination: Destination, *, frame: str = "mitsonar") -> None:
    """Render a camera's pictures into a run folder, or resume an interrupted run.

    The folder holds ``images/000000.png`` ..., ``poses.tum`` and ``run.json``.

    Args:
        simulator: scene and camera.
        flown: poses and times of the camera.
        destination: folder, origin, and how the run begins.
        frame: coordinate convention of ``poses.tum``.

    Raises:
        MitsonarError: as in :func:`~mitsonar.simulation.runs.write_run`.
    """
    settings = {
        "variant": current_variant(),
        "camera": camera_settings(simulator.camera),
        "frames": len(flown),
        "samples": simulator.samples,
        "frame": frame,
        "poses_sha256": path_digest(flown),
    }

    def steps(run: RunDirectory) -> Steps:
        if run.finished:
            return
        flown.save(run.path / "poses.tum", frame)
        (run.path / "images").mkdir(exist_ok=True)
        files = [run.path / "images" / f"{number:06d}.png" for number in range(len(flown))]
        noted = run.count("frames_done", len(flown))
        # the first missing picture and all after it are rendered again
        done = next((number for number in range(noted) if not files[number].is_file()), noted)
        yield done, {}
        for number, picture in enumerate(simulator.pictures(flown.poses[done:], flown.time_s[done:], first=done), done):
            buffer = io.BytesIO()
            Image.fromarray(picture).save(buffer, format="PNG")
            write_atomic(files[number], buffer.getvalue())
            yield 1, {"frames_done": number + 1}

    write_run(PHOTOGRAPHS, settings, destination, steps, frames_done=0)


# ---------------- Runs of sounders


SOUNDINGS = RunKind(
    "sounding",
    outputs=(
        *("parts", "echogram.npz", "echogram.png", "sidescan.xtf", "waterfall.png", "soundings.npz", "soundings.csv"),
        *("soundings.ply", "soundings.png", "range.png", "dvl.csv", "dvl.png", "sensors.csv", "poses.tum"),
    ),
    notes={"pings_done": int, "warnings": list},
    packages=SIMULATORS,
    deciding=SIMULATORS[:3],
)

WITH_LEVELS = ("sidescan", "altimeter")
"""Kinds of sounders that store all levels, not only detections."""

DETECTED = ("range_m", "level_db", "quality")


@dataclass(frozen=True)
class SoundingReport:
    """Files, number of detections and warnings of a run.

    Attributes:
        files: names of the files that were written.
        found: number of beams with an echo, out of ``beams``.
        beams: number of beams in all pings.
        warnings: warnings to the user, one sentence each.
    """

    files: list[str]
    found: int
    beams: int
    warnings: list[str]


def run_sounder(
    simulator: SounderSimulator, flown: Trajectory, destination: Destination, *, frame: str = "mitsonar"
) -> SoundingReport:
    """Render a sounder's pings into a run folder, or resume an interrupted run.

    Batches are stored as parts while they are rendered; the files of the kind of instrument follow at the end.

    Args:
        simulator: scene and instrument.
        flown: poses of the vehicle and times of the pings.
        destination: folder, origin, and how the run begins; the folder holds ``run.json``, ``poses.tum`` and the files of
            the kind of instrument.
        frame: coordinate convention of ``poses.tum``.

    Raises:
        MitsonarError: as in :func:`~mitsonar.simulation.runs.write_run`.
    """
    sounder = simulator.sounder
    settings = {
        "variant": simulator.variant,
        "sounder": sounder.model_dump(mode="json"),
        "pings": len(flown),
        "poses_sha256": path_digest(flown),
        "frame": frame,
    }

    def steps(run: RunDirectory) -> Steps:
        flown.save(run.path / "poses.tum", frame)
        if run.finished:
            return
        done, folder = run.count("pings_done", len(flown)), run.path / "parts"
        yield done, {}
        folder.mkdir(exist_ok=True)
        if done < len(flown):
            for batch in simulator.pings(flown.poses[done:], first=done, time_s=flown.time_s[done:]):
                part = folder / f"{batch.first:09d}.npz"
                whole = part.with_suffix(".part")
                with whole.open("wb") as file:
                    arrays = _stored_arrays(simulator, batch)
                    np.savez(file, **arrays)  # type: ignore[arg-type]  # the stubs take allow_pickle for a name
                whole.replace(part)
                yield len(batch.levels), {"pings_done": batch.first + len(batch.levels)}
        parts = _joined_parts(folder, len(flown))
        soundings = Soundings(flown.time_s, flown.poses, sounder, *(parts[name] for name in DETECTED))
        yield 0, {"warnings": [*simulator.notes, *_write_soundings(run.path, soundings, parts)]}

    directory = write_run(SOUNDINGS, settings, destination, steps, pings_done=0)
    shutil.rmtree(directory.path / "parts", ignore_errors=True)
    soundings = Soundings.load(directory.path / "soundings.npz")
    files = [name for name in SOUNDINGS.outputs if (directory.path / name).is_file()]
    warnings = [str(one) for one in directory.notes.get("warnings") or []]
    return SoundingReport(files, int(soundings.found.sum()), soundings.found.size, warnings)


def _stored_arrays(simulator: SounderSimulator, batch: SoundedPings) -> dict[str, NDArray[Any]]:
    """Return the arrays of a batch to store: detections, and for some kinds the levels."""
    arrays: dict[str, NDArray[Any]] = dict(zip(DETECTED, simulator.detect(batch.levels), strict=True))
    if simulator.sounder.kind in WITH_LEVELS:
        arrays |= {"levels": batch.levels[..., 0], "height_m": batch.height_m}
    return arrays


def _joined_parts(folder: Path, pings: int) -> dict[str, NDArray[Any]]:
    """Read all parts and return their concatenated arrays.

    Raises:
        MitsonarError: a part is missing or damaged.
    """
    try:
        parts = [read_npz(path) for path in sorted(folder.glob("*.npz"))]
        joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    except Exception as error:  # damaged bytes raise errors of many kinds
        raise MitsonarError(f"{folder} is damaged ({error}): start again with --overwrite") from None
    if len(joined["range_m"]) != pings:
        raise MitsonarError(f"{folder} holds {len(joined['range_m'])} pings of {pings}: start again with --overwrite")
    return joined


def _write_soundings(folder: Path, soundings: Soundings, parts: Mapping[str, NDArray[Any]]) -> list[str]:
    """Write the files of the kind of instrument; return warnings."""
    kind, notes = soundings.sounder.kind, []
    if kind in WITH_LEVELS:
        levels, height_m = parts["levels"], parts["height_m"]
        echogram = Echogram(soundings.time_s, soundings.poses, soundings.sounder, levels, height_m)
        echogram.save(folder / "echogram.npz")
        if kind == "sidescan":
            try:
                write_xtf(folder / "sidescan.xtf", echogram)
            except MitsonarError as error:  # the other files are whole
                notes.append(f"there is no sidescan.xtf: {error}")
            figures.save_sounding_figure(figures.side_scan_figure(echogram), folder / "waterfall.png")
        else:
            figures.save_sounding_figure(figures.echogram_figure(echogram, soundings), folder / "echogram.png")
    if not soundings.found.any():
        notes.append("no beam of any ping has an echo: move the window (range_min, range_max), or come nearer")
    elif kind == "dvl":
        notes += _write_dvl(folder, soundings)
    elif kind != "sidescan":
        notes += _write_points(folder, soundings)
    soundings.save(folder / "soundings.npz")
    return notes


def _write_dvl(folder: Path, soundings: Soundings) -> list[str]:
    """Write the readings of a DVL, and the sensor file that odometry reads; return warnings."""
    readings = dvl_readings(soundings, soundings.sounder.fan.seed)
    readings.save(folder / "dvl.csv")
    figures.save_sounding_figure(figures.dvl_figure(readings), folder / "dvl.png")
    lost = int((~readings.locked).sum())
    if lost == len(readings.locked):
        return ["the DVL has no bottom lock in any ping: there is no sensors.csv"]
    save_sensors(folder / "sensors.csv", dvl_sensors(readings))
    return [f"the DVL lost the bottom in {lost} of {count_noun(len(readings.locked), 'ping')}"] if lost else []


def _write_points(folder: Path, soundings: Soundings) -> list[str]:
    """Write soundings as table, point cloud and pictures; return warnings."""
    soundings.save(folder / "soundings.csv")
    if soundings.sounder.kind == "altimeter":
        return []
    drawn = figures.soundings_figure(soundings)
    figures.save_sounding_figure(drawn, folder / "soundings.png")
    if soundings.sounder.kind == "range-image":
        figures.save_sounding_figure(figures.range_figure(soundings), folder / "range.png")
    if find_spec("trimesh") is None:
        return ["there is no soundings.ply without trimesh: pip install 'mitsonar[meshes]'"]
    soundings.save(folder / "soundings.ply")
    return []


# ---------------- Runs of vehicles


VEHICLE_RUN = RunKind("run of a vehicle", outputs=("vehicle.tum",), notes={"begun": list, "warnings": list})


@dataclass(frozen=True)
class VehicleReport:
    """Sensor names and warnings of a run; each sensor has a subfolder of its name."""

    sensors: tuple[str, ...]
    warnings: list[str]


def run_vehicle(
    simulator: VehicleSimulator, vehicle: Trajectory, options: RenderOptions, destination: Destination
) -> VehicleReport:
    """Run all sensors of a vehicle one after another, each into its own subfolder, or resume an interrupted run.

    Args:
        simulator: scene, sensors and moving bodies.
        vehicle: trajectory of the vehicle.
        options: output options of imaging sonars; their coordinate convention applies to all pose files.
        destination: folder, origin, and how the run begins; the folder holds ``vehicle.tum``, ``run.json`` and a folder for
            each sensor.

    Raises:
        MitsonarError: a sensor cannot follow the trajectory; or as in :func:`~mitsonar.simulation.runs.write_run`.
    """
    sensors, bodies = simulator.sensors(vehicle), simulator.bodies(vehicle)
    refuse_path(simulator.scene, sensors, vehicle, options.noise, exr=options.exr)
    others = [one.parent.name for one in Path(destination.folder).glob(f"*/{RUN_FILE}") if one.parent.name not in sensors]
    if destination.overwrite and others:
        raise MitsonarError(
            f"{destination.folder} contains runs that this run does not replace, {', '.join(sorted(others))}: remove their "
            "folders, or choose another -o"
        )
    settings = {
        "sensors": {name: _sensor_settings(one) for name, one in sensors.items()},
        "frame": options.frame,
        "poses_sha256": path_digest(vehicle),
    }

    def steps(run: RunDirectory) -> Steps:
        vehicle.save(run.path / "vehicle.tum", options.frame)
        begun, warnings = list(run.notes.get("begun") or []), list(run.notes.get("warnings") or [])
        for name, one in sensors.items():
            resumed = name in begun
            if not resumed:
                begun.append(name)
                yield 0, {"begun": begun}  # noted first: only a sensor that was begun is resumed in its folder
            inner = replace(destination, folder=run.path / name, resume=resumed, overwrite=not resumed, configuration={})
            sentences = _run_sensor(simulator.scene, one, vehicle, bodies, options, inner)
            warnings += [line for line in (f"{name}: {sentence}" for sentence in sentences) if line not in warnings]
            yield 0, {"warnings": warnings}

    directory = write_run(VEHICLE_RUN, settings, destination, steps, begun=[], warnings=[])
    return VehicleReport(tuple(sensors), directory.notes["warnings"])


def _run_sensor(
    scene: mi.Scene,
    sensor: Mounted,
    vehicle: Trajectory,
    bodies: MovingBodies,
    options: RenderOptions,
    destination: Destination,
) -> list[str]:
    """Run one sensor; return its warnings."""
    instrument, flown = sensor.instrument, sensor.path(vehicle)
    if isinstance(instrument, Sonar):
        return run(Simulator(scene, instrument, moving=bodies), flown, options, destination).warnings
    if isinstance(instrument, Sounder):
        return run_sounder(
            SounderSimulator(scene, instrument, moving=bodies), flown, destination, frame=options.frame
        ).warnings
    if isinstance(instrument, ChannelSonar):
        simulator = ChannelSimulator(scene, instrument, moving=bodies)
        return run_impulse(simulator, flown, velocities(flown), destination).warnings
    run_camera(CameraSimulator(scene, instrument, moving=bodies), flown, destination, frame=options.frame)
    return []


def _sensor_settings(sensor: Mounted) -> dict[str, Any]:
    """Return the keys and the mount that describe a sensor."""
    one = sensor.instrument
    keys = one.model_dump(mode="json") if isinstance(one, Sonar | Sounder | ChannelSonar) else camera_settings(one)
    return {"keys": keys, "mount": list(sensor.mount)}
