"""Compute the acoustic backscatter of surfaces as a function of the grazing angle.

A material is a table of its scattering cross-section over the grazing angle. The cross-section sigma is per unit area and
steradian [1/sr], for sound that returns to where it came from. ``10 log sigma`` is the bottom scattering strength. The
grazing angle lies between ray and surface; its sine is the cosine of incidence.

The simulator's reflectivity C is Lambert's mu itself, not pi mu. A surface with C = 1 scatters pi times the incident power,
5 dB more than is physically possible. The mu of a material is physical: ``pi mu`` is at most 1. To use C as the share of the
power that is scattered, set mu to C / pi.

Its ``basis`` states whether its level was measured in its band, computed, fitted, extrapolated or assumed (:data:`Basis`).

Each named material is a YAML file in ``materials/`` that cites a source for every number. In a source, ``(not seen)`` marks
a number that is widely quoted from a document that could not be consulted, ``second hand`` a number that a third party
quotes from the named document, and ``ours`` a choice or calculation of this project.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import numpy as np
from array_api_compat import array_namespace, device
from numpy.typing import ArrayLike, NDArray
from pydantic import ConfigDict, Field, model_validator
from scipy.special import hankel1

from mitsonar.arrays import AnyArray
from mitsonar.errors import MitsonarError, argument, short_repr, suggest_names
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import View, Whole
from mitsonar.io.checked_model import CheckedModel, Preset, presets_in
from mitsonar.io.files import PlainValue, read_yaml

__all__ = [
    "COARSEST_PHI",
    "FINEST_PHI",
    "FLATTEST",
    "GRAZING_DEG",
    "LAWS",
    "SEDIMENTS",
    "Basis",
    "Law",
    "Material",
    "MuTable",
    "Sediment",
    "band_warning",
    "check_channel_mirrors",
    "check_image_mirrors",
    "depends_on_frequency",
    "frequency_notes",
    "material",
    "mirror_amplitude",
    "mu_at",
    "mu_table",
    "named_materials",
    "normal_mu",
    "reference_hz",
    "rough_fluid_sigma",
    "roughness_sigma",
    "sediment_of",
    "sigma_at",
    "sigma_table",
    "single_mu",
    "structure_integral",
    "volume_sigma",
]


# ---------------- Effective reflectivity for ray tracing
# A surface with cross-section sigma at the grazing angle g has the effective reflectivity C = sigma / sin^2 g: the Lambert's
# mu that scatters as much at this angle. A ray then needs a single number, whatever the scattering law. The sine of the
# grazing angle is the cosine of incidence.


FLATTEST = 1e-3
"""Sine of the smallest grazing angle at which a law is evaluated; at smaller angles the reflectivity is held constant."""

POWERS = {"lambert": 2, "lommel-seeliger": 1, "rough-fluid": 2, "table": 0}
"""Power of the sine that is divided out of each law's table, so that the rest is smooth between whole degrees."""

UNBOUNDED_HZ = 100e3
"""Frequency at which a material without a band is evaluated if the sonar has none [Hz]."""


class MuTable(NamedTuple):
    """A scattering law in the form ``C = value sin^(power - 2)``, with values linear between whole degrees.

    Attributes:
        values: at grazing angles of 0, 1 ... 90 deg ``(91,)``.
        power: power of the sine that was divided out of the cross-sections.
    """

    values: NDArray[np.float64]
    power: int


def mu_table(material: Material, frequency_hz: float, sound_speed_m_s: float = 1500.0) -> MuTable:
    """Compute the table of a material's effective reflectivity [1/sr].

    The law ``lambert`` gives an exact constant. Between whole degrees a ``table`` is linear in sigma, as is ``sigma_at``.
    ``rough-fluid`` is linear in C, which is within 2 % of the law from 5 deg on, and within 12 % at 1.5 deg.

    Args:
        material: the material.
        frequency_hz: carrier frequency [Hz].
        sound_speed_m_s: speed of sound in the water [m/s].

    Raises:
        MitsonarError: a frequency or speed that is not positive.
    """
    power = POWERS[material.law]
    sigma = sigma_table(material, frequency_hz, sound_speed_m_s)
    sine = np.sin(np.radians(GRAZING_DEG))
    values = sigma.copy()
    if power:
        values[1:] = sigma[1:] / sine[1:] ** power
        values[0] = max(0.0, 2 * values[1] - values[2])
    return MuTable(values, power)


