"""Synthetic aperture: how complex responses along a path become a stripmap image, by back-projection.

Each pixel adds up the responses of all phase centres whose beam contains it, at the exact delay of the path from the
transmitter via the pixel to the receiver, which moves while the sound travels, and with the phase of the carrier undone
(Hawkins, Synthetic aperture imaging algorithms, PhD thesis, University of Canterbury, 1996). The pattern of the elements is
divided out within the beam that is processed, so that the point response of an element of length D is a sinc with its first
null at D / 2 along the track, and at c / (2 B) in range.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from mitsonar.acoustics.water import delay_exact
from mitsonar.errors import MitsonarError, argument
from mitsonar.instruments.hydrophones import ChannelSonar, FieldOfView
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.records.responses import ImpulseResponses
from mitsonar.records.strips import StripGrid, StripImage

__all__ = [
    *("BackProjector", "PhaseCentres", "PointResponse", "Weighting", "along_resolution", "focus", "phase_centres"),
    *("point_response", "processed_sine", "refuse_aliased", "strip_grid"),
]

Weighting = Literal["uniform", "hann"]
"""Weights over beam and band: ``uniform`` (side lobes of -13.3 dB) or ``hann`` (-31.5 dB, 1.6 times as wide)."""

OVERSAMPLING = 16
"""Values per tap between which responses are interpolated linearly.

The droop of the interpolation is divided out; what remains are images of the spectrum, below -59 dB at the edge of the band.
"""

BLOCK_ROWS, BLOCK_COLUMNS = 64, 256
"""Pixels that are computed together: rows bound the memory, columns fit the cache."""

FARTHEST_LOBE = 0.75
"""Length in wavelengths times sine up to which the pattern of one element is undone; the beam of both ends at 0.5."""

TABLE = 4096
"""Entries of the table of weights over the sine within the beam."""


# ---------------- Geometry of the aperture


class PhaseCentres(NamedTuple):
    """Where the elements are in each ping, in the world.

    Attributes:
        sent: position of the transmitter ``(pings, 3)`` [m].
        received: position of each receiver when the sound is sent ``(pings, receivers, 3)`` [m].
        velocity: velocity of each receiver ``(pings, receivers, 3)`` [m/s].
        line: direction of the line of each receiver's field of view ``(pings, receivers, 3)``.
    """

    sent: NDArray[np.float64]
    received: NDArray[np.float64]
    velocity: NDArray[np.float64]
    line: NDArray[np.float64]

    @property
    def middle(self) -> NDArray[np.float64]:
        """Return the phase centres, halfway between transmitter and receiver ``(pings, receivers, 3)`` [m]."""
        return np.asarray((self.sent[:, None] + self.received) / 2)


def phase_centres(responses: ImpulseResponses) -> PhaseCentres:
    """Return where the elements are in each ping.

    Velocities are those of the responses, or of their path if these have none.

    Raises:
        MitsonarError: the responses have no poses.
    """
    if responses.poses is None:
        raise MitsonarError("focusing needs the pose of each ping: give responses with poses")
    poses, sonar = np.asarray(responses.poses, dtype=float), responses.sonar
    speed = velocities(Trajectory(poses, responses.time_s)) if responses.velocity is None else responses.velocity
    turn = vehicle_rotation(poses).as_matrix()
    swing = np.cross(np.array([0.0, 0.0, -1.0]) * speed[:, 3:, None], sonar.offsets[None])
    sides = np.array([one.field.axes[1] for one in sonar.receivers])
    return PhaseCentres(
        sent=poses[:, :3],
        received=poses[:, None, :3] + np.einsum("pij,rj->pri", turn, sonar.offsets),
        velocity=np.einsum("pij,prj->pri", turn, speed[:, None, :3] + swing),
        line=np.einsum("pij,rj->pri", turn, sides),
    )


def processed_sine(sonar: ChannelSonar) -> float:
    """Return the sine of the largest angle off the beam's axis that is processed.

    For an element of length D it is wavelength / (2 D), which makes the point response D / 2; other fields of view are
    processed up to their edges.
    """
    fields = [one.field for one in sonar.receivers]
    widest = max(fields, key=lambda field: field.half_across_rad)
    if widest.shape == "all":
        return 1.0
    return min(1.0, 0.5 / widest.wavelengths) if widest.shape == "line" else math.sin(widest.half_across_rad)


def along_resolution(sonar: ChannelSonar) -> float:
    """Return the distance along the track from the peak of the point response to its first null [m]."""
    return sonar.wavelength_m / (4 * processed_sine(sonar))


def _direction(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the level unit direction along a path ``(3,)``, from a straight line through its positions ``(pings, 3)``.

    Raises:
        MitsonarError: the path does not move.
    """
    level = places[:, :2] - places[:, :2].mean(axis=0)
    _, spread, rows = np.linalg.svd(level, full_matrices=False)
    if len(places) < 2 or spread[0] < 1e-6:
        raise MitsonarError("a synthetic aperture needs a path that moves: give two or more pings at different places")
    ahead = rows[0] * (1.0 if rows[0] @ (places[-1, :2] - places[0, :2]) >= 0 else -1.0)
    return np.array([ahead[0], ahead[1], 0.0])


