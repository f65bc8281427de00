"""What torch reads: the right frames and labels, in parts that share nothing; from a store or rendered, the same."""

from __future__ import annotations

import inspect
import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import DOWN, run_python, tiny_recipe

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.config.data import Split, load_recipe
from mitsonar.datasets.make import make_dataset
from mitsonar.errors import MitsonarError
from mitsonar.geometry.fan import to_cartesian
from mitsonar.motion.pose import Pose

torch = pytest.importorskip("torch", reason="torch is not installed: install mitsonar[learn]")
pytestmark = [pytest.mark.learn, pytest.mark.usefixtures("variant")]

from torch.utils.data import DataLoader  # noqa: E402

from mitsonar.datasets.arrangement import Labels, arrangement_of  # noqa: E402
from mitsonar.datasets.rendered import RenderedPairs  # noqa: E402
from mitsonar.datasets.samples import SampleOptions, Samples, SonarPairs  # noqa: E402

HIGH = NOISE_MODELS["high"]


@pytest.fixture(scope="module")
def made(tiny_data: Path) -> Path:
    """Three scenes of ten sequences of five pings."""
    return tiny_data


@pytest.fixture(scope="module")
def portions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A looking-down sonar in four quadrants, as images and as vectors."""
    url = tmp_path_factory.mktemp("made") / "portions.zarr"
    recipe = tiny_recipe(**DOWN, segments=["q1", "q3"], store="both", pixel="float32", scenes=[{"sequences": 12}])
    make_dataset(recipe, str(url))
    return url


# ---------------------------------------------------------------- samples


def test_a_sample_is_consecutive_frames_and_the_motion_between_them(made: Path) -> None:
    """Labels from the poses, by hand: the way from one to the next in the axes of the next (eq. 3.4)."""
    pairs = SonarPairs(made, part="all")
    assert len(pairs) == 3 * 10 * 4
    image, pose = pairs.store.read("image"), pairs.store.read("pose")
    for index in range(0, len(pairs), 7):
        pixels, label = pairs[index]
        first = pairs.frame_slice(index).start
        assert pixels.dtype == label.dtype == torch.float32
        np.testing.assert_allclose(
            pixels[0].numpy(), np.hstack([image[first], image[first + 1]]) / np.float32(255), atol=1e-7
        )
        here, there = Pose(*pose[first]), Pose(*pose[first + 1])
        east, north = there.x - here.x, there.y - here.y
        sin, cos = np.sin(there.heading), np.cos(there.heading)
        expected = [east * cos - north * sin, east * sin + north * cos, there.heading - here.heading]
        np.testing.assert_allclose(label, np.array(expected, dtype=np.float32), atol=1e-8)


def test_three_frames_have_the_mean_motion_and_one_its_height(made: Path) -> None:
    triples = SonarPairs(made, part="all", frames=3)
    assert len(triples) == 3 * 10 * 3
    assert triples[0][0].shape == (1, 40, 36)
    np.testing.assert_allclose(triples[0][1], triples.store.read("motion")[0:2].mean(axis=0), rtol=1e-6)
    heights = SonarPairs(made, part="all", frames=1)
    assert len(heights) == 150
    assert heights[3][1].tolist() == [2.5]
    for many in (6, 149, 151, 400):
        with pytest.raises(MitsonarError, match=f"no sample of {many} frames"):
            SonarPairs(made, frames=many)


def test_samples_never_cross_from_one_sequence_to_the_next(made: Path) -> None:
    pairs = SonarPairs(made, part="all")
    last = pairs.first + pairs.frames - 1
    np.testing.assert_array_equal(pairs.sequence[pairs.first], pairs.sequence[last])
    assert np.isfinite([pairs.target(index) for index in range(len(pairs))]).all()
    one = SonarPairs(made, part="all", one_per_sequence=True)
    np.testing.assert_array_equal(one.sequence[one.first], np.arange(30))
    assert len(set(one.first % 5)) > 1  # not always the first pair


@pytest.mark.parametrize("kind", ["numpy", "torch"])
@pytest.mark.parametrize("frames", [2, 3])
def test_shapes_of_almanza_medina(frames: int, kind: str) -> None:
    """Two frames side by side are 512 x 192."""
    recipe = load_recipe("rocky-field")
    pixels = np.random.default_rng(0).integers(0, 256, (4, frames, 512, 96), dtype=np.uint8)
    numbers = np.arange(4 * frames).reshape(4, frames)
    batch, order = (pixels, numbers) if kind == "numpy" else (torch.as_tensor(pixels), torch.as_tensor(numbers))
    (view,) = recipe.views

    def shape(**words: Any) -> tuple[Any, ...]:
        result = arrangement_of(recipe, **words)({view.name: batch}, order, 0)
        return tuple(part.shape for part in result) if isinstance(result, tuple) else tuple(result.shape)

    assert shape() == (4, 1, 512, 96 * frames)
    assert shape(layout="stack") == (4, 1, 512 * frames, 96)
    assert shape(layout="channels") == (4, frames, 512, 96)
    assert shape(kind="vector") == (4, 1, 512, frames)
    assert shape(kind="vector", layout="channels") == (4, frames, 512)
    rows, columns = shape(coordinates="cartesian", layout="channels", cartesian_rows=100)[2:]
    assert rows == 100
    assert shape(coordinates="both", cartesian_rows=100) == ((4, 1, 512, 96 * frames), (4, 1, 100, columns * frames))


def test_layouts_hold_the_same_frames(made: Path) -> None:
    side, stack, channels = (SonarPairs(made, part="all", layout=word)[5][0] for word in ("side", "stack", "channels"))
    torch.testing.assert_close(torch.cat(list(channels), dim=1), side[0], rtol=0, atol=0)
    torch.testing.assert_close(torch.cat(list(channels), dim=0), stack[0], rtol=0, atol=0)


def test_cartesian_is_the_scan_conversion_of_geometry(made: Path) -> None:
    (polar, fan), _ = SonarPairs(made, part="all", coordinates="both", layout="channels", cartesian_rows=60)[11]
    sonar = tiny_recipe().instrument
    for q in range(2):
        expected = to_cartesian(polar[q].numpy(), sonar.range_m, sonar.bearing_rad, rows=60).image
        np.testing.assert_allclose(fan[q], np.nan_to_num(expected), atol=1e-6)
    assert fan.max() > 0.1


# ---------------------------------------------------------------- noise


@pytest.mark.parametrize("kind", ["image", "vector"])
def test_noise_belongs_to_seed_epoch_and_frame(portions: Path, kind: str) -> None:
    """The same in a batch, alone, and in NumPy; another in another epoch, seed or frame, and in another view."""
    pairs = SonarPairs(portions, part="all", kind=kind, layout="channels", noise="high", seed=4)
    (batch, _) = next(pairs.loader(6, shuffle=False))
    for index in range(6):
        torch.testing.assert_close(batch[index], pairs[index][0], rtol=0, atol=0)
    raw = {name: np.asarray(values)[None] for name, values in pairs.raw(2).items()}
    np.testing.assert_array_equal(pairs.arrange(raw, raw["frames"], 4)[0], pairs[2][0].numpy())
    torch.testing.assert_close(pairs[1][0][1], pairs[2][0][0], rtol=0, atol=0)  # frame 2, in two samples
    silent = SonarPairs(portions, part="all", kind=kind, layout="channels")
    noise = (pairs[0][0] - silent[0][0]).reshape(4, -1)  # two views, two frames
    assert len({tuple(part.tolist()) for part in noise}) == 4
    assert not torch.equal(
        SonarPairs(portions, part="all", kind=kind, layout="channels", noise="high", seed=5)[0][0], pairs[0][0]
    )
    before = pairs[0][0]
    pairs.set_epoch(1)
    assert not torch.equal(pairs[0][0], before)
    pairs.set_epoch(0)
    assert torch.equal(pairs[0][0], before)


def test_noise_on_stored_images_is_that_of_the_model(made: Path) -> None:
    noisy = SonarPairs(made, part="all", noise="high", layout="channels", seed=9)[20][0]
    plain = SonarPairs(made, part="all", layout="channels")
    here = plain.frame_slice(20)
    np.testing.assert_array_equal(noisy, HIGH.apply(plain[20][0].numpy(), seed=9, frames=np.arange(here.start, here.stop)))


def test_vectors_of_a_store_are_its_images_summed(portions: Path) -> None:
    """Stored as sums, or summed when read; noise of both has the same distribution."""
    stored = SonarPairs(portions, part="all", kind="vector", layout="channels")
    images = SonarPairs(portions, part="all", kind="image", layout="channels")
    for index in (0, 13):
        np.testing.assert_allclose(stored[index][0], images[index][0].sum(dim=-1), rtol=1e-5, atol=1e-6)
    assert [view.name for view in stored.recipe.views] == ["q1", "q3"]
    one = SonarPairs(portions, part="all", kind="vector", layout="channels", views=[stored.arrange.views[1]])
    torch.testing.assert_close(one[3][0], stored[3][0][2:], rtol=0, atol=0)


def test_views_stand_in_the_order_in_which_they_are_asked_for(portions: Path) -> None:
    both = SonarPairs(portions, part="all", kind="vector")
    names = both.arrange.views
    turned = SonarPairs(portions, part="all", kind="vector", views=list(names[::-1]))
    torch.testing.assert_close(turned[4][0][..., [2, 3, 0, 1]], both[4][0], rtol=0, atol=0)
    assert SonarPairs(portions, views="q3").arrange.views == ("q3",)
    with pytest.raises(MitsonarError, match="q1, q3"):
        SonarPairs(portions, views=["quadrant-9"])


def test_frames_for_estimators(made: Path) -> None:
    pairs = SonarPairs(made, part="all", noise="low", seed=2, layout="channels")
    frames = pairs.sonar_frames(17)
    np.testing.assert_array_equal(frames.image, pairs[17][0].numpy())
    np.testing.assert_array_equal(frames.poses, pairs.store.read("pose")[pairs.frame_slice(17)])
    np.testing.assert_array_equal(frames.height_m, [2.5, 2.5])
    assert frames.sonar.beams == 12
    drawn = SonarPairs(made, part="all", noise=["low", "high"], layout="channels")  # each sample draws its level
    for index in range(0, 120, 12):
        np.testing.assert_array_equal(drawn.sonar_frames(index).image, drawn[index][0].numpy())


# ---------------------------------------------------------------- labels


def test_labels_quantised_and_in_ten() -> None:
    """32 levels over the limits of the flight; +-10 over the same; both go back."""
    recipe = load_recipe("rocky-field")
    limit = np.array([0.02, 0.02, np.radians(0.45)])
    motion = np.random.default_rng(1).uniform(-1, 1, (500, 3)) * limit
    quantised, ten, raw = (Labels.of(kind, recipe, 2) for kind in ("quantised", "normx10", "raw"))
    np.testing.assert_array_equal(quantised.encode([-limit, 0 * limit, limit])[[0, 2]], [[0] * 3, [31] * 3])
    levels = quantised.encode(motion)
    assert set(np.unique(levels)) == set(range(32))
    assert np.abs(quantised.decode(levels) - motion).max() <= (limit / 31).max() * (1 + 1e-6)
    assert (np.abs(quantised.decode(levels) - motion) <= limit / 31 * (1 + 1e-5)).all()
    np.testing.assert_allclose(ten.encode([limit, -limit]), [[10] * 3, [-10] * 3])
    np.testing.assert_allclose(ten.decode(ten.encode(motion)), motion, atol=1e-8)
    np.testing.assert_array_equal(raw.encode(motion), motion.astype(np.float32))
    assert raw.names == ("sideways (m)", "forward (m)", "yaw (rad)")
    height = Labels.of("normx10", load_recipe("height-rocky"), 1)
    np.testing.assert_allclose(height.decode(height.encode([[2.4]])), [[2.4]], atol=1e-6)
    still = Labels.of("normx10", tiny_recipe(flight__yaw_deg=0.0), 2)
    assert still.encode([[0.0, 0.0, 0.0]]).tolist() == [[0, 0, 0]]
    with pytest.raises(MitsonarError, match=re.escape("normx10")):
        Labels.of("norm10", recipe, 2)


# ---------------------------------------------------------------- parts


def frames_in(pairs: SonarPairs) -> set[int]:
    return {number for index in range(len(pairs)) for number in range(*pairs.frame_slice(index).indices(10**9))}


@pytest.mark.parametrize("by", ["sequence", "scene"])
def test_no_image_and_by_scene_no_world_is_in_two_parts(made: Path, by: str) -> None:
    """Compared by their pixels, not by their numbers."""
    split = Split(by=by, train=0.5, validation=0.3, test=0.2)
    parts = {part: SonarPairs(made, part=part, split=split) for part in ("train", "validation", "test")}
    numbers = {part: frames_in(pairs) for part, pairs in parts.items()}
    assert set.union(*numbers.values()) == frames_in(SonarPairs(made, part="all"))
    images = SonarPairs(made, part="all").store.read("image")
    seen = {part: {images[number].tobytes() for number in mine} for part, mine in numbers.items()}
    for one, second in itertools.combinations(parts, 2):
        assert not seen[one] & seen[second], f"{one} and {second} share an image"
        shared = set(parts[one].scene[parts[one].first]) & set(parts[second].scene[parts[second].first])
        assert bool(shared) == (by == "sequence")
    assert len({scene.seed for scene in parts["train"].store.scenes.values()}) == 3
    if by == "sequence":
        assert [len(pairs) for pairs in parts.values()] == [15 * 4, 9 * 4, 6 * 4]


def test_samples_dealt_out_one_by_one_share_sequences_but_those_for_test_do_not(made: Path) -> None:
    """Every sample is in one part. Without a test part the draw is that of samples alone."""
    split = Split(by="sample", train=0.6, validation=0.2, test=0.2)
    train, validation, test = parts_of(made, split)
    every = [*train.first, *validation.first, *test.first]
    assert sorted(every) == list(SonarPairs(made, part="all").first)
    assert [len(pairs) for pairs in (train, validation, test)] == [72, 24, 24]  # of 30 sequences of 4 samples
    of = [set(pairs.sequence[pairs.first]) for pairs in (train, validation, test)]
    assert len(of[2]) == 6
    assert of[1] <= of[0]
    assert not of[2] & (of[0] | of[1])
    named = SonarPairs(made, part="test", split="sample")
    assert (named.split.by, named.split.test) == ("sample", 0.05)
    alone = parts_of(made, Split(by="sample", train=0.7, validation=0.3))[:1]
    assert len(alone[0]) == 84


@pytest.mark.thorough
def test_scenes_of_one_world_stay_together(tmp_path: Path) -> None:
    """A scene file, or a picture as seabed, is the same world whatever the seed."""
    world = {"family": "pattern", "texture": "photo_sand"}
    recipe = tiny_recipe(
        world=world, scenes=[{"count": 2, "sequences": 4}, {"count": 2, "sequences": 4, "world": {"texture": "gaussian"}}]
    )
    make_dataset(recipe, str(tmp_path / "photo.zarr"))
    split = Split(by="scene", train=0.5, validation=0.3, test=0.2)
    result = [set(pairs.scene[pairs.first]) for pairs in parts_of(tmp_path / "photo.zarr", split)]
    assert sorted(map(len, result)) == [1, 1, 2]
    assert {0, 1} in result
    one = make_dataset(tiny_recipe(world=world, split={"by": "scene"}), str(tmp_path / "one.zarr"))
    assert any("too few for train 95%" in sentence for sentence in one.warnings)
    with pytest.raises(MitsonarError, match="1 different scene, too few"):
        SonarPairs(tmp_path / "one.zarr", split=split)


def parts_of(url: Path, split: Split) -> list[SonarPairs]:
    parts = ("train", "validation", "test") if split.test else ("train", "validation")
    return [SonarPairs(url, part=part, split=split) for part in parts]


def test_parts_do_not_depend_on_the_seed_of_noise_and_order(made: Path) -> None:
    """Another seed for validation must not move training samples into it."""
    for seed in (0, 1, 2):
        np.testing.assert_array_equal(
            SonarPairs(made, split="scene", seed=seed).first, SonarPairs(made, split="scene").first
        )
    second = Split(by="sequence", train=0.5, validation=0.5, seed=3)
    same = Split(by="sequence", train=0.5, validation=0.5)
    assert not np.array_equal(SonarPairs(made, split=second).first, SonarPairs(made, split=same).first)


def test_parts_that_are_not_there_are_refused(made: Path) -> None:
    with pytest.raises(MitsonarError, match="train, validation, test or all: got 'training'"):
        SonarPairs(made, part="training")
    with pytest.raises(MitsonarError, match="no test part"):
        SonarPairs(made, part="test", split="sequence")
    with pytest.raises(MitsonarError, match=r"sequence, scene, sample, or keys .*got 'world'"):
        SonarPairs(made, split="world")
    with pytest.raises(MitsonarError, match="unknown split key trian: did you mean train"):
        SonarPairs(made, split={"trian": 0.5})
    assert len(SonarPairs(made, split={"train": 0.5, "validation": 0.5})) == 60
    for noise in (None, 0.1):
        with pytest.raises(MitsonarError, match="noise must be a name"):
            SonarPairs(made, noise=noise)  # type: ignore[arg-type]
    with pytest.raises(MitsonarError, match="channels: got 'beside'"):
        SonarPairs(made, layout="beside")


# ---------------------------------------------------------------- loading


def test_the_order_of_an_epoch_is_a_function_of_seed_and_epoch(made: Path) -> None:
    pairs = SonarPairs(made, part="all", seed=3)

    def labels() -> Any:
        return torch.cat([label for _, label in pairs.loader(16)])

    first, again = labels(), labels()
    assert torch.equal(first, again)
    pairs.set_epoch(1)
    second = labels()
    assert not torch.equal(first, second)
    assert torch.equal(first.sort(dim=0).values, second.sort(dim=0).values)
    assert sum(len(label) for _, label in pairs.loader(16, drop_last=True)) == 112


@pytest.mark.parametrize(
    "start", [pytest.param("fork", marks=pytest.mark.posix), pytest.param("spawn", marks=pytest.mark.thorough)]
)
def test_workers_of_a_data_loader_read_the_same(made: Path, start: str) -> None:
    """Forked too, as torch does unasked on Linux, after the store has been read in the parent."""
    pairs = SonarPairs(made, part="all", noise="high")
    alone = [pairs[index][0] for index in range(0, 24)]
    loader = DataLoader(pairs, batch_size=8, num_workers=2, multiprocessing_context=start, timeout=180)
    batches = [batch for batch, _ in itertools.islice(loader, 3)]
    torch.testing.assert_close(torch.cat(batches), torch.stack(alone), rtol=0, atol=0)


@pytest.mark.thorough
def test_stores_are_read_without_a_renderer(made: Path) -> None:
    """Whoever trains need not be able to render."""
    script = f"""
        from mitsonar import SonarPairs
        image, label = SonarPairs({str(made)!r}, noise="high", coordinates="both")[0]
        print(image[0].shape, label.shape)
    """
    assert "torch.Size([1, 40, 24]) torch.Size([3])" in run_python(script, block=("mitsuba", "drjit"))


# ---------------------------------------------------------------- rendered


@pytest.mark.thorough
def test_rendered_samples_are_those_of_a_store_of_their_worlds(tmp_path: Path) -> None:
    """Two routes, bit for bit, jitter included: through a store on disk, and straight from the renderer."""
    recipe = tiny_recipe(scenes=[{"count": 2, "sequences": 6}], sonar__jitter=True)
    rendered = RenderedPairs(
        recipe,
        seed=5,
        sequences_per_world=6,
        buffer=1,
        length=48,
        gain=0.02,
        noise="none",
        layout="channels",
        labels="normx10",
    )
    make_dataset(rendered.worlds, str(tmp_path / "same.zarr"))
    stored = SonarPairs(tmp_path / "same.zarr", part="all", layout="channels", labels="normx10")
    rendered.gain = stored.store.about["gain"]
    count = 0
    for index, (image, label) in enumerate(rendered):
        torch.testing.assert_close(image, stored[index][0], rtol=0, atol=0)
        torch.testing.assert_close(label, stored[index][1], rtol=0, atol=0)
        count += 1
    assert count == len(stored) == 48


def test_rendered_worlds_are_in_no_data_set_of_the_recipe(made: Path) -> None:
    """Even with the recipe's own seed."""
    recipe = tiny_recipe()
    assert RenderedPairs(recipe, seed=recipe.seed).worlds.seed != recipe.seed
    assert len({RenderedPairs(recipe, seed=seed).worlds.seed for seed in range(100)}) == 100


