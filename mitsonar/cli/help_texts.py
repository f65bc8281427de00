"""Help texts with square brackets, such as ``[m]``, which rich would take for markup and omit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar

from rich.markup import escape

__all__ = ["with_plain_brackets"]


class Helpful(Protocol):
    """What a Click command has, in Click itself and in Typer's copy of it."""

    help: str | None

    @property
    def params(self) -> Sequence[object]:
        """Return the options and arguments."""


AnyCommand = TypeVar("AnyCommand", bound=Helpful)


def with_plain_brackets(command: AnyCommand) -> AnyCommand:
    """Escape brackets in the help of a command, of its options, and of its existing subcommands.

    A group that creates its commands on demand calls this itself.

    Args:
        command: a Click command of :func:`typer.main.get_command`. It is changed.

    Returns:
        The same command.
    """
    command.help = command.help and escape(command.help)
    for parameter in command.params:
        text = getattr(parameter, "help", None)
        if text:
            parameter.help = escape(text)  # type: ignore[attr-defined]  # arguments have help in Typer only
    for inner in getattr(command, "commands", {}).values():
        with_plain_brackets(inner)
    return command
