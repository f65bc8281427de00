"""Images with derivatives: levels of the model physical, and derivatives against differences, scaling and symmetry."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from helpers import Array, MitsubaDict, diffuse, essence, sphere
from scipy.spatial.transform import Rotation

import mitsonar
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose, to_world_matrices
from mitsonar.simulation.simulator import Simulator

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside the window")]

POSE = Pose(0, -3, 2.0, 0.6)
SONAR = Sonar(beams=24, range_min=2.0, range_max=5.5, range_bins=96, gain_exponent=2, jitter=False, rays_per_beam=200)
DENSE = SONAR.replace(rays_per_beam=600, rays_across=24)
WEIGHTS = (np.sin(5 * np.arange(96)[:, None] / 96) + 1) * np.linspace(0.5, 1.5, 24)

PROPERTIES = [
    *(("beam_width_deg", 0.8, 0.02), ("elevation_fov_deg", 12.0, 0.2), ("absorption_db_per_m", 0.4, 0.02)),
    *(("taper_db", 3.0, 0.3), ("sound_speed", 1490.0, 2.0)),
]
"""Properties of the sonar, values and steps of their differences."""


def built(**shapes: MitsubaDict) -> mi.Scene:
    """A tilted plane and other shapes."""
    plane = mi.ScalarTransform4f().rotate([1, 0, 0], 3).scale(20)
    ground = {"type": "rectangle", "to_world": plane, "bsdf": diffuse(0.4)}
    return cast(mi.Scene, mi.load_dict({"type": "scene", "ground": ground, **shapes}, optimize=False))


def solid(folder: Path, name: str, mesh: trimesh.Trimesh) -> MitsubaDict:
    """A mesh of the reflectance 0.8."""
    mesh.export(folder / f"{name}.ply")
    return {"type": "ply", "filename": str(folder / f"{name}.ply"), "face_normals": True, "bsdf": diffuse(0.8)}


def cube(folder: Path, place: tuple[float, ...]) -> MitsubaDict:
    """A cube of 0.24 m, turned."""
    placed = np.eye(4)
    placed[:3, :3] = Rotation.from_rotvec(0.7 * np.array([1, 2, 3]) / np.sqrt(14)).as_matrix()
    placed[:3, 3] = place
    mesh = trimesh.creation.box((0.24,) * 3, placed)
    return solid(folder, "cube", mesh)


def pose_of(*, by: int, change: float = 0.0) -> list[mi.Float]:
    """The pose, one number of which is changed."""
    return [mi.Float(value + change * (number == by)) for number, value in enumerate(POSE)]


def slope(simulator: mitsonar.DifferentiableSimulator, by: int, weights: Array = WEIGHTS, change: float = 0.0) -> float:
    """The derivative of a weighted sum by a number of the pose, which is changed, in forward mode."""
    pose = pose_of(by=by, change=change)
    dr.enable_grad(pose[by])
    levels = simulator.levels(pose)
    dr.forward(pose[by])
    return float((np.array(dr.grad(levels), dtype=float) * weights).sum())


def difference(simulator: mitsonar.DifferentiableSimulator, by: int, step: float) -> float:
    """Its central difference."""
    ends = [(np.array(simulator.levels(pose_of(by=by, change=side)), dtype=float) * WEIGHTS).sum() for side in (step, -step)]
    return float((ends[0] - ends[1]) / (2 * step))


def test_rows_of_to_world() -> None:
    from mitsonar.simulation.attached_levels import to_world

    pose = [1.0, 2.0, 3.0, 0.4, 0.2, -0.7]
    rows = [[float(value[0]) for value in row] for row in to_world([mi.Float(value) for value in pose])]
    np.testing.assert_allclose(rows, to_world_matrices(np.array([pose]))[0, :3], atol=1e-6)


@pytest.mark.parametrize("pattern", [None, "two_way"])
def test_levels_are_those_of_the_simulator(pattern: Any) -> None:
    loaded = built(ball=sphere((0.2, 0.3, 0.1), 0.2, diffuse(0.8)))
    given = {} if pattern is None else {"pattern": pattern, "elevation_pattern": pattern, "frequency_hz": 1.8e6}
    sonar = SONAR.replace(**given, jitter=pattern is not None)
    levels = np.array(mitsonar.DifferentiableSimulator(loaded, sonar).levels(POSE, ping=0))
    truth = next(iter(Simulator(loaded, sonar).pings(POSE))).levels[0]
    np.testing.assert_allclose(levels, truth, rtol=2e-5, atol=2e-6 * truth.max())
    assert (truth > 0).mean() > 0.3


@pytest.mark.parametrize(("by", "step"), [(2, 2e-3), (3, 1e-3)])
def test_on_a_plane_they_are_central_differences(by: int, step: float) -> None:
    simulator = mitsonar.DifferentiableSimulator(built(), SONAR)
    assert slope(simulator, by) == pytest.approx(difference(simulator, by, step), rel=1e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("height", essence([0.35, 0.0], 0.0))
def test_edges_make_them_central_differences(height: float, tmp_path: Path) -> None:
    """A cube above the ground covers it, and one that is cut by the ground moves the line where they meet."""
    loaded = built(cube=cube(tmp_path, (0.2, -0.3, height)))
    whole, alone = (mitsonar.DifferentiableSimulator(loaded, DENSE, edge_points=count) for count in (100_000, 0))
    truth = np.array([difference(alone, by, 0.01) for by in range(3)])
    size = np.linalg.norm(truth)
    assert np.linalg.norm([slope(whole, by) for by in range(3)] - truth) < 0.02 * size
    assert np.linalg.norm([slope(alone, by) for by in range(3)] - truth) > 0.05 * size


def test_a_turn_about_the_vertical_keeps_what_lies_inside(tmp_path: Path) -> None:
    """The level ground looks the same, and the whole cube stays in the fan: contributions of its edges cancel."""
    plane = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(20), "bsdf": diffuse(0.4)}
    scene = {"type": "scene", "ground": plane, "cube": cube(tmp_path, (0.2, -0.3, 0.35))}
    simulator = mitsonar.DifferentiableSimulator(cast(mi.Scene, mi.load_dict(scene, optimize=False)), DENSE)
    even, one_side = np.ones((96, 24)), np.tile(np.arange(24) >= 14, (96, 1))
    assert abs(slope(simulator, 5, even)) < 1e-3 * abs(slope(simulator, 5, one_side.astype(float)))


@pytest.mark.thorough
@pytest.mark.parametrize("shape", essence(["sphere", "cylinder", "disk", "rectangle"], "sphere", rest=pytest.mark.slow))
def test_outlines_of_shapes_that_are_no_meshes(shape: str) -> None:
    """The difference of the ends of a step is the mean of the derivative along it."""
    turned = mi.ScalarTransform4f().translate([0.2, -0.3, 0.35]).rotate([1, 0, 0], 20).scale(0.133)
    loaded = built(shape={"type": shape, "to_world": turned, "bsdf": diffuse(0.8)})
    sonar = DENSE.replace(jitter=True)
    whole, alone = (mitsonar.DifferentiableSimulator(loaded, sonar, edge_points=count) for count in (50_000, 0))
    truth = np.array([difference(alone, by, 0.02) for by in range(3)])
    slopes = [np.mean([slope(whole, by, change=change) for change in (-0.01, 0.01)]) for by in range(3)]
    assert np.linalg.norm(slopes - truth) < 0.01 * np.linalg.norm(truth)


def test_a_sphere_in_the_water_is_the_closed_form() -> None:
    """Its levels are an integral over the angle from its middle, whose derivative by the distance is known.

    What moves sideways cancels out of it, 25 times as much.
    """
    centre, radius, weight = np.array([0.2, -0.3, 0.35]), 0.133, np.sin(5 * np.arange(96) / 96) + 1
    ball = sphere(tuple(centre), radius, diffuse(0.8))
    loaded = cast(mi.Scene, mi.load_dict({"type": "scene", "ball": ball}, optimize=False))
    simulator = mitsonar.DifferentiableSimulator(loaded, DENSE.replace(jitter=True))

    def total(distance: float) -> float:
        share = (np.arange(400_000) + 0.5) / 400_000
        angle = np.arcsin(radius / distance) * (1 - share**2)  # dense at the outline
        cosine = np.sqrt(1 - np.square(distance / radius * np.sin(angle)))
        bins = (distance * np.cos(angle) - radius * cosine - DENSE.range_min) / DENSE.bin_m
        each = weight[bins.astype(int)] * cosine * np.sin(angle) * share
        return float(0.8 * 2 * np.pi * 2 * np.arcsin(radius / distance) * each.mean())

    away = np.array(POSE[:3]) - centre
    distance = float(np.linalg.norm(away))
    truth = (total(distance + 0.002) - total(distance - 0.002)) / 0.004
    slopes = np.array([slope(simulator, by, np.repeat(weight[:, None], 24, axis=1)) for by in range(3)])
    assert np.linalg.norm(slopes - truth * away / distance) < 0.03 * abs(truth)


def test_by_vertices_and_reflectance(tmp_path: Path) -> None:
    """The level is proportional to the reflectance; lifting all vertices is sinking the sonar."""
    facets = trimesh.Trimesh([[-30, -30, 0], [30, -30, 0], [0, 60, 0]], [[0, 1, 2]])
    loaded = cast(mi.Scene, mi.load_dict({"type": "scene", "ground": solid(tmp_path, "ground", facets)}, optimize=False))
    simulator, params = mitsonar.DifferentiableSimulator(loaded, SONAR), mi.traverse(loaded)
    keys = [key for key, _ in params if key.endswith(("vertex_positions", "reflectance.value"))]
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    levels = dr.sum(simulator.levels(POSE) * mi.TensorXf(WEIGHTS.astype(np.float32)))
    dr.backward(levels)
    by = {key.rsplit(".", 1)[-1]: np.array(dr.grad(params[key])) for key in keys}
    assert by["value"].sum() == pytest.approx(float(levels.array[0]) / 0.8, rel=1e-4)
    for key in keys:
        dr.disable_grad(params[key])
    params.update()
    assert by["vertex_positions"].reshape(-1, 3)[:, 2].sum() == pytest.approx(-slope(simulator, 2), rel=1e-3)


@pytest.mark.parametrize(
    ("name", "value", "step"),
    essence(PROPERTIES, PROPERTIES[0]),
)
def test_by_properties_of_the_instrument(name: str, value: float, step: float) -> None:
    sonar = SONAR.replace(pattern="two_way", elevation_pattern="two_way", frequency_hz=1.8e6, rays_per_beam=1500)
    simulator = mitsonar.DifferentiableSimulator(built(ball=sphere((0.2, 0.3, 0.1), 0.2, diffuse(0.8))), sonar)

    def total(number: Any) -> mi.TensorXf:
        return simulator.levels(POSE, **{name: number}) * mi.TensorXf(WEIGHTS.astype(np.float32))

    number = mi.Float(value)
    dr.enable_grad(number)
    dr.backward(dr.sum(total(number)))
    ends = [np.array(total(value + side), dtype=float).sum() for side in (step, -step)]
    rough = 0.05 * ends[0] / value if name == "sound_speed" else 0  # few rays pass from bin to bin at a time
    assert float(dr.grad(number)[0]) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-3, abs=rough)


def test_properties_of_the_sonar_itself_change_nothing() -> None:
    """Levels with the sonar's own numbers are those without, and those of the simulator with other numbers."""
    sonar = SONAR.replace(pattern="two_way", elevation_pattern="two_way", frequency_hz=1.8e6, absorption_db_per_m=0.5)
    loaded = built()
    simulator = mitsonar.DifferentiableSimulator(loaded, sonar)
    plain = np.array(simulator.levels(POSE))
    same = simulator.levels(POSE, beam_width_deg=np.degrees(sonar.beam_width_rad), absorption_db_per_m=0.5, taper_db=0,
                            elevation_fov_deg=sonar.elevation_fov_deg, sound_speed=sonar.sound_speed)  # fmt: skip
    np.testing.assert_allclose(np.array(same), plain, rtol=1e-5, atol=1e-6 * plain.max())
    other = mitsonar.DifferentiableSimulator(loaded, sonar.replace(absorption_db_per_m=0.8))
    changed = np.array(simulator.levels(POSE, absorption_db_per_m=0.8))
    np.testing.assert_allclose(changed, np.array(other.levels(POSE)), rtol=1e-4, atol=1e-6 * plain.max())


