"""Odometry of real recordings: sonars at rest, known shifts put on them, and a sonar that moves along a chain.

    python benchmarks/bench_recordings.py [--recordings FOLDER] [--estimators ecc,direct,phase] [--quick]

FOLDER holds the recordings of docs/guides/recordings.md (default: the variable MITSONAR_RECORDINGS). Sonars at rest: the
motion of each pair of consecutive frames must be zero. Shifts: the second frame is drawn as from a sonar that has moved by 3
pixels forward and 0.5 deg; a pixel is a bin. The chain: path, closure over 8 motions, and the sums beside the reference of
the recording's README.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from real_recordings import FOLDER, recordings_folder
from scipy import ndimage

from mitsonar.estimation.estimator import Estimate
from mitsonar.estimation.named import create_estimator
from mitsonar.geometry.ground import GroundGeometry, moved
from mitsonar.instruments.sonar import Sonar
from mitsonar.mapping.odometry import OdometryOptions, odometry
from mitsonar.mapping.open_source import LOOP, with_assumed_plane
from mitsonar.mapping.sources import FrameSource, open_frames
from mitsonar.recordings.write_aris import write_aris
from mitsonar.records.frames import SonarFrames

Array = NDArray[np.float64]

RESTING = {
    "ARIS 1200": "aris1200-sdk-sample/sample.aris",
    "Oculus 2.1 MHz": "oculus-m1200d-three-pings/three_pings_8bit.raw",
    "DIDSON, lamprey2": "didson-static-video/lamprey2_first30.npz",
    "DIDSON, lamprey4": "didson-static-video/lamprey4_first30.npz",
}
GEOMETRIES = Path(__file__).resolve().parents[1] / "tests/recordings/geometries"
"""Geometry files of pictures that do not tell theirs, by the name of the pictures."""

CHAIN = "marine-debris-aris3000/forward_chain.npz"

SHIFT_PIXELS, SHIFT_DEG = 3.0, 0.5


def opened(path: Path) -> FrameSource:
    """Open a recording as `mitsonar odometry` does."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        message = GEOMETRIES / f"{path.stem.removesuffix('_first30')}.yaml"
        return with_assumed_plane(open_frames(path, geometry=message if message.exists() else None))


def bin_m(source: FrameSource) -> float:
    """Return the length of a bin [m]: a pixel."""
    return float(np.median(np.diff(source.like.range_m)))


def geometry_of(source: FrameSource) -> GroundGeometry:
    """Return the assumed plane of a recording."""
    assert source.height_m is not None
    assert source.pitch_rad is not None
    like = source.like
    return GroundGeometry(like.range_m, like.bearing_rad, like.sonar.bearing, float(source.height_m[0]), source.pitch_rad)


def pixels_moved(source: FrameSource, motions: Array) -> Array:
    """Return by how much motions ``(n, 3)`` shift the picture ``(n, 2)``: rms over its cells, in bins and beams."""
    geometry = geometry_of(source)
    rows = []
    for motion in motions:
        radius, bearing = geometry.to_polar(moved(geometry.points, motion))
        shift = (radius - geometry.range_m[:, None]) / bin_m(source), bearing - geometry.bearing_rad
        beams = np.ptp(geometry.bearing_rad) / (len(geometry.bearing_rad) - 1)
        rows.append([np.sqrt(np.nanmean(shift[0] ** 2)), np.sqrt(np.nanmean((shift[1] / beams) ** 2))])
    return np.array(rows)


def shifted(frames: SonarFrames, source: FrameSource, motion: Array) -> SonarFrames:
    """Return the frames with the last drawn as from a sonar that has moved by ``motion``, with cubic splines."""
    geometry = geometry_of(source)
    sideways, forward, yaw = motion
    back = np.array(
        [-(sideways * np.cos(yaw) + forward * np.sin(yaw)), -(forward * np.cos(yaw) - sideways * np.sin(yaw)), -yaw]
    )
    radius, bearing = geometry.to_polar(moved(geometry.points, back))
    row = np.interp(np.nan_to_num(radius), geometry.range_m, np.arange(len(geometry.range_m)))
    column = np.interp(np.nan_to_num(bearing), geometry.bearing_rad, np.arange(len(geometry.bearing_rad)))
    image = frames.image.astype(np.float32)
    drawn = ndimage.map_coordinates(image[-1], (row, column), order=3, mode="nearest")
    top = 255 if frames.image.dtype == np.uint8 else 1
    image[-1] = np.clip(drawn, 0, top)
    return replace(frames, image=np.asarray(image / top, dtype=np.float32))


MOST_PAIRS = 15


def pairs(source: FrameSource) -> Iterator[SonarFrames]:
    for first in range(min(len(source) - 1, MOST_PAIRS)):
        yield source.read([first, first + 1])


