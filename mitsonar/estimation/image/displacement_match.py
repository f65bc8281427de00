"""The motion whose modelled displacement map fits a measured one best."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.estimation.image.displacement_map import WindowGrid

__all__ = ["STILL", "TINY", "WindowFlow", "in_blocks", "match_map", "match_vector"]

Doubles = NDArray[np.float64]

TINY = 1e-20
"""Keeps a division by zero finite."""

STILL = np.array([1e-4, 1e-4, 3e-5])
"""Steps below which a level ends [m, m, rad]."""

CAUCHY = 8.0
"""Windows whose squared misfit is so many times the usual have half the weight."""

SIZE = np.array([0.01, 0.01, 0.003])
"""Motions of like size [m, m, rad]."""

BLOCK = 4
"""Windows that overlap, and that show one rock, err alike: blocks of so many by so many count once."""


class WindowFlow(NamedTuple):
    """In each window: displacement left over [m, rad] ``(n, m, 2)``; its information, and the same without what noise adds
    to slopes ``(n, m, 2, 2)``."""

    displacement: Doubles
    information: Doubles
    shared: Doubles


class MapMatch(NamedTuple):
    """Motion, and its covariance, or None where the match is not a maximum."""

    motion: Doubles
    covariance: Doubles | None


def match_map(grid: WindowGrid, flow: WindowFlow, v: Doubles, height_std: float) -> MapMatch | None:
    """Weighted robust least squares between the displacement map and the exact map of a motion; None where that is singular.

    The unknowns are the motion and, unless ``height_std`` is 0, the height in parts of it.
    """
    found = grid.map(v) + flow.displacement
    unknowns = grid.derivative if not height_std else np.concatenate([grid.derivative, grid.by_height(v)], axis=-1)
    used = flow.information.any(axis=(2, 3))
    if used.sum() < BLOCK * BLOCK:
        return None
    p = np.append(v, 0.0)[: unknowns.shape[-1]]
    prior = np.zeros(len(p))
    for _ in range(10):
        misfit = found - grid.map(p[:3]) - (unknowns[..., 3:] @ p[3:])
        pull = (flow.information @ misfit[..., None])[..., 0]
        squared = np.maximum((misfit * pull).sum(axis=-1), 0)
        usual = float(np.median(squared[used])) / 1.39 + TINY  # the median of chi-square with 2 degrees of freedom
        prior[3:] = usual * BLOCK**2 / height_std**2 if height_std else 0.0
        weight = 1 / (1 + squared / (CAUCHY * usual))
        scores = _apply(unknowns, pull) * weight[..., None]
        normal = _normal(unknowns, flow.information * weight[..., None, None]).sum(axis=(0, 1)) + np.diag(prior)
        if not _regular(normal):
            return None
        step = np.linalg.solve(normal, scores.sum(axis=(0, 1)) - prior * p)
        p = p + step
        if (np.abs(step[:3]) < STILL / 10).all():
            break
    # robust scores rise by the weight's square, over both directions; noise is in either frame's slopes, not in the shared
    normals = _normal(unknowns, flow.shared * (weight * weight)[..., None, None])
    if not _regular(normals.sum(axis=(0, 1)) + np.diag(prior)):
        return MapMatch(p[:3], None)
    return MapMatch(p[:3], _covariance(normals, scores, prior, height_std))


def match_vector(grid: WindowGrid, flow: WindowFlow, v: Doubles) -> MapMatch | None:
    """Fit the motion whose modelled map has the same three numbers as the measured one; None where that is singular.

    They are the mean displacements in range and in bearing, and the slope of the displacement in range over bearing.
    """
    found = grid.map(v) + flow.displacement
    used = flow.information.any(axis=(2, 3))
    count = int(used.sum())
    if count < BLOCK * BLOCK:
        return None
    aside = np.where(used, grid.home[..., 1] - grid.home[..., 1][used].mean(), 0.0)
    one, none = used.astype(float), np.zeros(used.shape)
    # what each window adds to the vector: (n, m, 2, 3)
    summary = np.stack([np.stack([one, none, aside], axis=-1), np.stack([none, one, none], axis=-1)], axis=-2) / count
    slope = (np.swapaxes(summary, -1, -2) @ grid.derivative).sum(axis=(0, 1))
    if np.linalg.matrix_rank(slope * SIZE) < 3:
        return None
    for _ in range(10):
        scores = _apply(summary, found - grid.map(v))
        step = np.linalg.solve(slope, scores.sum(axis=(0, 1)))
        v = v + step
        if (np.abs(step) < STILL / 10).all():
            break
    # noise in the slopes holds the flow back by this much
    gain = np.linalg.pinv(flow.information, hermitian=True) @ flow.shared
    normals = np.swapaxes(summary, -1, -2) @ gain @ grid.derivative
    return MapMatch(v, _covariance(normals, scores, np.zeros(3), 0.0))


def _apply(unknowns: Doubles, pull: Doubles) -> Doubles:
    """Return the gradient by each unknown, of each window ``(n, m, unknowns)``."""
    return (np.swapaxes(unknowns, -1, -2) @ pull[..., None])[..., 0]


def _normal(unknowns: Doubles, information: Doubles) -> Doubles:
    """Unknowns' information from each window ``(n, m, unknowns, unknowns)``."""
    return np.asarray(np.swapaxes(unknowns, -1, -2) @ (information @ unknowns))


def _regular(normal: Doubles) -> bool:
    """Whether normal equations can be solved and have a maximum."""
    size = np.sqrt(np.maximum(np.diag(normal), TINY))
    eigenvalues = np.linalg.eigvalsh(normal / np.outer(size, size))
    return bool(eigenvalues[0] > 1e-8 * eigenvalues[-1])


def _covariance(normals: Doubles, scores: Doubles, prior: Doubles, height_std: float) -> Doubles | None:
    """Of the motion ``(3, 3)``, from how it changes when one block of windows is left out (jackknife), and from what was
    assumed of the height; None where one block alone decides."""
    each, said = in_blocks(normals), in_blocks(scores)
    whole = each.sum(axis=0) + np.diag(prior)
    try:
        change = np.linalg.solve(whole - each, said[..., None])[..., 0]
        assumed = np.linalg.solve(whole, np.diag(prior * height_std))
    except np.linalg.LinAlgError:
        return None
    blocks = len(each)
    return np.asarray((change.T @ change * (blocks - 1) / blocks + assumed @ assumed.T)[:3, :3])


def in_blocks(values: Doubles) -> Doubles:
    """Sum over blocks of windows ``(blocks, ...)``."""
    for axis in (0, 1):
        values = np.add.reduceat(values, np.arange(0, values.shape[axis], BLOCK), axis=axis)
    return values.reshape(-1, *values.shape[2:])
