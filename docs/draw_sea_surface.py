"""Draws docs/gallery/sea_surface.png: a sea, its spectrum, Lloyd's mirror and responses over wind speeds; prints the tables.

python docs/draw_sea_surface.py            # into docs/gallery
python docs/draw_sea_surface.py --quick    # coarse, into a folder that is removed: does it still work?
"""

from __future__ import annotations

import argparse
import itertools
import math
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

import mitsonar
from mitsonar.instruments.hydrophones import FieldOfView, Hydrophone
from mitsonar.motion.pose import Pose
from mitsonar.simulation.channel import ChannelSimulator, impulse_response
from mitsonar.simulation.device import ensure_variant
from mitsonar.worlds.sea import SeaSurface

if TYPE_CHECKING:
    import mitsuba as mi
    from matplotlib.axes import Axes

SOUND_SPEED = 1500.0
WINDS = (0.0, 2.0, 4.0, 8.0)
CARRIERS = (20e3, 80e3, 400e3)
SOURCE_M, AWAY_M, CARRIER = 5.0, 30.0, 5e3
"""Depth of the source, distance of the hydrophones [m], carrier [Hz]."""

SEED = 4


def main() -> None:
    """Print the tables, and draw into the gallery, or with ``--quick`` coarsely into a folder that is removed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="coarse, into a folder that is removed")
    quick = parser.parse_args().quick
    ensure_variant()
    print_winds()
    print_steps()
    print_costs(quick)
    print_ghosts(1 if quick else 12)
    with tempfile.TemporaryDirectory() as folder:
        draw(Path(folder if quick else Path(__file__).parent / "gallery") / "sea_surface.png", Path(folder), quick)


def loss_db(height_m: float, carrier_hz: float, cosine: float = 1.0) -> float:
    """Return what waves of an rms height take of the coherent echo [dB]."""
    return 20 * math.log10(math.e) * 2 * (2 * math.pi * carrier_hz / SOUND_SPEED * height_m * cosine) ** 2


def print_winds() -> None:
    """Print height, length and period of the waves of each wind, and where all of them take 10 dB."""
    for wind in (1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 15.0):
        sea = SeaSurface(wind_m_s=wind, size_m=10.0, step_m=0.1, water_m=1000.0)
        height = sea.state.significant_height_m
        grazing = [math.degrees(math.asin(min(1, math.sqrt(10 / loss_db(height / 4, carrier))))) for carrier in CARRIERS]
        print(
            f"| {wind:g} | {height:.2g} | {sea.state.peak_wavelength_m:.2g} | {2 * math.pi / sea.waves.peak_rad_s:.2g} | "
            f"{1e3 * sea.state.roughness_m:.2g} | {' | '.join(f'{angle:.2g}' for angle in grazing)} |"
        )


def print_steps() -> None:
    """Print the roughness that meshes leave, and its loss straight up, at a wind of 5 m/s."""
    for step in (0.5, 0.25, 0.1, 0.05, 0.02, 0.01):
        height = SeaSurface(size_m=1000 * step, step_m=step).state.roughness_m
        losses = [f"{loss:.2g}" if (loss := loss_db(height, carrier)) < 99 else "over 99" for carrier in CARRIERS]
        print(f"| {step:g} | {4 * step:g} | {1e3 * height:.2g} | {' | '.join(losses)} |")


def print_costs(quick: bool) -> None:
    """Print the time that surfaces take."""
    for cells in (100,) if quick else (100, 400, 1000):
        sea = SeaSurface(size_m=0.1 * cells, step_m=0.1)
        begun = time.process_time()
        sea.surface(SEED)
        print(f"{cells} x {cells} squares: {time.process_time() - begun:.2f} s")


def print_ghosts(seas: int) -> None:
    """Print the energy of a ball's ghosts in images over that by a flat surface, mean and standard deviation."""
    keys = {"elevation_fov_deg": 60, "range_min": 3.5, "range_max": 7, "range_bins": 700}
    sonar = mitsonar.Sonar.create(model="physical", bounces=3, frequency_hz=9e5, **keys)
    straight, image = 4.35, math.hypot(4.4, 1.6) - 0.05
    near = [np.abs(sonar.range_m - range_m) < 0.03 for range_m in ((straight + image) / 2, image)]
    flat = np.ones(2)
    for wind in (0.0, 0.5, 1.0, 2.0, 4.0):
        sea = SeaSurface(wind_m_s=wind, size_m=12.0, step_m=0.05)
        sums = np.array([[level[part].sum() for part in near] for level in ball_levels(sea, sonar, seas if wind else 1)])
        flat = sums[0] if wind == 0 else flat
        mean, spread = (sums / flat).mean(axis=0), (sums / flat).std(axis=0)
        print(f"| {wind:g} m/s | {' | '.join(f'{a:.2f} +- {b:.2f}' for a, b in zip(mean, spread, strict=True))} |")


