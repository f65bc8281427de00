"""The integrator ``echo``."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator

from mitsonar.plugins.imaging_sonar_sensor import Fan, is_imaging_sonar
from mitsonar.plugins.surfaces import Surfaces
from mitsonar.records.echoes import CHANNELS, Echoes

__all__ = ["GRAZING", "Echo", "steep"]

GRAZING = 0.02
"""Sine of the flattest angle (1.1 deg) at which a cell's tangent plane is followed: beyond it leaves the object."""


def steep(toward: Any) -> Any:
    """The part of a ray along the normal, kept off 0 where the ray grazes (see :data:`GRAZING`)."""
    return dr.select(dr.abs(toward) > GRAZING, toward, dr.select(toward > 0, GRAZING, -GRAZING))


class Echo(ADIntegrator):
    """Records what each ray meets: range, reflectivity, |cosine|, point, geometric normal, shape, solid angle.

    Channels after the film's own (reflectivity times cosine): those of
    :class:`mitsonar.records.echoes.Echoes`, in its order, all float32. A miss has ``hit`` 0, ``shape_id`` -1 and zero
    elsewhere. Each pixel gets exactly one ray, through its cell (``imaging_sonar``) or its centre (any other sensor),
    whatever the sampler says, so nothing is averaged. The range counts from the sensor's position, also where a camera
    starts its rays at a near plane. With other sensors than ``imaging_sonar`` the solid angle is 0 and ``near_m`` =
    ``far_m`` = ``range_m``.

    Properties: none. Reflectivity of BSDFs that are not diffuse: see :mod:`mitsonar.plugins.surfaces`. It does not
    model multiple bounces, transmission or volumes.

    .. code-block:: xml

        <integrator type="echo"/>
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self._fan: Fan | None = None
        self._origin = mi.Point3f(0)

    @staticmethod
    def measure(scene: mi.Scene, surfaces: Surfaces, ray: mi.Ray3f, fan: Fan, skipped: Any = 0.0) -> Echoes:
        """The echoes of rays that start ``skipped`` metres from the sonar; ``fan.lift`` and ``fan.side`` in world axes.

        On the tangent plane of the point hit, dR/de = -R (n . dd/de) / (n . d), and the same by bearing: this gives the
        range interval of the cell's middle line, wherever in its cell the ray is, so that on a plane cells join
        without gap or overlap also where rays jitter.
        """
        hit = surfaces.hit(scene, ray)
        valid = hit.valid
        toward = dr.dot(hit.n, ray.d)
        cosine = dr.select(dr.abs(toward) < 1, dr.abs(toward), 1)
        range_m = hit.t + skipped
        per_radian = -range_m / steep(toward)
        slope = per_radian * dr.dot(hit.n, fan.lift)
        middle = range_m + per_radian * dr.dot(hit.n, fan.side) * fan.aside
        low, high = middle + slope * fan.below, middle + slope * fan.above
        point = ray.o + ray.d * hit.t

        def kept(value: Any) -> mi.Float:
            return dr.select(valid, value, 0)

        return Echoes(
            hit=dr.select(valid, mi.Float(1), 0),
            range_m=kept(range_m),
            near_m=kept(dr.select(low < high, low, high)),
            far_m=kept(dr.select(low < high, high, low)),
            reflectivity=kept(hit.reflectivity),
            cosine=kept(cosine),
            solid_angle_sr=kept(fan.solid_angle),
            x=kept(point.x),
            y=kept(point.y),
            z=kept(point.z),
            nx=kept(hit.n.x),
            ny=kept(hit.n.y),
            nz=kept(hit.n.z),
            shape_id=dr.select(valid, mi.Float(hit.shape_id), -1),
            object_id=kept(hit.object_id),
        )

    def aov_names(self) -> list[str]:
        """The channels' names."""
        return list(CHANNELS)

    def prepare(self, sensor: mi.Sensor, seed: Any = 0, spp: int = 0, aovs: list[str] | None = None) -> Any:
        """One sample a pixel, whatever is asked."""
        return super().prepare(sensor, seed, 1, aovs or [])

    def sample_rays(self, scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler) -> Any:
        """The one ray of every pixel."""
        size = sensor.film().crop_size()
        index = dr.arange(mi.UInt32, dr.prod(size))
        row, column = index // size.x, index % size.x
        position = mi.Point2f((mi.Float(column) + 0.5) / size.x, (mi.Float(row) + 0.5) / size.y)
        ray, weight = sensor.sample_ray_differential(
            time=sensor.shutter_open(), sample1=0.5, sample2=position, sample3=mi.Point2f(0.5)
        )
        if is_imaging_sonar(sensor):
            self._fan = sensor.film_fan(position).carried(sensor.lines())
        else:
            self._fan = Fan(ray.d, mi.Vector3f(0), mi.Vector3f(0), *(mi.Float(0) for _ in range(5)))
        self._origin = mi.Point3f(sensor.world_transform().translation())
        return ray, weight, mi.Vector2f(mi.Vector2u(column, row)) + mi.Vector2f(sensor.film().crop_offset())

    def sample(self, mode: Any, scene: mi.Scene, sampler: Any, ray: mi.RayDifferential3f, **_: Any) -> Any:
        """Values, validity, channels and no state, as ``ADIntegrator`` wants them."""
        surfaces = Surfaces.of(scene)
        for note in surfaces.notes:
            mi.Log(mi.LogLevel.Warn, note)
        assert self._fan is not None
        skipped = dr.dot(ray.o - self._origin, ray.d)
        echoes = self.measure(scene, surfaces, mi.Ray3f(ray), self._fan, skipped)
        value = mi.Spectrum(echoes.reflectivity * echoes.cosine)
        return value, echoes.hit > 0, [getattr(echoes, name) for name in CHANNELS], None

    def to_string(self) -> str:
        return "Echo[]"


mi.register_integrator("echo", Echo)
