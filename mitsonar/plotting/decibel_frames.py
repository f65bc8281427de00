"""Frames of any coding with values that are decibels, for pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mitsonar.acoustics.levels import decoded
from mitsonar.errors import MitsonarError
from mitsonar.records.frames import SonarFrames, to_float32

__all__ = ["coded_in_decibels"]


def coded_in_decibels(frames: SonarFrames, span_db: float) -> SonarFrames:
    """Return frames whose values 0..1, float32, are the ``span_db`` decibels below full scale; what is lower is 0.

    Raises:
        MitsonarError: a span that is not above 0.
    """
    if not 0 < span_db <= 300:
        raise MitsonarError(f"the span must lie in 0..300 dB: got {span_db:g}")
    values = to_float32(frames.image)
    if frames.level == "dB":
        shown = 1 + (values - 1) * np.float32(frames.sonar.coding_db / span_db)
        shown[values <= 0] = 0
    else:
        with np.errstate(divide="ignore"):
            shown = 1 + 10 * np.log10(decoded(np.clip(values, 0, 1), frames.sonar, frames.level)) / span_db
    sonar = frames.sonar.replace(coding="dB", coding_db=span_db)
    return replace(frames, image=np.clip(shown, 0, 1).astype(np.float32), level="dB", sonar=sonar)
