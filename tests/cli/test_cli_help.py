"""Help texts say what they say in the code: nothing in brackets is lost on the way to the terminal."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
import typer
from helpers import Command

from mitsonar.cli import application
from mitsonar.cli.console import with_plain_brackets


def commands(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command with the words that call it."""
    yield words, command
    if hasattr(command, "list_commands"):
        for name in command.list_commands(None):
            yield from commands(command.get_command(None, name), (*words, name))


def in_brackets(command: Any) -> list[str]:
    """What stands in brackets in the texts of a command and its options, without the escapes."""
    texts = [command.help, *(getattr(parameter, "help", None) for parameter in command.params)]
    return [result for text in texts if text for result in re.findall(r"\[[^\]]+\]", text.replace("\\[", "["))]


TREE = dict(commands(typer.main.get_command(application())))


def test_the_help_texts_hold_units_at_all() -> None:
    """Else the test below would test nothing."""
    assert {("odometry",), ("mosaic",), ("crlb",), ("world", "rocky-field")} <= {w for w in TREE if in_brackets(TREE[w])}
    assert sum(in_brackets(one).count("[m]") for one in TREE.values()) >= 10


@pytest.mark.parametrize("words", TREE, ids=" ".join)
def test_every_unit_in_brackets_is_printed(
    words: tuple[str, ...], mitsonar: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "250")
    monkeypatch.setenv("TERMINAL_WIDTH", "250")
    done = mitsonar(*words, "--help")
    assert done.returncode == 0, done.stderr
    printed = "".join(re.sub(r"[│\s]", "", line) for line in done.stdout.splitlines())
    for text in in_brackets(TREE[words]):
        assert re.sub(r"\s", "", text) in printed
        assert "\\[" not in printed


def test_a_group_that_is_made_at_once_is_escaped_as_a_whole() -> None:
    """Commands, groups and options; the default that typer adds itself is no part of it."""
    app, inner = typer.Typer(), typer.Typer(help="A group [s].")

    def measure(height: float = typer.Option(1.0, help="Over the ground [m].")) -> None:
        """Tell a height [m]."""

    inner.command()(measure)
    inner.command("again")(measure)
    app.add_typer(inner, name="group")
    app.command("one")(measure)
    result: Any = with_plain_brackets(typer.main.get_command(app))
    group = result.commands["group"]
    assert group.help == r"A group \[s]."
    for command in (result.commands["one"], group.commands["measure"]):
        assert command.help == r"Tell a height \[m]."
        assert command.params[0].help == r"Over the ground \[m]."
