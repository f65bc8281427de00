"""How a trained network becomes an estimator: what it reads, which instrument it accepts, and when it is rejected."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, NamedTuple, cast

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from torch import Tensor, nn

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.datasets.arrangement import Arrangement
from mitsonar.datasets.responses import pack_responses
from mitsonar.datasets.samples import ground_of, light_of
from mitsonar.errors import MitsonarError
from mitsonar.estimation.channel.correlation import pings_of
from mitsonar.estimation.estimator import (
    INPUTS,
    LEAST_AT_BEST,
    AnyEstimator,
    Estimate,
    Record,
    ambiguity,
    blank,
    correlation_excess,
    correlation_of,
    matching_rejection,
    prior_rejection,
    rejected,
    two_frames,
    without_slow,
)
from mitsonar.estimation.image.phase import Phase
from mitsonar.geometry.fan import cartesian_map
from mitsonar.geometry.ground import STD_MEASURED, Attitude, attitude_of
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import sonar_from
from mitsonar.instruments.views import SEGMENTS
from mitsonar.motion.composition import Motion, MotionPrior, inverse
from mitsonar.motion.errors import AXES
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.networks.corrnet import GaussianHead, Ground, WarpGrid
from mitsonar.networks.create import called
from mitsonar.records.frames import SonarFrames, ViewFrames, to_float32
from mitsonar.records.responses import ImpulseResponses

if TYPE_CHECKING:
    from mitsonar.datasets.samples import Samples

__all__ = [
    "ANGLE_OFF_DEG",
    "BEYOND",
    "HEIGHT_OFF",
    "HeightEnsemble",
    "ImageNetwork",
    "NetworkInput",
    "OwnNetwork",
    "ResponseNetwork",
    "Trained",
    "TrainedInstrument",
    "ViewNetwork",
    "answer_of",
    "inputs_of",
    "one_thread",
    "reads_views",
]


@dataclass(eq=False)
class HeightEnsemble:
    """An ensemble of networks trained at different heights; the one trained nearest to the measured height answers.

    Args:
        networks: two or more, all of one image or all of the same views.

    Attributes:
        inputs: what it needs besides the images.
        views: the views that all networks read; None: a single image.
        kind: ``image`` or ``vector``.

    Raises:
        MitsonarError: networks that read different inputs.
    """

    networks: Sequence[AnyEstimator]
    inputs: str = field(default="height, which chooses the network", init=False)

    def __post_init__(self) -> None:
        signatures = {(type(one), getattr(one, "views", None), one.kind) for one in self._members}
        if len(signatures) != 1 or len(self._members) != len(self.networks):
            got = "; ".join(sorted(f"{kind}s of {', '.join(views or ('one view',))}" for _, views, kind in signatures))
            raise MitsonarError(f"the networks of an ensemble must read the same views: got {got}")
        ((_, self.views, self.kind),) = signatures

    @property
    def _members(self) -> list[ImageNetwork | ViewNetwork]:
        return [one for one in self.networks if isinstance(one, ImageNetwork | ViewNetwork)]

    @property
    def checkpoints(self) -> tuple[Checkpoint, ...]:
        """Return the checkpoints of all networks."""
        return tuple(checkpoint for one in self._members for checkpoint in one.checkpoints)

    @property
    def consumes(self) -> type:
        """Return the class of the records that its networks read."""
        return ViewFrames if self.views else SonarFrames

    @property
    def digest(self) -> str:
        """Return the digests of all networks."""
        return " ".join(one.digest for one in self.networks)

    def estimate(self, frames: SonarFrames | ViewFrames, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion with the network chosen by the height.

        Raises:
            MitsonarError: frames without a height, or the errors of the network.
        """
        heights = None if frames.height_m is None else frames.height_m[np.isfinite(frames.height_m)]
        if heights is None or not len(heights):
            raise MitsonarError(
                "the height selects the network, but the frames hold none: measure it with --height-by direct"
            )
        height = float(heights.mean())
        network: AnyEstimator = self.chosen(height)
        return network.estimate(frames, prior)

    def chosen(self, height_m: float) -> ImageNetwork | ViewNetwork:
        """Return the network whose training heights are nearest in ratio; among several, that with the nearest middle."""

        def distance(network: ImageNetwork | ViewNetwork) -> tuple[float, float]:
            low, high = network.heights
            outside = max(np.log(low / height_m), np.log(height_m / high), 0.0)
            return float(outside), float(abs(np.log(height_m / np.sqrt(low * high))))

        return min(self._members, key=distance)


# ---------------- Networks of the user


