"""``mitsonar reproduce``: reproduce the tables of Almanza-Medina."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mitsonar.cli.console import answered, changes_of, progress_bar, say, say_stopped
from mitsonar.cli.train_command import TrainingBar, asked_to_stop
from mitsonar.errors import MitsonarError

if TYPE_CHECKING:
    from mitsonar.training.run import TrainingReport

__all__ = ["reproduce"]


@answered
def reproduce(
    table: Annotated[str | None, typer.Argument(help="Number of a table, such as 3.2 (default: list all tables).")] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder of data, trainings and tables; a stopped run is resumed.")
    ] = None,
    rows: Annotated[str | None, typer.Option(help="Names of rows, separated by commas (default: all).")] = None,
    scale: Annotated[float, typer.Option(help="Part of the data of Almanza-Medina to make, above 0 and at most 1.")] = 0.02,
    minutes: Annotated[float, typer.Option(help="Longest training of a row [min]; 0: all epochs of the recipe.")] = 30.0,
    batch: Annotated[
        int | None,
        typer.Option(help="Pairs of a step (default: the recipe's); the learning rate is scaled by the square root."),
    ] = None,
    change: Annotated[
        list[str] | None,
        typer.Option("--set", help="Change a key of all recipes, KEY=VALUE, unless a row sets it: precision=bf16-mixed."),
    ] = None,
    data: Annotated[
        list[str] | None,
        typer.Option("--data", help="Change a key of all data sets, KEY=VALUE: sonar.range_bins=128, channel.rays=12500."),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Train each row for two steps on a few coarse frames, to see that it runs.")
    ] = False,
    workers: Annotated[int | None, typer.Option(help="Number of processes that render (default: number of cores).")] = None,
    accelerator: Annotated[str, typer.Option(help="Lightning's accelerator: auto, cpu, gpu ...")] = "auto",
    devices: Annotated[str, typer.Option(help="Lightning's devices: auto, a number, or a list (0,1).")] = "auto",
) -> None:
    """Make the data of a table, train and evaluate its rows, and print them beside the numbers of Almanza-Medina.

    After a stop at any moment the same command resumes. Several tables may share a folder: common rows are trained once.
    """
    if table is None:
        _list()
        return
    if workers is not None and workers < 1:
        raise MitsonarError(f"--workers must be at least 1: got {workers}")
    from mitsonar.training.reproduce import rows_named, table_named

    wanted = [name.strip() for name in rows.split(",") if name.strip()] if rows is not None else None
    rows_named(table_named(table), wanted)
    if out is None:
        raise MitsonarError(f"table {table} needs a folder: give -o")
    from mitsonar.training.reproduce import Effort
    from mitsonar.training.reproduce import reproduce as reproduced

    effort = Effort(scale, minutes or None, batch, changes_of(change or [], None), changes_of(data or [], None), quick)
    processes = len(os.sched_getaffinity(0)) if workers is None else workers
    try:
        with ExitStack() as stack:
            watch = stack.enter_context(_Console())
            reproduced(
                table, out, effort, rows=wanted, workers=processes, accelerator=accelerator, devices=devices, watch=watch
            )
    except KeyboardInterrupt as stop:
        code = say_stopped(reproduce, stop)
        sys.stdout.flush()
        os._exit(code)  # threads of Zarr and dask would complain one by one
    say((out / "table.md").read_text(encoding="utf-8").rstrip())
    say(f"\ntables: {out / 'table.md'}, {out / 'table.json'}; figure: {out / f'table-{table}.png'}")


def _list() -> None:
    """List all tables and figures with their rows, or with the command that makes them."""
    from mitsonar.training.reproduce import LOUD, NOISES, ScriptedTable, contents

    printed = [said for noise, said in NOISES.items() if noise != LOUD]
    say(f"RMSE in Almanza-Medina, sideways mm / forward mm / yaw deg: {', '.join(printed)}")
    for table in contents():
        say(f"\n{table.name}  {table.title}")
        if isinstance(table, ScriptedTable):
            for approach, text in table.printed.items():
                say(f"    {approach:32} {text}")
            say(f"    {table.command}")
            continue
        for row in table.rows:
            errors = [row.said(row.printed.get(noise)) for noise in table.noises if noise != LOUD] if row.printed else []
            say(f"    {row.name:32} {'   '.join(errors) or '-'}   {row.approach}")


class _Console:
    """Progress bars on standard error, one at a time."""

    def __init__(self) -> None:
        self.bar = ExitStack()

    def __enter__(self) -> _Console:
        return self

    def __exit__(self, *error: object) -> None:
        self.bar.close()

    def begin(self, what: str, total: int, unit: str) -> Callable[[int], None]:
        """Close the last bar and show the next one."""
        self.bar.close()
        return self.bar.enter_context(progress_bar(what, total, unit))

    @contextmanager
    def training(self, what: str) -> Iterator[tuple[Callable[[TrainingReport], None], Callable[[], bool]]]:
        """Show the bar of a training. Ctrl-C stops the training after its step."""
        self.bar.close()
        typer.echo(f"training {what}", err=True)
        with asked_to_stop() as stop, TrainingBar() as bar:
            yield bar, stop
