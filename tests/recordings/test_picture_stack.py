"""Stacks of pictures in npz files: the real samples, own geometry, damaged arrays."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fans import drawn

from mitsonar import MitsonarError, MitsonarWarning, SonarFrames, create_estimator, open_recording
from mitsonar.instruments.sonar import Sonar
from mitsonar.mapping.sources import open_frames
from mitsonar.recordings.open import detect_format

REAL = Path(__file__).resolve().parents[2].parent / "shared/data/real"
GEOMETRIES = Path(__file__).with_name("geometries")

with_samples = pytest.mark.skipif(not REAL.exists(), reason="needs the recordings of ../shared/data/real")


@with_samples
@pytest.mark.parametrize(("name", "frames"), [("forward_chain", 40), ("translate_tyre", 28)])
def test_stacks_that_tell_their_fan_open_without_a_geometry(name: str, frames: int) -> None:
    recording = open_recording(REAL / f"marine-debris-aris3000/{name}.npz")
    assert (len(recording), len(recording.parts)) == (frames, 1)
    assert (recording.facts["rows"], recording.facts["columns"]) == (480, 320)
    assert not [note for note in recording.notes if "stretch" in note or "apex" in note]
    assert any("up to scale" in note for note in recording.notes)
    sonar = recording.part().like.sonar
    assert sonar.azimuth_fov_deg == pytest.approx(29.9)
    assert sonar.range_max / sonar.range_min == pytest.approx(2.48, abs=0.01)
    assert sonar.range_bins == 429
    pair = recording.part().read([0, 1]).image
    assert pair.dtype == np.float32
    assert np.corrcoef(pair.reshape(2, -1))[0, 1] > {"forward_chain": 0.85, "translate_tyre": 0.75}[name]
    inside = pair[:, 20:-20, 6:-6]
    assert (inside > 0).mean() > 0.98  # the fan fills its cells: told apex, arcs and stretch are those of the pictures


@with_samples
@pytest.mark.parametrize(("name", "rows", "bins"), [("lamprey2", 774, 772), ("lamprey4", 544, 535)])
def test_the_static_videos_of_fish_open_with_their_ready_geometries(name: str, rows: int, bins: int) -> None:
    recording = open_recording(REAL / f"didson-static-video/{name}_first30.npz", GEOMETRIES / f"{name}.yaml")
    part = recording.part()
    assert len(part) == 30
    assert (recording.facts["rows"], recording.facts["columns"]) == (rows, 400)
    assert part.time_s == pytest.approx(np.arange(30) / 10)
    frames = part.read([0, 1])
    assert frames.image.shape == (2, bins, 96)
    expected = {"lamprey2": 0.98, "lamprey4": 0.936}[name]
    assert np.corrcoef(frames.image.reshape(2, -1))[0, 1] == pytest.approx(expected, abs=0.03)
    assert not [note for note in recording.notes if "stretch" in note]
    with pytest.raises(MitsonarError, match="without their geometry"):
        open_recording(REAL / f"didson-static-video/{name}_first30.npz")


@with_samples
@pytest.mark.thorough
@pytest.mark.parametrize("name", ["lamprey2", "lamprey4"])
def test_a_fish_before_a_sonar_at_rest_is_no_motion(name: str) -> None:
    """Height and pitch are guessed: a motion of nothing is nothing over any ground."""
    path, geometry = REAL / f"didson-static-video/{name}_first30.npz", GEOMETRIES / f"{name}.yaml"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MitsonarWarning)  # of metres that are not known
        source = open_frames(path, geometry=geometry).with_geometry(2.0, np.radians(15))
    estimator = create_estimator("direct")
    result = [estimator.estimate(source.read([k, k + 1])) for k in range(0, 29, 4)]
    assert all(one.valid for one in result)
    motions = np.array([one.motion for one in result])
    assert (np.sqrt((motions**2).mean(axis=0)) < [0.01, 0.002, np.radians(0.08)]).all()


def stack(path: Path, **arrays: Any) -> Path:
    np.savez_compressed(path, **arrays)
    return path


def own(**changed: Any) -> dict[str, Any]:
    keys = {"apex_xy": np.array([119.5, 210.25]), "rmin_px": 60.0, "rmax_px": 200.0, "half_fov_deg": 28.0, "kx": 1.0}
    return {"frames": np.stack([drawn(lambda r, b: 0.4 + 0 * r)] * 3), **keys, **changed}


def test_times_and_floats_of_a_stack(tmp_path: Path) -> None:
    recording = open_recording(stack(tmp_path / "a.npz", **own(time_s=np.array([5.0, 6.0, 6.5]))))
    assert recording.part().time_s == pytest.approx([5, 6, 6.5])
    assert recording.part().read([2]).image[0, 20, 30] == pytest.approx(0.4, abs=1e-3)
    assert open_recording(stack(tmp_path / "b.npz", **own(fps=4.0))).part().time_s == pytest.approx([0, 0.25, 0.5])
    images = own()
    images["images"] = images.pop("frames")
    assert len(open_recording(stack(tmp_path / "c.npz", **images))) == 3


def test_a_wrong_stretch_is_noted(tmp_path: Path) -> None:
    squeezed = np.stack([drawn(lambda r, b: 0.4 + 0 * r, stretch=1.24)] * 3)
    recording = open_recording(stack(tmp_path / "a.npz", **own(frames=squeezed)))
    assert any("circle with stretch 1.2" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"frames": np.zeros((3, 20), np.uint8)}, "must be pictures"),
        ({"frames": np.zeros((0, 20, 20), np.uint8)}, "must be pictures"),
        ({"frames": np.full((3, 20, 20), 7.0)}, "floats in 0..1"),
        ({"frames": np.full((3, 20, 20), np.nan)}, "floats in 0..1"),
        ({"frames": np.zeros((3, 20, 20), np.int64)}, "must be pictures"),
        ({"apex_xy": np.array([np.nan, 1.0])}, "apex_xy of .* two numbers"),
        ({"rmin_px": np.array([1.0, 2.0])}, "rmin_px of .* one number"),
        ({"rmax_px": -3.0}, "far_px"),
        ({"kx": 0.0}, "stretch"),
    ],
)
def test_damaged_stacks_are_refused(tmp_path: Path, changed: dict[str, Any], reason: str) -> None:
    with pytest.raises(MitsonarError, match=reason):
        open_recording(stack(tmp_path / "a.npz", **own(**changed)))


def test_cut_files_and_frames_of_mitsonar_are_other_things(tmp_path: Path) -> None:
    whole = stack(tmp_path / "a.npz", **own())
    (tmp_path / "b.npz").write_bytes(whole.read_bytes()[:-200])
    assert detect_format(tmp_path / "b.npz") is None
    content = bytearray(whole.read_bytes())
    content[300:360] = bytes(60)
    (tmp_path / "c.npz").write_bytes(bytes(content))
    with pytest.raises(MitsonarError, match=r"cannot read .*c\.npz"):
        open_recording(tmp_path / "c.npz")
    sonar = Sonar(beams=4, range_bins=8)
    SonarFrames(np.zeros((1, 8, 4), np.float32), sonar.range_m, sonar.bearing_rad, np.zeros(1), sonar).save(
        tmp_path / "f.npz"
    )
    assert detect_format(tmp_path / "f.npz") is None
