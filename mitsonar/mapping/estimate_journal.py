"""Journals of estimates: a JSON line each, written as they come, so that a killed run goes on. Bits survive."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate, PlainTable
from mitsonar.io.files import finite_number, parse_json, whole_lines, whole_number
from mitsonar.motion.composition import Motion

__all__ = ["add_to_journal", "read_journal"]

LARGEST_JOURNAL = 2**30
"""Bytes: some three million pairs."""

HEIGHTS = ("height_m", "height_std_m")
"""What an estimator may tell of the height over the ground [m]."""


def add_to_journal(path: Path, of: PlainTable, estimate: Estimate) -> None:
    """Add an estimate to a journal.

    Args:
        path: of the journal.
        of: what the estimate is of: its ``pair``; or ``first`` and ``second`` frame, and ``guess``, where it began.
        estimate: to add.
    """
    covariance = None if estimate.covariance is None else np.asarray(estimate.covariance, dtype=float).tolist()
    motion = [float(value) for value in estimate.motion]
    line = of | {"motion": motion, "covariance": covariance, "valid": bool(estimate.valid)}
    about = {name: estimate.about[name] for name in ("modes", "spreads", *HEIGHTS) if name in estimate.about}
    text = json.dumps(line | {"reason": estimate.reason} | ({"about": about} if about else {})) + "\n"
    with path.open("a", encoding="utf-8") as file:
        file.write(text)


def read_journal(path: Path, *names: str) -> Iterator[tuple[PlainTable, Estimate]]:
    """Yield what the estimates of a journal are of, and the estimates. Cut off a line that a kill left half written.

    Args:
        path: of the journal.
        names: numbers that say what an estimate is of, which each line must hold.

    Raises:
        MitsonarError: the journal is damaged.
    """
    for number, line in enumerate(whole_lines(path, "journal", LARGEST_JOURNAL), start=1):
        try:
            found = _estimate_in(line, names)
        except Exception:  # a line leads to whatever its bytes do
            raise MitsonarError(f"{path}, line {number} is damaged: start over with --overwrite") from None
        yield found


def _estimate_in(line: bytes, names: tuple[str, ...]) -> tuple[PlainTable, Estimate]:
    """Parse a line; a damaged one raises."""
    table = parse_json(line, "the line")
    covariance = None if table["covariance"] is None else np.array(table["covariance"], dtype=float)
    motion = np.array(table["motion"], dtype=float)
    if motion.shape != (3,) or not isinstance(table["reason"], str) or type(table["valid"]) is not bool:
        raise ValueError("motion, reason or valid is of another type")
    if table["valid"] and not np.isfinite(motion).all():
        raise ValueError("the motion is not finite")
    if covariance is not None and (covariance.shape != (3, 3) or (np.diagonal(covariance) < 0).any()):
        raise ValueError("covariance is not a covariance")
    about = table.get("about", {})
    if not isinstance(about, dict):
        raise ValueError("about is no table")
    for name in set(HEIGHTS) & set(about):
        finite_number(about[name], name, above=0)
    of: PlainTable = {name: whole_number(table[name], name, 0, 2**40) for name in names}
    if "first" in names:
        of["guess"] = Motion(*(float(value) for value in np.array(table["guess"], dtype=float).reshape(3)))
    return of, Estimate(Motion(*(float(value) for value in motion)), covariance, table["valid"], table["reason"], about)
