"""Range and expected level of each ray, attached to Dr.Jit's gradients: by pose, reflectivity and vertices.

The level is that of the model ``physical``: C cos dOmega / R^2 times the gain. Derivatives are those of the smooth part:
what a ray hits does not change. Edges that cover and uncover ground (silhouettes) have no part in them.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsonar.acoustics.levels import level
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.simulation.device import DeviceArray
from mitsonar.simulation.tracing import Rays, Tracer

__all__ = ["AttachedEchoes", "attached_echoes"]


@dataclass(frozen=True)
class AttachedEchoes:
    """What each ray of a ping brings back, as Dr.Jit arrays ``(rays,)`` that carry gradients.

    Attributes:
        hit: whether the ray hits.
        range_m: to the surface [m].
        level: of the echo, before any constant gain; 0 where nothing is hit.
        beam: number of the ray's beam.
    """

    hit: DeviceArray
    range_m: DeviceArray
    level: DeviceArray
    beam: DeviceArray


def attached_echoes(scene: mi.Scene, sonar: Sonar, pose: list[mi.Float]) -> AttachedEchoes:
    """Trace one ping whose results can be differentiated.

    Call ``dr.enable_grad`` on the numbers of the pose, or on parameters of the scene (``mi.traverse``: vertices,
    reflectances), before; then ``dr.backward`` or ``dr.forward`` a sum of the results.

    Args:
        scene: to trace.
        sonar: of the model ``physical``; its rays stand in the middle of their cells.
        pose: x, y, z [m], pitch, roll, heading [rad], six ``mi.Float`` of one value.

    Raises:
        MitsonarError: not six numbers, or another model.
    """
    if len(pose) != 6:
        raise MitsonarError(f"a pose is six numbers x, y, z [m], pitch, roll, heading [rad]: got {len(pose)}")
    if sonar.model != "physical":
        raise MitsonarError(f"gradients are those of the model physical: got {sonar.model}; give --model physical")
    still = sonar.replace(jitter=False)
    tracer = Tracer(scene, still)
    rays = Rays(still, Rays.numbered(still, 1))
    fan = tracer.sensor.fan(rays.column, rays.row, mi.UInt32(0))
    ray = mi.Ray3f(mi.Point3f(*pose[:3]), turned(pose, fan.d))
    si: DeviceArray = scene.ray_intersect(ray)
    valid = si.is_valid()
    cosine = dr.abs(dr.dot(si.n, ray.d))
    echoes = _Echo(_reflectivity(si, valid), cosine, fan.solid_angle, dr.select(valid, si.t, still.range_max))
    return AttachedEchoes(valid, si.t, dr.select(valid, level(echoes, still, dr.select), 0), rays.beam)


def _reflectivity(si: mi.SurfaceInteraction3f, active: DeviceArray) -> DeviceArray:
    """Return the diffuse reflectance where rays hit; its luminance where it has colours."""
    spectrum: DeviceArray = si.bsdf().eval_diffuse_reflectance(si, active)
    return mi.luminance(spectrum) if mi.is_rgb else spectrum[0]


@dataclass(frozen=True)
class _Echo:
    """What :func:`mitsonar.acoustics.levels.level` reads of an echo."""

    reflectivity: DeviceArray
    cosine: DeviceArray
    solid_angle_sr: DeviceArray
    range_m: DeviceArray


def turned(pose: list[mi.Float], d: mi.Vector3f) -> mi.Vector3f:
    """Return directions of the sensor's axes (+z forward, +y up, +x port) in the world's, for an attached attitude."""
    (sin_p, cos_p), (sin_r, cos_r), (sin_h, cos_h) = (dr.sincos(angle) for angle in pose[3:])
    starboard: DeviceArray = -d.x
    forward: DeviceArray = d.z
    up: DeviceArray = d.y
    starboard, up = cos_r * starboard + sin_r * up, cos_r * up - sin_r * starboard  # roll, starboard side down
    forward, up = cos_p * forward + sin_p * up, cos_p * up - sin_p * forward  # pitch, bow down
    return mi.Vector3f(cos_h * starboard + sin_h * forward, cos_h * forward - sin_h * starboard, up)
