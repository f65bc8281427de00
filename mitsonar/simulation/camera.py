"""Pictures of a camera on a vehicle: Mitsuba renders them, with the bodies of the scene where they are at the time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError
from mitsonar.motion.bodies import Moving, MovingBodies
from mitsonar.motion.pose import to_world_matrices, vehicle_rotation
from mitsonar.plugins.native_plugins import load_dict
from mitsonar.simulation.moving_scene import SceneMotion, motion_in
from mitsonar.simulation.scene_watch import SceneWatch

__all__ = ["CameraSimulator", "camera_of", "told_of"]

PATH_DEPTH = 8
"""Bounces of light in a scene without an integrator of its own for cameras."""


def camera_of(fov_deg: float, width: int, height: int, samples: int) -> mi.Sensor:
    """Return a pinhole camera of Mitsuba; ``fov_deg`` is across the picture."""
    pixel = "luminance" if "mono" in str(mi.variant()) else "rgb"
    made = load_dict(
        {
            "type": "perspective",
            "fov": fov_deg,
            "fov_axis": "x",
            "near_clip": 0.01,
            "film": {"type": "hdrfilm", "width": width, "height": height, "pixel_format": pixel},
            "sampler": {"type": "independent", "sample_count": samples},
        }
    )
    assert isinstance(made, mi.Sensor)
    return made


class CameraSimulator:
    """Renders what a camera of Mitsuba sees from poses in a scene.

    The scene's integrator is used; without one, paths of light of at most 8 bounces. The samples a pixel are those of the
    camera's sampler.

    Args:
        scene: with emitters.
        camera: of Mitsuba, perspective or another.
        moving: trajectories of bodies, as of :class:`mitsonar.Simulator`.

    Raises:
        MitsonarError: a scene without light.
    """

    def __init__(self, scene: mi.Scene, camera: mi.Sensor, *, moving: Moving | MovingBodies | None = None) -> None:
        if not scene.emitters():
            raise MitsonarError('a camera needs light: add an emitter to the scene, such as <emitter type="constant"/>')
        self.camera, self._given = camera, (scene, moving)
        self._watch = SceneWatch(scene)
        self._build()
        own = scene.integrator()
        sees = own is not None and not type(own).__module__.startswith("mitsonar")
        self.integrator = own if sees else load_dict({"type": "path", "max_depth": PATH_DEPTH})
        self.samples = int(camera.sampler().sample_count())

    def _build(self) -> None:
        """Make the scene that is rendered: that given, or one with the bodies that move."""
        scene, moving = self._given
        self.motion = motion_in(scene, moving)
        self.scene = scene if self.motion is None else _with_instances(scene, self.motion)

    def pictures(self, poses: ArrayLike, time_s: ArrayLike, *, first: int = 0) -> Iterator[NDArray[np.uint8]]:
        """Render pictures, one a pose: ``(height, width)`` or ``(height, width, 3)``, sRGB.

        Args:
            poses: of the camera ``(pictures, 6)`` [m, rad]; it looks ahead.
            time_s: of the pictures ``(pictures,)`` [s].
            first: number of the first, of which the noise of rendering is a function.
        """
        if self._watch.changed() is not None and self.motion is not None:
            self._build()
        table, time = np.atleast_2d(np.asarray(poses, dtype=float)), np.atleast_1d(np.asarray(time_s, dtype=float))
        grey = "mono" in str(mi.variant())
        place = mi.Transform4f(self.camera.world_transform().matrix)
        try:
            for number, (pose, now) in enumerate(zip(table, time, strict=True), first):
                if self.motion is not None:
                    _place(self.scene, self.motion, float(now))
                _turn(self.camera, mi.Transform4f(to_world_matrices(pose)[0].tolist()))
                picture = self._picture(number)
                yield picture[..., 0] if grey and picture.ndim == 3 else picture
        finally:
            _turn(self.camera, place)  # a scene's camera stays where the scene has it

    def _picture(self, number: int) -> NDArray[np.uint8]:
        """Render the scene as it is now; ``number`` seeds the noise of rendering."""
        module: Any = mi  # its types lack conversions of seeds and films
        film = module.render(self.scene, sensor=self.camera, integrator=self.integrator, spp=self.samples, seed=number)
        return np.array(module.util.convert_to_bitmap(film))


def told_of(camera: mi.Sensor) -> dict[str, str]:
    """Return what tells a camera again, but for its place."""
    values: Any = mi.traverse(camera)
    told = {name: str(values[name]) for name in values.keys() if not name.endswith("to_world")}  # noqa: SIM118  no dict
    return told | {"type": type(camera).__name__}


def _turn(camera: mi.Sensor, to_world: mi.Transform4f) -> None:
    """Put a camera at a place."""
    values = mi.traverse(camera)
    values["to_world"] = to_world
    values.update()


def _with_instances(scene: mi.Scene, motion: SceneMotion) -> mi.Scene:
    """Return the scene with an instance for each body that moves."""
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
    made = load_dict(parts, optimize=False)
    for shape, name in zip(motion.shapes, names, strict=True):
        shape.set_id(name)  # the loader has changed it
    assert isinstance(made, mi.Scene)
    return made


def _place(scene: mi.Scene, motion: SceneMotion, time_s: float) -> None:
    """Move the instances, and the vertices of what deforms, to where they are at a time [s]."""
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
