"""Real frames beside simulated ones: statistics in one table, pictures in one figure, and a sheet for a blind sorting.

    python benchmarks/bench_realism.py --recordings FOLDER [--out FOLDER] [--classify] [--quick] [--only NAME]

Recordings are read from the folder, or from the one that MITSONAR_RECORDINGS names. Their sonars are fitted
(`mitsonar sonar fit`), and the model coherent renders scenes that resemble theirs. Noise and gain are set so that noise and
brightest thousandth lie as far below full scale as in the recording. Where volume is bright, the fit says the gain. Pulse,
crosstalk, tails and the detector's offset are those whose rendered grain is nearest to the recording's.
`--classify` fits on the first half of the frames instead, and prints how well a logistic regression separates as many
simulated frames from the second half: it learns on patches of one half of the beams, and is tested on the other. A guess
has 0.5.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from real_recordings import FOLDER, RECORDINGS, as_recorded, recordings_folder
from realism_classifier import accuracies, control_accuracies
from realism_scenes import STAGES, Stage

from mitsonar.acoustics import statistics
from mitsonar.acoustics.levels import decoded
from mitsonar.errors import MitsonarWarning
from mitsonar.estimation.sonar_fit import SonarFit, fit_sonar
from mitsonar.geometry.fan import to_cartesian
from mitsonar.instruments.sonar import Sonar
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.device import ensure_variant
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

SHOWN_DB = 50.0
"""Span of the pictures below the 99.9th percentile [dB]."""

Levels = NDArray[np.float64]

SEED = 20
"""Of the sway."""


@dataclass(frozen=True)
class Row:
    """A statistic of both: name, band of the difference (None where it is only shown), values."""

    name: str
    band: float | None
    real: float
    simulated: float

    def cell(self) -> str:
        """Return real / simulated, bold where they are farther apart than the band."""
        digits = 2 if self.band is not None and self.band < 1 else 1
        both = f"{self.real:.{digits}f} / {self.simulated:.{digits}f}"
        return f"**{both}**" if self.band is not None and abs(self.simulated - self.real) > self.band else both


def main() -> None:
    """Compare, print the table, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", help=f"folder of the recordings; default: ${FOLDER}")
    parser.add_argument("--out", type=Path, help="folder of the pictures; default: none are drawn")
    parser.add_argument("--only", default="", help="only recordings whose name contains this")
    parser.add_argument("--order", type=int, default=20, help="seed of the order of the sheet")
    parser.add_argument("--classify", action="store_true", help="print how well a classifier separates them")
    parser.add_argument("--quick", action="store_true", help="two frames of one recording")
    arguments = parser.parse_args()
    folder = recordings_folder(arguments.recordings)
    if folder is None:
        return print(f"no recordings: name their folder by --recordings or {FOLDER}; nothing is compared")
    warnings.simplefilter("ignore", MitsonarWarning)
    names = [name for name in RECORDINGS if arguments.only in name]
    drawn: dict[str, tuple[SonarFrames, SonarFrames]] = {}
    names = ["ARIS 3000 tyre"] if arguments.quick else names
    if arguments.classify:
        return print(classified({name: held_out(name, folder, arguments.quick) for name in names}))
    for name in names:
        real = RECORDINGS[name](folder)
        if arguments.quick:
            real = real.select(slice(2))
        fit = fitted(name, real, folder, 0 if arguments.quick else 2)
        simulated = simulate(STAGES[name], fit, len(real), folder)
        print(f"\n{name}, fitted:\n" + "\n".join(f"    {line}" for line in [*fit.lines(), *fit.notes]), flush=True)
        drawn[name] = real, simulated
    print("\n" + table({name: compare(*pair) for name, pair in drawn.items()}))
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
        draw(drawn, arguments.out, arguments.order)


# ---------------------------------------------------------------- classifier


