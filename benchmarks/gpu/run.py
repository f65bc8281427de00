"""The first hour on a machine with a GPU, in steps of at most ten minutes that can be killed and go on.

    python benchmarks/gpu/run.py STEP --out OUT                        one step
    python benchmarks/gpu/run.py --all --out OUT [--minutes 10]        the open steps, one after the other, for so long
    python benchmarks/gpu/run.py --all --out OUT --scale 0.001 --device cpu
    python benchmarks/gpu/run.py --quick                               the same, kept nowhere

Each step prints what it found and writes it to OUT/state.json, its output to OUT/logs. A step that fails stops no other;
`--again` tries it once more. README.md beside this file says what each step does.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import torch

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(HERE))

import flagships as flagships_of  # noqa: E402
import pack  # noqa: E402

TABLE_52 = (
    *("impulse-standard", "impulse-two-receivers", "impulse-40khz", "impulse-60khz", "impulse-100khz", "impulse-160khz"),
    *("impulse-narrow", "impulse-circular-4800", "impulse-wideband-9600", "impulse-wideband-19200"),
    *("impulse-circular-19200", "impulse-high-objects", "impulse-ten-80khz", "impulse-ten-160khz", "impulse-ten-320khz"),
    *("scatterers-standard", "scatterers-wideband-19200"),
)
SMALL = 0.01
"""Scales below this one train small networks on coarse data, one row of each table: a check of the steps, no result."""

TOLERANCE_RMS = 0.01
"""Largest difference of two devices, as a part of the rms. They round differently, and a ray on an edge changes its cell."""

GRACE_S = 60.0
"""Seconds that a command has to write its state after a request to stop."""


Plain = dict[str, Any]
"""What a JSON file or a checkpoint holds: values by name."""

Saved = Any
"""A value of a checkpoint: a tensor, a dictionary, a list, or a plain value."""


class Request(NamedTuple):
    """Arguments of a step.

    Attributes:
        out: folder of everything.
        scale: part of the data of the tables, above 0 to 1.
        device: cuda or cpu.
        end: `time.monotonic()` at which the step should be over.
    """

    out: Path
    scale: float
    device: str
    end: float

    @property
    def variant(self) -> str:
        """Return the variant of Mitsuba."""
        return "cuda_ad_mono" if self.device == "cuda" else "llvm_ad_mono"

    @property
    def small(self) -> bool:
        """Return whether this is only a check of the steps."""
        return self.scale < SMALL


class Found(NamedTuple):
    """Result of a step; ``done`` is False if the next call continues it."""

    summary: Plain
    done: bool = True


class Failed(Exception):
    """A step failed, for the reason in the message."""


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", nargs="?", choices=list(STEPS), help="one step")
    parser.add_argument("--all", action="store_true", help="all steps that are open")
    parser.add_argument("--out", type=Path, default=Path("out/gpu"), help="state, logs, data, weights")
    parser.add_argument("--minutes", type=float, default=10, help="of this call")
    parser.add_argument("--scale", type=float, default=1.0, help="part of the data of the tables, above 0 to 1")
    parser.add_argument("--device", choices=["cuda", "cpu"], default="cuda")
    parser.add_argument("--again", action="store_true", help="steps that failed, too")
    parser.add_argument("--quick", action="store_true", help="--all --scale 0.001 --device cpu, kept nowhere")
    arguments = parser.parse_args()
    if not 0 < arguments.scale <= 1:
        parser.error(f"--scale must be above 0 and at most 1: got {arguments.scale:g}")
    if arguments.quick:
        return quick()
    if not arguments.all and arguments.step is None:
        parser.error(f"say which step, or --all: {', '.join(STEPS)}")
    names = list(STEPS) if arguments.all else [arguments.step]
    states = go(
        names,
        arguments.out,
        arguments.scale,
        arguments.device,
        arguments.minutes,
        again=arguments.again or not arguments.all,
    )
    raise SystemExit(1 if "failed" in states.values() else 0)


def quick() -> None:
    """All steps at a thousandth on the CPU.

    Raises:
        SystemExit: one failed, or is not done.
    """
    with tempfile.TemporaryDirectory() as folder:
        states = go(list(STEPS), Path(folder), 0.001, "cpu", 60)
    wrong = [name for name, state in states.items() if state not in ("done", "left out")]
    if wrong:
        raise SystemExit(f"not done: {', '.join(wrong)}")


# ---------------------------------------------------------------- state


def go(names: list[str], out: Path, scale: float, device: str, minutes: float, again: bool = False) -> dict[str, str]:
    """Do the steps that are open until the time is over.

    Returns:
        State of each: open, done, failed or left out.

    Raises:
        SystemExit: the folder was begun with other numbers.
    """
    out = out.resolve()
    state = opened(out, {"scale": scale, "device": device})
    end = time.monotonic() + 60 * minutes
    for name in names:
        had = state["steps"].setdefault(name, {"state": "open", "seconds": 0.0, "calls": 0})
        if had["state"] == "done" or (had["state"] == "failed" and not again) or time.monotonic() > end:
            continue
        begun = time.monotonic()
        print(f"== {name}", flush=True)
        had["calls"] += 1
        had.update(tried(name, Request(out, scale, device, end)))
        had["seconds"] += time.monotonic() - begun
        keep(out, state)
        print(f"{name}: {had['state']} after {had['seconds']:.0f} s in {had['calls']} calls", flush=True)
        print("\n".join(f"    {key}: {value}" for key, value in had["found"].items()), flush=True)
    states = {name: state["steps"][name]["state"] for name in names}
    print(", ".join(f"{sum(s == kind for s in states.values())} {kind}" for kind in ("done", "open", "failed", "left out")))
    return states


def tried(name: str, arguments: Request) -> Plain:
    """Do a step, and return its state also if it fails."""
    if arguments.small and name not in IN_SMALL:
        return {"state": "left out", "found": {"why": f"below a scale of {SMALL:g} one row of each table is tried"}}
    try:
        result = STEPS[name](arguments)
    except Exception as error:  # no step may stop the others
        return {"state": "failed", "found": {type(error).__name__: str(error)}}
    return {"state": "done" if result.done else "open", "found": result.summary}


def opened(out: Path, about: Plain) -> Plain:
    """Read the state of a folder, or begin a new one.

    Raises:
        SystemExit: it was begun with other numbers, or is damaged.
    """
    path = out / "state.json"
    if not path.exists():
        return {"about": about, "steps": {}}
    try:
        state: Plain = json.loads(path.read_text(encoding="utf-8"))
        had = state["about"]
    except (ValueError, KeyError, TypeError):
        raise SystemExit(f"{path} is damaged: remove it, and the steps find what they had done") from None
    if had != about:
        raise SystemExit(f"{out} was begun with {had}, not {about}: ask for the same, or choose another --out")
    return state


def keep(out: Path, state: Plain) -> None:
    """Write the state, whole or not at all."""
    out.mkdir(parents=True, exist_ok=True)
    part = out / ".state.json.part"
    part.write_text(json.dumps(state, indent=1, default=str), encoding="utf-8")
    part.replace(out / "state.json")


# ---------------------------------------------------------------- commands


def command(arguments: Request, name: str, words: list[str], *, goes_on: bool = False, **environment: str) -> bool:
    """Run Python with these words until the step's end; its output goes to OUT/logs/NAME.log.

    Returns:
        Whether it ended; False where it was stopped and ``goes_on`` when it is called again.

    Raises:
        Failed: it failed, or was stopped and cannot go on.
    """
    log = arguments.out / "logs" / f"{name}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    paths = [str(ROOT / "benchmarks"), *filter(None, [os.environ.get("PYTHONPATH")])]
    world = {**os.environ, "MITSONAR_VARIANT": arguments.variant, "PYTHONPATH": os.pathsep.join(paths), **environment}
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's background job, whose children would ignore it, too
        signal.signal(signal.SIGINT, signal.default_int_handler)
    with log.open("ab") as file:
        file.write(f"$ {' '.join(words)}\n".encode())
        file.flush()
        run = subprocess.Popen(
            [sys.executable, *words], cwd=arguments.out, env=world, stdout=file, stderr=file, start_new_session=True
        )
        ended = waited(run, arguments.end)
    if ended and run.returncode == 0:
        return True
    if not ended and goes_on:
        return False
    last = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()][-3:]
    why = f"exit status {run.returncode}" if ended else "not done in time"
    raise Failed(f"{why}: {' | '.join(last)} (see {log})")


def waited(run: subprocess.Popen[bytes], end: float) -> bool:
    """Wait for a command, and return whether it ended by itself. Otherwise stop it, and kill it if it does not stop."""
    try:
        run.wait(max(1.0, end - time.monotonic()))
        return True
    except subprocess.TimeoutExpired:
        run.send_signal(signal.SIGINT)
    try:
        run.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        os.killpg(run.pid, signal.SIGKILL)
        run.wait()
    return False


def mitsonar(*words: object) -> list[str]:
    """Return the words of a command of mitsonar."""
    return ["-m", "mitsonar", *map(str, words)]


# ---------------------------------------------------------------- steps


def look(arguments: Request) -> Found:
    """Describe the machine, and list the missing wheels."""
    expected = [one.partition("==")[0] for wheels in pack.listed().values() for one in wheels]
    output: Plain = {"python": platform.python_version(), "cores": os.cpu_count()}
    output["missing"] = ", ".join(name for name in expected if version_of(name) is None) or "nothing"
    output |= {name: version_of(name) for name in ("mitsonar", "mitsuba", "drjit", "torch", "lightning", "cufinufft")}
    for name, words in {
        "gpu": ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"],
        "torch on CUDA": [sys.executable, "-c", "import torch; print(torch.version.cuda, torch.cuda.is_available())"],
        "Dr.Jit has": [
            *(sys.executable, "-c"),
            "import drjit as dr; print([b.name for b in (dr.JitBackend.CUDA, dr.JitBackend.LLVM) if dr.has_backend(b)])",
        ],
        "cufinufft loads": [sys.executable, "-c", "import torch, cufinufft; print(cufinufft.__version__)"],
        "doctor": [sys.executable, *mitsonar("doctor")],
    }.items():
        output[name] = answer(words, arguments)
    return Found(output)


def version_of(name: str) -> str | None:
    """Version of an installed package."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def answer(words: list[str], arguments: Request) -> str:
    """Return what a command prints, or why it prints nothing."""
    world = {**os.environ, "MITSONAR_VARIANT": arguments.variant}
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=120, env=world)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"no answer ({type(error).__name__})"
    text = " / ".join(line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip())
    return text if done.returncode == 0 else f"exit status {done.returncode}: {text[-300:]}"


