"""The estimator protocol: two consecutive frames in, the motion between them out, and whether to believe it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.frames import SonarFrames
from mitsonar.motion import Motion

__all__ = ["Estimate", "Estimator", "two_frames"]


@dataclass(frozen=True)
class Estimate:
    """What an estimator says of two frames.

    Attributes:
        motion: sideways, forward [m], yaw [rad] (eq. 3.4); zero where nothing can be said.
        covariance: of these ``(3, 3)``, where the estimator knows it.
        believe: False where it should not be used.
        reason: why not.
        about: what else it tells: correlation, iterations ...
    """

    motion: Motion
    covariance: NDArray[np.float64] | None = None
    believe: bool = True
    reason: str = ""
    about: dict[str, Any] = field(default_factory=dict)


class Estimator(Protocol):
    """From two frames to the motion between them.

    Attributes:
        inputs: what it needs beside the images: ``nothing``, ``height and pitch`` ...
    """

    inputs: str

    def estimate(self, frames: SonarFrames) -> Estimate:
        """The motion from the first to the second of two frames.

        Raises:
            MitsonarError: not two frames, or frames without what the estimator needs.
        """


def two_frames(frames: SonarFrames) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The two images as fractions of the maximum, float32.

    Raises:
        MitsonarError: not two frames.
    """
    if len(frames) != 2:
        raise MitsonarError(f"an estimator takes two frames: got {len(frames)}")
    scale = np.float32(1 / 255 if frames.image.dtype == np.uint8 else 1)
    first, second = (np.asarray(image, dtype=np.float32) * scale for image in frames.image)
    return first, second
