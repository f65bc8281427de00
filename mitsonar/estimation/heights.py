"""Height estimators by name."""

from __future__ import annotations

from functools import partial

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimators import options_from
from mitsonar.estimation.height import DirectHeight, HeightEstimator

__all__ = ["height_estimator_from"]


def height_estimator_from(text: str) -> HeightEstimator:
    """What the command line says: ``direct``, a checkpoint or the folder of a training run, or either with options.

    Raises:
        MitsonarError: no such checkpoint, one of motions, an unknown option.
    """
    name, *words = text.split(":")
    if name == "direct":
        return DirectHeight(**options_from(name, words, DirectHeight))
    if "/" not in name and "." not in name:
        raise MitsonarError(f"heights are told by direct, or by the checkpoint or folder of a training: got {name!r}")
    try:
        from mitsonar.estimation.height_network import HeightNetwork
        from mitsonar.networks.checkpoint import Checkpoint
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "torch":
            raise
        raise MitsonarError("a network computes with torch: pip install 'mitsonar[learn]'") from None
    made = partial(HeightNetwork, Checkpoint.load(name))
    return made(**options_from(name, words, made))
