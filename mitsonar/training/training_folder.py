"""The folder of a training run: recipe, state, best network, log and learning curve, each whole or absent."""

from __future__ import annotations

import csv
import io
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import yaml
from lightning.pytorch.plugins.io import TorchCheckpointIO

from mitsonar.config.training import TrainingRecipe
from mitsonar.errors import MitsonarError
from mitsonar.io.files import whole_number, write_whole
from mitsonar.io.runs import RUN_FILE, RunDirectory, RunKind
from mitsonar.motion.errors import Axis
from mitsonar.training.training_types import JsonObject

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["TRAINING", "RunFolder", "StateFile", "column", "curve_figure"]

EVENTS = "tensorboard"
"""Folder of what TensorBoard shows, in the folder of a training."""

TRAINED = "training"
"""What the columns of the log are of that hold the RMSE of the samples that a network learns from."""

TRAINING = RunKind(
    "training",
    outputs=("recipe.yaml", "last.ckpt", "network.ckpt", "log.csv", "curve.png", EVENTS),
    notes={
        **{"gain": float | None, "threads": int, "accelerator": str, "epoch_samples": int, "steps": int, "machine": dict},
        **{"steps_done": int, "minutes": float},
    },
    packages=("mitsonar", "torch", "lightning", "numpy"),
)

WIDE = 30
"""Ratio of last to first samples seen from which their axis is logarithmic."""


class StateFile(TorchCheckpointIO):
    """The file of Lightning's state. It is written whole or not at all, and nothing in it is executed."""

    def save_checkpoint(self, checkpoint: JsonObject, path: str | Path, storage_options: object | None = None) -> None:
        """Write a state, whole or not at all."""
        buffer = io.BytesIO()
        torch.save(checkpoint, buffer)
        write_whole(path, buffer.getvalue())

    def load_checkpoint(
        self, path: str | Path, map_location: Callable[..., Any] | None = None, weights_only: bool | None = True
    ) -> JsonObject:
        """Read a state, without executing anything in it.

        Raises:
            MitsonarError: the file is damaged, or holds something else.
        """
        try:
            state = torch.load(path, map_location=map_location or "cpu", weights_only=True)
            if not isinstance(state["state_dict"], dict):
                raise ValueError("it holds something else")
            whole_number(state["global_step"], "global_step")
        except Exception as error:  # a damaged zip or pickle raises whatever its bytes lead to
            raise MitsonarError(
                f"{path} is damaged ({str(error).splitlines()[0] if str(error) else type(error).__name__}): begin anew with "
                "--overwrite"
            ) from None
        return dict(state)


@dataclass
class RunFolder:
    """The folder of a training.

    Attributes:
        path: of the folder.
        writes: whether this process writes.
        run: arguments and progress; None before :meth:`begin`, and if another process writes.
    """

    path: Path
    writes: bool = True
    run: RunDirectory | None = None

    @property
    def state(self) -> Path:
        """Return the path of the state, from which --resume continues."""
        return self.path / "last.ckpt"

    @property
    def network(self) -> Path:
        """Return the path of the best network."""
        return self.path / "network.ckpt"

    def known(self) -> RunDirectory | None:
        """Return the earlier run in the folder, if there is one. Its arguments may differ.

        Raises:
            MitsonarError: its file is damaged.
        """
        return RunDirectory.open(self.path, TRAINING) if (self.path / RUN_FILE).is_file() else None

    def begin(
        self, recipe: TrainingRecipe, asked: JsonObject, notes: JsonObject, *, resume: bool, overwrite: bool
    ) -> RunDirectory | None:
        """Create the folder, or resume the run in it, and return the resumed run.

        Args:
            recipe: of the training.
            asked: arguments beside the recipe that a resumed run must repeat to reach the same weights.
            notes: other facts on the run.
            resume: resume a run in the folder.
            overwrite: replace a run in the folder.

        Raises:
            MitsonarError: the folder holds a run and neither is allowed, the arguments differ, or it holds other things.
        """
        if not self.writes:
            return None
        asked = {**asked, "recipe": recipe.plain()}
        self.run = RunDirectory.begin(self.path, TRAINING, asked, resume=resume, overwrite=overwrite)
        self.run.start(**notes, machine=machine())
        if not (self.path / "recipe.yaml").is_file():
            text = yaml.safe_dump(recipe.plain(), sort_keys=False, allow_unicode=True)
            write_whole(self.path / "recipe.yaml", text.encode())
        return self.run if self.run.resumed else None

    def end(self, *, finished: bool, **notes: float) -> None:
        """Store the progress of the training."""
        if self.run is not None:
            self.run.finished = finished
            self.run.note(**notes)

    def log(self, rows: list[JsonObject], zero: list[float], axes: tuple[Axis, ...], *, drawn: bool) -> None:
        """Write ``log.csv``, and ``curve.png`` if it is to be drawn."""
        text = io.StringIO()
        table = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(
            {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()} for row in rows
        )
        write_whole(self.path / "log.csv", text.getvalue().encode())
        if not drawn:
            return
        buffer = io.BytesIO()
        curve_figure(rows, zero, axes).savefig(buffer, format="png", dpi=110)
        write_whole(self.path / "curve.png", buffer.getvalue())


def machine() -> JsonObject:
    """Describe this machine."""
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {"system": platform.platform(), "cores": len(os.sched_getaffinity(0)), "gpu": device}


def column(level: str, axis: Axis) -> str:
    """Return the name of a column of the log: the RMSE of one axis in training, or in validation at a level of noise."""
    return f"{level} {axis.name} ({axis.unit})"


def curve_figure(rows: list[JsonObject], zero: list[float], axes: tuple[Axis, ...]) -> Figure:
    """Draw the loss, and the RMSE of each axis in training and validation, against the training samples seen.

    Args:
        rows: of the log; one at least with a validation.
        zero: RMSE of always answering no motion, in the units of ``axes``.
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
    shown = [key.removesuffix(suffix) for key in rows[0] if key.endswith(suffix)]
    for panel, axis, still in zip(panels[1:], axes, zero, strict=True):
        curves = []
        for what in shown:
            points = [(row["pairs"], row[column(what, axis)]) for row in rows if row.get(column(what, axis)) is not None]
            curves.append([value for _, value in points])
            style = {"color": "0.6"} if what == TRAINED else {"marker": "."}
            panel.plot(*zip(*points, strict=True), label=what if what == TRAINED else f"validation, noise {what}", **style)
        panel.axhline(still, color="0.6", linestyle=":", label="no motion" if len(axes) > 1 else "zero")
        panel.set(title=axis.name, ylabel=f"RMSE ({axis.unit})", yscale="log")
        lowest, highest = min(map(min, curves)), max(map(max, curves))
        if min(lowest, still) > 0:
            panel.set_ylim(min(lowest, still / 5) / 1.2, max(highest, still) * 1.2)
        panel.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        panel.yaxis.set_minor_formatter(NullFormatter())
    for panel in panels:
        panel.set(xlabel="training samples seen")
        if pairs[-1] >= WIDE * pairs[0]:
            panel.set_xscale("log")
            panel.xaxis.set_minor_formatter(NullFormatter())
        panel.xaxis.set_major_formatter(EngFormatter(sep=""))
        panel.grid(visible=True, which="both", alpha=0.25)
    panels[1].legend(fontsize="small")
    return figure
