"""How do the pings of a scanning sonar become frames? A frame is a sweep of the head: from turn to turn, or once round.

Frames of a simulated scanning sonar are of the same kind (:func:`mitsonar.instruments.sonar.scanned`): beams are the steps
of the head from port to starboard, and each beam has its time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, count_noun
from mitsonar.recordings.recording import Part, Pixels, in_time_order, runs_of
from mitsonar.records.frames import SonarFrames

__all__ = ["ScanPings", "Sweep", "sweep_parts"]


Array = NDArray[np.float64]
Index = NDArray[np.intp]

ANGLE_UNIT_RAD = math.pi / 20_000
"""Resolution of bearings [rad], a hundredth of a gradian: angles that differ by less than half of it are one step."""

FULL_TURN = 40_000
"""Angle of a full turn in these units."""

MAX_TURN_STEPS = 3
"""Largest angle from the ping at a turn to the next, in steps, at which the ping belongs to both sweeps."""

MIN_SHARE = 0.1
"""Share of the steps of its part that a sweep must cover to become a frame."""

FEW_PINGS = 4
"""Number of pings below which a sweep does not determine the step of the head."""

DEFAULT_INTERVAL_S = 0.05
"""Time between pings if their times do not differ [s]."""


@dataclass(frozen=True)
class ScanPings:
    """The pings of a scanning sonar in the order of its recording.

    Attributes:
        time_s: times of the pings ``(pings,)`` [s].
        bearing_rad: bearings of the head ``(pings,)`` [rad], starboard positive, of any turn.
        windows: range window and carrier of each ping; pings with equal ones may share a frame.
        samples: function that reads the pings with the given indices ``(n,)`` as uint8 ``(n, bins)``; they share a window.
    """

    time_s: Array
    bearing_rad: Array
    windows: Sequence[Hashable]
    samples: Callable[[Index], NDArray[np.uint8]]


LikeFrames: TypeAlias = Callable[[int, Array, float], SonarFrames]
"""Function that returns empty frames, given the index of a ping, the bearings ``(beams,)`` and the interval of pings [s]."""


@dataclass(frozen=True)
class Sweep:
    """Function that reads the frames of a part.

    Attributes:
        pings: all pings.
        ping_of: index of the ping of each beam ``(frames, beams)``; -1 for a beam that was not scanned.
        bins: number of range bins.
    """

    pings: ScanPings
    ping_of: Index
    bins: int

    def __call__(self, index: Index) -> Pixels:
        """Return images ``(n, bins, beams)`` uint8, column 0 farthest to port; 0 where the head did not scan."""
        images = np.zeros((len(index), self.bins, self.ping_of.shape[1]), np.uint8)
        for image, row in zip(images, self.ping_of[index], strict=True):
            scanned = row >= 0
            image[:, scanned] = self.pings.samples(row[scanned]).T
        return images


def sweep_parts(pings: ScanPings, like: LikeFrames) -> tuple[tuple[Part, ...], list[str]]:
    """Group the pings of a scanning sonar into sweeps, and sweeps of one window and step into parts.

    A sweep ends where the head turns back, where it passes the rear, or where the window changes. The ping of a turn belongs
    to both sweeps. The beams of a part are all angles that its sweeps contain. A beam that a sweep lacks is 0, and has the
    time of its neighbours; frames have the mean time of their beams.

    Args:
        pings: pings of one head.
        like: function that describes the frames of a part.

    Returns:
        The parts in order of time, and sentences on what was left out or is incomplete.

    Raises:
        MitsonarError: if the head points to fewer than two angles.
    """
    # 1. Angles as whole numbers, in order of time, without single pings of another window, which some heads send.
    order = np.argsort(pings.time_s, kind="stable")
    notes = ["pings are not in order of time: they were sorted"] if (np.diff(order) < 0).any() else []
    single = _is_single(pings.windows, order)
    if single.any():
        notes.append(f"left out: {count_noun(int(single.sum()), 'ping')} with another window than the pings around")
        order = order[~single]
    angle = np.rint(pings.bearing_rad / ANGLE_UNIT_RAD).astype(np.int64)
    angle = (angle + FULL_TURN // 2) % FULL_TURN - FULL_TURN // 2  # the rear is -180 deg
    if len(np.unique(angle)) < 2:
        raise MitsonarError("the head of the scanning sonar points to a single angle: an image needs two or more")
    sweeps = _split(angle, pings.windows, order)
    # 2. Runs of sweeps with one window and one step of the head.
    steps = _steps(angle, sweeps)
    keys = [(pings.windows[sweep[0]], step) for sweep, step in zip(sweeps, steps, strict=True)]
    parts, short, gaps = [], 0, 0
    for _, run in runs_of(keys):
        chosen = [sweeps[number] for number in run]
        every_angle = np.unique(np.concatenate([angle[sweep] for sweep in chosen]))
        long = [sweep for sweep in chosen if len(sweep) >= max(2, MIN_SHARE * len(every_angle))]
        short += sum(map(len, chosen)) - sum(map(len, long))
        if long:
            part = _part(pings, angle, long, like)
            parts.append(part)
            gaps += int((part.images.ping_of < 0).any(axis=1).sum())  # type: ignore[attr-defined]
    # 3. What users should know.
    if short:
        notes.append(f"left out: {count_noun(short, 'ping')} of sweeps that cover less than {MIN_SHARE:.0%} of the steps")
    if gaps:
        frames = sum(map(len, parts))
        notes.append(f"{gaps:,} of {count_noun(frames, 'sweep')} are incomplete: beams that were not scanned are 0")
    return tuple(parts), notes


def _is_single(windows: Sequence[Hashable], order: Index) -> NDArray[np.bool_]:
    """Return which pings have another window than the two pings before and after, which share theirs."""
    numbers: dict[Hashable, int] = {}
    window = np.array([numbers.setdefault(windows[place], len(numbers)) for place in order])
    single = np.zeros(len(order), bool)
    single[1:-1] = (window[:-2] == window[2:]) & (window[1:-1] != window[:-2])
    return np.asarray(single & ~np.concatenate([[False], single[:-1]]), dtype=np.bool_)


def _split(angle: NDArray[np.int64], windows: Sequence[Hashable], order: Index) -> list[Index]:
    """Return the indices of the pings of each sweep, in order of time."""
    raw = np.diff(angle[order])
    turned = (raw + FULL_TURN // 2) % FULL_TURN - FULL_TURN // 2  # the shorter way round
    moves = np.abs(turned[turned != 0])
    limit = MAX_TURN_STEPS * float(np.median(moves)) if len(moves) else 0.0
    sweeps, first, direction = [], 0, 0
    for place, (step, plain) in enumerate(zip(turned.tolist(), raw.tolist(), strict=True)):
        sign = (step > 0) - (step < 0)
        same_window = windows[order[place]] == windows[order[place + 1]]
        past_rear, back = step != plain, sign * direction < 0
        if not same_window or past_rear or back:
            shared = same_window and not past_rear and abs(step) <= limit
            sweeps.append(order[first : place + 1])
            first = place if shared else place + 1
            direction = sign if shared else 0
        else:
            direction = direction or sign
    return [*sweeps, order[first:]]


def _steps(angle: NDArray[np.int64], sweeps: list[Index]) -> list[int]:
    """Return the step of the head in each sweep; that of the sweep before, or else after, if it has few pings."""
    steps = [int(np.median(np.abs(np.diff(angle[sweep])))) if len(sweep) >= FEW_PINGS else 0 for sweep in sweeps]
    known = next((step for step in steps if step), 0)
    for number, step in enumerate(steps):
        known = steps[number] = step or known
    return steps


def _part(pings: ScanPings, angle: NDArray[np.int64], sweeps: list[Index], like: LikeFrames) -> Part:
    """Return the part that consists of these sweeps."""
    angles = np.unique(np.concatenate([angle[sweep] for sweep in sweeps]))
    ping_of = np.full((len(sweeps), len(angles)), -1, np.intp)
    beam_time_s = np.zeros(ping_of.shape)
    for row, time_s, sweep in zip(ping_of, beam_time_s, sweeps, strict=True):
        row[np.searchsorted(angles, angle[sweep])] = sweep  # of pings at one angle the last counts
        scanned = np.flatnonzero(row >= 0)
        time_s[:] = np.interp(np.arange(len(angles)), scanned, pings.time_s[row[scanned]])
    times = beam_time_s.mean(axis=1)
    increasing, _ = in_time_order(times)
    ping_of, beam_time_s, times = ping_of[increasing], beam_time_s[increasing], times[increasing]
    intervals = np.concatenate([np.diff(pings.time_s[sweep]) for sweep in sweeps])
    interval_s = float(np.median(intervals)) if len(intervals) else 0.0
    frames = like(int(sweeps[0][0]), angles * ANGLE_UNIT_RAD, interval_s if interval_s > 0 else DEFAULT_INTERVAL_S)
    return Part(frames, times, Sweep(pings, ping_of, len(frames.range_m)), beam_time_s=beam_time_s)
