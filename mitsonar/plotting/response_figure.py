"""Figures of impulse responses."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from mitsonar.errors import counted
from mitsonar.records.responses import ImpulseResponses

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["response_figure", "response_png", "waterfall_figure", "waterfall_png"]

FAINT_DB = -40.0
"""Lower end of the waterfall's scale [dB]."""


def response_figure(responses: ImpulseResponses, ping: int = 0) -> Figure:
    """Draw magnitude, real and imaginary part of one ping over taps and range (Almanza-Medina, fig. 5.4)."""
    from matplotlib.figure import Figure

    sonar, count = responses.sonar, len(responses.sonar.receivers)
    values = responses.response[ping] / max(float(np.abs(responses.response[ping]).max()), 1e-30)
    begin, end = _strong_taps(responses)
    figure = Figure(figsize=(9, 1.2 + 1.5 * count), layout="constrained")
    grid = figure.subplots(count, 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    taps = np.arange(begin, end)
    for axes, one, receiver in zip(grid, values, sonar.receivers, strict=True):
        axes.plot(taps, np.abs(one[begin:end]), color="black", lw=1.2, label="magnitude")
        axes.plot(taps, one[begin:end].real, color="tab:blue", lw=0.7, label="real")
        axes.plot(taps, one[begin:end].imag, color="tab:orange", lw=0.7, label="imaginary")
        axes.set_ylabel(receiver.name)
        axes.grid(alpha=0.3)
    per_m = 2 * sonar.sampling_hz / sonar.sound_speed
    above = grid[0].secondary_xaxis("top", functions=(lambda tap: tap / per_m, lambda range_m: range_m * per_m))
    above.set_xlabel("half the path's length (m)")
    grid[0].legend(loc="upper right", fontsize=8, ncols=3)
    grid[-1].set_xlabel(f"tap ({1e3 / sonar.sampling_hz:.4g} ms each)")
    figure.suptitle(_title(responses, f"ping {ping}, divided by the largest magnitude"), fontsize=10)
    return figure


def waterfall_figure(responses: ImpulseResponses) -> Figure:
    """Draw the magnitude over time and delay at each receiver, in dB of the largest."""
    from matplotlib.figure import Figure

    sonar, count = responses.sonar, len(responses.sonar.receivers)
    begin, end = _strong_taps(responses)
    level = np.abs(responses.response[:, :, begin:end])
    decibel = 20 * np.log10(np.maximum(level / max(float(level.max()), 1e-30), 10 ** (FAINT_DB / 20)))
    time = responses.time_s
    half = 0.5 * (time[1] - time[0]) if len(time) > 1 else 0.5 / sonar.frame_rate_hz
    # a row is drawn around its time
    extent = (1e3 * begin / sonar.sampling_hz, 1e3 * end / sonar.sampling_hz, time[-1] + half, time[0] - half)
    figure = Figure(figsize=(2.6 * count + 1.6, 4.5), layout="constrained")
    grid = figure.subplots(1, count, sharex=True, sharey=True, squeeze=False)[0]
    for number, (axes, receiver) in enumerate(zip(grid, sonar.receivers, strict=True)):
        shown = axes.imshow(
            decibel[:, number], extent=extent, aspect="auto", cmap="magma", vmin=FAINT_DB, vmax=0, interpolation="nearest"
        )
        axes.set(title=receiver.name, xlabel="delay (ms)")
    grid[0].set_ylabel("time (s)")
    figure.colorbar(shown, ax=list(grid), label="dB of the largest of all receivers", fraction=0.04)
    figure.suptitle(_title(responses, counted(len(responses), "ping")), fontsize=10)
    return figure


def response_png(responses: ImpulseResponses) -> bytes:
    """Return the PNG of :func:`response_figure` for the first ping."""
    return _png(response_figure(responses))


def waterfall_png(responses: ImpulseResponses) -> bytes:
    """Return the PNG of :func:`waterfall_figure`."""
    return _png(waterfall_figure(responses))


def _strong_taps(responses: ImpulseResponses) -> tuple[int, int]:
    """Return the first tap with a visible level, and the tap after the last one, with a margin."""
    level = np.abs(responses.response).max(axis=(0, 1))
    loud = np.flatnonzero(level > level.max() * 10 ** (FAINT_DB / 20))
    if not level.max() > 0:
        return 0, len(level)
    margin = max(4, (loud[-1] - loud[0]) // 10)
    return max(0, int(loud[0] - margin)), min(len(level), int(loud[-1] + margin + 1))


def _title(responses: ImpulseResponses, what: str) -> str:
    sonar = responses.sonar
    bands = f"{sonar.carrier_hz / 1e3:g} kHz, bandwidth {sonar.bandwidth_hz / 1e3:g} kHz"
    return f"{sonar.title}, {sonar.model} model: {bands}; {what}"


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
