"""Gradients of range and expected level by pose, reflectivity and vertices, against central differences."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from helpers import Array, diffuse, floor, scene

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import to_world_matrices

if TYPE_CHECKING:
    import mitsuba as mi

pytestmark = pytest.mark.usefixtures("variant")

SONAR = Sonar(beams=8, azimuth_fov_deg=20, rays_per_beam=40, rays_across=2)
POSE = np.array([0.1, -0.2, 2.5, 0.6, 0.1, 0.2])


def totals(loaded: mi.Scene, pose: Any) -> tuple[Any, Any]:
    """Mean range and summed level of all rays."""
    import drjit as dr
    from attached_echoes import attached_echoes

    result = attached_echoes(loaded, SONAR, pose)
    return dr.mean(result.range_m), dr.sum(result.level)


def slopes(loaded: mi.Scene, which: int, by: int, step: float) -> float:
    """Central difference of one total by one number of the pose."""
    import mitsuba as mi

    ends = []
    for sign in (1, -1):
        moved = POSE.copy()
        moved[by] += sign * step
        ends.append(float(totals(loaded, [mi.Float(v) for v in moved])[which][0]))
    return (ends[0] - ends[1]) / (2 * step)


@pytest.mark.parametrize("by", range(6))
@pytest.mark.parametrize("which", [0, 1])
def test_by_pose(variant: str, which: int, by: int) -> None:
    import drjit as dr
    import mitsuba as mi

    loaded = scene(floor=floor(diffuse(0.5)))
    pose = [mi.Float(float(v)) for v in POSE]
    dr.enable_grad(pose[by])
    dr.backward(totals(loaded, pose)[which])
    truth = slopes(loaded, which, by, 1e-2)
    assert float(dr.grad(pose[by])[0]) == pytest.approx(truth, rel=5e-3, abs=2e-4)


def test_by_reflectivity(variant: str) -> None:
    """The level is proportional to it."""
    import drjit as dr
    import mitsuba as mi

    loaded = scene(floor=floor(diffuse(0.5)))
    params = mi.traverse(loaded)
    (key,) = (key for key, _ in params if key.endswith("reflectance.value"))
    dr.enable_grad(params[key])
    level = totals(loaded, [mi.Float(float(v)) for v in POSE])[1]
    dr.backward(level)
    assert float(dr.sum(dr.grad(params[key]))[0]) == pytest.approx(float(level[0]) / 0.5, rel=1e-4)


def test_by_a_vertex(variant: str) -> None:
    """A triangle that is lifted as a whole comes nearer as the sonar that sinks."""
    import drjit as dr
    import mitsuba as mi

    mesh = mi.Mesh("floor", 3, 1)
    params = mi.traverse(mesh)
    params["vertex_positions"] = [-80.0, -80.0, 0.0, 80.0, -80.0, 0.0, 0.0, 160.0, 0.0]
    params["faces"] = [0, 1, 2]
    params.update()
    loaded: mi.Scene = mi.load_dict({"type": "scene", "floor": mesh})
    params = mi.traverse(loaded)
    (key,) = (key for key, _ in params if key.endswith("vertex_positions"))
    place = mi.Float(params[key])
    dr.enable_grad(place)
    params[key] = place
    params.update()
    pose = [mi.Float(float(v)) for v in POSE]
    dr.backward(totals(loaded, pose)[0])
    lifted = np.array(dr.grad(place)).reshape(-1, 3)[:, 2].sum()
    assert lifted == pytest.approx(-slopes(loaded, 0, 2, 1e-2), rel=5e-3)


def test_attitude_is_that_of_the_poses(variant: str) -> None:
    import mitsuba as mi
    from attached_echoes import turned

    d: Array = np.array([0.3, -0.2, 0.9])
    got = turned([mi.Float(float(v)) for v in POSE], mi.Vector3f(*d.tolist()))
    np.testing.assert_allclose(np.array(got).ravel(), to_world_matrices(POSE[None])[0, :3, :3] @ d, atol=1e-6)


def test_other_models_are_refused(variant: str) -> None:
    import mitsuba as mi
    from attached_echoes import attached_echoes

    loaded = scene(floor=floor(diffuse(0.5)))
    with pytest.raises(MitsonarError, match="those of the model physical"):
        attached_echoes(loaded, SONAR.replace(model="thesis"), [mi.Float(0)] * 6)
    with pytest.raises(MitsonarError, match="six numbers"):
        attached_echoes(loaded, SONAR, [mi.Float(0)] * 5)
