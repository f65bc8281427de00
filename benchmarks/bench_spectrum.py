"""Which details of two noisy frames tell how far they are shifted, by their fineness.

    python benchmarks/bench_spectrum.py DATA.zarr [--noise high] [--frames 40]

Information about a small shift across beams, or along range, of a signal that is not known, in two frames with independent
noise (Knapp and Carter 1976): the sum over frequencies of (2 pi f)^2 S^2 / (N^2 + 2 S N). S is the spectrum of tiles of 32
bins and 32 beams of the noiseless frames, N the noise of their pixels as a Gaussian of the same variance. Beside it, how
much larger the errors of simple slopes are: they take the wrong weight of each frequency.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from mitsonar.dataset.store import DataStore
from mitsonar.noise import NoiseModel, load_noise

TILE = 32
BANDS = 4

SLOPES = {
    "differences of neighbours": lambda w: np.sin(w),
    "the same, smoothed over three": lambda w: np.sin(w) * (1 + np.cos(w)) / 2,
    "fourth order": lambda w: (8 * np.sin(w) - np.sin(2 * w)) / 6,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data")
    parser.add_argument("--noise", default="high")
    parser.add_argument("--frames", type=int, default=40)
    asked = parser.parse_args()
    noise = load_noise(asked.noise)
    store = DataStore.open(asked.data)
    window = np.hanning(TILE + 2)[1:-1]
    window = np.outer(window, window) / np.sqrt(np.mean(np.outer(window, window) ** 2))
    spectra, levels = [], []
    for number in np.linspace(0, len(store) - 1, asked.frames).astype(int):
        for tile in tiles(store.read("image", int(number))):
            spectra.append(np.abs(np.fft.fft2((tile - tile.mean()) * window)) ** 2 / tile.size)
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
            h = response(w) + 0 * signal[0]
            told = (h * w * signal / level).sum()
            spread = (h**2 * (2 * signal / level + 1)).sum()
            print(f"  slopes by {kind}: errors {np.sqrt(information.sum() * spread) / told:.2f} of the bound")


def tiles(image: NDArray[np.uint8]) -> list[NDArray[np.float64]]:
    """Tiles of a frame as fractions of the maximum."""
    rows, columns = (range(0, length - TILE + 1, TILE) for length in image.shape)
    return [image[r : r + TILE, c : c + TILE] / 255 for r in rows for c in columns]


def variance(tile: NDArray[np.float64], noise: NoiseModel) -> float:
    """Mean variance of the noise of a tile's pixels."""
    lit = float((tile > 0).mean())
    return lit * (2 - np.pi / 2) * noise.scale**2 + (1 - lit) * noise.std**2


if __name__ == "__main__":
    main()
