"""Surfaces that send on more than arrives: harmless in one reflection, too loud in several."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np

from mitsonar.plugins.surfaces import Surfaces

__all__ = ["bright_notes"]


def bright_notes(scene: mi.Scene, surfaces: Surfaces) -> list[str]:
    """Return a sentence where meshes without a material have a Lambert's mu above 1 / pi.

    Args:
        scene: any.
        surfaces: its tables.
    """
    rows = np.array(surfaces.facets).reshape(-1, 4)[:, 3]
    found, largest = [], 1 / math.pi + 1e-3
    for first, _, number, material in np.array(surfaces.shapes).reshape(-1, 4):
        if first < 0 or number < 0 or material >= 0:
            continue
        shape = scene.shapes()[number]
        assert isinstance(shape, mi.Mesh)
        if (rows[first : first + shape.face_count()] > largest).any():
            found.append(shape.id() or f"shape number {number}")  # Mitsuba merges meshes into one without a name
    if not found:
        return []
    names = ", ".join(sorted(found)[:3]) + (" ..." if len(found) > 3 else "")
    return [
        f"reflectivities above 1/pi = 0.318 send on more than arrives: paths of several reflections by way of {names} are "
        "too loud; give a reflectance of 0.318 at most, or a material"
    ]
