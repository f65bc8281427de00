"""How frames, scene and paths become a recording of Rerun: fan, polar image, levels, meshes, beams and poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsonar.bridges.live import FanEncoder
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.mapping.sources import FrameSource
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames, to_uint8
from mitsonar.simulation.scene import Triangles

__all__ = ["Shown", "first_eye", "lit_corners", "wedge_lines", "write_recording"]

CHUNK_FRAMES = 16
"""Number of frames that are read at once."""

BOX_COLOUR, TRUE, ESTIMATED, BEAMS = (110, 110, 140), (90, 200, 90), (240, 140, 40), (80, 170, 250)
WHOLE = ((168, 158, 132), (128, 132, 138), (160, 118, 92))
"""Colours that shapes take in turn; in a single colour a wreck would not stand out from its seabed."""

EYE_DIRECTION = np.array([0.54, -0.64, 0.54])
"""Initial direction from the sonar to the eye, in the axes (starboard, forward, up) of a level sonar."""

HALF_VIEW_RAD = np.radians(27.5)
"""Half of the viewer's field of view [rad]."""

LINE_RADIUS = rr.Radius.ui_points(1.5)


@dataclass(frozen=True)
class Shown:
    """The content of a recording.

    Attributes:
        name: name of the content, for messages.
        source: frames; None: only the scene.
        sonar: sonar whose beams are drawn as a wedge; None: no wedge.
        path: path of the sonar; None: the poses of the frames.
        shapes: shapes of the scene.
        estimated: further paths, keyed by name.
    """

    name: str
    source: FrameSource | None = None
    sonar: Sonar | None = None
    path: Trajectory | None = None
    shapes: Sequence[Triangles] = ()
    estimated: dict[str, Trajectory] = field(default_factory=dict)


def write_recording(shown: Shown, path: Path | None, progress: Callable[[int], None] = lambda done: None) -> list[str]:
    """Write a recording (.rrd), completely or not at all; without a path, open the viewer and send the recording to it.

    Args:
        shown: frames, scene and paths to show.
        path: file to write, or None.
        progress: called with the number of frames written since the last call.

    Returns:
        Names of the shapes that are shown as boxes only.

    Raises:
        MitsonarError: there is nothing to show.
    """
    if shown.source is None and not shown.shapes and shown.path is None:
        raise MitsonarError(f"{shown.name} has no frames, no scene and no path: there is nothing to show")
    recording = rr.RecordingStream("mitsonar", send_properties=False)
    temporary = None if path is None else path.with_name(f".{path.name}.part")
    if temporary is None:
        recording.spawn()
    else:
        recording.save(temporary)
    try:
        recording.send_blueprint(_blueprint(shown))
        _log_static(recording, shown)
        if shown.source is not None:
            _log_frames(recording, shown.source, progress)
        elif shown.path is not None:
            for pose, time in zip(shown.path.poses, shown.path.time_s, strict=True):
                recording.set_time("time", duration=float(time))
                _log_pose(recording, pose)
        recording.flush()
        recording.disconnect()
    except BaseException:
        recording.disconnect()
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        raise
    if temporary is not None and path is not None:
        temporary.replace(path)
    return [shape.name for shape in shown.shapes if not shape.whole]


def _blueprint(shown: Shown) -> rrb.Blueprint:
    """Arrange the views: the world next to fan, polar image and levels, as far as they exist."""
    eye_and_target = first_eye(shown)
    eye = (
        None
        if eye_and_target is None
        else rrb.EyeControls3D(position=eye_and_target[0], look_target=eye_and_target[1], eye_up=(0, 0, 1))
    )
    world_views = [rrb.Spatial3DView(origin="world", name="world", eye_controls=eye)]
    if shown.source is None:
        return rrb.Blueprint(*world_views, collapse_panels=True)
    has_world = bool(shown.shapes or shown.estimated or shown.path is not None or shown.source.poses is not None)
    lower_views = rrb.Horizontal(
        rrb.Spatial2DView(origin="polar", name="polar"),
        rrb.TimeSeriesView(origin="levels", name="levels", axis_y=rrb.ScalarAxis(range=(0, 1.02))),
        rrb.BarChartView(origin="levels_by_range", name="mean by range"),
    )
    images = rrb.Vertical(rrb.Spatial2DView(origin="fan", name="fan"), lower_views, row_shares=[2, 1])
    return rrb.Blueprint(rrb.Horizontal(*(world_views if has_world else []), images), collapse_panels=True)


