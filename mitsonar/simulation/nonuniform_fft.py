"""The sum over echoes, a non-uniform FFT of type 1: finufft, or cufinufft where the renderer runs on CUDA."""

from __future__ import annotations

from functools import cache

import finufft
import numpy as np
from numpy.typing import NDArray

from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.simulation.variant import current_variant

__all__ = ["TOLERANCE", "phasor_sums", "phasors"]

TOLERANCE = 1e-9
"""Relative error of the sums."""


def phasor_sums(turn: NDArray[np.float64], strength: NDArray[np.complex128], modes: int) -> NDArray[np.complex128]:
    """Sum strength exp(-i k turn) over the echoes, for an odd number of k around 0.

    Args:
        turn: phase step of each echo, -pi..pi ``(n,)`` [rad].
        strength: complex amplitude of each echo ``(n,)``.
        modes: number of k.

    Returns:
        The sums ``(modes,)``.
    """
    if not len(turn):
        return np.zeros(modes, np.complex128)
    if current_variant().startswith("cuda") and _has_cufinufft():
        return _on_the_device(turn, strength, modes)
    return np.asarray(finufft.nufft1d1(turn, strength, modes, eps=TOLERANCE, isign=-1, nthreads=1))


@cache
def _has_cufinufft() -> bool:
    """Test whether cufinufft is installed and loads; it finds CUDA's libraries in torch's, if their versions agree."""
    try:
        import torch  # noqa: F401, I001  # first: its libraries are found then

        import cufinufft  # noqa: F401
    except (ImportError, OSError):
        return False
    return True


def _on_the_device(turn: NDArray[np.float64], strength: NDArray[np.complex128], modes: int) -> NDArray[np.complex128]:
    import cufinufft
    import torch

    there = [torch.from_numpy(np.ascontiguousarray(values)).cuda() for values in (turn, strength)]
    return np.asarray(cufinufft.nufft1d1(*there, modes, eps=TOLERANCE, isign=-1).cpu().numpy())


def phasors(
    delay: NDArray[np.float64], amplitude: NDArray[np.inexact], sonar: ChannelSonar, padding: int
) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Compute phase step and complex amplitude of echoes in NumPy, as a launch does on the device.

    Args:
        delay: of each echo ``(n,)`` [s].
        amplitude: of each echo ``(n,)``, before the carrier's phase.
        sonar: carrier and frequency step.
        padding: factor by which the frequency response is sampled finer.
    """
    turn, phase = delay * (sonar.frequency_step_hz / padding), delay * sonar.carrier_hz
    strength = amplitude * np.exp(-2j * np.pi * (phase - np.rint(phase)))
    return 2 * np.pi * (turn - np.rint(turn)), np.asarray(strength, np.complex128)
