"""What happens between the steps of a training: reports, validation, states, the best network, and the end."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from mitsonar.motion.errors import Axis
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.training.training_data import Material
from mitsonar.training.training_folder import TRAINED, RunFolder, column
from mitsonar.training.training_step import NetworkTraining, axes_of, rmse_by_level
from mitsonar.training.training_types import Array, Batch, JsonObject

__all__ = ["STATE_MINUTES", "Journal", "Pace", "TrainingReport"]

STATE_MINUTES = 5.0
"""Minutes between two states on disk: what a kill may cost."""

LOG_SECONDS = 30.0
"""Time between two rows of the log without a validation."""

SMOOTH = 0.98
"""Weight of the past in the running numbers of a report."""


@dataclass(frozen=True)
class TrainingReport:
    """Progress of a training, after each step.

    Attributes:
        step: number of steps done.
        steps: number of steps planned.
        epoch: number of epochs done, with a fraction.
        pairs: samples seen.
        minutes: duration of training [min], of all resumed runs together.
        per_second: samples a second in this process.
        loss: running mean of the loss.
        rmse: running RMSE of the samples that it learns from, in the units of ``axes``.
        validation: RMSE of the last validation by level of noise, in the units of ``axes``.
        validated: whether this step was validated.
        logged: whether the log has a row of this step.
        axes: names and units of the estimates.
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
    logged: bool
    axes: tuple[Axis, ...]


@dataclass(frozen=True)
class Pace:
    """When a training reports, saves its state and stops: see :func:`mitsonar.training.training_run.train`."""

    minutes: float | None
    state_minutes: float
    progress: Callable[[TrainingReport], None] | None
    stop: Callable[[], bool] | None


