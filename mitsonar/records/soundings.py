"""Store soundings, echograms and DVL readings, convert soundings to points in the world, and read and write the files."""

from __future__ import annotations

import io
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sounder import FEWEST_BEAMS, Sounder
from mitsonar.instruments.views import directions
from mitsonar.io.files import parse_json, read_npz, write_atomic
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.motion.utm import UtmOrigin
from mitsonar.records.frames import SonarFrames

__all__ = [
    "DvlReadings",
    "Echogram",
    "Soundings",
    "body_of_pixels",
    "load_pings",
    "range_rates",
    "save_pings",
    "solve_velocity",
]


Array = NDArray[np.float64]

MEASURED = ("range_m", "level_db", "quality")

COLUMNS = ("time_s", "ping", "channel", "beam", "bearing_deg", *MEASURED, "x_m", "y_m", "z_m")
"""Columns of a CSV file."""


@dataclass(frozen=True)
class Soundings:
    """Detections of consecutive pings, one per beam; nan where a beam has none.

    Attributes:
        time_s: times of the pings ``(pings,)`` [s].
        poses: poses of the vehicle ``(pings, 6)`` [m, rad].
        sounder: the instrument.
        range_m: slant ranges ``(pings, channels, beams)`` [m].
        level_db: level of the strongest bin of each echo, of the same shape [dB].
        quality: fraction of a beam's energy above the noise that lies in its echo, 0..1, of the same shape.

    Raises:
        MitsonarError: inconsistent shapes.
    """

    time_s: Array
    poses: Array
    sounder: Sounder
    range_m: Array
    level_db: Array
    quality: Array

    def __post_init__(self) -> None:
        expected_shape = (len(self.time_s), len(self.sounder.channels), self.sounder.fan.beams)
        for name in MEASURED:
            if getattr(self, name).shape != expected_shape:
                raise MitsonarError(f"{name} must have the shape {expected_shape}: got {getattr(self, name).shape}")

    def __len__(self) -> int:
        return len(self.time_s)

    def __repr__(self) -> str:
        pings, fans, beams = self.range_m.shape
        return (
            f"Soundings({pings} pings of {fans} fans x {beams} beams, {int(self.found.sum()):,} of {self.range_m.size:,} "
            f"found, {self.sounder.name})"
        )

    @property
    def found(self) -> NDArray[np.bool_]:
        """Return which beams have an echo ``(pings, channels, beams)``."""
        return np.isfinite(self.range_m)

    def points(self) -> Array:
        """Return the positions of all soundings in the world ``(pings, channels, beams, 3)`` [m], on the beam axes."""
        fans = self.sounder.fan_poses(self.poses)
        rotation = vehicle_rotation(fans.reshape(-1, 6)).as_matrix().reshape(*fans.shape[:2], 3, 3)
        direction = np.einsum("pcij,bj->pcbi", rotation, self.sounder.directions())
        return np.asarray(fans[:, :, None, :3] + self.range_m[..., None] * direction)

    def save(self, path: str | Path) -> None:
        """Write a file atomically, in the format of its suffix.

        ``.npz`` holds everything; ``.csv``, ``.xyz`` and ``.ply`` hold the valid soundings.

        Raises:
            MitsonarError: another suffix, or no sounding to write.
        """
        path = Path(path)
        if path.suffix == ".npz":
            arrays = {name: getattr(self, name) for name in ("time_s", "poses", *MEASURED)}
            return save_pings(path, self.sounder, arrays)
        writers = {".csv": self._csv, ".xyz": self._xyz, ".ply": self._ply}
        if path.suffix not in writers:
            raise MitsonarError(f"soundings are written as .npz, {', '.join(writers)}: got {path.name}")
        if not self.found.any():
            raise MitsonarError(
                f"no beam has an echo, and {path.name} would be empty: move the window, or the instrument closer"
            )
        write_atomic(path, writers[path.suffix]())
        return None

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read an npz file written by :meth:`save`, or the ``soundings.npz`` in the folder of a run.

        Raises:
            MitsonarError: a file that cannot be read or has another format.
        """
        sounder, arrays = load_pings(_in_run(path, "soundings.npz"), MEASURED)
        return cls(arrays["time_s"], arrays["poses"], sounder, *(arrays[name] for name in MEASURED))

    def table(self) -> Array:
        """Return the valid soundings ``(found, columns)``, with :data:`mitsonar.records.soundings.COLUMNS`."""
        ping, channel, beam = np.nonzero(self.found)
        bearing = np.degrees(self.sounder.fan.bearing_rad)[beam]
        measured = [getattr(self, name)[self.found] for name in MEASURED]
        return np.column_stack([self.time_s[ping], ping, channel, beam, bearing, *measured, self.points()[self.found]])

    def _csv(self) -> bytes:
        text = io.StringIO()
        formats = ["%.9f", "%d", "%d", "%d", "%.6g", "%.6f", "%.3f", "%.4f", "%.6f", "%.6f", "%.6f"]
        np.savetxt(text, self.table(), fmt=formats, delimiter=",", header=",".join(COLUMNS), comments="")
        return text.getvalue().encode()

    def _xyz(self) -> bytes:
        text = io.StringIO()
        np.savetxt(text, self.points()[self.found], fmt="%.6f")
        return text.getvalue().encode()

    def _ply(self) -> bytes:
        """Return a binary PLY point cloud, in grey values by level."""
        import trimesh

        level = self.level_db[self.found]
        low, high = np.percentile(level, [2, 98])
        grey = np.clip((level - low) / max(high - low, 1e-9), 0, 1) * 255
        colours = np.column_stack([grey, grey, grey, np.full_like(grey, 255)]).astype(np.uint8)
        cloud: Any = trimesh.PointCloud(self.points()[self.found], colors=colours)  # type: ignore[no-untyped-call]
        return bytes(cloud.export(file_type="ply"))


# ---------------- Echograms


@dataclass(frozen=True)
class Echogram:
    """Levels over time and range of an instrument with one beam per fan, such as a side-scan waterfall.

    Attributes:
        time_s: times of the pings ``(pings,)`` [s].
        poses: poses of the vehicle ``(pings, 6)`` [m, rad].
        sounder: the instrument.
        levels: intensities ``(pings, channels, bins)`` float32, after the range-dependent gain of the instrument.
        height_m: height of the first fan over the surface straight below ``(pings,)`` [m]; nan if there is none.
        origin: where on the Earth the origin of the poses lies; None if that is unknown, as in a simulated world.

    Raises:
        MitsonarError: inconsistent shapes.
    """

    time_s: NDArray[np.float64]
    poses: NDArray[np.float64]
    sounder: Sounder
    levels: NDArray[np.float32]
    height_m: NDArray[np.float64]
    origin: UtmOrigin | None = None

    def __post_init__(self) -> None:
        expected_shape = (len(self.time_s), len(self.sounder.channels), self.sounder.fan.range_bins)
        if self.levels.shape != expected_shape:
            raise MitsonarError(f"levels must have the shape {expected_shape}: got {self.levels.shape}")

    def __len__(self) -> int:
        return len(self.time_s)

    def __repr__(self) -> str:
        return (
            f"Echogram({len(self)} pings of {', '.join(self.sounder.channels)}, {self.levels.shape[2]} bins to "
            f"{self.sounder.fan.range_max:g} m, {self.sounder.name})"
        )

    @property
    def range_m(self) -> NDArray[np.float64]:
        """Return the slant ranges of the bins ``(bins,)`` [m]."""
        return self.sounder.fan.range_m

    def channel(self, name: str) -> NDArray[np.float32]:
        """Return the levels of one fan ``(pings, bins)``.

        Raises:
            MitsonarError: unknown name.
        """
        if name not in self.sounder.channels:
            raise MitsonarError(f"unknown channel {name}: there are {', '.join(self.sounder.channels)}")
        return np.asarray(self.levels[:, self.sounder.channels.index(name)])

    def decibels(self, span_db: float = 60.0) -> NDArray[np.float32]:
        """Return the levels in dB relative to full scale, 0 to ``-span_db`` ``(pings, channels, bins)``.

        Full scale is the 99.9th percentile of all levels.
        """
        full_scale = float(np.percentile(self.levels, 99.9)) or float(self.levels.max()) or 1.0
        lowest = 10 ** (-span_db / 10)
        return np.asarray(10 * np.log10(np.clip(self.levels / np.float32(full_scale), lowest, 1)), dtype=np.float32)

    def save(self, path: str | Path) -> None:
        """Write an npz file atomically."""
        arrays = {name: getattr(self, name) for name in ("time_s", "poses", "levels", "height_m")}
        if self.origin is not None:
            arrays["origin"] = np.array([self.origin.zone, self.origin.south, self.origin.east_m, self.origin.north_m])
        save_pings(path, self.sounder, arrays)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file written by :meth:`save`, or the ``echogram.npz`` in the folder of a run.

        Raises:
            MitsonarError: a file that cannot be read or has another format.
        """
        path = _in_run(path, "echogram.npz")
        sounder, arrays = load_pings(path, ("levels", "height_m"), constants=("origin",))
        levels, height_m = arrays["levels"].astype(np.float32, copy=False), arrays["height_m"]
        if height_m.ndim != 1 or (height_m <= 0).any() or not np.isfinite(levels).all() or (levels < 0).any():
            raise MitsonarError(
                f"{path} is damaged: levels must be finite and not negative, with one height above 0 or nan for each ping"
            )
        origin = None
        if "origin" in arrays:
            if arrays["origin"].shape != (4,):
                raise MitsonarError(f"{path} is damaged: origin must be 4 numbers, got {arrays['origin'].shape}")
            zone, south, east_m, north_m = arrays["origin"].tolist()
            origin = UtmOrigin(int(zone), bool(south), east_m, north_m)
        return cls(arrays["time_s"], arrays["poses"], sounder, levels, height_m, origin)


