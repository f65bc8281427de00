"""Scenes that would hang, take all memory, or show what is in other files, are refused at once."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.simulation.scene import load_scene
from mitsonar.worlds.scene_check import check_grid, check_tensors, check_text, pixels_of

SCENE = '<scene version="3.0.0">{}</scene>'
OPEN = '<scene version="3.0.0">'
SHAPE = '<shape type="{}"><string name="filename" value="{}"/></shape>'
STRING = '<string name="{}" value="{}"/>'
BITMAP = '<texture type="bitmap" name="reflectance"><string name="filename" value="{}"/></texture>'
TEXTURED = f'<shape type="rectangle"><bsdf type="diffuse">{BITMAP}</bsdf></shape>'
SPECTRUM = '<shape type="sphere"><bsdf type="diffuse"><spectrum name="reflectance" filename="{}"/></bsdf></shape>'
TWOSIDED = '<bsdf type="twosided" id="{}"><ref id="{}"/></bsdf>'
BLEND = '<bsdf type="blendbsdf" id="b{}"><float name="weight" value="0.5"/><ref id="b{}"/><ref id="b{}"/></bsdf>'
TURNED = '<shape type="sphere"><transform name="to_world">{}</transform></shape>'
PARAMETER = '<default name="p{}" value="1"/>'
DIFFUSE = '<bsdf type="diffuse" id="b0"/>'


def grown(times: int) -> str:
    """Parameters each of which holds ten of the one before."""
    lines = [f'<default name="p{k + 1}" value="{f"$p{k}" * 10}"/>' for k in range(times)]
    return SCENE.format(f'<default name="p0" value="xxxxxxxxxx"/>{"".join(lines)}<bsdf type="diffuse" id="$p{times}"/>')


TEXTS = {
    "comments": (OPEN + "<!--" * 200_000, "a <!-- is not terminated"),
    "instructions": (OPEN + "<?" * 300_000, r"a <\? is not terminated"),
    "tags": (OPEN + "<a " * 200_000, "malformed"),
    "values": (OPEN + '<a x="' * 150_000, "malformed"),
    "quotes": (OPEN + "<a x='\" " * 150_000, "malformed"),
    "attributes": (OPEN + "<a " + "x='' " * 200_000 + "y", "malformed"),
    "data": (OPEN + "<![CDATA[" * 100_000, "is not terminated"),
    "depth": (OPEN + "<shape>" * 200, "nests its elements more than 100 levels deep"),
    "parameters that grow": (grown(10), "longer than 65,536 characters"),
    "many parameters": (SCENE.format("".join(PARAMETER.format(k) for k in range(60_000))), "1,000 parameters"),
    "used too often": (
        SCENE.format("".join(PARAMETER.format(k) for k in range(900)) + '<bsdf type="diffuse" id="$p1"/>' * 20_000),
        "uses its parameters too often",
    ),
    "entities": ('<!DOCTYPE scene [<!ENTITY a "aa">]>' + SCENE.format(""), "malformed"),
    "two roots": (SCENE.format("") * 2, "second root"),
    "zero byte": (SCENE.format("\0"), "zero byte"),
}
"""Texts that took seconds to hours, or gigabytes, and what is said of them."""


@pytest.mark.thorough
@pytest.mark.parametrize("name", TEXTS)
def test_texts_are_checked_in_linear_time(name: str, tmp_path: Path) -> None:
    """Quadratic time would be hours; seconds on a quiet machine are a minute on a busy one."""
    text, words = TEXTS[name]
    (tmp_path / "bad.xml").write_text(text)
    before = os.times()
    with pytest.raises(MitsonarError, match=words) as caught:
        check_text(tmp_path / "bad.xml", {}, [tmp_path])
    after = os.times()
    assert len(str(caught.value)) < 1000
    assert after.user + after.system - before.user - before.system < 120


GOOD = {
    "plain": OPEN + "</scene>",
    "declared": '<?xml version="1.0" encoding="utf-8"?>\n<!DOCTYPE scene>\n' + SCENE.format(""),
    "dashes in a comment": SCENE.format("<!-- ---- seabed ---- -->"),
    "loose text": SCENE.format("a & b > c"),
    "signs in a value": SCENE.format('<bsdf type="diffuse" id="a < b & c > d"/>'),
    "either quote": SCENE.format("<bsdf type='diffuse' id='a \"b\"'/>"),
    "over several lines": '<scene\n\tversion = "3.0.0"\n>\n<bsdf\n type="diffuse"\n\n/>\n</scene >\n<!-- end -->',
    "a dollar": SCENE.format('<bsdf type="diffuse" id="5 \\$"/>'),
    "a mark": "\ufeff" + SCENE.format(""),
}
"""Texts that Mitsuba reads."""


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "latin-1"])
@pytest.mark.parametrize("name", GOOD)
def test_texts_that_mitsuba_reads_are_read(name: str, encoding: str, tmp_path: Path) -> None:
    text = GOOD[name] + ("<!-- Übung -->" if encoding != "latin-1" or name == "dashes in a comment" else "")
    (tmp_path / "good.xml").write_bytes(text.encode(encoding, "ignore"))
    load_scene(tmp_path / "good.xml")


def test_parameters_are_followed_as_mitsuba_follows_them(tmp_path: Path) -> None:
    """A file that is included under a name made of parameters and entities is found, and checked."""
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "part.xml").write_text(SCENE.format("<a"))
    for name in ("$p", "&#36;p", "bel&#0000111;w/$q.xml", "$r", "below/\tpart.xml".replace("\t", ""), "$pp$s"):
        defaults = {"p": "below/part.xml", "q": "part", "r": "$p", "pp": "below/", "s": "part.xml"}
        lines = "".join(f'<default name="{key}" value="{value}"/>' for key, value in defaults.items())
        (tmp_path / "top.xml").write_text(SCENE.format(f'{lines}<include filename="{name}"/>'))
        with pytest.raises(MitsonarError, match=r"part\.xml, line 1: .* malformed"):
            check_text(tmp_path / "top.xml", {}, [tmp_path])


def test_files_that_include_each_other_are_counted(tmp_path: Path) -> None:
    """Ten a file, fourteen files deep: 10^14 reads."""
    for depth in range(14):
        (tmp_path / f"{depth}.xml").write_text(SCENE.format(f'<include filename="{depth + 1}.xml"/>' * 10))
    (tmp_path / "14.xml").write_text(SCENE.format(""))
    with pytest.raises(MitsonarError, match="more than 1,000 files"):
        check_text(tmp_path / "0.xml", {}, [tmp_path])
    (tmp_path / "own.xml").write_text(SCENE.format('<include filename="own.xml"/>'))
    with pytest.raises(MitsonarError, match="does it include itself"):
        check_text(tmp_path / "own.xml", {}, [tmp_path])


def test_elements_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mitsonar.worlds.scene_check.MAX_ELEMENTS", 100)
    (tmp_path / "many.xml").write_text(SCENE.format(DIFFUSE * 99))
    check_text(tmp_path / "many.xml", {}, [tmp_path])
    (tmp_path / "many.xml").write_text(SCENE.format(DIFFUSE * 100))
    with pytest.raises(MitsonarError, match="more than 100 elements"):
        check_text(tmp_path / "many.xml", {}, [tmp_path])


# ---------------------------------------------------------------- files that a scene names


def png(wide: int, high: int) -> bytes:
    """A white picture of one bit a pixel: a thousandth of its pixels in bytes."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    packer, row = zlib.compressobj(9), bytes(1 + (wide + 7) // 8)
    rows = b"".join(packer.compress(row) for _ in range(high)) + packer.flush()
    head = struct.pack(">IIBBBBB", wide, high, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


FILES = {
    **{f"{kind} ZERO": SCENE.format(SHAPE.format(kind, "ZERO")) for kind in ("ply", "obj", "sdfgrid")},
    **{f"{kind} pipe": SCENE.format(SHAPE.format(kind, "pipe")) for kind in ("ply", "obj", "sdfgrid")},
    **{f"curve {name}": SCENE.format(SHAPE.format("bsplinecurve", name)) for name in ("ZERO", "pipe", "secret")},
    **{f"picture {name}": SCENE.format(TEXTURED.format(name)) for name in ("ZERO", "pipe", "secret", "large.png")},
    **{f"spectrum {name}": SCENE.format(SPECTRUM.format(name)) for name in ("ZERO", "pipe", "secret", "&#112;ipe")},
    **{f"include {name}": SCENE.format(f'<include filename="{name}"/>') for name in ("ZERO", "pipe", "secret")},
    "picture of no file": SCENE.format('<texture type="bitmap"/>'),
    **{f"empty {kind}": SCENE.format(f'<shape type="{kind}"/>') for kind in ("shapegroup", "merge")},
    "empty blend": SCENE.format('<bsdf type="blendbsdf"/>'),
    "empty volume": SCENE.format('<texture type="volume"/>'),
    "references": SCENE.format(DIFFUSE + "".join(BLEND.format(k + 1, k, k) for k in range(60))),
    "circle": SCENE.format(TWOSIDED.format("a", "b") + TWOSIDED.format("b", "a")),
    "chain": SCENE.format(DIFFUSE + "".join(TWOSIDED.format(f"b{k + 1}", f"b{k}") for k in range(3_000))),
    "long name": SCENE.format(SHAPE.format("ply", "x" * 5_000)),
    "long type": SCENE.format(f'<shape type="{"x" * 5_000}"/>'),
    "long element": SCENE.format(f"<{'x' * 5_000}/>"),
    "many properties": SCENE.format(
        f'<bsdf type="diffuse">{"".join(STRING.format(f"{k:030}", k) for k in range(500))}</bsdf>'
    ),
    "moved nowhere": SCENE.format(TURNED.format('<translate x="nan"/>')),
    "moved too far": SCENE.format(TURNED.format('<translate x="1e30"/>')),
    "no place": SCENE.format('<shape type="sphere"><point name="center" x="0" y="nan" z="0"/></shape>'),
}
"""Scenes with files that hang or are none, and with numbers and references that cannot be."""

LOAD = """
import json, resource, sys, time
from mitsonar import MitsonarError, load_scene
load_scene("flat_floor")
with open("/proc/self/statm") as file:
    now = int(file.read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (now + 2**30, now + 2**30))
for name in json.loads(sys.argv[1]):
    before = time.process_time()
    try:
        load_scene(f"{name}.xml")
        said = "read"
    except MitsonarError as error:
        said = str(error)
    print(json.dumps([name, time.process_time() - before, said]), flush=True)
"""


@pytest.mark.thorough
@pytest.mark.linux
def test_scenes_whose_files_are_none_are_refused_at_once(tmp_path: Path) -> None:
    """Each within a second and a GiB."""
    (tmp_path / "secret").write_text("password: 12345\n")
    (tmp_path / "large.png").write_bytes(png(30_000, 30_000))
    os.mkfifo(tmp_path / "pipe")
    for name, text in FILES.items():
        (tmp_path / f"{name}.xml").write_text(text.replace("ZERO", "/dev/zero"))
    command = [sys.executable, "-c", LOAD, json.dumps(list(FILES))]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line[0] for line in lines] == list(FILES)
    for name, seconds, output in lines:
        assert output != "read", name
        assert seconds < 5, (name, seconds)
        assert len(output) < 1000, output
        assert "12345" not in output, output


