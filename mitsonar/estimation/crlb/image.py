"""How well any unbiased estimator can know a motion from images: the Cramer-Rao lower bound for a known scene.

No unbiased estimator of the motion (sideways, forward, yaw, or more degrees of freedom) has a covariance below the inverse
of the Fisher information F = J' W J. J is the derivative of the pixels by the motion, W the information of a noisy pixel
(:mod:`mitsonar.acoustics.noise`). The bound is that of an oracle that has the renderer and knows the scene, its height and
the frames without noise.

*One frame* is registered with that oracle: covariance 1 / F. *Two frames*, both noisy, of a known relief: twice that. The
bound is optimistic, since a real estimator has to find the relief and the reflectivity of every cell in the same two frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from mitsonar.acoustics.levels import coding_slope
from mitsonar.acoustics.noise import Information, NoiseModel, information, information_of_sums, refuse_noise
from mitsonar.acoustics.speckle import rician_information, score_components
from mitsonar.errors import MitsonarError, suggest_names
from mitsonar.instruments.sonar import Quality, Sonar
from mitsonar.instruments.views import Segment, directions
from mitsonar.motion.composition import PLANAR, MotionStd
from mitsonar.motion.pose import Pose, vehicle_rotation
from mitsonar.simulation.derivatives import (
    FIRST_PING,
    PINGS,
    STEP,
    Derivative,
    differentiate,
    evenly,
    jittered,
    moved_poses,
    steps_for,
)
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    from mitsonar.simulation.models.coherent import CoherentImager

__all__ = [
    "ALL",
    "KINDS",
    "LARGEST",
    "LAWS",
    "SPECKLE_LAWS",
    "VARIABLES",
    "Bound",
    "CellCorrelation",
    "CellScores",
    "ScoreCovariance",
    "SpeckleBounds",
    "balanced_steps",
    "bound",
    "bounds_at",
    "bounds_of_views",
    "cramer_rao_bound",
    "expected_sonar",
    "fisher",
    "fisher_by",
    "floor_ranges",
    "grain_law",
    "is_decided",
    "laws_of",
    "overall",
    "pixel_terms",
    "together",
    "varied",
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
    "azimuth_fov_deg": "constant number of beams, which are as wide as their spacing",
    "elevation_fov_deg": "constant number of rays over it",
    "beams": "constant field of view, beams are as wide as their spacing",
    "range_bins": "constant window",
    "window": "both ends [m], 3.2..5.6; constant number of bins",
}
"""Variables for which a bound can be computed over many values, with their meaning and what remains constant."""

FLOOR_MOVING_VARIABLES = ("height_m", "pitch_deg", "azimuth_fov_deg", "elevation_fov_deg")
"""Variables that move the floor out of the window."""


LARGEST = MotionStd()
"""The largest standard deviations that count as an observation."""

LONGEST_STEP = 0.25
"""Longest step of a derivative along directions that hardly change a frame, in bins and beams.

Derivatives are then known with a tenth of the pings. Bounds of six degrees of freedom are up to 10 % larger than with
steps of :data:`STEP`, since such steps smooth over a quarter of a bin.
"""


class InformationTerms(NamedTuple):
    """Information about the motion from values that change with it.

    Attributes:
        information: of each value ``(n, ...)``.
        jacobian: two estimates of the derivative of the parameters of the values ``(2, n, 2, k)``.
        rays: variance of each value by the rays of a ping, beyond what its law includes ``(n,)``.
    """

    information: Information
    jacobian: NDArray[np.float64]
    rays: NDArray[np.float64]

    def bound(self, law: str) -> Bound | None:
        """Return the bound by one of :data:`LAWS`; None where the information is unlimited."""
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

    Without noise only rounding separates a pixel from its level. The exact law then gives unlimited information, and the
    result is None. The law ``gaussian`` counts rounding as a variance of 1 / (12 255^2), as for pixels dithered by some
    noise; ``rays`` adds the noise of the rays, which every single ping has. Vectors are not rounded, and have no
    ``gaussian`` bound without noise either.

    Args:
        derivative: derivative of the view at a pose.
        noise: noise of its pixels.
        kind: one of :data:`KINDS`.
        law: one of :data:`LAWS`.
        greys: the largest grey value with which pixels are stored.

    Raises:
        MitsonarError: an unknown kind or law.
    """
    _check(kind, law)
    return _terms(derivative, noise, kind, greys).bound(law)


def laws_of(sonar: Sonar) -> dict[str, str]:
    """Return the laws that apply to a sonar's pixels, with their meaning, by name; comparisons use the last one."""
    return SPECKLE_LAWS if sonar.model == "coherent" else LAWS


def _check(kind: str, law: str, kinds: Sequence[str] = tuple(KINDS), laws: Sequence[str] = tuple(LAWS)) -> None:
    for label, word, names in (("kind", kind, kinds), ("law", law, laws)):
        if word not in names:
            raise MitsonarError(f"unknown {label} {word!r}: {suggest_names(word, names)}")


def _terms(derivative: Derivative, noise: NoiseModel, kind: str, greys: int = 255) -> InformationTerms:
    return pixel_terms(derivative, noise, greys) if kind == "image" else _by_sums(derivative, noise)


