"""Per-pixel truth of frames: elevation, shape, object and shadow, from the strongest ray of each cell."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.simulation.rendered_pings import RenderedPings

__all__ = ["labels_above", "labels_of", "shadow"]


def labels_of(pings: RenderedPings, truth: Any, rays: int) -> dict[str, NDArray[Any]]:
    """Label maps of a batch (see :class:`mitsonar.records.frames.SonarFrames`), from the strongest ray of each cell.

    ``rays`` is how many a ping has.
    """
    best, elevation, shape_id, object_id = truth
    frames, bins, beams = pings.levels.shape
    winner = np.array(best).reshape(frames, beams, bins).transpose(0, 2, 1)
    filled = (winner > 0) & (pings.echoes > 0)
    ray = (winner & 0xFFFFFFFF).astype(np.int64) + np.arange(frames)[:, None, None] * rays
    ray = np.where(filled, ray, 0)
    return {
        "elevation_rad": np.where(filled, np.array(elevation)[ray], np.float32(np.nan)),
        "shape_id": np.where(filled, np.array(shape_id)[ray], -1).astype(np.int32),
        "object_id": np.where(filled, np.array(object_id)[ray], -1).astype(np.int32),
        "shadow": shadow(pings),
    }


def labels_above(pings: RenderedPings, gain: float, floor: float | NDArray[np.float64]) -> dict[str, Any]:
    """Return the label maps of a batch without the pixels whose level is at most ``floor``.

    Args:
        pings: with labels, or without.
        gain: that lifts levels to full scale, 1.
        floor: part of full scale, one or of each bin ``(bins, 1)``; 0: every echo is labelled, however faint.
    """
    if np.max(floor) <= 0 or not pings.labels:
        return pings.labels
    bright = pings.echoes * np.float32(gain) > np.asarray(floor, dtype=np.float32)
    empty = {"elevation_rad": np.float32(np.nan), "shape_id": np.int32(-1), "object_id": np.int32(-1)}
    kept = {name: np.where(bright, pings.labels[name], nothing) for name, nothing in empty.items()}
    return {**kept, "shadow": shadow(pings, bright)}


def shadow(pings: RenderedPings, echo: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """Return where no echo came from ``(frames, bins, beams)``.

    0: lit, or not yet intercepted. 1: dark between what intercepts and what still travels. 2: dark beyond all echoes.

    Args:
        pings: of a batch.
        echo: which pixels count as echoes; default: all that are not 0.
    """
    echo = pings.echoes > 0 if echo is None else echo
    beams = echo.shape[2]
    near, far, missed = (_of_beams(one, beams) for one in (pings.counts.nearer, pings.counts.farther, pings.counts.missed))
    nearer = np.logical_or.accumulate(echo, axis=1) | (near > 0)[:, None]
    still = np.logical_or.accumulate(echo[:, ::-1], axis=1)[:, ::-1]
    still = still | ((far > 0) | (missed > 0))[:, None]
    return np.where(nearer & ~echo, np.where(still, 1, 2), 0).astype(np.uint8)


def _of_beams(counts: NDArray[Any], beams: int) -> NDArray[Any]:
    """Return counts of rays in the beams of the image: with a pattern, boxes beside the fan are traced too."""
    beside = max(0, counts.shape[-1] - beams) // 2
    return counts[..., beside : counts.shape[-1] - beside]
