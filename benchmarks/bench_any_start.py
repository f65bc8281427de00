"""Estimators from any start: pairs of rocky fields up to 250 mm and 6 deg apart, with 29 and 130 deg of view.

    python benchmarks/bench_any_start.py --out bench [--pairs 60] [--only narrow-near]

Makes the data sets (physical model, one pair a sequence, scenes that no training has seen) and runs `mitsonar compare` on
each. What is there is kept, so that a run that was broken off goes on. About half an hour on one core; the tables lie in
OUT/*/table.md. `--quick` compares two pairs of one small set.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from bench_compare import run

SEED = 4201
FAR = ("flight.sideways_mm=250", "flight.forward_mm=250", "flight.yaw_deg=6")
WIDE = ("sonar.preset=oculus-m750d-750khz",)
SETS: dict[str, tuple[str, ...]] = {"narrow-near": (), "narrow": FAR, "wide-near": WIDE, "wide": (*FAR, *WIDE)}
"""Changes of the recipe rocky-field-physical: a DIDSON of 29 deg or an Oculus of 130 deg, motions of 20 mm or 250 mm."""

METHODS = "phase,direct,corrnet"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("bench"))
    parser.add_argument("--pairs", type=int, default=60)
    parser.add_argument("--only", choices=SETS)
    parser.add_argument("--quick", action="store_true", help="two pairs of one set, kept nowhere: within a minute")
    arguments = parser.parse_args()
    if not arguments.quick:
        return compare_all(arguments.out, arguments.pairs, [arguments.only] if arguments.only else list(SETS), "none,high")
    with tempfile.TemporaryDirectory() as folder:
        compare_all(Path(folder), 2, ["narrow"], "none", world="size_m: 20, a_side: [8, 12]")


def compare_all(out: Path, pairs: int, names: list[str], noise: str, world: str = "size_m: 30") -> None:
    """Make the data sets and compare the estimators on each."""
    out.mkdir(parents=True, exist_ok=True)
    scenes = min(4, pairs // 2)
    fields = f"scenes=[{{count: {scenes}, sequences: {-(-pairs // scenes)}, world: {{{world}}}}}]"
    for name in names:
        data = out / f"{name}.zarr"
        changes = [word for change in (fields, "flight.pings=2", *SETS[name]) for word in ("--set", change)]
        run("dataset", "make", "rocky-field-physical", *changes, "--seed", SEED, "-o", data)
        words = ("--part", "all", "--noise", noise, "--limit", 0, "--pairs", pairs, "--reference", "direct")
        run("compare", data, *words, "--estimators", METHODS, "-o", out / name)


if __name__ == "__main__":
    main()
