"""Data sets with mirrors: what is stored, re-rendered and bounded is what a simulator with these mirrors renders."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import essence, impulse_recipe, tiny_recipe

from mitsonar.acoustics.noise import load_noise
from mitsonar.config.data import Recipe
from mitsonar.datasets.make import check, instrument_in, make_dataset
from mitsonar.datasets.rendered import RenderedPairs, rerender
from mitsonar.datasets.samples import SonarPairs
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError
from mitsonar.estimation.crlb.image import bounds_at
from mitsonar.estimation.crlb.report import BoundOptions, bounds_of_subject, subject_of_data
from mitsonar.records.frames import to_uint8
from mitsonar.simulation.channel import ChannelSimulator
from mitsonar.simulation.pings import to_image
from mitsonar.simulation.scene import load_scene
from mitsonar.simulation.simulator import Simulator

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside|.*too few for|.*holds")]

SURFACE = {"surface": [-1.0, 1e-4]}
"""The sea surface of the tiny worlds, 3.2 m over the ground: 0.7 m over the sonar."""

SEEN = {
    "scenes": [{"count": 1, "sequences": 4}],
    "world__surface_m": 3.2,
    "mount__pitch_deg": 0.0,
    "sonar__elevation_fov_deg": 100.0,
    "sonar__frequency_hz": 9e5,
    "mirrors": SURFACE,
}
"""Changes of the tiny recipe: both the ground and its image in the surface are in view."""

MODELS: dict[str, dict[str, Any]] = {
    "physical": {"sonar__model": "physical", "sonar__bounces": 2, "sonar__rays_across": 2},
    "coherent": {"sonar__model": "coherent", "sonar__bounces": 2, "sonar__quality": "draft"},
}


def mirrored_recipe(model: str, **changes: Any) -> Recipe:
    """A few pings of ground and surface."""
    result: Recipe = tiny_recipe(**{**SEEN, **MODELS[model], **changes})
    return result


def simulator_of(store: DataStore, folder: Path, **options: Any) -> Simulator:
    """The first scene of a store, built and loaded here, by the public simulator."""
    scene = store.scenes[0]
    path, _ = store.recipe.family(scene.group).prepare(scene.seed, folder / "world")
    return Simulator(load_scene(path), instrument_in(store.recipe, scene), **options)


@pytest.mark.parametrize("model", [pytest.param("coherent", marks=pytest.mark.thorough), "physical"])
def test_images_are_those_of_the_simulator_with_mirrors(model: str, tmp_path: Path) -> None:
    make_dataset(mirrored_recipe(model), str(tmp_path / "data.zarr"))
    store = DataStore.open(tmp_path / "data.zarr")
    assert check(store) == []
    assert store.about["recipe"]["mirrors"] == SURFACE
    simulator = simulator_of(store, tmp_path / "with", mirrors={"surface": (-1.0, 1e-4)})
    (pings,) = simulator.pings(store.read("pose", slice(3, 4)), first=3, time_s=[3 / simulator.sonar.frame_rate_hz])
    image = to_uint8(to_image(pings.levels[0], store.about["gain"], simulator.sonar))
    np.testing.assert_array_equal(store.read("image", slice(3, 4))[0], image)
    (without,) = simulator_of(store, tmp_path / "without").pings(store.read("pose", slice(3, 4)), first=3)
    assert pings.levels.sum() > 1.02 * without.levels.sum()


@pytest.mark.slow
def test_re_rendering_and_bounds_use_the_mirrors_of_the_data_set(tmp_path: Path) -> None:
    url = str(tmp_path / "data.zarr")
    make_dataset(mirrored_recipe("physical"), url)
    pairs = SonarPairs(url, part="all", noise="none")
    for number, frames in rerender(pairs, [0, 5]):
        np.testing.assert_array_equal(frames.image, pairs.sonar_frames(number).image)
    subject = subject_of_data(url, 1, part="all")
    noise = load_noise("low")
    options = BoundOptions(noise="low", pings=2)
    (result,) = bounds_of_subject(subject, options, None, lambda poses: None)["image", "image", "pixel"]
    place = next(subject.places())
    for mirrors, same in ((subject.mirrors, True), (None, False)):
        simulator = Simulator(place.scene, subject.sonar, mirrors=mirrors)
        gain = subject.gain
        assert gain is not None
        (bounds,) = bounds_at(simulator, place.poses, noise, gain, pings=2)
        second = bounds["image", "image", "pixel"]
        assert result is not None
        assert second is not None
        assert np.array_equal(result.information, second.information) == same


def test_frames_that_are_rendered_in_training_have_mirrors() -> None:
    def sums(mirrors: object) -> float:
        pairs = RenderedPairs(
            mirrored_recipe("physical", mirrors=mirrors), seed=1, gain=5e3, buffer=1, sequences_per_world=2
        )
        return sum(float(image.sum()) for image, _ in itertools.islice(pairs, 2))

    assert sums(SURFACE) > 1.02 * sums(None)


@pytest.mark.slow
@pytest.mark.parametrize("direct", essence([False, True], True))
def test_responses_are_those_of_the_simulator_with_mirrors(direct: bool, tmp_path: Path) -> None:
    recipe = impulse_recipe(
        world={"surface_m": 6.0},
        channel={"bounces": 2, "direct": direct, "range_max": 9.0},
        mirrors=SURFACE,
        scenes=[{"count": 1, "sequences": 2}],
        split={"by": "sequence"},
    )
    make_dataset(recipe, str(tmp_path / "data.zarr"))
    store = DataStore.open(tmp_path / "data.zarr")
    assert check(store) == []
    scene = store.scenes[0]
    path, _ = recipe.family(scene.group).prepare(scene.seed, tmp_path / "world")
    simulator = ChannelSimulator(load_scene(path), recipe.channel_sonar, mirrors={"surface": (-1.0, 1e-4)})
    assert "surface-scatterer" in simulator.kinds
    result = list(simulator.pings(store.read("pose"), store.read("velocity")))
    np.testing.assert_array_equal(store.read("response"), np.concatenate([part.response for part in result]))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mirrors": {"top": [-1, 0]}}, "no shape top: known: seabed, .*surface"),
        ({"mirrors": "materials"}, "no shape of the worlds of scenes.0 reflects"),
        ({"mirrors": {"surface": [-1, 0]}, "gain": 0.02, "world__surface_m": None}, "no shape surface"),
    ],
)
def test_mirrors_that_no_world_has_are_refused_before_a_store_is_made(
    changes: dict[str, Any], words: str, tmp_path: Path
) -> None:
    with pytest.raises(MitsonarError, match=words):
        make_dataset(mirrored_recipe("physical", **changes), str(tmp_path / "data.zarr"))
    assert not (tmp_path / "data.zarr" / "zarr.json").exists()
