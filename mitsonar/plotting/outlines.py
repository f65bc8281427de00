"""How labelled regions are outlined over pictures of frames, with a legend of their names."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mitsonar.geometry.fan import CartesianMap, nearest_cells
from mitsonar.records.frames import SonarFrames

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "COLOURS",
    "LabelledRegions",
    "Outlines",
    "add_legend",
    "colours_of",
    "draw_outlines",
    "legend_rows",
    "legend_strip",
]


COLOURS = (
    (86, 180, 233),
    (0, 210, 120),
    (255, 60, 220),
    (255, 255, 255),
    (70, 100, 255),
    (170, 255, 0),
    (160, 110, 255),
    (0, 240, 230),
)
"""Colours of the classes (red, green, blue), in this order and then again; none is brown as the levels."""

ROW_PX = 26
"""Height of a row of the legend of a video [px]."""

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class LabelledRegions:
    """The labelled regions of one frame.

    Attributes:
        number: number of the region of each cell ``(bins, beams)``, counted from 1; 0 where none is.
        kind: index of the class of each region, by its number; the entry of 0 is not used.
    """

    number: NDArray[np.int32]
    kind: NDArray[np.intp]


@dataclass(frozen=True)
class Outlines:
    """Regions to outline in frames.

    Attributes:
        names: names of the classes, by index; the list may grow when ``regions`` meets a shape without a name.
        regions: function that returns the regions of a frame, given its index.
    """

    names: Sequence[str]
    regions: Callable[[SonarFrames, int], LabelledRegions]

    def on(self, fan: CartesianMap, frames: SonarFrames, index: int) -> NDArray[np.int32]:
        """Return the outlines in a fan ``(rows, columns)``: 1 + class of the outlined region, 0 elsewhere.

        An outline is two pixels wide: the pixels of its region with a neighbour of another region, or of none, and those
        after them.
        """
        labelled = self.regions(frames, index)
        number = np.asarray(nearest_cells(fan, labelled.number, 0))
        padded = np.pad(number, 1)
        edge = np.zeros(number.shape, dtype=bool)
        for rows, columns in ((0, 1), (2, 1), (1, 0), (1, 2)):
            edge |= padded[rows : rows + number.shape[0], columns : columns + number.shape[1]] != number
        thin = np.where(edge & (number > 0), labelled.kind[number] + 1, 0).astype(np.int32)
        return np.asarray(ndimage.maximum_filter(thin, size=2))


def colour_of(kind: int) -> tuple[int, int, int]:
    """Return the colour of a class."""
    return COLOURS[kind % len(COLOURS)]


def colours_of(outlines: NDArray[np.int32]) -> Picture:
    """Return outlines as a picture ``(rows, columns, 4)`` of red, green, blue and opacity."""
    table = [(0, 0, 0, 0), *((*colour_of(kind), 255) for kind in range(int(outlines.max(initial=0))))]
    return np.array(table, dtype=np.uint8)[outlines]


def draw_outlines(picture: Picture, outlines: NDArray[np.int32]) -> None:
    """Draw outlines into a picture ``(rows, columns, 3)`` of blue, green, red."""
    drawn = outlines > 0
    picture[drawn] = colours_of(outlines)[drawn][:, 2::-1]


def add_legend(figure: Figure, names: Sequence[str], kinds: Sequence[int]) -> None:
    """Add a legend of the given classes below a figure."""
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], color=f"#{bytes(colour_of(kind)).hex()}", linewidth=3, label=names[kind]) for kind in kinds]
    if lines:
        legend = figure.legend(handles=lines, loc="outside lower center", ncols=min(len(lines), 5), facecolor="0.15")
        for text in legend.get_texts():
            text.set_color("white")
            text.set_parse_math(False)  # names of shapes may hold $


def legend_strip(width: int, names: Sequence[str], rows: int) -> Picture:
    """Draw the legend of a video: a strip ``(rows * 26, width, 3)`` of blue, green, red; names that do not fit are counted.

    Args:
        width: width of the video [px].
        names: names of the classes.
        rows: number of rows of the legend.
    """
    import cv2

    strip: Any = np.zeros((rows * ROW_PX, width, 3), dtype=np.uint8)
    for kind, (column, row) in enumerate(_places(width, names)):
        if row >= rows:
            break
        last = row == rows - 1 and kind + 1 < len(names) and _places(width, names)[kind + 1][1] >= rows
        text = f"... and {len(names) - kind} more" if last else names[kind]
        base = row * ROW_PX + 18
        if not last:
            cv2.line(strip, (column, base - 5), (column + 18, base - 5), colour_of(kind)[::-1], 3)
        cv2.putText(strip, _ascii(text), (column + 25, base), *_FONT, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(strip)


def legend_rows(width: int, names: Sequence[str]) -> int:
    """Return the number of rows that a legend needs, at least 1 and at most 4."""
    return min(4, 1 + max((row for _, row in _places(width, names)), default=0))


_FONT = (0, 0.5)
"""cv2.FONT_HERSHEY_SIMPLEX, and its scale."""


def _places(width: int, names: Sequence[str]) -> list[tuple[int, int]]:
    """Return the column [px] and row of each entry of a legend."""
    import cv2

    places, column, row = [], 8, 0
    for name in names:
        needed = 25 + cv2.getTextSize(_ascii(name), *_FONT, 1)[0][0] + 16
        if column + needed > width and column > 8:
            column, row = 8, row + 1
        places.append((column, row))
        column += needed
    return places


def _ascii(text: str) -> str:
    """Return a text with the characters that OpenCV draws; it draws no others."""
    return text.encode("ascii", "replace").decode()
