"""Memory does not grow with frames, nor with scenes."""

from __future__ import annotations

import gc
import json
import subprocess
import sys
import weakref
from pathlib import Path

import numpy as np
import pytest

from mitsonar import Simulator, Sonar, load_scene

BENCH = Path(__file__).parents[2] / "benchmarks" / "bench_render.py"


@pytest.mark.slow
def test_memory_is_flat_from_a_hundred_frames_to_thousands() -> None:
    peaks = []
    for frames in (100, 3000):
        command = [sys.executable, str(BENCH), "--frames-memory", str(frames), "100"]
        done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=900)
        peaks.append(json.loads(done.stdout)["peak MiB"])
    assert peaks[1] < 1.1 * peaks[0] + 20, peaks


@pytest.mark.parametrize("model", ["physical", "coherent"])
def test_what_a_simulator_has_compiled_goes_with_it(model: str) -> None:
    """Without waiting for Python's garbage collection: the code of scenes that linger is part of every later kernel."""
    sonar = Sonar(beams=4, range_bins=16, rays_per_beam=8, rays_across=1, range_max=30, frequency_hz=1e6, model=model)
    gc.disable()
    try:
        simulator = Simulator(load_scene("pattern"), sonar)
        simulator.render(np.array([[0.0, 0.0, 2.0, 0.5, 0.0, 0.0]]))
        stored = weakref.ref(simulator.tracer)
        del simulator
        assert stored() is None
    finally:
        gc.enable()
