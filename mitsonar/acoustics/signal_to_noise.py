"""Signal to noise ratios, as recipes and commands write them."""

from __future__ import annotations

import re

from mitsonar.errors import MitsonarError, shortened

__all__ = ["snr_of", "snr_said"]


def snr_of(text: str) -> float | None:
    """Parse a signal to noise ratio in dB: ``20 dB``; ``none`` for no noise.

    Raises:
        MitsonarError: something else.
    """
    found = re.fullmatch(r"\s*([+-]?\d+(?:\.\d+)?)\s*dB\s*", text)
    if text != "none" and not found:
        raise MitsonarError(
            f"noise of impulse responses is a signal to noise ratio such as '20 dB', or none: got {shortened(text)}"
        )
    return float(found[1]) if found else None


def snr_said(snr_db: float | None) -> str:
    """Format a signal to noise ratio [dB] as :func:`snr_of` parses it."""
    return "none" if snr_db is None else f"{snr_db:g} dB"
