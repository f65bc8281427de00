"""Which directions of a motion can be observed at all, and the bounds of instruments made of several fans.

The eigenvectors of the Fisher information are directions of motion whose least standard deviations are independent. Metres
and radians are compared by a largest standard deviation of each: a direction that exceeds it is not observable, as is one
about which the images hold nothing. Either may mix degrees of freedom: a narrow fan hardly separates sideways motion from
yaw, and then neither is observable, though one combination of them is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import NoiseModel, refuse_noise
from mitsonar.estimation.crlb.image import LARGEST, Bound, SpeckleBounds, bounds_at, is_decided, together
from mitsonar.motion.composition import DEGREES, MotionStd
from mitsonar.motion.pose import Pose
from mitsonar.simulation.derivatives import PINGS

if TYPE_CHECKING:
    from mitsonar.instruments.sounder import Sounder
    from mitsonar.simulation.simulator import Simulator

__all__ = ["ALL_MOUNTS", "LARGEST", "Observability", "bounds_of_fans", "observability"]

ALL_MOUNTS = "all mounts"
"""Name of the sum over all mounts of an instrument."""

LEAST_SHARE = 0.05
"""Smallest share of a degree of freedom in a direction that is named after it."""


@dataclass(frozen=True)
class Observability:
    """Independent directions of a motion, from the best to the worst known.

    Attributes:
        degrees: names of the k degrees of freedom.
        std: least standard deviation of each direction, in units of the largest that counts ``(k,)``; inf where the noise of
            the rays hides it.
        least: lower limit of the same, given the noise of the rays ``(k,)``.
        directions: unit vectors ``(k, k)``, one a column, in the same units.
    """

    degrees: tuple[str, ...]
    std: NDArray[np.float64]
    least: NDArray[np.float64]
    directions: NDArray[np.float64]

    @property
    def observable(self) -> int:
        """Number of directions that can be observed."""
        return int((self.std <= 1).sum())

    @property
    def unobservable(self) -> tuple[str, ...]:
        """Names of the directions that cannot be observed; see :meth:`_names`."""
        return self._names((self.std > 1) & (self.least > 1))

    @property
    def undecided(self) -> tuple[str, ...]:
        """Names of the directions about which the derivatives are too noisy to decide: more pings are needed."""
        return self._names((self.std > 1) & (self.least <= 1))

    def _names(self, chosen: NDArray[np.bool_]) -> tuple[str, ...]:
        """Return names of directions: `rise`, or `sideways and yaw` where they only appear together.

        Among several directions about which nothing is known any combination is as good, so that the degrees of freedom
        within the space that they span are named separately, and the rest together.
        """
        names: list[str] = []
        hidden = chosen & np.isinf(self.std)
        for columns in [np.flatnonzero(hidden), *np.flatnonzero(chosen & ~hidden)[:, None]]:
            if not len(columns):
                continue
            share = (self.directions[:, columns] ** 2).sum(axis=1)  # of each degree of freedom, within the space
            pure = share > 1 - LEAST_SHARE
            names += [name for name, within in zip(self.degrees, pure, strict=True) if within]
            mixed = np.flatnonzero((share > LEAST_SHARE) & ~pure)
            if pure.sum() < len(columns) and len(mixed):
                names.append(" and ".join(self.degrees[k] for k in mixed[np.argsort(-share[mixed].round(2), kind="stable")]))
        return tuple(names)


def observability(bound: Bound, degrees: Sequence[str], *, largest: MotionStd = LARGEST, frames: int = 2) -> Observability:
    """Return the directions of a motion and how well each can be known.

    Args:
        bound: bound of a motion with these degrees of freedom.
        degrees: their names.
        largest: largest standard deviations that count as an observation.
        frames: number of noisy frames, 1 or 2, as in :meth:`Bound.covariance`.
    """
    size, axes, significant = bound.directions(largest.of(degrees))
    known = size > significant
    std = np.where(known, np.sqrt(frames / np.where(known, size, 1.0)), np.inf)
    least = np.sqrt(frames / (np.maximum(size, 0.0) + significant))
    order = np.argsort(std, kind="stable")
    return Observability(tuple(degrees), std[order], least[order], axes[:, order])


def bounds_of_fans(
    simulator: Simulator,
    sounder: Sounder,
    poses: ArrayLike,
    noise: NoiseModel,
    gain: float,
    *,
    degrees: Sequence[str] = tuple(DEGREES),
    pings: int | None = None,
) -> Iterator[dict[tuple[str, str, str], Bound | None]]:
    """Compute the bounds of an instrument of several fans at each pose, keyed by (mount, kind, law).

    All fans ping at once and do not hear each other, so that their information adds up: that of the rows of a mount, which
    are a 3-D sonar, and that of all mounts, keyed by :data:`ALL_MOUNTS`, where there are several.

    Args:
        simulator: simulator of the scene with the sonar of the fans, ``sounder.fan``.
        sounder: the instrument.
        poses: poses of the vehicle ``(n, 6)``; the motion is that of the vehicle.
        noise: noise of the pixels.
        gain: gain of the frames.
        degrees: names of the k degrees of freedom of the motion.
        pings: pings of each half of the derivatives; default: 8, then 32 and 128 while it is undecided what all fans
            together can observe; for the model ``coherent`` as for one sonar.
    """
    mounts = [Pose.from_row(row) for row in sounder.mount_poses.tolist()]
    names = [mount for mount in sounder.mounts for _ in range(sounder.rows)]
    coherent = sounder.fan.model == "coherent"
    if coherent:
        refuse_noise(noise, sounder.fan)
        speckle = SpeckleBounds(simulator, gain, degrees)
    counts = (PINGS, 4 * PINGS, 16 * PINGS) if pings is None else (pings,)
    for pose in np.atleast_2d(np.asarray(poses, dtype=float)):
        if coherent:
            by_law = [next(speckle.mounted_at(mount).at_poses(pose, pings=pings)) for mount in mounts]
            yield _sums([{("image", law): bound for law, bound in fan.items()} for fan in by_law], names)
            continue
        for count in counts:
            views = [next(bounds_at(simulator, pose, noise, gain, pings=count, degrees=degrees, mount=m)) for m in mounts]
            sums = _sums([{key[1:]: bound for key, bound in fan.items()} for fan in views], names)
            whole = names[0] if len(sounder.mounts) == 1 else ALL_MOUNTS
            images = [one for (mount, kind, _), one in sums.items() if (mount, kind) == (whole, "image")]
            if all(one is None or is_decided(one, degrees) for one in images):
                break
        yield sums


def _sums(
    fans: Sequence[dict[tuple[str, str], Bound | None]], names: Sequence[str]
) -> dict[tuple[str, str, str], Bound | None]:
    """Add the bounds of fans, keyed by (kind, law), over the fans of each mount and over all; ``names`` are their mounts."""
    sums: dict[tuple[str, str, str], Bound | None] = {}
    mounts = list(dict.fromkeys(names))
    for key in fans[0]:
        if len(mounts) > 1:
            sums[(ALL_MOUNTS, *key)] = together([fan[key] for fan in fans])
        for mount in mounts:
            sums[(mount, *key)] = together([fan[key] for name, fan in zip(names, fans, strict=True) if name == mount])
    return sums
