"""The limit: laws of noisy pixels against the noise itself and closed forms, derivatives against geometry, and an oracle
that owns the renderer and reaches the bound."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from crlb_command import command, floor_scene
from helpers import box, diffuse, floor, scene, sphere
from scipy import ndimage, optimize, special, stats

from mitsonar.acoustics.noise import NOISE_MODELS, NoiseModel, information, information_of_sums
from mitsonar.errors import MitsonarError
from mitsonar.estimation.crlb.image import (
    Bound,
    bound,
    bounds_of_views,
    cramer_rao_bound,
    fisher,
    floor_ranges,
    overall,
    varied,
)
from mitsonar.geometry.ground import GroundGeometry
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.composition import Motion, compose
from mitsonar.motion.pose import Pose
from mitsonar.records.frames import to_uint8

if TYPE_CHECKING:
    from mitsonar.simulation.simulator import Simulator

LOW, HIGH = NOISE_MODELS["low"], NOISE_MODELS["high"]
POSE = Pose.from_degrees([0.3, -0.2, 2.5, 35, 0, 20])

# ---------------------------------------------------------------- what a noisy pixel tells


@pytest.mark.parametrize("noise", [LOW, HIGH], ids=["low", "high"])
@pytest.mark.parametrize("level", [0.0, 0.0131, 0.4, 0.97])
def test_grey_values_have_the_law_that_noise_gives_them(noise: NoiseModel, level: float) -> None:
    """Drawn, clipped and rounded by the code that frames go through; chi-square over the grey values."""
    image = np.full((4, 256, 256), level, np.float32)
    greys = np.bincount(to_uint8(noise.apply(image, seed=3, frames=np.arange(4))).ravel(), minlength=256)
    law = noise.grey_of_echo(level)[0] if level else noise.grey_of_empty()
    expected = law * image.size
    often = expected > 5
    assert abs(law.sum() - 1) < 1e-12
    assert greys[~often].sum() < expected[~often].sum() + 5 * np.sqrt(expected[~often].sum()) + 5
    got, target = np.append(greys[often], greys[~often].sum()), np.append(expected[often], expected[~often].sum())
    assert stats.chisquare(got[target > 0], target[target > 0]).pvalue > 1e-4


def test_derivative_of_the_law() -> None:
    level, step = np.linspace(0.01, 0.99, 50), 1e-6
    slope = (HIGH.grey_of_echo(level + step)[0] - HIGH.grey_of_echo(level - step)[0]) / (2 * step)
    np.testing.assert_allclose(HIGH.grey_of_echo(level)[1], slope, atol=1e-4)
    with pytest.raises(MitsonarError, match="scale"):
        NoiseModel(mean=0.1).grey_of_echo(0.5)


@pytest.mark.parametrize("greys", [255, 4095])
def test_information_of_an_added_rayleigh_value(greys: int) -> None:
    """Without clipping, u = (end of the grey value that the law begins in - level) / g: that one has 1 - exp(-u^2 / 2), all
    beyond it the integral of p'^2 / p = (1 / x - x)^2 x exp(-x^2 / 2), E1(u^2 / 2) / 2 + u^2 exp(-u^2 / 2), over g^2."""
    g, phase = 0.1, np.array([0.2, 0.5])
    u = (1 - phase) / greys / g
    first = u**2 * np.exp(-(u**2)) / -np.expm1(-(u**2) / 2)
    expected = (first + special.exp1(u**2 / 2) / 2 + u**2 * np.exp(-(u**2) / 2)) / g**2
    message = information(NoiseModel(mean=0.1, std=0.01, scale=g), (20 + phase - 0.5) / greys, greys=greys)
    # rounding hides a little of the density in the next few grey values
    np.testing.assert_allclose(message.law[:, 0, 0], expected, rtol=0.025)  # type: ignore[index]
    assert (message.law[:, 0, 0] < expected).all()  # type: ignore[index]


