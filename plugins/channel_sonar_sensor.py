"""The sensor ``channel_sonar``: a transmitter and receivers for channel impulse responses."""

from __future__ import annotations

from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from mitsonar.arrays import DeviceArray
from mitsonar.errors import MitsonarError, suggest_names
from mitsonar.instruments.hydrophones import RECEIVER_HEADINGS_DEG, ChannelSonar, FieldOfView, four_receivers
from mitsonar.motion.pose import Pose, pose_from_to_world, to_world_matrices
from mitsonar.plugins.native_plugins import load_dict

__all__ = ["ChannelSensor", "is_channel_sonar"]

FIELD_KEYS = tuple(FieldOfView.model_fields)
SONAR_KEYS = tuple(name for name in ChannelSonar.model_fields if name not in ("transmitter", "receivers"))


class ChannelSensor(mi.Sensor):
    """A transmitter and named receivers between which channel impulse responses are measured.

    Properties: those of :class:`mitsonar.instruments.hydrophones.ChannelSonar` (``carrier_hz`` [Hz, 80000], ``bandwidth_hz``
    [Hz, 4800], ``sampling_hz`` [Hz, 8000], ``frequency_step_hz`` [Hz, 10], ``rolloff`` [0.5], ``range_max`` [m, 25],
    ``sound_speed`` [m/s, 1500], ``frame_rate_hz`` [Hz, 20], ``model`` [scatterers], ``spreading``, ``bounces`` [1],
    ``direct`` [false], ``absorption_db_per_m`` [0], ``points_per_m2`` [1700], ``scatterer_spacing_m`` [m], ``rays`` [50000],
    ``seed`` [0], ``name``); ``receivers`` [front, left, back, right]: names separated by commas; ``to_world``: of the
    vehicle, local +z forward, +y up.

    Fields of view of all receivers: ``shape`` [rectangular], ``tilt_deg`` [deg, 25], ``across_deg`` [deg, 10], ``along_deg``
    [deg, 50], ``taper`` [0.5]. Of one receiver: the same and ``heading_deg``, prefixed with the name of the receiver, as in
    ``front_heading_deg``; and its position, ``front_position`` [m, starboard, forward, up]. Of the transmitter:
    ``transmitter_shape`` [all] and so on.

    By default the receivers front, left, back and right lie 0.1 m from the transmitter and point outwards. Others require a
    heading and a position. As a camera the sensor sends one ray, forward; ``mitsonar impulse`` computes responses. Shadowing
    of the receivers by the vehicle is not modelled. Multiple bounces require mirrors (``--mirrors``).

    .. code-block:: xml

        <sensor type="channel_sonar">
            <string name="receivers" value="front, keel"/>
            <float name="keel_heading_deg" value="90"/>
            <point name="keel_position" value="0.2, 0, -0.1"/>
            <float name="keel_across_deg" value="4"/>
            <float name="carrier_hz" value="80000"/>
            <transform name="to_world">
                <lookat origin="0, 0, 10" target="0, 1, 10" up="0, 0, 1"/>
            </transform>
        </sensor>
    """

    def __init__(self, props: mi.Properties) -> None:
        self.sonar = _read(props)
        if not any(isinstance(child, mi.Film) for _, child in props.objects(mark_queried=False)):
            one = {"type": "hdrfilm", "width": 1, "height": 1, "pixel_format": "luminance", "rfilter": {"type": "box"}}
            props["film"] = load_dict(one)
        super().__init__(props)
        self.pose  # noqa: B018  rejects a to_world with scaling

    @property
    def pose(self) -> Pose:
        """Return the pose of the vehicle, from ``to_world``."""
        return pose_from_to_world(np.array(self.world_transform().matrix, dtype=float).reshape(4, 4))

    def sample_ray(
        self,
        time: DeviceArray,
        sample1: DeviceArray,
        sample2: mi.Point2f,
        sample3: mi.Point2f,
        active: DeviceArray = True,
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Return a forward ray with weight 1."""
        matrix = to_world_matrices(self.pose)[0]
        ray = dr.zeros(mi.Ray3f, dr.width(sample2))
        ray.o, ray.d = mi.Point3f(*map(float, matrix[:3, 3])), mi.Vector3f(*map(float, matrix[:3, 2]))
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
        """Return the same as :meth:`sample_ray`."""
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight

    def to_string(self) -> str:
        """Return one line for Mitsuba's logs."""
        return f"ChannelSensor[{self.sonar!r}]"


def is_channel_sonar(sensor: mi.Sensor) -> bool:
    """Return whether a sensor is a channel sonar, by class name, since each variant creates a new class."""
    return any(base.__name__ == ChannelSensor.__name__ for base in type(sensor).__mro__)


def _read(props: mi.Properties) -> ChannelSonar:
    """Create the instrument from the properties."""
    fields = _some(props, SONAR_KEYS)
    shared = _some(props, tuple(name for name in FIELD_KEYS if name != "heading_deg"))
    transmitter = {"shape": "all", **_some(props, FIELD_KEYS, "transmitter_")}
    names = [name.strip() for name in str(props.get("receivers", ", ".join(RECEIVER_HEADINGS_DEG))).split(",")]
    known = {one.name: one.model_dump() for one in four_receivers()}
    receivers = []
    for name in names:
        field_keys = _some(props, FIELD_KEYS, f"{name}_")
        if not name.isidentifier():
            raise MitsonarError(
                f"receivers must be names separated by commas, such as 'bow, port': got {props['receivers']!r}"
            )
        receiver = known.get(name, {"name": name, "field": {}})
        if f"{name}_position" in props:
            receiver["position"] = _position(f"{name}_position", props[f"{name}_position"])
        receivers.append({**receiver, "field": {**receiver["field"], **shared, **field_keys}})
        missing = [
            key
            for key, there in (("heading_deg", "heading_deg" in field_keys), ("position", "position" in receiver))
            if not there
        ]
        if name not in known and missing:
            _refuse_unknown(props, names)
            keys = " and ".join(f"{name}_{key}" for key in missing)
            raise MitsonarError(
                f"receiver {name!r} needs a position and a heading: give {keys} (position: a point, starboard, forward, "
                "up in m; heading: 0 forward, 90 to starboard); front, left, back and right have defaults"
            )
    _refuse_unknown(props, names)
    return ChannelSonar.create(**fields, transmitter=transmitter, receivers=receivers)


def _position(key: str, value: object) -> tuple[float, ...]:
    """Parse three numbers from a point, or from comma-separated text."""
    try:
        given = value.replace(",", " ").split() if isinstance(value, str) else np.ravel(cast(ArrayLike, value))
        position = tuple(float(number) for number in given)
    except (TypeError, ValueError):
        position = ()
    if len(position) != 3:
        example = f'<point name="{key}" value="0, 0.3, 0"/>'
        raise MitsonarError(f"{key} must be a point, starboard, forward, up in m, such as {example}: got {value!r}")
    return position


def _refuse_unknown(props: mi.Properties, names: list[str]) -> None:
    """Check that the sensor knows all given properties.

    Raises:
        MitsonarError: an unknown property.
    """
    known = {*SONAR_KEYS, *FIELD_KEYS, "receivers", "to_world", "id", *(f"transmitter_{key}" for key in FIELD_KEYS)} - {
        "heading_deg"
    }
    known |= {f"{name}_{key}" for name in names for key in (*FIELD_KEYS, "position")}
    for key in props:
        if key not in known and props.type(key) not in (mi.Properties.Type.Object, mi.Properties.Type.Reference):
            raise MitsonarError(f"the sensor channel_sonar has no property {key!r}: {suggest_names(key, sorted(known))}")


def _some(props: mi.Properties, names: tuple[str, ...], before: str = "") -> dict[str, object]:
    """Return those of the named properties that are given."""
    return {name: props[before + name] for name in names if before + name in props}


mi.register_sensor("channel_sonar", ChannelSensor)
