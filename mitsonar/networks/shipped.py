"""Trained networks that come with mitsonar; torch is not needed to know their names."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

__all__ = ["SHIPPED", "shipped_path"]

SHIPPED = ("corrnet",)
"""Their names; the recipe of the same name says how each was trained."""


def shipped_path(name: str) -> Path:
    """The checkpoint of that name."""
    return Path(str(files("mitsonar.networks"))) / "weights" / f"{name}.ckpt"
