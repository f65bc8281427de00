"""How an estimator runs over all pairs of consecutive frames, in one process or in several.

:func:`estimate_motions` estimates the motions. :func:`continued` then resolves ambiguous ones by their neighbours.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logsumexp

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import AnyEstimator, Estimate, Record, rejected
from mitsonar.estimation.image.ping_groups import estimate_pair
from mitsonar.mapping.open_source import Source
from mitsonar.mapping.sources import without_height
from mitsonar.motion.composition import Motion, MotionPrior

__all__ = ["EstimateStore", "continued", "estimate_motions"]


Index = NDArray[np.intp]

Priors = list[MotionPrior | None]
"""Prior for the motion of each pair; None where there is none."""

PAIRS_A_BATCH = 8
"""Pairs that a worker receives at a time, and the most that a worker loses if it is killed."""

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class EstimateStore:
    """Estimates of an earlier run, to which a run adds its own as they are made. This store is in memory.

    Attributes:
        pairs: estimates by pair number.
        loops: registrations of loops by the numbers of both frames in the source and the initial motion.
    """

    def __init__(self, pairs: Mapping[int, Estimate] | None = None) -> None:
        self.pairs: dict[int, Estimate] = dict(pairs or {})
        self.loops: dict[tuple[int, int, Motion], Estimate] = {}

    def add_pair(self, pair: int, estimate: Estimate) -> None:
        """Add the estimate of a pair."""
        self.pairs[pair] = estimate

    def add_loop(self, first: int, second: int, guess: Motion, estimate: Estimate) -> None:
        """Add a registration of two frames from an initial motion."""
        self.loops[first, second, guess] = estimate


def estimate_motions(
    source: Source,
    estimator: AnyEstimator,
    frames: ArrayLike,
    *,
    workers: int = 1,
    priors: Sequence[MotionPrior] | None = None,
    store: EstimateStore | None = None,
    progress: Callable[[int], None] = lambda pairs: None,
) -> list[Estimate]:
    """Estimate the motion of each pair of consecutive frames, with only a few frames in memory at a time.

    Args:
        source: source of the frames.
        estimator: estimates the motion between two frames.
        frames: numbers of the frames ``(n,)``; pair ``k`` consists of frames ``k`` and ``k + 1`` of these.
        workers: number of worker processes, with one thread each; 1 computes in this process.
        priors: prior for the motion of each pair ``(n - 1,)``; default: none.
        store: estimates of an earlier run, to which each new one is added, in order.
        progress: called with the number of pairs processed since the last call.

    Raises:
        MitsonarError: frames cannot be read or lack what the estimator needs, a worker was lost, or the number of priors is
            not the number of pairs.
    """
    numbers = np.asarray(frames, dtype=np.intp)
    if priors is not None and len(priors) != len(numbers) - 1:
        raise MitsonarError(f"{len(numbers)} frames make {len(numbers) - 1} pairs, each with one prior: got {len(priors)}")
    store = store or EstimateStore()
    estimates = {pair: estimate for pair, estimate in store.pairs.items() if pair < len(numbers) - 1}
    if estimates:
        progress(len(estimates))
    batches = _batches([pair for pair in range(len(numbers) - 1) if pair not in estimates])
    run = _run_serial if workers <= 1 else _run_parallel
    of_pairs: Priors = [None] * (len(numbers) - 1) if priors is None else list(priors)
    with closing(run(source, estimator, numbers, of_pairs, batches, workers)) as finished:
        for batch, batch_estimates in finished:
            for pair, estimate in zip(batch, batch_estimates, strict=True):
                estimates[pair] = estimate
                store.add_pair(pair, estimate)
            progress(len(batch))
    return [estimates[pair] for pair in range(len(numbers) - 1)]


def _batches(pairs: list[int]) -> list[range]:
    """Group consecutive pairs into batches of at most :data:`PAIRS_A_BATCH`."""
    batches: list[range] = []
    for pair in pairs:
        if batches and batches[-1].stop == pair and len(batches[-1]) < PAIRS_A_BATCH:
            batches[-1] = range(batches[-1].start, pair + 1)
        else:
            batches.append(range(pair, pair + 1))
    return batches


def _run_serial(
    source: Source, estimator: AnyEstimator, numbers: Index, priors: Priors, batches: list[range], workers: int
) -> Generator[tuple[range, list[Estimate]]]:
    """Yield each batch with its estimates, computed in this process."""
    with _one_opencv_thread():
        for batch in batches:
            yield batch, _estimates(estimator, _frames_of(source, numbers, batch), priors[batch.start : batch.stop])


def _run_parallel(
    source: Source, estimator: AnyEstimator, numbers: Index, priors: Priors, batches: list[range], workers: int
) -> Generator[tuple[range, list[Estimate]]]:
    """Yield each batch with its estimates, computed in worker processes; this process reads the frames."""
    with _one_thread_each():
        others, whole = multiprocessing.active_children(), False
        pool = ProcessPoolExecutor(
            min(workers, max(1, len(batches))), multiprocessing.get_context("spawn"), _begin_worker, (estimator,)
        )
        waiting: deque[tuple[range, Future[list[Estimate]]]] = deque()
        try:
            for batch in batches:
                task = pool.submit(_in_worker, _frames_of(source, numbers, batch), priors[batch.start : batch.stop])
                waiting.append((batch, task))
                # a bounded queue: frames of waiting batches are in memory
                if len(waiting) > 2 * workers:
                    first, answers = waiting.popleft()
                    yield first, answers.result()
            while waiting:
                first, answers = waiting.popleft()
                yield first, answers.result()
            whole = True
        except BrokenProcessPool:
            raise MitsonarError(
                "a worker was lost: it was killed, or the memory did not suffice; resume with fewer workers"
            ) from None
        finally:
            if not whole:  # nobody will read the remaining results, and a batch may take long
                for worker in set(multiprocessing.active_children()).difference(others):
                    worker.terminate()
            pool.shutdown(cancel_futures=True)


def _frames_of(source: Source, numbers: Index, batch: range) -> Record:
    """Read the frames of a batch of pairs: one more frame than pairs."""
    return source.read(numbers[batch.start : batch.stop + 1])


def _estimates(estimator: AnyEstimator, frames: Record, priors: Priors) -> list[Estimate]:
    """Estimate each pair of consecutive frames or pings."""
    pairs = [frames.select(slice(k, k + 2)) for k in range(len(frames) - 1)]
    return [
        rejected("no height was found in the frames") if without_height(pair) else estimate_pair(estimator, pair, prior)
        for pair, prior in zip(pairs, priors, strict=True)
    ]


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    had = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(had)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Limit new processes to one thread each: numeric libraries read these variables when they are loaded."""
    had = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in had.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


