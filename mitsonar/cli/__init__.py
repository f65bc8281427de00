"""The command line, one file per group of commands. A command imports its modules when it is called."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import typer

__all__ = ["application", "main"]


def main() -> None:
    """Run the command line, as ``mitsonar`` or ``python -m mitsonar``."""
    import io
    import sys

    import typer

    from mitsonar.cli.console import with_plain_brackets

    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        # a pipe on Windows takes some 200 characters; file names may hold others
        sys.stdout.reconfigure(errors="backslashreplace")
    with_plain_brackets(typer.main.get_command(application()))()


def application() -> typer.Typer:
    """Create the application with all commands."""
    import typer

    from mitsonar.cli import data, doctor, estimate, heights, live, recording, render, sas, train

    app = typer.Typer(
        name="mitsonar",
        help="Sonar images from Mitsuba 3 scenes.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    for command in (
        *(render.render, render.impulse, render.image, render.sound, sas.sas),
        *(doctor.presets, doctor.materials, doctor.scenes, doctor.doctor),
        *(estimate.compare, estimate.crlb, estimate.height, heights.heights, estimate.odometry, estimate.mosaic),
        *(train.train, train.evaluate, train.export, train.reproduce, live.serve, live.view),
    ):
        app.command()(command)
    app.add_typer(data.worlds(), name="world")
    app.add_typer(recording.sonars(), name="sonar")
    app.add_typer(data.datasets(), name="dataset")
    app.add_typer(recording.recordings(), name="recording")
    app.add_typer(recording.frames(), name="frames")
    app.add_typer(estimate.benchmarks(), name="benchmark")
    return app
