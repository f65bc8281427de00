"""A data set of impulse responses as torch reads it: packed matrices with the displacement between the pings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from mitsonar.acoustics.signal_to_noise import snr_of, snr_said
from mitsonar.datasets.batches import StoredBatches
from mitsonar.datasets.response_packing import Packing
from mitsonar.datasets.response_samples import ImpulseSamples

__all__ = ["ImpulsePairs"]


class ImpulsePairs(ImpulseSamples, StoredBatches, Dataset[Any]):
    """Samples of impulse responses; ``pairs[i]`` is ``(input, label)``, float32 tensors.

    The input is ``(1, taps, 2 M Q)``: for each of M receivers the real parts of its Q responses, then their imaginary parts,
    one column each, divided by the largest magnitude among them (Almanza-Medina, 5.2.5). The label is the displacement from
    the first ping to the last: sideways, forward, and yaw where the recipe turns. Arguments and errors:
    :class:`~mitsonar.datasets.response_samples.ImpulseSamples`.
    """

    @property
    def noise_seed(self) -> int:
        """Another epoch draws other noise."""
        return self.epoch_seed

    def raw(self, index: int) -> dict[str, Any]:
        """A sample as it is stored: responses ``(Q, M, taps)``, numbers of the pings, and the label."""
        here = self.frame_numbers(index)
        label = self.labels.encode(self.target(index))
        return {"frames": np.arange(here.start, here.stop), "response": self.response(index), "label": label}

    def finished(self, batch: dict[str, Any], device: torch.device | str | None = None) -> tuple[Any, torch.Tensor]:
        """Matrices and labels of a batch of raw samples, on a device."""
        response, numbers = (torch.as_tensor(batch[name]).cpu().numpy() for name in ("response", "frames"))
        inputs = torch.from_numpy(self.arrange(response, numbers, self.noise_seed))
        return inputs.to(device, non_blocking=True), torch.as_tensor(batch["label"]).to(device, non_blocking=True)

    def at_noise(self, level: str) -> Packing:
        """The packing with one level of noise."""
        return replace(self.arrange, levels=(snr_of(level),))

    def described(self) -> dict[str, Any]:
        """What a checkpoint keeps of the samples that a network was trained on."""
        low, high = self.recipe.flight.heights
        return {
            "arrangement": {
                "frames": self.frames,
                "views": list(self.arrange.receivers),
                "kind": "response",
                "layout": "columns",
                "coordinates": "delay",
                "cartesian_rows": self.sonar.taps,
                "ground": False,
            },
            "sonar": {"channel": self.sonar.model_dump(mode="json")},
            "trained_at": {"height_m": [low, high], "pitch_deg": 0.0, "roll_deg": 0.0},
            "model": self.sonar.model,
            "noise": "; ".join(map(snr_said, self.arrange.levels)),
        }
