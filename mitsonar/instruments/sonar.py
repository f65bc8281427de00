"""The imaging sonar: field of view, beams, rays, window, and the model that is computed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, Self, TypeAlias

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from mitsonar.errors import MitsonarError, nearest_names, shortened
from mitsonar.instruments.beams import Aperture, Pattern, Pulse, Shading
from mitsonar.io.checked_model import CheckedModel
from mitsonar.motion.pose import Pose, mounted
from mitsonar.motion.trajectory import Trajectory

__all__ = [
    "FAR_GRAZING_RAD",
    "QUALITIES",
    "RAYS",
    "Bearing",
    "Coding",
    "FieldValue",
    "GroupOrder",
    "Instrument",
    "Measured",
    "Model",
    "Quality",
    "Sonar",
    "TimedPath",
    "check_groups",
    "first_sweeps",
    "frame_period_s",
    "group_of_beams",
    "measured_errors",
    "one_beam",
    "overlap_notes",
    "ping_interval_s",
    "rays_across",
    "rays_over_elevation",
    "scanned",
    "scans",
    "timed_path",
]


# ---------------- Number of rays for an accuracy, and the measured error of each quality
# Errors of the physical model, from ``benchmarks/bench_quality.py``:
#
# Plain ground: a ray spreads its level evenly over the ranges that its cell of elevation covers. Cells join without
# gap, so only the slope of the level within a cell is lost. The error grows with the cell's length along range as a
# part of the range, ``dR / R = de / tan(grazing angle)``, whatever the range bins are. It falls faster than 1 / rays,
# and more rays across lower the part of the error that is jitter.
#
# Textured ground, where a ray's cell is larger than a cell of the texture: each ray reads one value at random. The
# error is the texture's contrast over the square root of the rays in one bin. These are ``rays_across`` until an
# elevation cell is shorter than a bin. The error falls as 1 / sqrt(rays), and faster once rays are denser than the
# texture. Rays jitter anew each ping, so a sonar at rest sees this error change. It looks like speckle, and is none.


FAR_GRAZING_RAD = math.asin(0.2)
"""Grazing angle on the reference ground at the window's far end [rad]; the sonar is a fifth of that range above it."""

STEEPEST_RAD = math.radians(75)
"""Bearing beyond which a beam's width has no effect [rad]: the ground leaves the window there."""

MOST_ACROSS = 4096


class RayCounts(NamedTuple):
    """Requirements of a quality on the rays.

    Attributes:
        reach: longest range interval of one ray's cell on the reference ground, as a part of the range.
        apart_m: distance of rays across a beam at the far end of the window [m].
        across: rays across a beam at most, unless ``reach`` needs more.
    """

    reach: float
    apart_m: float
    across: int


QUALITIES: dict[str, RayCounts] = {
    "draft": RayCounts(0.03, math.inf, 1),
    "standard": RayCounts(0.01, 0.0075, 4),
    "fine": RayCounts(0.0025, 0.00375, 8),
}
"""Requirements of each quality, coarsest first."""


def _known(name: object) -> object:
    if not isinstance(name, str) or name not in QUALITIES:
        raise ValueError(f"unknown quality {shortened(name)}: {nearest_names(str(name)[:40], QUALITIES)}")
    return name


Quality = Annotated[Literal["draft", "standard", "fine"], BeforeValidator(_known)]


def rays_over_elevation(quality: str, elevation_fov_rad: float) -> int:
    """Compute the number of rays over a beam's elevation. It is even, since segments halve the field of view.

    A cell of height ``de`` covers ``de / tan(grazing)`` of the range. At the far end of the window it may cover ``reach``.
    """
    needed = elevation_fov_rad / (math.tan(FAR_GRAZING_RAD) * QUALITIES[quality].reach)
    return 2 * math.ceil(needed / 2)


def rays_across(quality: str, beam_width_rad: float, azimuth_fov_rad: float, range_max: float) -> int:
    """Compute the number of rays across a beam's width.

    Texture needs rays ``apart_m`` apart at the far end. At the edge of a wide fan the ground's range changes across a beam
    by the part ``tan(bearing)`` times the beam's width. Each ray may cover twice ``reach`` of it.
    """
    wanted = QUALITIES[quality]
    texture = min(wanted.across, math.ceil(beam_width_rad * range_max / wanted.apart_m))
    oblique = math.ceil(beam_width_rad * math.tan(min(azimuth_fov_rad / 2, STEEPEST_RAD)) / (2 * wanted.reach))
    return min(MOST_ACROSS, max(1, texture, oblique))


class Measured(NamedTuple):
    """Measured errors of a quality of a preset.

    Attributes:
        rays_per_beam: over elevation.
        rays_across: across a beam.
        plain_percent: rms error of a ping's bins on plain ground, in % of their level.
        textured_percent: on ground of 15 mm cells with reflectivities spread evenly over 0..1, in % of the level of plain
            ground of the same mean.
        still_correlation: of the levels of two pings of a sonar at rest over that ground, relative to plain ground.
    """

    rays_per_beam: int
    rays_across: int
    plain_percent: float
    textured_percent: float
    still_correlation: float


