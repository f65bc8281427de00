"""Recordings of ranges: SonarRanges in bags, packets of a Sonar 3D-15, and their points in PLY, CSV and MCAP."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from bags import KINDS, Maker, Sent, decoded, pings, smooth, write_bag
from helpers import Command
from recording_files import message, range_image, rip_packet, rip_payload
from scipy.spatial.transform import Rotation

from mitsonar import open_recording
from mitsonar.errors import MitsonarError
from mitsonar.mapping.sources import open_frames
from mitsonar.recordings.open import open_ranges, summary_lines, summary_of
from mitsonar.recordings.range_pings import RangeRecording, write_points
from mitsonar.recordings.ros_messages import ros1_types
from mitsonar.recordings.sonar_3d15 import _unpack_snappy

WLSONAR = json.loads((Path(__file__).parent / "wlsonar_packets.json").read_text())

ANGLE = np.linspace(-1.2, 1.2, 31)
DIRECTIONS = np.stack([0.1 * np.cos(3 * ANGLE), np.sin(ANGLE), -np.cos(ANGLE)], axis=-1)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1)[:, None]
"""A fan that looks down, bent along the track: no cone and no plane has these beams."""


def opened(path: Path, topic: str | None = None) -> RangeRecording:
    recording = open_ranges(path, topic)
    assert recording is not None
    return recording


def over_slope(path: Path, **options: Any) -> Path:
    """A vehicle that turns above the plane z = -10 + 0.2 x; the multibeam is mounted upside down, ahead and rolled."""
    maker = Maker(path.suffix == ".bag")
    mount = Rotation.from_euler("xyz", [160, 5, 20], degrees=True)
    body = [Rotation.from_euler("z", 10.0 * one, degrees=True) for one in range(5)]
    place = np.array([[0.5 * one, 0.1 * one, 0.0] for one in range(5)])
    sent: list[Sent] = [("/tf_static", 1.0, maker.transform(1.0, "base", "multibeam", [0.3, 0, -0.1], mount.as_quat()))]
    for one in range(5):
        sent.append(("/odom", 1.0 + one, maker.odometry(1.0 + one, place[one], body[one].as_quat(), "base")))
        turn = body[one] * mount
        # the beams of the message look down in the world, as a pilot of the fan would steer them
        local = turn.inv().apply(DIRECTIONS)
        start = place[one] + body[one].apply([0.3, 0, -0.1])
        range_m = (-10 + 0.2 * start[0] - start[2]) / (DIRECTIONS[:, 2] - 0.2 * DIRECTIONS[:, 0])
        sent.append(("/mb", 1.0 + one, maker.ranges(range_m, 2 * local, 1.0 + one, **options)))
    return write_bag(path, maker, sent)


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("package", ["marine_acoustic_msgs", "acoustic_msgs"])
def test_points_of_a_turning_vehicle_lie_on_the_ground(tmp_path: Path, name: str, package: str) -> None:
    path = over_slope(tmp_path / name, package=package)
    recording = opened(path)
    assert (len(recording), recording.points.tolist()) == (5, [31] * 5)
    for index, ping in enumerate(recording.pings()):
        x, _, z = recording.in_world(index, ping.points).T
        np.testing.assert_allclose(z, -10 + 0.2 * x, atol=2e-5)  # ranges are float32
        assert ping.intensity.tolist() == list(range(31))
    assert recording.facts["sound_speed"] == 1490
    assert not recording.notes


def test_flagged_beams_and_missing_ranges_have_no_points(tmp_path: Path) -> None:
    flags = np.zeros(31, int)
    flags[[0, 4]] = 1, 6
    path = over_slope(tmp_path / "a", flags=flags, transmit_delays=np.full(31, 0.01), intensities=[])
    maker = Maker(False)
    range_m = np.full(31, 5.0)
    range_m[[2, 3, 5, 6]] = 0, -1, np.nan, np.inf
    directions = DIRECTIONS.copy()
    directions[[7, 8]] = [0, 0, 0], [np.nan, 0, 0]
    sent: list[Sent] = [
        ("/mb", 1.0, maker.ranges(range_m, directions, 1.0)),
        ("/mb", 2.0, maker.ranges(range_m[:30], directions, 2.0)),  # fewer ranges than directions
        ("/mb", 3.0, maker.ranges(range_m, directions, 3.0)),
    ]
    assert opened(path).points.tolist() == [29] * 5
    notes = " ".join(opened(path).notes)
    assert "up to 0.01 s after the time of the header" in notes
    assert "left out: 6.5% of the beams" in notes
    other = opened(write_bag(tmp_path / "b", maker, sent))
    assert other.points.tolist() == [25, 25]
    assert "left out: 1 message that cannot be read: ranges, directions" in other.notes[0]
    (first, _) = other.pings()
    np.testing.assert_allclose(np.linalg.norm(first.points, axis=1), 5)
    # starboard, forward, up of forward, left, up
    kept = np.delete(np.arange(31), [2, 3, 5, 6, 7, 8])
    np.testing.assert_allclose(first.points, 5 * DIRECTIONS[kept][:, [1, 0, 2]] * [-1, 1, 1], rtol=1e-6)


def test_a_bag_with_images_has_frames_unless_the_topic_is_named(tmp_path: Path) -> None:
    maker = Maker(False)
    sent: list[Sent] = [("/mb", 1.0, maker.ranges(np.ones(31), DIRECTIONS, 1.0))]
    path = write_bag(tmp_path / "a", maker, [*pings(maker, smooth()), *sent])
    assert open_ranges(path) is None
    assert open_ranges(path, "/sonar") is None
    assert len(open_recording(path)) == 6
    assert len(opened(path, "/mb")) == 1
    two = write_bag(tmp_path / "two", maker, [*sent, ("/mc", 1.0, sent[0][2])])
    with pytest.raises(MitsonarError, match="several sonars: choose one by --topic /mb, /mc"):
        open_ranges(two)
    with pytest.raises(MitsonarError, match="SonarRanges hold no image: `mitsonar recording convert` writes their points"):
        open_recording(write_bag(tmp_path / "one", maker, sent))


def test_a_geometry_chooses_the_pictures_of_a_bag(mitsonar: Command, tmp_path: Path) -> None:
    maker = Maker(False)
    image = {
        "height": 20,
        "width": 16,
        "encoding": "mono8",
        "is_bigendian": 0,
        "step": 16,
        "data": np.full(320, 9, np.uint8),
    }
    picture = maker.make("sensor_msgs/Image", header=maker.header(1.0, "fan"), **image)
    ranges = maker.ranges(np.ones(31), DIRECTIONS, 1.0)
    path = write_bag(tmp_path / "a", maker, [("/mb", 1.0, ranges), ("/fan", 1.0, picture)])
    (tmp_path / "g.yaml").write_text("layout: polar\nazimuth_fov_deg: 60\nrange_min: 1\nrange_max: 5\n")
    points = mitsonar("recording", "info", path, "--json")
    assert json.loads(points.stdout)["parts"][0]["points"] == 31
    frames = mitsonar("recording", "info", path, "--geometry", tmp_path / "g.yaml", "--json")
    assert json.loads(frames.stdout)["parts"][0]["beams"] == 16


def test_fields_have_the_published_names_and_order() -> None:
    text = ros1_types().generate_msgdef("marine_acoustic_msgs/msg/SonarRanges")[0]
    assert [line.split()[1] for line in text.split("=" * 80)[0].strip().splitlines() if line.strip()] == [
        *("header", "ping_info", "flags", "transmit_delays", "intensities", "beam_unit_vec", "ranges")
    ]


# ---------------------------------------------------------------- Sonar 3D-15


def test_packets_of_wlsonar_give_its_points(tmp_path: Path) -> None:
    path = tmp_path / "a.sonar"
    path.write_bytes(base64.b64decode(WLSONAR["packets"]))
    recording = opened(path)
    assert recording.time_s == pytest.approx(1.7e9 + 0.2 * np.arange(3), abs=1e-6)
    assert recording.points.tolist() == [len(one) for one in WLSONAR["points"]]
    for ping, stated in zip(recording.pings(), WLSONAR["points"], strict=True):
        forward, right, down = np.array(stated).T
        np.testing.assert_allclose(ping.points, np.column_stack([right, forward, -down]), atol=1e-6)
    known = [bool(np.isfinite(ping.intensity).all()) for ping in recording.pings()]
    assert known == [True, True, False]  # the third has no image of strengths
    assert "left out: 1 packet other than images of range and strength" in recording.notes
    text = "\n".join(summary_lines(summary_of(recording)))
    assert "34, 9..13 a ping" in text
    assert "5 x 4" in text


def test_the_first_row_is_the_lowest_and_the_first_column_is_port(tmp_path: Path) -> None:
    pixels = np.zeros((3, 5), int)
    pixels[0, 0], pixels[1, 2] = 2000, 3000
    (tmp_path / "a.sonar").write_bytes(rip_packet(range_image(pixels)))
    (ping,) = opened(tmp_path / "a.sonar").pings()
    corner = 2 * np.array(
        [-np.sqrt(0.5) * np.cos(np.radians(20)), np.sqrt(0.5) * np.cos(np.radians(20)), -np.sin(np.radians(20))]
    )
    np.testing.assert_allclose(ping.points, np.stack([corner, np.array([0.0, 3, 0])]), atol=1e-6)


def test_damage_costs_only_its_packet(tmp_path: Path) -> None:
    pixels = np.full((3, 4), 1000)
    packets = [rip_packet(range_image(pixels, number), packed=number % 2 == 0) for number in range(5)]
    packets[1] = packets[1][:20] + b"x" + packets[1][21:]
    packets[3] = rip_packet(range_image(pixels, 3, f5=9))  # not the width of its pixels
    shaded = rip_packet(rip_payload("BitmapImageGreyscale8", f1=message(f2=2), f5=1, f6=4, f7=3, f10=bytes(12)))
    path = tmp_path / "a.sonar"
    path.write_bytes(b"".join([packets[4], *packets[:3], shaded, packets[3], packets[0][:30]]))
    recording = opened(path)
    assert recording.time_s == pytest.approx(1.7e9 + 0.2 * np.array([0, 2, 4]))
    notes = " ".join(recording.notes)
    assert "images are not in order of time" in notes
    assert "left out: 1 packet that cannot be decoded" in notes
    assert f"skipped: {len(packets[1]) + 30} bytes" in notes
    with pytest.raises(MitsonarError, match="holds points of each ping in place of frames"):
        open_recording(path)
    with pytest.raises(MitsonarError, match="holds points of each ping in place of frames"):
        open_frames(path)
    with pytest.raises(MitsonarError, match="without topics"):
        open_ranges(path, "/sonar")
    path.write_bytes(packets[1])
    with pytest.raises(MitsonarError, match="holds no range image that can be read"):
        open_ranges(path)


def test_strengths_belong_to_the_image_of_their_number_nearby(tmp_path: Path) -> None:
    """Numbers begin anew after a restart; strengths come before or behind their image."""

    def shaded(number: int, level: int) -> bytes:
        return rip_packet(rip_payload("BitmapImageGreyscale8", f1=message(f2=number), f6=4, f7=3, f10=bytes([level] * 12)))

    pixels = np.full((3, 4), 1000)
    later = message(f1=message(f1=1_700_000_009), f2=1)
    images = [
        rip_packet(range_image(pixels, 1)),
        rip_packet(range_image(pixels, 2)),
        rip_packet(range_image(pixels, 1, f1=later)),
    ]
    path = tmp_path / "a.sonar"
    path.write_bytes(b"".join([images[0], shaded(1, 51), shaded(2, 102), images[1], images[2], shaded(1, 204)]))
    assert [float(ping.intensity.max()) for ping in opened(path).pings()] == pytest.approx([0.2, 0.4, 0.8])


@pytest.mark.parametrize(
    ("packed", "unpacked"),
    [
        (b"\x05\x10abcde", b"abcde"),
        (b"\x0a\x08abc\x0d\x03", b"abcabcabca"),  # a copy of 7 bytes, 3 back, which repeats itself
        (b"\x0a\x08abc\x1a\x03\x00", b"abcabcabca"),  # the same with an offset of 2 bytes
        (b"\x0a\x08abc\x1b\x03\x00\x00\x00", b"abcabcabca"),
        (b"\x46\xf0\x45" + b"q" * 70, b"q" * 70),  # a literal whose length takes a byte
    ],
)
def test_snappy(packed: bytes, unpacked: bytes) -> None:
    """By the description of its format."""
    assert _unpack_snappy(packed) == unpacked
    for damaged in (
        packed[:-1],
        b"\x01" + packed[1:],
        packed + b"\x0d\x00",
    ):  # cut off, longer than stated, a copy from 0 back
        with pytest.raises(ValueError, match=r"cut off|stated|outside"):
            _unpack_snappy(damaged)


# ---------------------------------------------------------------- files of points


def test_points_are_written_in_the_world(tmp_path: Path) -> None:
    path = over_slope(tmp_path / "a")
    recording = opened(path)
    xyz = np.concatenate([recording.in_world(index, ping.points) for index, ping in enumerate(recording.pings())])
    for name in ("a.ply", "a.csv", "a.mcap"):
        assert write_points(recording, tmp_path / name) == 155
        with pytest.raises(MitsonarError, match="exists"):
            write_points(recording, tmp_path / name)
    np.testing.assert_allclose(np.asarray(trimesh.load(tmp_path / "a.ply").vertices), xyz)  # type: ignore[attr-defined]
    table = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(table[:, 2:5], xyz, atol=1e-6)
    assert table[31:62, 0] == pytest.approx(2.0)
    messages = decoded(tmp_path / "a.mcap")
    placed = []
    for cloud, moved in zip(messages["/sonar/returns"], messages["/tf"], strict=True):
        pose = moved.transforms[0].transform
        turn = Rotation.from_quat([getattr(pose.rotation, axis) for axis in "xyzw"])
        local = np.frombuffer(cloud.data, np.float32).reshape(-1, 4)
        placed.append(turn.apply(local[:, :3]) + [getattr(pose.translation, axis) for axis in "xyz"])
        assert local[:, 3].tolist() == list(range(31))
    np.testing.assert_allclose(np.concatenate(placed), xyz, atol=1e-5)
    with pytest.raises(MitsonarError, match=r"points are written as \.ply, \.csv, \.mcap"):
        write_points(recording, tmp_path / "a.las")
    with pytest.raises(MitsonarError, match="there is no folder"):
        write_points(recording, tmp_path / "none" / "a.ply")


def test_the_commands_take_points(mitsonar: Command, tmp_path: Path) -> None:
    path = tmp_path / "a.sonar"
    path.write_bytes(base64.b64decode(WLSONAR["packets"]))
    info = mitsonar("recording", "info", path, "--json")
    assert json.loads(info.stdout)["parts"][0]["points"] == 34
    done = mitsonar("recording", "convert", path, "-o", tmp_path / "a.ply")
    assert "34 points of 3 pings in" in done.stdout
    assert "the sonar states no motion" in done.stderr
    refused = mitsonar("recording", "convert", path, "-o", tmp_path / "b.ply", "--part", 1)
    assert refused.returncode == 2
    assert "holds points, and --part applies only to frames" in refused.stderr
