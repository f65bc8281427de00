"""Estimators on unseen scenes: 1,000 pairs of rocky fields and of ship hulls, both models, all noise levels, perturbed rows.

    python benchmarks/bench_compare.py --out bench [--pairs 1000] [--perturbed 200] [--only rocky-field]

Makes the data sets, one pair a sequence, and runs `mitsonar compare` on each; what is there is kept, so that a run that was
broken off goes on. About three hours on two cores; the tables lie in OUT/*/table.md.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

FIELDS = "scenes=[{count: 20, sequences: 17, world: {size_m: 30}},{count: 33, sequences: 20, world: {size_m: 50}}]"
HULLS = "scenes=[{count: 50, sequences: 20}]"
SETS = {
    "rocky-field": FIELDS,
    "rocky-field-physical": FIELDS,
    "ship-hull": HULLS,
    "ship-hull-physical": HULLS,
}
SEED = 4101  # not that of any recipe: scenes that no training has seen

METHODS = "zero,ecc,flow,phase,direct"
PERTURBED = "zero,ecc,flow,direct,direct:heave_std_m=0.01"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("bench"))
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--perturbed", type=int, default=200, help="pairs of the perturbed rows; 0: none")
    parser.add_argument("--only", choices=SETS)
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    for name in [asked.only] if asked.only else SETS:
        data = asked.out / f"{name}.zarr"
        run("dataset", "make", name, "--set", SETS[name], "--set", "flight.pings=2", "--seed", SEED, "-o", data)
        common = (data, "--part", "all", "--reference", "direct")
        levels = ("--noise", "none,low,high", "--limit", 10)
        run("compare", *common, *levels, "--prior", "--estimators", METHODS, "--pairs", asked.pairs, "-o", asked.out / name)
        if asked.perturbed:
            few = ("--pairs", asked.perturbed, "--noise", "none", "--limit", 0, "--perturb")
            few += () if name.endswith("physical") else ("--jitter",)  # the physical model's rays move already
            run("compare", *common, *few, "--estimators", PERTURBED, "-o", asked.out / f"{name}-perturbed")


def run(*words: object) -> None:
    """A command of mitsonar on one core."""
    command = [sys.executable, "-m", "mitsonar", *map(str, words)]
    print("$ mitsonar", *map(str, words), flush=True)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    subprocess.run(command, check=True, env=environment)


if __name__ == "__main__":
    main()
