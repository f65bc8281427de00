"""Overview of a data set of impulse responses: pings of some samples, phase changes, labels and mean energy."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, counted, nearest_names

if TYPE_CHECKING:
    from mitsonar.datasets.store import DataStore

__all__ = ["response_sheet"]

SAMPLED_PINGS = 200
"""Pings that means are taken over, about."""


def response_sheet(store: DataStore, *, samples: int = 4, receiver: str | None = None, seed: int = 0) -> Figure:
    """Draw the first and last ping of samples, the phase between them and the label; below, mean energy and labels.

    Args:
        store: a data set of impulse responses.
        samples: number of samples to draw.
        receiver: its name; default: the first.
        seed: of the draw of the samples.

    Raises:
        MitsonarError: no such receiver, or no sequence with the recipe's number of pings.
    """
    names = [one.name for one in store.recipe.channel_sonar.receivers]
    receiver = receiver or names[0]
    if receiver not in names:
        raise MitsonarError(f"unknown receiver {receiver}: {nearest_names(receiver, names)}")
    pings, sequence = store.recipe.frames, store.read("sequence")
    first = np.arange(max(0, len(sequence) - pings + 1))
    first = first[sequence[first] == sequence[first + pings - 1]]
    if not len(first):
        raise MitsonarError(f"{store.place.url} has no {pings} pings in one sequence: nothing to show")
    shown = np.sort(np.random.default_rng(seed).choice(first, size=min(samples, len(first)), replace=False))
    figure = Figure(figsize=(13, 2.6 * (len(shown) + 1)), layout="constrained")
    axes = figure.subplots(len(shown) + 1, 3, squeeze=False)
    for row, start in zip(axes, shown.tolist(), strict=False):
        _sample(row, store, names.index(receiver), start, pings)
    _summary(axes[-1], store, names)
    figure.suptitle(
        f"{store.recipe.name}, receiver {receiver}: {counted(len(store), 'ping')} in "
        f"{counted(store.about['sequences'], 'sequence')}"
    )
    return figure


def _sample(axes: NDArray[np.object_], store: DataStore, receiver: int, start: int, pings: int) -> None:
    """Draw magnitudes, the phase from first to last ping where the response is strong, and the label."""
    delay_ms = 1e3 * store.read("delay_s")
    response = store.read("response", slice(start, start + pings))[:, receiver]
    for place, style in ((0, "-"), (pings - 1, ":")):
        axes[0].plot(delay_ms, np.abs(response[place]), style, lw=0.8, label=f"ping {start + place}")
    axes[0].set(xlabel="delay (ms)", ylabel="magnitude", title=f"scene {store.read('scene')[start]}")
    axes[0].legend(fontsize=7)
    loud = np.abs(response[0]) > 0.1 * np.abs(response[0]).max(initial=0)
    turned = np.degrees(np.angle(response[-1] * response[0].conj()))
    axes[1].plot(delay_ms[loud], turned[loud], ".", ms=3)
    axes[1].set(xlabel="delay (ms)", ylabel="phase, first to last (deg)", ylim=(-180, 180))
    axes[2].axis("off")
    motion, pose = store.read("motion")[start], store.read("pose")[start]
    text = (
        f"a ping: sideways {1e3 * motion[0]:+.2f} mm\n        forward  {1e3 * motion[1]:+.2f} mm\n"
        f"        yaw {np.degrees(motion[2]):+.3f} deg\nover z = 0 {pose[2]:.3f} m"
    )
    axes[2].text(0, 0.5, text, fontsize=9, va="center", family="monospace", transform=axes[2].transAxes)


def _summary(axes: NDArray[np.object_], store: DataStore, names: list[str]) -> None:
    """Draw the mean energy of the taps of each receiver, and the distribution of the motions."""
    every = max(1, len(store) // SAMPLED_PINGS)
    some = store.read("response", slice(None, None, every))
    for receiver, name in enumerate(names):
        energy = _decibels((np.abs(some[:, receiver]) ** 2).mean(axis=0))
        axes[0].plot(1e3 * store.read("delay_s"), energy, lw=0.8, label=name)
    axes[0].set(xlabel="delay (ms)", ylabel="mean energy (dB)", ylim=(-80, 3))
    axes[0].legend(fontsize=7)
    motion = store.read("motion")
    motion = motion[~np.isnan(motion).any(axis=1)]
    axes[1].plot(*(1e3 * motion[:, :2].T), ".", ms=2)
    axes[1].set(xlabel="sideways (mm a ping)", ylabel="forward (mm a ping)", aspect="equal")
    axes[2].hist(np.degrees(motion[:, 2]), bins=40, color="0.4")
    axes[2].set(xlabel="yaw (deg a ping)", ylabel="pings")


def _decibels(energy: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return levels over the largest [dB]."""
    largest = energy.max() if energy.size and energy.max() > 0 else 1.0
    return np.asarray(10 * np.log10(np.maximum(energy / largest, 1e-12)))
