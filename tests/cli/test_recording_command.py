"""``mitsonar recording``: what it prints, draws and converts, of recordings and of runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bags import Maker, write_bag
from drawn_frames import START, as_zarr, over_ground, sway
from helpers import Command, essence, refused
from PIL import Image

from mitsonar import SonarFrames
from mitsonar.mapping.series import path_of
from mitsonar.mapping.sources import recording_at
from mitsonar.motion.trajectory import Trajectory
from mitsonar.recordings.write_mcap import write_mcap


@pytest.fixture(scope="module")
def frames() -> SonarFrames:
    drawn = over_ground(sway(6))
    elevation = np.full(drawn.image.shape, -0.6, np.float32)
    return replace(drawn, elevation_rad=elevation, shape_id=np.zeros(drawn.image.shape, np.int32))


@pytest.fixture(scope="module")
def places(frames: SonarFrames, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same frames as frames.npz, a run's folder with frames.zarr, and MCAP."""
    folder = tmp_path_factory.mktemp("frames")
    (folder / "run").mkdir()
    frames.save(folder / "frames.npz")
    as_zarr(frames, folder / "run/frames.zarr")
    write_mcap([frames], folder / "run.mcap", full=True)
    return {"npz": folder / "frames.npz", "zarr": folder / "run", "mcap": folder / "run.mcap"}


@pytest.mark.parametrize("kind", essence(["npz", "mcap"]))
def test_a_crop_keeps_bins_and_beams_with_their_axes(
    mitsonar: Command, places: dict[str, Path], frames: SonarFrames, tmp_path: Path, kind: str
) -> None:
    done = mitsonar(
        "recording", "convert", places[kind], "-o", tmp_path / "c", "--crop-bins", "20,84", "--crop-beams", "8,40"
    )
    assert done.returncode == 0, done
    result, rows, columns = SonarFrames.load(tmp_path / "c" / "frames.npz"), slice(20, 84), slice(8, 40)
    np.testing.assert_array_equal(result.image, frames.image[:, rows, columns])
    np.testing.assert_allclose(result.range_m, frames.range_m[rows])
    np.testing.assert_allclose(result.bearing_rad, frames.bearing_rad[columns], atol=1e-7)
    assert (result.sonar.range_bins, result.sonar.beams) == (64, 32)
    assert result.sonar.range_min == pytest.approx(frames.range_m[20] - 0.5 * np.diff(frames.range_m)[0], abs=1e-6)
    if kind == "npz":
        assert result.elevation_rad is not None
        assert result.elevation_rad.shape == result.image.shape
    second = ("recording", "convert", places[kind], "-o", tmp_path / "c", "--crop-bins", "20,84", "--crop-beams", "9,41")
    refused(mitsonar(*second, "--resume"), "beams 8,40", "beams 9,41")
    whole = mitsonar("recording", "convert", places[kind], "-o", tmp_path / "w", "--crop-beams", "0,96")
    assert whole.returncode == 0
    assert SonarFrames.load(tmp_path / "w" / "frames.npz").sonar.azimuth_fov_deg <= frames.sonar.azimuth_fov_deg


@pytest.mark.parametrize("kind", ["npz", "zarr", "mcap"])
def test_info_of_any_frames(mitsonar: Command, places: dict[str, Path], frames: SonarFrames, kind: str) -> None:
    done = mitsonar("recording", "info", places[kind], "--json")
    assert done.returncode == 0, done
    result = json.loads(done.stdout)
    (part,) = result["parts"]
    assert (result["frames"], part["bins"], part["beams"], part["samples"]) == (6, 128, 96, "float32")
    assert part["window_m"] == [3.6, 5.4]
    assert part["rate_hz"] == pytest.approx(1 / np.median(np.diff(frames.time_s)))
    assert part["bearing_deg"] == pytest.approx(np.degrees(frames.bearing_rad[[0, -1]]))
    assert part["path_m"] == pytest.approx(np.linalg.norm(np.diff(frames.poses[:, :3], axis=0), axis=1).sum())  # type: ignore[index]
    table = mitsonar("recording", "info", places[kind]).stdout
    assert "window     " in table
    assert "3.6..5.4 m, 128 bins of 14.06 mm" in " ".join(table.split())


