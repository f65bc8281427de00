"""How frames become the input of a network, and motions its labels; for NumPy and torch, on the array API."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias, cast, get_args

import numpy as np
from array_api_compat import array_namespace, device
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import NoiseModel, load_noise, uniform
from mitsonar.config.data import Recipe
from mitsonar.errors import MitsonarError, suggest_names
from mitsonar.geometry.fan import CartesianMap, cartesian_map

__all__ = ["LABELS", "Arrangement", "ArrayOfAnyLibrary", "Labels", "arrangement_of"]

ArrayOfAnyLibrary: TypeAlias = Any
"""An array of NumPy or torch on any device. Code on the array API accepts both, and returns the type that it was given."""

InputOfAnyLibrary: TypeAlias = ArrayOfAnyLibrary | tuple[ArrayOfAnyLibrary, ...]
"""Input of a network: one array, or a polar and a Cartesian array."""

LabelKind = Literal["raw", "quantised", "normx10"]
LABELS: tuple[str, ...] = get_args(LabelKind)
"""Kinds of labels; see :class:`Labels`."""

LEVELS = 32
"""Number of values of a quantised label, 0 to 31 (Almanza-Medina, 3.4.1)."""

SCALE = 10.0
"""Limit of normalised labels, which lie in +-10 ("Normx10", Almanza-Medina, 3.4.2)."""

WHICH_LEVEL = 0x1E7E1
"""Offset of the seed that draws a noise level from the seed of the noise."""

Layout = Literal["side", "stack", "channels"]
Coordinates = Literal["polar", "cartesian", "both"]


@dataclass(frozen=True)
class Labels:
    """Encoder of targets to the labels that a network learns, and decoder of labels.

    Attributes:
        kind: ``raw`` (m, m, rad; or m for heights), ``quantised`` to 32 levels 0..31, or ``normx10``, in +-10.
        low, high: limits of the targets in the recipe ``(targets,)``.
        names: of the targets, with units.
    """

    kind: str
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    names: tuple[str, ...]

    @classmethod
    def of(cls, kind: str, recipe: Recipe, frames: int) -> Labels:
        """Return the labels for samples with ``frames`` frames: motions, or heights if a sample is one frame.

        Raises:
            MitsonarError: unknown kind.
        """
        if kind not in LABELS:
            raise MitsonarError(f"unknown labels {kind!r}: {suggest_names(kind, LABELS)}")
        flight = recipe.flight
        if frames == 1:
            low, high = (height + recipe.mount.up_m for height in flight.heights)  # of the sonar, not of its vehicle
            return cls(kind, np.array([low]), np.array([high]), ("height (m)",))
        limit = np.array([flight.sideways_mm / 1e3, flight.forward_mm / 1e3, np.radians(flight.yaw_deg)])
        return cls(kind, -limit, limit, ("sideways (m)", "forward (m)", "yaw (rad)"))

    def encode(self, targets: ArrayLike) -> NDArray[np.float32]:
        """Compute the labels ``(..., targets)`` of targets [m, rad]; quantised labels are clipped to the limits."""
        values = np.asarray(targets, dtype=float)
        if self.kind == "raw":
            return values.astype(np.float32)
        fraction = self._fraction(values)
        if self.kind == "quantised":
            return np.rint(np.clip(fraction, 0, 1) * (LEVELS - 1)).astype(np.float32)
        return ((2 * fraction - 1) * SCALE).astype(np.float32)

    def decode(self, labels: ArrayLike) -> NDArray[np.float64]:
        """Compute the targets [m, rad] of labels ``(..., targets)``, or of estimates of labels."""
        values = np.asarray(labels, dtype=float)
        if self.kind == "raw":
            return values
        fraction = values / (LEVELS - 1) if self.kind == "quantised" else (values / SCALE + 1) / 2
        return np.asarray(self.low + fraction * (self.high - self.low), dtype=np.float64)

    def _fraction(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map the lower limit to 0 and the upper limit to 1; return 1/2 if the limits are equal."""
        span = self.high - self.low
        return np.where(span > 0, (values - self.low) / np.where(span > 0, span, 1), 0.5)


