"""GLF files of a Gemini, which ``pytritech`` parses: geometry, order of samples, compression, time, damaged files."""

from __future__ import annotations

import pickle
import zipfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import run_python
from recording_files import gemini_file
from scipy import ndimage

from mitsonar import MitsonarError, open_recording
from mitsonar.recordings.recording import Recording

pytest.importorskip("pytritech")

IMAGES = [
    np.rint(255 * one / one.max()).astype(np.uint8)
    for one in ndimage.gaussian_filter(np.random.default_rng(3).random((4, 60, 32)), (0, 1.5, 1.5)) ** 2
]


def opened(folder: Path, **changed: Any) -> Recording:
    path = folder / "a.glf"
    path.write_bytes(gemini_file(IMAGES, **changed))
    return open_recording(path)


@pytest.mark.parametrize("stored", [True, False])
@pytest.mark.parametrize("by_beam", [True, False])
@pytest.mark.parametrize("compression", [0, 1])
def test_images_are_read_as_they_were_written(tmp_path: Path, stored: bool, by_beam: bool, compression: int) -> None:
    recording = opened(tmp_path, stored=stored, by_beam=by_beam, compression=compression)
    frames = recording.part().read([0, 3, 1])
    assert (frames.image == np.stack(IMAGES)[[0, 3, 1]]).all()
    assert any("beam by beam" in note for note in recording.notes) == by_beam
    assert frames.range_m == pytest.approx((10.5 + np.arange(60)) * 1480 / 2 / 30_000)
    assert np.degrees(frames.bearing_rad) == pytest.approx(np.linspace(-60, 60, 32))
    assert frames.sonar.name == "gemini-720is"
    assert (frames.sonar.frequency_hz, frames.sonar.sound_speed) == (720e3, 1480)
    assert np.diff(recording.part().time_s) == pytest.approx(0.1, abs=0.002)
    assert (pickle.loads(pickle.dumps(recording.part())).read([2]).image == IMAGES[2]).all()


@pytest.mark.parametrize("unit", ["degrees", "radians"])
def test_bearings_in_either_unit_and_falling_ones(tmp_path: Path, unit: str) -> None:
    table = np.linspace(60, -60, 32)
    recording = opened(tmp_path, bearings=table if unit == "degrees" else np.radians(table))
    frames = recording.part().read([0])
    assert np.degrees(frames.bearing_rad) == pytest.approx(np.linspace(-60, 60, 32))
    assert (frames.image[0] == IMAGES[0][:, ::-1]).all()


@pytest.mark.parametrize(("flags", "name"), [(1, "gemini-1200ik-1200khz"), (0, "gemini-1200ik-720khz")])
def test_a_1200ik_has_two_frequencies(tmp_path: Path, flags: int, name: str) -> None:
    assert opened(tmp_path, model=4, flags=flags).part().like.sonar.name == name
    assert opened(tmp_path, model=0).part().like.sonar.frequency_hz is None


def test_times_are_those_of_transmission_in_utc(tmp_path: Path) -> None:
    """The file counts seconds of British time since 1980: 1.4e9 is 16:53:20 on 12 May 2024, an hour ahead of UTC."""
    first = datetime.fromtimestamp(float(opened(tmp_path).part().time_s[0]), UTC)
    assert first == datetime(2024, 5, 12, 15, 53, 20, tzinfo=UTC)


def test_older_versions_state_no_compression(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for compression in (0, 1):
        recording = opened(tmp_path, version=2, compression=compression)
        assert (recording.part().read([1]).image[0] == IMAGES[1]).all()
    assert capsys.readouterr().out == ""  # pytritech prints


def test_another_window_begins_another_part(tmp_path: Path) -> None:
    contents = []
    for one in (gemini_file(IMAGES[:2]), gemini_file(IMAGES[2:], start=100, frequency=15_000, first_s=1.4e9 + 1)):
        (tmp_path / "b.zip").write_bytes(one)
        with zipfile.ZipFile(tmp_path / "b.zip") as archive:
            contents.append(archive.read("data_1.dat")[:-2])
    with zipfile.ZipFile(tmp_path / "a.glf", "w") as archive:
        archive.writestr("data_1.cfg", "<log/>")
        archive.writestr("data_1.dat", b"".join(contents) + b"\xde\xde")
    near, far = open_recording(tmp_path / "a.glf").parts
    assert (near.read([1]).image[0] == IMAGES[1]).all()
    assert (far.read([0]).image[0] == IMAGES[2]).all()
    assert far.like.sonar.range_min == pytest.approx(100 * 1480 / 2 / 15_000)


def test_unfit_images_are_left_out_and_damaged_files_refused(tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match="no image that can be read"):
        opened(tmp_path, compression=2)
    with pytest.raises(MitsonarError, match="no image that can be read"):
        opened(tmp_path, speed=0.0)
    path = tmp_path / "a.glf"
    content = gemini_file(IMAGES)
    for damaged in (content[:-40], content[: len(content) // 2], content[:200] + bytes(100) + content[300:], b"PK\x03\x04"):
        path.write_bytes(damaged)
        with pytest.raises(MitsonarError) as refusal:
            open_recording(path).part().read([0, 1, 2, 3])
        assert "\n" not in str(refusal.value)


def test_an_image_that_inflates_beyond_its_size_is_damaged(tmp_path: Path) -> None:
    large = np.zeros((6000, 32), np.uint8)
    content = bytearray(gemini_file([large, large], stored=True))
    end = (10 + 6000).to_bytes(4, "little")
    while end in content:  # the records state 60 ranges
        place = content.index(end)
        content[place : place + 4] = (10 + 60).to_bytes(4, "little")
    path = tmp_path / "a.glf"
    (tmp_path / "b.zip").write_bytes(content)
    with zipfile.ZipFile(tmp_path / "b.zip") as archive:
        info = archive.getinfo("data_1.dat")
        start = info.header_offset + 30 + len(info.filename)
        data = bytes(content[start : start + info.file_size])
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data_1.cfg", "<log/>")
        archive.writestr("data_1.dat", data)
    with pytest.raises(MitsonarError, match="image 0 is damaged"):
        open_recording(path).part().read([0])


def test_without_pytritech_the_extra_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.glf").write_bytes(gemini_file(IMAGES))
    script = f"""
        from mitsonar import MitsonarError, open_recording
        try:
            open_recording({str(tmp_path / "a.glf")!r})
        except MitsonarError as error:
            print(error)
    """
    assert "mitsonar[gemini]" in run_python(script, block=("pytritech",))
