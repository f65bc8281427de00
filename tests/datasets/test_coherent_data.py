"""Data sets of coherent pings: the same bits for any workers, speckle of its own in each scene, values of the coding."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers import files_of, tiny_recipe

from mitsonar.acoustics.levels import coded
from mitsonar.config.data import Recipe
from mitsonar.datasets.make import instrument_in, make_dataset
from mitsonar.datasets.plan import scenes_of
from mitsonar.datasets.store import DataStore
from mitsonar.simulation.pings import to_image

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside|.*too few for")]

SONAR = {
    **{"preset": "didson300", "beams": 16, "azimuth_fov_deg": 4.8, "range_bins": 64, "pulse_m": 0.03, "quality": "draft"},
    **{"coding": "gamma", "gain_exponent": 4},
}


def coherent_recipe() -> Recipe:
    """A few pings over two scenes of rocks."""
    result: Recipe = tiny_recipe(sonar=SONAR)
    return result


@pytest.mark.slow
def test_workers_do_not_change_bits(tmp_path: Path) -> None:
    for workers in (1, 2):
        make_dataset(coherent_recipe(), str(tmp_path / f"{workers}.zarr"), workers=workers)
    one, two = (files_of(tmp_path / f"{workers}.zarr") for workers in (1, 2))
    assert one == two
    image = DataStore.open(str(tmp_path / "1.zarr")).read("image")
    assert image.dtype == np.uint8
    assert image.std() > 5


def test_speckle_is_of_each_scene() -> None:
    recipe = coherent_recipe()
    seeds = {instrument_in(recipe, scene).seed for scene in scenes_of(recipe, recipe.sequences)}
    assert len(seeds) == len(scenes_of(recipe, recipe.sequences)) > 1


def test_values_are_those_of_the_coding() -> None:
    sonar = coherent_recipe().instrument
    level = np.array([0.0, 1e-4, 1.0, 3.0], np.float32)
    np.testing.assert_array_equal(to_image(level, 1.0, sonar), coded(level, sonar))
    np.testing.assert_allclose(coded(level, sonar), [0, 0.1, 1, 1], atol=1e-6)
