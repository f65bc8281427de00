"""Networks beside methods without training: the same 1,000 pairs of unseen scenes, and geometries that no network saw.

    python benchmarks/bench_networks.py --out bench --networks out/posenet [--pairs 1000]

Takes the data sets of `bench_compare.py` (made where they are missing), and makes others: heights of 1.5 to 6 m, pitches of
20 and 50 deg, another sonar, hulls. What is there is kept, so that a run that was broken off goes on. The tables lie in
OUT/networks-*/table.md. `--quick` does two sets with two pairs each.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from bench_compare import SEED, SETS, SMALL, run

HOME = ("rocky-field", "rocky-field-physical")
FEW = "scenes=[{count: 20, sequences: 10, world: {size_m: 30}}]"
FIELD = ("rocky-field", FEW, "flight.pings=2", "flight.jump_m=null")
ARIS = "{preset: aris3000, model: thesis, bearing: azimuth, gain_exponent: 0, range_min: 3.2, range_max: 5.6}"


def window(near: float, far: float) -> tuple[str, str]:
    """Return the range window of the floor."""
    return f"sonar.range_min={near}", f"sonar.range_max={far}"


ELSEWHERE = {
    "height-1.5": (*FIELD, "flight.height_m=1.5", *window(1.9, 3.4)),
    "height-4": (*FIELD, "flight.height_m=4", *window(5.1, 9.0)),
    "height-6": (*FIELD, "flight.height_m=6", *window(7.7, 13.4)),
    "pitch-20": (*FIELD, "mount.pitch_deg=20", *window(4.5, 11.5)),
    "pitch-50": (*FIELD, "mount.pitch_deg=50", *window(2.4, 4.0)),
    "aris-3000": (*FIELD, f"sonar={ARIS}"),
    "ship-hull": ("ship-hull", "scenes=[{count: 20, sequences: 10}]", "flight.pings=2"),
}
"""Recipe and what is changed in it."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("bench"))
    parser.add_argument("--networks", default="", help="runs or checkpoints with commas between them, of home only")
    parser.add_argument("--corrnet", default="corrnet", help="those that know the geometry: for all sets")
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--perturbed", type=int, default=200, help="pairs of the perturbed rows; 0: none")
    parser.add_argument("--elsewhere", type=int, default=200, help="pairs of other geometries; 0: none")
    parser.add_argument("--only", choices=[*HOME, *ELSEWHERE])
    parser.add_argument("--quick", action="store_true", help="two pairs of two sets, kept nowhere: within a minute")
    arguments = parser.parse_args()
    if not arguments.quick:
        return compare_all(arguments)
    with tempfile.TemporaryDirectory() as folder:
        few = {"out": Path(folder), "pairs": 2, "perturbed": 0, "elsewhere": 2}
        for name in (HOME[0], "height-1.5"):
            compare_all(argparse.Namespace(**{**vars(arguments), **few, "only": name}))


def compare_all(arguments: argparse.Namespace) -> None:
    """Make the data sets and compare networks and estimators on each."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    elsewhere = ",".join(filter(None, ["zero", "ecc", "direct", arguments.corrnet]))
    networks = [name for name in arguments.networks.split(",") if name]
    for name in [arguments.only] if arguments.only else [*HOME, *ELSEWHERE]:
        data = arguments.out / f"{name}{'' if name in HOME else '-few'}.zarr"
        common = (data, "--part", "all", "--reference", "direct")
        if name in HOME:
            make(data, name, *(SMALL if arguments.quick else (SETS[name],)), "flight.pings=2")
            forced = "" if name == HOME[0] else ":force=1"  # the other model's bearing is a cone's
            methods = ",".join([elsewhere, *(network + forced for network in networks)])
            levels = ("--noise", "high" if arguments.quick else "none,low,high", "--limit", min(10, arguments.pairs))
            compare(
                arguments.out / f"networks-{name}", *common, *levels, "--pairs", arguments.pairs, "--estimators", methods
            )
            if arguments.perturbed:
                few = ("--pairs", arguments.perturbed, "--noise", "high", "--limit", 0, "--perturb")
                compare(arguments.out / f"networks-{name}-perturbed", *common, *few, "--estimators", methods)
        elif arguments.elsewhere:  # networks that know one geometry only would refuse these
            make(data, *ELSEWHERE[name], *(SMALL if arguments.quick else ()))
            levels = ("--noise", "high" if arguments.quick else "none,high", "--limit", min(5, arguments.elsewhere))
            compare(
                arguments.out / f"networks-{name}",
                *common,
                *levels,
                "--pairs",
                arguments.elsewhere,
                "--estimators",
                elsewhere,
            )


def make(data: Path, recipe: str, *changes: str) -> None:
    """Make the data set, if it is missing."""
    sets = [word for change in changes for word in ("--set", change)]
    run("dataset", "make", recipe, *sets, "--seed", SEED, "-o", data)


def compare(out: Path, *words: object) -> None:
    """One table."""
    run("compare", *words, "-o", out)


if __name__ == "__main__":
    main()
