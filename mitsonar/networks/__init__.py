"""Networks that estimate motion: plain torch modules, by name. ``mitsonar.networks.create_network("posenet")``."""

from __future__ import annotations

from typing import Any

__all__ = ["create_network"]


def create_network(name: str, **options: Any) -> Any:
    """The network of that name; see :func:`mitsonar.networks.create.create_network`."""
    from mitsonar.networks.create import create_network as create  # torch is loaded when it is needed

    return create(name, **options)