LEEWAY = 1.1
"""Factor by which a spacing may exceed the one that the beam needs: paths are never quite even."""


def refuse_aliased(responses: ImpulseResponses) -> None:
    """Refuse phase centres that are too far apart for the beam.

    Raises:
        MitsonarError: the aperture is aliased; the message gives the spacing, speed and rate that would do.
    """
    centres, sonar = phase_centres(responses), responses.sonar
    places = np.sort((centres.middle @ _direction(centres.sent)).ravel())
    gap, most = float(np.diff(places).max(initial=0.0)), along_resolution(sonar)
    if gap <= most * LEEWAY:
        return
    count = len(sonar.receivers)
    advance = float(np.median(np.linalg.norm(np.diff(centres.sent, axis=0), axis=1)))
    seconds = float(np.median(np.diff(responses.time_s)))
    way = float(np.linalg.norm(np.diff(centres.sent, axis=0), axis=1).sum())
    pings = math.ceil(way / (most * count) - 1e-6) + 1
    do = [f"pings {most * count:.3g} m apart, {pings:,} on this path ({len(centres.sent):,} are {advance:.3g} m apart)"]
    if seconds > 0:
        do.append(f"with {1 / seconds:.3g} pings a second at most {most * count / seconds:.3g} m/s")
    do.append(f"at this spacing {math.ceil(advance / most - 1e-6):d} receivers spaced by {2 * most:.3g} m")
    raise MitsonarError(
        f"the aperture is aliased: phase centres are up to {gap:.3g} m apart along the track, and this beam needs "
        f"{most:.3g} m; give {', or '.join(do)}"
    )