def held_out(name: str, folder: Path, quick: bool) -> tuple[Levels, Levels]:
    """Return levels of the second half of a recording's frames, and of simulated frames fitted to the first half."""
    real = RECORDINGS[name](folder)
    real = real.select(slice(4)) if quick else real
    half = len(real) // 2
    first, second = real.select(slice(half)), real.select(slice(half, None))
    return levels(second), levels(
        simulate(STAGES[name], fitted(name, first, folder, 0 if quick else 2), len(second), folder)
    )


def classified(pairs: dict[str, tuple[Levels, Levels]]) -> str:
    """Return the accuracies of the classifier in Markdown, by recording and group of features, with both controls."""
    rows = {name: accuracies(*pair) | dict(control_accuracies(*pair)) for name, pair in pairs.items()}
    columns = list(next(iter(rows.values())))
    lines = [f"| recording | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    if len(rows) > 1:
        rows["mean"] = {column: float(np.mean([row[column] for row in rows.values()])) for column in columns}
    return "\n".join([*lines, *(f"| {n} | {' | '.join(f'{row[c]:.2f}' for c in columns)} |" for n, row in rows.items())])


# ---------------------------------------------------------------- simulation


PULSES = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8)
"""Pulses that are tried for recordings in pictures, in bins."""

SHORTER = (0.7, 0.85, 1.0)
"""Pulses that are tried for others, relative to that of the dark noise."""

CROSSTALK_DB = (None, -45.0, -40.0, -35.0, -31.0, -28.0, -25.0, -22.0, -19.0)
OFFSET_DB = (None, -13.0, -10.0, -7.0, -4.0)
"""Crosstalk and offset of the detector, relative to the noise, that are tried."""

TAILS = ((None, 10), *((level, bins) for level in (-22.0, -18.0, -14.0, -10.0) for bins in (10, 30)))
"""Tails that are tried: power of an echo's tail, relative to it [dB], and its range [bins]."""

SMEAR_BAND_DB, TAIL_BAND_DB = 0.5, 2.0
"""Weights of smear and tails of the brightest, which a glance at a picture sees: 3 dB of smear count as 6 bands."""

RANKS = (0, 10, 30, 50, 70, 90, 100)
"""Percentiles of the windows' means, between which grain is compared."""


def fitted(name: str, real: SonarFrames, folder: Path, rounds: int = 2) -> SonarFit:
    """Fit the sonar of a recording; choose pulse, crosstalk, tails and offset by the rendered grain."""
    stage = STAGES[name]
    fit = fit_sonar(real, **stage.sonar)
    sonar, target = real.sonar, grain(real)
    pulses: list[dict[str, Any]]
    if stage.pictures:  # which smooth
        pulses = [{"pulse_m": bins * sonar.bin_m, "beam_width_deg": sonar.beam_width_deg} for bins in PULSES]
    else:
        width = fit.sonar.beam_width_deg
        pulses = [{"pulse_m": part * fit.sonar.resolution_m, "beam_width_deg": width} for part in SHORTER]
    fit = nearest([fit_sonar(real, **stage.sonar, **known) for known in pulses], stage, target, folder)
    for _ in range(rounds):
        leaks = [replace(fit, sonar=fit.sonar.replace(crosstalk_db=level)) for level in CROSSTALK_DB]
        fit = nearest([fit, *leaks], stage, target, folder)
        tails = [replace(fit, sonar=fit.sonar.replace(tail_db=level, tail_m=bins * sonar.bin_m)) for level, bins in TAILS]
        fit = nearest([fit, *tails], stage, target, folder)
        fit = nearest([fit, *(with_offset(fit, level) for level in OFFSET_DB)], stage, target, folder)
        fit = nearest([fit, *(replace(fit, sonar=fit.sonar.replace(**known)) for known in pulses)], stage, target, folder)
    return fit


def nearest(fits: list[SonarFit], stage: Stage, target: NDArray[np.float64], folder: Path) -> SonarFit:
    """Return the fit whose rendered grain is nearest to the target."""
    miss = [float(np.abs(grain(simulate(stage, fit, 1, folder)) - target).sum()) for fit in fits]
    return fits[int(np.argmin(miss))]


