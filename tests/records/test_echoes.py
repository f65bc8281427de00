"""Echoes in EXR files: float32 there and back, and files that are not ours are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.records.echoes import CHANNELS, Echoes, load_exr, save_exr

SONAR = Sonar(beams=5, rays_per_beam=9, rays_across=2)
SHAPE = (9, 10)


def echoes() -> Echoes:
    rng = np.random.default_rng(0)
    return Echoes(**{name: rng.random(90, dtype=np.float32) for name in CHANNELS})


def write(path: Path, channels: dict[str, Any]) -> None:
    with OpenEXR.File({"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.scanlineimage}, channels) as file:
        file.write(str(path))


def table() -> dict[str, np.ndarray]:
    return {name: getattr(echoes(), name).reshape(SHAPE) for name in CHANNELS}


def test_channels_are_the_fields() -> None:
    assert (
        *("hit", "range_m", "near_m", "far_m", "reflectivity", "cosine", "solid_angle_sr"),
        *("x", "y", "z", "nx", "ny", "nz", "shape_id", "object_id"),
    ) == CHANNELS


def test_round_trip_is_exact(tmp_path: Path) -> None:
    expected = echoes()
    expected.range_m[:4] = 123.456, 1e-30, 16_777_217, 0
    save_exr(tmp_path / "e.exr", expected, SONAR)
    got = load_exr(tmp_path / "e.exr", SONAR)
    for name in CHANNELS:
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name), err_msg=name)
        assert getattr(got, name).dtype == np.float32


def test_an_ordinary_reader_finds_rows_and_columns(tmp_path: Path) -> None:
    """Row 0 is the highest elevation, column 0 most to port; channels are sorted by name in the file."""
    save_exr(tmp_path / "e.exr", echoes(), SONAR)
    with OpenEXR.File(str(tmp_path / "e.exr"), separate_channels=True) as file:
        assert list(file.channels()) == sorted(CHANNELS)
        np.testing.assert_array_equal(file.channels()["range_m"].pixels, echoes().range_m.reshape(SHAPE))


@pytest.mark.parametrize("name", ["hit", "near_m", "shape_id"])
def test_a_missing_channel_is_named(tmp_path: Path, name: str) -> None:
    channels = table()
    del channels[name]
    write(tmp_path / "e.exr", channels)
    with pytest.raises(MitsonarError, match=f"lacks the channel {name}"):
        load_exr(tmp_path / "e.exr", SONAR)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("range_m", np.nan),
        ("x", np.inf),
        ("hit", 2),
        ("reflectivity", 1.5),
        ("reflectivity", 1e6),
        ("reflectivity", -0.1),
        ("cosine", -1),
        ("solid_angle_sr", 20),
    ],
)
def test_values_out_of_bounds(tmp_path: Path, name: str, value: float) -> None:
    channels = table()
    channels["cosine"][3, 4] = 1
    channels[name][3, 4] = value
    write(tmp_path / "e.exr", channels)
    with pytest.raises(MitsonarError, match=f"channel {name} (holds inf or nan|must lie in)"):
        load_exr(tmp_path / "e.exr", SONAR)


def test_a_law_may_exceed_1_at_flat_angles(tmp_path: Path) -> None:
    """What counts for the sums is reflectivity times cosine."""
    channels = table()
    channels["reflectivity"][3, 4], channels["cosine"][3, 4] = 9.5, 0.1
    write(tmp_path / "e.exr", channels)
    assert load_exr(tmp_path / "e.exr", SONAR).reflectivity.max() == 9.5


def test_another_size_and_no_exr(tmp_path: Path) -> None:
    write(tmp_path / "e.exr", table())
    with pytest.raises(MitsonarError, match=r"must have 20 x 9 rays, like its sonar: got \(9, 10\)"):
        load_exr(tmp_path / "e.exr", SONAR.replace(rays_across=4))
    with pytest.raises(MitsonarError, match="no such echo file"):
        load_exr(tmp_path / "absent.exr", SONAR)
    (tmp_path / "text.exr").write_text("no EXR")
    with pytest.raises(MitsonarError, match="cannot read echoes"):
        load_exr(tmp_path / "text.exr", SONAR)
    whole = (tmp_path / "e.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(MitsonarError):
        load_exr(tmp_path / "cut.exr", SONAR)
