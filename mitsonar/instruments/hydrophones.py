"""Define the instrument of impulse responses: transmitter, receivers, fields of view, and the signal band."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.fft import next_fast_len

from mitsonar.arrays import AnyArray
from mitsonar.errors import MitsonarError, short_repr
from mitsonar.instruments.sonar import FieldValue, Instrument
from mitsonar.io.checked_model import CheckedModel
from mitsonar.motion.pose import vehicle_rotation

__all__ = [
    *("HALF_POWER", "LINE_NULLS", "RECEIVER_HEADINGS_DEG", "NUMPY", "PADDING", "ChannelModel", "ChannelSonar"),
    *("FieldOfView", "Hydrophone", "Maths", "four_receivers", "side_looking_array"),
]

ChannelModel = Literal["scatterers", "rays"]
SEE = " (see docs/reference/plugins.md)"

PADDING = 2
"""Oversampling factor of the frequency response.

Pulse tails before t = 0 then wrap into a part that is cropped.
"""


class Maths(NamedTuple):
    """Functions of the array library with which fields of view are computed."""

    asin: Callable[..., AnyArray]
    atan2: Callable[..., AnyArray]
    sin: Callable[..., AnyArray]
    cos: Callable[..., AnyArray]
    clip: Callable[..., AnyArray]
    where: Callable[..., AnyArray]


NUMPY = Maths(np.arcsin, np.arctan2, np.sin, np.cos, np.clip, np.where)

HALF_POWER = 0.44294647
"""x at which sinc(x)^2 is 1/2: the half-power point of a line in one direction."""

LINE_NULLS = 2
"""Null of the pattern of a line beyond which it counts as deaf; two-way lobes there lie below -35 dB."""


class FieldOfView(CheckedModel):
    """Field of view of a transducer in the vehicle's axes (starboard, forward, up), and its sensitivity.

    Shapes: ``rectangular`` extends ``across_deg`` across a vertical plane and ``along_deg`` within it; ``circular`` is a
    cone of diameter ``across_deg``; ``all`` covers every direction; ``line`` is the pattern sinc(L sin(angle) / wavelength)
    of a line of length L across a vertical plane, with half-power width ``across_deg`` and with side lobes up to the null
    number :data:`LINE_NULLS`, and ``along_deg`` within the plane. The centre is tilted by ``tilt_deg`` from straight down,
    towards ``heading_deg``.

    The amplitude sensitivity is 1 in the centre and 0 at the edges. It falls like half a period of a cosine over the outer
    fraction ``taper`` of each half width, of a ``line`` only within the plane. A ``taper`` of 0 is a hard edge, which acts
    as an echo that moves with the vehicle.
    """

    called: ClassVar[str] = "field of view"

    shape: Literal["rectangular", "circular", "all", "line"] = Field("rectangular", description="of the field of view")
    heading_deg: float = Field(0.0, ge=-360, le=360, description="where it looks: 0 forward, 90 to starboard [deg]")
    tilt_deg: float = Field(25.0, ge=0, le=180, description="of its middle, from straight down [deg]")
    across_deg: float = Field(
        10.0, gt=0, le=180, description="whole width across; of a circle its diameter; half-power width of a line [deg]"
    )
    along_deg: float = Field(50.0, gt=0, le=180, description="whole width in the vertical plane [deg]")
    taper: float = Field(0.5, ge=0, le=1, description="part of each half width over which sensitivity falls to 0")

    @classmethod
    def of_line(cls, length_m: float, wavelength_m: float, **keys: FieldValue) -> Self:
        """Create the field of view of a line of a given length [m], which must exceed the wavelength [m].

        Args:
            length_m: length of the element across the vertical plane.
            wavelength_m: wavelength of the carrier.
            keys: other fields, such as ``heading_deg``.

        Raises:
            MitsonarError: the line is not longer than a wavelength, or other fields are not valid.
        """
        if not length_m > wavelength_m > 0:
            raise MitsonarError(
                f"the element must be longer than a wavelength, {wavelength_m:.3g} m: got {length_m:g} m; lengthen it, or "
                "raise the carrier"
            )
        width = 2 * math.degrees(math.asin(HALF_POWER * wavelength_m / length_m))
        return cls.create(shape="line", across_deg=width, **keys)

    @property
    def wavelengths(self) -> float:
        """Return the length of a ``line`` in wavelengths."""
        return HALF_POWER / math.sin(math.radians(self.across_deg) / 2)

    @property
    def half_across_rad(self) -> float:
        """Return the angle across beyond which nothing is received [rad]."""
        if self.shape == "line":
            return math.asin(min(1.0, LINE_NULLS / self.wavelengths))
        return math.radians(self.across_deg) / 2

    @property
    def axes(self) -> NDArray[np.float64]:
        """Return the axes of the field of view in the vehicle's axes, as rows ``(3, 3)``.

        The rows are the centre, the side (clockwise seen from above), and up.
        """
        turn, tilt = math.radians(self.heading_deg), math.radians(self.tilt_deg)
        level = np.array([math.sin(turn), math.cos(turn), 0.0])
        side = np.array([math.cos(turn), -math.sin(turn), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        return np.stack([math.sin(tilt) * level - math.cos(tilt) * up, side, math.cos(tilt) * level + math.sin(tilt) * up])

    def sensitivity(self, ahead: AnyArray, aside: AnyArray, above: AnyArray, maths: Maths = NUMPY) -> AnyArray:
        """Return the sensitivity to sound from a unit direction, given in components along :attr:`axes`.

        It is 0..1; the odd side lobes of a line have the opposite sign.
        """
        if self.shape == "all":
            return ahead * 0 + 1
        half_across = self.half_across_rad
        if self.shape == "circular":
            off = maths.atan2((aside * aside + above * above) ** 0.5, ahead)
            return self._fall(off / half_across, maths)
        along = abs(maths.atan2(above, ahead)) / (math.radians(self.along_deg) / 2)
        if self.shape == "line":
            return self._line(aside, maths) * self._fall(along, maths)
        across = maths.asin(maths.clip(aside, -1, 1))
        return self._fall(abs(across) / half_across, maths) * self._fall(along, maths)

    def _line(self, sine: AnyArray, maths: Maths) -> AnyArray:
        """Return sinc of the length in wavelengths times a sine, up to the last null."""
        x = sine * (math.pi * self.wavelengths)
        near = abs(x) < 1e-3  # the series is exact there in single precision
        lobes = maths.where(near, 1 - x * x / 6, maths.sin(x) / maths.where(near, x * 0 + 1, x))
        return maths.where(abs(x) < math.pi * LINE_NULLS, lobes, 0)

    def directions(self, count: int) -> NDArray[np.float64]:
        """Sample unit directions of the field of view, edges included, in the vehicle's axes ``(count**2, 3)``."""
        part = np.linspace(-1, 1, count)
        match self.shape:
            case "rectangular" | "line":
                side = np.sin(self.half_across_rad * part)[:, None]
                up = math.radians(self.along_deg) / 2 * part
                ahead = np.sqrt(1 - side**2)
                local = np.stack(np.broadcast_arrays(ahead * np.cos(up), side, ahead * np.sin(up)), axis=-1)
            case kind:
                off = math.radians(self.across_deg) / 2 if kind == "circular" else math.pi
                tilt, turn = np.meshgrid(off * (part + 1) / 2, np.pi * part)
                local = np.stack([np.cos(tilt), np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn)], axis=-1)
        return np.asarray(local.reshape(-1, 3) @ self.axes)

    def may_see(self, ahead: AnyArray, aside: AnyArray, above: AnyArray, margin: AnyArray) -> NDArray[np.bool_]:
        """Return whether a point within ``margin`` [rad] of a unit direction, in :attr:`axes` components, may be in view."""
        if self.shape == "all":
            return np.ones(np.shape(ahead), dtype=bool)
        half_across = self.half_across_rad
        if self.shape == "circular":
            return np.asarray(np.arctan2(np.hypot(aside, above), ahead) <= half_across + margin)
        across = np.abs(np.arcsin(np.clip(aside, -1, 1)))
        # far to the side, a degree of direction spans more than a degree of the angle along
        level = np.cos(np.minimum(across + margin, np.pi / 2))
        wider = np.where(level > np.sin(margin), np.arcsin(np.minimum(np.sin(margin) / np.maximum(level, 1e-9), 1)), np.pi)
        along = np.abs(np.arctan2(above, ahead))
        return np.asarray((across <= half_across + margin) & (along <= math.radians(self.along_deg) / 2 + wider))

    def _fall(self, angle: AnyArray, maths: Maths) -> AnyArray:
        """Return the taper at an angle in units of the half width: 1 in the centre, 0 from 1 on."""
        if self.taper == 0:
            return maths.where(angle <= 1, angle * 0 + 1, 0)
        ramp = maths.clip((angle - (1 - self.taper)) * (1 / self.taper), 0, 1)
        return 0.5 + 0.5 * maths.cos(ramp * math.pi)


