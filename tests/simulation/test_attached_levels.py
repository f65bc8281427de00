"""Levels with derivatives: those of the model physical, and central differences where facets have no borders."""

from __future__ import annotations

from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import MitsubaDict, diffuse, sphere

import mitsonar
from mitsonar.errors import MitsonarError
from mitsonar.motion.pose import Pose, to_world_matrices
from mitsonar.simulation.simulator import Simulator

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside the window")]

POSE = Pose(0, -3, 2.0, 0.6)


def built(**shapes: MitsubaDict) -> mi.Scene:
    """A tilted plane and other shapes, under a sonar whose rays stand in the middle of their cells."""
    instrument = {"type": "imaging_sonar", "beams": 24, "range_min": 2.0, "range_max": 5.5, "range_bins": 96,
                  "gain_exponent": 2, "jitter": False, "rays_per_beam": 200}  # fmt: skip
    matrix = to_world_matrices(np.array([POSE], dtype=float))[0]
    plane = mi.ScalarTransform4f().rotate([1, 0, 0], 3).scale(20)
    sonar = {**instrument, "to_world": mi.ScalarTransform4f(matrix)}
    ground = {"type": "rectangle", "to_world": plane, "bsdf": diffuse(0.4)}
    scene = {"type": "scene", "integrator": {"type": "echo"}, "sonar": sonar, "ground": ground, **shapes}
    return cast(mi.Scene, mi.load_dict(scene))


def test_levels_are_those_of_the_simulator() -> None:
    loaded = built(ball=sphere((0.2, 0.3, 0.1), 0.2, diffuse(0.8)))
    sonar, pose = mitsonar.sonar_in(loaded)  # type: ignore[misc]
    levels = np.array(mitsonar.expected_levels(mi.render(loaded, spp=1), sonar))
    truth = next(iter(Simulator(loaded, sonar).pings(pose))).levels[0]
    np.testing.assert_allclose(levels, truth, rtol=1e-6, atol=1e-9 * truth.max())
    assert (truth > 0).mean() > 0.3


def test_they_have_the_derivatives_of_central_differences() -> None:
    """By height and pitch of the sonar and by the reflectance, of a sum with weights that vary over range and beams."""
    loaded = built()
    sonar, _ = mitsonar.sonar_in(loaded)  # type: ignore[misc]
    params = mi.traverse(loaded)
    stood, bins = mi.Transform4f(params["sonar.to_world"]), np.arange(96)[:, None] / 96
    weight = (np.sin(5 * bins) + 1) * np.linspace(0.5, 1.5, 24)

    def total(values: list[mi.Float]) -> mi.TensorXf:
        height, pitch, reflectance = values
        up = mi.Transform4f().translate(mi.Vector3f(0, 0, height))
        params["sonar.to_world"] = up @ stood @ mi.Transform4f().rotate(mi.Vector3f(1, 0, 0), pitch)
        kind = type(params["ground.bsdf.reflectance.value"])
        params["ground.bsdf.reflectance.value"] = kind(0.4 + reflectance)
        params.update()
        return mitsonar.expected_levels(mi.render(loaded, params, spp=1), sonar)

    for k, step in enumerate((2e-3, 0.05, 0.02)):
        values = [mi.Float(0) for _ in range(3)]
        dr.enable_grad(values[k])
        levels = total(values)
        dr.forward(values[k])
        slope = (np.array(dr.grad(levels)) * weight).sum()
        sides = []
        for side in (step, -step):
            values = [mi.Float(0) for _ in range(3)]
            values[k] = mi.Float(side)
            sides.append((np.array(total(values)).astype(float) * weight).sum())
        assert slope == pytest.approx((sides[0] - sides[1]) / (2 * step), rel=1e-3)


def test_what_it_cannot_bin_is_refused() -> None:
    loaded = built()
    sonar, _ = mitsonar.sonar_in(loaded)  # type: ignore[misc]
    image = mi.render(loaded, spp=1)
    with pytest.raises(MitsonarError, match="got model coherent"):
        mitsonar.expected_levels(image, sonar.replace(model="coherent", frequency_hz=1e6))
    with pytest.raises(MitsonarError, match=r"must be .* = \(200, 48, 16\): got \(200, 96, 16\)"):
        mitsonar.expected_levels(image, sonar.replace(beams=12))
