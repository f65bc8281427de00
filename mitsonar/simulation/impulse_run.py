"""Runs of impulse responses on disk. A run that was killed can be resumed and ends with the same bits."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, counted
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.io.files import write_whole
from mitsonar.io.runs import RunDirectory, RunKind, digest
from mitsonar.io.storage import refuse_codecs
from mitsonar.motion.trajectory import Trajectory
from mitsonar.plotting.figures import response_png, waterfall_png
from mitsonar.records.frames import check_column
from mitsonar.records.responses import COLUMNS, ImpulseResponses
from mitsonar.simulation.channel import ChannelSimulator, Paths
from mitsonar.simulation.propagation_delay import delay_exact, delay_iterated
from mitsonar.simulation.render_run import SIMULATORS

if TYPE_CHECKING:
    import zarr

__all__ = ["SOUNDING", "ImpulseReport", "Spread", "iteration_error", "run_impulse", "spread_of"]

SOUNDING = RunKind(
    "channel measurement",
    outputs=("responses.npz", "responses.zarr", "response.png", "waterfall.png"),
    notes={"frames_done": int, "warnings": list},
    packages=(*SIMULATORS, "finufft"),
    deciding=(*SIMULATORS[:3], "finufft"),
)

OVERSPREAD = 0.3
"""Delay spread times Doppler spread of a receiver above which a channel is reported as overspread."""

MOST_ENERGY = (0.01, 0.99)
"""Quantiles of the echoes' energy between which the spread of delays and Doppler shifts is measured."""


@dataclass(frozen=True)
class Spread:
    """Delay spread [s] and Doppler spread [Hz] of a receiver's echoes: 98 % of their energy lies within each."""

    delay_s: float
    doppler_hz: float

    @property
    def factor(self) -> float:
        """Return delay spread times Doppler spread; above 1 a channel changes within one response."""
        return self.delay_s * self.doppler_hz


@dataclass(frozen=True)
class ImpulseReport:
    """Folder, number of pings, spread and warnings of a run."""

    folder: Path
    pings: int
    spread: Spread
    warnings: list[str]


def run_impulse(
    simulator: ChannelSimulator,
    flown: Trajectory,
    velocity: NDArray[np.float64],
    folder: str | Path,
    *,
    origin: Mapping[str, object],
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[int], None] = lambda pings: None,
) -> ImpulseReport:
    """Make a run's folder, or resume one: ``responses.zarr`` and ``.npz``, two figures, ``run.json``.

    Args:
        simulator: scene and instrument.
        flown: poses and times of the pings.
        velocity: of the vehicle in each, see :class:`~mitsonar.records.responses.ImpulseResponses`.
        folder: of the run.
        origin: what reproduces the run, beside instrument and trajectory.
        overwrite: replace a run that is there.
        resume: continue a run that was interrupted.
        progress: called with the number of new pings.

    Raises:
        MitsonarError: the folder exists; the run to resume was another one; the folder cannot be written.
    """
    sonar = simulator.sonar
    asked = {**origin, "sonar": sonar.model_dump(mode="json"), "pings": len(flown)}
    asked["poses_sha256"] = digest(flown.poses.tobytes(), flown.time_s.tobytes())
    asked["velocity"] = velocity[0].tolist() if len(np.unique(velocity, axis=0)) == 1 else "of the path"
    paths = [simulator.paths(flown.poses[0], velocity[:1], receiver) for receiver in range(len(sonar.receivers))]
    spread = spread_of(paths)
    if not any(path.amplitude.size for path in paths):
        _refuse_silence(simulator, flown, paths)
    run = RunDirectory.begin(folder, SOUNDING, asked, resume=resume, overwrite=overwrite)
    run.start(frames_done=0)
    if not (run.path / "responses.npz").exists():  # the last that is written
        progress(run.count("frames_done", len(flown)))
        made = _make(simulator, flown, velocity, run, progress)
        run.note(warnings=[*simulator.notes, *warnings_of(made, spread)])
        made.about |= {"spread_factor": spread.factor}
        write_whole(run.path / "response.png", response_png(made))
        write_whole(run.path / "waterfall.png", waterfall_png(made))
        made.save(run.path / "responses.npz")
    if not run.finished:
        run.finish()
    return ImpulseReport(run.path, len(flown), spread, run.notes.get("warnings") or [])