class OwnNetwork:
    """Estimates motions with a PyTorch module whose output is labels of motions ``(batch, 3)``.

    Args:
        network: takes images ``(batch, 2, bins, beams)`` float32 in 0..1, or the inputs that ``samples`` produce. It is
            copied and set to evaluation mode; later training has no effect.
        samples: the samples on which it was trained, such as :class:`~mitsonar.datasets.samples.SonarPairs`. They define how
            frames become its input, and decode its labels. Without them the labels are raw: sideways,
            forward [m], yaw [rad].

    Raises:
        MitsonarError: samples other than two images of one view, or with the geometry of the ground.
    """

    consumes = SonarFrames
    inputs = "custom"
    digest = ""

    def __init__(self, network: nn.Module, samples: Samples | None = None) -> None:
        if samples is not None and (
            samples.frames != 2 or len(samples.arrange.views) != 1 or samples.arrange.kind != "image" or samples.ground
        ):
            raise MitsonarError(
                "a user's network estimates from two images of one view: give samples with frames=2, kind='image', one "
                "view, and no ground"
            )
        self._network = copy.deepcopy(network).eval()
        self._arrange = None if samples is None else replace(samples.arrange, noise=NoiseModel(), levels=())
        self._labels = None if samples is None else samples.labels
        self._shape: tuple[int, ...] | None = None
        if samples is not None and samples.arrange.coordinates != "polar":
            view = next(view for view in samples.recipe.views if view.name == samples.arrange.views[0])
            self._shape = (len(view.sonar.range_m), len(view.bearing_rad))

    def estimate(self, frames: SonarFrames) -> Estimate:
        """Estimate the motion; its covariance is unknown.

        Raises:
            MitsonarError: not two frames, frames of a size that the network cannot take, or an output that is not a motion.
        """
        two_frames(frames)
        if self._shape is not None and frames.image.shape[1:] != self._shape:
            raise MitsonarError(f"the network was trained on images of {self._shape}: got {frames.image.shape[1:]}")
        # prepare the frames as in training, on the device of the network
        parameter = next(self._network.parameters(), torch.empty(0))
        images = torch.from_numpy(np.ascontiguousarray(to_float32(frames.image)))[None].to(parameter.device)
        inputs: NetworkInput = images
        if self._arrange is not None:
            inputs = self._arrange({self._arrange.views[0]: images}, torch.arange(2, device=parameter.device)[None], 0)
        with torch.inference_mode(), one_thread():
            answer = answer_of(self._network, inputs)
        # check the answer before it is decoded
        if not isinstance(answer, torch.Tensor) or answer.shape != (1, 3):
            output = f"a tensor of {tuple(answer.shape)}" if isinstance(answer, torch.Tensor) else type(answer).__name__
            raise MitsonarError(f"a network of motions must return labels (batch, 3): got {output} for a batch of one")
        labels = answer[0].double().cpu().numpy()
        if not np.isfinite(labels).all():
            return rejected("the network's answer is not finite")
        motion = labels if self._labels is None else self._labels.decode(labels)
        return Estimate(Motion(*motion.tolist()))


# ---------------- Basis of all checkpoint estimators


