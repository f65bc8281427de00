"""The layouts by name, and an export from beginning to end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.exports.detection_exports import export_coco, export_yolo
from mitsonar.exports.export_folder import new_folder
from mitsonar.exports.export_source import ExportSource
from mitsonar.exports.hugging_face_export import export_hugging_face
from mitsonar.exports.labelled_pictures import LEAST_SNR_DB, LabelledPictures, PictureKind
from mitsonar.exports.pose_exports import export_kitti, export_neusis
from mitsonar.exports.webdataset_export import export_webdataset

__all__ = ["EXPORTS", "export_to"]

Exporter = Callable[[ExportSource, LabelledPictures, Path], Iterator[int]]

EXPORTS: dict[str, Exporter] = {
    "coco": export_coco,
    "yolo": export_yolo,
    "webdataset": export_webdataset,
    "huggingface": export_hugging_face,
    "kitti": export_kitti,
    "neusis": export_neusis,
}
"""What writes each layout; it yields how many more frames are done."""


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
    """Write frames in a layout of another tool; the folder is whole or absent, and a few frames at a time are in memory.

    Args:
        layout: a name of :data:`EXPORTS`.
        source: of the frames.
        out: folder to make.
        picture: ``polar`` or ``fan``.
        classes: globs of names of shapes with their classes; see
            :class:`~mitsonar.exports.labelled_pictures.LabelledPictures`.
        least: pixels of a region, at least.
        least_snr_db: signal-to-noise ratio of a region, at least [dB].
        polygons: outlines in place of boxes; of YOLO.
        every_class: refuse classes that no picture of the training part shows.
        progress: is called with how many more frames are done.

    Returns:
        What made the pictures, which has counted the regions of COCO and YOLO.

    Raises:
        MitsonarError: an unknown layout, a folder that is there, frames that lack what the layout needs, COCO or YOLO
            without any object.
    """
    if layout not in EXPORTS:
        raise MitsonarError(f"unknown layout {layout!r}: {nearest_names(layout, EXPORTS)}")
    if polygons and layout != "yolo":
        raise MitsonarError(f"--polygons is of the layout yolo: got {layout}; COCO has masks in any case")
    if layout == "neusis" and picture != "polar":
        raise MitsonarError("the layout neusis has polar pictures only: leave --picture out")
    exporter = partial(export_yolo, polygons=True) if polygons else EXPORTS[layout]
    pictures = LabelledPictures(source.like, picture, classes, least, least_snr_db)
    with new_folder(out) as folder:
        for done in exporter(source, pictures, folder):
            progress(done)
        missing = [name for name in pictures.classes if every_class and not pictures.boxes["train", name]]
        if missing:
            raise MitsonarError(
                f"the class {missing[0]} is in no picture of the training part: make more frames, nearer to it, lower "
                f"--least-snr-db or --least, or leave it out with --classes {missing[0]}="
            )
    return pictures
