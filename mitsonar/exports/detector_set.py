"""The data set of a detector: random views of a scene or of generated worlds, with labels, noise and three parts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.config.data import Keys, Recipe, load_recipe, recipe_from, set_key, shipped_recipes
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar, named_sonars
from mitsonar.simulation.scene import covered_squares_in, find_scene, load_scene, shape_boxes_in, shape_names_in, sonar_in

__all__ = ["DetectorViews", "detector_recipe"]

CLEAR_M = 0.3
"""Distance of the sonar from the box around an object and from the ground, at least [m]."""

GROUND = 0.9
"""A shape is ground where it covers this part of the scene's edge."""

REACH = 0.6
"""Window of the sonar, at most, as a part of the scene's edge: a fan must find places to lie inside."""

SHARES = 0.7, 0.15, 0.15
FRAMES_OF_WORLD = 10
"""Frames of a generated world, where there are enough of them."""


@dataclass(frozen=True)
class DetectorViews:
    """What the pictures of a detector are taken of.

    Attributes:
        frames: number of pictures.
        heights: of the sonar, least and largest [m]; None: 1.5 to 3 m over a scene's ground, or as the recipe says.
        pitch_deg: least and largest, > 0 down [deg]; None: 10 to 30, or as the recipe says.
        noise_db: what is added to the noise of the sonar [dB]; each scene, or part of one, takes the next.
        split: shares of training, validation and test.
        seed: of poses, worlds and noise.
    """

    frames: int
    heights: tuple[float, float] | None = None
    pitch_deg: tuple[float, float] | None = None
    noise_db: tuple[float, ...] = ()
    split: tuple[float, float, float] = SHARES
    seed: int = 0


def detector_recipe(
    scene: str | Path, views: DetectorViews, sonar: str | None = None, changes: Keys | None = None
) -> tuple[Recipe, list[tuple[str, str]], list[str]]:
    """Make the recipe of a detector's data set: one ping a sequence, at random places, with labels of shapes and objects.

    In a scene file the sonar stays over the ground, and clear of the boxes around all other shapes. Worlds of a recipe are
    split by scene, views of one scene file by sequence.

    Args:
        scene: a Mitsuba XML file, the name of a shipped scene, or a recipe of a data set, whose worlds are taken.
        views: how many, from where, and in what noise.
        sonar: preset or YAML file; default: the sonar of the scene or of the recipe.
        changes: keys of the recipe to change, with dots between the levels.

    Returns:
        The recipe; classes that leave out the ground, as rules of
        :class:`~mitsonar.exports.labelled_pictures.LabelledPictures`; sentences on what was decided.

    Raises:
        MitsonarError: fewer frames than parts, no such scene, sonar or ground, a height within the ground.
    """
    parts = sum(share > 0 for share in views.split)
    if views.frames < parts:
        raise MitsonarError(f"--frames must be at least {parts}, one for each part of --split: got {views.frames}")
    of_recipe = str(scene).lower().endswith((".yaml", ".yml")) or str(scene) in shipped_recipes()
    chosen = "sonar.range_max" in (changes or {})
    fields, rules, notes = _of_recipe(str(scene), views) if of_recipe else _of_scene(str(scene), views, sonar, chosen)
    if of_recipe and sonar is not None:
        fields["sonar"] = _sonar_fields(sonar)
    flight = fields["flight"]
    flight |= {"pings": 1, "jump_m": None}
    flight |= {} if views.heights is None else {"height_m": list(views.heights)}
    if views.pitch_deg is not None:
        flight["pitch_deg"] = list(views.pitch_deg)
        fields["mount"] = {**fields.get("mount", {}), "pitch_deg": 0.0}
    train, validation, test = views.split
    fields |= {"frames": 1, "labels": ["shape_id", "object_id"], "noise_db": list(views.noise_db), "seed": views.seed}
    fields["split"] = {**fields["split"], "train": train, "validation": validation, "test": test}
    for key, value in (changes or {}).items():
        set_key(fields, key, value)
    recipe = recipe_from(fields)
    if recipe.sonar is not None and recipe.instrument.model == "coherent" and "visible_labels" not in (changes or {}):
        recipe = recipe_from({**fields, "visible_labels": True})
    return recipe, rules, notes


def _sonar_fields(name: str) -> Keys:
    """Return the keys of a sonar, of a preset or a file."""
    if name in named_sonars():
        return {"preset": name}
    return load_sonar(name).model_dump(exclude_unset=True)


def _scenes(frames: int, worlds: Sequence[Keys]) -> list[Keys]:
    """Spread frames evenly over worlds, a sequence a frame."""
    counts = np.diff(np.rint(np.linspace(0, frames, len(worlds) + 1)).astype(int))
    return [{"count": 1, "sequences": int(count), "world": world} for count, world in zip(counts, worlds, strict=True)]


