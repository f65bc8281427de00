"""The limit under speckle: covariance of scores against closed forms, and oracles that own the simulator and reach it."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from helpers import Array, Command, diffuse, essence, floor, scene, tiny_recipe
from scipy import ndimage, special, stats
from scipy.sparse import csr_array

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.errors import MitsonarError
from mitsonar.estimation.crlb.image import (
    CellCorrelation,
    CellScores,
    ScoreCovariance,
    SpeckleBounds,
    cramer_rao_bound,
    grain_law,
)
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.composition import Motion, compose
from mitsonar.motion.pose import Pose

if TYPE_CHECKING:
    from mitsonar.simulation.simulator import Simulator

SONAR = Sonar.create(model="coherent", frequency_hz=1.8e6, beams=24, azimuth_fov_deg=7.25, beam_width_deg=0.3, range_min=4.0,
                     range_max=4.45, range_bins=96, bearing="cone", absorption_db_per_m=0.0)  # fmt: skip
POSE = Pose(0.0, 0.0, 2.5, float(np.radians(35)), 0.0, 0.0)


def neighbours(size: int, value: float) -> Array:
    """A correlation of neighbours only."""
    return np.eye(size) + value * (np.eye(size, k=1) + np.eye(size, k=-1))


def near(bins: int, beams: int) -> CellCorrelation:
    return CellCorrelation(csr_array(neighbours(bins, 0.42)), neighbours(beams, 0.45))


# ---------------------------------------------------------------- cells that share noise


def test_the_covariance_is_that_of_the_formula_and_is_inverted() -> None:
    rng = np.random.default_rng(1)
    shape, shared = (7, 5), near(7, 5)
    turn = np.sqrt(0.6) * np.exp(2j * np.pi * rng.random(shape))
    power = np.sqrt(0.3) * np.ones(shape)
    covariance = ScoreCovariance.from_parts([(turn, shared), (power, shared * shared)], shape)
    whole = np.kron(neighbours(7, 0.42), neighbours(5, 0.45))
    flat = turn.ravel()
    expected = (flat.conj()[:, None] * whole * flat).real + 0.3 * whole**2 + 0.1 * np.eye(35)
    values = rng.normal(size=(3, *shape))
    np.testing.assert_allclose((covariance @ values).reshape(3, -1), values.reshape(3, -1) @ expected, atol=1e-12)
    np.testing.assert_allclose(np.diag(expected), 1)
    np.testing.assert_allclose(
        covariance.solve(values).reshape(3, -1), np.linalg.solve(expected, values.reshape(3, -1).T).T, rtol=1e-3, atol=1e-4
    )


def test_an_even_change_of_speckle_counts_independent_cells() -> None:
    """A level that changes by one factor everywhere: cells over the sum of squared coherences, apart from the edges."""
    shape, shared = (200, 120), near(200, 120)
    covariance = ScoreCovariance.from_parts([(np.ones(shape), shared * shared)], shape)
    jacobian = np.zeros((2, *shape, 3))
    jacobian[..., 0] = 1
    message = CellScores(jacobian, np.ones(shape), covariance).bound().information[0, 0]
    alone = (1 + 2 * 0.42**2) * (1 + 2 * 0.45**2)
    assert message == pytest.approx(200 * 120 / alone, rel=0.01)


def test_looks_count_as_independent_cells() -> None:
    """The mean of n looks of one level has the information of n cells, and fewer where looks correlate."""
    shape = 40, 5
    for lag, looks in ((0.0, 4), (0.42, 4)):
        one = CellCorrelation(csr_array(neighbours(40 * looks, lag)), np.eye(5))
        parts = [(np.ones((40 * looks, 5)), one * one)]
        variance, covariance = ScoreCovariance.of_looks(parts, looks)
        alone = (1 + 2 * (looks - 1) / looks * lag**2) / looks
        np.testing.assert_allclose(variance, alone)
        values = np.random.default_rng(3).normal(size=(2, *shape))
        mean = np.kron(np.eye(40), np.ones((1, looks)) / looks)
        whole = mean @ (neighbours(40 * looks, lag) ** 2) @ mean.T / alone
        np.testing.assert_allclose(covariance @ values, whole @ values, atol=2e-6 * np.abs(values).max())


def test_strong_looks_have_gaussian_powers() -> None:
    """The law of the mean power of several looks, against draws of noise."""
    rng = np.random.default_rng(4)
    looks, noise = 3, 0.01
    echo = np.exp(2j * np.pi * rng.random((6 * looks, 4))) * rng.uniform(1, 2, (6 * looks, 4))
    shared = CellCorrelation(csr_array(neighbours(6 * looks, 0.42)), neighbours(4, 0.45))
    weight, covariance = grain_law(echo, np.full((6, 4), noise), shared, looks=looks)
    root = np.kron(np.linalg.cholesky(neighbours(6 * looks, 0.42)), np.linalg.cholesky(neighbours(4, 0.45)))
    white = (rng.normal(size=(20_000, 72)) + 1j * rng.normal(size=(20_000, 72))) * np.sqrt(noise / 2)
    field = echo + (white @ root.T).reshape(-1, 6 * looks, 4)
    power = (np.abs(field) ** 2).reshape(-1, 6, looks, 4).mean(axis=2)
    np.testing.assert_allclose(power.var(axis=0) * weight, 1, atol=0.06)
    drawn = np.corrcoef(power.reshape(-1, 24).T)
    built = np.stack([(covariance @ one.reshape(1, 6, 4)).ravel() for one in np.eye(24)])
    np.testing.assert_allclose(drawn, built, atol=0.04)


def test_strong_echoes_have_gaussian_amplitudes() -> None:
    """J' C^-1 J with the covariance N / 2 Re(r exp(j (phase difference))) of the amplitudes, as for any Gaussian."""
    rng = np.random.default_rng(2)
    shape, noise = (9, 6), 1e-7
    echo = np.exp(2j * np.pi * rng.random(shape)) * rng.uniform(1, 2, shape)
    slope = rng.normal(size=(*shape, 3))
    result = CellScores(np.stack([slope, slope]), *grain_law(echo, np.full(shape, noise), near(*shape))).bound()
    by_amplitude = (slope / (2 * np.abs(echo))[..., None]).reshape(-1, 3)
    turn = np.exp(1j * np.angle(echo)).ravel()
    whole = noise / 2 * (turn.conj()[:, None] * np.kron(neighbours(9, 0.42), neighbours(6, 0.45)) * turn).real
    expected = by_amplitude.T @ np.linalg.solve(whole, by_amplitude)
    np.testing.assert_allclose(result.information, expected, rtol=2e-3, atol=1e-3 * np.abs(expected).max())


