"""Tasks between training steps: reports, validation, saving of the state and the best network, and stopping."""

from __future__ import annotations

import csv
import io
import math
import platform
import signal
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning
import numpy as np
import torch
import yaml
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor

from mitsonar.config.training import TrainingRecipe, TrainOptions
from mitsonar.errors import MitsonarError
from mitsonar.io.files import whole_number, write_atomic
from mitsonar.io.runs import RUN_FILE, RunDirectory, RunKind
from mitsonar.io.system import usable_cores
from mitsonar.motion.errors import Axis
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.training.data import Array, Batch, JsonObject, Material
from mitsonar.training.step import NetworkTraining, axes_of, rmse_by_level

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "TRAINING",
    "Journal",
    "RunFolder",
    "StateFile",
    "TrainingReport",
    "column",
    "curve_figure",
]


LOG_SECONDS = 30.0
"""Interval between log rows without validation [s]."""

SMOOTH = 0.98
"""Decay per step of the weights in the running means of a report."""


@dataclass(frozen=True)
class TrainingReport:
    """Progress of a training after a step.

    Attributes:
        step: number of completed steps.
        steps: number of planned steps.
        epoch: number of completed epochs, including fractions.
        pairs: number of samples seen.
        minutes: duration of training, including earlier parts of a resumed run [min].
        per_second: samples per second in this process.
        loss: running mean of the loss.
        rmse: running RMSE on the training samples, in the units of ``axes``.
        validation: RMSE of the last validation, keyed by noise level, in the units of ``axes``.
        validated: whether the network was validated after this step.
        logged: whether the log has a row for this step.
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


class Journal(Callback):
    """Callback that reports, validates, saves states and the best network, and ends training.

    It does not affect the result of the next step.
    """

    def __init__(
        self,
        folder: RunFolder,
        module: NetworkTraining,
        material: Material,
        options: TrainOptions,
        progress: Callable[[TrainingReport], None] | None,
        stop: Callable[[], bool] | None,
    ) -> None:
        self.folder, self.module, self.material = folder, module, material
        self.options, self.progress, self.stop = options, progress, stop
        self.recipe, self.axes = module.recipe, axes_of(material.samples.labels)
        self.scales = np.array([axis.scale for axis in self.axes])
        self.state = _JournalState()
        self.earlier_minutes = 0.0
        self.stopped = False
        self.on_sigterm = signal.getsignal(signal.SIGTERM)
        self.validation: dict[str, list[float]] = {}

    def state_dict(self) -> JsonObject:
        """Return the state of the journal for ``last.ckpt``."""
        return {**vars(self.state), "minutes": self.spent}

    def load_state_dict(self, state_dict: JsonObject) -> None:
        """Restore the state of the journal from ``last.ckpt``."""
        self.earlier_minutes = float(state_dict["minutes"])
        self.state = _JournalState(**{name: value for name, value in state_dict.items() if name != "minutes"})

    @property
    def spent(self) -> float:
        """Return the duration of training, including earlier parts of a resumed run [min]."""
        return self.earlier_minutes + (time.monotonic() - self.begun) / 60

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Start the clock, and restore the handler of SIGTERM.

        Lightning installs a handler that ends the process with code 0 and saves no state. If the caller can
        stop the training, the caller's handler is restored.
        """
        if self.stop is not None and threading.current_thread() is threading.main_thread():
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
        """Report, validate, save or end, whichever is due after this step."""
        assert isinstance(outputs, Mapping)
        step = trainer.global_step
        loss = float(outputs["loss"].detach())
        self.state.add(loss, self.module.squares)
        end, validate, save = self._due(trainer, step)
        stopped = end and self.stopped
        if stopped and self._finite():  # save first: whatever sent the signal may not wait
            trainer.save_checkpoint(self.folder.state)
        log = validate or stopped or time.monotonic() - self.logged >= LOG_SECONDS
        if log and trainer.is_global_zero:
            self._log(trainer, step, validate=validate, stopped=stopped)
        if self.progress is not None and trainer.is_global_zero:
            self.progress(self._report(step, validated=validate or stopped, logged=log))
        if save and self._finite():  # all processes take part in saving
            trainer.save_checkpoint(self.folder.state)
            self.saved = time.monotonic()
        if end:
            if trainer.is_global_zero:
                finished = step >= self.module.steps
                self.folder.end(finished=finished, steps_done=step, minutes=round(self.spent, 3))
            trainer.strategy.barrier()
            trainer.should_stop = True

    def _due(self, trainer: lightning.Trainer, step: int) -> tuple[bool, bool, bool]:
        """Return whether to end, validate, and save the state; the first process decides for all."""
        time_s, schedule = time.monotonic(), self.recipe.validation
        stopped = self.stopped or (self.stop is not None and self.stop())
        out_of_time = self.options.minutes is not None and self.spent >= self.options.minutes
        end = step >= self.module.steps or out_of_time or stopped
        if schedule.every_steps is not None:
            validate = step % schedule.every_steps == 0
        else:
            validate = time_s - self.validated >= schedule.every_minutes * 60
        validate = validate or (end and not stopped)
        due = end, stopped, validate, end or validate or time_s - self.saved >= self.options.state_minutes * 60
        end, self.stopped, validate, save = due if trainer.world_size == 1 else trainer.strategy.broadcast(due)
        return end, validate, save

    def _log(self, trainer: lightning.Trainer, step: int, *, validate: bool, stopped: bool) -> None:
        """Add a row to the log; validate if that is due, and save the network if it is the best so far.

        A requested stop also validates, but does not compete for the best network. Its network is saved only if the run
        has none.
        """
        row: JsonObject = {
            "step": step,
            "epoch": step / self.module.epoch_steps,
            "pairs": step * self.recipe.batch,
            "minutes": self.spent,
            "learning_rate": self.recipe.optimiser.rate_at(step - 1, self.module.epoch_steps, self.module.steps),
            "loss": self.state.loss_sum / self.state.loss_count,
        }
        row |= self._columns(TRAINED, self._training_rmse())
        self.state.loss_sum, self.state.loss_count = 0.0, 0
        score = self._validate(trainer) if validate or stopped else math.inf
        for level in self.material.validation.arrangements:
            row |= self._columns(level, self.validation[level] if validate or stopped else None)
        self.state.rows.append(row)
        better = validate and not score >= self.state.best
        if (better or (stopped and not self.folder.network.is_file())) and self._finite():
            self.state.best = score if validate else self.state.best
            self._checkpoint(row).save(self.folder.network)
        self.folder.log(self.state.rows, self.state.zero, self.axes, drawn=validate or stopped)
        for logger in trainer.loggers:
            logger.log_metrics({name: value for name, value in row.items() if name != "step" and value is not None}, step)
            logger.save()
        self.logged = time.monotonic()

    def _columns(self, source: str, rmse: list[float] | None) -> JsonObject:
        """Return the columns of an RMSE, keyed by name; the values are None without an RMSE."""
        values = [None] * len(self.axes) if rmse is None else rmse
        return {column(source, axis): value for axis, value in zip(self.axes, values, strict=True)}

    def _training_rmse(self) -> list[float]:
        """Return the running RMSE on the training samples, in the units of the axes."""
        return [float(value) for value in np.sqrt(self.state.squares) * self.scales]

    def _validate(self, trainer: lightning.Trainer) -> float:
        """Validate the network, and return its score."""
        context = trainer.precision_plugin.forward_context()
        size = max(self.recipe.batch, 8)
        labels, device = self.material.samples.labels, self.module.device
        rmse, zero = rmse_by_level(
            self.module.network, self.material.validation, labels, size, device=device, context=context
        )
        self.validation = {level: (values * self.scales).tolist() for level, values in rmse.items()}
        self.state.zero = (zero * self.scales).tolist()
        self.validated = time.monotonic()
        return _score([rmse[level] for level in self.recipe.noises], zero)

    def _checkpoint(self, row: JsonObject) -> Checkpoint:
        """Return the current network as a checkpoint."""
        count = len(self.material.validation)
        metrics = {level: {"rmse": values, "pairs": count} for level, values in self.validation.items()}
        trained = {"pairs": row["pairs"], "minutes": round(row["minutes"], 2), "epochs": round(row["epoch"], 3)}
        if self.material.numbers is None:
            trained["rendered"] = True
        else:
            trained["sequences"] = self.material.about["sequences"]
        return Checkpoint.of(
            self.module.network,
            self.material.samples,
            noise=self.recipe.noise_text,
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
            loss=self.state.loss,
            rmse=self._training_rmse(),
            validation=self.validation,
            validated=validated,
            logged=logged,
            axes=self.axes,
        )


