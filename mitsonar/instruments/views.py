"""Define the views of a ping: the whole field of view, a segment of it, or the image of a separate receiver.

Segments (Almanza-Medina, 4.3) are those of a sonar that points straight down. Its bearing runs fore-aft (positive forward),
its elevation across (negative to starboard): a mount of pitch 90 and heading -90 deg.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, short_repr, suggest_names
from mitsonar.instruments.sonar import Bearing, Sonar
from mitsonar.motion.pose import Pose

__all__ = ["CONES", "SEGMENTS", "Receiver", "Segment", "View", "Whole", "directions"]


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
"""Signs of bearing and elevation of each segment.

Quadrants run clockwise from fore-starboard; c1 to c4 are the cones inscribed in them.
"""

CONES = ("c1", "c2", "c3", "c4")
"""Segments with a circular border."""

FEWEST_ACROSS = 8
"""Smallest number of jittered transmitter rays across a receiver beam; with fewer, images show stripes."""


class View(Protocol):
    """One image of a ping; a simulator computes all views from a single trace.

    Attributes:
        name: name of the view.
        sonar: sonar that defines the range bins, model and gain of the image.
        bearing_rad: axes of the beams ``(beams,)`` [rad].
    """

    name: str
    sonar: Sonar
    bearing_rad: NDArray[np.float64]

    @property
    def rays_a_beam(self) -> NDArray[np.int64] | None:
        """Return the number of rays of each beam ``(beams,)``; None if it differs from ping to ping."""


class Whole:
    """The whole field of view, in the sonar's beams or at measured bearings ``(beams,)`` [rad]."""

    name = "image"

    def __init__(self, sonar: Sonar, bearing_rad: NDArray[np.float64] | None = None) -> None:
        self.sonar = sonar
        self.bearing_rad = sonar.bearing_rad if bearing_rad is None else bearing_rad
        self.rays_a_beam: NDArray[np.int64] | None = np.full(sonar.beams, sonar.rays // sonar.beams)


class Segment:
    """A segment of the field of view. Rays belong to it by the centre of their cell, so they are the same in every ping.

    Args:
        sonar: the downward-looking sonar, with an even number of beams and of rays per beam.
        name: one of :data:`SEGMENTS`.

    Raises:
        MitsonarError: unknown name, or an odd number of beams or rays, which a quadrant would have to halve.
    """

    def __init__(self, sonar: Sonar, name: str) -> None:
        if name not in SEGMENTS:
            raise MitsonarError(f"unknown segment {short_repr(name)}: {suggest_names(name, SEGMENTS)}")
        if sonar.beams % 2 or sonar.rays_per_beam % 2:
            raise MitsonarError(
                f"segments halve the field of view: beams and rays_per_beam must be even, got {sonar.beams} and "
                f"{sonar.rays_per_beam}"
            )
        self.sonar, self.name = sonar, name
        self.fore, self.up = SEGMENTS[name]
        self.first_beam = sonar.beams // 2 if self.fore == 1 else 0
        beams = slice(self.first_beam, self.first_beam + sonar.beams // (1 if self.fore is None else 2))
        self.beams = beams
        self.bearing_rad = sonar.bearing_rad[beams]

    @cached_property
    def rays_a_beam(self) -> NDArray[np.int64] | None:
        """Return the number of the segment's rays in each beam ``(beams,)``."""
        sonar = self.sonar
        counts = self.member.reshape(sonar.rays_per_beam, sonar.beams, sonar.across).sum(axis=(0, 2))
        beam_counts: NDArray[np.int64] = counts[self.beams].astype(np.int64)
        return beam_counts

    @cached_property
    def member(self) -> NDArray[np.bool_]:
        """Return which pixels of the film belong to the segment ``(rays_per_beam * columns,)``."""
        sonar = self.sonar
        beam = np.repeat(np.arange(sonar.beams), sonar.across)[None, :]
        row = np.arange(sonar.rays_per_beam)[:, None]
        member = np.ones((sonar.rays_per_beam, sonar.columns), dtype=bool)
        if self.fore is not None:
            member &= (beam >= sonar.beams // 2) == (self.fore > 0)
        if self.up is not None:
            member &= (row < sonar.rays_per_beam // 2) == (self.up > 0)
        if self.fore is not None and self.up is not None and self.name in CONES:
            member &= self._inside_cone(self.fore, self.up)
        return member.ravel()

    def _inside_cone(self, fore: int, up: int) -> NDArray[np.bool_]:
        """Return the directions that are no farther from the centre of the quadrant than its nearest border."""
        sonar = self.sonar
        # Directions of the centres of all cells.
        inner = (np.arange(sonar.across) + 0.5) / sonar.across - 0.5
        bearing = (sonar.bearing_rad[:, None] + inner * sonar.beam_width_rad).ravel()[None, :]
        rows = (np.arange(sonar.rays_per_beam)[:, None] + 0.5) / sonar.rays_per_beam
        elevation = (0.5 - rows) * np.radians(sonar.elevation_fov_deg)
        # The cone around the centre of the quadrant touches the nearest point of its four borders.
        quarter = np.radians([sonar.azimuth_fov_deg, sonar.elevation_fov_deg]) / 4
        b, e = fore * quarter[0], up * quarter[1]
        axis = directions(sonar.bearing, b, e)
        along = np.linspace(0, 2, 2001)
        border = [directions(sonar.bearing, b * along, e * side) for side in (0, 2)]
        border += [directions(sonar.bearing, b * side, e * along) for side in (0, 2)]
        nearest = max(float((edge @ axis).max()) for edge in border)
        return np.asarray(directions(sonar.bearing, bearing, elevation) @ axis >= nearest)


class Receiver:
    """A receiver of a bistatic sonar.

    A ray of the transmitter A hits P. The range in the image is half of |P - A| + |B - P|; the beam is the bearing of P in
    the frame of B. P is ignored if it is outside the field of view of B, hidden from B, or lit on its far side. The ground
    point of a cell lies on an ellipsoid with foci A and B.

    Level, ``thesis``: C times the transmitter's cosine. ``physical``: C cos(theta_B) dOmega r^g / R_B^2. The cosine is that
    of the receiver, since that of the transmitter cancels in the lit area dA = R_A^2 dOmega / cos(theta_A). If B coincides
    with A, this is the monostatic level.

    Args:
        transmitter: sonar whose rays are traced. It needs at least eight jittered columns across each beam of the receiver.
        sonar: field of view, beams and range bins of the receiver; model and gain as for the transmitter.
        offset: pose of the receiver in the transmitter's axes (starboard, forward, up).
        name: name of the view.

    Raises:
        MitsonarError: too few columns, overlapping beams, a model or gain that differs from the transmitter's, or a window
            that begins nearer than half the distance between transmitter and receiver.
    """

    rays_a_beam: NDArray[np.int64] | None = None

    def __init__(self, transmitter: Sonar, sonar: Sonar, offset: Pose, name: str) -> None:
        self.transmitter, self.sonar, self.offset, self.name = transmitter, sonar, offset, name
        self.bearing_rad = sonar.bearing_rad
        self._check(transmitter)

    def _check(self, transmitter: Sonar) -> None:
        sonar, name = self.sonar, self.name
        if (sonar.model, sonar.gain_exponent) != (transmitter.model, transmitter.gain_exponent):
            raise MitsonarError(f"receiver {name} must have the transmitter's model and gain_exponent")
        if sonar.beam_width_deg is not None and sonar.beam_width_rad > sonar.beam_spacing_rad * (1 + 1e-9):
            raise MitsonarError(f"receiver {name}: beams may not overlap; leave beam_width_deg out")
        across = transmitter.columns / transmitter.azimuth_fov_deg * sonar.azimuth_fov_deg / sonar.beams
        if across < FEWEST_ACROSS * (1 - 1e-9) or not transmitter.jittered:
            raise MitsonarError(
                f"receiver {name}: the transmitter needs {FEWEST_ACROSS} jittered columns of rays across a receiver's beam, "
                f"or stripes appear: got {across:.3g}, jitter {transmitter.jittered}; raise beams (thesis) or rays_across"
            )
        if math.dist(self.offset[:3], (0, 0, 0)) / 2 >= max(sonar.range_min, sonar.bin_m) and sonar.model == "physical":
            raise MitsonarError(f"receiver {name}: range_min must exceed half its distance from the transmitter")


# ---------------- Directions in the sonar's frame


def directions(bearing: Bearing, bearing_rad: ArrayLike, elevation_rad: ArrayLike) -> NDArray[np.float64]:
    """Compute unit vectors ``(..., 3)`` as (starboard, forward, up) in the sonar's frame, for both types of bearing.

    Args:
        bearing: ``azimuth``, or ``cone``, the angle that a line array measures.
        bearing_rad: bearings [rad].
        elevation_rad: elevations [rad], broadcast against the bearings.
    """
    b, e = np.broadcast_arrays(np.asarray(bearing_rad, dtype=float), np.asarray(elevation_rad, dtype=float))
    if bearing == "azimuth":
        return np.stack([np.cos(e) * np.sin(b), np.cos(e) * np.cos(b), np.sin(e)], axis=-1)
    return np.stack([np.sin(b), np.cos(b) * np.cos(e), np.cos(b) * np.sin(e)], axis=-1)
