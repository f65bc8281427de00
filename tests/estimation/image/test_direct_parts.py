"""The parts of direct: sums over blocks, displacements and their derivatives, smoothing, margins; the view of phase."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mitsonar.estimation.estimator import two_frames
from mitsonar.estimation.image import direct
from mitsonar.estimation.image.direct import LEVELS, Direct, _resolved, registered_over_relief
from mitsonar.estimation.image.registration import (
    SHADOW_SIDES,
    Cells,
    DirectLevel,
    GroundNodes,
    _inner,
    blurred,
    by_block,
    cell_blocks,
    is_resolved,
    products_by_block,
    shadow_lengths,
    smoothed,
)
from mitsonar.estimation.named import create_estimator
from mitsonar.geometry.ground import Attitude, GroundGeometry, GroundView
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar
from mitsonar.records.frames import SonarFrames

ATTITUDE = Attitude(2.5, 0.05, np.radians(35))


def frames(bins: int = 512, beams: int = 96) -> SonarFrames:
    """Two noisy frames of the same ground, seen from one place."""
    sonar = Sonar(range_bins=bins, beams=beams)
    image = np.random.default_rng(1).random((bins, beams), dtype=np.float32)
    poses = np.tile([0.0, 0.0, 2.5, np.radians(35), 0.0, 0.0], (2, 1))
    return SonarFrames(np.stack([image, image]), sonar.range_m, sonar.bearing_rad, np.arange(2.0), sonar, poses=poses)


@pytest.mark.parametrize("block", [(8, 4), (5, 7), (40, 3), (3, 50)])
def test_products_are_summed_over_blocks(block: tuple[int, int]) -> None:
    """Against plain sums; blocks that are not whole belong to the last, and a block may be larger than the map."""
    one, second = np.random.default_rng(2).normal(size=(2, 30, 19)).astype(np.float32)
    rows, columns = (
        np.minimum(np.arange(size) // edge, count - 1)
        for size, edge, count in zip(one.shape, block, cell_blocks(one.shape, block), strict=True)
    )
    plain = np.zeros(cell_blocks(one.shape, block))
    np.add.at(plain, (rows[:, None], columns), (one * second).astype(float))
    np.testing.assert_allclose(products_by_block([(one, second)], block)[0], plain.ravel(), atol=1e-4)
    np.testing.assert_allclose(by_block(one * second, block), plain.ravel(), atol=1e-4)


@pytest.mark.parametrize("level", LEVELS)
def test_patches_move_as_their_cells_do(level: DirectLevel) -> None:
    """The derivative of patches against the difference of displacements; all levels share the nodes."""
    nodes = GroundNodes(frames(), ATTITUDE, heave=False)
    cells = Cells(nodes, level)
    for k, small in enumerate((1e-3, 1e-3, 1e-4)):
        v = np.zeros(3)
        v[k] = small
        change = (cells.shift(v) - cells.shift(-v)) / (2 * small)
        middle = by_block(change, cells.patch) / by_block(np.ones(change.shape[1:]), cells.patch)
        usable = middle.reshape(2, *cells.patches)[:, -(-cells.usable.start // cells.patch[0]) : -1]
        message = cells.derivative[k].reshape(2, *cells.patches)[:, -usable.shape[1] - 1 : -1]
        assert np.abs(message - usable).max() < 0.05 * np.abs(usable).max()


@pytest.mark.parametrize("shadowed", [False, True])
@pytest.mark.parametrize("back", [False, True])
def test_derivatives_are_differences_of_displacements(back: bool, shadowed: bool) -> None:
    """By motion, and by the height of the ground: that of a sonar which flies lower by as much. Shadows move, too."""
    v, steps = np.array([0.15, -0.1, 0.04]), np.array([2e-3, 2e-3, 5e-4, 0.1])
    lengths = np.zeros((512, 96), np.float32)
    lengths[300:340, 40:50] = np.arange(40)[:, None]
    shadows = (lengths, lengths) if shadowed else None

    def cells(lower_m: float = 0.0) -> Cells:
        lower = replace(ATTITUDE, height_m=ATTITUDE.height_m - lower_m)
        return Cells(GroundNodes(frames(), lower, heave=False), LEVELS[-1], shadows)

    here = cells()
    expected = [
        (here.shift(v + change, back=back) - here.shift(v - change, back=back)) / (2 * small)
        for small, change in zip(steps[:3], np.diag(steps[:3]), strict=True)
    ]
    expected.append((cells(steps[3]).shift(v, back=back) - cells(-steps[3]).shift(v, back=back)) / (2 * steps[3]))
    rows = slice(max(cells(side).usable.start for side in (-steps[3], 0.0)), None)
    for one, other in zip(here.derivatives(v, steps, back=back), expected, strict=True):
        np.testing.assert_allclose(one[:, rows], other[:, rows], atol=2e-4 * np.abs(other[:, rows]).max())


@pytest.mark.parametrize("level", LEVELS)
def test_coarse_rows_are_those_of_the_smoothed_frame(level: DirectLevel) -> None:
    """Only some rows are computed, to the same values."""
    image = frames().image[0]
    whole = blurred(image, *level.smoothing)[level.step // 2 :: level.step]
    np.testing.assert_allclose(smoothed(image, level), whole, atol=1e-5)


def test_margins_do_not_shrink() -> None:
    """Cells that come and go would keep an iteration from settling."""
    margins = np.zeros(2)
    for rows, expected in ((3.2, 5), (0.1, 5), (6.5, 8)):
        inner = _inner(np.full((2, 64, 32), rows, dtype=np.float32), slice(0, None), margins)
        assert inner is not None
        assert inner[0] == slice(expected, 64 - expected)


# ---------------- Shadows


def posts(poses: np.ndarray, place: np.ndarray, height_m: float = 0.4, half_m: float = 0.06) -> SonarFrames:
    """Frames of a textured floor with posts ``(n, 2)``, which face the sonar and cast shadows, by plane geometry."""
    sonar = Sonar(range_bins=512, beams=96)
    ground = GroundGeometry(sonar.range_m, sonar.bearing_rad, sonar.bearing, poses[0, 2], poses[0, 3])
    rng = np.random.default_rng(7)
    wave, phase = rng.normal(0, 50, (60, 2)), rng.uniform(0, 2 * np.pi, 60)
    images = []
    for x, y, z, *_ in poses:
        on_floor = np.nan_to_num(ground.points) + np.array([x, y])
        albedo = 0.5 + 0.4 * np.tanh(np.cos(on_floor @ wave.T + phase).sum(axis=-1) / 6)
        across, ahead = np.nan_to_num(ground.points)[..., 0], np.nan_to_num(ground.points)[..., 1]
        for east, north in place - [x, y]:
            if north > 0.5:
                # the ray to a cell passes the post where it is as far ahead; the shadow ends where the ray over its top does
                hidden = np.abs(across * north / np.maximum(ahead, 0.1) - east) < half_m
                albedo[hidden & (ahead > north) & (ahead < north * z / (z - height_m))] = 0
        images.append(cv2.GaussianBlur(albedo.astype(np.float32), (0, 0), 0.6))
    return SonarFrames(np.stack(images), sonar.range_m, sonar.bearing_rad, np.arange(2.0), sonar, poses=poses)


def test_a_shadow_moves_across_the_beams_as_what_casts_it() -> None:
    """A step aside and a turn before a post: its shadow moves across as its foot does, and turns as the floor does."""
    step_m, turn_rad, ahead_m, pitch = 0.02, 0.01, 2.9, float(np.radians(35))
    frames = posts(np.tile([0.0, 0.0, 2.5, pitch, 0.0, 0.0], (2, 1)), np.array([[0.0, ahead_m]]))
    lengths = shadow_lengths(frames.image[0] ** np.float32(0.25), SHADOW_SIDES)
    cells = Cells(GroundNodes(frames, ATTITUDE, heave=False), LEVELS[-1], (lengths, lengths))
    beam_rad = float(np.diff(frames.bearing_rad).mean())
    x_m = ahead_m * np.array([1.03, 1.08, 1.15])
    rows = np.rint(np.interp(np.hypot(2.5, x_m), frames.range_m, np.arange(512))).astype(int)
    x_m = np.sqrt(frames.range_m[rows] ** 2 - 2.5**2)
    # angles in the axes of a sonar that looks down by its pitch
    foot, floor = (x * np.cos(pitch) + 2.5 * np.sin(pitch) for x in (ahead_m, x_m))
    aside, turned = (cells.shift(np.array(v))[1] * beam_rad for v in ([step_m, 0.0, 0.0], [0.0, 0.0, turn_rad]))
    np.testing.assert_allclose(aside[rows, 47:49].mean(axis=1), -step_m / foot, rtol=0.01)
    np.testing.assert_allclose(aside[rows, 30], aside[rows, 65], rtol=0.01)
    np.testing.assert_allclose(aside[rows, 30:66:35].mean(axis=1), -step_m / floor, rtol=0.02)
    np.testing.assert_allclose(turned[rows, 47:49].mean(axis=1), -turn_rad * x_m / floor, rtol=0.01)


@pytest.mark.thorough
@pytest.mark.parametrize(("step_m", "remains"), [(0.04, 0.7), (0.1, 0.2)])
def test_shadows_do_not_turn_a_sideways_motion(step_m: float, remains: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Posts all over three floors: displaced as the floor, their shadows turn the motion by 0.3 deg a metre or more."""
    start = [0.0, 0.0, 2.5, np.radians(35), 0.0, 0.0]
    steps = np.array([start, [step_m, *start[1:]]])
    floors = [posts(steps, np.random.default_rng(seed).uniform([-2, 2], [2, 5], (70, 2))) for seed in range(3)]

    def turn() -> float:
        return float(np.mean([Direct(2.5, relief_m=0.0).estimate(one).motion.yaw for one in floors]))

    with_shadows = turn()
    monkeypatch.setattr(direct, "shadow_lengths", lambda root, sides: np.zeros_like(root))
    without = turn()
    assert without > np.radians(0.3) * step_m
    assert abs(with_shadows) < remains * without


