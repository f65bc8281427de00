"""Define the imaging sonar: its field of view, beams, rays, range window and signal model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, Self, TypeAlias

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from mitsonar.errors import MitsonarError, short_repr, suggest_names
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
    "crosstalk_amplitude",
    "first_sweeps",
    "frame_period_s",
    "group_of_beams",
    "measured_errors",
    "one_beam",
    "overlap_notes",
    "ping_interval_s",
    "ping_offsets_s",
    "rays_across",
    "rays_over_elevation",
    "scanned",
    "scans",
    "timed_path",
]


# ---------------- Ray counts and measured errors of a quality
# Sources of error in the physical model, measured by ``benchmarks/bench_quality.py``:
#
# Plain ground: a ray spreads its level evenly over the ranges that its elevation cell covers. Neighbouring cells join
# without gaps, so only the slope of the level within a cell is lost. The error grows with the relative length of a cell
# along range, ``dR / R = de / tan(grazing angle)``, whatever the range bins are. It falls faster than 1 / rays. More rays
# across the beam reduce the part of the error that comes from jitter.
#
# Textured ground, where a ray's cell is larger than a texture cell: each ray samples one random value. The error is the
# contrast of the texture over the square root of the number of rays per bin. That number is ``rays_across`` until an
# elevation cell is shorter than a bin. The error falls as 1 / sqrt(rays), and faster once the rays are denser than the
# texture. Rays are jittered anew for each ping, so even a stationary sonar sees this error fluctuate. It resembles speckle
# but is a sampling error.


FAR_GRAZING_RAD = math.asin(0.2)
"""Grazing angle on the reference ground at the far end of the window [rad]: the sonar's height is a fifth of that range."""

STEEPEST_RAD = math.radians(75)
"""Bearing beyond which the width of a beam has no effect [rad], since the ground leaves the window there."""

MOST_ACROSS = 4096


class RayCounts(NamedTuple):
    """Ray sampling requirements of a quality.

    Attributes:
        reach: longest range interval that the cell of one ray may cover on the reference ground, as a fraction of the range.
        apart_m: spacing of the rays across a beam at the far end of the window [m].
        across: largest number of rays across a beam, unless ``reach`` requires more.
    """

    reach: float
    apart_m: float
    across: int


QUALITIES: dict[str, RayCounts] = {
    "draft": RayCounts(0.03, math.inf, 1),
    "standard": RayCounts(0.01, 0.0075, 4),
    "fine": RayCounts(0.0025, 0.00375, 8),
}
"""Ray sampling requirements by quality, coarsest first."""


def _check_quality(name: object) -> object:
    if not isinstance(name, str) or name not in QUALITIES:
        raise ValueError(f"unknown quality {short_repr(name)}: {suggest_names(str(name)[:40], QUALITIES)}")
    return name


Quality = Annotated[Literal["draft", "standard", "fine"], BeforeValidator(_check_quality)]


def rays_over_elevation(quality: str, elevation_fov_rad: float) -> int:
    """Compute the number of rays over the elevation of a beam.

    The number is even, since segments halve the field of view. A cell of height ``de`` covers the fraction
    ``de / tan(grazing)`` of the range, which may be at most ``reach`` at the far end of the window.
    """
    needed = elevation_fov_rad / (math.tan(FAR_GRAZING_RAD) * QUALITIES[quality].reach)
    return 2 * math.ceil(needed / 2)


def rays_across(quality: str, beam_width_rad: float, azimuth_fov_rad: float, range_max: float) -> int:
    """Compute the number of rays across the width of a beam.

    Texture requires a ray spacing of ``apart_m`` at the far end of the window. Near the edge of a wide fan, the range to the
    ground varies across a beam by the fraction ``tan(bearing)`` times the beam width. Each ray may cover twice ``reach`` of
    that variation.
    """
    requirements = QUALITIES[quality]
    texture = min(requirements.across, math.ceil(beam_width_rad * range_max / requirements.apart_m))
    oblique = math.ceil(beam_width_rad * math.tan(min(azimuth_fov_rad / 2, STEEPEST_RAD)) / (2 * requirements.reach))
    return min(MOST_ACROSS, max(1, texture, oblique))


