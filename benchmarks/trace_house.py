"""What a reader must open to follow a command, and how large the code is: two tables in Markdown.

    python benchmarks/trace_house.py [--house FOLDER] [--quick]

Runs five commands on small inputs, each in a process of its own with `sys.settrace`, and counts the files of mitsonar that
were entered and the distinct lines that were run. A file of which fewer than MUCH lines run is entered in passing. Lines of
imports and class bodies do not count. The code is only reached through `python -m mitsonar`, so that a checkout of another
version can be traced (`--house`). `--quick` traces two commands. Ends with code 1 if a path exceeds its budget by a tenth.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import json
import math
import os
import runpy
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

MUCH = 20
PACKAGE, EVERYTHING = ("mitsonar", "plugins"), ("mitsonar", "plugins", "scenes", "tests", "benchmarks", "docs")

RECIPE = """\
{name: tiny, world: {family: rocky-field, size_m: 20, a_side: [6, 10]}, scenes: [{count: 3, sequences: 4}],
 sonar: {preset: didson300, model: thesis, bearing: azimuth, gain_exponent: 0, rays_per_beam: 60, range_bins: 128},
 mount: {pitch_deg: 35}}
"""

RUN = ("render", "pattern", "--frames", "2", "--from=0,-4,2.5,35,0,0", "--to=0.01,-3.99,2.5,35,0,0", "-o", "run")
PATHS: dict[str, tuple[str, ...]] = {
    "XML to frames": RUN,
    "pair to path": ("odometry", "run", "--workers", "1", "-o", "path"),
    "frames to mosaic": ("mosaic", "run", "path", "-o", "map.png"),
    "echoes to response": ("impulse", "hydrophones", "--velocity", "1,0.5", "--frames", "2", "-o", "received"),
    "recipe to checkpoint": (
        *("train", "posenet-normx10", "--data", "tiny.zarr", "--set", "network.width=0.03", "--set", "batch=4"),
        *("--pairs", "8", "--workers", "0", "-o", "checkpoint"),
    ),
}
BUDGET = {"XML to frames": (53, 1_800), "pair to path": (35, 1_700)}
"""Files entered and lines run that a path may have, and a tenth more."""

MADE_FIRST = {"recipe to checkpoint": ("dataset", "make", "tiny.yaml", "--workers", "1", "-o", "tiny.zarr")}
"""Input of a path that no path before it makes."""


def main() -> None:
    """Print the tables, in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--house", type=Path, default=Path(__file__).resolve().parents[1], help="a checkout of mitsonar")
    parser.add_argument("--quick", action="store_true", help="only the first two paths")
    parser.add_argument("--child", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    house = arguments.house.resolve()
    if arguments.child:
        return traced(house, Path(arguments.child[0]), arguments.child[1:])
    exceeded: list[str] = []
    print(f"| path | files entered | of these {MUCH} lines or more | lines run |\n|---|---|---|---|")
    for name, lines in paths(house, 2 if arguments.quick else len(PATHS)):
        much = sum(count >= MUCH for count in lines.values())
        print(f"| {name} | {len(lines)} | {much} | {sum(lines.values()):,} |", flush=True)
        exceeded += [name] if exceeds_budget(name, lines) else []
    print("\n| code | count |\n|---|---|")
    for name, count in counts(house):
        print(f"| {name} | {count} |")
    if exceeded:
        sys.exit(f"these paths exceed their BUDGET by more than a tenth: {', '.join(exceeded)}")


# ---------------------------------------------------------------- tracing


def paths(house: Path, many: int) -> Iterable[tuple[str, dict[str, int]]]:
    """Yield the name of each path and the lines run in each file that it enters."""
    environment = {**os.environ, "PYTHONPATH": str(house), "OMP_NUM_THREADS": "1", "COLUMNS": "200"}
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "tiny.yaml").write_text(RECIPE, encoding="utf-8")

        def run(*words: str) -> None:
            done = subprocess.run([sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True)
            if done.returncode:
                raise SystemExit(f"{' '.join(words)}\n{done.stdout}{done.stderr}")

        for name, words in list(PATHS.items())[:many]:
            if name in MADE_FIRST:
                run("-m", "mitsonar", *MADE_FIRST[name])
            run(__file__, "--house", str(house), "--child", "lines.json", *words)
            yield name, json.loads(Path(folder, "lines.json").read_text(encoding="utf-8"))


def exceeds_budget(name: str, lines: dict[str, int]) -> bool:
    """Return whether a path enters more files or runs more lines than its budget and a tenth."""
    files, run = BUDGET.get(name, (math.inf, math.inf))
    return len(lines) > 1.1 * files or sum(lines.values()) > 1.1 * run


def traced(house: Path, out: Path, words: list[str]) -> None:
    """Run a command of mitsonar in this process and write how many lines of each file it ran."""
    seen: dict[CodeType, set[int]] = {}
    inside = tuple(str(house / part) + os.sep for part in PACKAGE)

    def enter(frame: FrameType, event: str, _: object) -> Callable[..., Any] | None:
        code = frame.f_code
        if not code.co_filename.startswith(inside) or not code.co_flags & inspect.CO_OPTIMIZED:
            return None  # not mitsonar, or the body of a module or a class
        lines = seen.setdefault(code, set())

        def line(frame: FrameType, event: str, _: object) -> Callable[..., Any]:
            lines.add(frame.f_lineno)
            return line

        return line

    sys.argv = ["mitsonar", *words]
    threading.settrace(enter)
    sys.settrace(enter)
    try:
        runpy.run_module("mitsonar", run_name="__main__")
    except SystemExit as done:
        if done.code:
            raise
    finally:
        sys.settrace(None)
    files: dict[str, set[int]] = {}
    for code, lines in seen.items():
        files.setdefault(str(Path(code.co_filename).resolve().relative_to(house)), set()).update(lines)
    out.write_text(json.dumps({name: len(lines) for name, lines in files.items()}), encoding="utf-8")


# ---------------------------------------------------------------- counting


def counts(house: Path) -> Iterable[tuple[str, str]]:
    """Count what needs no run."""
    sources = {path: path.read_text(encoding="utf-8") for part in EVERYTHING for path in files_of(house / part)}
    package = {path: text for path, text in sources.items() if path.relative_to(house).parts[0] in PACKAGE}
    trees = {path: ast.parse(text) for path, text in package.items()}
    nodes = [node for tree in trees.values() for node in ast.walk(tree)]
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    classes = [node.name for node in nodes if isinstance(node, ast.ClassDef) and not node.name.startswith("_")]
    long = [node for node in functions if node.end_lineno is not None and node.end_lineno - node.lineno >= 50]
    yield "`Any` in signatures", str(sum(named_any(function) for function in functions))
    yield "imports of mitsonar within functions", str(sum(late_imports(tree) for tree in trees.values()))
    yield "basenames twice", repeated(path.name for path in package if path.name != "__init__.py")
    yield "public class names twice", repeated(classes)
    for name, parts in (("mitsonar and plugins", PACKAGE), *((part, (part,)) for part in EVERYTHING[3:])):
        local = [text for path, text in sources.items() if path.relative_to(house).parts[0] in parts]
        yield f"lines, {name}", f"{sum(text.count(chr(10)) for text in local):,} in {len(local)} files"
    yield "files over 400 lines", str(sum(text.count("\n") > 400 for text in package.values()))
    yield "functions over 50 lines", str(len(long))


def files_of(folder: Path) -> list[Path]:
    """Python files, without those behind links."""
    return sorted(path for path in folder.rglob("*.py") if path.resolve() == path)


def named_any(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count `Any` in a signature."""
    local = function.args
    words = [*local.posonlyargs, *local.args, *local.kwonlyargs, *filter(None, (local.vararg, local.kwarg))]
    hints = [word.annotation for word in words] + [function.returns]
    return sum(isinstance(n, ast.Name) and n.id == "Any" for hint in hints if hint for n in ast.walk(hint))


def late_imports(tree: ast.Module) -> int:
    """How many lines within functions import mitsonar."""
    inner = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    result = {node for function in inner for node in ast.walk(function) if isinstance(node, ast.Import | ast.ImportFrom)}
    names = [node.module or "" if isinstance(node, ast.ImportFrom) else node.names[0].name for node in result]
    return sum(name.partition(".")[0] == "mitsonar" for name in names)


def repeated(names: Iterable[str]) -> str:
    """How many names stand more than once, and which."""
    twice = sorted(name for name, count in Counter(names).items() if count > 1)
    return str(len(twice)) + (f" ({', '.join(twice)})" if twice else "")


if __name__ == "__main__":
    main()
