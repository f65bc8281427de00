"""The modality of a recipe, by its instrument."""

from __future__ import annotations

from mitsonar.config.data import Recipe
from mitsonar.datasets.image_modality import ImageModality
from mitsonar.datasets.modality import Modality
from mitsonar.datasets.response_modality import ResponseModality

__all__ = ["modality_of"]


def modality_of(recipe: Recipe) -> Modality:
    """Return the modality of the recipe's instrument."""
    return ImageModality(recipe) if recipe.channel is None else ResponseModality(recipe)