def at_rest(name: str, source: FrameSource, estimators: list[str]) -> None:
    """Print what each estimator answers for a sonar at rest, and for a known shift put on it."""
    seen = source.with_contrast()
    assert seen.contrast is not None
    truth = np.array([0.0, SHIFT_PIXELS * bin_m(source), np.radians(SHIFT_DEG)])
    plain = list(pairs(source))
    for word in estimators:
        estimator = create_estimator(word)
        still = [estimator.estimate(pair) for pair in pairs(seen)]
        moving = [estimator.estimate(contrasted(seen, shifted(pair, source, truth))) for pair in plain]
        print(f"| {name} | {word} | {row(source, still, np.zeros(3))} | {row(source, moving, truth)} |")


def contrasted(seen: FrameSource, frames: SonarFrames) -> SonarFrames:
    """Return frames as the source with contrast reads them."""
    return FrameSource.of(frames, seen.name).with_contrast(seen.contrast).with_geometry(None, None).read([0, 1])


def row(source: FrameSource, estimates: list[Estimate], truth: Array) -> str:
    """Return errors as cells: rms and mean in pixels and deg, shift of the picture, how many were valid."""
    error = np.array([one.motion for one in estimates]) - truth
    unit = np.array([bin_m(source), bin_m(source), np.radians(1)])
    rms, mean = np.sqrt((error**2).mean(axis=0)) / unit, error.mean(axis=0) / unit
    shift = np.sqrt((pixels_moved(source, error) ** 2).mean(axis=0))
    valid = sum(one.valid for one in estimates)
    triple, means = (" / ".join(f"{value:.3f}" for value in values) for values in (rms, mean))
    return f"{triple} | {means} | {shift[0]:.2f} / {shift[1]:.2f} | {valid} of {len(estimates)}"


def chain(source: FrameSource, reference: Array | None, estimators: list[str]) -> None:
    """Print closure and sums of a moving sonar, in pixels and deg."""
    unit = np.array([bin_m(source), bin_m(source), np.radians(1)])
    for moving in (False, True):
        seen = source.with_contrast(moving=moving)
        for word in estimators:
            result = odometry(seen, create_estimator(word), OdometryOptions(closure=LOOP))
            total = result.series.motions.sum(axis=0) / unit
            loops = "" if result.closure is None else " / ".join(f"{value:.3f}" for value in result.closure.rms / unit)
            kind = "moving" if moving else "local"
            sums = " / ".join(f"{value:.2f}" for value in total)
            print(f"| {kind} | {word} | {sums} | {loops} | {int(result.valid.sum())} of {len(result.estimates)} |")
    if reference is not None:
        print(f"reference: forward {reference[:, 2].sum():.1f} px, yaw {-reference[:, 0].sum():.2f} deg, without truth")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings")
    parser.add_argument("--estimators", default="ecc,direct,phase")
    parser.add_argument("--quick", action="store_true", help="one recording and estimator; a drawn one where there are none")
    options = parser.parse_args()
    folder = recordings_folder(options.recordings)
    if folder is None and not options.quick:
        parser.error(f"no recordings: give --recordings or the variable {FOLDER}")
    estimators = ["direct"] if options.quick else options.estimators.split(",")
    print("| recording | estimator | at rest: rms px / px / deg | mean | picture, bins / beams | valid "
          "| shift: rms error | mean | picture | valid |")  # fmt: skip
    if folder is None:
        with tempfile.TemporaryDirectory() as scratch:
            return at_rest("drawn", opened(drawn(Path(scratch) / "drawn.aris")), estimators)
    for name, path in list(RESTING.items())[: 1 if options.quick else None]:
        at_rest(name, opened(folder / path), estimators)
    if options.quick:
        return None
    with np.load(folder / CHAIN) as table:
        reference = table["approx_motion"]
    print("| contrast | estimator | sums px / px / deg | closure over 8, px / px / deg | valid |")
    return chain(opened(folder / CHAIN), reference, estimators)


def drawn(path: Path) -> Path:
    """Write three frames of a sonar at rest over drawn ground in noise, as an ARIS file."""
    rng, sonar = np.random.default_rng(1), Sonar(beams=48, azimuth_fov_deg=14.9, range_bins=400, range_min=3, range_max=7)
    ground = ndimage.gaussian_filter(rng.normal(size=(400, 48)), (4, 1.5))
    image = 0.6 + 0.1 * ground / ground.std() + 0.02 * rng.normal(size=(3, 400, 48))
    coded = sonar.replace(coding="dB", coding_db=80.0, frequency_hz=1.2e6)
    pixels = np.asarray(np.clip(image, 0, 1), dtype=np.float32)
    write_aris(path, SonarFrames(pixels, sonar.range_m, sonar.bearing_rad, np.arange(3) / 10, coded, level="dB"), beams=48)
    return path


if __name__ == "__main__":
    main()
