"""Views as neusis and other acoustic radiance fields store them: a pickle a view, and a JSON file of the sonar.

Source of the layout: github.com/rpl-cmu/neusis (``load_data.py``, ``helpers.py``), whose views HoloOcean made.

| file | content |
|---|---|
| ``Data/*.pkl`` | a table with ``ImagingSonar`` (bins x beams) and ``PoseSensor`` (4 x 4, sensor to world) |
| ``Config.json`` | of a sensor ``ImagingSonar``: ``Azimuth``, ``Elevation`` [deg], ``RangeMin``, ``RangeMax`` [m] |

Row 0 is the nearest range. Column 0 has the bearing -Azimuth / 2 about the sensor's third axis. That axis is up, and the
first one forward, so column 0 is the one most to starboard. Views have no times: they follow one another by name, ten a
second. Levels are taken as linear; where a value exceeds 1, all are divided by the largest one.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError, argument
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.files import FileArray, PlainValue, finite_number, read_json
from mitsonar.motion.pose import poses_from
from mitsonar.recordings.picture_folder import naturally
from mitsonar.recordings.recording import Facts, Part, Pixels, Recording
from mitsonar.recordings.safe_pickle import read_pickled_arrays
from mitsonar.records.frames import SonarFrames

__all__ = ["is_neusis", "read_neusis"]

Array = NDArray[np.float64]

IMAGE, POSE = "ImagingSonar", "PoseSensor"

RATE_HZ = 10.0
"""Views a second: they have no times."""

SHAPE_LIMIT = 2**25
"""Cells of a view, at most."""

FORWARD_PORT_UP = Rotation.from_matrix([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
"""Starboard, forward and up in the sensor's axes, as columns."""

ORTHOGONAL = 1e-3
"""Largest error of a rotation matrix."""


def is_neusis(path: Path, first: bytes) -> bool:
    """Return whether a path is a folder of views with their configuration."""
    return not first and (path / "Config.json").is_file() and (path / "Data").is_dir()


def read_neusis(path: Path) -> Recording:
    """Open a folder of views. Each is read once for its pose and largest value, and again when it is asked for.

    Raises:
        MitsonarError: no configuration, no view that can be read, views of several sizes, or a pose that is none.
    """
    setting = _setting(path / "Config.json")
    files = sorted((path / "Data").glob("*.pkl"), key=lambda one: naturally(one.name))
    if not files:
        raise MitsonarError(f"{path / 'Data'} holds no .pkl file")
    shape, largest, matrices = None, 0.0, []
    for file in files:
        image, matrix = _view(file)
        if shape is not None and image.shape != shape:
            raise MitsonarError(f"{file} has {image.shape} cells, the others {shape}: remove it")
        shape = image.shape
        largest = max(largest, float(image.max()))
        matrices.append(matrix)
    assert shape is not None  # there is a file
    poses = np.array(matrices)
    rotation = Rotation.from_matrix(poses[:, :3, :3])
    sonar = Sonar.create(
        name="imaging-sonar",
        azimuth_fov_deg=setting["Azimuth"],
        elevation_fov_deg=setting["Elevation"],
        range_min=setting["RangeMin"],
        range_max=setting["RangeMax"],
        beams=shape[1],
        range_bins=shape[0],
        frame_rate_hz=RATE_HZ,
    )
    part = Part(
        SonarFrames(np.zeros((0, *shape), np.float32), sonar.range_m, sonar.bearing_rad, np.zeros(0), sonar),
        np.arange(len(files)) / RATE_HZ,
        _Views(tuple(files), (shape[0], shape[1]), max(1.0, largest)),
        poses=poses_from(poses[:, :3, 3], rotation * FORWARD_PORT_UP),
    )
    facts: Facts = {"views": len(files), "largest_value": largest}
    notes = ["views have no times: they follow one another by name, ten a second"]
    if largest > 1:
        notes.append(f"values reach {largest:.4g}: they are divided by it")
    return Recording(str(path), "views (neusis)", (part,), facts, tuple(notes))


@dataclass(frozen=True)
class _Views:
    """Views as images."""

    files: tuple[Path, ...]
    shape: tuple[int, int]
    largest: float

    def __call__(self, index: NDArray[np.intp]) -> Pixels:
        """Return ``(n, bins, beams)`` float32 in 0..1, column 0 most to port."""
        images = np.zeros((len(index), *self.shape), np.float32)
        for place, number in enumerate(index):
            image, _ = _view(self.files[number])
            if image.shape != self.shape:
                raise MitsonarError(f"{self.files[number]} has changed while it was read")
            images[place] = np.clip(image[:, ::-1] / self.largest, 0, 1)
        return images


def _view(path: Path) -> tuple[FileArray, Array]:
    """Return the image ``(bins, beams)`` and the pose ``(4, 4)`` of a view."""
    table = read_pickled_arrays(path)
    missing = [name for name in (IMAGE, POSE) if name not in table]
    if missing:
        raise MitsonarError(f"{path} lacks {' and '.join(missing)}: it is no view of a sonar")
    image, matrix = table[IMAGE], np.asarray(table[POSE], dtype=float)
    if (
        image.ndim != 2
        or min(image.shape) < 2
        or image.size > SHAPE_LIMIT
        or not np.isfinite(image).all()
        or image.min() < 0
    ):
        raise MitsonarError(f"{IMAGE} of {path} must be an image (bins, beams) of finite values from 0: got {image.shape}")
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or np.abs(matrix[:3, 3]).max() > 1e6:
        raise MitsonarError(f"{POSE} of {path} must be a matrix (4, 4) of finite numbers: got shape {matrix.shape}")
    turn = matrix[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > ORTHOGONAL or np.linalg.det(turn) < 0:
        raise MitsonarError(f"{POSE} of {path} holds no rotation: its columns must be unit vectors, at right angles")
    return image, matrix


def _setting(path: Path) -> dict[str, float]:
    """Return field of view [deg] and window [m] of the imaging sonar in a configuration of HoloOcean."""
    table = read_json(path)
    agents = table.get("agents")
    first: PlainValue = agents[0] if isinstance(agents, list) and agents and isinstance(agents[0], dict) else {}
    sensors = first.get("sensors")
    for sensor in sensors if isinstance(sensors, list) else []:
        if isinstance(sensor, dict) and sensor.get("sensor_type") == IMAGE and isinstance(sensor.get("configuration"), dict):
            values = sensor["configuration"]
            keys = ("Azimuth", "Elevation", "RangeMin", "RangeMax")
            return {key: finite_number(values.get(key), argument(f"{key} of {path}"), -1, 1e5) for key in keys}
    raise MitsonarError(f"{path} holds no sensor of type {IMAGE} with a configuration: give a Config.json of HoloOcean")
