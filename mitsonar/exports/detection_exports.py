"""COCO and YOLO: pictures with boxes, masks and classes, in parts for training, validation and test."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO

import numpy as np
import yaml

from mitsonar.errors import MitsonarWarning
from mitsonar.exports.export_folder import json_line, png
from mitsonar.exports.export_source import ExportSource
from mitsonar.exports.labelled_pictures import LabelledPictures, Region
from mitsonar.exports.run_length import compressed, runs_of
from mitsonar.exports.shots import Shot, refuse_unlabelled, shots
from mitsonar.io.files import write_whole

__all__ = ["export_coco", "export_yolo"]

YOLO_PARTS = {"train": "train", "validation": "val", "test": "test"}


def export_coco(source: ExportSource, pictures: LabelledPictures, folder: Path) -> Iterator[int]:
    """Write ``images/PART/`` and ``annotations/PART.json``, masks as compressed runs; yield after each frame.

    Categories are classes, numbered from 1. Attributes of an annotation name its shape and its object.
    """
    refuse_unlabelled(source)
    (folder / "annotations").mkdir()
    columns, rows = pictures.size
    count, like, parts = 0, source.like, _parts_of(source)
    with ExitStack() as files:
        tables: dict[str, tuple[IO[str], IO[str]]] = {}
        for part in parts:
            (folder / "images" / part).mkdir(parents=True)
            images, annotations = (folder / f"{part}.{name}" for name in ("images", "annotations"))
            tables[part] = files.enter_context(images.open("w")), files.enter_context(annotations.open("w"))
        for shot in shots(source):
            name = f"{shot.name}.png"
            write_whole(folder / "images" / shot.part / name, png(pictures.picture(shot.frames, shot.index)))
            size = {"width": columns, "height": rows, "file_name": name}
            extra = {"part": shot.part, "sequence": int(source.sequence[shot.number])}
            tables[shot.part][0].write(f"{json_line({'id': shot.number + 1, **size, **extra})}\n")
            for region in _regions(source, pictures, shot):
                count += 1
                names = (
                    like.shape_names[region.shape] if region.shape < len(like.shape_names) else f"shape {region.shape}",
                    like.object_names[region.number] if region.number < len(like.object_names) else "",
                )
                found = _annotation(count, shot.number + 1, region, names, (rows, columns))
                tables[shot.part][1].write(f"{json_line(found)}\n")
            yield 1
    pictures.refuse_none(source.frames)
    table = [{"id": kind + 1, "name": name, "supercategory": "shape"} for kind, name in enumerate(pictures.classes)]
    about = {"description": source.about or source.name, "contributor": "mitsonar", "picture": pictures.picture_kind}
    for part in parts:
        with (folder / "annotations" / f"{part}.json").open("w") as whole:  # piece by piece: it may exceed the memory
            whole.write(f'{{"info":{json_line(about)},"licenses":[],"categories":{json_line(table)},"images":[')
            _copy(folder / f"{part}.images", whole)
            whole.write('],"annotations":[')
            _copy(folder / f"{part}.annotations", whole)
            whole.write("]}\n")


def _parts_of(source: ExportSource) -> list[str]:
    """Return the parts that have frames; a warning names what a detector needs and lacks."""
    parts = [part for part in YOLO_PARTS if (source.part == part).any()]
    lacking = [part for part in ("train", "validation") if part not in parts]
    if lacking:
        warnings.warn(f"no frames are for {' and '.join(lacking)}: give --split", MitsonarWarning, stacklevel=3)
    return parts


def _regions(source: ExportSource, pictures: LabelledPictures, shot: Shot) -> list[Region]:
    """Return the regions of a frame, and count them."""
    found = pictures.regions(shot.frames, shot.index, float(source.raised_db[shot.number]))
    pictures.count(shot.part, found)
    return found


def _annotation(number: int, image: int, region: Region, names: tuple[str, str], size: tuple[int, int]) -> dict[str, object]:
    return {
        "id": number,
        "image_id": image,
        "category_id": region.kind + 1,
        "bbox": list(region.box),
        "area": int(np.count_nonzero(region.mask)),
        "iscrowd": 0,
        "segmentation": {"size": list(size), "counts": compressed(runs_of(region.mask))},
        "attributes": {"shape": names[0], "object": region.number, "object_name": names[1]},
    }


def _copy(part: Path, whole: IO[str]) -> None:
    """Append the lines of a file, with commas between them, and remove it."""
    with part.open() as lines:
        for place, line in enumerate(lines):
            whole.write(("," if place else "") + line.rstrip("\n"))
    part.unlink()


def export_yolo(source: ExportSource, pictures: LabelledPictures, folder: Path, *, polygons: bool = False) -> Iterator[int]:
    """Write ``images/PART/``, ``labels/PART/`` and ``data.yaml``; yield after each frame.

    A line of a label file is the class and the middle and size of the box, or with ``polygons`` the outline, as parts of the
    picture. Parts are train, val and test; ``data.yaml`` names those that have frames.
    """
    refuse_unlabelled(source)
    parts = [YOLO_PARTS[part] for part in _parts_of(source)]
    for part in parts:
        for kind in ("images", "labels"):
            (folder / kind / part).mkdir(parents=True)
    for shot in shots(source):
        part = YOLO_PARTS[shot.part]
        lines = [line for one in _regions(source, pictures, shot) for line in _yolo_lines(one, pictures.size, polygons)]
        write_whole(folder / "images" / part / f"{shot.name}.png", png(pictures.picture(shot.frames, shot.index)))
        write_whole(folder / "labels" / part / f"{shot.name}.txt", "".join(f"{line}\n" for line in lines).encode())
        yield 1
    pictures.refuse_none(source.frames)
    table = {**{part: f"images/{part}" for part in parts}, "names": dict(enumerate(pictures.classes))}
    write_whole(folder / "data.yaml", yaml.safe_dump(table, sort_keys=False, allow_unicode=True).encode())


def _yolo_lines(region: Region, size: tuple[int, int], polygons: bool) -> list[str]:
    columns, rows = size
    if polygons:
        outlines = [outline / size for outline in _outlines(region)]
        return [" ".join([str(region.kind), *(f"{value:.6f}" for value in one.ravel())]) for one in outlines]
    column, row, width, height = region.box
    values = ((column + width / 2) / columns, (row + height / 2) / rows, width / columns, height / rows)
    return [" ".join([str(region.kind), *(f"{value:.6f}" for value in values)])]


def _outlines(region: Region) -> list[np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
    """Return the outer outlines of a region ``(points, 2)`` along its pixels' middles; specks of two pixels have none."""
    import cv2

    found, _ = cv2.findContours(region.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return [one[:, 0, :].astype(float) + 0.5 for one in found if len(one) >= 3]
