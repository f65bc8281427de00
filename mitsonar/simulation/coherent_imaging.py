"""Coherent pings: field, beams, losses, leaks, noise, and levels after the gain, in the order of the instrument."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mitsonar.acoustics.noise import uniform
from mitsonar.acoustics.sonar_losses import gain_of, loss_notes, loss_of
from mitsonar.errors import MitsonarError
from mitsonar.instruments.aperture import series, shaded_sinc
from mitsonar.instruments.imaging_sonar import Sonar
from mitsonar.instruments.views import View, Whole
from mitsonar.simulation.beam_former import BeamFormer
from mitsonar.simulation.binning import Counts
from mitsonar.simulation.coherent_tracing import CoherentTracer, FieldCounts, point_pitch
from mitsonar.simulation.mirror_parts import Mirroring, mirror_of
from mitsonar.simulation.mirror_tracing import MirrorTracer

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = ["CoherentImager", "coherent_imager"]

FEWEST_A_CELL = 4.0
"""Points in a resolution cell below which the speckle's contrast exceeds theory by 3 % and more (measured)."""

STRIPES, NOISE, VOLUME, GLOW = 0x57121, 0x6E6F6973, 0x766F6C75, 0x676C6F77
"""Keep the draws of stripes, noise, volume and glow apart."""

MEDIAN_SQUARE = 0.25
"""Median over even beams of the square of the bearing, relative to the outermost."""


