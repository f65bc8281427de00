"""Sums are exact: the fused image equals plain NumPy on the stored echoes bit for bit, on any threads and launches."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
import pytest
from helpers import box, diffuse, floor, run_python, scene, sphere

from mitsonar.acoustics.levels import largest_level
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.echoes import Echoes, load_exr, save_exr
from mitsonar.simulation.pings import RenderedPings
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

pytestmark = pytest.mark.usefixtures("variant")

SONARS = {
    "physical": Sonar(beams=10, elevation_fov_deg=40, rays_per_beam=150, range_min=3.3, range_max=5.0, range_bins=200),
    "physical, gain": Sonar(beams=6, elevation_fov_deg=40, rays_per_beam=90, range_bins=7, gain_exponent=3, bearing="cone"),
    "thesis": Sonar(beams=10, elevation_fov_deg=40, rays_per_beam=600, range_min=3.3, range_max=5.0, model="thesis"),
}
"""Windows cut the near and the far end of what returns; the upper rays pass over the floor's edge."""

FLIGHT = Trajectory.between(Pose(0, 0, 2.5, np.radians(35), 0, 0.1), Pose(0.5, 0.3, 2.2, np.radians(30), 0.1, 0.2), 10, 10)


@pytest.fixture(scope="module")
def world(variant: str) -> mi.Scene:
    """Shapes with and without tables, textures in Python and in C++."""
    import mitsuba as mi

    noise = {"type": "cell_noise", "cells": 500}
    bitmap = {
        "type": "bitmap",
        "raw": True,
        "bitmap": mi.Bitmap(np.random.default_rng(0).random((16, 16, 1), dtype=np.float32)),
    }
    return scene(
        floor=floor(diffuse(noise), half=6),
        ball=sphere((0.4, 3.4, 0.2), 0.3, diffuse(bitmap)),
        box=box((-0.6, 3.2, 0), (0.3, 0.2, 0.4), diffuse(0.2)),
        painted=box((0.0, 4.2, 0), (0.3, 0.2, 0.3), diffuse(bitmap)),
    )


# ---------------------------------------------------------------- a second binning, from the docstring of models/thesis.py


def fixed_point_bits(sonar: Sonar) -> int:
    """All rays of a beam at the largest level, in footprints of 1/64 bin, stay below 2^62."""
    solid_angle = sonar.beam_width_rad / sonar.across * math.radians(sonar.elevation_fov_deg) / sonar.rays_per_beam
    largest = largest_level(sonar, solid_angle) * sonar.across * sonar.rays_per_beam
    return 62 - math.ceil(math.log2(largest * (1 if sonar.model == "thesis" else 64)))


