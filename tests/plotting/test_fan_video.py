"""Videos of fans and frames in decibels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_frames import over_ground, sway

from mitsonar import MitsonarError
from mitsonar.plotting.fans import fan_figure, to_decibels, write_fan_video

cv2 = pytest.importorskip("cv2")


@pytest.mark.parametrize("ending", [".mp4", ".avi"])
def test_each_frame_is_a_picture_of_the_video(tmp_path: Path, ending: str) -> None:
    frames = over_ground(sway(5))
    frames.image[:] = 0
    for number in range(5):
        frames.image[number, :, 10 + 16 * number : 18 + 16 * number] = 1  # a ray that goes from port to starboard
    path = tmp_path / f"a{ending}"
    message: list[int] = []
    done = write_fan_video(
        [frames.select(slice(3)), frames.select(slice(3, 5))], path, 8.0, rows=240, progress=message.append
    )
    assert (done, sum(message)) == (5, 5)
    video = cv2.VideoCapture(str(path))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(8)
    middles = []
    while (read := video.read())[0]:
        shown = read[1][60:].astype(float).sum(axis=2)  # below the text
        assert read[1].shape[0] == 240
        assert read[1].shape[1] % 2 == 0
        middles.append((shown.sum(axis=0) @ np.arange(shown.shape[1])) / shown.sum())
    assert len(middles) == 5
    assert (np.diff(middles) > 5).all()
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    frames = over_ground(sway(3))
    with pytest.raises(MitsonarError, match=r"videos must end in \.mp4 or \.avi"):
        write_fan_video([frames], tmp_path / "a.gif", 10)
    with pytest.raises(MitsonarError, match="there is no folder"):
        write_fan_video([frames], tmp_path / "no/a.mp4", 10)
    with pytest.raises(MitsonarError, match="no frames"):
        write_fan_video([], tmp_path / "a.mp4", 10)
    (tmp_path / "b.mp4").write_bytes(b"mine")
    with pytest.raises(MitsonarError, match="exists and is kept"):
        write_fan_video([frames], tmp_path / "b.mp4", 10)
    assert (tmp_path / "b.mp4").read_bytes() == b"mine"


@pytest.mark.parametrize(
    ("level", "value", "decibels"),
    [("linear", 0.01, -20), ("gamma", 0.1, -40), ("dB", 0.5, -40), ("linear", 1.0, 0), ("linear", 1e-9, None)],
)
def test_values_of_each_coding_become_decibels(level: str, value: float, decibels: float | None) -> None:
    """Level 0.01 is -20 dB; amplitude^0.5 of 0.1 is an amplitude of 0.01; half of a span of 80 dB is -40 dB."""
    frames = over_ground(sway(3))
    sonar = frames.sonar.replace(coding_db=80.0, coding_gamma=0.5)
    frames = replace(frames, image=np.full_like(frames.image, value), level=level, sonar=sonar)
    shown = to_decibels(frames, 60)
    assert (shown.level, shown.sonar.coding_db) == ("dB", 60)
    assert shown.image == pytest.approx(0 if decibels is None else 1 + decibels / 60, abs=1e-6)
    assert to_decibels(replace(frames, image=np.zeros_like(frames.image)), 60).image.max() == 0
    below_top = to_decibels(frames, 60, -30).image
    assert below_top == pytest.approx(0 if decibels is None else min(1, 1 + (decibels + 30) / 60), abs=1e-6)


@pytest.mark.parametrize("span_db", [3.0, 4.0, 60.0, 81.66622741539722])
def test_a_figure_states_what_its_levels_refer_to(span_db: float) -> None:
    frames = over_ground(sway(3))
    frames = replace(frames, sonar=frames.sonar.replace(source_level_db=0.0, gain_exponent=0), level_scale=1.0)
    figure = fan_figure(to_decibels(frames, span_db))
    assert figure.axes[1].get_ylabel() == "level (dB re full scale)"


def test_a_span_that_cannot_be_is_refused() -> None:
    with pytest.raises(MitsonarError, match="the span must lie in"):
        to_decibels(over_ground(sway(3)), 0)
    for top_db in (-np.inf, np.nan):
        with pytest.raises(MitsonarError, match="the top must be a finite level"):
            to_decibels(over_ground(sway(3)), 60, top_db)