def test_beams_have_their_width_without_a_pattern_over_elevation() -> None:
    sonar = SONAR.replace(pattern="two_way", elevation_pattern="box")
    loaded, width = built(), 1.5 * float(np.degrees(sonar.beam_width_rad))
    levels = np.array(mitsonar.DifferentiableSimulator(loaded, sonar).levels(POSE, beam_width_deg=width))
    other = np.array(mitsonar.DifferentiableSimulator(loaded, sonar.replace(beam_width_deg=width)).levels(POSE))
    assert levels.sum() == pytest.approx(other.sum(), rel=0.01)


@pytest.mark.parametrize("exponent", [0, 2])
def test_another_sound_speed_moves_echoes_and_their_gain(exponent: int) -> None:
    """A small ball at 3.4 m appears where sound of 1500 m/s would come from, with the gain of that range."""
    scene = {"type": "scene", "ball": sphere((0, 0.0, 0.0), 0.05, diffuse(0.8))}
    sonar = SONAR.replace(gain_exponent=exponent)
    simulator = mitsonar.DifferentiableSimulator(cast(mi.Scene, mi.load_dict(scene)), sonar)
    plain, slow = (np.array(simulator.levels(POSE, sound_speed=c), dtype=float).sum(axis=1) for c in (1500, 1350))
    place = [(one * sonar.range_m).sum() / one.sum() for one in (plain, slow)]
    assert place[1] / place[0] == pytest.approx(1500 / 1350, rel=1e-3)
    assert slow.sum() / plain.sum() == pytest.approx((1500 / 1350) ** exponent, rel=1e-3)


