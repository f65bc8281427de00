"""Estimators on unseen scenes: 1,000 pairs of rocky fields and of ship hulls, both models, all noise levels, perturbed rows.

    python benchmarks/bench_compare.py --out bench [--pairs 1000] [--perturbed 200] [--only rocky-field]

Makes the data sets, one pair a sequence, and runs `mitsonar compare` on each; what is there is kept, so that a run that was
broken off goes on. About three hours on two cores; the tables lie in OUT/*/table.md. `--quick` does one set with two pairs.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
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
SMALL = ("scenes=[{count: 2, sequences: 4, world: {size_m: 20, a_side: [8, 12]}}]", "sonar.rays_per_beam=200")
"""What `--quick` changes in a recipe of rocky fields."""

PERTURBED = "zero,ecc,flow,direct,direct:heave_std_m=0.01"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("bench"))
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--perturbed", type=int, default=200, help="pairs of the perturbed rows; 0: none")
    parser.add_argument("--only", choices=SETS)
    parser.add_argument("--quick", action="store_true", help="two pairs of one set, kept nowhere: within a minute")
    arguments = parser.parse_args()
    if not arguments.quick:
        return compare_all(arguments)
    with tempfile.TemporaryDirectory() as folder:
        few = {"out": Path(folder), "pairs": 2, "perturbed": 2, "only": "rocky-field"}
        compare_all(argparse.Namespace(**{**vars(arguments), **few}))


def compare_all(arguments: argparse.Namespace) -> None:
    """Make the data sets and compare the estimators on each."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in [arguments.only] if arguments.only else SETS:
        data = arguments.out / f"{name}.zarr"
        changes = (*(SMALL if arguments.quick else (SETS[name],)), "flight.pings=2")
        sets = [word for change in changes for word in ("--set", change)]
        run("dataset", "make", name, *sets, "--seed", SEED, "-o", data)
        common = (data, "--part", "all", "--reference", "direct")
        levels = ("--noise", "high" if arguments.quick else "none,low,high", "--limit", min(10, arguments.pairs))
        run(
            "compare",
            *common,
            *levels,
            "--prior",
            "--estimators",
            METHODS,
            "--pairs",
            arguments.pairs,
            "-o",
            arguments.out / name,
        )
        if arguments.perturbed:
            few: tuple[object, ...] = ("--pairs", arguments.perturbed, "--noise", "none", "--limit", 0, "--perturb")
            few += () if name.endswith("physical") else ("--jitter",)  # the physical model's rays move already
            run("compare", *common, *few, "--estimators", PERTURBED, "-o", arguments.out / f"{name}-perturbed")


def run(*words: object) -> None:
    """Run a command of mitsonar on one core."""
    command = [sys.executable, "-m", "mitsonar", *map(str, words)]
    print("$ mitsonar", *map(str, words), flush=True)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    subprocess.run(command, check=True, env=environment)


if __name__ == "__main__":
    main()
