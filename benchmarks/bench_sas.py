"""Synthetic apertures: point response, speckle, micronavigation, autofocus, speed, and echoes beside those of openSTB.

    python benchmarks/bench_sas.py                # two minutes on two cores
    python benchmarks/bench_sas.py --write        # also into results/tables/synthetic-aperture.json; then tables.py write
    python benchmarks/bench_sas.py --quick        # small, within seconds
    python benchmarks/bench_sas.py --only point   # one part: point, speckle, motion, autofocus, speed, openstb

Everything is simulated by `ChannelSimulator`. openSTB is compared where it is installed (pip install openstb-simulator).
"""

from __future__ import annotations

import argparse
import datetime
import importlib.util
import json
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mitsonar
from mitsonar.acoustics.water import Water, absorption_db_per_m
from mitsonar.instruments.hydrophones import ChannelSonar, FieldOfView, Hydrophone, side_looking_array
from mitsonar.io.files import write_atomic
from mitsonar.mapping.micronavigation import autofocus, displaced_phase_centres
from mitsonar.mapping.synthetic_aperture import BackProjector, Weighting, focus, point_response
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.records.responses import ImpulseResponses
from mitsonar.records.strips import StripGrid
from mitsonar.simulation.device import ensure_variant

RESULTS = Path(__file__).resolve().parent / "results" / "tables" / "synthetic-aperture.json"
HEIGHT, C = 8.0, 1500.0

Row = list[str]


