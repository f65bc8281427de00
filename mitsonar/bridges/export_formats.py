"""How frames are exported in the layouts of other tools: COCO, YOLO, Hugging Face, WebDataset, KITTI, neusis."""

from __future__ import annotations

import contextlib
import io
import math
import pickle
import tarfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from mitsonar.bridges.export_source import (
    LEAST_SNR_DB,
    ExportSource,
    LabelledPictures,
    PictureKind,
    Region,
    Shot,
    as_json,
    compress_run_lengths,
    digest_of,
    json_line,
    new_folder,
    png,
    pose_fields,
    region_fields,
    require_labels,
    require_poses,
    run_lengths,
    shots,
)
from mitsonar.config.data import Keys, Recipe, load_recipe, recipe_from, set_key, shipped_recipes
from mitsonar.errors import MitsonarError, MitsonarWarning, suggest_names
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar, named_sonars
from mitsonar.io.files import PlainValue, write_atomic
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.motion.trajectory import CONVENTIONS
from mitsonar.records.frames import to_float32
from mitsonar.simulation.scene import covered_squares_in, find_scene, load_scene, shape_boxes_in, shape_names_in, sonar_in
from mitsonar.worlds.scene_check import SceneFile

__all__ = [
    "EXPORTS",
    "DetectorViews",
    "detector_recipe",
    "export_coco",
    "export_hugging_face",
    "export_kitti",
    "export_neusis",
    "export_to",
    "export_webdataset",
    "export_yolo",
]


# ---------------- COCO and YOLO


YOLO_PARTS = {"train": "train", "validation": "val", "test": "test"}


def export_coco(source: ExportSource, pictures: LabelledPictures, folder: Path) -> Iterator[int]:
    """Write COCO's ``images/PART/`` and ``annotations/PART.json``, with run-length encoded masks; yield after each frame.

    Category ids are class indices plus 1. The attributes of an annotation give the names of its shape and its object.
    """
    # 1. Write the pictures. Write the records of images and annotations line by line into temporary files, because all of
    #    them together may exceed the memory.
    require_labels(source)
    (folder / "annotations").mkdir()
    columns, rows = pictures.size
    count, like, parts = 0, source.like, _parts_of(source)
    with ExitStack() as files:
        tables: dict[str, tuple[IO[str], IO[str]]] = {}
        for part in parts:
            (folder / "images" / part).mkdir(parents=True)
            images, annotations = (folder / f"{part}.{name}" for name in ("images", "annotations"))
            tables[part] = files.enter_context(_text_file(images)), files.enter_context(_text_file(annotations))
        for shot in shots(source):
            name = f"{shot.name}.png"
            write_atomic(folder / "images" / shot.part / name, png(pictures.picture(shot.frames, shot.index)))
            size = {"width": columns, "height": rows, "file_name": name}
            extra = {"part": shot.part, "sequence": int(source.sequence[shot.number])}
            tables[shot.part][0].write(f"{json_line({'id': shot.number + 1, **size, **extra})}\n")
            for region in _regions(source, pictures, shot):
                count += 1
                names = (
                    like.shape_names[region.shape] if region.shape < len(like.shape_names) else f"shape {region.shape}",
                    like.object_names[region.number] if region.number < len(like.object_names) else "",
                )
                record = _annotation(count, shot.number + 1, region, names, (rows, columns))
                tables[shot.part][1].write(f"{json_line(record)}\n")
            yield 1
    # 2. Join the temporary files of each part into one JSON document.
    pictures.require_regions(source.frames)
    table = [{"id": kind + 1, "name": name, "supercategory": "shape"} for kind, name in enumerate(pictures.classes)]
    about = {"description": source.about or source.name, "contributor": "mitsonar", "picture": pictures.picture_kind}
    for part in parts:
        with _text_file(folder / "annotations" / f"{part}.json") as document:  # streamed, without a copy in memory
            document.write(f'{{"info":{json_line(about)},"licenses":[],"categories":{json_line(table)},"images":[')
            _copy(folder / f"{part}.images", document)
            document.write('],"annotations":[')
            _copy(folder / f"{part}.annotations", document)
            document.write("]}\n")


