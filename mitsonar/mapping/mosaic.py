"""How frames along a path become a mosaic, a map of the level ground.

Each cell holds the mean level, its standard deviation over the frames, and the number of frames (Almanza-Medina, 2.3.3 and
3.5.1; the blend ``weighted`` is an addition of mitsonar).
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, argument, count_noun, suggest_names
from mitsonar.estimation.image.ping_groups import along_path
from mitsonar.geometry.ground import GroundGeometry, moved
from mitsonar.instruments.views import directions
from mitsonar.io.files import write_atomic
from mitsonar.motion.pose import Pose
from mitsonar.motion.utm import UtmOrigin
from mitsonar.records.frames import SonarFrames

__all__ = [
    "ILLUMINATION_FRAMES",
    "LONGEST_SIDE",
    "RAYS",
    "Blend",
    "Box",
    "CellSums",
    "FrameFan",
    "Mosaic",
    "MosaicOptions",
    "accumulate",
    "band_limited",
    "box_around",
    "build_mosaic",
    "checked_heights",
    "checked_poses",
    "fan_of",
    "fractional_index",
    "from_middle",
    "geotiff_bytes",
    "ground_outline",
    "illumination",
    "levels_of",
    "middle_beams",
    "poses_and_heights",
    "save_geotiff",
    "squared_span",
    "with_slack",
]

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

Blend = Literal["weighted", "centre"]

CENTRE_BEAMS = 24
"""Number of beams in the middle of the fan that Almanza-Medina draws (3.5.1)."""

MOST_CELLS = 2**25
"""Default largest number of cells: 58 x 58 m in cells of 10 mm, 20 bytes each."""

SLACK = 0.25
"""Smallest fraction of its size by which a map grows, so that long runs do not copy it at every frame."""

LEAST_WEIGHT = 1e-3
"""Smaller weights count as 0: bins at the outline are only half insonified, and may be the only ones of their cell."""

ONE_ALONE = 1e-3
"""Fraction of the weight W of a cell that W - sum w^2 / W must exceed for a standard deviation, given float32 precision."""


@dataclass(frozen=True)
class MosaicOptions:
    """Choices of a mosaic.

    Attributes:
        cell_m: edge of a cell [m].
        blend: ``weighted`` uses all beams, with cos^2 weights that fall to 0 at the edges of the fan in bearing and in
            range; ``centre`` is the plain mean of the ``centre_beams`` in the middle (Almanza-Medina, 3.5.1).
        centre_beams: number of beams for ``centre``.
        most_cells: largest number of cells.

    Raises:
        MitsonarError: an option is outside its limits.
    """

    cell_m: float = 0.01
    blend: Blend = "weighted"
    centre_beams: int = CENTRE_BEAMS
    most_cells: int = MOST_CELLS

    def __post_init__(self) -> None:
        if not (math.isfinite(self.cell_m) and self.cell_m > 0):
            raise MitsonarError(
                f"{argument('cell_m')} must be above 0: got {self.cell_m:g} m; 0.01 m suits range bins of 5 mm"
            )
        if self.blend not in get_args(Blend):
            raise MitsonarError(f"unknown blend {self.blend!r}: {suggest_names(self.blend, get_args(Blend))}")
        if self.centre_beams < 2 or self.most_cells < 1:
            raise MitsonarError(
                f"{argument('centre_beams')} must be at least 2 and {argument('most_cells')} at least 1: got "
                f"{self.centre_beams} and {self.most_cells:,}"
            )


class Mosaic:
    """A map of the level plane below the sonar, to which frames are added and which grows as they require.

    Cells are squares. Their edges lie on whole multiples of ``cell_m`` in the world, so that maps of the same cell size fit
    together. A cell takes the value of each frame at the range and bearing of its centre, interpolated bilinearly between
    the centres of bins and beams, with the exact geometry over level ground
    (:class:`mitsonar.geometry.ground.GroundGeometry`). Only ground within the range window, the beams and the elevation
    field of view is updated. There a pixel of 0 counts, because a shadow is dark. Relief is not modelled: objects that rise
    from the ground are mapped too near.

    Args:
        options: cells and blend.
        illumination: result of :func:`mitsonar.mapping.mosaic.illumination` ``(bins, beams)``. Images are divided by it, so
            that the fall-off of the level with range neither shades the map nor adds to the standard deviation. Levels may
            then exceed 1.

    Raises:
        MitsonarError: the illumination is not finite and above 0.
    """

    def __init__(self, options: MosaicOptions = MosaicOptions(), *, illumination: Floats | None = None) -> None:
        if illumination is not None and not (np.isfinite(illumination).all() and np.all(illumination > 0)):
            raise MitsonarError("an illumination must be finite and above 0 everywhere: take it from `illumination`")
        self.options, self.cell_m, self.illumination = options, float(options.cell_m), illumination
        self.frames = 0
        """Number of frames added."""
        self.frames_without_ground = 0
        """Number of these that showed no ground: height unknown (nan), or ground outside the window or field of view."""
        self.frames_past_nadir = 0
        """Number of these that look past straight down, where an echo belongs to one of two places, and is laid at both."""
        self._box = Box(0, 0, 0, 0)
        self._sums = np.zeros((len(CellSums._fields), 0, 0), np.float32)

    # ---------------- Adding frames

    def reserve(self, frames: SonarFrames, poses: ArrayLike, height_m: ArrayLike) -> None:
        """Allocate the map for all frames of a run before the first is read.

        Args:
            frames: one or more frames of the run, of which only the sonar is used.
            poses: poses of the sonar in the whole run ``(n, 6)`` [m, rad].
            height_m: height over the ground ``(n,)``, or one for all [m].

        Raises:
            MitsonarError: the map would exceed ``most_cells``.
        """
        table = checked_poses(poses)
        heights = checked_heights(height_m, len(table))
        boxes = [self._footprint(fan_of(frames, pose, height), pose) for pose, height in zip(table, heights, strict=True)]
        known = [box for box in boxes if box is not None]
        if known:
            self._make_room(box_around(known), slack=0.0)

    def reserve_box(self, box: Box) -> None:
        """Allocate the map for a box of cells.

        Raises:
            MitsonarError: the map would exceed ``most_cells``.
        """
        self._make_room(box, slack=0.0)

    def add_cells(self, box: Box, place: NDArray[np.int64], value: Floats) -> None:
        """Add values to some cells of a box, which count as one more frame with a weight of 1.

        Args:
            box: cells.
            place: indices of cells ``(n,)`` in the box, row by row from its southernmost; each occurs once.
            value: levels ``(n,)``, finite.

        Raises:
            MitsonarError: the map would exceed ``most_cells``.
        """
        self._make_room(box, slack=SLACK)
        rows, columns = np.divmod(place, box.shape[1])
        some = (slice(None), rows + (box.south - self._box.south), columns + (box.west - self._box.west))
        sums = self._sums[some]
        accumulate(CellSums(*sums), value, np.ones_like(value))
        self._sums[some] = sums

    def add(
        self,
        frames: SonarFrames,
        poses: ArrayLike | None = None,
        height_m: ArrayLike | None = None,
        *,
        whole: ArrayLike = False,
    ) -> None:
        """Add frames to the map.

        Beams that ping in groups are moved to the middle of their frame, if at least two frames are added at once.

        Args:
            frames: some frames of the run.
            poses: pose of the sonar at each frame ``(frames, 6)`` [m, rad]; default: those of the frames.
            height_m: height over the ground ``(frames,)``, or one for all [m]; default: those of the frames.
            whole: whether each frame is added with all beams, whatever the blend ``(frames,)``, or one value for all.

        Raises:
            MitsonarError: there are no poses or heights, their numbers do not fit, or the map would exceed ``most_cells``.
        """
        images = levels_of(frames)
        table, heights = poses_and_heights(frames, poses, height_m)
        of_one_moment = along_path(frames, table, heights)
        images = self._flat(images if of_one_moment is frames else levels_of(of_one_moment))
        if np.shape(whole) not in ((), (len(frames),)):
            raise MitsonarError(f"whole must be one boolean, or one for each of {len(frames)} frames: got {np.shape(whole)}")
        entire = np.broadcast_to(np.asarray(whole, dtype=bool), len(frames))
        for image, pose, height, all_beams in zip(images, table, heights, entire, strict=True):
            fan = fan_of(frames, pose, height)
            self.frames += 1
            self.frames_past_nadir += bool(fan.ground.pitch_rad + fan.half_elevation > math.pi / 2)
            if self.options.blend == "centre" and not all_beams:
                fan, image = middle_beams(fan, image, self.options.centre_beams)
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
        # 1. the cells that the frame may show, and their range, bearing and weight
        box = self._footprint(fan, pose)
        if box is None:
            return False
        self._make_room(box, slack=SLACK)
        points = self._points(box, pose)
        radius, bearing = fan.ground.to_polar(points)
        weight = self._weights(fan, points, radius, bearing)
        if not weight.any():
            return False
        # 2. sample the image at the cells, smoothed where cells are larger than bins or beams, against aliasing
        rows, columns = fractional_index(radius, fan.ground.range_m), fractional_index(bearing, fan.ground.bearing_rad)
        image = band_limited(image, squared_span(rows, weight), squared_span(columns, weight))
        value = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        accumulate(self._patch(box), np.asarray(value), weight)
        return True

    def _points(self, box: Box, pose: Array) -> Floats:
        """Return the centres of cells ``(rows, columns, 2)`` in the heading axes of the sonar [m], as float32."""
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
        if self.options.blend == "centre":
            return inside.astype(np.float32)
        quarter = np.float32(np.pi / 2)
        taper = np.square(np.cos(quarter * across) * np.cos(quarter * along))
        return np.asarray(np.where(inside & (taper > LEAST_WEIGHT), taper, np.float32(0)))

    def _footprint(self, fan: FrameFan, pose: Array) -> Box | None:
        """Return the box of cells around the ground that a frame can show; None if it shows none."""
        reach = ground_outline(fan)
        if reach is None:
            return None
        turned = moved(reach, (0.0, 0.0, -pose[5])) + pose[:2]
        margin = self.cell_m + fan.window[1] * (1 - math.cos(np.ptp(fan.sector) / (RAYS - 1) / 2))  # arcs bulge between rays
        west, south = np.floor((turned.min(axis=0) - margin) / self.cell_m).astype(int)
        east, north = np.ceil((turned.max(axis=0) + margin) / self.cell_m).astype(int)
        return Box(int(south), int(north), int(west), int(east))

    # ---------------- Map and statistics

    def _patch(self, box: Box) -> CellSums:
        """Return the sums of the cells of a box, as views."""
        south, west = box.south - self._box.south, box.west - self._box.west
        rows, columns = box.shape
        return CellSums(*self._sums[:, south : south + rows, west : west + columns])

    def _make_room(self, box: Box, slack: float) -> None:
        """Grow the map to hold a box."""
        new = box_around([self._box, box]) if self._sums.size else box
        if new == self._box:
            return
        cells = math.prod(new.shape)
        if cells > self.options.most_cells or max(box.shape) > LONGEST_SIDE:
            raise MitsonarError(self._too_large(new, cells))
        room = with_slack(self._box, new, slack)
        new = room if math.prod(room.shape) <= self.options.most_cells else new
        sums = np.zeros((len(self._sums), *new.shape), np.float32)
        south, west = self._box.south - new.south, self._box.west - new.west
        rows, columns = self._box.shape
        if self._sums.size:
            sums[:, south : south + rows, west : west + columns] = self._sums
        self._box, self._sums = new, sums

    def _too_large(self, box: Box, cells: int) -> str:
        rows, columns = box.shape
        fits = max(self.cell_m * math.sqrt(cells / self.options.most_cells), self.cell_m * max(rows, columns) / LONGEST_SIDE)
        fits = math.ceil(fits * 1.02 * 1e4) / 1e4
        return (
            f"the map would have {rows:,} x {columns:,} cells of {1e3 * self.cell_m:g} mm, for {rows * self.cell_m:.4g} x "
            f"{columns * self.cell_m:.4g} m; at most {self.options.most_cells:,} are allowed: use cells of "
            f"{1e3 * fits:g} mm, raise most_cells (20 bytes each), or look for a pose that is wrong"
        )

    @property
    def state_bytes(self) -> int:
        """Return the memory of the map [bytes]."""
        return self._sums.nbytes

    @property
    def covered(self) -> Box:
        """Return the smallest box around all cells that any frame shows.

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
        """Raise a MitsonarError if no frame shows ground."""
        if self.frames == self.frames_without_ground:
            raise MitsonarError(self._empty())

    def _empty(self) -> str:
        added = f"{count_noun(self.frames, 'frame')} added, without ground in {self.frames_without_ground:,}"
        return f"the mosaic is empty: {added}; check height, pitch, window and the cell size of {self.cell_m:g} m"

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Return the west, east, south and north edge of ``mean`` and the other arrays [m] (matplotlib's ``extent``)."""
        south, north, west, east = self.covered
        return west * self.cell_m, east * self.cell_m, south * self.cell_m, north * self.cell_m

    @property
    def mean(self) -> Floats:
        """Return the mean level ``(rows, columns)`` in 0..1; row 0 is northernmost, column 0 westernmost; nan: unknown."""
        cells = self._north_up()
        return np.where(cells.seen > 0, cells.mean, np.float32(np.nan))

    @property
    def std(self) -> Floats:
        """Return the standard deviation over the frames of the level in each cell, shaped as ``mean``.

        It is nan if fewer than two frames show the cell, or if one of them has nearly all the weight (:data:`ONE_ALONE`).
        The variance is unbiased: sum w (x - mean)^2 / (W - sum w^2 / W) with W = sum w. With equal weights this is
        the usual division by n - 1.
        """
        cells = self._north_up()
        with np.errstate(invalid="ignore", divide="ignore"):
            free = cells.weight - cells.weight2 / cells.weight
            known = (cells.seen > 1) & (free > ONE_ALONE * cells.weight)
            return np.where(known, np.sqrt(np.maximum(cells.squares, 0) / free), np.float32(np.nan))

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
    options: MosaicOptions = MosaicOptions(),
    *,
    illumination: Floats | None = None,
) -> Mosaic:
    """Build the mosaic of a run, whose frames are read once, a chunk at a time.

    With ``centre``, the first and the last frame are added with all beams (Almanza-Medina, 3.5.1).

    Args:
        frames: frames of one sonar, all at once or in consecutive chunks.
        poses: poses of the sonar in the whole run ``(n, 6)`` [m, rad], such as an estimated path; default: those of the
            frames.
        height_m: height over the ground ``(n,)``, or one for all [m]; default: those of the frames.
        options: cells and blend.
        illumination: result of :func:`mitsonar.mapping.mosaic.illumination` ``(bins, beams)``, by which images are divided.

    Returns:
        The map; see :class:`mitsonar.mapping.mosaic.Mosaic`.

    Raises:
        MitsonarError: frames lack poses or height or do not fit, the numbers of frames and poses differ, or no frame shows
            ground.
    """
    mosaic = Mosaic(options, illumination=illumination)
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
    """Raise a MitsonarError if there are more frames than poses or heights."""
    if poses is not None and frames > len(poses):
        raise MitsonarError(f"there are more frames than poses: got {len(poses):,} poses; give a pose for each frame")
    if heights is not None and heights.ndim and frames > len(heights):
        raise MitsonarError(f"there are more frames than heights: got {len(heights):,}; give a height for each frame")


