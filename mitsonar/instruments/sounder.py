"""Define sounders, such as side-scan, altimeter, profiler and DVL, and load instruments by name or from files."""

from __future__ import annotations

import math
import os
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from mitsonar.errors import MitsonarError, short_repr, suggest_names
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import directions
from mitsonar.io.checked_model import CheckedModel, Preset, presets_in
from mitsonar.io.files import read_yaml
from mitsonar.motion.pose import Pose, mounted, vehicle_rotation

__all__ = [
    "DEFAULT_PRESETS",
    "KINDS",
    "Kind",
    "Sounder",
    "fields_in",
    "load_sonar",
    "load_sounder",
    "named_sonars",
    "named_sounders",
    "preset",
    "sonar_from",
]


Kind = Literal["sidescan", "altimeter", "profiler", "dvl", "range-image"]
KINDS: tuple[str, ...] = get_args(Kind)

FEWEST_BEAMS = 3
"""Smallest number of beams that determine a velocity in three dimensions."""

SEE = " (see docs/guides/instruments.md)"

Mount = tuple[float, float, float, float, float, float]
"""Pose of a fan in the vehicle: starboard, forward, up [m], pitch, roll, heading [deg]."""


class Sounder(CheckedModel):
    """An instrument made of identical fans, which all ping at once and do not receive each other.

    A value of ``rows`` above 1 stacks fans on each mount, spaced by the ``elevation_fov_deg`` of the fan: a 2-D array. With
    the bearing ``cone`` the rows share their cones, like those of such an array.

    Raises:
        MitsonarError: an unknown key, or a value outside its limits.
    """

    called: ClassVar[str] = "instrument"
    see: ClassVar[str] = SEE

    name: str = Field("custom", description="name of the instrument")
    kind: Kind = Field(description="type of instrument")
    fan: Sonar = Field(description="the sonar at each mount")
    mounts: dict[str, Mount] = Field(
        min_length=1,
        max_length=64,
        description="fans by name: starboard, forward, up [m], pitch, roll, heading [deg] in the vehicle",
    )
    rows: int = Field(1, ge=1, le=1024, description="fans above each other on a mount")
    below_db: float = Field(10.0, gt=0, le=120, description="an echo reaches so far below its strongest bin [dB]")
    above_noise_db: float = Field(13.0, ge=0, le=120, description="least level of an echo above the noise [dB]")
    beam_std_m_s: float = Field(0.0, ge=0, le=10, description="noise of a range rate, standard deviation (dvl) [m/s]")
    scale_std: float = Field(0.0, ge=0, le=0.5, description="standard deviation of the constant scale error (dvl)")

    @classmethod
    def create(cls, **fields: Any) -> Self:
        """Create an instrument from its fields and those of its fan, given together.

        Raises:
            MitsonarError: an unknown key, or a value outside its limits.
        """
        instrument_keys = set(cls.model_fields) - {"fan"}
        unknown = sorted(set(fields) - instrument_keys - set(Sonar.model_fields))
        if unknown:
            known = instrument_keys | set(Sonar.model_fields)
            raise MitsonarError(f"unknown instrument key {unknown[0]}: {suggest_names(unknown[0], known)}")
        fan = Sonar.create(**{key: value for key, value in fields.items() if key not in instrument_keys or key == "name"})
        return cls(fan=fan, **{key: value for key, value in fields.items() if key in instrument_keys})

    def replace(self, **fields: Any) -> Self:
        """Return a copy with some fields of the instrument or of its fan changed; all fields are validated.

        Raises:
            MitsonarError: as for :meth:`create`.
        """
        instrument_keys = set(type(self).model_fields) - {"fan"}
        fan = self.fan.replace(**{key: value for key, value in fields.items() if key in Sonar.model_fields})
        instrument_fields = self.model_dump(exclude={"fan"}) | {key: fields[key] for key in instrument_keys & set(fields)}
        unknown = {
            key: value for key, value in fields.items() if key not in instrument_keys and key not in Sonar.model_fields
        }
        return self.create(**{**fan.model_dump(include=fan.model_fields_set), **instrument_fields, **unknown})

    def __repr__(self) -> str:
        return f"Sounder({self.name}, {self.kind}: {len(self.channels)} fans ({', '.join(self.channels[:4])}) of {self.fan})"

    def __str__(self) -> str:
        return repr(self)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        one_beam = self.kind in ("sidescan", "altimeter", "dvl")
        if one_beam and (self.fan.beams > 1 or self.rows > 1):
            raise ValueError(f"a {self.kind} has one beam a fan: got beams {self.fan.beams}, rows {self.rows}")
        if self.kind == "sidescan" and set(self.mounts) != {"port", "starboard"}:
            raise ValueError(f"a sidescan has the mounts port and starboard: got {', '.join(self.mounts)}")
        if self.kind == "dvl":
            axes = self.axes
            if len(axes) < FEWEST_BEAMS or np.linalg.matrix_rank(axes, tol=0.05) < FEWEST_BEAMS:
                raise ValueError(
                    f"a dvl needs {FEWEST_BEAMS} beams or more that do not lie in one plane: got {len(axes)} mounts"
                )
            if self.beam_std_m_s == 0:
                raise ValueError("a dvl has noise: give beam_std_m_s, 0.005 for example")
        return self

    @property
    def channels(self) -> tuple[str, ...]:
        """Return the names of the fans, mount by mount, from the highest row."""
        if self.rows == 1:
            return tuple(self.mounts)
        return tuple(f"{name}-{row}" for name in self.mounts for row in range(self.rows))

    @property
    def mount_poses(self) -> NDArray[np.float64]:
        """Return the poses of the fans in the vehicle's axes ``(channels, 6)`` [m, rad]."""
        bases = np.array([Pose.from_degrees(mount) for mount in self.mounts.values()])
        if self.rows == 1:
            return bases
        step = math.radians(self.fan.elevation_fov_deg)
        pitch = (np.arange(self.rows) + 0.5 - self.rows / 2) * step  # the first row points up
        rows = [mounted(bases, Pose.from_row((0, 0, 0, float(angle), 0, 0))) for angle in pitch]
        return np.stack(rows, axis=1).reshape(-1, 6)

    @property
    def axes(self) -> NDArray[np.float64]:
        """Return the unit vectors of the fan axes ``(channels, 3)`` as (starboard, forward, up) of the vehicle."""
        return np.asarray(vehicle_rotation(self.mount_poses).apply([0.0, 1.0, 0.0]))

    @property
    def looks_ahead(self) -> bool:
        """Return whether all fans look ahead, so that the poses are those of a forward-looking sonar."""
        return bool((self.axes[:, 1] > math.cos(math.radians(45))).all())

    def fan_poses(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the poses of all fans in the world ``(pings, channels, 6)`` for vehicle poses ``(pings, 6)``."""
        return np.stack([mounted(poses, Pose.from_row(mount)) for mount in self.mount_poses], axis=1)

    def directions(self) -> NDArray[np.float64]:
        """Return the beam axes in the frame of their fan ``(beams, 3)`` as (starboard, forward, up)."""
        return directions(self.fan.bearing, self.fan.bearing_rad, 0.0)


# ---------------- Sounder presets
# One YAML file per instrument in ``sounders/``, with the source document of every number.


DEFAULT_PRESETS = {
    "sidescan": "starfish-450f",
    "altimeter": "ping2",
    "profiler": "deltat-837",
    "dvl": "a50",
    "range-image": "sonar-3d-15",
}
"""Default preset of each kind of sounder."""


@cache
def named_sounders() -> dict[str, Preset]:
    """Return all sounder presets of the package, by name."""
    return presets_in("mitsonar.instruments", "sounders")


def load_sounder(name_or_file: str | Path) -> Sounder:
    """Load a preset by its name or kind, or an instrument from a YAML file (its keys, and ``preset``).

    Raises:
        MitsonarError: unknown preset (suggesting the nearest names), unreadable file, unknown key, or value outside its
            limits.
    """
    text = str(name_or_file)
    if not text.lower().endswith((".yaml", ".yml")):
        return _preset(text)
    fields = fields_in(text, "an instrument", "instruments")
    fields.setdefault("name", Path(text).stem)
    base = fields.pop("preset", None)
    return Sounder.create(**fields) if base is None else _preset(str(base)).replace(**fields)


def _preset(name: str) -> Sounder:
    """Return the instrument of a preset, given by its name or its kind."""
    known = named_sounders()
    preset_name = DEFAULT_PRESETS.get(name, name)
    if preset_name not in known:
        raise MitsonarError(f"unknown instrument {short_repr(name)}: {suggest_names(name, [*KINDS, *known])}")
    fields: dict[str, Any] = known[preset_name].values
    return Sounder.create(name=preset_name, **fields)


# ---------------- Sonar presets
# One YAML file per instrument in ``presets/``, with the source document of every number. An instrument with several
# frequencies has ``modes``: presets that share the keys of the file and hold those that differ. In a source, ``(not seen)``
# marks a number that is widely quoted from a data sheet that could not be consulted, ``second hand`` a number that a third
# party quotes from the named sheet, and ``ours`` a choice of this project. Real instruments measure the angle to a line
# array (``bearing: cone``). Their users set the window, so the window of a preset is a choice of this project, within the
# limits of the instrument.


@cache
def named_sonars() -> dict[str, Preset]:
    """Return all sonar presets of the package, by name."""
    return presets_in("mitsonar.instruments", "presets")


def preset(name: str) -> Sonar:
    """Return the sonar of a preset.

    Raises:
        MitsonarError: unknown name, suggesting the nearest ones.
    """
    known = named_sonars()
    if name not in known:
        raise MitsonarError(f"unknown sonar preset {short_repr(name)}: {suggest_names(name, known)}")
    return Sonar.create(name=name, **known[name].values)


def load_sonar(name_or_file: str | Path) -> Sonar:
    """Load a preset by its name, or a sonar from a YAML file (keys: the fields of :class:`Sonar`, and ``preset``).

    Files after a comma override fields: ``didson300,noise.yaml`` is the preset with the fields of ``noise.yaml`` replaced.

    Raises:
        MitsonarError: unknown preset (suggesting the nearest names), unreadable file, unknown key, or value outside its
            limits.
    """
    text = str(name_or_file)
    if "," in text and not os.path.exists(text):
        first, *override_files = (part.strip() for part in text.split(","))
        sonar = load_sonar(first)
        for file in override_files:
            sonar = sonar.replace(**{key: value for key, value in fields_in(file).items() if key != "name"})
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
        what: owner of the fields, for error messages.
        page: guide that describes them, for error messages.

    Raises:
        MitsonarError: an unreadable file, or one without `key: value` lines.
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
    """Create a sonar from its fields; the optional key ``preset`` names a preset that they modify."""
    fields = dict(fields)
    base = fields.pop("preset", None)
    if not all(isinstance(key, str) for key in fields) or not isinstance(base, str | None):
        raise MitsonarError("the keys of a sonar must be words, and preset the name of one; see docs/guides/sonars.md")
    return Sonar.create(**fields) if base is None else preset(str(base)).replace(**fields)