class Hydrophone(CheckedModel):
    """A receiver: its name, its position relative to the transmitter in the vehicle's axes, and its field of view."""

    called: ClassVar[str] = "receiver"

    name: str = Field(min_length=1, description="of the receiver")
    position: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="starboard, forward, up [m]")
    field: FieldOfView = Field(default_factory=FieldOfView, description="its field of view")

    @model_validator(mode="after")
    def _near(self) -> Self:
        if not (np.isfinite(self.position).all() and math.dist(self.position, (0, 0, 0)) <= 100):
            raise ValueError(f"receiver {self.name[:40]}: position must be finite and within 100 m: got {self.position}")
        if not self.name.isidentifier():
            raise ValueError(f"a receiver's name is letters, digits and _ : got {short_repr(self.name)}")
        return self


RECEIVER_HEADINGS_DEG = {"front": 0.0, "left": -90.0, "back": 180.0, "right": 90.0}
"""Headings of receivers 1 to 4 of Almanza-Medina, 5.4 [deg]."""


def four_receivers(distance_m: float = 0.1, **field: FieldValue) -> tuple[Hydrophone, ...]:
    """Create Almanza-Medina's receivers (5.4): forward, left, back and right of the transmitter, each pointing outwards.

    Args:
        distance_m: distance from the transmitter [m].
        field: fields of :class:`FieldOfView`, common to all receivers.
    """
    receivers = []
    for name, heading in RECEIVER_HEADINGS_DEG.items():
        turn = math.radians(heading)
        position = (round(distance_m * math.sin(turn), 12), round(distance_m * math.cos(turn), 12), 0.0)
        receivers.append(Hydrophone(name=name, position=position, field=FieldOfView(heading_deg=heading, **field)))
    return tuple(receivers)