def _check_all_used(frames: int, poses: Array | None, heights: Array | None) -> None:
    """Raise a MitsonarError if there are more poses or heights than frames."""
    for name, given in (("poses", poses), ("heights", heights)):
        if given is not None and given.ndim and frames != len(given):
            raise MitsonarError(f"there are more {name} than frames: got {len(given):,} for {frames:,} frames")


def _and_whether_last(chunks: Iterable[SonarFrames]) -> Iterator[tuple[SonarFrames, bool]]:
    """Yield each chunk and whether it is the last one, by reading one chunk ahead."""
    previous = None
    for chunk in chunks:
        if previous is not None:
            yield previous, False
        previous = chunk
    if previous is not None:
        yield previous, True


# ---------------- Cells and their running sums


class Box(NamedTuple):
    """A box of cells, numbered northwards and eastwards from the origin of the world; the ends are exclusive."""

    south: int
    north: int
    west: int
    east: int

    @property
    def shape(self) -> tuple[int, int]:
        """Return the number of rows and columns."""
        return self.north - self.south, self.east - self.west


class CellSums(NamedTuple):
    """Running statistics of each cell, all ``(rows, columns)``.

    Attributes:
        mean: weighted mean level.
        squares: weighted sum of squares about the mean.
        weight: sum of weights.
        weight2: sum of squared weights.
        seen: number of frames.
    """

    mean: Floats
    squares: Floats
    weight: Floats
    weight2: Floats
    seen: Floats


