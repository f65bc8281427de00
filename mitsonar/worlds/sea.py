"""How the sea surface and what drifts below it are made: wave spectra, the world ``sea-surface``, particles, nets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError
from mitsonar.io.files import write_atomic
from mitsonar.worlds.world import GRID_M, Family, Floor, Interval, Mesh, Standpoint, World, stream

__all__ = [
    "GRAVITY",
    "SHORTEST",
    "Sea",
    "SeaState",
    "SeaSurface",
    "WaveSpectrum",
    "fishing_net_mesh",
    "jonswap",
    "particle_mesh",
    "pierson_moskowitz",
    "spreading",
    "wave_heights",
]


# ---------------- Wave spectra


GRAVITY = 9.81
"""Gravitational acceleration g [m/s^2]."""

TO_19_5_M = 1.026
"""Ratio of the wind speeds at 19.5 m, which Pierson and Moskowitz use, and at 10 m (Stewart, Introduction to Physical
Oceanography, 16.4)."""

LOWEST_RATIO = 0.3
"""Lowest frequency of an integral, relative to the peak; waves below it have no energy: exp(-154)."""

HIGHEST_RATIO = 1000.0
"""Highest frequency of an integral, relative to the peak; waves above it have 1e-12 of the variance."""

FETCH_LIMITS = (100.0, 17_000.0)
"""Smallest and largest dimensionless fetch g x / U^2; at the largest, the peak is that of a fully developed sea."""

STEPS = 4000
"""Steps of a numerical integral per decade of frequency."""


@dataclass(frozen=True)
class WaveSpectrum:
    """A spectrum of the heights of wind waves: JONSWAP's, or Pierson and Moskowitz's with gamma = 1.

    S(omega) = alpha g^2 omega^-5 exp(-5/4 (omega_p / omega)^4) gamma^r,  r = exp(-(omega - omega_p)^2 / (2 s^2 omega_p^2))

    with s = 0.07 below the peak and 0.09 above it (Pierson and Moskowitz, J. Geophys. Res. 69 (1964), 5181-5190; Hasselmann
    et al., Measurements of wind-wave growth and swell decay during the Joint North Sea Wave Project, Deutsche Hydrogr. Z. A8
    (12), 1973). The dispersion relation is omega^2 = g k tanh(k d).

    Attributes:
        scale: Phillips' constant alpha.
        peak_rad_s: frequency of the peak omega_p [rad/s].
        enhancement: peak enhancement factor gamma, 1 or more.
        depth_m: depth d of the water, used by the dispersion relation alone [m]; infinite by default.
    """

    scale: float
    peak_rad_s: float
    enhancement: float = 1.0
    depth_m: float = math.inf

    def density(self, omega: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the variance density S(omega) ``(...)`` [m^2 s].

        Args:
            omega: frequencies above 0 ``(...)`` [rad/s].
        """
        over = omega / self.peak_rad_s
        width = np.where(over <= 1, 0.07, 0.09)
        peak = self.enhancement ** np.exp(-((over - 1) ** 2) / (2 * width**2))
        return np.asarray(self.scale * GRAVITY**2 * omega**-5.0 * np.exp(-1.25 * over**-4.0) * peak)

    def frequency(self, wavenumber: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the frequencies ``(...)`` [rad/s] of wavenumbers ``(...)`` [rad/m]."""
        return np.asarray(np.sqrt(GRAVITY * wavenumber * np.tanh(wavenumber * self.depth_m)))

    def wavenumber(self, omega: float) -> float:
        """Return the wavenumber of a frequency [rad/m], by Newton's method on the dispersion relation."""
        k = omega**2 / GRAVITY
        if math.isinf(self.depth_m):
            return k
        k = max(k, omega / math.sqrt(GRAVITY * self.depth_m))  # start above the root: the iterates then decrease to it
        for _ in range(50):
            slope, frequency = self.group_speed(np.array(k)), self.frequency(np.array(k))
            k -= float((frequency - omega) / slope)
        return k

    def group_speed(self, wavenumber: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the group speed d omega / d k ``(...)`` [m/s]."""
        twice = np.minimum(2 * wavenumber * self.depth_m, 100.0)  # 2 k d; above 100 the water is deep, and sinh overflows
        return np.asarray(self.frequency(wavenumber) / (2 * wavenumber) * (1 + twice / np.sinh(twice)))

    def density_of_wavenumber(self, wavenumber: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the variance density over the wavenumber, S(omega) d omega / d k ``(...)`` [m^3]."""
        return self.density(self.frequency(wavenumber)) * self.group_speed(wavenumber)

    @property
    def peak_wavelength_m(self) -> float:
        """Return the wavelength at the peak [m]."""
        return 2 * math.pi / self.wavenumber(self.peak_rad_s)

    @property
    def significant_height_m(self) -> float:
        """Return the significant wave height, four times the rms height of all waves [m]."""
        return 4 * math.sqrt(self.variance())

    def variance(self, shortest_m: float = 0.0, longest_m: float = math.inf) -> float:
        """Return the variance of the waves whose lengths lie in an interval [m^2]."""
        omega = self._band(shortest_m, longest_m)
        return float(np.trapezoid(self.density(omega) * omega, np.log(omega)))

    def mean_square_slope(self, shortest_m: float) -> float:
        """Return the mean square slope of all waves down to a wavelength, summed over both axes."""
        omega = self._band(shortest_m, math.inf)
        low, high = (self.wavenumber(float(end)) for end in (omega[0], omega[-1]))
        k = np.geomspace(low, high, len(omega))
        return float(np.trapezoid(self.density_of_wavenumber(k) * k**3, np.log(k)))

    def _band(self, shortest_m: float, longest_m: float) -> NDArray[np.float64]:
        """Return the frequencies of the waves between two lengths, logarithmically spaced."""
        low, high = LOWEST_RATIO * self.peak_rad_s, HIGHEST_RATIO * self.peak_rad_s
        if longest_m < math.inf:
            low = max(low, float(self.frequency(np.array(2 * math.pi / longest_m))))
        if shortest_m > 0:
            high = min(high, float(self.frequency(np.array(2 * math.pi / shortest_m))))
        if high <= low:
            return np.array([low, low])
        return np.geomspace(low, high, math.ceil(STEPS * math.log10(high / low)) + 2)


def pierson_moskowitz(wind_m_s: float, depth_m: float = math.inf) -> WaveSpectrum:
    """Return the spectrum of a fully developed sea, with alpha = 0.0081 and beta = 0.74.

    Args:
        wind_m_s: speed of the wind 10 m above the sea, above 0 [m/s].
        depth_m: depth of the water, for the dispersion relation [m].
    """
    peak = (0.8 * 0.74) ** 0.25 * GRAVITY / (TO_19_5_M * wind_m_s)
    return WaveSpectrum(0.0081, peak, 1.0, depth_m)


def jonswap(wind_m_s: float, fetch_m: float, depth_m: float = math.inf) -> WaveSpectrum:
    """Return the spectrum of a sea that grows with the fetch, with gamma = 3.3.

    Args:
        wind_m_s: speed of the wind 10 m above the sea, above 0 [m/s].
        fetch_m: distance over which the wind blows [m].
        depth_m: depth of the water, for the dispersion relation [m].

    Raises:
        MitsonarError: the fetch is shorter than those measured, or so long that the peak frequency would lie below that of a
            fully developed sea.
    """
    least, grown = (reach * wind_m_s**2 / GRAVITY for reach in FETCH_LIMITS)
    if not least <= fetch_m <= grown:
        raise MitsonarError(
            f"jonswap holds for fetches from {least / 1000:.3g} to {grown / 1000:.3g} km at a wind of {wind_m_s:g} m/s: got "
            f"{fetch_m / 1000:g} km; change fetch_km, or choose pierson-moskowitz for a fully developed sea"
        )
    reach = GRAVITY * fetch_m / wind_m_s**2
    peak = 2 * math.pi * 3.5 * GRAVITY / wind_m_s * reach ** (-1 / 3)
    return WaveSpectrum(0.076 * reach**-0.22, peak, 3.3, depth_m)


def spreading(angle: NDArray[np.float64], exponent: float) -> NDArray[np.float64]:
    """Return the directional distribution of the waves, ``cos^2s(angle / 2)`` normalised to integral 1 ``(...)`` [1/rad].

    This is the model of Longuet-Higgins, Cartwright and Smith (Ocean Wave Spectra, 1963), with the same s at all
    frequencies.

    Args:
        angle: angle from the direction towards which the wind blows ``(...)`` [rad].
        exponent: s, 0 or more; 0 spreads the waves evenly over all directions.
    """
    s = exponent
    log_factor = (2 * s - 1) * math.log(2) - math.log(math.pi) + 2 * math.lgamma(s + 1) - math.lgamma(2 * s + 1)
    return np.asarray(math.exp(log_factor) * np.cos(angle / 2) ** (2 * s))


# ---------------- World ``sea-surface``


MAX_TRIANGLES = 2_000_000
"""Largest number of triangles of a surface, the limit of mirrors in impulse responses."""

MIN_STEPS = 8
"""Smallest number of steps along the edge."""

MATERIAL = "surface.yaml"
"""File of the surface's material, in the folder of the scene."""


class SeaState(NamedTuple):
    """Wave heights of a surface: those that its mesh resolves, and those that roughen its mirror reflection.

    Attributes:
        significant_height_m: four times the rms height of all waves of the spectrum [m].
        peak_wavelength_m: wavelength at the peak of the spectrum [m]; infinite without waves.
        shortest_m: wavelength of the shortest waves in the mesh [m].
        rms_m: rms height of the waves in the mesh [m].
        roughness_m: rms height of the shorter waves, which the mesh does not resolve [m].
    """

    significant_height_m: float
    peak_wavelength_m: float
    shortest_m: float
    rms_m: float
    roughness_m: float


class SeaSurface(Family):
    """A sea surface over a flat seabed: wind waves of Pierson and Moskowitz's or JONSWAP's spectrum, or flat without wind.

    Waves of four steps and more are the mesh. The rms height of shorter ones is the roughness of the mirror part. The
    surface is the shape `surface`; it faces down and reflects -1. Surfaces of one seed at several times belong to one sea.
    """

    called: ClassVar[str] = "sea-surface"

    wind_m_s: float = Field(5.0, ge=0, le=40, description="wind 10 m above the sea [m/s]; 0: a flat surface")
    spectrum: Literal["pierson-moskowitz", "jonswap"] = Field(
        "pierson-moskowitz", description="pierson-moskowitz (fully developed) or jonswap (limited by the fetch)"
    )
    fetch_km: float = Field(20.0, gt=0, le=10_000, description="fetch: distance over which the wind blows, for jonswap [km]")
    towards_deg: float = Field(
        0.0, ge=-360, le=360, description="direction towards which the wind blows: 0 is +y, 90 is +x [deg]"
    )
    spreading: float = Field(2.0, ge=0, le=100, description="s of cos^2s of half the angle off the wind; 0: all directions")
    size_m: float = Field(40.0, gt=0, le=10_000, description="edge of the square surface, and of the seabed [m]")
    step_m: float = Field(0.25, gt=0, le=25, description="edge of the mesh's squares [m]")
    time_s: float = Field(0.0, ge=-1e6, le=1e6, description="time of the surface [s]")
    water_m: float = Field(
        10.0, gt=0, le=12_000, description="depth: the seabed is at z = 0, the mean surface at this height [m]"
    )
    seabed_cells: int = Field(512, ge=0, le=2**20, description="cells along the seabed's edge; 0: no seabed")
    seabed_reflectivity: Interval = Field((0.0, 0.2), description="uniform reflectivity of a cell")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.wind_m_s == 0:
            return self
        steps = self.size_m / self.step_m
        if steps < MIN_STEPS:
            raise ValueError(
                f"size_m must be at least {MIN_STEPS} step_m, {MIN_STEPS * self.step_m:g} m: got {self.size_m:g} m"
            )
        if 2 * round(steps) ** 2 > MAX_TRIANGLES:
            least = self.size_m / math.isqrt(MAX_TRIANGLES // 2)
            raise ValueError(
                f"a surface has at most {MAX_TRIANGLES:,} triangles, and {self.size_m:g} m in steps of {self.step_m:g} m "
                f"would have {2 * round(steps) ** 2:,}: give a step_m of at least {least:.2g} m, or a smaller size_m"
            )
        try:
            peak = self.waves.peak_wavelength_m
        except MitsonarError as error:
            raise ValueError(str(error)) from None
        if SHORTEST * self.step_m > peak:
            raise ValueError(
                f"step_m must be at most a quarter of the peak's wavelength, {peak / SHORTEST:.2g} m at a wind of "
                f"{self.wind_m_s:g} m/s, or the mesh misses them: got {self.step_m:g} m"
            )
        return self

    @property
    def seeded(self) -> bool:
        """Return whether the waves or the seabed are random."""
        return self.wind_m_s > 0 or self.seabed_cells > 0

    @property
    def waves(self) -> WaveSpectrum:
        """Return the spectrum of the waves; it is undefined without wind.

        Raises:
            MitsonarError: the fetch does not fit the wind.
        """
        if self.spectrum == "jonswap":
            return jonswap(self.wind_m_s, 1000 * self.fetch_km, self.water_m)
        return pierson_moskowitz(self.wind_m_s, self.water_m)

    @property
    def state(self) -> SeaState:
        """Return the wave heights, split into those in the mesh and those that are too short for it."""
        shortest = SHORTEST * self.step_m
        if self.wind_m_s == 0:
            return SeaState(0.0, math.inf, shortest, 0.0, 0.0)
        resolved, unresolved = self.waves.variance(shortest), self.waves.variance(0.0, shortest)
        height, peak = self.waves.significant_height_m, self.waves.peak_wavelength_m
        return SeaState(height, peak, shortest, math.sqrt(resolved), math.sqrt(unresolved))

    def save(self, path: str | Path, seed: int = 0, time_s: float | None = None) -> None:
        """Write the surface for a seed as a PLY file, for use in another scene.

        Args:
            path: PLY file to write; an existing file is replaced.
            seed: seed of the waves.
            time_s: time of the surface [s]; default: that of the family.
        """
        write_atomic(path, self.surface(seed, time_s).ply())

    def surface(self, seed: int, time_s: float | None = None) -> Mesh:
        """Build the surface for a seed.

        Args:
            seed: seed of the waves.
            time_s: time of the surface [s]; default: that of the family.
        """
        # 1. Sample the heights on a square grid; a flat surface needs only one cell.
        cells = 1 if self.wind_m_s == 0 else round(self.size_m / self.step_m)
        place = np.linspace(-self.half_m, self.half_m, cells + 1)
        heights = np.zeros((cells + 1, cells + 1))
        if self.wind_m_s > 0:
            sea = Sea(self.waves, math.radians(self.towards_deg), self.spreading)
            time = self.time_s if time_s is None else time_s
            heights = wave_heights(sea, cells + 1, self.size_m / cells, seed, time)
        # 2. Split each cell into two triangles.
        x, y = np.meshgrid(place, place)
        vertices = np.stack([x, y, self.water_m + heights], axis=-1).reshape(-1, 3)
        number = np.arange((cells + 1) ** 2).reshape(cells + 1, -1)
        a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
        faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([a, d, c], axis=1)])  # facing down
        return Mesh("surface", np.rint(vertices / GRID_M) * GRID_M, faces, material=MATERIAL)

    def material(self) -> str:
        """Return the YAML of the surface's material.

        Its reflection coefficient is -1. What the short waves take from the mirror reflection is scattered by Lambert's law.
        """
        return (
            "name: sea surface\n"
            "law: lambert\n"
            "mu: 0.31830\n"
            "reflection: -1.0\n"
            f"roughness_m: {self.state.roughness_m:.4g}\n"
            "source: >-\n"
            "  reflection: water against air. roughness_m: the waves that the mesh does not resolve. mu (ours): what they\n"
            "  take from the mirror is scattered by Lambert's law, all of it.\n"
        )

    def build(self, seed: int) -> World:
        """Build the surface and the seabed for a seed."""
        state = self.state
        about = f"sea-surface, seed {seed}: flat"
        if self.wind_m_s > 0:
            about = (
                f"sea-surface, seed {seed}, {self.time_s:g} s: {self.spectrum}, wind {self.wind_m_s:g} m/s, significant "
                f"wave height {state.significant_height_m:.3g} m, peak at {state.peak_wavelength_m:.3g} m; in the mesh rms "
                f"{state.rms_m:.3g} m; waves below {state.shortest_m:g} m are its roughness, rms {state.roughness_m:.3g} m"
            )
        deep = min(2.0, self.water_m / 2)
        y = -self.half_m / 2
        return World(
            about=about,
            meshes=[self.surface(seed)],
            stand=Standpoint((0, y, self.water_m - deep), (0, y + 2 * deep, self.water_m), (1.5 * deep, 4 * deep)),
            floor=Floor(self.half_m, Floor.cells(self.seabed_cells, self.seabed_reflectivity, seed))
            if self.seabed_cells
            else None,
            content={MATERIAL: self.material().encode()},
        )


# ---------------- Realisations of a sea


SHORTEST = 4
"""Grid steps per wavelength of the shortest wave that a grid resolves."""

INNER = 4
"""Largest index along both axes of the wave vectors that are subdivided."""

CALM_FRACTION = 0.4
"""Wave vectors below this fraction of the peak's are not subdivided further: they have 1e-20 of the variance."""


class Sea(NamedTuple):
    """Parameters of a random sea.

    Attributes:
        spectrum: spectrum of the heights.
        towards_rad: direction towards which the wind blows, from +y towards +x [rad].
        spread: exponent s of :func:`~mitsonar.worlds.sea.spreading`.
    """

    spectrum: WaveSpectrum
    towards_rad: float
    spread: float


class _Waves(NamedTuple):
    """Wave vectors of a square lattice: their x and y ``(n,)`` [rad/m], and the step of the lattice [rad/m]."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    step: float


def wave_heights(sea: Sea, count: int, step_m: float, seed: int, time_s: float) -> NDArray[np.float64]:
    """Return one realisation of Gaussian wave heights on a square grid around the origin ``(count, count)`` [m], y first.

    The heights contain all waves of at least :data:`SHORTEST` grid steps. Their amplitudes depend on the seed alone, so
    surfaces of one seed at several times belong to one sea.

    An FFT sums the waves of the grid's own wave vectors. The innermost 9 x 9 of these vectors, which include all waves
    longer than the grid, are divided in three in each direction, repeatedly, until the remainder has no energy. Long swells
    therefore heave and tilt a small patch, and nothing repeats within it.

    Args:
        sea: parameters of the sea.
        count: points along an edge.
        step_m: step of the grid [m].
        seed: seed of the amplitudes.
        time_s: time of the surface [s].
    """
    # 1. Choose the wave vectors of the FFT: outside the innermost ones, and no shorter than the grid resolves. The grid is
    #    enlarged to a size whose FFT is fast.
    points = _smooth(count)
    lattice = 2 * math.pi / (points * step_m)
    index = np.rint(np.fft.fftfreq(points) * points)
    rows, columns = np.nonzero(
        ((np.abs(index)[:, None] > INNER) | (np.abs(index) > INNER))
        & (lattice * np.hypot(index[:, None], index) <= 2 * math.pi / (SHORTEST * step_m))
    )
    grid_waves = _Waves(index[columns] * lattice, index[rows] * lattice, lattice)
    # 2. Sum their waves by an inverse FFT, and cut out the grid.
    values = np.zeros((points, points), np.complex128)
    values[rows, columns] = _amplitudes(sea, grid_waves, seed, 0, time_s)
    heights = (np.fft.ifft2(values) * points**2).real[:count, :count]
    # 3. Add the long waves one lattice at a time. They are few, so that a product of two matrices is cheap.
    place = np.arange(count) * step_m
    for number, waves in enumerate(_long_waves(sea, lattice, step_m), 1):
        amplitude = _amplitudes(sea, waves, seed, number, time_s)
        along = np.exp(1j * np.outer(place, waves.y)) * amplitude
        heights = heights + (along @ np.exp(1j * np.outer(waves.x, place))).real
    return np.asarray(heights)


def _long_waves(sea: Sea, lattice: float, step_m: float) -> list[_Waves]:
    """Return the wave vectors that replace the innermost ones of a lattice, in successively finer lattices."""
    calm = CALM_FRACTION * sea.spectrum.wavenumber(sea.spectrum.peak_rad_s)
    lattices = []
    outer = 3 * INNER + 1
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.arange(-outer, outer + 1.0)] * 2))
    ring = np.maximum(np.abs(x), np.abs(y)) > INNER
    shortest = 2 * math.pi / (SHORTEST * step_m)
    while lattice * (INNER + 0.5) > calm:
        lattice /= 3
        selected = ring & (lattice * np.hypot(x, y) <= shortest)
        lattices.append(_Waves(x[selected] * lattice, y[selected] * lattice, lattice))
    return lattices


def _amplitudes(sea: Sea, waves: _Waves, seed: int, number: int, time_s: float) -> NDArray[np.complex128]:
    """Return the complex amplitudes of waves at a time ``(n,)`` [m]: Gaussian numbers with the variance of each wave."""
    wavenumber = np.hypot(waves.x, waves.y)
    rng = stream(seed, 1, number)
    # Box-Muller transform: it uses only the generator's plain doubles, whose bits do not change between versions
    length, turn = np.sqrt(-2 * np.log(1 - rng.random(len(wavenumber)))), 2 * np.pi * rng.random(len(wavenumber))
    turn -= sea.spectrum.frequency(wavenumber) * time_s
    return np.asarray(np.sqrt(_variance(sea, waves)) * length * np.exp(1j * turn))


def _variance(sea: Sea, waves: _Waves) -> NDArray[np.float64]:
    """Return the variance of each cell of a lattice of wave vectors ``(n,)`` [m^2], by four-point Gauss quadrature."""
    total = np.zeros(len(waves.x))
    aside = waves.step / math.sqrt(12)
    for right in (-aside, aside):
        for up in (-aside, aside):
            x, y = waves.x + right, waves.y + up
            wavenumber = np.hypot(x, y)
            share = spreading(np.arctan2(x, y) - sea.towards_rad, sea.spread)
            total += sea.spectrum.density_of_wavenumber(wavenumber) / wavenumber * share
    return total / 4 * waves.step**2


def _smooth(count: int) -> int:
    """Return the smallest number >= ``count`` that has no prime factors but 2, 3 and 5: its FFT is fast."""
    while True:
        rest = count
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return count
        count += 1


# ---------------- Particles and fishing nets


Triangles = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Vertices ``(vertices, 3)`` [m] and outward triangles ``(faces, 3)``."""

MAX_COPIES = 5_000_000
"""Largest number of particles or bars."""


def particle_mesh(count: int, size_m: tuple[float, float, float], radius_m: float, seed: int = 0) -> Triangles:
    """Make a cloud of particles: octahedra with random positions and attitudes in a box centred on the origin.

    An octahedron of radius a has the surface 4 sqrt(3) a^2. With Lambert's mu its mean backscattering cross-section is mu
    times a sixth of the surface, as for every convex body.

    Args:
        count: number of particles.
        size_m: edges of the box, east, north, up [m].
        radius_m: distance from the centre of a particle to its corners [m].
        seed: seed of the positions and attitudes.

    Raises:
        MitsonarError: there are no particles or too many, or a size is not positive.
    """
    if not 1 <= count <= MAX_COPIES or not min(*size_m, radius_m) > 0:
        raise MitsonarError(f"particles are 1..{MAX_COPIES:,} of positive size: got {count} of {radius_m:g} m in {size_m} m")
    rng = np.random.default_rng(seed)
    corners = np.concatenate([np.eye(3), -np.eye(3)]) * radius_m
    sides = [[x, y, z] for x in (0, 3) for y in (1, 4) for z in (2, 5)]
    outward = [side if np.linalg.det(corners[side]) > 0 else side[::-1] for side in sides]
    turned = np.einsum("nij,kj->nki", Rotation.random(count, random_state=rng).as_matrix(), corners)
    vertices = turned + rng.uniform(-0.5, 0.5, (count, 1, 3)) * np.asarray(size_m)
    return vertices.reshape(-1, 3), _copied(np.array(outward), len(corners), count)


def fishing_net_mesh(width_m: float, height_m: float, opening_m: float, twine_m: float) -> Triangles:
    """Make a fishing net with square openings, in the plane y = 0, from the origin to the east and up.

    Its bars are prisms with three sides.

    Args:
        width_m: width of the net, rounded to a whole number of openings [m].
        height_m: height of the net, rounded likewise [m].
        opening_m: distance from bar to bar [m].
        twine_m: diameter of the bars [m].

    Raises:
        MitsonarError: the sizes make no net, or there are too many bars.
    """
    if not 0 < twine_m < opening_m <= min(width_m, height_m):
        raise MitsonarError(
            f"a net has twine < opening <= size: got {twine_m:g}, {opening_m:g}, {width_m:g}, {height_m:g} m"
        )
    across, up = (round(size / opening_m) for size in (width_m, height_m))
    if (across + 1) * up + (up + 1) * across > MAX_COPIES:
        raise MitsonarError(f"a net has at most {MAX_COPIES:,} bars: enlarge opening_m, got {opening_m:g}")
    # 1. Place the knots. From each, one bar rises and one leads east, except at the upper and the eastern edge.
    x, z = (a.ravel() for a in np.meshgrid(np.arange(across + 1), np.arange(up + 1), indexing="ij"))
    knots = np.column_stack([x, np.zeros_like(x), z]) * opening_m
    begins = np.concatenate([knots[z < up], knots[x < across]])
    bars = np.repeat([[0, 0, opening_m], [opening_m, 0, 0]], [(z < up).sum(), (x < across).sum()], axis=0)
    # 2. Put a triangular ring around both ends of each bar, and join the two rings.
    turn = 2 * np.pi * np.arange(3) / 3
    cross_section = 0.5 * twine_m * np.column_stack([np.cos(turn), np.sin(turn)])
    side = np.cross(bars / opening_m, [0.0, 1.0, 0.0])
    ring = cross_section[None, :, :1] * side[:, None] + cross_section[None, :, 1:] * np.array([0.0, 1.0, 0.0])
    vertices = np.concatenate([begins[:, None] + ring, (begins + bars)[:, None] + ring], axis=1)
    faces = [[k, 3 + k, (k + 1) % 3] for k in range(3)] + [[(k + 1) % 3, 3 + k, 3 + (k + 1) % 3] for k in range(3)]
    return vertices.reshape(-1, 3), _copied(np.array(faces), 6, len(begins))


def _copied(faces: NDArray[np.int64], vertices: int, count: int) -> NDArray[np.int64]:
    """Return the triangles of ``count`` copies of a shape that has the given number of vertices."""
    return np.asarray((faces[None] + vertices * np.arange(count)[:, None, None]).reshape(-1, 3), dtype=np.int64)
