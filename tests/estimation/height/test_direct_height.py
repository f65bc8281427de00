"""Heights: level ground along range against quadrature, the direct way with rocks and noise, networks, and what odometry
makes of them."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import DOWN, Command, essence, floor, floor_levels, refused, scene, tiny_recipe
from numpy.typing import NDArray

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.datasets.make import make_dataset
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate
from mitsonar.estimation.height import DirectHeight, FloorProfile, HeightEstimate, heights_csv, heights_lines
from mitsonar.estimation.named import height_estimator_from
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar
from mitsonar.mapping.open_source import open_views
from mitsonar.mapping.pairs import estimate_motions
from mitsonar.mapping.sources import FrameSource, measured
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.frames import SonarFrames, ViewFrames
from mitsonar.simulation.simulator import Simulator

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")]

AHEAD = {"range_min": 2.6, "range_max": 9.0, "range_bins": 160, "beams": 32, "rays_per_beam": 128, "rays_across": 1}
LOOKING_DOWN = {"range_min": 2.0, "range_max": 6.1, "range_bins": 128, "beams": 64, "rays_per_beam": 64}


def sonar_ahead(model: str, bearing: str = "azimuth") -> Sonar:
    return load_sonar("didson300").replace(**AHEAD, model=model, bearing=bearing, jitter=False)


# ---------------------------------------------------------------- level ground


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
@pytest.mark.parametrize("model", ["thesis", "physical"])
@pytest.mark.parametrize("gain", [0, 2])
def test_the_profile_of_the_floor_is_its_quadrature(model: str, bearing: str, gain: int) -> None:
    sonar = sonar_ahead(model, bearing).replace(gain_exponent=gain)
    edges = np.linspace(sonar.range_min, sonar.range_max, 41)
    for height in (2.1, 2.6):
        expected = floor_levels(sonar, height, np.radians(35), 0.5, axis_only=model == "thesis").sum(axis=1)
        expected = expected.reshape(40, 4).sum(axis=1)
        result = FloorProfile(sonar, np.radians(35)).levels_at(height, edges)
        np.testing.assert_allclose(result / result.sum(), expected / expected.sum(), atol=0.004)


def test_ranges_are_proportional_to_the_height() -> None:
    ground = FloorProfile(load_sonar("lookdown100").replace(**LOOKING_DOWN), np.radians(90))
    assert abs(ground.nearest - 1) < 1e-3
    corner = np.cos(np.radians(50)) ** 2
    assert abs(ground.farthest * corner - 1) < 0.05
    edges = np.linspace(0, 20, 50)
    np.testing.assert_allclose(ground.levels_at(4.0, edges), ground.levels_at(2.0, edges / 2), atol=1e-12)
    np.testing.assert_allclose(ground.levels_at(np.array([3.0, 5.0]), edges).sum(axis=1), 1)
    with pytest.raises(MitsonarError, match="sees no level ground"):
        FloorProfile(load_sonar("lookdown100").replace(**LOOKING_DOWN), np.radians(-90))


# ---------------------------------------------------------------- the direct way


@pytest.mark.parametrize("height", essence([1.6, 2.5, 3.2], 1.6, 3.2))
@pytest.mark.parametrize("noise", essence(["none", "high"], "high"))
@pytest.mark.parametrize(("model", "pitch"), [("thesis", 35), ("physical", 35), ("thesis", 90)])
def test_the_height_over_a_rendered_floor(model: str, pitch: int, noise: str, height: float) -> None:
    if pitch == 90:
        sonar = load_sonar("lookdown100").replace(**{**LOOKING_DOWN, "range_min": 1.5, "range_max": 8.0}, model="thesis")
    else:
        sonar = sonar_ahead(model).replace(range_min=1.8)
    frames = Simulator(scene(floor=floor()), sonar).render([[0, 0, height, np.radians(pitch), 0.02, 0.4]])
    image = (
        NOISE_MODELS["high"].apply(frames.image.astype(np.float32), seed=3, frames=np.zeros(1, dtype=np.int64))
        if noise == "high"
        else frames.image
    )
    result = DirectHeight().height(replace(frames, image=np.asarray(image)))
    assert result.valid
    assert abs(result.height_m - height) < (0.01 if noise == "none" else 0.04) * height
    assert result.std_m < 0.1 * height


def test_what_stands_on_the_floor_does_not_lift_it() -> None:
    """A third of the ground between the floor and 15 % above it, speckle besides: the floor is found, not the mean."""
    sonar = load_sonar("lookdown100").replace(**LOOKING_DOWN)
    ground = FloorProfile(sonar, np.radians(90))
    edges = np.linspace(2.0, 6.1, 129)
    rng = np.random.default_rng(4)
    tops = ground.levels_at(2.5 * rng.uniform(0.85, 1, 200), edges).mean(axis=0)
    levels = (2 * ground.levels_at(2.5, edges) + tops) * rng.uniform(0.8, 1.2, 128)
    image = np.tile(levels[None, :, None] / levels.max(), (1, 1, 64)).astype(np.float32)
    frame = frame_of(image, sonar)
    result = DirectHeight().height(frame)
    assert abs(result.height_m - 2.5) < 0.02 * 2.5
    assert abs(result.height_m - 2.5) < 3 * result.std_m
    vector = ViewFrames(
        "vector", {"whole": image.sum(axis=2)}, {"whole": sonar}, {"whole": sonar.bearing_rad}, *about(sonar)
    )
    assert abs(DirectHeight().height(vector).height_m - result.height_m) < 1e-6


def about(sonar: Sonar) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Time and pose of a frame that looks straight down."""
    return np.zeros(1), np.array([[0, 0, 2.5, np.radians(90), 0, 0]])


