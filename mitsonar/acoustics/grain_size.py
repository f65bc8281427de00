"""The sediment of a mean grain size, -1 phi (sandy gravel) to 9 phi (clay), as numbers of a rough fluid.

The regressions are those of APL-UW TR 9407 (1994), section IV, which could not be read: they are quoted from memory of the
literature. At -1, 0.5, 1.5, 2.5 and 6 phi they give the numbers of a program of D. R. Jackson as the project hyo2_openbst
has them, which is a second route (``tests/acoustics/test_grain_size.py``). They hold for 10 to 100 kHz.
"""

from __future__ import annotations

from mitsonar.acoustics.rough_fluid import Sediment
from mitsonar.errors import MitsonarError, argument, shortened

__all__ = ["COARSEST_PHI", "FINEST_PHI", "SEDIMENTS", "sediment_of"]

COARSEST_PHI, FINEST_PHI = -1.0, 9.0
"""Grain sizes that the regressions cover: phi is minus the logarithm to base 2 of the diameter in mm."""

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
"""Names of sediments, and the grain size that stands for each [phi]."""

SPECTRAL_EXPONENT = 3.25

WATER_M_S = 1528.0
"""Speed of sound of the water that attenuations refer to [m/s]."""

LOSS_OF_ATTENUATION = 2.302585093 / (40 * 3.141592654) * 1e-3
"""Loss parameter of an attenuation of 1 dB/m/kHz and a speed of 1 m/s."""


def sediment_of(phi: float) -> Sediment:
    """Return the rough fluid that stands for a sediment of a mean grain size.

    Args:
        phi: mean grain size, -1..9.

    Raises:
        MitsonarError: a grain size outside the regressions.
    """
    if not COARSEST_PHI <= phi <= FINEST_PHI:
        raise MitsonarError(
            f"{argument('grain_size_phi')} must lie in {COARSEST_PHI:g}..{FINEST_PHI:g}, sandy gravel to clay: got "
            f"{shortened(phi)}; give rock the named material, or numbers of your own"
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
    """Return the strength of the spectrum of heights [m^(4 - 3.25)], from that in cm^4 at 1 / cm."""
    height_cm = (2.03846 - 0.26923 * phi) / (1 + 0.076923 * phi) if phi < 5 else 0.5
    centimetre = 0.01
    return float(0.00207 * height_cm**2 * centimetre**4 * centimetre**-SPECTRAL_EXPONENT)
