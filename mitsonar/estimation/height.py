"""How the height over the ground is estimated from one frame, directly or by a trained network."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from mitsonar.errors import MitsonarError, argument
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import SEGMENTS, Segment, Whole, directions
from mitsonar.motion.pose import Pose, vehicle_rotation
from mitsonar.records.frames import SonarFrames, ViewFrames

__all__ = [
    "Above",
    "DirectHeight",
    "FloorProfile",
    "HeightEstimate",
    "HeightEstimator",
    "heights_csv",
    "heights_lines",
    "profile_of",
    "rejection_of_profile",
]


Above = SonarFrames | ViewFrames
"""One frame, or one ping of several views."""

CANDIDATES = 400
"""Number of heights of the initial search, spaced geometrically."""

PARTS = 40
"""Number of heights into which a profile is resolved in one pass."""

PASSES = (((0.75, 1.2), 0.75), ((0.75, 1.1), 0.7))
"""Passes of :class:`DirectHeight`.

Each holds the ends of the heights, as fractions of the previous estimate, and the fraction of the ground's echo that comes
from above the floor: tops and flanks of objects on it. Noise spreads fractions over all heights, so the second pass
ends at a lower height. These values err least on rocky fields from 1 to 10 m and on hulls, without noise and in high noise.
"""

QUANTILE_DISTANCE = 0.1
"""Distance of the quantiles, to either side, that give the standard deviation."""

MAX_CACHED_FLOORS = 16
"""Number of attitudes, to a milliradian, whose profiles of level ground are cached."""

LEAST_RELATIVE_STD = 0.01
"""Smallest standard deviation, as a fraction of the height."""

LEAST_CORRELATION = 0.5
"""Smallest correlation of a profile with the fitted ground for a valid height."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HeightEstimate:
    """The estimated height from one frame.

    Attributes:
        height_m: height of the sonar over the ground; nan where nothing can be estimated.
        std_m: its standard deviation; nan where unknown.
        valid: False where the height must not be used.
        reason: why the estimate was rejected; empty if it is valid.
    """

    height_m: float
    std_m: float
    valid: bool = True
    reason: str = ""


class HeightEstimator(Protocol):
    """Interface of an estimator of the height from one frame.

    Attributes:
        inputs: what it needs besides the frame.
    """

    inputs: str

    @property
    def views(self) -> tuple[str, ...] | None:
        """Return the views it reads; None: a single image."""

    @property
    def kind(self) -> str:
        """Return what it reads of views: ``image`` or ``vector``."""

    def height(self, frame: Above) -> HeightEstimate:
        """Estimate the height of one frame.

        Raises:
            MitsonarError: not one frame, or a frame that lacks what the estimator needs.
        """


@dataclass
class DirectHeight:
    """Fits the height at which level ground has the range profile of the frame: first echo and fall-off of levels.

    Objects on the ground look like ground nearer to the sonar. The profile is therefore resolved into ground at many heights
    (non-negative least squares, with a uniform background for noise), and the floor is a high quantile of them. Only the sum
    over beams is used, so that a frame and its vector give the same height.

    Attributes:
        pitch_rad: pitch of the sonar; None: that of the frames.
        views: see :class:`HeightEstimator`.
    """

    pitch_rad: float | None = None
    views: tuple[str, ...] | None = None
    kind: str = "vector"
    inputs: str = field(default="pitch", init=False)

    def __post_init__(self) -> None:
        self._floors: dict[tuple[str, tuple[str, ...], float, float], FloorProfile] = {}

    def height(self, frame: Above) -> HeightEstimate:
        """Estimate the height over the floor.

        Raises:
            MitsonarError: not one frame; neither a given pitch nor poses; a sonar whose field of view holds no ground.
        """
        profile, sonar = profile_of(frame)
        reason = rejection_of_profile(profile)
        if reason:
            return HeightEstimate(np.nan, np.nan, False, reason)
        floor = self._floor_of(frame, sonar)
        edges = np.linspace(sonar.range_min, sonar.range_max, len(profile) + 1)
        # initial search: the height whose ground correlates best with the profile
        guess = _best_matching_height(profile, floor, edges)
        if guess is None:
            return HeightEstimate(np.nan, np.nan, False, "the window shows no ground")
        height = guess
        # resolve the profile into ground at heights around the estimate; the floor is a high quantile of them
        for span, lowest in PASSES:
            heights = height * np.geomspace(*span, PARTS)
            ground = floor.levels_at(heights, edges).T
            parts = _resolved(ground, profile)
            if not parts.any():
                return HeightEstimate(np.nan, np.nan, False, "the levels along range do not match those of ground")
            cumulative = np.cumsum(parts) / parts.sum()
            low, height, high = np.interp(
                [lowest - QUANTILE_DISTANCE, lowest, lowest + QUANTILE_DISTANCE], cumulative, heights
            )
        # accept the height only if the sum of these grounds resembles the profile
        correlation = float(np.corrcoef(ground @ parts, profile)[0, 1])
        std = float(max((high - low) / 2, LEAST_RELATIVE_STD * height))
        if not correlation >= LEAST_CORRELATION:
            return HeightEstimate(
                float(height), std, False, f"levels along range correlate with those of ground by {correlation:.2f} only"
            )
        return HeightEstimate(float(height), std)

    def _floor_of(self, frame: Above, sonar: Sonar) -> FloorProfile:
        """Return the profile of level ground for this sonar, cached for the next frames."""
        pose = None if frame.poses is None else frame.poses[0]
        pitch = self.pitch_rad if self.pitch_rad is not None else (None if pose is None else float(pose[3]))
        if pitch is None or not np.isfinite(pitch):
            raise MitsonarError(f"the height needs the pitch, but the frames have no poses: give {argument('pitch_deg')}")
        roll = 0.0 if pose is None or not np.isfinite(pose[4]) else float(pose[4])
        views = tuple(frame.values) if isinstance(frame, ViewFrames) else ()
        pitch, roll = round(pitch, 3), round(roll, 3)
        key = (sonar.model_dump_json(), views, pitch, roll)
        if key not in self._floors:
            if len(self._floors) >= MAX_CACHED_FLOORS:
                self._floors.clear()
            self._floors[key] = FloorProfile(sonar, pitch, roll, _weight_of(sonar, views))
        return self._floors[key]


