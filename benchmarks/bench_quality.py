"""What each quality errs by, and costs, for every preset; `mitsonar presets` prints the table that this writes.

    python benchmarks/bench_quality.py [--write] [--quick] [--law]

The ground is a plane. The sonar is above it by a fifth of the window's far end, and its highest rays meet it there.
`plain`: one reflectivity. `textured`: cells of 15 mm with reflectivities spread evenly over 0..1. Twelve beams over the
preset's field of view are compared, ping by ping, with the mean of many pings of many rays. Errors are rms, in % of the
level of plain ground of the same mean. Bins where the field of view ends within a beam's width are left out.
`still`: how far a sonar at rest sees the same from ping to ping over textured ground, the correlation of the levels of two
pings, each over that of plain ground; what it lacks to 1 is the jitter of the rays, and no speckle. Times are of
the whole sonar over the textured ground, the fastest of 15 single pings, since others may use the machine; they are printed
and not kept. `--law` prints errors against rays for three presets in place of the table.
"""

from __future__ import annotations

import argparse
import math
import time
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml
from bench_render import machine
from numpy.typing import NDArray

import mitsonar
from mitsonar.instruments.sonar import FAR_GRAZING_RAD, QUALITIES, one_beam, scans
from mitsonar.instruments.sounder import named_sonars, preset
from mitsonar.io.files import write_atomic
from mitsonar.simulation.device import ensure_variant

if TYPE_CHECKING:
    import mitsuba as mi

BEAMS = 12
PINGS = 4
FINER = 4
"""How many times the rays over elevation of `fine` the reference has."""
REFERENCE_ACROSS, REFERENCE_PINGS = 16, 12
TABLE = Path(__file__).resolve().parents[1] / "mitsonar" / "instruments" / "quality.yaml"
LAW = ((50, 1), (100, 1), (200, 1), (400, 1), (800, 1), (100, 4), (200, 2), (200, 4), (200, 8), (700, 4), (700, 16))
"""Rays over elevation and across that `--law` compares."""

Levels = NDArray[np.float64]


