"""The mosaic: frames and a path become a map of the level ground.

Each cell holds the mean level, its standard deviation over the frames, and the number of frames (Almanza-Medina, 2.3.3 and
3.5.1; the blend ``weighted`` is our own).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, argument, counted, nearest_names
from mitsonar.geometry.ground import moved
from mitsonar.mapping.frame_footprint import (
    LONGEST_SIDE,
    RAYS,
    FrameFan,
    band_limited,
    checked_heights,
    checked_poses,
    fan_of,
    fractional_index,
    from_middle,
    ground_outline,
    levels_of,
    middle_beams,
    poses_and_heights,
    squared_span,
)
from mitsonar.mapping.map_cells import Box, CellSums, accumulate, box_around, with_slack
from mitsonar.records.frames import SonarFrames

__all__ = ["Blend", "Mosaic", "build_mosaic"]
Array = NDArray[np.float64]
Floats = NDArray[np.float32]

Blend = Literal["weighted", "centre"]

CENTRE_BEAMS = 24
"""Beams in the middle of the fan that Almanza-Medina draws (3.5.1)."""

MOST_CELLS = 2**25
"""Largest number of cells by default: 58 x 58 m in cells of 10 mm, 20 bytes each."""

SLACK = 0.25
"""Part of its size by which a map grows at least, so that long runs do not copy it at every frame."""

LEAST_WEIGHT = 1e-3
"""Smaller weights count as 0: bins at the outline are half in the dark, and may be the only ones of their cell."""

ONE_ALONE = 1e-3
"""Part of a cell's weight W that W - sum w^2 / W must exceed for a standard deviation: float32 loses smaller ones."""


