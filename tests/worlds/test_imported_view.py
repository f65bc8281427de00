"""The sonar of an imported scene looks at its objects, from near enough to see them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from helpers import Command

from mitsonar.bridges.model_import import REACH, imported_world
from mitsonar.errors import MitsonarWarning
from mitsonar.worlds.world import World


def link(name: str, place: str, geometry: str) -> str:
    visual = f'<visual name="v"><geometry>{geometry}</geometry></visual>'
    return f'<model name="{name}"><pose>{place} 0 0 0</pose><link name="l">{visual}</link></model>'


GROUND = link("ground", "0 0 0", "<plane><size>40 40</size></plane>")
WALL = link("wall", "6 2 1", "<box><size>0.5 4 2</size></box>")
FAR_PILE = link("pile", "-15 -15 1", "<cylinder><radius>0.2</radius><length>2</length></cylinder>")
SCREEN = link("screen", "6 -3 3.9", "<box><size>3 0.1 2</size></box>")
SHIP = link("ship", "0 0 5", "<ellipsoid><radii>10 60 5</radii></ellipsoid>")
ROV = link("rov", "2 0 1", "<box><size>0.6 0.3 0.3</size></box>")


def world_numbers(folder: Path, *parts: str, **options: list[str]) -> World:
    (folder / "w.sdf").write_text(f'<sdf version="1.9"><world name="w">{"".join(parts)}</world></sdf>')
    return imported_world(folder / "w.sdf", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("parts", "target", "what"),
    [
        ((GROUND, WALL), (6, 2, 1), "looks at wall::l"),
        ((GROUND, WALL, FAR_PILE), (6, 2, 1), "looks at wall::l"),  # the largest that the reach takes in
        ((WALL, link("ball", "4 0 1", "<sphere><radius>0.5</radius></sphere>")), (4.875, 1.75, 1), "looks at all 2 shapes"),
        ((GROUND, ROV, WALL), (6, 2, 1), "looks at wall::l"),  # the ROV is elsewhere: it is about the origin
        ((link("tile", "0 0 0", "<plane><size>2 2</size></plane>"),), (0, 0, 0), "looks at tile::l"),
    ],
)
def test_it_looks_at_the_objects_and_not_at_the_ground(
    parts: tuple[str, ...], target: tuple[float, ...], what: str, tmp_path: Path
) -> None:
    world = world_numbers(tmp_path, *parts, own_axes=["rov"] if ROV in parts else [])
    np.testing.assert_allclose(world.stand.target, target, atol=1e-6)
    near, far = world.stand.window
    away = np.linalg.norm(np.subtract(world.stand.origin, target))
    assert 1 <= near < away < far <= REACH[world.stand.preset]
    assert what in world.about


def test_what_stands_before_an_object_turns_the_view(tmp_path: Path) -> None:
    """A screen to the south: the sonar stands elsewhere, 30 deg above the target all the same."""
    free, turned = (world_numbers(tmp_path, GROUND, WALL, FAR_PILE, *more).stand for more in ((), (SCREEN,)))
    np.testing.assert_allclose(np.subtract(free.origin, free.target)[0], 0, atol=1e-9)
    seen = np.subtract(turned.origin, turned.target)
    assert turned.target == pytest.approx((6, 2, 1))
    assert abs(seen[0]) > 1
    assert seen[2] / np.linalg.norm(seen) == pytest.approx(0.5)


def test_of_a_ship_it_sees_a_part_from_nearby_and_says_so(tmp_path: Path) -> None:
    with pytest.warns(MitsonarWarning, match=r"looks at a part of ship::l from 5\.\d+ m; no shape is small enough"):
        world = world_numbers(tmp_path, GROUND, SHIP)
    place = np.divide(np.subtract(world.stand.target, (0, 0, 5)), (10, 60, 5))
    assert np.linalg.norm(place) == pytest.approx(1, abs=0.01)  # on the hull
    assert world.stand.window[1] <= REACH[world.stand.preset]


@pytest.mark.thorough
def test_the_printed_command_shows_the_object(mitsonar: Command, tmp_path: Path) -> None:
    """In the guide's own scene, some pixels are far brighter than the ground, and none is at the maximum for noise."""
    (tmp_path / "w.sdf").write_text(f'<sdf version="1.9"><world name="w">{GROUND}{WALL}{ROV}</world></sdf>')
    done = mitsonar("world", "import", tmp_path / "w.sdf", "--own-axes", "rov", "-o", tmp_path / "w")
    assert done.returncode == 0, done.stderr
    words = re.search(r"mitsonar (render \S+ --cartesian)", done.stdout)
    assert words is not None
    done = mitsonar(*words[1].split(), "--quality", "draft", "-o", tmp_path / "r")
    assert done.returncode == 0, done.stderr
    assert "at the maximum" not in done.stderr
    with np.load(tmp_path / "r" / "frames.npz") as frames:
        image = frames["image"][0].astype(float)
        ranges, bearing = frames["range_m"], frames["bearing_rad"]
    ahead = abs(bearing) < np.radians(1.5)
    shadow = image[(ranges > 11.5) & (ranges < 14)][:, ahead].mean()
    wall = image[(ranges > 7.3) & (ranges < 8.5)][:, ahead].mean()
    assert wall > 5 * shadow
