"""Motions that fit alike are told apart by their neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.estimation.estimator import Estimate, rejected
from mitsonar.mapping.pairs import continued
from mitsonar.motion.composition import Motion


def sure(forward: float) -> Estimate:
    return Estimate(Motion(0.03, forward, 0.0), np.eye(3) * 1e-8, about={"modes": [(1.0, 0.03, forward, 0.0)]})


def ambiguous(forward: float, first: float = 0.6) -> Estimate:
    """Its mirror image fits better."""
    modes = [(first, 0.03, -forward, 0.0), (1 - first, 0.03, forward, 0.0)]
    spreads = [np.diag([1e-8, 4e-8, 0]).tolist(), np.diag([1e-8, 9e-8, 0]).tolist()]
    return Estimate(Motion(0.03, 0.0, 0.0), np.eye(3), False, "2 motions fit alike", {"modes": modes, "spreads": spreads})


def test_doubtful_ones_follow_the_sure_ones() -> None:
    forward = 0.02 + 0.002 * np.sin(np.arange(12))
    message = [sure(f) if k % 5 == 0 else ambiguous(f) for k, f in enumerate(forward)]
    result = continued(message)
    assert [one.motion.forward for one in result] == pytest.approx(forward)
    assert all(one.valid for one in result)
    assert result[1].covariance is not None
    assert result[1].covariance[1, 1] == 9e-8
    assert result[0] is message[0]


def test_a_sudden_turn_is_possible_where_all_after_it_say_so() -> None:
    message = [sure(0.02), ambiguous(0.02, first=0.01), *(ambiguous(-0.02, first=0.01) for _ in range(4)), sure(-0.02)]
    assert [np.sign(one.motion.forward) for one in continued(message)] == [1, 1, -1, -1, -1, -1, -1]


def test_what_has_no_modes_is_stepped_over_and_kept() -> None:
    lost = rejected("the pings have nothing in common")
    result = continued([sure(0.02), lost, ambiguous(0.02), ambiguous(0.02)])
    assert result[1] is lost
    assert [one.motion.forward for one in result[2:]] == [0.02, 0.02]
    assert [one.valid for one in result] == [True, False, True, True]


def test_nothing_to_choose_is_nothing_done() -> None:
    message = [sure(0.02), rejected("dark"), sure(0.01)]
    assert all(a is b for a, b in zip(continued(message), message, strict=True))
    alone = [ambiguous(0.02)] * 5  # and its mirror image all along: nothing decides
    assert all(a is b for a, b in zip(continued(alone), alone, strict=True))
