"""How sonar frames become pictures: figures with axes, plain fan pictures with label maps, and videos."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mitsonar.acoustics.levels import decoded
from mitsonar.errors import MitsonarError, missing_package_error
from mitsonar.geometry.fan import CartesianMap, cartesian_map, nearest_cells, to_cartesian
from mitsonar.io.files import write_atomic, write_json
from mitsonar.io.runs import refuse_to_replace
from mitsonar.records.frames import SonarFrames, to_float32, to_uint8

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mitsonar.plotting.outlines import Outlines

__all__ = ["CODECS", "FanPictures", "fan_figure", "save_fan", "to_decibels", "write_fan_video"]


GAMMA = 0.6
"""Exponent applied to levels in figures, so that faint ground is visible next to bright faces; the colour bar states it."""

FIGURE_ROWS = 800
"""Rows of the fan in a figure [px]."""


def fan_figure(
    frames: SonarFrames, index: int = 0, *, title: str = "", outlines: Outlines | None = None, top_db: float = 0.0
) -> Figure:
    """Draw one frame as a fan with axes in metres: forward up, starboard to the right.

    Args:
        frames: frames to draw from.
        index: index of the frame.
        title: title of the figure.
        outlines: labelled regions to outline, with a legend.
        top_db: level of the brightest colour [dB re full scale], as given to :func:`to_decibels`.
    """
    from matplotlib.colors import Normalize, PowerNorm
    from matplotlib.figure import Figure

    fan = to_cartesian(frames.image[index], frames.range_m, frames.bearing_rad, FIGURE_ROWS)
    left, right, low, high = fan.extent
    height = 6.0
    width = float(np.clip(height * (right - left) / (high - low), 3.0, 14.0))
    figure = Figure(figsize=(width + 1.6, height), layout="constrained")
    axes = figure.add_subplot(facecolor="black")
    values = fan.image / (255 if frames.image.dtype == np.uint8 else 1)
    if frames.level == "dB":
        low, high = frames.decibels_of(0.0), frames.decibels_of(1.0)
        label = "level (dB re 1 uPa)" if frames.sonar.source_level_db else "level (dB re the source at 1 m)"
        label = "level (dB re full scale)" if high == 0 else label  # low is as far below as the coding spans, but rounded
        label += " with gain" if frames.sonar.gain_exponent or frames.sonar.gain_absorption else ""
        values, norm = low + top_db + values * (high - low), Normalize(low + top_db, high + top_db)
    else:
        norm, label = PowerNorm(GAMMA, vmin=0, vmax=1), f"level (1 = full scale; shown with gamma {GAMMA:g})"
    shown = axes.imshow(values, extent=fan.extent, cmap="copper", norm=norm, interpolation="nearest")
    axes.set(xlabel="starboard (m)", ylabel="forward (m)")
    axes.set_title(title, parse_math=False)  # names of files may hold $
    figure.colorbar(shown, ax=axes, label=label, fraction=0.04)
    if outlines is not None:
        from mitsonar.plotting.outlines import add_legend, colours_of

        drawn = outlines.on(cartesian_map(frames.range_m, frames.bearing_rad, FIGURE_ROWS), frames, index)
        axes.imshow(colours_of(drawn), extent=fan.extent, interpolation="nearest")
        add_legend(figure, outlines.names, [int(kind) - 1 for kind in np.unique(drawn) if kind > 0])
    return figure


def save_fan(
    path: str | Path,
    frames: SonarFrames,
    index: int = 0,
    *,
    title: str = "",
    outlines: Outlines | None = None,
    top_db: float = 0.0,
) -> None:
    """Write :func:`fan_figure` as a PNG file, completely or not at all."""
    buffer = io.BytesIO()
    fan_figure(frames, index, title=title, outlines=outlines, top_db=top_db).savefig(buffer, format="png", dpi=110)
    write_atomic(path, buffer.getvalue())


# ---------------- Plain fan pictures and label maps


LABELS: dict[str, tuple[str, type[np.uint8] | type[np.uint16]]] = {
    "shape_id": ("shape", np.uint16),
    "object_id": ("object", np.uint16),
    "shadow": ("shadow", np.uint8),
}
"""Name and pixel type of the picture of each label map. Identifiers are stored plus one, since 0 means no echo."""


class FanPictures:
    """Plain fan pictures of the frames of one sonar, without axes or colours: forward up, starboard to the right.

    A pixel is as long as a range bin.

    Args:
        frames: frames whose ranges and bearings define the fan.

    Attributes:
        fan: map from cells (bin, beam) to pixels.
        pixel_m: edge of a pixel [m].
    """

    def __init__(self, frames: SonarFrames) -> None:
        step = float(np.diff(frames.range_m).mean()) if len(frames.range_m) > 1 else 1.0
        coarse = cartesian_map(frames.range_m, frames.bearing_rad, rows=2)
        low, high = coarse.extent[2:]
        self.fan: CartesianMap = cartesian_map(frames.range_m, frames.bearing_rad, rows=max(2, round((high - low) / step)))
        self.pixel_m = (high - low) / self.fan.index.shape[1]

    def picture(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        """Return the picture of one image ``(bins, beams)``, 0..1 or 0..255, as ``(rows, columns)``; 0 outside the fan."""
        return to_uint8(np.asarray(self.fan.apply(to_float32(image))))

    def labels(self, frames: SonarFrames, index: int) -> dict[str, NDArray[Any]]:
        """Return the label pictures of one frame, keyed by name; each pixel has the label of the nearest cell."""
        pictures = {}
        for label, (name, kind) in LABELS.items():
            values = getattr(frames, label)
            if values is not None:
                label_map = values[index] + (0 if label == "shadow" else 1)
                pictures[name] = nearest_cells(self.fan, np.clip(label_map, 0, np.iinfo(kind).max).astype(kind), 0)
        return pictures

    def save(self, folder: Path, frames: SonarFrames, index: int, number: int) -> None:
        """Write ``NUMBER.png`` and ``NUMBER.LABEL.png`` of one frame, and ``fan.json`` unless it exists.

        Each file is written completely or not at all.

        Args:
            folder: folder of the pictures.
            frames: frames to draw from.
            index: index of the frame.
            number: number of the frame in the file names.
        """
        pictures = {"": self.picture(frames.image[index]), **self.labels(frames, index)}
        for name, values in pictures.items():
            buffer = io.BytesIO()
            Image.fromarray(values).save(buffer, format="PNG", compress_level=3)
            write_atomic(folder / f"{number:06d}{'.' * bool(name)}{name}.png", buffer.getvalue())
        if not (folder / "fan.json").is_file():
            starboard, forward = self.fan.extent[:2], self.fan.extent[2:]
            write_json(folder / "fan.json", {"pixel_m": self.pixel_m, "starboard_m": starboard, "forward_m": forward})


# ---------------- Videos of fans


CODECS = {".mp4": "mp4v", ".avi": "MJPG"}
"""Codec by file extension."""

Picture = NDArray[np.uint8]


def write_fan_video(
    chunks: Iterable[SonarFrames],
    path: str | Path,
    rate_hz: float,
    *,
    span_db: float = 60.0,
    top_db: float = 0.0,
    rows: int = 720,
    outlines: Outlines | None = None,
    overwrite: bool = False,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Write frames of one geometry as a video of fans: forward up, starboard to the right.

    Each picture shows the number of its frame and the time since the first. The file is written completely or not at all.

    Args:
        chunks: frames, in chunks of any size.
        path: video file, ``.mp4`` or ``.avi``.
        rate_hz: frames per second of the video [Hz].
        span_db: range of levels shown, downwards from the top [dB].
        top_db: level of the brightest colour [dB re full scale].
        rows: height of the picture [px], without a legend.
        outlines: labelled regions to outline, with a legend below the picture.
        overwrite: whether to replace an existing file.
        progress: called with the number of frames written since the last call.

    Returns:
        The number of frames written.

    Raises:
        MitsonarError: the file exists, its extension is unknown, there are no frames, or OpenCV cannot write the codec.
    """
    path = Path(path)
    if path.suffix.lower() not in CODECS:
        raise MitsonarError(f"{path}: videos must end in {' or '.join(CODECS)}")
    refuse_to_replace(path, overwrite=overwrite)
    if not path.parent.is_dir():
        raise MitsonarError(f"cannot write {path}: there is no folder {path.parent}; create it first")
    temporary = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        count = _write(chunks, temporary, rate_hz, (span_db, top_db), rows, outlines, progress or (lambda done: None))
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return count


