"""Vehicle simulation: what several sonars, hydrophones and cameras record along one trajectory in one scene."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, Union

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import NoiseModel, refuse_noise
from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import Sounder, load_sonar, load_sounder, sonar_from
from mitsonar.instruments.vehicle import SensorKeys, check_sensor_name, load_vehicle_recipe
from mitsonar.motion.bodies import Moving, MovingBodies
from mitsonar.motion.pose import Pose, mount_between, mounted, pose_from_to_world, to_world_matrices, vehicle_rotation
from mitsonar.motion.trajectory import Trajectory
from mitsonar.plugins.native_plugins import load_dict
from mitsonar.records.frames import SonarFrames
from mitsonar.records.responses import ImpulseResponses
from mitsonar.records.soundings import Echogram, Soundings
from mitsonar.simulation.channel import ChannelSimulator
from mitsonar.simulation.device import ensure_variant
from mitsonar.simulation.moving import SceneMotion, SceneWatch, motion_in
from mitsonar.simulation.runs import path_to_render
from mitsonar.simulation.scene import MotionSpec, motions_of
from mitsonar.simulation.simulator import Simulator
from mitsonar.simulation.sounding import SounderSimulator

__all__ = [
    "CameraSimulator",
    "Mounted",
    "Record",
    "VehicleFile",
    "VehicleSimulator",
    "camera_of",
    "camera_settings",
    "load_vehicle",
    "refuse_path",
    "sensors_in",
]


Instrument: TypeAlias = Union[Sonar, Sounder, ChannelSonar, "mi.Sensor"]
"""Instrument that can be mounted on a vehicle; a Mitsuba sensor is a camera."""

Record: TypeAlias = SonarFrames | Echogram | Soundings | ImpulseResponses | NDArray[np.uint8]
"""Record of a sensor; for a camera, pictures ``(frames, height, width)``, in colour with a last axis of 3."""

MIDDLE = Pose(0, 0, 0)

FARTHEST_M = 100.0
"""Largest distance of a sensor from its vehicle [m]; beyond it, the scene shows another place than the path's start."""


@dataclass(frozen=True)
class Mounted:
    """Sensor and its pose in the vehicle's axes (starboard, forward, up)."""

    instrument: Instrument
    mount: Pose = MIDDLE

    def __repr__(self) -> str:
        shown = str(self.instrument) if isinstance(self.instrument, Sonar | Sounder | ChannelSonar) else "a camera"
        return f"Mounted({shown} at {self.mount})"

    def path(self, vehicle: Trajectory) -> Trajectory:
        """Return the trajectory of the sensor for a trajectory of the vehicle."""
        return Trajectory(mounted(vehicle.poses, self.mount), vehicle.time_s)


class VehicleFile(NamedTuple):
    """Sensors of a vehicle keyed by name, and the motion specifications of bodies in its file."""

    sensors: dict[str, Mounted]
    motion_specs: list[MotionSpec]


