"""Names for what the training room passes on without looking inside."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

    from mitsonar.networks.corrnet import GaussianHead, Ground

    NetworkInput = Tensor | tuple[Tensor | Ground, ...]
    """One input of a network, or several, which are passed as separate arguments."""

    NetworkOutput = Tensor | GaussianHead
    """Labels ``(batch, outputs)``, or motions with a covariance."""

__all__ = ["Array", "Batch", "JsonObject", "RawSample"]

Array = NDArray[np.float64]
"""Numbers in SI units, unless the text says otherwise."""

JsonObject = dict[str, Any]
"""What a JSON file, a YAML file or a report holds: plain values by name."""

RawSample = dict[str, Any]
"""One sample as a data set stores it: arrays and numbers by name, before noise and arrangement."""

Batch = dict[str, Any]
"""Samples of one step: ``epoch``, ``frames``, and ``raw`` samples, or finished ``inputs`` and ``label``."""