def frame_of(image: NDArray[np.floating], sonar: Sonar) -> SonarFrames:
    time_s, poses = about(sonar)
    return SonarFrames(image, sonar.range_m, sonar.bearing_rad, time_s, sonar, poses)


def test_frames_without_ground_are_not_believed() -> None:
    sonar = load_sonar("lookdown100").replace(**LOOKING_DOWN)
    rng = np.random.default_rng(1)
    blank = DirectHeight().height(frame_of(np.zeros((1, 128, 64), np.float32), sonar))
    assert (blank.valid, np.isnan(blank.height_m)) == (False, True)
    dots = np.zeros((1, 128, 64), np.float32)
    dots[0, rng.integers(0, 128, 6)] = 1
    assert not DirectHeight().height(frame_of(dots, sonar)).valid
    frame = frame_of(rng.random((1, 128, 64)).astype(np.float32), sonar)
    assert not DirectHeight().height(frame).valid
    with pytest.raises(MitsonarError, match="have no poses: give pitch_deg"):
        DirectHeight().height(replace(frame, poses=None))
    with pytest.raises(MitsonarError, match="holds nan or inf"):
        DirectHeight().height(frame_of(np.full((1, 128, 64), np.nan, np.float32), sonar))
    with pytest.raises(MitsonarError, match="one frame: got 0"):
        DirectHeight().height(frame.select(slice(0)))


# ---------------------------------------------------------------- data sets, networks, odometry

LOW = {**DOWN, "mount__heading_deg": -90.0, "segments": ["whole", "c1", "c2", "c3", "c4"], "store": "vectors"}