Axes = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Ranges of the bins ``(bins,)`` [m] and bearings of the beams ``(beams,)`` [rad]."""

NetworkInput = Tensor | tuple[Tensor | Ground, ...]
"""Input of a network: a tensor, or a tuple of tensors and of the geometry of the ground."""

BEYOND = 1.2
"""Factor by which a valid motion may exceed those of training."""

HEIGHT_OFF, ANGLE_OFF_DEG = 0.1, 2.0
"""Largest valid deviation of the height, as a fraction of it, and of pitch and roll from those fixed by training."""

WINDOW_OFF = 0.02
"""Largest relative deviation of window and field of view from those of training."""


class TrainedInstrument(NamedTuple):
    """The properties of a sonar that a network knows from training."""

    name: str
    bins: int
    beams: int
    window_m: tuple[float, float]
    azimuth_fov_deg: float
    elevation_fov_deg: float
    bearing: str

    @classmethod
    def of(cls, sonar: Sonar) -> TrainedInstrument:
        """Return the properties of a sonar by its fields."""
        return cls.in_frames(sonar, sonar.range_m, sonar.bearing_rad)

    @classmethod
    def in_frames(cls, sonar: Sonar, range_m: NDArray[np.float64], bearing_rad: NDArray[np.float64]) -> TrainedInstrument:
        """Return the properties of a sonar whose frames have these bins and beams."""
        half = (range_m[-1] - range_m[0]) / max(1, len(range_m) - 1) / 2
        span = (bearing_rad[-1] - bearing_rad[0]) * len(bearing_rad) / max(1, len(bearing_rad) - 1)
        window = (float(range_m[0] - half), float(range_m[-1] + half))
        size = (len(range_m), len(bearing_rad))
        return cls(sonar.name, *size, window, math.degrees(span), sonar.elevation_fov_deg, sonar.bearing)

    def unlike(self, other: TrainedInstrument) -> str:
        """Return the properties in which another sonar differs: ``beams 128, not 96; ...``; empty if none does."""
        differences = []
        for what in ("bins", "beams", "bearing"):
            if getattr(self, what) != getattr(other, what):
                differences.append(f"{what} {getattr(other, what)}, not {getattr(self, what)}")
        for what in ("azimuth_fov_deg", "elevation_fov_deg"):
            trained, actual = getattr(self, what), getattr(other, what)
            if abs(actual - trained) > WINDOW_OFF * trained:
                differences.append(f"{what} {actual:.4g}, not {trained:.4g}")
        ends = zip(self.window_m, other.window_m, strict=True)
        if any(abs(actual - trained) > WINDOW_OFF * self.window_m[1] for trained, actual in ends):
            trained, actual = (f"{near:.3g}..{far:.3g} m" for near, far in (self.window_m, other.window_m))
            differences.append(f"window {actual}, not {trained}")
        return "; ".join(differences)


@dataclass(init=False, eq=False)
class Trained:
    """A network with its weights.

    Attributes:
        digest: digest of the network.
        force: accept a sonar other than that of training.
        inputs: what it needs besides the images.
    """

    digest: str
    force: bool
    instead: ClassVar[str] = "corrnet or direct"
    """Alternative for other sonars, named in error messages."""

    @property
    def checkpoints(self) -> tuple[Checkpoint, ...]:
        """Return the checkpoint as a tuple of one."""
        return (self._checkpoint,)

    @property
    def heights(self) -> tuple[float, float]:
        """Lowest and highest height of training [m]."""
        low, high = self._checkpoint.trained_at["height_m"]
        return float(low), float(high)

    def _set_checkpoint(self, checkpoint: Checkpoint) -> None:
        """Store the network outside the fields: files and comparisons of options need only the digest."""
        self.digest, self.inputs = checkpoint.digest, inputs_of(checkpoint)
        self._checkpoint, self._network = checkpoint, checkpoint.build()
        self._trained = {view: TrainedInstrument.of(sonar) for view, sonar in checkpoint.sonars.items()}
        self._cached_arrangement: tuple[bytes, Arrangement] | None = None

    def __getstate__(self) -> dict[str, object]:
        """Return the state for other processes, with the checkpoint as bytes: torch would share file descriptors."""
        return {**asdict(self), "content": self._checkpoint.to_bytes()}

    def __setstate__(self, state: dict[str, object]) -> None:
        content = state.pop("content")
        assert isinstance(content, bytes)
        vars(self).update(state)
        self._set_checkpoint(Checkpoint.from_bytes(content))

    @property
    def kind(self) -> str:
        """What it reads: ``image`` or ``vector``."""
        return str(self._checkpoint.arrangement["kind"])

    def _input_of_views(self, frames: ViewFrames) -> NetworkInput:
        """Return the input of the network from the pings of its views, a batch of one.

        Raises:
            MitsonarError: missing views, or views of a sonar other than that of training.
        """
        names = self._checkpoint.arrangement["views"]
        missing = [view for view in names if view not in frames.values]
        if missing:
            raise MitsonarError(
                f"this {self._checkpoint.network} takes {', '.join(names)}: got {', '.join(frames.values)}; read them "
                "from a data set that holds them"
            )
        for view in names:
            self._check_instrument(view, TrainedInstrument.of(frames.sonars[view]))
        values = {view: torch.from_numpy(np.asarray(frames.values[view])[None]) for view in names}
        if frames.kind == "vector":  # the noise is already included
            values |= {f"nonzero_{view}": torch.zeros_like(one, dtype=torch.int32) for view, one in values.items()}
        axes = {view: (frames.sonars[view].range_m, frames.bearing_rad[view]) for view in names}
        inputs: NetworkInput = self._arrangement_for(axes)(values, torch.arange(len(frames))[None], 0)
        return inputs

    def _check_instrument(self, view: str, instrument: TrainedInstrument) -> None:
        """Raise an error for a sonar other than that of training, unless forced."""
        differences = self._trained[view].unlike(instrument) if view in self._trained and not self.force else ""
        if differences:
            raise MitsonarError(
                f"this {self._checkpoint.network} was trained on the sonar {self._trained[view].name}, the frames are of "
                f"{instrument.name}: {differences}; train on that sonar, use {self.instead}, or force it with RUN:force=1"
            )

    def _arrangement_for(self, axes: dict[str, Axes]) -> Arrangement:
        """Return the transform from frames of these views to the network's input; the last one is cached."""
        key = b"".join(axis.tobytes() for view_axes in axes.values() for axis in view_axes)
        if self._cached_arrangement is None or self._cached_arrangement[0] != key:
            settings = self._checkpoint.arrangement
            maps = {}
            if settings["coordinates"] != "polar":
                maps = {view: cartesian_map(*view_axes, settings["cartesian_rows"]) for view, view_axes in axes.items()}
            beams = {view: len(bearing_rad) for view, (_, bearing_rad) in axes.items()}
            arrangement = Arrangement(
                tuple(axes), settings["kind"], settings["layout"], settings["coordinates"], NoiseModel(), beams, maps
            )
            arrangement = replace(
                arrangement, range_levels=settings.get("range_levels"), halves=settings.get("halves", False)
            )
            self._cached_arrangement = key, arrangement
        return self._cached_arrangement[1]

    # ---------------- Rejections

    def _rejection_of_geometry(self, frames: SonarFrames | ViewFrames) -> str:
        """Return why the geometry differs from training, as far as known; networks that take the geometry accept any."""
        if self._checkpoint.arrangement["ground"]:
            return ""
        trained_at = self._checkpoint.trained_at
        low, high = trained_at["height_m"]
        heights = [np.nanmean(frames.height_m)] if frames.height_m is not None and np.isfinite(frames.height_m).any() else []
        if (
            heights and frames.poses is not None and np.isfinite(frames.poses[:, 2]).all()
        ):  # over z = 0, since there may be a rock straight below
            heights.append(frames.poses[:, 2].mean())
        if heights and not any(low * (1 - HEIGHT_OFF) <= height <= high * (1 + HEIGHT_OFF) for height in heights):
            return f"the sonar was at {heights[0]:.2f} m: {self._checkpoint.fixed} are fixed by training"
        return self._rejection_of_attitude(frames)

    def _rejection_of_attitude(self, frames: SonarFrames | ViewFrames) -> str:
        """Return why pitch or roll differ from those of training, if the frames hold them; empty if they do not."""
        trained_at = self._checkpoint.trained_at
        if frames.poses is not None:
            for name, column in (("pitch", 3), ("roll", 4)):
                angle = math.degrees(np.unwrap(frames.poses[:, column]).mean())
                if abs(math.remainder(angle - trained_at[f"{name}_deg"], 360)) > ANGLE_OFF_DEG:
                    return f"the sonar had a {name} of {angle:.1f} deg: {self._checkpoint.fixed} are fixed by training"
        return ""

    def _rejection_of_size(self, motion: Motion, start: Motion | None = None) -> str:
        """Return why the motion, relative to the start of the iterations, exceeds those of training; empty if not."""
        coder = self._checkpoint.coder
        middle, half = (coder.low + coder.high) / 2, (coder.high - coder.low) / 2
        from_start = (np.array(motion) - (np.zeros(3) if start is None else np.array(start)))[: len(half)]
        beyond = np.abs(from_start - middle) > BEYOND * half
        if not beyond.any():
            return ""
        axis = int(beyond.argmax())
        name, unit, scale = AXES[axis]
        value, low, high = scale * np.array([from_start, coder.low, coder.high])[:, axis]
        suffix = "" if start is None else ", counted from the start,"
        return f"{name} {value:.3g} {unit}{suffix} is beyond the motions of training, {low:.3g}..{high:.3g} {unit}"


