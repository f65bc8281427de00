"""Recordings of pictures that are damaged or made to harm: every reader gives frames that can be, or one sentence."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import test_canoe
import test_uxo
from fans import drawn
from hostile_readers import read_recording
from mutations import Rng, changed_bytes, changed_text, outcome
from numpy.typing import NDArray
from PIL import Image

USUAL, MANY = 40, 10_000
"""Mutants of each format in the test that is always run, and in the slow one."""

GEOMETRY = (
    "layout: fan\napex_px: [119.5, 210.25]\nnear_px: 60\nfar_px: 200\nhalf_angle_deg: 28\nrange_max: 10\nlevel: dB\n"
    "elevation_fov_deg: 20\nbins: 30\nbeams: 20\n"
)


def ramp(radius: NDArray[np.float64], bearing: NDArray[np.float64]) -> NDArray[np.float64]:
    return (radius - 50) / 160


def pictures(count: int = 3) -> NDArray[np.uint8]:
    return np.stack([np.rint(drawn(ramp) * 255)] * count).astype(np.uint8)


def as_folder(path: Path, ending: str) -> None:
    path.mkdir()
    for number, picture in enumerate(pictures()):
        Image.fromarray(picture).save(path / f"{number}.{ending}")
    (path / "geometry.yaml").write_text(GEOMETRY + "times: times.csv\n")
    (path / "times.csv").write_text("\n".join(f"{k}.{ending}, {k}" for k in range(3)))


def as_stack(path: Path) -> None:
    keys = {"apex_xy": np.array([119.5, 210.25]), "rmin_px": 60.0, "rmax_px": 200.0, "half_fov_deg": 28.0, "kx": 1.0}
    np.savez(path.with_suffix(".npz"), frames=pictures(2)[:, ::4, ::4], **keys)  # type: ignore[arg-type]


def as_canoe(path: Path) -> None:
    test_canoe.written(path, frames=4)
    test_canoe.with_poses(path, np.eye(3), frames=4)


def as_uxo(path: Path) -> None:
    test_uxo.written(path, frames=3)


WRITERS: dict[str, Callable[[Path], object]] = {
    "png": lambda path: as_folder(path, "png"),
    "jpg": lambda path: as_folder(path, "jpg"),
    "pgm": lambda path: as_folder(path, "pgm"),
    "npz": as_stack,
    "canoe": as_canoe,
    "uxo": as_uxo,
}


def spoil(rng: Rng, folder: Path) -> None:
    """Change one or two files: words of texts, bytes of pictures, or remove, rename or empty a file."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    for _ in range(1 if rng.random() < 0.8 else 2):
        path = paths[int(rng.integers(len(paths)))]
        if not path.is_file():
            continue
        chance = rng.random()
        if chance < 0.04:
            path.unlink()
        elif chance < 0.08:
            path.rename(path.with_suffix(str(rng.choice([".png", ".pgm", ".npz", ".yaml", ""]))))
        elif path.suffix in (".yaml", ".csv"):
            path.write_bytes(changed_text(rng, path.read_bytes()))
        else:
            path.write_bytes(changed_bytes(rng, path.read_bytes()))


def read(folder: Path) -> None:
    with warnings.catch_warnings(), np.errstate(all="warn"):
        warnings.simplefilter("error", RuntimeWarning)
        read_recording(next(iter(sorted(folder.iterdir()))))


def attacked(name: str, folder: Path, seeds: range) -> dict[str, int]:
    good, bad = folder / "good", folder / "bad"
    good.mkdir()
    WRITERS[name](good / "a")
    read(good)
    result = {"read": 0, "refused": 0}
    for seed in seeds:
        shutil.rmtree(bad, ignore_errors=True)
        shutil.copytree(good, bad)
        spoil(np.random.default_rng([seed, *name.encode()]), bad)
        if not any(bad.iterdir()):
            continue
        try:
            result[outcome(lambda: read(bad))] += 1
        except BaseException as error:
            raise AssertionError(f"{name}, mutant {seed}: {type(error).__name__}: {str(error)[:300]}") from error
    return result


@pytest.mark.parametrize("name", WRITERS)
def test_mutants_are_read_or_refused(name: str, tmp_path: Path) -> None:
    assert attacked(name, tmp_path, range(USUAL))["refused"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", WRITERS)
def test_many_mutants(name: str, tmp_path: Path) -> None:
    assert min(attacked(name, tmp_path, range(USUAL, MANY)).values()) > 0
