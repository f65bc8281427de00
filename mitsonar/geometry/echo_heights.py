"""Height of the sonar over the visible surface by the first and the last echoes of each beam, and whether it is level.

The steepest rays of a beam meet the scene first, the shallowest ones last. So the ranges of the first and of the last echo
measure the height at the near and at the far end of the lit ground. Over level ground both are alike, but for a skirt of the
light, which makes the first too small and the last too large. Where the last is much smaller, the ground rises.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.instruments.beams import half_power, shaded_sinc
from mitsonar.instruments.views import directions
from mitsonar.motion.pose import Pose, vehicle_rotation

if TYPE_CHECKING:
    from mitsonar.records.frames import SonarFrames

__all__ = ["EchoHeights", "FirstEchoes", "echo_heights"]

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

TOPS = 0.5
"""Height of the contrast above the mean of the first echoes, as part of the height between that mean and their lowest tenth.

On rocky fields of 30 and 60 rocks of each kind a side the error is 0.06 and 0.04 m rms. Where 130 rocks hide the floor it is
0.10 m.
"""

EVEN = 0.005
"""Largest distance of the quartiles of the height under the steepest rays on even ground, as part of the height."""

BLUR = 2.0
"""Standard deviation of the blur along range [bins]."""

CLEAR = 90
"""Percentile of the beams by last echo: shadows of rocks end the light of the others early."""

NEAREST = 0.5
"""Least range at which the profile of a skirt is computed, as part of that of the first echoes."""

ROUNDS = 4
"""Rounds of the height that the profile of a skirt tells."""

FEWEST_BEAMS = 8

FAINTEST = 1e-9
"""Level, as part of full scale, below which nothing is an echo."""

SHARE, SHARE_OF_SKIRT = 0.15, 0.5
"""Level of an echo, as part of that in the middle of the window. Side lobes look straight down and answer before a skirt."""

EDGE = 15
"""Bins at the near or far side of the window that show what no echo looks like."""

STEEP = 0.2
"""Least median sine of the angle at which the shallowest rays go down: below it echoes end because they are faint."""


class FirstEchoes(NamedTuple):
    """Height from the first echoes, the contrast's height above their mean [m], and whether the ground is even."""

    height_m: float
    tops_m: float
    even: bool


class EchoHeights(NamedTuple):
    """Heights [m] by the ends of the light; None where the window does not show them.

    Attributes:
        first: by the first echoes.
        last_m: mean by the last echoes.
        ends_m: mean by both.
        last_clear_m: by the last echoes of those beams that shadows cut least.
    """

    first: FirstEchoes | None
    last_m: float | None = None
    ends_m: float | None = None
    last_clear_m: float | None = None


def echo_heights(frames: SonarFrames, pitch_rad: float, roll_rad: float) -> EchoHeights:
    """Measure how far below the sonar the steepest and the shallowest ray of each beam end.

    It is measured on levels: codings such as ``dB`` and ``gamma`` lift the skirt of the light to a height like the ground's.

    Args:
        frames: whose mean is looked at.
        pitch_rad: of the sonar, > 0 points down.
        roll_rad: > 0 puts starboard down.
    """
    if frames.level == "contrast":
        return EchoHeights(None)  # its dark parts are no water without echoes
    edged = frames.sonar.vertical_pattern == "box"
    image = frames.linear_values().mean(axis=0, dtype=np.float32)
    across = (3, 0.5) if edged else (13, 2.0)  # speckle crosses a threshold early: more of it is averaged
    smooth = cv2.GaussianBlur(image, (across[0], 13), sigmaX=across[1], sigmaY=BLUR, borderType=cv2.BORDER_REPLICATE)
    steepest = _down(frames, pitch_rad, roll_rad, far=False)
    near = _ends(smooth, frames.range_m, steepest, SHARE if edged else SHARE_OF_SKIRT)
    if not edged and near.shown:
        near = near.scaled(_skirt(frames, pitch_rad, near))
    first = _first_echoes(near.received) if near.shown else None
    down = _down(frames, pitch_rad, roll_rad, far=True)
    if np.median(down) < STEEP or not edged:  # the light of a beam with a skirt fades: its last echo tells nothing
        return EchoHeights(first)
    far = _ends(smooth[::-1], frames.range_m[::-1], down)
    if not far.shown:
        return EchoHeights(first)
    both = float(np.concatenate([near.ended, far.ended]).mean())
    return EchoHeights(first, float(far.ended.mean()), both, float(np.percentile(far.ended, CLEAR)))


