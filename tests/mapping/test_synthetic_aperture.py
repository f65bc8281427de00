"""Synthetic apertures: point responses and speckle by closed forms, exact delays, refusals, files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from aperture_scenes import BAND_HZ, ELEMENT, HEIGHT, C, array, responses_of, track
from helpers import diffuse, floor, scene

from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import FieldOfView, side_looking_array
from mitsonar.mapping.synthetic_aperture import BackProjector, focus, point_response, refuse_aliased, strip_grid
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.records.responses import ImpulseResponses
from mitsonar.records.strips import StripGrid, StripImage

pytestmark = pytest.mark.usefixtures("variant")

PLACE = (15.0, 6.0, 0.0)
AROUND = StripGrid(0, 0, 0, 0, 5.0, 0.0125, 161, 14.0, 0.0125, 161)
"""Pixels 1 m around the point at 15 m to starboard, 6 m along."""

TO_RANGE = 15.0 / np.hypot(15.0, HEIGHT)
"""Slant range per ground range at the point."""


@pytest.fixture(scope="module")
def point() -> ImpulseResponses:
    return responses_of(array(absorption_db_per_m=0.04), track(60, 0.2), PLACE, 2 * np.exp(0.7j))


def cuts(image: StripImage) -> tuple[tuple[int, int], np.ndarray, np.ndarray]:
    row, column = np.unravel_index(np.abs(image.value).argmax(), image.value.shape)
    return (int(row), int(column)), image.value[:, column], image.value[row]


# ---------------------------------------------------------------- point response


def test_a_point_is_a_sinc_of_half_an_element_and_of_the_band(point: ImpulseResponses) -> None:
    """First nulls at D / 2 and c / 2B: widths of 0.886 of these at half power, side lobes of -13.3 dB."""
    image = focus(point, AROUND)
    (row, column), along, across = cuts(image)
    assert (row, column) == (80, 80)
    for cut, resolution in ((along, ELEMENT / 2), (across, C / (2 * BAND_HZ) / TO_RANGE)):
        measured = point_response(cut, 0.0125)
        assert measured.width_m == pytest.approx(0.8859 * resolution, rel=0.01)
        assert measured.side_lobe_db == pytest.approx(-13.26, abs=0.5)
    # spreading, absorption and pattern are undone: amplitude and phase are the point's
    assert image.value[80, 80] == pytest.approx(2 * np.exp(0.7j), rel=0.01)


def test_a_hann_window_lowers_the_side_lobes(point: ImpulseResponses) -> None:
    image = focus(point, AROUND, weighting="hann")
    for cut, resolution in zip(cuts(image)[1:], (ELEMENT / 2, C / (2 * BAND_HZ) / TO_RANGE), strict=True):
        measured = point_response(cut, 0.0125)
        assert measured.side_lobe_db == pytest.approx(-31.5, abs=1.5)
        assert measured.width_m == pytest.approx(1.44 * resolution, rel=0.02)
    assert image.value[80, 80] == pytest.approx(2 * np.exp(0.7j), rel=0.01)


def test_the_width_does_not_depend_on_range() -> None:
    for far in (10.0, 20.0):
        grid = replace(AROUND, across_start_m=far, columns=1)
        found = responses_of(array(), track(60, 0.2), (far, 6.0, 0.0), 1.0)
        assert point_response(focus(found, grid).value[:, 0], 0.0125).width_m == pytest.approx(0.0443, rel=0.02)


def test_port_is_the_mirror_of_starboard() -> None:
    port = side_looking_array(ELEMENT, 4, carrier_hz=100e3, bandwidth_hz=BAND_HZ, range_max=25.0, side="port")
    flown = track(60, 0.2)
    image = focus(
        responses_of(port, flown, (-15.0, 6.0, 0.0), 1.0), replace(AROUND, across_start_m=-14, across_step_m=-0.0125)
    )
    assert cuts(image)[0] == (80, 80)
    assert strip_grid(responses_of(port, flown, (-15.0, 6.0, 0.0), 1.0)).across_m[-1] < -20


def test_a_turned_and_climbing_path_focuses_where_the_point_is() -> None:
    """Heading 30 deg, 4 deg of crab, 0.3 m of climb: the grid turns with the track, and the phase follows."""
    flown = track(60, 0.2)
    turn = np.radians(30)
    poses = flown.poses.copy()
    poses[:, :2] = poses[:, :2] @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    poses[:, 2] += np.linspace(0, 0.3, 60)
    poses[:, 5] = turn + np.radians(4)
    place = np.array([15 * np.cos(turn) + 6 * np.sin(turn), -15 * np.sin(turn) + 6 * np.cos(turn), 0.0])
    found = responses_of(array(), Trajectory(poses, flown.time_s), place, 1.0)
    image = focus(found, replace(AROUND, heading_rad=turn))
    assert cuts(image)[0] == (80, 80)
    assert abs(image.value[80, 80]) == pytest.approx(1.0, rel=0.02)
    assert strip_grid(found).heading_rad == pytest.approx(turn, abs=1e-3)


def test_motion_while_the_sound_travels_is_followed(point: ImpulseResponses) -> None:
    """At 6 m/s, stop-and-hop would misplace the point by half of the way that the receiver moves: v tau / 2."""
    fast = responses_of(array(), track(60, 0.2, every_s=0.2 / 6), PLACE, 1.0)
    exact = focus(fast, AROUND)
    assert cuts(exact)[0] == (80, 80)
    assert abs(exact.value[80, 80]) == pytest.approx(1.0, rel=0.01)
    stopped = focus(replace(fast, velocity=np.zeros((60, 4))), AROUND)
    moved = (cuts(stopped)[0][0] - 80) * 0.0125
    delay = 2 * np.hypot(15, HEIGHT) / C
    assert abs(moved) == pytest.approx(6 * delay / 2, abs=0.0125)


def test_blocks_are_those_of_the_whole(point: ImpulseResponses) -> None:
    projector = BackProjector(point, AROUND)
    whole = projector.block(slice(0, 161))
    np.testing.assert_array_equal(np.concatenate([block for _, block in projector.blocks()]), whole)
    np.testing.assert_array_equal(projector.block(slice(64, 128)), whole[64:128])


def test_interpolation_between_taps_is_band_limited() -> None:
    """A pulse whose spectrum fills the band, at delays between the taps: within -50 dB of the closed form."""
    sonar = array()
    delays = 0.02 + np.arange(7) / 7 / sonar.sampling_hz
    found = responses_of(sonar, track(60, 0.2), PLACE, 1.0)
    projector = BackProjector(found, AROUND)
    for delay in delays:
        response = sonar.pulse(sonar.delay_s - delay).astype(np.complex64)
        projector.responses = replace(found, response=np.broadcast_to(response, found.response.shape))
        fine = projector.taps(0)[0] / np.where(projector._gain > 0, projector._gain, 1)
        away = np.arange(len(fine)) / (sonar.sampling_hz * 16) - delay
        near = np.abs(away) < 40 / BAND_HZ
        # the droop of linear interpolation is undone in advance: interpolate halfway between fine taps
        middle = (fine[:-1] + fine[1:]) / 2
        expected = sonar.pulse(away[:-1] + 0.5 / (sonar.sampling_hz * 16))
        assert np.abs(middle - expected)[near[:-1]].max() < 10 ** (-50 / 20) * sonar.pulse(np.zeros(1))[0]


# ---------------------------------------------------------------- speckle of the simulator


@pytest.mark.thorough
def test_even_ground_is_speckle_of_contrast_one_at_the_level_of_its_cells() -> None:
    """Mean C sin^2(grazing) times the cell, 1.5 D / 2 and 1.5 c / 2B over cos(grazing) (Hann); deviation over mean 1.

    With uniform weights, the edges of the beam fold and add a quarter to the mean.
    """
    from mitsonar.simulation.channel import ChannelSimulator

    sonar = side_looking_array(
        0.2, 4, carrier_hz=60e3, bandwidth_hz=10e3, range_max=14.0, points_per_m2=3000, absorption_db_per_m=0.02
    )
    flown = Trajectory(
        np.column_stack([np.zeros(26), np.arange(26) * 0.4, np.full(26, 5.0), np.zeros((26, 3))]), np.arange(26) / 5
    )
    ground = scene(floor=floor(diffuse(0.3), 15.0))
    simulator = ChannelSimulator(ground, sonar, within=sonar.box_seen_from(flown.poses))
    measured = simulator.responses(flown, velocities(flown))
    grid = StripGrid(0, 0, 0, 0, 2.5, 0.1, 51, 9.5, 0.1, 26)  # spaced by the resolution along the track
    power = np.abs(focus(measured, grid, weighting="hann").value.astype(complex)) ** 2
    sine = 5.0 / np.hypot(grid.across_m, 5.0)
    expected = 0.3 * sine**2 * 1.5**2 * 0.1 * C / (2 * 10e3) / np.sqrt(1 - sine**2)
    share = power / expected
    assert share.mean() == pytest.approx(1.0, abs=0.12)  # of some 800 cells, which vary by 0.04

    assert (share.std() / share.mean()) == pytest.approx(1.0, abs=0.12)


# ---------------------------------------------------------------- what cannot work


def test_an_aliased_aperture_is_refused_with_what_would_do() -> None:
    found = responses_of(array(), track(30, 0.4), PLACE, 1.0)
    with pytest.raises(
        MitsonarError,
        match=r"up to 0\.25 m apart.*needs 0\.05 m.*pings 0\.2 m apart, 59 on this path \(30 are.*at most 2 m/s.*8 receiv",
    ):
        focus(found, AROUND)
    refuse_aliased(responses_of(array(8), track(30, 0.4), PLACE, 1.0))


def test_grids_that_cannot_be_are_refused(point: ImpulseResponses) -> None:
    for changes, text in (
        ({"far_m": 40.0}, "near < far <= 23.6"),
        ({"near_m": 20.0, "far_m": 12.0}, "near < far"),
        ({"ground_m": 9.0}, "below the path"),
    ):
        with pytest.raises(MitsonarError, match=text):
            strip_grid(point, **changes)
    with pytest.raises(MitsonarError, match="shorter than the aperture"):
        strip_grid(point.select(slice(0, 6)))
    with pytest.raises(MitsonarError, match="path that moves"):
        strip_grid(replace(point, poses=np.repeat(point.poses[:1], 60, axis=0)))  # type: ignore[index]
    with pytest.raises(MitsonarError, match="pose of each ping"):
        strip_grid(replace(point, poses=None))
    with pytest.raises(MitsonarError, match="ground_m"):
        strip_grid(replace(point, height_m=None))
    poses = point.poses.copy()  # type: ignore[union-attr]
    poses[:, 5] = np.pi / 2
    with pytest.raises(MitsonarError, match="port or starboard"):
        strip_grid(replace(point, poses=poses))
    with pytest.raises(MitsonarError, match="pixels"):
        strip_grid(point, along_step_m=1e-5, across_step_m=1e-5)


def test_a_line_has_the_pattern_of_its_length() -> None:
    field = FieldOfView.of_line(0.1, 0.015, heading_deg=90, tilt_deg=65)
    sine = np.linspace(-0.29, 0.29, 59)
    ahead = np.sqrt(1 - sine**2)
    np.testing.assert_allclose(field.sensitivity(ahead, sine, 0 * sine), np.sinc(0.1 / 0.015 * sine), atol=1e-6)
    half = np.radians(field.across_deg) / 2
    assert field.sensitivity(np.cos(half), np.sin(half), np.zeros(1))[0] ** 2 == pytest.approx(0.5, rel=1e-4)
    assert field.sensitivity(np.cos(0.35), np.sin(0.35), np.zeros(1))[0] == 0  # beyond the second null
    with pytest.raises(MitsonarError, match="longer than a wavelength"):
        FieldOfView.of_line(0.01, 0.015)


# ---------------------------------------------------------------- files


def test_an_image_comes_back_from_its_file(tmp_path: Path) -> None:
    grid = StripGrid(1, 2, 0, 0.3, 0, 0.1, 3, 5, 0.2, 4)
    image = StripImage((np.arange(12).reshape(3, 4) + 1j).astype(np.complex64), grid)
    image.save(tmp_path / "image.npz")
    again = StripImage.load(tmp_path / "image.npz")
    assert again.grid == grid
    np.testing.assert_array_equal(again.value, image.value)
    assert "3 x 4 pixels" in repr(again)


@pytest.mark.parametrize(
    "changes",
    [
        {"value": np.zeros((3, 4))},
        {"value": np.full((3, 4), np.nan, np.complex64)},
        {"value": np.zeros((3, 5), np.complex64)},
        {"rows": np.array(10**12)},
        {"rows": np.array(-3)},
        {"along_step_m": np.array(np.nan)},
        {"along_step_m": np.array([0.1, 0.1])},
        {"more": np.zeros(3)},
    ],
)
def test_a_damaged_image_is_one_sentence(tmp_path: Path, changes: dict[str, np.ndarray]) -> None:
    grid = {"x": 1, "y": 2, "z": 0, "heading_rad": 0.3, "along_start_m": 0, "along_step_m": 0.1, "rows": 3}
    grid |= {"across_start_m": 5, "across_step_m": 0.2, "columns": 4}
    table = {"value": np.zeros((3, 4), np.complex64), **{name: np.array(value) for name, value in grid.items()}}
    np.savez(tmp_path / "image.npz", **(table | changes))  # type: ignore[arg-type]  # the stubs take allow_pickle for a name
    with pytest.raises(MitsonarError):
        StripImage.load(tmp_path / "image.npz")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", b"text"])
def test_another_file_is_one_sentence(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "image.npz").write_bytes(content)
    with pytest.raises(MitsonarError, match="cannot read the image"):
        StripImage.load(tmp_path / "image.npz")
