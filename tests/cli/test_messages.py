"""What the command line answers to slips: the nearest name, the option that was typed, commands that can be pasted."""

from __future__ import annotations

import errno
import json
import os
import pickle
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from drawn_frames import over_ground, sway
from helpers import Command, essence, refused, run_python

from mitsonar.cli.console import OPTIONS, _Log, answered, command_line, numbers, say, say_json, warn
from mitsonar.errors import MitsonarError, argument, did_you_mean, suggest_names
from mitsonar.geometry.ground import attitude_of

AMPHORA = Path(__file__).parents[1] / "scenes" / "meshes" / "amphora.ply"

SLIPS = [
    ("render flat_floor --noise hgih", "got 'hgih'; did you mean high?"),
    ("render flat_flor", "did you mean flat_floor?"),
    (
        "render flat_floor --model physicl",
        "--model: input should be 'coherent', 'physical' or 'thesis'",
        "did you mean physical?",
    ),
    ("render flat_floor --sonar didson30", "did you mean didson300"),
    ("render flat_floor --trajectory shiped", "did you mean shipped?"),
    ("render flat_floor --frame end", "unknown frame 'end' of poses: did you mean ned?"),
    ("render pattern -D textur=rings", "did you mean texture?"),
    ("render flat_floor -D cells=3", "unused parameters: - $cells=3"),
    ("impulse hydrophones --trajectory squar", "did you mean square?"),
    ("impulse hydrophones --model scaterers", "--model: input should be", "did you mean scatterers?"),
    ("impulse hydrophones --set receivers=forwrd", "chooses among the receivers"),
    (
        "crlb flat_floor --sonar didson300 --noise low",
        "the model coherent adds its own noise",
        "give the sonar noise_level_db",
    ),
    ("render flat_floor --mirrors", "--mirrors needs the model coherent"),
    ("render flat_floor --set bounces=4", "bounces: input should be less than or equal to 3"),
    ("render flat_floor --model thesis --set bounces=2", "the model thesis supports one reflection"),
    ("render flat_floor --model coherent --noise low", "give the sonar noise_level_db"),
    ("crlb flat_floor --segments stabord", "did you mean starboard?"),
    ("crlb flat_floor --vary hight_m=2", "did you mean height_m?"),
    ("dataset recipes rocky-feild", "did you mean rocky-field"),
    ("dataset make rocky-field --set flight.kind=runz", "recipe flight.kind: input", "did you mean runs?"),
    ("dataset make rocky-field --set store=image", "recipe store: input should be", "did you mean images?"),
    ("dataset make rocky-field --set labels=[shadwo]", "did you mean shadow?"),
    ("dataset make rocky-field --set world.family=pattrn", "did you mean pattern?"),
    ("dataset make rocky-field --set split.by=scenes", "did you mean scene?"),
    ("render flat_floor --label-floor 0.1", "--label-floor 0.1 needs --labels"),
    ("odometry none.npz", "no such file: none.npz"),
    ("height none.npz --by drect", "got 'drect'; did you mean direct?"),
    ("mosaic none.npz treu", "or `true`; did you mean true?"),
    ("sonar fit none.npz", "no such file: none.npz"),
    ("sonar fit none.npz --sonar didson30", "did you mean didson300"),
    ("sonar fit none.npz --set frequency_hz", "--set takes KEY=VALUE"),
    (f"world mesh {AMPHORA} --reflectivity luminence", "--reflectivity must be", "did you mean luminance?"),
]


@pytest.mark.parametrize(("typed", "words"), [(slip[0], slip[1:]) for slip in SLIPS], ids=[slip[0] for slip in SLIPS])
def test_the_nearest_name_is_asked_for(mitsonar: Command, tmp_path: Path, typed: str, words: tuple[str, ...]) -> None:
    out = ["-o", tmp_path / "out.png"] if typed.startswith("mosaic") else ["-o", tmp_path / "out"]
    out = [] if typed.split()[0] in ("crlb", "height") or "recipes" in typed else out
    refused(mitsonar(*shlex.split(typed), *out), *words)


