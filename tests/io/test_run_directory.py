"""The folder of a run: begun, gone on with, replaced, refused; and a file that a stranger has written."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.io.files import whole_lines
from mitsonar.io.runs import (
    RUN_FILE,
    RunDirectory,
    RunKind,
    changed_versions,
    check_same_settings,
    differences,
    digest,
    file_digest,
    json_digest,
    refuse_to_replace,
    versions,
)

KIND = RunKind(
    "experiment",
    outputs=("table.md", "parts", "answers-*.npz"),
    notes={"done": int, "gain": float, "words": list, "tally": dict, "name": str, "sure": bool},
    packages=("numpy", "no-such-package"),
    deciding=("numpy",),
)
WAYS = ((False, False), (True, False), (False, True))
"""(resume, overwrite): a run that is there is refused, resumed or replaced."""

ASKED: dict[str, object] = {"sonar": {"beams": 16, "window": (1.0, 2.5)}, "path": Path("a/b"), "poses": np.arange(3)}


def begun(path: Path, asked: dict[str, object] = ASKED, *, resume: bool = False, overwrite: bool = False) -> RunDirectory:
    run = RunDirectory.begin(path, KIND, asked, resume=resume, overwrite=overwrite)
    run.start(done=0)
    return run


def rewritten(path: Path, **values: Any) -> None:
    """The run's file with other values; None removes one."""
    message = json.loads((path / RUN_FILE).read_text()) | values
    (path / RUN_FILE).write_text(json.dumps({key: value for key, value in message.items() if value is not None}))


# ---------------------------------------------------------------- begin, go on, replace


def test_beginning_writes_nothing_and_starting_says_what_was_asked(tmp_path: Path) -> None:
    run = RunDirectory.begin(tmp_path / "a" / "run", KIND, ASKED)
    assert not (tmp_path / "a").exists()
    run.start(done=0)
    message = json.loads((tmp_path / "a" / "run" / RUN_FILE).read_text())
    assert message["kind"] == "experiment"
    assert message["asked"] == {"sonar": {"beams": 16, "window": [1.0, 2.5]}, "path": "a/b", "poses": [0, 1, 2]}
    assert message["versions"] == {"numpy": np.__version__, "no-such-package": "not installed as a package"}
    assert (message["finished"], message["done"]) == (False, 0)


def test_a_resumed_run_keeps_notes_and_outputs(tmp_path: Path) -> None:
    run = begun(tmp_path / "run")
    run.note(done=3, gain=np.float32(0.5), tally={"rays": 7})
    (run.path / "table.md").write_text("half")
    again = begun(tmp_path / "run", resume=True)
    assert again.resumed
    assert (again.count("done", 5), again.notes["gain"], again.notes["tally"]) == (3, 0.5, {"rays": 7})
    assert (run.path / "table.md").read_text() == "half"
    again.finish(done=5)
    assert RunDirectory.open(run.path, KIND).finished


def test_a_run_to_resume_that_is_not_there_begins(tmp_path: Path) -> None:
    run = begun(tmp_path / "run", resume=True)
    assert not run.resumed
    assert (run.path / RUN_FILE).is_file()


def test_a_replaced_run_loses_its_outputs_and_nothing_else(tmp_path: Path) -> None:
    run = begun(tmp_path / "run")
    run.finish(done=9)
    (run.path / "parts").mkdir()
    (run.path / "parts" / "one").write_text("1")
    (run.path / "answers-high.npz").write_text("2")
    (run.path / "mine.txt").write_text("mine")
    new = RunDirectory.begin(tmp_path / "run", KIND, {"other": 1}, overwrite=True)
    assert (run.path / "parts" / "one").is_file(), "nothing is removed before the new run starts"
    new.start(done=0)
    assert sorted(os.listdir(run.path)) == ["mine.txt", RUN_FILE]
    again = RunDirectory.open(run.path, KIND)
    assert (again.settings, again.notes, again.finished) == ({"other": 1}, {"done": 0}, False)


@pytest.mark.posix
def test_what_was_killed_while_it_replaced_a_run_begins_anew_when_resumed(tmp_path: Path) -> None:
    """Half of the old outputs are never taken for the new run's."""
    run = begun(tmp_path / "run")
    run.note(done=3)
    (run.path / "table.md").write_text("old")
    script = f"""
        import os, shutil, sys
        from pathlib import Path
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from test_run_directory import KIND
        from mitsonar.io.runs import RunDirectory
        Path.unlink = lambda *_, **__: os.kill(os.getpid(), 9)
        RunDirectory.begin({str(run.path)!r}, KIND, {{"other": 1}}, overwrite=True).start(done=0)
    """
    killed = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert (run.path / "table.md").read_text() == "old"
    new = RunDirectory.begin(run.path, KIND, {"other": 1}, resume=True)
    assert not new.resumed
    new.start(done=0)
    assert os.listdir(run.path) == [RUN_FILE]


