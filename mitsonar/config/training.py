"""Training recipes and training options: their keys, and how they are read from YAML and validated.

A recipe is shipped for each row of Almanza-Medina's tables.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from mitsonar.acoustics.noise import load_noise, parse_snr
from mitsonar.config.data import SPLITS, Keys, Split, recipe_fields, set_key, split_from
from mitsonar.errors import MitsonarError, short_repr, validation_message

__all__ = [
    "STATE_MINUTES",
    "Input",
    "Loss",
    "Optimiser",
    "TrainOptions",
    "TrainingRecipe",
    "Validate",
    "load_training_recipe",
    "shipped_training_recipes",
]

Precision = Literal["32-true", "16-mixed", "bf16-mixed"]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


def _check_noise(text: str) -> str:
    (parse_snr if text.endswith("dB") else load_noise)(text)
    return text


Noise = Annotated[str, AfterValidator(_check_noise)]


class Input(_Part):
    """Conversion of frames to network input: arguments of :class:`~mitsonar.datasets.samples.SonarPairs`.

    For impulse responses only ``frames`` and ``leak`` apply, as arguments of
    :class:`~mitsonar.datasets.samples.ImpulsePairs`.
    """

    frames: int = Field(2, ge=1, le=16, description="frames per sample; 1: learn heights")
    views: list[str] | None = Field(None, description="names of the views; null: all")
    kind: Literal["image", "vector", "response"] = Field(
        "image", description="images, sums over their beams, or impulse responses"
    )
    layout: Literal["side", "stack", "channels"] = Field("side", description="frames side by side, stacked, or channels")
    coordinates: Literal["polar", "cartesian", "both"] = Field("polar", description="as stored, fans in metres, or both")
    cartesian_rows: int = Field(512, ge=2, le=8192, description="pixels of a fan in the forward direction")
    range_levels: int | None = Field(
        None, ge=1, description="number of bins of vectors, by summing neighbours; null: as stored"
    )
    halves: bool = Field(False, description="vectors of both halves of images (fig. 4.18)")
    ground: bool = Field(False, description="add the geometry of the ground, for networks that use it")
    leak: Literal["none", "one_ping", "strangers"] = Field(
        "none", description="test with impulse responses without motion: anything still learnt is a leak"
    )

    @model_validator(mode="after")
    def _check_kind(self) -> Self:
        defaults = Input.model_construct(kind=self.kind, frames=self.frames)
        image_keys = ("views", "layout", "coordinates", "cartesian_rows", "range_levels", "halves", "ground")
        names = image_keys if self.kind == "response" else ("leak",)
        misplaced = [name for name in names if getattr(self, name) != getattr(defaults, name)]
        if misplaced:
            raise ValueError(f"input.{misplaced[0]} does not apply to kind {self.kind}: leave it out")
        return self

    def arguments(self) -> Keys:
        """Return the keyword arguments for SonarPairs and RenderedPairs, or for ImpulsePairs."""
        arguments = self.model_dump()
        if self.kind == "response":
            return {"frames": self.frames, "leak": self.leak}
        del arguments["leak"]
        if not arguments["ground"]:
            del arguments["ground"]
        return arguments


class Loss(_Part):
    """Loss function of training."""

    kind: Literal["mse", "likelihood"] = Field(
        "mse", description="eq. 3.1; or the likelihood of the motion, with its covariance"
    )
    penalty: float = Field(
        0.0, ge=0, allow_inf_nan=False, description="weight eta of eq. 3.2 for estimates beyond the bounds"
    )
    bounds: tuple[float, float] | None = Field(
        None, description="bounds of eq. 3.2, in label units; default: labels of the largest motions, +-10 for normx10"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.bounds is not None and not self.bounds[0] < self.bounds[1]:
            raise ValueError(f"loss bounds must be low,high with low < high: got {self.bounds[0]:g},{self.bounds[1]:g}")
        if self.kind == "likelihood" and self.penalty:
            raise ValueError("loss.penalty applies only to kind mse: omit it for kind likelihood")
        return self


class Optimiser(_Part):
    """The optimiser and its learning rate."""

    kind: Literal["adam", "adamw"] = "adam"
    rate: float = Field(1e-4, gt=0, le=10, description="learning rate at the start")
    schedule: Literal["halve", "cosine", "constant", "steps"] = Field("halve", description="schedule of the rate")
    steps: list[tuple[float, float]] = Field(
        default_factory=list, description="for schedule steps: [epoch, rate from that epoch]"
    )
    halve_every: float = Field(12.0, gt=0, description="epochs between reductions of the rate")
    fall_to: float = Field(0.5, gt=0, le=1, description="factor of each reduction, with schedule halve")
    warmup: int = Field(0, ge=0, description="steps over which the rate rises from 0 at the start")
    weight_decay: float = Field(0.0, ge=0, le=1)
    clip: float | None = Field(None, gt=0, description="maximum norm of the gradient; null: unlimited")

    @model_validator(mode="after")
    def _check_steps(self) -> Self:
        epochs, rates = [epoch for epoch, _ in self.steps], [rate for _, rate in self.steps]
        valid = epochs == sorted(set(epochs)) and all(0 < rate <= 10 for rate in rates)
        if (self.schedule == "steps") != bool(self.steps) or not valid:
            raise ValueError(
                "optimiser steps must be [epoch, rate] pairs with increasing epochs and 0 < rate <= 10, for "
                f"schedule steps only: got {self.steps} with schedule {self.schedule}"
            )
        return self

    def rate_at(self, step: int, epoch_steps: int, steps: int) -> float:
        """Return the learning rate at a step.

        It does not depend on earlier steps, so a resumed training continues with the same rates.

        Args:
            step: index of the step, from 0.
            epoch_steps: number of steps in an epoch.
            steps: planned number of steps of the whole training.
        """
        warmup_factor = min(1.0, (step + 1) / self.warmup) if self.warmup else 1.0
        match self.schedule:
            case "halve":
                return self.rate * warmup_factor * self.fall_to ** math.floor(step / (self.halve_every * epoch_steps))
            case "steps":
                passed_rates = [rate for epoch, rate in self.steps if step >= epoch * epoch_steps]
                return warmup_factor * (passed_rates[-1] if passed_rates else self.rate)
            case "cosine":
                progress = max(0, step - self.warmup) / max(1, steps - self.warmup)
                return self.rate * warmup_factor * 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))
            case _:
                return self.rate * warmup_factor


class Validate(_Part):
    """Validation during training, which does not affect the updates of the weights."""

    noise: list[Noise] = Field(default=["none", "high"], min_length=1, description="noise levels")
    pairs: int | None = Field(500, ge=1, description="number of samples, the same each time; null: all of the part")
    every_minutes: float = Field(5.0, gt=0)
    every_steps: int | None = Field(None, ge=1, description="interval in steps, instead of minutes")


class TrainingRecipe(_Part):
    """A training recipe; the field descriptions document its keys.

    Raises:
        MitsonarError: from :func:`load_training_recipe`, if a key is unknown or a value is out of bounds.
    """

    about: str = Field("", description="description in one sentence")
    network: Keys = Field(description="name of the network, or name and options: {name: posenet, width: 0.25}")
    start: str | None = Field(None, description="checkpoint or run with the initial weights; null: random weights")
    data: str = Field("rocky-field", description="data set recipe, name or file, for --render and reproduce")
    data_changes: Keys = Field(default_factory=dict, description="overrides of that recipe: {sonar.range_bins: 256}")
    part_of_data: float = Field(
        1.0, gt=0, le=1, description="fraction of the frames, from the first, whose samples are used"
    )
    input: Input = Field(default_factory=Input)
    labels: Literal["raw", "quantised", "normx10"] = Field("normx10", description="encoding of the network's outputs")
    noise: Noise | list[Noise] = Field("none", description="noise in training; from a list, each sample draws one")
    augment: list[Literal["mirror", "reverse", "strangers"]] = Field(
        default_factory=list, description="augmentations of samples, for networks that use the ground"
    )
    split: str | Keys = Field("sequence", description="sequence, scene, sample, or keys of a data set recipe's split")
    loss: Loss = Field(default_factory=Loss)
    optimiser: Optimiser = Field(default_factory=Optimiser)
    batch: int = Field(4, ge=1, le=65_536, description="samples per step, over all devices")
    epochs: float | None = Field(32.0, gt=0, allow_inf_nan=False, description="passes over all samples; or steps")
    steps: int | None = Field(None, ge=1, description="steps of the optimiser, instead of epochs")
    precision: Precision = Field("32-true", description="precision, as named by Lightning; on a processor only 32-true")
    validate_: Validate = Field(default_factory=Validate, alias="validate")
    seed: int = Field(0, ge=0, lt=2**31, description="seed for weights, order, noise and dropout")

    @model_validator(mode="before")
    @classmethod
    def _expand(cls, fields: object) -> object:
        if not isinstance(fields, dict):
            return fields
        expanded = {"network": {"name": fields["network"]}} if isinstance(fields.get("network"), str) else {}
        kind = fields["input"].get("kind") if isinstance(fields.get("input"), dict) else None
        if kind == "response" and isinstance(fields.get("validate", {}), dict):
            expanded["validate"] = {"noise": ["none"], **fields.get("validate", {})}
        unset = {"epochs": None} if fields.get("steps") is not None and "epochs" not in fields else {}
        return {**fields, **expanded, **unset}

    @field_validator("network")
    @classmethod
    def _check_network(cls, network: Keys) -> Keys:
        if not isinstance(network.get("name"), str):
            raise ValueError("network must be a name, such as posenet, or a name and options")
        return network

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.epochs is None) == (self.steps is None):
            raise ValueError(f"give either epochs or steps: got epochs {self.epochs}, steps {self.steps}")
        if isinstance(self.noise, list) and not self.noise:
            raise ValueError("noise must be a level or a list of levels, not an empty list: give 'none' for no noise")
        in_decibels = self.input.kind == "response"
        for level in {*self.noises, *self.validate_.noise} - {"none"}:
            if level.endswith("dB") != in_decibels:
                allowed = (
                    "a signal to noise ratio such as '20 dB'" if in_decibels else "low, high, chapter2 or mean,std,scale"
                )
                raise ValueError(
                    f"noise of input.kind {self.input.kind} must be {allowed}, or none: got {short_repr(level)}"
                )
        if self.augment and not self.input.ground:
            raise ValueError("augment needs inputs with ground: set input.ground: true, or leave augment out")
        if isinstance(self.split, dict):
            split_from(self.split)
        elif self.split not in SPLITS:
            raise ValueError(f"split must be {', '.join(SPLITS)}, or keys as in a data set recipe: got {self.split!r}")
        return self

    @property
    def validation(self) -> Validate:
        """Return the value of the key ``validate``, whose name pydantic reserves."""
        return self.validate_

    @property
    def noises(self) -> list[str]:
        """Return the noise levels in training as a list."""
        return [self.noise] if isinstance(self.noise, str) else list(self.noise)

    @property
    def noise_text(self) -> str:
        """Return the noise levels in training as text."""
        return " or ".join(self.noises)

    @cached_property
    def resolved_split(self) -> str | Split:
        """Return the split in the form that SonarPairs accepts."""
        return split_from(self.split) if isinstance(self.split, dict) else self.split

    def arrangement(self) -> Keys:
        """Return the keyword arguments for SonarPairs and RenderedPairs in training."""
        noise = self.noises
        return {
            **self.input.arguments(),
            "labels": self.labels,
            "noise": noise[0] if len(noise) == 1 else noise,
            "seed": self.seed,
        }

    def length(self, epoch_steps: int) -> int:
        """Return the total number of training steps, at least one."""
        return self.steps or max(1, round((self.epochs or 0) * epoch_steps))

    def plain(self) -> Keys:
        """Return all keys with JSON-compatible values, as in the recipe file of a run."""
        return self.model_dump(mode="json", by_alias=True)

    def replace(self, **fields: object) -> TrainingRecipe:
        """Return a validated copy with some keys changed.

        Raises:
            MitsonarError: a key is unknown, or a value is outside its limits.
        """
        return training_recipe_from({**self.plain(), **fields})


def shipped_training_recipes() -> dict[str, Path]:
    """Return the files of the shipped training recipes, keyed by name."""
    if find_spec("mitsonar.recipes") is None:
        return {}
    return {path.stem: path for path in sorted(Path(str(files("mitsonar.recipes"))).glob("*.yaml"))}


def load_training_recipe(name_or_file: str | Path, changes: Keys | None = None) -> TrainingRecipe:
    """Load a training recipe from a YAML file, or a shipped recipe by its name.

    Args:
        name_or_file: a file, such as ``mine.yaml``, or the name of a shipped recipe.
        changes: values to override, keyed by dotted path: ``{"optimiser.rate": 1e-3}``.

    Raises:
        MitsonarError: there is no such recipe, the file is not YAML, a key is unknown, or a value is outside its limits.
    """
    fields, path = recipe_fields(name_or_file, shipped_training_recipes(), "training recipe", TrainingRecipe)
    if isinstance(fields.get("network"), str):
        fields["network"] = {"name": fields["network"]}
    for key, value in (changes or {}).items():
        set_key(fields, key, value)
    if isinstance(fields.get("data"), str) and fields["data"].lower().endswith((".yaml", ".yml")):
        fields["data"] = os.path.realpath(path.parent / fields["data"])  # relative to the folder of the recipe
    return training_recipe_from(fields)


def training_recipe_from(fields: Keys) -> TrainingRecipe:
    """Create a validated training recipe from its keys.

    Raises:
        MitsonarError: a key is unknown, or a value is outside its limits.
    """
    try:
        return TrainingRecipe(**fields)
    except ValidationError as error:
        message = validation_message(error, TrainingRecipe, "training recipe")
        raise MitsonarError(message.replace("validate_", "validate")) from None
    except TypeError as error:
        raise MitsonarError(f"training recipe keys must be strings: {error}") from None


# ---------------- Training options


STATE_MINUTES = 5.0
"""Interval between saved states, which bounds the training time lost if the process is killed [min]."""


@dataclass(frozen=True)
class TrainOptions:
    """Recipe, data, output folder and hardware of a training: the options of ``mitsonar train``.

    Attributes:
        recipe: training recipe, its name, or a YAML file.
        data: path or URL of a data set, or of several data sets of the same sonar to concatenate, such as one per model.
        out: folder of the run.
        render: render samples during training, with the recipe of ``data``, or else the one that ``recipe`` names.
        minutes: total duration after which training stops [min], including validation and earlier parts of a resumed run.
        resume: resume the run in ``out``, or start a new run if there is none.
        overwrite: replace a run in ``out``.
        scale: fraction of the data to use; multiplies ``part_of_data`` of the recipe.
        pairs: length of the training in samples; overrides that of the recipe.
        accelerator: as in Lightning's trainer.
        devices: as in Lightning's trainer.
        strategy: as in Lightning's trainer.
        precision: as in Lightning's trainer; overrides that of the recipe.
        threads: number of CPU threads.
        workers: number of processes that read or render; by default it depends on the machine.
        state_minutes: interval between saved states [min].

    Raises:
        MitsonarError: a number is outside its limits.
    """

    recipe: TrainingRecipe | str | Path
    data: str | Path | Sequence[str | Path] | None
    out: str | Path
    render: bool = False
    minutes: float | None = None
    resume: bool = False
    overwrite: bool = False
    scale: float | None = None
    pairs: int | None = None
    accelerator: str = "auto"
    devices: str | int = "auto"
    strategy: str = "auto"
    precision: str | None = None
    threads: int | None = None
    workers: int | None = None
    state_minutes: float = STATE_MINUTES

    def __post_init__(self) -> None:
        if self.scale is not None and not 0 < self.scale <= 1:
            raise MitsonarError(f"--scale must lie in 0..1: got {self.scale:g}")
        if self.minutes is not None and not self.minutes > 0:
            raise MitsonarError(f"--minutes must be above 0: got {self.minutes:g}")
        for name, minimum in (("threads", 1), ("workers", 0)):
            count = getattr(self, name)
            if count is not None and count < minimum:
                raise MitsonarError(f"--{name} must be at least {minimum}: got {count}")

    def changed_recipe(self) -> TrainingRecipe:
        """Load the recipe and apply ``scale``, ``pairs`` and ``precision``; the run uses the result.

        Raises:
            MitsonarError: there is no such recipe, or ``pairs`` is less than its batch size.
        """
        recipe = self.recipe if isinstance(self.recipe, TrainingRecipe) else load_training_recipe(self.recipe)
        changes: Keys = {}
        if self.scale is not None:
            changes["part_of_data"] = self.scale * recipe.part_of_data
        if self.pairs is not None:
            if self.pairs < recipe.batch:
                raise MitsonarError(f"--pairs must be at least the batch size, {recipe.batch}: got {self.pairs}")
            changes |= {"steps": self.pairs // recipe.batch, "epochs": None}
        if self.precision is not None:
            changes["precision"] = self.precision
        return recipe.replace(**changes) if changes else recipe
