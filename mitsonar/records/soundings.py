"""Soundings: a range in each beam of each ping, as points in the world, in files of several kinds."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sounder import FEWEST_BEAMS, Sounder
from mitsonar.instruments.views import directions
from mitsonar.io.files import parse_json, read_npz, write_whole
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.records.frames import SonarFrames

__all__ = [
    "DvlReadings",
    "Echogram",
    "Soundings",
    "body_of_pixels",
    "load_pings",
    "range_rates",
    "save_pings",
    "velocity_of",
]


Array = NDArray[np.float64]

MEASURED = ("range_m", "level_db", "quality")

COLUMNS = ("time_s", "ping", "channel", "beam", "bearing_deg", *MEASURED, "x_m", "y_m", "z_m")
"""Columns of a CSV file."""


@dataclass(frozen=True)
class Soundings:
    """Detections of consecutive pings; nan where a beam has none.

    Attributes:
        time_s: of the pings ``(pings,)`` [s].
        poses: of the vehicle ``(pings, 6)`` [m, rad].
        sounder: the instrument.
        range_m: slant ranges ``(pings, channels, beams)`` [m].
        level_db: of the strongest bin of each echo, of the same shape [dB].
        quality: part of a beam's energy above the noise that lies in its echo, 0..1, of the same shape.

    Raises:
        MitsonarError: shapes that do not fit.
    """

    time_s: Array
    poses: Array
    sounder: Sounder
    range_m: Array
    level_db: Array
    quality: Array

    def __post_init__(self) -> None:
        wanted = (len(self.time_s), len(self.sounder.channels), self.sounder.fan.beams)
        for name in MEASURED:
            if getattr(self, name).shape != wanted:
                raise MitsonarError(f"{name} must have the shape {wanted}: got {getattr(self, name).shape}")

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
        """Return the places of all soundings in the world ``(pings, channels, beams, 3)`` [m]: on the beams' axes."""
        fans = self.sounder.fan_poses(self.poses)
        turn = vehicle_rotation(fans.reshape(-1, 6)).as_matrix().reshape(*fans.shape[:2], 3, 3)
        way = np.einsum("pcij,bj->pcbi", turn, self.sounder.directions())
        return np.asarray(fans[:, :, None, :3] + self.range_m[..., None] * way)

    def save(self, path: str | Path) -> None:
        """Write a file by its ending, whole or absent: ``.npz``, or of the soundings found ``.csv``, ``.xyz`` or ``.ply``.

        Raises:
            MitsonarError: another ending; no sounding to write.
        """
        path = Path(path)
        if path.suffix == ".npz":
            named = {name: getattr(self, name) for name in ("time_s", "poses", *MEASURED)}
            return save_pings(path, self.sounder, named)
        writers = {".csv": self._csv, ".xyz": self._xyz, ".ply": self._ply}
        if path.suffix not in writers:
            raise MitsonarError(f"soundings are written as .npz, {', '.join(writers)}: got {path.name}")
        if not self.found.any():
            raise MitsonarError(f"no beam has an echo, and {path.name} would be empty: move the window, or come nearer")
        write_whole(path, writers[path.suffix]())
        return None

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read an npz file of :meth:`save`.

        Raises:
            MitsonarError: unreadable, or not such a file.
        """
        sounder, arrays = load_pings(path, MEASURED)
        return cls(arrays["time_s"], arrays["poses"], sounder, *(arrays[name] for name in MEASURED))

    def table(self) -> Array:
        """Return the soundings found ``(found, columns)``; columns: :data:`mitsonar.records.soundings.COLUMNS`."""
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
        """Return a binary PLY of points, grey by their level."""
        import trimesh

        level = self.level_db[self.found]
        low, high = np.percentile(level, [2, 98])
        grey = np.clip((level - low) / max(high - low, 1e-9), 0, 1) * 255
        colours = np.column_stack([grey, grey, grey, np.full_like(grey, 255)]).astype(np.uint8)
        cloud: Any = trimesh.PointCloud(self.points()[self.found], colors=colours)  # type: ignore[no-untyped-call]
        return bytes(cloud.export(file_type="ply"))


# ---------------- Echograms: levels over time and range of instruments with one beam a fan, such as a side-scan's
# waterfall


@dataclass(frozen=True)
class Echogram:
    """Consecutive pings.

    Attributes:
        time_s: of the pings ``(pings,)`` [s].
        poses: of the vehicle ``(pings, 6)`` [m, rad].
        sounder: the instrument.
        levels: intensities ``(pings, channels, bins)`` float32, after the instrument's gain over range.
        height_m: of the first fan over what is straight below it ``(pings,)`` [m]; nan where there is nothing.

    Raises:
        MitsonarError: shapes that do not fit.
    """

    time_s: NDArray[np.float64]
    poses: NDArray[np.float64]
    sounder: Sounder
    levels: NDArray[np.float32]
    height_m: NDArray[np.float64]

    def __post_init__(self) -> None:
        wanted = (len(self.time_s), len(self.sounder.channels), self.sounder.fan.range_bins)
        if self.levels.shape != wanted:
            raise MitsonarError(f"levels must have the shape {wanted}: got {self.levels.shape}")

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
        """Return the levels in dB of full scale, 0 to ``-span_db`` ``(pings, channels, bins)``.

        Full scale is the 99.9th percentile of all levels.
        """
        full = float(np.percentile(self.levels, 99.9)) or float(self.levels.max()) or 1.0
        least = 10 ** (-span_db / 10)
        return np.asarray(10 * np.log10(np.clip(self.levels / np.float32(full), least, 1)), dtype=np.float32)

    def save(self, path: str | Path) -> None:
        """Write an npz file, whole or absent."""
        names = ("time_s", "poses", "levels", "height_m")
        save_pings(path, self.sounder, {name: getattr(self, name) for name in names})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file of :meth:`save`.

        Raises:
            MitsonarError: unreadable, or not such a file.
        """
        sounder, arrays = load_pings(path, ("levels", "height_m"))
        return cls(arrays["time_s"], arrays["poses"], sounder, arrays["levels"], arrays["height_m"])


