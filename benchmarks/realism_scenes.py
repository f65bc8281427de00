"""Scenes that resemble what the real recordings show, and how their sonars stood: a guess, since none is documented."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = ["STAGES", "Stage"]


@dataclass(frozen=True)
class Stage:
    """A scene and a sonar in it.

    Attributes:
        build: makes the scene in a folder.
        start: pose of the first frame [m, rad].
        step: motion from frame to frame.
        sonar: fields that the recording does not tell.
        pictures: whether frames pass through fan pictures of 8 bit, as the recording did.
        video: whether these pass through MPEG-4.
        mirrors: reflection coefficient and rms height [m] of smooth shapes.
        sway_m: standard deviation of the sonar's place from ping to ping, along each axis [m].
        volume_db: strength of the water [dB re 1/m] where the fit has no scale: noise, volume and full scale move to it.
    """

    build: Callable[[Path], mi.Scene]
    start: NDArray[np.float64]
    step: NDArray[np.float64]
    sonar: dict[str, Any]
    pictures: str = ""
    video: bool = False
    mirrors: dict[str, tuple[float, float]] = field(default_factory=dict)
    volume_db: float | None = None
    sway_m: float = 0.0


def pose(height: float, pitch_deg: float, y: float = 0.0, x: float = 0.0, heading_deg: float = 0.0) -> NDArray[np.float64]:
    """Return a pose: x, y, z [m], pitch, roll, heading [rad]."""
    return np.array([x, y, height, math.radians(pitch_deg), 0.0, math.radians(heading_deg)])


STILL = np.zeros(6)

RIVER_SWAY_M = 1.3e-3
"""How far sonars in a river sway from ping to ping, along each axis [m]. Of the mounts nothing is known. The bright ground
of lamprey2 gave this number, lamprey4 follows."""


Shape = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


def ground(size: tuple[float, float], step: float, rms: float, longest: float, seed: int, shape: Shape) -> trimesh.Trimesh:
    """Make rough ground ahead of the origin: heights of a power law of 3 over the wavenumber, on a shape.

    Args:
        size: across and ahead [m].
        step: of the grid [m].
        rms: of the roughness [m].
        longest: wavelength from which its spectrum is flat [m].
        seed: of the roughness.
        shape: mean height at x and y [m].
    """
    across, ahead = (round(length / step) for length in size)
    fx, fy = np.meshgrid(np.fft.fftfreq(across, step), np.fft.rfftfreq(ahead, step), indexing="ij")
    weight = (1 + (np.hypot(fx, fy) * longest) ** 2) ** -1.1
    white = np.random.default_rng(seed).normal(size=(across, ahead))
    height = np.fft.irfft2(np.fft.rfft2(white) * weight, (across, ahead))
    x, y = np.meshgrid((np.arange(across) - across / 2) * step, np.arange(ahead) * step, indexing="ij")
    vertices = np.stack([x, y, height / height.std() * rms + shape(x, y)], axis=-1).reshape(-1, 3)
    corner = (np.arange(across - 1)[:, None] * ahead + np.arange(ahead - 1)).ravel()
    one = np.stack([corner, corner + ahead, corner + ahead + 1], axis=1)
    second = np.stack([corner, corner + ahead + 1, corner + 1], axis=1)
    return trimesh.Trimesh(vertices, np.concatenate([one, second]), process=False)


def adjacent(x: NDArray[np.float64], y: NDArray[np.float64], half: float, wander: float, seed: int) -> NDArray[np.float64]:
    """Return how far a place lies outside a strip whose two edges wander [m]."""
    phase = np.random.default_rng(seed).uniform(0, 2 * math.pi, (2, 6))
    side = [sum(wander / k**1.2 * np.sin(1.1 * k**1.1 * y + phase[one, k - 1]) for k in range(1, 7)) for one in (0, 1)]
    return np.asarray(np.abs(x) - half - np.where(x < 0, side[0], side[1]))


def hull(points: NDArray[np.float64]) -> trimesh.Trimesh:
    """Make the convex hull of points."""
    result = ConvexHull(points)
    one, second = (points[result.simplices[:, k]] - points[result.simplices[:, 0]] for k in (1, 2))
    outward = (np.cross(one, second) * result.equations[:, :3]).sum(axis=1) > 0
    faces = np.where(outward[:, None], result.simplices, result.simplices[:, ::-1])
    return trimesh.Trimesh(points, faces, process=False)


def stones(
    count: int, across: float, ahead: tuple[float, float], size: tuple[float, float], seed: int, shape: Shape
) -> trimesh.Trimesh:
    """Make stones that lie on a shape: convex bodies of random points, more small ones than large ones."""
    rng, result = np.random.default_rng(seed), []
    for _ in range(count):
        edge = size[0] * (size[1] / size[0]) ** (rng.random() ** 2)
        body = hull(rng.normal(size=(24, 3)) * edge / 3 * [1, 1, 0.6])
        x, y = rng.uniform(-across / 2, across / 2), rng.uniform(*ahead)
        result.append(placed(body, (x, y, float(shape(np.array(x), np.array(y)))), (0, 0, 360 * rng.random())))
    return merged(result)


Paint = float | dict[str, Any]
"""A reflectivity, or Mitsuba's dictionary of a texture."""


