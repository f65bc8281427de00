"""Networks that estimate motion: plain torch modules, by name. ``mitsonar.networks.create_network("posenet")``."""

from __future__ import annotations

from typing import Any, TypeAlias

__all__ = ["create_network"]

AnyNetwork: TypeAlias = Any
"""A module of one of the classes of :mod:`mitsonar.networks.create`, whose attributes differ."""


def create_network(name: str, **options: object) -> AnyNetwork:
    """Create a network by name; see :func:`mitsonar.networks.create.create_network`."""
    from mitsonar.networks.create import create_network as create  # torch is loaded only here

    return create(name, **options)
