"""Rendered pings: levels of a batch, the constant gain of a run, and images of both."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mitsonar.simulation.binning import Counts

__all__ = ["RenderedPings", "constant_gain", "to_image"]

CALIBRATION_FRAMES = 20
"""Frames whose brightest pixels set the gain of a run."""


@dataclass
class RenderedPings:
    """A batch of consecutive pings.

    Attributes:
        first: number of the first.
        levels: ``(pings, bins, beams)`` float32, before gain.
        counts: what became of the rays.
        height_m: ``(pings,)``.
        labels: ``elevation_rad``, ``shape_id``, ``object_id``, ``shadow``, like ``levels``, where asked for.
    """

    first: int
    levels: NDArray[np.float32]
    counts: Counts
    height_m: NDArray[np.float64]
    labels: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.levels)


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


def to_image(pings: RenderedPings, gain: float) -> NDArray[np.float32]:
    """Return levels times gain, clipped to 0..1."""
    image: NDArray[np.float32] = np.clip(pings.levels * np.float32(gain), 0, 1)
    return image