def _parts_of(source: ExportSource) -> list[str]:
    """Return the names of the parts that have frames; warn if training or validation, which a detector needs, has none."""
    parts = [part for part in YOLO_PARTS if (source.part == part).any()]
    missing = [part for part in ("train", "validation") if part not in parts]
    if missing:
        warnings.warn(f"no frames are in the parts {' and '.join(missing)}: give --split", MitsonarWarning, stacklevel=3)
    return parts


def _regions(source: ExportSource, pictures: LabelledPictures, shot: Shot) -> list[Region]:
    """Return the regions of a frame, and add them to the counts of ``pictures``."""
    regions = pictures.regions(shot.frames, shot.index, float(source.raised_db[shot.number]))
    pictures.count(shot.part, regions)
    return regions


def _annotation(number: int, image: int, region: Region, names: tuple[str, str], size: tuple[int, int]) -> dict[str, object]:
    return {
        "id": number,
        "image_id": image,
        "category_id": region.kind + 1,
        "bbox": list(region.box),
        "area": int(np.count_nonzero(region.mask)),
        "iscrowd": 0,
        "segmentation": {"size": list(size), "counts": compress_run_lengths(run_lengths(region.mask))},
        "attributes": {"shape": names[0], "object": region.number, "object_name": names[1]},
    }


def _text_file(path: Path) -> IO[str]:
    """Open a new text file that has the same bytes on every system."""
    return path.open("w", encoding="utf-8", newline="\n")


def _copy(source: Path, target: IO[str]) -> None:
    """Append the lines of a file to another, separated by commas, and remove the first file."""
    with source.open(encoding="utf-8") as lines:
        for number, line in enumerate(lines):
            target.write(("," if number else "") + line.rstrip("\n"))
    source.unlink()


def export_yolo(source: ExportSource, pictures: LabelledPictures, folder: Path, *, polygons: bool = False) -> Iterator[int]:
    """Write YOLO's ``images/PART/``, ``labels/PART/`` and ``data.yaml``; yield after each frame.

    A line of a label file, one for each object, has the class and the centre and size of the box, or with ``polygons`` the
    outline, as fractions of the picture's size. Parts are train, val and test; ``data.yaml`` lists those that have frames.
    """
    require_labels(source)
    parts = [YOLO_PARTS[part] for part in _parts_of(source)]
    for part in parts:
        for kind in ("images", "labels"):
            (folder / kind / part).mkdir(parents=True)
    for shot in shots(source):
        part = YOLO_PARTS[shot.part]
        lines = [_yolo_line(region, pictures.size, polygons) for region in _regions(source, pictures, shot)]
        write_atomic(folder / "images" / part / f"{shot.name}.png", png(pictures.picture(shot.frames, shot.index)))
        write_atomic(folder / "labels" / part / f"{shot.name}.txt", "".join(f"{line}\n" for line in lines).encode())
        yield 1
    pictures.require_regions(source.frames)
    table = {**{part: f"images/{part}" for part in parts}, "names": dict(enumerate(pictures.classes))}
    write_atomic(folder / "data.yaml", yaml.safe_dump(table, sort_keys=False, allow_unicode=True).encode())


def _yolo_line(region: Region, size: tuple[int, int], polygons: bool) -> str:
    columns, rows = size
    if polygons:
        return " ".join([str(region.kind), *(f"{value:.6f}" for value in (_outline(region) / size).ravel())])
    column, row, width, height = region.box
    values = ((column + width / 2) / columns, (row + height / 2) / rows, width / columns, height / rows)
    return " ".join([str(region.kind), *(f"{value:.6f}" for value in values)])


def _outline(region: Region) -> NDArray[np.float64]:
    """Return one outline of a region ``(points, 2)``: YOLO takes each line for an object, so its parts are joined.

    The outline goes to each further part and back along the shortest line from what it has already passed.
    """
    joined, *others = sorted(_outlines(region), key=len, reverse=True)
    middle = joined.mean(axis=0)
    for part in sorted(others, key=lambda points: float(np.linalg.norm(points.mean(axis=0) - middle))):
        here, there = divmod(int(cdist(joined, part).argmin()), len(part))
        joined = np.concatenate([joined[: here + 1], part[there:], part[: there + 1], joined[here:]])
    return joined