# ---------------- How fast what each pixel shows comes nearer or goes away: the labels' truth of motion


def range_rates(frames: SonarFrames, velocity: Array | None = None) -> NDArray[np.float32]:
    """Compute the rate of the range of the strongest echo of each pixel, like ``image`` [m/s]; nan where there is none.

    It is (v_echo - v_sonar) . d: positive where the echo goes away. A still sonar and scene give 0. What deforms moves as
    the axes of its body do.

    Args:
        frames: with poses, and rendered with labels.
        velocity: of the sonar in the world's axes ``(frames, 3)`` [m/s]; default: from its poses and times.

    Raises:
        MitsonarError: no labels, no poses, or one frame without a velocity.
    """
    if frames.elevation_rad is None or frames.poses is None:
        raise MitsonarError("range rates need labels and poses: render with --labels")
    time = frames.time_s if frames.time_s.ndim == 1 else frames.time_s.mean(axis=1)
    if velocity is None and len(frames) < 2:
        raise MitsonarError("one frame tells no velocity of the sonar: give velocity (1, 3) in m/s")
    own = np.gradient(frames.poses[:, :3], time, axis=0) if velocity is None else np.asarray(velocity, dtype=float)
    if own.shape != (len(frames), 3):
        raise MitsonarError(f"the sonar's velocity must be ({len(frames)}, 3) in m/s: got {own.shape}")
    found = np.full(frames.image.shape, np.nan, np.float32)
    bodies = body_of_pixels(frames)
    for number in range(len(frames)):
        bins, beams = np.nonzero(np.isfinite(frames.elevation_rad[number]))
        elevation = frames.elevation_rad[number, bins, beams]
        poses = frames.poses[None, number] if frames.beam_poses is None else frames.beam_poses[number]
        one = np.zeros_like(beams) if frames.beam_poses is None else beams
        own_axes = directions(frames.sonar.bearing, frames.bearing_rad[beams], elevation)
        way = np.einsum("nij,nj->ni", vehicle_rotation(poses).as_matrix()[one], own_axes)
        place = poses[one, :3] + way * frames.range_m[bins, None]
        moves = _velocity_at(frames, number, bodies[number, bins, beams], place) - own[number]
        found[number, bins, beams] = (moves * way).sum(axis=1)
    return found