def test_finer_grey_values_tell_more_by_a_logarithm() -> None:
    """The corner where the law begins: ln 2 / g^2 for each bit; the matched Gaussian stays at 1 / ((2 - pi / 2) g^2)."""
    level = np.linspace(0.2, 0.2 + 4 / 255, 400, endpoint=False)
    by_bits = []
    for greys in (255, 511, 1023, 2047):
        message = information(NoiseModel(mean=0.1, std=0.01, scale=0.1), level, greys=greys)
        by_bits.append(message.law[:, 0, 0].mean())  # type: ignore[index]
        np.testing.assert_allclose(message.matched()[:, 0, 0], 1 / ((2 - np.pi / 2) * 0.1**2), rtol=2e-3)
    np.testing.assert_allclose(np.diff(by_bits), np.log(2) / 0.1**2, rtol=0.02)


def test_rounding_and_clipping_only_take_information_away() -> None:
    """Grey values of 85 and 17 levels are unions of those of 255; levels nearer to the top lose their tail."""
    level = np.linspace(0.011, 0.6, 200)
    laws = [information(HIGH, level, greys=greys).law[:, 0, 0] for greys in (255, 85, 17)]  # type: ignore[index]
    assert (laws[0] > laws[1]).all()
    assert (laws[1] > laws[2]).all()
    clipped = information(HIGH, (np.array([50, 150, 200, 240, 252]) + 0.2) / 255).law[:, 0, 0]  # type: ignore[index]
    assert (np.diff(clipped) < 0).all()
    assert information(HIGH, 1.0).law[0, 0] == 0  # type: ignore[index]


@pytest.mark.parametrize("noise", [LOW, HIGH], ids=["low", "high"])
def test_the_matched_gaussian_never_tells_more_than_the_law(noise: NoiseModel) -> None:
    filled, level = np.meshgrid([0.05, 0.3, 0.7, 0.99], np.linspace(0.02, 0.9, 20))
    message = information(noise, filled * level, filled)
    assert message.law is not None
    assert np.linalg.eigvalsh(message.law - message.matched()).min() > -1e-8 * message.law.max()
    full = information(HIGH, np.linspace(0.02, 0.5, 500))
    ratio = np.sqrt(full.matched()[:, 0, 0] / full.law[:, 0, 0])  # type: ignore[index]
    assert 0.58 < ratio.mean() < 0.64  # the true bound is about 0.6 of the variance-matched one


def test_a_pixel_that_is_filled_or_not_is_a_coin_where_it_shows() -> None:
    """Laws that do not overlap: of (echo, filled) information is filled I(echo) and 1 / (filled (1 - filled)), alone."""
    noise, echo, c = NoiseModel(mean=0.05, std=0.005, scale=0.02), 0.4, 0.3
    law = information(noise, c * echo, c).law
    to_level = np.array([[c, echo], [0, 1]])  # level = filled echo
    apart = to_level.T @ law @ to_level
    alone = information(noise, echo).law[0, 0]  # type: ignore[index]
    np.testing.assert_allclose(apart, [[c * alone, 0], [0, 1 / (c * (1 - c))]], rtol=1e-9, atol=1e-6 * alone)


def test_sums_have_the_information_of_their_gaussian() -> None:
    """The law that ``apply_sum`` draws: 1 / V for the sum, and for the number of echoes by mean and by variance."""
    nonzero, cells = np.array([0.0, 30.0, 96.0]), 96
    message = information_of_sums(HIGH, nonzero, cells)
    drawn = HIGH.apply_sum(np.full((4000, 3), 20.0), np.tile(nonzero, (4000, 1)), cells, seed=1, frames=np.arange(4000))
    np.testing.assert_allclose(message.variance, drawn.var(axis=0), rtol=5 * np.sqrt(2 / 4000))
    np.testing.assert_allclose(message.law[:, 0, 0], 1 / message.variance)  # type: ignore[index]
    by_one = np.diff(information_of_sums(HIGH, nonzero + 1e-3, cells).variance - message.variance)
    assert abs(by_one).max() < 1e-12  # linear in the number
    slope = (information_of_sums(HIGH, nonzero + 1, cells).variance - message.variance)[0]
    expected = message.slope[:, 1] ** 2 / message.variance + slope**2 / (2 * message.variance**2)
    np.testing.assert_allclose(message.law[:, 1, 1], expected)  # type: ignore[index]