@pytest.mark.parametrize("coded", [True, False])
def test_shadows_are_the_same_in_all_codings(coded: bool) -> None:
    """Levels and their fourth roots; dark sand at a third of the level casts nothing and is no shadow."""
    level = np.full((200, 40), 0.5, dtype=np.float32)
    level[80:120, 10:20], level[80:120, 25:35] = 0.002, 0.17
    sonar = Sonar(range_bins=200, beams=40, coding="gamma" if coded else "linear", coding_gamma=0.25)
    image = np.stack([level ** np.float32(0.25) if coded else level] * 2)
    frames = SonarFrames(
        image, sonar.range_m, sonar.bearing_rad, np.arange(2.0), sonar, level="gamma" if coded else "linear"
    )
    shadows = direct._Task(frames, two_frames(frames), ATTITUDE, None).shadows
    assert shadows is not None
    assert shadows[0][100, 15] == pytest.approx(100 - 79, abs=2)
    assert shadows[0][:, 28:32].max() == 0


def test_small_frames_leave_out_coarse_levels_over_relief() -> None:
    """Frames of 64 bins: the level of every fourth bin has too few rows, and no motion is found."""
    small = frames(64, 32)
    assert not is_resolved(64, LEVELS[1])
    result = registered_over_relief(two_frames(small), small, ATTITUDE, np.zeros(3))
    assert result is not None
    assert (np.abs(result[0]) < [1e-3, 1e-3, 1e-3]).all()