def mu_at(table: MuTable, cosine: ArrayLike) -> NDArray[np.float64]:
    """Evaluate the effective reflectivity at angles of incidence as rays do, in float64.

    It is limited to 1 / cosine, since the sums of a sonar could overflow otherwise. This clips cross-sections to the cosine.

    Args:
        table: result of :func:`mu_table`.
        cosine: cosine of the angle between ray and normal ``(...)``, 0..1; smaller values are raised to :data:`FLATTEST`.
    """
    given = np.asarray(cosine, dtype=np.float64)
    steep = np.maximum(given, FLATTEST)
    degrees = np.degrees(np.arcsin(np.minimum(given, 1.0)))
    law = np.interp(degrees, GRAZING_DEG, table.values) * steep ** (table.power - 2)
    return np.asarray(np.minimum(law, 1 / steep))


def single_mu(material: Material, frequency_hz: float | None = None, sound_speed_m_s: float = 1500.0) -> float:
    """Return a single reflectivity for all angles: mu of the law ``lambert``, else sigma / sin^2 at 45 deg grazing [1/sr].

    It is used for impulse responses. A mirror part is not subtracted: it is that of a fully rough surface.

    Args:
        material: the material.
        frequency_hz: carrier frequency [Hz]; default: :func:`reference_hz`.
        sound_speed_m_s: speed of sound in the water [m/s].
    """
    if material.law == "lambert" and material.mu is not None:
        return material.mu
    frequency = reference_hz(material) if frequency_hz is None else frequency_hz
    fully_rough = material.model_copy(update=dict.fromkeys(MIRROR))
    return 2 * float(sigma_table(fully_rough, frequency, sound_speed_m_s)[45])


def normal_mu(material: Material, frequency_hz: float, sound_speed_m_s: float = 1500.0) -> float:
    """Return the reflectivity for the ``thesis`` model: mu of the law, or sigma at normal incidence without one [1/sr]."""
    return float(sigma_table(material, frequency_hz, sound_speed_m_s)[90]) if material.mu is None else material.mu


def reference_hz(material: Material) -> float:
    """Return the frequency used if none is given: the geometric mean of the material's band, or its only limit."""
    low, high = material.band_hz
    if low and math.isfinite(high):
        return math.sqrt(low * high)
    return low or (high if math.isfinite(high) else UNBOUNDED_HZ)


def depends_on_frequency(material: Material) -> bool:
    """Return whether the cross-section of a material depends on frequency."""
    return material.law == "rough-fluid" or material.has_mirror


def frequency_notes(materials: Sequence[Material], frequency_hz: float | None, sound_speed_m_s: float = 1500.0) -> list[str]:
    """Return one-sentence notes for the user about materials at the frequency of a sonar.

    They report a missing frequency, a frequency outside the band of a material, and cross-sections that are clipped.

    Args:
        materials: the materials of a scene.
        frequency_hz: carrier of the sonar [Hz]; None if it has none.
        sound_speed_m_s: speed of sound in the water [m/s].
    """
    notes = []
    for one in materials:
        if frequency_hz is None and depends_on_frequency(one):
            notes.append(
                f"the sonar has no frequency_hz: material {one.name} is taken at {reference_hz(one) / 1000:,.4g} kHz; give "
                "the sonar its carrier"
            )
        warning = None if frequency_hz is None else band_warning(one, frequency_hz)
        notes += [warning] if warning else []
        sigma = sigma_table(one, frequency_hz or reference_hz(one), sound_speed_m_s)
        above = np.flatnonzero(sigma[1:] > np.sin(np.radians(GRAZING_DEG[1:])) * (1 + 1e-9)) + 1
        if len(above):
            notes.append(
                f"material {one.name} scatters more than sonars can sum: sigma above the sine of the grazing angle is "
                f"clipped to it, from {above[0]} to {above[-1]} deg"
            )
    return notes


# ---------------- Sediments by mean grain size
# Mean grain sizes from -1 phi (sandy gravel) to 9 phi (clay) are mapped to the parameters of a rough fluid. The regressions
# are those of APL-UW TR 9407 (1994), section IV, which could not be consulted: they are quoted from memory of the
# literature. At 0.5, 1.5, 2.5 and 6 phi they reproduce the numbers of a program by D. R. Jackson as contained in the project
# hyo2_openbst, an independent source (``tests/acoustics/test_materials.py``). They are valid from 10 to 100 kHz.


COARSEST_PHI, FINEST_PHI = -1.0, 9.0
"""Range of grain sizes that the regressions cover; phi is minus the logarithm to base 2 of the diameter in mm."""

SEDIMENTS: dict[str, float] = {
    "sandy gravel": -1.0,
    "very coarse sand": -0.5,
    "muddy sandy gravel": 0.0,
    "coarse sand": 0.5,
    "gravelly muddy sand": 1.0,
    "medium sand": 1.5,
    "muddy gravel": 2.0,
    "fine sand": 2.5,
    "muddy sand": 3.0,
    "very fine sand": 3.5,
    "clayey sand": 4.0,
    "coarse silt": 4.5,
    "sandy silt": 5.0,
    "medium silt": 5.5,
    "sandy mud": 6.0,
    "fine silt": 6.5,
    "sandy clay": 7.0,
    "very fine silt": 7.5,
    "silty clay": 8.0,
    "clay": 9.0,
}
"""Mean grain size by name of sediment [phi]."""

