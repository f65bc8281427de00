"""Backscatter of surfaces: a material is a table of its scattering cross-section over the grazing angle.

The cross-section sigma is that per unit area and steradian [1/sr], for sound that returns where it came from.
``10 log sigma`` is the bottom scattering strength. The grazing angle lies between ray and surface; its sine is the cosine
of incidence.

The simulator's reflectivity C is Lambert's mu itself, not pi mu. A surface of C = 1 scatters pi times what arrives, 5 dB
more than it can. A material's mu is physical: ``pi mu`` is at most 1. Where C is to mean the share that is scattered, mu is
C / pi.

Named materials are one YAML file each in ``materials/``, every number with its source. In a source ``(not seen)`` marks a
number that is widely quoted from a document which could not be read when this was written, ``second hand`` one that a third
party quotes from the named document, ``ours`` a choice or our own arithmetic.
"""

from __future__ import annotations

import math
import os
from functools import cache, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import numpy as np
import yaml
from array_api_compat import array_namespace, device
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator

from mitsonar.acoustics.grain_size import sediment_of
from mitsonar.acoustics.rough_fluid import Sediment, rough_fluid_sigma
from mitsonar.arrays import AnyArray
from mitsonar.errors import MitsonarError, nearest_names, shortened
from mitsonar.io.checked_model import CheckedModel
from mitsonar.io.files import PlainValue, read_yaml

__all__ = [
    "GRAZING_DEG",
    "LAWS",
    "Law",
    "Material",
    "NamedMaterial",
    "band_warning",
    "material",
    "mirror_amplitude",
    "named_materials",
    "sigma_at",
    "sigma_table",
]

Law = Literal["lambert", "lommel-seeliger", "rough-fluid", "table"]

GRAZING_DEG = np.arange(91.0)
"""Grazing angles of every table [deg]."""

LAWS: dict[str, tuple[str, ...]] = {
    "lambert": ("mu",),
    "lommel-seeliger": ("mu",),
    "rough-fluid": ("density_ratio", "sound_speed_ratio", "loss", "volume", "spectral_exponent", "spectral_strength"),
    "table": ("strength_db",),
}
"""Laws of scattering, and the keys that each needs."""

MIRROR = ("reflection", "roughness_m")
"""Keys of the mirror part, both or none; ``lambert`` and ``lommel-seeliger`` may have them."""

LARGEST_MU = {"lambert": 1 / math.pi, "lommel-seeliger": 1 / (4 * math.pi)}
"""The mu of each law at which some direction of arrival is scattered without loss."""


class Material(CheckedModel):
    """What a surface is made of: a law of scattering with its numbers, where they hold and where they come from."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    called: ClassVar[str] = "material"

    name: str = Field("custom", max_length=200, description="what the material is called")
    about: str = Field("", max_length=2000, description="what it stands for")
    source: str = Field("", max_length=20_000, description="where its numbers come from")
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

    @classmethod
    def create(cls, **fields: PlainValue) -> Self:
        """Create a material with these fields.

        Raises:
            MitsonarError: an unknown key, a value outside its limits, or keys that do not fit the law.
        """
        return cls(**fields)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        mirror = MIRROR if self.law in LARGEST_MU else ()
        given = [key for keys in (*LAWS.values(), MIRROR) for key in keys if getattr(self, key) is not None]
        lacking = [key for key in LAWS[self.law] if key not in given]
        strange = [key for key in given if key not in LAWS[self.law] + mirror]
        if lacking:
            raise ValueError(
                f"a material of law {self.law} needs {', '.join(LAWS[self.law])}: it lacks {', '.join(lacking)}"
            )
        if strange:
            known = ", ".join(LAWS[self.law] + mirror)
            raise ValueError(f"a material of law {self.law} has no key {strange[0]}: its keys are {known}")
        if (self.reflection is None) != (self.roughness_m is None):
            raise ValueError("a mirror part needs both reflection and roughness_m: got one; give both or none")
        low, high = self.band_hz
        if high <= low:
            raise ValueError(f"frequency_max_hz must exceed frequency_min_hz: got {high:g} <= {low:g}")
        if self.mu is not None:
            self._check_energy(self.mu)
        return self

    def _check_energy(self, mu: float) -> None:
        """Refuse a mu by which more would be scattered than arrives, or than a mirror part would return."""
        most = LARGEST_MU[self.law] * (1.0 if self.reflection is None else self.reflection**2)
        if mu > most * (1 + 1e-9):
            than = "than arrives" if self.reflection is None else "than its reflection returns"
            raise ValueError(f"mu of law {self.law} is at most {most:.4g}, or more is scattered {than}: got {mu:g}")

    @property
    def band_hz(self) -> tuple[float, float]:
        """Return the lowest and the highest frequency at which the numbers hold [Hz]; 0 and infinity where none is given."""
        return self.frequency_min_hz or 0.0, self.frequency_max_hz or math.inf

    @property
    def has_mirror(self) -> bool:
        """Return whether a part of the echo is a mirror's."""
        return self.reflection is not None


