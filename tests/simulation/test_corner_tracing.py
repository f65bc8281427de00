"""Corner reflectors against the closed forms of their target strength, and a near one against Kirchhoff's integral."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import numpy as np
import pytest
from helpers import Array, essence
from scipy.spatial.transform import Rotation

from mitsonar.instruments.sonar import Sonar

if TYPE_CHECKING:
    import mitsuba as mi

pytestmark = pytest.mark.usefixtures("variant")

Kind = Literal["triangular", "square", "dihedral"]

FREQUENCY = 4.5e5
WAVELENGTH = 1500 / FREQUENCY


def corner(kind: Kind, side: float, turned: Array, at: Array) -> mi.Mesh:
    """A corner reflector with its apex at a place: the axes' planes, turned."""
    import mitsuba as mi

    x, y, z = np.eye(3) * side
    if kind == "triangular":
        points, faces = [0 * x, x, y, z], [[0, 1, 2], [0, 2, 3], [0, 3, 1]]
    elif kind == "square":
        points = [0 * x, x, y, z, x + y, y + z, z + x]
        faces = [[0, 1, 4], [0, 4, 2], [0, 2, 5], [0, 5, 3], [0, 3, 6], [0, 6, 1]]
    else:
        points, faces = (
            [-z / 2, z / 2, x - z / 2, x + z / 2, y - z / 2, y + z / 2],
            [[0, 2, 3], [0, 3, 1], [0, 4, 5], [0, 5, 1]],
        )
    mesh = mi.Mesh("corner", len(points), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = (np.array(points) @ turned.T + at).astype(np.float32).ravel()
    parameters["faces"] = np.array(faces, dtype=np.uint32).ravel()
    parameters.update()
    return mesh


def strength(kind: Kind, side: float, range_m: float, *, twist: float = 0.0, aside: float = 0.0, bounces: int = 3) -> float:
    """Target strength [dB] of a corner that looks at the sonar: its echo times R^2.

    The array only receives: one that sends too lights no more of the corner than its beam is wide.
    """
    import mitsuba as mi

    from mitsonar.simulation.models.coherent import CoherentImager

    sonar = Sonar.create(model="coherent", frequency_hz=FREQUENCY, beams=40, azimuth_fov_deg=12.0, elevation_fov_deg=10.0,
                         range_min=range_m - 0.6, range_max=range_m + 0.6, range_bins=256, bearing="cone",
                         elevation_pattern="box", pattern="receive", absorption_db_per_m=0.0, bounces=bounces)  # fmt: skip
    at = np.array([aside, range_m, aside / 2])
    toward = -at / np.linalg.norm(at)
    axis = np.array([1, 1, 0 if kind == "dihedral" else 1.0])
    first = Rotation.align_vectors([toward], [axis / np.linalg.norm(axis)])[0]
    turned = (Rotation.from_rotvec(toward * twist) * first).as_matrix()
    loaded = mi.load_dict({"type": "scene", "corner": corner(kind, side, turned, at)})
    assert isinstance(loaded, mi.Scene)
    imager = CoherentImager(loaded, sonar, {loaded.shapes()[0].id(): (1.0, 0.0)})
    field = np.zeros((imager.former.ranges, imager.former.sines), np.complex64)
    for part in (imager.glints, imager.corners):
        if part is not None:
            part.add(np.zeros(6), field)
    return float(20 * np.log10(abs(field.astype(complex).sum())) + 40 * np.log10(np.linalg.norm(at)))


CASES = [
    (0.05, 20.0, 0.0, 0.0),
    (0.05, 20.0, 0.7, 0.0),
    (0.05, 15.0, 0.3, 0.5),
    (0.1, 50.0, 0.0, 0.0),
    (0.1, 30.0, 1.1, -0.7),
]


@pytest.mark.parametrize(("side", "range_m", "twist", "aside"), essence(CASES, CASES[3]))
def test_trihedrals_have_the_strength_of_the_book(side: float, range_m: float, twist: float, aside: float) -> None:
    """10 log a^4 / 3 lambda^2 for triangular faces, 9 times that for square ones: 1 dB; two reflections miss it."""
    expected = 10 * math.log10(side**4 / (3 * WAVELENGTH**2))
    assert strength("triangular", side, range_m, twist=twist, aside=aside) == pytest.approx(expected, abs=1.0)
    assert strength("square", side, range_m, twist=twist, aside=aside) == pytest.approx(
        expected + 10 * math.log10(9), abs=1.0
    )
    assert strength("triangular", side, range_m, twist=twist, aside=aside, bounces=2) < expected - 10


@pytest.mark.parametrize(
    ("side", "range_m", "twist"), essence([(0.05, 20.0, 0.0), (0.05, 20.0, 0.5), (0.1, 50.0, 0.2)], (0.05, 20.0, 0.5))
)
def test_a_dihedral_has_the_strength_of_the_book(side: float, range_m: float, twist: float) -> None:
    """10 log 2 a^2 b^2 / lambda^2 with two reflections: 1 dB. One reflection misses it."""
    expected = 10 * math.log10(2 * side**4 / WAVELENGTH**2)
    assert strength("dihedral", side, range_m, twist=twist, bounces=2) == pytest.approx(expected, abs=1.0)
    assert strength("dihedral", side, range_m, twist=twist, bounces=1) < expected - 10


def test_a_near_corner_is_the_plate_of_its_aperture() -> None:
    """Within the Fresnel zone: a hexagon of the same aperture as a plane mirror, by Kirchhoff's integral. 0.7 dB.

    The aperture of a triangular trihedral is what its outline and the outline turned by half a turn have in common.
    """
    side, range_m = 0.2, 15.0
    corners = np.array([[np.cos(a), np.sin(a)] for a in np.radians([90, 210, 330])]) * side * math.sqrt(2 / 3)
    step = side / 600
    x, y = np.meshgrid(*[np.arange(-side, side, step) + step / 2] * 2)
    inside = np.ones_like(x, dtype=bool)
    for first, second in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        normal = np.array([-(second - first)[1], (second - first)[0]])
        for sign in (1, -1):
            inside &= normal[0] * (sign * x - first[0]) + normal[1] * (sign * y - first[1]) > 0
    k = 2 * math.pi / WAVELENGTH
    r = np.sqrt(range_m**2 + x[inside] ** 2 + y[inside] ** 2)
    plate = abs((k / (2 * math.pi) * np.exp(-2j * k * r) / r**2).sum()) * step**2
    expected = 20 * math.log10(plate) + 40 * math.log10(range_m)
    assert strength("triangular", side, range_m) == pytest.approx(expected, abs=0.7)
