"""Delays of a moving receiver: the exact root, the iteration, and their phase."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.acoustics.water import delay_exact, delay_iterated, delay_static

C = 1500.0


def test_exact_delay_solves_its_equation() -> None:
    rng = np.random.default_rng(1)
    to_point, velocity = rng.normal(0, 8, (3, 500)), rng.uniform(-3, 3, (3, 500))
    from_receiver = to_point + rng.normal(0, 0.3, (3, 500))
    delay = delay_exact(to_point, from_receiver, velocity, C)
    out, back = np.linalg.norm(to_point, axis=0), np.linalg.norm(from_receiver - velocity * delay, axis=0)
    assert np.abs(out + back - C * delay).max() < 1e-12 * C
    still = delay_exact(to_point, from_receiver, np.zeros((3, 500)), C)
    assert np.abs(still - delay_static(to_point, from_receiver, C)).max() < 1e-17


def test_iteration_gains_a_factor_of_v_over_c_each_round() -> None:
    """Eq. 5.5-5.14 repeated: error against the exact root, fitted on log axes."""
    point, velocity = np.array([3.0, 4.0, -10.0]), np.array([2.0, -1.0, 0.0])
    exact = delay_exact(point, point, velocity, C)
    errors = [abs(delay_iterated(point, point, velocity, C, rounds) - exact) for rounds in range(4)]
    closing = -velocity @ point / np.linalg.norm(point) / C  # what a round multiplies the error by
    assert np.polyfit(range(4), np.log(errors), 1)[0] == pytest.approx(np.log(abs(closing)), abs=0.1)
    assert errors[2] * 320e3 < 1e-4  # turns of the highest carrier: two rounds suffice (Almanza-Medina)


def test_delays_hold_their_phase_at_320_khz_and_25_m() -> None:
    """Against 50 digits: float64 leaves 1e-10 turns."""
    mpmath = pytest.importorskip("mpmath")
    mpmath.mp.dps = 50
    p, b, v = (15.1234567, 3.7654321, -19.5), (15.0234567, 3.7654321, -19.5), (1.9, -0.7, 0.0)
    tau0 = mpmath.sqrt(sum(mpmath.mpf(x) ** 2 for x in p)) / 1500
    q = [mpmath.mpf(x) - mpmath.mpf(w) * tau0 for x, w in zip(b, v, strict=True)]
    qv, qq, vv = (sum(x * y for x, y in zip(a, c, strict=True)) for a, c in ((q, v), (q, q), (v, v)))
    vv = sum(mpmath.mpf(x) ** 2 for x in v)
    exact = tau0 + (mpmath.sqrt(qv**2 + (mpmath.mpf(1500) ** 2 - vv) * qq) - qv) / (mpmath.mpf(1500) ** 2 - vv)
    assert abs(float(delay_exact(p, b, v, C) - exact)) * 320e3 < 1e-10


def test_sound_meets_a_moving_point_where_it_is_by_then() -> None:
    """Both ways solve their equations: |d + u t| = c t, then |q + (u - v) t - v s| = c s."""
    rng = np.random.default_rng(2)
    to_point, velocity, moves = rng.normal(0, 8, (3, 500)), rng.uniform(-3, 3, (3, 500)), rng.uniform(-30, 30, (3, 500))
    from_receiver = to_point + rng.normal(0, 0.3, (3, 500))
    delay = delay_exact(to_point, from_receiver, velocity, C, moves)
    # the time of the meeting by bisection, independent of the closed form
    low, high = np.zeros(500), np.full(500, 1.0)
    for _ in range(60):
        middle = (low + high) / 2
        late = np.linalg.norm(to_point + moves * middle, axis=0) < C * middle
        low, high = np.where(late, low, middle), np.where(late, middle, high)
    left = np.linalg.norm(from_receiver + moves * low - velocity * delay, axis=0)
    assert np.abs(left - C * (delay - low)).max() < 1e-11 * C
    still = delay_exact(to_point, from_receiver, velocity, C, np.zeros((3, 500)))
    assert np.abs(still - delay_exact(to_point, from_receiver, velocity, C)).max() < 1e-17
