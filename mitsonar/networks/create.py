"""How a network is created by its name, and which options it takes."""

from __future__ import annotations

import inspect
from typing import Any, TypeAlias

from torch import Tensor, nn

from mitsonar.datasets.modality import Fields
from mitsonar.datasets.samples import Inputs
from mitsonar.errors import MitsonarError, short_repr, suggest_names
from mitsonar.networks.corrnet import CorrNet
from mitsonar.networks.profilenet import ProfileNet
from mitsonar.networks.thesis import Cnn1b, Cnn4b, Cnn4PoseNet, ImpulsePoseNet, PoseNet, PoseNetDual, PoseNetVec, SfMNet

__all__ = ["NETWORKS", "called", "create_network", "options_for", "options_of"]

Output: TypeAlias = Any
"""Output of a network: labels ``(batch, outputs)``, or a :class:`~mitsonar.networks.corrnet.GaussianHead`."""

NETWORKS: dict[str, Any] = {
    "posenet": PoseNet,
    "sfmnet": SfMNet,
    "cnn1b": Cnn1b,
    "cnn4b": Cnn4b,
    "cnn4posenet": Cnn4PoseNet,
    "posenet_dual": PoseNetDual,
    "corrnet": CorrNet,
    "impulse_posenet": ImpulsePoseNet,
    "posenetvec": PoseNetVec,
    "profilenet": ProfileNet,
}
"""Network classes, keyed by name. Each has ``needs``, ``any_sonar`` and ``has_covariance``; see
:class:`~mitsonar.networks.blocks.Network`."""


def create_network(name: str, **options: object) -> nn.Module:
    """Create a network by name, with initial weights from torch's random generator.

    Args:
        name: key of :data:`NETWORKS`.
        options: of that network; see its class. Those of Almanza-Medina's networks are outputs, width, dropout, size and, if
            frames may be channels, channels.

    Raises:
        MitsonarError: the name or an option is unknown, or a value is out of range.
    """
    known = options_of(name)
    for option in options:
        if option not in known:
            raise MitsonarError(f"unknown option {short_repr(option)} of {name}: {suggest_names(option, known)}")
    network: nn.Module = NETWORKS[name](**options)
    return network


def called(network: nn.Module, inputs: Inputs) -> Output:
    """Call a network, passing the inputs of a tuple as separate arguments."""
    return network(*inputs) if isinstance(inputs, tuple) else network(inputs)


def options_of(name: str) -> list[str]:
    """List the options of a network.

    Raises:
        MitsonarError: unknown name.
    """
    if name not in NETWORKS:
        raise MitsonarError(f"unknown network {short_repr(name)}: {suggest_names(str(name), NETWORKS)}")
    return list(inspect.signature(NETWORKS[name]).parameters)


def options_for(name: str, inputs: Inputs, labels: Tensor, receivers: int = 1) -> Fields:
    """Derive the network options that the samples determine: number of labels, sizes and channels of the input.

    Args:
        name: key of :data:`NETWORKS`.
        inputs: of a batch from :class:`~mitsonar.datasets.samples.SonarPairs`: one tensor or a tuple.
        labels: of the batch ``(batch, outputs)``.
        receivers: number of receivers whose impulse responses the input holds.

    Raises:
        MitsonarError: unknown name.
    """
    first, *others = inputs if isinstance(inputs, tuple) else (inputs,)
    settled: Fields = {"outputs": labels.shape[-1], "size": list(first.shape[-2:]), "channels": first.shape[-3]}
    settled["receivers"] = receivers
    if others and isinstance(others[0], Tensor):
        settled["cartesian_size"] = list(others[0].shape[-2:])
    known = options_of(name)
    return {option: value for option, value in settled.items() if option in known}
