"""Pictures of ``bench_trajectories.py``: mosaics along true and estimated paths, and the errors of the paths."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from trajectory_jobs import NOISE_OF, RECIPES, Job, trajectory_job

from mitsonar.io.files import write_atomic
from mitsonar.mapping.mosaic import ILLUMINATION_FRAMES, Blend, Mosaic, MosaicOptions, build_mosaic, illumination
from mitsonar.motion.errors import AXES, in_units
from mitsonar.motion.trajectory import Trajectory
from mitsonar.plotting.fans import GAMMA
from mitsonar.records.frames import SonarFrames

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw(out: Path, pictures: Path, frames: int) -> None:
    """Draw mosaics along true and estimated paths, and the errors of the paths."""
    pictures.mkdir(parents=True, exist_ok=True)
    for model in RECIPES:
        save_small(pictures / f"pattern_mosaics_{model}.png", pattern_figure(out, model, frames))
    save_small(pictures / "rocky_mosaics.png", rocky_figure(out, frames))
    save_small(pictures / "trajectory_errors.png", drift_figure(out, frames))


def save_small(path: Path, figure: Figure) -> None:
    """Save a PNG of 160 colours. Noise does not compress, and true colour would be three times the size."""
    from PIL import Image

    drawn, small = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=75)
    Image.open(drawn).convert("RGB").quantize(160, method=Image.Quantize.MAXCOVERAGE).save(
        small, format="png", optimize=True
    )
    write_atomic(path, small.getvalue())


def paths_of(out: Path, job: Job, name: str) -> tuple[SonarFrames, dict[str, Trajectory]]:
    """Load frames, true and estimated path of a run."""
    frames = SonarFrames.load(out / f"{trajectory_job(job.run, job.model, job.frames).name}-frames.npz")
    assert frames.poses is not None
    path = Trajectory.load_tum(out / f"{job.name}-{name}.tum")
    return frames, {"true": Trajectory(frames.poses, frames.time_s), "estimated": path}


def mosaic_along(frames: SonarFrames, path: Trajectory, blend: Blend = "weighted") -> Mosaic:
    """Build the mosaic of all frames along a path, with the illumination compensated."""
    some = frames.select(np.unique(np.linspace(0, len(frames) - 1, ILLUMINATION_FRAMES).astype(int)))
    return build_mosaic(frames, path.poses, frames.height_m, MosaicOptions(0.015, blend), illumination=illumination(some))


def draw_network(out: Path, pictures: Path, frames: int, method: str) -> None:
    """Draw figures 3.7 and 3.8: paths of a network over the rocky field, and the mosaic along the first."""
    from matplotlib.figure import Figure

    pictures.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(17.0, 6.5), layout="constrained")
    axes = figure.subplots(1, 3, width_ratios=(12.8, 4, 4))
    name = ""
    for panel, run in zip(axes, ("sideways", "forward", "braking"), strict=True):
        job = trajectory_job(run, "thesis", frames, method=method)
        result, paths = paths_of(out, job, "raw")
        show(panel, mosaic_along(result, paths["estimated"], "centre"), paths)  # of 24 beams, as in figure 3.7
        end = np.linalg.norm(paths["estimated"].poses[-1, :2] - paths["true"].poses[-1, :2])
        length = np.linalg.norm(np.diff(paths["true"].poses[:, :2], axis=0), axis=1).sum()
        panel.set_title(f"{run}, {length:.1f} m:\nends {end:.2f} m off, {100 * end / length:.1f} %")
        name = job.name.split("-rocky-field-")[1].split("-thesis")[0]
    figure.suptitle(f"{method} from frame to frame, rocky field, model `thesis`, no noise; mosaics along estimated paths")
    save_small(pictures / f"paths_{name}.png", figure)


def draw_errors(out: Path, pictures: Path, job: Job) -> None:
    """Draw figure 2.7: absolute errors of the pairs along trajectory 2."""
    from matplotlib.figure import Figure

    pictures.mkdir(parents=True, exist_ok=True)
    with np.load(out / f"{job.name}.npz") as table:
        error = np.abs(in_units(table["motion"] - table["true"]))
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    for panel, axis, values in zip(figure.subplots(3, 1, sharex=True), AXES, error.T, strict=True):
        panel.plot(job.every * np.arange(len(values)), values, linewidth=0.8)
        panel.set(ylabel=f"{axis.name} ({axis.unit})")
        panel.grid(alpha=0.3)
    panel.set_xlabel("pair")
    figure.suptitle(f"absolute errors, {job.method}, {job.run}, {job.texture} seabed, noise {job.noise}")
    save_small(pictures / "pair_errors.png", figure)


def pattern_figure(out: Path, model: str, frames: int) -> Figure:
    """Draw mosaics of both runs over the pattern: true poses left, estimated poses right."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 12.0), layout="constrained")
    for row, run in enumerate(("diagonal", "legs")):
        maps = {}
        result, paths = paths_of(out, trajectory_job(run, model, frames), "Kalman")
        maps["true poses"] = result, {"true": paths["true"]}, paths["true"]
        maps["direct, Kalman"] = result, paths, paths["estimated"]
        for column, (name, (result, paths, path)) in enumerate(maps.items()):
            axes = figure.add_subplot(2, 2, 2 * row + column + 1)
            show(axes, mosaic_along(result, path), paths)
            axes.set(xlim=(-4.0, 4.5), ylim=(-5.2, 2.8), title=f"{run}: {name}")
    figure.suptitle(f"{model} model, Gaussian seabed, noise of chapter 2")
    return figure


