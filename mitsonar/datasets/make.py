"""How a data set is made and checked: shard by shard, by one process or many.

An interrupted run can be continued: a complete shard is never rendered again, whichever process was killed.
"""

from __future__ import annotations

import contextlib
import re
import socket
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.water import noise_of
from mitsonar.config.data import Recipe
from mitsonar.datasets.modality import Fields, Renderer, Scene, Values, empty_sentence, renderer_of
from mitsonar.datasets.plan import (
    ImageModality,
    Plan,
    footprints_at,
    modality_of,
    scenes_of,
    sequences_of,
    world_seed,
)
from mitsonar.datasets.store import PACKAGES, PARTS, DataStore, frames_in_part, world_numbers
from mitsonar.errors import MitsonarError, short_repr, suggest_names
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.runs import check_same_settings, versions
from mitsonar.io.storage import Storage
from mitsonar.motion.composition import motions
from mitsonar.motion.pose import mounted
from mitsonar.records.frames import to_uint8
from mitsonar.simulation.channel import ChannelSimulator
from mitsonar.simulation.device import ensure_variant, release_memory, use_threads
from mitsonar.simulation.pings import CALIBRATION_FRAMES, RenderedPings, constant_gain, labels_above, to_image
from mitsonar.simulation.scene import load_scene, shape_names_in
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.simulation.moving import SceneMotion

__all__ = [
    "FRAMES_A_SCENE",
    "GenerationReport",
    "Queue",
    "ResponseRenderer",
    "SceneRenderer",
    "calibrate",
    "check",
    "forget",
    "loaded_world",
    "make_dataset",
    "make_shard",
    "make_shards",
    "refuse_worlds",
]


PARTIAL_GROUP = re.compile(r"zarr\.[0-9a-f]{32}\.partial")
"""Partial file that a killed writer may leave in an otherwise empty folder. Any other file belongs to the user."""

ROUNDS = 3
"""Number of passes over the shards that are still missing."""

SHARDS_TO_CHECK = 32
"""Number of shards of a large data set that are searched for empty frames; `mitsonar dataset check` reads all."""


@dataclass(frozen=True)
class GenerationReport:
    """Report of :func:`make_dataset`.

    Attributes:
        url: of the store.
        frames: number of frames of the data set.
        new_shards: number of shards that this call wrote.
        shards: number of shards of the data set.
        warnings: one sentence each.
    """

    url: str
    frames: int
    new_shards: int
    shards: int
    warnings: list[str]


def make_dataset(
    recipe: Recipe,
    url: str,
    *,
    sequences: int | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    verify: bool = False,
    begun: Callable[[int, int], None] = lambda frames, done: None,
    progress: Callable[[int], None] = lambda frames: None,
) -> GenerationReport:
    """Make a data set, or continue one that was interrupted; the result is the same bit for bit.

    Args:
        recipe: of the data set.
        url: folder or URL of the store.
        sequences: number of sequences to make; all of the recipe by default.
        workers: number of processes on this machine; with 1 this process renders, with all its threads.
        scheduler: address of a running dask scheduler, whose workers render instead.
        verify: whether to compare existing shards with their digests, too, and make those again that differ.
        begun: called with the number of frames of the data set and the number of those that already exist.
        progress: called with the number of frames that were added.

    Returns:
        The report.

    Raises:
        MitsonarError: the store holds another data set, another process writes to it, or it was begun with other versions.
    """
    if recipe.recorded is not None:
        raise MitsonarError(
            f"the recipe {recipe.name} describes recorded frames: `mitsonar dataset from-frames` copies them"
        )
    storage = Storage(url)
    _refuse_other_files(storage)
    with storage.locked() as check_lock:
        variant = ensure_variant()
        store = _open_or_create(storage, recipe, sequences, variant, verify)
        _clear_parts(storage)
        todo = store.missing(verify=verify)
        begun(len(store), len(store) - _frame_count(store, todo))
        written = 0
        for _ in range(ROUNDS):  # later passes replace shards that were damaged meanwhile
            if not todo:
                break
            _check_versions(store)
            store.mark_unfinished()
            for shard in make_shards(store, todo, workers=workers, scheduler=scheduler):
                check_lock()
                progress(_frame_count(store, [shard]))
            written += len(todo)
            todo = store.missing()
        if todo:
            raise MitsonarError(f"{url}: shards vanish while others are written; does another program write there?")
        store.finish()
        return GenerationReport(storage.url, len(store), written, store.shards, _warnings(store))


def _refuse_other_files(storage: Storage) -> None:
    """Refuse a folder with other files, because creating an array removes any file of the same name.

    Raises:
        MitsonarError: there are other files.
    """
    names = [name for name in storage.sizes() if not PARTIAL_GROUP.fullmatch(name)]
    if names and "zarr.json" not in names:
        raise MitsonarError(f"{storage.url} contains other files ({min(names)}) and is kept as it is: choose another -o")


