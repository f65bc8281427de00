"""The records of one run for odometry and maps: frames, views of a data set, or impulse responses."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, TypeVar, cast

import numpy as np

from mitsonar.acoustics.noise import load_noise
from mitsonar.errors import MitsonarError, MitsonarWarning, nearest_names
from mitsonar.estimation.estimator import AnyEstimator
from mitsonar.estimation.height import height_estimator_from
from mitsonar.mapping.frame_source import FrameSource
from mitsonar.mapping.open_frames import is_recording, open_frames
from mitsonar.mapping.response_source import ResponseSource, holds_responses, open_responses
from mitsonar.mapping.view_source import ViewSource, open_views
from mitsonar.records.frames import SonarFrames, ViewFrames
from mitsonar.records.responses import ImpulseResponses

__all__ = [
    "LOOP",
    "Reading",
    "Source",
    "frames_for",
    "open_source",
    "record_at",
    "usual_loop",
    "views_for",
    "with_assumed_plane",
]

Source = FrameSource | ResponseSource | ViewSource

Framed = TypeVar("Framed", FrameSource, ViewSource)


class ViewReader(Protocol):
    """An estimator that reads views of a data set: their names, and ``image`` or ``vector``."""

    @property
    def views(self) -> tuple[str, ...]: ...
    @property
    def kind(self) -> str: ...


FRAME_OPTIONS = ("sequence", "view", "height_by", "pitch_rad", "geometry", "contrast")
"""Options that impulse responses lack."""


CONTRASTS = ("levels", "local", "moving")

ASSUMED_HEIGHT = 0.15
"""Height over the ground where nothing tells it, as part of the far end of the window."""

NEAREST = 0.25
"""Least range at which the assumed ground is looked for, as part of the far end: windows may begin at 0."""

LOOP = 8
"""Motions over which loops of contrast are closed, where nothing else is told."""


@dataclass(frozen=True)
class Reading:
    """How records are read: which, with which noise, and the height and pitch that are assumed where they lack them.

    Attributes:
        sequence: of a data set; None: the longest.
        view: of a data set; None: the first.
        noise: name of a model, or a ratio of signal to noise for impulse responses.
        seed: of the noise.
        height_m: over the ground [m], for records that lack it.
        pitch_rad: of the sonar [rad], for frames that lack poses.
        height_by: measures the height in each frame: ``direct`` or a checkpoint.
        geometry: file that tells how the pictures of a recording are laid out.
        contrast: what is matched: ``levels``; ``local`` contrast; ``moving``: the same, less the pattern that moves with the
            sonar. None: local for recordings that tell no height, levels for all others.
    """

    sequence: int | None = None
    view: str | None = None
    noise: str = "none"
    seed: int = 0
    height_m: float | None = None
    pitch_rad: float | None = None
    height_by: str | None = None
    geometry: Path | None = None
    contrast: str | None = None


def record_at(where: str | Path) -> type[SonarFrames] | type[ImpulseResponses]:
    """Return the class of the records at a path or URL."""
    return ImpulseResponses if holds_responses(where) else SonarFrames


def open_source(where: str, estimator: AnyEstimator, reading: Reading) -> Source:
    """Open the records of a run as an estimator consumes them.

    Raises:
        MitsonarError: nothing there, records that the estimator does not consume, options that do not fit them.
    """
    there, wanted = record_at(where), estimator.consumes
    if there is ImpulseResponses:
        _check_consumed(where, there, wanted)
        return _responses_for(where, reading)
    if wanted is ViewFrames:
        return _with_heights(_views_of(where, cast(ViewReader, estimator), reading), reading)
    if reading.height_m is not None and reading.height_by is not None:
        raise MitsonarError("--height gives the height and --height-by measures it: give one of them")
    source = frames_for(where, reading)
    _check_consumed(where, there, wanted)
    source = _with_heights(source, reading)
    bare = is_recording(where) and not _tells_height(source)
    return _with_contrast(with_assumed_plane(source) if bare else source, reading, bare=bare)


def frames_for(where: str, reading: Reading) -> FrameSource:
    """Open sonar frames.

    Raises:
        MitsonarError: none there, or options that do not fit them.
    """
    noise = load_noise(reading.noise)
    source = open_frames(where, sequence=reading.sequence, view=reading.view, geometry=reading.geometry)
    if not len(source):
        raise MitsonarError(f"{source.name} holds no frames: give those of a finished run")
    return source.with_noise(noise, reading.seed).with_geometry(reading.height_m, reading.pitch_rad)


def views_for(where: str, views: tuple[str, ...], kind: str, reading: Reading) -> ViewSource:
    """Open views of a data set, ``image`` or ``vector``.

    Raises:
        MitsonarError: none there.
    """
    return open_views(where, views, kind, sequence=reading.sequence).with_noise(load_noise(reading.noise), reading.seed)


def usual_loop(source: Source) -> int:
    """Return over how many motions loops are closed where the user does not say; 0: none. Short records have short loops."""
    half = (len(source) - 1) // 2
    return 0 if source.contrast is None or half < 2 else min(LOOP, half)


def _views_of(where: str, estimator: ViewReader, reading: Reading) -> ViewSource:
    """Open the views that a network was trained on."""
    if any(option is not None for option in (reading.view, reading.height_m, reading.pitch_rad, reading.geometry)):
        raise MitsonarError(
            "--view, --height, --pitch-deg and --geometry are not for a network that reads views of a data set"
        )
    return views_for(where, estimator.views, estimator.kind, reading)


def _responses_for(where: str, reading: Reading) -> ResponseSource:
    """Open impulse responses with noise and the assumed height."""
    if any(getattr(reading, name) is not None for name in FRAME_OPTIONS):
        raise MitsonarError(
            "--sequence, --view, --height-by, --pitch-deg and --geometry belong to frames, not to impulse responses"
        )
    return open_responses(where).with_noise(reading.noise, reading.seed).with_height(reading.height_m)


def _tells_height(source: FrameSource) -> bool:
    """Return whether all frames have a height, told or measured."""
    return source.altimeter is not None or (source.height_m is not None and bool(np.isfinite(source.height_m).all()))


def _with_contrast(source: FrameSource, reading: Reading, *, bare: bool) -> FrameSource:
    """Return the same frames, as levels or as contrast.

    Raises:
        MitsonarError: an unknown word.
    """
    contrast = reading.contrast or ("local" if bare else "levels")
    if contrast not in CONTRASTS:
        raise MitsonarError(f"unknown contrast {contrast!r}: {nearest_names(contrast, CONTRASTS)}")
    return source if contrast == "levels" else source.with_contrast(moving=contrast == "moving")


def with_assumed_plane(source: FrameSource) -> FrameSource:
    """Return the same frames with a height and a pitch where neither they nor the user tell a height, and a warning.

    The plane is seen over the whole window within the opening of the beams. Motions hardly depend on it: they are scaled by
    the cosine of the angle at which the sonar looks at the ground.
    """
    if _tells_height(source):
        return source
    far = float(source.like.range_m[-1])
    near = max(float(source.like.range_m[0]), NEAREST * far)
    opening = math.radians(source.like.sonar.elevation_fov_deg)
    height = min(ASSUMED_HEIGHT * far, opening * near * far / max(far - near, 1e-3 * far))
    pitch = (math.asin(height / near) + math.asin(height / far)) / 2
    warnings.warn(
        f"{source.name} tells no height over the ground: {height:.3g} m and a pitch of {math.degrees(pitch):.1f} deg are "
        "assumed, so that the beams meet the ground over the whole window; give --height and --pitch-deg",
        MitsonarWarning,
        stacklevel=3,
    )
    known = source.pitch_rad if source.pitch_rad is not None else pitch
    return replace(source, height_m=np.full(len(source), height), assumed_height=True, pitch_rad=known)


def _with_heights(source: Framed, reading: Reading) -> Framed:
    """Return the same records, whose heights are measured in them if the user asks for it."""
    return source if reading.height_by is None else source.with_heights_by(height_estimator_from(reading.height_by))


def _check_consumed(where: str, there: type, wanted: type) -> None:
    if wanted not in (there, object):
        raise MitsonarError(
            f"{where} holds {WORDS[there]}, and this estimator reads {WORDS[wanted]}: choose another estimator"
        )


WORDS: dict[type, str] = {SonarFrames: "sonar frames", ImpulseResponses: "impulse responses", ViewFrames: "views"}
