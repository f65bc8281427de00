"""What does a data set hold? Its sizes, arrays and levels as a table, and samples with their labels as a figure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.config.data import array_names
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError, count_noun, suggest_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["info", "sheet_figure"]


SAMPLED_FRAMES = 200
"""Approximate number of frames or pings that a mean is taken over."""

Table: TypeAlias = dict[str, Any]
"""Description of a data set: numbers, words, lists of words, or nested tables, keyed by name."""

Stored: TypeAlias = "NDArray[np.uint8] | NDArray[np.float32]"
"""Pixels or vectors in their stored type."""


def info(store: DataStore) -> Table:
    """Return a description of a data set: its state, sizes, arrays and levels, keyed by name."""
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
        **{name: about[name] for name in ("gain",) if name in store.modality.fixed_attributes},
        "bytes": sum(sizes.values()),
        "arrays": arrays,
        **({"levels": _level_table(store)} if store.recipe.channel is None else {}),
        "variant": about["variant"],
        "versions": about["versions"],
    }


def sheet_figure(store: DataStore, *, samples: int = 4, view: str | None = None, seed: int = 0) -> Figure:
    """Draw an overview of a data set: samples with their labels, the mean image, and the distribution of the labels.

    Of impulse responses, draw the first and last ping of each sample, the phase between them and its label, and in the last
    row the mean energy of the taps and the distribution of the labels.

    Args:
        store: data set to draw.
        samples: number of samples to draw.
        view: name of a view or receiver; default: the first.
        seed: seed of the choice of samples.

    Raises:
        MitsonarError: there is no such view, or no sequence with the recipe's number of frames.
    """
    if store.recipe.channel is not None:
        return _response_sheet(store, samples=samples, receiver=view, seed=seed)
    names = {v: name for name, (kind, v) in array_names(store.recipe).items() if kind == store.recipe.kinds[0]}
    view = view or next(iter(names))
    if view not in names:
        raise MitsonarError(f"unknown view {view}: {suggest_names(view, names)}")
    frames, name = store.recipe.frames, names[view]
    starts = _sample_starts(store, samples, seed)
    columns = max(frames + 2, 4)
    figure = Figure(figsize=(3.1 * columns, 2.8 * (len(starts) + 1)), layout="constrained")
    axes = figure.subplots(len(starts) + 1, columns, squeeze=False)
    for row, start in enumerate(starts):
        for column in range(columns):
            _sample(axes[row, column], store, name, view, start, column, frames)
    _summary(axes[-1], store, name, view)
    figure.suptitle(_title(store, f"view {view}"))
    return figure


def _sample_starts(store: DataStore, samples: int, seed: int) -> list[int]:
    """Return the first frames of samples drawn at random, in storage order."""
    frames, sequence = store.recipe.frames, store.read("sequence")
    first = np.arange(max(0, len(sequence) - frames + 1))
    # A sample starts where all of its frames belong to one sequence.
    first = first[sequence[first] == sequence[first + frames - 1]]
    if not len(first):
        raise MitsonarError(f"{store.place.url} has no {frames} {store.modality.what}s in one sequence: nothing to show")
    starts: list[int] = np.sort(np.random.default_rng(seed).choice(first, min(samples, len(first)), replace=False)).tolist()
    return starts


def _title(store: DataStore, part: str) -> str:
    """Return the title of an overview of a view or receiver."""
    size = f"{count_noun(len(store), store.modality.what)} in {count_noun(store.about['sequences'], 'sequence')}"
    return f"{store.recipe.name}, {part}: {size}"


# ---------------- Images


def _extent(store: DataStore, view: str) -> tuple[float, float, float, float]:
    """Return the limits of an image, bearing [deg] and range [m], as Matplotlib's extent with the nearest range below."""
    selected = next(v for v in store.recipe.views if v.name == view)
    port, starboard = np.degrees(selected.bearing_rad[[0, -1]])
    return float(port), float(starboard), selected.sonar.range_min, selected.sonar.range_max


