"""``mitsonar dataset``: make, show and check labelled data sets."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mitsonar.cli.console import LaterBar, answered, changes_of, command_line, progress_bar, say, say_json, say_stopped, warn
from mitsonar.cli.flown_path import Frame
from mitsonar.cli.frames_command import (
    LEAST_SNR_DB,
    Classes,
    Least,
    LeastSnr,
    Out,
    Picture,
    Polygons,
    Shares,
    To,
    Without,
    classes_of,
    exported,
    numbers_of,
    shares_of,
)
from mitsonar.cli.odometry_command import Geometry
from mitsonar.errors import MitsonarError, counted

if TYPE_CHECKING:
    from mitsonar.config.data import Recipe
    from mitsonar.datasets.make import Made

__all__ = ["datasets"]

Data = Annotated[str, typer.Argument(metavar="DATA.zarr", help="Folder or URL (s3://...) of a data set.")]


def datasets() -> typer.Typer:
    """Create the group of commands."""
    app = typer.Typer(help="Make, show and check labelled data sets.", no_args_is_help=True)
    for command in (make, info, show, check, recipes, export, detector):
        app.command()(command)
    app.command("from-frames")(from_frames)
    return app


@answered
def make(
    recipe: Annotated[str, typer.Argument(help="Name of a shipped recipe (`mitsonar dataset recipes`), or a YAML file.")],
    out: Annotated[
        str, typer.Option("-o", "--out", help="Folder or URL (s3://...) of the data set; a stopped one is resumed.")
    ],
    sequences: Annotated[int | None, typer.Option(help="Number of sequences (default: the recipe's).")] = None,
    scale: Annotated[float | None, typer.Option(help="Part of the recipe's sequences to make, 0..1.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of worlds, flights and jitter (default: the recipe's).")] = None,
    workers: Annotated[int | None, typer.Option(help="Processes on this machine (default: its cores).")] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a running dask scheduler, whose workers render.")] = None,
    change: Annotated[
        list[str] | None, typer.Option("--set", help="Change a key of the recipe, KEY=VALUE: sonar.range_bins=256.")
    ] = None,
    verify: Annotated[bool, typer.Option("--verify", help="Read all stored shards and make damaged ones anew.")] = False,
) -> None:
    """Make a data set. After a stop at any moment the same command resumes and ends with the same bytes."""
    from mitsonar.config.data import load_recipe

    described = load_recipe(recipe, changes_of(change or [], seed))
    if sequences is not None and scale is not None:
        raise MitsonarError("--sequences and --scale contradict each other: give one")
    if scale is not None:
        if not 0 < scale <= 1:
            raise MitsonarError(f"--scale must lie in 0..1: got {scale:g}")
        sequences = max(1, round(scale * described.sequences))
    if workers is not None and workers < 1:
        raise MitsonarError(f"--workers must be at least 1: got {workers}")
    if workers is not None and scheduler is not None:
        raise MitsonarError("--workers and --scheduler contradict each other: a scheduler has its own workers")
    processes = len(os.sched_getaffinity(0)) if workers is None else workers
    made = _made(described, out, sequences=sequences, workers=processes, scheduler=scheduler, verify=verify)
    there = made.shards - made.made
    say(
        f"{counted(made.frames, 'frame')} in {made.url}: {counted(made.made, 'shard')} made"
        + (f", {there} were there" if there else "")
    )
    say(f"show it: {command_line('dataset', 'show', made.url)}")


def _made(recipe: Recipe, out: str, **words: object) -> Made:
    """Make a data set with a bar; Ctrl-C ends the process at once."""
    from mitsonar.datasets.make import make_dataset

    bar = LaterBar("rendering", "frames")
    try:
        with bar:
            made = make_dataset(recipe, out, **words, begun=bar.begin, progress=bar.advance)  # type: ignore[arg-type]
    except KeyboardInterrupt as stop:
        code = say_stopped(make, stop)
        sys.stdout.flush()
        os._exit(code)  # threads of Zarr and dask would complain one by one
    for sentence in made.warnings:
        warn(sentence)
    return made


@answered
def detector(
    scene: Annotated[
        str,
        typer.Argument(metavar="SCENE|RECIPE", help="Mitsuba XML file, shipped scene, or recipe whose worlds are taken."),
    ],
    out: Out,
    frames: Annotated[int, typer.Option(min=1, help="Number of pictures.")] = 300,
    to: Annotated[str, typer.Option("--to", help="coco or yolo.")] = "coco",
    sonar: Annotated[str | None, typer.Option(help="Preset or YAML file (default: the scene's, the recipe's).")] = None,
    height: Annotated[
        str | None, typer.Option(help="Least and largest height over z = 0, LOW,HIGH [m] (default: 1.5,3 over the ground).")
    ] = None,
    pitch: Annotated[
        str | None, typer.Option(help="Least and largest pitch, > 0 down, LOW,HIGH [deg] (default: 10,30).")
    ] = None,
    noise_db: Annotated[
        str, typer.Option("--noise-db", help="What is added to the sonar's noise, in turn [dB]: 0,6,12.")
    ] = "",
    classes: Classes = "",
    picture: Picture = "polar",
    least: Least = 9,
    least_snr_db: LeastSnr = LEAST_SNR_DB,
    split: Annotated[str, typer.Option("--split", help="Shares of training, validation and test.")] = "0.7,0.15,0.15",
    polygons: Polygons = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of poses, worlds and noise.")] = 0,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes on this machine (default: its cores).")] = None,
    change: Annotated[
        list[str] | None, typer.Option("--set", help="Change a key of the recipe, KEY=VALUE: sonar.quality=draft.")
    ] = None,
) -> None:
    """Render random views of a scene, with boxes, in parts for training, validation and test. The same command resumes."""
    from mitsonar.bridges.export_formats import DetectorViews, detector_recipe

    if to not in ("coco", "yolo"):
        raise MitsonarError(f"--to is coco or yolo: got {to!r}; `mitsonar dataset export` writes other layouts")
    if out.exists():
        raise MitsonarError(f"{out} exists and is kept as it is: choose another -o, or remove it")
    shares = shares_of(split)
    assert shares is not None
    raised = tuple(numbers_of(noise_db, "--noise-db", None)) if noise_db else ()
    views = DetectorViews(frames, _interval(height, "--height"), _interval(pitch, "--pitch"), raised, shares, seed)
    rules = classes_of(classes, None)
    recipe, ground, notes = detector_recipe(scene, views, sonar, changes_of(change or [], None))
    for note in notes:
        say(note)
    store = f"{out}.zarr"
    made = _made(recipe, store, workers=workers or len(os.sched_getaffinity(0)))
    say(f"{made.frames:,} frames in {made.url}: `mitsonar dataset export` writes them again with other classes")
    exported(store, to, out, picture, [*rules, *ground], least, least_snr_db, None, polygons, None, every_class=True)


def _interval(text: str | None, option: str) -> tuple[float, float] | None:
    if text is None:
        return None
    low, high = numbers_of(text, option, 2)
    return low, high


@answered
def info(
    data: Data,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    recipe: Annotated[bool, typer.Option("--recipe", help="Print the recipe as YAML.")] = False,
) -> None:
    """Print what a data set holds: frames, arrays, levels against noise, versions."""
    import yaml

    from mitsonar.datasets.store import DataStore
    from mitsonar.plotting.figures import info as information

    store = DataStore.open(data, unfinished=True)
    if recipe:
        say(yaml.safe_dump(store.about["recipe"], sort_keys=False, allow_unicode=True).rstrip())
        return
    table = information(store)
    if as_json:
        say_json(table)
        return
    for key, value in table.items():
        if key == "levels":
            for view, level in value.items():
                over = ", ".join(f"{name} {ratio:.2f}" for name, ratio in level["signal_over_noise"].items())
                say(
                    f"{'level of ' + view:18} {100 * level['filled']:.1f} % of pixels hold an echo, "
                    f"mean {level['signal_mean']:.4f}"
                )
                say(f"{'  mean / noise':18} {over}")
        elif key == "bytes":
            say(f"{key:18} {value:,} ({value / max(table['frames'], 1):,.0f} a frame)")
        elif isinstance(value, dict):
            say(f"{key:18} " + "; ".join(f"{name}: {text}" for name, text in value.items()))
        elif isinstance(value, list):
            say(f"{key:18} {', '.join(map(str, value))}")
        else:
            say(f"{key:18} {value:,}" if isinstance(value, int) and not isinstance(value, bool) else f"{key:18} {value}")


@answered
def show(
    data: Data,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="PNG to write (default: NAME.png in the current folder).")
    ] = None,
    samples: Annotated[int, typer.Option(min=1, max=16, help="Number of samples to draw.")] = 4,
    view: Annotated[str | None, typer.Option(help="Name of the view (default: the first).")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the choice of samples.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing picture.")] = False,
) -> None:
    """Draw a sheet of sample pairs with labels, the distribution of the labels, and the mean image."""
    import io

    from mitsonar.datasets.store import DataStore
    from mitsonar.io.files import write_whole
    from mitsonar.io.runs import refuse_to_replace
    from mitsonar.plotting.figures import sheet_figure

    store = DataStore.open(data)
    path = out or Path(Path(store.place.url).stem + ".png")
    if path.suffix.lower() != ".png" or not path.parent.is_dir():
        raise MitsonarError(f"-o must name a .png file in a folder that is there: got {path}")
    refuse_to_replace(path, overwrite=overwrite)
    buffer = io.BytesIO()
    sheet_figure(store, samples=samples, view=view, seed=seed).savefig(buffer, format="png", dpi=90)
    write_whole(path, buffer.getvalue())
    say(f"picture: {path}")


@answered
def check(data: Data) -> None:
    """Verify checksums, counts, ranges, and that labels agree with poses. All data are read and none changed."""
    from mitsonar.datasets.make import check as find_faults
    from mitsonar.datasets.store import DataStore

    store = DataStore.open(data, unfinished=True)
    with progress_bar("checking", len(store), "frames") as progress:
        faults = find_faults(store, progress)
    for fault in faults:
        say(fault)
    if faults:
        raise MitsonarError(
            f"{len(faults)} faults in {data}: the `mitsonar dataset make` that made it resumes where it stopped, and with "
            "--verify makes damaged shards anew; empty frames stay until the recipe changes"
        )
    say(f"{counted(len(store), 'frame')} in {counted(store.shards, 'shard')}: all is well")


@answered
def recipes(
    name: Annotated[str | None, typer.Argument(help="Print the YAML of this recipe, to start your own from.")] = None,
) -> None:
    """Print the shipped recipes, or one of them."""
    from mitsonar.config.data import load_recipe, shipped_recipes

    if name is not None:
        load_recipe(name)
        say((shipped_recipes().get(name) or Path(name)).read_text(encoding="utf-8").rstrip())
        return
    import yaml

    for key, path in shipped_recipes().items():
        say(f"{key:24} {yaml.safe_load(path.read_text(encoding='utf-8'))['about']}")


@answered
def export(
    data: Data,
    to: To,
    out: Out,
    picture: Picture = "polar",
    without: Without = None,
    classes: Classes = "",
    least: Least = 1,
    least_snr_db: LeastSnr = LEAST_SNR_DB,
    split: Shares = None,
    polygons: Polygons = False,
    view: Annotated[str | None, typer.Option(help="Name of the view (default: the first).")] = None,
) -> None:
    """Write a data set in the layout of another tool, whole or absent."""
    from mitsonar.mapping.sources import is_data_set

    if not is_data_set(data):
        raise MitsonarError(f"no data set at {data}: {command_line('frames', 'export')} exports runs and recordings")
    rules = classes_of(classes, without)
    exported(data, to, out, picture, rules, least, least_snr_db, shares_of(split), polygons, view)


@answered
def from_frames(
    files: Annotated[
        list[str],
        typer.Argument(metavar="RUN|FILE...", help="Folders of runs, frames.npz, frames.zarr or recordings, of one sonar."),
    ],
    out: Annotated[str, typer.Option("-o", "--out", help="Folder of the data set, whole or absent.")],
    poses: Annotated[
        list[Path] | None,
        typer.Option(
            "--poses",
            help="TUM or CSV file of the sonar's path: one for all, or one a file (default: the frames' own poses).",
        ),
    ] = None,
    frame: Frame = "mitsonar",
    height: Annotated[float | None, typer.Option(help="Height over the ground [m], for frames that lack it.")] = None,
    cut: Annotated[
        int | None, typer.Option(min=2, help="Cut each file into sequences of so many frames, so that one can be split.")
    ] = None,
    geometry: Geometry = None,
) -> None:
    """Make a data set of frames with known poses, of runs and of recordings: to compare, to evaluate, to train on."""
    from mitsonar.bridges.export_source import frames_with_poses, write_recorded

    paths: list[Path | None] = list(poses) if poses else [None]
    if len(paths) not in (1, len(files)):
        raise MitsonarError(f"--poses must be given once, or once for each of {len(files)} files: got {len(paths)}")
    if height is not None and not 0 < height < float("inf"):
        raise MitsonarError(f"--height must be above 0 m: got {height:g}")
    words = {"frame": frame, "height_m": height, "cut": cut, "geometry": geometry}
    each = zip(files, paths if len(paths) > 1 else paths * len(files), strict=True)
    sources = [frames_with_poses(file, path=path, **words) for file, path in each]  # type: ignore[arg-type]
    bar = LaterBar("copying", "frames")
    with bar:
        made = write_recorded(sources, out, begun=bar.begin, progress=bar.advance)
    for sentence in made.notes:
        warn(sentence)
    say(f"{counted(made.frames, 'frame')} in {counted(made.sequences, 'sequence')} in {made.path}")
    part = ["--part", "all"] if made.sequences == 1 else []
    say(f"compare estimators on it: {command_line('compare', made.path, *part)}")
