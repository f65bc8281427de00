"""Number of rays for an accuracy, and the measured error of each quality.

Errors of the physical model, from ``benchmarks/bench_quality.py``:

Plain ground: a ray spreads its level evenly over the ranges that its cell of elevation covers. Cells join without gap, so
only the slope of the level within a cell is lost. The error grows with the cell's length along range as a part of the
range, ``dR / R = de / tan(grazing angle)``, whatever the range bins are. It falls faster than 1 / rays, and more rays
across lower the part of the error that is jitter.

Textured ground, where a ray's cell is larger than a cell of the texture: each ray reads one value at random. The error is
the texture's contrast over the square root of the rays in one bin. These are ``rays_across`` until an elevation cell is
shorter than a bin. The error falls as 1 / sqrt(rays), and faster once rays are denser than the texture. Rays jitter anew
each ping, so a sonar at rest sees this error change. It looks like speckle, and is none.
"""

from __future__ import annotations

import math
from functools import cache
from importlib.resources import files
from typing import Annotated, Literal, NamedTuple

import yaml
from pydantic import BeforeValidator

from mitsonar.errors import nearest_names, shortened

__all__ = ["FAR_GRAZING_RAD", "QUALITIES", "Measured", "Quality", "measured_errors", "rays_across", "rays_over_elevation"]

FAR_GRAZING_RAD = math.asin(0.2)
"""Grazing angle on the reference ground at the window's far end [rad]; the sonar is a fifth of that range above it."""

STEEPEST_RAD = math.radians(75)
"""Bearing beyond which a beam's width has no effect [rad]: the ground leaves the window there."""

MOST_ACROSS = 4096


class RayCounts(NamedTuple):
    """Requirements of a quality on the rays.

    Attributes:
        reach: longest range interval of one ray's cell on the reference ground, as a part of the range.
        apart_m: distance of rays across a beam at the far end of the window [m].
        across: rays across a beam at most, unless ``reach`` needs more.
    """

    reach: float
    apart_m: float
    across: int


QUALITIES: dict[str, RayCounts] = {
    "draft": RayCounts(0.03, math.inf, 1),
    "standard": RayCounts(0.01, 0.0075, 4),
    "fine": RayCounts(0.0025, 0.00375, 8),
}
"""Requirements of each quality, coarsest first."""


def _known(name: object) -> object:
    if not isinstance(name, str) or name not in QUALITIES:
        raise ValueError(f"unknown quality {shortened(name)}: {nearest_names(str(name)[:40], QUALITIES)}")
    return name


Quality = Annotated[Literal["draft", "standard", "fine"], BeforeValidator(_known)]


def rays_over_elevation(quality: str, elevation_fov_rad: float) -> int:
    """Compute the number of rays over a beam's elevation. It is even, since segments halve the field of view.

    A cell of height ``de`` covers ``de / tan(grazing)`` of the range. At the far end of the window it may cover ``reach``.
    """
    needed = elevation_fov_rad / (math.tan(FAR_GRAZING_RAD) * QUALITIES[quality].reach)
    return 2 * math.ceil(needed / 2)


def rays_across(quality: str, beam_width_rad: float, azimuth_fov_rad: float, range_max: float) -> int:
    """Compute the number of rays across a beam's width.

    Texture needs rays ``apart_m`` apart at the far end. At the edge of a wide fan the ground's range changes across a beam
    by the part ``tan(bearing)`` times the beam's width. Each ray may cover twice ``reach`` of it.
    """
    wanted = QUALITIES[quality]
    texture = min(wanted.across, math.ceil(beam_width_rad * range_max / wanted.apart_m))
    oblique = math.ceil(beam_width_rad * math.tan(min(azimuth_fov_rad / 2, STEEPEST_RAD)) / (2 * wanted.reach))
    return min(MOST_ACROSS, max(1, texture, oblique))


class Measured(NamedTuple):
    """Measured errors of a quality of a preset.

    Attributes:
        rays_per_beam: over elevation.
        rays_across: across a beam.
        plain_percent: rms error of a ping's bins on plain ground, in % of their level.
        textured_percent: on ground of 15 mm cells with reflectivities spread evenly over 0..1, in % of the level of plain
            ground of the same mean.
        still_correlation: of the levels of two pings of a sonar at rest over that ground, relative to plain ground.
    """

    rays_per_beam: int
    rays_across: int
    plain_percent: float
    textured_percent: float
    still_correlation: float


@cache
def measured_errors() -> tuple[str, dict[str, dict[str, Measured]]]:
    """Read the machine and date of the measurement, and the measured errors by preset and quality."""
    table = yaml.safe_load(files("mitsonar.instruments").joinpath("quality.yaml").read_text(encoding="utf-8"))
    found = {
        preset: {quality: Measured(**numbers) for quality, numbers in rows.items()}
        for preset, rows in table["presets"].items()
    }
    return f"{table['machine']}, {table['date']}", found
