"""A run's memory does not grow with its frames."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).parents[2] / "benchmarks" / "bench_render.py"


@pytest.mark.slow
def test_memory_is_flat_from_a_hundred_frames_to_thousands() -> None:
    peaks = []
    for frames in (100, 3000):
        command = [sys.executable, str(BENCH), "--frames-memory", str(frames), "100"]
        done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=900)
        peaks.append(json.loads(done.stdout)["peak MiB"])
    assert peaks[1] < 1.1 * peaks[0] + 20, peaks
