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
    app.command()(render.render)
    app.command()(render.impulse)
    app.command()(render.image)
    app.command()(render.sound)
    app.command()(sas.sas)
    app.command()(doctor.presets)
    app.command()(doctor.materials)
    app.command()(doctor.scenes)
    app.command()(doctor.doctor)
    app.command()(estimate.compare)
    app.command()(estimate.crlb)
    app.command()(estimate.height)
    app.command()(heights.heights)
    app.command()(estimate.odometry)
    app.command()(estimate.mosaic)
    app.command()(train.train)
    app.command()(train.evaluate)
    app.command()(train.export)
    app.command()(train.reproduce)
    app.command()(live.serve)
    app.command()(live.view)
    app.add_typer(data.worlds(), name="world")
    app.add_typer(recording.sonars(), name="sonar")
    app.add_typer(data.datasets(), name="dataset")
    app.add_typer(recording.recordings(), name="recording")
    app.add_typer(recording.frames(), name="frames")
    app.add_typer(estimate.benchmarks(), name="benchmark")
    return app