class Measured(NamedTuple):
    """Measured errors of a preset at one quality.

    Attributes:
        rays_per_beam: rays over elevation.
        rays_across: rays across a beam.
        plain_percent: rms error of the bins of a ping on plain ground, in % of their level.
        textured_percent: the same on ground of 15 mm cells with reflectivities uniform in 0..1, in % of the level of plain
            ground with the same mean.
        still_correlation: correlation of the levels of two pings from a stationary sonar over that ground, relative to plain
            ground.
    """

    rays_per_beam: int
    rays_across: int
    plain_percent: float
    textured_percent: float
    still_correlation: float


@cache
def measured_errors() -> tuple[str, dict[str, dict[str, Measured]]]:
    """Return the machine and date of the measurement, and the measured errors by preset and quality."""
    table = yaml.safe_load(files("mitsonar.instruments").joinpath("quality.yaml").read_text(encoding="utf-8"))
    errors = {
        preset: {quality: Measured(**numbers) for quality, numbers in rows.items()}
        for preset, rows in table["presets"].items()
    }
    return f"{table['machine']}, {table['date']}", errors


# ---------------- Timing: ping groups and scanning heads
# A frame may take several pings: 8 pings of 12 beams for a DIDSON, 4 to 8 pings for an ARIS. A mechanically scanned sonar
# rotates a single beam. Its frame is a sweep in which each beam is a separate ping. The time of a frame is the middle of its
# pings.


GroupOrder: TypeAlias = Literal["interleaved", "interleaved_starboard", "sequential"]


def check_groups(sonar: Sonar) -> None:
    """Check that a sonar has no more ping groups than beams.

    Raises:
        ValueError: more groups than beams.
    """
    if sonar.ping_groups > sonar.beams:
        raise ValueError(
            f"each ping group has a beam at least: got ping_groups {sonar.ping_groups} and beams {sonar.beams}; lower "
            "ping_groups"
        )


def scans(sonar: Sonar) -> bool:
    """Return whether the sonar has a rotating head, so that each beam is a separate ping."""
    return 1 < sonar.beams == sonar.ping_groups


def group_of_beams(sonar: Sonar) -> NDArray[np.int64]:
    """Return the index of the ping group of each beam ``(beams,)``; groups ping in the order of their indices."""
    beam = np.arange(sonar.beams)
    if sonar.group_order == "sequential":
        return beam * sonar.ping_groups // sonar.beams
    return (beam if sonar.group_order == "interleaved" else beam[::-1]) % sonar.ping_groups


CROSSTALK_FALL = 1 / 3
"""Exponent by which the amplitude of crosstalk falls with the distance between channels. The kernel of a DIDSON, by which
Teixeira et al. (2018, doi 10.1109/iros.2018.8594128) undo its crosstalk, is 1, 0.80, 0.68, 0.60 at distances 1 to 4."""


def crosstalk_amplitude(sonar: Sonar, crosstalk_db: float, groups: NDArray[np.int64] | None = None) -> NDArray[np.float64]:
    """Return the rms amplitudes with which beams leak into each other ``(from, to)``.

    They fall with the distance between the channels of a ping group. Over all pairs of a group, their mean square is
    ``crosstalk_db``.

    Args:
        sonar: the instrument.
        crosstalk_db: mean power of a pair [dB].
        groups: ping group of each beam ``(beams,)``; default: those of the sonar.
    """
    groups = group_of_beams(sonar) if groups is None else groups
    amplitude = np.zeros((sonar.beams, sonar.beams))
    for group in np.unique(groups):
        beams = np.flatnonzero(groups == group)
        channel = np.arange(len(beams))
        away = np.abs(channel[:, None] - channel)
        fall = np.where(away > 0, np.maximum(away, 1.0) ** -CROSSTALK_FALL, 0)
        if len(beams) > 1:
            fall *= 10 ** (crosstalk_db / 20) / math.sqrt(np.square(fall).sum() / (len(beams) * (len(beams) - 1)))
        amplitude[np.ix_(beams, beams)] = fall
    return amplitude


