"""Stripmap images of synthetic apertures: complex values on a level grid along a track, and their file."""

from __future__ import annotations

import io
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.io.files import read_npz, write_atomic

__all__ = ["StripGrid", "StripImage"]

MOST_PIXELS = 2**27
"""Largest number of pixels of an image: 1 GB."""


@dataclass(frozen=True)
class StripGrid:
    """Pixels of a stripmap image: a horizontal rectangle along a track.

    Attributes:
        x, y, z: where both distances are 0 [m].
        heading_rad: direction of the track, clockwise from +y.
        along_start_m, along_step_m, rows: distances along the track, one per row.
        across_start_m, across_step_m, columns: distances to starboard of the track, one per column; negative to port.
    """

    x: float
    y: float
    z: float
    heading_rad: float
    along_start_m: float
    along_step_m: float
    rows: int
    across_start_m: float
    across_step_m: float
    columns: int

    def __post_init__(self) -> None:
        steps = (self.along_step_m, self.across_step_m)
        if not all(math.isfinite(value) for value in asdict(self).values()) or 0 in steps or self.along_step_m < 0:
            raise MitsonarError(f"a grid has finite numbers and steps that are not 0: got {self}")
        if min(self.rows, self.columns) < 1 or self.rows * self.columns > MOST_PIXELS:
            raise MitsonarError(
                f"an image has 1 to {MOST_PIXELS:,} pixels: got {self.rows:,} x {self.columns:,}; choose larger steps, or a "
                "smaller area"
            )

    @property
    def along_m(self) -> NDArray[np.float64]:
        """Return the distance of each row along the track ``(rows,)`` [m]."""
        return self.along_start_m + self.along_step_m * np.arange(self.rows, dtype=np.float64)

    @property
    def across_m(self) -> NDArray[np.float64]:
        """Return the distance of each column to starboard ``(columns,)`` [m]."""
        return self.across_start_m + self.across_step_m * np.arange(self.columns, dtype=np.float64)

    @property
    def axes(self) -> NDArray[np.float64]:
        """Return the directions to starboard, along the track and up in the world, as rows ``(3, 3)``."""
        sin, cos = math.sin(self.heading_rad), math.cos(self.heading_rad)
        return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])

    def local(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return positions in the world ``(..., 3)`` as distances to starboard, along the track and up [m]."""
        return np.asarray((places - np.array([self.x, self.y, self.z])) @ self.axes.T)

    def world(self, along_m: float, across_m: float) -> NDArray[np.float64]:
        """Return the position of a pixel in the world ``(3,)`` [m]."""
        return np.asarray(np.array([across_m, along_m, 0.0]) @ self.axes + np.array([self.x, self.y, self.z]))


@dataclass(frozen=True)
class StripImage:
    """A complex stripmap image.

    A scatterer of the simulator appears with the square root of its strength and cosines and with its phase: spreading and
    absorption are undone, and the pattern of the elements across the vertical plane.

    Attributes:
        value: ``(rows, columns)`` complex64; 0 where no beam looks.
        grid: the pixels.
    """

    value: NDArray[np.complex64]
    grid: StripGrid

    def __post_init__(self) -> None:
        if self.value.shape != (self.grid.rows, self.grid.columns):
            raise MitsonarError(f"value must be {(self.grid.rows, self.grid.columns)}: got {self.value.shape}")

    def __repr__(self) -> str:
        grid = self.grid
        along, across = grid.along_m[[0, -1]], grid.across_m[[0, -1]]
        return (
            f"StripImage({grid.rows} x {grid.columns} pixels, {along[0]:g}..{along[1]:g} m along, "
            f"{across[0]:g}..{across[1]:g} m to starboard)"
        )

    def decibels(self, span_db: float = 50.0) -> NDArray[np.float32]:
        """Return the intensity in dB relative to its 99.9th percentile, 0 to ``-span_db`` ``(rows, columns)``."""
        power = np.square(np.abs(self.value))
        full_scale = float(np.percentile(power, 99.9)) or float(power.max()) or 1.0
        return np.asarray(10 * np.log10(np.clip(power / full_scale, 10 ** (-span_db / 10), 1)), dtype=np.float32)

    def save(self, path: str | Path) -> None:
        """Write an npz file atomically: ``value``, and the fields of the grid as numbers."""
        buffer = io.BytesIO()
        numbers = {name: np.asarray(number) for name, number in asdict(self.grid).items()}
        np.savez(buffer, value=self.value, **numbers)  # type: ignore[arg-type]  # the stubs take allow_pickle for a name
        write_atomic(Path(path), buffer.getvalue())

    @classmethod
    def load(cls, path: str | Path) -> StripImage:
        """Read a file written by :meth:`save`.

        Raises:
            MitsonarError: a file that cannot be read or has another format.
        """
        advice = "give the image.npz that `mitsonar sas` wrote"
        try:
            table = read_npz(path)
        except Exception as error:  # damaged bytes raise errors of many kinds
            raise MitsonarError(f"cannot read the image {path}: {' '.join(str(error).split())[:300]}; {advice}") from None
        fields = StripGrid.__dataclass_fields__
        if set(table) != {"value", *fields} or any(
            table[name].ndim or table[name].dtype.kind not in "fi" for name in fields
        ):
            raise MitsonarError(f"{path} is not an image of `mitsonar sas`: {advice}")
        whole = ("rows", "columns")
        numbers: dict[str, Any] = {name: int(table[name]) if name in whole else float(table[name]) for name in fields}
        grid = StripGrid(**numbers)
        value = table["value"]
        if value.dtype != np.complex64 or not np.isfinite(value).all():
            raise MitsonarError(f"{path} must hold finite complex64 values: {advice}")
        return cls(value, grid)
