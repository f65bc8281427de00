"""MCAP files: what is written from a run is read back by ``rosbags``, by ``mcap-ros2-support`` and by mitsonar."""

from __future__ import annotations

import io
import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import decoded
from drawn_frames import over_ground, sway
from PIL import Image
from scipy.spatial.transform import Rotation

from mitsonar import MitsonarError, Simulator, SonarFrames, open_recording
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.trajectory import Trajectory
from mitsonar.recordings.ros_pings import is_beam_major
from mitsonar.recordings.write_mcap import SPAN_DB, write_mcap
from mitsonar.records.frames import to_uint8

SONAR = Sonar(beams=24, range_bins=60, range_min=3.0, range_max=6.0, frequency_hz=1.8e6)


@pytest.fixture(scope="module")
def rendered(variant: str) -> SonarFrames:
    """A simulated run with labels: a floor of which each echo's place is known by geometry."""
    from helpers import floor, scene

    simulator = Simulator(scene(floor=floor()), SONAR)
    poses = np.array([[0, 0, 2.5, 0.6, 0.0, 0.3], [0.1, 0.2, 2.5, 0.6, 0.05, 0.35], [0.2, 0.4, 2.6, 0.62, -0.05, 0.4]])
    return simulator.render(Trajectory(poses, np.array([0.0, 0.1, 0.25])), labels=True)


def written(frames: SonarFrames, folder: Path, **options: Any) -> Path:
    path = folder / "run.mcap"
    options = {"full": True, **options}
    assert write_mcap([frames.select(slice(0, 2)), frames.select(slice(2, None))], path, **options) == len(frames)
    return path


def by_rosbags(path: Path) -> dict[str, list[Any]]:
    from rosbags.highlevel import AnyReader

    result = defaultdict(list)
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            result[connection.topic].append(reader.deserialize(raw, connection.msgtype))
    return dict(result)


def plain(message: Any) -> Any:
    """A message of either reader as lists and tables, without its constants."""
    if isinstance(message, np.ndarray | bytes | memoryview):
        return list(bytes(message)) if not isinstance(message, np.ndarray) else message.tolist()
    if isinstance(message, list | tuple):
        return [plain(one) for one in message]
    names = getattr(message, "__dataclass_fields__", None) or getattr(message, "__slots__", None)
    if names is None:
        return message
    return {name: plain(getattr(message, name)) for name in names if not name.startswith("_") and not name.isupper()}


def test_two_readers_agree_on_every_message(rendered: SonarFrames, tmp_path: Path) -> None:
    path = written(rendered, tmp_path)
    first, second = by_rosbags(path), decoded(path)
    assert set(first) == set(second)
    assert set(first) == {"/sonar/image", "/sonar/fan/compressed", "/sonar/points", "/sonar/odometry"} | {
        "/sonar/altitude",
        "/tf",
        "/tf_static",
    }
    for topic, messages in first.items():
        assert len(messages) == (1 if topic == "/tf_static" else len(rendered)), topic
        for one, another in zip(messages, second[topic], strict=True):
            assert plain(one) == plain(another), topic
            assert set(plain(one)) >= ({"transforms"} if topic.startswith("/tf") else {"header"})


@pytest.mark.parametrize("kind", ["uint8", "float32"])
def test_frames_come_back_bit_for_bit(rendered: SonarFrames, tmp_path: Path, kind: str) -> None:
    frames = rendered if kind == "float32" else replace(rendered, image=to_uint8(rendered.image))
    recording = open_recording(written(frames, tmp_path))
    assert recording.notes == ()
    back = recording.part().read(np.arange(len(frames)))
    for name in ("image", "range_m", "bearing_rad", "time_s"):
        assert getattr(back, name).dtype == getattr(frames, name).dtype
        assert (getattr(back, name) == getattr(frames, name)).all(), name
    assert (back.sonar, back.level, back.level_scale) == (frames.sonar, frames.level, frames.level_scale)
    assert back.poses == pytest.approx(frames.poses, abs=1e-12)
    assert back.height_m == pytest.approx(frames.height_m, rel=1e-6)


