"""Real recordings as sonar frames: DIDSON and ARIS 3000 from fan pictures, ARIS 1200 and Oculus from raw pings."""

from __future__ import annotations

import math
import os
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import preset
from mitsonar.records.frames import SonarFrames

__all__ = ["FOLDER", "RECORDINGS", "Outline", "as_recorded", "outline_of", "recordings_folder"]

FOLDER = "MITSONAR_RECORDINGS"
"""Name of the variable of the environment that holds the folder of the recordings."""

Picture = NDArray[np.float32]


class Outline:
    """Where the fan of a picture lies [pixels]: apex, stretch of x, nearest and farthest range, half angle [rad]."""

    def __init__(self, apex: tuple[float, float], near: float, far: float, half_deg: float, stretch: float = 1.0) -> None:
        self.apex, self.near, self.far, self.half, self.stretch = apex, near, far, math.radians(half_deg), stretch

    def pixels(self, bins: int, beams: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return row and column of the middle of each cell ``(bins, beams)``."""
        radius = self.near + (np.arange(bins) + 0.5) / bins * (self.far - self.near)
        angle = ((np.arange(beams) + 0.5) / beams * 2 - 1) * self.half
        forward, right = radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)
        return self.apex[1] - forward, self.apex[0] + right / self.stretch


def polar_of(pictures: NDArray[np.uint8], outline: Outline, bins: int, beams: int) -> Picture:
    """Return fan pictures ``(frames, rows, columns)`` as ``(frames, bins, beams)`` 0..1."""
    places = outline.pixels(bins, beams)
    read = [ndimage.map_coordinates(one.astype(np.float32), places, order=1, mode="nearest") for one in pictures]
    return np.asarray(np.stack(read) / 255, dtype=np.float32)


def fan_of(image: Picture, outline: Outline, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return images ``(frames, bins, beams)`` 0..1 as fan pictures of 8 bit of that shape, bilinear."""
    bins, beams = image.shape[1:]
    row, column = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    right, forward = (column - outline.apex[0]) * outline.stretch, outline.apex[1] - row
    radius, angle = np.hypot(right, forward), np.arctan2(right, forward)
    cell = (radius - outline.near) / (outline.far - outline.near) * bins - 0.5
    beam = (angle / outline.half + 1) / 2 * beams - 0.5
    inside = (np.abs(angle) <= outline.half) & (radius >= outline.near) & (radius <= outline.far)
    drawn = [ndimage.map_coordinates(one, (cell, beam), order=1, mode="nearest") * inside for one in image]
    return np.asarray(np.rint(np.clip(np.stack(drawn), 0, 1) * 255), dtype=np.uint8)


PLAIN: dict[str, Any] = {
    "model": "coherent",
    "gain_absorption": False,
    "source_level_db": 0.0,
    "noise_level_db": None,
    "absorption_db_per_m": 0.0,
}
"""What the presets say of levels, undone: recordings have no scale. Of the gain over range nothing is documented."""


def _frames(image: NDArray[np.floating], sonar: Sonar, time_step_s: float, level: str) -> SonarFrames:
    time = np.arange(len(image), dtype=np.float64) * np.float64(time_step_s)
    return SonarFrames(image, sonar.range_m, sonar.bearing_rad, time, sonar, level=level)


LAMPREY = {
    "lamprey2": Outline((199.1, 810.1), 37, 809.5, 14.15),
    "lamprey4": Outline((199.4, 807.2), 271, 806.3, 14.15),
}


def didson(folder: Path, name: str, window: tuple[float, float]) -> SonarFrames:
    """Return a DIDSON video, fixed sonar, 90 dB in 255 counts, MPEG-4. Apache-2.0, 2018 Brad Safnuk (DIDSON.jl)."""
    with np.load(folder / "didson-static-video" / f"{name}_first30.npz") as table:
        pictures = table["frames"][:12]
    sonar = preset("didson300").replace(
        **PLAIN, frequency_hz=1.8e6, azimuth_fov_deg=28.3, gain_exponent=0, coding="dB", coding_db=90.0,
        range_min=window[0], range_max=window[1],
    )  # fmt: skip
    return _frames(polar_of(pictures, LAMPREY[name], 512, 96), sonar, 0.1, "dB")


def _tank(folder: Path, name: str) -> tuple[NDArray[np.uint8], Outline]:
    """Return the fan pictures of a tank and their outline."""
    with np.load(folder / "marine-debris-aris3000" / f"{name}.npz") as table:
        pictures, apex = table["frames"][:12], table["apex_xy"]
        near, far, stretch = (float(table[key]) for key in ("rmin_px", "rmax_px", "kx"))
    return pictures, Outline((float(apex[0]), float(apex[1])), near, far, 14.95, stretch)


def aris3000(folder: Path, name: str) -> SonarFrames:
    """Return fan pictures of a moving ARIS 3000 in a tank, 80 dB in 255 counts. Licence unknown: not for documents."""
    pictures, outline = _tank(folder, name)
    sonar = preset("aris3000").replace(
        **PLAIN, frequency_hz=3.0e6, azimuth_fov_deg=29.9, gain_exponent=0, coding="dB", coding_db=80.0,
        range_bins=430, range_min=1.6, range_max=3.975,
    )  # fmt: skip
    return _frames(polar_of(pictures, outline, 430, 128), sonar, 1 / 15, "dB")


def aris1200(folder: Path) -> SonarFrames:
    """Return six raw frames of a resting ARIS 1200 with telephoto lens. MIT, 2015 Sound Metrics (aris-file-sdk)."""
    data = (folder / "aris1200-sdk-sample" / "sample.aris").read_bytes()
    head, samples, beams = 1024, *struct.unpack_from("<I", data, 1024 + 468), 48
    (delay,), (period,) = struct.unpack_from("<I", data, head + 476), struct.unpack_from("<I", data, head + 452)
    (speed,) = struct.unpack_from("<f", data, head + 464)
    size = head + samples * beams
    raw = [
        np.frombuffer(data, np.uint8, samples * beams, position + head)
        for position in range(head, len(data) - size + 1, size)
    ]
    image = np.stack(raw).reshape(-1, samples, beams)[:, :, ::-1].astype(np.float32) / 255
    near, step = delay * 0.5e-6 * speed, period * 0.5e-6 * speed
    sonar = Sonar.create(
        name="aris1200", **PLAIN, frequency_hz=1.2e6, azimuth_fov_deg=14.9, elevation_fov_deg=3.0, beams=beams,
        beam_width_deg=0.31, bearing="cone", range_min=near, range_max=near + samples * step, range_bins=samples,
        sound_speed=speed, frame_rate_hz=6.55, coding="dB", coding_db=80.0,
    )  # fmt: skip
    return _frames(image, sonar, 0.153, "dB")


def oculus(folder: Path) -> SonarFrames:
    """Return three raw pings of a resting Oculus at 2.1 MHz, amplitude^0.5. BSD-3-Clause, University of Washington.

    Of the gain: what is new in every ping, so noise, is 34 dB stronger at 1.85 m than at 0.18 m. R^3 and absorption undone
    (1.14 dB/m) make 34.1 dB.
    """
    data = (folder / "oculus-m1200d-three-pings" / "three_pings_8bit.raw").read_bytes()
    images, position = [], 0
    while position < len(data):
        (payload,) = struct.unpack_from("<I", data, position + 10)
        (step,), (bins, beams), (begin,) = (
            struct.unpack_from(form, data, position + place) for form, place in (("<d", 98), ("<HH", 106), ("<I", 110))
        )
        images.append(np.frombuffer(data, np.uint8, bins * beams, position + begin).reshape(bins, beams))
        position += 16 + payload
    sonar = preset("oculus-m1200d-2100khz").replace(
        **PLAIN | {"gain_absorption": True, "absorption_db_per_m": 1.14}, frequency_hz=2.1e6, beams=beams, range_min=0.0,
        range_max=bins * step, range_bins=bins, sound_speed=1490.66, gain_exponent=3, coding="gamma", coding_gamma=0.5,
    )  # fmt: skip
    return _frames(np.stack(images).astype(np.float32) / 255, sonar, 1 / 40, "gamma")


RECORDINGS: dict[str, Callable[[Path], SonarFrames]] = {
    "DIDSON lamprey2": lambda folder: didson(folder, "lamprey2", (0.475, 10.4)),
    "DIDSON lamprey4": lambda folder: didson(folder, "lamprey4", (5.04, 15.0)),
    "ARIS 1200": aris1200,
    "ARIS 3000 tyre": lambda folder: aris3000(folder, "translate_tyre"),
    "ARIS 3000 chain": lambda folder: aris3000(folder, "forward_chain"),
    "Oculus 2.1 MHz": oculus,
}
"""What can be read, by the name that tables and pictures show."""


def recordings_folder(given: str | None) -> Path | None:
    """Return the folder of the recordings that is given or in the environment; None where there is none."""
    name = given or os.environ.get(FOLDER)
    folder = Path(name) if name else None
    return folder if folder is not None and (folder / "didson-static-video").is_dir() else None


def outline_of(folder: Path, pictures: str) -> tuple[Outline, tuple[int, int]]:
    """Return the outline of a recording's pictures, and their rows and columns."""
    if pictures in LAMPREY:
        return LAMPREY[pictures], {"lamprey2": (774, 400), "lamprey4": (544, 400)}[pictures]
    return _tank(folder, pictures)[1], (480, 320)


def as_recorded(image: NDArray[np.floating], folder: Path, pictures: str, video: bool) -> Picture:
    """Return images ``(frames, bins, beams)`` 0..1 after the way of a recording: fan pictures of 8 bit, MPEG-4, and back."""
    outline, shape = outline_of(folder, pictures)
    drawn = fan_of(np.asarray(image, dtype=np.float32), outline, shape)
    return polar_of(_video(drawn) if video else drawn, outline, image.shape[1], image.shape[2])


def _video(pictures: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return pictures after MPEG-4, as it comes out of OpenCV."""
    import cv2

    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "frames.avi")
        rows, columns = pictures.shape[1:]
        writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"mp4v"), 10, (columns, rows), isColor=True)
        for one in pictures:
            writer.write(np.repeat(one[:, :, None], 3, axis=2))
        writer.release()
        reader = cv2.VideoCapture(path)
        read = [reader.read()[1] for _ in pictures]
        reader.release()
    if any(one is None for one in read):
        return pictures
    return np.stack([one[:, :, 0] for one in read]).astype(np.uint8)
