"""How a simulated sonar is fitted to a recording: its noise, water and coding, looks, resolution, stripes, speckle."""

from __future__ import annotations

import math
from collections.abc import Callable, Container
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy import ndimage, optimize, special

from mitsonar.acoustics import statistics
from mitsonar.acoustics.levels import decoded
from mitsonar.acoustics.water import gain_of, loss_of
from mitsonar.errors import MitsonarError
from mitsonar.instruments.beams import Pulse
from mitsonar.instruments.sonar import Sonar, group_of_beams
from mitsonar.records.frames import SonarFrames

__all__ = [
    "NOISE_FIELDS",
    "SonarFit",
    "as_instrument",
    "fit_sonar",
    "glow_by_beam",
    "moved_correlation",
    "near_glow",
    "volume",
]


Array = NDArray[np.float64]

GEOMETRY = (
    "azimuth_fov_deg", "beams", "beam_layout", "bearing", "range_min", "range_max", "range_bins", "sound_speed",
    "gain_exponent", "gain_absorption", "absorption_db_per_m", "temperature_c", "salinity_psu", "water_depth_m", "ph",
    "source_level_db", "frame_rate_hz",
)  # fmt: skip
"""Fields that are taken from the recording rather than from a named sonar."""

GROUPS = ("ping_groups", "group_order", "group_interval_s", "group_overhead_s")
"""Fields that are taken from a recording that states ping groups."""

LEAST_SHAPE = (96, 16)
"""Smallest number of bins and beams of a frame."""

NOISE_PERCENTILE, NOISE_FACTOR = 2.0, 2.0
"""Percentile of the windows' means that is noise, and the factor above it up to which windows count as noise."""

STATIC_CORRELATION = 0.5
"""Correlation between frames above which the darkest parts are not noise."""

FLAT_WINDOW, FLAT_NOISE_RATIO, MOST_CLIPPED = (64, 24), 10.0, 0.005
"""Windows from which the speckle law is fitted: bins and beams, smallest ratio to the noise, and the largest fraction of
their cells at full scale."""

STRUCTURED_NU = 0.5
"""Shape of the K law below which the scene's structure contributes."""

NEAR_RAYLEIGH = 0.02
"""Excess of the squared contrast below which intensities are exponential: a nu of 100."""

MOST_LOOKS = 16
"""Largest number of looks that a fit gives."""

OFFSETS = (0.03, 3.0)
"""Range of the detector's offset relative to the noise that a fit gives."""

LEAST_NOISE = 0.75
"""Part of the spread of dark windows that noise must have; the rest is texture, and structures if there is more."""

SPREAD_ERROR, SKEWNESS_ERROR = 0.1, 0.15
"""Errors of the measured spread, as a fraction, and skewness of noise in dB."""

GRAIN_PERCENTILE, LEAST_WINDOWS = 20.0, 8
"""Percentile of the windows' means below which the grain gives the coding, and the smallest number of windows."""

FULL_SCALE = 0.996
"""Value from which a cell may be clipped."""

FACE_REFLECTIVITY, FACE_SQUARED_COSINE = 0.5, 0.5
"""Assumptions where levels have no scale: reflectivity of the brightest thousandth, and the squared cosine of its slant."""


@dataclass(frozen=True)
class SonarFit:
    """A sonar fitted to a recording.

    Attributes:
        sonar: sonar of the model coherent, with the fitted fields.
        noise_db: noise in a cell at the middle of the window, relative to full scale [dB]; None if it was not seen.
        full_scale_db: level of full scale, before the gain, in the units of ``noise_level_db``.
        bright_db: 99.9th percentile of the levels beyond the near glow, relative to full scale [dB].
        speckle_span_db: span of the coding dB at which grain of 5.57 dB has the spread of these values [dB]; None for other
            codings, and where most windows are clipped.
        speckle_gamma: exponent of value = amplitude^gamma, from the coefficient of variation of the values; None in dB, and
            where most windows are clipped.
        glow_db: level of the first bins over the trend beyond them [dB].
        notes: sentences on assumptions and on quantities that could not be fitted.
    """

    sonar: Sonar
    noise_db: float | None
    full_scale_db: float
    bright_db: float
    speckle_span_db: float | None
    speckle_gamma: float | None
    glow_db: Array
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """Return the results as lines of text, one per quantity, with units."""
        sonar = self.sonar
        noise_text = "not seen" if self.noise_db is None else f"{self.noise_db:.1f} dB at mid range"
        grain = "none, since the frames are clipped"
        if self.speckle_span_db is not None:
            grain = f"a span of {self.speckle_span_db:.1f} dB"
        elif self.speckle_gamma is not None:
            grain = f"gamma {self.speckle_gamma:.2f} (linear is 2)"
        coding = {"dB": f"dB, span {sonar.coding_db:g} dB", "gamma": f"gamma {sonar.coding_gamma:g}"}
        level = "not fitted" if sonar.noise_level_db is None else f"{sonar.noise_level_db:.1f} dB"
        crosstalk_text = "none seen" if sonar.crosstalk_db is None else f"{sonar.crosstalk_db:.1f} dB"
        speckle_text = "none: exponential intensities" if sonar.speckle_nu is None else f"{sonar.speckle_nu:.2g}"
        glow_text = "none seen"
        if sonar.near_glow_db > 0:
            glow_text = (
                f"{sonar.near_glow_db:.1f} dB at range 0, gone at {sonar.near_glow_m:.3g} m; outermost beams "
                f"{sonar.near_glow_edge_db:.1f} dB below the middle one, spread {sonar.near_glow_spread_db:.1f} dB; "
                f"{100 * sonar.near_glow_still:.0f} % stay from ping to ping"
            )
        volume_text = "none seen" if sonar.volume_db is None else f"{sonar.volume_db:.1f} dB re 1/m"
        offset_text = "none seen" if sonar.detector_offset_db is None else f"{sonar.detector_offset_db:.1f} dB"
        groups_text = f" (of beams; group_stripes_db: {sonar.group_stripes_db:.2f})" if sonar.ping_groups > 1 else ""
        pulse_text = f"{1e3 * sonar.resolution_m:.3g} mm" + (f", {sonar.looks} looks a bin" if sonar.looks > 1 else "")
        return [
            f"noise over full scale   {noise_text} (noise_level_db: {level})",
            f"99.9th percentile       {self.bright_db:.1f} dB over full scale",
            f"coding                  {coding.get(sonar.value_coding, 'linear')}; the grain suggests {grain}",
            f"pulse, beam width       {pulse_text}; {math.degrees(sonar.beam_width_rad):.3g} deg",
            f"stripes_db              {sonar.stripes_db:.2f}" + groups_text,
            f"crosstalk_db            {crosstalk_text}",
            f"speckle_nu              {speckle_text}",
            f"near glow over noise    {glow_text}",
            f"volume_db               {volume_text}",
            f"detector_offset_db      {offset_text}",
        ]

    def yaml(self, *, only: Container[str] | None = None, leave: Container[str] = ()) -> str:
        """Return the sonar's file: the fields that differ from their defaults.

        Args:
            only: fields to include, even if they have their defaults; None: all that differ.
            leave: fields to leave out.
        """
        default, dumped = Sonar(), self.sonar.model_dump()
        if only is None:
            fields = {k: v for k, v in dumped.items() if v != getattr(default, k) and k in _written(self.sonar)}
        else:
            fields = {k: v for k, v in dumped.items() if k in only}
        fields = {k: v for k, v in fields.items() if k not in leave}
        about = "".join(f"# {line}\n" for line in [*self.lines(), *self.notes])
        return about + yaml.safe_dump(fields, sort_keys=False, allow_unicode=True)


