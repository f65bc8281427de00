"""What all estimators that a checkpoint makes have in common: the network, its sonar, and rejections that need no images."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.datasets.arrangement import Arrangement
from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import INPUTS
from mitsonar.geometry.fan import cartesian_map
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.composition import Motion
from mitsonar.motion.errors import AXES
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.networks.corrnet import GaussianHead, Ground
from mitsonar.networks.create import called
from mitsonar.records.frames import SonarFrames, ViewFrames

__all__ = [
    "ANGLE_OFF_DEG",
    "BEYOND",
    "HEIGHT_OFF",
    "NetworkInput",
    "Trained",
    "TrainedInstrument",
    "answer_of",
    "inputs_of",
    "one_thread",
]

Axes = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Ranges of the bins ``(bins,)`` [m] and bearings of the beams ``(beams,)`` [rad]."""

NetworkInput = Tensor | tuple[Tensor | Ground, ...]
"""What a network reads: a tensor, or a tuple of tensors and of the geometry of the ground."""

BEYOND = 1.2
"""Factor by which a valid motion may exceed those of training."""

HEIGHT_OFF, ANGLE_OFF_DEG = 0.1, 2.0
"""How far height, as part of it, and pitch and roll may be from those that training has fixed."""

WINDOW_OFF = 0.02
"""How far window and field of view may be from those of training, as part of them."""