def loaded(parts: dict[str, tuple[trimesh.Trimesh, Paint]], folder: Path, **others: dict[str, Any]) -> mi.Scene:
    """Load meshes with their reflectivities, and other shapes."""
    import mitsuba as mi

    shapes = {name: mesh(body, folder / f"{name}.ply", value) for name, (body, value) in parts.items()}
    scene: mi.Scene = mi.load_dict({"type": "scene", **shapes, **others})
    return scene


def patches(low: float, high: float, size: float, seed: int) -> dict[str, Any]:
    """Return a reflectivity that varies in patches of several sizes, the largest of ``size`` [m]."""
    where = {"coordinates": "position", "cell_size": size, "octaves": 5, "contrast": 3.0, "seed": seed}
    return {"type": "perlin", **where, "low": low, "high": high}


def parted(body: trimesh.Trimesh, outside: Shape, soft: float = 0.0) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Part ground into its faces where ``outside`` is negative, and the others; they mix over a width of ``soft`` [m]."""
    middle = body.vertices[body.faces].mean(axis=1)
    mixed = soft * np.random.default_rng(len(middle)).logistic(size=len(middle))
    beyond = outside(middle[:, 0], middle[:, 1]) + mixed > 0
    both = (trimesh.Trimesh(body.vertices, body.faces[part], process=False) for part in (~beyond, beyond))
    for one in (stored := list(both)):
        one.remove_unreferenced_vertices()
    return stored[0], stored[1]


def rough(body: trimesh.Trimesh, rms: float, longest: float, edge: float, seed: int) -> trimesh.Trimesh:
    """Give a body relief: its surface moves along its normals by a sum of waves of random directions.

    Args:
        body: closed.
        rms: of the relief [m].
        longest: largest wavelength, the smallest is a fifth of it [m].
        edge: largest edge of the faces afterwards [m].
        seed: of the waves.
    """
    subdivide: Callable[..., Any] = trimesh.remesh.subdivide_to_size
    vertices, faces = subdivide(body.vertices, body.faces, edge, max_iter=12)
    body = trimesh.Trimesh(vertices, faces)
    body.merge_vertices()
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(48, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    wave = 2 * math.pi / (longest * 5 ** -rng.random(48))
    height = np.cos(body.vertices @ (way * wave[:, None]).T + rng.uniform(0, 2 * math.pi, 48)).sum(axis=1)
    moved = body.vertices + body.vertex_normals * (height / math.sqrt(24) * rms)[:, None]
    return trimesh.Trimesh(moved, body.faces, process=False)


def river_bed(folder: Path) -> mi.Scene:
    """Make a gravel bed with a pit between two banks of mud, and stones with rims and shadows."""

    def outside(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return adjacent(x - 0.05 * (y - 3), y, 0.75, 0.1, 11)

    def shape(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        pit = np.hypot((x + 0.05) / 0.4, (y - 3.8) / 0.6)
        rim = 0.1 * np.exp(-(((pit - 1.1) / 0.35) ** 2)) - 0.16 * np.exp(-((pit / 0.8) ** 4))
        return np.asarray(0.6 * rim - 0.5 / (1 + np.exp(-outside(x, y) * 9)) - 0.02 * (y - 3))

    bed, bank = parted(ground((6, 12), 0.012, 0.012, 0.25, 3, shape), outside, 0.08)
    parts: dict[str, tuple[trimesh.Trimesh, Paint]] = {
        "bed": (bed, patches(0.0005, 0.03, 0.8, 31)),
        "bank": (bank, patches(0.0, 3e-4, 0.4, 32)),
        "stones": (stones(900, 1.7, (1.8, 11), (0.02, 0.12), 4, shape), 0.03),
        "scattered": (stones(150, 5, (2, 11), (0.03, 0.2), 5, shape), 6e-4),
    }
    return loaded(parts, folder / "river")


def far_bed(folder: Path) -> mi.Scene:
    """Make a bed of bars across the flow between two banks of mud, with stones."""

    def outside(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return adjacent(x - 0.35, y, 0.75, 0.2, 12)

    def shape(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        bars = 0.004 * np.sin(2 * math.pi * (y + 0.6 * x + 0.5 * np.sin(1.7 * x) + 0.3 * np.sin(2.3 * y)) / 0.45)
        return np.asarray(bars - 0.5 / (1 + np.exp(-outside(x, y) * 9)))

    bed, bank = parted(ground((10, 17), 0.02, 0.015, 0.3, 6, shape), outside, 0.08)
    parts: dict[str, tuple[trimesh.Trimesh, Paint]] = {
        "bed": (bed, patches(0.0005, 0.05, 1.2, 61)),
        "bank": (bank, patches(0.0, 2e-4, 0.6, 62)),
        "stones": (stones(500, 2.0, (5, 16), (0.03, 0.14), 7, shape), 0.04),
    }
    return loaded(parts, folder / "far")


def sparse_bottom(folder: Path) -> mi.Scene:
    """Make a flat bottom of mud with low ridges of rubble."""

    def shape(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        y = y + 0.2 * np.sin(2.1 * x + 1) + 0.1 * np.sin(5.3 * x)
        one = np.exp(-(((y - 15.0 + 0.9 * x) / 0.2) ** 2)) * (x < 1.8)
        second = np.exp(-(((y - 16.6 - 0.6 * x) / 0.2) ** 2)) * (x > -1.0) * (x < 0.3)
        return np.asarray(0.08 * (one + second))

    def low(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(0.03 - shape(x, y))

    ridges, mud = parted(ground((8, 26), 0.03, 0.004, 1.0, 8, shape), low, 0.01)
    parts: dict[str, tuple[trimesh.Trimesh, Paint]] = {
        "mud": (mud, patches(0.0, 5e-4, 2.0, 81)),
        "ridges": (ridges, patches(0.0, 0.02, 0.5, 82)),
    }
    return loaded(parts, folder / "sparse")


def placed(
    body: trimesh.Trimesh, position: tuple[float, float, float], turn_deg: tuple[float, float, float]
) -> trimesh.Trimesh:
    """Turn a body about x, y, z and move it."""
    turn = Rotation.from_euler("xyz", turn_deg, degrees=True)
    return trimesh.Trimesh(turn.apply(body.vertices) + np.asarray(position), body.faces, process=False)


def merged(bodies: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Merge bodies into one mesh."""
    first = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    faces = [body.faces + start for body, start in zip(bodies, first[:-1], strict=True)]
    return trimesh.Trimesh(np.concatenate([body.vertices for body in bodies]), np.concatenate(faces), process=False)


