"""Small recordings as sonars write them, byte by byte: for tests of readers, and to be made hostile."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from mitsonar.instruments.sounder import load_sounder
from mitsonar.motion.utm import UtmOrigin
from mitsonar.recordings.jsf import MESSAGE, TRACE
from mitsonar.recordings.oculus import LATER, OLDER
from mitsonar.recordings.sound_metrics import FILE, FRAME, FRAME_HEADER
from mitsonar.records.soundings import Echogram

Values = np.ndarray[Any, Any]


def oculus_ping(
    counts: Values,
    *,
    version: int = 0,
    width: int = 1,
    gains: Values | None = None,
    bearings: Values | None = None,
    **fields: Any,
) -> bytes:
    """A message with an image: counts ``(ranges, beams)`` of ``width`` bytes, a gain of each row where they are given."""
    ranges, beams = counts.shape
    kind = LATER if version >= 2 else OLDER
    bearings = np.linspace(-3000, 3000, beams) if bearings is None else bearings
    rows = counts.astype("<u4")[:, :, None].view("u1")[:, :, :width].reshape(ranges, beams * width)
    if gains is not None:
        rows = np.hstack([gains.astype("<u4")[:, None].view("u1"), rows])
    angles, image = bearings.astype("<i2").tobytes(), rows.tobytes()
    head = np.zeros(1, kind)
    offset = kind.itemsize + len(angles) + 6  # a gap, as the sonar leaves one
    message = {
        "mode": 2, "gamma": 127, "flags": 0x09 | (0 if gains is None else 4), "gain_percent": 50.0, "number": 7,
        "frequency": 2.1e6, "sound_speed": 1490.0, "resolution": 0.003, "ranges": ranges, "beams": beams,
        "width": width - 1, "image": offset, "image_size": len(image), "size": offset + len(image),
    }  # fmt: skip
    for name, value in (message | fields).items():
        head[name] = value
    body = (head.tobytes()[16:] + angles).ljust(offset - 16, b"\0") + image
    return struct.pack("<HHHHHIH", 0x4F53, 1, 0, 0x23, version, len(body), 0) + body


def other_message(kind: int = 0x15, size: int = 20) -> bytes:
    """A message without an image."""
    return struct.pack("<HHHHHIH", 0x4F53, 1, 0, kind, 0, size, 0) + bytes(size)


def oculus_log(messages: list[bytes], times: list[float], *, packed: bool, header: int = 48, item: int = 40) -> bytes:
    """A log: its header, and an item with each message; with headers that are longer than needed where that is asked."""
    result = struct.pack("<II16sHH4xqd", 0x11223344, header, b"Oculus", 1, 0, 0, times[0]).ljust(header, b"\0")
    for message, time_s in zip(messages, times, strict=True):
        body = struct.pack(">I", len(message)) + zlib.compress(message) if packed else message
        head = struct.pack("<IIHH4xdH2xII", 0xAABBCCDD, item, 10, 0, time_s, int(packed), len(message), len(body))
        result += head.ljust(item, b"\0") + body
    return result


def some_pings(count: int = 3, version: int = 0, **fields: Any) -> list[bytes]:
    """Pings of 12 ranges and 8 beams, in rising numbers."""
    rng = np.random.default_rng(5)
    return [
        oculus_ping(rng.integers(0, 256, (12, 8)), version=version, number=40 + one, **({"start": one / 4} | fields))
        for one in range(count)
    ]


def aris_file(frames: int = 4, samples: int = 20, **changed: Any) -> bytes:
    """An ARIS 3000 with 64 beams; fields of the headers may be changed ``(frames,)``."""
    head = np.zeros(frames, FRAME)
    head["index"], head["signature"] = np.arange(frames), b"DDF\x05"
    head["time_us"] = 1_000_000 + 100_000 * np.arange(frames)
    head["ping_mode"], head["samples"], head["system"], head["reordered"] = 6, samples, 1, 1
    head["sample_period_us"], head["start_delay_us"], head["sound_speed"] = 10, 2000, 1500.0
    for name, values in changed.items():
        head[name] = values
    body = np.random.default_rng(3).integers(0, 256, (frames, samples * 64), dtype=np.uint8)
    pairs = zip(head, body, strict=True)
    return b"DDF\x05".ljust(1024, b"\0") + b"".join(one.tobytes() + pixels.tobytes() for one, pixels in pairs)


def didson_file(
    images: Values, *, version: int = 3, header: int | None = None, file: dict[str, Any] | None = None, **changed: Any
) -> bytes:
    """A DIDSON file: images ``(frames, samples, beams)``; fields of the file's header, and of the frames' ``(frames,)``."""
    frames, samples, beams = images.shape
    mark = b"DDF" + bytes([version])
    first = np.zeros(1, FILE)
    message = {
        "signature": mark, "frames": frames, "frame_rate_hz": 8, "high_frequency": int(beams == 96), "beams": beams,
        "sample_rate_hz": samples * 1500 / (2 * 10.0), "samples": samples, "length_code": 3 if beams == 96 else 1,
        "serial": 200,
    }  # fmt: skip
    for name, value in (message | (file or {})).items():
        first[name] = value
    head = np.zeros(frames, FRAME_HEADER[version])
    message = {
        "index": np.arange(frames), "signature": mark, "year": 2010, "month": 6, "day": 3, "hour": 23, "minute": 59,
        "second": 58 + np.arange(frames) // 8, "hundredth": np.arange(frames) % 8 * 12, "start_code": 4,
        "length_code": first["length_code"][0],
    }  # fmt: skip
    for name, value in (message | changed).items():
        head[name] = value
    size = header or {3: 512, 4: 1024}[version]
    pairs = zip(head, images.astype(np.uint8), strict=True)
    return first.tobytes().ljust(size, b"\0")[:size] + b"".join(one.tobytes() + image.tobytes() for one, image in pairs)


# ---------------------------------------------------------------- side-scans


def side_scan_echogram(
    pings: int = 6,
    bins: int = 40,
    height: float = 4.0,
    origin: UtmOrigin | None = None,
    heading: float = 0.4,
) -> Echogram:
    """A line at constant speed, with dark water above a bright bottom whose levels differ by side and fall with range."""
    sounder = load_sounder("sidescan").replace(range_min=0.0, range_max=20.0, range_bins=bins, name="towfish")
    time_s = np.asarray(1.7e9 + np.arange(pings) * 0.25, dtype=np.float64)
    poses = np.zeros((pings, 6))
    poses[:, :2] = 0.3 + 0.5 * np.arange(pings)[:, None] * [np.sin(heading), np.cos(heading)]
    poses[:, 2:] = [-3.0, 0.02, -0.01, heading]
    range_m = sounder.fan.range_m
    bottom = np.where(range_m >= height, 1 / (1 + range_m), 1e-4)
    levels = np.stack([bottom, 0.5 * bottom])[None] * np.linspace(0.8, 1, pings)[:, None, None]
    return Echogram(time_s, poses, sounder, levels.astype(np.float32), np.full(pings, height), origin)


def jsf_message(body: bytes, kind: int = 80, subsystem: int = 20, channel: int = 0) -> bytes:
    """A message of a JSF file."""
    return MESSAGE.pack(b"\x01\x16", 13, 0, kind, 2, subsystem, channel, 0, 0, len(body)) + body


def jsf_trace(counts: Values, *, channel: int, subsystem: int = 20, **fields: Any) -> bytes:
    """A message with one ping of one side: envelopes, or complex samples if counts are ``(samples, 2)``."""
    head = np.zeros((), TRACE)
    given = {
        "time_s": 1_700_000_000, "ping": 1, "valid": 0x7FFF, "format": counts.ndim - 1, "units": 2, "samples": len(counts),
        "interval_ns": 40_000, "start_dahz": 11_000, "end_dahz": 13_000, "sound_speed": 1480.0,
    }  # fmt: skip
    for name, value in (given | fields).items():
        head[name] = value
    return jsf_message(head.tobytes() + counts.astype("<i2").tobytes(), 80, subsystem, channel)


def jsf_file(pings: int = 5, samples: int = 30, **fields: Any) -> bytes:
    """Pings of both sides at 0.25 s, north along a meridian, with another message between them."""
    counts = 100 + np.arange(samples)
    parts = [jsf_message(b"serial text", kind=2002)]
    for ping in range(pings):
        common = {
            "ping": ping + 1, "time_s": 1_700_000_000 + ping // 4, "time_ms": 250 * (ping % 4) + 7000,
            "x": 9_000_000, "y": 25_200_000 + 6 * ping, "heading": 35_900, "pitch": 182, "roll": -364, "depth_mm": 2500,
            "altitude_mm": 6000, "weighting": 3,
        }  # fmt: skip
        parts += [jsf_trace(counts * (1 + side), channel=side, **(common | fields)) for side in (0, 1)]
    return b"".join(parts)


def pingverter_folder(folder: Path, echogram: Echogram, *, reversed_port: bool = False) -> None:
    """The files that PINGVerter 2.1 writes from a log of 8 bits, by their published code."""
    folder.mkdir(parents=True)
    amplitude = np.sqrt(echogram.levels / echogram.levels.max())
    counts = np.rint(255 * amplitude).astype("<u2") * 257
    if reversed_port:
        counts[:, 0] = counts[:, 0, ::-1].copy()
    origin = echogram.origin or UtmOrigin(16, False, 5e5, 4e6)
    degrees = origin.to_degrees(echogram.poses[:, :2])
    heading = np.degrees(echogram.poses[:, 5] + origin.convergence_rad(degrees))
    fan, size = echogram.sounder.fan, counts[0, 0].nbytes
    frames = []
    for ping in range(len(echogram)):
        sides = [
            {
                "channelId": channel, "sampleOffset": (2 * ping + side) * size, "sampleCount": fan.range_bins,
                "byteLength": size, "minRangeMeters": 0, "maxRangeMeters": fan.range_max,
                "bottomDepthMeters": float(echogram.height_m[ping]),
            }
            for side, channel in enumerate((2, 3))
        ]  # fmt: skip
        frames.append(
            {
                "frameIndex": ping, "sequenceCount": ping, "timeSeconds": float(echogram.time_s[ping]),
                "lat": degrees[ping, 0], "lon": degrees[ping, 1], "headingDegrees": heading[ping], "channels": sides,
            }
        )  # fmt: skip
    listed = [
        {"channelId": channel, "orientation": side, "startFrequencyHz": 455, "endFrequencyHz": 455}
        for channel, side in ((2, "Port"), (3, "Starboard"))
    ]
    samples = {"path": "samples.u16le", "encoding": "uint16-le"}
    manifest = {"formatVersion": 2, "frames": "frames.jsonl", "samples": samples, "channels": listed}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    (folder / "frames.jsonl").write_text("".join(json.dumps(frame) + "\n" for frame in frames))
    (folder / "samples.u16le").write_bytes(counts.tobytes())


def ping360_message(samples: bytes, angle: int, number: int = 2300, **fields: int) -> bytes:
    """A message of a Ping360 with samples, of the number 2300 or 2301, as ping-protocol defines it."""
    values = {"gain_setting": 1, "transmit_duration": 30, "sample_period": 200, "transmit_frequency": 750} | fields
    count = values.pop("number_of_samples", len(samples))
    head = struct.pack("<BBHHHH", 1, values["gain_setting"], angle, *list(values.values())[1:])
    if number == 2301:
        head += struct.pack("<HHBB", 0, 399, 1, 0)
    return ping_message(number, head + struct.pack("<HH", count, len(samples)) + samples)


def ping_message(number: int, payload: bytes) -> bytes:
    """A message of the Ping protocol: header, payload and checksum."""
    body = b"BR" + struct.pack("<HHBB", len(payload), number, 2, 0) + payload
    return body + struct.pack("<H", sum(body) % 65536)


def ping_viewer_log(messages: list[bytes], times: list[float], *, encoding: str = "utf-16-be") -> bytes:
    """A log of Ping Viewer: its header, then a time and a message of each record."""

    def text(value: str) -> bytes:
        content = value.encode(encoding)
        return struct.pack(">I", len(content)) + content

    head = text("PingViewer sensor log file") + struct.pack(">i", 1)
    head += b"".join(map(text, ("b0461486", "2020-01-03T14:31:14-03:00", "", "Arch Linux", "unknown")))
    result = head + struct.pack(">ii", 1, 2)
    for message, time_s in zip(messages, times, strict=True):
        milliseconds = round(time_s * 1000)
        minutes, rest = divmod(milliseconds, 60_000)
        stamp = f"{minutes // 60 % 24:02}:{minutes % 60:02}:{rest // 1000:02}.{rest % 1000:03}"
        result += text(stamp) + struct.pack(">I", len(message)) + message
    return result


def ping360_text(samples: bytes, angle: int, **fields: int) -> str:
    """A message of a Ping360 as ``brping`` prints it."""
    values = {"mode": 1, "gain_setting": 1, "angle": angle, "transmit_duration": 30, "sample_period": 200}
    values |= {"transmit_frequency": 750, "number_of_samples": len(samples), "data_length": len(samples)} | fields
    lines = "".join(f"  - {name}: {value}\n" for name, value in values.items())
    return (
        f"\n{'-' * 50}\nID: 2300 - device_data\nHeader: start_1: 66 start_2: 82 payload_length: {14 + len(samples)} "
        f"message_id: 2300 src_device_id: 2 dst_device_id: 0\nPayload:\n{lines}  - data: {[hex(one) for one in samples]}\n"
        "Checksum: 1 check: 1 pass: True"
    )


def gemini_file(images: list[Values], **changed: Any) -> bytes:
    """A GLF file: images ``(ranges, beams)``, and fields of all records, by the layout that ``pytritech`` reads."""
    beams = images[0].shape[1]
    fields: dict[str, Any] = {
        "start": 10, "bearings": np.radians(np.linspace(-60, 60, beams)), "compression": 0, "frequency": 30_000,
        "speed": 1480.0, "model": 1, "flags": 0, "by_beam": False, "version": 3, "stored": True, "rate_hz": 10.0,
        "first_s": 1.4e9,  # since 1980
    } | changed  # fmt: skip
    content = b""
    for number, image in enumerate(images):
        time_s = fields["first_s"] + number / fields["rate_hz"]
        flat = np.ascontiguousarray(image.T if fields["by_beam"] else image, dtype=np.uint8).tobytes()
        data = zlib.compress(flat) if fields["compression"] == 0 else flat
        body = struct.pack("<HH", 1, 0xEFEF)
        start = fields["start"]
        body += struct.pack("<HIIHII", fields["version"], start, start + len(image), 0, 0, beams)
        body += struct.pack("<H", fields["compression"]) if fields["version"] == 3 else b""
        body += struct.pack("<I", len(data)) + data + np.asarray(fields["bearings"], "<f8").tobytes()
        body += struct.pack(
            "<IIfdHfh?BB",
            0,
            fields["frequency"],
            1.0,
            time_s,
            fields["flags"],
            fields["speed"],
            50,
            True,
            2,
            fields["model"],
        )
        body += b"\0" + struct.pack("<H", 0xDEDE)
        content += struct.pack("<cBIdBHHH", b"*", 1, 21 + len(body), time_s, 0, 1194, 0, 0) + body
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED if fields["stored"] else zipfile.ZIP_DEFLATED) as file:
        file.writestr("data_1.cfg", "<log><0>a</0></log>")
        file.writestr("data_1.dat", content + b"\xde\xde")
    return archive.getvalue()


def head_sweeps(angles: list[int], bins: int = 20) -> list[bytes]:
    """Samples of pings, each sample a function of angle and number of the ping, so that none can be mistaken."""
    return [bytes((7 * angle + 3 * number + one) % 251 for one in range(bins)) for number, angle in enumerate(angles)]


# ---------------------------------------------------------------- Sonar 3D-15


def _varint(value: int) -> bytes:
    return bytes([value & 127 | 128]) + _varint(value >> 7) if value > 127 else bytes([value])


def message(**fields: Any) -> bytes:
    """A message of Protocol Buffers: fields named ``f1``, ``f2`` ... of whole numbers, floats or bytes."""
    result = b""
    for name, value in fields.items():
        number = int(name[1:]) << 3
        if isinstance(value, int):
            result += _varint(number) + _varint(value)
        elif isinstance(value, float):
            result += _varint(number | 5) + struct.pack("<f", value)
        else:
            result += _varint(number | 2) + _varint(len(value)) + value
    return result


def rip_packet(payload: bytes, packed: bool = True) -> bytes:
    """A packet of the range image protocol; Snappy packs it as one literal."""
    if packed:
        length = len(payload) - 1
        payload = _varint(len(payload)) + bytes([61 << 2]) + length.to_bytes(2, "little") + payload
    head = (b"RIP2" if packed else b"RIP1") + struct.pack("<I", len(payload) + 12) + payload
    return head + struct.pack("<I", zlib.crc32(head))


def rip_payload(kind: str, **fields: Any) -> bytes:
    """The payload of a packet."""
    url = f"type.googleapis.com/waterlinked.sonar.protocol.{kind}".encode()
    return message(f1=message(f1=url, f2=message(**fields)))


def range_image(pixels: Values, number: int = 0, **changed: Any) -> bytes:
    """The payload of a range image ``(rows, columns)`` in mm, of 90 x 40 degrees, at 1.7e9 + 0.2 N seconds."""
    time = message(f1=1_700_000_000 + number // 5, f2=200_000_000 * (number % 5))
    fields = {
        "f1": message(f1=time, f2=number),
        "f2": 1480.0,
        "f3": 15.0,
        "f4": 1_200_000,
        "f5": pixels.shape[1],
        "f6": pixels.shape[0],
        "f7": 90.0,
        "f8": 40.0,
        "f9": 0.001,
        "f10": b"".join(_varint(int(one)) for one in pixels.ravel()),
    }
    return rip_payload("RangeImage", **fields | changed)
