"""Notice that parameters of a scene have changed since something was made of it, such as a table of its normals."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import drjit as dr
import mitsuba as mi

__all__ = ["SceneWatch"]

WITHOUT_ECHO = ("silhouette_sampling_weight", "vertex_normals")
"""Ends of the names of parameters that no echo depends on: facets are flat."""


class SceneWatch:
    """Watches the parameters of a scene's shapes, materials and textures that ``mi.traverse`` reaches.

    Dr.Jit numbers its arrays, and a changed one has another number: a look costs about 0.1 us an array, whatever its size.
    Copies that share the memory keep numbers from being given again.

    Args:
        scene: any.
        places: whether the places of instances, spheres, cylinders and disks count, which Mitsuba looks up when it traces.
    """

    def __init__(self, scene: mi.Scene, *, places: bool = True) -> None:
        self._scene, self._places = scene, places
        self._begin()

    def _begin(self) -> None:
        """Take hold of the parameters, and remember them as they are."""
        found: Any = mi.traverse(self._scene)  # its types lack the keys
        self._arrays: dict[str, Any] = {}  # references: they show what the scene holds now
        self._others: dict[str, Any] = {}
        self._owners: dict[str, mi.Object] = {}
        for name, (place, kind, owner, _) in found.properties.items():
            if not isinstance(owner, mi.Shape | mi.BSDF | mi.Texture) or name.endswith(WITHOUT_ECHO):
                continue
            looked_up = name.endswith("to_world") and isinstance(owner, mi.Shape) and not isinstance(owner, mi.Mesh)
            if looked_up and not self._places:
                continue
            self._owners[name] = owner
            value = place if kind is None else mi.get_property(place, kind, owner)
            if isinstance(value, mi.Float | mi.UInt32 | mi.Int32):
                self._arrays[name] = value
            else:
                self._others[name] = place, kind
        self._live = list(self._arrays.values())
        self._keep()

    def changed(self) -> dict[str, mi.Object] | None:
        """Return the parameters that changed since the last call, by name with what they belong to; None where none did."""
        materials = self._materials()
        if materials != self._kept_materials:  # another BSDF of a shape, with parameters of its own
            found: dict[str, mi.Object] = {"bsdf": self._scene}
            self._begin()
            return found
        others = self._fingerprints()
        if [one.index for one in self._live] == self._numbers and others == self._kept_others:
            return None
        numbered = zip(self._arrays.items(), self._numbers, strict=True)
        names = [name for (name, value), number in numbered if value.index != number]
        names += [name for name, before in self._kept_others.items() if others[name] != before]
        self._keep()
        return {name: self._owners[name] for name in names}

    def _materials(self) -> list[mi.BSDF | None]:
        return [shape.bsdf() for shape in self._scene.shapes()]

    def _values(self) -> dict[str, Any]:
        """Return the parameters that are no plain arrays, such as transforms and tensors, as they are now."""
        read: Any = mi.get_property
        return {
            name: place if kind is None else read(place, kind, self._owners[name])
            for name, (place, kind) in self._others.items()
        }

    def _fingerprints(self) -> dict[str, Hashable]:
        """Return what tells these parameters from others."""
        return {name: tuple(dr.detail.collect_indices([value])) or str(value) for name, value in self._values().items()}

    def _keep(self) -> None:
        """Remember the parameters as they are."""
        self._kept = [[dr.copy(value) for value in self._live], [_shared(value) for value in self._values().values()]]
        self._numbers, self._kept_others = [one.index for one in self._live], self._fingerprints()
        self._kept_materials = self._materials()


def _shared(value: Any) -> Any:
    """Return a copy that holds the same arrays."""
    return dr.copy(value) if dr.detail.collect_indices([value]) else None
