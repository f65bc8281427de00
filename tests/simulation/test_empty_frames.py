"""Empty frames are reported: what the rays hit, the view of the sonar, what may be wrong."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from helpers import Command, diffuse, floor, plate, refused, scene, separate, sphere
from numpy.typing import ArrayLike

from mitsonar.errors import MitsonarWarning
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose
from mitsonar.simulation.pings import angle_hint, empty_frames, view_of
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

SONAR = Sonar(beams=8, range_bins=64, rays_per_beam=100, rays_across=1, range_min=1.0, range_max=5.0)
GOOD = Pose(0, 0, 2.5, np.radians(35))


def warned(loaded: mi.Scene, poses: ArrayLike, sonar: Sonar = SONAR) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Simulator(loaded, sonar).render(poses)
    return [str(one.message) for one in caught if issubclass(one.category, MitsonarWarning)]


@pytest.mark.usefixtures("variant")
def test_frames_that_look_over_the_ground_say_so() -> None:
    """Radians given where degrees are meant: pitch 0.61 deg; the floor is met beyond the window."""
    ground = scene(floor=floor(diffuse(0.5), 50))
    (output,) = [text for text in warned(ground, [GOOD, Pose(0, 0, 2.5, np.radians(0.61))]) if "empty: " in text]
    assert output.startswith("empty: 1 of 2 frames, frame 1 first: 0 % of its rays meet something within the window 1..5 m")
    assert "farther (returns at" in output
    assert "the sonar is at (0, 0, 2.5) m and looks 0.61 deg below the horizon, along (0.00, 1.00, -0.01)" in output
    assert output.endswith("its pitch, roll, heading are only 0.61, 0, 0 deg: were radians given where degrees are meant?")


def test_all_rays_are_100_percent() -> None:
    output = empty_frames(1, 1, (0, np.array([0, 0, 2.2, 0.4, 0, 0])), (0, 90_324, 0, 0), (80.0, 90.0), (4.1, 7.3))
    assert "100 % nearer, 0 % farther (returns at 4.1..7.3 m)" in output


@pytest.mark.usefixtures("variant")
def test_frames_of_degrees_given_as_radians_say_so() -> None:
    """35 rad is 205 deg, into the sky."""
    ground = scene(floor=floor(diffuse(0.5), 50))
    (output,) = warned(ground, [Pose.from_row((0, 0, 2.5, 35.0, 0, 0))])
    assert output.startswith("no ray hit anything in 1 frame: check the pose (x, y, z in m; pitch > 0 looks down)")
    assert "35, 0, 0 rad, more than a full turn: were degrees given where radians are meant?" in output


@pytest.mark.usefixtures("variant")
def test_frames_with_hardly_an_echo_count_and_frames_with_a_small_target_do_not() -> None:
    sonar = SONAR.replace(range_bins=2048, beams=64)
    tiny = scene(ball=sphere((0, 3, 2.5), 0.003, diffuse(0.9)))
    hardly = warned(tiny, [Pose(0, 0, 2.5)], sonar.replace(rays_per_beam=400, rays_across=4))
    assert any(text.startswith("empty: 1 of 1 frame,") for text in hardly)
    assert not warned(scene(ball=sphere((0, 3, 2.5), 0.3, diffuse(0.9))), [Pose(0, 0, 2.5)], sonar)


def test_hints_name_what_is_likely() -> None:
    assert "check its sign" in angle_hint(np.array([0, 0, 0, -0.5, 0, 0]))
    assert angle_hint(np.array([0, 0, 0, 0.6, 0, 0])) == ""
    assert angle_hint(np.zeros(6)) == ""
    assert "radians given" in angle_hint(np.array([0, 0, 0, *np.radians([0.6, 0, -1.57])]))
    assert "degrees given" in angle_hint(np.array([0, 0, 0, 18.0, 0, -4.0]))


def test_where_a_sonar_looks() -> None:
    assert view_of(np.array([1, 2, 3.5, 0, 0, np.pi / 2])) == (
        "the sonar is at (1, 2, 3.5) m and looks along the horizon, along (1.00, 0.00, 0.00)"
    )
    assert "looks 30 deg above the horizon, along (0.00, 0.87, 0.50)" in view_of(np.array([0, 0, 0, -np.pi / 6, 0, 0]))


def test_the_command_line_warns_of_a_black_picture(mitsonar: Command, tmp_path: Path) -> None:
    done = mitsonar("render", "flat_floor", "-o", tmp_path / "out", "--from", "0,0,2.5,0.61,0,0.07")
    assert done.returncode == 0, done.stderr
    assert "were radians given where degrees are meant?" in done.stderr


@pytest.mark.usefixtures("variant")
def test_poses_below_the_ground_and_inside_objects_are_found() -> None:
    """A hull seen from below, and the water below a sea surface, are no ground above."""
    from mitsonar.simulation.tracing import buried_in

    bed = separate(floor=floor(), ball=sphere((0, 3, 1), 0.5), surface=plate((0, 0, 9), (0, 0, 1)))
    poses = np.array([Pose(0, 0, 2.5), Pose(1, 2, -2.5), Pose(0, 3, 1.1)])
    below, inside = buried_in(bed, poses), buried_in(bed, poses[2:])
    assert below is not None
    assert (below.frame, below.frames, below.inside) == (1, 2, False)
    assert below.text == "at (1, 2, -2.5) m is 2.5 m below the ground, the shape floor, at z = 0 m (z points up)"
    assert inside is not None
    assert (inside.text, inside.inside) == ("at (0, 3, 1.1) m is inside the shape ball", True)
    assert buried_in(bed, poses[:1]) is None
    assert buried_in(scene(hull=sphere((0, 0, 5), 2)), poses[:1]) is None
    assert buried_in(separate(surface=plate((0, 0, 9), (0, 0, 1))), poses[:1]) is None
    (output,) = warned(separate(floor=floor()), [Pose(0, 0, -2.5, np.radians(35))])
    assert output.startswith("no ray hit anything in 1 frame: ")
    assert output.endswith(
        "the sonar at (0, 0, -2.5) m is 2.5 m below the ground, the shape floor, at z = 0 m (z points up)"
    )


def test_a_path_below_the_ground_is_refused_and_leaves_no_folder(mitsonar: Command, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ("--sonar", "didson300", "--model", "physical", "--quality", "draft", "-o", out, "--from")
    refused(
        mitsonar("render", "flat_floor", *words, "0,0,-2.5,35,0,0"),
        "pose 0 at (0, 0, -2.5) m is 2.5 m below the ground, the shape floor, at z = 0 m",
        "correct --from",
    )
    assert not out.exists()
    done = mitsonar("render", "flat_floor", *words, "0,0,-2.5,-35,0,0")
    assert done.returncode == 0
    assert "its frames show the ground from below" in done.stderr
