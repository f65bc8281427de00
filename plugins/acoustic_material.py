"""The BSDF ``acoustic_material``: a surface whose echo depends on the grazing angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsonar.acoustics.materials import LAWS, Material, material, named_materials, single_mu
from mitsonar.arrays import DeviceArray
from mitsonar.errors import MitsonarError
from mitsonar.plugins.hashed_texture import number_of_property
from mitsonar.plugins.native_plugins import load_dict

__all__ = ["AcousticMaterial", "is_acoustic_material"]

SHADE = 0.5
"""Default reflectance for cameras."""

NO_MATERIAL = "none"
"""Name that selects a surface without a material."""

LOUDEST, FAINTEST = 1.0, 1e-6
"""Limits of the single reflectivity that represents a material where its scattering law is not evaluated."""


class AcousticMaterial(mi.BSDF):
    """A surface of a material of :mod:`mitsonar.acoustics.materials`: its echo follows a law of the grazing angle.

    Properties: ``material``: a name, or a YAML file (relative to the scene's folder), or ``none``, which gives a plain
    ``diffuse`` whose reflectance is the reflectivity; ``reflectance`` [0.5]: a texture or number. ``reflectance_mean`` [the
    mean of the texture]: what the reflectance is divided by for sonars; required for ``mesh_attribute``. ``level_db`` [0]:
    added to the scattering strength of the material. ``mi.traverse`` shows it and the constants of the law, such as
    ``mu`` or ``density_ratio``, with derivatives.

    Cameras see a diffuse surface of that reflectance, from both sides. For sonars only its relative variation matters: it is
    divided by its mean, and multiplies the cross-section. A plain number therefore affects only camera images.

    The models ``physical`` and ``coherent`` evaluate the law at each ray's angle, at the sonar's frequency. The model
    ``thesis`` uses the mu of the law, or sigma at normal incidence, for all angles. Impulse responses, other sensors and
    shapes of a ``shapegroup`` use mu, or sigma / sin^2 at 45 deg grazing.

    Not modelled: transmission, two materials on one shape; the mirror part echoes only where the simulator is given mirrors.

    .. code-block:: xml

        <bsdf type="acoustic_material">
            <string name="material" value="sand"/>
            <texture type="cell_noise" name="reflectance"/>
        </bsdf>
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.material = _material(str(props.get("material", "")))
        self.reflectance = cast(mi.Texture, props.get_texture("reflectance", SHADE))
        self.given_mean = number_of_property(props, "reflectance_mean", 0.0)
        self.mean = _mean(self.reflectance, self.given_mean)
        self.level_db = mi.Float(number_of_property(props, "level_db", 0.0))
        self.constants = {name: mi.Float(_constant(self.material, name)) for name in _constants_of(self.material)}
        self.mu = _single_reflectivity(self.material)
        shown = {"type": "twosided", "below": {"type": "diffuse", "reflectance": self.reflectance}}
        self.shown = cast(mi.BSDF, load_dict(shown))
        self.m_components = [self.shown.flags(index) for index in range(self.shown.component_count())]
        self.m_flags = self.shown.flags()

    def eval_diffuse_reflectance(self, si: mi.SurfaceInteraction3f, active: DeviceArray = True) -> mi.Spectrum:
        """Return the reflectivity for sonars that do not evaluate the law: mu times the relative variation and the level."""
        factor: DeviceArray = dr.exp2(self.level_db * (math.log2(10) / 10))
        value: Any = self.reflectance.eval(si, active) * (self.mu / self.mean) * factor
        return mi.Spectrum(value)

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: DeviceArray,
        sample2: mi.Point2f,
        active: DeviceArray = True,
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        """Sample a direction from the diffuse surface that cameras see."""
        return self.shown.sample(ctx, si, sample1, sample2, active)

    def eval(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: DeviceArray = True
    ) -> mi.Spectrum:
        """Return the value of the diffuse surface that cameras see."""
        return self.shown.eval(ctx, si, wo, active)

    def pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: DeviceArray = True
    ) -> DeviceArray:
        """Return the probability density of :meth:`sample`."""
        return self.shown.pdf(ctx, si, wo, active)

    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: DeviceArray = True
    ) -> tuple[mi.Spectrum, DeviceArray]:
        """Return :meth:`eval` and :meth:`pdf`."""
        return self.shown.eval_pdf(ctx, si, wo, active)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the reflectance, the level and the constants of the law to ``mi.traverse``."""
        callback.put("reflectance", self.reflectance, mi.ParamFlags.Differentiable)
        callback.put("level_db", self.level_db, mi.ParamFlags.Differentiable)
        for name, constant in self.constants.items():
            callback.put(name, constant, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Update the mean of the reflectance and the law after a change.

        Raises:
            MitsonarError: a constant outside its limits.
        """
        self.mean = _mean(self.reflectance, self.given_mean)
        changed: dict[str, Any] = {}
        for name, constant in self.constants.items():
            values, given = np.array(dr.detach(constant), dtype=np.float64), _constant(self.material, name)
            if values.astype(np.float32).tolist() != np.asarray(given, dtype=np.float32).tolist():
                changed[name] = tuple(values.tolist()) if name == "strength_db" else float(values[0])
        if changed:
            self.material = Material(**{**self.material.model_dump(), **changed})
            self.mu = _single_reflectivity(self.material)

    def to_string(self) -> str:
        """Return one line for Mitsuba's logs."""
        return f"AcousticMaterial[material = {self.material.name}, reflectance = {self.reflectance}]"


def _constants_of(material: Material) -> list[str]:
    """Return the names of the numbers that determine the scattering of a material."""
    return [*LAWS[material.law], *(["roughness_m"] if material.has_mirror else [])]


def _constant(material: Material, name: str) -> list[float]:
    given = getattr(material, name)
    return list(given) if isinstance(given, tuple) else [float(given)]


def _single_reflectivity(material: Material) -> float:
    return min(max(single_mu(material), FAINTEST), LOUDEST)


def _material(name: str) -> Material:
    """Return a material by name, or from a YAML file that Mitsuba resolves relative to the scene's folder."""
    if not name:
        raise MitsonarError(f"acoustic_material needs a material: {', '.join(named_materials())}, or a YAML file")
    is_file = name.lower().endswith((".yaml", ".yml"))
    resolver: Any = mi.file_resolver  # an `object` to Mitsuba's stubs
    return material(str(resolver().resolve(name)) if is_file else name)


def _mean(texture: mi.Texture, given: float) -> float:
    """Return the positive number by which a reflectance is divided."""
    if given == 0:
        try:
            given = float(texture.mean()[0])
        except RuntimeError:
            raise MitsonarError(
                f"acoustic_material cannot determine the mean of a reflectance of kind {texture.class_name()}: give it as "
                "reflectance_mean"
            ) from None
    if not 0 < given < float("inf"):
        raise MitsonarError(f"acoustic_material needs a reflectance whose mean is above 0: got {given:g}")
    return given


def is_acoustic_material(bsdf: mi.Object) -> bool:
    """Return whether a BSDF is an acoustic material, by class name, since each variant creates a new class."""
    return type(bsdf).__name__ == AcousticMaterial.__name__


def _create(props: mi.Properties) -> mi.BSDF:
    """Create the BSDF, which is a plain diffuse one for the material ``none``."""
    if str(props.get("material", "")) != NO_MATERIAL:
        return AcousticMaterial(props)
    reflectance = props.get_texture("reflectance", SHADE)
    return cast(mi.BSDF, load_dict({"type": "diffuse", "id": props.id(), "reflectance": reflectance}))


mi.register_bsdf("acoustic_material", _create)
