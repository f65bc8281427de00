"""Levels of coherent pings in dB re 1 uPa: the sonar equation for every preset, and what noise leaves of the grain."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from coherent_scenes import POSE, SONAR, imager
from helpers import Array, diffuse, essence, floor, scene
from scipy import special
from scipy.ndimage import uniform_filter

from mitsonar.acoustics.water import gain_of, sonar_absorption
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import named_sonars, preset
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside the window")]

MU = 0.1
SOURCE_DB = 210.0


@pytest.fixture(scope="module")
def flat(variant: str) -> mi.Scene:
    return scene(floor=floor(diffuse(MU)))


# ---------------------------------------------------------------- the sonar equation


def narrow(name: str) -> Sonar:
    """A preset's carrier, window, pulse, beams, water and gain; 12 deg of its fan, a hard edge over 40 deg of elevation."""
    base = preset(name)
    return base.replace(
        model="coherent", frequency_hz=base.frequency_hz or 1e6, source_level_db=SOURCE_DB, coding="dB", coding_db=200.0,
        elevation_pattern="box", elevation_fov_deg=40.0, azimuth_fov_deg=12.0, beam_layout="even",
        beams=max(8, round(12 * base.beams / base.azimuth_fov_deg)), beam_width_deg=math.degrees(base.beam_width_rad),
        ping_groups=1,
        noise_level_db=None, near_glow_db=0.0, volume_db=None, stripes_db=0.0, crosstalk_db=None, speckle_nu=None,
        scatterers_per_cell=12.0,
    )  # fmt: skip


def floor_echo_db(sonar: Sonar, height: float) -> Array:
    """EL = SL - 40 log R - 2 alpha R + 10 log(mu sin^2 g dA) of each bin ``(bins,)``, written here.

    A beam of width w and a bin of length dr light w R dr / cos g of a floor ``height`` below; sin g = height / R.
    """
    r = sonar.range_m
    sine = np.minimum(height / r, 0.999)
    area = sonar.beam_width_rad * r * sonar.bin_m / np.sqrt(1 - sine**2)
    strength = 10 * np.log10(MU * sine**2 * area)
    return np.asarray(SOURCE_DB - 40 * np.log10(r) - 2 * sonar_absorption(sonar) * r + strength)


PRESETS = sorted(set(named_sonars()) - {"lookdown100"})


@pytest.mark.thorough
@pytest.mark.parametrize("name", essence(PRESETS, "blueview-p900-45", rest=pytest.mark.slow))
@pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")
def test_the_sonar_equation_holds_for_every_preset(flat: mi.Scene, name: str) -> None:
    """Values of frames, read as dB re 1 uPa, less the gain: 0.5 dB in each of up to ten parts of the lit ranges, 1 to 40 m.

    The floor lies so far below that it is met at 8.6 to 42 deg; other heights light the nearer ranges. A part holds some
    1,500 independent cells, whose mean is known to 0.13 dB.
    """
    sonar = narrow(name)
    simulator, r = Simulator(flat, sonar), sonar.range_m
    height, pings, tested = 0.15 * min(40.0, sonar.range_max), 8, []
    while height / 0.15 > max(1.0, 1.1 * sonar.range_min):
        poses = [[0.6 * k, 0.2 * k, height, math.radians(27), 0, 0] for k in range(pings)]
        lit = np.flatnonzero((r > 1.5 * height) & (r < height / 0.152) & (r > 1.0) & (r < 40.0))
        expected = 10 ** (floor_echo_db(sonar, height) / 10)
        brightest = (expected * gain_of(sonar))[r > 1.2 * height].max() * 10 ** (-SOURCE_DB / 10)
        frames = simulator.render(np.array(poses), gain=1e-3 / brightest)  # so low that no pixel is at the maximum
        low, high = frames.decibels_of(0), frames.decibels_of(1)
        power = 10 ** ((low + frames.image.astype(float) * (high - low)) / 10) / gain_of(sonar)[:, None]
        ratio = power / expected[:, None]
        cells = len(lit) * pings * math.radians(12) / sonar.beam_width_rad * min(1.0, sonar.bin_m / sonar.resolution_m)
        for part in np.array_split(lit, max(1, min(10, round(cells / 1500)))) if len(lit) else []:
            error = 10 * np.log10(ratio[:, part].mean())
            assert abs(error) < 0.5, f"{name}: {error:+.2f} dB at {r[part[0]]:.2f}..{r[part[-1]]:.2f} m, height {height:g} m"
        tested += [float(r[lit[0]]), float(r[lit[-1]])] if len(lit) else []
        height, pings = height * 0.15 * 1.5, pings * 2  # near the sonar cells are small and hold few points
    assert tested
    assert max(tested) > 0.9 * min(40.0, sonar.range_max)
    assert min(tested) < 1.6 * max(1.0, sonar.range_min)


# ---------------------------------------------------------------- noise and grain


@pytest.mark.parametrize("above_db", essence([20.0, 10.0, 0.0], 10.0))
def test_detrended_correlation_by_level(flat: mi.Scene, above_db: float) -> None:
    """A still sonar's pings, less the local mean of 31 x 9 cells: bright grain stays, grain at the noise's level goes.

    The echo's share of the power is r. Two complex Gaussian fields that agree by r have intensities that correlate by r^2,
    and levels in dB by Li2(r^2) / (pi^2 / 6): 0.98 and 0.94 at 20 dB, 0.25 and 0.16 at 0 dB. Within 0.03.
    """
    level = 10 * math.log10(float((np.abs(imager(flat).image(POSE, 0)[0]) ** 2).mean()))
    source = imager(flat, SONAR.replace(noise_level_db=level - above_db))
    result = []
    for step in range(6):
        pose = POSE + step * np.array([0.7, 0.2, 0, 0, 0, 0])
        power = [np.abs(source.image(pose, 2 * step + k)[0]).astype(float) ** 2 for k in (0, 1)]
        grain = [one / uniform_filter(one, (31, 9)) for one in power]
        logs = [np.log(one) for one in power]
        logs = [one - uniform_filter(one, (31, 9)) for one in logs]
        result.append([np.corrcoef(*(one.ravel() for one in pair))[0, 1] for pair in (grain, logs)])
    intensity, decibels = np.mean(result, axis=0)
    agreement = (1 + 10 ** (-above_db / 10)) ** -2
    assert intensity == pytest.approx(agreement, abs=0.03)
    assert decibels == pytest.approx(special.spence(1 - agreement) / (math.pi**2 / 6), abs=0.03)


def test_a_gain_beyond_single_precision_is_refused(flat: mi.Scene) -> None:
    """2.84 dB/m at 3 MHz, 100 m there and back: from 68 m on, noise times gain would be infinite."""
    sonar = SONAR.replace(frequency_hz=3e6, absorption_db_per_m=None, gain_absorption=True, range_max=100.0)
    with pytest.raises(MitsonarError, match=r"568\.8 dB there and back to range_max 100 m"):
        Simulator(flat, sonar)
    Simulator(flat, sonar.replace(range_max=20.0))