def test_without_noise_only_rounding_is_left() -> None:
    message = information(NOISE_MODELS["none"], 0.3)
    assert message.law is None
    np.testing.assert_allclose(message.matched(), [[12 * 255**2, 0], [0, 0]])
    assert information_of_sums(NOISE_MODELS["none"], 5.0, 10).law is None


# ---------------------------------------------------------------- derivatives

SONAR = Sonar(beams=16, range_bins=64, rays_per_beam=200, rays_across=4, range_min=3.8, range_max=5.2)


def simulator(sonar: Sonar = SONAR, **shapes: dict[str, Any]) -> Simulator:
    from mitsonar.simulation.simulator import Simulator

    return Simulator(scene(**shapes), sonar)


def bitmap(values: np.ndarray, to: float = 1.0) -> dict[str, Any]:
    import mitsuba as mi

    picture = mi.Bitmap(np.asarray(values, np.float32)[..., None] * np.float32(to))
    return {"type": "bitmap", "bitmap": picture, "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp"}


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("model", ["thesis", "physical"])
def test_an_even_floor_does_not_tell_the_motion(model: str) -> None:
    """Common random numbers: both sides agree to the bit but for rounding of poses, and nothing is observable."""
    from mitsonar.simulation.derivatives import differentiate

    source = simulator(SONAR.replace(model=model), floor=floor())
    (result,) = next(differentiate(source, POSE, gain_of(source), pings=2))
    assert result.filled.max() == 1
    assert np.isinf(bound(result, HIGH).std()).all()  # type: ignore[union-attr]


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("model", ["thesis", "physical"])
def test_a_ramp_moves_as_geometry_says(model: str) -> None:
    """Reflectivity c + k y (world) under heading 0: levels change by k times those of an even floor for each metre forward,
    not at all sideways, and by -k X for each radian, X to starboard of the sonar."""
    from mitsonar.simulation.derivatives import differentiate

    half, sonar = 10.0, SONAR.replace(model=model)
    place = (np.arange(256) + 0.5) / 256 * 2 * half - half
    ramp = np.repeat((0.5 + 0.04 * place)[:, None], 256, axis=1)  # rows of a bitmap run along v
    source, even = (
        simulator(sonar, floor=floor(diffuse(bitmap(ramp)), half)),
        simulator(sonar, floor=floor(diffuse(1.0), half)),
    )
    pose = Pose.from_degrees([0.3, -0.2, 2.5, 35, 0, 0])
    gain = 0.3 / float(next(even.pings([pose])).levels.max())
    (result,), (flat,) = (next(differentiate(one, pose, gain, pings=10)) for one in (source, even))
    by_sideways, by_forward, by_yaw = np.moveaxis(result.jacobian[..., 0, :].mean(axis=0, dtype=float), -1, 0)
    inner = flat.filled == 1
    starboard = GroundGeometry(sonar.range_m, sonar.bearing_rad, sonar.bearing, 2.5, pose.pitch).points[..., 0]
    size = 0.04 * flat.level[inner]
    np.testing.assert_allclose(by_forward[inner].sum(), size.sum(), rtol=1e-4)
    assert abs(by_sideways[inner]).max() < 1e-3 * size.max()
    np.testing.assert_allclose((by_yaw * starboard)[inner].sum(), -(size * starboard[inner] ** 2).sum(), rtol=1e-3)


def gain_of(source: Simulator, pose: Pose = POSE) -> float:
    return 0.7 / float(next(source.pings([pose])).levels.max())


