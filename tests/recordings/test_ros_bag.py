"""ROS bags: pings of ROS 1, SQLite and MCAP, order and types of samples, poses, topics, damaged files."""

from __future__ import annotations

import contextlib
import gc
import io
import pickle
import sqlite3
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import BEARING, KINDS, RANGE, TIME, Maker, Sent, pings, smooth, write_bag
from helpers import run_python
from numpy.typing import NDArray
from PIL import Image
from rosbags.rosbag1 import Writer

from mitsonar import MitsonarError, open_recording
from mitsonar.mapping.sources import open_frames
from mitsonar.recordings.ros_messages import OCULUS, PROJECTED, ros1_types


def bag(path: Path, *more: Sent, images: NDArray[Any] | None = None, **options: Any) -> Path:
    maker = Maker(path.suffix == ".bag")
    return write_bag(path, maker, [*pings(maker, smooth() if images is None else images, **options), *more])


def test_definitions_are_the_published_ones() -> None:
    sums = {
        PROJECTED[0]: "c72fc8e29ab227a547720a36666022fd",
        OCULUS[0]: "9f6ad8a7bb36e92c4f0225b11da7ca2e",
        "sonar_oculus/msg/OculusFire": "0ab4b9458f99dac20a81bfd379cffcb5",
    }
    assert {name: ros1_types().generate_msgdef(name)[1] for name in sums} == sums


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("beam_major", [False, True])
def test_pings_are_read_as_they_were_sent(tmp_path: Path, name: str, beam_major: bool) -> None:
    images = smooth()
    recording = open_recording(bag(tmp_path / name, images=images, beam_major=beam_major))
    assert (len(recording), len(recording.parts)) == (6, 1)
    assert any("beam by beam" in note for note in recording.notes) == beam_major
    frames = recording.part().read([0, 3, 5, 1])
    assert frames.image.dtype == np.uint8
    assert (frames.image == images[[0, 3, 5, 1]]).all()
    assert frames.time_s == pytest.approx(TIME[[0, 3, 5, 1]], abs=1e-6)
    assert frames.bearing_rad == pytest.approx(BEARING, abs=1e-15)
    assert frames.range_m == pytest.approx(RANGE, rel=1e-6)
    assert frames.sonar.sound_speed == 1480
    assert frames.sonar.elevation_fov_deg == pytest.approx(np.degrees(0.35), rel=1e-6)
    assert frames.sonar.vertical_pattern == "two_way", "first echoes come from beyond the aperture"
    assert frames.sonar.range_min == pytest.approx(0.975, abs=1e-6)
    assert recording.facts["received_after_s"] == pytest.approx([0.02, 0.02], abs=1e-5)


@pytest.mark.parametrize(("kind", "big"), [("u2", False), ("u4", True), ("i2", True), ("f4", False), ("f8", True)])
def test_samples_of_any_type_become_levels(tmp_path: Path, kind: str, big: bool) -> None:
    images = smooth(kind=np.dtype(kind).type)
    frames = open_recording(bag(tmp_path / "two", images=images, big=big)).part().read(np.arange(6))
    assert frames.image.dtype == np.float32
    most = 1.0 if kind[0] == "f" else np.iinfo(kind).max
    assert frames.image == pytest.approx(images / most, abs=1e-6)


def test_floats_beyond_1_are_divided_by_the_greatest_and_decibels_are_refused(tmp_path: Path) -> None:
    images = smooth(kind=np.float32) * np.float32(7)
    images[2, 3, 4] = np.nan
    recording = open_recording(bag(tmp_path / "two", images=images))
    assert any("floats up to 7" in note for note in recording.notes)
    assert any("nan" in note for note in recording.notes)
    read = recording.part().read([2]).image[0]
    assert read[3, 4] == 0
    assert read[0] == pytest.approx(images[2, 0] / 7, rel=1e-6)
    with pytest.raises(MitsonarError, match="holds floats from -20"):
        open_recording(bag(tmp_path / "dB", images=images - np.float32(20)))


