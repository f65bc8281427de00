"""Other platforms, simulated on this one: what macOS and Windows lack, their encodings and locks; and what CI runs there."""

from __future__ import annotations

import ast
import os
import re
import shlex
import sys
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path, PureWindowsPath
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import yaml
from helpers import Command, run_python

from mitsonar.errors import MitsonarError
from mitsonar.io import system
from mitsonar.simulation import device

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
SOURCES = [path for folder in ("mitsonar", "plugins", "scenes") for path in sorted((ROOT / folder).rglob("*.py"))]


# ---------------- What the sources may call


UNIX_MODULES = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}
"""Modules of the standard library that Windows lacks."""

UNIX_NAMES = {
    *("os.chown", "os.fchmod", "os.fork", "os.forkpty", "os.geteuid", "os.getloadavg", "os.getpgid", "os.getuid"),
    *("os.killpg", "os.mkfifo", "os.nice", "os.O_DIRECTORY", "os.O_NOFOLLOW", "os.posix_fadvise", "os.pread", "os.pwrite"),
    *("os.sched_getaffinity", "os.sched_setaffinity", "os.setpgrp", "os.setsid", "os.statvfs", "os.sync", "os.sysconf"),
    *("os.uname", "signal.alarm", "signal.pause", "signal.pthread_kill", "signal.setitimer", "signal.SIGALRM"),
    *("signal.SIGCHLD", "signal.SIGHUP", "signal.SIGKILL", "signal.SIGPIPE", "signal.SIGUSR1", "signal.SIGUSR2"),
    "time.tzset",
}
"""Names of the standard library that Windows lacks."""

UNIX_PATH = re.compile(r"/(proc|sys|dev|tmp|etc|usr|var)/")


parsed = cache(ast.parse)


def docstrings(tree: ast.AST) -> set[int]:
    """Identities of the strings that stand alone."""
    return {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}


def unix_only(source: str) -> Iterator[str]:
    """What a source names that Windows lacks."""
    tree = parsed(source)
    alone = docstrings(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from UNIX_MODULES.intersection(name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            names = {node.module or "", *(f"{node.module}.{name.name}" for name in node.names)}
            yield from names & (UNIX_MODULES | UNIX_NAMES)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            yield from UNIX_NAMES & {f"{node.value.id}.{node.attr}"}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and UNIX_PATH.match(node.value):
            if id(node) not in alone:
                yield node.value
        elif isinstance(node, ast.Call) and "fork" in (word.value for word in node.args if isinstance(word, ast.Constant)):
            yield "fork"


def text_without_encoding(source: str) -> Iterator[str]:
    """Calls of a source that read or write text in the encoding of the machine, or end lines as the machine does."""
    for node in ast.walk(parsed(source)):
        if not isinstance(node, ast.Call):
            continue
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        keywords = {word.arg: word.value for word in node.keywords}
        piped = name in ("run", "Popen", "check_output") and "text" in keywords
        opened = name in ("read_text", "write_text", "TextIOWrapper", "NamedTemporaryFile")
        opened = opened or (name == "open" and opens_text(node))
        written = opened and (name == "write_text" or mode_of(node) in ("w", "a", "x"))
        if ((piped or opened) and "encoding" not in keywords) or (written and "newline" not in keywords):
            yield ast.unparse(node)


MODE = re.compile(r"[rwxa][bt+]{0,2}")


def mode_of(call: ast.Call) -> str:
    """The mode of a call of ``open``: ``r`` if it names none."""
    words = [*call.args, *(word.value for word in call.keywords if word.arg == "mode")]
    texts = (word.value for word in words if isinstance(word, ast.Constant) and isinstance(word.value, str))
    return next((text for text in texts if MODE.fullmatch(text)), "r")


def opens_text(call: ast.Call) -> bool:
    """Whether a call ``open(path)`` or ``path.open()`` opens a file of text: not in binary, nor by another library."""
    if "b" in mode_of(call):
        return False
    if isinstance(call.func, ast.Name):
        return True
    # a file by its path takes a mode and no more; `Image.open(path)`, `archive.open(name)` and others take what to open
    return not call.args or mode_of(call) != "r" or [getattr(word, "value", None) for word in call.args] == ["r"]


OTHER_OPENS = ("tarfile.open(", "file.open(f'{name}.npy'", "reader.open()")
"""Calls named ``open`` of libraries that give bytes or records."""


@pytest.mark.thorough
def test_no_module_but_one_calls_what_only_unix_has() -> None:
    texts = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in SOURCES}
    assert len(texts) > 150
    found = {name: sorted(unix_only(text)) for name, text in texts.items()}
    assert [name for name, calls in found.items() if calls] == ["mitsonar/io/system.py"], found


@pytest.mark.thorough
def test_text_files_name_their_encoding_and_their_line_ends() -> None:
    for path in SOURCES:
        found = text_without_encoding(path.read_text(encoding="utf-8"))
        assert [call for call in found if not call.startswith(OTHER_OPENS)] == [], path


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("import resource", "resource"),
        ("from os import sysconf", "os.sysconf"),
        ("def f():\n    from fcntl import flock", "fcntl"),
        ("n = len(os.sched_getaffinity(0))", "os.sched_getaffinity"),
        ("signal.signal(signal.SIGHUP, stop)", "signal.SIGHUP"),
        ("Path('/proc/self/statm')", "/proc/self/statm"),
        ("get_context('fork')", "fork"),
    ],
)
def test_what_only_unix_has_is_found(source: str, found: str) -> None:
    assert found in set(unix_only(source))


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("open(path)", True),
        ("open(path, 'rb')", False),
        ("open(path, 'w', encoding='utf-8')", True),
        ("open(path, 'w', encoding='utf-8', newline='')", False),
        ("path.open()", True),
        ("path.open('a')", True),
        ("path.open(mode='w+b')", False),
        ("Image.open(path)", False),
        ("path.read_text()", True),
        ("path.read_text(encoding='utf-8')", False),
        ("path.write_text(a, encoding='utf-8')", True),
        ("subprocess.run(words, text=True)", True),
        ("subprocess.run(words, text=True, encoding='utf-8')", False),
    ],
)
def test_text_in_the_encoding_of_the_machine_is_found(source: str, found: bool) -> None:
    assert bool(list(text_without_encoding(source))) is found


