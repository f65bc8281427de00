"""Frames of several views of the same pings, or their vectors: the portions of a downward-looking sonar's field of view."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.files import FileArray

__all__ = ["ViewFrames"]


@dataclass(frozen=True)
class ViewFrames:
    """Consecutive pings.

    Attributes:
        kind: ``image``, or ``vector``: sums over the beams.
        values: by view; images ``(n, bins, beams)`` uint8 or float 0..1, vectors ``(n, bins)`` in pixels' maxima.
        sonars: of the views.
        bearing_rad: of the beams of each view.
        time_s: of the pings ``(n,)``.
        poses: of the sonar ``(n, 6)``, where known.
        height_m: over the ground ``(n,)``, where known.

    Raises:
        MitsonarError: shapes that do not fit.
    """

    kind: str
    values: dict[str, FileArray]
    sonars: dict[str, Sonar]
    bearing_rad: dict[str, NDArray[np.float64]]
    time_s: NDArray[np.float64]
    poses: NDArray[np.float64] | None = None
    height_m: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        for view, values in self.values.items():
            shape = (len(self.time_s), self.sonars[view].range_bins)
            wanted = shape if self.kind == "vector" else (*shape, len(self.bearing_rad[view]))
            if values.shape != wanted:
                raise MitsonarError(f"{self.kind}s of view {view} must have the shape {wanted}: got {values.shape}")

    def __len__(self) -> int:
        return len(self.time_s)

    def select(self, which: slice) -> Self:
        """Select some of the pings."""
        return replace(
            self,
            values={view: values[which] for view, values in self.values.items()},
            time_s=self.time_s[which],
            poses=None if self.poses is None else self.poses[which],
            height_m=None if self.height_m is None else self.height_m[which],
        )

    def profiles(self) -> NDArray[np.float32]:
        """Sum the images over the beams: ``(views, n, bins)`` float32, in pixels' maxima."""
        scale = {np.dtype(np.uint8): np.float32(1 / 255)}
        whole = [values * scale.get(values.dtype, np.float32(1)) for values in self.values.values()]
        return np.stack([one if self.kind == "vector" else one.sum(axis=-1) for one in whole]).astype(np.float32)