def test_rendered_vectors_heights_and_epochs(variant: str) -> None:
    recipe = tiny_recipe(**DOWN, segments=["q1", "q3"], store="vectors", flight__height_m=[2.4, 2.6])
    pairs = RenderedPairs(recipe, seed=1, length=12, sequences_per_world=3, buffer=4, gain=0.05, frames=1, noise="low")
    first, again = list(pairs), list(pairs)
    assert all(torch.equal(a[0], b[0]) and torch.equal(a[1], b[1]) for a, b in zip(first, again, strict=True))
    assert len(first) == 12
    assert first[0][0].shape == (1, 40, 2)
    assert all(2.4 <= float(label) <= 2.6 for _, label in first)
    assert len({float(label) for _, label in first}) >= 3
    pairs.set_epoch(1)
    assert not {float(label) for _, label in pairs} & {float(label) for _, label in first}


def test_heights_are_those_of_the_sonar_below_its_vehicle(variant: str, tmp_path: Path) -> None:
    """Of a store and rendered, and the limits too: else quantised labels would be clipped to those of the vehicle."""
    recipe = tiny_recipe(
        frames=1, scenes=[{"sequences": 4}], mount__up_m=-0.4, flight__height_m=[2.4, 2.8], flight__pings=1, gain=0.02
    )
    make_dataset(recipe, str(tmp_path / "low.zarr"))
    stored = SonarPairs(tmp_path / "low.zarr", part="all", labels="quantised")
    assert [stored.labels.low.tolist(), stored.labels.high.tolist()] == [[pytest.approx(2.0)], [pytest.approx(2.4)]]
    for index in range(4):
        assert abs(stored.labels.decode(stored[index][1])[0] - stored.target(index)[0]) <= 0.4 / 31 / 2 + 1e-6
    rendered = [float(label) for _, label in RenderedPairs(recipe, seed=1, length=4, sequences_per_world=4, buffer=1)]
    assert all(2.0 <= height <= 2.4 for height in rendered)


