"""Noise: its distributions by statistics, its numbers a function of (seed, frame, cell), the same in NumPy and torch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from mitsonar.acoustics.noise import NOISE_MODELS, NoiseModel, load_noise, uniform
from mitsonar.errors import MitsonarError

HIGH = NOISE_MODELS["high"]
SHAPE = (8, 128, 96)
"""Frames, bins, beams: 98,304 numbers; at z < 4.5 a right distribution fails once in 150,000 runs, and the seed is fixed."""

Z = 4.5


def noisy(image: np.ndarray, model: NoiseModel = HIGH, seed: int = 11, first: int = 0) -> np.ndarray:
    return np.asarray(model.apply(image, seed=seed, frames=np.arange(first, first + len(image))))


def assert_mean(values: np.ndarray, mean: float, std: float) -> None:
    """z-test of a mean."""
    z = (values.mean(dtype=float) - mean) / (std / np.sqrt(values.size))
    assert abs(z) < Z, f"mean {values.mean():.6f}, expected {mean:.6f}: z = {z:.1f}"


def test_levels_of_the_reference() -> None:
    """Almanza-Medina's low, high and chapter 2 levels of (m, s, g)."""
    levels = {name: (model.mean, model.std, model.scale) for name, model in NOISE_MODELS.items()}
    assert levels == {
        "none": (0, 0, 0),
        "low": (0.04, 0.02, 0.04),
        "high": (0.137, 0.031, 0.137),
        "chapter2": (0.137, 0.031, 0.275),
    }


def test_empty_pixels_become_gaussian() -> None:
    """High noise: clipping at 0 lies 4.4 standard deviations away and does not show."""
    values = noisy(np.zeros(SHAPE, np.float32)).ravel().astype(float)
    assert_mean(values, HIGH.mean, HIGH.std)
    z = (values.std() / HIGH.std - 1) * np.sqrt(2 * values.size)
    assert abs(z) < Z, f"standard deviation {values.std():.6f}, expected {HIGH.std}: z = {z:.1f}"
    assert stats.kstest(values, stats.norm(HIGH.mean, HIGH.std).cdf).pvalue > 1e-4


def test_echoes_get_an_added_rayleigh_value() -> None:
    values = noisy(np.full(SHAPE, 0.1, np.float32)).ravel() - np.float64(np.float32(0.1))
    rayleigh = stats.rayleigh(scale=HIGH.scale)
    assert values.min() > 0  # only ever added
    assert_mean(values, HIGH.scale * np.sqrt(np.pi / 2), rayleigh.std())
    assert stats.kstest(values, rayleigh.cdf).pvalue > 1e-4


def test_one_model_does_both_by_what_the_pixel_holds() -> None:
    image = np.zeros(SHAPE, np.float32)
    image[:, ::2] = 0.2
    mixed = noisy(image)
    np.testing.assert_array_equal(mixed[:, ::2], noisy(np.full(SHAPE, 0.2, np.float32))[:, ::2])
    np.testing.assert_array_equal(mixed[:, 1::2], noisy(np.zeros(SHAPE, np.float32))[:, 1::2])
    faint = noisy(np.full(SHAPE, 1e-12, np.float32), NoiseModel(mean=0.9, scale=0.01))
    assert faint.max() < 0.1  # an echo, however faint, is not an empty pixel


def test_clipped_before_and_after() -> None:
    quiet = NoiseModel(mean=0.5, std=0.01, scale=1e-6)
    before = noisy(np.array([[[3.0, -2.0]]], np.float32), quiet)  # clipped to 1 and to 0: the second is empty then
    assert before[0, 0, 0] == 1
    assert 0.4 < before[0, 0, 1] < 0.6
    after = noisy(np.full(SHAPE, 0.9, np.float32), NOISE_MODELS["chapter2"])
    assert after.max() == 1
    assert (after == 1).mean() > 0.5
    low = noisy(np.zeros(SHAPE, np.float32), NOISE_MODELS["low"])
    assert low.min() == 0
    share = stats.norm.cdf(-2)  # mean / std = 2
    z = ((low == 0).mean() - share) / np.sqrt(share * (1 - share) / low.size)
    assert abs(z) < Z


