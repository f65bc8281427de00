"""``mitsonar serve``: poses in, sonar out, ping by ping."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitsonar.cli import options
from mitsonar.cli.console import answered, command_line, progress_bar, say, warn
from mitsonar.errors import MitsonarError, counted

if TYPE_CHECKING:
    from mitsonar.bridges.live import LivePublisher, PoseMailbox
    from mitsonar.bridges.rerun import Shown
    from mitsonar.motion.trajectory import Trajectory

__all__ = ["serve", "view"]


@answered
def serve(
    scene: options.SceneName,
    sonar: options.SonarName = None,
    model: Annotated[str | None, typer.Option(help="physical, thesis or coherent.")] = None,
    quality: Annotated[str | None, typer.Option(help="draft, standard or fine (`mitsonar presets`).")] = None,
    set_: options.SonarKeys = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the Foxglove WebSocket; 0: a free one.")] = 8765,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0: all of this machine.")] = "127.0.0.1",
    rate: Annotated[float | None, typer.Option(help="Pings a second of the path (default: the sonar's) [Hz].")] = None,
    start: options.Start = None,
    trajectory: Annotated[
        Path | None, typer.Option(help="Path that is played while no pose comes: a TUM or CSV file, or `shipped`.")
    ] = None,
    frame: options.Frame = "mitsonar",
    noise: options.Noise = "none",
    seed: Annotated[int | None, typer.Option(help="Seed of jitter and noise.")] = None,
    parameter: options.Parameters = None,
    pings: Annotated[int | None, typer.Option(min=1, help="End after so many pings (default: never).")] = None,
    ros: Annotated[bool, typer.Option("--ros", help="A ROS 2 node in place of the Foxglove server; needs rclpy.")] = False,
) -> None:
    """Serve a live sonar: clients publish poses on /pose and get fan, polar image, transform and timing. Ctrl-C ends it."""
    from mitsonar.acoustics.noise import load_noise, refuse_noise
    from mitsonar.bridges.live import PoseMailbox, live_pings
    from mitsonar.simulation.scene import load_scene
    from mitsonar.simulation.simulator import Simulator

    drawn = load_noise(noise)
    loaded = load_scene(scene, **options.scene_parameters(parameter or []))
    instrument, attitude = options.instrument_for(loaded, sonar, options.sonar_changes(set_, quality, model, seed))
    refuse_noise(drawn, instrument)
    path = options.path_for(instrument, attitude, scene, None, start, None, trajectory, frame)
    hertz = instrument.frame_rate_hz if rate is None else rate
    if not hertz > 0:
        raise MitsonarError(f"--rate must be positive: got {hertz:g}; give pings a second")
    simulator = Simulator(loaded, instrument)
    mailbox, served = PoseMailbox(), 0
    publisher = _ros_node(mailbox) if ros else _foxglove(mailbox, host, port)
    say(f"{instrument.title}, {instrument.model} model, {instrument.beams} beams x {instrument.range_bins} bins: ready")
    try:
        with _set_by_signals() as ends:
            for _ in live_pings(simulator, mailbox, publisher, path, rate_hz=hertz, noise=drawn, seed=seed or 0, ends=ends):
                served += 1
                if pings is not None and served >= pings:
                    break
    finally:
        publisher.close()
    say(f"{counted(served, 'ping')}")


@contextmanager
def _set_by_signals() -> Iterator[Event]:
    """Yield an event that Ctrl-C or SIGTERM sets. A second signal ends the process at once."""
    ends, numbers = Event(), (signal.SIGINT, signal.SIGTERM)

    def end(number: int, _: FrameType | None) -> None:
        signal.signal(number, signal.default_int_handler)
        ends.set()

    before = {number: signal.signal(number, end) for number in numbers}
    try:
        yield ends
    finally:
        for number in numbers:
            signal.signal(number, before[number])


def _foxglove(mailbox: PoseMailbox, host: str, port: int) -> LivePublisher:
    """Start the server and print its address."""
    from mitsonar.bridges.foxglove import FoxgloveServer

    server = FoxgloveServer(mailbox, host, port)
    say(f"listening on ws://{host}:{server.port} (in Foxglove: Open connection); poses as JSON on /pose")
    return server


def _ros_node(mailbox: PoseMailbox) -> LivePublisher:
    """Start the node and print its topics."""
    from mitsonar.bridges.ros_node import RosNode

    node = RosNode(mailbox)
    say("ROS 2 node /mitsonar: poses on /pose")
    return node


# ---------------- ``mitsonar view``: frames, scene and paths in the viewer Rerun


@answered
def view(
    what: Annotated[
        str,
        typer.Argument(
            metavar="RUN|FILE|DATA.zarr|SCENE", help="A run, frames, a recording, a data set, or a scene (XML or name)."
        ),
    ],
    save: Annotated[Path | None, typer.Option("--save", help="Write a recording (.rrd) and open no viewer.")] = None,
    html: Annotated[
        Path | None, typer.Option("--html", help="Make a folder: a page with the viewer, for any web server.")
    ] = None,
    path: Annotated[
        Path | None, typer.Option("--path", help="Estimated path too: the folder of an odometry, a TUM or CSV file.")
    ] = None,
    frame: options.Frame = "mitsonar",
    scene: Annotated[
        str | None, typer.Option(help="Scene to draw: XML or name (default: that of the run; `none`: no scene).")
    ] = None,
    sequence: Annotated[int | None, typer.Option(help="Sequence of a data set (default: the longest).")] = None,
    view_: Annotated[str | None, typer.Option("--view", help="View of a data set (default: the first).")] = None,
    parameter: options.Parameters = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file or page.")] = False,
) -> None:
    """Show fan, polar image and levels of each frame; scene, wedge of the beams, true and estimated path."""
    from mitsonar.bridges.rerun import write_recording
    from mitsonar.bridges.viewer_page import RECORDING, VIEWER, write_page
    from mitsonar.io.runs import refuse_to_replace

    if save is not None and html is not None:
        raise MitsonarError("--save and --html contradict each other: the page has the recording in it")
    if save is not None and (save.suffix != ".rrd" or not save.parent.is_dir()):
        raise MitsonarError(f"--save must name an .rrd file in a folder that is there: got {save}")
    target = html / RECORDING if html is not None else save
    if target is not None:
        option = "--save" if html is None else "--html"
        refuse_to_replace(target, *[html / name for name in VIEWER if html], overwrite=overwrite, option=option)
    shown = _shown(what, scene, dict(options.scene_parameters(parameter or [])), _paths(path, frame), sequence, view_)
    if html is not None:
        html.mkdir(parents=True, exist_ok=True)
    frames = 0 if shown.source is None else len(shown.source)
    with progress_bar("logging", frames, "frames") as progress:
        boxed = write_recording(shown, target, progress)
    if boxed:
        names = ", ".join(boxed[:5]) + (" ..." if len(boxed) > 5 else "")
        warn(f"of {len(boxed)} shapes only the box is drawn, of instances and of meshes that are too large: {names}")
    said = f"{counted(frames, 'frame')}, {counted(len(shown.shapes), 'shape')}"
    said += f", {counted(len(shown.estimated), 'estimated path')}"
    if html is not None:
        write_page(html)
        say(f"{said}: {html}; serve it: python -m http.server -d {html}")
    elif target is not None:
        say(f"{said}: {target} ({target.stat().st_size:,} bytes); open it: rerun {target}")


def _shown(
    what: str,
    scene: str | None,
    parameters: dict[str, str],
    estimated: dict[str, Trajectory],
    sequence: int | None,
    view_: str | None,
) -> Shown:
    """Return what to show: frames with the scene they were made of, or a scene with its sonar and its shipped path."""
    from mitsonar.bridges.rerun import Shown
    from mitsonar.mapping.sources import is_data_set, is_recording, open_frames

    place = Path(what)
    frames_there = is_data_set(what) or is_recording(what) or place.is_dir() or place.suffix in (".npz", ".zarr")
    if frames_there:
        source = open_frames(what, sequence=sequence, view=view_)
        named, told = (scene, parameters) if scene is not None else _scene_of(place)
        shapes = [] if named in (None, "none") else _loaded(str(named), told)[0]
        return Shown(source.name, source, source.like.sonar, None, shapes, estimated)
    if sequence is not None or view_ is not None or scene is not None:
        raise MitsonarError(f"--sequence, --view and --scene are for frames: {what} is a scene, or is not there")
    shapes, found, path = _loaded(what, parameters)
    return Shown(what, None, found, path, shapes, estimated)


def _loaded(scene: str, parameters: dict[str, str]) -> tuple[Any, Any, Any]:
    """Load a scene: its triangles, its sonar, and the path that lies beside it or the pose of the sonar."""
    import numpy as np

    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.simulation.scene import find_scene, load_scene, sonar_in, triangles_in

    loaded = load_scene(scene, **parameters)
    found = sonar_in(loaded)
    beside = find_scene(scene).with_suffix(".tum")
    path = Trajectory(np.array([found[1]]), np.zeros(1)) if found else None
    if beside.is_file():
        path = Trajectory.load_tum(beside)
    return triangles_in(loaded), found and found[0], path


def _scene_of(run: Path) -> tuple[str | None, dict[str, str]]:
    """Return the scene that a run was made of, where it says it and it is there, and its parameters."""
    from mitsonar.io.files import read_json
    from mitsonar.simulation.scene import find_scene

    folder = run if run.is_dir() else run.parent
    if not (folder / "run.json").is_file():
        return None, {}
    told = read_json(folder / "run.json")
    asked = told.get("asked", told)
    name, parameters = asked.get("scene", told.get("scene")), asked.get("parameters", told.get("parameters", {}))
    if not isinstance(name, str) or not isinstance(parameters, dict):
        return None, {}
    try:
        find_scene(name)
    except MitsonarError:
        warn(f"the scene of the run, {name}, is not there: give it by --scene, or `--scene none`")
        return None, {}
    return name, {str(key): str(value) for key, value in parameters.items()}


def _paths(path: Path | None, frame: str) -> dict[str, Trajectory]:
    """Load an estimated path; of an odometry's folder the true one as well."""
    from mitsonar.mapping.odometry_run import OdometryFolder
    from mitsonar.motion.trajectory import Trajectory

    if path is None:
        return {}
    if not path.exists():
        raise MitsonarError(f"there is no path {path}: {command_line('odometry')} makes one, or give a TUM or CSV file")
    if path.is_dir():
        folder = OdometryFolder.open(path)
        return {"estimated": folder.estimated} | ({} if folder.true is None else {"true": folder.true})
    return {"estimated": Trajectory.load(path, frame)}
