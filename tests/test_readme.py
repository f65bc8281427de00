"""What the README says runs: its Python blocks as they stand, and its commands know their options."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import Command

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
FOR_TORCH = [block for block in BLOCKS if "Pairs" in block]
PYTHON = [block for block in BLOCKS if block not in FOR_TORCH]
COMMANDS = [
    shlex.split(line, comments=True)
    for block in re.findall(r"```sh\n(.*?)```", README, flags=re.DOTALL)
    for line in block.splitlines()
    if line.startswith("mitsonar ")
]


FEW = {"compare": "8", "train": "24", "evaluate": "8"}
"""Pairs of commands that take a while with as many as the README has."""


def run(command: list[str], folder: Path) -> str:
    done = subprocess.run([sys.executable, *command], capture_output=True, text=True, cwd=folder, timeout=300)
    assert done.returncode == 0, (command, done.stderr)
    return done.stdout


@pytest.mark.thorough
def test_commands_and_python_blocks_run_in_order(tmp_path: Path, mitsonar: Command) -> None:
    """In a folder that holds the scenes, as a checkout does; blocks may use what commands have made. Commands share a
    process, which saves twenty starts."""
    shutil.copytree(ROOT / "scenes", tmp_path / "scenes")
    assert len(COMMANDS) >= 12
    assert FOR_TORCH
    has_torch = importlib.util.find_spec("torch") is not None or os.environ.get("MITSONAR_REQUIRE_LEARN") == "1"
    for command in COMMANDS:
        if command[1] in ("compare", "train", "evaluate", "export", "reproduce") and not has_torch:
            continue
        # few frames and pairs are enough to see that a command works; odometry needs the frames of its run
        fewer = ["--frames", "2"] if "--trajectory" in command and "out/run" not in command else []
        fewer += ["--pairs", FEW[command[1]]] if command[1] in FEW else []
        fewer += ["--sequences", "2"] if "impulse-standard" in command else []
        done = mitsonar(*command[1:], *fewer, cwd=tmp_path)
        assert done.returncode == 0, (command, done.stderr)
    for code in [*PYTHON, *(FOR_TORCH if has_torch else [])]:
        assert run(["-c", code.replace("in range(2)", "in range(1)")], tmp_path)  # one epoch


def test_links_and_pictures_exist() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if not target.startswith("http"):
            assert (ROOT / target).exists(), target