def rocky_figure(out: Path, frames: int) -> Figure:
    """Draw mosaics of the runs over the rocky field: sideways along true and estimated poses, the others along estimated."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(17.0, 10.5), layout="constrained")
    grid = figure.add_gridspec(2, 3, width_ratios=(12.8, 4, 4))
    panels = [("sideways", "true", grid[0, 0]), ("sideways", "estimated", grid[1, 0])]
    panels += [("forward", "estimated", grid[:, 1]), ("braking", "estimated", grid[:, 2])]
    for run, name, cell in panels:
        result, paths = paths_of(out, trajectory_job(run, "thesis", frames), "raw")
        axes = figure.add_subplot(cell)
        show(axes, mosaic_along(result, paths[name]), paths)
        axes.set_title(f"{run}, {name} poses")
    figure.suptitle("rocky field, model `thesis`, no noise; direct, frame by frame")
    return figure


COLOURS = {"true": "limegreen", "estimated": "red"}


def show(axes: Axes, mosaic: Mosaic, paths: dict[str, Trajectory]) -> None:
    """Draw a mosaic with paths over it."""
    from matplotlib.colors import PowerNorm

    level = mosaic.mean
    norm = PowerNorm(GAMMA, vmin=0, vmax=float(np.nanpercentile(level, 99.7)))
    axes.set_facecolor("0.9")
    axes.imshow(level, extent=mosaic.extent, cmap="copper", norm=norm, interpolation="antialiased")
    for name, path in paths.items():
        width = 3.0 if name == "true" else 1.2
        axes.plot(path.poses[:, 0], path.poses[:, 1], color=COLOURS[name], linewidth=width, label=name)
    axes.set(xlabel="x, east (m)", ylabel="y, north (m)", aspect="equal")
    axes.legend(loc="best", fontsize="small")


def drift_figure(out: Path, frames: int) -> Figure:
    """Draw the errors along and across the path and of the heading, over the distance."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 8.0), layout="constrained")
    runs = [run for run in NOISE_OF if run != "legs"]
    axes = figure.subplots(3, len(runs), sharex="col", squeeze=False)
    for column, run in enumerate(runs):
        for model, colour in (("thesis", "tab:blue"), ("physical", "tab:orange")):
            _, paths = paths_of(out, trajectory_job(run, model, frames), "raw")
            true, off = paths["true"].poses, paths["estimated"].poses - paths["true"].poses
            step = np.diff(true[:, :2], axis=0)
            way = np.concatenate([[0], np.cumsum(np.linalg.norm(step, axis=1))])
            ahead = step[0] / np.linalg.norm(step[0])
            values = (1e3 * off[:, :2] @ ahead, 1e3 * off[:, :2] @ [ahead[1], -ahead[0]], np.degrees(off[:, 5]))
            for row, value in enumerate(values):
                axes[row, column].plot(way, value, color=colour, label=f"direct, {model}")
        axes[0, column].set_title(f"{run}, noise: {NOISE_OF[run]}")
        axes[2, column].set_xlabel("driven (m)")
    for row, name in enumerate(("along the way (mm)", "to starboard of it (mm)", "heading (deg)")):
        axes[row, 0].set_ylabel(name)
    for one in axes.flat:
        one.grid(alpha=0.3)
    for one in (axes[0, 0], axes[0, -1]):
        one.legend(fontsize="small")
    return figure
