"""The textures `cell_noise` and `perlin`: their statistics, their grids, their properties; and a bitmap read in place."""

from __future__ import annotations

from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import MitsubaDict, diffuse, scene
from numpy.typing import ArrayLike
from scipy import stats

from mitsonar.arrays import DeviceArray
from mitsonar.errors import MitsonarError

pytestmark = pytest.mark.usefixtures("variant")

Z = 4.5
"""Bound of all z-tests: seeds are fixed, so a right distribution fails never or always; one in 150,000 seeds."""


def at(
    texture: mi.Texture, *, uv: ArrayLike | None = None, p: ArrayLike | None = None, active: DeviceArray = True
) -> np.ndarray:
    """Values at uv ``(n, 2)`` or positions ``(n, 3)``."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(np.asarray(uv if uv is not None else p)))
    if uv is not None:
        si.uv = mi.Point2f(*np.asarray(uv, np.float32).T)
    if p is not None:
        si.p = mi.Point3f(*np.asarray(p, np.float32).T)
    return np.array(texture.eval_1(si, active))


def texture(kind: str, **properties: Any) -> mi.Texture:
    loaded = mi.load_dict({"type": kind, **properties})
    assert isinstance(loaded, mi.Texture)
    return loaded


def grid(count: int, step: float, start: float = 0.5) -> np.ndarray:
    """The middles ``(count^2, 2)`` of cells of that step; the second coordinate runs fastest."""
    line = (np.arange(count) + start) * step
    return np.stack(np.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2)


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Of two samples, as a z-value."""
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1] * np.sqrt(a.size))


# ---------------------------------------------------------------- cell_noise


@pytest.mark.parametrize("seed", [0, 7])
def test_cells_are_uniform(seed: int) -> None:
    """Mean 1/2, variance 1/12 (its standard error is sqrt((1/80 - 1/144) / N)), chi-square on 64 classes."""
    values = at(texture("cell_noise", cells=256, seed=seed), uv=grid(256, 1 / 256)).astype(float)
    assert abs(values.mean() - 0.5) * np.sqrt(12 * values.size) < Z
    assert abs(values.var() - 1 / 12) / np.sqrt((1 / 80 - 1 / 144) / values.size) < Z
    assert stats.chisquare(np.bincount((values * 64).astype(int), minlength=64)).pvalue > 1e-5


def test_low_high_and_mean() -> None:
    source = texture("cell_noise", cells=200, low=0.25, high=0.75)
    values = at(source, uv=grid(200, 1 / 200)).astype(float)
    assert 0.25 <= values.min() < 0.2501
    assert 0.7499 < values.max() <= 0.75
    assert abs(values.mean() - 0.5) * np.sqrt(12 * values.size) / 0.5 < Z
    assert np.array(source.mean()).tolist() == [0.5]


def test_gaussian_cells() -> None:
    source = texture("cell_noise", cells=200, distribution="gaussian", mean=0.4, std=0.08)
    values = at(source, uv=grid(200, 1 / 200)).astype(float)  # 0 lies five standard deviations away
    assert abs(values.mean() - 0.4) * np.sqrt(values.size) / 0.08 < Z
    assert abs(values.std() / 0.08 - 1) * np.sqrt(2 * values.size) < Z
    assert stats.kstest(values, stats.norm(0.4, 0.08).cdf).pvalue > 1e-5
    assert np.array(source.mean()) == pytest.approx([0.4])
    wide = at(texture("cell_noise", distribution="gaussian", std=1.0), uv=grid(100, 1 / 2048))
    assert (wide.min(), wide.max()) == (0, 1)


def test_one_value_in_a_cell_and_another_in_the_next() -> None:
    source = texture("cell_noise", cells=50)
    rng = np.random.default_rng(0)
    middle = grid(50, 1 / 50)
    anywhere = middle + rng.uniform(-0.499, 0.499, middle.shape) / 50
    np.testing.assert_array_equal(at(source, uv=anywhere), at(source, uv=middle))
    assert len(np.unique(at(source, uv=middle))) == 2500


@pytest.mark.parametrize("coordinates", ["uv", "position"])
def test_cells_are_independent_of_their_neighbours(coordinates: str) -> None:
    """Correlations of the 200 x 200 cells with those up to eight rows or columns away."""
    where = grid(200, 1 / 200)
    if coordinates == "uv":
        values = at(texture("cell_noise", cells=200), uv=where)
    else:
        values = at(texture("cell_noise", coordinates="position", cell_size=1 / 200), p=np.insert(where, 2, 0.001, axis=1))
    values = values.reshape(200, 200)
    z = {f"{k} rows": correlation(values[k:], values[:-k]) for k in (1, 2, 3, 4, 8)}
    z |= {f"{k} columns": correlation(values[:, k:], values[:, :-k]) for k in (1, 2, 3, 4, 8)}
    z["diagonal"] = correlation(values[1:, 1:], values[:-1, :-1])
    assert all(abs(value) < Z for value in z.values()), {name: f"z = {value:.1f}" for name, value in z.items()}
    blocks = values.reshape(10, 20, 10, 20).mean(axis=(1, 3))  # sums of 400 cells: variance 1/12/400 if independent
    share = blocks.var() * 12 * 400 * 99
    assert 1e-5 < stats.chi2(99).cdf(share) < 1 - 1e-5


