"""Scatterers of the world: one in each cell, strengths, selection by a field of view, shadows, energy."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from channel_scenes import CELLS, LEVEL, C, cells_floor, points, received_from, scatterers_of, simulator
from helpers import box, diffuse, floor, scene, sphere

from mitsonar.instruments.channel_sonar import ChannelSonar, FieldOfView, Hydrophone
from mitsonar.motion.pose import Pose
from mitsonar.simulation.channel import ChannelSimulator

if TYPE_CHECKING:
    pass

pytestmark = pytest.mark.usefixtures("variant")


def test_every_cell_has_one_point_inside_it_whoever_looks() -> None:
    made = simulator(ChannelSonar(), floor=cells_floor(cells=64.0))
    place = points(made)
    assert len(place) == 64**2
    cell = np.floor((place[:, :2] / 28 + 0.5) * 64).astype(int)
    assert len(np.unique(cell, axis=0)) == 64**2
    within = (place[:, :2] / 28 + 0.5) * 64 - cell
    for axis in within.T:  # uniform in the cell: Kolmogorov's distance
        assert np.abs(np.sort(axis) - (np.arange(64**2) + 0.5) / 64**2).max() < 1.63 / 64
    other = simulator(ChannelSonar(seed=8, range_max=20.0), floor=cells_floor(cells=64.0))
    assert np.array_equal(points(other), place)
    different = simulator(ChannelSonar(), floor=floor(diffuse({**CELLS, "cells": 64.0, "seed": 6}), 14.0))
    assert not np.array_equal(points(different), place)


@pytest.mark.parametrize("shape", ["rectangle", "mesh", "sphere"])
def test_strengths_add_up_to_reflectivity_times_area(shape: str) -> None:
    kinds = {
        "rectangle": (floor(diffuse(0.3), 2.0), 16.0),
        "mesh": (box((0, 0, 0), (1, 2, 3), diffuse(0.3)), 88.0),
        "sphere": (sphere((0, 0, 0), 1.5, diffuse(0.3)), 4 * np.pi * 2.25),
    }
    body, area = kinds[shape]
    made = simulator(ChannelSonar(), body=body)
    assert scatterers_of(made).strength.sum() == pytest.approx(0.3 * area, rel=0.03 if shape == "sphere" else 1e-5)


def test_a_textured_floor_has_the_strength_of_its_cells() -> None:
    made = simulator(ChannelSonar(), floor=cells_floor())
    assert scatterers_of(made).strength.sum() == pytest.approx(0.5 * 28**2, rel=0.01)


def test_a_field_of_view_selects_all_that_it_receives() -> None:
    field = FieldOfView(heading_deg=40.0, tilt_deg=35.0, across_deg=17.0, along_deg=60.0)
    for one in (
        field,
        field.model_copy(update={"shape": "circular"}),
        FieldOfView(tilt_deg=90.0, across_deg=100.0, along_deg=170.0),
    ):
        sonar = ChannelSonar(receivers=(Hydrophone(name="one", field=one),))
        made = simulator(sonar, floor=cells_floor(), body=box((3, 4, 1), (1, 1, 1)))
        pose = np.array([1.0, -2.0, 6.0, 0.2, -0.1, 0.7])
        stored = scatterers_of(made)
        asked = made.tracer.source.asked(pose, 0)
        from mitsonar.motion.pose import vehicle_rotation

        way = stored.place - pose[:3]
        unit = way / np.linalg.norm(way, axis=1)[:, None]
        local = unit @ vehicle_rotation(pose).as_matrix()[0] @ one.axes.T
        front = np.einsum("pi,pi->p", stored.normal, unit) < 0
        receives = np.flatnonzero((one.sensitivity(*local.T) > 0) & front)
        assert len(receives) > 100
        assert np.isin(receives, asked).all()
        assert len(asked) < 0.8 * len(stored)


def test_bodies_hide_what_is_behind_them() -> None:
    sonar = ChannelSonar(receivers=(received_from(),))
    bare = simulator(sonar, floor=cells_floor()).paths(LEVEL)
    hidden = simulator(sonar, floor=cells_floor(), lid=box((0, 0, 5), (1.0, 1.0, 0.01), diffuse(0.0))).paths(LEVEL)
    shadow = (2 * 1.0 * 10 / 4.99) ** 2
    assert 1 - len(hidden.delay_s) / len(bare.delay_s) == pytest.approx(shadow / 28**2, rel=0.1)
    assert hidden.delay_s.min() > 2 * 10.19 / C  # straight below nothing is left


def test_energy_is_that_of_the_imaging_sonar() -> None:
    """Two routes to the energy of the floor: echoes of a receiver at the transmitter, and pixels of an image."""
    from mitsonar.instruments.imaging_sonar import Sonar
    from mitsonar.simulation.imaging import Simulator

    field = FieldOfView(tilt_deg=40.0, across_deg=20.0, along_deg=30.0, taper=0.0)
    sonar = ChannelSonar(receivers=(Hydrophone(name="one", field=field),), points_per_m2=2000.0)
    ground = scene(floor=floor(diffuse(0.5), 16.0))
    received = ChannelSimulator(ground, sonar).paths(LEVEL)
    fan = Sonar(
        azimuth_fov_deg=20.0,
        elevation_fov_deg=30.0,
        beams=20,
        range_min=5.0,
        range_max=25.0,
        bearing="cone",
        rays_per_beam=400,
    )
    (pings,) = Simulator(ground, fan).pings([Pose(0, 0, 10, np.radians(50))])
    assert (received.amplitude**2).sum() == pytest.approx(pings.levels.sum(), rel=0.01)
