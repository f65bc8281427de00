"""Model ``coherent``: field, beams, losses, tails, crosstalk, noise and gain of a ping, in the order of the instrument."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.water import gain_of, loss_notes, loss_of, net_loss, sonar_absorption
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Quality, Sonar
from mitsonar.instruments.views import CONES, Segment, View, Whole
from mitsonar.simulation.beams import BeamFormer
from mitsonar.simulation.coherent_tracing import CoherentTracer, FieldCounts, point_pitch
from mitsonar.simulation.mirrors import Mirroring, mirror_of
from mitsonar.simulation.models.thesis import ImageLaunch, ThesisModel
from mitsonar.simulation.moving import SceneMotion
from mitsonar.simulation.multipath_coherent import CornerTracer, GhostTracer, MirrorTracer
from mitsonar.simulation.multipath_rough import DiffuseField
from mitsonar.simulation.pings import Counts, CutRays, RenderedPings
from mitsonar.simulation.points import MOST_CANDIDATES
from mitsonar.simulation.receiver_noise import EchoTail, ReceiverNoise, crosstalk, saturation_notes
from mitsonar.simulation.tracing import surfaces_of, tracer_of

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = ["CoherentImager", "CoherentModel"]

FEWEST_A_CELL = 4.0
"""Points per resolution cell below which the contrast of speckle exceeds theory by 3 % or more (measured)."""

MOST_CUT = 1e-3
"""Fraction of rays that may miss points: rays that graze the sides of bodies do, and contribute little."""


class CoherentModel:
    """Renderer of levels with speckle and noise, one ping after another.

    Implements :class:`~mitsonar.simulation.models.create.PingModel`.

    The arguments are those of :func:`~mitsonar.simulation.models.create.create_model`, and:

    Args:
        groups: ping group of each beam ``(beams,)``, for crosstalk, if the sonar is that of one ping.

    Attributes:
        imager: renderer of the complex images.

    Raises:
        MitsonarError: as in :class:`CoherentImager`.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sonar: Sonar,
        views: Sequence[View] | None,
        mirrors: Mirroring,
        motion: SceneMotion | None,
        rays_per_launch: int,
        groups: NDArray[np.int64] | None = None,
    ) -> None:
        self.imager = CoherentImager(scene, sonar, mirrors, views, motion, groups)
        self.tracer, self._rays_per_launch = tracer_of(scene, sonar, motion), rays_per_launch
        self.views, self.notes = self.imager.views, self.imager.notes
        self._grouped = groups is not None and groups.max() > 0 and motion is None

    @cached_property
    def _expected(self) -> ThesisModel:
        """Return the renderer of the expected levels of the same surfaces, from which labels are derived."""
        return ThesisModel(ImageLaunch(self.tracer, self.views), self._rays_per_launch)

    @property
    def pings_per_launch(self) -> int:
        """Return the number of pings whose labels fit into a launch."""
        return self._expected.pings_per_launch

    def adopt(self, scene: mi.Scene) -> bool:
        """Take over the surface tables of a changed scene at rest; return False if the model must be rebuilt."""
        if self.imager.has_thin_shapes:  # their points stand in tables
            return False
        tables = [self.tracer.surfaces, *(one.surfaces for one in self.imager.tracers.values())]
        return all(one.adopt(surfaces_of(scene, self.imager.sonar, None)) for one in tables)

    def render(
        self, poses: NDArray[np.float64], time_s: NDArray[np.float64], numbers: list[int], labels: bool
    ) -> Iterator[list[RenderedPings]]:
        """Yield pings one at a time, one entry for each view.

        Raises:
            MitsonarError: labels of portions.
        """
        if labels and self.imager.sides != (0,):
            raise MitsonarError("portions have no labels in the model coherent: leave labels out, or use physical")
        for index, number in enumerate(numbers):
            pose, time = poses[index : index + 1], time_s[index : index + 1]
            # pings of one frame from a sonar at rest, in a scene at rest, have the same echoes
            again = self._grouped and index > 0 and bool((pose == poses[index - 1]).all())
            levels, counts, cut = self.imager.levels(pose[0], number, time[0], again=again)
            if labels:
                pings = next(self._expected.render(pose, time, [number], True))[0]
                left = net_loss(self.imager.sonar).astype(np.float32)[:, None]
                pings.levels, pings.expected, pings.cut = levels[None], pings.echoes * left, cut
            else:
                height_m = self.tracer.height_m(self.tracer.scene_at(time), self.tracer.inputs(pose, [number])[0])
                pings = RenderedPings(number, levels[None], counts, np.array(height_m, dtype=float), cut=cut)
            yield self.imager.in_views(pings)