SPECTRAL_EXPONENT = 3.25

WATER_M_S = 1528.0
"""Speed of sound in the water that attenuations refer to [m/s]."""

LOSS_OF_ATTENUATION = 2.302585093 / (40 * 3.141592654) * 1e-3
"""Loss parameter for an attenuation of 1 dB/m/kHz and a speed of 1 m/s."""


def sediment_of(phi: float) -> Sediment:
    """Return the rough fluid that models a sediment of a mean grain size.

    Args:
        phi: mean grain size, -1..9.

    Raises:
        MitsonarError: a grain size outside the range of the regressions.
    """
    if not COARSEST_PHI <= phi <= FINEST_PHI:
        raise MitsonarError(
            f"{argument('grain_size_phi')} must lie in {COARSEST_PHI:g}..{FINEST_PHI:g}, sandy gravel to clay: got "
            f"{short_repr(phi)}; use the named material rock, or give the parameters"
        )
    speed = _speed_ratio(phi)
    return Sediment(
        density_ratio=_density_ratio(phi),
        sound_speed_ratio=speed,
        loss=_attenuation(phi) * speed * WATER_M_S * LOSS_OF_ATTENUATION,
        volume=0.002 if phi < 5.5 else 0.001,
        spectral_exponent=SPECTRAL_EXPONENT,
        spectral_strength=_strength(phi),
    )


def _density_ratio(phi: float) -> float:
    if phi < 1:
        return 0.007797 * phi**2 - 0.17057 * phi + 2.3139
    if phi < 5.3:
        return -0.0165406 * phi**3 + 0.2290201 * phi**2 - 1.1069031 * phi + 3.0455
    return -0.0012973 * phi + 1.1565


def _speed_ratio(phi: float) -> float:
    if phi < 1:
        return 0.002709 * phi**2 - 0.056452 * phi + 1.2778
    if phi < 5.3:
        return -0.0014881 * phi**3 + 0.0213937 * phi**2 - 0.1382798 * phi + 1.3425
    return -0.0024324 * phi + 1.0019


def _attenuation(phi: float) -> float:
    """Return the attenuation [dB/m/kHz]."""
    if phi < 0:
        return 0.4556
    if phi < 2.6:
        return 0.4556 + 0.0245 * phi
    if phi < 4.5:
        return 0.1978 + 0.1245 * phi
    if phi < 6:
        return 8.0399 - 2.5228 * phi + 0.20098 * phi**2
    return max(0.0601, 0.9431 - 0.2041 * phi + 0.0117 * phi**2)


def _strength(phi: float) -> float:
    """Return the strength of the roughness spectrum [m^(4 - 3.25)], converted from cm^4 at 1 / cm."""
    height_cm = (2.03846 - 0.26923 * phi) / (1 + 0.076923 * phi) if phi < 5 else 0.5
    centimetre = 0.01
    return float(0.00207 * height_cm**2 * centimetre**4 * centimetre**-SPECTRAL_EXPONENT)


# ---------------- Rough absorbing fluid
# The sea floor is modelled as a rough, absorbing fluid with volume scatterers. Roughness and volume scattering are added.
# Roughness scattering is the first-order small-slope approximation for a power-law spectrum. It approaches the Kirchhoff
# approximation near normal incidence and first-order perturbation at low grazing angles, without a rule to join them
# (Jackson and Richardson, High-Frequency Seafloor Acoustics, 2007). APL-UW TR 9407 (1994) joins the same two limits by an
# interpolation, averages the second over the slopes of the large-scale roughness, and has a separate model for rock; these
# three parts are not implemented. The volume term is that of TR 9407 and of Mourad and Jackson (1989).
#
# Shear waves (rock), layers, gas and multiple scattering are not modelled. Slopes must be small: far above 100 kHz, rough
# floors scatter more at low angles than at steep ones, which is an artefact of the approximation.


Angles = NDArray[np.float64]

LOWEST_COSINE = 1e-5
"""Cosine used at normal incidence, where the formula is 0 / 0."""