@pytest.mark.parametrize("level", ["linear", "dB", "gamma"])
def test_samples_are_8_bit_by_default_and_levels_come_back(rendered: SonarFrames, tmp_path: Path, level: str) -> None:
    image = np.where(rendered.image > 0.9, 0, rendered.image)  # some cells without an echo
    frames = replace(rendered, image=image, level=level)
    path = written(frames, tmp_path, full=False)
    result = decoded(path)
    assert "/sonar/points" not in result
    assert {one.image.dtype for one in result["/sonar/image"]} == {0}
    assert set(by_rosbags(path)) == set(result)
    back = open_recording(path).part().read(np.arange(len(frames)))
    assert (back.sonar, back.level, back.level_scale) == (frames.sonar, level, frames.level_scale)
    assert ((back.image > 0) == (frames.image > 0)).all()
    if level == "linear":
        stored = frames.image > 10 ** (-SPAN_DB / 10)
        error_db = 10 * np.log10(back.image[stored] / frames.image[stored])
        assert np.abs(error_db).max() <= SPAN_DB / 255 / 2 + 1e-4
        write_mcap([back], tmp_path / "again.mcap")
        again = open_recording(tmp_path / "again.mcap").part().read(np.arange(len(frames)))
        assert (again.image == back.image).all()
    else:
        assert (back.image == to_uint8(frames.image)).all()


def test_the_record_tells_in_words_how_samples_become_decibels(rendered: SonarFrames, tmp_path: Path) -> None:
    from mcap.reader import make_reader

    path = written(replace(rendered, level_scale=100.0), tmp_path, full=False)
    with path.open("rb") as file:
        record = next(one.metadata for one in make_reader(file).iter_metadata())
    assert json.loads(record["samples"]) == (
        "0 is no echo; level in dB = 80 * (sample / 255 - 1), relative to full scale, which is 20 dB"
    )


def test_points_are_written_on_request(rendered: SonarFrames, tmp_path: Path) -> None:
    small, labelled = (written(rendered, tmp_path, full=False, labels=one, overwrite=True).stat().st_size for one in (0, 1))
    assert small < labelled / 2
    assert len(decoded(tmp_path / "run.mcap")["/sonar/points"]) == len(rendered)


def test_without_its_record_the_messages_alone_tell_ranges_and_bearings(rendered: SonarFrames, tmp_path: Path) -> None:
    path = written(rendered, tmp_path)
    path.write_bytes(path.read_bytes().replace(b"mitsonar", b"somebody"))
    back = open_recording(path).part().read(np.arange(3))
    assert (back.image == rendered.image).all()
    assert back.bearing_rad == pytest.approx(rendered.bearing_rad, abs=1e-15)
    assert back.range_m == pytest.approx(rendered.range_m, rel=1e-7)
    assert back.level == "gamma"


def test_beams_are_where_the_driver_of_the_oculus_puts_them(rendered: SonarFrames, tmp_path: Path) -> None:
    """Forward is z, port is y; samples of one range follow each other."""
    message = decoded(written(rendered, tmp_path))["/sonar/image"][1]
    axes = np.array([(one.x, one.y, one.z) for one in message.beam_directions])
    assert np.arctan2(-axes[:, 1], axes[:, 2]) == pytest.approx(rendered.bearing_rad, abs=1e-15)
    assert (message.image.dtype, message.image.beam_count, message.header.frame_id) == (8, 24, "sonar")
    samples = np.frombuffer(bytes(message.image.data), "<f4").reshape(60, 24)
    assert (samples == rendered.image[1]).all()
    stamp = message.header.stamp
    assert (stamp.sec, stamp.nanosec) == (0, 100_000_000)


def test_points_lie_on_the_floor_of_the_world(rendered: SonarFrames, tmp_path: Path) -> None:
    """Points turned by the transform of their frame have the height 0: labels, axes and poses fit together."""
    result = decoded(written(rendered, tmp_path))
    for cloud, tree in zip(result["/sonar/points"], result["/tf"], strict=True):
        where = tree.transforms[0]
        assert (where.header.frame_id, where.child_frame_id, cloud.header.frame_id) == ("map", "sonar_link", "sonar_link")
        names = [one.name for one in cloud.fields]
        assert names[:4] == ["x", "y", "z", "intensity"]
        table = np.frombuffer(bytes(cloud.data), [(name, "<i4" if name.endswith("_id") else "<f4") for name in names])
        assert len(table) == cloud.width > 300
        turn = where.transform.rotation
        local = np.stack([table[name] for name in "xyz"], axis=-1)
        world = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).apply(local)
        assert world[:, 2] + where.transform.translation.z == pytest.approx(0, abs=0.06)  # a bin is 0.05 m long


def test_a_fan_is_a_picture_with_forward_up(rendered: SonarFrames, tmp_path: Path) -> None:
    shown = {}
    for picture, first in (("png", b"\x89PNG"), ("jpeg", b"\xff\xd8")):
        message = decoded(written(rendered, tmp_path, picture=picture, overwrite=True))["/sonar/fan/compressed"][0]
        content = bytes(message.data)
        assert (message.format, content[: len(first)]) == (picture, first)
        shown[picture] = np.asarray(Image.open(io.BytesIO(content))).astype(int)
    assert np.abs(shown["png"] - shown["jpeg"]).mean() < 2
    rows, columns = np.nonzero(shown["png"])
    assert np.ptp(columns[rows < 20]) > np.ptp(columns[rows > len(shown["png"]) - 20])  # wider far away, which is up


