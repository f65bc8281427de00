"""Simulators follow their scene: what ``mi.traverse`` changes between pings is in the next ping, as in a new simulator."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from helpers import box, diffuse, essence, floor, plate, separate, sphere

from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sounder
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.simulation.channel import ChannelSimulator
from mitsonar.simulation.simulator import Simulator
from mitsonar.simulation.sounding import SounderSimulator

if TYPE_CHECKING:
    import mitsuba as mi

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")]

SONAR = Sonar(beams=8, range_bins=48, rays_per_beam=60, rays_across=2, range_min=3.0, range_max=6.0)
COHERENT = Sonar.create(model="coherent", frequency_hz=1.1e6, beams=24, azimuth_fov_deg=14.5, range_min=3.0, range_max=5.0,
                        range_bins=96, bearing="cone", quality="draft")  # fmt: skip
POSE = Pose(0, 0, 2.5, np.radians(35))


def ground() -> mi.Scene:
    """A floor with a box and a sphere, a textured plate, and a plate of sand."""
    import mitsuba as mi

    checks: dict[str, Any] = {"type": "bitmap", "data": mi.TensorXf(np.ones((4, 4, 1), np.float32)), "raw": True}
    return separate(
        floor=floor(diffuse(0.9), 20),
        crate=box((0.3, 3.4, 0.3), (0.3, 0.3, 0.3)),
        ball=sphere((-0.4, 3.3, 0.2), 0.2),
        board=plate((0.0, 4.4, 0.5), (0, -1, 0.2), 0.4, diffuse(checks)),
        sand={**floor({"type": "acoustic_material", "material": "sand", "reflectance": 0.4}, 1.0), "to_world": _placed()},
    )


def _placed() -> Any:
    import mitsuba as mi

    return mi.ScalarTransform4f().translate([0.6, 3.6, 0.05]).scale(0.4)


def _darker(values: Any) -> None:
    values["floor.bsdf.reflectance.value"] = 0.1


def _sand(values: Any) -> None:
    values["sand.bsdf.reflectance.value"] = 0.8


def _deformed(values: Any) -> None:
    corners = np.array(values["crate.vertex_positions"]).reshape(-1, 3)
    corners[:, 2] *= 1 + 0.8 * corners[:, 0]
    values["crate.vertex_positions"] = corners.ravel()


def _tilted(values: Any) -> None:
    import mitsuba as mi

    values["floor.to_world"] = mi.ScalarTransform4f().rotate([1, 0, 0], 10).scale(20)


def _rolled(values: Any) -> None:
    import mitsuba as mi

    values["ball.to_world"] = mi.ScalarTransform4f().translate([0.1, 3.1, 0.4]).scale(0.3)


def _painted(values: Any) -> None:
    import mitsuba as mi

    values["board.bsdf.reflectance.data"] = mi.TensorXf(np.eye(4, dtype=np.float32)[..., None])


CHANGES = [_darker, _sand, _painted, _deformed, _tilted, _rolled]


def change(scene: mi.Scene, one: Callable[[Any], None]) -> None:
    import mitsuba as mi

    values = mi.traverse(scene)
    one(values)
    values.update()


def levels(simulator: Simulator) -> Any:
    return np.concatenate([pings.levels for pings in simulator.pings([POSE], first=5)])


@pytest.mark.parametrize("model", essence(["physical", "thesis", "coherent"], "physical", "thesis"))
def test_a_changed_scene_is_rendered_as_by_a_new_simulator(model: str) -> None:
    """Bit for bit, after each change; and each of them changes the picture but that of a material's plain colour."""
    sonar = COHERENT if model == "coherent" else SONAR.replace(model=model)
    scene = ground()
    simulator = Simulator(scene, sonar)
    before = levels(simulator)
    for one in CHANGES:
        change(scene, one)
        current = levels(simulator)
        np.testing.assert_array_equal(current, levels(Simulator(scene, sonar)), err_msg=one.__name__)
        assert (current != before).any() == (one is not _sand), one.__name__
        np.testing.assert_array_equal(current, levels(simulator))
        before = current


