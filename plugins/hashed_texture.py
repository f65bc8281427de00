"""Base class of the textures ``cell_noise`` and ``perlin``, whose values are hashes of the point on a surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.arrays import DeviceArray
from mitsonar.errors import MitsonarError

__all__ = ["ROUNDS", "HashedTexture", "number_of_property"]

ROUNDS = 8
"""Rounds of the hash (Tiny Encryption Algorithm); with Mitsuba's default of 4, neighbours have a correlation of 0.4."""


class HashedTexture(mi.Texture):
    """A sum of octaves over uv or world position. Subclasses define :meth:`octave`."""

    def __init__(self, props: mi.Properties, *, cells: float, cell_size: float, octaves: int = 1) -> None:
        super().__init__(props)
        self.coordinates = str(props.get("coordinates", "uv"))
        if self.coordinates not in ("uv", "position"):
            raise MitsonarError(f"{self.name} coordinates must be uv or position: got {self.coordinates!r}")
        self.cells = number_of_property(props, "cells", cells)
        self.cell_size = number_of_property(props, "cell_size", cell_size)
        self.octaves = int(cast(int, props.get("octaves", octaves)))
        self.seed = int(cast(int, props.get("seed", 0)))
        transform = cast(mi.ScalarTransform4f, props.get("to_uv", mi.ScalarTransform4f()))
        to_uv: NDArray[np.float64] = np.array(transform.matrix, dtype=float)
        self.to_uv = to_uv[:2][:, [0, 1, 3]]
        if not (self.cells > 0 and self.cell_size > 0 and 1 <= self.octaves <= 24):
            raise MitsonarError(
                f"{self.name} needs cells > 0, cell_size > 0 and octaves 1..24: got cells {self.cells:g}, cell_size "
                f"{self.cell_size:g} m, octaves {self.octaves}"
            )

    LEVELS: Mapping[str, str] = MappingProxyType({})
    """Attributes by their name in ``mi.traverse``: Dr.Jit numbers that scale the values, with derivatives if any."""

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the levels to ``mi.traverse``."""
        for name, attribute in self.LEVELS.items():
            callback.put(name, getattr(self, attribute), mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check the levels after a change.

        Raises:
            MitsonarError: a level is outside its limits.
        """
        self.check(*(float(dr.detach(getattr(self, name))[0]) for name in self.LEVELS.values()))

    def check(self, *levels: float) -> None:
        """Check the values of :attr:`LEVELS`; subclasses override this.

        Raises:
            MitsonarError: a level is outside its limits.
        """

    @property
    def name(self) -> str:
        """Return the name of the class, for messages."""
        return type(self).__name__

    def octave(self, point: DeviceArray, seed: int) -> DeviceArray:
        """Return the values of one octave.

        Args:
            point: Dr.Jit points with 2 or 3 coordinates, in units of cells.
            seed: seed of this octave, 0..2^32 - 1.
        """
        raise NotImplementedError

    def finish(self, value: DeviceArray) -> DeviceArray:
        """Map the mean of the octaves to the value of the texture; subclasses may override this."""
        return value

    def hash(self, point: DeviceArray, seed: int) -> tuple[DeviceArray, DeviceArray]:
        """Return 64 random bits, as two ``UInt32``, for a lattice point and a seed (0..2^32 - 1)."""
        whole: list[DeviceArray] = [dr.reinterpret_array(mi.UInt32, mi.Int32(axis)) for axis in point]
        key: DeviceArray = mi.UInt32(seed)
        if len(whole) == 3:
            key = mi.sample_tea_32(whole[2], key, ROUNDS)[0]
        first, second = mi.sample_tea_32(whole[0], whole[1] ^ key, ROUNDS)
        return first, second

    def value(self, si: mi.SurfaceInteraction3f) -> DeviceArray:
        """Return the mean of the octaves, each with half the weight of the previous one."""
        on_surface = self.coordinates == "uv"
        point = self._transformed(si.uv) * self.cells if on_surface else si.p / self.cell_size
        total: DeviceArray = mi.Float(0)
        weight = 0.0
        for octave in range(self.octaves):
            total += 0.5**octave * self.octave(point * 2**octave, _scramble(self.seed, octave))
            weight += 0.5**octave
        return self.finish(total / weight)

    def _transformed(self, uv: mi.Point2f) -> mi.Point2f:
        """Apply ``to_uv``."""
        return mi.Point2f(*(float(u) * uv.x + float(v) * uv.y + float(one) for u, v, one in self.to_uv))

    def eval(self, si: mi.SurfaceInteraction3f, active: DeviceArray = True) -> mi.UnpolarizedSpectrum:
        """Return :meth:`value` as a spectrum; 0 for inactive lanes."""
        return mi.UnpolarizedSpectrum(dr.select(active, self.value(si), 0))

    def eval_1(self, si: mi.SurfaceInteraction3f, active: DeviceArray = True) -> DeviceArray:
        """Return :meth:`value`; 0 for inactive lanes."""
        return dr.select(active, self.value(si), 0)

    def eval_3(self, si: mi.SurfaceInteraction3f, active: DeviceArray = True) -> mi.Color3f:
        """Return :meth:`value` as a grey colour; 0 for inactive lanes."""
        return mi.Color3f(self.eval_1(si, active))

    def is_spatially_varying(self) -> bool:
        """Return True, so that Mitsuba does not treat the texture as constant."""
        return True

    def to_string(self) -> str:
        """Return one line for Mitsuba's logs."""
        return f"{self.name}[coordinates = {self.coordinates}, octaves = {self.octaves}, seed = {self.seed}]"


def number_of_property(props: mi.Properties, name: str, default: float) -> float:
    """Return a numeric property of a plugin."""
    return float(cast(float, props.get(name, default)))


def _scramble(seed: int, octave: int) -> int:
    """Hash seed and octave to 32 bits (the finaliser of SplitMix64)."""
    value = (seed * 64 + octave + 1) * 0x9E3779B97F4A7C15 % 2**64
    value = (value ^ (value >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    value = (value ^ (value >> 27)) * 0x94D049BB133111EB % 2**64
    return (value ^ (value >> 31)) >> 32
