"""Commands ``mitsonar dataset`` and ``mitsonar world``: make labelled data sets and random worlds."""

from __future__ import annotations

import functools
import inspect
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin

import typer
from typer.core import TyperGroup

from mitsonar.cli.console import (
    LaterBar,
    answered,
    changes_of,
    command_line,
    progress_bar,
    say,
    say_json,
    say_stopped,
    warn,
    with_plain_brackets,
)
from mitsonar.cli.estimate import Geometry
from mitsonar.cli.options import Frame
from mitsonar.cli.recording import (
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
from mitsonar.errors import MitsonarError, count_noun
from mitsonar.io.system import usable_cores

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

    from mitsonar.config.data import Recipe
    from mitsonar.datasets.make import GenerationReport
    from mitsonar.worlds.world import Family, World

__all__ = ["datasets", "worlds"]


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
    scale: Annotated[float | None, typer.Option(help="Fraction of the recipe's sequences to make, 0..1.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of worlds, flights and jitter (default: the recipe's).")] = None,
    workers: Annotated[int | None, typer.Option(help="Processes on this machine (default: its cores).")] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a running dask scheduler; its workers render.")] = None,
    change: Annotated[
        list[str] | None, typer.Option("--set", help="Change a key of the recipe, KEY=VALUE: sonar.range_bins=256.")
    ] = None,
    verify: Annotated[bool, typer.Option("--verify", help="Read all stored shards and remake damaged ones.")] = False,
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
    processes = usable_cores() if workers is None else workers
    report = _make_with_bar(described, out, sequences=sequences, workers=processes, scheduler=scheduler, verify=verify)
    present = report.shards - report.new_shards
    say(
        f"{count_noun(report.frames, 'frame')} in {report.url}: {count_noun(report.new_shards, 'shard')} made"
        + (f", {present} were already complete" if present else "")
    )
    say(f"show it: {command_line('dataset', 'show', report.url)}")


def _make_with_bar(recipe: Recipe, out: str, **words: object) -> GenerationReport:
    """Make a data set with a progress bar; Ctrl-C ends the process at once."""
    from mitsonar.datasets.make import make_dataset

    bar = LaterBar("rendering", "frames")
    try:
        with bar:
            report = make_dataset(recipe, out, **words, begun=bar.begin, progress=bar.advance)  # type: ignore[arg-type]
    except KeyboardInterrupt as stop:
        code = say_stopped(make, stop)
        sys.stdout.flush()
        os._exit(code)  # threads of Zarr and dask would complain one by one
    for sentence in report.warnings:
        warn(sentence)
    return report


@answered
def detector(
    scene: Annotated[
        str,
        typer.Argument(metavar="SCENE|RECIPE", help="Mitsuba XML file, shipped scene, or recipe of worlds."),
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
        str, typer.Option("--noise-db", help="Raise the sonar's noise by these levels in turn [dB]: 0,6,12.")
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
    """Render random views of a scene with boxes, split into training, validation and test. The same command resumes."""
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
    report = _make_with_bar(recipe, store, workers=workers or usable_cores())
    say(f"{report.frames:,} frames in {report.url}: `mitsonar dataset export` writes them again with other classes")
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
    """Print the contents of a data set: frames, arrays, levels relative to noise, versions."""
    import yaml

    from mitsonar.datasets.overview import info as information
    from mitsonar.datasets.store import DataStore

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
    seed: Annotated[int, typer.Option(min=0, help="Seed of the selection of samples.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing picture.")] = False,
) -> None:
    """Draw sample pairs with labels, the distribution of the labels, and the mean image."""
    import io

    from mitsonar.datasets.overview import sheet_figure
    from mitsonar.datasets.store import DataStore
    from mitsonar.io.files import write_atomic
    from mitsonar.io.runs import refuse_to_replace

    store = DataStore.open(data)
    path = out or Path(Path(store.place.url).stem + ".png")
    if path.suffix.lower() != ".png" or not path.parent.is_dir():
        raise MitsonarError(f"-o must name a .png file in an existing folder: got {path}")
    refuse_to_replace(path, overwrite=overwrite)
    buffer = io.BytesIO()
    sheet_figure(store, samples=samples, view=view, seed=seed).savefig(buffer, format="png", dpi=90)
    write_atomic(path, buffer.getvalue())
    say(f"picture: {path}")


@answered
def check(data: Data) -> None:
    """Verify checksums, counts, ranges, and the agreement of labels with poses. Reads all data and changes none."""
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
            "--verify remakes damaged shards; empty frames stay until the recipe changes"
        )
    say(f"{count_noun(len(store), 'frame')} in {count_noun(store.shards, 'shard')}: all is well")


@answered
def recipes(
    name: Annotated[str | None, typer.Argument(help="Print the YAML of this recipe, as a start for your own.")] = None,
) -> None:
    """List the shipped recipes, or print one of them."""
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
    """Export a data set in the layout of another tool."""
    from mitsonar.mapping.sources import is_data_set

    if not is_data_set(data):
        raise MitsonarError(f"no data set at {data}: {command_line('frames', 'export')} exports runs and recordings")
    rules = classes_of(classes, without)
    exported(data, to, out, picture, rules, least, least_snr_db, shares_of(split), polygons, view)


@answered
def from_frames(
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="RUN|FILE|DATA...",
            help="Folders of runs, frames.npz, frames.zarr, recordings or data sets, all of one sonar.",
        ),
    ],
    out: Annotated[str, typer.Option("-o", "--out", help="Folder of the data set; complete or absent.")],
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
        int | None,
        typer.Option(min=2, help="Cut each file into sequences of this many frames, so that a single file can be split."),
    ] = None,
    geometry: Geometry = None,
    labels: Annotated[
        bool, typer.Option("--labels/--no-labels", help="Copy the labels of pixels, which all must have.")
    ] = True,
) -> None:
    """Join runs, recordings with known poses, and data sets to one data set."""
    from mitsonar.bridges.export_source import write_recorded
    from mitsonar.bridges.join_data import sources_at

    paths: list[Path | None] = list(poses) if poses else [None]
    if len(paths) not in (1, len(files)):
        raise MitsonarError(f"--poses must be given once, or once for each of {len(files)} files: got {len(paths)}")
    if height is not None and not 0 < height < float("inf"):
        raise MitsonarError(f"--height must be above 0 m: got {height:g}")
    words = {"frame": frame, "height_m": height, "cut": cut, "geometry": geometry}
    each = zip(files, paths if len(paths) > 1 else paths * len(files), strict=True)
    sources = [source for file, path in each for source in sources_at(file, path=path, **words)]  # type: ignore[arg-type]
    bar = LaterBar("copying", "frames")
    with bar:
        report = write_recorded(sources, out, labels=labels, begun=bar.begin, progress=bar.advance)
    for sentence in report.notes:
        warn(sentence)
    say(f"{count_noun(report.frames, 'frame')} in {count_noun(report.sequences, 'sequence')} in {report.path}")
    part = ["--part", "all"] if report.sequences == 1 else []
    say(f"compare estimators on it: {command_line('compare', report.path, *part)}")


