"""The mirror part of smooth surfaces: which shapes have one, how much of an echo it is, and what is left to scatter.

A shape of reflection coefficient V and rms height h reflects the amplitude ``V exp(-2 k^2 h^2 cos^2)`` as a mirror: its
energy is ``V^2 exp(-4 k^2 h^2 cos^2)``. What it scatters is multiplied by ``1 - exp(-4 k^2 h^2 cos^2)``. Both are the laws
of :mod:`mitsonar.acoustics.materials`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.materials import Material
from mitsonar.errors import MitsonarError, nearest_names, shortened
from mitsonar.plugins.material_laws import material_of
from mitsonar.plugins.surfaces import Hit
from mitsonar.simulation.device_arrays import DeviceArray

__all__ = ["MirrorPart", "Mirroring", "Mirrors", "mirror_of"]

MirrorPart: TypeAlias = tuple[float, float] | Material
"""Reflection coefficient of pressures, -1 to 1, and rms height of the roughness [m]; or a material that has both."""

Mirroring: TypeAlias = Mapping[str, MirrorPart] | Literal["materials"] | None
"""Mirror parts by the ids of the shapes, those of the shapes' materials, or none."""

ROUGHEST_M = 1.0
"""Largest rms height [m]."""


@dataclass(frozen=True)
class Mirrors:
    """Mirror parts of the shapes of a scene, by their place in ``scene.shapes()``.

    Attributes:
        reflection: coefficient V of pressures ``(shapes,)``, 0: no mirror part.
        roughness_m: rms height ``(shapes,)`` [m].
    """

    reflection: NDArray[np.float64]
    roughness_m: NDArray[np.float64]

    def table(self) -> mi.Float:
        """Return V and rms height in turn, and zeros for one shape more: the input of a launch."""
        rows = np.append(np.stack([self.reflection, self.roughness_m], axis=1), np.zeros((1, 2)), axis=0)
        return mi.Float(rows.ravel().astype(np.float32))


def mirror_of(scene: mi.Scene, mirrors: Mirroring) -> Mirrors | None:
    """Collect the mirror parts of a scene's shapes; None where there are none.

    Args:
        scene: any.
        mirrors: parts by the ids of the shapes, or ``materials``: those of each shape's ``acoustic_material``. A material
            without a mirror part gives none.

    Raises:
        MitsonarError: a shape that the scene does not have, or a number out of limits.
    """
    if isinstance(mirrors, str):
        mirrors = _of_materials(scene, mirrors)
    if not isinstance(mirrors, Mapping | None):
        raise MitsonarError(f"mirrors are parts by the ids of the shapes, or `materials`: got {shortened(mirrors)}")
    names = [shape.id() for shape in scene.shapes()]
    found = Mirrors(np.zeros(len(names)), np.zeros(len(names)))
    for name, part in (mirrors or {}).items():
        if name not in names:
            raise MitsonarError(f"mirrors: the scene has no shape {name}: {nearest_names(name, names)}")
        reflection, roughness_m = _numbers_of(name, part)
        if not (-1 <= reflection <= 1 and 0 <= roughness_m <= ROUGHEST_M):
            raise MitsonarError(
                f"mirrors: the reflection of {name} lies in -1..1 and its rms height in 0..{ROUGHEST_M:g} m: "
                f"got {reflection:g} and {roughness_m:g}"
            )
        for place in (place for place, own in enumerate(names) if own == name):
            found.reflection[place], found.roughness_m[place] = reflection, roughness_m
    return found if found.reflection.any() else None


def _numbers_of(name: str, part: MirrorPart) -> tuple[float, float]:
    """Return reflection and rms height [m] of a mirror part; without either 0."""
    if isinstance(part, Material):
        return part.reflection or 0.0, part.roughness_m or 0.0
    try:
        reflection, roughness_m = (float(number) for number in part)
    except (TypeError, ValueError):
        raise MitsonarError(
            f"mirrors: {name} takes a pair, reflection and rms height in m, such as (-1.0, 0.0): got {shortened(part)}"
        ) from None
    return reflection, roughness_m


def _of_materials(scene: mi.Scene, asked: str) -> dict[str, MirrorPart]:
    """Return the materials of a scene's shapes by the shapes' ids."""
    if asked != "materials":
        raise MitsonarError(f"mirrors are parts by the ids of the shapes, or `materials`: got {asked!r}")
    found: dict[str, MirrorPart] = {}
    for shape in scene.shapes():
        own = material_of(shape) if shape.bsdf() is not None else None
        if own is not None:
            found[shape.id()] = own.material
    return found


def refuse_moving_mirrors(scene: mi.Scene, mirrors: Mirroring, moving: Collection[str]) -> None:
    """Refuse mirrors that move: images of the sonar are of planes that stand still.

    Args:
        scene: any.
        mirrors: as of :func:`mirror_of`.
        moving: ids of the shapes that move.

    Raises:
        MitsonarError: a mirror moves.
    """
    found = mirror_of(scene, mirrors)
    for shape, reflection in zip(scene.shapes(), [] if found is None else found.reflection, strict=found is not None):
        if reflection != 0 and shape.id() in moving:
            raise MitsonarError(
                f"mirrors stand still: got {shape.id()}, which moves; name the mirrors by the ids of still shapes, or leave "
                "its trajectory out"
            )


def parts_at(table: mi.Float, hit: Hit) -> tuple[DeviceArray, DeviceArray]:
    """Return V and rms height [m] where rays hit, 0 where there is no mirror part."""
    known = hit.valid & (hit.shape_id >= 0)
    pair = dr.gather(mi.Vector2f, table, mi.UInt32(dr.select(known, hit.shape_id, 0)), known)
    return pair.x, pair.y


def smooth_share(roughness_m: DeviceArray, cosine: DeviceArray, wavenumber: float) -> DeviceArray:
    """Return the amplitude that roughness leaves of a mirror's, ``exp(-2 k^2 h^2 cos^2)``."""
    return dr.exp(-2 * dr.square(roughness_m * cosine * wavenumber))


def without_mirror_part(table: mi.Float, hit: Hit, d: DeviceArray, wavenumber: float) -> Hit:
    """Return hits whose reflectivity is what roughness takes from the mirror part; others stay as they are.

    The law of a material holds that share already.
    """
    reflection, roughness_m = parts_at(table, hit)
    taken = 1 - dr.square(smooth_share(roughness_m, dr.dot(hit.n, d), wavenumber))
    return replace(
        hit, reflectivity=dr.select((reflection == 0) | (hit.material >= 0), hit.reflectivity, hit.reflectivity * taken)
    )