def pixel_terms(derivative: Derivative, noise: NoiseModel, greys: int = 255) -> InformationTerms:
    """Return the information of the pixels that change with the motion, in the order of the image."""
    changing = derivative.jacobian.any(axis=(0, 3, 4))
    level, filled = derivative.level[changing], derivative.filled[changing]
    value_information = information(noise, level, filled, greys=greys)
    switching = level**2 * (1 / filled - 1)  # variance of echoes that are there or not, which the law includes
    rays = np.maximum(derivative.variance[changing] - switching, 0.0) * value_information.slope[:, 0] ** 2
    return InformationTerms(value_information, derivative.jacobian[:, changing].astype(float), rays)


def _by_sums(derivative: Derivative, noise: NoiseModel) -> InformationTerms:
    """Return the information of sums over the beams."""
    jacobian = derivative.jacobian.sum(axis=2, dtype=float)
    changing = jacobian.any(axis=(0, 2, 3))
    level, filled = derivative.level[changing], derivative.filled[changing]
    value_information = information_of_sums(noise, filled.sum(axis=1), filled.shape[1])
    by_filled = value_information.slope[:, 1:]
    # no ray falls into two beams, so the variances of a row's pixels add up
    rays = derivative.variance[changing] + (2 * by_filled * level + by_filled**2 * filled) * (1 - filled)
    return InformationTerms(value_information, jacobian[:, changing], np.maximum(rays.sum(axis=1), 0.0))


def bounds_of_views(
    names: Sequence[str], views: Sequence[Derivative], noise: NoiseModel, *, apart: bool = True
) -> dict[tuple[str, str, str], Bound | None]:
    """Compute all bounds at one pose, keyed by (portion, kind, law); several views also have their sum, as ``all views``.

    Args:
        names: names of the views.
        views: their derivatives.
        noise: noise of their pixels.
        apart: whether no two views receive the same rays; views that share rays have no sum.
    """
    bounds: dict[tuple[str, str, str], Bound | None] = {}
    for kind in KINDS:
        terms = [_terms(view, noise, kind) for view in views]
        for law in LAWS:
            parts = [term.bound(law) for term in terms]
            if len(parts) > 1 and apart:
                bounds[ALL, kind, law] = together(parts)
            bounds |= {(name, kind, law): part for name, part in zip(names, parts, strict=True)}
    return bounds


def bounds_at(
    simulator: Simulator,
    poses: ArrayLike,
    noise: NoiseModel,
    gain: float,
    *,
    pings: int | None = None,
    degrees: Sequence[str] = PLANAR,
    mount: Pose | None = None,
) -> Iterator[dict[tuple[str, str, str], Bound | None]]:
    """Compute :func:`bounds_of_views` at each pose.

    Args:
        simulator: simulator of the scene that contains the poses; for a data set
            ``SceneRenderer(recipe, scene).simulator``.
        poses: poses of the sonar ``(n, 6)``.
        noise: noise of the pixels.
        gain: gain of the frames.
        pings: pings of each half of the derivatives; default: 8, then 32 and 128 while it is undecided whether an
            axis can be observed.
        degrees: names of the k degrees of freedom of the motion, of :data:`mitsonar.motion.composition.DEGREES`.
        mount: pose of the sonar in the axes of a vehicle, to which poses and motion then belong.
    """
    if simulator.sonar.model == "coherent":
        refuse_noise(noise, simulator.sonar)
        for laws in SpeckleBounds(simulator, gain, degrees, mount).at_poses(poses, pings=pings):
            yield {(simulator.views[0].name, "image", law): one for law, one in laws.items()}
        return
    six = tuple(degrees) != PLANAR
    source, names = jittered(simulator), [view.name for view in simulator.views]
    portions = [view.member for view in simulator.views if isinstance(view, Segment)]
    apart = not portions or bool(np.sum(portions, axis=0).max() <= 1)
    for number, pose in enumerate(np.atleast_2d(np.asarray(poses, dtype=float))):
        along: dict[str, Any] = {}
        for count in (PINGS, 4 * PINGS, 16 * PINGS) if pings is None else (pings,) * (2 if six else 1):
            first = FIRST_PING + 32 * PINGS * number
            motion: dict[str, Any] = {"degrees": degrees, "mount": mount} | along
            views = next(differentiate(source, pose, gain, pings=count, first=first, **motion))
            bounds = bounds_of_views(names, views, noise, apart=apart)
            images = [one for (_, kind, _), one in bounds.items() if kind == "image" and one is not None]
            if six and images:
                basis, step = balanced_steps(sum(images[1:], images[0]), source.sonar, degrees)
                first_time, along = not along, {"basis": basis, "step": step}
                if first_time:
                    continue  # the first bound only balances the steps
            if all(is_decided(one, degrees) if six else np.isfinite(one.std()).all() for one in images):
                break
        yield bounds


def is_decided(bound: Bound, degrees: Sequence[str]) -> bool:
    """Return whether each direction of a motion is observable, or is not by :data:`LARGEST`, despite the rays' noise."""
    size, _, significant = bound.directions(LARGEST.of(degrees))
    return bool(((size > significant) | (np.maximum(size, 0.0) + significant < 1)).all())


