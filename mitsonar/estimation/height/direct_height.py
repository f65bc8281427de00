"""Height estimators: one frame in, the height over the ground out. ``direct`` fits first return and fall-off of levels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from mitsonar.errors import MitsonarError, argument
from mitsonar.estimation.height.floor_profile import FloorProfile
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import SEGMENTS, Segment, Whole
from mitsonar.records.frames import SonarFrames, ViewFrames

__all__ = ["Above", "DirectHeight", "HeightEstimate", "HeightEstimator", "profile_of", "rejection_of_profile"]

Above = SonarFrames | ViewFrames
"""One frame, or one ping of several views."""

CANDIDATES = 400
"""Number of heights that are tried first, at equal ratios."""

PARTS = 40
"""Number of heights between such ends into which a profile is resolved."""

PASSES = (((0.75, 1.2), 0.75), ((0.75, 1.1), 0.7))
"""Ends of these heights, as parts of the height found before, and the part of the ground's echo that comes from above the
floor: tops and flanks of what stands on it. Noise spreads parts to all heights, so that the second pass has a lower end
above. On rocky fields from 1 to 10 m and hulls, without noise and with much, these err least."""

SPREAD = 0.1
"""Distance of the quantiles, to either side, that give the standard deviation."""

KEPT = 16
"""Attitudes, to a milliradian, whose profiles of level ground are kept."""

FINEST = 0.01
"""Least standard deviation, as part of the height."""

LEAST = 0.5
"""Least correlation of a profile with the fitted ground for a valid height."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HeightEstimate:
    """The estimate of a height from one frame.

    Attributes:
        height_m: of the sonar over the ground; nan where nothing can be estimated.
        std_m: its standard deviation; nan where unknown.
        valid: False where the height must not be used.
        reason: of a rejection.
    """

    height_m: float
    std_m: float
    valid: bool = True
    reason: str = ""


class HeightEstimator(Protocol):
    """Estimates the height from one frame.

    Attributes:
        inputs: what it needs beside the frame.
    """

    inputs: str

    @property
    def views(self) -> tuple[str, ...] | None:
        """Return the views that it reads; None: a single image."""

    @property
    def kind(self) -> str:
        """Return what it reads of views: ``image`` or ``vector``."""

    def height(self, frame: Above) -> HeightEstimate:
        """Estimate the height of one frame.

        Raises:
            MitsonarError: not one frame, or one without what the estimator needs.
        """


@dataclass
class DirectHeight:
    """Fits the height at which level ground has the range profile of the frame: first echo and fall-off of levels.

    Objects on the ground look like ground nearer to the sonar. The profile is therefore resolved into ground at many heights
    (non-negative least squares, with an even background for noise), and the floor is a high quantile of them. Only the sum
    over beams is used, so that a frame and its vector give the same height.

    Attributes:
        pitch_rad: of the sonar; None: that of the frames.
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
        guess = _nearest_alike(profile, floor, edges)
        if guess is None:
            return HeightEstimate(np.nan, np.nan, False, "the window shows no ground")
        height = guess
        for around, lowest in PASSES:
            heights = height * np.geomspace(*around, PARTS)
            ground = floor.at(heights, edges).T
            part = _resolved(ground, profile)
            if not part.any():
                return HeightEstimate(np.nan, np.nan, False, "the levels along range are not those of ground")
            share = np.cumsum(part) / part.sum()
            low, height, high = np.interp([lowest - SPREAD, lowest, lowest + SPREAD], share, heights)
        alike = float(np.corrcoef(ground @ part, profile)[0, 1])
        std = float(max((high - low) / 2, FINEST * height))
        if not alike >= LEAST:
            return HeightEstimate(float(height), std, False, f"levels along range are those of ground by {alike:.2f} only")
        return HeightEstimate(float(height), std)

    def _floor_of(self, frame: Above, sonar: Sonar) -> FloorProfile:
        """Return the profile of level ground for this sonar, cached for the next frames."""
        pose = None if frame.poses is None else frame.poses[0]
        pitch = self.pitch_rad if self.pitch_rad is not None else (None if pose is None else float(pose[3]))
        if pitch is None or not np.isfinite(pitch):
            raise MitsonarError(f"the height needs the pitch: the frames lack poses; give {argument('pitch_deg')}")
        roll = 0.0 if pose is None or not np.isfinite(pose[4]) else float(pose[4])
        views = tuple(frame.values) if isinstance(frame, ViewFrames) else ()
        pitch, roll = round(pitch, 3), round(roll, 3)
        key = (sonar.model_dump_json(), views, pitch, roll)
        if key not in self._floors:
            if len(self._floors) >= KEPT:
                self._floors.clear()
            self._floors[key] = FloorProfile(sonar, pitch, roll, _weight_of(sonar, views))
        return self._floors[key]


def profile_of(frame: Above) -> tuple[Array, Sonar]:
    """Return the levels along range ``(bins,)``, summed over beams and views, and the sonar.

    Raises:
        MitsonarError: not one frame, levels that are not linear or not finite.
    """
    if len(frame) != 1:
        raise MitsonarError(f"a height is that of one frame: got {len(frame)}")
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
    """Return why a profile shows nothing; empty where it shows something."""
    return "" if np.ptp(profile) > 0 else "nothing in the frame to tell a height from"


def _weight_of(sonar: Sonar, views: tuple[str, ...]) -> Array | None:
    """Return how often each ray is in the sum of the views; None where all are equal.

    Raises:
        MitsonarError: receivers of a bistatic sonar, whose ranges are others.
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
    """Return the part of a profile that is ground at each height ``(heights,)``, beside an even background."""
    even = np.full((len(profile), 1), 1 / len(profile))
    return np.asarray(nnls(np.hstack([ground, even]), profile / profile.max())[0][:-1])


def _nearest_alike(profile: Array, floor: FloorProfile, edges: Array) -> float | None:
    """Return the height whose ground correlates best with a profile; None where no height shows ground in the window."""
    heights = np.geomspace(max(edges[0], edges[-1] / 1e3) / floor.farthest, edges[-1] / floor.nearest, CANDIDATES)
    ground = floor.at(heights, edges)
    ground -= ground.mean(axis=1, keepdims=True)
    size = np.linalg.norm(ground, axis=1)
    lit = size > 0
    if not lit.any():
        return None
    alike = (ground[lit] / size[lit, None]) @ (profile - profile.mean())
    return float(heights[lit][int(alike.argmax())])
