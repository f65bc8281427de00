"""Channel simulation: how echoes become complex impulse responses, for any transmitter and receivers.

The symbols and equation numbers are those of Almanza-Medina, section 5.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.materials import check_channel_mirrors
from mitsonar.errors import MitsonarError, argument, suggest_names
from mitsonar.instruments.hydrophones import PADDING, ChannelSonar
from mitsonar.motion.bodies import Moving, MovingBodies
from mitsonar.motion.pose import refuse_beyond_reach
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.records.responses import ImpulseResponses
from mitsonar.simulation.beams import phasor_sums, phasors
from mitsonar.simulation.device import thread_count

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.simulation.mirror_paths import MirrorPaths
    from mitsonar.simulation.mirrors import Mirroring
    from mitsonar.simulation.moving import SceneMotion
    from mitsonar.simulation.scatterers import ChannelTracer, EchoValues, Moment

__all__ = ["ChannelSimulator", "Channels", "Paths", "frequency_response", "impulse_response"]

FOR_PATHS = ("counts", "beyond", "delay", "amplitude", "phase", "doppler")
FOR_RESPONSES = ("counts", "beyond", "turn", "real", "imag")
"""Fields of :class:`~mitsonar.simulation.scatterers.EchoBatch` that a launch returns."""

MIRROR_ADVICE = (
    'give reflection and rms height keyed by shape id, mirrors={"surface": (-1.0, 0.0)}, or "materials" (--mirrors) with '
    "a material that has both"
)
"""Advice in the error of an instrument that needs mirrors."""

NO_MIRRORS = (
    "the scene has no mirrors: no shape has an acoustic_material with reflection and roughness_m; mirrors have no effect"
)

PINGS_AT_A_TIME = 16
"""Number of pings whose echoes wait in memory for their transforms: 50 bytes per echo and receiver."""


@dataclass(frozen=True)
class Channels:
    """Responses of consecutive pings, with counts of their echoes.

    Attributes:
        first: number of the first ping.
        response: ``(pings, receivers, taps)`` complex64.
        height_m: height of the transmitter above the surface straight below it ``(pings,)`` [m]; nan if there is none.
        echoes: number of echoes within ``range_max`` ``(pings, receivers)``.
        dropped: number of echoes from beyond ``range_max`` ``(pings, receivers)``.
    """

    first: int
    response: NDArray[np.complex64]
    height_m: NDArray[np.float64]
    echoes: NDArray[np.int64]
    dropped: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.response)


@dataclass(frozen=True)
class Paths:
    """The echoes of one ping at one receiver.

    Attributes:
        delay_s: delay ``(n,)`` float64 [s].
        amplitude: ``(n,)`` complex128, before the carrier's phase -2 pi f_c tau; real and positive in the model ``rays``.
        doppler_hz: Doppler shift of the carrier ``(n,)`` [Hz], positive where the path gets shorter.
        dropped: number of echoes from beyond ``range_max``.
        kind: kind of each path, as an index into ``kinds`` ``(n,)``; by default all paths are of the first kind.
        kinds: kinds of paths, named after what they meet in turn: ``scatterer``, ``surface-scatterer``, ``direct``,
            ``surface-seabed`` ...
    """

    delay_s: NDArray[np.float64]
    amplitude: NDArray[np.complex128]
    doppler_hz: NDArray[np.float64]
    dropped: int
    kind: NDArray[np.int64] | None = None
    kinds: tuple[str, ...] = ("scatterer",)

    def by(self, name: str) -> Paths:
        """Return the paths of one kind.

        Args:
            name: one of :attr:`kinds`.

        Raises:
            MitsonarError: there is no such kind of path.
        """
        if name not in self.kinds:
            raise MitsonarError(f"no kind of path is named {name!r}: {suggest_names(name, self.kinds)}")
        kind = np.zeros(len(self.delay_s), np.int64) if self.kind is None else self.kind
        selected = kind == self.kinds.index(name)
        return Paths(
            self.delay_s[selected], self.amplitude[selected], self.doppler_hz[selected], 0, kind[selected], self.kinds
        )


class ChannelSimulator:
    """Simulator of the impulse responses that a channel sonar measures in a scene.

    Model ``scatterers``: points of the world (:mod:`mitsonar.simulation.scatterers`) that the transmitter sees, with one
    shadow ray each. The amplitude is zeta sqrt(C dA cos_A cos_B) / (r_A r_B), where zeta is an independent complex Gaussian
    number for each point. The mean of its square is the level of an imaging sonar's echo. Model ``rays`` (Almanza-Medina,
    5.2.1): rays that are fixed to the vehicle and cover each receiver's field of view evenly. The amplitude is C cos_A.

    With ``mirrors``, sound also arrives via flat mirrors, with up to ``sonar.bounces`` reflections in total. These paths
    are computed from image sources and include the phase of the carrier. Mirrors that are not flat, such as waves, reflect
    once.

    Bodies may move, in the model ``scatterers``: their scatterers move with them, sound meets them where they are by then,
    and they cast shadows. The kinds of their paths have their names. Heights are those above still shapes.

    Parameters of the scene may be changed at any time (``mi.traverse``): the next ping uses the changed scene.

    Args:
        scene: any Mitsuba scene.
        sonar: the instrument.
        like: a simulator of the same scene; its scatterers are reused if both instruments have the same ones.
        mirrors: reflection coefficient and rms height [m] keyed by shape id, ``{"surface": (-1.0, 0.0)}``, or
            ``materials`` to use those of the shapes' materials.
        within: two opposite corners of a box ``(2, 3)`` [m]; scatterers outside are left out, which saves memory in a large
            scene (:meth:`~mitsonar.instruments.hydrophones.ChannelSonar.box_seen_from`); default: all.
        moving: as in :class:`~mitsonar.Simulator`.

    Attributes:
        kinds: kinds of paths, named after what they meet in turn: ``scatterer``, ``surface-scatterer``, ``direct``,
            ``surface`` ...

    Raises:
        MitsonarError: no surface can carry scatterers; a mirror is not in the scene, or moves; bounces without mirrors; a
            body deforms, or moves in the model ``rays``.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sonar: ChannelSonar,
        *,
        like: ChannelSimulator | None = None,
        mirrors: Mirroring = None,
        within: ArrayLike | None = None,
        moving: Moving | MovingBodies | None = None,
    ) -> None:
        self.sonar = sonar
        from mitsonar.simulation.moving import SceneWatch

        self._given = scene, mirrors, moving
        self._within = None if within is None else np.asarray(within, dtype=float).reshape(2, 3)
        self._watch = SceneWatch(scene)
        if like is not None:
            like._follow_scene()
        self._build(None if like is None else like.tracer)
        self.reset()

    def __repr__(self) -> str:
        shapes, paths = len(self._given[0].shapes()), ", ".join(self.kinds[:4])
        return f"ChannelSimulator({self.sonar} in a scene of {shapes} shapes; paths {paths})"

    def _build(self, like: ChannelTracer | None = None) -> None:
        """Build everything that depends on the current scene: scatterers or surface tables, and mirrors."""
        scene, mirrors, moving = self._given
        sonar = self.sonar
        from mitsonar.simulation.mirror_paths import MirrorPaths
        from mitsonar.simulation.mirrors import mirror_of, refuse_moving_mirrors
        from mitsonar.simulation.moving import motion_in
        from mitsonar.simulation.scatterers import ChannelTracer

        motion = motion_in(scene, moving)
        if motion is not None:
            _check_motion(motion, sonar)
            refuse_moving_mirrors(scene, mirrors, motion.bodies.shapes)
        parts = mirror_of(scene, mirrors) if mirrors else None
        check_channel_mirrors(sonar, parts is not None, MIRROR_ADVICE)
        self._without_mirrors = mirrors == "materials" and parts is None
        self.tracer: ChannelTracer = ChannelTracer(scene, sonar, like, parts, self._within, motion)
        self.without_scatterer: MirrorPaths = MirrorPaths(self.tracer)
        self.kinds = tuple([path.name for path in self.tracer.paths] + self.without_scatterer.names)

    def _follow_scene(self) -> None:
        """Rebuild everything that depends on the scene if its parameters have changed."""
        if self._watch.changed() is not None:
            self._build()

    @property
    def notes(self) -> list[str]:
        """Return notes to the user about the scene's BSDFs and mirrors."""
        notes = [*self.tracer.notes, *self.without_scatterer.notes]
        return [*notes, NO_MIRRORS] if self._without_mirrors else notes

    def responses(
        self, flown: Trajectory, velocity: ArrayLike | None = None, progress: Callable[[int], None] = lambda pings: None
    ) -> ImpulseResponses:
        """Simulate the responses of a whole trajectory.

        Args:
            flown: poses of the transmitter and times.
            velocity: velocity in the vehicle's axes, see :class:`~mitsonar.records.responses.ImpulseResponses`; default:
                that of the trajectory (:func:`~mitsonar.motion.trajectory.velocities`).
            progress: called with the number of new pings.

        Raises:
            MitsonarError: the velocities are not valid.
        """
        parts = []
        velocity = velocities(flown) if velocity is None else velocity
        for part in self.pings(flown.poses, velocity, time_s=flown.time_s):
            parts.append(part)
            progress(len(part))
        return ImpulseResponses(
            response=np.concatenate([part.response for part in parts]),
            time_s=flown.time_s,
            sonar=self.sonar,
            poses=flown.poses,
            velocity=_checked(velocity, len(flown), self.sonar.sound_speed),
            height_m=np.concatenate([part.height_m for part in parts]),
            echoes=np.concatenate([part.echoes for part in parts]),
            dropped=np.concatenate([part.dropped for part in parts]),
        )

    def step(self, pose: ArrayLike, velocity: ArrayLike, *, time_s: float | None = None) -> ImpulseResponses:
        """Simulate the next ping of a closed loop.

        Stepping through the poses and velocities of a trajectory gives the same bits as :meth:`responses`. Each step needs
        a velocity, since a single pose does not determine it. The only state of the loop is the number of pings, which
        determines their times: responses have no gain, and a ping draws no random numbers.

        Args:
            pose: pose of the transmitter: x, y, z [m], pitch, roll, heading [rad].
            velocity: velocity in the vehicle's axes ``(4,)``, starboard, forward, up [m/s], turn to starboard [rad/s].
            time_s: time of the ping [s]; default: its number / ``frame_rate_hz``.

        Returns:
            The responses of one ping.

        Raises:
            MitsonarError: not exactly one pose, or a velocity that is not finite or too large.
        """
        table = np.atleast_2d(np.asarray(pose, dtype=float))
        if table.shape != (1, 6):
            raise MitsonarError(f"a step takes one pose x, y, z [m], pitch, roll, heading [rad]: got {table.shape}")
        time = self._stepped / self.sonar.frame_rate_hz if time_s is None else time_s
        responses = self.responses(Trajectory(table, np.array([time])), velocity)
        self._stepped += 1
        return responses

    def reset(self) -> None:
        """Begin a new loop: the next :meth:`step` is ping 0."""
        self._stepped = 0

    def pings(
        self,
        poses: ArrayLike,
        velocity: ArrayLike | None = None,
        *,
        first: int = 0,
        time_s: ArrayLike | None = None,
    ) -> Iterator[Channels]:
        """Simulate consecutive pings in batches, so that memory does not grow with their number.

        Args:
            poses: poses of the transmitter when the pings are sent ``(pings, 6)``.
            velocity: velocity in the vehicle's axes ``(pings, 4)``, starboard, forward, up [m/s], turn to starboard [rad/s],
                or one for all pings ``(4,)``; default: at rest.
            first: number of the first ping.
            time_s: times of the pings ``(pings,)`` [s], at which bodies are placed; default: number / ``frame_rate_hz``.

        Yields:
            The responses of each batch.

        Raises:
            MitsonarError: the velocities are not valid.
        """
        self._follow_scene()
        table = np.atleast_2d(np.asarray(poses, dtype=float))
        speeds = _checked(velocity, len(table), self.sonar.sound_speed)
        numbers = first + np.arange(len(table))
        times = numbers / self.sonar.frame_rate_hz if time_s is None else np.asarray(time_s, dtype=float)
        with ThreadPoolExecutor(thread_count()) as threads:
            for begin in range(0, len(table), PINGS_AT_A_TIME):
                here = slice(begin, begin + PINGS_AT_A_TIME)
                yield self._channels(table[here], speeds[here], times[here], first + begin, threads)

    def paths(
        self, pose: ArrayLike, velocity: ArrayLike | None = None, receiver: int | str = 0, *, time_s: float = 0.0
    ) -> Paths:
        """Trace the echoes of one ping at one receiver.

        Args:
            pose: pose of the transmitter: x, y, z [m], pitch, roll, heading [rad].
            velocity: as in :meth:`pings`.
            receiver: name or number of the receiver.
            time_s: time of the ping [s], at which bodies are placed.

        Raises:
            MitsonarError: no such receiver, or a pose or velocity that is not valid.
        """
        table = np.asarray(pose, dtype=float).reshape(1, -1)
        if table.shape != (1, 6) or not np.isfinite(table).all():
            raise MitsonarError(f"a pose is six numbers x, y, z [m], pitch, roll, heading [rad]: got {table.size}")
        refuse_beyond_reach(table)
        receiver = self.sonar.receiver_number(receiver)
        speeds = _checked(velocity, 1, self.sonar.sound_speed)
        self._follow_scene()
        moment = self._moment(time_s)
        parts = [
            *(
                self.tracer.trace(table[0], speeds[0], receiver, FOR_PATHS, path=path, moment=moment)
                for path in self.tracer.paths
            ),
            *self.without_scatterer.trace(table[0], speeds[0], receiver, FOR_PATHS, moment),
        ]
        received = joined(parts)
        keep = received["counts"].astype(bool)
        names = ("delay", "amplitude", "phase", "doppler")
        delay, size, phase, doppler = (received[name][keep].astype(float) for name in names)
        kind = np.repeat(np.arange(len(parts)), [len(part["counts"]) for part in parts])[keep]
        beyond = int(np.count_nonzero(received["beyond"]))
        return Paths(delay, size * np.exp(1j * phase), doppler, beyond, kind, self.kinds)

    def _moment(self, time_s: float) -> Moment | None:
        """Return the moving bodies at a time [s]; None if nothing moves."""
        from mitsonar.simulation.scatterers import Moment

        return None if self.tracer.motion is None else Moment.at(self.tracer.motion, time_s)

    def _channels(
        self,
        poses: NDArray[np.float64],
        velocity: NDArray[np.float64],
        time_s: NDArray[np.float64],
        first: int,
        threads: ThreadPoolExecutor,
    ) -> Channels:
        """Simulate a batch of pings; threads select points and transform echoes while the device traces."""
        shape = (len(poses), len(self.sonar.receivers))
        paths, moments = self.tracer.paths, [self._moment(float(time)) for time in time_s]
        each = [(k, receiver, path) for k, receiver in np.ndindex(shape) for path in paths]
        # select the points of all launches ahead, in threads
        candidates = [
            threads.submit(self.tracer.candidates, poses[k], receiver, path, moments[k]) for k, receiver, path in each
        ]
        transforms = []
        parts: list[EchoValues] = []
        # trace one kind of path after another; a response is transformed once all its kinds have arrived
        for (k, receiver, path), ready in zip(each, candidates, strict=True):
            parts.append(self.tracer.trace(poses[k], velocity[k], receiver, FOR_RESPONSES, ready.result(), path, moments[k]))
            if len(parts) == len(paths):
                parts += self.without_scatterer.trace(poses[k], velocity[k], receiver, FOR_RESPONSES, moments[k])
                transforms.append(threads.submit(_one_response, self.sonar, parts))
                parts = []
        response, echoes, dropped = zip(*(future.result() for future in transforms), strict=True)
        return Channels(
            first=first,
            response=np.reshape(np.asarray(response, np.complex64), (*shape, self.sonar.taps)),
            height_m=self.tracer.height_m(poses),
            echoes=np.reshape(echoes, shape).astype(np.int64),
            dropped=np.reshape(dropped, shape).astype(np.int64),
        )