def bin_in_numpy(echoes: Echoes, sonar: Sonar) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Levels ``(bins, beams)`` float32, and what became of the rays of each beam; unsigned 64-bit sums."""
    e = {name: np.asarray(value, np.float64) for name, value in vars(echoes).items()}
    beam = np.tile(np.repeat(np.arange(sonar.beams), sonar.across), sonar.rays_per_beam)
    bins, unit = sonar.range_bins, 2.0 ** fixed_point_bits(sonar)
    sums = np.zeros((bins + 2, sonar.beams), np.uint64)
    value = e["reflectivity"] * e["cosine"]
    hit = e["hit"] > 0
    if sonar.model == "thesis":
        place = (e["range_m"] - sonar.range_min) * (1 / sonar.bin_m)
        nearer, farther = hit & (place < 0), hit & (place >= bins)
        inside = hit & ~nearer & ~farther
        amount = (value * unit).astype(np.uint64)
        np.add.at(sums, (place[inside].astype(int), beam[inside]), amount[inside])
    else:
        stored = np.clip(e["range_m"], max(sonar.range_min, sonar.bin_m), 4 * sonar.range_max)
        spreading = {0: 1 / (stored * stored), 1: 1 / stored, 2: stored * 0 + 1, 3: stored, 4: stored * stored}[
            sonar.gain_exponent
        ]
        value = value * e["solid_angle_sr"] * spreading * unit
        a, b = ((e[name] - sonar.range_min) * (1 / sonar.bin_m) for name in ("near_m", "far_m"))
        short, middle = b - a <= 1 / 64, (a + b) * 0.5
        a, b = np.where(short, middle - 1 / 128, a), np.where(short, middle + 1 / 128, b)
        nearer, farther = hit & (b <= 0), hit & (b > 0) & (a >= bins)
        inside = hit & ~nearer & ~farther
        density = (value / (b - a))[inside]
        a, b, beam_in = np.clip(a[inside], 0, bins), np.clip(b[inside], 0, bins), beam[inside]
        whole = density.astype(np.uint64)
        # a box as its derivative: q (1 - frac a) at floor a, q frac a at the next; the same at b with the other sign
        for end, sign in ((a, 1), (b, -1)):
            late = (density * (end - np.floor(end))).astype(np.uint64)
            for offset, amount in ((0, whole - late), (1, late)):
                amount = amount if sign > 0 else np.uint64(0) - amount
                np.add.at(sums, (np.floor(end).astype(int) + offset, beam_in), amount)
        sums = np.cumsum(sums, axis=0, dtype=np.uint64)
    levels = (sums[:bins].astype(np.float64) / unit).astype(np.float32)
    which = {"inside": inside, "nearer": nearer, "farther": farther, "missed": ~hit}
    return levels, {name: np.bincount(beam[chosen], minlength=sonar.beams) for name, chosen in which.items()}


@pytest.mark.thorough
@pytest.mark.parametrize("name", SONARS)
def test_fused_image_equals_numpy_on_the_stored_echoes(world: mi.Scene, tmp_path: Path, name: str) -> None:
    sonar = SONARS[name]
    simulator = Simulator(world, sonar)
    list(simulator.pings(FLIGHT.poses[4:7]))  # what follows is a replay of this launch
    (pings,) = simulator.pings(FLIGHT.poses[:3], first=5)
    for k, pose in enumerate(FLIGHT.poses[:3]):
        save_exr(tmp_path / "echoes.exr", simulator.tracer.film_echoes(pose, 5 + k), sonar)
        levels, counts = bin_in_numpy(load_exr(tmp_path / "echoes.exr", sonar), sonar)
        assert levels.max() > 0
        np.testing.assert_array_equal(pings.levels[k], levels)
        for what, expected in counts.items():
            assert expected.sum() > 0, f"no ray is {what}: the scene tests nothing"
            np.testing.assert_array_equal(getattr(pings.counts, what)[k], expected, err_msg=what)


def assert_same_pings(got: Sequence[RenderedPings], wanted: Sequence[RenderedPings]) -> None:
    """All batches joined."""
    for name in ("levels", "height_m"):
        parts = [np.concatenate([getattr(pings, name) for pings in batches]) for batches in (got, wanted)]
        np.testing.assert_array_equal(parts[0], parts[1], err_msg=name)
    for name in ("inside", "nearer", "farther", "missed"):
        parts = [np.concatenate([getattr(pings.counts, name) for pings in batches]) for batches in (got, wanted)]
        np.testing.assert_array_equal(parts[0], parts[1], err_msg=name)
    for name in wanted[0].labels:
        parts = [np.concatenate([pings.labels[name] for pings in batches]) for batches in (got, wanted)]
        np.testing.assert_array_equal(parts[0], parts[1], err_msg=name)


@pytest.mark.parametrize("name", ["physical", "thesis"])
def test_one_launch_ten_launches_or_three(world: mi.Scene, name: str) -> None:
    sonar = SONARS[name]
    whole = list(Simulator(world, sonar).pings(FLIGHT.poses))
    assert len(whole) == 1
    for pings, launches in ((1, 10), (4, 3)):
        parts = list(Simulator(world, sonar, rays_per_launch=pings * sonar.rays).pings(FLIGHT.poses))
        assert [part.first for part in parts] == list(range(0, 10, pings))
        assert len(parts) == launches
        assert_same_pings(parts, whole)


@pytest.fixture
def threads() -> Iterator[None]:
    """Thread counts may be changed, and are put back."""
    count = dr.thread_count()
    yield
    dr.set_thread_count(count)


@pytest.mark.thorough
@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("name", ["physical", "thesis"])
def test_one_thread_or_two(world: mi.Scene, name: str) -> None:
    result = []
    for count in (1, 2):
        dr.set_thread_count(count)
        result.append(list(Simulator(world, SONARS[name]).pings(FLIGHT.poses, labels=True)))
    assert_same_pings(*result)


@pytest.mark.thorough
def test_threads_may_change_between_launches() -> None:
    """A launch recorded on one thread is replayed on two; in its own interpreter, lest it overruns memory."""
    run_python("""
        import drjit as dr, mitsonar, numpy as np
        from mitsonar.simulation.device import ensure_variant
        ensure_variant("llvm_ad_mono")
        import mitsuba as mi
        floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(100), "bsdf": {"type": "diffuse"}}
        scene = mi.load_dict({"type": "scene", "floor": floor})
        simulator = mitsonar.Simulator(scene, mitsonar.Sonar(beams=10, rays_per_beam=300, range_bins=200))
        poses = [mitsonar.Pose.from_degrees([0, 0, 2.5, 35, 0, heading]) for heading in range(10)]
        found = []
        for count in (1, 2, 1):
            dr.set_thread_count(count)
            found.append(next(simulator.pings(poses)).levels.copy())
        other = [int((levels != found[0]).sum()) for levels in found]
        assert other == [0, 0, 0], f"pixels that differ on one, two and one threads: {other}"
    """)


def test_again_gives_the_same(world: mi.Scene) -> None:
    first, second = (list(Simulator(world, SONARS["physical"]).pings(FLIGHT.poses, labels=True)) for _ in range(2))
    assert_same_pings(first, second)
    another = list(Simulator(world, SONARS["physical"].replace(seed=1)).pings(FLIGHT.poses))
    assert (another[0].levels != first[0].levels).mean() > 0.3  # another seed, another draw


@pytest.mark.parametrize("name", SONARS)
def test_every_ray_is_counted_once(world: mi.Scene, name: str) -> None:
    sonar = SONARS[name]
    counts = next(Simulator(world, sonar).pings(FLIGHT.poses)).counts
    parts = [getattr(counts, what) for what in ("inside", "nearer", "farther", "missed")]
    assert all(part.shape == (10, sonar.beams) and (part >= 0).all() and part.sum() > 0 for part in parts)
    np.testing.assert_array_equal(sum(parts), sonar.rays // sonar.beams)


# ---------------------------------------------------------------- the ends of the scale

AROUND = (0.0, 0.0, 0.0)


@pytest.mark.parametrize("radius", [3.2, 5.0])
def test_all_rays_at_the_largest_level_in_one_bin(radius: float) -> None:
    """The largest sum there can be: a white sphere around the sonar at the window's start. Nothing overflows."""
    loaded = scene(ball=sphere(AROUND, radius + 1e-4, diffuse(1.0)))
    for sonar in (Sonar(beams=4), Sonar(beams=4, model="thesis")):
        levels = next(Simulator(loaded, sonar).pings([Pose(*AROUND)])).levels[0]
        if sonar.model == "thesis":
            expected = 700.0
        else:  # the solid angle of a beam over R^2
            expected = 2 * np.sin(np.radians(7)) * sonar.beam_width_rad / (radius + 1e-4) ** 2
        np.testing.assert_allclose(levels.sum(axis=0), expected, rtol=1e-5)
        assert (levels > 0).sum() <= 2 * sonar.beams  # in one bin, or on the border of two