class VehicleSimulator:
    """Simulator of all sensors of a vehicle, each independent of the others: sonars do not receive each other.

    Args:
        scene: a Mitsuba scene.
        sensors: sensors keyed by name; default: the sensors in the scene, keyed by id.
        moving: trajectories of bodies, as in :class:`mitsonar.Simulator`; ``vehicle`` denotes the vehicle's trajectory.

    Raises:
        MitsonarError: the scene has no sensors.
    """

    def __init__(
        self, scene: mi.Scene, sensors: Mapping[str, Mounted] | None = None, *, moving: Moving | None = None
    ) -> None:
        self.scene, self._sensors = scene, sensors
        self.moving = motions_of(scene) if moving is None else moving

    def __repr__(self) -> str:
        names = "those of the scene" if self._sensors is None else ", ".join(self._sensors)
        return f"VehicleSimulator(sensors {names[:160]}; a scene of {len(self.scene.shapes())} shapes)"

    def sensors(self, vehicle: Trajectory) -> Mapping[str, Mounted]:
        """Return the sensors keyed by name; sensors in the scene are mounted as it shows them at the first pose."""
        return sensors_in(self.scene, Pose.from_row(vehicle.poses[0])) if self._sensors is None else self._sensors

    def bodies(self, vehicle: Trajectory) -> MovingBodies:
        """Return the bodies that move while the vehicle follows a trajectory."""
        return MovingBodies.of(self.moving, vehicle=vehicle)

    def render(self, vehicle: Trajectory, *, labels: bool = False) -> dict[str, Record]:
        """Render all sensors into memory; return frames, soundings, responses or pictures, keyed by sensor name.

        Args:
            vehicle: poses and times; each sensor pings at each of them, and a rotating head sweeps as often as it can.
            labels: whether to render per-pixel ground truth for imaging sonars.
        """
        bodies, sensors = self.bodies(vehicle), self.sensors(vehicle)
        refuse_path(self.scene, sensors, vehicle)
        return {name: self._record(one, vehicle, bodies, labels) for name, one in sensors.items()}

    def _record(self, one: Mounted, vehicle: Trajectory, bodies: MovingBodies, labels: bool) -> Record:
        path, instrument = one.path(vehicle), one.instrument
        if isinstance(instrument, Sonar):
            return Simulator(self.scene, instrument, moving=bodies).render(path, labels=labels)
        if isinstance(instrument, Sounder):
            sounder = SounderSimulator(self.scene, instrument, moving=bodies)
            return sounder.echogram(path) if instrument.kind == "sidescan" else sounder.soundings(path)
        if isinstance(instrument, ChannelSonar):
            return ChannelSimulator(self.scene, instrument, moving=bodies).responses(path)
        return np.stack(list(CameraSimulator(self.scene, instrument, moving=bodies).pictures(path.poses, path.time_s)))


def refuse_path(
    scene: mi.Scene,
    sensors: Mapping[str, Mounted],
    vehicle: Trajectory,
    noise: NoiseModel | None = None,
    *,
    exr: bool = False,
) -> None:
    """Refuse a trajectory or scene that one of the sensors cannot follow, before any sensor is rendered.

    Args:
        scene: any Mitsuba scene.
        sensors: sensors keyed by name.
        vehicle: trajectory of the vehicle.
        noise: noise model for imaging sonars.
        exr: whether the echoes of each ray of imaging sonars are to be stored.

    Raises:
        MitsonarError: the trajectory is too short for a sweep, noise is given for a sonar that already includes noise, a
            frame whose echoes are to be stored is several pings, or hydrophones would hear instances; the message names the
            sensor.
    """
    from mitsonar.simulation.scatterers import refuse_instances

    for name, one in sensors.items():
        try:
            if isinstance(one.instrument, Sonar):
                path_to_render(one.instrument, vehicle, exr=exr)
                refuse_noise(noise, one.instrument)
            elif isinstance(one.instrument, ChannelSonar) and one.instrument.model == "scatterers":
                refuse_instances(scene.shapes())
        except MitsonarError as error:
            raise MitsonarError(f"sensor {name}: {error}") from None


def sensors_in(scene: mi.Scene, vehicle: Pose) -> dict[str, Mounted]:
    """Return the sensors of a scene keyed by id, with their mounts relative to a vehicle at the given pose.

    Raises:
        MitsonarError: there are no sensors; two have the same id; a sensor is far from the vehicle, or scaled.
    """
    from mitsonar.plugins.channel_sonar_sensor import is_channel_sonar
    from mitsonar.plugins.imaging_sonar_sensor import is_imaging_sonar

    sensors: dict[str, Mounted] = {}
    for number, sensor in enumerate(scene.sensors()):
        name = sensor.id() or f"sensor{number}"
        check_sensor_name(name)
        if name in sensors:
            raise MitsonarError(f"two sensors of the scene have the id {name}: give them different ids")
        untyped: Any = sensor
        matrix = np.array(sensor.world_transform().matrix, dtype=float).reshape(4, 4)
        sensor_pose = untyped.pose if is_imaging_sonar(sensor) else pose_from_to_world(matrix)
        distance_m = math.dist(sensor_pose[:3], vehicle[:3])
        if distance_m > FARTHEST_M:
            raise MitsonarError(
                f"the sensor {name} is {distance_m:.3g} m from the path's first pose: the scene must show the vehicle "
                "there; move the sensors, or the path"
            )
        sonar = is_imaging_sonar(sensor) or is_channel_sonar(sensor)
        sensors[name] = Mounted(untyped.sonar if sonar else sensor, mount_between(vehicle, sensor_pose))
    if not sensors:
        raise MitsonarError("the scene has no sensors: add some, or give a vehicle's file")
    return sensors


