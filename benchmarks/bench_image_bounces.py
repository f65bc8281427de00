"""What a ping with two and with three reflections costs, in the time of one.

    python benchmarks/bench_image_bounces.py [--json] [--quick] [--variant cuda_ad_mono]

Milliseconds of processor time of all threads, medians within one run; rows take turns. `objects`: the shipped scene, whose
floor and bodies are rough. `tank`: the same bodies between four smooth walls below a flat surface; walls and surface are
mirrors. The poses move by 10 mm a ping.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads of BLAS that wait for work count as processor time

import numpy as np
from bench_render import machine

from mitsonar import Simulator, Sonar, load_scene
from mitsonar.instruments.sounder import preset
from mitsonar.simulation.device import ensure_variant

if TYPE_CHECKING:
    import mitsuba as mi

TARGET = 2.5
"""Largest cost of two reflections, in that of one."""

SMOOTH = (0.7, 2e-5)
"""Reflection coefficient and rms height [m] of the tank's walls."""


@dataclass(frozen=True)
class Case:
    """A sonar in a scene, with mirrors."""

    name: str
    scene: mi.Scene
    sonar: Sonar
    mirrors: dict[str, tuple[float, float]] = field(default_factory=dict)

    def pose(self, ping: int) -> np.ndarray:
        """Return the pose of a ping ``(1, 6)``."""
        return np.array([[0.01 * ping, 0.002 * ping, 2.5, np.radians(35), 0, 0]])


def main() -> None:
    """Print the table, or everything as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print for programs")
    parser.add_argument("--quick", action="store_true", help="each once: within a minute")
    parser.add_argument("--variant", help="Mitsuba variant, e.g. cuda_ad_mono")
    arguments = parser.parse_args()
    ensure_variant(arguments.variant)
    rows = [measured(case, model, 1 if arguments.quick else 15) for case in cases() for model in ("physical", "coherent")]
    result = {"machine": machine(), "rows": rows}
    print(json.dumps(result, indent=2) if arguments.json else table(result))


def cases() -> list[Case]:
    """Return the scenes."""
    didson = preset("didson300")
    return [Case("objects", load_scene("objects"), didson), Case("tank", tank(), didson, tank_mirrors())]


def tank_mirrors() -> dict[str, tuple[float, float]]:
    """Return the mirrors of :func:`tank`."""
    return {"surface": (-1.0, 0.0), **{f"wall{number}": SMOOTH for number in range(4)}}


def tank() -> mi.Scene:
    """Return a tank of 6 x 7 m, 4 m deep, with a rough floor and three balls on it."""
    import mitsuba as mi

    def plate(position: list[float], normal: list[float], reflectance: float) -> dict[str, Any]:
        up = [0, 1, 0] if normal[2] else [0, 0, 1]
        look = mi.ScalarTransform4f().look_at(
            origin=position, target=[a + n for a, n in zip(position, normal, strict=True)], up=up
        )
        grey = {"type": "diffuse", "reflectance": {"type": "uniform", "value": reflectance}}
        return {"type": "rectangle", "to_world": look @ mi.ScalarTransform4f().scale(8), "bsdf": grey}

    walls: list[tuple[list[float], list[float]]] = [
        ([3, 2, 2], [-1, 0, 0]),
        ([-3, 2, 2], [1, 0, 0]),
        ([0, 4.5, 2], [0, -1, 0]),
        ([0, -2.5, 2], [0, 1, 0]),
    ]
    scene: dict[str, Any] = {f"wall{number}": plate(*wall, 0.05) for number, wall in enumerate(walls)}
    scene |= {"floor": plate([0, 0, 0], [0, 0, 1], 0.05), "surface": plate([0, 0, 4], [0, 0, -1], 0.05)}
    for number, position in enumerate(([-0.4, 3.0, 0.15], [0.3, 3.5, 0.15], [0.7, 2.8, 0.15])):
        grey = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.2}}
        scene[f"ball{number}"] = {"type": "sphere", "center": position, "radius": 0.15, "bsdf": grey}
    loaded = mi.load_dict({"type": "scene", **scene}, optimize=False)  # merged meshes would lose their ids
    assert isinstance(loaded, mi.Scene)
    return loaded


def measured(case: Case, model: str, repeats: int) -> dict[str, Any]:
    """Measure one case in one model: milliseconds by the number of reflections."""
    sonar = case.sonar.replace(model=model, bounces=1, pattern="two_way" if model == "coherent" else "box")
    works = {}
    for bounces in (1, 2, 3):
        mirrors = case.mirrors if bounces > 1 or model == "coherent" else None
        works[bounces] = partial(rendered, Simulator(case.scene, sonar.replace(bounces=bounces), mirrors=mirrors), case)
    times: dict[int, list[float]] = {bounces: [] for bounces in works}
    for ping in range(repeats + 2):  # two rounds of warming up
        for bounces, work in works.items():
            begun = time.process_time()
            work(ping)
            times[bounces].append(1000 * (time.process_time() - begun))
    return {"case": case.name, "model": model, "cpu": {b: float(np.median(values[2:])) for b, values in times.items()}}


def rendered(simulator: Simulator, case: Case, ping: int) -> object:
    """Render one ping of a case."""
    return next(iter(simulator.pings(case.pose(ping), first=ping)))


def table(result: dict[str, Any]) -> str:
    """Format the result as Markdown."""
    m = result["machine"]
    lines = [
        f"{m['cpu']}, {m['cores']} cores, {m['variant']}, Mitsuba {m['mitsuba']}, {m['date']}",
        "",
        f"| ms of CPU a ping, didson300 | model | one | two | three | two / one, at most {TARGET:g} | three / one |",
        "|---" * 7 + "|",
    ]
    for row in result["rows"]:
        one, two, three = row["cpu"].values()
        lines.append(
            f"| {row['case']} | {row['model']} | {one:.1f} | {two:.1f} | {three:.1f} | {two / one:.2f} | {three / one:.2f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
