"""``mitsonar serve``: poses in, sonar out, ping by ping."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from mitsonar.cli.console import answered, say
from mitsonar.cli.flown_path import SIX, Frame, path_for
from mitsonar.cli.render_command import NOISE, instrument_for, scene_parameters, sonar_changes
from mitsonar.errors import MitsonarError, counted

if TYPE_CHECKING:
    from mitsonar.bridges.live import LivePublisher, PoseMailbox

__all__ = ["serve"]


@answered
def serve(
    scene: Annotated[str, typer.Argument(help="Mitsuba XML file, or the name of a shipped scene (`mitsonar scenes`).")],
    sonar: Annotated[str | None, typer.Option(help="Preset (`mitsonar presets`) or YAML file.")] = None,
    model: Annotated[str | None, typer.Option(help="physical, thesis or coherent.")] = None,
    quality: Annotated[str | None, typer.Option(help="draft, standard or fine (`mitsonar presets`).")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE of the sonar: range_max=8.")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the Foxglove WebSocket; 0: a free one.")] = 8765,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0: all of this machine.")] = "127.0.0.1",
    rate: Annotated[float | None, typer.Option(help="Pings a second of the path (default: the sonar's) [Hz].")] = None,
    start: Annotated[str | None, typer.Option("--from", help=f"First pose: {SIX}.")] = None,
    trajectory: Annotated[
        Path | None, typer.Option(help="Path that is played while no pose comes: a TUM or CSV file, or `shipped`.")
    ] = None,
    frame: Frame = "mitsonar",
    noise: Annotated[str, typer.Option(help=f"{NOISE}.")] = "none",
    seed: Annotated[int | None, typer.Option(help="Seed of jitter and noise.")] = None,
    parameter: Annotated[list[str] | None, typer.Option("-D", help="NAME=VALUE for the scene's $NAME.")] = None,
    pings: Annotated[int | None, typer.Option(min=1, help="End after so many pings (default: never).")] = None,
    ros: Annotated[bool, typer.Option("--ros", help="A ROS 2 node in place of the Foxglove server; needs rclpy.")] = False,
) -> None:
    """Serve a live sonar: clients publish poses on /pose and get fan, polar image, transform and timing. Ctrl-C ends it."""
    from mitsonar.acoustics.noise import load_noise, refuse_noise
    from mitsonar.bridges.live import PoseMailbox, live_pings
    from mitsonar.simulation.scene import load_scene
    from mitsonar.simulation.simulator import Simulator

    drawn = load_noise(noise)
    loaded = load_scene(scene, **scene_parameters(parameter or []))
    instrument, attitude = instrument_for(loaded, sonar, model, seed, sonar_changes(set_ or [], quality))
    refuse_noise(drawn, instrument)
    path = path_for(instrument, attitude, scene, None, start, None, trajectory, frame)
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
    """Start the server and say where it is."""
    from mitsonar.bridges.foxglove import FoxgloveServer

    server = FoxgloveServer(mailbox, host, port)
    say(f"listening on ws://{host}:{server.port} (in Foxglove: Open connection); poses as JSON on /pose")
    return server


def _ros_node(mailbox: PoseMailbox) -> LivePublisher:
    """Start the node and say its topics."""
    from mitsonar.bridges.ros_node import RosNode

    node = RosNode(mailbox)
    say("ROS 2 node /mitsonar: poses on /pose")
    return node