def _down(frames: SonarFrames, pitch: float, roll: float, *, far: bool) -> Doubles:
    """Return how much of the shallowest (``far``) or steepest ray of each beam points down ``(beams,)``."""
    half = np.radians(frames.sonar.elevation_fov_deg) / 2
    ray = directions(frames.sonar.bearing, frames.bearing_rad, half if far else -half)
    return np.asarray(-vehicle_rotation(Pose(0, 0, 0, pitch, roll, 0)).apply(ray)[:, 2])


class _Ends(NamedTuple):
    """How far below the sonar beams' first echoes lie [m].

    Attributes:
        received: of all beams with an echo.
        ended: of those whose first echo lies within the window.
        shown: whether these are enough.
        range_m: median range of the first echoes.
        threshold: level of a first echo over the dark, as part of the mean level of the middle of the window over it.
    """

    received: Doubles
    ended: Doubles
    shown: bool
    range_m: float
    threshold: float

    def scaled(self, factor: float) -> _Ends:
        """Return the ends of rays that point down so many times as much."""
        return self._replace(received=self.received * factor, ended=self.ended * factor)


def _ends(smooth: Floats, range_m: Doubles, down: Doubles, share: float = SHARE) -> _Ends:
    """Measure how far below the sonar the first echoes of the beams lie.

    Args:
        smooth: levels ``(bins, beams)``; rows in the order in which they are searched.
        range_m: of the rows.
        down: part of each beam's ray that points down ``(beams,)``.
        share: level of an echo over the dark, as part of that of the middle of the window.
    """
    bins = len(smooth)
    darkest, dark = (float(level) for level in np.percentile(smooth[:EDGE], [5, 25]))
    spread = (dark - darkest) / 0.97  # quartile to twentieth of a Gaussian, in standard deviations
    bright = float(smooth[bins // 4 : 3 * bins // 4].mean())
    over_dark = max(5 * spread, share * (bright - dark), FAINTEST)
    over = smooth > dark + over_dark
    first = over.argmax(axis=0)
    received = over.any(axis=0)
    ended = received & (first > 2)  # else the window cuts the light
    drop = range_m[first] * down
    shown = bool(ended.sum() >= max(FEWEST_BEAMS, len(down) // 4))
    middle_m = float(np.median(range_m[first[received]])) if received.any() else 0.0
    return _Ends(drop[received], drop[ended], shown, middle_m, over_dark / max(bright - dark, FAINTEST))


def _skirt(frames: SonarFrames, pitch_rad: float, near: _Ends) -> float:
    """Return how much steeper the ray of a first echo goes down than the edge of the light, for beams with a skirt.

    The profile of level ground under the pattern of a uniform aperture, blurred as the frames are, crosses the same
    threshold somewhere; the height at which it does so where the frames do is the fixed point of a few rounds.
    """
    sonar, bin_m = frames.sonar, float(np.diff(frames.range_m).mean())
    before = np.arange(frames.range_m[0] - bin_m, NEAREST * near.range_m, -bin_m)[
        ::-1
    ]  # a skirt may begin before the window
    range_m, window = (
        np.append(before, frames.range_m),
        slice(len(before) + len(frames.range_m) // 4, -(len(frames.range_m) // 4)),
    )
    power = 4 if sonar.vertical_pattern == "two_way" else 2
    half = math.radians(sonar.elevation_fov_deg) / 2
    edge_down = math.sin(min(pitch_rad + half, math.pi / 2))
    height = near.range_m * edge_down
    for _ in range(ROUNDS):
        sine = np.clip(height / range_m, 0.0, 0.999)
        off_axis = np.sin(pitch_rad - np.arcsin(sine)) / math.sin(half)
        pattern = np.abs(shaded_sinc(half_power((), power) * off_axis, ())) ** power
        level = np.where(height < range_m, pattern * range_m ** (sonar.gain_exponent - 5) / np.sqrt(1 - sine**2), 0.0)
        level = cv2.GaussianBlur(level, (1, 13), sigmaX=1e-3, sigmaY=BLUR, borderType=cv2.BORDER_REPLICATE).ravel()
        below = level[: level.argmax() + 1] <= near.threshold * level[window].mean()
        if not below.any():
            return 1.0
        crossing = range_m[np.flatnonzero(below)[-1] + 1]  # that of the main lobe: side lobes straight down are narrow
        height *= near.range_m / float(crossing)
    return height / (near.range_m * edge_down)


def _first_echoes(drop: Doubles) -> FirstEchoes | None:
    """Return the height by first echoes that lie so far below the sonar [m]; None where it is not above 0."""
    low, high, lowest = np.percentile(drop, [25, 75, 90])
    height = float(drop.mean() - TOPS * (lowest - drop.mean()))
    if not height > 0:
        return None
    return FirstEchoes(height, float(drop.mean()) - height, bool(high - low < EVEN * height))