def accumulate(cells: CellSums, value: Floats, weight: Floats) -> None:
    """Add values to the running statistics in place, without cancellation in float32 (West 1979)."""
    cells.weight[...] += weight
    before = value - cells.mean
    cells.mean[...] += before * (weight / np.maximum(cells.weight, np.float32(1e-30)))
    cells.squares[...] += weight * before * (value - cells.mean)
    cells.weight2[...] += weight * weight
    cells.seen[...] += weight > 0


def box_around(boxes: Iterable[Box]) -> Box:
    """Return the smallest box around some boxes."""
    south, north, west, east = zip(*boxes, strict=True)
    return Box(min(south), max(north), min(west), max(east))


def with_slack(old: Box, new: Box, slack: float) -> Box:
    """Return the new box, enlarged by a fraction of the old one on those sides where the old one had to grow."""
    if not math.prod(old.shape):
        return new
    rows, columns = (math.ceil(slack * size) for size in old.shape)
    return Box(
        new.south - rows * (new.south < old.south),
        new.north + rows * (new.north > old.north),
        new.west - columns * (new.west < old.west),
        new.east + columns * (new.east > old.east),
    )


# ---------------- One frame over level ground


RAYS = 33
"""Number of rays over bearing, and over elevation, whose ends on the ground bound a footprint."""

