"""What a model of a ping offers, which one a sonar has, and how frames of several pings are made with any of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.materials import check_image_mirrors
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar, group_of_beams, one_beam, scans, turned_heads
from mitsonar.instruments.views import View, Whole
from mitsonar.simulation.pings import Counts, CutRays, RenderedPings

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.simulation.mirrors import Mirroring
    from mitsonar.simulation.models.coherent import CoherentImager
    from mitsonar.simulation.moving import SceneMotion
    from mitsonar.simulation.tracing import Tracer

__all__ = ["GroupedPings", "PingModel", "create_model"]


class PingModel(Protocol):
    """Protocol of a renderer of pings: of one sonar in one scene, by one model.

    Attributes:
        tracer: tracer of the rays; its sonar may have a wider fan and window.
        views: images of each ping.
        notes: warnings about scene and sonar.
    """

    tracer: Tracer
    views: Sequence[View]
    notes: list[str]

    @property
    def imager(self) -> CoherentImager | None:
        """Return the renderer of complex images; None if the model has levels only."""

    @property
    def pings_per_launch(self) -> int:
        """Return the number of pings that fit into a launch."""

    def render(
        self, poses: NDArray[np.float64], time_s: NDArray[np.float64], numbers: list[int], labels: bool
    ) -> Iterator[list[RenderedPings]]:
        """Yield batches of consecutive pings, one entry for each view.

        Args:
            poses: sonar poses ``(pings, 6)``, or ``(pings, groups, 6)`` for groups of beams [m, rad].
            time_s: times of the poses ``(pings,)`` or ``(pings, groups)`` [s].
            numbers: numbers of the pings, which determine what is random.
            labels: whether to return per-pixel truth as well.

        Raises:
            MitsonarError: the model has no labels of these views.
        """

    def adopt(self, scene: mi.Scene) -> bool:
        """Take over the surface tables of a changed scene at rest; return False if the model must be rebuilt."""


def create_model(
    scene: mi.Scene,
    sonar: Sonar,
    views: Sequence[View] | None,
    mirrors: Mirroring,
    motion: SceneMotion | None,
    rays_per_launch: int,
) -> PingModel:
    """Create the model of a sonar's pings in a scene.

    One launch can trace each group of beams from its pose if beams are independent boxes. If a beam also receives rays of
    other beams, through its pattern or several reflections, all beams of the fan are formed at the pose of each group, and
    only those of the group are used. A scanning head has a single beam.

    Args:
        scene: any Mitsuba scene.
        sonar: the instrument; its ``model`` names the model.
        views: images of each ping; default: one of all echoes.
        mirrors: mirror parts of shapes.
        motion: motion of the scene's bodies; None if nothing moves.
        rays_per_launch: upper bound on the rays of a launch and on its image cells.

    Raises:
        MitsonarError: the model has no mirrors or none of these views; bodies move, or beams ping in groups, with receivers
            elsewhere or portions of the field of view; a mirror moves.
    """
    # 1. Reject views and mirrors that do not support the model, moving bodies or groups of beams.
    feature = "moving bodies" if motion is not None else "ping groups" if sonar.ping_groups > 1 else ""
    check_image_mirrors(sonar, views, bool(mirrors))
    if feature and any(not isinstance(view, Whole) for view in views or ()):
        raise MitsonarError(f"bistatic receivers and portions do not support {feature}: render the whole view")
    if mirrors and motion is not None:
        from mitsonar.simulation.mirrors import refuse_moving_mirrors

        refuse_moving_mirrors(scene, mirrors, motion.bodies.shapes)
    # 2. Find the sonar of one ping of a group, unless one launch traces all groups.
    single_launch = sonar.ping_groups == 1 or (sonar.beam_pattern == "box" and sonar.bounces == 1)
    ping_sonar = sonar if single_launch else one_beam(sonar) if scans(sonar) else sonar.replace(ping_groups=1)
    # 3. Create its model; what other models need is not imported.
    model: PingModel
    if sonar.model == "coherent":
        from mitsonar.simulation.models.coherent import CoherentModel

        groups = None if scans(sonar) else group_of_beams(sonar)
        model = CoherentModel(scene, ping_sonar, views, mirrors, motion, rays_per_launch, groups)
    elif sonar.model == "physical":
        from mitsonar.simulation.models.physical import PhysicalModel

        model = PhysicalModel(scene, ping_sonar, views, mirrors, motion, rays_per_launch)
    else:
        from mitsonar.simulation.models.thesis import ImageLaunch, ThesisModel
        from mitsonar.simulation.tracing import tracer_of

        shown = [Whole(ping_sonar)] if views is None else views
        model = ThesisModel(ImageLaunch(tracer_of(scene, ping_sonar, motion), shown), rays_per_launch)
    return model if single_launch else GroupedPings(model, sonar)


class GroupedPings:
    """Renderer of frames in which every group of beams is a separate ping of another model.

    Implements :class:`PingModel`.

    Args:
        inner: model of the pings of one group.
        sonar: the sonar with groups of beams.
    """

    def __init__(self, inner: PingModel, sonar: Sonar) -> None:
        self.inner, self.sonar = inner, sonar
        self.tracer, self.views, self.notes = inner.tracer, inner.views, inner.notes

    @property
    def imager(self) -> CoherentImager | None:
        """Return the renderer of complex images of one ping; None if the model has levels only."""
        return self.inner.imager

    @property
    def pings_per_launch(self) -> int:
        """Return the number of pings, each of one group, that fit into a launch."""
        return self.inner.pings_per_launch

    def adopt(self, scene: mi.Scene) -> bool:
        """Take over the surface tables of a changed scene at rest; return False if the model must be rebuilt."""
        return self.inner.adopt(scene)

    def render(
        self, poses: NDArray[np.float64], time_s: NDArray[np.float64], numbers: list[int], labels: bool
    ) -> Iterator[list[RenderedPings]]:
        """Yield frames one at a time; see :meth:`PingModel.render`."""
        groups = self.sonar.ping_groups
        heads = turned_heads(self.sonar, poses) if scans(self.sonar) else poses
        for index, number in enumerate(numbers):
            parts = range(number * groups, (number + 1) * groups)
            batches = self.inner.render(heads[index], time_s[index], list(parts), labels)
            yield [self._joined([batch[0] for batch in batches], number)]

    def _joined(self, parts: list[RenderedPings], number: int) -> RenderedPings:
        """Join the pings of a frame's groups into one frame, taking each beam from the ping of its group."""
        group = group_of_beams(self.sonar)
        beam = np.zeros_like(group) if scans(self.sonar) else np.arange(self.sonar.beams)

        def chosen(images: list[Any]) -> NDArray[Any]:
            return np.ascontiguousarray(np.concatenate(images)[group, :, beam].T[None])

        counts = (
            np.concatenate([getattr(part.counts, name) for part in parts])
            for name in ("inside", "nearer", "farther", "missed")
        )
        height_m = np.concatenate([part.height_m for part in parts])
        return RenderedPings(
            number,
            chosen([part.levels for part in parts]),
            Counts(*(self._of_beams(count, group, beam) for count in counts)),
            height_m[len(height_m) // 2 :][:1],
            {name: chosen([part.labels[name] for part in parts]) for name in parts[0].labels},
            None if parts[0].expected is None else chosen([part.expected for part in parts]),
            CutRays(sum(part.cut.rays for part in parts), max(part.cut.enough_m for part in parts)),
        )

    def _of_beams(self, count: NDArray[np.int64], group: NDArray[np.int64], beam: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the ray counts of the frame's beams, or their total if the pings do not count rays for each beam."""
        beams = 1 if scans(self.sonar) else self.sonar.beams
        margin = (count.shape[1] - beams) // 2  # boxes traced on each side of the fan
        if margin < 0:
            return np.asarray([[count.sum()]])
        return np.asarray(count[group, beam + margin][None])
