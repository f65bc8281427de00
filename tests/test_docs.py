"""The documentation: its commands and Python run page by page, its XML loads, its reference follows from the code.

A block that is shown but not run has a comment with its reason before it: ``<!-- notest: reason -->``. A page that reads
what another page makes says so at its first use: ``<!-- uses: out/rocks.zarr -->``; the tests make that once, small.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import pytest
import yaml
from helpers import PROGRAM, Command

import mitsonar

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"

BLOCK = re.compile(r"(?:<!-- notest: *(?P<reason>[^\n]*?) *-->\n)?```(?P<kind>sh|python|xml)\n(?P<text>.*?)```", re.DOTALL)
USES = re.compile(r"<!-- uses: *(.+?) *-->")

WITH_TORCH = ("guides/data-sets.md", "guides/networks.md")

SMALL_SCENES = "scenes=[{count: 2, sequences: 6}]"
SMALL_FIELD = "world={family: rocky-field, size_m: 20, a_side: [5, 10]}"
SMALL_FLOOR = "world={family: flat-objects, size_m: 16, seabed_cells: 96, rectangles: 20, ellipses: 20}"
SMALL_FLIGHT = "flight={height_m: 4, pings: 2, sideways_mm: 50, forward_mm: 50, jump_m: null}"
SMALL_CHANNEL = "channel={range_max: 8, frequency_step_hz: 40, frame_rate_hz: 40}"
HALVES = "split={by: scene, train: 0.5, validation: 0.5}"

SHARED: dict[str, list[str]] = {
    "out/run": ["render", "pattern", "--trajectory", "shipped", "-D", "texture=photo_gravel"],
    "out/rocks.zarr": ["dataset", "make", "rocky-field", "--set", SMALL_FIELD, "--set", SMALL_SCENES, "--set", HALVES],
    "out/responses.zarr": [
        *("dataset", "make", "impulse-standard", "--set", SMALL_FLOOR, "--set", SMALL_SCENES),
        *("--set", SMALL_CHANNEL, "--set", SMALL_FLIGHT, "--set", HALVES),
    ],
}
"""What pages read: how it is made, without its `-o`."""


class Block(NamedTuple):
    """A piece of a page: language, text, and why it is not run, if so."""

    kind: str
    text: str
    reason: str | None


def blocks_of(path: Path) -> list[Block]:
    """All fenced blocks of a page that could run."""
    text = path.read_text(encoding="utf-8")
    return [Block(result["kind"], result["text"], result["reason"]) for result in BLOCK.finditer(text)]


def pages() -> list[str]:
    """Pages that hold something to run, by their path below docs/."""
    names = (path.relative_to(DOCS).as_posix() for path in sorted(DOCS.rglob("*.md")))
    return [name for name in names if any(block.reason is None for block in blocks_of(DOCS / name))]


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Make what pages read, each once."""
    folder = tmp_path_factory.mktemp("docs")

    def make(name: str) -> Path:
        if not (folder / name).exists():
            command = [*PROGRAM, *SHARED[name], "-o", name]
            done = subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=300)
            assert done.returncode == 0, (command, done.stderr)
        return folder / name

    return make


def statements(text: str) -> Iterator[str]:
    """The commands of a shell block: lines, with a here-document in one piece."""
    lines = iter(text.splitlines())
    for line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        end = re.search(r"<<'(\w+)'", line)
        if end:
            line = "\n".join([line, *iter(lambda: next(lines), end[1]), end[1]])
        yield line


def run_shell(text: str, folder: Path, mitsonar: Command) -> None:
    """Run a shell block: our commands in this process, which saves their start, all else by the shell."""
    for line in statements(text):
        if line.startswith("mitsonar ") and ">" not in line.partition("#")[0]:
            done = mitsonar(*shlex.split(line, comments=True)[1:], cwd=folder)
            assert done.returncode == 0, (line, done.stdout, done.stderr)
        else:
            program = " ".join(map(shlex.quote, PROGRAM))
            line = re.sub(r"^mitsonar ", f"{program} ", line)
            shell = subprocess.run(["bash", "-ec", line], capture_output=True, text=True, cwd=folder, timeout=300)
            assert shell.returncode == 0, (line, shell.stdout, shell.stderr)


def run_python(text: str, page: str, folder: Path) -> None:
    """Run a Python block in a namespace of its own."""
    with contextlib.chdir(folder):
        exec(compile(text, page, "exec"), {"__name__": "__docs__"})


def run_xml(text: str) -> None:
    """Load a scene."""
    import mitsonar  # noqa: F401  registers the plugins
    from mitsonar.simulation.device import ensure_variant

    ensure_variant()
    import mitsuba as mi

    assert isinstance(mi.load_string(text, parallel=False), mi.Scene)


def marked(page: str) -> object:
    """The page as a parameter, with its markers."""
    marks = [pytest.mark.docs] + ([pytest.mark.learn] if page in WITH_TORCH else [])
    return pytest.param(page, marks=marks)


@pytest.mark.parametrize("page", [marked(page) for page in pages()])
def test_page_runs(page: str, tmp_path: Path, mitsonar: Command, shared: Callable[[str], Path]) -> None:
    """All blocks of a page in their order, in a folder that holds the scenes, as a checkout does."""
    shutil.copytree(ROOT / "scenes", tmp_path / "scenes")
    (tmp_path / "out").mkdir()
    result = re.findall(r"-o (out/\S+)", "".join(block.text for block in blocks_of(DOCS / page) if block.reason is None))
    for name in {name for uses in USES.findall((DOCS / page).read_text()) for name in uses.split(", ")}:
        if name not in result:
            (tmp_path / name).symlink_to(shared(name))
    for block in blocks_of(DOCS / page):
        if block.reason is not None:
            continue
        if block.kind == "sh":
            run_shell(block.text, tmp_path, mitsonar)
        elif block.kind == "python":
            run_python(block.text, page, tmp_path)
        else:
            run_xml(block.text)


