"""Portions of a coherent ping: two sides are the whole, each holds its own ground, energies are the expected ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pytest
from helpers import Array, box, diffuse, essence, floor, scene
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import Segment, View
from mitsonar.motion.pose import Pose, mounted

if TYPE_CHECKING:
    from mitsonar.simulation.simulator import Simulator

pytestmark = pytest.mark.usefixtures("variant")

SONAR = Sonar.create(
    **{"name": "down", "model": "coherent", "frequency_hz": 300e3, "azimuth_fov_deg": 60, "elevation_fov_deg": 60},
    **{"beams": 20, "range_min": 1.5, "range_max": 3.0, "range_bins": 60, "elevation_pattern": "box", "coding": "linear"},
)
DOWN = Pose(0, 0, 0, np.radians(90), 0, np.radians(-90))
"""A mount that looks straight down, bearings along the vehicle."""


def pose_at(x: float = 0.0) -> Array:
    """The sonar 2 m above the ground."""
    return np.asarray(mounted(Pose(x, 0, 2), DOWN)[0])


def simulator(loaded: object, names: Sequence[str], sonar: Sonar = SONAR) -> Simulator:
    from mitsonar.simulation.simulator import Simulator

    views: list[View] = [Segment(sonar, name) for name in names]
    return Simulator(loaded, sonar, views=views)  # type: ignore[arg-type]


def levels(source: Simulator, poses: Array) -> list[NDArray[np.float32]]:
    """Levels of all pings in each view ``(pings, bins, beams)``."""
    pings = list(source.render_views(poses))
    return [np.concatenate([views[k].levels for views in pings]) for k in range(len(pings[0]))]


def test_both_sides_add_up_to_the_whole() -> None:
    """Every point is on one side, so the fields add up, up to the rounding of single precision."""
    from mitsonar.simulation.models.coherent import CoherentImager

    loaded = scene(floor=floor(), box=box([0.3, 0.2, 0.1], [0.1, 0.2, 0.1]))
    whole, rays = CoherentImager(loaded, SONAR).image(pose_at(), 0)
    sides = [Segment(SONAR, "starboard"), Segment(SONAR, "port")]
    both, counts = CoherentImager(loaded, SONAR, views=sides).image(pose_at(), 0)
    assert both.shape == (60, 40)
    np.testing.assert_allclose(both[:, :20] + both[:, 20:], whole, atol=2e-6 * np.abs(whole).max())
    assert np.abs(both[:, :20]).max() > 0.1 * np.abs(whole).max()
    assert np.abs(both[:, 20:]).max() > 0.1 * np.abs(whole).max()
    assert counts == rays


def test_quadrants_are_the_beams_of_a_side() -> None:
    loaded = scene(floor=floor())
    poses = np.stack([pose_at(), pose_at(0.5)])
    starboard, port = levels(simulator(loaded, ["starboard", "port"]), poses)
    fore_starboard, aft_starboard, aft_port, fore_port = levels(simulator(loaded, ["q1", "q2", "q3", "q4"]), poses)
    np.testing.assert_array_equal(np.concatenate([aft_starboard, fore_starboard], axis=2), starboard)
    np.testing.assert_array_equal(np.concatenate([aft_port, fore_port], axis=2), port)


QUADRANTS = [("q1", 1, 1), ("q2", 1, -1), ("q3", -1, -1), ("q4", -1, 1)]


@pytest.mark.parametrize(("name", "x", "y"), essence(QUADRANTS, ("q1", 1, 1), ("q2", 1, -1)))
def test_a_quadrant_holds_what_lies_there(name: str, x: int, y: int) -> None:
    """Starboard is +x and ahead +y: only the quadrant above a plate shows it, but for the side lobes beside its beams."""
    plate = box([0.55 * x, 0.55 * y, 0], [0.2, 0.2, 0.01], bsdf=diffuse(0.8))
    names = ["q1", "q2", "q3", "q4"]
    result = [float(view.sum()) for view in levels(simulator(scene(plate=plate), names), pose_at()[None])]
    shares = np.array(result) / sum(result)
    assert shares[names.index(name)] > 0.999


@pytest.mark.thorough
def test_energies_are_those_of_the_model_physical() -> None:
    """The vectors of a flat floor, mean over 40 pings 3 m apart, whose speckle is independent."""
    loaded = scene(floor=floor())
    poses = np.stack([pose_at(3.0 * k) for k in range(40)])
    names = ["q1", "q3"]
    speckled = levels(simulator(loaded, names), poses)
    expected = levels(simulator(loaded, names, SONAR.replace(model="physical", pattern=None)), poses[:4])
    for coherent, physical in zip(speckled, expected, strict=True):
        target, energy = physical.sum(axis=(1, 2)).mean(), coherent.sum(axis=(1, 2))
        error = energy.std(ddof=1) / np.sqrt(len(energy))
        assert abs(energy.mean() - target) < 3 * error + 0.03 * target, (energy.mean() / target, error / target)


def test_noise_is_of_each_side() -> None:
    sonar = SONAR.replace(noise_level_db=80, source_level_db=200)
    fore = levels(simulator(scene(floor=floor(bsdf=diffuse(0.0))), ["q1", "q4"], sonar), pose_at()[None])
    assert all(view.min() > 0 for view in fore)
    assert abs(np.corrcoef(fore[0].ravel(), fore[1].ravel())[0, 1]) < 0.15


def test_what_has_no_portions_is_refused() -> None:
    loaded = scene(floor=floor())
    with pytest.raises(MitsonarError, match="nor cones: got c1"):
        simulator(loaded, ["q1", "c1"])
    with pytest.raises(MitsonarError, match="portions have no labels"):
        list(simulator(loaded, ["q1"]).render_views(pose_at()[None], labels=True))
    from mitsonar.simulation.models.coherent import CoherentImager

    with pytest.raises(MitsonarError, match="mirrors need the whole view: got q1"):
        CoherentImager(loaded, SONAR, {"floor": (0.5, 0.001)}, [Segment(SONAR, "q1")])