def _open_or_create(storage: Storage, recipe: Recipe, sequences: int | None, variant: str, verify: bool) -> DataStore:
    """Open the existing store if it is the same data set, or create a new one."""
    count = recipe.sequences if sequences is None else sequences
    scenes_of(recipe, count)  # rejects a wrong number before anything is rendered
    if "zarr.json" in storage.sizes():
        store = DataStore.open(storage, write=True, unfinished=True)
        _check_same(store, recipe, count, variant)
        if store.ready:
            if verify:
                store.repair_planned_arrays(Plan.of(recipe, count))
            return store
    about = {**renderer_of(modality_of(recipe)).fixed_attributes(recipe), "variant": variant, "versions": versions(PACKAGES)}
    return DataStore.create(storage, recipe, Plan.of(recipe, count), about)


def _check_same(store: DataStore, recipe: Recipe, sequences: int, variant: str) -> None:
    """Check that the store was begun with this recipe, number of sequences and variant.

    Raises:
        MitsonarError: it was not; the message names the differences.
    """
    about = store.about
    requested = {**recipe.model_dump(mode="json"), "sequences": sequences}
    stored = {**about["recipe"], "sequences": about["sequences"]}
    check_same_settings(store.place.url, stored, requested, " (`mitsonar dataset info --recipe` prints the recipe)")
    if about["variant"] != variant:
        raise MitsonarError(
            f"{store.place.url} was begun with {about['variant']}, this is {variant}, which differs in the last bits: set "
            f"MITSONAR_VARIANT={about['variant']}, or choose another -o"
        )


def _check_versions(store: DataStore) -> None:
    """Check that the missing shards would be made with the same versions as the existing ones.

    Raises:
        MitsonarError: the store was begun with other versions.
    """
    changed = store.changed_versions()
    if changed:
        raise MitsonarError(
            f"{store.place.url} was begun with {', '.join(changed)}: the rest would differ from it; finish it with these "
            "versions, or choose another -o"
        )


def _clear_parts(storage: Storage) -> None:
    """Remove the partial files of a killed writer; a file gets its final name only when it is complete."""
    if storage.local:
        for name in storage.sizes():
            if name.endswith(".partial"):
                storage.remove(name)


def _split_warnings(store: DataStore) -> list[str]:
    """Return a warning if there are too few scenes or sequences for the recipe's split."""
    split = store.recipe.split
    worlds = world_numbers(store.recipe, store.scenes)[store.read("scene")]
    try:
        frames_in_part(worlds, store.read("sequence"), split, max(PARTS, key=lambda part: getattr(split, part)))
    except MitsonarError as error:
        return [str(error)]
    return []


def _frame_count(store: DataStore, shards: list[int]) -> int:
    return sum(store.frames_of(shard).stop - store.frames_of(shard).start for shard in shards)


def _warnings(store: DataStore) -> list[str]:
    """Return all warnings for the user about a finished data set, one sentence each."""
    sentences = [*_split_warnings(store)]
    without_ground = int(np.isnan(store.read("height_m")).sum())
    if without_ground:
        sentences.append(
            f"nothing is below the sonar in {without_ground:,} of {len(store):,} frames: world.size_m exceeds the scene"
        )
    return [*sentences, *_empty_frame_warnings(store), *store.modality.warnings(store.read)]


def _empty_frame_warnings(store: DataStore) -> list[str]:
    """Return a warning if frames have no echo, searching shards that are spread evenly over the data set."""
    shards = np.unique(np.linspace(0, store.shards - 1, min(SHARDS_TO_CHECK, store.shards)).round().astype(int))
    empty, frames = [], 0
    for shard in shards:
        here = store.frames_of(int(shard))
        try:
            empty += (here.start + np.flatnonzero(store.modality.empty(store.read, here))).tolist()
        except MitsonarError:  # damaged: `mitsonar dataset check` reports it
            continue
        frames += here.stop - here.start
    checked = "" if frames == len(store) else f" that were checked (of {len(store):,})"
    return [empty_sentence(empty, frames, checked)] if empty else []


# ---------------- Workers: this process, local processes or dask


SHARDS_PER_WORKER = 2
"""Number of shards assigned to a worker at a time: one in progress, one waiting."""

REFRESH_S = 1.0
"""Seconds between two updates of the list of workers."""

MAX_LOSSES = 3
"""Number of workers that may be lost on the same shard."""

WORKER_TIMEOUT_S = 90.0
"""Seconds that the scheduler may be without any worker."""

CONNECT_TIMEOUT = "10s"
"""Time limit for the scheduler's first answer, in dask's notation."""


class Future(Protocol):
    """A task of dask, which comes without type annotations."""

    status: str

    def done(self) -> bool:
        """Return whether the task has ended."""

    def exception(self) -> BaseException:
        """Return the error of a task that failed."""

    def cancel(self) -> None:
        """Cancel the task."""


