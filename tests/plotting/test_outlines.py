"""Outlines of labelled objects over pictures and videos of frames, and the legend of their names."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_frames import over_ground, sway
from helpers import Command, refused, tiny_recipe
from PIL import Image
from scipy import ndimage

from mitsonar import SonarFrames
from mitsonar.bridges.label_outlines import labelled_recording, outlines_of
from mitsonar.geometry.fan import cartesian_map, nearest_cells
from mitsonar.plotting.fans import fan_figure, write_fan_video
from mitsonar.plotting.outlines import COLOURS, ROW_PX, colours_of, legend_rows, legend_strip

cv2 = pytest.importorskip("cv2")

NAMES = ("sand", "pillar0", "pillar1", "wreck")


@pytest.fixture(scope="module")
def frames() -> SonarFrames:
    """Frames with two pillars on sand, one of which leaves the picture, and a wreck in the last frame."""
    drawn = over_ground(sway(4))
    shape = np.zeros(drawn.image.shape, np.int32)
    shape[:, 40:60, 20:34] = 1
    shape[:2, 80:100, 60:70] = 2
    shape[3, 100:120, 10:30] = 3
    shape[:, :20] = -1
    return replace(drawn, shape_id=shape, shape_names=NAMES)


@pytest.fixture(scope="module")
def run(frames: SonarFrames, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    frames.save(folder / "frames.npz")
    return folder


def test_an_outline_is_the_rim_of_a_region(frames: SonarFrames) -> None:
    """The pixels that erosion takes from the label picture are outlined, and none beyond a pixel from them."""
    fan = cartesian_map(frames.range_m, frames.bearing_rad, rows=400)
    outlines = outlines_of(frames, [("sand", "")])
    drawn = outlines.on(fan, frames, 0)
    assert frames.shape_id is not None
    shape = np.asarray(nearest_cells(fan, frames.shape_id[0], -1))
    rims = [mask & ~ndimage.binary_erosion(mask) for mask in (shape == 1, shape == 2)]
    rim = rims[0] | rims[1]
    assert list(outlines.names) == ["pillar", "wreck"]
    assert (drawn[rim] == 1).all()
    assert (drawn[~ndimage.binary_dilation(rim, np.ones((3, 3)))] == 0).all()
    assert set(np.unique(drawn).tolist()) == {0, 1}
    assert set(np.unique(outlines.on(fan, frames, 3)).tolist()) == {0, 1, 2}


def test_objects_of_one_mesh_have_a_border(frames: SonarFrames) -> None:
    """Two objects of one shape that touch are two regions, with one colour."""
    assert frames.shape_id is not None
    part = np.where(frames.shape_id == 1, 1, 0).astype(np.int32)
    part[:, 40:50, 20:34] *= 2
    fan = cartesian_map(frames.range_m, frames.bearing_rad, rows=400)
    one = outlines_of(frames, [("sand", "")]).on(fan, frames, 2)
    two = outlines_of(frames, [("sand", "")]).on(fan, replace(frames, object_id=part), 2)
    middle = np.asarray(nearest_cells(fan, part[2], 0))
    touching = (middle[1:] == 1) & (middle[:-1] == 2) | (middle[1:] == 2) & (middle[:-1] == 1)
    assert touching.sum() > 20
    assert (two[1:][touching] == 1).all()
    assert (one[1:][touching] == 0).mean() > 0.8


@pytest.mark.thorough
def test_a_figure_names_what_it_shows(frames: SonarFrames) -> None:
    def names_in(index: int) -> list[str]:
        figure = fan_figure(frames, index, outlines=outlines_of(frames, [("sand", "")]))
        return [text.get_text() for legend in figure.legends for text in legend.get_texts()]

    assert names_in(0) == ["pillar"]
    assert names_in(3) == ["pillar", "wreck"]
    assert fan_figure(frames).legends == []
    nothing = replace(frames, shape_id=np.full(frames.image.shape, -1, np.int32))
    assert fan_figure(nothing, outlines=outlines_of(nothing)).legends == []


def test_names_may_hold_dollars(frames: SonarFrames) -> None:
    named = replace(frames, shape_names=tuple(f"$^{name}$" for name in frames.shape_names))
    figure = fan_figure(named, 3, title="a$^$b", outlines=outlines_of(named))
    figure.savefig(io.BytesIO(), dpi=20)
    assert figure.axes[0].get_title() == "a$^$b"


def test_shapes_without_names_have_their_numbers(frames: SonarFrames) -> None:
    figure = fan_figure(replace(frames, shape_names=()), 3, outlines=outlines_of(replace(frames, shape_names=())))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["shape 0", "shape 1", "shape 3"]


def test_a_video_has_outlines_and_a_legend_of_all_classes(frames: SonarFrames, tmp_path: Path) -> None:
    dark = replace(frames, image=np.zeros_like(frames.image))
    pictures = {}
    for name, outlines in (("bare", None), ("drawn", outlines_of(frames, [("sand", "")]))):
        parts = [dark.select(slice(0, 3)), dark.select(slice(3, 4))]
        assert write_fan_video(parts, tmp_path / f"{name}.avi", 5.0, rows=240, outlines=outlines) == 4
        video = cv2.VideoCapture(str(tmp_path / f"{name}.avi"))
        pictures[name] = [video.read()[1] for _ in range(4)]
    bare, drawn = pictures["bare"], pictures["drawn"]
    assert drawn[0].shape == (240 + ROW_PX, *bare[0].shape[1:])
    fan = cartesian_map(frames.range_m, frames.bearing_rad, rows=240)
    for index in (0, 3):
        expected = ndimage.binary_dilation(outlines_of(frames, [("sand", "")]).on(fan, frames, index) > 0, iterations=3)
        bright = drawn[index][30:240, : expected.shape[1]].max(axis=2) > 100
        assert bright.sum() > 100
        assert expected[30:][bright].all()
    assert (bare[0][30:].max(axis=2) < 60).all()
    assert drawn[0][240:].max() > 150


@pytest.mark.parametrize(("count", "rows"), [(1, 1), (3, 1), (12, 3), (100, 4)])
def test_a_legend_has_the_rows_that_it_needs(count: int, rows: int) -> None:
    names = [f"object {number:03}" for number in range(count)]
    assert legend_rows(600, names) == rows
    strip = legend_strip(600, names, rows)
    assert strip.shape == (rows * ROW_PX, 600, 3)
    shown = [kind for kind in range(min(count, len(COLOURS))) if (strip == COLOURS[kind][::-1]).all(axis=2).any()]
    assert shown == list(range(min(count, len(COLOURS))))
    assert strip[-ROW_PX:].any()


def test_colours_repeat_and_are_opaque() -> None:
    table = colours_of(np.arange(len(COLOURS) + 2, dtype=np.int32))
    assert table[0].tolist() == [0, 0, 0, 0]
    assert table[1].tolist() == table[len(COLOURS) + 1].tolist() == [*COLOURS[0], 255]


@pytest.mark.thorough
def test_commands_draw_labels(mitsonar: Command, run: Path, variant: str, tmp_path: Path) -> None:
    from mitsonar.datasets.make import make_dataset

    labels = ("--labels", "--without", "sand")
    done = mitsonar("recording", "show", run, *labels, "-o", tmp_path / "labels.png")
    assert done.returncode == 0, done
    assert mitsonar("recording", "show", run, "-o", tmp_path / "bare.png").returncode == 0
    bare, drawn = (np.asarray(Image.open(tmp_path / f"{name}.png").convert("RGB")) for name in ("bare", "labels"))
    counts = [(picture == COLOURS[0]).all(axis=2).sum() for picture in (bare, drawn)]
    assert counts[0] == 0
    assert counts[1] > 300
    done = mitsonar("recording", "video", run, *labels, "--classes", "pillar*=post", "-o", tmp_path / "a.mp4")
    assert done.returncode == 0, done
    make_dataset(tiny_recipe(labels=["shape_id"], scenes=[{"sequences": 1}]), str(tmp_path / "data.zarr"))
    done = mitsonar("recording", "show", tmp_path / "data.zarr", "--labels", "-o", tmp_path / "data.png")
    assert done.returncode == 0, done
    recording = labelled_recording(str(tmp_path / "data.zarr"))
    assert recording.part().read([0, 2]).shape_id is not None


def test_labels_that_cannot_be_drawn_are_refused(mitsonar: Command, run: Path, frames: SonarFrames, tmp_path: Path) -> None:
    replace(frames, shape_id=None, shape_names=()).save(tmp_path / "bare.npz")
    out = ("-o", tmp_path / "a.png")
    refused(
        mitsonar("recording", "show", tmp_path / "bare.npz", "--labels", *out), "no label shape_id", "render with --labels"
    )
    refused(mitsonar("recording", "show", run, "--without", "sand", *out), "give --labels too")
    refused(mitsonar("recording", "show", run, "--labels", "--without", "sad", *out), "no shape is named 'sad'", "sand")
    refused(mitsonar("recording", "show", run, "--labels", "--topic", "x", *out), "--topic")
    assert not (tmp_path / "a.png").exists()
