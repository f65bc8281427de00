"""How a trained network estimates heights: the height estimator of a checkpoint, which needs torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from mitsonar.errors import MitsonarError
from mitsonar.estimation.height import Above, HeightEstimate, profile_of, rejection_of_profile
from mitsonar.estimation.learned import NetworkInput, Trained, TrainedInstrument, answer_of, one_thread
from mitsonar.instruments.views import Whole
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.records.frames import ViewFrames

__all__ = ["HeightNetwork"]

BEYOND = 0.1
"""Margin beyond the heights of training within which a height is valid, as a fraction of their interval."""


@dataclass(init=False, eq=False)
class HeightNetwork(Trained):
    """A trained network of one frame, or of one vector, that estimates heights (Almanza-Medina, 4.5).

    Args:
        checkpoint: of the network, which must take one frame.
        force: accept a sonar other than that of training.

    Raises:
        MitsonarError: a checkpoint that estimates motions.
    """

    instead: ClassVar[str] = "direct"

    def __init__(self, checkpoint: Checkpoint, *, force: bool = False) -> None:
        if checkpoint.arrangement["frames"] != 1:
            raise MitsonarError(
                f"this {checkpoint.network} estimates motions of {checkpoint.arrangement['frames']} frames, not heights: "
                "give one that was trained with input.frames: 1, or direct"
            )
        self.force = force
        self._set_checkpoint(checkpoint)

    @property
    def views(self) -> tuple[str, ...] | None:
        """Return the names of the views it reads; None: a single image."""
        views = tuple(self._checkpoint.arrangement["views"])
        return None if views == (Whole.name,) else views

    def height(self, frame: Above) -> HeightEstimate:
        """Estimate the height; its standard deviation is that of validation.

        Raises:
            MitsonarError: not one frame, or views or a sonar other than those of training.
        """
        profile, _ = profile_of(frame)
        reason = rejection_of_profile(profile) or self._rejection_of_attitude(frame)
        if reason:
            return HeightEstimate(np.nan, np.nan, False, reason)
        with torch.inference_mode(), one_thread():
            targets, _ = self._checkpoint.decode(answer_of(self._network, self._input(frame)))
        height, coder = float(targets[0, 0]), self._checkpoint.coder
        if not np.isfinite(height):
            return HeightEstimate(np.nan, np.nan, False, "the network's answer is not finite")
        low, high = float(coder.low[0]), float(coder.high[0])
        rmse = self._checkpoint.rmse
        std = np.nan if rmse is None else float(rmse[0]) / 1e3
        if not low - BEYOND * (high - low) <= height <= high + BEYOND * (high - low):
            return HeightEstimate(
                height, std, False, f"{height:.2f} m is beyond the heights of training, {low:g}..{high:g} m"
            )
        return HeightEstimate(height, std)

    def _input(self, frame: Above) -> NetworkInput:
        """Return the input of the network, a batch of one."""
        if isinstance(frame, ViewFrames):
            return self._input_of_views(frame)
        names = self._checkpoint.arrangement["views"]
        if len(names) > 1:
            raise MitsonarError(f"this {self._checkpoint.network} takes {', '.join(names)}: use a data set that holds them")
        self._check_instrument(names[0], TrainedInstrument.in_frames(frame.sonar, frame.range_m, frame.bearing_rad))
        values = {names[0]: torch.from_numpy(np.asarray(frame.image)[None])}
        arrangement = self._arrangement_for({names[0]: (frame.range_m, frame.bearing_rad)})
        inputs: NetworkInput = arrangement(values, torch.arange(1)[None], 0)
        return inputs
