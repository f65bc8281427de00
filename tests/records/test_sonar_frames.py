"""Frames: the npz file gives back what was written, and what is not frames is refused in one sentence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.records.frames import LABELS, SonarFrames, to_float32, to_uint8

SONAR = Sonar(name="small", beams=6, range_bins=10, bearing="cone", beam_width_deg=0.3)
FRAMES = 4
SHAPE = (FRAMES, SONAR.range_bins, SONAR.beams)


def frames(**changed: Any) -> SonarFrames:
    """Frames with every field filled."""
    rng = np.random.default_rng(3)
    fields: dict[str, Any] = {
        "image": rng.random(SHAPE, dtype=np.float32),
        "range_m": SONAR.range_m,
        "bearing_rad": SONAR.bearing_rad,
        "time_s": np.arange(FRAMES) / 7,
        "sonar": SONAR,
        "poses": rng.normal(size=(FRAMES, 6)),
        "height_m": np.array([1.0, 2.0, np.nan, 4.0]),
        "level_scale": 0.37,
        "elevation_rad": np.where(rng.random(SHAPE) < 0.5, np.nan, 0.1).astype(np.float32),
        "shape_id": rng.integers(-1, 5, SHAPE, dtype=np.int32),
        "object_id": rng.integers(-1, 500, SHAPE, dtype=np.int32),
        "shadow": rng.integers(0, 3, SHAPE, dtype=np.uint8),
        "about": {"scene": "flat", "gain": 2.5},
    }
    return SonarFrames(**{**fields, **changed})


def assert_same(got: SonarFrames, wanted: SonarFrames) -> None:
    """Every field equal, types included."""
    for name, value in vars(wanted).items():
        second = getattr(got, name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(second, value, err_msg=name)
            assert second.dtype == value.dtype, name
        else:
            assert second == value, name


@pytest.mark.parametrize(
    "changed",
    [
        {},
        dict.fromkeys(("poses", "height_m", *LABELS)),
        {"image": np.arange(np.prod(SHAPE)).reshape(SHAPE).astype(np.uint8), "level": "dB"},
        {"time_s": np.arange(FRAMES * SONAR.beams, dtype=float).reshape(FRAMES, -1)},  # a time each beam
    ],
    ids=["full", "bare", "uint8", "beam times"],
)
def test_npz_round_trip(tmp_path: Path, changed: dict[str, Any]) -> None:
    expected = frames(**changed)
    expected.save(tmp_path / "frames.npz")
    assert_same(SonarFrames.load(tmp_path / "frames.npz"), expected)
    assert_same(SonarFrames.load(tmp_path), expected)  # the folder of a run


def test_a_disk_that_is_full_leaves_the_frames_of_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "frames.npz"
    frames().save(path)

    def full(file: Any, **table: Any) -> None:
        with file if hasattr(file, "write") else Path(file).open("wb") as opened:
            opened.write(b"PK")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="No space"):
        frames(poses=None).save(path)
    assert_same(SonarFrames.load(path), frames())
    assert [one.name for one in tmp_path.iterdir()] == ["frames.npz"]


def test_zarr_group_reads_like_npz(tmp_path: Path) -> None:
    import zarr

    expected = frames()
    group = zarr.open_group(tmp_path / "frames.zarr", mode="w")
    for name, array in expected.arrays().items():
        if array.ndim:
            group.create_array(name, data=array)
        else:
            group.attrs[name] = array.item()
    assert_same(SonarFrames.load(tmp_path / "frames.zarr"), expected)
    assert_same(SonarFrames.load(tmp_path), expected)


def test_file_holds_plain_arrays_only(tmp_path: Path) -> None:
    frames().save(tmp_path / "frames.npz")
    with np.load(tmp_path / "frames.npz", allow_pickle=False) as file:
        table = {name: file[name] for name in file.files}
    np.testing.assert_array_equal(table["pitch_rad"], frames().poses[:, 3])  # type: ignore[index]
    assert {"image", "range_m", "bearing_rad", "time_s", "level", "level_scale", "sonar", "about", *LABELS} <= set(table)


def test_select_takes_frames_from_every_field() -> None:
    picked = frames().select(slice(1, 3))
    assert len(picked) == 2
    for name in ("image", "time_s", "poses", "height_m", *LABELS):
        np.testing.assert_array_equal(getattr(picked, name), getattr(frames(), name)[1:3])
    np.testing.assert_array_equal(picked.range_m, SONAR.range_m)
    assert picked.level_scale == 0.37
    np.testing.assert_array_equal(frames().select(np.array([2, 0])).time_s, frames().time_s[[2, 0]])


def test_pitch_is_known_where_poses_are() -> None:
    np.testing.assert_array_equal(frames().pitch_rad, frames().poses[:, 3])  # type: ignore[index]
    assert frames(poses=None).pitch_rad is None


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"image": np.zeros((FRAMES, 10, 7), np.float32)},
            r"image must be \(frames, bins, beams\) = \(4, 10, 6\).*got \(4, 10, 7\)",
        ),
        ({"image": np.zeros((10, 6), np.float32)}, r"image must be .* got \(10, 6\)"),
        ({"time_s": np.zeros(3)}, r"image must be .*\(3, 10, 6\) after time_s"),
        ({"image": np.ones(SHAPE, np.uint16)}, r"uint8 in 0\.\.255, or floats in 0\.\.1: got uint16"),
        ({"level": "log"}, "level must be one of linear, dB, gamma, contrast: got 'log'"),
        ({"poses": np.zeros((3, 6))}, "poses must hold 4 frames: got 3"),
        ({"height_m": np.zeros(5)}, "height_m must hold 4 frames: got 5"),
        ({"shadow": np.zeros((1, 10, 6), np.uint8)}, "shadow must hold 4 frames: got 1"),
    ],
)
def test_fields_that_contradict(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(MitsonarError, match=message):
        frames(**changed)


@pytest.mark.parametrize("name", ["image", "range_m", "bearing_rad", "time_s", "sonar"])
def test_missing_field_is_named(name: str) -> None:
    table = frames().arrays()
    del table[name]
    with pytest.raises(MitsonarError, match=f"some.npz lacks {name}"):
        SonarFrames.from_arrays(table, "some.npz")


@pytest.mark.parametrize("text", ["{", "[1, 2]", '{"beams": 0}', '{"beems": 3}'])
def test_sonar_text_that_is_no_sonar(text: str) -> None:
    with pytest.raises(MitsonarError):
        SonarFrames.from_arrays({**frames().arrays(), "sonar": np.array(text)})


def test_files_that_are_no_frames(tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match=r"no such file: .*absent\.npz"):
        SonarFrames.load(tmp_path / "absent.npz")
    with pytest.raises(MitsonarError, match=r"holds no frames\.npz or frames\.zarr"):
        SonarFrames.load(tmp_path)
    (tmp_path / "text.npz").write_text("not a zip file")
    with pytest.raises(MitsonarError, match="cannot read frames"):
        SonarFrames.load(tmp_path / "text.npz")
    (tmp_path / "void.npz").write_bytes(b"")
    with pytest.raises(MitsonarError, match="cannot read frames"):
        SonarFrames.load(tmp_path / "void.npz")
    np.savez(tmp_path / "pickled.npz", image=np.array([{}], dtype=object))
    with pytest.raises(MitsonarError, match="cannot read frames"):
        SonarFrames.load(tmp_path / "pickled.npz")


def test_damaged_file_is_refused_wherever_the_damage_is(tmp_path: Path) -> None:
    """A byte changed or the end cut off, all over the file: frames as they were, or an error of ours."""
    frames().save(tmp_path / "good.npz")
    whole = (tmp_path / "good.npz").read_bytes()
    bad = tmp_path / "bad.npz"
    others = []
    for place in range(0, len(whole), 23):
        for damaged in (whole[:place], whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :]):
            bad.write_bytes(damaged)
            try:
                assert_same(SonarFrames.load(bad), frames())
            except MitsonarError:
                pass
            except Exception as error:
                others.append(f"{type(error).__name__} at byte {place}: {str(error)[:60]}")
    assert not others, f"{len(others)} times something else, such as " + "\n".join(others[:6])


# ---------------------------------------------------------------- storage as bytes


def test_bytes_never_map_an_echo_to_zero() -> None:
    image = np.array([0, 1e-30, 1e-6, 0.4 / 255, 1 / 255, 0.5, 0.9999, 1, 1.5, -0.2])
    assert to_uint8(image).tolist() == [0, 1, 1, 1, 1, 128, 255, 255, 255, 0]
    assert to_uint8(image.astype(np.float32)).dtype == np.uint8
    levels = np.arange(256, dtype=np.uint8)
    assert (to_uint8(to_float32(levels)) == levels).all()
    assert to_float32(levels)[[0, 255]].tolist() == [0, 1]


def test_bytes_are_the_nearest_level() -> None:
    image = np.random.default_rng(0).random(10_000, dtype=np.float32)
    assert np.abs(to_uint8(image) / 255 - image).max() <= 1 / 255
    stored = image > 1 / 255
    assert np.abs(to_uint8(image)[stored] / 255 - image[stored]).max() <= 0.5001 / 255
