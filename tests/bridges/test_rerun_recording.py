"""Recordings of Rerun are read back with its own reader; the page is parsed."""

from __future__ import annotations

import io
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import Command, axes, box, direction, floor, refused, sphere
from PIL import Image

pytest.importorskip("rerun")

from mitsonar.bridges.live import FanEncoder
from mitsonar.bridges.rerun import Shown, first_eye, lit_corners, wedge_lines
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.scene import Triangles, triangles_in

FRAMES = 20
SONAR = Sonar(beams=12, range_bins=30)


@pytest.fixture
def stored(tmp_path: Path) -> SonarFrames:
    """Frames on disk, with poses."""
    image = np.random.default_rng(3).random((FRAMES, 30, 12), np.float32)
    poses = np.array([[0.1 * k, 1, 2, 0.5, 0, 0.1 * k] for k in range(FRAMES)])
    frames = SonarFrames(image, SONAR.range_m, SONAR.bearing_rad, np.arange(FRAMES) / 10, SONAR, poses)
    frames.save(tmp_path / "frames.npz")
    return frames


def rows_of(path: Path) -> dict[str, dict[str, list[Any]]]:
    """All values of a recording by entity and component."""
    from rerun.chunk import RrdReader

    result: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(path).stream():
        table = chunk.to_record_batch().to_pydict()
        for name, values in table.items():
            result.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(values)
    return result


@pytest.mark.e2e
def test_a_recording_holds_all_frames_poses_and_paths(mitsonar: Command, tmp_path: Path, stored: SonarFrames) -> None:
    estimated = Trajectory(np.array([[0, 0, 2, 0, 0, 0], [3, 1, 2, 0, 0, 0]], float), np.array([0.0, 1.0]))
    estimated.save(tmp_path / "path.tum")
    words = ("view", tmp_path / "frames.npz", "--save", tmp_path / "all.rrd")
    done = mitsonar(*words, "--path", tmp_path / "path.tum", "--scene", "pattern")
    assert done.returncode == 0, done.stderr
    rows = rows_of(tmp_path / "all.rrd")
    fans = rows["/fan"]["EncodedImage:blob"]
    assert len(fans) == FRAMES
    encoder = FanEncoder()
    for number in (0, FRAMES - 1):
        blob = bytes(np.array(fans[number][0], dtype=np.uint8))
        assert blob == encoder.jpeg(stored, number)
        assert Image.open(io.BytesIO(blob)).size == encoder.picture(stored).shape[::-1]
    moved = np.array([row[0] for row in rows["/world/sonar"]["Transform3D:translation"]])
    np.testing.assert_allclose(moved, stored.poses[:, :3], atol=1e-6)  # type: ignore[index]
    means = [row[0] for row in rows["/levels/mean"]["Scalars:scalars"]]
    np.testing.assert_allclose(means, stored.image.mean((1, 2)), atol=2e-3)
    line = np.array(rows["/world/paths/estimated"]["LineStrips3D:strips"][0][0])
    np.testing.assert_allclose(line, estimated.poses[:, :3])
    assert len(np.array(rows["/world/paths/path"]["LineStrips3D:strips"][0][0])) == FRAMES
    assert any(name.startswith("/world/scene/") for name in rows)
    refused(mitsonar(*words), "--save", "--overwrite")
    assert mitsonar(*words, "--overwrite").returncode == 0


@pytest.mark.e2e
def test_what_cannot_be_shown_is_one_sentence(mitsonar: Command, tmp_path: Path, stored: SonarFrames) -> None:
    frames = tmp_path / "frames.npz"
    refused(mitsonar("view", frames, "--save", tmp_path / "a.mp4"), "--save must name an .rrd file")
    refused(mitsonar("view", frames, "--save", tmp_path / "a.rrd", "--html", tmp_path / "page"), "contradict")
    refused(mitsonar("view", frames, "--save", tmp_path / "a.rrd", "--path", "none"), "there is no path none")
    refused(mitsonar("view", tmp_path / "none", "--save", tmp_path / "a.rrd"), "no scene file")
    (tmp_path / "frames.npz").write_bytes(b"PK")
    refused(mitsonar("view", frames, "--save", tmp_path / "a.rrd"), "cannot read frames")
    assert not list(tmp_path.glob("*.rrd*"))


