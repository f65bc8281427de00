"""Scenes of other simulators: places in closed form, what the sonar then sees, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from foreign_scenes import BUOY, SDF, URDF, make_sdf, make_urdf
from helpers import Command, refused

from mitsonar.bridges.model_import import imported_world
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.simulation.scene import load_scene
from mitsonar.simulation.simulator import Simulator
from mitsonar.worlds.world import World


def middle_of(world: World, name: str) -> np.ndarray:
    """The middle of the box around a shape [m]."""
    (mesh,) = [mesh for mesh in world.meshes if mesh.shape_id == name]
    return np.asarray((mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2)


def edges_of(world: World, name: str) -> np.ndarray:
    """The edges of the box around a shape [m]."""
    (mesh,) = [mesh for mesh in world.meshes if mesh.shape_id == name]
    return np.asarray(np.ptp(mesh.vertices, axis=0))


# ---------------------------------------------------------------- URDF


def test_a_chain_of_two_joints_is_where_its_closed_form_says(tmp_path: Path) -> None:
    make_urdf(tmp_path)
    turn, slide = 0.7, 0.4
    world = imported_world(tmp_path / "crane.urdf", joints={"shoulder": turn, "slide": slide})
    along = np.array([np.cos(turn), np.sin(turn), 0])
    np.testing.assert_allclose(middle_of(world, "arm"), 0.5 * along + (0, 0, 1), atol=1e-3)
    out = np.array([np.cos(turn + 0.5), np.sin(turn + 0.5), 0])  # the slide's own axes are turned by 0.5 rad
    np.testing.assert_allclose(middle_of(world, "hand"), along + slide * out + (0, 0, 1), atol=1e-9)
    still = imported_world(tmp_path / "crane.urdf")
    np.testing.assert_allclose(middle_of(still, "hand"), (1, 0, 1), atol=1e-9)
    np.testing.assert_allclose(edges_of(still, "base"), (1, 2, 0.5))


def test_a_scaled_mesh_a_colour_and_a_mimic_are_read(tmp_path: Path) -> None:
    make_urdf(tmp_path)
    world = imported_world(tmp_path / "crane.urdf", reflectivity="red", joints={"shoulder": 1.0})
    meshes = {mesh.shape_id: mesh for mesh in world.meshes}
    assert set(meshes) == {"base", "arm", "hand", "twin"}
    assert np.all(meshes["base"].reflectivity == 1)  # orange has red 1
    assert np.all(meshes["arm"].reflectivity == 0.5)  # no colour
    ball = meshes["hand"].vertices - meshes["hand"].vertices.mean(axis=0)
    out = np.array([np.cos(1.5), np.sin(1.5), 0])
    assert np.ptp(ball @ out) == pytest.approx(2.0, rel=1e-6)  # twice as long along its own x
    assert {int(mesh.object_id[0]) for mesh in world.meshes if mesh.object_id is not None} == {1, 2, 3, 4}
    with pytest.raises(MitsonarError, match="no joint 'elbow' that moves"):
        imported_world(tmp_path / "crane.urdf", joints={"elbow": 1})
    with pytest.raises(MitsonarError, match=r"must lie in -2..2 \[rad, m\]: got 3"):
        imported_world(tmp_path / "crane.urdf", joints={"shoulder": 3})
    with pytest.raises(MitsonarError, match="finite number"):
        imported_world(tmp_path / "crane.urdf", joints={"shoulder": np.nan})


def test_a_colour_that_a_link_defines_holds_for_links_that_name_it(tmp_path: Path) -> None:
    """As in ROS: without a material of the robot, the first visual that gives its colour defines it."""
    links = "".join(
        f'<link name="{name}"><visual><geometry><box size="1 1 1"/></geometry><material name="white">{colour}</material>'
        "</visual></link>"
        for name, colour in (("a", ""), ("b", '<color rgba="1 1 1 1"/>'), ("c", '<color rgba="0 0 0 1"/>'))
    )
    joints = "".join(
        f'<joint name="{name}" type="fixed"><parent link="a"/><child link="{name}"/></joint>' for name in ("b", "c")
    )
    (tmp_path / "white.urdf").write_text(f'<robot name="r">{links}{joints}</robot>')
    for mesh, reflectivity in zip(imported_world(tmp_path / "white.urdf").meshes, (1, 1, 0), strict=True):
        assert mesh.reflectivity == pytest.approx(reflectivity)


def test_degrees_in_place_of_radians_are_told(tmp_path: Path) -> None:
    box = '<visual><geometry><box size="1 1 1"/></geometry></visual>'
    joint = '<joint name="hinge" type="continuous"><parent link="a"/><child link="b"/><origin rpy="0 90 0"/></joint>'
    (tmp_path / "arm.urdf").write_text(f'<robot><link name="a">{box}</link><link name="b">{box}</link>{joint}</robot>')
    with pytest.warns(MitsonarWarning, match=r"rpy is in radians, but 90 is more than a turn"):
        imported_world(tmp_path / "arm.urdf")
    with (
        pytest.warns(MitsonarWarning, match=r"rpy"),
        pytest.warns(MitsonarWarning, match=r"joint hinge is in radians, but 45"),
    ):
        imported_world(tmp_path / "arm.urdf", joints={"hinge": 45})


def test_a_model_without_joints_says_so(tmp_path: Path) -> None:
    box = "<visual name='v'><geometry><box><size>1 1 1</size></box></geometry></visual>"
    (tmp_path / "box.sdf").write_text(f"<sdf version='1.7'><model name='m'><link name='l'>{box}</link></model></sdf>")
    with pytest.raises(MitsonarError, match="no joint 'q' that moves: it has none"):
        imported_world(tmp_path / "box.sdf", joints={"q": 1})


def test_collision_shapes_are_read_in_place_of_visual_ones(tmp_path: Path) -> None:
    make_urdf(tmp_path)
    world = imported_world(tmp_path / "crane.urdf", collision=True)
    assert [mesh.shape_id for mesh in world.meshes] == ["base"]
    np.testing.assert_allclose(edges_of(world, "base"), (3, 3, 3))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("<robot", '<!DOCTYPE r [<!ENTITY a "b">]><robot'), "document type"),
        (('child link="hand"', 'child link="arm"'), "child of two joints"),
        (('parent link="base"/><child link="arm"', 'parent link="hand"/><child link="arm"'), "form a circle"),
        (("0 0 1", "0 0 nan"), "3 finite numbers"),
        (("0 0 1", "0 0 1e300"), "3 finite numbers"),
        (("package://crane/ball.stl", "../../etc/passwd"), "not within"),
        (("package://crane/ball.stl", "/etc/passwd"), "not within"),
        (("package://crane/ball.stl", "package://crane/../../../etc/passwd"), "not within"),
        (("package://crane/ball.stl", "https://models.org/ball.stl"), "nothing is downloaded"),
        (('radius="0.1" length="1"', 'radius="-0.1" length="1"'), "sizes of 1e-6 to 1e6 m"),
        (('joint="shoulder" multi', 'joint="follower" multi'), "mimic each other in a circle"),
        (('axis xyz="0 0 2"', 'axis xyz="0 0 0"'), "its axis has length 0"),
        (('link name="twin"', 'link name="hand"'), "this link is used twice"),
        (("</robot>", ""), "not a (valid )?URDF file"),
        (("<robot", "<sdf"), "not a (valid )?URDF file"),
    ],
)
def test_damaged_and_harmful_urdf_is_refused_in_one_sentence(change: tuple[str, str], reason: str, tmp_path: Path) -> None:
    make_urdf(tmp_path)
    assert change[0] in URDF
    (tmp_path / "crane.urdf").write_text(URDF.replace(*change))
    with pytest.raises(MitsonarError, match=reason) as error:
        imported_world(tmp_path / "crane.urdf", joints={"shoulder": 0.5})
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500


def test_links_of_a_long_name_and_of_strange_letters_become_ids(tmp_path: Path) -> None:
    name = "a &lt;$x&gt; &quot;../../b&quot;" + "c" * 500
    (tmp_path / "one.urdf").write_text(
        f'<robot name="r"><link name="{name}"><visual><geometry><sphere radius="1"/></geometry></visual></link></robot>'
    )
    scene = load_scene(imported_world(tmp_path / "one.urdf").write(tmp_path / "w"))
    (shape,) = scene.shapes()
    assert shape.id().startswith("a___x__")
    assert len(shape.id()) == 200
    assert len(list((tmp_path / "w" / "meshes").iterdir())) == 1


# ---------------------------------------------------------------- SDF


def test_frames_models_and_includes_are_placed_in_closed_form(tmp_path: Path) -> None:
    make_sdf(tmp_path)
    world = imported_world(tmp_path / "harbour.sdf")
    assert [mesh.shape_id for mesh in world.meshes] == ["pier::wall", "pier::door", "pier::lamp::bulb", "red::hull"]
    # the quay is turned by 90 deg about z: its x is north, its y west
    np.testing.assert_allclose(middle_of(world, "pier::wall"), (10, 2, 1), atol=1e-9)
    np.testing.assert_allclose(edges_of(world, "pier::wall"), (1, 4, 2), atol=1e-9)
    np.testing.assert_allclose(middle_of(world, "pier::door"), (10, 4.5, 0), atol=1e-9)
    np.testing.assert_allclose(middle_of(world, "pier::lamp::bulb"), (9, 2, 3), atol=1e-6)  # 90 deg further: x is west
    np.testing.assert_allclose(middle_of(world, "red::hull"), (0, -5, 2), atol=1e-6)  # its foot, 2 m below, is at the pose
    opened = imported_world(tmp_path / "harbour.sdf", joints={"hinge": np.pi / 2})
    np.testing.assert_allclose(middle_of(opened, "pier::door"), (9.5, 4, 0), atol=1e-9)
    scoped = imported_world(tmp_path / "harbour.sdf", joints={"pier::hinge": np.pi / 2})
    np.testing.assert_array_equal(middle_of(scoped, "pier::door"), middle_of(opened, "pier::door"))


def test_a_joint_to_a_link_of_a_nested_model_moves_that_model(tmp_path: Path) -> None:
    """A quarter turn about the base, 2 m away, of the arm and of what it carries."""
    shape = '<visual name="v"><geometry><box><size>1 1 1</size></box></geometry></visual>'
    hand = f'<model name="hand"><pose>1 0 0 0 0 0</pose><link name="palm">{shape}</link></model>'
    (tmp_path / "rov.sdf").write_text(
        f'<sdf version="1.9"><model name="rov"><link name="base">{shape}</link>'
        f'<model name="arm"><pose>2 0 0 0 0 0</pose><link name="bar">{shape}</link>{hand}</model>'
        '<joint name="elbow" type="revolute"><pose relative_to="base"/><parent>base</parent><child>arm::bar</child>'
        "<axis><xyz>0 0 1</xyz></axis></joint></model></sdf>"
    )
    for angle, bar, palm in ((0.0, (2, 0, 0), (3, 0, 0)), (np.pi / 2, (0, 2, 0), (0, 3, 0))):
        world = imported_world(tmp_path / "rov.sdf", joints={"elbow": angle})
        np.testing.assert_allclose(middle_of(world, "rov::arm::bar"), bar, atol=1e-9)
        np.testing.assert_allclose(middle_of(world, "rov::arm::hand::palm"), palm, atol=1e-9)


def test_what_a_harbour_cannot_hold_is_left_out_with_a_warning(tmp_path: Path) -> None:
    make_sdf(tmp_path)
    swapped = SDF.replace("<sphere><radius>0.2</radius></sphere>", "<heightmap><uri>a.png</uri></heightmap>")
    (tmp_path / "harbour.sdf").write_text(swapped)
    with pytest.warns(MitsonarWarning, match="left out: 1 heightmap"):
        world = imported_world(tmp_path / "harbour.sdf")
    assert len(world.meshes) == 3


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (('relative_to="quay"', 'relative_to="nowhere"'), "names the frame 'nowhere'"),
        (('attached_to="bulb"', 'attached_to="knob"'), "relative to itself"),
        (("<uri>model://buoy</uri>", "<uri>model://../harbour.sdf</uri>"), "not within|includes itself"),
        (("<uri>model://buoy</uri>", "<uri>harbour.sdf</uri>"), "includes itself"),
        (("<uri>model://buoy</uri>", "<uri>https://fuel.org/buoy</uri>"), "nothing is downloaded"),
        (("10 0 0 0 0 1.57", "10 0 0 0 inf 1.57"), "6 finite numbers"),
        (("<name>red</name>", "<name>pier</name>"), "given twice"),
        (("<child>door</child>", "<child>gate</child>"), "names the frame 'gate'"),
        (("<parent>wall</parent>", "<parent>door</parent>"), "form a circle"),
        (("<radius>0.2</radius>", "<radius>nan</radius>"), "1 finite numbers"),
        (('<sdf version="1.9">', '<!DOCTYPE s SYSTEM "/etc/passwd"><sdf version="1.9">'), "document type"),
    ],
)
def test_damaged_and_harmful_sdf_is_refused_in_one_sentence(change: tuple[str, str], reason: str, tmp_path: Path) -> None:
    make_sdf(tmp_path)
    assert change[0] in SDF
    (tmp_path / "harbour.sdf").write_text(SDF.replace(*change))
    with pytest.raises(MitsonarError, match=reason) as error:
        imported_world(tmp_path / "harbour.sdf", joints={"hinge": 1.0})
    assert "\n" not in str(error.value)


@pytest.mark.posix
def test_includes_in_a_circle_and_links_out_of_the_folder_are_refused(tmp_path: Path) -> None:
    make_sdf(tmp_path)
    circle = BUOY.replace('<link name="hull">', '<include><uri>model://buoy</uri></include><link name="hull">')
    (tmp_path / "buoy" / "buoy.sdf").write_text(circle)
    with pytest.raises(MitsonarError, match="includes itself"):
        imported_world(tmp_path / "harbour.sdf")
    (tmp_path / "buoy" / "buoy.sdf").write_text(BUOY)
    (tmp_path / "buoy" / "ball.stl").unlink()
    (tmp_path / "buoy" / "ball.stl").symlink_to("/etc/passwd")
    with pytest.raises(MitsonarError, match="not within"):
        imported_world(tmp_path / "harbour.sdf")


@pytest.mark.thorough
def test_files_that_include_each_other_many_times_are_refused(tmp_path: Path) -> None:
    for number in range(12):
        inner = "".join(f"<include><uri>{number + 1}.sdf</uri><name>m{k}</name></include>" for k in range(10))
        (tmp_path / f"{number}.sdf").write_text(f'<sdf version="1.9"><model name="m">{inner}</model></sdf>')
    (tmp_path / "12.sdf").write_text('<sdf version="1.9"><model name="m"/></sdf>')
    with pytest.raises(MitsonarError, match=r"more than 10,000 models"):
        imported_world(tmp_path / "0.sdf")


def test_models_elsewhere_need_the_search_path(tmp_path: Path) -> None:
    for folder in ("worlds", "models"):
        (tmp_path / folder).mkdir()
    make_sdf(tmp_path / "worlds")
    (tmp_path / "worlds" / "buoy").rename(tmp_path / "models" / "buoy")
    with pytest.raises(MitsonarError, match="give the folder that contains it by --search"):
        imported_world(tmp_path / "worlds" / "harbour.sdf")
    assert len(imported_world(tmp_path / "worlds" / "harbour.sdf", search=[tmp_path / "models"]).meshes) == 4
    (tmp_path / "models" / "buoy" / "ball.stl").unlink()
    with pytest.raises(MitsonarError, match=r"ball\.stl', there is no such file within") as message:
        imported_world(tmp_path / "worlds" / "harbour.sdf", search=[tmp_path / "models", tmp_path / "models"])
    assert str(message.value).count(str(tmp_path / "models,")) + str(message.value).count(f"{tmp_path / 'models'}:") == 1
    with pytest.raises(MitsonarError, match="there is no folder"):
        imported_world(tmp_path / "worlds" / "harbour.sdf", search=[tmp_path / "none"])


# ---------------------------------------------------------------- what the sonar sees

SONAR = Sonar(
    model="physical",
    frequency_hz=1e6,
    beams=48,
    range_bins=300,
    range_min=1,
    range_max=7,
    azimuth_fov_deg=60,
    elevation_fov_deg=20,
)


def test_the_sonar_sees_a_ball_at_its_range_and_bearing(tmp_path: Path) -> None:
    make_sdf(tmp_path)
    world = imported_world(tmp_path / "harbour.sdf", materials={"pier": "concrete"})
    assert [mesh.material for mesh in world.meshes] == ["concrete"] * 3 + [None]
    scene = load_scene(world.write(tmp_path / "w"))
    pose = Pose(-1, -9, 2)  # the buoy, of radius 0.5 m, is 4 m ahead and 1 m to starboard
    frame = Simulator(scene, SONAR).render([pose]).image[0]
    row, column = np.unravel_index(frame.argmax(), frame.shape)
    away, bearing = np.hypot(4, 1) - 0.5, np.arctan2(1, 4)
    assert SONAR.range_m[row] == pytest.approx(away, abs=0.06)
    assert SONAR.bearing_rad[column] == pytest.approx(bearing, abs=0.06)


def test_a_model_in_its_own_axes_follows_a_trajectory(tmp_path: Path) -> None:
    """The same frame as of the model at its pose in the world, which ROS's convention tells."""
    make_sdf(tmp_path)
    still = load_scene(imported_world(tmp_path / "harbour.sdf").write(tmp_path / "still"))
    loose = load_scene(imported_world(tmp_path / "harbour.sdf", own_axes=["pier"]).write(tmp_path / "loose"))
    assert {shape.id() for shape in loose.shapes()} == {"pier", "red::hull"}
    (tmp_path / "pier.tum").write_text("0 10 2 0 0 0 0.70710678118 0.70710678118\n")
    path = Trajectory.load(tmp_path / "pier.tum", "ros-enu", looks_ahead=False)
    pose = Pose(6, 2, 1, heading=np.pi / 2)
    sonar = SONAR.replace(jitter=False)
    seen = Simulator(still, sonar).film_echoes(pose, 0)
    moved = Simulator(loose, sonar, moving={"pier": path}).film_echoes(pose, 0)
    both = (seen.hit > 0) & (moved.hit > 0)
    assert both.mean() > 0.3
    assert ((seen.hit > 0) == (moved.hit > 0)).mean() > 0.999
    np.testing.assert_allclose(moved.range_m[both], seen.range_m[both], atol=2e-3)