def _outlines(region: Region) -> list[NDArray[np.float64]]:
    """Return the outlines of the parts of a region ``(points, 2)`` through pixel centres; a line of them is a rectangle."""
    import cv2

    contours, _ = cv2.findContours(region.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    outlines = []
    for contour in contours:
        column, row, width, height = cv2.boundingRect(contour)
        corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * (width, height) + (column, row)
        outlines.append(contour[:, 0, :].astype(float) + 0.5 if len(contour) >= 3 else corners.astype(float))
    return outlines


# ---------------- Data set recipe for a detector


CLEARANCE_M = 0.3
"""Smallest distance of the sonar from the bounding box of an object and from the ground [m]."""

MIN_GROUND_FRACTION = 0.9
"""Smallest fraction of the scene's edge that a shape covers if it counts as ground."""

MAX_RANGE_FRACTION = 0.6
"""Largest range of the sonar as a fraction of the scene's edge; a longer fan would hardly fit inside the scene."""

DEFAULT_SPLIT = 0.7, 0.15, 0.15
FRAMES_PER_WORLD = 10
"""Number of frames per generated world, if there are enough worlds."""


@dataclass(frozen=True)
class DetectorViews:
    """Random views for a detector's data set.

    Attributes:
        frames: number of pictures.
        heights: smallest and largest height of the sonar [m]; None: 1.5 to 3 m above the ground of a scene, or as in the
            recipe.
        pitch_deg: smallest and largest pitch, > 0 looks down [deg]; None: 10 to 30, or as in the recipe.
        noise_db: levels added to the noise of the sonar [dB], assigned in turn to scenes, or to parts of one scene.
        split: shares of training, validation and test.
        seed: seed of poses, worlds and noise.
    """

    frames: int
    heights: tuple[float, float] | None = None
    pitch_deg: tuple[float, float] | None = None
    noise_db: tuple[float, ...] = ()
    split: tuple[float, float, float] = DEFAULT_SPLIT
    seed: int = 0


def detector_recipe(
    scene: str | Path, views: DetectorViews, sonar: str | None = None, changes: Keys | None = None
) -> tuple[Recipe, list[tuple[str, str]], list[str]]:
    """Create a data set recipe for a detector: random views, one ping per sequence, with labels of shapes and objects.

    In a scene file the sonar stays above the ground, and outside the bounding boxes of all other shapes. The worlds of a
    recipe are split by scene, the views of one scene file by sequence.

    Args:
        scene: a Mitsuba XML file, the name of a shipped scene, or the recipe of a data set whose worlds are used.
        views: number of views, their poses and their noise.
        sonar: preset or YAML file of a sonar; default: the sonar of the scene or of the recipe.
        changes: recipe values to change, keyed by dotted path.

    Returns:
        The recipe; rules for :class:`~mitsonar.bridges.export_source.LabelledPictures` that leave out the ground; and
        sentences that explain automatic choices.

    Raises:
        MitsonarError: there are fewer frames than parts; the scene, its sonar or its ground is missing; a height lies within
            the ground; or the recipe is one of a scene file.
    """
    # 1. Start from the keys of the recipe, or from those derived from the scene.
    parts = sum(share > 0 for share in views.split)
    if views.frames < parts:
        raise MitsonarError(f"--frames must be at least {parts}, one for each part of --split: got {views.frames}")
    is_recipe = str(scene).lower().endswith((".yaml", ".yml")) or str(scene) in shipped_recipes()
    range_given = "sonar.range_max" in (changes or {})
    fields, rules, notes = (
        _fields_from_recipe(str(scene), views) if is_recipe else _fields_from_scene(str(scene), views, sonar, range_given)
    )
    if is_recipe and sonar is not None:
        fields["sonar"] = _sonar_fields(sonar)
    # 2. Apply the views: isolated pings anywhere, with the requested heights, pitches, noise and split.
    flight = fields["flight"]
    flight |= {"kind": "random", "pings": 1, "jump_m": None}
    flight |= {} if views.heights is None else {"height_m": list(views.heights)}
    if views.pitch_deg is not None:
        flight["pitch_deg"] = list(views.pitch_deg)
        fields["mount"] = {**fields.get("mount", {}), "pitch_deg": 0.0}
    train, validation, test = views.split
    fields |= {"frames": 1, "labels": ["shape_id", "object_id"], "noise_db": list(views.noise_db), "seed": views.seed}
    fields["split"] = {**fields["split"], "train": train, "validation": validation, "test": test}
    # 3. Apply the user's changes. A coherent model labels only what its pictures show, unless the user decides otherwise.
    for key, value in (changes or {}).items():
        set_key(fields, key, value)
    recipe = recipe_from(fields)
    if recipe.sonar is not None and recipe.instrument.model == "coherent" and "visible_labels" not in (changes or {}):
        recipe = recipe_from({**fields, "visible_labels": True})
    return recipe, rules, notes


def _sonar_fields(name: str) -> Keys:
    """Return the keys of a sonar, given the name of a preset or a file."""
    if name in named_sonars():
        return {"preset": name}
    return load_sonar(name).model_dump(exclude_unset=True)


def _scenes(frames: int, worlds: Sequence[Keys]) -> list[Keys]:
    """Distribute frames evenly over worlds, one sequence per frame; return the scenes of the recipe."""
    counts = np.diff(np.rint(np.linspace(0, frames, len(worlds) + 1)).astype(int))
    return [{"count": 1, "sequences": int(count), "world": world} for count, world in zip(counts, worlds, strict=True)]


def _fields_from_recipe(name: str, views: DetectorViews) -> tuple[Keys, list[tuple[str, str]], list[str]]:
    """Return keys, class rules and notes for the worlds of a recipe. Worlds that depend on a seed are split by scene."""
    recipe = load_recipe(name)
    files = [family.file for group in range(len(recipe.scenes)) if isinstance(family := recipe.family(group), SceneFile)]
    if files:
        raise MitsonarError(f"{name} flies over the scene {files[0]}: give that file in place of the recipe")
    groups = [group for group, scene in enumerate(recipe.scenes) for _ in range(scene.count)]
    target_worlds = max(3, len(views.noise_db), views.frames // FRAMES_PER_WORLD)
    chosen = [
        groups[int(position)]
        for position in np.linspace(0, len(groups) - 1, min(len(groups), target_worlds, views.frames)).round()
    ]
    fields = recipe.model_dump(mode="json")
    fields["scenes"] = _scenes(views.frames, [dict(recipe.scenes[group].world) for group in chosen])
    seeded = all(recipe.family(group).seeded for group in chosen) and len(chosen) >= 3
    fields["split"]["by"] = "scene" if seeded else "sequence"
    ground = ("seabed", "plate", "surface")
    return fields, [(shape, "") for shape in ground if shape in recipe.family(0).build(0).shape_names], []


def _fields_from_scene(
    name: str, views: DetectorViews, sonar: str | None, range_given: bool
) -> tuple[Keys, list[tuple[str, str]], list[str]]:
    """Return keys, class rules and notes for a scene file. The ground limits the range, unless it was ``range_given``."""
    # 1. Separate the ground from the objects.
    path = find_scene(name).resolve()
    scene = load_scene(path)
    names, boxes = shape_names_in(scene), shape_boxes_in(scene)
    size, ground = _ground(path, covered_squares_in(scene))
    objects = [box for box, is_ground in zip(boxes, ground, strict=True) if not is_ground]
    if not objects:
        raise MitsonarError(f"{path} contains only ground: a detector needs objects")
    # 2. Keep the sonar above the highest point of the ground.
    top = float(boxes[ground, 1, 2].max())
    heights = views.heights or (top + 1.5, top + 3.0)
    if heights[0] < top + CLEARANCE_M:
        raise MitsonarError(
            f"--height must be at least {top + CLEARANCE_M:.3g} m, {CLEARANCE_M:g} m above the ground of {path}: "
            f"got {heights[0]:g}"
        )
    # 3. Choose the sonar, and limit its range to the size of the scene.
    scene_sonar = sonar_in(scene)
    if sonar is not None:
        instrument, keys = load_sonar(sonar), _sonar_fields(sonar)
    elif scene_sonar is not None:
        instrument = scene_sonar[0]
        keys = instrument.model_dump(exclude_unset=True)
    else:
        raise MitsonarError(
            f"{path} has no sensor of type imaging_sonar: give a sonar, such as --sonar oculus-m750d-1200khz"
        )
    left_out = list(dict.fromkeys(name for name, is_ground in zip(names, ground, strict=True) if is_ground))
    notes = [f"ground, without a class: {', '.join(left_out)}"]
    keys, range_notes = (keys, []) if range_given else _limit_range(instrument, keys, size)
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
            "keep_out": [[*(box[0] - CLEARANCE_M), *(box[1] + CLEARANCE_M)] for box in objects],
        },
        "split": {"by": "sequence"},
    }
    return fields, [(name, "") for name in left_out], [*notes, *range_notes]


