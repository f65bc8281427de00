"""From scene to frames: energies in closed form, convergence at its order, gain, labels, warnings, launches."""

from __future__ import annotations

import gc
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from helpers import assert_image_close, diffuse, floor, floor_levels, run_python, scene, slope, sphere
from numpy.typing import ArrayLike

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.pings import Counts, RenderedPings, Tally, constant_gain, to_image
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

pytestmark = pytest.mark.usefixtures("variant")

HEIGHT, PITCH = 2.5, np.radians(35)
POSE = Pose(0, 0, HEIGHT, PITCH, 0, 0)


@pytest.fixture(scope="module")
def flat(variant: str) -> mi.Scene:
    """An endless floor of reflectivity 0.5."""
    return scene(floor=floor(diffuse(0.5)))


def levels(loaded: mi.Scene, sonar: Sonar, pings: int = 1) -> np.ndarray:
    """Levels ``(pings, bins, beams)`` at the pose above."""
    return np.concatenate([batch.levels for batch in Simulator(loaded, sonar).pings([POSE] * pings)])


def whole_bins(truth: np.ndarray) -> np.ndarray:
    """Where a bin and both its neighbours are lit by the floor: the ends of the field of view cut theirs."""
    lit = truth > 0
    return lit & np.roll(lit, 1, axis=0) & np.roll(lit, -1, axis=0)


# ---------------------------------------------------------------- energy


@pytest.mark.parametrize("jitter", [True, False])
@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_energy_of_a_flat_floor(flat: mi.Scene, tmp_path: Path, bearing: str, jitter: bool) -> None:
    """Footprints: 1 % a bin is wanted at 700 rays a beam; four rays across measure 0.03 %."""
    sonar = Sonar(bearing=bearing, jitter=jitter, rays_per_beam=700, rays_across=4)
    truth = floor_levels(sonar, HEIGHT, PITCH, 0.5)
    got = levels(flat, sonar)[0]
    assert_image_close(got, np.where(whole_bins(truth), truth, 0), 1e-3, tmp_path / "floor.png")
    assert got.sum(dtype=float) == pytest.approx(truth.sum(), rel=1e-4)
    dark = (truth == 0) & ~np.roll(truth > 0, 1, axis=0) & ~np.roll(truth > 0, -1, axis=0)
    assert dark.any()
    assert (got[dark] == 0).all()


@pytest.mark.parametrize("exponent", [2, 4])
def test_gain_laws_of_a_flat_floor(flat: mi.Scene, tmp_path: Path, exponent: int) -> None:
    sonar = Sonar(gain_exponent=exponent, beams=16, beam_width_deg=0.3, rays_per_beam=700, rays_across=4)
    truth = floor_levels(sonar, HEIGHT, PITCH, 0.5)
    got = levels(flat, sonar)[0]
    assert_image_close(got, np.where(whole_bins(truth), truth, 0), 2e-3, tmp_path / "floor.png")


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_levels_do_not_depend_on_the_number_of_rays(flat: mi.Scene, tmp_path: Path, bearing: str) -> None:
    """Energy a beam to 1e-3 and levels to 1 % rms, from 350 x 1 to 1400 x 3 rays a beam."""
    base = Sonar(bearing=bearing, beams=24, range_bins=256, beam_width_deg=0.4)
    truth = floor_levels(base, HEIGHT, PITCH, 0.5)
    for rays, across in ((350, 1), (700, 2), (1400, 3)):
        got = levels(flat, base.replace(rays_per_beam=rays, rays_across=across))[0]
        np.testing.assert_allclose(got.sum(axis=0, dtype=float), truth.sum(axis=0), rtol=1e-3)
        assert_image_close(got, np.where(whole_bins(truth), truth, 0), 1e-2, tmp_path / f"{rays}_{across}.png")


