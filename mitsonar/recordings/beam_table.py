"""Beam angles of ARIS sonars by lens and number of beams (Sound Metrics, aris-file-sdk, MIT)."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError

__all__ = ["aris_bearings"]

TABLES = {
    ("telephoto", 48): "aris_telephoto_48",
    ("telephoto", 96): "aris_telephoto_96",
    ("1200", 48): "aris1200_1800_48",
    ("1800", 48): "aris1200_1800_48",
    ("1800", 96): "aris1800_96",
    ("3000", 64): "aris3000_64",
    ("3000", 128): "aris3000_128",
}
"""Tables by lens or type of the sonar and number of beams."""


@cache
def aris_bearings(kind: str, beams: int) -> NDArray[np.float64]:
    """Return the bearings of an ARIS' beams ``(beams,)`` [rad], most to port first, starboard positive.

    Beam 0 of a file is the one most to starboard, and of the table the one of the least angle. So the angle of a beam is
    the negative one of its row, and the beams in falling order of their numbers are the table as it is, negated.

    Args:
        kind: ``1200``, ``1800`` or ``3000``, or ``telephoto`` for any of them with the large lens.
        beams: number of beams.

    Raises:
        MitsonarError: no table for them.
    """
    if (kind, beams) not in TABLES:
        known = ", ".join(f"{one} with {number}" for one, number in TABLES)
        raise MitsonarError(f"no beam angles are known for an ARIS {kind} with {beams} beams: known are {known}")
    lines = files("mitsonar.recordings").joinpath(f"beam_tables/{TABLES[kind, beams]}.csv").read_text().splitlines()
    degrees = np.array([float(line.split(",")[1]) for line in lines[1:]])
    return np.asarray(-np.radians(degrees)[::-1])
