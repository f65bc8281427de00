"""Commands ``mitsonar train``, ``evaluate``, ``export`` and ``reproduce``: train networks and test them."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from mitsonar.cli.console import Terminated, answered, changes_of, progress_bar, say, say_json, say_stopped, warn
from mitsonar.errors import MitsonarError, count_noun, did_you_mean
from mitsonar.io.system import usable_cores

if TYPE_CHECKING:
    from rich.progress import Progress

    from mitsonar.networks.checkpoint import Checkpoint
    from mitsonar.training.journal import TrainingReport

__all__ = ["Run", "TrainingBar", "checkpoint_from", "evaluate", "export", "reproduce", "stop_on_signals", "train"]


@answered
def train(
    recipe: Annotated[
        str, typer.Argument(metavar="RECIPE.yaml", help="A training recipe: a YAML file, or the name of a shipped one.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder of the run: network, log, learning curve, state.")],
    data: Annotated[
        list[str] | None,
        typer.Option(help="Path or URL of a data set; repeat to join several. With --render at most one, for validation."),
    ] = None,
    render: Annotated[bool, typer.Option("--render", help="Render training samples on demand.")] = False,
    minutes: Annotated[float | None, typer.Option(help="Stop after this duration [min], all resumed runs together.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Resume a run that was stopped or killed.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing run.")] = False,
    scale: Annotated[float | None, typer.Option(help="Fraction of the data to use, 0..1.")] = None,
    pairs: Annotated[
        int | None, typer.Option(help="Length of the training in samples, instead of the recipe's epochs.")
    ] = None,
    change: Annotated[
        list[str] | None, typer.Option("--set", help="Change a key of the recipe, KEY=VALUE: optimiser.rate=1e-3.")
    ] = None,
    accelerator: Annotated[str, typer.Option(help="Lightning's accelerator: auto, cpu, gpu ...")] = "auto",
    devices: Annotated[str, typer.Option(help="Lightning's devices: auto, a number, or a list (0,1).")] = "auto",
    strategy: Annotated[str, typer.Option(help="Lightning's strategy: auto, ddp ...")] = "auto",
    precision: Annotated[
        str | None, typer.Option(help="Lightning's precision: 32-true, or on a GPU bf16-mixed ... (default: the recipe's).")
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Number of CPU threads (default: torch's choice).")] = None,
    workers: Annotated[
        int | None, typer.Option(help="Number of processes that read or render (default: by the machine).")
    ] = None,
    state_minutes: Annotated[
        float, typer.Option(help="Interval between saved states [min]; a kill loses at most this.")
    ] = 5.0,
) -> None:
    """Train a network. After a stop, --resume continues; on a CPU to the same bits."""
    given = locals()  # by name the fields of TrainOptions, and the changes of the recipe
    from mitsonar.config.training import TrainOptions, load_training_recipe
    from mitsonar.training.run import is_main_process
    from mitsonar.training.run import train as train_network

    changes = changes_of(given.pop("change") or [], None)
    options = TrainOptions(**{**given, "recipe": load_training_recipe(recipe, changes)})
    with stop_on_signals() as stop, TrainingBar() as bar:
        report = train_network(options, progress=bar, stop=stop)
    if not is_main_process():
        return
    for name, text in report.rows():
        say(f"{name:18} {text}")
    say(f"network: {out / 'network.ckpt'}; learning curve: {out / 'curve.png'}, {out / 'log.csv'}")


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Stop training after its step at Ctrl-C or SIGTERM, with its state saved; stop at once at the second signal.

    Yields a function that returns whether to stop.
    """
    stop_requested, received = threading.Event(), list[int]()

    def first(number: int, frame: FrameType | None) -> None:
        received.append(number)
        stop_requested.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)

    if threading.current_thread() is not threading.main_thread():
        yield stop_requested.is_set
        return
    before = {number: signal.signal(number, first) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop_requested.is_set
    except KeyboardInterrupt:
        if received == [signal.SIGTERM]:
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


# ---------------- ``mitsonar evaluate``: the errors of a trained network on a data set


Run = Annotated[str, typer.Argument(metavar="RUN", help="Folder of a training, a checkpoint, or corrnet.")]


@answered
def evaluate(
    run: Run,
    data: Annotated[str, typer.Argument(metavar="DATA.zarr", help="Path or URL of a data set.")],
    noise: Annotated[
        str | None,
        typer.Option(
            help="Levels of noise, separated by commas (by ; if one is m,s,g): none, low, high, a YAML file; for impulse "
            "responses none, 20 dB ... (default: none,low,high; for impulse responses none)."
        ),
    ] = None,
    part: Annotated[
        str | None, typer.Option(help="train, validation, test (default if the split has one) or all, split as in training.")
    ] = None,
    pairs: Annotated[int | None, typer.Option(min=1, help="Maximum number of pairs, one per sequence.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Allow a sonar other than that of training.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of noise, choice of pairs and bootstrap.")] = 0,
    batch: Annotated[int, typer.Option(min=1, help="Pairs at a time.")] = 16,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for table.md and table.json.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing tables.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Evaluate a trained network and the answer zero. Bootstrap by scene, then sequence.

    `large` is the RMSE of motions beyond half the largest (10..20 mm of 20). Almanza-Medina prints yaw in
    deg/100.
    """
    checkpoint = checkpoint_from(run)
    from mitsonar.estimation.compare import FEWEST_SCENES
    from mitsonar.training.evaluate import check_no_tables, report_lines, save_tables
    from mitsonar.training.evaluate import evaluate as evaluated

    if out is not None:
        check_no_tables(out, overwrite=overwrite)
    levels = None if noise is None else list(dict.fromkeys(noise.split(";" if ";" in noise else ",")))
    with ExitStack() as bar:
        report = evaluated(
            checkpoint,
            data,
            noise=levels,
            part=part,
            pairs=pairs,
            force=force,
            seed=seed,
            batch=batch,
            begin=lambda count: bar.enter_context(progress_bar("evaluating", count, "pairs")),
        )
    report = {"run": run, **report}
    for sentence in report["notes"]:
        warn(sentence)
    if report["scenes"] < FEWEST_SCENES:
        warn(
            f"{count_noun(report['scenes'], 'scene')} only: the 95 % intervals are too narrow; evaluate on "
            f"{FEWEST_SCENES} or more"
        )
    lines = report_lines(report)
    if out is not None:
        save_tables(out, report)
    if as_json:
        say_json(report, indent=1)
        return
    for name, value in checkpoint.rows():
        say(f"{name:18} {value}")
    say("")
    for line in lines:
        say(line)
    if out is not None:
        say(f"\ntables: {out / 'table.md'}, {out / 'table.json'}")


def checkpoint_from(run: str) -> Checkpoint:
    """Load the checkpoint that the command line names.

    Raises:
        MitsonarError: torch is missing, or there is no usable checkpoint.
    """
    from mitsonar.networks.checkpoint import Checkpoint

    return Checkpoint.load(run)


# ---------------- ``mitsonar export``: a trained network as ONNX, for programs without torch, or as a smaller checkpoint


@answered
def export(
    run: Run,
    onnx: Annotated[Path | None, typer.Option("--onnx", help="ONNX file to write.")] = None,
    half: Annotated[
        Path | None, typer.Option("--half", help="Checkpoint to write, with weights of half precision (.ckpt).")
    ] = None,
    batch: Annotated[str, typer.Option(help="Batch size of the ONNX network: a number, or `dynamic` for any.")] = "dynamic",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Export a network to ONNX, with metadata on inputs and outputs, or to a checkpoint of half the size."""
    from mitsonar.io.files import write_atomic

    if batch != "dynamic" and not (batch.isdecimal() and int(batch) > 0):
        raise MitsonarError(f"--batch is a number of samples, or dynamic: got {batch!r}{did_you_mean(batch, ['dynamic'])}")
    if onnx is None and half is None:
        raise MitsonarError("nothing to write: give --onnx FILE.onnx, --half FILE.ckpt, or both")
    for option, path, suffix in (("--onnx", onnx, ".onnx"), ("--half", half, ".ckpt")):
        if path is not None:
            _refuse_place(option, path, suffix, overwrite=overwrite)
    checkpoint = checkpoint_from(run)
    network = f"{checkpoint.network} of mitsonar {checkpoint.version}"
    if half is not None:
        content = checkpoint.halved().to_bytes()
        write_atomic(half, content)
        say(f"{network}, {len(content):,} bytes: {half}")
    if onnx is not None:
        from mitsonar.networks.checkpoint import to_onnx

        content = to_onnx(checkpoint, None if batch == "dynamic" else int(batch))
        write_atomic(onnx, content)
        say(f"{network}, {len(content):,} bytes: {onnx}")


def _refuse_place(option: str, path: Path, suffix: str, *, overwrite: bool) -> None:
    """Refuse a file with another suffix, without its folder, or that exists already.

    Raises:
        MitsonarError: the file is refused.
    """
    from mitsonar.io.runs import refuse_to_replace

    if path.suffix.lower() != suffix or not path.parent.is_dir():
        raise MitsonarError(f"{option} must name an {suffix} file in an existing folder: got {path}")
    refuse_to_replace(path, overwrite=overwrite, option=option)


# ---------------- ``mitsonar reproduce``: reproduce the tables of Almanza-Medina


@answered
def reproduce(
    table: Annotated[str | None, typer.Argument(help="Number of a table, such as 3.2 (default: list all tables).")] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder of data, trainings and tables; a stopped run is resumed.")
    ] = None,
    rows: Annotated[str | None, typer.Option(help="Names of rows, separated by commas (default: all).")] = None,
    scale: Annotated[float, typer.Option(help="Fraction of Almanza-Medina's data to make, above 0 and at most 1.")] = 0.02,
    minutes: Annotated[
        float, typer.Option(help="Maximum training time of a row [min]; 0: all epochs of the recipe.")
    ] = 30.0,
    batch: Annotated[
        int | None,
        typer.Option(help="Pairs per step (default: the recipe's); the learning rate scales with the square root."),
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
        bool, typer.Option("--quick", help="Train each row for two steps on a few coarse frames, as a test.")
    ] = False,
    workers: Annotated[int | None, typer.Option(help="Number of processes that render (default: number of cores).")] = None,
    accelerator: Annotated[str, typer.Option(help="Lightning's accelerator: auto, cpu, gpu ...")] = "auto",
    devices: Annotated[str, typer.Option(help="Lightning's devices: auto, a number, or a list (0,1).")] = "auto",
) -> None:
    """Reproduce a table: make its data, train and evaluate its rows, and print them beside the published numbers.

    After a stop the same command resumes. Several tables may share a folder: common rows are trained once.
    """
    if table is None:
        _list()
        return
    if workers is not None and workers < 1:
        raise MitsonarError(f"--workers must be at least 1: got {workers}")
    from mitsonar.reproduction.tables import rows_named, table_named

    row_names = [name.strip() for name in rows.split(",") if name.strip()] if rows is not None else None
    rows_named(table_named(table), row_names)
    if out is None:
        raise MitsonarError(f"table {table} needs a folder: give -o")
    from mitsonar.reproduction.tables import Effort
    from mitsonar.reproduction.tables import reproduce as reproduced

    effort = Effort(scale, minutes or None, batch, changes_of(change or [], None), changes_of(data or [], None), quick)
    processes = usable_cores() if workers is None else workers
    try:
        with ExitStack() as stack:
            watch = stack.enter_context(_Console())
            reproduced(
                table, out, effort, rows=row_names, workers=processes, accelerator=accelerator, devices=devices, watch=watch
            )
    except KeyboardInterrupt as stop:
        code = say_stopped(reproduce, stop)
        sys.stdout.flush()
        os._exit(code)  # threads of Zarr and dask would complain one by one
    say((out / "table.md").read_text(encoding="utf-8").rstrip())
    say(f"\ntables: {out / 'table.md'}, {out / 'table.json'}; figure: {out / f'table-{table}.png'}")


def _list() -> None:
    """List all tables and figures with their rows, or with the command that makes them."""
    from mitsonar.reproduction.tables import HIGHEST_NOISE, NOISES, ScriptedTable, contents

    printed = [text for noise, text in NOISES.items() if noise != HIGHEST_NOISE]
    say(f"RMSE in Almanza-Medina, sideways mm / forward mm / yaw deg: {', '.join(printed)}")
    for table in contents():
        say(f"\n{table.name}  {table.title}")
        if isinstance(table, ScriptedTable):
            for approach, text in table.printed.items():
                say(f"    {approach:32} {text}")
            say(f"    {table.command}")
            continue
        for row in table.rows:
            errors = (
                [row.format_errors(row.printed.get(noise)) for noise in table.noises if noise != HIGHEST_NOISE]
                if row.printed
                else []
            )
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
        """Close the current bar and show the next one."""
        self.bar.close()
        return self.bar.enter_context(progress_bar(what, total, unit))

    @contextmanager
    def training(self, what: str) -> Iterator[tuple[Callable[[TrainingReport], None], Callable[[], bool]]]:
        """Show the bar of a training. Ctrl-C stops the training after its step."""
        self.bar.close()
        typer.echo(f"training {what}", err=True)
        with stop_on_signals() as stop, TrainingBar() as bar:
            yield bar, stop