LONGEST_SIDE = 32_766
"""Longest side of an image or a patch [cells]: the limit of OpenCV's remap."""


@dataclass(frozen=True)
class FrameFan:
    """The fan of one frame over level ground.

    Attributes:
        ground: geometry of the frame over the ground.
        half_elevation: half of the elevation field of view [rad].
    """

    ground: GroundGeometry
    half_elevation: float

    @property
    def window(self) -> tuple[float, float]:
        """Return the near and the far end of the range bins [m]."""
        return _ends(self.ground.range_m)

    @property
    def sector(self) -> tuple[float, float]:
        """Return the port and the starboard end of the beams [rad]."""
        return _ends(self.ground.bearing_rad)


# ---------------- Checks of frames, poses and heights


def levels_of(frames: SonarFrames) -> Floats:
    """Return the images ``(frames, bins, beams)`` as float32 in 0..1, as estimators match them.

    Raises:
        MitsonarError: there are too few or too many bins or beams, an axis does not increase, or a pixel is not finite.
    """
    _, bins, beams = frames.image.shape
    if min(bins, beams) < 2 or max(bins, beams) > LONGEST_SIDE:
        raise MitsonarError(f"a mosaic needs images of 2 to {LONGEST_SIDE:,} bins and beams: got {bins:,} x {beams:,}")
    if (np.diff(frames.range_m) <= 0).any() or (np.diff(frames.bearing_rad) <= 0).any():
        raise MitsonarError("range_m and bearing_rad must increase: sort the images' rows and columns")
    images = frames.matching_values()
    if not np.isfinite(images).all():
        raise MitsonarError("images must be finite: got inf or nan; 0 means no echo")
    return np.asarray(images)