def _ground(path: Path, halves: NDArray[np.float64]) -> tuple[float, NDArray[np.bool_]]:
    """Return the edge of the largest square around the origin that a shape covers [m], and the mask of the ground shapes.

    Args:
        path: the scene file, for error messages.
        halves: half the edge of the square that each shape covers ``(shapes,)`` [m].

    Raises:
        MitsonarError: no shape covers the origin.
    """
    if not len(halves):
        raise MitsonarError(f"{path} contains no shapes: give a scene with a ground and objects")
    size = 2 * float(halves.max())
    if size <= 0:
        raise MitsonarError(f"no shape of {path} covers the origin: views are drawn around it, so the ground must cover it")
    return math.floor(size * 1000) / 1000, 2 * halves >= MIN_GROUND_FRACTION * size


def _limit_range(sonar: Sonar, keys: Keys, size: float) -> tuple[Keys, list[str]]:
    """Limit the range of a sonar to the size of its scene. Return its keys, and a note if the range was changed."""
    reach = MAX_RANGE_FRACTION * size
    if sonar.range_max <= reach:
        return keys, []
    if reach <= sonar.range_min:
        raise MitsonarError(
            f"a scene of {size:g} m is too small for a window from {sonar.range_min:g} m: give another sonar"
        )
    bins = max(1, round(sonar.range_bins * (reach - sonar.range_min) / (sonar.range_max - sonar.range_min)))
    note = f"range_max was reduced from {sonar.range_max:g} to {reach:.3g} m to fit into {size:g} m of ground"
    return {**keys, "range_max": reach, "range_bins": bins}, [f"{note}; override it with --set sonar.range_max=..."]