@pytest.mark.thorough
def test_names_of_files_are_valid_on_every_system() -> None:
    """No two names differ in case only, none is a device of Windows, and none holds a character that it reserves."""
    skipped = {".git", ".venv", "build", "out", "dist", "__pycache__"}
    names = [
        path.relative_to(ROOT).as_posix()
        for path in ROOT.rglob("*")
        if not skipped & set(path.relative_to(ROOT).parts) and not path.parts[-1].endswith(".egg-info")
    ]
    assert len(names) > 500
    assert len({name.lower() for name in names}) == len(names)
    assert [name for name in names if PureWindowsPath(name).is_reserved() or re.search(r'[<>:"|?*\\]|[. ]$', name)] == []


# ---------------- Cores, memory, limits and locks of other systems


class Handles:
    """Stand-in for ``os`` and ``msvcrt`` of Windows: no open file is removed, and a byte is locked by one handle."""

    LK_NBLCK = 2

    def __init__(self) -> None:
        self.opened: dict[int, str] = {}
        self.locked: dict[int, str] = {}
        self.path, self.O_RDWR, self.O_CREAT, self.cpu_count = os.path, os.O_RDWR, os.O_CREAT, os.cpu_count

    def open(self, path: str, flags: int, mode: int) -> int:
        handle = os.open(path, flags, mode)
        self.opened[handle] = path
        return handle

    def close(self, handle: int) -> None:
        os.close(handle)
        del self.opened[handle]
        self.locked.pop(handle, None)

    def unlink(self, path: str) -> None:
        if path in self.opened.values():
            raise PermissionError(13, "The process cannot access the file because it is being used by another process")
        os.unlink(path)

    def locking(self, handle: int, mode: int, count: int) -> None:
        assert (mode, count) == (self.LK_NBLCK, 1)
        if self.opened[handle] in self.locked.values():
            raise PermissionError(13, "Permission denied")
        self.locked[handle] = self.opened[handle]


@pytest.fixture
def on_windows(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """``mitsonar.io.system`` as Windows imports it."""
    import psutil  # noqa: F401  # knows which system it runs on

    handles = Handles()
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setitem(sys.modules, "msvcrt", handles)
    for name in ("fcntl", "resource"):
        monkeypatch.setitem(sys.modules, name, None)
    spec = spec_from_file_location("system_on_windows", system.__file__)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "os", handles)
    return module


def test_windows_counts_all_cores_and_the_same_memory(on_windows: ModuleType) -> None:
    assert on_windows.usable_cores() == os.cpu_count()
    assert on_windows.memory_bytes() == pytest.approx(system.memory_bytes(), rel=1e-3)


def test_windows_has_no_limits_of_a_process(on_windows: ModuleType) -> None:
    on_windows.limit_process(2**20, 1)
    assert len(bytearray(2**24)) == 2**24


