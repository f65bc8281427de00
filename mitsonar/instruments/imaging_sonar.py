"""The imaging sonar: field of view, beams, rays, window, and the model that is computed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator

from mitsonar.instruments.aperture import Aperture, Pattern, Shading
from mitsonar.instruments.ping_groups import GroupOrder, check_groups, scans
from mitsonar.instruments.pulse import Pulse
from mitsonar.instruments.quality import Quality, rays_across, rays_over_elevation
from mitsonar.io.checked_model import CheckedModel

__all__ = ["RAYS", "Bearing", "Coding", "FieldValue", "Instrument", "Model", "Sonar"]

FieldValue: TypeAlias = Any
"""The value of an instrument's field, before pydantic checks it."""

Model = Literal["coherent", "physical", "thesis"]
Coding = Literal["linear", "dB", "gamma"]
Bearing = Literal["azimuth", "cone"]
SEE = " (see `mitsonar presets --help` and docs/guides/sonars.md)"
RAYS = ("rays_per_beam", "rays_across")
"""Fields that follow from ``quality`` where they are not given."""

LEAST_APERTURE = 0.5
"""Shortest aperture of a pattern of beams [wavelengths]."""

MOST_COHERENT_DEG = 170
"""Largest field of view of the model coherent: its fan is even in the sine and the tangent of angles [deg]."""

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


UNNAMED = "custom"
"""Name of an instrument that was given none."""