def balanced_steps(
    bound: Bound, sonar: Sonar, degrees: Sequence[str], part: float = STEP
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return directions ``(k, k)`` and steps ``(k,)`` of derivatives that change a frame by about as much each.

    The directions are the eigenvectors of the information, in units of bins and beams. The best known one has the usual
    step. That of others is longer as their information is smaller, up to :data:`LONGEST_STEP` bins or beams.

    Args:
        bound: a first bound.
        sonar: the instrument.
        degrees: names of the k degrees of freedom.
        part: the usual step, as a fraction of a bin and of a beam.
    """
    unit = steps_for(sonar, degrees, 1.0)
    size, axes, significant = bound.directions(unit)
    size = np.maximum(size, significant)
    return unit[:, None] * axes, np.clip(part * np.sqrt(size.max() / size), part, max(part, LONGEST_STEP))


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
    degrees: Sequence[str] = PLANAR,
) -> NDArray[np.float64]:
    """Compute the least standard deviations of a motion at each pose (Cramer and Rao).

    Args:
        simulator: simulator of the scene that contains the poses.
        poses: poses of the sonar ``(n, 6)`` [m, rad].
        noise: noise of the pixels; without noise use the law ``rays``. The model ``coherent`` includes noise: give none.
        gain: gain of the frames.
        view: name of a view; default: the only one, or all together if no two receive the same rays.
        kind: ``image``, all pixels, or ``vector``, sums over the beams; the model ``coherent`` has images only.
        law: ``pixel``: the exact law of the noisy pixel, clipped and rounded to grey values; ``gaussian``: a Gaussian of the
            same mean and variance; ``rays``: the same, with the noise of the rays of a single ping as further variance. For
            the model ``coherent``, ``ground``: the expected level is known, and the grain is new in each frame; ``grain``:
            the scatterers are known as well. Default: ``pixel``, or ``ground`` for the model ``coherent``.
        frames: number of noisy frames, 1 or 2.
        pings: pings of each half of the derivatives; default: 8, then 32 and 128 while it is undecided whether an
            axis can be observed.
        degrees: names of the k degrees of freedom of the motion, of :data:`mitsonar.motion.composition.DEGREES`.

    Returns:
        Sideways, forward [m] and yaw [rad], or the other ``degrees`` ``(n, k)``; 0 where only rounding separates a pixel
        from its level, inf where an axis cannot be observed.

    Raises:
        MitsonarError: unknown names; several portions that overlap, and none named; noise of pixels with speckle.
    """
    speckle = simulator.sonar.model == "coherent"
    law = law or ("ground" if speckle else "pixel")
    _check(kind, law, ["image"] if speckle else list(KINDS), list(laws_of(simulator.sonar)))
    portion = view or (ALL if len(simulator.views) > 1 else simulator.views[0].name)
    bounds = []
    for at_pose in bounds_at(simulator, poses, noise, gain, pings=pings, degrees=degrees):
        if (portion, kind, law) not in at_pose:
            names = ", ".join(known.name for known in simulator.views)
            raise MitsonarError(f"overlapping portions have no common bound: got view {view!r}; name one of {names}")
        bounds.append(at_pose[portion, kind, law])
    return np.array([np.zeros(len(degrees)) if one is None else one.std(frames) for one in bounds]).reshape(-1, len(degrees))


# ---------------- Changed sonars and poses


def varied(
    sonar: Sonar, poses: NDArray[np.float64], heights: NDArray[np.float64], name: str, value: float | tuple[float, float]
) -> tuple[Sonar, NDArray[np.float64]]:
    """Return sonar and poses with one of :data:`VARIABLES` changed.

    The floor stays in the window: if height, pitch or a field of view changes, both ends of the window move in the same
    proportion as the nearest and the farthest range of the level floor in view, and its bins scale with it. A window that is
    given explicitly is not changed.

    Args:
        sonar: the instrument.
        poses: poses of the sonar ``(n, 6)``.
        heights: heights over the ground ``(n,)`` [m].
        name: name of the variable.
        value: in the unit given by its name; for ``window`` both ends [m].

    Raises:
        MitsonarError: an unknown name, a value outside its limits, or a sonar that looks past the floor to the horizon.
    """
    if name not in VARIABLES:
        raise MitsonarError(f"unknown variable {name!r}: {suggest_names(name, VARIABLES)}")
    if name == "window":
        near, far = value  # type: ignore[misc]
        return sonar.replace(range_min=near, range_max=far), poses
    varied_poses, number = poses.copy(), float(value)  # type: ignore[arg-type]
    # change the variable itself
    before = (
        floor_ranges(sonar, float(heights.mean()), float(poses[:, 3].mean())) if name in FLOOR_MOVING_VARIABLES else None
    )
    height, varied_sonar = heights, sonar
    if name == "height_m":
        if not number > 0:
            raise MitsonarError(f"height_m must be above 0: got {number:g}")
        varied_poses[:, 2] += number - heights
        height = np.full_like(heights, number)
    elif name == "pitch_deg":
        varied_poses[:, 3] = np.radians(number)
    else:
        is_whole = name in ("beams", "range_bins", "rays_per_beam")
        if is_whole and number != round(number):
            raise MitsonarError(f"{name} must be a whole number: got {number:g}")
        width = {"beam_width_deg": None} if name in ("azimuth_fov_deg", "beams") else {}
        varied_sonar = sonar.replace(**{name: round(number) if is_whole else number}, **width)
    if before is None:
        return varied_sonar, varied_poses
    # scale the window with the range of the floor
    after = floor_ranges(varied_sonar, float(height.mean()), float(varied_poses[:, 3].mean()))
    near, far = (end * new / old for end, new, old in zip((sonar.range_min, sonar.range_max), after, before, strict=True))
    return varied_sonar.replace(range_min=near, range_max=far), varied_poses


def floor_ranges(sonar: Sonar, height_m: float, pitch_rad: float) -> tuple[float, float]:
    """Return the nearest and farthest range of a level floor in the field of view [m].

    Raises:
        MitsonarError: part of the field of view reaches the horizon.
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


# ---------------- Fisher information and least covariance


SIGNIFICANCE = 3.0
"""Number of standard errors that the information of an observable direction exceeds."""


@dataclass(frozen=True)
class Bound:
    """Fisher information of the motion in one frame.

    Attributes:
        information: F ``(k, k)`` of k degrees of freedom, such as sideways, forward [1/m^2] and yaw [1/rad^2].
        reason: covariance of the elements of F due to the noise of the rays in its computation ``(k, k, k, k)``.
    """

    information: NDArray[np.float64]
    reason: NDArray[np.float64]

    def __add__(self, other: Bound) -> Bound:
        """Return the bound of two independent images."""
        return Bound(self.information + other.information, self.reason + other.reason)

    def covariance(self, frames: int = 1) -> NDArray[np.float64]:
        """Return the least covariance ``(k, k)`` [m, rad]: of one frame relative to an oracle, or of two noisy frames.

        It is the pseudo-inverse where not everything can be observed. Axes that contribute to an unobservable direction have
        infinite variance.
        """
        if frames not in (1, 2):
            raise MitsonarError(f"a bound is for 1 or 2 noisy frames: got {frames}")
        # scale F to a unit diagonal; keep the directions that exceed their errors
        diagonal = np.diag(self.information)
        scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
        size, axes, significant = self.directions(scale)
        known = size > significant
        inverse = (axes[:, known] / size[known]) @ axes[:, known].T * np.outer(scale, scale)
        # axes with a part in the other directions are unobservable
        unobservable = (axes[:, ~known] ** 2).sum(axis=1) > 1e-3
        inverse[unobservable, :] = inverse[:, unobservable] = 0
        inverse[unobservable, unobservable] = np.inf
        return np.asarray(frames * inverse)

    def directions(self, scale: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the eigenvalues ``(k,)`` and eigenvectors ``(k, k)`` of F for scaled axes, and their significance ``(k,)``.

        An eigenvalue is significant if it exceeds this value, a multiple of its error due to the noise of the rays.

        Args:
            scale: unit of each axis ``(k,)`` [m, rad].
        """
        size, axes = np.linalg.eigh(self.information * np.outer(scale, scale))
        return size, axes, np.maximum(SIGNIFICANCE * self._error(axes * scale[:, None]), 1e-9)

    def std(self, frames: int = 1) -> NDArray[np.float64]:
        """Return the least standard deviations ``(k,)`` [m, rad]; inf where an axis cannot be observed."""
        return np.asarray(np.sqrt(np.diag(self.covariance(frames))))

    @property
    def relative_error(self) -> NDArray[np.float64]:
        """Relative standard error of :meth:`std` ``(k,)``; nan where an axis cannot be observed."""
        covariance = self.covariance()
        variance = np.diag(covariance)
        finite = np.where(np.isfinite(covariance), covariance, 0)
        return np.asarray(np.where(np.isfinite(variance), self._error(finite) / (2 * variance), np.nan))

    def _error(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the standard error of v' F v for each column v ``(k, n)``."""
        v = directions
        variance: NDArray[np.float64] = np.einsum("ijkl,in,jn,kn,ln->n", self.reason, v, v, v, v)
        return np.sqrt(np.maximum(variance, 0))


def fisher(jacobian: NDArray[np.float64], weight: NDArray[np.float64]) -> Bound:
    """Compute F = J1' W J2, made symmetric, and the covariance of its elements.

    Args:
        jacobian: two independent estimates of the derivatives of p parameters of n independent values by the motion
            ``(2, n, p, k)``.
        weight: information of each value about its parameters ``(n, p, p)``.
    """
    return fisher_by(jacobian, lambda values: weight @ values)


def fisher_by(jacobian: NDArray[np.float64], weigh: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Bound:
    """Compute F = J1' W J2 of values that need not be independent; see :func:`fisher`.

    With M the mean and D half the difference of both estimates it is M' W M - D' W D, and the noise of M is as large as D.

    Args:
        jacobian: two independent estimates ``(2, n, p, k)``.
        weigh: multiplies derivatives ``(n, p, k)`` by the information of all values, W.
    """
    mean, half = jacobian.mean(axis=0), (jacobian[0] - jacobian[1]) / 2
    weighted = weigh(half)
    mean_information = mean.transpose(0, 2, 1) @ weigh(mean)
    mean_information = (mean_information + mean_information.transpose(0, 2, 1)) / 2
    noise = half.transpose(0, 2, 1) @ weighted
    noise = (noise + noise.transpose(0, 2, 1)) / 2
    mixed = mean.transpose(0, 2, 1) @ weighted
    axes = jacobian.shape[-1]
    parts = np.concatenate([mixed + mixed.transpose(0, 2, 1), np.sqrt(2) * noise]).reshape(-1, axes**2)
    return Bound((mean_information - noise).sum(axis=0), (parts.T @ parts).reshape((axes,) * 4))


def together(parts: Sequence[Bound | None]) -> Bound | None:
    """Add the information of several views, whose noise is independent; None if any view has no bound."""
    known = [part for part in parts if part is not None]
    return sum(known[1:], known[0]) if len(known) == len(parts) else None


def overall(stds: Iterable[ArrayLike]) -> NDArray[np.float64]:
    """Return one number per axis for many poses ``(k,)``: the root of the mean variance, which is comparable to an RMSE."""
    return np.asarray(np.sqrt(np.mean(np.square(np.array(list(stds), dtype=float)), axis=0)))


# ---------------- Covariance of the scores of cells


Complex = NDArray[np.complex128]
Floats = NDArray[np.float64]

TOLERANCE, MOST_STEPS = 1e-5, 2000
"""Relative residual at which the conjugate gradients end, and their largest number of steps."""


@dataclass(frozen=True)
class CellCorrelation:
    """The correlation of two cells: that of their bins times that of their beams.

    Attributes:
        over_bins: ``(bins, bins)``.
        over_beams: ``(beams, beams)``.
    """

    over_bins: csr_array[Any, Any]
    over_beams: Floats

    def __mul__(self, other: CellCorrelation) -> CellCorrelation:
        """Multiply element by element."""
        return CellCorrelation(csr_array(self.over_bins.multiply(other.over_bins)), self.over_beams * other.over_beams)

    def __matmul__(self, image: NDArray[Any]) -> NDArray[Any]:
        """Apply to an image ``(bins, beams)``."""
        return np.asarray((self.over_bins @ image) @ self.over_beams.T)


@dataclass(frozen=True)
class ScoreCovariance:
    """Covariance of the standardised scores of all cells: sums of Re(w_i* R_ij w_j), and an uncorrelated part.

    Array and pulse spread echoes and noise over several cells, so the scores of neighbours are correlated. The information
    of n correlated values about a motion is J' W^1/2 C^-1 W^1/2 J: J is their derivative by the motion, W their individual
    information, C the covariance of their standardised scores. It is what the best weighted sum of the scores can use. Parts
    of C are products of a correlation over bins and one over beams.

    Attributes:
        parts: weights w ``(bins * looks, beams)`` with the correlation R of the looks.
        uncorrelated: variance of each cell that is uncorrelated with others ``(bins, beams)``, so that all have variance 1.
        looks: number of looks that a cell averages.
    """

    parts: list[tuple[NDArray[Any], CellCorrelation]]
    uncorrelated: Floats
    looks: int = 1

    @classmethod
    def from_parts(cls, parts: list[tuple[NDArray[Any], CellCorrelation]], shape: tuple[int, int]) -> ScoreCovariance:
        """Add the uncorrelated part that makes all variances 1.

        Args:
            parts: see the attribute.
            shape: bins and beams.
        """
        shared = sum((np.abs(weight) ** 2 for weight, _ in parts), np.zeros(shape))
        return cls(parts, np.maximum(1 - shared, 1e-6))

    @classmethod
    def of_looks(
        cls, parts: list[tuple[NDArray[Any], CellCorrelation]], looks: int, more: ArrayLike = 0.0
    ) -> tuple[Floats, ScoreCovariance]:
        """Return the variance of the means of looks ``(bins, beams)``, and the covariance of these means over its root.

        Args:
            parts: weights ``(bins * looks, beams)`` and the correlation of the looks.
            looks: number of looks that a cell averages.
            more: further variance of each cell, uncorrelated with others ``(bins, beams)``.
        """
        variance = 0.0
        for weight, correlation in parts:
            split = weight.reshape(-1, looks, weight.shape[1])
            for apart in range(looks):
                # looks of one cell a number of bins apart; both orders count
                along = correlation.over_bins.diagonal(apart)
                along = np.append(along, np.zeros(apart)).reshape(-1, looks, 1)[:, : looks - apart]
                products = (np.conj(split[:, : looks - apart]) * along * split[:, apart:]).real.sum(axis=1)
                variance = variance + (1 if apart == 0 else 2) * products / looks**2
        total = np.asarray(variance + np.asarray(more), dtype=np.float64)
        safe = np.where(total > 0, total, 1.0)
        root = np.repeat(np.sqrt(safe), looks, axis=0)
        scaled = [(weight / root, correlation) for weight, correlation in parts]
        return total, cls(scaled, np.maximum(1 - variance / safe, 1e-6), looks)

    def __matmul__(self, values: Floats) -> Floats:
        """Apply to maps ``(k, bins, beams)``."""
        product = self.uncorrelated * values
        for weight, correlation in self.parts:
            for total, one in zip(product, values, strict=True):
                each = one if self.looks == 1 else np.repeat(one / self.looks, self.looks, axis=0)
                total += _mean_of_looks((np.conj(weight) * (correlation @ (weight * each))).real, self.looks)
        return product

    def solve(self, values: Floats) -> Floats:
        """Return C^-1 of maps ``(k, bins, beams)``, by conjugate gradients.

        Raises:
            MitsonarError: the iteration does not converge.
        """
        solution, residual = np.zeros_like(values), values.copy()
        direction, size = residual.copy(), np.einsum("kij,kij->k", residual, residual)
        target = TOLERANCE**2 * size
        for _ in range(MOST_STEPS):
            if (size <= target).all():
                return solution
            # one step along the conjugate direction of each map; maps of zeros stay zero
            spread = self @ direction
            along = np.einsum("kij,kij->k", direction, spread)
            step = np.divide(size, along, out=np.zeros_like(size), where=along > 0)[:, None, None]
            solution += step * direction
            residual -= step * spread
            before, size = size, np.einsum("kij,kij->k", residual, residual)
            direction = (
                residual + np.divide(size, before, out=np.zeros_like(size), where=before > 0)[:, None, None] * direction
            )
        raise MitsonarError("the covariance of the cells cannot be inverted: give beams nearer to the width of the spacing")


# ---------------- Bounds of the coherent model


SPECKLE_LAWS: dict[str, str] = {
    "grain": "scatterers and ground are known: amplitudes in the receiver's noise, rounded to grey values",
    "ground": "the expected level is known, the grain is new in each frame: intensities of speckle and noise",
}

GRAIN_PINGS, GROUND_PINGS = 2, 4
"""Number of places at which each half of the derivatives is taken: bounds vary by 1 to 3 %."""

GRAIN_STEP = 1 / 8
"""Step of the grain's derivatives, as a fraction of a bin (forward) and of a beam (sideways, yaw): a tenth of the grain."""

OTHER_HALF_QUALITY: dict[str, Quality] = {"draft": "standard", "standard": "fine", "fine": "standard"}
"""Quality of the rays of the other half."""

MAX_RELATIVE_DEVIATION = 0.5
"""Relative deviation beyond which a value is left out.

It applies to echoes on which two sets of rays disagree, such as sharp edges and thin tops of rocks, and to expected levels
that vary from ping to ping of moving rays.
"""

GREYS = 255


class SpeckleBounds:
    """Bounds of one sonar of the model ``coherent`` in one scene, whose pixels are |s + n|: speckle s, receiver noise n.

    *Grain known*: an oracle has the scatterers, so s is a function of the pose. A pixel has the Rice law
    (:mod:`mitsonar.acoustics.speckle`), and |s|^2 changes with the motion. Only amplitudes are observed: the phase of s,
    which turns once in a quarter of a millimetre, gives no information. Neighbouring cells share noise.

    *Ground known*: an oracle knows the expected level of every cell, as for the other models, but no scatterers. Each frame
    has new grain, as after a motion of more than the grain's size. An intensity is exponential; its score is the intensity
    over its mean, and the scores of two cells covary as the squared coherence of their fields.

    Both bounds are what the best weighted sum of the scores of single pixels can use. ``ground`` is optimistic in two
    respects: speckle correlates as on even ground, though a dark cell beside a bright one shows the grain of the bright one;
    and it leaves out patches of ``speckle_nu``, which belong to the grain.

    With several looks, a pixel is the mean of as many powers, and its score is its deviation from the expected mean.

    Args:
        simulator: of the model ``coherent``.
        gain: gain of the frames.
        degrees: names of the k degrees of freedom of the motion.
        mount: pose of the sonar in the axes of a vehicle, to which poses and motion then belong.

    Raises:
        MitsonarError: another model, or a sonar that saturates.
    """

    def __init__(
        self, simulator: Simulator, gain: float, degrees: Sequence[str] = PLANAR, mount: Pose | None = None
    ) -> None:
        if simulator.model.imager is None:
            raise MitsonarError(f"bounds of speckle are for the model coherent: got {simulator.sonar.model}")
        if simulator.sonar.saturation_db is not None:
            raise MitsonarError(
                f"bounds do not know the distortion of a receiver that saturates: got saturation_db"
                f" {simulator.sonar.saturation_db:g}; leave it out"
            )
        self.sonar, self.gain = simulator.sonar, gain
        self.degrees, self.mount = degrees, mount
        self.imager = simulator.model.imager
        self.halves = self.imager, self.imager.of_quality(OTHER_HALF_QUALITY[self.sonar.quality])
        mirrors = simulator.mirrors if self.sonar.bounces > 1 else None  # with one reflection a mirror has no expected level
        self.expected = Simulator(simulator.tracer.scene, expected_sonar(self.sonar), mirrors=mirrors)
        # noise of the receiver and of the volume, which beams correlate differently
        noise, volume = self.imager.receiver.noise_powers()
        self.noise = np.broadcast_to((noise + volume)[:, None], (self.sonar.range_bins, self.sonar.beams))
        beams = self.imager.receiver.beam_correlations()
        share = float(volume.sum()) / max(float((noise + volume).sum()), 1e-300)
        bins = self.imager.receiver.bin_correlation().astype(float)
        self.noise_correlation = CellCorrelation(bins, (1 - share) * beams[0] + share * beams[1])
        self.speckle_correlation = CellCorrelation(bins, beams[2])

    def at_poses(self, poses: ArrayLike, *, pings: int | None = None) -> Iterator[dict[str, Bound]]:
        """Compute the bounds at each pose, keyed by :data:`SPECKLE_LAWS`.

        Args:
            poses: poses of the sonar ``(n, 6)``.
            pings: pings of each half of the derivatives; default: 2 for the grain, 4 for the ground.
        """
        for number, pose in enumerate(np.atleast_2d(np.asarray(poses, dtype=float))):
            first = FIRST_PING + 32 * PINGS * number
            yield {"grain": self.grain(pose, pings).bound(), "ground": self.ground(pose, pings, first).bound()}

    def grain(self, pose: Floats, pings: int | None = None) -> CellScores:
        """Return the information of cells about the motion if the scatterers are known.

        The derivatives are those of the power of echoes, by two sets of rays.

        Args:
            pose: pose of the sonar ``(6,)``.
            pings: see :meth:`at_poses`.
        """
        # two independent estimates of the derivative, by two sets of rays
        jacobian = np.stack([self._power_slopes(imager, pose, pings or GRAIN_PINGS) for imager in self.halves])
        looks, place = self.sonar.looks, self._places(pose, np.zeros((1, len(self.degrees))))[0]
        echo, other_echo = (imager.echoes(place)[0].astype(np.complex128) for imager in self.halves)
        power, apart, together = (
            _mean_of_looks(np.abs(field) ** 2, looks) for field in (echo, echo - other_echo, echo + other_echo)
        )
        level = power + self.noise
        # leave out clipped pixels and echoes on which the rays disagree; rounding adds variance
        scale = self.gain * self.imager.gain.astype(float)[:, None]
        slope = coding_slope(level * scale, self.sonar) * scale
        used = (slope > 0) & (np.sqrt(apart) < MAX_RELATIVE_DEVIATION * np.sqrt(together) / 2)
        rounding = np.divide(1 / (12 * GREYS**2), slope**2, out=np.full_like(slope, np.inf), where=used)
        return CellScores(jacobian, *grain_law(echo, self.noise, self.noise_correlation, rounding, looks))

    def ground(self, pose: Floats, pings: int | None = None, first: int = FIRST_PING) -> CellScores:
        """Return the information of cells about the motion if the expected level is known.

        The derivatives are those of the expected level, divided by the sum of level and noise.

        Args:
            pose: pose of the sonar ``(6,)``.
            pings: see :meth:`at_poses`.
            first: number of the first ping, which determines the rays' jitter.
        """
        scores = self._ground(pose, pings, first, {})
        if tuple(self.degrees) != PLANAR:
            # the first bound only balances the steps
            basis, step = balanced_steps(scores.bound(), self.sonar, self.degrees)
            scores = self._ground(pose, pings, first, {"basis": basis, "step": step})
        return scores

    def _ground(self, pose: Floats, pings: int | None, first: int, along: dict[str, Any]) -> CellScores:
        """Return :meth:`ground` with steps of the derivatives along given directions."""
        # expected level and derivative, scaled well below clipping
        place = self._places(pose, np.zeros((1, len(self.degrees))))
        gain = 0.01 / float(next(self.expected.pings(place, first=first)).levels.max())
        motion: dict[str, Any] = {"degrees": self.degrees, "mount": self.mount} | along
        (derivative,) = next(differentiate(self.expected, pose, gain, pings=pings or GROUND_PINGS, first=first, **motion))
        level = derivative.level + self.noise * self.imager.gain[:, None] * gain
        known = (level > 0) & (derivative.variance < (MAX_RELATIVE_DEVIATION * level) ** 2)
        safe = np.where(known, level, 1)
        # fractions of speckle and noise, whose products give the covariance of the scores
        echo_share = np.where(known, derivative.level, 0) / safe
        noise_share = np.where(known, 1 - echo_share, 0.0)
        parts = [
            (echo_share, self.speckle_correlation * self.speckle_correlation),
            (np.sqrt(2 * echo_share * noise_share), self.speckle_correlation * self.noise_correlation),
            (noise_share, self.noise_correlation * self.noise_correlation),
        ]
        jacobian = derivative.jacobian[..., 0, :] / safe[..., None]
        looks = self.sonar.looks
        if looks == 1:
            return CellScores(jacobian, known.astype(float), ScoreCovariance.from_parts(parts, level.shape))
        repeated = [(np.repeat(weight, looks, axis=0), correlation) for weight, correlation in parts]
        variance, covariance = ScoreCovariance.of_looks(repeated, looks)
        return CellScores(jacobian, np.divide(1, variance, out=np.zeros_like(variance), where=known), covariance)

    def mounted_at(self, mount: Pose) -> SpeckleBounds:
        """Return the same bounds for another mount of the sonar."""
        other = copy(self)
        other.mount = mount
        return other

    def _places(self, pose: Floats, motions: Floats) -> Floats:
        """Return the poses of the sonar after motions ``(n, k)`` from a pose."""
        if self.mount is None and not motions.any():
            return np.repeat(np.atleast_2d(pose), len(motions), axis=0)
        return moved_poses(Pose.from_row(pose), motions, self.degrees, self.mount)

    def _power_slopes(self, imager: CoherentImager, pose: Floats, pings: int) -> Floats:
        """Return the derivative of the power of echoes by the motion ``(bins, beams, k)``: mean over places in the step."""
        step = steps_for(self.sonar, self.degrees, GRAIN_STEP)
        offsets = evenly(pings, len(step)) * step
        slopes = np.zeros((imager.sonar.range_bins, imager.sonar.beams, len(step)))
        for axis in range(len(step)):
            for motion in offsets:
                for side in (1, -1):
                    moved = motion.copy()
                    moved[axis] = side * step[axis]
                    echo = imager.echoes(self._places(pose, moved[None])[0])[0]
                    power = echo.real.astype(float) ** 2 + echo.imag.astype(float) ** 2
                    slopes[..., axis] += side * _mean_of_looks(power, imager.sonar.looks)
        return slopes / (2 * step * pings)


class CellScores(NamedTuple):
    """Information of the cells of a frame about the motion.

    Attributes:
        jacobian: two independent estimates of the derivative of the cells' parameters by the motion ``(2, bins, beams, k)``.
        weight: Fisher information of each cell about its parameter ``(bins, beams)``.
        covariance: of the standardised scores.
    """

    jacobian: Floats
    weight: Floats
    covariance: ScoreCovariance

    def bound(self) -> Bound:
        """Compute the bound J1' W^1/2 C^-1 W^1/2 J2."""
        axes = self.jacobian.shape[-1]
        return fisher_by(np.asarray(self.jacobian, dtype=float).reshape(2, -1, 1, axes), self._weigh)

    def _weigh(self, values: Floats) -> Floats:
        """Return W^1/2 C^-1 W^1/2 of values ``(cells, 1, k)``."""
        root = np.sqrt(self.weight)
        maps = np.moveaxis(values.reshape(*root.shape, -1), 2, 0)
        return np.moveaxis(root * self.covariance.solve(root * maps), 0, 2).reshape(values.shape)


def grain_law(
    echo: Complex, noise: Floats, shared: CellCorrelation, rounding: ArrayLike = 0.0, looks: int = 1
) -> tuple[Floats, ScoreCovariance]:
    """Compute the information of amplitudes about the power of an echo whose noiseless field is known.

    Args:
        echo: the noiseless field ``(bins * looks, beams)``.
        noise: mean power of the noise ``(bins, beams)``; all 0: only rounding is left.
        shared: correlation of the noise of two looks.
        rounding: variance of the power by rounding ``(bins, beams)``; inf where a pixel is not to be used.
        looks: number of looks that a bin averages; with more than one, the score is the deviation from the mean power.

    Returns:
        The information of each cell ``(bins, beams)`` and the covariance of their scores.

    Raises:
        MitsonarError: neither noise nor rounding.
    """
    power = np.abs(echo) ** 2
    rounding = np.broadcast_to(np.asarray(rounding, dtype=float), noise.shape)
    # without noise only rounding limits the information
    if not (noise > 0).all():
        if not (rounding > 0).all():
            raise MitsonarError(
                "without noise, amplitudes determine the motion without limit: give the sonar noise_level_db"
            )
        return 1 / rounding, ScoreCovariance([], np.ones(noise.shape))
    if looks > 1:
        each = np.repeat(noise, looks, axis=0)
        unused = np.isinf(rounding)
        parts = [(np.sqrt(2 * each) * echo, shared), (each, shared * shared)]
        total, covariance = ScoreCovariance.of_looks(parts, looks, np.where(unused, 0.0, rounding))
        return np.where(unused, 0.0, 1 / total), covariance
    variance = 1 / rician_information(power, noise)
    total = variance + rounding
    score_fraction = np.sqrt(variance / total)  # fraction of the score's standard deviation that is not rounding
    # the score is a sum of terms in the noise, in its power and in its square, each with its correlation
    shares = score_components(power, noise)
    turn = np.exp(1j * np.angle(echo))
    parts = [
        (score_fraction * shares.linear * turn, shared),
        (score_fraction * shares.power, shared * shared),
        (score_fraction * shares.double * turn**2, shared * shared),
    ]
    return 1 / total, ScoreCovariance.from_parts(parts, power.shape)


def expected_sonar(sonar: Sonar) -> Sonar:
    """Return the sonar whose levels are the means of many coherent pings."""
    patterns = {"pattern": sonar.beam_pattern, "elevation_pattern": sonar.vertical_pattern}
    return sonar.replace(model="physical", quality="fine", **patterns)


def _mean_of_looks(values: Floats, looks: int) -> Floats:
    """Average values ``(bins * looks, beams)`` over the looks of each bin."""
    return values if looks == 1 else np.asarray(values.reshape(-1, looks, values.shape[1]).mean(axis=1))
