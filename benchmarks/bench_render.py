"""How fast frames are rendered, beside the ray tracer alone and beside what a user would write with Open3D.

    python benchmarks/bench_render.py [--json] [--quick] [--variant cuda_ad_mono]

Every figure is a median within one run; rows that are compared take turns. `limit` is `ray_intersect_preliminary` on the
same rays, made in the same launch, and nothing else. `equal rays`: the physical model with one ray across a beam. Open3D is
the extra `bench`; its column may stay empty (`--without-open3d`, `--quick`).
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import date
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rocky_seabed import Seabed, mitsuba_scene, poses_over, rocky_seabed

import mitsonar
from mitsonar.simulation.device import backend, ensure_variant

if TYPE_CHECKING:
    import mitsuba as mi

GRIDS = ((96, 700, 200), (512, 114, 200), (3000, 461, 20))
"""Beams, rays a beam, poses a launch."""
DrJit = Any
"""A Dr.Jit array of the active variant, or a structure or scene of it."""

Row = dict[str, Any]
"""One row of a result: numbers and texts by name."""


class Size(NamedTuple):
    """How much is done.

    Attributes:
        a_side: rocks of a kind along an edge of the seabed.
        part: one of so many poses of `GRIDS`.
        repeats: of each figure.
        error: rms error of the bins that is to be reached.
        exact: rays a beam that count as the truth.
        frames: numbers of frames of the runs whose memory is measured.
    """

    a_side: int
    part: int
    repeats: int
    error: float
    exact: int
    frames: tuple[int, int]


FULL = Size(52, 1, 7, 0.01, 200_000, (100, 10_000))
QUICK = Size(8, 20, 1, 0.05, 20_000, (3, 9))


def main() -> None:
    """Print the tables, or everything as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print for programs")
    parser.add_argument("--quick", action="store_true", help="a small seabed, few poses, once: within a minute")
    parser.add_argument("--without-open3d", action="store_true", help="leave its column empty where it is not installed")
    parser.add_argument("--variant", help="Mitsuba variant, e.g. cuda_ad_mono")
    parser.add_argument("--frames-memory", type=int, nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.frames_memory:
        return render_for_memory(*args.frames_memory)
    ensure_variant(args.variant)
    size = QUICK if args.quick else FULL
    if not (args.quick or args.without_open3d) and (fault := open3d_fault()):
        parser.error(f"Open3D cannot be loaded ({fault}): pip install 'mitsonar[bench]', or give --without-open3d")
    seabed = rocky_seabed(size.a_side)
    scene = mitsuba_scene(seabed)
    result: Row = {"machine": machine(), "triangles": len(seabed.faces) + 2, "batch": [], "single": []}
    for beams, rays, poses in GRIDS:
        result["batch"].append(batch(scene, seabed, beams, rays, max(2, poses // size.part), size.repeats))
        note(result["batch"][-1])
        result["single"].append(single(scene, beams, rays, size.repeats * 10))
        note(result["single"][-1])
    result["one_percent"] = one_percent(size)
    note(result["one_percent"])
    result["memory"] = [memory(frames) for frames in size.frames]
    print(json.dumps(result, indent=2) if args.json else tables(result))


def note(what: object) -> None:
    """Progress, out of the way of what is printed."""
    print(what, file=sys.stderr, flush=True)


def machine() -> Row:
    """Describe the machine and the versions."""
    import os

    names = [line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line]
    result = backend()
    return {
        "cpu": names[0] if names else platform.machine(),
        "cores": os.cpu_count(),
        "variant": result.variant,
        "llvm": result.llvm and ".".join(map(str, result.llvm)),
        "mitsuba": __import__("mitsuba").__version__,
        "date": date.today().isoformat(),
    }


def instrument(beams: int, rays: int, model: str) -> mitsonar.Sonar:
    """Return a sonar with the window and field of view of the DIDSON, this grid, and one ray across a beam."""
    return mitsonar.Sonar(beams=beams, rays_per_beam=rays, rays_across=1, model=model)


def medians(work: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median seconds of each, taking turns, after two rounds that do not count."""
    times: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(repeats + 2):
        for name, call in work.items():
            start = time.perf_counter()
            call()
            times[name].append(time.perf_counter() - start)
    return {name: float(np.median(values[2:])) for name, values in times.items()}


def limit(scene: mi.Scene, sonar: mitsonar.Sonar, poses: np.ndarray) -> Callable[[], None]:
    """Return a function that traces the rays of these poses alone, as one frozen launch."""
    import drjit as dr

    from mitsonar.simulation.tracing import Rays, Tracer

    tracer = Tracer(scene, sonar)
    rows, keys, _ = tracer.inputs(poses, range(len(poses)))

    index = Rays.numbered(sonar, len(poses))

    @dr.freeze
    def launch(index: DrJit, scene: DrJit, rows: DrJit, keys: DrJit) -> DrJit:
        rays = Rays(sonar, index)
        ray, _ = tracer.rays_of(rays, rows, keys)
        return scene.ray_intersect_preliminary(ray, coherent=True).t

    def call() -> None:
        dr.eval(launch(index, scene, rows, keys))
        dr.sync_thread()

    return call


def batch(scene: mi.Scene, seabed: Seabed, beams: int, rays: int, count: int, repeats: int) -> Row:
    """Rays a second of the limit, of both models with their images in NumPy, and of Open3D with NumPy binning."""
    poses = poses_over(count)
    thesis, physical = (instrument(beams, rays, model) for model in ("thesis", "physical"))
    simulators = [mitsonar.Simulator(scene, sonar, rays_per_launch=2**31) for sonar in (thesis, physical)]
    few = poses[: max(2, min(10, count, 2_000_000 // thesis.rays))]
    work: dict[str, Callable[[], object]] = {
        "limit": limit(scene, thesis, poses),
        "limit, jittered rays": limit(scene, physical, poses),
        "thesis": lambda: list(simulators[0].pings(poses)),
        "physical": lambda: list(simulators[1].pings(poses)),
    }
    if open3d_fault() is None:
        open3d = open3d_frames(seabed, thesis)
        work["open3d"] = lambda: [open3d(pose) for pose in few]
    seconds = medians(work, repeats)
    rate = {name: (len(few) if name == "open3d" else count) * thesis.rays / s / 1e6 for name, s in seconds.items()}
    rate.setdefault("open3d", float("nan"))
    return {
        "grid": f"{beams} x {rays}",
        "poses": count,
        "million rays a second": rate,
        "thesis / limit": rate["thesis"] / rate["limit"],
        "physical / limit": rate["physical"] / rate["limit"],
        "thesis / open3d": rate["thesis"] / rate["open3d"],
        "physical / open3d": rate["physical"] / rate["open3d"],
    }


def single(scene: mi.Scene, beams: int, rays: int, repeats: int) -> Row:
    """Milliseconds of one ping, image in NumPy, beside one bare trace."""
    poses = poses_over(1)
    sonars = [instrument(beams, rays, model) for model in ("thesis", "physical")]
    simulators = [mitsonar.Simulator(scene, sonar) for sonar in sonars]
    work: dict[str, Callable[[], object]] = {
        "limit": limit(scene, sonars[0], poses),
        "thesis": lambda: next(simulators[0].pings(poses)),
        "physical": lambda: next(simulators[1].pings(poses)),
    }
    ms = {name: 1000 * s for name, s in medians(work, repeats).items()}
    ratios = {f"{name} / limit": ms[name] / ms["limit"] for name in ("thesis", "physical")}
    return {"grid": f"{beams} x {rays}", "ms": ms, **ratios}


@cache
def open3d_fault() -> str | None:
    """Return why Open3D, or a system library that it needs, cannot be loaded; None if it can."""
    try:
        import open3d  # noqa: F401
    except (ImportError, OSError) as error:
        return str(error).splitlines()[0]
    return None


def open3d_frames(seabed: Seabed, sonar: mitsonar.Sonar) -> Callable[[np.ndarray], np.ndarray]:
    """Return a baseline in Open3D and NumPy: RaycastingScene, rays and bins, the model `thesis`."""
    import open3d as o3d

    from mitsonar.motion.pose import vehicle_rotation

    half = 15.0
    floor = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]], np.float32)
    tracer = o3d.t.geometry.RaycastingScene()
    rocks = tracer.add_triangles(o3d.core.Tensor(seabed.vertices), o3d.core.Tensor(seabed.faces))
    tracer.add_triangles(o3d.core.Tensor(floor), o3d.core.Tensor(np.array([[0, 1, 2], [0, 2, 3]], np.uint32)))
    cells = np.random.default_rng(0).random((2048, 2048), dtype=np.float32)
    azimuth, elevation = np.meshgrid(
        sonar.bearing_rad,
        (np.arange(sonar.rays_per_beam) + 0.5) / sonar.rays_per_beam * np.radians(sonar.elevation_fov_deg)
        - np.radians(sonar.elevation_fov_deg) / 2,
        indexing="ij",
    )
    way = [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)]
    local = np.stack(way, axis=-1).reshape(-1, 3).astype(np.float32)
    beam = np.repeat(np.arange(sonar.beams), sonar.rays_per_beam)

    def frame(pose: np.ndarray) -> np.ndarray:
        d = local @ vehicle_rotation(pose).as_matrix()[0].T.astype(np.float32)
        rays = np.concatenate([np.broadcast_to(pose[:3].astype(np.float32), d.shape), d], axis=1)
        hit = tracer.cast_rays(o3d.core.Tensor(rays))
        distance, normal = hit["t_hit"].numpy(), hit["primitive_normals"].numpy()
        cosine = np.abs(np.einsum("ij,ij->i", normal, d))
        with np.errstate(invalid="ignore"):
            point = pose[:2] + d[:, :2] * distance[:, None]
            uv = np.nan_to_num((point + half) / (2 * half) * 2048, nan=0, posinf=0, neginf=0).astype(int).clip(0, 2047)
        rock = hit["geometry_ids"].numpy() == rocks
        face = np.where(rock, hit["primitive_ids"].numpy(), 0)
        value = np.where(rock, seabed.reflectivity[face], cells[uv[:, 0], uv[:, 1]]) * cosine
        position = (distance - sonar.range_min) / sonar.bin_m
        inside = (position >= 0) & (position < sonar.range_bins)
        cell = position[inside].astype(int) * sonar.beams + beam[inside]
        size = sonar.range_bins * sonar.beams
        return np.bincount(cell, weights=value[inside], minlength=size).reshape(sonar.range_bins, -1)

    return frame


def one_percent(size: Size) -> Row:
    """Rays a beam, and milliseconds a ping, until a flat floor's bins err by 1 % rms, for points and for footprints.

    Raises:
        SystemExit: no number of rays is enough.
    """
    import mitsuba as mi

    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(100.0)}
    scene = mi.load_dict({"type": "scene", "floor": floor | {"bsdf": {"type": "diffuse", "reflectance": 0.5}}})
    pose = np.array([[0, 0, 2.5, np.radians(35), 0, 0]])
    result: Row = {}
    for name, changes in (
        ("thesis, points", {"model": "thesis"}),
        ("physical, footprints, jittered", {}),
        ("physical, footprints, grid", {"jitter": False}),
    ):
        for rays in (25, 50, 100, 200, 350, 700, 1400, 2800, 5600, 11200, 22400, 44800, 89600):
            sonar = mitsonar.Sonar(rays_per_beam=rays, **{"rays_across": 1, **changes})
            simulator = mitsonar.Simulator(scene, sonar)
            error = bin_error(next(simulator.pings(pose)).levels[0], simulator, size.exact)
            if error <= size.error:
                break
        else:
            raise SystemExit(f"{name}: the bins of a flat floor err by {error:.1%} rms with {rays} rays a beam")
        seconds = medians({"ping": lambda simulator=simulator: next(simulator.pings(pose))}, 3 * size.repeats)  # type: ignore[misc]
        result[name] = {"rays a beam": rays, "rms error": error, "ms": 1000 * seconds["ping"]}
    return result


def bin_error(levels: np.ndarray, simulator: mitsonar.Simulator, rays: int) -> float:
    """Relative rms error of the bins against the same beams with many rays."""
    sonar = simulator.sonar
    exact = sonar.replace(rays_per_beam=rays, model="physical", jitter=False, gain_exponent=0)
    if sonar.model == "thesis":  # C L a ray: the physical level with spreading undone, in rays instead of steradians
        exact = exact.replace(gain_exponent=2)
    truth = next(mitsonar.Simulator(simulator.tracer.scene, exact).pings([[0, 0, 2.5, np.radians(35), 0, 0]])).levels[0]
    lit = truth > 0
    whole = lit & np.roll(lit, 2, axis=0) & np.roll(lit, -2, axis=0)
    ratio = levels[whole] / truth[whole]
    return float(np.sqrt(np.mean((ratio / ratio.mean() - 1) ** 2)))


def memory(frames: int) -> Row:
    """Peak memory of a render to disk of so many frames, in a process of its own."""
    command = [sys.executable, __file__, "--frames-memory", str(frames), "100"]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return {"frames": frames, **json.loads(out)}


def render_for_memory(frames: int, rays: int) -> None:
    """Render frames over the seabed into a folder and print the peak memory of this process."""
    from mitsonar.acoustics.noise import NoiseModel
    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.simulation.runs import Destination, RenderOptions, run

    ensure_variant()
    sonar = instrument(96, rays, "physical").replace(range_bins=128)
    simulator = mitsonar.Simulator(mitsuba_scene(rocky_seabed()), sonar, rays_per_launch=2**20)
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        path = Trajectory(poses_over(frames), np.arange(frames) / 10)
        run(simulator, path, RenderOptions(NoiseModel()), Destination(Path(folder) / "run"))
    # not ru_maxrss: a child inherits its parent's
    status = Path("/proc/self/status").read_text()
    peak = int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))) / 1024
    print(json.dumps({"peak MiB": peak, "ms a frame, written": 1000 * (time.perf_counter() - start) / frames}))


def tables(result: Row) -> str:
    """Format the results as Markdown."""
    m = result["machine"]
    lines = [
        f"{m['cpu']}, {m['cores']} cores, {m['variant']}" + (f" (LLVM {m['llvm']})" if m["llvm"] else ""),
        f"Mitsuba {m['mitsuba']}, {m['date']}; {result['triangles']:,} triangles",
        "",
        "| beams x rays | poses a launch | limit, Mrays/s | thesis | physical | Open3D + NumPy | thesis / limit "
        "| physical / limit | thesis / Open3D |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in result["batch"]:
        rate = row["million rays a second"]
        lines.append(
            f"| {row['grid']} | {row['poses']} | {rate['limit']:.1f} | {rate['thesis']:.1f} | {rate['physical']:.1f} "
            f"| {rate['open3d']:.2f} | {row['thesis / limit']:.2f} | {row['physical / limit']:.2f} "
            f"| {row['thesis / open3d']:.1f} |"
        )
    lines += [
        "",
        "| one ping | bare trace, ms | thesis, ms | physical, ms | thesis / trace | physical / trace |",
        "|---" * 6 + "|",
    ]
    for row in result["single"]:
        ms = row["ms"]
        lines.append(
            f"| {row['grid']} | {ms['limit']:.2f} | {ms['thesis']:.2f} | {ms['physical']:.2f} "
            f"| {row['thesis / limit']:.2f} | {row['physical / limit']:.2f} |"
        )
    lines += ["", "| to a small rms bin error, 96 beams | rays a beam | rms error | ms a ping |", "|---|---|---|---|"]
    for name, row in result["one_percent"].items():
        lines.append(f"| {name} | {row['rays a beam']} | {100 * row['rms error']:.2f} % | {row['ms']:.1f} |")
    lines += ["", "| frames | peak memory, MiB | ms a frame, written |", "|---|---|---|"]
    for row in result["memory"]:
        lines.append(f"| {row['frames']:,} | {row['peak MiB']:.0f} | {row['ms a frame, written']:.1f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
