"""How frames become what a network reads, and motions its labels; written on the array API, for NumPy and torch alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from array_api_compat import array_namespace, device
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import NoiseModel, load_noise, uniform
from mitsonar.config.data_recipe import Recipe
from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.geometry.scan_conversion import CartesianMap, cartesian_map

__all__ = ["LABELS", "Arrangement", "Labels", "arrangement_of"]

LABELS = ("raw", "quantised", "normx10")
LEVELS = 32
"""Values of a quantised label, 0 to 31 (Almanza-Medina, 3.4.1)."""

SCALE = 10.0
"""Normalised labels lie in +-10 ("Normx10", 3.4.2)."""

WHICH_LEVEL = 0x1E7E1
"""Between the seed of noise and the seed that draws its level."""

Layout = Literal["side", "stack", "channels"]
Coordinates = Literal["polar", "cartesian", "both"]


@dataclass(frozen=True)
class Labels:
    """Targets as a network learns them, and back.

    Attributes:
        kind: ``raw`` (m, m, rad; or m of height), ``quantised`` to 32 levels 0..31, or ``normx10``, in +-10.
        low, high: limits of the targets, from the recipe.
        names: of the targets, with units.
    """

    kind: str
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    names: tuple[str, ...]

    @classmethod
    def of(cls, kind: str, recipe: Recipe, frames: int) -> Labels:
        """The labels of samples of ``frames`` frames: their motion, or the height where a sample is one frame."""
        if kind not in LABELS:
            raise MitsonarError(f"unknown labels {kind!r}: {nearest_names(kind, LABELS)}")
        flight = recipe.flight
        if frames == 1:
            low, high = flight.heights
            return cls(kind, np.array([low]), np.array([high]), ("height (m)",))
        limit = np.array([flight.sideways_mm / 1e3, flight.forward_mm / 1e3, np.radians(flight.yaw_deg)])
        return cls(kind, -limit, limit, ("sideways (m)", "forward (m)", "yaw (rad)"))

    def encode(self, targets: ArrayLike) -> NDArray[np.float32]:
        """Labels ``(..., targets)`` of targets [m, rad]; quantised ones are clipped to the limits."""
        values = np.asarray(targets, dtype=float)
        if self.kind == "raw":
            return values.astype(np.float32)
        place = self._place(values)
        if self.kind == "quantised":
            return np.rint(np.clip(place, 0, 1) * (LEVELS - 1)).astype(np.float32)
        return ((2 * place - 1) * SCALE).astype(np.float32)

    def decode(self, labels: Any) -> NDArray[np.float64]:
        """Targets [m, rad] of labels or estimates of them ``(..., targets)``."""
        values = np.asarray(labels, dtype=float)
        if self.kind == "raw":
            return values
        place = values / (LEVELS - 1) if self.kind == "quantised" else (values / SCALE + 1) / 2
        return np.asarray(self.low + place * (self.high - self.low), dtype=np.float64)

    def _place(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """0 at the lower limit, 1 at the upper; 1/2 where both are one."""
        span = self.high - self.low
        return np.where(span > 0, (values - self.low) / np.where(span > 0, span, 1), 0.5)


@dataclass(frozen=True)
class Arrangement:
    """From frames of a batch to the input of a network.

    Attributes:
        views: names of the views, in the order in which they are placed.
        kind: ``image`` or ``vector``.
        layout: ``side``, frames side by side, view by view: (batch, 1, bins, frames * beams); ``stack``, one below the
            other; ``channels``, one channel each. Vectors are columns: (batch, 1, bins, frames * views), or channels.
        coordinates: ``polar``; ``cartesian``, fans in metres; ``both``, a pair of the two.
        noise: drawn from (seed, frame, cell).
        beams: of each view.
        maps: of scan conversion, for each view.
        range_levels: of vectors, neighbouring ones added up to so many; None: as they are.
        halves: vectors of the port and of the starboard half of each image, a pseudo-quadrant each (Almanza-Medina, fig.
            4.18).
        levels: of noise, of which each sample draws one by (seed, its first frame); empty: ``noise``, the first of them.
    """

    views: tuple[str, ...]
    kind: str
    layout: Layout
    coordinates: Coordinates
    noise: NoiseModel
    beams: dict[str, int]
    maps: dict[str, CartesianMap] = field(default_factory=dict)
    levels: tuple[NoiseModel, ...] = ()
    range_levels: int | None = None
    halves: bool = False

    def __call__(self, frames: dict[str, Any], numbers: Any, seed: int) -> Any:
        """The input of a network.

        Args:
            frames: by view ``(batch, frames, bins, beams)`` uint8 or float 0..1; as vectors ``(batch, frames, bins)`` with
                ``nonzero_VIEW`` beside; NumPy or torch, on any device.
            numbers: of the frames ``(batch, frames)``, integers: noise is theirs.
            seed: of the noise.
        """
        if self.levels:
            return self._each_its_level(frames, numbers, seed)
        xp = array_namespace(numbers)
        parts = [self.noisy(frames, view, numbers, seed + place) for place, view in enumerate(self.views)]
        if self.kind == "vector":
            axis = 1 if self.layout == "channels" else 3
            parts = [part[..., side] for part in parts for side in (0, 1)] if self.halves else parts
            columns = [self._coarser(part[:, q, :]) for part in parts for q in range(part.shape[1])]
            return xp.stack(columns, axis=1) if axis == 1 else xp.expand_dims(xp.stack(columns, axis=2), axis=1)
        polar = self._laid_out(parts) if self.coordinates != "cartesian" else None
        if self.coordinates == "polar":
            return polar
        fan = self._laid_out([self.maps[view].apply(part) for view, part in zip(self.views, parts, strict=True)])
        return fan if polar is None else (polar, fan)

    def _each_its_level(self, frames: dict[str, Any], numbers: Any, seed: int) -> Any:
        """Inputs of a batch whose samples draw their noise levels; made level by level, in the order of the batch."""
        xp = array_namespace(numbers)
        drawn, _ = uniform((numbers.shape[0], 1, 1), seed=seed + WHICH_LEVEL, frames=numbers[:, 0], like=numbers)
        level = xp.floor(drawn[:, 0, 0] * len(self.levels))
        groups = [(model, xp.nonzero(level == k)[0]) for k, model in enumerate(self.levels)]
        mine = {name: values for name, values in frames.items() if name.removeprefix("nonzero_") in self.views}
        parts = [
            replace(self, noise=model, levels=())(
                {name: xp.take(values, place, axis=0) for name, values in mine.items()},
                xp.take(numbers, place, axis=0),
                seed,
            )
            for model, place in groups
            if place.shape[0]
        ]
        back = xp.argsort(xp.concat([place for _, place in groups]))

        def joined(pieces: Any) -> Any:
            return xp.take(xp.concat(list(pieces), axis=0), back, axis=0)

        return tuple(map(joined, zip(*parts, strict=True))) if isinstance(parts[0], tuple) else joined(parts)

    def noisy(self, frames: dict[str, Any], view: str, numbers: Any, seed: int) -> Any:
        """Float32 frames of a view ``(batch, frames, bins, beams)``, with noise; vectors ``(batch, frames, bins)``, and of
        halves one more axis of 2."""
        values = frames[view]
        xp = array_namespace(values)
        batch, count, *shape = values.shape
        flat = xp.reshape(values, (batch * count, *shape))
        numbers = xp.reshape(numbers, (batch * count,))
        if len(shape) == 1:
            nonzero = xp.reshape(frames[f"nonzero_{view}"], flat.shape)
            flat = self.noise.apply_sum(flat, nonzero, self.beams[view], seed=seed, frames=numbers)
            return xp.reshape(flat, values.shape)
        if values.dtype == xp.uint8:
            flat = xp.astype(flat, xp.float32) * xp.asarray(1 / 255, dtype=xp.float32, device=device(flat))
        flat = self.noise.apply(flat, seed=seed, frames=numbers)
        if self.kind != "vector":
            return xp.reshape(flat, values.shape)
        if not self.halves:
            return xp.reshape(xp.sum(flat, axis=-1), values.shape[:-1])
        half = flat.shape[-1] // 2  # of odd beams the middle one is in neither
        both = [xp.sum(side, axis=-1) for side in (flat[..., :half], flat[..., flat.shape[-1] - half :])]
        return xp.reshape(xp.stack(both, axis=-1), (*values.shape[:-1], 2))

    def _coarser(self, vectors: Any) -> Any:
        """Vectors ``(batch, bins)`` with neighbouring bins added up."""
        if self.range_levels is None:
            return vectors
        batch, bins = vectors.shape
        split = array_namespace(vectors).reshape(vectors, (batch, self.range_levels, bins // self.range_levels))
        return array_namespace(vectors).sum(split, axis=-1)

    def _laid_out(self, parts: list[Any]) -> Any:
        """Frames of all views in one tensor ``(batch, channels, rows, columns)``."""
        xp = array_namespace(parts[0])
        pictures = [part[:, q, ...] for part in parts for q in range(part.shape[1])]
        if self.layout == "channels":
            return xp.stack(pictures, axis=1)
        return xp.expand_dims(xp.concat(pictures, axis=2 if self.layout == "side" else 1), axis=1)


def arrangement_of(
    recipe: Recipe,
    *,
    views: str | tuple[str, ...] | list[str] | None = None,
    kind: str | None = None,
    layout: str = "side",
    coordinates: str = "polar",
    noise: str | NoiseModel | Sequence[str | NoiseModel] = "none",
    cartesian_rows: int = 512,
    range_levels: int | None = None,
    halves: bool = False,
) -> Arrangement:
    """The arrangement that these words say, for the frames of a recipe; of several noise levels each sample draws one.

    Raises:
        MitsonarError: a word that is not known, or that does not fit the others.
    """
    known = {view.name: view for view in recipe.views}
    chosen = (views,) if isinstance(views, str) else tuple(known if views is None else views)
    levels = [noise] if isinstance(noise, str | NoiseModel) else list(noise) if isinstance(noise, Sequence) else []
    if not levels or not all(isinstance(level, str | NoiseModel) for level in levels):
        raise MitsonarError(f"noise must be a name, three numbers as text, or a NoiseModel: got {noise!r}; 'none' for none")
    kind = kind or recipe.kinds[0]
    for word, name, allowed in (
        (kind, "kind", ("image", "vector")),
        (layout, "layout", ("side", "stack", "channels")),
        (coordinates, "coordinates", ("polar", "cartesian", "both")),
    ):
        if word not in allowed:
            raise MitsonarError(f"{name} must be one of {', '.join(allowed)}: got {word!r}")
    wrong = [name for name in chosen if name not in known]
    if wrong or not chosen:
        raise MitsonarError(
            f"unknown view {wrong[0] if wrong else 'none'}: {nearest_names(wrong[0] if wrong else '', known)}"
        )
    if kind == "image" and "image" not in recipe.kinds:
        raise MitsonarError("the data set holds vectors only: read kind='vector', or make one with store: images or both")
    if kind == "vector" and (coordinates != "polar" or layout == "stack"):
        raise MitsonarError("vectors have no cartesian form and stand side by side or in channels: got " + layout)
    _check_vectors(recipe, kind, range_levels, halves)
    beams = {name: len(known[name].bearing_rad) for name in chosen}
    if kind == "image" and len(set(beams.values())) > 1 and layout != "side":
        raise MitsonarError(f"views of different widths stand side by side only: {beams}")
    maps = {}
    if coordinates != "polar":
        for name in chosen:
            maps[name] = cartesian_map(known[name].sonar.range_m, known[name].bearing_rad, cartesian_rows)
        if len({conversion.index.shape for conversion in maps.values()}) > 1 and layout != "side":
            raise MitsonarError("fans of different sizes stand side by side only")
    models = tuple(load_noise(level) if isinstance(level, str) else level for level in levels)
    return Arrangement(
        chosen,
        kind,
        layout,  # type: ignore[arg-type]
        coordinates,  # type: ignore[arg-type]
        models[0],
        beams,
        maps,
        models if len(models) > 1 else (),
        range_levels,
        halves,
    )


def _check_vectors(recipe: Recipe, kind: str, range_levels: int | None, halves: bool) -> None:
    """Words that are for vectors only.

    Raises:
        MitsonarError: they do not fit the others.
    """
    if (range_levels is not None or halves) and kind != "vector":
        raise MitsonarError("range_levels and halves are for vectors: read kind='vector', or leave them out")
    if halves and "image" not in recipe.kinds:
        raise MitsonarError("halves are cut from images: this data set holds vectors only; make one with store: images")
    bins = recipe.instrument.range_bins
    if range_levels is not None and not (1 <= range_levels <= bins and bins % range_levels == 0):
        fit = [str(count) for count in range(1, bins + 1) if bins % count == 0]
        raise MitsonarError(f"range_levels must divide the {bins} of the data set ({', '.join(fit)}): got {range_levels}")
