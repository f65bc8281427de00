"""Where the sonar of an imported scene stands: a few metres from its objects, not from its ground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.worlds.meshes import Piece, overview
from mitsonar.worlds.world import Standpoint

__all__ = ["ImportedView", "view_of_objects"]

Point: TypeAlias = NDArray[np.float64]
Groups: TypeAlias = Mapping[str, Sequence[Piece]]

REACH = {"didson300": 15.0, "oculus-m1200d-1200khz": 40.0}
"""Farthest range at which each preset is used [m], within the limits of its instrument; the nearest first."""

NEAREST_M = 1.0
"""The sonar keeps this distance [m]."""

PART_M = 1.2
"""Radius of the part that is looked at where no shape fits [m]."""

FLAT, LOW, WIDE = 1e-3, 0.2, 0.5
"""Ground is flat, or low and wide: height over diagonal, and part of the area of all shapes."""

TURNS_DEG = (0, 45, -45, 90, -90, 135, -135, 180)
"""Directions that are tried, about the vertical; 0 looks along +y."""

TRIANGLES = 2**17
"""Triangles that a ray meets at once, a bound of memory."""


class ImportedView(NamedTuple):
    """What the sonar looks at.

    Attributes:
        stand: of the sonar.
        about: what it sees, in words.
        part: whether no shape fits, so that it sees a part of one.
    """

    stand: Standpoint
    about: str
    part: bool


def view_of_objects(groups: Groups) -> ImportedView:
    """Return the view of all objects, of the largest one that a sonar takes in, or of a part.

    Args:
        groups: the geometries of each shape, in the axes of the world [m].
    """
    boxes = {name: _box(pieces) for name, pieces in groups.items()}
    objects = {name: box for name, box in boxes.items() if not _is_ground(box, _union(list(boxes.values())))}
    objects = objects or boxes
    whole = _union(list(objects.values()))
    fitting = {name: box for name, box in objects.items() if _fits(box)}
    if _fits(whole):
        chosen, what = whole, next(iter(objects)) if len(objects) == 1 else f"all {len(objects)} shapes"
    elif fitting:
        what = max(fitting, key=lambda name: _radius(fitting[name]))
        chosen = fitting[what]
    else:
        name = max(objects, key=lambda one: _radius(objects[one]))
        chosen, what = _part(groups[name], objects[name]), f"a part of {name}"
    stand, away = _clear_view(groups, chosen)
    return ImportedView(stand, f"the sonar looks at {what[:80]} from {away:.3g} m", not (_fits(whole) or fitting))


def _box(pieces: Sequence[Piece]) -> Point:
    """Return the lowest and the highest corner of geometries ``(2, 3)`` [m]."""
    corners = np.concatenate([piece.vertices[np.unique(piece.faces)] for piece in pieces])
    return np.array([corners.min(axis=0), corners.max(axis=0)])


def _union(boxes: Sequence[Point]) -> Point:
    return np.array([np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)])


def _radius(box: Point) -> float:
    return max(float(np.linalg.norm(box[1] - box[0])) / 2, 0.05)


def _fits(box: Point) -> bool:
    """Return whether a sonar of :data:`REACH` takes it in."""
    return _overview(box).window[1] <= max(REACH.values())


def _overview(box: Point) -> Standpoint:
    low, high = box
    foot = (*(low + high)[:2] / 2, low[2])
    return overview(_radius(box), float(high[2] - low[2]), foot, nearest=NEAREST_M)


def _is_ground(box: Point, whole: Point) -> bool:
    """Return whether a shape is flat and level, or low and as wide as half of the scene."""
    edges, all_edges = box[1] - box[0], whole[1] - whole[0]
    across = float(np.linalg.norm(edges[:2]))
    wide = edges[0] * edges[1] >= WIDE * all_edges[0] * all_edges[1]
    return bool(edges[2] <= FLAT * across or (wide and edges[2] < LOW * across))


def _part(pieces: Sequence[Piece], box: Point) -> Point:
    """Return the box around the place that a ray along the view, through the middle, meets first."""
    middle, along = box.mean(axis=0), _forward(0)
    begin = middle - 2 * _radius(box) * along
    met = begin + _first_hit(pieces, begin, along) * along
    centre = met if np.isfinite(met).all() else middle
    return np.array([centre - PART_M / np.sqrt(3), centre + PART_M / np.sqrt(3)])


def _clear_view(groups: Groups, box: Point) -> tuple[Standpoint, float]:
    """Return the view of a box from the first direction without anything before it, and its distance [m]."""
    base = _overview(box)
    target = np.array(base.target)
    away = float(np.linalg.norm(target - np.array(base.origin)))
    preset = next((name for name, reach in REACH.items() if base.window[1] <= reach), list(REACH)[-1])
    everything = [piece for pieces in groups.values() for piece in pieces]
    origins = [target - away * _forward(turn) for turn in TURNS_DEG]
    clear = (
        origin
        for origin, turn in zip(origins, TURNS_DEG, strict=True)
        if _first_hit(everything, origin, _forward(turn)) >= base.window[0]
    )
    x, y, z = (float(value) for value in next(clear, origins[0]))
    return Standpoint((x, y, z), base.target, base.window, preset), away


def _forward(turn_deg: float) -> Point:
    """Return the direction of a view 30 deg down, turned about the vertical."""
    turn, down = np.radians(turn_deg), np.radians(30)
    return np.array([np.sin(turn) * np.cos(down), np.cos(turn) * np.cos(down), -np.sin(down)])


def _first_hit(pieces: Sequence[Piece], origin: Point, along: Point) -> float:
    """Return the distance at which a ray meets triangles first [m], inf where it meets none (Moeller, Trumbore 1997)."""
    nearest = np.inf
    for piece in pieces:
        for first in range(0, len(piece.faces), TRIANGLES):
            corner, second, third = np.moveaxis(piece.vertices[piece.faces[first : first + TRIANGLES]], 1, 0)
            one, other = second - corner, third - corner
            normal = np.cross(along, other)
            volume = (one * normal).sum(axis=1)
            with np.errstate(divide="ignore", invalid="ignore"):
                since = origin - corner
                u = (since * normal).sum(axis=1) / volume
                across = np.cross(since, one)
                v = across @ along / volume
                distance = (other * across).sum(axis=1) / volume
                hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
            nearest = min(nearest, float(distance[hit].min(initial=np.inf)))
    return nearest
