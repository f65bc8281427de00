"""Raise a clear error in Mitsuba's scalar variants, which cannot run plugins written in Python."""

from __future__ import annotations

from collections.abc import Callable

from mitsonar.errors import MitsonarError

__all__ = ["KINDS", "register_refusals"]

KINDS = {
    "sensor": ("imaging_sonar", "channel_sonar"),
    "integrator": ("echo",),
    "bsdf": ("acoustic_material",),
    "texture": ("cell_noise", "perlin", "trajectory"),
}
"""Names of the plugins in XML, by the type under which Mitsuba registers them."""


def register_refusals(variant: str) -> None:
    """Register plugins that raise an error naming the required variants, instead of Mitsuba's "not found"."""
    import mitsuba as mi

    for kind, names in KINDS.items():
        for name in names:
            getattr(mi, f"register_{kind}")(name, _refusal(name, variant))


def _refusal(name: str, variant: str) -> Callable[[object], object]:
    def refuse(_props: object) -> object:
        raise MitsonarError(
            f"{name} is a plugin of mitsonar, written in Python, and does not run in the variant {variant}: call "
            'mi.set_variant("llvm_ad_mono"), or another llvm or cuda variant, before the scene is loaded'
        )

    return refuse
