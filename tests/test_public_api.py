"""The public names, as one meets them in the first hour: what they print, which names they refer to, how they open files."""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from helpers import diffuse, floor, separate, tiny_recipe

import mitsonar

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")]

CLASSES = [name for name in mitsonar.__all__ if inspect.isclass(getattr(mitsonar, name))]

LONGEST = 300
"""Letters that a public object prints, at most."""

PATH = mitsonar.Trajectory(np.column_stack([np.zeros((5, 2)), np.full((5, 1), 3.0), np.zeros((5, 3))]), np.arange(5) / 10)

SONAR = mitsonar.Sonar(beams=8, range_bins=16, quality="draft", range_min=1)


def _scene() -> Any:
    return separate(floor=floor(diffuse()))


def _pairs(data: Path) -> Any:
    return mitsonar.SonarPairs(data, split="sequence")


def _sounder() -> mitsonar.Sounder:
    return mitsonar.load_sounder("altimeter").replace(model="physical", pattern="box", range_min=1, range_max=8)


def _sounding() -> mitsonar.SounderSimulator:
    return mitsonar.SounderSimulator(_scene(), _sounder())


CHANNEL = mitsonar.ChannelSonar(range_max=8.0)


def _responses(_: Path) -> mitsonar.ImpulseResponses:
    response = np.zeros((5, len(CHANNEL.receivers), CHANNEL.taps), np.complex64)
    return mitsonar.ImpulseResponses(response, PATH.time_s, CHANNEL, PATH.poses)


MADE: dict[str, Callable[[Path], Any]] = {
    "ChannelSimulator": lambda _: mitsonar.ChannelSimulator(separate(floor=floor(diffuse(), 2)), CHANNEL),
    "ChannelSonar": lambda _: CHANNEL,
    "ComparisonOptions": lambda _: mitsonar.ComparisonOptions(),
    "DataStore": lambda data: mitsonar.DataStore.open(data),
    "Deforming": lambda _: mitsonar.Deforming(PATH, lambda _time: np.zeros((3, 3), np.float32)),
    "DifferentiableSimulator": lambda _: mitsonar.DifferentiableSimulator(_scene(), SONAR),
    "Echogram": lambda _: _sounding().echogram(PATH),
    "Effort": lambda _: mitsonar.Effort(),
    "Estimate": lambda _: mitsonar.Estimate(mitsonar.Motion(0.1, 0.2, 0.03), np.eye(3)),
    "FirstReturns": lambda _: mitsonar.FirstReturns(),
    "ImpulseResponses": _responses,
    "MosaicOptions": lambda _: mitsonar.MosaicOptions(),
    "Motion": lambda _: mitsonar.Motion(*np.array([0.1, 0.2, 0.3]) / 3),
    "Mounted": lambda _: mitsonar.Mounted(SONAR, mitsonar.Pose(*np.ones(6) / 3)),
    "OdometryOptions": lambda _: mitsonar.OdometryOptions(),
    "Pose": lambda _: mitsonar.Pose(*np.ones(6) / 3),
    "RenderedPairs": lambda _: mitsonar.RenderedPairs(tiny_recipe(), seed=1),
    "SeaSurface": lambda _: mitsonar.SeaSurface(),
    "SensorNoise": lambda _: mitsonar.SensorNoise(0.1, 1.0, 0.01, 0.02, 1.0, (0.1, 1.0)),
    "Simulator": lambda _: mitsonar.Simulator(_scene(), SONAR),
    "Sonar": lambda _: mitsonar.load_sonar("didson300"),
    "SonarEnv": lambda _: mitsonar.SonarEnv(_scene(), SONAR, start=PATH.poses[0], gain=1.0),
    "SonarFrames": lambda _: mitsonar.Simulator(_scene(), SONAR).render(PATH, labels=True),
    "SonarPairs": _pairs,
    "SonarVectorEnv": lambda _: mitsonar.SonarVectorEnv(_scene(), SONAR, 2, start=PATH.poses[0], gain=1.0),
    "Sounder": lambda _: mitsonar.load_sounder("dvl"),
    "SounderSimulator": lambda _: _sounding(),
    "Soundings": lambda _: _sounding().soundings(PATH),
    "Trajectory": lambda _: PATH,
    "VehicleSensors": lambda _: mitsonar.simulated_sensors(PATH, mitsonar.SensorNoise(gyro_deg_rth=0.1, depth_m=0.1)),
    "VehicleSimulator": lambda _: mitsonar.VehicleSimulator(_scene(), {"front": mitsonar.Mounted(SONAR)}),
}
"""An object of each public class that has one; a path holds a data set."""

