"""``mitsonar world``: make a scene and its meshes from a seed or from a user's model."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin

import typer
from typer.core import TyperGroup

from mitsonar.cli.console import answered, command_line, say, warn
from mitsonar.cli.help_texts import with_plain_brackets
from mitsonar.errors import MitsonarError, counted

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

    from mitsonar.worlds.world import Family, World

__all__ = ["worlds"]

Click = Any
"""A command or context of Click, or of Typer's copy of it."""

FieldValue = int | float | str
"""Value of an option, before the numbers of a tuple are parsed."""

SMALLEST_M, LARGEST_M = 0.05, 100.0
"""Sizes of a model beyond which its unit is probably no metre [m]: most objects of the sea floor lie between."""

Out = Annotated[Path, typer.Option("-o", "--out", help="Folder to make, with scene.xml, meshes/ and textures/.")]


def worlds() -> typer.Typer:
    """Create the group of commands: one for each family, with an option for each of its fields."""
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
        inspect.Parameter("out", keyword, annotation=Out),
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
    out: Out,
    scale: Annotated[float, typer.Option(help="Length of a unit of the file [m]: 0.001 for millimetres.")] = 1.0,
    up: Annotated[str | None, typer.Option(help="Axis that points up: x, y or z (default: y for glTF, else z).")] = None,
    reflectivity: Annotated[
        str, typer.Option(help="Reflectivity from the texture: red or luminance; or a number 0..1.")
    ] = "luminance",
    floor: Annotated[bool, typer.Option(help="Add a seabed of random cells below the model.")] = True,
    floor_m: Annotated[
        float | None, typer.Option(help="Edge of that seabed [m] (default: 3 times the diagonal of the model).")
    ] = None,
) -> None:
    """Make a scene from your own model, with or without textures: on a seabed, with a sonar that looks at it."""
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
    out: Out,
    joint: Annotated[
        list[str] | None, typer.Option("--joint", help="NAME=VALUE of a joint [rad, m]; others are at 0 (URDF, SDF).")
    ] = None,
    search: Annotated[
        list[Path] | None,
        typer.Option("--search", help="Folder that holds models and packages; files elsewhere are refused."),
    ] = None,
    collision: Annotated[bool, typer.Option("--collision", help="Collision shapes in place of visual ones.")] = False,
    reflectivity: Annotated[
        str, typer.Option(help="Reflectivity from diffuse colours: luminance or red; or a number 0..1.")
    ] = "luminance",
    material: Annotated[
        list[str] | None, typer.Option("--material", help="NAME=MATERIAL of a link, model or prim: hull=steel.")
    ] = None,
    own_axes: Annotated[
        list[str] | None,
        typer.Option("--own-axes", help="A link, model or prim to write about the origin: it follows --moving NAME=FILE."),
    ] = None,
    seabed_z: Annotated[float | None, typer.Option(help="Add a seabed of random cells at this height [m].")] = None,
) -> None:
    """Make a scene from one of another simulator: Gazebo (SDF), ROS (URDF), Isaac Sim (USD). Coordinates stay."""
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
    """Return what an option that is given several times says, by name; a name may hold ``=``, a value may not."""
    for pair in pairs:
        if not all(pair.rpartition("=")):
            raise MitsonarError(f"{option} takes {form}: got {pair!r}")
    parts = [pair.rpartition("=") for pair in pairs]
    found = {name: value for name, _, value in parts}
    if len(found) < len(parts):
        twice = next(name for name in found if sum(name == one for one, _, _ in parts) > 1)
        raise MitsonarError(f"{option} gives {twice[:80]} twice: give it once")
    return found


def _joint_values(pairs: list[str]) -> dict[str, float]:
    """Return the values of joints that --joint says."""
    given = _pairs(pairs, "--joint", "NAME=VALUE")
    try:
        return {name: float(value) for name, value in given.items()}
    except ValueError:
        raise MitsonarError(f"--joint takes NAME=VALUE, a number in rad or m: got {', '.join(pairs)!r}") from None


def _write(world: World, out: Path) -> None:
    scene = world.write(out)
    say(world.about)
    say(f"{counted(world.faces, 'triangle')} in {scene}; render it with: {command_line('render', scene, '--cartesian')}")
