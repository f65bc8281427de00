"""Read a vehicle from a YAML file: its sensors with their mounts, and the moving bodies around it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from mitsonar.errors import MitsonarError, validation_message
from mitsonar.io.files import read_yaml
from mitsonar.motion.bodies import BodyMotion, motions_from

__all__ = ["CameraKeys", "SensorKeys", "VehicleRecipe", "check_sensor_name", "load_vehicle_recipe"]

SEE = " (see docs/guides/bridges.md)"

Mount = tuple[float, float, float, float, float, float]

KINDS = ("sonar", "instrument", "hydrophones", "camera")
"""Keys of the sensor types, of which each sensor has exactly one."""


class CameraKeys(BaseModel):
    """A forward-looking pinhole camera."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    fov_deg: float = Field(60.0, gt=0, lt=179, description="field of view across the picture [deg]")
    width: int = Field(640, ge=1, le=16_384, description="of the picture [pixels]")
    height: int = Field(480, ge=1, le=16_384, description="of the picture [pixels]")
    samples: int = Field(16, ge=1, le=65_536, description="rays of light a pixel")


class SensorKeys(BaseModel):
    """One sensor of a vehicle: one of ``sonar``, ``instrument``, ``hydrophones``, ``camera``, with its mount."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sonar: str | dict[str, Any] | None = Field(None, description="preset, YAML file, or the keys of an imaging sonar")
    instrument: str | None = Field(None, description="side-scan, DVL ...: what `mitsonar sound --instrument` takes")
    hydrophones: dict[str, Any] | None = Field(None, description="keys of a channel sonar")
    camera: CameraKeys | None = Field(None, description="fov_deg, width, height, samples")
    mount: Mount = Field((0, 0, 0, 0, 0, 0), description="starboard, forward, up [m], pitch, roll, heading [deg]")

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        given = [name for name in KINDS if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"a sensor is one of {', '.join(KINDS)}: got {' and '.join(given) or 'none'}")
        return self


class VehicleRecipe(BaseModel):
    """The sensors of a vehicle by name, and the moving bodies."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sensors: dict[str, SensorKeys] = Field(min_length=1, max_length=64, description="sensors by name")
    moving: dict[str, BodyMotion] = Field(default_factory=dict, description="motions by the ids of the scene's shapes")


def load_vehicle_recipe(file: str | Path) -> VehicleRecipe:
    """Read a YAML file with ``sensors`` and, optionally, ``moving``.

    Raises:
        MitsonarError: an unreadable file, an unknown key, or a value outside its limits.
    """
    fields = read_yaml(file, "vehicle file")
    if not (isinstance(fields, dict) and all(isinstance(key, str) for key in fields)):
        raise MitsonarError(f"{file} must hold the key sensors, and moving where bodies move{SEE}")
    table: dict[str, Any] = dict(fields)
    if table.get("moving"):
        table["moving"] = motions_from(table["moving"], f"moving of {file}")
    if isinstance(table.get("sensors"), dict):
        table["sensors"] = {name: _sensor(str(name), keys, file) for name, keys in table["sensors"].items()}
    try:
        return VehicleRecipe(**table)
    except ValidationError as error:
        raise MitsonarError(f"{file}: {validation_message(error, VehicleRecipe, 'vehicle', SEE)}") from None


def _sensor(name: str, keys: Any, file: str | Path) -> SensorKeys:
    """Return the keys of one sensor."""
    check_sensor_name(name)
    if not (isinstance(keys, dict) and all(isinstance(key, str) for key in keys)):
        raise MitsonarError(f"{file}: sensor {name} takes keys such as sonar and mount: got {type(keys).__name__}")
    try:
        return SensorKeys(**keys)
    except ValidationError as error:
        raise MitsonarError(f"{file}: sensor {name}: {validation_message(error, SensorKeys, 'sensor', SEE)}") from None


def check_sensor_name(name: str) -> None:
    """Check that the name of a sensor is valid as the name of its folder.

    Raises:
        MitsonarError: an invalid name.
    """
    if not name or name.startswith(".") or not all(one.isalnum() or one in "-_. " for one in name):
        raise MitsonarError(f"a sensor's name is that of its folder, letters, digits, - and _: got {name!r}; give it an id")
