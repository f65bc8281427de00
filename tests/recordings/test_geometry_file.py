"""Geometry files: keys that belong together, window, what is assumed, and the files beside a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mitsonar import MitsonarError
from mitsonar.recordings.picture_geometry import PictureGeometry, find_geometry_file, load_geometry

FAN: dict[str, Any] = {"layout": "fan", "apex_px": [10, 99], "near_px": 20, "far_px": 80, "half_angle_deg": 15}
POLAR: dict[str, Any] = {"layout": "polar", "range_min": 1, "range_max": 9, "azimuth_fov_deg": 60}


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        ({**FAN, "range_max": 4, "aperture": 3}, "unknown geometry key aperture: .*apex_px"),
        ({**FAN, "range_max": 4, "apex_pix": 3}, "unknown geometry key apex_pix: did you mean apex_px"),
        ({"layout": "fan", "range_max": 4}, "needs apex_px, near_px, far_px, half_angle_deg"),
        (FAN, "needs its scale: give either pixels_per_m or range_max"),
        ({**FAN, "range_max": 4, "pixels_per_m": 20}, "either pixels_per_m or range_max"),
        ({**FAN, "range_max": 4, "far_px": 21}, "far_px must exceed near_px"),
        ({**FAN, "range_max": 4, "bearings_deg": [1, 2]}, "bearings_deg do not apply to the layout fan"),
        ({**POLAR, "apex_px": [1, 2]}, "apex_px do not apply to the layout polar"),
        ({**POLAR, "range_min": 9}, "range_max must exceed range_min"),
        ({"layout": "polar", "azimuth_fov_deg": 60, "range_max": 3}, "needs range_min and range_max"),
        ({**POLAR, "bearings_deg": [1, 2]}, "either azimuth_fov_deg or bearings_deg"),
        ({"layout": "polar", "range_min": 1, "range_max": 9, "bearings_deg": [1, 3, 2]}, "must increase, or decrease"),
        ({"layout": "polar", "range_min": 1, "range_max": 9, "bearings_deg": [1, 2], "mirror": True}, "omit mirror"),
        ({"layout": "cone"}, "geometry layout: .* got 'cone'"),
        ({}, "geometry lacks layout"),
    ],
)
def test_keys_that_do_not_fit_are_refused_in_one_sentence(keys: dict[str, Any], reason: str) -> None:
    with pytest.raises(MitsonarError, match=reason):
        PictureGeometry.create(**keys)


def test_the_window_follows_from_the_scale() -> None:
    assert PictureGeometry.create(**FAN, pixels_per_m=20).window_m == (1, 4)
    assert PictureGeometry.create(**FAN, range_max=8).window_m == (2, 8)
    assert PictureGeometry.create(**FAN, range_max=8, range_min=3).window_m == (3, 8)
    assert PictureGeometry.create(**POLAR).window_m == (1, 9)
    start, end = PictureGeometry.create(**FAN, scale_known=False).window_m
    assert start / end == pytest.approx(20 / 80)


def test_what_is_assumed_is_said() -> None:
    whole = {"level": "dB", "elevation_fov_deg": 14}
    assert PictureGeometry.create(**FAN, **whole, range_max=8).notes() == []
    assert "up to scale" in PictureGeometry.create(**FAN, **whole, scale_known=False).notes()[0]
    assert "check the apex" in PictureGeometry.create(**FAN, **whole, range_max=8, range_min=3).notes()[0]
    assert [note.split()[0] for note in PictureGeometry.create(**POLAR).notes()] == ["level", "elevation_fov_deg"]


def test_a_file_is_read_and_its_faults_name_it(tmp_path: Path) -> None:
    path = tmp_path / "fan.yaml"
    path.write_text("layout: fan\napex_px: [10, 99]\nnear_px: 20\nfar_px: 80\nhalf_angle_deg: 15\nrange_max: 8\n")
    assert load_geometry(path) == PictureGeometry.create(**FAN, range_max=8)
    for text, reason in [
        ("layout: fan\nkx: 3", f"{path}: unknown geometry key kx"),
        ("- fan", "must hold `key: value` lines"),
        ("layout: [", "not YAML"),
        (path.read_text().replace("[10,", "[.nan,"), "not finite"),
        (path.read_text() + "pitch_deg: .nan", "pitch_deg|not finite"),
    ]:
        (tmp_path / "bad.yaml").write_text(text)
        with pytest.raises(MitsonarError, match=reason.replace("bad", "fan") if "kx" not in reason else "bad.yaml: unknown"):
            load_geometry(tmp_path / "bad.yaml")


def test_the_file_beside_a_recording_is_found(tmp_path: Path) -> None:
    (tmp_path / "pings").mkdir()
    video = tmp_path / "a.avi"
    assert find_geometry_file(video) is None
    assert find_geometry_file(tmp_path / "pings") is None
    order = ["geometry.yaml", "a.yaml", "a.avi.yaml"]
    for name in order:
        (tmp_path / name).write_text("layout: polar")
        assert find_geometry_file(video) == tmp_path / name
    (tmp_path / "pings/geometry.yaml").write_text("layout: polar")
    assert find_geometry_file(tmp_path / "pings") == tmp_path / "pings/geometry.yaml"


def test_every_key_is_in_the_reference() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs/reference/files.md").read_text()
    missing = [key for key in PictureGeometry.model_fields if f"`{key}`" not in page]
    assert not missing
