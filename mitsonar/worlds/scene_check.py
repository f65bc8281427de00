"""Check a scene that Mitsuba has parsed, before it creates its objects: names, numbers, references and files."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsonar.errors import MitsonarError, shortened
from mitsonar.io.files import refuse_beyond_memory, refuse_irregular
from mitsonar.plugins.native_plugins import file_resolver, foreign_names
from mitsonar.worlds.grid_check import check_grid, check_tensors, pixels_of
from mitsonar.worlds.mesh_check import CHECKS, LARGEST_COORDINATE, check_counts, check_mesh, refuse_foreign_format

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = ["check_parsed"]

DEEPEST = 100
"""Largest depth of objects that hold or refer to each other."""

MOST_WAYS = 10**8
"""Ways from objects to those that they hold, at most: Mitsuba goes each of them."""

MOST_PIXELS = 2**28
"""Pixels of all pictures of a scene, at most."""

BYTES_A_PIXEL = 28
"""What Mitsuba takes to read a picture: the pixels as they are, and as single precision."""

PICTURES = ("bitmap", "envmap")

CONTAINERS = {"blendbsdf": "bsdf", "merge": "shape", "shapegroup": "shape", "volume": "volume"}
"""Objects that consist of others, and of what."""

REFRACTING = ("material", "int_ior", "ext_ior")
"""Properties that name a file of ``data/ior``, without its ending."""


def check_parsed(state: mi.parser.ParserState) -> None:
    """Check a parsed scene, whose included files and parameters are resolved. Mitsuba must search in the scene's folders.

    Args:
        state: of the scene; no object is created yet.

    Raises:
        MitsonarError: a type that is no name; a number that is not finite; objects that refer to each other too often; a
            damaged mesh or picture; a file that is none; a bitmap without a file, an empty group.
    """
    import mitsuba as mi

    for node in state.nodes:
        if node.type == mi.ObjectType.Shape:
            refuse_foreign_format(node.props.plugin_name(), str(node.props.get("filename", "")))
    foreign_names(node.props.plugin_name() for node in state.nodes)
    _check_references(state)
    _refuse_incomplete(state)
    pixels = 0
    for node in state.nodes:
        for name in list(node.props):
            try:
                _check_numbers(node.props, name)
                pixels += _check_file(node, name)
            except MitsonarError as error:
                where = f"{node.props.plugin_name()} {node.props.id()}".strip()[:100]
                raise MitsonarError(f"{where}, {name[:60]}: {error}") from None
    if pixels > MOST_PIXELS:
        raise MitsonarError(f"its pictures have {pixels:,} pixels, at most {MOST_PIXELS:,} are possible: make them smaller")
    refuse_beyond_memory(BYTES_A_PIXEL * pixels, "its pictures")


def _check_numbers(props: mi.Properties, name: str) -> None:
    """Check that a property is finite; what lies beyond the reach of single precision vanishes without a word."""
    import mitsuba as mi

    kinds = mi.Properties.Type
    kind = props.type(name)
    value: Any = props[name] if kind in (kinds.Float, kinds.Transform, kinds.Vector, kinds.Color) else 0.0
    if kind == kinds.Float and math.isnan(value):
        raise MitsonarError("got nan; give a number")
    if kind not in (kinds.Transform, kinds.Vector, kinds.Color):
        return
    numbers = np.array(value.matrix if kind == kinds.Transform else value, dtype=float)
    if not (np.abs(numbers) <= LARGEST_COORDINATE).all():
        wrong = numbers[~(np.abs(numbers) <= LARGEST_COORDINATE)][0]
        raise MitsonarError(f"got {wrong:g}; give finite numbers, of at most {LARGEST_COORDINATE:g}")


def _check_file(node: mi.parser.SceneNode, name: str) -> int:
    """Check the file that a property names, if there is one; return how many pixels of a picture it holds."""
    import mitsuba as mi

    if node.props.type(name) != mi.Properties.Type.String:
        return 0
    plugin, value = node.props.plugin_name(), str(node.props[name])
    for found in _files(value, name):
        if name != "filename":
            if not found.is_dir():
                refuse_irregular(found, "file")
        elif plugin in CHECKS:
            check_mesh(found, plugin)
        elif plugin in PICTURES:
            return pixels_of(found)
        elif plugin in ("gridvolume", "sdfgrid"):
            check_grid(found)
        elif plugin in ("measured", "measured_polarized"):
            check_tensors(found)
        else:
            refuse_irregular(found, "file")
            if plugin.startswith("ellipsoids"):
                _check_ellipsoids(found)
    return 0


def _check_ellipsoids(path: Path) -> None:
    try:
        check_counts(path)
    except ValueError as error:
        raise MitsonarError(f"{path} is damaged: {error}; export it again") from None


def _files(value: str, name: str) -> Iterator[Path]:
    """Yield what Mitsuba finds under a name."""
    if "\0" in value:
        raise MitsonarError("a value holds a zero byte: remove it")
    values = [f"data/ior/{value}.{part}.spd" for part in ("eta", "k")] if name in REFRACTING else [value]
    for one in values:
        found = Path(str(file_resolver().resolve(one)))
        try:
            if one and found.exists():
                yield found
        except OSError:  # such as a name too long
            if name == "filename":
                raise MitsonarError(f"there cannot be a file of the name {shortened(value)}") from None


def _refuse_incomplete(state: mi.parser.ParserState) -> None:
    """Refuse objects without what they consist of, on which Mitsuba ends the process or fails late."""
    import mitsuba as mi

    kinds = mi.Properties.Type
    for node in state.nodes:
        plugin, held = node.props.plugin_name(), {name: node.props.type(name) for name in node.props}
        where = f"{plugin} {node.props.id()}".strip()[:100]
        if plugin == "bitmap" and held.get("filename") != kinds.String:
            raise MitsonarError(f'{where} names no file: give <string name="filename" value="..."/>')
        if plugin in CONTAINERS and kinds.ResolvedReference not in held.values():
            raise MitsonarError(f"{where} is empty: put a {CONTAINERS[plugin]} in it, or leave it out")


def _check_references(state: mi.parser.ParserState) -> None:
    """Check how deep objects hold each other, and in how many ways: Mitsuba's search for circles goes all of them."""
    import mitsuba as mi

    kinds = mi.Properties.Type
    ids = state.id_to_index
    children: list[list[int]] = []
    for node in state.nodes:
        held = []
        for name in list(node.props):
            kind = node.props.type(name)
            if kind == kinds.ResolvedReference:
                held.append(int(node.props[name].index()))
            elif kind == kinds.Reference and node.props[name].id() in ids:
                held.append(int(ids[node.props[name].id()]))
        children.append(held)
    ways, depths = [0] * len(children), [0] * len(children)
    for root in range(len(children)):
        path = [] if ways[root] else [(root, iter(children[root]))]
        waiting = {root}
        while path:
            number, rest = path[-1]
            child = next(rest, None)
            if child is None:
                ways[number] = min(1 + sum(ways[one] for one in children[number]), MOST_WAYS + 1)
                depths[number] = 1 + max((depths[one] for one in children[number]), default=0)
                waiting.discard(number)
                path.pop()
            elif child in waiting:
                raise MitsonarError("its objects refer to each other in a circle: take one of the references out")
            elif not ways[child]:
                path.append((child, iter(children[child])))
                waiting.add(child)
    if max(depths, default=0) > DEEPEST:
        raise MitsonarError(f"its objects refer to each other more than {DEEPEST} deep: it is no scene")
    if sum(ways) > MOST_WAYS:
        raise MitsonarError(f"its objects refer to each other in more than {MOST_WAYS:,} ways: it is no scene")
