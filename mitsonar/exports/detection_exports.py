"""COCO and YOLO: pictures with boxes, masks and classes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
import yaml

from mitsonar.exports.export_folder import json_line, png
from mitsonar.exports.export_source import ExportSource
from mitsonar.exports.labelled_pictures import LabelledPictures, Region, class_names
from mitsonar.exports.run_length import compressed, runs_of
from mitsonar.exports.shots import refuse_unlabelled, shots
from mitsonar.io.whole_files import write_whole

__all__ = ["export_coco", "export_yolo"]

YOLO_PARTS = {"train": "train", "validation": "val", "test": "test"}


def export_coco(source: ExportSource, pictures: LabelledPictures, folder: Path) -> Iterator[int]:
    """Write ``images/`` and ``annotations.json``, masks as compressed runs; yield after each frame.

    Classes are shapes, with 1 for the shape of number 0. Attributes of an annotation name its object.
    """
    refuse_unlabelled(source)
    (folder / "images").mkdir()
    columns, rows = pictures.size
    kinds: set[int] = set()
    count, names = 0, source.like.object_names
    with (folder / "images.part").open("w") as images, (folder / "annotations.part").open("w") as annotations:
        for shot in shots(source):
            write_whole(folder / "images" / f"{shot.name}.png", png(pictures.picture(shot.frames, shot.index)))
            size = {"width": columns, "height": rows, "file_name": f"{shot.name}.png"}
            extra = {"part": shot.part, "sequence": int(source.sequence[shot.number])}
            images.write(f"{json_line({'id': shot.number + 1, **size, **extra})}\n")
            for region in pictures.regions(shot.frames, shot.index):
                count, kinds = count + 1, kinds | {region.kind}
                object_name = names[region.number] if region.number < len(names) else ""
                annotations.write(
                    f"{json_line(_annotation(count, shot.number + 1, region, object_name, (rows, columns)))}\n"
                )
            yield 1
    classes = _classes(source, kinds)
    table = [{"id": kind + 1, "name": name, "supercategory": "shape"} for kind, name in classes.items()]
    about = {"description": source.about or source.name, "contributor": "mitsonar", "picture": pictures.picture_kind}
    with (folder / "annotations.json").open("w") as whole:  # piece by piece: it may be larger than the memory
        whole.write(f'{{"info":{json_line(about)},"licenses":[],"categories":{json_line(table)},"images":[')
        _copy(folder / "images.part", whole)
        whole.write('],"annotations":[')
        _copy(folder / "annotations.part", whole)
        whole.write("]}\n")


def _annotation(number: int, image: int, region: Region, name: str, size: tuple[int, int]) -> dict[str, object]:
    return {
        "id": number,
        "image_id": image,
        "category_id": region.kind + 1,
        "bbox": list(region.box),
        "area": int(np.count_nonzero(region.mask)),
        "iscrowd": 0,
        "segmentation": {"size": list(size), "counts": compressed(runs_of(region.mask))},
        "attributes": {"object": region.number, "object_name": name},
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
    picture. Parts are train, val and test. Where nothing is for validation, training is named for it.
    """
    refuse_unlabelled(source)
    kinds: set[int] = set()
    parts: set[str] = set()
    for shot in shots(source):
        part = YOLO_PARTS[shot.part]
        for kind in ("images", "labels") if part not in parts else ():
            (folder / kind / part).mkdir(parents=True)
        parts.add(part)
        regions = pictures.regions(shot.frames, shot.index)
        kinds |= {region.kind for region in regions}
        lines = [line for region in regions for line in _yolo_lines(region, pictures.size, polygons)]
        write_whole(folder / "images" / part / f"{shot.name}.png", png(pictures.picture(shot.frames, shot.index)))
        write_whole(folder / "labels" / part / f"{shot.name}.txt", "".join(f"{line}\n" for line in lines).encode())
        yield 1
    known = _classes(source, kinds)
    names = [known.get(number, f"shape {number}") for number in range(max(known, default=-1) + 1)]
    told = {part: f"images/{part}" for part in sorted(parts)}
    told.setdefault("train", told[min(told)])
    told.setdefault("val", told["train"])
    text = yaml.safe_dump({**told, "names": dict(enumerate(names))}, sort_keys=False, allow_unicode=True)
    write_whole(folder / "data.yaml", text.encode())


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


def _classes(source: ExportSource, kinds: set[int]) -> dict[int, str]:
    """Return the names of classes: all shapes with names, else the numbers that were seen."""
    return class_names(source.like) or {kind: f"shape {kind}" for kind in sorted(kinds)}
