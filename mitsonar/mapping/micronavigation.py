"""Micronavigation: how the path of a synthetic aperture is corrected from its responses.

Displaced phase centres: consecutive pings overlap, so that receivers of the first and others of the second have the same
phase centres. Their responses differ by the motion that the navigation misses, whose phase is measured with a known bound
(Bellettini and Pinto, Theoretical accuracy of synthetic aperture sonar micronavigation using a displaced phase-center
antenna, IEEE J. Oceanic Eng. 27 (2002), 780-789). Autofocus: the sway that makes an image sharpest (Fienup and Miller,
Aberration correction by maximizing generalized sharpness metrics, J. Opt. Soc. Am. A 20 (2003), 609-620).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.optimize import minimize

from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.mapping.synthetic_aperture import BackProjector, PhaseCentres, phase_centres, strip_grid
from mitsonar.records.responses import ImpulseResponses
from mitsonar.records.strips import StripGrid

__all__ = ["MicroNavigation", "autofocus", "displaced_phase_centres", "sway_bound"]


SEGMENTS = 8
"""Parts of the range window whose phases are measured one by one, since the sway shows less at steep angles."""

LEAST_COHERENCE = 0.3
"""Coherence below which a pair of pings is not used: its phase may be off by a turn."""


# ---------------- Displaced phase centres


@dataclass(frozen=True)
class MicroNavigation:
    """Motion between consecutive pings beyond that of the navigation.

    Attributes:
        sway_m: displacement towards the side that the receivers look at ``(pings - 1,)`` [m]; nan if it is not valid.
        sway_std_m: Cramer-Rao bound of the sway ``(pings - 1,)`` [m].
        advance_m: displacement along the track, from the coherence of neighbouring pairs ``(pings - 1,)`` [m].
        coherence: of the overlapping phase centres ``(pings - 1,)``, 0..1.
        path: corrected positions of the pings ``(pings, 3)`` [m]: those of the navigation, and the sum of the sways without
            its mean and trend, which a synthetic aperture does not sense. A sway that is not valid counts as 0.
    """

    sway_m: NDArray[np.float64]
    sway_std_m: NDArray[np.float64]
    advance_m: NDArray[np.float64]
    coherence: NDArray[np.float64]
    path: NDArray[np.float64]

    @property
    def unused(self) -> int:
        """Return the number of pairs whose sway is not valid."""
        return int(np.isnan(self.sway_m).sum())


def sway_bound(coherence: float, samples: float, wavelength_m: float, cosine: float = 1.0) -> float:
    """Return the Cramer-Rao bound of the sway between two pings [m].

    The phase between two jointly Gaussian signals of coherence g has the bound sqrt((1 - g^2) / (2 n g^2)) for n independent
    samples, and a sway s changes it by 4 pi s cos / wavelength.

    Args:
        coherence: g, 0..1.
        samples: n, bandwidth times duration of the window times the number of pairs of receivers.
        wavelength_m: of the carrier.
        cosine: horizontal part of the direction of the echoes.
    """
    phase = math.sqrt(max(1 - coherence**2, 0.0) / (2 * samples * coherence**2)) if coherence > 0 else math.inf
    return phase * wavelength_m / (4 * math.pi * cosine)


class _Window(NamedTuple):
    """Taps that are compared: their slice, and the horizontal and vertical part of the direction of their echoes."""

    taps: slice
    level: NDArray[np.float64]
    down: NDArray[np.float64]


def displaced_phase_centres(responses: ImpulseResponses, *, near_m: float | None = None) -> MicroNavigation:
    """Estimate the sway between consecutive pings from overlapping phase centres.

    Heading and depth are those of the navigation, on level ground.

    Args:
        responses: responses of a row of evenly spaced receivers; ``poses`` are those of the navigation.
        near_m: slant range at which the compared window begins; default: 1.5 times the height.

    Raises:
        MitsonarError: no poses or heights; fewer than three receivers, or uneven ones; no overlap between pings; no pair of
            pings that is coherent enough.
    """
    sonar, centres = responses.sonar, phase_centres(responses)
    spacing = _spacing(sonar)
    window = _window(responses, near_m)
    line = centres.line.mean(axis=(0, 1))
    line /= np.linalg.norm(line)
    side = _looking_side(responses, line)
    results = [_between(responses, centres, pair, window, spacing, side) for pair in range(len(responses) - 1)]
    phase, std, advance, coherence = (np.array(column) for column in zip(*results, strict=True))
    if not np.isfinite(phase).any():
        raise MitsonarError(
            f"no pair of pings is as coherent as displaced phase centres need, {LEAST_COHERENCE:g}: the best of "
            f"{len(phase)} has {coherence.max():.2g}; correct the path with autofocus alone, raise the level of the echoes "
            "over the noise, or give a navigation that is closer to the path"
        )
    sway = _without_drift(phase, responses.time_s, float(sonar.delay_s[window.taps].mean()))
    total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(sway))])
    number = np.arange(len(total))
    total -= np.polynomial.polynomial.Polynomial.fit(number, total, 1)(number)
    return MicroNavigation(sway, std, advance, coherence, centres.sent + total[:, None] * side)


def _without_drift(phase_m: NDArray[np.float64], time_s: NDArray[np.float64], delay_s: float) -> NDArray[np.float64]:
    """Return the sway of the transmitter ``(pings - 1,)`` [m], given that of the phase centres; nan where it is not valid.

    The receiver moves on at the velocity of the sway while the sound travels, so a phase centre is ahead of the transmitter
    by half of that, and the displacements between phase centres hold the differences of velocity.
    """
    known = np.isfinite(phase_m)
    ahead = delay_s / 2 / np.maximum(np.diff(time_s), delay_s)
    system = np.diag(1 - ahead) + np.diag(ahead[1:], 1)
    system[-1, -1] = 1.0  # the last ping has the velocity of the step before it
    return np.where(known, np.linalg.solve(system, np.where(known, phase_m, 0.0)), np.nan)


def _spacing(sonar: ChannelSonar) -> float:
    """Return the distance between neighbouring receivers along the track [m].

    Raises:
        MitsonarError: fewer than three receivers, or not an even row ahead.
    """
    offsets = sonar.offsets
    steps = np.diff(offsets, axis=0)
    if len(offsets) < 3 or np.ptp(steps, axis=0).max() > 1e-6 or np.abs(steps[:, [0, 2]]).max() > 1e-6 or steps[0, 1] <= 0:
        raise MitsonarError(
            "displaced phase centres need three or more receivers in an even row along the track, the last one ahead: got "
            f"{len(offsets)} at {offsets.round(4).tolist()[:4]}"
        )
    return float(steps[0, 1])


def _window(responses: ImpulseResponses, near_m: float | None) -> _Window:
    """Return the window of slant ranges that is compared, from level ground.

    Raises:
        MitsonarError: no height, or a window without taps.
    """
    sonar = responses.sonar
    grid = _height_m(responses)
    near = 1.5 * grid if near_m is None else near_m
    slant = sonar.delay_s * sonar.sound_speed / 2
    first, last = np.searchsorted(slant, (max(near, 1.05 * grid), 0.98 * sonar.range_max))
    if last - first < 8 * SEGMENTS:
        raise MitsonarError(
            f"the window from {near:.3g} m to range_max {sonar.range_max:g} m has {max(last - first, 0)} taps, fewer than "
            f"{8 * SEGMENTS}: begin it nearer, or raise range_max"
        )
    taps = slice(int(first), int(last))
    down = np.minimum(grid / slant[taps], 0.999)
    return _Window(taps, np.sqrt(1 - down**2), down)


def _height_m(responses: ImpulseResponses) -> float:
    """Return the median height over the ground [m].

    Raises:
        MitsonarError: it is not known.
    """
    ground = responses.ground_m
    height = math.nan if ground is None else float(np.median(np.asarray(responses.poses)[:, 2])) - ground
    if not height > 0:
        raise MitsonarError("micronavigation needs the height over the ground: give responses with height_m above 0")
    return height


def _looking_side(responses: ImpulseResponses, line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the level unit direction across the line towards what the receivers see ``(3,)``."""
    across = np.cross(line, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    starboard = responses.sonar.receivers[0].field.axes[0][0]
    # the line points to port of the beam for receivers that look to starboard: compare with the track
    places = np.asarray(responses.poses)[:, :3]
    ahead = places[-1] - places[0]
    to_starboard = np.cross(ahead, [0.0, 0.0, 1.0])
    sign = np.sign(across @ to_starboard) * np.sign(starboard)
    return np.asarray(across * (sign or 1.0))


def _between(
    responses: ImpulseResponses,
    centres: PhaseCentres,
    pair: int,
    window: _Window,
    spacing: float,
    side: NDArray[np.float64],
) -> tuple[float, float, float, float]:
    """Return sway, its bound, advance and coherence of one pair of pings."""
    sonar = responses.sonar
    count = len(sonar.receivers)
    ahead = np.cross([0.0, 0.0, 1.0], side)
    ahead *= 1.0 if ahead @ (centres.sent[pair + 1] - centres.sent[pair]) > 0 else -1.0
    nominal = float((centres.sent[pair + 1] - centres.sent[pair]) @ ahead)
    shift = round(2 * nominal / spacing)
    if not 1 <= shift <= count - 2:
        raise MitsonarError(
            f"pings {pair} and {pair + 1} are {nominal:.3g} m apart, and {count} receivers {spacing:.3g} m apart overlap by "
            f"two or more only up to {(count - 2) * spacing / 2:.3g} m: fly more slowly, or send pings more often"
        )
    signals = [_monostatic(responses, centres, ping, window) for ping in (pair, pair + 1)]
    # 1. coherence for the nominal shift and its neighbours; its maximum gives the advance
    tried = [shift + k for k in (-1, 0, 1) if 1 <= shift + k <= count - 1]
    matches = {m: _match(sonar, centres, pair, signals, m, window, side) for m in tried}
    best = max(matches, key=lambda m: matches[m].coherence)
    advance = _vertex([(m, matches[m].coherence) for m in tried], best) * spacing / 2
    match = matches[best]
    if match.coherence < LEAST_COHERENCE:
        return math.nan, math.nan, advance, match.coherence
    return match.sway_m, match.std_m, advance, match.coherence


class _Match(NamedTuple):
    """Coherence of overlapping phase centres, the sway between them and its bound [m]."""

    coherence: float
    sway_m: float
    std_m: float


def _monostatic(responses: ImpulseResponses, centres: PhaseCentres, ping: int, window: _Window) -> NDArray[np.complex128]:
    """Return the responses of a ping as if transmitter and receiver were at the phase centre ``(receivers, taps)``.

    A receiver at a distance y ahead of the transmitter when the echo arrives has a path longer by y^2 / (4 r).
    """
    sonar = responses.sonar
    delay = sonar.delay_s[window.taps]
    ahead = centres.line[ping] / np.linalg.norm(centres.line[ping], axis=1)[:, None]
    apart = np.einsum("ri,ri->r", centres.received[ping] - centres.sent[ping], ahead)
    moving = np.einsum("ri,ri->r", centres.velocity[ping], ahead)
    excess = (apart[:, None] + moving[:, None] * delay) ** 2 / (2 * sonar.sound_speed * delay)
    response = np.asarray(responses.response[ping], np.complex128)[:, window.taps]
    return np.asarray(response * np.exp(2j * np.pi * excess / sonar.wavelength_m))


def _match(
    sonar: ChannelSonar,
    centres: PhaseCentres,
    pair: int,
    signals: list[NDArray[np.complex128]],
    shift: int,
    window: _Window,
    side: NDArray[np.float64],
) -> _Match:
    """Compare the receivers of one ping with those of the next that are ``shift`` places behind."""
    first, second = signals[0][shift:], signals[1][: len(signals[1]) - shift]
    # 1. undo the displacement that the navigation knows, in phase
    known = centres.middle[pair + 1, : len(second)] - centres.middle[pair, shift:]
    path = -2 * (known @ side)[:, None] * window.level + 2 * known[:, 2:] * window.down
    first = first * np.exp(-2j * np.pi * path / sonar.wavelength_m)
    # 2. whole turns from the delay between the envelopes, over all receivers and the whole window
    spectra = [scipy.fft.fft(one, axis=1) for one in (first, second)]
    cross = (spectra[0] * spectra[1].conj()).sum(axis=0)
    delay = _delay(cross, sonar.sampling_hz, sonar.bandwidth_hz)
    coherence = abs(_turned(cross, sonar.sampling_hz, delay).sum())
    coherence /= math.sqrt(float(np.prod([np.square(np.abs(one)).sum() for one in spectra]))) or 1.0
    rest = float(np.angle(_turned(cross, sonar.sampling_hz, delay).sum())) / (2 * math.pi)
    turns = rest + round(delay * sonar.carrier_hz - rest)
    level = float(np.mean(window.level))
    sway = -turns * sonar.wavelength_m / (2 * level)
    # 3. the small remainder in each segment, weighted by how much a sway shows there
    frequency = scipy.fft.fftfreq(first.shape[1], 1 / sonar.sampling_hz)
    aligned = scipy.fft.ifft(spectra[0] * np.exp(-2j * np.pi * frequency * delay), axis=1)
    product = (aligned * second.conj()).sum(axis=0) * np.exp(4j * np.pi * sway * window.level / sonar.wavelength_m)
    sums, one, other, levels = (
        np.array([part.mean() for part in np.array_split(values, SEGMENTS)])
        for values in (product, _power(aligned), _power(second), window.level)
    )
    # the information of each segment, from its coherence and its independent samples
    samples = sonar.bandwidth_hz / sonar.sampling_hz * len(product) / SEGMENTS * len(second)
    coherences = np.minimum(np.abs(sums) / np.sqrt(np.maximum(one * other, 1e-300)), 1 - 1e-9)
    bounds = np.array([sway_bound(g, samples, sonar.wavelength_m, c) for g, c in zip(coherences, levels, strict=True)])
    each = np.angle(sums) * -sonar.wavelength_m / (4 * math.pi * levels)
    information = bounds**-2.0
    sway += float((information * each).sum() / information.sum())
    return _Match(float(min(coherence, 1.0)), sway, float(information.sum() ** -0.5))


def _power(signals: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return the power of signals ``(n, taps)``, summed over the first axis."""
    return np.asarray(np.square(np.abs(signals)).sum(axis=0))


def _turned(cross: NDArray[np.complex128], sampling_hz: float, delay: float) -> NDArray[np.complex128]:
    """Return a cross-spectrum without a delay [s]."""
    return np.asarray(cross * np.exp(-2j * np.pi * scipy.fft.fftfreq(len(cross), 1 / sampling_hz) * delay))


def _delay(cross: NDArray[np.complex128], sampling_hz: float, bandwidth_hz: float) -> float:
    """Return the delay between envelopes [s], within two resolutions, from the peak of the correlation."""
    tried = np.arange(-64, 65) / (32 * bandwidth_hz)
    size = np.array([abs(_turned(cross, sampling_hz, delay).sum()) for delay in tried])
    best = int(size[1:-1].argmax()) + 1
    below, peak, above = size[best - 1 : best + 2]
    bend = below - 2 * peak + above
    return float(tried[best] + (0.5 * (below - above) / bend if bend < 0 else 0.0) * (tried[1] - tried[0]))


def _vertex(values: list[tuple[int, float]], best: int) -> float:
    """Return where a bell through up to three coherences peaks."""
    known = dict(values)
    if best - 1 not in known or best + 1 not in known:
        return float(best)
    low, mid, high = (math.log(max(known[best + k], 1e-6)) for k in (-1, 0, 1))
    bend = low - 2 * mid + high
    return best + (0.5 * (low - high) / bend if bend < 0 else 0.0)


# ---------------- Autofocus


LARGEST_SWAY = 0.5
"""Sway in wavelengths beyond which autofocus is held back, by a cost that grows with the fourth power.

Larger sways let it pile up speckle to points that are sharper than the scene.
"""

MOST_STORED = 2**26
"""Complex numbers of a patch that autofocus keeps in memory: 512 MB."""


def autofocus(
    responses: ImpulseResponses,
    grid: StripGrid | None = None,
    *,
    path: NDArray[np.float64] | None = None,
    columns: int = 192,
    detail_m: float | None = None,
    rounds: int = 2,
    progress: Callable[[int], None] = lambda rounds: None,
) -> NDArray[np.float64]:
    """Return the positions of the pings ``(pings, 3)`` that make an image sharpest.

    The sway is a spline along the track, without mean and trend. The sum of the fourth powers of the sharpest patch of the
    image is maximised, coarse to fine. A sway beyond half a wavelength costs more than it gains.

    Args:
        responses: responses with poses.
        grid: the pixels; default: :func:`~mitsonar.mapping.synthetic_aperture.strip_grid`.
        path: positions at which to begin ``(pings, 3)`` [m]; default: those of the responses.
        columns: number of columns of the patch.
        detail_m: distance between knots of the sway; default: a quarter of an aperture, and at least four pings.
        rounds: how often the patch is focused anew along the improved path.
        progress: called with 1 after each round.

    Raises:
        MitsonarError: a patch that is too large for memory, or as in
            :class:`~mitsonar.mapping.synthetic_aperture.BackProjector`.
    """
    grid = strip_grid(responses) if grid is None else grid
    centres = phase_centres(responses)
    places = centres.sent if path is None else np.asarray(path, dtype=float)
    patch = _sharpest(responses, grid, columns, places)
    start, height, side = places, float(np.median(places[:, 2])), grid.axes[0] * np.sign(grid.across_step_m)
    for _ in range(max(rounds, 1)):
        contributions = _contributions(BackProjector(responses, patch, path=places), patch)
        along = grid.local(places)[:, 1]
        for basis in _bases(along, detail_m or _detail(patch, along, contributions)):
            before = (places - start) @ side
            sway, contributions = _sharpen(contributions, basis, patch, before, height, responses.sonar)
            places = places + sway[:, None] * side
        progress(1)
    return places


class _Contribution(NamedTuple):
    """What a ping adds to the rows of a patch that it sees ``(rows, columns)``."""

    rows: slice
    value: NDArray[np.complex64]


def _sharpest(responses: ImpulseResponses, grid: StripGrid, columns: int, places: NDArray[np.float64]) -> StripGrid:
    """Return the columns of a grid in which the intensity varies most."""
    if grid.columns <= columns:
        return grid
    projector = BackProjector(responses, grid, path=places)
    strips = [
        projector.block(slice(first, min(first + 16, grid.rows))) for first in range(0, grid.rows, max(grid.rows // 8, 16))
    ]
    power = np.square(np.abs(np.concatenate(strips))).astype(float)
    mean = power.mean(axis=0)
    contrast = (power**2).mean(axis=0) / np.where(mean > 0, mean, np.inf) ** 2
    score = np.convolve(contrast, np.ones(columns), mode="valid")
    first = int(score.argmax())
    return replace(grid, across_start_m=grid.across_start_m + first * grid.across_step_m, columns=columns)


def _contributions(projector: BackProjector, patch: StripGrid) -> list[_Contribution]:
    """Back-project each ping by itself.

    Raises:
        MitsonarError: they do not fit the memory.
    """
    parts, stored = [], 0
    every = slice(0, patch.rows)
    for ping in range(len(projector.sent)):
        taps = projector.taps(ping)
        tiles = [
            (receiver, rows, columns)
            for receiver in range(len(projector.sonar.receivers))
            for rows, columns in projector.tiles(ping, receiver, every)
        ]
        first = min((rows.start for _, rows, _ in tiles), default=0)
        last = max((rows.stop for _, rows, _ in tiles), default=0)
        stored += (last - first) * patch.columns
        if stored > MOST_STORED:
            raise MitsonarError(
                f"the patch of autofocus takes more than {MOST_STORED:,} numbers: give fewer columns, or a shorter strip"
            )
        value = np.zeros((last - first, patch.columns), np.complex64)
        for receiver, rows, columns in tiles:
            echo, _ = projector.contribution(ping, receiver, rows, columns, taps[receiver])
            value[rows.start - first : rows.stop - first, columns] += echo
        parts.append(_Contribution(slice(first, last), value))
    return parts


def _detail(patch: StripGrid, along: NDArray[np.float64], contributions: list[_Contribution]) -> float:
    """Return the default distance between knots: a quarter of the aperture, and at least four pings [m]."""
    seen = [part.rows.stop - part.rows.start for part in contributions]
    aperture = float(np.median(seen)) * patch.along_step_m
    return max(aperture / 4, 4 * float(np.ptp(along)) / max(len(along) - 1, 1))


def _bases(along: NDArray[np.float64], detail_m: float) -> list[NDArray[np.float64]]:
    """Return bases of the sway ``(pings, n)``, coarse to fine, orthonormal, without mean and trend."""
    bases, length = [], float(np.ptp(along))
    trend = np.linalg.qr(np.column_stack([np.ones(len(along)), along - along.mean()]))[0]
    for factor in (4, 2, 1):
        pieces = max(2, round(length / (factor * detail_m)))
        knots = np.concatenate([np.full(3, along.min()), np.linspace(along.min(), along.max() + 1e-9, pieces + 1)])
        knots = np.concatenate([knots, np.full(3, knots[-1])])
        spline = BSpline.design_matrix(along, knots, 3).toarray()
        spline -= trend @ (trend.T @ spline)
        left, size, _ = np.linalg.svd(spline, full_matrices=False)
        bases.append(left[:, size > 1e-6 * size[0]])
    return bases


def _sharpen(
    contributions: list[_Contribution],
    basis: NDArray[np.float64],
    patch: StripGrid,
    before: NDArray[np.float64],
    height: float,
    sonar: ChannelSonar,
) -> tuple[NDArray[np.float64], list[_Contribution]]:
    """Return the sway of each ping towards the scene [m] that makes the patch sharpest, and the turned contributions."""
    across = np.abs(patch.across_m)
    rate = (4 * np.pi / sonar.wavelength_m * across / np.hypot(across, height - patch.z)).astype(np.float32)

    def turned(sway: float, part: _Contribution) -> NDArray[np.complex64]:
        return np.asarray(part.value * np.exp(np.complex64(-1j) * rate * np.float32(sway)), dtype=np.complex64)

    def loss(coefficients: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        sways = basis @ coefficients * sonar.wavelength_m
        image = np.zeros((patch.rows, patch.columns), np.complex64)
        for sway, part in zip(sways, contributions, strict=True):
            image[part.rows] += turned(float(sway), part)
        power = np.square(np.abs(image)).astype(float)
        energy, sharp = power.sum(), np.square(power).sum()
        # of log(sharp / energy^2), by the conjugate of the image
        inner = ((power / sharp - 1 / energy) * 4).astype(np.float32) * image.conj()
        slope = np.array(
            [
                float((inner[part.rows] * turned(float(sway), part) * (np.complex64(-1j) * rate)).sum().real)
                for sway, part in zip(sways, contributions, strict=True)
            ]
        )
        share = (before + sways) / (LARGEST_SWAY * sonar.wavelength_m)
        cost, rise = float(np.mean(share**4)), 4 * share**3 / (len(share) * LARGEST_SWAY * sonar.wavelength_m)
        return cost - float(np.log(sharp / energy**2)), ((rise - slope) @ basis) * sonar.wavelength_m

    start = np.zeros(basis.shape[1])
    fit = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": 40})
    sways = basis @ fit.x * sonar.wavelength_m
    return sways, [
        _Contribution(part.rows, turned(float(sway), part)) for sway, part in zip(sways, contributions, strict=True)
    ]