def profile_of(frame: Above) -> tuple[Array, Sonar]:
    """Return the levels along range ``(bins,)``, summed over beams and views, and the sonar.

    Raises:
        MitsonarError: not one frame, or levels that are not linear or not finite.
    """
    if len(frame) != 1:
        raise MitsonarError(f"a height is estimated from one frame: got {len(frame)}")
    if isinstance(frame, ViewFrames):
        return _finite(frame.profiles().sum(axis=(0, 1), dtype=float)), next(iter(frame.sonars.values()))
    if frame.level != "linear":
        raise MitsonarError(f"heights are estimated from linear images: got {frame.level}; convert them first")
    profile = frame.image[0].sum(axis=1, dtype=float)
    half = (frame.range_m[-1] - frame.range_m[0]) / max(1, len(frame.range_m) - 1) / 2
    window = {"range_min": max(0.0, float(frame.range_m[0] - half)), "range_max": float(frame.range_m[-1] + half)}
    beams = {"beams": len(frame.bearing_rad), "range_bins": len(frame.range_m)}
    return _finite(profile), frame.sonar.replace(**window, **beams)


def _finite(profile: Array) -> Array:
    if not np.isfinite(profile).all():
        raise MitsonarError("the frame holds nan or inf: set pixels without echo to 0")
    return profile


def rejection_of_profile(profile: Array) -> str:
    """Return why a profile holds no information; empty if it does."""
    return "" if np.ptp(profile) > 0 else "nothing in the frame from which to estimate a height"


def _weight_of(sonar: Sonar, views: tuple[str, ...]) -> Array | None:
    """Return how often each ray counts in the sum of the views; None if all count equally.

    Raises:
        MitsonarError: receivers of a bistatic sonar, which measure different ranges.
    """
    if views in ((), (Whole.name,)):
        return None
    others = [view for view in views if view not in SEGMENTS]
    if others:
        raise MitsonarError(
            f"heights are estimated directly from a sonar's own image or portions of its view: got the receiver {others[0]}"
        )
    rays = np.sum([Segment(sonar, view).member for view in views], axis=0, dtype=float)
    shape = (sonar.rays_per_beam, sonar.beams, -1)
    return np.asarray(rays.reshape(shape).sum(axis=2))


def _resolved(ground: Array, profile: Array) -> Array:
    """Return the fraction of a profile that is ground at each height ``(heights,)``, besides a uniform background."""
    uniform = np.full((len(profile), 1), 1 / len(profile))
    return np.asarray(nnls(np.hstack([ground, uniform]), profile / profile.max())[0][:-1])


def _best_matching_height(profile: Array, floor: FloorProfile, edges: Array) -> float | None:
    """Return the height whose ground correlates best with a profile; None if no height shows ground in the window."""
    heights = np.geomspace(max(edges[0], edges[-1] / 1e3) / floor.farthest, edges[-1] / floor.nearest, CANDIDATES)
    ground = floor.levels_at(heights, edges)
    ground -= ground.mean(axis=1, keepdims=True)
    norms = np.linalg.norm(ground, axis=1)
    visible = norms > 0
    if not visible.any():
        return None
    correlations = (ground[visible] / norms[visible, None]) @ (profile - profile.mean())
    return float(heights[visible][int(correlations.argmax())])


# ---------------- Range profile of level ground


MAX_RAYS = 256
"""Largest number of beams, and of rays per beam, that are used."""

FARTHEST = 40.0
"""Largest ratio of range to height of the ground."""


