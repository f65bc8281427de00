"""Poses and times of pings as a simulator takes them, and frames whose groups of beams are rendered ping by ping."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.materials import check_image_mirrors
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar, group_of_beams, one_beam, scans, turned_heads
from mitsonar.instruments.views import View, Whole
from mitsonar.motion.pose import refuse_beyond_reach
from mitsonar.simulation.binning import Counts
from mitsonar.simulation.rendered_pings import CutRays, RenderedPings

__all__ = ["FirstPing", "GroupedPings", "check_timed", "moments_of", "sonar_of_one_ping"]


FirstPing: TypeAlias = int | Sequence[int]
"""Number of the first of consecutive pings, or of each ping."""


class OnePing(Protocol):
    """Renders pings, each at one moment."""

    def pings(
        self, poses: ArrayLike, *, first: FirstPing = 0, labels: bool = False, time_s: ArrayLike | None = None
    ) -> Iterator[RenderedPings]:
        """Levels of consecutive pings, in batches."""


def moments_of(
    sonar: Sonar, poses: ArrayLike, time_s: ArrayLike | None, first: FirstPing
) -> tuple[NDArray[np.float64], NDArray[np.float64], list[int]]:
    """Return poses and times of pings, both with an axis for groups of beams where there are several, and their numbers.

    Args:
        sonar: the instrument.
        poses: ``(frames, 6)``, which hold for all groups of a frame, or ``(frames, groups, 6)`` [m, rad].
        time_s: ``(frames,)`` or ``(frames, groups)`` [s]; default: the number of the frame / ``frame_rate_hz``.
        first: number of the first frame, or of each.

    Raises:
        MitsonarError: another shape, numbers that are not finite, or too large ones.
    """
    table, groups = np.atleast_2d(np.asarray(poses, dtype=float)), sonar.ping_groups
    shapes = [(len(table), 6)] + ([(len(table), groups, 6)] if groups > 1 else [])
    if table.shape not in shapes or not len(table) or not np.isfinite(table).all():
        known = "(frames, 6)" if groups == 1 else f"(frames, 6) or (frames, {groups}, 6)"
        raise MitsonarError(f"poses must be finite numbers {known}: got {table.shape}; give m and rad")
    refuse_beyond_reach(table)
    numbers = (
        [first + place for place in range(len(table))]
        if isinstance(first, int | np.integer)
        else [int(number) for number in first]
    )
    if len(numbers) != len(table) or min(numbers) < 0:
        raise MitsonarError(f"pings need a number of 0 or more each, {len(table)} of them: got {len(numbers)}")
    time = np.array(numbers) / sonar.frame_rate_hz if time_s is None else np.asarray(time_s, dtype=float)
    if time.shape not in [shape[:-1] for shape in shapes] or not np.isfinite(time).all():
        raise MitsonarError(f"times must be finite numbers, one for each pose {table.shape[:-1]}: got {time.shape}; give s")
    if groups == 1:
        return table, time, numbers
    table = table if table.ndim == 3 else np.repeat(table[:, None], groups, axis=1)
    return table, time if time.ndim == 2 else np.repeat(time[:, None], groups, axis=1), numbers


def sonar_of_one_ping(sonar: Sonar) -> Sonar | None:
    """Return the sonar whose pings make up the frames; None where one launch traces all groups, each from its own pose.

    That is so where the beams are apart: boxes. Where each beam is formed of more than its own rays, or hears those of
    others by way of several reflections, all beams of the fan are formed at each group's pose, and those of the group are
    kept. A head that turns has one beam.
    """
    if sonar.ping_groups == 1 or (sonar.beam_pattern == "box" and sonar.bounces == 1):
        return None
    return one_beam(sonar) if scans(sonar) else sonar.replace(ping_groups=1)


def check_timed(sonar: Sonar, moving: object, views: Sequence[View] | None, mirrors: object) -> None:
    """Refuse what has no bodies that move, and no groups of beams.

    Raises:
        MitsonarError: receivers elsewhere or portions; mirrors in a model without them.
    """
    what = "bodies that move" if moving else "ping groups" if sonar.ping_groups > 1 else ""
    check_image_mirrors(sonar, views, bool(mirrors))
    if what and any(not isinstance(view, Whole) for view in views or ()):
        raise MitsonarError(f"receivers elsewhere and portions have no {what}: render the whole view")


class GroupedPings:
    """Frames whose groups of beams are pings of their own.

    Args:
        inner: renders the pings of the sonar of :func:`sonar_of_one_ping`.
        sonar: with groups.
    """

    def __init__(self, inner: OnePing, sonar: Sonar) -> None:
        self.inner, self.sonar = inner, sonar

    def pings(
        self, poses: NDArray[np.float64], time_s: NDArray[np.float64], numbers: list[int], labels: bool
    ) -> Iterator[RenderedPings]:
        """Levels of frames, one at a time; arguments as :func:`moments_of` returns them."""
        groups = self.sonar.ping_groups
        heads = turned_heads(self.sonar, poses) if scans(self.sonar) else poses
        for place, number in enumerate(numbers):
            made = self.inner.pings(heads[place], first=number * groups, labels=labels, time_s=time_s[place])
            yield self._joined(list(made), number)

    def _joined(self, parts: list[RenderedPings], number: int) -> RenderedPings:
        """Return the pings of a frame's groups as one frame: each beam from the ping of its group."""
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
        """Return numbers of rays of the frame's beams, or of all where the pings do not tell them beam by beam."""
        if count.shape[1] == (1 if scans(self.sonar) else self.sonar.beams):
            return np.asarray(count[group, beam][None])
        return np.asarray([[count.sum()]])