def test_result_is_float32_and_no_noise_only_clips() -> None:
    image = np.array([[[0.3, 1.4, 0.0]]], np.float32)
    assert noisy(image).dtype == np.float32
    np.testing.assert_array_equal(noisy(image, NOISE_MODELS["none"]), np.array([[[0.3, 1, 0]]], np.float32))
    assert NOISE_MODELS["none"].is_none
    assert not NoiseModel(scale=0.1).is_none


# ---------------------------------------------------------------- random numbers


def test_a_function_of_seed_frame_and_cell_only() -> None:
    image = np.random.default_rng(0).random((6, 20, 10), dtype=np.float32) * (np.arange(20) % 3 > 0)[:, None]
    whole = noisy(image, first=40)
    for split in (1, 2, 5):
        parts = [noisy(image[k : k + split], first=40 + k) for k in range(0, 6, split)]
        np.testing.assert_array_equal(np.concatenate(parts), whole)
    order = np.array([3, 0, 5, 1, 4, 2])
    np.testing.assert_array_equal(HIGH.apply(image[order], seed=11, frames=40 + order), whole[order])
    np.testing.assert_array_equal(noisy(image.astype(np.float64), first=40), whole)


def draw(seed: int, frames: np.ndarray, bins: int = 128, beams: int = 96) -> tuple[np.ndarray, np.ndarray]:
    return uniform((len(frames), bins, beams), seed=seed, frames=frames, like=np.zeros(1))


@pytest.mark.parametrize("which", [0, 1])
def test_numbers_are_uniform(which: int) -> None:
    values = draw(5, np.arange(8))[which].ravel()
    assert 0 < values.min() < 1e-4
    assert 1 - 1e-4 < values.max() < 1
    counts = np.bincount((values * 256).astype(int), minlength=256)
    assert stats.chisquare(counts).pvalue > 1e-4
    assert_mean(values, 0.5, np.sqrt(1 / 12))


def test_numbers_do_not_depend_on_each_other() -> None:
    """Both numbers of a cell, neighbouring cells, frames and seeds: correlations within 4.5 / sqrt(N)."""
    first, second = draw(5, np.arange(8))
    far = draw(5 + 2**40, np.arange(8))[0]
    late = draw(5, np.arange(8) + 2**20)[0]
    pairs = {
        "the two of a cell": (first, second),
        "bins": (first[:, 1:], first[:, :-1]),
        "beams": (first[..., 1:], first[..., :-1]),
        "frames": (first[1:], first[:-1]),
        "seeds": (first, draw(6, np.arange(8))[0]),
        "seeds above 32 bits": (first, far),
        "late frames": (first, late),
        "frame against seed": (draw(6, np.array([5]))[0], draw(5, np.array([6]))[0]),
    }
    for name, (a, b) in pairs.items():
        r = np.corrcoef(a.ravel(), b.ravel())[0, 1]
        assert abs(r) * np.sqrt(a.size) < Z, f"{name}: correlation {r:.4f}"


def test_pairs_fill_the_square() -> None:
    """Chi-square of (first, second) on 32 x 32 fields: what the Gaussian is made from."""
    first, second = (values.ravel() for values in draw(1, np.arange(8)))
    counts = np.bincount((first * 32).astype(int) * 32 + (second * 32).astype(int), minlength=1024)
    assert stats.chisquare(counts).pvalue > 1e-4


@pytest.mark.learn
@pytest.mark.parametrize("name", ["none", "low", "high", "chapter2"])
def test_torch_draws_the_same(name: str) -> None:
    import torch

    rng = np.random.default_rng(7)
    image = rng.random((4, 64, 48), dtype=np.float32) * (rng.random((4, 64, 48)) > 0.3)
    image = image.astype(np.float32)
    expected = NOISE_MODELS[name].apply(image, seed=2**45 + 3, frames=np.array([0, 7, 8, 2**20]))
    got = NOISE_MODELS[name].apply(torch.from_numpy(image), seed=2**45 + 3, frames=torch.tensor([0, 7, 8, 2**20]))
    assert isinstance(got, torch.Tensor)
    assert got.dtype == torch.float32
    np.testing.assert_array_equal(got.numpy(), expected)


