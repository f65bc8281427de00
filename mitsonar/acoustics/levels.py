"""Compute and encode the levels of echoes, detect echoes in beams, and extract local contrast.

The reflectivity C is Lambert's mu, the share scattered per steradian: C = 1 scatters pi times the incident power, and a body
that reflects everything has C = 1 / pi.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from mitsonar.arrays import AnyArray
from mitsonar.instruments.sonar import Sonar

__all__ = [
    "SPREAD",
    "Detected",
    "LevelParts",
    "LocalContrast",
    "coded",
    "coding_slope",
    "decoded",
    "first_echoes",
    "fitted_contrast",
    "frame_correlation",
    "largest_level",
    "level",
    "strongest_echoes",
]


class LevelParts(Protocol):
    """Quantities that determine the level of an echo."""

    @property
    def reflectivity(self) -> AnyArray:
        """Return the reflectivity, Lambert's mu."""

    @property
    def cosine(self) -> AnyArray:
        """Return the cosine of the angle between ray and normal."""

    @property
    def solid_angle_sr(self) -> AnyArray:
        """Return the solid angle of the ray's cell [sr]."""

    @property
    def range_m(self) -> AnyArray:
        """Return the range to the surface [m]."""


def level(echoes: LevelParts, sonar: Sonar, where: Callable[..., AnyArray]) -> AnyArray:
    """Compute the level of each echo, which is its contribution to the range bins.

    Only IEEE products in float64 are used, so NumPy and Dr.Jit agree to the bit.

    ``thesis``: C L, reflectivity times cosine (Almanza-Medina, eq. 2.2).

    ``physical``, monostatic: C cos(theta) dOmega / R^2 times the gain R^g [sr/m^2]. The factors are the two-way spreading
    1/R^4, Lambert's law C cos^2(theta), and the lit area dA = R^2 dOmega / cos(theta), which cancels one cosine. C is
    Lambert's mu [1/sr]. A gain of g = 2 compensates one-way spreading, g = 4 two-way spreading. R is clamped from below to
    the start of the window or one bin, and from above to four times the end of the window, which only the tail of a
    footprint reaches.

    Args:
        echoes: arrays of float64.
        sonar: the instrument.
        where: function ``where(condition, a, b)`` of the array library.
    """
    lambert = echoes.reflectivity * echoes.cosine
    if sonar.model == "thesis":
        return lambert
    nearest, farthest = _range_limits(sonar)
    radius = where(echoes.range_m > nearest, where(echoes.range_m < farthest, echoes.range_m, farthest), nearest)
    return lambert * echoes.solid_angle_sr * _spreading(radius, sonar.gain_exponent)


def largest_level(sonar: Sonar, solid_angle: float) -> float:
    """Return the largest possible level of one ray, given the largest ``solid_angle`` of a cell [sr]."""
    if sonar.model == "thesis":
        return 1.0
    largest: float = max(_spreading(end, sonar.gain_exponent) for end in _range_limits(sonar))
    return largest * solid_angle


def _range_limits(sonar: Sonar) -> tuple[float, float]:
    """Return the limits to which ranges are clamped in spreading and gain [m]."""
    nearest = max(sonar.range_min, sonar.bin_m)
    return nearest, max(4 * sonar.range_max, nearest)


def _spreading(radius: AnyArray, gain_exponent: int) -> AnyArray:
    """Compute R^(g - 2) by multiplication rather than powers, for bitwise reproducibility."""
    match gain_exponent:
        case 0:
            return 1 / (radius * radius)
        case 1:
            return 1 / radius
        case 2:
            return radius * 0 + 1
        case 3:
            return radius
        case _:
            return radius * radius


# ---------------- Encoding of levels as image values


def coded(level: NDArray[np.float32], sonar: Sonar) -> NDArray[np.float32]:
    """Encode levels relative to full scale as image values in 0..1, float32, of the same shape.

    ``linear`` stores the level. ``dB`` (ARIS, DIDSON) stores 1 + 10 log10(level) / ``coding_db``. ``gamma`` (Oculus) stores
    amplitude^``coding_gamma``. All are clipped to 0..1.
    """
    if sonar.value_coding == "linear":
        linear: NDArray[np.float32] = np.clip(level, 0, 1)
        return linear
    if sonar.value_coding == "gamma":
        return np.asarray(np.clip(level, 0, 1) ** np.float32(sonar.coding_gamma / 2), dtype=np.float32)
    smallest = np.float32(10 ** (-sonar.coding_db / 10))
    value = 1 + np.log10(np.clip(level, smallest, 1)) * np.float32(10 / sonar.coding_db)
    return np.asarray(np.maximum(value, np.float32(0)), dtype=np.float32)