class Client(Protocol):
    """A client of a dask scheduler."""

    def ncores(self) -> dict[str, int]:
        """Return the number of threads of each worker, keyed by address."""

    def submit(self, task: Callable[[str, int], int], /, *args: object, workers: list[str], pure: bool) -> Future:
        """Submit a task to one of the workers."""

    def cancel(self, futures: list[Future]) -> None:
        """Cancel tasks."""


def make_shards(store: DataStore, todo: list[int], *, workers: int = 1, scheduler: str | None = None) -> Iterator[int]:
    """Make shards, and yield the number of each when it is done.

    Args:
        store: to which the shards belong.
        todo: numbers of the shards to make.
        workers: number of processes on this machine, with one thread each; with 1 this process renders, with all its
            threads.
        scheduler: address of a running dask scheduler, whose workers render instead.

    Raises:
        MitsonarError: no scheduler answers, no worker is left, too many workers were lost on one shard, or a worker failed.
    """
    if scheduler is None and workers <= 1:
        try:
            for shard in todo:
                yield make_shard(store, shard)
        finally:
            forget()
    else:
        with _client(workers, scheduler) as client:
            yield from _distribute(client, store, Queue(todo))


@contextlib.contextmanager
def _client(workers: int, scheduler: str | None) -> Iterator[Client]:
    """Open a client of the scheduler, or start a local cluster of spawned workers with one thread each."""
    import logging

    import dask
    import distributed

    connect: Callable[..., AbstractContextManager[Client]] = distributed.Client
    start: Callable[..., AbstractContextManager[object]] = distributed.LocalCluster

    if scheduler is not None:
        try:
            connected = connect(scheduler, timeout=CONNECT_TIMEOUT, set_as_default=False)
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
        # dask's defaults return memory to the system at each release, which doubles NumPy's time, and sample the stacks
        "distributed.nanny.pre-spawn-environ": {"OMP_NUM_THREADS": "1"},
        "distributed.worker.profile.enabled": False,
        # Ctrl-C reaches every process of a terminal; workers ignore it, and this process stops them
        "distributed.worker.preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"],
    }
    quiet = logging.CRITICAL  # mitsonar reports lost workers itself
    with (
        dask.config.set(settings),
        start(
            n_workers=workers, threads_per_worker=1, memory_limit=0, dashboard_address=None, silence_logs=quiet
        ) as cluster,
        connect(cluster, set_as_default=False) as client,
    ):
        yield client


class Queue:
    """Queue of the shards to make.

    A worker gets the shard after its last one, whose scene it has already loaded. If that shard is taken, the worker starts
    a new run of consecutive shards.

    Args:
        todo: numbers of the shards.
    """

    def __init__(self, todo: list[int]) -> None:
        self.waiting = set(todo)
        self.last_shard: dict[str, int] = {}
        self.losses: Counter[int] = Counter()

    def __bool__(self) -> bool:
        return bool(self.waiting)

    def next(self, worker: str) -> int:
        """Choose the next shard for a worker."""
        shard = self.last_shard.get(worker, -2) + 1
        if shard not in self.waiting:
            first, end = self._longest()
            taken = first - 1 in self.last_shard.values()  # another worker will continue there: start in the middle
            shard = (first + end) // 2 if taken else first
        self.waiting.remove(shard)
        self.last_shard[worker] = shard
        return shard

    def _longest(self) -> tuple[int, int]:
        """Find the longest run of consecutive waiting shards, as its first shard and the one after its last."""
        waiting = np.sort(np.fromiter(self.waiting, dtype=int))
        ends = np.flatnonzero(np.append(np.diff(waiting) > 1, True)) + 1
        lengths = np.diff(ends, prepend=0)
        longest = int(lengths.argmax())
        first = int(waiting[ends[longest] - lengths[longest]])
        return first, first + int(lengths[longest])

    def give_back(self, shard: int) -> None:
        """Put a shard back whose worker was lost, so that another worker makes it.

        Raises:
            MitsonarError: too many workers were lost on this shard.
        """
        self.losses[shard] += 1
        if self.losses[shard] > MAX_LOSSES:
            raise MitsonarError(
                f"a worker was lost again and again at shard {shard} (out of memory?): use fewer workers; complete "
                "shards are kept, and the same command continues"
            )
        self.waiting.add(shard)

    def forget(self, alive: list[str]) -> None:
        """Forget the workers that are no longer alive."""
        self.last_shard = {worker: shard for worker, shard in self.last_shard.items() if worker in alive}