def first_eye(shown: Shown) -> NDArray[np.float64] | None:
    """Return the initial position of the eye and its target ``(2, 3)`` [m], or None without a pose to look at.

    The eye sees paths and beams from behind and above. It does not try to see the whole scene, which may be far larger.
    """
    # 1. Collect all poses, and the volume of the beams at the first, middle and last one.
    pose_tables = [] if shown.path is None else [shown.path.poses]
    if shown.source is not None and shown.source.poses is not None:
        pose_tables.append(shown.source.poses)
    poses = np.concatenate([*pose_tables, *(path.poses for path in shown.estimated.values()), np.empty((0, 6))])
    poses = poses[np.isfinite(poses).all(axis=1)]  # a recording may lack depth or attitude
    if not len(poses):
        return None
    edges = np.zeros((1, 3)) if shown.sonar is None else np.concatenate(wedge_lines(shown.sonar))
    beam_corners = [vehicle_rotation(pose).apply(edges) + pose[:3] for pose in poses[[0, len(poses) // 2, -1]]]
    points = np.concatenate([poses[:, :3], *beam_corners])
    # 2. Move the eye back until a sphere around all points fits into the viewer's field of view.
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = float(np.linalg.norm(points - centre, axis=1).max())
    if radius == 0:
        return None
    direction = Rotation.from_rotvec([0, 0, -float(poses[len(poses) // 2, 5])]).apply(
        EYE_DIRECTION / np.linalg.norm(EYE_DIRECTION)
    )
    return np.stack([centre + radius / np.sin(HALF_VIEW_RAD) * direction, centre])


def wedge_lines(sonar: Sonar, steps: int = 16) -> list[NDArray[np.float64]]:
    """Return the edges of the volume that the beams cover, as lines ``(points, 3)`` [m] in (starboard, forward, up).

    Args:
        sonar: the sonar.
        steps: number of points of an arc.
    """
    # Two arcs across and two arcs up at both the nearest and the farthest range, then the four straight edges between them.
    bearing_limits = sonar.bearing_rad[[0, -1]] + np.array([-0.5, 0.5]) * sonar.beam_width_rad
    elevation = np.radians(sonar.elevation_fov_deg) / 2 * np.array([-1, 1])
    across, up = np.linspace(bearing_limits[0], bearing_limits[1], steps), np.linspace(elevation[0], elevation[1], steps)
    ranges = (max(sonar.range_min, 1e-3), sonar.range_max)
    lines = [radius * _direction(sonar, across, np.full(steps, edge)) for radius in ranges for edge in elevation]
    lines += [radius * _direction(sonar, np.full(steps, edge), up) for radius in ranges for edge in bearing_limits]
    for bearing in bearing_limits:
        for edge in elevation:
            lines.append(np.array(ranges)[:, None] * _direction(sonar, np.array([bearing]), np.array([edge])))
    return lines


def _direction(sonar: Sonar, b: NDArray[np.float64], e: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors ``(n, 3)`` for bearings ``b`` and elevations ``e`` [rad], in the sonar's definition of bearing."""
    if sonar.bearing == "azimuth":
        return np.stack([np.cos(e) * np.sin(b), np.cos(e) * np.cos(b), np.sin(e)], -1)
    return np.stack([np.sin(b), np.cos(b) * np.cos(e), np.cos(b) * np.sin(e)], -1)


def lit_corners(shape: Triangles) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the three corners of each face ``(3 faces, 3)`` [m], and the face's unit normal at each of them.

    Without normals the viewer draws all faces in one colour, and no relief is visible. The normal of a face without area is
    0.
    """
    corners = shape.vertices[shape.faces.astype(np.intp)]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    unit = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
    return corners.reshape(-1, 3), np.repeat(unit, 3, axis=0)


def _log_static(recording: rr.RecordingStream, shown: Shown) -> None:
    """Log the static content: the scene, the wedge of the beams in the sonar's axes, and the paths."""
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for number, shape in enumerate(shown.shapes):
        colour = WHOLE[number % len(WHOLE)] if shape.whole else BOX_COLOUR
        corners, normals = lit_corners(shape)
        mesh = rr.Mesh3D(vertex_positions=corners, vertex_normals=normals, albedo_factor=colour)
        recording.log(["world", "scene", f"{number:03d} {shape.name}"], mesh, static=True)
    if shown.sonar is not None:
        wedge = rr.LineStrips3D(wedge_lines(shown.sonar), colors=BEAMS, radii=LINE_RADIUS)
        recording.log("world/sonar/beams", wedge, static=True)
    poses = None if shown.path is None else shown.path.poses
    if poses is None and shown.source is not None:
        poses = shown.source.poses
    paths = {} if poses is None else {"path": (poses, TRUE)}
    paths |= {name: (path.poses, ESTIMATED if name == "estimated" else TRUE) for name, path in shown.estimated.items()}
    for name, (path_poses, colour) in paths.items():
        line = rr.LineStrips3D([path_poses[:, :3]], colors=colour, radii=LINE_RADIUS)
        recording.log(["world", "paths", name], line, static=True)


def _log_frames(recording: rr.RecordingStream, source: FrameSource, progress: Callable[[int], None]) -> None:
    """Log each frame at its time: fan, polar image, levels and pose; a few frames are in memory at a time."""
    encoder = FanEncoder()
    for first in range(0, len(source), CHUNK_FRAMES):
        index = np.arange(first, min(first + CHUNK_FRAMES, len(source)))
        frames = source.read(index)
        for position, number in enumerate(index):
            recording.set_time("frame", sequence=int(number))
            recording.set_time("time", duration=float(source.time_s[number]))
            if source.poses is not None:  # the frames themselves withhold position and heading from estimators
                _log_pose(recording, source.poses[number])
            _log_image(recording, encoder, frames, position)
        progress(len(index))


def _log_pose(recording: rr.RecordingStream, pose: NDArray[np.float64]) -> None:
    quaternion = vehicle_rotation(pose).as_quat(canonical=True)[0]
    recording.log("world/sonar", rr.Transform3D(translation=pose[:3], quaternion=rr.Quaternion(xyzw=quaternion)))


def _log_image(recording: rr.RecordingStream, encoder: FanEncoder, frames: SonarFrames, index: int) -> None:
    image = frames.image[index]
    levels = image if image.dtype == np.uint8 else to_uint8(image)
    recording.log("fan", rr.EncodedImage(contents=encoder.jpeg(frames, index), media_type="image/jpeg"))
    recording.log("polar", rr.Image(levels[::-1]))  # far ranges on top, as in the fan
    relative_levels = levels.astype(np.float32) / 255
    recording.log("levels/mean", rr.Scalars(float(relative_levels.mean())))
    recording.log("levels/brightest", rr.Scalars(float(relative_levels.max())))
    recording.log("levels_by_range", rr.BarChart(relative_levels.mean(axis=1), abscissa=frames.range_m))
