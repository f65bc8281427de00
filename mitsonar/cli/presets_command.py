"""``mitsonar presets`` and ``mitsonar scenes``: what can be named."""

from __future__ import annotations

import math
from typing import Annotated

import typer

from mitsonar.cli.console import answered, say

__all__ = ["presets", "scenes"]


@answered
def presets(
    name: Annotated[str | None, typer.Argument(help="One preset: every number with its source.")] = None,
) -> None:
    """Print the sonars that can be named, or one of them with the document behind each number."""
    from mitsonar.acoustics.sonar_losses import absorption_line
    from mitsonar.instruments.imaging_sonar import RAYS
    from mitsonar.instruments.named_sonars import named_sonars, preset

    if name is not None:
        sonar, sources = preset(name), named_sonars()[name].sources
        say(f"{name}: {named_sonars()[name].about}")
        for key, value in sonar.model_dump(exclude={"name"}).items():
            shown = f"{value:g}" if isinstance(value, float) else "-" if value is None else str(value)
            source = sources.get(key, "from quality" if key in RAYS else "default")
            say(f"  {key:18} {shown:10} {source}")
        if line := absorption_line(sonar):
            say(f"  {line}")
        for line in _accuracy([name]):
            say(line)
        return
    say(f"{'preset':22} {'az x el (deg)':14} {'beams':>5} {'width':>6}  {'window (m)':12} {'bins':>5}  instrument")
    for key, (title, *_) in named_sonars().items():
        sonar = preset(key)
        width = f"{math.degrees(sonar.beam_width_rad):.3g}"
        field = f"{sonar.azimuth_fov_deg:g} x {sonar.elevation_fov_deg:g}"
        window = f"{sonar.range_min:g}..{sonar.range_max:g}"
        say(f"{key:22} {field:14} {sonar.beams:5} {width:>6}  {window:12} {sonar.range_bins:5}  {title}")
    for line in _accuracy(list(named_sonars())):
        say(line)
    say("`mitsonar presets NAME` prints where each number comes from; docs/guides/sonars.md tells how to write your own.")


def _accuracy(names: list[str]) -> list[str]:
    """Return the measured errors of each quality, preset by preset."""
    from mitsonar.instruments.quality import measured_errors

    about, measured = measured_errors()
    lines = [
        "",
        "quality: rays a beam (over elevation x across), rms error of one ping in % on plain ground / on 15 mm cells, and",
        "correlation of a resting sonar's pings on these cells (below 1: jitter of the rays, not speckle)",
        f"{'preset':22}" + "".join(f" {quality:30}" for quality in measured[names[0]]).rstrip(),
    ]
    for name in names:
        cells = [
            f"{f'{over} x {across}':8} {plain:6g} % / {textured:g} %  {still:.2f}"
            for over, across, plain, textured, still in measured[name].values()
        ]
        lines.append(f"{name:22}" + "".join(f" {cell:30}" for cell in cells).rstrip())
    return [
        *lines,
        f"Physical model; the thesis model keeps its own rays. Ground a fifth of the far range below the sonar. {about}.",
    ]


@answered
def scenes() -> None:
    """Print the scenes that are shipped; each has a trajectory (`--trajectory shipped`)."""
    from mitsonar.simulation.scene import shipped_scenes

    for name, path in shipped_scenes().items():
        say(f"{name:16} {path}")