class CoherentImager:
    """Renderer of a sonar's complex images: amplitudes relative to the source at 1 m, without the gain.

    Args:
        scene: any Mitsuba scene.
        sonar: a sonar of the model ``coherent``.
        mirrors: mirror parts of shapes, keyed by shape id, or ``"materials"``; default: none.
        views: the whole field of view or portions of it; default: the whole.
        motion: motion of the scene's bodies; default: nothing moves.
        groups: ping group of each beam ``(beams,)``, within which beams leak; default: those of the sonar.

    Attributes:
        sonar: as given.
        sampled: the sonar with a bin for each look.
        sides: sides of the elevation that are rendered separately: 0 for the whole view, +1 and -1 for portions.
        notes: warnings about scene and sonar.

    Raises:
        MitsonarError: a view is a receiver elsewhere or a cone; there are mirrors in portions; the gain is too large.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sonar: Sonar,
        mirrors: Mirroring = None,
        views: Sequence[View] | None = None,
        motion: SceneMotion | None = None,
        groups: NDArray[np.int64] | None = None,
    ) -> None:
        check_gain(sonar)
        self.views = check_views(views or [Whole(sonar)], mirrors)
        self.sides = tuple(dict.fromkeys(side_of(view) for view in self.views))
        self.sonar, self.sampled = sonar, sampled(sonar)
        self.former = BeamFormer(self.sampled)
        self.receiver = ReceiverNoise(self.sampled, self.former, sonar.looks, groups)
        self.tail = None if sonar.tail_db is None else EchoTail(self.sampled)
        self.crosstalk = crosstalk(sonar, groups)
        self._latest: list[tuple[NDArray[np.complex64], FieldCounts]] = []
        self._given = scene, mirrors, motion, groups
        parts = None if mirrors is None else mirror_of(scene, mirrors)
        self.tracers = {side: CoherentTracer(scene, self.sampled, self.former, parts, side, motion) for side in self.sides}
        self.tracer = self.tracers[self.sides[0]]
        self.glints = None if parts is None else MirrorTracer(scene, self.sampled, self.former, parts, motion=motion)
        several = parts is not None and sonar.bounces > 1
        self.ghosts = GhostTracer(self.tracer, parts) if several else None
        self.diffuse = DiffuseField(self.tracer) if sonar.bounces > 1 else None
        cornered = parts if several else None
        self.corners = None if cornered is None else CornerTracer(scene, self.sampled, self.former, cornered, motion=motion)
        self.notes = [*self.tracer.surfaces.notes, *point_notes(sonar), *loss_notes(sonar), *saturation_notes(sonar)]

    @property
    def has_thin_shapes(self) -> bool:
        """Return whether the scene has shapes whose points are listed once."""
        return any(tracer.thin_points is not None for tracer in self.tracers.values())

    def image(
        self, pose: NDArray[np.float64], ping: int, time_s: float = 0.0, *, again: bool = False
    ) -> tuple[NDArray[np.complex64], FieldCounts]:
        """Return the complex image of one ping ``(bins * looks, sides * beams)`` with its noise, and the counts of its rays.

        Args:
            pose: sonar pose ``(6,)`` [m, rad].
            ping: ping number, which determines the noise.
            time_s: time at which moving bodies are placed [s].
            again: use the echoes of the latest image, since neither sonar nor scene has moved; the noise is new.
        """
        if not again:
            self._latest = [self.echoes(pose, side, time_s) for side in self.sides]
        silent, counts = zip(*self._latest, strict=True)
        images = [self.receiver.add(image.copy(), ping, side) for image, side in zip(silent, self.sides, strict=True)]
        return np.concatenate(images, axis=1) if len(images) > 1 else images[0], FieldCounts.joined(counts)

    def echoes(
        self, pose: NDArray[np.float64], side: int | None = None, time_s: float = 0.0
    ) -> tuple[NDArray[np.complex64], FieldCounts]:
        """Return the complex image of the scene alone ``(bins * looks, beams)``, and the ray counts.

        The image has no noise, volume reverberation or stripes.

        Args:
            pose: sonar pose ``(6,)`` [m, rad].
            side: side of the elevation, one of :attr:`sides`; default: the first.
            time_s: time at which moving bodies are placed [s].
        """
        # field of the scatterers, then of mirror images and paths of several reflections
        field, counts = (self.tracer if side is None else self.tracers[side]).field(pose, time_s)
        for further in (self.glints, self.ghosts, self.corners, self.diffuse):
            if further is not None:
                further.add(pose, field, time_s)
        # beams and bins, absorption, tails, and the crosstalk of all beams; each look has the power of a whole bin
        image = self.former.beams(field) * self._loss[:, None]
        if self.tail is not None:
            image = self.tail.add(image)
        if self.crosstalk is not None:
            image = image + image @ self.crosstalk
        return np.asarray(image, dtype=np.complex64), counts

    def of_quality(self, quality: Quality) -> CoherentImager:
        """Return a renderer of the same scatterers with the number of rays of another quality."""
        scene, mirrors, motion, groups = self._given
        return CoherentImager(scene, self.sonar.replace(quality=quality), mirrors, motion=motion, groups=groups)

    def in_views(self, pings: RenderedPings) -> list[RenderedPings]:
        """Split pings of all :attr:`sides` ``(pings, bins, sides * beams)`` into one part for each view."""
        parts = []
        for view in self.views:
            first = self.sides.index(side_of(view)) * self.sonar.beams
            beams = view.beams if isinstance(view, Segment) else slice(0, self.sonar.beams)
            parts.append(replace(pings, levels=pings.levels[:, :, first + beams.start : first + beams.stop]))
        return parts

    def levels(
        self, pose: NDArray[np.float64], ping: int, time_s: float = 0.0, *, again: bool = False
    ) -> tuple[NDArray[np.float32], Counts, CutRays]:
        """Return the levels of one ping after gain ``(bins, sides * beams)`` float32, its ray counts, and its cut rays.

        Arguments as for :meth:`image`.
        """
        image, counts = self.image(pose, ping, time_s, again=again)
        power = image.real * image.real + image.imag * image.imag
        if self.sonar.looks > 1:
            power = power.reshape(self.sonar.range_bins, self.sonar.looks, -1).mean(axis=1)
        if self.sonar.detector_offset_db is not None:
            power = power + np.tile(self.receiver.offset, len(self.sides))
        rays = (np.array([[number]]) for number in (counts.inside, counts.nearer, counts.farther, counts.missed))
        return np.asarray(power * self.gain[:, None], dtype=np.float32), Counts(*rays), self._cut_rays(counts)

    def _cut_rays(self, counts: FieldCounts) -> CutRays:
        """Return the rays that missed points, if they are numerous enough to affect the image."""
        if counts.cut <= MOST_CUT * counts.inside:
            return CutRays()
        return CutRays(counts.cut, self.tracer.pitch * math.sqrt(1.1 * counts.widest / MOST_CANDIDATES))

    @cached_property
    def gain(self) -> NDArray[np.float32]:
        """Return the time-varying gain of levels ``(bins,)``."""
        return np.asarray(gain_of(self.sonar), dtype=np.float32)

    @cached_property
    def _loss(self) -> NDArray[np.float32]:
        """Return the two-way amplitude factor of absorption, times that of a look, ``(bins * looks,)``."""
        return np.asarray(np.sqrt(loss_of(self.sampled) * self.sonar.looks), dtype=np.float32)


def sampled(sonar: Sonar) -> Sonar:
    """Return the sonar with a bin for each look, and the same scatterers."""
    if sonar.looks == 1:
        return sonar
    return sonar.replace(
        looks=1,
        range_bins=sonar.range_bins * sonar.looks,
        pulse_m=None if sonar.pulse_m is None else sonar.pulse_m / sonar.looks,
        bandwidth_hz=None if sonar.bandwidth_hz is None else sonar.bandwidth_hz * sonar.looks,
        scatterers_per_cell=sonar.scatterers_per_cell / sonar.looks,
    )


def point_notes(sonar: Sonar) -> list[str]:
    """Return a warning if points are too sparse for speckle: a resolution cell should hold :data:`FEWEST_A_CELL`."""
    pitch = point_pitch(sonar)
    nearest = max(sonar.range_min, sonar.bin_m)
    points = nearest * sonar.beam_width_rad * sonar.resolution_m / pitch**2
    needed = math.sqrt(nearest * sonar.beam_width_rad * sonar.resolution_m / FEWEST_A_CELL)
    enough = FEWEST_A_CELL * pitch**2 / (sonar.beam_width_rad * sonar.resolution_m)
    if points >= FEWEST_A_CELL or (sonar.scatterer_spacing_m is None and enough <= sonar.range_max / 2):
        return []
    return [
        f"a resolution cell holds {points:.2g} points at {nearest:g} m, {FEWEST_A_CELL:g} from {enough:.3g} m on: below, "
        f"intensities vary more than speckle does; a scatterer_spacing_m of {needed:.2g} m is enough everywhere"
    ]


def check_gain(sonar: Sonar) -> None:
    """Check that levels after the time-varying gain fit single precision.

    Raises:
        MitsonarError: the gain is too large.
    """
    with np.errstate(divide="ignore"):
        largest = gain_of(sonar).max()
    if largest > np.finfo(np.float32).max:
        undone_db = 2 * sonar_absorption(sonar) * sonar.range_max
        raise MitsonarError(
            f"gain_absorption undoes {undone_db:.4g} dB there and back to range_max {sonar.range_max:g} m, more than levels "
            "can hold, 385 dB with the gain of spreading: lower range_max, or leave gain_absorption out"
        )


def check_views(views: Sequence[View], mirrors: Mirroring) -> Sequence[View]:
    """Return the views if each is the whole field of view, or a portion bounded by beams and the horizon.

    Raises:
        MitsonarError: a view is a receiver elsewhere or a cone; there are mirrors in portions.
    """
    for view in views:
        if not isinstance(view, Whole | Segment) or view.name in CONES:
            raise MitsonarError(
                f"the model coherent supports neither bistatic receivers nor cones: got {view.name}; render the whole view, "
                "a side or quadrants, or use the model physical"
            )
        if mirrors and side_of(view):
            raise MitsonarError(f"mirrors need the whole view: got {view.name}; leave mirrors out, or render the whole view")
    return views


def side_of(view: View) -> int:
    """Return the side of the elevation that a view shows: +1 up, -1 down, 0 both."""
    return (view.up or 0) if isinstance(view, Segment) else 0
