"""Help texts as they are written: rich takes ``[m]`` for markup and would leave it out."""

from __future__ import annotations

from typing import Any

from rich.markup import escape

__all__ = ["with_plain_brackets"]


def with_plain_brackets(command: Any) -> Any:
    """Escape brackets in the help of a command, of its options, and of the commands in it that are there already.

    A group that makes its commands when they are asked for calls this itself.

    Args:
        command: Click's, as :func:`typer.main.get_command` makes it; it is changed and returned.
    """
    command.help = command.help and escape(command.help)
    for parameter in command.params:
        text = getattr(parameter, "help", None)
        if text:
            parameter.help = escape(text)
    for inner in getattr(command, "commands", {}).values():
        with_plain_brackets(inner)
    return command