# ---------------- ``mitsonar world``: make a scene and its meshes from a seed or from a user's model


Click = Any
"""A command or context of Click, or of Typer's copy of it."""

FieldValue = int | float | str
"""Value of an option, before the numbers of a tuple are parsed."""

SMALLEST_M, LARGEST_M = 0.05, 100.0
"""Sizes of a model beyond which its unit is probably no metre [m]: most objects of the sea floor lie between."""

WorldOut = Annotated[Path, typer.Option("-o", "--out", help="Folder to make, with scene.xml, meshes/ and textures/.")]


def worlds() -> typer.Typer:
    """Create the group of commands: one per family, with an option per field."""
    return typer.Typer(help="Make a world: a Mitsuba scene and its meshes.", no_args_is_help=True, cls=_Families)


class _Families(TyperGroup):
    """Imports the families only when one of these commands is called, which keeps `mitsonar --help` fast."""

    @functools.cached_property
    def known(self) -> Click:
        """Create the commands of all families."""
        from mitsonar.worlds.families import FAMILIES

        app = typer.Typer()
        for name, family in FAMILIES.items():
            app.command(name, help=inspect.cleandoc(family.__doc__ or ""))(_command(name, family))
        app.command("mesh")(mesh)
        app.command("import")(import_scene)
        return with_plain_brackets(typer.main.get_command(app))

    def list_commands(self, ctx: Click) -> list[str]:
        return list(self.known.list_commands(ctx))

    def resolve_command(self, ctx: Click, args: list[str]) -> Click:
        self.commands = self.known.commands  # for the suggestions after a wrong name
        return super().resolve_command(ctx, args)

    def get_command(self, ctx: Click, cmd_name: str) -> Click:
        return self.known.get_command(ctx, cmd_name)