def load_vehicle(file: str | Path) -> VehicleFile:
    """Read the sensors of a vehicle and the motions of bodies from a YAML file; paths are relative to its folder.

    Raises:
        MitsonarError: the file is unreadable, has wrong keys, or names unknown presets.
    """
    recipe, folder = load_vehicle_recipe(file), Path(file).parent
    sensors = {}
    for name, keys in recipe.sensors.items():
        sensors[name] = Mounted(_instrument(keys, folder, name), Pose.from_degrees(keys.mount))
    return VehicleFile(sensors, [MotionSpec(name, motion, [folder]) for name, motion in recipe.moving.items()])


def _instrument(keys: SensorKeys, folder: Path, name: str) -> Instrument:
    """Return the instrument that the keys of a sensor describe."""
    if isinstance(keys.sonar, dict):
        return sonar_from({"name": name, **keys.sonar})
    if keys.sonar is not None:
        return load_sonar(_file(keys.sonar, folder))
    if keys.instrument is not None:
        return load_sounder(_file(keys.instrument, folder))
    if keys.hydrophones is not None:
        return ChannelSonar.create(**{"name": name, **keys.hydrophones})
    assert keys.camera is not None
    ensure_variant()

    return camera_of(keys.camera.fov_deg, keys.camera.width, keys.camera.height, keys.camera.samples)


def _file(name: str, folder: Path) -> str:
    """Return the path of a YAML file relative to the vehicle's folder; other names are returned unchanged."""
    return str(folder / name) if name.lower().endswith((".yaml", ".yml")) else name


# ---------------- Cameras, rendered by Mitsuba


PATH_DEPTH = 8
"""Maximum depth of light paths in a scene without an integrator for cameras."""


def camera_of(fov_deg: float, width: int, height: int, samples: int) -> mi.Sensor:
    """Create a Mitsuba pinhole camera; ``fov_deg`` is the horizontal field of view."""
    pixel = "luminance" if "mono" in str(mi.variant()) else "rgb"
    camera = load_dict(
        {
            "type": "perspective",
            "fov": fov_deg,
            "fov_axis": "x",
            "near_clip": 0.01,
            "film": {"type": "hdrfilm", "width": width, "height": height, "pixel_format": pixel},
            "sampler": {"type": "independent", "sample_count": samples},
        }
    )
    assert isinstance(camera, mi.Sensor)
    return camera


