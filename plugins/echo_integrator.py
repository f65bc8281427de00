"""The integrator ``echo``: one ray per pixel, and what it meets."""

from __future__ import annotations

from typing import cast

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator

from mitsonar.arrays import DeviceArray
from mitsonar.errors import MitsonarError
from mitsonar.plugins.imaging_sonar_sensor import Fan, ImagingSonar, is_imaging_sonar
from mitsonar.plugins.surfaces import Hit, Surfaces
from mitsonar.records.echoes import CHANNELS, Echoes

__all__ = ["GRAZING", "Echo", "edge_direction", "flatter", "steep"]

GRAZING = 0.02
"""Sine of the grazing angle (1.1 deg) down to which a cell is extended along its tangent plane without a check.

At smaller angles the plane may leave the body.
"""

LEVEL = 0.01
"""Sine of the largest angle to the tangent plane at which the line to an edge stays on the surface of the hit point."""


def steep(toward: DeviceArray) -> DeviceArray:
    """Return the component of a ray along the normal, bounded away from 0 for grazing rays (see :data:`GRAZING`)."""
    size: DeviceArray = dr.abs(toward)
    return dr.select(size > GRAZING, toward, dr.select(toward > 0, GRAZING, -GRAZING))


def edge_direction(fan: Fan, angle: DeviceArray) -> DeviceArray:
    """Return the unit direction to the middle of a cell's edge, ``angle`` above the ray [rad], to first order."""
    return dr.normalize(fan.d + fan.side * fan.aside + fan.lift * angle)


def flatter(normal: DeviceArray, d: DeviceArray, direction: DeviceArray) -> DeviceArray:
    """Return whether a direction meets the tangent plane of the ray ``d`` below :data:`GRAZING`, or misses it."""
    return dr.dot(normal, direction) * dr.select(dr.dot(normal, d) > 0, 1, -1) <= GRAZING


class Echo(ADIntegrator):
    """Record what each ray meets: range, reflectivity, |cosine|, point, geometric normal, shape, solid angle.

    The film's main channel holds reflectivity times cosine. It is followed by the channels of
    :class:`mitsonar.records.echoes.Echoes`, in its order, all float32. A miss has ``hit`` 0, ``shape_id`` -1 and zero
    elsewhere. Each pixel gets exactly one ray, whatever the sampler requests, so nothing is averaged. The ray passes through
    the pixel's cell (``imaging_sonar``) or its centre (any other sensor). The range is measured from the sensor's position,
    even if a camera starts its rays at a near plane. With sensors other than ``imaging_sonar`` the solid angle is 0 and
    ``near_m`` = ``far_m`` = ``range_m``.

    Properties: none. For the reflectivity of BSDFs that are not diffuse, see :mod:`mitsonar.plugins.surfaces`. Multiple
    bounces, transmission and volumes are not modelled.

    .. code-block:: xml

        <integrator type="echo"/>
    """

    def __init__(self, props: mi.Properties) -> None:
        if given := list(props.keys()):  # check before the base class reads max_depth, rr_depth and hide_emitters
            raise MitsonarError(f"the integrator echo has no properties: got {', '.join(given)}; leave them out")
        super().__init__(props)  # type: ignore[no-untyped-call]  # Mitsuba's own class has no types
        self._fan: Fan | None = None
        self._sensor: ImagingSonar | None = None
        self._position = mi.Point2f(0)
        self._origin = mi.Point3f(0)

    @staticmethod
    def measure(
        scene: mi.Scene,
        surfaces: Surfaces,
        ray: mi.Ray3f,
        fan: Fan,
        skipped: DeviceArray = 0.0,
        *,
        edges: bool = False,
        attached: bool = False,
    ) -> Echoes:
        """Return the echoes of rays as arrays that are not evaluated yet.

        The range interval of a cell is that of its centre line, wherever the ray lies within the cell: see
        :func:`_interval`.

        Args:
            scene: scene to trace.
            surfaces: tables of that scene.
            ray: one ray per cell, in world axes.
            fan: the same rays; ``lift`` and ``side`` in world axes.
            skipped: distance from the sonar to where each ray starts [m].
            edges: whether grazing edges of cells are traced (:func:`_meets`), as sums over footprints require.
            attached: whether echoes carry derivatives by ray, geometry and reflectance, along each ray: silhouettes do not
                move.
        """
        hit = surfaces.hit(scene, ray, attached=attached)
        valid = hit.valid
        # Cosine of incidence, clipped against rounding, and the ranges of the cell's edges on the tangent plane.
        toward = dr.dot(hit.n, ray.d)
        cosine = dr.select(dr.abs(toward) < 1, dr.abs(toward), 1)
        range_m = hit.t + skipped
        low, high = _interval(fan, hit, range_m)
        # At grazing incidence the tangent plane may leave the body, so trace the edges.
        if edges:
            low = _meets(scene, ray, fan, hit, fan.below, low, attached)
            high = _meets(scene, ray, fan, hit, fan.above, high, attached)
        point = ray.o + ray.d * hit.t

        def masked(value: DeviceArray) -> DeviceArray:
            return dr.select(valid, value, 0)

        return Echoes(
            hit=dr.select(valid, mi.Float(1), 0),
            range_m=masked(range_m),
            near_m=masked(dr.select(low < high, low, high)),
            far_m=masked(dr.select(low < high, high, low)),
            reflectivity=masked(hit.reflectivity),
            cosine=masked(cosine),
            solid_angle_sr=masked(fan.solid_angle),
            x=masked(point.x),
            y=masked(point.y),
            z=masked(point.z),
            nx=masked(hit.n.x),
            ny=masked(hit.n.y),
            nz=masked(hit.n.z),
            shape_id=dr.select(valid, mi.Float(hit.shape_id), -1),
            object_id=masked(hit.object_id),
        )

    def aov_names(self) -> list[str]:
        """Return the names of the channels."""
        return list(CHANNELS)

    def prepare(
        self, sensor: mi.Sensor, seed: DeviceArray = 0, spp: int = 0, aovs: list[str] | None = None
    ) -> tuple[mi.Sampler, int]:
        """Prepare one sample per pixel, whatever ``spp`` is requested."""
        sampler, samples = super().prepare(sensor, seed, 1, aovs or [])
        return sampler, samples

    def sample_rays(
        self, scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum, mi.Vector2f]:
        """Return one ray per pixel, its weight, and its film position in pixels."""
        size = sensor.film().crop_size()
        index = dr.arange(mi.UInt32, dr.prod(size))
        row, column = index // size.x, index % size.x
        position = mi.Point2f((mi.Float(column) + 0.5) / size.x, (mi.Float(row) + 0.5) / size.y)
        time: DeviceArray = sensor.shutter_open()
        half: DeviceArray = 0.5
        ray, weight = sensor.sample_ray_differential(time=time, sample1=half, sample2=position, sample3=mi.Point2f(0.5))
        if is_imaging_sonar(sensor):
            self._sensor, self._position, self._origin = cast(ImagingSonar, sensor), position, ray.o
        else:
            self._fan = Fan(ray.d, mi.Vector3f(0), mi.Vector3f(0), *(mi.Float(0) for _ in range(5)))
            self._sensor = None
            self._origin = mi.Point3f(sensor.world_transform().translation())
        return ray, weight, mi.Vector2f(mi.Vector2u(column, row)) + mi.Vector2f(sensor.film().crop_offset())

    def sample(  # type: ignore[override]  # ADIntegrator.sample overrides its own parent with other arguments
        self, mode: object, scene: mi.Scene, sampler: mi.Sampler, ray: mi.RayDifferential3f, **_: object
    ) -> tuple[mi.Spectrum, DeviceArray, list[DeviceArray], None]:
        """Return values, validity, channels and no state, as ``ADIntegrator`` expects them."""
        attached, sonar = mode != dr.ADMode.Primal, self._sensor
        surfaces, fan, place = Surfaces.from_scene(scene), self._fan, mi.Ray3f(ray)
        if sonar is not None:
            # the rays of sample_rays have no derivatives by the pose of the sensor
            surfaces, lines = surfaces.at_frequency_of(sonar.sonar), sonar.lines()
            fan = sonar.film_fan(self._position).carried(lines)
            place.o, place.d = mi.Point3f(*(line.w for line in lines)), fan.d
        for note in surfaces.notes:
            mi.Log(mi.LogLevel.Warn, note)  # type: ignore[operator]  # an `object` to Mitsuba's stubs
        assert fan is not None
        offset: DeviceArray = ray.o - self._origin
        skipped = dr.dot(offset, ray.d)
        edges = sonar is not None and sonar.sonar.model == "physical"
        echoes = self.measure(scene, surfaces, place, fan, skipped, edges=edges, attached=attached)
        value = mi.Spectrum(echoes.reflectivity * echoes.cosine)
        return value, echoes.hit > 0, [getattr(echoes, name) for name in CHANNELS], None

    def to_string(self) -> str:
        """Return one line for Mitsuba's logs."""
        return "Echo[]"


