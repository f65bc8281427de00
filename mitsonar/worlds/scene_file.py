"""The world ``scene``: a Mitsuba XML file of the user's own."""

from __future__ import annotations

import os
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mitsonar.errors import MitsonarError
from mitsonar.worlds.world import Family, World

__all__ = ["SceneFile"]


class SceneFile(Family):
    """A scene that exists already; the seed determines only the motion of the vehicle."""

    called: ClassVar[str] = "scene"
    described: ClassVar[str] = "docs/guides/data-sets.md, `A scene of your own`"

    file: str = Field(description="the XML file; in a recipe, relative to the recipe's folder")
    size_m: float = Field(gt=0, le=1e6, description="edge of the square around the origin to stay inside [m]")
    parameters: dict[str, str] = Field(default_factory=dict, description="values of the scene's $names")

    @property
    def half_m(self) -> float:
        """Return half the edge of the square to stay inside [m]."""
        return self.size_m / 2

    @property
    def seeded(self) -> bool:
        """Return False: the scene is the same for each seed."""
        return False

    def refuse_smaller(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Refuse a ``size_m`` whose square reaches beyond the file's shapes: frames there would be empty.

        Args:
            low: least x, y, z of the scene ``(3,)`` [m].
            high: largest ``(3,)`` [m].

        Raises:
            MitsonarError: the square is too large, or the scene has no shapes.
        """
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise MitsonarError(f"{self.file} holds nothing that a sonar could see: give a scene with shapes")
        fits = 2 * max(0.0, float(min(-low[0], -low[1], high[0], high[1])))
        if self.size_m > fits * (1 + 1e-3):
            raise MitsonarError(
                f"world.size_m, {self.size_m:g} m, is larger than what {self.file} holds, x {low[0]:.3g}..{high[0]:.3g} m "
                f"and y {low[1]:.3g}..{high[1]:.3g} m: frames taken beyond it would be empty; give at most {fits:.3g} (a "
                "square around the origin), or a larger ground"
            )

    def build(self, seed: int) -> World:
        """Refuse: the scene exists already.

        Raises:
            MitsonarError: always.
        """
        raise MitsonarError(f"{self.file} is a scene already: there is nothing to build")

    def prepare(self, seed: int, folder: Path) -> tuple[Path, dict[str, str]]:
        """Return the file and its parameters; nothing is written.

        Raises:
            MitsonarError: the file does not exist.
        """
        if not os.path.isfile(self.file):
            raise MitsonarError(f"no scene file {self.file}: world.file must name a Mitsuba XML file that is there")
        return Path(self.file), self.parameters