def test_info_tells_gaps_and_notes(mitsonar: Command, frames: SonarFrames, tmp_path: Path) -> None:
    time = np.array([0.0, 0.1, 0.2, 0.9, 1.0, 1.1]) + 1_790_000_000
    replace(frames, time_s=time).save(tmp_path / "frames.npz")
    table = mitsonar("recording", "info", tmp_path).stdout
    assert "10 Hz, 1 gap; the longest step takes 0.7 s" in table
    assert "2026-09-21" in table


@pytest.mark.thorough
@pytest.mark.parametrize("kind", essence(["npz", "zarr", "mcap"], "mcap"))
def test_show_and_video(mitsonar: Command, places: dict[str, Path], tmp_path: Path, kind: str) -> None:
    done = mitsonar("recording", "show", places[kind], "--frame", 3, "-o", tmp_path / "a.png")
    assert done.returncode == 0, done
    assert np.asarray(Image.open(tmp_path / "a.png").convert("L")).std() > 10
    refused(mitsonar("recording", "show", places[kind], "-o", tmp_path / "a.png"), "exists and is kept")
    refused(mitsonar("recording", "show", places[kind], "--frame", 6, "-o", tmp_path / "b.png"), "there is no frame 6")
    done = mitsonar("recording", "video", places[kind], "-o", tmp_path / "a.mp4")
    assert done.returncode == 0, done
    assert "6 frames at" in done.stdout
    assert (tmp_path / "a.mp4").stat().st_size > 1000


@pytest.mark.thorough
@pytest.mark.parametrize("kind", essence(["npz", "zarr", "mcap"], "mcap"))
def test_frames_survive_folder_and_mcap_in_any_order(
    mitsonar: Command, places: dict[str, Path], frames: SonarFrames, tmp_path: Path, kind: str
) -> None:
    first, second = tmp_path / "one.mcap", tmp_path / "two"
    for source, out in ((places[kind], first), (first, second)):
        done = mitsonar("recording", "convert", source, "-o", out, *(["--full"] if out is first else []))
        assert done.returncode == 0, done
        assert "6 frames in" in done.stdout
    back = SonarFrames.load(second)
    for name in ("image", "range_m", "bearing_rad"):
        assert (getattr(back, name) == getattr(frames, name)).all(), name
    assert back.time_s == pytest.approx(frames.time_s, abs=0.51e-9)  # ROS counts nanoseconds
    assert back.poses == pytest.approx(frames.poses, abs=1e-8)
    assert back.height_m == pytest.approx(frames.height_m, rel=1e-6)
    assert back.sonar == frames.sonar
    refused(mitsonar("recording", "convert", places[kind], "-o", first), "exists and is kept")
    refused(mitsonar("recording", "convert", places[kind], "-o", second), "--resume continues it")
    assert mitsonar("recording", "convert", first, "-o", second, "--resume").returncode == 0


@pytest.mark.parametrize("kind", ["npz", "zarr"])
def test_labels_of_a_run_become_points(mitsonar: Command, places: dict[str, Path], tmp_path: Path, kind: str) -> None:
    from bags import decoded

    assert mitsonar("recording", "convert", places[kind], "-o", tmp_path / "a.mcap", "--labels").returncode == 0
    clouds = decoded(tmp_path / "a.mcap")["/sonar/points"]
    assert len(clouds) == 6
    assert [one.name for one in clouds[0].fields] == ["x", "y", "z", "intensity", "shape_id"]
    assert recording_at(places[kind]).part().read([1, 4]).elevation_rad == pytest.approx(-0.6)


