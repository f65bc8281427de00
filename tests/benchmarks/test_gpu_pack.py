"""The pack for a machine with a GPU: its list is whole, its archive has what is loaded, steps go on and stop nobody."""

from __future__ import annotations

import importlib.metadata
import json
import sys
import tarfile
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "benchmarks" / "gpu"))

import flagships  # noqa: E402
import pack  # noqa: E402
import run  # noqa: E402

GIVEN = ("torch", "lightning")
"""What such a machine has, with all that it brings."""

# ---------------------------------------------------------------- the list


def constraints() -> dict[str, str]:
    """Exact versions by name."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pairs = [line.split("==") for line in lines if "==" in line and not line.startswith("#")]
    return {str(canonicalize_name(name)): version.strip() for name, version in pairs}


def listed() -> dict[str, str]:
    """Versions by name, of the whole list."""
    pairs = [one.split("==") for wheels in pack.listed().values() for one in wheels]
    assert len({canonicalize_name(name) for name, _ in pairs}) == len(pairs)
    return {str(canonicalize_name(name)): version for name, version in pairs}


def needs(names: list[str]) -> Iterator[str]:
    """Names of packages that these need, themselves among them, on Python 3.12."""
    seen: set[str] = set()
    world = {"python_version": "3.12", "python_full_version": "3.12.3", "extra": "", "sys_platform": "linux"}
    while names:
        name = str(canonicalize_name(names.pop()))
        if name in seen:
            continue
        seen.add(name)
        yield name
        for text in importlib.metadata.requires(name) or []:
            expected = Requirement(text)
            if expected.marker is None or expected.marker.evaluate(world):
                names.append(expected.name)


def test_versions_are_those_of_the_constraints_or_stated() -> None:
    lines = (ROOT / "benchmarks" / "gpu" / "wheels.txt").read_text().splitlines()
    stated = {canonicalize_name(line.partition("==")[0]) for line in lines if "not in constraints.txt" in line}
    known = constraints()
    for name, version in listed().items():
        assert (name in stated) != (name in known), name
        assert known.get(name, version) == version, name
    assert stated == {"cufinufft"}
    assert listed()["cufinufft"] == known["finufft"]


@pytest.mark.learn
def test_the_list_holds_all_that_rendering_and_training_need() -> None:
    pytest.importorskip("lightning")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [one for name in ("data", "odometry", "learn", "cuda") for one in project["optional-dependencies"][name]]
    expected = [Requirement(one).name for one in project["dependencies"] + extras]
    here = [name for name in expected if name not in ("cufinufft", "mitsonar")]
    missing = set(needs(here)) - set(needs(list(GIVEN))) - set(listed())
    assert missing == set()


# ---------------------------------------------------------------- the archive


def test_the_archive_has_what_is_loaded_and_no_more(tmp_path: Path) -> None:
    site, out = tmp_path / "site", tmp_path / "deep" / "site.tar.xz"
    loaded = ["drjit/drjit.py", "mitsuba/cuda_ad_mono.so", "mitsuba/plugins/sphere.so"]
    unused = ["bin/f2py", "drjit/include/drjit/array.h", "mitsuba/cuda_ad_mono_polarized.so", "mitsuba/data/sunsky/a.bin"]
    for name in loaded + unused:
        (site / name).parent.mkdir(parents=True, exist_ok=True)
        (site / name).write_text(name)
    pack.slim(site, pack.UNUSED)
    pack.archive(site, out)
    with tarfile.open(out) as file:
        assert sorted(one.name for one in file.getmembers() if one.isfile()) == loaded


# ---------------------------------------------------------------- steps

Calls = list[str]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Three steps in place of the real ones: one that ends, one that goes on once, one that fails."""
    done: Calls = []

    def ends(asked: run.Request) -> run.Found:
        done.append("ends")
        return run.Found({"speed": 3})

    def goes_on(asked: run.Request) -> run.Found:
        done.append("goes_on")
        return run.Found({"so far": done.count("goes_on")}, done=done.count("goes_on") > 1)

    def fails(asked: run.Request) -> run.Found:
        done.append("fails")
        raise ValueError("no such kernel")

    steps: dict[str, Any] = {"fails": fails, "ends": ends, "goes_on": goes_on}
    monkeypatch.setattr(run, "STEPS", steps)
    monkeypatch.setattr(run, "IN_SMALL", set(steps))
    return done


def work(out: Path, **words: Any) -> dict[str, str]:
    """All steps."""
    return run.go(list(run.STEPS), out, 1.0, "cpu", words.pop("minutes", 1), **words)