@pytest.mark.usefixtures("variant")
def test_two_halves_cancel_the_noise_of_rays() -> None:
    """Few rays, one ping in each half: J' W J is lifted by the noise of the rays, J1' W J2 agrees with 64 pings."""
    from mitsonar.simulation.derivatives import differentiate

    texture = {"type": "cell_noise", "cells": 600}
    source = simulator(SONAR.replace(model="thesis", rays_per_beam=60), floor=floor(diffuse(texture), 10))
    few = [result for (result,) in differentiate(source, [POSE] * 40, 0.2, pings=1)]
    (many,) = next(differentiate(source, POSE, 0.2, pings=64))

    def forward(first: np.ndarray, second: np.ndarray) -> float:
        return float(np.sum(first[..., 0, 1].astype(float) * second[..., 0, 1]))

    expected = forward(*many.jacobian)
    crossed = [forward(*result.jacobian) for result in few]
    assert abs(np.mean(crossed) - expected) < 4 * np.std(crossed) / np.sqrt(40) + 0.02 * expected
    lifted = np.mean([forward(result.jacobian.mean(axis=0), result.jacobian.mean(axis=0)) for result in few])
    assert lifted > 1.2 * expected, f"{lifted / expected:.2f}"


@pytest.mark.usefixtures("variant")
def test_the_same_pings_twice_and_words_that_are_wrong() -> None:
    from mitsonar.simulation.derivatives import differentiate

    source = simulator(floor=floor(diffuse({"type": "cell_noise", "cells": 600}), 10))
    one, second = (next(differentiate(source, POSE, 1e3, pings=2))[0] for _ in range(2))
    assert np.array_equal(one.jacobian, second.jacobian)
    with pytest.raises(MitsonarError, match="at least 1 ping"):
        next(differentiate(source, POSE, 1.0, pings=0))
    with pytest.raises(MitsonarError, match="finite"):
        next(differentiate(source, [0, 0, np.nan, 0, 0, 0], 1.0))
    with pytest.raises(MitsonarError, match="pixel, gaussian, rays"):
        bound(one, HIGH, law="poisson")


# ---------------------------------------------------------------- from information to bounds


def test_information_of_independent_values_adds_up() -> None:
    rng = np.random.default_rng(0)
    jacobian, weight = rng.normal(size=(50, 2, 3)), np.tile(np.diag([3.0, 1.0]), (50, 1, 1))
    both = np.stack([jacobian, jacobian])
    whole = fisher(both, weight)
    parts = fisher(both[:, :20], weight[:20]) + fisher(both[:, 20:], weight[20:])
    np.testing.assert_allclose(whole.information, np.einsum("nai,nab,nbj->ij", jacobian, weight, jacobian))
    np.testing.assert_allclose(parts.information, whole.information)
    np.testing.assert_allclose(whole.covariance(2), 2 * np.linalg.inv(whole.information))
    np.testing.assert_allclose(whole.std(2), np.sqrt(2) * whole.std(1))
    with pytest.raises(MitsonarError, match="1 or 2"):
        whole.std(3)


def test_what_cannot_be_observed_is_infinite_and_leaves_the_rest() -> None:
    none = np.zeros((3, 3, 3, 3))
    np.testing.assert_allclose(Bound(np.diag([4.0, 1.0, 0.0]), none).std(), [0.5, 1, np.inf])
    # sideways and yaw only ever seen together
    together = np.outer([1.0, 0, 2.0], [1.0, 0, 2.0]) + np.diag([0, 9.0, 0])
    np.testing.assert_allclose(Bound(together, none).std(), [np.inf, 1 / 3, np.inf])
    assert np.isinf(Bound(np.zeros((3, 3)), none).std()).all()
    np.testing.assert_allclose(overall([[3, 1, 1], [4, 1, np.inf]]), [np.sqrt(12.5), 1, np.inf])


def test_the_doubt_is_the_scatter_of_bounds() -> None:
    """Noise on Jacobians: F is right on average, and its standard error is what is scattered about it."""
    rng = np.random.default_rng(1)
    true, weight = rng.normal(size=(400, 1, 3)) * [2, 5, 3], np.ones((400, 1, 1))
    result = [fisher(true + rng.normal(size=(2, 400, 1, 3)), weight) for _ in range(400)]
    exact = true[:, 0].T @ true[:, 0]
    got = np.array([one.information for one in result])
    error = np.sqrt([one.reason[0, 1, 0, 1] for one in result]).mean()
    assert (abs(got.mean(axis=0) - exact) < 4.5 * got.std(axis=0) / 20).all()
    np.testing.assert_allclose(error, got[:, 0, 1].std(), rtol=0.2)
    output = np.array([one.relative_error for one in result]).mean(axis=0)
    stds = np.array([one.std() for one in result])
    assert np.isfinite(stds).all()
    np.testing.assert_allclose(output, stds.std(axis=0) / stds.mean(axis=0), rtol=0.25)