def test_what_a_kill_leaves_before_a_run_has_begun_is_free(tmp_path: Path) -> None:
    (tmp_path / f".{RUN_FILE}.part").write_text("{")
    (tmp_path / "writer.lock").touch()
    assert not begun(tmp_path).resumed


# ---------------------------------------------------------------- refused


def test_other_things_are_kept(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    for resume, overwrite in WAYS:
        with pytest.raises(MitsonarError, match=r"contains other files \(thesis.tex\) and is kept as it is: choose"):
            begun(tmp_path, resume=resume, overwrite=overwrite)
        with pytest.raises(MitsonarError, match="is a file and is kept as it is"):
            begun(tmp_path / "thesis.tex", resume=resume, overwrite=overwrite)
    assert os.listdir(tmp_path) == ["thesis.tex"]


def test_runs_of_another_kind_are_kept(tmp_path: Path) -> None:
    second = RunDirectory.begin(tmp_path, RunKind("odometry", outputs=("table.md",), notes={}), {})
    second.start()
    before = (tmp_path / RUN_FILE).read_bytes()
    for resume, overwrite in WAYS:
        with pytest.raises(MitsonarError, match="holds no experiment of mitsonar and is kept as it is"):
            begun(tmp_path, resume=resume, overwrite=overwrite)
    with pytest.raises(MitsonarError, match="holds no experiment"):
        RunDirectory.open(tmp_path, KIND)
    assert (tmp_path / RUN_FILE).read_bytes() == before
    with pytest.raises(MitsonarError, match=r"holds no experiment: there is no .*run\.json"):
        RunDirectory.open(tmp_path / "none", KIND)


def test_a_run_is_kept_unless_it_is_resumed_or_replaced_and_not_both(tmp_path: Path) -> None:
    begun(tmp_path)
    with pytest.raises(MitsonarError, match="exists and is kept as it is: --resume continues it, --overwrite begins"):
        begun(tmp_path)
    with pytest.raises(MitsonarError, match="contradict each other"):
        begun(tmp_path, resume=True, overwrite=True)


def test_another_run_is_not_gone_on_with(tmp_path: Path) -> None:
    begun(tmp_path)
    before = (tmp_path / RUN_FILE).read_bytes()
    wide = {**ASKED, "sonar": {"beams": 32, "window": [1.0, 2.5]}, "noise": "low"}
    with pytest.raises(MitsonarError, match=r"was begun with sonar\.beams 16, not 32; noise None, not low: request"):
        begun(tmp_path, wide, resume=True)
    rewritten(tmp_path, versions={"numpy": "1.0"})
    with pytest.raises(MitsonarError, match=rf"was begun with numpy 1\.0, not {np.__version__}"):
        begun(tmp_path, resume=True)
    (tmp_path / RUN_FILE).write_bytes(before)
    assert begun(tmp_path, resume=True).resumed


def test_a_folder_that_cannot_be_made_is_said(tmp_path: Path) -> None:
    run = RunDirectory.begin(tmp_path / "file" / "run", KIND, ASKED)
    (tmp_path / "file").touch()
    with pytest.raises(MitsonarError, match=r"cannot write .*; choose another -o"):
        run.start()


# ---------------------------------------------------------------- a file of a stranger


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"done": "3"}, "run done: input should be a valid integer, got '3'"),
        ({"done": -1}, "run done: input should be greater than or equal to 0, got -1"),
        ({"done": True}, "run done: input should be a valid integer, got True"),
        ({"done": 2**70}, "it holds an integer of 71 bits"),
        ({"done": 2**63}, "run done: input should be less than or equal to 9223372036854775807, got 9223372036854775808"),
        ({"gain": float("nan")}, "run gain: input should be a finite number, got nan"),
        ({"gain": 10**400}, "it holds an integer of 1,329 bits"),
        ({"words": ["a", {}]}, r"run words\.1.*, got {}"),
        ({"words": ["a", True]}, r"run words\.1.*, got True"),
        ({"tally": [1]}, "run tally: input should be a valid dictionary"),
        ({"name": 3}, "run name: input should be a valid string, got 3"),
        ({"finished": "yes"}, "run finished: input should be a valid boolean, got 'yes'"),
        ({"asked": []}, "run asked: input should be a valid dictionary"),
        ({"versions": None}, "run lacks versions"),
        ({"doen": 3}, "unknown run key doen: did you mean done"),
        ({"tally": json.loads("[" * 100 + "]" * 100)}, "it nests more than 40 deep"),
    ],
)
def test_values_of_another_type_are_named(tmp_path: Path, values: dict[str, Any], said: str) -> None:
    begun(tmp_path)
    rewritten(tmp_path, **values)
    with pytest.raises(MitsonarError, match=r"run\.json is damaged \(" + said):
        begun(tmp_path, resume=True)
    assert not begun(tmp_path, overwrite=True).resumed


