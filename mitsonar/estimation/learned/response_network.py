"""The estimator that a checkpoint of impulse responses is: its measured taps in, the motion over all its pings out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from mitsonar.datasets.responses import packed
from mitsonar.errors import MitsonarError
from mitsonar.estimation.channel.pings import pings_of
from mitsonar.estimation.estimator import Estimate, rejected
from mitsonar.estimation.learned.trained_network import HEIGHT_OFF, Trained, answer_of, one_thread
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.motion.errors import AXES
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.records.responses import ImpulseResponses

__all__ = ["ResponseNetwork"]

UNREAD = ("name", "frame_rate_hz", "seed")
"""Fields of a channel sonar that do not change what a network reads; and ``rays`` of the model scatterers."""


@dataclass(init=False, eq=False)
class ResponseNetwork(Trained):
    """A trained network that reads impulse responses.

    Args:
        checkpoint: of it.
        force: go on with another instrument or model than that of training.

    Raises:
        MitsonarError: a checkpoint that does not fit its network.
    """

    instead: ClassVar[str] = "likelihood or correlation"

    @property
    def consumes(self) -> type:
        """Return the class of records that it reads."""
        return ImpulseResponses

    def __init__(self, checkpoint: Checkpoint, *, force: bool = False) -> None:
        self.force = force
        self._take(checkpoint)

    def estimate(self, responses: ImpulseResponses, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion from the first to the last ping, with the covariance of validation.

        A network that was trained without turns answers that there is none, and with no variance, as ``likelihood`` does.

        Args:
            responses: as many pings as in training.
            prior: ignored: the network answers in the range of its training.

        Raises:
            MitsonarError: another number of pings, or another instrument or model than that of training.
        """
        count = self._checkpoint.arrangement["frames"]
        if len(responses) != count:
            raise MitsonarError(f"this {self._checkpoint.network} is given {count} pings: got {len(responses)}")
        pings = pings_of(responses)
        self._check_channel(responses.sonar)
        if len(pings.silent) == len(responses.sonar.receivers):
            return rejected("no receiver heard anything")
        inputs = torch.from_numpy(packed(pings.response)[None, None])
        with torch.inference_mode(), one_thread():
            targets, _ = self._checkpoint.decode(answer_of(self._network, inputs))
        if not np.isfinite(targets).all():
            return rejected("the network's answer is not finite")
        answer = np.zeros(3)
        answer[: targets.shape[1]] = targets[0]
        motion = Motion(*answer.tolist())
        reason = self._rejection_of_height(responses) or self._rejection_of_size(motion)
        return Estimate(motion, self._covariance, not reason, reason)

    @property
    def _covariance(self) -> NDArray[np.float64] | None:
        """Return the covariance of validation [m, m, rad] ``(3, 3)``; 0 of a turn that the network does not estimate."""
        rmse = self._checkpoint.rmse
        if rmse is None:
            return None
        variances = np.zeros(3)
        variances[: len(rmse)] = (rmse / [axis.scale for axis in AXES[: len(rmse)]]) ** 2
        return np.diag(variances)

    def _check_channel(self, has: ChannelSonar) -> None:
        """Refuse another instrument or model of echoes than that of training, unless it is forced."""
        trained = self._checkpoint.channel
        if trained is None or self.force:
            return
        left_out = {*UNREAD, *(() if trained.model == has.model == "rays" else ("rays",))}
        mine, its = (one.model_dump(exclude=left_out) for one in (trained, has))
        receivers = mine.pop("receivers") != its.pop("receivers")
        unlike = [f"{name} {its[name]}, not {value}" for name, value in mine.items() if value != its[name]]
        unlike += ["other receivers"] if receivers else []
        if unlike:
            raise MitsonarError(
                f"this {self._checkpoint.network} was trained on the channel sonar {trained.name}, the responses are of "
                f"{has.name}: {'; '.join(unlike)}; train on that one, use {self.instead}, or force it with RUN:force=1"
            )

    def _rejection_of_height(self, responses: ImpulseResponses) -> str:
        """Return why the height is not that of training; empty where it is, or where the responses do not hold it."""
        low, high = self.heights
        if responses.height_m is None or not np.isfinite(responses.height_m).all():
            return ""
        height = float(np.mean(responses.height_m))
        if low * (1 - HEIGHT_OFF) <= height <= high * (1 + HEIGHT_OFF):
            return ""
        return f"the transmitter stood at {height:.2f} m: {self._checkpoint.fixed} are fixed by training"
