"""XTF files of side-scans: their bytes by the format's own offsets, and a reader of another package."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sounder import load_sounder
from mitsonar.recordings.write_xtf import write_xtf
from mitsonar.records.soundings import Echogram


def echogram(instrument: str = "sidescan", bins: int = 50) -> Echogram:
    """Three pings whose levels grow along range and differ by side."""
    sounder = load_sounder(instrument).replace(range_min=1.5, range_max=31.5, range_bins=bins)
    poses = np.array([[1.0, 2.0, -3.0, 0.05, 0.02, 0.3]] * 3)
    poses[:, 1] += [0, 0.5, 1.0]
    levels = np.ones((3, len(sounder.channels), bins)) * np.arange(1, bins + 1) ** 2
    levels[:, 1:] *= 0.25
    return Echogram(np.array([10.0, 10.5, 11.0]), poses, sounder, levels.astype(np.float32), np.full(3, 7.5))


def test_bytes_lie_where_the_format_has_them(tmp_path: Path) -> None:
    path = tmp_path / "line.xtf"
    write_xtf(path, echogram())
    data = path.read_bytes()
    assert data[0] == 0x7B
    assert struct.unpack_from("<H", data, 166) == (2,)
    magic, kind, _, channels, size = struct.unpack_from("<HBBH4xI", data, 1024)
    assert (magic, kind, channels) == (0xFACE, 0, 2)
    assert size % 64 == 0
    assert len(data) == 1024 + 3 * size
    assert struct.unpack_from("<dd", data, 1024 + 160) == (2.0, 1.0)
    assert struct.unpack_from("<f", data, 1024 + 196)[0] == pytest.approx(7.5)
    port = np.frombuffer(data, "<u2", 50, 1024 + 256 + 64)
    starboard = np.frombuffer(data, "<u2", 50, 1024 + 256 + 64 + 100 + 64)
    assert port[0] == 32767
    assert np.all(np.diff(port.astype(int)) < 0)  # outermost first
    assert starboard[-1] == round(32767 / 2)


def test_another_reader_reads_it(tmp_path: Path) -> None:
    pyxtf = pytest.importorskip("pyxtf")
    write_xtf(tmp_path / "line.xtf", echogram())
    _, packets = pyxtf.xtf_read(str(tmp_path / "line.xtf"))
    pings = packets[pyxtf.XTFHeaderType.sonar]
    assert [one.data[0].shape for one in pings] == [(50,)] * 3
    assert pings[0].ping_chan_headers[1].SlantRange == pytest.approx(31.5)
    second = pings[1]
    assert (second.SensorXcoordinate, second.SensorYcoordinate, second.SensorDepth) == (1.0, 2.5, 3.0)
    assert (second.Second, second.HSeconds, second.AttitudeTimeTag) == (10, 50, 500)
    assert second.SensorHeading == pytest.approx(np.degrees(0.3))


def test_only_side_scans_are_written(tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match="hold side-scans"):
        write_xtf(tmp_path / "line.xtf", echogram("altimeter"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("first", [-5.0, 7.2581184e9, 5e11])
def test_times_without_a_date_are_refused(tmp_path: Path, first: float) -> None:
    """Datetime ended with a traceback at 5e11 s, and no reader takes a year before 1970."""
    pings = echogram()
    with pytest.raises(MitsonarError, match="seconds since 1970, to the year 2200: got "):
        write_xtf(tmp_path / "line.xtf", replace(pings, time_s=pings.time_s - pings.time_s[0] + first))
    assert not list(tmp_path.iterdir())