def ball_levels(sea: SeaSurface, sonar: mitsonar.Sonar, seas: int) -> list[NDArray[np.float64]]:
    """Return levels over range of a ball 0.8 m below each of some seas ``(ranges,)``."""
    import mitsuba as mi

    dark, bright = ({"type": "diffuse", "reflectance": value} for value in (0.0, 0.3))
    ball = {"type": "sphere", "center": [0, 4.4, 9.2], "radius": 0.05, "bsdf": bright}
    result = []
    for seed in range(seas):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "surface.ply"
            sea.save(path, seed)
            surface = {"type": "ply", "filename": str(path), "face_normals": True, "bsdf": dark}
            scene = mi.load_dict({"type": "scene", "surface": surface, "ball": ball}, optimize=False)
        assert isinstance(scene, mi.Scene)
        (ping,) = mitsonar.Simulator(scene, sonar, mirrors={"surface": (-1.0, 0.0)}).pings(np.array([0, 0, 9.2, 0, 0, 0]))
        result.append(np.asarray(ping.levels[0], dtype=float).sum(axis=1))
    return result


def below(sea: SeaSurface, folder: Path) -> mi.Scene:
    """Return a scene of the surface alone."""
    import mitsuba as mi

    path = folder / "surface.ply"
    path.write_bytes(sea.surface(SEED).ply())
    scene = mi.load_dict({"type": "scene", "surface": {"type": "ply", "filename": str(path), "face_normals": True}})
    assert isinstance(scene, mi.Scene)
    return scene


def draw(out: Path, folder: Path, quick: bool) -> None:
    """Draw the four panels."""
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    draw_surface(axes[0, 0], axes[0, 1], 6 if quick else 40)
    depths = np.linspace(0.5, 15, 5 if quick else 88)
    for wind in WINDS:
        sea = SeaSurface(wind_m_s=wind, size_m=60.0, step_m=0.5, water_m=100.0, seabed_cells=0, spreading=1.0)
        levels, response, sonar = lloyd(below(sea, folder), sea, depths)
        label = f"{wind:g} m/s" if wind else "flat"
        axes[1, 0].plot(levels, depths, label=label)
        delay = 1e3 * np.arange(sonar.taps) / sonar.sampling_hz
        axes[1, 1].plot(delay, 20 * np.log10(np.abs(response)), label=label)
    axes[1, 0].set(
        xlabel=f"level of direct path and surface at {CARRIER / 1000:g} kHz, {AWAY_M:g} m away (dB re 1 m)",
        ylabel="depth of the hydrophone (m)",
        ylim=(15, 0),
        xlim=(-50, -20),
        title=f"Lloyd's mirror, source {SOURCE_M:g} m deep",
    )
    axes[1, 1].set(
        xlabel="delay (ms)", ylabel="response (dB)", xlim=(19, 30), ylim=(-90, -20), title="responses, hydrophone 10 m deep"
    )
    for axis in axes.flat[1:]:
        axis.legend(fontsize=8)
    figure.savefig(out, dpi=85)


