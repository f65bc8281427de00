"""What the README says runs: its commands and its Python as they stand; it stays short, and its links lead somewhere."""

from __future__ import annotations

import contextlib
import re
import shlex
from pathlib import Path

import pytest
from helpers import Command

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
PYTHON = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
COMMANDS = [
    shlex.split(line, comments=True)
    for block in re.findall(r"```sh\n(.*?)```", README, flags=re.DOTALL)
    for line in block.splitlines()
    if line.startswith("mitsonar ")
]

SMALLER = {"dataset": ["--set", "world={family: rocky-field, a_side: [5, 10]}"]}
"""Fewer rocks are enough to see that a command works."""


@pytest.mark.thorough
def test_python_runs(tmp_path: Path) -> None:
    assert PYTHON
    for code in PYTHON:
        with contextlib.chdir(tmp_path):
            exec(compile(code, "README.md", "exec"), {"__name__": "__readme__"})


@pytest.mark.thorough
def test_commands_run_in_order(tmp_path: Path, mitsonar: Command) -> None:
    """Later commands read what earlier ones made; all share a process, which saves their start."""
    assert len(COMMANDS) >= 4
    for command in COMMANDS:
        done = mitsonar(*command[1:], *SMALLER.get(command[1], []), cwd=tmp_path)
        assert done.returncode == 0, (command, done.stderr)


def test_it_has_at_most_500_words() -> None:
    assert len(README.split()) <= 500


def test_links_and_pictures_exist() -> None:
    targets = [target for target in re.findall(r"\]\(([^)#]+)", README) if not target.startswith("http")]
    assert len(targets) > 10
    for target in targets:
        assert (ROOT / target).exists(), target


def test_it_cites_the_works_that_it_builds_on() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    for text in (README, (ROOT / "docs" / "cite.md").read_text(encoding="utf-8"), citation):
        assert "Underwater Motion Estimation Based on" in " ".join(text.split())
        for first, last in ((33880, 33896), (25591, 25604), (127047, 127060)):
            assert f"{first}-{last}" in text or f"start: {first}\n    end: {last}" in text, (first, text[:40])
