"""What an imaging sonar records of a ping: images, vectors, or both, of each view, with their labels."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.noise import NoiseModel, load_noise
from mitsonar.config.data import Recipe, array_names
from mitsonar.datasets.modality import Fields, Read, StoredArray, StoredAxis, Values, ground_reach
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import directions
from mitsonar.motion.pose import Pose, mounted, vehicle_rotation
from mitsonar.records.frames import LABELS

__all__ = ["ImageModality", "footprint"]

RAYS = 61
"""Rays over azimuth and over elevation whose ends make a footprint. Arcs bulge less than 0.2 mm between them."""

TEXTS = {
    "image": "{}: level times gain, 0..255 (or 0..1), row 0 nearest, column 0 most to port; zero means no echo",
    "vector": "{}: sum over the beams of the image in 0..1",
    "nonzero": "{}: number of beams with an echo, from which a vector's noise is drawn",
    "elevation_rad": "{}: elevation of the strongest echo; nan without echo",
    "shape_id": "{}: place in the scene of the shape of the strongest echo; -1 without echo",
    "object_id": "{}: object of the strongest echo, as its mesh numbers them; 0 for none, -1 without echo",
    "shadow": "{}: 0 not in shadow, 1 dark with sound or echoes beyond, 2 dark with all sound intercepted before",
}

OF_BODIES = {
    "body_pose": "of the recipe's bodies, in its order: x, y, z [m], pitch, roll, heading [rad]",
    "body_velocity": "of the recipe's bodies in the world's axes: of the origin [m/s], rotation vector a second [rad/s]",
}

PER_FRAME = {
    "height_m": StoredArray(
        np.dtype(np.float64), "height of the sonar over what is straight below it [m]; nan where nothing is"
    ),
    "dropped": StoredArray(np.dtype(np.uint32), "returns of the frame that lie outside the window and were dropped"),
    "saturated": StoredArray(np.dtype(np.uint32), "pixels of the frame at the maximum"),
}


MOST_DROPPED = 0.5
"""Part of a ping's rays that the window of a recipe may drop: a recipe that states its window means it."""


