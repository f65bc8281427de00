"""Frames and a path become a mosaic: a map of the level ground with the mean level of each cell, how much the frames that
saw it differ, and how many did (Almanza-Medina, 2.3.3 and 3.5.1, and a blend of our own)."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, argument, nearest_names
from mitsonar.geometry.ground_plane import GroundGeometry, moved
from mitsonar.instruments.beam_directions import directions
from mitsonar.io.whole_files import write_whole
from mitsonar.motion.pose import Pose
from mitsonar.records.sonar_frames import SonarFrames

__all__ = ["ILLUMINATION_FRAMES", "Blend", "Mosaic", "build_mosaic", "illumination", "save_geotiff"]

Blend = Literal["weighted", "centre"]
Floats = NDArray[np.float32]

CENTRE_BEAMS = 24
"""Beams in the middle of the fan that the thesis draws (Almanza-Medina, 3.5.1)."""

MOST_CELLS = 2**25
"""Cells that a map has at most unless told: 58 x 58 m in cells of 10 mm, and 20 bytes each."""

SLACK = 0.25
"""A map that has to grow grows by this part of its size at least, so that long runs do not copy it at every frame."""

RAYS = 33
"""Over bearing and over elevation, whose ends on the ground bound a footprint."""

ILLUMINATION_FRAMES = 20
"""Frames, spread over a run, that tell its illumination: 300 tell it no better (correlation of the mosaic with the true
reflectivity of the pattern's seabed 0.789 with 20, 0.788 with 300, 0.381 without)."""

SMOOTH_ILLUMINATION = (1 / 32, 1 / 8)
"""Standard deviations that it is smoothed with, in parts of the bins and of the beams: scenery goes, the pattern stays."""

FAINTEST_ILLUMINATION = 0.05
"""Of its mean; what is lit less is not raised further."""

LEAST_WEIGHT = 1e-3
"""Below, a tapered weight is none: bins at the outline are half in the dark, and nothing else may see the cell."""

ONE_ALONE = 1e-3
"""Of a cell's weight, what W - sum w^2 / W must exceed for a standard deviation: below, float32 loses it."""

LONGEST_SIDE = 32_766
"""Of an image or a patch, in cells: what OpenCV's remap takes."""


class Box(NamedTuple):
    """Whole cells of the map, counted from the world's origin: first and one past the last, northwards and eastwards."""

    south: int
    north: int
    west: int
    east: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.north - self.south, self.east - self.west


class _Sums(NamedTuple):
    """What each cell keeps ``(rows, columns)``: mean, weighted squares about it, weight, squared weights, frames."""

    mean: Floats
    squares: Floats
    weight: Floats
    weight2: Floats
    seen: Floats


@dataclass(frozen=True)
class _Fan:
    """Geometry of one frame over the ground, and half its elevation field of view [rad]."""

    ground: GroundGeometry
    half_elevation: float

    @property
    def window(self) -> tuple[float, float]:
        """Near and far end of the range bins [m]."""
        return _ends(self.ground.range_m)

    @property
    def sector(self) -> tuple[float, float]:
        """Port and starboard end of the beams [rad]."""
        return _ends(self.ground.bearing_rad)


class Mosaic:
    """A map of the plane below the sonar, to which frames are added; its memory is bounded by the ground they cover.

    Cells are squares; their edges lie on whole multiples of ``cell_m`` in the world, so that maps of one cell size fit
    together. The map grows where frames need it. Every cell takes from each frame that shows it the value at its own
    (range, bearing), bilinear between the centres of bins and beams, over level ground with the exact geometry
    (:class:`mitsonar.geometry.ground_plane.GroundGeometry`). Ground outside the window, the beams or the elevation field of
    view is not
    touched. A pixel of 0 within them counts: a shadow is dark. Not modelled: relief; what stands up lies too near.

    Args:
        cell_m: edge of a cell [m].
        blend: ``weighted``: all beams, with weights cos^2 that fall to 0 at the edges of the fan in bearing and in range;
            ``centre``: the plain mean of the ``centre_beams`` in the middle (Almanza-Medina, 3.5.1).
        centre_beams: for ``centre``.
        most_cells: what the map may grow to.
        illumination: what :func:`illumination` found ``(bins, beams)``: images are divided by it, so that the fall-off of
            the level with range, which moves with the sonar, neither shades the map nor adds to the standard deviation.
            Levels may then exceed 1.

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
        """Of these, how many showed no ground at all: height unknown (nan), or beyond the window or the field of view."""
        self._box = Box(0, 0, 0, 0)
        self._sums = np.zeros((len(_Sums._fields), 0, 0), np.float32)

    # ------------------------------------------------------------ frames in

    def reserve(self, frames: SonarFrames, poses: ArrayLike, height_m: ArrayLike) -> None:
        """Make room for all frames of a run before the first is read; ``frames`` only tells the sonar.

        Args:
            frames: any frames of the run, one or more.
            poses: of the sonar in the whole run ``(n, 6)`` [m, rad].
            height_m: over the ground ``(n,)`` or one for all [m].

        Raises:
            MitsonarError: the map would exceed ``most_cells``.
        """
        table = _poses(poses)
        heights = _heights(height_m, len(table))
        boxes = [self._footprint(_fan(frames, pose, height), pose) for pose, height in zip(table, heights, strict=True)]
        known = [box for box in boxes if box is not None]
        if known:
            self._make_room(_around(known), slack=0.0)

    def add(
        self,
        frames: SonarFrames,
        poses: ArrayLike | None = None,
        height_m: ArrayLike | None = None,
        *,
        whole: ArrayLike = False,
    ) -> None:
        """Lay frames on the map.

        Args:
            frames: some frames of the run.
            poses: of the sonar, one a frame ``(frames, 6)`` [m, rad]; default: what the frames say.
            height_m: over the ground ``(frames,)`` or one for all [m]; default: what the frames say.
            whole: frames that are laid with all beams whatever the blend ``(frames,)``, or one for all.

        Raises:
            MitsonarError: no poses or heights, numbers that do not fit, or a map beyond ``most_cells``.
        """
        images = self._flat(_levels(frames))
        table, heights = _placed(frames, poses, height_m)
        if np.shape(whole) not in ((), (len(frames),)):
            raise MitsonarError(f"whole must be one truth, or one for each of {len(frames)} frames: got {np.shape(whole)}")
        entire = np.broadcast_to(np.asarray(whole, dtype=bool), len(frames))
        for image, pose, height, all_beams in zip(images, table, heights, entire, strict=True):
            fan = _fan(frames, pose, height)
            self.frames += 1
            if self.blend == "centre" and not all_beams:
                fan, image = _centre(fan, image, self.centre_beams)
            if not self._lay(image, fan, pose):
                self.frames_without_ground += 1

    def _flat(self, images: Floats) -> Floats:
        """Images ``(frames, bins, beams)`` without what the illumination did to them."""
        if self.illumination is None:
            return images
        if self.illumination.shape != images.shape[1:]:
            raise MitsonarError(
                f"the illumination must be (bins, beams) = {images.shape[1:]} as the images: got {self.illumination.shape}"
            )
        return np.asarray(images / self.illumination.astype(np.float32))

    def _lay(self, image: Floats, fan: _Fan, pose: NDArray[np.float64]) -> bool:
        """Add one image ``(bins, beams)``; whether it showed any ground."""
        box = self._footprint(fan, pose)
        if box is None:
            return False
        self._make_room(box, slack=SLACK)
        points = self._points(box, pose)
        radius, bearing = fan.ground.to_polar(points)
        weight = self._weights(fan, points, radius, bearing)
        if not weight.any():
            return False
        rows, columns = _place(radius, fan.ground.range_m), _place(bearing, fan.ground.bearing_rad)
        image = _band_limited(image, _span2(rows, weight), _span2(columns, weight))
        value = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        _accumulate(self._patch(box), np.asarray(value), weight)
        return True

    def _points(self, box: Box, pose: NDArray[np.float64]) -> Floats:
        """Centres of cells ``(rows, columns, 2)`` in the sonar's heading axes; float32, since they are near it."""
        x = (np.arange(box.west, box.east) + 0.5) * self.cell_m - pose[0]
        y = (np.arange(box.south, box.north) + 0.5) * self.cell_m - pose[1]
        about = np.stack(np.meshgrid(x.astype(np.float32), y.astype(np.float32)), axis=-1)
        return np.asarray(moved(about, (0.0, 0.0, pose[5])))

    def _weights(self, fan: _Fan, points: Floats, radius: Floats, bearing: Floats) -> Floats:
        """Weight of each cell ``(rows, columns)``; 0 where the frame does not show it."""
        across = _from_middle(bearing, *fan.sector)
        elevation = _from_middle(fan.ground.elevation(points), -fan.half_elevation, fan.half_elevation)
        along = np.maximum(elevation, _from_middle(radius, *fan.window))
        inside = (across < 1) & (along < 1)
        if self.blend == "centre":
            return inside.astype(np.float32)
        quarter = np.float32(np.pi / 2)
        taper = np.square(np.cos(quarter * across) * np.cos(quarter * along))
        return np.asarray(np.where(inside & (taper > LEAST_WEIGHT), taper, np.float32(0)))

    def _footprint(self, fan: _Fan, pose: NDArray[np.float64]) -> Box | None:
        """Cells around the ground that a frame can show; None where there is none."""
        reach = _reach(fan)
        if reach is None:
            return None
        turned = moved(reach, (0.0, 0.0, -pose[5])) + pose[:2]
        margin = self.cell_m + fan.window[1] * (1 - math.cos(np.ptp(fan.sector) / (RAYS - 1) / 2))  # arcs bulge between rays
        west, south = np.floor((turned.min(axis=0) - margin) / self.cell_m).astype(int)
        east, north = np.ceil((turned.max(axis=0) + margin) / self.cell_m).astype(int)
        return Box(int(south), int(north), int(west), int(east))

    # ------------------------------------------------------------ the map

    def _patch(self, box: Box) -> _Sums:
        """A view of some cells."""
        south, west = box.south - self._box.south, box.west - self._box.west
        rows, columns = box.shape
        return _Sums(*self._sums[:, south : south + rows, west : west + columns])

    def _make_room(self, box: Box, slack: float) -> None:
        """Grow the map to hold a box."""
        new = _around([self._box, box]) if self._sums.size else box
        if new == self._box:
            return
        cells = math.prod(new.shape)
        if cells > self.most_cells or max(box.shape) > LONGEST_SIDE:
            raise MitsonarError(self._too_large(new, cells))
        room = _with_slack(self._box, new, slack)
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
        """Memory that the map holds."""
        return self._sums.nbytes

    @property
    def covered(self) -> Box:
        """The smallest box of cells around all that was seen.

        Raises:
            MitsonarError: nothing was seen.
        """
        seen = self._sums[_Sums._fields.index("seen")] > 0
        if not seen.any():
            raise MitsonarError(self._empty())
        rows, columns = (np.flatnonzero(seen.any(axis=axis)) for axis in (1, 0))
        south, west = self._box.south, self._box.west
        return Box(south + int(rows[0]), south + int(rows[-1]) + 1, west + int(columns[0]), west + int(columns[-1]) + 1)

    def _empty(self) -> str:
        return (
            f"the mosaic is empty: {self.frames} frames added, {self.frames_without_ground} of them show no ground; "
            "check height, pitch and window"
        )

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, east, south, north edge of the arrays below [m] (as matplotlib's ``extent``)."""
        south, north, west, east = self.covered
        return west * self.cell_m, east * self.cell_m, south * self.cell_m, north * self.cell_m

    @property
    def mean(self) -> Floats:
        """Mean level ``(rows, columns)`` in 0..1; row 0 northernmost, column 0 westernmost; nan where nothing was seen."""
        found = self._north_up()
        return np.where(found.seen > 0, found.mean, np.float32(np.nan))

    @property
    def std(self) -> Floats:
        """Standard deviation of the frames' levels in each cell, like ``mean``; nan where fewer than two saw it, or
        one of them has nearly all the weight (:data:`ONE_ALONE`).

        Without bias: sum w (x - mean)^2 / (W - sum w^2 / W), W = sum w; with equal weights that is over n - 1.
        """
        found = self._north_up()
        with np.errstate(invalid="ignore", divide="ignore"):
            free = found.weight - found.weight2 / found.weight
            known = (found.seen > 1) & (free > ONE_ALONE * found.weight)
            return np.where(known, np.sqrt(np.maximum(found.squares, 0) / free), np.float32(np.nan))

    @property
    def weight(self) -> Floats:
        """Sum of weights, like ``mean``; 0 where nothing was seen."""
        return self._north_up().weight

    @property
    def count(self) -> NDArray[np.int64]:
        """Frames that saw each cell, like ``mean``."""
        return self._north_up().seen.astype(np.int64)

    def _north_up(self) -> _Sums:
        return _Sums(*(values[::-1] for values in self._patch(self.covered)))


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
    """The mosaic of a run, whose frames are read once, a chunk at a time.

    With ``centre``, the first and the last frame are laid whole (Almanza-Medina, 3.5.1).

    Args:
        frames: of one sonar, all at once or in chunks that follow each other.
        poses: of the sonar in the whole run ``(n, 6)`` [m, rad]: an estimated path; default: what the frames say.
        height_m: over the ground ``(n,)`` or one for all [m]; default: what the frames say.
        cell_m: as the rest, see :class:`Mosaic`.
        blend: see :class:`Mosaic`.
        centre_beams: see :class:`Mosaic`.
        most_cells: see :class:`Mosaic`.
        illumination: see :class:`Mosaic`.

    Raises:
        MitsonarError: as :meth:`Mosaic.add`; more or fewer frames than poses; no frame that shows ground.
    """
    mosaic = Mosaic(cell_m, blend, centre_beams=centre_beams, most_cells=most_cells, illumination=illumination)
    table = None if poses is None else _poses(poses)
    heights = None if height_m is None else np.asarray(height_m, dtype=float)
    done = 0
    for chunk, last in _and_whether_last([frames] if isinstance(frames, SonarFrames) else frames):
        part = slice(done, done + len(chunk))
        if table is not None and part.stop > len(table):
            raise MitsonarError(f"there are more frames than poses: got {len(table):,} poses; give a pose for each frame")
        if heights is not None and heights.ndim and part.stop > len(heights):
            raise MitsonarError(f"there are more frames than heights: got {len(heights):,}; give a height for each frame")
        if not done and table is not None and heights is not None:
            mosaic.reserve(chunk, table, heights)
        whole = np.zeros(len(chunk), dtype=bool)
        if len(chunk):
            whole[0] |= not done
            whole[-1] |= last
        mosaic.add(
            chunk,
            None if table is None else table[part],
            heights if heights is None or not heights.ndim else heights[part],
            whole=whole,
        )
        done = part.stop
    for name, given in (("poses", table), ("heights", heights)):
        if given is not None and given.ndim and done != len(given):
            raise MitsonarError(f"there are more {name} than frames: got {len(given):,} for {done:,} frames")
    if mosaic.frames == mosaic.frames_without_ground:
        raise MitsonarError(mosaic._empty())
    return mosaic


def illumination(frames: SonarFrames, poses: ArrayLike | None = None, height_m: ArrayLike | None = None) -> Floats:
    """How brightly each cell of the image is lit over even ground ``(bins, beams)``, with mean 1; 1 where no ground is.

    The mean of frames that show different places, smoothed within what the elevation field of view lights; made for a sonar
    whose height and pitch stay about the same. :data:`ILLUMINATION_FRAMES` frames spread over the run are enough.

    Args:
        frames: a sample of the run.
        poses: as in :meth:`Mosaic.add`.
        height_m: as in :meth:`Mosaic.add`.

    Raises:
        MitsonarError: as :meth:`Mosaic.add`; the frames show no ground, or nothing.
    """
    table, heights = _placed(frames, poses, height_m)
    mean = _levels(frames).mean(axis=0)
    over_ground = np.isfinite(heights)
    if not over_ground.any():
        raise MitsonarError(f"the illumination needs frames over ground, of known height: give {argument('height_m')}")
    fan = _fan(frames, table[over_ground].mean(axis=0), float(heights[over_ground].mean()))
    points = fan.ground.points
    lit = np.abs(fan.ground.elevation(points)) <= fan.half_elevation
    if not mean[lit].any():
        raise MitsonarError("the frames show no lit ground: check height, pitch, window, and that they are not blank")
    along, across = (part * size for part, size in zip(SMOOTH_ILLUMINATION, mean.shape, strict=True))

    def smooth(image: Floats) -> Floats:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), across, sigmaY=along, borderType=cv2.BORDER_CONSTANT))

    share = smooth(lit.astype(np.float32))
    known = share > 1e-3
    level = smooth(np.where(lit, mean, np.float32(0))) / np.maximum(share, np.float32(1e-3))
    level = level / level[lit].mean()
    return np.asarray(np.where(known, np.maximum(level, np.float32(FAINTEST_ILLUMINATION)), np.float32(1)))