def band_warning(material: Material, frequency_hz: float) -> str | None:
    """Say in one sentence where a frequency lies outside the band of a material; None where it lies within."""
    low, high = material.band_hz
    if low <= frequency_hz <= high:
        return None
    end = f"from {low / 1000:,.4g} kHz" if frequency_hz < low else f"to {high / 1000:,.4g} kHz"
    return f"the numbers of material {material.name} hold {end}: {frequency_hz / 1000:,.4g} kHz is extrapolated"


@lru_cache(maxsize=256)
def sigma_table(material: Material, frequency_hz: float, sound_speed_m_s: float = 1500.0) -> NDArray[np.float64]:
    """Compute the cross-sections of a material at :data:`GRAZING_DEG` ``(91,)`` [1/sr], read-only.

    ====================  ==========================================================================================
    law                   sigma at the grazing angle g
    ====================  ==========================================================================================
    ``lambert``           ``mu sin^2 g``: a matt surface
    ``lommel-seeliger``   ``mu sin g``: grains that scatter once, evenly to all sides, each in the shadow of others
    ``rough-fluid``       :mod:`mitsonar.acoustics.rough_fluid`
    ``table``             as given
    ====================  ==========================================================================================

    With a mirror part, mu is what a fully rough surface scatters. The rest of the coherent echo of :func:`mirror_amplitude`
    is scattered: mu is multiplied by ``1 - exp(-4 k^2 h^2 sin^2 g)``. Both together never exceed the reflection.

    Args:
        material: the material.
        frequency_hz: of the carrier.
        sound_speed_m_s: in the water.

    Raises:
        MitsonarError: a frequency or speed that is not above 0.
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
    """Gather the cross-section of a material at angles of incidence, linear between whole degrees, in float64 [1/sr].

    Args:
        material: the material.
        cosine: of the angle between ray and normal ``(...)``, NumPy or torch; clipped to 0..1.
        frequency_hz: of the carrier.
        sound_speed_m_s: in the water.

    Returns:
        Like ``cosine``. A smooth law is met within 1e-4 of its largest value.

    Raises:
        MitsonarError: a frequency or speed that is not above 0.
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
    """Compute the coherent reflection coefficient of a rough mirror, ``V exp(-2 k^2 h^2 cos^2)``, of pressures.

    V is ``reflection``, taken the same at all angles, h ``roughness_m``, k the wavenumber. The factor is that of Gaussian
    heights in Kirchhoff's approximation (Jackson and Richardson, High-Frequency Seafloor Acoustics, 2007).

    Args:
        material: the material.
        cosine: of the angle between ray and normal ``(...)``, NumPy or torch.
        frequency_hz: of the carrier.
        sound_speed_m_s: in the water.

    Returns:
        Like ``cosine``; zero without a mirror part.

    Raises:
        MitsonarError: a frequency or speed that is not above 0.
    """
    cosine = np.asarray(cosine, dtype=np.float64) if isinstance(cosine, int | float) else cosine
    height = _wavenumber(frequency_hz, sound_speed_m_s) * (material.roughness_m or 0.0)
    return (material.reflection or 0.0) * array_namespace(cosine).exp(cosine * cosine * (-2.0 * height * height))


def _rough_share(material: Material, sine: NDArray[np.float64], wavenumber: float) -> NDArray[np.float64]:
    """Return the share of the intensity that roughness takes from a mirror ``(n,)``; one without a mirror part."""
    if material.roughness_m is None:
        return np.ones_like(sine)
    return np.asarray(-np.expm1(-4 * (wavenumber * material.roughness_m * sine) ** 2))