# ---------------- Range rates of pixels


def range_rates(frames: SonarFrames, velocity: Array | None = None) -> NDArray[np.float32]:
    """Compute the range rate of the strongest echo in each pixel, like ``image`` [m/s]; nan without an echo.

    It is (v_echo - v_sonar) . d, which is positive for a receding echo. A stationary sonar and scene give 0. Deforming
    objects are assumed to move with the axes of their body.

    Args:
        frames: frames with poses, rendered with labels.
        velocity: velocity of the sonar in world axes ``(frames, 3)`` [m/s]; default: from its poses and times.

    Raises:
        MitsonarError: no labels, no poses, or a single frame without a velocity.
    """
    if frames.elevation_rad is None or frames.poses is None:
        raise MitsonarError("range rates need labels and poses: render with --labels")
    time = frames.time_s if frames.time_s.ndim == 1 else frames.time_s.mean(axis=1)
    if velocity is None and len(frames) < 2:
        raise MitsonarError("a single frame does not determine the velocity of the sonar: give velocity (1, 3) in m/s")
    # 1. Velocity of the sonar.
    sonar_velocity = (
        np.gradient(frames.poses[:, :3], time, axis=0) if velocity is None else np.asarray(velocity, dtype=float)
    )
    if sonar_velocity.shape != (len(frames), 3):
        raise MitsonarError(f"the sonar's velocity must be ({len(frames)}, 3) in m/s: got {sonar_velocity.shape}")
    range_rate = np.full(frames.image.shape, np.nan, np.float32)
    bodies = body_of_pixels(frames)
    for number in range(len(frames)):
        # 2. Direction and position of the echo of each pixel in the world, from its bearing and elevation.
        bins, beams = np.nonzero(np.isfinite(frames.elevation_rad[number]))
        elevation = frames.elevation_rad[number, bins, beams]
        poses = frames.poses[None, number] if frames.beam_poses is None else frames.beam_poses[number]
        pose_index = np.zeros_like(beams) if frames.beam_poses is None else beams
        local_direction = directions(frames.sonar.bearing, frames.bearing_rad[beams], elevation)
        direction = np.einsum("nij,nj->ni", vehicle_rotation(poses).as_matrix()[pose_index], local_direction)
        position = poses[pose_index, :3] + direction * frames.range_m[bins, None]
        # 3. Relative velocity, projected on the direction.
        relative_velocity = _velocity_at(frames, number, bodies[number, bins, beams], position) - sonar_velocity[number]
        range_rate[number, bins, beams] = (relative_velocity * direction).sum(axis=1)
    return range_rate


