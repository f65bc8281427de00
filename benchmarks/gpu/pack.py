"""Packs what mitsonar needs on a machine with a GPU and no network, into loads that can be carried one by one.

    python benchmarks/gpu/pack.py OUT [--load-mib 55] [--part-mib 15] [--all] [--cufinufft] [--no-embree]
    python benchmarks/gpu/pack.py --quick        # no network: reads the list, slims and splits a small wheel

Fetches the wheels of wheels.txt with `pip download`, builds that of this checkout, slims Mitsuba's, splits what is larger
than a part, deals all out to OUT/load-1, OUT/load-2 ... and prints their sizes. There, `run.py install FOLDER ...` puts them
together and installs them.
"""

from __future__ import annotations

import argparse
import base64
import csv
import hashlib
import io
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
MIB = 2**20

PLATFORMS = ("manylinux_2_28", "manylinux_2_27", "manylinux_2_24", "manylinux_2_17", "manylinux2014", "manylinux1")
UNUSED = ("spectral", "polarized", "cuda_ad_rgb", "llvm_ad_rgb", "srgb.coeff")
"""Parts of names of files in Mitsuba's wheel that mitsonar never loads: colour and polarisation."""


def main() -> None:
    """Pack."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", help="folder to make")
    parser.add_argument("--load-mib", type=float, default=55, help="largest load")
    parser.add_argument("--part-mib", type=float, default=15, help="larger files are split into parts of this size")
    parser.add_argument("--all", action="store_true", help="also what such machines often have")
    parser.add_argument("--cufinufft", action="store_true", help="for PyTorch of CUDA 12: the sums over echoes on the GPU")
    parser.add_argument(
        "--no-embree", action="store_true", help="Mitsuba for CUDA only: nothing can be compared with the CPU"
    )
    parser.add_argument("--quick", action="store_true", help="a small wheel of its own, no network")
    arguments = parser.parse_args()
    if arguments.quick:
        return quick()
    if arguments.out is None:
        parser.error("a folder is missing: give OUT, or --quick")
    if arguments.out.exists():
        parser.error(f"{arguments.out} is there already: remove it, or choose another OUT")
    chosen = {"needed": True, "often there": arguments.all, "CUDA 12": arguments.cufinufft}
    expected = [one for section, wheels in listed().items() if chosen[section] for one in wheels]
    with tempfile.TemporaryDirectory() as folder:
        fetched = Path(folder)
        fetch(expected, fetched)
        build(fetched)
        for wheel in fetched.glob("mitsuba-*.whl"):
            slim(wheel, (*UNUSED, "libembree") if arguments.no_embree else UNUSED)
        loads(fetched, arguments.out, int(arguments.load_mib * MIB), int(arguments.part_mib * MIB))
    print(reported(arguments.out))


def quick() -> None:
    """Read the list, slim and split a small wheel, put it together again."""
    print(", ".join(f"{section}: {len(wheels)} wheels" for section, wheels in listed().items()))
    with tempfile.TemporaryDirectory() as folder:
        wheels, out = Path(folder, "wheels"), Path(folder, "out")
        wheels.mkdir()
        wheel = wheels / "mitsuba-0-py3-none-any.whl"
        rows = "mitsuba/llvm_ad_mono.so,,\nmitsuba/llvm_ad_spectral.so,,\nmitsuba-0.dist-info/RECORD,,\n"
        with zipfile.ZipFile(wheel, "w") as file:
            file.writestr("mitsuba/llvm_ad_mono.so", "kept" * 1000)
            file.writestr("mitsuba/llvm_ad_spectral.so", "dropped" * 1000)
            file.writestr("mitsuba-0.dist-info/RECORD", rows)
        slim(wheel, UNUSED)
        loads(wheels, out, 150, 100)
        print(reported(out))
        put_together(sorted(out.iterdir()), Path(folder))
        if Path(folder, wheel.name).read_bytes() != wheel.read_bytes():
            raise SystemExit("a wheel that was split and put together again is another one")


# ---------------------------------------------------------------- wheels


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


def fetch(expected: list[str], out: Path) -> None:
    """Download wheels for CPython 3.12, x86-64 Linux, and nothing else."""
    words = [word for platform in PLATFORMS for word in ("--platform", f"{platform}_x86_64")]
    words += ["--only-binary=:all:", "--no-deps", "--python-version", "3.12", "--implementation", "cp", "-d", str(out)]
    subprocess.run([sys.executable, "-m", "pip", "download", "-q", *words, *expected], check=True)


def build(out: Path) -> None:
    """Build the wheel of this checkout from a copy, without the remains of earlier builds."""
    others = shutil.ignore_patterns(".*", "out", "build", "dist", "*.egg-info", "__pycache__", "*.zarr")
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(ROOT, Path(folder, "mitsonar"), symlinks=True, ignore=others)
        words = ["--no-deps", "--no-build-isolation", "-q", "-w", str(out), str(Path(folder, "mitsonar"))]
        subprocess.run([sys.executable, "-m", "pip", "wheel", *words], check=True)


def slim(wheel: Path, unused: Iterable[str]) -> None:
    """Drop files of a wheel whose names contain one of these words, from its record too; compress the rest well."""

    def stored(name: str) -> bool:
        return not name.endswith((".so", ".coeff")) or not any(word in Path(name).name for word in unused)

    result = wheel.with_suffix(".slim")
    with zipfile.ZipFile(wheel) as old, zipfile.ZipFile(result, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as new:
        for item in old.infolist():
            if stored(item.filename):
                data = old.read(item)
                new.writestr(item.filename, without_rows(data, stored) if item.filename.endswith("/RECORD") else data)
    result.replace(wheel)


def without_rows(record: bytes, stored: Callable[[str], bool]) -> bytes:
    """Return the RECORD of a wheel without the rows of removed files."""
    text = io.StringIO()
    rows = [row for row in csv.reader(record.decode().splitlines()) if row and stored(row[0])]
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


# ---------------------------------------------------------------- loads


def loads(files: Path, out: Path, load: int, part: int) -> None:
    """Deal files out to folders of at most `load` bytes, the large ones in parts `NAME.part-01-of-03`."""
    pieces: list[tuple[str, bytes]] = []
    for path in sorted(files.iterdir(), key=lambda path: -path.stat().st_size):
        pieces += split(path.name, path.read_bytes(), part)
    used: list[int] = []
    for name, data in pieces:
        number = next((k for k, size in enumerate(used) if size + len(data) <= load), len(used))
        used += [0] if number == len(used) else []
        used[number] += len(data)
        folder = out / f"load-{number + 1}"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


def split(name: str, data: bytes, part: int) -> list[tuple[str, bytes]]:
    """Names and bytes of the parts of a file; one that is small enough is whole. The digest of the whole is in the name."""
    if len(data) <= part:
        return [(name, data)]
    count = -(-len(data) // part)
    digest = base64.b32encode(hashlib.sha256(data).digest()[:5]).decode().lower()
    return [(f"{name}.{digest}-part-{k + 1:02}-of-{count:02}", data[k * part : (k + 1) * part]) for k in range(count)]


def put_together(folders: Iterable[Path], out: Path) -> list[Path]:
    """Write the files of some loads as they were.

    Raises:
        SystemExit: a part is missing, or a file is not what it was.
    """
    result = sorted((path for folder in folders for path in folder.iterdir()), key=lambda path: path.name)
    parts: dict[str, list[Path]] = {}
    for path in result:
        parts.setdefault(path.name.partition("-part-")[0], []).append(path)
    built = []
    for name, mine in parts.items():
        data = b"".join(path.read_bytes() for path in mine)
        if "-part-" in mine[0].name:
            name, _, digest = name.rpartition(".")
            count = int(mine[0].name.rpartition("-")[2])
            if len(mine) != count:
                raise SystemExit(f"{name} has {len(mine)} of its {count} parts: bring the other loads too")
            if digest != base64.b32encode(hashlib.sha256(data).digest()[:5]).decode().lower():
                raise SystemExit(f"{name} is damaged: carry its parts again")
        out.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(data)
        built.append(out / name)
    return built


def reported(out: Path) -> str:
    """Sizes of the loads and of what is in them."""
    lines = []
    for folder in sorted(out.iterdir()):
        sizes = {path.name: path.stat().st_size / MIB for path in sorted(folder.iterdir())}
        lines.append(f"{folder.name}: {sum(sizes.values()):.1f} MiB")
        lines += [f"    {size:7.2f} MiB  {name}" for name, size in sizes.items()]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
