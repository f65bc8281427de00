"""Several networks, each trained at a height of its own: the one that was trained nearest to the measured height answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import AnyEstimator, Estimate
from mitsonar.estimation.learned.image_network import ImageNetwork
from mitsonar.estimation.learned.view_network import ViewNetwork
from mitsonar.motion.composition import MotionPrior
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.records.frames import SonarFrames, ViewFrames

__all__ = ["HeightEnsemble"]


@dataclass(eq=False)
class HeightEnsemble:
    """The network trained nearest to the height of the frames.

    Args:
        networks: two or more, all of one image or all of the same views.

    Attributes:
        inputs: what it is given beside the images.
        views: that all of them read; None: a single image.
        kind: ``image`` or ``vector``.

    Raises:
        MitsonarError: networks that read different things.
    """

    networks: Sequence[AnyEstimator]
    inputs: str = field(default="height, which chooses the network", init=False)

    def __post_init__(self) -> None:
        reads = {(type(one), getattr(one, "views", None), one.kind) for one in self._members}
        if len(reads) != 1 or len(self._members) != len(self.networks):
            said = "; ".join(sorted(f"{kind}s of {', '.join(views or ('one view',))}" for _, views, kind in reads))
            raise MitsonarError(f"networks that stand in for each other must read the same views: got {said}")
        ((_, self.views, self.kind),) = reads

    @property
    def _members(self) -> list[ImageNetwork | ViewNetwork]:
        return [one for one in self.networks if isinstance(one, ImageNetwork | ViewNetwork)]

    @property
    def checkpoints(self) -> tuple[Checkpoint, ...]:
        """Return the checkpoints of all networks."""
        return tuple(checkpoint for one in self._members for checkpoint in one.checkpoints)

    @property
    def consumes(self) -> type:
        """Return the class of records that its networks read."""
        return ViewFrames if self.views else SonarFrames

    @property
    def digest(self) -> str:
        """Return the digests of all networks."""
        return " ".join(one.digest for one in self.networks)

    def estimate(self, frames: SonarFrames | ViewFrames, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion with the chosen network.

        Raises:
            MitsonarError: frames without a height; as the network does.
        """
        known = None if frames.height_m is None else frames.height_m[np.isfinite(frames.height_m)]
        if known is None or not len(known):
            raise MitsonarError(
                "the height chooses the network, and the frames tell none: measure it with --height-by direct"
            )
        height = float(known.mean())
        network: AnyEstimator = self.chosen(height)
        return network.estimate(frames, prior)

    def chosen(self, height_m: float) -> ImageNetwork | ViewNetwork:
        """Return the network whose heights of training are nearest in ratio; of several, that whose middle is nearest."""

        def away(network: ImageNetwork | ViewNetwork) -> tuple[float, float]:
            low, high = network.heights
            outside = max(np.log(low / height_m), np.log(height_m / high), 0.0)
            return float(outside), float(abs(np.log(height_m / np.sqrt(low * high))))

        return min(self._members, key=away)