@pytest.mark.learn
@pytest.mark.parametrize(
    ("typed", "words"),
    [
        ("evaluate corrent none.zarr", "or posenet-noise or profilenet-quadrants-coherent; did you mean corrnet?"),
        ("train posenet-hul -o x", "did you mean posenet-hull"),
        ("reproduce 3.22 -o x", "did you mean 3.2"),
    ],
)
def test_the_nearest_name_of_trained_things(mitsonar: Command, tmp_path: Path, typed: str, words: str) -> None:
    refused(mitsonar(*typed.split(), cwd=tmp_path), words)


@pytest.mark.parametrize(
    "typed", ["rendr flat_floor", "dataset mak x", "world rocky-feild -o x", "render flat_floor --sonra x"]
)
def test_commands_and_options_have_neighbours_too(mitsonar: Command, typed: str) -> None:
    done = mitsonar(*typed.split())
    assert done.returncode == 2
    output = " ".join(done.stderr.replace("│", " ").split())
    assert any(
        words in output
        for words in ("Did you mean 'render'?", "Did you mean 'make'?", "Did you mean 'rocky-field'", "--sonar")
    )


def test_frames_beyond_any_memory_are_named(mitsonar: Command, tmp_path: Path) -> None:
    done = mitsonar("render", "flat_floor", "--from", "0,0,2,30,0,0", "--frames", 10**13, "-o", tmp_path / "run")
    refused(done, "out of memory; ask for less: frames or pings, beams")
    assert not (tmp_path / "run").exists()


# ---------------------------------------------------------------- options by the names that were typed


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("typed", "words"),
    [
        ("render flat_floor --seed -1", "error: --seed: input should be greater than or equal to 0"),
        ("impulse hydrophones --velocity 400,0", "error: --velocity is in m/s and must stay below"),
        ("crlb flat_floor --height -1", "error: --height must be above 0"),
        ("image nothing --range 5,4", "error: --range takes from,to in m, the near end first: got 5,4"),
        ("mosaic none.npz true -o x.png --cell-mm -10", "error: --cell-mm must be above 0: got -0.01 m"),
        ("mosaic none.npz true -o x.png --centre-beams 1", "error: --centre-beams must be at least 2"),
        ("world rocky-field --size-m -1 -o x", "error: --size-m: input should be greater than 0"),
        (f"world mesh {AMPHORA} -o x --up w", "error: --up must be x, y or z"),
        (f"world mesh {AMPHORA} -o x --scale -1", "error: --scale must be a finite number"),
        (f"world mesh {AMPHORA} -o x --floor-m -1", "error: --floor-m must lie in"),
    ],
)
def test_options_are_named_as_they_were_typed(mitsonar: Command, tmp_path: Path, typed: str, words: str) -> None:
    done = mitsonar(*shlex.split(typed), cwd=tmp_path)
    refused(done)
    assert words in done.stderr
    assert "\x1f" not in done.stderr


def test_what_frames_lack_is_asked_for_by_its_option(mitsonar: Command, tmp_path: Path) -> None:
    frames = over_ground(sway(3))
    frames.height_m, frames.poses = None, None
    frames.save(tmp_path / "bare.npz")
    refused(
        mitsonar("odometry", tmp_path / "bare.npz", "-o", tmp_path / "o", "--estimator", "ecc"), "--height", "--pitch-deg"
    )
    refused(mitsonar("height", tmp_path / "bare.npz"), "give --pitch-deg")
    refused(mitsonar("odometry", tmp_path / "bare.npz", "-o", tmp_path / "o", "--every", 0), "--every must be at least 1")
    with pytest.raises(MitsonarError, match="give height_m and pitch_rad") as caught:
        attitude_of(frames, "ecc", None, None)
    assert "\x1f" not in str(caught.value)


def test_arguments_have_their_python_names_but_for_who_typed_options() -> None:
    error = MitsonarError(f"give {argument('height_m')} or {argument('sonar pitch_rad')}, not height_m")
    for one in (error, pickle.loads(pickle.dumps(error))):
        assert str(one) == "give height_m or sonar pitch_rad, not height_m"
        assert one.with_options({"height_m": "--height"}) == "give --height or sonar pitch_rad, not height_m"
        assert one.with_options({"pitch_rad": "--pitch-deg"}) == "give height_m or --pitch-deg, not height_m"