def test_spreading_and_cosine_of_a_sphere_around(flat: mi.Scene) -> None:
    """Energy of a beam from a sphere of radius R around the sonar: C dOmega / R^2, whatever the bin."""
    sonar = Sonar(beams=4, range_min=1.0, range_max=20.0)
    expected = 0.5 * 2 * np.sin(np.radians(7)) * sonar.beam_width_rad
    for radius in (2.0, 5.0, 17.0):
        got = levels(scene(ball=sphere(POSE[:3], radius)), sonar)[0].sum(axis=0, dtype=float)
        np.testing.assert_allclose(got, expected / radius**2, rtol=1e-5)


# ---------------------------------------------------------------- convergence of Almanza-Medina's points


def point_error(flat: mi.Scene, sonar: Sonar, pings: int) -> float:
    """Relative error rms over whole bins, beams and pings."""
    truth = floor_levels(sonar, HEIGHT, PITCH, 0.5, axis_only=not sonar.jittered)
    inside = whole_bins(truth)
    return float(np.sqrt(np.mean((levels(flat, sonar, pings)[:, inside] / truth[inside] - 1) ** 2)))


def test_points_on_the_grid_converge_as_one_over_the_rays(flat: mi.Scene) -> None:
    """Of evenly spaced rays a bin gets the right number to within one: slope -1."""
    rays = (64, 128, 256, 512, 1024)
    coarse = Sonar(model="thesis", beams=24, range_min=3, range_max=8, range_bins=48)
    errors = [point_error(flat, coarse.replace(rays_per_beam=n), 1) for n in rays]
    assert slope(rays, errors) == pytest.approx(-1, abs=0.08), dict(zip(rays, errors, strict=True))


def test_points_at_random_converge_as_one_over_the_root(flat: mi.Scene) -> None:
    """Wide beams of jittered rays: the bins a ray may fall in are many, so its place is a matter of chance: slope -1/2."""
    rays = (256, 512, 1024, 2048, 4096)
    coarse = Sonar(model="thesis", jitter=True, azimuth_fov_deg=100, beams=8, range_min=3, range_max=8, range_bins=48)
    errors = [point_error(flat, coarse.replace(rays_per_beam=n), 16) for n in rays]
    assert slope(rays, errors) == pytest.approx(-0.5, abs=0.05), dict(zip(rays, errors, strict=True))


def test_points_err_by_small_counts(flat: mi.Scene) -> None:
    """One to two rays a bin have errors of tens of percent; footprints stay below 1 %."""
    thesis = point_error(flat, Sonar(model="thesis", jitter=True, beams=24), 1)
    truth = floor_levels(Sonar(beams=24), HEIGHT, PITCH, 0.5)
    footprints = levels(flat, Sonar(beams=24))[0][whole_bins(truth)] / truth[whole_bins(truth)] - 1
    assert thesis > 0.2
    assert np.sqrt(np.mean(footprints**2)) < 0.01


# ---------------------------------------------------------------- gain


def descent(frames: int) -> Trajectory:
    """Nearing the floor from 2.9 m by 1 cm a frame: levels rise."""
    return Trajectory.between(Pose(0, 0, 2.9, PITCH, 0, 0), Pose(0, 0, 2.9 - 0.01 * (frames - 1), PITCH, 0, 0), frames, 10)


SMALL = Sonar(beams=8, rays_per_beam=200, range_bins=64, range_min=2.5, range_max=8.0)


