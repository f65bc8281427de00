"""Calibration with level ground: whether known instruments come back, and what real recordings give.

    python benchmarks/bench_calibration.py [--draws 6] [--recordings FOLDER] [--json FILE]

*simulated*: sonars whose taper, width over elevation, absorption and crosstalk differ from their data sheets by chance, over
level ground of one material, of patches, and with rocks. Eight coherent frames from different heights and pitches, whose
poses err by a common height and pitch. Root mean square errors, their ratio to the stated standard deviations (1 is
consistent), and what frames that were not fitted say: gain of the log likelihood of a block over the sonar of `sonar fit`.
*recordings*: the same of real frames, or why they are refused. `--quick` takes one sonar and one draw.
"""

from __future__ import annotations

import argparse
import json
import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from real_recordings import RECORDINGS, recordings_folder

from mitsonar.acoustics.water import sonar_absorption
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.estimation.calibration import Calibration, calibrate_sonar
from mitsonar.instruments.sonar import crosstalk_amplitude
from mitsonar.instruments.sounder import load_sonar
from mitsonar.io.files import write_atomic
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.device import ensure_variant
from mitsonar.simulation.simulator import Simulator

Array = NDArray[np.float64]

SONARS = {
    "didson300": {"range_min": 1.0, "range_max": 9.0},
    "oculus-m750d-750khz": {"range_min": 1.0, "range_max": 12.0},
    "blueview-p900-45": {"range_min": 1.0, "range_max": 12.0},
}
"""Presets, and the window from which the ground is seen."""

PLACES = ((1.5, 20), (1.5, 20), (2.0, 30), (2.0, 30), (2.6, 25), (2.6, 25), (1.8, 15), (1.8, 15))
"""Height [m] and pitch [deg] of each frame."""

FIELDS = {"taper_db": 1, "elevation_fov_deg": 0, "height_m": 0, "pitch_deg": 1, "absorption_db_per_m": 0, "crosstalk_db": 1}
"""Parameters: 1 for an error in their unit, 0 for a relative one."""

