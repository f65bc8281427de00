"""Mirrored pictures are told from right ones by their rotation; pictures that do not turn tell nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_frames import START, over_ground, sway

from mitsonar import MitsonarError, Pose, Simulator, Trajectory, load_scene, load_sonar, open_recording
from mitsonar.mapping.series import path_of
from mitsonar.recordings.handedness import check_handedness
from mitsonar.recordings.recording import Part
from mitsonar.records.frames import SonarFrames

REAL = Path(__file__).resolve().parents[2].parent / "shared/data/real"

with_samples = pytest.mark.skipif(not REAL.exists(), reason="needs the recordings of ../shared/data/real")


def part_of(frames: SonarFrames, *, mirrored: bool = False) -> Part:
    """Frames as a part of a recording, whose pictures may be mirrored while its poses are not."""
    image = frames.image[:, :, ::-1] if mirrored else frames.image
    return Part(empty_aris_frames(frames), frames.time_s, image.__getitem__, poses=frames.poses)


def empty_aris_frames(frames: SonarFrames) -> SonarFrames:
    """Frames without images, and without what is of each frame."""
    return replace(frames.select(slice(0)), poses=None, height_m=None, about={})


def turning(frames: int, rate_deg: float, sideways: float = 0.0) -> Trajectory:
    """A path that turns evenly, and moves forward and sideways [m a frame]."""
    motions = np.tile([sideways, 0.02, np.radians(rate_deg)], (frames - 1, 1))
    return path_of(motions, START, np.arange(frames) * 0.1)


@pytest.mark.parametrize(("mirrored", "verdict", "sign"), [(False, "agree", 1), (True, "mirrored", -1)])
def test_drawn_frames_of_a_path_that_sways(mirrored: bool, verdict: str, sign: int) -> None:
    result = check_handedness(part_of(over_ground(sway(60)), mirrored=mirrored))
    assert result.verdict == verdict
    assert result.correlation * sign > 0.9
    assert 0.6 < result.slope * sign < 1.2


@pytest.mark.parametrize("rate_deg", [0.6, -0.6])
@pytest.mark.parametrize("mirrored", [False, True])
def test_an_even_turn_that_the_user_tells(rate_deg: float, mirrored: bool) -> None:
    part = replace(part_of(over_ground(turning(30, rate_deg)), mirrored=mirrored), poses=None)
    message = np.radians(rate_deg * 29)
    assert check_handedness(part, message).verdict == ("mirrored" if mirrored else "agree")
    assert check_handedness(part, -message).verdict == ("agree" if mirrored else "mirrored")
    assert check_handedness(part).verdict == "unknown"
    assert "the headings are unknown" in check_handedness(part).reason


def test_headings_beyond_north_wrap() -> None:
    path = turning(30, 0.6)
    poses = path.poses.copy()
    poses[:, 5] = (poses[:, 5] - poses[15, 5]) % (2 * np.pi)
    part = part_of(replace(over_ground(path), poses=poses))
    assert check_handedness(part).verdict == "agree"


def test_uneven_bearings_and_pictures_in_db() -> None:
    frames = over_ground(sway(60))
    uneven = np.sort(np.arcsin(np.linspace(-0.24, 0.24, 96)) + np.random.default_rng(3).normal(0, 2e-4, 96))
    pick = np.interp(uneven, frames.bearing_rad, np.arange(96))
    image = np.stack([[np.interp(pick, np.arange(96), row) for row in one] for one in frames.image])
    coded = (1 + np.log10(np.clip(image, 1e-4, 1)) / 4).astype(np.float32)
    sonar = frames.sonar.replace(coding="dB", coding_db=40, pattern="two_way")
    changed = replace(frames, image=coded, bearing_rad=uneven, sonar=sonar, level="dB")
    assert check_handedness(part_of(changed)).verdict == "agree"
    assert check_handedness(part_of(changed, mirrored=True)).verdict == "mirrored"


def test_pictures_that_do_not_turn_tell_nothing() -> None:
    straight = over_ground(turning(40, 0.0))
    result = check_handedness(part_of(straight))
    assert (result.verdict, result.pairs) == ("unknown", 0)
    assert "turn by" in result.reason
    noise = np.random.default_rng(5).normal(0, np.radians(1), 40)  # a compass that trembles on a sonar that does not
    result = check_handedness(replace(part_of(straight), poses=None), noise)
    assert result.verdict == "unknown"
    assert abs(result.correlation) < 0.4 or result.pairs < 60


def test_pictures_of_noise_alone_tell_nothing() -> None:
    rng = np.random.default_rng(11)
    heading = np.radians(np.cumsum(rng.normal(0, 1.5, 80)))
    verdicts = []
    for _ in range(6):
        image = rng.random((80, 32, 96)).astype(np.float32)
        like = empty_aris_frames(over_ground(turning(2, 0.0)))
        like = replace(like, image=np.zeros((0, 32, 96), np.float32), range_m=like.range_m[:32])
        verdicts.append(check_handedness(Part(like, np.arange(80.0), image.__getitem__), heading).verdict)
    assert verdicts == ["unknown"] * 6


def test_headings_must_be_one_a_frame() -> None:
    part = part_of(over_ground(turning(10, 0.5)))
    with pytest.raises(MitsonarError, match="one for each of 10 frames"):
        check_handedness(part, [0.0, 0.1])
    with pytest.raises(MitsonarError, match="one finite number"):
        check_handedness(part, np.full(10, np.nan))


@pytest.mark.thorough
def test_simulated_frames_of_a_real_sonar() -> None:
    """Coherent pings with speckle of the preset, on the scene with objects: the sonar turns and sails."""
    sonar = load_sonar("didson300").replace(range_bins=128)
    path = [Pose(0.02 * k, 0.05 * k, 2.5, np.radians(35), 0, np.radians(0.9 * k)) for k in range(16)]
    frames = Simulator(load_scene("objects"), sonar).render(path)
    assert check_handedness(part_of(frames)).verdict == "agree"
    assert check_handedness(part_of(frames, mirrored=True)).verdict == "mirrored"


@with_samples
@pytest.mark.parametrize("name", ["forward_chain", "translate_tyre"])
def test_real_fans_turn_as_their_registration_says(name: str) -> None:
    """The reference is a registration of the fans themselves: it tests the signs, and tells nothing of the sonar's side.

    A fixed point that turns anticlockwise in the fan (x to the right, y forward) is one that the sonar turned away from to
    starboard.
    """
    path = REAL / f"marine-debris-aris3000/{name}.npz"
    heading = np.concatenate([[0], np.cumsum(np.radians(np.load(path)["approx_motion"][:, 0]))])
    part = open_recording(path).part()
    assert check_handedness(part, heading).verdict == "agree"
    assert check_handedness(part, -heading).verdict == "mirrored"


@pytest.mark.thorough
@with_samples
@pytest.mark.parametrize("name", ["lamprey2", "lamprey4"])
def test_a_fish_before_a_sonar_at_rest_tells_nothing(name: str) -> None:
    geometry = Path(__file__).with_name("geometries") / f"{name}.yaml"
    part = open_recording(REAL / f"didson-static-video/{name}_first30.npz", geometry).part()
    assert check_handedness(part, np.radians(10)).verdict == "unknown"
    assert check_handedness(part, np.radians(-10)).verdict == "unknown"


@with_samples
def test_a_real_sonar_at_rest_tells_nothing() -> None:
    part = open_recording(REAL / "aris1200-sdk-sample/sample.aris").part()
    assert check_handedness(part).verdict == "unknown"
