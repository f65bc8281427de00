"""Recipes: Almanza-Medina's own numbers, and one sentence for whatever is wrong in a user's file."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from helpers import TINY

from mitsonar.config.data import load_recipe, shipped_recipes
from mitsonar.datasets.plan import Plan
from mitsonar.errors import MitsonarError
from mitsonar.worlds.families import create_family

IMAGES = {
    "rocky-field": 200_000,
    "ship-hull": 100_000,
    "rocky-field-wide": 50_000,
    "rocky-field-two-sensors": 25_000,
    "looking-down": 1_250,
    "looking-down-10m": 1_250,
    "looking-down-runs": 212,
    "height-rocky": 1_250,
    "height-hull": 3_000,
    "pattern-runs": 9_300,
    "rocky-field-physical": 200_000,
    "ship-hull-physical": 100_000,
    "rocky-field-coherent": 50_000,
    "looking-down-coherent": 1_200,
}
"""Pings of the whole set, from Almanza-Medina: 3.2, 3.4.5, 3.6 and 4.2 (pairs times 5/4), 4.4.4, 4.5, 2.3."""


def test_all_that_is_promised_is_shipped() -> None:
    images = {name for name in shipped_recipes() if not name.startswith("impulse-")}  # those: tests/test_impulse_data.py
    assert images == set(IMAGES)


@pytest.mark.parametrize("name", sorted(IMAGES))
def test_shipped_recipes_hold_the_thesis_s_numbers(name: str) -> None:
    recipe = load_recipe(name)
    assert recipe.about
    runs = 53 if name == "looking-down-runs" else 1550 / 3
    each = runs if recipe.flight.kind == "runs" else recipe.flight.pings
    assert recipe.sequences * each == IMAGES[name]
    flight = recipe.flight
    if flight.kind == "random" and flight.pings > 1:
        assert (flight.sideways_mm, flight.forward_mm, flight.yaw_deg, flight.pings) == (20, 20, 0.45, 5)
        assert flight.jump_m == (3, 4)
    sonar = recipe.instrument
    if "hull" in name:
        assert recipe.mount.pitch_deg == 4
        assert sum(group.count for group in recipe.scenes) == 15
        assert flight.heights == ((0.2, 0.55) if "height" in name else (0.32, 0.32))
    elif name.startswith("rocky") or name == "pattern-runs":
        assert recipe.mount.pitch_deg == 35
        assert flight.heights == (2.5, 2.5)
        assert (sonar.range_min, sonar.range_max) == (3.2, 5.6)
    local = next((model for model in ("physical", "coherent") if name.endswith(model)), None)
    assert sonar.model == (local or "thesis")
    assert (recipe.split.by == "scene") == (local is not None)
    if local == "physical":
        assert sonar.jittered
        assert sonar.rays_across > 1
        assert sonar.beam_width_rad == sonar.beam_spacing_rad
        assert sonar.bearing == "cone"
    assert len(Plan.of(recipe, min(recipe.sequences, 20))) > 0


def test_special_recipes() -> None:
    wide = load_recipe("rocky-field-wide").instrument
    assert (wide.azimuth_fov_deg, wide.elevation_fov_deg, wide.beams) == (60, 12, 512)
    two = load_recipe("rocky-field-two-sensors")
    assert [view.name for view in two.views] == ["fore", "aft"]
    assert [spec.starboard_m for spec in two.receivers] == [-0.5, 0.5]
    assert two.mount.heading_deg == 90
    assert [len(view.bearing_rad) for view in two.views] == [96, 96]
    down = load_recipe("looking-down")
    widths = {view.name: len(view.bearing_rad) for view in down.views}
    assert widths == {"whole": 1000, "starboard": 1000} | {f"{kind}{n}": 500 for kind in "qc" for n in (1, 2, 3, 4)}
    assert (down.instrument.range_min, down.instrument.range_max) == (2.0, 6.1)
    high = load_recipe("looking-down-10m").instrument
    assert (high.range_min, high.range_max) == (9.0, 24.5)
    assert load_recipe("height-rocky").flight.heights == (1, 10)


def test_wide_frames_fly_the_poses_of_the_plain_ones() -> None:
    """Almanza-Medina, 3.4.5: the same positions, in the first ten scenes."""
    import numpy as np

    plain, wide = (Plan.of(load_recipe(name), 60) for name in ("rocky-field", "rocky-field-wide"))
    np.testing.assert_array_equal(plain.poses, wide.poses)


def written(folder: Path, **changes: object) -> Path:
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump({**TINY, **changes}))
    return path


def test_a_recipe_of_one_s_own(tmp_path: Path) -> None:
    recipe = load_recipe(written(tmp_path), {"sonar.range_bins": 256, "seed": 9})
    assert recipe.instrument.range_bins == 256
    assert recipe.instrument.seed == 9
    assert recipe.sequences == 30


def test_a_scene_of_one_s_own(tmp_path: Path) -> None:
    create_family("pattern").build(0).write(tmp_path / "world")
    world = {"family": "scene", "file": "world/scene.xml", "size_m": 12}
    recipe = load_recipe(written(tmp_path, world=world))
    path, parameters = recipe.family(0).prepare(0, tmp_path / "unused")
    assert path == tmp_path / "world" / "scene.xml"
    assert parameters == {}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"wrold": {}}, "unknown recipe key wrold: did you mean world"),
        ({"flight": {"jumps": 3}}, "unknown recipe key flight.jumps: did you mean jump_m"),
        ({"sonar": {"preset": "didson30"}}, "didson300"),
        ({"sonar": {"beems": 3}}, "beams"),
        ({"world": {}}, "world lacks family"),
        ({"world": {"family": "moon"}}, "unknown world 'moon'"),
        ({"world": {"family": "rocky-field", "rocks": 3}}, "unknown rocky-field key rocks"),
        ({"world": {"family": "scene", "size_m": 3}}, "lacks file"),
        ({"scenes": []}, "scenes"),
        ({"scenes": [{"count": 2}]}, "lacks scenes.0.sequences"),
        ({"scenes": [{"count": 2, "sequences": 1, "wrld": {}}]}, "unknown recipe key scenes.0.wrld"),
        ({"seed": -1}, "seed"),
        ({"frames": 9}, "at most flight.pings"),
        ({"flight": {"height_m": -2.0}}, "above 0"),
        ({"flight": {"jump_m": [4, 3]}}, "low <= high"),
        ({"flight": {"kind": "runs"}}, "one per run"),
        ({"segments": ["q7"]}, "unknown segment"),
        ({"segments": ["q1"], "receivers": [{"name": "a"}]}, "exclude each other"),
        ({"receivers": [{"name": "a", "starboard_m": 0.5}]}, "jittered columns"),
        ({"receivers": [{"name": "a b"}]}, "a name must consist of letters"),
        ({"mirrors": {"surface": 3}}, "give [reflection, rms height in m] by the ids of shapes"),
        ({"mirrors": {"surface": [-1.5, 0]}, "sonar": {**TINY["sonar"], "model": "coherent"}}, "reflections in -1..1"),
        ({"mirrors": {"surface": [-1, float("nan")]}}, "rms heights in 0..1"),
        ({"mirrors": {"surface": [True, 0]}}, "give [reflection"),
        ({"mirrors": {}}, "give [reflection"),
        ({"mirrors": "material"}, "or the word materials: got 'material'"),
        ({"mirrors": {"surface": [-1, 0]}}, "the model thesis has no mirrors"),
        ({"mirrors": "materials", "sonar": {**TINY["sonar"], "model": "physical"}}, "or bounces 2"),
        ({"world": {**TINY["world"], "surface_m": 2.5}}, "stay below the world's surface_m, 2.5 m: got 2.5 m"),
        ({"world": {**TINY["world"], "surface_m": -1}}, "surface_m"),
        ({"labels": ["depth"]}, "labels"),
        ({"labels": ["shadow"], "store": "vectors"}, "labels are pixels"),
        ({"sonar": {"ping_groups": 8}}, "one pose"),
        ({"split": {"train": 0.5}}, "add up to 1"),
        ({"mount": {"pitch_deg": 100}}, "pitch_deg"),
        ({"flight": {"height_m": float("nan")}}, "above 0"),
        ({"flight": {"height_m": float("inf")}}, "above 0"),
        ({"flight": {"jump_m": [-4, -3]}}, "0 <= low"),
        ({"flight": {"footprint_fov_deg": [0, 10]}}, "footprint_fov_deg"),
        ({"flight": {"footprint_fov_deg": [float("nan"), 10]}}, "footprint_fov_deg"),
        ({"scenes": [{"sequences": 3}], "flight": {"kind": "runs", "height_m": [2, 3]}}, "one number"),
        ({"sonar": {"jitter": True}, "receivers": [{"name": "label"}]}, "choose another name"),
        (
            {
                "sonar": {"preset": "didson300", "beams": 768, "rays_per_beam": 4, "jitter": True, "model": "thesis"},
                "receivers": [
                    {"name": x, "starboard_m": 0.5, "sonar": {"beams": 96, "range_bins": n}} for x, n in (("a", 5), ("b", 6))
                ],
            },
            "same window",
        ),
    ],
)
def test_mistakes_are_answered_by_one_sentence(changes: dict[str, object], words: str, tmp_path: Path) -> None:
    with pytest.raises(MitsonarError) as error:
        load_recipe(written(tmp_path, **changes))
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_files_that_are_no_recipes(tmp_path: Path) -> None:
    for name, content, words in (
        ("none.yaml", None, "cannot read recipe"),
        ("list.yaml", b"- 1\n- 2\n", "must hold the keys"),
        ("bad.yaml", b"a: [1", "not YAML"),
        ("bytes.yaml", b"\xff\xfe\x00", "not YAML"),
        ("deep.yaml", b"[" * 20_000, "not YAML"),
        ("code.yaml", b"!!python/object/apply:os.system ['true']", "not YAML"),
        ("number.yaml", b"1: 2\n", "keys|unknown"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(MitsonarError, match=words):
            load_recipe(tmp_path / name)
    with pytest.raises(MitsonarError, match="rocky-field"):
        load_recipe("rocky")
    with pytest.raises(MitsonarError, match="not a group"):
        load_recipe("rocky-field", {"seed.world": 3, "scenes.count": 3})


def test_keys_of_later_versions_leave_recipes_as_they_were() -> None:
    """Stores and checkpoints hold these digests and compare these keys: from before there were mirrors."""
    assert load_recipe("rocky-field").digest() == "2b77fcb199249550"
    assert load_recipe("rocky-field-coherent").digest() == "cd80394a96e45d3c"
    plain = load_recipe("rocky-field-coherent")
    assert not {"mirrors", "recorded"} & set(plain.model_dump(mode="json"))
    mirrored = load_recipe("rocky-field-coherent", {"mirrors": {"surface": [-1, 0]}, "world.surface_m": 10})
    assert mirrored.model_dump(mode="json")["mirrors"] == {"surface": [-1, 0]}
    assert mirrored.digest() != plain.digest()


def test_mirrors_of_responses_fit_the_instrument() -> None:
    from helpers import impulse_recipe

    with pytest.raises(MitsonarError, match=r"bounces 2 need mirrors, .* give the recipe the key mirrors"):
        impulse_recipe(channel={"bounces": 2})
    with pytest.raises(MitsonarError, match="mirrors need the model scatterers"):
        impulse_recipe(channel={"model": "rays"}, mirrors={"surface": [-1, 0]})