def _draw(axes: Axes, store: DataStore, values: NDArray[np.float64], view: str, title: str, *, top: float = 1.0) -> None:
    """Draw an image with gamma 0.6 and ``top`` as white, or a vector as a line; axes in degrees and metres."""
    if values.ndim == 1:
        axes.plot(store.read("range_m"), values, lw=0.7)
        axes.set(xlabel="range (m)", ylabel="sum of levels")
    else:
        norm = PowerNorm(0.6, vmin=0, vmax=top)
        axes.imshow(values, extent=_extent(store, view), origin="lower", aspect="auto", cmap="copper", norm=norm)
        axes.set(xlabel="bearing (deg)", ylabel="range (m)")
    axes.set_title(title, fontsize=8)


def _levels(values: Stored) -> NDArray[np.float64]:
    """Return 8-bit pixels as fractions of 255, and other values unchanged."""
    return np.asarray(values, dtype=float) / (255 if values.dtype == np.uint8 else 1)


def _sample(axes: Axes, store: DataStore, name: str, view: str, start: int, column: int, frames: int) -> None:
    """Draw one panel of a sample: a frame, then the difference of the last and the first, then the label."""
    if column < frames:
        title = f"frame {start + column}, scene {store.read('scene')[start + column]}"
        _draw(axes, store, _levels(store.read(name, start + column)), view, title)
    elif column == frames and frames > 1:
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
        if column == min(frames + 1, 2 * frames):
            axes.text(
                0, 0.5, _label(store, start, frames), fontsize=9, va="center", family="monospace", transform=axes.transAxes
            )


def _label(store: DataStore, start: int, frames: int) -> str:
    """Return a text with the motion and the height of a sample."""
    motion, height = store.read("motion")[start], store.read("height_m")[start]
    text = f"over z = 0  {store.read('pose')[start, 2]:.3f} m\nover what is below {height:.3f} m"
    if frames == 1:
        return text
    sideways, forward, yaw = 1e3 * motion[0], 1e3 * motion[1], np.degrees(motion[2])
    return f"sideways {sideways:+.2f} mm\nforward  {forward:+.2f} mm\nyaw {yaw:+.3f} deg\n{text}"


def _summary(axes: NDArray[np.object_], store: DataStore, name: str, view: str) -> None:
    """Draw the mean image and histograms of the labels."""
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
    for column, axis in enumerate(axes[1:]):
        if column < len(columns):
            axis.hist(np.round(columns[column], 6), bins=40, color="0.4")  # equal but for rounding in one sequence
            axis.set(xlabel=names[column], ylabel="frames")
        else:
            axis.axis("off")


