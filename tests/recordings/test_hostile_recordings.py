"""Recordings that are damaged or made to harm: every reader gives frames that can be, or one sentence, and never ends.

Another format is one more entry of :data:`RECORDINGS`.
"""

from __future__ import annotations

import struct
import tracemalloc
import warnings
import zlib
from collections.abc import Callable
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from bags import Maker, Sent, write_bag
from drawn_frames import over_ground, sway
from helpers import essence
from hostile_readers import Reader, attack, read_recording
from mutations import Rng, changed_bytes, changed_text, outcome
from recording_files import (
    aris_file,
    didson_file,
    gemini_file,
    head_sweeps,
    jsf_file,
    oculus_log,
    oculus_ping,
    ping360_message,
    ping360_text,
    ping_viewer_log,
    pingverter_folder,
    range_image,
    rip_packet,
    side_scan_echogram,
    some_pings,
)

from mitsonar import MitsonarError, open_recording
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.utm import UtmOrigin
from mitsonar.recordings.open import open_ranges
from mitsonar.recordings.write_mcap import write_mcap
from mitsonar.recordings.write_xtf import write_xtf

FIRST, USUAL, FEWER, MANY = 40, 100, 10, 10_000
"""Mutants of each format in the essence, in CI, in the essence of bags, which take longer, and in the slow test."""

MEMORY_FLOOR, MEMORY_FACTOR = 10 * 2**20, 40
"""What a reader may hold at a time: so many bytes, and so many times the size of the recording.

Of a bag that lost its definitions of messages, ``rosbags`` holds 8 MB of its own.
"""

TEXT = (".csv", ".txt", ".yaml", ".yml", ".json", ".tum")
"""Files that are spoilt by their words."""

NUMBERS = [
    *(struct.pack("<B", value) for value in (0, 1, 127, 128, 255)),
    *(struct.pack("<H", value) for value in (0, 1, 32767, 65535)),
    *(struct.pack("<I", value) for value in (0, 1, 2, 1000, 10**6, 2**31 - 1, 2**31, 2**32 - 1)),
    *(struct.pack("<Q", value) for value in (0, 2**33, 2**63 - 1, 2**64 - 1)),
    *(struct.pack("<f", value) for value in (np.nan, np.inf, -np.inf, -1.0, 1e30, 1e-30)),
    *(struct.pack("<d", value) for value in (np.nan, np.inf, -np.inf, -1.0, 0.0, 1e300, 1e-300)),
]
"""What may stand where a field of a header should."""

SMALL = Sonar(bearing="azimuth", beams=8, range_bins=12, range_min=3.6, range_max=5.4)

IMAGES = np.random.default_rng(2).integers(0, 256, (4, 6, 48))

RECORDINGS: dict[str, Callable[[Path], object]] = {
    "aris": lambda folder: (folder / "a.aris").write_bytes(aris_file(samples=8)),
    "oculus dump": lambda folder: (folder / "a.raw").write_bytes(b"".join(some_pings(4))),
    "oculus dump, version 2, 16 bits and gains": lambda folder: (folder / "a.raw").write_bytes(_gained()),
    "oculus log": lambda folder: (folder / "a.oculus").write_bytes(oculus_log(some_pings(3), [1, 2, 3], packed=False)),
    "oculus log, packed": lambda folder: (folder / "a.oculus").write_bytes(
        oculus_log(some_pings(3), [1, 2, 3], packed=True)
    ),
    "oculus log, version 2": lambda folder: (folder / "a.oculus").write_bytes(
        oculus_log(some_pings(4, version=2), [5.0, 5.26, 5.5, 5.75], packed=False)
    ),
    "didson 3": lambda folder: (folder / "a.ddf").write_bytes(didson_file(IMAGES)),
    "didson 4": lambda folder: (folder / "a.ddf").write_bytes(didson_file(IMAGES, version=4)),
    "ping360 log": lambda folder: (folder / "a.bin").write_bytes(
        ping_viewer_log([ping360_message(one, angle) for one, angle in _head()], [0.1 * one for one in range(22)])
    ),
    "ping360 text": lambda folder: (folder / "a.txt").write_text(
        "\n".join(f"timestamp: '00:00:0{one % 9}.000'\n{text}" for one, text in enumerate(_head_texts()))
    ),
    "ping360 cells": lambda folder: (folder / "a.csv").write_text(
        ",".join(f'"<bound method PingMessage.unpack_msg_data of {text}>"' for text in _head_texts())
    ),
    **(
        {"gemini": lambda folder: (folder / "a.glf").write_bytes(gemini_file(list(IMAGES)))}
        if find_spec("pytritech")
        else {}
    ),
    "ros 1 bag": lambda folder: _bag(folder / "a.bag"),
    "ros 2 bag, sqlite": lambda folder: _bag(folder / "a"),
    "ros 2 bag, mcap": lambda folder: _bag(folder / "a_mcap"),
    "xtf": lambda folder: write_xtf(folder / "a.xtf", side_scan_echogram(origin=UtmOrigin(19, False, 512724.0, 5365826.0))),
    "jsf": lambda folder: (folder / "a.jsf").write_bytes(jsf_file()),
    "pingverter": lambda folder: pingverter_folder(folder / "log", side_scan_echogram()),
    "ros 2 bag of raw images": lambda folder: _raw_bag(folder / "a"),
    "ros 2 bag of a ping360": lambda folder: _head_bag(folder / "a"),
    "ros 2 bag of ranges": lambda folder: _ranges_bag(folder / "a"),
    "sonar 3d-15": lambda folder: (folder / "a.sonar").write_bytes(
        b"".join(rip_packet(one, packed) for one, packed in zip(_range_images(), (True, False, True), strict=True))
    ),
    "mcap of a run": lambda folder: write_mcap([over_ground(sway(3), SMALL)], folder / "a.mcap"),
}
"""What writes a small recording of each format into an empty folder: one file, or one folder of files."""


