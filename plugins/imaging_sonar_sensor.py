"""The sensor ``imaging_sonar``: the fans of rays of an imaging sonar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsonar.arrays import DeviceArray
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import sonar_from
from mitsonar.motion.pose import Pose, pose_from_to_world, to_world_matrices
from mitsonar.plugins.hashed_texture import ROUNDS
from mitsonar.plugins.native_plugins import load_dict

__all__ = ["Fan", "ImagingSonar", "is_imaging_sonar"]


@dataclass
class Fan:
    """Rays in the sensor's frame (local +z is the acoustic axis, +y up, +x port).

    Attributes:
        d: unit direction.
        lift: derivative of the direction by elevation.
        side: derivative of the direction by bearing.
        below: elevation of the lower edge of the ray's cell, relative to the ray [rad], <= 0.
        above: elevation of the upper edge, >= 0.
        aside: bearing of the centre of the cell, relative to the ray [rad].
        solid_angle: solid angle of the ray's cell [sr].
        elevation: elevation of the ray [rad].
    """

    d: mi.Vector3f
    lift: mi.Vector3f
    side: mi.Vector3f
    below: DeviceArray
    above: DeviceArray
    aside: DeviceArray
    solid_angle: DeviceArray
    elevation: DeviceArray

    def carried(self, lines: list[mi.Vector4f]) -> Fan:
        """Return the same rays in world axes; ``lines`` are the first three rows of ``to_world``."""
        return replace(self, d=carried(lines, self.d), lift=carried(lines, self.lift), side=carried(lines, self.side))


class ImagingSonar(mi.Sensor):
    """Fans of rays of an imaging sonar, where each pixel of the film is one ray.

    Column ``beam * rays_across + k`` of the film is the k-th ray across a beam, from port to starboard; row 0 is the highest
    elevation. Direction for azimuth or bearing b and elevation e, as (starboard, forward, up): ``bearing: azimuth`` (cos e
    sin b, cos e cos b, sin e); ``bearing: cone``, which a line array measures, (sin b, cos b cos e, cos b sin e).

    Properties: those of :class:`mitsonar.instruments.sonar.Sonar` (``azimuth_fov_deg`` [deg, 29], ``elevation_fov_deg``
    [deg, 14], ``beams`` [96], ``range_min`` [m, 3.2], ``range_max`` [m, 5.6], ``range_bins`` [512], ``sound_speed`` [m/s,
    1500], ``bearing`` [azimuth], ``beam_layout`` [even], ``beam_width_deg`` [deg, the spacing], ``jitter`` [physical: true],
    ``seed`` [0], ``model`` [physical], ``gain_exponent`` [0], ``bounces`` [1], ``frame_rate_hz`` [Hz, 10], ``ping_groups``
    [1], ``group_order`` [interleaved], ``group_interval_s`` [s, 2 range_max / sound_speed + group_overhead_s],
    ``group_overhead_s`` [s, 0]: groups of beams that ping one after another, which ``mitsonar.Simulator`` reads
    (docs/guides/moving.md); ``quality`` [standard]: draft, standard or fine, ``thesis_rays`` [700], ``rays_per_beam`` and
    ``rays_across`` [from quality; in the model ``thesis``, ``thesis_rays`` and one]); of the model ``coherent``, and in part
    of ``physical`` with a pattern: ``frequency_hz`` [Hz], ``bandwidth_hz`` [Hz] or ``pulse_m`` [m, one bin], ``focus_m``
    [m], ``pattern``, ``shading`` [hann], ``elevation_pattern``, ``scatterers_per_cell`` [6], ``scatterer_spacing_m`` [m],
    ``speckle_nu``, ``speckle_patch_m`` [m, 0.1], ``source_level_db`` [0], ``noise_level_db``, ``near_glow_db`` [0],
    ``near_glow_m`` [m, 0.5], ``near_glow_edge_db`` [0], ``near_glow_spread_db`` [0], ``near_glow_still`` [0], ``volume_db``,
    ``absorption_db_per_m``, ``temperature_c`` [10], ``salinity_psu`` [35], ``water_depth_m`` [m, 10], ``ph`` [8],
    ``gain_absorption`` [false], ``tail_db``, ``tail_m`` [m, 0.1], ``crosstalk_db``, ``saturation_db``, ``stripes_db`` [0],
    ``group_stripes_db`` [0], ``taper_db`` [0], ``array_error`` [0], ``detector_offset_db``, ``detector_spread_db`` [0],
    ``coding``, ``coding_db`` [80], ``coding_gamma`` [0.5] (docs/guides/coherent.md); ``preset``:
    name of a preset, whose values the other properties override; ``ping`` [0]: index of the jitter's draw; ``to_world``. A
    film is optional. If given, it must have the size that follows from beams and rays.

    Its rays are those of the models ``physical`` and ``thesis``. The model ``coherent`` traces a separate fan, with beam
    patterns and side lobes. In all models, the sonar is stationary during a ping.

    .. code-block:: xml

        <sensor type="imaging_sonar">
            <string name="preset" value="didson300"/>
            <transform name="to_world">
                <lookat origin="0, 0, 2.5" target="0, 3.57, 0" up="0, 0, 1"/>
            </transform>
        </sensor>
    """

    def __init__(self, props: mi.Properties) -> None:
        self.sonar = _read_sonar(props)
        self.ping = int(cast(int, props.get("ping", 0)))
        if self.ping < 0:
            raise MitsonarError(f"ping must be 0 or more: got {self.ping}")
        if not any(isinstance(child, mi.Film) for _, child in props.objects(mark_queried=False)):
            props["film"] = self._film()
        super().__init__(props)
        self._check_film()
        self.to_world = mi.Transform4f(self.world_transform())
        self.pose  # noqa: B018  rejects a to_world with scaling

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose ``to_world`` to ``mi.traverse``, besides what every sensor has."""
        super().traverse(callback)
        callback.put("to_world", self.to_world, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check ``to_world`` after a change.

        Raises:
            MitsonarError: it scales, shears or mirrors.
        """
        super().parameters_changed(list(keys))
        self.pose  # noqa: B018  rejects scaling

    @property
    def pose(self) -> Pose:
        """Return the pose of the sonar, from ``to_world``."""
        return pose_from_to_world(np.array(dr.detach(self.to_world.matrix), dtype=float).reshape(4, 4))

    def lines(self) -> list[mi.Vector4f]:
        """Return the first three rows of ``to_world``, for :func:`carried`; with derivatives, where it has them."""
        matrix: DeviceArray = self.to_world.matrix
        if dr.grad_enabled(matrix):
            return [mi.Vector4f(*(matrix[row, column] for column in range(4))) for row in range(3)]
        return [mi.Vector4f(*map(float, row)) for row in to_world_matrices(self.pose)[0, :3].astype(np.float32)]

    # ---------------- Directions of the rays

    def fan(self, column: mi.UInt32, row: mi.UInt32, key: mi.UInt32 | None = None) -> Fan:
        """Return the ray of each cell. If the sonar jitters, ``key`` (see :meth:`key`) draws its position in the cell."""
        sonar = self.sonar
        beam, step = column // sonar.across, column % sonar.across
        across, along = self._position_in_cell(row * sonar.columns + column, key)
        return self._fan(self._middle(beam, step), self._level(row), across, along)

    def fan_at(self, beam: mi.UInt32, bearing: DeviceArray, elevation: DeviceArray) -> Fan:
        """Return the rays at bearings in a beam and elevations [rad], in the cells of :meth:`fan`."""
        sonar = self.sonar
        width, height = self._cell()
        step = dr.floor((bearing - self._axis(beam)) / width + sonar.across / 2)
        row = dr.floor(sonar.rays_per_beam / 2 - elevation / height)
        middle, level = self._middle(beam, step), self._level(row)
        return self._fan(middle, level, (bearing - middle) / width + 0.5, (level - elevation) / height + 0.5)

    def _cell(self) -> tuple[float, float]:
        """Return width and height of a cell [rad]."""
        sonar = self.sonar
        return sonar.beam_width_rad / sonar.across, float(np.radians(sonar.elevation_fov_deg) / sonar.rays_per_beam)

    def _middle(self, beam: mi.UInt32, step: DeviceArray) -> mi.Float:
        """Return the bearing of the middle of a cell [rad]."""
        return self._axis(beam) + (mi.Float(step) + (0.5 - self.sonar.across / 2)) * self._cell()[0]

    def _level(self, row: DeviceArray) -> mi.Float:
        """Return the elevation of the middle of a cell [rad]."""
        return (mi.Float(row) + (0.5 - self.sonar.rays_per_beam / 2)) * -self._cell()[1]

    def _fan(self, middle: mi.Float, level: mi.Float, across: DeviceArray, along: DeviceArray) -> Fan:
        """Return rays at positions 0..1 across and down cells, whose middles are given [rad]."""
        sonar = self.sonar
        width, height = self._cell()
        sin_b, cos_b = dr.sincos(middle + (across - 0.5) * width)
        elevation = level - (along - 0.5) * height
        sin_e, cos_e = dr.sincos(elevation)
        # 1. Direction, its derivatives by elevation and bearing, and the exact solid angle of the cell.
        if sonar.bearing == "azimuth":
            d = _local(cos_e * sin_b, cos_e * cos_b, sin_e)
            lift = _local(-sin_e * sin_b, -sin_e * cos_b, cos_e)
            side = _local(cos_e * cos_b, -cos_e * sin_b, mi.Float(0))
            solid_angle = dr.cos(level) * (2 * np.sin(height / 2) * width)
        else:
            d = _local(sin_b, cos_b * cos_e, cos_b * sin_e)
            lift = _local(mi.Float(0), -cos_b * sin_e, cos_b * cos_e)
            side = _local(cos_b, -sin_b * cos_e, -sin_b * sin_e)
            solid_angle = dr.cos(middle) * (2 * np.sin(width / 2) * height)
        # 2. Edges and centre of the cell relative to the ray.
        below, above, aside = (along - 1) * height, along * height, (0.5 - across) * width
        return Fan(d, lift, side, below, above, aside, solid_angle, elevation)

    def key(self, ping: int) -> int:
        """Return a 32-bit key of (seed, ping) for the hash of the jitter."""
        return int(np.random.SeedSequence((self.sonar.seed, ping)).generate_state(1)[0])

    def _axis(self, beam: mi.UInt32) -> mi.Float:
        """Return the bearing of a beam's axis [rad], with the formula of ``Sonar.bearing_rad``."""
        half = float(np.radians(self.sonar.azimuth_fov_deg)) / 2
        part = (mi.Float(beam) + (0.5 - self.sonar.beams / 2)) * (2 / self.sonar.beams)  # -1..1 across the fan
        return part * half if self.sonar.beam_layout == "even" else dr.asin(part * np.sin(half))

    def _position_in_cell(self, ray: DeviceArray, key: DeviceArray | None) -> tuple[mi.Float, mi.Float]:
        """Return the position across and down the cell, 0..1: its centre, or a hash of (seed, ping, ray) with jitter."""
        if key is None or not self.sonar.jittered:
            return mi.Float(0.5), mi.Float(0.5)
        first, second = mi.sample_tea_32(ray, key, ROUNDS)
        return (mi.Float(first >> 8) + 0.5) * 2.0**-24, (mi.Float(second >> 8) + 0.5) * 2.0**-24

    # ---------------- Sensor interface of Mitsuba

    def sample_ray(
        self,
        time: DeviceArray,
        sample1: DeviceArray,
        sample2: mi.Point2f,
        sample3: mi.Point2f,
        active: DeviceArray = True,
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Return the ray of the film cell that contains ``sample2``, with weight 1."""
        fan = self.film_fan(sample2)
        lines = self.lines()
        ray = dr.zeros(mi.Ray3f, dr.width(fan.d))
        ray.o = mi.Point3f(*(line.w for line in lines))
        ray.d = carried(lines, fan.d)
        ray.maxt = dr.largest(mi.Float)  # type: ignore[no-untyped-call]  # Dr.Jit gives it no types
        ray.time = time
        return ray, mi.Spectrum(1.0)

    def sample_ray_differential(
        self,
        time: DeviceArray,
        sample1: DeviceArray,
        sample2: mi.Point2f,
        sample3: mi.Point2f,
        active: DeviceArray = True,
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """Return the same as :meth:`sample_ray`, since sonar rays have no differentials."""
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight

    def film_fan(self, position: mi.Point2f) -> Fan:
        """Return the rays at film positions 0..1."""
        column = mi.UInt32(position.x * self.sonar.columns)
        row = mi.UInt32(position.y * self.sonar.rays_per_beam)
        return self.fan(column, row, dr.opaque(mi.UInt32, self.key(self.ping)))

    def to_string(self) -> str:
        """Return one line for Mitsuba's logs."""
        return f"ImagingSonar[{self.sonar!r}]"

    def _film(self) -> mi.Film:
        film = load_dict(
            {
                "type": "hdrfilm",
                "width": self.sonar.columns,
                "height": self.sonar.rays_per_beam,
                "pixel_format": "luminance",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            }
        )
        return cast(mi.Film, film)

    def _check_film(self) -> None:
        film, expected = self.film(), (self.sonar.columns, self.sonar.rays_per_beam)
        size, crop = (tuple(int(n) for n in film.size()), tuple(int(n) for n in film.crop_size()))
        if size != expected or crop != expected:
            raise MitsonarError(
                f"the film must be {expected[0]} x {expected[1]} pixels, rays side by side x rays over elevation: got "
                f"{crop[0]} x {crop[1]}; remove the film from the sensor, it follows from beams and rays"
            )
        if not film.rfilter().is_box_filter():
            raise MitsonarError(
                "the film must have a box filter, since each pixel is one ray: remove the film from the sensor"
            )


def _read_sonar(props: mi.Properties) -> Sonar:
    names = ("preset", *(name for name in Sonar.model_fields if name != "name"))
    return sonar_from({name: props[name] for name in names if name in props})


def _local(starboard: mi.Float, forward: mi.Float, up: mi.Float) -> mi.Vector3f:
    """Convert (starboard, forward, up) to the sensor's axes."""
    return mi.Vector3f(-starboard, up, forward)


def carried(lines: list[mi.Vector4f], v: mi.Vector3f) -> mi.Vector3f:
    """Rotate a direction from sensor to world axes, with the same products and thus the same bits for every caller."""
    return mi.Vector3f(*(line.x * v.x + line.y * v.y + line.z * v.z for line in lines))


def is_imaging_sonar(sensor: mi.Sensor) -> bool:
    """Return whether a sensor is an imaging sonar, by class name, since each variant creates a new class."""
    return any(base.__name__ == ImagingSonar.__name__ for base in type(sensor).__mro__)


mi.register_sensor("imaging_sonar", ImagingSonar)