def _written(sonar: Sonar) -> set[str]:
    """Return the fields that a file needs; the numbers of rays follow from the quality."""
    return set(type(sonar).model_fields) - {"rays_per_beam", "rays_across"}


def fit_sonar(frames: SonarFrames, base: Sonar | None = None, *, measure_coding: bool = False, **given: Any) -> SonarFit:
    """Fit a sonar of the model coherent to a recording.

    Args:
        frames: of a real or simulated sonar, at rest or slow; linear, dB or gamma.
        base: source of what the recording does not show: carrier, beam width, patterns; default: the sonar of the frames.
        measure_coding: take the coding from the grain instead of the one that the frames state. It assumes one look.
        given: known fields, which replace those of the base and are not fitted.

    Raises:
        MitsonarError: frames that are too small, empty or not finite, or fields that the model coherent lacks.
    """
    _check(frames)
    # 1. geometry and coding from the frames, everything else from the base
    recorded_sonar = frames.sonar
    stated = GEOMETRY if recorded_sonar.ping_groups == 1 else (*GEOMETRY, *GROUPS)
    known = {name: getattr(recorded_sonar, name) for name in stated}
    coding = {"coding": frames.level, "coding_db": recorded_sonar.coding_db, "coding_gamma": recorded_sonar.coding_gamma}
    sonar = (recorded_sonar if base is None else base).replace(**{"model": "coherent", **known, **coding, **given})
    value = np.asarray(frames.image, dtype=float) / (255 if frames.image.dtype.kind == "u" else 1)
    notes: list[str] = []
    # 2. the grain of dark windows gives a coding; with it, values become intensities. Ping groups precede the beam width.
    inside = _inside(statistics.window_values(value))
    clipped = inside.sum() < min(LEAST_WINDOWS, len(inside))
    span = gamma = None
    if clipped:
        share = 100 * float(((value <= 0) | (value >= FULL_SCALE)).mean())
        notes.append(
            f"{share:.0f} % of the cells have the smallest or the largest value: the grain of clipped frames has no coding "
            "and no pulse"
        )
    elif frames.level == "dB":
        span = _span(value)
    else:
        gamma = _gamma(value)
    sonar = _with_coding(sonar, span, gamma, measure_coding, notes)
    if not clipped:
        if "ping_groups" not in given and sonar.ping_groups == 1 and (groups := statistics.ping_groups(value)) > 1:
            sonar = sonar.replace(ping_groups=groups)
            notes.append(f"beams {groups} apart share what leaks from one to another: ping_groups is {groups}")
        sonar = _with_resolution(sonar, value, frames.level == "dB" and not measure_coding, given, notes)
    intensity = decoded(value, sonar)
    level = statistics.decibels(intensity, float(statistics.decibels(intensity[intensity > 0].min())) - 3)
    # 3. intensities before the gain give the noise, and the contrast of bright windows the speckle
    flat = intensity / gain_of(sonar)[:, None]
    noise = _noise(flat, value, level, notes)
    nu = _nu(flat, value, noise or 0.0, sonar)
    if nu is not None and nu < STRUCTURED_NU:
        notes.append(f"a speckle_nu of {nu:g} is more than the texture of a bottom: it includes objects and edges")
    # 4. a rise of quiet beams of the same ping next to a strong echo is crosstalk
    limit, group = float(decoded(FULL_SCALE, sonar)), group_of_beams(sonar)
    parts = [intensity[:, statistics.GLOW_BINS :, group == one] for one in range(sonar.ping_groups)]
    leak = statistics.leak_power(parts, limit)
    stripes = statistics.stripes_by_group_db(level, group)
    fitted: dict[str, Any] = {
        **{"near_glow_db": 0.0, "near_glow_edge_db": 0.0, "near_glow_spread_db": 0.0, "near_glow_still": 0.0},
        "volume_db": None,
        **dict(zip(("stripes_db", "group_stripes_db"), np.round(stripes, 2).tolist(), strict=True)),
        "crosstalk_db": round(float(np.clip(10 * math.log10(leak), -120, 0)), 1) if leak > 0 else None,
        "speckle_nu": nu,
        "detector_offset_db": None,
    }
    scale_notes: list[str] = []
    full_scale_db = _full_scale_db(frames, sonar, flat, scale_notes)
    # 5. what exceeds the noise near the sonar is glow; what is new in every frame is volume
    if noise is not None:
        fitted |= _water(flat, level, noise, sonar, full_scale_db, notes)
        # 6. dark bins contain noise and the detector's offset
        dark_db = _grain_windows(value)[1] * sonar.coding_db
        ratio = _offset_of(dark_db, sonar.looks) if frames.level == "dB" and not clipped else 0.0
        least_db = _grain(sonar.looks, OFFSETS[1])[0]
        if frames.level == "dB" and len(dark_db) and (spread_db := float(np.median(dark_db.std(axis=1)))) < least_db:
            notes.append(
                f"dark cells vary by {spread_db:.2g} dB, less than noise of {sonar.looks} looks does: a constant or a "
                "compression covers the noise, so noise_level_db, pulse and beam width are not the instrument's; give "
                "them by --set"
            )
        if ratio > 0:
            noise /= 1 + ratio
            fitted["noise_level_db"] = round(float(statistics.decibels(noise)) + full_scale_db, 1)
            fitted["detector_offset_db"] = round(float(statistics.decibels(noise * ratio)) + full_scale_db, 1)
        notes += scale_notes
    fitted = {name: value for name, value in fitted.items() if name not in given}
    middle = float(gain_of(sonar)[len(frames.range_m) // 2])
    return SonarFit(
        sonar=sonar.replace(**fitted),
        noise_db=None if noise is None else float(10 * math.log10(noise * middle)),
        full_scale_db=full_scale_db,
        bright_db=float(np.percentile(level[:, statistics.GLOW_BINS :], 99.9)),
        speckle_span_db=span,
        speckle_gamma=gamma,
        glow_db=statistics.near_glow_db(level),
        notes=notes,
    )


def _water(flat: Array, level: Array, noise: float, sonar: Sonar, full_scale_db: float, notes: list[str]) -> dict[str, Any]:
    """Return the fields of noise, near glow and volume."""
    fields: dict[str, Any] = {"noise_level_db": round(float(statistics.decibels(noise)) + full_scale_db, 1)}
    glow = near_glow(flat, noise, sonar.range_m)
    if glow is not None:
        edge, spread, still = glow_by_beam(flat, noise, sonar.range_m, sonar.bearing_rad, glow)
        fields |= {"near_glow_db": round(glow[0], 1), "near_glow_m": round(glow[1], 4)}
        fields |= {"near_glow_edge_db": round(float(np.clip(edge, -60, 60)), 1), "near_glow_still": round(still, 2)}
        fields["near_glow_spread_db"] = round(min(spread, 20.0), 1)
    strength_db = volume(flat, level, noise, sonar, notes)
    if strength_db is not None:
        fields["volume_db"] = round(float(np.clip(strength_db + full_scale_db - sonar.source_level_db, -200, 0)), 1)
    return fields


def _check(frames: SonarFrames) -> None:
    """Raise an error for frames that are too small, not finite, or that do not vary."""
    shape = frames.image.shape
    if len(frames) == 0 or shape[1] < LEAST_SHAPE[0] or shape[2] < LEAST_SHAPE[1]:
        raise MitsonarError(
            f"a fit needs at least one frame of {LEAST_SHAPE[0]} bins x {LEAST_SHAPE[1]} beams: got "
            f"{shape[0]} of {shape[1]} x {shape[2]}; record a longer or wider window"
        )
    if not np.isfinite(frames.image).all():
        raise MitsonarError("a fit needs finite levels: the frames hold nan or inf; set cells without echo to 0")
    if not np.ptp(frames.image):
        raise MitsonarError("a fit needs frames that vary: all cells have the same value; give frames with echoes")


# ---------------- Coding


def _mode(values: Array) -> float:
    """Return the half-sample mode: where values are densest, whatever their tails."""
    values = np.sort(values)
    while len(values) > 3:
        half = (len(values) + 1) // 2
        start = int(np.argmin(values[half - 1 :] - values[: len(values) - half + 1]))
        values = values[start : start + half]
    return float(values.mean()) if len(values) else math.nan


def _inside(parts: Array) -> NDArray[np.bool_]:
    """Return the windows ``(windows,)`` in which hardly any cell has the smallest or the largest value."""
    return np.asarray(((parts > 0) & (parts < FULL_SCALE)).mean(axis=1) > 1 - MOST_CLIPPED)


def _grain_windows(value: Array) -> tuple[Array, Array]:
    """Return windows and their detrended values ``(windows, cells)`` from which a coding is measured.

    These are the darkest ones in which hardly any cell has the smallest or the largest value: noise has grain of one law,
    which the texture of the bottom does not change.
    """
    parts, rest = (statistics.window_values(one) for one in (value, statistics.detrended(value)))
    inside = _inside(parts)
    if inside.sum() >= LEAST_WINDOWS:
        parts, rest = parts[inside], rest[inside]
    mean = parts.mean(axis=1)
    dark = mean <= max(np.percentile(mean, GRAIN_PERCENTILE), np.sort(mean)[min(LEAST_WINDOWS, len(mean)) - 1])
    return parts[dark], rest[dark]


def _bright_windows(value: Array, sonar: Sonar) -> Array:
    """Return detrended values ``(windows, cells)`` of windows far above the darkest, hardly clipped, in dB."""
    parts, rest = (statistics.window_values(one) for one in (value, statistics.detrended(value)))
    inside = _inside(parts)
    mean = parts.mean(axis=1)
    above = np.percentile(mean, NOISE_PERCENTILE) + 10 * math.log10(FLAT_NOISE_RATIO) / sonar.coding_db
    return np.asarray(rest[inside & (mean > above)])


def _span(value: Array) -> float:
    """Return the span of the coding dB at which the grain of dark windows has 5.57 dB."""
    rest = _grain_windows(value)[1]
    return float(statistics.RAYLEIGH_DB / max(_mode(rest.std(axis=1, ddof=1)), 1e-3))


def _variation(gamma: float) -> float:
    """Return the coefficient of variation of amplitude^gamma of exponential intensities; 0.2805 for 0.5."""
    return math.sqrt(special.gamma(1 + gamma) / special.gamma(1 + gamma / 2) ** 2 - 1)


def _gamma(value: Array) -> float:
    """Return the gamma that gives the coefficient of variation of dark windows; 2 is linear."""
    parts = _grain_windows(value)[0]
    mean = parts.mean(axis=1)
    variation = _mode(parts.std(axis=1, ddof=1)[mean > 0] / mean[mean > 0])
    low, high = 0.05, 4.0
    if not _variation(low) < variation < _variation(high):
        return low if variation <= _variation(low) else high
    return float(optimize.brentq(lambda gamma: _variation(gamma) - variation, low, high))


def _with_coding(sonar: Sonar, span: float | None, gamma: float | None, measure: bool, notes: list[str]) -> Sonar:
    """Return the sonar with the measured coding if requested; else add a note if it differs from the stated one."""
    if span is not None:
        stated, measured, coding = sonar.coding_db, span, {"coding": "dB", "coding_db": round(span, 1)}
    elif gamma is None:
        return sonar
    else:
        stated = sonar.coding_gamma if sonar.value_coding == "gamma" else 2.0
        measured, coding = gamma, {"coding": "gamma", "coding_gamma": round(gamma, 2)}
    if measure:
        return sonar.replace(**coding)
    if abs(math.log(measured / stated)) > 0.15:
        notes.append(
            f"the grain suggests {measured:.3g}, but the frames state {stated:g}: several looks, compression, or another "
            "coding (--measure-coding uses the grain's)"
        )
    return sonar


# ---------------- Looks, pulse and beams


LEAST_CORRELATION = 0.02
"""Correlation of neighbouring cells below which pulse and beam width stay unknown."""

RESOLUTIONS = (0.25, 8.0)
"""Range of pulses in bins, and of beam widths in beams, that are tried."""

LEAST_WIDTH = 0.7
"""Width below which beams of one ping would leave gaps, in beams."""


def _with_resolution(sonar: Sonar, value: Array, several: bool, given: dict[str, Any], notes: list[str]) -> Sonar:
    """Return the sonar with the pulse, looks and beam width at which the noise of neighbouring cells correlates as measured.

    The grain of the darkest windows is noise that array and matched filter have passed, without texture of the bottom.

    Args:
        sonar: with its coding.
        value: values of the frames ``(frames, bins, beams)``.
        several: whether to find the number of looks, for a known coding in dB; otherwise it stays.
        given: known fields, which stay.
        notes: of the fit, to which sentences are added.
    """
    rest = _grain_windows(value)[1]
    if len(rest) < LEAST_WINDOWS:
        return sonar
    # 1. Correlation with the next bin and with the next beam. Texture only adds to it, so bright windows may show less.
    over_range, over_beams = _next_correlation(rest, value.shape)
    bright = _bright_windows(value, sonar) if several else rest[:0]
    if len(bright) >= LEAST_WINDOWS:
        over_range, over_beams = np.minimum((over_range, over_beams), _next_correlation(bright, value.shape))
    exponent = {"dB": 0.0, "gamma": sonar.coding_gamma / 2}.get(sonar.value_coding, 1.0)
    # 2. Looks from the spread of the grain in dB, then the pulse. Looks of a long pulse count as the fewer they resemble.
    assert sonar.frequency_hz is not None
    shortest_m = 1.001 * Pulse.of_band(2 * sonar.frequency_hz, sonar.sound_speed).resolution_m
    if "looks" not in given and several:
        looks = _looks_of(rest * sonar.coding_db, bright * sonar.coding_db)
        sonar = sonar.replace(looks=max(1, min(looks, MOST_LOOKS, int(sonar.resolution_m / shortest_m))))
    if "pulse_m" not in given and "bandwidth_hz" not in given:
        step_m = sonar.bin_m / sonar.looks

        def excess_over_range(bins: float) -> float:
            squared = np.square(Pulse(bins * step_m).spectrum().coherence(np.arange(2 * sonar.looks) * step_m))
            return _coded(_neighbours(squared, sonar.looks), sonar.looks, exponent) - over_range

        pulse_bins = _root(excess_over_range, over_range)
        if pulse_bins is None:
            notes.append(f"the noise of neighbouring bins correlates by {over_range:.2f}, which gives no pulse: it is kept")
        else:
            pulse_m = max(pulse_bins * sonar.bin_m, sonar.looks * shortest_m)
            sonar = sonar.replace(bandwidth_hz=None, pulse_m=float(f"{pulse_m:.3g}"))
    # 3. Beam width, if neighbouring beams belong to one ping.
    if "beam_width_deg" not in given and sonar.ping_groups == 1:
        spacing_deg = sonar.azimuth_fov_deg / sonar.beams
        lag = float(np.median(np.diff(np.sin(sonar.bearing_rad))))

        def excess_over_beams(beams: float) -> float:
            aperture = sonar.replace(beam_width_deg=beams * spacing_deg).aperture
            return _coded(float(aperture.elements().coherence(lag)) ** 2, sonar.looks, exponent) - over_beams

        beams = _root(excess_over_beams, over_beams)
        if beams is not None and beams >= LEAST_WIDTH:
            sonar = sonar.replace(beam_width_deg=float(f"{beams * spacing_deg:.3g}"))
        else:
            notes.append(
                f"the noise of neighbouring beams correlates by {over_beams:.2f}: beam_width_deg is kept; if it is little, "
                "they belong to different pings, so give ping_groups (ARIS: a group for 16 beams; DIDSON: 12)"
            )
    return sonar


def _next_correlation(grain: Array, shape: tuple[int, ...]) -> tuple[float, float]:
    """Return the correlation with the next bin and with the next beam, medians over windows.

    Args:
        grain: detrended values of windows ``(windows, cells)``.
        shape: frames, bins and beams from which the windows were cut.
    """
    tall, wide = (min(size, whole) for size, whole in zip(statistics.WINDOW, shape[1:], strict=True))
    windows = grain.reshape(-1, tall, wide)
    power = np.square(windows).mean(axis=(1, 2))
    over_range = np.median((windows[:, 1:] * windows[:, :-1]).mean(axis=(1, 2)) / power)
    over_beams = np.median((windows[:, :, 1:] * windows[:, :, :-1]).mean(axis=(1, 2)) / power)
    return float(over_range), float(over_beams)


def _looks_of(grain_db: Array, bright_db: Array) -> int:
    """Return the number of looks, 1 to 16, by the spread and skewness of dark noise, to which a detector may add a constant.

    Args:
        grain_db: detrended levels of dark windows ``(windows, cells)`` [dB].
        bright_db: the same of windows far above the noise, where texture may raise the spread.
    """
    spread, skewness = _mode(grain_db.std(axis=1, ddof=1)), _skewness(grain_db)
    # Bright windows have at least the spread of their looks.
    fewest = 1
    if len(bright_db) >= LEAST_WINDOWS:
        at_most = _mode(bright_db.std(axis=1, ddof=1))
        fewest = max(looks for looks in range(1, MOST_LOOKS + 1) if looks == 1 or _grain(looks - 0.5, 0.0)[0] > at_most)

    def miss(looks: int, ratio: float) -> float:
        model = _grain(looks, ratio)
        return (math.log(model[0] / spread) / SPREAD_ERROR) ** 2 + ((model[1] - skewness) / SKEWNESS_ERROR) ** 2

    ratios = [0.0, *np.geomspace(*OFFSETS, 24)]
    return min(range(fewest, MOST_LOOKS + 1), key=lambda looks: min(miss(looks, ratio) for ratio in ratios))


def _offset_of(grain_db: Array, looks: int) -> float:
    """Return the constant that the detector adds to each bin, relative to the mean of the noise; 0 where none is seen.

    The logarithm of noise alone is skewed to low levels, and a constant cuts that tail.

    Args:
        grain_db: detrended levels of dark windows ``(windows, cells)`` [dB].
        looks: number of looks, which determines the law of the noise.
    """
    if len(grain_db) < LEAST_WINDOWS:
        return 0.0
    # Some texture, symmetric in dB, adds to the spread and not to the third moment; but that has its maximum at skewness 0.
    skewness = _skewness(grain_db)
    power = 3 if skewness < 0 else 0
    measured = skewness * float(np.median(grain_db.std(axis=1))) ** power

    def excess(log_ratio: float) -> float:
        spread, skewness = _grain(looks, math.exp(log_ratio))
        return skewness * spread**power - measured

    ends = [math.log(ratio) for ratio in OFFSETS]
    if not excess(ends[0]) < 0 < excess(ends[1]):
        return 0.0
    ratio = math.exp(optimize.brentq(excess, *ends))
    return ratio if _grain(looks, ratio)[0] > LEAST_NOISE * np.median(grain_db.std(axis=1)) else 0.0


def _skewness(grain_db: Array) -> float:
    """Return the skewness of detrended levels ``(windows, cells)``, the median over windows."""
    return float(np.median((grain_db**3).mean(axis=1) / np.square(grain_db).mean(axis=1) ** 1.5))


@cache
def _grain(looks: float, ratio: float) -> tuple[float, float]:
    """Return standard deviation [dB] and skewness of 10 log10(I + ratio), I of a Gamma law of mean 1."""
    level = statistics.decibels(special.gammaincinv(looks, (np.arange(2000) + 0.5) / 2000) / looks + ratio)
    away = level - level.mean()
    spread = float(np.sqrt(np.square(away).mean()))
    return spread, float((away**3).mean()) / spread**3


def _root(excess: Callable[[float], float], measured: float) -> float | None:
    """Return the resolution in cells at which the model correlates as measured; None if there is none."""
    if measured < LEAST_CORRELATION or not excess(RESOLUTIONS[0]) < 0 < excess(RESOLUTIONS[1]):
        return None
    return float(optimize.brentq(excess, *RESOLUTIONS, xtol=1e-3))


def _neighbours(squared: Array, looks: int) -> float:
    """Return the correlation of the powers of neighbouring bins: the mean of c^2 over pairs of their looks.

    Args:
        squared: squared coherence c^2 of the field at lags of 0, 1 ... looks ``(2 * looks,)``.
        looks: number of looks that a bin averages.
    """
    lag = np.arange(looks)[None, :] - np.arange(looks)[:, None]
    return float(squared[looks + lag].mean() / squared[np.abs(lag)].mean())


def _coded(correlation: float, looks: int, exponent: float) -> float:
    """Return the correlation of values whose powers, of Gamma laws of as many looks, correlate.

    Powers I^a of one look have (F(c) - 1) / (F(1) - 1), F = 2F1(-a, -a; 1; .). Logarithms have the sum of
    c^k (k - 1)! / (k (L)_k) over trigamma(L), which is Li2(c) / (pi^2 / 6) for one look.

    Args:
        correlation: of the powers, c.
        looks: L.
        exponent: a, of the coding; 0 for dB.
    """
    if exponent == 0:
        k = np.arange(1, 400)
        term = np.exp(special.gammaln(k) + special.gammaln(looks) - special.gammaln(looks + k)) / k
        return float((correlation**k * term).sum() / term.sum())
    if looks > 1:
        return correlation
    here, one = special.hyp2f1(-exponent, -exponent, 1, np.array([correlation, 1.0]))
    return float((here - 1) / (one - 1))


# ---------------- Levels


def _noise(flat: Array, value: Array, level: Array, notes: list[str]) -> float | None:
    """Return the mean intensity of the darkest windows; None if it is below the coding's floor, or not new in each frame."""
    beyond_glow = slice(statistics.GLOW_BINS, None)
    parts = statistics.window_values(flat[:, beyond_glow])
    mean = parts.mean(axis=1)
    dark = mean <= np.percentile(mean, NOISE_PERCENTILE) * NOISE_FACTOR
    empty = statistics.window_values(value[:, beyond_glow] <= 0)[dark].mean()
    if empty > 0.2:
        notes.append("the noise is below the lowest level of the coding: noise_level_db is left out")
        return None
    if len(level) > 1 and (correlation := float(statistics.correlation_by_level(level)[1][0])) > STATIC_CORRELATION:
        notes.append(
            f"the darkest tenth correlates by {correlation:.2f} from frame to frame, so it is not noise: noise_level_db is "
            "left out"
        )
        return None
    return float(np.median(mean[dark]))


def _full_scale_db(frames: SonarFrames, sonar: Sonar, flat: Array, notes: list[str]) -> float:
    """Return the level of full scale [dB re 1 uPa, or relative to the source], without the gain over range.

    Recordings without a scale get one by assuming that their brightest thousandth is a face of reflectivity 0.5 at 45 deg.
    """
    if frames.level_scale != 1.0:
        return float(10 * np.log10(frames.level_scale)) + sonar.source_level_db
    flat = flat[:, statistics.GLOW_BINS :]
    bright = np.percentile(flat, 99.9)
    bright_bins = np.nonzero(flat >= bright)[1] + statistics.GLOW_BINS
    range_m = float(np.median(sonar.range_m[bright_bins]))
    face = FACE_REFLECTIVITY * FACE_SQUARED_COSINE * sonar.beam_width_rad * sonar.bin_m / range_m**3 * math.log(1000)
    loss_db = -float(10 * np.log10(np.interp(range_m, sonar.range_m, loss_of(sonar))))
    notes.append(
        f"levels have no scale: noise_level_db assumes that the brightest thousandth, at {range_m:.3g} m, is a face of "
        f"reflectivity {FACE_REFLECTIVITY:g} at 45 deg"
    )
    return float(10 * np.log10(face / bright)) - loss_db + sonar.source_level_db


def _nu(flat: Array, value: Array, noise: float, sonar: Sonar) -> float | None:
    """Return the shape of the K law in bright, flat windows; None if intensities are exponential or nothing is bright.

    For a K law of L looks with noise N and signal S the mean square is (1 + 1 / L) (S + N)^2 (1 + (S / (S + N))^2 / nu).
    Looks that correlate count as the fewer that vary as much.
    """
    # remove the trend along range, and keep bright windows without clipping
    smooth = ndimage.uniform_filter1d(flat.mean(axis=(0, 2)), statistics.WINDOW[0], mode="nearest")
    parts, levels = (statistics.window_values(one, FLAT_WINDOW) for one in (flat / smooth[:, None], flat))
    clipped = statistics.window_values(value >= FULL_SCALE, FLAT_WINDOW).mean(axis=1)
    mean = levels.mean(axis=1)
    bright = (mean > (1 + FLAT_NOISE_RATIO) * noise) & (clipped <= MOST_CLIPPED) & (mean > 0)
    bright &= np.isfinite(parts).all(axis=1)  # not where whole rows are empty
    if not bright.any():
        return None
    # excess of the squared contrast over that of speckle alone, corrected for the noise
    step_m, lag = sonar.bin_m / sonar.looks, np.arange(sonar.looks)
    squared = np.square(Pulse(sonar.resolution_m / sonar.looks).spectrum().coherence(lag * step_m))
    law = 1 + float(squared[np.abs(lag[:, None] - lag)].mean())
    excess = (parts[bright] ** 2).mean(axis=1) / (law * parts[bright].mean(axis=1) ** 2) - 1
    inverse_nu = float(np.median(excess * (mean[bright] / (mean[bright] - noise)) ** 2))
    return None if inverse_nu < NEAR_RAYLEIGH else round(float(np.clip(1 / inverse_nu, 0.1, 100)), 2)


# ---------------- Near glow and volume scattering


FEWEST_GLOW_BINS, GLOW_WINDOW_FRACTION = 3, 0.25
"""Number of bins of the shortest glow, and the fraction of the window within which it ends."""

LEAST_FALL_DB, GLOW_STEEPNESS_RATIO = 10.0, 4.0
"""Smallest fall of a glow, and how many times steeper it is than the profile beyond it."""

MOST_GLOW_DB = 120.0
"""Largest ``near_glow_db``."""

GLOWING_DB, FEWEST_GLOWING = 10.0, 8
"""Smallest glow of the bins that show how beams differ [dB], and the smallest number of them."""

CLEAR_DB, FEWEST_CELLS = 15.0, 64
"""Smallest glow of the cells that give the constant part, so that noise contributes 3 % or less, and their least number."""

NEW_GRAIN_CORRELATION = 0.3
"""Correlation of bright grain between frames below which it is new."""

VOLUME_NOISE_RATIO = 3.0
"""Smallest ratio of a bin's mean to the noise where volume is measured."""

UNEVEN_DB = 3.0
"""Largest deviation of a profile of volume from that of noise and volume: half the spread, 10th to 90th percentile."""


def near_glow(flat: Array, noise: float, range_m: Array) -> tuple[float, float] | None:
    """Return the noise at range 0 above the noise beyond [dB], and the range where it ends [m]; None without glow.

    Two straight lines in dB are fitted to the medians of the first quarter of the bins, starting at the highest of the first
    :data:`~mitsonar.acoustics.statistics.GLOW_BINS`. The first line is the glow.

    Args:
        flat: intensities before the gain ``(frames, bins, beams)``.
        noise: mean of ``flat`` where there is only noise.
        range_m: ranges of the bins.
    """
    # profile relative to the noise: the median of exponential intensities is ln 2 times their mean
    excess = statistics.decibels(np.median(flat, axis=(0, 2)) / math.log(2) / noise)
    first = _first(excess)
    last = max(2 * FEWEST_GLOW_BINS, round(len(excess) * GLOW_WINDOW_FRACTION))
    fit_range_m, excess = range_m[first : first + last], excess[first : first + last]
    # two lines with the best break between them
    best: tuple[float, int, Array, Array] | None = None
    for end in range(FEWEST_GLOW_BINS, last - FEWEST_GLOW_BINS):
        lines = [np.polyfit(fit_range_m[part], excess[part], 1) for part in (slice(end), slice(end, None))]
        model = np.where(np.arange(last) < end, np.polyval(lines[0], fit_range_m), np.polyval(lines[1], fit_range_m))
        squared_error = float(np.square(excess - model).sum())
        if best is None or squared_error < best[0]:
            best = squared_error, end, lines[0], lines[1]
    assert best is not None
    _, end, (slope, start), (slope_beyond, _) = best
    # a glow falls far, and much more steeply than the profile beyond it
    fall = -slope * (fit_range_m[end - 1] - fit_range_m[0])
    if fall < LEAST_FALL_DB or -slope < GLOW_STEEPNESS_RATIO * abs(slope_beyond):
        return None
    if start <= MOST_GLOW_DB:
        return float(start), float(-start / slope)
    middle = float(fit_range_m[:end].mean())  # a line from 120 dB at range 0 through the middle of the glow
    height = min(start + slope * middle, 0.95 * MOST_GLOW_DB)
    return MOST_GLOW_DB, middle / (1 - height / MOST_GLOW_DB)


def _first(excess_db: Array) -> int:
    """Return the bin from which a glow falls: windows may begin with darker bins."""
    return int(np.argmax(excess_db[: statistics.GLOW_BINS]))


def glow_by_beam(
    flat: Array, noise: float, range_m: Array, bearing_rad: Array, glow: tuple[float, float]
) -> tuple[float, ...]:
    """Return how the near glow differs from beam to beam, and how much of it stays from ping to ping.

    The glow of a beam is the median level of its bins relative to the line of all beams. A straight line over the square of
    the bearing is fitted to it. The remainder, minus the grain of that many bins, is the spread. The part that stays follows
    from the correlation of consecutive frames' levels, which is Li2(c^2) / (pi^2 / 6) for complex Gaussian fields of
    coherence c.

    Args:
        flat: intensities before the gain ``(frames, bins, beams)``.
        noise: mean of ``flat`` where there is only noise.
        range_m: ranges of the bins.
        bearing_rad: bearings of the beams.
        glow: result of :func:`near_glow`.

    Returns:
        ``near_glow_edge_db``, ``near_glow_spread_db``, ``near_glow_still``; zeros where too few bins glow.
    """
    # bins well within the glow
    line = glow[0] * (1 - range_m / glow[1])
    first = _first(statistics.decibels(np.median(flat, axis=(0, 2)) / math.log(2) / noise))
    bins = np.arange(len(range_m))
    glowing = (bins >= first) & (line > GLOWING_DB)
    if glowing.sum() < FEWEST_GLOWING:
        return 0.0, 0.0, 0.0
    # level of each beam relative to the common line, and its robust trend over the squared bearing
    least = noise * 1e-3
    over_line_db = statistics.decibels(np.maximum(flat[:, glowing], least) / noise) - line[glowing][None, :, None]
    beam_glow_db = np.median(over_line_db, axis=(0, 1))
    square = (np.sin(bearing_rad) / np.sin(np.abs(bearing_rad).max())) ** 2
    trend = optimize.least_squares(
        lambda x: x[0] - x[1] * square - beam_glow_db, (0.0, 0.0), loss="soft_l1", f_scale=statistics.RAYLEIGH_DB
    )
    # spread of the beams about the trend, minus the grain of a median
    residual_db = beam_glow_db - trend.x[0] + trend.x[1] * square
    spread = 1.4826 * float(np.median(np.abs(residual_db - np.median(residual_db))))
    still = _coherence(over_line_db - beam_glow_db, line[glowing][:, None] + beam_glow_db > CLEAR_DB)
    frames = 1 + (len(flat) - 1) * (1 - still)  # the part that stays is one draw
    grain = (
        1.57 * statistics.RAYLEIGH_DB**2 / (frames * glowing.sum() / 2)
    )  # of a median, while neighbouring bins share grain
    return float(trend.x[1]), math.sqrt(max(spread**2 - grain, 0.0)), still


def _coherence(grain_db: Array, clear: NDArray[np.bool_]) -> float:
    """Return the coherence of consecutive frames from the correlation of their levels in the clear cells."""
    if len(grain_db) < 2 or clear.sum() < FEWEST_CELLS:
        return 0.0
    grain = grain_db[:, clear]
    rho = float(np.mean([np.corrcoef(one, other)[0, 1] for one, other in pairwise(grain)]))
    top = math.pi**2 / 6
    return math.sqrt(optimize.brentq(lambda x: special.spence(1 - x) / top - min(max(rho, 0.0), 1.0), 0.0, 1.0))


def moved_correlation(level_db: Array) -> float:
    """Return the largest correlation of consecutive detrended frames in their brighter half, over all shifts of cells."""
    grain, mean = statistics.detrended(level_db), statistics.local_mean(level_db)
    grain = np.where(mean >= np.median(mean), grain, 0)
    correlations = []
    for one, other in pairwise(grain):
        correlation = np.fft.irfft2(np.conj(np.fft.rfft2(one)) * np.fft.rfft2(other), one.shape)
        correlations.append(correlation.max() / max(math.sqrt(np.square(one).sum() * np.square(other).sum()), 1e-30))
    return float(np.mean(correlations)) if correlations else math.nan


def volume(flat: Array, level_db: Array, noise: float, sonar: Sonar, notes: list[str]) -> float | None:
    """Return the volume scattering strength relative to full scale at 1 m, in the units of ``flat`` [dB re 1/m].

    Bright speckle that is new in every frame of a resting sonar does not come from a surface. The result is None if the
    speckle is not new, if a shift finds it again, so that the sonar moved, if the profile is not that of volume, or if
    nothing exceeds the noise.

    Args:
        flat: intensities before the gain ``(frames, bins, beams)``.
        level_db: levels of the frames.
        noise: mean of ``flat`` where there is only noise.
        sonar: gives beam width, field of view over elevation, absorption.
        notes: list to which sentences are added.
    """
    # only speckle that is new in every frame, at any shift, can be volume
    if len(flat) < 2 or not float(statistics.correlation_by_level(level_db)[1][-3:].mean()) < NEW_GRAIN_CORRELATION:
        return None
    if moved_correlation(level_db) > NEW_GRAIN_CORRELATION:
        return None
    # bins that exceed the noise, beyond the near glow
    echo = flat.mean(axis=(0, 2)) - noise
    above_noise = echo > (VOLUME_NOISE_RATIO - 1) * noise
    above_noise[: statistics.GLOW_BINS] = False
    if above_noise.sum() < statistics.WINDOW[0]:
        return None
    # divide by the echo of volume of strength 1; check the profile of the whole window
    unit_echo = (
        sonar.beam_width_rad * math.radians(sonar.elevation_fov_deg) * sonar.bin_m / sonar.range_m**2 * loss_of(sonar)
    )
    strengths_db = statistics.decibels(echo[above_noise] / unit_echo[above_noise])
    strength_db = float(np.median(strengths_db))
    residual_db = statistics.decibels((echo + noise) / (noise + 10 ** (strength_db / 10) * unit_echo))[
        statistics.GLOW_BINS :
    ]
    if np.diff(np.percentile(residual_db, [10, 90]))[0] / 2 > UNEVEN_DB:
        return None
    notes.append(
        "bright speckle is new in every frame and falls with range as volume scattering does, so it is counted as such "
        "(volume_db): this holds for a sonar at rest"
    )
    return strength_db


# ---------------- Instrument of a recording


Layout = Literal["even", "sine"]

NOISE_FIELDS = (
    *("noise_level_db", "volume_db", "near_glow_db", "near_glow_m", "near_glow_edge_db", "near_glow_spread_db"),
    *("near_glow_still", "stripes_db", "group_stripes_db", "crosstalk_db", "detector_offset_db"),
    *("detector_spread_db", "tail_db", "tail_m", "saturation_db"),
    *("speckle_nu", "speckle_patch_m"),
)
"""Fields of a sonar that describe noise, water and grain, not the instrument's geometry."""

NOTED_DEVIATION = 0.1
"""Deviation of a beam from its place in the layout above which a note is added, as a fraction of the beam spacing."""


def as_instrument(frames: SonarFrames) -> tuple[SonarFrames, list[str]]:
    """Return the frames with a simulator's sonar that has their axes, and sentences on what it cannot represent.

    Beams are laid out at even angles, or at even sines of them, whichever is nearer to the bearings of the frames. The
    window begins half a bin before the first range and ends half a bin beyond the last.

    Raises:
        MitsonarError: frames of one bin or one beam, which have no spacing.
    """
    bearings, ranges = frames.bearing_rad, frames.range_m
    count = len(bearings)
    if min(count, len(ranges)) < 2:
        raise MitsonarError(
            f"the sonar of a recording needs two or more bins and beams: got {len(ranges)} x {count}; give frames of images"
        )
    middle = (bearings[0] + bearings[-1]) / 2
    # try both layouts, and choose the one whose beams are nearest to the bearings
    layouts: dict[Layout, float] = {}
    for layout in ("even", "sine"):
        layouts[layout] = _opening(bearings - middle, layout)
    sonars = {
        layout: frames.sonar.replace(
            beams=count,
            azimuth_fov_deg=float(np.degrees(opening)),
            beam_layout=layout,
            range_min=max(0.0, float(ranges[0] - (ranges[1] - ranges[0]) / 2)),
            range_max=float(ranges[-1] + (ranges[-1] - ranges[-2]) / 2),
            range_bins=len(ranges),
        )
        for layout, opening in layouts.items()
    }
    deviation_rad = {layout: float(np.abs(sonar.bearing_rad + middle - bearings).max()) for layout, sonar in sonars.items()}
    chosen = min(sonars, key=lambda layout: deviation_rad[layout])
    spacing = float(bearings[-1] - bearings[0]) / (count - 1)
    notes = []
    if deviation_rad[chosen] > NOTED_DEVIATION * spacing:
        notes.append(
            f"the beams are not evenly spaced: up to {np.degrees(deviation_rad[chosen]):.2g} deg from the layout {chosen} "
            f"of the simulator, which is {deviation_rad[chosen] / spacing:.2g} of their spacing"
        )
    if abs(middle) > NOTED_DEVIATION * spacing:
        notes.append(f"the fan is centred on {np.degrees(middle):.2g} deg; the simulator's is centred on the axis")
    return replace(frames, sonar=sonars[chosen]), notes


def _opening(bearings: np.ndarray, layout: Layout) -> float:
    """Return the field of view [rad] at which a layout's outermost beams match those of centred bearings ``(beams,)``."""
    outer, count = float(np.abs(bearings[[0, -1]]).mean()), len(bearings)
    if layout == "even":
        return 2 * outer * count / (count - 1)
    return float(2 * np.arcsin(min(1.0, np.sin(outer) * count / (count - 1))))
