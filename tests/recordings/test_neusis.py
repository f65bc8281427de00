"""Views in pickles: poses, side, values; and pickles that would run something are refused before they do."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mutations import changed_bytes, outcome
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsonar import MitsonarError, open_recording
from mitsonar.recordings.public_sets import read_pickled_arrays

CONFIG = {"Azimuth": 60, "Elevation": 12, "RangeMin": 0.5, "RangeMax": 4.5}

USUAL, MANY = 300, 10_000
"""Mutants of a pickle in the test that is always run, and in the slow one."""


def written(path: Path, protocol: int = 4, scale: float = 1.0) -> NDArray[np.float32]:
    (path / "Data").mkdir(parents=True)
    sensors = [{"sensor_type": "PoseSensor"}, {"sensor_type": "ImagingSonar", "configuration": CONFIG}]
    (path / "Config.json").write_text(json.dumps({"agents": [{"sensors": sensors}]}))
    images = (np.random.default_rng(8).random((12, 20, 16)) * scale).astype(np.float32)
    for k, image in enumerate(images):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("ZY", [10 * k, 30], degrees=True).as_matrix()  # to port, nose down
        pose[:3, 3] = (k, 2 * k, 3)
        (path / f"Data/{k}.pkl").write_bytes(pickle.dumps({"ImagingSonar": image, "PoseSensor": pose, "t": 3.5}, protocol))
    return images


@pytest.mark.parametrize("protocol", range(6))
def test_views_become_frames_with_poses(tmp_path: Path, protocol: int) -> None:
    images = written(tmp_path, protocol)
    recording = open_recording(tmp_path)
    assert (recording.format, len(recording)) == ("views (neusis)", 12)
    frames = recording.part().read(np.arange(12))
    assert (frames.image == images[:, :, ::-1]).all()
    assert frames.range_m[[0, -1]] == pytest.approx([0.6, 4.4])
    assert np.degrees(frames.bearing_rad[-1]) == pytest.approx(30 - 60 / 32)
    assert frames.poses is not None
    assert frames.poses[:, :3] == pytest.approx(np.column_stack([np.arange(12), 2 * np.arange(12), np.full(12, 3)]))
    assert np.degrees(frames.poses[:, 3]) == pytest.approx(30)
    forward = np.column_stack([np.sin(frames.poses[:, 5]), np.cos(frames.poses[:, 5])])
    angle = np.radians(10 * np.arange(12))
    assert forward == pytest.approx(np.column_stack([np.cos(angle), np.sin(angle)]))


def test_values_above_one_are_divided_by_the_largest(tmp_path: Path) -> None:
    images = written(tmp_path, scale=3.0)
    recording = open_recording(tmp_path)
    assert any("values reach 2.99" in note for note in recording.notes)
    assert "views have no times: they are ordered by name, at an assumed 10 Hz" in recording.notes
    assert recording.part().read([4]).image[0] == pytest.approx(images[4][:, ::-1] / images.max())


class Bomb:
    """What a hostile pickle holds: a call."""

    def __init__(self, call: Any, *arguments: Any) -> None:
        self.call, self.arguments = call, arguments

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return self.call, self.arguments


@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize("call", [os.system, eval, getattr, np.load, Path.touch])
def test_calls_in_pickles_are_refused(tmp_path: Path, call: Any, protocol: int) -> None:
    mark = tmp_path / "mark"
    arguments = (mark,) if call is Path.touch else (f"touch {mark}",)
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"ImagingSonar": Bomb(call, *arguments)}, protocol))
    with pytest.raises(MitsonarError, match="which is not part of an array"):
        read_pickled_arrays(tmp_path / "a.pkl")
    assert not mark.exists()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x80\x04.",
        pickle.dumps([1, 2]),
        pickle.dumps({"a": np.array([object()], dtype=object)}),
        b"cnumpy\nndarray\n(dS'__init__'\nS'x'\nsb.",  # a state for a class
        b"\x80\x02r\xff\xff\xff\x7f.",  # a memo of 2^31 places
        b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\x00\x00a.",  # 2^48 bytes
        b"\x80\x02" + b"]" * 5000 + b"a" * 4999 + b".",
    ],
)
def test_other_pickles_are_refused_or_hold_nothing(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.pkl").write_bytes(content)
    try:
        result = read_pickled_arrays(tmp_path / "a.pkl")
    except MitsonarError:
        return
    assert result == {}


def test_sizes_of_arrays_are_checked_against_their_bytes(tmp_path: Path) -> None:
    good = pickle.dumps({"a": np.arange(6, dtype=np.float32).reshape(2, 3)}, 2)
    assert good.count(b"K\x02K\x03\x86") == 1
    for shape in (b"K\x02K\x04\x86", b"J\xff\xff\xff\x7fK\x03\x86", b"K\x02J\xff\xff\xff\xff\x86"):
        (tmp_path / "a.pkl").write_bytes(good.replace(b"K\x02K\x03\x86", shape))
        with pytest.raises(MitsonarError, match="shape"):
            read_pickled_arrays(tmp_path / "a.pkl")
    (tmp_path / "a.pkl").write_bytes(good)
    assert read_pickled_arrays(tmp_path / "a.pkl")["a"].tolist() == [[0, 1, 2], [3, 4, 5]]


def test_faults_of_a_folder_are_one_sentence(tmp_path: Path) -> None:
    written(tmp_path)
    view = tmp_path / "Data/3.pkl"
    for value, reason in [
        ({"PoseSensor": np.eye(4)}, "lacks ImagingSonar"),
        ({"ImagingSonar": np.ones((3, 4)), "PoseSensor": np.eye(4)}, "the others"),
        ({"ImagingSonar": np.full((20, 16), np.nan), "PoseSensor": np.eye(4)}, "finite values"),
        ({"ImagingSonar": np.ones((20, 16)), "PoseSensor": np.eye(3)}, "matrix"),
        ({"ImagingSonar": np.ones((20, 16)), "PoseSensor": 2 * np.eye(4)}, "no rotation"),
    ]:
        view.write_bytes(pickle.dumps(value))
        with pytest.raises(MitsonarError, match=reason):
            open_recording(tmp_path)
    (tmp_path / "Config.json").write_text('{"agents": [{"sensors": [3]}]}')
    with pytest.raises(MitsonarError, match="no sensor of type ImagingSonar"):
        open_recording(tmp_path)


def attacked(folder: Path, seeds: range) -> dict[str, int]:
    """How many mutants of a pickle are read and refused."""
    written(folder)
    path = folder / "Data/5.pkl"
    good = path.read_bytes()
    result = {"read": 0, "refused": 0}
    for seed in seeds:
        path.write_bytes(changed_bytes(np.random.default_rng(seed), good))
        result[outcome(lambda: read_pickled_arrays(path))] += 1
    return result


def test_mutants_are_read_or_refused(tmp_path: Path) -> None:
    assert min(attacked(tmp_path, range(USUAL)).values()) > 0


@pytest.mark.slow
def test_ten_thousand_mutants(tmp_path: Path) -> None:
    assert min(attacked(tmp_path, range(USUAL, MANY)).values()) > 0
