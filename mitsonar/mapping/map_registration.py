"""Registration of a frame to the landmarks of a local map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.estimation.image.patches import PatchImage
from mitsonar.geometry.fan import Views, projection_of
from mitsonar.mapping.bundle_adjustment import PLANAR, cauchy, track_weight
from mitsonar.mapping.landmarks import Found, Landmarks

__all__ = ["FEWEST", "PAIR_STD", "Registered", "level_turn", "registered"]

Array = NDArray[np.float64]

FEWEST = 12
"""Fewest landmarks by which a frame is registered."""

LEAST_FOUND = 0.5
"""Least part of the landmarks in view that a frame must show. Without noise it is nine tenths; with noise of pixels that
hides the ground, a fifth."""

ROUNDS, STILL = 8, 1e-6
"""Gauss-Newton iterations of a registration, and the step below which they end [m, rad]."""

PAIR_SHARE = 0.1
PAIR_STD = np.array([1e-3, 1e-3, np.radians(0.03)])
"""Share of the information of the motion between two frames that counts: the map has seen the same frames; least standard
deviations of that motion [m, m, rad]."""

GATE = 16.0
"""Squared error, in covariances, beyond which a landmark is not where it was expected: noise that looks alike."""

ASTRAY = 25.0
"""Squared distance, in covariances, of the map's pose from the prediction, beyond which the map is not believed."""


@dataclass(frozen=True)
class Registered:
    """A frame's pose by the map, what it shows, its squared errors in covariances, and why it is not used."""

    pose: Array
    found: Found
    squared: Array
    reason: str = ""


def registered(landmarks: Landmarks, image: PatchImage, expected: Array, spread: Array) -> Registered:
    """Find the landmarks, and the pose from which the sonar receives them there.

    Args:
        landmarks: of the map.
        image: the frame.
        expected: its pose as predicted ``(6,)``.
        spread: covariance of starboard, forward [m], heading [rad] of the prediction ``(3, 3)``.
    """
    turn = np.eye(3)
    turn[:2, :2] = level_turn(expected[5])
    predicted = turn.T @ spread @ turn
    found, shown = landmarks.find(image, Views.of(expected))
    found = found.take(_residuals(landmarks, found, expected, predicted).squared < GATE)
    pose, prior = expected.copy(), PAIR_SHARE * np.linalg.inv(predicted)
    needed = max(FEWEST, int(LEAST_FOUND * shown))
    if len(found.landmark) < needed:
        few = f"the map finds {len(found.landmark)} of {shown} landmarks, {needed} are needed"
        return Registered(pose, found, np.zeros(len(found.landmark)), few)
    for _ in range(ROUNDS):
        at = _residuals(landmarks, found, pose, None)
        weight = cauchy(at.squared) * track_weight(landmarks.faults[found.landmark])
        weighted = at.by_pose.transpose(0, 2, 1) @ (at.inverse * weight[:, None, None])
        normal = (weighted @ at.by_pose).sum(axis=0) + prior
        pull = (weighted @ at.error[:, :, None])[:, :, 0].sum(axis=0) - prior @ (pose - expected)[PLANAR]
        step = np.linalg.solve(normal, pull)
        pose[PLANAR] += step
        if np.abs(step).max() < STILL:
            break
    off = (pose - expected)[PLANAR]
    if off @ np.linalg.solve(predicted, off) > ASTRAY:
        return Registered(expected, found, at.squared, "the map and the motion between two frames contradict each other")
    return Registered(pose, found, at.squared)


class _Residuals(NamedTuple):
    """Of landmarks at a pose: errors ``(n, 2)``, inverse covariances, squares in covariances, derivatives by the pose."""

    error: Array
    inverse: Array
    squared: Array
    by_pose: Array


def _residuals(landmarks: Landmarks, found: Found, pose: Array, predicted: Array | None) -> _Residuals:
    """Compare where landmarks were found with where a pose has them; with the covariance of the pose, where it is given."""
    projected = projection_of(landmarks.points[found.landmark], Views.of(pose), landmarks.axes.bearing)
    error, by_pose = found.polar - projected.polar, projected.by_pose[:, :, PLANAR]
    covariance = landmarks.covariance[found.landmark]
    spread = found.covariance + projected.by_point @ covariance @ projected.by_point.transpose(0, 2, 1)
    if predicted is not None:
        spread = spread + by_pose @ predicted @ by_pose.transpose(0, 2, 1)
    inverse = np.asarray(np.linalg.inv(spread), dtype=np.float64)
    return _Residuals(error, inverse, np.einsum("ni,nij,nj->n", error, inverse, error), by_pose)


def level_turn(heading: float) -> Array:
    """Return what turns x and y of the world into starboard and forward ``(2, 2)``."""
    sin, cos = np.sin(heading), np.cos(heading)
    return np.array([[cos, -sin], [sin, cos]])
