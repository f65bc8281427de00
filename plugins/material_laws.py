"""Evaluate the scattering laws of materials on the device, at the angle of each ray."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.materials import FLATTEST, Material, mu_table, normal_mu, reference_hz
from mitsonar.arrays import DeviceArray
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.plugins.acoustic_material import AcousticMaterial, is_acoustic_material

__all__ = ["law_rows", "material_of", "mirror_rows", "weighed"]

ENTRIES = 91
"""Number of pairs per material: 90 of a value and its change to the next degree, and one with the power of the sine."""


RELATIVE_STEP, STEP_AT_ZERO = 1e-4, 1e-6
"""Steps of the differences that give the derivatives of laws by their constants, in float64: relative, and at 0."""


def law_rows(materials: Sequence[AcousticMaterial], sonar: Sonar) -> mi.Float:
    """Return the laws of materials for one sonar, relative to the single reflectivity that each has without a law.

    They carry derivatives by those constants of a material that have any.

    Args:
        materials: one BSDF per material.
        sonar: sonar of the models ``physical`` or ``coherent``, or of ``thesis``, which has no laws.
    """
    rows = [_row(one.material, one.mu, sonar) for one in materials]
    laws = mi.Float(np.concatenate(rows).tolist())
    for number, one in enumerate(materials):
        for name, constant in one.constants.items():
            if dr.grad_enabled(constant):
                change = _change(one, name, constant, sonar)
                dr.scatter_add(laws, change, dr.arange(mi.UInt32, 2 * ENTRIES) + 2 * ENTRIES * number)
    return laws


def _row(material: Material, mu: float, sonar: Sonar) -> NDArray[np.float64]:
    """Return the row of a material relative to a single reflectivity, flat ``(2 ENTRIES,)``."""
    row = np.zeros((ENTRIES, 2))
    frequency = sonar.frequency_hz or reference_hz(material)
    if sonar.model == "thesis":
        row[:90, 0] = normal_mu(material, frequency, sonar.sound_speed) / mu
        row[90, 0] = 2
        return row.ravel()
    table = mu_table(material, frequency, sonar.sound_speed)
    row[:90, 0], row[:90, 1] = table.values[:-1] / mu, np.diff(table.values) / mu
    row[90, 0] = table.power
    return row.ravel()


def _change(bsdf: AcousticMaterial, name: str, constant: mi.Float, sonar: Sonar) -> mi.Float:
    """Return what is added to the row of a material: 0, with the derivatives by one of its constants."""
    given = np.atleast_1d(np.asarray(getattr(bsdf.material, name), dtype=np.float64))
    change = dr.zeros(mi.Float, 2 * ENTRIES)
    for index, number in enumerate(given):
        step = abs(number) * RELATIVE_STEP or STEP_AT_ZERO
        above, below = (_row(_changed(bsdf.material, name, index, number + by), bsdf.mu, sonar) for by in (step, -step))
        value = dr.gather(mi.Float, constant, mi.UInt32(index))
        change += mi.Float(((above - below) / (2 * step)).tolist()) * (value - dr.detach(value))
    return change


def _changed(material: Material, name: str, index: int, number: float) -> Material:
    """Return a material with another constant, also just outside the limits of a file's."""
    given = getattr(material, name)
    value = (*given[:index], number, *given[index + 1 :]) if isinstance(given, tuple) else number
    return material.model_copy(update={name: value})


def mirror_rows(materials: Sequence[Material]) -> mi.Float:
    """Return the reflection coefficient at normal incidence and rms height [m] per material; zeros without a mirror part."""
    return mi.Float([number for one in materials for number in (one.reflection or 0.0, one.roughness_m or 0.0)])


def weighed(laws: mi.Float, material: DeviceArray, reflectivity: DeviceArray, cosine: DeviceArray) -> DeviceArray:
    """Return the effective reflectivity of points at the angle of their rays; unchanged without a material.

    It equals that of :func:`mitsonar.acoustics.materials.mu_at`, and is at most 1 / cosine.

    Args:
        laws: result of :func:`law_rows`.
        material: material number of each point; -1 without one.
        reflectivity: reflectivity of the points without a law.
        cosine: cosine of the angle between ray and normal, 0..1.
    """
    known = material >= 0
    # Interpolate the tabulated law between whole degrees of the grazing angle.
    grazing_deg = dr.asin(cosine) * (180 / math.pi)
    below = dr.select(grazing_deg < 89, dr.floor(grazing_deg), 89)
    begin = mi.UInt32(dr.select(known, material, 0)) * ENTRIES
    value = dr.gather(mi.Vector2f, laws, begin + mi.UInt32(below), known)
    power = dr.gather(mi.Vector2f, laws, begin + 90, known).x
    # Restore the power of the sine that was divided out of the table, then limit the result to 1 / cosine.
    steep = dr.select(cosine > FLATTEST, cosine, FLATTEST)
    shape = dr.select(power > 1.5, 1, dr.select(power > 0.5, 1 / steep, 1 / (steep * steep)))
    law = reflectivity * (value.x + value.y * (grazing_deg - below)) * shape
    return dr.select(known, dr.select(law * steep < 1, law, 1 / steep), reflectivity)


class _Children(mi.TraversalCallback):
    """Traversal that collects the BSDFs directly below an object."""

    def __init__(self) -> None:
        super().__init__()
        self.bsdfs: list[mi.BSDF] = []

    def put(self, name: str, value: object, flags: int, cpptype: object = None) -> None:
        """Collect a value if it is a BSDF; Mitsuba calls this for each parameter."""
        if isinstance(value, mi.BSDF):
            self.bsdfs.append(value)


def material_of(shape: mi.Shape) -> AcousticMaterial | None:
    """Return the material of a shape, even if another BSDF wraps it; None without one.

    Raises:
        MitsonarError: several materials, or a material together with another BSDF.
    """
    materials, others = _leaves(shape.bsdf())
    names = sorted({one.material.name for one in materials})
    if len(materials) > 1 or (materials and others):
        raise MitsonarError(
            f"shape {shape.id()} must have a single material: got {', '.join(names)} together with another BSDF; "
            "acoustic_material covers both sides, use it alone"
        )
    return materials[0] if materials else None


def _leaves(bsdf: mi.BSDF) -> tuple[list[AcousticMaterial], int]:
    """Return the distinct materials at or below a BSDF, and the number of other BSDFs that contain none."""
    if is_acoustic_material(bsdf):
        return [cast(AcousticMaterial, bsdf)], 0
    children = _Children()
    bsdf.traverse(children)
    if not children.bsdfs:
        return [], 1
    materials: list[AcousticMaterial] = []
    others = 0
    for child in children.bsdfs:
        below = _leaves(child)
        materials += [one for one in below[0] if all(one is not other for other in materials)]
        others += below[1]
    return materials, others
