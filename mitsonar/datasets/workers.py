"""Who makes the shards: this process, processes beside it, or the workers of a dask scheduler anywhere."""

from __future__ import annotations

import contextlib
import socket
import time
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from mitsonar.datasets.shards import forget, make_shard
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError
from mitsonar.simulation.variant import use_threads

if TYPE_CHECKING:
    from distributed import Client, Future

__all__ = ["Queue", "made_by"]

AHEAD = 2
"""Shards that a worker is given at a time: one that it makes, one that waits."""

ASK_S = 1.0
"""How often the scheduler is asked who is there."""

LOSSES = 3
"""How often workers may be lost with the same shard."""

SILENCE_S = 90.0
"""How long there may be no worker at all."""

ANSWERS_WITHIN = "10s"
"""How long a scheduler may take to answer first, in dask's words."""


def made_by(store: DataStore, todo: list[int], *, workers: int = 1, scheduler: str | None = None) -> Iterator[int]:
    """Make the shards; their numbers, as they get done.

    Args:
        store: where they belong.
        todo: their numbers.
        workers: 1, this process with all its threads; more, so many processes here, one thread each.
        scheduler: address of a dask scheduler that runs already; its workers instead.

    Raises:
        MitsonarError: no scheduler there, no worker left, a worker that was lost again and again, or what a worker says.
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
    """A client of the scheduler; a local one starts its workers by spawn, one thread each."""
    import logging

    import dask
    from distributed import Client, LocalCluster

    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=ANSWERS_WITHIN, set_as_default=False)
        except (OSError, ValueError) as error:
            reason = " ".join(str(error).split())[:160]
            raise MitsonarError(
                f"no dask scheduler at {scheduler}: {reason}; start one with `dask scheduler` and give the address it prints"
            ) from None
        with client:
            yield client
        return
    settings = {
        "distributed.worker.multiprocessing-method": "spawn",
        "distributed.comm.timeouts.connect": "60s",
        # dask lets workers return memory at each release, which doubles the time of NumPy here, and samples their stacks
        "distributed.nanny.pre-spawn-environ": {"OMP_NUM_THREADS": "1"},
        "distributed.worker.profile.enabled": False,
        # Ctrl-C reaches all processes of a terminal: this one stops the others
        "distributed.worker.preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"],
    }
    quiet = logging.CRITICAL  # what a user should know of a lost worker, we say
    with (
        dask.config.set(settings),
        LocalCluster(
            n_workers=workers, threads_per_worker=1, memory_limit=0, dashboard_address=None, silence_logs=quiet
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


class Queue:
    """Shards that wait: a worker goes on where it is, whose scene it has; where it cannot, it begins a stretch of its own.

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
        """The next shard for a worker."""
        shard = self.at.get(worker, -2) + 1
        if shard not in self.waiting:
            first, end = self._longest()
            taken = first - 1 in self.at.values()  # somebody will go on there
            shard = (first + end) // 2 if taken else first
        self.waiting.remove(shard)
        self.at[worker] = shard
        return shard

    def _longest(self) -> tuple[int, int]:
        """The longest stretch of shards that wait: its first, and the one after its last."""
        waiting = np.sort(np.fromiter(self.waiting, dtype=int))
        ends = np.flatnonzero(np.append(np.diff(waiting) > 1, True)) + 1
        lengths = np.diff(ends, prepend=0)
        longest = int(lengths.argmax())
        first = int(waiting[ends[longest] - lengths[longest]])
        return first, first + int(lengths[longest])

    def give_back(self, shard: int) -> None:
        """A worker was lost with this shard: another makes it.

        Raises:
            MitsonarError: it was lost too often.
        """
        self.lost[shard] += 1
        if self.lost[shard] > LOSSES:
            raise MitsonarError(
                f"a worker was lost again and again at shard {shard} (out of memory?): use fewer workers; what is whole "
                "stays, the same command goes on"
            )
        self.waiting.add(shard)

    def forget(self, alive: list[str]) -> None:
        """Workers that are gone are nowhere."""
        self.at = {worker: shard for worker, shard in self.at.items() if worker in alive}


def _hand_out(client: Client, store: DataStore, queue: Queue) -> Iterator[int]:
    """Keep every worker supplied until all shards are made."""
    url = store.place.root if store.place.local else store.place.url
    given: dict[Future, tuple[str, int]] = {}
    asked, received, alive = 0.0, time.monotonic(), []
    try:
        while queue or given:
            if time.monotonic() - asked > ASK_S:
                alive, asked = list(client.ncores()), time.monotonic()
                queue.forget(alive)
                # dask itself leaves a task waiting for ever that was meant for a worker which is gone
                for future in [future for future, (worker, _) in given.items() if worker not in alive]:
                    queue.give_back(given.pop(future)[1])
                    future.cancel()
            if alive:
                received = time.monotonic()
            elif time.monotonic() - received > SILENCE_S:
                raise MitsonarError(
                    f"workers were lost at shards {', '.join(map(str, queue.lost))} and none has come back for "
                    f"{SILENCE_S:.0f} s (out of memory?): use fewer workers; what is whole stays, the same command goes on"
                    if queue.lost
                    else f"the scheduler has had no worker for {SILENCE_S:.0f} s: start some with `dask worker ADDRESS`; "
                    "what is whole stays, the same command goes on"
                )
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
                    raise future.exception()  # type: ignore[misc]
                else:
                    queue.give_back(shard)
            if not done:
                time.sleep(0.1)
    finally:
        with contextlib.suppress(Exception):
            client.cancel(list(given))


def _is_lost(future: Future) -> bool:
    """Whether the worker died, not the work failed."""
    from distributed import KilledWorker

    return isinstance(future.exception(), KilledWorker)


def _work(url: str, shard: int) -> int:
    """One shard, in a dask worker: as many threads of the ray tracer as the worker has.

    Raises:
        MitsonarError: this worker does not see the store, or has other versions.
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