def coding_slope(level: NDArray[np.float64], sonar: Sonar) -> NDArray[np.float64]:
    """Return the derivative of image values in 0..1 with respect to the level, of the same shape; 0 above full scale.

    Args:
        level: levels relative to full scale, above 0.
        sonar: the sonar that defines the coding.
    """
    match sonar.value_coding:
        case "linear":
            slope = np.ones_like(level)
        case "gamma":
            slope = sonar.coding_gamma / 2 * level ** (sonar.coding_gamma / 2 - 1)
        case _:
            slope = 10 / (np.log(10) * sonar.coding_db * np.maximum(level, 10 ** (-sonar.coding_db / 10)))
    return np.asarray(np.where(level < 1, slope, 0.0), dtype=np.float64)


def decoded(value: ArrayLike, sonar: Sonar, coding: str | None = None) -> NDArray[np.float64]:
    """Decode image values in 0..1 to levels relative to full scale, of the same shape.

    In the ``dB`` coding, a value of 0 represents the lowest level of the coding or less. If ``coding`` is None, the coding
    of the sonar is used.
    """
    value = np.asarray(value, dtype=float)
    match coding or sonar.value_coding:
        case "linear":
            return value
        case "gamma":
            return np.asarray(value ** (2 / sonar.coding_gamma), dtype=np.float64)
        case _:
            return np.asarray(10 ** ((value - 1) * (sonar.coding_db / 10)), dtype=np.float64)


# ---------------- Echo detection


Array = NDArray[np.float64]


class Detected(NamedTuple):
    """Range, level and quality of one detected echo per beam; range and level are nan where there is none.

    Attributes:
        range_m: range of the echo ``(...)``, with sub-bin resolution.
        level_db: level of its strongest bin ``(...)``.
        quality: fraction of the beam's energy above the noise that lies in the echo ``(...)``, 0..1.
    """

    range_m: Array
    level_db: Array
    quality: Array


def first_echoes(levels: Array, range_m: Array, noise: Array, *, below_db: float, above_noise_db: float) -> Detected:
    """Find the onset of the first echo in each beam, as an altimeter does.

    The onset is where the level rises above the threshold, interpolated between the centres of two bins. The threshold lies
    ``below_db`` under the strongest bin, but at least ``above_noise_db`` over the noise.

    Args:
        levels: intensities ``(..., bins)``.
        range_m: centres of the bins ``(bins,)``, evenly spaced.
        noise: mean intensity of the noise ``(bins,)``; 0 for none.
        below_db: threshold relative to the strongest bin, downwards.
        above_noise_db: threshold relative to the noise, upwards.
    """
    levels, limit, above = _thresholds(levels, noise, below_db, above_noise_db)
    # Find the first bin above the threshold, and the bin before it.
    first = above.argmax(axis=-1)[..., None]
    before = np.maximum(first - 1, 0)
    level_at, level_before, threshold = (
        np.take_along_axis(values, index, -1) for values, index in ((levels, first), (levels, before), (limit, first))
    )
    # Interpolate the threshold crossing linearly between the two; an echo in the first bin starts there.
    rise = np.where(level_at > level_before, level_at - level_before, 1.0)
    back = np.where(first > 0, np.clip((level_at - threshold) / rise, 0, 1), 0)
    onset_m = (range_m[first] - back * (range_m[1] - range_m[0] if len(range_m) > 1 else 0))[..., 0]
    return _detected(levels, noise, above, _run_around(above, first), onset_m)


def strongest_echoes(levels: Array, range_m: Array, noise: Array, *, below_db: float, above_noise_db: float) -> Detected:
    """Find the centre of the strongest echo in each beam, as the centroid of its energy.

    The echo is the run of bins around the strongest bin that exceed the threshold of :func:`first_echoes`, extended by one
    bin on each side. Speckle may interrupt it for up to two bins. The noise is subtracted.

    Args:
        levels: intensities ``(..., bins)``.
        range_m: centres of the bins ``(bins,)``.
        noise: mean intensity of the noise ``(bins,)``; 0 for none.
        below_db: threshold relative to the strongest bin, downwards.
        above_noise_db: threshold relative to the noise, upwards.
    """
    levels, _, above = _thresholds(levels, noise, below_db, above_noise_db)
    strongest = np.where(above, levels, 0).argmax(axis=-1)[..., None]
    # Extend the runs by one bin on each side, which bridges gaps of up to two bins from speckle.
    wide = above.copy()
    wide[..., 1:] |= above[..., :-1]
    wide[..., :-1] |= above[..., 1:]
    echo = _run_around(wide, strongest)
    # Average the ranges of the echo, weighted by the energy above the noise.
    energy = np.where(echo, np.maximum(levels - noise, 0), 0)
    total = energy.sum(axis=-1)
    centroid_m = (energy * range_m).sum(axis=-1) / np.where(total > 0, total, 1)
    return _detected(levels, noise, above, echo, centroid_m)


