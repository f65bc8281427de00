"""Who makes the shards: this process, processes beside it, or the workers of a dask scheduler anywhere."""

from __future__ import annotations

import contextlib
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Protocol

import numpy as np

from mitsonar.datasets.shards import forget, make_shard
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError
from mitsonar.simulation.device import use_threads

__all__ = ["Queue", "made_by"]

AHEAD = 2
"""Shards that a worker holds at a time: one that it makes, one that waits."""

ASK_S = 1.0
"""Seconds between two requests for the list of workers."""

LOSSES = 3
"""Number of workers that may be lost with the same shard."""

SILENCE_S = 90.0
"""Seconds for which there may be no worker at all."""

ANSWERS_WITHIN = "10s"
"""Time for the scheduler's first answer, in dask's notation."""


class Future(Protocol):
    """A task of dask, which has no types of its own."""

    status: str

    def done(self) -> bool:
        """Return whether the task has ended."""

    def exception(self) -> BaseException:
        """Return the error of a task that failed."""

    def cancel(self) -> None:
        """Withdraw the task."""


class Client(Protocol):
    """A client of a dask scheduler."""

    def ncores(self) -> dict[str, int]:
        """Return the threads of each worker, by address."""

    def submit(self, task: Callable[[str, int], int], /, *args: object, workers: list[str], pure: bool) -> Future:
        """Hand a task to one of the workers."""

    def cancel(self, futures: list[Future]) -> None:
        """Withdraw tasks."""


def made_by(store: DataStore, todo: list[int], *, workers: int = 1, scheduler: str | None = None) -> Iterator[int]:
    """Make shards. Yield the number of each when it is done.

    Args:
        store: to which they belong.
        todo: their numbers.
        workers: processes on this machine, one thread each; with 1 this process renders, with all its threads.
        scheduler: address of a running dask scheduler, whose workers render instead.

    Raises:
        MitsonarError: no scheduler there, no worker left, too many workers lost at one shard, or a worker's error.
    """
    if scheduler is None and workers <= 1:
        try:
            for shard in todo:
                yield make_shard(store, shard)
        finally:
            forget()
    else:
        with _client(workers, scheduler) as client:
            yield from _hand_out(client, store, Queue(todo))


@contextlib.contextmanager
def _client(workers: int, scheduler: str | None) -> Iterator[Client]:
    """Open a client of the scheduler. Local workers are started by spawn, with one thread each."""
    import logging

    import dask
    import distributed

    connect: Callable[..., AbstractContextManager[Client]] = distributed.Client
    start: Callable[..., AbstractContextManager[object]] = distributed.LocalCluster

    if scheduler is not None:
        try:
            connected = connect(scheduler, timeout=ANSWERS_WITHIN, set_as_default=False)
        except (OSError, ValueError) as error:
            reason = " ".join(str(error).split())[:160]
            raise MitsonarError(
                f"no dask scheduler at {scheduler}: {reason}; start one with `dask scheduler` and give the address it prints"
            ) from None
        with connected as client:
            yield client
        return
    settings = {
        "distributed.worker.multiprocessing-method": "spawn",
        "distributed.comm.timeouts.connect": "60s",
        # by default dask makes workers return memory at each release, which doubles NumPy's time, and samples their stacks
        "distributed.nanny.pre-spawn-environ": {"OMP_NUM_THREADS": "1"},
        "distributed.worker.profile.enabled": False,
        # Ctrl-C reaches all processes of a terminal: this process stops the others
        "distributed.worker.preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"],
    }
    quiet = logging.CRITICAL  # mitsonar itself reports a lost worker
    with (
        dask.config.set(settings),
        start(
            n_workers=workers, threads_per_worker=1, memory_limit=0, dashboard_address=None, silence_logs=quiet
        ) as cluster,
        connect(cluster, set_as_default=False) as client,
    ):
        yield client


