"""The command line: one file a group of commands. A command imports what it needs when it is called."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import typer

__all__ = ["application", "main"]


def main() -> None:
    """Run the command line, as ``mitsonar`` or ``python -m mitsonar``."""
    import typer

    from mitsonar.cli.help_texts import with_plain_brackets

    with_plain_brackets(typer.main.get_command(application()))()


def application() -> typer.Typer:
    """Create the application with all commands."""
    import typer

    from mitsonar.cli import (
        benchmark_command,
        compare_command,
        crlb_command,
        dataset_command,
        doctor_command,
        evaluate_command,
        export_command,
        frames_command,
        height_command,
        image_command,
        impulse_command,
        mosaic_command,
        odometry_command,
        presets_command,
        recording_command,
        render_command,
        reproduce_command,
        serve_command,
        sonar_command,
        sound_command,
        train_command,
        view_command,
        world_command,
    )

    app = typer.Typer(
        name="mitsonar",
        help="Sonar images from Mitsuba 3 scenes.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.command()(render_command.render)
    app.command()(impulse_command.impulse)
    app.command()(image_command.image)
    app.command()(sound_command.sound)
    app.command()(presets_command.presets)
    app.command()(presets_command.scenes)
    app.command()(doctor_command.doctor)
    app.command()(compare_command.compare)
    app.command()(crlb_command.crlb)
    app.command()(height_command.height)
    app.command()(odometry_command.odometry)
    app.command()(mosaic_command.mosaic)
    app.command()(train_command.train)
    app.command()(evaluate_command.evaluate)
    app.command()(export_command.export)
    app.command()(reproduce_command.reproduce)
    app.command()(serve_command.serve)
    app.command()(view_command.view)
    app.add_typer(world_command.worlds(), name="world")
    app.add_typer(sonar_command.sonars(), name="sonar")
    app.add_typer(dataset_command.datasets(), name="dataset")
    app.add_typer(recording_command.recordings(), name="recording")
    app.add_typer(frames_command.frames(), name="frames")
    app.add_typer(benchmark_command.benchmarks(), name="benchmark")
    return app
