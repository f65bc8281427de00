"""How a scene, a sonar and poses become frames: many pings are traced and binned in one launch, in constant memory."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import NoiseModel, refuse_noise
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.instruments.sonar import Sonar, TimedPath, overlap_notes, timed_path
from mitsonar.motion.bodies import BodyStates
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.echoes import Echoes
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.device import ensure_variant
from mitsonar.simulation.pings import FirstPing, RenderedPings, Tally, constant_gain, labels_above, moments_of, to_image

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.instruments.views import View
    from mitsonar.motion.bodies import Moving, MovingBodies
    from mitsonar.simulation.mirrors import Mirroring
    from mitsonar.simulation.tracing import Tracer

__all__ = ["Simulator"]


class Simulator:
    """Simulator of what a sonar receives in a scene.

    Scene parameters may change at any time (through ``mi.traverse``): the next ping shows the scene as it is then.

    Args:
        scene: a Mitsuba scene; its cameras are ignored.
        sonar: the instrument; default: the scene's ``imaging_sonar``.
        views: the images made from the echoes of each ping; default: one image of all echoes.
        mirrors: reflection coefficient and rms height [m] of the shapes that reflect as mirrors, keyed by shape id, or
            ``"materials"`` to take them from the shapes' materials (model ``coherent``, and ``physical`` with several
            ``bounces``); default: none.
        moving: trajectories or trajectory files, keyed by shape id (docs/guides/moving.md); default: the motion that the
            scene specifies for its shapes.
        rays_per_launch: upper bound on the rays of a launch and on its image cells, about 30 bytes each.

    Attributes:
        gain: gain of the closed loop that :meth:`step` renders; None until it is set.
        mirrors: the mirrors as given.
        model: renderer of the pings, by the sonar's model.
        motion: motion of the scene's bodies; None if nothing moves.
        notes: warnings about scene and sonar.

    Raises:
        MitsonarError: there is no sonar, neither given nor in the scene; a mirror moves.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sonar: Sonar | None = None,
        *,
        views: Sequence[View] | None = None,
        mirrors: Mirroring = None,
        moving: Moving | MovingBodies | None = None,
        rays_per_launch: int = 2**23,
    ) -> None:
        self.variant = ensure_variant()
        from mitsonar.simulation.moving import SceneWatch
        from mitsonar.simulation.scene import sonar_in

        if sonar is None:
            placed = sonar_in(scene)
            if placed is None:
                raise MitsonarError(
                    "the scene has no sensor of type imaging_sonar: add one, or name a sonar (--sonar didson300)"
                )
            sonar = placed[0]
        self.sonar, self.mirrors = sonar, mirrors
        self._given = scene, views, moving, rays_per_launch
        self._build()
        thin = self.model.imager is not None and self.model.imager.has_thin_shapes
        self._watch = SceneWatch(scene, places=bool(self.motion or mirrors or thin))
        self._stepped, self._gain_from, self._issued = 0, "", set[str]()
        self.gain: float | None = None

    def __repr__(self) -> str:
        shapes, moving = len(self.tracer.scene.shapes()), 0 if self.motion is None else len(self.motion.bodies)
        moving_text = f", {moving} moving bodies" if moving else ""
        return f"Simulator({self.sonar} in a scene of {shapes} shapes{moving_text}; {self.variant})"

    def _build(self) -> None:
        """Build everything derived from the current scene: moving bodies, and the model with its tables and launches."""
        from mitsonar.simulation.models.create import create_model
        from mitsonar.simulation.moving import motion_in
        from mitsonar.simulation.scene import scale_notes

        scene, views, moving, rays_per_launch = self._given
        sonar, mirrors = self.sonar, self.mirrors
        self.motion = motion_in(scene, moving)
        self.model = create_model(scene, sonar, views, mirrors, self.motion, rays_per_launch)
        self.notes = [*self.model.notes, *scale_notes(scene, sonar)]
        if sonar.bounces > 1:
            from mitsonar.simulation.mirrors import bright_notes, second_notes

            self.notes += bright_notes(scene, self.tracer.surfaces)
            self.notes += second_notes(scene, mirrors) if sonar.bounces > 2 else []

    @property
    def tracer(self) -> Tracer:
        """Return the tracer of the model's rays, which may extend beyond the field of view and the window."""
        return self.model.tracer

    @property
    def views(self) -> Sequence[View]:
        """Return the images of each ping."""
        return self.model.views

    def _follow_scene(self) -> None:
        """Rebuild whatever depends on scene parameters that have changed since the last ping.

        Compiled launches remain valid where only their inputs change: the normals and reflectivities in the tables of a
        static scene. A launch that evaluates a BSDF is recorded again once that BSDF changes, because Dr.Jit 1.5 would
        replay it with the old texture.
        """
        changed = self._watch.changed()
        if changed is None:
            return
        import mitsuba as mi

        plain = not (self.motion or self.mirrors or self.sonar.bounces > 1 or self.tracer.surfaces.foreign)
        plain &= not self.tracer.surfaces.textured or all(isinstance(owner, mi.Mesh) for owner in changed.values())
        if not (plain and self.model.adopt(self._given[0])):
            self._build()
        self.__dict__.pop("_exact_tracer", None)

    def pings(
        self, poses: ArrayLike, *, first: FirstPing = 0, labels: bool = False, time_s: ArrayLike | None = None
    ) -> Iterator[RenderedPings]:
        """Yield batches of consecutive pings in the first view; see :meth:`render_views`."""
        for views in self.render_views(poses, first=first, labels=labels, time_s=time_s):
            yield views[0]

    def render_views(
        self, poses: ArrayLike, *, first: FirstPing = 0, labels: bool = False, time_s: ArrayLike | None = None
    ) -> Iterator[list[RenderedPings]]:
        """Render consecutive pings in batches; each item holds the levels of one batch in every view.

        The jitter of a ping depends on its number only, not on how pings are split into batches.

        Args:
            poses: sonar poses ``(frames, 6)``: x, y, z [m], pitch, roll, heading [rad]; or ``(frames, groups, 6)``, one pose
                for each group of beams that pings separately.
            first: number of the first ping, or the number of each ping.
            labels: whether to return per-pixel truth as well.
            time_s: times of the poses [s], at which moving bodies are placed; default: ping number / ``frame_rate_hz``.

        Yields:
            The rendered pings of one batch, one entry for each view.

        Raises:
            MitsonarError: labels of portions in the model ``coherent``.
        """
        self._follow_scene()
        yield from self.model.render(*moments_of(self.sonar, poses, time_s, first), labels)

    def film_echoes(self, pose: ArrayLike, ping: int, time_s: float | None = None) -> Echoes:
        """Return the echoes of one ping as NumPy arrays, in film order; all beams ping at ``time_s`` [s]."""
        self._follow_scene()
        time_s = ping / self.sonar.frame_rate_hz if time_s is None else time_s
        return self._exact_tracer.film_echoes(pose, ping, time_s)

    @cached_property
    def _exact_tracer(self) -> Tracer:
        """Return a tracer of exactly the sonar's rays."""
        from mitsonar.simulation.tracing import tracer_of

        same = self.tracer.sonar is self.sonar
        return self.tracer if same else tracer_of(self.tracer.scene, self.sonar, self.motion)

    def window_range(self, pose: ArrayLike, ping: int, time_s: float | None = None) -> tuple[float, float] | None:
        """Return the nearest and farthest return outside the window of one ping [m]; None if all lie inside."""
        return self.film_echoes(pose, ping, time_s).outside(self.sonar)

    def buried(self, pose: ArrayLike) -> str:
        """Describe how a pose lies below the ground or inside an object; empty if it does not, or if bodies move."""
        from mitsonar.simulation.tracing import buried_in

        fault = (
            None if self.motion is not None else buried_in(self.tracer.scene, np.atleast_2d(np.asarray(pose, dtype=float)))
        )
        return "" if fault is None else fault.text

    def render(
        self,
        trajectory: Trajectory | ArrayLike,
        *,
        noise: NoiseModel | None = None,
        seed: int = 0,
        labels: bool = False,
        gain: float | None = None,
        label_floor: float = 0.0,
    ) -> SonarFrames:
        """Render all frames into memory.

        Args:
            trajectory: poses with times, or poses ``(frames, 6)`` [m, rad], one every ``1 / frame_rate_hz``.
            noise: noise model, drawn from (seed, frame, cell); default: none.
            seed: seed of the noise; the jitter uses the seed of the sonar.
            labels: whether to return per-pixel truth as well.
            gain: constant factor of the levels; default: set on the first 20 frames.
            label_floor: fraction of full scale above which a pixel is labelled; 0 labels every echo.

        Raises:
            MitsonarError: noise for a sonar that already includes it, or a first view of some of the beams.

        Warns:
            MitsonarWarning: nothing was hit; returns lie outside the window; pixels saturate; there are too few rays per
                bin; a BSDF has no diffuse reflectance; the pings of frames overlap.
        """
        refuse_noise(noise, self.sonar)
        given = self._given[1]
        if given and len(given[0].bearing_rad) != self.sonar.beams:
            raise MitsonarError(
                f"frames hold all {self.sonar.beams} beams, but the first view, {given[0].name}, has "
                f"{len(given[0].bearing_rad)}: put a view of all beams first, or use render_views"
            )
        if not isinstance(trajectory, Trajectory):
            poses = np.atleast_2d(np.asarray(trajectory, dtype=float))
            trajectory = Trajectory(poses, np.arange(len(poses)) / self.sonar.frame_rate_hz)
        timed = timed_path(self.sonar, trajectory)
        batches = self.pings(timed.poses, labels=labels, time_s=timed.time_s)
        calibrated = gain is None
        if gain is None:
            gain, batches = constant_gain(batches)
        tally = Tally(self.sonar) if calibrated else Tally(self.sonar, "as given")
        images, heights, truth = [], [], []
        for pings in batches:
            image = to_image(pings.levels, gain, self.sonar)
            tally.add(pings, image)
            frames = np.arange(pings.first, pings.first + len(pings))
            images.append(image if noise is None else noise.apply(image, seed=seed, frames=frames))
            heights.append(pings.height_m)
            truth.append(labels_above(pings, gain, label_floor))
        labelled: dict[str, Any] = {name: np.concatenate([part[name] for part in truth]) for name in truth[0]}
        notes = [*self.notes, *overlap_notes(self.sonar, timed.frames.time_s)]
        for sentence in [*notes, *tally.warnings(self, timed.frames.poses, timed.frames.time_s)]:
            warnings.warn(sentence, MitsonarWarning, stacklevel=2)
        return self._frames(np.concatenate(images), timed, np.concatenate(heights), gain, labelled)

    def _frames(
        self,
        image: NDArray[np.float32],
        timed: TimedPath,
        height_m: NDArray[np.float64],
        gain: float,
        labelled: dict[str, Any],
    ) -> SonarFrames:
        """Assemble images and labels into frames of the sonar, with the names that the labels refer to."""
        shapes, objects = self.label_names(bool(labelled))
        time_s, beam_poses = timed.of_beams(self.sonar)
        return SonarFrames(
            image=image,
            range_m=self.sonar.range_m,
            bearing_rad=self.sonar.bearing_rad,
            time_s=time_s,
            sonar=self.sonar,
            poses=timed.frames.poses,
            beam_poses=beam_poses,
            **self.bodies(timed.frames.time_s).fields(),
            height_m=height_m,
            level=self.sonar.value_coding,
            level_scale=1 / gain,
            shape_names=shapes,
            object_names=objects,
            **labelled,
        )

    def label_names(self, labels: bool = True) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the names of shapes and of objects that labels refer to; both empty without labels."""
        from mitsonar.simulation.scene import object_names_in, shape_names_in

        if not labels:
            return (), ()
        objects = object_names_in(self.tracer.scene)
        return shape_names_in(self.tracer.scene), objects if self.motion is None else self.motion.object_names(objects)

    def bodies(self, time_s: ArrayLike) -> BodyStates:
        """Return the names, poses and velocities of the moving bodies at given times [s]; empty if nothing moves."""
        return BodyStates() if self.motion is None else self.motion.bodies.states(time_s)

    def step(
        self,
        pose: ArrayLike,
        *,
        time_s: float | None = None,
        noise: NoiseModel | None = None,
        seed: int = 0,
        labels: bool = False,
        gain: float | None = None,
        label_floor: float = 0.0,
    ) -> SonarFrames:
        """Render the next ping of a closed loop, in which each pose follows from the frame before it.

        The simulator counts the pings, so that each draws different jitter and noise, and holds the gain constant. Stepping
        through poses gives bit for bit the images of ``render(poses, gain=simulator.gain)``. If no gain is given, the first
        frame with echoes sets it. Each kind of warning is issued once in a loop. Call :meth:`reset` to begin a new loop.

        Args:
            pose: sonar pose: x, y, z [m], pitch, roll, heading [rad].
            time_s: time of the ping [s]; default: ping number / ``frame_rate_hz``.
            noise: noise model, drawn from (seed, ping number, cell); default: none.
            seed: seed of the noise; the jitter uses the seed of the sonar.
            labels: whether to return per-pixel truth as well.
            gain: constant factor of the levels; default: set on the first frame with echoes.
            label_floor: fraction of full scale above which a pixel is labelled; 0 labels every echo.

        Raises:
            MitsonarError: there is not exactly one pose; the gain differs from that of earlier steps.
        """
        refuse_noise(noise, self.sonar)
        table = np.atleast_2d(np.asarray(pose, dtype=float))
        if table.shape != (1, 6):
            raise MitsonarError(f"a step takes one pose x, y, z [m], pitch, roll, heading [rad]: got {table.shape}")
        if gain is not None and self.gain is not None and gain != self.gain:
            raise MitsonarError(
                f"the gain of a loop is constant, {self.gain:g}: got {gain:g}; leave gain out, or call reset() to begin a "
                "new loop"
            )
        number = self._stepped
        moment_s = number / self.sonar.frame_rate_hz if time_s is None else time_s
        (pings,) = self.pings(table, first=number, labels=labels, time_s=[moment_s])
        if self.gain is None and (gain is not None or pings.levels.any()):
            self._gain_from = "set on the first frame with echoes" if gain is None else "as given"
            self.gain = constant_gain([pings])[0] if gain is None else gain
        applied_gain = 1.0 if self.gain is None else self.gain
        self._stepped = number + 1
        image = to_image(pings.levels, applied_gain, self.sonar)
        self._warn_once(pings, image, table, moment_s)
        noisy = image if noise is None else noise.apply(image, seed=seed, frames=np.array([number]))
        labelled = labels_above(pings, applied_gain, label_floor)
        timed = TimedPath(Trajectory(table, np.array([moment_s])), *moments_of(self.sonar, table, [moment_s], number)[1::-1])
        return self._frames(noisy, timed, pings.height_m, applied_gain, labelled)

    def reset(self) -> None:
        """Begin a new loop: the next :meth:`step` is ping 0, sets a new gain, and may repeat warnings."""
        self._stepped = 0
        self._gain_from, self.gain = "", None
        self._issued.clear()

    def _warn_once(self, pings: RenderedPings, image: NDArray[np.float32], pose: NDArray[np.float64], time_s: float) -> None:
        """Issue the warnings of one step, each kind once in a loop."""
        tally = Tally(self.sonar, self._gain_from)
        tally.add(pings, image)
        sentences = {note: note for note in self.notes} | tally.findings(
            self, pose, np.array([time_s]), pings.first, self._issued
        )
        for kind in [kind for kind in sentences if kind not in self._issued]:
            self._issued.add(kind)
            warnings.warn(sentences[kind], MitsonarWarning, stacklevel=3)