def test_the_window_follows_the_floor() -> None:
    """A flat floor: ranges grow with the height; the DIDSON's window of 3.2 to 5.6 m keeps its share of floor and margin."""
    poses, heights = np.array([POSE]), np.array([2.5])
    sonar, changed = varied(SONAR, poses, heights, "height_m", 5.0)
    assert (sonar.range_min, sonar.range_max) == (2 * SONAR.range_min, 2 * SONAR.range_max)
    assert changed[0, 2] == poses[0, 2] + 2.5
    near, far = floor_ranges(Sonar(), 2.5, np.radians(35))
    assert (round(near, 2), round(far, 2)) == (3.74, 5.54)
    pitched, changed = varied(SONAR, poses, heights, "pitch_deg", 45.0)
    assert pitched.range_max < SONAR.range_max
    np.testing.assert_allclose(np.degrees(changed[0, 3]), 45)
    fine, same = varied(SONAR, poses, heights, "range_bins", 128.0)
    assert (fine.range_bins, fine.range_max) == (128, SONAR.range_max)
    assert np.array_equal(same, poses)
    window, _ = varied(SONAR, poses, heights, "window", (3.0, 6.0))
    assert (window.range_min, window.range_max) == (3, 6)
    for name, value, words in (
        ("pitch_deg", 5.0, "horizon"),
        ("height_m", -1.0, "above 0"),
        ("beams", 3.5, "whole"),
        ("hieght", 1.0, "height_m"),
    ):
        with pytest.raises(MitsonarError, match=words):
            varied(SONAR, poses, heights, name, value)


# ---------------------------------------------------------------- the oracle


class Oracle:
    """Who owns the renderer: knows the mean image at any motion, with the same draws of the jitter as the frame's own.

    Args:
        sonar: the instrument.
        pings: that each mean is of.
    """

    def __init__(self, sonar: Sonar, pings: int) -> None:
        from mitsonar.simulation.derivatives import differentiate

        grain = ndimage.gaussian_filter(np.random.default_rng(5).random((400, 400)), 1.5, mode="wrap")
        grain = np.clip(0.5 + (grain - 0.5) * 3, 0.02, 1)  # cells of 5 cm, smooth over some
        self.source = simulator(
            sonar,
            floor=floor(diffuse(bitmap(grain)), 10.0),
            stone=sphere([0.2, 3.3, 0.1], 0.25, diffuse(0.8)),
            block=box([1.4, 3.9, 0.1], [0.2, 0.1, 0.2], diffuse(0.6)),
        )
        self.pings = pings
        self.gain = gain_of(self.source)
        (self.derivative,) = next(differentiate(self.source, POSE, self.gain, pings=4 * pings))
        self.jacobian = self.derivative.jacobian.mean(axis=0, dtype=float).reshape(-1, 2, 3)
        self.level, self.filled = (values[0] for values in self.means(np.zeros((1, 3))))

    def means(self, motions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean level and coverage ``(n, pixels)`` after each motion."""
        images = []
        for one in motions:
            poses = np.repeat([compose(POSE, Motion(*one))], self.pings, axis=0)
            levels = np.concatenate([batch.levels for batch in self.source.pings(poses)])
            images.append(np.minimum(levels * np.float32(self.gain), 1).reshape(self.pings, -1))
        return np.stack([im.mean(axis=0, dtype=float) for im in images]), np.stack([(im > 0).mean(axis=0) for im in images])


@lru_cache(maxsize=2)
def oracle(beams: int, bins: int, pings: int) -> Oracle:
    return Oracle(SONAR.replace(beams=beams, range_bins=bins), pings)


def least_squares(
    who: Oracle, values: np.ndarray, noise: NoiseModel | None, variance: np.ndarray | float, limit: Bound
) -> np.ndarray:
    """Motions ``(n, 3)`` by Gauss-Newton on frames ``(n, pixels)``, rendered anew at each of three steps."""
    echo, empty = (0.0, 0.0) if noise is None else (noise.scale * np.sqrt(np.pi / 2), noise.mean)
    by_motion = who.jacobian[:, 0] + (echo - empty) * who.jacobian[:, 1]
    motion = np.tile([0.002, -0.001, 0.0005], (len(values), 1))
    for _ in range(3):
        level, filled = who.means(motion)
        residual = values - (level + echo * filled + empty * (1 - filled))
        motion += np.linalg.solve(limit.information, by_motion.T @ (residual / variance).T).T
    return motion


def normed(errors: np.ndarray, limit: Bound) -> float:
    """Mean of e' F e / 3."""
    return float(np.einsum("ni,ij,nj->n", errors, limit.information, errors).mean() / 3)


def reaches(value: float, draws: int, excess: float = 0.0) -> bool:
    """Whether the mean of e' F e / 3 of so many draws is that of the bound, or exceeds it by no more than a part."""
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], 3 * draws) / (3 * draws)
    return bool(low < value < high * (1 + excess))