class CoherentImager:
    """Render the complex images of a sonar: amplitudes relative to the source's at 1 m, without the gain.

    Args:
        scene: any Mitsuba scene.
        sonar: of the model ``coherent``.
        mirrors: parts of shapes that reflect as mirrors, by the shapes' ids; default: none.

    Attributes:
        notes: what a user should know about scene and sonar.
    """

    def __init__(self, scene: mi.Scene, sonar: Sonar, mirrors: Mirroring = None) -> None:
        self.sonar, self.former = sonar, BeamFormer(sonar)
        self._kept_waves: dict[int, NDArray[np.float32]] = {}
        parts = mirror_of(scene, mirrors)
        self.tracer = CoherentTracer(scene, sonar, self.former, parts)
        self.glints = None if parts is None else MirrorTracer(scene, sonar, self.former, parts)
        self.notes = [*self.tracer.surfaces.notes, *point_notes(sonar), *loss_notes(sonar)]

    def image(self, pose: NDArray[np.float64], ping: int) -> tuple[NDArray[np.complex64], FieldCounts]:
        """Return the complex image of one ping ``(bins, beams)`` with its noise, and the counts of its rays.

        Args:
            pose: of the sonar ``(6,)`` [m, rad].
            ping: its number, of which the noise is a function.
        """
        field, counts = self.tracer.field(pose)
        if self.glints is not None:
            self.glints.add(pose, field)
        image = self.former.beams(field) * self._loss[:, None]
        if self.sonar.crosstalk_db is not None:
            image = image + np.float32(10 ** (self.sonar.crosstalk_db / 20)) * image.sum(axis=1, keepdims=True)
        if self.sonar.volume_db is not None:
            image = image + self.volume(ping)
        if self.sonar.noise_level_db is not None:
            image = image + self.noise(ping)
        if self.sonar.stripes_db > 0:
            image = image * self._stripes
        return np.asarray(image, dtype=np.complex64), counts

    def levels(self, pose: NDArray[np.float64], ping: int) -> tuple[NDArray[np.float32], Counts]:
        """Return the levels of one ping after the gain ``(bins, beams)`` float32, and the counts of its rays."""
        image, found = self.image(pose, ping)
        power = image.real * image.real + image.imag * image.imag
        rays = (np.array([[number]]) for number in (found.inside, found.nearer, found.farther, found.missed))
        return np.asarray(power * self.gain[:, None], dtype=np.float32), Counts(*rays)

    @cached_property
    def gain(self) -> NDArray[np.float32]:
        """Return the time-varying gain of levels ``(bins,)``."""
        return np.asarray(gain_of(self.sonar), dtype=np.float32)

    @cached_property
    def _loss(self) -> NDArray[np.float32]:
        """Return the amplitude that absorption leaves, there and back ``(bins,)``."""
        return np.asarray(np.sqrt(loss_of(self.sonar)), dtype=np.float32)

    @cached_property
    def _stripes(self) -> NDArray[np.float32]:
        """Return the gain of each beam's amplitude ``(beams,)``, from the seed."""
        rng = np.random.default_rng([abs(self.sonar.seed), STRIPES])
        return np.asarray(10 ** (rng.normal(0, self.sonar.stripes_db, self.sonar.beams) / 20), dtype=np.float32)

    # ---------------------------------------------------------------- noise and volume

    def noise(self, ping: int) -> NDArray[np.complex64]:
        """Return the receiver's noise of one ping ``(bins, beams)``: complex Gaussian, filtered as echoes are.

        White noise of the water and of the elements passes the array, so neighbouring beams share part of it, and the
        matched filter. Near the sonar it may glow. Each number is a function of (seed, ping, cell), those of the part of the
        glow that stays of (seed, cell).
        """
        sonar = self.sonar
        assert sonar.noise_level_db is not None
        amplitude = 10 ** ((sonar.noise_level_db - sonar.source_level_db + self._glow) / 20)
        if sonar.near_glow_still == 0 or sonar.near_glow_db == 0:
            return self._white(ping, NOISE, 1) * np.asarray(amplitude, np.float32)
        power = np.square(amplitude)
        still = sonar.near_glow_still * power * (1 - 10 ** (-self._glow / 10))
        new = self._white(ping, NOISE, 1) * np.asarray(np.sqrt(power - still), np.float32)
        return np.asarray(new + self._white(0, GLOW, 1) * np.asarray(np.sqrt(still), np.float32), dtype=np.complex64)

    @cached_property
    def _glow(self) -> NDArray[np.float64]:
        """Return what the noise near the sonar exceeds that behind by ``(bins, 1)`` or ``(bins, beams)`` [dB]."""
        sonar = self.sonar
        fall = (sonar.near_glow_db * (1 - sonar.range_m / sonar.near_glow_m))[:, None]
        if sonar.near_glow_db == 0 or (sonar.near_glow_edge_db == 0 and sonar.near_glow_spread_db == 0):
            return np.asarray(np.maximum(0, fall), dtype=np.float64)
        bearing = np.sin(sonar.bearing_rad) / np.sin(np.abs(sonar.bearing_rad).max())
        drawn = np.random.default_rng([abs(sonar.seed), GLOW]).normal(0, sonar.near_glow_spread_db, sonar.beams)
        return np.asarray(np.maximum(0, fall - sonar.near_glow_edge_db * (bearing**2 - MEDIAN_SQUARE) + drawn))

    def volume(self, ping: int) -> NDArray[np.complex64]:
        """Return the echo of what drifts in the water ``(bins, beams)``, new in each ping: Sv times the volume over R^4."""
        sonar = self.sonar
        assert sonar.volume_db is not None
        volume = sonar.range_m**2 * sonar.beam_width_rad * math.radians(sonar.elevation_fov_deg) * sonar.bin_m
        power = 10 ** (sonar.volume_db / 10) * volume / sonar.range_m**4 * loss_of(sonar)
        return self._white(ping, VOLUME, 2) * np.asarray(np.sqrt(power), np.float32)[:, None]

    def _white(self, ping: int, salt: int, ways: int) -> NDArray[np.complex64]:
        """Return complex Gaussian noise of unit power ``(bins, beams)`` that has passed array and matched filter."""
        if ways not in self._kept_waves:
            self._kept_waves[ways] = self._waves(ways)
        waves = self._kept_waves[ways]
        shape = 1, self.former.ranges, len(waves)
        first, second = uniform(shape, seed=self.sonar.seed ^ salt, frames=np.array([ping]), like=np.empty(0))
        radius = np.sqrt(-np.log(first[0]))
        white = np.concatenate([radius * np.cos(2 * math.pi * second[0]), radius * np.sin(2 * math.pi * second[0])], axis=1)
        filtered = self._noise_ranges @ white.astype(np.float32)
        real, imag = (np.ascontiguousarray(part) @ waves for part in np.split(filtered, 2, axis=1))
        return np.asarray(real + 1j * imag, dtype=np.complex64)

    def _waves(self, ways: int) -> NDArray[np.float32]:
        """Return the amplitude of plane waves in each beam ``(waves, beams)``, by the pattern one way or both ways.

        Waves are 1 / (ways x length) apart, which resolves that pattern. Each beam has unit power.
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
        """Return the matrix of the matched filter with rows of unit power ``(bins, ranges)``."""
        rows = self.former.over_range
        power = np.asarray(rows.multiply(rows).sum(axis=1)).ravel()
        return csr_array(rows.multiply(1 / np.sqrt(power)[:, None]), dtype=np.float32)


def point_notes(sonar: Sonar) -> list[str]:
    """Return a sentence where points are too few for speckle: a resolution cell should hold four."""
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
    scene: mi.Scene, sonar: Sonar, views: Sequence[View] | None, mirrors: Mirroring = None
) -> CoherentImager | None:
    """Return what renders pings of the model ``coherent``; None for other models.

    Raises:
        MitsonarError: portions of the field of view, or receivers elsewhere; mirrors in other models.
    """
    if sonar.model != "coherent":
        if mirrors:
            raise MitsonarError(f"the model {sonar.model} has no mirrors: give the sonar model coherent")
        return None
    if views is not None and any(not isinstance(view, Whole) for view in views):
        raise MitsonarError(
            "the model coherent has no portions of the field of view and no receivers elsewhere: render the whole view, "
            "or use the model physical"
        )
    return CoherentImager(scene, sonar, mirrors)