def mesh(body: trimesh.Trimesh, path: Path, reflectivity: Paint) -> dict[str, Any]:
    """Write a mesh and return it as Mitsuba's dictionary."""
    path.parent.mkdir(parents=True, exist_ok=True)
    body.export(path)
    return {"type": "ply", "filename": str(path), "face_normals": True, "bsdf": paint(reflectivity)}


def paint(reflectivity: Paint) -> dict[str, Any]:
    """Return a diffuse surface."""
    even = {"type": "uniform", "value": reflectivity}
    return {"type": "diffuse", "reflectance": reflectivity if isinstance(reflectivity, dict) else even}


def floor(reflectivity: Paint, half: float = 6.0) -> dict[str, Any]:
    """Return level ground."""
    import mitsuba as mi

    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(half), "bsdf": paint(reflectivity)}


def flat(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return level ground."""
    return np.zeros(np.broadcast(x, y).shape)


def tank_with_tyre(folder: Path) -> mi.Scene:
    """Make a dark floor of patches, a tyre with tread on its side, a box and a wall's corner, all smooth with relief."""
    tyre = placed(trimesh.creation.torus(0.11, 0.04, major_sections=96, minor_sections=32), (0.12, 2.4, 0.02), (30, 0, 25))
    box = placed(trimesh.creation.box((0.05, 0.3, 0.12)), (-0.3, 3.1, 0.06), (0, 0, 35))
    lid = placed(trimesh.creation.box((0.25, 0.04, 0.1)), (-0.28, 2.95, 0.05), (0, 0, -25))
    wall = placed(trimesh.creation.box((1.5, 0.05, 0.8)), (1.15, 3.55, 0.4), (0, 0, -40))
    parts: dict[str, tuple[trimesh.Trimesh, Paint]] = {
        "tyre": (rough(tyre, 3e-3, 0.08, 0.005, 41), 5e-4),
        "box": (rough(box, 2e-3, 0.08, 0.006, 42), 0.005),
        "lid": (rough(lid, 2e-3, 0.08, 0.006, 43), 0.008),
        "wall": (rough(wall, 3e-3, 0.15, 0.01, 44), 0.02),
    }
    return loaded(parts, folder / "tyre", floor=floor(patches(0.0, 3e-7, 0.4, 45)))


def tank_with_chain(folder: Path) -> mi.Scene:
    """Make a dark floor of patches, beams of wood, and a chain in two bows that sinks into the floor here and there.

    Chain and beams are smooth, with relief.
    """
    links = []
    for k, along in enumerate(np.linspace(0, 1, 96)):
        x = -0.3 + 0.5 * math.sin(2.2 * along) ** 2 + 0.35 * along
        y = 2.75 + 0.22 * math.sin(7.5 * along + 0.9) - 0.25 * along
        turn = (90.0 * (k % 2) + 20 * math.sin(5.0 * k), 20 * math.cos(3.0 * k), 137.0 * k)
        links.append(
            placed(
                trimesh.creation.torus(0.028, 0.009, major_sections=32, minor_sections=12),
                (x, y, 0.01 + 0.03 * math.sin(37.0 * along)),
                turn,
            )
        )
    beams = [placed(trimesh.creation.box((0.08, 0.9, 0.1)), (0.2 + 0.4 * k, 3.6, 0.05), (0, 0, 12 - 80 * k)) for k in (0, 1)]
    parts: dict[str, tuple[trimesh.Trimesh, Paint]] = {
        "chain": (rough(merged(links), 5e-4, 0.02, 0.004, 51), 0.02),
        "beams": (rough(merged(beams), 3e-3, 0.1, 0.008, 52), 0.03),
    }
    return loaded(parts, folder / "chain", floor=floor(patches(0.0, 2e-5, 0.4, 53)))


def small_tank(folder: Path) -> mi.Scene:
    """Make a rough strip of floor that ends in smooth floor, a low body with a shadow, and a seam."""

    def outside(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.abs(y - 0.9 + 0.05 * np.sin(5 * x)) - 0.22 - 0.03 * np.sin(9 * x + 1))

    body = placed(trimesh.creation.capsule(0.1, 0.012, count=[24, 24]), (0.05, 0.95, 0.01), (90, 0, 60))
    seam = rough(placed(trimesh.creation.box((1.2, 0.02, 0.012)), (0.2, 1.45, 0.0), (0, 0, -20)), 0.003, 0.2, 0.01, 93)
    strip, smooth = parted(ground((3, 2.4), 0.006, 0.004, 0.3, 9, flat), outside, 0.04)
    parts: dict[str, tuple[trimesh.Trimesh, Paint]] = {
        "strip": (strip, patches(0.02, 0.3, 0.3, 91)),
        "smooth": (smooth, patches(0.0, 0.004, 0.3, 92)),
        "body": (body, 0.1),
        "seam": (seam, 0.04),
    }
    return loaded(parts, folder / "small")


DIDSON = {"absorption_db_per_m": 0.84, "ping_groups": 8, "looks": 2}
ARIS_3000 = {"absorption_db_per_m": 2.34, "ping_groups": 8, "looks": 2}
"""What fan pictures do not tell. Groups are those of the makers, 12 and 16 beams a ping."""

STAGES = {
    "DIDSON lamprey2": Stage(river_bed, pose(0.9, 10), STILL, DIDSON, pictures="lamprey2", video=True, sway_m=RIVER_SWAY_M),
    "DIDSON lamprey4": Stage(far_bed, pose(1.9, 11.5), STILL, DIDSON, pictures="lamprey4", video=True, sway_m=RIVER_SWAY_M),
    "ARIS 1200": Stage(
        sparse_bottom,
        pose(1.3, 7),
        STILL,
        {"elevation_fov_deg": 14.0, "absorption_db_per_m": 0.37, "ping_groups": 3},
        volume_db=-45.0,
    ),
    "ARIS 3000 tyre": Stage(
        tank_with_tyre,
        pose(1.3, 29),
        np.array([0.0, 0.0055, 0.0, 0.0, 0.0, math.radians(0.16)]),
        ARIS_3000,
        pictures="translate_tyre",
        mirrors={"tyre": (0.15, 3e-6), "box": (0.2, 3e-6), "lid": (0.2, 3e-6), "wall": (0.7, 3e-6)},
    ),
    "ARIS 3000 chain": Stage(
        tank_with_chain,
        pose(1.3, 29),
        np.array([0.0, 0.0068, 0.0, 0.0, 0.0, math.radians(0.09)]),
        ARIS_3000,
        pictures="forward_chain",
        mirrors={"chain": (0.94, 3e-6), "beams": (0.2, 1e-5)},
    ),
    "Oculus 2.1 MHz": Stage(small_tank, pose(0.27, 18), STILL, {"absorption_db_per_m": 1.14}),
}
"""By the name of the recording."""