def test_rounding_is_a_variance_and_without_noise_it_is_all() -> None:
    shape = (4, 5)
    echo, none = np.ones(shape, complex), np.zeros(shape)
    weight, _ = grain_law(echo, none, near(*shape), 0.01)
    np.testing.assert_allclose(weight, 100)
    weight, _ = grain_law(echo, np.full(shape, 1e-4), near(*shape), 0.01)
    np.testing.assert_allclose(weight, 1 / (0.01 + 2e-4), rtol=1e-3)  # var |s|^2 = 2 N |s|^2
    with pytest.raises(MitsonarError, match="noise_level_db"):
        grain_law(echo, none, near(*shape))


# ---------------------------------------------------------------- oracles


def source(noise_db: float, even: bool = False, looks: int = 1) -> Simulator:
    """Even ground, or soft blotches of 10 cm; a noise of -90 dB lies 16 dB below the median echo."""
    import mitsuba as mi

    from mitsonar.simulation.simulator import Simulator

    grain = ndimage.gaussian_filter(np.random.default_rng(5).random((400, 400)), 1.5, mode="wrap")
    picture = mi.Bitmap(np.clip(0.5 + (grain - 0.5) * 3, 0.02, 1).astype(np.float32)[..., None])
    blotches = {"type": "bitmap", "bitmap": picture, "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp"}
    result = scene(floor=floor(diffuse(0.5 if even else blotches), 10.0))
    return Simulator(result, SONAR.replace(noise_level_db=noise_db, looks=looks))


@lru_cache(maxsize=4)
def limits(noise_db: float, even: bool = False, looks: int = 1) -> SpeckleBounds:
    return SpeckleBounds(source(noise_db, even, looks), 1.0)


def reaches(value: float, draws: int) -> bool:
    """Whether a mean of e' F e / 3 of so many draws is that of the bound."""
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], 3 * draws) / (3 * draws)
    return bool(low < value < high)


def pulled(told: CellScores, scores: Array) -> Array:
    """Return J' W^1/2 C^-1 of standardised scores ``(n, bins, beams)``, as ``(n, 3)``."""
    jacobian = told.jacobian.mean(axis=0, dtype=float) * np.sqrt(told.weight)[..., None]
    return np.asarray(np.einsum("nij,ijk->nk", told.covariance.solve(scores), jacobian))


def rician_scores(amplitude: Array, echo: Array, noise: Array, weight: Array) -> Array:
    """Standardised derivatives of the log of the density of amplitudes by the power of their echo."""
    z = 2 * amplitude * echo / noise
    return np.asarray((amplitude / echo * special.i1e(z) / special.i0e(z) - 1) / noise / np.sqrt(weight))


def grain_oracle(bounds: SpeckleBounds, draws: int) -> float:
    """e' F e / 3 of scoring from a start that is off, with the echoes rendered anew at each step; noise as pings have it."""
    pose = np.array(POSE)
    message = bounds.grain(pose)
    weight, covariance = grain_law(bounds.imager.echoes(pose)[0].astype(complex), bounds.noise, bounds.noise_correlation)
    message = CellScores(message.jacobian, weight, covariance)  # amplitudes are not rounded here
    limit = message.bound()
    echo = bounds.imager.echoes(pose)[0]
    amplitude = np.abs(np.array([echo + bounds.imager.receiver.noise(ping) for ping in range(draws)])).astype(float)
    motion = np.tile(limit.std() * [2, -1, 1], (draws, 1))
    for _ in range(3):
        for frame in range(draws):
            moved = np.abs(bounds.imager.echoes(np.array(compose(POSE, Motion(*motion[frame]))))[0]).astype(float)
            scores = rician_scores(amplitude[frame], np.maximum(moved, 1e-12), bounds.noise, weight)
            motion[frame] += np.linalg.solve(limit.information, pulled(message, scores[None])[0])
    return float(np.einsum("ni,ij,nj->n", motion, limit.information, motion).mean() / 3)


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("noise_db", essence([-90.0, -75.0], -90.0))
@pytest.mark.slow
def test_an_oracle_of_the_scatterers_reaches_the_grain_bound(noise_db: float) -> None:
    """At a high and at a low ratio of echo to noise."""
    value = grain_oracle(limits(noise_db, even=True), 12)
    assert reaches(value, 12), value