def ping_interval_s(sonar: Sonar) -> float:
    """Return the time between the pings of consecutive groups [s].

    This is ``group_interval_s`` if given, and otherwise the duration of the echo plus ``group_overhead_s``.
    """
    if sonar.group_interval_s is not None:
        return sonar.group_interval_s
    return 2 * sonar.range_max / sonar.sound_speed + sonar.group_overhead_s


def ping_offsets_s(sonar: Sonar) -> NDArray[np.float64]:
    """Return the times of the groups' pings relative to the middle of their frame ``(groups,)`` [s]."""
    middle = (sonar.ping_groups - 1) / 2
    return np.asarray((np.arange(sonar.ping_groups) - middle) * ping_interval_s(sonar), dtype=np.float64)


def frame_period_s(sonar: Sonar) -> float:
    """Return the time between frames [s]: the length of a sweep for a rotating head, else the inverse of the frame rate."""
    return sonar.ping_groups * ping_interval_s(sonar) if scans(sonar) else 1 / sonar.frame_rate_hz


def scanned(sonar: Sonar, *, sector_deg: float = 360.0, step_deg: float = 0.9, overhead_s: float = 0.0) -> Sonar:
    """Return a scanning sonar whose beams are the steps of a one-beam head that rotates from port to starboard.

    Each step is a ping with its own time and pose. It lasts ``2 range_max / sound_speed + overhead_s``. A frame is one
    sweep.

    Args:
        sonar: a sonar with one beam; its ``beam_width_deg``, or else its ``azimuth_fov_deg``, is the beam width.
        sector_deg: sector to sweep, at most 360 [deg], centred on 0 deg, which is straight ahead.
        step_deg: angle between beams [deg]; the sector must be a whole number of steps.
        overhead_s: time for rotation and reporting per step [s].

    Raises:
        MitsonarError: the sonar has more than one beam, or the sector is not a whole number of steps.
    """
    if sonar.beams != 1:
        raise MitsonarError(f"a rotating head has one beam: got {sonar.beams}; give a sonar with beams 1")
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
    """Return the single-beam sonar that the head of a scanning sonar rotates."""
    width = math.degrees(sonar.beam_width_rad)
    return sonar.replace(beams=1, azimuth_fov_deg=width, beam_width_deg=width, ping_groups=1)


