"""The commands `odometry` and `mosaic` as a user meets them: what they write, what they answer to mistakes, what survives a
kill."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tifffile
from drawn_frames import as_zarr, over_ground, sway
from helpers import Command, diffuse, files_of, floor, refused, scene
from numpy.typing import NDArray
from PIL import Image

from mitsonar.instruments.sonar import Sonar
from mitsonar.mapping.odometry_run import OdometryFolder
from mitsonar.mapping.sensors import SensorNoise, simulated_sensors
from mitsonar.mapping.series import path_of
from mitsonar.motion.composition import motions
from mitsonar.motion.pose import Pose
from mitsonar.motion.sensors import save_sensors
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames

DRIVEN = np.tile([0.012, 0.009, np.radians(0.3)], (11, 1))


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Path:
    """A run's folder: twelve frames over a floor of noise, rendered, 15 mm and 0.3 deg a frame."""
    from mitsonar.simulation.simulator import Simulator

    texture = {"type": "cell_noise", "cells": 1000, "seed": 3}
    path = path_of(DRIVEN, Pose.from_degrees([0.3, -1.0, 2.5, 35, 0, 20]), np.arange(12) / 10)
    sonar = Sonar(rays_per_beam=700, rays_across=4)
    frames = Simulator(scene(floor=floor(diffuse(texture), 15.0)), sonar).render(path.poses)
    folder = tmp_path_factory.mktemp("rendered")
    frames.save(folder / "frames.npz")
    return folder


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of twenty frames of a drawn floor."""
    path = tmp_path_factory.mktemp("drawn") / "frames.npz"
    over_ground(sway(20)).save(path)
    return path


def table(folder: Path) -> dict[str, float]:
    return {row["name"]: row["value"] for row in json.loads((folder / "table.json").read_text())["rows"]}


# ---------------------------------------------------------------- end to end


def bands(path: Path) -> tuple[NDArray[np.float32], tuple[float, float, float]]:
    """Mean, std and count of a GeoTIFF, and its west and north edge and cell [m]."""
    with tifffile.TiffFile(path) as file:
        tags = file.pages[0].tags  # type: ignore[union-attr]
        west, north = tags["ModelTiepointTag"].value[3:5]
        return np.asarray(file.asarray()), (west, north, tags["ModelPixelScaleTag"].value[0])


def in_common(a: Path, b: Path) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean levels of two maps where both know them, cell by cell of the world."""
    (one, (west, north, cell)), (two, (west2, north2, cell2)) = bands(a), bands(b)
    assert cell == cell2
    right, down = round((west2 - west) / cell), round((north - north2) / cell)
    size = np.array(one.shape[1:]) + 2 * 50
    canvas = np.full((2, *size), np.nan, np.float32)
    for k, (maps, row, column) in enumerate(((one, 50, 50), (two, 50 + down, 50 + right))):
        rows, columns = (min(n, s - o) for n, s, o in zip(maps.shape[1:], size, (row, column), strict=True))
        canvas[k, row : row + rows, column : column + columns] = maps[0, :rows, :columns]
    both = np.isfinite(canvas).all(axis=0)
    assert both.sum() > 0.7 * np.isfinite(one[0]).sum()
    return canvas[0][both], canvas[1][both]


@pytest.mark.thorough
def test_a_rendered_run_becomes_its_path_and_its_map(mitsonar: Command, rendered: Path, tmp_path: Path) -> None:
    out = tmp_path / "odometry"
    done = mitsonar("odometry", rendered, "-o", out, "--estimator", "direct")
    assert done.returncode == 0, done
    assert "11 motions by direct (pitch; height where no first echoes show), 0 invalid and bridged" in done.stdout
    assert "end-point error" in done.stdout
    result = table(out)
    assert result["path length"] == pytest.approx(np.linalg.norm(DRIVEN[:, :2], axis=1).sum(), rel=1e-6)
    assert result["end-point error"] < 4, "mm"
    assert abs(result["heading error at the end"]) < 0.2, "deg"
    estimated, true = (Trajectory.load_tum(out / f"{name}.tum") for name in ("estimated", "true"))
    np.testing.assert_allclose(motions(true.poses), DRIVEN, atol=1e-7)
    assert np.abs(motions(estimated.poses) - DRIVEN).max() < 2e-3
    for name, trajectory in (("a", out), ("b", "true"), ("c", out / "estimated.tum")):
        done = mitsonar("mosaic", rendered, trajectory, "-o", tmp_path / f"{name}.tif", "--cell-mm", 20)
        assert done.returncode == 0, done
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "c.tif").read_bytes()
    # the check can fail: a path that goes the other way makes another map
    back = path_of(-DRIVEN, Pose(*true.poses[0]), true.time_s)
    back.save_tum(tmp_path / "back.tum")
    assert mitsonar("mosaic", rendered, tmp_path / "back.tum", "-o", tmp_path / "d.tif", "--cell-mm", 20).returncode == 0
    similar = {}
    for name in ("a", "d"):
        one, second = in_common(tmp_path / f"{name}.tif", tmp_path / "b.tif")
        similar[name] = np.corrcoef(one, second)[0, 1], np.sqrt(np.mean((one - second) ** 2)) / second.std()
    assert similar["a"][0] > 0.9, similar
    assert similar["a"][1] < 0.4, similar
    assert similar["d"][0] < 0.7, similar


