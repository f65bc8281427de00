"""Closure of loops: what exact steps leave over, what a pull towards rest does, and covariances that explain it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from drawn_frames import sway
from numpy.typing import NDArray

from mitsonar import MitsonarError
from mitsonar.estimation.estimator import Estimate
from mitsonar.instruments.sonar import Sonar
from mitsonar.mapping.odometry import Closure, OdometryOptions, closure_of, odometry
from mitsonar.mapping.pairs import estimate_motions
from mitsonar.mapping.sources import FrameSource
from mitsonar.motion.composition import Motion, MotionPrior, motions
from mitsonar.records.frames import SonarFrames

FRAMES, STEPS = 129, 8
STD = np.array([1e-3, 5e-4, 2e-4])


def numbered(frames: int) -> SonarFrames:
    """Frames whose pixels are their number, so that an estimator can look the motion up."""
    path, sonar = sway(frames), Sonar(beams=2, range_bins=3)
    image = np.broadcast_to(np.arange(frames, dtype=np.float32)[:, None, None], (frames, 3, 2)).copy()
    return SonarFrames(image, sonar.range_m, sonar.bearing_rad, path.time_s, sonar, path.poses, np.full(frames, 2.5))


@dataclass(frozen=True)
class Known:
    """Tells the true motion with errors: Gaussian ones of ``std``, independent of the length, and a ``pull`` towards rest.

    The pull is a part of motions of one step; over several steps there is none, as with light that moves with a sonar.
    Motions over more than ``farthest`` steps are rejected. Those over several steps from the frames in ``wrong`` are matched
    where they do not belong, 0.3 m off; ``distinct`` is what they report of themselves.
    """

    poses: NDArray[np.float64]
    std: NDArray[np.float64]
    told: NDArray[np.float64] | None
    pull: float = 0.0
    lost: tuple[int, ...] = ()
    farthest: int = FRAMES
    wrong: tuple[int, ...] = ()
    distinct: bool = True

    consumes = SonarFrames
    inputs = "nothing"
    digest = ""

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        first, second = (int(number) for number in frames.image[:, 0, 0])
        answer = motions(self.poses[[first, second]])[0] * (1 - self.pull * (second - first == 1))
        answer = answer + np.random.default_rng([first, second]).normal(0, self.std)
        wrong = first in self.wrong and second - first > 1
        answer = answer - [0.0, 0.3 * wrong, 0.0]
        covariance = None if self.told is None else np.diag(self.told**2)
        about = {"distinct": self.distinct or not wrong}
        return Estimate(Motion(*answer), covariance, self._valid(first, second), about=about)

    def _valid(self, first: int, second: int) -> bool:
        return first not in self.lost and second - first <= self.farthest


def closed(estimator: Known, frames: SonarFrames) -> tuple[Closure, list[Estimate]]:
    source, numbers = FrameSource.of(frames), np.arange(len(frames))
    estimates = estimate_motions(source, estimator, numbers)
    result = closure_of(source, estimator, numbers, estimates, STEPS)
    assert result is not None
    return result, estimates


def test_exact_motions_close() -> None:
    frames = numbered(FRAMES)
    assert frames.poses is not None
    result, _ = closed(Known(frames.poses, np.zeros(3), STD), frames)
    assert result.residuals.shape == (16, 3)
    np.testing.assert_allclose(result.residuals, 0, atol=1e-12)
    assert result.factor == 1


def test_residuals_have_the_variance_of_nine_motions_and_true_covariances_stay() -> None:
    frames = numbered(1601)
    assert frames.poses is not None
    result, estimates = closed(Known(frames.poses, STD, STD), frames)
    # 200 loops: the rms scatters by 5 %; turns of a degree mix the axes by less
    np.testing.assert_allclose(result.rms, 3 * STD, rtol=0.2)
    assert result.factor == pytest.approx(1, abs=0.25)
    inflated = result.inflate_covariances(estimates)
    np.testing.assert_allclose(np.asarray(inflated[0].covariance), np.diag(STD**2) * result.factor)


@pytest.mark.parametrize("told", [STD / 5, None])
def test_covariances_that_are_too_small_or_missing_are_made_honest(told: NDArray[np.float64] | None) -> None:
    frames = numbered(1601)
    assert frames.poses is not None
    result, estimates = closed(Known(frames.poses, STD, told), frames)
    covariance = np.asarray(result.inflate_covariances(estimates)[3].covariance)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), STD, rtol=0.2)


def test_a_pull_towards_rest_shows_in_the_mean() -> None:
    frames = numbered(FRAMES)
    assert frames.poses is not None
    result, _ = closed(Known(frames.poses, np.zeros(3), STD / 100, pull=0.1), frames)
    true = motions(frames.poses)
    assert result.mean[1] == pytest.approx(-0.1 * STEPS * true[:128, 1].mean(), rel=0.05)
    assert result.factor > 100


def test_loops_with_invalid_motions_are_left_out_and_one_loop_is_none() -> None:
    frames = numbered(FRAMES)
    assert frames.poses is not None
    result, _ = closed(Known(frames.poses, np.zeros(3), STD, lost=(3, 50)), frames)
    assert len(result.residuals) == 14
    short = numbered(STEPS + 1)
    assert short.poses is not None
    source, numbers = FrameSource.of(short), np.arange(STEPS + 1)
    known = Known(short.poses, np.zeros(3), STD)
    assert closure_of(source, known, numbers, estimate_motions(source, known, numbers), STEPS) is None


@pytest.mark.thorough
@pytest.mark.parametrize("small", [1, 5])
def test_a_wrong_match_is_refused_and_right_ones_still_show_covariances_that_are_too_small(small: int) -> None:
    """A loop of 0.3 m in 200 is left out; the others have the factor of the path without it, 1 or 25."""
    frames = numbered(1601)
    assert frames.poses is not None
    right = Known(frames.poses, STD, STD / small)
    (plain, _), (result, _) = closed(right, frames), closed(replace(right, wrong=(80,)), frames)
    assert result.factor == pytest.approx(small**2, rel=0.25)
    assert plain.refused <= 1  # of 200 right loops
    assert result.refused == plain.refused + 1
    assert np.abs(result.residuals).max() == np.abs(plain.residuals).max()
    # a path that drifts by far more than it states is believed to do so: its loops agree
    drifting, _ = closed(replace(right, pull=0.1), frames)
    assert drifting.refused <= 1
    assert drifting.factor > 10
    # most matches are wrong: they agree on a place, and only a match that is not distinct is known to be wrong
    many = tuple(range(0, 1200, STEPS))
    indistinct, _ = closed(replace(right, wrong=many, distinct=False), frames)
    assert indistinct.refused == len(many)
    np.testing.assert_array_equal(indistinct.residuals[-10:], plain.residuals[-10:])


def test_of_two_loops_that_contradict_each_other_none_counts() -> None:
    frames = numbered(STEPS + 2)
    assert frames.poses is not None
    source, numbers = FrameSource.of(frames), np.arange(STEPS + 2)
    for wrong, found in (((), 2), ((1,), None)):
        known = Known(frames.poses, STD, STD, wrong=wrong)
        result = closure_of(source, known, numbers, estimate_motions(source, known, numbers), STEPS)
        assert (None if result is None else len(result.residuals)) == found


def test_odometry_tells_the_closure_and_raises_its_covariances() -> None:
    frames = numbered(FRAMES)
    assert frames.poses is not None
    estimator = Known(frames.poses, STD, STD / 5)
    plain, closing = odometry(frames, estimator), odometry(frames, estimator, OdometryOptions(closure=STEPS))
    assert plain.closure is None
    assert closing.closure is not None
    np.testing.assert_array_equal(plain.series.motions, closing.series.motions)
    assert plain.series.covariances is not None
    assert closing.series.covariances is not None
    np.testing.assert_allclose(closing.series.covariances, plain.series.covariances * closing.closure.factor)
    names = [name for name, _, _ in closing.rows()]
    assert "closure over 8 motions, rms, forward" in names
    with pytest.raises(MitsonarError, match="must be 0, or 2 motions or more: got 1"):
        OdometryOptions(closure=1)


@pytest.mark.parametrize(("farthest", "steps"), [(8, 8), (5, 4), (2, 2), (1, None)])
def test_loops_are_halved_until_they_close_or_a_sentence_says_that_none_does(farthest: int, steps: int | None) -> None:
    frames = numbered(41)
    assert frames.poses is not None
    result = odometry(frames, Known(frames.poses, STD, STD, farthest=farthest), OdometryOptions(closure=8))
    names = [name for name, _, _ in result.rows()]
    assert (f"closure over {steps} motions, loops" in names) == (steps is not None)
    assert [sentence for sentence in result.warnings() if "no closure is given" in sentence] == (
        [] if steps else [result.warnings()[0]]
    )
