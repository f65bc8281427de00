"""No scene runs code: libraries that lie beside it, below it or in the current directory are never loaded."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import PROGRAM

CODE = '#include <stdio.h>\n__attribute__((constructor)) static void run(void) { fclose(fopen("RAN", "w")); }\n'
"""A library that leaves a mark where the process works."""

NAMES = ("sphere", "diffuse", "evil", "imaging_sonar", "acoustic_material", "twosided", "hdrfilm", "independent", "srgb")
"""Plugins of Mitsuba, of mitsonar and of nobody, all of which the library poses as."""

SENSOR = '<sensor type="imaging_sonar"><integer name="beams" value="4"/><integer name="rays_per_beam" value="4"/></sensor>'
SPHERE = '<shape type="sphere"><bsdf type="{}"/></shape>'


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The compiled library; skips where there is no compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("needs a C compiler, and Linux")
    folder = tmp_path_factory.mktemp("library")
    (folder / "code.c").write_text(CODE)
    subprocess.run([compiler, "-shared", "-fPIC", "-o", str(folder / "code.so"), str(folder / "code.c")], check=True)
    return folder / "code.so"


def spread(library: Path, folder: Path, names: tuple[str, ...] = NAMES) -> None:
    """Put the library wherever Mitsuba might look from a folder."""
    (folder / "plugins").mkdir(parents=True, exist_ok=True)
    for name in names:
        shutil.copy(library, folder / "plugins" / f"{name}.so")
    shutil.copy(library, folder / "evil.so")


def scene(inside: str) -> str:
    return f'<scene version="3.0.0">{SENSOR}{inside}</scene>'


SCENES = {
    "shadowed": scene(SPHERE.format("diffuse")),
    "another name": scene('<shape type="evil"/>'),
    "upwards": scene('<shape type="../evil"/>'),
    "a path": scene('<shape type="{folder}/evil"/>'),
    "an ending": scene('<shape type="evil.x"/>'),
    "parameter": scene('<default name="p" value="evil"/><shape type="$p"/>'),
    "nested": scene(SPHERE.format("evil")),
    "alias": scene('<bsdf type="evil" id="a"/><alias id="a" as="b"/><shape type="sphere"><ref id="b"/></shape>'),
    "include": scene('<include filename="part.xml"/>'),
    "folder": scene('<path value="more"/>' + SPHERE.format("more_evil")),
    "spectrum": scene('<shape type="sphere"><bsdf type="diffuse"><spectrum type="evil" name="reflectance"/></bsdf></shape>'),
    "no scene": '<shape version="3.0.0" type="evil"/>',
}
"""Scenes that name a library."""

LOAD = """
import sys
from pathlib import Path
from mitsonar import MitsonarError, Simulator, load_scene
for path in sorted(Path(sys.argv[1]).glob("*.xml")):
    try:
        Simulator(load_scene(path)).render([[0, 0, 0, 0, 0, 0]])
        print(path.stem, "read")
    except MitsonarError as error:
        print(path.stem, "refused", error)
    if Path("RAN").exists():
        sys.exit(f"{path.stem} ran code")
"""


@pytest.mark.parametrize(
    "inside", [pytest.param(False, marks=pytest.mark.thorough), True], ids=["elsewhere", "in its folder"]
)
def test_no_scene_loads_a_library(inside: bool, library: Path, tmp_path: Path) -> None:
    folder = tmp_path / "stranger"
    spread(library, folder)
    spread(library, folder / "more", ("more_evil",))
    work = folder if inside else tmp_path / "work"
    spread(library, work, () if not inside else NAMES)
    for name, text in SCENES.items():
        (folder / f"{name.replace(' ', '_')}.xml").write_text(text.replace("{folder}", str(folder)))
    (folder / "part.xml").write_text('<scene version="3.0.0"><shape type="evil"/></scene>')
    done = subprocess.run(
        [sys.executable, "-c", LOAD, str(folder)], cwd=work, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    lines = {line.split()[0]: line for line in done.stdout.splitlines()}
    assert lines.pop("shadowed").endswith("read")
    assert len(lines) == len(SCENES)
    for name, line in lines.items():
        assert "refused" in line, line
        assert "evil" in line, f"{name} is refused for another reason: {line}"


@pytest.mark.thorough
@pytest.mark.parametrize("names", [("sphere", "imaging_sonar"), ("evil",)])
def test_a_strangers_run_loads_no_library(names: tuple[str, ...], library: Path, tmp_path: Path) -> None:
    """``view`` shows the scene that a run names."""
    run = tmp_path / "run"
    spread(library, run, names)
    (run / "scene.xml").write_text(scene(SPHERE.format("diffuse" if "evil" not in names else "evil")))
    message = {"asked": {"scene": str(run / "scene.xml"), "parameters": {}}}
    (run / "run.json").write_text(json.dumps(message))
    make = (
        "import sys; sys.path.insert(0, sys.argv[1]); from hostile_readers import frames; "
        "frames().save(sys.argv[2] + '/frames.npz')"
    )
    tests = str(Path(__file__).parents[1])
    subprocess.run([sys.executable, "-c", make, tests, str(run)], check=True, cwd=tmp_path, timeout=120)
    for command in (["view", str(run), "--out", "shown.html"], ["render", str(run / "scene.xml"), "--out", "made"]):
        done = subprocess.run([*PROGRAM, *command], cwd=run, capture_output=True, text=True, timeout=120, check=False)
        assert not (run / "RAN").exists(), done.stdout + done.stderr
        assert "Traceback" not in done.stderr, done.stderr


@pytest.mark.thorough
def test_classes_registered_in_python_still_work(tmp_path: Path) -> None:
    """They are code of this process already. Their names may be anything that a file's name may be."""
    (tmp_path / "mine.xml").write_text(scene('<shape type="sphere"><bsdf type="my-bsdf.v2"/></shape>'))
    script = f"""
import mitsuba as mi
mi.set_variant("llvm_ad_mono")
mi.register_bsdf("my-bsdf.v2", lambda props: mi.load_dict({{"type": "diffuse"}}))
from mitsonar import load_scene
assert load_scene({str(tmp_path / "mine.xml")!r}).shapes()[0].bsdf().class_name() == "SmoothDiffuse"
"""
    subprocess.run([sys.executable, "-c", script], check=True, cwd=tmp_path, timeout=120)
