"""Height estimators by name."""

from __future__ import annotations

from functools import partial

from mitsonar.errors import MitsonarError, meant
from mitsonar.estimation.height.direct_height import DirectHeight, HeightEstimator
from mitsonar.estimation.named_estimators import load_checkpoint, names_checkpoint, options_from

__all__ = ["height_estimator_from"]


def height_estimator_from(text: str) -> HeightEstimator:
    """Create a height estimator from a text: ``direct``, a checkpoint or the folder of a training run, with options or not.

    Raises:
        MitsonarError: no such checkpoint, one of motions, an unknown option.
    """
    name, *words = text.split(":")
    if name == "direct":
        return DirectHeight(**options_from(name, words, DirectHeight))
    if not names_checkpoint(name):
        raise MitsonarError(
            "heights are told by direct, or by the checkpoint or folder of a training: got "
            f"{name!r}{meant(name, ['direct'])}"
        )
    checkpoint = load_checkpoint(name)
    from mitsonar.estimation.height.height_network import HeightNetwork

    made = partial(HeightNetwork, checkpoint)
    return made(**options_from(name, words, made))