@dataclass(frozen=True)
class TimedPath:
    """Times and poses of the pings of all frames.

    Attributes:
        frames: pose and time of each frame, at the middle of its pings.
        time_s: time of each ping ``(frames, groups)``, or ``(frames,)`` if a frame is one ping [s].
        poses: pose at each ping ``(frames, groups, 6)``, or ``(frames, 6)`` [m, rad].
    """

    frames: Trajectory
    time_s: NDArray[np.float64]
    poses: NDArray[np.float64]

    def of_beams(self, sonar: Sonar) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Return the time ``(frames, beams)`` and pose of each beam; ``(frames,)`` and None if a frame is one ping."""
        if self.time_s.ndim == 1:
            return self.time_s, None
        group = group_of_beams(sonar)
        return self.time_s[:, group], self.poses[:, group]


def timed_path(sonar: Sonar, path: Trajectory) -> TimedPath:
    """Compute the times and poses of all pings along a path.

    A frame is due at each time of the path. The poses of its pings are interpolated along the path, and extrapolated at
    constant velocity before its first and after its last pose. A scanning sonar sweeps continuously from the start of the
    path for as many whole sweeps as fit. Along a single pose it sweeps once.

    Raises:
        MitsonarError: the path is too short for a sweep, or its times do not increase.
    """
    if sonar.ping_groups == 1:
        return TimedPath(path, path.time_s, path.poses)
    # Times of the pings relative to the time of their frame.
    offsets = ping_offsets_s(sonar)
    due = path.time_s
    if scans(sonar) and len(path) > 1:
        sweep = ping_interval_s(sonar) * sonar.ping_groups
        duration_s = path.time_s[-1] - path.time_s[0]
        if duration_s < sweep * (1 - 1e-9):
            raise MitsonarError(f"a sweep lasts {sweep:.4g} s and the path {duration_s:.4g} s: give a longer path")
        # A scanning sonar sweeps without pauses, as often as the path allows.
        due = path.time_s[0] + (np.arange(int(duration_s / sweep + 1e-9)) + 0.5) * sweep
    # Extend the path, since the outer pings of the first and last frame lie beyond its ends.
    longer = path.extrapolated(-offsets[0])
    time = due[:, None] + offsets
    poses = longer.at(time.ravel()).reshape(*time.shape, 6)
    frames = path if due is path.time_s else Trajectory(longer.at(due), due)
    return TimedPath(frames, time, poses)


def first_sweeps(sonar: Sonar, path: Trajectory, count: int) -> Trajectory:
    """Return the part of a path that covers the first ``count`` sweeps of a scanning sonar.

    Raises:
        MitsonarError: the path is too short; a single pose counts as one sweep.
    """
    sweep, duration_s = frame_period_s(sonar), float(path.time_s[-1] - path.time_s[0])
    if duration_s < count * sweep * (1 - 1e-9) and (len(path) > 1 or count > 1):
        raise MitsonarError(
            f"a sweep lasts {sweep:.4g} s and the path {duration_s:.4g} s, room for {int(duration_s / sweep + 1e-9)}: got "
            f"{count}; --frames counts the sweeps of a rotating head: give fewer, or a longer path"
        )
    if len(path) == 1:
        return path
    end = path.time_s[0] + count * sweep
    inside = path.time_s < end
    return Trajectory(np.concatenate([path.poses[inside], path.at([end])]), np.concatenate([path.time_s[inside], [end]]))


def overlap_notes(sonar: Sonar, time_s: NDArray[np.float64]) -> list[str]:
    """Return a warning if the pings of a frame last beyond the start of the next frame, which no real instrument allows.

    Args:
        sonar: the instrument that makes the frames.
        time_s: times of the frames ``(frames,)`` [s].
    """
    duration_s = sonar.ping_groups * ping_interval_s(sonar)
    interval_s = np.diff(time_s).min(initial=np.inf)
    if sonar.ping_groups == 1 or scans(sonar) or duration_s <= interval_s * (1 + 1e-6):
        return []
    rate = _format_rounded_down(1 / duration_s)
    return [
        f"the {sonar.ping_groups} pings of a frame last {duration_s:.3g} s and the next frame is due {interval_s:.3g} s "
        f"later: they overlap, which no instrument can do; lower frame_rate_hz to {rate} (or the rate of the poses in the "
        "file), or range_max"
    ]


def _format_rounded_down(value: float) -> str:
    """Format a number with three significant digits, rounded down."""
    step = 10.0 ** (math.floor(math.log10(value)) - 2)
    return f"{math.floor(value / step) * step:.3g}"


def turned_heads(sonar: Sonar, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the head poses of a scanning sonar from the vehicle poses, both ``(frames, beams, 6)``."""
    head_poses = np.empty_like(poses)
    group = group_of_beams(sonar)
    for beam, bearing in enumerate(sonar.bearing_rad):
        head_poses[:, group[beam]] = mounted(poses[:, group[beam]], Pose(0, 0, 0, heading=float(bearing)))
    return head_poses


# ---------------- Imaging sonar


FieldValue: TypeAlias = Any
"""Value of an instrument field before pydantic validates it."""

Model = Literal["coherent", "physical", "thesis"]
Coding = Literal["linear", "dB", "gamma"]
Bearing = Literal["azimuth", "cone"]
SEE = " (see `mitsonar presets --help` and docs/reference/plugins.md)"
RAYS = ("rays_per_beam", "rays_across")
"""Fields that are derived from ``quality`` unless given."""

