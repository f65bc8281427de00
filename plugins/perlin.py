"""The texture ``perlin``."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mitsonar.errors import MitsonarError
from mitsonar.plugins.hashed_texture import HashedTexture

__all__ = ["Perlin"]


class Perlin(HashedTexture):
    """Perlin's gradient noise (Perlin, Improving Noise, 2002) in two dimensions (uv) or three (position).

    Properties: ``coordinates`` [uv]: uv or position; ``cells`` [64]: lattice cells a unit of uv; ``cell_size`` [m, 0.5]:
    edge of a lattice cell for position; ``octaves`` [4]: each with half the cell and half the weight of the one before;
    ``low`` [0], ``high`` [1]: reflectivity that the noise's -1..1 stands for, after ``contrast`` [1.5] times it, clipped;
    ``seed`` [0]; ``to_uv``: transform of uv.

    It does not repeat, but for the 2^32 lattice points of its hash.

    .. code-block:: xml

        <texture type="perlin" name="reflectance">
            <string name="coordinates" value="position"/>
            <float name="cell_size" value="0.3"/>
        </texture>
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props, cells=64.0, cell_size=0.5, octaves=4)
        self.low, self.high = float(props.get("low", 0.0)), float(props.get("high", 1.0))
        self.contrast = float(props.get("contrast", 1.5))
        if not 0 <= self.low <= self.high <= 1 or not self.contrast > 0:
            raise MitsonarError(
                f"perlin needs 0 <= low <= high <= 1 and contrast > 0: got low {self.low:g}, high {self.high:g}, "
                f"contrast {self.contrast:g}"
            )

    def octave(self, place: Any, seed: int) -> mi.Float:
        """Reflectivity before the octaves are averaged; ``place`` in lattice cells."""
        corner = dr.floor(place)
        inside = place - corner
        ease = inside * inside * inside * (inside * (inside * 6 - 15) + 10)
        value = self._blend(corner, inside, ease, seed, ())
        value = (value * self.contrast + 1) / 2
        return self.low + (self.high - self.low) * value

    def finish(self, value: mi.Float) -> mi.Float:
        """Into low..high, which the sum of octaves seldom leaves."""
        return dr.select(value > self.low, dr.select(value < self.high, value, self.high), self.low)

    def _blend(self, corner: Any, inside: Any, ease: Any, seed: int, chosen: tuple[int, ...]) -> mi.Float:
        """Interpolates, dimension by dimension, the ramps of the lattice points around."""
        if len(chosen) == len(corner):
            return self._ramp(corner, inside, seed, chosen)
        low = self._blend(corner, inside, ease, seed, (*chosen, 0))
        high = self._blend(corner, inside, ease, seed, (*chosen, 1))
        return dr.lerp(low, high, ease[len(chosen)])

    def _ramp(self, corner: Any, inside: Any, seed: int, chosen: tuple[int, ...]) -> mi.Float:
        """The linear ramp of one lattice point: its random unit gradient times the way from it."""
        offset = type(corner)(*chosen)
        first, second = self.hash(corner + offset, seed)
        way = inside - offset
        sin, cos = dr.sincos(mi.Float(first >> 8) * (2.0**-24 * 2 * dr.pi))
        if len(chosen) == 2:
            # scaled so that the largest value, half a cell from four points, is 1
            return (cos * way[0] + sin * way[1]) * dr.sqrt(2.0)
        up = mi.Float(second >> 8) * 2.0**-23 - 1
        across = dr.sqrt(dr.select(up * up < 1, 1 - up * up, 0))
        return (cos * across * way[0] + sin * across * way[1] + up * way[2]) * (2 / dr.sqrt(3.0))

    def mean(self) -> mi.Float:
        return mi.Float((self.low + self.high) / 2)


mi.register_texture("perlin", Perlin)
