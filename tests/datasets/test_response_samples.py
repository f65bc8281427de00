"""Data sets of impulse responses: they hold what is simulated, and samples are those of Almanza-Medina, 5.2.5."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import Command, files_of, impulse_recipe, refused, run_python, tiny_recipe

from mitsonar.acoustics.noise import parse_snr
from mitsonar.config.data import load_recipe, shipped_recipes
from mitsonar.datasets.make import check, make_dataset
from mitsonar.datasets.overview import info
from mitsonar.datasets.plan import Plan, footprints_at, modality_of
from mitsonar.datasets.responses import ImpulseSamples, Packing, displacement_labels, noise_power, pack_responses, with_noise
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError
from mitsonar.estimation.named import create_estimator
from mitsonar.motion.composition import Motion, compose, motions, steady
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.reproduction.regressors import REGRESSORS, Turned, flattened, score_all
from mitsonar.simulation.scene import load_scene


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Path:
    """The small data set."""
    url = tmp_path_factory.mktemp("made") / "heard.zarr"
    make_dataset(impulse_recipe(), str(url))
    return url


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Path:
    """The same without turns, in pairs."""
    url = tmp_path_factory.mktemp("made") / "straight.zarr"
    make_dataset(
        impulse_recipe(scenes=[{"count": 2, "sequences": 10}], flight={"yaw_deg": 0.0, "pings": 2}, frames=2), str(url)
    )
    return url


# ---------------------------------------------------------------- what is stored


@pytest.mark.slow
def test_responses_are_what_the_simulator_hears(made: Path, tmp_path: Path) -> None:
    """Two routes: each scene is built, loaded and simulated here, ping by ping."""
    from mitsonar.simulation.channel import ChannelSimulator

    store, recipe = DataStore.open(made), impulse_recipe()
    response, scene = store.read("response"), store.read("scene")
    assert response.dtype == np.complex64
    assert response.shape == (120, 4, 200)
    for number, one in store.scenes.items():
        path, _ = recipe.family(one.group).prepare(one.seed, tmp_path / str(number))
        simulator = ChannelSimulator(load_scene(path), recipe.channel_sonar)
        for index in np.flatnonzero(scene == number)[::13]:
            (received,) = simulator.pings(store.read("pose")[index], store.read("velocity")[index])
            np.testing.assert_allclose(
                response[index], received.response[0], rtol=0, atol=1e-6 * np.abs(received.response).max()
            )
            assert store.read("height_m")[index] == pytest.approx(4.0, abs=0.01)
            np.testing.assert_array_equal(store.read("echoes")[index], received.echoes[0])
    assert np.abs(response).max(axis=2).min() > 0


@pytest.mark.slow
def test_the_same_recipe_gives_the_same_bytes_and_a_lost_shard_comes_back(made: Path, tmp_path: Path) -> None:
    url = tmp_path / "again.zarr"
    make_dataset(impulse_recipe(), str(url))
    assert files_of(url) == files_of(made)
    store = DataStore.open(url)
    (url / store.key("response", 0)).unlink()
    assert any("not written" in fault for fault in check(store))
    make_dataset(impulse_recipe(), str(url))
    assert files_of(url) == files_of(made)


@pytest.mark.thorough
def test_check_info_and_sheet(mitsonar: Command, made: Path, tmp_path: Path) -> None:
    assert check(DataStore.open(made)) == []
    table = info(DataStore.open(made))
    assert table["receivers"] == ["front", "left", "back", "right"]
    assert table["arrays"]["response"].startswith("120x4x200 complex64, ")
    assert {"gain", "levels", "views"}.isdisjoint(table)
    done = mitsonar("dataset", "info", made, "--json")
    assert json.loads(done.stdout)["model"] == "scatterers"
    assert mitsonar("dataset", "info", made).returncode == 0
    assert mitsonar("dataset", "show", made, "-o", tmp_path / "sheet.png", "--view", "back").returncode == 0
    assert (tmp_path / "sheet.png").stat().st_size > 10_000
    refused(
        mitsonar("dataset", "show", made, "-o", tmp_path / "other.png", "--view", "bow"), "unknown receiver bow", "front"
    )


def test_a_changed_velocity_is_found_and_mended(made: Path, tmp_path: Path) -> None:
    import shutil

    import zarr

    url = Path(shutil.copytree(made, tmp_path / "heard.zarr"))
    array = zarr.open_group(url, mode="r+")["velocity"]
    array[3] = np.asarray(array[3]) + 1e-3  # type: ignore[index]
    assert check(DataStore.open(url)) == ["velocity differs from the plan of recipe and seed"]
    make_dataset(impulse_recipe(), str(url), verify=True)
    assert files_of(url) == files_of(made)


def test_receivers_that_hear_nothing_and_echoes_from_too_far_are_told(tmp_path: Path, variant: str) -> None:
    up = {"name": "up", "field": {"tilt_deg": 180.0}}
    recipe = impulse_recipe(
        scenes=[{"count": 1, "sequences": 1}],
        channel={"receivers": [{"name": "low", "field": {"tilt_deg": 40.0}}, up], "range_max": 4.5},
        split={"by": "sequence"},
    )
    output = " ".join(make_dataset(recipe, str(tmp_path / "data.zarr")).warnings)
    assert "receiver up records no echo in 3 of 3 pings" in output
    assert re.search(r"came from beyond range_max 4\.5 m", output)


# ---------------------------------------------------------------- the plan


def test_velocities_are_those_of_the_poses() -> None:
    """A vehicle that keeps its first velocity is at each ping where the plan has it."""
    recipe = impulse_recipe(flight={"yaw_deg": 30.0, "pings": 6}, frames=2)
    plan, rate = Plan.of(recipe, 8), 40.0
    for sequence in range(8):
        mine = plan.sequence == sequence
        starboard, forward, up, turn = plan.velocity[mine][0]
        flown, _ = steady(Pose(*plan.vehicle[mine][0]), (starboard, forward, turn), 6, rate)
        np.testing.assert_allclose(flown.poses, plan.vehicle[mine], atol=1e-9)
        np.testing.assert_allclose(plan.velocity[mine], np.tile(plan.velocity[mine][0], (6, 1)), atol=1e-9)
        assert up == 0


def test_a_velocity_is_the_derivative_of_the_way() -> None:
    """Moved for 1 us at that velocity, by hand, and along the arc to the next ping in 10,000 steps."""
    start, motion = Pose(1, 2, 4, 0, 0, 0.7), Motion(0.1, -0.06, 0.3)
    way = np.array([start, compose(start, motion)])
    (starboard, forward, _, turn), last = velocities(Trajectory(way, np.arange(len(way)) / 20.0))
    np.testing.assert_array_equal([starboard, forward, 0, turn], last)
    steps = 10_000
    heading = 0.7 + turn * (np.arange(steps) + 0.5) / steps / 20
    x = 1 + np.sum(forward * np.sin(heading) + starboard * np.cos(heading)) / steps / 20
    y = 2 + np.sum(forward * np.cos(heading) - starboard * np.sin(heading)) / steps / 20
    np.testing.assert_allclose([x, y], way[1, :2], atol=1e-9)
    assert velocities(Trajectory(way[:1], np.zeros(1))).tolist() == [[0, 0, 0, 0]]


@pytest.mark.parametrize("shape", ["rectangular", "circular"])
def test_what_receivers_see_stays_inside_the_scene(shape: str) -> None:
    """Rays drawn at random that a receiver's field of view lets through meet the ground within the reach."""
    field = {"shape": shape, "heading_deg": 40.0, "tilt_deg": 35.0, "across_deg": 20.0, "along_deg": 30.0, "taper": 0.0}
    recipe = impulse_recipe(channel={"receivers": [{"name": "one", "position": [0.3, -0.2, 0.1], "field": field}]})
    (receiver,) = recipe.channel_sonar.receivers
    rays = np.random.default_rng(1).normal(size=(400_000, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    rays = rays[receiver.field.sensitivity(*(rays @ receiver.field.axes.T).T) > 0]
    assert len(rays) > 1000
    ground = np.array([0.3, -0.2]) - rays[:, :2] * 4.1 / rays[:, 2:]
    reach = modality_of(recipe).reach(4.0)
    for axis in range(2):
        assert reach[:, axis].min() - 1e-9 <= ground[:, axis].min() < reach[:, axis].min() + 0.15
        assert reach[:, axis].max() - 0.15 < ground[:, axis].max() <= reach[:, axis].max() + 1e-9
    plan = Plan.of(recipe)
    assert np.abs(footprints_at(plan.vehicle, reach)).max() <= 8.0


def test_no_place_in_a_small_scene_is_one_sentence() -> None:
    with pytest.raises(MitsonarError, match="no place for a sequence found"):
        Plan.of(impulse_recipe(world={"size_m": 8.0}), 1)
    with pytest.raises(MitsonarError, match="cannot see the ground: it is 9 m above it, but range_max is 8 m"):
        Plan.of(impulse_recipe(flight={"height_m": 9.0}), 1)


# ---------------------------------------------------------------- recipes

TURNING = {"impulse-yaw": "impulse-standard", "impulse-yaw-narrow": "impulse-narrow", "impulse-yaw-ten": "impulse-ten-80khz"}
"""Recipes that turn, and those that do not."""

TABLE: dict[str, tuple[int, float, float, int, int, str, float, float]] = {
    "impulse-two-receivers": (2, 80, 4.8, 800, 2, "rectangular", 10, 0.001),
    "impulse-40khz": (4, 40, 4.8, 800, 2, "rectangular", 10, 0.001),
    "impulse-60khz": (4, 60, 4.8, 800, 2, "rectangular", 10, 0.001),
    "impulse-standard": (4, 80, 4.8, 800, 2, "rectangular", 10, 0.001),
    "impulse-narrow": (4, 80, 4.8, 800, 2, "rectangular", 2, 0.001),
    "impulse-circular-4800": (4, 80, 4.8, 800, 2, "circular", 10, 0.001),
    "impulse-100khz": (4, 100, 4.8, 800, 2, "rectangular", 10, 0.001),
    "impulse-160khz": (4, 160, 4.8, 800, 2, "rectangular", 10, 0.001),
    "impulse-wideband-9600": (4, 80, 9.6, 1600, 2, "rectangular", 10, 0.001),
    "impulse-wideband-19200": (4, 80, 19.2, 3200, 2, "rectangular", 10, 0.001),
    "impulse-circular-19200": (4, 80, 19.2, 3200, 2, "circular", 10, 0.001),
    "impulse-high-objects": (4, 80, 4.8, 800, 2, "rectangular", 10, 0.1),
    "impulse-ten-80khz": (4, 80, 4.8, 800, 10, "rectangular", 10, 0.001),
    "impulse-ten-160khz": (4, 160, 4.8, 800, 10, "rectangular", 10, 0.001),
    "impulse-ten-320khz": (4, 320, 4.8, 800, 10, "rectangular", 10, 0.001),
}
"""Rows of table 5.2: receivers, carrier, bandwidth [kHz], taps, Q, field of view, its width [deg], objects' height [m]."""


def test_recipes_are_the_rows_of_the_table() -> None:
    assert {name for name in shipped_recipes() if name.startswith("impulse-")} == {*TABLE, *TURNING}
    for name, (receivers, carrier, band, taps, pings, shape, across, thick) in TABLE.items():
        recipe = load_recipe(name)
        sonar, flight, family = recipe.channel_sonar, recipe.flight, recipe.family(0)
        assert (len(sonar.receivers), sonar.carrier_hz, sonar.bandwidth_hz) == (receivers, 1e3 * carrier, 1e3 * band), name
        assert (sonar.taps, recipe.frames, flight.pings, recipe.sequences) == (taps, pings, pings, 3000), name
        assert {(one.field.shape, one.field.across_deg) for one in sonar.receivers} == {(shape, across)}, name
        assert {one.field.tilt_deg for one in sonar.receivers} == {45.0 if shape == "circular" else 25.0}
        assert (family.half_m, getattr(family, "thickness_m"), getattr(family, "seabed_cells")) == (25, thick, 2048)  # noqa: B009
        assert (pings - 1) / sonar.frame_rate_hz == pytest.approx(0.05)
        assert np.allclose(displacement_labels("raw", recipe, pings).high, [0.1, 0.1])
        assert flight.heights == (10, 10)
        assert sonar.model == "rays"
        np.testing.assert_allclose(np.linalg.norm(sonar.offsets, axis=1), 0.1)
        assert [one.name for one in sonar.receivers] == (
            ["front", "right"] if receivers == 2 else ["front", "left", "back", "right"]
        )
    for name, still in TURNING.items():
        turning = load_recipe(name)
        assert turning.flight.yaw_deg * (turning.flight.pings - 1) == pytest.approx(0.45)
        assert turning.channel_sonar.model == "scatterers"  # ours
        local = {"flight": 0, "name": 0, "about": 0, "channel": 0}
        second = load_recipe(still, {"channel.model": "scatterers"})
        assert {**turning.model_dump(), **local} == {**second.model_dump(), **local}
        assert turning.channel_sonar.model_dump(exclude={"name"}) == second.channel_sonar.model_dump(exclude={"name"})


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"channel": {"carrier_hz": 0}}, "carrier_hz must exceed half the band"),
        ({"channel": {"frequency_step_hz": 100}}, "frequency_step_hz must be below"),
        ({"channel": {"bandwidth_hz": 6000}}, "sampling_hz must be at least"),
        ({"channel": {"carier_hz": 1}}, "unknown channel sonar key carier_hz: did you mean carrier_hz"),
        ({"sonar": {"preset": "didson300"}}, "impulse responses): got both"),
        ({"channel": None}, "impulse responses): got neither"),
        ({"mount": {"pitch_deg": 35}}, "mount belongs to images"),
        ({"store": "vectors"}, "store belongs to images"),
        ({"segments": ["q1"]}, "segments belongs to images"),
        ({"flight": {"footprint_fov_deg": [30, 14]}}, "flight.footprint_fov_deg belongs to images"),
        ({"frames": 4}, "frames must be at most flight.pings, 3: got 4"),
    ],
)
def test_mistakes_in_recipes_are_one_sentence(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(MitsonarError, match=re.escape(sentence)) as error:
        impulse_recipe(**changes)
    assert "\n" not in str(error.value)


# ---------------------------------------------------------------- reading


def test_packing_is_that_of_the_text() -> None:
    """5.2.5, column by column."""
    rng = np.random.default_rng(2)
    response = rng.normal(size=(5, 3, 2, 7)) + 1j * rng.normal(size=(5, 3, 2, 7))
    matrix = pack_responses(response)
    assert matrix.shape == (5, 7, 2 * 2 * 3)
    for sample, receiver, ping in itertools.product(range(5), range(2), range(3)):
        unit = response[sample, ping, receiver] / np.abs(response[sample]).max()
        np.testing.assert_allclose(matrix[sample, :, 6 * receiver + ping], unit.real, rtol=1e-6)
        np.testing.assert_allclose(matrix[sample, :, 6 * receiver + 3 + ping], unit.imag, rtol=1e-6)
    assert not pack_responses(np.zeros((1, 2, 1, 4), complex)).any()


def test_samples_are_the_stored_pings(made: Path) -> None:
    samples = ImpulseSamples(made, part="all", labels="raw")
    assert len(samples) == 40
    for index in (0, 7, 39):
        here = samples.frame_slice(index)
        assert (here.start, here.stop) == (3 * index, 3 * index + 3)
        stored = samples.store.read("response", here)
        received = samples.responses(index)
        np.testing.assert_array_equal(received.response, stored)
        np.testing.assert_array_equal(samples.matrix(index), pack_responses(stored))
        assert received.poses is not None
        np.testing.assert_allclose(samples.target(index), motions(received.poses[[0, -1]])[0])
        np.testing.assert_allclose(received.time_s, [0, 0.025, 0.05])
        assert received.velocity is not None
        assert received.sonar == impulse_recipe().channel_sonar
    assert samples.labels.names == ("sideways (m)", "forward (m)", "yaw (rad)")
    np.testing.assert_allclose(samples.labels.high, [0.1, 0.1, np.radians(0.8)])
    two = ImpulseSamples(made, part="all", frames=2)
    assert len(two) == 80
    np.testing.assert_allclose(two.labels.high, [0.05, 0.05, np.radians(0.4)])


def test_without_turns_there_are_two_labels(straight: Path) -> None:
    samples = ImpulseSamples(straight, part="all")
    assert samples.labels.names == ("sideways (m)", "forward (m)")
    assert samples.targets().shape == (20, 2)
    np.testing.assert_allclose(samples.targets(), samples.chosen.motion[::2, :2], atol=1e-12)


def test_no_world_is_in_two_parts(made: Path) -> None:
    parts = [ImpulseSamples(made, part=part) for part in ("train", "validation")]
    worlds = [set(part.scene[part.first].tolist()) for part in parts]
    assert not worlds[0] & worlds[1]
    assert [len(part) for part in parts] == [20, 20]
    by_sequence = ImpulseSamples(made, part="train", split={"by": "sequence", "train": 0.8, "validation": 0.2})
    assert len(by_sequence) == 32


def test_noise_has_the_ratio_that_is_said() -> None:
    """White, complex, as strong in every ping, receiver and tap; the signal lies between 1 % and 99 % of the energy."""
    rng = np.random.default_rng(3)
    response = np.zeros((2, 3, 4000), np.complex64)
    response[..., 1000:2000] = (rng.normal(size=(2, 3, 1000)) + 1j * rng.normal(size=(2, 3, 1000))) * 3
    assert noise_power(response, 20) == pytest.approx(0.18, rel=0.03)
    noise = with_noise(response, [5, 6], 20, 1) - response
    assert (np.abs(noise) ** 2).mean(axis=2) == pytest.approx(np.full((2, 3), 0.18), rel=0.1)
    assert noise.real.var() == pytest.approx(noise.imag.var(), rel=0.05)
    assert abs((noise[0] * noise[1].conj()).mean()) < 0.01
    assert abs((noise[..., 1:] * noise[..., :-1].conj()).mean()) < 0.01
    assert with_noise(response, [5, 6], None, 1) is response
    assert parse_snr("12.5 dB") == 12.5
    assert parse_snr("none") is None
    for text in ("high", "12", "dB"):
        with pytest.raises(MitsonarError, match="'20 dB', or none: got"):
            parse_snr(text)


def test_noise_belongs_to_seed_and_ping(made: Path) -> None:
    samples = ImpulseSamples(made, part="all", noise="10 dB", seed=4)
    quiet = ImpulseSamples(made, part="all")
    noise = samples.responses(3).response - quiet.responses(3).response
    np.testing.assert_array_equal(samples.responses(3).response, samples.responses(3).response)
    parts = {part.tobytes() for part in noise.reshape(12, -1)}
    assert len(parts) == 12
    second = ImpulseSamples(made, part="all", noise="10 dB", seed=5).responses(3).response
    assert not np.array_equal(second, samples.responses(3).response)
    levels = Packing(("a",), (None, 0.0))
    one = np.ones((2, 1, 9), np.complex64)
    changed = [not np.array_equal(levels.received(one, [number, number + 1], 0), one) for number in range(60)]
    assert 15 < sum(changed) < 45


def test_leaks_show_no_motion(made: Path) -> None:
    plain = ImpulseSamples(made, part="all")
    alone = ImpulseSamples(made, part="all", leak="one_ping")
    strangers = ImpulseSamples(made, part="all", leak="strangers", seed=1)
    for index in (0, 21):
        first = plain.response(index)[0]
        for ping in alone.response(index):
            np.testing.assert_array_equal(ping, first)
        theirs = strangers.response(index)
        np.testing.assert_array_equal(theirs[0], first)
        place = np.flatnonzero((plain.store.read("response") == theirs[1]).all(axis=(1, 2)))
        assert len(place) == 1
        assert plain.scene[place[0]] != plain.scene[plain.first[index]]
        np.testing.assert_array_equal(strangers.target(index), plain.target(index))
    with pytest.raises(MitsonarError, match="leak must be one of none, one_ping, strangers: got 'ping'"):
        ImpulseSamples(made, leak="ping")  # type: ignore[arg-type]


@pytest.mark.thorough
def test_responses_are_read_without_torch_and_without_a_renderer(made: Path) -> None:
    script = f"""
        from mitsonar.datasets.responses import ImpulseSamples
        print(ImpulseSamples({str(made)!r}, noise="20 dB").responses(0).response.shape)
    """
    assert "(3, 4, 200)" in run_python(script, block=("torch", "mitsuba", "drjit", "finufft"))


def test_the_wrong_kind_of_data_set_is_one_sentence(made: Path) -> None:
    with pytest.raises(
        MitsonarError, match="the data set tiny holds images, but responses are needed: read it with SonarPairs"
    ):
        tiny_recipe().channel_sonar  # noqa: B018
    with pytest.raises(MitsonarError, match="frames must be at least 2, for a first and a last ping: got 1"):
        ImpulseSamples(made, frames=1)
    pytest.importorskip("torch", reason="torch is not installed: install mitsonar[learn]")
    from mitsonar.datasets.samples import SonarPairs

    with pytest.raises(MitsonarError, match="the data set received holds impulse responses, but images are needed"):
        SonarPairs(made)


@pytest.mark.thorough
def test_estimators_are_compared_on_its_samples(mitsonar: Command, straight: Path, tmp_path: Path) -> None:
    """RMSE in the table against the estimator asked by hand."""
    pytest.importorskip("torch", reason="torch is not installed: install mitsonar[learn]")
    words = ("compare", straight, "--part", "all", "--estimators", "zero,correlation", "--noise", "none,20 dB", "--seed", 3)
    done = mitsonar(*words, "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    tables = json.loads((tmp_path / "out" / "table.json").read_text())["tables"]
    assert [table["noise"] for table in tables] == ["none", "20 dB"]
    for table in tables:
        samples = ImpulseSamples(straight, part="all", noise=table["noise"], seed=3, one_per_sequence=True)
        answers = [create_estimator("correlation").estimate(samples.responses(k)) for k in range(len(samples))]
        output = np.array([one.motion[:2] if one.valid else (0, 0) for one in answers])
        expected = 1e3 * np.sqrt(((output - samples.targets()) ** 2).mean(axis=0))
        row = next(row for row in table["rows"] if row["method"] == "correlation")
        np.testing.assert_allclose(row["rmse"][:2], expected, rtol=1e-9)
    refused(mitsonar("compare", straight, "--part", "all", "--perturb"), "only to data sets of images")
    refused(mitsonar("odometry", straight, "-o", tmp_path / "path", "--estimator", "correlation"), "holds impulse responses")


# ---------------------------------------------------------------- regressors


@pytest.mark.thorough
def test_regressors_are_those_of_the_table() -> None:
    """Table 5.4; a linear relation is found by the linear ones, and by all better than by no answer."""
    assert len(REGRESSORS) == 10
    rng = np.random.default_rng(5)
    features = rng.normal(size=(260, 6)).astype(np.float32)
    motion = np.column_stack([features[:, 1], features @ [0.02, -0.01, 0.03, 0, 0, 0.01]]) * 1.0
    train, test = (features[:200], motion[:200]), (features[200:], motion[200:])
    scores = {score.name: score for score in score_all(train, test)}
    assert list(scores) == list(REGRESSORS)
    for name, score in scores.items():
        assert score.rmse_mm < 0.9 * score.zero_mm, name
        assert score.features == 6
    assert scores["Linear Regression"].rmse_mm < 1e-3
    assert scores["Linear SVM"].rmse_mm < 0.2 * scores["Linear SVM"].zero_mm
    assert scores["Rational Quadratic GPR"].rmse_mm < 0.1 * scores["Linear SVM"].zero_mm
    (turned,) = score_all(train, test, names=["Linear Regression"], components=6)
    assert turned.rmse_mm < 1e-3
    (sideways,) = score_all(train, test, names=["Fine Tree"], axis=0)
    assert sideways.zero_mm == pytest.approx(1e3 * np.sqrt((motion[200:, 0] ** 2).mean()))


def test_turned_features_keep_distances() -> None:
    rng = np.random.default_rng(6)
    train, test = rng.normal(size=(9, 40)) + 3, rng.normal(size=(4, 40))
    turned = Turned().fit(train)
    one, second = turned.transform(train), turned.transform(test)
    assert one.shape == (9, 10)
    for a, b, wide_a, wide_b in ((one, one, train, train), (second, one, test, train)):
        near, far = (np.linalg.norm(x[:, None] - y[None], axis=2) for x, y in ((a, b), (wide_a, wide_b)))
        np.testing.assert_allclose(near, far, atol=1e-6)


def test_regressors_read_a_data_set(straight: Path) -> None:
    parts = [flattened(ImpulseSamples(straight, part=part)) for part in ("train", "validation")]
    assert parts[0][0].shape == (10, 200 * 16)
    (score,) = score_all(*parts, names=["Coarse Tree"], components=5)
    assert score.features == 5
    assert np.isfinite(score.rmse_mm)
    with pytest.raises(MitsonarError, match="unknown regressor 'Tree': did you mean"):
        score_all(*parts, names=["Tree"])
    with pytest.raises(MitsonarError, match="components must be 1 to 10"):
        score_all(*parts, components=11)
    with pytest.raises(MitsonarError, match="axis must be 0"):
        score_all(*parts, axis=2)
