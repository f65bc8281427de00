"""How labelled frames are opened to be shown, and which regions of theirs are outlined."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mitsonar.bridges.export_source import LabelledPictures
from mitsonar.bridges.join_data import part_of, require_single_view, shape_names_by_scene
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError
from mitsonar.mapping.sources import is_data_set, recording_at, sequence_in
from mitsonar.plotting.outlines import LabelledRegions, Outlines
from mitsonar.recordings.recording import Recording
from mitsonar.records.frames import SonarFrames

__all__ = ["labelled_recording", "outlines_of"]


def labelled_recording(where: str) -> Recording:
    """Open frames with their labels as a recording; of a data set, the longest sequence.

    Raises:
        MitsonarError: there are no frames, or no ``shape_id``.
    """
    if is_data_set(where):
        store = DataStore.open(where)
        require_single_view(store)
        span, _, which = sequence_in(store)
        scene = int(store.read("scene", span)[0])
        part = part_of(store, span, shape_names_by_scene(store).get(scene, ()))
        recording = Recording(str(where), "data set of mitsonar", (part,), {}, (which,))
    else:
        recording = recording_at(where)
    none = recording.part().read(np.zeros(0, dtype=np.intp))
    if none.shape_id is None:
        raise MitsonarError(
            f"{where} has no label shape_id: render with --labels, or give the recipe `labels: [shape_id, object_id]`"
        )
    return recording


def outlines_of(like: SonarFrames, classes: Sequence[tuple[str, str]] = ()) -> Outlines:
    """Return the outlines of the objects that an export with these classes boxes, of any size and level.

    Args:
        like: frames whose shapes are named, possibly none.
        classes: globs of shape names, each with a class; see :class:`~mitsonar.bridges.export_source.LabelledPictures`.

    Raises:
        MitsonarError: a glob matches no shape, or no class is left.
    """
    pictures = LabelledPictures(like, "polar", classes, least_snr_db=-np.inf)

    def regions(frames: SonarFrames, index: int) -> LabelledRegions:
        visible = pictures.regions(frames, index)
        number = np.zeros(frames.image.shape[1:], dtype=np.int32)
        for place, region in enumerate(visible, start=1):
            number[region.mask] = place
        return LabelledRegions(number, np.array([0, *(region.kind for region in visible)], dtype=np.intp))

    return Outlines(pictures.classes, regions)