class Sediment(NamedTuple):
    """Acoustic parameters of a rough fluid below water.

    Attributes:
        density_ratio: rho, density relative to that of the water.
        sound_speed_ratio: nu, speed of sound relative to that of the water.
        loss: delta, imaginary over real part of the wavenumber.
        volume: sigma_2, volume scattering cross-section per unit volume and steradian, over the attenuation in dB per
            length.
        spectral_exponent: gamma of the height spectrum ``W(K) = w K^-gamma``, 2..4. The integral of W over the plane of wave
            vectors is the mean square height.
        spectral_strength: w [m^(4 - gamma)].
    """

    density_ratio: float
    sound_speed_ratio: float
    loss: float
    volume: float
    spectral_exponent: float
    spectral_strength: float


def rough_fluid_sigma(sediment: Sediment, grazing_rad: Angles, wavenumber: float) -> Angles:
    """Compute the scattering cross-section per unit area and steradian ``(n,)`` [1/sr].

    Args:
        sediment: the sea floor.
        grazing_rad: angle between ray and surface, 0..pi/2 ``(n,)``.
        wavenumber: 2 pi f / c in the water [rad/m].
    """
    return roughness_sigma(sediment, grazing_rad, wavenumber) + volume_sigma(sediment, grazing_rad)


def roughness_sigma(sediment: Sediment, grazing_rad: Angles, wavenumber: float) -> Angles:
    """Compute the roughness contribution ``sin^2 |Y|^2 I(q) / (8 pi cos^2)`` ``(n,)`` [1/sr].

    Y is the factor of first-order perturbation for two fluids, I the integral of :func:`structure_integral`, and
    ``q = 2 C^2 k^2 sin^2 (2 k cos)^(-2 alpha)`` with ``alpha = gamma / 2 - 1`` and the structure constant C^2.

    Args:
        sediment: the sea floor.
        grazing_rad: angle between ray and surface, 0..pi/2 ``(n,)``.
        wavenumber: in the water [rad/m].
    """
    sine, cosine = np.sin(grazing_rad), np.maximum(np.cos(grazing_rad), LOWEST_COSINE)
    alpha = sediment.spectral_exponent / 2 - 1
    below = _sine_below(sediment, cosine)
    rho, kappa = sediment.density_ratio, _relative_wavenumber(sediment)
    factor = ((rho - 1) ** 2 * cosine**2 + rho**2 - kappa**2) / (rho * sine + below) ** 2
    q = 2 * structure_constant(sediment) * (wavenumber * sine) ** 2 * (2 * wavenumber * cosine) ** (-2 * alpha)
    return np.asarray((sine * np.abs(factor) / cosine) ** 2 * structure_integral(q, alpha) / (8 * math.pi))


def structure_constant(sediment: Sediment) -> float:
    """Return C^2 [m^(2 - 2 alpha)]: the mean square height difference at a distance r is ``C^2 r^(2 alpha)``."""
    alpha = sediment.spectral_exponent / 2 - 1
    gammas = math.gamma(2 - alpha) / (alpha * (1 - alpha) * math.gamma(1 + alpha))
    return 2 * math.pi * sediment.spectral_strength * 2 ** (-2 * alpha) * gammas


def structure_integral(q: Angles, alpha: float) -> Angles:
    """Compute ``I(q)``, the integral of ``exp(-q u^(2 alpha)) J0(u) u`` over u from 0 to infinity, ``(n,)``.

    J0 is the real part of a Hankel function. On a ray rotated into the upper half of the complex plane both factors decay,
    and a sum over even steps of log u converges exponentially. Below q = 1, the integral of ``H0(u) u``, which is zero, is
    subtracted first.

    Args:
        q: 0 or more ``(n,)``.
        alpha: 0..1, both excluded.
    """
    # Rotation of the path that keeps both the exponential and the Hankel function decaying.
    turn = min(math.pi / 4, math.pi / (8 * alpha))
    integral = np.zeros_like(q)
    for k, q_k in enumerate(q):
        if q_k > 0:
            begin, end = -19.0, math.log(40 / math.sin(turn))  # limits of log u, beyond which the integrand is negligible
            # A large q moves the scale of the exponential to smaller u, and with it both limits.
            if q_k >= 1:
                begin -= math.log(q_k) / (2 * alpha)
                end = min(end, math.log(40 / (q_k * math.cos(2 * alpha * turn))) / (2 * alpha))
            # Sum over even steps of log u along the rotated ray.
            t = np.exp(np.arange(begin, end, 0.04))
            u = t * np.exp(1j * turn)
            exponent = -q_k * t ** (2 * alpha) * np.exp(2j * alpha * turn)
            decay = np.exp(exponent) if q_k >= 1 else np.expm1(exponent)
            integral[k] = 0.04 * np.sum(decay * hankel1(0, u) * u * u).real
    return integral


