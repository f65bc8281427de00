"""The house rules: what imports cost and need, which module may import which, what is packaged."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from helpers import Command, run_python

from mitsonar.errors import EXTRAS

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SETUPTOOLS = PROJECT["tool"]["setuptools"]

ROOMS = (
    "errors",
    "arrays",
    "io",
    "motion",
    "instruments",
    "acoustics",
    "records",
    "geometry",
    "recordings",
    "plugins",
    "worlds",
    "config",
    "plotting",
    "simulation",
    "datasets",
    "networks",
    "estimation",
    "mapping",
    "training",
    "reproduction",
    "bridges",
    "cli",
    "__main__",
)
"""Rooms in the order in which data flows: a module imports only from its own room and from earlier ones."""


def folder_of(package: str) -> Path:
    """Where a package's files are in the checkout."""
    if package in SETUPTOOLS["package-dir"]:
        return ROOT / str(SETUPTOOLS["package-dir"][package])
    return ROOT / package.replace(".", "/")


def modules() -> dict[str, Path]:
    """All modules by their name within mitsonar; a package is its ``__init__``, and mitsonar itself the empty name."""
    result = {}
    for package in SETUPTOOLS["packages"]:
        within = package.removeprefix("mitsonar").removeprefix(".")
        for path in sorted(folder_of(package).glob("*.py")):
            name = within if path.stem == "__init__" else f"{within}.{path.stem}".lstrip(".")
            result[name] = path
    return result


MODULES = modules()

parsed = cache(lambda path: ast.parse(path.read_text()))


def imports(tree: ast.AST, types: bool = True) -> Iterator[str]:
    """What a module imports, also within functions, and with ``types`` for type checking: ``mitsonar.errors.EXTRAS``."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING" and not types:
            for second in node.orelse:
                yield from imports(second, types)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide where a name comes from"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        else:
            yield from imports(node, types)


@cache
def imported(path: Path, types: bool = True) -> frozenset[str]:
    """Modules of mitsonar that a file imports; a name in a module counts as the module."""
    result = set()
    for full in imports(parsed(path), types):
        if full.split(".")[0] == "mitsonar":
            name = full.removeprefix("mitsonar").removeprefix(".")
            while name not in MODULES:
                name = name.rpartition(".")[0]
            result.add(name)
    return frozenset(result)


def room(name: str) -> str:
    """The room of a module: ``simulation`` of ``simulation.imaging``."""
    return name.split(".")[0]


DATA = ("scenes", "recipes")
"""Packages that hold data; a script that makes them may stand beside."""

PACKAGES = {name for name, path in MODULES.items() if path.stem == "__init__"}
"""Their ``__init__`` is outside the order: it may import nothing of mitsonar but, at the top, the plugins' register."""

HOUSE = {name: path for name, path in MODULES.items() if name not in PACKAGES and room(name) not in DATA}
"""Modules that import what their room may."""


def test_every_module_has_its_room() -> None:
    lost = {name for name in HOUSE if room(name) not in ROOMS}
    assert not lost, f"give these modules a room: {sorted(lost)}"


@pytest.mark.parametrize("name", HOUSE)
def test_modules_import_from_their_own_and_earlier_rooms_only(name: str) -> None:
    for second in imported(HOUSE[name]) - set(DATA):
        assert second, f"{name} imports from mitsonar itself: import from the module that holds the name"
        command = room(name) in ("cli", "__main__")
        assert second not in PACKAGES or command, f"{name} imports the package {second}: import from its modules"
        assert ROOMS.index(room(second)) <= ROOMS.index(room(name)), f"{name} imports from {second}, a later room"


def test_objects_of_mitsuba_are_created_where_no_foreign_library_is_loaded() -> None:
    """Mitsuba runs ``plugins/NAME.so`` of the scene's folder and of the current one: see ``plugins/native_plugins.py``."""
    creating = {"load_dict", "load_file", "load_string", "instantiate", "create_object", "plugin_type"}
    result = set()
    for name, path in HOUSE.items():
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Attribute) and node.attr in creating:
                result.add((name, node.attr))
    assert result == {("plugins.native_plugins", "load_dict"), ("simulation.scene", "instantiate")}


