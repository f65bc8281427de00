"""Command ``mitsonar sas``: simulate a synthetic aperture sonar along a path, and focus a stripmap image."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from mitsonar.cli import options
from mitsonar.cli.console import LaterBar, answered, numbers, progress_bar, say, warn
from mitsonar.cli.render import _load, moving_bodies
from mitsonar.errors import MitsonarError, count_noun

if TYPE_CHECKING:
    from mitsonar.instruments.hydrophones import ChannelSonar
    from mitsonar.mapping.aperture_run import Correction
    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.records.responses import ImpulseResponses
    from mitsonar.simulation.channel import ChannelSimulator

__all__ = ["sas"]

SPEED = 1.5
"""Speed of the vehicle between two poses, unless another is given [m/s]."""


@answered
def sas(
    scene: options.SceneName,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder to make (default: out/SCENE-sas).")] = None,
    trajectory: Annotated[
        Path | None, typer.Option(help="Poses of the vehicle, which heads along its path: a TUM or CSV file.")
    ] = None,
    start: Annotated[str | None, typer.Option("--from", help=f"First pose of the vehicle: {options.SIX}.")] = None,
    end: options.End = None,
    speed: Annotated[float | None, typer.Option(help=f"Speed from --from to --to [m/s] (default: {SPEED}).")] = None,
    frames: Annotated[
        int | None,
        typer.Option(help="Number of pings (default: as far apart as the phase centres of the array allow)."),
    ] = None,
    frame: options.Frame = "mitsonar",
    side: Annotated[str, typer.Option(help="Side that the array looks at: starboard or port.")] = "starboard",
    element: Annotated[float, typer.Option(help="Length of each element along the track [m].")] = 0.1,
    receivers: Annotated[int, typer.Option(help="Number of receivers, one element apart.")] = 8,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="Change a key of the array, KEY=VALUE: carrier_hz=120e3, tilt_deg=70, range_max=40."),
    ] = None,
    window: Annotated[
        str | None,
        typer.Option("--range", help="Ground range near,far of the image [m] (default: edge of the beam to range_max)."),
    ] = None,
    pixel: Annotated[
        str | None, typer.Option(help="Spacing of pixels along,across [m] (default: half the resolution).")
    ] = None,
    ground: Annotated[
        float | None, typer.Option(help="Height z of the plane that is focused [m] (default: the ground below the path).")
    ] = None,
    navigation: Annotated[
        Path | None,
        typer.Option(help="Poses that focusing assumes, a TUM or CSV file (default: those that the vehicle has)."),
    ] = None,
    correct: Annotated[
        str | None,
        typer.Option(help="Corrections of the path: dpc (displaced phase centres), autofocus, or both: dpc,autofocus."),
    ] = None,
    weighting: Annotated[
        str, typer.Option(help="uniform (sharpest, side lobes of -13 dB) or hann (-31 dB, 1.6 times as wide).")
    ] = "uniform",
    parameter: options.Parameters = None,
    moving: options.Moving = None,
    overwrite: options.Overwrite = False,
    resume: options.Resume = False,
) -> None:
    """Simulate a synthetic aperture, and write image.npz, image.png and the responses into the folder OUT."""
    import numpy as np

    from mitsonar.acoustics.water import Water, absorption_db_per_m
    from mitsonar.mapping.aperture_run import ApertureOptions, run_aperture
    from mitsonar.mapping.micronavigation import LEAST_COHERENCE
    from mitsonar.mapping.synthetic_aperture import along_resolution, refuse_aliased, strip_grid
    from mitsonar.motion.trajectory import Trajectory, convention_named, velocities
    from mitsonar.simulation.channel import ChannelSimulator
    from mitsonar.simulation.instrument_runs import run_impulse
    from mitsonar.simulation.runs import Destination, path_digest
    from mitsonar.simulation.scene import find_scene

    # 1. instrument and path
    loaded, origin = _load(scene, parameter)
    sonar = _array(element, receivers, side, set_ or [])
    if "absorption_db_per_m" not in [pair.partition("=")[0] for pair in set_ or []]:
        sonar = sonar.replace(absorption_db_per_m=float(absorption_db_per_m(sonar.carrier_hz, Water())))
    corrections = _corrections(correct)
    # displaced phase centres need pings whose receivers overlap
    shared = len(sonar.receivers) // 2 if "dpc" in corrections else 0
    spacing = along_resolution(sonar) * (len(sonar.receivers) - shared)
    flown = _path(spacing, trajectory, start, end, speed, frames, frame)
    _refuse_haste(sonar, flown)
    # 2. what is focused is checked before anything is simulated
    bodies, moved = moving_bodies(loaded, moving, convention_named(frame).name, flown)
    origin |= moved
    seen = sonar.box_seen_from(flown.poses[:: max(1, len(flown) // 1000)])
    simulator = ChannelSimulator(loaded, sonar, within=seen, moving=bodies)
    planned = _planned(simulator, flown)
    ends, steps = numbers(window, 2, "--range"), numbers(pixel, 2, "--pixel")
    if steps and min(steps) <= 0:
        raise MitsonarError(f"--pixel takes two spacings above 0 m, along,across: got {pixel}")
    grid = strip_grid(
        planned,
        near_m=ends[0] if ends else None,
        far_m=ends[1] if ends else None,
        along_step_m=steps[0] if steps else None,
        across_step_m=steps[1] if steps else None,
        ground_m=ground,
    )
    refuse_aliased(planned)
    if weighting not in ("uniform", "hann"):
        raise MitsonarError(f"--weighting takes uniform or hann: got {weighting}")
    assumed = None if navigation is None else Trajectory.load(navigation, frame, looks_ahead=False)
    chosen: Literal["uniform", "hann"] = "hann" if weighting == "hann" else "uniform"
    # 3. measure, then focus
    folder = out or Path("out") / f"{find_scene(scene).stem}-sas"
    along = along_resolution(sonar)
    title = (
        f"{sonar.carrier_hz / 1e3:g} kHz, {count_noun(len(flown), 'ping')} of "
        f"{count_noun(len(sonar.receivers), 'receiver')}, "
        f"resolution {100 * along:.3g} cm along, {50 * sonar.sound_speed / sonar.bandwidth_hz:.3g} cm in range"
    )

    def measure(inner: Path, resumed: bool) -> list[str]:
        with progress_bar("measuring", len(flown), "pings") as progress:
            destination = Destination(inner, origin, resume=resumed, progress=progress)
            return run_impulse(simulator, flown, velocities(flown), destination, pulsed=True).warnings

    settings = origin | {"sonar": sonar.model_dump(mode="json"), "poses_sha256": path_digest(flown)}
    with LaterBar("focusing", "rows") as bar:
        report = run_aperture(
            *(folder, settings, measure),
            ApertureOptions(grid, chosen, assumed, corrections),
            title=title,
            resume=resume,
            overwrite=overwrite,
            begin=lambda done: bar.begin(grid.rows, done),
            progress=bar.advance,
        )
    for sentence in report.warnings:
        warn(sentence)
    say(f"{title} in {folder}")
    say(options.poses_line(flown, {}))
    say(
        f"image of {grid.rows:,} x {grid.columns:,} pixels, {grid.along_m[0]:.3g} to {grid.along_m[-1]:.3g} m along the "
        "track, "
        f"{abs(grid.across_m[0]):.3g} to {abs(grid.across_m[-1]):.3g} m to {side}, on the plane z = {grid.z:.3g} m"
    )
    if micro := report.micronavigation:
        if micro.unused:
            warn(
                f"{micro.unused} of {count_noun(len(micro.sway_m), 'pair')} of pings not used: their coherence is below "
                f"{LEAST_COHERENCE:g}, and their sway counts as 0; see {folder / 'micronavigation.csv'}"
            )
        say(
            f"displaced phase centres: coherence {np.median(micro.coherence):.2f}, sway between pings "
            f"{1e3 * np.nanstd(micro.sway_m):.3g} mm, bound {1e3 * np.nanmedian(micro.sway_std_m):.2g} mm"
        )
    say(f"files: {folder / 'image.png'}, {folder / 'image.npz'}, {folder / 'responses'}")


def _corrections(text: str | None) -> tuple[Correction, ...]:
    """Return the corrections of --correct, in the order in which they are applied."""
    from mitsonar.errors import suggest_names
    from mitsonar.mapping.aperture_run import CORRECTIONS

    given = [] if text is None else [one.strip() for one in text.split(",")]
    for one in given:
        if one not in CORRECTIONS:
            raise MitsonarError(f"--correct has no {one!r}: {suggest_names(one, CORRECTIONS)}")
    return tuple(one for one in CORRECTIONS if one in given)


def _array(element: float, receivers: int, side: str, changes: list[str]) -> ChannelSonar:
    """Return the instrument with its changes."""
    from mitsonar.instruments.hydrophones import ChannelSonar, side_looking_array

    if side not in ("port", "starboard"):
        raise MitsonarError(f"--side takes port or starboard: got {side}")
    keys: dict[str, Any] = {}
    numeric = ("carrier_hz", "bandwidth_hz", "range_max", "sound_speed", "tilt_deg", "along_deg")
    for pair in changes:
        key, equals, value = pair.partition("=")
        if not equals:
            raise MitsonarError(f"--set takes KEY=VALUE: got {pair!r}")
        if key in ("transmitter", "receivers", "model", "rolloff", "sampling_hz", "frequency_step_hz"):
            raise MitsonarError(f"the array of a synthetic aperture sets {key} itself: leave it out, or focus in Python")
        if key not in numeric and key not in ChannelSonar.model_fields:
            from mitsonar.errors import suggest_names

            raise MitsonarError(
                f"the array has no key {key!r}: {suggest_names(key, [*numeric, *ChannelSonar.model_fields])}"
            )
        try:
            keys[key] = float(value) if key in numeric else value
        except ValueError:
            raise MitsonarError(f"{key} must be a number: got {value!r}") from None
    looked: Literal["port", "starboard"] = "port" if side == "port" else "starboard"
    return side_looking_array(element, receivers, side=looked, **keys)


def _path(
    spacing: float,
    file: Path | None,
    start: str | None,
    end: str | None,
    speed: float | None,
    frames: int | None,
    frame: str,
) -> Trajectory:
    """Return the pings along a path, by default ``spacing`` apart [m]."""
    import numpy as np

    from mitsonar.motion.pose import Pose
    from mitsonar.motion.trajectory import Trajectory, convention_named

    convention_named(frame)
    if frames is not None and frames < 2:
        raise MitsonarError(f"--frames must be at least 2 pings: got {frames}")
    if file is not None:
        if start or end:
            raise MitsonarError("--trajectory and --from/--to contradict each other: give one")
        if speed is not None:
            raise MitsonarError(f"--speed belongs to --from and --to, and {file} has times of its own: leave --speed out")
        flown = Trajectory.load(file, frame, looks_ahead=False)
    else:
        first, last = numbers(start, 6, "--from"), numbers(end, 6, "--to")
        if first is None or last is None:
            raise MitsonarError(f"give a path: --trajectory FILE.tum, or --from and --to ({options.SIX})")
        speed = SPEED if speed is None else speed
        if not 0 < speed < 1e4:
            raise MitsonarError(f"--speed must be above 0 m/s: got {speed:g}")
        length = math.dist(first[:3], last[:3])
        flown = Trajectory.between(Pose.from_degrees(first), Pose.from_degrees(last), 2, speed / max(length, 1e-9))
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(flown.poses[:, :3], axis=0), axis=1))])
    if len(flown) < 2 or way[-1] < 1e-6:
        raise MitsonarError("a synthetic aperture needs a path that moves: give two or more different places")
    if frames is not None:
        return flown.resample(frames)
    count = math.ceil(way[-1] / spacing) + 1
    if count > MOST_PINGS:
        raise MitsonarError(
            f"a path of {way[-1]:.4g} m takes {count:,} pings {spacing:.3g} m apart, more than {MOST_PINGS:,}: shorten it, "
            "or give more receivers"
        )
    time_s = np.interp(np.linspace(0, way[-1], count), way, flown.time_s)
    return Trajectory(flown.at(time_s), time_s)


MOST_PINGS = 100_000
"""Largest number of pings that the command spaces by itself."""


def _refuse_haste(sonar: ChannelSonar, flown: Trajectory) -> None:
    """Refuse pings that are sent before the last echo of the one before is back.

    Raises:
        MitsonarError: the message gives the speed that would do.
    """
    import numpy as np

    interval, longest = float(np.diff(flown.time_s).min()), 2 * sonar.range_max / sonar.sound_speed
    if interval < longest * (1 - 1e-9):
        steps = np.linalg.norm(np.diff(flown.poses[:, :3], axis=0), axis=1)
        fastest = float((steps / np.maximum(np.diff(flown.time_s), 1e-12)).max())
        raise MitsonarError(
            f"pings follow each other after {1e3 * interval:.3g} ms, before the echo from {sonar.range_max:g} m is back "
            f"after {1e3 * longest:.3g} ms: fly at {fastest * interval / longest:.3g} m/s at most instead of {fastest:.3g}, "
            "lower range_max, or give more receivers"
        )


def _planned(simulator: ChannelSimulator, flown: Trajectory) -> ImpulseResponses:
    """Return responses that are all 0 and take no memory, with the geometry of a run."""
    import numpy as np

    from mitsonar.motion.trajectory import velocities
    from mitsonar.records.responses import ImpulseResponses

    sonar = simulator.sonar
    nothing = np.broadcast_to(np.complex64(0), (len(flown), len(sonar.receivers), sonar.taps))
    height = simulator.tracer.height_m(flown.poses)
    return ImpulseResponses(nothing, flown.time_s, sonar, flown.poses, velocities(flown), height)
