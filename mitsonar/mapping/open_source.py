"""The records of one run for odometry and maps: frames, views of a data set, or impulse responses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar, cast

from mitsonar.acoustics.noise import load_noise
from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import AnyEstimator
from mitsonar.estimation.height.named_height_estimators import height_estimator_from
from mitsonar.mapping.frame_source import FrameSource
from mitsonar.mapping.open_frames import open_frames
from mitsonar.mapping.response_source import ResponseSource, holds_responses, open_responses
from mitsonar.mapping.view_source import ViewSource, open_views
from mitsonar.records.impulse_responses import ImpulseResponses
from mitsonar.records.sonar_frames import SonarFrames
from mitsonar.records.view_frames import ViewFrames

__all__ = ["Reading", "Source", "frames_for", "open_source", "record_at", "views_for"]

Source = FrameSource | ResponseSource | ViewSource

Framed = TypeVar("Framed", FrameSource, ViewSource)


class ViewReader(Protocol):
    """An estimator that reads views of a data set: their names, and ``image`` or ``vector``."""

    @property
    def views(self) -> tuple[str, ...]: ...
    @property
    def kind(self) -> str: ...


FRAME_OPTIONS = ("sequence", "view", "height_by", "pitch_rad", "geometry")
"""Options that impulse responses lack."""


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
    """

    sequence: int | None = None
    view: str | None = None
    noise: str = "none"
    seed: int = 0
    height_m: float | None = None
    pitch_rad: float | None = None
    height_by: str | None = None
    geometry: Path | None = None


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
    return _with_heights(source, reading)


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


def _with_heights(source: Framed, reading: Reading) -> Framed:
    """Return the same records, whose heights are measured in them if the user asks for it."""
    return source if reading.height_by is None else source.with_heights_by(height_estimator_from(reading.height_by))


def _check_consumed(where: str, there: type, wanted: type) -> None:
    if wanted not in (there, object):
        raise MitsonarError(
            f"{where} holds {WORDS[there]}, and this estimator reads {WORDS[wanted]}: choose another estimator"
        )


WORDS: dict[type, str] = {SonarFrames: "sonar frames", ImpulseResponses: "impulse responses", ViewFrames: "views"}
