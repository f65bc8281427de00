"""Priors reach the pairs that they belong to, in this process and in others."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import pytest
from helpers import essence

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate, rejected
from mitsonar.instruments.sonar import Sonar
from mitsonar.mapping.pairs import PAIRS_A_BATCH, EstimateStore, estimate_motions
from mitsonar.mapping.sources import FrameSource
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.frames import SonarFrames

FRAMES = 2 * PAIRS_A_BATCH + 4
SONAR = Sonar(range_bins=16, beams=8)


@dataclass(frozen=True)
class Believer:
    """Estimates what it is told, plus the number of the first frame as yaw."""

    consumes = SonarFrames
    inputs = "nothing"
    digest = ""

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        if prior is None:
            return rejected("nothing told")
        return Estimate(prior.motion._replace(yaw=float(frames.image[0, 0, 0])), prior.covariance)


def numbered() -> FrameSource:
    """Frames whose pixels are their numbers."""
    image = np.broadcast_to(np.arange(FRAMES, dtype=np.float32)[:, None, None], (FRAMES, 16, 8)).copy()
    return FrameSource.of(SonarFrames(image, SONAR.range_m, SONAR.bearing_rad, np.linspace(0, 1, FRAMES), SONAR))


def told() -> list[MotionPrior]:
    return [MotionPrior(Motion(1e-3 * k, 0.0, 0.0), np.eye(3) * (1 + k)) for k in range(FRAMES - 1)]


@pytest.mark.parametrize("workers", essence([1, 2], 1))
def test_each_pair_gets_its_own_prior(workers: int) -> None:
    """Also where pairs of an earlier run are left out, so that batches do not begin where the table does."""
    known = {0: rejected("known"), 5: rejected("known")}
    result = estimate_motions(
        numbered(), Believer(), np.arange(FRAMES), workers=workers, priors=told(), store=EstimateStore(known)
    )
    assert {k for k, one in enumerate(result) if one.reason == "known"} == {0, 5}
    for k, one in enumerate(result):
        if k not in known:
            assert one.motion == Motion(1e-3 * k, 0.0, float(k))
            assert one.covariance is not None
            assert one.covariance[0, 0] == 1 + k


class Slow(Believer):
    """Takes a minute from the second batch on."""

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        if frames.image[0, 0, 0] >= PAIRS_A_BATCH:
            time.sleep(60)
        return rejected("nothing told")


@pytest.mark.thorough
def test_a_stop_does_not_wait_for_what_workers_have_begun() -> None:
    stopped = list[float]()

    class Stopping(EstimateStore):
        def add_pair(self, pair: int, estimate: Estimate) -> None:
            time.sleep(1)  # the next batch has begun
            stopped.append(time.monotonic())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        estimate_motions(numbered(), Slow(), np.arange(FRAMES), workers=2, store=Stopping())
    assert time.monotonic() - stopped[0] < 20


def test_without_priors_none_is_told() -> None:
    assert {one.reason for one in estimate_motions(numbered(), Believer(), np.arange(3))} == {"nothing told"}


def test_one_prior_a_pair() -> None:
    with pytest.raises(MitsonarError, match=f"{FRAMES} frames make {FRAMES - 1} pairs, each with one prior: got 3"):
        estimate_motions(numbered(), Believer(), np.arange(FRAMES), priors=told()[:3])
