"""Stages of USD: places, units and colours in closed form, and what damaged or harmful ones are told."""

from __future__ import annotations

import importlib.util
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from foreign_scenes import USDA, make_usd
from helpers import run_python
from hostile_readers import Reader, attack, spoil_file
from mutations import changed_bytes, changed_text

from mitsonar.bridges import usd
from mitsonar.bridges.model_import import imported_world
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.simulation.scene import load_scene

pytestmark = pytest.mark.skipif(importlib.util.find_spec("pxr") is None, reason="usd-core is not installed: mitsonar[usd]")


def box_of(path: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner of a shape [m]."""
    (mesh,) = [mesh for mesh in imported_world(path).meshes if mesh.shape_id == name]
    return mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)


def test_prims_are_placed_scaled_and_coloured(tmp_path: Path) -> None:
    make_usd(tmp_path)
    world = imported_world(tmp_path / "stage.usda")
    ball, plate = world.meshes
    assert [ball.shape_id, plate.shape_id] == ["/World/ball", "/World/plate"]
    # centimetres; the world is turned by 90 deg about z: the ball's x of 2 m is north of the world's x of 1 m
    np.testing.assert_allclose(ball.vertices.mean(axis=0), (1, 2, 0), atol=1e-6)
    np.testing.assert_allclose(np.ptp(ball.vertices, axis=0), 1, rtol=1e-3)
    assert ball.reflectivity == pytest.approx(0.25)  # USD's colours are linear
    assert len(plate.faces) == 3
    assert plate.reflectivity == pytest.approx([0.1, 0.1, 0.8])
    np.testing.assert_allclose(plate.vertices[2], (0, 1, 0), atol=1e-6)
    assert {shape.id() for shape in load_scene(world.write(tmp_path / "w")).shapes()} == {"/World/ball", "/World/plate"}


@pytest.mark.thorough
def test_planes_have_the_extent_that_usd_gives_them(tmp_path: Path) -> None:
    """Width and length of a plane lie along other axes for each of its normals."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "planes.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    extents = {}
    for axis in "XYZ":
        plane = UsdGeom.Plane.Define(stage, f"/{axis}")
        plane.CreateWidthAttr(2.0), plane.CreateLengthAttr(6.0), plane.CreateAxisAttr(axis)
        extents[axis] = np.array(UsdGeom.Boundable.ComputeExtentFromPlugins(plane, Usd.TimeCode.Default()))
    stage.GetRootLayer().Save()
    for axis, extent in extents.items():
        np.testing.assert_allclose(box_of(tmp_path / "planes.usda", f"/{axis}"), extent, atol=1e-9)


@pytest.mark.thorough
def test_stages_with_y_up_stand_upright_and_collision_shapes_may_be_hidden(tmp_path: Path) -> None:
    upright = USDA.replace('upAxis = "Z"', 'upAxis = "Y"').replace("rotateZ = 90", "rotateZ = 0")
    (tmp_path / "stage.usda").write_text(upright.replace("(200, 0, 0)", "(200, 100, 0)"))
    low, high = box_of(tmp_path / "stage.usda", "/World/ball")
    np.testing.assert_allclose((low + high) / 2, (3, 0, 1), atol=1e-6)
    (mesh,) = imported_world(tmp_path / "stage.usda", collision=True).meshes
    assert mesh.shape_id == "/World/hidden"
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), 0.02, rtol=1e-6)


def test_modules_beside_a_stage_are_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_usd(tmp_path)
    (tmp_path / "json.py").write_text("open('ran', 'w').close()")
    monkeypatch.chdir(tmp_path)
    assert len(imported_world("stage.usda").meshes) == 2
    assert not Path("ran").exists()