def test_a_darker_floor_is_darker_at_the_next_step_of_a_loop() -> None:
    """What was wrong: the step showed the reflectivity of before."""
    scene = separate(floor=floor(diffuse(0.9), 20))
    simulator = Simulator(scene, SONAR)
    bright = simulator.step(POSE, gain=1e-6)
    change(scene, _darker)
    dark = simulator.step(POSE)
    assert dark.image.sum() / bright.image.sum() == pytest.approx(1 / 9, rel=1e-3)
    assert dark.time_s[0] > bright.time_s[0]  # the loop goes on
    assert simulator.gain == 1e-6


@pytest.mark.parametrize("model", essence(["physical", "coherent"], "physical"))
def test_with_mirrors_and_several_bounces_all_follows(model: str) -> None:
    sonar = (COHERENT if model == "coherent" else SONAR.replace(frequency_hz=3e5)).replace(bounces=2)
    scene = ground()
    simulator = Simulator(scene, sonar, mirrors={"board": (-1.0, 0.0)})
    levels(simulator)
    change(scene, _tilted)
    np.testing.assert_array_equal(levels(simulator), levels(Simulator(scene, sonar, mirrors={"board": (-1.0, 0.0)})))


def test_the_still_shapes_around_moving_bodies_follow() -> None:
    def made(scene: mi.Scene) -> Simulator:
        return Simulator(scene, SONAR, moving={"ball": Trajectory(np.array([Pose(0, 0, 0), Pose(0, 1, 0)]), np.arange(2.0))})

    scene = ground()
    simulator = made(scene)
    for one in (_darker, _deformed):
        levels(simulator)
        change(scene, one)
        np.testing.assert_array_equal(levels(simulator), levels(made(scene)), err_msg=one.__name__)


def test_groups_of_beams_that_ping_one_after_another_follow() -> None:
    sonar = SONAR.replace(ping_groups=2)
    scene = ground()
    simulator = Simulator(scene, sonar)
    levels(simulator)
    change(scene, _darker)
    np.testing.assert_array_equal(levels(simulator), levels(Simulator(scene, sonar)))


@pytest.mark.parametrize("model", essence(["rays", "scatterers"], "rays"))
def test_hydrophones_hear_the_scene_as_it_is(model: str) -> None:
    """A simulator that shares the scatterers of an older one does not share those of before."""
    sonar = ChannelSonar(range_max=8.0, model=model, rays=2000, points_per_m2=400)
    scene = separate(floor=floor(diffuse(0.9), 2), ball=sphere((0.5, 0.2, 0.3), 0.3))
    older, simulator = ChannelSimulator(scene, sonar), ChannelSimulator(scene, sonar)
    pose, rest = Pose(0, 0, 4), [0, 0, 0, 0]
    before = simulator.step(pose, rest).response
    for one in (_darker, _rolled, _tilted):
        change(scene, one)
        current = simulator.step(pose, rest).response
        np.testing.assert_array_equal(current, ChannelSimulator(scene, sonar, like=older).step(pose, rest).response)
        assert (current != before).any(), one.__name__
        before = current


def test_sounders_follow() -> None:
    scene = separate(floor=floor(diffuse(0.9), 20))
    sounder = load_sounder("altimeter").replace(model="physical", pattern="box", range_min=1, range_max=8, quality="draft")
    simulator = SounderSimulator(scene, sounder)
    loud = np.concatenate([batch.levels for batch in simulator.pings([Pose(0, 0, 3)])])
    change(scene, _darker)
    quiet = np.concatenate([batch.levels for batch in simulator.pings([Pose(0, 0, 3)])])
    assert quiet.sum() / loud.sum() == pytest.approx(1 / 9, rel=1e-3)


def test_a_scene_that_becomes_impossible_is_refused_at_the_next_ping() -> None:
    scene = separate(floor=floor(diffuse(0.9), 4))
    simulator = ChannelSimulator(scene, ChannelSonar(range_max=8.0))
    change(scene, lambda values: values.__setitem__("floor.bsdf.reflectance.value", 0.0))
    with pytest.raises(MitsonarError):
        simulator.step(Pose(0, 0, 4), [0, 0, 0, 0])


def test_an_unchanged_scene_makes_nothing_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does a sphere that only moves, which Mitsuba looks up."""
    from mitsonar.plugins.surfaces import Surfaces

    scene = ground()
    simulator = Simulator(scene, SONAR)
    result: list[str] = []
    monkeypatch.setattr(Surfaces, "from_scene", lambda *_: result.append("anew"))
    levels(simulator)
    change(scene, _rolled)
    levels(simulator)
    assert result == []
