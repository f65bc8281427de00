"""Patches: found again where they were moved to, with the covariance that they promise, and never in shadows."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mitsonar.estimation.image.patches import COLUMNS, ROWS, Patches, align, corners, cut, patch_image

Floats = NDArray[np.float32]


def texture(shift: tuple[float, float] = (0.0, 0.0), noise: float = 0.0, seed: int = 0) -> Floats:
    """Return a random frame of 260 bins x 96 beams without steps; its spectrum is shifted."""
    rng = np.random.default_rng(3)
    plain = cv2.GaussianBlur(rng.random((320, 160)).astype(np.float32), (0, 0), sigmaX=1.2, sigmaY=2.0)
    turn = np.fft.fftfreq(320)[:, None] * shift[0] + np.fft.fftfreq(160)[None, :] * shift[1]
    moved = np.fft.ifft2(np.fft.fft2(plain) * np.exp(-2j * np.pi * turn)).real.astype(np.float32)
    result = 0.3 + 3 * (moved - plain.mean())[30:290, 32:128]
    return np.asarray(np.maximum(result, 0) + noise * np.random.default_rng(seed).standard_normal(result.shape), np.float32)


def patches_of(frame: Floats) -> tuple[Patches, NDArray[np.float64], NDArray[np.float64]]:
    """Return all patches of a frame, and where their pixels are."""
    image = patch_image(frame)
    row, column = corners(image, np.zeros(frame.shape, dtype=bool))
    rows, columns = row[:, None] + ROWS, column[:, None] + COLUMNS
    patches, good = cut(image, rows, columns)
    return patches.take(good), rows[good], columns[good]


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.37, -0.21), (2.4, 0.8)])
def test_patches_are_found_where_they_moved(shift: tuple[float, float]) -> None:
    patches, rows, columns = patches_of(texture())
    result = align(patch_image(2 * texture(shift) + 0.1), patches, rows, columns)
    good = result.correlation > 0.9
    assert good.mean() > 0.8
    assert len(rows) > 40
    off = result.shift[good] - shift
    assert np.abs(np.median(off, axis=0)).max() < 0.04, "OpenCV interpolates at 32nds of a pixel"
    assert (np.abs(off) < 0.15).all(axis=1).mean() > 0.9


def test_covariance_is_that_of_repeated_noise() -> None:
    patches, rows, columns = patches_of(texture())
    shifts, promised = [], []
    for seed in range(30):
        result = align(patch_image(texture(noise=0.05, seed=seed)), patches, rows, columns)
        shifts.append(result.shift)
        promised.append(np.diagonal(result.covariance, axis1=1, axis2=2))
    ratio = np.var(shifts, axis=0) / np.mean(promised, axis=0)
    assert 0.2 < float(np.median(ratio)) < 1.5


def test_shadows_have_no_patches() -> None:
    frame = texture()
    frame[100:160, 30:60] = 0
    image = patch_image(frame)
    row, column = corners(image, np.zeros(frame.shape, dtype=bool))
    patches, good = cut(image, row[:, None] + ROWS, column[:, None] + COLUMNS)
    inside = (row > 104) & (row < 156) & (column > 32) & (column < 58)
    assert not (inside & good).any()
    assert good.sum() > 30
    near = good & (row > 92) & (row < 168) & (column > 28) & (column < 62)
    dark = cv2.remap(
        frame,
        (column[:, None] + COLUMNS).astype(np.float32),
        (row[:, None] + ROWS).astype(np.float32),
        cv2.INTER_NEAREST,
    )
    assert (patches.weights[near][dark[near] == 0] < 1e-6).all(), "pixels in shadow weigh nothing"


def test_cells_that_are_taken_get_no_second_patch() -> None:
    image = patch_image(texture())
    row, column = corners(image, np.zeros((260, 96), dtype=bool))
    taken = np.zeros((260, 96), dtype=bool)
    taken[row, column] = True
    assert len(corners(image, taken)[0]) == 0
