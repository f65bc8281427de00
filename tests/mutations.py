"""Files made hostile: bytes, values, arrays and texts changed at random by a seed, and what a reader makes of them."""

from __future__ import annotations

import copy
import io
import json
import signal
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from xml.etree import ElementTree

import numpy as np

from mitsonar.errors import MitsonarError

Rng = np.random.Generator

LONGEST_S = 20
"""Of a reader; beyond it hangs."""

MOST_MEMORY = 2**31
"""Bytes that a reader may ask for; beyond it fails."""

STRANGE: list[Any] = [
    *(None, True, False, 0, 1, -1, 2, 3.5, -0.0, 1e300, -1e300, float("nan"), float("inf"), 10**12, 10**18, 2**63, -(2**63)),
    *(10**400, "", "a", "1", "nan", "\0", "ü" * 40, [], [0], [[]], [1, 2, 3], ["a"], {}, {"a": 1}, {"": None}),
]
"""What may stand where something else should."""

TEXTS = ["\0", ":", "- ", "{", "[", "]", "&a", "*a", "<<: *a", "!!int ''", "!!python/object:os.system ", "9" * 5000]
TEXTS += [
    "nan",
    "-",
    "1e999",
    "\n",
    "  ",
    "0x" + "f" * 99,
    "1:1:1",
    "2001-99-99",
    "'",
    '"',
    "%",
    "@",
    "~",
    "-1",
    "10000000000",
]


def changed_bytes(rng: Rng, content: bytes) -> bytes:
    """Some bytes of a file changed, removed, doubled or cut off."""
    result = bytearray(content)
    for _ in range(1 if rng.random() < 0.7 else 3):
        place = int(rng.integers(len(result) + 1))
        length = int(rng.integers(1, 9))
        match int(rng.choice([0, 0, 0, 1, 2, 2, 3, 4, 5])):
            case 0:
                result[place : place + 1] = bytes([int(rng.integers(256))])
            case 1:
                result[place : place + length] = bytes(rng.integers(0, 256, length, dtype=np.uint8))
            case 2:
                result[place : place + 4] = int(rng.choice([0, 1, 10**8, 2 * 10**9, 2**31 - 1, 2**32 - 1])).to_bytes(
                    4, "little"
                )
            case 3:
                del result[place : place + length]
            case 4:
                result[place:place] = result[place : place + length]
            case _:
                del result[place:]
    return bytes(result)


def changed_text(rng: Rng, content: bytes) -> bytes:
    """Some words of a text replaced by strange ones, or its bytes changed."""
    if rng.random() < 0.3:
        return changed_bytes(rng, content)
    words = content.decode("utf-8", "replace").split(" ")
    for _ in range(1 if rng.random() < 0.7 else 3):
        place, strange = int(rng.integers(len(words))), TEXTS[int(rng.integers(len(TEXTS)))]
        words[place] = strange if rng.random() < 0.6 else words[place] + strange
    return " ".join(words).encode()


PLUGINS = {
    "shape": "sphere rectangle disk cube cylinder ply obj shapegroup instance sdfgrid linearcurve",
    "bsdf": "diffuse twosided mask conductor roughplastic principled blendbsdf null acoustic_material",
    "texture": "bitmap checkerboard cell_noise perlin_noise mesh_attribute trajectory uniform volume",
    "sensor": "imaging_sonar channel_sonar perspective orthographic distant",
    "emitter": "constant point area envmap spot sunsky",
    "integrator": "path echo direct volpath aov",
}
"""Plugins that may stand in each other's place, by the element that names them."""

NUMBERS = [*("0", "-1", "1", "0.5", "2", "7", "90", "1e-30", "1e-6", "1e6", "1e11", "-1e11"), "nan", "inf", "3.4e38"]
NUMBERS += ["2147483648", "-9223372036854775808"]
WORDS = ["", "true", "$size", "$nothing", "none", "mud", "seabed.ply", "grain.png", ".", "/dev/null", "seabed", "x" * 300]
"""What may stand as a value in a scene."""


def changed_scene(rng: Rng, content: bytes) -> bytes:
    """A scene's XML that is well formed and has one to three other plugins, properties, values or places."""
    root = ElementTree.fromstring(content)
    for _ in range(1 if rng.random() < 0.6 else 3):
        parents = [element for element in root.iter() if len(element)]
        parent = parents[int(rng.integers(len(parents)))]
        one = parent[int(rng.integers(len(parent)))]
        others = list(root.iter())
        second = others[int(rng.integers(len(others)))]
        match int(rng.choice([0, 0, 1, 1, 1, 1, 2, 3, 4, 5, 6])):
            case 0 if one.tag in PLUGINS:
                one.set("type", str(rng.choice(PLUGINS[one.tag].split())))
                if rng.random() < 0.7:  # what the other plugin does not know
                    one[:] = [inner for inner in one if inner.tag in ("transform", "bsdf", "ref")]
            case 0 | 1 if keys := [name for name in one.attrib if name not in ("name", "type", "id")]:
                key = str(rng.choice(keys))
                numeric = one.get(key, "")[:1] in "-0123456789$" and rng.random() < 0.9
                values = NUMBERS if numeric else WORDS
                one.set(key, values[int(rng.integers(len(values)))])
            case 2:
                result = copy.deepcopy(one)
                for inner in result.iter():
                    inner.attrib.pop("id", None) if inner.tag != "ref" else None
                parent.append(result)
            case 3:
                parent.remove(one)
            case 4:
                second.append(copy.deepcopy(one))
            case 5 if one.get("name") and second.get("name"):
                one.set("name", str(second.get("name")))
            case _ if one.get("value") and second.get("value"):
                one.set("value", str(second.get("value")))
            case _:
                pass
    return ElementTree.tostring(root)


