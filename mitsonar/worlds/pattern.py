"""The world ``pattern``: blocks that form a T and pairs of parallel bars, on one of six seabeds."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from mitsonar.worlds.shapes import place, slab
from mitsonar.worlds.world import BuiltFamily, Floor, Mesh, Standpoint, World

__all__ = ["Pattern"]

PHOTO_M = 2.0
"""Edge of the seabed in a shipped picture [m]; the picture is repeated."""

T = np.array([(-1, 0.5), (0, 0.5), (1, 0.5), (0, -0.5)])
"""Centres of the blocks, in steps: three across, one below the middle."""


class Pattern(BuiltFamily):
    """The test field of Almanza-Medina, 2.3.

    The seed draws the three random seabeds. The other three are pictures: generated stand-ins for Almanza-Medina's
    photographs, see the README beside them.
    """

    called: ClassVar[str] = "pattern"

    size_m: float = Field(12.0, gt=0, le=10_000, description="edge of the square seabed [m] (ours)")
    texture: Literal["gaussian", "perlin_high", "perlin_low", "photo_sand", "photo_gravel", "photo_rock"] = Field(
        "gaussian", description="seabed: Gaussian cells, Perlin of high or low correlation, or a picture"
    )
    block_m: tuple[float, float, float] = Field((0.5, 0.5, 0.025), description="a block's width, length, height [m]")
    block_step_m: float = Field(0.6, gt=0, description="from one block's middle to the next [m] (ours)")
    bar_width_m: float = Field(0.05, gt=0, description="width of a bar [m] (ours)")
    bar_height_m: float = Field(0.025, gt=0, description="height of a bar [m] (ours)")
    bar_step_m: float = Field(0.2, gt=0, description="between the middles of the two bars of a pair [m] (ours)")
    bars_across_m: tuple[float, float] = Field((3.6, 1.1), description="fore and aft pairs: length, and y of the inner [m]")
    bars_along_m: tuple[float, float] = Field((1.8, 2.1), description="side pairs: length, and x of the inner bar [m]")
    object_reflectivity: float = Field(0.6, ge=0, le=1, description="reflectivity of blocks and bars (ours)")

    @property
    def half_m(self) -> float:
        """Return half the edge of the seabed [m]."""
        return self.size_m / 2

    @property
    def seeded(self) -> bool:
        """Return whether the seabed is random."""
        return not self.texture.startswith("photo")

    def build(self, seed: int) -> World:
        """Build the field with the seabed of a seed."""
        blocks = np.column_stack([T * self.block_step_m, np.full(len(T), self.block_m[2] / 2)])
        meshes = [self._boxes("blocks", 1, np.tile(self.block_m, (len(T), 1)), blocks)]
        meshes.append(self._boxes("bars", 1 + len(T), *self._bars()))
        return World(
            about=f"pattern, seabed {self.texture}, seed {seed}",
            meshes=meshes,
            stand=Standpoint((-2.5, -4.85, 2.5), (-2.5, -4.85 + 2.5 / np.tan(np.radians(35)), 0)),
            floor=Floor(self.half_m, self._seabed(seed)),
            surface=self.surface,
            pictures=self._pictures(),
        )

    def _boxes(self, name: str, first_id: int, size: ArrayLike, centre: NDArray[np.float64]) -> Mesh:
        placed = place(slab(), size, Rotation.identity(len(centre)), centre)
        reflectivity = np.full(len(placed.faces), self.object_reflectivity)
        return Mesh(name, placed.vertices, placed.faces, reflectivity, first_id + placed.number)

    def _bars(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return sizes and centres of the eight bars [m]: fore, aft, port, starboard, the inner first."""
        sizes, centres = [], []
        for axis, (length, inner) in ((1, self.bars_across_m), (0, self.bars_along_m)):
            for sign in (1, -1):
                for step in (0, 1):
                    size = np.array([self.bar_width_m, self.bar_width_m, self.bar_height_m])
                    size[1 - axis] = length
                    centre = np.array([0, 0, self.bar_height_m / 2])
                    centre[axis] = sign * (inner + step * self.bar_step_m)
                    sizes.append(size)
                    centres.append(centre)
        return np.array(sizes), np.array(centres)

    def _seabed(self, seed: int) -> str:
        """Return the floor's texture; random ones have the grain of the shipped scene ``pattern`` at any size."""
        a_metre = self.size_m / 12
        if self.texture == "gaussian":
            numbers = {"cells": 800 * a_metre, "mean": 0.45, "std": 0.2}
            return _texture("cell_noise", numbers, seed, '<string name="distribution" value="gaussian"/>')
        if self.texture.startswith("perlin"):
            cells, octaves = (16, 2) if self.texture == "perlin_high" else (100, 3)
            return _texture(
                "perlin", {"cells": cells * a_metre, "high": 0.9}, seed, f'<integer name="octaves" value="{octaves}"/>'
            )
        return f"""<texture type="bitmap" name="reflectance">
                <string name="filename" value="textures/{self.texture}.png"/>
                <boolean name="raw" value="true"/>
                <transform name="to_uv"><scale value="{self.size_m / PHOTO_M!r}"/></transform>
            </texture>"""

    def _pictures(self) -> dict[str, Path]:
        name = f"textures/{self.texture}.png"
        return {name: Path(str(files("mitsonar.scenes"))) / name} if self.texture.startswith("photo") else {}


def _texture(kind: str, numbers: dict[str, float], seed: int, more: str) -> str:
    lines = "".join(f'<float name="{name}" value="{value!r}"/>' for name, value in numbers.items())
    return f"""<texture type="{kind}" name="reflectance">
                {lines}{more}<integer name="seed" value="{seed}"/>
            </texture>"""
