"""Sonar images with derivatives: the channels of the integrator ``echo``, binned as by the model ``physical``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsonar.acoustics.levels import level
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.records.echoes import CHANNELS, Echoes
from mitsonar.simulation.device import DeviceArray

__all__ = ["expected_levels"]


def expected_levels(image: mi.TensorXf, sonar: Sonar) -> mi.TensorXf:
    """Compute the expected levels of a sonar image from a rendering of its echoes, with the derivatives that it carries.

    The levels are those of ``Simulator`` in the model ``physical`` before the gain of the run: C cos dOmega / R^2 times the
    gain over range, spread evenly over the ranges of each ray's cell. Derivatives are along rays; silhouettes stay.

    Args:
        image: result of ``mi.render`` with the integrator ``echo`` and an ``imaging_sonar`` ``(rows, columns, channels)``.
        sonar: this sonar, from :func:`mitsonar.sonar_in`.

    Returns:
        Levels ``(bins, beams)``.

    Raises:
        MitsonarError: another model, a beam pattern, several reflections, or an image of another sonar or integrator.
    """
    from mitsonar.simulation.models.thesis import footprint  # needs a variant

    # 1. Channels of the rays, in double precision.
    shape = (sonar.rays_per_beam, sonar.columns, 1 + len(CHANNELS))
    if sonar.model != "physical" or sonar.beam_pattern != "box" or sonar.bounces != 1:
        raise MitsonarError(
            f"levels with derivatives are those of the model physical without pattern and bounces: got model {sonar.model}, "
            f"beam pattern {sonar.beam_pattern}, bounces {sonar.bounces}; load the scene with model=physical"
        )
    if tuple(image.shape) != shape:
        raise MitsonarError(
            f"the image must be (rays over elevation, rays across, channels of echo) = {shape}: got {tuple(image.shape)}; "
            "render the sonar with the integrator echo and spp=1"
        )
    ray = dr.arange(mi.UInt32, shape[0] * shape[1])
    values = {name: dr.gather(mi.Float, image.array, ray * shape[2] + (1 + k)) for k, name in enumerate(CHANNELS)}
    echoes = Echoes(**{name: mi.Float64(value) for name, value in values.items()})
    hit, beam = echoes.hit > 0, ray % sonar.columns // sonar.across
    # 2. Density of each footprint, and its ends in the window.
    begin, end, length = footprint(echoes, sonar)
    density = dr.select(hit, level(echoes, sonar, dr.select) / length, 0)
    # 3. A footprint is a step up at its begin and a step down at its end; their running sum is the share of each bin.
    steps = dr.zeros(mi.Float64, (sonar.range_bins + 2) * sonar.beams)
    for place, height in ((begin, density), (end, -density)):
        inside: DeviceArray = dr.clip(place, 0, sonar.range_bins)
        first, part = dr.floor(inside), inside - dr.floor(inside)
        for offset, share in ((0, 1 - part), (1, part)):
            where = (mi.UInt32(first) + offset) * sonar.beams + beam
            dr.scatter_reduce(dr.ReduceOp.Add, steps, height * share, where, hit)
    tensor: DeviceArray = dr.tensor_t(mi.Float64)
    sums = dr.cumsum(tensor(steps, (sonar.range_bins + 2, sonar.beams)), axis=0)
    return mi.TensorXf(mi.Float(sums.array), sums.shape)[: sonar.range_bins]