# ---------------------------------------------------------------- the command


def test_the_command_makes_a_scene_and_names_its_shapes(mitsonar: Command, tmp_path: Path) -> None:
    make_urdf(tmp_path)
    options = ("--joint", "shoulder=0.5", "--material", "base=steel", "--seabed-z", "-2", "--own-axes", "hand")
    done = mitsonar("world", "import", tmp_path / "crane.urdf", *options, "-o", tmp_path / "w")
    assert done.returncode == 0, done.stderr
    assert "shapes: hand, base, arm, twin" in done.stdout or "shapes: base, arm, hand, twin" in done.stdout
    scene = load_scene(tmp_path / "w" / "scene.xml")
    assert {shape.id() for shape in scene.shapes()} == {"seabed", "base", "arm", "hand", "twin"}
    out = tmp_path / "w2"
    refused(
        mitsonar("world", "import", tmp_path / "crane.urdf", "--joint", "shoulder", "-o", out), "--joint takes NAME=VALUE"
    )
    refused(mitsonar("world", "import", tmp_path / "crane.urdf", "--joint", "shoulder=x", "-o", out), "a number in rad or m")
    twice = ("--joint", "shoulder=0.1", "--joint", "shoulder=0.2")
    refused(mitsonar("world", "import", tmp_path / "crane.urdf", *twice, "-o", out), "--joint gives shoulder twice")
    refused(mitsonar("world", "import", tmp_path / "crane.urdf", "--material", "base=stel", "-o", out), "did you mean steel")
    refused(mitsonar("world", "import", tmp_path / "crane.urdf", "--material", "bas=steel", "-o", out), "no link", "base")
    refused(mitsonar("world", "import", tmp_path / "crane.urdf", "--reflectivity", "2", "-o", out), "--reflectivity must be")
    (tmp_path / "crane.dae").write_text("<COLLADA/>")
    refused(mitsonar("world", "import", tmp_path / "crane.dae", "-o", out), "cannot read scenes of type .dae")
    refused(mitsonar("world", "import", tmp_path / "none.urdf", "-o", out), "no such file")
    assert not out.exists()
