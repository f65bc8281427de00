"""The world ``sea-surface``: waves of a wind over a flat seabed of random cells, or a flat surface."""

from __future__ import annotations

import math
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from mitsonar.errors import MitsonarError
from mitsonar.io.files import write_whole
from mitsonar.worlds.shapes import GRID_M
from mitsonar.worlds.wave_field import SHORTEST, Sea, wave_heights
from mitsonar.worlds.wave_spectrum import WaveSpectrum, jonswap, pierson_moskowitz
from mitsonar.worlds.world import Family, Floor, Interval, Mesh, Standpoint, World

__all__ = ["SeaState", "SeaSurface"]

MOST_TRIANGLES = 2_000_000
"""Triangles of a surface, at most: those of a mirror in impulse responses."""

FEWEST_STEPS = 8
"""Steps along the edge, at least."""

MATERIAL = "surface.yaml"
"""File of the surface's material, beside the scene."""


class SeaState(NamedTuple):
    """What a surface holds, and what it leaves to the loss of its mirror part.

    Attributes:
        significant_height_m: four times the rms height of all waves of the spectrum [m].
        peak_wavelength_m: length of the waves at the peak of the spectrum [m]; infinite where there are none.
        shortest_m: length of the shortest waves of the mesh [m].
        rms_m: rms height of the waves of the mesh [m].
        roughness_m: rms height of the shorter waves, which the mesh does not hold [m].
    """

    significant_height_m: float
    peak_wavelength_m: float
    shortest_m: float
    rms_m: float
    roughness_m: float