# ---------------- Hugging Face


CROISSANT_CONTEXT: dict[str, PlainValue] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
"""JSON-LD context prescribed by Croissant 1.0."""


def export_hugging_face(source: ExportSource, pictures: LabelledPictures, folder: Path) -> Iterator[int]:
    """Write a Hugging Face image folder; yield after each frame.

    It contains ``data/PART/*.png`` with a ``metadata.jsonl`` for each part, the dataset card ``README.md``, and Croissant
    metadata in ``croissant.json``.
    """
    counts: dict[str, int] = {}
    keys: dict[str, str] = {}
    with contextlib.ExitStack() as files:
        tables: dict[str, IO[str]] = {}
        for shot in shots(source):
            part_folder = folder / "data" / shot.part
            if shot.part not in tables:
                part_folder.mkdir(parents=True)
                tables[shot.part] = files.enter_context(_text_file(part_folder / "metadata.jsonl"))
            counts[shot.part] = counts.get(shot.part, 0) + 1
            write_atomic(part_folder / f"{shot.name}.png", png(pictures.picture(shot.frames, shot.index)))
            record: dict[str, PlainValue] = {"file_name": f"{shot.name}.png", **pose_fields(shot)}
            record["sequence"] = int(source.sequence[shot.number])
            keys = {key: "sc:Integer" if isinstance(value, int) else "sc:Float" for key, value in record.items()}
            if "shape_id" in source.labels:
                record["objects"] = region_fields(shot, pictures, source)
            tables[shot.part].write(f"{json_line(record)}\n")
            yield 1
    keys["file_name"] = "sc:Text"
    write_atomic(folder / "README.md", _card(source, pictures, counts).encode())
    write_atomic(folder / "croissant.json", as_json(_croissant(source, folder, sorted(counts), keys)))


