"""Rendered pings: levels of a batch, the constant gain of a run, and images of both."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.levels import coded

if TYPE_CHECKING:
    from mitsonar.instruments.sonar import Sonar
    from mitsonar.simulation.binning import Counts

__all__ = ["CutRays", "RenderedPings", "constant_gain", "to_image"]

CALIBRATION_FRAMES = 20
"""Frames whose brightest pixels set the gain of a run."""


class CutRays(NamedTuple):
    """Rays of the model ``coherent`` whose cells of a surface hold more points than are looked through.

    Attributes:
        rays: how many.
        enough_m: pitch of the points with which none would be cut [m].
    """

    rays: int = 0
    enough_m: float = 0.0


NONE_CUT = CutRays()


@dataclass
class RenderedPings:
    """A batch of consecutive pings.

    Attributes:
        first: number of the first.
        levels: ``(pings, bins, beams)`` float32, before gain.
        counts: what became of the rays.
        height_m: ``(pings,)``.
        labels: ``elevation_rad``, ``shape_id``, ``object_id``, ``shadow``, like ``levels``, where asked for.
        expected: levels without speckle, noise and patterns, like ``levels``, that labels of the model ``coherent`` go by;
            None: the levels themselves.
        cut: rays that missed points, in the model ``coherent``.
    """

    first: int
    levels: NDArray[np.float32]
    counts: Counts
    height_m: NDArray[np.float64]
    labels: dict[str, Any] = field(default_factory=dict)
    expected: NDArray[np.float32] | None = None
    cut: CutRays = NONE_CUT

    def __len__(self) -> int:
        return len(self.levels)

    @property
    def echoes(self) -> NDArray[np.float32]:
        """Return the levels that tell where echoes are ``(pings, bins, beams)``."""
        return self.levels if self.expected is None else self.expected


def constant_gain(batches: Iterable[RenderedPings]) -> tuple[float, Iterator[RenderedPings]]:
    """Find the gain that lifts the 99.9th percentile of all pixels of the first 20 frames to 0.9, and all the batches again.

    Where that percentile is empty the largest pixel takes its place; where all pixels are, the gain is 1.
    """
    batches = iter(batches)
    head: list[RenderedPings] = []
    while sum(map(len, head)) < CALIBRATION_FRAMES and (pings := next(batches, None)) is not None:
        head.append(pings)
    levels = np.concatenate([pings.levels for pings in head])[:CALIBRATION_FRAMES]
    bright = float(np.percentile(levels, 99.9)) or float(levels.max())
    return (0.9 / bright if bright > 0 else 1.0), chain(head, batches)


def to_image(levels: NDArray[np.float32], gain: float, sonar: Sonar) -> NDArray[np.float32]:
    """Return values 0..1 of levels times the gain, in the sonar's coding, of the same shape."""
    return coded(levels * np.float32(gain), sonar)
