"""The texture ``cell_noise``: an independent random value in each cell of a grid."""

from __future__ import annotations

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

    It is not filtered: a ray reads the single cell that it hits.

    .. code-block:: xml

        <texture type="cell_noise" name="reflectance">
            <integer name="cells" value="2048"/>
            <integer name="seed" value="7"/>
        </texture>
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props, cells=2048.0, cell_size=0.015)
        self.distribution = str(props.get("distribution", "uniform"))
        self.low, self.high = number_of_property(props, "low", 0.0), number_of_property(props, "high", 1.0)
        self.middle, self.std = number_of_property(props, "mean", 0.5), number_of_property(props, "std", 0.2)
        if self.distribution not in ("uniform", "gaussian"):
            raise MitsonarError(f"cell_noise distribution must be uniform or gaussian: got {self.distribution!r}")
        if not 0 <= self.low <= self.high <= 1 or not 0 <= self.middle <= 1 or not self.std >= 0:
            raise MitsonarError(
                f"cell_noise needs 0 <= low <= high <= 1, 0 <= mean <= 1, std >= 0: got low {self.low:g}, "
                f"high {self.high:g}, mean {self.middle:g}, std {self.std:g}"
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
        return mi.Float((self.low + self.high) / 2 if self.distribution == "uniform" else self.middle)


mi.register_texture("cell_noise", CellNoise)