class Journal(Callback):
    """Reports, validates, saves states and the best network, and ends training.

    Nothing here changes what the next step computes.
    """

    def __init__(self, folder: RunFolder, module: NetworkTraining, material: Material, pace: Pace) -> None:
        self.folder, self.module, self.material, self.pace = folder, module, material, pace
        self.recipe, self.axes = module.recipe, axes_of(material.samples.labels)
        self.scales = np.array([axis.scale for axis in self.axes])
        self.kept = _Kept()
        self.had_minutes = 0.0
        self.stopped = False
        self.on_sigterm = signal.getsignal(signal.SIGTERM)
        self.validation: dict[str, list[float]] = {}

    def state_dict(self) -> JsonObject:
        """Return what ``last.ckpt`` keeps of the journal."""
        return {**vars(self.kept), "minutes": self.spent}

    def load_state_dict(self, state_dict: JsonObject) -> None:
        """Take what ``last.ckpt`` keeps of the journal."""
        self.had_minutes = float(state_dict["minutes"])
        self.kept = _Kept(**{name: value for name, value in state_dict.items() if name != "minutes"})

    @property
    def spent(self) -> float:
        """Return the duration of training [min], of all resumed runs together."""
        return self.had_minutes + (time.monotonic() - self.begun) / 60

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Start the clock.

        Lightning has taken SIGTERM over: it would end the process with code 0, and without a state. Whoever can stop the
        training gets the signal back.
        """
        if self.pace.stop is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self.on_sigterm)
        self.begun = self.saved = self.validated = self.logged = time.monotonic()
        self.first = trainer.global_step

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Tensor | Mapping[str, Any] | None,
        batch: Batch,
        batch_idx: int,
    ) -> None:
        """Report, validate, save or end, as is due after this step."""
        assert isinstance(outputs, Mapping)
        step = trainer.global_step
        loss = float(outputs["loss"].detach())
        self.kept.add(loss, self.module.squares)
        end, validate, save = self._due(trainer, step)
        stopped = end and self.stopped
        if stopped and self._finite():  # first: a second signal, or what sent this one, may not wait
            trainer.save_checkpoint(self.folder.state)
        log = validate or stopped or time.monotonic() - self.logged >= LOG_SECONDS
        if log and trainer.is_global_zero:
            self._log(trainer, step, validate=validate, stopped=stopped)
        if self.pace.progress is not None and trainer.is_global_zero:
            self.pace.progress(self._report(step, validated=validate or stopped, logged=log))
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
        """Return whether training ends, is validated, and saves its state. The first process decides for all."""
        now, wanted = time.monotonic(), self.recipe.validation
        stopped = self.stopped or (self.pace.stop is not None and self.pace.stop())
        over = self.pace.minutes is not None and self.spent >= self.pace.minutes
        end = step >= self.module.steps or over or stopped
        if wanted.every_steps is not None:
            validate = step % wanted.every_steps == 0
        else:
            validate = now - self.validated >= wanted.every_minutes * 60
        validate = validate or (end and not stopped)
        due = end, stopped, validate, end or validate or now - self.saved >= self.pace.state_minutes * 60
        end, self.stopped, validate, save = due if trainer.world_size == 1 else trainer.strategy.broadcast(due)
        return end, validate, save

    def _log(self, trainer: lightning.Trainer, step: int, *, validate: bool, stopped: bool) -> None:
        """Add a row to the log; validate where that is due, and save the network if it is the best so far.

        A stop validates, too, but what is best does not depend on it: only a run without a network gets this one.
        """
        row: JsonObject = {
            "step": step,
            "epoch": step / self.module.epoch_steps,
            "pairs": step * self.recipe.batch,
            "minutes": self.spent,
            "learning_rate": self.recipe.optimiser.rate_at(step - 1, self.module.epoch_steps, self.module.steps),
            "loss": self.kept.loss_sum / self.kept.loss_count,
        }
        row |= self._columns(TRAINED, self._training_rmse())
        self.kept.loss_sum, self.kept.loss_count = 0.0, 0
        score = self._validate(trainer) if validate or stopped else math.inf
        for level in self.material.validation.arrangements:
            row |= self._columns(level, self.validation[level] if validate or stopped else None)
        self.kept.rows.append(row)
        better = validate and not score >= self.kept.best
        if (better or (stopped and not self.folder.network.is_file())) and self._finite():
            self.kept.best = score if validate else self.kept.best
            self._checkpoint(row).save(self.folder.network)
        self.folder.log(self.kept.rows, self.kept.zero, self.axes, drawn=validate or stopped)
        for logger in trainer.loggers:
            logger.log_metrics({name: value for name, value in row.items() if name != "step" and value is not None}, step)
            logger.save()
        self.logged = time.monotonic()

    def _columns(self, what: str, rmse: list[float] | None) -> JsonObject:
        """Return the columns of an RMSE by their names, empty without one."""
        values = [None] * len(self.axes) if rmse is None else rmse
        return {column(what, axis): value for axis, value in zip(self.axes, values, strict=True)}

    def _training_rmse(self) -> list[float]:
        """Return the running RMSE of the samples that it learns from, in the units of the axes."""
        return [float(value) for value in np.sqrt(self.kept.squares) * self.scales]

    def _validate(self, trainer: lightning.Trainer) -> float:
        """Validate, and return the score of the network."""
        context = trainer.precision_plugin.forward_context()
        size = max(self.recipe.batch, 8)
        labels, device = self.material.samples.labels, self.module.device
        rmse, zero = rmse_by_level(
            self.module.network, self.material.validation, labels, size, device=device, context=context
        )
        self.validation = {level: (values * self.scales).tolist() for level, values in rmse.items()}
        self.kept.zero = (zero * self.scales).tolist()
        self.validated = time.monotonic()
        return _score([rmse[level] for level in self.recipe.noises], zero)

    def _checkpoint(self, row: JsonObject) -> Checkpoint:
        """Return the present network as a checkpoint."""
        count = len(self.material.validation)
        metrics = {level: {"rmse": values, "pairs": count} for level, values in self.validation.items()}
        trained = {"pairs": row["pairs"], "minutes": round(row["minutes"], 2), "epochs": round(row["epoch"], 3)}
        if self.material.numbers is None:
            trained["rendered"] = True
        return Checkpoint.of(
            self.module.network,
            self.material.samples,
            noise=self.recipe.noise_said,
            recipe=self.recipe.plain(),
            metrics=metrics,
            trained={**trained, "steps": row["step"], "seed": self.recipe.seed},
        )

    def _finite(self) -> bool:
        """Return whether all weights are finite."""
        return all(bool(torch.isfinite(values).all()) for values in self.module.network.state_dict().values())

    def _report(self, step: int, *, validated: bool, logged: bool) -> TrainingReport:
        seconds = time.monotonic() - self.begun
        return TrainingReport(
            step=step,
            steps=self.module.steps,
            epoch=step / self.module.epoch_steps,
            pairs=step * self.recipe.batch,
            minutes=self.spent,
            per_second=(step - self.first) * self.recipe.batch / max(seconds, 1e-6),
            loss=self.kept.loss,
            rmse=self._training_rmse(),
            validation=self.validation,
            validated=validated,
            logged=logged,
            axes=self.axes,
        )


@dataclass
class _Kept:
    """State of the journal that a resumed run needs.

    Attributes:
        rows: of the log.
        loss_sum: of the steps since the last row.
        loss_count: number of these.
        best: score of the best network.
        zero: RMSE of always answering zero, in the units of the axes.
        weight: of the running means.
        loss: their running mean.
        squares: running mean of squared errors, by axis [m^2, m^2, rad^2].
    """

    rows: list[JsonObject] = field(default_factory=list)
    loss_sum: float = 0.0
    loss_count: int = 0
    best: float = math.inf
    zero: list[float] = field(default_factory=list)
    weight: float = 0.0
    loss: float = 0.0
    squares: list[float] = field(default_factory=list)

    def add(self, loss: float, squares: Array) -> None:
        """Add one step."""
        self.loss_sum, self.loss_count = self.loss_sum + loss, self.loss_count + 1
        self.weight = SMOOTH * self.weight + 1
        self.loss += (loss - self.loss) / self.weight
        had = np.array(self.squares or [0.0] * len(squares))
        self.squares = (had + (squares - had) / self.weight).tolist()


def _score(rmse: list[Array], zero: Array) -> float:
    """Return the score of a validation, of which the smallest is the best.

    The score is the RMSE over that of always answering zero, as a geometric mean over axes and levels of noise. The
    geometric mean gives equal weight to equal relative errors, also if one axis cannot be estimated.
    """
    moves = zero > 0
    parts = np.array([level[moves] / zero[moves] for level in rmse])
    return float(np.exp(np.log(np.maximum(parts, 1e-9)).mean())) if moves.any() else float(np.mean(rmse))