def body_of_pixels(frames: SonarFrames) -> NDArray[np.int32]:
    """Return the index in ``body_names`` of the body that each pixel shows, like ``image``; -1 for no moving body.

    Raises:
        MitsonarError: no labels.
    """
    if frames.object_id is None or frames.shape_id is None:
        raise MitsonarError("bodies of pixels need labels: render with --labels")
    body_index = np.full(frames.image.shape, -1, np.int32)
    for number, name in enumerate(frames.body_names):
        if name in frames.object_names:
            body_index[frames.object_id == frames.object_names.index(name)] = number
        if name in frames.shape_names:  # a mesh that numbers its objects
            body_index[frames.shape_id == frames.shape_names.index(name)] = number
    return body_index


def _velocity_at(frames: SonarFrames, number: int, body: NDArray[np.int32], position: Array) -> Array:
    """Return the velocity at positions ``(n, 3)`` in one frame: v + w x r of the body there, or 0 for stationary parts."""
    velocity = np.zeros_like(position)
    if frames.body_poses is None or frames.body_velocities is None:
        return velocity
    on_body = body >= 0
    body_velocity, origin = frames.body_velocities[number, body[on_body]], frames.body_poses[number, body[on_body], :3]
    velocity[on_body] = body_velocity[:, :3] + np.cross(body_velocity[:, 3:], position[on_body] - origin)
    return velocity