@pytest.mark.thorough
def test_the_pictures_are_pictures(mitsonar: Command, drawn: Path, tmp_path: Path) -> None:
    out = tmp_path / "odometry"
    assert mitsonar("odometry", drawn, "-o", out, "--estimator", "zero").returncode == 0
    done = mitsonar("mosaic", drawn, out, "-o", tmp_path / "map.png", "--blend", "centre", "--centre-beams", 40)
    assert done.returncode == 0, done
    assert "20 frames along the estimated path" in done.stdout
    for path in (out / "path.png", tmp_path / "map.png", tmp_path / "map.quality.png"):
        assert len(np.unique(np.array(Image.open(path)))) > 50
    refused(mitsonar("mosaic", drawn, "true", "-o", tmp_path / "map.png"), "exists and is kept", "--overwrite")
    assert mitsonar("mosaic", drawn, "true", "-o", tmp_path / "map.png", "--no-flatten", "--overwrite").returncode == 0


@pytest.mark.thorough
def test_sensors_and_loops_make_a_graph(mitsonar: Command, drawn: Path, tmp_path: Path) -> None:
    path = sway(20)
    save_sensors(tmp_path / "gyro.csv", simulated_sensors(path, SensorNoise(gyro_deg_rth=0.1)))
    command = ("odometry", drawn, "-o", tmp_path / "out", "--sensors", tmp_path / "gyro.csv", "--loops")
    done = mitsonar(*command)
    assert done.returncode == 0, done
    assert "sensors: gyroscope" in done.stdout
    result = table(tmp_path / "out")
    assert result["loops"] == 0
    assert abs(result["heading error at the end"]) < 0.05
    assert result["estimated standard deviation of the end"] > 0
    assert (tmp_path / "out" / "loops.csv").exists()
    (tmp_path / "bad.csv").write_text("time_s,yaw_rate\n0,1\n")
    refused(mitsonar("odometry", drawn, "-o", tmp_path / "no", "--sensors", tmp_path / "bad.csv"), "yaw_rate_deg_s")
    refused(mitsonar("odometry", drawn, "-o", tmp_path / "no", "--sensors", tmp_path / "none.csv"), "none.csv")
    refused(mitsonar("odometry", drawn, "-o", tmp_path / "no", "--loops", "--smooth", "kalman"), "smooth", "exclude")


@pytest.mark.thorough
def test_frames_without_geometry_are_told_it(mitsonar: Command, tmp_path: Path) -> None:
    """Height and pitch given on the command line lead to the motions that frames with both tell."""
    path = sway(8)
    frames = over_ground(path)
    frames.save(tmp_path / "known.npz")
    frames.poses = frames.height_m = None
    frames.save(tmp_path / "bare.npz")
    message = ["--height", 2.5, "--pitch-deg", 35]
    by = ["--estimator", "ecc"]  # direct also corrects for heave and lean that are unknown without poses
    assert mitsonar("odometry", tmp_path / "known.npz", *by, "-o", tmp_path / "known").returncode == 0
    done = mitsonar("odometry", tmp_path / "bare.npz", *by, "-o", tmp_path / "bare", *message, "--from", "1,-2,2.5,35,0,40")
    assert done.returncode == 0, done
    assert not (tmp_path / "bare" / "true.tum").exists()
    same = [(tmp_path / name / "estimated.tum").read_bytes() for name in ("known", "bare")]
    assert same[0] == same[1]
    maps: list[NDArray[np.float32]] = []
    for name, options in (("known", []), ("bare", []), ("bare", message)):
        out = tmp_path / f"{len(maps)}.tif"
        done = mitsonar("mosaic", tmp_path / f"{name}.npz", tmp_path / name, "-o", out, "--cell-mm", 20, *options)
        assert done.returncode == 0, done
        maps.append(bands(out)[0])
    np.testing.assert_allclose(maps[0], maps[1], atol=2e-5)  # files round the pitch
    np.testing.assert_allclose(maps[0], maps[2], atol=2e-5)
    refused(
        mitsonar("mosaic", tmp_path / "bare.npz", tmp_path / "bare" / "estimated.tum", "-o", tmp_path / "n.tif"), "--height"
    )
    refused(mitsonar("odometry", tmp_path / "bare.npz", "-o", tmp_path / "no"), "height")
    assert not (tmp_path / "no").exists()