def _wavenumber(frequency_hz: float, sound_speed_m_s: float) -> float:
    """Return 2 pi f / c [rad/m]."""
    for value, name in ((frequency_hz, "frequency_hz"), (sound_speed_m_s, "sound_speed_m_s")):
        if not 0 < value < math.inf:
            raise MitsonarError(f"{name} must be a finite number above 0: got {shortened(value)}")
    return 2 * math.pi * frequency_hz / sound_speed_m_s


def _number(material: Material, key: str) -> float:
    """Return a number that the material's law needs, and which is therefore there."""
    return float(getattr(material, key))


# ---------------------------------------------------------------- named materials


class NamedMaterial(NamedTuple):
    """A material of the package.

    Attributes:
        about: what it stands for.
        values: of the fields of :class:`Material`, by name.
        sources: where each value comes from.
    """

    about: str
    values: dict[str, PlainValue]
    sources: dict[str, str]


@cache
def named_materials() -> dict[str, NamedMaterial]:
    """Return all named materials by name, from the files of the package."""
    found = {}
    for path in sorted((files("mitsonar.acoustics") / "materials").iterdir(), key=lambda path: path.name):
        table = yaml.safe_load(path.read_text(encoding="utf-8"))
        values, sources = ({key: one[part] for key, one in table["keys"].items()} for part in ("value", "source"))
        found[path.name.removesuffix(".yaml")] = NamedMaterial(table["about"], values, sources)
    return found


def material(name_or_file: str | Path) -> Material:
    """Load a material by its name, or from a YAML file (keys: the fields of :class:`Material`, and ``material``).

    The key ``material`` (optional) names a material whose numbers the others replace. Where they give another ``law``, only
    name, description and band are taken over. The key ``grain_size_phi`` gives the numbers of a sediment of that mean grain
    size (:mod:`mitsonar.acoustics.grain_size`), which the others replace too.

    Raises:
        MitsonarError: unknown name (with the nearest ones), unreadable file, unknown key, value out of limits.
    """
    text = str(name_or_file)
    if not text.lower().endswith((".yaml", ".yml")):
        if text in named_materials() or not os.path.exists(text):
            return Material.create(**_named(text))
        raise MitsonarError(f"a material's file ends in .yaml: got {text}; rename it, or name a material")
    fields = read_yaml(text, "material file", " or a material's name")
    if not isinstance(fields, dict) or not all(isinstance(key, str) for key in fields):
        raise MitsonarError(f"{text} must hold `key: value` lines of a material")
    fields = _by_grain_size(fields, text)
    base = fields.pop("material", None)
    if not isinstance(base, str | None):
        raise MitsonarError(f"material in {text} must name a material: got {shortened(base)}")
    kept = {} if base is None else _named(base)
    if fields.get("law", kept.get("law")) != kept.get("law"):
        numbers = {key for keys in (*LAWS.values(), MIRROR) for key in keys}
        kept = {key: value for key, value in kept.items() if key not in numbers}
    return Material.create(**{**kept, "name": Path(text).stem, **fields})


def _by_grain_size(fields: dict[str, PlainValue], text: str) -> dict[str, PlainValue]:
    """Return the fields of a file with the numbers of its grain size, where it gives one; its own numbers win."""
    if "grain_size_phi" not in fields:
        return fields
    phi = fields.pop("grain_size_phi")
    if isinstance(phi, bool) or not isinstance(phi, int | float):
        raise MitsonarError(f"grain_size_phi in {text} must be a number: got {shortened(phi)}")
    if "material" in fields:
        raise MitsonarError(f"grain_size_phi and material say the same: {text} gives both; leave one of them out")
    band = {"frequency_min_hz": 10e3, "frequency_max_hz": 100e3}
    source = f"grain size of {phi:g} phi: regressions of APL-UW TR 9407 (1994), section IV (not seen)"
    return {"law": "rough-fluid", "source": source, **band, **sediment_of(float(phi))._asdict(), **fields}


def _named(name: str) -> dict[str, PlainValue]:
    """Return the fields of a named material, its sources in one text."""
    known = named_materials()
    if name not in known:
        raise MitsonarError(f"unknown material {shortened(name)}: {nearest_names(name, known)}")
    one = known[name]
    source = "; ".join(f"{key}: {text}" for key, text in one.sources.items())
    return {"name": name, "about": one.about, "source": source, **one.values}
