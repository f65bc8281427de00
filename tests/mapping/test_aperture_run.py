"""The folder of a synthetic aperture: interrupted anywhere, it continues to the same bits; damage is one sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from aperture_scenes import array, responses_of, track

from mitsonar.errors import MitsonarError
from mitsonar.mapping.aperture_run import ApertureOptions, run_aperture
from mitsonar.mapping.synthetic_aperture import focus
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.responses import ImpulseResponses
from mitsonar.records.strips import StripGrid

pytestmark = pytest.mark.usefixtures("variant")

GRID = StripGrid(0, 0, 0, 0, 2.0, 0.02, 200, 14.0, 0.05, 40)


@pytest.fixture(scope="module")
def measured() -> ImpulseResponses:
    return responses_of(array(), track(40, 0.2), [(15.0, 3.0, 0.0), (14.5, 5.0, 0.0)], [1.0, 1j])


class Stopped(Exception):
    """A run is killed."""


def run(folder: Path, measured: ImpulseResponses, stop_at: int = 10**9, **keys: object) -> np.ndarray:
    """Run, and stop after that many rows."""
    rows = 0

    def measure(inner: Path, resumed: bool) -> list[str]:
        if not resumed:
            inner.mkdir()
            measured.save(inner / "responses.zarr")
        return ["a warning"]

    def progress(more: int) -> None:
        nonlocal rows
        rows += more
        if rows >= stop_at:
            raise Stopped

    options = ApertureOptions(GRID, **keys)  # type: ignore[arg-type]
    report = run_aperture(folder, {"scene": "points"}, measure, options, resume=True, progress=progress)
    assert report.warnings == ["a warning"]
    return report.image.value


@pytest.mark.thorough
def test_a_run_that_was_stopped_continues_to_the_same_bits(measured: ImpulseResponses, tmp_path: Path) -> None:
    whole = run(tmp_path / "whole", measured)
    np.testing.assert_array_equal(whole, focus(measured, GRID).value)
    for stop_at in (1, 128):
        with pytest.raises(Stopped):
            run(tmp_path / f"{stop_at}", measured, stop_at)
        assert not (tmp_path / f"{stop_at}" / "image.npz").exists()
        np.testing.assert_array_equal(run(tmp_path / f"{stop_at}", measured), whole)
        assert not (tmp_path / f"{stop_at}" / "parts").exists()


def test_a_damaged_part_is_one_sentence(measured: ImpulseResponses, tmp_path: Path) -> None:
    with pytest.raises(Stopped):
        run(tmp_path / "run", measured, 64)
    part = tmp_path / "run" / "parts" / "000000000.npz"
    part.write_bytes(b"PK broken")
    with pytest.raises(MitsonarError, match="start again with --overwrite"):
        run(tmp_path / "run", measured)
    for shape in ((1, 1), (64, 1), (1, 40)):  # NumPy would repeat them over the block
        np.savez(part, value=np.zeros(shape, np.complex64))
        with pytest.raises(MitsonarError, match=r"shape \(\d+, \d+\)\): start again with --overwrite"):
            run(tmp_path / "run", measured)


@pytest.mark.thorough
def test_a_navigation_replaces_the_poses_and_must_cover_the_pings(measured: ImpulseResponses, tmp_path: Path) -> None:
    """A navigation 0.5 m farther along moves the image by that much."""
    flown = track(40, 0.2)
    poses = flown.poses.copy()
    poses[:, 1] -= 0.5
    moved = run(tmp_path / "run", measured, navigation=Trajectory(poses, flown.time_s))
    peaks = [np.unravel_index(np.abs(one).argmax(), one.shape)[0] for one in (focus(measured, GRID).value, moved)]
    assert peaks[0] - peaks[1] == 25
    with pytest.raises(MitsonarError, match="must cover the pings"):
        run(tmp_path / "short", measured, navigation=Trajectory(poses[:20], flown.time_s[:20]))
    with pytest.raises(MitsonarError, match="navigation"):
        run(tmp_path / "run", measured)  # the same folder without navigation