LEAK_DB = (-25.0, -12.0)
"""Power that leaks into the middle beam from all others, relative to theirs [dB]: the least and the most."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=6, help="instruments of each row")
    parser.add_argument("--recordings", help="folder of the recordings (default: MITSONAR_RECORDINGS)")
    parser.add_argument("--json", type=Path, help="file to write the rows to")
    parser.add_argument("--quick", action="store_true", help="one sonar, one draw: within a minute")
    arguments = parser.parse_args()
    ensure_variant()
    warnings.simplefilter("ignore", MitsonarWarning)
    tables: dict[str, list[list[str]]] = {"simulated": [], "recordings": []}
    for sonar in list(SONARS)[: 1 if arguments.quick else None]:
        for ground in list(GROUNDS)[: 1 if arguments.quick else None]:
            tables["simulated"].append(simulated_row(sonar, ground, 1 if arguments.quick else arguments.draws))
            print(" | ".join(tables["simulated"][-1]), flush=True)
    folder = recordings_folder(arguments.recordings)
    if folder is not None and not arguments.quick:
        for name, read in RECORDINGS.items():
            tables["recordings"].append(recorded_row(name, read, folder))
            print(" | ".join(tables["recordings"][-1]), flush=True)
    if arguments.json:
        write_atomic(arguments.json, json.dumps(tables, indent=1).encode())


# ---------------- Grounds


def even() -> Any:
    """Return level ground of one reflectivity."""
    return ground({"type": "rgb", "value": 0.3})


def patches() -> Any:
    """Return level ground whose reflectivity varies by 2 dB (standard deviation) over half a metre."""
    return ground({"type": "perlin", "cells": 160.0, "octaves": 1, "low": 0.1, "high": 0.5})


def ground(reflectance: dict[str, Any], **shapes: Any) -> Any:
    """Return level ground of a texture, and other shapes."""
    import mitsuba as mi

    floor = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale(40),
        "bsdf": {"type": "diffuse", "reflectance": reflectance},
    }
    return mi.load_dict({"type": "scene", "floor": floor, **shapes})


def rocks() -> Any:
    """Return level ground with 200 balls of 0.1 m, half of which lies in the ground."""
    import mitsuba as mi

    place = np.random.default_rng(6).uniform(-20, 20, (200, 2))
    balls = {
        f"rock{k}": {"type": "sphere", "center": mi.ScalarPoint3f(x, y, 0), "radius": 0.1} for k, (x, y) in enumerate(place)
    }
    return ground({"type": "rgb", "value": 0.3}, **balls)


GROUNDS: dict[str, Callable[[], Any]] = {"even": even, "patches": patches, "rocks": rocks}
"""Scenes by name."""


# ---------------- Rows


def simulated_row(name: str, ground_name: str, draws: int) -> list[str]:
    """Return the row of a sonar over a ground."""
    sheet = load_sonar(name).replace(**SONARS[name], gain_absorption=False)
    scene = GROUNDS[ground_name]()
    error: dict[str, list[float]] = {field: [] for field in FIELDS}
    ratio: dict[str, list[float]] = {field: [] for field in FIELDS}
    gains, refused = [], 0
    for draw in range(draws):
        rng = np.random.default_rng([draw, len(name), len(ground_name)])
        true = {
            "taper_db": float(rng.uniform(1, 5)),
            "elevation_fov_deg": sheet.elevation_fov_deg * float(rng.uniform(0.85, 1.15)),
            "absorption_db_per_m": sonar_absorption(sheet) * float(rng.uniform(0.7, 1.3)),
        }
        leak = np.square(crosstalk_amplitude(sheet, 0.0)).sum(axis=0).max()
        off = np.array([0, 0, rng.normal(0, 0.1), math.radians(rng.normal(0, 1.5)), 0, 0])
        at = [
            [*rng.uniform(-10, 10, 2), height, math.radians(pitch), 0, rng.uniform(0, 2 * math.pi)]
            for height, pitch in PLACES
        ]
        poses = np.array(at)
        true["crosstalk_db"] = float(rng.uniform(*LEAK_DB)) - 10 * math.log10(leak)
        frames = Simulator(scene, sheet.replace(**true, seed=draw)).render(poses)
        frames = replace(frames, sonar=sheet, poses=poses + off)
        true |= {
            "height_m": float(np.median(poses[:, 2])),
            "pitch_deg": math.degrees(np.median(poses[:, 3])),
        }
        try:
            result = calibrate_sonar(frames, sheet)
        except MitsonarError:
            refused += 1
            continue
        for field, absolute in FIELDS.items():
            one = result.parameters[field]
            if one.determined:
                error[field].append((one.value - true[field]) / (1.0 if absolute else true[field] / 100))
                ratio[field].append((one.value - true[field]) / one.std)
        gains.append(likelihood_gain(result))
    cells = []
    for field in FIELDS:
        spread = f"{rms(error[field]):.2f} ({rms(ratio[field]):.1f})" if error[field] else "-"
        cells.append(spread + (f", {len(error[field])}" if 0 < len(error[field]) < draws else ""))
    return [name, ground_name, f"{draws - refused} of {draws}", *cells, f"{np.median(gains):+.2f}" if gains else "-"]


def likelihood_gain(result: Calibration) -> float:
    """Return the gain of the log likelihood of a block over `sonar fit`, in frames that were not fitted."""
    assert result.held_out is not None
    return result.held_out["calibrated"][0] - result.held_out["sonar fit"][0]


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def recorded_row(name: str, read: Callable[[Path], SonarFrames], folder: Path) -> list[str]:
    """Return what a recording gives, or why it is refused."""
    frames = read(folder)
    try:
        result = calibrate_sonar(frames)
    except MitsonarError as error:
        return [name, str(len(frames)), f"refused: {error}", "-", "-"]
    known = [
        f"{field} {one.value:.3g} +- {one.std:.2g}" for field, one in result.parameters.items() if one.determined and one.std
    ]
    assert result.held_out is not None
    calibrated, fitted = result.held_out["calibrated"], result.held_out["sonar fit"]
    errors = f"{fitted[1]:.2f} to {calibrated[1]:.2f}"
    return [name, str(len(frames)), ", ".join(known), f"{likelihood_gain(result):+.2f}", errors]


if __name__ == "__main__":
    main()
