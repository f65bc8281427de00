"""How a coherent ping is made: field, beams, losses, crosstalk, noise and gain, in the order of the instrument."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mitsonar.acoustics.noise import uniform
from mitsonar.acoustics.water import gain_of, loss_notes, loss_of
from mitsonar.errors import MitsonarError
from mitsonar.instruments.beams import series, shaded_sinc
from mitsonar.instruments.sonar import Quality, Sonar
from mitsonar.instruments.views import CONES, Segment, View, Whole
from mitsonar.simulation.beams import BeamFormer
from mitsonar.simulation.binning import Counts
from mitsonar.simulation.coherent_tracing import CoherentTracer, FieldCounts, point_pitch
from mitsonar.simulation.mirrors import Mirroring, mirror_of
from mitsonar.simulation.moving import SceneMotion
from mitsonar.simulation.multipath_coherent import CornerTracer, GhostTracer, MirrorTracer
from mitsonar.simulation.multipath_rough import DiffuseField
from mitsonar.simulation.pings import CutRays, RenderedPings
from mitsonar.simulation.points import MOST_CANDIDATES

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = ["CoherentImager", "coherent_imager"]

FEWEST_A_CELL = 4.0
"""Points per resolution cell below which the contrast of speckle exceeds theory by 3 % or more (measured)."""

MOST_CUT = 1e-3
"""Fraction of rays that may miss points: rays that graze the sides of bodies do, and contribute little."""

STRIPES, NOISE, VOLUME, GLOW = 0x57121, 0x6E6F6973, 0x766F6C75, 0x676C6F77
"""Salts of the seed that make the draws of stripes, noise, volume and glow independent."""

MEDIAN_SQUARE = 0.25
"""Median of the squared bearing over evenly spaced beams, relative to the outermost beam."""

SIDE_SALT = {0: 0, 1: 0x7570 << 32, -1: 0x646F << 32}
"""Salts of the seed that make the noise of both sides of the elevation independent, keyed by side."""


class CoherentImager:
    """Renderer of a sonar's complex images: amplitudes relative to the source at 1 m, without the gain.

    Args:
        scene: any Mitsuba scene.
        sonar: a sonar of the model ``coherent``.
        mirrors: mirror parts of shapes, keyed by shape id, or ``"materials"``; default: none.
        views: the whole field of view or portions of it; default: the whole.
        motion: motion of the scene's bodies; default: nothing moves.

    Attributes:
        sides: sides of the elevation that are rendered separately: 0 for the whole view, +1 and -1 for portions.
        notes: warnings about scene and sonar.

    Raises:
        MitsonarError: a view is a receiver elsewhere or a cone; there are mirrors in portions.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sonar: Sonar,
        mirrors: Mirroring = None,
        views: Sequence[View] | None = None,
        motion: SceneMotion | None = None,
    ) -> None:
        self.views = check_views(views or [Whole(sonar)], mirrors)
        self.sides = tuple(dict.fromkeys(side_of(view) for view in self.views))
        self.sonar, self.former = sonar, BeamFormer(sonar)
        self._given = scene, mirrors, motion
        self._kept_waves: dict[int, NDArray[np.float32]] = {}
        parts = mirror_of(scene, mirrors)
        self.tracers = {side: CoherentTracer(scene, sonar, self.former, parts, side, motion) for side in self.sides}
        self.tracer = self.tracers[self.sides[0]]
        self.glints = None if parts is None else MirrorTracer(scene, sonar, self.former, parts, motion=motion)
        several = parts is not None and sonar.bounces > 1
        self.ghosts = GhostTracer(self.tracer, parts) if several else None
        self.diffuse = DiffuseField(self.tracer) if sonar.bounces > 1 else None
        cornered = parts if several else None
        self.corners = None if cornered is None else CornerTracer(scene, sonar, self.former, cornered, motion=motion)
        self.notes = [*self.tracer.surfaces.notes, *point_notes(sonar), *loss_notes(sonar)]

    def image(self, pose: NDArray[np.float64], ping: int, time_s: float = 0.0) -> tuple[NDArray[np.complex64], FieldCounts]:
        """Return the complex image of one ping ``(bins, sides * beams)`` with its noise, and the counts of its rays.

        Args:
            pose: sonar pose ``(6,)`` [m, rad].
            ping: ping number, which determines the noise.
            time_s: time at which moving bodies are placed [s].
        """
        images, counts = zip(*(self._of_side(pose, ping, side, time_s) for side in self.sides), strict=True)
        return np.concatenate(images, axis=1) if len(images) > 1 else images[0], FieldCounts.joined(counts)

    def _of_side(
        self, pose: NDArray[np.float64], ping: int, side: int, time_s: float
    ) -> tuple[NDArray[np.complex64], FieldCounts]:
        """Return the complex image of one side of the elevation ``(bins, beams)`` with its noise, and its ray counts."""
        image, counts = self.echoes(pose, side, time_s)
        if self.sonar.volume_db is not None:
            image = image + self.volume(ping, side)
        if self.sonar.noise_level_db is not None:
            image = image + self.noise(ping, side)
        if self.sonar.stripes_db > 0:
            image = image * self._stripes
        return np.asarray(image, dtype=np.complex64), counts

    def echoes(
        self, pose: NDArray[np.float64], side: int | None = None, time_s: float = 0.0
    ) -> tuple[NDArray[np.complex64], FieldCounts]:
        """Return the complex image of the scene alone ``(bins, beams)``, and the ray counts.

        The image has no noise, volume reverberation or stripes.

        Args:
            pose: sonar pose ``(6,)`` [m, rad].
            side: side of the elevation, one of :attr:`sides`; default: the first.
            time_s: time at which moving bodies are placed [s].
        """
        # field of the scatterers, then of mirror images and paths of several reflections
        field, counts = (self.tracer if side is None else self.tracers[side]).field(pose, time_s)
        if self.glints is not None:
            self.glints.add(pose, field, time_s)
        for further in (self.ghosts, self.corners, self.diffuse):
            if further is not None:
                further.add(pose, field, time_s)
        # beams and bins, absorption, and the crosstalk of all beams
        image = self.former.beams(field) * self._loss[:, None]
        if self.sonar.crosstalk_db is not None:
            image = image + np.float32(10 ** (self.sonar.crosstalk_db / 20)) * image.sum(axis=1, keepdims=True)
        return np.asarray(image, dtype=np.complex64), counts

    def of_quality(self, quality: Quality) -> CoherentImager:
        """Return a renderer of the same scatterers with the number of rays of another quality."""
        scene, mirrors, motion = self._given
        return CoherentImager(scene, self.sonar.replace(quality=quality), mirrors, motion=motion)

    def in_views(self, pings: RenderedPings) -> list[RenderedPings]:
        """Split pings of all :attr:`sides` ``(pings, bins, sides * beams)`` into one part for each view."""
        found = []
        for view in self.views:
            first = self.sides.index(side_of(view)) * self.sonar.beams
            own = view.beams if isinstance(view, Segment) else slice(0, self.sonar.beams)
            found.append(replace(pings, levels=pings.levels[:, :, first + own.start : first + own.stop]))
        return found

    def levels(
        self, pose: NDArray[np.float64], ping: int, time_s: float = 0.0
    ) -> tuple[NDArray[np.float32], Counts, CutRays]:
        """Return the levels of one ping after gain ``(bins, sides * beams)`` float32, its ray counts, and its cut rays."""
        image, found = self.image(pose, ping, time_s)
        power = image.real * image.real + image.imag * image.imag
        rays = (np.array([[number]]) for number in (found.inside, found.nearer, found.farther, found.missed))
        return np.asarray(power * self.gain[:, None], dtype=np.float32), Counts(*rays), self._cut_rays(found)

    def _cut_rays(self, found: FieldCounts) -> CutRays:
        """Return the rays that missed points, if they are numerous enough to affect the image."""
        if found.cut <= MOST_CUT * found.inside:
            return CutRays()
        return CutRays(found.cut, self.tracer.pitch * math.sqrt(1.1 * found.widest / MOST_CANDIDATES))

    @cached_property
    def gain(self) -> NDArray[np.float32]:
        """Return the time-varying gain of levels ``(bins,)``."""
        return np.asarray(gain_of(self.sonar), dtype=np.float32)

    @cached_property
    def _loss(self) -> NDArray[np.float32]:
        """Return the two-way amplitude factor of absorption ``(bins,)``."""
        return np.asarray(np.sqrt(loss_of(self.sonar)), dtype=np.float32)

    @cached_property
    def _stripes(self) -> NDArray[np.float32]:
        """Return the amplitude gain of each beam ``(beams,)``, drawn from the seed."""
        rng = np.random.default_rng([abs(self.sonar.seed), STRIPES])
        return np.asarray(10 ** (rng.normal(0, self.sonar.stripes_db, self.sonar.beams) / 20), dtype=np.float32)

    # ---------------- Noise and volume reverberation

    def noise(self, ping: int, side: int = 0) -> NDArray[np.complex64]:
        """Return the receiver noise of one ping ``(bins, beams)``: complex Gaussian, filtered as echoes are.

        White noise from the water and the array elements passes the array, which correlates neighbouring beams, and the
        matched filter. The noise may rise near the sonar (near glow). Each value is a function of (seed, ping, cell); the
        part of the glow that is constant over pings is a function of (seed, cell).
        """
        sonar, amplitude, salt = self.sonar, self._noise_amplitude, SIDE_SALT[side]
        if sonar.near_glow_still == 0 or sonar.near_glow_db == 0:
            return self._white(ping, NOISE ^ salt, 1) * np.asarray(amplitude, np.float32)
        # split the excess power of the glow into a part that is constant over pings and a part drawn for each ping
        power = np.square(amplitude)
        still = sonar.near_glow_still * power * (1 - 10 ** (-self._glow / 10))
        new = self._white(ping, NOISE ^ salt, 1) * np.asarray(np.sqrt(power - still), np.float32)
        stays = self._white(0, GLOW ^ salt, 1) * np.asarray(np.sqrt(still), np.float32)
        return np.asarray(new + stays, dtype=np.complex64)

    @cached_property
    def _glow(self) -> NDArray[np.float64]:
        """Return the excess of the noise near the sonar over that farther away ``(bins, 1)`` or ``(bins, beams)`` [dB]."""
        sonar = self.sonar
        fall = (sonar.near_glow_db * (1 - sonar.range_m / sonar.near_glow_m))[:, None]
        if sonar.near_glow_db == 0 or (sonar.near_glow_edge_db == 0 and sonar.near_glow_spread_db == 0):
            return np.asarray(np.maximum(0, fall), dtype=np.float64)
        bearing = np.sin(sonar.bearing_rad) / np.sin(np.abs(sonar.bearing_rad).max())
        drawn = np.random.default_rng([abs(sonar.seed), GLOW]).normal(0, sonar.near_glow_spread_db, sonar.beams)
        return np.asarray(np.maximum(0, fall - sonar.near_glow_edge_db * (bearing**2 - MEDIAN_SQUARE) + drawn))

    def volume(self, ping: int, side: int = 0) -> NDArray[np.complex64]:
        """Return the volume reverberation of one ping ``(bins, beams)``, drawn anew for each ping.

        Its power is Sv times the volume of the cell over R^4. One side of the elevation contains half of the volume.
        """
        amplitude = np.asarray(self._volume_amplitude * (math.sqrt(0.5) if side else 1), np.float32)
        return self._white(ping, VOLUME ^ SIDE_SALT[side], 2) * amplitude[:, None]

    def noise_powers(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the mean powers of noise and of volume reverberation, two arrays ``(bins,)``; 0 where there is none.

        Glow that differs from beam to beam is averaged over the beams.
        """
        sonar, none = self.sonar, np.zeros(self.sonar.range_bins)
        noise = none if sonar.noise_level_db is None else np.square(self._noise_amplitude).mean(axis=1)
        return noise, none if sonar.volume_db is None else np.square(self._volume_amplitude)

    def beam_correlations(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the beam correlations ``(beams, beams)`` of noise, volume reverberation, and speckle on even ground."""
        noise, volume = (self._plane_waves(ways).astype(float) for ways in (1, 2))
        lines = self.former.over_sine.T.astype(float)
        return noise.T @ noise, volume.T @ volume, _correlation(lines.T @ lines)

    def bin_correlation(self) -> csr_array[Any, Any]:
        """Return the bin correlation ``(bins, bins)`` due to the pulse, the same for noise, volume and speckle."""
        rows = self._noise_ranges.astype(float)
        return csr_array(rows @ rows.T)

    @cached_property
    def _noise_amplitude(self) -> NDArray[np.float64]:
        """Return the amplitude of the receiver noise including glow ``(bins, 1)`` or ``(bins, beams)``."""
        sonar = self.sonar
        assert sonar.noise_level_db is not None
        return np.asarray(10 ** ((sonar.noise_level_db - sonar.source_level_db + self._glow) / 20), dtype=np.float64)

    @cached_property
    def _volume_amplitude(self) -> NDArray[np.float64]:
        """Return the amplitude of the volume reverberation ``(bins,)``."""
        sonar = self.sonar
        assert sonar.volume_db is not None
        volume = sonar.range_m**2 * sonar.beam_width_rad * math.radians(sonar.elevation_fov_deg) * sonar.bin_m
        power = 10 ** (sonar.volume_db / 10) * volume / sonar.range_m**4 * loss_of(sonar)
        return np.asarray(np.sqrt(power), dtype=np.float64)

    def _plane_waves(self, ways: int) -> NDArray[np.float32]:
        """Return :meth:`_waves` from a cache."""
        if ways not in self._kept_waves:
            self._kept_waves[ways] = self._waves(ways)
        return self._kept_waves[ways]

    def _white(self, ping: int, salt: int, ways: int) -> NDArray[np.complex64]:
        """Return complex Gaussian noise of unit power ``(bins, beams)``, filtered by the array and the matched filter."""
        waves = self._plane_waves(ways)
        shape = 1, self.former.ranges, len(waves)
        first, second = uniform(shape, seed=self.sonar.seed ^ salt, frames=np.array([ping]), like=np.empty(0))
        # 1. Draw complex Gaussian noise of every plane wave and range (Box-Muller), real and imaginary part side by side.
        radius = np.sqrt(-np.log(first[0]))
        white = np.concatenate([radius * np.cos(2 * math.pi * second[0]), radius * np.sin(2 * math.pi * second[0])], axis=1)
        # 2. Apply the matched filter over range, then the array over plane waves.
        filtered = self._noise_ranges @ white.astype(np.float32)
        real, imag = (np.ascontiguousarray(part) @ waves for part in np.split(filtered, 2, axis=1))
        return np.asarray(real + 1j * imag, dtype=np.complex64)

    def _waves(self, ways: int) -> NDArray[np.float32]:
        """Return the amplitude of plane waves in each beam ``(waves, beams)``, for a one-way or two-way pattern.

        Waves are 1 / (ways x length) apart in sine, which resolves that pattern. Each beam has unit power.
        """
        length = self.former.aperture.length
        reach = math.sin(math.radians(self.sonar.azimuth_fov_deg) / 2) + 4 / length
        wave = np.arange(-reach, reach, 1 / (ways * length))
        away = np.sin(self.sonar.bearing_rad)[:, None] - wave
        amplitude = shaded_sinc(away * length, series(self.sonar.shading)) ** ways
        amplitude /= np.sqrt(np.square(amplitude).sum(axis=1, keepdims=True))
        return np.ascontiguousarray(amplitude.T, dtype=np.float32)

    @cached_property
    def _noise_ranges(self) -> csr_array[Any, Any]:
        """Return the matched filter as a matrix ``(bins, ranges)`` with rows of unit power."""
        rows = self.former.over_range
        power = np.asarray(rows.multiply(rows).sum(axis=1)).ravel()
        return csr_array(rows.multiply(1 / np.sqrt(power)[:, None]), dtype=np.float32)


def _correlation(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert a covariance matrix ``(n, n)`` to a correlation matrix."""
    std = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / np.outer(std, std), dtype=np.float64)


def point_notes(sonar: Sonar) -> list[str]:
    """Return a warning if points are too sparse for speckle: a resolution cell should hold :data:`FEWEST_A_CELL`."""
    pitch = point_pitch(sonar)
    nearest = max(sonar.range_min, sonar.bin_m)
    held = nearest * sonar.beam_width_rad * sonar.resolution_m / pitch**2
    needed = math.sqrt(nearest * sonar.beam_width_rad * sonar.resolution_m / FEWEST_A_CELL)
    enough = FEWEST_A_CELL * pitch**2 / (sonar.beam_width_rad * sonar.resolution_m)
    if held >= FEWEST_A_CELL or (sonar.scatterer_spacing_m is None and enough <= sonar.range_max / 2):
        return []
    return [
        f"a resolution cell holds {held:.2g} points at {nearest:g} m, {FEWEST_A_CELL:g} from {enough:.3g} m on: below, "
        f"intensities vary more than speckle does; a scatterer_spacing_m of {needed:.2g} m would do everywhere"
    ]


def coherent_imager(
    scene: mi.Scene,
    sonar: Sonar,
    views: Sequence[View] | None,
    mirrors: Mirroring = None,
    motion: SceneMotion | None = None,
) -> CoherentImager | None:
    """Return the renderer of pings of the model ``coherent``; None for other models.

    Raises:
        MitsonarError: a view is a receiver elsewhere or a cone; there are mirrors in portions.
    """
    if sonar.model != "coherent":
        return None
    return CoherentImager(scene, sonar, mirrors, views, motion)


def check_views(views: Sequence[View], mirrors: Mirroring) -> Sequence[View]:
    """Return the views if each is the whole field of view, or a portion bounded by beams and the horizon.

    Raises:
        MitsonarError: a view is a receiver elsewhere or a cone; there are mirrors in portions.
    """
    for view in views:
        if not isinstance(view, Whole | Segment) or view.name in CONES:
            raise MitsonarError(
                f"the model coherent has no receivers elsewhere and no cones: got {view.name}; render the whole view, a "
                "side or quadrants, or use the model physical"
            )
        if mirrors and side_of(view):
            raise MitsonarError(f"mirrors are of whole views: got {view.name}; leave mirrors out, or render the whole view")
    return views


def side_of(view: View) -> int:
    """Return the side of the elevation that a view shows: +1 up, -1 down, 0 both."""
    return (view.up or 0) if isinstance(view, Segment) else 0