def ground_oracle(bounds: SpeckleBounds, draws: int) -> float:
    """e' F e / 3 of one step of scoring on frames whose scatterers are drawn anew; level and motion are known before."""
    from mitsonar.simulation.models.coherent import CoherentImager

    pose = np.array(POSE)
    message = bounds.ground(pose, 12)
    limit = message.bound()
    level = next(bounds.expected.pings(np.tile(pose, (24, 1)), first=9000)).levels.mean(axis=0)
    mean = level / bounds.imager.gain[:, None] + bounds.noise
    scores = []
    for seed in range(draws):
        imager = CoherentImager(bounds.expected.tracer.scene, bounds.sonar.replace(seed=1000 + seed))
        power = np.abs(imager.image(pose, seed)[0].astype(complex)) ** 2
        power = power.reshape(len(mean), bounds.sonar.looks, -1).mean(axis=1)
        scores.append((power / mean - 1) * np.sqrt(message.weight))
    motion = np.linalg.solve(limit.information, pulled(message, np.array(scores)).T).T
    return float(np.einsum("ni,ij,nj->n", motion, limit.information, motion).mean() / 3)


@pytest.mark.usefixtures("variant")
@pytest.mark.slow
@pytest.mark.parametrize("looks", essence([1, 3], 1))
def test_an_oracle_of_the_level_reaches_the_ground_bound(looks: int) -> None:
    value = ground_oracle(limits(-75.0, looks=looks), 10)
    assert reaches(value, 10), value


@pytest.mark.usefixtures("variant")
@pytest.mark.thorough
def test_looks_tell_more_of_the_ground() -> None:
    """Three looks lower the bound of an even level by about sqrt(3), and noise bounds the grain as before."""
    one, several = (next(limits(-75.0, looks=looks).at_poses(np.array(POSE))) for looks in (1, 3))
    ratio = one["ground"].std(2) / several["ground"].std(2)
    assert ((ratio > 1.1) & (ratio < 1.9)).all()
    assert np.isfinite(several["grain"].std(2)).all()


# ---------------------------------------------------------------- the bound itself


@pytest.mark.usefixtures("variant")
@pytest.mark.slow
def test_grain_tells_far_more_than_ground_and_noise_hides_both() -> None:
    quiet, loud = (next(limits(noise_db).at_poses(np.array(POSE))) for noise_db in (-90.0, -75.0))
    assert (quiet["grain"].std(2) < 0.05 * quiet["ground"].std(2)).all()
    for law in ("grain", "ground"):
        assert (quiet[law].std(2) < loud[law].std(2)).all()
    simulator = source(-90.0)
    result = cramer_rao_bound(simulator, np.array(POSE), NOISE_MODELS["none"], 1.0)
    np.testing.assert_allclose(result[0], quiet["ground"].std(2))
    with pytest.raises(MitsonarError, match="adds its own noise"):
        cramer_rao_bound(simulator, np.array(POSE), NOISE_MODELS["low"], 1e-3)
    with pytest.raises(MitsonarError, match="unknown law 'rays'"):
        cramer_rao_bound(simulator, np.array(POSE), NOISE_MODELS["none"], 1e-3, law="rays")
    from mitsonar.simulation.simulator import Simulator

    saturated = Simulator(simulator.tracer.scene, simulator.sonar.replace(saturation_db=-40.0))
    with pytest.raises(MitsonarError, match="got saturation_db -40; leave it out"):
        SpeckleBounds(saturated, 1.0)


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_commands_answer_coherent_data_sets(tmp_path: Path, mitsonar: Command) -> None:
    """`crlb` says which laws it used, and `compare` divides by the last of them."""
    from mitsonar.datasets.make import make_dataset

    url = tmp_path / "coherent.zarr"
    changes = {"model": "coherent", "beams": 12, "range_bins": 48}
    make_dataset(tiny_recipe(**{f"sonar__{key}": value for key, value in changes.items()}), str(url), sequences=3)
    done = mitsonar("crlb", url, "--pairs", 1, "--part", "all", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert list(report["laws"]) == ["grain", "ground"] == [row["law"] for row in report["rows"]]
    done = mitsonar("compare", url, "--part", "all", "--estimators", "zero", "--limit", 1, "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "/ limit (ground)" in done.stdout
    assert "limit of two frames: grain" in done.stdout
    assert mitsonar("crlb", url, "--noise", "high").returncode == 2