def test_a_count_beyond_what_is_possible_is_named(tmp_path: Path) -> None:
    run = begun(tmp_path)
    run.note(done=7)
    output = r"run\.json is damaged \(done must be a whole number in 0\.\.5: got 7\): begin anew with --overwrite, or choose"
    with pytest.raises(
        MitsonarError,
        match=output,
    ):
        run.count("done", 5)
    assert run.count("lacking", 5) == 0


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 200_000, '{"kind": ' + "9" * 5000 + "}", "\ufeff{}", "null"])
def test_text_that_is_no_run_is_one_sentence(tmp_path: Path, text: str) -> None:
    (tmp_path / RUN_FILE).write_text(text)
    for resume, overwrite in WAYS:
        with pytest.raises(MitsonarError):
            begun(tmp_path, resume=resume, overwrite=overwrite)
    assert (tmp_path / RUN_FILE).read_text() == text


@pytest.mark.parametrize("count", [300, pytest.param(10_000, marks=pytest.mark.slow)])
def test_mutated_files_are_refused_or_read(tmp_path: Path, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """One changed byte, one doubled or dropped piece: a sentence, or values of the right types."""
    monkeypatch.setattr(os, "fsync", lambda number: None)  # the disk is not asked
    run = begun(tmp_path)
    run.note(done=3, gain=0.5, words=["a", 1], tally={"rays": 7}, name="x", sure=True)
    whole = (tmp_path / RUN_FILE).read_bytes()
    draw = random.Random(1)
    for _ in range(count):
        place, length = draw.randrange(len(whole)), draw.randrange(1, 9)
        piece = draw.choice([b"", bytes([draw.randrange(256)]), whole[place : place + length] * 2, b"null", b"[", b"1e999"])
        (tmp_path / RUN_FILE).write_bytes(whole[:place] + piece + whole[place + length :])
        try:
            again = RunDirectory.begin(tmp_path, KIND, ASKED, resume=True)
        except MitsonarError:
            continue
        assert type(again.finished) is bool
        assert again.count("done", 2**63) >= 0
        again.note(words=["b"])


# ---------------------------------------------------------------- what a result was made of


def test_differences_name_both_values() -> None:
    had, arguments = {"a": 1, "b": {"c": [1, 2], "d": None}, "old": "x" * 100}, {"a": 1.0, "b": {"c": [1, 3], "d": None}}
    assert differences(had, arguments) == ["b.c [1, 2], not [1, 3]", f"old {'x' * 60}..., not None"]
    assert differences(arguments, arguments) == []
    with pytest.raises(
        MitsonarError, match=r"^here was begun with a 0, not 1; .*; and 2 more: request the same settings \(so\), or"
    ):
        check_same_settings("here", dict.fromkeys("abcdef", 0), dict.fromkeys("abcdef", 1), " (so)")


def test_digests_are_of_contents(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"abc")
    assert digest(b"a", "bc") == file_digest(tmp_path / "file") == digest("abc")
    assert digest("abc").startswith("ba7816bf8f01cfea")  # of FIPS 180-4
    assert json_digest({"a": (1, 2), "b": np.int64(3)}) == json_digest({"b": 3, "a": [1, 2]}) != json_digest({"a": [1, 2]})


def test_versions_that_differ_are_named() -> None:
    assert changed_versions(versions(["numpy"]), ["numpy"]) == []
    assert changed_versions({"numpy": "1.0"}, ["numpy"]) == [f"numpy 1.0 (now {np.__version__})"]


def test_files_are_replaced_only_where_that_was_asked_for(tmp_path: Path) -> None:
    there, free = tmp_path / "there.png", tmp_path / "free.png"
    there.touch()
    refuse_to_replace(free, overwrite=False)
    refuse_to_replace(there, free, overwrite=True)
    with pytest.raises(MitsonarError, match=r"there\.png exists and is kept as it is: choose another --onnx, or"):
        refuse_to_replace(free, there, overwrite=False, option="--onnx")
    with pytest.raises(MitsonarError, match="exists and is kept"):
        refuse_to_replace(tmp_path, overwrite=True)


def test_a_line_that_a_kill_left_half_written_is_cut_off(tmp_path: Path) -> None:
    journal = tmp_path / "journal.jsonl"
    assert whole_lines(journal, "journal", 100) == []
    journal.write_bytes(b"one\ntwo\nthr")
    assert whole_lines(journal, "journal", 100) == [b"one", b"two"]
    assert journal.read_bytes() == b"one\ntwo\n"
    with pytest.raises(MitsonarError, match="larger than 5 bytes"):
        whole_lines(journal, "journal", 5)
