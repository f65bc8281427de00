"""The estimator that a checkpoint of several views, or of vectors, is: portions of a looking-down view, say."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate, Record, rejected
from mitsonar.estimation.learned.trained_network import Trained, answer_of, one_thread
from mitsonar.instruments.views import SEGMENTS
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.records.frames import ViewFrames

__all__ = ["ViewNetwork", "reads_views"]

ALIKE = 0.4
"""Least correlation of two pings' profiles without what is slow in them, the median over the views: pairs of 20 mm from 10 m
have 0.8 to 0.97 at 512 and 1024 levels, pings of different places less than 0.4 but for the vector of a whole view."""

SLOW = 4.0
"""Standard deviation of the filter that tells what is slow [bins]."""

FEW = 256
"""Levels below which profiles of any two places are alike, and tell nothing."""


def reads_views(checkpoint: Checkpoint) -> bool:
    """Whether a network is given several views, a portion of one, or vectors as a data set stores them."""
    words = checkpoint.arrangement
    vectors = words["kind"] == "vector" and not words.get("halves", False)
    return vectors or len(words["views"]) > 1 or words["views"][0] in SEGMENTS


@dataclass(init=False, eq=False)
class ViewNetwork(Trained):
    """A trained network that reads several views or their vectors.

    Args:
        checkpoint: of it; it must take two frames.
        force: go on with another sonar than that of training.

    Raises:
        MitsonarError: a checkpoint that needs something else than two frames, or that does not fit its network.
    """

    instead: ClassVar[str] = "a network of that sonar's views"

    @property
    def consumes(self) -> type:
        """Return the class of records that it reads."""
        return ViewFrames

    def __init__(self, checkpoint: Checkpoint, *, force: bool = False) -> None:
        if checkpoint.arrangement["frames"] != 2:
            raise MitsonarError(
                f"an estimator has two frames: this {checkpoint.network} is given {checkpoint.arrangement['frames']}; use "
                "`mitsonar evaluate`, or another checkpoint"
            )
        self.force = force
        self._take(checkpoint)

    @property
    def views(self) -> tuple[str, ...]:
        """Return the names of the views that it reads."""
        return tuple(self._checkpoint.arrangement["views"])

    def estimate(self, records: Record, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion between two pings, with the covariance of validation.

        Args:
            records: two :class:`~mitsonar.records.frames.ViewFrames`.
            prior: ignored: the network answers in the range of its training.

        Raises:
            MitsonarError: not two pings of these views, another sonar than that of training.
        """
        frames = self._checked_views(records)
        inputs = self._input_of_views(frames)
        profiles = frames.profiles()
        if not np.isfinite(profiles).all():
            raise MitsonarError("the frames hold nan or inf: set pixels without echo to 0")
        if (np.ptp(profiles, axis=2) == 0).any():
            return rejected("nothing in the frames to match")
        with torch.inference_mode(), one_thread():
            targets, covariances = self._checkpoint.decode(answer_of(self._network, inputs))
        if not np.isfinite(targets).all():
            return rejected("the network's answer is not finite")
        motion = Motion(*targets[0].tolist())
        reason = self._rejection_of_geometry(frames) or self._rejection_of_size(motion) or _rejection_of_profiles(profiles)
        covariance = self._checkpoint.covariance if covariances is None else covariances[0]
        return Estimate(motion, covariance, not reason, reason)

    def _checked_views(self, frames: Record) -> ViewFrames:
        """Check that there are two pings of the views that it reads."""
        views = ", ".join(self.views)
        if not isinstance(frames, ViewFrames):
            raise MitsonarError(
                f"this {self._checkpoint.network} is given {self.kind}s of {views}: use `mitsonar odometry` or `mitsonar "
                "evaluate` on a data set that holds them"
            )
        if len(frames) != 2 or any(view not in frames.values for view in self.views):
            raise MitsonarError(f"two pings of {views} are needed: got {len(frames)} of {', '.join(frames.values)}")
        return frames


def _rejection_of_profiles(profiles: NDArray[np.float32]) -> str:
    """Whether two pings ``(views, 2, bins)`` show one place: what varies quickly along range must be alike."""
    if profiles.shape[2] < FEW:
        return ""
    quick = profiles - gaussian_filter1d(profiles, SLOW, axis=2)
    found = []
    for first, second in quick:
        shifted = [(first[3 : len(first) - 3], second[3 + lag : len(second) - 3 + lag]) for lag in range(-3, 4)]
        found.append(max(np.vdot(a, b) / np.sqrt(np.vdot(a, a) * np.vdot(b, b) + 1e-12) for a, b in shifted))
    alike = float(np.median(found))
    return "" if alike >= ALIKE else f"the profiles of both pings correlate by {alike:.2f} only"