def main() -> None:
    """Print the table, and write it if requested."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", help="keep the table with the package")
    parser.add_argument("--quick", action="store_true", help="two presets, fewer pings; writes nothing")
    parser.add_argument("--law", action="store_true", help="errors against rays, for three presets")
    args = parser.parse_args()
    if args.write and (args.quick or args.law):
        parser.error("--write keeps the whole table only: leave --quick and --law out")
    ensure_variant()
    if args.law:
        shown = ("didson300", "oculus-m1200d-1200khz", "oculus-m1200d-2100khz")
        return law(shown[:1] if args.quick else shown, 1 if args.quick else PINGS)
    names = ("didson300", "aris3000") if args.quick else tuple(named_sonars())
    rows = {name: qualities(name, *((1, 2, 3) if args.quick else (PINGS, REFERENCE_PINGS, 15))) for name in names}
    if args.write:
        write(rows)


def qualities(name: str, pings: int, reference_pings: int, repeats: int) -> dict[str, dict[str, float]]:
    """Measure the rows of a preset, by quality."""
    ground = Ground(name, reference_pings)
    rows: dict[str, dict[str, float]] = {}
    for quality in QUALITIES:
        sonar = preset(name).replace(model="physical", quality=quality)
        plain, textured, still = ground.errors(sonar.rays_per_beam, sonar.rays_across, pings)
        rows[quality] = {
            "rays_per_beam": sonar.rays_per_beam,
            "rays_across": sonar.rays_across,
            "plain_percent": two_digits_up(100 * plain),
            "textured_percent": two_digits_up(100 * textured),
            "still_correlation": round(still, 2),
        }
        ms = 1000 * ground.seconds(sonar, repeats)
        print(f"{name:22} {quality:9} {rows[quality]} {ms:.2g} ms a ping", flush=True)
    return rows


def law(names: tuple[str, ...], pings: int) -> None:
    """Print errors against rays."""
    print("| preset | rays a beam | plain, % | textured, % | still | bins an elevation cell covers at the far end |")
    print("|---" * 6 + "|")
    for name in names:
        ground = Ground(name, 3 * pings)
        sonar = ground.sonar
        for over, across in LAW:
            plain, textured, still = ground.errors(over, across, pings)
            reach = math.radians(sonar.elevation_fov_deg) / over / math.tan(FAR_GRAZING_RAD) * sonar.range_max / sonar.bin_m
            errors = f"{100 * plain:.2f} | {100 * textured:.1f} | {still:.2f}"
            print(f"| {name} | {over} x {across} | {errors} | {reach:.1f} |", flush=True)


class Ground:
    """A preset over the reference ground, and what many rays receive there.

    Args:
        name: of the preset.
        pings: whose mean is the reference.
    """

    def __init__(self, name: str, pings: int) -> None:
        whole = preset(name).replace(model="physical")
        whole = one_beam(whole) if scans(whole) else whole  # a head that turns: around its one beam
        self.sonar = whole.replace(beams=BEAMS, beam_width_deg=math.degrees(whole.beam_width_rad))
        self.height = whole.range_max * math.sin(FAR_GRAZING_RAD)
        self.pitch = FAR_GRAZING_RAD + math.radians(whole.elevation_fov_deg) / 2
        cells = {"type": "cell_noise", "coordinates": "position", "cell_size": 0.015}
        self.scenes = [plane(0.5), plane(cells)]
        dense = self.sonar.replace(quality="fine").rays_per_beam * FINER
        self.plain, self.textured = (
            self.levels(scene, dense, REFERENCE_ACROSS, range(1000, 1000 + pings)).mean(axis=0) for scene in self.scenes
        )
        self.inside = away_from_ends(self.sonar, self.height, self.pitch) & (self.plain > 0)

    def levels(self, scene: mi.Scene, over: int, across: int, pings: range) -> Levels:
        """Levels ``(pings, bins, beams)`` with so many rays a beam."""
        simulator = mitsonar.Simulator(scene, self.sonar.replace(rays_per_beam=over, rays_across=across))
        result = [next(simulator.pings(self.pose, first=ping)).levels[0] for ping in pings]
        return np.asarray(result, dtype=np.float64)

    @property
    def pose(self) -> list[list[float]]:
        """Of the sonar: x, y, z [m], pitch, roll, heading [rad]."""
        return [[0.0, 0.0, self.height, self.pitch, 0.0, 0.0]]

    def errors(self, over: int, across: int, pings: int) -> tuple[float, float, float]:
        """Relative rms errors of single pings on plain and on textured ground; correlation of pings on the textured."""
        pings = max(pings, 2)
        result = []
        for scene, truth in zip(self.scenes, (self.plain, self.textured), strict=True):
            seen = self.levels(scene, over, across, range(pings))[:, self.inside] / self.plain[self.inside]
            result.append(float(np.sqrt(np.mean((seen - truth[self.inside] / self.plain[self.inside]) ** 2))))
        still = np.corrcoef(seen)[np.triu_indices(pings, 1)].mean()
        return result[0], result[1], float(still)

    def seconds(self, sonar: mitsonar.Sonar, repeats: int) -> float:
        """Time of the fastest ping of the whole sonar over textured ground."""
        simulator = mitsonar.Simulator(self.scenes[1], sonar)
        times = []
        for ping in range(repeats):
            start = time.perf_counter()
            next(simulator.pings(self.pose, first=ping))
            times.append(time.perf_counter() - start)
        return min(times)


def plane(reflectance: object) -> mi.Scene:
    """Make a scene of the plane z = 0."""
    import mitsuba as mi

    bsdf = {"type": "diffuse", "reflectance": reflectance}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(500.0), "bsdf": bsdf}
    loaded: mi.Scene = mi.load_dict({"type": "scene", "floor": floor})
    return loaded


def away_from_ends(sonar: mitsonar.Sonar, height: float, pitch: float, margin: int = 2) -> NDArray[np.bool_]:
    """Bins ``(bins, beams)`` where the plane is met over a beam's whole width, so many bins away from where it ends.

    The ends are the ranges of the highest and lowest rays, and the nearest range where the fan reaches below the sonar.
    """
    half = math.radians(sonar.elevation_fov_deg) / 2
    b = sonar.bearing_rad[:, None, None] + np.linspace(-0.5, 0.5, 5)[None, :, None] * sonar.beam_width_rad
    e = np.linspace(-half, half, 4001)
    if sonar.bearing == "azimuth":
        forward, up = np.cos(e) * np.cos(b), np.sin(e)
    else:
        forward, up = np.cos(b) * np.cos(e), np.cos(b) * np.sin(e)
    down = forward * math.sin(pitch) - up * math.cos(pitch)
    reached = height / np.where(down > 1e-9, down, np.nan)  # (beams, width, elevation)
    nearest, slack = np.nanmin(reached, axis=2), margin * sonar.bin_m
    place = sonar.range_m[:, None]
    inside = (place > nearest.max(axis=1) + slack) & (place < np.nanmax(reached, axis=2).min(axis=1) - slack)
    for end in (reached[:, :, 0], reached[:, :, -1], nearest):
        inside &= (place < end.min(axis=1) - slack) | (place > end.max(axis=1) + slack)
    return np.asarray(inside, dtype=np.bool_)


def two_digits_up(value: float) -> float:
    """Round up to two digits, so that the stated bound holds."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / step - 1e-9) * step:.2g}")


def write(rows: dict[str, dict[str, dict[str, float]]]) -> None:
    """Keep the table with the package."""
    about = machine()
    lines = [
        "# Written by benchmarks/bench_quality.py --write; not by hand.",
        f"machine: {about['cpu']}, {about['cores']} cores",
        f"mitsuba: {about['mitsuba']}, {about['variant']}",
        f"date: {date.today().isoformat()}",
        "presets:",
    ]
    for name, by_quality in rows.items():
        lines.append(f"  {name}:")
        for quality, row in by_quality.items():
            output = yaml.safe_dump(row, default_flow_style=True, sort_keys=False, width=200).strip()
            lines.append(f"    {quality}: {output}")
    write_atomic(TABLE, ("\n".join(lines) + "\n").encode())


if __name__ == "__main__":
    main()
