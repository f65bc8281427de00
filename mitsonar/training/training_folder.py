"""The folder of a training run: recipe, state, best network, log and learning curve, each whole or absent."""

from __future__ import annotations

import csv
import io
import os
import platform
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import yaml
from lightning.pytorch.plugins.io import TorchCheckpointIO

from mitsonar.config.training_recipe import TrainingRecipe, load_training_recipe
from mitsonar.errors import MitsonarError
from mitsonar.io.whole_files import read_json, write_json, write_whole
from mitsonar.motion.motion_errors import Axis

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["RunFolder", "StateFile", "column", "curve_figure"]

NAMES = ("run.json", "recipe.yaml", "last.ckpt", "network.ckpt", "log.csv", "curve.png")
MUST_AGREE = ("data", "digest", "render", "workers", "world_size")
"""What a resumed run must have as before, beside the recipe, to reach the same weights."""

WIDE = 30
"""Ratio of samples seen from which they are drawn on a log axis."""


class StateFile(TorchCheckpointIO):
    """Lightning's state, written whole and read without executing anything in it."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        """Write it."""
        buffer = io.BytesIO()
        torch.save(checkpoint, buffer)
        write_whole(path, buffer.getvalue())

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = True) -> dict[str, Any]:
        """Read it.

        Raises:
            MitsonarError: damaged, or something else.
        """
        try:
            state = torch.load(path, map_location=map_location or "cpu", weights_only=True)
            if not isinstance(state["state_dict"], dict) or not isinstance(state["global_step"], int):
                raise ValueError("it holds something else")
        except Exception as error:  # a damaged zip or pickle raises whatever its bytes lead to
            raise MitsonarError(
                f"{path} is damaged ({str(error).splitlines()[0] if str(error) else type(error).__name__}): begin anew with "
                "--overwrite"
            ) from None
        return dict(state)


@dataclass(frozen=True)
class RunFolder:
    """Where a training lies.

    Attributes:
        path: of the folder.
        writes: whether this process is the one that writes.
    """

    path: Path
    writes: bool = True

    @property
    def state(self) -> Path:
        """What --resume goes on from."""
        return self.path / "last.ckpt"

    @property
    def network(self) -> Path:
        """The best network."""
        return self.path / "network.ckpt"

    def begin(
        self, recipe: TrainingRecipe, about: dict[str, Any], *, resume: bool, overwrite: bool
    ) -> dict[str, Any] | None:
        """Make the folder, or find an earlier run in it; what its run.json holds.

        Raises:
            MitsonarError: it exists and neither is allowed, holds other things, or an earlier run differs.
        """
        if not self.writes:
            return None
        if resume and overwrite:
            raise MitsonarError("--resume and --overwrite contradict each other: give one")
        there = self.path.exists() and (not self.path.is_dir() or any(self._apart_from_beginnings()))
        ours = (self.path / NAMES[0]).is_file()
        if there and not ours:
            raise MitsonarError(f"{self.path} holds other things and is kept: choose another -o")
        if there and not resume and not overwrite:
            raise MitsonarError(
                f"{self.path} holds a training and is kept: --resume goes on with it, --overwrite begins anew, or choose "
                "another -o"
            )
        if there and resume:
            return self._agreed(recipe, about)
        for name in NAMES if there else ():
            (self.path / name).unlink(missing_ok=True)
        self.path.mkdir(parents=True, exist_ok=True)
        text = yaml.safe_dump(recipe.plain(), sort_keys=False, allow_unicode=True)
        write_whole(self.path / "recipe.yaml", text.encode())
        write_json(self.path / "run.json", {**about, **machine(), "finished": False})
        return None

    def _apart_from_beginnings(self) -> list[Path]:
        """What lies there, but for what a run leaves that was killed before it had begun."""
        if (self.path / NAMES[0]).is_file():
            return list(self.path.iterdir())
        return [
            path for path in self.path.iterdir() if path.name not in ("recipe.yaml", ".recipe.yaml.part", ".run.json.part")
        ]

    def _agreed(self, recipe: TrainingRecipe, about: dict[str, Any]) -> dict[str, Any]:
        other = load_training_recipe(self.path / "recipe.yaml").differs(recipe)
        if other is not None:
            raise MitsonarError(
                f"{self.path} was begun with {other}: resume with {self.path / 'recipe.yaml'}, or choose another -o"
            )
        had = read_json(self.path / "run.json")
        for key in MUST_AGREE:
            if had.get(key) != about.get(key):
                raise MitsonarError(
                    f"{self.path} was begun with {key} {had.get(key)}, not {about.get(key)}: resume with what it was begun "
                    "with, or choose another -o"
                )
        return had

    def known(self) -> dict[str, Any]:
        """What an earlier run has written into run.json; empty where there is none."""
        return read_json(self.path / "run.json") if (self.path / "run.json").is_file() else {}

    def note(self, **fields: Any) -> None:
        """Add to run.json."""
        write_json(self.path / "run.json", {**self.known(), **fields})

    def log(self, rows: list[dict[str, Any]], zero: list[float], axes: tuple[Axis, ...]) -> None:
        """Write log.csv and curve.png anew."""
        if not rows:
            return
        text = io.StringIO()
        table = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(
            {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()} for row in rows
        )
        write_whole(self.path / "log.csv", text.getvalue().encode())
        buffer = io.BytesIO()
        curve_figure(rows, zero, axes).savefig(buffer, format="png", dpi=110)
        write_whole(self.path / "curve.png", buffer.getvalue())


def machine() -> dict[str, Any]:
    """Where and with what a run is made."""
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    versions = {name: version(name) for name in ("mitsonar", "torch", "lightning", "numpy")}
    return {
        "versions": versions,
        "machine": {"system": platform.platform(), "cores": len(os.sched_getaffinity(0)), "gpu": device},
    }


def column(level: str, axis: Axis) -> str:
    """Name of a column of the log: validation RMSE at a level of noise."""
    return f"{level} {axis.name} ({axis.unit})"


def curve_figure(rows: list[dict[str, Any]], zero: list[float], axes: tuple[Axis, ...]) -> Figure:
    """The loss, and the validation RMSE of each number, against training samples seen.

    Args:
        rows: of the log.
        zero: RMSE of answering no motion, in the units of ``axes``.
        axes: what is estimated.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter, FormatStrFormatter, LogLocator, NullFormatter

    figure = Figure(figsize=(3.4 * (1 + len(axes)), 3.2), layout="constrained")
    panels = figure.subplots(1, 1 + len(axes))
    pairs = np.array([row["pairs"] for row in rows], dtype=float)
    panels[0].plot(pairs, [row["loss"] for row in rows], color="0.2", marker=".")
    panels[0].set(title="training loss", ylabel="loss")
    suffix = f" {axes[0].name} ({axes[0].unit})"
    levels = [key.removesuffix(suffix) for key in rows[0] if key.endswith(suffix)]
    for panel, axis, still in zip(panels[1:], axes, zero, strict=True):
        curves = [[row[column(level, axis)] for row in rows] for level in levels]
        for level, curve in zip(levels, curves, strict=True):
            panel.plot(pairs, curve, marker=".", label=f"noise {level}")
        panel.axhline(still, color="0.6", linestyle=":", label="no motion" if len(axes) > 1 else "zero")
        panel.set(title=f"validation, {axis.name}", ylabel=f"RMSE ({axis.unit})", yscale="log")
        if min(np.min(curves), still) > 0:
            panel.set_ylim(min(np.min(curves), still / 5) / 1.2, max(np.max(curves), still) * 1.2)
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