def test_no_circles_within_a_room() -> None:
    waiting = {name: imported(path) & set(HOUSE) for name, path in HOUSE.items() if room(name) != "cli"}
    while ready := [name for name, others in waiting.items() if not others & set(waiting)]:
        for name in ready:
            del waiting[name]
    assert not waiting, f"these import each other in a circle: {sorted(waiting)}"


def test_packages_import_nothing_but_the_register_of_plugins() -> None:
    allowed = {"": {"errors", "plugins"}, "networks": {"networks.create"}}
    result = {name: imported(MODULES[name], types=False) for name in PACKAGES if name != "cli"}
    assert result == {name: allowed.get(name, set()) for name in result}


def test_only_plugins_and_the_simulation_speak_mitsuba() -> None:
    """What evaluates images must work where there is no renderer."""
    speak = set()
    for name, path in MODULES.items():
        tops = {full.split(".")[0] for full in imports(parsed(path), types=False)}
        if tops & {"mitsuba", "drjit"}:
            speak.add(name.split(".")[0])
    assert speak <= {
        "plugins",
        "simulation",
        "cli",
        "worlds",
        "bridges",
    }  # worlds and bridges only to check what Mitsuba would read


@pytest.mark.thorough
def test_kernels_compile_on_old_versions_of_llvm() -> None:
    """LLVM 15 and 16 end the process on these; `clipped` and `select` compare."""
    for path in (path for room in ("mitsonar", "plugins") for path in (ROOT / room).rglob("*.py")):
        nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        used = {node.attr for node in nodes if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "dr"}
        assert not used & {"minimum", "maximum", "clip"}, path


def test_every_module_says_what_it_is() -> None:
    for name, path in MODULES.items():
        assert ast.get_docstring(parsed(path)), f"{name or 'mitsonar'} has no docstring"


# ---------------------------------------------------------------- what imports load


@pytest.mark.thorough
def test_import_sets_no_variant_and_loads_no_renderer() -> None:
    run_python("""
        import sys
        import mitsonar
        heavy = {"mitsuba", "drjit", "torch", "matplotlib", "zarr"} & set(sys.modules)
        assert not heavy, heavy
        import mitsuba
        assert mitsuba.variant() is None, mitsuba.variant()
        assert "Simulator" in dir(mitsonar) and mitsonar.Sonar().beams == 96
        assert mitsuba.variant() is None
        try:
            mitsonar.Sona
        except AttributeError as error:
            assert "Sona" in str(error)
        else:
            raise AssertionError("an unknown name must be an AttributeError")
    """)


@pytest.mark.thorough
def test_public_names_are_all_there() -> None:
    run_python("""
        import mitsonar
        from mitsonar.simulation.device import ensure_variant
        for name in mitsonar.__all__:
            assert getattr(mitsonar, name) is not None, name
    """)


@pytest.mark.thorough
def test_all_but_rendering_works_without_a_renderer() -> None:
    script = """
        import numpy as np, mitsonar, tempfile
        sonar = mitsonar.load_sonar("didson300").replace(beams=4, range_bins=8)
        flown = mitsonar.Trajectory.between(mitsonar.Pose(0, 0, 2), mitsonar.Pose(0, 1, 2), 3, 10)
        noise = mitsonar.load_noise("low")
        image = noise.apply(np.zeros((3, 8, 4), np.float32), seed=1, frames=np.arange(3))
        frames = mitsonar.SonarFrames(image, sonar.range_m, sonar.bearing_rad, flown.time_s, sonar, flown.poses)
        with tempfile.TemporaryDirectory() as folder:
            frames.save(folder + "/frames.npz")
            assert len(mitsonar.SonarFrames.load(folder)) == 3
        try:
            mitsonar.load_scene("flat_floor")
        except mitsonar.MitsonarError as error:
            assert "Dr.Jit cannot be loaded" in str(error) and "apt-get install" in str(error), error
        else:
            raise AssertionError("without Dr.Jit nothing can be rendered")
    """
    run_python(script, block=("mitsuba", "drjit", "torch"))