def gaussian_oracle(who: Oracle, draws: int, std: float = 0.05) -> float:
    """e' F e / 3 of least squares on frames with Gaussian noise, neither clipped nor rounded: information 1 / std^2."""
    weight = np.zeros((who.level.size, 2, 2))
    weight[:, 0, 0] = 1 / std**2
    limit = fisher(who.derivative.jacobian.reshape(2, -1, 2, 3).astype(float), weight)
    values = who.level + std * np.random.default_rng(2).normal(size=(draws, who.level.size))
    return normed(least_squares(who, values, None, std**2, limit), limit)


def pixel_oracle(who: Oracle, draws: int, noise: NoiseModel, greys: int) -> tuple[float, float, float]:
    """e' F e / 3 on frames of grey values, drawn, clipped and rounded as frames are: of least squares by the matched bound
    and by the exact one, and of maximum likelihood by the exact one."""
    exact, matched = (bound(who.derivative, noise, law=law, greys=greys) for law in ("pixel", "gaussian"))
    assert exact is not None
    assert matched is not None
    present = np.random.default_rng(3).random((draws, who.level.size)) < who.filled
    echo = np.divide(who.level, who.filled, out=np.zeros_like(who.level), where=who.filled > 0)
    image = np.where(present, echo, 0).astype(np.float32).reshape(draws, *who.derivative.level.shape)
    stored = to_uint8(noise.apply(image, seed=4, frames=np.arange(draws))).reshape(draws, -1)
    frames = np.maximum((stored.astype(int) + 255 // greys // 2) // (255 // greys), stored > 0)  # fewer bits
    squares = least_squares(
        who, frames / greys, noise, information(noise, who.level, who.filled, greys=greys).variance, matched
    )
    best = squares.copy()
    for _ in range(2):
        level, filled = who.means(best)
        best += [most_likely(who, noise, greys, *one, exact) for one in zip(frames, level, filled, strict=True)]
    return normed(squares, matched), normed(squares, exact), normed(best, exact)


def most_likely(
    who: Oracle, noise: NoiseModel, greys: int, grey: np.ndarray, level: np.ndarray, filled: np.ndarray, limit: Bound
) -> np.ndarray:
    """The change of the motion ``(3,)`` that a frame is most likely with: its law has corners, so no gradients are used."""
    use = np.flatnonzero(who.jacobian.any(axis=(1, 2)))
    y, level, filled, jacobian = grey[use].astype(int), level[use], filled[use], who.jacobian[use]
    edges = (np.arange(greys + 2) - 0.5) / greys
    edges[[0, 1, -1]] = -np.inf, 0, np.inf
    empty = noise.grey_of_empty(greys)[y]
    whitened = np.linalg.cholesky(limit.covariance())

    def unlikely(place: np.ndarray) -> float:
        motion = whitened @ place
        mean, c = level + jacobian[:, 0] @ motion, np.clip(filled + jacobian[:, 1] @ motion, 0, 1)
        echo = np.divide(mean, c, out=np.zeros_like(mean), where=c > 0)
        above = [np.exp(-np.square(np.maximum(edges[y + k] - echo, 0) / noise.scale) / 2) for k in (0, 1)]
        p = c * (above[0] - above[1]) + (1 - c) * empty
        return -float(np.log(np.maximum(p, 1e-12)).sum())

    tries = [np.zeros(3), *(2 * np.eye(3)), *(-2 * np.eye(3))]
    start = min(tries, key=unlikely)
    corners = np.vstack([start, start + 0.7 * np.eye(3)])
    words = {"xatol": 0.02, "fatol": 0.02, "initial_simplex": corners}
    return np.asarray(whitened @ optimize.minimize(unlikely, start, method="Nelder-Mead", options=words).x)


@pytest.mark.thorough
@pytest.mark.usefixtures("variant")
def test_an_oracle_reaches_the_bound_of_gaussian_noise() -> None:
    value = gaussian_oracle(oracle(24, 96, 6), 40)
    assert reaches(value, 40), value


@pytest.mark.usefixtures("variant")
@pytest.mark.slow
def test_an_oracle_reaches_the_bound_of_the_pixel_law() -> None:
    """Least squares reaches the matched bound; the exact one takes the likelihood."""
    who = oracle(24, 96, 6)
    squares, as_exact, best = pixel_oracle(who, 40, HIGH, 15)
    assert reaches(squares, 40), squares
    assert reaches(best, 40), best
    assert best < 0.8 * as_exact


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(("noise", "greys", "excess"), [(LOW, 51, 0.05), (HIGH, 51, 0.05), (HIGH, 255, 0.4)])
def test_more_pixels_reach_the_bound_of_finer_grey_values(noise: NoiseModel, greys: int, excess: float) -> None:
    """Fine grey values show the corner of the law, which pixels use in full only once levels are known far better than they
    step, by 16,000 pixels not quite: what is left over is stated."""
    who = oracle(64, 256, 32)
    value = gaussian_oracle(who, 100)
    assert reaches(value, 100), value
    squares, _, best = pixel_oracle(who, 100, noise, greys)
    assert reaches(squares, 100), squares
    assert reaches(best, 100, excess), best


# ---------------------------------------------------------------- views, data sets, the command


@pytest.mark.usefixtures("variant")
@pytest.mark.thorough
def test_segments_and_their_sums() -> None:
    """Four quadrants of a looking-down sonar: information adds up, and pixels tell no less than their sums."""
    from mitsonar.instruments.views import Segment
    from mitsonar.simulation.derivatives import differentiate
    from mitsonar.simulation.simulator import Simulator

    sonar = Sonar(
        azimuth_fov_deg=100, elevation_fov_deg=100, beams=40, rays_per_beam=80, range_bins=64, range_min=2, range_max=4.5
    )
    names = ["q1", "q2", "q3", "q4"]
    built = scene(floor=floor(diffuse({"type": "cell_noise", "cells": 100}), 10))
    source = Simulator(built, sonar, views=[Segment(sonar, name) for name in names])
    pose = Pose.from_degrees([0, 0, 2.5, 90, 0, -90])
    gain = 0.5 / float(next(source.pings([pose])).levels.max())
    result = bounds_of_views(names, next(differentiate(source, pose, gain, pings=24)), LOW)
    assert {key[0] for key in result} == {"all views", *names}
    for kind in ("image", "vector"):
        whole = result["all views", kind, "pixel"]
        parts = [result[name, kind, "pixel"] for name in names]
        assert whole is not None
        known = [part.information for part in parts if part is not None]
        assert len(known) == len(parts)
        np.testing.assert_allclose(whole.information, sum(known, np.zeros((3, 3))))
        assert np.isfinite(whole.std()).all()
    overlapping = Simulator(built, sonar, views=[Segment(sonar, name) for name in ("whole", "q1")])
    with pytest.raises(MitsonarError, match="name one of whole, q1"):
        cramer_rao_bound(overlapping, pose, LOW, gain, pings=2)
    images, vectors = (result["all views", kind, "gaussian"] for kind in ("image", "vector"))
    assert (images.std() < 0.6 * vectors.std()).all()  # type: ignore[union-attr]
    whole = result["all views", "vector", "pixel"]
    assert whole is not None
    assert (cramer_rao_bound(source, pose, LOW, gain, kind="vector", pings=24)[0] == whole.std(2)).all()


SCENE = floor_scene('<texture type="cell_noise" name="reflectance"><integer name="cells" value="2000"/></texture>')


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_the_command_answers_the_buyer(tmp_path: Path) -> None:
    """Twice the height: cells twice as far apart, larger errors; no noise: no exact bound, and words that say so."""
    path = tmp_path / "floor.xml"
    path.write_text(SCENE)
    picture = tmp_path / "limit.png"
    code, text = command(
        path, "--vary", "height_m=2.5,5", "--to", "1,0,2.5,35,0,0", "--poses", 2, "--plot", picture, "--json"
    )
    assert code == 0, text
    rows = json.loads(text[text.index("{") : text.rindex("}") + 1])["rows"]
    exact = {row["height_m"]: row["two_frames"] for row in rows if (row["data"], row["law"]) == ("image", "pixel")}
    assert exact[5][1] > exact[2.5][1] > 0
    assert picture.stat().st_size > 10_000
    code, text = command(path, "--noise", "none")
    assert code == 0, text
    assert "image    image   pixel     -" in text
    assert "without limit" in text
    for words, output in (
        (["--vary", "heigth=1"], "height_m"),
        (["--vary", "window=3"], "3.2..5.6"),
        (["--from", "0,0,2.5,2,0,0", "--vary", "pitch_deg=3"], "horizon"),
        (["--noise", "loud"], "none, low, high"),
    ):
        code, text = command(path, *words)
        assert code == 2
        assert output in text, text


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    ("words", "output"),
    [
        (["--gain", "-1"], "--gain must be above 0 and finite: got -1"),
        (["--gain", "nan"], "--gain must be above 0 and finite: got nan"),
        (["--poses", "0"], "--poses must be at least 1: got 0"),
        (["--to", "1,0,2.5,35,0,0"], "--to needs --poses T, 2 or more: how many poses lie between"),
    ],
)
def test_the_command_refuses_what_it_cannot_compute(tmp_path: Path, words: list[str], output: str) -> None:
    path = tmp_path / "floor.xml"
    path.write_text(SCENE)
    code, text = command(path, *words)
    assert code == 2
    assert output in " ".join(text.split())


@pytest.mark.usefixtures("variant")
@pytest.mark.slow
def test_the_command_reads_data_sets(tmp_path: Path) -> None:
    from helpers import tiny_recipe

    from mitsonar.datasets.make import SceneRenderer, make_dataset
    from mitsonar.datasets.store import DataStore

    url = tmp_path / "tiny.zarr"
    make_dataset(tiny_recipe(sonar__model="physical", sonar__beams=24, world__a_side=[12, 12]), str(url), sequences=3)
    code, text = command(url, "--pairs", 3, "--part", "all", "--noise", "low", "--json")
    assert code == 0, text
    rows = json.loads(text[text.index("{") : text.rindex("}") + 1])["rows"]
    (exact,) = [row["two_frames_each"] for row in rows if (row["data"], row["law"]) == ("image", "pixel")]
    store = DataStore.open(str(url))
    renderer = SceneRenderer(store.recipe, store.scenes[0])
    expected = cramer_rao_bound(renderer.simulator, store.read("pose")[:1], LOW, float(store.about["gain"]))[0]
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(exact[0], expected * [1e3, 1e3, np.degrees(1)], rtol=1e-5)
    code, text = command(url, "--sonar", "didson300")
    assert code == 2
    assert "data set" in text
