"""The runs of ``bench_trajectories.py``: seabeds, trajectories, methods, and the figures of Almanza-Medina."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

TEXTURES = ("gaussian", "perlin_high", "perlin_low", "photo_sand", "photo_gravel", "photo_rock")
RUNS = ("legs", "diagonal", "turn")
"""Seabeds and runs in the order of table 2.1; the last three seabeds are stand-ins for photographs."""

TABLE_21 = {
    "gaussian": ((4.40, 0.95, 0.010), (2.27, 0.86, 0.030), (10.63, 2.88, 0.31)),
    "perlin_high": ((11.86, 3.33, 0.060), (6.19, 1.70, 0.080), (13.06, 1.13, 0.41)),
    "perlin_low": ((9.03, 2.45, 0.040), (4.29, 1.28, 0.060), (13.39, 1.17, 0.38)),
    "photo_sand": ((12.29, 3.93, 0.050), (5.93, 2.49, 0.070), (11.00, 0.55, 0.39)),
    "photo_gravel": ((15.98, 4.83, 0.050), (12.59, 4.69, 0.100), (7.55, 0.71, 0.41)),
    "photo_rock": ((13.78, 3.95, 0.050), (11.56, 4.24, 0.090), (7.44, 0.78, 0.41)),
}
"""RMSE of Almanza-Medina for each run: sideways mm, forward mm, yaw deg (printed there with forward first)."""


class Setting(NamedTuple):
    """A row's method and data; one of so many pairs is used."""

    method: str
    model: str
    noise: str
    every: int = 1


SETTINGS = (
    Setting("direct", "thesis", "chapter2"),
    Setting("direct", "physical", "none"),
    Setting("direct", "thesis", "none"),
    Setting("flow", "thesis", "chapter2", 2),
    Setting("ecc", "thesis", "chapter2", 2),
    Setting("direct", "physical", "chapter2"),
)

RECIPES = {"thesis": "rocky-field", "physical": "rocky-field-physical"}
"""Where the sonar of each model is described."""

SPECKLE = "coherent"
"""Model of runs whose sonar is that of the model ``physical`` with speckle; they are rendered without noise only."""

HEIGHT_M, PITCH_DEG = 2.5, 35.0
FIELD_M, FIELD_SEED, FRAMES = 50.0, 904, 904
"""The field of the trajectories. The worlds of the recipes have other seeds: hashes of the data set's seed and the scene."""

COARSE = {"rays_per_beam": 300, "rays_across": 1}
"""Changes of a sonar by `--quick`."""

SLOW, FAST, CREEPING, BRAKED = 0.105, 0.378, 0.063, 0.357
"""Speeds of 3.5.1 [m/s]."""

NOISE_OF = {
    "sideways": "none",
    "forward": "none",
    "braking": "none",
    "diagonal": "chapter2",
    "legs": "chapter2",
}
"""Runs, and the noise that Almanza-Medina added to them."""


@dataclass(frozen=True)
class Job:
    """One run of one method; ``frames`` is how many are used at most, 0 for all; ``coarse`` takes few rays and few rocks."""

    part: str
    run: str
    texture: str
    method: str
    model: str
    noise: str
    every: int
    frames: int
    coarse: bool = False

    @property
    def name(self) -> str:
        """Return the name of its files."""
        method = re.sub(r"[^A-Za-z0-9]+", "-", self.method).strip("-")
        words = (self.part, self.run, self.texture, method, self.model, self.noise)
        return "-".join([*words, *([str(self.frames)] if self.frames else [])])


class Table(NamedTuple):
    """Rows of table 2.1: seabeds and settings."""

    textures: tuple[str, ...]
    settings: tuple[Setting, ...]


def jobs(
    parts: Iterable[str], frames: int, every: int, table: Table, coarse: bool, methods: Sequence[str] = ("direct",)
) -> Iterator[Job]:
    """List all jobs, the most important first. Networks fly the runs over the rocky field of the model `thesis` only."""
    if "trajectories" in parts:
        for method in methods:
            quiet = [run for run, noise in NOISE_OF.items() if noise == "none"]
            if method != "direct":
                yield from (trajectory_job(run, "thesis", frames, coarse, method) for run in quiet)
                continue
            yield from (trajectory_job(run, model, frames, coarse) for model in RECIPES for run in NOISE_OF)
            yield from (trajectory_job(run, SPECKLE, frames, coarse) for run in quiet)
    if "table21" in parts:
        for setting in table.settings:
            local = setting._replace(every=setting.every * every)
            yield from (Job("table21", run, texture, *local, frames, coarse) for texture in table.textures for run in RUNS)


def trajectory_job(run: str, model: str, frames: int, coarse: bool = False, method: str = "direct") -> Job:
    """Return the job of a trajectory."""
    texture = "gaussian" if run in RUNS else "rocky-field"
    return Job("trajectories", run, texture, method, model, NOISE_OF[run], 1, frames, coarse)
