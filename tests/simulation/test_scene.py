"""Scenes from files: parameters, shipped names, the sonar in them, and errors of one sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar, named_sonars
from mitsonar.motion.trajectory import Trajectory
from mitsonar.simulation.scene import (
    find_scene,
    load_scene,
    motion_specs_of,
    scale_notes,
    shipped_scenes,
    shipped_trajectory,
    sonar_in,
)

pytestmark = pytest.mark.usefixtures("variant")

XML = """<scene version="3.0.0">
    <default name="value" value="0.5"/>
    <sensor type="perspective"/>
    <sensor type="imaging_sonar">
        <integer name="beams" value="3"/>
        <transform name="to_world"><lookat origin="1, 2, 3" target="1, 5, 3" up="0, 0, 1"/></transform>
    </sensor>
    <sensor type="imaging_sonar"><integer name="beams" value="4"/></sensor>
    <shape type="sphere"><bsdf type="diffuse"><float name="reflectance" value="$value"/></bsdf></shape>
</scene>"""


def test_load_with_parameters(tmp_path: Path) -> None:
    import mitsuba as mi

    (tmp_path / "mine.xml").write_text(XML)
    for given, value in (({}, 0.5), ({"value": 0.25}, 0.25)):
        scene = load_scene(tmp_path / "mine.xml", **given)
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 5), mi.Vector3f(0, 0, -1)))
        assert np.ravel(np.array(si.bsdf().eval_diffuse_reflectance(si)))[0] == pytest.approx(value)


def test_sonars_are_found_and_cameras_ignored(tmp_path: Path) -> None:
    (tmp_path / "mine.xml").write_text(XML)
    scene = load_scene(tmp_path / "mine.xml")
    first, second = sonar_in(scene), sonar_in(scene, 1)
    assert first is not None
    assert second is not None
    assert (first[0], second[0]) == (Sonar(beams=3), Sonar(beams=4))
    np.testing.assert_allclose(first[1], (1, 2, 3, 0, 0, 0), atol=1e-6)
    assert sonar_in(scene, 2) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (XML.replace("</scene>", ""), r"cannot load scene .*bad\.xml"),
        (XML.replace('"beams" value="3"', '"beams" value="0"'), r"bad\.xml: .*sonar beams: .* got 0"),
        (XML.replace('name="beams"', 'name="beems"'), r"bad\.xml: .*beems"),
        (XML.replace('type="sphere"', 'type="spere"'), r"bad\.xml: .*spere"),
        (XML.replace("diffuse", "cell_noise"), r"bad\.xml"),
        (XML.replace('name="reflectance"', 'name="reflectence"'), r"bad\.xml: .*unreferenced property .*reflectence"),
        ('<shape version="3.0.0" type="sphere"/>', r"bad\.xml holds a \w+, not a scene: wrap it in <scene>"),
        ("", r"cannot load scene .*bad\.xml"),
    ],
    ids=["cut off", "bad value", "slip", "unknown plugin", "wrong place", "slip of a name", "no scene", "empty"],
)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bad.xml").write_text(text)
    with pytest.raises(MitsonarError, match=message) as caught:
        load_scene(tmp_path / "bad.xml")
    assert "\n" not in str(caught.value)


def test_names_that_are_no_scene(tmp_path: Path) -> None:
    with pytest.raises(
        MitsonarError, match=r"no scene file .*absent\.xml: give a Mitsuba XML file or the name of a shipped"
    ):
        load_scene(tmp_path / "absent.xml")
    with pytest.raises(MitsonarError, match="is a folder: give the XML file in it"):
        find_scene(tmp_path)


def test_shipped_scenes_have_a_trajectory_of_their_name() -> None:
    assert shipped_scenes()
    for name, path in shipped_scenes().items():
        assert find_scene(name) == path
        assert len(Trajectory.load_tum(shipped_trajectory(name))) > 1


PATH = '<texture type="trajectory" {}><string name="filename" value="fish.tum"/></texture>'


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        (PATH.format('name="moton"'), 'in sphere fish is given with name="moton", so nothing would move'),
        (PATH.format(""), "is given without a name"),
        ('<ref id="way" name="moton"/>', 'is given with name="moton"'),
        (f'<bsdf type="diffuse">{PATH.format("")}</bsdf>', 'write name="motion", in a shape'),
        (PATH.format('name="motion"'), ""),
        ('<ref id="way" name="motion"/>', ""),
    ],
)
def test_a_trajectory_that_no_shape_reads_is_refused(shape: str, said: str, tmp_path: Path) -> None:
    """Mitsuba leaves textures of any other name out without a word."""
    waits = PATH.format('id="way"') if "<ref" in shape else ""
    file = tmp_path / "tank.xml"
    file.write_text(f'<scene version="3.0.0">{waits}<shape type="sphere" id="fish">{shape}</shape></scene>')
    if said:
        with pytest.raises(MitsonarError, match=said):
            load_scene(file)
    else:
        assert [result.name for result in motion_specs_of(load_scene(file))] == ["fish"]


GLB = b"glTF\x02\x00\x00\x00" + bytes(100)
BINARY_STL = bytes(80) + (2).to_bytes(4, "little") + bytes(100)
COLLADA = b'<?xml version="1.0"?><COLLADA version="1.4.1"/>'


@pytest.mark.parametrize(
    ("kind", "name", "content", "message"),
    [
        (
            "ply",
            "ship.glb",
            GLB,
            r"is in the format glTF, and Mitsuba's shape ply does not read it.*mitsonar world mesh .*ship.glb",
        ),
        ("obj", "ship.gltf", b'{"asset": {"version": "2.0"}}', r"is in the format glTF.*mitsonar world mesh"),
        ("ply", "ship.dae", COLLADA, r"is in the format COLLADA.*mitsonar world mesh"),
        ("obj", "ship.stl", BINARY_STL, r"is in the format STL.*ply, obj and serialized.*mitsonar world mesh"),
        ("glb", "ship.glb", GLB, r"is in the format glTF, and Mitsuba has no shape glb.*mitsonar world mesh"),
        ("obj", "ship.ply", b"ply\nformat ascii 1.0\n", r"is in the format PLY.*name the shape ply"),
        ("ply", "ship.ply", b"ply\nformat ascii 1.0\n", r"is damaged: it has no PLY header; export it again"),
    ],
)
def test_a_model_in_a_format_that_mitsuba_lacks_is_named(
    tmp_path: Path, kind: str, name: str, content: bytes, message: str
) -> None:
    (tmp_path / name).write_bytes(content)
    shape = f'<shape type="{kind}"><string name="filename" value="{name}"/></shape>'
    (tmp_path / "mine.xml").write_text(f'<scene version="3.0.0">{shape}</scene>')
    with pytest.raises(MitsonarError, match=message):
        load_scene(tmp_path / "mine.xml")


def ball(radius: float) -> str:
    return f'<scene version="3.0.0"><shape type="sphere" id="ball"><float name="radius" value="{radius}"/></shape></scene>'


@pytest.mark.parametrize(
    ("radius", "window", "words"),
    [
        (200.0, 10.0, ["shape ball is 400 x 400 x 400 m large", "window of the sonar ends at 10 m", "--scale 0.001"]),
        (200.0, 2300.0, ["the window ends at 2300 m", "--scale 0.001"]),
        (0.0002, 10.0, ["the whole scene is 0.693 mm large", "larger --scale"]),
        (0.019, 10.0, []),  # a sphere for calibration
        (50.0, 10.0, []),
    ],
)
def test_a_scene_in_millimetres_is_noticed(tmp_path: Path, radius: float, window: float, words: list[str]) -> None:
    (tmp_path / "ball.xml").write_text(ball(radius))
    notes = scale_notes(load_scene(tmp_path / "ball.xml"), Sonar(range_min=1.0, range_max=window))
    assert len(notes) == bool(words)
    assert all(word in notes[0] for word in words)


def test_shipped_scenes_and_presets_are_of_their_size() -> None:
    for name in shipped_scenes():
        scene = load_scene(name)
        for sonar in named_sonars():
            assert scale_notes(scene, load_sonar(sonar)) == [], (name, sonar)
