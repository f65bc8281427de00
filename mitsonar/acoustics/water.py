"""How sound travels through water: its speed and absorption with the validity of the formulas, and the delay of its paths.

Absorption is in dB per metre of path, one way. Above 1 MHz both formulas extrapolate; the dominant term there is the
viscosity of pure water, which grows with the square of the frequency.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import ClassVar, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from mitsonar.arrays import AnyArray
from mitsonar.errors import MitsonarError, did_you_mean, short_repr
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.checked_model import CheckedModel

__all__ = [
    "FORMULAS",
    "Formula",
    "Water",
    "absorption_db_per_m",
    "absorption_line",
    "absorption_warning",
    "delay_exact",
    "delay_iterated",
    "delay_static",
    "dot",
    "gain_of",
    "length",
    "loss_notes",
    "loss_of",
    "net_loss",
    "noise_of",
    "sonar_absorption",
    "sound_speed_m_s",
    "sound_speed_warning",
    "undone_absorption",
    "water_of",
]


Formula = Literal["francois-garrison", "ainslie-mccolm"]

FORMULAS = ("francois-garrison", "ainslie-mccolm")
"""Absorption formulas, the default first."""

SALTY_PSU = 1.0
"""Salinity below which water counts as fresh, since salts then add little to the absorption [psu]."""


class Water(CheckedModel):
    """Properties of the water that sound travels through; the default is a cool sea at its surface.

    A ``salinity_psu`` of 0 is a lake or a tank.
    """

    model_config = ConfigDict(allow_inf_nan=False)

    called: ClassVar[str] = "water"

    temperature_c: float = Field(10.0, ge=-6, le=40, description="temperature [deg C]")
    salinity_psu: float = Field(35.0, ge=0, le=50, description="salinity [psu]; 0 is fresh water")
    depth_m: float = Field(0.0, ge=0, le=12_000, description="depth below the surface [m]")
    ph: float = Field(8.0, ge=5, le=10, description="pH; it matters below 10 kHz only")


# ---------------- Absorption


def absorption_db_per_m(frequency_hz: AnyArray, water: Water, formula: Formula = "francois-garrison") -> AnyArray:
    """Compute the absorption of sound in water [dB/m], one way.

    The frequency enters only through ``+ * /``, so NumPy, torch and Dr.Jit give the same bits. Use
    :func:`absorption_warning` to check whether the formula is valid.

    Args:
        frequency_hz: above 0, a number or an array ``(...)`` of any library.
        water: the water.
        formula: ``francois-garrison``: Francois and Garrison, Sound absorption based on ocean measurements, parts I and II,
            J. Acoust. Soc. Am. 72 (1982), 896-907 and 1879-1890. ``ainslie-mccolm``: Ainslie and McColm, A simplified
            formula for viscous and chemical absorption in sea water, J. Acoust. Soc. Am. 103 (1998), 1671-1672.

    Returns:
        Like ``frequency_hz``.

    Raises:
        MitsonarError: unknown formula, or a number that is not a valid frequency.
    """
    _check_frequency(frequency_hz)
    match formula:
        case "francois-garrison":
            relaxations, viscous = _francois_garrison(water)
        case "ainslie-mccolm":
            relaxations, viscous = _ainslie_mccolm(water)
        case _:
            raise _unknown(formula)
    khz = frequency_hz * 1e-3
    square = khz * khz
    total = viscous * square
    for strength, relaxation_khz in relaxations:
        if strength > 0:  # fresh water has no salts, hence no relaxation
            total = total + strength * relaxation_khz * square / (square + relaxation_khz * relaxation_khz)
    return total * 1e-3


def _francois_garrison(water: Water) -> tuple[list[tuple[float, float]], float]:
    """Return strength [dB/km/kHz] and frequency [kHz] of both relaxations, and the viscous term [dB/km/kHz^2]."""
    t, s, d = water.temperature_c, water.salinity_psu, water.depth_m
    speed = 1412 + 3.21 * t + 1.19 * s + 0.0167 * d
    boric = 8.86 / speed * 10 ** (0.78 * water.ph - 5) if s > 0 else 0.0
    boric_khz = 2.8 * math.sqrt(s / 35) * 10 ** (4 - 1245 / (t + 273))
    magnesium = 21.44 * s / speed * (1 + 0.025 * t) * (1 - 1.37e-4 * d + 6.2e-9 * d * d)
    magnesium_khz = 8.17 * 10 ** (8 - 1990 / (t + 273)) / (1 + 0.0018 * (s - 35))
    if t <= 20:
        viscous = 4.937e-4 - 2.59e-5 * t + 9.11e-7 * t * t - 1.50e-8 * t**3
    else:
        viscous = 3.964e-4 - 1.146e-5 * t + 1.45e-7 * t * t - 6.5e-10 * t**3
    viscous *= 1 - 3.83e-5 * d + 4.9e-10 * d * d
    return [(boric, boric_khz), (magnesium, magnesium_khz)], viscous


def _ainslie_mccolm(water: Water) -> tuple[list[tuple[float, float]], float]:
    """Return strength [dB/km/kHz] and frequency [kHz] of both relaxations, and the viscous term [dB/km/kHz^2]."""
    t, s, z = water.temperature_c, water.salinity_psu, water.depth_m / 1000
    boric = 0.106 * math.exp((water.ph - 8) / 0.56) if s > 0 else 0.0
    boric_khz = 0.78 * math.sqrt(s / 35) * math.exp(t / 26)
    magnesium = 0.52 * (1 + t / 43) * (s / 35) * math.exp(-z / 6)
    magnesium_khz = 42 * math.exp(t / 17)
    return [(boric, boric_khz), (magnesium, magnesium_khz)], 0.00049 * math.exp(-(t / 27 + z / 17))


def absorption_warning(frequency_hz: float, water: Water, formula: Formula = "francois-garrison") -> str | None:
    """Return a one-sentence warning if the absorption formula is outside its validity range, else None.

    Validity of Francois and Garrison, to within 5 %: 10 to 500 kHz at -2..22 deg C, 30..35 psu, to 3,500 m; above 500 kHz at
    0..30 deg C, 0..40 psu, to 10,000 m; overall from 0.2 kHz to 1 MHz. Ainslie and McColm stay within 10 % of them from 0.1
    kHz to 1 MHz at -6..35 deg C, 5..50 psu, pH 7.7..8.3, to 7,000 m. Both as quoted by the National Physical Laboratory,
    Underlying physics and mechanisms for the absorption of sound in seawater (second hand).

    Raises:
        MitsonarError: unknown formula, or a number that is not a valid frequency.
    """
    _check_frequency(frequency_hz)
    if formula not in FORMULAS:
        raise _unknown(formula)
    khz = frequency_hz / 1000
    garrison = formula == "francois-garrison"
    name = "Francois and Garrison" if garrison else "Ainslie and McColm"
    if khz > 1000:
        return f"absorption at {khz:,.4g} kHz is extrapolated: {name} hold to 1,000 kHz, beyond by pure water's f^2"
    lowest = 0.2 if garrison else 0.1
    if khz < lowest:
        return f"absorption at {khz:,.4g} kHz is extrapolated: {name} hold from {lowest} kHz"
    if water.salinity_psu < SALTY_PSU and khz < 500:
        return f"absorption at {khz:,.4g} kHz in fresh water is that of pure water alone: {name} measured the sea"
    bands: dict[str, tuple[float, float]]
    if not garrison:
        bands = {"temperature_c": (-6, 35), "salinity_psu": (5, 50), "depth_m": (0, 7000), "ph": (7.7, 8.3)}
        if khz > 10:
            del bands["ph"]
        if water.salinity_psu < SALTY_PSU:
            del bands["salinity_psu"]
    elif khz > 500:
        bands = {"temperature_c": (0, 30), "salinity_psu": (0, 40), "depth_m": (0, 10_000)}
    else:
        bands = {"temperature_c": (-2, 22), "salinity_psu": (30, 35), "depth_m": (0, 3500)}
    return _outside(water, bands, f"absorption by {name} at {khz:,.4g} kHz")


# ---------------- Sound speed

PURE = (1402.388, 5.03711, -5.80852e-2, 3.3420e-4, -1.47800e-6, 3.1464e-9)
PURE_1 = (0.153563, 6.8982e-4, -8.1788e-6, 1.3621e-7, -6.1185e-10)
PURE_2 = (3.1260e-5, -1.7107e-6, 2.5974e-8, -2.5335e-10, 1.0405e-12)
PURE_3 = (-9.7729e-9, 3.8504e-10, -2.3643e-12)
SALT = (1.389, -1.262e-2, 7.164e-5, 2.006e-6, -3.21e-8)
SALT_1 = (9.4742e-5, -1.2580e-5, -6.4885e-8, 1.0507e-8, -2.0122e-10)
SALT_2 = (-3.9064e-7, 9.1041e-9, -1.6002e-10, 7.988e-12)
SALT_3 = (1.100e-10, 6.649e-12, -3.389e-13)
ROOT, ROOT_1 = (-1.922e-2, -4.42e-5), (7.3637e-5, 1.7945e-7)
SQUARE, SQUARE_1 = (1.727e-3,), (-7.9836e-6,)
"""Polynomials of the temperature (Fofonoff and Millard, 1983); ``_k`` marks the factor of the k-th power of pressure."""


def sound_speed_m_s(water: Water) -> float:
    """Compute the speed of sound in sea water and fresh water [m/s].

    The formula is that of Chen and Millero, J. Acoust. Soc. Am. 62 (1977), 1129-1135, as adopted by UNESCO: Fofonoff and
    Millard, Algorithms for computation of fundamental properties of seawater, UNESCO technical papers in marine science 44
    (1983). Its temperature is on the 1968 scale, 1.00024 times that of 1990. The pressure is computed from the depth by
    Saunders, J. Phys. Oceanogr. 11 (1981), 573-574, at 45 deg latitude.

    Args:
        water: the water; its pH has no effect. Use :func:`sound_speed_warning` to check whether the formula is valid.
    """
    return unesco_speed_m_s(1.00024 * water.temperature_c, water.salinity_psu, pressure_bar(water.depth_m))


def unesco_speed_m_s(temperature_68_c: float, salinity_psu: float, pressure_bar: float) -> float:
    """Compute the speed of sound by Chen and Millero [m/s].

    Args:
        temperature_68_c: temperature on the 1968 scale [deg C].
        salinity_psu: practical salinity [psu].
        pressure_bar: pressure above atmospheric [bar].
    """
    t, s, p = temperature_68_c, salinity_psu, pressure_bar
    pure = _polynomial((_polynomial(one, t) for one in (PURE, PURE_1, PURE_2, PURE_3)), p)
    salt = _polynomial((_polynomial(one, t) for one in (SALT, SALT_1, SALT_2, SALT_3)), p)
    root = _polynomial((_polynomial(one, t) for one in (ROOT, ROOT_1)), p)
    square = _polynomial((_polynomial(one, t) for one in (SQUARE, SQUARE_1)), p)
    return pure + salt * s + root * s * math.sqrt(s) + square * s * s


def pressure_bar(depth_m: float, latitude_deg: float = 45.0) -> float:
    """Compute the pressure above atmospheric [bar] at a depth in the sea, by Saunders (1981)."""
    linear = 1 - (5.92e-3 + 5.25e-3 * math.sin(math.radians(latitude_deg)) ** 2)
    return (linear - math.sqrt(linear * linear - 8.84e-6 * depth_m)) / 4.42e-6 / 10


def sound_speed_warning(water: Water) -> str | None:
    """Return a one-sentence warning if the sound speed formula is outside its validity range, else None.

    The range is 0..40 deg C, 0..40 psu and 0..1,000 bar, which is 9,700 m (Fofonoff and Millard, 1983).
    """
    bands: dict[str, tuple[float, float]] = {"temperature_c": (0, 40), "salinity_psu": (0, 40), "depth_m": (0, 9700)}
    return _outside(water, bands, "speed of sound by Chen and Millero")


# ---------------- Helpers


def _polynomial(coefficients: Iterable[float], x: float) -> float:
    """Evaluate a polynomial with the constant coefficient first."""
    total = 0.0
    for one in reversed(tuple(coefficients)):
        total = total * x + one
    return total


def _outside(water: Water, bands: dict[str, tuple[float, float]], what: str) -> str | None:
    """Describe the first field of the water that lies outside its band; None if all lie within."""
    for key, (low, high) in bands.items():
        value = getattr(water, key)
        if not low <= value <= high:
            return f"{what} is extrapolated: {key} {value:g} lies outside {low:g}..{high:g}"
    return None


def _check_frequency(frequency_hz: AnyArray) -> None:
    """Reject a number that is not a valid frequency; arrays are not checked."""
    if isinstance(frequency_hz, int | float) and not 0 < frequency_hz < math.inf:
        raise MitsonarError(f"a frequency must be a finite number of Hz above 0: got {short_repr(frequency_hz)}")


def _unknown(formula: object) -> MitsonarError:
    known = ", ".join(FORMULAS)
    return MitsonarError(
        f"unknown formula of absorption {short_repr(formula)}: known: {known}{did_you_mean(formula, FORMULAS)}"
    )


# ---------------- Absorption, gain and noise of a sonar


EXTRAPOLATED_HZ = 1e6
"""Carrier above which the formula extrapolates with the viscosity of pure water [Hz]."""


def water_of(sonar: Sonar) -> Water:
    """Return the water around a sonar.

    Raises:
        MitsonarError: properties outside their limits.
    """
    return Water.create(
        temperature_c=sonar.temperature_c, salinity_psu=sonar.salinity_psu, depth_m=sonar.water_depth_m, ph=sonar.ph
    )


def sonar_absorption(sonar: Sonar) -> float:
    """Return the one-way absorption of a sonar [dB/m].

    This is ``absorption_db_per_m`` if given, 0 with box patterns (see Sonar.pattern) or without a carrier, and otherwise the
    absorption at the carrier in the sonar's water.
    """
    if sonar.absorption_db_per_m is not None:
        return sonar.absorption_db_per_m
    if sonar.beam_pattern == "box" or sonar.frequency_hz is None:
        return 0.0
    return float(absorption_db_per_m(sonar.frequency_hz, water_of(sonar)))


def loss_notes(sonar: Sonar) -> list[str]:
    """Return a one-sentence note if carrier or water lie outside the validity range of the absorption formula."""
    if sonar.absorption_db_per_m is not None or sonar.beam_pattern == "box" or sonar.frequency_hz is None:
        return []
    if sonar.frequency_hz > EXTRAPOLATED_HZ:  # common to imaging sonars: reported by absorption_line instead of a warning
        return []
    note = absorption_warning(sonar.frequency_hz, water_of(sonar))
    return [] if note is None else [f"{note}; or give absorption_db_per_m"]


def absorption_line(sonar: Sonar) -> str | None:
    """Return a line that reports the absorption derived from carrier and water; None if it is given or absent."""
    if sonar.absorption_db_per_m is not None or sonar.beam_pattern == "box" or sonar.frequency_hz is None:
        return None
    beyond = ", extrapolated: Francois and Garrison hold to 1 MHz" if sonar.frequency_hz > EXTRAPOLATED_HZ else ""
    return f"absorption at {sonar.frequency_hz / 1000:,.4g} kHz: {sonar_absorption(sonar):.3g} dB/m one way{beyond}"


def loss_of(sonar: Sonar) -> NDArray[np.float64]:
    """Return the fraction of the intensity that remains after two-way absorption ``(bins,)``."""
    return np.asarray(10 ** (-2 * sonar_absorption(sonar) * sonar.range_m / 10), dtype=np.float64)


def undone_absorption(sonar: Sonar) -> NDArray[np.float64]:
    """Return the intensity gain that compensates absorption ``(bins,)``; ones without ``gain_absorption``."""
    return 1 / loss_of(sonar) if sonar.gain_absorption else np.ones(sonar.range_bins)


def net_loss(sonar: Sonar) -> NDArray[np.float64]:
    """Return the fraction of the intensity that remains after absorption and its compensation by the gain ``(bins,)``."""
    return np.asarray(loss_of(sonar) * undone_absorption(sonar), dtype=np.float64)


def gain_of(sonar: Sonar) -> NDArray[np.float64]:
    """Return the time-varying intensity gain ``(bins,)``: R^gain_exponent, and the compensation of absorption if enabled."""
    return np.asarray(sonar.range_m**sonar.gain_exponent * undone_absorption(sonar), dtype=np.float64)


def noise_of(sonar: Sonar) -> NDArray[np.float64]:
    """Return the mean power of the receiver noise in each bin after the gain ``(bins,)``; 0 without noise.

    It is relative to the source, as echoes are. The glow near the sonar is that of a beam halfway between the middle and the
    edge of the fan.
    """
    if sonar.noise_level_db is None:
        return np.zeros(sonar.range_bins)
    glow = np.maximum(0.0, sonar.near_glow_db * (1 - sonar.range_m / sonar.near_glow_m))
    power = 10 ** ((sonar.noise_level_db - sonar.source_level_db + glow) / 10)
    return np.asarray(power * gain_of(sonar), dtype=np.float64)


# ---------------- Delays from the transmitter via a point to a moving receiver
# The equations are those of Almanza-Medina, sections 5.2.2 and 5.2.3. The functions accept NumPy arrays and Dr.Jit arrays.


Vector: TypeAlias = Sequence[AnyArray] | NDArray[np.floating]
"""Three coordinates: a sequence of NumPy or Dr.Jit arrays, or an array whose first axis holds them."""


def dot(a: Vector, b: Vector) -> AnyArray:
    """Return the inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def length(a: Vector) -> AnyArray:
    """Return the Euclidean length."""
    return dot(a, a) ** 0.5