class Queue:
    """Shards that wait. A worker continues after its last shard, whose scene it has loaded, or begins a stretch of its own.

    Args:
        todo: numbers of the shards.
    """

    def __init__(self, todo: list[int]) -> None:
        self.waiting = set(todo)
        self.at: dict[str, int] = {}
        self.lost: Counter[int] = Counter()

    def __bool__(self) -> bool:
        return bool(self.waiting)

    def next(self, worker: str) -> int:
        """Choose the next shard for a worker."""
        shard = self.at.get(worker, -2) + 1
        if shard not in self.waiting:
            first, end = self._longest()
            taken = first - 1 in self.at.values()  # another worker will continue there
            shard = (first + end) // 2 if taken else first
        self.waiting.remove(shard)
        self.at[worker] = shard
        return shard

    def _longest(self) -> tuple[int, int]:
        """Find the longest stretch of shards that wait: its first, and the one after its last."""
        waiting = np.sort(np.fromiter(self.waiting, dtype=int))
        ends = np.flatnonzero(np.append(np.diff(waiting) > 1, True)) + 1
        lengths = np.diff(ends, prepend=0)
        longest = int(lengths.argmax())
        first = int(waiting[ends[longest] - lengths[longest]])
        return first, first + int(lengths[longest])

    def give_back(self, shard: int) -> None:
        """Return a shard whose worker was lost, so that another worker makes it.

        Raises:
            MitsonarError: too many workers were lost with it.
        """
        self.lost[shard] += 1
        if self.lost[shard] > LOSSES:
            raise MitsonarError(
                f"a worker was lost again and again at shard {shard} (out of memory?): use fewer workers; whole shards "
                "stay, the same command continues"
            )
        self.waiting.add(shard)

    def forget(self, alive: list[str]) -> None:
        """Forget the workers that are gone."""
        self.at = {worker: shard for worker, shard in self.at.items() if worker in alive}


def _hand_out(client: Client, store: DataStore, queue: Queue) -> Iterator[int]:
    """Supply every worker with shards until all are made. Yield the number of each when it is done."""
    url = store.place.root if store.place.local else store.place.url
    given: dict[Future, tuple[str, int]] = {}
    asked, received, alive = 0.0, time.monotonic(), list[str]()
    try:
        while queue or given:
            if time.monotonic() - asked > ASK_S:
                alive, asked = list(client.ncores()), time.monotonic()
                queue.forget(alive)
                # dask would keep a task waiting for ever whose worker is gone
                for future in [future for future, (worker, _) in given.items() if worker not in alive]:
                    queue.give_back(given.pop(future)[1])
                    future.cancel()
            if alive:
                received = time.monotonic()
            elif time.monotonic() - received > SILENCE_S:
                raise _no_worker(queue)
            for worker in alive:
                while queue and sum(owner == worker for owner, _ in given.values()) < AHEAD:
                    shard = queue.next(worker)
                    given[client.submit(_work, url, shard, workers=[worker], pure=False)] = worker, shard
            done = [future for future in given if future.done()]
            for future in done:
                shard = given.pop(future)[1]
                if future.status == "finished":
                    yield shard
                elif future.status == "error" and not _is_lost(future):
                    raise future.exception()
                else:
                    queue.give_back(shard)
            if not done:
                time.sleep(0.1)
    finally:
        with contextlib.suppress(Exception):
            client.cancel(list(given))


def _no_worker(queue: Queue) -> MitsonarError:
    """Write the error of a scheduler without workers."""
    lost = ", ".join(map(str, queue.lost))
    cause = (
        f"workers were lost at shards {lost} and none has come back for {SILENCE_S:.0f} s "
        "(out of memory?): use fewer workers"
        if lost
        else f"the scheduler has had no worker for {SILENCE_S:.0f} s: start some with `dask worker ADDRESS`"
    )
    return MitsonarError(f"{cause}; whole shards stay, the same command continues")


def _is_lost(future: Future) -> bool:
    """Return whether the worker died, rather than its task failed."""
    from distributed import KilledWorker

    return isinstance(future.exception(), KilledWorker)


def _work(url: str, shard: int) -> int:
    """Make one shard in a dask worker, with as many threads of the ray tracer as the worker has.

    Raises:
        MitsonarError: this worker cannot open the store, or has other versions.
    """
    from distributed import get_worker

    use_threads(get_worker().state.nthreads)
    store = DataStore.open(url, write=True, unfinished=True)
    other = store.other_versions()
    if other:
        raise MitsonarError(
            f"the store was begun with {', '.join(other)} on {socket.gethostname()}: install the same everywhere"
        )
    return make_shard(store, shard)