def test_attitudes_of_the_sonars_own_sensors_come_back(tmp_path: Path) -> None:
    attitude = np.array([[0.1, 0.02, 3.0], [0.12, 0.01, 3.1], [0.13, -0.02, 3.14]])
    frames = replace(over_ground(sway(3)), poses=None, height_m=None, attitude_rad=attitude)
    back = open_recording(written(frames, tmp_path)).part()
    assert back.poses is None
    assert back.attitude_rad == pytest.approx(attitude, abs=1e-12)


def test_a_pitch_without_a_heading_comes_back(tmp_path: Path) -> None:
    """Pictures with pitch_deg in their geometry file have no heading; without any attitude a frame keeps none."""
    attitude = np.array([[0.1, 0.02, np.nan], [0.12, 0.01, 3.1], [0.1, 0.0, np.nan]])
    frames = replace(over_ground(sway(3)), poses=None, height_m=None, attitude_rad=attitude)
    back = open_recording(written(frames, tmp_path)).part()
    assert back.attitude_rad == pytest.approx(attitude, abs=1e-12, nan_ok=True)


def test_times_of_the_year_2026_come_back(tmp_path: Path) -> None:
    frames = over_ground(sway(4))
    frames = replace(frames, time_s=frames.time_s + 1_795_000_000.123456)
    assert (open_recording(written(frames, tmp_path)).part().time_s == frames.time_s).all()


def test_a_file_that_is_there_is_kept_and_a_stopped_one_leaves_nothing(tmp_path: Path) -> None:
    frames = over_ground(sway(4))
    path = written(frames, tmp_path)
    before = path.read_bytes()
    with pytest.raises(MitsonarError, match="exists and is kept"):
        write_mcap([frames], path)

    def breaks() -> Any:
        yield frames
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_mcap(breaks(), path, overwrite=True)
    assert path.read_bytes() == before
    assert [one.name for one in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize(
    ("name", "options", "reason"),
    [
        ("a.bag", {}, r"must end with \.mcap"),
        ("no/a.mcap", {}, "there is no folder"),
        ("a.mcap", {"picture": "gif"}, "written as png or jpeg"),
    ],
)
def test_what_cannot_be_written_is_said(tmp_path: Path, name: str, options: dict[str, Any], reason: str) -> None:
    with pytest.raises(MitsonarError, match=reason):
        write_mcap([over_ground(sway(3))], tmp_path / name, **options)
    assert not list(tmp_path.iterdir())


def test_frames_of_other_arrays_or_times_are_refused(tmp_path: Path) -> None:
    frames = over_ground(sway(3))
    with pytest.raises(MitsonarError, match="the same arrays"):
        write_mcap([frames, replace(frames, poses=None)], tmp_path / "a.mcap")
    with pytest.raises(MitsonarError, match="frame times must lie"):
        write_mcap([replace(frames, time_s=frames.time_s - 100)], tmp_path / "a.mcap")
    with pytest.raises(MitsonarError, match="no frames"):
        write_mcap([], tmp_path / "a.mcap")
    assert not list(tmp_path.iterdir())


REAL = Path(__file__).resolve().parents[2].parent / "shared/data/real"


@pytest.mark.skipif(not REAL.exists(), reason="needs the recordings of ../shared/data/real")
@pytest.mark.parametrize("name", ["aris1200-sdk-sample/sample.aris", "oculus-m1200d-three-pings/three_pings_8bit.raw"])
def test_real_recordings_come_back_bit_for_bit(tmp_path: Path, name: str) -> None:
    part = open_recording(REAL / name).part()
    write_mcap(part.chunks(), tmp_path / "a.mcap")
    back, frames = open_recording(tmp_path / "a.mcap").part(), part.read(np.arange(len(part)))
    read = back.read(np.arange(len(back)))
    for column in ("image", "range_m", "bearing_rad", "time_s"):
        assert (getattr(read, column) == getattr(frames, column)).all(), column
    assert (read.sonar, read.level) == (frames.sonar, frames.level)
    for turned in (False, True):
        flat = [one.T.ravel() if turned else one.ravel() for one in frames.image]
        assert is_beam_major(flat, *frames.image.shape[1:]) == turned
    if frames.attitude_rad is not None:
        assert read.attitude_rad == pytest.approx(frames.attitude_rad, abs=1e-9)
