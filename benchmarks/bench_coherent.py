"""What a coherent ping costs, beside the bare tracing of its rays and beside the model physical.

    python benchmarks/bench_coherent.py [--json] [--quick] [--presets] [--variant cuda_ad_mono]

Milliseconds of processor time of all threads, and of wall time, medians within one run; rows take turns. `trace` is
`ray_intersect_preliminary` on the rays of the coherent fan. `beams`: the model physical with pattern two_way. The poses move
by 10 mm a ping. `--presets`: a frame of each preset over the flat floor instead, from 0.3 of the window's end above it at a
pitch of 20 deg, and its figure with metre axes (`mitsonar render --cartesian`).
"""

from __future__ import annotations

import argparse
import io
import json
import os
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads of BLAS that wait for work count as processor time

import numpy as np
from bench_render import machine
from rocky_seabed import mitsuba_scene, rocky_seabed

from mitsonar import MitsonarWarning, Simulator, Sonar, SonarFrames, Trajectory, load_scene
from mitsonar.instruments.sonar import frame_period_s, scans
from mitsonar.instruments.sounder import named_sonars, preset
from mitsonar.plotting.fans import fan_figure
from mitsonar.simulation.device import ensure_variant

if TYPE_CHECKING:
    import mitsuba as mi

TARGETS_MS = {"didson300, floor": 60, "oculus-m1200d-2100khz, floor": 150, "didson300, rocks": 110}
"""Processor time of a coherent ping that is to be kept on two cores."""


@dataclass(frozen=True)
class Case:
    """A sonar over a ground, at a height [m] and a pitch [deg]."""

    name: str
    scene: mi.Scene
    sonar: Sonar
    height_m: float
    pitch_deg: float

    def pose(self, ping: int) -> np.ndarray:
        """Return the pose of a ping ``(1, 6)``."""
        return np.array([[0.01 * ping, 0.002 * ping, self.height_m, np.radians(self.pitch_deg), 0, 0]])