class Mosaic:
    """A map of the level plane below the sonar, to which frames are added. It grows where frames need it.

    Cells are squares. Their edges lie on whole multiples of ``cell_m`` in the world, so that maps of one cell size fit
    together. A cell takes the value of each frame at its own (range, bearing), bilinear between the centres of bins and
    beams, with the exact geometry over level ground (:class:`mitsonar.geometry.ground.GroundGeometry`). Only ground
    within the window, the beams and the elevation field of view is updated. There a pixel of 0 counts: a shadow is dark.
    Relief is not modelled: objects that rise from the ground are mapped too near.

    Args:
        cell_m: edge of a cell [m].
        blend: ``weighted``: all beams, with weights cos^2 that fall to 0 at the edges of the fan in bearing and in range;
            ``centre``: the plain mean of the ``centre_beams`` in the middle (Almanza-Medina, 3.5.1).
        centre_beams: for ``centre``.
        most_cells: largest number of cells.
        illumination: of :func:`mitsonar.mapping.illumination.illumination` ``(bins, beams)``. Images are divided by it, so
            that the fall-off of the level with range neither shades the map nor adds to the standard deviation. Levels may
            then exceed 1.

    Raises:
        MitsonarError: an argument outside its limits.
    """

    def __init__(
        self,
        cell_m: float = 0.01,
        blend: Blend = "weighted",
        *,
        centre_beams: int = CENTRE_BEAMS,
        most_cells: int = MOST_CELLS,
        illumination: Floats | None = None,
    ) -> None:
        if not (math.isfinite(cell_m) and cell_m > 0):
            raise MitsonarError(f"{argument('cell_m')} must be above 0: got {cell_m:g} m; 0.01 m suits range bins of 5 mm")
        if blend not in get_args(Blend):
            raise MitsonarError(f"unknown blend {blend!r}: {nearest_names(blend, get_args(Blend))}")
        if centre_beams < 2 or most_cells < 1:
            raise MitsonarError(
                f"{argument('centre_beams')} must be at least 2 and {argument('most_cells')} at least 1: got {centre_beams} "
                f"and {most_cells:,}"
            )
        if illumination is not None and not (np.isfinite(illumination).all() and np.all(illumination > 0)):
            raise MitsonarError("an illumination must be finite and above 0 everywhere: take it from `illumination`")
        self.cell_m, self.blend, self.centre_beams, self.most_cells = float(cell_m), blend, centre_beams, most_cells
        self.illumination = illumination
        self.frames = 0
        """Frames added."""
        self.frames_without_ground = 0
        """How many of them showed no ground: height unknown (nan), or ground beyond the window or the field of view."""
        self._box = Box(0, 0, 0, 0)
        self._sums = np.zeros((len(CellSums._fields), 0, 0), np.float32)

    # ------------------------------------------------------------ frames in

    def reserve(self, frames: SonarFrames, poses: ArrayLike, height_m: ArrayLike) -> None:
        """Allocate the map for all frames of a run before the first is read; of ``frames`` only the sonar is used.

        Args:
            frames: any frames of the run, one or more.
            poses: of the sonar in the whole run ``(n, 6)`` [m, rad].
            height_m: over the ground ``(n,)`` or one for all [m].

        Raises:
            MitsonarError: the map would exceed ``most_cells``.
        """
        table = checked_poses(poses)
        heights = checked_heights(height_m, len(table))
        boxes = [self._footprint(fan_of(frames, pose, height), pose) for pose, height in zip(table, heights, strict=True)]
        known = [box for box in boxes if box is not None]
        if known:
            self._make_room(box_around(known), slack=0.0)

    def add(
        self,
        frames: SonarFrames,
        poses: ArrayLike | None = None,
        height_m: ArrayLike | None = None,
        *,
        whole: ArrayLike = False,
    ) -> None:
        """Add frames to the map.

        Args:
            frames: some frames of the run.
            poses: of the sonar, one a frame ``(frames, 6)`` [m, rad]; default: those of the frames.
            height_m: over the ground ``(frames,)`` or one for all [m]; default: those of the frames.
            whole: frames that are added with all beams, whatever the blend ``(frames,)``, or one for all.

        Raises:
            MitsonarError: no poses or heights, numbers that do not fit, or a map beyond ``most_cells``.
        """
        images = self._flat(levels_of(frames))
        table, heights = poses_and_heights(frames, poses, height_m)
        if np.shape(whole) not in ((), (len(frames),)):
            raise MitsonarError(f"whole must be one truth, or one for each of {len(frames)} frames: got {np.shape(whole)}")
        entire = np.broadcast_to(np.asarray(whole, dtype=bool), len(frames))
        for image, pose, height, all_beams in zip(images, table, heights, entire, strict=True):
            fan = fan_of(frames, pose, height)
            self.frames += 1
            if self.blend == "centre" and not all_beams:
                fan, image = middle_beams(fan, image, self.centre_beams)
            if not self._lay(image, fan, pose):
                self.frames_without_ground += 1

    def _flat(self, images: Floats) -> Floats:
        """Divide images ``(frames, bins, beams)`` by the illumination."""
        if self.illumination is None:
            return images
        if self.illumination.shape != images.shape[1:]:
            raise MitsonarError(
                f"the illumination must be (bins, beams) = {images.shape[1:]} as the images: got {self.illumination.shape}"
            )
        return np.asarray(images / self.illumination.astype(np.float32))

    def _lay(self, image: Floats, fan: FrameFan, pose: Array) -> bool:
        """Add one image ``(bins, beams)``; return whether it showed any ground."""
        box = self._footprint(fan, pose)
        if box is None:
            return False
        self._make_room(box, slack=SLACK)
        points = self._points(box, pose)
        radius, bearing = fan.ground.to_polar(points)
        weight = self._weights(fan, points, radius, bearing)
        if not weight.any():
            return False
        rows, columns = fractional_index(radius, fan.ground.range_m), fractional_index(bearing, fan.ground.bearing_rad)
        image = band_limited(image, squared_span(rows, weight), squared_span(columns, weight))
        value = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        accumulate(self._patch(box), np.asarray(value), weight)
        return True

    def _points(self, box: Box, pose: Array) -> Floats:
        """Return the centres of cells ``(rows, columns, 2)`` in the sonar's heading axes [m], as float32."""
        x = (np.arange(box.west, box.east) + 0.5) * self.cell_m - pose[0]
        y = (np.arange(box.south, box.north) + 0.5) * self.cell_m - pose[1]
        about = np.stack(np.meshgrid(x.astype(np.float32), y.astype(np.float32)), axis=-1)
        return np.asarray(moved(about, (0.0, 0.0, pose[5])))

    def _weights(self, fan: FrameFan, points: Floats, radius: Floats, bearing: Floats) -> Floats:
        """Return the weight of each cell ``(rows, columns)``; 0 where the frame does not show it."""
        across = from_middle(bearing, *fan.sector)
        elevation = from_middle(fan.ground.elevation(points), -fan.half_elevation, fan.half_elevation)
        along = np.maximum(elevation, from_middle(radius, *fan.window))
        inside = (across < 1) & (along < 1)
        if self.blend == "centre":
            return inside.astype(np.float32)
        quarter = np.float32(np.pi / 2)
        taper = np.square(np.cos(quarter * across) * np.cos(quarter * along))
        return np.asarray(np.where(inside & (taper > LEAST_WEIGHT), taper, np.float32(0)))

    def _footprint(self, fan: FrameFan, pose: Array) -> Box | None:
        """Return the box around the ground that a frame can show; None where there is none."""
        reach = ground_outline(fan)
        if reach is None:
            return None
        turned = moved(reach, (0.0, 0.0, -pose[5])) + pose[:2]
        margin = self.cell_m + fan.window[1] * (1 - math.cos(np.ptp(fan.sector) / (RAYS - 1) / 2))  # arcs bulge between rays
        west, south = np.floor((turned.min(axis=0) - margin) / self.cell_m).astype(int)
        east, north = np.ceil((turned.max(axis=0) + margin) / self.cell_m).astype(int)
        return Box(int(south), int(north), int(west), int(east))

    # ------------------------------------------------------------ the map

    def _patch(self, box: Box) -> CellSums:
        """Return the sums of some cells, not copied."""
        south, west = box.south - self._box.south, box.west - self._box.west
        rows, columns = box.shape
        return CellSums(*self._sums[:, south : south + rows, west : west + columns])

    def _make_room(self, box: Box, slack: float) -> None:
        """Grow the map to hold a box."""
        new = box_around([self._box, box]) if self._sums.size else box
        if new == self._box:
            return
        cells = math.prod(new.shape)
        if cells > self.most_cells or max(box.shape) > LONGEST_SIDE:
            raise MitsonarError(self._too_large(new, cells))
        room = with_slack(self._box, new, slack)
        new = room if math.prod(room.shape) <= self.most_cells else new
        sums = np.zeros((len(self._sums), *new.shape), np.float32)
        south, west = self._box.south - new.south, self._box.west - new.west
        rows, columns = self._box.shape
        if self._sums.size:
            sums[:, south : south + rows, west : west + columns] = self._sums
        self._box, self._sums = new, sums

    def _too_large(self, box: Box, cells: int) -> str:
        rows, columns = box.shape
        fits = max(self.cell_m * math.sqrt(cells / self.most_cells), self.cell_m * max(rows, columns) / LONGEST_SIDE)
        fits = math.ceil(fits * 1.02 * 1e4) / 1e4
        return (
            f"the map would have {rows:,} x {columns:,} cells of {1e3 * self.cell_m:g} mm, for {rows * self.cell_m:.4g} x "
            f"{columns * self.cell_m:.4g} m; at most {self.most_cells:,} are allowed: use cells of {1e3 * fits:g} mm, raise "
            "most_cells (20 bytes each), or look for a pose that is wrong"
        )

    @property
    def state_bytes(self) -> int:
        """Return the memory of the map [bytes]."""
        return self._sums.nbytes

    @property
    def covered(self) -> Box:
        """Return the smallest box around all cells that frames show.

        Raises:
            MitsonarError: no frame shows ground.
        """
        seen = self._sums[CellSums._fields.index("seen")] > 0
        if not seen.any():
            raise MitsonarError(self._empty())
        rows, columns = (np.flatnonzero(seen.any(axis=axis)) for axis in (1, 0))
        south, west = self._box.south, self._box.west
        return Box(south + int(rows[0]), south + int(rows[-1]) + 1, west + int(columns[0]), west + int(columns[-1]) + 1)

    def check_not_empty(self) -> None:
        """Raise a MitsonarError where no frame shows ground."""
        if self.frames == self.frames_without_ground:
            raise MitsonarError(self._empty())

    def _empty(self) -> str:
        added = f"{counted(self.frames, 'frame')} added, without ground in {self.frames_without_ground:,}"
        return f"the mosaic is empty: {added}; check height, pitch and window"

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Return the west, east, south and north edge of the arrays below [m] (matplotlib's ``extent``)."""
        south, north, west, east = self.covered
        return west * self.cell_m, east * self.cell_m, south * self.cell_m, north * self.cell_m

    @property
    def mean(self) -> Floats:
        """Return the mean level ``(rows, columns)`` in 0..1; row 0 northernmost, column 0 westernmost; nan where unknown."""
        found = self._north_up()
        return np.where(found.seen > 0, found.mean, np.float32(np.nan))

    @property
    def std(self) -> Floats:
        """Return the standard deviation of the frames' levels in each cell, shaped as ``mean``.

        It is nan where fewer than two frames show the cell, or where one has nearly all the weight (:data:`ONE_ALONE`).
        The variance is unbiased: sum w (x - mean)^2 / (W - sum w^2 / W) with W = sum w. With equal weights that is over
        n - 1.
        """
        found = self._north_up()
        with np.errstate(invalid="ignore", divide="ignore"):
            free = found.weight - found.weight2 / found.weight
            known = (found.seen > 1) & (free > ONE_ALONE * found.weight)
            return np.where(known, np.sqrt(np.maximum(found.squares, 0) / free), np.float32(np.nan))

    @property
    def weight(self) -> Floats:
        """Return the sum of weights, shaped as ``mean``; 0 where unknown."""
        return self._north_up().weight

    @property
    def count(self) -> NDArray[np.int64]:
        """Return the number of frames that show each cell, shaped as ``mean``."""
        return self._north_up().seen.astype(np.int64)

    def _north_up(self) -> CellSums:
        return CellSums(*(values[::-1] for values in self._patch(self.covered)))


def build_mosaic(
    frames: SonarFrames | Iterable[SonarFrames],
    poses: ArrayLike | None = None,
    height_m: ArrayLike | None = None,
    *,
    cell_m: float = 0.01,
    blend: Blend = "weighted",
    centre_beams: int = CENTRE_BEAMS,
    most_cells: int = MOST_CELLS,
    illumination: Floats | None = None,
) -> Mosaic:
    """Build the mosaic of a run, whose frames are read once, a chunk at a time.

    With ``centre``, the first and the last frame are added whole (Almanza-Medina, 3.5.1).

    Args:
        frames: of one sonar, all at once or in consecutive chunks.
        poses: of the sonar in the whole run ``(n, 6)`` [m, rad]: an estimated path; default: those of the frames.
        height_m: over the ground ``(n,)`` or one for all [m]; default: those of the frames.
        cell_m: edge of a cell [m].
        blend: ``weighted``: all beams, with weights that fall to 0 at the edges of the fan; ``centre``: the plain mean of
            the ``centre_beams`` in the middle.
        centre_beams: for ``centre``.
        most_cells: largest number of cells.
        illumination: of :func:`mitsonar.mapping.illumination.illumination` ``(bins, beams)``. Images are divided by it.

    Returns:
        The map; see :class:`mitsonar.mapping.mosaic.Mosaic`.

    Raises:
        MitsonarError: frames without poses or height, or that do not fit;
            more or fewer frames than poses; no frame that shows ground.
    """
    mosaic = Mosaic(cell_m, blend, centre_beams=centre_beams, most_cells=most_cells, illumination=illumination)
    table = None if poses is None else checked_poses(poses)
    heights = None if height_m is None else np.asarray(height_m, dtype=float)
    done, chunks = 0, [frames] if isinstance(frames, SonarFrames) else frames
    for chunk, last in _and_whether_last(chunks):
        part = slice(done, done + len(chunk))
        _check_enough(part.stop, table, heights)
        if not done and table is not None and heights is not None:
            mosaic.reserve(chunk, table, heights)
        whole = np.zeros(len(chunk), dtype=bool)
        whole[:1] |= not done
        whole[-1:] |= last
        mosaic.add(
            chunk,
            None if table is None else table[part],
            heights if heights is None or not heights.ndim else heights[part],
            whole=whole,
        )
        done = part.stop
    _check_all_used(done, table, heights)
    mosaic.check_not_empty()
    return mosaic


def _check_enough(frames: int, poses: Array | None, heights: Array | None) -> None:
    """Raise where there are more frames than poses or heights."""
    if poses is not None and frames > len(poses):
        raise MitsonarError(f"there are more frames than poses: got {len(poses):,} poses; give a pose for each frame")
    if heights is not None and heights.ndim and frames > len(heights):
        raise MitsonarError(f"there are more frames than heights: got {len(heights):,}; give a height for each frame")


def _check_all_used(frames: int, poses: Array | None, heights: Array | None) -> None:
    """Raise where there are more poses or heights than frames."""
    for name, given in (("poses", poses), ("heights", heights)):
        if given is not None and given.ndim and frames != len(given):
            raise MitsonarError(f"there are more {name} than frames: got {len(given):,} for {frames:,} frames")


def _and_whether_last(chunks: Iterable[SonarFrames]) -> Iterator[tuple[SonarFrames, bool]]:
    """Yield each chunk, and whether it is the last one; one is read ahead."""
    held = None
    for chunk in chunks:
        if held is not None:
            yield held, False
        held = chunk
    if held is not None:
        yield held, True