def strip_grid(
    responses: ImpulseResponses,
    *,
    near_m: float | None = None,
    far_m: float | None = None,
    along_step_m: float | None = None,
    across_step_m: float | None = None,
    ground_m: float | None = None,
) -> StripGrid:
    """Return the default grid: level ground on the side that the receivers look at, where all rows see a whole aperture.

    Args:
        responses: responses with poses.
        near_m: ground range of the first column; default: where the beam has half its sensitivity, and at most
            :data:`STEEPEST_DEG` below the horizon.
        far_m: ground range of the last column; default: that of ``range_max``.
        along_step_m: spacing of rows; default: half the resolution.
        across_step_m: spacing of columns; default: half the resolution.
        ground_m: height of the ground (z) that is focused; default: the median of what lies below the pings.

    Raises:
        MitsonarError: no poses or heights; the receivers look ahead; a window beyond ``range_max``; a path shorter than an
            aperture.
    """
    centres, sonar = phase_centres(responses), responses.sonar
    ahead = _direction(centres.sent)
    heading = math.atan2(ahead[0], ahead[1])
    ground = responses.ground_m if ground_m is None else ground_m
    if ground is None:
        raise MitsonarError(f"the height of the ground is not known: give {argument('ground_m')}, its z [m]")
    height = float(np.median(centres.sent[:, 2])) - ground
    if height <= 0:
        raise MitsonarError(f"the ground must lie below the path: got z = {ground:g} m, {-height:g} m above it")
    # 1. the side of the receivers, and the window in ground range
    view = np.mean([one.field.axes[0] for one in sonar.receivers], axis=0)
    level = vehicle_rotation(np.asarray(responses.poses)[:1]).as_matrix()[0] @ view
    starboard = float(level @ np.array([ahead[1], -ahead[0], 0.0]))
    if abs(starboard) < abs(float(level @ ahead)) or abs(starboard) < 1e-6:
        raise MitsonarError(
            "the receivers must look to port or starboard of the path: the vehicle must head along it, and heading_deg of "
            "receivers be -90 or 90"
        )
    reach = sonar.range_max * 0.999
    farthest = math.sqrt(max(reach**2 - height**2, 0.0))
    far = farthest if far_m is None else far_m
    near = height * math.tan(_edge_rad(sonar.receivers[0].field)) if near_m is None else near_m
    if not 0 <= near < far <= farthest * (1 + 1e-9):
        raise MitsonarError(
            f"{argument('near_m, far_m')} must satisfy 0 <= near < far <= {farthest:.4g} m, the ground "
            f"range of range_max {sonar.range_max:g} m from {height:.3g} m up: got {near:.4g} and {far:.4g} m"
        )
    # 2. rows that see a whole aperture
    places = (centres.middle - centres.sent[0]) @ ahead
    half = math.hypot(far, height) * math.tan(math.asin(min(processed_sine(sonar), 0.999)))
    first, last = float(places.min()) + half, float(places.max()) - half
    if first >= last:
        raise MitsonarError(
            f"the path of {places.max() - places.min():.3g} m is shorter than the aperture at {far:.4g} m, which is "
            f"{2 * half:.3g} m: extend it, or focus nearer"
        )
    # 3. steps
    along = along_step_m or along_resolution(sonar) / 2
    across = across_step_m or sonar.sound_speed / (2 * sonar.bandwidth_hz) / 2
    sign = 1.0 if starboard > 0 else -1.0
    x, y, _ = centres.sent[0]
    rows, columns = (math.floor(reach_m / step) + 1 for reach_m, step in ((last - first, along), (far - near, across)))
    return StripGrid(float(x), float(y), ground, heading, first, along, rows, sign * near, sign * across, columns)


STEEPEST_DEG = 60.0
"""Largest depression angle at which the default image begins [deg]; nearer, ground range is poorly resolved."""


def _edge_rad(field: FieldOfView) -> float:
    """Return the angle from straight down at which the default image begins [rad]."""
    edge = field.tilt_deg - (1 - field.taper / 2) * field.along_deg / 2 if field.shape in ("line", "rectangular") else 0.0
    return math.radians(min(max(edge, 90 - STEEPEST_DEG), 89.0))


# ---------------- Back-projection


