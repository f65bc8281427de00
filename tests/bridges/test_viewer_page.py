"""The page of `mitsonar view --html` in a browser: what it asks of whom, and what it shows."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers import Command
from numpy.typing import NDArray
from PIL import Image

pytest.importorskip("rerun")
pytest.importorskip("websockets")

from browser import CHROMIUM, Page, opened, served

from mitsonar.bridges.rerun import BEAMS, ESTIMATED, TRUE, WHOLE
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames

Picture = NDArray[np.uint8]

WIDTH, HEIGHT = 800, 640
NEAR, FAR = 90, 200
"""Grey levels of the frames, in the nearer and the farther half of the ranges."""

SHORTEST, LONGEST_S = 20, 90.0
"""Pixels of a line at least; how long the page may take to draw all."""


def near(picture: Picture, colour: tuple[int, int, int], tolerance: int = 12) -> NDArray[np.bool_]:
    """Which pixels have about that colour."""
    close: NDArray[np.bool_] = np.abs(picture.astype(int) - colour).max(axis=-1) <= tolerance
    return close


def fan_of(picture: Picture) -> Picture:
    """The upper three fifths of the right half."""
    return picture[: 3 * picture.shape[0] // 5, picture.shape[1] // 2 :]


def shown_in(picture: Picture) -> dict[str, int]:
    """Pixels of each thing to show: lines in the left half, the fan in the upper part of the right half."""
    world, fan = picture[:, : picture.shape[1] // 2], fan_of(picture)
    return {
        "true": int(near(world, TRUE).sum()),
        "estimated": int(near(world, ESTIMATED).sum()),
        "beams": int(near(world, BEAMS).sum()),
        "scene": int(near(world, WHOLE[0]).sum()),
        "near": int(near(fan, (NEAR,) * 3, 4).sum()),
        "far": int(near(fan, (FAR,) * 3, 4).sum()),
    }


def wait_for(page: Page, recording: str, there: Callable[[Picture], bool]) -> Picture:
    """Wait for the recording, then take pictures until one shows what is asked for, or the time is over."""
    end = time.monotonic() + LONGEST_S
    while recording not in page.status:
        assert time.monotonic() < end, (page.status, page.said)
        page.wait(0.2)
    while True:
        page.wait(0.5)
        picture = page.screenshot()
        if there(picture) or time.monotonic() > end:
            return picture


@pytest.fixture
def folder(mitsonar: Command, tmp_path: Path) -> Path:
    """A page: a sonar above the pattern, a true path of 2 m, an estimated one beside it."""
    sonar = Sonar(beams=16, range_bins=64)
    poses = np.array([[0.1 * k, 0, 2, 0.5, 0, 0] for k in range(20)])
    levels = np.where(np.arange(64) < 32, NEAR, FAR) / 255
    image = np.broadcast_to(levels[None, :, None], (20, 64, 16)).astype(np.float32)
    SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.arange(20) / 10, sonar, poses).save(tmp_path / "frames.npz")
    Trajectory(poses + np.array([0, 0.4, 0, 0, 0, 0]), np.arange(20) / 10).save(tmp_path / "path.tum")
    words = ("view", tmp_path / "frames.npz", "--path", tmp_path / "path.tum", "--scene", "pattern")
    done = mitsonar(*words, "--html", tmp_path / "page")
    assert done.returncode == 0, done.stderr
    return tmp_path / "page"


REFUSED = """new Promise(answer => {
    document.addEventListener("securitypolicyviolation", event => answer(event.violatedDirective));
    const picture = new Image();
    picture.onload = () => answer("loaded");
    picture.src = "http://127.0.0.1:1/elsewhere.png";
    setTimeout(() => answer("not refused"), 20000);
})"""
"""Asks for a picture of another host without the viewer's way of asking: the browser itself must refuse."""


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium, chromium-browser or google-chrome")
def test_a_browser_shows_fan_scene_and_paths_and_asks_nobody_else(folder: Path, tmp_path: Path) -> None:
    with served(folder) as address, opened(address + "?theme=dark", tmp_path / "profile", WIDTH, HEIGHT) as page:
        picture = wait_for(page, address + "recording.rrd", lambda one: min(shown_in(one).values()) >= SHORTEST)
        Image.fromarray(picture).save(tmp_path / "picture.png")
        assert not [text for level, text in page.said if level in ("error", "assert")]
        assert not [url for url in page.requested if not url.startswith((address, "data:", "blob:"))]
        for name in ("re_viewer.js", "re_viewer_bg.wasm", "recording.rrd"):
            assert page.status[address + name] == 200, page.status
        counts = shown_in(picture)
        assert min(counts.values()) >= SHORTEST, (counts, tmp_path / "picture.png")
        assert min(counts["near"], counts["far"], counts["scene"]) > 2_000, (counts, tmp_path / "picture.png")
        rows = [np.nonzero(near(fan_of(picture), (level,) * 3, 4))[0].mean() for level in (FAR, NEAR)]
        assert rows[0] < rows[1], "far ranges are above"
        assert page.run(REFUSED) == "img-src"
