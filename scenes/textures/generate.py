"""Generate the tileable greyscale textures of the shipped scenes: stand-ins for photographs of real surfaces.

Each picture is a made-up luminance (albedo times a soft oblique light) with periodic boundaries. The seeds are fixed,
so the same bytes come out each time; `--quick` makes one and compares it with the shipped one.
"""

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import fft, ndimage
from scipy.spatial import cKDTree

SIZE = 512
Field = NDArray[np.float64]
KY, KX = np.meshgrid(fft.fftfreq(SIZE, 1 / SIZE), fft.fftfreq(SIZE, 1 / SIZE), indexing="ij")
K = np.hypot(KX, KY)
Y, X = np.mgrid[:SIZE, :SIZE].astype(float)


def filtered(rng: np.random.Generator, gain: Field) -> Field:
    """Return periodic Gaussian noise of zero mean and unit deviation with the given spectral amplitude."""
    spectrum = fft.fft2(rng.standard_normal((SIZE, SIZE))) * gain
    spectrum[0, 0] = 0.0
    noise = fft.ifft2(spectrum).real
    result: Field = noise / noise.std()
    return result


def fractal(rng: np.random.Generator, slope: float, low: float = 0.0) -> Field:
    """Return periodic 1/f^slope noise, flat below `low` cycles per picture."""
    return filtered(rng, np.maximum(K, max(low, 1.0)) ** -slope)


def slope_light(height: Field, degrees: float) -> Field:
    """Return the slope of a periodic height field towards a light in the given direction."""
    dy, dx = (np.roll(height, 1, axis) - np.roll(height, -1, axis) for axis in (0, 1))
    slope: Field = 0.5 * (np.cos(np.radians(degrees)) * dx + np.sin(np.radians(degrees)) * dy)
    return slope


def periodic(delta: Field) -> Field:
    """Wrap coordinate differences into half a picture either way."""
    return (delta + SIZE / 2) % SIZE - SIZE / 2


def scatter(rng: np.random.Generator, radii: Field, gap: float) -> tuple[Field, Field]:
    """Throw discs, largest first, keeping those that clear the others; return the centres and radii kept."""
    centres, stored = np.empty((0, 2)), np.empty(0)
    for radius in np.sort(radii)[::-1]:
        point = rng.uniform(0, SIZE, 2)
        if np.all(np.hypot(*periodic(centres - point).T) > gap * (stored + radius)):
            centres, stored = np.vstack([centres, point]), np.append(stored, radius)
    return centres, stored


def cells(
    rng: np.random.Generator, centres: Field, radii: Field, x: Field, y: Field
) -> tuple[NDArray[np.intp], Field, Field]:
    """Return each pixel's owner in a power diagram of ellipses, the distance to its centre, and to the next cell."""
    angle, stretch = rng.uniform(0, np.pi, len(radii)), rng.uniform(1.0, 1.3, len(radii))
    points = np.stack([x % SIZE, y % SIZE], axis=-1)
    near = cKDTree(centres, boxsize=SIZE).query(points, k=min(24, len(radii)))[1]
    dx, dy = np.moveaxis(periodic(points[:, :, None] - centres[near]), -1, 0)
    c, s = np.cos(angle[near]), np.sin(angle[near])
    distance = np.hypot((c * dx + s * dy) / stretch[near], (c * dy - s * dx) * stretch[near])
    power = distance**2 - radii[near] ** 2
    order = np.argsort(power, axis=-1)[..., :2]
    owner, distance, power = (np.take_along_axis(values, order, -1) for values in (near, distance, power))
    return owner[..., 0], distance[..., 0], (power[..., 1] - power[..., 0]) / distance.sum(axis=-1)


def sand() -> Field:
    """Return rippled sand: a narrow band of wave vectors, whose phase singularities are the forks of real ripples."""
    rng = np.random.default_rng(1)
    band = np.exp(-(((KY - 17) / 2.6) ** 2) - ((KX - 3) / 3.5) ** 2)
    wave = fft.ifft2(fft.fft2(rng.standard_normal((SIZE, SIZE))) * band)
    phase, strength = np.angle(wave), np.abs(wave) / (np.abs(wave) + 0.25 * np.abs(wave).mean())
    ripple = strength * (np.cos(phase) + 0.2 * np.cos(2 * phase + 0.8))
    height = 5.0 * ripple + 0.9 * fractal(rng, 1.6, 4)
    grain = filtered(rng, np.exp(-((K / 170) ** 2)))
    field: Field = slope_light(height, 80) + 0.25 * ripple + 0.32 * grain + 0.15 * fractal(rng, 1.5)
    return field


