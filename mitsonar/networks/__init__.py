"""Networks that estimate motion: plain torch modules, by name. ``mitsonar.networks.create_network("posenet")``."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import nn

__all__ = ["create_network"]


def create_network(name: str, **options: object) -> nn.Module:
    """Create a network by name; see :func:`mitsonar.networks.create.create_network`."""
    from mitsonar.networks.create import create_network as create  # torch is loaded only here

    return create(name, **options)