# ---------------- DVL readings


AXES = ("starboard", "forward", "up")


@dataclass(frozen=True)
class DvlReadings:
    """DVL readings of consecutive pings; nan where bottom lock is lost.

    Attributes:
        soundings: ranges of the beams.
        range_rate: range rates of the beams, positive for increasing range ``(pings, beams)`` [m/s]; nan without an echo.
        velocity: velocity of the vehicle in its own axes, starboard, forward, up ``(pings, 3)`` [m/s].
        covariance: covariance of the velocity ``(pings, 3, 3)``, from the noise of a range rate.
    """

    soundings: Soundings
    range_rate: Array
    velocity: Array
    covariance: Array

    @classmethod
    def of(cls, soundings: Soundings, range_rate: Array) -> Self:
        """Compute velocities from range rates ``(pings, beams)``, ignoring beams without an echo."""
        sounder = soundings.sounder
        valid_rates = np.where(soundings.found[..., 0], range_rate, np.nan)
        return cls(soundings, valid_rates, *solve_velocity(valid_rates, sounder.axes, sounder.beam_std_m_s))

    @property
    def locked(self) -> NDArray[np.bool_]:
        """Return whether the velocity is known in each ping ``(pings,)``."""
        return np.asarray(np.isfinite(self.velocity).all(axis=1), dtype=np.bool_)

    @property
    def altitude_m(self) -> Array:
        """Return the height of the vehicle over the mean of the points where the beams hit ``(pings,)`` [m]."""
        depth = self.soundings.poses[:, None, 2] - self.soundings.points()[:, :, 0, 2]
        valid = np.isfinite(depth)
        return np.where(valid.any(axis=1), np.nansum(depth, axis=1) / np.maximum(valid.sum(axis=1), 1), np.nan)

    def level(self) -> tuple[Array, Array]:
        """Return velocities ``(pings, 3)`` and covariances ``(pings, 3, 3)`` in level axes: sideways, forward, up.

        Pitch and roll are taken from the poses, as in a DVL with an attitude sensor.
        """
        upright = self.soundings.poses.copy()
        upright[:, 3:5] = 0
        rotation = (vehicle_rotation(upright).inv() * vehicle_rotation(self.soundings.poses)).as_matrix()
        return np.einsum("pij,pj->pi", rotation, self.velocity), rotation @ self.covariance @ rotation.swapaxes(1, 2)

    def save(self, path: str | Path) -> None:
        """Write a CSV file atomically; unknown values are empty cells."""
        beams = len(self.soundings.sounder.channels)
        std = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        names = [f"{axis}_m_s" for axis in AXES] + [f"{axis}_std_m_s" for axis in AXES] + ["altitude_m"]
        names += [f"range_{k}_m" for k in range(1, beams + 1)] + [f"range_rate_{k}_m_s" for k in range(1, beams + 1)]
        table = np.column_stack([self.velocity, std, self.altitude_m, self.soundings.range_m[..., 0], self.range_rate])
        text = io.StringIO()
        text.write(",".join(["time_s", "locked", *names]) + "\n")
        for time_s, locked, row in zip(self.soundings.time_s, self.locked, table, strict=True):
            cells = ["" if np.isnan(value) else f"{value:.6f}" for value in row]
            text.write(",".join([f"{time_s:.9f}", str(int(locked)), *cells]) + "\n")
        write_atomic(Path(path), text.getvalue().encode())


