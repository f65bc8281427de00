"""Scripts that are not part of the package: each knows --quick, and the runner tells a broken one."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

import run_quick  # noqa: E402

SCRIPTS = {str(path.relative_to(ROOT)): path for path in run_quick.scripts(ROOT)}


def test_all_scripts_are_found() -> None:
    assert len(SCRIPTS) >= 16
    assert {"benchmarks/bench_render.py", "benchmarks/gpu/run.py", "docs/draw_worlds.py", "scenes/trajectories.py"} <= set(
        SCRIPTS
    )
    assert "benchmarks/rocky_seabed.py" not in SCRIPTS  # it is imported only


@pytest.mark.parametrize("name", SCRIPTS)
def test_each_script_knows_quick(name: str) -> None:
    assert 'add_argument("--quick"' in SCRIPTS[name].read_text()


@pytest.mark.slow
def test_each_script_ends_well() -> None:
    """Minutes: `make bench-quick` does the same."""
    assert [name for name, path in SCRIPTS.items() if not run_quick.passes(path, 600)] == []


@pytest.mark.parametrize(("body", "well"), [("print(1)", True), ("raise SystemExit('no tracer')", False), ("1 / 0", False)])
def test_the_runner_tells_what_fails(
    body: str, well: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "bench_it.py"
    script.write_text(f'\nif __name__ == "__main__":\n    {body}\n')
    monkeypatch.setattr(run_quick, "ROOT", tmp_path)
    assert run_quick.is_script(script)
    assert run_quick.passes(script, 60) is well
    output = capsys.readouterr().out
    assert output.split()[2] == ("ok" if well else "FAILED")  # the path of a clone may hold either word
    assert well or "no tracer" in output or "ZeroDivisionError" in output


def test_a_script_that_hangs_has_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "bench_it.py"
    script.write_text('import time\n\nif __name__ == "__main__":\n    print("begun", flush=True)\n    time.sleep(60)\n')
    monkeypatch.setattr(run_quick, "ROOT", tmp_path)
    assert not run_quick.passes(script, 0.7)
    output = capsys.readouterr().out
    assert "begun" in output
    assert "not done after 0.7 s" in output
