"""corrnet: its geometry against the exact one, its parts against closed forms, and motions that it must give back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from numpy.typing import NDArray

from mitsonar.datasets.samples import NODES, ground_at
from mitsonar.errors import MitsonarError
from mitsonar.geometry.ground import GroundGeometry, moved
from mitsonar.instruments.sonar import Bearing
from mitsonar.motion.composition import Motion, compose, inverse
from mitsonar.motion.pose import Pose
from mitsonar.networks import create_network

if TYPE_CHECKING:
    from torch import Tensor

torch = pytest.importorskip("torch")
corrnet = pytest.importorskip("mitsonar.networks.corrnet")
warp_grid = pytest.importorskip("mitsonar.networks.corrnet")
matching = pytest.importorskip("mitsonar.networks.corrnet")
slopes = pytest.importorskip("mitsonar.networks.corrnet")
head = pytest.importorskip("mitsonar.networks.corrnet")
augment = pytest.importorskip("mitsonar.training.step")

pytestmark = pytest.mark.learn

RANGE = 3.2 + (np.arange(256) + 0.5) * 2.4 / 256
BEARING = (np.arange(48) - 23.5) * np.radians(29) / 48
STAND = {"height_m": 2.5, "pitch_rad": np.radians(35), "roll_rad": 0.02}
MOTION = np.array([0.02, -0.012, np.radians(0.45)])


def batch(bearing: Bearing = "azimuth", scale: float = 1.0, count: int = 1) -> dict[str, Tensor]:
    """Geometry of the sonar of these tests, the whole scene scaled."""
    stand = STAND | {"height_m": scale * STAND["height_m"]}
    table = ground_at(scale * RANGE, BEARING, bearing, **stand)
    return {name: torch.from_numpy(np.stack([values] * count)) for name, values in table.items()}


def texture(points: NDArray[np.float64], seed: int = 3) -> NDArray[np.float64]:
    """A floor of waves of 6 to 60 cm; smooth, so that frames hold no aliases."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(size=(60, 2)), rng.uniform(0, 2 * np.pi, 60)
    waves *= (2 * np.pi / rng.uniform(0.06, 0.6, 60) / np.linalg.norm(waves, axis=1))[:, None]
    return np.asarray(0.5 + 0.05 * np.cos(points @ waves.T + phases).sum(axis=-1))


def seen_pair(motion: NDArray[np.float64], noise: float = 0.0, bearing: Bearing = "azimuth") -> Tensor:
    """Two frames of that floor, before and after a motion ``(1, 2, bins, beams)``."""
    ground = GroundGeometry(RANGE, BEARING, bearing, STAND["height_m"], STAND["pitch_rad"], STAND["roll_rad"])
    # what lies at a place for the moved sonar lay elsewhere for the first
    there = moved(ground.points, inverse(motion))
    images = np.stack([texture(ground.points), texture(there)])
    images += noise * np.random.default_rng(1).normal(size=images.shape)
    pair: Tensor = torch.from_numpy(np.clip(images, 0, 1)[None].astype(np.float32))
    return pair


# ---------------------------------------------------------------- geometry


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_displacements_are_those_of_the_exact_geometry(bearing: Bearing) -> None:
    ground = batch(bearing)
    result = warp_grid.displacement(ground, torch.tensor(MOTION[None], dtype=torch.float32))[0].numpy()
    nodes = [
        np.interp(np.linspace(0, len(a) - 1, n), np.arange(len(a)), a) for a, n in zip((RANGE, BEARING), NODES, strict=True)
    ]
    exact = GroundGeometry(nodes[0], nodes[1], bearing, STAND["height_m"], STAND["pitch_rad"], STAND["roll_rad"])
    radius, angle = exact.to_polar(moved(exact.points, MOTION))
    bins = (radius - nodes[0][:, None]) / (RANGE[1] - RANGE[0])
    beams = (angle - nodes[1]) / (BEARING[1] - BEARING[0])
    assert np.abs(bins).max() > 1
    assert np.abs(beams).max() > 1
    assert result[0] == pytest.approx(bins, abs=2e-3)
    assert result[1] == pytest.approx(beams, abs=2e-3)


