"""Sounders: instruments made of one fan at several mounts, such as a side-scan, an altimeter, a profiler, a DVL."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.instruments.beam_directions import directions
from mitsonar.instruments.imaging_sonar import Sonar
from mitsonar.io.checked_model import CheckedModel
from mitsonar.motion.pose import Pose, mounted, vehicle_rotation

__all__ = ["KINDS", "Kind", "Sounder"]

Kind = Literal["sidescan", "altimeter", "profiler", "dvl", "range-image"]
KINDS: tuple[str, ...] = get_args(Kind)

FEWEST_BEAMS = 3
"""Beams that a velocity in three directions takes."""

SEE = " (see docs/guides/instruments.md)"

Mount = tuple[float, float, float, float, float, float]
"""Place of a fan in the vehicle: starboard, forward, up [m], pitch, roll, heading [deg]."""


class Sounder(CheckedModel):
    """An instrument made of equal fans. All of them ping at once, and do not hear each other.

    ``rows`` above 1 stacks fans on each mount, ``elevation_fov_deg`` of the fan apart: a 2-D array. With the bearing
    ``cone`` the rows share their cones, as those of such an array do.

    Raises:
        MitsonarError: an unknown key, or a value outside its limits.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    called: ClassVar[str] = "instrument"
    see: ClassVar[str] = SEE

    name: str = Field("custom", description="what the instrument is called")
    kind: Kind = Field(description="what is made of its echoes")
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
        """Create an instrument; keys of the fan stand beside its own.

        Raises:
            MitsonarError: an unknown key, a value outside its limits.
        """
        own = set(cls.model_fields) - {"fan"}
        wrong = sorted(set(fields) - own - set(Sonar.model_fields))
        if wrong:
            raise MitsonarError(
                f"unknown instrument key {wrong[0]}: {nearest_names(wrong[0], own | set(Sonar.model_fields))}"
            )
        fan = Sonar.create(**{key: value for key, value in fields.items() if key not in own or key == "name"})
        return cls(fan=fan, **{key: value for key, value in fields.items() if key in own})

    def replace(self, **fields: Any) -> Self:
        """Return a copy with some keys changed, of its own or of the fan; all are checked.

        Raises:
            MitsonarError: as :meth:`create`.
        """
        own = set(type(self).model_fields) - {"fan"}
        fan = self.fan.replace(**{key: value for key, value in fields.items() if key in Sonar.model_fields})
        kept = self.model_dump(exclude={"fan"}) | {key: fields[key] for key in own & set(fields)}
        wrong = {key: value for key, value in fields.items() if key not in own and key not in Sonar.model_fields}
        return self.create(**{**fan.model_dump(include=fan.model_fields_set), **kept, **wrong})

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
        """Return the names of the fans, mount by mount, the highest row first."""
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
        pitch = (np.arange(self.rows) + 0.5 - self.rows / 2) * step  # the first row looks up
        rows = [mounted(bases, Pose.from_row((0, 0, 0, float(one), 0, 0))) for one in pitch]
        return np.stack(rows, axis=1).reshape(-1, 6)

    @property
    def axes(self) -> NDArray[np.float64]:
        """Return the unit vectors of the fans' axes ``(channels, 3)`` as (starboard, forward, up) of the vehicle."""
        return np.asarray(vehicle_rotation(self.mount_poses).apply([0.0, 1.0, 0.0]))

    @property
    def looks_ahead(self) -> bool:
        """Return whether all fans look ahead, so that the instrument's poses are those of a forward-looking sonar."""
        return bool((self.axes[:, 1] > math.cos(math.radians(45))).all())

    def fan_poses(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the poses of all fans in the world ``(pings, channels, 6)`` for poses of the vehicle ``(pings, 6)``."""
        return np.stack([mounted(poses, Pose.from_row(mount)) for mount in self.mount_poses], axis=1)

    def directions(self) -> NDArray[np.float64]:
        """Return the beams' axes in the frame of their fan ``(beams, 3)`` as (starboard, forward, up)."""
        return directions(self.fan.bearing, self.fan.bearing_rad, 0.0)