GROUPED = {
    "mesh": "world mesh",
    "import_scene": "world import",
    "show": "recording show",
    "convert": "recording convert",
    "odometry_benchmark": "benchmark odometry",
}
"""Functions of the table whose commands are in a group, or are called otherwise."""


def test_the_table_names_options_that_there_are() -> None:
    """Every option of the table is one of its command."""
    import typer

    from mitsonar.cli import application

    tree: Any = typer.main.get_command(application())
    for name, options in OPTIONS.items():
        command = tree
        for word in GROUPED.get(name, name).split():
            command = command.get_command(None, word)
        there = {option for parameter in command.params for option in parameter.opts}
        assert {option for option in options.values() if option.startswith("--")} <= there, name


def test_a_name_that_is_near_none_is_not_guessed() -> None:
    assert did_you_mean("quartz", ["none", "low", "high"]) == ""
    assert did_you_mean("", ["none"]) == ""
    assert did_you_mean("NONE", ["none"]) == "; did you mean none?"


# ---------------------------------------------------------------- commands that can be pasted


@pytest.mark.thorough
def test_printed_commands_can_be_pasted(mitsonar: Command, tmp_path: Path) -> None:
    """A folder with a space, a quote and a dollar sign."""
    folder = tmp_path / "my world's $5"
    done = mitsonar("world", "flat-objects", "--size-m", 4, "--objects", "5,10", "-o", folder)
    assert done.returncode == 0, done.stderr
    printed = done.stdout.partition("render it with: ")[2].strip()
    words = subprocess.run(
        ["sh", "-c", f'for word in {printed}; do echo "$word"; done'], capture_output=True, text=True, check=True
    )
    assert words.stdout.splitlines() == ["mitsonar", "render", str(folder / "scene.xml"), "--cartesian"]
    assert command_line("dataset", "show", Path("a b.zarr")) == "mitsonar dataset show 'a b.zarr'"


@pytest.mark.thorough
def test_a_data_sets_command_is_quoted(mitsonar: Command, tmp_path: Path) -> None:
    message = ["--sequences", 1, "--workers", 1, "--set", "sonar.beams=4", "--set", "sonar.range_bins=16"]
    message += ["--set", "world={family: flat-objects, size_m: 20}", "--set", "flight.jump_m=null"]
    done = mitsonar("dataset", "make", "rocky-field", "-o", tmp_path / "a b.zarr", *message)
    assert done.returncode == 0, done.stderr
    assert shlex.split(done.stdout.partition("show it: ")[2]) == [
        "mitsonar",
        "dataset",
        "show",
        str(tmp_path / "a b.zarr"),
    ]


# ---------------------------------------------------------------- COLLADA