def draw_surface(left: Axes, right: Axes, seeds: int) -> None:
    """Draw heights of one sea, and the spectrum of many against its law."""
    sea = SeaSurface(wind_m_s=5.0, size_m=40.0, step_m=0.2, water_m=1000.0)
    count = 201
    z = sea.surface(SEED).vertices[:, 2].reshape(count, count) - sea.water_m
    shown = left.imshow(z, origin="lower", extent=(-20, 20, -20, 20), cmap="RdBu_r", vmin=-0.45, vmax=0.45)
    left.figure.colorbar(shown, ax=left, label="height (m)")
    left.set(xlabel="x (m)", ylabel="y, where the wind blows to (m)", title="a sea of 5 m/s")
    for wind in (3.0, 5.0, 10.0):
        windy = SeaSurface(wind_m_s=wind, size_m=40.0, step_m=0.2, water_m=1000.0)
        k, power = periodogram(windy, seeds, count)
        (line,) = right.loglog(k, power, ".", markersize=4)
        fine = np.geomspace(0.03, 30, 400)
        law = windy.waves.density_of_wavenumber(fine)
        right.loglog(fine, law, color=line.get_color(), linewidth=1, label=f"{wind:g} m/s")
    right.axvline(2 * math.pi / 0.8, color="0.7")
    right.set(xlabel="wavenumber (rad/m)", ylabel="density of variance (m^3)", xlim=(0.03, 30), ylim=(1e-7, 30))
    right.set(title="spectra: points of the meshes, lines of the law")


def periodogram(sea: SeaSurface, seeds: int, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return wavenumbers of rings and the density over the wavenumber, averaged over seeds."""
    window = np.outer(*[np.hanning(count)] * 2)
    step = sea.size_m / (count - 1)
    total = np.zeros((count, count))
    for seed in range(seeds):
        z = sea.surface(seed).vertices[:, 2].reshape(count, count) - sea.water_m
        total += np.abs(np.fft.fft2(z * window)) ** 2 / seeds
    total *= (step / (2 * np.pi)) ** 2 / (window**2).sum()
    axis = 2 * np.pi * np.fft.fftfreq(count, step)
    k = np.hypot(axis[:, None], axis)
    edges = np.geomspace(0.4, 10, 28)
    rings = [(k >= low) & (k < high) for low, high in itertools.pairwise(edges)]
    result = [(k[ring].mean(), (total * k)[ring].mean() * 2 * np.pi) for ring in rings if ring.any()]
    wave, power = np.array(result).T
    return wave, power


def lloyd(
    scene: mi.Scene, sea: SeaSurface, depths: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.complex128], mitsonar.ChannelSonar]:
    """Return levels at hydrophones of several depths [dB], the response at 10 m, and the instrument."""

    def instrument(depth: float) -> mitsonar.ChannelSonar:
        one = Hydrophone(name="one", position=(0.0, AWAY_M, SOURCE_M - depth), field=FieldOfView(shape="all"))
        keys = {"carrier_hz": CARRIER, "bandwidth_hz": 2000.0, "sampling_hz": 4000.0, "frequency_step_hz": 5.0}
        return mitsonar.ChannelSonar(receivers=(one,), direct=True, range_max=60.0, points_per_m2=1e-3, **keys)

    pose = Pose(0, -AWAY_M / 2, sea.water_m - SOURCE_M)
    mirrors = {"surface": (-1.0, sea.state.roughness_m)}
    levels = []
    for depth in depths:
        received = ChannelSimulator(scene, instrument(float(depth)), mirrors=mirrors).paths(pose)
        parts = [received.by(name) for name in ("direct", "surface")]
        total = sum((part.amplitude * np.exp(-2j * np.pi * CARRIER * part.delay_s)).sum() for part in parts)
        levels.append(20 * math.log10(abs(total)))
    sonar = instrument(10.0)
    received = ChannelSimulator(scene, sonar, mirrors=mirrors).paths(pose)
    parts = [received.by(name) for name in ("direct", "surface")]
    delay, amplitude = (np.concatenate([getattr(part, key) for part in parts]) for key in ("delay_s", "amplitude"))
    return np.array(levels), impulse_response(delay, amplitude, sonar), sonar


if __name__ == "__main__":
    main()