def _distribute(client: Client, store: DataStore, queue: Queue) -> Iterator[int]:
    """Supply every worker with shards until all are made, and yield the number of each when it is done."""
    url = store.place.root if store.place.local else store.place.url
    assigned: dict[Future, tuple[str, int]] = {}
    refreshed_s, last_worker_s, alive = 0.0, time.monotonic(), list[str]()
    try:
        while queue or assigned:
            # 1. Refresh the list of workers, and take back the shards of lost ones.
            if time.monotonic() - refreshed_s > REFRESH_S:
                alive, refreshed_s = list(client.ncores()), time.monotonic()
                queue.forget(alive)
                # dask would wait for ever for a worker that is gone
                for future in [future for future, (worker, _) in assigned.items() if worker not in alive]:
                    queue.give_back(assigned.pop(future)[1])
                    future.cancel()
            if alive:
                last_worker_s = time.monotonic()
            elif time.monotonic() - last_worker_s > WORKER_TIMEOUT_S:
                raise _no_worker(queue)
            # 2. Keep SHARDS_PER_WORKER shards assigned to every worker, so that none idles between two shards.
            for worker in alive:
                while queue and sum(owner == worker for owner, _ in assigned.values()) < SHARDS_PER_WORKER:
                    shard = queue.next(worker)
                    assigned[client.submit(_work, url, shard, workers=[worker], pure=False)] = worker, shard
            # 3. Yield finished shards, raise the error of a task, and put back the shards of workers that died.
            done = [future for future in assigned if future.done()]
            for future in done:
                shard = assigned.pop(future)[1]
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
            client.cancel(list(assigned))


def _no_worker(queue: Queue) -> MitsonarError:
    """Return the error for a scheduler without workers."""
    shards = ", ".join(map(str, queue.losses))
    cause = (
        f"workers were lost at shards {shards} and none has come back for {WORKER_TIMEOUT_S:.0f} s "
        "(out of memory?): use fewer workers"
        if shards
        else f"the scheduler has had no worker for {WORKER_TIMEOUT_S:.0f} s: start some with `dask worker ADDRESS`"
    )
    return MitsonarError(f"{cause}; complete shards are kept, and the same command continues")


def _is_lost(future: Future) -> bool:
    """Return whether the worker died, as opposed to a failure of its task."""
    from distributed import KilledWorker

    return isinstance(future.exception(), KilledWorker)


def _work(url: str, shard: int) -> int:
    """Make one shard in a dask worker, tracing rays with as many threads as the worker has.

    Raises:
        MitsonarError: this worker cannot open the store, or has other versions of the packages.
    """
    from distributed import get_worker

    use_threads(get_worker().state.nthreads)
    store = DataStore.open(url, write=True, unfinished=True)
    changed = store.changed_versions()
    if changed:
        raise MitsonarError(
            f"the store was begun with {', '.join(changed)} on {socket.gethostname()}: install the same versions everywhere"
        )
    return make_shard(store, shard)


# ---------------- Rendering and writing one shard


_RENDERER: dict[tuple[str, Scene], Renderer] = {}
"""Renderer of the last scene, keyed by everything that it depends on: the recipe and the scene's plan."""

_RENDER_LOCK = threading.Lock()
"""Lock that lets a process render one shard at a time, because the threads of a dask worker share one ray tracer."""


def make_shard(store: DataStore, shard: int) -> int:
    """Render and write one shard, and return its number; the last scene stays loaded for the next call."""
    with _RENDER_LOCK:
        ensure_variant(store.about["variant"])
        store.write_shard(shard, _shard_values(store, shard))
    return shard


def forget() -> None:
    """Close the scene that :func:`make_shard` keeps loaded."""
    if _RENDERER:
        _RENDERER.clear()
        release_memory()


def _shard_values(store: DataStore, shard: int) -> dict[str, Values]:
    """Render all arrays of a shard, keyed by name; frames of several scenes are concatenated."""
    here = store.frames_of(shard)
    scene_of = store.read("scene")[here]
    planned = {name: store.read(name, here) for name in ("pose", *store.modality.planned)}
    first_frames = _first_frames(store)
    parts: dict[str, list[Values]] = {}
    for number in np.unique(scene_of):
        rows = np.flatnonzero(scene_of == number)
        first = here.start + int(rows[0]) - first_frames[int(number)]
        scene_planned = {name: values[rows] for name, values in planned.items()}
        for name, values in _renderer(store, int(number)).recorded(scene_planned, first, store.about).items():
            parts.setdefault(name, []).append(values)
    return {name: values[0] if len(values) == 1 else np.concatenate(values) for name, values in parts.items()}


def _first_frames(store: DataStore) -> dict[int, int]:
    """Return the first frame of each scene, keyed by scene number; frames of a scene are consecutive."""
    numbers, first = np.unique(store.read("scene"), return_index=True)
    return dict(zip(numbers.tolist(), first.tolist(), strict=True))


def _renderer(store: DataStore, number: int) -> Renderer:
    """Return the renderer of a scene; the last one is cached."""
    scene = store.scenes[number]
    key = (store.recipe.model_dump_json(), scene)
    if key not in _RENDERER:
        forget()  # before the next scene is loaded: two scenes would need twice the memory
        _RENDERER[key] = renderer_of(store.modality)(store.recipe, scene)
    return _RENDERER[key]


# ---------------- Checks of a finished data set


LABEL_TOLERANCE = 1e-9
"""Tolerance of the checks of labels and of limits [m, rad]."""


