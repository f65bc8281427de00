"""Level of an echo: its contribution to its bins.

The reflectivity C is Lambert's mu, what is scattered into a steradian: C = 1 scatters pi times what arrives, and a body that
reflects all has C = 1 / pi.
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
    "alike",
    "coded",
    "coding_slope",
    "decoded",
    "first_echoes",
    "fitted_contrast",
    "largest_level",
    "level",
    "strongest_echoes",
]


class LevelParts(Protocol):
    """What a level is made of."""

    @property
    def reflectivity(self) -> AnyArray:
        """Lambert's mu."""

    @property
    def cosine(self) -> AnyArray:
        """Of the angle between ray and normal."""

    @property
    def solid_angle_sr(self) -> AnyArray:
        """Of the ray's cell [sr]."""

    @property
    def range_m(self) -> AnyArray:
        """To the surface [m]."""


def level(echoes: LevelParts, sonar: Sonar, where: Callable[..., AnyArray]) -> AnyArray:
    """Compute the level of each echo, float64, by plain IEEE products: NumPy and Dr.Jit agree to the bit.

    ``thesis``: C L, reflectivity times cosine (Almanza-Medina, eq. 2.2).

    ``physical``, monostatic: C cos(theta) dOmega / R^2 times the gain R^g [sr/m^2]. The factors are spreading 1/R^4 there
    and back, Lambert's law C cos^2(theta), and the lit area dA = R^2 dOmega / cos(theta), which cancels one cosine. C is
    Lambert's mu [1/sr]. The gain g = 2 undoes the spreading of one way, g = 4 that of both. R is clamped below to the
    window's begin or one bin, and above to four times the window's end, where only a footprint's tail reaches.

    Args:
        echoes: arrays of float64.
        sonar: the instrument.
        where: ``where(condition, a, b)`` of the arrays' library.
    """
    lambert = echoes.reflectivity * echoes.cosine
    if sonar.model == "thesis":
        return lambert
    nearest, farthest = _ends(sonar)
    radius = where(echoes.range_m > nearest, where(echoes.range_m < farthest, echoes.range_m, farthest), nearest)
    return lambert * echoes.solid_angle_sr * _spreading(radius, sonar.gain_exponent)


def largest_level(sonar: Sonar, solid_angle: float) -> float:
    """Return the largest level of one ray; ``solid_angle`` [sr] is the largest of a cell."""
    if sonar.model == "thesis":
        return 1.0
    largest: float = max(_spreading(end, sonar.gain_exponent) for end in _ends(sonar))
    return largest * solid_angle


def _ends(sonar: Sonar) -> tuple[float, float]:
    """Return the least and the greatest range of spreading and gain [m]."""
    nearest = max(sonar.range_min, sonar.bin_m)
    return nearest, max(4 * sonar.range_max, nearest)


def _spreading(radius: AnyArray, gain_exponent: int) -> AnyArray:
    """Compute R^(g - 2) by products, not powers."""
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


# ---------------- How values 0..1 of a picture stand for levels: linearly, in decibels (ARIS, DIDSON), or as a power
# (Oculus)


def coded(level: NDArray[np.float32], sonar: Sonar) -> NDArray[np.float32]:
    """Return values 0..1, float32, for levels relative to full scale, of the same shape.

    ``linear``: the level. ``dB``: 1 + 10 log10(level) / ``coding_db``. ``gamma``: amplitude^``coding_gamma``. All are
    clipped to 0..1.
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
    """Return the derivative of values 0..1 by the level relative to full scale, of the same shape; 0 beyond full scale.

    Args:
        level: above 0.
        sonar: its coding.
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
    """Return the levels relative to full scale that values 0..1 stand for, of the same shape.

    A value of 0 of the coding ``dB`` stands for its least level, or less. ``coding`` None is the sonar's own.
    """
    value = np.asarray(value, dtype=float)
    match coding or sonar.value_coding:
        case "linear":
            return value
        case "gamma":
            return np.asarray(value ** (2 / sonar.coding_gamma), dtype=np.float64)
        case _:
            return np.asarray(10 ** ((value - 1) * (sonar.coding_db / 10)), dtype=np.float64)