def _write(
    chunks: Iterable[SonarFrames],
    path: Path,
    rate_hz: float,
    levels_db: tuple[float, float],
    rows: int,
    outlines: Outlines | None,
    progress: Callable[[int], None],
) -> int:
    """Write all frames and return their number."""
    try:
        import cv2
    except ModuleNotFoundError as error:
        raise missing_package_error(error) from None
    from mitsonar.plotting.outlines import draw_outlines, legend_rows, legend_strip

    colours, strip_rows = _colours(), 0
    writer, fan, count, first_s = None, None, 0, 0.0
    try:
        for frames in chunks:
            if fan is None:
                fan = cartesian_map(frames.range_m, frames.bearing_rad, rows=2 * (rows // 2))
            decibel_images = to_decibels(frames, *levels_db).image
            times = np.atleast_2d(frames.time_s.T).T.mean(axis=1)
            for index, (image, time) in enumerate(zip(decibel_images, times, strict=True)):
                values = np.asarray(fan.apply(np.asarray(image, np.float32)))
                picture = colours[np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)]
                if outlines is not None:
                    draw_outlines(picture, outlines.on(fan, frames, index))
                    strip_rows = strip_rows or legend_rows(picture.shape[1], outlines.names)
                    strip = legend_strip(picture.shape[1], outlines.names, strip_rows)
                    picture = np.concatenate([picture, strip])
                picture = _even(picture)
                first_s = first_s if count else float(time)
                text = f"{count}   {time - first_s:.2f} s"
                cv2.putText(picture, text, (8, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 1, cv2.LINE_AA)
                if writer is None:
                    codec = cv2.VideoWriter.fourcc(*CODECS[path.suffix.lower()])
                    writer = cv2.VideoWriter(str(path), codec, rate_hz, (picture.shape[1], picture.shape[0]))
                    if not writer.isOpened():
                        raise MitsonarError(f"OpenCV cannot write {path.suffix} here: choose another extension")
                writer.write(picture)
                count += 1
                progress(1)
    finally:
        if writer is not None:
            writer.release()
    if not count:
        raise MitsonarError("there are no frames to show")
    return count


def _colours() -> Picture:
    """Return the colour map of the other figures as blue, green, red of each value ``(256, 3)``."""
    from matplotlib import colormaps

    table = np.asarray(colormaps["copper"](np.arange(256)))[:, 2::-1]
    return np.asarray(np.rint(255 * table), dtype=np.uint8)


def _even(picture: Picture) -> Picture:
    """Pad a picture to an even number of columns, which codecs require."""
    return np.ascontiguousarray(np.pad(picture, ((0, 0), (0, picture.shape[1] % 2), (0, 0))))


# ---------------- Decibel coding


def to_decibels(frames: SonarFrames, span_db: float, top_db: float = 0.0) -> SonarFrames:
    """Convert frames of any coding to decibels: values 0..1, float32, span the ``span_db`` decibels below the top.

    Lower levels become 0, higher ones 1. The top is ``top_db`` re full scale.

    Raises:
        MitsonarError: the span is not in 0..300 dB, or the top is not finite.
    """
    if not 0 < span_db <= 300:
        raise MitsonarError(f"the span must lie in 0..300 dB: got {span_db:g}")
    if not math.isfinite(top_db):
        raise MitsonarError(f"the top must be a finite level in dB re full scale: got {top_db:g}")
    values = to_float32(frames.image)
    if frames.level == "dB":
        coded = 1 + (values - 1) * np.float32(frames.sonar.coding_db / span_db) - np.float32(top_db / span_db)
        coded[values <= 0] = 0
    else:
        with np.errstate(divide="ignore"):
            coded = 1 + (10 * np.log10(decoded(np.clip(values, 0, 1), frames.sonar, frames.level)) - top_db) / span_db
    sonar = frames.sonar.replace(coding="dB", coding_db=span_db)
    return replace(frames, image=np.clip(coded, 0, 1).astype(np.float32), level="dB", sonar=sonar)
