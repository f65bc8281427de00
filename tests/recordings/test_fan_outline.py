"""The outline of fans: what it tells of drawn and of real pictures, and what it doubts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fans import FAN, drawn
from numpy.typing import NDArray

from mitsonar.recordings.picture_geometry import PictureGeometry, doubts, load_geometry, outline_of

REAL = Path(__file__).resolve().parents[2].parent / "shared/data/real"
Array = NDArray[np.float64]

with_samples = pytest.mark.skipif(not REAL.exists(), reason="needs the recordings of ../shared/data/real")


def speckled(radius: Array, bearing: Array) -> Array:
    """Echoes with dark holes, one of them at an edge and one at the arc."""
    dark = (np.hypot(radius - 110, (bearing + 0.45) * 110) < 14) | (np.hypot(radius - 195, bearing * 195) < 12)
    return np.where(dark, 0, np.random.default_rng(1).random(radius.shape) * 200 + 30)


@pytest.mark.parametrize("stretch", [1.0, 1.24, 0.85])
def test_the_outline_of_a_drawn_fan_tells_its_geometry(stretch: float) -> None:
    result = outline_of(drawn(speckled, stretch=stretch))
    assert result is not None
    assert result.stretch == pytest.approx(stretch, rel=0.03)
    assert result.half_angle_deg == pytest.approx(28, abs=0.6)
    assert result.apex_px == pytest.approx((119.5, 210.25), abs=2.5)
    assert result.far_px == pytest.approx(200, abs=2.5)


def test_squeezed_pictures_are_doubted_and_the_stretch_is_told() -> None:
    squeezed = drawn(speckled, stretch=1.24)
    message = PictureGeometry.create(**FAN, range_max=10)
    assert "circle with stretch 1.2" in doubts(message, squeezed)[0]
    assert doubts(PictureGeometry.create(**FAN, range_max=10, stretch=1.24), squeezed) == []
    assert doubts(message, drawn(speckled)) == []
    assert doubts(message, np.flipud(drawn(speckled)))[0].startswith("the pictures show no outline")


def test_other_apexes_angles_and_arcs_are_doubted() -> None:
    picture = drawn(speckled)
    apex = PictureGeometry.create(**{**FAN, "apex_px": (119.5, 225)}, range_max=10)
    assert any("meet at (119" in note for note in doubts(apex, picture))
    angle = PictureGeometry.create(**{**FAN, "half_angle_deg": 25}, range_max=10)
    assert any("open 2" in note for note in doubts(angle, picture))
    far = PictureGeometry.create(**{**FAN, "far_px": 190}, range_max=10)
    assert any("far arc lies at" in note for note in doubts(far, picture))


def test_pictures_without_a_fan_have_no_outline() -> None:
    assert outline_of(np.zeros((200, 200), np.uint8)) is None
    assert outline_of(np.full((200, 200), 255, np.uint8)) is None
    assert outline_of(np.random.default_rng(0).integers(0, 256, (200, 200))) is None


@with_samples
@pytest.mark.parametrize(
    ("name", "stretch", "half", "apex", "far"),
    [
        ("marine-debris-aris3000/forward_chain", 1.24, 14.95, (159.42, 745.8), 718.0),
        ("marine-debris-aris3000/translate_tyre", 1.24, 14.95, (159.42, 745.8), 718.0),
        ("didson-static-video/lamprey2_first30", 1.0, 14.15, (199.1, 810.1), 809.5),
        ("didson-static-video/lamprey4_first30", 1.0, 14.15, (199.4, 807.2), 806.3),
    ],
)
def test_the_outline_of_real_fans_is_as_measured(
    name: str, stretch: float, half: float, apex: tuple[float, float], far: float
) -> None:
    frames = np.load(REAL / f"{name}.npz")["frames"]
    result = outline_of(frames[::2].max(axis=0))
    assert result is not None
    assert result.stretch == pytest.approx(stretch, rel=0.01)
    assert result.half_angle_deg == pytest.approx(half, abs=0.1)
    assert result.apex_px == pytest.approx(apex, abs=2.5)
    assert result.far_px == pytest.approx(far, abs=2.5)


@with_samples
def test_the_ready_geometries_agree_with_their_videos() -> None:
    for name in ("lamprey2", "lamprey4"):
        geometry = load_geometry(Path(__file__).with_name("geometries") / f"{name}.yaml")
        frames = np.load(REAL / f"didson-static-video/{name}_first30.npz")["frames"]
        assert doubts(geometry, frames.max(axis=0)) == []
