"""Messages of ROS bags beyond projected images: pings of a Ping360, raw images, polar pictures of a Sonoptix Echo."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import BEARING, KINDS, TIME, Maker, Sent, smooth, write_bag
from recording_files import head_sweeps

from mitsonar import MitsonarError, open_recording
from mitsonar.instruments.sonar import scans
from mitsonar.recordings.ros_messages import ECHOES, RAW, ros1_types

ANGLES = [*range(-20, 21), *range(19, -21, -1), *range(-19, 21)]
"""A head that goes to and fro [gradian], positive to port."""


def echoes(path: Path, *more: Sent, **changed: Any) -> Path:
    maker = Maker(path.suffix == ".bag")
    sent: list[Sent] = list(more)
    for number, (samples, angle) in enumerate(zip(head_sweeps(ANGLES), ANGLES, strict=True)):
        time_s = 100 + 0.1 * number
        sent.append(("/sonar", time_s + 0.01, maker.echo(samples, angle, time_s, **changed)))
    return write_bag(path, maker, sorted(sent, key=lambda one: one[1]))


# ---------------------------------------------------------------- definitions


def test_definitions_have_these_sums() -> None:
    """That of raw images is published; that of echoes is what ``rosbags`` computes of the published text."""
    sums = {name: ros1_types().generate_msgdef(name)[1] for name in (*RAW, *ECHOES)}
    assert sums[RAW[0]] == sums[RAW[1]] == "84d7210aa67320a9262e0908f3e466c5"
    assert sums[ECHOES[0]] == sums[ECHOES[1]] == "c3a4e4ed79c9e54919e2ef7e62c1eb5e"


# ---------------------------------------------------------------- Ping360


@pytest.mark.parametrize("name", KINDS)
def test_pings_of_a_ping360_become_sweeps(tmp_path: Path, name: str) -> None:
    recording = open_recording(echoes(tmp_path / name))
    frames, samples = recording.part().read([0, 1, 2]), head_sweeps(ANGLES)
    assert frames.image.shape == (3, 20, 41)
    assert np.degrees(frames.bearing_rad) == pytest.approx(0.9 * np.arange(-20, 21))
    # angles are positive to port: the first sweep runs from starboard to port
    assert (frames.image[0].T[::-1] == [list(one) for one in samples[:41]]).all()
    assert np.array_equal(frames.image[1].T, [list(one) for one in samples[40:81]])
    assert frames.time_s[1] == pytest.approx(100 + 0.1 * np.arange(40, 81), abs=1e-6)
    assert frames.range_m == pytest.approx((np.arange(20) + 0.5) * 0.2)
    assert (frames.sonar.sound_speed, frames.sonar.frequency_hz) == (1480, 740e3)
    assert scans(frames.sonar)
    assert recording.facts["frame_id"] == "ping360"
    again = pickle.loads(pickle.dumps(recording.part()))
    assert (again.read([2]).image == frames.image[2]).all()


def test_poses_of_the_bag_are_those_of_every_ping(tmp_path: Path) -> None:
    """A vehicle that moves north at 0.1 m/s: the pose of each beam lies at the time of its ping."""
    maker = Maker(False)
    north = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]  # x of forward, left, up points north
    sent: list[Sent] = [("/tf_static", 99.0, maker.transform(99.0, "base", "ping360", [0.3, 0, 0], [0, 0, 0, 1]))]
    for time_s in np.arange(99.5, 113, 0.25):
        sent.append(("/odom", time_s, maker.odometry(time_s, [0, 0.1 * (time_s - 100), -5], north, "base")))
    part = open_recording(echoes(tmp_path / "two", *sent)).part()
    frames = part.read([0, 1, 2])
    assert frames.beam_poses is not None
    assert frames.poses is not None
    assert frames.beam_poses[..., 1] == pytest.approx(0.3 + 0.1 * (frames.time_s - 100), abs=1e-6)
    assert frames.poses[:, 1] == pytest.approx(0.3 + 0.1 * (part.time_s - 100), abs=1e-6)
    assert frames.beam_poses[..., [0, 3, 4, 5]] == pytest.approx(0, abs=1e-6)
    assert part.cropped(None, (3, 9)).read([1]).beam_poses == pytest.approx(frames.beam_poses[[1], 3:9])


def test_an_unlikely_sound_speed_is_replaced_and_damaged_pings_are_counted(tmp_path: Path) -> None:
    maker = Maker(False)
    lost = [("/sonar", 100.05, maker.echo(b"\1\2", 3, 100.05, range=0))]
    recording = open_recording(echoes(tmp_path / "two", *lost, speed_of_sound=50))
    assert recording.part().like.sonar.sound_speed == 1500
    assert any("1 message that cannot be read" in note for note in recording.notes)


def test_a_head_at_rest_is_refused(tmp_path: Path) -> None:
    maker = Maker(False)
    sent: list[Sent] = [("/sonar", 100 + 0.1 * one, maker.echo(b"\1\2\3", 7, 100 + 0.1 * one)) for one in range(5)]
    with pytest.raises(MitsonarError, match="/sonar: the head of the scanning sonar points to a single angle"):
        open_recording(write_bag(tmp_path / "two", maker, sent))


# ---------------------------------------------------------------- raw images


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("beam_major", [False, True])
def test_raw_images_are_read_in_either_order(tmp_path: Path, name: str, beam_major: bool) -> None:
    """Also with angles that fall: columns are sorted from port to starboard."""
    maker, images = Maker(name.endswith(".bag")), smooth()
    sent: list[Sent] = [
        ("/raw", time, maker.raw(image[:, ::-1], time, BEARING[::-1], beam_major=beam_major))
        for time, image in zip(TIME, images, strict=True)
    ]
    recording = open_recording(write_bag(tmp_path / name, maker, sent))
    frames = recording.part().read([0, 3])
    assert (frames.image == images[[0, 3]]).all()
    assert frames.bearing_rad == pytest.approx(BEARING, abs=1e-6)
    assert frames.range_m == pytest.approx((50 + np.arange(40)) * 1480 / 2 / 37_000)  # two-way travel time
    assert frames.sonar.sound_speed == 1480
    assert frames.sonar.elevation_fov_deg == pytest.approx(np.degrees(0.2), rel=1e-5)
    assert frames.sonar.beam_width_deg == pytest.approx(np.degrees(0.02), rel=1e-5)


@pytest.mark.parametrize(
    "changed",
    [{"sample_rate": 0.0}, {"sample_rate": float("nan")}, {"samples_per_beam": 41}, {"rx_angles": np.zeros(24, np.float32)}],
)
def test_damaged_raw_images_are_refused(tmp_path: Path, changed: dict[str, Any]) -> None:
    maker = Maker(False)
    sent: list[Sent] = [("/raw", 1.0, maker.raw(smooth()[0], 1.0, BEARING, beam_major=False, **changed))]
    with pytest.raises(MitsonarError, match="no message of /raw can be read"):
        open_recording(write_bag(tmp_path / "two", maker, sent))


# ---------------------------------------------------------------- pictures of a Sonoptix Echo

SONOPTIX = "layout: polar\nazimuth_fov_deg: 120\nrange_min: 0\nrange_max: 20\nmirror: true\nlevel: gamma\ncoding_gamma: 1\n"
"""The geometry that the guide gives."""


def test_pictures_of_a_sonoptix_echo(tmp_path: Path) -> None:
    """Rows are ranges, the nearest first, and columns run from starboard to port."""
    maker, images = Maker(False), smooth()
    (tmp_path / "echo.yaml").write_text(SONOPTIX)
    sent: list[Sent] = [
        (
            "/sonar/echo/data",
            time,
            maker.make(
                "sensor_msgs/Image",
                header=maker.header(time, "echo"),
                height=image.shape[0],
                width=image.shape[1],
                encoding="mono8",
                is_bigendian=0,
                step=image.shape[1],
                data=np.ascontiguousarray(image[:, ::-1]).ravel(),
            ),
        )
        for time, image in zip(TIME, images, strict=True)
    ]
    recording = open_recording(write_bag(tmp_path / "two", maker, sent), tmp_path / "echo.yaml")
    frames = recording.part().read([0, 5])
    assert (frames.image == images[[0, 5]]).all()
    assert frames.sonar.range_max == 20
    assert np.degrees(frames.bearing_rad[[0, -1]]) == pytest.approx([-57.5, 57.5])