@pytest.mark.parametrize("kind", ["cell_noise", "perlin"])
def test_seeds_are_independent(kind: str) -> None:
    """Perlin's lattice cells count, not the points: one point in each."""
    where = grid(200, 1 / 200, start=0.37)
    first, *others = (
        at(texture(kind, cells=200, octaves=1, seed=seed), uv=where) for seed in (0, 1, 2, 1 << 20, (1 << 20) + 1)
    )
    for second in others:
        assert abs(correlation(first, second)) < Z
    np.testing.assert_array_equal(at(texture(kind, cells=200, octaves=1, seed=0), uv=where), first)


def test_cells_by_position_are_cubes_of_the_world() -> None:
    source = texture("cell_noise", coordinates="position", cell_size=0.25, seed=3)
    rng = np.random.default_rng(1)
    cell = rng.integers(-40, 40, (2000, 3))
    middle, anywhere = (cell + 0.5) * 0.25, (cell + rng.uniform(0.001, 0.999, cell.shape)) * 0.25
    np.testing.assert_array_equal(at(source, p=anywhere), at(source, p=middle))
    np.testing.assert_array_equal(at(source, p=middle, uv=rng.random((2000, 2))), at(source, p=middle))  # uv is not read
    for axis in range(3):
        step = np.eye(3)[axis] * 0.25
        assert abs(correlation(at(source, p=middle + step), at(source, p=middle))) < Z
    assert abs(at(source, p=middle).mean() - 0.5) * np.sqrt(12 * 2000) < Z