@pytest.mark.thorough
def test_frames_become_an_aris_file(mitsonar: Command, places: dict[str, Path], tmp_path: Path) -> None:
    refused(mitsonar("recording", "convert", places["mcap"], "-o", tmp_path / "a.aris"), "--beams 96")
    done = mitsonar("recording", "convert", places["mcap"], "-o", tmp_path / "a.aris", "--beams", 96)
    assert done.returncode == 0, done
    assert "warning: 96 beams interpolated" in done.stderr
    assert "6 frames in" in done.stdout
    assert json.loads(mitsonar("recording", "info", tmp_path / "a.aris", "--json").stdout)["frames"] == 6
    again = ("recording", "convert", places["mcap"], "-o", tmp_path / "a.aris", "--beams", 96)
    refused(mitsonar(*again), "exists and is kept")
    assert mitsonar(*again, "--overwrite").returncode == 0
    assert [one.name for one in tmp_path.iterdir()] == ["a.aris"]


@pytest.mark.thorough
def test_odometry_reads_what_was_converted(mitsonar: Command, places: dict[str, Path], tmp_path: Path) -> None:
    done = mitsonar("odometry", places["mcap"], "--estimator", "zero", "-o", tmp_path / "out")
    assert done.returncode == 0, done
    assert (tmp_path / "out/true.tum").exists()


def test_an_estimated_path_is_written_with_a_recording_that_has_none(
    mitsonar: Command, frames: SonarFrames, tmp_path: Path
) -> None:
    write_mcap([replace(frames, poses=None, height_m=None)], tmp_path / "dive.mcap")
    path = sway(6)
    path.save(tmp_path / "path.tum")
    done = mitsonar("recording", "convert", "dive.mcap", "--poses", "path.tum", "-o", "both.mcap", cwd=tmp_path)
    assert done.returncode == 0, done
    poses = recording_at(tmp_path / "both.mcap").part().poses
    assert poses is not None
    np.testing.assert_allclose(poses, path.poses, atol=1e-6)
    Trajectory(path.poses[:3], path.time_s[:3]).save(tmp_path / "short.tum")
    refused(
        mitsonar("recording", "convert", "dive.mcap", "--poses", "short.tum", "-o", "a.mcap", cwd=tmp_path),
        "short.tum has no pose for 3 of 6 frames",
    )


@pytest.mark.thorough
def test_a_dark_frame_is_noted_and_drawn_below_another_top(mitsonar: Command, frames: SonarFrames, tmp_path: Path) -> None:
    replace(frames, image=(frames.image * 1e-5).astype(np.float32)).save(tmp_path / "dark.npz")
    done = mitsonar("recording", "show", tmp_path / "dark.npz", "-o", tmp_path / "a.png")
    assert "the picture is dark: the brightest thousandth lies at -5" in done.stderr
    assert "give --top-db -50" in done.stderr
    done = mitsonar("recording", "show", tmp_path / "dark.npz", "-o", tmp_path / "b.png", "--top-db", -50)
    assert not done.stderr
    dark, light = (np.asarray(Image.open(tmp_path / name).convert("L"))[100:500, 100:400] for name in ("a.png", "b.png"))
    assert light.mean() > dark.mean() + 20