def inputs_of(checkpoint: Checkpoint) -> str:
    """Return what a network needs besides the images, for tables."""
    return INPUTS if checkpoint.arrangement["ground"] else f"nothing; {checkpoint.fixed} fixed by training"


def answer_of(network: nn.Module, inputs: NetworkInput) -> Tensor | GaussianHead:
    """Run a network; several inputs are passed as a tuple.

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
    """Limit torch to one thread: a pair is too small for more, and processes share the pairs."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


# ---------------- Networks of two images


Pair = tuple[NDArray[np.float32], NDArray[np.float32]]

SMOOTHING = (2.0, 0.8)
"""Standard deviations of the filter applied before frames are matched [bins, beams]."""


class Comparison(NamedTuple):
    """How frames registered by an answer are compared: bins per cell, smoothing [bins, beams]."""

    cell: int
    smoothing: tuple[float, float]

    @property
    def correlated(self) -> float:
        """Return the number of neighbouring cells that count as one."""
        return 4 * math.pi * math.hypot(self.smoothing[0] / self.cell, 12**-0.5) * self.smoothing[1]


COMPARISONS = (Comparison(4, SMOOTHING), Comparison(1, (0.7, 0.5)))
"""Comparisons of registered frames, coarse then fine.

The second is used only if the first finds no match: fine texture remains visible in noise that hides coarse structure.
"""

BLOCK = 16
"""Size in cells and beams of the blocks over which the matched energy must be spread."""

NOISY_CORRELATION = 0.83
"""Correlation of matched frames below which noise shortens the network's steps, so that it is run again from its answer.

Without noise hulls have 0.84 and more, and rocky fields 0.95. In high noise hulls have 0.82 and less, and rocky fields
0.75 to 0.91. With a limit of 0.75, six of 200 pairs of hulls in high noise stopped short, with squared errors of 8 to 44
times the covariance.
"""

MAX_FAN_RATIO = 1.5
"""Ratio to the fan of training, wider or narrower, beyond which a fan is reported."""

FAR_MODEL = 4.0
"""Squared errors over the network's covariance for motions far beyond training, measured on rocky fields."""