def test_octaves_add_grids_of_half_the_cell_and_half_the_weight() -> None:
    where = grid(256, 1 / 256)
    values = {
        count: at(texture("cell_noise", cells=64, octaves=count), uv=where).astype(float).reshape(256, 256)
        for count in (1, 2, 3)
    }
    second = values[2] * 1.5 - values[1]  # mean = (first + second / 2) / 1.5
    third = values[3] * 1.75 - values[2] * 1.5
    for octave, block, weight in ((values[1], 4, 1), (second, 2, 0.5), (third, 1, 0.25)):
        cells = octave.reshape(256 // block, block, 256 // block, block)
        np.testing.assert_allclose(cells, np.broadcast_to(cells[:, :1, :, :1], cells.shape), atol=1e-6)
        local = cells[:, 0, :, 0] / weight
        assert 0 <= local.min() < local.max() <= 1 + 1e-6
        assert abs(local.var() - 1 / 12) / np.sqrt((1 / 80 - 1 / 144) / local.size) < Z
    assert abs(correlation(values[1], second)) < Z * 4  # 4 x 4 points share a cell


@pytest.mark.parametrize("kind", ["cell_noise", "perlin"])
def test_to_uv_moves_the_grid(kind: str) -> None:
    """As in Mitsuba's own textures: uv is transformed, here 2 uv + (1/2, 1/4), exactly so in float32."""
    where = (np.random.default_rng(2).integers(0, 1024, (1000, 2)) + 0.5) / 1024
    expected = at(texture(kind, cells=16), uv=2 * where + [0.5, 0.25])
    given = f'''<texture version="3.0.0" type="{kind}">
        <float name="cells" value="16"/>
        <transform name="to_uv"> <scale value="2"/> <translate x="0.5" y="0.25"/> </transform>
    </texture>'''
    np.testing.assert_allclose(at(mi.load_string(given), uv=where), expected, atol=1e-6)
    to_uv = mi.ScalarTransform4f().translate([0.5, 0.25, 0]).scale([2, 2, 1])
    np.testing.assert_allclose(at(texture(kind, cells=16, to_uv=to_uv), uv=where), expected, atol=1e-6)


# ---------------------------------------------------------------- perlin


@pytest.mark.parametrize("coordinates", ["uv", "position"])
def test_perlin_has_mean_one_half_and_stays_in_range(coordinates: str) -> None:
    """One point in each of 40,000 lattice cells; neighbours share corners, so the z-test counts every fourth."""
    where = grid(200, 1.0, start=0.37)
    if coordinates == "uv":
        values = at(texture("perlin", cells=1, octaves=1), uv=where)
    else:
        values = at(texture("perlin", coordinates="position", cell_size=1.0, octaves=1), p=np.insert(where, 2, 0.41, axis=1))
    values = values.astype(float)
    assert 0 <= values.min() < 0.2
    assert 0.8 < values.max() <= 1
    assert abs(values.mean() - 0.5) * np.sqrt(values.size / 4) / values.std() < Z
    skew = ((values - values.mean()) ** 3).mean() / values.std() ** 3
    assert abs(skew) < Z * np.sqrt(6 / (values.size / 4))


def test_perlin_is_the_mean_at_lattice_points() -> None:
    """Gradient noise vanishes there: with one octave exactly the middle of low..high."""
    values = at(texture("perlin", cells=16, octaves=1, low=0.2, high=0.6), uv=grid(16, 1 / 16, start=0.0))
    np.testing.assert_allclose(values, 0.4, atol=1e-6)


@pytest.mark.parametrize("coordinates", ["uv", "position"])
def test_perlin_is_continuous_with_its_slope(coordinates: str) -> None:
    """Along a line through lattice cells: steps shrink with the step, and so do changes of slope, also across borders."""
    source = texture("perlin", coordinates=coordinates, cells=1, cell_size=1.0, octaves=1, contrast=0.7)
    largest = []
    for count in (1000, 4000):
        t = np.linspace(0.05, 8.05, count)
        line = np.column_stack([t, 0.31 + 0.53 * t, 0.7 - 0.29 * t])
        values = at(source, uv=line[:, :2] if coordinates == "uv" else None, p=line).astype(float)
        largest.append((np.abs(np.diff(values)).max(), np.abs(np.diff(values, 2)).max()))
    (first, bend), (fine, fine_bend) = largest
    assert first < 0.03
    assert fine / first == pytest.approx(1 / 4, rel=0.05)
    assert fine_bend / bend < 1 / 10  # 1/16 but for float32's rounding


def test_correlation_length_shrinks_with_the_cells() -> None:
    """The lag at which the autocorrelation halves is a fixed part of the lattice cell."""
    t = (np.arange(2**14) + 0.5) / 2**10  # 1024 points a unit of uv
    lengths = []
    for cells in (4, 8, 16):
        source = texture("perlin", cells=cells, octaves=1, contrast=0.7)
        across = (13 * np.arange(12) + 0.37) / cells  # the same place within a lattice cell
        rows = [at(source, uv=np.column_stack([t, np.full(t.size, y)])) - 0.5 for y in across]
        power = [np.mean([np.mean(row[lag:] * row[: row.size - lag]) for row in rows]) for lag in range(256)]
        lengths.append(int(np.argmax(np.array(power) < power[0] / 2)))
    assert lengths[0] / lengths[1] == pytest.approx(2, rel=0.1)
    assert lengths[1] / lengths[2] == pytest.approx(2, rel=0.1)


def test_octaves_add_detail_and_low_high_bound_it() -> None:
    t = np.column_stack([np.linspace(0, 4, 4000), np.full(4000, 0.3)])
    lines = [at(texture("perlin", cells=4, octaves=count, contrast=0.7), uv=t) for count in (1, 3, 5)]
    rough = [np.abs(np.diff(line)).mean() / line.std() for line in lines]
    assert rough[1] > 1.2 * rough[0]  # in theory 1.5: sqrt(3) the slope, sqrt(21 / 16) the deviation
    assert rough[2] > 1.1 * rough[1]
    strong = at(texture("perlin", cells=4, contrast=9.0, low=0.3, high=0.45), uv=t)
    assert (strong.min(), strong.max()) == (np.float32(0.3), np.float32(0.45))
    assert np.array(texture("perlin", low=0.2, high=0.6).mean()) == pytest.approx([0.4])


# ---------------------------------------------------------------- both


@pytest.mark.parametrize("kind", ["cell_noise", "perlin"])
def test_all_ways_to_ask_agree(kind: str) -> None:
    source = texture(kind, seed=5)
    si = dr.zeros(mi.SurfaceInteraction3f, 100)
    si.uv = mi.Point2f(*np.random.default_rng(3).random((2, 100), dtype=np.float32))
    one = np.array(source.eval_1(si))
    np.testing.assert_array_equal(np.array(source.eval(si)).ravel(), one)
    np.testing.assert_array_equal(np.array(source.eval_3(si)), np.tile(one, (3, 1)))
    active: DeviceArray = mi.Bool(np.arange(100) % 2 == 0)
    np.testing.assert_array_equal(np.array(source.eval_1(si, active)), np.where(np.arange(100) % 2 == 0, one, 0))
    assert source.is_spatially_varying()


@pytest.mark.parametrize(
    ("kind", "properties", "message"),
    [
        ("cell_noise", {"coordinates": "xyz"}, "coordinates must be uv or position: got 'xyz'"),
        ("cell_noise", {"distribution": "rayleigh"}, "distribution must be uniform or gaussian: got 'rayleigh'"),
        ("cell_noise", {"low": 0.7, "high": 0.3}, r"0 <= low <= high <= 1.* got low 0\.7, high 0\.3"),
        ("cell_noise", {"high": 1.5}, r"high 1\.5"),
        ("cell_noise", {"std": -0.1}, r"std -0\.1"),
        ("cell_noise", {"cells": 0}, "cells > 0.* got cells 0"),
        ("cell_noise", {"cell_size": -1.0}, "cell_size -1 m"),
        ("perlin", {"octaves": 0}, "octaves 0"),
        ("perlin", {"octaves": 99}, "octaves 99"),
        ("perlin", {"contrast": 0.0}, "contrast 0"),
        ("perlin", {"low": -0.1}, r"low -0\.1"),
    ],
)
def test_bad_properties(kind: str, properties: MitsubaDict, message: str) -> None:
    with pytest.raises(RuntimeError, match=message):
        texture(kind, **properties)


@pytest.mark.parametrize(
    ("kind", "properties", "scales"),
    [
        ("cell_noise", {"low": 0.2, "high": 0.7}, ("low", "high")),
        ("cell_noise", {"distribution": "gaussian", "mean": 0.5, "std": 0.05}, ("mean", "std")),
        ("perlin", {"low": 0.3, "high": 0.6, "contrast": 1.0}, ("low", "high")),
    ],
)
def test_levels_have_derivatives_and_scale_the_values(kind: str, properties: MitsubaDict, scales: tuple[str, ...]) -> None:
    """A value is proportional to its levels taken together (Euler): its derivatives by them, times them, add up to it."""
    loaded = cast(
        mi.Scene,
        mi.load_dict({"type": "scene", "plate": {"type": "rectangle", "bsdf": diffuse({"type": kind, **properties})}}),
    )
    params = mi.traverse(loaded)
    keys = [next(key for key, _ in params if key.endswith(f"reflectance.{name}")) for name in scales]
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    si = dr.zeros(mi.SurfaceInteraction3f, 200)
    si.uv = mi.Point2f(*np.random.default_rng(3).random((2, 200), dtype=np.float32))
    value = loaded.shapes()[0].bsdf().eval_diffuse_reflectance(si)
    total = dr.sum(value[0])
    dr.backward(total)
    whole = sum(float(dr.grad(params[key])[0]) * float(dr.detach(params[key])[0]) for key in keys)
    assert whole == pytest.approx(float(total[0]), rel=1e-5)


def test_a_level_is_changed_by_traverse_and_checked() -> None:
    loaded = cast(
        mi.Scene, mi.load_dict({"type": "scene", "plate": {"type": "rectangle", "bsdf": diffuse({"type": "cell_noise"})}})
    )
    params = mi.traverse(loaded)
    key = next(key for key, _ in params if key.endswith("reflectance.high"))
    si = dr.zeros(mi.SurfaceInteraction3f, 4)
    si.uv = mi.Point2f([0.1, 0.3, 0.5, 0.7], 0.2)
    before = np.array(loaded.shapes()[0].bsdf().eval_diffuse_reflectance(si)[0])
    params[key] = mi.Float(0.5)
    params.update()
    np.testing.assert_allclose(np.array(loaded.shapes()[0].bsdf().eval_diffuse_reflectance(si)[0]), before / 2, rtol=1e-6)
    params[key] = mi.Float(1.5)
    with pytest.raises(MitsonarError, match=r"high 1\.5"):
        params.update()


def test_a_bitmap_is_read_where_it_lies() -> None:
    """Two texels side by side, u to the right: the left half of a plate reflects 0.2, the right 0.8; also on a mesh."""
    from mitsonar.plugins.surfaces import Surfaces

    values = np.array([[[0.2], [0.8]]], np.float32)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, "filter_type": "nearest"}
    along, aside = mi.Float([-0.9, -0.1, 0.1, 0.9]), mi.Float(0.3)
    for kind, start in (("rectangle", (along, aside)), ("cube", (aside, along))):  # on a cube's top u runs along y
        loaded = scene(plate={"type": kind, "bsdf": diffuse(bitmap)})
        ray = mi.Ray3f(mi.Point3f(*start, 5), mi.Vector3f(0, 0, -1))
        got = np.array(Surfaces.from_scene(loaded).hit(loaded, ray).reflectivity)
        np.testing.assert_allclose(got, [0.2, 0.2, 0.8, 0.8], atol=1e-6)