def _head() -> list[tuple[bytes, int]]:
    """Pings of a head that goes to and fro."""
    angles = [*range(195, 206), *range(205, 194, -1)]
    return list(zip(head_sweeps(angles, 12), angles, strict=True))


def _head_texts() -> list[str]:
    return [ping360_text(one, angle) for one, angle in _head()]


def _bag(path: Path) -> None:
    """Three pings with odometry and the transform between them."""
    maker, images = Maker(path.suffix == ".bag"), IMAGES[:3].astype(np.uint8)
    bearing, distance, level = np.radians(np.linspace(-20, 20, 48)), np.linspace(1, 2, 6), [0, 0, 0, 1]
    sent: list[Sent] = [("/tf_static", 1.0, maker.transform(1.0, "base", "sonar", [0, 0, 0], level))]
    for number, image in enumerate(images):
        time = 1.0 + 0.1 * number
        sent.append(("/sonar", time, maker.ping(image, time, bearing, distance)))
        sent.append(("/odom", time, maker.odometry(time, [number, 0, 1], level, "base")))
    write_bag(path, maker, sent)


def _raw_bag(path: Path) -> None:
    maker, bearing = Maker(False), np.radians(np.linspace(-20, 20, 48))
    sent: list[Sent] = [
        ("/raw", 1.0 + number, maker.raw(image, 1.0 + number, bearing, beam_major=True))
        for number, image in enumerate(IMAGES[:3].astype(np.uint8))
    ]
    write_bag(path, maker, sent)


def _head_bag(path: Path) -> None:
    maker = Maker(False)
    sent: list[Sent] = [("/sonar", 1.0 + one, maker.echo(*ping, 1.0 + one)) for one, ping in enumerate(_head())]
    write_bag(path, maker, sent)


def _ranges_bag(path: Path) -> None:
    maker, angle = Maker(False), np.linspace(-1, 1, 9)
    directions = np.stack([0 * angle, np.sin(angle), np.cos(angle)], axis=-1)
    sent: list[Sent] = [("/mb", 1.0 + one, maker.ranges(3 + angle, directions, 1.0 + one)) for one in range(3)]
    write_bag(path, maker, sent)


def _range_images() -> list[bytes]:
    pixels = np.random.default_rng(4).integers(0, 20_000, (3, 4, 6))
    return [range_image(image, number) for number, image in enumerate(pixels)]


def _gained() -> bytes:
    rng = np.random.default_rng(1)
    pings = [
        oculus_ping(rng.integers(0, 65536, (9, 7)), version=2, width=2, gains=rng.integers(1, 999, 9), number=one, start=one)
        for one in range(3)
    ]
    return b"".join(pings)