class CameraSimulator:
    """Simulator of a Mitsuba camera's pictures from poses in a scene, with moving bodies at their poses at the time.

    The scene's integrator is used; without one, a path tracer with a maximum depth of 8. The camera's sampler gives the
    number of samples per pixel.

    Args:
        scene: scene with emitters.
        camera: Mitsuba camera, perspective or another kind.
        moving: trajectories of bodies, as in :class:`mitsonar.Simulator`.

    Raises:
        MitsonarError: the scene has no light.
    """

    def __init__(self, scene: mi.Scene, camera: mi.Sensor, *, moving: Moving | MovingBodies | None = None) -> None:
        if not scene.emitters():
            raise MitsonarError('a camera needs light: add an emitter to the scene, such as <emitter type="constant"/>')
        self.camera, self._given = camera, (scene, moving)
        self._watch = SceneWatch(scene)
        self._build()
        integrator = scene.integrator()
        for_cameras = integrator is not None and not type(integrator).__module__.startswith("mitsonar")
        self.integrator = integrator if for_cameras else load_dict({"type": "path", "max_depth": PATH_DEPTH})
        self.samples = int(camera.sampler().sample_count())

    def _build(self) -> None:
        """Build the scene to render: the given scene, or a copy of it with the moving bodies as instances."""
        scene, moving = self._given
        self.motion = motion_in(scene, moving)
        self.scene = scene if self.motion is None else _with_instances(scene, self.motion)

    def pictures(self, poses: ArrayLike, time_s: ArrayLike, *, first: int = 0) -> Iterator[NDArray[np.uint8]]:
        """Yield one sRGB picture for each pose: ``(height, width)`` or ``(height, width, 3)``.

        Args:
            poses: poses of the camera ``(pictures, 6)`` [m, rad]; it looks ahead.
            time_s: times of the pictures ``(pictures,)`` [s].
            first: number of the first picture; the numbers seed the rendering noise.
        """
        if self._watch.changed() is not None and self.motion is not None:
            self._build()
        table, time = np.atleast_2d(np.asarray(poses, dtype=float)), np.atleast_1d(np.asarray(time_s, dtype=float))
        grey = "mono" in str(mi.variant())
        scene_pose = mi.Transform4f(self.camera.world_transform().matrix)
        try:
            for number, (pose, moment_s) in enumerate(zip(table, time, strict=True), first):
                if self.motion is not None:
                    _place(self.scene, self.motion, float(moment_s))
                _turn(self.camera, mi.Transform4f(to_world_matrices(pose)[0].tolist()))
                picture = self._picture(number)
                yield picture[..., 0] if grey and picture.ndim == 3 else picture
        finally:
            _turn(self.camera, scene_pose)  # restore the pose that the scene gives the camera

    def _picture(self, number: int) -> NDArray[np.uint8]:
        """Render the scene in its current state; ``number`` seeds the rendering noise."""
        module: Any = mi  # the type stubs lack conversions of seeds and films
        film = module.render(self.scene, sensor=self.camera, integrator=self.integrator, spp=self.samples, seed=number)
        return np.array(module.util.convert_to_bitmap(film))


def camera_settings(camera: mi.Sensor) -> dict[str, str]:
    """Return the parameters and the type of a camera as strings, without its pose."""
    values: Any = mi.traverse(camera)
    settings = {name: str(values[name]) for name in values.keys() if not name.endswith("to_world")}  # noqa: SIM118  no dict
    return settings | {"type": type(camera).__name__}


def _turn(camera: mi.Sensor, to_world: mi.Transform4f) -> None:
    """Set the pose of a camera."""
    values = mi.traverse(camera)
    values["to_world"] = to_world
    values.update()


def _with_instances(scene: mi.Scene, motion: SceneMotion) -> mi.Scene:
    """Build a scene with an instance for each moving body."""
    parts: dict[str, Any] = {"type": "scene"}
    for number, emitter in enumerate(scene.emitters()):
        if emitter.get_shape() is None:
            parts[f"emitter{number}"] = emitter
    for number, shape in enumerate(motion.shapes):
        if shape.id() in motion.numbers:
            parts[f"group{number}"] = {"type": "shapegroup", "shape": shape}
        else:
            parts[f"shape{number}"] = shape
    for body, name in enumerate(motion.bodies.shapes):
        group = {"type": "ref", "id": f"group{motion.numbers[name]}"}
        parts[f"body{body}"] = {"type": "instance", "group": group}
    names = [shape.id() for shape in motion.shapes]
    instanced = load_dict(parts, optimize=False)
    for shape, name in zip(motion.shapes, names, strict=True):
        shape.set_id(name)  # restore the id, which the loader changes
    assert isinstance(instanced, mi.Scene)
    return instanced


def _place(scene: mi.Scene, motion: SceneMotion, time_s: float) -> None:
    """Move the instances, and the vertices of deforming meshes, to their positions at a time [s]."""
    values: Any = mi.traverse(scene)
    for one in motion.deformed:
        group = f"group{motion.numbers[one.mesh.id()]}."
        (key,) = [key for key in values.keys() if key.startswith(group) and key.endswith("vertex_positions")]  # noqa: SIM118
        values[key] = mi.Float(one.vertices(time_s).ravel().tolist())
    for body, pose in enumerate(motion.bodies.poses(time_s)[0]):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = vehicle_rotation(pose).as_matrix()[0], pose[:3]
        values[f"body{body}.to_world"] = mi.Transform4f(matrix.tolist())
    values.update()
