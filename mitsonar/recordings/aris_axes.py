"""The axes of an ARIS file: which of the vendor's tables beams are, and ranges in whole microseconds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, argument
from mitsonar.instruments.sonar import Sonar
from mitsonar.recordings.aris import BEAMS, KINDS, LEAST_SPEED, MOST_SAMPLES, MOST_SPEED
from mitsonar.recordings.beam_table import TABLES, aris_bearings

__all__ = ["ArisTable", "ArisWindow", "Values", "half_spacing", "interpolated", "table_of", "window_of"]

Array = NDArray[np.float64]

Values = NDArray[np.float32] | NDArray[np.uint8]
"""Values 0..255 of images ``(n, bins, beams)``."""

EXACT = 0.05
"""Part of a sample by which the written range axis may differ from the frames' at any sample, without interpolation."""


@dataclass(frozen=True)
class ArisTable:
    """A table of beams, and the fields of a header that name it."""

    beams: int
    bearings: Array
    system: int
    lens: int
    high: int


@dataclass(frozen=True)
class ArisWindow:
    """A range axis in whole microseconds; ``exact``: it is the frames' own."""

    delay_us: int
    period_us: int
    samples: int
    sound_speed: float
    exact: bool

    @property
    def step_m(self) -> float:
        """Return the length of a sample [m]."""
        return self.period_us * 1e-6 * self.sound_speed / 2

    @property
    def start_m(self) -> float:
        """Return the range of the first sample [m]."""
        return self.delay_us * 1e-6 * self.sound_speed / 2


def interpolated(values: NDArray[Any], have: Array, want: Array, *, axis: int) -> NDArray[np.float32]:
    """Return values at other places of an axis, linearly; 0 beyond its ends by more than half a step."""
    place = np.interp(want, have, np.arange(len(have)))
    low = np.clip(place.astype(np.intp), 0, max(0, len(have) - 2))
    shape = [1, 1, 1]
    shape[axis] = len(want)
    part = (place - low).astype(np.float32).reshape(shape)
    made = (
        np.take(values, low, axis=axis) * (1 - part) + np.take(values, np.minimum(low + 1, len(have) - 1), axis=axis) * part
    )
    first, last = (have[1] - have[0]) / 2, (have[-1] - have[-2]) / 2
    inside = (want >= have[0] - first) & (want <= have[-1] + last)
    return np.asarray(made * inside.reshape(shape), dtype=np.float32)


def half_spacing(bearings: Array) -> float:
    """Return half the mean angle between beams [rad]."""
    return float(np.diff(bearings).mean()) / 2 if len(bearings) > 1 else 0.0


def table_of(bearings: Array, sonar: Sonar, beams: int | None) -> tuple[ArisTable, float]:
    """Return the table that is nearest to the beams, and by how much it moves them, at most [rad]."""
    numbers = sorted(set(BEAMS.values()))
    count = len(bearings) if beams is None else beams
    fan = f"{len(bearings)} beams from {np.degrees(bearings[0]):.4g} to {np.degrees(bearings[-1]):.4g} deg"
    if count not in numbers:
        known = ", ".join(str(one) for one in numbers)
        raise MitsonarError(f"an ARIS file holds {known} beams: got {fan}; give {argument('beams')} 128 to interpolate them")
    tables = [_named(kind, count, sonar) for kind, number in TABLES if number == count]
    edge = max(abs(bearings[0]), abs(bearings[-1]))

    def differs(table: ArisTable) -> float:
        if len(bearings) == count:
            return float(np.abs(table.bearings - bearings).max())
        return float(abs(table.bearings[-1] - edge))

    moved = min(differs(table) for table in tables)
    near = [table for table in tables if differs(table) <= moved + 1e-9]
    table = min(near, key=lambda one: (sonar.name != f"aris{KINDS[one.system].name}", _apart(one.system, one.high, sonar)))
    if beams is None and moved > half_spacing(bearings):
        raise MitsonarError(
            f"no ARIS has {fan}: the nearest table has {count} up to {np.degrees(table.bearings[-1]):.4g} deg; give "
            f"{argument('beams')} {count} to interpolate them"
        )
    return table, moved


def _named(kind: str, beams: int, sonar: Sonar) -> ArisTable:
    """Return a table with the type of sonar, of those that have it, and the carrier that are nearest to a sonar's."""
    systems = [one for one in KINDS if kind in ("telephoto", KINDS[one].name)]
    choices = [(system, high) for system in systems for high in (1, 0)]
    chosen = min(choices, key=lambda one: (sonar.name != f"aris{KINDS[one[0]].name}", _apart(one[0], one[1], sonar)))
    return ArisTable(beams, aris_bearings(kind, beams), chosen[0], int(kind == "telephoto"), chosen[1])


def _apart(system: int, high: int, sonar: Sonar) -> float:
    """Return how far the carrier of a type of ARIS is from a sonar's [Hz]; 0 where the sonar tells none."""
    carrier = KINDS[system].high_hz if high else KINDS[system].low_hz
    return abs(carrier - sonar.frequency_hz) if sonar.frequency_hz else 0.0


def window_of(range_m: Array, sound_speed: float) -> ArisWindow:
    """Return the range axis in whole microseconds: the frames' own where that is one, else the next finer one."""
    if not LEAST_SPEED < sound_speed < MOST_SPEED:
        raise MitsonarError(
            f"an ARIS file holds sound speeds of {LEAST_SPEED:g} to {MOST_SPEED:g} m/s: got {sound_speed:g}; give others"
        )
    speed = float(np.float32(sound_speed))
    bins = len(range_m)
    step = (range_m[-1] - range_m[0]) / (bins - 1) if bins > 1 else speed * 1e-6
    period, delay = step * 2e6 / speed, range_m[0] * 2e6 / speed
    whole = max(1, round(period))
    axis = (round(delay) + np.arange(bins) * whole) * speed * 5e-7
    if np.abs(axis - range_m).max() < EXACT * step:
        made = ArisWindow(round(delay), whole, bins, speed, exact=True)
    else:
        finer = max(1, int(period + 1e-6))
        samples = int((range_m[-1] * 2e6 / speed - round(delay)) / finer + 1e-6) + 1
        made = ArisWindow(round(delay), finer, samples, speed, exact=False)
    if not 0 < made.samples <= MOST_SAMPLES or made.delay_us >= 1e8 or made.period_us >= 1e6:
        raise MitsonarError(
            f"an ARIS file holds up to {MOST_SAMPLES:,} samples a beam: the frames' {bins:,} bins from {range_m[0]:.4g} to "
            f"{range_m[-1]:.4g} m take {made.samples:,}; write a shorter window"
        )
    return made