def _make(
    simulator: ChannelSimulator,
    flown: Trajectory,
    velocity: NDArray[np.float64],
    run: RunDirectory,
    progress: Callable[[int], None],
) -> ImpulseResponses:
    """Simulate the missing pings; the run's notes are updated after each batch."""
    import zarr

    done = run.count("frames_done", len(flown))
    url = run.path / "responses.zarr"
    if done == 0:
        shape = (len(flown), len(simulator.sonar.receivers))
        empty = ImpulseResponses(
            response=np.zeros((*shape, simulator.sonar.taps), np.complex64),
            time_s=flown.time_s,
            sonar=simulator.sonar,
            poses=flown.poses,
            velocity=velocity,
            height_m=np.zeros(shape[0]),
            echoes=np.zeros(shape, np.int64),
            dropped=np.zeros(shape, np.int64),
        )
        empty.save(url)
    try:
        group = zarr.open_group(url, mode="r+", zarr_format=3)
        _check(group, len(flown), simulator.sonar)
        for part in simulator.pings(flown.poses[done:], velocity[done:], first=done):
            here = slice(part.first, part.first + len(part))
            for name in ("response", "height_m", "echoes", "dropped"):
                group[name][here] = getattr(part, name)  # type: ignore[index]
            run.note(frames_done=here.stop)
            progress(len(part))
    except MitsonarError:
        raise
    except Exception as error:  # a damaged Zarr store raises errors of any type
        raise MitsonarError(f"cannot go on with {url}: {error}; make it again with --overwrite") from None
    return ImpulseResponses.load(url)


def _check(group: zarr.Group, pings: int, sonar: ChannelSonar) -> None:
    """Check that a store is that of the run, before anything is written into it.

    Raises:
        MitsonarError: an array is missing or has another shape or type.
        ValueError: an array has other chunks, or codecs that are not read.
    """
    sizes = {"pings": pings, "receivers": len(sonar.receivers), "taps": sonar.taps, "four": 4, "six": 6}
    for name, column in COLUMNS.items():
        array = cast("zarr.Array[Any]", group[name])
        refuse_codecs(array)
        check_column(array, name, column, sizes, str(group.store_path))
        if array.chunks != ((1, *array.shape[1:]) if array.ndim > 2 else array.shape):
            raise ValueError(f"{name} is cut into pieces of {array.chunks}")