def solve_velocity(range_rate: Array, axes: Array, std_m_s: float) -> tuple[Array, Array]:
    """Solve for velocities by least squares, where each range rate is minus the velocity along its beam.

    Args:
        range_rate: range rates of the beams ``(pings, beams)`` [m/s], nan if missing.
        axes: axes of the beams ``(beams, 3)``, unit vectors.
        std_m_s: standard deviation of a range rate [m/s].

    Returns:
        Velocities ``(pings, 3)`` and covariances ``(pings, 3, 3)``, nan with fewer than three beams or coplanar beams.
    """
    valid = np.isfinite(range_rate)
    weight = valid.astype(float)
    information = np.einsum("pb,bi,bj->pij", weight, axes, axes)
    right = -np.einsum("pb,bi->pi", np.where(valid, range_rate, 0), axes)
    determined = (valid.sum(axis=1) >= FEWEST_BEAMS) & (np.linalg.cond(information) < 1e6)
    inverse = np.full(information.shape, np.nan)
    inverse[determined] = np.linalg.inv(information[determined])
    return np.einsum("pij,pj->pi", inverse, right), inverse * std_m_s**2


# ---------------- npz files of sounders


def save_pings(path: str | Path, sounder: Sounder, arrays: dict[str, NDArray[Any]]) -> None:
    """Write arrays and the instrument, as JSON, to an npz file, atomically."""
    buffer = io.BytesIO()
    fields = sounder.model_dump(mode="json", exclude={"fan"}) | {"fan": sounder.fan.model_dump(mode="json")}
    table: dict[str, Any] = {"sounder": np.array(json.dumps(fields)), **arrays}
    np.savez_compressed(buffer, **table)
    write_atomic(Path(path), buffer.getvalue())


def _in_run(path: str | Path, name: str) -> Path:
    """Return the file of this name in a folder, or the path itself if it is none."""
    return Path(path) / name if os.path.isdir(path) else Path(path)


def load_pings(
    path: str | Path, names: tuple[str, ...], constants: tuple[str, ...] = ()
) -> tuple[Sounder, dict[str, NDArray[Any]]]:
    """Read a file of :func:`save_pings`: the instrument and the named arrays, checked for type and length.

    Infinite values are rejected; nan is allowed.

    Args:
        path: path of the file.
        names: names of arrays with a row for each ping, which the file must have in addition to times and poses.
        constants: names of finite arrays without such rows, which the file may have.

    Raises:
        MitsonarError: a file that cannot be read or has another format.
    """
    try:
        table = read_npz(path)
    except MitsonarError:
        raise
    except Exception as error:  # damaged bytes raise many types of errors
        reason = " ".join(str(error).split())[:160]
        raise MitsonarError(f"cannot read {path}: {reason}; give a file that `mitsonar sound` wrote") from None
    missing = [name for name in (*names, "sounder", "time_s", "poses") if name not in table]
    if missing:
        raise MitsonarError(f"{path} lacks {missing[0]}: give a file that `mitsonar sound` wrote")
    fields: Any = parse_json(str(table.pop("sounder")), str(path))
    if not isinstance(fields, dict) or not isinstance(fields.get("fan"), dict):
        raise MitsonarError(f"{path} describes no instrument: give a file that `mitsonar sound` wrote")
    sounder = Sounder.create(**{**fields.pop("fan"), **fields})
    arrays = {name: table[name] for name in (*names, "time_s", "poses")}
    pings = len(arrays["time_s"]) if arrays["time_s"].ndim == 1 else -1
    for name, values in arrays.items():
        if values.dtype.kind != "f" or not values.ndim or len(values) != pings or np.isinf(values).any():
            raise MitsonarError(f"{path} is damaged: {name} must be {pings} rows of numbers")
    if arrays["poses"].shape != (pings, 6) or not pings:
        raise MitsonarError(f"{path} is damaged: poses must be (pings, 6), got {arrays['poses'].shape}")
    if not (np.isfinite(arrays["poses"]).all() and np.isfinite(arrays["time_s"]).all()):
        raise MitsonarError(f"{path} is damaged: poses and times must be finite")
    for name in set(constants) & set(table):
        if table[name].dtype.kind != "f" or not np.isfinite(table[name]).all():
            raise MitsonarError(f"{path} is damaged: {name} must be finite numbers")
        arrays[name] = table[name]
    return sounder, arrays