def poses_and_heights(
    frames: SonarFrames, poses: ArrayLike | None, height_m: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return poses ``(frames, 6)`` [m, rad] and heights ``(frames,)`` [m], as given, or else those of the frames.

    Raises:
        MitsonarError: there are none, or their number or values do not fit.
    """
    if poses is None and frames.poses is None:
        raise MitsonarError("the frames have no poses: give poses, such as those of an estimated path")
    if height_m is None and frames.height_m is None:
        raise MitsonarError(f"the frames hold no height: give {argument('height_m')}, the sonar's height over the ground")
    table = checked_poses(frames.poses if poses is None else poses)
    if len(table) != len(frames):
        raise MitsonarError(f"each frame needs a pose: got {len(table)} poses for {len(frames)} frames")
    return table, checked_heights(frames.height_m if height_m is None else height_m, len(frames))


def checked_heights(height_m: ArrayLike | None, count: int) -> NDArray[np.float64]:
    """Return one height per frame ``(count,)`` [m]; nan where unknown.

    Raises:
        MitsonarError: the number of heights does not fit, or a height is not above 0.
    """
    heights = np.asarray(height_m, dtype=float)
    if heights.shape not in ((), (count,)):
        raise MitsonarError(
            f"{argument('height_m')} must be one number, or one for each of {count} frames: got {heights.shape}"
        )
    if (heights <= 0).any():
        raise MitsonarError(f"{argument('height_m')} must be above 0: got {np.nanmin(heights):g} m")
    return np.broadcast_to(heights, count)


def checked_poses(poses: ArrayLike | None) -> NDArray[np.float64]:
    """Return poses as an array ``(frames, 6)`` [m, rad].

    Raises:
        MitsonarError: the shape does not fit, or a pose is not finite.
    """
    table = np.asarray(poses, dtype=float)
    if table.ndim != 2 or table.shape[1] != 6 or not np.isfinite(table).all():
        raise MitsonarError(f"poses must be (frames, 6), finite: got {table.shape}, x, y, z [m], pitch, roll, heading [rad]")
    return table


# ---------------- Geometry of one frame


def fan_of(frames: SonarFrames, pose: NDArray[np.float64], height: float) -> FrameFan:
    """Return the geometry of a frame at a pose and a height [m] over the ground."""
    _, _, _, pitch, roll, _ = Pose.from_row(pose)
    ground = GroundGeometry(frames.range_m, frames.bearing_rad, frames.sonar.bearing, float(height), pitch, roll)
    return FrameFan(ground, math.radians(frames.sonar.elevation_fov_deg) / 2)


def middle_beams(fan: FrameFan, image: Floats, beams: int) -> tuple[FrameFan, Floats]:
    """Return the fan and the image ``(bins, beams)``, restricted to the beams in the middle."""
    first = max(0, (image.shape[1] - beams) // 2)
    middle = slice(first, first + beams)
    ground = replace(fan.ground, bearing_rad=fan.ground.bearing_rad[middle])
    return replace(fan, ground=ground), np.ascontiguousarray(image[:, middle])


def ground_outline(fan: FrameFan) -> NDArray[np.float64] | None:
    """Return points ``(n, 2)`` in heading axes [m] that enclose all ground a frame can show; None if it shows none.

    Rays that meet the ground beyond the far end of the window, or never, end where the window ends.
    """
    ground, far = fan.ground, fan.window[1]
    if not ground.height_m < far:  # nan too
        return None
    # directions of rays over the sector and the elevation field of view, in level axes
    b, e = np.meshgrid(np.linspace(*fan.sector, RAYS), np.linspace(-1, 1, RAYS) * fan.half_elevation)
    x, y, z = np.moveaxis(directions(ground.bearing, b, e) @ ground.turn.T, -1, 0)
    level = np.maximum(np.hypot(x, y), 1e-12)
    # horizontal distance at which each ray meets the ground, cut off at the far end of the window
    with np.errstate(divide="ignore"):
        meets = np.where(z < 0, ground.height_m * level / -z, np.inf)
    distance = np.minimum(meets, math.sqrt(far**2 - ground.height_m**2)) / level
    return np.stack([x * distance, y * distance], axis=-1).reshape(-1, 2)


def _ends(centres: NDArray[np.float64]) -> tuple[float, float]:
    """Return the outer edges of cells with these centres; the first and last are as wide as their neighbours."""
    return float(1.5 * centres[0] - 0.5 * centres[1]), float(1.5 * centres[-1] - 0.5 * centres[-2])


def from_middle(value: NDArray[np.floating], low: float, high: float) -> Floats:
    """Return the distance from the middle of an interval, relative to its half width: 1 at either end."""
    return np.asarray(np.abs(value - np.float32((low + high) / 2)) / np.float32((high - low) / 2), dtype=np.float32)


def fractional_index(value: Floats, centres: NDArray[np.float64]) -> Floats:
    """Return the fractional index of values among increasing centres."""
    steps = np.diff(centres)
    if np.allclose(steps, steps[0], rtol=1e-6, atol=0):  # even spacing is ten times as fast
        return np.asarray((value - np.float32(centres[0])) / np.float32(steps.mean()))
    return np.interp(value, centres, np.arange(centres.size)).astype(np.float32)


def band_limited(image: Floats, bins2: float, beams2: float) -> Floats:
    """Smooth an image where a cell of the map spans more than a bin or a beam, so that fine texture is averaged.

    Variances add: a box of w bins has variance w^2 / 12, of which each bin already contributes 1 / 12.

    Args:
        image: image to smooth ``(bins, beams)``.
        bins2: squared width of a cell of the map in bins.
        beams2: squared width of a cell of the map in beams.
    """
    along, across = (math.sqrt(max(width2 - 1, 0) / 12) for width2 in (bins2, beams2))
    if max(along, across) == 0:
        return image
    kernel = (2 * math.ceil(3 * across) + 1, 2 * math.ceil(3 * along) + 1)
    # OpenCV replaces a sigma of 0 by one that suits the kernel; here the kernel is then a single cell, so any sigma does
    return np.asarray(cv2.GaussianBlur(image, kernel, across or 1.0, sigmaY=along or 1.0, borderType=cv2.BORDER_REPLICATE))


def squared_span(indices: Floats, weight: Floats) -> float:
    """Return the squared width of a cell of the map in bins or beams, as the median over some cells in view."""
    rows, columns = (slice(1, None, max(1, size // 16)) for size in indices.shape)
    before = slice(0, -1, rows.step), slice(0, -1, columns.step)
    here, seen = indices[rows, columns], weight[rows, columns] > 0
    squared = np.square(here - indices[before[0], columns]) + np.square(here - indices[rows, before[1]])
    return float(np.median(squared[seen])) if seen.any() else 0.0


# ---------------- Illumination


ILLUMINATION_FRAMES = 20
"""Number of frames, spread over a run, that suffice for its illumination. On the patterned seabed, the correlation of the
mosaic with the true reflectivity is 0.789 with 20 frames, 0.788 with 300, and 0.381 without an illumination."""

SMOOTH_ILLUMINATION = (1 / 32, 1 / 8)
"""Standard deviations of its smoothing, as fractions of the numbers of bins and beams, which removes scenery only."""

FAINTEST_ILLUMINATION = 0.05
"""Smallest illumination, as a fraction of its mean; darker pixels are not amplified further."""


def illumination(frames: SonarFrames, poses: ArrayLike | None = None, height_m: ArrayLike | None = None) -> Floats:
    """Estimate the illumination of each image cell over uniform ground ``(bins, beams)``, with mean 1; 1 beyond the ground.

    It is the mean of frames that show different ground, smoothed within the insonified part of the image. The height and
    pitch of the sonar must stay about the same. :data:`~mitsonar.mapping.mosaic.ILLUMINATION_FRAMES` frames, spread over the
    run, suffice.

    Args:
        frames: sample of the frames of the run.
        poses: see :meth:`~mitsonar.mapping.mosaic.Mosaic.add`.
        height_m: see :meth:`~mitsonar.mapping.mosaic.Mosaic.add`.

    Raises:
        MitsonarError: as for :meth:`~mitsonar.mapping.mosaic.Mosaic.add`; or the frames show no ground, or are blank.
    """
    # 1. mean of the frames, and the part of the image that lies on the ground within the elevation field of view
    table, heights = poses_and_heights(frames, poses, height_m)
    mean = levels_of(frames).mean(axis=0)
    over_ground = np.isfinite(heights)
    if not over_ground.any():
        raise MitsonarError(f"the illumination needs frames over ground, of known height: give {argument('height_m')}")
    shown = table[over_ground]
    usual = np.concatenate([shown[:, :3], np.unwrap(shown[:, 3:], axis=0)], axis=1).mean(axis=0)
    fan = fan_of(frames, usual, float(heights[over_ground].mean()))
    points = fan.ground.points
    lit = np.abs(fan.ground.elevation(points)) <= fan.half_elevation
    if not mean[lit].any():
        raise MitsonarError("the frames show no lit ground: check height, pitch, window, and that they are not blank")
    # 2. smooth within that part only (normalised convolution), scale to mean 1, and bound the amplification
    along, across = (part * size for part, size in zip(SMOOTH_ILLUMINATION, mean.shape, strict=True))

    def smooth(image: Floats) -> Floats:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), across, sigmaY=along, borderType=cv2.BORDER_CONSTANT))

    share = smooth(lit.astype(np.float32))
    known = share > 1e-3
    level = smooth(np.where(lit, mean, np.float32(0))) / np.maximum(share, np.float32(1e-3))
    level = level / level[lit].mean()
    return np.asarray(np.where(known, np.maximum(level, np.float32(FAINTEST_ILLUMINATION)), np.float32(1)))


# ---------------- GeoTIFF


def save_geotiff(path: str | Path, mosaic: Mosaic, origin: UtmOrigin | None = None) -> None:
    """Write a mosaic as a GeoTIFF with float32 bands mean, std and count, nan where unknown, in metres.

    Args:
        path: file to write.
        mosaic: the map.
        origin: where on the Earth the origin of the map lies.
    """
    bands = np.stack([mosaic.mean, mosaic.std, mosaic.count.astype(np.float32)])
    west, _, _, north = mosaic.extent
    names = ("mean level, 0..1", "standard deviation of the frames' levels", "frames that saw the cell")
    write_atomic(path, geotiff_bytes(bands, names, (west, north), mosaic.cell_m, origin))


def geotiff_bytes(
    bands: Floats, names: Sequence[str], corner_m: tuple[float, float], cell_m: float, origin: UtmOrigin | None = None
) -> bytes:
    """Encode a map as a GeoTIFF in metres.

    With an origin, coordinates are those of its UTM grid on WGS 84. Without one, the reference system is a local engineering
    system: x east, y north, without a position on Earth (GeoTIFF 1.1: user-defined model, linear unit metre).

    Args:
        bands: ``(bands, rows, columns)`` float32, with the northernmost row first; nan where unknown.
        names: description of each band.
        corner_m: western and northern edge [m].
        cell_m: edge of a cell [m].
        origin: where on the Earth the origin of the map lies.
    """
    import tifffile

    west, north = corner_m
    items = "".join(f'<Item name="DESCRIPTION" sample="{i}" role="description">{n}</Item>' for i, n in enumerate(names))
    if origin is None:
        model, citation, grid = 32767, "mitsonar world: x east, y north, metres|", []
    else:
        west, north = west + origin.east_m, north + origin.north_m
        hemisphere = "S" if origin.south else "N"
        model, citation, grid = 1, f"WGS 84 / UTM zone {origin.zone}{hemisphere}|", [(3072, 0, 1, origin.epsg)]
    keys = [(1024, 0, 1, model), (1025, 0, 1, 1), (1026, 34737, len(citation), 0), *grid, (3076, 0, 1, 9001)]
    directory = [1, 1, 1, len(keys), *(number for key in keys for number in key)]
    tags = [
        (33550, "d", 3, (cell_m, cell_m, 0.0), True),  # ModelPixelScale
        (33922, "d", 6, (0.0, 0.0, 0.0, west, north, 0.0), True),  # ModelTiepoint: the corner of pixel (0, 0)
        (34735, "H", len(directory), directory, True),  # GeoKeyDirectory
        (34737, "s", 0, citation, True),  # GeoAsciiParams
        (42112, "s", 0, f"<GDALMetadata>{items}</GDALMetadata>", True),  # GDAL_METADATA: names of bands
        (42113, "s", 0, "nan", True),  # GDAL_NODATA
    ]
    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer,
        bands,
        bigtiff=bands.nbytes > 2**31,
        photometric="minisblack",
        planarconfig="separate",
        compression="zlib",
        metadata=None,
        extratags=tags,
    )
    return buffer.getvalue()