def volume_sigma(sediment: Sediment, grazing_rad: Angles) -> Angles:
    """Compute the volume contribution ``5 delta sigma_2 |1 - V^2|^2 sin^2 / (nu ln 10 |P|^2 Im P)`` ``(n,)`` [1/sr].

    V is the reflection coefficient, P the sine of the grazing angle below the surface times the relative wavenumber there.

    Args:
        sediment: the sea floor.
        grazing_rad: angle between ray and surface, 0..pi/2 ``(n,)``.
    """
    sine, below = np.sin(grazing_rad), _sine_below(sediment, np.cos(grazing_rad))
    through = np.abs(1 - reflection(sediment, grazing_rad) ** 2) ** 2 * sine**2
    scale = 5 * sediment.loss * sediment.volume / (sediment.sound_speed_ratio * math.log(10))
    return np.asarray(scale * through / (np.abs(below) ** 2 * below.imag))


def reflection(sediment: Sediment, grazing_rad: Angles) -> NDArray[np.complex128]:
    """Compute the pressure reflection coefficient of the flat surface ``(n,)``."""
    ratio = sediment.density_ratio * np.sin(grazing_rad) / _sine_below(sediment, np.cos(grazing_rad))
    return np.asarray((ratio - 1) / (ratio + 1))


def _relative_wavenumber(sediment: Sediment) -> complex:
    """Return kappa, the wavenumber in the sediment over that in the water."""
    return (1 + 1j * sediment.loss) / sediment.sound_speed_ratio


def _sine_below(sediment: Sediment, cosine: Angles) -> NDArray[np.complex128]:
    """Return P, the vertical wavenumber in the sediment over the wavenumber in the water ``(n,)``."""
    return np.asarray(np.sqrt(_relative_wavenumber(sediment) ** 2 - cosine**2))


# ---------------- Materials and their scattering laws


Law = Literal["lambert", "lommel-seeliger", "rough-fluid", "table"]

Basis = Literal["measured", "computed", "fitted", "extrapolated", "assumed"]
"""What the level of a material is based on, within its band.

``measured``: its scattering was measured there; ``computed`` by a model from properties that were measured there, such as
density and speed of sound; ``fitted`` to a recording; ``extrapolated`` from measurements at other frequencies; ``assumed``
by this project. The weakest number counts, except roughness and law, which most materials assume.
"""

GRAZING_DEG = np.arange(91.0)
"""Grazing angles of every table [deg]."""

LAWS: dict[str, tuple[str, ...]] = {
    "lambert": ("mu",),
    "lommel-seeliger": ("mu",),
    "rough-fluid": ("density_ratio", "sound_speed_ratio", "loss", "volume", "spectral_exponent", "spectral_strength"),
    "table": ("strength_db",),
}
"""Scattering laws, and the keys that each requires."""

MIRROR = ("reflection", "roughness_m")
"""Keys of the mirror part, to be given together or not at all; only ``lambert`` and ``lommel-seeliger`` accept them."""

LARGEST_MU = {"lambert": 1 / math.pi, "lommel-seeliger": 1 / (4 * math.pi)}
"""Value of mu for each law at which some direction of incidence is scattered without loss."""