@pytest.fixture(scope="module")
def heights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Vectors of a looking-down sonar at drawn heights."""
    url = tmp_path_factory.mktemp("made") / "heights.zarr"
    changes = {"flight__height_m": [2.2, 3.2], "flight__pings": 3, "scenes": [{"count": 2, "sequences": 8}]}
    make_dataset(tiny_recipe(**LOW, **changes), str(url))
    return url


def test_heights_of_a_data_set_s_vectors(heights: Path, tmp_path: Path, mitsonar: Command) -> None:
    done = mitsonar("height", heights, "--sequence", 5, "-o", tmp_path / "heights.csv")
    assert done.returncode == 0, done.stderr
    assert "vectors of whole" in done.stdout
    rows = list(csv.DictReader((tmp_path / "heights.csv").open()))
    true = DataStore.open(heights).read("pose")[15:18, 2]
    np.testing.assert_allclose([float(row["true_z_m"]) for row in rows], true, rtol=1e-5)
    assert np.abs([float(row["height_m"]) for row in rows] - true).max() < 0.1 * true[0]
    refused(mitsonar("height", heights, "-o", tmp_path / "heights.csv"), "exists and is kept as it is")
    refused(mitsonar("height", heights, "--by", "directly"), "a height estimator is direct, a checkpoint")
    refused(mitsonar("height", heights, "--view", "q1"), "has no vectors of view 'q1'")


def test_a_table_of_heights_keeps_the_times_of_a_clock() -> None:
    times = 1764424800.125 + 0.25 * np.arange(3.0)
    table = csv.DictReader(heights_csv(times, [HeightEstimate(2.0, 0.1)] * 3, None).splitlines())
    assert [float(row["time_s"]) for row in table] == times.tolist()


def test_a_depth_is_no_height_to_compare_with() -> None:
    """The z of a sonar below a surface at z = 0, as in recordings, says nothing about the height over the ground."""
    estimates = [HeightEstimate(1.8, 0.1), HeightEstimate(1.9, 0.1)]
    assert "against the true z: RMSE 10.00 cm" in heights_lines(estimates, np.array([1.7, 1.8]))[-1]
    assert heights_lines(estimates, np.array([-10.3, -10.2])) == heights_lines(estimates, None)


def test_measured_heights_hide_the_true_ones() -> None:
    sonar = sonar_ahead("thesis").replace(range_min=1.8)
    pings = Simulator(scene(floor=floor()), sonar).render(np.tile([0, 0, 2.5, np.radians(35), 0, 0], (3, 1)))
    source = FrameSource.of(pings).with_heights_by(DirectHeight())
    seen = source.read([0, 2])
    assert seen.height_m is not None
    assert seen.poses is not None
    assert not np.isin(seen.height_m, [2.5]).any()
    np.testing.assert_array_equal(seen.poses[:, 2], seen.height_m)
    assert source.digest() != FrameSource.of(pings).digest()
    empty = replace(pings, image=np.where(np.arange(3)[:, None, None] == 1, 0, pings.image))
    result, output = measured(empty, DirectHeight())
    assert [one.valid for one in output] == [True, False, True]
    assert result.height_m is not None
    np.testing.assert_array_equal(np.isfinite(result.height_m), [True, False, True])


def test_frames_that_tell_no_height_are_bridged() -> None:
    """Two that hold nothing, among others: these two are not believed, and the rest goes on."""
    sonar = sonar_ahead("thesis").replace(range_min=1.8)
    poses = np.tile([0, 0, 2.5, np.radians(35), 0, 0], (6, 1))
    poses[:, 1] += 0.005 * np.arange(6)
    pings = Simulator(scene(floor=floor()), sonar).render(poses)
    lost = replace(pings, image=np.where(np.isin(np.arange(6), [3, 4])[:, None, None], 0, pings.image))
    source = FrameSource.of(lost).with_heights_by(DirectHeight())
    output = estimate_motions(source, Told(), np.arange(6))
    assert [one.valid for one in output] == [True, True, True, False, True]
    assert output[3].reason == "no height was found in the frames"


class Told:
    """An estimator that needs a height, and says nothing else."""

    consumes = SonarFrames
    inputs = "height"
    digest = ""

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        assert frames.height_m is not None
        assert np.isfinite(frames.height_m).any()
        return Estimate(Motion(0.0, 0.0, 0.0))


@pytest.mark.thorough
def test_portions_as_images_know_their_rays(tmp_path: Path, mitsonar: Command) -> None:
    """An image of a cone, read as that of the whole view, would tell 3 % too much."""
    url = tmp_path / "cones.zarr"
    changes = {"segments": ["c1", "whole"], "store": "both", "scenes": [{"count": 1, "sequences": 2}]}
    make_dataset(tiny_recipe(**{**LOW, **changes}), str(url))
    store = DataStore.open(str(url))
    true = store.read("pose")[0, 2]
    for view in ("c1", "whole"):
        done = mitsonar("height", url, "--view", view, "--sequence", 0, "-o", tmp_path / f"{view}.csv")
        assert done.returncode == 0, done.stderr
        assert f"images of {view}" in done.stdout
        rows = list(csv.DictReader((tmp_path / f"{view}.csv").open()))
        assert abs(float(rows[0]["height_m"]) - true) < 0.1 * true
    vectors = open_views(str(url), ["c1"], "vector", sequence=0).read([0])
    images = open_views(str(url), ["c1"], "image", sequence=0).read([0])
    both = [DirectHeight().height(one).height_m for one in (vectors, images)]
    assert abs(both[0] - both[1]) < 0.02 * true  # pixels are rounded
    with pytest.raises(MitsonarError, match="has no vectors of view 'q1'"):
        open_views(str(url), ["c1"], "vector").with_heights_by(DirectHeight(views=("q1",)))
    words = ("--height-by", "direct", "--height", "2.5", "-o", tmp_path / "path")
    refused(mitsonar("odometry", url, "--view", "whole", *words), "give only one of them")


@pytest.mark.usefixtures("bare_curves")
class TestNetworks:
    """Networks that tell heights, and those that a height chooses."""

    torch = pytest.importorskip("torch", reason="torch is not installed: install mitsonar[learn]")
    pytest.importorskip("lightning", reason="Lightning is not installed: install mitsonar[learn]")
    pytestmark = pytest.mark.learn

    @staticmethod
    def trained(data: Path, run: Path, **words: Any) -> Any:
        from mitsonar.config.training import TrainOptions, training_recipe_from
        from mitsonar.training.run import train

        small = {
            "network": {"name": "posenetvec", "width": 1 / 16},
            "steps": 6,
            "validate": {"noise": ["none"], "every_steps": 3, "pairs": 4},
            "batch": 4,
        }
        return train(TrainOptions(training_recipe_from({**small, **words}), data, run))

    @pytest.mark.thorough
    def test_a_network_tells_the_height(self, heights: Path, tmp_path: Path, mitsonar: Command) -> None:
        from mitsonar.datasets.samples import SonarPairs
        from mitsonar.estimation.height_network import HeightNetwork
        from mitsonar.training.evaluate import predictions

        words = {"kind": "vector", "frames": 1, "views": ["whole", "c2"]}
        stored = self.trained(heights, tmp_path / "run", input=words)
        estimator = height_estimator_from(str(tmp_path / "run"))
        assert estimator.views == ("whole", "c2")
        source = open_views(str(heights), ["whole", "c2"], "vector", sequence=2)
        output = measured(source.read(np.arange(3)), estimator)[1]
        samples = SonarPairs(heights, part="all", **stored.arrangement, labels=stored.labels["kind"])
        expected, _ = predictions(stored, samples, numbers=[6, 7, 8])
        np.testing.assert_allclose([one.height_m for one in output], expected[:, 0], rtol=1e-5)
        rmse = stored.metrics["none"]["rmse"][0] / 1e3
        assert output[0].std_m == pytest.approx(rmse)
        done = mitsonar("height", heights, "--by", tmp_path / "run", "--sequence", 2)
        assert done.returncode == 0, done.stderr
        assert "vectors of whole, c2" in done.stdout
        for answer, valid in ((0.5, True), (1.05, True), (1.2, False), (-0.2, False)):
            far = HeightNetwork(stored)
            vars(far)["_network"] = lambda inputs, place=answer: self.torch.tensor([[20.0 * place - 10.0]])
            one = far.height(source.read([0]))
            assert one.valid is valid
            assert ("beyond the heights of training" in one.reason) is not valid
        level = source.read([0])
        assert level.poses is not None
        tilted = replace(level, poses=level.poses - [0, 0, 0, 0.2, 0, 0])
        assert "had a pitch of 78.5 deg" in estimator.height(tilted).reason
        blank = replace(level, values={view: 0 * one for view, one in level.values.items()})
        assert "nothing in the frame" in estimator.height(blank).reason
        motions = self.trained(heights, tmp_path / "motions", input={"kind": "vector", "views": ["c1"]})
        with pytest.raises(MitsonarError, match="estimates motions of 2 frames, not heights"):
            HeightNetwork(motions)

    @pytest.mark.thorough
    def test_the_network_trained_nearest_to_the_height_answers(
        self, heights: Path, tmp_path: Path, mitsonar: Command
    ) -> None:
        from mitsonar.estimation.named import create_estimator

        runs = []
        for name, seed in (("low", 0), ("high", 1)):
            self.trained(heights, tmp_path / name, input={"kind": "vector", "views": ["c1", "c2", "c3", "c4"]}, seed=seed)
            runs.append(tmp_path / name)
        both: Any = create_estimator(f"{runs[0]},{runs[1]}")
        both.networks[0]._checkpoint.trained_at["height_m"] = [2.0, 2.6]
        both.networks[1]._checkpoint.trained_at["height_m"] = [2.7, 4.0]
        assert [both.networks.index(both.chosen(height)) for height in (1.0, 2.3, 2.62, 2.69, 3, 9)] == [0, 0, 0, 1, 1, 1]
        source = open_views(str(heights), both.views, both.kind, sequence=1).with_heights_by(DirectHeight())
        pair = source.read([0, 1])
        assert pair.height_m is not None
        assert both.estimate(pair).motion == both.chosen(pair.height_m.mean()).estimate(pair).motion
        assert both.networks[0].estimate(pair).motion != both.networks[1].estimate(pair).motion
        with pytest.raises(MitsonarError, match="measure it with --height-by direct"):
            both.estimate(replace(pair, height_m=None))
        with pytest.raises(MitsonarError, match="zero was not trained at a height"):
            create_estimator(f"zero,{runs[0]}")
        words = ("--estimator", f"{runs[0]},{runs[1]}", "--height-by", "direct", "--sequence", "1", "-o", tmp_path / "path")
        done = mitsonar("odometry", heights, *words)
        assert done.returncode == 0, done.stderr
        self.trained(heights, tmp_path / "other", input={"kind": "vector", "views": ["c1"]})
        with pytest.raises(MitsonarError, match="must read the same views: got vectors of c1; vectors of c1, c2, c3, c4"):
            create_estimator(f"{runs[0]},{tmp_path / 'other'}")