def test_a_wide_fan_has_larger_pixels() -> None:
    """The longer side has as many pixels as asked for, and not one more than rounding needs."""
    one = frames()
    fine, coarse = GroundView(one, ATTITUDE, 0.005), GroundView(one, ATTITUDE, 0.005, 100)
    assert fine.edge == 0.005
    assert max(coarse.draw(one.image[0]).shape) in (100, 101)


def test_phase_takes_the_relief() -> None:
    """As direct does, for starts over rocks."""
    estimator = create_estimator("phase", relief_m=0.2)
    assert getattr(estimator, "relief_m") == 0.2  # noqa: B009


def test_beams_closer_than_their_width_are_averaged_first() -> None:
    """An Oculus has four beams within the width of one: half a million cells become as many as four DIDSONs have."""
    sonar = load_sonar("oculus-m1200d-2100khz")
    image = np.random.default_rng(1).random((2, sonar.range_bins, sonar.beams), dtype=np.float32)
    frames = SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.arange(2.0), sonar)
    fewer, images = _resolved(frames, (image[0], image[1]))
    assert images[0].shape == (1024, 170)
    np.testing.assert_allclose(images[1], image[1, :, :510].reshape(1024, 170, 3).mean(axis=2), atol=1e-6)
    np.testing.assert_allclose(fewer.bearing_rad, sonar.bearing_rad[:510].reshape(170, 3).mean(axis=1))
    np.testing.assert_array_equal(fewer.range_m, sonar.range_m)
    few = replace(frames, image=image[..., :96], bearing_rad=sonar.bearing_rad[:96])
    assert _resolved(few, (image[0, :, :96], image[1, :, :96]))[0] is few