def side_looking_array(
    element_m: float = 0.1,
    receivers: int = 8,
    *,
    carrier_hz: float = 100e3,
    bandwidth_hz: float = 20e3,
    range_max: float = 50.0,
    sound_speed: float = 1500.0,
    side: Literal["port", "starboard"] = "starboard",
    tilt_deg: float = 65.0,
    along_deg: float = 60.0,
    **keys: FieldValue,
) -> ChannelSonar:
    """Create the instrument of a synthetic aperture: a transmitter, and a row of receivers along the track.

    All elements have the length ``element_m``, and the receivers are as far apart. The phase centres of a ping are therefore
    ``element_m / 2`` apart, and pings that are ``receivers * element_m / 2`` apart continue them.

    Args:
        element_m: length of an element along the track [m].
        receivers: number of receivers, centred on the transmitter.
        carrier_hz: centre of the band [Hz].
        bandwidth_hz: width of the band, whose spectrum is flat [Hz].
        range_max: largest range [m].
        sound_speed: [m/s].
        side: where the elements look.
        tilt_deg: tilt of the elements from straight down [deg].
        along_deg: whole width of the elements in the vertical plane [deg].
        keys: other keys of :class:`ChannelSonar`; ``frame_rate_hz`` is by default the highest that ``range_max`` allows.

    Raises:
        MitsonarError: a value outside its limits.
    """
    if not 1 <= receivers <= 256:
        raise MitsonarError(f"an array has 1 to 256 receivers: got {receivers}")
    if not (0 < element_m <= 10 and 0 < bandwidth_hz < 1e9 and 0 < range_max <= 1e5 and 100 <= sound_speed <= 1e4):
        raise MitsonarError(
            "an array needs element_m in 0..10 m, a bandwidth_hz above 0, range_max in 0..1e5 m, and sound_speed in "
            f"100..1e4 m/s: got {element_m:g} m, {bandwidth_hz:g} Hz, {range_max:g} m, {sound_speed:g} m/s"
        )
    if not 0 < carrier_hz <= 1e9:
        raise MitsonarError(f"carrier_hz must be above 0 and at most 1e9: got {carrier_hz:g}")
    heading = 90.0 if side == "starboard" else -90.0
    field = FieldOfView.of_line(
        element_m, sound_speed / carrier_hz, heading_deg=heading, tilt_deg=tilt_deg, along_deg=along_deg
    )
    sampling = SAMPLES_A_BAND * bandwidth_hz
    taps = next_fast_len(math.floor(4 * range_max / sound_speed * sampling) + 1)
    places = (np.arange(receivers) - (receivers - 1) / 2) * element_m
    fixed = {"carrier_hz": carrier_hz, "bandwidth_hz": bandwidth_hz, "range_max": range_max, "sound_speed": sound_speed}
    derived = {
        "name": "side-looking array",
        "rolloff": 0.0,
        "sampling_hz": sampling,
        "frequency_step_hz": sampling / taps,
        "frame_rate_hz": min(sound_speed / (2 * range_max), 1e6),
    }
    row = [Hydrophone(name=f"r{k}", position=(0.0, float(y), 0.0), field=field) for k, y in enumerate(places)]
    return ChannelSonar.create(**{**derived, **fixed, **keys, "transmitter": field, "receivers": tuple(row)})


