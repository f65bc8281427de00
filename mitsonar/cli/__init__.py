"""The command line: one file a group of commands, each loading what it needs when it is called."""

from __future__ import annotations

__all__ = ["main"]


def main() -> None:
    """``mitsonar`` and ``python -m mitsonar``."""
    import typer

    from mitsonar.cli import (
        compare,
        dataset,
        doctor,
        evaluate,
        export,
        height,
        image,
        impulse,
        limit,
        mosaic,
        odometry,
        presets,
        render,
        reproduce,
        train,
        world,
    )

    app = typer.Typer(
        name="mitsonar",
        help="Sonar images from Mitsuba 3 scenes.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.command()(render.render)
    app.command()(impulse.impulse)
    app.command()(image.image)
    app.command()(presets.presets)
    app.command()(presets.scenes)
    app.command()(doctor.doctor)
    app.command()(compare.compare)
    app.command()(limit.limit)
    app.command()(height.height)
    app.command()(odometry.odometry)
    app.command()(mosaic.mosaic)
    app.command()(train.train)
    app.command()(evaluate.evaluate)
    app.command()(export.export)
    app.command()(reproduce.reproduce)
    app.add_typer(world.worlds(), name="world")
    app.add_typer(dataset.datasets(), name="dataset")
    app()
