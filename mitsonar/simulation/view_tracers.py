"""The tracer of each kind of view."""

from __future__ import annotations

from collections.abc import Iterable

from mitsonar.instruments.views import Receiver, Segment, View, Whole
from mitsonar.simulation.bistatic import ReceiverTracer
from mitsonar.simulation.view_echoes import SegmentTracer, ViewTracer, WholeTracer

__all__ = ["view_tracers"]

TRACERS = {Whole: WholeTracer, Segment: SegmentTracer, Receiver: ReceiverTracer}


def view_tracers(views: Iterable[View]) -> list[ViewTracer]:
    """Return the tracer of each view, in their order."""
    return [TRACERS[type(view)](view) for view in views]