@pytest.mark.thorough
def test_rendering_works_without_torch() -> None:
    script = """
        import warnings
        import mitsonar
        from mitsonar.simulation.device import ensure_variant
        ensure_variant()
        import mitsuba as mi
        import mitsonar.simulation.models.coherent
        warnings.simplefilter("ignore", mitsonar.MitsonarWarning)
        floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(100), "bsdf": {"type": "diffuse"}}
        simulator = mitsonar.Simulator(mi.load_dict({"type": "scene", "floor": floor}), mitsonar.Sonar(beams=4))
        pose = mitsonar.Pose.from_degrees([0, 0, 2.5, 35, 0, 0])
        frames = simulator.render([pose], noise=mitsonar.load_noise("high"), seed=1)
        assert frames.image.max() > 0.5
    """
    run_python(script, block=("torch", "cv2", "trimesh", "distributed", "dask", "tifffile"))


OPTIONAL = ("torch", "cv2", "trimesh", "distributed", "dask", "tifffile", "lightning", "sklearn", "rosbags", "gymnasium")
"""Packages of the extras that commands could need by accident."""


@pytest.mark.thorough
def test_commands_need_no_more_than_their_extra(tmp_path: Path) -> None:
    """`make demo` installs no extra: what draws and renders needs none, and odometry needs no torch."""
    script = """
        import sys
        from mitsonar.cli import main
        for words in %r:
            sys.argv = ["mitsonar", *words]
            try:
                main()
            except SystemExit as end:
                assert end.code in (0, None), (words, end.code)
    """
    flown = ("--from=0,-4,2.5,35,0,0", "--to=0.02,-3.98,2.5,35,0,0", "--frames", "3", "--model", "physical")
    run = str(tmp_path / "run")
    plain = [
        ["render", "objects", *flown, "--set", "beams=24", "--cartesian", "--fan", "--labels", "-o", run],
        ["impulse", "hydrophones", "--velocity", "1,0.5", "--set", "rays=500", "-o", str(tmp_path / "heard")],
        ["recording", "info", run],
    ]
    run_python(script % plain, block=OPTIONAL)
    odometry = [["odometry", run, "--workers", "1", "-o", str(tmp_path / "path")]]
    run_python(script % odometry, block=tuple(name for name in OPTIONAL if name not in ("cv2", "tifffile")))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("package", "uses", "extra"),
    [
        ("cv2", ['create_estimator("direct")'], "odometry"),
        ("torch", ["SonarPairs", 'load_checkpoint("corrnet")'], "learn"),
    ],
)
def test_a_missing_package_is_one_sentence_that_names_the_extra(package: str, uses: list[str], extra: str) -> None:
    script = f"""
        import mitsonar
        for use in {uses!r}:
            try:
                eval("mitsonar." + use)
            except mitsonar.MitsonarError as error:
                assert "{package}" in str(error) and "pip install 'mitsonar[{extra}]'" in str(error), error
            else:
                raise AssertionError("it must be missed")
    """
    run_python(script, block=(package,))


@pytest.mark.thorough
def test_a_command_names_the_extra_that_it_lacks(tmp_path: Path) -> None:
    script = """
        import sys
        from mitsonar.cli import main
        sys.stderr = sys.stdout
        sys.argv = ["mitsonar", "world", "rocky-field", "--size-m", "5", "-o", "%s"]
        try:
            main()
        except SystemExit as end:
            assert end.code == 2, end.code
    """
    output = run_python(script % (tmp_path / "rocks"), block=("trimesh",))
    assert not (tmp_path / "rocks").exists()
    assert "trimesh" in output
    assert "pip install 'mitsonar[data,meshes]'" in output


DISTRIBUTIONS = {
    **{"dask": "distributed", "collada": "pycollada", "pxr": "usd-core", "cv2": "opencv-python-headless"},
    **{"sklearn": "scikit-learn", "foxglove": "foxglove-sdk", "rerun": "rerun-sdk"},
}
"""Packages whose distribution has another name, or comes with another one."""


