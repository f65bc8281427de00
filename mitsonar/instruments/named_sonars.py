"""Sonars that can be named: one YAML file each in ``presets/``, every number with the document that it comes from.

In a source ``(not seen)`` marks a number that is widely quoted from a data sheet which could not be read when this was
written, ``second hand`` one that a third party quotes from the named sheet, ``ours`` a choice. Real instruments measure the
angle to a line array (``bearing: cone``). Their users set the window, so a preset's window is ours, inside the instrument's
limits.
"""

from __future__ import annotations

import os
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from mitsonar.errors import MitsonarError, nearest_names, shortened
from mitsonar.instruments.imaging_sonar import Sonar
from mitsonar.io.files import read_yaml

__all__ = ["NamedSonar", "fields_in", "load_sonar", "named_sonars", "preset", "presets_in", "sonar_from"]


class NamedSonar(NamedTuple):
    """A preset.

    Attributes:
        about: which instrument, in which mode.
        values: of the fields of :class:`Sonar`, by name.
        sources: where each value comes from.
    """

    about: str
    values: dict[str, Any]
    sources: dict[str, str]


@cache
def named_sonars() -> dict[str, NamedSonar]:
    """Return all presets by name, from the files of the package."""
    return presets_in("presets")


def presets_in(folder: str) -> dict[str, NamedSonar]:
    """Return the presets in a folder of the package by name."""
    found = {}
    for path in sorted((files("mitsonar.instruments") / folder).iterdir(), key=lambda path: path.name):
        table = yaml.safe_load(path.read_text(encoding="utf-8"))
        keys = table["keys"].items()
        values, sources = ({key: one[part] for key, one in keys} for part in ("value", "source"))
        found[path.name.removesuffix(".yaml")] = NamedSonar(table["about"], values, sources)
    return found


def preset(name: str) -> Sonar:
    """Return the sonar of a preset.

    Raises:
        MitsonarError: unknown name, with the nearest ones.
    """
    known = named_sonars()
    if name not in known:
        raise MitsonarError(f"unknown sonar preset {shortened(name)}: {nearest_names(name, known)}")
    return Sonar.create(name=name, **known[name].values)


def load_sonar(name_or_file: str | Path) -> Sonar:
    """Load a preset by its name, or a sonar from a YAML file (keys: the fields of :class:`Sonar`, and ``preset``).

    Files after a comma are laid over it: ``didson300,noise.yaml`` is the preset with the fields of ``noise.yaml`` replaced.

    Raises:
        MitsonarError: unknown preset (with the nearest names), unreadable file, unknown key, value out of limits.
    """
    text = str(name_or_file)
    if "," in text and not os.path.exists(text):
        first, *over = (part.strip() for part in text.split(","))
        sonar = load_sonar(first)
        for one in over:
            sonar = sonar.replace(**{key: value for key, value in fields_in(one).items() if key != "name"})
        return sonar
    if not text.lower().endswith((".yaml", ".yml")):
        if text in named_sonars() or not os.path.exists(text):
            return preset(text)
        raise MitsonarError(f"a sonar's file ends in .yaml: got {text}; rename it, or name a preset")
    fields = fields_in(text)
    fields.setdefault("name", Path(text).stem)
    return sonar_from(fields)


def fields_in(text: str, what: str = "a sonar", page: str = "sonars") -> dict[str, Any]:
    """Return the fields in a YAML file.

    Args:
        text: path of the file.
        what: whose they are, for errors.
        page: of the guides that tells of them.

    Raises:
        MitsonarError: unreadable, or no `key: value` lines.
    """
    try:
        fields = read_yaml(text, f"{what.split()[-1]} file")
    except MitsonarError as error:
        more = f"; see docs/guides/{page}.md" if "not YAML" in str(error) else " or a preset's name"
        raise MitsonarError(f"{error}{more}") from None
    if not isinstance(fields, dict) or not all(isinstance(key, str) for key in fields):
        raise MitsonarError(f"{text} must hold `key: value` lines of {what}; see docs/guides/{page}.md")
    return fields


def sonar_from(fields: dict[str, Any]) -> Sonar:
    """Make a sonar from its fields, the key ``preset`` (optional) naming the one they change."""
    fields = dict(fields)
    base = fields.pop("preset", None)
    if not all(isinstance(key, str) for key in fields) or not isinstance(base, str | None):
        raise MitsonarError("the keys of a sonar must be words, and preset the name of one; see docs/guides/sonars.md")
    return Sonar.create(**fields) if base is None else preset(str(base)).replace(**fields)
