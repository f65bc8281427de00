"""Find the textures that determine the reflectivity of a BSDF, and evaluate it at points."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsonar.arrays import DeviceArray
from mitsonar.plugins.acoustic_material import AcousticMaterial

__all__ = [
    "APPROXIMATED",
    "BENT",
    "DEFAULT_REFLECTIVITY",
    "DIFFUSE",
    "TWO_FACED",
    "WRAPPERS",
    "by_vertex",
    "constant_on_facets",
    "is_black",
    "kinds_and_textures",
    "reduce_colour",
    "reflectances_of",
    "reflectivity_at",
    "unit",
]

DEFAULT_REFLECTIVITY = 0.5

DIFFUSE = {"SmoothDiffuse", "SmoothPlastic", "RoughPlastic", AcousticMaterial.__name__}
APPROXIMATED = {"Principled", "PrincipledThin", "BlendBSDF"}
BENT = {"BumpMap", "NormalMap"}
TWO_FACED = "a different BSDF on each side"
WRAPPERS = {"TwoSidedBRDF", "MaskBSDF", TWO_FACED, *BENT}


def reflectances_of(bsdf: mi.BSDF) -> list[mi.Object]:
    """Return the textures that may determine the reflectivity of a BSDF."""
    return kinds_and_textures(bsdf)[1]


def reflectivity_at(bsdf: mi.BSDF, si: mi.SurfaceInteraction3f) -> DeviceArray:
    """Return the reflectivity 0..1 of a BSDF at points, or :data:`DEFAULT_REFLECTIVITY` without a diffuse reflectance."""
    if not kinds_and_textures(bsdf)[0] <= DIFFUSE | APPROXIMATED | WRAPPERS:
        return mi.Float(DEFAULT_REFLECTIVITY)
    return unit(reduce_colour(bsdf.eval_diffuse_reflectance(si)))


def reduce_colour(spectrum: DeviceArray) -> DeviceArray:
    """Return the luminance of a spectrum."""
    return mi.luminance(spectrum) if mi.is_rgb else spectrum[0]


def unit(value: DeviceArray) -> DeviceArray:
    """Clip to 0..1, using comparisons since LLVM 15 and 16 abort on `max` (see simulation.variant)."""
    return dr.select(value > 0, dr.select(value < 1, value, 1), 0)


class _Children(mi.TraversalCallback):
    """Traversal that collects the direct children of an object."""

    def __init__(self) -> None:
        super().__init__()
        self.objects: list[mi.Object] = []

    def put(self, name: str, value: object, flags: int, cpptype: object = None) -> None:
        """Collect a value if it is an object; Mitsuba calls this for each parameter."""
        if isinstance(value, mi.Object):
            self.objects.append(value)


def kinds_and_textures(bsdf: mi.BSDF) -> tuple[set[str], list[mi.Object]]:
    """Return the class names of a BSDF and all nested ones, and the textures that may determine their reflectance."""
    children = _Children()
    bsdf.traverse(children)
    kinds, textures = {_kind(bsdf)}, []
    if bsdf.class_name() == "TwoSidedBRDF" and len({id(child) for child in children.objects}) > 1:
        kinds.add(TWO_FACED)
    for child in children.objects:
        if isinstance(child, mi.BSDF):
            below = kinds_and_textures(child)
            kinds |= below[0]
            textures += below[1]
        else:
            textures.append(child)
    return kinds, textures


def _kind(bsdf: mi.Object) -> str:
    """Return the class name of a BSDF, since Mitsuba reports ``BSDF`` for all those written in Python."""
    name = bsdf.class_name()
    return type(bsdf).__name__ if name == "BSDF" else name


def constant_on_facets(texture: mi.Object) -> bool:
    """Return whether a texture is constant on each facet."""
    name = texture.class_name()
    return name == "UniformSpectrum" or (name == "MeshAttribute" and 'name = "face_' in str(texture))


def is_black(bsdf: mi.BSDF) -> bool:
    """Return whether a BSDF is diffuse with zero reflectance everywhere."""
    kinds, textures = kinds_and_textures(bsdf)
    if kinds != {"SmoothDiffuse"} or any(texture.class_name() != "UniformSpectrum" for texture in textures):
        return False
    return float(reflectivity_at(bsdf, dr.zeros(mi.SurfaceInteraction3f))[0]) == 0


def by_vertex(texture: mi.Object) -> bool:
    """Return whether a texture is a mesh attribute."""
    return texture.class_name() == "MeshAttribute"
