"""Portions of a looking-down sonar's field of view, each an image of its own from the same echoes (Almanza-Medina, 4.3).

The sonar looks straight down, its bearing runs fore-aft (positive forward), its elevation across (negative to starboard):
a mount of pitch 90 and heading -90 deg.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.geometry import directions
from mitsonar.simulation.echoes import Echoes
from mitsonar.simulation.views import Seen, fraction_bits
from mitsonar.sonar import Sonar

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.plugins.imaging_sonar import Fan
    from mitsonar.simulation.tracing import Rays

__all__ = ["SEGMENTS", "Segment"]

SEGMENTS = {
    "whole": (None, None),
    "starboard": (None, -1),
    "port": (None, +1),
    "q1": (+1, -1),
    "q2": (-1, -1),
    "q3": (-1, +1),
    "q4": (+1, +1),
    "c1": (+1, -1),
    "c2": (-1, -1),
    "c3": (-1, +1),
    "c4": (+1, +1),
}
"""Signs of bearing and elevation. Quadrants from fore-starboard clockwise; c1 to c4, the cone inscribed in each."""


class Segment:
    """One portion; rays belong to it by the middle of their cell, so that it is the same in every ping.

    Args:
        sonar: the looking-down sonar, with an even number of beams and of rays a beam.
        name: of :data:`SEGMENTS`.

    Raises:
        MitsonarError: unknown name; odd beams or rays, which a quadrant would have to halve.
    """

    def __init__(self, sonar: Sonar, name: str) -> None:
        if name not in SEGMENTS:
            raise MitsonarError(f"unknown segment {name!r}: {nearest_names(name, SEGMENTS)}")
        if sonar.beams % 2 or sonar.rays_per_beam % 2:
            raise MitsonarError(
                f"segments halve the field of view: beams and rays_per_beam must be even, got {sonar.beams} and "
                f"{sonar.rays_per_beam}"
            )
        self.sonar, self.name = sonar, name
        self.fore, self.up = SEGMENTS[name]
        self.first_beam = sonar.beams // 2 if self.fore == 1 else 0
        beams = slice(self.first_beam, self.first_beam + sonar.beams // (1 if self.fore is None else 2))
        member = self._member()
        counts = member.reshape(sonar.rays_per_beam, sonar.beams, sonar.across).sum(axis=(0, 2))
        self.bearing_rad = sonar.bearing_rad[beams]
        self.rays_a_beam: NDArray[np.int64] | None = counts[beams].astype(np.int64)
        self.bits = fraction_bits(sonar, sonar.rays // sonar.beams)
        self.member = member

    def _member(self) -> NDArray[np.bool_]:
        """Which pixels of the film belong to it ``(rays_per_beam * columns,)``."""
        sonar = self.sonar
        beam = np.repeat(np.arange(sonar.beams), sonar.across)[None, :]
        row = np.arange(sonar.rays_per_beam)[:, None]
        member = np.ones((sonar.rays_per_beam, sonar.columns), dtype=bool)
        if self.fore is not None:
            member &= (beam >= sonar.beams // 2) == (self.fore > 0)
        if self.up is not None:
            member &= (row < sonar.rays_per_beam // 2) == (self.up > 0)
        if self.fore is not None and self.up is not None and self.name.startswith("c"):
            member &= self._inside_cone(self.fore, self.up)
        return member.ravel()

    def _inside_cone(self, fore: int, up: int) -> NDArray[np.bool_]:
        """Directions no farther from the quadrant's middle than its nearest border."""
        sonar = self.sonar
        inner = (np.arange(sonar.across) + 0.5) / sonar.across - 0.5
        bearing = (sonar.bearing_rad[:, None] + inner * sonar.beam_width_rad).ravel()[None, :]
        rows = (np.arange(sonar.rays_per_beam)[:, None] + 0.5) / sonar.rays_per_beam
        elevation = (0.5 - rows) * np.radians(sonar.elevation_fov_deg)
        quarter = np.radians([sonar.azimuth_fov_deg, sonar.elevation_fov_deg]) / 4
        b, e = fore * quarter[0], up * quarter[1]
        axis = directions(sonar.bearing, b, e)
        along = np.linspace(0, 2, 2001)
        border = [directions(sonar.bearing, b * along, e * side) for side in (0, 2)]
        border += [directions(sonar.bearing, b * side, e * along) for side in (0, 2)]
        nearest = max(float((edge @ axis).max()) for edge in border)
        return np.asarray(directions(sonar.bearing, bearing, elevation) @ axis >= nearest)

    @cached_property
    def _on_device(self) -> dict[str, Any]:
        import drjit as dr
        import mitsuba as mi

        table = mi.Bool(self.member)
        dr.make_opaque(table)
        return {"member": table}

    def tables(self, poses: ArrayLike) -> dict[str, Any]:
        """Which pixels of the film belong to it."""
        return self._on_device

    def see(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: dict[str, Any]) -> Seen:
        """The rays of the portion, beams counted from its own first."""
        import drjit as dr
        import mitsuba as mi

        active = dr.gather(mi.Bool, tables["member"], rays.film)
        return Seen(echoes, dr.select(active, rays.beam - self.first_beam, 0), active, fan.elevation)