RENDERS = {
    "thesis": ("render", "flat_floor", "--model", "thesis", "--frames", 2),
    "physical": ("render", "pattern", "--model", "physical", "--frames", 2),
    "labels": ("render", "objects", "--labels", "--frames", 1),
    "scatterers": ("impulse", "hydrophones", "--velocity", "1,0.5", "--frames", 2),
    "rays": ("impulse", "hydrophones", "--velocity", "1,0.5", "--frames", 2, "--model", "rays", "--set", "rays=20000"),
}


def same(arguments: Request) -> Found:
    """Render scenes twice on the device, with equal bits, and once on the CPU, equal within `TOLERANCE_RMS`."""
    output, wrong = {}, []
    for name in ("thesis",) if arguments.small else RENDERS:
        first, second, cpu = (report(arguments, name, run) for run in ("first", "second", "cpu"))
        for key in sorted(first):
            if not np.array_equal(first[key], second[key], equal_nan=True):
                wrong.append(f"{name}.{key} twice on {arguments.device}: {differ(first[key], second[key]):.2g} rms")
            error = differ(first[key], cpu[key])
            equal = float(np.mean(first[key] == cpu[key])) if first[key].shape == cpu[key].shape else 0.0
            output[f"{name}.{key}"] = f"{error:.2g} rms from the CPU, {equal:.2%} of the values equal"
            if not error <= TOLERANCE_RMS:
                wrong.append(f"{name}.{key}: {error:.2g} rms from the CPU, more than {TOLERANCE_RMS:g}")
    if wrong:
        raise Failed(f"{'; '.join(wrong)}; found: {output}")
    return Found(output)


