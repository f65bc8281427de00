"""How do latitudes and longitudes become metres, east and north? By Universal Transverse Mercator (UTM) on WGS 84.

Source: Karney, Transverse Mercator with an accuracy of a few nanometers, J. Geodesy 85 (2011), 475-485: the series of
Krueger to the fourth order in the third flattening, which are good to some micrometres within a zone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError

__all__ = ["LATITUDES_DEG", "UtmOrigin"]

Array = NDArray[np.float64]

SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1 / 298.257223563
SCALE = 0.9996
"""Scale on the central meridian of a zone."""

FALSE_EAST_M, FALSE_NORTH_SOUTH_M = 500_000.0, 10_000_000.0
"""Coordinates of the equator on the central meridian: east, and north in the southern hemisphere."""

LATITUDES_DEG = (-80.0, 84.0)
"""Latitudes for which UTM is defined."""

REACH_DEG = 20.0
"""Largest difference of longitudes from the central meridian for which the series are used."""

_N = FLATTENING / (2 - FLATTENING)
_ECCENTRICITY = 2 * math.sqrt(_N) / (1 + _N)
_RADIUS_M = SEMI_MAJOR_M / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
"""Radius of the rectifying sphere."""

_FORWARD = (
    _N / 2 - 2 / 3 * _N**2 + 5 / 16 * _N**3 + 41 / 180 * _N**4,
    13 / 48 * _N**2 - 3 / 5 * _N**3 + 557 / 1440 * _N**4,
    61 / 240 * _N**3 - 103 / 140 * _N**4,
    49561 / 161280 * _N**4,
)
_INVERSE = (
    _N / 2 - 2 / 3 * _N**2 + 37 / 96 * _N**3 - 1 / 360 * _N**4,
    1 / 48 * _N**2 + 1 / 15 * _N**3 - 437 / 1440 * _N**4,
    17 / 480 * _N**3 - 37 / 840 * _N**4,
    4397 / 161280 * _N**4,
)
_LATITUDE = (
    2 * _N - 2 / 3 * _N**2 - 2 * _N**3 + 116 / 45 * _N**4,
    7 / 3 * _N**2 - 8 / 5 * _N**3 - 227 / 45 * _N**4,
    56 / 15 * _N**3 - 136 / 35 * _N**4,
    4279 / 630 * _N**4,
)


class _Sphere(NamedTuple):
    """Positions on the conformal sphere: ``xi`` along and ``eta`` across the central meridian, and what leads there."""

    xi: Array
    eta: Array
    tangent: Array
    longitude_rad: Array


@dataclass(frozen=True)
class UtmOrigin:
    """Where on the Earth the origin x = y = 0 of a world lies, whose axes are those of a UTM grid: x east, y north.

    Attributes:
        zone: zone of UTM, 1..60.
        south: whether coordinates are those of the southern hemisphere.
        east_m: easting of the origin [m].
        north_m: northing of the origin [m].

    Raises:
        MitsonarError: there is no such zone, or a coordinate is not finite.
    """

    zone: int
    south: bool
    east_m: float
    north_m: float

    def __post_init__(self) -> None:
        if not 1 <= self.zone <= 60:
            raise MitsonarError(f"zones of UTM are 1 to 60: got {self.zone}")
        if not (math.isfinite(self.east_m) and math.isfinite(self.north_m)):
            raise MitsonarError(f"an origin needs finite coordinates: got {self.east_m:g} m east, {self.north_m:g} m north")

    @classmethod
    def near(cls, latitude_deg: float, longitude_deg: float) -> Self:
        """Return the origin at the whole metre south-west of a position.

        Raises:
            MitsonarError: UTM is not defined at this latitude, or the position is not on the Earth.
        """
        low, high = LATITUDES_DEG
        if not (low <= latitude_deg <= high and -180 <= longitude_deg <= 180):
            raise MitsonarError(
                f"UTM needs a latitude in {low:g}..{high:g} and a longitude in -180..180 deg: got {latitude_deg:g}, "
                f"{longitude_deg:g}"
            )
        zone = min(60, int((longitude_deg + 180) // 6) + 1)
        grid = cls(zone, bool(latitude_deg < 0), 0.0, 0.0)
        east, north = np.floor(grid.to_world([[latitude_deg, longitude_deg]])[0])
        return cls(zone, grid.south, float(east), float(north))

    @property
    def epsg(self) -> int:
        """Return the code of the grid in the EPSG register."""
        return (32700 if self.south else 32600) + self.zone

    @property
    def central_deg(self) -> float:
        """Return the longitude of the central meridian [deg]."""
        return 6.0 * self.zone - 183.0

    def to_world(self, degrees: ArrayLike) -> Array:
        """Return x east and y north ``(n, 2)`` [m] of latitudes and longitudes ``(n, 2)`` [deg].

        Raises:
            MitsonarError: a position lies more than 20 deg from the central meridian, or is not finite.
        """
        sphere = self._sphere(degrees)
        k = 2 * np.arange(1, len(_FORWARD) + 1)
        xi = sphere.xi + np.sin(np.multiply.outer(sphere.xi, k)) * np.cosh(np.multiply.outer(sphere.eta, k)) @ _FORWARD
        eta = sphere.eta + np.cos(np.multiply.outer(sphere.xi, k)) * np.sinh(np.multiply.outer(sphere.eta, k)) @ _FORWARD
        scale = SCALE * _RADIUS_M
        return np.column_stack([FALSE_EAST_M + scale * eta - self.east_m, self._false_north + scale * xi - self.north_m])

    def to_degrees(self, world: ArrayLike) -> Array:
        """Return latitudes and longitudes ``(n, 2)`` [deg] of positions x, y ``(n, 2)`` [m]."""
        x, y = np.asarray(world, dtype=float).T
        scale = SCALE * _RADIUS_M
        eta, xi = (x + self.east_m - FALSE_EAST_M) / scale, (y + self.north_m - self._false_north) / scale
        k = 2 * np.arange(1, len(_INVERSE) + 1)
        xi, eta = (
            xi - np.sin(np.multiply.outer(xi, k)) * np.cosh(np.multiply.outer(eta, k)) @ _INVERSE,
            eta - np.cos(np.multiply.outer(xi, k)) * np.sinh(np.multiply.outer(eta, k)) @ _INVERSE,
        )
        conformal = np.arcsin(np.sin(xi) / np.cosh(eta))
        latitude = conformal + np.sin(np.multiply.outer(conformal, k)) @ _LATITUDE
        longitude = np.arctan2(np.sinh(eta), np.cos(xi))
        return np.column_stack([np.degrees(latitude), _wrapped_deg(np.degrees(longitude) + self.central_deg)])

    def convergence_rad(self, degrees: ArrayLike) -> Array:
        """Return by how much grid north lies clockwise of true north ``(n,)`` [rad], at positions ``(n, 2)`` [deg].

        A heading in the grid is the true heading minus this angle.

        Raises:
            MitsonarError: as for :meth:`to_world`.
        """
        sphere = self._sphere(degrees)
        k = 2 * np.arange(1, len(_FORWARD) + 1)
        along = 1 + np.cos(np.multiply.outer(sphere.xi, k)) * np.cosh(np.multiply.outer(sphere.eta, k)) @ (k * _FORWARD)
        across = np.sin(np.multiply.outer(sphere.xi, k)) * np.sinh(np.multiply.outer(sphere.eta, k)) @ (k * _FORWARD)
        secant, tangent = np.hypot(1, sphere.tangent), sphere.tangent * np.tan(sphere.longitude_rad)
        return np.asarray(np.arctan2(across * secant + along * tangent, along * secant - across * tangent))

    @property
    def _false_north(self) -> float:
        return FALSE_NORTH_SOUTH_M if self.south else 0.0

    def _sphere(self, degrees: ArrayLike) -> _Sphere:
        """Project positions ``(n, 2)`` [deg] to the conformal sphere, as seen from the central meridian."""
        latitude, longitude = np.asarray(degrees, dtype=float).reshape(-1, 2).T
        longitude = _wrapped_deg(longitude - self.central_deg)
        if not ((np.abs(latitude) <= 90) & (np.abs(longitude) <= REACH_DEG)).all():  # nan too
            raise MitsonarError(
                f"zone {self.zone} of UTM is used within {REACH_DEG:g} deg of longitude of {self.central_deg:g} deg: a "
                "position lies beyond, or is no latitude and longitude"
            )
        sine, longitude = np.sin(np.radians(latitude)), np.radians(longitude)
        sine = np.clip(sine, -1 + 1e-15, 1 - 1e-15)  # the poles
        tangent = np.sinh(np.arctanh(sine) - _ECCENTRICITY * np.arctanh(_ECCENTRICITY * sine))
        eta = np.arctanh(np.sin(longitude) / np.hypot(1, tangent))
        return _Sphere(np.arctan2(tangent, np.cos(longitude)), eta, tangent, longitude)


def _wrapped_deg(angle: Array) -> Array:
    """Return angles in -180..180 [deg]."""
    return np.asarray((angle + 180) % 360 - 180)