MESSAGES = {"MitsonarError", "MitsonarWarning"}
ELSEWHERE = {"Comparison", "ImpulsePairs"}
"""Classes whose objects print only their message, and those that other tests print: a comparison prints its table."""


def test_every_public_class_is_printed_by_a_test() -> None:
    assert set(CLASSES) == set(MADE) | MESSAGES | ELSEWHERE


@pytest.mark.parametrize("name", MADE)
def test_public_objects_print_a_few_lines_that_name_them(name: str, tiny_data: Path) -> None:
    result = MADE[name](tiny_data)
    for shown in (str(result), repr(result)):
        assert shown.startswith(name), shown
        assert len(shown) < LONGEST + len(str(tiny_data)), shown
        assert "np.float" not in shown
        assert "object at 0x" not in shown
        assert shown.count("\n") < 3


def test_frames_print_what_one_wants_to_know() -> None:
    frames = MADE["SonarFrames"](Path())
    for word in ("5 frames", "16 bins x 8 beams", "level linear", "sonar custom", "poses", "float32"):
        assert word in str(frames)
    assert str(frames.select(slice(0, 0))).startswith("SonarFrames(0 frames")


# ---------------------------------------------------------------- opening files


class Opened(NamedTuple):
    """How a public name opens a path, and the ending of its files."""

    read: Callable[[Path], Any]
    ending: str


OPENERS = {
    "load_frames": Opened(mitsonar.load_frames, ".npz"),
    "SonarFrames.load": Opened(mitsonar.SonarFrames.load, ".npz"),
    "ImpulseResponses.load": Opened(mitsonar.ImpulseResponses.load, ".npz"),
    "Echogram.load": Opened(mitsonar.Echogram.load, ".npz"),
    "Soundings.load": Opened(mitsonar.Soundings.load, ".npz"),
    "Trajectory.load": Opened(mitsonar.Trajectory.load, ".csv"),
    "Trajectory.load_tum": Opened(mitsonar.Trajectory.load_tum, ".tum"),
    "DataStore.open": Opened(mitsonar.DataStore.open, ".zarr"),
    "open_recording": Opened(mitsonar.open_recording, ".aris"),
    "open_side_scan": Opened(mitsonar.open_side_scan, ".xtf"),
    "load_scene": Opened(mitsonar.load_scene, ".xml"),
    "load_sonar": Opened(mitsonar.load_sonar, ".yaml"),
    "load_sounder": Opened(mitsonar.load_sounder, ".yaml"),
    "load_vehicle": Opened(mitsonar.load_vehicle, ".yaml"),
    "load_motions": Opened(mitsonar.load_motions, ".yaml"),
    "load_meshes": Opened(lambda path: mitsonar.load_meshes([path], 10.0), ".ply"),
    "load_noise": Opened(lambda path: mitsonar.load_noise(str(path)), ".yaml"),
    "load_recipe": Opened(mitsonar.load_recipe, ".yaml"),
    "load_sensors": Opened(mitsonar.load_sensors, ".csv"),
    "load_checkpoint": Opened(mitsonar.load_checkpoint, ".ckpt"),
}
"""All public names that open files."""

FOREIGN = ("Traceback", "Errno", "zip file", "codec", "LocalStore", "newline mode", "pickle")
"""Words of other libraries, which help no user."""


def missing(folder: Path, ending: str) -> Path:
    return folder / f"missing{ending}"


def empty(folder: Path, ending: str) -> Path:
    (path := folder / f"empty{ending}").touch()
    return path


def another_kind(folder: Path, ending: str) -> Path:
    (path := folder / f"other{ending}").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 20)
    return path


def a_folder(folder: Path, ending: str) -> Path:
    (path := folder / "folder").mkdir()
    return path


def a_folder_so_named(folder: Path, ending: str) -> Path:
    (path := folder / f"folder{ending}").mkdir()
    return path


@pytest.mark.parametrize("wrong", [missing, empty, another_kind, a_folder, a_folder_so_named])
@pytest.mark.parametrize("name", OPENERS)
def test_a_wrong_path_is_one_sentence(name: str, wrong: Callable[[Path, str], Path], tmp_path: Path) -> None:
    path = wrong(tmp_path, OPENERS[name].ending)
    with pytest.raises(mitsonar.MitsonarError) as result:
        OPENERS[name].read(path)
    output = str(result.value)
    assert path.name in output
    assert "\n" not in output
    assert len(output) < 900
    assert not [word for word in FOREIGN if word in output], output


