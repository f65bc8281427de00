"""Landmarks of a local map: points of the ground with the patches by which frames show them, and their observations."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.estimation.image.patches import COLUMNS, ROWS, Patches, PatchImage, align, corners, cut
from mitsonar.geometry.fan import Views, points_at, polar_of, projection_of
from mitsonar.instruments.sonar import Bearing
from mitsonar.mapping.bundle_adjustment import Observations

__all__ = ["Found", "ImageAxes", "Landmarks"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

PIXELS = len(ROWS)

ANCHOR = np.array([0.1, 0.08])
"""Standard deviation of where a new landmark is [bins, beams]: the noise of its patch."""

LEAST_ALIKE = 0.75
FARTHEST = np.array([8.0, 2.5])
"""Least correlation of a patch that was found, and how far from where it was looked for [bins, beams]."""

EDGE = np.array([9.0, 2.4])
"""Distance from the edge of the frame at which landmarks are looked for [bins, beams]."""

STALE = 0.92
"""Correlation below which a patch is cut anew."""

MISSED = 2
"""Keyframes in which a landmark may be missed before it is given up."""

FAULTY = 8.0
"""Mean squared error, in those of the usual one, beyond which a landmark is given up."""

BLOCKING = 4.0
"""Landmarks worse than this keep their place for a while, so that the same shadow is not chosen again."""

HEIGHT_STD_M = 0.3
"""Standard deviation of the height of a new landmark."""


@dataclass(frozen=True)
class ImageAxes:
    """Cells of the frames of a run: ranges [m] and bearings [rad] of their middles, and the kind of the bearings."""

    range_m: Array
    bearing_rad: Array
    bearing: Bearing

    def cells(self, polar: Array) -> Array:
        """Return row and column ``(..., 2)`` of range and bearing; beyond the last cells by the spacing there."""
        return np.stack([_place(polar[..., k], axis) for k, axis in enumerate(self._axes)], axis=-1)

    def polar(self, row: Array, column: Array) -> Array:
        """Return range and bearing ``(..., 2)`` of rows and columns."""
        places = (row, column)
        return np.stack([_value(place, axis) for place, axis in zip(places, self._axes, strict=True)], axis=-1)

    def spacing(self, polar: Array) -> Array:
        """Return the spacing of cells ``(n, 2)`` [m, rad] at range and bearing ``(n, 2)``."""
        return np.stack([np.interp(polar[:, k], axis, np.gradient(axis)) for k, axis in enumerate(self._axes)], axis=-1)

    @property
    def _axes(self) -> tuple[Array, Array]:
        return self.range_m, self.bearing_rad


class Found(NamedTuple):
    """Landmarks that a frame shows: number, range and bearing with covariance, correlation of the patch."""

    landmark: Index
    polar: Array
    covariance: Array
    correlation: Array

    def take(self, index: Index | NDArray[np.bool_]) -> Found:
        """Return some of them."""
        return Found(self.landmark[index], self.polar[index], self.covariance[index], self.correlation[index])


def _empty(*shape: int) -> Array:
    return np.zeros((0, *shape))


@dataclass
class Landmarks:
    """A table of landmarks, of those in use and of those that still hold the map's poses.

    Attributes:
        axes: of the frames.
        points: in metres over the ground ``(l, 3)``.
        covariance: of the points ``(l, 3, 3)``.
        offsets: of the patch's pixels from the point, level ``(l, pixels, 2)`` [m].
        patches: by which frames show them.
        used: whether they are still looked for ``(l,)``.
        faults: mean squared errors, in those of the usual one ``(l,)``.
        missed: keyframes since they were found ``(l,)``.
        born: keyframe in which they were chosen ``(l,)``.
        seen: observations in keyframes.
    """

    axes: ImageAxes
    points: Array = field(default_factory=lambda: _empty(3))
    covariance: Array = field(default_factory=lambda: _empty(3, 3))
    offsets: Array = field(default_factory=lambda: _empty(PIXELS, 2))
    patches: Patches = field(
        default_factory=lambda: Patches(np.zeros((0, PIXELS), np.float32), np.zeros((0, PIXELS), np.float32))
    )
    used: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    faults: Array = field(default_factory=_empty)
    missed: Index = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    born: Index = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    seen: Observations = field(
        default_factory=lambda: Observations(np.zeros(0, np.intp), np.zeros(0, np.intp), _empty(2), _empty(2, 2))
    )

    def find(self, image: PatchImage, view: Views) -> tuple[Found, int]:
        """Find the landmarks in a frame that a view is expected to have taken; and count those that it should show."""
        number = np.flatnonzero(self.used)
        if not len(number):
            return Found(number, _empty(2), _empty(2, 2), _empty()), 0
        middle = polar_of(self.points[number], view, self.axes.bearing)
        place = self.axes.cells(middle)
        inside = (np.abs(place - self._middle) < self._half).all(axis=1)
        number, middle = number[inside], middle[inside]
        pixels = np.concatenate([self.offsets[number], np.zeros((len(number), PIXELS, 1))], axis=2)
        cells = self.axes.cells(polar_of((self.points[number][:, None] + pixels).reshape(-1, 3), view, self.axes.bearing))
        cells = cells.reshape(len(number), PIXELS, 2)
        there = align(image, self.patches.take(number), cells[..., 0], cells[..., 1])
        good = (there.correlation > LEAST_ALIKE) & (np.abs(there.shift) < FARTHEST).all(axis=1)
        spacing = self.axes.spacing(middle)
        covariance = there.covariance * spacing[:, :, None] * spacing[:, None, :]
        found = Found(number, middle + there.shift * spacing, covariance, there.correlation)
        return found.take(good), len(number)

    @property
    def _middle(self) -> Array:
        size = [len(self.axes.range_m), len(self.axes.bearing_rad)]
        return np.asarray((np.array(size, dtype=np.float64) - 1) / 2)

    @property
    def _half(self) -> Array:
        return np.asarray(self._middle - EDGE)

    def observe(self, keyframe: int, found: Found) -> None:
        """Keep what a keyframe shows; give up landmarks that it misses again."""
        views = np.full(len(found.landmark), keyframe, dtype=np.intp)
        new = Observations(views, found.landmark, found.polar, found.covariance)
        self.seen = Observations(*(np.concatenate(pair) for pair in zip(self.seen, new, strict=True)))
        self.missed += self.used
        self.missed[found.landmark] = 0
        self.used &= self.missed < MISSED

    def give_up(self) -> None:
        """Look for none of the landmarks any more: the map is begun anew."""
        self.used[:] = False

    def renew(self, image: PatchImage, view: Views, found: Found) -> None:
        """Cut the patches anew of landmarks that look otherwise than when they were chosen."""
        old = found.take(found.correlation < STALE)
        if not len(old.landmark):
            return
        middle = self.axes.cells(old.polar)
        row, column = middle[:, :1] + ROWS, middle[:, 1:] + COLUMNS
        patches, inside = cut(image, row, column, self.patches.weights[old.landmark])
        offsets = self._offsets(old.polar, row, column, self.points[old.landmark, 2], view)
        good = inside & np.isfinite(offsets).all(axis=(1, 2))
        number = old.landmark[good]
        self.patches.values[number], self.offsets[number] = patches.values[good], offsets[good]

    def _offsets(self, middle: Array, row: Array, column: Array, height: Array, view: Views) -> Array:
        """Return where the pixels of patches lie beside their middles, on level ground ``(n, pixels, 2)`` [m]."""
        rows = np.broadcast_to(row, (len(middle), PIXELS))
        pixels = self.axes.polar(rows, np.broadcast_to(column, rows.shape)).reshape(-1, 2)
        ground = points_at(pixels, np.repeat(height, PIXELS), view, self.axes.bearing).reshape(-1, PIXELS, 3)
        return np.asarray((ground - points_at(middle, height, view, self.axes.bearing)[:, None])[..., :2])

    def choose(self, image: PatchImage, view: Views, keyframe: int, height_m: float) -> None:
        """Choose new landmarks where a keyframe shows none.

        Args:
            image: of the keyframe.
            view: that took it.
            keyframe: its number.
            height_m: of the new landmarks, until more frames show them.
        """
        row, column = corners(image, self._taken(view, keyframe))
        polar = self.axes.polar(row.astype(float), column.astype(float))
        rows, columns = row[:, None] + ROWS, column[:, None] + COLUMNS
        patches, good = cut(image, rows, columns)
        height = np.full(len(row), height_m)
        points = points_at(polar, height, view, self.axes.bearing)
        offsets = self._offsets(polar, rows, columns, height, view)
        good &= np.isfinite(points).all(axis=1) & np.isfinite(offsets).all(axis=(1, 2))
        if not good.any():
            return
        points, polar = points[good], polar[good]
        noise = self.axes.spacing(polar) * ANCHOR
        covariance = noise[:, :, None] ** 2 * np.eye(2)
        count, first = len(points), len(self.points)
        fresh = {
            "points": points,
            "covariance": self._covariance_of_new(points, view, covariance),
            "offsets": offsets[good],
            "used": np.ones(count, dtype=bool),
            "faults": np.ones(count),
            "missed": np.zeros(count, dtype=np.intp),
            "born": np.full(count, keyframe, dtype=np.intp),
        }
        for name, values in fresh.items():
            setattr(self, name, np.concatenate([getattr(self, name), values]))
        self.patches = Patches(*(np.concatenate(two) for two in zip(self.patches, patches.take(good), strict=True)))
        anchors = Observations(np.full(count, keyframe, dtype=np.intp), np.arange(first, first + count), polar, covariance)
        self.seen = Observations(*(np.concatenate(pair) for pair in zip(self.seen, anchors, strict=True)))

    def _covariance_of_new(self, points: Array, view: Views, covariance: Array) -> Array:
        """Return the covariance of new points: by range and bearing, and by the law of heights."""
        by_point = projection_of(points, view, self.axes.bearing).by_point
        information = by_point.transpose(0, 2, 1) @ np.linalg.inv(covariance) @ by_point
        information[:, 2, 2] += 1 / HEIGHT_STD_M**2
        return np.asarray(np.linalg.inv(information))

    def _taken(self, view: Views, keyframe: int) -> NDArray[np.bool_]:
        """Return the cells ``(bins, beams)`` of landmarks that are in use, or that were found to be bad of late."""
        taken = np.zeros((len(self.axes.range_m), len(self.axes.bearing_rad)), dtype=bool)
        there = self.used | ((self.faults > BLOCKING) & (self.born > keyframe - 25))
        if there.any():
            place = np.rint(self.axes.cells(polar_of(self.points[there], view, self.axes.bearing)))
            place = place[((place >= 0) & (place < taken.shape)).all(axis=1)].astype(np.intp)
            taken[place[:, 0], place[:, 1]] = True
        return taken

    def refine(self, number: Index, points: Array, covariance: Array, faults: Array) -> None:
        """Take what a bundle adjustment found for some landmarks; give up those that fit badly."""
        self.points[number], self.covariance[number], self.faults[number] = points, covariance, faults
        self.used[number] &= faults < FAULTY

    def forget(self, first_view: int) -> None:
        """Drop landmarks that are not in use and that no keyframe from ``first_view`` on shows: memory stays constant."""
        keep = self.used.copy()
        keep[self.seen.landmark[self.seen.view >= first_view]] = True
        if keep.all():
            return
        new = np.cumsum(keep) - 1
        seen = self.seen.take(keep[self.seen.landmark])
        self.seen = seen._replace(landmark=new[seen.landmark])
        for name in ("points", "covariance", "offsets", "used", "faults", "missed", "born"):
            setattr(self, name, getattr(self, name)[keep])
        self.patches = self.patches.take(keep)

    def holding(self, first_view: int, fewest: int, born: int) -> tuple[Index, Observations]:
        """Return landmarks that hold the keyframes from ``first_view`` on: their numbers, and all observations of them.

        Args:
            first_view: of the keyframes.
            fewest: keyframes that must show a landmark.
            born: keyframe before which landmarks do not count: the map was begun anew there.

        In these observations landmarks are numbered in this order.
        """
        times = np.bincount(self.seen.landmark, minlength=len(self.points))
        shown = np.zeros(len(self.points), dtype=bool)
        shown[self.seen.landmark[self.seen.view >= first_view]] = True
        number = np.flatnonzero(shown & (times >= fewest) & (self.born >= born))
        place = np.full(len(self.points), -1)
        place[number] = np.arange(len(number))
        seen = self.seen.take(place[self.seen.landmark] >= 0)
        return number, seen._replace(landmark=place[seen.landmark])


def _place(values: Array, axis: Array) -> Array:
    """Return where values stand on an increasing axis, in cells; beyond its ends by the spacing there."""
    cell = np.interp(values, axis, np.arange(len(axis), dtype=float))
    low, high = (values - axis[0]) / (axis[1] - axis[0]), (values - axis[-1]) / (axis[-1] - axis[-2]) + len(axis) - 1
    return np.asarray(np.where(values < axis[0], low, np.where(values > axis[-1], high, cell)))


def _value(place: Array, axis: Array) -> Array:
    """Return the value at a place on an axis, the inverse of :func:`_place`."""
    value = np.interp(place, np.arange(len(axis), dtype=float), axis)
    low, high = axis[0] + place * (axis[1] - axis[0]), axis[-1] + (place - len(axis) + 1) * (axis[-1] - axis[-2])
    return np.asarray(np.where(place < 0, low, np.where(place > len(axis) - 1, high, value)))