def report(arguments: Request, name: str, run: str) -> dict[str, np.ndarray]:
    """Render a small run, and return its arrays. That of the CPU is the reference."""
    out = arguments.out / "same" / f"{name}-{run}"
    variant = "llvm_ad_mono" if run == "cpu" else arguments.variant
    command(arguments, "same", mitsonar(*RENDERS[name], "--overwrite", "-o", out), MITSONAR_VARIANT=variant)
    kinds = {"image", "response", "elevation", "elevation_rad", "shadow"}
    with np.load(next(out.glob("*.npz"))) as table:
        result = {key: table[key] for key in table.files if key in kinds}
    if not result:
        raise Failed(f"{out} holds neither images nor responses")
    return result


def differ(one: np.ndarray, other: np.ndarray) -> float:
    """Return the rms difference as a part of the rms value."""
    if one.shape != other.shape:
        return float("inf")
    scale = float(np.sqrt(np.nanmean(np.abs(other.astype(np.complex128)) ** 2)))
    return float(np.sqrt(np.nanmean(np.abs(one.astype(np.complex128) - other) ** 2))) / (scale or 1.0)


def tests(arguments: Request) -> Found:
    """Run the tests that need CUDA, or on a CPU those of the variant."""
    if importlib.util.find_spec("pytest") is None:
        raise Failed("pytest is missing: pack it with `pack.py --all`")
    chosen = ["-m", "gpu", str(ROOT / "tests")] if arguments.device == "cuda" else ["-k", "variant", str(ROOT / "tests")]
    words = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", str(ROOT / "pyproject.toml"), *chosen]
    command(arguments, "tests", words if arguments.device == "cuda" else [*words[:-1], str(variant_tests())])
    return Found({"said": last_line(arguments, "tests")})


