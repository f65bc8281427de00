"""mitsonar: sonar images from Mitsuba 3 scenes, and the motion of the vehicle that saw them.

Importing mitsonar sets no Mitsuba variant and loads no Mitsuba; it only sees to it that the plugins are registered once
a variant is set. Names are loaded when they are first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from mitsonar import plugins

if TYPE_CHECKING:
    from mitsonar.channel_sonar import ChannelSonar
    from mitsonar.dataset.impulse_samples import ImpulseSamples
    from mitsonar.dataset.impulses import ImpulsePairs
    from mitsonar.dataset.pairs import SonarPairs
    from mitsonar.dataset.recipe import Split, load_recipe
    from mitsonar.dataset.rendered import RenderedPairs
    from mitsonar.dataset.store import DataStore
    from mitsonar.errors import MitsonarError, MitsonarWarning
    from mitsonar.frames import SonarFrames
    from mitsonar.motion import Motion, Pose, Trajectory
    from mitsonar.noise import NoiseModel, load_noise
    from mitsonar.presets import PRESETS, load_sonar
    from mitsonar.responses import ImpulseResponses
    from mitsonar.simulation.channel import ChannelSimulator
    from mitsonar.simulation.imaging import Simulator
    from mitsonar.simulation.scenes import load_scene
    from mitsonar.sonar import Sonar

__version__ = "0.1.0"

__all__ = [
    "PRESETS",
    "ChannelSimulator",
    "ChannelSonar",
    "DataStore",
    "ImpulsePairs",
    "ImpulseResponses",
    "ImpulseSamples",
    "MitsonarError",
    "MitsonarWarning",
    "Motion",
    "NoiseModel",
    "Pose",
    "RenderedPairs",
    "Simulator",
    "Sonar",
    "SonarFrames",
    "SonarPairs",
    "Split",
    "Trajectory",
    "load_noise",
    "load_recipe",
    "load_scene",
    "load_sonar",
]

_HOME = {
    "PRESETS": "presets",
    "ChannelSimulator": "simulation.channel",
    "ChannelSonar": "channel_sonar",
    "ImpulseResponses": "responses",
    "DataStore": "dataset.store",
    "ImpulsePairs": "dataset.impulses",
    "ImpulseSamples": "dataset.impulse_samples",
    "MitsonarError": "errors",
    "MitsonarWarning": "errors",
    "Motion": "motion",
    "NoiseModel": "noise",
    "Pose": "motion",
    "RenderedPairs": "dataset.rendered",
    "Simulator": "simulation.imaging",
    "Sonar": "sonar",
    "SonarFrames": "frames",
    "SonarPairs": "dataset.pairs",
    "Split": "dataset.recipe",
    "Trajectory": "motion",
    "load_noise": "noise",
    "load_recipe": "dataset.recipe",
    "load_scene": "simulation.scenes",
    "load_sonar": "presets",
}

plugins.install()


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'mitsonar' has no attribute {name!r}")
    return getattr(import_module(f"mitsonar.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