def check(store: DataStore, progress: Callable[[int], None] = lambda frames: None) -> list[str]:
    """Check checksums, counts, value ranges and labels of a data set; every file is read.

    Args:
        store: of the data set.
        progress: called with the number of frames that were checked.

    Returns:
        One sentence per fault.
    """
    faults = _file_faults(store, progress)
    for check_part in (_plan_faults, _count_faults, _label_faults, _flight_faults):
        try:
            faults += check_part(store)
        except MitsonarError as error:
            faults.append(str(error))
    return faults


def _file_faults(store: DataStore, progress: Callable[[int], None]) -> list[str]:
    """Check every file against its seal, and the values against their limits."""
    faults: list[str] = []
    unwritten: list[int] = []
    empty: list[int] = []
    sizes, seals = store.place.sizes(), store.seals()
    for shard in range(store.shards):
        here = store.frames_of(shard)
        keys = [store.key(name, shard) for name in store.rendered]
        missing = [key for key in keys if key not in sizes]
        # Values are only checked in shards that are complete and undamaged.
        if missing or not seals[shard].any():
            unwritten.append(shard)
        else:
            damaged = store.damaged(shard, seals[shard])
            for key in damaged:
                size = int(seals[shard][keys.index(key), 0])
                faults.append(
                    f"{key} is damaged (frames {here.start}..{here.stop - 1}): "
                    + (f"{sizes[key]} bytes, sealed with {size}" if sizes[key] != size else "its content was changed")
                )
            if not damaged:
                faults += store.modality.faults(store.read, here)
                empty += (here.start + np.flatnonzero(store.modality.empty(store.read, here))).tolist()
        progress(here.stop - here.start)
    if empty:
        faults.append(empty_sentence(empty, len(store)))
    if unwritten:
        which = ", ".join(map(str, unwritten[:10])) + (" ..." if len(unwritten) > 10 else "")
        state = "is damaged" if store.finished else "is not finished"
        faults.append(
            f"{store.place.url} {state}: {len(unwritten)} of {store.shards} shards are not written ({which}); the same "
            "`mitsonar dataset make` makes them"
        )
    return faults


def _plan_faults(store: DataStore) -> list[str]:
    """Check the planned arrays against a new plan from recipe and seed."""
    if store.recipe.recorded is not None:  # recorded frames come with their poses, there is no plan
        return []
    plan = Plan.of(store.recipe, int(store.about["sequences"]))
    return [f"{name} differs from the plan of recipe and seed" for name in store.deviating_arrays(plan)]


def _count_faults(store: DataStore) -> list[str]:
    """Check the numbers of frames, sequences and scenes."""
    about, faults = store.about, []
    scene, sequence = store.read("scene"), store.read("sequence")
    lengths = np.bincount(sequence)
    if len(scene) != about["frames"] or len(lengths) != about["sequences"]:
        faults.append(f"{len(scene)} frames in {len(lengths)} sequences, {about['frames']} in {about['sequences']} expected")
    if (np.diff(sequence) < 0).any() or (np.diff(sequence) > 1).any():
        faults.append("sequences are not numbered one after the other")
    if store.recipe.flight.kind == "random" and (lengths != store.recipe.flight.pings).any():
        faults.append(f"sequences of {sorted(set(lengths.tolist()))} frames, the recipe has {store.recipe.flight.pings}")
    _, first = np.unique(sequence, return_index=True)
    for number, planned in store.scenes.items():
        count = int((scene[first] == number).sum())
        if count != planned.sequences:
            faults.append(f"scene {number} has {count} sequences, {planned.sequences} expected")
    for name, axis in store.modality.axes.items():
        if not np.array_equal(store.read(name), axis.values):
            faults.append(f"{name} differs from that of the recipe's sonar")
    return faults


def _vehicle_poses(store: DataStore) -> NDArray[np.float64]:
    return store.read("vehicle_pose" if "vehicle_pose" in store.group else "pose")


def _label_faults(store: DataStore) -> list[str]:
    """Check the motions against the poses."""
    sequence, motion, vehicle = store.read("sequence"), store.read("motion"), _vehicle_poses(store)
    inner = np.append(sequence[1:] == sequence[:-1], False)
    faults = []
    if not np.isnan(motion[~inner]).all():
        faults.append("the last frame of a sequence has a motion")
    error = np.abs(motions(vehicle) - motion[:-1])[inner[:-1]]
    if error.size and not error.max() <= LABEL_TOLERANCE:
        faults.append(f"labels differ from poses by up to {error.max():.1e} (m, rad), allowed {LABEL_TOLERANCE:g}")
    return faults


