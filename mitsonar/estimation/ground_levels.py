"""How levels of frames over level ground are modelled, and the parameters of the model fitted to them.

The mean level of a cell is C sin(grazing) dOmega R^(g - 2 + x) times losses and the pattern over elevation, plus what leaks
from other beams, plus noise, times the gain of its beam (:func:`mitsonar.acoustics.levels.level`). Means of blocks of cells
follow a Gamma law, so the likelihood is maximised by Fisher scoring. Data sheets enter as normal priors. The covariance is
the inverse of the Fisher information and the priors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from mitsonar.acoustics.levels import decoded
from mitsonar.acoustics.statistics import decibels
from mitsonar.acoustics.water import gain_of, sonar_absorption, undone_absorption
from mitsonar.errors import MitsonarError
from mitsonar.estimation.sonar_fit import FULL_SCALE, SonarFit
from mitsonar.geometry.ground import GroundGeometry, arc_elevation
from mitsonar.instruments.beams import half_power
from mitsonar.instruments.sonar import Sonar, crosstalk_amplitude
from mitsonar.records.frames import SonarFrames

__all__ = [
    "FIELDS",
    "INSTRUMENT",
    "NO_CROSSTALK_DB",
    "POSITIVE",
    "GroundModel",
    "GroundProblem",
    "GroundSolution",
    "reference_of",
]

Array = NDArray[np.float64]

FIELDS = {
    "level_db": "dB", "height_m": "m", "pitch_deg": "deg", "roll_deg": "deg", "taper_db": "dB", "elevation_fov_deg": "deg",
    "absorption_db_per_m": "dB/m", "range_exponent": "", "noise_level_db": "dB", "crosstalk_db": "dB",
}  # fmt: skip
"""Parameters and their units, in the order of their vector."""

INSTRUMENT = ("taper_db", "elevation_fov_deg", "absorption_db_per_m", "range_exponent", "noise_level_db", "crosstalk_db")
"""Parameters of the instrument rather than of the place."""

POSITIVE = ("height_m", "elevation_fov_deg")
"""Parameters whose logarithm is fitted."""

PRIOR_STD = {
    "level_db": 1e3, "height_m": 0.2, "pitch_deg": 5.0, "roll_deg": 3.0, "taper_db": 6.0, "elevation_fov_deg": 0.3,
    "range_exponent": 1.5, "noise_level_db": 10.0, "crosstalk_db": 10.0,
}  # fmt: skip
"""Standard deviations of the priors; of the logarithm where that is fitted."""

UNKNOWN_HEIGHT = 0.2
"""Height, relative to the end of the window, at which the prior of an unknown one has its middle."""

UNKNOWN_POSE_STD = {"height_m": 1.0, "pitch_deg": 30.0}
"""The same for frames without poses."""

FAINT_LEAK_DB, NO_CROSSTALK_DB = -20.0, -120.0
"""Power that leaks into a beam from all others, relative to theirs, at which the prior of crosstalk has its middle where
none was seen [dB]; and crosstalk without any effect."""

ABSORPTION_STD = (0.3, 0.05)
"""Standard deviation of the prior of the absorption: as a fraction of it, and the least [dB/m]."""

BEAM_GAIN_STD_DB = 2.0
"""Standard deviation of the prior of the beams' gains, if they are fitted."""

BLOCKS, SAMPLES, MOST_VIEWS = (64, 32), (4, 8), 16
"""Largest number of blocks along range and of beams, of places within a block where the model is computed, and of poses."""

KEPT = 3 * MOST_VIEWS
"""Number of geometries that a model remembers."""

SAME_POSE = (0.01, math.radians(0.1))
"""Differences of height [m] and of angles [rad] within which frames are averaged."""

MOST_CLIPPED, CLIPPED_OVER, MOST_EMPTY = 0.1, 5, 0.2
"""Largest fraction of cells at full scale, in a square of blocks, and of cells without a level, of a block that is used."""

OUTLIER = 4.0
"""Robust standard deviations from the model beyond which a block is left out as an object or a shadow."""