def test_fits_name_the_command_for_recordings_and_the_missing_carrier(
    mitsonar: Command, places: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "sonar.yaml"
    refused(mitsonar("sonar", "fit", places["mcap"], "-o", out), "is a recording: give `mitsonar sonar from-recording")
    twice = mitsonar("sonar", "from-recording", places["mcap"], "-o", out, "--noise", out)
    refused(twice, "-o and --noise both name")
    for words in (("from-recording",), ("calibrate",)):
        refused(mitsonar("sonar", *words, places["mcap"], "-o", out), "state the carrier: give --set frequency_hz=1.8e6")
    assert not out.exists()


def test_a_topic_is_chosen(mitsonar: Command, tmp_path: Path) -> None:
    maker, sent = Maker(True), []
    bearing, distance = np.radians(np.linspace(-20, 20, 8)), np.arange(1, 13, dtype=np.float64)
    for topic, value in (("/port", 10), ("/starboard", 200)):
        for time in (1.0, 1.1, 1.2):
            image = np.full((12, 8), value, np.uint8)
            sent.append((topic, time, maker.ping(image, time, bearing, distance)))
    path = write_bag(tmp_path / "two.bag", maker, sent)
    refused(mitsonar("recording", "info", path), "choose one of the topics /port, /starboard", "--topic")
    result = json.loads(mitsonar("recording", "info", path, "--topic", "/starboard", "--json").stdout)
    assert result["facts"]["topic"] == "/starboard"


@pytest.mark.posix
@pytest.mark.parametrize("target", ["gone.aris", "link.aris"])
def test_a_link_to_nothing_or_itself_is_named_as_one(mitsonar: Command, tmp_path: Path, target: str) -> None:
    (tmp_path / "link.aris").symlink_to(target)
    done = mitsonar("recording", "info", "link.aris", cwd=tmp_path)
    refused(done, f"no such file: link.aris is a link to {target}, which is missing")


def test_a_missing_file_is_named_with_its_neighbour(mitsonar: Command, tmp_path: Path) -> None:
    (tmp_path / "dive.mcap").touch()
    for typed in (["recording", "info", "dvie.mcap"], ["odometry", "DIVE.MCAP", "-o", "out"]):
        refused(mitsonar(*typed, cwd=tmp_path), "no such file: ", "; did you mean dive.mcap?")
    (tmp_path / "notes.mcap").write_text("text")
    refused(mitsonar("recording", "info", tmp_path / "notes.mcap"), "XTF (.xtf)", "Sonar 3D-15 (.sonar)")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["info", "no.aris"], "no such file: no.aris; give frames.npz"),
        (["convert", "FRAMES", "-o", "a.bag"], "unknown ending"),
        (["convert", "FRAMES", "-o", "a.mcap", "--resume"], "--resume applies only to folders"),
        (["convert", "FRAMES", "-o", "a.mcap", "--part", "3"], "has no part 3"),
        (["convert", "FRAMES", "-o", "a", "--crop-bins", "20"], "--crop-bins is two whole numbers, first,end"),
        (["convert", "FRAMES", "-o", "a", "--crop-beams", "90,97"], "--crop-beams must be first,end of at least two beams"),
        (["convert", "FRAMES", "-o", "a", "--full"], "--full and --labels apply only to MCAP files"),
        (["video", "FRAMES", "-o", "a.mp4", "--rate", "0"], "--rate must lie"),
        (["show", "FRAMES", "-o", "a.png", "--span-db", "-1"], "the span must lie"),
        (["show", "FRAMES", "-o", "a.jpg"], "a.jpg: pictures are written as .png"),
        (["show", "FRAMES", "-o", "none/a.png"], "there is no folder none; create it first"),
    ],
)
def test_mistakes_are_one_sentence(
    mitsonar: Command, places: dict[str, Path], tmp_path: Path, words: list[str], reason: str
) -> None:
    given = [str(places["npz"]) if word == "FRAMES" else word for word in words]
    refused(mitsonar("recording", *given, cwd=tmp_path), reason)
    assert not list(tmp_path.iterdir())


def test_frames_are_not_replaced_while_they_are_read(mitsonar: Command, places: dict[str, Path], tmp_path: Path) -> None:
    assert mitsonar("recording", "convert", places["npz"], "-o", tmp_path / "a").returncode == 0
    before = (tmp_path / "a" / "frames.npz").read_bytes()
    for given in (tmp_path / "a", tmp_path / "a" / "frames.npz"):
        again = mitsonar("recording", "convert", given, "-o", tmp_path / "a", "--crop-bins", "0,8", "--overwrite")
        refused(again, "would replace the frames that are read")
    assert (tmp_path / "a" / "frames.npz").read_bytes() == before


def test_handedness_is_told_on_request(mitsonar: Command, tmp_path: Path) -> None:
    """A drawn floor under a sonar that turns by 9 deg to starboard agrees, and its mirror image does not."""
    turning = path_of(np.tile([0.0, 0.0, np.radians(0.6)], (15, 1)), START, np.arange(16) / 10)
    frames = over_ground(turning)
    frames.save(tmp_path / "right.npz")
    replace(frames, image=frames.image[:, :, ::-1].copy()).save(tmp_path / "wrong.npz")
    for name, verdict in (("right", "agree"), ("wrong", "mirrored")):
        done = mitsonar("recording", "info", tmp_path / f"{name}.npz", "--handedness")
        assert done.returncode == 0, done.stderr
        assert f"handedness             {verdict}: correlation" in done.stdout