def test_shapes_without_edges() -> None:
    """Instances have none, and other shapes without an outline are refused unless edges are left out."""
    group = {"type": "shapegroup", "ball": sphere((0.2, 0.3, 0.1), 0.2, diffuse(0.8))}
    scene = {"type": "scene", "group": group, "one": {"type": "instance", "of": {"type": "ref", "id": "group"}}}
    simulator = mitsonar.DifferentiableSimulator(cast(mi.Scene, mi.load_dict(scene, optimize=False)), SONAR)
    assert np.isfinite(slope(simulator, 2))
    grid = mi.TensorXf(np.linspace(-0.5, 0.5, 64, dtype=np.float32).reshape(4, 4, 4, 1))
    other = cast(mi.Scene, mi.load_dict({"type": "scene", "lump": {"type": "sdfgrid", "grid": grid}}))
    with pytest.raises(MitsonarError, match=r"shape lump is of a kind without outlines: got SDFGrid; .* edge_points=0"):
        mitsonar.DifferentiableSimulator(other, SONAR)
    mitsonar.DifferentiableSimulator(other, SONAR, edge_points=0)


def test_in_torch() -> None:
    torch = pytest.importorskip("torch")
    simulator = mitsonar.DifferentiableSimulator(built(), SONAR)
    render = simulator.as_torch("pose", "ground.bsdf.reflectance.value", "taper_db")
    pose = torch.tensor(list(POSE), dtype=torch.float32, requires_grad=True)
    reflectance, taper = (torch.tensor([value], requires_grad=True) for value in (0.4, 0.0))
    (render(pose, reflectance, taper) * torch.tensor(WEIGHTS, dtype=torch.float32)).sum().backward()
    assert pose.grad is not None
    assert reflectance.grad is not None
    assert float(pose.grad[2]) == pytest.approx(slope(simulator, 2), rel=1e-4)
    plain = (np.array(simulator.levels(POSE)) * WEIGHTS).sum()
    assert float(reflectance.grad[0]) == pytest.approx(plain / 0.4, rel=1e-4)
    with pytest.raises(MitsonarError, match="unknown parameter 'height'"):
        simulator.as_torch("height")
    with pytest.raises(MitsonarError, match="got a tensor of 12"):
        simulator.as_torch("pose")(torch.zeros(2, 6))


