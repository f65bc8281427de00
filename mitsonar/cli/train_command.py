"""``mitsonar train``: train a network by a recipe."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from mitsonar.cli.console import Terminated, answered, changes_of, say

if TYPE_CHECKING:
    from rich.progress import Progress

    from mitsonar.training.run import TrainingReport

__all__ = ["TrainingBar", "asked_to_stop", "train"]


@answered
def train(
    recipe: Annotated[
        str, typer.Argument(metavar="RECIPE.yaml", help="A training recipe: a YAML file, or the name of a shipped one.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder of the run: network, log, learning curve, state.")],
    data: Annotated[
        list[str] | None,
        typer.Option(help="Path or URL of a data set; again: others join it. With --render one, for validation only."),
    ] = None,
    render: Annotated[bool, typer.Option("--render", help="Render training samples during training.")] = False,
    minutes: Annotated[
        float | None, typer.Option(help="Duration after which training stops [min], of all resumed runs together.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Resume a run that was stopped or killed.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing run.")] = False,
    scale: Annotated[float | None, typer.Option(help="Part of the data to use, 0..1.")] = None,
    pairs: Annotated[
        int | None, typer.Option(help="Length of the training in samples, in place of the recipe's epochs.")
    ] = None,
    change: Annotated[
        list[str] | None, typer.Option("--set", help="Change a key of the recipe, KEY=VALUE: optimiser.rate=1e-3.")
    ] = None,
    accelerator: Annotated[str, typer.Option(help="Lightning's accelerator: auto, cpu, gpu ...")] = "auto",
    devices: Annotated[str, typer.Option(help="Lightning's devices: auto, a number, or a list (0,1).")] = "auto",
    strategy: Annotated[str, typer.Option(help="Lightning's strategy: auto, ddp ...")] = "auto",
    precision: Annotated[
        str | None, typer.Option(help="Lightning's precision: 32-true, bf16-mixed ... (default: the recipe's).")
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Number of CPU threads (default: torch's choice).")] = None,
    workers: Annotated[
        int | None, typer.Option(help="Number of processes that read or render (default: by the machine).")
    ] = None,
    state_minutes: Annotated[
        float, typer.Option(help="Time between two saved states [min]. A kill loses at most this.")
    ] = 5.0,
) -> None:
    """Train a network. After a stop at any moment --resume continues; on a CPU the result has the same bits."""
    from mitsonar.config.training import load_training_recipe
    from mitsonar.training.run import leads
    from mitsonar.training.run import train as train_network

    wanted = load_training_recipe(recipe, changes_of(change or [], None))
    with asked_to_stop() as stop, TrainingBar() as bar:
        made = train_network(
            wanted,
            data,
            out,
            render=render,
            minutes=minutes,
            resume=resume,
            overwrite=overwrite,
            scale=scale,
            pairs=pairs,
            accelerator=accelerator,
            devices=devices,
            strategy=strategy,
            precision=precision,
            threads=threads,
            workers=workers,
            state_minutes=state_minutes,
            progress=bar,
            stop=stop,
        )
    if not leads():
        return
    for name, text in made.rows():
        say(f"{name:18} {text}")
    say(f"network: {out / 'network.ckpt'}; learning curve: {out / 'curve.png'}, {out / 'log.csv'}")


@contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C or SIGTERM stop training after its step, with its state saved, and a second one at once.

    Yields the function that returns whether to stop.
    """
    asked, come = threading.Event(), list[int]()

    def first(number: int, frame: FrameType | None) -> None:
        come.append(number)
        asked.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)

    if threading.current_thread() is not threading.main_thread():
        yield asked.is_set
        return
    before = {number: signal.signal(number, first) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked.is_set
    except KeyboardInterrupt:
        if come == [signal.SIGTERM]:
            raise Terminated from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class TrainingBar:
    """Progress of a training on standard error.

    A terminal shows a bar, and a line for each validation. Otherwise a line is printed for each row of the log.
    """

    def __init__(self) -> None:
        self.inner: Progress | None = None

    def __enter__(self) -> TrainingBar:
        return self

    def __exit__(self, *error: object) -> None:
        if self.inner is not None:
            self.inner.stop()

    def __call__(self, report: TrainingReport) -> None:
        """Show a report."""
        if sys.stderr.isatty():
            self._draw(report)
        elif report.logged:
            typer.echo(progress_line(report) + (validation_text(report) if report.validated else ""), err=True)

    def _draw(self, report: TrainingReport) -> None:
        if self.inner is None:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn

            columns = (BarColumn(bar_width=12), TextColumn("{task.fields[text]}"))
            self.inner = Progress(*columns, console=Console(stderr=True, highlight=False))
            self.inner.start()
            self.task = self.inner.add_task("", total=report.steps, text="")
        self.inner.update(self.task, completed=report.step, text=progress_line(report))
        if report.validated:
            self.inner.console.print(f"{report.minutes:.1f} min, {report.pairs:,} samples{validation_text(report)}")


def progress_line(report: TrainingReport) -> str:
    """Format the progress of a training: ``epoch 1.26 at 18/s, 0.5 min, loss 15, training RMSE 10.9/11.9 mm 0.232 deg``."""
    return (
        f"epoch {report.epoch:.2f} at {report.per_second:.3g}/s, {report.minutes:.1f} min, loss {report.loss:.3g}, "
        f"training RMSE {_rmse(report.rmse, report)}"
    )


def validation_text(report: TrainingReport) -> str:
    """Format the last validation: ``; validation, noise none 2.84/1.00 mm 0.052 deg``."""
    return "".join(f"; validation, noise {level} {_rmse(values, report)}" for level, values in report.validation.items())


def _rmse(values: list[float], report: TrainingReport) -> str:
    """Format an RMSE. Numbers with the same unit share it."""
    texts: dict[str, list[str]] = {}
    for value, axis in zip(values, report.axes, strict=True):
        texts.setdefault(axis.unit, []).append(f"{value:.3g}")
    return " ".join(f"{'/'.join(numbers)} {unit}" for unit, numbers in texts.items())
