"""Plain fan pictures: pixels in metres without axes or colours, and label maps beside them that mix nothing."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mitsonar.geometry.fan import CartesianMap, cartesian_map, nearest_cells
from mitsonar.io.files import write_json, write_whole
from mitsonar.records.frames import SonarFrames, to_float32, to_uint8

__all__ = ["FanPictures"]

LABELS: dict[str, tuple[str, type[np.uint8] | type[np.uint16]]] = {
    "shape_id": ("shape", np.uint16),
    "object_id": ("object", np.uint16),
    "shadow": ("shadow", np.uint8),
}
"""Label maps that become pictures: the picture's name and type. Identifiers are stored plus one: 0 is no echo."""


class FanPictures:
    """Fan pictures of frames of one sonar, forward up and starboard to the right; a pixel is as long as a range bin.

    Args:
        frames: whose ranges and bearings the pictures have.

    Attributes:
        fan: which cells make each pixel.
        pixel_m: edge of a pixel [m].
    """

    def __init__(self, frames: SonarFrames) -> None:
        step = float(np.diff(frames.range_m).mean()) if len(frames.range_m) > 1 else 1.0
        coarse = cartesian_map(frames.range_m, frames.bearing_rad, rows=2)
        low, high = coarse.extent[2:]
        self.fan: CartesianMap = cartesian_map(frames.range_m, frames.bearing_rad, rows=max(2, round((high - low) / step)))
        self.pixel_m = (high - low) / self.fan.index.shape[1]

    def picture(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        """Return the levels of one frame ``(bins, beams)``, 0..1 or 0..255, as ``(rows, columns)``; 0 outside the fan."""
        return to_uint8(np.asarray(self.fan.apply(to_float32(image))))

    def labels(self, frames: SonarFrames, index: int) -> dict[str, NDArray[Any]]:
        """Return the label pictures of one frame by name, each pixel the label of the nearest cell."""
        found = {}
        for label, (name, kind) in LABELS.items():
            values = getattr(frames, label)
            if values is not None:
                shown = values[index] + (0 if label == "shadow" else 1)
                found[name] = nearest_cells(self.fan, np.clip(shown, 0, np.iinfo(kind).max).astype(kind), 0)
        return found

    def save(self, folder: Path, frames: SonarFrames, index: int, number: int) -> None:
        """Write ``NUMBER.png`` and ``NUMBER.LABEL.png`` of one frame, and ``fan.json`` once, each whole or not at all."""
        pictures = {"": self.picture(frames.image[index]), **self.labels(frames, index)}
        for name, values in pictures.items():
            buffer = io.BytesIO()
            Image.fromarray(values).save(buffer, format="PNG", compress_level=3)
            write_whole(folder / f"{number:06d}{'.' * bool(name)}{name}.png", buffer.getvalue())
        if not (folder / "fan.json").is_file():
            starboard, forward = self.fan.extent[:2], self.fan.extent[2:]
            write_json(folder / "fan.json", {"pixel_m": self.pixel_m, "starboard_m": starboard, "forward_m": forward})