def _thresholds(
    levels: Array, noise: Array, below_db: float, above_noise_db: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return levels, the threshold of each bin, and which bins exceed it."""
    levels = np.asarray(levels, dtype=float)
    peak = levels.max(axis=-1, keepdims=True)
    limit = np.maximum(peak * 10 ** (-below_db / 10), noise * 10 ** (above_noise_db / 10))
    return levels, limit, (levels >= limit) & (levels > 0)


def _run_around(above: NDArray[np.bool_], index: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return the contiguous run of bins above the threshold that contains ``at`` ``(..., 1)``."""
    gaps = np.cumsum(~above, axis=-1)
    return np.asarray(above & (gaps == np.take_along_axis(gaps, index, -1)))


def _detected(levels: Array, noise: Array, above: NDArray[np.bool_], echo: NDArray[np.bool_], range_m: Array) -> Detected:
    """Return the detections, with nan where no bin exceeds the threshold."""
    has_echo = above.any(axis=-1)
    energy = np.maximum(levels - noise, 0)
    total, inside = energy.sum(axis=-1), np.where(echo, energy, 0).sum(axis=-1)
    peak = np.where(echo, levels, 0).max(axis=-1)
    quality = np.where(has_echo, inside / np.where(total > 0, total, 1), 0.0)
    level = 10 * np.log10(np.where(has_echo, peak, 1.0))
    return Detected(np.where(has_echo, range_m, np.nan), np.where(has_echo, level, np.nan), quality)


# ---------------- Local contrast of sonar images


Images = NDArray[np.float32]

SPREAD = 8.0
"""Number of standard deviations that the values 0 to 1 span."""

SMOOTHINGS = ((1.0, 0.5), (2.0, 0.7), (4.0, 1.0), (8.0, 1.4), (16.0, 2.0))
"""Candidate smoothings, weakest first: standard deviations of Gaussians [bins, beams]."""

ENOUGH = 0.75
"""Correlation of consecutive frames at which they need no further smoothing."""

NEIGHBOURHOOD = (0.12, 0.3)
"""Standard deviation of the Gaussian neighbourhood, as a fraction of the number of bins and of beams."""

LEAST_SPREAD_DB = 0.5
"""Lower limit of the standard deviation of an image [dB], so that the noise of a uniform image is not amplified."""


@dataclass(frozen=True)
class LocalContrast:
    """Conversion of levels to local contrast: the deviation from the neighbourhood, in standard deviations of the image.

    A real sonar illuminates the ground unevenly: with a bright patch, stripes of beams, and a decay with range. This
    illumination moves with the sonar, so it biases estimators that match levels towards zero motion. Its scale is that of
    the patch, which is larger than stones and their shadows. The mean of a neighbourhood is therefore subtracted from the
    levels in dB. Its standard deviation is not divided out, since this increased closure errors fivefold on a real
    recording. Smoothing suppresses speckle and noise that differ from frame to frame; its strength is chosen from the frames
    by :func:`mitsonar.acoustics.levels.fitted_contrast`.

    Attributes:
        bins: standard deviation of the smoothing along range [bins].
        beams: standard deviation of the smoothing across beams [beams].
    """

    bins: float = 4.0
    beams: float = 1.0

    def apply(self, level_db: Images) -> Images:
        """Return the contrast of images ``(frames, bins, beams)`` [dB] in 0..1; 0.5 is the mean of the neighbourhood."""
        return np.stack([self._contrast(image) for image in level_db]) if len(level_db) else level_db.astype(np.float32)

    def _contrast(self, level_db: Images) -> Images:
        smooth = ndimage.gaussian_filter(level_db, (self.bins, self.beams), mode="nearest", output=np.float32)
        neighbourhood = [part * size for part, size in zip(NEIGHBOURHOOD, smooth.shape, strict=True)]
        deviation = smooth - ndimage.gaussian_filter(smooth, neighbourhood, mode="nearest")
        contrast = deviation / np.float32(max(float(deviation.std()), LEAST_SPREAD_DB))
        return np.asarray(np.clip(np.float32(0.5) + contrast / np.float32(SPREAD), 0, 1), dtype=np.float32)


def frame_correlation(images: Images) -> float:
    """Return the mean correlation of consecutive images ``(frames, bins, beams)``; 0 for fewer than two."""
    flat = images.reshape(len(images), -1).astype(np.float64)
    flat = flat - flat.mean(axis=1, keepdims=True)
    size = np.sqrt((flat * flat).sum(axis=1))
    products = (flat[1:] * flat[:-1]).sum(axis=1)
    norms = size[1:] * size[:-1]
    return float(np.mean(np.where(norms > 0, products / np.where(norms > 0, norms, 1), 0))) if len(images) > 1 else 0.0


def fitted_contrast(runs: Sequence[Images]) -> LocalContrast:
    """Choose the weakest smoothing at which consecutive images are sufficiently correlated.

    The required correlation is 0.75. If no smoothing reaches it, the one with the largest correlation is chosen.

    Args:
        runs: sequences of consecutive images, each ``(frames, bins, beams)`` [dB].
    """
    best, best_correlation = LocalContrast(*SMOOTHINGS[0]), -1.0
    for bins, beams in SMOOTHINGS:
        candidate = LocalContrast(bins, beams)
        correlation = float(np.mean([frame_correlation(candidate.apply(run)) for run in runs]))
        if correlation > best_correlation:
            best, best_correlation = candidate, correlation
        if correlation >= ENOUGH:
            break
    return best