def main() -> None:
    """Print the table, or everything as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print for programs")
    parser.add_argument("--quick", action="store_true", help="a small seabed, each once: within a minute")
    parser.add_argument("--presets", action="store_true", help="a ping of each preset, and its figure")
    parser.add_argument("--variant", help="Mitsuba variant, e.g. cuda_ad_mono")
    arguments = parser.parse_args()
    ensure_variant(arguments.variant)
    if arguments.presets:
        of_presets = {"machine": machine(), "rows": [preset_row(name, 3) for name in named_sonars()]}
        print(json.dumps(of_presets, indent=2) if arguments.json else preset_table(of_presets))
        return
    rows = [measured(case, 1 if arguments.quick else 15) for case in cases(arguments.quick)]
    result = {"machine": machine(), "rows": rows}
    print(json.dumps(result, indent=2) if arguments.json else table(result))


def preset_row(name: str, repeats: int) -> dict[str, Any]:
    """Measure a frame of a preset, of a head that turns a sweep: milliseconds of the frame and of its figure, medians."""
    sonar = preset(name)
    case = Case(name, load_scene("flat_floor"), sonar, 0.3 * sonar.range_max, 20)
    simulator = Simulator(case.scene, sonar)
    ping = partial(rendered_frames, simulator, case)
    frames = ping(0)
    work: dict[str, Callable[[int], object]] = {"frame": ping, "cartesian": lambda _: drawn(frames)}
    times = turns(work, repeats)
    return {"name": name, "beams": sonar.beams, "bins": sonar.range_bins, **{key: cpu for key, (cpu, _) in times.items()}}


def rendered_frames(simulator: Simulator, case: Case, ping: int) -> SonarFrames:
    """Render one frame of a case, as `mitsonar render` does."""
    poses = np.repeat(case.pose(ping), 2 if scans(case.sonar) else 1, axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MitsonarWarning)
        return simulator.render(Trajectory(poses, frame_period_s(case.sonar) * np.arange(len(poses), dtype=float)))


def drawn(frames: SonarFrames) -> bytes:
    """Draw the figure of a frame."""
    buffer = io.BytesIO()
    fan_figure(frames, 0).savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def preset_table(result: dict[str, Any]) -> str:
    """Format the times of presets as Markdown."""
    m = result["machine"]
    lines = [
        f"{m['cpu']}, {m['cores']} cores, {m['variant']}, Mitsuba {m['mitsuba']}, {m['date']}",
        "",
        "| preset | beams x bins | s of CPU a frame | with `--cartesian`, more |",
        "|---|---|---|---|",
    ]
    lines += [
        f"| `{row['name']}` | {row['beams']} x {row['bins']} | {row['frame'] / 1e3:.2f} | {row['cartesian'] / 1e3:.2f} |"
        for row in result["rows"]
    ]
    return "\n".join(lines)


def cases(quick: bool) -> Iterator[Case]:
    """Yield the sonars and grounds."""
    floor = load_scene("flat_floor")
    didson = preset("didson300")
    yield Case("didson300, floor", floor, didson, 2.5, 35)
    if not quick:
        yield Case("oculus-m1200d-2100khz, floor", floor, preset("oculus-m1200d-2100khz"), 2.0, 20)
    yield Case("didson300, rocks", mitsuba_scene(rocky_seabed(8 if quick else 52)), didson, 2.5, 35)


def measured(case: Case, repeats: int) -> dict[str, Any]:
    """Measure one case: milliseconds by name, points and rays of a coherent ping."""
    hard = case.sonar.replace(model="physical", pattern="box")
    sonars = {"physical": hard, "beams": hard.replace(pattern="two_way"), "coherent": case.sonar}
    simulators = {name: Simulator(case.scene, sonar) for name, sonar in sonars.items()}
    imager = simulators["coherent"].model.imager
    assert imager is not None
    work: dict[str, Callable[[int], object]] = {"trace": bare(case)}
    for name, simulator in simulators.items():
        work[name] = partial(rendered, simulator, case)
    counts = imager.image(case.pose(0)[0], 0)[1]
    result = {"case": case.name, "rays": imager.tracer.fan.rays, "points": counts.points}
    return result | {name: dict(zip(("cpu", "wall"), ms, strict=True)) for name, ms in turns(work, repeats).items()}


def rendered(simulator: Simulator, case: Case, ping: int) -> object:
    """Render one ping of a case."""
    return next(iter(simulator.pings(case.pose(ping), first=ping)))


def bare(case: Case) -> Callable[[int], object]:
    """Return a function that traces the rays of a coherent ping, and nothing else."""
    import drjit as dr
    import mitsuba as mi

    from mitsonar.motion.pose import to_world_matrices
    from mitsonar.simulation.beams import CommonFan
    from mitsonar.simulation.coherent_tracing import FanRays

    sonar, fan = case.sonar, CommonFan.from_sonar(case.sonar)
    index = dr.arange(mi.UInt32, fan.rays)
    dr.make_opaque(index)

    @dr.freeze
    def launch(index: Any, scene: Any, rows: Any) -> Any:
        lines = [[dr.gather(mi.Float64, rows, mi.UInt32(4 * i + j)) for j in range(4)] for i in range(3)]
        rays = FanRays(fan, sonar, index, lines)
        return scene.ray_intersect_preliminary(mi.Ray3f(rays.origin, rays.d), coherent=True).t

    def call(ping: int) -> None:
        rows = mi.Float64(to_world_matrices(case.pose(ping))[0, :3].astype(np.float64).ravel().tolist())
        dr.eval(launch(index, case.scene, rows))
        dr.sync_thread()

    return call


def turns(work: dict[str, Callable[[int], object]], repeats: int) -> dict[str, tuple[float, float]]:
    """Return the median milliseconds of processor and wall time of each, taking turns, after two rounds of warming up."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in work}
    for ping in range(repeats + 2):
        for name, call in work.items():
            cpu, wall = time.process_time(), time.perf_counter()
            call(ping)
            times[name].append((1000 * (time.process_time() - cpu), 1000 * (time.perf_counter() - wall)))
    return {name: tuple(np.median(values[2:], axis=0).tolist()) for name, values in times.items()}


def table(result: dict[str, Any]) -> str:
    """Format the result as Markdown."""
    m = result["machine"]
    lines = [
        f"{m['cpu']}, {m['cores']} cores, {m['variant']}, Mitsuba {m['mitsuba']}, {m['date']}",
        "",
        "| ms of CPU a ping | rays | points | trace | physical | with beams | coherent | wall | target |",
        "|---" * 9 + "|",
    ]
    for row in result["rows"]:
        cpu = [f"{row[name]['cpu']:.0f}" for name in ("trace", "physical", "beams", "coherent")]
        lines.append(
            f"| {row['case']} | {row['rays']:,} | {row['points']:,} | {' | '.join(cpu)} | {row['coherent']['wall']:.0f} "
            f"| {TARGETS_MS[row['case']]} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