@pytest.mark.parametrize("forward", ["x", "z"])
def test_beams_are_sorted_from_port_to_starboard_in_either_frame(tmp_path: Path, forward: str) -> None:
    images = smooth()
    path = bag(tmp_path / "two", images=images[:, :, ::-1], bearing_rad=BEARING[::-1], forward=forward)
    frames = open_recording(path).part().read([1])
    assert frames.bearing_rad == pytest.approx(BEARING, abs=1e-15)
    assert (frames.image[0] == images[1]).all()


@pytest.mark.parametrize("name", KINDS)
def test_pings_of_an_oculus(tmp_path: Path, name: str) -> None:
    maker, images = Maker(name.endswith(".bag")), smooth()
    centidegrees = np.linspace(-6500, 6500, len(BEARING)).astype(np.int16)
    sent = [("/ping", time, maker.oculus(one, time, centidegrees, 0.02)) for time, one in zip(TIME, images, strict=True)]
    recording = open_recording(write_bag(tmp_path / name, maker, sent))
    frames = recording.part().read(np.arange(6))
    assert (frames.image == images).all()
    assert np.degrees(frames.bearing_rad) == pytest.approx(centidegrees / 100)
    assert frames.range_m[:2] == pytest.approx([0.01, 0.03])
    assert frames.sonar.sound_speed == 1490
    assert frames.sonar.coding_gamma == 0.5  # as in a file of the instrument
    assert "elevation aperture" in " ".join(recording.notes)


def test_a_window_that_changes_makes_parts_and_drifts_of_the_sound_speed_none(tmp_path: Path) -> None:
    maker, images = Maker(False), smooth()
    windows = [RANGE, RANGE * 1.0005, RANGE * 1.001, RANGE + 2, RANGE + 2, RANGE]
    sent = [
        ("/sonar", time, maker.ping(image, time, BEARING, window))
        for time, image, window in zip(TIME, images, windows, strict=True)
    ]
    recording = open_recording(write_bag(tmp_path / "two", maker, sent))
    assert [len(part) for part in recording.parts] == [3, 2, 1]
    assert recording.parts[1].like.range_m == pytest.approx(RANGE + 2, rel=1e-6)
    assert (recording.parts[1].read([0, 1]).image == images[3:5]).all()


def test_without_times_in_the_headers_those_of_reception_count(tmp_path: Path) -> None:
    maker = Maker(True)
    sent = [("/sonar", time, maker.ping(one, 0.0, BEARING, RANGE)) for time, one in zip(TIME, smooth(), strict=True)]
    recording = open_recording(write_bag(tmp_path / "a.bag", maker, sent))
    assert recording.part().time_s == pytest.approx(TIME, abs=1e-6)
    assert any("hold no times" in note for note in recording.notes)


def test_messages_of_one_time_of_reception_are_told_apart(tmp_path: Path) -> None:
    maker, images = Maker(False), smooth()
    sent = [("/sonar", 1.0, maker.ping(one, time, BEARING, RANGE)) for time, one in zip(TIME, images, strict=True)]
    frames = open_recording(write_bag(tmp_path / "two", maker, sent)).part().read([4, 2])
    assert (frames.image == images[[4, 2]]).all()


def test_a_reader_can_be_sent_to_another_process(tmp_path: Path) -> None:
    source = open_frames(bag(tmp_path / "a.bag"))
    again = pickle.loads(pickle.dumps(source.images))
    assert (again(np.array([2])) == source.images(np.array([2]))).all()


@pytest.mark.parametrize("name", KINDS)
def test_a_recording_that_is_gone_leaves_no_file_open(tmp_path: Path, name: str) -> None:
    path = bag(tmp_path / name)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", ResourceWarning)
        recording = open_recording(path)
        recording.part().read([0])
        del recording
        gc.collect()
    assert [str(one.message) for one in said] == []


def test_a_database_by_itself_and_without_definitions(tmp_path: Path) -> None:
    """Bags of ROS 2 before Iron hold no definitions of their messages."""
    path, images = bag(tmp_path / "two"), smooth()
    database = next(path.glob("*.db3"))
    assert (open_recording(database).part().read([3]).image[0] == images[3]).all()
    with contextlib.closing(sqlite3.connect(database)) as opened:
        opened.execute("delete from message_definitions")
        opened.commit()
    for one in (path, database):
        assert (open_recording(one).part().read([2]).image[0] == images[2]).all()


