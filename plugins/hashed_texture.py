"""What the textures ``cell_noise`` and ``perlin`` share: a value that is a hash of the place on a surface."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsonar.errors import MitsonarError

__all__ = ["ROUNDS", "HashedTexture"]

ROUNDS = 8
"""Rounds of the hash (Tiny Encryption Algorithm): with Mitsuba's default of 4, neighbours correlate by 0.4."""


class HashedTexture(mi.Texture):
    """A sum of octaves over uv or world position; a subclass gives :meth:`octave`."""

    def __init__(self, props: mi.Properties, *, cells: float, cell_size: float, octaves: int = 1) -> None:
        super().__init__(props)
        self.coordinates = str(props.get("coordinates", "uv"))
        if self.coordinates not in ("uv", "position"):
            raise MitsonarError(f"{self.name} coordinates must be uv or position: got {self.coordinates!r}")
        self.cells = float(props.get("cells", cells))
        self.cell_size = float(props.get("cell_size", cell_size))
        self.octaves = int(props.get("octaves", octaves))
        self.seed = int(props.get("seed", 0))
        to_uv = np.array(props.get("to_uv", mi.ScalarTransform4f()).matrix, dtype=float)
        self.to_uv = to_uv[:2][:, [0, 1, 3]]
        if not (self.cells > 0 and self.cell_size > 0 and 1 <= self.octaves <= 24):
            raise MitsonarError(
                f"{self.name} needs cells > 0, cell_size > 0 and octaves 1..24: got cells {self.cells:g}, cell_size "
                f"{self.cell_size:g} m, octaves {self.octaves}"
            )

    @property
    def name(self) -> str:
        """The class's name, for messages."""
        return type(self).__name__

    def octave(self, place: Any, seed: int) -> mi.Float:
        """The value at ``place``, in cells (2 or 3 coordinates)."""
        raise NotImplementedError

    def finish(self, value: mi.Float) -> mi.Float:
        """What is done to the sum of octaves."""
        return value

    def hash(self, place: Any, seed: int) -> tuple[mi.UInt32, mi.UInt32]:
        """64 random bits for a lattice point and a seed (0..2^32 - 1)."""
        whole = [dr.reinterpret_array(mi.UInt32, mi.Int32(axis)) for axis in place]
        key = mi.UInt32(seed)
        if len(whole) == 3:
            key = mi.sample_tea_32(whole[2], key, ROUNDS)[0]
        return mi.sample_tea_32(whole[0], whole[1] ^ key, ROUNDS)

    def value(self, si: mi.SurfaceInteraction3f) -> mi.Float:
        """The mean of the octaves, each with half the weight of the one before."""
        on_surface = self.coordinates == "uv"
        place = self._moved(si.uv) * self.cells if on_surface else si.p / self.cell_size
        total, weight = mi.Float(0), 0.0
        for octave in range(self.octaves):
            total += 0.5**octave * self.octave(place * 2**octave, _scramble(self.seed, octave))
            weight += 0.5**octave
        return self.finish(total / weight)

    def _moved(self, uv: mi.Point2f) -> mi.Point2f:
        """uv after ``to_uv``."""
        return mi.Point2f(*(float(u) * uv.x + float(v) * uv.y + float(one) for u, v, one in self.to_uv))

    def eval(self, si: mi.SurfaceInteraction3f, active: Any = True) -> Any:
        return mi.UnpolarizedSpectrum(dr.select(active, self.value(si), 0))

    def eval_1(self, si: mi.SurfaceInteraction3f, active: Any = True) -> Any:
        return dr.select(active, self.value(si), 0)

    def eval_3(self, si: mi.SurfaceInteraction3f, active: Any = True) -> Any:
        return mi.Color3f(self.eval_1(si, active))

    def is_spatially_varying(self) -> bool:
        return True

    def to_string(self) -> str:
        return f"{self.name}[coordinates = {self.coordinates}, octaves = {self.octaves}, seed = {self.seed}]"


def _scramble(seed: int, octave: int) -> int:
    """32 bits of seed and octave (the finaliser of SplitMix64)."""
    value = (seed * 64 + octave + 1) * 0x9E3779B97F4A7C15 % 2**64
    value = (value ^ (value >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    value = (value ^ (value >> 27)) * 0x94D049BB133111EB % 2**64
    return (value ^ (value >> 31)) >> 32