def _command(name: str, family: type[Family]) -> Callable[..., None]:
    """Create a command whose options are the fields of a family."""

    def command(seed: int, out: Path, **fields: FieldValue | None) -> None:
        from mitsonar.worlds.families import create_family

        if seed < 0:
            raise MitsonarError(f"--seed must be 0 or more: got {seed}")
        given = {key: _pair(value, family.model_fields[key], key) for key, value in fields.items() if value is not None}
        _write(create_family(name, **given).build(seed), out)

    keyword = inspect.Parameter.KEYWORD_ONLY
    parameters = [
        inspect.Parameter(
            "seed",
            keyword,
            default=0,
            annotation=Annotated[int, typer.Option(help="Seed of the world; the same seed gives the same bytes.")],
        ),
        inspect.Parameter("out", keyword, annotation=WorldOut),
    ]
    parameters += [_option(key, field) for key, field in family.model_fields.items()]
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return answered(command, {key: f"--{key.replace('_', '-')}" for key in family.model_fields})


def _option(key: str, field: FieldInfo) -> inspect.Parameter:
    """Create the option of one field. Intervals and triples are numbers separated by commas."""
    default = "drawn" if field.default is None else _shown(field.default)
    text = f"{field.description} [default: {default}]"
    kind = next((kind for kind in (int, float) if field.annotation in (kind, kind | None)), str)
    shape = ",".join("N" * len(get_args(field.annotation))) if get_origin(field.annotation) is tuple else None
    option = typer.Option(f"--{key.replace('_', '-')}", help=text, show_default=False, metavar=shape)
    return inspect.Parameter(
        key,
        inspect.Parameter.KEYWORD_ONLY,
        default=None,
        annotation=Annotated[kind | None, option],
    )


def _shown(value: object) -> str:
    return ",".join(f"{part:g}" for part in value) if isinstance(value, tuple) else str(value)


def _pair(value: FieldValue, field: FieldInfo, key: str) -> FieldValue | tuple[float, ...]:
    """Parse the numbers of an option whose field is a tuple. Other values stay as they are."""
    if get_origin(field.annotation) is not tuple:
        return value
    from mitsonar.cli.console import numbers

    kinds = get_args(field.annotation)
    assert isinstance(value, str)
    given = numbers(value, len(kinds), f"--{key.replace('_', '-')}")
    assert given is not None
    return tuple(
        int(number) if kind is int and number == int(number) else number for kind, number in zip(kinds, given, strict=True)
    )