class SeaSurface(Family):
    """A sea surface over a flat seabed: wind waves of Pierson and Moskowitz's or JONSWAP's spectrum, or flat without wind.

    Waves of four steps and more are the mesh. The rms height of shorter ones is the roughness of the mirror part. The
    surface is the shape `surface`; it faces down and reflects -1. Surfaces of one seed at several times belong to one sea.
    """

    called: ClassVar[str] = "sea-surface"

    wind_m_s: float = Field(5.0, ge=0, le=40, description="wind 10 m above the sea [m/s]; 0: a flat surface")
    spectrum: Literal["pierson-moskowitz", "jonswap"] = Field(
        "pierson-moskowitz", description="pierson-moskowitz (fully developed) or jonswap (limited by the fetch)"
    )
    fetch_km: float = Field(20.0, gt=0, le=10_000, description="way over which the wind blows, of jonswap [km]")
    towards_deg: float = Field(0.0, ge=-360, le=360, description="where the wind blows to: 0 is +y, 90 is +x [deg]")
    spreading: float = Field(2.0, ge=0, le=100, description="s of cos^2s of half the angle off the wind; 0: all directions")
    size_m: float = Field(40.0, gt=0, le=10_000, description="edge of the square surface, and of the seabed [m]")
    step_m: float = Field(0.25, gt=0, le=25, description="edge of the mesh's squares [m]")
    time_s: float = Field(0.0, ge=-1e6, le=1e6, description="time of the surface [s]")
    water_m: float = Field(
        10.0, gt=0, le=12_000, description="depth: the seabed is at z = 0, the mean surface at this height [m]"
    )
    seabed_cells: int = Field(512, ge=0, le=2**20, description="cells along the seabed's edge; 0: no seabed")
    seabed_reflectivity: Interval = Field((0.0, 0.2), description="uniform reflectivity of a cell")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.wind_m_s == 0:
            return self
        steps = self.size_m / self.step_m
        if steps < FEWEST_STEPS:
            raise ValueError(
                f"size_m must be at least {FEWEST_STEPS} step_m, {FEWEST_STEPS * self.step_m:g} m: got {self.size_m:g} m"
            )
        if 2 * round(steps) ** 2 > MOST_TRIANGLES:
            least = self.size_m / math.isqrt(MOST_TRIANGLES // 2)
            raise ValueError(
                f"a surface has at most {MOST_TRIANGLES:,} triangles, and {self.size_m:g} m in steps of {self.step_m:g} m "
                f"would have {2 * round(steps) ** 2:,}: give a step_m of at least {least:.2g} m, or a smaller size_m"
            )
        try:
            peak = self.waves.peak_wavelength_m
        except MitsonarError as error:
            raise ValueError(str(error)) from None
        if SHORTEST * self.step_m > peak:
            raise ValueError(
                f"step_m must be at most a quarter of the peak's wavelength, {peak / SHORTEST:.2g} m at a wind of "
                f"{self.wind_m_s:g} m/s, or the mesh misses them: got {self.step_m:g} m"
            )
        return self

    @property
    def half_m(self) -> float:
        """Return half the edge of the surface [m]."""
        return self.size_m / 2

    @property
    def seeded(self) -> bool:
        """Return whether waves or seabed are random."""
        return self.wind_m_s > 0 or self.seabed_cells > 0

    @property
    def waves(self) -> WaveSpectrum:
        """Return the spectrum of the waves; there is none without wind.

        Raises:
            MitsonarError: a fetch that does not fit the wind.
        """
        if self.spectrum == "jonswap":
            return jonswap(self.wind_m_s, 1000 * self.fetch_km, self.water_m)
        return pierson_moskowitz(self.wind_m_s, self.water_m)

    @property
    def state(self) -> SeaState:
        """Return heights of the waves, those of the mesh and those that it does not hold."""
        shortest = SHORTEST * self.step_m
        if self.wind_m_s == 0:
            return SeaState(0.0, math.inf, shortest, 0.0, 0.0)
        held, left = self.waves.variance(shortest), self.waves.variance(0.0, shortest)
        height, peak = self.waves.significant_height_m, self.waves.peak_wavelength_m
        return SeaState(height, peak, shortest, math.sqrt(held), math.sqrt(left))

    def save(self, path: str | Path, seed: int = 0, time_s: float | None = None) -> None:
        """Write the surface of a seed as a PLY file, for a scene of one's own.

        Args:
            path: of the file; one that is there is replaced.
            seed: of the waves.
            time_s: its time [s]; default: that of the family.
        """
        write_whole(path, self.surface(seed, time_s).ply())

    def surface(self, seed: int, time_s: float | None = None) -> Mesh:
        """Build the surface of a seed.

        Args:
            seed: of the waves.
            time_s: its time [s]; default: that of the family.
        """
        cells = 1 if self.wind_m_s == 0 else round(self.size_m / self.step_m)
        place = np.linspace(-self.half_m, self.half_m, cells + 1)
        heights = np.zeros((cells + 1, cells + 1))
        if self.wind_m_s > 0:
            sea = Sea(self.waves, math.radians(self.towards_deg), self.spreading)
            time = self.time_s if time_s is None else time_s
            heights = wave_heights(sea, cells + 1, self.size_m / cells, seed, time)
        x, y = np.meshgrid(place, place)
        vertices = np.stack([x, y, self.water_m + heights], axis=-1).reshape(-1, 3)
        number = np.arange((cells + 1) ** 2).reshape(cells + 1, -1)
        a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
        faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([a, d, c], axis=1)])  # facing down
        return Mesh("surface", np.rint(vertices / GRID_M) * GRID_M, faces, material=MATERIAL)

    def material(self) -> str:
        """Return the YAML of the surface's material: it reflects -1, and what its short waves take is scattered evenly."""
        return (
            "name: sea surface\n"
            "law: lambert\n"
            "mu: 0.31830\n"
            "reflection: -1.0\n"
            f"roughness_m: {self.state.roughness_m:.4g}\n"
            "source: >-\n"
            "  reflection: water against air. roughness_m: the waves that the mesh does not hold. mu (ours): what they\n"
            "  take from the mirror is scattered by Lambert's law, all of it.\n"
        )

    def build(self, seed: int) -> World:
        """Build surface and seabed of a seed."""
        state = self.state
        about = f"sea-surface, seed {seed}: flat"
        if self.wind_m_s > 0:
            about = (
                f"sea-surface, seed {seed}, {self.time_s:g} s: {self.spectrum}, wind {self.wind_m_s:g} m/s, significant "
                f"wave height {state.significant_height_m:.3g} m, peak at {state.peak_wavelength_m:.3g} m; in the mesh rms "
                f"{state.rms_m:.3g} m; waves below {state.shortest_m:g} m are its roughness, rms {state.roughness_m:.3g} m"
            )
        deep = min(2.0, self.water_m / 2)
        y = -self.half_m / 2
        return World(
            about=about,
            meshes=[self.surface(seed)],
            stand=Standpoint((0, y, self.water_m - deep), (0, y + 2 * deep, self.water_m), (1.5 * deep, 4 * deep)),
            floor=Floor(self.half_m, Floor.cells(self.seabed_cells, self.seabed_reflectivity, seed))
            if self.seabed_cells
            else None,
            content={MATERIAL: self.material().encode()},
        )