def _of_recipe(name: str, views: DetectorViews) -> tuple[Keys, list[tuple[str, str]], list[str]]:
    """Return the keys of a recipe whose worlds a detector shall see; several worlds a part, where they differ."""
    recipe = load_recipe(name)
    groups = [group for group, one in enumerate(recipe.scenes) for _ in range(one.count)]
    wanted = max(3, len(views.noise_db), views.frames // FRAMES_OF_WORLD)
    chosen = [groups[int(at)] for at in np.linspace(0, len(groups) - 1, min(len(groups), wanted, views.frames)).round()]
    fields = recipe.model_dump(mode="json")
    fields["scenes"] = _scenes(views.frames, [dict(recipe.scenes[group].world) for group in chosen])
    seeded = all(recipe.family(group).seeded for group in chosen) and len(chosen) >= 3
    fields["split"]["by"] = "scene" if seeded else "sequence"
    ground = ("seabed", "plate", "surface")
    return fields, [(shape, "") for shape in ground if shape in recipe.family(0).build(0).shape_names], []


def _of_scene(
    name: str, views: DetectorViews, sonar: str | None, chosen: bool
) -> tuple[Keys, list[tuple[str, str]], list[str]]:
    """Return the keys of a recipe of a scene file; the window is cut to the ground unless the user has chosen it."""
    path = find_scene(name).resolve()
    loaded = load_scene(path)
    names, boxes = shape_names_in(loaded), shape_boxes_in(loaded)
    size, ground = _ground(path, covered_squares_in(loaded))
    objects = [box for box, flat in zip(boxes, ground, strict=True) if not flat]
    if not objects:
        raise MitsonarError(f"{path} holds its ground and no objects: a detector needs some to find")
    top = float(boxes[ground, 1, 2].max())
    heights = views.heights or (top + 1.5, top + 3.0)
    if heights[0] < top + CLEAR_M:
        raise MitsonarError(
            f"--height must be at least {top + CLEAR_M:.3g} m, {CLEAR_M:g} m over the ground of {path}: got {heights[0]:g}"
        )
    found = sonar_in(loaded)
    if sonar is not None:
        instrument, keys = load_sonar(sonar), _sonar_fields(sonar)
    elif found is not None:
        instrument = found[0]
        keys = instrument.model_dump(exclude_unset=True)
    else:
        raise MitsonarError(f"{path} has no sensor of type imaging_sonar: name a sonar, --sonar oculus-m750d-1200khz")
    left_out = list(dict.fromkeys(name for name, flat in zip(names, ground, strict=True) if flat))
    notes = [f"ground, without a class: {', '.join(left_out)}"]
    keys, note = (keys, []) if chosen else _within(instrument, keys, size)
    fields: Keys = {
        "name": path.stem,
        "about": f"views of {path.name} for a detector",
        "world": {"family": "scene", "file": str(path), "size_m": size},
        "scenes": _scenes(views.frames, [{}] * max(1, min(len(views.noise_db), views.frames))),
        "sonar": keys,
        "mount": {"pitch_deg": 0.0},
        "flight": {
            "height_m": list(heights),
            "pitch_deg": [10.0, 30.0],
            "keep_out": [[*(box[0] - CLEAR_M), *(box[1] + CLEAR_M)] for box in objects],
        },
        "split": {"by": "sequence"},
    }
    return fields, [(name, "") for name in left_out], [*notes, *note]


def _ground(path: Path, halves: NDArray[np.float64]) -> tuple[float, NDArray[np.bool_]]:
    """Return the edge of the square around the origin that the widest shape covers [m], and which shapes cover it.

    Raises:
        MitsonarError: no shape lies around the origin.
    """
    if not len(halves):
        raise MitsonarError(f"{path} holds no shapes: give a scene with a ground and objects")
    size = 2 * float(halves.max())
    if size <= 0:
        raise MitsonarError(f"no shape of {path} lies around the origin: its ground must, since views are drawn there")
    return math.floor(size * 1000) / 1000, 2 * halves >= GROUND * size


def _within(sonar: Sonar, keys: Keys, size: float) -> tuple[Keys, list[str]]:
    """Return the keys of a sonar whose window is no longer than its scene allows, and a sentence where it was cut."""
    reach = REACH * size
    if sonar.range_max <= reach:
        return keys, []
    if reach <= sonar.range_min:
        raise MitsonarError(
            f"a scene of {size:g} m is too small for a window from {sonar.range_min:g} m: give another sonar"
        )
    bins = max(1, round(sonar.range_bins * (reach - sonar.range_min) / (sonar.range_max - sonar.range_min)))
    note = f"range_max is {reach:.3g} m in place of {sonar.range_max:g}, so that fans fit into {size:g} m of ground"
    return {**keys, "range_max": reach, "range_bins": bins}, [f"{note}; --set sonar.range_max=... changes it"]
