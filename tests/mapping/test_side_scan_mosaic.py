"""Mosaics of side-scans: cells show the ground that was drawn ray by ray, and GeoTIFF files say where on the Earth."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from drawn_side_scans import amplitude_to_level, blocks, drawn, line
from helpers import essence

from mitsonar.errors import MitsonarError
from mitsonar.mapping.mosaic import Mosaic, MosaicOptions, save_geotiff
from mitsonar.mapping.side_scan_mosaic import build_side_scan_mosaic
from mitsonar.motion.utm import UtmOrigin
from mitsonar.records.soundings import Echogram

CELL = MosaicOptions(cell_m=0.1)


def centres(mosaic: Mosaic) -> tuple[np.ndarray, np.ndarray]:
    """East and north of the centres of cells."""
    west, _, _, north = mosaic.extent
    rows, columns = np.indices(mosaic.mean.shape)
    return np.asarray(west + (columns + 0.5) * mosaic.cell_m), np.asarray(north - (rows + 0.5) * mosaic.cell_m)


def error_of(mosaic: Mosaic, echogram: Echogram, shift: tuple[float, float] = (0.0, 0.0)) -> float:
    """RMS difference to the drawn pattern, moved by a shift, where the map is known and rays are not too steep."""
    x, y = centres(mosaic)
    full_scale = np.percentile(echogram.levels, 99.9)
    expected = amplitude_to_level(blocks(x + shift[0], y + shift[1]) / full_scale)
    pose = echogram.poses[0]
    across = (x - pose[0]) * np.cos(pose[5]) - (y - pose[1]) * np.sin(pose[5])
    known = np.isfinite(mosaic.mean) & (np.abs(across) > 3)
    assert known.sum() > 2000
    return float(np.sqrt(np.mean((mosaic.mean - expected)[known] ** 2)))


TURNED = (2.5, 0.3, 0.0)


@pytest.mark.parametrize(
    ("heading", "pitch", "roll"), essence([(0.0, 0.0, 0.0), (0.9, 0.0, 0.1), TURNED, (-1.2, -0.2, -0.15)], TURNED)
)
def test_cells_show_the_ground_below_them(heading: float, pitch: float, roll: float) -> None:
    """The error is least where the pattern is, and a shift of two cells in any direction doubles it."""
    poses = line(80, heading=heading, pitch=pitch, roll=roll)
    poses[:, 2] = np.linspace(5, 7, 80)
    echogram = drawn(poses)
    mosaic = build_side_scan_mosaic(echogram, poses[:, 2], CELL, flatten=False)
    right = error_of(mosaic, echogram)
    assert right < 0.012
    for shift in ((0.2, 0.0), (-0.2, 0.0), (0.0, 0.2), (0.0, -0.2)):
        assert error_of(mosaic, echogram, shift) > 2 * right


@pytest.mark.thorough
def test_errors_fall_with_the_size_of_cells() -> None:
    echogram = drawn(line(120, step=0.1))
    errors = [
        error_of(build_side_scan_mosaic(echogram, 6.0, MosaicOptions(cell_m=cell), flatten=False), echogram)
        for cell in (0.4, 0.2, 0.1)
    ]
    assert errors[0] > 1.5 * errors[1] > 2.2 * errors[2]


def test_strips_have_no_holes_and_gaps_stay_open() -> None:
    """Cells finer than the distance of pings; a pause of 5 m; and a turn between two pings."""
    poses = line(60, step=0.3)
    poses[30:, 1] += 5
    mosaic = build_side_scan_mosaic(drawn(poses), 6.0, MosaicOptions(cell_m=0.05), flatten=False)
    x, y = centres(mosaic)
    inside = np.abs(x - 40) < 20
    gap = (y > poses[29, 1] + 0.1) & (y < poses[30, 1] - 0.1)
    assert np.isnan(mosaic.mean[inside & gap]).all()
    for first, last in ((0, 29), (30, 59)):
        strip = inside & (y > poses[first, 1] + 0.1) & (y < poses[last, 1] - 0.1)
        assert np.isfinite(mosaic.mean[strip]).all()
    turned = line(20)
    turned[10:, 5] += 0.5
    swept = build_side_scan_mosaic(drawn(turned), 6.0, CELL, flatten=False)
    x, y = centres(swept)
    # between the last line before the turn and the first after it, to port and ahead
    angle = np.arctan2(y - turned[10, 1], 40 - x)
    wedge = (angle > 0.1) & (angle < 0.4) & (np.hypot(x - 40, y - turned[10, 1]) > 15) & (x < 40)
    assert np.isnan(swept.mean[wedge]).mean() > 0.9


def test_counts_and_spread_are_those_of_pings() -> None:
    """Two passes of the same line with different levels: means between them, and the spread of both."""
    once = drawn(line(40, step=0.1), lambda x, y: np.full_like(x, 0.2))
    twice = replace(
        once,
        time_s=np.concatenate([once.time_s, once.time_s + 100]),
        poses=np.concatenate([once.poses, once.poses]),
        levels=np.concatenate([once.levels, 0.25 * once.levels]),
        height_m=np.concatenate([once.height_m, once.height_m]),
    )
    one, two = (build_side_scan_mosaic(each, 6.0, MosaicOptions(cell_m=0.5), flatten=False) for each in (once, twice))
    middle = np.s_[2:-2, 10:20]
    np.testing.assert_array_equal(two.count[middle], 2 * one.count[middle])
    step = -np.log10(0.25) / 6
    np.testing.assert_allclose(two.mean[middle], one.mean[middle] - step / 2, atol=1e-3)
    count = two.count[middle]
    np.testing.assert_allclose(two.std[middle], step / 2 * np.sqrt(count / (count - 1)), rtol=0.02)
    assert two.frames == 80


def test_a_diagonal_strip_takes_the_memory_of_its_cells() -> None:
    """At 45 deg the box around a strip is nearly the whole map, of which it fills about 1 %."""
    echogram = drawn(line(3, heading=np.pi / 4))
    tracemalloc.start()
    try:
        mosaic = build_side_scan_mosaic(echogram, 6.0, MosaicOptions(cell_m=0.02), flatten=False)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert (mosaic.count > 0).mean() < 0.03
    assert peak < 1.5 * mosaic.state_bytes


def test_flattening_removes_the_beam_pattern_and_keeps_the_ground() -> None:
    """A level that falls by 25 dB from straight down to the side, the same on all pings, and squares of +-6 dB."""

    def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where((np.floor(x / 2) + np.floor(y / 2)) % 2 == 0, 0.4, 0.1)

    plain = drawn(line(80, step=0.25), ground)
    fall = 10 ** (-2.5 * np.clip(plain.range_m / 25, 0, 1) ** 2)
    echogram = replace(plain, levels=(plain.levels * fall).astype(np.float32))
    shaded, flat = (build_side_scan_mosaic(echogram, 6.0, CELL, flatten=flatten) for flatten in (False, True))
    x, y = centres(flat)
    bright = ground(x, y) > 0.2
    spread = []
    for mosaic in (shaded, flat):
        bands = [np.isfinite(mosaic.mean) & (np.abs(np.abs(x - 40) - distance) < 2) & bright for distance in (6, 12, 18, 22)]
        spread.append(np.ptp([np.median(mosaic.mean[band]) for band in bands]) * 60)
    assert spread[0] > 15
    assert spread[1] < 3
    known = np.isfinite(flat.mean) & (np.abs(x - 40) > 4)
    contrast = np.median(flat.mean[known & bright]) - np.median(flat.mean[known & ~bright])
    assert 60 * contrast == pytest.approx(10 * np.log10(4), abs=1)


def test_a_geotiff_lies_in_its_zone(tmp_path: Path) -> None:
    """A bright spot at a latitude and longitude is found there by the tags of the file."""
    origin = UtmOrigin.near(-33.8, 151.2)
    spot = np.array([47.0, -10.0])

    def one(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.asarray(0.01 + np.exp(-((x - spot[0]) ** 2 + (y - spot[1]) ** 2) / 0.3**2))

    echogram = drawn(line(80), one, origin=origin)
    mosaic = build_side_scan_mosaic(echogram, 6.0, CELL, flatten=False)
    save_geotiff(tmp_path / "map.tif", mosaic, origin)
    with tifffile.TiffFile(tmp_path / "map.tif") as file:
        page = file.pages.first
        mean = page.asarray()[0]
        tags = {tag.code: tag.value for tag in page.tags.values()}
        described = page.geotiff_tags or {}
    assert described["GTModelTypeGeoKey"] == 1
    assert int(described["ProjectedCSTypeGeoKey"]) == 32756
    assert "zone 56S" in str(described["GTCitationGeoKey"])
    _, _, _, east, north, _ = tags[33922]
    row, column = np.argwhere(mean > 0.99 * np.nanmax(mean)).mean(axis=0)
    place = np.array([east + (column + 0.5) * 0.1 - origin.east_m, north - (row + 0.5) * 0.1 - origin.north_m])
    assert np.abs(place - spot).max() < 0.15
    degrees = origin.to_degrees(place[None])[0]
    assert degrees == pytest.approx([-33.8, 151.2], abs=1e-3)


def test_impossible_maps_are_refused() -> None:
    echogram = drawn(line(20))
    with pytest.raises(MitsonarError, match="no ping shows ground"):
        build_side_scan_mosaic(echogram, 30.0, CELL)
    with pytest.raises(MitsonarError, match="the map would have"):
        build_side_scan_mosaic(echogram, 6.0, MosaicOptions(cell_m=0.001))
    with pytest.raises(MitsonarError, match="too small for a window of 25 m"):
        build_side_scan_mosaic(echogram, 6.0, MosaicOptions(cell_m=1e-9))
    far = echogram.poses.copy()
    far[10:, 0] += 1e9
    with pytest.raises(MitsonarError, match="1,000 km"):
        build_side_scan_mosaic(replace(echogram, poses=far), 6.0, CELL)