def _refuse_silence(simulator: ChannelSimulator, flown: Trajectory, paths: list[Paths]) -> None:
    """Refuse a run without echoes in the first, the middle and the last ping; the first is known to have none.

    Raises:
        MitsonarError: there are none in the other two either.
    """
    sonar = simulator.sonar
    for pose in flown.poses[[len(flown) // 2, -1]]:
        if any(simulator.paths(pose, None, receiver).amplitude.size for receiver in range(len(sonar.receivers))):
            return
    beyond = sum(path.dropped for path in paths)
    x, y, z, pitch, *_ = flown.poses[0]
    height = float(simulator.tracer.height_m(flown.poses[:1])[0])
    below = f"{height:.3g} m above what is below it" if math.isfinite(height) else "with nothing below it"
    raise MitsonarError(
        f"no receiver has an echo: the vehicle is at ({x:g}, {y:g}, {z:g}) m, {below}, pitched by "
        f"{math.degrees(pitch):.3g} deg; {beyond:,} echoes came from beyond range_max {sonar.range_max:g} m. z is upwards, "
        "a level vehicle has pitch 0 (to_world's +z is forward), and receivers point tilt_deg away from straight down"
    )


FAR_ARM_M = 10.0
"""Distance from the transmitter [m] above which a receiver's position is probably given in millimetres."""


def spread_of(paths: list[Paths]) -> Spread:
    """Measure the spread of the echoes of 98 % of each receiver's energy, and return the spread of the largest factor.

    Each receiver has a channel of its own: shifts of receivers that look different ways do not blur one response.
    """
    return max((_own_spread(path) for path in paths), key=lambda spread: spread.factor)


def _own_spread(path: Paths) -> Spread:
    """Measure the spread of one receiver's echoes."""
    energy = np.abs(path.amplitude) ** 2
    widths = []
    for values in (path.delay_s, path.doppler_hz):
        order = np.argsort(values)
        share = np.cumsum(energy[order])
        if not share.size or share[-1] == 0:
            return Spread(0.0, 0.0)
        low, high = np.searchsorted(share, np.array(MOST_ENERGY) * share[-1])
        widths.append(float(values[order[min(high, len(order) - 1)]] - values[order[low]]))
    return Spread(*widths)


def warnings_of(made: ImpulseResponses, spread: Spread) -> list[str]:
    """Return the warnings of a run, one sentence each."""
    arms = {one.name: math.dist(one.position, (0, 0, 0)) for one in made.sonar.receivers}
    far = [name for name, away in arms.items() if away > FAR_ARM_M]
    several = f"receivers {', '.join(far)} are up to" if len(far) > 1 else f"receiver {', '.join(far)} is"
    sentences = [f"{several} {max(arms.values()):g} m from the transmitter: positions are in metres"] if far else []
    assert made.echoes is not None
    assert made.dropped is not None
    for number, receiver in enumerate(made.sonar.receivers):
        silent = int((made.echoes[:, number] == 0).sum())
        if silent:
            view = receiver.field
            up = " (above 90: upwards)" if view.tilt_deg > 90 else ""
            pitch = "" if made.poses is None else f" (pitched by {math.degrees(made.poses[0, 3]):.3g} deg)"
            sentences.append(
                f"receiver {receiver.name} has no echo in {silent} of {counted(len(made), 'ping')}: check its direction "
                f"(heading {view.heading_deg:g} deg, tilt {view.tilt_deg:g} deg from straight down{up}), "
                f"the vehicle's pose{pitch} and range_max"
            )
    dropped = int(made.dropped.sum())
    if dropped:
        share = dropped / max(1, dropped + int(made.echoes.sum()))
        sentences.append(
            f"{dropped:,} echoes ({100 * share:.3g} %) came from beyond range_max {made.sonar.range_max:g} m and were "
            "dropped: raise it, with a frequency_step_hz below sound_speed / (4 range_max)"
        )
    if spread.factor > OVERSPREAD:
        sentences.append(
            f"the channel is overspread: delays over {1e3 * spread.delay_s:.3g} ms times Doppler shifts over "
            f"{spread.doppler_hz:.3g} Hz make {spread.factor:.2g}, above {OVERSPREAD:g}; it changes while it is measured, "
            "and a real sounder would see it blurred"
        )
    return sentences


def iteration_error(flown: Trajectory, velocity: NDArray[np.float64], sonar: ChannelSonar) -> tuple[float, float]:
    """Bound the error of a moving receiver's delay by Almanza-Medina's iteration (eq. 5.5-5.14).

    The points lie ahead and behind at ``range_max``.

    Returns:
        Largest errors without iteration and after two rounds [turns of the carrier]; 0, 0 where they are not finite.
    """
    speed = float(np.linalg.norm(velocity[:, :3], axis=1).max(initial=0.0))
    ahead = (np.array([sonar.range_max, -sonar.range_max]), np.zeros(2), np.zeros(2))
    moving = (np.full(2, speed), np.zeros(2), np.zeros(2))
    exact = delay_exact(ahead, ahead, moving, sonar.sound_speed)
    errors = [
        float(np.abs(delay_iterated(ahead, ahead, moving, sonar.sound_speed, rounds) - exact).max()) * sonar.carrier_hz
        for rounds in (0, 2)
    ]
    return (errors[0], errors[1]) if math.isfinite(sum(errors)) else (0.0, 0.0)