_worker: AnyEstimator
"""The estimator of this process, if it is a worker."""


def _begin_worker(estimator: AnyEstimator) -> None:
    global _worker
    _worker = estimator
    cv2.setNumThreads(1)
    # Ctrl-C reaches all processes of a terminal; only the parent reacts, and stops its workers
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this worker when its parent was killed; otherwise it would wait forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _in_worker(frames: Record, priors: Priors) -> list[Estimate]:
    return _estimates(_worker, frames, priors)


# ---------------- Ambiguous motions


Array = NDArray[np.float64]

USUAL_M, USUAL_RAD = 0.005, 0.002
"""Standard deviations of the usual change from one motion to the next [m, rad]."""

SUDDEN = -12.0
"""Log probability of a sudden change of any size, since a path may turn a corner."""

SURE = 0.95
"""Smallest probability at which a candidate counts as the valid motion."""


def continued(estimates: Sequence[Estimate]) -> list[Estimate]:
    """Choose one motion of each ambiguous estimate where its neighbours decide.

    An estimator lists the candidates in ``about["modes"]``: probability, sideways, forward [m], yaw [rad] of each. Their
    covariances are in ``about["spreads"]``. A candidate becomes the valid motion if its probability, given all motions
    before and after, reaches :data:`SURE`. All other estimates are returned unchanged. The probabilities come from the
    forward-backward algorithm (Rabiner 1989).
    """
    modes = [np.array(one.about.get("modes", []), dtype=float).reshape(-1, 4) for one in estimates]
    ambiguous = [len(mine) > 1 and not one.valid for one, mine in zip(estimates, modes, strict=True)]
    if not any(ambiguous):
        return list(estimates)
    candidates = [
        mine if one.valid or unsure else np.empty((0, 4))
        for one, mine, unsure in zip(estimates, modes, ambiguous, strict=True)
    ]
    sure = _marginals(candidates)
    return [
        _with_mode(one, mine, int(share.argmax())) if unsure and share.max() >= SURE else one
        for one, mine, unsure, share in zip(estimates, modes, ambiguous, sure, strict=True)
    ]


def _marginals(modes: list[Array]) -> list[Array]:
    """Return the probability of each mode of each step, given all steps; steps without modes are skipped."""
    # 1. log probabilities of the modes alone, and of the changes between successive steps that have modes
    known = [k for k, mine in enumerate(modes) if len(mine)]
    log_probabilities = [np.log(np.maximum(modes[k][:, 0], 1e-300)) for k in known]
    change = [_change(modes[a][:, 1:], modes[b][:, 1:], b - a) for a, b in pairwise(known)]
    # 2. forward pass over all earlier steps, backward pass over all later ones, in logs against underflow
    before, after = [log_probabilities[0]], [np.zeros(len(log_probabilities[-1]))]
    for between, mine in zip(change, log_probabilities[1:], strict=True):
        before.append(logsumexp(before[-1][:, None] + between, axis=0) + mine)
    for between, mine in zip(change[::-1], log_probabilities[:0:-1], strict=True):
        after.append(logsumexp(between + (mine + after[-1])[None], axis=1))
    # 3. their product, normalised, is the probability given all steps
    shares = [np.empty(0)] * len(modes)
    for step, first, last in zip(known, before, after[::-1], strict=True):
        shares[step] = np.exp(first + last - logsumexp(first + last))
    return shares


def _change(first: Array, second: Array, steps: int) -> Array:
    """Return the log probability ``(n, m)`` that each second motion ``(m, 3)`` follows each first ``(n, 3)``.

    The change is a random walk, so that its standard deviation grows with the square root of ``steps``.
    """
    usual = np.array([USUAL_M, USUAL_M, USUAL_RAD]) * np.sqrt(steps)
    off = (second[None] - first[:, None]) / usual
    return np.asarray(np.maximum(-0.5 * (off**2).sum(axis=-1), SUDDEN))


def _with_mode(one: Estimate, modes: Array, number: int) -> Estimate:
    spreads = one.about.get("spreads")
    covariance = None if spreads is None else np.array(spreads[number], dtype=float)
    return replace(one, motion=Motion(*modes[number, 1:]), covariance=covariance, valid=True, reason="")
