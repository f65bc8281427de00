"""``mitsonar doctor``: check the installation and its results."""

from __future__ import annotations

import platform
import time
from importlib.metadata import PackageNotFoundError, version

from mitsonar.cli.console import answered, say, warn
from mitsonar.errors import MitsonarError

__all__ = ["doctor"]

PACKAGES = ("mitsonar", "mitsuba", "drjit", "numpy", "scipy", "OpenEXR", "trimesh", "zarr", "torch")


@answered
def doctor() -> None:
    """Check variant, libraries and versions, render a small scene against its closed form, and time it."""
    from mitsonar.simulation.device import backend

    say(f"python {platform.python_version()}, {platform.system()} {platform.machine()}")
    for package in PACKAGES:
        say(f"  {package:10} {_version(package)}")
    found = backend()
    llvm = "" if found.llvm is None else f", LLVM {'.'.join(map(str, found.llvm))}"
    say(f"variant {found.variant}{llvm}")
    if found.llvm is not None and found.llvm[0] < 17:
        warn(
            f"LLVM {found.llvm[0]} ends the process on some Mitsuba plugins (it cannot compile `max`); mitsonar's own "
            "avoid it; better: sudo apt-get install libllvm19"
        )
    _check_sphere()
    _check_floor()
    say("all is well")


def _check_sphere() -> None:
    """Check that inside a sphere of 10 m every range is 10 m and every cosine 1."""
    import numpy as np

    from mitsonar.instruments.sonar import Sonar
    from mitsonar.plugins.native_plugins import load_dict
    from mitsonar.simulation.simulator import Simulator

    scene = load_dict({"type": "scene", "sphere": {"type": "sphere", "radius": 10.0}})
    echoes = Simulator(scene, Sonar(range_max=12.0)).film_echoes(np.zeros(6), 0)
    error = max(np.abs(echoes.range_m - 10).max(), np.abs(echoes.cosine - 1).max())
    say(f"inside a 10 m sphere: largest error of range (m) and cosine {error:.1e}")
    if not (echoes.hit.all() and error < 1e-5):
        raise MitsonarError(
            f"inside a 10 m sphere range or cosine is off by {error:.1e}, allowed 1e-5: results are wrong on this machine"
        )


def _check_floor() -> None:
    """Check the energy of a flat floor, C H (1 / R^3) integrated over the fan, and measure the rate of rendering."""
    import mitsuba as mi
    import numpy as np

    from mitsonar.instruments.sonar import Sonar
    from mitsonar.plugins.native_plugins import load_dict
    from mitsonar.simulation.simulator import Simulator

    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(100.0)}
    scene = load_dict({"type": "scene", "floor": floor | {"bsdf": {"type": "diffuse", "reflectance": 0.5}}})
    sonar = Sonar(range_min=2.0, range_max=8.0)
    simulator = Simulator(scene, sonar)
    height, pitch = 2.5, np.radians(35)
    poses = np.tile([0, 0, height, pitch, 0, 0], (31, 1))
    levels = next(simulator.pings(poses)).levels
    half = np.radians([sonar.azimuth_fov_deg, sonar.elevation_fov_deg]) / 2
    nodes, weights = np.polynomial.legendre.leggauss(24)
    azimuth, elevation = np.meshgrid(nodes * half[0], nodes * half[1], indexing="ij")
    down = np.cos(elevation) * np.cos(azimuth) * np.sin(pitch) - np.sin(elevation) * np.cos(pitch)
    area = weights[:, None] * weights * half[0] * half[1]
    expected = float((0.5 * down**3 / height**2 * np.cos(elevation) * area).sum())
    error = abs(float(levels[0].sum(dtype=float)) / expected - 1)
    say(f"flat floor: relative error of its energy {error:.1e}")
    start = time.perf_counter()
    for batch in simulator.pings(poses):
        batch.levels.sum()
    rate = len(poses) * sonar.rays / (time.perf_counter() - start)
    say(f"rays traced and binned a second: {rate / 1e6:.1f} million ({rate / sonar.rays:.0f} pings of {sonar.rays:,})")
    if error > 1e-4:
        raise MitsonarError(
            f"the flat floor's energy is off by {error:.1e}, allowed 1e-4: results are wrong on this machine"
        )


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed" + (" (only needed for learning)" if package == "torch" else "")
