"""What of a ping's echoes makes the image of a view: all of them, or those of a portion of the field of view."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

from numpy.typing import ArrayLike

from mitsonar.acoustics.echo_level import largest_level
from mitsonar.instruments.imaging_sonar import Sonar
from mitsonar.instruments.views import Segment, View, Whole
from mitsonar.records.echoes import Echoes

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.plugins.imaging_sonar_sensor import Fan
    from mitsonar.simulation.tracing import Rays

__all__ = ["NARROWEST", "SegmentTracer", "ViewEchoes", "ViewTracer", "WholeTracer", "fraction_bits"]

NARROWEST = 2.0**-6
"""Shortest footprint [bins]: a surface seen straight on has none, and a density needs one."""


@dataclass(frozen=True)
class ViewEchoes:
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


class ViewTracer(Protocol):
    """How the echoes of a launch become those of one view.

    Attributes:
        view: whose image it is.
        bits: fraction bits of its fixed-point sums.
    """

    bits: int

    @property
    def view(self) -> View: ...

    def tables(self, poses: ArrayLike) -> dict[str, Any]:
        """What it needs on the device, given the sonar's poses ``(pings, 6)``."""

    def view_echoes(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: dict[str, Any]) -> ViewEchoes:
        """The echoes of a launch as this view has them; joins the kernel that makes them."""


class WholeTracer:
    """All echoes, each in its ray's own beam."""

    def __init__(self, view: Whole) -> None:
        self.view = view
        self.bits = fraction_bits(view.sonar, view.sonar.rays // view.sonar.beams)

    def tables(self, poses: ArrayLike) -> dict[str, Any]:
        """Nothing."""
        return {}

    def view_echoes(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: dict[str, Any]) -> ViewEchoes:
        """Every ray in its own beam."""
        return ViewEchoes(echoes, rays.beam, True, fan.elevation)


class SegmentTracer:
    """The echoes of a portion of the field of view."""

    def __init__(self, view: Segment) -> None:
        self.view = view
        self.bits = fraction_bits(view.sonar, view.sonar.rays // view.sonar.beams)

    @cached_property
    def _on_device(self) -> dict[str, Any]:
        import drjit as dr
        import mitsuba as mi

        table = mi.Bool(self.view.member)
        dr.make_opaque(table)
        return {"member": table}

    def tables(self, poses: ArrayLike) -> dict[str, Any]:
        """Which pixels of the film belong to it."""
        return self._on_device

    def view_echoes(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: dict[str, Any]) -> ViewEchoes:
        """The rays of the portion, beams counted from its own first."""
        import drjit as dr
        import mitsuba as mi

        active = dr.gather(mi.Bool, tables["member"], rays.film)
        return ViewEchoes(echoes, dr.select(active, rays.beam - self.view.first_beam, 0), active, fan.elevation)


def fraction_bits(sonar: Sonar, rays: int, gain: float = 1.0) -> int:
    """Bits below one of the fixed-point sums: ``rays`` in one bin, each as strong as can be, stay below 2^62.

    ``gain`` is what a view may multiply a ray's level by at most.
    """
    cell = sonar.beam_width_rad / sonar.across * math.radians(sonar.elevation_fov_deg) / sonar.rays_per_beam
    largest = largest_level(sonar, cell) * rays * gain
    return 62 - math.ceil(math.log2(largest if sonar.model == "thesis" else largest / NARROWEST))
