"""The Cramer-Rao lower bound of motion estimation for a known scene, sonar and noise.

No unbiased estimator of the motion (sideways, forward, yaw) has a covariance below the inverse of the Fisher information
F = J' W J: J how pixels change with the motion, W the information of a noisy pixel (:mod:`mitsonar.acoustics.noise`).
The bound is that of an oracle, which owns the renderer and knows the scene, its height and the frames without noise.

*One frame* is registered with that oracle: covariance 1 / F. *Two frames*, both noisy, of a known relief: twice that. It is
optimistic, since a real estimator has to find the relief and the reflectivity of every cell in the same two frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import Information, NoiseModel, information, information_of_sums, refuse_noise
from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.estimation.crlb.fisher_bound import Bound, fisher, together
from mitsonar.estimation.crlb.speckle_crlb import SPECKLE_LAWS, SpeckleBounds
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import Segment, directions
from mitsonar.motion.pose import Pose, vehicle_rotation
from mitsonar.simulation.derivatives import FIRST_PING, PINGS, Derivative, differentiate, jittered
from mitsonar.simulation.simulator import Simulator

__all__ = [
    *("ALL", "KINDS", "LAWS", "VARIABLES", "bound", "bounds_at", "bounds_of_views", "cramer_rao_bound", "floor_ranges"),
    *("laws_of", "varied"),
]

KINDS: dict[str, str] = {"image": "all pixels", "vector": "sums over the beams"}
LAWS: dict[str, str] = {
    "pixel": "the exact law of the noisy pixel: clipped, rounded to grey values",
    "gaussian": "a Gaussian of the same mean and variance: the limit of least squares",
    "rays": "the same, with the noise of the rays of a single ping as further variance",
}

ALL = "all views"

VARIABLES = {
    "height_m": "of the sonar over the ground",
    "pitch_deg": "of the sonar",
    "azimuth_fov_deg": "beams stay as many, and as wide as their spacing",
    "elevation_fov_deg": "rays over it stay as many",
    "beams": "the field of view stays, beams are as wide as their spacing",
    "range_bins": "the window stays",
    "window": "both ends [m], 3.2..5.6; bins stay as many",
}
"""Numbers that a bound may be asked for many values of, and what stays the same."""

MOVING = ("height_m", "pitch_deg", "azimuth_fov_deg", "elevation_fov_deg")
"""Those that move the floor out of the window."""


class InformationTerms(NamedTuple):
    """What values that change with the motion tell.

    Attributes:
        information: of each ``(n, ...)``.
        jacobian: two estimates of what they depend on ``(2, n, 2, 3)``.
        rays: variance of each by the rays of a ping, beyond what its law holds ``(n,)``.
    """

    information: Information
    jacobian: NDArray[np.float64]
    rays: NDArray[np.float64]

    def bound(self, law: str) -> Bound | None:
        """By one of :data:`LAWS`."""
        if law == "pixel":
            weight = self.information.law
        else:
            more = self.rays if law == "rays" else np.zeros_like(self.rays)
            weight = self.information.matched(more) if (self.information.variance + more > 0).all() else None
        return None if weight is None else fisher(self.jacobian, weight)


def bound(
    derivative: Derivative, noise: NoiseModel, *, kind: str = "image", law: str = "pixel", greys: int = 255
) -> Bound | None:
    """Compute the bound of one view.

    Without noise nothing but rounding stands between a pixel and its level. The exact law then tells the motion without
    limit, and the answer is None; ``gaussian`` counts rounding as a variance of 1 / (12 255^2), as for pixels that noise of
    their own dithers; ``rays`` adds the noise of the rays, from which no single ping is free. Vectors are not rounded, and
    have no ``gaussian`` bound without noise either.

    Args:
        derivative: of the view at a pose.
        noise: of its pixels.
        kind: of :data:`KINDS`.
        law: of :data:`LAWS`.
        greys: the largest grey value that pixels are stored with.

    Raises:
        MitsonarError: unknown words.
    """
    _check(kind, law)
    return _terms(derivative, noise, kind, greys).bound(law)


def laws_of(sonar: Sonar) -> dict[str, str]:
    """Return the laws that a sonar's pixels may have, by name, with what they mean; the last counts in comparisons."""
    return SPECKLE_LAWS if sonar.model == "coherent" else LAWS


def _check(kind: str, law: str, kinds: Sequence[str] = tuple(KINDS), laws: Sequence[str] = tuple(LAWS)) -> None:
    for what, word, known in (("kind", kind, kinds), ("law", law, laws)):
        if word not in known:
            raise MitsonarError(f"unknown {what} {word!r}: {nearest_names(word, known)}")


def _terms(derivative: Derivative, noise: NoiseModel, kind: str, greys: int = 255) -> InformationTerms:
    return _by_pixels(derivative, noise, greys) if kind == "image" else _by_sums(derivative, noise)