LEAST_APERTURE = 0.5
"""Shortest aperture that has a beam pattern [wavelengths]."""

MOST_BINS = 1_000_000
"""Largest number of range bins."""

MOST_COHERENT_DEG = 170
"""Largest field of view of the coherent model, whose rays are evenly spaced in the sine and tangent of angles [deg]."""

THESIS_ACROSS = 4
"""Value of ``rays_across`` in the ``thesis`` model, which nevertheless traces one ray."""


def _rays_over_elevation(fields: dict[str, FieldValue]) -> int:
    """Derive the number of rays over elevation from the other fields."""
    if fields["model"] == "thesis":
        return int(fields["thesis_rays"])
    return rays_over_elevation(fields["quality"], math.radians(fields["elevation_fov_deg"]))


def _rays_across(fields: dict[str, FieldValue]) -> int:
    """Derive the number of rays across a beam from the other fields."""
    if fields["model"] == "thesis":
        return THESIS_ACROSS
    fov = math.radians(fields["azimuth_fov_deg"])
    width = fov / fields["beams"] if fields["beam_width_deg"] is None else math.radians(fields["beam_width_deg"])
    return rays_across(fields["quality"], width, fov, fields["range_max"])


UNNAMED = "custom"
"""Name of an instrument for which none was given."""


class Instrument(CheckedModel):
    """Base class of all instruments."""

    name: str = Field(UNNAMED, description="name of the instrument")

    if TYPE_CHECKING:  # subclasses define these at different positions among their fields
        model: str
        frame_rate_hz: float

    @property
    def title(self) -> str:
        """Return the name for titles and sentences, or ``unnamed`` with the type of instrument: ``unnamed sonar``."""
        return f"unnamed {self.called}" if self.name == UNNAMED else self.name

    def replace(self, **fields: FieldValue) -> Self:
        """Return a copy with some fields changed; all fields are validated.

        Raises:
            MitsonarError: an unknown key, or a value outside its limits.
        """
        return self.create(**{**self.model_dump(), **fields})

    def __str__(self) -> str:
        return repr(self)


