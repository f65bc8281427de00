"""What a row of a table reached here: its errors, and the scale of its training."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mitsonar.training.document_tables import Errors, Strict

__all__ = ["Found", "Part", "Reached", "RowScore"]

Part = Literal["validation", "test", "unseen"]
"""Samples that a row is scored on."""


class RowScore(Strict):
    """Errors on some samples: sideways [mm], forward [mm], and yaw [deg] if the network estimates it; or height [mm].

    Attributes:
        pairs: number of pairs.
        scenes: number of scenes that they are of.
        rmse: root mean square error.
        low: lower end of its 95 % interval.
        high: upper end of its 95 % interval.
        slope: of the estimates over the true motions, without unit; null where nothing moved.
        zero: RMSE of always estimating no motion.
        ms: processor time of one estimate on one core [ms], as an evaluation measures it.
    """

    pairs: int
    scenes: int
    rmse: Errors
    low: Errors
    high: Errors
    slope: tuple[float | None, ...]
    zero: Errors
    ms: float | None = None


class Reached(Strict):
    """The scale at which a row was reached.

    Attributes:
        training_pairs: number of training samples.
        pairs_seen: samples seen in training; a sample counts each time that it is seen.
        pairs_best: samples seen when the evaluated network was saved, the best by validation.
        epochs: pairs_seen over training_pairs.
        epochs_asked: epochs of the recipe.
        minutes: duration of training [min].
        device: device of training.
        machine: processor of that machine.
        threads: number of threads.
        batch: samples of one step.
        rate: initial learning rate.
        precision: of the training.
        split: how validation samples are separated from training: ``sample``, ``sequence`` or ``scene``.
        date: day on which training ended.
    """

    training_pairs: int
    pairs_seen: int
    pairs_best: int
    epochs: float
    epochs_asked: float
    minutes: float
    device: str
    machine: str
    threads: int
    batch: int
    rate: float
    precision: str
    split: str
    date: str


class Found(Strict):
    """Errors of one row, and the scale at which they were reached.

    Attributes:
        recipe: name of the row.
        validation: errors by noise, on the part of the data set that is not used for training.
        test: errors by noise, on the sequences that are kept from training and validation; empty where there are none.
        unseen: errors by noise, on the scenes of a data set with another seed.
        reached: scale of the training.
    """

    recipe: str
    validation: dict[str, RowScore]
    test: dict[str, RowScore] = Field(default_factory=dict)
    unseen: dict[str, RowScore]
    reached: Reached

    def score(self, part: Part, noise: str) -> RowScore | None:
        """Return the errors on one part with one noise; None where there are no such samples."""
        scores: dict[str, RowScore] = getattr(self, part)
        return scores.get(noise)
