"""The attributes of a data set's store, checked before anything is allocated for the frames that they promise."""

from __future__ import annotations

from mitsonar.config.data import Recipe
from mitsonar.datasets.modality import Fields, Modality
from mitsonar.io.files import finite_number, whole_number

__all__ = ["check_attributes"]

MOST_FRAMES = 10**9
"""Largest number of frames of a data set."""


def check_attributes(about: Fields, recipe: Recipe, modality: Modality) -> None:
    """Check the numbers of a store against each other and against its recipe.

    Args:
        about: attributes of the Zarr group.
        recipe: of the data set.
        modality: what its instrument records.

    Raises:
        MitsonarError, KeyError, ValueError: a number that cannot be, or one that is missing.
    """
    sequences = whole_number(about["sequences"], "sequences", 1, recipe.sequences)
    most = MOST_FRAMES
    if recipe.flight.kind == "random":
        most = sequences * recipe.flight.pings
        whole_number(about["frames"], "frames", most, most)
    frames = whole_number(about["frames"], "frames", 1, min(most, MOST_FRAMES))
    shard = whole_number(about["shard_frames"], "shard_frames", 1, MOST_FRAMES)
    if shard % whole_number(about["chunk_frames"], "chunk_frames", 1, shard):
        raise ValueError("shard_frames is no multiple of chunk_frames")
    total, numbers = 0, set()
    for scene in about["scenes"]:
        numbers.add(whole_number(scene["number"], "number of a scene", 0, 2**31))
        whole_number(scene["group"], "group of a scene", 0, len(recipe.scenes) - 1)
        whole_number(scene["seed"], "seed of a scene", 0, 2**64)
        total += whole_number(scene["sequences"], "sequences of a scene", 1, sequences)
    if total != sequences or len(numbers) != len(about["scenes"]):
        raise ValueError(f"scenes have {total:,} sequences, {sequences:,} are promised for {frames:,} frames")
    for name in modality.settled:
        finite_number(about[name], name, above=0)
    versions = about["versions"]
    if not (isinstance(versions, dict) and isinstance(about["variant"], str)):
        raise ValueError("versions or variant is something else")
    if not all(type(about[name]) is bool for name in ("ready", "finished")):
        raise ValueError("ready and finished must be true or false")
