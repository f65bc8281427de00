"""Data sets of a scene whose bodies move: images, labels, poses and velocities at frame / frame_rate_hz."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import place_of, tiny_recipe

from mitsonar.config.data import Recipe
from mitsonar.datasets.make import check, make_dataset
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError
from mitsonar.records.frames import to_uint8
from mitsonar.simulation.pings import to_image
from mitsonar.simulation.scene import load_scene
from mitsonar.simulation.simulator import Simulator

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside")]

TANK = """<scene version="3.0.0">
    <shape type="rectangle" id="floor"><transform name="to_world"><scale value="20"/></transform></shape>
    <shape type="sphere" id="buoy"><float name="radius" value="0.2"/>
        <texture type="trajectory" name="motion"><string name="filename" value="buoy.csv"/></texture></shape>
    <shape type="sphere" id="fish"><float name="radius" value="0.8"/>
        <texture type="trajectory" name="motion"><string name="filename" value="fish.csv"/></texture></shape>
</scene>"""

SPEED = np.array([0.3, -0.2, 0.05])
"""Of the fish [m/s]: 10 s from (-1.5, 1, 0.6) on."""


SEEN = {
    **{"flight__jump_m": None, "bodies": ["fish"], "sonar__model": "physical", "sonar__range_min": 1.0},
    "sonar__azimuth_fov_deg": 90.0,
}


def moving_recipe(folder: Path, **changes: Any) -> Recipe:
    """Twelve sequences over a floor with a ball that swims and another that stands still."""
    folder.mkdir(exist_ok=True)
    (folder / "tank.xml").write_text(TANK)
    begin = np.array([-1.5, 1, 0.6])
    for name, places in (("fish", (begin, begin + 10 * SPEED)), ("buoy", ([3, 3, 1], [3, 3, 1]))):
        rows = [",".join(map(str, (time, *place, 0, 0, 0))) for time, place in zip((0, 10), places, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(["time_s,x_m,y_m,z_m,pitch_deg,roll_deg,heading_deg", *rows]))
    result: Recipe = tiny_recipe(
        world={"family": "scene", "file": str(folder / "tank.xml"), "size_m": 12.0},
        scenes=[{"count": 1, "sequences": 12}],
        labels=["shape_id", "object_id"],
        **{**SEEN, **changes},
    )
    return result


def test_bodies_are_where_their_trajectories_say(tmp_path: Path) -> None:
    recipe = moving_recipe(tmp_path / "tank")
    make_dataset(recipe, str(tmp_path / "data.zarr"))
    store = DataStore.open(tmp_path / "data.zarr")
    assert check(store) == []
    time_s = np.arange(len(store)) / recipe.instrument.frame_rate_hz
    pose, velocity = store.read("body_pose"), store.read("body_velocity")
    assert pose.shape == (60, 1, 6)
    np.testing.assert_allclose(pose[:, 0, :3], [-1.5, 1, 0.6] + time_s[:, None] * SPEED, atol=1e-9)
    np.testing.assert_allclose(velocity[:, 0], np.broadcast_to([*SPEED, 0, 0, 0], (60, 6)), atol=1e-6)
    scene = load_scene(tmp_path / "tank" / "tank.xml")
    simulator = Simulator(scene, recipe.instrument)
    on_fish = store.read("shape_id") == place_of(scene, "fish")
    assert simulator.motion is not None
    assert (store.read("object_id")[on_fish] == 1 + simulator.motion.bodies.names.index("fish")).all()
    seen = np.flatnonzero(on_fish.any(axis=(1, 2)))
    assert len(seen) > 3
    for frame in (0, int(seen[-1])):
        here = slice(frame, frame + 1)
        (pings,) = simulator.pings(store.read("pose", here), first=frame, labels=True, time_s=time_s[here])
        image = to_uint8(to_image(pings.levels[0], store.about["gain"], simulator.sonar))
        np.testing.assert_array_equal(store.read("image", here)[0], image)
        np.testing.assert_array_equal(store.read("object_id", here)[0], pings.labels["object_id"][0])


def test_a_body_that_does_not_move_is_refused_before_a_store_is_made(tmp_path: Path) -> None:
    for bodies, words in ((["fisch"], "no body 'fisch' moves .*did you mean fish"), (["fish", "fish"], "only once")):
        with pytest.raises(MitsonarError, match=words):
            make_dataset(moving_recipe(tmp_path / "tank", bodies=bodies, gain=1e3), str(tmp_path / "data.zarr"))
    with pytest.raises(MitsonarError, match="nothing moves there"):
        make_dataset(tiny_recipe(bodies=["cubes"]), str(tmp_path / "data.zarr"))
    assert not (tmp_path / "data.zarr" / "zarr.json").exists()