class Material(CheckedModel):
    """The scattering law of a surface with its parameters, their band and their source."""

    model_config = ConfigDict(allow_inf_nan=False)

    called: ClassVar[str] = "material"

    name: str = Field("custom", max_length=200, description="name of the material")
    about: str = Field("", max_length=2000, description="description of the material")
    source: str = Field("", max_length=20_000, description="where its numbers come from")
    basis: Basis | None = Field(None, description="measured, computed, fitted, extrapolated or assumed within its band")
    law: Law = Field("lambert", description="lambert, lommel-seeliger, rough-fluid or table")
    mu: float | None = Field(None, gt=0, le=1 / math.pi, description="cross-section at normal incidence [1/sr]")
    reflection: float | None = Field(
        None, ge=-1, le=1, description="reflection coefficient of the mirror part, of pressures; -1: the sea surface"
    )
    roughness_m: float | None = Field(None, ge=0, le=1, description="rms height of the roughness of the mirror part [m]")
    density_ratio: float | None = Field(None, ge=0.5, le=20, description="density over that of water")
    sound_speed_ratio: float | None = Field(None, ge=0.5, le=6, description="speed of sound over that of water")
    loss: float | None = Field(None, ge=1e-5, le=0.5, description="imaginary over real part of the wavenumber")
    volume: float | None = Field(None, ge=0, le=1, description="volume cross-section over attenuation in dB")
    spectral_exponent: float | None = Field(None, ge=2.4, le=3.9, description="exponent of the spectrum of heights")
    spectral_strength: float | None = Field(
        None, gt=0, le=1, description="strength of the spectrum of heights [m^(4 - exponent)]"
    )
    strength_db: tuple[Annotated[float, Field(ge=-300, le=60)], ...] | None = Field(
        None, min_length=91, max_length=91, description="10 log sigma at grazing angles of 0, 1 ... 90 deg [dB]"
    )
    frequency_min_hz: float | None = Field(None, gt=0, le=1e9, description="lowest frequency at which the numbers hold [Hz]")
    frequency_max_hz: float | None = Field(None, gt=0, le=1e9, description="highest frequency at which they hold [Hz]")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        mirror = MIRROR if self.law in LARGEST_MU else ()
        given = [key for keys in (*LAWS.values(), MIRROR) for key in keys if getattr(self, key) is not None]
        missing = [key for key in LAWS[self.law] if key not in given]
        unexpected = [key for key in given if key not in LAWS[self.law] + mirror]
        if missing:
            raise ValueError(
                f"a material of law {self.law} needs {', '.join(LAWS[self.law])}: it lacks {', '.join(missing)}"
            )
        if unexpected:
            known = ", ".join(LAWS[self.law] + mirror)
            raise ValueError(f"a material of law {self.law} has no key {unexpected[0]}: its keys are {known}")
        if (self.reflection is None) != (self.roughness_m is None):
            raise ValueError("a mirror part needs both reflection and roughness_m: got one; give both or none")
        low, high = self.band_hz
        if high <= low:
            raise ValueError(f"frequency_max_hz must exceed frequency_min_hz: got {high:g} <= {low:g}")
        if self.mu is not None:
            self._check_energy(self.mu)
        return self

    def _check_energy(self, mu: float) -> None:
        """Reject a mu that would scatter more than the incident power, or more than a mirror part returns."""
        most = LARGEST_MU[self.law] * (1.0 if self.reflection is None else self.reflection**2)
        if mu > most * (1 + 1e-9):
            limit_text = "than arrives" if self.reflection is None else "than its reflection returns"
            raise ValueError(f"mu of law {self.law} is at most {most:.4g}, or more is scattered {limit_text}: got {mu:g}")

    @property
    def band_hz(self) -> tuple[float, float]:
        """Return the lowest and highest frequency at which the numbers are valid [Hz]; 0 and infinity if not given."""
        return self.frequency_min_hz or 0.0, self.frequency_max_hz or math.inf

    @property
    def has_mirror(self) -> bool:
        """Return whether the echo has a mirror (specular) part."""
        return self.reflection is not None


MEGAHERTZ = "-mhz"
"""End of the names of materials for sonars that make images, where those for lower frequencies do not hold."""


def band_warning(one: Material, frequency_hz: float) -> str | None:
    """Return a one-sentence warning if a frequency lies outside the band of a material, else None.

    The sentence names the band, what the level is based on, and the material for the frequency if there is one: ``sand-mhz``
    for ``sand``.
    """
    if _holds(one.band_hz, frequency_hz):
        return None
    low, high = one.band_hz
    band = " ".join(f"{word} {end / 1000:,.4g} kHz" for word, end in (("from", low), ("to", high)) if 0 < end < math.inf)
    family = one.name.removesuffix(MEGAHERTZ)
    others = [other for other in (family, family + MEGAHERTZ) if other != one.name and other in named_materials()]
    better = next((other for other in others if _holds(material(other).band_hz, frequency_hz)), None)
    basis = f" ({one.basis})" if one.basis else ""
    return f"the numbers of material {one.name}{basis} hold {band}: {frequency_hz / 1000:,.4g} kHz is extrapolated" + (
        f"; give {better}, which is meant for it" if better else ""
    )


def _holds(band_hz: tuple[float, float], frequency_hz: float) -> bool:
    return band_hz[0] <= frequency_hz <= band_hz[1]


@lru_cache(maxsize=256)
def sigma_table(material: Material, frequency_hz: float, sound_speed_m_s: float = 1500.0) -> NDArray[np.float64]:
    """Compute the cross-sections of a material at :data:`GRAZING_DEG` ``(91,)`` [1/sr], read-only.

    ====================  ==========================================================================================
    law                   sigma at the grazing angle g
    ====================  ==========================================================================================
    ``lambert``           ``mu sin^2 g``: a matt surface
    ``lommel-seeliger``   ``mu sin g``: grains that scatter once, isotropically, each in the shadow of others
    ``rough-fluid``       :func:`mitsonar.acoustics.materials.rough_fluid_sigma`
    ``table``             as given
    ====================  ==========================================================================================

    With a mirror part, mu is the scattering of a fully rough surface. What the coherent echo of :func:`mirror_amplitude`
    loses is scattered: mu is multiplied by ``1 - exp(-4 k^2 h^2 sin^2 g)``. The two together never exceed the reflection.

    Args:
        material: the material.
        frequency_hz: carrier frequency [Hz].
        sound_speed_m_s: speed of sound in the water [m/s].

    Raises:
        MitsonarError: a frequency or speed that is not positive.
    """
    wavenumber = _wavenumber(frequency_hz, sound_speed_m_s)
    grazing = np.radians(GRAZING_DEG)
    sine = np.sin(grazing)
    table: NDArray[np.float64]
    match material.law:
        case "lambert":
            table = _number(material, "mu") * sine**2 * _rough_share(material, sine, wavenumber)
        case "lommel-seeliger":
            table = _number(material, "mu") * sine * _rough_share(material, sine, wavenumber)
        case "rough-fluid":
            sediment = Sediment(*(_number(material, key) for key in LAWS["rough-fluid"]))
            table = rough_fluid_sigma(sediment, grazing, wavenumber)
        case _:
            table = 10.0 ** (np.asarray(material.strength_db) / 10)
    table.flags.writeable = False
    return table


