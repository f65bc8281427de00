"""The estimator that a checkpoint is: a trained network between two frames and a motion, with doubts where they are due."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from mitsonar.dataset.arrangement import Arrangement
from mitsonar.dataset.ground import ground_of
from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import INPUTS, Estimate, blank, matching_doubt, two_frames, unbelieved
from mitsonar.frames import SonarFrames
from mitsonar.geometry import cartesian_map
from mitsonar.height import Standing, standing_of
from mitsonar.metrics import AXES, in_units
from mitsonar.motion import Motion
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.networks.create import called
from mitsonar.networks.look import Ground, Look
from mitsonar.noise import NoiseModel
from mitsonar.sonar import Sonar
from mitsonar.viewframes import ViewFrames

__all__ = ["Instrument", "Network", "answer_of", "inputs_of", "one_thread"]

Pair = tuple[NDArray[np.float32], NDArray[np.float32]]
Axes = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Ranges of the bins and bearings of the beams."""

BEYOND = 1.2
"""Answers beyond the motions of training by this factor are not believed."""

HEIGHT_OFF, ANGLE_OFF_DEG = 0.1, 2.0
"""How far height, as part of it, and pitch and roll may be from those that training has fixed."""

WINDOW_OFF = 0.02
"""How far window and field of view may be from those of training, as part of them."""

SMOOTH = (2.0, 0.8)
"""Standard deviations of the filter before frames are matched [bins, beams]."""

CELL = 4
"""Bins of the cells in which frames are compared that an answer has brought together."""

BLOCK = 16
"""Such cells and beams of the blocks over which what is matched must be spread."""


class Instrument(NamedTuple):
    """The numbers of a sonar that a network knows from training."""

    name: str
    bins: int
    beams: int
    window_m: tuple[float, float]
    azimuth_fov_deg: float
    elevation_fov_deg: float
    bearing: str

    @classmethod
    def of(cls, sonar: Sonar) -> Instrument:
        """As the sonar says."""
        return cls.in_frames(sonar, sonar.range_m, sonar.bearing_rad)

    @classmethod
    def in_frames(cls, sonar: Sonar, range_m: NDArray[np.float64], bearing_rad: NDArray[np.float64]) -> Instrument:
        """Of a sonar whose frames have these bins and beams."""
        half = (range_m[-1] - range_m[0]) / max(1, len(range_m) - 1) / 2
        span = (bearing_rad[-1] - bearing_rad[0]) * len(bearing_rad) / max(1, len(bearing_rad) - 1)
        window = (float(range_m[0] - half), float(range_m[-1] + half))
        size = (len(range_m), len(bearing_rad))
        return cls(sonar.name, *size, window, math.degrees(span), sonar.elevation_fov_deg, sonar.bearing)

    def unlike(self, other: Instrument) -> str:
        """The numbers in which another differs: ``beams 128, not 96; ...``; empty where none does."""
        found = []
        for what in ("bins", "beams", "bearing"):
            if getattr(self, what) != getattr(other, what):
                found.append(f"{what} {getattr(other, what)}, not {getattr(self, what)}")
        for what in ("azimuth_fov_deg", "elevation_fov_deg"):
            mine, its = getattr(self, what), getattr(other, what)
            if abs(its - mine) > WINDOW_OFF * mine:
                found.append(f"{what} {its:.4g}, not {mine:.4g}")
        ends = zip(self.window_m, other.window_m, strict=True)
        if any(abs(its - mine) > WINDOW_OFF * self.window_m[1] for mine, its in ends):
            mine, its = (f"{near:.3g}..{far:.3g} m" for near, far in (self.window_m, other.window_m))
            found.append(f"window {its}, not {mine}")
        return "; ".join(found)


