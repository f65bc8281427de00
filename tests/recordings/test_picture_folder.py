"""Folders of pictures: order, times, odd ones out, polar layouts, hostile files."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from fans import drawn
from numpy.typing import NDArray
from PIL import Image

from mitsonar import MitsonarError, open_recording
from mitsonar.mapping.sources import open_frames
from mitsonar.recordings.pictures import natural_key, times_in_names

POLAR = "layout: polar\nrange_min: 1\nrange_max: 9\nazimuth_fov_deg: 60\nlevel: dB\nelevation_fov_deg: 12\n"


def polar(frames: int = 4, bins: int = 30, beams: int = 20) -> NDArray[np.uint8]:
    return np.random.default_rng(5).integers(1, 256, (frames, bins, beams), dtype=np.uint8)


def ramp(radius: NDArray[np.float64], bearing: NDArray[np.float64]) -> NDArray[np.float64]:
    return (radius - 60) / 300


def folder_of(path: Path, images: NDArray[np.uint8], names: list[str], geometry: str = POLAR) -> Path:
    path.mkdir()
    for image, name in zip(images, names, strict=True):
        Image.fromarray(image).save(path / name)
    if geometry:
        (path / "geometry.yaml").write_text(geometry)
    return path


def test_pictures_are_read_in_natural_order(tmp_path: Path) -> None:
    images = polar(3)
    path = folder_of(tmp_path / "p", images, ["f10.png", "f2.png", "f1.pgm"], POLAR + "frame_rate_hz: 5\n")
    recording = open_recording(path)
    assert recording.notes == ("missing: 7 frames, by the numbers that the sonar gave them",)
    frames = recording.part().read([0, 1, 2])
    assert (frames.image == images[[2, 1, 0]]).all()
    assert frames.image.dtype == np.uint8
    assert frames.time_s == pytest.approx([0, 0.2, 1.8])
    assert frames.level == "dB"
    assert frames.sonar.coding_db == 80
    assert frames.range_m == pytest.approx(1 + (np.arange(30) + 0.5) * 8 / 30)
    assert np.degrees(frames.bearing_rad[[0, -1]]) == pytest.approx([-28.5, 28.5])


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["1692633600123456789.png", "1692633600223456789.png"], [1692633600.123456789, 1692633600.223456789]),
        (["sonar_1692633600123456.png", "sonar_1692633600223456.png"], [1692633600.123456, 1692633600.223456]),
        (["1692633600123.jpg", "1692633600223.jpg"], [1692633600.123, 1692633600.223]),
        (["t1692633600.5.png", "t1692633600.75.png"], [1692633600.5, 1692633600.75]),
        (["1692633600_000000050.png", "1692633600_250000000.png"], [1692633600.00000005, 1692633600.25]),
        (["1692633600.png", "1692633601.png"], [1692633600.0, 1692633601.0]),
    ],
)
def test_names_that_look_like_times_are_times(names: list[str], times: list[float]) -> None:
    result = times_in_names(names)
    assert result is not None
    assert result == pytest.approx(times, abs=1e-6, rel=0)


@pytest.mark.parametrize("names", [["frame0001.png", "frame0002.png"], ["1692633600.png", "f1.png"], ["9999999999.png"], []])
def test_other_names_are_none(names: list[str]) -> None:
    assert times_in_names(names) is None


def test_natural_order() -> None:
    assert sorted(["f10", "F2", "f1", "10", "9"], key=natural_key) == ["9", "10", "f1", "F2", "f10"]


@pytest.mark.parametrize(
    ("keys", "turned"),
    [
        ("rows: far-to-near", lambda image: image[::-1]),
        ("mirror: true", lambda image: image[:, ::-1]),
        ("transposed: true", lambda image: image.T),
        ("transposed: true\nrows: far-to-near\nmirror: true", lambda image: image[::-1, ::-1].T),
    ],
)
def test_polar_pictures_are_turned(tmp_path: Path, keys: str, turned: object) -> None:
    images = polar(2)
    shown = np.stack([turned(one) for one in images])  # type: ignore[operator]
    path = folder_of(tmp_path / "p", np.ascontiguousarray(shown), ["a.png", "b.png"], POLAR + keys)
    assert (open_recording(path).part().read([0, 1]).image == images).all()


@pytest.mark.parametrize("sign", [1, -1])
def test_bearings_may_be_uneven_and_fall(tmp_path: Path, sign: int) -> None:
    bearings = sign * np.array([-30.0, -10, 0, 5, 31])
    text = f"layout: polar\nrange_min: 1\nrange_max: 9\nbearings_deg: {bearings.tolist()}\nlevel: linear\n"
    images = polar(2, beams=5)
    frames = open_recording(folder_of(tmp_path / "p", images, ["a.png", "b.png"], text)).part().read([0])
    assert np.degrees(frames.bearing_rad) == pytest.approx(sorted(bearings))
    assert (frames.image[0] == images[0][:, ::sign]).all()
    wrong = tmp_path / "g.yaml"
    wrong.write_text(text.replace("31.0]", f"31.0, {32 * sign}]"))
    with pytest.raises(MitsonarError, match="6 bearings_deg, and the pictures have 5 beams"):
        open_recording(tmp_path / "p", wrong)


def test_times_may_stand_in_a_file(tmp_path: Path) -> None:
    path = folder_of(tmp_path / "p", polar(3), ["a.png", "b.png", "c.png"], POLAR + "times: times.csv\n")
    (path / "times.csv").write_text("# name, time\nb.png, 3.5\na.png, 3.0\n")
    recording = open_recording(path)
    assert recording.part().time_s == pytest.approx([3, 3.5])
    assert "left out: 1 frame without a valid time" in recording.notes
    (path / "times.csv").write_text("1\n2\n4\n")
    assert open_recording(path).part().time_s == pytest.approx([1, 2, 4])
    for text, reason in [
        ("1\n2\n", "a time for each of 3 pictures"),
        ("a b\n", "must hold lines"),
        ("x.png 3", "lists none"),
    ]:
        (path / "times.csv").write_text(text)
        with pytest.raises(MitsonarError, match=reason):
            open_recording(path)
    (path / "times.csv").unlink()
    with pytest.raises(MitsonarError, match=r"no such file: .*times\.csv"):
        open_recording(path)


def test_fans_are_resampled_and_the_told_pitch_and_height_are_kept(tmp_path: Path) -> None:
    pictures = np.stack([np.rint(drawn(ramp) * 255 * (k + 1)) for k in range(2)]).astype(np.uint8)
    text = (
        "layout: fan\napex_px: [119.5, 210.25]\nnear_px: 60\nfar_px: 200\nhalf_angle_deg: 28\nrange_max: 10\npitch_deg: 30\n"
        "height_m: 2.5\nlevel: gamma\nelevation_fov_deg: 20\nframe_rate_hz: 4\nbeams: 64\n"
    )
    recording = open_recording(folder_of(tmp_path / "p", pictures, ["a.png", "b.png"], text))
    assert recording.notes == ()
    part = recording.part()
    frames = part.read([0, 1])
    assert frames.image.shape == (2, 140, 64)
    assert frames.image[1, 20:-5, 5:-5] == pytest.approx(
        np.broadcast_to(((frames.range_m * 20 - 60) / 150)[20:-5, None], (115, 54)), abs=0.01
    )
    assert frames.sonar.range_min == pytest.approx(3)
    assert frames.sonar.coding == "gamma"
    assert np.degrees(part.attitude_rad[0, :2]) == pytest.approx([30, 0])  # type: ignore[index]
    source = open_frames(tmp_path / "p")
    assert source.read([0]).pitch_rad == pytest.approx(np.radians(30))
    assert source.height_m == pytest.approx([2.5, 2.5])


@pytest.mark.posix
def test_odd_pictures_are_left_out_and_told(tmp_path: Path) -> None:
    path = folder_of(tmp_path / "p", polar(4), [f"{k}.png" for k in range(4)])
    os.mkfifo(path / "7.png")
    (path / "8.png").mkdir()
    (path / "3.png").write_bytes((path / "3.png").read_bytes()[:-30])
    (path / "4.png").write_bytes(b"")
    (path / "5.png").write_bytes(b"no picture")
    Image.fromarray(polar(1, 31)[0]).save(path / "6.png")
    recording = open_recording(path)
    assert len(recording) == 3
    assert any("left out: 5 pictures cut off or damaged" in note for note in recording.notes)
    assert any("left out: 1 picture of another size than 20 x 30" in note for note in recording.notes)


def test_damage_within_a_picture_is_one_sentence(tmp_path: Path) -> None:
    path = folder_of(tmp_path / "p", polar(2), ["0.png", "1.png"])
    content = bytearray((path / "1.png").read_bytes())
    content[60:90] = bytes(30)
    (path / "1.png").write_bytes(bytes(content))
    recording = open_recording(path)
    with pytest.raises(MitsonarError, match=r"cannot read the picture .*1\.png: .*; it is damaged"):
        recording.part().read([1])


def bomb(path: Path, columns: int, rows: int) -> None:
    """Write a PNG file whose header says that it is huge."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b""))


