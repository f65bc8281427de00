"""Soundings: a range in each beam of each ping, as points in the world, in files of several kinds."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sounder import Sounder
from mitsonar.io.files import write_whole
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.records.sounder_files import load_pings, save_pings

__all__ = ["Soundings"]

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
