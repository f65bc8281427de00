"""Spread of a channel: of each receiver by itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from channel_scenes import LEVEL, cells_floor, simulator

from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.simulation.channel import Paths
from mitsonar.simulation.instrument_runs import run_impulse, spread_of
from mitsonar.simulation.runs import Destination


def paths(delay_s: float, doppler_hz: float, around_hz: float) -> Paths:
    """Echoes of equal energy, evenly over so many seconds and hertz."""
    share = np.random.default_rng(2).permutation(np.linspace(0, 1, 1001))
    zeta = np.exp(1j * np.arange(1001))
    return Paths(0.01 + delay_s * np.linspace(0, 1, 1001), zeta, around_hz + doppler_hz * (share - 0.5), 0)


def test_receivers_that_look_ahead_and_back_do_not_spread_one_channel() -> None:
    """Shifts around +50 and -50 Hz; 98 % of the energy of each lies within 4 ms x 20 Hz and 5 ms x 30 Hz."""
    none = np.zeros(0)
    ahead, back, silent = paths(4e-3, 20.0, 50.0), paths(5e-3, 30.0, -50.0), Paths(none, none.astype(complex), none, 0)
    spread = spread_of([ahead, back, silent])
    assert spread.delay_s == pytest.approx(0.98 * 5e-3, rel=1e-2)
    assert spread.doppler_hz == pytest.approx(0.98 * 30.0, rel=1e-2)
    assert spread_of([back]) == spread
    assert spread_of([ahead]).factor < spread.factor
    assert spread_of([silent]).factor == 0


@pytest.mark.usefixtures("variant")
def test_four_receivers_at_one_metre_a_second() -> None:
    """Some 4.8 ms times 37 Hz where a receiver looks across the way, 62 Hz where it looks along; all together 138 Hz."""
    result = simulator(ChannelSonar(), floor=cells_floor())
    each = [result.paths(LEVEL, [1.0, 0.5, 0.0, 0.0], receiver) for receiver in range(4)]
    alone = [spread_of([path]) for path in each]
    assert [one.delay_s for one in alone] == pytest.approx([4.8e-3] * 4, rel=0.03)
    assert [one.doppler_hz for one in alone] == pytest.approx([37.0, 62.0, 37.0, 62.0], rel=0.04)
    assert spread_of(each) == max(alone, key=lambda one: one.factor)


@pytest.mark.thorough
@pytest.mark.usefixtures("variant")
def test_a_run_goes_on_only_with_the_velocities_that_it_began_with(tmp_path: Path) -> None:
    channel = simulator(ChannelSonar(), floor=cells_floor())
    poses = np.array([LEVEL] * 3, dtype=float)
    poses[:, 0] += [0.0, 0.1, 0.3]
    flown = Trajectory(poses, np.arange(3.0))
    drift = velocities(flown) + np.linspace(0.0, 0.3, 3)[:, None]
    for name, velocity in (("path", velocities(flown)), ("drift", drift)):
        run_impulse(channel, flown, velocity, Destination(tmp_path / name))
        run_impulse(channel, flown, velocity, Destination(tmp_path / name, resume=True))
    for name, velocity in (("path", drift), ("drift", 2 * drift)):
        with pytest.raises(MitsonarError, match="velocity"):
            run_impulse(channel, flown, velocity, Destination(tmp_path / name, resume=True))