def test_a_failed_step_stops_no_other_and_open_ones_go_on(
    calls: Calls, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert work(tmp_path) == {"fails": "failed", "ends": "done", "goes_on": "open"}
    assert calls == ["fails", "ends", "goes_on"]
    assert "ValueError: no such kernel" in capsys.readouterr().out
    assert work(tmp_path) == {"fails": "failed", "ends": "done", "goes_on": "done"}
    assert calls[3:] == ["goes_on"]
    assert work(tmp_path, again=True)["fails"] == "failed"
    assert calls[4:] == ["fails"]
    steps = json.loads((tmp_path / "state.json").read_text())["steps"]
    assert steps["goes_on"]["calls"] == 2
    assert steps["ends"]["found"] == {"speed": 3}
    assert steps["fails"]["found"] == {"ValueError": "no such kernel"}


def test_no_step_begins_when_the_time_is_over(calls: Calls, tmp_path: Path) -> None:
    assert set(work(tmp_path, minutes=-1).values()) == {"open"}
    assert calls == []


def test_a_kill_between_steps_loses_only_the_step_that_ran(
    calls: Calls, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(asked: run.Request) -> run.Found:
        raise KeyboardInterrupt

    monkeypatch.setitem(run.STEPS, "goes_on", killed)
    with pytest.raises(KeyboardInterrupt):
        work(tmp_path)
    monkeypatch.setitem(run.STEPS, "goes_on", lambda asked: run.Found({}))
    assert work(tmp_path) == {"fails": "failed", "ends": "done", "goes_on": "done"}
    assert calls == ["fails", "ends"]


def test_a_folder_that_was_begun_otherwise_is_refused(calls: Calls, tmp_path: Path) -> None:
    work(tmp_path)
    with pytest.raises(SystemExit, match="was begun with"):
        run.go(["ends"], tmp_path, 0.5, "cpu", 1)
    (tmp_path / "state.json").write_text("{")
    with pytest.raises(SystemExit, match="is damaged"):
        work(tmp_path)


def asked_of(tmp_path: Path, seconds: float) -> run.Request:
    """A step that has so long."""
    return run.Request(tmp_path, 1.0, "cpu", time.monotonic() + seconds)


@pytest.mark.thorough
def test_a_command_is_stopped_in_time_and_says_why(tmp_path: Path) -> None:
    assert run.command(asked_of(tmp_path, 60), "ok", ["-c", "print('well')"])
    assert "well" in (tmp_path / "logs" / "ok.log").read_text()
    with pytest.raises(run.Failed, match=r"exit status 3: .*broken"):
        run.command(asked_of(tmp_path, 60), "bad", ["-c", "print('broken'); raise SystemExit(3)"])
    sleeps = ["-c", "import time; print('begun', flush=True); time.sleep(60)"]
    assert not run.command(asked_of(tmp_path, 2), "late", sleeps, goes_on=True)
    with pytest.raises(run.Failed, match="not done in time"):
        run.command(asked_of(tmp_path, 2), "late", sleeps)


@pytest.mark.posix
@pytest.mark.thorough
def test_a_command_that_heeds_no_request_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "GRACE_S", 1.0)
    deaf = ["-c", "import signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN); time.sleep(60)"]
    begun = time.monotonic()
    assert not run.command(asked_of(tmp_path, 3), "deaf", deaf, goes_on=True)
    assert time.monotonic() - begun < 30


def test_weights_come_back_of_half_the_bytes(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    assert not run.weights(asked_of(tmp_path, 60)).done
    folder = tmp_path / "flagships" / "posenet-normx10" / "runs" / "posenet-normx10"
    folder.mkdir(parents=True)
    stored: dict[str, Any] = {"weights": {"a": torch.randn(9000), "steps": torch.tensor(7)}, "about": ["x", 1.5]}
    torch.save(stored, folder / "network.ckpt")
    assert run.weights(asked_of(tmp_path, 60)).done
    out = tmp_path / "weights" / "posenet-normx10.bf16"
    assert out.stat().st_size < 0.6 * (folder / "network.ckpt").stat().st_size
    back = run.full(torch.load(out, weights_only=True))
    assert back["about"] == stored["about"]
    assert int(back["weights"]["steps"]) == 7
    assert torch.allclose(back["weights"]["a"], stored["weights"]["a"], rtol=2**-8)
    assert back["weights"]["a"].dtype == torch.float32


def test_two_arrays_differ_by_their_rms_part() -> None:
    import numpy as np

    one = np.array([3.0, 4.0, np.nan])
    assert run.differ(one, one) == 0
    assert run.differ(one, np.array([3.0, 4.5, np.nan])) == pytest.approx(0.5 / np.hypot(3.0, 4.5))
    assert run.differ(one, one[:2]) == float("inf")


def test_cufinufft_that_does_not_load_is_done_without(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from mitsonar.simulation import beams

    (tmp_path / "cufinufft.py").write_text("raise ImportError('Could not find cufinufft library in system path')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "cufinufft", raising=False)
    beams._has_cufinufft.cache_clear()
    try:
        assert not beams._has_cufinufft()
    finally:
        beams._has_cufinufft.cache_clear()


def test_rows_are_those_of_the_tables() -> None:
    from mitsonar.reproduction.tables import load_tables

    tables = load_tables()
    assert set(run.TABLE_52) == {row.name for row in tables["5.2"].rows}
    for name, table in flagships.ROWS.items():
        assert name in {row.name for row in tables[table].rows}
    assert set(run.TABLE_52) <= set(run.STEPS)
