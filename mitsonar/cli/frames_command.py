"""``mitsonar frames``: frames of a run or a recording, for other tools."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, cast

import typer

from mitsonar.cli.console import answered, command_line, progress_bar, say
from mitsonar.errors import MitsonarError, counted

__all__ = [
    *("Classes", "Least", "LeastSnr", "Out", "Picture", "Polygons", "Shares", "To", "Without"),
    *("LEAST_SNR_DB", "classes_of", "exported", "frames", "numbers_of", "shares_of"),
]

OF_RUN = 0.7, 0.15, 0.15
"""Shares of training, validation and test of a run's frames."""

LEAST_SNR_DB = 3.0
"""That of the export, which is not loaded yet."""

To = Annotated[str, typer.Option("--to", help="coco, yolo, webdataset, huggingface, kitti or neusis.")]
Out = Annotated[Path, typer.Option("-o", "--out", help="Folder to make; it is whole or absent.")]
Picture = Annotated[str, typer.Option(help="polar, or fan: forward up, starboard to the right.")]
Without = Annotated[list[str] | None, typer.Option("--without", help="Name of a shape that gets no box: the ground.")]
Classes = Annotated[
    str,
    typer.Option(
        "--classes",
        help="Classes of shapes by name, GLOB=CLASS,...: pillar*=pillar,seabed*= (empty: left out); default: their names, "
        "one class where only numbers at the end differ.",
    ),
]
Least = Annotated[int, typer.Option(min=1, help="Pixels of an object, at least.")]
LeastSnr = Annotated[
    float,
    typer.Option("--least-snr-db", help="Signal-to-noise ratio of an object, at least [dB]; -inf: all that is labelled."),
]
Shares = Annotated[
    str | None,
    typer.Option(
        "--split",
        help="Shares of training, validation and test, default: the recipe's; of a run 0.7,0.15,0.15.",
    ),
]
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
    classes: Classes = "",
    least: Least = 1,
    least_snr_db: LeastSnr = LEAST_SNR_DB,
    split: Shares = None,
    polygons: Polygons = False,
) -> None:
    """Write frames in the layout of another tool, whole or absent. COCO and YOLO need labels, KITTI and neusis poses."""
    from mitsonar.mapping.sources import is_data_set

    if is_data_set(run):
        raise MitsonarError(f"{run} is a data set: {command_line('dataset', 'export', run)} exports it")
    rules = classes_of(classes, without)
    shares = shares_of(split) or (OF_RUN if to in ("coco", "yolo") else None)
    exported(run, to, out, picture, rules, least, least_snr_db, shares, polygons, None)


def classes_of(classes: str, without: list[str] | None) -> list[tuple[str, str]]:
    """Return the rules of classes that options give."""
    from mitsonar.bridges.export_source import class_rules

    return [*((name, "") for name in without or []), *class_rules(classes)]


def shares_of(split: str | None) -> tuple[float, float, float] | None:
    """Return the shares of training, validation and test that an option gives.

    Raises:
        MitsonarError: no three numbers.
    """
    if split is None:
        return None
    train, validation, test = numbers_of(split, "--split", 3)
    return train, validation, test


def numbers_of(text: str, option: str, count: int | None) -> list[float]:
    """Return the numbers of an option, with commas between.

    Raises:
        MitsonarError: something else, or another count of them.
    """
    try:
        numbers = [float(one) for one in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or len(numbers) != (count or len(numbers)) or not all(map(math.isfinite, numbers)):
        raise MitsonarError(f"{option} takes {count or 'some'} numbers with commas between: got {text!r}")
    return numbers


def exported(
    where: str,
    to: str,
    out: Path,
    picture: str,
    classes: list[tuple[str, str]],
    least: int,
    least_snr_db: float,
    split: tuple[float, float, float] | None,
    polygons: bool,
    view: str | None,
    every_class: bool = False,
) -> None:
    """Export frames and say where they are."""
    from mitsonar.bridges.export_formats import export_to
    from mitsonar.bridges.export_source import PictureKind, open_export

    source = open_export(where, view=view, split=split)
    words = {"classes": classes, "least": least, "least_snr_db": least_snr_db, "polygons": polygons}
    with progress_bar("exporting", source.frames, "frames") as progress:
        kind = cast(PictureKind, picture)
        made = export_to(to, source, out, picture=kind, every_class=every_class, progress=progress, **words)  # type: ignore[arg-type]
    say(f"{counted(source.frames, 'frame')} as {to}: {out}")
    for part in ("train", "validation", "test"):
        counts = ", ".join(f"{name} {made.boxes[part, name]:,}" for name in made.classes)
        if to in ("coco", "yolo") and (source.part == part).any():
            say(f"{part:10} {int((source.part == part).sum()):,} pictures, boxes: {counts}")
    if to in ("coco", "yolo") and made.faint + made.small:
        say(f"without a box: {made.faint:,} below {least_snr_db:g} dB over the noise, {made.small:,} below {least} pixels")
