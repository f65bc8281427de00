"""Noise of sonar images (Almanza-Medina, 2.2.3): a function of (seed, frame, cell), the same in NumPy and torch.

Echo is clipped to [0, 1]; pixels without echo become Gaussian, others get an added Rayleigh value; clipped again.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import yaml
from array_api_compat import array_namespace, device
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mitsonar.errors import MitsonarError, nearest_names

__all__ = ["NOISE_MODELS", "NoiseModel", "load_noise", "uniform"]

MASK = 0xFFFFFFFF


class NoiseModel(BaseModel):
    """Gaussian of the empty pixels and Rayleigh of the others, in fractions of the largest pixel value."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    mean: float = Field(0.0, ge=0, le=1, description="mean of the Gaussian of empty pixels")
    std: float = Field(0.0, ge=0, le=1, description="its standard deviation")
    scale: float = Field(0.0, ge=0, le=1, description="scale of the Rayleigh value added to echoes")

    @property
    def is_none(self) -> bool:
        """Whether frames stay as they are."""
        return self.mean == self.std == self.scale == 0

    def apply(self, image: Any, *, seed: int, frames: Any) -> Any:
        """Noisy images, float32 in 0..1.

        Args:
            image: ``(frames, bins, beams)`` in 0..1, NumPy or torch.
            seed: seed of the noise.
            frames: number of each frame ``(frames,)``, an integer array of the same kind.
        """
        xp = array_namespace(image)
        if self.is_none:
            return xp.clip(image, 0.0, 1.0)
        if image.shape[0] > 1 and str(device(image)) == "cpu":  # what one frame needs stays in the cache
            one = [self.apply(image[k : k + 1, ...], seed=seed, frames=frames[k : k + 1]) for k in range(image.shape[0])]
            return xp.concat(one, axis=0)
        first, second = uniform(image.shape, seed=seed, frames=frames, like=image)
        radius = xp.sqrt(-2.0 * xp.log(first))
        gaussian = self.mean + self.std * radius * xp.cos(2.0 * math.pi * second)
        echo = xp.clip(xp.astype(image, xp.float64), 0.0, 1.0)
        noisy = xp.where(echo > 0, echo + self.scale * radius, gaussian)
        # libraries differ in the last bit of log and cos: a grid of 2^-30 far above it hides that
        noisy = xp.round(xp.clip(noisy, 0.0, 1.0) * 2.0**30) * 2.0**-30
        return xp.astype(noisy, xp.float32)

    def apply_sum(self, vector: Any, nonzero: Any, cells: int, *, seed: int, frames: Any) -> Any:
        """Noisy sums over the beams, drawn from the law of the sum (its mean and variance, as a Gaussian), float32.

        The noise of single pixels, :meth:`apply`, summed over a row of the image, has the same mean and variance as long as
        echoes do not reach 1, where they would be clipped.

        Args:
            vector: sums of images in 0..1 ``(frames, bins)``, NumPy or torch.
            nonzero: how many pixels of each row hold an echo, like ``vector``.
            cells: pixels of a row.
            seed: seed of the noise.
            frames: number of each frame ``(frames,)``, an integer array of the same kind.
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
        noisy = xp.round(noisy * 2.0**24) * 2.0**-24  # hides the last bits in which libraries differ
        return xp.astype(noisy, xp.float32)


def _clipped_gaussian(mean: float, std: float) -> tuple[float, float]:
    """Mean and variance of a Gaussian clipped to 0..1."""
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


def uniform(shape: tuple[int, int, int], *, seed: int, frames: Any, like: Any) -> tuple[Any, Any]:
    """Two independent uniform numbers in (0, 1) for each cell, float64, of the array kind of ``like``.

    A hash of seed, frame and cell (two rounds of 32-bit mixing, carried out in int64 so that NumPy and torch agree).
    """
    xp = array_namespace(like)
    count, bins, beams = shape
    cell = xp.reshape(xp.arange(bins * beams, dtype=xp.int64, device=device(like)), (1, bins, beams))
    frame = xp.reshape(xp.astype(frames, xp.int64), (count, 1, 1))
    key = _mix(frame & MASK, _mix_int(seed & MASK) ^ _mix_int((seed >> 32) + 0x51ED270B))
    first = _mix(cell, key)
    second = _mix(first, key ^ 0x2545F491)
    return tuple((xp.astype(value, xp.float64) + 0.5) * 2.0**-32 for value in (first, second))  # type: ignore[return-value]


def _multiply(value: Any, factor: int) -> Any:
    """``value * factor`` modulo 2^32: int64 arrays wrap, which leaves the low bits right."""
    return (value * factor) & MASK


def _mix(value: Any, key: Any) -> Any:
    """Chris Wellons's 32-bit integer hash `lowbias32`, keyed, twice."""
    for _ in range(2):
        value = value ^ key
        value = _multiply(value ^ (value >> 16), 0x7FEB352D)
        value = _multiply(value ^ (value >> 15), 0x846CA68B)
        value = value ^ (value >> 16)
        key = _multiply(key, 0x9E3779B1)
    return value


def _mix_int(value: int) -> int:
    return int(_mix(value & MASK, 0x68BC21EB))


def load_noise(text: str) -> NoiseModel:
    """``none``, ``low``, ``high``, ``chapter2``, three numbers ``mean,std,scale``, or a YAML file with these keys.

    Raises:
        MitsonarError: none of these, or a number outside 0..1.
    """
    if text in NOISE_MODELS:
        return NOISE_MODELS[text]
    try:
        if text.lower().endswith((".yaml", ".yml")):
            fields = yaml.safe_load(Path(text).read_text(encoding="utf-8"))
            if not isinstance(fields, dict):
                raise MitsonarError(f"{text} must hold the keys mean, std, scale, each 0..1")
            return NoiseModel(**fields)
        mean, std, scale = (float(word) for word in text.split(","))
        return NoiseModel(mean=mean, std=std, scale=scale)
    except OSError as error:
        raise MitsonarError(f"cannot read noise file {text}: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise MitsonarError(f"{text} is not YAML: {' '.join(str(error).split())}") from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise MitsonarError(f"unknown noise key {key}: {nearest_names(key, NoiseModel.model_fields)}") from None
        raise MitsonarError(f"noise {key} must be a fraction 0..1 of the maximum: got {first['input']!r}") from None
    except (ValueError, TypeError) as error:
        if isinstance(error, MitsonarError):
            raise
        raise MitsonarError(
            f"noise must be {', '.join(NOISE_MODELS)}, three fractions mean,std,scale, or a YAML file: got {text!r}"
        ) from None
