"""Mosaics: the ground comes back where it is, means and deviations are those of the frames, files say where they lie."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from helpers import essence
from matplotlib.patches import Rectangle
from matplotlib.quiver import Quiver
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy import ndimage

from mitsonar.errors import MitsonarError
from mitsonar.geometry.ground import GroundGeometry
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import directions
from mitsonar.mapping.mosaic import Blend, Mosaic, MosaicOptions, build_mosaic, illumination, save_geotiff
from mitsonar.motion.pose import Pose, vehicle_rotation
from mitsonar.motion.trajectory import Trajectory
from mitsonar.plotting.figures import mosaic_figure, path_figure, quality_figure, save_figure
from mitsonar.records.frames import SonarFrames

Array = NDArray[np.float64]

SONAR = Sonar(bearing="azimuth", beams=96, range_bins=256)
HEIGHT = 2.5


def ground(sonar: Sonar, pose: Pose, height: float = HEIGHT) -> tuple[Array, Array]:
    """World x, y of the cells' ground points ``(bins, beams, 2)``, and whether the elevation field of view lights them."""
    geometry = GroundGeometry(sonar.range_m, sonar.bearing_rad, sonar.bearing, height, pose.pitch, pose.roll)
    level = np.concatenate([geometry.points, np.full((*geometry.points.shape[:2], 1), -height)], axis=-1)
    world = vehicle_rotation(Pose(0, 0, 0, heading=pose.heading)).apply(level.reshape(-1, 3)).reshape(level.shape)
    b = np.broadcast_to(sonar.bearing_rad, level.shape[:2])
    half = np.radians(sonar.elevation_fov_deg) / 2
    # lit cells lie, in the sonar's own axes, along a direction of an elevation within the field of view
    local = (vehicle_rotation(Pose(0, 0, 0, pose.pitch, pose.roll, 0)).inv().apply(level.reshape(-1, 3))).reshape(
        level.shape
    )
    unit = local / np.linalg.norm(local, axis=-1, keepdims=True)
    nearest = np.max(
        [np.einsum("...i,...i", unit, directions(sonar.bearing, b, e)) for e in np.linspace(-half, half, 61)], 0
    )
    return world[..., :2] + np.array(pose[:2]), nearest > np.cos(half / 50)


def frames_of(level: Any, poses: ArrayLike, sonar: Sonar = SONAR, height: float = HEIGHT) -> SonarFrames:
    """Frames of a ground whose level is ``level(x, y)``."""
    table = np.atleast_2d(np.asarray(poses, dtype=float))
    images = []
    for pose in table:
        points, lit = ground(sonar, Pose(*pose), height)
        images.append(np.where(lit, level(*np.moveaxis(np.nan_to_num(points), -1, 0)), 0))
    count = len(table)
    return SonarFrames(
        np.array(images, np.float32),
        sonar.range_m,
        sonar.bearing_rad,
        np.arange(count) / 10.0,
        sonar,
        table,
        np.full(count, height),
    )


def blank(poses: ArrayLike, value: float = 0.5, sonar: Sonar = SONAR) -> SonarFrames:
    """Frames of one level all over."""
    table = np.atleast_2d(np.asarray(poses, dtype=float))
    image = np.full((len(table), sonar.range_bins, sonar.beams), value, np.float32)
    return SonarFrames(
        image,
        sonar.range_m,
        sonar.bearing_rad,
        np.arange(len(table)) / 10.0,
        sonar,
        table,
        np.full(len(table), HEIGHT),
    )


