"""Image sources: a transmitter or receiver behind mirrors, for each sequence of planes that sound meets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.simulation.mirror_planes import MirrorPlane

__all__ = ["ROW", "MirrorWay", "mirror_ways", "mirrored_table"]

ROW = 10
"""Numbers of a plane in :meth:`MirrorWay.rows`; the registry index of its shape is one more."""


MOST_WAYS = 20_000
"""Ways of one number of planes, at most: some 1 ms each, ping and receiver."""


@dataclass(frozen=True)
class MirrorWay:
    """Planes that sound meets one after another on its way from (or, backwards, to) a transducer; none: the direct way."""

    planes: tuple[MirrorPlane, ...] = ()

    @property
    def name(self) -> str:
        """Return the names of the mirrors from the transducer on, as ``surface-seabed``."""
        return "-".join(plane.name for plane in self.planes)

    def images(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the transducer and its images, one more mirror each ``(planes + 1, 3)`` [m]."""
        places = [np.asarray(place, dtype=float)]
        for plane in self.planes:
            last = places[-1]
            places.append(last - 2 * (plane.normal @ last - plane.offset) * plane.normal)
        return np.stack(places)

    @property
    def turn(self) -> NDArray[np.float64]:
        """Return the matrix that mirrors vectors of the transducer, such as its velocity ``(3, 3)``."""
        turn = np.eye(3)
        for plane in self.planes:
            turn = turn - 2 * np.outer(plane.normal, plane.normal @ turn)
        return turn

    def rows(self, place: NDArray[np.float64], registry: dict[int, int]) -> NDArray[np.float64]:
        """Return what tests of the way need ``(planes, 11)``.

        A row holds the image before the plane, normal, offset, reflection, roughness, slab and registry index of the shape.

        Args:
            place: of the transducer [m].
            registry: index of each mirror by its place in the scene.
        """
        images = self.images(place)
        return np.array(
            [
                [
                    *(*image, *plane.normal, plane.offset),
                    *(plane.reflection, plane.roughness_m, plane.slab_m, registry[plane.shape]),
                ]
                for image, plane in zip(images[:-1], self.planes, strict=True)
            ]
        ).reshape(-1, ROW + 1)


def mirror_ways(planes: Sequence[MirrorPlane], length: int) -> list[MirrorWay]:
    """Return all sequences of ``length`` planes in which none follows itself.

    Raises:
        MitsonarError: more than :data:`MOST_WAYS`.
    """
    count = len(planes) * (len(planes) - 1) ** (length - 1) if length else 1
    if count > MOST_WAYS:
        raise MitsonarError(
            f"sound may meet the {len(planes)} planes of the mirrors in {count:,} orders of {length}: at most {MOST_WAYS:,} "
            "are traced; give fewer mirrors, or fewer bounces"
        )
    ways: list[tuple[MirrorPlane, ...]] = [()]
    for _ in range(length):
        ways = [(*way, plane) for way in ways for plane in planes if not way or way[-1] is not plane]
    return [MirrorWay(way) for way in ways]


def mirrored_table(
    table: NDArray[np.float64], out: MirrorWay, back: MirrorWay, registry: dict[int, int]
) -> NDArray[np.float64]:
    """Return the geometry of a link by way of mirrors: :func:`~mitsonar.simulation.link_geometry.link_table` of the images.

    Places, velocities and fields of view are those of the images; the rows of both ways follow.

    Args:
        table: of the link itself ``(30,)``.
        out: from the transmitter to the points.
        back: from the receiver to the points, backwards in time.
        registry: see :meth:`MirrorWay.rows`.
    """
    places = out.images(table[0:3])[-1], back.images(table[3:6])[-1]
    velocities = out.turn @ table[6:9], back.turn @ table[9:12]
    axes = table[12:21].reshape(3, 3) @ back.turn.T, table[21:30].reshape(3, 3) @ out.turn.T
    rows = out.rows(table[0:3], registry), back.rows(table[3:6], registry)
    return np.concatenate([*places, *velocities, *(part.ravel() for part in (*axes, *rows))])
