"""Which details of two noisy frames tell how far they are shifted, by their fineness.

    python benchmarks/bench_spectrum.py DATA.zarr [--noise high] [--frames 40] [--poses 20]

Information about a small shift across beams, or along range, of a signal that is not known, in two frames with independent
noise (Knapp and Carter 1976): the sum over frequencies of (2 pi f)^2 S^2 / (N^2 + 2 S N). S is the spectrum of tiles of 32
bins and 32 beams of the noiseless frames, N the noise of their pixels as a Gaussian of the same variance. Beside it, how
much larger the errors of simple slopes are: they take the wrong weight of each frequency.

With --poses the limit of the motion that follows: tiles give shifts, which the geometry of level ground turns into motions.
S is then of the mean over many draws of the rays, and their variance in one ping is noise. Whoever knows the scene has
S / (2 N) instead: the ratio of both is what not knowing it costs. The last row is the oracle of `mitsonar limit`.
`--quick` makes a small data set of its own and does both.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from mitsonar.acoustics.noise import NoiseModel, information, load_noise
from mitsonar.config.data import load_recipe
from mitsonar.datasets.make import SceneRenderer, make_dataset
from mitsonar.datasets.plan import scenes_of
from mitsonar.datasets.samples import SonarPairs
from mitsonar.datasets.store import DataStore
from mitsonar.estimation.crlb.image import bound, overall
from mitsonar.geometry.ground import GroundGeometry
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.errors import in_units
from mitsonar.motion.pose import Pose
from mitsonar.simulation.derivatives import Derivative, differentiate, jittered

TILE = 32
BANDS = 4

WINDOW = np.outer(np.hanning(TILE + 2)[1:-1], np.hanning(TILE + 2)[1:-1])
WINDOW /= np.sqrt(np.mean(WINDOW**2))

SLOPES: dict[str, Callable[[NDArray[np.floating]], NDArray[np.floating]]] = {
    "differences of neighbours": lambda w: np.sin(w),
    "the same, smoothed over three": lambda w: np.sin(w) * (1 + np.cos(w)) / 2,
    "fourth order": lambda w: (8 * np.sin(w) - np.sin(2 * w)) / 6,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?")
    parser.add_argument("--noise", default="high")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--poses", type=int, default=0, help="for the limit of the motion; 0: none")
    parser.add_argument("--quick", action="store_true", help="of four frames of its own: within a minute")
    arguments = parser.parse_args()
    if arguments.quick:
        return quick(arguments.noise)
    if arguments.data is None:
        parser.error("a data set is missing: give DATA.zarr, or --quick")
    both(arguments.data, arguments.noise, arguments.frames, arguments.poses)


def quick(noise: str) -> None:
    """Of a small data set that is made for it."""
    changes: dict[str, Any] = {"scenes": [{"count": 2, "sequences": 2}], "sonar.rays_per_beam": 200, "flight.pings": 2}
    changes["world"] = {"family": "rocky-field", "size_m": 20.0, "a_side": [8, 12]}
    with tempfile.TemporaryDirectory() as folder:
        data = str(Path(folder) / "small.zarr")
        make_dataset(load_recipe("rocky-field", changes), data)
        both(data, noise, 4, 2)


def both(data: str, noise: str, frames: int, poses: int) -> None:
    """Print the information on shifts, and with poses the bound of motions."""
    level = load_noise(noise)
    shifts(DataStore.open(data), level, frames)
    if poses:
        motions(data, level, poses)


def shifts(store: DataStore, noise: NoiseModel, frames: int) -> None:
    """Print the information on shifts by spatial frequency."""
    spectra, levels = [], []
    for number in np.linspace(0, len(store) - 1, frames).astype(int):
        for tile in tiles(store.read("image", int(number))):
            spectra.append(spectrum(tile))
            levels.append(variance(tile, noise))
    signal, level = np.array(spectra), np.array(levels)[:, None, None]
    frequency = np.fft.fftfreq(TILE)
    for name, turns in (("along range", frequency[:, None]), ("across beams", frequency[None])):
        w = 2 * np.pi * turns
        information = w**2 * signal**2 / (level**2 + 2 * signal * level)
        band = np.minimum((np.abs(turns) * 2 * BANDS).astype(int), BANDS - 1)
        shares = [float((information * (band == k)).sum() / information.sum()) for k in range(BANDS)]
        print(f"{name}: " + ", ".join(f"{share:.0%} in {k / 8:.3g}..{(k + 1) / 8:.3g}" for k, share in enumerate(shares)))
        for kind, response in SLOPES.items():
            h = np.asarray(response(w) + 0 * signal[0])
            sensitivity = (h * w * signal / level).sum()
            spread = (h**2 * (2 * signal / level + 1)).sum()
            print(f"  slopes by {kind}: errors {np.sqrt(information.sum() * spread) / sensitivity:.2f} of the bound")


def motions(data: str, noise: NoiseModel, poses: int) -> None:
    """Compute the bound of the motion between two frames of an unknown scene, at the first poses of some pairs."""
    pairs = SonarPairs(data, part="all")
    expected = pairs.first[np.linspace(0, len(pairs) - 1, poses).astype(int)]
    gain = float(pairs.store.about["gain"])
    result: dict[str, list[NDArray[np.float64]]] = {"oracle, pixels (rays)": [], "scene known": [], "scene unknown": []}
    for scene in scenes_of(pairs.recipe, pairs.recipe.sequences):
        frames = expected[pairs.scene[expected] == scene.number]
        if not len(frames):
            continue
        simulator = jittered(SceneRenderer(pairs.recipe, scene).simulator)
        for frame, (seen,) in zip(frames, differentiate(simulator, pairs.pose[frames], gain), strict=True):
            oracle = bound(seen, noise, law="rays")
            assert oracle is not None
            height = float(pairs.store.read("height_m", int(frame)))
            signal, level = spectra_of(seen, noise)
            moving = derivative_of(pairs.recipe.instrument, Pose.from_row(pairs.pose[frame]), height)
            result["oracle, pixels (rays)"].append(oracle.std(2))
            result["scene known"].append(least(signal / (2 * level), moving))
            result["scene unknown"].append(least(signal**2 / (level**2 + 2 * signal * level), moving))
    for name, stds in result.items():
        print(f"{name}: " + " / ".join(f"{value:.3g}" for value in in_units(overall(stds))) + " mm, mm, deg")


def spectra_of(seen: Derivative, noise: NoiseModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of tiles that overlap by half: power by frequency ``(rows, columns, TILE, TILE)``, the mean of neighbours since one
    tile is random, and the variance of noise and rays ``(rows, columns, 1, 1)``."""
    pixels = information(noise, seen.level, seen.filled).variance + seen.variance
    rows, columns = (range(0, length - TILE + 1, TILE // 2) for length in seen.level.shape)
    spectra, levels = np.zeros((len(rows), len(columns), TILE, TILE)), np.zeros((len(rows), len(columns), 1, 1))
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            local = slice(row, row + TILE), slice(column, column + TILE)
            spectra[i, j] = spectrum(seen.level[local])
            levels[i, j] = (pixels[local] * WINDOW**2).mean()
    return uniform_filter(spectra, (3, 3, 1, 1), mode="nearest"), levels


def derivative_of(sonar: Sonar, pose: Pose, height: float) -> NDArray[np.float64]:
    """Return the derivatives of the tile centres by the motion, in bins and beams ``(rows, columns, 2, 3)``."""
    ground = GroundGeometry(sonar.range_m, sonar.bearing_rad, sonar.bearing, height, pose.pitch, pose.roll)
    cell = np.array([sonar.bin_m, np.diff(sonar.bearing_rad).mean()])
    every = slice(TILE // 2, 1 - TILE // 2, TILE // 2)
    return np.asarray(np.nan_to_num(ground.derivative / cell[:, None])[every, every])


def least(phase_information: NDArray[np.float64], moving: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the bound of the motion ``(3,)``, from the information on the phase of each frequency of each tile."""
    w = 2 * np.pi * np.fft.fftfreq(TILE)
    w[TILE // 2] = 0  # the finest has no phase
    axes = np.stack(np.meshgrid(w, w, indexing="ij"))
    shifts = np.einsum("aij,bij,rcij->rcab", axes, axes, phase_information / 4)  # each cell is in four tiles
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(np.einsum("rcak,rcab,rcbl->kl", moving, shifts, moving)))))


def tiles(image: NDArray[np.uint8]) -> list[NDArray[np.float64]]:
    """Tiles of a frame as fractions of the maximum."""
    rows, columns = (range(0, length - TILE + 1, TILE) for length in image.shape)
    return [image[r : r + TILE, c : c + TILE] / 255 for r in rows for c in columns]


def spectrum(tile: NDArray[np.float64]) -> NDArray[np.float64]:
    """Power of a tile by frequency, of all parts of it about its mean."""
    return np.asarray(np.abs(np.fft.fft2((tile - tile.mean()) * WINDOW)) ** 2 / tile.size)


def variance(tile: NDArray[np.float64], noise: NoiseModel) -> float:
    """Mean variance of the noise of a tile's pixels."""
    return float(information(noise, tile, tile > 0).variance.mean())


if __name__ == "__main__":
    main()