def grain(frames: SonarFrames) -> NDArray[np.float64]:
    """Return what pulse, crosstalk, tails and offset change ``(28,)``, in units of bands.

    These are spread and correlation of the grain of windows, by the rank of their level, smear and tails of the brightest.
    """
    rest = statistics.detrended(level := levels(frames))
    mean = statistics.window_values(level).mean(axis=1)
    shape = [min(size, whole) for size, whole in zip(statistics.WINDOW, rest.shape[1:], strict=True)]
    windows = statistics.window_values(rest).reshape(-1, *shape)
    power = np.square(windows).mean(axis=(1, 2)) + 1e-9
    over_range = [(windows[:, lag:] * windows[:, :-lag]).mean(axis=(1, 2)) / power for lag in (1, 2)]
    over_beams = (windows[:, :, 1:] * windows[:, :, :-1]).mean(axis=(1, 2)) / power
    numbers = np.stack([np.sqrt(power) / 0.7, *(one / 0.1 for one in (*over_range, over_beams))])
    ends = np.percentile(mean, RANKS)
    parts = [(mean >= low) & (mean <= high) for low, high in pairwise(ends)]
    by_rank = np.array([np.median(numbers[:, part], axis=1) for part in parts])
    tails = np.nan_to_num(statistics.tail_db(level)) / TAIL_BAND_DB
    return np.concatenate([by_rank.ravel(), [statistics.smear_db(level) / SMEAR_BAND_DB], tails])


def with_offset(fit: SonarFit, offset_db: float | None) -> SonarFit:
    """Return the fit with another offset of the detector, relative to the noise [dB], and the same dark level."""
    sonar, noise_db = fit.sonar, fit.noise_db
    if sonar.noise_level_db is None or noise_db is None:
        return fit
    before = 0.0 if sonar.detector_offset_db is None else 10 ** ((sonar.detector_offset_db - sonar.noise_level_db) / 10)
    after = 0.0 if offset_db is None else 10 ** (offset_db / 10)
    change_db = 10 * math.log10((1 + before) / (1 + after))
    noise_level_db = sonar.noise_level_db + change_db
    known = None if offset_db is None else noise_level_db + offset_db
    return replace(
        fit, sonar=sonar.replace(noise_level_db=noise_level_db, detector_offset_db=known), noise_db=noise_db + change_db
    )


@cache
def built(build: Callable[[Path], mi.Scene]) -> mi.Scene:
    """Build a scene once."""
    with tempfile.TemporaryDirectory() as folder:
        return build(Path(folder))


