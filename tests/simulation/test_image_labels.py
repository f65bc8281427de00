"""Labels of pixels: shape, elevation and shadow of a box on a floor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from helpers import box, diffuse, floor, place_of, scene

from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")]

HEIGHT, PITCH = 2.5, np.radians(35)
POSE = Pose(0, 0, HEIGHT, PITCH, 0, 0)
BEAMS = 15
LABELLED = Sonar(azimuth_fov_deg=30, beams=BEAMS, elevation_fov_deg=30, rays_per_beam=800, range_min=3.0, range_max=9.0)


def labelled(tall: float, half: float = 100.0, **fields: Any) -> tuple[SonarFrames, mi.Scene]:
    """A box of that height ahead, on a floor; frames with labels, and the scene."""
    loaded = scene(floor=floor(diffuse(0.4), half), box=box((0, 4.2, tall / 2), (0.4, 0.1, tall / 2), diffuse(0.8)))
    return Simulator(loaded, LABELLED.replace(**fields)).render([POSE], labels=True), loaded


@pytest.mark.parametrize("model", ["physical", "thesis"])
def test_labels_of_floor_and_box(model: str) -> None:
    frames, loaded = labelled(0.5, model=model, rays_per_beam=3000 if model == "thesis" else 800, range_bins=200)
    assert frames.shape_id is not None
    assert frames.elevation_rad is not None
    image, shape, elevation = frames.image[0], frames.shape_id[0], frames.elevation_rad[0]
    assert shape.dtype == np.int32
    assert elevation.dtype == np.float32
    empty = image == 0
    assert (shape[empty] == -1).all()
    assert np.isnan(elevation[empty]).all()
    assert set(np.unique(shape[~empty])) == {place_of(loaded, "floor"), place_of(loaded, "box")}
    # the box's front, 4.1 m ahead, reaches from the floor at 4.80 m to its upper edge at 4.56 m
    middle = BEAMS // 2
    on_box = frames.range_m[shape[:, middle] == place_of(loaded, "box")]
    assert on_box.min() == pytest.approx(np.hypot(4.1, 2.0), abs=0.04)
    assert on_box.max() == pytest.approx(np.hypot(4.1, 2.5), abs=0.04)
    assert (shape[:, 0] != place_of(loaded, "box")).all()
    # the floor's elevation in its range: sin(pitch - e) = height / range on the axis beam
    on_floor = shape[:, middle] == place_of(loaded, "floor")
    expected = PITCH - np.arcsin(HEIGHT / frames.range_m[on_floor])
    np.testing.assert_allclose(elevation[on_floor, middle], expected, atol=0.01)


@pytest.mark.parametrize(("tall", "half"), [(0.5, 100.0), (1.6, 100.0), (1.6, 6.0)], ids=["low", "tall", "tall, floor ends"])
def test_shadow_behind_a_box(tall: float, half: float) -> None:
    """1 between the box and floor that is lit again; 2 where all sound of the beam was intercepted; 0 elsewhere.

    Sound grazes the box's far upper edge, 4.3 m ahead, and meets the floor 4.3 h / (h - tall) ahead: at 5.4 m (low), 11.9 m
    (tall). The upper rays, 20 deg down, meet it 6.87 m ahead, at 7.31 m: behind the tall box nothing is lit any more.
    """
    frames, _ = labelled(tall, half)
    assert frames.shadow is not None
    code, echo, radius = frames.shadow[0], frames.image[0] > 0, frames.range_m
    assert code.dtype == np.uint8
    assert (code[echo] == 0).all()
    side, middle = 0, BEAMS // 2
    nearest = radius[echo[:, middle]].min()
    assert (code[radius < nearest - 0.05, middle] == 0).all()
    lit_to = radius[echo[:, side]].max()
    beyond = radius > lit_to + 0.05
    assert beyond.any()
    if tall < 1:
        lit_again = np.hypot(4.3 * 2.5 / (2.5 - tall), 2.5)
        shadow = (radius > np.hypot(4.1, 2.5) + 0.1) & (radius < lit_again - 0.1)
        assert shadow.sum() > 20
        assert (code[shadow, middle] == 1).all()
        assert (code[(radius > lit_again + 0.1) & (radius < HEIGHT / np.sin(np.radians(20)) - 0.1), middle] == 0).all()
    else:
        shadow = radius > np.hypot(4.3, 2.5) + 0.1
        assert (code[shadow, middle] == 2).all()
    # past the lit floor nothing travels on, unless the upper rays pass over the floor's end
    assert (code[beyond, side] == (2 if half > 50 else 1)).all()


def test_a_floor_below_all_echoes_leaves_the_shadows_of_ping_groups_with_a_pattern() -> None:
    """Only the beams on the box send no sound on; counts of each beam, not of the frame, decide between 1 and 2."""
    loaded = scene(floor=floor(diffuse(0.4), 6.0), box=box((0, 4.2, 0.8), (0.4, 0.1, 0.8), diffuse(0.8)))
    sonar = LABELLED.replace(pattern="two_way", elevation_pattern="box", frequency_hz=7e5, ping_groups=3, rays_per_beam=200)
    plain, above = (Simulator(loaded, sonar).render([POSE], labels=True, label_floor=low) for low in (0.0, 1e-20))
    assert plain.shadow is not None
    assert set(np.unique(plain.shadow)) == {0, 1, 2}
    np.testing.assert_array_equal(above.shadow, plain.shadow)


@pytest.mark.parametrize("undone", [False, True])
@pytest.mark.parametrize("model", ["physical", "coherent"])
def test_labels_are_of_what_absorption_leaves(model: str, undone: bool) -> None:
    """Expected levels, to which a label floor is compared, fall by 2 dB/m there and back unless the gain undoes it."""
    clear = LABELLED.replace(
        model=model, pattern="two_way", frequency_hz=7e5, absorption_db_per_m=0.0, rays_per_beam=200, range_bins=64
    )
    dim = clear.replace(absorption_db_per_m=2.0, gain_absorption=undone)
    loaded = scene(floor=floor(diffuse(0.4)))
    pings, lossless = (next(Simulator(loaded, sonar).pings(POSE, labels=True)) for sonar in (dim, clear))
    left = np.ones(64) if undone else 10 ** (-0.4 * dim.range_m)
    np.testing.assert_allclose(pings.echoes[0], lossless.echoes[0] * left[:, None], rtol=1e-5)