def sigma_at(material: Material, cosine: AnyArray, frequency_hz: float, sound_speed_m_s: float = 1500.0) -> AnyArray:
    """Evaluate the cross-section of a material at angles of incidence, linear between whole degrees, in float64 [1/sr].

    Args:
        material: the material.
        cosine: cosine of the angle between ray and normal ``(...)``, NumPy or torch; clipped to 0..1.
        frequency_hz: carrier frequency [Hz].
        sound_speed_m_s: speed of sound in the water [m/s].

    Returns:
        Like ``cosine``. The error for a smooth law is within 1e-4 of its largest value.

    Raises:
        MitsonarError: a frequency or speed that is not positive.
    """
    cosine = np.asarray(cosine, dtype=np.float64) if isinstance(cosine, int | float) else cosine
    xp = array_namespace(cosine)
    table = sigma_table(material, float(frequency_hz), float(sound_speed_m_s))
    values = xp.asarray(table.copy(), device=device(cosine))
    place = xp.asin(xp.clip(xp.astype(cosine, xp.float64), 0.0, 1.0)) * (180.0 / math.pi)
    below = xp.clip(xp.floor(place), 0.0, 89.0)
    index = xp.reshape(xp.astype(below, xp.int64), (-1,))
    low, high = (xp.reshape(xp.take(values, one, axis=0), place.shape) for one in (index, index + 1))
    return low + (high - low) * (place - below)


def mirror_amplitude(material: Material, cosine: AnyArray, frequency_hz: float, sound_speed_m_s: float = 1500.0) -> AnyArray:
    """Compute the coherent pressure reflection coefficient of a rough mirror, ``V exp(-2 k^2 h^2 cos^2)``.

    V is ``reflection``, assumed independent of the angle, h is ``roughness_m`` and k the wavenumber. The factor is that of
    Gaussian heights in the Kirchhoff approximation (Jackson and Richardson, High-Frequency Seafloor Acoustics, 2007).

    Args:
        material: the material.
        cosine: cosine of the angle between ray and normal ``(...)``, NumPy or torch.
        frequency_hz: carrier frequency [Hz].
        sound_speed_m_s: speed of sound in the water [m/s].

    Returns:
        Like ``cosine``; zero without a mirror part.

    Raises:
        MitsonarError: a frequency or speed that is not positive.
    """
    cosine = np.asarray(cosine, dtype=np.float64) if isinstance(cosine, int | float) else cosine
    height = _wavenumber(frequency_hz, sound_speed_m_s) * (material.roughness_m or 0.0)
    return (material.reflection or 0.0) * array_namespace(cosine).exp(cosine * cosine * (-2.0 * height * height))


def _rough_share(material: Material, sine: NDArray[np.float64], wavenumber: float) -> NDArray[np.float64]:
    """Return the share of the intensity that roughness removes from a mirror ``(n,)``; one without a mirror part."""
    if material.roughness_m is None:
        return np.ones_like(sine)
    return np.asarray(-np.expm1(-4 * (wavenumber * material.roughness_m * sine) ** 2))


def _wavenumber(frequency_hz: float, sound_speed_m_s: float) -> float:
    """Return 2 pi f / c [rad/m]."""
    for value, name in ((frequency_hz, "frequency_hz"), (sound_speed_m_s, "sound_speed_m_s")):
        if not 0 < value < math.inf:
            raise MitsonarError(f"{name} must be a finite number above 0: got {short_repr(value)}")
    return 2 * math.pi * frequency_hz / sound_speed_m_s


def _number(material: Material, key: str) -> float:
    """Return a parameter that the material's law requires, and which is therefore set."""
    return float(getattr(material, key))


# ---------------- Named materials


@cache
def named_materials() -> dict[str, Preset]:
    """Return all named materials of the package, by name."""
    return presets_in("mitsonar.acoustics", "materials")


