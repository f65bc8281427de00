"""Commands ``mitsonar serve`` and ``mitsonar view``: serve a live sonar, and show frames in Rerun."""

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
from mitsonar.errors import MitsonarError, count_noun

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
    rate: Annotated[float | None, typer.Option(help="Pings per second along the path [Hz] (default: the sonar's).")] = None,
    start: options.Start = None,
    trajectory: Annotated[
        Path | None, typer.Option(help="Path to play while no pose arrives: a TUM or CSV file, or `shipped`.")
    ] = None,
    frame: options.Frame = "mitsonar",
    noise: options.Noise = "none",
    seed: Annotated[int | None, typer.Option(help="Seed of jitter and noise.")] = None,
    parameter: options.Parameters = None,
    pings: Annotated[int | None, typer.Option(min=1, help="End after this many pings (default: never).")] = None,
    ros: Annotated[
        bool, typer.Option("--ros", help="Start a ROS 2 node instead of the Foxglove server; needs rclpy.")
    ] = False,
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
        raise MitsonarError(f"--rate must be positive: got {hertz:g}; give pings per second")
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
    say(f"{count_noun(served, 'ping')}")


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
    save: Annotated[
        Path | None, typer.Option("--save", help="Write a recording (.rrd) instead of opening the viewer.")
    ] = None,
    html: Annotated[
        Path | None, typer.Option("--html", help="Make a folder with a page and the viewer, for any web server.")
    ] = None,
    path: Annotated[
        Path | None, typer.Option("--path", help="Estimated path to add: the folder of an odometry, a TUM or CSV file.")
    ] = None,
    frame: options.Frame = "mitsonar",
    scene: Annotated[
        str | None, typer.Option(help="Scene to draw: XML file or name (default: the run's; `none`: no scene).")
    ] = None,
    sequence: Annotated[int | None, typer.Option(help="Sequence of a data set (default: the longest).")] = None,
    view_: Annotated[str | None, typer.Option("--view", help="View of a data set (default: the first).")] = None,
    parameter: options.Parameters = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file or page.")] = False,
) -> None:
    """Show fan, polar image and levels of each frame, with scene, beams, true and estimated path."""
    from mitsonar.bridges.rerun import write_recording
    from mitsonar.bridges.viewer_page import RECORDING, VIEWER, write_page
    from mitsonar.io.runs import refuse_to_replace

    if save is not None and html is not None:
        raise MitsonarError("--save and --html contradict each other: the page contains the recording; give one")
    if save is not None and (save.suffix != ".rrd" or not save.parent.is_dir()):
        raise MitsonarError(f"--save must name an .rrd file in an existing folder: got {save}")
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
        warn(f"{len(boxed)} shapes are drawn as boxes, since they are instances or too large meshes: {names}")
    summary = f"{count_noun(frames, 'frame')}, {count_noun(len(shown.shapes), 'shape')}"
    summary += f", {count_noun(len(shown.estimated), 'estimated path')}"
    if html is not None:
        write_page(html)
        say(f"{summary}: {html}; serve it: python -m http.server -d {html}")
    elif target is not None:
        say(f"{summary}: {target} ({target.stat().st_size:,} bytes); open it: rerun {target}")


def _shown(
    what: str,
    scene: str | None,
    parameters: dict[str, str],
    estimated: dict[str, Trajectory],
    sequence: int | None,
    view_: str | None,
) -> Shown:
    """Return the content to show: frames with their scene, or a scene with its sonar and its shipped path."""
    from mitsonar.bridges.rerun import Shown
    from mitsonar.mapping.sources import is_data_set, is_recording, open_frames

    run = Path(what)
    frames_there = is_data_set(what) or is_recording(what) or run.is_dir() or run.suffix in (".npz", ".zarr")
    if frames_there:
        source = open_frames(what, sequence=sequence, view=view_)
        scene_name, scene_parameters = (scene, parameters) if scene is not None else _scene_of(run)
        shapes = [] if scene_name in (None, "none") else _loaded(str(scene_name), scene_parameters)[0]
        return Shown(source.name, source, source.like.sonar, None, shapes, estimated)
    if sequence is not None or view_ is not None or scene is not None:
        raise MitsonarError(f"--sequence, --view and --scene apply only to frames: {what} is a scene, or does not exist")
    shapes, sonar, path = _loaded(what, parameters)
    return Shown(what, None, sonar, path, shapes, estimated)


def _loaded(scene: str, parameters: dict[str, str]) -> tuple[Any, Any, Any]:
    """Load a scene: its triangles, its sonar, and the path next to its file or the pose of the sonar."""
    import numpy as np

    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.simulation.scene import find_scene, load_scene, sonar_in, triangles_in

    loaded = load_scene(scene, **parameters)
    sonar_and_pose = sonar_in(loaded)
    path_file = find_scene(scene).with_suffix(".tum")
    path = Trajectory(np.array([sonar_and_pose[1]]), np.zeros(1)) if sonar_and_pose else None
    if path_file.is_file():
        path = Trajectory.load_tum(path_file)
    return triangles_in(loaded), sonar_and_pose and sonar_and_pose[0], path


def _scene_of(run: Path) -> tuple[str | None, dict[str, str]]:
    """Return the scene of a run and its parameters, if run.json names the scene and the file exists."""
    from mitsonar.io.files import read_json
    from mitsonar.simulation.scene import find_scene

    folder = run if run.is_dir() else run.parent
    if not (folder / "run.json").is_file():
        return None, {}
    record = read_json(folder / "run.json")
    request = record.get("asked", record)
    name, parameters = request.get("scene", record.get("scene")), request.get("parameters", record.get("parameters", {}))
    if not isinstance(name, str) or not isinstance(parameters, dict):
        return None, {}
    try:
        find_scene(name)
    except MitsonarError:
        warn(f"the scene of the run, {name}, was not found: give it with --scene, or give `--scene none`")
        return None, {}
    return name, {str(key): str(value) for key, value in parameters.items()}


def _paths(path: Path | None, frame: str) -> dict[str, Trajectory]:
    """Load an estimated path; from the folder of an odometry also the true one."""
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
