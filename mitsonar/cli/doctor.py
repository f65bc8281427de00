"""Commands ``mitsonar doctor``, ``presets`` and ``scenes``: check the installation, list what can be named."""

from __future__ import annotations

import math
import platform
import time
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Annotated

import typer

from mitsonar.cli.console import answered, say, warn
from mitsonar.errors import MitsonarError, short_repr, suggest_names

if TYPE_CHECKING:
    from mitsonar.instruments.sonar import Sonar
    from mitsonar.io.checked_model import Preset

__all__ = ["doctor", "materials", "presets", "scenes"]


PACKAGES = ("mitsonar", "mitsuba", "drjit", "numpy", "scipy", "OpenEXR", "trimesh", "zarr", "torch")


@answered
def doctor() -> None:
    """Check variant, libraries and versions, compare small scenes with closed forms, and measure the speed."""
    from mitsonar.simulation.device import backend, install_hint

    say(f"python {platform.python_version()}, {platform.system()} {platform.machine()}")
    for package in PACKAGES:
        say(f"  {package:10} {_version(package)}")
    device = backend()
    llvm = "" if device.llvm is None else f", LLVM {'.'.join(map(str, device.llvm))}"
    say(f"variant {device.variant}{llvm}")
    if device.llvm is not None and device.llvm[0] < 17:
        warn(
            f"LLVM {device.llvm[0]} ends the process on some Mitsuba plugins (it cannot compile `max`); mitsonar's own "
            f"avoid it; better: {install_hint()}"
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


# ---------------- ``mitsonar presets``, ``mitsonar materials`` and ``mitsonar scenes``: what can be named


@answered
def presets(
    name: Annotated[str | None, typer.Argument(help="Print every number of this preset with its source.")] = None,
) -> None:
    """List the presets of sonars and instruments, or print one with the source of each number."""
    from mitsonar.instruments.sounder import named_sonars, preset

    if name is not None:
        return _one(name)
    say(f"{'preset':22} {'az x el (deg)':14} {'beams':>5} {'width':>6}  {'window (m)':12} {'bins':>5}  instrument")
    for key, (title, *_) in named_sonars().items():
        sonar = preset(key)
        width = f"{math.degrees(sonar.beam_width_rad):.3g}"
        field = f"{sonar.azimuth_fov_deg:g} x {sonar.elevation_fov_deg:g}"
        window = f"{sonar.range_min:g}..{sonar.range_max:g}"
        say(f"{key:22} {field:14} {sonar.beams:5} {width:>6}  {window:12} {sonar.range_bins:5}  {title}")
    for line in [*_instruments(), *_accuracy(list(named_sonars()))]:
        say(line)
    say("`mitsonar presets NAME` prints where each number comes from; docs/guides/sonars.md explains how to write one.")


def _one(name: str) -> None:
    """Print a preset: each number with its source.

    Raises:
        MitsonarError: neither a sonar nor an instrument, with the nearest names.
    """
    from mitsonar.instruments.sounder import DEFAULT_PRESETS, load_sounder, named_sonars, named_sounders, preset

    sonars, sounders = named_sonars(), named_sounders()
    key = DEFAULT_PRESETS.get(name, name)
    if key not in sonars and key not in sounders:
        raise MitsonarError(f"unknown preset {short_repr(name)}: {suggest_names(name, [*sonars, *sounders])}")
    if key in sonars:
        _print_keys(key, sonars[key], preset(key))
        for line in _accuracy([key]):
            say(line)
    else:
        sounder = load_sounder(key)
        _print_keys(key, sounders[key], sounder.fan, sounder.model_dump(exclude={"name", "fan"}))


def _print_keys(name: str, known: Preset, sonar: Sonar, instrument_keys: dict[str, object] | None = None) -> None:
    """Print every key with its source: those of an instrument first, then those of its sonar."""
    from mitsonar.acoustics.water import absorption_line
    from mitsonar.instruments.sonar import RAYS

    say(f"{name}: {known.about}")
    for key, value in {**(instrument_keys or {}), **sonar.model_dump(exclude={"name"})}.items():
        shown = f"{value:g}" if isinstance(value, float) else "-" if value is None else str(value)
        say(f"  {key:18} {shown:10} {known.sources.get(key, 'from quality' if key in RAYS else 'default')}")
    if line := absorption_line(sonar):
        say(f"  {line}")


def _instruments() -> list[str]:
    """Return a line for each instrument of `mitsonar sound`."""
    from mitsonar.instruments.sounder import load_sounder, named_sounders

    lines = [
        "",
        f"{'instrument of `sound`':22} {'kind':14} {'fans':>5} {'beams':>6}  {'window (m)':12} {'bins':>5}  instrument",
    ]
    for key, known in named_sounders().items():
        one = load_sounder(key)
        fan, window = one.fan, f"{one.fan.range_min:g}..{one.fan.range_max:g}"
        count = f"{len(one.channels):5} {fan.beams:6}"
        lines.append(f"{key:22} {one.kind:14} {count}  {window:12} {fan.range_bins:5}  {known.about}")
    return lines


def _accuracy(names: list[str]) -> list[str]:
    """Return the measured errors of each quality, preset by preset."""
    from mitsonar.instruments.sonar import measured_errors

    about, measured = measured_errors()
    lines = [
        "",
        "quality: rays a beam (over elevation x across), rms error of one ping in % on plain ground / on 15 mm cells, and",
        "correlation of a resting sonar's pings on these cells (below 1: jitter of the rays, not speckle)",
        f"{'preset':22}" + "".join(f" {quality:30}" for quality in measured[names[0]]).rstrip(),
    ]
    for name in names:
        cells = [
            f"{f'{over} x {across}':8} {plain:6g} % / {textured:g} %  {still:.2f}"
            for over, across, plain, textured, still in measured[name].values()
        ]
        lines.append(f"{name:22}" + "".join(f" {cell:30}" for cell in cells).rstrip())
    return [
        *lines,
        f"Physical model; the thesis model keeps its own rays. Ground a fifth of the far range below the sonar. {about}.",
    ]


@answered
def materials(
    name: Annotated[
        str | None, typer.Argument(help="Print every number of this material (or YAML file) with its source.")
    ] = None,
) -> None:
    """List the materials of surfaces, or print one: what its level is based on, its band, and the source of each number."""
    import numpy as np

    from mitsonar.acoustics.materials import material, named_materials, reference_hz, sigma_table

    known = named_materials()
    if name is not None:
        one = material(name)
        sources = known[name].sources if name in known else {}
        say(f"{one.name}: {one.about or 'no description'}")
        for key, value in one.model_dump(exclude={"name", "about", "source"}, exclude_none=True).items():
            shown = (
                f"{value:g}" if isinstance(value, float) else f"{len(value)} values" if isinstance(value, tuple) else value
            )
            say(f"  {key:18} {shown:12} {sources.get(key, '')}".rstrip())
        if not sources:
            say(f"  source: {one.source or 'not stated'}")
        return
    say(f"{'material':10} {'basis':12} {'band (kHz)':12} {'law':12} {'dB at 30 deg':>12}  description")
    for key, (about, *_) in sorted(known.items()):
        one = material(key)
        band = "..".join(f"{end / 1000:g}" for end in one.band_hz)
        strength = 10 * np.log10(sigma_table(one, reference_hz(one))[30])
        say(f"{key:10} {one.basis or '-':12} {band:12} {one.law:12} {strength:12.1f}  {about}")
    say("dB: backscattering strength at 30 deg of grazing, mid-band. `mitsonar materials NAME` prints the sources.")


@answered
def scenes() -> None:
    """List the shipped scenes; each has a trajectory (`--trajectory shipped`)."""
    from mitsonar.simulation.scene import shipped_scenes

    for name, path in shipped_scenes().items():
        say(f"{name:16} {path}")
