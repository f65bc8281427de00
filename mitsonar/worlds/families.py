"""The families of worlds by name."""

from __future__ import annotations

from mitsonar.errors import MitsonarError, nearest_names, shortened
from mitsonar.worlds.flat_objects import FlatObjects
from mitsonar.worlds.pattern import Pattern
from mitsonar.worlds.rocky_field import RockyField
from mitsonar.worlds.scene_file import SceneFile
from mitsonar.worlds.sea_surface import SeaSurface
from mitsonar.worlds.ship_hull import ShipHull
from mitsonar.worlds.world import Family

__all__ = ["FAMILIES", "create_family"]

FAMILIES: dict[str, type[Family]] = {
    family.called: family for family in (RockyField, ShipHull, Pattern, FlatObjects, SeaSurface)
}


def create_family(name: str, **fields: object) -> Family:
    """Create the family of a name; ``scene`` is a file of the user's own.

    Args:
        name: of :data:`FAMILIES`, or ``scene``.
        fields: numbers of the family; the others are Almanza-Medina's.

    Raises:
        MitsonarError: unknown name or key, or a number outside its limits.
    """
    known: dict[str, type[Family]] = {**FAMILIES, SceneFile.called: SceneFile}
    if name not in known:
        raise MitsonarError(f"unknown world {shortened(name)}: {nearest_names(name, known)}")
    return known[name].create(**fields)