class BackProjector:
    """Back-projection of responses onto a grid, block by block.

    Memory holds one block of rows and the responses of one ping at a time; responses may lie on disk.

    Args:
        responses: responses with poses.
        grid: the pixels.
        weighting: weights over beam and band.
        path: corrected positions of the pings ``(pings, 3)`` [m], as of :mod:`mitsonar.mapping.micronavigation`.

    Raises:
        MitsonarError: no poses, or an aliased aperture.
    """

    def __init__(
        self,
        responses: ImpulseResponses,
        grid: StripGrid,
        weighting: Weighting = "uniform",
        path: NDArray[np.float64] | None = None,
    ) -> None:
        if weighting not in ("uniform", "hann"):
            raise MitsonarError(f"weighting must be uniform or hann: got {weighting!r}")
        refuse_aliased(responses)
        self.responses, self.grid, self.sonar = responses, grid, responses.sonar
        self.weighting = weighting
        centres = phase_centres(responses)
        shift = np.zeros_like(centres.sent) if path is None else np.asarray(path, dtype=float) - centres.sent
        self.sent = grid.local(centres.sent + shift)
        self.received = grid.local(centres.received + shift[:, None])
        self.velocity, self.line = centres.velocity @ grid.axes.T, centres.line @ grid.axes.T
        self.limit = processed_sine(self.sonar)
        sine = np.linspace(0, self.limit, TABLE)
        window = np.ones(TABLE) if weighting == "uniform" else 0.5 + 0.5 * np.cos(np.pi * sine / self.limit)
        window[-1] = 0.0  # beyond the beam
        self.window = window.astype(np.float32)
        self.inverses = [
            self._inverse(field) for field in (self.sonar.transmitter, *(one.field for one in self.sonar.receivers))
        ]

    def _inverse(self, field: FieldOfView) -> NDArray[np.float32] | None:
        """Return what undoes the pattern of a line, at sines up to twice the limit; None for other fields of view."""
        if field.shape != "line":
            return None
        sine = np.linspace(0, 2 * self.limit, 2 * TABLE)
        return (1 / np.sinc(np.minimum(field.wavelengths * sine, FARTHEST_LOBE))).astype(np.float32)

    def blocks(self, first: int = 0) -> Iterator[tuple[slice, NDArray[np.complex64]]]:
        """Focus the rows in blocks.

        Args:
            first: row at which to begin, a multiple of :data:`BLOCK_ROWS`.

        Yields:
            Rows of the grid, and their values ``(rows, columns)``.
        """
        starts = range(first, self.grid.rows, BLOCK_ROWS)
        rows = [slice(start, min(start + BLOCK_ROWS, self.grid.rows)) for start in starts]
        with ThreadPoolExecutor(2) as threads:  # a block depends on no other, and NumPy frees the interpreter
            for begin in range(0, len(rows), 2):
                pair = rows[begin : begin + 2]
                yield from zip(pair, threads.map(self.block, pair), strict=True)

    def block(self, rows: slice) -> NDArray[np.complex64]:
        """Focus some rows ``(rows, columns)``."""
        grid = self.grid
        total = np.zeros((rows.stop - rows.start, grid.columns), np.complex64)
        weight = np.zeros(total.shape, np.float32)
        for ping in self.pings_of(rows):
            taps = self.taps(ping)
            for receiver in range(len(self.sonar.receivers)):
                for part, columns in self.tiles(ping, receiver, rows):
                    echo, window = self.contribution(ping, receiver, part, columns, taps[receiver])
                    here = slice(part.start - rows.start, part.stop - rows.start), columns
                    total[here] += echo
                    weight[here] += window
        return np.asarray(total / np.where(weight > 0, weight, 1), dtype=np.complex64)

    def pings_of(self, rows: slice) -> NDArray[np.int64]:
        """Return the pings whose beam touches some rows."""
        lanes = [self._lane(receiver, slice(0, self.grid.columns)) for receiver in range(len(self.sonar.receivers))]
        first, last = np.min([lane[0] for lane in lanes], axis=0), np.max([lane[1] for lane in lanes], axis=0)
        return np.flatnonzero((first < rows.stop) & (last > rows.start))

    def tiles(self, ping: int, receiver: int, rows: slice) -> Iterator[tuple[slice, slice]]:
        """Yield the tiles of rows and columns that a beam touches."""
        for start in range(0, self.grid.columns, BLOCK_COLUMNS):
            columns = slice(start, min(start + BLOCK_COLUMNS, self.grid.columns))
            first, last = (int(edge[ping]) for edge in self._lane(receiver, columns))
            part = slice(max(first, rows.start), min(last, rows.stop))
            if part.start < part.stop:
                yield part, columns

    def _lane(self, receiver: int, columns: slice) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the first row, and the one after the last, that the beam of each ping may touch in some columns."""
        key = receiver, columns.start
        if columns.stop - columns.start <= BLOCK_COLUMNS and key in self._lanes:
            return self._lanes[key]
        grid, middle = self.grid, (self.sent + self.received[:, receiver]) / 2
        across = grid.across_m[[columns.start, columns.stop - 1]]
        reach = np.hypot(np.abs(across[None] - middle[:, :1]).max(axis=1), middle[:, 2])
        # the beam is a shell between two cones around the line; its axis may be turned off the track
        line = self.line[:, receiver]
        off = np.arctan2(np.linalg.norm(line[:, [0, 2]], axis=1), np.abs(line[:, 1]))
        half = reach * np.tan(np.minimum(math.asin(self.limit) + off, math.radians(80)))
        half += self._moved(receiver)
        low, high = ((middle[:, 1] + sign * half - grid.along_start_m) / grid.along_step_m for sign in (-1, 1))
        lane = np.floor(low).astype(np.int64), np.ceil(high).astype(np.int64) + 1
        if columns.stop - columns.start <= BLOCK_COLUMNS:
            self._lanes[key] = lane
        return lane

    @cached_property
    def _lanes(self) -> dict[tuple[int, int], tuple[NDArray[np.int64], NDArray[np.int64]]]:
        return {}

    def _moved(self, receiver: int) -> NDArray[np.float64]:
        """Return how far a receiver moves during the longest ping ``(pings,)`` [m]."""
        longest = 2 * self.sonar.range_max / self.sonar.sound_speed
        return np.asarray(np.linalg.norm(self.velocity[:, receiver], axis=1) * longest)

    def taps(self, ping: int) -> NDArray[np.complex64]:
        """Return the responses of a ping ``(receivers, OVERSAMPLING taps + 1)`` with spreading and absorption undone.

        Values are finely spaced, so that linear interpolation between them is band-limited.
        """
        sonar = self.sonar
        response = np.asarray(self.responses.response[ping], np.complex64)
        count, fine = sonar.taps, sonar.taps * OVERSAMPLING
        spectrum = scipy.fft.fft(response, axis=1)
        number = np.asarray(np.fft.fftfreq(count, 1 / count), dtype=np.float64)
        droop = np.sinc(number / fine) ** 2  # of the linear interpolation
        spectrum *= (OVERSAMPLING / droop * self._band(number * sonar.frequency_step_hz)).astype(np.float32)
        wide = np.zeros((len(response), fine), np.complex64)
        half = (count + 1) // 2
        wide[:, :half], wide[:, fine - (count - half) :] = spectrum[:, :half], spectrum[:, half:]
        taps = np.zeros((len(response), fine + 1), np.complex64)
        taps[:, :fine] = scipy.fft.ifft(wide, axis=1, overwrite_x=True)
        return np.asarray(taps * self._gain)

    def _band(self, frequency: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the weights over the band, which leave the peak of the pulse as it is."""
        if self.weighting == "uniform":
            return np.ones(len(frequency))
        share = frequency / ((1 + self.sonar.rolloff) * self.sonar.bandwidth_hz)
        weight = np.where(np.abs(share) <= 0.5, 0.5 + 0.5 * np.cos(2 * np.pi * share), 0.0)
        pulse = self.sonar.raised_cosine(frequency)
        return np.asarray(weight * pulse.sum() / (weight * pulse).sum())

    @cached_property
    def _gain(self) -> NDArray[np.float32]:
        """Return what undoes spreading and absorption at each fine delay, over the peak of the pulse; 0 beyond range_max."""
        sonar = self.sonar
        delay = np.arange(sonar.taps * OVERSAMPLING + 1) / (sonar.sampling_hz * OVERSAMPLING)
        gain = np.full(len(delay), sonar.sampling_hz / sonar.bandwidth_hz)
        path = delay * sonar.sound_speed
        if sonar.spreads:
            gain *= (path / 2) ** 2
        gain *= 10 ** (sonar.absorption_db_per_m * path / 20)
        gain[path > 2 * sonar.range_max * (1 + 1e-3)] = 0
        gain[-1] = 0
        return gain.astype(np.float32)

    def contribution(
        self, ping: int, receiver: int, rows: slice, columns: slice, taps: NDArray[np.complex64]
    ) -> tuple[NDArray[np.complex64], NDArray[np.float32]]:
        """Return the weighted echo of one phase centre at some pixels, and its weight ``(rows, columns)``."""
        sonar, grid = self.sonar, self.grid
        # 1. from both ends to the pixels: to starboard a row vector, along a column vector, up a number
        pixel = (grid.across_m[None, columns], grid.along_m[rows, None], np.zeros((1, 1)))
        sent, received = self.sent[ping], self.received[ping, receiver]
        to_point = [p - a for p, a in zip(pixel, sent, strict=True)]
        from_receiver = [p - b for p, b in zip(pixel, received, strict=True)]
        delay = delay_exact(to_point, from_receiver, self.velocity[ping, receiver].tolist(), sonar.sound_speed)
        # 2. weight by the angle off the beam's axis, seen from the phase centre
        line = self.line[ping, receiver]
        scale = (TABLE - 1) / (self.limit * sonar.sound_speed / 2) / delay
        index = [sum(float(a) * p for a, p in zip(line, way, strict=True)) * scale for way in (to_point, from_receiver)]
        weight = self.window[np.minimum(np.abs(index[0] + index[1]) / 2, TABLE - 1).astype(np.int32)]
        gain = weight.copy()
        for place, inverse in zip(index, (self.inverses[0], self.inverses[1 + receiver]), strict=True):
            if inverse is not None:  # each end sees the pixel at an angle of its own
                gain *= inverse[np.minimum(np.abs(place), 2 * TABLE - 1).astype(np.int32)]
        # 3. the response at the delay, between two fine taps
        place = delay * (sonar.sampling_hz * OVERSAMPLING)
        place = np.minimum(place, len(taps) - 2)
        tap = place.astype(np.int32)
        part = (place - tap).astype(np.float32)
        near = taps[tap]
        echo = near + part * (taps[tap + 1] - near)
        # 4. the phase of the carrier, in turns of double precision
        turns = delay * sonar.carrier_hz
        angle = ((turns - np.rint(turns)) * (2 * math.pi)).astype(np.float32)
        phasor = np.empty(angle.shape, np.complex64)
        phasor.real, phasor.imag = np.cos(angle), np.sin(angle)
        return echo * phasor * gain, weight


