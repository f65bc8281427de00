"""The figure of Cramer-Rao bounds."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any, TypeAlias

__all__ = ["crlb_png"]

Report: TypeAlias = Mapping[str, Any]
"""A report of :mod:`mitsonar.estimation.crlb.crlb_report`: its keys, with rows of bounds under ``rows``."""


def crlb_png(report: Report) -> bytes:
    """Draw the bounds of two frames against the variable, or for each pose, and return the PNG."""
    from matplotlib.figure import Figure

    name = report["vary"]
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    panels = figure.subplots(1, 3)
    series: dict[str, list[tuple[float | str, list[float | None]]]] = {}
    for row in report["rows"]:
        label = " ".join([row["portion"], row["data"], row["law"]])
        if name is None:
            series[label] = list(enumerate(row["two_frames_each"]))
        elif row["two_frames"] is not None:
            x = "..".join(f"{v:g}" for v in row[name]) if name == "window" else row[name]
            series.setdefault(label, []).append((x, row["two_frames"]))
    for axis, (panel, unit) in enumerate(zip(panels, report["units"], strict=True)):
        for label, points in series.items():
            known = [(x, std[axis]) for x, std in points if std[axis] is not None]
            panel.plot([x for x, _ in known], [y for _, y in known], "o-" if name else ".", label=label, markersize=4)
        panel.set(xlabel=name or "pose", ylabel=unit, yscale="log")
        panel.grid(alpha=0.3, which="both")
    panels[0].legend(fontsize=7)
    figure.suptitle(f"least standard deviation of two frames, noise {report['noise']}", fontsize=10)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    return buffer.getvalue()