def _sampled(store: DataStore, name: str) -> Stored:
    """Read a sample of the frames: whole chunks, evenly spread over the data set."""
    chunk = int(store.about["chunk_frames"])
    starts = np.arange(0, len(store), chunk)
    selected = starts[np.unique(np.linspace(0, len(starts) - 1, max(1, SAMPLED_FRAMES // chunk)).astype(int))]
    return np.concatenate([store.read(name, slice(start, start + chunk)) for start in selected])


def _view_levels(store: DataStore, name: str, view: str) -> Table:
    """Measure the fraction of pixels with an echo, their mean level, and its ratio to the scale of each noise model."""
    levels = _levels(_sampled(store, name))
    if levels.ndim == 2:  # sums over the beams
        beams = next(len(v.bearing_rad) for v in store.recipe.views if v.name == view)
        echoes, pixels = int(_sampled(store, name.replace("vector", "nonzero", 1)).sum()), levels.size * beams
    else:
        echoes, pixels = int(np.count_nonzero(levels)), levels.size
    mean = float(levels.sum()) / max(echoes, 1)
    noise = {model: mean / NOISE_MODELS[model].scale for model in ("low", "high", "chapter2")}
    return {"filled": echoes / pixels, "signal_mean": mean, "signal_over_noise": noise}


def _level_table(store: DataStore) -> Table:
    """Measure the levels of each view of a data set, keyed by view; empty while the data set is unfinished."""
    names = array_names(store.recipe).items() if store.finished else ()
    return {view: _view_levels(store, name, view) for name, (kind, view) in names if kind == store.recipe.kinds[0]}


# ---------------- Impulse responses


def _response_sheet(store: DataStore, *, samples: int, receiver: str | None, seed: int) -> Figure:
    """Draw an overview of a data set of impulse responses, with the arguments of :func:`sheet_figure`."""
    names = [one.name for one in store.recipe.channel_sonar.receivers]
    receiver = receiver or names[0]
    if receiver not in names:
        raise MitsonarError(f"unknown receiver {receiver}: {suggest_names(receiver, names)}")
    starts = _sample_starts(store, samples, seed)
    figure = Figure(figsize=(13, 2.6 * (len(starts) + 1)), layout="constrained")
    axes = figure.subplots(len(starts) + 1, 3, squeeze=False)
    for row, start in zip(axes, starts, strict=False):
        _response_sample(row, store, names.index(receiver), start, store.recipe.frames)
    _response_summary(axes[-1], store, names)
    figure.suptitle(_title(store, f"receiver {receiver}"))
    return figure


def _response_sample(axes: NDArray[np.object_], store: DataStore, receiver: int, start: int, pings: int) -> None:
    """Draw the magnitudes, the phase from the first to the last ping where the response is strong, and the label."""
    delay_ms = 1e3 * store.read("delay_s")
    response = store.read("response", slice(start, start + pings))[:, receiver]
    for ping, style in ((0, "-"), (pings - 1, ":")):
        axes[0].plot(delay_ms, np.abs(response[ping]), style, lw=0.8, label=f"ping {start + ping}")
    axes[0].set(xlabel="delay (ms)", ylabel="magnitude", title=f"scene {store.read('scene')[start]}")
    axes[0].legend(fontsize=7)
    strong = np.abs(response[0]) > 0.1 * np.abs(response[0]).max(initial=0)
    phase_deg = np.degrees(np.angle(response[-1] * response[0].conj()))
    axes[1].plot(delay_ms[strong], phase_deg[strong], ".", ms=3)
    axes[1].set(xlabel="delay (ms)", ylabel="phase, first to last (deg)", ylim=(-180, 180))
    axes[2].axis("off")
    motion, pose = store.read("motion")[start], store.read("pose")[start]
    text = (
        f"a ping: sideways {1e3 * motion[0]:+.2f} mm\n        forward  {1e3 * motion[1]:+.2f} mm\n"
        f"        yaw {np.degrees(motion[2]):+.3f} deg\nover z = 0 {pose[2]:.3f} m"
    )
    axes[2].text(0, 0.5, text, fontsize=9, va="center", family="monospace", transform=axes[2].transAxes)


def _response_summary(axes: NDArray[np.object_], store: DataStore, names: list[str]) -> None:
    """Draw the mean energy of the taps of each receiver, and the distribution of the motions."""
    step = max(1, len(store) // SAMPLED_FRAMES)
    responses = store.read("response", slice(None, None, step))
    for receiver, name in enumerate(names):
        energy = _decibels((np.abs(responses[:, receiver]) ** 2).mean(axis=0))
        axes[0].plot(1e3 * store.read("delay_s"), energy, lw=0.8, label=name)
    axes[0].set(xlabel="delay (ms)", ylabel="mean energy (dB)", ylim=(-80, 3))
    axes[0].legend(fontsize=7)
    motion = store.read("motion")
    motion = motion[~np.isnan(motion).any(axis=1)]
    axes[1].plot(*(1e3 * motion[:, :2].T), ".", ms=2)
    axes[1].set(xlabel="sideways (mm a ping)", ylabel="forward (mm a ping)", aspect="equal")
    axes[2].hist(np.round(np.degrees(motion[:, 2]), 6), bins=40, color="0.4")
    axes[2].set(xlabel="yaw (deg a ping)", ylabel="pings")


def _decibels(energy: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return levels relative to the largest [dB]."""
    largest = energy.max() if energy.size and energy.max() > 0 else 1.0
    return np.asarray(10 * np.log10(np.maximum(energy / largest, 1e-12)))