PATTERN_EDGE, NEGLIGIBLE = 0.01, 0.2
"""Power of the pattern over elevation below which its shape is unknown, and the echo, relative to the noise, up to which
ground out there is noise."""

FEWEST_BLOCKS, LEAST_SIGNAL, LEAST_EXPLAINED, MOST_ERROR_DB = 200, 0.05, 0.5, 4.0
"""Fewest blocks, smallest fraction of them above the noise, smallest fraction of the variance of their levels that ground
explains, and their largest robust standard deviation from the model [dB]."""

LAGS, LEAST_CORRELATION = 8, 0.05
"""Largest distance in blocks at which residuals are correlated, and the correlation below which they are independent."""

ITERATIONS, ROUNDS, STEPS = 40, 3, 1e-3
"""Iterations of Fisher scoring, rounds of its weights, and the step of differences."""

STARTS = np.geomspace(0.01, 0.9, 20), np.arange(0.0, 75.0, 5.0)
"""Heights, relative to the end of the window, and pitches [deg] of the initial search without poses."""

DB = math.log(10) / 10


# ---------------- Level ground


class GroundModel:
    """The mean levels that level ground of reflectivity 1 gives in blocks of cells, without noise.

    Args:
        sonar: the instrument, with its window, gain and patterns.
        bearing_rad: bearings of the blocks ``(columns,)``, or of places in them ``(columns, places)`` [rad].
        edges_m: ranges between the blocks ``(rows + 1,)`` [m].
    """

    def __init__(self, sonar: Sonar, bearing_rad: Array, edges_m: Array) -> None:
        self.sonar, self.columns, self.bearing_rad = sonar, len(bearing_rad), bearing_rad.ravel()
        rows = len(edges_m) - 1
        places = np.arange(rows * SAMPLES[0] + 1) / SAMPLES[0]
        self.edges_m = np.maximum(np.interp(places, np.arange(rows + 1), edges_m), 1e-6)
        self.range_m = (self.edges_m[1:] + self.edges_m[:-1]) / 2
        self.middle_m = float(np.sqrt(max(edges_m[0], sonar.bin_m) * edges_m[-1]))
        # gain of the instrument, and the width of a beam, which grows to the sides of the fan
        undone = np.interp(self.range_m, sonar.range_m, undone_absorption(sonar))
        self._gain = self.range_m ** (sonar.gain_exponent - 3.0) * undone
        self._width = sonar.beam_width_rad / np.cos(self.bearing_rad) * sonar.bin_m / np.diff(self.edges_m)[:, None]
        aside = np.square(np.sin(self.bearing_rad) / np.sin(np.abs(sonar.bearing_rad).max()))
        self.aside = aside.reshape(self.columns, -1).mean(axis=1)
        self._power = 4 if sonar.vertical_pattern == "two_way" else 2
        self._half = half_power((), self._power)
        # most parameters leave the geometry as it is
        self._cells = lru_cache(KEPT)(self._cells_of)
        self._shape = lru_cache(KEPT)(self._shape_of)

    def levels(
        self,
        height_m: float,
        pitch_deg: float,
        roll_deg: float,
        elevation_fov_deg: float,
        absorption_db_per_m: float,
        range_exponent: float,
        least_pattern: float = 0.0,
    ) -> Array:
        """Compute the levels ``(rows, columns)``, 0 where the arc of a cell misses the ground.

        Args:
            height_m: height of the sonar over the ground [m].
            pitch_deg: pitch of the sonar, > 0 looks down [deg].
            roll_deg: roll of the sonar [deg].
            elevation_fov_deg: half-power width over elevation [deg].
            absorption_db_per_m: absorption, one way [dB/m].
            range_exponent: power of the range, relative to the middle of the window, besides that of ``gain_exponent``.
            least_pattern: least power of the pattern over elevation.
        """
        shape = self._shape(height_m, pitch_deg, roll_deg, elevation_fov_deg, least_pattern)
        # what depends on range alone; the sine of grazing is height over range
        along = height_m * self._gain * (self.range_m / self.middle_m) ** range_exponent
        along = along * np.exp(-2 * DB * absorption_db_per_m * self.range_m)
        places = shape.shape[1] // self.columns
        level = shape.reshape(-1, SAMPLES[0], self.columns * places) * along.reshape(-1, SAMPLES[0], 1)
        return np.asarray(level.sum(axis=1).reshape(-1, self.columns, places).sum(axis=2) / (SAMPLES[0] * places))

    def _cells_of(self, height_m: float, pitch_deg: float, roll_deg: float) -> tuple[Array, Array]:
        """Compute elevation [rad] and solid angle [sr] of the ground in each cell, each ``(ranges, bearings)``."""
        geometry = GroundGeometry(
            self.edges_m, self.bearing_rad, self.sonar.bearing, height_m, math.radians(pitch_deg), math.radians(roll_deg)
        )
        # between the elevations at which the two edges of a cell meet the ground
        radius, bearing = np.meshgrid(self.edges_m, self.bearing_rad, indexing="ij")
        elevation = arc_elevation(self.sonar.bearing, bearing, -height_m / radius, geometry.turn[2])
        middle = (elevation[1:] + elevation[:-1]) / 2
        across = np.cos(middle) if self.sonar.bearing == "azimuth" else np.cos(self.bearing_rad)
        return middle, np.abs(np.diff(elevation, axis=0)) * across * self._width

    def _shape_of(
        self, height_m: float, pitch_deg: float, roll_deg: float, elevation_fov_deg: float, least_pattern: float
    ) -> Array:
        """Compute the solid angle times the pattern over elevation [sr], 0 where the arc of a cell misses the ground."""
        middle, solid_angle = self._cells(height_m, pitch_deg, roll_deg)
        x = np.sin(middle) * (self._half / math.sin(math.radians(min(elevation_fov_deg, 179.0)) / 2))
        square = np.square(np.where(np.abs(x) < 1, np.sinc(x), 0.0))
        pattern = np.square(square) if self._power == 4 else square
        return np.asarray(np.nan_to_num(solid_angle * np.maximum(pattern, least_pattern)))


