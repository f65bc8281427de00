"""Impulse responses: how fast they are made, and whether one alone betrays the velocity.

    python benchmarks/bench_impulse.py speed [--threads 2]
    python benchmarks/bench_impulse.py leak [--samples 100]
    python benchmarks/bench_impulse.py --quick           # both, over a field of 8 x 8 m

`speed`: responses a second of the standard configuration over a field of flat objects (50 x 50 m, 2048 x 2048 cells), 800
taps, some 50,000 echoes each, tracing included; the direct sum of eq. 5.15 beside it; memory after more and more of them;
and the time of the parts.

`leak`: an estimator that is given one response and knows nothing of the scene. It has a template of each velocity, the
response of a bare floor of one grey, and answers with the one most like the response. In the model `rays` it reads the
velocity from the pattern of the rays, which is the same every time; in `scatterers` it must be no better than zero.
"""

from __future__ import annotations

import argparse
import os
import platform
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar import ChannelSimulator, ChannelSonar, load_scene
from mitsonar.simulation.device import ensure_variant, use_threads
from mitsonar.worlds.families import create_family

if TYPE_CHECKING:
    import mitsuba as mi

HEIGHT_M, FASTEST, APART_S = 10.0, 2.0, 0.05


class Size(NamedTuple):
    """How much is done.

    Attributes:
        world: options of the fields of flat objects.
        pings: that rates and memory are measured with, before and after.
        repeats: of each rate.
        steps: velocities that are tried along each axis.
    """

    world: dict[str, Any]
    pings: tuple[int, int, int, int]
    repeats: int
    steps: int


FULL = Size({}, (48, 50, 100, 200), 6, 41)
QUICK = Size({"size_m": 24.0, "seabed_cells": 256, "rectangles": 20, "ellipses": 20}, (4, 2, 2, 2), 2, 9)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["speed", "leak"], nargs="?")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--samples", type=int, default=100, help="of the leak test")
    parser.add_argument("--rays", type=int, default=50_000, help="a receiver, of the leak test in the model rays")
    parser.add_argument("--quick", action="store_true", help="both, small: within a minute")
    arguments = parser.parse_args()
    if arguments.what is None and not arguments.quick:
        parser.error("say what: speed, leak, or --quick")
    ensure_variant()
    use_threads(arguments.threads)
    print(f"{cpu()}, {arguments.threads} threads, {time.strftime('%Y-%m-%d')}")
    size = QUICK if arguments.quick else FULL
    samples, rays = (5, 2000) if arguments.quick else (arguments.samples, arguments.rays)
    if arguments.quick or arguments.what == "speed":
        speed(size)
    if arguments.quick or arguments.what == "leak":
        for model in ("rays", "scatterers"):
            leak(ChannelSonar(model=model, rays=rays), samples, size)


def cpu() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores"


def field_of(seed: int, size: Size = FULL) -> mi.Scene:
    """Make a field of flat objects (Almanza-Medina, 5.4.1)."""
    with tempfile.TemporaryDirectory() as folder:
        path, parameters = create_family("flat-objects", **size.world).prepare(seed, Path(folder) / "world")
        return load_scene(path, **parameters)