@cache
def measured_errors() -> tuple[str, dict[str, dict[str, Measured]]]:
    """Read the machine and date of the measurement, and the measured errors by preset and quality."""
    table = yaml.safe_load(files("mitsonar.instruments").joinpath("quality.yaml").read_text(encoding="utf-8"))
    found = {
        preset: {quality: Measured(**numbers) for quality, numbers in rows.items()}
        for preset, rows in table["presets"].items()
    }
    return f"{table['machine']}, {table['date']}", found


# ---------------- Frames that take time: groups of beams that ping one after another, and heads that turn from beam
# to beam
# A frame of a DIDSON is 8 pings of 12 beams, one of an ARIS 4 to 8 pings. A mechanically scanned sonar has one beam and
# turns it: its frame is a sweep, each beam of which is a ping of its own. The time of a frame is the middle of its pings.


GroupOrder: TypeAlias = Literal["interleaved", "sequential"]


def check_groups(sonar: Sonar) -> None:
    """Check the ping groups of a sonar.

    Raises:
        ValueError: more groups than beams.
    """
    if sonar.ping_groups > sonar.beams:
        raise ValueError(
            f"each ping group has a beam at least: got ping_groups {sonar.ping_groups} and beams {sonar.beams}; lower "
            "ping_groups"
        )


def scans(sonar: Sonar) -> bool:
    """Return whether each beam is a ping of its own: a head that turns."""
    return 1 < sonar.beams == sonar.ping_groups


def group_of_beams(sonar: Sonar) -> NDArray[np.int64]:
    """Return the number of the group of each beam ``(beams,)``; groups ping in the order of their numbers."""
    beam = np.arange(sonar.beams)
    return beam % sonar.ping_groups if sonar.group_order == "interleaved" else beam * sonar.ping_groups // sonar.beams


def ping_interval_s(sonar: Sonar) -> float:
    """Return the time from the ping of one group to that of the next [s]: as given, or echo and overhead."""
    if sonar.group_interval_s is not None:
        return sonar.group_interval_s
    return 2 * sonar.range_max / sonar.sound_speed + sonar.group_overhead_s


def frame_period_s(sonar: Sonar) -> float:
    """Return the time from frame to frame [s]: one over the frame rate, of a head that turns its sweep."""
    return sonar.ping_groups * ping_interval_s(sonar) if scans(sonar) else 1 / sonar.frame_rate_hz


def scanned(sonar: Sonar, *, sector_deg: float = 360.0, step_deg: float = 0.9, overhead_s: float = 0.0) -> Sonar:
    """Return the sonar whose beams are the steps of a head that turns a one-beam sonar from port to starboard.

    Each step is a ping with its own time and pose. It lasts ``2 range_max / sound_speed + overhead_s``. A frame is a sweep.

    Args:
        sonar: with one beam; ``beam_width_deg``, or its ``azimuth_fov_deg``, is the width of the beam.
        sector_deg: that is swept, at most 360 [deg]; 0 deg is ahead, in its middle.
        step_deg: from beam to beam [deg]; the sector must be a whole number of them.
        overhead_s: for turning and reporting, a step [s].

    Raises:
        MitsonarError: more beams than one; a sector that is no whole number of steps.
    """
    if sonar.beams != 1:
        raise MitsonarError(f"a head that turns has one beam: got {sonar.beams}; give a sonar with beams 1")
    steps = round(sector_deg / step_deg) if step_deg > 0 and 0 < sector_deg <= 360 else 0
    if steps < 2 or not math.isclose(steps * step_deg, sector_deg, rel_tol=1e-6):
        raise MitsonarError(
            f"a sector of at most 360 deg is a whole number of steps: got {sector_deg:g} deg and steps of {step_deg:g} deg"
        )
    if not 0 <= overhead_s < math.inf:
        raise MitsonarError(f"the overhead of a step must be 0 s or more: got {overhead_s:g}")
    interval = 2 * sonar.range_max / sonar.sound_speed + overhead_s
    return sonar.replace(
        beams=steps,
        azimuth_fov_deg=sector_deg,
        beam_width_deg=math.degrees(sonar.beam_width_rad),
        bearing="azimuth",
        beam_layout="even",
        ping_groups=steps,
        group_order="sequential",
        group_interval_s=None,
        group_overhead_s=overhead_s,
        frame_rate_hz=1 / (steps * interval),
    )


def one_beam(sonar: Sonar) -> Sonar:
    """Return the one beam that a head turns, of a sonar that scans."""
    width = math.degrees(sonar.beam_width_rad)
    return sonar.replace(beams=1, azimuth_fov_deg=width, beam_width_deg=width, ping_groups=1)


