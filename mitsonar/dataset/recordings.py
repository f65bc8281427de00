"""The recording of a recipe, by its instrument."""

from __future__ import annotations

from mitsonar.dataset.image_recording import ImageRecording
from mitsonar.dataset.recipe import Recipe
from mitsonar.dataset.recording import Recording
from mitsonar.dataset.response_recording import ResponseRecording

__all__ = ["recording_of"]


def recording_of(recipe: Recipe) -> Recording:
    """What the recipe's instrument records."""
    return ImageRecording(recipe) if recipe.channel is None else ResponseRecording(recipe)