@pytest.mark.parametrize(("columns", "rows"), [(8000, 8000), (12_000, 12_000), (2**30, 2**30), (1, 5)])
def test_absurd_sizes_are_refused_before_they_are_decoded(tmp_path: Path, columns: int, rows: int) -> None:
    (tmp_path / "geometry.yaml").write_text(POLAR)
    bomb(tmp_path / "0.png", columns, rows)
    with pytest.raises(MitsonarError, match="pixels"):
        open_recording(tmp_path)


def test_colours_and_sixteen_bits(tmp_path: Path) -> None:
    path = folder_of(tmp_path / "p", np.zeros((0, 2, 2), np.uint8), [])
    grey = polar(1)[0]
    Image.fromarray(np.dstack([grey, grey // 2, grey])).save(path / "0.png")
    recording = open_recording(path)
    assert any("luminance" in note for note in recording.notes)
    assert recording.part().read([0]).image.dtype == np.uint8
    deep = grey.astype(np.uint16) * 257
    (path / "0.png").unlink()
    Image.fromarray(deep).save(path / "1.png")
    assert open_recording(path).part().read([0]).image[0] == pytest.approx(grey / 255, abs=1e-6)


def test_what_is_missing_is_told(tmp_path: Path) -> None:
    path = folder_of(tmp_path / "p", polar(2), ["0.png", "1.png"], "")
    with pytest.raises(MitsonarError, match=r"give a geometry file \(--geometry FILE\)"):
        open_recording(path)
    (tmp_path / "told.yaml").write_text(POLAR + "frame_rate_hz: 2\n")
    assert len(open_recording(path, tmp_path / "told.yaml")) == 2
    assert len(open_frames(path, geometry=tmp_path / "told.yaml")) == 2
    with pytest.raises(MitsonarError, match=r"cannot read geometry file .*none\.yaml"):
        open_recording(path, tmp_path / "none.yaml")
    (path / "run.json").write_text("{}")  # a run's folder is no recording
    with pytest.raises(MitsonarError, match="is not a recording that mitsonar reads"):
        open_recording(path, tmp_path / "told.yaml")
    with pytest.raises(MitsonarError, match="is not a recording of pictures, and states its geometry"):
        open_frames(path, geometry=tmp_path / "told.yaml")
