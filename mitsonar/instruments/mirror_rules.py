"""Which instruments hear mirrors and several reflections: refusals that recipes, commands and simulators share."""

from __future__ import annotations

from collections.abc import Sequence

from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import View, Whole

__all__ = ["check_channel_mirrors", "check_image_mirrors"]


def check_image_mirrors(sonar: Sonar, views: Sequence[View] | None, mirrors: bool) -> None:
    """Refuse mirrors and several reflections that an imaging sonar does not hear.

    Args:
        sonar: the instrument.
        views: of its images; None: the whole.
        mirrors: whether shapes are to reflect as mirrors.

    Raises:
        MitsonarError: mirrors in a model without them; several reflections at receivers elsewhere or in portions.
    """
    if mirrors and sonar.model != "coherent" and sonar.bounces == 1:
        raise MitsonarError(
            f"the model {sonar.model} has no mirrors: give the sonar model coherent"
            + (", or bounces 2" if sonar.model == "physical" else "")
        )
    if sonar.bounces > 1 and any(not isinstance(view, Whole) for view in views or ()):
        raise MitsonarError(
            "receivers elsewhere and portions hear one reflection: leave bounces out, or render the whole view"
        )


def check_channel_mirrors(sonar: ChannelSonar, mirrors: bool, lacking: str) -> None:
    """Refuse several bounces without mirrors, and mirrors in the model ``rays``.

    Args:
        sonar: the instrument.
        mirrors: whether any shape reflects as a mirror.
        lacking: how to name mirrors where the instrument needs them.

    Raises:
        MitsonarError: they do not fit.
    """
    if sonar.bounces > 1 and not mirrors:
        raise MitsonarError(f"bounces {sonar.bounces} need mirrors, and the scene has none: {lacking}")
    if mirrors and sonar.model == "rays":
        raise MitsonarError("mirrors are of the model scatterers: got the model rays; leave them out, or choose scatterers")