def _flight_faults(store: DataStore) -> list[str]:
    """Check that motions and jumps are within their limits, and that footprints lie inside their scenes."""
    recipe = store.recipe
    flight = recipe.flight
    if flight.kind != "random":
        return []
    faults = []
    sequence, motion, scene = (store.read(name) for name in ("sequence", "motion", "scene"))
    vehicle = _vehicle_poses(store)
    limit = np.array([flight.sideways_mm / 1e3, flight.forward_mm / 1e3, np.radians(flight.yaw_deg)])
    if motion.size and np.nanmax(np.abs(np.nan_to_num(motion)) - limit) > LABEL_TOLERANCE:
        faults.append("motions exceed the recipe's limits")
    border = np.flatnonzero((sequence[1:] != sequence[:-1]) & (scene[1:] == scene[:-1]))
    if flight.jump_m is not None and border.size:
        jump = np.abs(vehicle[border + 1, :2] - vehicle[border, :2])
        low, high = flight.jump_m
        if jump.min() < low - LABEL_TOLERANCE or jump.max() > high + LABEL_TOLERANCE:
            faults.append(f"jumps of {jump.min():.4f}..{jump.max():.4f} m, the recipe has {low:g}..{high:g}")
    excess_m = _footprint_excess_m(store, vehicle, scene)
    if excess_m > LABEL_TOLERANCE:
        faults.append(f"a footprint leaves its scene by {excess_m:.3g} m")
    return faults


def _footprint_excess_m(store: DataStore, vehicle: NDArray[np.float64], scene: NDArray[np.int32]) -> float:
    """Compute the largest distance by which a footprint leaves its scene [m]; negative if all lie inside."""
    recipe = store.recipe
    # Half the side of each frame's scene.
    half_m = {number: recipe.family(one.group).half_m for number, one in store.scenes.items()}
    limit_m = np.array([half_m[int(number)] for number in scene])
    excess_m = -np.inf
    # If no vehicle poses are stored, they differ from those of the sonar by the pitch of the mount only.
    mount_pitch = 0.0 if "vehicle_pose" in store.group else recipe.mount.pose.pitch
    attitudes = np.column_stack([vehicle[:, 2], np.round(vehicle[:, 3] - mount_pitch, 9)])
    # Frames at the same height and pitch share one footprint.
    for height, pitch in np.unique(attitudes, axis=0):
        rows = (attitudes == (height, pitch)).all(axis=1)
        corners = np.abs(footprints_at(vehicle[rows], store.modality.reach(float(height), float(pitch))))
        excess_m = max(excess_m, float((corners.max(axis=(1, 2)) - limit_m[rows]).max()))
    return excess_m


# ---------------- Rendering images, for stores and for training


VISIBLE = 1e-4
"""Smallest expected level of a cell with a visible label, as a fraction of full scale; it must also exceed the noise."""

FRAMES_A_SCENE = 10_000_000
"""Stride of ping numbers between scenes. A ping's number is its scene's number times this, plus its position in the scene,
so jitter does not depend on the size of the data set."""