@pytest.mark.parametrize("exponent", [0, 4])
def test_faint_echoes_keep_their_digits(exponent: int) -> None:
    """A reflectivity of 1e-6 at the far end of a long window: 62 bits leave 1e-5 of it."""
    sonar = Sonar(beams=2, range_min=1, range_max=100, gain_exponent=exponent)
    levels = [
        next(Simulator(scene(ball=sphere(AROUND, 99.9, diffuse(value))), sonar).pings([Pose(*AROUND)])).levels.sum(
            dtype=float
        )
        for value in (1.0, 1e-6)
    ]
    assert levels[1] / levels[0] == pytest.approx(1e-6, rel=1e-5)


def wall(distance: float) -> mi.Scene:
    """A wall across +y at exactly that distance from the origin."""
    import mitsuba as mi

    turned = [[9, 0, 0, 0], [0, 0, -9, distance], [0, 9, 0, 0], [0, 0, 0, 1]]
    return scene(wall={"type": "rectangle", "to_world": mi.ScalarTransform4f(turned), "bsdf": diffuse(0.5)})


ONE_RAY = Sonar(beams=1, rays_per_beam=1, rays_across=1, jitter=False, range_min=2, range_max=4, range_bins=4)
"""It goes straight along +y; borders of the bins lie at 2, 2.5, 3, 3.5 and 4 m, exactly so in float32."""


@pytest.mark.parametrize(
    ("distance", "filled"),
    [(1.75, "nearer"), (2.0, 0), (2.25, 0), (2.5, 1), (3.0, 2), (3.75, 3), (4.0, "farther"), (5.0, "farther")],
)
def test_bins_are_half_open(distance: float, filled: int | str) -> None:
    """A return on the border of two bins belongs to the farther one; at range_max it is outside, and is not clamped."""
    simulator = Simulator(wall(distance), ONE_RAY.replace(model="thesis"))
    assert simulator.tracer.film_echoes(Pose(*AROUND), 0).range_m.tolist() == [distance]
    pings = next(simulator.pings([Pose(*AROUND)]))
    counts = {name: int(getattr(pings.counts, name)[0, 0]) for name in ("inside", "nearer", "farther", "missed")}
    where = filled if isinstance(filled, str) else "inside"
    assert counts == {**dict.fromkeys(counts, 0), where: 1}
    assert pings.levels[0, :, 0].tolist() == [0.5 if place == filled else 0.0 for place in range(4)]


def test_an_echo_without_extent_on_a_border_is_shared() -> None:
    """Seen straight on a cell has no range interval; the shortest one lies evenly about the echo."""
    levels = next(Simulator(wall(3.0), ONE_RAY).pings([Pose(*AROUND)])).levels[0, :, 0]
    assert levels[1] == levels[2] > 0
    assert levels[0] == levels[3] == 0
    inside = next(Simulator(wall(3.25), ONE_RAY).pings([Pose(*AROUND)])).levels[0, :, 0]
    assert np.flatnonzero(inside).tolist() == [2]
