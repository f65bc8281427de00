"""A vehicle with several sensors: each sees what it would alone at its mounted poses, from XML, YAML and Python."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose, mount_between, mounted
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames
from mitsonar.records.responses import ImpulseResponses
from mitsonar.records.soundings import Soundings, range_rates
from mitsonar.simulation.channel import ChannelSimulator
from mitsonar.simulation.instrument_runs import run_vehicle
from mitsonar.simulation.scene import load_motions, load_scene, motions_of
from mitsonar.simulation.simulator import Simulator
from mitsonar.simulation.vehicle import Mounted, VehicleSimulator, load_vehicle, sensors_in

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")]

SCENE = """<scene version="3.0.0">
<emitter type="constant"/>
<sensor type="imaging_sonar" id="ahead"><integer name="beams" value="12"/><float name="range_max" value="9"/>
  <string name="quality" value="draft"/>
  <transform name="to_world"><lookat origin="0, 0.3, 2" target="0, 4, 0.5" up="0, 0, 1"/></transform></sensor>
<sensor type="perspective" id="camera"><float name="fov" value="60"/>
  <transform name="to_world"><lookat origin="0, 0, 2" target="0, 4, 0.5" up="0, 0, 1"/></transform>
  <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
  <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="24"/></film></sensor>
<shape type="rectangle" id="floor"><transform name="to_world"><scale value="20"/></transform></shape>
<shape type="sphere" id="fish"><float name="radius" value="0.3"/>
  <texture type="trajectory" name="motion"><string name="filename" value="fish*.tum"/></texture></shape>
<shape type="cube" id="skid"><transform name="to_world"><scale x="0.2" y="0.2" z="0.02"/><translate z="-0.5"/></transform>
  <texture type="trajectory" name="motion"><string name="filename" value="vehicle"/></texture></shape>