def _by_pixels(derivative: Derivative, noise: NoiseModel, greys: int) -> InformationTerms:
    """Return the information of pixels."""
    changing = derivative.jacobian.any(axis=(0, 3, 4))
    level, filled = derivative.level[changing], derivative.filled[changing]
    told = information(noise, level, filled, greys=greys)
    switching = level**2 * (1 / filled - 1)  # of echoes that are there or not: the law holds it
    rays = np.maximum(derivative.variance[changing] - switching, 0.0) * told.slope[:, 0] ** 2
    return InformationTerms(told, derivative.jacobian[:, changing].astype(float), rays)


def _by_sums(derivative: Derivative, noise: NoiseModel) -> InformationTerms:
    """Return the information of sums over the beams."""
    jacobian = derivative.jacobian.sum(axis=2, dtype=float)
    changing = jacobian.any(axis=(0, 2, 3))
    level, filled = derivative.level[changing], derivative.filled[changing]
    told = information_of_sums(noise, filled.sum(axis=1), filled.shape[1])
    by_filled = told.slope[:, 1:]
    # no ray falls into two beams: variances of a row's pixels add up
    rays = derivative.variance[changing] + (2 * by_filled * level + by_filled**2 * filled) * (1 - filled)
    return InformationTerms(told, jacobian[:, changing], np.maximum(rays.sum(axis=1), 0.0))


def bounds_of_views(
    names: Sequence[str], views: Sequence[Derivative], noise: NoiseModel, *, apart: bool = True
) -> dict[tuple[str, str, str], Bound | None]:
    """All bounds at one pose: (portion, kind, law) -> bound; of several views their sum too, as ``all views``.

    Args:
        names: of the views.
        views: their derivatives.
        noise: of their pixels.
        apart: whether no two views hear the same rays; those that do have no sum.
    """
    found: dict[tuple[str, str, str], Bound | None] = {}
    for kind in KINDS:
        told = [_terms(view, noise, kind) for view in views]
        for law in LAWS:
            parts = [one.bound(law) for one in told]
            if len(parts) > 1 and apart:
                found[ALL, kind, law] = together(parts)
            found |= {(name, kind, law): part for name, part in zip(names, parts, strict=True)}
    return found


def bounds_at(
    simulator: Simulator, poses: ArrayLike, noise: NoiseModel, gain: float, *, pings: int | None = None
) -> Iterator[dict[tuple[str, str, str], Bound | None]]:
    """:func:`bounds_of_views` at each pose.

    Args:
        simulator: of the scene that the poses are in (of a data set: ``SceneRenderer(recipe, scene).simulator``).
        poses: of the sonar ``(n, 6)``.
        noise: of the pixels.
        gain: that of the frames.
        pings: of each half of the derivatives; default: 8, and four times as many, twice, where images leave it open whether
            an axis can be observed.
    """
    if simulator.coherent is not None:
        refuse_noise(noise, simulator.sonar)
        for laws in SpeckleBounds(simulator, gain).at(poses, pings=pings):
            yield {(simulator.views[0].name, "image", law): found for law, found in laws.items()}
        return
    source, names = jittered(simulator), [view.name for view in simulator.views]
    portions = [view.member for view in simulator.views if isinstance(view, Segment)]
    apart = not portions or bool(np.sum(portions, axis=0).max() <= 1)
    for number, pose in enumerate(np.atleast_2d(np.asarray(poses, dtype=float))):
        for count in (PINGS, 4 * PINGS, 16 * PINGS) if pings is None else (pings,):
            first = FIRST_PING + 32 * PINGS * number
            views = next(differentiate(source, pose, gain, pings=count, first=first))
            found = bounds_of_views(names, views, noise, apart=apart)
            images = [one for (_, kind, _), one in found.items() if kind == "image" and one is not None]
            if all(np.isfinite(one.std()).all() for one in images):
                break
        yield found