def spoil(rng: Rng, folder: Path) -> None:
    """Change one or two files of the recording: numbers in headers, bytes, words, length, or name."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    for _ in range(1 if rng.random() < 0.8 else 2):
        path = paths[int(rng.integers(len(paths)))]
        if not path.is_file():
            continue
        content, chance = path.read_bytes(), rng.random()
        if chance < 0.02:
            path.write_bytes(b"")
        elif chance < 0.04:
            path.write_bytes(content[: int(rng.integers(len(content) + 1))])
        elif chance < 0.06:
            path.rename(path.with_suffix(str(rng.choice([".aris", ".ddf", ".raw", ".npz", ".png", ".json", ""]))))
        elif path.suffix in TEXT:
            path.write_bytes(changed_text(rng, content))
        elif chance < 0.6:
            path.write_bytes(changed_numbers(rng, content))
        else:
            path.write_bytes(changed_bytes(rng, content))


def changed_numbers(rng: Rng, content: bytes) -> bytes:
    """Up to four fields replaced by strange numbers, half of them near the begin, where headers are."""
    result = bytearray(content)
    for _ in range(int(rng.integers(1, 5))):
        place = int(rng.integers(min(len(result), 1600) if rng.random() < 0.5 else len(result))) if result else 0
        value = NUMBERS[int(rng.integers(len(NUMBERS)))]
        result[place : place + len(value)] = value
    return bytes(result)


def read(folder: Path) -> None:
    """Read all frames of the recording in a folder, and check that they can be. Warnings of NumPy are failures."""
    path = next(iter(sorted(folder.iterdir())))
    size = sum(one.stat().st_size for one in [path, *path.rglob("*")] if one.is_file())
    try:
        most = memory_of_reading(path)
        if most >= MEMORY_FLOOR + MEMORY_FACTOR * size:
            most = memory_of_reading(path)  # without what the first reading of its kind imports
    except MitsonarError as error:
        output = str(error)
        assert "\n" not in output, f"a refusal is not one line: {output[:300]}"
        assert len(output) < 700, f"a refusal is {len(output)} letters long: {output[:300]}"
        raise
    assert most < MEMORY_FLOOR + MEMORY_FACTOR * size, f"{most:,} bytes of memory for {size:,} of a recording"


def memory_of_reading(path: Path) -> int:
    """Read a recording, and return the most memory that it takes [bytes]."""
    tracemalloc.start()
    try:
        with np.errstate(over="warn", divide="warn", invalid="warn"), warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            read_recording(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


READERS = {name: Reader(lambda folder, write=write: write(folder), spoil, read) for name, write in RECORDINGS.items()}  # type: ignore[misc]


@pytest.fixture(autouse=True)
def _messages_are_compiled_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """rosbags compiles the messages of each bag anew, which takes half of the time of a mutant."""
    utils = pytest.importorskip("rosbags.serde.utils")
    compiled = lru_cache(maxsize=5000)(lambda text: utils.compile_lines(text.split("\n")))
    for module in ("cdr", "ros1"):
        monkeypatch.setattr(f"rosbags.serde.{module}.compile_lines", lambda lines: compiled("\n".join(lines)))


@pytest.mark.thorough
@pytest.mark.parametrize("first", essence([0, FIRST], 0))
@pytest.mark.parametrize("name", RECORDINGS)
def test_mutants_are_read_or_refused(name: str, first: int, tmp_path: Path) -> None:
    is_bag = "bag" in name or "mcap" in name
    count = (FEWER if is_bag else FIRST) if first == 0 else 2 * FEWER if is_bag else USUAL - FIRST
    result = attack(name, tmp_path, count, first, READERS)
    assert result["read"] + result["refused"] == count
    if first:
        assert result["refused"] > 0 or name.startswith("ping360")  # which leaves damaged pings out
        assert result["read"] > 0 or name == "mcap of a run"  # whose every byte has a checksum


@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDINGS)
def test_ten_thousand_mutants(name: str, tmp_path: Path) -> None:
    result = attack(name, tmp_path, MANY, first=USUAL, readers=READERS)
    print(f"\n{name}: {result['read']:,} read, {result['refused']:,} refused")
    assert min(result.values()) > 0


def test_nothing_but_zeros_behind_each_signature(tmp_path: Path) -> None:
    """Also of a length that is no multiple of anything."""
    for first in (b"DDF\x05", b"DDF\x04", b"DDF\x03", b"SO", b"\x44\x33\x22\x11"):
        for length in (16, 17, 511, 512, 1023, 1024, 2047, 2048, 5000):
            (tmp_path / "a").write_bytes(first.ljust(length, b"\0"))
            assert outcome(lambda: open_recording(tmp_path / "a")) == "refused"


def test_a_log_that_unpacks_to_more_than_it_says_is_refused(tmp_path: Path) -> None:
    """100 MiB of zeros behind a good header, packed a thousandfold: what the header does not say is never made."""
    ping = some_pings(1)[0]
    log = oculus_log([ping], [1.0], packed=True)
    head = log[: len(log) - len(zlib.compress(ping))]
    (tmp_path / "a.oculus").write_bytes(_longer(head, zlib.compress(ping + bytes(100 * 2**20), 9)))
    tracemalloc.start()
    frames = open_recording(tmp_path / "a.oculus").part().read([0])
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert frames.image.shape == (1, 12, 8)
    assert most < MEMORY_FLOOR


@pytest.mark.thorough
def test_a_log_that_says_that_it_unpacks_to_much_is_left_out(tmp_path: Path) -> None:
    ping = some_pings(1)[0]
    packed = zlib.compress(ping + bytes(200 * 2**20), 9)
    head = bytearray(oculus_log([ping], [1.0], packed=True)[: 48 + 40 + 4])
    head[48 + 28 : 48 + 32] = struct.pack("<I", len(ping) + 200 * 2**20)
    head[-4:] = struct.pack(">I", len(ping) + 200 * 2**20)
    (tmp_path / "a.oculus").write_bytes(_longer(bytes(head), packed))
    with pytest.raises(MitsonarError, match="holds no ping"):
        open_recording(tmp_path / "a.oculus")


def _longer(head: bytes, packed: bytes) -> bytes:
    """A log of one item with other packed bytes."""
    result = bytearray(head + packed)
    result[48 + 32 : 48 + 36] = struct.pack("<I", 4 + len(packed))
    return bytes(result)


@pytest.mark.thorough
def test_many_marks_of_messages_do_not_take_long(tmp_path: Path) -> None:
    """Two million marks, none of which begins a message, behind a good ping."""
    (tmp_path / "a.raw").write_bytes(some_pings(1)[0] + b"SO" * 2_000_000)
    assert outcome(lambda: len(open_recording(tmp_path / "a.raw"))) == "read"


def test_many_marks_in_a_log_of_a_ping360_do_not_take_long(tmp_path: Path) -> None:
    """200,000 marks, each of a message of 65,535 bytes whose sum is wrong, behind good pings."""
    pings = [ping360_message(samples, angle) for samples, angle in zip(head_sweeps([190, 191]), (190, 191), strict=True)]
    content = ping_viewer_log([*pings, b"BR\xff\xff" * 200_000], [0.0, 0.1, 0.2])
    (tmp_path / "a.bin").write_bytes(content)
    assert outcome(lambda: open_recording(tmp_path / "a.bin")) == "read"


@pytest.mark.thorough
@pytest.mark.parametrize("packed", [False, True])
def test_damaged_range_images_with_a_right_checksum(tmp_path: Path, packed: bool) -> None:
    """Of packed messages those bytes are changed, too, that Snappy reads."""
    rng, path = np.random.default_rng(8), tmp_path / "a.sonar"
    whole = [rip_packet(one, packed) for one in _range_images()]
    outcomes = []
    for _ in range(USUAL * 10):
        content = b"".join(_with_sum(changed_numbers(rng, one[8:-4]), one[:4]) for one in whole)
        path.write_bytes(content)
        outcomes.append(outcome(lambda: read_recording(path)))
    assert {"read", "refused"} <= set(outcomes)


def _with_sum(payload: bytes, identifier: bytes) -> bytes:
    head = identifier + struct.pack("<I", len(payload) + 12) + payload
    return head + struct.pack("<I", zlib.crc32(head))


def test_packets_that_unpack_to_more_than_they_say_are_left_out(tmp_path: Path) -> None:
    """Copies of one byte that make 64 MB, behind a small and behind a large stated size."""
    for stated in (b"\x10", b"\xff\xff\xff\x7f"):
        packed = stated + b"\x00a" + b"\xfe\x01\x00" * 20_000
        (tmp_path / "a.sonar").write_bytes(_with_sum(packed, b"RIP2"))
        tracemalloc.start()
        with pytest.raises(MitsonarError, match="holds no range image"):
            open_ranges(tmp_path / "a.sonar")
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert most < MEMORY_FLOOR


@pytest.mark.thorough
def test_packets_of_many_fields_are_left_out(tmp_path: Path) -> None:
    """Packets of 13 kB that unpack to 130,000 fields each, with a right checksum: parsing them all would take minutes."""
    packed = b"\x80\x80\x10" + b"\x04\x58\x00" + b"\xfe\x02\x00" * 4095 + b"\xf6\x02\x00"
    good = rip_packet(_range_images()[0])
    (tmp_path / "a.sonar").write_bytes(good + _with_sum(packed, b"RIP2") * 300)
    recording = open_ranges(tmp_path / "a.sonar")
    assert recording is not None
    assert "left out: 300 packets that cannot be decoded" in recording.notes


def test_many_marks_of_packets_do_not_take_long(tmp_path: Path) -> None:
    """200,000 marks, each of a packet of 65,507 bytes whose sum is wrong, behind a good packet."""
    good = rip_packet(_range_images()[0])
    (tmp_path / "a.sonar").write_bytes(good + (b"RIP2" + struct.pack("<I", 65_507)) * 200_000)
    assert outcome(lambda: open_ranges(tmp_path / "a.sonar")) == "read"