class FloorProfile:
    """The range profile of level ground of constant reflectivity, as a curve over range / height.

    It holds the first return and the fall-off of levels at any height. Levels are those of
    :func:`mitsonar.acoustics.levels.level`: a ray's cosine in the ``thesis`` model; cosine, solid angle, spreading and gain
    in ``physical``.

    Args:
        sonar: the instrument.
        pitch_rad: pitch of the sonar, > 0 looks down.
        roll_rad: roll of the sonar.
        weight: weight of its rays in the profile ``(rays_per_beam, beams)``, rows from the highest elevation down; None: all
            equal.

    Raises:
        MitsonarError: no ray meets the ground.
    """

    def __init__(self, sonar: Sonar, pitch_rad: float, roll_rad: float = 0.0, weight: Array | None = None) -> None:
        self.sonar, self.pitch_rad, self.roll_rad = sonar, pitch_rad, roll_rad
        # directions of a subset of rays, and the downward component of each
        rows, beams = (np.unique(np.linspace(0, n - 1, min(n, MAX_RAYS)).astype(int)) for n in (self._rows, sonar.beams))
        elevation = (0.5 - (rows + 0.5) / self._rows) * np.radians(sonar.elevation_fov_deg)
        bearing = sonar.bearing_rad[beams]
        rays = directions(sonar.bearing, bearing[None, :], elevation[:, None])
        down = -(vehicle_rotation(Pose(0, 0, 0, pitch_rad, roll_rad, 0)).apply(rays.reshape(-1, 3))[:, 2])
        # weight of each ray: views, and in the physical model its solid angle
        weights = np.ones(rays.shape[:2]) if weight is None else weight[np.ix_(rows, beams)]
        angle = elevation[:, None] if sonar.bearing == "azimuth" else bearing[None, :]
        weights = weights * (1.0 if sonar.model == "thesis" else np.cos(angle))
        # rays that meet the ground, nearest first
        on_ground = (down > 1 / FARTHEST) & (weights.ravel() > 0)
        if not on_ground.any():
            raise MitsonarError(f"at a pitch of {np.degrees(pitch_rad):g} deg the sonar sees no level ground")
        order = np.argsort(-down[on_ground])
        self._down, self._part = down[on_ground][order], weights.ravel()[on_ground][order]

    @property
    def _rows(self) -> int:
        return max(1, self.sonar.rays_per_beam)

    @cached_property
    def _along(self) -> tuple[Array, Array]:
        """Return range over height of the rays in increasing order, and the cumulative sum of their levels."""
        range_over_height = 1 / self._down
        gain = 1.0 if self.sonar.model == "thesis" else range_over_height ** (self.sonar.gain_exponent - 2)
        return range_over_height, np.cumsum(self._part * self._down * gain)

    @property
    def nearest(self) -> float:
        """Return the range of the first return divided by the height."""
        return float(self._along[0][0])

    @property
    def farthest(self) -> float:
        """Return the range of the last return divided by the height."""
        return float(self._along[0][-1])

    def levels_at(self, height_m: float | Array, edges_m: Array) -> Array:
        """Return the levels of the bins between edges ``(..., bins)`` at heights ``(...)`` [m]; their sum is at most 1."""
        range_over_height, total = self._along
        edges_over_height = np.asarray(edges_m) / np.asarray(height_m, dtype=float)[..., None]
        return np.asarray(np.diff(np.interp(edges_over_height, range_over_height, total, left=0.0), axis=-1) / total[-1])


# ---------------- Measured heights as a table, and in sentences


def heights_csv(time_s: Array, estimates: list[HeightEstimate], true: Array | None) -> str:
    """Return a table with a line a frame; cells are empty where a number is not known.

    Args:
        time_s: of the frames ``(n,)`` [s].
        estimates: of the frames.
        true: true heights ``(n,)`` [m], where known.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["frame", "time_s", "height_m", "std_m", "believed", "reason", "true_z_m"])
    for k, one in enumerate(estimates):
        numbers = [f"{value:.6g}" if np.isfinite(value) else "" for value in (one.height_m, one.std_m)]
        z = "" if true is None else f"{true[k]:.6g}"
        table.writerow([k, f"{time_s[k]:.9f}", *numbers, int(one.valid), one.reason, z])
    return text.getvalue()


def heights_lines(estimates: list[HeightEstimate], true: Array | None) -> list[str]:
    """Return sentences on the heights of all frames.

    Args:
        estimates: of the frames.
        true: true z ``(n,)`` [m], where known; it is no height if it is 0 or less, as below a surface at z = 0.
    """
    valid = np.array([one.valid for one in estimates], dtype=bool)
    heights = np.array([one.height_m for one in estimates])[valid]
    lines = []
    for reason in dict.fromkeys(one.reason for one in estimates if not one.valid):
        lines.append(f"rejected, {sum(one.reason == reason for one in estimates):,} frames: {reason}")
    if len(heights):
        lines.append(f"height {heights.min():.3f} .. {heights.max():.3f} m, median {np.median(heights):.3f} m")
    if true is not None and len(heights) and (true > 0).all():
        error = heights - true[valid]
        rmse, median = 100 * np.sqrt((error**2).mean()), 100 * np.median(np.abs(error))
        lines.append(f"against the true z: RMSE {rmse:.2f} cm, median {median:.2f} cm, bias {100 * error.mean():+.2f} cm")
    return lines
