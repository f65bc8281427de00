"""The Docker file, as far as it can be tried without docker: what it installs, from which files, and what it starts."""

from __future__ import annotations

import fnmatch
import json
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from mitsonar.errors import EXTRAS

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

BUILD = "from setuptools import build_meta; import sys; build_meta.build_wheel(sys.argv[1])"


def instructions() -> list[tuple[str, str]]:
    """The instructions of the Docker file, in their order: name and arguments."""
    text = (ROOT / ".ci" / "Dockerfile").read_text(encoding="utf-8")
    lines = re.sub(r"\\\n", " ", re.sub(r"^#.*\n", "", text, flags=re.MULTILINE)).splitlines()
    return [(name, rest) for name, _, rest in (line.partition(" ") for line in lines if line)]


def arguments(name: str) -> list[str]:
    return [rest for kind, rest in instructions() if kind == name]


def context() -> list[str]:
    """The tracked files that the build sees: of the patterns of `Dockerfile.dockerignore` the last that applies decides."""
    lines = (ROOT / ".ci" / "Dockerfile.dockerignore").read_text(encoding="utf-8").splitlines()
    patterns = [line for line in lines if line and not line.startswith("#")]
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not in a clone: which files are tracked is unknown")
    tracked = [name for name in listed.stdout.splitlines() if (ROOT / name).is_file()]
    for pattern in patterns:
        path = pattern.removeprefix("!")
        applies = any(fnmatch.fnmatch(name, path) or name.startswith(f"{path}/") for name in tracked)
        assert applies or path == "**/__pycache__", f"{pattern} applies to no file"

    def sent(name: str) -> bool:
        kept = True
        for pattern in patterns:
            path = pattern.removeprefix("!")
            if fnmatch.fnmatch(name, path) or name.startswith(f"{path}/"):
                kept = pattern.startswith("!")
        return kept

    return [name for name in tracked if sent(name)]


def test_system_packages_are_those_of_the_script_that_ci_runs() -> None:
    """The script itself runs, as root, before anything else is installed; nothing is installed without it."""
    runs = [rest for kind, rest in instructions() if kind == "RUN"]
    assert runs[0].split(" && ")[0] == "/opt/mitsonar/.ci/system_libraries"
    assert "apt-get install" not in " ".join(runs)
    assert not arguments("USER")
    assert (ROOT / ".ci" / "system_libraries").stat().st_mode & 0o111 == 0o111
    copied = arguments("COPY")
    assert copied == [".ci/system_libraries /opt/mitsonar/.ci/", ". /opt/mitsonar"]
    order = [kind for kind, _ in instructions()]
    assert order.index("COPY") < order.index("RUN")
    # the base is the Debian whose libLLVM the script names first, and the Python of the constraints
    base = re.fullmatch(r"python:(3\.\d+)-slim-trixie", arguments("FROM")[0])
    assert base
    assert f"(Python {base[1]})" in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()[0]
    assert "llvm=libllvm19" in (ROOT / ".ci" / "system_libraries").read_text(encoding="utf-8")


def test_extras_exist_and_leave_out_torch() -> None:
    install = next(rest for rest in arguments("RUN") if "pip install" in rest)
    assert "-c constraints.txt" in install
    result = re.search(r"'\.\[(.*)\]'", install)
    assert result
    extras = result[1].split(",")
    named = {extra for names, _ in EXTRAS.values() for extra in names.split(",")}
    assert set(extras) <= set(PROJECT["optional-dependencies"]) & named
    needs = " ".join(one for extra in extras for one in PROJECT["optional-dependencies"][extra])
    assert "torch" not in needs
    assert "learn" not in needs


def test_the_context_holds_what_a_wheel_needs_and_no_more() -> None:
    files = context()
    assert {"pyproject.toml", "constraints.txt", "README.md", "LICENSE", ".ci/system_libraries"} <= set(files)
    folders = {name.split("/")[0] for name in files if "/" in name}
    assert folders == {".ci", "mitsonar", "plugins", "scenes", "benchmarks"}
    assert not [
        name for name in files if name.endswith(".ipynb") or name.startswith(("tests/", "docs/", "benchmarks/results"))
    ]


@pytest.mark.thorough
def test_a_wheel_of_the_context_holds_all_and_its_entry_point_starts(tmp_path: Path) -> None:
    """Only the files that docker would send: build, unpack, and start what the image starts."""
    pytest.importorskip("setuptools")
    for name in context():
        (tmp_path / "context" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, tmp_path / "context" / name)
    build = subprocess.run(
        [sys.executable, "-c", BUILD, str(tmp_path)], cwd=tmp_path / "context", capture_output=True, text=True, timeout=300
    )
    assert build.returncode == 0, build.stderr
    unpacked = tmp_path / "unpacked"
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        wheel.extractall(unpacked)
    packaged = {path.relative_to(unpacked).as_posix() for path in unpacked.rglob("*")}
    code = {name for name in context() if name.startswith("mitsonar/") and name.endswith(".py")}
    assert code <= packaged
    assert {"mitsonar/scenes/objects.xml", "mitsonar/plugins/imaging_sonar_sensor.py"} <= packaged

    [entry] = map(json.loads, arguments("ENTRYPOINT"))
    [command] = map(json.loads, arguments("CMD"))
    module, function = PROJECT["scripts"][entry[0]].split(":")
    script = f"import sys, {module} as m; sys.argv[0] = {entry[0]!r}; print(m.__file__); m.{function}()"
    done = subprocess.run(
        [sys.executable, "-c", script, *entry[1:], *command],
        cwd=tmp_path,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(unpacked), "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(unpacked))
    assert all(name in done.stdout for name in ("render", "odometry", "serve"))