def simulate(stage: Stage, fit: SonarFit, frames: int, folder: Path) -> SonarFrames:
    """Return as many frames of a stage, with the fitted sonar, after the recording's way."""
    ensure_variant()
    poses = stage.start + np.arange(frames)[:, None] * stage.step
    poses[:, :3] += np.random.default_rng(SEED).normal(0, stage.sway_m, (frames, 3))
    sonar = fit.sonar.replace(**stage.sonar, speckle_nu=None)  # the fitted one counts objects and edges
    scene = built(stage.build)
    if sonar.volume_db is not None and sonar.noise_level_db is not None:
        scale_db = (sonar.volume_db if stage.volume_db is None else stage.volume_db) - sonar.volume_db
        sonar = with_noise(sonar, sonar.noise_level_db + scale_db).replace(volume_db=sonar.volume_db + scale_db)
        full_db = fit.full_scale_db + scale_db - sonar.source_level_db
        return recorded(Simulator(scene, sonar, mirrors=stage.mirrors), poses, full_db, stage, folder)
    quiet = sonar.replace(noise_level_db=None, near_glow_db=0.0, detector_offset_db=None)
    silent = Simulator(scene, quiet, mirrors=stage.mirrors)
    bright = np.percentile(next(iter(silent.pings(poses[:1]))).levels[:, statistics.GLOW_BINS :], 99.9)
    assert silent.model.imager is not None
    middle_db = 10 * math.log10(silent.model.imager.gain[sonar.range_bins // 2])
    full_db = 10 * math.log10(bright) - fit.bright_db
    for few in (2, frames):  # pictures dim glints of single cells: full scale moves by what is missing
        if fit.noise_db is not None:
            sonar = with_noise(sonar, full_db - middle_db + fit.noise_db + sonar.source_level_db)
        made_frames = recorded(Simulator(scene, sonar, mirrors=stage.mirrors), poses[:few], full_db, stage, folder)
        full_db += np.percentile(levels(made_frames)[:, statistics.GLOW_BINS :], 99.9) - fit.bright_db
    return made_frames


def with_noise(sonar: Sonar, noise_level_db: float) -> Sonar:
    """Return a sonar with another level of noise, and of the detector's offset with it."""
    offset_db, noise_db = sonar.detector_offset_db, sonar.noise_level_db
    if offset_db is not None and noise_db is not None:
        offset_db += noise_level_db - noise_db
    return sonar.replace(noise_level_db=noise_level_db, detector_offset_db=offset_db)


def recorded(simulator: Simulator, poses: NDArray[np.float64], full_db: float, stage: Stage, folder: Path) -> SonarFrames:
    """Return frames whose full scale is a level [dB], in 8 bit, coded as the recording."""
    frames = simulator.render(poses, gain=float(10 ** (-full_db / 10)))
    image = np.rint(frames.image * 255).astype(np.float32) / 255
    frames.image = as_recorded(image, folder, stage.pictures, stage.video) if stage.pictures else image
    return frames


# ---------------------------------------------------------------- table


def levels(frames: SonarFrames) -> NDArray[np.float64]:
    """Return the levels of frames relative to full scale, zeros 3 dB below the least [dB]."""
    intensity = decoded(frames.image, frames.sonar)
    least = float(statistics.decibels(intensity[intensity > 0].min()))
    return statistics.decibels(intensity, least - 3)


def compare(real: SonarFrames, simulated: SonarFrames) -> list[Row]:
    """Return all statistics of both."""
    one, second = measured(real), measured(simulated)
    return [Row(name, band, one[name][0], second[name][0]) for name, (_, band) in one.items()]


def table(results: dict[str, list[Row]]) -> str:
    """Return the statistics of all recordings in Markdown: real / simulated, bold where out of the band."""
    lines = [f"| real / simulated | band | {' | '.join(results)} |", "|---" * (len(results) + 2) + "|"]
    for rows in zip(*results.values(), strict=True):
        band = "" if rows[0].band is None else f"±{rows[0].band:g}"
        lines.append(f"| {rows[0].name} | {band} | {' | '.join(row.cell() for row in rows)} |")
    judged = [row for rows in results.values() for row in rows if row.band is not None]
    inside = sum(abs(row.simulated - row.real) <= row.band for row in judged if row.band is not None)
    return "\n".join([*lines, f"\n{inside} of {len(judged)} numbers with a band are in it; bold ones are out."])


def measured(frames: SonarFrames) -> dict[str, tuple[float, float | None]]:
    """Return each statistic with its band, None where it is only shown."""
    level = levels(frames)
    by_level = statistics.correlation_by_level(level)[1]
    over_range, over_beams = (statistics.autocorrelation(level, axis) for axis in (1, 2))
    rise, fall = statistics.edge_steps_db(level)
    glow = statistics.near_glow_db(level)
    behind = dict(zip(statistics.BEHIND_BINS, statistics.tail_db(level).tolist(), strict=True))
    profile = statistics.range_profile_db(level)
    third = [float(part.mean() - profile.max()) for part in np.array_split(profile, 3)]
    result: dict[str, tuple[float, float | None]] = {
        "span 1..99.9 %, dB": (statistics.percentile_span_db(level), 6.0),
        "exact zeros, %": (100 * statistics.zero_share(frames.image), None),
        "local std, dB": (statistics.local_std_db(level), 0.7),
        "contrast, median": (float(np.median(statistics.intensity_contrast(10 ** (level / 10)))), None),
        "frames, raw": (statistics.frame_correlation(level), None),
        "frames, detrended, darkest 3 tenths": (float(by_level[:3].mean()), 0.1),
        "frames, detrended, middle 4 tenths": (float(by_level[3:7].mean()), 0.1),
        "frames, detrended, brightest 3 tenths": (float(by_level[7:].mean()), 0.1),
        "range, lag 1": (float(over_range[0]), 0.1),
        "range, lag 2": (float(over_range[1]), 0.1),
        "beams, lag 1": (float(over_beams[0]), 0.1),
        "beams, lag 2": (float(over_beams[1]), 0.1),
        "stripes, dB": (statistics.beam_stripes_db(level), None),
        "smear of the brightest, dB": (statistics.smear_db(level), None),
        **{f"{bins} bins behind the brightest, dB": (value, None) for bins, value in behind.items()},
        "99.9 % over median, dB": (statistics.bright_over_median_db(level), None),
        "near glow, dB": (float(glow.max()), None),
        "steepest rise in 5 % of range, dB": (rise, None),
        "steepest fall in 5 % of range, dB": (fall, None),
    }
    return result | {f"profile, third {k + 1}, below its top, dB": (value, None) for k, value in enumerate(third)}


# ---------------------------------------------------------------- pictures


def fan(frames: SonarFrames, index: int = 0) -> NDArray[np.float32]:
    """Return a frame as a fan of grey 0..1, the upper 50 dB; white outside."""
    level = levels(frames)[index]
    top = float(np.percentile(level, 99.9))
    grey = np.clip((level - top) / SHOWN_DB + 1, 0, 1).astype(np.float32)
    drawn = to_cartesian(grey, frames.range_m, frames.bearing_rad).image
    return np.asarray(np.where(np.isfinite(drawn), drawn, 1.0), dtype=np.float32)


def panels(pictures: Iterable[NDArray[np.float32]], titles: Iterable[str], columns: int, path: Path) -> None:
    """Write pictures side by side, each as high as the others."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    shown, named = list(pictures), list(titles)
    figure = Figure(figsize=(3 * columns, 5 * math.ceil(len(shown) / columns)), layout="constrained")
    axes = figure.subplots(math.ceil(len(shown) / columns), columns, squeeze=False).ravel()
    for one, axis in enumerate(axes):
        axis.axis("off")
        if one < len(shown):
            axis.imshow(shown[one], cmap="gray", vmin=0, vmax=1, interpolation="antialiased", aspect="equal")
            axis.set_title(named[one], fontsize=9)
    grey = ScalarMappable(Normalize(-SHOWN_DB, 0), "gray")
    figure.colorbar(grey, ax=list(axes), label="level (dB below the brightest 0.1 %)", fraction=0.02, pad=0.01)
    figure.savefig(path, dpi=110)


def draw(drawn: dict[str, tuple[SonarFrames, SonarFrames]], folder: Path, seed: int) -> None:
    """Write the figure with names, real above simulated, and the sheet without them with its key apart."""
    both = [[fan(pair[side]) for pair in drawn.values()] for side in (0, 1)]
    titles = [f"{side}: {name}" for side in ("real", "simulated") for name in drawn]
    panels(both[0] + both[1], titles, len(drawn), folder / "realism.png")
    order = np.random.default_rng(seed).permutation(2 * len(drawn))
    letters = [chr(ord("A") + place) for place in range(len(order))]
    mixed = both[0] + both[1]
    panels([mixed[k] for k in order], letters, len(drawn), folder / "sheet.png")
    key = {letter: titles[k] for letter, k in zip(letters, order, strict=True)}
    (folder / "key.json").write_text(json.dumps(key, indent=1) + "\n", encoding="utf-8")
    print(f"\npictures in {folder}: realism.png; sheet.png without names, its key in key.json")


if __name__ == "__main__":
    main()