@dataclass(init=False, eq=False)
class Network:
    """A trained network.

    Args:
        checkpoint: of it; it must take two frames of one view.
        force: go on with another sonar than that of training.
        height_m: over the ground, where the window shows no first echoes; only for networks that know the geometry, as
        pitch_rad: is, and
        relief_m: mean height over the ground of what is seen.

    Attributes:
        digest: of the network.
        inputs: what it is given beside the images.

    Raises:
        MitsonarError: a checkpoint that needs something else than two frames, that does not fit its network, or whose
            geometry is fixed by training but given here.
    """

    digest: str
    force: bool
    height_m: float | None
    pitch_rad: float | None
    relief_m: float | None

    def __init__(
        self,
        checkpoint: Checkpoint,
        *,
        force: bool = False,
        height_m: float | None = None,
        pitch_rad: float | None = None,
        relief_m: float | None = None,
    ) -> None:
        self._check_input(checkpoint)
        if not checkpoint.arrangement["ground"] and any(value is not None for value in (height_m, pitch_rad, relief_m)):
            raise MitsonarError(f"this {checkpoint.network} is given no geometry: {checkpoint.fixed} are fixed by training")
        self.force, self.height_m, self.pitch_rad, self.relief_m = force, height_m, pitch_rad, relief_m
        self._take(checkpoint)

    def _check_input(self, checkpoint: Checkpoint) -> None:
        """Whether the network reads what an estimator has."""
        words = checkpoint.arrangement
        if words["frames"] != 2 or len(words["views"]) != 1:
            raise MitsonarError(
                f"an estimator has two frames of one view: this {checkpoint.network} is given {words['frames']} frames of "
                f"{', '.join(words['views'])} as {words['kind']}s; use `mitsonar odometry` on a data set that holds them, "
                "`mitsonar evaluate`, or another checkpoint"
            )

    def _take(self, checkpoint: Checkpoint) -> None:
        """What computes is no field: files and comparisons of options need the digest only."""
        self.digest, self.inputs = checkpoint.digest, inputs_of(checkpoint)
        self._checkpoint, self._network = checkpoint, checkpoint.build()
        self._trained = {view: Instrument.of(sonar) for view, sonar in checkpoint.sonars.items()}
        self._last: tuple[bytes, Arrangement] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """For other processes: torch would share its tensors through file descriptors."""
        return {**asdict(self), "content": self._checkpoint.to_bytes()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        content = state.pop("content")
        vars(self).update(state)
        self._take(Checkpoint.from_bytes(content))

    def estimate(self, frames: SonarFrames) -> Estimate:
        """The motion that the network says, its covariance, and whether to believe it.

        Raises:
            MitsonarError: not two frames, another sonar than that of training, frames without what the network needs.
        """
        images = two_frames(frames)
        self._check_sonar(frames)
        if any(blank(image) for image in images):
            return unbelieved("nothing in the frames to match")
        standing = self._standing(frames)
        if standing is not None and standing.doubt:
            return unbelieved(standing.doubt)
        ground = {} if standing is None else _batch(ground_of(frames, standing))
        with torch.inference_mode(), one_thread():
            targets, covariances = self._checkpoint.decode(self._answer(frames, images, ground))
        if not np.isfinite(targets).all():
            return unbelieved("the network's answer is not finite")
        motion = Motion(*targets[0].tolist())
        covariance = self._checkpoint.covariance if covariances is None else covariances[0]
        reason = self._doubt_of_standing(frames) or self._doubt_of_size(motion)
        if not reason:
            reason = _doubt_of_answer(images, ground, motion) if ground else self._doubt_of_match(frames, images)
        return Estimate(motion, covariance, not reason, reason)

    def _check_sonar(self, frames: SonarFrames) -> None:
        """Refuse another sonar than that of training, unless it is forced."""
        if self.force:
            return
        for trained in self._trained.values():
            has = Instrument.in_frames(frames.sonar, frames.range_m, frames.bearing_rad)
            unlike = trained.unlike(has)
            if unlike:
                raise MitsonarError(
                    f"this {self._checkpoint.network} was trained on the sonar {trained.name}, the frames are of "
                    f"{has.name}: {unlike}; train on that sonar, use corrnet or direct, or force it with RUN:force=1"
                )

    def _standing(self, frames: SonarFrames) -> Standing | None:
        """Height and pitch, for a network that is given them."""
        if not self._checkpoint.arrangement["ground"]:
            return None
        return standing_of(frames, self._checkpoint.network, self.height_m, self.pitch_rad, self.relief_m)

    def _answer(self, frames: SonarFrames, images: Pair, ground: Ground) -> Any:
        """What the network says of the frames, as a batch of one."""
        (view,) = self._checkpoint.arrangement["views"]
        inputs = self._arrangement(frames)({view: torch.from_numpy(np.stack(images)[None])}, torch.arange(2)[None], 0)
        return answer_of(self._network, (inputs, ground) if ground else inputs)

    def _arrangement(self, frames: SonarFrames) -> Arrangement:
        """From the frames to the network's input."""
        (view,) = self._checkpoint.arrangement["views"]
        return self._arranged({view: (frames.range_m, frames.bearing_rad)})

    def _arranged(self, axes: dict[str, Axes]) -> Arrangement:
        """From frames of these views to the network's input; kept, since it is that of the frames before."""
        key = b"".join(axis.tobytes() for both in axes.values() for axis in both)
        if self._last is None or self._last[0] != key:
            words = self._checkpoint.arrangement
            maps = {}
            if words["coordinates"] != "polar":
                maps = {view: cartesian_map(*both, words["cartesian_rows"]) for view, both in axes.items()}
            beams = {view: len(bearing_rad) for view, (_, bearing_rad) in axes.items()}
            made = Arrangement(tuple(axes), words["kind"], words["layout"], words["coordinates"], NoiseModel(), beams, maps)
            made = replace(made, range_levels=words.get("range_levels"), halves=words.get("halves", False))
            self._last = key, made
        return self._last[1]

    # ---------------------------------------------------------------- doubts

    def _doubt_of_standing(self, frames: SonarFrames | ViewFrames) -> str:
        """Whether the sonar stood as in training, as far as the frames tell; networks that are given it need not."""
        if self._checkpoint.arrangement["ground"]:
            return ""
        stands = self._checkpoint.stands
        low, high = stands["height_m"]
        heights = [np.nanmean(frames.height_m)] if frames.height_m is not None and np.isfinite(frames.height_m).any() else []
        if heights and frames.poses is not None:  # over z = 0: straight below there may be a rock
            heights.append(frames.poses[:, 2].mean())
        if heights and not any(low * (1 - HEIGHT_OFF) <= height <= high * (1 + HEIGHT_OFF) for height in heights):
            return f"the sonar stood at {heights[0]:.2f} m: {self._checkpoint.fixed} are fixed by training"
        if frames.poses is not None:
            for name, column in (("pitch", 3), ("roll", 4)):
                angle = math.degrees(frames.poses[:, column].mean())
                if abs(angle - stands[f"{name}_deg"]) > ANGLE_OFF_DEG:
                    return f"the sonar had a {name} of {angle:.1f} deg: {self._checkpoint.fixed} are fixed by training"
        return ""

    def _doubt_of_size(self, motion: Motion) -> str:
        """Whether the answer is of the size that training had."""
        coder = self._checkpoint.coder
        middle, half = (coder.low + coder.high) / 2, (coder.high - coder.low) / 2
        beyond = np.abs(np.array(motion) - middle) > BEYOND * half
        if not beyond.any():
            return ""
        axis = int(beyond.argmax())
        value, low, high = in_units(np.array([motion, coder.low, coder.high]))[:, axis]
        name, unit, _ = AXES[axis]
        return f"{name} {value:.3g} {unit} is beyond the motions of training, {low:.3g}..{high:.3g} {unit}"

    def _doubt_of_match(self, frames: SonarFrames, images: Pair) -> str:
        """Whether the frames show one place at all: they must be alike once shifted, as far as training's motions go."""
        first, second = (smooth(image) for image in images)
        size = first.shape
        rows, columns = (min(reach, length // 3) for reach, length in zip(self._reach(frames), size, strict=True))
        middle = second[rows : size[0] - rows, columns : size[1] - columns]
        found = cv2.matchTemplate(without_slow(first), without_slow(middle), cv2.TM_CCOEFF_NORMED)
        row, column = np.unravel_index(int(found.argmax()), found.shape)
        there = first[row : row + middle.shape[0], column : column + middle.shape[1]]
        inside = np.ones(middle.shape, dtype=bool)
        return matching_doubt(there, middle, inside, alike=4 * math.pi * SMOOTH[0] * SMOOTH[1])

    def _reach(self, frames: SonarFrames) -> tuple[int, int]:
        """How far an echo can move between frames in bins and in beams, by the motions of training."""
        coder = self._checkpoint.coder
        sideways, forward, yaw = BEYOND * np.maximum(np.abs(coder.low), np.abs(coder.high))
        bin_m, beam_rad = (float(np.median(np.diff(axis))) for axis in (frames.range_m, frames.bearing_rad))
        outward = forward + sideways * math.sin(min(math.pi / 2, np.abs(frames.bearing_rad).max()))
        across = yaw + sideways / frames.range_m[0]
        return 2 + int(outward / bin_m), 2 + int(across / beam_rad)


def inputs_of(checkpoint: Checkpoint) -> str:
    """What a network is given beside the images, for tables."""
    return INPUTS if checkpoint.arrangement["ground"] else f"nothing; {checkpoint.fixed} fixed by training"


def answer_of(network: nn.Module, inputs: Any) -> Any:
    """What a network answers; several inputs come as a tuple.

    Raises:
        MitsonarError: inputs of a size that it cannot take.
    """
    try:
        return called(network, inputs)
    except RuntimeError as error:
        raise MitsonarError(f"the network cannot take these frames: {error}") from None


def _batch(table: dict[str, NDArray[np.float32]]) -> Ground:
    """A batch of one."""
    return {name: torch.from_numpy(values)[None] for name, values in table.items()}


def _doubt_of_answer(images: Pair, ground: Ground, motion: Motion) -> str:
    """Whether the frames are alike once the second is drawn where the answer takes what the first shows."""
    rows, beams = images[0].shape[0] // CELL, images[0].shape[1]
    means = (image[: rows * CELL].reshape(rows, CELL, beams).mean(axis=1) for image in images)
    first, second = (smooth(mean, CELL) for mean in means)
    look = Look(ground, torch.ones(1, 3), (CELL, 1), images[0].shape, first.shape, None)
    back, inside = look.draw(torch.from_numpy(second)[None, None], torch.tensor([motion]))
    alike = 4 * math.pi * math.hypot(SMOOTH[0] / CELL, 12**-0.5) * SMOOTH[1]
    return matching_doubt(first, back[0, 0].numpy(), inside[0].numpy() > 0, alike=alike, block=BLOCK)


def smooth(image: NDArray[np.float32], step: int = 1) -> NDArray[np.float32]:
    """With less noise; ``step`` bins are a cell."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigmaX=SMOOTH[1], sigmaY=SMOOTH[0] / step), dtype=np.float32)


def without_slow(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """What is slow belongs to the sonar's lighting, not to the ground."""
    return np.asarray(image - cv2.blur(image, (16, 16)), dtype=np.float32)


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch computes with one thread: a pair is too small for more, and pairs are for the processes to share."""
    had = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(had)
