"""Groups of beams that ping one after another, and heads that turn: times and poses."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import (
    RAYS,
    Sonar,
    first_sweeps,
    frame_period_s,
    group_of_beams,
    one_beam,
    overlap_notes,
    scanned,
    scans,
    timed_path,
)
from mitsonar.instruments.sounder import preset
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory

ONE = Sonar.create(beams=1, azimuth_fov_deg=2, elevation_fov_deg=25, range_min=0.5, range_max=7.5)


def test_groups_of_a_didson_and_of_neighbours() -> None:
    sonar = Sonar.create(beams=96, ping_groups=8)
    assert (np.bincount(group_of_beams(sonar)) == 12).all()
    np.testing.assert_array_equal(np.nonzero(group_of_beams(sonar) == 3)[0], 3 + 8 * np.arange(12))
    np.testing.assert_array_equal(group_of_beams(sonar.replace(group_order="sequential")), np.arange(96) // 12)
    back = group_of_beams(sonar.replace(group_order="interleaved_starboard"))
    np.testing.assert_array_equal(back, group_of_beams(sonar)[::-1])


def test_one_ping_a_frame_leaves_a_path_as_it_is() -> None:
    path = Trajectory.between(Pose(0, 0, 1), Pose(0, 1, 1), 3, 1.0)
    timed = timed_path(Sonar(), path)
    assert timed.poses is path.poses
    assert timed.time_s is path.time_s


def test_pings_lie_about_the_time_of_the_frame() -> None:
    sonar = Sonar.create(beams=8, ping_groups=4, group_interval_s=0.1)
    path = Trajectory.between(Pose(0, 0, 1), Pose(0, 3, 1, 0, 0, 0.6), 4, 1.0)
    timed = timed_path(sonar, path)
    np.testing.assert_allclose(timed.time_s.mean(axis=1), path.time_s)
    np.testing.assert_allclose(timed.poses[..., 1], timed.time_s, atol=1e-12)  # 1 m/s, also before the first pose
    np.testing.assert_allclose(timed.poses[..., 5], 0.2 * timed.time_s, atol=1e-12)
    times, poses = timed.of_beams(sonar)
    assert poses is not None
    np.testing.assert_array_equal(times[:, 5], timed.time_s[:, 1])
    np.testing.assert_array_equal(poses[:, 5], timed.poses[:, 1])


def test_sweeps_follow_one_another() -> None:
    sonar = scanned(ONE, overhead_s=0.005)
    assert scans(sonar)
    assert sonar.beams == 400
    sweep = 400 * (2 * 7.5 / 1500 + 0.005)
    timed = timed_path(sonar, Trajectory.between(Pose(0, 0, 1), Pose(0, 8, 1), 17, 1.0))
    assert timed.time_s.shape == (2, 400)
    np.testing.assert_allclose(np.diff(timed.time_s.ravel()), sweep / 400)
    np.testing.assert_allclose(timed.frames.time_s, (0.5 * sweep, 1.5 * sweep))


def test_a_named_head_takes_seconds_a_sweep() -> None:
    """Ping360, a head turned by 0.9 deg: 35 s a turn at 50 m, 9 s at 2 m by its page; by keys as by `scanned`."""
    head = preset("ping360")
    assert scans(head)
    for range_max, turn in ((50.0, 35.0), (2.0, 9.0)):
        assert frame_period_s(head.replace(range_max=range_max)) == pytest.approx(turn, rel=0.03)
    assert frame_period_s(head) == pytest.approx(1 / head.frame_rate_hz, rel=2e-3)
    result = scanned(one_beam(head), overhead_s=0.02)
    assert result == head.replace(
        frame_rate_hz=result.frame_rate_hz, beam_width_deg=result.beam_width_deg, **result.model_dump(include={*RAYS})
    )
    assert frame_period_s(Sonar(frame_rate_hz=8)) == 1 / 8


@pytest.mark.parametrize(
    ("sector", "step", "said"), [(360, 0.7, "whole number of steps"), (400, 1, "at most 360"), (90, 0, "whole number")]
)
def test_sectors_are_checked(sector: float, step: float, said: str) -> None:
    with pytest.raises(MitsonarError, match=said):
        scanned(ONE, sector_deg=sector, step_deg=step)


def test_mistakes_are_told() -> None:
    with pytest.raises(MitsonarError, match="one beam"):
        scanned(Sonar())
    with pytest.raises(MitsonarError, match="each ping group has a beam"):
        Sonar.create(beams=4, ping_groups=5)
    with pytest.raises(MitsonarError, match="a sweep lasts"):
        timed_path(scanned(ONE), Trajectory.between(Pose(0, 0, 1), Pose(0, 1, 1), 2, 1.0))


def test_pings_that_overlap_are_told_with_the_rate_that_would_do() -> None:
    """8 pings of 7.5 ms against 1/21 s; a head that turns follows its own sweeps."""
    didson = preset("didson300").replace(ping_groups=8)
    (note,) = overlap_notes(didson, np.arange(3) / 21)
    assert "the 8 pings of a frame last 0.0597 s and the next frame is due 0.0476 s later" in note
    rate = float(note.partition("frame_rate_hz to ")[2].split()[0])
    assert not overlap_notes(didson, np.arange(3) / rate)
    assert overlap_notes(didson, np.arange(3) / (rate * 1.01))
    for fine in (preset("didson300"), preset("ping360")):
        assert not overlap_notes(fine, np.arange(3) / 21)
    assert not overlap_notes(didson, np.zeros(1))


def test_frames_of_a_head_count_its_first_sweeps() -> None:
    sonar = scanned(ONE, overhead_s=0.005)
    path = Trajectory.between(Pose(0, 0, 1), Pose(0, 8, 1), 17, 1.0)  # 16 s, two sweeps of 6 s
    whole, one = timed_path(sonar, path), timed_path(sonar, first_sweeps(sonar, path, 1))
    np.testing.assert_allclose(one.time_s, whole.time_s[:1])
    np.testing.assert_allclose(one.poses, whole.poses[:1], atol=1e-12)
    assert np.ptp(one.poses[0, :, 1]) > 2.9  # it goes on while the head turns
    with pytest.raises(MitsonarError, match=r"a sweep lasts 6 s and the path 16 s, room for 2: got 3"):
        first_sweeps(sonar, path, 3)