def test_the_recipe_for_a_mavlink_log_makes_sensors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The block runs with a stand-in for pymavlink, whose messages have the fields and units of MAVLink."""
    from mitsonar.motion.sensors import load_sensors

    sent = [
        SimpleNamespace(get_type=lambda: "ATTITUDE", _timestamp=1.7e9, yawspeed=0.1, pitch=-0.03, roll=0.02),
        SimpleNamespace(get_type=lambda: "VFR_HUD", _timestamp=1.7e9, alt=-2.5),
        SimpleNamespace(get_type=lambda: "ATTITUDE", _timestamp=1.7e9 + 0.05, yawspeed=-0.2, pitch=0.01, roll=0.0),
        None,
    ]
    log = SimpleNamespace(recv_match=lambda type: sent.pop(0))
    stand_in = SimpleNamespace(mavutil=SimpleNamespace(mavlink_connection=lambda name: log))
    monkeypatch.setitem(sys.modules, "pymavlink", stand_in)
    (block,) = (one for one in blocks_of(DOCS / "reference/files.md") if "pymavlink" in one.text)
    run_python(block.text, "files.md", tmp_path)
    sensors = load_sensors(tmp_path / "sensors.csv")
    assert sensors.yaw_rate is not None
    assert sensors.depth is not None
    assert sensors.yaw_rate.values == pytest.approx([0.1, -0.2])
    assert sensors.depth.values.tolist() == [2.5]
    assert sensors.pitch is not None
    assert sensors.roll is not None
    assert sensors.pitch.values == pytest.approx([0.03, -0.01])  # MAVLink: > 0 is bow up
    assert sensors.roll.values == pytest.approx([0.02, 0.0])


def test_what_is_not_run_says_why() -> None:
    texts = {path: path.read_text(encoding="utf-8") for path in DOCS.rglob("*.md")}
    for path, text in texts.items():
        assert text.count("<!-- notest") == sum(block.reason is not None for block in blocks_of(path)), path
        assert all(block.reason != "" for block in blocks_of(path)), path
        assert text.count("\n```sh") == sum(block.kind == "sh" for block in blocks_of(path)), path


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks" / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem)
def test_notebooks_use_public_names_and_store_their_results(path: Path) -> None:
    """No module within mitsonar, no other process; results with pictures, no path of the machine that ran it."""
    text = path.read_text(encoding="utf-8")
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    code = "\n".join("".join(cell["source"]) for cell in cells)
    assert not re.findall(r"(?:from|import) mitsonar\.|subprocess", code)
    assert not set(re.findall(r"mitsonar\.(\w+)", code)) - set(mitsonar.__all__)
    assert all(cell["execution_count"] for cell in cells), "run it, and store it with its results"
    assert '"image/png"' in text
    assert tempfile.gettempdir() not in text
    assert len(text) < 400_000, "store smaller pictures"


def test_a_block_that_fails_fails_its_page(tmp_path: Path, mitsonar: Command) -> None:
    with pytest.raises(AssertionError, match="no scene file"):
        run_shell("mitsonar render nothing -o out/x\n", tmp_path, mitsonar)
    with pytest.raises(AssertionError):
        run_shell("cat missing.yaml\n", tmp_path, mitsonar)
    with pytest.raises(ZeroDivisionError):
        run_python("1 / 0", "page", tmp_path)


def test_here_documents_are_one_command() -> None:
    text = "# a comment\ncat > a.yaml <<'END'\nkey: 1\n\nmore: 2\nEND\nmitsonar presets  # all\n"
    assert list(statements(text)) == ["cat > a.yaml <<'END'\nkey: 1\n\nmore: 2\nEND", "mitsonar presets  # all"]


@pytest.mark.parametrize("name", ["command-line.md", "python.md"])
def test_the_reference_follows_from_the_code(name: str) -> None:
    """Run `python docs/make_reference.py` after a change of the command line or of the public names."""
    spec = importlib.util.spec_from_file_location("make_reference", DOCS / "make_reference.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    result = {"command-line.md": script.command_page, "python.md": script.python_page}[name]()
    assert (DOCS / "reference" / name).read_text(encoding="utf-8") == result
    if name == "python.md":
        import mitsonar

        assert all(f"::: mitsonar.{public}\n" in result for public in mitsonar.__all__)


def test_every_page_is_in_the_menu() -> None:
    class Loader(yaml.SafeLoader):
        pass

    Loader.add_multi_constructor("tag:", lambda *_: None)
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    listed = re.findall(r"[\w/-]+\.md", str(yaml.load(menu, Loader)["nav"]))
    assert {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")} <= set(listed)


@pytest.mark.docs
@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="mkdocs is not installed: install mitsonar[docs]")
def test_the_site_builds_strictly_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert done.returncode == 0, done.stderr
    for path in (tmp_path / "site").rglob("*.html"):
        page = path.read_text(encoding="utf-8")
        assert not re.findall(r"<(?:script|img)[^>]*src=\"(?:https?:)?//[^>]*>", page), path
        assert not re.findall(r"<link[^>]*rel=\"stylesheet\"[^>]*href=\"(?:https?:)?//[^>]*>", page), path
        assert "arithmatex" not in page, path  # formulas are drawn
        assert not re.search(r":(?:class|meth|func):<code>", page), path  # roles of docstrings are code
    for name in ("benchmarks", "tutorials/01_render", "changelog"):
        assert (tmp_path / "site" / name / "index.html").stat().st_size > 10_000, name