def _card(source: ExportSource, pictures: LabelledPictures, counts: dict[str, int]) -> str:
    """Return the dataset card, with the YAML header that the Hugging Face Hub reads."""
    parts = [{"split": part, "path": f"data/{part}/**"} for part in counts]
    head = {"task_categories": ["object-detection"], "tags": ["sonar", "simulation", "mitsonar"]}
    configs = {"configs": [{"config_name": "default", "data_files": parts}]}
    text = yaml.safe_dump({**head, **configs}, sort_keys=False)
    lines = [f"| {part} | {count:,} |" for part, count in counts.items()]
    table = "\n".join(["| part | frames |", "|---|---|", *lines])
    about = f"{source.about or source.name}. Sonar frames, {pictures.picture_kind} pictures, exported by mitsonar."
    names = ", ".join(name for name in source.like.shape_names if name)
    return f"---\n{text}---\n# Sonar frames\n{about}\n\n{table}\n" + (f"\nShapes: {names}.\n" if names else "")


def _croissant(source: ExportSource, folder: Path, parts: list[str], keys: dict[str, str]) -> dict[str, PlainValue]:
    """Return the Croissant metadata: one file object and one record set for the table of each part."""
    objects: list[PlainValue] = []
    records: list[PlainValue] = []
    for part in parts:
        path, table = f"data/{part}/metadata.jsonl", f"{part}-metadata"
        file_object = {"@type": "cr:FileObject", "@id": table, "name": table, "contentUrl": path}
        objects.append({**file_object, "encodingFormat": "application/jsonlines", "sha256": digest_of(folder / path)})
        fields = [
            {
                "@type": "cr:Field",
                "@id": f"{part}/{key}",
                "name": key,
                "dataType": kind,
                "source": {"fileObject": {"@id": table}, "extract": {"column": key}},
            }
            for key, kind in keys.items()
        ]
        records.append({"@type": "cr:RecordSet", "@id": part, "name": part, "field": fields})
    return {
        "@context": CROISSANT_CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": "sonar-frames",
        "description": source.about or source.name,
        "distribution": objects,
        "recordSet": records,
    }


# ---------------- WebDataset


SAMPLES_PER_SHARD = 1000
"""Number of samples in a shard."""


def export_webdataset(source: ExportSource, pictures: LabelledPictures, folder: Path) -> Iterator[int]:
    """Write the shards ``PART-000000.tar`` ... of a WebDataset, and ``about.json``; yield after each frame.

    A sample consists of ``png``, ``json`` (time, pose, sequence, regions), and, if there are labels, ``shape.png`` and
    ``object.png``: 16-bit labels plus one, 0 for no echo.
    """
    counts: dict[str, int] = {}
    with contextlib.ExitStack() as ends:
        files: dict[str, tarfile.TarFile] = {}
        for shot in shots(source):
            number = counts.get(shot.part, 0)
            if number % SAMPLES_PER_SHARD == 0:
                if shot.part in files:
                    files[shot.part].close()
                path = folder / f"{shot.part}-{number // SAMPLES_PER_SHARD:06d}.tar"
                files[shot.part] = ends.enter_context(tarfile.open(path, "w", format=tarfile.USTAR_FORMAT))
            counts[shot.part] = number + 1
            about = {"sequence": int(source.sequence[shot.number]), **pose_fields(shot)}
            parts = {"png": png(pictures.picture(shot.frames, shot.index))}
            for name in ("shape", "object"):
                if f"{name}_id" in source.labels:
                    label = pictures.label(shot.frames, f"{name}_id", shot.index) + 1
                    parts[f"{name}.png"] = png(np.clip(label, 0, 65535).astype(np.uint16))
            parts["json"] = json_line({**about, "regions": region_fields(shot, pictures, source)}).encode()
            for extension, content in parts.items():
                entry = tarfile.TarInfo(f"{shot.name}.{extension}")
                entry.size = len(content)
                files[shot.part].addfile(entry, io.BytesIO(content))
            yield 1
    names = {"shapes": list(source.like.shape_names), "objects": list(source.like.object_names)}
    metadata = {"source": source.name, "about": source.about, "picture": pictures.picture_kind, "samples": counts, **names}
    write_atomic(folder / "about.json", as_json(metadata))