def cramer_rao_bound(
    simulator: Simulator,
    poses: ArrayLike,
    noise: NoiseModel,
    gain: float,
    *,
    view: str | None = None,
    kind: str = "image",
    law: str | None = None,
    frames: int = 2,
    pings: int | None = None,
) -> NDArray[np.float64]:
    """Compute the least standard deviations of a motion at each pose (Cramer and Rao).

    Args:
        simulator: of the scene that the poses are in.
        poses: of the sonar ``(n, 6)`` [m, rad].
        noise: of the pixels; without noise ask for the law ``rays``. The model ``coherent`` has its own: none.
        gain: that of the frames.
        view: which one; default: the only one, or all together where no two hear the same rays.
        kind: ``image``, all pixels, or ``vector``, sums over the beams; the model ``coherent`` has images only.
        law: ``pixel``: the exact law of the noisy pixel, clipped and rounded to grey values; ``gaussian``: a Gaussian of the
            same mean and variance; ``rays``: the same, with the noise of the rays of a single ping as further variance. Of
            the model ``coherent`` ``ground``: the expected level is known, and the grain is new in each frame; ``grain``:
            the scatterers are known as well. Default: ``pixel``, of the model ``coherent`` ``ground``.
        frames: noisy ones, 1 or 2.
        pings: of each half of the derivatives; default: 8, and four times as many, twice, where images leave it open whether
            an axis can be observed.

    Returns:
        Sideways, forward [m] and yaw [rad] ``(n, 3)``; 0 where nothing but rounding stands between a pixel and its level,
        inf where an axis cannot be observed.

    Raises:
        MitsonarError: unknown words; several portions that overlap, and none named; noise of pixels with speckle.
    """
    speckle = simulator.coherent is not None
    law = law or ("ground" if speckle else "pixel")
    _check(kind, law, ["image"] if speckle else list(KINDS), list(laws_of(simulator.sonar)))
    portion = view or (ALL if len(simulator.views) > 1 else simulator.views[0].name)
    found = []
    for one in bounds_at(simulator, poses, noise, gain, pings=pings):
        if (portion, kind, law) not in one:
            names = ", ".join(known.name for known in simulator.views)
            raise MitsonarError(f"portions that overlap have no bound together: got view {view!r}; name one of {names}")
        found.append(one[portion, kind, law])
    return np.array([np.zeros(3) if one is None else one.std(frames) for one in found]).reshape(-1, 3)


# ---------------------------------------------------------------- what if


def varied(
    sonar: Sonar, poses: NDArray[np.float64], heights: NDArray[np.float64], name: str, value: float | tuple[float, float]
) -> tuple[Sonar, NDArray[np.float64]]:
    """Sonar and poses with one number of :data:`VARIABLES` changed.

    The floor stays in the window: where height, pitch or a field of view change, both ends of the window move in the
    proportion in which the nearest and the farthest range of the level floor in view do, and its bins become longer or
    shorter with it. A window that is given itself stays as it is.

    Args:
        sonar: the instrument.
        poses: of the sonar ``(n, 6)``.
        heights: over the ground ``(n,)`` [m].
        name: of the number.
        value: in the unit that its name says; of ``window`` both ends [m].

    Raises:
        MitsonarError: unknown name, a value outside its limits, a sonar that looks past the floor to the horizon.
    """
    if name not in VARIABLES:
        raise MitsonarError(f"unknown variable {name!r}: {nearest_names(name, VARIABLES)}")
    if name == "window":
        near, far = value  # type: ignore[misc]
        return sonar.replace(range_min=near, range_max=far), poses
    changed, number = poses.copy(), float(value)  # type: ignore[arg-type]
    before = floor_ranges(sonar, float(heights.mean()), float(poses[:, 3].mean())) if name in MOVING else None
    height, other = heights, sonar
    if name == "height_m":
        if not number > 0:
            raise MitsonarError(f"height_m must be above 0: got {number:g}")
        changed[:, 2] += number - heights
        height = np.full_like(heights, number)
    elif name == "pitch_deg":
        changed[:, 3] = np.radians(number)
    else:
        whole = name in ("beams", "range_bins", "rays_per_beam")
        if whole and number != round(number):
            raise MitsonarError(f"{name} must be a whole number: got {number:g}")
        width = {"beam_width_deg": None} if name in ("azimuth_fov_deg", "beams") else {}
        other = sonar.replace(**{name: round(number) if whole else number}, **width)
    if before is None:
        return other, changed
    after = floor_ranges(other, float(height.mean()), float(changed[:, 3].mean()))
    near, far = (end * new / old for end, new, old in zip((sonar.range_min, sonar.range_max), after, before, strict=True))
    return other.replace(range_min=near, range_max=far), changed


def floor_ranges(sonar: Sonar, height_m: float, pitch_rad: float) -> tuple[float, float]:
    """Nearest and farthest range of a level floor in the field of view [m].

    Raises:
        MitsonarError: part of it looks to the horizon.
    """
    half = sonar.bearing_rad[-1] + sonar.beam_width_rad / 2
    elevation = np.radians(sonar.elevation_fov_deg) / 2
    b, e = np.meshgrid(np.linspace(-half, half, 181), np.linspace(-elevation, elevation, 181))
    turn = vehicle_rotation(Pose(0, 0, 0, pitch_rad, 0, 0))
    down = -turn.apply(directions(sonar.bearing, b.ravel(), e.ravel()))[:, 2]
    if down.min() < 1e-3:
        raise MitsonarError(
            f"at pitch {np.degrees(pitch_rad):.3g} deg the field of view of {sonar.elevation_fov_deg:g} deg reaches the "
            "horizon, no window holds that floor: raise pitch_deg or lower elevation_fov_deg"
        )
    return height_m / float(down.max()), height_m / float(down.min())
