"""``mitsonar recording`` and ``mitsonar mosaic`` of side-scans: XTF files, echograms and runs of ``mitsonar sound``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from drawn_side_scans import drawn, line
from helpers import Command, refused
from PIL import Image

from mitsonar.motion.trajectory import Trajectory
from mitsonar.motion.utm import UtmOrigin
from mitsonar.recordings.write_xtf import write_xtf
from mitsonar.records.soundings import Echogram

ORIGIN = UtmOrigin(19, False, 512724.0, 5365826.0)


@pytest.fixture(scope="module")
def echogram() -> Echogram:
    return drawn(line(80, heading=0.3), rng=np.random.default_rng(0), origin=ORIGIN)


@pytest.fixture(scope="module")
def file(echogram: Echogram, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lines") / "line.xtf"
    write_xtf(path, echogram)
    return path


def colours(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"), dtype=int)


def test_info_of_a_line(mitsonar: Command, file: Path) -> None:
    done = mitsonar("recording", "info", file)
    assert done.returncode == 0, done.stderr
    for words in ("XTF (.xtf)", "pings             80", "0..25 m, 500 bins of 50 mm", "450 kHz", "EPSG:32619"):
        assert words in done.stdout
    summary = json.loads(mitsonar("recording", "info", file, "--json").stdout)
    assert summary["pings"] == 80
    assert summary["parts"][0]["sides"] == ["port", "starboard"]
    assert summary["parts"][0]["height_m"] == pytest.approx([6, 6])


@pytest.mark.thorough
def test_waterfalls_have_a_water_column_over_slant_range_only(mitsonar: Command, file: Path, tmp_path: Path) -> None:
    for name, options in (
        ("slant.png", ()),
        ("ground.png", ("--ground-range",)),
        ("stored.png", ("--ground-range", "--stored-height")),
    ):
        done = mitsonar("recording", "show", file, "-o", tmp_path / name, *options)
        assert done.returncode == 0, done.stderr
    slant, ground, stored = (colours(tmp_path / name) for name in ("slant.png", "ground.png", "stored.png"))
    middle = np.s_[200:350, 360:380]  # a little to port of the track
    assert slant[middle].mean() < 10
    assert ground[middle].mean() > 60
    assert np.abs(ground[middle] - stored[middle]).mean() < 20
    again = mitsonar("recording", "show", file, "-o", tmp_path / "slant.png")
    refused(again, "exists")


def test_lines_are_converted_there_and_back(mitsonar: Command, file: Path, echogram: Echogram, tmp_path: Path) -> None:
    for source, target in ((file, "a.npz"), (tmp_path / "a.npz", "b.xtf"), (tmp_path / "b.xtf", "c.npz")):
        done = mitsonar("recording", "convert", source, "-o", tmp_path / target)
        assert done.returncode == 0, done.stderr
    first, second = Echogram.load(tmp_path / "a.npz"), Echogram.load(tmp_path / "c.npz")
    assert first.origin is not None
    assert first.origin == second.origin
    np.testing.assert_array_equal(first.levels, second.levels)
    places = first.origin.to_degrees(first.poses[:, :2])
    np.testing.assert_allclose(places, ORIGIN.to_degrees(echogram.poses[:, :2]), atol=1e-10)
    np.testing.assert_allclose(first.poses, second.poses, atol=1e-5)


def test_a_map_lies_on_the_earth(mitsonar: Command, file: Path, tmp_path: Path) -> None:
    done = mitsonar("mosaic", file, "true", "-o", tmp_path / "map.tif", "--cell-mm", 200)
    assert done.returncode == 0, done.stderr
    assert "EPSG:32619" in done.stdout
    assert "minus that of the file: median" in done.stdout
    with tifffile.TiffFile(tmp_path / "map.tif") as tif:
        page = tif.pages.first
        _, _, _, east, north, _ = {tag.code: tag.value for tag in page.tags.values()}[33922]
        assert int((page.geotiff_tags or {})["ProjectedCSTypeGeoKey"]) == 32619
        rows, columns = page.shape[-2:]
    assert east < ORIGIN.east_m + 40 < east + 0.2 * columns
    assert north - 0.2 * rows < ORIGIN.north_m - 20 < north


@pytest.mark.thorough
def test_a_map_along_another_path_with_another_heading(mitsonar: Command, echogram: Echogram, tmp_path: Path) -> None:
    """A path 100 m further east whose headings lack a declination; the last quarter of the pings lies beyond it."""
    line = tmp_path / "line.npz"
    echogram.save(line)
    poses = echogram.poses[:60].copy()
    poses[:, 0] += 100
    poses[:, 5] -= 0.2
    Trajectory(poses, echogram.time_s[:60]).save(tmp_path / "path.tum", "mitsonar")
    done = mitsonar(
        "mosaic", line, tmp_path / "path.tum", "-o", tmp_path / "moved.tif", "--declination", np.degrees(0.2), "--height", 6
    )
    assert done.returncode == 0, done.stderr
    assert "left out beyond the path: 20 of 80 pings" in done.stderr
    plain = mitsonar("mosaic", line, "true", "-o", tmp_path / "plain.tif", "--height", 6)
    assert plain.returncode == 0, plain.stderr
    ties = []
    for name in ("moved.tif", "plain.tif"):
        with tifffile.TiffFile(tmp_path / name) as tif:
            ties.append({tag.code: tag.value for tag in tif.pages.first.tags.values()}[33922][3])
    assert ties[0] - ties[1] == pytest.approx(100, abs=0.2)


@pytest.mark.thorough
def test_a_declination_is_taken_into_account_by_the_note_on_headings(mitsonar: Command, tmp_path: Path) -> None:
    written = drawn(line(100, heading=0.3), rng=np.random.default_rng(0), origin=ORIGIN)
    written.poses[:, 5] += 0.3  # headings of a compass
    write_xtf(tmp_path / "line.xtf", written)
    words = ("mosaic", tmp_path / "line.xtf", "true", "--height", 6, "-o")
    assert "the track lies -17 deg from the headings" in mitsonar(*words, tmp_path / "a.tif").stderr
    assert "the track lies" not in mitsonar(*words, tmp_path / "b.tif", "--declination", -np.degrees(0.3)).stderr
    assert "the track lies -34 deg" in mitsonar(*words, tmp_path / "c.tif", "--declination", np.degrees(0.3)).stderr


@pytest.mark.thorough
def test_figures_of_a_map(mitsonar: Command, file: Path, tmp_path: Path) -> None:
    done = mitsonar("mosaic", file, "true", "-o", tmp_path / "map.png", "--cell-mm", 200)
    assert done.returncode == 0, done.stderr
    assert colours(tmp_path / "map.png").std() > 10
    assert (tmp_path / "map.quality.png").is_file()


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")
def test_a_simulated_line_is_shown_and_mapped_as_a_real_one(mitsonar: Command, tmp_path: Path) -> None:
    out = tmp_path / "run"
    path = ("--from=-3,-2,3,0,0,90", "--to=1,-2,3,0,0,90", "--frames", 12, "--quality", "draft", "--model", "physical")
    assert mitsonar("sound", "flat_floor", "--instrument", "sidescan", *path, "-o", out).returncode == 0
    info = mitsonar("recording", "info", out)
    assert "echogram of mitsonar" in info.stdout
    assert "starfish-450f" in mitsonar("recording", "info", out / "sidescan.xtf").stdout
    for source in (out, out / "echogram.npz", out / "sidescan.xtf"):
        target = tmp_path / f"{source.stem}.tif"
        done = mitsonar("mosaic", source, "true", "-o", target, "--stored-height")
        assert done.returncode == 0, done.stderr
        assert "a local world" in done.stdout
    maps = [tifffile.imread(tmp_path / f"{name}.tif") for name in ("run", "echogram", "sidescan")]
    np.testing.assert_array_equal(maps[0], maps[1])
    both = np.isfinite(maps[0][0]) & np.isfinite(maps[2][0])
    assert both.sum() > 0.95 * np.isfinite(maps[0][0]).sum()
    np.testing.assert_allclose(maps[0][0][both], maps[2][0][both], atol=0.02)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("recording", "show", "FILE", "-o", "x.png", "--frame", 3), "--frame applies only to frames"),
        (("recording", "show", "FILE", "-o", "x.png", "--part", 3), "has no part 3"),
        (
            ("recording", "show", "FILE", "-o", "x.png", "--ground-range", "--height", -1),
            "--height must be one number above 0",
        ),
        (("recording", "show", "FILE", "-o", "x.png", "--height", 3, "--stored-height"), "exclude each other"),
        (("recording", "show", "FILE", "-o", "x.png", "--span-db", -5), "the span must lie in 0..300 dB: got -5"),
        (("recording", "show", "FILE", "-o", "x.png", "--ground-range", "--height", 3, "--span-db", "nan"), "0..300 dB"),
        (("recording", "info", "FILE", "--handedness"), "--handedness applies only to frames"),
        (("recording", "convert", "FILE", "-o", "x.mcap"), "converted to .xtf or .npz"),
        (("recording", "convert", "FILE", "-o", "x.xtf", "--beams", 48), "--beams applies only to frames"),
        (("recording", "video", "FILE", "-o", "x.mp4"), "pings in place of frames"),
        (("odometry", "FILE", "-o", "x"), "pings in place of frames"),
        (("mosaic", "FILE", "true", "-o", "x.tif", "--blend", "centre"), "--blend applies only to frames"),
        (("mosaic", "FILE", "true", "-o", "x.tif", "--cell-mm", 1), "the map would have"),
        (("mosaic", "FILE", "absent.tum", "-o", "x.tif"), "no such file: absent.tum"),
    ],
)
def test_wrong_options_are_named(mitsonar: Command, file: Path, words: tuple[object, ...], says: str) -> None:
    refused(mitsonar(*[file if word == "FILE" else word for word in words]), says)


def test_without_a_water_column_the_picture_is_drawn_and_a_map_needs_a_height(
    mitsonar: Command, echogram: Echogram, tmp_path: Path
) -> None:
    rng = np.random.default_rng(2)
    noise = rng.exponential(size=echogram.levels.shape).astype(np.float32)
    replace(echogram, levels=noise, height_m=np.full(len(echogram), np.nan)).save(tmp_path / "line.npz")
    done = mitsonar("recording", "show", tmp_path / "line.npz", "-o", tmp_path / "line.png")
    assert done.returncode == 0
    assert "drawn without the first return: no water column" in done.stderr
    refused(mitsonar("mosaic", tmp_path / "line.npz", "true", "-o", tmp_path / "x.tif"), "no water column", "--height")
    refused(
        mitsonar("mosaic", tmp_path / "line.npz", "true", "-o", tmp_path / "x.tif", "--stored-height"), "states no height"
    )
