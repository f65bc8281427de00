"""The texture ``perlin``: smooth gradient noise."""

from __future__ import annotations

from types import MappingProxyType

import drjit as dr
import mitsuba as mi

from mitsonar.arrays import DeviceArray
from mitsonar.errors import MitsonarError
from mitsonar.plugins.hashed_texture import HashedTexture, number_of_property

__all__ = ["Perlin"]


class Perlin(HashedTexture):
    """Perlin's gradient noise (Perlin, Improving Noise, 2002) in two dimensions (uv) or three (position).

    Properties: ``coordinates`` [uv]: uv or position; ``cells`` [64]: lattice cells per unit of uv; ``cell_size`` [m, 0.5]:
    edge of a lattice cell for position; ``octaves`` [4]: number of octaves, each with half the cell size and half the weight
    of the previous one; ``low`` [0], ``high`` [1]: reflectivity at noise -1 and 1, clipped; ``contrast`` [1.5]: factor
    applied to the noise before that; ``seed`` [0]; ``to_uv``: transform of uv.

    It repeats only after the 2^32 lattice points of its hash. ``mi.traverse`` shows ``low``, ``high`` and ``contrast``, with
    derivatives.

    .. code-block:: xml

        <texture type="perlin" name="reflectance">
            <string name="coordinates" value="position"/>
            <float name="cell_size" value="0.3"/>
        </texture>
    """

    LEVELS = MappingProxyType({name: name for name in ("low", "high", "contrast")})

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props, cells=64.0, cell_size=0.5, octaves=4)
        defaults = {"low": 0.0, "high": 1.0, "contrast": 1.5}
        levels = [number_of_property(props, name, default) for name, default in defaults.items()]
        self.check(*levels)
        self.low, self.high, self.contrast = map(mi.Float, levels)

    def check(self, *levels: float) -> None:
        """Check low, high and contrast.

        Raises:
            MitsonarError: a level is outside its limits.
        """
        low, high, contrast = levels
        if not 0 <= low <= high <= 1 or not contrast > 0:
            raise MitsonarError(
                f"perlin needs 0 <= low <= high <= 1 and contrast > 0: got low {low:g}, high {high:g}, contrast {contrast:g}"
            )

    def octave(self, point: DeviceArray, seed: int) -> DeviceArray:
        """Return the reflectivity of one octave at ``point``, in units of lattice cells."""
        corner = dr.floor(point)
        inside = point - corner
        ease = inside * inside * inside * (inside * (inside * 6 - 15) + 10)
        value = self._blend(corner, inside, ease, seed, ())
        value = (value * self.contrast + 1) / 2
        return self.low + (self.high - self.low) * value

    def finish(self, value: DeviceArray) -> DeviceArray:
        """Clip to low..high, which the mean of the octaves rarely exceeds."""
        return dr.select(value > self.low, dr.select(value < self.high, value, self.high), self.low)

    def _blend(
        self, corner: DeviceArray, inside: DeviceArray, ease: DeviceArray, seed: int, chosen: tuple[int, ...]
    ) -> DeviceArray:
        """Interpolate the ramps of the surrounding lattice points, one dimension after the other."""
        if len(chosen) == len(corner):
            return self._ramp(corner, inside, seed, chosen)
        low = self._blend(corner, inside, ease, seed, (*chosen, 0))
        high = self._blend(corner, inside, ease, seed, (*chosen, 1))
        return dr.lerp(low, high, ease[len(chosen)])

    def _ramp(self, corner: DeviceArray, inside: DeviceArray, seed: int, chosen: tuple[int, ...]) -> DeviceArray:
        """Return the linear ramp of a lattice point: its random unit gradient times the offset from it."""
        offset = type(corner)(*chosen)
        first, second = self.hash(corner + offset, seed)
        way = inside - offset
        sin, cos = dr.sincos(mi.Float(first >> 8) * (2.0**-24 * 2 * dr.pi))
        if len(chosen) == 2:
            # scaled so that the maximum, at the centre of four points, is 1
            return (cos * way[0] + sin * way[1]) * dr.sqrt(2.0)
        up = mi.Float(second >> 8) * 2.0**-23 - 1
        across = dr.sqrt(dr.select(up * up < 1, 1 - up * up, 0))
        return (cos * across * way[0] + sin * across * way[1] + up * way[2]) * (2 / dr.sqrt(3.0))

    def mean(self) -> DeviceArray:
        """Return the middle of low..high, which Mitsuba uses for importance sampling."""
        return mi.Float((self.low + self.high) / 2)


mi.register_texture("perlin", Perlin)
