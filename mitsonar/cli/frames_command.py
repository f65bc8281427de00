"""``mitsonar frames``: frames of a run or a recording, for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast

import typer

from mitsonar.cli.console import answered, command_line, progress_bar, say
from mitsonar.errors import MitsonarError, counted

__all__ = ["Least", "Out", "Picture", "Polygons", "To", "Without", "exported", "frames"]

To = Annotated[str, typer.Option("--to", help="coco, yolo, webdataset, huggingface, kitti or neusis.")]
Out = Annotated[Path, typer.Option("-o", "--out", help="Folder to make; it is whole or absent.")]
Picture = Annotated[str, typer.Option(help="polar, or fan: forward up, starboard to the right.")]
Without = Annotated[list[str] | None, typer.Option("--without", help="Name of a shape that gets no box: the ground.")]
Least = Annotated[int, typer.Option(min=1, help="Pixels of an object, at least.")]
Polygons = Annotated[bool, typer.Option("--polygons", help="YOLO: outlines in place of boxes.")]


def frames() -> typer.Typer:
    """Create the group of commands."""
    app = typer.Typer(help="Write frames for other tools.", no_args_is_help=True)
    app.command()(export)

    @app.callback()
    def group() -> None:
        """Keep the name of the only command."""

    return app


@answered
def export(
    run: Annotated[str, typer.Argument(metavar="RUN|FILE", help="A run's folder, frames.npz, frames.zarr, or a recording.")],
    to: To,
    out: Out,
    picture: Picture = "polar",
    without: Without = None,
    least: Least = 1,
    polygons: Polygons = False,
) -> None:
    """Write frames in the layout of another tool, whole or absent. COCO and YOLO need labels, KITTI and neusis poses."""
    from mitsonar.mapping.open_frames import is_data_set

    if is_data_set(run):
        raise MitsonarError(f"{run} is a data set: {command_line('dataset', 'export', run)} exports it")
    exported(run, to, out, picture, without or [], least, polygons, None)


def exported(
    where: str, to: str, out: Path, picture: str, without: list[str], least: int, polygons: bool, view: str | None
) -> None:
    """Export frames and say where they are."""
    from mitsonar.exports.export_source import open_export
    from mitsonar.exports.labelled_pictures import PictureKind
    from mitsonar.exports.named_exports import export_to

    source = open_export(where, view=view)
    kind = cast(PictureKind, picture)
    with progress_bar("exporting", source.frames, "frames") as progress:
        export_to(to, source, out, picture=kind, without=without, least=least, polygons=polygons, progress=progress)
    say(f"{counted(source.frames, 'frame')} as {to}: {out}")