def centres(mosaic: Mosaic) -> tuple[Array, Array]:
    """World x, y of the cells' centres, by the documented order of rows and columns."""
    west, east, south, north = mosaic.extent
    rows, columns = mosaic.mean.shape
    x = np.linspace(west, east, columns + 1)
    y = np.linspace(north, south, rows + 1)
    east_m, north_m = np.meshgrid((x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2)
    return east_m, north_m


def looking(heading_deg: float, pitch_deg: float = 35.0, roll_deg: float = 0.0, x: float = 0.0, y: float = 0.0) -> Pose:
    return Pose.from_degrees([x, y, HEIGHT, pitch_deg, roll_deg, heading_deg])


def waves(x: Array, y: Array) -> Array:
    """A ground without symmetry: it differs mirrored, turned, and shifted."""
    return 0.5 + 0.2 * np.sin(7 * x + 2 * y) + 0.15 * np.cos(3 * x - 8 * y + 1) + 0.01 * x


POSES = [looking(0), looking(40, 37, 5, 3, -2), looking(-125, 30, -6, -4, 1.5), looking(180, 40, 0, 0.5, 100)]

# ---------------------------------------------------------------- the right place


EVERY_WAY = list(itertools.product(["azimuth", "cone"], ["weighted", "centre"], POSES))


@pytest.mark.parametrize(("bearing", "blend", "pose"), essence(EVERY_WAY, *EVERY_WAY[::5]))
def test_the_ground_comes_back(bearing: str, blend: Blend, pose: Pose) -> None:
    """Cells well inside hold the ground's level at their centres; a shift by a tenth of a cell would show.

    The ground's slope is up to 2.5 a metre, so 0.01 of level stand for 4 mm: bilinear interpolation over beams of 20 mm errs
    by 0.003.
    """
    mosaic = Mosaic(MosaicOptions(0.01, blend))
    mosaic.add(frames_of(waves, [pose], SONAR.replace(bearing=bearing)))
    x, y = centres(mosaic)
    error = mosaic.mean - waves(x, y)
    inside = ndimage.binary_erosion(mosaic.count > 0, iterations=3)  # the outline's bins are half in the dark
    assert inside.sum() > 5000
    assert np.abs(error[inside]).max() < 0.02
    for dx, dy in ((0.001, 0), (-0.001, 0), (0, 0.001), (0, -0.001)):
        moved = mosaic.mean - waves(x + dx, y + dy)
        assert np.square(moved[inside]).mean() > np.square(error[inside]).mean(), "a tenth of a cell away it fits better"


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
@pytest.mark.parametrize("heading_deg", [0.0, 90.0, -150.0])
def test_starboard_and_heading_have_the_right_sign(bearing: str, heading_deg: float) -> None:
    """A bright cell to starboard lies clockwise of the heading, by hand from the axes of the vehicle."""
    sonar = SONAR.replace(bearing=bearing)
    pose = looking(heading_deg, x=10, y=20)
    frames = blank([pose], 0.0, sonar)
    frames.image[0, 120:124, 80] = 1.0
    mosaic = build_mosaic(frames, options=MosaicOptions(cell_m=0.01))
    level = np.nan_to_num(mosaic.mean)
    x, y = (float((axis * level).sum() / level.sum()) for axis in centres(mosaic))
    theta = np.radians(heading_deg)
    ahead = (x - 10) * np.sin(theta) + (y - 20) * np.cos(theta)
    starboard = (x - 10) * np.cos(theta) - (y - 20) * np.sin(theta)
    radius = np.sqrt(sonar.range_m[120:124].mean() ** 2 - HEIGHT**2)  # on the ground
    assert np.hypot(starboard, ahead) == pytest.approx(radius, abs=3e-3)
    if bearing == "azimuth":  # of a point h below, seen by a sonar that looks down by 35 deg
        forward = ahead * np.cos(np.radians(35)) + HEIGHT * np.sin(np.radians(35))
        assert np.arctan2(starboard, forward) == pytest.approx(sonar.bearing_rad[80], abs=6e-4)
    else:
        assert starboard / np.sqrt(radius**2 + HEIGHT**2) == pytest.approx(np.sin(sonar.bearing_rad[80]), abs=6e-4)


def test_only_lit_ground_is_touched() -> None:
    """The axis beam meets the floor at elevations of 28 to 42 deg below level: nothing nearer or farther."""
    mosaic = build_mosaic(blank([looking(0)]), options=MosaicOptions(cell_m=0.01, blend="centre"))
    x, y = centres(mosaic)
    ahead = y[(np.abs(x) < 0.006) & np.isfinite(mosaic.mean)]
    assert ahead.min() == pytest.approx(HEIGHT / np.tan(np.radians(42)), abs=0.011)
    assert ahead.max() == pytest.approx(HEIGHT / np.tan(np.radians(28)), abs=0.011)
    narrow = build_mosaic(
        blank([looking(0)], sonar=SONAR.replace(range_min=4.0, range_max=4.5)), options=MosaicOptions(cell_m=0.01)
    )
    x, y = centres(narrow)
    radius = np.sqrt(x**2 + y**2 + HEIGHT**2)[np.isfinite(narrow.mean)]
    assert radius.min() >= 4.0
    assert radius.max() <= 4.5
    np.testing.assert_allclose(narrow.mean[np.isfinite(narrow.mean)], 0.5, atol=1e-6)


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_all_lit_ground_and_no_other_is_seen(bearing: str) -> None:
    """Every cell by hand, in a fan that rolls: window, beams and elevations by the directions of the beams."""
    sonar = SONAR.replace(bearing=bearing, azimuth_fov_deg=50, range_min=4.0, range_max=5.0)
    pose = looking(0, 35, 6)
    mosaic = build_mosaic(blank([pose], sonar=sonar), options=MosaicOptions(cell_m=0.02, blend="centre"))
    x, y = centres(mosaic)
    below = np.stack([x, y, np.full_like(x, -HEIGHT)], axis=-1)
    s, f, u = np.moveaxis(vehicle_rotation(pose).inv().apply(below.reshape(-1, 3)).reshape(below.shape), -1, 0)
    radius = np.sqrt(s**2 + f**2 + u**2)
    if bearing == "azimuth":
        b, elevation = np.arctan2(s, f), np.arcsin(u / radius)
    else:
        b, elevation = np.arcsin(s / radius), np.arctan2(u, f)
    margins = [
        np.radians(25) - np.abs(b),
        np.radians(7) - np.abs(elevation),
        (radius - 4.0) / 5,
        (5.0 - radius) / 5,
    ]
    margin = np.min(margins, axis=0)
    assert (mosaic.count[margin > 1e-6] == 1).all()
    assert (mosaic.count[margin < -1e-6] == 0).all()
    only = [(one < 0) & (np.min(margins[:k] + margins[k + 1 :], axis=0) > 0) for k, one in enumerate(margins)]
    assert [bool(cells.any()) for cells in only] == [True] * 4, "each end alone keeps some cells out"


def test_uneven_beams_are_where_they_say() -> None:
    sonar = SONAR.replace(beam_layout="sine", azimuth_fov_deg=80, beams=128)
    mosaic = build_mosaic(frames_of(waves, [looking(20)], sonar), options=MosaicOptions(cell_m=0.02))
    error = mosaic.mean - waves(*centres(mosaic))
    assert np.abs(error[mosaic.weight > 0.05]).max() < 0.04
    assert np.sqrt(np.square(error[mosaic.weight > 0.05]).mean()) < 0.01


def test_finer_bins_than_cells_are_averaged() -> None:
    """Independent bins under a coarse cell: its variance falls with their number, as an average's does, not as one bin's."""
    sonar = SONAR.replace(range_bins=1024)
    frames = blank([looking(0)], sonar=sonar)
    rng = np.random.default_rng(1)
    frames.image[...] = rng.uniform(0, 1, frames.image.shape)
    spread = {}
    for cell in (0.05, 0.1):
        mosaic = build_mosaic(frames, options=MosaicOptions(cell_m=cell))
        spread[cell] = float(mosaic.mean[mosaic.weight > 0.3].std())
    # a cell of 50 mm spans some 18 bins and 1.5 to 3 beams; picking between four pixels would leave about 0.19
    assert spread[0.05] < 0.29 / np.sqrt(18) * 1.3
    assert spread[0.1] < 0.6 * spread[0.05]


# ---------------------------------------------------------------- statistics


@pytest.mark.parametrize("blend", ["weighted", "centre"])
def test_identical_frames_do_not_differ(blend: Blend) -> None:
    one = frames_of(waves, [POSES[1]])
    mosaic = Mosaic(MosaicOptions(0.02, blend))
    for _ in range(7):
        mosaic.add(one)
    seen = mosaic.count > 0
    assert (mosaic.count[seen] == 7).all()
    assert np.nanmax(mosaic.std) < 1e-6
    single = Mosaic(MosaicOptions(0.02, blend))
    single.add(one)
    np.testing.assert_allclose(mosaic.mean, single.mean, atol=1e-6)
    assert np.isnan(single.std).all()


@pytest.mark.parametrize("blend", ["weighted", "centre"])
def test_deviation_is_the_noise_s(blend: Blend) -> None:
    """Noise that is the same all over a frame is not smoothed by interpolation: its level must come back.

    120 frames of std 0.05: the estimate's own standard error is 6.5 %, one number for all cells with equal weights.
    """
    rng = np.random.default_rng(3)
    noise = rng.normal(0, 0.05, 120)
    mosaic = Mosaic(MosaicOptions(0.05, blend))
    for value in noise:
        mosaic.add(blank([looking(0)], 0.5 + value))
    np.testing.assert_allclose(mosaic.std[mosaic.count == 120], noise.std(ddof=1), rtol=1e-3)
    np.testing.assert_allclose(mosaic.mean[mosaic.count == 120], 0.5 + noise.mean(), atol=1e-5)


def test_deviation_of_unequal_weights_has_no_bias() -> None:
    """Few frames that see a cell with different weights: averaged over many cells and draws, the variance is the noise's."""
    rng = np.random.default_rng(4)
    variances = []
    for _ in range(40):
        mosaic = Mosaic(MosaicOptions(0.1, "weighted"))
        for step in range(4):
            mosaic.add(blank([looking(0, x=0.4 * step)], 0.5 + rng.normal(0, 0.1)))
        known = mosaic.std[mosaic.count == 4]
        assert len(np.unique(mosaic.weight[mosaic.count == 4])) > 10
        variances.append(np.square(known).mean())
    assert np.mean(variances) == pytest.approx(0.01, abs=4 * np.std(variances) / np.sqrt(40))
    assert np.std(variances) / np.sqrt(40) < 0.0015


def test_means_are_weighted_means() -> None:
    """Two routes: the map's sums, and each frame's own map put together in float64."""
    rng = np.random.default_rng(5)
    poses = [looking(10 * k, x=0.3 * k) for k in range(5)]
    frames = blank(poses)
    frames.image[...] = rng.uniform(0, 1, frames.image.shape)
    whole = Mosaic(MosaicOptions(0.02))
    whole.add(frames)
    sums = np.zeros((3, *whole.mean.shape))
    west, _, _, north = whole.extent
    for k in range(5):
        one = Mosaic(MosaicOptions(0.02))
        one.add(frames.select(np.array([k])))
        column, row = round((one.extent[0] - west) / 0.02), round((north - one.extent[3]) / 0.02)
        rows, columns = one.mean.shape
        part = sums[:, row : row + rows, column : column + columns]
        level, weight = np.nan_to_num(one.mean.astype(float)), one.weight.astype(float)
        part += np.stack([weight, weight * level, weight * level**2])
    seen = whole.count > 1
    mean = sums[1][seen] / sums[0][seen]
    np.testing.assert_allclose(whole.mean[seen], mean, atol=1e-5)
    good = seen & (whole.weight > 0.1)
    spread = sums[2][good] - sums[1][good] ** 2 / sums[0][good]
    free = (np.square(whole.std[good].astype(float)) > 0) & (spread > 1e-4)
    ratio = spread[free] / np.square(whole.std[good][free].astype(float))  # W - sum w^2 / W: between 0 and W
    assert ((ratio > 0) & (ratio < sums[0][good][free])).all()


def test_order_does_not_matter() -> None:
    frames = frames_of(waves, [looking(15 * k, x=0.3 * k, y=-0.2 * k) for k in range(6)])
    rng = np.random.default_rng(6)
    frames.image += rng.normal(0, 0.05, frames.image.shape).astype(np.float32)
    maps = []
    for order in (np.arange(6), np.arange(6)[::-1], rng.permutation(6)):
        mosaic = Mosaic(MosaicOptions(0.02))
        mosaic.add(frames.select(order))
        maps.append(mosaic)
    for second in maps[1:]:
        assert second.extent == maps[0].extent
        np.testing.assert_array_equal(second.count, maps[0].count)
        np.testing.assert_allclose(second.mean, maps[0].mean, atol=2e-6)
        both = np.isfinite(second.std) & np.isfinite(maps[0].std)  # a cell at the limit may be known in one order only
        assert (np.isfinite(second.std) != np.isfinite(maps[0].std)).sum() <= 3
        np.testing.assert_allclose(second.std[both], maps[0].std[both], atol=5e-5)


@pytest.mark.thorough
def test_illumination_is_taken_out() -> None:
    """A fall-off that moves with the sonar: without it, the ground is the same from everywhere and near and far alike."""
    poses = [looking(0, x=0.12 * k, y=0.1 * k) for k in range(20)]
    pattern = (3.5 / SONAR.range_m[:, None]) ** 3 * np.cos(2.5 * SONAR.bearing_rad) ** 2
    shaded = frames_of(waves, poses)
    shaded.image *= pattern.astype(np.float32)
    result = illumination(shaded)
    _, lit = ground(SONAR, poses[0])
    ratio = (result / pattern)[lit]
    assert ratio.std() / ratio.mean() < 0.06
    assert result[lit].mean() == pytest.approx(1, abs=0.02)
    results = {}
    for name, use in (("with", result), ("without", None)):
        mosaic = build_mosaic(shaded, options=MosaicOptions(cell_m=0.02), illumination=use)
        many = mosaic.count >= 5
        level = waves(*centres(mosaic))
        results[name] = np.corrcoef(mosaic.mean[many], level[many])[0, 1], np.nanmean(mosaic.std[many] / mosaic.mean[many])
    assert results["with"][0] > 0.985
    assert results["without"][0] < 0.97
    assert results["with"][1] < 0.5 * results["without"][1]


def test_illumination_of_a_sonar_mounted_upside_down() -> None:
    """Its roll jumps between 180 and -180 deg, and the mean is 180 deg all the same."""
    poses = [looking(0, x=0.12 * k, y=0.1 * k) for k in range(6)]
    frames = frames_of(waves, poses)
    assert frames.poses is not None
    steady, jumping = frames.poses.copy(), frames.poses.copy()
    steady[:, 4] = np.pi
    jumping[:, 4] = (np.pi - 1e-3) * np.array([1, 1, -1, 1, 1, -1])
    one, other = (illumination(frames, poses=table) for table in (steady, jumping))
    np.testing.assert_allclose(other, one, rtol=0.02)


# ---------------------------------------------------------------- runs, memory, bounds


@pytest.mark.thorough
def test_chunks_and_whole_runs_make_one_map() -> None:
    """Frames that come in chunks, poses of another path, first and last frame whole with `centre`."""
    poses = np.array([looking(3 * k, x=0.2 * k) for k in range(9)])
    frames = frames_of(waves, poses)
    frames.poses = None
    at_once = build_mosaic(frames, poses, HEIGHT, MosaicOptions(cell_m=0.02, blend="centre"))
    chunks = (frames.select(slice(a, a + 4)) for a in (0, 4, 8))
    in_parts = build_mosaic(chunks, poses, options=MosaicOptions(cell_m=0.02, blend="centre"))
    assert in_parts.extent == at_once.extent
    np.testing.assert_array_equal(in_parts.mean, at_once.mean)
    plain = Mosaic(MosaicOptions(0.02, "centre"))
    plain.add(frames, poses)
    assert (at_once.count > 0).sum() > 1.3 * (plain.count > 0).sum()


def test_24_beams_are_the_middle_quarter() -> None:
    mosaic = Mosaic(MosaicOptions(0.005, "centre"))
    mosaic.add(blank([looking(0)]))
    x, y = centres(mosaic)
    seen = mosaic.count > 0
    forward = y * np.cos(np.radians(35)) + HEIGHT * np.sin(np.radians(35))
    assert np.abs(np.arctan2(x, forward)[seen]).max() == pytest.approx(np.radians(29 / 8), rel=0.01)


def test_memory_is_the_map_s() -> None:
    """Many frames over one place: the state does not grow."""
    mosaic = Mosaic(MosaicOptions(0.05))
    one = blank([looking(0)])
    mosaic.add(one)
    stored = mosaic.state_bytes
    for _ in range(30):
        mosaic.add(one)
    assert mosaic.state_bytes == stored
    assert mosaic.frames == 31
    rows, columns = mosaic.mean.shape
    assert rows * columns * 20 <= stored < 4 * rows * columns * 20
    arrays = [value for value in vars(mosaic).values() if isinstance(value, np.ndarray)]
    assert sum(array.nbytes for array in arrays) == stored


def test_a_map_grows_in_every_direction() -> None:
    poses = [looking(0), looking(0, x=-3), looking(0, x=4), looking(0, y=5), looking(0, y=-4)]
    reserved = Mosaic(MosaicOptions(0.05))
    frames = frames_of(waves, poses)
    reserved.reserve(frames, poses, HEIGHT)
    stored = reserved.state_bytes
    reserved.add(frames)
    assert reserved.state_bytes == stored, "room was made before"
    grown = Mosaic(MosaicOptions(0.05))
    for k in range(5):
        grown.add(frames.select(np.array([k])))
    assert grown.extent == reserved.extent
    np.testing.assert_array_equal(grown.mean, reserved.mean)


def test_too_large_a_map_names_a_cell_that_fits() -> None:
    poses = np.array([looking(0), looking(0, x=200, y=100)])
    with pytest.raises(MitsonarError, match=r"at most 1,000,000 are allowed: use cells of ([\d.]+) mm") as result:
        build_mosaic(blank(poses), poses, HEIGHT, MosaicOptions(most_cells=1_000_000))
    cell = float(str(result.value).split("use cells of ")[1].split(" mm")[0]) / 1e3
    assert 0.14 < cell < 0.17
    fits = build_mosaic(blank(poses), poses, HEIGHT, MosaicOptions(cell_m=cell, most_cells=1_000_000))
    assert fits.frames_without_ground == 0


def test_cells_far_too_small_are_refused_before_they_fill_the_memory() -> None:
    with pytest.raises(MitsonarError, match="use cells of"):
        Mosaic(MosaicOptions(1e-6)).add(blank([looking(0)]))


def test_echoes_of_a_sonar_that_looks_down_lie_ahead_and_astern() -> None:
    """A cell shows two places, and nothing tells which: such frames are counted."""
    sonar = SONAR.replace(range_min=2.6, range_max=4, elevation_fov_deg=60)
    frames = frames_of(lambda x, y: np.where(y > 1, 1.0, 0.2), [0, 0, HEIGHT, np.pi / 2, 0, 0], sonar)
    below = build_mosaic(frames)
    _, _, south, north = below.extent
    assert below.frames_past_nadir == 1
    assert north == pytest.approx(-south, abs=0.02)
    assert np.isfinite(below.mean[[len(below.mean) // 8, -len(below.mean) // 8], below.mean.shape[1] // 2]).all()
    assert build_mosaic(frames_of(lambda x, y: 0 * x + 1, [0, 0, HEIGHT, 0.6, 0, 0])).frames_past_nadir == 0


def test_frames_without_ground_are_counted() -> None:
    high = Pose.from_degrees([0, 0, 9, 35, 0, 0])
    frames = blank([looking(0), high, looking(0)])
    assert frames.height_m is not None
    frames.height_m[:] = HEIGHT, 9.0, np.nan
    mosaic = build_mosaic(frames, options=MosaicOptions(cell_m=0.05))
    assert (mosaic.frames, mosaic.frames_without_ground, mosaic.count.max()) == (3, 2, 1)
    frames.height_m[0] = 9.0
    with pytest.raises(MitsonarError, match="3 frames added, without ground in 3"):
        build_mosaic(frames)


def wrong(change: str) -> SonarFrames:
    frames = blank([looking(0)])
    match change:
        case "no poses":
            frames.poses = None
        case "no height":
            frames.height_m = None
        case "nan":
            frames.image[0, 3, 3] = np.nan
        case "unsorted":
            frames.bearing_rad = frames.bearing_rad[::-1]
        case "below":
            frames.height_m = np.array([-1.0])
    return frames


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ("no poses", {}, "no poses"),
        ("no height", {}, "hold no height"),
        ("nan", {}, "finite"),
        ("unsorted", {}, "increase"),
        ("below", {}, "above 0"),
        ("", {"poses": np.zeros((1, 5))}, r"\(frames, 6\)"),
        ("", {"poses": np.full((1, 6), np.inf)}, "finite"),
        ("", {"poses": np.zeros((3, 6))}, "more poses than frames"),
        ("", {"poses": np.zeros((0, 6))}, "more frames than poses"),
        ("", {"height_m": [2.5, 2.5]}, "more heights than frames"),
        ("", {"poses": [looking(0)], "height_m": [2.5, 2.5]}, "one for each of 1 frames"),
        ("", {"cell_m": 0.0}, "cell_m must be above 0"),
        ("", {"cell_m": np.nan}, "cell_m must be above 0"),
        ("", {"blend": "centr"}, "did you mean centre"),
        ("", {"centre_beams": 1}, "centre_beams"),
        ("", {"illumination": np.zeros((256, 96))}, "above 0"),
        ("", {"illumination": np.ones((96, 256))}, r"\(256, 96\)"),
    ],
)
def test_what_is_wrong_is_said(change: str, options: dict[str, Any], message: str) -> None:
    chosen = {name: options[name] for name in ("cell_m", "blend", "centre_beams") if name in options}
    rest = {name: value for name, value in options.items() if name not in chosen}
    with pytest.raises(MitsonarError, match=message):
        build_mosaic(wrong(change), options=MosaicOptions(**chosen), **rest)


def test_an_empty_mosaic_says_so() -> None:
    with pytest.raises(MitsonarError, match="empty: 0 frames"):
        Mosaic().mean  # noqa: B018
    with pytest.raises(MitsonarError, match="empty: 0 frames"):
        build_mosaic(iter(()))
    with pytest.raises(MitsonarError, match="one for each of 1 frames"):
        Mosaic().add(blank([looking(0)]), whole=[True, False])
    single = Sonar(bearing="azimuth", beams=1, range_bins=50)
    with pytest.raises(MitsonarError, match="2 to 32,766 bins and beams: got 50 x 1"):
        build_mosaic(blank([looking(0)], sonar=single))
    with pytest.raises(MitsonarError, match="no lit ground"):
        illumination(blank([looking(0)], 0.0))


# ---------------------------------------------------------------- files and figures


def small_mosaic() -> Mosaic:
    return build_mosaic(
        frames_of(waves, [looking(0, x=5, y=-7), looking(20, x=5, y=-7)]), options=MosaicOptions(cell_m=0.02)
    )


def test_geotiff_says_where_its_cells_are(tmp_path: Path) -> None:
    mosaic = small_mosaic()
    save_geotiff(tmp_path / "map.tif", mosaic)
    with tifffile.TiffFile(tmp_path / "map.tif") as file:
        page = file.pages.first
        bands = page.asarray()
        tags = {tag.code: tag.value for tag in page.tags.values()}
    assert bands.dtype == np.float32
    for band, expected in zip(bands, (mosaic.mean, mosaic.std, mosaic.count), strict=True):
        np.testing.assert_array_equal(band, expected)
    assert tags[42113] == "nan"
    i, j, _, x, y, _ = tags[33922]
    step_x, step_y, _ = tags[33550]
    rows, columns = np.indices(bands[0].shape)
    easting, northing = x + (columns + 0.5 - i) * step_x, y - (rows + 0.5 - j) * step_y
    np.testing.assert_allclose(np.stack([easting, northing]), np.stack(centres(mosaic)), atol=1e-9)
    good = mosaic.weight > 0.1
    right = np.abs(bands[0] - waves(easting, northing))[good].mean()
    for shift in (-0.01, 0.01):  # half a cell
        assert right < 0.5 * np.abs(bands[0] - waves(easting + shift, northing + shift))[good].mean()
    keys = dict(zip(tags[34735][4::4], tags[34735][7::4], strict=True))
    assert keys[1024] == 32767, "a user-defined model, not a place on Earth"
    assert keys[1025] == 1, "pixels are areas: the tie point is a corner"
    assert keys[3076] == 9001, "metre"
    assert not list(tmp_path.glob(".*")), "no part is left"


@pytest.mark.thorough
def test_figures_are_written(tmp_path: Path) -> None:
    mosaic = small_mosaic()
    path = Trajectory.between(looking(0, x=5, y=-7), looking(20, x=5.5, y=-7), 30, 10)
    paths = {"estimated": path, "true": path, "another": path}
    save_figure(tmp_path / "map.png", mosaic_figure(mosaic, paths, title="map"))
    save_figure(tmp_path / "quality.png", quality_figure(mosaic))
    some = np.tile(np.diag([1e-6, 1e-6, 1e-7]), (30, 1, 1))
    figure = path_figure(paths, motion_covariances={"estimated": some[1:]}, pose_covariances={"estimated": some})
    save_figure(tmp_path / "path.png", figure)
    for name in ("map", "quality", "path"):
        assert np.asarray(Image.open(tmp_path / f"{name}.png").convert("L")).std() > 10


def test_a_map_is_drawn_where_it_lies_with_a_true_scale_bar() -> None:
    mosaic = small_mosaic()
    path = Trajectory.between(looking(0, x=5, y=-7), looking(90, x=6, y=-7), 30, 10)
    figure = mosaic_figure(mosaic, {"estimated": path, "true": path})
    axes = figure.axes[0]
    assert tuple(axes.images[0].get_extent()) == pytest.approx(mosaic.extent)
    assert axes.images[0].origin == "upper"
    lines = {line.get_label(): line for line in axes.lines}
    np.testing.assert_array_equal(lines["estimated"].get_xydata(), path.poses[:, :2])
    assert (lines["estimated"].get_color(), lines["true"].get_color()) == ("red", "limegreen")
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["estimated", "true", "start", "heading"]
    arrows = next(one for one in axes.collections if isinstance(one, Quiver))
    np.testing.assert_allclose([np.asarray(arrows.U)[0], np.asarray(arrows.V)[0]], [0, 1], atol=1e-12)
    np.testing.assert_allclose([np.asarray(arrows.U)[-1], np.asarray(arrows.V)[-1]], [1, 0], atol=1e-12)
    bar, label = axes.patches[0], axes.texts[0].get_text()
    assert label.endswith(" cm") or label.endswith(" m")
    output = float(label.split()[0]) * (0.01 if label.endswith(" cm") else 1)
    assert isinstance(bar, Rectangle)
    assert bar.get_width() == pytest.approx(output)


def test_path_figures_show_motions_along_the_new_heading() -> None:
    """Forward along a heading of 90 deg is east: 100 mm a frame, no sideways motion."""
    path = Trajectory.between(looking(90), looking(90, x=1.0), 11, 10)
    figure = path_figure({"true": path})
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels[1:] == ["heading (deg)", "sideways (mm)", "forward (mm)", "yaw (deg)"]
    heading, sideways, forward, yaw = (np.asarray(axes.lines[0].get_ydata(), dtype=float) for axes in figure.axes[1:])
    for values, expected in ((heading, 90), (sideways, 0), (forward, 100), (yaw, 0)):
        np.testing.assert_allclose(values, expected, atol=1e-9)


def test_times_of_a_clock_are_drawn_from_the_first_frame() -> None:
    """Two frames make one motion, which is drawn as a point."""
    path = Trajectory(np.array([looking(0), looking(0, y=1.0)]), 1_371_198_079.25 + np.array([0.0, 0.5]))
    figure = path_figure({"true": path})
    assert figure.axes[-1].get_xlabel() == "time since the first frame (s)"
    heading, *motions = (axes.lines[0] for axes in figure.axes[1:])
    assert np.asarray(heading.get_xdata()).tolist() == [0, 0.5]
    assert [(np.asarray(one.get_xdata()).tolist(), one.get_marker()) for one in motions] == [([0.5], "o")] * 3


def test_bands_are_two_standard_deviations() -> None:
    path = Trajectory.between(looking(0), looking(0, y=1.0), 11, 10)
    covariance = np.tile(np.diag([1e-6, 4e-6, 9e-6]), (10, 1, 1))
    figure = path_figure({"true": path}, motion_covariances={"true": covariance})
    for axes, width in zip(figure.axes[2:], (1.0, 2.0, np.degrees(3e-3)), strict=True):
        y = np.asarray(axes.collections[0].get_paths()[0].vertices)[:, 1]
        assert y.max() - y.min() == pytest.approx(4 * width)


def test_wrong_figures_are_refused(tmp_path: Path) -> None:
    path = Trajectory.between(looking(0), looking(0, y=1.0), 11, 10)
    with pytest.raises(MitsonarError, match="no path"):
        path_figure({})
    for what, count in itertools.product(("motion_covariances", "pose_covariances"), (9,)):
        options: dict[str, Any] = {what: {"true": np.zeros((count, 3, 3))}}
        with pytest.raises(MitsonarError, match=f"{what} of true must be"):
            path_figure({"true": path}, **options)
    with pytest.raises(MitsonarError, match="names a path that is not drawn: got 'other'"):
        path_figure({"true": path}, pose_covariances={"other": np.zeros((11, 3, 3))})
    with pytest.raises(MitsonarError, match="must end in one of"):
        save_figure(tmp_path / "path.tum", path_figure({"true": path}))
    assert not list(tmp_path.iterdir())