def test_cells_have_the_geometry_of_their_middles() -> None:
    ground, size = batch(), (len(RANGE), len(BEARING))
    unit = corrnet._units(ground)
    cells = warp_grid.WarpGrid(ground, unit, (8, 1), size, (size[0] // 8, size[1]), None)
    motion = torch.tensor(MOTION[None], dtype=torch.float32) / unit
    shift = cells._shift(motion)[0].numpy()
    middle = RANGE.reshape(-1, 8).mean(axis=1)
    exact = GroundGeometry(middle, BEARING, "azimuth", STAND["height_m"], STAND["pitch_rad"], STAND["roll_rad"])
    radius, angle = exact.to_polar(moved(exact.points, MOTION))
    assert shift[0] == pytest.approx((radius - middle[:, None]) / (8 * (RANGE[1] - RANGE[0])), abs=1e-3)
    assert shift[1] == pytest.approx((angle - BEARING) / (BEARING[1] - BEARING[0]), abs=3e-3)
    linear = (cells.derivative[0] * motion[0, :, None, None, None]).sum(dim=0).numpy()
    assert linear == pytest.approx(shift, abs=float(0.02 * np.abs(shift).max()))


def test_weights_of_nodes_draw_straight_lines_exactly() -> None:
    weights = warp_grid._from_nodes(17, 512, 8, 64, torch.device("cpu")).numpy()
    assert weights.sum(axis=1) == pytest.approx(np.ones(64))
    assert weights @ np.linspace(0, 511, 17) == pytest.approx(np.arange(64) * 8 + 3.5, abs=1e-4)


def test_relief_moves_as_lower_height_does() -> None:
    ground = batch()
    lower = ground_at(RANGE, BEARING, "azimuth", **(STAND | {"height_m": 0.97 * STAND["height_m"]}))["derivative"]
    result = ground["derivative"][0].numpy() + 0.03 * ground["by_relief"][0].numpy()
    before = np.abs(ground["derivative"][0].numpy() - lower).max(axis=(2, 3))
    assert (np.abs(result - lower).max(axis=(2, 3)) <= 0.15 * before + 1e-3).all()


# ---------------------------------------------------------------- parts


def test_the_derivative_of_correlations_is_torchs() -> None:
    torch.manual_seed(0)
    one = torch.rand(2, 3, 4, 5, dtype=torch.float64, requires_grad=True)
    wide = torch.rand(2, 3, 6, 9, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(matching._Correlations.apply, (one, wide))
    weight = torch.rand(2, 15, 4, 5, dtype=torch.float64)
    local = torch.autograd.grad((matching._Correlations.apply(one, wide) * weight).sum(), (one, wide))
    second = torch.autograd.grad((matching._correlations(one, wide) * weight).sum(), (one, wide))
    for a, b in zip(local, second, strict=True):
        assert torch.allclose(a, b)


@pytest.mark.parametrize("axis", [2, 3])
def test_slopes_of_quartics_are_exact(axis: int) -> None:
    x = torch.arange(-6, 7, dtype=torch.float64)
    frame = (0.3 * x**4 - x**3 + 2 * x).expand(1, 1, 5, 13)
    expected = 1.2 * x**3 - 3 * x**2 + 2
    if axis == 2:
        frame = frame.mT
    result = slopes._slope(frame.contiguous(), axis)
    assert torch.allclose(result.movedim(axis, -1)[0, 0, :, 2:-2], expected[2:-2])


def test_what_lies_between_cells_keeps_its_fineness() -> None:
    """Waves of three cells: drawn at any place they keep 80 % or more; from cells alone up to a half would be lost."""
    layers, rows, columns = slopes.Slopes(1, 4), 40, 40
    row, column = np.mgrid[:rows, :columns]

    def wave(r: NDArray[np.float64], c: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.cos(2 * np.pi * r / 3) + np.sin(2 * np.pi * c / 3)

    frame = torch.tensor(wave(row, column), dtype=torch.float32)[None, None]
    with torch.no_grad():
        finer = layers.prepared(frame, frame)[1]
    assert finer.shape == (1, 1, 2 * rows - 1, 2 * columns - 1)
    inner = slice(6, -6)
    for shift in (0.25, 0.5, 0.8):
        places = [(index + shift) / (size - 1) * 2 - 1 for index, size in ((column, columns), (row, rows))]
        grid = torch.tensor(np.stack(places, axis=-1), dtype=torch.float32)[None]
        expected = wave(row + shift, column + shift)[inner, inner]
        for drawn, least, most in ((finer, 0.8, 1.05), (frame, 0.0, 0.75)):
            result = torch.nn.functional.grid_sample(drawn, grid, align_corners=True)[0, 0].numpy()[inner, inner]
            stored = (result * expected).sum() / (expected * expected).sum()
            assert least < stored < most, (shift, stored)


def test_later_iterations_count_more() -> None:
    output = head.GaussianHead(torch.zeros(2, 1, 3), torch.eye(3).expand(2, 1, 3, 3) * 1e-6)
    wrong = output.mean.clone()
    wrong[0] = 1e-3
    early = head.likelihood(head.GaussianHead(wrong, output.covariance), torch.zeros(1, 3))
    late = head.likelihood(head.GaussianHead(wrong.flip(0), output.covariance), torch.zeros(1, 3))
    assert float(late) > float(early) > float(head.likelihood(output, torch.zeros(1, 3)))


# ---------------------------------------------------------------- the network


def test_a_scaled_scene_has_scaled_motions() -> None:
    torch.manual_seed(1)
    network, images = create_network("corrnet").eval(), seen_pair(MOTION)
    with torch.no_grad():
        one, two = network(images, batch()), network(images, batch(scale=2.0))
    size = torch.tensor([2.0, 2.0, 1.0])
    assert torch.allclose(two.mean, one.mean * size, rtol=1e-3, atol=1e-7)
    assert torch.allclose(two.covariance, one.covariance * size[:, None] * size, rtol=1e-2, atol=1e-12)


def test_levels_do_not_matter_and_covariances_are_covariances() -> None:
    torch.manual_seed(1)
    network, images = create_network("corrnet").eval(), seen_pair(MOTION, noise=0.1)
    with torch.no_grad():
        one, second = network(images, batch()), network(0.5 * images, batch())
    assert torch.allclose(one.mean, second.mean, atol=1e-6)
    assert torch.allclose(one.covariance, one.covariance.mT)
    assert (torch.linalg.eigvalsh(one.covariance.double()) > 0).all()


@pytest.mark.thorough
def test_it_learns() -> None:
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    motions = rng.uniform(-1, 1, (4, 3)) * [0.02, 0.02, np.radians(0.45)]
    images = torch.cat([seen_pair(motion, noise=0.1) for motion in motions])
    network, ground, target = create_network("corrnet", finer=1), batch(count=4), torch.tensor(motions, dtype=torch.float32)
    optimiser = torch.optim.AdamW(network.parameters(), lr=5e-4)
    losses = []
    for _ in range(14):
        loss = head.likelihood(network(images, ground), target)
        optimiser.zero_grad()
        loss.backward()
        assert all(weight.grad is not None and torch.isfinite(weight.grad).all() for weight in network.parameters())
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0] - 2, losses


def test_it_learns_after_it_was_asked() -> None:
    """In one process: what an evaluation leaves behind for sizes of its own serves a training."""
    from mitsonar.networks.corrnet import _from_nodes

    _from_nodes.cache_clear()
    network, image, ground = create_network("corrnet", finer=1), seen_pair(np.array([0.01, 0.0, 0.0])), batch()
    with torch.inference_mode():
        network(image, ground)
    head.likelihood(network(image, ground), torch.zeros(1, 3)).backward()


def test_it_stays_below_a_million_parameters() -> None:
    assert sum(weight.numel() for weight in create_network("corrnet").parameters()) < 1_000_000


@pytest.mark.parametrize("shape", [(1, 2, 64, 48), (1, 2, 256, 8), (1, 1, 256, 48), (2, 256, 48)])
def test_images_that_are_too_small_or_no_pairs_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(MitsonarError, match="corrnet takes"):
        create_network("corrnet")(torch.zeros(shape), batch())


@pytest.mark.parametrize("options", [{"width": 0}, {"looks": 0}, {"looks": 1.5}, {"width": "half"}])
def test_options_that_no_network_can_have(options: dict[str, object]) -> None:
    with pytest.raises(MitsonarError, match="corrnet takes"):
        create_network("corrnet", **options)


# ---------------------------------------------------------------- samples changed


def test_a_motion_and_its_inverse_lead_back() -> None:
    start = Pose(1.0, -2.0, 2.5, 0.6, 0.0, 0.7)
    back = compose(compose(start, Motion(*MOTION)), Motion(*inverse(MOTION)))
    assert np.array(back) == pytest.approx(np.array(start), abs=1e-12)
    assert inverse(torch.tensor(MOTION)).numpy() == pytest.approx(inverse(MOTION))


def test_mirrored_samples_are_those_of_a_mirrored_floor() -> None:
    ground = GroundGeometry(RANGE, BEARING, "azimuth", STAND["height_m"], STAND["pitch_rad"])

    def drawn(motion: NDArray[np.float64], port: float) -> NDArray[np.float64]:
        places = (ground.points, moved(ground.points, inverse(motion)))
        return np.stack([texture(points * [port, 1.0]) for points in places])

    torch.manual_seed(0)
    images = torch.tensor(drawn(MOTION, 1.0)).repeat(16, 1, 1, 1)
    (new, _), changed = augment.augmented((images, {}), torch.tensor(MOTION[None]).repeat(16, 1), ["mirror"])
    touched = (changed != torch.tensor(MOTION)).any(dim=1)
    assert 3 <= int(touched.sum()) <= 13
    assert torch.equal(new[~touched], images[~touched])
    assert new[touched][0].numpy() == pytest.approx(drawn(changed[touched][0].numpy(), -1.0), abs=1e-9)


def test_reversed_samples_run_backwards() -> None:
    torch.manual_seed(0)
    images, labels = torch.rand(16, 2, 8, 8), torch.tensor(MOTION[None]).repeat(16, 1)
    (new, _), changed = augment.augmented((images, {}), labels, ["reverse"])
    touched = (changed != labels).any(dim=1)
    assert 3 <= int(touched.sum()) <= 13
    assert torch.equal(new[touched], images[touched].flip(1))
    points = np.random.default_rng(0).normal(size=(5, 2))
    assert moved(moved(points, MOTION), changed[touched][0].numpy()) == pytest.approx(points, abs=1e-12)


def test_strangers_are_few_and_keep_their_first_frame() -> None:
    torch.manual_seed(0)
    images = torch.arange(400.0)[:, None, None, None].expand(400, 2, 16, 16).clone()
    labels = torch.zeros(400, 3)
    (new, _), same = augment.augmented((images, {}), labels, ["strangers"])
    strange = (new[:, 1] != images[:, 1]).flatten(1).any(dim=1)
    assert torch.equal(new[:, 0], images[:, 0])
    assert 5 <= int(strange.sum()) <= 40
    assert torch.equal(same, labels)
