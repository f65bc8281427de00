"""Add pixel noise to sonar images (Almanza-Medina, 2.2.3), reproducibly in NumPy and torch.

The noise is a function of (seed, frame, cell). The echo is clipped to [0, 1]. Pixels without an echo become Gaussian; the
others have a Rayleigh value added. The sum is clipped. The model is retained as published, to reproduce its tables. Its
distribution depends on whether a pixel contains an echo, so the noise itself outlines the shadows.
"""

from __future__ import annotations

import math
import re
from typing import ClassVar, NamedTuple

import numpy as np
from array_api_compat import array_namespace, device
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, ValidationError
from scipy.special import ndtr

from mitsonar.arrays import AnyArray
from mitsonar.errors import MitsonarError, did_you_mean, short_repr, validation_message
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.checked_model import CheckedModel
from mitsonar.io.files import read_yaml

__all__ = [
    "NOISE_MODELS",
    "Information",
    "NoiseModel",
    "expected_values",
    "format_snr",
    "information",
    "information_of_sums",
    "load_noise",
    "parse_snr",
    "refuse_noise",
    "uniform",
]


MASK = 0xFFFFFFFF


class NoiseModel(CheckedModel):
    """Gaussian noise of empty pixels and Rayleigh noise of the others, in fractions of the largest pixel value.

    This is the noise of the ``thesis`` model, and not a model of a real sonar. A real receiver adds noise of the same
    distribution to every pixel, with or without an echo. Here the distribution changes at the border of every shadow, so a
    network or an estimator can read the exact mask of empty pixels from the noise. Results with it say little about real
    images.
    """

    called: ClassVar[str] = "noise"

    mean: float = Field(0.0, ge=0, le=1, description="mean of the Gaussian of empty pixels")
    std: float = Field(0.0, ge=0, le=1, description="its standard deviation")
    scale: float = Field(0.0, ge=0, le=1, description="scale of the Rayleigh value added to echoes")

    @property
    def is_none(self) -> bool:
        """Return whether the model adds no noise."""
        return self.mean == self.std == self.scale == 0

    def apply(self, image: AnyArray, *, seed: int, frames: AnyArray) -> AnyArray:
        """Add noise to images; return float32 in 0..1.

        Args:
            image: ``(frames, bins, beams)`` in 0..1, NumPy or torch.
            seed: seed of the noise.
            frames: number of each frame ``(frames,)``, an integer array of the same library.
        """
        xp = array_namespace(image)
        if self.is_none:
            return xp.clip(image, 0.0, 1.0)
        if image.shape[0] > 1 and str(device(image)) == "cpu":  # one frame at a time fits the cache
            by_frame = [
                self.apply(image[k : k + 1, ...], seed=seed, frames=frames[k : k + 1]) for k in range(image.shape[0])
            ]
            return xp.concat(by_frame, axis=0)
        first, second = uniform(image.shape, seed=seed, frames=frames, like=image)
        # Box-Muller: the radius is also a Rayleigh variable, used for the echoes.
        radius = xp.sqrt(-2.0 * xp.log(first))
        gaussian = self.mean + self.std * radius * xp.cos(2.0 * math.pi * second)
        echo = xp.clip(xp.astype(image, xp.float64), 0.0, 1.0)
        noisy = xp.where(echo > 0, echo + self.scale * radius, gaussian)
        # rounding to 2^-30 hides the last bits of log and cos, in which libraries differ
        noisy = xp.round(xp.clip(noisy, 0.0, 1.0) * 2.0**30) * 2.0**-30
        return xp.astype(noisy, xp.float32)

    def apply_sum(self, vector: AnyArray, nonzero: AnyArray, cells: int, *, seed: int, frames: AnyArray) -> AnyArray:
        """Add Gaussian noise with the correct mean and variance to sums over the beams; return float32.

        The pixel noise of :meth:`apply`, summed over a row of the image, has the same mean and variance, provided that
        echoes do not reach 1, where they would be clipped.

        Args:
            vector: sums of images in 0..1 ``(frames, bins)``, NumPy or torch.
            nonzero: number of pixels with an echo in each row, like ``vector``.
            cells: number of pixels per row.
            seed: seed of the noise.
            frames: number of each frame ``(frames,)``, an integer array of the same library.
        """
        xp = array_namespace(vector)
        if self.is_none:
            return xp.astype(vector, xp.float32)
        first, second = uniform((*vector.shape, 1), seed=seed, frames=frames, like=vector)
        gaussian = xp.sqrt(-2.0 * xp.log(first[..., 0])) * xp.cos(2.0 * math.pi * second[..., 0])
        echoes = xp.astype(nonzero, xp.float64)
        empty_mean, empty_variance = _clipped_gaussian(self.mean, self.std)
        echo_mean, echo_variance = math.sqrt(math.pi / 2) * self.scale, (2 - math.pi / 2) * self.scale**2
        mean = echoes * echo_mean + (cells - echoes) * empty_mean
        std = xp.sqrt(echoes * echo_variance + (cells - echoes) * empty_variance)
        noisy = xp.clip(xp.astype(vector, xp.float64) + mean + std * gaussian, 0.0, None)
        noisy = xp.round(noisy * 2.0**24) * 2.0**-24  # hides the last bits, in which libraries differ
        return xp.astype(noisy, xp.float32)

    def grey_of_empty(self, greys: int = 255) -> NDArray[np.float64]:
        """Compute the probability of each stored grey value 0..``greys`` of a pixel without an echo ``(greys + 1,)``."""
        edges = _grey_edges(greys)
        above = (self.mean > edges).astype(float) if self.std == 0 else ndtr((self.mean - edges) / self.std)
        return np.asarray(-np.diff(above, prepend=1.0, append=0.0), dtype=np.float64)

    def grey_of_echo(self, level: ArrayLike, greys: int = 255) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Compute the probability of each grey value of a pixel with an echo, and its derivative with respect to the echo.

        Args:
            level: the echo before noise, above 0 ``(...)``.
            greys: the largest grey value.

        Returns:
            Two arrays ``(..., greys + 1)``.

        Raises:
            MitsonarError: echoes have no noise, so their grey values have no derivative.
        """
        if self.scale == 0:
            raise MitsonarError("the distribution of an echo needs noise: got scale 0; give a scale above 0")
        over = (_grey_edges(greys) - np.asarray(level, dtype=float)[..., None]) / self.scale
        over = np.maximum(over, 0.0)
        above = np.ones((*over.shape[:-1], greys + 2))
        above[..., 1:-1] = np.exp(-over * over / 2)
        above[..., -1] = 0.0
        slope = np.zeros_like(above)
        slope[..., 1:-1] = above[..., 1:-1] * over / self.scale
        return above[..., :-1] - above[..., 1:], slope[..., :-1] - slope[..., 1:]


def _clipped_gaussian(mean: float, std: float) -> tuple[float, float]:
    """Compute the mean and variance of a Gaussian clipped to 0..1."""
    if std == 0:
        return mean, 0.0

    def density(x: float) -> float:
        return math.exp(-x * x / 2) / math.sqrt(2 * math.pi)

    def below(x: float) -> float:
        return math.erf(x / math.sqrt(2)) / 2 + 0.5

    low, high = -mean / std, (1 - mean) / std
    inside = below(high) - below(low)
    first = mean * inside + std * (density(low) - density(high)) + 1 - below(high)
    second = (mean**2 + std**2) * inside + std * (mean * density(low) - (1 + mean) * density(high)) + 1 - below(high)
    return first, second - first**2


NOISE_MODELS = {
    "none": NoiseModel(),
    "low": NoiseModel(mean=0.04, std=0.02, scale=0.04),
    "high": NoiseModel(mean=0.137, std=0.031, scale=0.137),
    "chapter2": NoiseModel(mean=0.137, std=0.031, scale=0.275),
}
"""Almanza-Medina's noise levels by name; ``chapter2`` is that of table 2.1."""


