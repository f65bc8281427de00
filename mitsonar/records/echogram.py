"""Echograms: levels over time and range of instruments with one beam a fan, such as a side-scan's waterfall."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sounder import Sounder
from mitsonar.records.sounder_files import load_pings, save_pings

__all__ = ["Echogram"]


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
