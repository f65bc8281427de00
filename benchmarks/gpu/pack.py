"""Packs what mitsonar needs on a machine with a GPU and no network into one archive of installed packages.

    python benchmarks/gpu/pack.py out/site.tar.xz [--all] [--cufinufft] [--no-embree]
    python benchmarks/gpu/pack.py --quick        # no network: reads the list, slims and packs a small folder

Fetches the wheels of wheels.txt for CPython 3.12 on x86-64 Linux, builds that of this checkout, unpacks all into one folder,
removes what mitsonar never loads, and packs the folder. There, unpack it, and name the folder in PYTHONPATH.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterable
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]

PLATFORMS = ("manylinux_2_28", "manylinux_2_27", "manylinux_2_24", "manylinux_2_17", "manylinux2014", "manylinux1")
UNUSED = (
    *(
        "mitsuba/*spectral*.so",
        "mitsuba/*polarized*.so",
        "mitsuba/*_rgb*.so",
        "mitsuba/data/srgb.coeff",
        "mitsuba/data/sunsky",
    ),
    *("*/include", "*/tests", "bin"),
)
"""Files and folders that mitsonar never loads: colour, polarisation, headers, tests and commands."""


def main() -> None:
    """Pack."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", help="archive to write")
    parser.add_argument("--all", action="store_true", help="also what such machines often have")
    parser.add_argument("--cufinufft", action="store_true", help="for PyTorch of CUDA 12: the sums over echoes on the GPU")
    parser.add_argument(
        "--no-embree", action="store_true", help="Mitsuba for CUDA only: nothing can be compared with the CPU"
    )
    parser.add_argument("--quick", action="store_true", help="a small folder of its own, no network")
    arguments = parser.parse_args()
    if arguments.quick:
        return quick()
    if arguments.out is None:
        parser.error("an archive is missing: give OUT, or --quick")
    if arguments.out.exists():
        parser.error(f"{arguments.out} exists: remove it, or choose another OUT")
    chosen = {"needed": True, "often there": arguments.all, "CUDA 12": arguments.cufinufft}
    expected = [one for section, wheels in listed().items() if chosen[section] for one in wheels]
    with tempfile.TemporaryDirectory() as folder:
        site = Path(folder, "site")
        with tempfile.TemporaryDirectory() as wheels:
            build(Path(wheels))
            fetch([*expected, *map(str, Path(wheels).iterdir())], site)
        slim(site, (*UNUSED, "mitsuba/libembree*") if arguments.no_embree else UNUSED)
        archive(site, arguments.out)
    print(f"{arguments.out}: {arguments.out.stat().st_size / 2**20:.1f} MiB")


def quick() -> None:
    """Read the list; slim and pack a small folder, and unpack it.

    Raises:
        SystemExit: it comes back with other files.
    """
    print(", ".join(f"{section}: {len(wheels)} wheels" for section, wheels in listed().items()))
    with tempfile.TemporaryDirectory() as folder:
        site, out = Path(folder, "site"), Path(folder, "site.tar.xz")
        for name in ("mitsuba/llvm_ad_mono.so", "mitsuba/llvm_ad_spectral.so", "drjit/include/drjit.h"):
            (site / name).parent.mkdir(parents=True, exist_ok=True)
            (site / name).write_text(name)
        slim(site, UNUSED)
        archive(site, out)
        with tarfile.open(out) as file:
            file.extractall(Path(folder, "back"), filter="data")
        back = [path.name for path in Path(folder, "back").rglob("*") if path.is_file()]
        if back != ["llvm_ad_mono.so"]:
            raise SystemExit(f"the folder comes back with {', '.join(back)}")


def listed(path: Path = HERE / "wheels.txt") -> dict[str, list[str]]:
    """Read the requirements `name==version` of each section of the list."""
    result: dict[str, list[str]] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        words = line.partition("#")[0].strip()
        if words.startswith("["):
            local = result.setdefault(words.strip("[]"), [])
        elif words:
            local.append(words)
    return result


def fetch(expected: list[str], site: Path) -> None:
    """Install wheels for CPython 3.12, x86-64 Linux, and nothing else, into a folder."""
    words = [word for platform in PLATFORMS for word in ("--platform", f"{platform}_x86_64")]
    words += ["--only-binary=:all:", "--no-deps", "--python-version", "3.12", "--implementation", "cp"]
    words += ["--no-compile", "--target", str(site)]
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", *words, *expected], check=True)


def build(out: Path) -> None:
    """Build the wheel of this checkout from a copy, without the remains of earlier builds."""
    others = shutil.ignore_patterns(".*", "out", "build", "dist", "*.egg-info", "__pycache__", "*.zarr")
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(ROOT, Path(folder, "mitsonar"), symlinks=True, ignore=others)
        words = ["--no-deps", "--no-build-isolation", "-q", "-w", str(out), str(Path(folder, "mitsonar"))]
        subprocess.run([sys.executable, "-m", "pip", "wheel", *words], check=True)


def slim(site: Path, unused: Iterable[str]) -> None:
    """Remove files and folders that match these patterns, and symbols of libraries where `strip` is installed."""
    for pattern in unused:
        for path in site.glob(pattern):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    libraries = [str(path) for path in site.rglob("*.so*") if path.read_bytes()[:4] == b"\x7fELF"]
    if libraries and shutil.which("strip"):
        subprocess.run(["strip", "--strip-unneeded", *libraries], check=True)


def archive(site: Path, out: Path) -> None:
    """Pack the files of a folder, with paths from that folder."""
    out.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(out, "w:xz") as file:
        for path in sorted(site.iterdir()):
            file.add(path, path.name)


if __name__ == "__main__":
    main()
