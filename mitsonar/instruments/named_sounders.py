"""Sounders that can be named: one YAML file each in ``sounders/``, every number with the document that it comes from."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from mitsonar.errors import MitsonarError, nearest_names, shortened
from mitsonar.instruments.named_sonars import NamedSonar, fields_in, presets_in
from mitsonar.instruments.sounder import KINDS, Sounder

__all__ = ["OF_KIND", "load_sounder", "named_sounders"]

OF_KIND = {
    "sidescan": "starfish-450f",
    "altimeter": "ping2",
    "profiler": "deltat-837",
    "dvl": "a50",
    "range-image": "sonar-3d-15",
}
"""The preset that the name of a kind stands for."""


@cache
def named_sounders() -> dict[str, NamedSonar]:
    """Return all presets by name, from the files of the package."""
    return presets_in("sounders")


def load_sounder(name_or_file: str | Path) -> Sounder:
    """Load a preset by its name or its kind's, or an instrument from a YAML file (its keys, and ``preset``).

    Raises:
        MitsonarError: unknown preset (with the nearest names), unreadable file, unknown key, value out of limits.
    """
    text = str(name_or_file)
    if not text.lower().endswith((".yaml", ".yml")):
        return _preset(text)
    fields = fields_in(text, "an instrument", "instruments")
    fields.setdefault("name", Path(text).stem)
    base = fields.pop("preset", None)
    return Sounder.create(**fields) if base is None else _preset(str(base)).replace(**fields)


def _preset(name: str) -> Sounder:
    """Return the instrument of a preset, or of the kind that stands for one."""
    known = named_sounders()
    found = OF_KIND.get(name, name)
    if found not in known:
        raise MitsonarError(f"unknown instrument {shortened(name)}: {nearest_names(name, [*KINDS, *known])}")
    fields: dict[str, Any] = known[found].values
    return Sounder.create(name=found, **fields)