def uniform(shape: tuple[int, int, int], *, seed: int, frames: AnyArray, like: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Draw two independent uniform numbers in (0, 1) for each cell, float64, in the array library of ``like``.

    They are a hash of seed, frame and cell: two rounds of 32-bit mixing, in int64 where the library has no unsigned product.

    Args:
        shape: (frames, bins, beams).
        seed: seed of the noise.
        frames: number of each frame ``(frames,)``.
        like: an array that selects library and device.
    """
    xp = array_namespace(like)
    count, bins, beams = shape
    cell = xp.reshape(xp.arange(bins * beams, dtype=xp.int64, device=device(like)), (1, bins, beams))
    frame = xp.reshape(xp.astype(frames, xp.int64), (count, 1, 1))
    key = _mix(frame & MASK, _mix_int(seed & MASK) ^ _mix_int((seed >> 32) + 0x51ED270B))
    if xp is array_namespace(np.empty(0)):  # the same bits in a quarter of the time
        cell, key = (values.astype(np.uint32) for values in (cell, key))
    first = _mix(cell, key)
    second = _mix(first, key ^ 0x2545F491)
    one, other = ((xp.astype(value, xp.float64) + 0.5) * 2.0**-32 for value in (first, second))
    return one, other


def _multiply(value: AnyArray, factor: int) -> AnyArray:
    """Multiply modulo 2^32; int64 overflow wraps, which leaves the low bits correct."""
    return value * np.uint32(factor) if getattr(value, "dtype", None) == np.uint32 else (value * factor) & MASK


def _mix(value: AnyArray, key: AnyArray) -> AnyArray:
    """Hash with a key, using two rounds of Chris Wellons's 32-bit integer hash `lowbias32`."""
    for _ in range(2):
        value = value ^ key
        value = _multiply(value ^ (value >> 16), 0x7FEB352D)
        value = _multiply(value ^ (value >> 15), 0x846CA68B)
        value = value ^ (value >> 16)
        key = _multiply(key, 0x9E3779B1)
    return value


def _mix_int(value: int) -> int:
    return int(_mix(value & MASK, 0x68BC21EB))


def _grey_edges(greys: int) -> NDArray[np.float64]:
    """Return the lower bounds of grey values 1, 2 ... ``greys``; any value above zero is at least grey 1."""
    edges = (np.arange(1, greys + 1) - 0.5) / greys
    edges[0] = 0.0
    return edges


def refuse_noise(noise: NoiseModel | None, sonar: Sonar) -> None:
    """Check that pixel noise is not combined with a sonar model that adds its own noise.

    Raises:
        MitsonarError: pixel noise with the ``coherent`` model.
    """
    if noise is not None and not noise.is_none and sonar.model == "coherent":
        raise MitsonarError(
            "the model coherent adds its own noise: got pixel noise; omit noise and give the sonar "
            "noise_level_db, such as --set noise_level_db=60"
        )


class Information(NamedTuple):
    """Information that noisy values carry about the mean echo of a pixel and the probability that it contains one.

    Attributes:
        law: Fisher information of the exact distribution ``(..., 2, 2)``, in 1 / (fraction of the maximum)^2. None if echoes
            have no noise, where the information is unbounded.
        slope: derivative of the mean of the value by the two parameters ``(..., 2)``.
        variance: variance of the value ``(...)``.
    """

    law: NDArray[np.float64] | None
    slope: NDArray[np.float64]
    variance: NDArray[np.float64]

    def matched(self, more: ArrayLike = 0.0) -> NDArray[np.float64]:
        """Compute the information of a Gaussian with this mean and variance ``(..., 2, 2)``.

        This is the information that least squares can use. It never exceeds ``law``.

        Args:
            more: variance to add ``(...)``.
        """
        variance = self.variance + np.asarray(more, dtype=float)
        return np.asarray(self.slope[..., :, None] * self.slope[..., None, :] / variance[..., None, None])


CHUNK = 2048
"""Number of pixels whose distributions are held in memory at a time: 4 MB per array."""


def information(noise: NoiseModel, level: ArrayLike, filled: ArrayLike = 1.0, *, greys: int = 255) -> Information:
    """Compute the Fisher information of noisy, clipped pixels, stored as grey values 0..``greys``.

    The noise is that of Almanza-Medina, 2.2.3; the distribution is derived here. A pixel holds an echo ``level / filled``
    with probability ``filled``, and otherwise none: where the edge of a shadow crosses a pixel, only some of the pings fill
    it. Let p_e and p_0 be the distributions of a pixel with and without an echo. The distribution of the pixel is p = filled
    p_e + (1 - filled) p_0. The information is the sum over grey values of g g' / p, with g the derivatives of p.

    The information of an added Rayleigh value alone grows with the logarithm of ``greys``: its density starts with a corner,
    which fine grey values resolve.

    If echoes have no noise (scale 0), ``law`` is None, and ``variance`` includes the variance of rounding, 1 / (12 greys^2).

    Args:
        noise: noise of the pixels.
        level: mean echo, 0..1, over pings that fill the pixel and pings that do not ``(...)``.
        filled: fraction of the pings that fill the pixel, 0..1 ``(...)``.
        greys: the largest grey value.
    """
    level, filled = np.broadcast_arrays(np.asarray(level, dtype=float), np.asarray(filled, dtype=float))
    shape, level, filled = level.shape, level.ravel(), filled.ravel()
    echo = np.divide(level, filled, out=np.zeros_like(level), where=filled > 0)
    if noise.scale == 0:
        slope, variance = _noiseless(noise, echo, filled, greys)
        return Information(None, slope.reshape(*shape, 2), variance.reshape(shape))
    parts = [_exact(noise, echo[k : k + CHUNK], filled[k : k + CHUNK], greys) for k in range(0, max(len(level), 1), CHUNK)]
    law, slope, variance = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Information(law.reshape(*shape, 2, 2), slope.reshape(*shape, 2), variance.reshape(shape))


def expected_values(
    noise: NoiseModel, level: ArrayLike, filled: ArrayLike = 1.0, *, greys: int = 255
) -> NDArray[np.float64]:
    """Compute the mean of noisy, clipped pixels ``(...)``, stored as grey values; the arguments are as for `information`."""
    level, filled = np.broadcast_arrays(np.asarray(level, dtype=float), np.asarray(filled, dtype=float))
    shape, level, filled = level.shape, level.ravel(), filled.ravel()
    echo = np.divide(level, filled, out=np.zeros_like(level), where=filled > 0)
    if noise.scale == 0:
        empty, _ = _clipped_gaussian(noise.mean, noise.std)
        return np.asarray(filled * np.minimum(echo, 1.0) + (1 - filled) * empty).reshape(shape)
    value, mean = np.arange(greys + 1) / greys, np.zeros(len(level))
    empty = float(noise.grey_of_empty(greys) @ value)
    for k in range(0, len(level), CHUNK):
        part = slice(k, k + CHUNK)
        mean[part] = filled[part] * (noise.grey_of_echo(echo[part], greys)[0] @ value) + (1 - filled[part]) * empty
    return mean.reshape(shape)


def _exact(
    noise: NoiseModel, echo: NDArray[np.float64], filled: NDArray[np.float64], greys: int
) -> tuple[NDArray[np.float64], ...]:
    """Compute information, slope and variance of a chunk of pixels."""
    empty = noise.grey_of_empty(greys)
    p_echo, by_echo = noise.grey_of_echo(echo, greys)
    # Mixture of the distributions with and without an echo.
    c = filled[:, None]
    p = c * p_echo + (1 - c) * empty
    by_level, by_filled = by_echo, p_echo - empty - echo[:, None] * by_echo  # the echo is level / filled
    # Derivatives of p by both parameters, divided by p where it is not zero.
    g = np.stack([by_level, by_filled], axis=1)
    weighted = np.divide(g, p[:, None], out=np.zeros_like(g), where=p[:, None] > 0)
    value = np.arange(greys + 1) / greys
    mean = p @ value
    return weighted @ g.transpose(0, 2, 1), g @ value, np.maximum(p @ value**2 - mean**2, 1e-300)


def _noiseless(
    noise: NoiseModel, echo: NDArray[np.float64], filled: NDArray[np.float64], greys: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute slope and variance if echoes are only rounded."""
    mean, variance = _clipped_gaussian(noise.mean, noise.std)
    slope = np.stack([(echo < 1).astype(float), np.full_like(echo, -mean)], axis=-1)
    spread = filled * (1 - filled) * (echo - mean) ** 2 + (1 - filled) * variance
    return slope, spread + 1 / (12 * greys**2)


def information_of_sums(noise: NoiseModel, nonzero: ArrayLike, cells: int) -> Information:
    """Compute the Fisher information of noisy sums over the beams (:meth:`NoiseModel.apply_sum`).

    The two parameters are the sum of the echoes and the number of pixels that contain one. Sums are not rounded.

    Args:
        noise: noise of the pixels.
        nonzero: number of pixels with an echo in each row ``(...)``.
        cells: number of pixels per row.
    """
    nonzero = np.asarray(nonzero, dtype=float)
    empty_mean, empty_variance = _clipped_gaussian(noise.mean, noise.std)
    echo_mean, echo_variance = math.sqrt(math.pi / 2) * noise.scale, (2 - math.pi / 2) * noise.scale**2
    slope = np.broadcast_to(np.array([1.0, echo_mean - empty_mean]), (*nonzero.shape, 2))
    variance = nonzero * echo_variance + (cells - nonzero) * empty_variance
    if noise.scale == 0:
        return Information(None, slope, variance)
    by_filled = np.diag([0.0, echo_variance - empty_variance])
    of_variance = (by_filled @ by_filled) / (2 * variance**2)[..., None, None]
    return Information(slope[..., :, None] * slope[..., None, :] / variance[..., None, None] + of_variance, slope, variance)


def load_noise(text: str) -> NoiseModel:
    """Load a noise model: ``none``, ``low``, ``high``, ``chapter2``, ``mean,std,scale``, or a YAML file with these keys.

    Raises:
        MitsonarError: none of these, or a number outside 0..1.
    """
    if text in NOISE_MODELS:
        return NOISE_MODELS[text]
    try:
        if text.lower().endswith((".yaml", ".yml")):
            fields = read_yaml(text, "noise file")
            if not (isinstance(fields, dict) and all(isinstance(key, str) for key in fields)):
                raise MitsonarError(f"{text} must hold the keys mean, std, scale, each 0..1")
            return NoiseModel.model_validate(fields)
        mean, std, scale = (float(word) for word in text.split(","))
        return NoiseModel.model_validate({"mean": mean, "std": std, "scale": scale})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise MitsonarError(validation_message(error, NoiseModel, "noise")) from None
        raise MitsonarError(
            f"noise {key} must be a fraction 0..1 of the maximum: got {short_repr(first['input'])}"
        ) from None
    except (ValueError, TypeError) as error:
        if isinstance(error, MitsonarError):
            raise
        raise MitsonarError(
            f"noise must be {', '.join(NOISE_MODELS)}, three fractions mean,std,scale, or a YAML file: "
            f"got {short_repr(text)}{did_you_mean(text, NOISE_MODELS)}"
        ) from None


# ---------------- Signal-to-noise ratios in recipes and commands


def parse_snr(text: str) -> float | None:
    """Parse a signal-to-noise ratio in dB, such as ``20 dB``; ``none`` means no noise.

    Raises:
        MitsonarError: any other text.
    """
    match = re.fullmatch(r"\s*([+-]?\d+(?:\.\d+)?)\s*dB\s*", text)
    if text != "none" and not match:
        raise MitsonarError(
            f"noise of impulse responses is a signal to noise ratio such as '20 dB', or none: got {short_repr(text)}"
        )
    return float(match[1]) if match else None


def format_snr(snr_db: float | None) -> str:
    """Format a signal-to-noise ratio [dB] in the form that :func:`parse_snr` parses."""
    return "none" if snr_db is None else f"{snr_db:g} dB"