def changed_value(rng: Rng, value: Any) -> Any:
    """A value as JSON holds it, with one or two of its parts replaced, removed or added."""
    result = copy.deepcopy(value)
    for _ in range(int(rng.integers(1, 3))):
        path = _some_path(rng, result)
        if not path:
            return _strange(rng)
        inner = result
        for key in path[:-1]:
            inner = inner[key]
        choice = rng.random()
        if choice < 0.15:
            del inner[path[-1]]
        elif choice < 0.25 and isinstance(inner, dict):
            inner["more"] = _strange(rng)
        else:
            inner[path[-1]] = _strange(rng)
    return result


def _strange(rng: Rng) -> Any:
    if rng.random() < 0.02:
        deep: Any = []
        for _ in range(120):
            deep = [deep]
        return deep
    return copy.deepcopy(STRANGE[int(rng.integers(len(STRANGE)))])


def _some_path(rng: Rng, value: Any) -> list[Any]:
    """Keys that lead to a part of a value."""
    path: list[Any] = []
    while isinstance(value, dict | list) and len(value) and (not path or rng.random() < 0.8):
        keys = list(value) if isinstance(value, dict) else list(range(len(value)))
        path.append(keys[int(rng.integers(len(keys)))])
        value = value[path[-1]]
    return path


def changed_json(rng: Rng, content: bytes) -> bytes:
    """A JSON file with parts of its value, or its bytes, changed."""
    if rng.random() < 0.2:
        return changed_bytes(rng, content)
    value = json.loads(content)
    if "attributes" in value and rng.random() < 0.7:
        value["attributes"] = changed_value(rng, value["attributes"])
        return json.dumps(value).encode()
    return json.dumps(changed_value(rng, value)).encode()


def changed_arrays(rng: Rng, table: dict[str, Any]) -> dict[str, Any]:
    """Arrays with other types, shapes and values; texts of JSON with other values."""
    result = dict(table)
    for _ in range(int(rng.integers(1, 3))):
        if not result:
            break
        name = str(rng.choice(sorted(result)))
        result[name] = _changed_array(rng, np.asarray(result[name]))
        if rng.random() < 0.1:
            del result[name]
    return result


def _changed_array(rng: Rng, values: np.ndarray) -> np.ndarray:
    if values.dtype.kind == "U" and values.ndim == 0 and rng.random() < 0.7:
        content = str(values).encode()
        if content[:1] == b"{":
            return np.array(_changed_table(rng, content).decode("utf-8", "replace"))
        return np.array(str(_strange(rng)))
    result = np.array(values)
    match int(rng.integers(8)):
        case 0:
            return np.array(rng.choice(np.array([0.0, -1.0, np.nan, np.inf, 1e300])))
        case 1:
            return np.array("text")
        case 2:
            with np.errstate(all="ignore"):
                kind = str(rng.choice(["f2", "f4", "f8", "i8", "u1", "c8", "?", "U3"]))
                return result.astype(kind) if result.dtype.kind not in "Uc" else np.zeros(result.shape, kind)
        case 3:
            return result[..., None]
        case 4:
            return result[1:] if result.ndim else result.reshape(1)
        case 5:
            return result.reshape(-1) if result.ndim else np.array([])
        case 6:
            return result[::-1] if result.ndim else result
        case _:
            if result.dtype.kind in "fc" and result.size:
                result.reshape(-1)[int(rng.integers(result.size))] = rng.choice(
                    np.array([np.nan, np.inf, -1e30, 1e300, -1.0])
                )
            return result


def _changed_table(rng: Rng, content: bytes) -> bytes:
    """A text of JSON changed; one that an earlier change has made something else changes by its bytes."""
    try:
        return changed_json(rng, content)
    except ValueError:
        return changed_bytes(rng, content)


def npz(table: dict[str, Any]) -> bytes:
    """The bytes of an npz file."""
    buffer = io.BytesIO()
    with np.errstate(all="ignore"):
        np.savez_compressed(buffer, **table)
    return buffer.getvalue()


def with_part(content: bytes, name: str, part: bytes) -> bytes:
    """A zip file with one part replaced."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.namelist():
            new.writestr(entry, part if entry == name else old.read(entry))
    return buffer.getvalue()


# ---------------------------------------------------------------- what becomes of them


@contextmanager
def limits() -> Iterator[None]:
    """A reader that hangs, or asks for more memory than :data:`MOST_MEMORY`, fails: on Linux, which can limit both."""
    if sys.platform != "linux":
        yield
        return
    import resource

    def hangs(*_: Any) -> None:
        raise AssertionError(f"a reader takes more than {LONGEST_S} s")

    with open("/proc/self/statm", encoding="ascii") as file:
        current = int(file.read().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    before = signal.signal(signal.SIGALRM, hangs)
    signal.alarm(LONGEST_S)
    resource.setrlimit(resource.RLIMIT_AS, (current + MOST_MEMORY, hard))
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def outcome(read: Callable[[], Any]) -> str:
    """``read`` or ``refused``; whatever else a reader raises is the test's failure."""
    with limits(), np.errstate(all="ignore"):
        try:
            read()
        except MitsonarError as error:
            output = str(error)
            assert output.strip(), "a refusal says nothing"
            assert "Traceback" not in output
            assert len(output) < 2000, f"a refusal is {len(output)} letters long: {output[:200]}"
            return "refused"
    return "read"
