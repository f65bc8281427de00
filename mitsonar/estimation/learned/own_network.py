"""A network of torch of the user's own as an estimator: frames become its input as they did in training."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import nn

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate, rejected, two_frames
from mitsonar.estimation.learned.trained_network import NetworkInput, answer_of, one_thread
from mitsonar.motion.composition import Motion
from mitsonar.records.frames import SonarFrames, to_float32

if TYPE_CHECKING:
    from mitsonar.datasets.samples import Samples

__all__ = ["OwnNetwork"]


class OwnNetwork:
    """Estimates motions by any module whose output is labels of motions ``(batch, 3)``.

    Args:
        network: takes images ``(batch, 2, bins, beams)`` float32 in 0..1, or what ``samples`` make of them. It is copied and
            set to evaluation; what is learnt later does not count.
        samples: on which it was trained, such as :class:`~mitsonar.datasets.samples.SonarPairs`. They say how frames
            become its input, and decode its labels. Without them the labels are raw: sideways, forward [m], yaw [rad].

    Raises:
        MitsonarError: samples of other than two images of one view, or with the geometry of the ground.
    """

    consumes = SonarFrames
    inputs = "its own"
    digest = ""

    def __init__(self, network: nn.Module, samples: Samples | None = None) -> None:
        if samples is not None and (
            samples.frames != 2 or len(samples.arrange.views) != 1 or samples.arrange.kind != "image" or samples.ground
        ):
            raise MitsonarError(
                "a network of your own estimates from two images of one view: give samples with frames=2, kind='image', one "
                "view, and no ground"
            )
        self._network = copy.deepcopy(network).eval()
        self._arrange = None if samples is None else replace(samples.arrange, noise=NoiseModel(), levels=())
        self._labels = None if samples is None else samples.labels
        self._shape: tuple[int, ...] | None = None
        if samples is not None and samples.arrange.coordinates != "polar":
            view = next(view for view in samples.recipe.views if view.name == samples.arrange.views[0])
            self._shape = (len(view.sonar.range_m), len(view.bearing_rad))

    def estimate(self, frames: SonarFrames) -> Estimate:
        """Estimate the motion; its covariance is not known.

        Raises:
            MitsonarError: not two frames, frames of a size that the network does not take, an output that is no motion.
        """
        two_frames(frames)
        if self._shape is not None and frames.image.shape[1:] != self._shape:
            raise MitsonarError(f"the network was trained on images of {self._shape}: got {frames.image.shape[1:]}")
        like = next(self._network.parameters(), torch.empty(0))
        images = torch.from_numpy(np.ascontiguousarray(to_float32(frames.image)))[None].to(like.device)
        inputs: NetworkInput = images
        if self._arrange is not None:
            inputs = self._arrange({self._arrange.views[0]: images}, torch.arange(2, device=like.device)[None], 0)
        with torch.inference_mode(), one_thread():
            answer = answer_of(self._network, inputs)
        if not isinstance(answer, torch.Tensor) or answer.shape != (1, 3):
            got = f"a tensor of {tuple(answer.shape)}" if isinstance(answer, torch.Tensor) else type(answer).__name__
            raise MitsonarError(f"a network of motions must return labels (batch, 3): got {got} for a batch of one")
        labels = answer[0].double().cpu().numpy()
        if not np.isfinite(labels).all():
            return rejected("the network's answer is not finite")
        motion = labels if self._labels is None else self._labels.decode(labels)
        return Estimate(Motion(*motion.tolist()))
