"""Overview of a data set: a sheet of samples, labels and mean image, and a table of its contents."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.config.data import array_names
from mitsonar.errors import MitsonarError, counted, nearest_names
from mitsonar.plotting.response_sheet import response_sheet

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from mitsonar.datasets.store import DataStore

__all__ = ["info", "sheet_figure"]

SAMPLED_FRAMES = 200
"""Frames that means are taken over, about."""

Table: TypeAlias = dict[str, Any]
"""Contents of a data set by name: numbers, words, lists of words, or tables of them."""

Stored: TypeAlias = "NDArray[np.uint8] | NDArray[np.float32]"
"""Pixels or vectors as they are stored."""


def sheet_figure(store: DataStore, *, samples: int = 4, view: str | None = None, seed: int = 0) -> Figure:
    """Draw samples with their labels, the distribution of the labels, and the mean image.

    Data sets of responses get a :func:`~mitsonar.plotting.response_sheet.response_sheet`.

    Args:
        store: the data set.
        samples: number of samples to draw.
        view: name of a view or receiver; default: the first.
        seed: of the draw of the samples.

    Raises:
        MitsonarError: no such view, or no sequence with the recipe's number of frames.
    """
    if store.recipe.channel is not None:
        return response_sheet(store, samples=samples, receiver=view, seed=seed)
    names = {v: name for name, (kind, v) in array_names(store.recipe).items() if kind == store.recipe.kinds[0]}
    view = view or next(iter(names))
    if view not in names:
        raise MitsonarError(f"unknown view {view}: {nearest_names(view, names)}")
    frames, name = store.recipe.frames, names[view]
    sequence = store.read("sequence")
    first = np.arange(max(0, len(sequence) - frames + 1))
    first = first[sequence[first] == sequence[first + frames - 1]]
    if not len(first):
        raise MitsonarError(f"{store.place.url} has no {frames} frames in one sequence: nothing to show")
    shown = np.sort(np.random.default_rng(seed).choice(first, size=min(samples, len(first)), replace=False))
    columns = max(frames + 2, 4)
    figure = Figure(figsize=(3.1 * columns, 2.8 * (len(shown) + 1)), layout="constrained")
    axes = figure.subplots(len(shown) + 1, columns, squeeze=False)
    for row, start in enumerate(shown):
        for place in range(columns):
            _sample(axes[row, place], store, name, view, int(start), place, frames)
    _summary(axes[-1], store, name, view)
    figure.suptitle(
        f"{store.recipe.name}, view {view}: {counted(len(store), 'frame')} in "
        f"{counted(store.about['sequences'], 'sequence')}"
    )
    return figure


def _extent(store: DataStore, view: str) -> tuple[float, float, float, float]:
    """Return bearing [deg] and range [m] at the borders of an image, nearest at the bottom."""
    shown = next(v for v in store.recipe.views if v.name == view)
    port, starboard = np.degrees(shown.bearing_rad[[0, -1]])
    return float(port), float(starboard), shown.sonar.range_min, shown.sonar.range_max


def _draw(axes: Axes, store: DataStore, values: NDArray[np.float64], view: str, title: str, *, top: float = 1.0) -> None:
    """Draw an image with gamma 0.6 and ``top`` white, or a vector as a line; axes in degrees and metres."""
    if values.ndim == 1:
        axes.plot(store.read("range_m"), values, lw=0.7)
        axes.set(xlabel="range (m)", ylabel="sum of levels")
    else:
        norm = PowerNorm(0.6, vmin=0, vmax=top)
        axes.imshow(values, extent=_extent(store, view), origin="lower", aspect="auto", cmap="copper", norm=norm)
        axes.set(xlabel="bearing (deg)", ylabel="range (m)")
    axes.set_title(title, fontsize=8)


def _levels(values: Stored) -> NDArray[np.float64]:
    """Return pixels as fractions of the maximum; vectors as they are."""
    return np.asarray(values, dtype=float) / (255 if values.dtype == np.uint8 else 1)


def _sample(axes: Axes, store: DataStore, name: str, view: str, start: int, place: int, frames: int) -> None:
    """Draw one panel of a sample: a frame, after the last frame the difference, then the label."""
    if place < frames:
        title = f"frame {start + place}, scene {store.read('scene')[start + place]}"
        _draw(axes, store, _levels(store.read(name, start + place)), view, title)
    elif place == frames and frames > 1:
        first, last = (_levels(store.read(name, frame)) for frame in (start, start + frames - 1))
        if first.ndim == 1:
            axes.plot(store.read("range_m"), last - first, lw=0.7)
        else:
            axes.imshow(
                last - first, extent=_extent(store, view), origin="lower", aspect="auto", cmap="RdBu_r", vmin=-0.3, vmax=0.3
            )
        axes.set_title("last minus first" + (" (+-0.3)" if first.ndim == 2 else ""), fontsize=8)
    else:
        axes.axis("off")
        if place == min(frames + 1, 2 * frames):
            axes.text(
                0, 0.5, _label(store, start, frames), fontsize=9, va="center", family="monospace", transform=axes.transAxes
            )


def _label(store: DataStore, start: int, frames: int) -> str:
    """Return motion and height of a sample in words."""
    motion, height = store.read("motion")[start], store.read("height_m")[start]
    text = f"over z = 0  {store.read('pose')[start, 2]:.3f} m\nover what is below {height:.3f} m"
    if frames == 1:
        return text
    sideways, forward, yaw = 1e3 * motion[0], 1e3 * motion[1], np.degrees(motion[2])
    return f"sideways {sideways:+.2f} mm\nforward  {forward:+.2f} mm\nyaw {yaw:+.3f} deg\n{text}"


def _summary(axes: NDArray[np.object_], store: DataStore, name: str, view: str) -> None:
    """Draw the mean image, and histograms of the labels."""
    mean = _levels(_sampled(store, name)).mean(axis=0)
    top = float(mean.max()) or 1.0
    _draw(axes[0], store, mean, view, "mean of frames" + (f" (white {top:.3g})" if mean.ndim == 2 else ""), top=top)
    motion = store.read("motion")
    motion = motion[~np.isnan(motion).any(axis=1)]
    if len(motion):
        columns = [motion[:, 0] * 1e3, motion[:, 1] * 1e3, np.degrees(motion[:, 2])]
        names = ["sideways (mm)", "forward (mm)", "yaw (deg)"]
    else:
        columns, names = [store.read("pose")[:, 2]], ["height (m)"]
    for place, axis in enumerate(axes[1:]):
        if place < len(columns):
            axis.hist(columns[place], bins=40, color="0.4")
            axis.set(xlabel=names[place], ylabel="frames")
        else:
            axis.axis("off")


def _sampled(store: DataStore, name: str) -> Stored:
    """Read some frames of the whole data set: whole chunks, evenly spread."""
    chunk = int(store.about["chunk_frames"])
    starts = np.arange(0, len(store), chunk)
    some = starts[np.unique(np.linspace(0, len(starts) - 1, max(1, SAMPLED_FRAMES // chunk)).astype(int))]
    return np.concatenate([store.read(name, slice(start, start + chunk)) for start in some])


def _level(store: DataStore, name: str, view: str) -> Table:
    """Measure the part of the pixels with an echo, their mean level, and its ratio to the scale of each noise."""
    some = _levels(_sampled(store, name))
    if some.ndim == 2:  # sums over the beams
        beams = next(len(v.bearing_rad) for v in store.recipe.views if v.name == view)
        echoes, pixels = int(_sampled(store, name.replace("vector", "nonzero", 1)).sum()), some.size * beams
    else:
        echoes, pixels = int(np.count_nonzero(some)), some.size
    mean = float(some.sum()) / max(echoes, 1)
    noise = {model: mean / NOISE_MODELS[model].scale for model in ("low", "high", "chapter2")}
    return {"filled": echoes / pixels, "signal_mean": mean, "signal_over_noise": noise}


def _levels_of(store: DataStore) -> Table:
    """Measure the level of each view of a finished data set."""
    names = array_names(store.recipe).items() if store.finished else ()
    return {view: _level(store, name, view) for name, (kind, view) in names if kind == store.recipe.kinds[0]}


def info(store: DataStore) -> Table:
    """Describe the contents of a data set by name; values are numbers, words, or tables of them."""
    about, sizes = store.about, store.place.sizes()
    arrays = {}
    for name, stored in store.modality.stored.items():
        if stored.shape:
            size = sum(size for key, size in sizes.items() if key.startswith(f"{name}/"))
            shape = "x".join(map(str, (len(store), *stored.shape)))
            arrays[name] = f"{shape} {stored.kind}, {size / max(len(store), 1):,.0f} bytes a {store.modality.what}"
    done = int((store.seals().any(axis=(1, 2))).sum())
    return {
        "name": store.recipe.name,
        "about": store.recipe.about,
        "finished": store.finished,
        "shards": f"{done} of {store.shards}",
        "frames": len(store),
        "sequences": about["sequences"],
        "scenes": len(about["scenes"]),
        "model": store.modality.sonar.model,
        "sonar": store.modality.sonar.name,
        **({"views": list(about["views"])} if "views" in about else {"receivers": about["receivers"]}),
        "seed": store.recipe.seed,
        **{name: about[name] for name in ("gain",) if name in store.modality.settled},
        "bytes": sum(sizes.values()),
        "arrays": arrays,
        **({"levels": _levels_of(store)} if store.recipe.channel is None else {}),
        "variant": about["variant"],
        "versions": about["versions"],
    }
