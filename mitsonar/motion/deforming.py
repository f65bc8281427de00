"""Bodies whose shape changes while they move: a path, and where the vertices of the mesh are at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.motion.trajectory import Trajectory

__all__ = ["Deforming", "MeshSequence", "VertexLaw"]

VertexLaw: TypeAlias = Callable[[float], NDArray[Any]]
"""Vertices ``(vertices, 3)`` [m] in the body's own axes at a time [s], in the order of the shape's mesh."""


@dataclass(frozen=True)
class Deforming:
    """A body that moves along a path and changes its shape.

    Attributes:
        path: of the body; a single pose: it stays there.
        vertices: of its mesh at a time.
    """

    path: Trajectory
    vertices: VertexLaw

    def __repr__(self) -> str:
        law = self.vertices
        shown = (
            f"{len(law.vertices)} meshes" if isinstance(law, MeshSequence) else getattr(law, "__name__", type(law).__name__)
        )
        return f"Deforming({shown} along {self.path})"


@dataclass(frozen=True)
class MeshSequence:
    """Vertices of meshes that follow one another; between two they move on straight lines.

    Attributes:
        vertices: ``(meshes, vertices, 3)`` [m].
        rate_hz: meshes a second; the first is at time 0.
        loop: after the last mesh comes the first; else the last one stays.
    """

    vertices: NDArray[np.float32]
    rate_hz: float
    loop: bool = True

    def __post_init__(self) -> None:
        if self.vertices.ndim != 3 or self.vertices.shape[2] != 3 or not len(self.vertices):
            raise MitsonarError(f"meshes are vertices (meshes, vertices, 3): got {self.vertices.shape}")
        if not 0 < self.rate_hz < np.inf:
            raise MitsonarError(f"the rate of meshes must be positive: got {self.rate_hz:g}; give meshes a second")

    def __call__(self, time_s: float) -> NDArray[np.float32]:
        """Return the vertices ``(vertices, 3)`` at a time [s]; before time 0 the first mesh holds, or the loop."""
        count = len(self.vertices)
        place = time_s * self.rate_hz
        place = place % count if self.loop else min(max(place, 0.0), count - 1.0)
        first = int(place)
        part = np.float32(place - first)
        after = self.vertices[(first + 1) % count if self.loop else min(first + 1, count - 1)]
        return np.asarray(self.vertices[first % count] * (1 - part) + after * part, dtype=np.float32)
