"""A scene of a recipe becomes impulse responses."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.config.data_recipe import Recipe
from mitsonar.datasets.plan import Scene
from mitsonar.datasets.scene_rendering import loaded_world
from mitsonar.simulation.channel import ChannelSimulator

__all__ = ["ResponseRenderer"]


class ResponseRenderer:
    """One scene, built, loaded, and ready to be heard.

    Args:
        recipe: of the data set.
        scene: which of its scenes.
    """

    def __init__(self, recipe: Recipe, scene: Scene) -> None:
        self.simulator = ChannelSimulator(loaded_world(recipe, scene), recipe.channel_sonar)

    @staticmethod
    def settled(recipe: Recipe) -> dict[str, Any]:
        """Return nothing: responses have no gain."""
        return {}

    def recorded(self, planned: dict[str, NDArray[Any]], first: int, about: dict[str, Any]) -> dict[str, NDArray[Any]]:
        """Responses where and as fast as the plan has them; see :class:`~mitsonar.datasets.modality.Renderer`."""
        parts = list(self.simulator.pings(planned["pose"], planned["velocity"], first=first))
        names = ("response", "height_m", "echoes", "dropped")
        return {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