class Scripts(HTMLParser):
    """Addresses that a page loads."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loaded += [value for name, value in attrs if name in ("src", "href") and value]


@pytest.mark.e2e
@pytest.mark.thorough
def test_a_page_loads_nothing_from_elsewhere(mitsonar: Command, tmp_path: Path, stored: SonarFrames) -> None:
    page = tmp_path / "page"
    done = mitsonar("view", tmp_path / "frames.npz", "--html", page)
    assert done.returncode == 0, done.stderr
    assert f"python -m http.server -d {page}" in done.stdout
    assert len(rows_of(page / "recording.rrd")["/fan"]["EncodedImage:blob"]) == FRAMES
    assert (page / "re_viewer_bg.wasm").read_bytes()[:4] == b"\0asm"
    text = (page / "index.html").read_text()
    reader = Scripts()
    reader.feed(text)
    assert "re_viewer.js" in reader.loaded
    assert not [address for address in reader.loaded if "//" in address]
    assert text.index("Content-Security-Policy") < min(text.index("<script"), text.index("<link"))
    assert text.index("window.fetch =") < text.index('src="re_viewer.js"')
    assert text.index('new URL("recording.rrd"') < text.index('src="re_viewer.js"')
    refused(mitsonar("view", tmp_path / "frames.npz", "--html", page), "--html", "--overwrite")


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_the_wedge_is_the_edge_of_what_the_beams_see(bearing: str) -> None:
    sonar = SONAR.replace(bearing=bearing)
    points = np.concatenate(wedge_lines(sonar))
    radius = np.linalg.norm(points, axis=1)
    assert (radius.min(), radius.max()) == (pytest.approx(sonar.range_min), pytest.approx(sonar.range_max))
    half = np.abs(sonar.bearing_rad).max() + sonar.beam_width_rad / 2
    corner = sonar.range_max * direction(sonar, half, np.radians(sonar.elevation_fov_deg) / 2)
    assert np.linalg.norm(points - corner, axis=1).min() < 1e-9
    starboard, _, _ = axes(Pose(0, 0, 0))
    assert np.allclose(starboard, [1, 0, 0])  # the axes of the wedge


@pytest.mark.parametrize("heading", [0.0, 1.9])
def test_the_eye_sees_path_and_beams_at_first_however_large_the_scene(heading: float) -> None:
    starboard, forward, _ = axes(Pose(0, 0, 0, heading=heading))
    poses = np.array([[*(5 + 0.1 * k * forward), 0.4, 0, heading] for k in range(30)])
    flown = Trajectory(poses, np.arange(30.0))
    edges = np.array([[-1e3, -1e3, 0], [1e3, 0, 0], [0, 1e3, 0]], np.float32)
    sand = Triangles("sand", edges, np.array([[0, 1, 2]], np.uint32), True)
    eye = first_eye(Shown("a", sonar=SONAR, path=flown, shapes=[sand]))
    assert eye is not None
    place, target = eye
    assert place[2] > poses[:, 2].max()
    assert (place - target) @ forward < 0 < (place - target) @ starboard  # behind, to starboard
    ahead = (target - place) / np.linalg.norm(target - place)
    first, last = axes(Pose(0, 0, 0, pitch=0.4, heading=heading)), np.concatenate(wedge_lines(SONAR))
    seen = np.concatenate([poses[:, :3], *(last @ np.array(first) + pose[:3] for pose in poses)]) - place
    angle = np.degrees(np.arccos(seen @ ahead / np.linalg.norm(seen, axis=1)))
    assert 15 < angle.max() < 27.5  # half of the 55 deg of the viewer
    assert first_eye(Shown("b", path=Trajectory(poses[:1], np.zeros(1)))) is None
    assert first_eye(Shown("c", shapes=[sand])) is None


def test_faces_are_lit_by_their_own_normals() -> None:
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 4]], np.float32)
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 1, 1]], np.uint32)  # up, forward, no area
    corners, normals = lit_corners(Triangles("a", vertices, faces, True))
    np.testing.assert_array_equal(corners, vertices[faces.ravel()])
    np.testing.assert_array_equal(normals, np.repeat([[0, 0, 1], [0, 1, 0], [0, 0, 0]], 3, axis=0))


def test_shapes_become_triangles_that_fill_their_boxes(variant: str) -> None:
    import mitsuba as mi

    shapes = {"floor": floor(), "block": box((1, 2, 3), (0.5, 1, 2)), "ball": sphere((4, 0, 1), 0.7)}
    result = mi.load_dict({"type": "scene", **shapes}, optimize=False)  # merged meshes keep the box of the first
    assert isinstance(result, mi.Scene)
    for one, shape in zip(triangles_in(result), result.shapes(), strict=True):
        extent = shape.bbox()
        low, high = np.array(extent.min).reshape(3), np.array(extent.max).reshape(3)
        np.testing.assert_allclose(one.vertices.min(axis=0), low, atol=0.02)
        np.testing.assert_allclose(one.vertices.max(axis=0), high, atol=0.02)
        assert one.whole
        assert one.faces.max() < len(one.vertices)
        a, b, c = (one.vertices[one.faces[:, corner]] for corner in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        assert area == pytest.approx(float(np.array(shape.surface_area()).reshape(-1)[0]), rel=0.02)
