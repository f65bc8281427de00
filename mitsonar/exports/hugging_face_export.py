"""Hugging Face: an image folder with a metadata.jsonl for each part, a card, and Croissant metadata."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import yaml

from mitsonar.exports.export_folder import digest_of, json_line, png
from mitsonar.exports.export_source import ExportSource
from mitsonar.exports.labelled_pictures import LabelledPictures
from mitsonar.exports.shots import as_json, pose_of, regions_of, shots
from mitsonar.io.files import PlainValue, write_whole

__all__ = ["export_hugging_face"]

CONTEXT: dict[str, PlainValue] = {
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
"""The context that Croissant 1.0 prescribes."""


def export_hugging_face(source: ExportSource, pictures: LabelledPictures, folder: Path) -> Iterator[int]:
    """Write ``data/PART/*.png`` with ``metadata.jsonl``, ``README.md`` and ``croissant.json``; yield after each frame."""
    counts: dict[str, int] = {}
    keys: dict[str, str] = {}
    with contextlib.ExitStack() as ends:
        tables: dict[str, IO[str]] = {}
        for shot in shots(source):
            place = folder / "data" / shot.part
            if shot.part not in tables:
                place.mkdir(parents=True)
                tables[shot.part] = ends.enter_context((place / "metadata.jsonl").open("w"))
            counts[shot.part] = counts.get(shot.part, 0) + 1
            write_whole(place / f"{shot.name}.png", png(pictures.picture(shot.frames, shot.index)))
            told: dict[str, PlainValue] = {"file_name": f"{shot.name}.png", **pose_of(shot)}
            told["sequence"] = int(source.sequence[shot.number])
            keys = {key: "sc:Integer" if isinstance(value, int) else "sc:Float" for key, value in told.items()}
            if "shape_id" in source.labels:
                told["objects"] = regions_of(shot, pictures, source)
            tables[shot.part].write(f"{json_line(told)}\n")
            yield 1
    keys["file_name"] = "sc:Text"
    write_whole(folder / "README.md", _card(source, pictures, counts).encode())
    write_whole(folder / "croissant.json", as_json(_croissant(source, folder, sorted(counts), keys)))


def _card(source: ExportSource, pictures: LabelledPictures, counts: dict[str, int]) -> str:
    """Return the card of the data set, whose head the hub reads."""
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
    """Return the metadata of the layout: a table of each part, and its pictures."""
    objects: list[PlainValue] = []
    records: list[PlainValue] = []
    for part in parts:
        path, table = f"data/{part}/metadata.jsonl", f"{part}-metadata"
        one = {"@type": "cr:FileObject", "@id": table, "name": table, "contentUrl": path}
        objects.append({**one, "encodingFormat": "application/jsonlines", "sha256": digest_of(folder / path)})
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
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": "sonar-frames",
        "description": source.about or source.name,
        "distribution": objects,
        "recordSet": records,
    }