def focus(
    responses: ImpulseResponses,
    grid: StripGrid | None = None,
    *,
    weighting: Weighting = "uniform",
    path: NDArray[np.float64] | None = None,
    progress: Callable[[int], None] = lambda rows: None,
) -> StripImage:
    """Focus responses to a stripmap image.

    Args:
        responses: responses with poses, of one side.
        grid: the pixels; default: :func:`strip_grid`.
        weighting: weights over beam and band.
        path: corrected positions of the pings ``(pings, 3)`` [m].
        progress: called with the number of new rows.

    Raises:
        MitsonarError: no poses, an aliased aperture, or no default grid.
    """
    grid = strip_grid(responses) if grid is None else grid
    value = np.zeros((grid.rows, grid.columns), np.complex64)
    for rows, block in BackProjector(responses, grid, weighting, path).blocks():
        value[rows] = block
        progress(len(block))
    return StripImage(value, grid)


# ---------------- Point response


@dataclass(frozen=True)
class PointResponse:
    """Point response in one direction.

    Attributes:
        width_m: width at half power [m]; 0.886 of the distance to the first null of a sinc.
        side_lobe_db: largest side lobe relative to the peak [dB].
        peak: value at the peak, complex.
    """

    width_m: float
    side_lobe_db: float
    peak: complex