class TrainedInstrument(NamedTuple):
    """The numbers of a sonar that a network knows from training."""

    name: str
    bins: int
    beams: int
    window_m: tuple[float, float]
    azimuth_fov_deg: float
    elevation_fov_deg: float
    bearing: str

    @classmethod
    def of(cls, sonar: Sonar) -> TrainedInstrument:
        """As the sonar says."""
        return cls.in_frames(sonar, sonar.range_m, sonar.bearing_rad)

    @classmethod
    def in_frames(cls, sonar: Sonar, range_m: NDArray[np.float64], bearing_rad: NDArray[np.float64]) -> TrainedInstrument:
        """Of a sonar whose frames have these bins and beams."""
        half = (range_m[-1] - range_m[0]) / max(1, len(range_m) - 1) / 2
        span = (bearing_rad[-1] - bearing_rad[0]) * len(bearing_rad) / max(1, len(bearing_rad) - 1)
        window = (float(range_m[0] - half), float(range_m[-1] + half))
        size = (len(range_m), len(bearing_rad))
        return cls(sonar.name, *size, window, math.degrees(span), sonar.elevation_fov_deg, sonar.bearing)

    def unlike(self, other: TrainedInstrument) -> str:
        """Return the numbers in which another differs: ``beams 128, not 96; ...``; empty where none does."""
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
class Trained:
    """A network with its weights.

    Attributes:
        digest: of the network.
        force: go on with another sonar than that of training.
        inputs: what it is given beside the images.
    """

    digest: str
    force: bool
    instead: ClassVar[str] = "corrnet or direct"
    """What serves other sonars."""

    @property
    def checkpoints(self) -> tuple[Checkpoint, ...]:
        """Return the checkpoint."""
        return (self._checkpoint,)

    @property
    def heights(self) -> tuple[float, float]:
        """Lowest and highest of training [m]."""
        low, high = self._checkpoint.trained_at["height_m"]
        return float(low), float(high)

    def _take(self, checkpoint: Checkpoint) -> None:
        """Keep the network out of the fields: files and comparisons of options need the digest only."""
        self.digest, self.inputs = checkpoint.digest, inputs_of(checkpoint)
        self._checkpoint, self._network = checkpoint, checkpoint.build()
        self._trained = {view: TrainedInstrument.of(sonar) for view, sonar in checkpoint.sonars.items()}
        self._last: tuple[bytes, Arrangement] | None = None

    def __getstate__(self) -> dict[str, object]:
        """For other processes: torch would share its tensors through file descriptors."""
        return {**asdict(self), "content": self._checkpoint.to_bytes()}

    def __setstate__(self, state: dict[str, object]) -> None:
        content = state.pop("content")
        assert isinstance(content, bytes)
        vars(self).update(state)
        self._take(Checkpoint.from_bytes(content))

    @property
    def kind(self) -> str:
        """``image`` or ``vector``, that it reads."""
        return str(self._checkpoint.arrangement["kind"])

    def _input_of_views(self, frames: ViewFrames) -> NetworkInput:
        """Return the input of the network from the pings of its views, a batch of one.

        Raises:
            MitsonarError: views that are not there, or of another sonar than that of training.
        """
        names = self._checkpoint.arrangement["views"]
        lacking = [view for view in names if view not in frames.values]
        if lacking:
            raise MitsonarError(
                f"this {self._checkpoint.network} is given {', '.join(names)}: got {', '.join(frames.values)}; read them "
                "from a data set that holds them"
            )
        for view in names:
            self._check_instrument(view, TrainedInstrument.of(frames.sonars[view]))
        values = {view: torch.from_numpy(np.asarray(frames.values[view])[None]) for view in names}
        if frames.kind == "vector":  # noise has been drawn before
            values |= {f"nonzero_{view}": torch.zeros_like(one, dtype=torch.int32) for view, one in values.items()}
        axes = {view: (frames.sonars[view].range_m, frames.bearing_rad[view]) for view in names}
        inputs: NetworkInput = self._arranged(axes)(values, torch.arange(len(frames))[None], 0)
        return inputs

    def _check_instrument(self, view: str, has: TrainedInstrument) -> None:
        """Refuse another sonar than that of training, unless it is forced."""
        unlike = self._trained[view].unlike(has) if view in self._trained and not self.force else ""
        if unlike:
            raise MitsonarError(
                f"this {self._checkpoint.network} was trained on the sonar {self._trained[view].name}, the frames are of "
                f"{has.name}: {unlike}; train on that sonar, use {self.instead}, or force it with RUN:force=1"
            )

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

    # ---------------------------------------------------------------- rejections

    def _rejection_of_geometry(self, frames: SonarFrames | ViewFrames) -> str:
        """Whether the sonar stood as in training, as far as the frames tell; networks that are given it need not."""
        if self._checkpoint.arrangement["ground"]:
            return ""
        trained_at = self._checkpoint.trained_at
        low, high = trained_at["height_m"]
        heights = [np.nanmean(frames.height_m)] if frames.height_m is not None and np.isfinite(frames.height_m).any() else []
        if (
            heights and frames.poses is not None and np.isfinite(frames.poses[:, 2]).all()
        ):  # over z = 0: straight below there may be a rock
            heights.append(frames.poses[:, 2].mean())
        if heights and not any(low * (1 - HEIGHT_OFF) <= height <= high * (1 + HEIGHT_OFF) for height in heights):
            return f"the sonar stood at {heights[0]:.2f} m: {self._checkpoint.fixed} are fixed by training"
        return self._rejection_of_attitude(frames)

    def _rejection_of_attitude(self, frames: SonarFrames | ViewFrames) -> str:
        """Whether pitch and roll were those of training, as far as the frames tell."""
        trained_at = self._checkpoint.trained_at
        if frames.poses is not None:
            for name, column in (("pitch", 3), ("roll", 4)):
                angle = math.degrees(frames.poses[:, column].mean())
                if abs(angle - trained_at[f"{name}_deg"]) > ANGLE_OFF_DEG:
                    return f"the sonar had a {name} of {angle:.1f} deg: {self._checkpoint.fixed} are fixed by training"
        return ""

    def _rejection_of_size(self, motion: Motion, start: Motion | None = None) -> str:
        """Whether the answer, counted from the start of the iterations, is of the size that training had."""
        coder = self._checkpoint.coder
        middle, half = (coder.low + coder.high) / 2, (coder.high - coder.low) / 2
        off = (np.array(motion) - (np.zeros(3) if start is None else np.array(start)))[: len(half)]
        beyond = np.abs(off - middle) > BEYOND * half
        if not beyond.any():
            return ""
        axis = int(beyond.argmax())
        name, unit, scale = AXES[axis]
        value, low, high = scale * np.array([off, coder.low, coder.high])[:, axis]
        since = "" if start is None else ", counted from the start,"
        return f"{name} {value:.3g} {unit}{since} is beyond the motions of training, {low:.3g}..{high:.3g} {unit}"


def inputs_of(checkpoint: Checkpoint) -> str:
    """Return what a network needs beside the images, for tables."""
    return INPUTS if checkpoint.arrangement["ground"] else f"nothing; {checkpoint.fixed} fixed by training"


def answer_of(network: nn.Module, inputs: NetworkInput) -> Tensor | GaussianHead:
    """Run a network; several inputs come as a tuple.

    Raises:
        MitsonarError: inputs of a size that it cannot take.
    """
    try:
        answer: Tensor | GaussianHead = called(network, inputs)
        return answer
    except MitsonarError:
        raise
    except (RuntimeError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise MitsonarError(f"the network cannot take these frames: {error}") from None


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch computes with one thread: a pair is too small for more, and pairs are for the processes to share."""
    had = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(had)
