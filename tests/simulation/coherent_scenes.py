"""The sonar, the floor's pose and imagers that tests of the model coherent share."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from helpers import Array, diffuse, plate, scene

from mitsonar.instruments.sonar import Sonar

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.simulation.models.coherent import CoherentImager

HEIGHT, PITCH = 2.5, math.radians(35)
SONAR = Sonar.create(model="coherent", frequency_hz=1.8e6, beams=48, azimuth_fov_deg=14.5, beam_width_deg=0.3, range_min=4.0,
                     range_max=4.9, range_bins=192, bearing="cone", elevation_pattern="box", quality="standard",
                     absorption_db_per_m=0.0)  # fmt: skip
"""Half the field of view of a DIDSON, its window within the lit floor."""

BOXES = SONAR.replace(model="physical", beam_width_deg=None, azimuth_fov_deg=48 * 0.3)
"""Hard boxes as wide as the beams."""

POSE = np.array([0, 0, HEIGHT, PITCH, 0, 0])


def imager(loaded: mi.Scene, sonar: Sonar = SONAR) -> CoherentImager:
    from mitsonar.simulation.models.coherent import CoherentImager

    return CoherentImager(loaded, sonar)


def one_point(half: float = 0.01) -> tuple[mi.Scene, dict[str, float], Array]:
    """A small plate 4.4 m ahead of the origin that carries one lattice point: scene, fields of a sonar, the point's place.

    Seeds are tried until exactly one point lies on the plate, far from its edge and not weak.
    """
    from mitsonar.plugins.surfaces import grain_key
    from mitsonar.simulation.points import lattice_points

    at = np.array([0, 4.4, 0])
    loaded = scene(target=plate(at, (0, -1, 0), half=half, bsdf=diffuse(0.5)))
    for seed in range(200):
        points = lattice_points(loaded.shapes()[0], grain_key("target", 0), 3 * half, seed)
        place, weight = points.place, points.strength / (0.5 * (3 * half) ** 2)
        if len(place) == 1 and np.abs(place[0] - at).max() < 0.6 * half and weight[0] > 0.5:
            return loaded, {"scatterer_spacing_m": 3 * half, "seed": seed}, place[0].astype(float)
    raise AssertionError("no seed puts one point on the plate")
