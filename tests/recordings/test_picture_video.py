"""Videos of fans: the real ones against their stacks, frames in any order, damaged files."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest

from mitsonar import MitsonarError, open_recording

cv2 = pytest.importorskip("cv2")

REAL = Path(__file__).resolve().parents[2].parent / "shared/data/real/didson-static-video"
GEOMETRIES = Path(__file__).with_name("geometries")

with_samples = pytest.mark.skipif(not REAL.exists(), reason="needs the recordings of ../shared/data/real")


@with_samples
@pytest.mark.parametrize(("name", "frames"), [("lamprey2", 58), ("lamprey4", 70)])
def test_a_video_is_its_stack(name: str, frames: int) -> None:
    video = open_recording(REAL / f"{name}.avi", GEOMETRIES / f"{name}.yaml")
    stack = open_recording(REAL / f"{name}_first30.npz", GEOMETRIES / f"{name}.yaml")
    assert len(video) == frames
    assert video.part().time_s[:3] == pytest.approx([0, 0.1, 0.2])
    for order in ([0, 1, 2], [29, 5], [5]):
        difference = video.part().read(order).image - stack.part().read(order).image
        assert np.abs(difference).max() < 2.5 / 255


def written(path: Path, frames: int = 12) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 8.0, (40, 30))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MJPG")
    for number in range(frames):
        writer.write(np.full((30, 40, 3), 10 + 20 * number, np.uint8))
    writer.release()
    path.with_name("geometry.yaml").write_text(
        "layout: polar\nrange_min: 1\nrange_max: 9\nazimuth_fov_deg: 60\nlevel: dB\nelevation_fov_deg: 12\n"
    )
    return path


def test_frames_are_read_in_any_order(tmp_path: Path) -> None:
    recording = open_recording(written(tmp_path / "a.avi"))
    part = recording.part()
    assert (len(part), recording.notes) == (12, ())
    assert part.time_s == pytest.approx(np.arange(12) / 8)
    order = [3, 0, 11, 4, 5]
    assert part.read(order).image.mean(axis=(1, 2)) == pytest.approx([10 + 20 * one for one in order], abs=2)


def test_a_cut_video_keeps_what_can_be_decoded_and_junk_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.avi")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with contextlib.suppress(MitsonarError):  # builds of FFmpeg differ in what they accept
        assert 0 < len(open_recording(path)) < 12
    path.write_bytes(b"RIFF\x00\x10\x00\x00AVI " + bytes(500))
    with pytest.raises(MitsonarError, match=r"OpenCV cannot open the video|pixels"):
        open_recording(path)
