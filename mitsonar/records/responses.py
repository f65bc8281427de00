"""Store complex channel impulse responses in the common format of ``responses.npz`` that all later stages read."""

from __future__ import annotations

import io
import json
import os
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.io.files import FileArray, PlainValue, read_npz, refuse_beyond_memory, write_atomic
from mitsonar.records.frames import Column, StoredArray, check_column, open_group, table_in

__all__ = ["ImpulseResponses"]

PER_PING = ("response", "time_s", "poses", "velocity", "height_m", "echoes", "dropped")

COLUMNS = {
    "response": Column(("pings", "receivers", "taps"), "c"),
    "time_s": Column(("pings",), order="same"),
    "poses": Column(("pings", "six"), low=-1e9, high=1e9),
    "velocity": Column(("pings", "four"), low=-1e6, high=1e6),
    "height_m": Column(("pings",), low=0, nan=True),
    "echoes": Column(("pings", "receivers"), "i", low=0),
    "dropped": Column(("pings", "receivers"), "i", low=0),
}
"""Requirements on the arrays of a file."""


@dataclass
class ImpulseResponses:
    """Channel impulse responses of one instrument.

    Attributes:
        response: complex baseband ``(pings, receivers, taps)`` complex64; receivers in the order of ``sonar.receivers``.
        time_s: transmission time of each ping ``(pings,)`` [s].
        sonar: the instrument.
        poses: x, y, z [m], pitch, roll, heading [rad] of the transmitter at transmission ``(pings, 6)``, if known.
        velocity: velocity of the vehicle in its own axes, starboard, forward, up [m/s], and turn rate to starboard [rad/s]
            ``(pings, 4)``, if known.
        height_m: height of the transmitter over the ground below ``(pings,)``, if known.
        echoes: number of echoes in each response ``(pings, receivers)``, if known.
        dropped: number of echoes from beyond ``range_max`` ``(pings, receivers)``, if known.
        about: further metadata for the file.
    """

    response: NDArray[np.complex64]
    time_s: NDArray[np.float64]
    sonar: ChannelSonar
    poses: NDArray[np.float64] | None = None
    velocity: NDArray[np.float64] | None = None
    height_m: NDArray[np.float64] | None = None
    echoes: NDArray[np.int64] | None = None
    dropped: NDArray[np.int64] | None = None
    about: dict[str, PlainValue] = field(default_factory=dict)

    def __post_init__(self) -> None:
        expected_shape = (len(self.time_s), len(self.sonar.receivers), self.sonar.taps)
        if self.response.shape != expected_shape:
            raise MitsonarError(
                f"response must be (pings, receivers, taps) = {expected_shape} after time_s and sonar: got "
                f"{self.response.shape}"
            )
        for name in PER_PING:
            values = getattr(self, name)
            if values is not None and values.shape[0] != expected_shape[0]:
                raise MitsonarError(f"{name} must hold {expected_shape[0]} pings: got {len(values)}")

    def __len__(self) -> int:
        return int(self.response.shape[0])

    def __repr__(self) -> str:
        names = ", ".join(receiver.name for receiver in self.sonar.receivers)
        known = ", ".join(name for name in PER_PING[2:] if getattr(self, name) is not None)
        return (
            f"ImpulseResponses({len(self)} pings, {self.response.shape[1]} receivers ({names}), {self.sonar.taps} taps at "
            f"{self.sonar.sampling_hz:g} Hz; {known})"
        )

    @property
    def delay_s(self) -> NDArray[np.float64]:
        """Return the delay of each tap ``(taps,)`` [s]."""
        return self.sonar.delay_s

    @property
    def ground_m(self) -> float | None:
        """Return the median height (z) of the ground below the pings [m]; None if no ping knows its pose and height."""
        if self.poses is None or self.height_m is None:
            return None
        below = np.asarray(self.poses, dtype=float)[:, 2] - np.asarray(self.height_m, dtype=float)
        return float(np.median(below[np.isfinite(below)])) if np.isfinite(below).any() else None

    def select(self, index: slice | NDArray[np.integer] | NDArray[np.bool_]) -> ImpulseResponses:
        """Return a subset of the pings."""
        selected = {name: getattr(self, name)[index] for name in PER_PING if getattr(self, name) is not None}
        unchanged = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in selected}
        return ImpulseResponses(**selected, **unchanged)

    def arrays(self) -> dict[str, FileArray]:
        """Return the arrays of ``responses.npz`` by name; ``sonar`` and ``about`` are JSON strings."""
        table: dict[str, FileArray] = {"delay_s": self.delay_s}
        table |= {name: getattr(self, name) for name in PER_PING if getattr(self, name) is not None}
        return table | {
            "sonar": np.array(self.sonar.model_dump_json()),
            "about": np.array(json.dumps(self.about)),
        }

    def save(self, path: str | Path) -> None:
        """Write an ``.npz`` file atomically, or a Zarr v3 group if the name ends with ``.zarr``."""
        path = Path(path)
        if path.suffix == ".zarr":
            import zarr

            group = zarr.open_group(path, mode="w", zarr_format=3)
            for name, values in self.arrays().items():
                if values.ndim:
                    group.create_array(name, data=values, chunks=(1, *values.shape[1:]) if values.ndim > 2 else values.shape)
                else:
                    group.attrs[name] = values.item()
        else:
            buffer = io.BytesIO()
            table: dict[str, StoredArray] = self.arrays()
            np.savez_compressed(buffer, **table)
            write_atomic(path, buffer.getvalue())

    @classmethod
    def load(cls, path: str | Path, *, stored: bool = False) -> ImpulseResponses:
        """Read a file written by :meth:`save`, or a folder written by ``mitsonar impulse``.

        Args:
            path: file or folder.
            stored: leave the responses of a ``.zarr`` on disk; slices of :attr:`response` read them.

        Raises:
            MitsonarError: no such file, or a file that is damaged or does not hold responses.
        """
        path = Path(path)
        if os.path.isdir(path) and path.suffix != ".zarr":
            path = path / "responses.npz"
        if not os.path.exists(path):
            raise MitsonarError(f"there are no responses at {path}: give what `mitsonar impulse` wrote")
        try:
            if os.path.isdir(path):
                table, _ = open_group(path, COLUMNS, "time_s")
                left = {"response": table["response"]} if stored and "response" in table else {}
                loaded = [values for name, values in table.items() if name not in left]
                refuse_beyond_memory(sum(getattr(values, "nbytes", 0) for values in loaded), str(path))
                table |= {name: array[...] for name, array in table.items() if not isinstance(array, np.ndarray)} | left
            else:
                table = read_npz(path)
        except Exception as error:  # a damaged zip or Zarr raises many types of errors
            reason = " ".join(str(error).split())[:300] or type(error).__name__
            raise MitsonarError(f"cannot read responses {path}: {reason}; give what `mitsonar impulse` wrote") from None
        missing = [name for name in ("response", "time_s", "sonar") if name not in table]
        if missing:
            raise MitsonarError(f"{path} lacks {', '.join(missing)}: it is not a file of impulse responses of mitsonar")
        sonar = ChannelSonar.create(**table_in(table, "sonar", str(path)))
        about = table_in(table, "about", str(path), "{}")
        values = {name: table[name] for name in PER_PING if name in table}
        sizes = {"pings": len(np.atleast_1d(table["time_s"])), "receivers": len(sonar.receivers), "taps": sonar.taps}
        for name in values:
            check_column(values[name], name, COLUMNS[name], sizes | {"four": 4, "six": 6}, str(path))
        return cls(**values, sonar=sonar, about=about)
