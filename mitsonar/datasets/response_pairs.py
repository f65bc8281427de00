"""Samples of impulse responses for torch: packed matrices with the displacement between the pings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from mitsonar.acoustics.noise import snr_of, snr_said
from mitsonar.datasets.batches import Batch, Device, RawSample, StoredBatches
from mitsonar.datasets.modality import Fields
from mitsonar.datasets.response_packing import Packing
from mitsonar.datasets.response_samples import ImpulseSamples

__all__ = ["ImpulsePairs"]


class ImpulsePairs(ImpulseSamples, StoredBatches, Dataset[Batch]):
    """Samples of impulse responses; ``pairs[i]`` is ``(input, label)``, float32 tensors.

    The input is ``(1, taps, 2 M Q)``: for each of M receivers the real parts of its Q responses, then their imaginary parts,
    one column each, divided by the largest magnitude of the sample (Almanza-Medina, 5.2.5). The label is the displacement
    from the first ping to the last: sideways, forward, and yaw where the recipe turns. Arguments and errors:
    :class:`~mitsonar.datasets.response_samples.ImpulseSamples`.
    """

    @property
    def noise_seed(self) -> int:
        """Return the seed of the noise, which changes with the epoch."""
        return self.epoch_seed

    def raw(self, index: int) -> RawSample:
        """Read a sample as it is stored: responses ``(Q, M, taps)``, numbers of the pings, and the label."""
        here = self.frame_numbers(index)
        label = self.labels.encode(self.target(index))
        return {"frames": np.arange(here.start, here.stop), "response": self.response(index), "label": label}

    def finished(self, batch: dict[str, Tensor], device: Device = None) -> Batch:
        """Make matrices and labels of a batch of raw samples, on a device."""
        response, numbers = (torch.as_tensor(batch[name]).cpu().numpy() for name in ("response", "frames"))
        inputs = torch.from_numpy(self.arrange(response, numbers, self.noise_seed))
        return inputs.to(device, non_blocking=True), torch.as_tensor(batch["label"]).to(device, non_blocking=True)

    def at_noise(self, level: str) -> Packing:
        """Return the packing with one level of noise.

        Raises:
            MitsonarError: an unknown level.
        """
        return replace(self.arrange, levels=(snr_of(level),))

    def described(self) -> Fields:
        """Describe the samples, as a checkpoint keeps it; see :meth:`~mitsonar.datasets.batches.Batches.described`."""
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
