"""Ambiguous motions are resolved by their neighbours: the probability of each, given all others (Rabiner 1989)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from mitsonar.estimation.estimator import Estimate
from mitsonar.motion.composition import Motion

__all__ = ["continued"]

Array = NDArray[np.float64]

USUAL_M, USUAL_RAD = 0.005, 0.002
"""Standard deviations of the change from one motion to the next."""

SUDDEN = -12.0
"""Log probability of a sudden change of any size: a path may turn a corner."""

SURE = 0.95
"""Probability from which a motion is valid."""


def continued(estimates: Sequence[Estimate]) -> list[Estimate]:
    """Choose one motion of each ambiguous estimate, where its neighbours decide.

    An estimator lists the candidates in ``about["modes"]``: probability, sideways, forward [m], yaw [rad] of each. Their
    covariances are in ``about["spreads"]``. A candidate whose probability, given the motions before and after, reaches
    :data:`SURE` becomes the valid motion. All other estimates stay as they are.
    """
    modes = [np.array(one.about.get("modes", []), dtype=float).reshape(-1, 4) for one in estimates]
    ambiguous = [len(mine) > 1 and not one.valid for one, mine in zip(estimates, modes, strict=True)]
    if not any(ambiguous):
        return list(estimates)
    candidates = [
        mine if one.valid or unsure else np.empty((0, 4))
        for one, mine, unsure in zip(estimates, modes, ambiguous, strict=True)
    ]
    sure = _marginals(candidates)
    return [
        _with_mode(one, mine, int(share.argmax())) if unsure and share.max() >= SURE else one
        for one, mine, unsure, share in zip(estimates, modes, ambiguous, sure, strict=True)
    ]


def _marginals(modes: list[Array]) -> list[Array]:
    """Return the probability of each mode of each step, given all steps; steps without modes are skipped."""
    known = [k for k, mine in enumerate(modes) if len(mine)]
    own = [np.log(np.maximum(modes[k][:, 0], 1e-300)) for k in known]
    change = [_change(modes[a][:, 1:], modes[b][:, 1:], b - a) for a, b in pairwise(known)]
    before, after = [own[0]], [np.zeros(len(own[-1]))]
    for between, mine in zip(change, own[1:], strict=True):
        before.append(logsumexp(before[-1][:, None] + between, axis=0) + mine)
    for between, mine in zip(change[::-1], own[:0:-1], strict=True):
        after.append(logsumexp(between + (mine + after[-1])[None], axis=1))
    shares = [np.empty(0)] * len(modes)
    for step, first, last in zip(known, before, after[::-1], strict=True):
        shares[step] = np.exp(first + last - logsumexp(first + last))
    return shares


def _change(first: Array, second: Array, steps: int) -> Array:
    """Return the log probability that each second motion ``(m, 3)`` follows each first one ``(n, 3)``: ``(n, m)``."""
    usual = np.array([USUAL_M, USUAL_M, USUAL_RAD]) * np.sqrt(steps)
    off = (second[None] - first[:, None]) / usual
    return np.asarray(np.maximum(-0.5 * (off**2).sum(axis=-1), SUDDEN))


def _with_mode(one: Estimate, modes: Array, number: int) -> Estimate:
    spreads = one.about.get("spreads")
    covariance = None if spreads is None else np.array(spreads[number], dtype=float)
    return replace(one, motion=Motion(*modes[number, 1:]), covariance=covariance, valid=True, reason="")