def variant_tests() -> Path:
    """Return the file of the tests of the variant."""
    return next((ROOT / "tests").rglob("test_variant.py"))


def last_line(arguments: Request, name: str) -> str:
    """Return the last line of a log."""
    text = (arguments.out / "logs" / f"{name}.log").read_text(encoding="utf-8", errors="replace")
    return next(line for line in reversed(text.splitlines()) if line.strip())


def render_speed(arguments: Request) -> Found:
    """Measure the speed of rendering frames. The table is in the log."""
    few = ["--quick"] if arguments.small else ["--without-open3d"]
    script = str(ROOT / "benchmarks" / "bench_render.py")
    command(arguments, "render_speed", [script, "--variant", arguments.variant, *few])
    return Found(rows_of(arguments, "render_speed"))


def coherent_speed(arguments: Request) -> Found:
    """Measure what a coherent ping costs. The table is in the log."""
    script = str(ROOT / "benchmarks" / "bench_coherent.py")
    command(arguments, "coherent_speed", [script, "--variant", arguments.variant, *(["--quick"] if arguments.small else [])])
    return Found(rows_of(arguments, "coherent_speed"))


def impulse_speed(arguments: Request) -> Found:
    """Measure the speed of impulse responses."""
    script = str(ROOT / "benchmarks" / "bench_impulse.py")
    command(arguments, "impulse_speed", [script, "--quick"] if arguments.small else [script, "speed"])
    return Found(rows_of(arguments, "impulse_speed"))


def rows_of(arguments: Request, name: str) -> dict[str, str]:
    """Return the lines of a log that hold a result."""
    text = (arguments.out / "logs" / f"{name}.log").read_text(encoding="utf-8", errors="replace")
    mine = text.rpartition("\n$ ")[2].splitlines()[1:]
    return {f"line {k}": line for k, line in enumerate(line for line in mine if line.strip() and line[0] not in "{-")}


def flagships(arguments: Request) -> Found:
    """Train PoseNet of tables 3.2 and 3.3 and ours with noise at once; flagships.py says how."""
    minutes = 5 if arguments.small else max(1.0, (arguments.end - time.monotonic()) / 60 - 0.5)
    words = [str(HERE / "flagships.py"), str(arguments.out / "flagships"), "--minutes", f"{minutes:.2f}"]
    words += ["--device", arguments.device, *(["--small"] if arguments.small else [])]
    if not command(arguments, "flagships", words, goes_on=True):
        return Found({"so far": last_line(arguments, "flagships")}, done=False)
    paths = sorted((arguments.out / "flagships").glob("*/rows/*.json"))
    return Found({path.stem: json.loads(path.read_text(encoding="utf-8")) for path in paths})