def main() -> None:
    """Print a table for each part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small, stored nowhere")
    parser.add_argument("--write", action="store_true", help="store the tables")
    parser.add_argument("--only", choices=tuple(PARTS), help="one part")
    parser.add_argument("--machine", default="two shared cores", help="what the tables say of the machine")
    arguments = parser.parse_args()
    ensure_variant()
    tables = []
    for name, (caption, note, columns, part) in PARTS.items():
        if arguments.only not in (None, name):
            continue
        rows = part(arguments.quick)
        print(f"\n{caption}\n{' | '.join(columns)}")
        for row in rows:
            print(" | ".join(row), flush=True)
        tables.append({"caption": caption, "note": note, "columns": columns, "rows": rows})
    if arguments.write and not arguments.quick and arguments.only is None:
        about = {
            "machine": arguments.machine,
            "date": f"{datetime.date.today():%Y-%m-%d}",
            "command": "python benchmarks/bench_sas.py --write",
        }
        record = {
            "title": "Synthetic aperture",
            "anchor": "synthetic-aperture",
            "tables": [{**table, **about} for table in tables if table["rows"]],
        }
        write_atomic(RESULTS, (json.dumps(record, indent=1) + "\n").encode())


def track(pings: int, step: float, sway: NDArray[np.float64] | float = 0.0, every_s: float = 0.2) -> Trajectory:
    """Return pings along +y."""
    poses = np.zeros((pings, 6))
    poses[:, 0], poses[:, 1], poses[:, 2] = sway, np.arange(pings) * step, HEIGHT
    return Trajectory(poses, np.arange(pings, dtype=np.float64) * every_s)


def plate(place: tuple[float, float, float]) -> dict[str, Any]:
    """Return a plate of 1 cm that faces the middle of the track."""
    import mitsuba as mi

    towards = mi.ScalarPoint3f(0, place[1], HEIGHT)
    look = mi.ScalarTransform4f().look_at(origin=list(place), target=towards, up=[0, 1, 0])
    return {"type": "rectangle", "to_world": look.scale(0.005), "bsdf": {"type": "diffuse"}}


def one_point(sonar: ChannelSonar, place: tuple[float, float, float]) -> mitsonar.ChannelSimulator:
    """Return a simulator of one scatterer: that of the first seed that places exactly one on the plate."""
    import mitsuba as mi

    scene = mi.load_dict({"type": "scene", "plate": plate(place)})
    for seed in range(100):
        try:
            simulator = mitsonar.ChannelSimulator(scene, sonar.replace(points_per_m2=1e4, seed=seed))
        except mitsonar.MitsonarError:  # no point on the plate
            continue
        if len(simulator.tracer.source.scatterers) == 1:  # type: ignore[union-attr]
            return simulator
    raise SystemExit("no seed places a single scatterer on the plate")


# ---------------- Point response


def point(quick: bool) -> list[Row]:
    """Measure the response of one scatterer."""
    rows = []
    ranges = (12.0,) if quick else (12.0, 20.0)
    for far in ranges:
        sonar = side_looking_array(0.1, 4, range_max=25.0)
        simulator = one_point(sonar, (far, 6.0, 0.0))
        flown = track(60, 0.2)
        responses = simulator.responses(flown, velocities(flown))
        scatterers = simulator.tracer.source.scatterers  # type: ignore[union-attr]
        x, y, z = (float(value) for value in scatterers.place[0])
        weightings: tuple[Weighting, ...] = ("uniform", "hann")
        for weighting in weightings:
            grid = StripGrid(0, 0, z, 0, y - 1, 0.0125, 161, x - 1, 0.0125, 161)
            image = focus(responses, grid, weighting=weighting)
            row, column = np.unravel_index(np.abs(image.value).argmax(), image.value.shape)
            along = point_response(image.value[:, column], 0.0125)
            across = point_response(image.value[row], 0.0125)
            slant = (x / math.hypot(x, HEIGHT - z)) * across.width_m
            ideal = (0.0443, 0.8859 * C / (2 * sonar.bandwidth_hz))
            away = math.hypot((row - 80) * 0.0125, (column - 80) * 0.0125)
            rows.append(
                [
                    f"{far:g} m, {weighting}",
                    f"{1e3 * along.width_m:.2f} ({along.width_m / ideal[0]:.3f})",
                    f"{along.side_lobe_db:.1f}",
                    f"{1e3 * slant:.2f} ({slant / ideal[1]:.3f})",
                    f"{across.side_lobe_db:.1f}",
                    f"{1e3 * away:.1f}",
                ]
            )
    return rows


# ---------------- Speckle


def speckle(quick: bool) -> list[Row]:
    """Measure level and contrast of even ground."""
    import mitsuba as mi

    half = 12.0 if quick else 20.0
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(half),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.3}},
            },
        }
    )
    rows = []
    weightings: tuple[tuple[Weighting, float], ...] = (("uniform", 1.0), ("hann", 1.5))
    for weighting, wider in weightings:
        shares = []
        for seed in (0,) if quick else (0, 1, 2):
            sonar = side_looking_array(
                0.2, 4, carrier_hz=60e3, bandwidth_hz=10e3, range_max=14.0, points_per_m2=3000, seed=seed
            )
            flown = replace(track(26 if quick else 40, 0.4))
            poses = flown.poses.copy()
            poses[:, 1] -= poses[:, 1].mean()
            poses[:, 2] = 5.0
            flown = Trajectory(poses, flown.time_s)
            simulator = mitsonar.ChannelSimulator(scene, sonar, within=sonar.box_seen_from(poses))
            grid = StripGrid(0, 0, 0, 0, -poses[-1, 1] + 2.0, 0.1, int((2 * poses[-1, 1] - 4.0) / 0.1), 7.0, 0.1, 50)
            power = (
                np.abs(focus(simulator.responses(flown, velocities(flown)), grid, weighting=weighting).value.astype(complex))
                ** 2
            )
            sine = 5.0 / np.hypot(grid.across_m, 5.0)
            shares.append(power / (0.3 * sine**2 * wider**2 * 0.1 * C / (2 * 10e3) / np.sqrt(1 - sine**2)))
        share = np.concatenate(shares)
        rows.append([weighting, f"{share.size:,}", f"{share.mean():.2f}", f"{share.std() / share.mean():.3f}"])
    return rows


# ---------------- Micronavigation and autofocus


def swaying(quick: bool) -> tuple[ImpulseResponses, NDArray[np.float64], ImpulseResponses]:
    """Return responses over ground with stones as a navigation without sway sees them, the sway, and the true ones."""
    import mitsuba as mi

    pings = 16 if quick else 60
    rng = np.random.default_rng(2)
    number = np.arange(pings)
    sway = 4e-3 * np.sin(2 * np.pi * number * 0.2 / 4) + np.cumsum(rng.normal(0, 3e-4, pings))
    sway -= np.polynomial.Polynomial.fit(number, sway, 1)(number)
    material = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.1}}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(30), "bsdf": material}
    stones = {
        f"stone{k}": {
            "type": "sphere",
            "center": [float(rng.uniform(13, 20)), float(rng.uniform(1, 0.2 * pings - 1)), 0.05],
            "radius": 0.12,
            "bsdf": {"type": "diffuse"},
        }
        for k in range(20)
    }
    scene = mi.load_dict({"type": "scene", "floor": floor, **stones}, optimize=False)
    sonar = side_looking_array(0.1, 8, range_max=22.0, points_per_m2=4000)
    flown, straight = track(pings, 0.2, sway), track(pings, 0.2)
    simulator = mitsonar.ChannelSimulator(scene, sonar, within=sonar.box_seen_from(flown.poses))
    true = simulator.responses(flown, velocities(flown))
    return replace(true, poses=straight.poses, velocity=velocities(straight)), sway, true


SWAYING: dict[bool, tuple[ImpulseResponses, NDArray[np.float64], ImpulseResponses]] = {}


def shared(quick: bool) -> tuple[ImpulseResponses, NDArray[np.float64], ImpulseResponses]:
    """Simulate the swaying path once."""
    if quick not in SWAYING:
        SWAYING[quick] = swaying(quick)
    return SWAYING[quick]


def motion(quick: bool) -> list[Row]:
    """Compare the sway between pings with its bound, at several levels of noise."""
    measured, sway, _ = shared(quick)
    rng = np.random.default_rng(0)
    near = measured.delay_s * C / 2 > 1.5 * HEIGHT
    rows = []
    for noise_db in (None, -20.0, -10.0, -3.0):
        noisy = measured
        if noise_db is not None:
            white = rng.normal(size=measured.response.shape) + 1j * rng.normal(size=measured.response.shape)
            band = (
                np.abs(np.fft.fftfreq(measured.sonar.taps, 1 / measured.sonar.sampling_hz))
                <= measured.sonar.bandwidth_hz / 2
            )
            white = np.fft.ifft(np.fft.fft(white, axis=2) * band, axis=2)
            level = np.mean(np.abs(measured.response[:, :, near & (measured.delay_s * C / 2 < 22)]) ** 2)
            white *= math.sqrt(level * 10 ** (noise_db / 10) / np.mean(np.abs(white) ** 2))
            noisy = replace(measured, response=(measured.response + white).astype(np.complex64))
        micro = displaced_phase_centres(noisy)
        error = micro.sway_m - np.diff(sway)
        along = micro.path[:, 0] - sway
        rows.append(
            [
                "none" if noise_db is None else f"{noise_db:g} dB",
                f"{np.median(micro.coherence):.3f}",
                f"{1e3 * np.sqrt(np.nanmean(error**2)):.3f}",
                f"{1e3 * np.sqrt(np.nanmean(micro.sway_std_m**2)):.3f}",
                f"{1e3 * np.std(along):.2f}",
                f"{1e3 * np.std(sway):.2f}",
            ]
        )
    return rows


def sharpness(responses: ImpulseResponses, grid: StripGrid, path: NDArray[np.float64] | None = None) -> float:
    """Return the mean square intensity over the square of its mean; 2 for speckle."""
    power = np.abs(focus(responses, grid, path=path).value.astype(complex)) ** 2
    return float((power**2).mean() / power.mean() ** 2)


def sharpened(quick: bool) -> list[Row]:
    """Compare the sharpness of an image along several paths."""
    measured, _, true = shared(quick)
    rows = 60 if quick else 360
    grid = StripGrid(0, 0, 0, 0, 1.2 if quick else 1.5, 0.025, rows, 13.0, 0.02, 200)
    path = displaced_phase_centres(measured).path
    begun = time.perf_counter()
    auto = autofocus(measured, grid)
    seconds = time.perf_counter() - begun
    return [
        ["true path", f"{sharpness(true, grid):.0f}"],
        ["navigation without the sway", f"{sharpness(measured, grid):.0f}"],
        ["displaced phase centres", f"{sharpness(measured, grid, path):.0f}"],
        [f"autofocus ({seconds:.0f} s)", f"{sharpness(measured, grid, auto):.0f}"],
        ["both", f"{sharpness(measured, grid, autofocus(measured, grid, path=path)):.0f}"],
    ]


# ---------------- Speed


def speed(quick: bool) -> list[Row]:
    """Time the back-projection of one block."""
    measured, _, _ = shared(quick)
    grid = StripGrid(0, 0, 0, 0, 1.0, 0.025, 64, 9.0, 0.01875, 512)
    projector = BackProjector(measured, grid)
    every = slice(0, 64)
    pixels = 0
    for ping in projector.pings_of(every):
        for receiver in range(len(measured.sonar.receivers)):
            for rows, columns in projector.tiles(int(ping), receiver, every):
                pixels += (rows.stop - rows.start) * (columns.stop - columns.start)
    projector.block(every)
    begun = time.process_time()
    projector.block(every)
    seconds = time.process_time() - begun
    return [[f"{pixels:,}", f"{seconds:.2f}", f"{1e9 * seconds / pixels:.0f}"]]


# ---------------- openSTB


def openstb(quick: bool) -> list[Row]:
    """Compare the echoes of three points at four moving receivers with those of openSTB."""
    if importlib.util.find_spec("openstb") is None:
        print("openSTB is not installed (pip install openstb-simulator): its comparison is left out")
        return []
    from openstb.simulator.distortion.environmental import AnslieMcColmAttenuation, GeometricSpreading
    from openstb.simulator.environment.invariant import InvariantEnvironment
    from openstb.simulator.simulation.points import CommonSettings, _point_simulation_chunk
    from openstb.simulator.system.trajectory import Linear
    from openstb.simulator.travel_time.iterative import Iterative

    water = Water(temperature_c=10.0, salinity_psu=35.0)
    absorption = float(absorption_db_per_m(100e3, water, "ainslie-mccolm"))
    field = FieldOfView(shape="all")
    receivers = tuple(Hydrophone(name=f"r{k}", position=(0.02, 0.3 * k - 0.4, -0.01), field=field) for k in range(4))
    sonar = ChannelSonar.create(
        **{"carrier_hz": 100e3, "bandwidth_hz": 20e3, "sampling_hz": 32e3, "frequency_step_hz": 10.0, "rolloff": 0.5},
        **{"range_max": 30.0, "absorption_db_per_m": absorption, "receivers": receivers},
    )
    rows = []
    for place in ((12.0, 1.0, 0.0), (20.0, -4.0, 1.0), (5.0, 9.0, 0.5)):
        simulator = one_point(sonar, place)
        scatterers = simulator.tracer.source.scatterers  # type: ignore[union-attr]
        spot, normal = scatterers.place[0].astype(float), scatterers.normal[0].astype(float)
        cells, shifted = [], 0.0
        for speed_m_s in (0.01, 3.0, 10.0):
            worst = 0.0
            (part,) = simulator.pings(track(1, 0.0).poses, np.array([[0.0, speed_m_s, 0.0, 0.0]]))
            # openSTB: forward, starboard, down
            frequency = 100e3 + np.fft.fftshift(np.fft.fftfreq(2 * sonar.taps, 1 / sonar.sampling_hz))
            spectrum = sonar.raised_cosine(frequency - 100e3)
            common = CommonSettings(
                f=frequency,
                S=spectrum,
                signal_frequency_bounds=(90e3, 110e3),
                baseband_frequency=100e3,
                travel_time=Iterative(50, 1e-14),
                trajectory=Linear([0, 0, -HEIGHT], [1000.0, 0, -HEIGHT], speed_m_s),
                environment=InvariantEnvironment(35.0, C, 10.0),
                tx_position=np.zeros(3),
                tx_ori=np.array([1.0, 0, 0, 0]),
                distortion=[GeometricSpreading(1.0), AnslieMcColmAttenuation("centre")],
            )
            for number, one in enumerate(receivers):
                starboard, forward, up = one.position
                target = np.array([[spot[1], spot[0], -spot[2], 1.0]])
                at = np.array([forward, starboard, -up])
                sums = _point_simulation_chunk(common, target, 0.0, at, np.array([1.0, 0, 0, 0]), [], 1.0)
                theirs = np.fft.ifft(np.fft.ifftshift(sums))[: sonar.taps]
                out, back = np.array([0, 0, HEIGHT]) - spot, np.array([starboard, forward, HEIGHT + up]) - spot
                cosines = [float(normal @ way) / float(np.linalg.norm(way)) for way in (out, back)]
                size = math.sqrt(scatterers.strength[0] * cosines[0] * cosines[1]) * np.exp(1j * scatterers.phase[0])
                ours = part.response[0, number] / size
                worst = max(worst, float(np.abs(ours - theirs).max() / np.abs(theirs).max()))
                shifted = max(shifted, abs(float(np.angle(np.vdot(theirs, ours)))) / (2 * math.pi * 100e3))
            cells.append(f"{20 * math.log10(worst):.0f}")
        rows.append([f"({place[0]:g}, {place[1]:g}, {place[2]:g})", *cells, f"{1e12 * shifted:.2f}"])
    return rows


Part = tuple[str, str, list[str], Callable[[bool], list[Row]]]

PARTS: dict[str, Part] = {
    "point": (
        "Point response",
        "One scatterer, elements of 0.1 m, 100 kHz, 20 kHz wide. Widths at half power; in brackets relative to "
        "0.886 D / 2 and 0.886 c / 2B.",
        ["range, weights", "along (mm)", "side lobe (dB)", "slant range (mm)", "side lobe (dB)", "off its place (mm)"],
        point,
    ),
    "speckle": (
        "Speckle of even ground",
        "Level: mean intensity over C sin^2 of the grazing angle times the resolution cell; with uniform weights the edges "
        "of the beam fold into it. Contrast: standard deviation over mean.",
        ["weights", "pixels", "level", "contrast"],
        speckle,
    ),
    "motion": (
        "Displaced phase centres",
        "Ground with stones, 8 receivers, 0.2 m from ping to ping, a sway of 4 mm with a period of 4 m and "
        "0.3 mm of random walk.",
        ["noise", "coherence", "rms error of a sway (mm)", "bound (mm)", "of the path (mm)", "sway (mm)"],
        motion,
    ),
    "autofocus": (
        "Sharpness of the image",
        "The same path; mean square intensity over the square of its mean.",
        ["path", "sharpness"],
        sharpened,
    ),
    "speed": (
        "Back-projection",
        "Processor time of one block of 64 x 512 pixels.",
        ["echoes of pixels", "seconds", "ns an echo"],
        speed,
    ),
    "openstb": (
        "Echoes of points beside openSTB 0.6.1",
        "Four receivers at 0.01, 3 and 10 m/s, spreading and Ainslie-McColm absorption at the carrier: largest difference "
        "of a response relative to its peak, and of delay from the phase of the carrier. mitsonar takes the spreading from "
        "where a receiver is when the sound is sent.",
        ["place (m)", "at 0.01 m/s (dB)", "at 3 m/s (dB)", "at 10 m/s (dB)", "delay (ps)"],
        openstb,
    ),
}
"""Caption, note, columns and function of each part."""


if __name__ == "__main__":
    main()