class Instrument(CheckedModel):
    """Base of all instruments."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(UNNAMED, description="what the instrument is called")

    if TYPE_CHECKING:  # each has its own, at its own position among the keys
        model: str
        frame_rate_hz: float

    @property
    def title(self) -> str:
        """Return the name for titles and sentences; of an instrument without one, what it is: ``unnamed sonar``."""
        return f"unnamed {self.called}" if self.name == UNNAMED else self.name

    @classmethod
    def create(cls, **fields: FieldValue) -> Self:
        """Create an instrument with these fields.

        Raises:
            MitsonarError: an unknown key, a value outside its limits.
        """
        return cls(**fields)

    def replace(self, **fields: FieldValue) -> Self:
        """Return a copy with some fields changed; all fields are checked.

        Raises:
            MitsonarError: an unknown key, a value outside its limits.
        """
        return self.create(**{**self.model_dump(), **fields})

    def __str__(self) -> str:
        return repr(self)


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
    model: Model = Field(
        "physical",
        description="coherent: with speckle, beams and pulse, as presets of real sonars have it; physical: expected levels, "
        "the default since coherent needs a frequency_hz; thesis: Almanza-Medina's",
    )
    bounces: int = Field(
        1, ge=1, le=3, description="largest number of reflections of a path: 1, 2 or 3 (docs/guides/multipath.md)"
    )
    gain_exponent: int = Field(
        0,
        ge=0,
        le=4,
        description="time-varying gain (R / 1 m)^gain_exponent of `physical`; 2 undoes the spreading of one way, 4 of both",
    )
    frame_rate_hz: float = Field(10.0, gt=0, le=1e6, description="pings a second [Hz]")
    ping_groups: int = Field(1, ge=1, le=65_536, description="groups of beams that ping one after another in a frame")
    group_order: GroupOrder = Field(
        "interleaved", description="beam k in group k mod ping_groups, or sequential: neighbours in one group"
    )
    group_interval_s: float | None = Field(
        None, ge=0, le=1e3, description="from the ping of a group to the next [s]; default: 2 range_max / sound_speed"
    )
    group_overhead_s: float = Field(
        0.0, ge=0, le=1e3, description="what a ping takes beyond its echo [s], where group_interval_s is not given"
    )
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
    frequency_hz: float | None = Field(None, gt=0, le=1e8, description="carrier [Hz]; the model coherent needs it")
    bandwidth_hz: float | None = Field(None, gt=0, le=1e8, description="band of the pulse [Hz], instead of pulse_m")
    pulse_m: float | None = Field(
        None, gt=0, le=1e3, description="range resolution, half-power width of the compressed pulse [m]; default: one bin"
    )
    pattern: Pattern | None = Field(
        None, description="of the beams: box, receive or two_way; default: two_way in the model coherent, else box"
    )
    shading: Shading = Field("hann", description="of the aperture: uniform, hann, hamming or taylor (-30 dB)")
    elevation_pattern: Pattern | None = Field(
        None, description="over elevation, of a uniform aperture: box, receive or two_way; default: pattern"
    )
    focus_m: float | None = Field(
        None, gt=0, le=1e5, description="range at which the array is focused [m] (coherent); default: at every range"
    )
    scatterers_per_cell: float = Field(
        6.0, gt=0, le=1e4, description="points a beam width by resolution at mid range (coherent); speckle needs 4"
    )
    scatterer_spacing_m: float | None = Field(
        None, gt=0, le=10, description="pitch of the points on surfaces [m]; default: from scatterers_per_cell"
    )
    speckle_nu: float | None = Field(
        None, gt=0.05, le=100, description="shape of the K law of speckle; default: none, exponential intensities"
    )
    speckle_patch_m: float = Field(0.1, gt=0, le=100, description="side of the patches that speckle_nu varies over [m]")
    source_level_db: float = Field(0.0, ge=-200, le=300, description="source level [dB re 1 uPa at 1 m]; 0: relative")
    noise_level_db: float | None = Field(
        None, ge=-300, le=300, description="noise in a beam and bin [dB re 1 uPa] (coherent); default: none"
    )
    volume_db: float | None = Field(
        None, ge=-200, le=0, description="volume scattering strength of the water [dB re 1/m] (coherent); default: none"
    )
    near_glow_db: float = Field(0.0, ge=0, le=120, description="noise near the sonar above noise_level_db [dB] (coherent)")
    near_glow_m: float = Field(0.5, gt=0, le=100, description="range over which near_glow_db falls to 0, evenly in dB [m]")
    near_glow_edge_db: float = Field(
        0.0,
        ge=-60,
        le=60,
        description="what the outermost beams glow less than the middle one, as the square of the bearing [dB]",
    )
    near_glow_spread_db: float = Field(0.0, ge=0, le=20, description="spread of the beams' near glow, by the seed [dB]")
    near_glow_still: float = Field(
        0.0,
        ge=0,
        le=1,
        description="part of the near glow's power that is the same in every ping, as the housing's ringing is",
    )
    absorption_db_per_m: float | None = Field(
        None, ge=0, le=1e3, description="one way [dB/m]; default: coherent by frequency and water, else 0"
    )
    temperature_c: float = Field(10.0, ge=-2, le=40, description="of the water [deg C]")
    salinity_psu: float = Field(35.0, ge=0, le=45, description="of the water [parts per thousand]")
    water_depth_m: float = Field(10.0, ge=0, le=12_000, description="depth of the sonar in the water [m]")
    ph: float = Field(8.0, ge=6, le=9, description="acidity of the water")
    gain_absorption: bool = Field(False, description="the gain undoes absorption there and back too")
    crosstalk_db: float | None = Field(
        None, ge=-120, le=0, description="every beam leaks into all others at this level [dB] (coherent); default: none"
    )
    stripes_db: float = Field(0.0, ge=0, le=20, description="spread of the beams' gains, by the seed [dB] (coherent)")
    coding: Coding | None = Field(
        None,
        description="how values stand for levels (with a pattern): linear, dB or gamma; default: coherent dB, else linear",
    )
    coding_db: float = Field(80.0, gt=0, le=300, description="span of the coding dB, from value 0 to 1 [dB]")
    coding_gamma: float = Field(0.5, gt=0, le=4, description="of the coding gamma: value = amplitude^gamma")

    def __repr__(self) -> str:
        carrier = "" if self.frequency_hz is None else f", {self.frequency_hz / 1e3:g} kHz"
        return (
            f"Sonar({self.name}: {self.beams} beams over {self.azimuth_fov_deg:g} deg, {self.range_bins} bins over "
            f"{self.range_min:g}..{self.range_max:g} m{carrier}, model {self.model})"
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
        if self.pulse_m is not None and self.bandwidth_hz is not None:
            raise ValueError("pulse_m and bandwidth_hz say the same: give one of them")
        check_groups(self)
        if self.bounces > 1 and self.model == "thesis":
            raise ValueError(
                f"the model thesis knows one reflection: got bounces {self.bounces}; leave bounces out, or use physical or "
                "coherent"
            )
        if self.model == "coherent":
            self._check_coherent()
        if self.beam_pattern != "box":
            self._check_aperture()
        rays = self.beams * (1 if self.model == "thesis" else self.rays_across) * self.rays_per_beam
        if rays > 2**28:
            raise ValueError(f"a ping has at most {2**28:,} rays: got {rays:,}; lower quality, beams or numbers of rays")
        return self

    def _check_coherent(self) -> None:
        if self.near_glow_db > 0 and self.noise_level_db is None:
            raise ValueError("near_glow_db stands above the noise: give noise_level_db too")
        if self.frequency_hz is None:
            raise ValueError("the model coherent needs the carrier: give frequency_hz, 1.8e6 for example")
        across = math.degrees(self.beam_width_rad) if scans(self) else self.azimuth_fov_deg
        if across > MOST_COHERENT_DEG or self.elevation_fov_deg > MOST_COHERENT_DEG:
            raise ValueError(
                f"the model coherent covers at most {MOST_COHERENT_DEG} x {MOST_COHERENT_DEG} deg: got "
                f"{self.azimuth_fov_deg:g} x {self.elevation_fov_deg:g}; use the model physical"
            )
        if self.beam_pattern == "box":
            raise ValueError("the model coherent needs a pattern of the beams: give pattern receive or two_way")
        band = Pulse(self.resolution_m).bandwidth_hz(self.sound_speed)
        if band > 2 * self.frequency_hz:
            raise ValueError(
                f"a range resolution of {self.resolution_m:.3g} m takes a band of {band:.3g} Hz, more than twice the "
                f"carrier: got frequency_hz {self.frequency_hz:g}; give it in Hz, at least {band / 2:.3g}, or a larger "
                "pulse_m"
            )

    def _check_aperture(self) -> None:
        length = self.aperture.length
        if length < LEAST_APERTURE:
            widest = math.degrees(length * self.beam_width_rad / LEAST_APERTURE)
            raise ValueError(
                f"an aperture is at least half a wavelength: a beam of {math.degrees(self.beam_width_rad):.3g} deg takes "
                f"{length:.2g}; give beam_width_deg below {math.floor(widest * 10) / 10:g}"
            )

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
    def beam_pattern(self) -> Pattern:
        """Return the pattern of the beams."""
        if self.model == "thesis":
            return "box"
        return self.pattern or ("two_way" if self.model == "coherent" else "box")

    @property
    def vertical_pattern(self) -> Pattern:
        """Return the pattern over elevation."""
        return "box" if self.model == "thesis" else self.elevation_pattern or self.beam_pattern

    @property
    def aperture(self) -> Aperture:
        """Return the array across the beams."""
        return Aperture(self.beam_width_rad, self.shading, self.beam_pattern != "receive")

    @property
    def resolution_m(self) -> float:
        """Return the range resolution [m]."""
        if self.bandwidth_hz is not None:
            return Pulse.of_band(self.bandwidth_hz, self.sound_speed).resolution_m
        return self.bin_m if self.pulse_m is None else self.pulse_m

    @property
    def value_coding(self) -> Coding:
        """Return how values stand for levels. With hard edges they are linear."""
        if self.beam_pattern == "box":
            return "linear"
        return self.coding or ("dB" if self.model == "coherent" else "linear")

    @property
    def across(self) -> int:
        """Return the rays across a beam that are traced: ``rays_across``, or one in the model ``thesis``."""
        return 1 if self.model == "thesis" else self.rays_across

    @property
    def jittered(self) -> bool:
        """Return whether rays move within their cells."""
        return self.model != "thesis" if self.jitter is None else self.jitter

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