@dataclass(init=False, eq=False)
class ImageNetwork(Trained):
    """A trained network that reads two frames of one view.

    Args:
        checkpoint: of the network, which must take two frames of one view.
        force: accept a sonar other than that of training.
        height_m: height over the ground, used where the window shows no first echoes. This and the next two are only for
            networks that take the geometry.
        pitch_rad: pitch of the sonar.
        relief_m: mean height of the visible surface over the ground.

    Raises:
        MitsonarError: a checkpoint that needs anything other than two frames of one view, that does not fit its network, or
            whose geometry is fixed by training but given here.
    """

    height_m: float | None
    pitch_rad: float | None
    relief_m: float | None

    @property
    def consumes(self) -> type:
        """Return the class of the records it reads."""
        return SonarFrames

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
            raise MitsonarError(f"this {checkpoint.network} takes no geometry: {checkpoint.fixed} are fixed by training")
        self.force, self.height_m, self.pitch_rad, self.relief_m = force, height_m, pitch_rad, relief_m
        self._set_checkpoint(checkpoint)

    def _check_input(self, checkpoint: Checkpoint) -> None:
        """Raise an error if the network needs inputs that an estimator does not have."""
        settings = checkpoint.arrangement
        if settings["frames"] != 2 or len(settings["views"]) != 1:
            raise MitsonarError(
                f"an estimator has two frames of one view: this {checkpoint.network} takes {settings['frames']} frames of "
                f"{', '.join(settings['views'])} as {settings['kind']}s; use `mitsonar odometry` on a data set that holds "
                "them, `mitsonar evaluate`, or another checkpoint"
            )

    def estimate(self, frames: SonarFrames, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion and its covariance.

        A network that takes the geometry starts at a prior, or else at zero motion. If that fails, and the prior does not
        show that the motion is near, :class:`~mitsonar.estimation.image.phase.Phase` finds the start. Other networks
        ignore a prior.

        Args:
            frames: two frames.
            prior: where to start; a motion that contradicts it is rejected.

        Returns:
            The estimate; ``start`` of ``about`` is ``zero``, ``prior`` or ``phase``.

        Raises:
            MitsonarError: not two frames, a sonar other than that of training, or frames that lack what the network needs.
        """
        images = two_frames(frames)
        for view in self._trained:
            self._check_instrument(view, TrainedInstrument.in_frames(frames.sonar, frames.range_m, frames.bearing_rad))
        if any(blank(image) for image in images):
            return rejected("nothing in the frames to match")
        attitude = self._attitude_of(frames)
        if attitude is not None and attitude.reason:
            return rejected(attitude.reason)
        if attitude is None:
            return self._estimate_from(frames, images, {}, None)
        ground = _batch({**ground_of(frames, attitude), **light_of(frames, attitude)})
        # 1. estimate from the prior or from zero motion; run again where noise may have shortened the steps
        near = self._estimate_from(frames, images, ground, None if prior is None else prior.motion)
        if near.covariance is not None and _correlation_of_answer(images, ground, near.motion) < NOISY_CORRELATION:
            near = self._refined(frames, images, ground, near)
        near = self._finalised(frames, near, prior, "zero" if prior is None else "prior", attitude, ground)
        # 2. accept it if it is valid and the frames correlate, or if the prior leaves no far motion
        doubtful = near.valid and _correlation_of_answer(images, ground, near.motion) < LEAST_AT_BEST
        is_near = prior is not None and not self._rejection_of_size(Motion(*(3 * prior.std)))
        if is_near or (near.valid and not doubtful):
            return near
        # 3. otherwise let phase correlation find a far start
        phase_estimate = Phase(self.height_m, self.pitch_rad, self.relief_m).estimate(frames)
        if not phase_estimate.valid or not self._rejection_of_size(phase_estimate.motion):
            return near  # the first estimate has already searched near motions
        far = self._estimate_from(frames, images, ground, phase_estimate.motion)
        if self._rejection_of_size(far.motion, phase_estimate.motion):  # the error of phase exceeds the motions of training
            far = self._estimate_from(frames, images, ground, far.motion)
        far = self._finalised(frames, far, prior, "phase", attitude, ground)
        if doubtful and (not far.valid or _correlation_of_answer(images, ground, far.motion) < LEAST_AT_BEST):
            return near
        return far

    def _finalised(
        self,
        frames: SonarFrames,
        estimate: Estimate,
        prior: MotionPrior | None,
        start_name: str,
        attitude: Attitude,
        ground: Ground,
    ) -> Estimate:
        """Return an estimate with its final covariance and the name of its start, rejected if it contradicts a prior.

        The covariance grows for motions beyond training, for heights less certain than those of training, and for unknown
        heave, pitch and roll.
        """
        covariance = estimate.covariance
        if covariance is not None:
            covariance = FAR_MODEL * covariance if self._rejection_of_size(estimate.motion) else covariance
            height_variance = (attitude.height_std_m / attitude.height_m) ** 2 - STD_MEASURED**2
            if height_variance > 0:
                by_relative_height = _by_height(ground, estimate.motion)
                covariance = covariance + height_variance * np.outer(by_relative_height, by_relative_height)
            covariance = attitude.widened(covariance, frames)
        reason = estimate.reason or prior_rejection(estimate.motion, covariance, prior)
        return replace(
            estimate,
            covariance=covariance,
            valid=not reason,
            reason=reason,
            about={**estimate.about, **attitude.about, **self._untrained(frames), "start": start_name},
        )

    @cached_property
    def _fan_deg(self) -> float:
        """Return the field of view in azimuth of the training data [deg]."""
        trained = sonar_from(dict(self._checkpoint.data_recipe["sonar"]))
        return TrainedInstrument.of(trained).azimuth_fov_deg

    def _untrained(self, frames: SonarFrames) -> dict[str, str]:
        """Return a note on frames unlike those of training, for a network that accepts any sonar."""
        differences = []
        if frames.sonar.model == "coherent" and "coherent" not in self._checkpoint.model:
            differences.append("speckle")
        instrument = TrainedInstrument.in_frames(frames.sonar, frames.range_m, frames.bearing_rad)
        if abs(math.log(instrument.azimuth_fov_deg / self._fan_deg)) > math.log(MAX_FAN_RATIO):
            differences.append(f"a fan of {instrument.azimuth_fov_deg:.3g} deg (but {self._fan_deg:.3g})")
        return (
            {"untrained": f"{self._checkpoint.network} was not trained for {' or '.join(differences)}"}
            if differences
            else {}
        )

    def _estimate_from(self, frames: SonarFrames, images: Pair, ground: Ground, start: Motion | None) -> Estimate:
        """Estimate the motion from a start of the network's iterations; None: zero motion."""
        with torch.inference_mode(), one_thread():
            targets, covariances = self._checkpoint.decode(self._answer(frames, images, ground, start))
        if not np.isfinite(targets).all():
            return rejected("the network's answer is not finite")
        if targets.shape[1] != 3:
            raise MitsonarError(f"a motion has three numbers: this {self._checkpoint.network} returns {targets.shape[1]}")
        # check the answer: a valid covariance, the geometry and motions of training, and frames that match
        if covariances is not None and not _is_covariance(covariances[0]):
            return rejected("the network's covariance is not positive: images unlike those of its training")
        motion = Motion(*targets[0].tolist())
        covariance = self._checkpoint.covariance if covariances is None else covariances[0]
        reason = self._rejection_of_geometry(frames) or self._rejection_of_size(motion, start)
        if not reason:
            reason = _rejection_of_answer(images, ground, motion) if ground else self._rejection_of_match(frames, images)
        return Estimate(motion, covariance, not reason, reason)

    def _refined(self, frames: SonarFrames, images: Pair, ground: Ground, first: Estimate) -> Estimate:
        """Estimate again, starting from an answer that noise may have shortened, and also backwards from the second frame.

        The result is the mean of both directions. The change by the second run and the difference of the directions enter
        the covariance, since nothing better is known of these errors.
        """
        second = self._estimate_from(frames, images, ground, first.motion)
        if second.covariance is None:
            return second
        motion, asymmetry = self._mean_of_directions(frames, images, second.motion)
        change = np.array(second.motion) - np.array(first.motion)
        fine = COMPARISONS[-1]
        first_image, second_image, inside = _registered(images, ground, motion, fine)
        excess = correlation_excess(first_image, second_image, inside, BLOCK // 2).mean
        factor = ambiguity(excess, inside.sum() / fine.correlated)
        reason = second.reason or self._rejection_of_size(motion)
        covariance = factor * second.covariance + np.outer(change, change) + np.outer(asymmetry, asymmetry) / 2
        return Estimate(motion, covariance, not reason, reason, second.about)

    def _mean_of_directions(self, frames: SonarFrames, images: Pair, motion: Motion) -> tuple[Motion, NDArray[np.float64]]:
        """Return the mean of a motion and the one estimated from the second frame to the first, and their difference."""
        swapped = frames.select(np.array([1, 0]))
        attitude = self._attitude_of(swapped)
        if attitude is None or attitude.reason:
            return motion, np.zeros(3)
        ground = _batch({**ground_of(swapped, attitude), **light_of(swapped, attitude)})
        backward = self._estimate_from(swapped, images[::-1], ground, Motion(*inverse(np.array(motion)).tolist()))
        if backward.covariance is None:
            return motion, np.zeros(3)
        difference = inverse(np.array(backward.motion)) - np.array(motion)
        return Motion(*(np.array(motion) + difference / 2).tolist()), difference

    def _attitude_of(self, frames: SonarFrames) -> Attitude | None:
        """Return the attitude, for a network that takes the geometry; None for others."""
        if not self._checkpoint.arrangement["ground"]:
            return None
        return attitude_of(frames, self._checkpoint.network, self.height_m, self.pitch_rad, self.relief_m)

    def _answer(self, frames: SonarFrames, images: Pair, ground: Ground, start: Motion | None) -> Tensor | GaussianHead:
        """Return the answer of the network, a batch of one."""
        (view,) = self._checkpoint.arrangement["views"]
        inputs = self._arrangement(frames)({view: torch.from_numpy(np.stack(images)[None])}, torch.arange(2)[None], 0)
        if not ground:
            return answer_of(self._network, inputs)
        image = cast(Tensor, inputs)  # networks that take the ground read one image
        if start is None:
            return answer_of(self._network, (image, ground))
        return answer_of(self._network, (image, ground, torch.tensor([start], dtype=torch.float32)))

    def _arrangement(self, frames: SonarFrames) -> Arrangement:
        """Return the transform from the frames to the network's input."""
        (view,) = self._checkpoint.arrangement["views"]
        return self._arrangement_for({view: (frames.range_m, frames.bearing_rad)})

    # ---------------- Rejections

    def _rejection_of_match(self, frames: SonarFrames, images: Pair) -> str:
        """Return why the frames do not show the same place: they must correlate at a shift within training's motions."""
        first, second = (smooth(image, Comparison(1, SMOOTHING)) for image in images)
        size = first.shape
        rows, columns = (min(reach, length // 3) for reach, length in zip(self._reach(frames), size, strict=True))
        # compare the middle of the second frame with the first at all these shifts
        middle = second[rows : size[0] - rows, columns : size[1] - columns]
        correlation = cv2.matchTemplate(without_slow(first, 32), without_slow(middle, 32), cv2.TM_CCOEFF_NORMED)
        row, column = np.unravel_index(int(correlation.argmax()), correlation.shape)
        matched = first[row : row + middle.shape[0], column : column + middle.shape[1]]
        inside = np.ones(middle.shape, dtype=bool)
        return matching_rejection(matched, middle, inside, correlated=4 * math.pi * SMOOTHING[0] * SMOOTHING[1])

    def _reach(self, frames: SonarFrames) -> tuple[int, int]:
        """Return how far an echo can move between frames in bins and in beams, by the motions of training."""
        coder = self._checkpoint.coder
        sideways, forward, yaw = BEYOND * np.maximum(np.abs(coder.low), np.abs(coder.high))
        bin_m, beam_rad = (float(np.median(np.diff(axis))) for axis in (frames.range_m, frames.bearing_rad))
        outward = forward + sideways * math.sin(min(math.pi / 2, np.abs(frames.bearing_rad).max()))
        across = yaw + sideways / frames.range_m[0]
        return 2 + int(outward / bin_m), 2 + int(across / beam_rad)


def _batch(table: dict[str, NDArray[np.float32]]) -> Ground:
    """Return tensors of a batch of one."""
    return {name: torch.from_numpy(values)[None] for name, values in table.items()}


def _by_height(ground: Ground, motion: Motion) -> NDArray[np.float64]:
    """Return the derivative of an estimated motion by the relative height: another motion explains the same shifts."""
    lit = ground["lit"][0].numpy() >= 0 if "lit" in ground else np.ones(ground["derivative"].shape[-2:], dtype=bool)
    by_motion, by_relief = (ground[name][0].numpy()[..., lit] for name in ("derivative", "by_relief"))
    shift_change = np.tensordot(np.array(motion), by_relief, axes=(0, 1))
    return np.asarray(np.linalg.lstsq(np.moveaxis(by_motion, 1, -1).reshape(-1, 3), shift_change.ravel(), rcond=None)[0])


def _rejection_of_answer(images: Pair, ground: Ground, motion: Motion) -> str:
    """Return why the frames do not match once registered by the answer; empty if they do."""
    coarse, fine = COMPARISONS
    reason = _mismatch(images, ground, motion, coarse)
    if reason and _correlation_of_answer(images, ground, motion) < LEAST_AT_BEST:
        return reason if _mismatch(images, ground, motion, fine) else ""
    return reason


def _mismatch(images: Pair, ground: Ground, motion: Motion, comparison: Comparison) -> str:
    """Return why the frames registered by an answer do not match in one comparison; empty if they do."""
    first, second, inside = _registered(images, ground, motion, comparison)
    return matching_rejection(first, second, inside, correlated=comparison.correlated, block=BLOCK, aside=BLOCK // 2)


def _correlation_of_answer(images: Pair, ground: Ground, motion: Motion) -> float:
    """Return the correlation of the frames registered by an answer."""
    first, second, inside = _registered(images, ground, motion, COMPARISONS[0])
    return correlation_of(without_slow(first, BLOCK)[inside], without_slow(second, BLOCK)[inside])


def _registered(
    images: Pair, ground: Ground, motion: Motion, comparison: Comparison
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Return the first frame, the second one resampled at its cells, and which cells both show."""
    rows, beams = images[0].shape[0] // comparison.cell, images[0].shape[1]
    means = (image[: rows * comparison.cell].reshape(rows, comparison.cell, beams).mean(axis=1) for image in images)
    first, second = (smooth(mean, comparison) for mean in means)
    warp_grid = WarpGrid(ground, torch.ones(1, 3), (comparison.cell, 1), images[0].shape, first.shape, None)
    warped, inside = warp_grid.draw(torch.from_numpy(second)[None, None], torch.tensor([motion]))
    return first, warped[0, 0].numpy(), inside[0].numpy() > 0


def smooth(image: NDArray[np.float32], comparison: Comparison) -> NDArray[np.float32]:
    """Return an image smoothed against noise."""
    bins, beams = comparison.smoothing
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigmaX=beams, sigmaY=bins / comparison.cell), dtype=np.float32)


def _is_covariance(matrix: NDArray[np.float64]) -> bool:
    """Return whether a matrix ``(3, 3)`` is finite, symmetric and not negative, as a series of motions requires."""
    if not np.isfinite(matrix).all() or np.abs(matrix - matrix.T).max() > 1e-9 * np.abs(matrix).max():
        return False
    least, _, largest = np.linalg.eigvalsh(matrix)
    return bool(least >= -1e-9 * largest)


# ---------------- Networks of impulse responses


IGNORED_FIELDS = ("name", "frame_rate_hz", "seed")
"""Fields of a channel sonar that do not affect a network's input; ``rays`` is one too, except for the model ``rays``."""


@dataclass(init=False, eq=False)
class ResponseNetwork(Trained):
    """A trained network that reads impulse responses and returns the motion over all their pings.

    Args:
        checkpoint: of the network.
        force: accept an instrument or model other than that of training.

    Raises:
        MitsonarError: a checkpoint that does not fit its network.
    """

    instead: ClassVar[str] = "likelihood or correlation"

    @property
    def consumes(self) -> type:
        """Return the class of the records it reads."""
        return ImpulseResponses

    def __init__(self, checkpoint: Checkpoint, *, force: bool = False) -> None:
        self.force = force
        self._set_checkpoint(checkpoint)

    def estimate(self, responses: ImpulseResponses, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion from the first to the last ping, with the covariance of validation.

        A network trained without turns returns zero yaw with zero variance, as ``likelihood`` does.

        Args:
            responses: the same number of pings as in training.
            prior: ignored: the network answers in the range of its training.

        Raises:
            MitsonarError: another number of pings, or an instrument or model other than that of training.
        """
        count = self._checkpoint.arrangement["frames"]
        if len(responses) != count:
            raise MitsonarError(f"this {self._checkpoint.network} takes {count} pings: got {len(responses)}")
        pings = pings_of(responses)
        self._check_channel(responses.sonar)
        if len(pings.silent) == len(responses.sonar.receivers):
            return rejected("no receiver has any echo")
        inputs = torch.from_numpy(pack_responses(pings.response)[None, None])
        with torch.inference_mode(), one_thread():
            targets, _ = self._checkpoint.decode(answer_of(self._network, inputs))
        if not np.isfinite(targets).all():
            return rejected("the network's answer is not finite")
        answer = np.zeros(3)
        answer[: targets.shape[1]] = targets[0]
        motion = Motion(*answer.tolist())
        reason = self._rejection_of_height(responses) or self._rejection_of_size(motion)
        return Estimate(motion, self._covariance, not reason, reason)

    @property
    def _covariance(self) -> NDArray[np.float64] | None:
        """Return the covariance of validation [m, m, rad] ``(3, 3)``; 0 for a turn that the network does not estimate."""
        rmse = self._checkpoint.rmse
        if rmse is None:
            return None
        variances = np.zeros(3)
        variances[: len(rmse)] = (rmse / [axis.scale for axis in AXES[: len(rmse)]]) ** 2
        return np.diag(variances)

    def _check_channel(self, sonar: ChannelSonar) -> None:
        """Raise an error for an instrument or model of echoes other than that of training, unless forced."""
        trained = self._checkpoint.channel
        if trained is None or self.force:
            return
        left_out = {*IGNORED_FIELDS, *(() if trained.model == sonar.model == "rays" else ("rays",))}
        trained_fields, fields = (one.model_dump(exclude=left_out) for one in (trained, sonar))
        receivers = trained_fields.pop("receivers") != fields.pop("receivers")
        differences = [
            f"{name} {fields[name]}, not {value}" for name, value in trained_fields.items() if value != fields[name]
        ]
        differences += ["other receivers"] if receivers else []
        if differences:
            raise MitsonarError(
                f"this {self._checkpoint.network} was trained on the channel sonar {trained.name}, the responses are of "
                f"{sonar.name}: {'; '.join(differences)}; train on that one, use {self.instead}, or force it with "
                "RUN:force=1"
            )

    def _rejection_of_height(self, responses: ImpulseResponses) -> str:
        """Return why the height is not that of training; empty if it is, or if the responses do not hold it."""
        low, high = self.heights
        if responses.height_m is None or not np.isfinite(responses.height_m).all():
            return ""
        height = float(np.mean(responses.height_m))
        if low * (1 - HEIGHT_OFF) <= height <= high * (1 + HEIGHT_OFF):
            return ""
        return f"the transmitter was at {height:.2f} m: {self._checkpoint.fixed} are fixed by training"


# ---------------- Networks of several views or vectors


LEAST_PROFILE_CORRELATION = 0.4
"""Smallest valid correlation of two pings' profiles without their slow variation, the median over the views.

Pairs 20 mm apart from 10 m have 0.8 to 0.97 at 512 and 1024 levels. Pings of different places have less than 0.4, except
for the vector of a whole view.
"""

SLOW_STD_BINS = 4.0
"""Standard deviation of the filter that defines the slow variation [bins]."""

FEWEST_LEVELS = 256
"""Number of levels below which profiles of any two places are similar, so that they are not compared."""


def reads_views(checkpoint: Checkpoint) -> bool:
    """Return whether a network takes several views, a portion of one, or vectors as a data set stores them."""
    settings = checkpoint.arrangement
    vectors = settings["kind"] == "vector" and not settings.get("halves", False)
    return vectors or len(settings["views"]) > 1 or settings["views"][0] in SEGMENTS


@dataclass(init=False, eq=False)
class ViewNetwork(Trained):
    """A trained network that reads several views or their vectors.

    Args:
        checkpoint: of the network, which must take two frames.
        force: accept a sonar other than that of training.

    Raises:
        MitsonarError: a checkpoint that does not take two frames, or that does not fit its network.
    """

    instead: ClassVar[str] = "a network of that sonar's views"

    @property
    def consumes(self) -> type:
        """Return the class of the records it reads."""
        return ViewFrames

    def __init__(self, checkpoint: Checkpoint, *, force: bool = False) -> None:
        if checkpoint.arrangement["frames"] != 2:
            raise MitsonarError(
                f"an estimator has two frames: this {checkpoint.network} takes {checkpoint.arrangement['frames']}; use "
                "`mitsonar evaluate`, or another checkpoint"
            )
        self.force = force
        self._set_checkpoint(checkpoint)

    @property
    def views(self) -> tuple[str, ...]:
        """Return the names of the views it reads."""
        return tuple(self._checkpoint.arrangement["views"])

    def estimate(self, records: Record, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion between two pings, with the covariance of validation.

        Args:
            records: two :class:`~mitsonar.records.frames.ViewFrames`.
            prior: ignored: the network answers in the range of its training.

        Raises:
            MitsonarError: not two pings of these views, or a sonar other than that of training.
        """
        frames = self._checked_views(records)
        inputs = self._input_of_views(frames)
        profiles = frames.profiles()
        if not np.isfinite(profiles).all():
            raise MitsonarError("the frames hold nan or inf: set pixels without echo to 0")
        if (np.ptp(profiles, axis=2) == 0).any():
            return rejected("nothing in the frames to match")
        with torch.inference_mode(), one_thread():
            targets, covariances = self._checkpoint.decode(answer_of(self._network, inputs))
        if not np.isfinite(targets).all():
            return rejected("the network's answer is not finite")
        motion = Motion(*targets[0].tolist())
        reason = self._rejection_of_geometry(frames) or self._rejection_of_size(motion) or _rejection_of_profiles(profiles)
        covariance = self._checkpoint.covariance if covariances is None else covariances[0]
        return Estimate(motion, covariance, not reason, reason)

    def _checked_views(self, frames: Record) -> ViewFrames:
        """Check that there are two pings of the views it reads, and return them."""
        views = ", ".join(self.views)
        if not isinstance(frames, ViewFrames):
            raise MitsonarError(
                f"this {self._checkpoint.network} takes {self.kind}s of {views}: use `mitsonar odometry` or `mitsonar "
                "evaluate` on a data set that holds them"
            )
        if len(frames) != 2 or any(view not in frames.values for view in self.views):
            raise MitsonarError(f"two pings of {views} are needed: got {len(frames)} of {', '.join(frames.values)}")
        return frames


def _rejection_of_profiles(profiles: NDArray[np.float32]) -> str:
    """Return why two pings ``(views, 2, bins)`` do not show the same place; empty if they do.

    Their quick variation along range must correlate.
    """
    if profiles.shape[2] < FEWEST_LEVELS:
        return ""
    quick = profiles - gaussian_filter1d(profiles, SLOW_STD_BINS, axis=2)
    correlations = []
    for first, second in quick:
        shifted = [(first[3 : len(first) - 3], second[3 + lag : len(second) - 3 + lag]) for lag in range(-3, 4)]
        correlations.append(max(np.vdot(a, b) / np.sqrt(np.vdot(a, a) * np.vdot(b, b) + 1e-12) for a, b in shifted))
    correlation = float(np.median(correlations))
    return (
        "" if correlation >= LEAST_PROFILE_CORRELATION else f"the profiles of both pings correlate by {correlation:.2f} only"
    )
