"""What a channel sonar records of a ping: a complex impulse response at each receiver."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.noise import snr_of
from mitsonar.config.data import Recipe
from mitsonar.datasets.modality import Fields, Read, StoredArray, StoredAxis, ground_reach
from mitsonar.instruments.hydrophones import ChannelSonar, FieldOfView

__all__ = ["ResponseModality"]

RAYS = 61
"""Rays across and along each field of view whose ends on the ground make a footprint."""


class ResponseModality:
    """Responses of a recipe with a channel sonar; see :class:`~mitsonar.datasets.modality.Modality`."""

    what = "ping"
    settled: tuple[str, ...] = ()
    planned: tuple[str, ...] = ("velocity",)
    decided_by: tuple[str, ...] = ("finufft",)
    renderer_class = "mitsonar.datasets.response_rendering:ResponseRenderer"
    samples_class = "mitsonar.datasets.response_samples:ImpulseSamples"
    estimators = "zero,correlation,likelihood"
    variations = False

    def __init__(self, recipe: Recipe) -> None:
        self.recipe, self.sonar = recipe, recipe.channel_sonar

    @property
    def stored(self) -> dict[str, StoredArray]:
        """Return the array of responses, and what the simulation reports of each ping."""
        count = len(self.sonar.receivers)
        response = "complex baseband responses; receivers in the order of the attribute sonar"
        return {
            "response": StoredArray(np.dtype(np.complex64), response, (count, self.sonar.taps), ("receiver", "tap")),
            "height_m": StoredArray(
                np.dtype(np.float64), "height of the transmitter over what is straight below it [m]; nan where nothing is"
            ),
            "echoes": StoredArray(np.dtype(np.int64), "echoes that count", (count,), ("receiver",)),
            "dropped": StoredArray(np.dtype(np.int64), "echoes from beyond range_max, dropped", (count,), ("receiver",)),
        }

    @property
    def axes(self) -> dict[str, StoredAxis]:
        """Return the delays."""
        return {"delay_s": StoredAxis(self.sonar.delay_s, "tap", "delay of each tap [s]")}

    @property
    def attributes(self) -> Fields:
        """Return the instrument and the names of its receivers."""
        return {"sonar": self.sonar.model_dump(mode="json"), "receivers": [one.name for one in self.sonar.receivers]}

    @property
    def ping_bytes(self) -> int:
        """Return the size of the responses of a ping [bytes]."""
        return 8 * len(self.sonar.receivers) * self.sonar.taps

    @property
    def sample_frames(self) -> int:
        """Return the number of pings of a sample, as the recipe has it."""
        return self.recipe.frames

    def reach(self, height: float, pitch: float = 0.0) -> NDArray[np.float64]:
        """Compute the corners ``(n, 2)`` of what the receivers cover of the ground [m].

        Raises:
            MitsonarError: a receiver has no ground in range.
        """
        return _reach(self.sonar, height)

    def noise_model(self, name: str) -> None:
        """Check a signal-to-noise ratio, whose name alone defines the noise.

        Raises:
            MitsonarError: not a ratio.
        """
        snr_of(name)

    def empty(self, read: Read, here: slice) -> NDArray[np.bool_]:
        """Find the pings of which no receiver recorded an echo ``(pings,)``."""
        return np.asarray((read("echoes", here) == 0).all(axis=1))

    def faults(self, read: Read, here: slice) -> list[str]:
        """Check that responses are finite and that no count is below 0. Return a sentence for each fault."""
        wrong = [
            f"response, pings {here.start}..{here.stop - 1}: values that are not finite"
            for _ in range(not np.isfinite(read("response", here)).all())
        ]
        for name in ("echoes", "dropped"):
            if (read(name, here) < 0).any():
                wrong.append(f"{name}, pings {here.start}..{here.stop - 1}: numbers below 0")
        return wrong

    def warnings(self, read: Read) -> list[str]:
        """Warn of receivers without echoes, of echoes that were dropped, and of motions far below a wavelength."""
        sentences = []
        echoes, dropped = read("echoes"), read("dropped")
        for number, receiver in enumerate(self.sonar.receivers):
            silent = int((echoes[:, number] == 0).sum())
            if silent:
                sentences.append(
                    f"receiver {receiver.name} records no echo in {silent:,} of {len(echoes):,} pings: check where it "
                    f"points (heading {receiver.field.heading_deg:g} deg, tilt {receiver.field.tilt_deg:g} deg), height_m "
                    "and range_max"
                )
        if dropped.any():
            share = 100 * dropped.sum() / max(1, dropped.sum() + echoes.sum())
            sentences.append(
                f"{dropped.sum() / len(dropped):,.0f} echoes a ping ({share:.2g} %) came from beyond range_max "
                f"{self.sonar.range_max:g} m and were dropped"
            )
        flight, wave_mm = self.recipe.flight, 1e3 * self.sonar.wavelength_m
        largest_mm = max(flight.sideways_mm, flight.forward_mm)
        if flight.kind == "random" and flight.pings > 1 and 0 < largest_mm < wave_mm / 1000:
            sentences.append(
                f"motions of at most {largest_mm:g} mm are less than a thousandth of the wavelength ({wave_mm:.3g} mm): "
                "flight.sideways_mm and forward_mm are in millimetres"
            )
        return sentences


@lru_cache(maxsize=8)
def _reach(sonar: ChannelSonar, height: float) -> NDArray[np.float64]:
    """Compute the footprints of all receivers, one after the other."""
    parts = [
        ground_reach(np.array([*one.position[:2], height + one.position[2]]), _rays(one.field), sonar.range_max)
        for one in sonar.receivers
    ]
    return np.concatenate(parts)


def _rays(field: FieldOfView) -> NDArray[np.float64]:
    """Compute directions over a field of view, borders included, in the vehicle's axes ``(n, 3)``."""
    part = np.linspace(-1, 1, RAYS)
    match field.shape:
        case "rectangular":
            side = np.sin(math.radians(field.across_deg) / 2 * part)[:, None]
            up = math.radians(field.along_deg) / 2 * part
            ahead = np.sqrt(1 - side**2)
            local = np.stack(np.broadcast_arrays(ahead * np.cos(up), side, ahead * np.sin(up)), axis=-1)
        case kind:
            off = math.radians(field.across_deg) / 2 if kind == "circular" else math.pi
            tilt, turn = np.meshgrid(off * (part + 1) / 2, np.pi * part)
            local = np.stack([np.cos(tilt), np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn)], axis=-1)
    return np.asarray(local.reshape(-1, 3) @ field.axes)
