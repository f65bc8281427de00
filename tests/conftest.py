"""What all tests share: the variant, and the markers that need a device or an extra."""

from __future__ import annotations

import functools
import gc
import importlib.util
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers import Command, Done, tiny_recipe

LONGEST = (
    "test_docs.py",
    "test_readme.py",
    "04_networks.ipynb",
    "03_odometry.ipynb",
    "02_dataset.ipynb",
    "test_generation.py",
    "test_reproduce.py",
    "test_training_run.py",
    "test_evaluation.py",
)
"""Files in the order in which they begin: begun last, one of them would keep one core busy while the other waits."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files, mark what goes through the command line, skip what this machine lacks."""
    items.sort(key=_turn)
    for item in items:
        item.add_marker("e2e" if _is_end_to_end(item) else "unit")
    _skip_what_is_absent(items)


def pytest_configure() -> None:
    """Import the test files without collections of garbage, which take a quarter of it."""
    gc.disable()


def pytest_collection_finish() -> None:
    """Leave what all test files have imported out of garbage collections, of which each data set makes several."""
    gc.collect()
    gc.freeze()
    gc.enable()


def _turn(item: pytest.Item) -> int:
    name = item.path.name
    return LONGEST.index(name) if name in LONGEST else len(LONGEST)


def _is_end_to_end(item: pytest.Item) -> bool:
    by_hand = item.get_closest_marker("e2e") is not None
    return by_hand or item.path.parent.name == "cli" or "mitsonar" in getattr(item, "fixturenames", ())


def _skip_what_is_absent(items: list[pytest.Item]) -> None:
    """Skip and say so; with MITSONAR_REQUIRE_LEARN=1 an absent torch fails the tests instead."""
    skips = []
    if importlib.util.find_spec("torch") is None and os.environ.get("MITSONAR_REQUIRE_LEARN") != "1":
        reason = "torch is not installed: install mitsonar[learn]; MITSONAR_REQUIRE_LEARN=1 makes this a failure"
        skips.append(("learn", pytest.mark.skip(reason=reason)))
    if any(item.get_closest_marker("gpu") for item in items) and not _has_cuda():
        skips.append(("gpu", pytest.mark.skip(reason="no CUDA device")))
    if os.name != "posix":
        skips.append(("posix", pytest.mark.skip(reason="needs signals, pipes or links as Linux and macOS have them")))
    if not sys.platform.startswith("linux"):
        skips.append(("linux", pytest.mark.skip(reason="needs /proc")))
    for item in items:
        for name, skip in skips:
            if item.get_closest_marker(name):
                item.add_marker(skip)


def _has_cuda() -> bool:
    import drjit as dr

    return bool(dr.has_backend(dr.JitBackend.CUDA))


@pytest.fixture(scope="session")
def variant() -> str:
    """A Mitsuba variant is set."""
    from mitsonar.simulation.device import ensure_variant

    return ensure_variant()


@pytest.fixture(scope="session")
def tiny_data(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Path:
    """The data set of the tiny recipe, made once for all modules of a worker: to read, and to copy before any harm."""
    from mitsonar.datasets.make import make_dataset

    url = tmp_path_factory.mktemp("made") / "tiny.zarr"
    make_dataset(tiny_recipe(), str(url))
    return url


@pytest.fixture(scope="module")
def bare_curves() -> Iterator[Callable[..., Any]]:
    """An empty figure in place of a training's curve, which takes half a second at each validation; gives the real one."""
    from matplotlib.figure import Figure

    from mitsonar.training import journal

    real = journal.curve_figure
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(journal, "curve_figure", lambda *_: Figure(figsize=(1, 1)))
        yield real


@functools.cache
def _command_line() -> Any:
    """What ``main`` calls, made once: the commands and their options take longer to build than most commands to refuse."""
    import typer

    from mitsonar.cli import application
    from mitsonar.cli.console import with_plain_brackets

    return with_plain_brackets(typer.main.get_command(application()))


@pytest.fixture
def mitsonar(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Command:
    """The command line in this process, which saves its start: ``mitsonar("render", scene, cwd=folder)``."""

    def run(*arguments: object, cwd: Path | None = None) -> Done:
        capfd.readouterr()
        with monkeypatch.context() as changed, warnings.catch_warnings():
            changed.setattr(sys, "argv", ["mitsonar", *map(str, arguments)])
            changed.chdir(cwd or Path.cwd())
            with pytest.raises(SystemExit) as end:
                _command_line()()
        return Done(int(end.value.code or 0), *capfd.readouterr())

    return run


@pytest.fixture(scope="module", autouse=True)
def scenes_of_before_are_gone() -> None:
    """Free the scenes of other files: each kernel with virtual calls holds the code of all plugins that are alive."""
    if "drjit" in sys.modules:
        from mitsonar.simulation.device import release_memory

        release_memory()
        gc.freeze()