def _check_motion(motion: SceneMotion, sonar: ChannelSonar) -> None:
    """Check that responses can be simulated while bodies move.

    Raises:
        MitsonarError: the sonar has the model ``rays``, or a body deforms.
    """
    if sonar.model != "scatterers":
        raise MitsonarError(
            f"bodies move in the model scatterers only: got {sonar.model} while {motion.bodies.shapes[0]} moves; choose "
            "--model scatterers, or remove its trajectory"
        )
    if motion.deformed:
        name = motion.deformed[0].mesh.id()
        raise MitsonarError(f"impulse responses need rigid bodies: {name} deforms; give it a path without meshes")


def joined(parts: list[EchoValues]) -> EchoValues:
    """Concatenate the echoes of several kinds of paths."""
    return parts[0] if len(parts) == 1 else {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _one_response(sonar: ChannelSonar, parts: list[EchoValues]) -> tuple[NDArray[np.complex128], int, int]:
    """Return the response of all echoes, the number of echoes, and the number from beyond ``range_max``."""
    received = joined(parts)
    keep = np.flatnonzero(received["counts"])
    strength = np.empty(len(keep), np.complex128)
    strength.real, strength.imag = received["real"][keep], received["imag"][keep]
    spectrum = _spectrum(sonar, received["turn"][keep], strength, PADDING)
    return _taps(sonar, spectrum, PADDING), len(keep), int(np.count_nonzero(received["beyond"]))


def frequency_response(
    delay_s: ArrayLike, amplitude: ArrayLike, sonar: ChannelSonar
) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Compute the frequency response H_f of echoes (Almanza-Medina, eq. 5.15) by a type 1 non-uniform FFT.

    Args:
        delay_s: delay of each echo ``(n,)`` [s].
        amplitude: amplitude of each echo ``(n,)``, real or complex.
        sonar: carrier, band and frequency step.

    Returns:
        Frequencies of the band relative to the carrier ``(k,)`` [Hz], and H_f ``(k,)``.
    """
    delay = np.asarray(delay_s, dtype=float)
    turn, strength = phasors(delay, np.asarray(amplitude), sonar, 1)
    half = _half(sonar, 1)
    frequency = np.arange(-half, half + 1, dtype=np.float64) * sonar.frequency_step_hz
    return frequency, _spectrum(sonar, turn, strength, 1)


def impulse_response(delay_s: ArrayLike, amplitude: ArrayLike, sonar: ChannelSonar) -> NDArray[np.complex128]:
    """Compute the impulse response of echoes (Almanza-Medina, eq. 5.15-5.17).

    The frequency response is weighted by a raised cosine, padded, and transformed by an inverse FFT.

    Args:
        delay_s: delay of each echo ``(n,)`` [s].
        amplitude: amplitude of each echo ``(n,)``, real or complex.
        sonar: carrier, band, frequency step and taps.

    Returns:
        The response ``(taps,)``.
    """
    delay = np.asarray(delay_s, dtype=float)
    turn, strength = phasors(delay, np.asarray(amplitude), sonar, PADDING)
    return _taps(sonar, _spectrum(sonar, turn, strength, PADDING), PADDING)


def _half(sonar: ChannelSonar, padding: int) -> int:
    """Return the index of the last frequency within the band, counted from its centre."""
    return math.floor((1 + sonar.rolloff) * sonar.bandwidth_hz / 2 / sonar.frequency_step_hz * padding + 1e-9)


def _spectrum(
    sonar: ChannelSonar, turn: NDArray[np.float64], strength: NDArray[np.complex128], padding: int
) -> NDArray[np.complex128]:
    """Sum strength exp(-i k turn) for each k of the band ``(2 half + 1,)``."""
    return phasor_sums(turn, strength, 2 * _half(sonar, padding) + 1)


def _taps(sonar: ChannelSonar, spectrum: NDArray[np.complex128], padding: int) -> NDArray[np.complex128]:
    """Apply the raised cosine and the inverse FFT (eq. 5.17), and cut the padded response to the taps."""
    half = _half(sonar, padding)
    number = np.arange(-half, half + 1)
    length_ = sonar.taps * padding
    band = np.zeros(length_, np.complex128)
    np.add.at(band, number % length_, spectrum * sonar.raised_cosine(number * sonar.frequency_step_hz / padding))
    return np.asarray(np.fft.ifft(band)[: sonar.taps])


def _checked(velocity: ArrayLike | None, pings: int, sound_speed: float) -> NDArray[np.float64]:
    """Validate velocities and return them as an array ``(pings, 4)``; zeros by default.

    Raises:
        MitsonarError: another shape, not finite, or above a tenth of the sound speed.
    """
    table = np.zeros((pings, 4)) if velocity is None else np.atleast_2d(np.asarray(velocity, dtype=float))
    if table.shape == (1, 4):
        table = np.repeat(table, pings, axis=0)
    if table.shape != (pings, 4) or not np.isfinite(table).all():
        raise MitsonarError(
            f"{argument('velocity')} must be finite numbers (pings, 4) = ({pings}, 4), starboard, forward, up in m/s and "
            f"turn in rad/s: got {table.shape}"
        )
    fastest, most = float(np.linalg.norm(table[:, :3], axis=1).max(initial=0)), 0.1 * sound_speed
    if fastest > most:
        raise MitsonarError(
            f"{argument('velocity')} is in m/s and must stay below a tenth of the sound speed, {most:g} m/s: got "
            f"{fastest:g} m/s"
        )
    return table
