"""Trained networks that come with mitsonar. Their names can be read without torch."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

__all__ = ["SHIPPED", "shipped_path"]

SHIPPED = ("corrnet", "corrnet-coherent", "impulse-posenet", "posenet", "posenet-noise", "profilenet-quadrants-coherent")
"""Their names. The recipe of the same name defines how each was trained."""


def shipped_path(name: str) -> Path:
    """Return the path of the checkpoint of that name."""
    return Path(str(files("mitsonar.networks"))) / "weights" / f"{name}.ckpt"