</scene>"""
PATH = Trajectory.between(Pose(0, 0, 2), Pose(0, 0.6, 2), 3, 2.0)
FISH = Trajectory.between(Pose(-0.4, 4, 0.8), Pose(0.6, 4.5, 0.8), 2, 1.0)


@pytest.fixture
def tank(tmp_path: Path) -> Path:
    FISH.save(tmp_path / "fish.tum")
    (tmp_path / "tank.xml").write_text(SCENE)
    return tmp_path / "tank.xml"


def test_mounts_are_found_again() -> None:
    vehicle, mount = Pose(1, 2, 3, 0.1, -0.2, 0.7), Pose(0.3, 0.5, -0.2, 0.4, 0.1, -0.3)
    sensor = Pose(*mounted(vehicle, mount)[0])
    np.testing.assert_allclose(mount_between(vehicle, sensor), mount, atol=1e-9)


def test_each_sensor_sees_what_it_would_alone(tank: Path) -> None:
    scene = load_scene(tank)
    records = VehicleSimulator(scene).render(PATH, labels=True)
    assert set(records) == {"ahead", "camera"}
    seen, pictures = records["ahead"], records["camera"]
    assert isinstance(seen, SonarFrames)
    assert isinstance(pictures, np.ndarray)
    assert pictures.shape == (3, 24, 32)
    assert not np.array_equal(pictures[0], pictures[2])  # the fish swims past
    sensor = sensors_in(scene, Pose(*PATH.poses[0]))["ahead"]
    assert isinstance(sensor.instrument, Sonar)
    np.testing.assert_allclose(sensor.mount[:3], (0, 0.3, 0), atol=1e-6)
    moving = {"fish": FISH, "skid": PATH}
    alone = Simulator(scene, sensor.instrument, moving=moving).render(sensor.path(PATH))
    np.testing.assert_allclose(seen.image, alone.image, atol=1e-4)
    assert seen.body_names == ("fish", "skid")
    with pytest.raises(MitsonarError, match="500 m from the path"):
        sensors_in(scene, Pose(500, 0, 2))


def test_hydrophones_hear_bodies_that_move(tank: Path) -> None:
    sonar = ChannelSonar(points_per_m2=20)
    ear, scene = Mounted(sonar), load_scene(tank)
    record = VehicleSimulator(scene, {"ear": ear}, moving={"fish": FISH}).render(PATH)["ear"]
    alone = ChannelSimulator(scene, sonar, moving={"fish": FISH}).responses(ear.path(PATH))
    assert isinstance(record, ImpulseResponses)
    np.testing.assert_array_equal(record.response, alone.response)


@pytest.mark.thorough
def test_a_run_goes_on_with_the_same_bits(tank: Path, tmp_path: Path) -> None:
    from mitsonar.acoustics.noise import NOISE_MODELS
    from mitsonar.simulation.runs import Destination, RenderOptions

    class KilledError(Exception):
        pass

    (tmp_path / "auv.yaml").write_text(
        "sensors:\n  ahead: {sonar: {beams: 12, range_max: 9, quality: draft}, mount: [0, 0.3, 0, 20, 0, 0]}\n"
        "  down: {instrument: altimeter}\n"
        "  camera: {camera: {width: 32, height: 24, samples: 4}, mount: [0, 0, 0, 20, 0, 0]}\n"
        "moving: {fish: fish.tum}\n"
    )
    file, options, calls = load_vehicle(tmp_path / "auv.yaml"), RenderOptions(NOISE_MODELS["none"]), [0]
    simulator = VehicleSimulator(load_scene(tank), file.sensors, moving={"fish": FISH})

    def killed(pings: int) -> None:
        calls[0] += pings
        if calls[0] == 7:
            raise KilledError

    with pytest.raises(KilledError):
        run_vehicle(simulator, PATH, options, Destination(tmp_path / "run", progress=killed))
    (tmp_path / "run" / "camera" / "images" / "000000.png").unlink()  # what was deleted is made again
    report = run_vehicle(simulator, PATH, options, Destination(tmp_path / "run", resume=True))
    run_vehicle(simulator, PATH, options, Destination(tmp_path / "whole"))
    assert report.sensors == ("ahead", "down", "camera")
    for name in ("ahead/images/000002.png", "camera/images/000000.png", "camera/images/000002.png", "vehicle.tum"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    down = Soundings.load(tmp_path / "run" / "down" / "soundings.npz")
    np.testing.assert_allclose(down.range_m.ravel(), 2.0, atol=0.08)
    with pytest.raises(MitsonarError, match="kept as it is"):
        run_vehicle(simulator, PATH, options, Destination(tmp_path / "run"))
    fewer = VehicleSimulator(load_scene(tank), {"down": file.sensors["down"]}, moving={"fish": FISH})
    with pytest.raises(MitsonarError, match="does not replace, ahead, camera: remove"):
        run_vehicle(fewer, PATH, options, Destination(tmp_path / "run", overwrite=True))


def test_motions_of_the_scene_and_of_a_file_are_the_same(tank: Path, tmp_path: Path) -> None:
    output = motions_of(load_scene(tank))
    (tmp_path / "moving.yaml").write_text("fish: fish.tum\nskid: vehicle\n")
    read = load_motions(tmp_path / "moving.yaml")
    assert output["skid"] == read["skid"] == "vehicle"
    np.testing.assert_array_equal(output["fish"][0].poses, read["fish"][0].poses)
    with pytest.raises(MitsonarError, match="skid follows the vehicle"):
        Simulator(load_scene(tank))


def test_range_rates_are_those_of_body_and_sonar(tank: Path) -> None:
    """Rate of a pixel: (v_fish - v_sonar) . d on the fish, -v_sonar . d on the floor."""
    scene = load_scene(tank)
    frames = Simulator(scene, moving={"fish": FISH}).render(
        Trajectory(mounted(PATH.poses, Pose(0, 0.3, 0, 0.35)), PATH.time_s), labels=True
    )
    rates = range_rates(frames)
    assert frames.object_id is not None
    assert frames.poses is not None
    fish = frames.object_id == frames.object_names.index("fish")
    np.testing.assert_array_equal(np.isfinite(rates), frames.object_id >= 0)
    for number, time in enumerate(PATH.time_s):
        centre, here = FISH.at(time)[0, :3], frames.poses[number, :3]
        way = (centre - here) / np.linalg.norm(centre - here)
        assert rates[number][fish[number]].mean() == pytest.approx((np.array([1, 0.5, 0]) - [0, 0.6, 0]) @ way, abs=0.08)
    ground = (frames.object_id == 0) & ~fish
    drop = 2.0 / np.broadcast_to(frames.range_m[None, :, None], rates.shape)
    across = np.sin(frames.bearing_rad)[None, None]
    ahead = np.sqrt(1 - drop**2) * np.cos(across)
    np.testing.assert_allclose(rates[ground], (-0.6 * ahead)[ground], atol=0.03)


def test_a_sensor_that_cannot_follow_is_named_before_any_is_rendered(tank: Path, tmp_path: Path) -> None:
    from mitsonar.acoustics.noise import NOISE_MODELS
    from mitsonar.simulation.runs import Destination, RenderOptions

    (tmp_path / "auv.yaml").write_text(
        "sensors:\n  ahead: {sonar: {beams: 12, range_max: 9, quality: draft}}\n  head: {sonar: ping360}\n"
    )
    simulator = VehicleSimulator(load_scene(tank), load_vehicle(tmp_path / "auv.yaml").sensors)
    calls: list[int] = []
    for noise, output in (("none", r"sensor head: a sweep lasts 18\.67 s and the path 1 s"), ("low", "sensor head: ")):
        options = RenderOptions(NOISE_MODELS[noise])
        with pytest.raises(MitsonarError, match=output):
            run_vehicle(simulator, PATH, options, Destination(tmp_path / "run", progress=calls.append))
    assert not calls
    assert not (tmp_path / "run").exists()
    with pytest.raises(MitsonarError, match="sensor head: a sweep"):
        simulator.render(PATH)


def test_hydrophones_over_instances_are_refused_before_any_sensor_is_rendered(tmp_path: Path) -> None:
    from mitsonar.acoustics.noise import NOISE_MODELS
    from mitsonar.simulation.runs import Destination, RenderOptions

    (tmp_path / "auv.yaml").write_text("sensors:\n  ahead: {sonar: {beams: 12}}\n  ears: {hydrophones: {}}\n")
    simulator = VehicleSimulator(load_scene("objects"), load_vehicle(tmp_path / "auv.yaml").sensors)
    with pytest.raises(MitsonarError, match="sensor ears: scatterers cannot lie on instances: got cannon"):
        run_vehicle(simulator, PATH, RenderOptions(NOISE_MODELS["none"]), Destination(tmp_path / "run"))
    assert not (tmp_path / "run").exists()