@pytest.mark.thorough
def test_a_long_run_and_some_of_its_frames(mitsonar: Command, tmp_path: Path) -> None:
    """Every second frame of frames.zarr; the mosaic takes the frames that have a pose, and says how many have none."""
    as_zarr(over_ground(sway(12)), tmp_path / "frames.zarr")
    assert mitsonar("odometry", tmp_path, "-o", tmp_path / "out", "--every", 2, "--smooth", "spline").returncode == 0
    assert table(tmp_path / "out")["motions"] == 5
    done = mitsonar("mosaic", tmp_path / "frames.zarr", tmp_path / "out", "-o", tmp_path / "map.tif")
    assert done.returncode == 0, done
    assert "6 frames along the estimated path" in done.stdout
    assert "warning: left out without a pose at their time: 6 of 12 frames" in done.stderr


@pytest.mark.thorough
def test_what_is_not_believed_is_warned_of(mitsonar: Command, drawn: Path, tmp_path: Path) -> None:
    frames = SonarFrames.load(drawn)
    frames.image[10:13] = 0
    frames.save(tmp_path / "gap.npz")
    done = mitsonar("odometry", tmp_path / "gap.npz", "-o", tmp_path / "out", "--every", 2)
    assert done.returncode == 0, done
    assert "warning: 3 of 9 motions (33 %) were rejected and bridged" in done.stderr
    assert "3 invalid and bridged" in done.stdout
    frames.image[...] = 0
    frames.save(tmp_path / "dark.npz")
    refused(mitsonar("odometry", tmp_path / "dark.npz", "-o", tmp_path / "dark"), "none of 19 motions is valid")


# ---------------------------------------------------------------- kills and workers

SAME = (
    "estimated.tum",
    "true.tum",
    "motions.csv",
    "covariances.npz",
    "table.md",
    "table.json",
    "estimates.jsonl",
    "height_profile.csv",
)


@pytest.mark.posix
@pytest.mark.slow
def test_a_killed_odometry_resumes_to_the_same_files_with_any_workers(mitsonar: Command, tmp_path: Path) -> None:
    over_ground(sway(120)).save(tmp_path / "frames.npz")
    assert mitsonar("odometry", tmp_path, "-o", tmp_path / "whole", "--workers", 1).returncode == 0
    out = tmp_path / "killed"
    command = [sys.executable, "-m", "mitsonar", "odometry", str(tmp_path), "-o", str(out), "--workers", "1"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ)
    journal, done = out / "estimates.jsonl", 0
    deadline = time.monotonic() + 120
    while done < 16 and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.005)
        done = journal.read_bytes().count(b"\n") if journal.exists() else 0
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = journal.read_bytes().count(b"\n")
    assert 16 <= done < 119, done
    refused(mitsonar("odometry", tmp_path, "-o", out), "exists and is kept", "--resume")
    refused(mitsonar("mosaic", tmp_path, out, "-o", tmp_path / "map.png"), "not finished", "--resume")
    again = mitsonar("odometry", tmp_path, "-o", out, "--resume", "--workers", 2)
    assert again.returncode == 0, again
    one, two = files_of(tmp_path / "whole"), files_of(out)
    for name in SAME:
        assert one[name] == two[name], name
    assert json.loads(two["run.json"])["pairs_in_these_seconds"] == 119 - done


# ---------------------------------------------------------------- mistakes


