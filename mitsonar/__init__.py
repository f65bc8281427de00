"""mitsonar: sonar images and impulse responses from Mitsuba 3 scenes, and the motion of the vehicle that received them.

    import mitsonar
    scene = mitsonar.load_scene("sunken_ship")
    frames = mitsonar.Simulator(scene, mitsonar.load_sonar("didson300")).render([mitsonar.Pose(0, 0, 3)])

Importing mitsonar loads no Mitsuba and sets no variant. It registers the plugins (``imaging_sonar``, ``echo`` ...) for the
variant that is set, now or later.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

from mitsonar import plugins
from mitsonar.errors import explain_missing

if TYPE_CHECKING:
    from mitsonar.acoustics.noise import load_noise
    from mitsonar.config.data_recipe import load_recipe
    from mitsonar.datasets.generation import make_dataset
    from mitsonar.datasets.rendered_pairs import RenderedPairs
    from mitsonar.datasets.response_pairs import ImpulsePairs
    from mitsonar.datasets.store import DataStore
    from mitsonar.datasets.torch_pairs import SonarPairs
    from mitsonar.environments.sonar_env import SonarEnv
    from mitsonar.environments.sonar_vector_env import SonarVectorEnv
    from mitsonar.errors import MitsonarError, MitsonarWarning
    from mitsonar.estimation.crlb.image_crlb import cramer_rao_bound
    from mitsonar.estimation.estimator import Estimate
    from mitsonar.estimation.named_estimators import create_estimator, load_checkpoint
    from mitsonar.instruments.channel_sonar import ChannelSonar
    from mitsonar.instruments.imaging_sonar import Sonar
    from mitsonar.instruments.named_sonars import load_sonar
    from mitsonar.instruments.named_sounders import load_sounder
    from mitsonar.instruments.sounder import Sounder
    from mitsonar.mapping.mosaic import build_mosaic
    from mitsonar.mapping.odometry import odometry
    from mitsonar.mapping.open_frames import load_frames
    from mitsonar.mapping.sensor_files import load_sensors, save_sensors
    from mitsonar.mapping.simulated_sensors import SensorNoise, simulated_sensors
    from mitsonar.mapping.vehicle_sensors import VehicleSensors
    from mitsonar.motion.composition import Motion
    from mitsonar.motion.pose import Pose
    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.recordings.mcap_writer import write_mcap
    from mitsonar.recordings.open_recording import open_recording
    from mitsonar.records.echogram import Echogram
    from mitsonar.records.impulse_responses import ImpulseResponses
    from mitsonar.records.sonar_frames import SonarFrames
    from mitsonar.records.soundings import Soundings
    from mitsonar.simulation.channel import ChannelSimulator
    from mitsonar.simulation.imaging import Simulator
    from mitsonar.simulation.scene import load_scene
    from mitsonar.simulation.sounding import SounderSimulator

__all__ = [
    "ChannelSimulator",
    "ChannelSonar",
    "DataStore",
    "Echogram",
    "Estimate",
    "ImpulsePairs",
    "ImpulseResponses",
    "MitsonarError",
    "MitsonarWarning",
    "Motion",
    "Pose",
    "RenderedPairs",
    "SensorNoise",
    "Simulator",
    "Sonar",
    "SonarEnv",
    "SonarFrames",
    "SonarPairs",
    "SonarVectorEnv",
    "Sounder",
    "SounderSimulator",
    "Soundings",
    "Trajectory",
    "VehicleSensors",
    "build_mosaic",
    "cramer_rao_bound",
    "create_estimator",
    "load_checkpoint",
    "load_frames",
    "load_noise",
    "load_recipe",
    "load_scene",
    "load_sensors",
    "load_sonar",
    "load_sounder",
    "make_dataset",
    "odometry",
    "open_recording",
    "save_sensors",
    "simulated_sensors",
    "write_mcap",
]

_MODULES = {
    "ChannelSimulator": "simulation.channel",
    "ChannelSonar": "instruments.channel_sonar",
    "DataStore": "datasets.store",
    "Echogram": "records.echogram",
    "Estimate": "estimation.estimator",
    "ImpulsePairs": "datasets.response_pairs",
    "ImpulseResponses": "records.impulse_responses",
    "MitsonarError": "errors",
    "MitsonarWarning": "errors",
    "Motion": "motion.composition",
    "Pose": "motion.pose",
    "RenderedPairs": "datasets.rendered_pairs",
    "SensorNoise": "mapping.simulated_sensors",
    "Simulator": "simulation.imaging",
    "Sonar": "instruments.imaging_sonar",
    "SonarEnv": "environments.sonar_env",
    "SonarVectorEnv": "environments.sonar_vector_env",
    "SonarFrames": "records.sonar_frames",
    "SonarPairs": "datasets.torch_pairs",
    "Sounder": "instruments.sounder",
    "SounderSimulator": "simulation.sounding",
    "Soundings": "records.soundings",
    "Trajectory": "motion.trajectory",
    "VehicleSensors": "mapping.vehicle_sensors",
    "build_mosaic": "mapping.mosaic",
    "cramer_rao_bound": "estimation.crlb.image_crlb",
    "create_estimator": "estimation.named_estimators",
    "load_checkpoint": "estimation.named_estimators",
    "load_frames": "mapping.open_frames",
    "load_noise": "acoustics.noise",
    "load_recipe": "config.data_recipe",
    "load_scene": "simulation.scene",
    "load_sensors": "mapping.sensor_files",
    "load_sonar": "instruments.named_sonars",
    "load_sounder": "instruments.named_sounders",
    "make_dataset": "datasets.generation",
    "odometry": "mapping.odometry",
    "save_sensors": "mapping.sensor_files",
    "simulated_sensors": "mapping.simulated_sensors",
    "open_recording": "recordings.open_recording",
    "write_mcap": "recordings.mcap_writer",
}

plugins.install()


def __getattr__(name: str) -> object:
    if name == "__version__":
        return version("mitsonar")
    if name not in _MODULES:
        raise AttributeError(f"module 'mitsonar' has no attribute {name!r}")
    try:
        found: object = getattr(import_module(f"mitsonar.{_MODULES[name]}"), name)
    except ModuleNotFoundError as error:
        raise explain_missing(error) from None
    return found


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__, "__version__"])