# ---------------- KITTI and neusis


CAMERA_AXES = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Axes of a camera (starboard, down, forward), as columns in (starboard, forward, up)."""


UNEVEN = 0.1
"""Deviation of a beam from the even angles of neusis above which it warns, as a fraction of the beam spacing."""


def export_kitti(source: ExportSource, pictures: LabelledPictures, folder: Path) -> Iterator[int]:
    """Write KITTI's ``poses/00.txt``, ``sequences/00/times.txt`` and ``sequences/00/image_0/``; yield after each frame.

    Each line of ``poses`` contains the first three rows of the matrix from the sonar's axes (x starboard, y down, z forward)
    to those of the first frame in the sequence. The frames of a sequence must be consecutive.
    """
    require_poses(source)
    (folder / "poses").mkdir()
    sequence, first, number = -1, np.eye(4), 0
    poses: IO[str] | None = None
    times: IO[str] | None = None
    try:
        for shot in shots(source):
            if source.sequence[shot.number] != sequence or poses is None or times is None:
                sequence, number = int(source.sequence[shot.number]), 0
                name = f"{sequence:02d}"
                (folder / "sequences" / name / "image_0").mkdir(parents=True)
                for file in (poses, times):
                    if file is not None:
                        file.close()
                poses = _text_file(folder / "poses" / f"{name}.txt")
                times = _text_file(folder / "sequences" / name / "times.txt")
                start_s = float(np.mean(shot.frames.time_s[shot.index]))
            assert shot.frames.poses is not None
            matrix = np.eye(4)
            matrix[:3, :3] = vehicle_rotation(shot.frames.poses[shot.index]).as_matrix()[0] @ CAMERA_AXES
            matrix[:3, 3] = shot.frames.poses[shot.index, :3]
            first = matrix if number == 0 else first
            relative = np.linalg.inv(first) @ matrix
            poses.write(" ".join(f"{value:.12e}" for value in relative[:3].ravel()) + "\n")
            times.write(f"{float(np.mean(shot.frames.time_s[shot.index])) - start_s:.9e}\n")
            picture = png(pictures.picture(shot.frames, shot.index))
            write_atomic(folder / "sequences" / f"{sequence:02d}" / "image_0" / f"{number:06d}.png", picture)
            number += 1
            yield 1
    finally:
        for file in (poses, times):
            if file is not None:
                file.close()


def export_neusis(source: ExportSource, pictures: LabelledPictures, folder: Path) -> Iterator[int]:
    """Write ``Data/000000.pkl`` ... and ``Config.json``, as neusis' ``load_data`` reads them; yield after each frame.

    A pickle contains ``ImagingSonar``, float32 ``(bins, beams)`` in 0..1, with the nearest range in row 0 and the beam
    farthest to *starboard* in column 0, and ``PoseSensor``, the matrix ``(4, 4)`` from the sonar's axes (x forward, y to
    port, z up) to the world. In neusis the bearing of a pixel increases to port with its column. Pictures must be polar.

    Warns:
        MitsonarWarning: beams are not at even angles about the axis, where neusis places them.
    """
    require_poses(source)
    (folder / "Data").mkdir()
    for shot in shots(source):
        assert shot.frames.poses is not None
        values = to_float32(shot.frames.image[shot.index])
        state = {"ImagingSonar": values[:, ::-1].copy(), "PoseSensor": port_matrix(shot.frames.poses[shot.index])}
        write_atomic(folder / "Data" / f"{shot.name}.pkl", pickle.dumps(state, protocol=4))
        yield 1
    sonar = source.like.sonar
    bearing_rad = source.like.bearing_rad
    fov = float(np.ptp(bearing_rad)) * (1 + 1 / max(1, len(bearing_rad) - 1))
    step = fov / len(bearing_rad)
    off = float(np.abs((np.arange(len(bearing_rad)) - (len(bearing_rad) - 1) / 2) * step - bearing_rad).max())
    if off > UNEVEN * step:
        warnings.warn(
            f"neusis places beams at even angles about the axis, up to {math.degrees(off):.2g} deg from those of "
            f"{source.name}: give frames of a sonar with beam_layout even, and crop the same number of beams on both sides",
            MitsonarWarning,
            stacklevel=2,
        )
    configuration = {
        "Azimuth": math.degrees(fov),
        "Elevation": sonar.elevation_fov_deg,
        "RangeMin": sonar.range_min,
        "RangeMax": sonar.range_max,
        "RangeBins": sonar.range_bins,
        "AzimuthBins": len(bearing_rad),
    }
    agent = {"sensors": [{"sensor_type": "ImagingSonar", "configuration": configuration}]}
    write_atomic(folder / "Config.json", as_json({"name": source.name, "agents": [agent]}))


def port_matrix(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix ``(4, 4)`` from (forward, port, up) to the world for a pose ``(6,)`` [m, rad]."""
    positions, rotations = CONVENTIONS["ros-enu"].from_mitsonar(pose[None, :3], vehicle_rotation(pose))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotations.as_matrix()[0], positions[0]
    return matrix