@pytest.mark.slow
def test_workers_render_worlds_of_their_own() -> None:
    """Two spawned workers share the epoch's length, and no sample is made twice."""
    pairs = RenderedPairs(tiny_recipe(), seed=2, length=30, sequences_per_world=3, buffer=5, gain=0.02)
    batches = list(pairs.loader(5, workers=2))
    labels = torch.cat([label for _, label in batches])
    assert len(labels) == 30
    # a sequence has one motion and four samples: no motion may turn up more often
    _, times = torch.unique(labels, dim=0, return_counts=True)
    assert times.max() <= 4


@pytest.mark.posix
def test_what_cannot_be_rendered_in_training_is_refused() -> None:
    with pytest.raises(MitsonarError, match="random flights only"):
        RenderedPairs(load_recipe("pattern-runs"), seed=0)
    with pytest.raises(MitsonarError, match=r"at most flight\.pings, 5: got 6"):
        RenderedPairs(tiny_recipe(), seed=0, frames=6)
    forked = DataLoader(
        RenderedPairs(tiny_recipe(), seed=0, gain=1.0), num_workers=1, multiprocessing_context="fork", timeout=180
    )
    with pytest.raises(MitsonarError, match="multiprocessing_context"):
        next(iter(forked))


@pytest.mark.parametrize(
    ("kind", "given", "words"),
    [
        (SonarPairs, {"url": "absent.zarr", "layuot": "side"}, "SonarPairs has no argument layuot: did you mean layout"),
        (SonarPairs, {"url": "absent.zarr", "prat": "all"}, "SonarPairs has no argument prat: did you mean part"),
        (RenderedPairs, {"recipe": "rocky-field", "seed": 1, "lenght": 8}, "has no argument lenght: did you mean length"),
    ],
)
def test_a_mistyped_argument_is_one_sentence(kind: Any, given: dict[str, object], words: str) -> None:
    with pytest.raises(MitsonarError, match=words):
        kind(**given)


def test_the_options_that_editors_complete_are_those_of_samples() -> None:
    options = [name for name, one in inspect.signature(Samples).parameters.items() if one.kind is one.KEYWORD_ONLY]
    assert sorted(options) == sorted(SampleOptions.__annotations__)
