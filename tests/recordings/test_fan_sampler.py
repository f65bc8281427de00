"""Fans resampled to beams and bins: closed forms, squeezed and mirrored pictures, and the way there and back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from fans import FAN, drawn
from numpy.typing import NDArray

from mitsonar import MitsonarError
from mitsonar.geometry.fan import to_cartesian
from mitsonar.recordings.picture_geometry import PictureGeometry
from mitsonar.recordings.pictures import FanSampler

Array = NDArray[np.float64]


def axes(bins: int, beams: int) -> tuple[Array, Array]:
    """Centres of the cells of FAN [px, rad], from the formula."""
    radius = 60 + (np.arange(bins) + 0.5) * 140 / bins
    bearing = np.radians(-28 + (np.arange(beams) + 0.5) * 56 / beams)
    return radius[:, None], bearing[None, :]


def smooth(radius: Array, bearing: Array) -> Array:
    return 0.5 + 0.2 * np.sin(radius / 9) * np.cos(bearing * 12 + radius / 25)


@pytest.mark.parametrize(
    "changed",
    [{}, {"stretch": 1.3}, {"stretch": 0.8}, {"mirror": True}, {"forward": "down"}, {"mirror": True, "forward": "down"}],
)
def test_each_cell_holds_the_value_of_its_place(changed: dict[str, Any]) -> None:
    picture = drawn(smooth, **changed)
    keys = dict(changed)
    apex = (119.5, 210.25 if changed.get("forward") != "down" else 199 - 210.25)
    geometry = PictureGeometry.create(**{**FAN, "apex_px": apex}, range_max=10, **keys)
    sampler = FanSampler.from_geometry(geometry, *picture.shape)
    assert sampler.bins == 140
    result = sampler.apply(picture)
    expected = smooth(*axes(sampler.bins, sampler.beams))
    inner = (slice(3, -3), slice(4, -4))  # cells at the border mix with the dark outside
    assert np.abs(result - expected)[inner].max() < 0.02
    assert np.abs(result - expected)[inner].mean() < 0.003


def test_a_cell_wider_than_pixels_is_the_mean_of_its_area() -> None:
    rng = np.random.default_rng(2)
    noise = rng.random((200, 240)).astype(np.float32)
    geometry = PictureGeometry.create(**FAN, range_max=10, bins=14, beams=7)
    result = FanSampler.from_geometry(geometry, 200, 240).apply(noise)
    v, u = np.indices((200, 240), dtype=float)
    radius, bearing = np.hypot(u - 119.5, 210.25 - v), np.arctan2(u - 119.5, 210.25 - v)
    row, column = ((radius - 60) / 10).astype(int), ((np.degrees(bearing) + 28) / 8).astype(int)
    inside = (radius >= 60) & (radius < 200) & (np.abs(np.degrees(bearing)) < 28)
    count = np.bincount((row * 7 + column)[inside], minlength=98)
    mean = np.bincount((row * 7 + column)[inside], noise[inside], 98) / count
    cut = result[1:-1].ravel() - mean.reshape(14, 7)[1:-1].ravel()
    assert cut.std() < 0.5 * (0.2887 / np.sqrt(np.median(count)))  # nearer to the mean than its own standard deviation
    assert result.std() == pytest.approx(mean.std(), rel=0.25)


def test_there_and_back_through_scan_conversion() -> None:
    ranges, bearings = np.linspace(2, 8, 200), np.radians(np.linspace(-25, 25, 90))
    image = 0.5 + 0.3 * np.sin(ranges * 5)[:, None] * np.cos(bearings * 15)[None, :]
    fan = to_cartesian(image, ranges, bearings, rows=500)
    left, _, low, high = fan.extent
    pixel = (high - low) / 500
    geometry = PictureGeometry.create(
        layout="fan",
        apex_px=(-left / pixel - 0.5, high / pixel - 0.5),
        near_px=2 / pixel,
        far_px=8 / pixel,
        half_angle_deg=25,
        pixels_per_m=1 / pixel,
        bins=200,
        beams=90,
    )
    result = FanSampler.from_geometry(geometry, *fan.image.shape).apply(np.nan_to_num(fan.image))
    at_range = 2 + (np.arange(200) + 0.5) * 6 / 200
    at_bearing = np.radians(-25 + (np.arange(90) + 0.5) * 50 / 90)
    expected = 0.5 + 0.3 * np.sin(at_range * 5)[:, None] * np.cos(at_bearing * 15)[None, :]
    assert np.abs(result - expected)[4:-4, 2:-2].max() < 0.02


def test_bytes_and_floats_agree() -> None:
    picture = drawn(smooth)
    sampler = FanSampler.from_geometry(PictureGeometry.create(**FAN, range_max=10), 200, 240)
    as_bytes = np.rint(picture * 255).astype(np.uint8)
    assert np.abs(sampler.apply(as_bytes) - sampler.apply(picture)).max() <= 0.5 / 255 + 1e-6


def test_nothing_exceeds_full_scale() -> None:
    """Weights that add up to 1 are rounded, and so is 255 of them."""
    sampler = FanSampler.from_geometry(PictureGeometry.create(**FAN, range_max=10), 200, 240)
    assert sampler.apply(np.full((200, 240), 255, np.uint8)).max() == 1


def test_fans_outside_and_too_large_ones_are_refused() -> None:
    away = PictureGeometry.create(**{**FAN, "apex_px": (9000, 9000)}, range_max=10)
    with pytest.raises(MitsonarError, match="lies outside the pictures of 240 x 200"):
        FanSampler.from_geometry(away, 200, 240)
    large = PictureGeometry.create(**FAN, range_max=10, bins=60_000, beams=60_000)
    with pytest.raises(MitsonarError, match="give smaller bins and beams"):
        FanSampler.from_geometry(large, 200, 240)