def test_every_public_name_that_opens_files_is_tried() -> None:
    """By their names: load_..., open_..., and the methods load and open of classes.

    What saves also loads; but for a sea surface, which saves a scene.
    """
    public = {name for name in mitsonar.__all__ if name.startswith(("load_", "open_"))} - {"load_tables"}  # shipped ones
    for name in CLASSES:
        local = vars(getattr(mitsonar, name))
        public |= {f"{name}.{method}" for method in local if method == "open" or method.split("_")[0] == "load"}
        assert "load" in local or "save" not in local or name == "SeaSurface", f"{name}.save has no load"
    assert public == set(OPENERS)


def test_meshes_are_a_list() -> None:
    mistakes: tuple[Any, ...] = ([], "fish.ply")
    for wrong in mistakes:
        with pytest.raises(mitsonar.MitsonarError, match="in the order of time"):
            mitsonar.load_meshes(wrong, 10.0)


# ---------------------------------------------------------------- names in docstrings

ROLE = re.compile(r":(?:func|class|meth|mod|data|attr|exc|const):`(!?)(~?)([^`]+)`")


def docstrings() -> Iterator[tuple[str, Any, str]]:
    """Every docstring of the public names: its name, the object that holds what it calls by bare names, the text."""
    for name in mitsonar.__all__:
        public = getattr(mitsonar, name)
        yield name, public, inspect.getdoc(public) or ""
        if inspect.isclass(public):
            for method, value in list(vars(public).items()):
                documented = isinstance(value, classmethod | staticmethod | property) or inspect.isfunction(value)
                if documented and not method.startswith("_"):
                    yield f"{name}.{method}", public, inspect.getdoc(value) or ""


def reached(target: str, holder: Any) -> bool:
    """Whether a name leads somewhere: from the class itself, from mitsonar, or by its whole path through modules."""
    module = sys.modules[holder.__module__]
    for start in (holder, module, mitsonar):
        if _has(start, target.split(".")):
            return True
    parts = target.split(".")
    for count in range(len(parts), 0, -1):
        try:
            result = importlib.import_module(".".join(parts[:count]))
        except ImportError:
            continue
        return _has(result, parts[count:])
    return False


def _has(start: Any, names: Iterable[str]) -> bool:
    for name in names:
        fields = (
            {*getattr(start, "__annotations__", {}), *getattr(start, "model_fields", {})} if inspect.isclass(start) else ()
        )
        documented = inspect.isclass(start) and re.search(rf"^\s*{name}:|, {name}:", start.__doc__ or "", flags=re.MULTILINE)
        if name in fields or documented:
            return True
        if not hasattr(start, name):
            return False
        start = getattr(start, name)
    return True


def open_to_readers(target: str, holder: Any) -> bool:
    """Whether a reader of the reference finds a name by itself: public, a part of the same class, or with its whole path."""
    first = target.split(".")[0]
    return first == "mitsonar" or target in mitsonar.__all__ or first in mitsonar.__all__ or _has(holder, [first])


def test_names_that_docstrings_refer_to_lead_somewhere() -> None:
    """A role (:func:, :class: ...) names what is public, a part of the same class, or a whole path that exists."""
    lost = []
    for name, holder, text in docstrings():
        for _, _, target in ROLE.findall(text):
            if not (reached(target, holder) and open_to_readers(target, holder)):
                lost.append(f"{name}: {target}")
    assert not lost, "\n".join(lost)


NAMED = re.compile(r"``(?:([A-Z][a-z]+[A-Z]\w*)(?:\.\w+)*|(mitsonar\.[\w.]+)|([A-Za-z_][\w.]*)\(.*?)``")
"""In double backticks: ClassNames, mitsonar.names, and calls."""

OTHERS = {"torch", "gymnasium", "mi", "np", "dr", "DataLoader", "NextStep", "estimate"}
"""What is of other libraries, or of classes that users write."""


def test_names_in_backticks_of_docstrings_lead_somewhere() -> None:
    lost = []
    for name, holder, text in docstrings():
        for target in (next(filter(None, result)) for result in NAMED.findall(text)):
            local = target.removeprefix("mitsonar.")
            if local.split(".")[0] not in OTHERS and not (_has(holder, local.split(".")) or reached(local, holder)):
                lost.append(f"{name}: {target}")
    assert not lost, "\n".join(lost)
