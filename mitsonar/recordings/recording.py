"""What does every reader return? A recording of one sonar, in parts of constant geometry, with pixels read on demand."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, argument, count_noun
from mitsonar.instruments.beams import Pattern
from mitsonar.instruments.sonar import Sonar, group_of_beams, ping_interval_s, scans
from mitsonar.records.frames import SonarFrames

__all__ = [
    "CHUNK_BYTES",
    "ELEVATION_PATTERN",
    "Bytes",
    "EqualFrames",
    "Facts",
    "Header",
    "Part",
    "Pixels",
    "Recording",
    "in_time_order",
    "layout",
    "mapped",
    "runs_of",
]


Array = NDArray[np.float64]
Index = NDArray[np.intp]

Pixels = NDArray[np.generic]
"""Images ``(n, bins, beams)``: uint8 in 0..255, or float32 in 0..1."""

Facts: TypeAlias = dict[str, Any]
"""Header values of a file, keyed by name: numbers, strings and lists of them."""

CHUNK_BYTES = 8 * 2**20
"""Approximate amount of pixel data that is read at a time [bytes]."""

ELEVATION_PATTERN: Pattern = "two_way"
"""Pattern over elevation of a real sonar, whose files do not state it.

An elevation aperture is a half-power width: ground beyond it echoes, and the first echoes of level ground come from there.
"""


@dataclass(frozen=True)
class Part:
    """Consecutive frames of one geometry: one window, one set of beams, one coding.

    Attributes:
        like: an empty sequence of frames that holds everything they share: sonar, ranges, bearings and level.
        time_s: frame times ``(frames,)`` [s], increasing. Seconds since 1970 if the file records the date.
        images: function that reads the frames with the given indices ``(n,)`` and returns ``(n, bins, beams)``, where
            column 0 is farthest to port.
        poses: x, y, z [m], pitch, roll, heading [rad] of the sonar ``(frames, 6)``, if known.
        attitude_rad: pitch, roll, heading [rad] ``(frames, 3)`` measured by the sonar's sensors; nan where unknown.
        height_m: height above the ground ``(frames,)`` [m], if known.
        gain_db: receiver gain of each frame ``(frames,)`` [dB], if known.
        beam_time_s: time of each beam ``(frames, beams)`` [s], if the beams ping one after another; ``time_s`` is the mean.
        beam_poses: poses at these times ``(frames, beams, 6)``, if known.
    """

    like: SonarFrames
    time_s: Array
    images: Callable[[Index], Pixels]
    poses: Array | None = None
    attitude_rad: Array | None = None
    height_m: Array | None = None
    gain_db: Array | None = None
    beam_time_s: Array | None = None
    beam_poses: Array | None = None

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.time_s)

    def read(self, index: ArrayLike) -> SonarFrames:
        """Read the frames with the given indices ``(n,)``.

        Raises:
            MitsonarError: if a frame does not exist or cannot be read.
        """
        chosen = np.asarray(index, dtype=np.intp)
        beyond = chosen[(chosen < 0) | (chosen >= len(self))]
        if beyond.size:
            raise MitsonarError(f"there is no frame {beyond[0]}: the part holds {len(self):,}, numbered from 0")
        per_frame = ("poses", "attitude_rad", "height_m", "beam_poses")
        known = {name: getattr(self, name)[chosen] for name in per_frame if getattr(self, name) is not None}
        time_s = self.time_s if self.beam_time_s is None else self.beam_time_s
        return replace(self.like, image=self.images(chosen), time_s=time_s[chosen], **known)

    def cropped(self, bins: tuple[int, int] | None, beams: tuple[int, int] | None) -> Part:
        """Return the part restricted to half-open intervals of bins and beams.

        Args:
            bins: first bin and the bin after the last one; None keeps all bins.
            beams: first beam and the beam after the last one; None keeps all beams.

        Raises:
            MitsonarError: if an interval holds fewer than two bins or beams, or exceeds those of the part; or if no
                order of ping groups describes the beams that are left.
        """
        rows, columns = (
            _crop_slice(what, span, len(axis))
            for what, span, axis in (("bins", bins, self.like.range_m), ("beams", beams, self.like.bearing_rad))
        )
        range_m, bearing_rad = self.like.range_m[rows], self.like.bearing_rad[columns]
        step_m, step_rad = (float(np.diff(axis).mean()) for axis in (range_m, bearing_rad))
        sonar = self.like.sonar.replace(
            beams=len(bearing_rad),
            **_groups_of(self.like.sonar, columns),
            range_bins=len(range_m),
            range_min=max(0.0, float(range_m[0] - step_m / 2)),
            range_max=float(range_m[-1] + step_m / 2),
            azimuth_fov_deg=min(self.like.sonar.azimuth_fov_deg, float(np.degrees(step_rad)) * len(bearing_rad)),
        )
        image = self.like.image[:, rows, columns]
        like = replace(self.like, image=image, range_m=range_m, bearing_rad=bearing_rad, sonar=sonar)
        per_beam = {
            name: values[:, columns] for name in ("beam_time_s", "beam_poses") if (values := getattr(self, name)) is not None
        }
        return replace(self, like=like, **per_beam, **self._read_within(rows, columns))

    def _read_within(self, rows: slice, columns: slice) -> dict[str, Any]:
        """Return replacements for the fields that read pixels, restricted to these bins and beams."""
        return {"images": lambda index: self.images(index)[:, rows, columns]}

    def chunks(self) -> Iterator[SonarFrames]:
        """Read all frames in chunks, so that memory use does not grow with the file."""
        cells = max(1, len(self.like.range_m) * len(self.like.bearing_rad))
        count = max(1, CHUNK_BYTES // (4 * cells))
        for start in range(0, len(self), count):
            yield self.read(np.arange(start, min(start + count, len(self))))


def _groups_of(sonar: Sonar, columns: slice) -> dict[str, Any]:
    """Return the ping groups of some of the beams of a sonar, with the times that they have in the whole fan.

    Raises:
        MitsonarError: if no order of groups describes those beams.
    """
    if sonar.ping_groups == 1:
        return {}
    group = group_of_beams(sonar)[columns]
    group = group - group.min()
    groups: dict[str, Any] = {"ping_groups": int(group.max()) + 1, "group_interval_s": ping_interval_s(sonar)}
    cropped = sonar.replace(beams=len(group), **groups)
    if not scans(sonar) and (group_of_beams(cropped) != group).any():
        together = sonar.beams // sonar.ping_groups if sonar.group_order == "sequential" else sonar.ping_groups
        raise MitsonarError(
            f"{argument('crop_beams')} must not change which of the {sonar.ping_groups} ping groups ({sonar.group_order}) a "
            f"beam is in: got {columns.start},{columns.stop} of {sonar.beams} beams; give multiples of {together}"
        )
    return groups


def _crop_slice(what: str, span: tuple[int, int] | None, count: int) -> slice:
    """Return a half-open interval of bins or beams as a slice.

    Raises:
        MitsonarError: if the interval holds fewer than two of them, or exceeds ``count``.
    """
    first, end = (0, count) if span is None else span
    if not (0 <= first < end - 1 and end <= count):
        raise MitsonarError(
            f"{argument(f'crop_{what}')} must be first,end of at least two {what}, numbered from 0, the end excluded, "
            f"within 0,{count}: got {first},{end}"
        )
    return slice(first, end)


@dataclass(frozen=True)
class Recording:
    """A recording of a real sonar: a file or a folder.

    Attributes:
        name: name of the file.
        format: readable name of the format, such as ``ARIS 5 (.aris)``.
        parts: parts in chronological order; a single one if neither window nor beams change.
        facts: header values, keyed by name.
        notes: sentences on what was left out, sorted or assumed.
    """

    name: str
    format: str
    parts: tuple[Part, ...]
    facts: Facts = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not any(len(part) for part in self.parts):
            raise MitsonarError(f"{self.name} holds no frame that can be read: the file is empty or damaged")

    def __len__(self) -> int:
        """Return the number of frames in all parts."""
        return sum(len(part) for part in self.parts)

    @property
    def longest(self) -> int:
        """Return the index of the longest part; the first one if several are equally long."""
        return int(np.argmax([len(part) for part in self.parts]))

    def part(self, number: int | None = None) -> Part:
        """Return a part by its index; default: the longest.

        Raises:
            MitsonarError: if there is no such part.
        """
        if number is not None and not 0 <= number < len(self.parts):
            raise MitsonarError(f"{self.name} has no part {number}: it has {len(self.parts):,}, numbered from 0")
        return self.parts[self.longest if number is None else number]


def in_time_order(time_s: ArrayLike, number: ArrayLike | None = None, what: str = "frame") -> tuple[Index, list[str]]:
    """Sort frames by time, and drop those without a valid time or with the time of the frame before.

    Args:
        time_s: frame times ``(frames,)`` [s].
        number: number that the sonar gave each frame ``(frames,)``, if known. Gaps in it are reported as missing frames.
        what: noun for a frame in the sentences.

    Returns:
        The indices of the remaining frames in order of time, and sentences on what was sorted, dropped or is missing.
    """
    time = np.asarray(time_s, dtype=float)
    known = np.isfinite(time)
    order = np.flatnonzero(known)[np.argsort(time[known], kind="stable")]
    notes = [] if known.all() else [f"left out: {count_noun(int((~known).sum()), what)} without a valid time"]
    if (np.diff(order) < 0).any():
        notes.append(f"{what}s are not in order of time: they were sorted")
    increasing = order[np.diff(time[order], prepend=-np.inf) > 0]
    if len(increasing) < len(order):
        notes.append(f"left out: {count_noun(len(order) - len(increasing), what)} at the time of the one before")
    if number is not None and len(increasing) > 1:
        steps = np.diff(np.asarray(number, dtype=float)[increasing])
        missing = float((steps[steps > 1] - 1).sum())
        if missing:
            notes.append(f"missing: {count_noun(round(missing), what)}, by the numbers that the sonar gave them")
    return increasing, notes


def runs_of(keys: Sequence[Hashable]) -> list[tuple[Hashable, Index]]:
    """Return each run of equal keys with the indices of its members.

    Readers use the geometry of each frame as its key, so that each run becomes a part.
    """
    runs: list[tuple[Hashable, list[int]]] = []
    for place, key in enumerate(keys):
        if not runs or runs[-1][0] != key:
            runs.append((key, []))
        runs[-1][1].append(place)
    return [(key, np.asarray(places, dtype=np.intp)) for key, places in runs]


# ---------------- Memory-mapped files of equally sized frames


Bytes = NDArray[np.uint8]

Header = NDArray[Any]
"""A structured array with the fields of a header."""


def mapped(path: str | Path, what: str, least: int = 1) -> Bytes:
    """Map a file into memory read-only, so that its bytes are read on demand.

    Args:
        path: path of the file.
        what: kind of file, for error messages.
        least: minimum size of the file [bytes].

    Raises:
        MitsonarError: if the path does not exist, is not a regular file, is too short or cannot be read.
    """
    path = Path(path)
    if not os.path.isfile(path):
        raise MitsonarError(f"no such file: {path}" if not os.path.exists(path) else f"{path} is not a file: give {what}")
    size = path.stat().st_size
    if size < least:
        raise MitsonarError(
            f"{path} has {size:,} bytes, but {what} has at least {least:,}: the file is cut off or has another format"
        )
    try:
        return np.memmap(path, dtype=np.uint8, mode="r")
    except (OSError, ValueError) as error:
        raise MitsonarError(f"cannot read {what} {path}: {error}") from None


def layout(fields: Mapping[str, tuple[int, str]], size: int) -> np.dtype[np.void]:
    """Return the structured type of a header of ``size`` bytes, from ``(byte offset, NumPy type)`` of each field."""
    offsets = [offset for offset, _ in fields.values()]
    formats = [kind for _, kind in fields.values()]
    table: Any = {"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": size}
    header_type: np.dtype[np.void] = np.dtype(table)
    return header_type


@dataclass(frozen=True)
class EqualFrames:
    """Consecutive frames of equal size, each a header followed by samples.

    Attributes:
        data: the whole file.
        start: offset of the first frame [bytes].
        header: structured type of a frame's header.
        samples: size of a frame's samples [bytes].
    """

    data: Bytes
    start: int
    header: np.dtype[np.void]
    samples: int

    @property
    def stride(self) -> int:
        """Return the size of a frame including its header [bytes]."""
        return self.header.itemsize + self.samples

    def __len__(self) -> int:
        """Return the number of whole frames, computed from the size of the file rather than read from its header."""
        return max(0, (len(self.data) - self.start) // self.stride)

    @property
    def left_over(self) -> int:
        """Return the number of bytes after the last whole frame."""
        return max(0, len(self.data) - self.start - len(self) * self.stride)

    def headers(self) -> Header:
        """Return the headers ``(frames,)`` as a view into the file."""
        return np.ndarray((len(self),), self.header, self.data, self.start, (self.stride,))

    def table(self) -> Header:
        """Return a copy of the headers ``(frames,)`` that holds only the known fields."""
        names = self.header.names or ()
        return self.headers().astype([(name, self.header[name]) for name in names])

    def read(self, index: NDArray[np.intp], shape: tuple[int, int]) -> Bytes:
        """Return a copy of the samples of the given frames ``(n, *shape)``."""
        begin = self.start + self.header.itemsize + index.astype(np.int64) * self.stride
        return (
            np.stack([self.data[offset : offset + self.samples].reshape(shape) for offset in begin])
            if len(index)
            else np.zeros((0, *shape), np.uint8)
        )
