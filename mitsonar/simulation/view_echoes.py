"""Echoes of a view: all echoes of a ping, or those of a portion of the field of view."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

from numpy.typing import ArrayLike

from mitsonar.acoustics.levels import largest_level
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import Segment, View, Whole
from mitsonar.records.echoes import Echoes
from mitsonar.simulation.device_arrays import DeviceArray, LaunchTables

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.plugins.imaging_sonar_sensor import Fan
    from mitsonar.simulation.tracing import Rays

__all__ = ["NARROWEST", "SegmentTracer", "ViewEchoes", "ViewTracer", "WholeTracer", "fraction_bits"]

NARROWEST = 2.0**-6
"""Shortest footprint [bins]: a surface at normal incidence has none, and a density needs one."""


@dataclass(frozen=True)
class ViewEchoes:
    """The echoes of a launch in one view, one value for each ray, not evaluated yet.

    Attributes:
        echoes: with ranges and levels of this view.
        beam: index of the view's beam.
        active: whether the ray belongs to the view; other rays are not counted.
        elevation: of each ray in the view's own frame [rad].
    """

    echoes: Echoes
    beam: DeviceArray
    active: DeviceArray
    elevation: DeviceArray


class ViewTracer(Protocol):
    """Turn the echoes of a launch into those of one view.

    Attributes:
        bits: fraction bits of the fixed-point sums.
    """

    bits: int

    @property
    def view(self) -> View:
        """Return the view."""

    def tables(self, poses: ArrayLike) -> LaunchTables:
        """Return the view's inputs of a launch, given the sonar's poses ``(pings, 6)`` [m, rad]."""

    def view_echoes(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: LaunchTables) -> ViewEchoes:
        """Return the echoes of a launch in this view; joins the kernel that traces them."""


class WholeTracer:
    """All echoes, each in the beam of its ray."""

    def __init__(self, view: Whole) -> None:
        self.view = view
        self.bits = fraction_bits(view.sonar, view.sonar.rays // view.sonar.beams)

    def tables(self, poses: ArrayLike) -> LaunchTables:
        """Return an empty table: the view needs no inputs."""
        return {}

    def view_echoes(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: LaunchTables) -> ViewEchoes:
        """Return all echoes, each in the beam of its ray."""
        return ViewEchoes(echoes, rays.beam, True, fan.elevation)


class SegmentTracer:
    """The echoes of a portion of the field of view."""

    def __init__(self, view: Segment) -> None:
        self.view = view
        self.bits = fraction_bits(view.sonar, view.sonar.rays // view.sonar.beams)

    @cached_property
    def _on_device(self) -> LaunchTables:
        import drjit as dr
        import mitsuba as mi

        table = mi.Bool(self.view.member)
        dr.make_opaque(table)
        return {"member": table}

    def tables(self, poses: ArrayLike) -> LaunchTables:
        """Return the pixels of the film that belong to the portion."""
        return self._on_device

    def view_echoes(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: LaunchTables) -> ViewEchoes:
        """Return the echoes of the portion; beams count from its first."""
        import drjit as dr
        import mitsuba as mi

        active = dr.gather(mi.Bool, tables["member"], rays.film)
        return ViewEchoes(echoes, dr.select(active, rays.beam - self.view.first_beam, 0), active, fan.elevation)


def fraction_bits(sonar: Sonar, rays: int, gain: float = 1.0) -> int:
    """Return the fraction bits of the fixed-point sums: ``rays`` of the largest level in one bin stay below 2^62.

    Args:
        sonar: the instrument.
        rays: largest number of rays in one bin.
        gain: largest factor by which a view multiplies a ray's level.
    """
    cell = sonar.beam_width_rad / sonar.across * math.radians(sonar.elevation_fov_deg) / sonar.rays_per_beam
    largest = largest_level(sonar, cell) * rays * gain
    return 62 - math.ceil(math.log2(largest if sonar.model == "thesis" else largest / NARROWEST))