def delay_static(to_point: Vector, from_receiver: Vector, sound_speed: float) -> AnyArray:
    """Return the delay for a vehicle at rest (Almanza-Medina, eq. 5.1-5.4) [s].

    Args:
        to_point: vector from the transmitter to the point, P - A [m].
        from_receiver: vector from the receiver to the point, P - B, when the sound is sent [m].
        sound_speed: [m/s].
    """
    return (length(to_point) + length(from_receiver)) / sound_speed


def delay_iterated(
    to_point: Vector, from_receiver: Vector, velocity: Vector, sound_speed: float, times: int = 2
) -> AnyArray:
    """Return the delay to a receiver that moves while sound travels, by iteration (Almanza-Medina, eq. 5.5-5.14) [s].

    Each round moves the receiver along its velocity for the previous delay. Almanza-Medina takes two rounds.
    """
    out = length(to_point) / sound_speed
    delay = out + length(from_receiver) / sound_speed
    for _ in range(times):
        moved = [q - v * delay for q, v in zip(from_receiver, velocity, strict=True)]
        delay = out + length(moved) / sound_speed
    return delay


def delay_exact(
    to_point: Vector, from_receiver: Vector, velocity: Vector, sound_speed: float, point_velocity: Vector | None = None
) -> AnyArray:
    """Return the exact delay to a receiver that moves while sound travels [s]: the limit of :func:`delay_iterated`.

    |P - B - v tau| = c (tau - tau_0) is a quadratic equation, whose larger root is the one after tau_0. Let s = tau - tau_0,
    and let q be the vector from the receiver to P when the sound is at P. Then (c^2 - v^2) s^2 + 2 q.v s - q^2 = 0. This
    form suffers no cancellation. The way to a point that moves with velocity u is such an equation with v = -u.

    Args:
        to_point: vectors from the transmitter to the points as the sound is sent [m].
        from_receiver: vectors from the receiver to the points at that time [m].
        velocity: of the receiver [m/s].
        sound_speed: [m/s].
        point_velocity: of the points [m/s]; default: at rest.
    """
    if point_velocity is None:
        out, relative = length(to_point) / sound_speed, [-v for v in velocity]
    else:
        out = _meeting(to_point, point_velocity, sound_speed)
        relative = [u - v for u, v in zip(point_velocity, velocity, strict=True)]
    left = [q + w * out for q, w in zip(from_receiver, relative, strict=True)]
    return out + _meeting(left, [-v for v in velocity], sound_speed)


def _meeting(apart: Vector, velocity: Vector, sound_speed: float) -> AnyArray:
    """Return the time [s] after which sound meets what is ``apart`` [m] from its source and moves with a velocity [m/s]."""
    leaving, speed2 = dot(apart, velocity), sound_speed**2 - dot(velocity, velocity)
    return ((leaving * leaving + speed2 * dot(apart, apart)) ** 0.5 + leaving) / speed2
