"""The public names, as one meets them in the first hour: what they print, which names they refer to, how they open files."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

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
    "DataStore": lambda data: mitsonar.DataStore.open(data),
    "Deforming": lambda _: mitsonar.Deforming(PATH, lambda _time: np.zeros((3, 3), np.float32)),
    "Echogram": lambda _: _sounding().echogram(PATH),
    "Estimate": lambda _: mitsonar.Estimate(mitsonar.Motion(0.1, 0.2, 0.03), np.eye(3)),
    "ImpulseResponses": _responses,
    "Motion": lambda _: mitsonar.Motion(*np.array([0.1, 0.2, 0.3]) / 3),
    "Mounted": lambda _: mitsonar.Mounted(SONAR, mitsonar.Pose(*np.ones(6) / 3)),
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
ELSEWHERE = {"ImpulsePairs"}
"""Classes whose objects print only their message, and those that another test prints."""


def test_every_public_class_is_printed_by_a_test() -> None:
    assert set(CLASSES) == set(MADE) | MESSAGES | ELSEWHERE


@pytest.mark.parametrize("name", MADE)
def test_public_objects_print_a_few_lines_that_name_them(name: str, tiny_data: Path) -> None:
    made = MADE[name](tiny_data)
    for shown in (str(made), repr(made)):
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
