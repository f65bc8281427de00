"""Almanza-Medina's networks: layers as in tables and text, counted by hand; what is cut, padded, averaged; they learn."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from mitsonar.config.data import Recipe, load_recipe
from mitsonar.errors import MitsonarError

torch = pytest.importorskip("torch", reason="torch is not installed: install mitsonar[learn]")
pytestmark = pytest.mark.learn

from torch import Tensor, nn  # noqa: E402

from mitsonar.datasets.arrangement import arrangement_of  # noqa: E402
from mitsonar.networks import create_network  # noqa: E402
from mitsonar.networks.blocks import Quadrants, SameAverage, SameConv2d  # noqa: E402
from mitsonar.networks.create import NETWORKS, options_for, options_of  # noqa: E402

THESIS = ("posenet", "sfmnet", "cnn1b", "cnn4b", "cnn4posenet", "posenet_dual")
TINY = 1 / 16
SMALL: dict[str, dict[str, Any]] = {name: {"size": (128, 64)} for name in THESIS}
SMALL["cnn4b"] = {"size": (128, 128)}
SMALL["posenet_dual"] = {"size": (128, 64), "cartesian_size": (96, 80)}
WIDTHS = dict.fromkeys(THESIS, TINY) | {"cnn1b": 0.25, "cnn4b": 0.25}
"""Of networks that learn; those whose second convolution has 20 channels need more of them than one."""


def tiny(name: str, **options: Any) -> Any:
    torch.manual_seed(3)
    return create_network(name, **({"width": WIDTHS[name]} | SMALL[name] | options))


def inputs_of(network: Any, batch: int, device: str = "cpu") -> tuple[Tensor, ...]:
    """Random blocks of 8 x 8 cells, of the sizes that a network was made for."""
    torch.manual_seed(5)
    sizes = [network.options[name] for name in ("size", "cartesian_size") if name in network.options]
    blocks = [
        torch.rand(batch, network.options.get("channels", 1), -(-rows // 8), -(-columns // 8)) for rows, columns in sizes
    ]
    return tuple(
        block.repeat_interleave(8, 2).repeat_interleave(8, 3)[..., :rows, :columns].to(device)
        for block, (rows, columns) in zip(blocks, sizes, strict=True)
    )


def shapes(network: nn.Module, among: nn.Module, batch: int = 1) -> dict[str, tuple[int, ...]]:
    """Channels, rows and columns that leave each child of a module, without computing (on the meta device)."""
    result = {}
    for name, child in among.named_children():
        child.register_forward_hook(lambda _, __, out, name=name: result.update({name: tuple(out.shape[1:])}))
    network.to("meta").eval()(*inputs_of(network, batch, "meta"))
    return result


def parameters(network: nn.Module) -> int:
    return sum(values.numel() for values in network.parameters())


# ---------------------------------------------------------------- layers as in the tables and the text

TABLE_4_1 = """
Conv1 7×7 32 2×2 256×1000 Yes
Conv2 5×5 64 2×2 128×500 Yes
Conv3 3×3 128 2×2 64×250 Yes
Conv4 3×3 256 2×2 32×125 Yes
Conv5 3×3 512 2×2 16×63 Yes
Conv6 3×3 512 2×2 8×32 Yes
Conv7 3×3 512 2×2 4×16 Yes
Conv8 3×3 1024 2×2 2×8 Yes
Conv9 3×3 1024 2×2 1×4 No
Average 4×4 1024 1×1 1×4 No
"""


def table_4_1() -> dict[str, tuple[int, int, int, int, bool]]:
    """Kernel, channels, rows, columns, and whether ReLU and normalisation follow, of each layer."""
    rows = [line.split() for line in TABLE_4_1.strip().splitlines()]
    table = {}
    for name, kernel, channels, _, size, after in rows:
        height, width = map(int, size.split("×"))
        table[name.lower()] = (int(kernel[0]), int(channels), height, width, after == "Yes")
    return table


def test_posenet_is_table_4_1() -> None:
    with torch.device("meta"):
        network = create_network("posenet", size=(512, 2000))
    expected = {name: row[1:4] for name, row in table_4_1().items()}
    assert shapes(network, network.layers) == expected


def test_posenet_has_the_weights_of_table_4_1() -> None:
    with torch.device("meta"):
        network = create_network("posenet", size=(512, 2000))
    count, channels = 0, 1
    for name, (kernel, wider, _, _, normalised) in table_4_1().items():
        if name == "average":
            continue
        count += kernel * kernel * channels * wider + (2 * wider if normalised else wider)
        kinds = [type(layer) for layer in network.layers.get_submodule(name).modules()]
        assert (nn.ReLU in kinds, nn.BatchNorm2d in kinds) == (normalised, normalised), name
        channels = wider
    assert parameters(network) == count + 1 * 4 * 1024 * 3 + 3


@pytest.mark.parametrize(
    ("size", "left"),
    [((512, 192), (1, 1)), ((512, 288), (1, 1)), ((512, 384), (1, 1)), ((512, 1024), (1, 2)), ((1024, 512), (2, 1))],
)
def test_posenet_serves_three_frames_two_sensors_and_wide_frames(size: tuple[int, int], left: tuple[int, int]) -> None:
    network = create_network("posenet", size=size, width=TINY)
    assert network.regression.in_features == 64 * left[0] * left[1]
    assert network.eval()(*inputs_of(network, 2)).shape == (2, 3)


SFMNET = {
    "conv1": (7, 32, 4, 128, 48),
    "conv2": (5, 64, 3, 43, 16),
    "conv3": (3, 128, 3, 15, 6),
    "conv4": (3, 128, 2, 8, 3),
    "conv5": (3, 256, 1, 8, 3),
    "conv6": (3, 256, 2, 4, 2),
    "conv7": (3, 512, 1, 4, 2),
    "conv8": (3, 512, 2, 2, 1),
    "conv9": (3, 1024, 1, 2, 1),
    "conv10": (3, 1024, 2, 1, 1),
}
"""Kernel, channels, stride, rows and columns after it: 3.3.1 in numbers, each size divided by the stride and rounded up."""


def test_sfmnet_is_as_the_text_says() -> None:
    with torch.device("meta"):
        network = create_network("sfmnet")
    expected = {name: (channels, rows, columns) for name, (_, channels, _, rows, columns) in SFMNET.items()}
    assert shapes(network, network.layers) == expected | {"average": (1024, 1, 1)}
    channels, count = 1, 0
    for name, (kernel, wider, stride, _, _) in SFMNET.items():
        last = name == "conv10"
        convolution = network.layers.get_submodule(name if last else f"{name}.0")
        assert convolution.stride == (stride, stride)
        count += kernel * kernel * channels * wider + (wider if last else 2 * wider)
        channels = wider
    assert parameters(network) == count + 1024 * 3 + 3


def test_cnn1b_is_as_the_text_says() -> None:
    with torch.device("meta"):
        network = create_network("cnn1b")
    assert shapes(network, network.features) == {
        "coarse": (1, 64, 24),
        "conv1": (64, 64, 24),
        "pool1": (64, 16, 6),
        "conv2": (20, 16, 6),
        "pool2": (20, 8, 3),
    }
    assert parameters(network) == cnn1b_features() + fully_connected_network(64 * 16 * 6 + 20 * 8 * 3)


def cnn1b_features() -> int:
    """Weights and biases of its two convolutions."""
    return (9 * 9 * 1 * 64 + 64) + (2 * 2 * 64 * 20 + 20)


def fully_connected_network(values: int) -> int:
    """Weights and biases from those values by 2400, 1200, 600, 300 to three estimates."""
    sizes = [values, 2400, 1200, 600, 300, 3]
    return sum((before + 1) * after for before, after in pairwise(sizes))


def test_cnn4b_reads_four_images_as_large_as_that_of_cnn1b() -> None:
    """A quadrant pair of 256 x 96, coarser by 4, has the 64 x 24 cells of 512 x 192, coarser by 8."""
    with torch.device("meta"):
        network = create_network("cnn4b")
    for quarter in network.quarters:
        assert shapes(network, quarter)["coarse"] == (1, 64, 24)
    values = 4 * (64 * 16 * 6 + 20 * 8 * 3)
    assert parameters(network) == 4 * cnn1b_features() + fully_connected_network(values)


def test_cnn4posenet_is_as_the_text_says() -> None:
    with torch.device("meta"):
        network = create_network("cnn4posenet")
    kernels, channels = (7, 5, 3, 3, 3, 3, 3, 3), (1, 32, 64, 128, 256, 512, 512, 512, 1024)
    convolutions = sum(
        kernel**2 * before * after + 2 * after
        for kernel, before, after in zip(kernels, channels[:-1], channels[1:], strict=True)
    )
    fully_connected = (1024 * 1 * 1 + 1) * 1024 + (32 * (128 // 5) * (48 // 5) + 1) * 1024
    assert parameters(network) == 4 * (convolutions + fully_connected) + (8 * 1024 + 1) * 3
    for quarter in network.quarters:
        result = shapes(network, quarter)
        assert (result["first"], result["early"]) == ((32, 128, 48), (32, 25, 9))
        assert (result["others"], result["from_last"], result["from_first"]) == ((1024, 1, 1), (1024,), (1024,))


def test_posenet_dual_is_two_posenets() -> None:
    with torch.device("meta"):
        network = create_network("posenet_dual", cartesian_size=(512, 600))
        one = create_network("posenet")
    convolutions = parameters(one.layers)
    assert parameters(network.polar) == parameters(network.cartesian) == convolutions
    assert parameters(network) == 2 * convolutions + ((1 + 2) * 1024 + 1) * 1024 + 1025 * 3
    assert shapes(network, network)["cartesian"] == (1024, 1, 2)


# ---------------------------------------------------------------- padding, average, dropout, initialisation


@pytest.mark.parametrize(("length", "kernel", "stride"), [(8, 3, 2), (9, 3, 2), (8, 7, 2), (7, 5, 3), (5, 2, 1), (1, 3, 2)])
def test_same_padding_against_sums_by_hand(length: int, kernel: int, stride: int) -> None:
    """MATLAB: ceil(length / stride) cells; the zeros that this takes go half before and half after, an odd one after."""
    convolution = SameConv2d(1, 1, kernel, stride)
    rng = np.random.default_rng(1)
    image, weight = rng.normal(size=(length, length + 1)), rng.normal(size=(kernel, kernel))
    with torch.no_grad():
        convolution.weight[:] = torch.tensor(weight)
        assert convolution.bias is not None
        convolution.bias[:] = 0.25
        seen = convolution(torch.tensor(image, dtype=torch.float32)[None, None])[0, 0].numpy()
    cells = [math.ceil(one / stride) for one in image.shape]
    before = [max(0, (n - 1) * stride + kernel - one) // 2 for n, one in zip(cells, image.shape, strict=True)]
    expected = np.full(cells, 0.25)
    for row, column in np.ndindex(*cells):
        for down, right in np.ndindex(kernel, kernel):
            y, x = row * stride + down - before[0], column * stride + right - before[1]
            if 0 <= y < image.shape[0] and 0 <= x < image.shape[1]:
                expected[row, column] += weight[down, right] * image[y, x]
    np.testing.assert_allclose(seen, expected, atol=1e-5)


def test_the_average_counts_only_cells_of_the_image() -> None:
    image = torch.arange(30.0).reshape(1, 1, 5, 6)
    seen = SameAverage()(image)
    assert seen.shape == image.shape
    expected = [[image[0, 0, max(0, y - 1) : y + 3, max(0, x - 1) : x + 3].mean() for x in range(6)] for y in range(5)]
    torch.testing.assert_close(seen[0, 0], torch.tensor(expected))
    one = torch.tensor([[[[3.5]]]])
    torch.testing.assert_close(SameAverage()(one), one)


@pytest.mark.parametrize("name", THESIS)
def test_dropout_only_in_training(name: str) -> None:
    network = tiny(name)
    inputs = inputs_of(network, 4)
    assert not torch.equal(network(*inputs), network(*inputs))
    network.eval()
    torch.testing.assert_close(network(*inputs), network(*inputs), rtol=0, atol=0)
    without = tiny(name, dropout=0)
    torch.testing.assert_close(without(*inputs), without(*inputs), rtol=0, atol=0)


def test_weights_are_drawn_as_glorot_says() -> None:
    torch.manual_seed(0)
    weight = create_network("posenet", width=0.25).layers.get_submodule("conv6.0").weight
    limit = math.sqrt(6 / (3 * 3 * (128 + 128)))
    assert 0.999 * limit < weight.abs().max() <= limit
    spread = limit / math.sqrt(
        3
    )  # of a uniform distribution; the variance of n draws has a relative error of sqrt(4 / 5 / n)
    assert abs(weight.var().item() / spread**2 - 1) < 4 * math.sqrt(0.8 / weight.numel())


# ---------------------------------------------------------------- quadrants


def test_quadrants_stand_beside_their_like() -> None:
    image, row, column = torch.meshgrid(torch.arange(2), torch.arange(6), torch.arange(8), indexing="ij")
    code = 100 * image + 10 * row + column
    pair = torch.cat((code[0], code[1]), dim=1)[None, None]
    quadrants = Quadrants()(pair)
    for place, quadrant in enumerate(quadrants):
        rows = slice(0, 3) if place < 2 else slice(3, 6)
        columns = slice(0, 4) if place % 2 == 0 else slice(4, 8)
        expected = torch.cat((code[0, rows, columns], code[1, rows, columns]), dim=1)
        assert torch.equal(quadrant[0, 0], expected), place


@pytest.mark.parametrize("name", ["cnn4b", "cnn4posenet"])
@pytest.mark.parametrize("image", [0, 1])
def test_a_cell_reaches_only_the_network_of_its_quadrant(name: str, image: int) -> None:
    network = tiny(name).eval()
    seen: list[Tensor] = []
    for quarter in network.quarters:
        quarter.register_forward_hook(lambda _, __, out: seen.append(out))
    (pair,) = inputs_of(network, 1)
    rows, columns = network.options["size"]
    with torch.no_grad():
        network(pair)
        for place in range(4):
            changed = pair.clone()
            left = image * columns // 2 + (place % 2) * columns // 4
            changed[0, 0, (place // 2) * rows // 2 :, left:][: rows // 2, : columns // 4] += 1
            network(changed)
            differ = [not torch.equal(seen[quarter], seen[4 + quarter]) for quarter in range(4)]
            assert differ == [quarter == place for quarter in range(4)]
            del seen[4:]


@pytest.mark.parametrize("name", ["cnn4b", "cnn4posenet"])
@pytest.mark.parametrize("size", [(129, 128), (128, 126)])
def test_what_cannot_be_cut_is_refused(name: str, size: tuple[int, int]) -> None:
    with pytest.raises(MitsonarError, match=rf"quadrants: .* got {size[0]} x {size[1]}"):
        create_network(name, size=size)


# ---------------------------------------------------------------- what a data set gives


def recipe_of(views: int = 1) -> Recipe:
    """Of frames of 64 x 16 cells, or of 64 x 96 of two sensors."""
    if views == 2:
        return load_recipe("rocky-field-two-sensors", {"sonar.range_bins": 64})
    return load_recipe("rocky-field", {"sonar.range_bins": 64, "sonar.beams": 16})


@pytest.mark.parametrize("name", ["posenet", "sfmnet"])
@pytest.mark.parametrize(
    ("views", "frames", "words", "shape"),
    [
        (1, 2, {}, (1, 64, 32)),
        (1, 3, {}, (1, 64, 48)),
        (1, 2, {"layout": "stack"}, (1, 128, 16)),
        (1, 2, {"layout": "channels"}, (2, 64, 16)),
        (2, 2, {}, (1, 64, 384)),
    ],
)
def test_layouts_of_data_sets_are_read(
    name: str, views: int, frames: int, words: dict[str, Any], shape: tuple[int, int, int]
) -> None:
    inputs = arranged(recipe_of(views=views), frames, **words)
    assert tuple(inputs.shape[1:]) == shape
    options = options_for(name, inputs, torch.zeros(2, 3))
    network = create_network(name, width=TINY, **options)
    assert network.eval()(inputs).shape == (2, 3)


def arranged(recipe: Recipe, frames: int, **words: Any) -> Any:
    """The inputs of two samples of random frames, as a data set arranges them."""
    arrange = arrangement_of(recipe, **words)
    random = torch.Generator().manual_seed(1)
    shape = (2, frames, 64)
    images = {view: torch.rand(*shape, beams, generator=random) for view, beams in arrange.beams.items()}
    return arrange(images, torch.arange(2 * frames).reshape(2, frames), 0)


def test_polar_and_cartesian_inputs_settle_both_sizes() -> None:
    inputs = arranged(recipe_of(), 2, coordinates="both", cartesian_rows=48)
    options = options_for("posenet_dual", inputs, torch.zeros(2, 3))
    columns = inputs[1].shape[-1]
    assert options == {"outputs": 3, "size": [64, 32], "channels": 1, "cartesian_size": [48, columns]}
    assert create_network("posenet_dual", width=TINY, **options).eval()(*inputs).shape == (2, 3)
    assert NETWORKS["posenet_dual"].needs == {"coordinates": "both"}


def test_both_branches_of_the_dual_are_heard() -> None:
    network = tiny("posenet_dual").eval()
    polar, cartesian = inputs_of(network, 1)
    output = network(polar, cartesian)
    assert not torch.equal(network(polar + 0.1, cartesian), output)
    assert not torch.equal(network(polar, cartesian + 0.1), output)


def test_another_size_than_it_was_made_for_is_refused() -> None:
    network = tiny("posenet")
    with pytest.raises(MitsonarError, match=r"reads \(batch, 1, 128, 64\): got \(2, 2, 128, 32\).* size=\[128, 32\]"):
        network(torch.rand(2, 2, 128, 32))
    with pytest.raises(MitsonarError, match=r"got \(128, 64\)"):
        network(torch.rand(128, 64))
    dual = tiny("posenet_dual")
    with pytest.raises(MitsonarError, match=r"cartesian_size=\[128, 64\]"):
        dual(torch.rand(2, 1, 128, 64), torch.rand(2, 1, 128, 64))


# ---------------------------------------------------------------- learning


@pytest.mark.parametrize(
    "name", [name if name == "posenet" else pytest.param(name, marks=pytest.mark.slow) for name in THESIS]
)
def test_it_learns_eight_samples_by_heart(name: str) -> None:
    """Random images with labels in +-10: the loss falls from that of answering 0 to a tenth and less."""
    network = tiny(name, dropout=0)
    inputs = inputs_of(network, 8)
    labels = torch.empty(8, 3).uniform_(-10, 10)
    adam = torch.optim.Adam(network.parameters(), lr=3e-3)
    for _ in range(80):
        adam.zero_grad()
        loss = (network(*inputs) - labels).square().mean()
        loss.backward()
        adam.step()
    assert loss.item() < 0.1 * labels.square().mean().item()


@pytest.mark.parametrize("name", THESIS)
def test_every_weight_is_reached_by_the_gradient(name: str) -> None:
    network = tiny(name, dropout=0)
    network(*inputs_of(network, 4)).square().mean().backward()
    without = [key for key, values in network.named_parameters() if values.grad is None or not values.grad.abs().sum() > 0]
    assert without == []


# ---------------------------------------------------------------- by name, options, errors


@pytest.mark.parametrize("name", THESIS)
def test_options_make_the_network_again(name: str) -> None:
    network = tiny(name, outputs=2, dropout=0.25).eval()
    again = create_network(name, **network.options)
    assert again.options == network.options
    assert set(network.options) == set(options_of(name))
    again.load_state_dict(network.state_dict())
    inputs = inputs_of(network, 2)
    assert network(*inputs).shape == (2, 2)
    torch.testing.assert_close(again.eval()(*inputs), network(*inputs), rtol=0, atol=0)


@pytest.mark.parametrize("name", THESIS)
def test_width_scales_every_layer(name: str) -> None:
    with torch.device("meta"):
        narrow, wide = (create_network(name, width=width, **SMALL[name]) for width in (0.125, 0.25))
    for key, values in narrow.named_parameters():
        first, second = len(values), len(wide.get_parameter(key))
        assert (first, second) == (3, 3) if key.startswith("regression") else abs(second - 2 * first) <= 1, key


def test_known_names_are_told() -> None:
    with pytest.raises(
        MitsonarError, match=r"unknown network 'posnet': did you mean posenet.*Known: posenet, sfmnet, cnn1b"
    ):
        create_network("posnet")
    assert set(NETWORKS) == {*THESIS, "corrnet", "impulse_posenet", "posenetvec", "profilenet"}


def test_only_what_a_network_takes_is_settled() -> None:
    images, ground = torch.zeros(2, 2, 128, 16), {"height": torch.zeros(2)}
    assert options_for("corrnet", (images, ground), torch.zeros(2, 3)) == {}
    assert options_for("cnn4b", torch.zeros(2, 1, 128, 128), torch.zeros(2, 1)) == {"outputs": 1, "size": [128, 128]}
    with pytest.raises(MitsonarError, match="unknown network 'corr': did you mean corrnet"):
        options_for("corr", images, torch.zeros(2, 3))


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("posenet", {"widht": 1}, "unknown option 'widht' of posenet: did you mean width"),
        ("cnn4b", {"channels": 2}, "unknown option 'channels' of cnn4b: .*nown: outputs, width, dropout, size"),
        ("posenet", {"width": 0}, "width must be a number above 0 .*got 0"),
        ("posenet", {"width": float("nan")}, "width .*got nan"),
        ("posenet", {"width": "half"}, "width .*got 'half'"),
        ("sfmnet", {"outputs": 0}, "outputs must be a whole number of at least 1: got 0"),
        ("sfmnet", {"outputs": 2.5}, "outputs .*got 2.5"),
        ("cnn1b", {"dropout": 1}, "dropout must be a rate from 0 to below 1: got 1"),
        ("cnn1b", {"dropout": -0.1}, "dropout .*got -0.1"),
        ("cnn1b", {"size": (512, 56)}, "at least 64 x 64 cells .*got 512 x 56"),
        ("cnn4b", {"size": (128, 48)}, "at least 32 x 32 cells .*got 64 x 24"),
        ("cnn4posenet", {"size": (16, 64)}, "at least 9 x 9 cells: got 8 x 32"),
        ("posenet", {"size": 512}, r"size must be the input's rows and columns, such as \[512, 192\]: got 512"),
        ("posenet", {"size": (512, 0)}, "size .*got"),
        ("posenet", {"size": "12"}, "size .*got '12'"),
        ("posenet_dual", {"cartesian_size": (512,)}, "cartesian_size must be"),
    ],
)
def test_what_a_network_cannot_be_made_with(name: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(MitsonarError, match=message):
        create_network(name, **options)