# ---------------- Frames as means of blocks


def reference_of(frames: SonarFrames) -> Array:
    """Return height [m], pitch and roll [rad] that the parameters refer to: medians over the frames; nan where unknown."""
    if frames.poses is None:
        return np.full(3, np.nan)
    reference = np.median(frames.poses[:, 2:5], axis=0)
    if not reference[0] > 0:
        reference[0] = np.nan
    return np.asarray(np.where(np.isfinite(reference), reference, np.nan), dtype=np.float64)


@dataclass
class GroundSolution:
    """Parameters with the largest posterior.

    Attributes:
        values: by name.
        gain_db: gains of the beams ``(columns,)`` [dB], 0 unless fitted.
        fitted_gains: whether they were fitted.
        used: blocks that were used ``(views, rows, columns)``.
        looks: effective looks of a block.
        covariance: of all parameters ``(10, 10)``, in their units.
    """

    values: dict[str, float]
    gain_db: Array
    fitted_gains: bool
    used: NDArray[np.bool_]
    looks: float
    covariance: Array


class GroundProblem:
    """Means of blocks of frames, their model, and its fit.

    Args:
        frames: the recording.
        sonar: the instrument before the calibration.
        fit: what :func:`.fit_sonar` measures.
        reference: result of :func:`reference_of`, of all frames.
        each_beam: whether a block holds one beam rather than several.
    """

    def __init__(
        self, frames: SonarFrames, sonar: Sonar, fit: SonarFit, reference: Array, *, each_beam: bool = False
    ) -> None:
        self.fit = fit
        # 1. Poses that differ, relative to the reference, and the frames of each.
        away = np.zeros((len(frames), 3))
        if frames.poses is not None:
            away = np.nan_to_num(frames.poses[:, 2:5] - reference)
        step = np.array([SAME_POSE[0], SAME_POSE[1], SAME_POSE[1]])
        _, first, self.view_of = np.unique(np.rint(away / step), axis=0, return_index=True, return_inverse=True)
        self.view_of = self.view_of.ravel()
        chosen = np.unique(np.linspace(0, len(first) - 1, MOST_VIEWS).astype(int)) if len(first) > MOST_VIEWS else None
        which = np.arange(len(frames)) if chosen is None else np.flatnonzero(np.isin(self.view_of, chosen))
        views, self.view_of = np.unique(self.view_of[which], return_inverse=True)
        self.away = away[first[views]] * [1.0, 180 / math.pi, 180 / math.pi]
        # 2. Means of blocks, and the blocks that hold levels.
        bins, beams = frames.image.shape[1:]
        tall = max(1, bins // BLOCKS[0])
        wide = 1 if each_beam else math.ceil(beams / BLOCKS[1])
        rows, columns = bins // tall, beams // wide
        self.mean_of_frame = np.zeros((len(which), rows, columns))
        bad = np.zeros((2, *self.mean_of_frame.shape), dtype=bool)

        def averaged(cells: NDArray[Any]) -> Array:
            cut = cells[: rows * tall, : columns * wide].reshape(rows, tall, columns, wide)
            return np.asarray(cut.mean(axis=(1, 3)), dtype=np.float64)

        for k, number in enumerate(which):
            value = np.asarray(frames.image[number], dtype=float) / (255 if frames.image.dtype.kind == "u" else 1)
            # The mean of exponential intensities is that of the clipped ones over the share that is not clipped; of several
            # looks, less is lost. The share is that of the neighbourhood, since leaving out or raising blocks for the chance
            # clipping of their cells would bias the levels.
            clipped = ndimage.uniform_filter(averaged(value >= FULL_SCALE), CLIPPED_OVER, mode="nearest")
            self.mean_of_frame[k] = averaged(decoded(value, sonar)) / (1 - clipped / sonar.looks).clip(1e-3)
            bad[:, k] = clipped > MOST_CLIPPED, averaged(value <= 0) > MOST_EMPTY
        edges = sonar.range_min + np.arange(rows + 1) * tall * sonar.bin_m
        far = edges[:-1] >= (fit.sonar.near_glow_m if fit.sonar.near_glow_db > 0 else 0.0)
        self.valid_of_frame = ~bad.any(axis=0) & far[:, None] & (self.mean_of_frame > 0)
        count = np.bincount(self.view_of)
        sums = np.zeros((len(count), rows, columns))
        np.add.at(sums, self.view_of, self.mean_of_frame)
        self.mean = sums / count[:, None, None]
        missing = np.zeros(sums.shape)
        np.add.at(missing, self.view_of, ~self.valid_of_frame)
        self.valid: NDArray[np.bool_] = missing == 0
        if self.valid.sum() < FEWEST_BLOCKS:
            raise MitsonarError(
                f"a calibration needs at least {FEWEST_BLOCKS} blocks of cells with levels: got {self.valid.sum()} of "
                f"{self.valid.size:,}; {bad[0].mean():.0%} are clipped, {bad[1].mean():.0%} hold cells without a level, "
                f"{1 - far.mean():.0%} are in the near glow; give frames whose levels are neither clipped nor cut off below"
            )
        self._weight = (count / count.mean())[:, None, None]
        # 3. Model, priors and start.
        places = min(wide, SAMPLES[1])
        beam = (np.arange(columns * places) + 0.5) * wide / places - 0.5
        bearing = np.interp(beam, np.arange(beams), frames.bearing_rad).reshape(columns, places)
        self.model = GroundModel(sonar, bearing, edges)
        self.noise_gain = np.interp((edges[1:] + edges[:-1]) / 2, sonar.range_m, gain_of(sonar))[:, None]
        floor = np.where(self.valid, self.mean / self.noise_gain, np.inf)
        noise_db = fit.sonar.noise_level_db
        if noise_db is None:
            noise_db = float(decibels(floor.min())) + fit.full_scale_db
        self.scale_db = fit.full_scale_db - sonar.source_level_db
        absorption = sonar_absorption(sonar)
        # Power that a block receives from others by crosstalk of 0 dB (from, to), and its relative standard deviation over
        # the draws of the gains of pairs, whose powers follow an exponential law.
        leak = np.square(crosstalk_amplitude(sonar, 0.0))[: columns * wide, : columns * wide]
        self._leak = leak.reshape(columns, wide, columns, wide).sum(axis=1).mean(axis=2)
        spread = np.sqrt(np.square(leak).sum(axis=0)) / np.maximum(leak.sum(axis=0), 1e-300)
        self._leak_spread = np.sqrt(np.square(spread).reshape(columns, wide).mean(axis=1) / wide)
        crosstalk_db = sonar.crosstalk_db
        if crosstalk_db is None:
            crosstalk_db = FAINT_LEAK_DB - 10 * math.log10(max(float(self._leak.sum(axis=0).max()), 1.0))
        self.start = {
            "level_db": 0.0, "height_m": float(np.nan_to_num(reference[0], nan=UNKNOWN_HEIGHT * edges[-1])),
            "pitch_deg": math.degrees(np.nan_to_num(reference[1])),
            "roll_deg": math.degrees(np.nan_to_num(reference[2])), "taper_db": sonar.taper_db,
            "elevation_fov_deg": sonar.elevation_fov_deg, "absorption_db_per_m": absorption, "range_exponent": 0.0,
            "noise_level_db": noise_db, "crosstalk_db": crosstalk_db,
        }  # fmt: skip
        self.unknown = {n for n, known in zip(UNKNOWN_POSE_STD, reference, strict=False) if not math.isfinite(known)}
        self.prior_std = PRIOR_STD | {n: UNKNOWN_POSE_STD[n] for n in self.unknown}
        self.prior_std |= {"absorption_db_per_m": max(ABSORPTION_STD[0] * absorption, ABSORPTION_STD[1])}

    # ---------------- Model

    def signal(self, values: dict[str, float], least_pattern: float = 0.0) -> Array:
        """Return the mean levels of the ground ``(views, rows, columns)``, with crosstalk, relative to full scale."""
        names = [name for name in FIELDS if name not in ("level_db", "taper_db", "noise_level_db", "crosstalk_db")]
        images = []
        for height, pitch, roll in self.away:
            one = {name: values[name] for name in names}
            one["height_m"] = max(one["height_m"] + height, 1e-3)
            one["pitch_deg"], one["roll_deg"] = one["pitch_deg"] + pitch, one["roll_deg"] + roll
            images.append(self.model.levels(**one, least_pattern=least_pattern))
        signal = np.stack(images) * 10 ** ((values["level_db"] - self.scale_db) / 10)
        return np.asarray(signal + signal @ (self._leak * 10 ** (values["crosstalk_db"] / 10)))

    def means(self, values: dict[str, float], gain_db: Array) -> tuple[Array, Array]:
        """Return the mean levels ``(views, rows, columns)``, and the fraction of them that is signal.

        Taper and gains of the beams act on signal and noise, as in the model coherent.
        """
        signal = self.signal(values)
        noise = 10 ** ((values["noise_level_db"] - self.fit.full_scale_db) / 10) * self.noise_gain
        mean = signal + np.maximum(noise, 1e-300)
        return mean * np.exp(DB * (gain_db - values["taper_db"] * self.model.aside)), signal / mean

    def within_pattern(self, values: dict[str, float]) -> NDArray[np.bool_]:
        """Return the blocks ``(views, rows, columns)`` whose ground is in the main lobe, or too faint to matter."""
        signal = self.signal(values)
        edge = self.signal(values, PATTERN_EDGE)
        noise = 10 ** ((values["noise_level_db"] - self.fit.full_scale_db) / 10) * self.noise_gain
        unknown = (edge > 1.02 * signal) & (edge > NEGLIGIBLE * noise)
        # blocks next to them hold some of their echoes, by pulse and side lobes
        unknown[:, 1:] |= unknown[:, :-1]
        unknown[:, :-1] |= unknown[:, 1:]
        return np.asarray(~unknown)

    # ---------------- Fit

    def solve(
        self, fixed: dict[str, float], start: dict[str, float] | None = None, *, beam_gains: bool = False
    ) -> GroundSolution:
        """Maximise the posterior of the parameters that are not fixed, from a start or from the priors."""
        free = [name for name in FIELDS if name not in fixed]
        candidates = [start | fixed] if start is not None else self._starts(fixed)
        solutions = [
            GroundSolution(one, np.zeros(self.mean.shape[2]), False, self.valid, 1.0, np.zeros(0)) for one in candidates
        ]
        if len(solutions) > 1:
            solutions = [self._climb(self._weighted(one, len(free)), free) for one in solutions]
        solution = replace(min(solutions, key=lambda one: self._misfit(one.values)), fitted_gains=beam_gains)
        # alternate between the fit, and what is an outlier and how much blocks vary
        for _ in range(ROUNDS):
            solution = self._climb(self._weighted(solution, len(free)), free)
        return solution

    def _starts(self, fixed: dict[str, float]) -> list[dict[str, float]]:
        """Return starts: the priors with a matching level; of unknown places, the best of a grid."""
        grid = {"height_m": STARTS[0] * self.model.edges_m[-1], "pitch_deg": STARTS[1]}
        heights, pitches = (
            [fixed.get(name, self.start[name])] if name in fixed or name not in self.unknown else list(places)
            for name, places in grid.items()
        )
        scored = []
        for height in heights:
            for pitch in pitches:
                values = self.start | fixed | {"height_m": height, "pitch_deg": pitch}
                if "level_db" not in fixed:
                    values["level_db"] = self._level(values)
                scored.append((self._misfit(values), values))
        scored.sort(key=lambda one: one[0])
        return [values for _, values in scored[: 4 if len(scored) > 1 else 1]]

    def _misfit(self, values: dict[str, float]) -> float:
        """Return the mean absolute difference of the logarithms of blocks and model, without gains of beams."""
        mean, _ = self.means(values, np.zeros(self.mean.shape[2]))
        return float(np.abs(np.log(self.mean[self.valid] / mean[self.valid])).mean())

    def _level(self, values: dict[str, float]) -> float:
        """Return the level at which the brighter half of the ground has the levels of the frames [dB]."""
        signal = self.signal(values | {"level_db": 0.0})
        lit = self.valid & (signal > 0)
        if not lit.any():
            return 0.0
        lit &= signal >= np.median(signal[lit])
        return float(np.median(decibels(self.mean[lit] / signal[lit])))

    def _weighted(self, solution: GroundSolution, parameters: int) -> GroundSolution:
        """Return a solution with outliers left out, and the looks that the spread and correlation of blocks give."""
        mean, _ = self.means(solution.values, solution.gain_db)
        judged = self.valid & self.within_pattern(solution.values)
        if not judged.any():  # a start whose pattern misses all levels
            return replace(solution, used=judged, looks=1.0)
        error = np.log(np.where(judged, self.mean, 1.0) / mean)
        middle = float(np.median(error[judged]))
        spread = 1.4826 * float(np.median(np.abs(error[judged] - middle)))
        used = judged & (np.abs(error - middle) <= OUTLIER * max(spread, 1e-6))
        residual = np.where(used, self.mean / mean - 1, 0.0)
        freedom = max(1, int(used.sum()) - parameters - (len(solution.gain_db) if solution.fitted_gains else 0))
        variance = float((self._weight * np.square(residual)).sum()) / freedom
        correlated = math.prod(_correlation_sum(residual, axis) for axis in (1, 2))
        return replace(solution, used=used, looks=1 / max(variance * correlated, 1e-9))

    def _climb(self, solution: GroundSolution, free: Sequence[str]) -> GroundSolution:
        """Maximise the posterior by damped Fisher scoring, for given blocks and looks."""
        values, gain_db, weight = dict(solution.values), solution.gain_db, solution.looks * self._weight * solution.used
        logs = np.array([name in POSITIVE for name in free])

        def vector(values: dict[str, float]) -> Array:
            return np.array([math.log(values[n]) if n in POSITIVE else values[n] for n in free])

        def moved(change: Array) -> dict[str, float]:
            x = vector(values) + change
            return values | {n: math.exp(min(v, 12.0)) if n in POSITIVE else float(v) for n, v in zip(free, x, strict=True)}

        def deviation(values: dict[str, float]) -> Array:
            away = {n: math.log(values[n] / self.start[n]) if n in POSITIVE else values[n] - self.start[n] for n in free}
            return np.array([*(away | {"level_db": 0.0} if "level_db" in away else away).values()])

        precision = np.array([1 / self.prior_std[n] ** 2 for n in free])
        gain_precision = 1 / BEAM_GAIN_STD_DB**2

        def objective(values: dict[str, float], gain_db: Array) -> float:
            mean, _ = self.means(values, gain_db)
            likelihood = -float((weight * (self.mean / mean + np.log(mean))).sum())
            penalty = float((precision * deviation(values) ** 2).sum() + gain_precision * (gain_db**2).sum())
            return likelihood - penalty / 2

        best, damping, information = objective(values, gain_db), 1e-3, np.diag(precision)
        for _ in range(ITERATIONS):
            # 1. Derivatives of the logarithm of the means, and the score.
            mean, _ = self.means(values, gain_db)
            residual = self.mean / mean - 1
            slopes = []
            for k in range(len(free)):
                step = np.zeros(len(free))
                step[k] = STEPS
                high, low = (np.log(self.means(moved(sign * step), gain_db)[0]) for sign in (1, -1))
                slopes.append((high - low) / (2 * STEPS))
            slope = np.stack(slopes)
            score = np.einsum("pvrc,vrc->p", slope, weight * residual) - precision * deviation(values)
            information = np.einsum("pvrc,qvrc,vrc->pq", slope, slope, weight, optimize=True) + np.diag(precision)
            # 2. Gains of the beams are eliminated: each affects its column alone.
            if solution.fitted_gains:
                gain_score = DB * (weight * residual).sum(axis=(0, 1)) - gain_precision * gain_db
                gain_information = DB**2 * weight.sum(axis=(0, 1)) + gain_precision
                cross = DB * np.einsum("pvrc,vrc->pc", slope, weight)
                information = information - (cross / gain_information) @ cross.T
                score = score - (cross / gain_information) @ gain_score
            # 3. A damped step that raises the posterior.
            improved = False
            while damping < 1e8 and not improved:
                damped = information + damping * np.diag(np.diag(information))
                change = np.clip(np.linalg.solve(damped, score), -np.where(logs, 0.5, 10.0), np.where(logs, 0.5, 10.0))
                gains = gain_db
                if solution.fitted_gains:
                    gains = gain_db + (gain_score - cross.T @ change) / gain_information
                trial = moved(change)
                value = objective(trial, gains)
                improved = math.isfinite(value) and value > best
                damping = damping / 10 if improved else damping * 10
            if not improved:
                break
            rise, best, values, gain_db = value - best, value, trial, gains
            if rise < 1e-6:
                break
        # The inverse of the information, widened because the gains of pairs are drawn: each column leaks more or less.
        inverse = np.linalg.inv(information)
        mean, _ = self.means(values, gain_db)
        none, _ = self.means(values | {"crosstalk_db": NO_CROSSTALK_DB}, gain_db)
        odd = weight * (1 - none / mean) * self._leak_spread
        odd_score = np.einsum("pvrc,vrc->pc", slope, odd)
        if solution.fitted_gains:
            odd_score -= cross / gain_information * (DB * odd.sum(axis=(0, 1)))
        shift = inverse @ odd_score
        inverse = inverse + shift @ shift.T
        # the covariance, in the parameters' units
        scale = np.array([values[n] if n in POSITIVE else 1.0 for n in free])
        index = [list(FIELDS).index(n) for n in free]
        covariance = np.zeros((len(FIELDS), len(FIELDS)))
        covariance[np.ix_(index, index)] = inverse * scale[:, None] * scale
        return replace(solution, values=values, gain_db=gain_db, covariance=covariance)

    # ---------------- Judgement

    def check(self, solution: GroundSolution) -> None:
        """Raise an error if the frames do not show level ground above the noise."""
        mean, part = self.means(solution.values, solution.gain_db)
        lit = float((part[self.valid] > 0.5).mean())
        if lit < LEAST_SIGNAL:
            raise MitsonarError(
                f"the frames show no ground above the noise: {lit:.0%} of the blocks, {LEAST_SIGNAL:.0%} are needed; give "
                "frames of level ground, and check the height and the pitch"
            )
        judged = self.valid & self.within_pattern(solution.values)
        level = np.log((self.mean / self.noise_gain)[judged])
        error = np.log(self.mean[judged] / mean[judged])
        spread_db = 1.4826 * float(np.median(np.abs(error - np.median(error)))) / DB
        explained = 1 - float(np.square(error).mean() / max(level.var(), 1e-12))
        if explained < LEAST_EXPLAINED or spread_db > MOST_ERROR_DB:
            misfits = []
            if explained < LEAST_EXPLAINED:
                share = max(explained, 0.0)
                misfits.append(f"it explains {share:.0%} of the variance of the levels ({LEAST_EXPLAINED:.0%} are needed)")
            if spread_db > MOST_ERROR_DB:
                differ, most = spread_db / 1.4826, MOST_ERROR_DB / 1.4826
                misfits.append(f"half of the blocks differ by more than {differ:.1f} dB ({most:.1f} are allowed)")
            raise MitsonarError(
                f"the frames do not show level ground: {', and '.join(misfits)}; give frames of level ground without large "
                "objects, or their height and pitch where these are known"
            )

    def looks_of_frame(self, solution: GroundSolution) -> float:
        """Return the looks of a block of one frame, by its spread about the model."""
        mean, _ = self.means(solution.values, solution.gain_db)
        used = self.valid_of_frame & solution.used[self.view_of]
        residual = (self.mean_of_frame / mean[self.view_of] - 1)[used]
        return 1 / max(float(np.square(residual).mean()), 1e-9)

    def scores(self, solutions: Sequence[GroundSolution], looks: Sequence[float]) -> list[tuple[float, float]]:
        """Return log likelihood per block and rms error [dB] of solutions on these frames.

        Blocks count that no solution takes for an outlier, or for ground beyond its pattern: the sharper the law of a
        solution, the more a stone would count against it. The logarithm of a mean of L looks of a Gamma law has the variance
        trigamma(L), so the rms error has a floor.
        """
        means = [self.means(one.values, one.gain_db)[0][self.view_of] for one in solutions]
        shown, used = self.mean_of_frame, self.valid_of_frame
        for solution in solutions:
            used = used & self.within_pattern(solution.values)[self.view_of]
        if not used.any():
            return [(math.nan, math.nan)] * len(solutions)
        inside = np.ones(used.shape, dtype=bool)
        for mean in means:
            error = np.log(np.where(used, shown, 1.0) / mean)
            middle = np.median(error[used])
            inside &= np.abs(error - middle) <= OUTLIER * 1.4826 * np.median(np.abs(error[used] - middle))
        used = used & inside
        scores = []
        for mean, one in zip(means, looks, strict=True):
            x, y = mean[used], shown[used]
            law = one * np.log(one / x) + (one - 1) * np.log(y) - one * y / x - special.gammaln(one)
            scores.append((float(law.mean()), float(np.sqrt(np.square(decibels(y / x)).mean()))))
        return scores


def _correlation_sum(residual: Array, axis: int) -> float:
    """Return the sum of the correlations of residuals ``(views, rows, columns)`` at all lags along an axis, at least 1."""
    values = np.moveaxis(residual, axis, 0)
    power = max(float(np.square(values).mean()), 1e-300)
    total = 1.0
    for lag in range(1, min(LAGS, len(values) - 1) + 1):
        correlation = float((values[lag:] * values[:-lag]).mean()) / power
        if correlation < LEAST_CORRELATION:
            break
        total += 2 * correlation
    return total
