"""Frames as ARIS files: bit for bit where they can be, by their levels where not; axes, path, and files that stay whole."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_frames import over_ground, sway

from mitsonar import MitsonarError, SonarFrames, open_recording
from mitsonar.estimation.image.direct import Direct
from mitsonar.instruments.sounder import preset
from mitsonar.recordings.sound_metrics import FRAME, TABLES, aris_bearings
from mitsonar.recordings.write_aris import write_aris

REAL = Path(__file__).resolve().parents[2].parent / "shared/data/real"
ARIS = REAL / "aris1200-sdk-sample/sample.aris"
OCULUS = REAL / "oculus-m1200d-three-pings/three_pings_8bit.raw"

with_samples = pytest.mark.skipif(not REAL.exists(), reason="needs the recordings of ../shared/data/real")


def drawn(
    *, beams: int = 128, bins: int = 50, step_m: float = 0.0075, coding_db: float = 80.0, **changed: Any
) -> SonarFrames:
    """Three 8-bit frames of an ARIS 3000, 1500 m/s: 0.0075 m are 10 us."""
    rng = np.random.default_rng(4)
    sonar = preset("aris3000").replace(
        name="aris3000", beams=beams, range_bins=bins, range_min=1.5, range_max=1.5 + bins * step_m, coding_db=coding_db
    )
    known: dict[str, Any] = dict(
        image=rng.integers(0, 256, (3, bins, beams), dtype=np.uint8),
        range_m=1.5 + np.arange(bins) * step_m,
        bearing_rad=aris_bearings("3000", 128) if beams == 128 else sonar.bearing_rad,
        time_s=np.array([0.0, 0.1, 0.25]),
        sonar=sonar,
        level="dB",
    )
    return SonarFrames(**(known | changed))


@with_samples
def test_the_sample_comes_back_bit_for_bit(tmp_path: Path) -> None:
    part = open_recording(ARIS).part()
    written = write_aris(tmp_path / "a.aris", part.chunks())
    assert written.notes == ()
    again = open_recording(tmp_path / "a.aris")
    one, second = part.read(np.arange(6)), again.part().read(np.arange(6))
    assert (one.image == second.image).all()
    assert (one.range_m == second.range_m).all()
    assert (one.bearing_rad == second.bearing_rad).all()
    assert (one.time_s == second.time_s).all()
    assert one.attitude_rad is not None
    assert second.attitude_rad == pytest.approx(one.attitude_rad, abs=1e-7)
    assert one.sonar.model_dump() == second.sonar.model_dump()
    raw, result = (np.fromfile(path, np.uint8)[1024:].reshape(6, -1) for path in (ARIS, tmp_path / "a.aris"))
    assert (raw[:, 1024:] == result[:, 1024:]).all()
    heads = [np.frombuffer(content[:, :1024].tobytes(), FRAME) for content in (raw, result)]
    same = (
        "index",
        "time_us",
        "ping_mode",
        "cycle_us",
        "high_frequency",
        "sample_period_us",
        "start_delay_us",
        "samples",
        "large_lens",
    )
    for name in (*same, "system", "sound_speed", "heading_deg", "reordered"):
        assert heads[0][name] == pytest.approx(heads[1][name], abs=1e-4), name


@pytest.mark.parametrize(("kind", "beams"), list(TABLES))
def test_frames_of_every_table_come_back_bit_for_bit(tmp_path: Path, kind: str, beams: int) -> None:
    name = "aris3000" if kind == "telephoto" else f"aris{kind}"
    frames = drawn(beams=beams, bearing_rad=aris_bearings(kind, beams))
    frames.sonar = frames.sonar.replace(name=name)
    written = write_aris(tmp_path / "a.aris", frames)
    again = open_recording(tmp_path / "a.aris")
    assert (written.frames, written.notes) == (3, ())
    result = again.part().read([0, 1, 2])
    assert (result.image == frames.image).all()
    assert result.bearing_rad == pytest.approx(frames.bearing_rad)
    assert result.range_m == pytest.approx(frames.range_m)
    assert result.time_s == pytest.approx(frames.time_s, abs=1e-9)
    assert result.sonar.name == name
    assert again.facts["large_lens"] == int(kind == "telephoto")


def test_floats_in_the_same_coding_are_rounded_to_counts(tmp_path: Path) -> None:
    values = np.random.default_rng(1).random((3, 50, 128), dtype=np.float32)
    write_aris(tmp_path / "a.aris", drawn(image=values))
    assert (open_recording(tmp_path / "a.aris").part().read([0, 1, 2]).image == np.rint(values * 255)).all()


@pytest.mark.parametrize("level", ["linear", "gamma", "dB"])
def test_other_codings_go_through_their_levels(tmp_path: Path, level: str) -> None:
    """Levels come back to half a count: 80 dB / 255 / 2."""
    values = np.random.default_rng(1).uniform(0.3, 1, (3, 50, 128)).astype(np.float32)
    frames = drawn(image=values, level=level, coding_db=60.0)
    write_aris(tmp_path / "a.aris", frames)
    result = open_recording(tmp_path / "a.aris").part().read([0, 1, 2]).to_linear()
    error = 10 * np.log10(result.image / frames.to_linear().image)
    assert np.abs(error).max() < 80 / 255 / 2 + 0.01


def test_echoes_below_the_span_are_counted(tmp_path: Path) -> None:
    values = np.zeros((3, 50, 128), np.float32)
    values[:, 0], values[:, 1] = 1.0, 1e-9
    written = write_aris(tmp_path / "a.aris", drawn(image=values, level="linear"))
    image = open_recording(tmp_path / "a.aris").part().read([0]).image[0]
    assert (image[0] == 255).all()
    assert not image[1:].any()
    assert written.notes == ("50 % of the echoes lie 80 dB or more below full scale: they become 0",)


def test_attitude_path_height_and_speed_come_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    poses = np.column_stack([rng.normal(0, 20, (3, 2)), [2.0, 2.5, 3.0], rng.uniform(0.2, 0.6, (3, 3))])
    frames = drawn(poses=poses, height_m=np.array([2.0, np.nan, 3.0]))
    write_aris(tmp_path / "a.aris", frames, origin_deg=(-32.0, -52.0))
    part = open_recording(tmp_path / "a.aris").part()
    assert part.poses is not None
    assert part.poses[:, :2] - part.poses[0, :2] == pytest.approx(poses[:, :2] - poses[0, :2], abs=1e-3)
    assert part.poses[:, 2:] == pytest.approx(poses[:, 2:], abs=1e-6)
    assert part.attitude_rad == pytest.approx(poses[:, 3:], abs=1e-6)
    assert part.height_m == pytest.approx([2, np.nan, 3], nan_ok=True)


def test_the_sensors_attitude_comes_before_that_of_the_path(tmp_path: Path) -> None:
    message = np.array([[0.1, 0.2, -0.3], [np.nan, 0.2, 0.3], [0.1, 0.2, 6.2]])
    write_aris(tmp_path / "a.aris", drawn(poses=np.full((3, 6), 0.5), attitude_rad=message))
    attitude = open_recording(tmp_path / "a.aris").part().attitude_rad
    assert attitude is not None
    assert attitude[:, :2] == pytest.approx(message[:, :2], abs=1e-6, nan_ok=True)
    assert np.cos(attitude[:, 2] - message[:, 2]) == pytest.approx(1)


@pytest.mark.parametrize("step_m", [0.0047, 0.0123])
def test_other_range_axes_are_interpolated(tmp_path: Path, step_m: float) -> None:
    """A ramp over range stays the same ramp, to half a count."""
    ramp = np.broadcast_to(np.arange(50, dtype=np.uint8)[None, :, None] * 5, (3, 50, 128))
    frames = drawn(step_m=step_m, image=np.ascontiguousarray(ramp))
    written = write_aris(tmp_path / "a.aris", frames)
    assert "whole microseconds" in written.notes[0]
    result = open_recording(tmp_path / "a.aris").part().read([0])
    step = result.range_m[1] - result.range_m[0]
    assert 0.5 * step_m < step <= step_m
    assert result.range_m[0] == pytest.approx(1.5, abs=4e-4)
    assert result.range_m[-1] == pytest.approx(frames.range_m[-1], abs=step)
    expected = np.clip((result.range_m - 1.5) / step_m * 5, 0, 245)
    assert np.abs(result.image[0].astype(float) - expected[:, None]).max() <= 0.5 + 1e-3


def test_beams_that_fit_no_table_are_refused_or_interpolated(tmp_path: Path) -> None:
    frames = drawn(beams=96)
    with pytest.raises(MitsonarError, match="beams 96 to interpolate"):
        write_aris(tmp_path / "a.aris", drawn(beams=96, bearing_rad=np.linspace(-1, 1, 96)))
    with pytest.raises(MitsonarError, match=r"holds 48, 64, 96, 128 beams: got 100 beams"):
        write_aris(tmp_path / "a.aris", drawn(beams=100))
    assert not list(tmp_path.iterdir())
    slope = np.degrees(frames.bearing_rad) * 5 + 100
    frames.image = np.broadcast_to(np.rint(slope).astype(np.uint8), (3, 50, 96)).copy()
    written = write_aris(tmp_path / "a.aris", frames, beams=128)
    assert "96 beams interpolated to 128" in written.notes[0]
    result = open_recording(tmp_path / "a.aris").part().read([0])
    inside = np.abs(result.bearing_rad) < frames.bearing_rad[-1]
    expected = np.degrees(result.bearing_rad) * 5 + 100
    assert np.abs(result.image[0, 0][inside] - expected[inside]).max() <= 1.001
    assert inside.sum() >= 124


def test_a_narrow_fan_is_zero_outside(tmp_path: Path) -> None:
    narrow = drawn(beams=48, bearing_rad=np.radians(np.linspace(-5, 5, 48)), image=np.full((3, 50, 48), 200, np.uint8))
    write_aris(tmp_path / "a.aris", narrow, beams=128)
    result = open_recording(tmp_path / "a.aris").part().read([0])
    degrees = np.abs(np.degrees(result.bearing_rad))
    assert (result.image[0][:, degrees < 5] == 200).all()
    assert not result.image[0][:, degrees > 5.2].any()


@with_samples
def test_an_oculus_recording_becomes_an_aris_file(tmp_path: Path) -> None:
    """Levels of the Oculus, in dB over 80, at the beams of an ARIS that lie inside its fan."""
    part = open_recording(OCULUS).part()
    written = write_aris(tmp_path / "a.aris", part.chunks(), beams=128)
    assert written.frames == 3
    one, second = part.read([0]).to_linear(), open_recording(tmp_path / "a.aris").part().read([0]).to_linear()
    assert second.sonar.sound_speed == pytest.approx(one.sonar.sound_speed)
    near = np.abs(one.bearing_rad[:, None] - second.bearing_rad).argmin(axis=0)
    rows = np.abs(one.range_m[:, None] - second.range_m).argmin(axis=0)
    levels = [np.log10(np.maximum(image, 1e-8)) for image in (one.image[0][np.ix_(rows, near)], second.image[0])]
    assert np.corrcoef(levels[0].ravel(), levels[1].ravel())[0, 1] > 0.95


def test_the_motion_in_frames_is_that_in_their_file(tmp_path: Path) -> None:
    """Frames of a floor, drawn with the cones of an ARIS 3000, in linear values: the estimates agree."""
    sonar = preset("aris3000").replace(
        name="aris3000", model="physical", beams=128, range_bins=240, range_min=3.6, range_max=5.4, bearing="cone"
    )
    frames = over_ground(sway(8), sonar)
    write_aris(tmp_path / "a.aris", frames)
    result = open_recording(tmp_path / "a.aris").part().read(np.arange(8))
    result.height_m = frames.height_m
    for one in range(7):
        pair = slice(one, one + 2)
        before, after = (Direct().estimate(each.select(pair)).motion for each in (frames, result))
        assert after[:2] == pytest.approx(before[:2], abs=2e-3)
        assert after[2] == pytest.approx(before[2], abs=np.radians(0.1))


def test_files_are_whole_or_absent_and_never_overwritten(tmp_path: Path) -> None:
    frames = drawn()
    write_aris(tmp_path / "a.aris", frames)
    before = (tmp_path / "a.aris").read_bytes()
    with pytest.raises(MitsonarError, match="exists"):
        write_aris(tmp_path / "a.aris", frames)
    assert (tmp_path / "a.aris").read_bytes() == before

    def breaks() -> Iterator[SonarFrames]:
        yield frames
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_aris(tmp_path / "b.aris", breaks())
    assert [path.name for path in tmp_path.iterdir()] == ["a.aris"]
    assert int.from_bytes(before[424:432], "little") == len(before)
    assert int.from_bytes(before[4:8], "little") == 3


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"time_s": np.array([0.0, 0.2, 0.1])}, "must increase"),
        ({"time_s": np.array([-1.0, 0.2, 0.3])}, "seconds since 1970, from 0"),
        ({"time_s": np.array([0.0, 1e-7, 1.0])}, "at least a microsecond"),
        ({"time_s": np.array([0.0, np.nan, 1.0])}, "seconds since 1970, from 0"),
        ({"poses": np.full((3, 6), 5e7)}, "leaves the earth"),
    ],
)
def test_what_such_a_file_cannot_hold_is_refused(tmp_path: Path, changed: dict[str, object], reason: str) -> None:
    with pytest.raises(MitsonarError, match=reason):
        write_aris(tmp_path / "a.aris", drawn(**changed))  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_other_refusals(tmp_path: Path) -> None:
    frames = drawn()
    with pytest.raises(MitsonarError, match="no frames"):
        write_aris(tmp_path / "a.aris", [])
    with pytest.raises(MitsonarError, match=r"ends in \.aris"):
        write_aris(tmp_path / "a.ddf", frames)
    with pytest.raises(MitsonarError, match="no folder"):
        write_aris(tmp_path / "b" / "a.aris", frames)
    with pytest.raises(MitsonarError, match="one geometry"):
        write_aris(tmp_path / "a.aris", [frames, drawn(step_m=0.015, time_s=np.array([1.0, 2.0, 3.0]))])
    frames.sonar = frames.sonar.replace(sound_speed=340.0)
    with pytest.raises(MitsonarError, match="sound speeds of 1000 to 2000"):
        write_aris(tmp_path / "a.aris", frames)
    assert not list(tmp_path.iterdir())