def test_a_definition_that_lacks_a_field_is_named(tmp_path: Path) -> None:
    """Bags of ROS 2 hold the definitions of their messages."""
    fixed = Maker(False).transform(1.0, "base", "sonar", [0, 0, 0], [0, 0, 0, 1])
    database = next(bag(tmp_path / "two", ("/tf_static", 1.0, fixed)).glob("*.db3"))
    with contextlib.closing(sqlite3.connect(database)) as opened:
        opened.execute(
            "update message_definitions set encoded_message_definition = replace(encoded_message_definition, ?, ?)",
            ("geometry_msgs/Quaternion rotation", "geometry_msgs/Quaternion rotatiom"),
        )
        opened.execute("update topics set type_description_hash = ''")
        opened.commit()
    with pytest.raises(MitsonarError, match=r"definition of a message is damaged or of another version: .*'rotation'"):
        open_recording(database)


def test_an_altimeter_whose_messages_are_lost_gives_no_heights(tmp_path: Path) -> None:
    """The metadata of the bag count one."""
    maker, limits = Maker(False), {"field_of_view": 0.1, "min_range": 0.1, "max_range": 50.0, "range": 3.0}
    height = maker.make("sensor_msgs/Range", header=maker.header(1.0), radiation_type=0, **limits)
    path = bag(tmp_path / "two", ("/altitude", 1.0, height))
    with contextlib.closing(sqlite3.connect(next(path.glob("*.db3")))) as opened:
        opened.execute("delete from messages where topic_id in (select id from topics where name = '/altitude')")
        opened.commit()
    assert open_recording(path).part().height_m is None


@pytest.mark.parametrize("packing", ["BZ2", "LZ4"])
def test_packed_bags_of_ros_1(tmp_path: Path, packing: str) -> None:
    maker, writer = Maker(True), Writer(tmp_path / "a.bag")
    writer.set_compression(Writer.CompressionFormat[packing])
    with writer:
        connection = writer.add_connection("/sonar", PROJECTED[0], typestore=maker.types)
        for _, time, message in pings(maker, smooth()):
            writer.write(connection, round(time * 1e9), maker.types.serialize_ros1(message, PROJECTED[0]))
    assert (open_recording(tmp_path / "a.bag").part().read([4]).image[0] == smooth()[4]).all()


# ---------------------------------------------------------------- topics


def test_of_several_sonars_one_is_chosen(tmp_path: Path) -> None:
    maker = Maker(False)
    path = write_bag(tmp_path / "two", maker, [*pings(maker, smooth()), *pings(maker, 255 - smooth(), "/other")])
    with pytest.raises(MitsonarError, match=r"several sonars: choose one of the topics /other, /sonar"):
        open_recording(path)
    assert (open_recording(path, topic="/other").part().read([0]).image == 255 - smooth()[:1]).all()
    assert (open_frames(path, view="/sonar").read([0]).image == smooth()[:1]).all()
    with pytest.raises(MitsonarError, match=r"no topic '/sonr': did you mean /sonar"):
        open_recording(path, topic="/sonr")


def test_bags_without_a_sonar_say_what_they_hold(tmp_path: Path) -> None:
    maker = Maker(True)
    path = write_bag(tmp_path / "a.bag", maker, [("/odom", 1.0, maker.odometry(1.0, [0, 0, 0], [0, 0, 0, 1], "base"))])
    with pytest.raises(
        MitsonarError,
        match=r"holds no messages marine_acoustic_msgs/ProjectedSonarImage or .*: its topics are /odom \(nav_msgs/O",
    ):
        open_recording(path)
    with pytest.raises(MitsonarError, match=r"/odom holds 1 message nav_msgs/Odometry; a sonar's are"):
        open_recording(path, topic="/odom")


# ---------------------------------------------------------------- damage


