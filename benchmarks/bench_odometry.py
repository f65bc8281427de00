"""The public odometry benchmark: `mitsonar benchmark odometry` on the simulated sets and on recordings.

    python benchmarks/bench_odometry.py [--out out/odometry] [--noise none,high] [--recordings FOLDER] [--workers 1]
    python benchmarks/bench_odometry.py --quick           # six frames of one set, four methods, kept nowhere

FOLDER holds the recordings of docs/guides/recordings.md (default: the variable MITSONAR_RECORDINGS; without it only
simulated sets are run). A stopped benchmark goes on. The tables lie in OUT/simulated and OUT/recorded.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from real_recordings import FOLDER, recordings_folder

GEOMETRIES = Path(__file__).resolve().parents[1] / "tests/recordings/geometries"
"""Geometry files of pictures that do not tell theirs, by the name of the pictures."""

RECORDED = (
    "marine-debris-aris3000/forward_chain.npz",
    "marine-debris-aris3000/translate_tyre.npz",
    "didson-static-video/lamprey2_first30.npz",
    "didson-static-video/lamprey4_first30.npz",
    "aris1200-sdk-sample/sample.aris",
    "oculus-m1200d-three-pings/three_pings_8bit.raw",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/odometry"))
    parser.add_argument("--noise", default="none,high")
    parser.add_argument("--recordings")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="six frames of one set, four methods: within a minute")
    arguments = parser.parse_args()
    if arguments.quick:
        with tempfile.TemporaryDirectory() as scratch:
            few = [word for name in ("zero", "ecc", "flow", "direct") for word in ("--method", name)]
            return run(Path(scratch), "--set", "hull", "--texture", "still", "--frames", 6, "--bound", 1, *few)
    levels = [word for level in arguments.noise.split(",") for word in ("--noise", level)]
    run(arguments.out / "simulated", *levels, "--workers", arguments.workers)
    folder = recordings_folder(arguments.recordings)
    if folder is None:
        print(f"no recordings: give --recordings or the variable {FOLDER}")
        return None
    for name in RECORDED:
        message = GEOMETRIES / f"{Path(name).stem.removesuffix('_first30')}.yaml"
        run(arguments.out / "recorded", "--set", folder / name, *(["--geometry", message] if message.exists() else []))
    return None


def run(out: Path, *words: object) -> None:
    """Run the command on one thread a process; a folder that is there goes on."""
    command = [sys.executable, "-m", "mitsonar", "benchmark", "odometry", *map(str, words), "-o", str(out), "--resume"]
    print("$ mitsonar", *command[3:], flush=True)
    subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"})


if __name__ == "__main__":
    main()