def _interval(fan: Fan, hit: Hit, range_m: DeviceArray) -> tuple[DeviceArray, DeviceArray]:
    """Return the ranges of a cell's lower and upper edge on the tangent plane of the hit point [m].

    There dR/de = -R (n . dd/de) / (n . d), and the same for bearing. On a plane, cells therefore join without gaps or
    overlaps, even if rays are jittered, as long as cells are short along range. The slope is limited to that at
    :data:`GRAZING`: beyond the end of a body, a cell extends by R de / GRAZING.
    """
    per_radian = -range_m / steep(dr.dot(hit.n, fan.d))
    slope = per_radian * dr.dot(hit.n, fan.lift)
    middle = range_m + per_radian * dr.dot(hit.n, fan.side) * fan.aside
    return middle + slope * fan.below, middle + slope * fan.above


def _meets(
    scene: mi.Scene,
    ray: mi.Ray3f,
    fan: Fan,
    hit: Hit,
    angle: DeviceArray,
    otherwise: DeviceArray,
    attached: bool,
) -> DeviceArray:
    """Return where a grazing edge of a cell meets the surface that its ray met [m], or else ``otherwise``.

    The point on the edge counts if the line to it lies within :data:`LEVEL` of the tangent plane. An edge is the same ray
    for both of its cells, so they join.
    """
    direction = edge_direction(fan, angle)
    grazing = hit.valid & flatter(hit.n, ray.d, direction)
    coherent: DeviceArray = True
    edge = mi.Ray3f(ray.o, direction, ray.time)
    intersection = scene.ray_intersect_preliminary(edge, coherent=coherent, active=grazing)
    valid, t = grazing & intersection.is_valid(), intersection.t
    if attached:
        t = intersection.compute_surface_interaction(edge, mi.RayFlags.Minimal, valid).t
    along: DeviceArray = direction * t - ray.d * hit.t
    level = dr.abs(dr.dot(hit.n, along)) <= LEVEL * dr.norm(along)
    return dr.select(valid & level, t, otherwise)


mi.register_integrator("echo", Echo)