def test_what_it_cannot_do_is_refused() -> None:
    loaded = built()
    with pytest.raises(MitsonarError, match="the scene has no imaging_sonar"):
        mitsonar.DifferentiableSimulator(loaded)
    with pytest.raises(MitsonarError, match="got model coherent"):
        mitsonar.DifferentiableSimulator(loaded, SONAR.replace(model="coherent", frequency_hz=1e6))
    simulator = mitsonar.DifferentiableSimulator(loaded, SONAR)
    with pytest.raises(MitsonarError, match=r"six numbers .* got none"):
        simulator.levels()
    with pytest.raises(MitsonarError, match=r"six numbers .* got 5"):
        simulator.levels([0.0] * 5)
    with pytest.raises(MitsonarError, match="unknown property 'beam_width'"):
        simulator.levels(POSE, beam_width=1)
    for name in ("beam_width_deg", "absorption_db_per_m"):
        with pytest.raises(MitsonarError, match=f"{name} needs a beam pattern"):
            simulator.levels(POSE, **{name: 1})
    across = mitsonar.DifferentiableSimulator(loaded, SONAR.replace(pattern="two_way", elevation_pattern="box"))
    upright = mitsonar.DifferentiableSimulator(loaded, SONAR.replace(pattern="box", elevation_pattern="two_way"))
    for one, name in ((across, "elevation_fov_deg"), (upright, "beam_width_deg"), (upright, "absorption_db_per_m")):
        with pytest.raises(MitsonarError, match=f"{name} needs a beam pattern"):
            one.levels(POSE, **{name: 1})
    for value in (0.0, -1500.0, float("nan"), [1.0, 2.0]):
        with pytest.raises(MitsonarError, match="sound_speed must be one number of at least 1"):
            simulator.levels(POSE, sound_speed=value)
    with pytest.raises(MitsonarError, match="applies absorption only with a beam pattern"):
        mitsonar.DifferentiableSimulator(loaded, SONAR.replace(absorption_db_per_m=0.3))
