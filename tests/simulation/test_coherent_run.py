"""Coherent pings of a run on disk: broken off and resumed, the same bits as in one go, noise and warnings included."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from coherent_scenes import HEIGHT, PITCH, SONAR
from helpers import diffuse, floor, scene, sphere

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import FrameStore, SonarFrames
from mitsonar.simulation.runs import Destination, RenderOptions, run
from mitsonar.simulation.simulator import Simulator

pytestmark = pytest.mark.usefixtures("variant")

NOISY = SONAR.replace(
    beams=12, azimuth_fov_deg=3.6, range_bins=64, range_min=3.5, quality="draft", noise_level_db=-110.0, volume_db=-70.0,
    stripes_db=0.5, crosstalk_db=-50.0, speckle_nu=2.0, near_glow_db=10.0,
)  # fmt: skip


@pytest.mark.thorough
def test_a_run_that_is_broken_off_and_resumed_has_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """25 frames, broken off after the 22nd: the gain is that of the first 20; noise goes by the number of the ping."""
    loaded = scene(floor=floor(diffuse(0.1)), ball=sphere((0, 3.4, 0.2), 0.15, diffuse(0.3)))
    poses = np.array([0, 0, HEIGHT, PITCH, 0, 0]) + np.arange(25)[:, None] * np.array([0.01, 0.004, 0, 0, 0, 0.002])
    path, options = Trajectory(poses, np.arange(25) / 10), RenderOptions(NOISE_MODELS["none"], labels=True)
    run(Simulator(loaded, NOISY), path, options, Destination(tmp_path / "whole"))
    real = FrameStore.write

    def broken(store: FrameStore, first: int, frames: SonarFrames) -> None:
        if first >= 22:
            raise KeyboardInterrupt
        real(store, first, frames)

    with monkeypatch.context() as patch:
        patch.setattr(FrameStore, "write", broken)
        with pytest.raises(KeyboardInterrupt):
            run(Simulator(loaded, NOISY), path, options, Destination(tmp_path / "parts"))
    run(Simulator(loaded, NOISY), path, options, Destination(tmp_path / "parts", resume=True))
    whole, parts = (SonarFrames.load(tmp_path / name) for name in ("whole", "parts"))
    np.testing.assert_array_equal(whole.image, parts.image)
    assert whole.shape_id is not None
    assert parts.shape_id is not None
    np.testing.assert_array_equal(whole.shape_id, parts.shape_id)
    assert whole.level_scale == parts.level_scale
    assert not np.array_equal(whole.image[0], whole.image[1])
    alone = list(Simulator(loaded, NOISY).pings(poses[23:24], first=23))
    np.testing.assert_array_equal(alone[0].levels, list(Simulator(loaded, NOISY).pings(poses))[23].levels)
