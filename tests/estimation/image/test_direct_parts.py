"""The parts of direct: sums over blocks, displacements and their derivatives, smoothing, margins; the view of phase."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsonar.estimation.estimator import two_frames
from mitsonar.estimation.image.direct import LEVELS, _resolved, registered_over_relief
from mitsonar.estimation.image.registration import (
    Cells,
    DirectLevel,
    GroundNodes,
    _inner,
    blurred,
    by_block,
    cell_blocks,
    is_resolved,
    products_by_block,
    smoothed,
)
from mitsonar.estimation.named import create_estimator
from mitsonar.geometry.ground import Attitude, GroundView
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