# ---------------- Bottom detection: the range of the first or of the strongest echo in a beam, finer than a bin, with
# a quality


Array = NDArray[np.float64]


class Detected(NamedTuple):
    """An echo in each beam; nan where there is none.

    Attributes:
        range_m: of the echo ``(...)``.
        level_db: of its strongest bin ``(...)``.
        quality: part of the beam's energy above the noise that lies in the echo ``(...)``, 0..1.
    """

    range_m: Array
    level_db: Array
    quality: Array


def first_echoes(levels: Array, range_m: Array, noise: Array, *, below_db: float, above_noise_db: float) -> Detected:
    """Find where the first echo of each beam begins, as an altimeter does.

    It begins where levels rise over the threshold, interpolated between the middles of two bins. The threshold lies
    ``below_db`` under the strongest bin, and ``above_noise_db`` over the noise at least.

    Args:
        levels: intensities ``(..., bins)``.
        range_m: middles of the bins ``(bins,)``, at equal steps.
        noise: mean intensity of the noise ``(bins,)``; 0: none.
        below_db: of the threshold under the strongest bin.
        above_noise_db: of the threshold over the noise.
    """
    levels, limit, above = _thresholds(levels, noise, below_db, above_noise_db)
    first = above.argmax(axis=-1)[..., None]
    before = np.maximum(first - 1, 0)
    here, low, wanted = (np.take_along_axis(one, at, -1) for one, at in ((levels, first), (levels, before), (limit, first)))
    rise = np.where(here > low, here - low, 1.0)
    back = np.where(first > 0, np.clip((here - wanted) / rise, 0, 1), 0)
    place = (range_m[first] - back * (range_m[1] - range_m[0] if len(range_m) > 1 else 0))[..., 0]
    return _told(levels, noise, above, _joined(above, first), place)


def strongest_echoes(levels: Array, range_m: Array, noise: Array, *, below_db: float, above_noise_db: float) -> Detected:
    """Find the middle of the strongest echo of each beam: the centroid of its energy.

    The echo is the run of bins around the strongest that exceed the threshold of :func:`first_echoes`, with one bin on each
    side; speckle may interrupt it for two bins. Noise is taken off.

    Args:
        levels: intensities ``(..., bins)``.
        range_m: middles of the bins ``(bins,)``.
        noise: mean intensity of the noise ``(bins,)``; 0: none.
        below_db: of the threshold under the strongest bin.
        above_noise_db: of the threshold over the noise.
    """
    levels, _, above = _thresholds(levels, noise, below_db, above_noise_db)
    strongest = np.where(above, levels, 0).argmax(axis=-1)[..., None]
    wide = above.copy()
    wide[..., 1:] |= above[..., :-1]
    wide[..., :-1] |= above[..., 1:]
    echo = _joined(wide, strongest)
    energy = np.where(echo, np.maximum(levels - noise, 0), 0)
    total = energy.sum(axis=-1)
    middle = (energy * range_m).sum(axis=-1) / np.where(total > 0, total, 1)
    return _told(levels, noise, above, echo, middle)