def test_bad_frames_are_answered_by_one_sentence(mitsonar: Command, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.npz").write_text("no frames")
    frames = over_ground(sway(3))
    frames.select(slice(1)).save(tmp_path / "one.npz")
    still = over_ground(sway(3))
    still.time_s = np.zeros(3)
    still.save(tmp_path / "still.npz")
    nothing = frames.select(slice(0))
    nothing.save(tmp_path / "nothing.npz")
    refused(mitsonar("odometry", tmp_path / "none", "-o", out), "none")
    refused(mitsonar("odometry", tmp_path / "empty", "-o", out), "frames.npz")
    refused(mitsonar("odometry", tmp_path / "text.npz", "-o", out), "text.npz", "cannot read")
    refused(mitsonar("odometry", tmp_path / "one.npz", "-o", out), "two frames or more")
    refused(mitsonar("odometry", tmp_path / "still.npz", "-o", out), "times", "increase")
    refused(mitsonar("odometry", tmp_path / "nothing.npz", "-o", out), "no frames")
    refused(mitsonar("mosaic", tmp_path / "nothing.npz", "true", "-o", tmp_path / "m.png"), "no frames")
    refused(mitsonar("mosaic", tmp_path / "text.npz", "-o", tmp_path / "m.png"), "needs a path after the frames", "`true`")
    refused(mitsonar("mosaic", tmp_path / "text.npz", "true", "-o", tmp_path / "m.png"), "cannot read")
    assert not out.exists()


def test_bad_options_are_answered_by_one_sentence(mitsonar: Command, drawn: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    refused(mitsonar("odometry", drawn, "-o", out, "--estimator", "dirct"), "dirct", "direct")
    refused(mitsonar("odometry", drawn, "-o", out, "--estimator", "direct:heigth=2"), "heigth", "height_m")
    refused(mitsonar("odometry", drawn, "-o", out, "--smooth", "spine"), "spline")
    refused(mitsonar("odometry", drawn, "-o", out, "--scale", "1,2"), "--scale", "3 numbers")
    refused(mitsonar("odometry", drawn, "-o", out, "--from", "1,2"), "--from", "6 numbers")
    refused(mitsonar("odometry", drawn, "-o", out, "--every", 0), "--every")
    refused(mitsonar("odometry", drawn, "-o", out, "--closure", 1), "--closure must be 0, or 2")
    refused(mitsonar("odometry", drawn, "-o", out, "--smooth", "spline", "--loops"), "--smooth spline and a pose graph")
    refused(mitsonar("odometry", drawn, "-o", out, "--noise", "loud"), "noise", "low")
    refused(mitsonar("odometry", drawn, "-o", out, "--height", 2), "the frames have heights")
    refused(mitsonar("odometry", drawn, "-o", out, "--sequence", 1), "neither a data set")
    refused(mitsonar("odometry", drawn, "-o", out, "--overwrite", "--resume"), "contradict")
    refused(mitsonar("odometry", drawn, "-o", drawn), "is a file and is kept")
    refused(mitsonar("odometry", drawn, "-o", drawn, "--overwrite"), "is a file and is kept")
    assert not out.exists()


def test_a_map_of_one_frame_has_no_standard_deviation(mitsonar: Command, drawn: Path, tmp_path: Path) -> None:
    SonarFrames.load(drawn).select(slice(0, 1)).save(tmp_path / "one.npz")
    done = mitsonar("mosaic", tmp_path / "one.npz", "true", "-o", tmp_path / "map.tif", "--cell-mm", 40)
    assert done.returncode == 0, done.stderr
    assert "no cell is lit by two frames" in done.stdout


def test_a_bad_mosaic_is_answered_by_one_sentence(mitsonar: Command, drawn: Path, tmp_path: Path) -> None:
    out = tmp_path / "map.png"
    frames = SonarFrames.load(drawn)
    assert frames.poses is not None
    later = tmp_path / "later.tum"
    Trajectory(frames.poses, frames.time_s + 1000).save_tum(later)
    far = frames.poses.copy()
    far[-1, 0] += 1e5
    Trajectory(far, frames.time_s).save_tum(tmp_path / "far.tum")
    (tmp_path / "broken.tum").write_text("1 2 3\n")
    (tmp_path / "empty").mkdir()
    refused(mitsonar("mosaic", drawn, later, "-o", out), "no pose is within", "give the path of this run")
    refused(mitsonar("mosaic", drawn, tmp_path / "none.tum", "-o", out), "none.tum")
    refused(mitsonar("mosaic", drawn, tmp_path / "broken.tum", "-o", out), "line 1")
    refused(mitsonar("mosaic", drawn, tmp_path / "empty", "-o", out), "run.json")
    refused(mitsonar("mosaic", drawn, tmp_path / "far.tum", "-o", out), "look for a pose that is wrong")
    (tmp_path / "estimated").mkdir()
    (tmp_path / "estimated" / "run.json").write_text('{"kind": "odometry"}')
    refused(mitsonar("mosaic", tmp_path / "estimated", drawn, "-o", out), "frames first, the odometry second")
    refused(mitsonar("odometry", tmp_path / "estimated", "-o", out), "the folder of an odometry, which holds no frames")
    refused(mitsonar("mosaic", drawn, "true", "-o", tmp_path / "map.jpg"), ".png, .tif")
    refused(mitsonar("mosaic", drawn, "true", "-o", tmp_path / "no" / "map.png"), "no folder")
    refused(mitsonar("mosaic", drawn, "true", "-o", out, "--cell-mm", 0), "above 0")
    refused(mitsonar("mosaic", drawn, "true", "-o", out, "--blend", "center"), "centre")
    refused(mitsonar("mosaic", drawn, "true", "-o", out, "--true", later), "the same path")
    refused(mitsonar("mosaic", drawn, later, "-o", tmp_path / "map.tif", "--true", later), "figure")
    frames.image[...] = 0
    frames.save(tmp_path / "dark.npz")
    refused(mitsonar("mosaic", tmp_path / "dark.npz", "true", "-o", out), "lit ground")
    frames.poses = None
    frames.save(tmp_path / "bare.npz")
    refused(mitsonar("mosaic", tmp_path / "bare.npz", "true", "-o", out), "where the sonar was")
    assert not list(tmp_path.glob("*.png"))


@pytest.mark.slow
def test_odometry_and_mosaic_speak_the_convention_that_is_named(mitsonar: Command, drawn: Path, tmp_path: Path) -> None:
    """Paths are the same ones, the mosaic too; a folder remembers its own convention."""
    for frame in ("mitsonar", "ros-enu", "ned"):
        out = tmp_path / frame
        done = mitsonar("odometry", drawn, "-o", out, "--estimator", "zero", "--frame", frame)
        assert done.returncode == 0, done.stderr
        path = OdometryFolder.open(out).true
        assert path is not None
        poses = SonarFrames.load(drawn).poses
        assert poses is not None
        np.testing.assert_allclose(path.poses, poses, atol=1e-7)
        options = ["--frame", "mitsonar" if frame == "ned" else frame]  # which is for files, not for a folder
        done = mitsonar("mosaic", drawn, out, "-o", tmp_path / f"{frame}.tif", "--cell-mm", 20, *options)
        assert done.returncode == 0, done.stderr
        done = mitsonar(
            *("mosaic", drawn, out / "true.tum", "-o", tmp_path / f"{frame}-true.tif", "--cell-mm", 20, "--frame", frame)
        )
        assert done.returncode == 0, done.stderr
    for ending in (".tif", "-true.tif"):
        expected, _ = bands(tmp_path / f"mitsonar{ending}")
        for frame in ("ros-enu", "ned"):
            np.testing.assert_allclose(bands(tmp_path / f"{frame}{ending}")[0], expected, atol=1e-3)
    refused(
        mitsonar("mosaic", drawn, tmp_path / "ned" / "true.tum", "-o", tmp_path / "x.tif"),
        "is in the convention ned, but --frame is mitsonar",
    )
    refused(mitsonar("odometry", drawn, "-o", tmp_path / "y", "--frame", "nde"), "unknown frame 'nde'", "did you mean ned?")


@pytest.mark.slow
def test_a_local_map_resumes_to_the_same_bits(mitsonar: Command, drawn: Path, tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    done = mitsonar("odometry", drawn, "--map", "-o", whole)
    assert done.returncode == 0, done
    assert "motions by the local map" in done.stdout
    assert mitsonar("odometry", drawn, "-o", cut).returncode == 0
    lines = (cut / "estimates.jsonl").read_bytes().splitlines(keepends=True)
    (cut / "estimates.jsonl").write_bytes(b"".join(lines[:7]))
    done = mitsonar("odometry", drawn, "--map", "-o", cut, "--resume")
    assert done.returncode == 0, done
    assert (cut / "estimated.tum").read_bytes() == (whole / "estimated.tum").read_bytes()
