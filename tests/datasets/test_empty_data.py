"""Data sets whose sonar points past the scene: refused where that can be known, else warned of and found by the check."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers import HEARD, TINY, Command, essence, refused, tiny_recipe

from mitsonar.config.data import Recipe, load_recipe, recipe_from
from mitsonar.datasets.make import check, loaded_world, make_dataset
from mitsonar.datasets.modality import Scene
from mitsonar.datasets.plan import ImageModality
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError

pytestmark = pytest.mark.usefixtures("variant")

GROUND = """<shape type="rectangle" id="ground"><transform name="to_world"><scale x="{half}" y="{half}"/></transform>
  <bsdf type="diffuse"/></shape>"""
BALL = """<shape type="sphere" id="{name}"><point name="center" x="{x}" y="{x}" z="0.1"/>
  <float name="radius" value="0.1"/></shape>"""


def scene_file(folder: Path, half: float, *far: float) -> Path:
    """A ground of that half edge, and balls at these places, which make the scene larger than its ground."""
    balls = "".join(BALL.format(name=f"ball{number}", x=x) for number, x in enumerate(far))
    path = folder / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{GROUND.format(half=half)}{balls}</scene>')
    return path


def own_scene(path: Path, size_m: float, **changes: object) -> Recipe:
    """The tiny recipe in a scene of one's own, twelve frames in two sequences."""
    world = {"family": "scene", "file": str(path), "size_m": size_m}
    flight = {**TINY.get("flight", {}), "pings": 6, "jump_m": None}
    recipe: Recipe = tiny_recipe(world=world, scenes=[{"count": 1, "sequences": 4}], flight=flight, **changes)
    return recipe


@pytest.mark.parametrize("gain", [None, 3.0])
def test_a_scene_smaller_than_its_recipe_says_is_refused_before_rendering(tmp_path: Path, gain: float | None) -> None:
    path = scene_file(tmp_path, 4.0)
    out = tmp_path / "x.zarr"
    with pytest.raises(
        MitsonarError, match=r"world.size_m, 30 m, is too large for .*scene.xml, which covers x -4..4 m and y"
    ) as caught:
        make_dataset(own_scene(path, 30.0, gain=gain), str(out))
    assert "give at most 8 (a square around the origin)" in str(caught.value)
    assert not (out / "zarr.json").exists()
    loaded_world(own_scene(path, 8.0), Scene(0, 0, 0, 1))


def test_impulse_responses_are_refused_likewise(tmp_path: Path) -> None:
    world = {"family": "scene", "file": str(scene_file(tmp_path, 4.0)), "size_m": 30.0}
    with pytest.raises(MitsonarError, match="is too large for"):
        make_dataset(recipe_from({**HEARD, "world": world}), str(tmp_path / "x.zarr"))


@pytest.mark.parametrize("kind", essence(["images", "vectors", "both"], "both"))
def test_empty_frames_are_warned_of_and_are_faults(tmp_path: Path, kind: str) -> None:
    """Two balls far away: that the ground between them is small is not known before it is rendered."""
    recipe = own_scene(scene_file(tmp_path, 3.0, -20.0, 20.0), 40.0, gain=1.0, store=kind)
    result = make_dataset(recipe, str(tmp_path / "x.zarr"))
    store = DataStore.open(tmp_path / "x.zarr")
    names = {"images": ["image"], "vectors": ["vector"], "both": ["image", "vector"]}[kind]
    empty = np.all([~store.read(name).reshape(24, -1).any(axis=1) for name in names], axis=0)
    assert 0 < empty.sum() <= 24
    expected = f"{empty.sum()} of 24 frames contain no echoes ({np.flatnonzero(empty)[0]}"
    assert sum(sentence.startswith(expected) for sentence in result.warnings) == 1
    assert "check world.size_m" in next(sentence for sentence in result.warnings if sentence.startswith(expected))
    assert [fault.startswith(expected) for fault in check(store)] == [True]


def test_the_command_line_says_so(mitsonar: Command, tmp_path: Path) -> None:
    recipe = own_scene(scene_file(tmp_path, 3.0, -20.0, 20.0), 40.0, gain=1.0)
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(recipe.model_dump(mode="json", exclude_defaults=True)))
    load_recipe(tmp_path / "mine.yaml")
    done = mitsonar("dataset", "make", tmp_path / "mine.yaml", "-o", tmp_path / "x.zarr", "--workers", 1)
    assert done.returncode == 0, done.stderr
    assert "frames contain no echoes" in done.stderr
    checked = mitsonar("dataset", "check", tmp_path / "x.zarr")
    refused(checked, "1 faults", "empty frames stay until the recipe changes")
    assert "frames contain no echoes (" in checked.stdout
    small = {**yaml.safe_load((tmp_path / "mine.yaml").read_text())}
    small["world"]["size_m"] = 60.0
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(small))
    refused(
        mitsonar("dataset", "make", tmp_path / "small.yaml", "-o", tmp_path / "y.zarr"), "world.size_m", "is too large for"
    )


@pytest.mark.parametrize(("stated", "share", "warned"), [(True, 0.061, ""), (True, 0.6, "60 %"), (False, 0.061, "6.1 %")])
def test_a_recipe_that_states_its_window_means_it(stated: bool, share: float, warned: str) -> None:
    """It is warned of a window that drops more than half of a ping; the window of a preset counts from a thousandth on."""
    window = {"range_min": 3.2, "range_max": 5.6} if stated else {}
    recipe = tiny_recipe(sonar={**TINY["sonar"], **window})
    rays = recipe.instrument.rays
    table = {"dropped": np.full(4, round(share * rays)), "saturated": np.zeros(4, dtype=int)}
    result = ImageModality(recipe).warnings(lambda name: table[name])
    assert bool(result) == bool(warned)
    assert all(warned in text and "set sonar.range_min" in text for text in result)
