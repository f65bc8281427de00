"""The imaging sonar: field of view, beams, rays, window, and the model that is computed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from mitsonar.errors import MitsonarError, complaint
from mitsonar.instruments.quality import Quality, rays_across, rays_over_elevation

__all__ = ["RAYS", "Bearing", "FieldValue", "Instrument", "Model", "Sonar"]

FieldValue: TypeAlias = Any
"""The value of an instrument's field, before pydantic checks it."""

Model = Literal["physical", "thesis"]
Bearing = Literal["azimuth", "cone"]
SEE = " (see `mitsonar presets --help` and docs/guides/sonars.md)"
RAYS = ("rays_per_beam", "rays_across")
"""Fields that follow from ``quality`` where they are not given."""

THESIS_ACROSS = 4
"""Value of ``rays_across`` in the model ``thesis``, which traces one ray."""


def _rays_over_elevation(given: dict[str, FieldValue]) -> int:
    """Derive the rays over elevation from the other fields."""
    if given["model"] == "thesis":
        return int(given["thesis_rays"])
    return rays_over_elevation(given["quality"], math.radians(given["elevation_fov_deg"]))


def _rays_across(given: dict[str, FieldValue]) -> int:
    """Derive the rays across a beam from the other fields."""
    if given["model"] == "thesis":
        return THESIS_ACROSS
    fov = math.radians(given["azimuth_fov_deg"])
    width = fov / given["beams"] if given["beam_width_deg"] is None else math.radians(given["beam_width_deg"])
    return rays_across(given["quality"], width, fov, given["range_max"])