def body_of_pixels(frames: SonarFrames) -> NDArray[np.int32]:
    """Return the place in ``body_names`` of the body that each pixel shows, like ``image``; -1: none that moves.

    Raises:
        MitsonarError: no labels.
    """
    if frames.object_id is None or frames.shape_id is None:
        raise MitsonarError("bodies of pixels need labels: render with --labels")
    found = np.full(frames.image.shape, -1, np.int32)
    for number, name in enumerate(frames.body_names):
        if name in frames.object_names:
            found[frames.object_id == frames.object_names.index(name)] = number
        if name in frames.shape_names:  # a mesh that numbers its own objects
            found[frames.shape_id == frames.shape_names.index(name)] = number
    return found


def _velocity_at(frames: SonarFrames, number: int, body: NDArray[np.int32], place: Array) -> Array:
    """Return the velocity of what is at places ``(n, 3)`` in one frame: v + w x r of its body, 0 of what is still."""
    found = np.zeros_like(place)
    if frames.body_poses is None or frames.body_velocities is None:
        return found
    on = body >= 0
    moves, middle = frames.body_velocities[number, body[on]], frames.body_poses[number, body[on], :3]
    found[on] = moves[:, :3] + np.cross(moves[:, 3:], place[on] - middle)
    return found


# ---------------- Readings of a DVL: range rates of its beams, the velocity and altitude that follow from them, and
# when they are lost


AXES = ("starboard", "forward", "up")


@dataclass(frozen=True)
class DvlReadings:
    """Readings of consecutive pings; nan where the bottom lock is lost.

    Attributes:
        soundings: ranges of the beams.
        range_rate: of the beams, growing ranges positive ``(pings, beams)`` [m/s]; nan without an echo.
        velocity: of the vehicle in its own axes, starboard, forward, up ``(pings, 3)`` [m/s].
        covariance: of the velocity ``(pings, 3, 3)``, from the noise of a range rate.
    """

    soundings: Soundings
    range_rate: Array
    velocity: Array
    covariance: Array

    @classmethod
    def of(cls, soundings: Soundings, range_rate: Array) -> Self:
        """Compute velocities from range rates ``(pings, beams)``; beams without an echo do not count."""
        sounder = soundings.sounder
        heard = np.where(soundings.found[..., 0], range_rate, np.nan)
        return cls(soundings, heard, *velocity_of(heard, sounder.axes, sounder.beam_std_m_s))

    @property
    def locked(self) -> NDArray[np.bool_]:
        """Return in which pings the velocity is known ``(pings,)``."""
        return np.asarray(np.isfinite(self.velocity).all(axis=1), dtype=np.bool_)

    @property
    def altitude_m(self) -> Array:
        """Return the height of the vehicle over the mean of the points that the beams meet ``(pings,)`` [m]."""
        depth = self.soundings.poses[:, None, 2] - self.soundings.points()[:, :, 0, 2]
        there = np.isfinite(depth)
        return np.where(there.any(axis=1), np.nansum(depth, axis=1) / np.maximum(there.sum(axis=1), 1), np.nan)

    def level(self) -> tuple[Array, Array]:
        """Return velocities and covariances in level axes: sideways, forward, up ``(pings, 3)`` and ``(pings, 3, 3)``.

        Pitch and roll are those of the poses, as a DVL with an attitude sensor has them.
        """
        upright = self.soundings.poses.copy()
        upright[:, 3:5] = 0
        turn = (vehicle_rotation(upright).inv() * vehicle_rotation(self.soundings.poses)).as_matrix()
        return np.einsum("pij,pj->pi", turn, self.velocity), turn @ self.covariance @ turn.swapaxes(1, 2)

    def save(self, path: str | Path) -> None:
        """Write a CSV file, whole or absent; cells are empty where nothing is known."""
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
        write_whole(Path(path), text.getvalue().encode())


