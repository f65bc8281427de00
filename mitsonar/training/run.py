"""How a network is trained, from the recipe to the checkpoint, and how an interrupted run is resumed.

A run may be killed at any moment. A resumed run ends with the same bits, on a CPU with the same number of threads, because
sample order, noise and dropout depend only on (seed, epoch, index) and (seed, step).
"""

from __future__ import annotations

import importlib.util
import logging
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import lightning
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch.utils import deterministic

from mitsonar.config.training import TrainingRecipe, load_training_recipe
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.io.runs import RunDirectory, other_versions
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.training.data import JsonObject, Material, material_of
from mitsonar.training.journal import EVENTS, STATE_MINUTES, Journal, Pace, RunFolder, StateFile, TrainingReport
from mitsonar.training.step import NetworkTraining, network_for

__all__ = ["TrainingReport", "leads", "train"]

MOST_AT_ONCE = 1024
"""Largest valid number of threads or processes in the record of a run."""


def train(
    recipe: TrainingRecipe | str | Path,
    data: str | Path | Sequence[str | Path] | None,
    out: str | Path,
    *,
    render: bool = False,
    minutes: float | None = None,
    resume: bool = False,
    overwrite: bool = False,
    scale: float | None = None,
    pairs: int | None = None,
    accelerator: str = "auto",
    devices: str | int = "auto",
    strategy: str = "auto",
    precision: str | None = None,
    threads: int | None = None,
    workers: int | None = None,
    state_minutes: float = STATE_MINUTES,
    progress: Callable[[TrainingReport], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Checkpoint:
    """Train a network, and return the best one by validation at the noise of training.

    Args:
        recipe: training recipe, its name, or a YAML file.
        data: path or URL of a data set, or of several data sets of one sonar, which are joined, such as one per model.
        out: folder of the run.
        render: render samples during training, by the recipe of ``data`` or else by the one that ``recipe`` names.
        minutes: total duration after which training stops [min], including validation and earlier parts of a resumed run.
        resume: resume the run in ``out``, or start a new run if there is none.
        overwrite: replace a run in ``out``.
        scale: fraction of the data to use, which multiplies ``part_of_data`` of the recipe.
        pairs: length of the training in samples, which replaces that of the recipe.
        accelerator: as in Lightning's trainer.
        devices: as in Lightning's trainer.
        strategy: as in Lightning's trainer.
        precision: as in Lightning's trainer; replaces that of the recipe.
        threads: number of CPU threads.
        workers: number of processes that read or render; by default it depends on the machine.
        state_minutes: time between two states on disk [min].
        progress: called after each step.
        stop: called after each step; if it returns true, the state is saved and training stops.

    Raises:
        MitsonarError: arguments contradict each other, which is checked before training begins, or the loss is not finite.
    """
    recipe, folder = _changed(recipe, scale, pairs, precision), RunFolder(Path(out), writes=leads())
    hardware = _Hardware(accelerator, devices, strategy, threads, workers)
    run = _Run(recipe, data, folder, render, resume, overwrite)
    return run.train(hardware, Pace(minutes, state_minutes, progress, stop))


@dataclass(frozen=True)
class _Hardware:
    """Options of the hardware and the processes of a training; see :func:`train`."""

    accelerator: str
    devices: str | int
    strategy: str
    threads: int | None
    workers: int | None


@dataclass(frozen=True)
class _Run:
    """A training run: its recipe, data and folder; see :func:`train`."""

    recipe: TrainingRecipe
    data: str | Path | Sequence[str | Path] | None
    folder: RunFolder
    render: bool
    resume: bool
    overwrite: bool

    def train(self, hardware: _Hardware, pace: Pace) -> Checkpoint:
        """Train, or resume training, and return the best network."""
        if pace.minutes is not None and not pace.minutes > 0:
            raise MitsonarError(f"--minutes must be above 0: got {pace.minutes:g}")
        if hardware.threads is not None and hardware.threads < 1:
            raise MitsonarError(f"--threads must be at least 1: got {hardware.threads}")
        known = self.folder.known() if self.resume else None
        gain = None if known is None else known.amount("gain")
        threads = hardware.threads or (known.count("threads", MOST_AT_ONCE) if known is not None else None)
        material = material_of(self.recipe, self.data, render=self.render, gain=gain)
        network = network_for(self.recipe, material)
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # faster convolutions
        with _quiet(), _settings(threads), torch.random.fork_rng(devices=[]):
            module = NetworkTraining(network, self.recipe, material)
            journal = Journal(self.folder, module, material, pace)
            trainer = _trainer(module, self.folder, journal, hardware)
            workers = _workers(hardware.workers, known, self.render, trainer)
            self._begin(material, module, trainer, workers)
            self._fit(module, journal, trainer, workers)
        if journal.stopped:
            raise KeyboardInterrupt
        return Checkpoint.load(self.folder.path)

    def _begin(self, material: Material, module: NetworkTraining, trainer: lightning.Trainer, workers: int) -> None:
        """Create the folder of the run, or check that it contains the same run."""
        asked = {
            "data": material.about["name"],
            "digest": material.about["digest"],
            "render": self.render,
            "workers": workers if self.render else None,
            "world_size": trainer.world_size,
        }
        notes = {
            "gain": material.about["gain"],
            "threads": torch.get_num_threads(),
            "accelerator": type(trainer.accelerator).__name__,
            "epoch_samples": material.epoch,
            "steps": module.steps,
        }
        earlier = self.folder.begin(self.recipe, asked, notes, resume=self.resume, overwrite=self.overwrite)
        _warn_of_other_bits(earlier, notes)

    def _fit(self, module: NetworkTraining, journal: Journal, trainer: lightning.Trainer, workers: int) -> None:
        """Train from the last state, if steps and minutes are left.

        Raises:
            MitsonarError: no minutes are left, but no network has been saved.
        """
        minutes = journal.pace.minutes
        state = self.folder.state if self.resume and self.folder.state.is_file() else None
        done, used = _position(state, journal)
        if done < module.steps and minutes is not None and used >= minutes and not self.folder.network.is_file():
            raise MitsonarError(
                f"the run in {self.folder.path} was stopped before it validated once, and has used its {minutes:g} minutes "
                f"({used:.1f}): resume it with more"
            )
        if done < module.steps and (minutes is None or used < minutes):
            module.workers = workers
            trainer.fit(module, ckpt_path=state, weights_only=True)


def _position(state: Path | None, journal: Journal) -> tuple[int, float]:
    """Return the steps done and minutes used in a state; zeros without a state."""
    if state is None:
        return 0, 0.0
    begun = StateFile().load_checkpoint(state)
    return begun["global_step"], float(begun["callbacks"][journal.state_key]["minutes"])


def leads() -> bool:
    """Return whether this process is the one that writes and prints, if Lightning has started several."""
    return all(os.environ.get(name, "0") == "0" for name in ("LOCAL_RANK", "NODE_RANK", "SLURM_PROCID"))


def _changed(
    recipe: TrainingRecipe | str | Path, scale: float | None, pairs: int | None, precision: str | None
) -> TrainingRecipe:
    """Load a recipe and apply the arguments that change it; the result is saved in the folder of the run."""
    recipe = recipe if isinstance(recipe, TrainingRecipe) else load_training_recipe(recipe)
    changes: JsonObject = {}
    if scale is not None:
        if not 0 < scale <= 1:
            raise MitsonarError(f"--scale must lie in 0..1: got {scale:g}")
        changes["part_of_data"] = scale * recipe.part_of_data
    if pairs is not None:
        if pairs < recipe.batch:
            raise MitsonarError(f"--pairs must be at least a batch, {recipe.batch}: got {pairs}")
        changes |= {"steps": pairs // recipe.batch, "epochs": None}
    if precision is not None:
        changes["precision"] = precision
    return recipe.replace(**changes) if changes else recipe


def _trainer(module: NetworkTraining, folder: RunFolder, journal: Journal, hardware: _Hardware) -> lightning.Trainer:
    """Create Lightning's trainer.

    Raises:
        MitsonarError: Lightning rejects an argument, or a batch cannot be divided equally among the devices.
    """
    try:
        trainer = lightning.Trainer(
            accelerator=hardware.accelerator,
            devices=hardware.devices,
            strategy=hardware.strategy,
            precision=module.recipe.precision,
            max_steps=module.steps,
            max_epochs=-1,
            gradient_clip_val=module.recipe.optimiser.clip,
            callbacks=[journal],
            plugins=[StateFile()],
            logger=_tensorboard(folder),
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            use_distributed_sampler=False,
            default_root_dir=folder.path,
        )
    except Exception as error:  # Lightning raises exceptions of many kinds for missing hardware
        raise MitsonarError(
            f"accelerator {hardware.accelerator}, devices {hardware.devices}, strategy {hardware.strategy}, precision "
            f"{module.recipe.precision} do not work here: {str(error).splitlines()[0]}"
        ) from None
    if module.recipe.batch % trainer.world_size:
        raise MitsonarError(
            f"a batch of {module.recipe.batch} cannot be shared by {trainer.world_size} devices: choose another batch, or "
            "--devices 1"
        )
    if trainer.strategy.root_device.type == "cpu":
        torch.use_deterministic_algorithms(True)
        deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]  # saves a seventh of the time
    return trainer


def _tensorboard(folder: RunFolder) -> TensorBoardLogger | bool:
    """Return the logger for TensorBoard; False if TensorBoard is not installed or this process does not write."""
    if not folder.writes or importlib.util.find_spec("tensorboard") is None:
        return False
    return TensorBoardLogger(folder.path, name="", version=EVENTS)


def _workers(workers: int | None, known: RunDirectory | None, render: bool, trainer: lightning.Trainer) -> int:
    """Return the number of processes that read or render: that of the earlier run, or one that suits the machine."""
    if workers is not None:
        if workers < 0:
            raise MitsonarError(f"--workers must be at least 0: got {workers}")
        return workers
    cores = len(os.sched_getaffinity(0)) // max(1, trainer.world_size)
    on_cpu = trainer.strategy.root_device.type == "cpu"
    if render:
        had = None if known is None else known.asked.get("workers")
        usual = max(1, cores // 2 if on_cpu else cores - 1)
        return had if isinstance(had, int) and 0 <= had <= MOST_AT_ONCE else usual
    return (1 if cores > 2 else 0) if on_cpu else max(1, min(8, cores - 1))


def _warn_of_other_bits(had: RunDirectory | None, notes: JsonObject) -> None:
    """Warn of differences because of which a resumed run ends with other bits than an uninterrupted one."""
    if had is None:
        return
    other = [
        f"{key} {had.notes.get(key)} (now {notes[key]})"
        for key in ("threads", "accelerator")
        if had.notes.get(key) != notes[key]
    ]
    for change in other + other_versions(had.versions, ("mitsonar", "torch")):
        warnings.warn(
            f"the run was begun with {change}: it goes on, but not to the same bits", MitsonarWarning, stacklevel=5
        )


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Lightning; everything important is raised as an error or part of a report."""
    logs = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric", "lightning_utilities")]
    levels = [log.level for log in logs]
    with warnings.catch_warnings():
        for origin in ("lightning", "torch"):
            warnings.filterwarnings("ignore", module=origin)
        for log in logs:
            log.setLevel(logging.ERROR)
        try:
            yield
        finally:
            for log, level in zip(logs, levels, strict=True):
                log.setLevel(level)


@contextmanager
def _settings(threads: int | None) -> Iterator[None]:
    """Set torch's number of threads for this training, and restore threads and algorithms afterwards."""
    had, exact = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    warn_only = torch.is_deterministic_algorithms_warn_only_enabled()
    filled = deterministic.fill_uninitialized_memory  # type: ignore[attr-defined]
    if threads:
        torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(had)
        torch.use_deterministic_algorithms(exact, warn_only=warn_only)
        deterministic.fill_uninitialized_memory = filled  # type: ignore[attr-defined]
