"""How the models ``physical`` and ``thesis`` render many pings in one launch: rays, echoes, views and sums."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import View
from mitsonar.plugins.imaging_sonar_sensor import Fan
from mitsonar.records.echoes import Echoes
from mitsonar.simulation.beams import elevation_gain
from mitsonar.simulation.binning import ViewEchoes, ViewTracer, accumulate, develop, strongest
from mitsonar.simulation.device import DeviceArray, Frozen
from mitsonar.simulation.multipath_rough import BounceSums
from mitsonar.simulation.tracing import Rays, Tracer

__all__ = ["ImageLaunch"]


@dataclass(frozen=True)
class ImageLaunch:
    """Compiler of launches that render a given number of pings.

    Attributes:
        tracer: tracer of the rays.
        views: views that are rendered.
        view_tracers: view tracer of each view.
        formed: sonar whose pattern over elevation weighs the echoes; None: no pattern.
        bounces: sums over paths with several reflections; None: single reflections only.
    """

    tracer: Tracer
    views: Sequence[View]
    view_tracers: Sequence[ViewTracer]
    formed: Sonar | None
    bounces: BounceSums | None

    def compiled(self, pings: int, labels: bool) -> tuple[Callable[..., Any], DeviceArray]:
        """Compile the launch of a number of pings; also return its first input, the numbers of the rays.

        The launch is recorded once and then replayed (``dr.freeze``), so a single ping costs its rays and hardly any Python.
        Its inputs are the ray numbers, the scene, the rows of the poses, the jitter keys, and the tables of surfaces, views
        and mirrors. It returns the heights and, for each view, the levels, the counters, the truth for labels, and the
        levels of single reflections if labels are derived from these.
        """
        tracer, bounces = self.tracer, self.bounces

        @Frozen
        def launch(index: Any, scene: Any, rows: Any, keys: Any, surfaces: Any, tables: Any, mirrors: Any) -> Any:
            # 1. Trace one echo for each ray.
            rays = Rays(tracer.sonar, index)
            ray, fan = tracer.rays_of(rays, rows, keys)
            echoes = tracer.echoes(scene, ray, fan, surfaces)
            # 2. Sum paths with several reflections; the mirror part of a surface does not scatter.
            more = None
            if bounces is not None:
                echoes, reflection = bounces.scattered(echoes, mirrors)
                key = dr.gather(mi.UInt32, keys, rays.ping) if tracer.sonar.jittered else mi.UInt32(tracer.sensor.key(0))
                lines = [dr.gather(mi.Vector4f, rows, rays.moment * 3 + axis) for axis in range(3)]
                seen = fan, echoes, reflection
                known = replace(tracer.surfaces, **surfaces)
                more = bounces.sums(scene, known, rays, lines, seen, key, mirrors, pings)
            # 3. Sum the echoes of each view, and find the strongest ray of each cell for labels.
            looks = self._looks(scene, rays, fan, echoes, tables)
            sums = [accumulate(seen, rays.ping, pings, own) for seen, own in zip(looks, self.view_tracers, strict=True)]
            truths = [
                self._truth(seen, rays, pings, view) if labels else None
                for seen, view in zip(looks, self.views, strict=True)
            ]
            # 4. Evaluate everything that reads the echoes in one kernel, before any sum is read: rays are traced only once.
            dr.eval(sums, more, truths)
            # 5. Turn the sums into levels and counters.
            made: list[tuple[Any, ...]] = []
            for total, own, truth in zip(sums, self.view_tracers, truths, strict=True):
                first = develop(total, pings, own)
                if more is None:
                    made.append((*first, truth, None))
                else:
                    assert bounces is not None
                    joined = develop(total, pings, own, (more, bounces.tracer.bits))
                    made.append((*joined, truth, first[0] if labels else None))
            return tracer.height_m(scene, rows), made

        return launch, Rays.numbered(tracer.sonar, pings)

    def _looks(self, scene: Any, rays: Rays, fan: Fan, echoes: Echoes, tables: Sequence[DeviceArray]) -> list[ViewEchoes]:
        """Return the echoes of each view, weighted by the pattern over elevation if there is one."""
        if self.formed is not None:
            gain = dr.square(elevation_gain(self.formed, dr.tan(fan.elevation)))
            echoes = replace(echoes, reflectivity=echoes.reflectivity * gain)
        return [
            tracer.view_echoes(scene, rays, fan, echoes, table)
            for tracer, table in zip(self.view_tracers, tables, strict=True)
        ]

    @staticmethod
    def _truth(seen: ViewEchoes, rays: Rays, pings: int, view: View) -> tuple[DeviceArray, ...]:
        """Return the data of labels: strongest ray of each cell, and elevation, shape and object of each ray."""
        best = strongest(seen, rays.ping, rays.ray, pings, view)
        return best, seen.elevation, seen.echoes.shape_id, seen.echoes.object_id