def quietly(simulator: Simulator, trajectory: Trajectory | ArrayLike, **options: Any) -> SonarFrames:
    """Frames, whatever there is to warn of."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MitsonarWarning)
        return simulator.render(trajectory, **options)


def test_gain_is_one_constant_from_the_first_20_frames(flat: mi.Scene) -> None:
    """Their 99.9th percentile becomes 0.9; level_scale undoes it; brighter frames after them are not looked at."""
    flown = descent(26)
    raw = np.concatenate([batch.levels for batch in Simulator(flat, SMALL).pings(flown.poses)])
    frames = quietly(Simulator(flat, SMALL), flown)
    gain = 0.9 / np.percentile(raw[:20], 99.9)
    assert np.percentile(frames.image[:20], 99.9) == pytest.approx(0.9, rel=1e-5)
    np.testing.assert_allclose(frames.image, np.clip(raw * gain, 0, 1), rtol=1e-6)
    assert frames.image.max() == 1  # the floor came nearer after the calibration
    below = frames.image < 1
    np.testing.assert_allclose((frames.image * frames.level_scale)[below], raw[below], rtol=1e-6)
    split = quietly(Simulator(flat, SMALL, rays_per_launch=3 * SMALL.rays), flown)
    np.testing.assert_array_equal(split.image, frames.image)
    assert split.level_scale == frames.level_scale


def test_gain_can_be_given_and_a_dark_scene_has_gain_one(flat: mi.Scene) -> None:
    raw = levels(flat, SMALL)
    frames = quietly(Simulator(flat, SMALL), [POSE], gain=3.0)
    np.testing.assert_allclose(frames.image, np.clip(raw * 3, 0, 1), rtol=1e-6)
    assert frames.level_scale == pytest.approx(1 / 3)
    assert quietly(Simulator(scene(), SMALL), [POSE]).level_scale == 1
    few = scene(ball=sphere((0, 4, -0.3), 0.02))  # so few pixels that the percentile is empty: the largest counts
    frames = quietly(Simulator(few, SMALL.replace(beams=60, range_bins=512)), [POSE])
    assert np.count_nonzero(frames.image) < 0.001 * frames.image.size
    assert frames.image.max() == pytest.approx(0.9)


def test_frames_say_what_they_are(flat: mi.Scene) -> None:
    flown = descent(3)
    frames = quietly(Simulator(flat, SMALL), flown)
    assert frames.image.shape == (3, 64, 8)
    assert frames.image.dtype == np.float32
    np.testing.assert_array_equal(frames.range_m, SMALL.range_m)
    np.testing.assert_array_equal(frames.bearing_rad, SMALL.bearing_rad)
    np.testing.assert_array_equal(frames.time_s, flown.time_s)
    np.testing.assert_array_equal(frames.poses, flown.poses)
    assert frames.height_m is not None
    np.testing.assert_allclose(frames.height_m, [2.9, 2.89, 2.88], rtol=1e-6)
    assert frames.sonar == SMALL
    assert (frames.elevation_rad, frames.shape_id, frames.shadow) == (None, None, None)
    bare = quietly(Simulator(flat, SMALL), flown.poses)  # poses alone: one every 1 / frame_rate_hz
    np.testing.assert_allclose(bare.time_s, [0, 0.1, 0.2])
    np.testing.assert_array_equal(bare.image, frames.image)


def test_noise_is_drawn_by_frame_and_cell(flat: mi.Scene) -> None:
    noise = NOISE_MODELS["high"]
    still = quietly(Simulator(flat, SMALL), [POSE] * 4)
    noisy = quietly(Simulator(flat, SMALL, rays_per_launch=SMALL.rays), [POSE] * 4, noise=noise, seed=5)
    np.testing.assert_array_equal(noisy.image, noise.apply(still.image, seed=5, frames=np.arange(4)))
    assert noisy.level_scale == still.level_scale


def test_pings_draw_their_own_jitter(flat: mi.Scene) -> None:
    """The same pose twice: other rays, nearly the same image; and ping k is ping k wherever it starts."""
    first, second = levels(flat, Sonar(beams=4), 2)
    assert (first != second).mean() > 0.5
    np.testing.assert_allclose(first.sum(), second.sum(), rtol=1e-3)
    third = next(Simulator(flat, Sonar(beams=4)).pings([POSE], first=1)).levels[0]
    np.testing.assert_array_equal(third, second)
    still = levels(flat, Sonar(beams=4, jitter=False), 2)
    np.testing.assert_array_equal(still[0], still[1])


# ---------------------------------------------------------------- warnings


def test_nothing_to_warn_of(flat: mi.Scene) -> None:
    """MitsonarWarning is an error in these tests."""
    Simulator(flat, SMALL).render([POSE] * 3, gain=1e-3)
    Simulator(flat, SMALL.replace(model="thesis", rays_per_beam=4000)).render([POSE], gain=1e-3)


def test_warned_when_nothing_is_hit(flat: mi.Scene) -> None:
    with pytest.warns(MitsonarWarning, match=r"no ray hit anything in 2 frames: check the pose"):
        frames = Simulator(flat, SMALL).render([Pose(0, 0, 2.5, -1.0)] * 2)
    assert (frames.image == 0).all()


def test_warned_of_returns_outside_the_window(flat: mi.Scene) -> None:
    """Their number, share, and the ranges of the frame that loses most."""
    sonar = SMALL.replace(range_min=3.4, range_max=5.0)
    simulator = Simulator(flat, sonar)
    poses = [POSE, Pose(0, 0, 2.0, PITCH)]
    lost, total, frames = 0, 0, []
    for number, pose in enumerate(poses):
        echoes = simulator.tracer.film_echoes(pose, number)
        ranges = echoes.range_m[(echoes.far_m <= 3.4) | (echoes.near_m >= 5.0)]
        lost, total = lost + ranges.size, total + int(echoes.hit.sum())
        frames.append((ranges.size, number, ranges.min(), ranges.max()))
    _, worst, near, far = max(frames)
    expected = (
        rf"{lost:,} of {total:,} returns \({100 * lost / total:.2g} %\) lie outside the window 3\.4\.\.5 m, "
        rf"in frame {worst} at {near:.2f}\.\.{far:.2f} m"
    )
    assert lost > 100
    with pytest.warns(MitsonarWarning, match=expected):
        simulator.render(poses, gain=1e-3)


class _Seen:
    """A source whose worst frame lost returns at 6..7 m."""

    def window_range(self, pose: object, number: int, time_s: float) -> tuple[float, float]:
        return 6.0, 7.0


@pytest.mark.parametrize(("outside", "warned"), [(1, False), (21_000, False), (22_000, True)])
def test_a_negligible_share_outside_the_window_is_not_warned_of(outside: int, warned: bool) -> None:
    """Up to a thousandth of the returns."""
    rays = {"inside": 21_299_182 - outside, "nearer": 0, "farther": outside, "missed": 0}
    tally = Tally(SMALL, frames=1, rays=rays, pixels=100, filled=100, worst=(outside, 0))
    assert ("window" in tally.findings(_Seen(), np.zeros((1, 6)), np.zeros(1))) == warned


def test_warned_of_saturation(flat: mi.Scene) -> None:
    raw = levels(flat, SMALL)
    for share, warned in ((0.013, True), (0.008, False)):
        gain = 1 / np.quantile(raw, 1 - share)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            image = Simulator(flat, SMALL).render([POSE], gain=float(gain)).image
        output = [str(warning.message) for warning in caught if issubclass(warning.category, MitsonarWarning)]
        assert ((image >= 1).mean() > 0.01) == warned
        assert len(output) == warned
        assert all("% of pixels are at the maximum (more than 1 %)" in text for text in output)


def test_warned_of_too_few_rays_for_points(flat: mi.Scene) -> None:
    """Fewer than ten rays a filled bin: the model `thesis` says so, `physical` has footprints."""
    few = SMALL.replace(rays_per_beam=100, range_bins=512)
    Simulator(flat, few).render([POSE], gain=1e-3)
    with pytest.warns(MitsonarWarning, match=r"1\.\d rays per bin on average, below 10: .* raise rays_per_beam"):
        Simulator(flat, few.replace(model="thesis")).render([POSE], gain=1e-3)


def test_warned_of_surfaces_without_reflectivity() -> None:
    glass = scene(floor=floor({"type": "dielectric"}))
    with pytest.warns(MitsonarWarning, match=r"the BSDF of floor has no diffuse reflectance: reflectivity 0\.5 is used"):
        frames = Simulator(glass, SMALL).render([POSE], gain=1.0)
    np.testing.assert_allclose(frames.image[0], levels(scene(floor=floor(diffuse(0.5))), SMALL)[0], rtol=1e-6)


# ---------------------------------------------------------------- the simulator


def _launches(simulator: Simulator) -> dict[tuple[int, bool], Any]:
    from mitsonar.simulation.models.thesis import ThesisModel

    assert isinstance(simulator.model, ThesisModel)
    return simulator.model.launches


def test_a_launch_is_recorded_once_and_not_for_every_call(flat: mi.Scene) -> None:
    """Whatever poses and first ping."""
    gc.collect()  # it would also record again as scenes of other tests go
    simulator = Simulator(flat, SMALL)
    launches = _launches(simulator)
    for k in range(12):
        list(simulator.pings([Pose(k, 0, 2.5 + 0.01 * k, PITCH, 0, 0.3 * k)] * 2, first=7 * k))
    ((launch, _),) = launches.values()
    recorded: Any = launch
    assert recorded._recorded.n_recordings == 1
    list(simulator.pings([POSE] * 3))
    list(simulator.pings([POSE] * 3, labels=True))
    assert len(launches) == 3


def test_a_launch_that_cannot_be_replayed_is_recorded_anew(flat: mi.Scene) -> None:
    """Dr.Jit refuses where other scenes came or went; here a stand-in refuses once."""
    simulator = Simulator(flat, SMALL)
    (before,) = simulator.pings([POSE])
    ((key, (launch, rays)),) = _launches(simulator).items()
    recorded: Any = launch
    left = ["registry entries"]

    class Refusing:
        clear = staticmethod(recorded.clear)

        def __call__(self, *inputs: object) -> Any:
            if left:
                raise RuntimeError(left.pop())
            return recorded(*inputs)

    _launches(simulator)[key] = Refusing(), rays
    (after,) = simulator.pings([POSE])
    np.testing.assert_array_equal(before.levels, after.levels)


def test_a_scene_with_a_bsdf_that_no_shape_uses_is_rendered_beside_another() -> None:
    """Dr.Jit refuses to record a launch of the second scene while it does not find the values of that BSDF."""
    shapes = {"unused": diffuse(0.3), "ground": floor(), "ball": sphere([0, 3, 0], 0.5)}
    first, second = scene(**shapes), scene(**shapes)
    before, after = (Simulator(one, SMALL).render([POSE], gain=1.0).image for one in (first, second))
    np.testing.assert_array_equal(before, after)


def test_a_replayed_launch_gives_what_a_new_one_gives(flat: mi.Scene) -> None:
    """Poses, ping numbers and jitter are inputs of the recording, not constants in it."""
    old = Simulator(flat, SMALL)
    list(old.pings([POSE] * 2))
    poses = [Pose(1, 2, 2.7, 0.5, 0.1, 1.0), Pose(-1, 0, 2.3, 0.6, 0, -2.0)]
    (replayed,), (new,) = (list(simulator.pings(poses, first=9)) for simulator in (old, Simulator(flat, SMALL)))
    np.testing.assert_array_equal(replayed.levels, new.levels)
    np.testing.assert_array_equal(replayed.height_m, new.height_m)


@pytest.mark.thorough
def test_python_may_collect_garbage_at_any_time() -> None:
    """One simulator after another: freeing the arrays of the first while a launch of the second is recorded would end the
    process, for Dr.Jit cannot record it."""
    run_python("""
        import gc, mitsonar
        from mitsonar.simulation.device import ensure_variant
        ensure_variant("llvm_ad_mono")
        import mitsuba as mi
        gc.set_threshold(10**9)  # only where this test collects

        def look(simulator):
            ours = simulator.tracer.echoes

            def echoes(*arguments):
                if gc.isenabled():  # Python itself would collect here sooner or later
                    gc.collect()
                return ours(*arguments)

            simulator.tracer.echoes = echoes  # a cycle: the simulator is garbage, not gone, when this function ends
            return next(simulator.pings([mitsonar.Pose.from_degrees([0, 0, 2.5, 35, 0, 0])])).levels.max()

        floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(100), "bsdf": {"type": "diffuse"}}
        for _ in range(2):
            assert look(mitsonar.Simulator(mi.load_dict({"type": "scene", "floor": floor}), mitsonar.Sonar(beams=4))) > 0
        assert gc.isenabled()
    """)


def test_earlier_batches_outlive_later_launches(flat: mi.Scene) -> None:
    """Batches may be kept: what they hold is not memory that the next launch writes to."""
    simulator = Simulator(flat, SMALL, rays_per_launch=SMALL.rays)
    poses = descent(12).poses
    stored, copies = [], []
    for batch in simulator.pings(poses):
        stored.append(batch.levels)
        copies.append(batch.levels.copy())
    for k, (view, copy) in enumerate(zip(stored, copies, strict=True)):
        np.testing.assert_array_equal(view, copy, err_msg=f"ping {k}")


def test_the_sonar_of_the_scene_is_the_default() -> None:
    import mitsuba as mi

    sensor = {"type": "imaging_sonar", "beams": 5, "rays_per_beam": 30, "preset": "didson300"}
    with_sonar = mi.load_dict({"type": "scene", "camera": {"type": "perspective"}, "sonar": sensor, "floor": floor()})
    assert (Simulator(with_sonar).sonar.beams, Simulator(with_sonar).sonar.bearing) == (5, "cone")
    assert Simulator(with_sonar, SMALL).sonar == SMALL
    with pytest.raises(MitsonarError, match=r"no sensor of type imaging_sonar: add one, or name a sonar"):
        Simulator(scene(floor=floor()))


@pytest.mark.parametrize("poses", [np.zeros((2, 5)), np.full((1, 6), np.nan), np.zeros((1, 2, 6))])
def test_poses_that_are_none(flat: mi.Scene, poses: np.ndarray) -> None:
    with pytest.raises(MitsonarError, match=r"poses must be finite numbers \(frames, 6\)"):
        list(Simulator(flat, SMALL).pings(poses))


@pytest.mark.parametrize(("across", "allowed_db"), [(4, 1.2), (32, 0.2)])
def test_profile_of_a_body_that_curves(across: int, allowed_db: float) -> None:
    """The rings of a sphere by range, C cos^2 dA / R^4 with dA = 2 pi a R / D dR: few rays across a beam err, many do not.

    The nearer half of what is seen, in bins of 2 mm, the mean of 20 pings: 95 % of the bins, which no averaging mends.
    """
    radius, away, window = 0.1, 4.0, (3.9, 4.0)
    sonar = Sonar(bearing="cone", beams=12, azimuth_fov_deg=3.6, elevation_fov_deg=3.6, range_min=window[0],
                  range_max=window[1], range_bins=50, rays_per_beam=400, rays_across=across)  # fmt: skip
    loaded = scene(ball=sphere((0, away, 0), radius))
    pings = np.concatenate([batch.levels for batch in Simulator(loaded, sonar).pings([Pose(0, 0, 0)] * 20)])
    got = pings.mean(axis=0).sum(axis=1, dtype=float)[: sonar.range_bins // 2]
    r = sonar.range_m[: len(got)]
    cosine = (away**2 - radius**2 - r**2) / (2 * radius * r)
    truth = 0.5 * cosine**2 * 2 * np.pi * radius * r / away * sonar.bin_m / r**4
    assert np.percentile(np.abs(10 * np.log10(got / truth)), 95) < allowed_db
    assert 10 * np.log10(got.sum() / truth.sum()) == pytest.approx(0, abs=0.05)


def test_levels_too_faint_for_a_gain_in_single_precision_stay_finite() -> None:
    """400 dB of absorption leave 1e-43; 0.9 over that is beyond 3e38, and 0 times infinity is not a number."""
    levels = np.zeros((1, 8, 4), np.float32)
    levels[0, 3] = 1e-43
    counts = Counts(*np.zeros((4, 1, 4), dtype=np.int64))
    gain, batches = constant_gain([RenderedPings(0, levels, counts, np.zeros(1))])
    assert gain == 1.0
    assert np.isfinite(to_image(next(batches).levels, gain, SMALL)).all()