@pytest.mark.parametrize("name", ["one.bag", "three_mcap", "two"])
def test_cut_bags_are_refused_in_one_sentence(tmp_path: Path, name: str) -> None:
    path = bag(tmp_path / name)
    file = path if path.is_file() else next(one for one in path.iterdir() if one.suffix in (".mcap", ".db3"))
    content = file.read_bytes()
    for end in (0.9, 0.5, 0.1):
        file.write_bytes(content[: int(len(content) * end)])
        with pytest.raises(MitsonarError, match=r"cannot read the bag .*: .*damaged|is not a recording"):
            open_recording(path).part().read(np.arange(6))


def test_a_wrong_name_is_said(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.bag")
    path.rename(tmp_path / "a.orig")
    with pytest.raises(MitsonarError, match=r"must end with \.bag: rename it"):
        open_recording(tmp_path / "a.orig")


@pytest.mark.thorough
def test_without_rosbags_the_extra_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n".ljust(100, b"\0"))
    script = f"""
        import mitsonar
        try:
            mitsonar.open_recording({str(tmp_path / "a.mcap")!r})
        except mitsonar.MitsonarError as error:
            assert "rosbags" in str(error) and "pip install 'mitsonar[ros]'" in str(error), error
        else:
            raise AssertionError("it must be missed")
    """
    run_python(script, block=("rosbags", "mcap"))


# ---------------------------------------------------------------- pictures

POLAR = """
layout: polar
range_min: 1
range_max: 3
azimuth_fov_deg: 58
level: dB
"""


def pictures(maker: Maker, images: NDArray[np.uint8], compressed: bool, encoding: str = "mono8") -> list[Sent]:
    sent: list[Sent] = []
    for time, image in zip(TIME, images, strict=True):
        header, (rows, columns) = maker.header(time), image.shape
        if compressed:
            buffer = io.BytesIO()
            Image.fromarray(image).save(buffer, format="PNG")
            data = np.frombuffer(buffer.getvalue(), np.uint8)
            fields: dict[str, Any] = {"header": header, "format": "png", "data": data}
            sent.append(("/fan", time, maker.make("sensor_msgs/CompressedImage", **fields)))
        else:
            values = image if encoding == "mono8" else np.repeat(image[:, :, None], 3, axis=2)
            step = columns * values.size // image.size
            fields = {
                "header": header,
                "height": rows,
                "width": columns,
                "encoding": encoding,
                "is_bigendian": 0,
                "step": step,
            }
            sent.append(("/fan", time, maker.make("sensor_msgs/Image", **fields, data=values.ravel())))
    return sent


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize(("compressed", "encoding"), [(True, ""), (False, "mono8"), (False, "bgr8")])
def test_pictures_with_a_geometry_are_a_recording(tmp_path: Path, name: str, compressed: bool, encoding: str) -> None:
    maker, images = Maker(name.endswith(".bag")), smooth()
    (tmp_path / "polar.yaml").write_text(POLAR)
    path = write_bag(tmp_path / name, maker, [*pictures(maker, images, compressed, encoding), *pings(maker, images)])
    recording = open_recording(path, tmp_path / "polar.yaml")
    assert recording.facts["topic"] == "/fan"
    frames = recording.part().read([0, 4, 2])
    assert (frames.image == images[[0, 4, 2]]).all()
    assert frames.time_s == pytest.approx(TIME[[0, 4, 2]], abs=1e-6)
    assert frames.level == "dB"
    assert (frames.sonar.range_min, frames.sonar.range_max) == (1, 3)
    assert open_recording(path).facts["topic"] == "/sonar"
    assert open_recording(path, tmp_path / "polar.yaml", "/fan").facts["topic"] == "/fan"


def test_pictures_without_a_geometry_ask_for_one(tmp_path: Path) -> None:
    maker = Maker(False)
    path = write_bag(tmp_path / "two", maker, pictures(maker, smooth(), True))
    with pytest.raises(MitsonarError, match=r"its topics are /fan .*; pictures need a geometry file"):
        open_recording(path)
    with pytest.raises(MitsonarError, match="give a geometry file"):
        open_recording(path, topic="/fan")


def test_a_geometry_is_refused_for_a_sonar(tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match="contains its geometry"):
        open_recording(bag(tmp_path / "two"), "geometry.yaml", "/sonar")
