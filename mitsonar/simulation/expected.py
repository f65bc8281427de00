"""How the model ``physical`` applies beam pattern, pulse and losses to levels that were binned in hard-edged boxes.

The rays are binned in boxes that tile sine and range without gaps, also beyond the field of view and the window. Matrices
of the squared pattern and the squared pulse then spread the levels. The result is the mean of many pings of the model
``coherent``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.water import loss_of, sonar_absorption, undone_absorption
from mitsonar.errors import MitsonarError
from mitsonar.instruments.beams import Pulse
from mitsonar.instruments.sonar import RAYS, Sonar
from mitsonar.instruments.views import View, Whole
from mitsonar.simulation.beams import PULSE_LENGTHS, elevation_end, side_lobes

__all__ = ["ExpectedFormer", "expected_former"]

PARTS = 16
"""Number of points of the integral over a box."""


@dataclass(frozen=True)
class ExpectedFormer:
    """Linear operator that spreads the levels of hard-edged boxes over beams and pulse.

    Attributes:
        sonar: a sonar of the model ``physical`` with a beam pattern.
    """

    sonar: Sonar

    @cached_property
    def beams_beside(self) -> int:
        """Return the number of boxes traced beside the fan, on each side."""
        sonar = self.sonar
        edge = math.radians(sonar.azimuth_fov_deg) / 2
        if sonar.beam_layout == "sine":
            wanted = side_lobes(sonar.aperture) / (2 * math.sin(edge) / sonar.beams)
            most = (1 / math.sin(edge) - 1) / 2 * sonar.beams
        else:
            wanted = side_lobes(sonar.aperture) / sonar.beam_spacing_rad
            most = (math.pi / 2 / edge - 1) / 2 * sonar.beams
        return max(0, math.floor(min(math.ceil(wanted), most)))

    @cached_property
    def bins_beside(self) -> tuple[int, int]:
        """Return the numbers of bins traced before the window and after it."""
        wanted = math.ceil(PULSE_LENGTHS / 2 * self.sonar.resolution_m / self.sonar.bin_m)
        return min(wanted, math.floor(self.sonar.range_min / self.sonar.bin_m)), wanted

    @cached_property
    def traced(self) -> Sonar:
        """Return the sonar whose hard-edged boxes are traced: its fan and window include the boxes and bins beside them."""
        # 1. Fan: as many boxes of the same width more, on both sides.
        sonar, beside = self.sonar, self.beams_beside
        before, after = self.bins_beside
        beams = sonar.beams + 2 * beside
        if sonar.beam_layout == "sine":
            part = math.sin(math.radians(sonar.azimuth_fov_deg) / 2) * beams / sonar.beams
            fov = 2 * math.degrees(math.asin(min(1.0, part)))
        else:
            fov = sonar.azimuth_fov_deg * beams / sonar.beams
        # 2. Elevation: to the end of its pattern, with the same density of rays.
        elevation = 2 * math.degrees(elevation_end(sonar))
        given = {name: getattr(sonar, name) for name in RAYS if name in sonar.model_fields_set}
        if "rays_per_beam" in given:
            given["rays_per_beam"] = math.ceil(sonar.rays_per_beam * elevation / sonar.elevation_fov_deg / 2) * 2
        return sonar.replace(
            azimuth_fov_deg=fov,
            elevation_fov_deg=elevation,
            beams=beams,
            beam_width_deg=None,
            range_min=sonar.range_min - before * sonar.bin_m,
            range_max=sonar.range_max + after * sonar.bin_m,
            range_bins=sonar.range_bins + before + after,
            **given,
        )

    @cached_property
    def over_beams(self) -> NDArray[np.float32]:
        """Return the fraction of each box's level that each beam receives ``(boxes, beams)``."""
        # Sample each box evenly in angle, and weight by the derivative of the sine: the integral is over sines.
        sonar, traced = self.sonar, self.traced
        aperture, width = sonar.aperture, traced.beam_width_rad
        share = (np.arange(PARTS) + 0.5) / PARTS - 0.5
        line = np.sin(traced.bearing_rad[:, None] + share * width)
        slope = np.cos(traced.bearing_rad[:, None] + share * width)  # derivative of the sine by the angle
        away = np.sin(sonar.bearing_rad)[None, :, None] - line[:, None, :]
        power = (aperture.pattern(away) ** 2 * slope[:, None, :]).mean(axis=2)
        return np.asarray(power * sonar.beam_width_rad / aperture.equivalent_width, dtype=np.float32)

    @cached_property
    def over_bins(self) -> NDArray[np.float32]:
        """Return the fraction of each traced bin's level in each bin, after losses and gain ``(bins, traced bins)``.

        The pulse is the same at all ranges, so the matrix has equal diagonals before losses: one row of values by the
        distance in bins, beginning with the farthest traced bin.
        """
        # 1. Mean squared pulse over a traced bin, for every possible distance in bins.
        sonar, bins, pulse = self.sonar, self.traced.range_bins, Pulse(self.sonar.resolution_m)
        share = (np.arange(PARTS) + 0.5) / PARTS - 0.5
        apart = np.arange(sonar.range_bins + bins - 1) - (bins - 1) + self.bins_beside[0]
        row = (pulse.shape((apart[:, None] - share) * sonar.bin_m) ** 2).mean(axis=1) * sonar.bin_m / pulse.equivalent_m
        # 2. Arrange the row as a matrix, and scale each bin by its losses and gain.
        power = row[np.arange(sonar.range_bins)[:, None] + np.arange(bins)[::-1]]
        kept = loss_of(sonar) * undone_absorption(sonar)
        return np.asarray(power * kept[:, None], dtype=np.float32)

    def levels(self, boxes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute the levels ``(pings, bins, beams)`` from those of the traced boxes."""
        return np.asarray(self.over_bins @ (boxes @ self.over_beams), dtype=np.float32)

    def crop(self, boxes: NDArray[Any]) -> NDArray[Any]:
        """Crop values of the traced boxes to the bins and beams of the sonar."""
        before, beside = self.bins_beside[0], self.beams_beside
        return boxes[:, before : before + self.sonar.range_bins, beside : beside + self.sonar.beams]


def expected_former(sonar: Sonar, views: Sequence[View] | None) -> ExpectedFormer | None:
    """Return the operator that spreads the levels of a sonar; None unless its model is ``physical`` with a pattern.

    Raises:
        MitsonarError: a sonar with a pattern has portions of the field of view or receivers elsewhere; there is absorption
            without a pattern.
    """
    if sonar.model != "physical" or sonar.beam_pattern == "box":
        if sonar.model == "physical" and sonar_absorption(sonar):
            raise MitsonarError(
                "the model physical loses sound to absorption with a pattern of the beams only: give pattern two_way as well"
            )
        return None
    if views is not None and any(not isinstance(view, Whole) for view in views):
        raise MitsonarError(
            "portions of the field of view and receivers elsewhere have hard edges: leave pattern out, or render the whole "
            "view"
        )
    return ExpectedFormer(sonar)