def test_macos_limits_time_but_not_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """There ``setrlimit`` refuses a limit of the address space."""
    limits: dict[int, tuple[int, int]] = {}

    def setrlimit(kind: int, limit: tuple[int, int]) -> None:
        if kind == 9:
            raise ValueError("current limit exceeds maximum limit")
        limits[kind] = limit

    darwin = SimpleNamespace(
        RLIMIT_AS=9, RLIMIT_CPU=0, RLIMIT_CORE=4, RLIM_INFINITY=-1, getrlimit=lambda kind: (-1, 100), setrlimit=setrlimit
    )
    monkeypatch.setitem(sys.modules, "resource", darwin)
    monkeypatch.setattr(sys, "platform", "darwin")
    system.limit_process(2**30, 300)
    assert limits == {0: (100, 100), 4: (0, 0)}
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(ValueError, match="exceeds"):
        system.limit_process(2**30, 300)


@pytest.mark.linux
def test_a_limited_process_gets_no_more_memory() -> None:
    script = """
from mitsonar.io.system import limit_process
limit_process(2**30, 60)
try:
    bytearray(2**31)
except MemoryError:
    print("refused")
"""
    assert run_python(script).strip() == "refused"


def lock_twice(exclusive_file: Callable[[str], Any], path: Path) -> None:
    """A second lock on a file is refused until the first ends, and nothing stays."""
    with exclusive_file(str(path)):
        assert path.exists()
        for _ in range(2):
            with pytest.raises(BlockingIOError), exclusive_file(str(path)):
                pass
        assert path.exists()
    assert not path.exists()
    path.touch()  # a process that was killed leaves it
    with pytest.raises(KeyError), exclusive_file(str(path)):
        raise KeyError
    assert not path.exists()


def test_a_file_is_locked_once(tmp_path: Path) -> None:
    lock_twice(system.exclusive_file, tmp_path / "writer.lock")


def test_a_file_is_locked_once_on_windows(on_windows: ModuleType, tmp_path: Path) -> None:
    lock_twice(on_windows.exclusive_file, tmp_path / "writer.lock")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("linux", "apt-get install"),
        ("darwin", "brew install llvm"),
        ("win32", "winget install LLVM.LLVM"),
        ("aix", "LLVM 17"),
    ],
)
def test_a_missing_library_is_installed_by_the_command_of_the_system(
    name: str, words: str, monkeypatch: pytest.MonkeyPatch, variant: str
) -> None:
    monkeypatch.setattr(sys, "platform", name)
    monkeypatch.setattr(device, "_backends", lambda: (False, False))
    with pytest.raises(MitsonarError, match="libLLVM was not found") as refusal:
        device.ensure_variant("llvm_ad_mono")
    assert words in str(refusal.value)
    assert "DRJIT_LIBLLVM_PATH" in str(refusal.value)
    assert ("apt-get" in str(refusal.value)) is (name == "linux")


# ---------------- The package as a whole


WITHOUT_UNIX = """
import os, signal, sys, time
import asyncio, multiprocessing.connection, subprocess, tempfile  # they know which system they run on
import fsspec.implementations.local, matplotlib.pyplot, mitsuba, scipy.optimize, typer, zarr
import mitsonar.io.system
os.chdir({folder!r})
for name in {modules}:
    sys.modules[name] = None
for name in {names}:
    owner, _, attribute = name.partition(".")
    if hasattr(sys.modules[owner], attribute):
        delattr(sys.modules[owner], attribute)
sys.argv = ["mitsonar", *{arguments}]
from mitsonar.cli import main
main()
"""


def without_unix(folder: Path, *arguments: str) -> str:
    """What the command line prints in a process without what Windows lacks, in the encoding of a pipe there."""
    modules, names = UNIX_MODULES - {"posix"}, UNIX_NAMES - {"os.sysconf"}  # Python and `memory_bytes` call them here
    given = {"folder": str(folder), "modules": modules, "names": names, "arguments": arguments}
    return run_python(WITHOUT_UNIX.format(**given), PYTHONIOENCODING="cp1252", PYTHONUTF8="0")


@pytest.mark.thorough
@pytest.mark.e2e
def test_a_scene_is_rendered_without_what_windows_lacks(mitsonar: Command, tmp_path: Path) -> None:
    """To the bits that are rendered with it, into a folder whose name the pipe cannot take."""
    words = ("render", "flat_floor", "--sonar", "didson300", "--model", "physical", "--quality", "draft", "-o")
    printed = without_unix(tmp_path, *words, "ship\u2192")
    assert "ship\\u2192" in printed
    assert mitsonar(*words, "ship", cwd=tmp_path).returncode == 0
    for name in ("frames.npz", "poses.tum"):
        assert (tmp_path / "ship\u2192" / name).read_bytes() == (tmp_path / "ship" / name).read_bytes()


