"""Folders that PINGVerter writes from logs of Humminbird, Lowrance and others: frames in JSON, samples of two bytes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_files import pingverter_folder, side_scan_echogram

import mitsonar
from mitsonar.errors import MitsonarError
from mitsonar.motion.utm import UtmOrigin
from mitsonar.records.soundings import Echogram

ORIGIN = UtmOrigin(16, False, 512724.0, 4365826.0)


@pytest.fixture
def written() -> Echogram:
    return side_scan_echogram(pings=12, origin=ORIGIN)


def frames(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]


def replace_frames(folder: Path, changed: list[dict[str, Any]]) -> None:
    (folder / "frames.jsonl").write_text("".join(json.dumps(frame) + "\n" for frame in changed))


@pytest.mark.parametrize("reversed_port", [False, True])
def test_a_log_is_read_whatever_the_order_of_port(tmp_path: Path, written: Echogram, reversed_port: bool) -> None:
    """Samples of 8 bits, expanded to 16: within half a step of amplitude."""
    pingverter_folder(tmp_path / "log", written, reversed_port=reversed_port)
    recording = mitsonar.open_side_scan(tmp_path / "log")
    read = recording.part().read()
    largest = np.sqrt(written.levels.max())
    np.testing.assert_allclose(np.sqrt(read.levels), np.sqrt(written.levels) / largest, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(read.time_s, written.time_s, atol=1e-6)
    np.testing.assert_allclose(read.poses[:, :2], written.poses[:, :2], atol=1e-5)
    np.testing.assert_allclose(read.poses[:, 5], written.poses[:, 5], atol=1e-5)
    np.testing.assert_allclose(read.height_m, written.height_m)
    np.testing.assert_allclose(read.range_m, written.range_m)
    assert read.sounder.fan.frequency_hz == 455e3
    assert any("turned" in note for note in recording.notes) == reversed_port


def test_frames_that_lack_something_are_counted(tmp_path: Path, written: Echogram) -> None:
    folder = tmp_path / "log"
    pingverter_folder(folder, written)
    listed = frames(folder)
    listed[1]["channels"].pop()
    for side in listed[2]["channels"]:
        side["maxRangeMeters"] = None
    listed[3]["channels"][1]["sampleOffset"] = 10**9
    listed[4]["channels"][0]["sampleCount"] = "many"
    listed[5]["channels"] = 7
    replace_frames(folder, listed)
    with (folder / "frames.jsonl").open("a") as file:
        file.write("{cut off")
    recording = mitsonar.open_side_scan(folder)
    assert len(recording) == 7
    assert "left out: 2 frames without both sides or a range" in recording.notes
    assert "left out: 4 frames that are damaged" in recording.notes


def test_what_is_missing_is_named(tmp_path: Path, written: Echogram) -> None:
    folder = tmp_path / "log"
    pingverter_folder(folder, written)
    manifest = json.loads((folder / "manifest.json").read_text())
    for change, says in (
        ({"samples": {"encoding": "float32"}}, "no samples of uint16-le"),
        ({"channels": manifest["channels"][:1]}, "no side-scan channel starboard"),
        ({"channels": [manifest["channels"][0], {**manifest["channels"][0], "orientation": "Starboard"}]}, "starboard"),
    ):
        (folder / "manifest.json").write_text(json.dumps({**manifest, **change}))
        with pytest.raises(MitsonarError, match=says):
            mitsonar.open_side_scan(folder)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    replace_frames(folder, [])
    with pytest.raises(MitsonarError, match="holds no ping of port and starboard with a range"):
        mitsonar.open_side_scan(folder)