DIRECTIONS = 24
"""Directions over each width of a field of view that bound what it sees."""

SAMPLES_A_BAND = 1.2
"""Sampling rate of a side-looking array over its bandwidth."""


def _taps_with_short_step(sampling_hz: float, taps: int) -> int:
    """Return ``taps`` or slightly more, such that the frequency step has few digits."""
    for digits in (1, 2, 3):
        for candidate in range(taps, taps + taps // 3 + 1):
            step = sampling_hz / candidate
            if float(f"{step:.{digits}g}") == step:
                return candidate
    return taps


class ChannelSonar(Instrument):
    """A continuous transmitter, and receivers whose channels are measured continuously (Almanza-Medina, ch. 5).

    Angles are in degrees, all other quantities in SI units. The same names serve as XML properties of the sensor
    ``channel_sonar`` (docs/reference/plugins.md).

    Raises:
        MitsonarError: an unknown key, or a value outside its limits.
    """

    called: ClassVar[str] = "channel sonar"
    see: ClassVar[str] = SEE

    carrier_hz: float = Field(80e3, le=1e9, description="carrier f_c [Hz]")
    bandwidth_hz: float = Field(4.8e3, gt=0, le=1e9, description="bandwidth F_d [Hz]")
    sampling_hz: float = Field(8e3, gt=0, le=1e9, description="sampling rate f_d of the complex baseband [Hz]")
    frequency_step_hz: float = Field(10.0, gt=0, le=1e9, description="step of the frequency response [Hz]")
    rolloff: float = Field(0.5, ge=0, le=1, description="roll-off alpha of the raised cosine")
    range_max: float = Field(25.0, gt=0, le=1e5, description="echoes from farther away are dropped and counted [m]")
    sound_speed: float = Field(1500.0, ge=100, le=1e4, description="sound speed [m/s]")
    frame_rate_hz: float = Field(20.0, gt=0, le=1e6, description="responses a second [Hz]")
    model: ChannelModel = Field(
        "scatterers", description="scatterers of the world, or rays of the vehicle (Almanza-Medina's)"
    )
    bounces: int = Field(1, ge=1, le=3, description="reflections of a path, at most; a scatterer's counts as one")
    direct: bool = Field(False, description="sound also arrives directly from transmitter to receiver")
    spreading: bool | None = Field(None, description="amplitudes fall with distance; default: scatterers yes, rays no")
    points_per_m2: float = Field(
        1700.0, gt=0, le=1e7, description="density of the scatterers of surfaces without cells [1/m2]"
    )
    scatterer_spacing_m: float | None = Field(
        None, gt=0, le=10, description="pitch of the points on all surfaces [m], as of an imaging sonar; default: cells"
    )
    speckle_nu: float | None = Field(
        None, gt=0.05, le=100, description="shape of the K law of surfaces without cells, as of an imaging sonar"
    )
    speckle_patch_m: float = Field(0.1, gt=0, le=100, description="side of the patches that speckle_nu varies over [m]")
    rays: int = Field(50_000, ge=1, le=10**8, description="rays within each receiver's field of view, model rays")
    seed: int = Field(0, ge=0, lt=2**31, description="of the places and weights of scatterers without cells")
    absorption_db_per_m: float = Field(
        0.0, ge=0, le=100, description="absorption of the water at the carrier, one way [dB/m]"
    )
    transmitter: FieldOfView = Field(FieldOfView(shape="all"), description="its field of view")
    receivers: tuple[Hydrophone, ...] = Field(default_factory=four_receivers, min_length=1, description="the receivers")

    def __repr__(self) -> str:
        names = [receiver.name for receiver in self.receivers]
        shown = ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
        return (
            f"ChannelSonar({self.name}: {self.carrier_hz / 1e3:g} kHz, band {self.bandwidth_hz / 1e3:g} kHz, {len(names)} "
            f"receivers ({shown}), {self.taps} taps, to {self.range_max:g} m, model {self.model})"
        )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        half_band = (1 + self.rolloff) * self.bandwidth_hz / 2
        if not self.carrier_hz > half_band:
            raise ValueError(
                f"carrier_hz must exceed half the band, (1 + rolloff) bandwidth_hz / 2 = {half_band:g} Hz: got "
                f"{self.carrier_hz:g} Hz; raise the carrier or narrow the band"
            )
        if 2 * half_band > self.sampling_hz * (1 + 1e-12):
            raise ValueError(
                f"sampling_hz must be at least (1 + rolloff) bandwidth_hz = {2 * half_band:g} Hz: got "
                f"{self.sampling_hz:g} Hz; raise it, or narrow the band"
            )
        longest = 2 * self.range_max / self.sound_speed
        if not self.frequency_step_hz < 1 / (2 * longest):
            enough = _taps_with_short_step(self.sampling_hz, math.floor(2 * longest * self.sampling_hz) + 1)
            raise ValueError(
                f"frequency_step_hz must be below 1 / (2 tau_max) = {1 / (2 * longest):.6g} Hz, tau_max being the delay "
                f"from range_max {self.range_max:g} m: got {self.frequency_step_hz:g} Hz; give "
                f"{self.sampling_hz / enough:.9g} Hz, or lower range_max"
            )
        taps = self.sampling_hz / self.frequency_step_hz
        if abs(taps - round(taps)) > 1e-6 * taps:
            raise ValueError(
                f"sampling_hz must be a whole number of frequency_step_hz: got {self.sampling_hz:g} / "
                f"{self.frequency_step_hz:g}; give {self.sampling_hz / math.ceil(taps):.9g} Hz"
            )
        if self.model == "rays" and (self.bounces > 1 or self.direct):
            raise ValueError(
                f"bounces and direct need the model scatterers, since rays has one bounce: got bounces {self.bounces}, "
                f"direct {str(self.direct).lower()}; omit them, or choose the model scatterers"
            )
        fields = [self.transmitter, *(receiver.field for receiver in self.receivers)]
        if self.model == "rays" and any(field.shape == "line" for field in fields):
            raise ValueError("the model rays has no fields of view of shape line: choose the model scatterers")
        names = [receiver.name for receiver in self.receivers]
        if len(set(names)) < len(names):
            raise ValueError(f"receivers must have different names: got {', '.join(names)}")
        if round(taps) * len(names) > 2**24:
            raise ValueError(f"a measurement has at most {2**24:,} taps: got {round(taps) * len(names):,}")
        return self

    @property
    def taps(self) -> int:
        """Return the number of taps of a response."""
        return round(self.sampling_hz / self.frequency_step_hz)

    @property
    def delay_s(self) -> NDArray[np.float64]:
        """Return the delay of each tap ``(taps,)`` [s]."""
        return np.arange(self.taps) / self.sampling_hz

    @property
    def wavelength_m(self) -> float:
        """Return the wavelength of the carrier [m]."""
        return self.sound_speed / self.carrier_hz

    @property
    def lattice_pitch_m(self) -> float:
        """Return the spacing of the points on surfaces without cells [m]."""
        return self.points_per_m2**-0.5 if self.scatterer_spacing_m is None else self.scatterer_spacing_m

    @property
    def spreads(self) -> bool:
        """Return whether amplitudes decrease with distance."""
        return self.model == "scatterers" if self.spreading is None else self.spreading

    @property
    def field_of_view(self) -> dict[str, FieldOfView]:
        """Return the field of view of each receiver by name; without taper in the model ``rays``, as in Almanza-Medina."""
        hard = {"taper": 0.0} if self.model == "rays" else {}
        return {receiver.name: receiver.field.model_copy(update=hard) for receiver in self.receivers}

    @property
    def offsets(self) -> NDArray[np.float64]:
        """Return the positions of the receivers in the vehicle's axes ``(receivers, 3)`` [m]."""
        return np.array([receiver.position for receiver in self.receivers], dtype=float)

    def box_seen_from(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return two opposite corners of a box around all that the receivers may see from some poses ``(2, 3)`` [m].

        Args:
            poses: poses of the transmitter ``(pings, 6)``.
        """
        turns = vehicle_rotation(poses).as_matrix()
        corners = [poses[:, :3].min(axis=0), poses[:, :3].max(axis=0)]
        for one in self.receivers:
            rays = np.array(one.position) + self.range_max * one.field.directions(DIRECTIONS)
            for turn, pose in zip(turns, poses, strict=True):
                ends = pose[:3] + rays @ turn.T
                corners += [ends.min(axis=0), ends.max(axis=0)]
        margin = 0.01 * self.range_max
        return np.array([np.min(corners, axis=0) - margin, np.max(corners, axis=0) + margin])

    def receiver_number(self, receiver: int | str) -> int:
        """Return the index of a receiver that is given by name or by index.

        Raises:
            MitsonarError: no such receiver.
        """
        names = [one.name for one in self.receivers]
        if isinstance(receiver, str) and receiver in names:
            return names.index(receiver)
        whole = isinstance(receiver, int | np.integer) and not isinstance(receiver, bool)
        if not whole or not 0 <= int(receiver) < len(names):
            raise MitsonarError(
                f"receiver must be a name of {', '.join(names)}, or a number 0..{len(names) - 1}: got {short_repr(receiver)}"
            )
        return int(receiver)

    def raised_cosine(self, frequency_hz: NDArray[np.floating]) -> NDArray[np.float64]:
        """Compute the raised cosine X_R at baseband frequencies [Hz] (Almanza-Medina, eq. 5.16, corrected).

        X_R is 1 up to c = (1 - alpha) F_d / 2, 0 from a = (1 + alpha) F_d / 2 on, and half a period of a cosine in between.
        """
        flat = (1 - self.rolloff) * self.bandwidth_hz / 2
        width = self.rolloff * self.bandwidth_hz
        beyond = np.abs(np.asarray(frequency_hz, dtype=float)) - flat
        if width == 0:
            return np.where(beyond <= 0, 1.0, 0.0)
        return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.clip(beyond / width, 0, 1)))

    def pulse(self, delay_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Compute the response to one echo of amplitude 1 at delay 0: the transform of X_R over the sampling rate.

        Args:
            delay_s: delays at which the response is evaluated [s].
        """
        t = np.asarray(delay_s, dtype=float) * self.bandwidth_hz
        edge = 1 - (2 * self.rolloff * t) ** 2
        near = np.abs(edge) < 1e-9
        shape = np.where(near, np.pi / 4, np.cos(np.pi * self.rolloff * t) / np.where(near, 1.0, edge))
        return np.asarray(np.sinc(t) * shape * self.bandwidth_hz / self.sampling_hz)