@pytest.mark.thorough
def test_a_prim_in_its_own_axes_holds_what_lies_below_it(tmp_path: Path) -> None:
    make_usd(tmp_path)
    (mesh,) = imported_world(tmp_path / "stage.usda", own_axes=["/World"]).meshes
    assert mesh.shape_id == "/World"
    low = mesh.vertices[mesh.object_id is None or mesh.faces[mesh.object_id == 1].ravel()].mean(axis=0)
    np.testing.assert_allclose(low, (0, 2, 0), atol=1e-3)  # 2 m ahead, along +y


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (('def Xform "World" {', 'def Xform "World" (references = @/etc/passwd@) {'), "outside its folder"),
        (('def Xform "World" {', 'def Xform "World" (references = @../up.usda@) {'), "outside its folder|does not exist"),
        (('def Xform "World" {', 'def Xform "World" (payload = @https://a.org/b.usd@) {'), "only files in its folder"),
        (('upAxis = "Z"', 'upAxis = "Z"\n    subLayers = [@none.usda@]'), "which does not exist"),
        (("[0, 1, 2, 3, 3, 2, 4]", "[0, 1, 2, 3, 3, 2, 9]"), "refers to a point that does not exist"),
        (("[4, 3]", "[4, 4]"), "states 8 corners of faces, but has 7"),
        (("(0, 200, 0)]", "(0, nan, 0)]"), "not finite"),
        (("metersPerUnit = 0.01", "metersPerUnit = -1"), "metersPerUnit must lie"),
        (("double radius = 50", "double radius = -50"), "sizes of 1e-6"),
        (("translate = (100, 0, 0)", "translate = (nan, 0, 0)"), "not finite"),
        (("#usda 1.0", "#udsa 1.0"), "cannot read"),
    ],
)
def test_damaged_and_harmful_stages_are_refused_in_one_sentence(
    change: tuple[str, str], reason: str, tmp_path: Path
) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "up.usda").write_text("#usda 1.0\n")
    assert change[0] in USDA
    (tmp_path / "in" / "stage.usda").write_text(USDA.replace(*change))
    with pytest.raises(MitsonarError, match=reason) as error:
        imported_world(tmp_path / "in" / "stage.usda")
    assert "\n" not in str(error.value)


def test_a_layer_in_a_searched_folder_is_read(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    make_usd(tmp_path)
    text = (
        '#usda 1.0\n(\n    metersPerUnit = 0.01\n    upAxis = "Z"\n)\ndef "a" (references = @../stage.usda@</World>) {\n}\n'
    )
    (tmp_path / "in" / "top.usda").write_text(text)
    world = imported_world(tmp_path / "in" / "top.usda", search=[tmp_path])
    assert [mesh.shape_id for mesh in world.meshes] == ["/a/ball", "/a/plate"]


def test_without_usd_core_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_usd(tmp_path)
    monkeypatch.setattr(usd, "find_spec", lambda name: None)
    with pytest.raises(MitsonarError, match=r"reading USD needs pxr.*mitsonar\[usd\]"):
        imported_world(tmp_path / "stage.usda")


# ---------------------------------------------------------------- mutants


def make_both(folder: Path) -> None:
    """Write the stage as text and as a crate, by a process of its own."""
    make_usd(folder)
    run_python(f"""
        from pxr import Sdf
        layer = Sdf.Layer.FindOrOpen({str(folder / "stage.usda")!r})
        layer.Export({str(folder / "crate.usdc")!r})
    """)


def imported_below(folder: Path, name: str) -> object:
    """Import one of the files of a folder."""
    return imported_world(folder / name)


USD = {
    f"USD, {name}": Reader(make_both, spoil_file(name, how), partial(imported_below, name=name))
    for name, how in (("stage.usda", changed_text), ("crate.usdc", changed_bytes))
}


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")
@pytest.mark.parametrize("name", USD)
def test_mutants_of_stages_are_read_or_refused(name: str, tmp_path: Path) -> None:
    """A stage on which the C++ reader ends is refused as well: it is read in a process of its own."""
    assert sum(attack(name, tmp_path, 8, readers=USD).values()) == 8


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")
@pytest.mark.parametrize("name", USD)
def test_three_hundred_mutants_of_stages(name: str, tmp_path: Path) -> None:
    result = attack(name, tmp_path, 300, first=8, readers=USD)
    assert min(result.values()) > 0


def test_what_is_no_gprim_is_left_out_with_a_warning(tmp_path: Path) -> None:
    curve = '    def BasisCurves "rope" {\n        int[] curveVertexCounts = [4]\n    }\n    def Cube "hidden" ('
    (tmp_path / "stage.usda").write_text(USDA.replace('    def Cube "hidden" (', curve))
    with pytest.warns(MitsonarWarning, match="1 BasisCurves"):
        imported_world(tmp_path / "stage.usda")