@answered
def mesh(
    file: Annotated[Path, typer.Argument(help="Model: glb, gltf, obj, stl, dae or ply.")],
    out: WorldOut,
    scale: Annotated[float, typer.Option(help="Length of the file's unit [m]: 0.001 for millimetres.")] = 1.0,
    up: Annotated[str | None, typer.Option(help="Axis that points up: x, y or z (default: y for glTF, else z).")] = None,
    reflectivity: Annotated[
        str, typer.Option(help="Reflectivity from the texture: red or luminance; or a number 0..1.")
    ] = "luminance",
    floor: Annotated[bool, typer.Option(help="Add a seabed of random cells below the model.")] = True,
    floor_m: Annotated[
        float | None, typer.Option(help="Edge of that seabed [m] (default: 3 times the diagonal of the model).")
    ] = None,
) -> None:
    """Make a scene from your own model, with a seabed and a sonar facing it."""
    from mitsonar.worlds.meshes import mesh_world

    world = mesh_world(file, scale=scale, up=up, reflectivity=reflectivity, floor=floor, floor_m=floor_m)
    if not SMALLEST_M <= world.size_m <= LARGEST_M:
        warn(
            f"the model is {world.size_m:.3g} m large with --scale {scale:g}, the metres of a unit of the file: give "
            "--scale 0.001 where the unit is a millimetre, 0.0254 where it is an inch"
        )
    _write(world, out)


@answered
def import_scene(
    file: Annotated[Path, typer.Argument(help="Scene: urdf, sdf, world, usd, usda, usdc or usdz.")],
    out: WorldOut,
    joint: Annotated[
        list[str] | None, typer.Option("--joint", help="Set a joint, NAME=VALUE [rad, m]; others are at 0 (URDF, SDF).")
    ] = None,
    search: Annotated[
        list[Path] | None,
        typer.Option("--search", help="Folder with models and packages; files elsewhere are refused."),
    ] = None,
    collision: Annotated[bool, typer.Option("--collision", help="Read collision shapes instead of visual ones.")] = False,
    reflectivity: Annotated[
        str, typer.Option(help="Reflectivity from diffuse colours: luminance or red; or a number 0..1.")
    ] = "luminance",
    material: Annotated[
        list[str] | None,
        typer.Option("--material", help="Set the material of a link, model or prim, NAME=MATERIAL: hull=steel."),
    ] = None,
    own_axes: Annotated[
        list[str] | None,
        typer.Option("--own-axes", help="Centre a link, model or prim on the origin, to follow --moving NAME=FILE."),
    ] = None,
    seabed_z: Annotated[float | None, typer.Option(help="Add a seabed of random cells at this height [m].")] = None,
) -> None:
    """Import a scene of another simulator: Gazebo (SDF), ROS (URDF), Isaac Sim (USD). Coordinates stay."""
    from mitsonar.bridges.model_import import imported_world

    world = imported_world(
        file,
        joints=_joint_values(joint or []),
        search=search or (),
        collision=collision,
        reflectivity=reflectivity,
        materials=_pairs(material or [], "--material", "NAME=MATERIAL"),
        own_axes=own_axes or (),
        seabed_z=seabed_z,
    )
    _write(world, out)
    say(f"shapes: {', '.join(mesh.shape_id or mesh.name for mesh in world.meshes[:20])}")


def _pairs(pairs: list[str], option: str, form: str) -> dict[str, str]:
    """Parse the pairs of a repeated option, keyed by name. A name may contain ``=``, a value may not."""
    for pair in pairs:
        if not all(pair.rpartition("=")):
            raise MitsonarError(f"{option} takes {form}: got {pair!r}")
    parts = [pair.rpartition("=") for pair in pairs]
    values = {name: value for name, _, value in parts}
    if len(values) < len(parts):
        twice = next(name for name in values if sum(name == one for one, _, _ in parts) > 1)
        raise MitsonarError(f"{option} gives {twice[:80]} twice: give it once")
    return values


def _joint_values(pairs: list[str]) -> dict[str, float]:
    """Parse the values of --joint, keyed by joint."""
    given = _pairs(pairs, "--joint", "NAME=VALUE")
    try:
        return {name: float(value) for name, value in given.items()}
    except ValueError:
        raise MitsonarError(f"--joint takes NAME=VALUE, a number in rad or m: got {', '.join(pairs)!r}") from None


def _write(world: World, out: Path) -> None:
    scene = world.write(out)
    say(world.about)
    say(f"{count_noun(world.faces, 'triangle')} in {scene}; render it with: {command_line('render', scene, '--cartesian')}")
