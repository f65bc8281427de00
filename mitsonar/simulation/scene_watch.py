"""Notice that parameters of a scene have changed since something was made of it, such as a table of its normals."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

__all__ = ["SceneWatch"]


class SceneWatch:
    """Watches the parameters of a scene's shapes, materials and textures that ``mi.traverse`` reaches.

    Dr.Jit numbers its arrays, and a changed one has another number: a look costs about 1 us a parameter, whatever its size.
    Copies that share the memory keep numbers from being given again.

    Args:
        scene: any.
    """

    def __init__(self, scene: mi.Scene) -> None:
        found: Any = mi.traverse(scene)  # its types lack the keys
        watched = {name: of for name, of in found.properties.items() if isinstance(of[2], mi.Shape | mi.BSDF | mi.Texture)}
        self._names, self._properties = list(watched), [of[:3] for of in watched.values()]
        self._read: Any = mi.get_property
        values = self._values()
        self._plain = [place for place, value in enumerate(values) if not dr.detail.collect_indices([value])]
        self._keep(values)

    def changed(self) -> dict[str, mi.Object] | None:
        """Return the parameters that changed since the last call, by name with what they belong to; None where none did.

        Places that Mitsuba alone looks up are left out, those of instances, spheres, cylinders and disks: there may be none
        left.
        """
        values = self._values()
        if dr.detail.collect_indices(values) == self._numbers and self._texts(values) == self._kept_texts:
            return None
        texts = dict(zip(self._plain, self._kept_texts, strict=True))
        found = {}
        for place, (name, (_, _, owner)) in enumerate(zip(self._names, self._properties, strict=True)):
            now = values[place]
            if place in texts:
                same = str(now) == texts[place]
            else:
                same = dr.detail.collect_indices([now]) == dr.detail.collect_indices([self._kept[place]])
            looked_up = name.endswith("to_world") and isinstance(owner, mi.Shape) and not isinstance(owner, mi.Mesh)
            if not same and not looked_up:
                found[name] = owner
        self._keep(values)
        return found

    def _values(self) -> list[Any]:
        """Return the parameters as they are now."""
        return [value if kind is None else self._read(value, kind, owner) for value, kind, owner in self._properties]

    def _texts(self, values: list[Any]) -> list[str]:
        """Return the parameters that are no arrays as texts."""
        return [str(values[place]) for place in self._plain]

    def _keep(self, values: list[Any]) -> None:
        """Remember these values."""
        plain = set(self._plain)
        self._kept = [None if place in plain else dr.copy(value) for place, value in enumerate(values)]
        self._numbers, self._kept_texts = dr.detail.collect_indices(values), self._texts(values)
