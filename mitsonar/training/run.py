"""How a network is trained, from the recipe to the checkpoint, and how an interrupted run is resumed.

A run may be killed at any moment. A resumed run ends with the same bits, on a CPU with the same number of threads, because
sample order, noise and dropout depend only on (seed, epoch, index) and (seed, step).
"""

from __future__ import annotations

import importlib.util
import logging
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import lightning
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch.utils import deterministic

from mitsonar.config.training import TrainOptions
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.io.runs import RunDirectory, changed_versions
from mitsonar.io.system import usable_cores
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.training.data import JsonObject, material_of
from mitsonar.training.journal import EVENTS, Journal, RunFolder, StateFile, TrainingReport
from mitsonar.training.step import NetworkTraining, network_for

__all__ = ["is_main_process", "train"]

MAX_COUNT = 1024
"""Largest valid number of threads or processes in the record of a run."""


def train(
    options: TrainOptions,
    *,
    progress: Callable[[TrainingReport], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Checkpoint:
    """Train a network, or resume its training, and return the best one by validation at the noise of training.

    Args:
        options: of the training.
        progress: called after each step.
        stop: called after each step; if it returns true, the state is saved and training stops.

    Raises:
        MitsonarError: options contradict each other, which is checked before training begins, or the loss or the weights
            are not finite.
    """
    recipe, folder = options.changed_recipe(), RunFolder(Path(options.out), writes=is_main_process())
    earlier = folder.earlier_run() if options.resume else None
    gain = None if earlier is None else earlier.amount("gain")
    threads = options.threads or (earlier.count("threads", MAX_COUNT) if earlier is not None else None)
    material = material_of(recipe, options.data, render=options.render, gain=gain)
    network = network_for(recipe, material)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # faster convolutions
    with _quiet(), _settings(threads), torch.random.fork_rng(devices=[]):
        module = NetworkTraining(network, recipe, material)
        journal = Journal(folder, module, material, options, progress, stop)
        trainer = _trainer(journal, options)
        module.workers = _workers(options, earlier, trainer)
        _begin(journal, trainer, options)
        _fit(journal, trainer, options)
    if journal.stopped:
        raise KeyboardInterrupt
    if not folder.network.is_file():
        raise MitsonarError(
            f"the training in {folder.path} kept no network: its weights were not finite at any validation; set a lower "
            "optimiser.rate, or optimiser.clip=1, and check the data with `mitsonar dataset check`"
        )
    return Checkpoint.load(folder.path)


def _begin(journal: Journal, trainer: lightning.Trainer, options: TrainOptions) -> None:
    """Create the folder of the run, or check that it contains the same run."""
    material, module = journal.material, journal.module
    arguments = {
        "data": material.about["name"],
        "digest": material.about["digest"],
        "render": options.render,
        "workers": module.workers if options.render else None,
        "world_size": trainer.world_size,
    }
    notes = {
        "gain": material.about["gain"],
        "threads": torch.get_num_threads(),
        "accelerator": type(trainer.accelerator).__name__,
        "epoch_samples": material.epoch,
        "steps": module.steps,
    }
    earlier = journal.folder.begin(module.recipe, arguments, notes, resume=options.resume, overwrite=options.overwrite)
    _warn_of_changes(earlier, notes)


def _fit(journal: Journal, trainer: lightning.Trainer, options: TrainOptions) -> None:
    """Train from the last state, if steps and minutes are left.

    Raises:
        MitsonarError: no minutes are left, but no network has been saved.
    """
    folder, steps, minutes = journal.folder, journal.module.steps, options.minutes
    state = folder.state if options.resume and folder.state.is_file() else None
    done, used = _position(state, journal)
    if done < steps and minutes is not None and used >= minutes and not folder.network.is_file():
        raise MitsonarError(
            f"the run in {folder.path} was stopped before it validated once, and has used its {minutes:g} minutes "
            f"({used:.1f}): resume it with more"
        )
    if done < steps and (minutes is None or used < minutes):
        trainer.fit(journal.module, ckpt_path=state, weights_only=True)


def _position(state: Path | None, journal: Journal) -> tuple[int, float]:
    """Return the steps done and minutes used in a state; zeros without a state."""
    if state is None:
        return 0, 0.0
    state_dict = StateFile().load_checkpoint(state)
    return state_dict["global_step"], float(state_dict["callbacks"][journal.state_key]["minutes"])


def is_main_process() -> bool:
    """Return whether this process is the one that writes and prints, if Lightning has started several."""
    return all(os.environ.get(name, "0") == "0" for name in ("LOCAL_RANK", "NODE_RANK", "SLURM_PROCID"))


def _trainer(journal: Journal, options: TrainOptions) -> lightning.Trainer:
    """Create Lightning's trainer.

    Raises:
        MitsonarError: Lightning rejects an argument, a processor would train in half precision, or a batch cannot be
            divided equally among the devices.
    """
    module, folder = journal.module, journal.folder
    try:
        trainer = lightning.Trainer(
            accelerator=options.accelerator,
            devices=options.devices,
            strategy=options.strategy,
            precision=module.recipe.precision,
            max_steps=module.steps,
            max_epochs=-1,
            gradient_clip_val=module.recipe.optimiser.clip,
            callbacks=[journal],
            plugins=[StateFile()],
            logger=_tensorboard(folder),
            benchmark=options.accelerator != "cpu",  # of convolutions: their sizes never change
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            use_distributed_sampler=False,
            default_root_dir=folder.path,
        )
    except Exception as error:  # Lightning raises exceptions of many kinds for missing hardware
        raise MitsonarError(
            f"accelerator {options.accelerator}, devices {options.devices}, strategy {options.strategy}, precision "
            f"{module.recipe.precision} do not work here: {str(error).splitlines()[0]}"
        ) from None
    on_cpu = trainer.strategy.root_device.type == "cpu"
    if on_cpu and module.recipe.precision != "32-true":
        raise MitsonarError(
            f"precision {module.recipe.precision} needs a GPU: on processors with AMX, torch computes convolutions in "
            "bfloat16 wrongly, and on others it is hardly faster; use 32-true"
        )
    if module.recipe.batch % trainer.world_size:
        raise MitsonarError(
            f"a batch of {module.recipe.batch} cannot be shared by {trainer.world_size} devices: choose another batch, or "
            "--devices 1"
        )
    if on_cpu:
        torch.use_deterministic_algorithms(True)
        deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]  # saves a seventh of the time
    return trainer


def _tensorboard(folder: RunFolder) -> TensorBoardLogger | bool:
    """Return the logger for TensorBoard; False if TensorBoard is not installed or this process does not write."""
    if not folder.writes or importlib.util.find_spec("tensorboard") is None:
        return False
    return TensorBoardLogger(folder.path, name="", version=EVENTS)


def _workers(options: TrainOptions, earlier: RunDirectory | None, trainer: lightning.Trainer) -> int:
    """Return the number of processes that read or render: that of the earlier run, or one that suits the machine."""
    if options.workers is not None:
        return options.workers
    cores = usable_cores() // max(1, trainer.world_size)
    on_cpu = trainer.strategy.root_device.type == "cpu"
    if options.render:
        workers = None if earlier is None else earlier.settings.get("workers")
        default = max(1, cores // 2 if on_cpu else cores - 1)
        return workers if isinstance(workers, int) and 0 <= workers <= MAX_COUNT else default
    return (1 if cores > 2 else 0) if on_cpu else max(1, min(8, cores - 1))


def _warn_of_changes(earlier: RunDirectory | None, notes: JsonObject) -> None:
    """Warn of differences because of which a resumed run ends with other bits than an uninterrupted one."""
    if earlier is None:
        return
    changes = [
        f"{key} {earlier.notes.get(key)} (now {notes[key]})"
        for key in ("threads", "accelerator")
        if earlier.notes.get(key) != notes[key]
    ]
    for change in changes + changed_versions(earlier.versions, ("mitsonar", "torch")):
        warnings.warn(
            f"the run was begun with {change}: it is resumed, but will not end with the same bits",
            MitsonarWarning,
            stacklevel=4,
        )


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Lightning; everything important is raised as an error or part of a report."""
    logs = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric", "lightning_utilities")]
    levels = [logger.level for logger in logs]
    with warnings.catch_warnings():
        for origin in ("lightning", "torch"):
            warnings.filterwarnings("ignore", module=origin)
        for logger in logs:
            logger.setLevel(logging.ERROR)
        try:
            yield
        finally:
            for logger, level in zip(logs, levels, strict=True):
                logger.setLevel(level)


@contextmanager
def _settings(threads: int | None) -> Iterator[None]:
    """Set torch's number of threads for this training, and restore threads and algorithms afterwards."""
    thread_count, deterministic_algorithms = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    warn_only = torch.is_deterministic_algorithms_warn_only_enabled()
    filled = deterministic.fill_uninitialized_memory  # type: ignore[attr-defined]
    if threads:
        torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(thread_count)
        torch.use_deterministic_algorithms(deterministic_algorithms, warn_only=warn_only)
        deterministic.fill_uninitialized_memory = filled  # type: ignore[attr-defined]
