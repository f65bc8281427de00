"""The tally of a run: what its frames add up to warn of."""

from __future__ import annotations

import math
from collections.abc import Container
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.files import finite_number, whole_number
from mitsonar.simulation.empty_frames import NEARLY_EMPTY, empty_frames, percent
from mitsonar.simulation.rendered_pings import RenderedPings

__all__ = ["NEGLIGIBLE", "Tally"]


NEGLIGIBLE = 1e-3
"""Part of the returns that may lie outside the window without a warning."""


@dataclass
class Tally:
    """What a run adds up to warn of."""

    sonar: Sonar
    gain_from: str = "set on the first 20 frames"
    frames: int = 0
    rays: dict[str, int] = field(default_factory=lambda: dict.fromkeys(("inside", "nearer", "farther", "missed"), 0))
    pixels: int = 0
    filled: int = 0
    saturated: int = 0
    worst: tuple[int, int] = (0, 0)
    empty: int = 0
    first_empty: tuple[int, ...] = ()
    """Number of the first empty frame, then of its rays those inside the window, nearer, farther, missed."""
    cut: int = 0
    """Rays that missed points, and the pitch of points that would do [m]."""
    enough_m: float = 0.0

    def add(self, pings: RenderedPings, image: NDArray[np.float32]) -> None:
        """Count a batch; ``image`` before noise."""
        self.frames += len(pings)
        filled = np.count_nonzero(image, axis=(1, 2))
        if self.sonar.model == "coherent":  # noise and side lobes fill every pixel
            filled = np.where(pings.counts.inside.sum(axis=1) > 0, filled, 0)
        empty = np.flatnonzero(filled < NEARLY_EMPTY * image[0].size)
        if len(empty) and not self.empty:
            rays = (int(getattr(pings.counts, name)[empty[0]].sum()) for name in self.rays)
            self.first_empty = (pings.first + int(empty[0]), *rays)
        self.empty += len(empty)
        for name in self.rays:
            self.rays[name] += int(getattr(pings.counts, name).sum())
        self.cut += pings.cut.rays
        self.enough_m = max(self.enough_m, pings.cut.enough_m)
        self.pixels += image.size
        self.filled += int(filled.sum())
        self.saturated += int(np.count_nonzero(image >= 1))
        outside = (pings.counts.nearer + pings.counts.farther).sum(axis=1)
        if outside.max() > self.worst[0]:
            self.worst = int(outside.max()), pings.first + int(outside.argmax())

    def warnings(self, source: Any, poses: NDArray[np.float64]) -> list[str]:
        """Return a sentence for each thing that the user should know; ``source`` finds the ranges of the worst frame."""
        return list(self.findings(source, poses).values())

    def findings(self, source: Any, poses: NDArray[np.float64], first: int = 0, told: Container[str] = ()) -> dict[str, str]:
        """Return the sentences of :meth:`warnings`, each by the name of what it is about.

        Args:
            source: finds the ranges of the worst frame.
            poses: of the frames ``(frames, 6)``.
            first: number of the first of them.
            told: names of sentences that are not wanted again; ranges, which take another tracing, are not sought for them.
        """
        sonar, rays = self.sonar, self.rays
        outside = rays["nearer"] + rays["farther"]
        hits = rays["inside"] + outside
        found = {}
        if self.empty and "empty" not in told:
            number, *its_rays = self.first_empty
            pose = poses[number - first]
            window = (sonar.range_min, sonar.range_max)
            beside = source.window_range(pose, number)
            found["empty"] = empty_frames(
                self.empty, self.frames, (number, pose), its_rays, window, beside, source.buried(pose)
            )
        if outside > NEGLIGIBLE * hits and "window" not in told:
            frame = self.worst[1]
            ends = source.window_range(poses[frame - first], frame)
            where = f", in frame {frame} at {ends[0]:.2f}..{ends[1]:.2f} m" if ends else ""
            found["window"] = (
                f"{outside:,} of {hits:,} returns ({percent(outside / hits)} %) lie outside the window "
                f"{sonar.range_min:g}..{sonar.range_max:g} m{where}: they are dropped; widen the window if they matter"
            )
        if self.saturated > 0.01 * self.pixels:
            found["saturated"] = (
                f"{percent(self.saturated / self.pixels)} % of pixels are at the maximum (more than 1 %): the gain, "
                f"{self.gain_from}, is too high for the rest"
            )
        if self.cut:
            found["cut"] = (
                f"{self.cut:,} rays met surfaces so flatly, or points so dense, that they looked through a part of their "
                f"points only: these surfaces are too dark; a scatterer_spacing_m of {_up(self.enough_m)} m would do, or a "
                "higher quality"
            )
        reach = rounding_reach_m(sonar)
        if reach is not None and np.abs(poses[:, :3]).max() > reach:
            found["far"] = (
                f"a pose lies {np.abs(poses[:, :3]).max():,.0f} m from the origin, where coordinates round to more than an "
                f"eighth of the wavelength: speckle loses its place; move the scene so that poses lie within {reach:.0f} m "
                "of the origin"
            )
        if sonar.model == "thesis" and 0 < rays["inside"] < 10 * self.filled:
            found["rays"] = (
                f"{rays['inside'] / self.filled:.1f} rays a bin on average, below 10: point deposits make the levels "
                "noisy; raise rays_per_beam, lower range_bins, or use the model physical"
            )
        return found

    def state(self) -> dict[str, Any]:
        """As JSON can hold it; :meth:`restore` reads it back."""
        names = ("frames", "rays", "pixels", "filled", "saturated", "worst", "empty", "first_empty", "cut", "enough_m")
        return {name: getattr(self, name) for name in names}

    @classmethod
    def restore(cls, sonar: Sonar, state: dict[str, Any]) -> Tally:
        """Restore the tally of a run that was broken off, as JSON gives it back.

        Raises:
            MitsonarError: the state is damaged.
        """
        kept = cls(sonar)
        rays, worst, empty = (state.get(name) for name in ("rays", "worst", "first_empty"))
        if set(state) != set(kept.state()) or not isinstance(rays, dict) or set(rays) != set(kept.rays):
            raise MitsonarError(f"the tally must hold {', '.join(kept.state())}, and rays {', '.join(kept.rays)}")
        if not isinstance(worst, list) or len(worst) != 2 or not isinstance(empty, list) or len(empty) not in (0, 5):
            raise MitsonarError("worst of the tally must be two counts, first_empty five or none")
        for count in (*rays.values(), *worst, *empty):
            whole_number(count, "a count of the tally")
        frames = whole_number(state["frames"], "frames of the tally")
        pixels = whole_number(state["pixels"], "pixels of the tally")
        for name in ("filled", "saturated"):
            whole_number(state[name], f"{name} of the tally", 0, pixels)
        whole_number(state["empty"], "empty of the tally", 0, frames if empty else 0)
        for number in (worst[1], *empty[:1]):
            whole_number(number, "a frame of the tally", 0, max(0, frames - 1))
        whole_number(state["cut"], "cut of the tally")
        finite_number(state["enough_m"], "enough_m of the tally", above=1e-9 if state["cut"] else -math.inf)
        tuples = {name: tuple(state[name]) for name in ("worst", "first_empty")}
        return cls(sonar, **{**state, "rays": dict(state["rays"]), **tuples})


def rounding_reach_m(sonar: Sonar) -> float | None:
    """Return the distance at which single precision rounds to an eighth of the wavelength; None for other models."""
    if sonar.model != "coherent" or sonar.frequency_hz is None:
        return None
    return sonar.sound_speed / sonar.frequency_hz / 8 * 2.0**24


def _up(length_m: float) -> str:
    """Return a length to two digits, rounded up."""
    step = 10.0 ** (math.floor(math.log10(length_m)) - 1)
    return f"{math.ceil(length_m / step) * step:.2g}"