def row(name: str) -> Callable[[Request], Found]:
    """Return the step of a row of table 5.2, by `mitsonar reproduce`, which resumes where it was stopped."""

    def work(arguments: Request) -> Found:
        out = arguments.out / "table-5.2"
        words: list[object] = ["reproduce", "5.2", "--rows", name, "-o", out, *effort(arguments)]
        words += ["--accelerator", "gpu" if arguments.device == "cuda" else "cpu", "--devices", 1]
        words += ["--workers", 1 if arguments.device == "cuda" or arguments.small else os.cpu_count()]
        if not command(arguments, f"table-5.2-{name}", mitsonar(*words), goes_on=True):
            return Found({"so far": last_line(arguments, f"table-5.2-{name}")}, done=False)
        return Found(json.loads((out / "rows" / f"{name}.json").read_text(encoding="utf-8")))

    return work


def effort(arguments: Request) -> list[object]:
    """Return the effort of a row of table 5.2: all epochs, or at a small scale some seconds on coarse data."""
    bf16 = ["--set", "precision=bf16-mixed"] if arguments.device == "cuda" else []
    if not arguments.small:
        return ["--scale", arguments.scale, "--minutes", 0, *bf16]
    flat = "{family: flat-objects, size_m: 30, seabed_cells: 200, rectangles: 20, ellipses: 20}"
    data = f"scenes: [{{count: 2, sequences: {max(4, round(750 * arguments.scale))}}}], world: {flat}"
    changes = ["network.width=0.03", f"data_changes={{{data}}}"]
    return ["--scale", 1, "--minutes", 0.1, *(word for change in changes for word in ("--set", change))]


def weights(arguments: Request) -> Found:
    """Save all networks in OUT/weights, in bf16; `full` makes checkpoints of them again."""
    import torch

    output: Plain = {}
    (arguments.out / "weights").mkdir(exist_ok=True)
    for path in sorted(
        [*arguments.out.glob("**/runs/*/network.ckpt"), *arguments.out.glob(f"flagships/{flagships_of.OURS}/network.ckpt")]
    ):
        out = arguments.out / "weights" / f"{path.parent.name}.bf16"
        torch.save(halved(torch.load(path, map_location="cpu", weights_only=True)), out)
        output[path.parent.name] = f"{out.stat().st_size:,} bytes"
    return Found(output or {"networks": "none yet"}, done=bool(output))


def halved(value: Saved) -> Saved:
    """Convert all tensors of 32-bit numbers to bf16."""
    import torch

    return converted(value, torch.float32, torch.bfloat16)


def full(value: Saved) -> Saved:
    """Convert all tensors of bf16 to 32-bit numbers."""
    import torch

    return converted(value, torch.bfloat16, torch.float32)


def converted(value: Saved, old: torch.dtype, new: torch.dtype) -> Saved:
    """Convert all tensors of one type to another, and leave the rest as it is."""
    if isinstance(value, dict):
        return {key: converted(one, old, new) for key, one in value.items()}
    if isinstance(value, list):
        return [converted(one, old, new) for one in value]
    return value.to(new) if getattr(value, "dtype", None) == old else value


STEPS: dict[str, Callable[[Request], Found]] = {
    "look": look,
    "same": same,
    "tests": tests,
    "render_speed": render_speed,
    "coherent_speed": coherent_speed,
    "impulse_speed": impulse_speed,
    "flagships": flagships,
    **{name: row(name) for name in TABLE_52},
    "weights": weights,
}
"""In the order in which they are done."""

IN_SMALL = {*STEPS} - {"render_speed", "impulse_speed", "flagships", *TABLE_52[1:]}
"""Steps of a small scale; the scripts that are left out know `--quick`."""


if __name__ == "__main__":
    main()