class SceneRenderer:
    """Renderer of images of one scene, which it builds and loads.

    Args:
        recipe: of the data set.
        scene: the scene to render.
    """

    def __init__(self, recipe: Recipe, scene: Scene) -> None:
        self.recipe, self.scene = recipe, scene
        world, sonar = loaded_world(recipe, scene), instrument_in(recipe, scene)
        self.simulator = Simulator(world, sonar, views=recipe.views, mirrors=recipe.mirrors)
        self.bodies = body_places(recipe, self.simulator.motion)
        self._labeller: Simulator | None = None
        if recipe.labels and recipe.visible_labels:  # expected levels, over everything that the patterns receive
            patterns = {"pattern": sonar.beam_pattern, "elevation_pattern": sonar.vertical_pattern}
            self._labeller = Simulator(world, sonar.replace(model="physical", **patterns))

    @staticmethod
    def fixed_attributes(recipe: Recipe) -> Fields:
        """Compute the gain of the data set, its inverse, and, if shapes are labelled, the shape names of scene files.

        See :func:`calibrate` for the gain. The names are a list for each group of scenes; it is empty for generated worlds.
        """
        refuse_worlds(recipe)
        gain = calibrate(recipe)
        attributes: Fields = {"gain": gain, "level_scale": 1 / gain}
        groups = range(len(recipe.scenes))
        if "shape_id" in recipe.labels and any(recipe.family(group).called == "scene" for group in groups):
            names_by_family: dict[str, list[str]] = {}
            for group in groups:
                family = recipe.family(group)
                if repr(family) not in names_by_family:
                    scene = Scene(0, group, world_seed(recipe.seed, 0), 1)
                    is_file = family.called == "scene"
                    names_by_family[repr(family)] = list(shape_names_in(loaded_world(recipe, scene))) if is_file else []
            attributes["shape_names"] = [names_by_family[repr(recipe.family(group))] for group in groups]
        return attributes

    def render_views(self, poses: NDArray[np.float64], first: int, *, labels: bool = False) -> Iterator[list[RenderedPings]]:
        """Render the levels of frames ``first``, ``first + 1`` ... of the scene, and yield batches with one part per view.

        Moving bodies of the scene file are placed at the time frame / ``frame_rate_hz``.
        """
        time_s = self._time_s(first, len(poses))
        number = self.scene.number * FRAMES_A_SCENE + first
        return self.simulator.render_views(poses, first=number, labels=labels, time_s=time_s)

    def frames(self, poses: NDArray[np.float64], first: int, gain: float) -> dict[str, Values]:
        """Render frames of the scene, and return the arrays to store ``(frames, ...)``, keyed by name.

        Args:
            poses: of the sonar ``(frames, 6)`` [m, rad].
            first: number of the first frame in the scene.
            gain: of the data set.
        """
        values = self._allocate(len(poses))
        # 1. Pixels, and labels unless a second simulator makes them.
        for batch in self.render_views(poses, first, labels=bool(self.recipe.labels) and self._labeller is None):
            start = batch[0].first - (self.scene.number * FRAMES_A_SCENE + first)
            self._fill({name: array[start : start + len(batch[0])] for name, array in values.items()}, batch, gain)
        # 2. Visible labels: only cells whose expected level exceeds the noise and VISIBLE keep theirs.
        if self._labeller is not None:
            number = self.scene.number * FRAMES_A_SCENE + first
            for pings in self._labeller.pings(poses, first=number, labels=True, time_s=self._time_s(first, len(poses))):
                here = slice(pings.first - number, pings.first - number + len(pings))
                floor = np.maximum(VISIBLE, gain * noise_of(self.simulator.sonar))[:, None]
                for label, shown in labels_above(pings, gain, floor).items():
                    if label in self.recipe.labels:
                        values[label][here] = shown
        # 3. States of the moving bodies, as functions of time.
        if self.bodies:
            states = self.simulator.bodies(self._time_s(first, len(poses)))
            assert states.poses is not None
            assert states.velocities is not None
            values["body_pose"][:] = states.poses[:, self.bodies]
            values["body_velocity"][:] = states.velocities[:, self.bodies]
        return values

    def _time_s(self, first: int, frames: int) -> NDArray[np.float64]:
        """Return the times ``(frames,)`` [s] of frames of the scene, which determine where its moving bodies are."""
        return np.asarray((first + np.arange(frames)) / self.simulator.sonar.frame_rate_hz, dtype=np.float64)

    def recorded(self, planned: dict[str, Values], first: int, about: Fields) -> dict[str, Values]:
        """Render frames at the planned poses; see :class:`~mitsonar.datasets.modality.Renderer`."""
        return self.frames(planned["pose"], first, float(about["gain"]))

    def _allocate(self, frames: int) -> dict[str, Values]:
        """Allocate the arrays to fill, with zeros."""
        stored = ImageModality(self.recipe).stored
        return {name: np.zeros((frames, *one.shape), dtype=one.kind) for name, one in stored.items()}

    def _fill(self, values: dict[str, Values], batch: list[RenderedPings], gain: float) -> None:
        """Write the stored quantities of one batch into the arrays."""
        values["height_m"][:] = batch[0].height_m
        for view, pings in zip(self.simulator.views, batch, strict=True):
            suffix = self.recipe.suffix(view.name)
            outside = (pings.counts.nearer + pings.counts.farther).sum(axis=1).astype(np.uint32)
            np.maximum(values["dropped"], outside, out=values["dropped"])  # views overlap: a sum would count twice
            for number, levels in enumerate(pings.levels):  # frame by frame: a frame fits the cache, a batch does not
                image = to_image(levels, gain, view.sonar)
                values["saturated"][number] += np.count_nonzero(image >= 1)
                if f"image{suffix}" in values:
                    values[f"image{suffix}"][number] = to_uint8(image) if self.recipe.pixel == "uint8" else image
                if f"vector{suffix}" in values:
                    values[f"vector{suffix}"][number] = image.sum(axis=1, dtype=np.float64)
                    values[f"nonzero{suffix}"][number] = np.count_nonzero(image, axis=1)
            for label in pings.labels and self.recipe.labels:
                values[f"{label}{suffix}"][:] = pings.labels[label]


def instrument_in(recipe: Recipe, scene: Scene) -> Sonar:
    """Return the sonar for a scene.

    A coherent sonar gets a different seed in each scene, because the seed determines the scatterers behind its speckle. If
    the recipe has ``noise_db``, the noise level is raised by the scene's value.
    """
    sonar = recipe.instrument
    if sonar.model != "coherent":
        return sonar
    seed = int(np.random.SeedSequence([recipe.seed, scene.number]).generate_state(1)[0])
    if sonar.noise_level_db is None or not recipe.noise_db:
        return sonar.replace(seed=seed)
    return sonar.replace(seed=seed, noise_level_db=sonar.noise_level_db + float(recipe.noise_raised_db(scene.number)))


