"""How a scene's bodies move, as a YAML file says it: a path each, and meshes where the body deforms."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mitsonar.errors import MitsonarError, complaint
from mitsonar.io.files import read_yaml

__all__ = ["BodyMotion", "files_of", "motions_from", "read_motions"]

SEE = " (see docs/guides/moving.md)"


class BodyMotion(BaseModel):
    """Where one shape of the scene moves, and how it deforms."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    path: str | None = Field(
        None, description="a TUM or CSV file, several as school/*.tum, or vehicle; default: the body stays in its place"
    )
    frame: str = Field("mitsonar", description="convention of the file: mitsonar, ros-enu or ned")
    meshes: str | None = Field(None, description="PLY files of a mesh that deforms: fish/*.ply, in the order of their names")
    rate_hz: float = Field(10.0, gt=0, le=1e6, description="meshes a second [Hz]; the first is at time 0")
    loop: bool = Field(True, description="after the last mesh comes the first")

    @classmethod
    def create(cls, name: str, given: Any) -> Self:
        """Create the motion of a shape from its keys, or from a path alone.

        Raises:
            MitsonarError: an unknown key, a value of another type, or neither a path nor meshes.
        """
        fields = {"path": given} if isinstance(given, str) else given
        if not (isinstance(fields, dict) and all(isinstance(key, str) for key in fields)):
            raise MitsonarError(f"moving: {name} takes a path, or keys such as path and meshes: got {type(given).__name__}")
        try:
            made = cls(**fields)
        except ValidationError as error:
            raise MitsonarError(f"moving: {name}: {complaint(error, cls, 'motion', SEE)}") from None
        if made.path is None and made.meshes is None:
            raise MitsonarError(f"moving: {name} needs a path or meshes{SEE}")
        return made


def read_motions(file: str | Path) -> dict[str, BodyMotion]:
    """Read a YAML file: ``id: path.tum``, or the keys of :class:`BodyMotion` below the id.

    Raises:
        MitsonarError: unreadable, or wrong keys.
    """
    return motions_from(read_yaml(file, "file of moving bodies"), str(file))


def motions_from(table: Any, source: str) -> dict[str, BodyMotion]:
    """Return the motions in a table by the ids of the shapes; ``source`` is named in errors.

    Raises:
        MitsonarError: no table of ids, or wrong keys.
    """
    if not (isinstance(table, dict) and table and all(isinstance(name, str) for name in table)):
        raise MitsonarError(f"{source} must hold `shape id: path` lines{SEE}")
    return {name: BodyMotion.create(name, given) for name, given in table.items()}


def files_of(name: str, folder: Path) -> list[Path]:
    """Return the file of a name, or the files of a pattern such as ``school/*.tum`` in the order of their names.

    Raises:
        MitsonarError: none matches.
    """
    whole = folder / name
    found = sorted(whole.parent.glob(whole.name)) if "*" in whole.name else [whole]
    if not found:
        raise MitsonarError(f"no file matches {whole}: give TUM, CSV or PLY files")
    return found
