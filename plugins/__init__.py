"""Plugins for Mitsuba 3, usable from any XML scene: ``imaging_sonar``, ``echo``, ``acoustic_material`` ...

Mitsuba has a separate plugin registry for each variant, and a class can derive from ``mi.Sensor`` only once a variant is
set. :func:`install` registers the plugins for the current variant, if any, and after each change of variant. Mitsuba may be
imported before or after mitsonar.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

__all__ = ["PLUGINS", "install"]

PLUGINS = (
    "hashed_texture",
    "acoustic_material",
    "material_laws",
    "surfaces",
    "imaging_sonar_sensor",
    "channel_sonar_sensor",
    "echo_integrator",
    "cell_noise",
    "perlin",
    "trajectory_texture",
)
"""Modules that use Mitsuba, in the order in which they import each other."""


def install() -> None:
    """Register the plugins now if Mitsuba is imported, otherwise once it is; does not set a variant."""
    if "mitsuba" in sys.modules:
        _watch_variants()
    elif not any(isinstance(finder, _AfterMitsuba) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterMitsuba())


def _watch_variants() -> None:
    import mitsuba as mi

    mi.detail.add_variant_callback(_register)
    if mi.variant() is not None:
        _register(None, mi.variant())


def _register(_old: str | None, new: str | None) -> None:
    """Load the plugin modules for the new variant; for a scalar variant, register plugins that only raise an error."""
    if new is None:
        return
    if not new.startswith(("llvm", "cuda")):
        importlib.import_module(f"{__name__}.scalar_variants").register_refusals(new)
        return
    for name in PLUGINS:
        module = sys.modules.get(f"{__name__}.{name}")
        if module is None:
            importlib.import_module(f"{__name__}.{name}")
        else:
            importlib.reload(module)


class _AfterMitsuba(MetaPathFinder, Loader):
    """Import hook that watches the variants of ``mitsuba`` once it is loaded, so ``import mitsonar`` need not import it."""

    def __init__(self) -> None:
        self.real: Loader | None = None
        self.searching = False

    def find_spec(self, name: str, path: object = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the spec of ``mitsuba`` with this loader in front of the original one; None for any other module."""
        if name != "mitsuba" or self.searching:
            return None
        self.searching = True  # so that the other finders are used
        try:
            spec = importlib.util.find_spec(name)
        finally:
            self.searching = False
        if spec is not None and spec.loader is not None:
            self.real, spec.loader = spec.loader, self
        return spec

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Create the module with its original loader."""
        assert self.real is not None
        return self.real.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        """Load the module, remove this import hook, and register the plugins."""
        assert self.real is not None
        module.__spec__.loader = module.__loader__ = self.real  # type: ignore[union-attr]
        self.real.exec_module(module)
        sys.meta_path.remove(self)
        _watch_variants()