class Instrument(BaseModel):
    """Base of all instruments. :meth:`create` answers a mistake with one sentence."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    called: ClassVar[str]
    see: ClassVar[str]

    name: str = Field("custom", description="what the instrument is called")

    if TYPE_CHECKING:  # each has its own, at its own position among the keys
        model: str
        frame_rate_hz: float

    @classmethod
    def create(cls, **fields: FieldValue) -> Self:
        """Create an instrument with these fields.

        Raises:
            MitsonarError: an unknown key, a value outside its limits.
        """
        try:
            return cls(**fields)
        except ValidationError as error:
            raise MitsonarError(complaint(error, cls, cls.called, cls.see)) from None

    def replace(self, **fields: FieldValue) -> Self:
        """Return a copy with some fields changed; all fields are checked.

        Raises:
            MitsonarError: an unknown key, a value outside its limits.
        """
        return self.create(**{**self.model_dump(), **fields})


class Sonar(Instrument):
    """An imaging sonar. Angles in degrees (the edge of the program), all else SI.

    The same names are the XML properties of the sensor ``imaging_sonar`` and the keys of a sonar's YAML file
    (``docs/guides/sonars.md``).

    In the physical model ``rays_per_beam`` and ``rays_across`` follow from ``quality``. In the model ``thesis`` they are
    ``thesis_rays`` and one. Numbers that are given take precedence.

    Raises:
        MitsonarError: through :meth:`create`, for an unknown key or a value outside its limits.
    """

    called: ClassVar[str] = "sonar"
    see: ClassVar[str] = SEE

    azimuth_fov_deg: float = Field(29.0, gt=0, le=360, description="field of view across the beams [deg]")
    elevation_fov_deg: float = Field(14.0, gt=0, le=180, description="field of view within a beam [deg]")
    beams: int = Field(96, ge=1, le=65_536, description="number of beams")
    range_min: float = Field(3.2, ge=0, le=1e5, description="start of the window [m]")
    range_max: float = Field(5.6, gt=0, le=1e5, description="end of the window [m], beyond range_min")
    range_bins: int = Field(512, ge=1, le=1_000_000, description="range bins of the window")
    sound_speed: float = Field(1500.0, gt=0, le=1e4, description="sound speed [m/s]")
    bearing: Bearing = Field("azimuth", description="what a beam's angle is: azimuth, or the cone of a line array")
    beam_layout: Literal["even", "sine"] = Field(
        "even", description="axes at equal steps of the angle, or of its sine (beamformers without steering tables)"
    )
    beam_width_deg: float | None = Field(
        None, gt=0, le=360, description="width of one beam [deg]; default: the spacing of the beams"
    )
    jitter: bool | None = Field(
        None, description="rays move at random within their cells, anew each ping; default: physical yes, thesis no"
    )
    seed: int = Field(0, ge=0, lt=2**63, description="seed of the jitter")
    model: Model = Field("physical", description="physical, or thesis with its artefacts")
    gain_exponent: int = Field(
        0,
        ge=0,
        le=4,
        description="time-varying gain (R / 1 m)^gain_exponent of `physical`; 2 undoes the spreading of one way, 4 of both",
    )
    frame_rate_hz: float = Field(10.0, gt=0, le=1e6, description="pings a second [Hz]")
    quality: Quality = Field(
        "standard", description="rays of `physical`: draft, standard or fine; `mitsonar presets` prints what each errs by"
    )
    thesis_rays: int = Field(700, ge=1, le=1_000_000, description="rays over a beam's elevation of the model thesis")
    rays_per_beam: int = Field(
        default_factory=_rays_over_elevation,
        ge=1,
        le=1_000_000,
        description="rays over a beam's elevation; default: from quality",
    )
    rays_across: int = Field(
        default_factory=_rays_across,
        ge=1,
        le=4096,
        description="rays across a beam's width (thesis: one, on the axis); default: from quality",
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.range_max > self.range_min:
            raise ValueError(
                f"range_max must exceed range_min: got {self.range_max:g} m <= {self.range_min:g} m; "
                "give the far end of the window as range_max"
            )
        if self.bearing == "cone" and self.azimuth_fov_deg > 180:
            raise ValueError(
                f"a cone bearing covers at most 180 deg: got azimuth_fov_deg {self.azimuth_fov_deg:g}; "
                "use bearing azimuth for wider fans"
            )
        if self.beam_layout == "sine" and self.azimuth_fov_deg > 180:
            raise ValueError(f"beam_layout sine covers at most 180 deg: got azimuth_fov_deg {self.azimuth_fov_deg:g}")
        if self.bearing == "cone" and self.bearing_rad[-1] + self.beam_width_rad / 2 > math.radians(90) + 1e-9:
            raise ValueError(
                f"a cone's beams end at 90 deg: the outermost reaches {self._outermost_deg():.4g} deg; lower "
                "azimuth_fov_deg or beam_width_deg"
            )
        if self.beams * self.range_bins > 2**28:
            raise ValueError(
                f"an image has at most {2**28:,} cells: got {self.beams * self.range_bins:,}; lower beams or range_bins"
            )
        rays = self.beams * (1 if self.model == "thesis" else self.rays_across) * self.rays_per_beam
        if rays > 2**28:
            raise ValueError(f"a ping has at most {2**28:,} rays: got {rays:,}; lower quality, beams or numbers of rays")
        return self

    def replace(self, **fields: FieldValue) -> Self:
        """Return a copy with some fields changed; all fields are checked.

        Numbers of rays that follow from other fields are derived anew. In the physical model a ``quality`` replaces numbers
        of rays that were given before. Numbers given together with it take precedence.
        """
        kept = self.model_dump()
        renewed = "quality" in fields and fields.get("model", self.model) != "thesis"
        for name in RAYS:
            if renewed or name not in self.model_fields_set:
                del kept[name]
        return self.create(**{**kept, **fields})

    def _outermost_deg(self) -> float:
        return math.degrees(self.bearing_rad[-1] + self.beam_width_rad / 2)

    @property
    def across(self) -> int:
        """Return the rays across a beam that are traced: ``rays_across``, or one in the model ``thesis``."""
        return 1 if self.model == "thesis" else self.rays_across

    @property
    def jittered(self) -> bool:
        """Return whether rays move within their cells."""
        return self.model == "physical" if self.jitter is None else self.jitter

    @property
    def columns(self) -> int:
        """Return the number of rays side by side: the width of the film."""
        return self.beams * self.across

    @property
    def rays(self) -> int:
        """Return the number of rays of a ping."""
        return self.columns * self.rays_per_beam

    @property
    def beam_spacing_rad(self) -> float:
        """Return the field of view over the beams [rad]: the angle from one beam's axis to the next where they are even."""
        return math.radians(self.azimuth_fov_deg) / self.beams

    @property
    def beam_width_rad(self) -> float:
        """Return the width of the fan of rays of one beam [rad]. In the model ``thesis`` it is the spacing of the beams."""
        if self.beam_width_deg is None or self.model == "thesis":
            return self.beam_spacing_rad
        return math.radians(self.beam_width_deg)

    @property
    def bin_m(self) -> float:
        """Return the length of a range bin [m]."""
        return (self.range_max - self.range_min) / self.range_bins

    @property
    def range_m(self) -> NDArray[np.float64]:
        """Return the centres of the range bins ``(bins,)`` [m], nearest first."""
        return np.asarray(self.range_min + (np.arange(self.range_bins) + 0.5) * self.bin_m, dtype=np.float64)

    @property
    def bearing_rad(self) -> NDArray[np.float64]:
        """Return the bearings of the beams' axes ``(beams,)`` [rad], most to port first."""
        part = (np.arange(self.beams) + 0.5) / self.beams * 2 - 1  # -1..1 across the fan
        half = math.radians(self.azimuth_fov_deg) / 2
        axes = part * half if self.beam_layout == "even" else np.arcsin(part * math.sin(half))
        return np.asarray(axes, dtype=np.float64)