@dataclass(frozen=True)
class TimedPath:
    """The pings of all frames.

    Attributes:
        frames: pose and time of each frame, the middle of its pings.
        time_s: of each ping ``(frames, groups)``, or ``(frames,)`` where a frame is one ping [s].
        poses: of each ping ``(frames, groups, 6)``, or ``(frames, 6)`` [m, rad].
    """

    frames: Trajectory
    time_s: NDArray[np.float64]
    poses: NDArray[np.float64]

    def of_beams(self, sonar: Sonar) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Return the time of each beam ``(frames, beams)`` and its pose; ``(frames,)`` and None for one ping a frame."""
        if self.time_s.ndim == 1:
            return self.time_s, None
        group = group_of_beams(sonar)
        return self.time_s[:, group], self.poses[:, group]


def timed_path(sonar: Sonar, path: Trajectory) -> TimedPath:
    """Return the pings of all frames along a path.

    A frame is due at each time of the path. Poses of its pings lie between those of the path; before its first and after
    its last one the vehicle goes on as beside it. A head that turns sweeps without a pause from the path's begin on, as
    often as the path is long; along a single pose it sweeps once.

    Raises:
        MitsonarError: a path that is too short for a sweep, or whose times do not grow.
    """
    if sonar.ping_groups == 1:
        return TimedPath(path, path.time_s, path.poses)
    offsets = (np.arange(sonar.ping_groups) - (sonar.ping_groups - 1) / 2) * ping_interval_s(sonar)
    due = path.time_s
    if scans(sonar) and len(path) > 1:
        sweep = ping_interval_s(sonar) * sonar.ping_groups
        lasts = path.time_s[-1] - path.time_s[0]
        if lasts < sweep * (1 - 1e-9):
            raise MitsonarError(f"a sweep lasts {sweep:.4g} s and the path {lasts:.4g} s: give a longer path")
        due = path.time_s[0] + (np.arange(int(lasts / sweep + 1e-9)) + 0.5) * sweep
    longer = path.lengthened(-offsets[0])
    time = due[:, None] + offsets
    poses = longer.at(time.ravel()).reshape(*time.shape, 6)
    frames = path if due is path.time_s else Trajectory(longer.at(due), due)
    return TimedPath(frames, time, poses)


def first_sweeps(sonar: Sonar, path: Trajectory, count: int) -> Trajectory:
    """Return the part of a path along which a head that turns makes its first ``count`` sweeps.

    Raises:
        MitsonarError: the path is shorter; a single pose counts as one sweep.
    """
    sweep, lasts = frame_period_s(sonar), float(path.time_s[-1] - path.time_s[0])
    if lasts < count * sweep * (1 - 1e-9) and (len(path) > 1 or count > 1):
        raise MitsonarError(
            f"a sweep lasts {sweep:.4g} s and the path {lasts:.4g} s, room for {int(lasts / sweep + 1e-9)}: got {count}; "
            "--frames counts the sweeps of a head that turns: give fewer, or a longer path"
        )
    if len(path) == 1:
        return path
    end = path.time_s[0] + count * sweep
    inside = path.time_s < end
    return Trajectory(np.concatenate([path.poses[inside], path.at([end])]), np.concatenate([path.time_s[inside], [end]]))


def overlap_notes(sonar: Sonar, time_s: NDArray[np.float64]) -> list[str]:
    """Return what to tell where the pings of a frame last longer than the time to the next frame: no instrument pings so.

    Args:
        sonar: whose frames follow each other.
        time_s: of the frames ``(frames,)`` [s].
    """
    lasts = sonar.ping_groups * ping_interval_s(sonar)
    apart = np.diff(time_s).min(initial=np.inf)
    if sonar.ping_groups == 1 or scans(sonar) or lasts <= apart * (1 + 1e-6):
        return []
    return [
        f"the {sonar.ping_groups} pings of a frame last {lasts:.3g} s and the next frame is due {apart:.3g} s later: they "
        f"overlap, which no instrument does; a frame_rate_hz of {_down(1 / lasts)} would do (of poses in a file, that many "
        "a second), or a shorter range_max"
    ]


def _down(value: float) -> str:
    """Return a number to three digits, rounded down."""
    step = 10.0 ** (math.floor(math.log10(value)) - 2)
    return f"{math.floor(value / step) * step:.3g}"


def turned_heads(sonar: Sonar, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses of the head of a sonar that scans, from those of the vehicle, both ``(frames, beams, 6)``."""
    found = np.empty_like(poses)
    group = group_of_beams(sonar)
    for beam, bearing in enumerate(sonar.bearing_rad):
        found[:, group[beam]] = mounted(poses[:, group[beam]], Pose(0, 0, 0, heading=float(bearing)))
    return found


# ---------------- imaging sonar


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