class Sonar(Instrument):
    """An imaging sonar, with angles in degrees and all other quantities in SI units.

    The same names serve as XML properties of the sensor ``imaging_sonar`` and as keys of a sonar's YAML file
    (``docs/reference/plugins.md``).

    In the physical and coherent models, ``rays_per_beam`` and ``rays_across`` are derived from ``quality``. In the
    ``thesis`` model they are ``thesis_rays`` and one. Explicit values take precedence.

    Raises:
        MitsonarError: from :meth:`create`, for an unknown key or a value outside its limits.
    """

    called: ClassVar[str] = "sonar"
    see: ClassVar[str] = SEE

    azimuth_fov_deg: float = Field(29.0, gt=0, le=360, description="field of view across the beams [deg]")
    elevation_fov_deg: float = Field(14.0, gt=0, le=180, description="field of view within a beam [deg]")
    beams: int = Field(96, ge=1, le=65_536, description="number of beams")
    range_min: float = Field(3.2, ge=0, le=1e5, description="start of the window [m]")
    range_max: float = Field(5.6, gt=0, le=1e5, description="end of the window [m], beyond range_min")
    range_bins: int = Field(512, ge=1, le=MOST_BINS, description="range bins of the window")
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
        "interleaved",
        description="beam k, from port or (interleaved_starboard) from starboard, in group k mod ping_groups; sequential: "
        "neighbours in one group",
    )
    group_interval_s: float | None = Field(
        None, ge=0, le=1e3, description="from the ping of a group to the next [s]; default: 2 range_max / sound_speed"
    )
    group_overhead_s: float = Field(
        0.0, ge=0, le=1e3, description="what a ping takes beyond its echo [s], where group_interval_s is not given"
    )
    quality: Quality = Field(
        "standard", description="rays of `physical`: draft, standard or fine; `mitsonar presets` prints the errors of each"
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
    looks: int = Field(
        1, ge=1, le=16, description="powers of shorter pulses that a bin averages, of pulse_m / looks each (coherent)"
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
        None, ge=0, le=1e3, description="one way [dB/m]; default: by frequency and water with a pattern, else 0"
    )
    temperature_c: float = Field(10.0, ge=-2, le=40, description="of the water [deg C]")
    salinity_psu: float = Field(35.0, ge=0, le=45, description="of the water [parts per thousand]")
    water_depth_m: float = Field(10.0, ge=0, le=12_000, description="depth of the sonar in the water [m]")
    ph: float = Field(8.0, ge=6, le=9, description="acidity of the water")
    gain_absorption: bool = Field(False, description="the gain undoes absorption there and back too")
    crosstalk_db: float | None = Field(
        None, ge=-120, le=0, description="rms leak of a beam into another of its ping group [dB] (coherent); default: none"
    )
    stripes_db: float = Field(0.0, ge=0, le=20, description="spread of the beams' gains, by the seed [dB] (coherent)")
    taper_db: float = Field(
        0.0,
        ge=-60,
        le=60,
        description="gain of the middle beam over the outermost, as the square of the bearing [dB] (coherent)",
    )
    group_stripes_db: float = Field(
        0.0, ge=0, le=20, description="spread of the ping groups' gains, by the seed [dB] (coherent)"
    )
    tail_db: float | None = Field(
        None, ge=-120, le=0, description="power of what follows an echo, relative to it [dB] (coherent); default: none"
    )
    tail_m: float = Field(0.1, gt=0, le=100, description="range over which tails fall by the factor e of power [m]")
    saturation_db: float | None = Field(
        None, ge=-300, le=300, description="level at which the array's elements clip [dB re 1 uPa] (coherent); default: none"
    )
    array_error: float = Field(
        0.0, ge=0, le=1, description="rms error of the array's elements, relative to their amplitude, by the seed (coherent)"
    )
    detector_offset_db: float | None = Field(
        None, ge=-300, le=300, description="constant power that the detector adds [dB re 1 uPa] (coherent); default: none"
    )
    detector_spread_db: float = Field(
        0.0, ge=0, le=20, description="spread of the beams' detector_offset_db, by the seed [dB] (coherent)"
    )
    coding: Coding | None = Field(
        None,
        description="how image values encode levels (with a pattern): linear, dB, gamma; default: coherent dB, else linear",
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
        outermost = self.bearing_rad[-1] + self.beam_width_rad / 2
        if self.bearing == "cone" and outermost > math.radians(90) + 1e-9:
            raise ValueError(
                f"a cone's beams end at 90 deg: the outermost reaches {math.degrees(outermost):.4g} deg; lower "
                "azimuth_fov_deg or beam_width_deg"
            )
        if self.beams * self.range_bins > 2**28:
            raise ValueError(
                f"an image has at most {2**28:,} cells: got {self.beams * self.range_bins:,}; lower beams or range_bins"
            )
        if self.pulse_m is not None and self.bandwidth_hz is not None:
            raise ValueError("pulse_m and bandwidth_hz both set the range resolution: give one of them")
        check_groups(self)
        if self.bounces > 1 and self.model == "thesis":
            raise ValueError(
                f"the model thesis supports one reflection: got bounces {self.bounces}; omit bounces, or use physical or "
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
            raise ValueError("near_glow_db is relative to noise_level_db: give noise_level_db too")
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
        band = Pulse(self.resolution_m / self.looks).bandwidth_hz(self.sound_speed)
        if band > 2 * self.frequency_hz:
            several = f" by {self.looks} looks" if self.looks > 1 else ""
            raise ValueError(
                f"a range resolution of {self.resolution_m:.3g} m{several} takes a band of {band:.3g} Hz, more than twice "
                f"the carrier: got frequency_hz {self.frequency_hz:g}; give it in Hz, at least {band / 2:.3g}, or a larger "
                f"pulse_m{' or fewer looks' if several else ''}"
            )
        if self.range_bins * self.looks > MOST_BINS:
            raise ValueError(
                f"range_bins times looks are at most {MOST_BINS:,}: got {self.range_bins:,} x {self.looks}; lower looks"
            )

    def _check_aperture(self) -> None:
        if self.azimuth_fov_deg > 180 and not scans(self):
            raise ValueError(
                "an array does not distinguish ahead from astern, so that its pattern covers at most 180 deg: got "
                f"azimuth_fov_deg {self.azimuth_fov_deg:g}; use pattern box, or ping_groups {self.beams} for a rotating head"
            )
        length = self.aperture.length
        if length < LEAST_APERTURE:
            widest = math.degrees(length * self.beam_width_rad / LEAST_APERTURE)
            raise ValueError(
                f"an aperture is at least half a wavelength: a beam of {math.degrees(self.beam_width_rad):.3g} deg takes "
                f"{length:.2g}; give beam_width_deg below {math.floor(widest * 10) / 10:g}"
            )

    def replace(self, **fields: FieldValue) -> Self:
        """Return a copy with some fields changed; all fields are validated.

        Ray counts that are derived from other fields are recomputed. Except in the ``thesis`` model, a new ``quality`` also
        replaces ray counts that were set explicitly. Ray counts passed together with it take precedence.
        """
        values = self.model_dump()
        derive_rays = "quality" in fields and fields.get("model", self.model) != "thesis"
        for name in RAYS:
            if derive_rays or name not in self.model_fields_set:
                del values[name]
        return self.create(**{**values, **fields})

    @property
    def beam_pattern(self) -> Pattern:
        """Return the beam pattern across the beams."""
        if self.model == "thesis":
            return "box"
        return self.pattern or ("two_way" if self.model == "coherent" else "box")

    @property
    def vertical_pattern(self) -> Pattern:
        """Return the beam pattern over elevation."""
        return "box" if self.model == "thesis" else self.elevation_pattern or self.beam_pattern

    @property
    def aperture(self) -> Aperture:
        """Return the aperture of the array across the beams."""
        error = self.array_error if self.model == "coherent" else 0.0
        return Aperture(self.beam_width_rad, self.shading, self.beam_pattern != "receive", error, self.seed)

    @property
    def resolution_m(self) -> float:
        """Return the range resolution [m]."""
        if self.bandwidth_hz is not None:
            return Pulse.of_band(self.bandwidth_hz, self.sound_speed).resolution_m
        return self.bin_m if self.pulse_m is None else self.pulse_m

    @property
    def value_coding(self) -> Coding:
        """Return how image values encode levels; box patterns are always linear."""
        if self.beam_pattern == "box":
            return "linear"
        return self.coding or ("dB" if self.model == "coherent" else "linear")

    @property
    def across(self) -> int:
        """Return the number of rays traced across a beam: ``rays_across``, or one in the ``thesis`` model."""
        return 1 if self.model == "thesis" else self.rays_across

    @property
    def jittered(self) -> bool:
        """Return whether rays are jittered within their cells."""
        return self.model != "thesis" if self.jitter is None else self.jitter

    @property
    def columns(self) -> int:
        """Return the number of rays side by side, which is the width of the film."""
        return self.beams * self.across

    @property
    def rays(self) -> int:
        """Return the number of rays per ping."""
        return self.columns * self.rays_per_beam

    @property
    def beam_spacing_rad(self) -> float:
        """Return the azimuth field of view per beam [rad]; for even beams, the angle between neighbouring axes."""
        return math.radians(self.azimuth_fov_deg) / self.beams

    @property
    def beam_width_rad(self) -> float:
        """Return the width of the ray fan of one beam [rad], which is the beam spacing in the ``thesis`` model."""
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
        """Return the bearings of the beam axes ``(beams,)`` [rad], from port to starboard."""
        part = (np.arange(self.beams) + 0.5) / self.beams * 2 - 1  # -1..1 across the fan
        half = math.radians(self.azimuth_fov_deg) / 2
        axes = part * half if self.beam_layout == "even" else np.arcsin(part * math.sin(half))
        return np.asarray(axes, dtype=np.float64)