@pytest.mark.parametrize("package", EXTRAS)
def test_the_extras_of_messages_install_what_is_missing_and_are_documented(package: str) -> None:
    extras, table = EXTRAS[package][0].split(","), (ROOT / "docs" / "start.md").read_text()
    for extra in extras:
        needs = {re.split(r"[<>=\[]", one)[0] for one in PROJECT["project"]["optional-dependencies"][extra]}
        assert DISTRIBUTIONS.get(package, package) in needs, f"{package} is not in the extra {extra}"
        assert f"| `{extra}` |" in table, f"docs/start.md does not name the extra {extra}"


@pytest.mark.thorough
def test_data_sets_are_made_without_torch(tmp_path: Path) -> None:
    script = f"""
        import sys
        sys.path.insert(0, {str(ROOT / "tests")!r})
        from helpers import tiny_recipe
        from mitsonar.datasets.make import check
        from mitsonar.datasets.make import make_dataset
        from mitsonar.datasets.store import DataStore
        make_dataset(tiny_recipe(), {str(tmp_path / "tiny.zarr")!r}, sequences=2)
        assert check(DataStore.open({str(tmp_path / "tiny.zarr")!r})) == []
    """
    run_python(script, block=("torch",))


@pytest.mark.thorough
def test_a_stored_set_is_read_without_a_simulator(tiny_data: Path) -> None:
    """Configuration stands below the simulation: who only reads enters no simulator and loads no Mitsuba."""
    run_python(f"""
        import sys
        import mitsonar
        store = mitsonar.DataStore.open({str(tiny_data)!r})
        assert store.read("image").any()
        entered = [name for name in sys.modules if name.startswith("mitsonar.simulation") or name in ("mitsuba", "drjit")]
        assert not entered, entered
    """)


# ---------------------------------------------------------------- what is packaged


def test_package_list_matches_the_folders() -> None:
    """The list is explicit: a sub-package that is forgotten is missing from the wheel without a word."""
    folders = {
        f"mitsonar.{path.parent.relative_to(ROOT / 'mitsonar').as_posix().replace('/', '.')}".removesuffix(
            ".."
        ).removesuffix(".")
        for path in (ROOT / "mitsonar").rglob("__init__.py")
    }
    mapped = set(SETUPTOOLS["package-dir"])
    assert all((folder_of(package) / "__init__.py").is_file() for package in SETUPTOOLS["packages"])
    assert set(SETUPTOOLS["packages"]) == folders | mapped
    loose = {path.parent for path in (ROOT / "mitsonar").rglob("*.py")} - {folder_of(name) for name in folders}
    assert not loose, f"folders with modules but no __init__.py: {loose}"


def test_package_data_names_every_shipped_file() -> None:
    """What lies in scenes/ and is no Python is in the wheel, and no pattern is left over."""
    scenes = ROOT / "scenes"
    named = {path for pattern in SETUPTOOLS["package-data"]["mitsonar.scenes"] for path in scenes.glob(pattern)}
    shipped = {path for path in scenes.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")}
    assert shipped == named
    recipes = set((ROOT / "mitsonar" / "config").glob(SETUPTOOLS["package-data"]["mitsonar.config"][0]))
    assert len(recipes) == 32
    training = ROOT / "benchmarks" / "recipes"
    named = {path for pattern in SETUPTOOLS["package-data"]["mitsonar.recipes"] for path in training.glob(pattern)}
    assert {path for path in training.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")} == named
    assert (ROOT / "mitsonar" / "py.typed").is_file()


# ---------------------------------------------------------------- markers


def test_what_uses_the_command_line_is_e2e(request: pytest.FixtureRequest, mitsonar: Command) -> None:
    assert request.node.get_closest_marker("e2e")
    assert not request.node.get_closest_marker("unit")


def test_what_does_not_is_unit(request: pytest.FixtureRequest) -> None:
    assert request.node.get_closest_marker("unit")
    assert not request.node.get_closest_marker("e2e")