def _thresholds(
    levels: Array, noise: Array, below_db: float, above_noise_db: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return levels, the threshold of each bin, and which bins exceed it."""
    levels = np.asarray(levels, dtype=float)
    peak = levels.max(axis=-1, keepdims=True)
    limit = np.maximum(peak * 10 ** (-below_db / 10), noise * 10 ** (above_noise_db / 10))
    return levels, limit, (levels >= limit) & (levels > 0)


def _joined(above: NDArray[np.bool_], at: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return the run of bins around ``at`` ``(..., 1)`` of which all are above the threshold."""
    gaps = np.cumsum(~above, axis=-1)
    return np.asarray(above & (gaps == np.take_along_axis(gaps, at, -1)))


def _told(levels: Array, noise: Array, above: NDArray[np.bool_], echo: NDArray[np.bool_], place: Array) -> Detected:
    """Return detections, nan where no bin is above the threshold."""
    there = above.any(axis=-1)
    energy = np.maximum(levels - noise, 0)
    total, inside = energy.sum(axis=-1), np.where(echo, energy, 0).sum(axis=-1)
    peak = np.where(echo, levels, 0).max(axis=-1)
    quality = np.where(there, inside / np.where(total > 0, total, 1), 0.0)
    level = 10 * np.log10(np.where(there, peak, 1.0))
    return Detected(np.where(there, place, np.nan), np.where(there, level, np.nan), quality)


# ---------------- Local contrast of sonar images: what stands out of its neighbourhood, in standard deviations of the
# image
# A real sonar lights the ground unevenly: a bright patch, stripes of beams, a fall with range. This light moves with
# the sonar, so that estimators that match levels are pulled towards no motion. Its scale is that of the patch, larger
# than that of stones and their shadows. So the mean of a neighbourhood is taken out of levels in dB. Its spread is not:
# dividing by it made the errors of closure five times larger on a real recording. Speckle and noise that are new in
# each frame are smoothed away, as far as the frames themselves say.


Images = NDArray[np.float32]

SPREAD = 8.0
"""Standard deviations over the range of the values, 0 to 1."""

SMOOTHINGS = ((1.0, 0.5), (2.0, 0.7), (4.0, 1.0), (8.0, 1.4), (16.0, 2.0))
"""Smoothings that are tried, least first: standard deviations of Gaussians [bins, beams]."""

ENOUGH = 0.75
"""Correlation of consecutive frames at which they need no more smoothing."""

NEIGHBOURHOOD = (0.12, 0.3)
"""Standard deviation of the Gaussian that a neighbourhood is, as part of the bins and of the beams."""

LEAST_SPREAD_DB = 0.5
"""Spread of an image [dB] below which it is taken for even: its noise must not be blown up."""


@dataclass(frozen=True)
class LocalContrast:
    """How levels become contrast.

    Attributes:
        bins: standard deviation of the smoothing along range [bins].
        beams: and across beams [beams].
    """

    bins: float = 4.0
    beams: float = 1.0

    def apply(self, level_db: Images) -> Images:
        """Return the contrast of images ``(frames, bins, beams)`` [dB] in 0..1: 0.5 is the mean of the neighbourhood."""
        return np.stack([self._of(one) for one in level_db]) if len(level_db) else level_db.astype(np.float32)

    def _of(self, level_db: Images) -> Images:
        smooth = ndimage.gaussian_filter(level_db, (self.bins, self.beams), mode="nearest", output=np.float32)
        around = [part * size for part, size in zip(NEIGHBOURHOOD, smooth.shape, strict=True)]
        rest = smooth - ndimage.gaussian_filter(smooth, around, mode="nearest")
        contrast = rest / np.float32(max(float(rest.std()), LEAST_SPREAD_DB))
        return np.asarray(np.clip(np.float32(0.5) + contrast / np.float32(SPREAD), 0, 1), dtype=np.float32)


def alike(images: Images) -> float:
    """Return the mean correlation of consecutive images ``(frames, bins, beams)``; 0 for fewer than two."""
    flat = images.reshape(len(images), -1).astype(np.float64)
    flat = flat - flat.mean(axis=1, keepdims=True)
    size = np.sqrt((flat * flat).sum(axis=1))
    products = (flat[1:] * flat[:-1]).sum(axis=1)
    norms = size[1:] * size[:-1]
    return float(np.mean(np.where(norms > 0, products / np.where(norms > 0, norms, 1), 0))) if len(images) > 1 else 0.0


def fitted_contrast(runs: Sequence[Images]) -> LocalContrast:
    """Choose the least smoothing by which consecutive images are alike.

    They correlate by 0.75 then. Where none of the smoothings reaches it, the one with the largest correlation is taken.

    Args:
        runs: consecutive images, each ``(frames, bins, beams)`` [dB].
    """
    found, best = LocalContrast(*SMOOTHINGS[0]), -1.0
    for bins, beams in SMOOTHINGS:
        tried = LocalContrast(bins, beams)
        correlation = float(np.mean([alike(tried.apply(run)) for run in runs]))
        if correlation > best:
            found, best = tried, correlation
        if correlation >= ENOUGH:
            break
    return found