class ImageModality:
    """Images of a recipe with a sonar; see :class:`~mitsonar.datasets.modality.Modality`."""

    what = "frame"
    settled: tuple[str, ...] = ("gain", "level_scale")
    planned: tuple[str, ...] = ()
    decided_by: tuple[str, ...] = ()
    renderer_class = "mitsonar.datasets.scene_rendering:SceneRenderer"
    samples_class = "mitsonar.datasets.torch_pairs:SonarPairs"
    estimators = "zero,ecc,flow,phase,direct"
    variations = True

    def __init__(self, recipe: Recipe) -> None:
        self.recipe, self.sonar = recipe, recipe.instrument

    @property
    def stored(self) -> dict[str, StoredArray]:
        """Return the arrays of pixels, and what rendering reports of each frame."""
        views = {view.name: view for view in self.recipe.views}
        table = {}
        for name, (kind, view_name) in array_names(self.recipe).items():
            view, sums = views[view_name], kind in ("vector", "nonzero")
            shape: tuple[int, ...] = (view.sonar.range_bins, *(() if sums else (len(view.bearing_rad),)))
            dims = ("range", *(() if sums else (f"beam{self.recipe.suffix(view_name)}",)))
            table[name] = self._stored(kind, view_name, shape, dims)
        if self.recipe.bodies:
            shape, dims = (len(self.recipe.bodies), 6), ("body", "six")
            table |= {name: StoredArray(np.dtype(np.float64), about, shape, dims) for name, about in OF_BODIES.items()}
        return table | PER_FRAME

    @property
    def axes(self) -> dict[str, StoredAxis]:
        """Return the bearings of each view, and the ranges."""
        table = {}
        for view in self.recipe.views:
            suffix = self.recipe.suffix(view.name)
            about = "bearing of each beam's axis [rad], starboard positive"
            table[f"bearing_rad{suffix}"] = StoredAxis(view.bearing_rad, f"beam{suffix}", about)
        return table | {"range_m": StoredAxis(self.recipe.views[0].sonar.range_m, "range", "centre of each range bin [m]")}

    @property
    def attributes(self) -> Fields:
        """Return the sonar, and that of each view."""
        views = {view.name: view.sonar.model_dump() for view in self.recipe.views}
        return {
            "sonar": self.sonar.model_dump(),
            "views": views,
            "level": "linear" if self.recipe.recorded is None else self.recipe.recorded.level,
        }

    @property
    def ping_bytes(self) -> int:
        """Return the size of a frame's pixels and labels; of vectors alone that of sums and counts [bytes]."""
        if "image" not in self.recipe.kinds:
            return sum(view.sonar.range_bins * 8 for view in self.recipe.views)
        size = 1 if self.recipe.pixel == "uint8" else 4
        each = sum(len(view.bearing_rad) * view.sonar.range_bins * size for view in self.recipe.views)
        return each + len(self.recipe.labels) * 4 * each // size

    @property
    def sample_frames(self) -> int:
        """Return 2: estimators of images are compared on pairs."""
        return 2

    def reach(self, height: float, pitch: float = 0.0) -> NDArray[np.float64]:
        """Compute the footprint ``(n, 2)`` [m], or that of the field of view that the flight names.

        Raises:
            MitsonarError: the ground is out of range.
        """
        return footprint(self.sonar, self.recipe.mount.pose, height, self.recipe.flight.footprint_fov_deg, pitch)

    def _stored(self, kind: str, view: str, shape: tuple[int, ...], dims: tuple[str, ...]) -> StoredArray:
        """Return an array of this kind for a view."""
        known = {"image": self.recipe.pixel, "vector": np.float32, "nonzero": np.uint32}
        return StoredArray(np.dtype(known[kind] if kind in known else LABELS[kind]), TEXTS[kind].format(view), shape, dims)

    # ---------------------------------------------------------------- noise

    def noise_model(self, name: str) -> NoiseModel:
        """Return the noise model of a name.

        Raises:
            MitsonarError: unknown name.
        """
        return load_noise(name)

    # ---------------------------------------------------------------- checks

    def empty(self, read: Read, here: slice) -> NDArray[np.bool_]:
        """Find the frames without a pixel above 0 in any view ``(frames,)``."""
        dark = np.ones(here.stop - here.start, dtype=bool)
        for name, (kind, _) in array_names(self.recipe).items():
            if kind in ("image", "vector"):
                dark &= ~read(name, here).reshape(len(dark), -1).any(axis=1)
        return dark

    def faults(self, read: Read, here: slice) -> list[str]:
        """Check the limits of pixels, sums and labels. Return a sentence for each fault."""
        wrong = []
        beams = {view.name: len(view.bearing_rad) for view in self.recipe.views}
        for name, (kind, view) in array_names(self.recipe).items():
            values = read(name, here)
            low, high = _limits(kind, values, beams[view])
            known = values[~np.isnan(values)] if kind == "elevation_rad" else values
            if known.size and not (known.min() >= low and known.max() <= high):
                wrong.append(
                    f"{name}, frames {here.start}..{here.stop - 1}: values {known.min():g}..{known.max():g}, allowed "
                    f"{low:g}..{high:g}"
                )
            if kind == "nonzero":
                vector = read(name.replace("nonzero", "vector", 1), here)
                if ((vector > 0) != (values > 0)).any() or (vector > values * (1 + 1e-6)).any():
                    wrong.append(
                        f"{name}, frames {here.start}..{here.stop - 1}: sums and numbers of echoes contradict each other"
                    )
        return wrong

    def warnings(self, read: Read) -> list[str]:
        """Warn of motions far below a bin, of returns outside the window, and of a gain that is too high."""
        from mitsonar.simulation.pings import NEGLIGIBLE  # a stored set is read without a simulator

        sentences = []
        flight, bin_mm = self.recipe.flight, 1e3 * self.sonar.bin_m
        largest_mm = max(flight.sideways_mm, flight.forward_mm)
        if flight.kind == "random" and flight.pings > 1 and 0 < largest_mm < bin_mm / 100:
            sentences.append(
                f"motions of at most {largest_mm:g} mm are less than a hundredth of a range bin ({bin_mm:.2g} mm): "
                "flight.sideways_mm and forward_mm are in millimetres"
            )
        dropped, saturated = (read(name).astype(np.int64) for name in ("dropped", "saturated"))
        rays, stated = self.sonar.rays, {"range_min", "range_max"} <= set(self.recipe.sonar or {})
        if dropped.mean() > (MOST_DROPPED if stated else NEGLIGIBLE) * rays:
            sentences.append(
                f"{dropped.mean():,.0f} returns a ping ({100 * dropped.mean() / rays:.2g} % of {rays:,} rays) lie outside "
                f"the window {self.sonar.range_min:g}..{self.sonar.range_max:g} m and were dropped: set sonar.range_min "
                "and range_max"
            )
        pixels = sum(len(view.bearing_rad) * view.sonar.range_bins for view in self.recipe.views)
        if saturated.mean() > 0.01 * pixels:
            sentences.append(
                f"{100 * saturated.mean() / pixels:.2g} % of pixels are at the maximum (more than 1 %): the gain, set on "
                "the first 20 frames, is too high for the rest"
            )
        return sentences


def _limits(kind: str, values: Values, beams: int) -> tuple[float, float]:
    """Return the lowest and the highest value that an array of this kind may hold."""
    match kind:
        case "image":
            return 0, 255 if values.dtype == np.uint8 else 1
        case "vector" | "nonzero":
            return 0, beams
        case "elevation_rad":
            return -np.pi / 2, np.pi / 2
        case "shadow":
            return 0, 2
        case _:
            return -1, np.inf


@lru_cache(maxsize=8)
def footprint(
    sonar: Sonar, mount: Pose, height: float, fov_deg: tuple[float, float] | None = None, pitch: float = 0.0
) -> NDArray[np.float64]:
    """Compute a sonar's footprint on the ground z = 0: corners ``(n, 2)``, starboard and forward of the vehicle [m].

    Args:
        sonar: whose field of view it is.
        mount: pose of the sonar on the vehicle.
        height: of the vehicle [m].
        fov_deg: azimuth and elevation in place of the sonar's own [deg].
        pitch: of the vehicle [rad], > 0 down.

    Raises:
        MitsonarError: the ground is out of range.
    """
    azimuth, elevation = fov_deg or (sonar.azimuth_fov_deg, sonar.elevation_fov_deg)
    outer = max(math.radians(azimuth) / 2, sonar.bearing_rad[-1] + sonar.beam_width_rad / 2 if fov_deg is None else 0)
    b, e = np.meshgrid(np.linspace(-outer, outer, RAYS), np.radians(np.linspace(-elevation, elevation, RAYS)) / 2)
    local = directions(sonar.bearing, b.ravel(), e.ravel())
    eye = mounted(Pose(0, 0, height, pitch), mount)[0]
    return ground_reach(eye[:3], vehicle_rotation(eye).apply(local), sonar.range_max)
