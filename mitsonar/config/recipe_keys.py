"""Keys of a recipe: read from YAML, and changed one by one."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeAlias

from pydantic import BaseModel

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.io.files import read_yaml

__all__ = ["Keys", "recipe_fields", "set_key"]

Keys: TypeAlias = dict[str, Any]
"""Keys and values of a recipe or of a part of it, as YAML holds them; a model checks them."""


def recipe_fields(
    name_or_file: str | Path, shipped: dict[str, Path], what: str, model: type[BaseModel], else_: str = ""
) -> tuple[Keys, Path]:
    """Read the keys of a YAML file, or of the shipped one of that name, and return them with the file.

    Args:
        name_or_file: ``rocky-field``, or ``mine.yaml``.
        shipped: files by name.
        what: kind of recipe, for errors.
        model: its fields are the known keys.
        else_: alternatives to a YAML file, for errors.

    Raises:
        MitsonarError: no such recipe, not YAML, or not a table.
    """
    path = Path(name_or_file)
    if path.suffix.lower() not in (".yaml", ".yml"):
        if str(name_or_file) not in shipped:
            names = nearest_names(str(name_or_file), shipped)
            raise MitsonarError(
                f"no {what} {str(name_or_file)!r}: give a YAML file or the name of a shipped recipe, {names}"
            )
        path = shipped[str(name_or_file)]
    fields = read_yaml(path, what, else_)
    if not (isinstance(fields, dict) and all(isinstance(key, str) for key in fields)):
        keys = ", ".join(field.alias or name for name, field in model.model_fields.items())
        raise MitsonarError(f"{path} must hold the keys of a {what}: {keys}")
    return fields, path


def set_key(fields: Keys, key: str, value: object) -> None:
    """Set a key of a recipe.

    Args:
        fields: the keys of the recipe; changed in place.
        key: with dots between the levels.
        value: its value.

    Raises:
        MitsonarError: a level is not a group of keys.
    """
    *levels, last = key.split(".")
    for level in levels:
        fields = fields.setdefault(level, {})
        if not isinstance(fields, dict):
            raise MitsonarError(f"cannot set {key}: {level} is not a group of keys; change it in a YAML file of your own")
    fields[last] = value