def test_a_collada_file_without_its_package_names_the_extra(
    mitsonar: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mitsonar.worlds import meshes

    monkeypatch.setattr(meshes, "find_spec", lambda name: None)
    (tmp_path / "wreck.dae").write_text("<COLLADA/>")
    done = mitsonar("world", "mesh", tmp_path / "wreck.dae", "-o", tmp_path / "w")
    refused(done, "COLLADA needs the package pycollada", "pip install 'mitsonar[meshes]'", "glb, obj, stl or ply")
    assert not (tmp_path / "w").exists()


# ---------------------------------------------------------------- signals

STAYS = "complete files stay on disk, and the same command"


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Whoever runs the tests in the background may have had Ctrl-C ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.posix
@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_a_command_with_a_sentence(
    number: signal.Signals, code: int, capfd: pytest.CaptureFixture[str]
) -> None:
    def with_folder(resume: bool = False) -> None:
        os.kill(os.getpid(), number)
        time.sleep(10)

    def without() -> None:
        try:
            with_folder()
        except KeyboardInterrupt:
            raise SystemError("native code was broken off") from None

    for command, words in (
        (with_folder, ": complete files stay on disk, and the same command with --resume continues"),
        (without, ""),
    ):
        with pytest.raises(typer.Exit) as end:
            answered(command)()
        assert end.value.exit_code == code
        assert capfd.readouterr().err == f"stopped{words}\n"
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_what_may_not_be_read_or_written_is_one_sentence(capfd: pytest.CaptureFixture[str]) -> None:
    def write() -> None:
        raise PermissionError(errno.EACCES, "Permission denied", "maps/.map.png.part")

    with pytest.raises(typer.Exit) as end:
        answered(write)()
    assert end.value.exit_code == 2
    sentence = "error: Permission denied (maps/.map.png.part); change its permissions, or give another path\n"
    assert capfd.readouterr().err == sentence


@pytest.mark.posix
def test_a_signal_ends_a_child_that_a_command_has_forked() -> None:
    """It inherits the answer to the signal, and is not to go on where its parent was."""
    script = """
        import os, signal, time
        from mitsonar.cli.console import answered
        def command():
            child = os.fork()
            if child == 0:
                time.sleep(10)
                os._exit(0)
            time.sleep(0.1)
            os.kill(child, signal.SIGTERM)
            print(os.waitpid(child, 0)[1])
        answered(command)()
    """
    assert run_python(script) == f"{int(signal.SIGTERM)}\n"


@pytest.mark.posix
@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("number", essence([signal.SIGINT, signal.SIGTERM]))
def test_a_signal_ends_a_rendering_that_goes_on(number: signal.Signals, mitsonar: Command, tmp_path: Path) -> None:
    words = ["render", "objects", "--sonar", "didson300", "--model", "physical", "--quality", "draft", "-o", "run"]
    words += ["--trajectory", "shipped", "--set", "range_bins=60"]
    command = [sys.executable, "-m", "mitsonar", *words]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        end = time.monotonic() + 60
        while not list((tmp_path / "run").glob("frames.zarr/zarr.json")) and time.monotonic() < end:
            time.sleep(0.01)
        process.send_signal(number)
        _, output = process.communicate(timeout=30)
    assert process.returncode == 128 + number
    assert output.splitlines()[-1] == f"stopped: {STAYS} with --resume continues"
    assert mitsonar(*words, "--resume", cwd=tmp_path).returncode == 0


@pytest.mark.parametrize("text", ["nan", "inf", "1,-inf"])
def test_numbers_of_options_are_finite(text: str) -> None:
    with pytest.raises(MitsonarError, match=f"--pixel takes finite numbers: got '{text}'"):
        numbers(text, text.count(",") + 1, "--pixel")


def test_printed_json_has_no_words_of_python(capfd: pytest.CaptureFixture[str]) -> None:
    say_json({"a": [1.5, float("nan")], "b": {"c": (float("inf"), "NaN")}}, indent=0)
    assert json.loads(capfd.readouterr().out, parse_constant=pytest.fail) == {"a": [1.5, None], "b": {"c": [None, "NaN"]}}


def test_the_time_left_is_estimated_from_the_third_item(capsys: pytest.CaptureFixture[str]) -> None:
    """The first items load and compile; more items than announced leave no time below 0."""
    log = _Log("rendering", 3, "pings", every_s=0.0)
    log.begun -= 10
    for _ in range(4):
        log(1)
    lines = capsys.readouterr().err.splitlines()
    assert [line.rpartition(", ")[2].endswith("s left") for line in lines] == [False, False, True, True]
    assert lines[-1].endswith(" 0 s left")


def test_names_from_files_cannot_break_a_message_or_control_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """As read in a damaged bag: a line break, an escape sequence and an undecodable byte within names."""
    hostile = "/topic\n (\x1b[2J\x07 \udcff)"
    assert str(MitsonarError(f"no  topic {hostile}\n")) == r"no  topic /topic (\x1b[2J\x07 \udcff)"
    warn(hostile)
    say("facts\nof \x1b[31m")
    shown = capsys.readouterr()
    assert (shown.out, shown.err) == ("facts\nof \\x1b[31m\n", "warning: /topic (\\x1b[2J\\x07 \\udcff)\n")


def test_of_many_names_the_nearest_or_the_first_are_listed() -> None:
    """A sonar has more than 60 keys."""
    assert suggest_names("c", ["ab", "cd"]) == "did you mean cd? Known: ab, cd"
    many = [f"name_{number}" for number in range(100)]
    assert suggest_names("name_77x", many) == "did you mean name_77 or name_7 or name_97?"
    assert suggest_names("?", many).startswith("known: name_0, name_1, ")
    assert suggest_names("?", many).endswith(", name_55, ... (100 names)")
