"""Ratios of signal to noise, as recipes and commands state them."""

from __future__ import annotations

import re

from mitsonar.errors import MitsonarError

__all__ = ["snr_of", "snr_said"]


def snr_of(text: str) -> float | None:
    """A ratio of signal to noise in dB: ``20 dB``; ``none`` for no noise.

    Raises:
        MitsonarError: something else.
    """
    found = re.fullmatch(r"\s*([+-]?\d+(?:\.\d+)?)\s*dB\s*", text)
    if text != "none" and not found:
        raise MitsonarError(f"noise of impulse responses is a signal to noise ratio such as '20 dB', or none: got {text!r}")
    return float(found[1]) if found else None


def snr_said(snr_db: float | None) -> str:
    """What :func:`snr_of` reads."""
    return "none" if snr_db is None else f"{snr_db:g} dB"
