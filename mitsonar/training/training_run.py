"""A training from recipe to checkpoint, which may be killed at any moment and goes on to the same bits."""

from __future__ import annotations

import logging
import math
import os
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback
from numpy.typing import NDArray

from mitsonar.config.training_recipe import TrainingRecipe, load_training_recipe
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.io.provenance import other_versions
from mitsonar.io.run_directory import RunDirectory
from mitsonar.motion.motion_errors import Axis
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.training.training_data import Material, material_of
from mitsonar.training.training_folder import RunFolder, StateFile, column
from mitsonar.training.training_step import NetworkTraining, axes_of, network_for, rmse_by_level

__all__ = ["TrainingReport", "leads", "train"]

STATE_MINUTES = 5.0
"""Between two states on disk: what a kill may cost."""

MOST_AT_ONCE = 1024
"""Threads, and processes, that a run may have had."""

SMOOTH = 0.98
"""Weight of the past in the running numbers of a report."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrainingReport:
    """How far a training is; after each step.

    Attributes:
        step, steps: done, and planned.
        epoch: of the step, from 0, with its fraction.
        pairs: samples seen.
        minutes: trained, all resumed runs together.
        per_second: samples a second in this process.
        loss: running mean.
        rmse: running, of training samples, in the units of ``axes``.
        validation: the last validation's RMSE by level of noise, in the units of ``axes``.
        validated: whether it is of this step.
        axes: names and units.
    """

    step: int
    steps: int
    epoch: float
    pairs: int
    minutes: float
    per_second: float
    loss: float
    rmse: list[float]
    validation: dict[str, list[float]]
    validated: bool
    axes: tuple[Axis, ...]


def train(
    recipe: TrainingRecipe | str | Path,
    data: str | Path | None,
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
    """Train a network; the best one by validation at the noise of training.

    Sample order, noise and dropout are functions of (seed, epoch, index) and (seed, step). On a CPU, with the same number of
    threads, a run that was killed and resumed ends with the same bits as an unbroken one.

    Args:
        recipe: of the training, its name, or a YAML file.
        data: path or URL of a data set.
        out: folder of the run.
        render: training samples are rendered meanwhile, of the recipe of ``data``, else of the one that the recipe names.
        minutes: of training after which it stops, all resumed runs together, validation included.
        resume: go on with the run in ``out``; one that is not there begins.
        overwrite: begin anew where a run is.
        scale: only this part of the data, times the recipe's ``part_of_data``.
        pairs: length of the training in samples, in place of the recipe's.
        accelerator, devices, strategy: Lightning's.
        precision: Lightning's, in place of the recipe's.
        threads: of the CPU.
        workers: processes that read or render; default: by the machine.
        state_minutes: between two states on disk.
        progress: called after each step.
        stop: asked after each step; when it says so the state is kept and training stops.

    Raises:
        MitsonarError: what does not go together, before training begins; a loss that is not finite.
    """
    recipe = recipe if isinstance(recipe, TrainingRecipe) else load_training_recipe(recipe)
    recipe = _changed(recipe, scale, pairs, precision)
    if minutes is not None and not minutes > 0:
        raise MitsonarError(f"--minutes must be above 0: got {minutes:g}")
    if threads is not None and threads < 1:
        raise MitsonarError(f"--threads must be at least 1: got {threads}")
    folder = RunFolder(Path(out), writes=leads())
    known = folder.known() if resume else None
    gain = None if known is None else known.amount("gain")
    threads = threads or (known.count("threads", MOST_AT_ONCE) if known is not None else None)
    material = material_of(recipe, data, render=render, gain=gain)
    network = network_for(recipe, material)
    with _quiet(), _settings(threads), torch.random.fork_rng(devices=[]):
        module = NetworkTraining(network, recipe, material)
        journal = Journal(folder, module, material, minutes, state_minutes, progress, stop)
        trainer = _trainer(module, folder, journal, accelerator, devices, strategy)
        workers = _workers(workers, known, render, trainer)
        asked = {
            "data": material.about["name"],
            "digest": material.about["digest"],
            "render": render,
            "workers": workers if render else None,
            "world_size": trainer.world_size,
        }
        notes = {
            "gain": material.about["gain"],
            "threads": torch.get_num_threads(),
            "accelerator": type(trainer.accelerator).__name__,
            "epoch_samples": material.epoch,
            "steps": module.steps,
        }
        _warn_of_other_bits(folder.begin(recipe, asked, notes, resume=resume, overwrite=overwrite), notes)
        state = folder.state if resume and folder.state.is_file() else None
        begun = StateFile().load_checkpoint(state) if state else None
        done = begun["global_step"] if begun else 0
        used = float(begun["callbacks"][journal.state_key]["minutes"]) if begun else 0.0
        del begun
        if done < module.steps and minutes is not None and used >= minutes and not folder.network.is_file():
            raise MitsonarError(
                f"the run in {folder.path} was stopped before it validated once, and has had its {minutes:g} minutes "
                f"({used:.1f}): resume it with more"
            )
        if done < module.steps and (minutes is None or used < minutes):
            module.workers = workers
            trainer.fit(module, ckpt_path=state, weights_only=True)
    if journal.stopped:
        raise KeyboardInterrupt
    return Checkpoint.load(folder.path)


def leads() -> bool:
    """Whether this process writes and speaks, where Lightning has started several."""
    return all(os.environ.get(name, "0") == "0" for name in ("LOCAL_RANK", "NODE_RANK", "SLURM_PROCID"))


class Journal(Callback):
    """What happens between steps: reports, validation, states, the best network, and the end.

    Nothing here changes what the next step computes.
    """

    def __init__(
        self,
        folder: RunFolder,
        module: NetworkTraining,
        material: Material,
        minutes: float | None,
        state_minutes: float,
        progress: Callable[[TrainingReport], None] | None,
        stop: Callable[[], bool] | None,
    ) -> None:
        self.folder, self.module, self.material = folder, module, material
        self.minutes, self.state_minutes, self.progress, self.stop = minutes, state_minutes, progress, stop
        self.recipe, self.axes = module.recipe, axes_of(material.samples.labels)
        self.scales = np.array([axis.scale for axis in self.axes])
        self.kept = _Kept()
        self.had_minutes = 0.0
        self.stopped = False
        self.running = _Running()
        self.validation: dict[str, list[float]] = {}

    def state_dict(self) -> dict[str, Any]:
        """For last.ckpt."""
        return {**vars(self.kept), "minutes": self.spent}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """From last.ckpt."""
        self.had_minutes = float(state_dict["minutes"])
        self.kept = _Kept(**{name: value for name, value in state_dict.items() if name != "minutes"})

    @property
    def spent(self) -> float:
        """Minutes of training, all resumed runs together."""
        return self.had_minutes + (time.monotonic() - self.begun) / 60

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """The clock starts."""
        self.begun = self.saved = self.validated = time.monotonic()
        self.first = trainer.global_step

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """After each step."""
        step = trainer.global_step
        loss = float(outputs["loss"].detach())
        self.kept.loss_sum, self.kept.loss_count = self.kept.loss_sum + loss, self.kept.loss_count + 1
        self.running.add(loss, self.module.squares)
        end, validate, save = self._due(trainer, step)
        if validate and trainer.is_global_zero:
            self._validate(trainer, step)
        if self.progress is not None and trainer.is_global_zero:
            self.progress(self._report(step, validate))
        if save and self._finite():  # every process takes part in writing
            trainer.save_checkpoint(self.folder.state)
            self.saved = time.monotonic()
        if end:
            if trainer.is_global_zero:
                finished = step >= self.module.steps
                self.folder.end(finished=finished, steps_done=step, minutes=round(self.spent, 3))
            trainer.strategy.barrier()
            trainer.should_stop = True

    def _due(self, trainer: lightning.Trainer, step: int) -> tuple[bool, bool, bool]:
        """Whether training ends, is validated, and its state kept: as the first process says."""
        now, told = time.monotonic(), self.recipe.validation
        self.stopped = self.stopped or (self.stop is not None and self.stop())
        over = self.minutes is not None and self.spent >= self.minutes
        end = step >= self.module.steps or over or self.stopped
        if told.every_steps is not None:
            validate = step % told.every_steps == 0
        else:
            validate = now - self.validated >= told.every_minutes * 60
        validate = validate or (end and not self.stopped)
        due = end, validate, end or validate or now - self.saved >= self.state_minutes * 60
        return due if trainer.world_size == 1 else trainer.strategy.broadcast(due)

    def _validate(self, trainer: lightning.Trainer, step: int) -> None:
        """A row of the log; the network is kept if it is the best so far."""
        context = trainer.precision_plugin.forward_context()
        size = max(self.recipe.batch, 8)
        labels, device = self.material.samples.labels, self.module.device
        rmse, zero = rmse_by_level(
            self.module.network, self.material.validation, labels, size, device=device, context=context
        )
        self.validation = {level: (values * self.scales).tolist() for level, values in rmse.items()}
        row: dict[str, Any] = {
            "step": step,
            "epoch": step / self.module.epoch_steps,
            "pairs": step * self.recipe.batch,
            "minutes": self.spent,
            "learning_rate": self.recipe.optimiser.rate_at(step - 1, self.module.epoch_steps, self.module.steps),
            "loss": self.kept.loss_sum / self.kept.loss_count,
        }
        for level, values in self.validation.items():
            row |= {column(level, axis): value for axis, value in zip(self.axes, values, strict=True)}
        self.kept.rows.append(row)
        self.kept.loss_sum, self.kept.loss_count = 0.0, 0
        score = _score([rmse[level] for level in self.recipe.noises], zero)
        if self._finite() and not score >= self.kept.best:
            self.kept.best = score
            self._checkpoint(row).save(self.folder.network)
        self.folder.log(self.kept.rows, (zero * self.scales).tolist(), self.axes)
        self.validated = time.monotonic()

    def _checkpoint(self, row: dict[str, Any]) -> Checkpoint:
        """The network as it is now."""
        count = len(self.material.validation)
        metrics = {level: {"rmse": values, "pairs": count} for level, values in self.validation.items()}
        trained = {"pairs": row["pairs"], "minutes": round(row["minutes"], 2), "epochs": round(row["epoch"], 3)}
        return Checkpoint.of(
            self.module.network,
            self.material.samples,
            noise=self.recipe.noise_said,
            recipe=self.recipe.plain(),
            metrics=metrics,
            trained={**trained, "steps": row["step"], "seed": self.recipe.seed},
        )

    def _finite(self) -> bool:
        """Whether the network is worth keeping."""
        return all(bool(torch.isfinite(values).all()) for values in self.module.network.state_dict().values())

    def _report(self, step: int, validated: bool) -> TrainingReport:
        seconds = time.monotonic() - self.begun
        return TrainingReport(
            step=step,
            steps=self.module.steps,
            epoch=step / self.module.epoch_steps,
            pairs=step * self.recipe.batch,
            minutes=self.spent,
            per_second=(step - self.first) * self.recipe.batch / max(seconds, 1e-6),
            loss=self.running.loss,
            rmse=(np.sqrt(self.running.squares) * self.scales).tolist(),
            validation=self.validation,
            validated=validated,
            axes=self.axes,
        )


@dataclass
class _Kept:
    """What a resumed run needs of the journal."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    loss_sum: float = 0.0
    loss_count: int = 0
    best: float = math.inf


