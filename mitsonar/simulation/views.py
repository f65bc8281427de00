"""What of a ping's echoes makes an image: all of them (here), a portion of the field of view, or what a receiver hears."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.simulation.acoustics import largest_level
from mitsonar.simulation.echoes import Echoes
from mitsonar.sonar import Sonar

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.plugins.imaging_sonar import Fan
    from mitsonar.simulation.tracing import Rays

__all__ = ["NARROWEST", "Seen", "View", "Whole", "fraction_bits"]

NARROWEST = 2.0**-6
"""Shortest footprint [bins]: a surface seen straight on has none, and a density needs one."""


@dataclass(frozen=True)
class Seen:
    """What a view makes of the echoes of a launch, one value a ray, not evaluated yet.

    Attributes:
        echoes: as this view has them.
        beam: the view's beam that each belongs to.
        active: rays that belong to the view at all; the others are not even counted.
        elevation: of each ray in the view's own frame [rad].
    """

    echoes: Echoes
    beam: Any
    active: Any
    elevation: Any


class View(Protocol):
    """One image of a ping; all views of a simulator are made from one trace.

    Attributes:
        name: of the view.
        sonar: whose range bins, model and gain law the image has.
        bearing_rad: axes of its beams ``(beams,)`` [rad].
        bits: fraction bits of its fixed-point sums.
        rays_a_beam: rays that belong to each beam ``(beams,)``; None where that differs from ping to ping.
    """

    name: str
    sonar: Sonar
    bearing_rad: NDArray[np.float64]
    bits: int
    rays_a_beam: NDArray[np.int64] | None

    def tables(self, poses: ArrayLike) -> dict[str, Any]:
        """What it needs on the device, given the sonar's poses ``(pings, 6)``."""

    def see(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: dict[str, Any]) -> Seen:
        """The echoes of a launch as this view has them; joins the kernel that makes them."""


class Whole:
    """All echoes, in the sonar's own beams."""

    name = "image"

    def __init__(self, sonar: Sonar) -> None:
        each = sonar.rays // sonar.beams
        self.sonar = sonar
        self.bearing_rad = sonar.bearing_rad
        self.bits = fraction_bits(sonar, each)
        self.rays_a_beam: NDArray[np.int64] | None = np.full(sonar.beams, each)

    def tables(self, poses: ArrayLike) -> dict[str, Any]:
        """Nothing."""
        return {}

    def see(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: dict[str, Any]) -> Seen:
        """Every ray in its own beam."""
        return Seen(echoes, rays.beam, True, fan.elevation)


def fraction_bits(sonar: Sonar, rays: int, gain: float = 1.0) -> int:
    """Bits below one of the fixed-point sums: ``rays`` in one bin, each as strong as can be, stay below 2^62.

    ``gain`` is what a view may multiply a ray's level by at most.
    """
    cell = sonar.beam_width_rad / sonar.across * math.radians(sonar.elevation_fov_deg) / sonar.rays_per_beam
    largest = largest_level(sonar, cell) * rays * gain
    return 62 - math.ceil(math.log2(largest if sonar.model == "thesis" else largest / NARROWEST))