def save_geotiff(path: str | Path, mosaic: Mosaic) -> None:
    """Write a GeoTIFF whole: bands mean, std and count as float32, nan where unknown, in metres of the local world.

    The reference system is a local engineering one: x east, y north, with no place on Earth (GeoTIFF 1.1: user-defined
    model, linear unit metre).
    """
    import tifffile

    bands = np.stack([mosaic.mean, mosaic.std, mosaic.count.astype(np.float32)])
    west, _, _, north = mosaic.extent
    names = ("mean level, 0..1", "standard deviation of the frames' levels", "frames that saw the cell")
    items = "".join(f'<Item name="DESCRIPTION" sample="{i}" role="description">{n}</Item>' for i, n in enumerate(names))
    citation = "mitsonar world: x east, y north, metres|"
    keys = [(1024, 0, 1, 32767), (1025, 0, 1, 1), (1026, 34737, len(citation), 0), (3076, 0, 1, 9001)]
    directory = [1, 1, 1, len(keys), *(number for key in keys for number in key)]
    tags = [
        (33550, "d", 3, (mosaic.cell_m, mosaic.cell_m, 0.0), True),  # ModelPixelScale
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
    write_whole(path, buffer.getvalue())


# ---------------------------------------------------------------- frames


def _levels(frames: SonarFrames) -> Floats:
    """Images ``(frames, bins, beams)`` as float32 in 0..1."""
    _, bins, beams = frames.image.shape
    if min(bins, beams) < 2 or max(bins, beams) > LONGEST_SIDE:
        raise MitsonarError(f"a mosaic needs images of 2 to {LONGEST_SIDE:,} bins and beams: got {bins:,} x {beams:,}")
    if (np.diff(frames.range_m) <= 0).any() or (np.diff(frames.bearing_rad) <= 0).any():
        raise MitsonarError("range_m and bearing_rad must rise: sort the images' rows and columns")
    images = frames.image.astype(np.float32) / np.float32(255 if frames.image.dtype == np.uint8 else 1)
    if not np.isfinite(images).all():
        raise MitsonarError("images must be finite: got inf or nan; 0 means no echo")
    return np.asarray(images)


def _placed(
    frames: SonarFrames, poses: ArrayLike | None, height_m: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses ``(frames, 6)`` and heights ``(frames,)``, given or the frames' own."""
    if poses is None and frames.poses is None:
        raise MitsonarError("the frames have no poses: give poses, such as those of an estimated path")
    if height_m is None and frames.height_m is None:
        raise MitsonarError(
            f"the frames do not tell their height: give {argument('height_m')}, the sonar's height over the ground"
        )
    table = _poses(frames.poses if poses is None else poses)
    if len(table) != len(frames):
        raise MitsonarError(f"each frame needs a pose: got {len(table)} poses for {len(frames)} frames")
    return table, _heights(frames.height_m if height_m is None else height_m, len(frames))


def _heights(height_m: ArrayLike | None, count: int) -> NDArray[np.float64]:
    """One height a frame ``(count,)``; nan where unknown."""
    heights = np.asarray(height_m, dtype=float)
    if heights.shape not in ((), (count,)):
        raise MitsonarError(
            f"{argument('height_m')} must be one number, or one for each of {count} frames: got {heights.shape}"
        )
    if (heights <= 0).any():
        raise MitsonarError(f"{argument('height_m')} must be above 0: got {np.nanmin(heights):g} m")
    return np.broadcast_to(heights, count)


def _poses(poses: ArrayLike | None) -> NDArray[np.float64]:
    table = np.asarray(poses, dtype=float)
    if table.ndim != 2 or table.shape[1] != 6 or not np.isfinite(table).all():
        raise MitsonarError(f"poses must be (frames, 6), finite: got {table.shape}, x, y, z [m], pitch, roll, heading [rad]")
    return table


def _and_whether_last(chunks: Iterable[SonarFrames]) -> Iterator[tuple[SonarFrames, bool]]:
    """Each chunk, and whether it is the last one: one is read ahead."""
    held = None
    for chunk in chunks:
        if held is not None:
            yield held, False
        held = chunk
    if held is not None:
        yield held, True


# ---------------------------------------------------------------- geometry of one frame


def _fan(frames: SonarFrames, pose: NDArray[np.float64], height: float) -> _Fan:
    at = Pose(*pose)
    ground = GroundGeometry(frames.range_m, frames.bearing_rad, frames.sonar.bearing, float(height), at.pitch, at.roll)
    return _Fan(ground, math.radians(frames.sonar.elevation_fov_deg) / 2)


def _centre(fan: _Fan, image: Floats, beams: int) -> tuple[_Fan, Floats]:
    """The beams in the middle alone."""
    first = max(0, (image.shape[1] - beams) // 2)
    middle = slice(first, first + beams)
    ground = replace(fan.ground, bearing_rad=fan.ground.bearing_rad[middle])
    return replace(fan, ground=ground), np.ascontiguousarray(image[:, middle])


def _reach(fan: _Fan) -> NDArray[np.float64] | None:
    """Ground points ``(n, 2)`` in heading axes around all that a frame can show; None where the ground is out of reach.

    Rays that meet the ground beyond the window's end, or never, count as far as that end allows.
    """
    ground, far = fan.ground, fan.window[1]
    if not ground.height_m < far:  # nan too
        return None
    b, e = np.meshgrid(np.linspace(*fan.sector, RAYS), np.linspace(-1, 1, RAYS) * fan.half_elevation)
    x, y, z = np.moveaxis(directions(ground.bearing, b, e) @ ground.turn.T, -1, 0)
    level = np.maximum(np.hypot(x, y), 1e-12)
    with np.errstate(divide="ignore"):
        meets = np.where(z < 0, ground.height_m * level / -z, np.inf)
    distance = np.minimum(meets, math.sqrt(far**2 - ground.height_m**2)) / level
    return np.stack([x * distance, y * distance], axis=-1).reshape(-1, 2)


def _ends(centres: NDArray[np.float64]) -> tuple[float, float]:
    """Outer edges of cells with these centres, as wide as their neighbours."""
    return float(1.5 * centres[0] - 0.5 * centres[1]), float(1.5 * centres[-1] - 0.5 * centres[-2])


def _from_middle(value: NDArray[np.floating], low: float, high: float) -> Floats:
    """0 half-way between two ends, 1 at them."""
    return np.asarray(np.abs(value - np.float32((low + high) / 2)) / np.float32((high - low) / 2), dtype=np.float32)


def _place(value: Floats, centres: NDArray[np.float64]) -> Floats:
    """Fractional index of values among centres that rise."""
    steps = np.diff(centres)
    if np.allclose(steps, steps[0], rtol=1e-6, atol=0):  # ten times as fast
        return np.asarray((value - np.float32(centres[0])) / np.float32(steps.mean()))
    return np.interp(value, centres, np.arange(centres.size)).astype(np.float32)


def _band_limited(image: Floats, bins2: float, beams2: float) -> Floats:
    """The image smoothed as far as a cell of the map spans more than a bin or a beam, so that fine texture is averaged.

    Variances add up: a square of w bins has w^2 / 12, of which each bin has 1 / 12 already.

    Args:
        image: ``(bins, beams)``.
        bins2: squared width of a cell of the map in bins.
        beams2: in beams.
    """
    along, across = (math.sqrt(max(width2 - 1, 0) / 12) for width2 in (bins2, beams2))
    if max(along, across) == 0:
        return image
    kernel = (2 * math.ceil(3 * across) + 1, 2 * math.ceil(3 * along) + 1)
    # a sigma of 0 would mean one that suits the kernel, which here is a single cell
    return np.asarray(cv2.GaussianBlur(image, kernel, across or 1.0, sigmaY=along or 1.0, borderType=cv2.BORDER_REPLICATE))


def _span2(places: Floats, weight: Floats) -> float:
    """Squared width of a cell of the map in bins or beams, the median over some that are seen."""
    rows, columns = (slice(1, None, max(1, size // 16)) for size in places.shape)
    before = slice(0, -1, rows.step), slice(0, -1, columns.step)
    here, seen = places[rows, columns], weight[rows, columns] > 0
    squared = np.square(here - places[before[0], columns]) + np.square(here - places[rows, before[1]])
    return float(np.median(squared[seen])) if seen.any() else 0.0


# ---------------------------------------------------------------- cells


def _accumulate(cells: _Sums, value: Floats, weight: Floats) -> None:
    """Weighted mean and squares about it, updated in place (West 1979): no cancellation in float32."""
    cells.weight[...] += weight
    before = value - cells.mean
    cells.mean[...] += before * (weight / np.maximum(cells.weight, np.float32(1e-30)))
    cells.squares[...] += weight * before * (value - cells.mean)
    cells.weight2[...] += weight * weight
    cells.seen[...] += weight > 0


def _around(boxes: Iterable[Box]) -> Box:
    """The smallest box around boxes."""
    south, north, west, east = zip(*boxes, strict=True)
    return Box(min(south), max(north), min(west), max(east))


def _with_slack(old: Box, new: Box, slack: float) -> Box:
    """The new box, larger on those sides where the old one had to grow."""
    if not math.prod(old.shape):
        return new
    rows, columns = (math.ceil(slack * size) for size in old.shape)
    return Box(
        new.south - rows * (new.south < old.south),
        new.north + rows * (new.north > old.north),
        new.west - columns * (new.west < old.west),
        new.east + columns * (new.east > old.east),
    )
