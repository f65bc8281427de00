"""How values 0..1 of a picture stand for levels: linearly, in decibels (ARIS, DIDSON), or as a power (Oculus)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from mitsonar.instruments.sonar import Sonar

__all__ = ["coded", "coding_slope", "decoded"]


def coded(level: NDArray[np.float32], sonar: Sonar) -> NDArray[np.float32]:
    """Return values 0..1, float32, for levels relative to full scale, of the same shape.

    ``linear``: the level. ``dB``: 1 + 10 log10(level) / ``coding_db``. ``gamma``: amplitude^``coding_gamma``. All are
    clipped to 0..1.
    """
    if sonar.value_coding == "linear":
        linear: NDArray[np.float32] = np.clip(level, 0, 1)
        return linear
    if sonar.value_coding == "gamma":
        return np.asarray(np.clip(level, 0, 1) ** np.float32(sonar.coding_gamma / 2), dtype=np.float32)
    smallest = np.float32(10 ** (-sonar.coding_db / 10))
    value = 1 + np.log10(np.clip(level, smallest, 1)) * np.float32(10 / sonar.coding_db)
    return np.asarray(np.maximum(value, np.float32(0)), dtype=np.float32)


def coding_slope(level: NDArray[np.float64], sonar: Sonar) -> NDArray[np.float64]:
    """Return the derivative of values 0..1 by the level relative to full scale, of the same shape; 0 beyond full scale.

    Args:
        level: above 0.
        sonar: its coding.
    """
    match sonar.value_coding:
        case "linear":
            slope = np.ones_like(level)
        case "gamma":
            slope = sonar.coding_gamma / 2 * level ** (sonar.coding_gamma / 2 - 1)
        case _:
            slope = 10 / (np.log(10) * sonar.coding_db * np.maximum(level, 10 ** (-sonar.coding_db / 10)))
    return np.asarray(np.where(level < 1, slope, 0.0), dtype=np.float64)


def decoded(value: ArrayLike, sonar: Sonar, coding: str | None = None) -> NDArray[np.float64]:
    """Return the levels relative to full scale that values 0..1 stand for, of the same shape.

    A value of 0 of the coding ``dB`` stands for its least level, or less. ``coding`` None is the sonar's own.
    """
    value = np.asarray(value, dtype=float)
    match coding or sonar.value_coding:
        case "linear":
            return value
        case "gamma":
            return np.asarray(value ** (2 / sonar.coding_gamma), dtype=np.float64)
        case _:
            return np.asarray(10 ** ((value - 1) * (sonar.coding_db / 10)), dtype=np.float64)
