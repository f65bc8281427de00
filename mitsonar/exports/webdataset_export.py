"""WebDataset: tar files of samples, each a picture, its metadata and its label pictures."""

from __future__ import annotations

import contextlib
import io
import tarfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mitsonar.exports.export_folder import json_line, png
from mitsonar.exports.export_source import ExportSource
from mitsonar.exports.labelled_pictures import LabelledPictures
from mitsonar.exports.shots import as_json, pose_of, regions_of, shots
from mitsonar.io.files import write_whole

__all__ = ["export_webdataset"]

OF_SHARD = 1000
"""Samples of a shard."""


def export_webdataset(source: ExportSource, pictures: LabelledPictures, folder: Path) -> Iterator[int]:
    """Write ``PART-000000.tar`` ... and ``about.json``; yield after each frame.

    A sample has ``png``, ``json`` (time, pose, sequence, regions), and where there are labels ``shape.png`` and
    ``object.png``: the label plus one, 16 bit, 0 for no echo.
    """
    counts: dict[str, int] = {}
    with contextlib.ExitStack() as ends:
        files: dict[str, tarfile.TarFile] = {}
        for shot in shots(source):
            number = counts.get(shot.part, 0)
            if number % OF_SHARD == 0:
                if shot.part in files:
                    files[shot.part].close()
                path = folder / f"{shot.part}-{number // OF_SHARD:06d}.tar"
                files[shot.part] = ends.enter_context(tarfile.open(path, "w", format=tarfile.USTAR_FORMAT))
            counts[shot.part] = number + 1
            about = {"sequence": int(source.sequence[shot.number]), **pose_of(shot)}
            parts = {"png": png(pictures.picture(shot.frames, shot.index))}
            for name in ("shape", "object"):
                if f"{name}_id" in source.labels:
                    label = pictures.label(shot.frames, f"{name}_id", shot.index) + 1
                    parts[f"{name}.png"] = png(np.clip(label, 0, 65535).astype(np.uint16))
            parts["json"] = json_line({**about, "regions": regions_of(shot, pictures, source)}).encode()
            for ending, content in parts.items():
                entry = tarfile.TarInfo(f"{shot.name}.{ending}")
                entry.size = len(content)
                files[shot.part].addfile(entry, io.BytesIO(content))
            yield 1
    names = {"shapes": list(source.like.shape_names), "objects": list(source.like.object_names)}
    told = {"source": source.name, "about": source.about, "picture": pictures.picture_kind, "samples": counts, **names}
    write_whole(folder / "about.json", as_json(told))
