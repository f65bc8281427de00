"""Universal Transverse Mercator: values of PROJ, and properties of the projection."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.motion.utm import UtmOrigin

PROJ = [
    # latitude, longitude [deg], EPSG, east, north [m], convergence [deg]
    (48.44545, -68.827935, 32619, 512724.3898744671, 5365826.367633726, 0.1287606297036388),
    (-33.856784, 151.215297, 32756, 334900.2612919739, 6252290.522406041, 0.9945166909077838),
    (59.9, 10.75, 32632, 597897.8128840559, 6641568.107208937, 1.5141339964177303),
    (0.0, -180.0, 32601, 166021.44308054057, 0.0, 0.0),
]
"""By pyproj 3.7.2."""


@pytest.mark.parametrize(("latitude", "longitude", "epsg", "east", "north", "convergence"), PROJ)
def test_places_are_those_of_proj(
    latitude: float, longitude: float, epsg: int, east: float, north: float, convergence: float
) -> None:
    origin = UtmOrigin.near(latitude, longitude)
    assert origin.epsg == epsg
    assert 0 <= east - origin.east_m < 1
    assert 0 <= north - origin.north_m < 1
    place = origin.to_world([[latitude, longitude]])
    np.testing.assert_allclose(place, [[east - origin.east_m, north - origin.north_m]], atol=2e-6)
    assert np.degrees(origin.convergence_rad([[latitude, longitude]]))[0] == pytest.approx(convergence, abs=1e-9)


def test_there_and_back() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        latitude, longitude = rng.uniform(-80, 84), rng.uniform(-180, 180)
        origin = UtmOrigin.near(latitude, longitude)
        near = np.column_stack([latitude + rng.uniform(-0.5, 0.5, 20), longitude + rng.uniform(-1, 1, 20)])
        back = origin.to_degrees(origin.to_world(near))
        np.testing.assert_allclose(back[:, 0], near[:, 0], atol=1e-10)
        assert np.abs((back[:, 1] - near[:, 1] + 180) % 360 - 180).max() < 1e-9


def test_the_grid_turns_by_the_convergence_and_scales_by_less_than_a_thousandth() -> None:
    """A step due north and one due east, by differences, at the edge of a zone."""
    origin = UtmOrigin.near(55.0, 8.9)
    step = 1e-5  # deg
    here, north, east = origin.to_world([[55.0, 8.9], [55.0 + step, 8.9], [55.0, 8.9 + step]])
    turn = origin.convergence_rad([[55.0, 8.9]])[0]
    assert np.arctan2(*(north - here)) == pytest.approx(-turn, abs=1e-6)
    assert np.arctan2(*(east - here)) == pytest.approx(np.pi / 2 - turn, abs=1e-6)
    square = (1 / 298.257223563) * (2 - 1 / 298.257223563)
    sine = np.sin(np.radians(55.0))
    meridian = 6378137 * (1 - square) / (1 - square * sine**2) ** 1.5
    assert np.linalg.norm(north - here) / (meridian * np.radians(step)) == pytest.approx(1.0, abs=1e-3)


def test_positions_off_the_map_are_refused() -> None:
    with pytest.raises(MitsonarError, match="needs a latitude in"):
        UtmOrigin.near(85, 0)
    with pytest.raises(MitsonarError, match="longitude"):
        UtmOrigin.near(0, 181)
    origin = UtmOrigin.near(10, 3)
    for place in ([10.0, 90.0], [np.nan, 3.0], [91.0, 3.0]):
        with pytest.raises(MitsonarError, match="beyond, or is no latitude"):
            origin.to_world([place])
    with pytest.raises(MitsonarError, match="1 to 60"):
        UtmOrigin(0, False, 0.0, 0.0)