def material(name_or_file: str | Path) -> Material:
    """Load a material by its name, or from a YAML file (keys: the fields of :class:`Material`, and ``material``).

    The optional key ``material`` names a base material whose numbers the other keys replace. If they give another ``law``,
    only name, description and band of the base are used. The key ``grain_size_phi`` sets the parameters of a sediment of
    that mean grain size (:func:`mitsonar.acoustics.materials.sediment_of`), which the other keys also replace.

    Raises:
        MitsonarError: unknown name (suggesting the nearest ones), unreadable file, unknown key, or value outside its limits.
    """
    text = str(name_or_file)
    if not text.lower().endswith((".yaml", ".yml")):
        if text in named_materials() or not os.path.exists(text):
            return Material.create(**_named_fields(text))
        raise MitsonarError(f"a material's file ends in .yaml: got {text}; rename it, or name a material")
    fields = read_yaml(text, "material file", " or a material's name")
    if not isinstance(fields, dict) or not all(isinstance(key, str) for key in fields):
        raise MitsonarError(f"{text} must hold `key: value` lines of a material")
    fields = _fill_from_grain_size(fields, text)
    base = fields.pop("material", None)
    if not isinstance(base, str | None):
        raise MitsonarError(f"material in {text} must name a material: got {short_repr(base)}")
    base_fields = {} if base is None else _named_fields(base)
    if fields.get("law", base_fields.get("law")) != base_fields.get("law"):
        numeric_keys = {key for keys in (*LAWS.values(), MIRROR) for key in keys}
        base_fields = {key: value for key, value in base_fields.items() if key not in numeric_keys}
    return Material.create(**{**base_fields, "name": Path(text).stem, **fields})


def _fill_from_grain_size(fields: dict[str, PlainValue], text: str) -> dict[str, PlainValue]:
    """Return the fields of a file, completed from its grain size if it gives one; explicit fields take precedence."""
    if "grain_size_phi" not in fields:
        return fields
    phi = fields.pop("grain_size_phi")
    if isinstance(phi, bool) or not isinstance(phi, int | float):
        raise MitsonarError(f"grain_size_phi in {text} must be a number: got {short_repr(phi)}")
    if "material" in fields:
        raise MitsonarError(f"grain_size_phi and material both set the parameters: {text} gives both; omit one of them")
    band = {"frequency_min_hz": 10e3, "frequency_max_hz": 100e3}
    source = f"grain size of {phi:g} phi: regressions of APL-UW TR 9407 (1994), section IV (not seen)"
    return {"law": "rough-fluid", "source": source, **band, **sediment_of(float(phi))._asdict(), **fields}


def _named_fields(name: str) -> dict[str, PlainValue]:
    """Return the fields of a named material, with its sources joined into one text."""
    known = named_materials()
    if name not in known:
        raise MitsonarError(f"unknown material {short_repr(name)}: {suggest_names(name, known)}")
    entry = known[name]
    source = "; ".join(f"{key}: {text}" for key, text in entry.sources.items())
    return {"name": name, "about": entry.about, "source": source, **entry.values}


# ---------------- Checks for mirrors and multiple reflections


def check_image_mirrors(sonar: Sonar, views: Sequence[View] | None, mirrors: bool) -> None:
    """Check that an imaging sonar supports the requested mirrors and multiple reflections.

    Args:
        sonar: the instrument.
        views: views of its images; None: the whole.
        mirrors: whether shapes are to reflect as mirrors.

    Raises:
        MitsonarError: mirrors in a model without them, or multiple reflections with remote receivers or partial views.
    """
    if mirrors and sonar.model != "coherent" and sonar.bounces == 1:
        raise MitsonarError(
            f"the model {sonar.model} has no mirrors: give the sonar model coherent"
            + (", or bounces 2" if sonar.model == "physical" else "")
        )
    if sonar.bounces > 1 and any(not isinstance(view, Whole) for view in views or ()):
        raise MitsonarError("separate receivers and segments support one reflection: omit bounces, or render the whole view")


def check_channel_mirrors(sonar: ChannelSonar, mirrors: bool, lacking: str) -> None:
    """Check that bounces come with mirrors, and that the model ``rays`` has no mirrors.

    Args:
        sonar: the instrument.
        mirrors: whether any shape reflects as a mirror.
        lacking: text of the error if the instrument needs mirrors and the scene has none.

    Raises:
        MitsonarError: an unsupported combination.
    """
    if sonar.bounces > 1 and not mirrors:
        raise MitsonarError(f"bounces {sonar.bounces} need mirrors, and the scene has none: {lacking}")
    if mirrors and sonar.model == "rays":
        raise MitsonarError("mirrors need the model scatterers: got the model rays; omit them, or choose scatterers")
