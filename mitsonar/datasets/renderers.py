"""What turns a scene of a recipe into what is recorded, by the recipe's instrument."""

from __future__ import annotations

from typing import Any, Protocol

from numpy.typing import NDArray

from mitsonar.config.data_recipe import Recipe
from mitsonar.datasets.plan import Scene
from mitsonar.datasets.scene_rendering import SceneRenderer, calibrate
from mitsonar.datasets.response_rendering import ResponseRenderer

__all__ = ["Renderer", "renderer_of", "settled_of"]


class Renderer(Protocol):
    """One scene, loaded."""

    def recorded(self, planned: dict[str, NDArray[Any]], first: int, about: dict[str, Any]) -> dict[str, NDArray[Any]]:
        """What is stored of consecutive pings of the scene, by name.

        Args:
            planned: what the plan says of them: ``pose``, and what the recording names.
            first: number of the first in the scene.
            about: attributes of the store.
        """


def renderer_of(recipe: Recipe, scene: Scene) -> Renderer:
    """The renderer of a scene."""
    return SceneRenderer(recipe, scene) if recipe.channel is None else ResponseRenderer(recipe, scene)


def settled_of(recipe: Recipe) -> dict[str, Any]:
    """Numbers of the whole data set, which are set before its first ping is recorded.

    Raises:
        MitsonarError: the first frames are empty.
    """
    if recipe.channel is not None:
        return {}
    gain = calibrate(recipe)
    return {"gain": gain, "level_scale": 1 / gain}
