"""mitsonar: simulate sonar images and impulse responses of Mitsuba 3 scenes, and estimate the vehicle's motion from them.

    import mitsonar
    scene = mitsonar.load_scene("sunken_ship")
    frames = mitsonar.Simulator(scene, mitsonar.load_sonar("didson300")).render([mitsonar.Pose(0, 0, 3)])

Importing mitsonar neither loads Mitsuba nor sets a variant. It registers the plugins (``imaging_sonar``, ``echo`` ...) with
the current Mitsuba variant, or with whichever variant is set later.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

from mitsonar import plugins
from mitsonar.errors import missing_package_error

if TYPE_CHECKING:
    from mitsonar.acoustics.noise import load_noise
    from mitsonar.bridges.gymnasium import SonarEnv, SonarVectorEnv
    from mitsonar.config.data import load_recipe
    from mitsonar.datasets.make import make_dataset
    from mitsonar.datasets.overview import sheet_figure
    from mitsonar.datasets.rendered import RenderedPairs
    from mitsonar.datasets.samples import ImpulsePairs, SonarPairs
    from mitsonar.datasets.store import DataStore
    from mitsonar.errors import MitsonarError, MitsonarWarning
    from mitsonar.estimation.compare import Comparison, ComparisonOptions, compare
    from mitsonar.estimation.crlb.image import cramer_rao_bound
    from mitsonar.estimation.estimator import Estimate
    from mitsonar.estimation.named import create_estimator, load_checkpoint
    from mitsonar.geometry.fan import to_cartesian
    from mitsonar.instruments.hydrophones import ChannelSonar
    from mitsonar.instruments.sonar import Sonar
    from mitsonar.instruments.sounder import Sounder, load_sonar, load_sounder
    from mitsonar.mapping.mosaic import MosaicOptions, build_mosaic, illumination
    from mitsonar.mapping.odometry import OdometryOptions, odometry
    from mitsonar.mapping.sensors import SensorNoise, simulated_sensors
    from mitsonar.mapping.series import path_of
    from mitsonar.mapping.sources import load_frames
    from mitsonar.motion.bodies import Deforming
    from mitsonar.motion.composition import Motion
    from mitsonar.motion.pose import Pose
    from mitsonar.motion.sensors import VehicleSensors, load_sensors, save_sensors
    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.plotting.figures import mosaic_figure, path_figure
    from mitsonar.recordings.first_returns import FirstReturns
    from mitsonar.recordings.open import open_recording, open_side_scan
    from mitsonar.recordings.write_mcap import write_mcap
    from mitsonar.records.frames import SonarFrames
    from mitsonar.records.responses import ImpulseResponses
    from mitsonar.records.soundings import Echogram, Soundings, range_rates
    from mitsonar.reproduction.tables import Effort, load_tables, reproduce
    from mitsonar.simulation.channel import ChannelSimulator
    from mitsonar.simulation.differentiable import DifferentiableSimulator
    from mitsonar.simulation.scene import load_meshes, load_motions, load_scene, shipped_trajectory, sonar_in
    from mitsonar.simulation.simulator import Simulator
    from mitsonar.simulation.sounding import SounderSimulator
    from mitsonar.simulation.vehicle import Mounted, VehicleSimulator, load_vehicle
    from mitsonar.worlds.sea import SeaSurface, fishing_net_mesh, particle_mesh

__all__ = [
    "ChannelSimulator",
    "ChannelSonar",
    "Comparison",
    "ComparisonOptions",
    "DataStore",
    "Deforming",
    "DifferentiableSimulator",
    "Echogram",
    "Effort",
    "Estimate",
    "FirstReturns",
    "ImpulsePairs",
    "ImpulseResponses",
    "MitsonarError",
    "MitsonarWarning",
    "MosaicOptions",
    "Motion",
    "Mounted",
    "OdometryOptions",
    "Pose",
    "RenderedPairs",
    "SeaSurface",
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
    "VehicleSimulator",
    "build_mosaic",
    "compare",
    "cramer_rao_bound",
    "create_estimator",
    "fishing_net_mesh",
    "illumination",
    "load_checkpoint",
    "load_frames",
    "load_meshes",
    "load_motions",
    "load_noise",
    "load_recipe",
    "load_scene",
    "load_sensors",
    "load_sonar",
    "load_sounder",
    "load_tables",
    "load_vehicle",
    "make_dataset",
    "mosaic_figure",
    "odometry",
    "open_recording",
    "open_side_scan",
    "particle_mesh",
    "path_figure",
    "path_of",
    "range_rates",
    "reproduce",
    "save_sensors",
    "sheet_figure",
    "shipped_trajectory",
    "simulated_sensors",
    "sonar_in",
    "to_cartesian",
    "write_mcap",
]

_MODULES = {
    "ChannelSimulator": "simulation.channel",
    "ChannelSonar": "instruments.hydrophones",
    "Comparison": "estimation.compare",
    "ComparisonOptions": "estimation.compare",
    "DataStore": "datasets.store",
    "Deforming": "motion.bodies",
    "DifferentiableSimulator": "simulation.differentiable",
    "Echogram": "records.soundings",
    "Effort": "reproduction.tables",
    "Estimate": "estimation.estimator",
    "FirstReturns": "recordings.first_returns",
    "ImpulsePairs": "datasets.samples",
    "ImpulseResponses": "records.responses",
    "MitsonarError": "errors",
    "MitsonarWarning": "errors",
    "MosaicOptions": "mapping.mosaic",
    "Motion": "motion.composition",
    "Mounted": "simulation.vehicle",
    "OdometryOptions": "mapping.odometry",
    "Pose": "motion.pose",
    "RenderedPairs": "datasets.rendered",
    "SeaSurface": "worlds.sea",
    "SensorNoise": "mapping.sensors",
    "Simulator": "simulation.simulator",
    "Sonar": "instruments.sonar",
    "SonarEnv": "bridges.gymnasium",
    "SonarFrames": "records.frames",
    "SonarPairs": "datasets.samples",
    "SonarVectorEnv": "bridges.gymnasium",
    "Sounder": "instruments.sounder",
    "SounderSimulator": "simulation.sounding",
    "Soundings": "records.soundings",
    "Trajectory": "motion.trajectory",
    "VehicleSensors": "motion.sensors",
    "VehicleSimulator": "simulation.vehicle",
    "build_mosaic": "mapping.mosaic",
    "compare": "estimation.compare",
    "cramer_rao_bound": "estimation.crlb.image",
    "create_estimator": "estimation.named",
    "fishing_net_mesh": "worlds.sea",
    "illumination": "mapping.mosaic",
    "load_checkpoint": "estimation.named",
    "load_frames": "mapping.sources",
    "load_meshes": "simulation.scene",
    "load_motions": "simulation.scene",
    "load_noise": "acoustics.noise",
    "load_recipe": "config.data",
    "load_scene": "simulation.scene",
    "load_sensors": "motion.sensors",
    "load_sonar": "instruments.sounder",
    "load_sounder": "instruments.sounder",
    "load_tables": "reproduction.tables",
    "load_vehicle": "simulation.vehicle",
    "make_dataset": "datasets.make",
    "mosaic_figure": "plotting.figures",
    "odometry": "mapping.odometry",
    "open_recording": "recordings.open",
    "open_side_scan": "recordings.open",
    "particle_mesh": "worlds.sea",
    "path_figure": "plotting.figures",
    "path_of": "mapping.series",
    "range_rates": "records.soundings",
    "reproduce": "reproduction.tables",
    "save_sensors": "motion.sensors",
    "sheet_figure": "datasets.overview",
    "shipped_trajectory": "simulation.scene",
    "simulated_sensors": "mapping.sensors",
    "sonar_in": "simulation.scene",
    "to_cartesian": "geometry.fan",
    "write_mcap": "recordings.write_mcap",
}

plugins.install()


def __getattr__(name: str) -> object:
    if name == "__version__":
        return version("mitsonar")
    if name not in _MODULES:
        raise AttributeError(f"module 'mitsonar' has no attribute {name!r}")
    try:
        attribute: object = getattr(import_module(f"mitsonar.{_MODULES[name]}"), name)
    except ModuleNotFoundError as error:
        raise missing_package_error(error) from None
    return attribute


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__, "__version__"])
