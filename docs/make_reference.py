"""Write the two reference pages that follow from the code: docs/reference/command-line.md and python.md.

    python docs/make_reference.py [--quick]

A test compares the stored pages with those of this script.
"""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

import mitsonar
from mitsonar.cli import application

Click = Any
"""A command, context or parameter of Click, or of Typer's copy of it."""

FOLDER = Path(__file__).parent / "reference"

GROUPS = {
    "Scenes and sonars": ("load_scene", "load_sonar", "Sonar", "ChannelSonar", "load_sounder", "Sounder"),
    "Poses and paths": ("Pose", "Motion", "Trajectory"),
    "Simulation": (
        "Simulator",
        "ChannelSimulator",
        "SounderSimulator",
        "DifferentiableSimulator",
        "load_noise",
        "NoiseModel",
    ),
    "Bodies that move": ("Deforming", "load_meshes", "load_motions", "range_rates", "particle_mesh", "fishing_net_mesh"),
    "Sea surface": ("SeaSurface",),
    "Several sensors": ("VehicleSimulator", "Mounted", "load_vehicle"),
    "Environments": (
        "SonarEnv",
        "SonarVectorEnv",
        "bridges.gymnasium.SonarTask",
        "bridges.gymnasium.Transition",
    ),
    "Records": (
        "SonarFrames",
        "ImpulseResponses",
        "Echogram",
        "Soundings",
        "load_frames",
        "open_recording",
        "write_mcap",
        "FirstReturns",
    ),
    "Estimation and mapping": (
        "create_estimator",
        "Estimate",
        "compare",
        "ComparisonOptions",
        "Comparison",
        "odometry",
        "OdometryOptions",
        "VehicleSensors",
        "load_sensors",
        "save_sensors",
        "SensorNoise",
        "simulated_sensors",
        "build_mosaic",
        "MosaicOptions",
        "cramer_rao_bound",
        "estimation.image.direct6.Direct6",
        "load_checkpoint",
    ),
    "Data sets": (
        "load_recipe",
        "make_dataset",
        "DataStore",
        "SonarPairs",
        "ImpulsePairs",
        "ImpulseSamples",
        "RenderedPairs",
        "Split",
    ),
    "Errors": ("MitsonarError", "MitsonarWarning"),
}
"""Public names by subject, and names of modules with dots. Names that mitsonar does not have are left out; those of no group
come last."""


OPENING = """Names are read in three forms, by what it is:

| it is | call | then |
|---|---|---|
| what a record's `save` wrote | `load` of its class: `SonarFrames.load`, `Trajectory.load` ... | all is in memory |
| a name, or one of several kinds of files | `load_...`: `load_scene`, `load_sonar`, `load_frames` ... | all is in memory |
| larger than the memory | `mitsonar.open_recording`, `DataStore.open` | parts are read when they are needed |

`load_frames` reads frames wherever they are: of a run, a data set or a recording. `SonarFrames.load` reads those of a run
with their labels. A path that is not there, or holds something else, is a `MitsonarError` that says what to give."""


def python_page() -> str:
    """Return the page of the public Python names."""
    known = {name for names in GROUPS.values() for name in names}
    groups = {**GROUPS, "Others": tuple(name for name in mitsonar.__all__ if name not in known)}
    parts = [
        "# Python",
        "These names are in `mitsonar` itself, those with dots in its modules. They are loaded when they are first used: "
        "`import mitsonar` loads no Mitsuba and no torch. Errors that a user can cause are `MitsonarError`, with one "
        "sentence.",
        OPENING,
    ]
    for title, names in groups.items():
        public = [name for name in names if name in mitsonar.__all__ or "." in name]
        if public:
            parts += [f"## {title}", *(f"::: mitsonar.{name}" for name in public)]
    return "\n\n".join(parts) + "\n"


def command_page() -> str:
    """Return the page of the command line: every command with its arguments and options."""
    parts = [
        "# Command line",
        "`mitsonar COMMAND --help` prints the same. `python -m mitsonar` is the same program. An error ends the program "
        "with one sentence and exit code 2.",
    ]
    for name, command in commands(typer.main.get_command(application()), "mitsonar"):
        parts += [f"## `{name}`", inspect.cleandoc(command.help or "").replace("\n\n\n", "\n\n")]
        context = command.context_class(command, info_name=name)
        rows = [row(parameter, context) for parameter in command.params if parameter.name != "help"]
        if rows:
            parts.append("\n".join(["| argument or option | default | meaning |", "|---|---|---|", *rows]))
    return "\n\n".join(parts) + "\n"


def commands(command: Click, name: str) -> Iterator[tuple[str, Click]]:
    """List all commands below one, with their full names, in the order of the program."""
    if not hasattr(command, "list_commands"):
        yield name, command
        return
    context = command.context_class(command, info_name=name)
    for word in command.list_commands(context):
        yield from commands(command.get_command(context, word), f"{name} {word}")


def row(parameter: Click, context: Click) -> str:
    """Format a line of the table of a command."""
    if parameter.param_type_name == "argument":
        names = f"`{parameter.metavar or parameter.name.upper()}`"
    else:
        value = "" if parameter.is_flag else f" {parameter.metavar or kind(parameter, context)}"
        names = ", ".join(f"`{name}{value}`" for name in (*parameter.opts, *parameter.secondary_opts))
    default = "" if callable(parameter.default) or parameter.default in (None, False, ()) else f"`{parameter.default}`"
    if parameter.required:
        default = "required"
    text = " ".join((parameter.help or "").split())
    text = text.replace("\\[", "[").replace("[", "\\[").replace("<", "&lt;")  # in help texts brackets may be escaped or not
    return f"| {names} | {default} | {text} |"


def kind(parameter: Click, context: Click) -> str:
    """Return the type of an option's value as its help shows it: INT, FLOAT, TEXT ..."""
    words = {"int": "INT", "float": "FLOAT", "path": "PATH"}
    shown = str(parameter.display_type(context)).strip("<>").split()
    return words.get(shown[0].lower() if shown else "", "TEXT")


def main() -> None:
    """Write both pages, or with ``--quick`` only say whether they are what the code gives."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="write nothing: compare, and fail where a page is stale")
    pages = {"command-line.md": command_page(), "python.md": python_page()}
    if parser.parse_args().quick:
        stale = [name for name, text in pages.items() if (FOLDER / name).read_text(encoding="utf-8") != text]
        raise SystemExit(f"stale: {', '.join(stale)}; run docs/make_reference.py" if stale else 0)
    FOLDER.mkdir(exist_ok=True)
    for name, text in pages.items():
        (FOLDER / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