def test_pictures_are_measured_by_their_headers(tmp_path: Path) -> None:
    import mitsuba as mi
    from PIL import Image

    pixels = np.random.default_rng(0).random((33, 47, 3)).astype(np.float32)
    for ending in ("png", "jpg", "ppm", "exr", "pfm", "hdr", "bmp", "tga"):
        path = tmp_path / f"picture.{ending}"
        levels = (255 * pixels).astype(np.uint8)
        if ending in ("bmp", "tga"):  # which Mitsuba only reads
            Image.fromarray(levels).save(path)
        else:
            mi.Bitmap(levels if ending in ("png", "jpg", "ppm") else pixels).write(str(path))
        assert pixels_of(path) == 33 * 47
        path.write_bytes(path.read_bytes()[:4])
        with pytest.raises(MitsonarError, match="picture"):
            pixels_of(path)


def test_grids_and_tables_hold_what_they_promise(tmp_path: Path) -> None:
    path = tmp_path / "grid.vol"
    head = b"VOL\x03" + struct.pack("<5i6f", 1, 2, 3, 4, 1, 0, 0, 0, 1, 1, 1)
    path.write_bytes(head + bytes(4 * 24))
    check_grid(path)
    for wrong in (head, head + bytes(4 * 25), b"VOL\x02" + head[4:] + bytes(4 * 24), b""):
        path.write_bytes(wrong)
        with pytest.raises(MitsonarError, match=r"grid .* is damaged"):
            check_grid(path)
    field = struct.pack("<H", 1) + b"a" + struct.pack("<HBQ2Q", 2, 10, 64, 3, 4)
    table = (b"tensor_file\0" + bytes([1, 0]) + struct.pack("<I", 1) + field).ljust(64, b"\0")
    path.write_bytes(table + bytes(48))
    check_tensors(path)
    for wrong in (table, table[:30], b"", table.replace(struct.pack("<Q", 64), struct.pack("<Q", 2**60)) + bytes(48)):
        path.write_bytes(wrong)
        with pytest.raises(MitsonarError, match=r"table .* is damaged"):
            check_tensors(path)


@pytest.mark.thorough
def test_mutants_of_a_scene_render_or_are_refused(tmp_path: Path) -> None:
    """Elements, attributes and values of every kind of object changed, then a ping rendered: no other error, no hang."""
    mutants, most = 120, 30
    command = [sys.executable, str(Path(__file__).parent / "scene_mutants.py"), str(tmp_path), "-1", str(mutants)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=environment)
    lines = [json.loads(line) for line in done.stdout.splitlines() if "began" not in line]
    assert done.returncode == 0, done.stdout[-300:] + done.stderr[-2000:]
    assert len(lines) == mutants
    assert lines[0][1] == "read"
    assert not [line for line in lines if line[1] not in ("read", "refused") or line[2] > most]
    assert min(sum(line[1] == kind for line in lines) for kind in ("read", "refused")) > mutants / 4