def flights(count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses ``(n, 6)`` anywhere in the middle of a field and velocities ``(n, 4)``."""
    rng = np.random.default_rng(seed)
    poses, velocity = np.zeros((count, 6)), np.zeros((count, 4))
    poses[:, :2], poses[:, 2], poses[:, 5] = rng.uniform(-8, 8, (count, 2)), HEIGHT_M, rng.uniform(-np.pi, np.pi, count)
    velocity[:, :2] = rng.uniform(-FASTEST, FASTEST, (count, 2))
    return poses, velocity


# ---------------------------------------------------------------- speed


def speed(size: Size) -> None:
    """Rates, shares and memory."""
    scene = field_of(1, size)
    for model in ("scatterers", "rays"):
        sonar = ChannelSonar(model=model)
        begun = time.perf_counter()
        simulator = ChannelSimulator(scene, sonar)
        ready = time.perf_counter() - begun
        poses, velocity = flights(size.pings[0], 2)
        result = [rate_of(simulator, poses, velocity) for _ in range(size.repeats)][1:]
        rate, echoes = float(np.median([one[0] for one in result])), result[0][1]
        print(
            f"{model}: {rate:.0f} responses/s of {sonar.taps} taps from {echoes:,.0f} echoes each; scene ready in "
            f"{ready:.1f} s"
        )
        paths = simulator.paths(poses[0], velocity[0])
        direct = direct_seconds(paths.delay_s, paths.amplitude, sonar)
        print(f"  the direct sum of eq. 5.15 for one: {direct:.2f} s, {direct * rate:.0f} times as long as one response")
        shares(simulator, poses, velocity)
        sizes = [memory_after(simulator, pings) for pings in size.pings[1:]]
        pings = ", ".join(map(str, np.cumsum(size.pings[1:])))
        print(f"  largest memory after {pings} more pings: {', '.join(f'{mib:.0f}' for mib in sizes)} MiB")


def rate_of(simulator: ChannelSimulator, poses: NDArray[np.float64], velocity: NDArray[np.float64]) -> tuple[float, float]:
    """Responses a second, and their mean number of echoes."""
    begun = time.perf_counter()
    parts = list(simulator.pings(poses, velocity))
    seconds = time.perf_counter() - begun
    echoes = np.concatenate([part.echoes for part in parts])
    return echoes.size / seconds, float(echoes.mean())


def direct_seconds(delay: NDArray[np.float64], amplitude: NDArray[np.complex128], sonar: ChannelSonar) -> float:
    """Time of eq. 5.15 as written, frequency by frequency."""
    frequency = sonar.carrier_hz + np.arange(-360, 361) * sonar.frequency_step_hz
    begun = time.perf_counter()
    for one in frequency[::8]:
        np.exp(-2j * np.pi * one * delay) @ amplitude
    return 8 * (time.perf_counter() - begun)


def shares(simulator: ChannelSimulator, poses: NDArray[np.float64], velocity: NDArray[np.float64]) -> None:
    """Time of the parts of a response, each alone."""
    from mitsonar.simulation.channel import FOR_RESPONSES, impulse_response

    tracer = simulator.tracer
    received = simulator.paths(poses[0], velocity[0])
    parts: dict[str, Callable[[], object]] = {
        "which points": lambda: tracer.candidates(poses[0], 0),
        "these, tracing, delays": lambda: tracer.trace(poses[0], velocity[0], 0, FOR_RESPONSES),
        "transform (one thread)": lambda: impulse_response(received.delay_s, received.amplitude, simulator.sonar),
    }
    print("  " + ", ".join(f"{name} {1e3 * median_seconds(part):.2f} ms" for name, part in parts.items()))


def median_seconds(part: Callable[[], object]) -> float:
    times = []
    for _ in range(15):
        begun = time.perf_counter()
        part()
        times.append(time.perf_counter() - begun)
    return float(np.median(times))


def memory_after(simulator: ChannelSimulator, pings: int) -> float:
    """Largest memory of the process [MiB] after so many more pings, none of them kept."""
    poses, velocity = flights(pings, pings)
    for _ in simulator.pings(poses, velocity):
        pass
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


# ---------------------------------------------------------------- leak


def leak(sonar: ChannelSonar, samples: int, size: Size) -> None:
    """Errors of velocities read from one response alone, as displacements in 50 ms."""
    templates, tried = templates_of(sonar, size.steps)
    true, result = [], []
    for seed in range(5):
        simulator = ChannelSimulator(field_of(10 + seed, size), sonar)
        poses, velocity = flights(samples // 5, 100 + seed)
        response = np.concatenate([part.response for part in simulator.pings(poses, velocity)])
        result += [most_similar(one, templates, tried) for one in response]
        true += list(velocity[:, :2])
    error = 1e3 * APART_S * (np.array(result) - np.array(true))
    zero = 1e3 * APART_S * np.array(true)
    rmse, still = (np.sqrt((values**2).mean(axis=0)) for values in (error, zero))
    median = np.median(np.abs(error), axis=0)
    print(
        f"{sonar.model}: one response alone, {len(true)} samples: RMSE {rmse[0]:.1f} / {rmse[1]:.1f} mm sideways / forward, "
        f"median {median[0]:.1f} / {median[1]:.1f}; answering zero {still[0]:.1f} / {still[1]:.1f}"
    )


def templates_of(sonar: ChannelSonar, steps: int) -> tuple[NDArray[np.complex64], NDArray[np.float64]]:
    """Responses of a bare floor for each velocity ``(velocities, receivers, taps)``, of unit length, and the velocities."""
    import mitsuba as mi

    grey = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.5}}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(25), "bsdf": grey}
    simulator = ChannelSimulator(mi.load_dict({"type": "scene", "floor": floor}), sonar)
    axis = np.linspace(-FASTEST, FASTEST, steps)
    tried = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    velocity = np.pad(tried, ((0, 0), (0, 2)))
    poses = np.tile([0, 0, HEIGHT_M, 0, 0, 0], (len(tried), 1))
    response = np.concatenate([part.response for part in simulator.pings(poses, velocity)])
    return response / np.linalg.norm(response, axis=2, keepdims=True), tried


def most_similar(
    response: NDArray[np.complex64], templates: NDArray[np.complex64], tried: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the velocity whose template best correlates with a response ``(receivers, taps)``, with a parabola."""
    steps = round(len(tried) ** 0.5)
    similar = (np.abs(np.einsum("vrt,rt->vr", templates.conj(), response)) ** 2).sum(axis=1).reshape(steps, steps)
    best = np.array(np.unravel_index(similar.argmax(), similar.shape))
    answer = []
    for axis in (0, 1):
        line = similar[:, best[1]] if axis == 0 else similar[best[0]]
        peak = int(np.clip(best[axis], 1, steps - 2))
        low, mid, high = line[peak - 1 : peak + 2]
        curve = low - 2 * mid + high
        offset = float(np.clip(0.5 * (low - high) / curve, -1, 1)) if curve < 0 else 0.0
        answer.append(tried[0, 0] + (peak + offset) * 2 * FASTEST / (steps - 1))
    return np.array(answer)


if __name__ == "__main__":
    main()