def velocity_of(range_rate: Array, axes: Array, std_m_s: float) -> tuple[Array, Array]:
    """Solve for velocities by least squares: each rate is minus the velocity along its beam.

    Args:
        range_rate: of the beams ``(pings, beams)`` [m/s], nan where there is none.
        axes: of the beams ``(beams, 3)``, unit vectors.
        std_m_s: noise of a rate.

    Returns:
        Velocities ``(pings, 3)`` and covariances ``(pings, 3, 3)``, nan with fewer than three beams, or beams in a plane.
    """
    heard = np.isfinite(range_rate)
    weight = heard.astype(float)
    information = np.einsum("pb,bi,bj->pij", weight, axes, axes)
    right = -np.einsum("pb,bi->pi", np.where(heard, range_rate, 0), axes)
    known = (heard.sum(axis=1) >= FEWEST_BEAMS) & (np.linalg.cond(information) < 1e6)
    inverse = np.full(information.shape, np.nan)
    inverse[known] = np.linalg.inv(information[known])
    return np.einsum("pij,pj->pi", inverse, right), inverse * std_m_s**2


# ---------------- The npz files of sounders: arrays of pings with the instrument in JSON, checked when they are read


def save_pings(path: str | Path, sounder: Sounder, arrays: dict[str, NDArray[Any]]) -> None:
    """Write arrays and the instrument to an npz file, whole or absent."""
    buffer = io.BytesIO()
    told = sounder.model_dump(mode="json", exclude={"fan"}) | {"fan": sounder.fan.model_dump(mode="json")}
    table: dict[str, Any] = {"sounder": np.array(json.dumps(told)), **arrays}
    np.savez_compressed(buffer, **table)
    write_whole(Path(path), buffer.getvalue())


def load_pings(path: str | Path, names: tuple[str, ...]) -> tuple[Sounder, dict[str, NDArray[Any]]]:
    """Read a file of :func:`save_pings`: the instrument and the named arrays, finite or nan, with the same first length.

    Raises:
        MitsonarError: unreadable, or not such a file.
    """
    try:
        found = read_npz(path)
    except MitsonarError:
        raise
    except Exception as error:  # damaged bytes raise errors of many kinds
        raise MitsonarError(f"cannot read {path}: {error}; give a file that `mitsonar sound` wrote") from None
    lacking = [name for name in (*names, "sounder", "time_s", "poses") if name not in found]
    if lacking:
        raise MitsonarError(f"{path} lacks {lacking[0]}: give a file that `mitsonar sound` wrote")
    told: Any = parse_json(str(found.pop("sounder")), str(path))
    if not isinstance(told, dict) or not isinstance(told.get("fan"), dict):
        raise MitsonarError(f"{path} tells of no instrument: give a file that `mitsonar sound` wrote")
    sounder = Sounder.create(**{**told.pop("fan"), **told})
    arrays = {name: found[name] for name in (*names, "time_s", "poses")}
    pings = len(arrays["time_s"]) if arrays["time_s"].ndim == 1 else -1
    for name, values in arrays.items():
        if values.dtype.kind != "f" or not values.ndim or len(values) != pings or np.isinf(values).any():
            raise MitsonarError(f"{path} is damaged: {name} must be {pings} rows of numbers")
    if arrays["poses"].shape != (pings, 6) or not pings:
        raise MitsonarError(f"{path} is damaged: poses must be (pings, 6), got {arrays['poses'].shape}")
    return sounder, arrays
