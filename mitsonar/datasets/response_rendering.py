"""A scene of a recipe becomes impulse responses."""

from __future__ import annotations

import numpy as np

from mitsonar.config.data import Recipe
from mitsonar.datasets.modality import Fields, Values
from mitsonar.datasets.plan import Scene
from mitsonar.datasets.scene_rendering import loaded_world, refuse_worlds
from mitsonar.simulation.channel import ChannelSimulator

__all__ = ["ResponseRenderer"]


class ResponseRenderer:
    """One scene, built, loaded, and ready to record.

    Args:
        recipe: of the data set.
        scene: which of its scenes.
    """

    def __init__(self, recipe: Recipe, scene: Scene) -> None:
        self.simulator = ChannelSimulator(loaded_world(recipe, scene), recipe.channel_sonar, mirrors=recipe.mirrors)

    @staticmethod
    def settled(recipe: Recipe) -> Fields:
        """Return no numbers: responses have no gain. Mirrors are looked for in the worlds."""
        refuse_worlds(recipe)
        return {}

    def recorded(self, planned: dict[str, Values], first: int, about: Fields) -> dict[str, Values]:
        """Simulate responses at the poses and velocities of the plan; see :class:`~mitsonar.datasets.modality.Renderer`."""
        parts = list(self.simulator.pings(planned["pose"], planned["velocity"], first=first))
        names = ("response", "height_m", "echoes", "dropped")
        return {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
