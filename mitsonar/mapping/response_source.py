"""Impulse responses of one run, for odometry, as :class:`~mitsonar.mapping.frame_source.FrameSource` gives frames."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import snr_of, snr_said
from mitsonar.datasets.responses import with_noise
from mitsonar.errors import MitsonarError
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.responses import ImpulseResponses

__all__ = ["ResponseSource", "holds_responses", "open_responses"]


@dataclass(frozen=True)
class ResponseNoise:
    """White complex noise at a ratio of signal to noise."""

    snr_db: float

    def model_dump(self) -> dict[str, str]:
        """Return its kind and ratio, for the record of a run."""
        return {"kind": "white", "snr": snr_said(self.snr_db)}


@dataclass(frozen=True)
class ResponseSource:
    """The pings of one run.

    Attributes:
        name: of the source, for messages.
        responses: of all pings.
        told_height_m: the height that the user gave for responses without one.
        noise: added to the pings that are read.
        seed: of the noise.
        note: empty; data sets are read by their samples.
        contrast: none, as of all impulse responses.
    """

    name: str
    responses: ImpulseResponses
    told_height_m: float | None = None
    noise: ResponseNoise | None = None
    seed: int = 0
    note: str = ""
    pitch_rad: float | None = None
    contrast: ClassVar[None] = None

    def __len__(self) -> int:
        """Return the number of pings."""
        return len(self.responses)

    @property
    def time_s(self) -> NDArray[np.float64]:
        """Return the times of the pings ``(pings,)`` [s]."""
        return self.responses.time_s

    @property
    def poses(self) -> NDArray[np.float64] | None:
        """Return the true poses of the transmitter ``(pings, 6)`` [m, rad]; None where they are not known."""
        return self.responses.poses

    @property
    def height_m(self) -> NDArray[np.float64] | None:
        """Return the height over the ground ``(pings,)`` [m]; None where it is not known."""
        return self.responses.height_m

    @property
    def true(self) -> Trajectory | None:
        """Return the true path of the transmitter; None where it is not known."""
        return None if self.poses is None else Trajectory(self.poses, self.time_s)

    def with_noise(self, snr: str, seed: int = 0) -> Self:
        """Return the same pings with noise at a ratio of signal to noise such as ``20 dB``.

        Raises:
            MitsonarError: not a ratio.
        """
        ratio = snr_of(snr)
        return replace(self, noise=None if ratio is None else ResponseNoise(ratio), seed=seed)

    def with_height(self, height_m: float | None) -> Self:
        """Return the same pings with a height [m] where they lack it.

        Raises:
            MitsonarError: a height that is not above 0, or that would not be used.
        """
        if height_m is None:
            return self
        if not 0 < height_m < np.inf:
            raise MitsonarError(f"the height must be above 0: got {height_m:g} m")
        known = self.responses.height_m
        if known is not None and np.isfinite(known).all():
            raise MitsonarError(f"{self.name} holds heights, so that {height_m:g} m would not be used: leave it out")
        responses = replace(self.responses, height_m=np.full(len(self), height_m))
        return replace(self, responses=responses, told_height_m=height_m)

    def check_times(self) -> None:
        """Check that the times of the pings increase.

        Raises:
            MitsonarError: they do not, or are not finite.
        """
        if not (np.isfinite(self.time_s).all() and (np.diff(self.time_s) > 0).all()):
            raise MitsonarError(f"{self.name}: times of pings must be finite and increase; write the pings in order")

    def read(self, index: ArrayLike) -> ImpulseResponses:
        """Read pings of these numbers ``(n,)`` as estimators may use them.

        They have height and attitude, but neither position, heading nor velocity, so that no truth can leak.
        """
        chosen = np.asarray(index, dtype=np.intp)
        picked = self.responses.select(chosen)
        response = picked.response
        if self.noise is not None:
            response = with_noise(response, chosen, self.noise.snr_db, self.seed)
        poses = None if picked.poses is None else picked.poses * [0, 0, 1, 1, 1, 0]
        return replace(picked, response=response.astype(np.complex64), poses=poses, velocity=None)

    def digest(self) -> str:
        """Return the SHA-256 of the responses with their times, poses, heights and noise."""
        digest = hashlib.sha256(self.responses.sonar.model_dump_json().encode())
        for values in (self.responses.response, self.time_s, self.poses, self.height_m):
            digest.update(b"-" if values is None else np.ascontiguousarray(values).tobytes())
        digest.update(repr((self.noise, self.seed)).encode())
        return digest.hexdigest()


def holds_responses(where: str | Path) -> bool:
    """Return whether impulse responses are there: a folder of ``mitsonar impulse``, or its responses.npz or .zarr."""
    path = Path(where)
    if path.name.startswith("responses."):
        return os.path.exists(path)
    return os.path.isdir(path) and os.path.isfile(path / "responses.npz")


def open_responses(where: str | Path) -> ResponseSource:
    """Open the responses at a path.

    Raises:
        MitsonarError: no responses, or a damaged file.
    """
    return ResponseSource(str(where), ImpulseResponses.load(where))