# ---------------- What is published, and the tests in CI


WORKFLOW = ROOT / ".github" / "workflows" / "tests.yml"
SYSTEMS = {"ubuntu-latest": "Linux", "macos-latest": "macOS", "windows-latest": "Windows"}


@pytest.fixture(scope="module")
def job() -> dict[str, Any]:
    """The job of the workflow, which any fork may run: without secrets, on every push."""
    text = WORKFLOW.read_text(encoding="utf-8")
    assert "secrets." not in text
    workflow = yaml.safe_load(text)
    assert workflow["permissions"] == {"contents": "read"}
    assert {"push", "pull_request"} <= set(workflow[True])  # YAML 1.1 reads `on` as true
    (job,) = workflow["jobs"].values()
    return dict(job)


def commands(job: dict[str, Any], system_name: str) -> list[str]:
    """The commands that the job runs on a system."""
    condition = f"runner.os == '{system_name}'"
    return [str(step["run"]).strip() for step in job["steps"] if "run" in step and step.get("if", condition) == condition]


def python_versions() -> list[str]:
    """The versions of Python that the classifiers name."""
    versions = (re.fullmatch(r"Programming Language :: Python :: (3\.\d+)", line) for line in PROJECT["classifiers"])
    return [version[1] for version in versions if version]


def test_the_workflow_has_every_system_and_every_python(job: dict[str, Any]) -> None:
    matrix = job["strategy"]["matrix"]
    assert set(matrix["system"]) == set(SYSTEMS)
    assert matrix["python"] == python_versions()
    assert PROJECT["requires-python"] == f">={python_versions()[0]}"


@pytest.mark.parametrize("system_name", SYSTEMS.values())
def test_the_workflow_runs_what_make_test_runs(job: dict[str, Any], system_name: str) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    runner = re.search(r"^PYTEST = OMP_NUM_THREADS=1 \S+/python (-m pytest .*)$", makefile, re.M)
    target = re.search(r"^test: .*\n\t\$\(PYTEST\) (.*) \$\(PYTEST_FLAGS\)$", makefile, re.M)
    assert runner is not None
    assert target is not None
    lines = commands(job, system_name)
    assert shlex.split(lines[-1]) == ["python", *shlex.split(runner[1]), *shlex.split(target[1])]
    assert job["env"]["OMP_NUM_THREADS"] == "1"
    install = next(line for line in lines if "pip install" in line)
    extras = re.search(r"\$\(PIP\) -e (\S+)\n\t@touch \$@\n\nclean", makefile)
    assert extras is not None
    assert install.endswith(extras[1])
    assert (ROOT / ".ci" / "system_libraries").stat().st_mode & 0o100 or os.name != "posix"


@pytest.mark.parametrize(("system_name", "library"), [("macOS", "libLLVM.dylib"), ("Windows", "LLVM-C.dll")])
def test_the_workflow_installs_llvm(job: dict[str, Any], system_name: str, library: str) -> None:
    """By the tool that the system has, and Dr.Jit is given its library."""
    (line,) = [line for line in commands(job, system_name) if " install llvm" in line]
    assert re.search(rf"DRJIT_LIBLLVM_PATH=\S.*{re.escape(library)}['\"] >> \"\$GITHUB_ENV\"", line)
    assert ".ci/system_libraries" not in commands(job, system_name)
    assert ".ci/system_libraries" in commands(job, "Linux")


def test_the_metadata_are_complete() -> None:
    assert (ROOT / PROJECT["readme"]).is_file()
    assert len(PROJECT["description"]) < 120
    assert len(PROJECT["classifiers"]) == len(set(PROJECT["classifiers"]))
    assert PROJECT["classifiers"] == sorted(PROJECT["classifiers"], key=lambda line: line.split(" :: ")[0])
    assert not any(line.startswith("License ::") for line in PROJECT["classifiers"])  # `license` gives it
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (citation["version"], citation["license"]) == (PROJECT["version"], PROJECT["license"])
    assert [author["name"] for author in citation["authors"]] == [author["name"] for author in PROJECT["authors"]]


def test_every_extra_for_users_is_documented_with_its_size() -> None:
    table = (ROOT / "docs" / "start.md").read_text(encoding="utf-8")
    for extra in set(PROJECT["optional-dependencies"]) - {"all", "cuda", "dev"}:
        assert re.search(rf"^\| `{extra}` \| .+ \| (\d.* [MG]B.*|varies) \|$", table, re.M), extra
