"""Extension of griffe, which reads docstrings for the reference: packages of mitsonar that lie outside ``mitsonar/``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import griffe

ROOT = Path(__file__).resolve().parents[1]


class PackagesElsewhere(griffe.Extension):  # type: ignore[misc, unused-ignore]  # Any where griffe is not installed
    """Adds ``mitsonar.reproduction``, where the public names of reproduction are defined."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Read the package, and make it a member of mitsonar."""
        if pkg.name == "mitsonar":
            pkg.set_member("reproduction", griffe.load("reproduce", search_paths=[ROOT / "benchmarks"]))