class _Running:
    """Running means, for a report."""

    def __init__(self) -> None:
        self.weight, self.loss, self.squares = 0.0, 0.0, np.zeros(1)

    def add(self, loss: float, squares: np.ndarray[Any, Any]) -> None:
        """Of one step."""
        self.weight = SMOOTH * self.weight + 1
        self.loss = self.loss + (loss - self.loss) / self.weight
        self.squares = self.squares + (squares - self.squares) / self.weight


def _score(rmse: list[Array], zero: Array) -> float:
    """What the kept network has least of: RMSE over that of answering nothing, as a geometric mean over axes and levels of
    noise. One axis that no network tells does not outweigh all others, and ten per cent are ten per cent on each."""
    moves = zero > 0
    parts = np.array([level[moves] / zero[moves] for level in rmse])
    return float(np.exp(np.log(np.maximum(parts, 1e-9)).mean())) if moves.any() else float(np.mean(rmse))


def _changed(recipe: TrainingRecipe, scale: float | None, pairs: int | None, precision: str | None) -> TrainingRecipe:
    """The recipe that is run, which the run's folder keeps."""
    changes: dict[str, Any] = {}
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


def _trainer(
    module: NetworkTraining, folder: RunFolder, journal: Journal, accelerator: str, devices: str | int, strategy: str
) -> lightning.Trainer:
    """Lightning's trainer.

    Raises:
        MitsonarError: what Lightning does not take, or a batch that the devices cannot share.
    """
    try:
        trainer = lightning.Trainer(
            accelerator=accelerator,
            devices=devices,
            strategy=strategy,
            precision=module.recipe.precision,
            max_steps=module.steps,
            max_epochs=-1,
            gradient_clip_val=module.recipe.optimiser.clip,
            callbacks=[journal],
            plugins=[StateFile()],
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            use_distributed_sampler=False,
            default_root_dir=folder.path,
        )
    except Exception as error:  # Lightning has exceptions of many kinds for what is not there
        raise MitsonarError(
            f"accelerator {accelerator}, devices {devices}, strategy {strategy}, precision {module.recipe.precision} do not "
            f"work here: {str(error).splitlines()[0]}"
        ) from None
    if module.recipe.batch % trainer.world_size:
        raise MitsonarError(
            f"a batch of {module.recipe.batch} cannot be shared by {trainer.world_size} devices: choose another batch, or "
            "--devices 1"
        )
    if trainer.strategy.root_device.type == "cpu":
        torch.use_deterministic_algorithms(True)
    return trainer


def _workers(workers: int | None, known: RunDirectory | None, render: bool, trainer: lightning.Trainer) -> int:
    """Processes that read or render: those of an earlier run, or by the machine."""
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


def _warn_of_other_bits(had: RunDirectory | None, notes: dict[str, Any]) -> None:
    """What makes a resumed run end with other last bits than an unbroken one."""
    if had is None:
        return
    other = [
        f"{key} {had.notes.get(key)} (now {notes[key]})"
        for key in ("threads", "accelerator")
        if had.notes.get(key) != notes[key]
    ]
    for change in other + other_versions(had.versions, ("mitsonar", "torch")):
        warnings.warn(
            f"the run was begun with {change}: it goes on, but not to the same bits", MitsonarWarning, stacklevel=3
        )


@contextmanager
def _quiet() -> Iterator[None]:
    """Lightning says nothing: what matters is an error or in a report."""
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
    """Threads and algorithms of torch as this training needs them, and afterwards as they were."""
    had, deterministic = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    warn_only = torch.is_deterministic_algorithms_warn_only_enabled()
    if threads:
        torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(had)
        torch.use_deterministic_algorithms(deterministic, warn_only=warn_only)