def gravel() -> Field:
    """Return pebbles of various sizes: rounded, domed cells of a power diagram with dark grit between them."""
    rng = np.random.default_rng(2)
    centres, radii = scatter(rng, np.clip(rng.lognormal(2.0, 0.55, 16000), 4.5, 32), 0.86)
    warp = [2.5 * fractal(rng, 2.6, 9) for _ in range(2)]
    owner, centre, edge = cells(rng, centres, radii, X + warp[0], Y + warp[1])
    size = radii[owner]
    inside = np.clip(np.minimum(0.5 * edge, 1.12 * size - centre), 0, None)
    height = 0.8 * size * np.sqrt(1 - (1 - np.minimum(inside / size, 1)) ** 2)
    height = ndimage.gaussian_filter(height + 0.25 * fractal(rng, 1.3, 10), 0.9, mode="wrap")
    tone = rng.normal(1.0, 0.27, len(radii)).clip(0.45, 1.7)[owner]
    mottle = 1 + 0.10 * fractal(rng, 0.9, 20) + 0.04 * rng.standard_normal((SIZE, SIZE))
    light = np.clip(0.75 + 0.5 * np.arctan(slope_light(height, 50)), 0.08, None)
    return mottle * (tone * light * np.tanh(inside / 2) + 0.1)


def rock() -> Field:
    """Return weathered rock: a lit 1/f relief with stains, broken by cracks that wander, widen and die out."""
    rng = np.random.default_rng(3)
    relief, warp = fractal(rng, 1.75), [fractal(rng, 1.7) for _ in range(2)]
    light = slope_light(28 * relief, 40)
    dark = np.zeros((SIZE, SIZE))
    for count, width, sway in ((7, 2.6, 26.0), (45, 1.3, 13.0)):
        centres, radii = scatter(rng, np.full(40 * count, 0.40 * SIZE / count**0.5), 0.8)
        edge = cells(rng, centres, radii, X + sway * warp[0], Y + sway * warp[1])[2]
        opening = width * np.clip(0.5 + 0.6 * fractal(rng, 1.3), 0, 1.3)
        dark = np.maximum(dark, np.clip(1.4 * opening - edge, 0, 1.5))
    texture = 0.5 * light / light.std() + 0.5 * fractal(rng, 1.1, 2) + 0.12 * rng.standard_normal((SIZE, SIZE))
    field: Field = texture - 1.8 * ndimage.gaussian_filter(dark, 0.6, mode="wrap")
    return field


def save(path: Path, field: Field) -> None:
    """Stretch a field over 0.05 to 1, bend it to a mean of 0.45, and write it as 8-bit greyscale."""
    low, high = np.percentile(field, (0.3, 99.7))
    unit = np.clip((field - low) / (high - low), 0.0, 1.0)
    gammas = np.linspace(0.3, 3.0, 541)
    gamma = gammas[np.argmin([abs(np.mean(unit[::4, ::4] ** g) * 0.95 + 0.05 - 0.45) for g in gammas])]
    Image.fromarray(np.rint(255 * (0.05 + 0.95 * unit**gamma)).astype(np.uint8)).save(path, optimize=True)


TEXTURES: dict[str, Callable[[], Field]] = {"photo_sand": sand, "photo_gravel": gravel, "photo_rock": rock}


def main() -> None:
    """Write every texture into a folder, or compare one with the one that is shipped."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, nargs="?", help="folder for the PNG files")
    parser.add_argument("--quick", action="store_true", help="compare the sand with the shipped one instead")
    arguments = parser.parse_args()
    if arguments.quick:
        return compare("photo_sand")
    if arguments.out is None:
        parser.error("a folder is missing: give OUT, or --quick")
    for name, texture in TEXTURES.items():
        save(arguments.out / f"{name}.png", texture())


def compare(name: str) -> None:
    """Make a texture and compare it with the shipped one.

    Raises:
        SystemExit: grey levels differ by more than rounding.
    """
    with tempfile.TemporaryDirectory() as folder:
        save(Path(folder, f"{name}.png"), TEXTURES[name]())
        result, had = (
            np.asarray(Image.open(path / f"{name}.png"), dtype=int)
            for path in (Path(folder), Path(__file__).resolve().parent)
        )
    if result.shape != had.shape or np.abs(result - had).max() > 1:
        raise SystemExit(f"{name}.png is not what is made now: run `python generate.py .`")
    print(f"{name}.png: {result.shape[0]} x {result.shape[1]} pixels, as shipped")


if __name__ == "__main__":
    main()
