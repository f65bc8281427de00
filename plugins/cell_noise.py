"""The texture ``cell_noise``: an independent random value in each cell of a grid."""

from __future__ import annotations

from types import MappingProxyType

import drjit as dr
import mitsuba as mi

from mitsonar.arrays import DeviceArray
from mitsonar.errors import MitsonarError
from mitsonar.plugins.hashed_texture import HashedTexture, number_of_property

__all__ = ["CellNoise"]


class CellNoise(HashedTexture):
    """Independent reflectivity in every cell of a grid, computed from a hash without a bitmap in memory at any resolution.

    Properties: ``coordinates`` [uv]: uv or position; ``cells`` [2048]: cells per unit of uv; ``cell_size`` [m, 0.015]: edge
    of a cubic cell for position; ``distribution`` [uniform]: uniform in ``low``..``high`` [0..1], or gaussian with ``mean``
    [0.5] and ``std`` [0.2], clipped to 0..1; ``octaves`` [1]: number of grids, each with half the cell size and half the
    weight of the previous one; ``seed`` [0]; ``to_uv``: transform of uv.

    It is not filtered: a ray reads the single cell that it hits. ``mi.traverse`` shows ``low``, ``high``, ``mean`` and
    ``std``, with derivatives.

    .. code-block:: xml

        <texture type="cell_noise" name="reflectance">
            <integer name="cells" value="2048"/>
            <integer name="seed" value="7"/>
        </texture>
    """

    LEVELS = MappingProxyType({"low": "low", "high": "high", "mean": "middle", "std": "std"})

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props, cells=2048.0, cell_size=0.015)
        self.distribution = str(props.get("distribution", "uniform"))
        if self.distribution not in ("uniform", "gaussian"):
            raise MitsonarError(f"cell_noise distribution must be uniform or gaussian: got {self.distribution!r}")
        defaults = {"low": 0.0, "high": 1.0, "mean": 0.5, "std": 0.2}
        levels = [number_of_property(props, name, default) for name, default in defaults.items()]
        self.check(*levels)
        self.low, self.high, self.middle, self.std = map(mi.Float, levels)

    def check(self, *levels: float) -> None:
        """Check low, high, mean and standard deviation.

        Raises:
            MitsonarError: a level is outside its limits.
        """
        low, high, mean, std = levels
        if not 0 <= low <= high <= 1 or not 0 <= mean <= 1 or not std >= 0:
            raise MitsonarError(
                f"cell_noise needs 0 <= low <= high <= 1, 0 <= mean <= 1, std >= 0: got low {low:g}, high {high:g}, "
                f"mean {mean:g}, std {std:g}"
            )

    def octave(self, point: DeviceArray, seed: int) -> DeviceArray:
        """Return the value of the cell that contains ``point``, in units of cells."""
        first, second = self.hash(dr.floor(point), seed)
        value: DeviceArray = (mi.Float(first >> 8) + 0.5) * 2.0**-24
        if self.distribution == "uniform":
            return self.low + value * (self.high - self.low)
        angle = (mi.Float(second >> 8) + 0.5) * (2.0**-24 * 2 * dr.pi)
        value = self.middle + self.std * dr.sqrt(-2 * dr.log(value)) * dr.cos(angle)
        return dr.select(value > 0, dr.select(value < 1, value, 1), 0)

    def mean(self) -> DeviceArray:
        """Return the mean of the distribution, which Mitsuba uses for importance sampling."""
        mean: DeviceArray = (self.low + self.high) / 2 if self.distribution == "uniform" else self.middle
        return mi.Float(mean)


mi.register_texture("cell_noise", CellNoise)