def body_places(recipe: Recipe, motion: SceneMotion | None) -> list[int]:
    """Return the indices of the recipe's bodies among the moving bodies of a scene.

    Raises:
        MitsonarError: one of the recipe's bodies does not move in the scene.
    """
    moving = () if motion is None else motion.bodies.names
    for name in recipe.bodies:
        if name not in moving:
            hint = suggest_names(name, moving) if moving else "nothing moves there"
            raise MitsonarError(f"bodies: no body {short_repr(name)} moves in the scene: {hint}")
    return [moving.index(name) for name in recipe.bodies]


def loaded_world(recipe: Recipe, scene: Scene) -> mi.Scene:
    """Build a scene's world in a temporary folder, and load it.

    Raises:
        MitsonarError: the world is a scene file of the user and smaller than the recipe states.
    """
    with tempfile.TemporaryDirectory(prefix="mitsonar-world-") as folder:
        family = recipe.family(scene.group)
        path, parameters = family.prepare(scene.seed, Path(folder) / "world")
        loaded = load_scene(path, **parameters)
        extent = loaded.bbox()
        family.check_scene_extent(np.array(extent.min, dtype=float).ravel(), np.array(extent.max, dtype=float).ravel())
        return loaded


def refuse_worlds(recipe: Recipe) -> None:
    """Refuse scene files that are smaller than the recipe states, and worlds that lack its mirrors or moving bodies.

    The check renders nothing. It loads one world of each group of scenes.

    Raises:
        MitsonarError: a world is smaller than its ``size_m``, lacks a mirror or a moving body, or cannot be loaded.
    """
    from mitsonar.simulation.mirrors import mirror_of
    from mitsonar.simulation.moving import motion_in

    families = [recipe.family(group) for group in range(len(recipe.scenes))]
    check_all = bool(recipe.mirrors or recipe.bodies)
    groups = {repr(family): group for group, family in enumerate(families) if check_all or not family.seeded}
    for group in groups.values():
        world = loaded_world(recipe, Scene(0, group, world_seed(recipe.seed, 0), 1))
        body_places(recipe, motion_in(world, None) if recipe.bodies else None)
        if mirror_of(world, recipe.mirrors) is None and recipe.mirrors:
            raise MitsonarError(
                f"mirrors: no shape of the worlds of scenes.{group} reflects: got {recipe.mirrors}; give [reflection, rms "
                "height in m] by the ids of shapes, or shapes of materials that have both"
            )
    if groups:
        release_memory()


def calibrate(recipe: Recipe) -> float:
    """Compute the gain that maps the 99.9th percentile of all pixels in the first 20 frames of the first scene to 0.9.

    The frames are those of the whole recipe, even if fewer are made. If the recipe gives a gain, such as that of another
    data set of the same sonar, it is returned unchanged.

    Raises:
        MitsonarError: these frames are empty.
    """
    if recipe.gain is not None:
        return recipe.gain
    scene = scenes_of(recipe, recipe.sequences)[0]
    poses = []
    for sequence in sequences_of(recipe, scene):
        poses.append(mounted(sequence.vehicle, recipe.mount.pose))
        if sum(map(len, poses)) >= CALIBRATION_FRAMES:
            break
    table = np.concatenate(poses)[:CALIBRATION_FRAMES]
    renderer = SceneRenderer(recipe, scene)
    batches = list(renderer.render_views(table, 0))
    del renderer
    release_memory()
    if not any(pings.levels.any() for batch in batches for pings in batch):
        raise MitsonarError(
            "the first frames are empty: no ray met anything within the window; check height_m, mount, range_min and "
            "range_max"
        )
    return constant_gain([_join_views(batches)])[0]


def _join_views(batches: list[list[RenderedPings]]) -> RenderedPings:
    """Join all views of all frames into frames of one column, because one gain applies to all views."""
    first = batches[0][0]
    frames = []
    for batch in batches:
        frames += [np.concatenate([pings.levels[k].ravel() for pings in batch]) for k in range(len(batch[0]))]
    return RenderedPings(first.first, np.stack(frames)[:, :, None], first.counts, first.height_m)


# ---------------- Rendering impulse responses


class ResponseRenderer:
    """Renderer of impulse responses of one scene, which it builds and loads.

    Args:
        recipe: of the data set.
        scene: the scene to render.
    """

    def __init__(self, recipe: Recipe, scene: Scene) -> None:
        self.simulator = ChannelSimulator(loaded_world(recipe, scene), recipe.channel_sonar, mirrors=recipe.mirrors)

    @staticmethod
    def fixed_attributes(recipe: Recipe) -> Fields:
        """Check that the worlds have the recipe's mirrors, and return no attributes, because responses have no gain."""
        refuse_worlds(recipe)
        return {}

    def recorded(self, planned: dict[str, Values], first: int, about: Fields) -> dict[str, Values]:
        """Simulate responses at the planned poses and velocities; see :class:`~mitsonar.datasets.modality.Renderer`."""
        parts = list(self.simulator.pings(planned["pose"], planned["velocity"], first=first))
        names = ("response", "height_m", "echoes", "dropped")
        return {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
