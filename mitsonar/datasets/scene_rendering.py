"""A scene of a recipe becomes pixels, for stores and for training with rendered frames."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.water import noise_of
from mitsonar.config.data import Recipe
from mitsonar.datasets.image_modality import ImageModality
from mitsonar.datasets.modality import Fields, Values
from mitsonar.datasets.plan import Scene, scenes_of, sequences_of, world_seed
from mitsonar.errors import MitsonarError, nearest_names, shortened
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import mounted
from mitsonar.records.frames import to_uint8
from mitsonar.simulation.device import release_memory
from mitsonar.simulation.pings import CALIBRATION_FRAMES, RenderedPings, constant_gain, labels_above, to_image
from mitsonar.simulation.scene import load_scene, shape_names_in
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.simulation.moving import SceneMotion

__all__ = ["FRAMES_A_SCENE", "SceneRenderer", "calibrate", "loaded_world", "refuse_worlds"]

VISIBLE = 1e-4
"""Expected level of a cell with a visible label, at least, as a part of full scale; it must exceed the noise too."""

FRAMES_A_SCENE = 10_000_000
"""A ping's number is its scene's number times this, plus its position in the scene: jitter does not depend on the size of
the data set."""


class SceneRenderer:
    """One scene, built, loaded, and ready to render.

    Args:
        recipe: of the data set.
        scene: which of its scenes.
    """

    def __init__(self, recipe: Recipe, scene: Scene) -> None:
        self.recipe, self.scene = recipe, scene
        world, sonar = loaded_world(recipe, scene), instrument_in(recipe, scene)
        self.simulator = Simulator(world, sonar, views=recipe.views, mirrors=recipe.mirrors)
        self.bodies = body_places(recipe, self.simulator.motion)
        self._labeller: Simulator | None = None
        if recipe.labels and recipe.visible_labels:  # the expected levels, over all that the patterns receive
            patterns = {"pattern": sonar.beam_pattern, "elevation_pattern": sonar.vertical_pattern}
            self._labeller = Simulator(world, sonar.replace(model="physical", **patterns))

    @staticmethod
    def settled(recipe: Recipe) -> Fields:
        """Compute the gain of the data set and its inverse, and with labels of shapes the names of those of scene files.

        See :func:`calibrate`. The names are a list for each group of scenes; it is empty for worlds that are built.
        """
        refuse_worlds(recipe)
        gain = calibrate(recipe)
        found: Fields = {"gain": gain, "level_scale": 1 / gain}
        groups = range(len(recipe.scenes))
        if "shape_id" in recipe.labels and any(recipe.family(group).called == "scene" for group in groups):
            known: dict[str, list[str]] = {}
            for group in groups:
                family = recipe.family(group)
                if repr(family) not in known:
                    world = Scene(0, group, world_seed(recipe.seed, 0), 1)
                    named = family.called == "scene"
                    known[repr(family)] = list(shape_names_in(loaded_world(recipe, world))) if named else []
            found["shape_names"] = [known[repr(recipe.family(group))] for group in groups]
        return found

    def render_views(self, poses: NDArray[np.float64], first: int, *, labels: bool = False) -> Iterator[list[RenderedPings]]:
        """Render levels of frames ``first``, ``first + 1`` ... of the scene, in batches with a part for each view.

        Bodies that the scene's file moves are where they are at frame / ``frame_rate_hz``.
        """
        time_s = self._time_s(first, len(poses))
        number = self.scene.number * FRAMES_A_SCENE + first
        return self.simulator.render_views(poses, first=number, labels=labels, time_s=time_s)

    def frames(self, poses: NDArray[np.float64], first: int, gain: float) -> dict[str, Values]:
        """Render frames of the scene. Return what is stored of them, ``(frames, ...)`` by array name.

        Args:
            poses: of the sonar ``(frames, 6)``.
            first: number of the first in the scene.
            gain: of the data set.
        """
        values = self._empty(len(poses))
        for batch in self.render_views(poses, first, labels=bool(self.recipe.labels) and self._labeller is None):
            start = batch[0].first - (self.scene.number * FRAMES_A_SCENE + first)
            self._fill({name: array[start : start + len(batch[0])] for name, array in values.items()}, batch, gain)
        if self._labeller is not None:
            number = self.scene.number * FRAMES_A_SCENE + first
            for pings in self._labeller.pings(poses, first=number, labels=True, time_s=self._time_s(first, len(poses))):
                here = slice(pings.first - number, pings.first - number + len(pings))
                floor = np.maximum(VISIBLE, gain * noise_of(self.simulator.sonar))[:, None]
                for label, shown in labels_above(pings, gain, floor).items():
                    if label in self.recipe.labels:
                        values[label][here] = shown
        if self.bodies:
            states = self.simulator.bodies(self._time_s(first, len(poses)))
            assert states.poses is not None
            assert states.velocities is not None
            values["body_pose"][:] = states.poses[:, self.bodies]
            values["body_velocity"][:] = states.velocities[:, self.bodies]
        return values

    def _time_s(self, first: int, frames: int) -> NDArray[np.float64]:
        """Return the times of frames of the scene, of which its moving bodies are functions ``(frames,)`` [s]."""
        return np.asarray((first + np.arange(frames)) / self.simulator.sonar.frame_rate_hz, dtype=np.float64)

    def recorded(self, planned: dict[str, Values], first: int, about: Fields) -> dict[str, Values]:
        """Render frames at the poses of the plan; see :class:`~mitsonar.datasets.modality.Renderer`."""
        return self.frames(planned["pose"], first, float(about["gain"]))

    def _empty(self, frames: int) -> dict[str, Values]:
        """Allocate the arrays to fill; counts begin at 0."""
        stored = ImageModality(self.recipe).stored
        return {name: np.zeros((frames, *one.shape), dtype=one.kind) for name, one in stored.items()}

    def _fill(self, values: dict[str, Values], batch: list[RenderedPings], gain: float) -> None:
        """Write what is stored of one batch into the arrays."""
        values["height_m"][:] = batch[0].height_m
        for view, pings in zip(self.simulator.views, batch, strict=True):
            suffix = self.recipe.suffix(view.name)
            outside = (pings.counts.nearer + pings.counts.farther).sum(axis=1).astype(np.uint32)
            np.maximum(values["dropped"], outside, out=values["dropped"])  # portions overlap
            for number, levels in enumerate(pings.levels):  # one by one: a frame fits the cache, a batch does not
                image = to_image(levels, gain, view.sonar)
                values["saturated"][number] += np.count_nonzero(image >= 1)
                if f"image{suffix}" in values:
                    values[f"image{suffix}"][number] = to_uint8(image) if self.recipe.pixel == "uint8" else image
                if f"vector{suffix}" in values:
                    values[f"vector{suffix}"][number] = image.sum(axis=1, dtype=np.float64)
                    values[f"nonzero{suffix}"][number] = np.count_nonzero(image, axis=1)
            for label in pings.labels and self.recipe.labels:
                values[f"{label}{suffix}"][:] = pings.labels[label]


def instrument_in(recipe: Recipe, scene: Scene) -> Sonar:
    """Return the sonar of a scene: that of speckle has a seed of each scene, since its scatterers are hashed by it.

    Where the recipe has ``noise_db``, the noise of a scene is raised.
    """
    sonar = recipe.instrument
    if sonar.model != "coherent":
        return sonar
    seed = int(np.random.SeedSequence([recipe.seed, scene.number]).generate_state(1)[0])
    if sonar.noise_level_db is None or not recipe.noise_db:
        return sonar.replace(seed=seed)
    return sonar.replace(seed=seed, noise_level_db=sonar.noise_level_db + float(recipe.noise_raised_db(scene.number)))


def body_places(recipe: Recipe, motion: SceneMotion | None) -> list[int]:
    """Return the places of the recipe's bodies among those that move in a scene.

    Raises:
        MitsonarError: a body that does not move there.
    """
    known = () if motion is None else motion.bodies.names
    for name in recipe.bodies:
        if name not in known:
            there = nearest_names(name, known) if known else "nothing moves there"
            raise MitsonarError(f"bodies: no body {shortened(name)} moves in the scene: {there}")
    return [known.index(name) for name in recipe.bodies]


def loaded_world(recipe: Recipe, scene: Scene) -> mi.Scene:
    """Build a scene's world in a temporary folder, and load it.

    Raises:
        MitsonarError: a scene of the user's own that is smaller than the recipe says.
    """
    with tempfile.TemporaryDirectory(prefix="mitsonar-world-") as folder:
        family = recipe.family(scene.group)
        path, parameters = family.prepare(scene.seed, Path(folder) / "world")
        loaded = load_scene(path, **parameters)
        extent = loaded.bbox()
        family.refuse_smaller(np.array(extent.min, dtype=float).ravel(), np.array(extent.max, dtype=float).ravel())
        return loaded


def refuse_worlds(recipe: Recipe) -> None:
    """Refuse scenes of the user's own that are smaller than the recipe says, and worlds without the mirrors that it names.

    Nothing is rendered yet. Of each group of scenes one world is looked at.

    Raises:
        MitsonarError: one is smaller than its ``size_m``, lacks a mirror or a body that moves, or cannot be loaded.
    """
    from mitsonar.simulation.mirrors import mirror_of
    from mitsonar.simulation.moving import motion_in

    families = [recipe.family(group) for group in range(len(recipe.scenes))]
    every = bool(recipe.mirrors or recipe.bodies)
    looked_at = {repr(family): group for group, family in enumerate(families) if every or not family.seeded}
    for group in looked_at.values():
        world = loaded_world(recipe, Scene(0, group, world_seed(recipe.seed, 0), 1))
        body_places(recipe, motion_in(world, None) if recipe.bodies else None)
        if mirror_of(world, recipe.mirrors) is None and recipe.mirrors:
            raise MitsonarError(
                f"mirrors: no shape of the worlds of scenes.{group} reflects: got {recipe.mirrors}; give [reflection, rms "
                "height in m] by the ids of shapes, or shapes of materials that have both"
            )
    release_memory()


def calibrate(recipe: Recipe) -> float:
    """Compute the gain: the 99.9th percentile of all pixels of the first 20 frames of the first scene becomes 0.9.

    The frames are those of the recipe, however few of them are made. A recipe may also give the gain, such as that of
    another data set of the same sonar.

    Raises:
        MitsonarError: these frames are empty.
    """
    if recipe.gain is not None:
        return recipe.gain
    scene = scenes_of(recipe, recipe.sequences)[0]
    poses = []
    for sequence in sequences_of(recipe, scene):
        poses.append(mounted(sequence.vehicle, recipe.mount.pose))
        if sum(map(len, poses)) >= CALIBRATION_FRAMES:
            break
    table = np.concatenate(poses)[:CALIBRATION_FRAMES]
    renderer = SceneRenderer(recipe, scene)
    batches = list(renderer.render_views(table, 0))
    del renderer
    release_memory()
    if not any(pings.levels.any() for batch in batches for pings in batch):
        raise MitsonarError(
            "the first frames are empty: no ray met anything within the window; check height_m, mount, range_min and "
            "range_max"
        )
    return constant_gain([_joined(batches)])[0]


def _joined(batches: list[list[RenderedPings]]) -> RenderedPings:
    """Join all views of all frames as frames of one column, since the gain is one constant for all."""
    first = batches[0][0]
    frames = []
    for batch in batches:
        frames += [np.concatenate([pings.levels[k].ravel() for pings in batch]) for k in range(len(batch[0]))]
    return RenderedPings(first.first, np.stack(frames)[:, :, None], first.counts, first.height_m)