# ---------------------------------------------------------------- sums over the beams


@pytest.mark.parametrize("name", ["low", "high"])
@pytest.mark.parametrize("echoes", [0, 24, 96])
def test_sums_have_the_mean_and_variance_of_summed_pixels(name: str, echoes: int) -> None:
    """Two routes to one distribution: noise drawn for the sum, and drawn for 96 pixels and added up."""
    model = NOISE_MODELS[name]
    image = np.zeros((16, 512, 96), np.float32)
    image[..., :echoes] = 0.05
    vector, nonzero = image.sum(axis=-1), np.full((16, 512), echoes)
    order = np.arange(16)
    added = model.apply(image, seed=3, frames=order).sum(axis=-1, dtype=float).ravel()
    drawn = model.apply_sum(vector, nonzero, 96, seed=8, frames=order).ravel().astype(float)
    z = (drawn.mean() - added.mean()) / np.hypot(drawn.std(), added.std()) * np.sqrt(drawn.size)
    assert abs(z) < Z, f"means {drawn.mean():.5f} and {added.mean():.5f}: z = {z:.1f}"
    z = np.log(drawn.std() / added.std()) * np.sqrt(drawn.size)
    assert abs(z) < Z, f"standard deviations {drawn.std():.5f} and {added.std():.5f}: z = {z:.1f}"
    assert drawn.min() >= 0


@pytest.mark.learn
def test_torch_draws_the_same_sums() -> None:
    import torch

    rng = np.random.default_rng(7)
    vector, nonzero, order = rng.random((4, 64), dtype=np.float32) * 20, rng.integers(0, 97, (4, 64)), np.arange(4)
    expected = HIGH.apply_sum(vector, nonzero, 96, seed=5, frames=order)
    got = HIGH.apply_sum(torch.from_numpy(vector), torch.from_numpy(nonzero), 96, seed=5, frames=torch.from_numpy(order))
    np.testing.assert_array_equal(got.numpy(), expected)
    assert expected.dtype == np.float32
    np.testing.assert_array_equal(NOISE_MODELS["none"].apply_sum(vector, nonzero, 96, seed=5, frames=order), vector)


# ---------------------------------------------------------------- from text


def test_load_noise(tmp_path: Path) -> None:
    assert load_noise("high") is HIGH
    assert load_noise("0.1,0.02,0.3") == NoiseModel(mean=0.1, std=0.02, scale=0.3)
    (tmp_path / "mine.yaml").write_text("mean: 0.1\nscale: 0.3\n")
    assert load_noise(str(tmp_path / "mine.yaml")) == NoiseModel(mean=0.1, scale=0.3)


@pytest.mark.parametrize("text", ["hihg", "0.1,0.2", "0.1,0.2,0.3,0.4", "a,b,c", ""])
def test_text_that_is_no_noise(text: str) -> None:
    with pytest.raises(MitsonarError, match=rf"noise must be none, low, high, chapter2.* got '{text}'"):
        load_noise(text)


@pytest.mark.parametrize("text", ["0.1,1.2,0.3", "-0.1,0,0", "nan,0,0"])
def test_fractions_outside_their_limits(text: str) -> None:
    with pytest.raises(MitsonarError, match=r"noise (mean|std) must be a fraction 0\.\.1"):
        load_noise(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scale: 2\n", "noise scale must be a fraction .* got 2"),
        ("skale: 0.1\n", "unknown noise key skale: did you mean scale"),
        ("- 1\n", "must hold the keys mean, std, scale"),
        ("", "must hold the keys mean, std, scale"),
        ("mean: [1", "is not YAML"),
        ("mean: {}\n", "noise mean must be a fraction"),
        ("1: 0.5\n", "noise"),
    ],
)
def test_bad_noise_files(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "noise.yaml").write_text(text)
    with pytest.raises(MitsonarError, match=message):
        load_noise(str(tmp_path / "noise.yaml"))


def test_noise_file_that_is_absent(tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match=r"cannot read noise file .*absent\.yml: No such file"):
        load_noise(str(tmp_path / "absent.yml"))