@dataclass(frozen=True)
class Arrangement:
    """Conversion of the frames of a batch to the input of a network.

    Attributes:
        views: names of the views, in the order of their placement.
        kind: ``image`` or ``vector``.
        layout: ``side``: frames side by side, view by view (batch, 1, bins, frames * beams); ``stack``: one below the
            other; ``channels``: one channel each. Vectors are columns (batch, 1, bins, frames * views), or channels.
        coordinates: ``polar``; ``cartesian``, fans in metres; ``both``, a pair of the two.
        noise: noise model; the noise depends on seed, frame and cell.
        beams: number of beams of each view.
        maps: scan conversion of each view.
        range_levels: number of levels in a vector, whose bins are summed in groups; None: one level per bin.
        halves: whether images become vectors of their port and starboard halves (Almanza-Medina, fig. 4.18).
        levels: noise levels, from which each sample draws one by seed and first frame; empty: ``noise`` for all samples.
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

    def __call__(self, frames: Mapping[str, ArrayOfAnyLibrary], numbers: ArrayOfAnyLibrary, seed: int) -> InputOfAnyLibrary:
        """Arrange the input of a network.

        Args:
            frames: arrays keyed by view, of NumPy or torch, on any device: images ``(batch, frames, bins, beams)`` of uint8
                or float in 0..1, or vectors ``(batch, frames, bins)`` together with ``nonzero_VIEW``.
            numbers: of the frames ``(batch, frames)``, integers that seed the noise.
            seed: of the noise.

        Returns:
            One float32 array ``(batch, channels, rows, columns)``, or a polar and a Cartesian array.
        """
        if self.levels:
            return self._with_drawn_levels(frames, numbers, seed)
        xp = array_namespace(numbers)
        parts = [self.noisy(frames, view, numbers, seed + index) for index, view in enumerate(self.views)]
        if self.kind == "vector":
            axis = 1 if self.layout == "channels" else 3
            parts = [part[..., side] for part in parts for side in (0, 1)] if self.halves else parts
            columns = [self._rebin(part[:, q, :]) for part in parts for q in range(part.shape[1])]
            return xp.stack(columns, axis=1) if axis == 1 else xp.expand_dims(xp.stack(columns, axis=2), axis=1)
        polar = self._lay_out(parts) if self.coordinates != "cartesian" else None
        if self.coordinates == "polar":
            return polar
        fan = self._lay_out([self.maps[view].apply(part) for view, part in zip(self.views, parts, strict=True)])
        return fan if polar is None else (polar, fan)

    def _with_drawn_levels(
        self, frames: Mapping[str, ArrayOfAnyLibrary], numbers: ArrayOfAnyLibrary, seed: int
    ) -> InputOfAnyLibrary:
        """Arrange a batch whose samples draw their noise levels; the order of the batch is preserved."""
        # 1. Draw the level of each sample, and group the samples by level.
        xp = array_namespace(numbers)
        level = self._drawn_levels(numbers, seed)
        groups = [(model, xp.nonzero(level == k)[0]) for k, model in enumerate(self.levels)]
        view_frames = {name: values for name, values in frames.items() if name.removeprefix("nonzero_") in self.views}
        # 2. Arrange each group with a single noise model.
        parts = [
            replace(self, noise=model, levels=())(
                {name: xp.take(values, rows, axis=0) for name, values in view_frames.items()},
                xp.take(numbers, rows, axis=0),
                seed,
            )
            for model, rows in groups
            if rows.shape[0]
        ]
        # 3. Join the groups and restore the order of the batch.
        order = xp.argsort(xp.concat([rows for _, rows in groups]))

        def joined(pieces: Iterable[ArrayOfAnyLibrary]) -> ArrayOfAnyLibrary:
            return xp.take(xp.concat(list(pieces), axis=0), order, axis=0)

        return tuple(map(joined, zip(*parts, strict=True))) if isinstance(parts[0], tuple) else joined(parts)

    def _drawn_levels(self, numbers: ArrayOfAnyLibrary, seed: int) -> ArrayOfAnyLibrary:
        """Draw the index of the noise level of each sample ``(batch,)`` from the numbers of its frames."""
        drawn, _ = uniform((numbers.shape[0], 1, 1), seed=seed + WHICH_LEVEL, frames=numbers[:, 0], like=numbers)
        return array_namespace(numbers).floor(drawn[:, 0, 0] * len(self.levels))

    def for_sample(self, numbers: NDArray[np.int64], seed: int) -> Arrangement:
        """Return the arrangement with the noise level that a sample draws, given the numbers of its frames ``(frames,)``."""
        if not self.levels:
            return self
        return replace(self, noise=self.levels[int(self._drawn_levels(numbers[None], seed)[0])], levels=())

    def noisy(
        self, frames: Mapping[str, ArrayOfAnyLibrary], view: str, numbers: ArrayOfAnyLibrary, seed: int
    ) -> ArrayOfAnyLibrary:
        """Add noise to the frames of a view.

        Args:
            frames: as in :meth:`__call__`.
            view: name of the view.
            numbers: of the frames ``(batch, frames)``.
            seed: of the noise.

        Returns:
            Images ``(batch, frames, bins, beams)`` float32, vectors ``(batch, frames, bins)``, or halves of images
            ``(batch, frames, bins, 2)``.
        """
        values = frames[view]
        xp = array_namespace(values)
        batch, count, *shape = values.shape
        flat = xp.reshape(values, (batch * count, *shape))
        numbers = xp.reshape(numbers, (batch * count,))
        # Vectors: the noise of a sum over beams, given the number of beams that have an echo.
        if len(shape) == 1:
            nonzero = xp.reshape(frames[f"nonzero_{view}"], flat.shape)
            flat = self.noise.apply_sum(flat, nonzero, self.beams[view], seed=seed, frames=numbers)
            return xp.reshape(flat, values.shape)
        # Images: scale to 0..1 and add noise to each pixel; sum over beams afterwards if vectors are requested.
        if values.dtype == xp.uint8:
            flat = xp.astype(flat, xp.float32) * xp.asarray(1 / 255, dtype=xp.float32, device=device(flat))
        flat = self.noise.apply(flat, seed=seed, frames=numbers)
        if self.kind != "vector":
            return xp.reshape(flat, values.shape)
        if not self.halves:
            return xp.reshape(xp.sum(flat, axis=-1), values.shape[:-1])
        half = flat.shape[-1] // 2  # with an odd number of beams, the middle one is in neither half
        both = [xp.sum(side, axis=-1) for side in (flat[..., :half], flat[..., flat.shape[-1] - half :])]
        return xp.reshape(xp.stack(both, axis=-1), (*values.shape[:-1], 2))

    def _rebin(self, vectors: ArrayOfAnyLibrary) -> ArrayOfAnyLibrary:
        """Sum neighbouring bins of vectors ``(batch, bins)`` into ``range_levels`` levels."""
        if self.range_levels is None:
            return vectors
        batch, bins = vectors.shape
        split = array_namespace(vectors).reshape(vectors, (batch, self.range_levels, bins // self.range_levels))
        return array_namespace(vectors).sum(split, axis=-1)

    def _lay_out(self, parts: list[ArrayOfAnyLibrary]) -> ArrayOfAnyLibrary:
        """Join the frames of all views into one array ``(batch, channels, rows, columns)``."""
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
    """Build the arrangement of a recipe's frames.

    The options are those of :class:`Arrangement`. By default the arrangement uses all stored views, of the first stored
    kind. If ``noise`` is a list, each sample draws one of its levels. ``cartesian_rows`` is the number of pixels of a fan in
    the forward direction.

    Raises:
        MitsonarError: an option is unknown, or does not fit the others.
    """
    views_by_name = {view.name: view for view in recipe.views}
    names = (views,) if isinstance(views, str) else tuple(views_by_name if views is None else views)
    models = _noise_models(noise)
    kind = kind or recipe.kinds[0]
    _check_names(recipe, names, kind, layout, coordinates)
    _check_vectors(recipe, kind, range_levels, halves)
    beams = {name: len(views_by_name[name].bearing_rad) for name in names}
    if kind == "image" and len(set(beams.values())) > 1 and layout != "side":
        raise MitsonarError(f"views of different widths can only be side by side: {beams}; give layout='side'")
    maps = {}
    if coordinates != "polar":
        for name in names:
            maps[name] = cartesian_map(views_by_name[name].sonar.range_m, views_by_name[name].bearing_rad, cartesian_rows)
        if len({conversion.index.shape for conversion in maps.values()}) > 1 and layout != "side":
            raise MitsonarError("fans of different sizes can only be side by side: give layout='side'")
    return Arrangement(
        views=names,
        kind=kind,
        layout=cast(Layout, layout),
        coordinates=cast(Coordinates, coordinates),
        noise=models[0],
        beams=beams,
        maps=maps,
        levels=models if len(models) > 1 else (),
        range_levels=range_levels,
        halves=halves,
    )


def _noise_models(noise: str | NoiseModel | Sequence[str | NoiseModel]) -> tuple[NoiseModel, ...]:
    """Return the noise models of one level or of several levels.

    Raises:
        MitsonarError: the argument has another type, or a name is unknown.
    """
    levels = [noise] if isinstance(noise, str | NoiseModel) else list(noise) if isinstance(noise, Sequence) else []
    if not levels or not all(isinstance(level, str | NoiseModel) for level in levels):
        raise MitsonarError(f"noise must be a name, three numbers as text, or a NoiseModel: got {noise!r}; 'none' for none")
    return tuple(load_noise(level) if isinstance(level, str) else level for level in levels)


def _check_names(recipe: Recipe, views: tuple[str, ...], kind: str, layout: str, coordinates: str) -> None:
    """Check that named options are known, and that they fit each other and the stored arrays.

    Raises:
        MitsonarError: a name is unknown or does not fit.
    """
    for value, name, allowed in (
        (kind, "kind", ("image", "vector")),
        (layout, "layout", get_args(Layout)),
        (coordinates, "coordinates", get_args(Coordinates)),
    ):
        if value not in allowed:
            raise MitsonarError(f"{name} must be one of {', '.join(allowed)}: got {value!r}")
    known = [view.name for view in recipe.views]
    unknown = [name for name in views if name not in known]
    if unknown or not views:
        raise MitsonarError(
            f"unknown view {unknown[0] if unknown else 'none'}: {suggest_names(unknown[0] if unknown else '', known)}"
        )
    if kind == "image" and "image" not in recipe.kinds:
        raise MitsonarError("the data set holds vectors only: read kind='vector', or make one with store: images or both")
    if kind == "vector" and (coordinates != "polar" or layout == "stack"):
        raise MitsonarError(f"vectors have no cartesian form, and layout side or channels only: got {coordinates}, {layout}")


def _check_vectors(recipe: Recipe, kind: str, range_levels: int | None, halves: bool) -> None:
    """Check the options that apply to vectors only.

    Raises:
        MitsonarError: they do not fit the other options.
    """
    if (range_levels is not None or halves) and kind != "vector":
        raise MitsonarError("range_levels and halves are for vectors: read kind='vector', or leave them out")
    if halves and "image" not in recipe.kinds:
        raise MitsonarError("halves are cut from images: this data set holds vectors only; make one with store: images")
    bins = recipe.instrument.range_bins
    if range_levels is not None and not (1 <= range_levels <= bins and bins % range_levels == 0):
        divisors = [str(count) for count in range(1, bins + 1) if bins % count == 0]
        raise MitsonarError(
            f"range_levels must divide the {bins} of the data set ({', '.join(divisors)}): got {range_levels}"
        )
