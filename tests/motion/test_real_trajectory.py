"""Trajectory errors of a real run: ARACATI 2017, a float with DGPS and a BlueView P900-130 (Silveira et al.)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mitsonar.motion.errors import assess
from mitsonar.motion.trajectory import Trajectory

RUN = Path(__file__).resolve().parents[2].parent / "shared/data/real/aracati2017-slam-run"

COMPASS_RAD = np.radians(90.3)
"""Between the compass, clockwise from north, and the map's angle, counter-clockwise from x: 90.3 deg less the compass."""


def column(name: str, *keys: str) -> NDArray[np.float64]:
    table = np.genfromtxt(RUN / name, delimiter=",", names=True)
    return np.column_stack([table[key] for key in keys])


def path_of(place: NDArray[np.float64], angle: NDArray[np.float64], time_s: NDArray[np.float64]) -> Trajectory:
    """A path of the map's axes; headings are clockwise from y."""
    poses = np.zeros((len(place), 6))
    poses[:, :2], poses[:, 5] = place, np.pi / 2 - angle
    return Trajectory(poses, time_s)


@pytest.mark.skipif(not RUN.exists(), reason="needs the recordings of ../shared/data/real")
@pytest.mark.parametrize(("keys", "error_m"), [(("x", "y", "theta"), 1.45), (("dr_x", "dr_y", "dr_theta"), 10.6)])
def test_errors_after_rigid_alignment_are_those_of_the_readme(keys: tuple[str, str, str], error_m: float) -> None:
    """Almost every keyframe has a fix of the DGPS within 0.2 s, which is 0.1 m."""
    (time,), truth = column("groundtruth.csv", "time").T, column("groundtruth.csv", "x", "y", "theta")
    stored = np.diff(time, prepend=-np.inf) > 0
    true = path_of(truth[stored, :2], COMPASS_RAD - truth[stored, 2], time[stored])
    (keyframes,), poses = column("trajectory.csv", "time").T, column("trajectory.csv", *keys)
    result = assess(path_of(poses[:, :2], poses[:, 2], keyframes), true, align="plane", tolerance_s=0.2)
    assert result.frames > 600
    assert result.absolute_rmse_m == pytest.approx(error_m, abs=0.05)
    assert result.path_m == pytest.approx(626, rel=0.05)