@dataclass
class _JournalState:
    """State of the journal that a resumed run needs.

    Attributes:
        rows: rows of the log.
        loss_sum: sum of the losses since the last row.
        loss_count: number of steps since the last row.
        best: score of the best network.
        zero: RMSE of the constant estimate zero, in the units of the axes.
        weight: sum of the weights of the running means.
        loss: running mean of the loss.
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
        """Add the loss and the squared errors of one step."""
        self.loss_sum, self.loss_count = self.loss_sum + loss, self.loss_count + 1
        self.weight = SMOOTH * self.weight + 1
        self.loss += (loss - self.loss) / self.weight
        means = np.array(self.squares or [0.0] * len(squares))
        self.squares = (means + (squares - means) / self.weight).tolist()


def _score(rmse: list[Array], zero: Array) -> float:
    """Compute the score of a validation; smaller is better.

    The score is the ratio of the RMSE to that of the constant estimate zero, as a geometric mean over axes and noise levels.
    The geometric mean gives equal weight to equal relative errors, even if one axis cannot be estimated.
    """
    varies = zero > 0
    ratios = np.array([level[varies] / zero[varies] for level in rmse])
    return float(np.exp(np.log(np.maximum(ratios, 1e-9)).mean())) if varies.any() else float(np.mean(rmse))


# ---------------- Folder of a training run


EVENTS = "tensorboard"
"""Name of the TensorBoard folder inside a run folder."""

TRAINED = "training"
"""Prefix of the log columns of the RMSE on the training samples."""

TRAINING = RunKind(
    "training",
    outputs=("recipe.yaml", "last.ckpt", "network.ckpt", "log.csv", "curve.png", EVENTS),
    notes={
        **{"gain": float | None, "threads": int, "accelerator": str, "epoch_samples": int, "steps": int, "machine": dict},
        **{"steps_done": int, "minutes": float},
    },
    packages=("mitsonar", "torch", "lightning", "numpy"),
)

LOG_AXIS_RATIO = 30
"""Ratio of the last to the first number of samples seen at which the axis becomes logarithmic."""


class StateFile(TorchCheckpointIO):
    """Checkpoint I/O for Lightning that writes atomically and executes nothing from the file."""

    def save_checkpoint(self, checkpoint: JsonObject, path: str | Path, storage_options: object | None = None) -> None:
        """Write a state atomically."""
        buffer = io.BytesIO()
        torch.save(checkpoint, buffer)
        write_atomic(path, buffer.getvalue())

    def load_checkpoint(
        self, path: str | Path, map_location: Callable[..., Any] | None = None, weights_only: bool | None = True
    ) -> JsonObject:
        """Read a state without executing anything in it.

        Raises:
            MitsonarError: the file is damaged, or is not a state.
        """
        try:
            state = torch.load(path, map_location=map_location or "cpu", weights_only=True)
            if not isinstance(state["state_dict"], dict):
                raise ValueError("it is not a state")
            whole_number(state["global_step"], "global_step")
        except Exception as error:  # a damaged zip or pickle raises errors of any type
            raise MitsonarError(
                f"{path} is damaged ({str(error).splitlines()[0] if str(error) else type(error).__name__}): begin anew with "
                "--overwrite"
            ) from None
        return dict(state)


@dataclass
class RunFolder:
    """Folder of a training run: recipe, state, best network, log and learning curve, each of them complete or absent.

    Attributes:
        path: path of the folder.
        writes: whether this process writes.
        run: arguments and progress; None before :meth:`begin`, or if another process writes.
    """

    path: Path
    writes: bool = True
    run: RunDirectory | None = None

    @property
    def state(self) -> Path:
        """Return the path of the state from which --resume continues."""
        return self.path / "last.ckpt"

    @property
    def network(self) -> Path:
        """Return the path of the best network."""
        return self.path / "network.ckpt"

    def earlier_run(self) -> RunDirectory | None:
        """Return the earlier run in the folder, if there is one; its arguments may differ.

        Raises:
            MitsonarError: the file of the run is damaged.
        """
        return RunDirectory.open(self.path, TRAINING) if (self.path / RUN_FILE).is_file() else None

    def begin(
        self, recipe: TrainingRecipe, arguments: JsonObject, notes: JsonObject, *, resume: bool, overwrite: bool
    ) -> RunDirectory | None:
        """Create the folder, or resume the run in it, and return the resumed run.

        Args:
            recipe: training recipe.
            arguments: further arguments that a resumed run must repeat to reach the same weights.
            notes: other facts about the run.
            resume: resume a run in the folder.
            overwrite: replace a run in the folder.

        Raises:
            MitsonarError: the folder contains a run and neither is allowed, the arguments differ, or it has other files.
        """
        if not self.writes:
            return None
        arguments = {**arguments, "recipe": recipe.plain()}
        self.run = RunDirectory.begin(self.path, TRAINING, arguments, resume=resume, overwrite=overwrite)
        self.run.start(**notes, machine=machine())
        if not (self.path / "recipe.yaml").is_file():
            text = yaml.safe_dump(recipe.plain(), sort_keys=False, allow_unicode=True)
            write_atomic(self.path / "recipe.yaml", text.encode())
        return self.run if self.run.resumed else None

    def end(self, *, finished: bool, **notes: float) -> None:
        """Save the progress of the training at its end."""
        if self.run is not None:
            self.run.finished = finished
            self.run.note(**notes)

    def log(self, rows: list[JsonObject], zero: list[float], axes: tuple[Axis, ...], *, drawn: bool) -> None:
        """Write ``log.csv`` and, if ``drawn``, ``curve.png``."""
        text = io.StringIO()
        table = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(
            {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()} for row in rows
        )
        write_atomic(self.path / "log.csv", text.getvalue().encode())
        if not drawn:
            return
        buffer = io.BytesIO()
        curve_figure(rows, zero, axes).savefig(buffer, format="png", dpi=110)
        write_atomic(self.path / "curve.png", buffer.getvalue())


def machine() -> JsonObject:
    """Return a description of this machine."""
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {"system": platform.platform(), "cores": usable_cores(), "gpu": device}


def column(level: str, axis: Axis) -> str:
    """Return the name of a log column: the RMSE of one axis in training, or in validation at a noise level."""
    return f"{level} {axis.name} ({axis.unit})"


def curve_figure(rows: list[JsonObject], zero: list[float], axes: tuple[Axis, ...]) -> Figure:
    """Draw the loss, and the RMSE of each axis in training and validation, against the number of samples seen.

    Args:
        rows: rows of the log, at least one with a validation.
        zero: RMSE of the constant estimate of no motion, in the units of ``axes``.
        axes: names and units of the estimates.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter, FormatStrFormatter, LogLocator, NullFormatter

    figure = Figure(figsize=(3.4 * (1 + len(axes)), 3.2), layout="constrained")
    panels = figure.subplots(1, 1 + len(axes))
    pairs = np.array([row["pairs"] for row in rows], dtype=float)
    panels[0].plot(pairs, [row["loss"] for row in rows], color="0.2", marker=".")
    panels[0].set(title="training loss", ylabel="loss")
    suffix = f" {axes[0].name} ({axes[0].unit})"
    sources = [key.removesuffix(suffix) for key in rows[0] if key.endswith(suffix)]
    for panel, axis, no_motion in zip(panels[1:], axes, zero, strict=True):
        curves = []
        for source in sources:
            points = [(row["pairs"], row[column(source, axis)]) for row in rows if row.get(column(source, axis)) is not None]
            curves.append([value for _, value in points])
            style = {"color": "0.6"} if source == TRAINED else {"marker": "."}
            panel.plot(
                *zip(*points, strict=True), label=source if source == TRAINED else f"validation, noise {source}", **style
            )
        panel.axhline(no_motion, color="0.6", linestyle=":", label="no motion" if len(axes) > 1 else "zero")
        panel.set(title=axis.name, ylabel=f"RMSE ({axis.unit})", yscale="log")
        lowest, highest = min(map(min, curves)), max(map(max, curves))
        if min(lowest, no_motion) > 0:
            panel.set_ylim(min(lowest, no_motion / 5) / 1.2, max(highest, no_motion) * 1.2)
        panel.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        panel.yaxis.set_minor_formatter(NullFormatter())
    for panel in panels:
        panel.set(xlabel="training samples seen")
        if pairs[-1] >= LOG_AXIS_RATIO * pairs[0]:
            panel.set_xscale("log")
            panel.xaxis.set_minor_formatter(NullFormatter())
        panel.xaxis.set_major_formatter(EngFormatter(sep=""))
        panel.grid(visible=True, which="both", alpha=0.25)
    panels[1].legend(fontsize="small")
    return figure