# ---------------- Exports by name


Exporter = Callable[[ExportSource, LabelledPictures, Path], Iterator[int]]

EXPORTS: dict[str, Exporter] = {
    "coco": export_coco,
    "yolo": export_yolo,
    "webdataset": export_webdataset,
    "huggingface": export_hugging_face,
    "kitti": export_kitti,
    "neusis": export_neusis,
}
"""Writers of the layouts, by name; each yields the number of frames written since its last yield."""


def export_to(
    layout: str,
    source: ExportSource,
    out: Path,
    *,
    picture: PictureKind = "polar",
    classes: Sequence[tuple[str, str]] = (),
    least: int = 1,
    least_snr_db: float = LEAST_SNR_DB,
    polygons: bool = False,
    every_class: bool = False,
    progress: Callable[[int], None] = lambda done: None,
) -> LabelledPictures:
    """Export frames in the layout of another tool.

    The folder is written completely or not at all. Only a few frames are kept in memory at a time.

    Args:
        layout: a name of :data:`EXPORTS`.
        source: frames to export.
        out: folder to create.
        picture: ``polar`` or ``fan``.
        classes: globs of shape names with their classes; see
            :class:`~mitsonar.bridges.export_source.LabelledPictures`.
        least: smallest number of pixels of a region.
        least_snr_db: smallest signal-to-noise ratio of a region [dB].
        polygons: whether to write outlines instead of boxes; YOLO only.
        every_class: whether to raise an error if a class appears in no picture of the training part.
        progress: called with the number of frames written since the last call.

    Returns:
        The object that rendered the pictures; for COCO and YOLO with the counts of the regions.

    Raises:
        MitsonarError: the layout is unknown, the folder exists, the frames lack labels or poses that the layout needs, or an
            export to COCO or YOLO contains no object.
    """
    if layout not in EXPORTS:
        raise MitsonarError(f"unknown layout {layout!r}: {suggest_names(layout, EXPORTS)}")
    if polygons and layout != "yolo":
        raise MitsonarError(f"--polygons applies only to the layout yolo: got {layout}; COCO always has masks")
    if layout == "neusis" and picture != "polar":
        raise MitsonarError("the layout neusis supports polar pictures only: leave --picture out")
    exporter = partial(export_yolo, polygons=True) if polygons else EXPORTS[layout]
    pictures = LabelledPictures(source.like, picture, classes, least, least_snr_db)
    with new_folder(out) as folder:
        for done in exporter(source, pictures, folder):
            progress(done)
        missing = [name for name in pictures.classes if every_class and not pictures.boxes["train", name]]
        if missing:
            raise MitsonarError(
                f"no picture of the training part shows the class {missing[0]}: render more frames, nearer to it, lower "
                f"--least-snr-db or --least, or leave it out with --classes {missing[0]}="
            )
    return pictures
