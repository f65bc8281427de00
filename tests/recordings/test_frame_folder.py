"""Copies of recordings as runs: whole, resumed after a stop, and refused where something else is there."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_frames import over_ground, sway

from mitsonar import MitsonarError, SonarFrames
from mitsonar.instruments.sonar import Sonar, group_of_beams, ping_offsets_s
from mitsonar.mapping.sources import load_frames
from mitsonar.recordings import pictures
from mitsonar.recordings.pictures import write_frames
from mitsonar.recordings.recording import Part, Recording

COUNT = 7


@pytest.fixture(scope="module")
def frames() -> SonarFrames:
    drawn = over_ground(sway(COUNT))
    return replace(drawn, image=(255 * drawn.image).astype(np.uint8), attitude_rad=drawn.poses[:, 3:])  # type: ignore[index]


def of(frames: SonarFrames, stops_at: int | None = None) -> Recording:
    """A recording of frames, whose reading may stop at one of them."""

    def images(index: np.ndarray) -> np.ndarray:
        if stops_at is not None and stops_at in index:
            raise KeyboardInterrupt
        return np.asarray(frames.image[index])

    part = Part(frames.select(slice(0)), frames.time_s, images, frames.poses, frames.attitude_rad, frames.height_m)
    return Recording("drawn", "drawn frames", (part,))


def same(path: Path, frames: SonarFrames) -> None:
    back = SonarFrames.load(path)
    for name in ("image", "range_m", "bearing_rad", "time_s", "poses", "attitude_rad", "height_m"):
        assert (getattr(back, name) == getattr(frames, name)).all(), name
    assert back.image.dtype == frames.image.dtype
    assert (back.sonar, back.level) == (frames.sonar, frames.level)


def test_a_short_recording_becomes_frames_npz(frames: SonarFrames, tmp_path: Path) -> None:
    message: list[int] = []
    result = write_frames(of(frames), None, tmp_path / "run", progress=message.append)
    assert result == tmp_path / "run/frames.npz"
    same(result, frames)
    assert sum(message) == COUNT
    assert SonarFrames.load(result).about["format"] == "drawn frames"
    back = load_frames(tmp_path / "run")
    for name in ("image", "poses", "attitude_rad", "height_m"):
        assert (getattr(back, name) == getattr(frames, name)).all(), name


@pytest.mark.parametrize("longest_npz", [3, 1000])
def test_a_stopped_copy_goes_on_and_gives_the_same(
    frames: SonarFrames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, longest_npz: int
) -> None:
    monkeypatch.setattr(pictures, "CHUNK_BYTES", 2 * frames.image[0].nbytes)
    monkeypatch.setattr(pictures, "MAX_NPZ_FRAMES", longest_npz)
    folder = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        write_frames(of(frames, stops_at=5), None, folder)
    assert len(load_frames_of_unfinished(folder)) == 4
    (folder / "frames.zarr/image/c/4/0").mkdir(parents=True, exist_ok=True)
    (folder / "frames.zarr/image/c/4/0/0.7f.partial").write_bytes(b"half")  # as a kill leaves it
    with pytest.raises(MitsonarError, match="--resume continues it"):
        write_frames(of(frames), None, folder)
    read: list[int] = []
    result = write_frames(of(frames), None, folder, resume=True, progress=read.append)
    assert read == [4, 2, 1]
    assert result.name == ("frames.zarr" if longest_npz < COUNT else "frames.npz")
    same(result, frames)
    monkeypatch.setattr(time, "time", lambda: 1e9)
    whole = write_frames(of(frames), None, tmp_path / "whole")
    assert files_of(result) == files_of(whole)
    assert write_frames(of(frames, stops_at=0), None, folder, resume=True) == result  # nothing is read again


def files_of(made: Path) -> dict[str, bytes]:
    files = [one for one in made.rglob("*") if one.is_file()] if made.is_dir() else [made]
    return {str(one.relative_to(made)): one.read_bytes() for one in files}


def load_frames_of_unfinished(folder: Path) -> SonarFrames:
    with pytest.warns(match="is not finished: 4 of 7"):
        return load_frames(folder)


def test_another_recording_is_not_resumed_and_other_things_are_kept(frames: SonarFrames, tmp_path: Path) -> None:
    write_frames(of(frames), None, tmp_path / "run")
    with pytest.raises(MitsonarError, match="frames"):
        write_frames(of(frames.select(slice(3))), None, tmp_path / "run", resume=True)
    result = write_frames(of(frames.select(slice(3))), None, tmp_path / "run", overwrite=True)
    same(result, frames.select(slice(3)))
    (tmp_path / "other").mkdir()
    (tmp_path / "other/notes.txt").write_text("mine")
    with pytest.raises(MitsonarError, match="contains other files"):
        write_frames(of(frames), None, tmp_path / "other")


def beam_times(sonar: Sonar) -> np.ndarray:
    return ping_offsets_s(sonar)[group_of_beams(sonar)]


@pytest.mark.parametrize("order", ["interleaved", "interleaved_starboard", "sequential"])
@pytest.mark.parametrize("beams", [(24, 72), (48, 96), (0, 96)])
def test_a_crop_keeps_the_times_of_ping_groups(order: str, beams: tuple[int, int]) -> None:
    sonar = Sonar.create(beams=96, ping_groups=8, group_order=order, range_bins=16)
    image = np.zeros((0, 16, 96), np.uint8)
    like = SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.zeros(0), sonar)
    part = Part(like, np.arange(2.0), lambda index: np.zeros((len(index), 16, 96), np.uint8))
    cropped = part.cropped((0, 4), beams).like.sonar  # a shorter window, whose echoes would take less time
    apart = beam_times(cropped) - beam_times(sonar)[slice(*beams)]
    assert apart == pytest.approx(apart[0])
    with pytest.raises(MitsonarError, match=r"got 17,81 of 96 beams; give multiples of (8|12)$"):
        part.cropped(None, (17, 81))
