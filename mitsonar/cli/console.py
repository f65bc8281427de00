"""Output of all commands: errors, warnings and progress."""

from __future__ import annotations

import errno
import functools
import inspect
import json
import logging
import math
import os
import shlex
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from types import FrameType, TracebackType
from typing import ParamSpec, Protocol, TypeVar

import typer
from rich.markup import escape

from mitsonar.errors import MitsonarError, MitsonarWarning, missing_package_error, one_line, printable

__all__ = [
    "LaterBar",
    "Terminated",
    "answered",
    "changes_of",
    "command_line",
    "numbers",
    "progress_bar",
    "say",
    "say_json",
    "say_stopped",
    "warn",
    "with_plain_brackets",
]


P = ParamSpec("P")
R = TypeVar("R")


def say(text: str) -> None:
    """Print a line on standard output."""
    typer.echo(printable(text))


def say_json(value: object, indent: int = 2) -> None:
    """Print a value as JSON; nan and infinities become null."""
    say(json.dumps(_with_nulls(value), indent=indent, allow_nan=False))


def _with_nulls(value: object) -> object:
    if isinstance(value, dict):
        return {key: _with_nulls(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_with_nulls(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def warn(text: str) -> None:
    """Print a warning on standard error."""
    typer.echo(f"warning: {one_line(text)}", err=True)


class Terminated(KeyboardInterrupt):
    """Raised at SIGTERM: a command ends as after Ctrl-C, with another exit code."""


RESUMES = ("make", "reproduce")
"""Commands that resume without an option; others resume with ``--resume``, if they can."""


def _resume_hint(command: Callable[..., object]) -> str:
    """Return the part of a sentence that explains how to resume a stopped command; empty if it cannot."""
    if command.__name__ in RESUMES:
        return ": complete files stay on disk, and the same command continues"
    if "resume" in inspect.signature(command).parameters:
        return ": complete files stay on disk, and the same command with --resume continues"
    return ""


def say_stopped(command: Callable[..., object], stop: KeyboardInterrupt) -> int:
    """Print that Ctrl-C or SIGTERM has stopped a command and how to resume it; return the exit code."""
    _silence_asyncio()
    typer.echo(f"stopped{_resume_hint(command)}", err=True)
    return 128 + (signal.SIGTERM if isinstance(stop, Terminated) else signal.SIGINT)


def _silence_asyncio() -> None:
    """Silence asyncio, which logs writes of Zarr's thread that were abandoned."""
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)


@contextmanager
def _signals_stop() -> Iterator[None]:
    """Raise :class:`Terminated` at SIGTERM and KeyboardInterrupt at Ctrl-C, whatever exception reaches the caller.

    Native code that calls Python replaces the exception of a signal by its own, and an interrupted import may fail with
    any exception. A second SIGTERM ends the process at once, and so does one in a child that was forked.
    """
    usual: dict[int, object] = {signal.SIGTERM: signal.SIG_DFL, signal.SIGINT: signal.default_int_handler}
    handled = [number for number, handler in usual.items() if signal.getsignal(number) is handler]
    if threading.current_thread() is not threading.main_thread():
        handled = []
    owner, received = os.getpid(), list[type[KeyboardInterrupt]]()

    def stop(number: int, _: FrameType | None) -> None:
        signal.signal(number, usual[number])  # type: ignore[arg-type]
        if os.getpid() != owner:
            os.kill(os.getpid(), number)
        received.append(Terminated if number == signal.SIGTERM else KeyboardInterrupt)
        raise received[0]

    for number in handled:
        signal.signal(number, stop)
    try:
        yield
    except Exception:
        if received:
            raise received[0] from None
        raise
    finally:
        for number in handled:
            signal.signal(number, usual[number])  # type: ignore[arg-type]


GEOMETRY = {"height_m": "--height", "pitch_rad": "--pitch-deg", "pitch_deg": "--pitch-deg"}
INSTRUMENT = {"model": "--model", "seed": "--seed"}

OPTIONS: dict[str, dict[str, str]] = {
    "render": INSTRUMENT,
    "crlb": {**INSTRUMENT, "height_m": "--height", "gain": "--gain"},
    "sound": INSTRUMENT,
    "serve": {**INSTRUMENT, "rate_hz": "--rate"},
    "impulse": {**INSTRUMENT, "velocity": "--velocity"},
    "sas": {"far_m": "--range", "ground_m": "--ground"},
    "image": {"range_bins": "--bins", "range_min": "--range", "range_max": "--range"},
    "odometry": {**GEOMETRY, **{name: f"--{name}" for name in ("every", "closure", "smooth")}},
    "height": {"pitch_rad": "--pitch-deg", "pitch_deg": "--pitch-deg"},
    "heights": {**GEOMETRY, "cells": "--cells"},
    "mosaic": {**GEOMETRY, "cell_m": "--cell-mm", "centre_beams": "--centre-beams"},
    "compare": {
        "height_m": "NAME:height_m=METRES",
        "pitch_rad": "NAME:pitch_deg=DEGREES",
        **{name: f"--{name}" for name in ("estimators", "reference", "perturb", "jitter", "prior", "part", "split")},
    },
    "mesh": {"up": "--up", "scale": "--scale", "floor_m": "--floor-m", "reflectivity": "--reflectivity"},
    "import_scene": {"reflectivity": "--reflectivity", "seabed_z": "--seabed-z"},
    "reproduce": {"minutes": "--minutes"},
    "show": {"height_m": "--height"},
    "convert": {
        **{name: f"--{name.replace('_', '-')}" for name in ("beams", "crop_bins", "crop_beams")},
        "level_db": "--scan-db",
        "from_m": "--scan-from",
    },
    "odometry_benchmark": {"frames": "--frames"},
}
"""Option of an argument that a message names (:func:`mitsonar.errors.argument`), keyed by command."""


def command_line(*words: object) -> str:
    """Return a command of mitsonar that can be pasted into a shell. Words with spaces are quoted."""
    return shlex.join(["mitsonar", *map(str, words)])


def answered(command: Callable[P, R], options: Mapping[str, str] | None = None) -> Callable[P, R]:
    """Wrap a command so that errors, a full disk, Ctrl-C and SIGTERM end it with one sentence instead of a traceback.

    Args:
        command: the function of the command.
        options: by argument, the option that messages name; default: those of :data:`OPTIONS`.

    Returns:
        The command, which exits with code 2 after an error, with 130 after Ctrl-C and with 143 after SIGTERM.
    """
    typed = OPTIONS.get(command.__name__, {}) if options is None else options

    @functools.wraps(command)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        warnings.filterwarnings("always", category=MitsonarWarning)
        warnings.showwarning = _show
        try:
            with _signals_stop():
                return command(*args, **kwargs)
        except MitsonarError as error:
            typer.echo(f"error: {error.with_options(typed)}", err=True)
        except ModuleNotFoundError as error:
            typer.echo(f"error: {missing_package_error(error)}", err=True)
        except BrokenPipeError:  # the reader of our output has ended, which is no error
            raise typer.Exit(0) from None
        except OSError as error:
            _silence_asyncio()
            where = f" ({error.filename})" if error.filename else ""
            hint = ""
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
                hint = _resume_hint(command)
            elif error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
                hint = "; change its permissions, or give another path"
            typer.echo(f"error: {error.strerror or error}{where}{hint}", err=True)
        except MemoryError:
            less = "frames or pings, beams, rays or bins of the sonar, objects of a world"
            typer.echo(f"error: out of memory; ask for less: {less}", err=True)
        except RuntimeError as error:
            if "memory" not in str(error):
                raise
            typer.echo("error: out of memory; lower --rays-per-launch, or the sonar's beams, rays or bins", err=True)
        except KeyboardInterrupt as stop:
            raise typer.Exit(say_stopped(command, stop)) from None
        raise typer.Exit(2)

    return wrapped


def _show(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    if issubclass(category, MitsonarWarning):
        warn(str(message))


def numbers(text: str | None, count: int, what: str) -> list[float] | None:
    """Parse ``count`` numbers that are separated by commas; None stays None.

    Raises:
        MitsonarError: the text is not that many finite numbers.
    """
    if text is None:
        return None
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        raise MitsonarError(f"{what} takes {count} numbers, separated by commas: got {text!r}")
    if not all(map(math.isfinite, values)):
        raise MitsonarError(f"{what} takes finite numbers: got {text!r}")
    return values


def changes_of(pairs: list[str], seed: int | None) -> dict[str, object]:
    """Parse KEY=VALUE pairs, with values in YAML, and add a seed.

    Raises:
        MitsonarError: a pair has no key or no ``=``, or its value is not YAML.
    """
    from mitsonar.io.files import parse_yaml

    changes: dict[str, object] = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not (key and equals):
            raise MitsonarError(f"--set takes KEY=VALUE: got {pair!r}")
        try:
            changes[key] = parse_yaml(text, text)
        except MitsonarError:
            raise MitsonarError(f"--set {key}: {text!r} is not a YAML value") from None
    return changes if seed is None else {**changes, "seed": seed}


@contextmanager
def progress_bar(what: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """Show progress on standard error: a bar with rate and time left, or without a terminal a line every ten seconds.

    Yields a function that takes the number of newly finished items.
    """
    if not sys.stderr.isatty():
        yield _Log(what, total, unit)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            rate = task.finished_speed or task.speed
            return Text(f"{rate:.1f} {unit}/s" if rate else f"- {unit}/s")

    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), Rate(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.advance(task, done)


FEWEST_TIMED = 3
"""Number of finished items from which the time left is estimated."""


class _Log:
    """Progress without a terminal: a line every ten seconds."""

    def __init__(self, what: str, total: int, unit: str, every_s: float = 10.0) -> None:
        self.what, self.total, self.unit, self.every_s = what, total, unit, every_s
        self.done, self.resumed, self.begun = 0, 0, time.monotonic()
        self.reported_s = self.begun

    def __call__(self, done: int) -> None:
        time_s = time.monotonic()
        if self.done == 0 and time_s - self.begun < 0.5:  # frames that a resumed run already had
            self.resumed = done
        self.done += done
        if time_s - self.reported_s >= self.every_s and self.done > self.resumed:
            rate = (self.done - self.resumed) / (time_s - self.begun)
            line = f"{self.what} {self.done}/{self.total}, {rate:.1f} {self.unit}/s"
            if self.done - self.resumed >= FEWEST_TIMED:  # the first items load and compile
                line += f", {max(0, self.total - self.done) / rate:.0f} s left"
            typer.echo(line, err=True)
            self.reported_s = time_s


class LaterBar:
    """A progress bar that starts once its length is known."""

    def __init__(self, what: str, unit: str) -> None:
        self.what, self.unit = what, unit
        self.inner: AbstractContextManager[Callable[[int], None]] | None = None
        self.call: Callable[[int], object] = lambda done: None

    def begin(self, total: int, done: int) -> None:
        """Show the bar, with the parts already done."""
        self.inner = progress_bar(self.what, total, self.unit)
        self.call = self.inner.__enter__()
        if done:
            self.call(done)

    def advance(self, more: int) -> None:
        """Show that more parts are done."""
        self.call(more)

    def __enter__(self) -> LaterBar:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self.inner is not None:
            self.inner.__exit__(kind, error, traceback)


# ---------------- Help texts with square brackets, such as ``[m]``, which rich would take for markup and omit


class Helpful(Protocol):
    """Attributes of a Click command, in Click itself and in Typer's copy of it."""

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
