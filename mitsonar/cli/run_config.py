"""How are the options of a command read from a file, and written for the next time? ``run.yaml`` in the folder of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

from mitsonar.errors import MitsonarError, short_repr, suggest_names

__all__ = ["Config", "configuration_of", "merged_pairs"]


Parameter: TypeAlias = Any
"""An option or argument of Click, in Click itself or in Typer's copy of it."""

PAIRS = ("--set", "-D")
"""Options that take KEY=VALUE; a file holds a mapping."""

NAMES = {"-D": "parameters"}
"""Keys of options without a long name."""

UNWRITTEN = ("help", "config", "out", "overwrite", "resume")
"""Keys that do not describe a run, but where and how it begins; ``out`` may be read."""

COMMAND = "command"
"""Key of the name of the command."""


def read_config(ctx: typer.Context, value: Path | None) -> Path | None:
    """Take the options of a file as defaults of those that the command line lacks; a callback of Typer."""
    if value is None or ctx.resilient_parsing:
        return value
    try:
        ctx.default_map = _options_in(value, ctx)
    except MitsonarError as error:
        typer.echo(f"error: {' '.join(str(error).split())}", err=True)
        raise typer.Exit(2) from None
    return value


Config = Annotated[
    Path | None,
    typer.Option(
        "--config",
        is_eager=True,
        callback=read_config,
        help="YAML file of options, such as run.yaml of an earlier run; the command line overrides it.",
    ),
]


def merged_pairs(ctx: typer.Context, param: typer.CallbackParam, value: list[str] | None) -> list[str]:
    """Return the pairs of the file followed by those of the command line, which override them; a callback of Typer.

    Without any pair the list is empty, never None: Typer 0.15 takes the length of what a callback returns.
    """
    of_file = (ctx.default_map or {}).get(str(param.name))
    if not of_file or value is None or list(value) == list(of_file):
        return list(value or ())
    return [*of_file, *value]


def configuration_of(ctx: typer.Context) -> dict[str, Any]:
    """Return the options of a command as its file holds them, including defaults, without where the run goes."""
    table: dict[str, Any] = {COMMAND: ctx.info_name}
    for key, param in _parameters(ctx).items():
        value = ctx.params.get(param.name)
        is_empty = isinstance(value, list | tuple) and not value
        if key in UNWRITTEN or value is None or value is False or is_empty:
            continue
        if _takes_pairs(param):
            pairs = [str(pair).partition("=") for pair in value]
            table[key] = {name: _plain(text) for name, _, text in pairs}
        else:
            table[key] = list(map(str, value)) if param.multiple else value if isinstance(value, int | float) else str(value)
    return table


def _plain(text: str) -> str | int | float:
    """Return a number if it is written as the text; otherwise the text."""
    for kind in (int, float):
        try:
            number: int | float = kind(text)
        except ValueError:
            continue
        if str(number) == text:
            return number
    return text


def _parameters(ctx: typer.Context) -> dict[str, Parameter]:
    """Return the options and arguments of the command, keyed by their keys in a file."""
    table: dict[str, Parameter] = {}
    for param in ctx.command.params:
        long = next((option for option in param.opts if option.startswith("--")), None)
        key = long[2:].replace("-", "_") if long else NAMES.get(param.opts[0], str(param.name))
        table[key] = param
    return table


def _takes_pairs(param: Parameter) -> bool:
    return any(option in PAIRS for option in param.opts)


def _options_in(path: Path, ctx: typer.Context) -> dict[str, Any]:
    """Return the options in a file, keyed as Click keys them.

    Raises:
        MitsonarError: the file cannot be read, belongs to another command, or has an unknown key or an unfit value.
    """
    from mitsonar.instruments.sonar import Sonar
    from mitsonar.io.files import read_yaml

    table = read_yaml(path, "configuration")
    if not isinstance(table, dict):
        raise MitsonarError(f"{path} must hold options of `mitsonar {ctx.info_name}` as KEY: VALUE, one a line")
    known = {key: param for key, param in _parameters(ctx).items() if key == "out" or key not in UNWRITTEN}
    result = {}
    for name, value in table.items():
        key = str(name).replace("-", "_")
        if key == COMMAND:
            if value != ctx.info_name:
                raise MitsonarError(f"{path} is a configuration of the command {short_repr(value)}, not of {ctx.info_name}")
        elif key not in known:
            if "set" in known and key in Sonar.model_fields:
                raise MitsonarError(
                    f"{path}: {name} is a key of the sonar: give it below `set`, as {name}: {short_repr(value)}"
                )
            raise MitsonarError(f"{path}: unknown key {short_repr(name)}: {suggest_names(key, known)}")
        elif value is not None:
            result[str(known[key].name)] = _value(value, known[key], f"{path}: {key}")
    return result


def _value(value: object, param: Parameter, what: str) -> object:
    """Return the value of a key as the command line has it; Click then checks words that are to be numbers.

    Raises:
        MitsonarError: a value that no option has.
    """
    if getattr(param, "is_flag", False):
        if not isinstance(value, bool):
            raise MitsonarError(f"{what} must be true or false: got {short_repr(value)}")
        return value
    if _takes_pairs(param):
        if not isinstance(value, Mapping):
            raise MitsonarError(f"{what} must hold KEY: VALUE pairs: got {short_repr(value)}")
        return [f"{key}={_text(one, f'{what}.{key}')}" for key, one in value.items()]
    values = value if isinstance(value, list) else [value]
    texts = [_text(one, what) for one in values]
    return texts if getattr(param, "multiple", False) else ",".join(texts)  # 1,2,3 of the command line may be a list


def _text(value: object, what: str) -> str:
    """Return a word or a number as the command line has it.

    Raises:
        MitsonarError: another type.
    """
    if not isinstance(value, str | int | float):
        raise MitsonarError(f"{what} must be a word or a number: got {short_repr(value)}")
    return str(value).lower() if isinstance(value, bool) else str(value)
