"""Layouts of pictures with poses: KITTI's sequences, and the views of neusis."""

from __future__ import annotations

import math
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from mitsonar.exports.export_folder import png
from mitsonar.exports.export_source import ExportSource
from mitsonar.exports.labelled_pictures import LabelledPictures
from mitsonar.exports.shots import as_json, refuse_unposed, shots
from mitsonar.io.files import write_whole
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.motion.trajectory import CONVENTIONS
from mitsonar.records.frames import to_float32

__all__ = ["export_kitti", "export_neusis"]

CAMERA = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""A camera's axes (starboard, down, forward) as columns in (starboard, forward, up)."""


def export_kitti(source: ExportSource, pictures: LabelledPictures, folder: Path) -> Iterator[int]:
    """Write ``poses/00.txt``, ``sequences/00/times.txt`` and ``sequences/00/image_0/``; yield after each frame.

    A line of poses is the first three rows of the matrix from the sonar's axes (x starboard, y down, z forward) to those of
    the first frame of its sequence. Frames of a sequence follow each other.
    """
    refuse_unposed(source)
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
                poses = (folder / "poses" / f"{name}.txt").open("w")
                times = (folder / "sequences" / name / "times.txt").open("w")
                begun = float(np.mean(shot.frames.time_s[shot.index]))
            assert shot.frames.poses is not None
            matrix = np.eye(4)
            matrix[:3, :3] = vehicle_rotation(shot.frames.poses[shot.index]).as_matrix()[0] @ CAMERA
            matrix[:3, 3] = shot.frames.poses[shot.index, :3]
            first = matrix if number == 0 else first
            relative = np.linalg.inv(first) @ matrix
            poses.write(" ".join(f"{value:.12e}" for value in relative[:3].ravel()) + "\n")
            times.write(f"{float(np.mean(shot.frames.time_s[shot.index])) - begun:.9e}\n")
            picture = png(pictures.picture(shot.frames, shot.index))
            write_whole(folder / "sequences" / f"{sequence:02d}" / "image_0" / f"{number:06d}.png", picture)
            number += 1
            yield 1
    finally:
        for file in (poses, times):
            if file is not None:
                file.close()


def export_neusis(source: ExportSource, pictures: LabelledPictures, folder: Path) -> Iterator[int]:
    """Write ``Data/000000.pkl`` ... and ``Config.json``, as neusis' ``load_data`` reads them; yield after each frame.

    A pickle holds ``ImagingSonar``, float32 ``(bins, beams)`` in 0..1, row 0 nearest, column 0 most to *starboard*, and
    ``PoseSensor``, the matrix ``(4, 4)`` from the sonar's axes (x forward, y to port, z up) to the world. In neusis the
    bearing of a pixel grows to port with its column. Pictures are polar in any case.
    """
    refuse_unposed(source)
    (folder / "Data").mkdir()
    for shot in shots(source):
        assert shot.frames.poses is not None
        values = to_float32(shot.frames.image[shot.index])
        state = {"ImagingSonar": values[:, ::-1].copy(), "PoseSensor": port_matrix(shot.frames.poses[shot.index])}
        write_whole(folder / "Data" / f"{shot.name}.pkl", pickle.dumps(state, protocol=4))
        yield 1
    sonar = source.like.sonar
    across = source.like.bearing_rad
    fov = float(np.ptp(across)) * (1 + 1 / max(1, len(across) - 1))
    told = {
        "Azimuth": math.degrees(fov),
        "Elevation": sonar.elevation_fov_deg,
        "RangeMin": sonar.range_min,
        "RangeMax": sonar.range_max,
        "RangeBins": sonar.range_bins,
        "AzimuthBins": len(across),
    }
    agent = {"sensors": [{"sensor_type": "ImagingSonar", "configuration": told}]}
    write_whole(folder / "Config.json", as_json({"name": source.name, "agents": [agent]}))


def port_matrix(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix ``(4, 4)`` from (forward, port, up) to the world of a pose [m, rad]."""
    place, turn = CONVENTIONS["ros-enu"].from_ours(pose[None, :3], vehicle_rotation(pose))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix()[0], place[0]
    return matrix