def point_response(values: NDArray[np.complexfloating], step_m: float) -> PointResponse:
    """Measure a cut through the response of one point.

    Args:
        values: complex cut through the peak ``(n,)``, with side lobes on both sides, spaced by less than the resolution.
        step_m: spacing of the values.

    Raises:
        MitsonarError: the cut does not fall to half power, and rise again, on both sides.
    """
    fine = 64
    # the cut is band-limited around a mean frequency, which a spectrum that is centred on its energy does not split
    spectrum = np.fft.fft(values)
    power = np.abs(spectrum) ** 2
    turn = np.exp(2j * np.pi * np.arange(len(values)) / len(values))
    centre = round(float(np.angle((power * turn).sum())) / (2 * np.pi) * len(values))
    spectrum = np.fft.fftshift(np.roll(spectrum, -centre))
    pad = (fine - 1) * len(values)
    wide = np.fft.ifft(np.fft.ifftshift(np.pad(spectrum, (pad // 2, pad - pad // 2)))) * fine
    size = np.abs(wide)
    peak = int(size.argmax())
    edges, minima = [], []
    for direction in (-1, 1):
        side = size[peak::direction]
        below = np.flatnonzero(side < size[peak] * math.sqrt(0.5))
        rising = np.flatnonzero(np.diff(side) > 0)
        if not below.size or not rising.size:
            raise MitsonarError("the cut must reach beyond the main lobe on both sides of the peak: give a longer one")
        k = int(below[0])
        before, after = side[k - 1], side[k]
        edges.append(k - 1 + (before - size[peak] * math.sqrt(0.5)) / (before - after))
        minima.append(side[int(rising[0]) :].max())
    return PointResponse(
        float(sum(edges)) * step_m / fine,
        20 * math.log10(max(minima) / size[peak]),
        complex(wide[peak] * np.exp(2j * np.pi * centre * peak / (fine * len(values)))),
    )
