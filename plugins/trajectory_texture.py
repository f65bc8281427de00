"""The texture ``trajectory``, with which a shape of a scene specifies its motion."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mitsonar.plugins.hashed_texture import number_of_property
from mitsonar.plugins.native_plugins import search_folders

__all__ = ["MOTION", "TrajectoryTexture"]

MOTION = "motion"
"""Name of the texture within a shape."""


class TrajectoryTexture(mi.Texture):
    """The trajectory of the shape that contains the texture, under the name ``motion``.

    It has no colour; sonars and cameras follow it.

    Properties: ``filename``: a TUM or CSV file, or several as ``school/*.tum`` (which places the shape several times), or
    ``vehicle`` for the path of the vehicle; ``frame`` [mitsonar]: coordinate convention of the file, or ros-enu or ned;
    ``meshes``: PLY files of a deforming mesh, ``fish/*.ply``, each with as many vertices as the shape; ``rate_hz`` [10]:
    meshes per second; ``loop`` [true]. Paths are relative to the folder of the scene file. At pose 0 the shape lies where
    the scene places it (docs/guides/moving.md). Mitsuba alone renders the shape there.

    .. code-block:: xml

        <shape type="ply" id="fish">
            <string name="filename" value="fish.ply"/>
            <texture type="trajectory" name="motion"><string name="filename" value="fish.tum"/></texture>
        </shape>
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.fields: dict[str, Any] = {"rate_hz": number_of_property(props, "rate_hz", 10.0)}
        self.fields |= {"loop": bool(props.get("loop", True)), "frame": str(props.get("frame", "mitsonar"))}
        for name, key in (("filename", "path"), ("meshes", "meshes")):
            if name in props:
                self.fields[key] = str(props[name])
        self.folders = search_folders()

    def to_string(self) -> str:
        """Return one line for Mitsuba's logs."""
        return f"Trajectory[{self.fields}]"

    def mean(self) -> Any:
        """Return 0, since the texture has no colour."""
        return mi.Float(0)


mi.register_texture("trajectory", TrajectoryTexture)
